"""Whether the Gaussian of a fix covers: the cost three standard deviations away, against the square of the distance.

``kappa = max |ln((f(x +- 3 t_k) - f(x)) / 9)|`` over the principal axes t_k of the covariance, one standard deviation
long: zero where the cost is quadratic. It is asked in metres, and where the answer there is poor in the coordinates
``y = (p, w)`` of the chart ``x = c + (r / w)(u0 + B p)``, in which the range is inverse; see `optloc.problem.chart`.
"""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.compute.principal import principal_axes
from optloc.compute.range_refine import costs
from optloc.compute.range_room import (
    AXES,
    BASE,
    CENTRE,
    COST,
    COST_TRIAL,
    H_TRIAL,
    HIGH,
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
from optloc.compute.systems import LANES

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
