"""A target in uniform motion: bounds of a cost over boxes of positions and velocities.

The rows are those of a run; a node of an epoch at time t is bounded over the places ``p + t v`` of all states (p, v) of
a box, which lie in a box of space again. Slopes and Hessians with respect to the state follow by the chain rule, and
are summed over all nodes before a bound is taken. Coordinates are the principal axes of the cost at the fix.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.compute.systems import invert
from optloc.proof.batch import plainly
from optloc.proof.box import bound_nodes
from optloc.proof.chart import accuracy_floor
from optloc.proof.curvature import curve_nodes, entry
from optloc.proof.nodes.node import CHI, CURVE_WIDTH, H00, HIGH, LOW, NODE_WIDTH, SLOPE0
from optloc.proof.runs.rows import (
    Rows,
    Sheet,
    blur_of,
    digits_of,
    greatest_length,
    multiply,
    norm_of,
    project,
    pull_back,
    residual_at,
    sheet_of,
)

# What is searched.


class Course(NamedTuple):
    """The cost of a run over the state of a target in uniform motion.

    Parameters
    ----------
    kinds, data : int array (J,), array (J, width)
        The nodes, epoch by epoch.
    first : int array (K + 1,)
        Where the nodes of each epoch begin, and the end.
    since : array (K,)
        Seconds of each epoch from the time at which the state holds.
    rows : Rows
        All rows.
    """

    kinds: Array
    data: Array
    first: Array
    since: Array
    rows: Rows


class Axes(NamedTuple):
    """Search coordinates s of states: ``(p, v) = origin + turn s``.

    Parameters
    ----------
    origin : array (n,)
        Position and velocity of the fix, n = 2 d.
    turn, back : array (n, n)
        Their derivative with respect to s, and its inverse.
    corners : array (2, n)
        Lowest and highest state of the region.
    """

    origin: Array
    turn: Array
    back: Array
    corners: Array


class Table(NamedTuple):
    """Working memory for one box of a course.

    Parameters
    ----------
    at, half : array (n,)
        The box.
    unit : array (n,)
        Lengths in which derivatives are taken: half-widths of a box, or one.
    lever : array (K, d, n)
        Derivatives of the places of each epoch with respect to coordinates in these lengths.
    places : array (K, 2, 3)
        Middle and half-widths of the places of each epoch, metres.
    nodes, curves : array (J, NODE_WIDTH), (J, CURVE_WIDTH)
        Tables of all nodes, with derivatives with respect to the place.
    sheet : Sheet
        Of the rows.
    lines, pulls : array (n, q), (n, J)
        Columns of the Jacobian, and what they pull at the nodes.
    slope, along : array (n,)
        The gradient of f/2 at the centre, and the inner products of the Jacobian with a direction.
    hessian, change : array (n, n)
        The Hessian of f/2 at the centre, and by how much its entries change to first order.
    move : array (n,)
        A step.
    solve : array (n, n)
        Working memory.
    """

    at: Array
    half: Array
    unit: Array
    lever: Array
    places: Array
    nodes: Array
    curves: Array
    sheet: Sheet
    lines: Array
    pulls: Array
    slope: Array
    along: Array
    hessian: Array
    change: Array
    move: Array
    solve: Array


# A half-width covers the rounding of centres: relative to itself, and some units in the last place of these.
WIDER, SHIFT = 1e-12, 1e-15


@compiled
def table_of(course: Course, n: int) -> Table:
    """Return working memory for boxes of n coordinates."""
    J, K, q, d = course.kinds.shape[0], course.since.shape[0], course.rows.w.shape[0], n // 2
    vectors, matrices = np.zeros((6, n)), np.zeros((3, n, n))
    return Table(
        vectors[0],
        vectors[1],
        vectors[2],
        np.zeros((K, d, n)),
        np.zeros((K, 2, 3)),
        np.zeros((J, NODE_WIDTH)),
        np.zeros((J, CURVE_WIDTH)),
        sheet_of(course.rows),
        np.zeros((n, q)),
        np.zeros((n, J)),
        vectors[3],
        vectors[4],
        matrices[0],
        matrices[1],
        vectors[5],
        matrices[2],
    )


@compiled
def put(table: Table, at: Array, half: Array) -> None:
    """Set a box, whose derivatives are taken in its half-widths."""
    for m in range(at.shape[0]):
        table.at[m], table.half[m], table.unit[m] = at[m], half[m], half[m]


@compiled
def set_box(course: Course, axes: Axes, table: Table) -> None:
    """Bound all nodes over a box that is set, and write the levers of its unit."""
    n, d, at, half = table.at.shape[0], table.at.shape[0] // 2, table.at, table.half
    plan, line = np.zeros((3, 3)), np.zeros(6)
    for i in range(d):
        plan[i, i] = 1.0
    for k in range(course.since.shape[0]):
        time, place, reach = course.since[k], table.places[k, 0], table.places[k, 1]
        for i in range(d):
            place[i], reach[i] = axes.origin[i] + time * axes.origin[d + i], 0.0
            size = abs(axes.origin[i]) + abs(time * axes.origin[d + i])
            for m in range(n):
                lever = axes.turn[i, m] + time * axes.turn[d + i, m]
                place[i] += lever * at[m]
                reach[i] += abs(lever) * half[m]
                size += (abs(axes.turn[i, m]) + abs(time * axes.turn[d + i, m])) * (abs(at[m]) + half[m])
                table.lever[k, i, m] = lever * table.unit[m]
            if reach[i] > 0.0:
                reach[i] += WIDER * reach[i] + SHIFT * n * size
        a, b = course.first[k], course.first[k + 1]
        bound_nodes(course.kinds[a:b], course.data[a:b], place, plan, plan, reach, line, table.nodes[a:b])


@compiled
def set_bends(course: Course, table: Table) -> None:
    """Bound second derivatives of all nodes, with respect to the place, over a box whose nodes are bounded."""
    plan, line, second = np.zeros((3, 3)), np.zeros(6), np.zeros((3, 3))
    for i in range(table.lever.shape[1]):
        plan[i, i] = 1.0
    for k in range(course.since.shape[0]):
        a, b, place, reach = course.first[k], course.first[k + 1], table.places[k, 0], table.places[k, 1]
        nodes, curves = table.nodes[a:b], table.curves[a:b]
        curve_nodes(course.kinds[a:b], course.data[a:b], place, plan, plan, reach, line, second, nodes, curves)


@compiled
def set_lines(course: Course, table: Table) -> None:
    """Write the Jacobian of the rows at the centre of a box whose nodes are bounded."""
    values, d = table.sheet.reach, table.lever.shape[1]
    for m in range(table.at.shape[0]):
        for k in range(course.since.shape[0]):
            for j in range(course.first[k], course.first[k + 1]):
                values[j] = 0.0
                for i in range(d):
                    values[j] += table.nodes[j, SLOPE0 + i] * table.lever[k, i, m]
        multiply(course.rows, values, table.lines[m])
        project(course.rows, table.lines[m])


# Bounds of the residual over a box.

# Coordinate descents towards the least-squares point of a box; any point gives a valid bound.
_SWEEPS = 3


@compiled
def _reach(course: Course, table: Table, direction: Array, curved: bool) -> float:
    """Return a lower bound of ``|P e|`` over a box from one direction (q,), rounding apart; see `least_length`."""
    n, d, force = table.at.shape[0], table.lever.shape[1], table.sheet.force
    length, total, rest = 0.0, 0.0, 0.0
    for i in range(direction.shape[0]):
        length += direction[i] * direction[i]
        total += direction[i] * table.sheet.residual[i]
    if not length > 0.0:
        return -1.0
    pull_back(course.rows, direction, force)
    table.along[:], table.solve[:] = 0.0, 0.0
    for k in range(course.since.shape[0]):
        lever, third = table.lever[k], 0.0
        for i in range(d):
            third += table.places[k, 1, i] * table.places[k, 1, i] / 6.0
        for j in range(course.first[k], course.first[k + 1]):
            still = True
            for i in range(d):
                slope = force[j] * table.nodes[j, SLOPE0 + i]
                still = still and table.nodes[j, SLOPE0 + i] == 0.0
                for m in range(n):
                    table.along[m] += slope * lever[i, m]
            enclosed = min(force[j] * table.nodes[j, LOW], force[j] * table.nodes[j, HIGH])
            left = -abs(force[j]) * table.curves[j, CHI] * third if curved and not still else -inf
            if left > enclosed:
                rest += left
                _bend(table.curves[j], lever, force[j], table.solve)
            else:
                rest += enclosed
    for m in range(n):
        rest += 0.5 * min(table.solve[m, m], 0.0)
        for other in range(m):
            rest -= abs(table.solve[m, other])
        rest -= abs(table.along[m])
    return float((total + rest) / sqrt(length))


@compiled
def _bend(curve: Array, lever: Array, factor: float, out: Array) -> None:
    """Add ``factor L'N L`` to the lower triangle of a matrix (n, n), N the Hessian of a node."""
    d, n = lever.shape
    for m in range(n):
        for i in range(d):
            along = 0.0
            for k in range(d):
                along += curve[H00 + entry(i, k)] * lever[k, m]
            for other in range(m, n):
                out[other, m] += factor * along * lever[i, other]


@compiled
def least_length(course: Course, table: Table, cost: float, curved: bool) -> float:
    """Return a lower bound of ``|P e|`` over a box, rounding apart; negative where it says nothing.

    The residual at the centre and the Jacobian are set. Of the directions that are tried the last is the residual
    nearest to zero of the linear part.
    """
    sheet, lines, n = table.sheet, table.lines, table.at.shape[0]
    if not cost > 0.0:
        return -1.0
    s, v = table.move, sheet.length
    for m in range(n):
        s[m] = 0.0
    for i in range(v.shape[0]):
        v[i] = sheet.residual[i]
    for _ in range(_SWEEPS):
        for m in range(n):
            pull = own = 0.0
            for i in range(v.shape[0]):
                pull += lines[m, i] * v[i]
                own += lines[m, i] * lines[m, i]
            if own > 0.0:
                new = min(max(s[m] - pull / own, -1.0), 1.0)
                step = new - s[m]
                for i in range(v.shape[0]):
                    v[i] += step * lines[m, i]
                s[m] = new
    return _reach(course, table, v, curved)


# Second derivatives of f/2 over a box.


@compiled
def sum_up(course: Course, table: Table, noise: float) -> tuple[float, float]:
    """Fill gradient, Hessian and its change of first order; return bounds of the rest's norm and the gradient's blur.

    As `optloc.proof.runs.rows.sum_up_rows`, in units of the half-widths of the box; nodes, Hessians of nodes, residual
    and Jacobian are set, `noise` is the rounding of a residual.
    """
    rows, sheet, lines, pulls, n = course.rows, table.sheet, table.lines, table.pulls, table.at.shape[0]
    pull_back(rows, sheet.residual, sheet.force)
    longest, widest = 0.0, 0.0
    for value in sheet.residual:
        longest += value * value
    longest = sqrt(longest)
    table.hessian[:] = 0.0
    for m in range(n):
        pull_back(rows, lines[m], pulls[m])
        table.slope[m] = 0.0
        for i in range(lines.shape[1]):
            table.slope[m] += lines[m, i] * sheet.residual[i]
        for other in range(m + 1):
            for i in range(lines.shape[1]):
                table.hessian[m, other] += lines[m, i] * lines[other, i]
        widest = max(widest, table.hessian[m, m])
    blur = _blur_of_lines(course, table)
    _turn(course, table)
    for m in range(n):
        for other in range(m):
            table.hessian[other, m] = table.hessian[m, other]
        for other in range(
            n
        ):  # the rounding of J'J counts as change, twice: for the mean over a line half of it counts
            table.change[m, other] += 4.0 * sqrt(widest) * blur
    ball = _rest(course, table, noise + digits_of(rows) * longest)
    return ball, sqrt(widest) * noise + blur * (longest + noise)


@compiled
def _blur_of_lines(course: Course, table: Table) -> float:
    """Return a bound of the rounding of each column of the Jacobian."""
    most = 0.0
    for m in range(table.at.shape[0]):
        total = 0.0
        for k in range(course.since.shape[0]):
            for j in range(course.first[k], course.first[k + 1]):
                for i in range(table.lever.shape[1]):
                    total += course.rows.weight[j] * abs(table.nodes[j, SLOPE0 + i] * table.lever[k, i, m])
        most = max(most, total)
    return float(digits_of(course.rows) * most)


@compiled
def _turn(course: Course, table: Table) -> None:
    """Add the nodes' part of the Hessian, and write what is linear in s of its change."""
    n, own = table.at.shape[0], table.solve
    third = np.zeros((n, n, n))
    for k in range(course.since.shape[0]):
        for j in range(course.first[k], course.first[k + 1]):
            own[:] = 0.0
            _bend(table.curves[j], table.lever[k], 1.0, own)
            for m in range(n):
                for other in range(m + 1):
                    table.hessian[m, other] += table.sheet.force[j] * own[m, other]
                    for along in range(n):
                        third[along, m, other] += table.pulls[along, j] * own[m, other]
    for a in range(n):
        for b in range(a + 1):
            change = 0.0
            for k in range(n):
                ka, kb = third[b, max(k, a), min(k, a)], third[a, max(k, b), min(k, b)]
                change += abs(third[k, a, b] + ka + kb)
            table.change[a, b] = table.change[b, a] = change


@compiled
def _rest(course: Course, table: Table, blur: float) -> float:
    """Return a bound of the norm of what else changes in the Hessian; see `optloc.proof.runs.rows`."""
    rows, sheet, reach, n = course.rows, table.sheet, table.sheet.reach, table.at.shape[0]
    own = cross = ball = 0.0
    size = sqrt(float(n))
    for k in range(course.since.shape[0]):
        lever = _squared(table.lever[k])
        for j in range(course.first[k], course.first[k + 1]):
            chi, across, along = table.curves[j, CHI] * lever, 0.0, 0.0
            for m in range(n):
                across += table.pulls[m, j] * table.pulls[m, j]
                along += abs(table.pulls[m, j])
            ball += (abs(sheet.force[j]) + along) * chi
            cross += sqrt(across) * chi * size
            own += rows.weight[j] * blur * norm_of(table.curves, j) * lever
            reach[j] = max(-table.nodes[j, LOW], table.nodes[j, HIGH])
    if not ball < inf:
        return inf
    remainder = greatest_length(rows, reach, sheet.length)
    for k in range(course.since.shape[0]):
        for j in range(course.first[k], course.first[k + 1]):
            reach[j] = norm_of(table.curves, j) * _squared(table.lever[k])
    bent = greatest_length(rows, reach, sheet.length)
    for k in range(course.since.shape[0]):
        for j in range(course.first[k], course.first[k + 1]):
            reach[j] = table.curves[j, CHI] * _squared(table.lever[k])
    wide = greatest_length(rows, reach, sheet.length)
    jump = bent * size + 0.5 * wide * size
    return float(ball + cross + 2.0 * own + remainder * (bent + wide) + jump * jump)


@compiled
def _squared(lever: Array) -> float:
    """Return the squared Frobenius norm of a lever (d, n)."""
    total = 0.0
    for i in range(lever.shape[0]):
        for m in range(lever.shape[1]):
            total += lever[i, m] * lever[i, m]
    return total


@compiled
def is_convex(table: Table, ball: float, margin: float) -> bool:
    """Return whether the Hessian of f/2, in lengths of 1, exceeds `margin` all over a box whose sums are filled."""
    if not ball < inf:
        return False
    n, matrix = table.at.shape[0], table.solve
    for m in range(n):
        away = ball + margin * table.unit[m] * table.unit[m]
        for other in range(n):
            matrix[m, other] = table.hessian[m, other]
            away += table.change[m, other]
        matrix[m, m] -= away
    return invert(matrix, n, 1e-12)


@compiled
def has_no_minimum(table: Table, ball: float, noise: float) -> bool:
    """Return whether no minimum of the cost can lie in a box whose sums are filled.

    The gradient does not vanish, or the cost bends downwards along a coordinate.
    """
    n, matrix = table.at.shape[0], table.solve
    if not ball < inf:
        return False
    size = sqrt(float(n))
    for m in range(n):
        change = ball * size
        for other in range(n):
            change += abs(table.hessian[m, other]) + table.change[m, other]
            matrix[m, other] = table.hessian[m, other]
        # slack for the rounding of the sums
        if abs(table.slope[m]) > change * (1.0 + 1e-6) + noise:
            return True
        if table.hessian[m, m] + (table.change[m, m] + ball) * (1.0 + 1e-6) < 0.0:
            return True
    if not invert(matrix, n, 1e-12):
        return False
    # with Y nearly the inverse: s = -Y slope - (Y H - 1) s - Y (change s)
    for k in range(n):
        centre, spread = 0.0, 0.0
        for m in range(n):
            own, turned = abs(matrix[k, m]), -1.0 if k == m else 0.0
            centre -= matrix[k, m] * table.slope[m]
            for other in range(n):
                turned += matrix[k, other] * table.hessian[other, m]
                spread += own * table.change[m, other]
            spread += own * (noise + ball * size) + abs(turned)
        if abs(centre) > 1.0 + spread * (1.0 + 1e-6) + 1e-9 * abs(centre):
            return True
    return False


# States by themselves.


@compiled
def cost_of_state(course: Course, state: Array) -> tuple[float, float]:
    """Return the cost of a state (n,), and the rounding of its residual."""
    table = table_of(course, state.shape[0])
    table.unit[:] = 1.0
    set_box(course, _own_axes(state), table)
    cost = residual_at(course.rows, table.nodes, table.sheet)
    return cost, blur_of(course.rows, floor_of(course, state), table.nodes)


@compiled
def hessian_of_state(course: Course, state: Array) -> Array:
    """Return the Hessian (n, n) of f/2 at a state (n,)."""
    table = table_of(course, state.shape[0])
    table.unit[:] = 1.0
    set_box(course, _own_axes(state), table)
    residual_at(course.rows, table.nodes, table.sheet)
    set_lines(course, table)
    set_bends(course, table)
    sum_up(course, table, 0.0)
    return table.hessian


@compiled
def _own_axes(state: Array) -> Axes:
    n = state.shape[0]
    return Axes(state, np.eye(n), np.eye(n), np.zeros((2, n)))


@compiled
def floor_of(course: Course, state: Array) -> float:
    """Return the sizes of what residuals are differences of, beside the nodes, over all places of a state."""
    d, last, most = state.shape[0] // 2, 0.0, np.zeros(3)
    for time in course.since:
        last = max(last, abs(time))
    for i in range(d):
        most[i] = abs(state[i]) + last * abs(state[d + i])
    return accuracy_floor(course.kinds, course.data, course.rows.weight, course.rows.w, most)


def axes_of(hessian: Array, state: Array, corners: Array) -> Axes | None:
    """Return the principal axes of the cost at a state (n,), in standard deviations; None where it is no minimum."""
    size = np.sqrt(np.maximum(np.diag(hessian), 0.0))
    if not (np.isfinite(hessian).all() and size.all()):
        return None
    values, vectors = np.linalg.eigh(hessian / size / size[:, None])
    if not values[0] > 0.0:
        return None
    turn = vectors / size[:, None] / np.sqrt(values)
    return Axes(state, plainly(turn), plainly(np.linalg.inv(turn)), corners)
