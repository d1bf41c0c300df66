"""The refined mirror image of a fix in the best plane of the stations: the second minimum of flat networks.

A block has W problems, one in each lane. A refinement ends early if it cannot lead to a rival of the fix, see
`stop_hopeless`. ALIVE is 1.0 for lanes whose refinement continues; GOOD is 1.0 for lanes that may reach a rival.

`room` is the workspace of the block. Names in capitals, such as X or GOOD, are rows of the arrays of
`optloc.engine.memory.EngineWorkspace`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.engine.admission import check_constraints, coarsen, evaluate, project_step, restore
from optloc.engine.evaluator import bend, bow_of, note_nearest
from optloc.engine.memory import (
    ALIVE,
    AXES,
    CENTRE,
    COST,
    DAMPING,
    DIAGONAL,
    EIGEN,
    FIX,
    FIX_COST,
    FIX_H,
    GAIN,
    GOOD,
    GROWTH,
    H_TRIAL,
    HEIGHT,
    INVERSE,
    LOW,
    LOWER,
    MOVE,
    NORMAL,
    OTHER,
    SECOND,
    SHARE,
    SPARE,
    STEPS,
    EngineModel,
    EngineWorkspace,
    G,
    H,
    X,
)
from optloc.engine.refinement import decide, propose
from optloc.kernels.damping import FIRST_DAMPING, FIRST_GROWTH
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES, factor_plain, principal_axes, solve_plain

LISTED = 25.0
"""Greatest cost of a rival above the cost of the fix (`optloc.solvers.policy.LISTED_GAP`)."""
SAME = 1e-2
"""Squared distance in standard deviations below which two minima are the same (`optloc.solvers.policy.SAME_PLACE`)."""

# Radius of the ball about the image that is searched for a rival, as a share of the fix's height above the plane. With
# a fifth, none of 1 760 rivals in flat networks was lost (heights of 30, 100 and 300 m, range differences and ranges).
_BALL = 0.2
# Greatest damping at which the minimum of the linear prediction is used. A damped, short step predicts too little about
# rivals farther away, some of which are behind a ridge.
_FREE = 1e-5
# Greatest number of steps of a mirror image: in flat networks half of the rivals are reached in seven steps, nine of
# ten in fifteen, the last in fifty.
_MOST = 60
# A point belongs to the fix under two conditions: its squared distance is below NEAR (squared standard deviations),
# and its cost has risen by at least the share RISEN of the quadratic rise. Another minimum would be cheaper.
NEAR, RISEN = 9.0, 0.5
# Squared length of the undamped step, in standard deviations, below which a refinement has converged: 0.01 squared.
_ARRIVED = 1e-4
# Share of its diagonal that a pivot must keep: below it the curvature is rounding.
_WEAK = 1e-11


@compiled
def find_plane(room: EngineWorkspace) -> None:
    """Write the unit vector in whose direction the stations spread least to row NORMAL."""
    s, d = room.place.shape[:2]
    normal, least, spare = room.vector[NORMAL], room.scalar[LOW], room.scalar[SPARE]
    work, axes = room.axes[EIGEN], room.axes[AXES]
    for i in range(d):
        for j in range(i + 1):
            for lane in range(LANES):
                work[i, j, lane] = 0.0
            for k in range(s):
                for lane in range(LANES):
                    first = room.place[k, i, lane] - room.vector[CENTRE, i, lane]
                    work[i, j, lane] += first * (room.place[k, j, lane] - room.vector[CENTRE, j, lane])
    principal_axes(work, axes, spare)
    for lane in range(LANES):
        least[lane] = np.inf
    for k in range(d):
        for lane in range(LANES):
            spare[lane] = 1.0 if work[k, k, lane] < least[lane] else 0.0
            least[lane] = min(least[lane], work[k, k, lane])
        for i in range(d):
            for lane in range(LANES):
                normal[i, lane] = axes[i, k, lane] if spare[lane] != 0.0 else normal[i, lane]


@compiled
def keep_fix(room: EngineWorkspace) -> None:
    """Store position and information of the fix in FIX and FIX_H, and its height above the stations' plane."""
    vector, matrix, scalar = room.vector, room.matrix, room.scalar
    for lane in range(LANES):
        scalar[HEIGHT, lane] = 0.0
    for i in range(room.d):
        for lane in range(LANES):
            scalar[HEIGHT, lane] += (vector[X, i, lane] - vector[CENTRE, i, lane]) * vector[NORMAL, i, lane]
    for i in range(vector.shape[1]):
        for lane in range(LANES):
            vector[FIX, i, lane] = vector[X, i, lane]
        for j in range(i + 1):
            for lane in range(LANES):
                matrix[FIX_H, i, j, lane] = matrix[H, i, j, lane]


@compiled
def reflect(model: EngineModel, room: EngineWorkspace) -> None:
    """Set row X to the point from which a second minimum is searched, and reset the refinement.

    If SECOND is 1.0, the point is OTHER: the squared ranges or the candidates gave a second start, which the fix did
    not use. Otherwise the point is the mirror image of the fix in the plane of the stations. Lanes whose GOOD is 0.0
    are not refined. At the end, the exact constraints are restored at row X (the argument 0 selects X, not TRIAL).
    """
    vector, scalar, d = room.vector, room.scalar, room.d
    for i in range(vector.shape[1]):
        # unknowns after the first d (the position) keep the values of the fix: their entries of NORMAL are zero
        for lane in range(LANES):
            image = vector[FIX, i, lane] - 2.0 * scalar[HEIGHT, lane] * vector[NORMAL, i, lane]
            vector[X, i, lane] = vector[OTHER, i, lane] if i < d and scalar[SECOND, lane] != 0.0 else image
    for lane in range(LANES):
        scalar[DAMPING, lane], scalar[GROWTH, lane], scalar[STEPS, lane] = FIRST_DAMPING, FIRST_GROWTH, 0.0
        scalar[ALIVE, lane] = scalar[GOOD, lane]
    restore(model, room, 0)


@compiled
def refine_images(
    model: EngineModel, rows: Any, room: EngineWorkspace, tolerance: float, fewest: int, every: bool
) -> None:
    """Refine the mirror images in row X, until fewer than `fewest` lanes are active.

    The result decides whether the fix has a rival. The caller collects the lanes that remain active and continues them
    in a full block.

    Parameters
    ----------
    model : EngineModel
        Contains the constraints of the position.
    rows : named tuple
        Rows of the evaluator.
    room : EngineWorkspace
        In: unknowns in row X, damping, steps, and the results of `keep_fix`. Out: lanes that converged have GOOD = 1
        and ALIVE = 0; lanes that were abandoned have GOOD = 0 and ALIVE = 0; the others have ALIVE = 1.
    tolerance : float
        Tolerance of `optloc.engine.refinement.refine`: length of the last step in standard deviations.
    fewest : int
        Least number of active lanes to continue.
    every : bool
        Whether to refine also images whose bound excludes a rival, see `stop_hopeless`.
    """
    nearest = room.scalar[SHARE]
    evaluate(model, rows, room, 0)
    coarsen(model, room)
    _note_nearest(rows, room, nearest, True)
    bow = bow_of(rows, room)
    while True:
        propose(model, room)
        if stop_hopeless(bow, room, nearest, every) < fewest:
            return
        evaluate(model, rows, room, 1)
        going = decide(room, tolerance)
        _note_nearest(rows, room, nearest, False)
        if not going:
            return


@compiled
def _note_nearest(rows: Any, room: EngineWorkspace, nearest: Array, every: bool) -> None:
    """Write the range (W,) to the nearest station, metres, to `nearest`.

    Only lanes whose last step was kept are written, or every lane if `every` is True.
    """
    kept, least = room.scalar[SPARE], room.scalar[LOW]
    note_nearest(rows, room, least)
    for lane in range(LANES):
        nearest[lane] = least[lane] if every or kept[lane] != 0.0 else nearest[lane]


@compiled
def stop_hopeless(bow: float, room: EngineWorkspace, nearest: Array, every: bool) -> float:
    """Abandon refinements that cannot lead to a rival, and return the number of active lanes.

    A refinement ends for one of three reasons. First: no position in a ball about it has a cost as low as a rival's.
    The radius D is `_BALL` times the height of the fix above the plane. After a step of length D, the residuals differ
    from their linear prediction by at most ``bow D^2 / r``. Here r is the range to the nearest station.
    Second: the refinement has returned to the fix. Then it is within three standard deviations, and the cost has risen
    as the curvature at the fix predicts. Third: it has taken `_MOST` steps.

    Parameters
    ----------
    bow : float
        Result of `optloc.engine.evaluator.bow_of`, 1/metres.
    room : EngineWorkspace
        Proposed steps, and the results of `keep_fix`; ALIVE and GOOD are written.
    nearest : array (W,)
        Ranges to the nearest stations, metres.
    every : bool
        Whether to ignore the first reason: if a fix has two starts, its rivals are farther away.
    """
    vector, matrix, scalar = room.vector, room.matrix, room.scalar
    d, spare, trace = vector.shape[1], scalar[SPARE], scalar[LOW]
    for lane in range(LANES):
        trace[lane], spare[lane] = 0.0, 0.0
    for i in range(d):
        for lane in range(LANES):
            trace[lane] += matrix[H, i, i, lane]
        for j in range(i + 1):
            twice = 1.0 if i == j else 2.0
            for lane in range(LANES):
                first = vector[X, i, lane] - vector[FIX, i, lane]
                second = vector[X, j, lane] - vector[FIX, j, lane]
                spare[lane] += twice * matrix[FIX_H, i, j, lane] * first * second
    alive = 0.0
    for lane in range(LANES):
        ball = _BALL * _BALL * scalar[HEIGHT, lane] * scalar[HEIGHT, lane]
        # lower bound of the linear prediction in the ball: COST - GAIN is the least sum of prediction and damping
        # term, and the damping term in the ball is at most the last term
        least = scalar[COST, lane] - scalar[GAIN, lane] - scalar[DAMPING, lane] * trace[lane] * ball
        far = np.sqrt(max(least, 0.0)) >= np.sqrt(scalar[FIX_COST, lane] + LISTED) + bow * ball / nearest[lane]
        near = spare[lane] < NEAR and scalar[COST, lane] - scalar[FIX_COST, lane] > RISEN * spare[lane]
        far = far and scalar[DAMPING, lane] <= _FREE and not every
        up = far or near or scalar[STEPS, lane] >= _MOST
        scalar[GOOD, lane] = 0.0 if up and scalar[ALIVE, lane] != 0.0 else scalar[GOOD, lane]
        scalar[ALIVE, lane] = 0.0 if up else scalar[ALIVE, lane]
        alive += scalar[ALIVE, lane]
    return alive


@compiled
def confirm_rivals(model: EngineModel, rows: Any, room: EngineWorkspace) -> float:
    """Clear GOOD for lanes that did not reach a rival, and return the number of lanes that did.

    The end of a damped refinement need not be a minimum. Therefore the undamped step must be short, and the curvature
    of the cost must be positive, including the second derivatives of the ranges.
    """
    vector, matrix, scalar, spare = room.vector, room.matrix, room.scalar, room.scalar[SPARE]
    d, found = vector.shape[1], 0.0
    for lane in range(LANES):
        cheap = scalar[COST, lane] <= scalar[FIX_COST, lane] + LISTED
        scalar[GOOD, lane] = scalar[GOOD, lane] if cheap and scalar[ALIVE, lane] == 0.0 else 0.0
        spare[lane] = 0.0
        found += scalar[GOOD, lane]
    if found == 0.0:
        return 0.0
    for i in range(d):
        for j in range(d):
            for lane in range(LANES):
                apart = (vector[X, i, lane] - vector[FIX, i, lane]) * (vector[X, j, lane] - vector[FIX, j, lane])
                spare[lane] += matrix[FIX_H, max(i, j), min(i, j), lane] * apart
    for lane in range(LANES):
        scalar[GOOD, lane] = scalar[GOOD, lane] if spare[lane] >= SAME else 0.0
    _require_rest(model, room)
    bend(rows, room)
    check_constraints(model, room, scalar[GOOD])
    _require_positive(vector, matrix, scalar[GOOD], matrix[H_TRIAL])
    found = 0.0
    for lane in range(LANES):
        found += scalar[GOOD, lane]
    return found


@compiled
def _require_rest(model: EngineModel, room: EngineWorkspace) -> None:
    """Clear GOOD for lanes whose undamped step from row X is 0.01 standard deviations or longer: X is no minimum."""
    vector, matrix, scalar = room.vector, room.matrix, room.scalar
    d, move, length = vector.shape[1], vector[MOVE], scalar[SPARE]
    _require_positive(vector, matrix, scalar[GOOD], matrix[H])
    for i in range(d):
        for lane in range(LANES):
            move[i, lane] = vector[G, i, lane]
    solve_plain(matrix[LOWER], vector[INVERSE], move)
    project_step(model, room)
    for lane in range(LANES):
        length[lane] = 0.0
    for i in range(d):
        for lane in range(LANES):
            length[lane] += move[i, lane] * vector[G, i, lane]
    for lane in range(LANES):
        scalar[GOOD, lane] = scalar[GOOD, lane] if length[lane] < _ARRIVED else 0.0


@compiled
def _require_positive(vector: Array, matrix: Array, good: Array, curvature: Array) -> None:
    """Clear GOOD for lanes whose `curvature` (p, p, W) is not positive definite.

    The Cholesky factor is written to LOWER, one over its pivots to INVERSE.
    """
    d, diagonal, inverse = vector.shape[1], vector[DIAGONAL], vector[INVERSE]
    for i in range(d):
        for lane in range(LANES):
            diagonal[i, lane] = curvature[i, i, lane]
    factor_plain(curvature, diagonal, matrix[LOWER], inverse)
    for i in range(d):
        for lane in range(LANES):
            good[lane] = good[lane] if 0.0 < inverse[i, lane] * diagonal[i, lane] < 1.0 / _WEAK else 0.0
