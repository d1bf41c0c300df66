"""The shape of the likelihood around a fix: its difference from a Gaussian.

`kappa` is the greatest absolute logarithm of the cost rise at three sigma over the quadratic rise, in all probed
directions. It is 0 for a Gaussian. It is measured in metres, and in inverse range about the mean of the stations. The
*rise* of the cost is its value at a probe less its value at the fix.

A block has W problems, one in each lane. `room` is the workspace of the block. Names in capitals, such as X or MOVE,
are rows of the arrays of `optloc.engine.memory.EngineWorkspace`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.engine.admission import restore
from optloc.engine.evaluator import costs
from optloc.engine.memory import (
    AXES,
    BASE,
    CENTRE,
    COST,
    COST_TRIAL,
    DIAGONAL,
    EIGEN,
    H_TRIAL,
    HIGH,
    LOW,
    MARGIN,
    MOVE,
    ROW,
    SHARE,
    SPARE,
    TRIAL,
    EngineModel,
    EngineWorkspace,
    G,
    H,
    X,
)
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES, eliminate_last, principal_axes

STRAIGHT = 0.3
"""Greatest kappa at which the covariance region is valid: the cost at three sigma is between 6.67 and 12.15, not 9."""

# Distance of the probes in standard deviations: far enough to show skewness, near enough to contain 99 %.
_REACH = 3.0
# Least rise as a share of the quadratic rise. Its logarithm is about -20, far beyond any threshold.
_NONE = 1e-9
# Relative difference up to which two eigenvalues count as equal; then the axes between them are arbitrary.
_EQUAL = 0.05
# Share of the largest variance below which a variance is rounding.
_EXACT = 1e-14
# Least inverse range relative to the fix: a probe ends at most a million times as far away, where wave fronts are flat.
_HORIZON = 1e-6


@compiled
def measure_shape(
    model: EngineModel, rows: Any, room: EngineWorkspace, inverse: bool, turned: bool, out: Array
) -> None:
    """Write kappa of the fixes in row X to `out`.

    Parameters
    ----------
    model : EngineModel
        Contains the constraints of the position.
    rows : named tuple
        Rows of the evaluator.
    room : EngineWorkspace
        Unknowns, information, covariance in H_TRIAL, and costs; scratch rows are overwritten.
    inverse : bool
        Whether to measure in inverse range about the mean of the stations, instead of in metres.
    turned : bool
        Whether to probe also along axes turned by 45 degrees between equal eigenvalues.
    out : array (W,)
        Written: kappa; infinite if the fix is at the centre of the coordinates.
    """
    vector, scalar, d = room.vector, room.scalar, room.d
    high, low, spare = scalar[HIGH], scalar[LOW], scalar[SPARE]
    if vector.shape[1] > d:
        _leave_position(room)
    if inverse:
        _span(vector, room.axes[BASE], spare)
    _axes(room, inverse, model.admission.exact > 0, spare)
    for lane in range(LANES):
        high[lane], low[lane] = 1.0, 1.0
    for k in range(d):
        for side in range(2):
            size = _REACH if side == 0 else -_REACH
            for i in range(d):
                for lane in range(LANES):
                    vector[MOVE, i, lane] = size * room.axes[AXES, i, k, lane]
            _probe(model, rows, room, inverse)
            if model.admission.exact:
                _spare_still(room, k)
            _note(scalar, high, low)
    if turned:
        _turn(model, rows, room, inverse)
    for lane in range(LANES):
        out[lane] = np.log(max(high[lane], 1.0 / max(low[lane], _NONE)))


@compiled
def _leave_position(room: EngineWorkspace) -> None:
    """Eliminate the other unknowns, and write the result to MARGIN.

    MARGIN then has the information about the position, and the coefficients with which the other unknowns follow it.
    """
    p, left, right = room.vector.shape[1], room.matrix[MARGIN], room.vector[MOVE]
    for i in range(p):
        for lane in range(LANES):
            right[i, lane] = room.vector[G, i, lane]
        for j in range(i + 1):
            for lane in range(LANES):
                left[i, j, lane] = room.matrix[H, i, j, lane]
    eliminate_last(left, right, room.scalar[SPARE], room.vector[DIAGONAL], room.d)


@compiled
def find_even(eigen: Array, out: Array) -> None:
    """Write 1.0 to `out` (W,) if two eigenvalues on a diagonal (d, d, W) are equal up to `_EQUAL`, else 0.0."""
    for lane in range(LANES):
        out[lane] = 0.0
    for i in range(1, len(eigen)):
        for j in range(i):
            for lane in range(LANES):
                out[lane] = max(out[lane], _even(eigen, i, j, lane))


@compiled
def _even(eigen: Array, i: int, j: int, lane: int) -> float:
    # Return 1.0 if two eigenvalues of a lane are equal up to `_EQUAL`, else 0.0.
    first, second = eigen[i, i, lane], eigen[j, j, lane]
    most = max(first, second)
    return 1.0 if abs(first - second) <= _EQUAL * most and most > 0.0 else 0.0


@compiled
def _turn(model: EngineModel, rows: Any, room: EngineWorkspace, inverse: bool) -> None:
    """Probe along the diagonals between two axes, and record the rises of the lanes with equal eigenvalues.

    With equal eigenvalues the axes are arbitrary, so that the axes alone may miss the direction of the greatest kappa.
    """
    vector, axes, scalar = room.vector, room.axes, room.scalar
    d, share = room.d, scalar[SHARE]
    even = room.vector[ROW, 0]
    for j in range(1, d):
        for k in range(j):
            found = 0.0
            for lane in range(LANES):
                even[lane] = _even(axes[EIGEN], j, k, lane)
                found += even[lane]
            if found == 0.0:
                continue
            for side in range(4):
                first = (_REACH if side < 2 else -_REACH) * np.sqrt(0.5)
                second = first if side in (0, 3) else -first
                for i in range(d):
                    for lane in range(LANES):
                        along = first * axes[AXES, i, j, lane]
                        vector[MOVE, i, lane] = along + second * axes[AXES, i, k, lane]
                _probe(model, rows, room, inverse)
                for lane in range(LANES):
                    # lanes with different eigenvalues get the quadratic rise, which changes nothing
                    rise = scalar[COST, lane] + 1.0 / share[lane]
                    scalar[COST_TRIAL, lane] = scalar[COST_TRIAL, lane] if even[lane] != 0.0 else rise
                _note(scalar, scalar[HIGH], scalar[LOW])


@compiled
def _span(vector: Array, base: Array, r: Array) -> None:
    """Write the derivatives of positions by (p, w) at the fix, ``[r B, -r u0]``, to the columns of `base` (d, d, W).

    `vector` contains the rows X and CENTRE. (p, w) are the coordinates in inverse range: direction and inverse range,
    relative to the fix. r and u0 are range and direction of the fix from the centre. B is from T. Duff et al.,
    "Building an orthonormal basis, revisited", J. Computer Graphics Techniques 6 (2017).
    """
    d = len(base)
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
def _axes(room: EngineWorkspace, inverse: bool, held: bool, spare: Array) -> None:
    """Write the principal axes of the position's information, each as long as one sigma, to AXES.

    If `inverse` is True, the information is expressed in inverse range. If `held` is True, exact surfaces constrain the
    fix, and the axes come from the covariance. `spare` (W,) is scratch.
    """
    d, base, work, axes = room.d, room.axes[BASE], room.axes[EIGEN], room.axes[AXES]
    source = room.matrix[H_TRIAL if held else MARGIN if room.vector.shape[1] > d else H]
    for i in range(d):
        for j in range(i + 1):
            for lane in range(LANES):
                work[i, j, lane] = 0.0 if inverse else source[i, j, lane]
    if inverse:
        for k in range(d):
            for i in range(d):
                for lane in range(LANES):
                    spare[lane] = 0.0
                for m in range(d):
                    row, column = max(k, m), min(k, m)
                    for lane in range(LANES):
                        spare[lane] += source[row, column, lane] * base[m, i, lane]
                for j in range(i + 1):
                    for lane in range(LANES):
                        work[i, j, lane] += base[k, j, lane] * spare[lane]
    principal_axes(work, axes, spare)
    if held:
        _drop_exact(work, spare)
    for k in range(d):
        for lane in range(LANES):
            spare[lane] = np.sqrt(work[k, k, lane]) if held else 1.0 / np.sqrt(work[k, k, lane])
        for i in range(d):
            for lane in range(LANES):
                axes[i, k, lane] *= spare[lane]


@compiled
def _drop_exact(variance: Array, most: Array) -> None:
    """Set variances on a diagonal (d, d, W) to zero if they are rounding relative to the largest, `most` (W,)."""
    d = len(variance)
    for lane in range(LANES):
        most[lane] = 0.0
    for k in range(d):
        for lane in range(LANES):
            most[lane] = max(most[lane], variance[k, k, lane])
    for k in range(d):
        for lane in range(LANES):
            exact = variance[k, k, lane] <= _EXACT * most[lane]
            variance[k, k, lane] = 0.0 if exact else variance[k, k, lane]


@compiled
def _probe(model: EngineModel, rows: Any, room: EngineWorkspace, inverse: bool) -> None:
    """Write the cost after a step MOVE from the fix to COST_TRIAL, and one over the quadratic rise there to SHARE.

    If `inverse` is True, MOVE is a step in inverse range (`_span` defines these coordinates); a step beyond `_HORIZON`
    is shortened.
    """
    vector, scalar, base = room.vector, room.scalar, room.axes[BASE]
    d, move, trial, share, w = room.d, vector[MOVE], vector[TRIAL], scalar[SHARE], scalar[SPARE]
    if inverse:
        for lane in range(LANES):
            down = move[d - 1, lane]
            cut = (_HORIZON - 1.0) / down if 1.0 + down < _HORIZON else 1.0
            share[lane] = 1.0 / (_REACH * _REACH * cut * cut)
            # the last component of the step is the change of the inverse range, relative to the fix
            w[lane] = 1.0 / (1.0 + cut * down)
            for j in range(d - 1):
                move[j, lane] *= cut
        for i in range(d):
            for lane in range(LANES):
                trial[i, lane] = -base[i, d - 1, lane]
            for j in range(d - 1):
                for lane in range(LANES):
                    trial[i, lane] += base[i, j, lane] * move[j, lane]
            for lane in range(LANES):
                trial[i, lane] = vector[CENTRE, i, lane] + w[lane] * trial[i, lane]
    else:
        for lane in range(LANES):
            share[lane] = 1.0 / (_REACH * _REACH)
        for i in range(d):
            for lane in range(LANES):
                trial[i, lane] = vector[X, i, lane] + move[i, lane]
    # the other unknowns follow the position linearly, so that they minimise the quadratic cost
    for k in range(d, vector.shape[1]):
        for lane in range(LANES):
            trial[k, lane] = vector[X, k, lane]
        for j in range(k):
            for lane in range(LANES):
                trial[k, lane] -= room.matrix[MARGIN, k, j, lane] * (trial[j, lane] - vector[X, j, lane])
    restore(model, room, 1)
    costs(rows, room)


@compiled
def _spare_still(room: EngineWorkspace, axis: int) -> None:
    """Set the rise of the cost to the quadratic rise along axes of length zero, where a surface fixes the position."""
    scalar = room.scalar
    for lane in range(LANES):
        if room.axes[EIGEN, axis, axis, lane] == 0.0:
            scalar[COST_TRIAL, lane] = scalar[COST, lane] + 1.0 / scalar[SHARE, lane]


@compiled
def _note(scalar: Array, high: Array, low: Array) -> None:
    """Update the greatest (`high`) and the least (`low`) rise of the cost (W,), over the rise of a quadratic cost.

    In `scalar`, COST_TRIAL is the cost at the probe, COST the cost of the fix, and SHARE one over the quadratic rise.
    """
    for lane in range(LANES):
        rise = (scalar[COST_TRIAL, lane] - scalar[COST, lane]) * scalar[SHARE, lane]
        # NaN means far from quadratic, and every comparison with NaN is false
        number, lower = rise < np.inf, rise < low[lane]
        rise = rise if number else np.inf
        high[lane] = max(high[lane], rise)
        low[lane] = rise if lower else low[lane]
