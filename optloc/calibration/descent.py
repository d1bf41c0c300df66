"""Networks refined as machine code, one after another: the steps of `Likelihood.refine` in scalar loops.

The rule of the steps and the sums are those of the form in numpy, which stands beside them and is what is read first.
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, put, put_rows

FIRST, EASE, STIFFEN = 1e-3, 0.2, 6.0
"""Marquardt's damping: at first, and its factors after a good and a bad step."""
LEAST, MOST = 1e-12, 1e12
"""Limits of the damping."""
SHORT = 10.0
"""Damping from which a step that does not lower the cost speaks of a minimum: a tenth of Newton's or less."""
SETTLED = 1e-12
"""Relative decrease of the cost below which a start has arrived: three decades above rounding, and far below what any
verdict asks for."""
FINAL = 3
"""Such steps in a row that end a refinement."""
FLOOR, NOTHING = 1e-13, 1e-290
"""What is added to a diagonal, of its largest entry and of nothing: it alone holds what no row tells."""
HELD = 1e6
"""Weight, of the largest entry of the diagonal, that holds a linear function of the stations: a millionth of a step."""


class Rows(NamedTuple):
    """What a network measured, as arrays: see `optloc.calibration.likelihood.Likelihood`.

    Parameters
    ----------
    z : array (N, R)
        Measured values.
    root : array (1 or S, N, R)
        Inverse standard deviations.
    first, second : int array (R,)
        Stations of each slot.
    gains, ticks : array (2, R)
        What their ranges and clocks count.
    emits : array (R,)
        What the emission counts.
    sought : bool array (N,)
        Whether the emission of a pulse is unknown.
    place, prior : array (M, d)
        What is known of places, and its inverse standard deviation.
    free : bool array (P,)
        Which station unknowns move.
    between : int array (q, 2)
        Pairs of stations whose distance is known.
    distance, near : array (q,)
        That distance and its inverse standard deviation.
    hold : array (0 or S, h, P)
        Linear functions of the station unknowns, of length one, that keep their values.
    """

    z: Array
    root: Array
    first: Array
    second: Array
    gains: Array
    ticks: Array
    emits: Array
    sought: Array
    place: Array
    prior: Array
    free: Array
    between: Array
    distance: Array
    near: Array
    hold: Array


class State(NamedTuple):
    """One network: stations (M, d), clocks (M,), pulses (N, d) and emission (N,)."""

    stations: Array
    clocks: Array
    pulses: Array
    emission: Array


class Room(NamedTuple):
    """Memory of a step: normal matrix (P, P) and gradient (P,) of stations; block, coupling and gradient of pulses."""

    normal: Array
    gradient: Array
    block: Array
    coupling: Array
    local: Array
    columns: Array
    values: Array


@compiled
def _apart(one: Array, i: int, other: Array, j: int) -> float:
    total = 0.0
    for c in range(one.shape[1]):
        total += (one[i, c] - other[j, c]) ** 2
    return sqrt(total)


@compiled
def total(rows: Rows, root: Array, at: State) -> float:
    """Return the weighted sum of squared residuals."""
    cost = 0.0
    for j in range(rows.z.shape[0]):
        for r in range(rows.z.shape[1]):
            if root[j, r] > 0.0:
                value = at.emission[j] * rows.emits[r]
                for e in range(2):
                    i = rows.first[r] if e == 0 else rows.second[r]
                    if rows.gains[e, r] != 0.0:
                        value += rows.gains[e, r] * _apart(at.stations, i, at.pulses, j)
                    value += rows.ticks[e, r] * at.clocks[i]
                cost += ((rows.z[j, r] - value) * root[j, r]) ** 2
    for i in range(rows.place.shape[0]):
        for c in range(rows.place.shape[1]):
            cost += ((at.stations[i, c] - rows.place[i, c]) * rows.prior[i, c]) ** 2
    for q in range(rows.distance.shape[0]):
        length = _apart(at.stations, rows.between[q, 0], at.stations, rows.between[q, 1])
        cost += ((rows.distance[q] - length) * rows.near[q]) ** 2
    return cost


@compiled
def _row(rows: Rows, weight: float, at: State, j: int, r: int, room: Room, pulse: Array) -> tuple[int, float]:
    """Write the derivatives of a row; return how many station unknowns it has, and its residual, all whitened."""
    m, d = at.stations.shape
    count, value = 0, at.emission[j] * rows.emits[r]
    for c in range(d):
        pulse[c] = 0.0
    pulse[d] = rows.emits[r] * weight
    for e in range(2):
        i, gain = (rows.first[r] if e == 0 else rows.second[r]), rows.gains[e, r]
        if gain != 0.0:
            length = max(_apart(at.stations, i, at.pulses, j), 1e-300)
            value += gain * length
            for c in range(d):
                unit = gain * weight * (at.stations[i, c] - at.pulses[j, c]) / length
                pulse[c] -= unit
                if rows.free[i * d + c]:
                    room.columns[count], room.values[count] = i * d + c, unit
                    count += 1
        tick = rows.ticks[e, r]
        value += tick * at.clocks[i]
        if tick != 0.0 and rows.free.shape[0] > m * d:
            room.columns[count], room.values[count] = m * d + i, tick * weight
            count += 1
    return count, (rows.z[j, r] - value) * weight


@compiled
def _gather(rows: Rows, root: Array, at: State, room: Room) -> None:
    """Sum the normal equations of stations and of pulses, before anything is eliminated."""
    d = at.stations.shape[1]
    room.normal[:], room.gradient[:] = 0.0, 0.0
    room.block[:], room.coupling[:], room.local[:] = 0.0, 0.0, 0.0
    pulse = np.zeros(d + 1)
    for j in range(rows.z.shape[0]):
        for r in range(rows.z.shape[1]):
            if root[j, r] > 0.0:
                count, residual = _row(rows, root[j, r], at, j, r, room, pulse)
                for i in range(count):
                    one, v = room.columns[i], room.values[i]
                    room.gradient[one] += v * residual
                    for k in range(i + 1):
                        room.normal[max(one, room.columns[k]), min(one, room.columns[k])] += v * room.values[k]
                    for c in range(d + 1):
                        room.coupling[j, c, one] += pulse[c] * v
                for c in range(d + 1):
                    room.local[j, c] += pulse[c] * residual
                    for k in range(c + 1):
                        room.block[j, c, k] += pulse[c] * pulse[k]
    for i in range(rows.place.shape[0]):
        for c in range(d):
            if rows.prior[i, c] > 0.0:
                room.normal[i * d + c, i * d + c] += rows.prior[i, c] ** 2
                room.gradient[i * d + c] += (rows.place[i, c] - at.stations[i, c]) * rows.prior[i, c] ** 2
    _gather_distances(rows, at, room)


@compiled
def _gather_distances(rows: Rows, at: State, room: Room) -> None:
    d = at.stations.shape[1]
    for q in range(rows.distance.shape[0]):
        length = max(_apart(at.stations, rows.between[q, 0], at.stations, rows.between[q, 1]), 1e-300)
        residual = (rows.distance[q] - length) * rows.near[q]
        count = 0
        for e in range(2):
            i, sign = rows.between[q, e], 1.0 - 2.0 * e
            for c in range(d):
                if rows.free[i * d + c]:
                    line = at.stations[rows.between[q, 0], c] - at.stations[rows.between[q, 1], c]
                    room.columns[count], room.values[count] = i * d + c, sign * line / length * rows.near[q]
                    count += 1
        for i in range(count):
            one = room.columns[i]
            room.gradient[one] += room.values[i] * residual
            for k in range(i + 1):
                other = room.columns[k]
                room.normal[max(one, other), min(one, other)] += room.values[i] * room.values[k]


@compiled
def _damp(matrix: Array, damping: float) -> float:
    """Add to the diagonal what `damping` and rounding ask for; return its largest entry."""
    largest = 0.0
    for i in range(matrix.shape[0]):
        largest = max(largest, matrix[i, i])
    for i in range(matrix.shape[0]):
        matrix[i, i] += damping * matrix[i, i] + FLOOR * largest + NOTHING
    return largest


@compiled
def _factor(matrix: Array) -> bool:
    """Replace the lower triangle by its Cholesky factor; return whether the matrix is positive definite."""
    n = matrix.shape[0]
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > 0.0:
            return False
        matrix[j, j] = sqrt(pivot)
        for i in range(j + 1, n):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = value / matrix[j, j]
    return True


@compiled
def _step(rows: Rows, root: Array, s: int, at: State, damping: float, room: Room, there: State) -> bool:
    """Write where a damped step of Gauss and Newton leads, the pulses eliminated; return whether there is one."""
    m, d = at.stations.shape
    n, p = at.pulses.shape[0], rows.free.shape[0]
    _gather(rows, root, at, room)
    largest = _damp(room.normal, damping)
    for i in range(p):
        if not rows.free[i]:
            room.normal[i, i] = 1.0
    for j in range(n):
        _damp(room.block[j], damping)
        if not rows.sought[j]:
            room.block[j, d, d] = 1.0
        if not _factor(room.block[j]):
            return False
        _forward(room.block[j], room.coupling[j], room.local[j])
    coupling = room.coupling.reshape(n * (d + 1), p)
    if rows.free.any():
        put_rows(room.normal - coupling.T @ coupling, room.normal)
        put(room.gradient - coupling.T @ room.local.reshape(n * (d + 1)), room.gradient)
    if rows.hold.shape[0]:
        for i in range(p):
            for k in range(i + 1):
                for h in range(rows.hold.shape[1]):
                    room.normal[i, k] += HELD * largest * rows.hold[s, h, i] * rows.hold[s, h, k]
    if not _factor(room.normal):
        return False
    _solve(room.normal, room.gradient)
    local = room.local - (coupling @ room.gradient).reshape(n, d + 1)
    for i in range(m):
        for c in range(d):
            there.stations[i, c] = at.stations[i, c] + room.gradient[i * d + c]
        there.clocks[i] = at.clocks[i] + (room.gradient[m * d + i] if p > m * d else 0.0)
    for j in range(n):
        _backward(room.block[j], local[j])
        for c in range(d):
            there.pulses[j, c] = at.pulses[j, c] + local[j, c]
        there.emission[j] = at.emission[j] + (local[j, d] if rows.sought[j] else 0.0)
    return True


@compiled
def _forward(lower: Array, many: Array, one: Array) -> None:
    """Replace right sides, the lines of one array and another, by the factor's inverse times them."""
    for i in range(lower.shape[0]):
        for k in range(i):
            one[i] -= lower[i, k] * one[k]
            for c in range(many.shape[1]):
                many[i, c] -= lower[i, k] * many[k, c]
        one[i] /= lower[i, i]
        for c in range(many.shape[1]):
            many[i, c] /= lower[i, i]


@compiled
def _backward(lower: Array, right: Array) -> None:
    for i in range(lower.shape[0] - 1, -1, -1):
        for k in range(i + 1, lower.shape[0]):
            right[i] -= lower[k, i] * right[k]
        right[i] /= lower[i, i]


@compiled
def _solve(lower: Array, right: Array) -> None:
    for i in range(lower.shape[0]):
        for k in range(i):
            right[i] -= lower[i, k] * right[k]
        right[i] /= lower[i, i]
    _backward(lower, right)


@compiled
def _copy(source: State, target: State) -> None:
    put_rows(source.stations, target.stations)
    put(source.clocks, target.clocks)
    put_rows(source.pulses, target.pulses)
    put(source.emission, target.emission)


@compiled
def descend(rows: Rows, all_of: State, cost: Array, steps: int) -> None:
    """Refine S networks in place, and write their costs.

    Parameters
    ----------
    rows : Rows
        What was measured.
    all_of : State
        S networks: every array has one more leading axis.
    cost : array (S,)
        Receives the weighted sums of squares.
    steps : int
        Of each, at most.
    """
    m, d = rows.place.shape
    n, p = rows.z.shape[0], rows.free.shape[0]
    normal, coupling = np.zeros((p, p)), np.zeros((n, d + 1, p))
    block, local = np.zeros((n, d + 1, d + 1)), np.zeros((n, d + 1))
    columns, values = np.zeros(2 * (d + 1), dtype=np.int64), np.zeros(2 * (d + 1))
    room = Room(normal, np.zeros(p), block, coupling, local, columns, values)
    there = State(np.zeros((m, d)), np.zeros(m), np.zeros((n, d)), np.zeros(n))
    for s in range(cost.shape[0]):
        at = State(all_of.stations[s], all_of.clocks[s], all_of.pulses[s], all_of.emission[s])
        root = rows.root[s if rows.root.shape[0] > 1 else 0]
        damping, settled = FIRST, 0
        cost[s] = total(rows, root, at)
        for _ in range(steps):
            after = np.inf
            if _step(rows, root, s, at, damping, room, there):
                after = total(rows, root, there)
            good = after < cost[s]
            damping = min(max(damping * (EASE if good else STIFFEN), LEAST), MOST)
            gain = cost[s] - after if good else 0.0
            small = gain <= SETTLED * (1.0 + cost[s]) and (good or damping > SHORT)
            settled = settled + 1 if small else 0
            if good:
                _copy(there, at)
                cost[s] = after
            if settled == FINAL or not isfinite(cost[s]):
                break
