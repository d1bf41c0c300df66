"""The least cost of remote emitters: range differences become differences of station places along a direction.

Far away a range is ``R - s'e`` for a direction e, and R drops out where the rows are differences. What is left is least
squares on the unit sphere, ``min |u + M e|^2`` with ``M = K S``, which the secular equation solves exactly:
``e = (A + mu)^-1 g`` with ``A = M'M``, ``g = -M'u`` and the multiplier mu of ``|e| = 1`` not below minus the least
eigenvalue of A. Every such mu gives a lower bound, so that most problems are done before the equation is solved.

Source: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993).
"""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.compute.principal import principal_axes
from optloc.compute.range_room import (
    AXES,
    BEYOND,
    COST_TRIAL,
    DIAGONAL,
    FIX_COST,
    H_TRIAL,
    HIGH,
    INVERSE,
    LOOP,
    LOW,
    MOVE,
    SHARE,
    SPARE,
    TRIAL,
    Model,
    Room,
)
from optloc.compute.systems import LANES

BEYOND_DOUBT = 16.0
"""Cost above that of a fix from which on infinity is far outside every region that is reported."""

# Newton's steps on the secular equation: three to six from the start that is taken here.
_STEPS = 20
# Share by which the direction may differ from unit length: the cost hangs on its square.
_UNIT = 1e-12


@compiled
def see_far(model: Model, room: Room) -> None:
    """Write the map from directions to whitened rows, turned to its principal axes, and its squared singular values."""
    s, d = room.place.shape[:2]
    flat = room.flat
    for k in range(len(flat)):
        for j in range(d):
            for lane in range(LANES):
                flat[k, j, lane] = 0.0
            for i in range(s):
                part = model.K[k, i]
                if part != 0.0:
                    for lane in range(LANES):
                        flat[k, j, lane] += part * room.place[i, j, lane]
    _turn_to_axes(room)


@compiled
def _turn_to_axes(room: Room) -> None:
    """Turn the map to the principal axes of its square."""
    matrix, flat, row = room.matrix, room.flat, room.vector[MOVE]
    work, axes, d = matrix[H_TRIAL], matrix[AXES], len(room.bend)
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
            room.bend[j, lane] = work[j, j, lane]
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
def measure_infinity(model: Model, u: Array, room: Room) -> None:
    """Write the least cost at infinity to BEYOND: exact where it is within `BEYOND_DOUBT` of FIX_COST, else a bound.

    Parameters
    ----------
    model : Model
        What all problems share.
    u : array (q, W)
        Whitened rows.
    room : Room
        LOOP, FIX_COST and what `see_far` wrote in; rows of scratch are overwritten.
    """
    scalar, vector = room.scalar, room.vector
    out = scalar[BEYOND]
    if not model.level:
        for lane in range(LANES):
            out[lane] = np.inf
        return
    total, least, more, todo = scalar[HIGH], scalar[LOW], scalar[SHARE], scalar[COST_TRIAL]
    g, gap = vector[TRIAL], vector[DIAGONAL]
    d = len(g)
    _begin(u, room, g, gap, total, least, more)
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
                # a direction of no pull along an axis of no stiffness stays zero: what length is missing comes below
                y[j, lane] = g[j, lane] / (gap[j, lane] + more[lane]) if g[j, lane] != 0.0 else 0.0
        _lengthen(y, gap, scalar[SPARE])
        _weigh(u, room, y, scalar[SPARE], scalar[HIGH])
        for lane in range(LANES):
            out[lane] = scalar[HIGH, lane] if todo[lane] != 0.0 else out[lane]


@compiled
def _begin(u: Array, room: Room, g: Array, gap: Array, total: Array, least: Array, more: Array) -> None:
    """Write g, gaps of the eigenvalues, the cost without ranges, the least eigenvalue, and the first multiplier.

    Multipliers are counted from minus the least eigenvalue: there nothing cancels. The first is as large as the longest
    part of the direction allows: the direction is not shorter than one, and Newton's steps come from that side.
    """
    q, d = len(u), len(g)
    for lane in range(LANES):
        total[lane], least[lane], more[lane] = room.scalar[LOOP, lane], np.inf, 0.0
    for j in range(d):
        for lane in range(LANES):
            least[lane] = min(least[lane], room.bend[j, lane])
            g[j, lane] = 0.0
    for k in range(q):
        for lane in range(LANES):
            total[lane] += u[k, lane] * u[k, lane]
        for j in range(d):
            for lane in range(LANES):
                g[j, lane] -= room.flat[k, j, lane] * u[k, lane]
    for j in range(d):
        for lane in range(LANES):
            gap[j, lane] = room.bend[j, lane] - least[lane]
            more[lane] = max(more[lane], abs(g[j, lane]) - gap[j, lane])


@compiled
def _step(
    scalar: Array, g: Array, gap: Array, total: Array, least: Array, more: Array, low: Array, todo: Array
) -> bool:
    """Write the lower bounds at the multipliers, and move those that could matter; return whether one moved."""
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
        # a direction that is too short even here lies between two of the same cost: the hard case, and the bound holds
        left = length > 1.0 + _UNIT and low[lane] <= scalar[FIX_COST, lane] + BEYOND_DOUBT
        # Newton's step for 1 / length = 1, which is all but straight
        more[lane] += square[lane] * (length - 1.0) / cube[lane] if left else 0.0
        moving += 1.0 if left else 0.0
    return moving > 0.0


@compiled
def _lengthen(y: Array, gap: Array, spare: Array) -> None:
    """Make directions unit vectors: too short ones by a part along the axis of the least eigenvalue."""
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
def _weigh(u: Array, room: Room, y: Array, left: Array, cost: Array) -> None:
    """Write the cost of remote emitters in directions y (d, W): from residuals, which cancel less than the bound."""
    for lane in range(LANES):
        cost[lane] = room.scalar[LOOP, lane]
    for k in range(len(u)):
        for lane in range(LANES):
            left[lane] = u[k, lane]
        for j in range(len(y)):
            for lane in range(LANES):
                left[lane] += room.flat[k, j, lane] * y[j, lane]
        for lane in range(LANES):
            cost[lane] += left[lane] * left[lane]
