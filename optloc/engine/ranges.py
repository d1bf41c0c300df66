"""Rows that are sums of ranges, with emission times as the only other unknowns: a linear map of ranges, and loops.

A block has W problems, one in each lane; s stations, d coordinates, q whitened rows, e emission times. K (q, s) maps
ranges to rows; u (q, W) are whitened measurements. `loop` (W,) is the cost of the loops, `place` (s, d, W) are the
stations. `left` and `spare` are scratch. `room` is the `EngineWorkspace` of the block: capitals, such as COST, name
rows of its arrays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.engine.memory import (
    AXES,
    BEYOND,
    COST,
    COST_TRIAL,
    DIAGONAL,
    EIGEN,
    FIX_COST,
    H_TRIAL,
    HIGH,
    INVERSE,
    LOOP,
    LOW,
    MOVE,
    ROW,
    SHARE,
    SOLVABLE,
    SPARE,
    TRIAL,
    EngineModel,
    EngineWorkspace,
    G,
    H,
    X,
)
from optloc.kernels.gtrs import minimise
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES, principal_axes


class RangeRows(NamedTuple):
    """Whitened rows over ranges r: the cost is ``|u - K r|^2`` plus the cost of *loops* (sums that no range changes).

    Parameters
    ----------
    correction : array (m,)
        Known amount by which each measurement exceeds the model, metres.
    K : array (q, s)
        Whitened rows, 1/metres. In `EngineModel.linear` the maps to u follow the maps to ranges, then come the maps to
        emission times for zero ranges, and to loops.
    travel : array (e, s)
        Coefficients with which the ranges reduce the emission times.
    start : int64 array (e,)
        Row that each emission time is relative to, or -1.
    norm : float
        Greatest singular value of K, 1/metres.
    level : bool
        Whether a common change of all ranges has no effect on K r. Then the cost has limits at infinity.
    wander : array (s,)
        Variances of isotropic station errors, m^2: noise, as the cheapest change of a range is along the line of sight.
    offset : int64 array (s,)
        First index of the errors of each station in parameter vectors; -1 if they are not unknowns.
    """

    correction: Array
    K: Array
    travel: Array
    start: Array
    norm: float
    level: bool
    wander: Array
    offset: Array


class RangeBlock(NamedTuple):
    """Rows with the memory for a block of problems of s stations.

    Parameters
    ----------
    rows : RangeRows
        Rows of all problems.
    r, unit : array (s, W), (s, d, W)
        Ranges in metres, and unit vectors from the stations.
    residual : array (q, W)
        Whitened residuals.
    sent : array (e, W)
        Emission times, metres.
    flat : array (q, d, W)
        Map from the direction of an infinitely remote emitter to the whitened residuals, along principal axes.
    stiff : array (d, W)
        Squared singular values of this map.
    """

    rows: RangeRows
    r: Array
    unit: Array
    residual: Array
    sent: Array
    flat: Array
    stiff: Array


@compiled
def count_unknowns(rows: RangeRows, d: int, size: int) -> int:
    """Return the number of coordinates: emission times follow from the position."""
    return d


@compiled
def count_lifted(rows: RangeRows) -> int:
    """Return the number of linear rows of other kinds: zero."""
    return 0


@compiled
def keep(model: EngineModel, rows: RangeRows, stations: int, d: int, size: int) -> RangeBlock:
    """Return the rows with the memory for a block of problems with `stations` stations and d coordinates."""
    q = len(rows.K)
    return RangeBlock(
        rows,
        np.zeros((stations, LANES)),
        np.zeros((stations, d, LANES)),
        np.zeros((q, LANES)),
        np.zeros((len(rows.start), LANES)),
        np.zeros((q, d, LANES)),
        np.zeros((d, LANES)),
    )


@compiled
def load(block: RangeBlock, z: Array, room: EngineWorkspace, anew: bool) -> None:
    """Write the cost of the loops to LOOP; for new stations (`anew`) also the map from directions at infinity."""
    first, loop = len(room.place) + len(block.rows.K) + len(block.rows.start), room.scalar[LOOP]
    for lane in range(LANES):
        loop[lane] = 0.0
    for i in range(first, len(room.value)):
        for lane in range(LANES):
            loop[lane] += room.value[i, lane] * room.value[i, lane]
    if anew and block.rows.level:
        _see_far(block, room)


@compiled
def minimise_start(model: EngineModel, block: RangeBlock, room: EngineWorkspace, first: bool) -> None:
    """Write the minimiser of the weighted squared-range rows to `room.y`, and to SOLVABLE whether it is unique."""
    minimise(room.rows, model.reference >= 0, room.y, room.scalar[SOLVABLE], room.work)


@compiled
def scout(model: EngineModel, block: RangeBlock, room: EngineWorkspace) -> None:
    """Do nothing: problems with too few rows of ranges use tapes instead."""


@compiled
def complete(block: RangeBlock, room: EngineWorkspace) -> None:
    """Do nothing: only the position is refined."""


@compiled
def equations(block: RangeBlock, room: EngineWorkspace, shift: int) -> None:
    """Write information (lower half), right side and cost at row X, or at TRIAL if `shift` is 1."""
    s, vector, scalar = len(room.place), room.vector, room.scalar
    _equations(
        block.rows.K,
        room.value[s : s + len(block.rows.K)],
        room.place,
        block.r,
        block.unit,
        vector[X + shift],
        vector[ROW],
        scalar[SPARE],
        scalar[LOOP],
        room.matrix[H + shift],
        vector[G + shift],
        scalar[COST + shift],
    )


@compiled
def costs(block: RangeBlock, room: EngineWorkspace) -> None:
    """Write the cost at TRIAL to COST_TRIAL: a third of the work of `equations`."""
    s, scalar = len(room.place), room.scalar
    u, trial = room.value[s : s + len(block.rows.K)], room.vector[TRIAL]
    _costs(block.rows.K, u, room.place, trial, block.r, scalar[SPARE], scalar[LOOP], scalar[COST_TRIAL])


@compiled
def bow_of(block: RangeBlock, room: EngineWorkspace) -> float:
    """Return a bound b of the curvature of all residuals, 1/metres.

    After a step D, the whitened residuals differ from their linear prediction by at most ``b D^2 / r``, see `bow_of` in
    `optloc.engine.evaluator`. r is the range to the nearest station, metres.

    A range exceeds its linear prediction by 0 to ``D^2 / 2 r``. So all residuals together differ by at most ``norm(K)
    sqrt(s) D^2 / 2 r``. If a common error of all ranges has no effect, half of this bound is valid.
    """
    return float(block.rows.norm * np.sqrt(len(block.r)) * (0.25 if block.rows.level else 0.5))


@compiled
def note_nearest(block: RangeBlock, room: EngineWorkspace, least: Array) -> None:
    """Write the range to the nearest station, metres, to `least` (W,)."""
    r = block.r
    for lane in range(LANES):
        least[lane] = np.inf
    for i in range(len(r)):
        for lane in range(LANES):
            least[lane] = min(least[lane], r[i, lane])


@compiled
def search_infinity(model: EngineModel, block: RangeBlock, room: EngineWorkspace) -> None:
    """Write the least cost at infinity to BEYOND: a closed form exists, so no search is necessary."""
    measure_infinity(block, room)


@compiled
def finish(block: RangeBlock, z: Array, room: EngineWorkspace, size: int, mark: Array, marked: bool, x: Array) -> None:
    """Write emission times and station errors at row X to x (N, p), metres: `size` lanes, or those with a `mark`."""
    if not len(block.rows.start) and not len(block.rows.wander):
        return
    ranges(room.place, room.vector[X], block.r, block.unit, room.scalar[SPARE])
    _emit(block, z, room, size, mark, marked, x)
    if len(block.rows.wander):
        _write_residuals(block, room)
        for i in range(len(block.rows.offset)):
            if block.rows.offset[i] >= 0:
                _shift(block, room, i, size, mark, marked, x)


@compiled
def _emit(block: RangeBlock, z: Array, room: EngineWorkspace, size: int, mark: Array, marked: bool, x: Array) -> None:
    """Write emission times to x (N, p), metres: their linear map less the share of the ranges, plus their reference."""
    item, r, sent, start, d = room.item, block.r, block.sent, block.rows.start, room.d
    first = len(room.place) + len(block.rows.K)
    for j in range(len(start)):
        at = start[j]
        for lane in range(LANES):
            since = z[item[lane], at] - block.rows.correction[at] if at >= 0 else 0.0
            sent[j, lane] = room.value[first + j, lane] + since
        for k in range(len(r)):
            for lane in range(LANES):
                sent[j, lane] -= block.rows.travel[j, k] * r[k, lane]
    for lane in range(size):
        if not marked or mark[lane] != 0.0:
            for j in range(len(start)):
                x[item[lane], d + j] = sent[j, lane]


@compiled
def _write_residuals(block: RangeBlock, room: EngineWorkspace) -> None:
    """Write the whitened residuals (q, W) ``u - K r`` of the ranges in `block.r` to `block.residual`."""
    K, residual, r, s = block.rows.K, block.residual, block.r, len(room.place)
    for k in range(len(K)):
        for lane in range(LANES):
            residual[k, lane] = room.value[s + k, lane]
        for i in range(s):
            part = K[k, i]
            if part != 0.0:
                for lane in range(LANES):
                    residual[k, lane] -= part * r[i, lane]


@compiled
def _shift(
    block: RangeBlock, room: EngineWorkspace, station: int, size: int, mark: Array, marked: bool, x: Array
) -> None:
    """Write the error of a station to x (N, p), metres: along the line of sight, its variance times half the slope."""
    K, residual, unit, first = block.rows.K, block.residual, block.unit, block.rows.offset[station]
    for lane in range(size):
        if not marked or mark[lane] != 0.0:
            longer = 0.0
            for k in range(len(K)):
                longer += K[k, station] * residual[k, lane]
            for j in range(room.d):
                # an error towards the target makes the range shorter
                x[room.item[lane], first + j] = -block.rows.wander[station] * longer * unit[station, j, lane]


@compiled
def _equations(
    K: Array,
    u: Array,
    place: Array,
    r: Array,
    unit: Array,
    x: Array,
    row: Array,
    left: Array,
    loop: Array,
    information: Array,
    right: Array,
    cost: Array,
) -> None:
    """Write information (lower half), right side and cost at positions x (d, W); `row` and `left` are scratch."""
    d = len(x)
    ranges(place, x, r, unit, left)
    for lane in range(LANES):
        cost[lane] = loop[lane]
    for i in range(d):
        for lane in range(LANES):
            right[i, lane] = 0.0
        for j in range(i + 1):
            for lane in range(LANES):
                information[i, j, lane] = 0.0
    for k in range(len(K)):
        _row(K[k], u[k], r, unit, row, left)
        for lane in range(LANES):
            cost[lane] += left[lane] * left[lane]
        for i in range(d):
            for lane in range(LANES):
                right[i, lane] += row[i, lane] * left[lane]
            for j in range(i + 1):
                for lane in range(LANES):
                    information[i, j, lane] += row[i, lane] * row[j, lane]


@compiled
def _row(share: Array, seen: Array, r: Array, unit: Array, row: Array, left: Array) -> None:
    """Write a whitened row (d, W) of the Jacobian, and its residual (W,): `seen` less the ranges times `share` (s,)."""
    s, d = unit.shape[:2]
    for lane in range(LANES):
        left[lane] = seen[lane]
    for j in range(d):
        for lane in range(LANES):
            row[j, lane] = 0.0
    for i in range(s):
        part = share[i]
        # For differences between two stations, only two entries of a row are not zero.
        if part != 0.0:
            for lane in range(LANES):
                left[lane] -= part * r[i, lane]
            for j in range(d):
                for lane in range(LANES):
                    row[j, lane] += part * unit[i, j, lane]


@compiled
def ranges(place: Array, x: Array, r: Array, unit: Array, spare: Array) -> None:
    """Write ranges (s, W), metres, and unit vectors (s, d, W) from the stations to positions x (d, W)."""
    s, d = place.shape[:2]
    for i in range(s):
        for lane in range(LANES):
            spare[lane] = 0.0
        for j in range(d):
            for lane in range(LANES):
                apart = x[j, lane] - place[i, j, lane]
                unit[i, j, lane] = apart
                spare[lane] += apart * apart
        for lane in range(LANES):
            r[i, lane] = np.sqrt(spare[lane])
            spare[lane] = 1.0 / r[i, lane]
        for j in range(d):
            for lane in range(LANES):
                unit[i, j, lane] *= spare[lane]


@compiled
def _costs(K: Array, u: Array, place: Array, x: Array, r: Array, left: Array, loop: Array, cost: Array) -> None:
    """Write the cost (W,) at positions x (d, W): a third of the work of `equations`; `r` and `left` are scratch."""
    s, d = place.shape[:2]
    for i in range(s):
        for lane in range(LANES):
            r[i, lane] = 0.0
        for j in range(d):
            for lane in range(LANES):
                apart = x[j, lane] - place[i, j, lane]
                r[i, lane] += apart * apart
        for lane in range(LANES):
            r[i, lane] = np.sqrt(r[i, lane])
    for lane in range(LANES):
        cost[lane] = loop[lane]
    for k in range(len(K)):
        for lane in range(LANES):
            left[lane] = u[k, lane]
        for i in range(s):
            part = K[k, i]
            if part != 0.0:
                for lane in range(LANES):
                    left[lane] -= part * r[i, lane]
        for lane in range(LANES):
            cost[lane] += left[lane] * left[lane]


@compiled
def bend(block: RangeBlock, room: EngineWorkspace) -> None:
    """Write half the second derivatives of the cost (information less curvature of the wave fronts) to H_TRIAL."""
    vector, matrix, scalar, K = room.vector, room.matrix, room.scalar, block.rows.K
    s, d = room.place.shape[:2]
    left, pull = scalar[SPARE], scalar[HIGH]
    out, residual, r, unit = matrix[H_TRIAL], block.residual, block.r, block.unit
    ranges(room.place, vector[X], r, unit, left)
    _write_residuals(block, room)
    for i in range(d):
        for j in range(i + 1):
            for lane in range(LANES):
                out[i, j, lane] = matrix[H, i, j, lane]
    for k in range(s):
        for lane in range(LANES):
            pull[lane] = 0.0
        for m in range(len(K)):
            part = K[m, k]
            if part != 0.0:
                for lane in range(LANES):
                    pull[lane] += part * residual[m, lane]
        for i in range(d):
            for j in range(i + 1):
                own = 1.0 if i == j else 0.0
                for lane in range(LANES):
                    across = own - unit[k, i, lane] * unit[k, j, lane]
                    out[i, j, lane] -= pull[lane] * across / r[k, lane]


# The cost at infinity.

BEYOND_DOUBT = 16.0
"""Cost above a fix from which on infinity is far outside every reported region."""

# Limit of Newton's steps on the secular equation; three to six are enough from this start.
_STEPS = 20
# Tolerance of the length of a direction, relative to one: the cost depends on the square of the length.
_UNIT = 1e-12


@compiled
def _see_far(block: RangeBlock, room: EngineWorkspace) -> None:
    """Write the map (q, d, W) from directions at infinity to whitened residuals, and its squared singular values."""
    s, d = room.place.shape[:2]
    flat = block.flat
    for k in range(len(flat)):
        for j in range(d):
            for lane in range(LANES):
                flat[k, j, lane] = 0.0
            for i in range(s):
                part = block.rows.K[k, i]
                if part != 0.0:
                    for lane in range(LANES):
                        flat[k, j, lane] += part * room.place[i, j, lane]
    _turn_to_axes(block, room)


@compiled
def _turn_to_axes(block: RangeBlock, room: EngineWorkspace) -> None:
    """Rotate the map F from directions to the principal axes of F^T F, and write its eigenvalues to `block.stiff`."""
    flat, stiff, row = block.flat, block.stiff, room.vector[MOVE]
    work, axes, d = room.axes[EIGEN], room.axes[AXES], room.d
    for i in range(d):
        for j in range(i + 1):
            for lane in range(LANES):
                work[i, j, lane] = 0.0
            for k in range(len(flat)):
                for lane in range(LANES):
                    work[i, j, lane] += flat[k, i, lane] * flat[k, j, lane]
    principal_axes(work, axes, room.scalar[SPARE])
    for j in range(d):
        for lane in range(LANES):
            stiff[j, lane] = work[j, j, lane]
    for k in range(len(flat)):
        for j in range(d):
            for lane in range(LANES):
                row[j, lane] = flat[k, j, lane]
        for j in range(d):
            for lane in range(LANES):
                flat[k, j, lane] = 0.0
            for i in range(d):
                for lane in range(LANES):
                    flat[k, j, lane] += row[i, lane] * axes[i, j, lane]


@compiled
def measure_infinity(block: RangeBlock, room: EngineWorkspace) -> None:
    """Write the least cost at infinity to BEYOND: exact if within `BEYOND_DOUBT` of FIX_COST, else a lower bound.

    It is infinite unless `rows.level` is True. The kernel reads LOOP, FIX_COST and the results of `_see_far`. A secular
    equation gives the least cost: the direction, a function of a multiplier, has length one.
    """
    scalar, vector = room.scalar, room.vector
    out = scalar[BEYOND]
    if not block.rows.level:
        for lane in range(LANES):
            out[lane] = np.inf
        return
    s = len(room.place)
    u = room.value[s : s + len(block.rows.K)]
    total, least, more, todo = scalar[HIGH], scalar[LOW], scalar[SHARE], scalar[COST_TRIAL]
    g, gap = vector[TRIAL], vector[DIAGONAL]
    d = len(g)
    _begin(u, block, room, g, gap, total, least, more)
    for _ in range(_STEPS):
        if not _step(scalar, g, gap, total, least, more, out, todo):
            break
    left = 0.0
    for lane in range(LANES):
        todo[lane] = 0.0 if out[lane] > scalar[FIX_COST, lane] + BEYOND_DOUBT else 1.0
        left += todo[lane]
    if left > 0.0:
        y = vector[INVERSE]
        for j in range(d):
            for lane in range(LANES):
                # a component without gradient and stiffness stays zero; `_lengthen` adds the missing length
                y[j, lane] = g[j, lane] / (gap[j, lane] + more[lane]) if g[j, lane] != 0.0 else 0.0
        _lengthen(y, gap, scalar[SPARE])
        _weigh(u, block, room, y, scalar[SPARE], scalar[HIGH])
        for lane in range(LANES):
            out[lane] = scalar[HIGH, lane] if todo[lane] != 0.0 else out[lane]


@compiled
def _begin(
    u: Array, block: RangeBlock, room: EngineWorkspace, g: Array, gap: Array, total: Array, least: Array, more: Array
) -> None:
    """Write gradient g, gaps of the eigenvalues, cost without ranges, least eigenvalue, and the first multiplier.

    Multipliers (`more`) are relative to minus the least eigenvalue, where no digits cancel. The first is the largest
    for which one component alone has length one: Newton's steps converge from this side.
    """
    q, d = len(u), len(g)
    for lane in range(LANES):
        total[lane], least[lane], more[lane] = room.scalar[LOOP, lane], np.inf, 0.0
    for j in range(d):
        for lane in range(LANES):
            least[lane] = min(least[lane], block.stiff[j, lane])
            g[j, lane] = 0.0
    for k in range(q):
        for lane in range(LANES):
            total[lane] += u[k, lane] * u[k, lane]
        for j in range(d):
            for lane in range(LANES):
                g[j, lane] -= block.flat[k, j, lane] * u[k, lane]
    for j in range(d):
        for lane in range(LANES):
            gap[j, lane] = block.stiff[j, lane] - least[lane]
            more[lane] = max(more[lane], abs(g[j, lane]) - gap[j, lane])


@compiled
def _step(
    scalar: Array, g: Array, gap: Array, total: Array, least: Array, more: Array, low: Array, todo: Array
) -> bool:
    """Write lower bounds of the cost to `low` (W,), and step multipliers of low bounds; return whether any moved."""
    d, square, cube = len(g), scalar[SPARE], todo
    for lane in range(LANES):
        low[lane], square[lane], cube[lane] = total[lane] + least[lane] - more[lane], 0.0, 0.0
    for j in range(d):
        for lane in range(LANES):
            away = gap[j, lane] + more[lane]
            part = g[j, lane] / away if g[j, lane] != 0.0 else 0.0
            low[lane] -= g[j, lane] * part
            square[lane] += part * part
            cube[lane] += part * part / away if g[j, lane] != 0.0 else 0.0
    moving = 0.0
    for lane in range(LANES):
        length = np.sqrt(square[lane])
        # a direction that is too short even here is the hard case: two directions of equal cost; the bound is valid
        left = length > 1.0 + _UNIT and low[lane] <= scalar[FIX_COST, lane] + BEYOND_DOUBT
        # Newton's step for 1 / length = 1, which is nearly linear
        more[lane] += square[lane] * (length - 1.0) / cube[lane] if left else 0.0
        moving += 1.0 if left else 0.0
    return moving > 0.0


@compiled
def _lengthen(y: Array, gap: Array, spare: Array) -> None:
    """Scale directions (d, W) to length one; shorter ones get a component along the axis of the least eigenvalue."""
    d = len(y)
    for lane in range(LANES):
        spare[lane] = 0.0
    for j in range(d):
        for lane in range(LANES):
            spare[lane] += y[j, lane] * y[j, lane]
    for j in range(d):
        for lane in range(LANES):
            if gap[j, lane] == 0.0 and spare[lane] < 1.0:
                own = y[j, lane] * y[j, lane]
                size = np.sqrt(max(1.0 - spare[lane] + own, 0.0))
                y[j, lane] = size if y[j, lane] >= 0.0 else -size
                spare[lane] = 1.0
    for j in range(d):
        for lane in range(LANES):
            y[j, lane] /= np.sqrt(spare[lane])


@compiled
def _weigh(u: Array, block: RangeBlock, room: EngineWorkspace, y: Array, left: Array, cost: Array) -> None:
    """Write the cost (W,) of emitters at infinity in directions y (d, W), more accurate than the bound of `_step`."""
    for lane in range(LANES):
        cost[lane] = room.scalar[LOOP, lane]
    for k in range(len(u)):
        for lane in range(LANES):
            left[lane] = u[k, lane]
        for j in range(len(y)):
            for lane in range(LANES):
                left[lane] += block.flat[k, j, lane] * y[j, lane]
        for lane in range(LANES):
            cost[lane] += left[lane] * left[lane]
