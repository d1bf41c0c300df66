"""The shape of the likelihood about fixes from ranges: how far it is Gaussian, and what infinity costs."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.compute.range_refine import costs
from optloc.compute.range_start import (
    AXES,
    BASE,
    BEYOND,
    CENTRE,
    COST,
    COST_TRIAL,
    DIAGONAL,
    FIX_COST,
    H_TRIAL,
    HIGH,
    INVERSE,
    LOOP,
    LOW,
    MOVE,
    ROW,
    SHARE,
    SPARE,
    TRIAL,
    H,
    Model,
    Room,
    X,
)
from optloc.compute.systems import LANES, principal_axes

STRAIGHT = 0.3
"""Greatest kappa of a Gaussian that covers: the cost at three sigma lies between 6.67 and 12.15 instead of 9."""

# Where costs are compared, in standard deviations: far enough to see skewness, near enough to hold 99 %.
_REACH = 3.0
# Share of the quadratic cost below which a rise counts as none: its logarithm is 20, far beyond any threshold.
_NONE = 1e-9
# Share by which eigenvalues may differ and still be equal: the axes between them are then any axes.
_EQUAL = 0.05
# Least inverse range, in that of the fix: a step ends a million times as far away, where fronts are flat.
_HORIZON = 1e-6


@compiled
def measure_shape(model: Model, u: Array, room: Room, inverse: bool, turned: bool, out: Array) -> None:
    """Find kappa of fixes in row X, with their information and costs.

    Parameters
    ----------
    model : Model
        What all problems share.
    u : array (q, W)
        Whitened rows.
    room : Room
        H, COST and LOOP in; rows of scratch are overwritten.
    inverse : bool
        In inverse range about the mean of the stations that take part, instead of in metres.
    turned : bool
        Whether axes between equal eigenvalues are turned by 45 degrees as well.
    out : array (W,)
        Written: kappa; infinite at the centre of the chart.
    """
    vector, matrix, scalar = room.vector, room.matrix, room.scalar
    d = vector.shape[1]
    high, low, spare = scalar[HIGH], scalar[LOW], scalar[SPARE]
    if inverse:
        _span(vector, matrix, spare)
    _axes(matrix, inverse, spare)
    for lane in range(LANES):
        high[lane], low[lane] = 1.0, 1.0
    for k in range(d):
        for side in range(2):
            size = _REACH if side == 0 else -_REACH
            for i in range(d):
                for lane in range(LANES):
                    vector[MOVE, i, lane] = size * matrix[AXES, i, k, lane]
            _probe(model, u, room, inverse)
            _note(scalar, high, low)
    if turned:
        _turn(model, u, room, inverse)
    for lane in range(LANES):
        out[lane] = np.log(max(high[lane], 1.0 / max(low[lane], _NONE)))


@compiled
def find_even(matrix: Array, out: Array) -> None:
    """Write 1.0 where two eigenvalues, on the diagonal of H_TRIAL, are equal within the share that counts, else 0.0."""
    d = matrix.shape[1]
    for lane in range(LANES):
        out[lane] = 0.0
    for i in range(1, d):
        for j in range(i):
            for lane in range(LANES):
                out[lane] = max(out[lane], _even(matrix, i, j, lane))


@compiled
def _even(matrix: Array, i: int, j: int, lane: int) -> float:
    first, second = matrix[H_TRIAL, i, i, lane], matrix[H_TRIAL, j, j, lane]
    return 1.0 if abs(first - second) <= _EQUAL * max(first, second) else 0.0


@compiled
def _turn(model: Model, u: Array, room: Room, inverse: bool) -> None:
    """Go along the diagonals between axes of equal eigenvalues, and note them where they are equal."""
    vector, matrix, scalar = room.vector, room.matrix, room.scalar
    d, share = vector.shape[1], scalar[SHARE]
    even = room.vector[ROW, 0]
    for j in range(1, d):
        for k in range(j):
            found = 0.0
            for lane in range(LANES):
                even[lane] = _even(matrix, j, k, lane)
                found += even[lane]
            if found == 0.0:
                continue
            for side in range(4):
                first = (_REACH if side < 2 else -_REACH) * np.sqrt(0.5)
                second = first if side in (0, 3) else -first
                for i in range(d):
                    for lane in range(LANES):
                        along = first * matrix[AXES, i, j, lane]
                        vector[MOVE, i, lane] = along + second * matrix[AXES, i, k, lane]
                _probe(model, u, room, inverse)
                for lane in range(LANES):
                    # a quadratic rise stands for what is not asked
                    rise = scalar[COST, lane] + 1.0 / share[lane]
                    scalar[COST_TRIAL, lane] = scalar[COST_TRIAL, lane] if even[lane] != 0.0 else rise
                _note(scalar, scalar[HIGH], scalar[LOW])


@compiled
def _span(vector: Array, matrix: Array, r: Array) -> None:
    """Write the derivatives of positions by (p, w) at the fix, ``[r B, -r u0]``, to the columns of BASE.

    B as in T. Duff et al., "Building an orthonormal basis, revisited", J. Computer Graphics Techniques 6 (2017).
    """
    d, base = vector.shape[1], matrix[BASE]
    for lane in range(LANES):
        r[lane] = 0.0
    for i in range(d):
        for lane in range(LANES):
            base[i, d - 1, lane] = vector[CENTRE, i, lane] - vector[X, i, lane]
            r[lane] += base[i, d - 1, lane] * base[i, d - 1, lane]
    for lane in range(LANES):
        r[lane] = np.sqrt(r[lane])
        if d == 2:
            base[0, 0, lane], base[1, 0, lane] = base[1, 1, lane], -base[0, 1, lane]
        else:
            x, y, z = -base[0, 2, lane] / r[lane], -base[1, 2, lane] / r[lane], -base[2, 2, lane] / r[lane]
            sign = 1.0 if z >= 0.0 else -1.0
            a = -1.0 / (sign + z)
            base[0, 0, lane] = r[lane] * (1.0 + sign * a * x * x)
            base[1, 0, lane] = r[lane] * sign * a * x * y
            base[2, 0, lane] = -r[lane] * sign * x
            base[0, 1, lane] = r[lane] * a * x * y
            base[1, 1, lane] = r[lane] * (sign + a * y * y)
            base[2, 1, lane] = -r[lane] * y


@compiled
def _axes(matrix: Array, inverse: bool, spare: Array) -> None:
    """Write the principal axes of H, or of it in the chart, one standard deviation long, to the columns of AXES."""
    d = matrix.shape[1]
    work, axes = matrix[H_TRIAL], matrix[AXES]
    for i in range(d):
        for j in range(i + 1):
            for lane in range(LANES):
                work[i, j, lane] = 0.0 if inverse else matrix[H, i, j, lane]
    if inverse:
        for k in range(d):
            for i in range(d):
                for lane in range(LANES):
                    spare[lane] = 0.0
                for m in range(d):
                    row, column = max(k, m), min(k, m)
                    for lane in range(LANES):
                        spare[lane] += matrix[H, row, column, lane] * matrix[BASE, m, i, lane]
                for j in range(i + 1):
                    for lane in range(LANES):
                        work[i, j, lane] += matrix[BASE, k, j, lane] * spare[lane]
    principal_axes(work, axes, spare)
    for k in range(d):
        for lane in range(LANES):
            spare[lane] = 1.0 / np.sqrt(work[k, k, lane])
        for i in range(d):
            for lane in range(LANES):
                axes[i, k, lane] *= spare[lane]


@compiled
def _probe(model: Model, u: Array, room: Room, inverse: bool) -> None:
    """Find the cost a step MOVE away, and one over the rise of a quadratic one; a step past the horizon ends there."""
    vector, scalar = room.vector, room.scalar
    d, move, trial, share, w = vector.shape[1], vector[MOVE], vector[TRIAL], scalar[SHARE], scalar[SPARE]
    if inverse:
        for lane in range(LANES):
            down = move[d - 1, lane]
            cut = (_HORIZON - 1.0) / down if 1.0 + down < _HORIZON else 1.0
            share[lane] = 1.0 / (_REACH * _REACH * cut * cut)
            w[lane] = 1.0 / (1.0 + cut * down)
            for j in range(d - 1):
                move[j, lane] *= cut
        for i in range(d):
            for lane in range(LANES):
                trial[i, lane] = -room.matrix[BASE, i, d - 1, lane]
            for j in range(d - 1):
                for lane in range(LANES):
                    trial[i, lane] += room.matrix[BASE, i, j, lane] * move[j, lane]
            for lane in range(LANES):
                trial[i, lane] = vector[CENTRE, i, lane] + w[lane] * trial[i, lane]
    else:
        for lane in range(LANES):
            share[lane] = 1.0 / (_REACH * _REACH)
        for i in range(d):
            for lane in range(LANES):
                trial[i, lane] = vector[X, i, lane] + move[i, lane]
    costs(model.K, u, room.place, trial, room.r, scalar[SPARE], scalar[LOOP], scalar[COST_TRIAL])


@compiled
def _note(scalar: Array, high: Array, low: Array) -> None:
    """Keep the greatest and the least rise of the cost, relative to that of a quadratic one."""
    for lane in range(LANES):
        rise = (scalar[COST_TRIAL, lane] - scalar[COST, lane]) * scalar[SHARE, lane]
        # what is no number is far from quadratic, and comparisons with it fail
        number, lower = rise < np.inf, rise < low[lane]
        rise = rise if number else np.inf
        high[lane] = max(high[lane], rise)
        low[lane] = rise if lower else low[lane]


# What infinity costs.

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
