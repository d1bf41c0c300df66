"""Damped Gauss-Newton refinement of many problems in lanes, with the rules of `optloc.kernels.least_squares`.

A lane is the place of one problem in a block. `room` is the workspace of the block. Names in capitals, such as X or
ALIVE, are rows of the arrays of `optloc.engine.memory.EngineWorkspace`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.linalg import PIVOT
from optloc.engine.admission import coarsen, evaluate, project_step, restore
from optloc.engine.memory import (
    ALIVE,
    BLUR,
    COST,
    COST_TRIAL,
    DAMPING,
    DIAGONAL,
    G_TRIAL,
    GAIN,
    GOOD,
    GROWTH,
    H_TRIAL,
    INVERSE,
    LOWER,
    MOVE,
    SOLVABLE,
    SPARE,
    STEPS,
    TRIAL,
    EngineModel,
    EngineWorkspace,
    G,
    H,
    X,
)
from optloc.kernels.damping import FIRST_DAMPING, FIRST_GROWTH, judge_lane
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES, factor_plain, solve_plain


@compiled
def refine(model: EngineModel, rows: Any, room: EngineWorkspace, tolerance: float, limit: int) -> None:
    """Refine the unknowns of the lanes that are good; lanes that do not converge within `limit` steps stay ALIVE.

    Parameters
    ----------
    model : EngineModel
        Contains the constraints of the position.
    rows : named tuple
        Rows of the evaluator.
    room : EngineWorkspace
        In: unknowns in row X, rounding error, and GOOD. Out: unknowns, right sides, information (lower half), costs,
        steps, ALIVE and GOOD.
    tolerance : float
        A fix has converged if its next step is shorter than this number of standard deviations.
    limit : int
        Greatest number of steps tried.

    Notes
    -----
    Levenberg's method with Marquardt's scaling; the damping follows H. B. Nielsen, "Damping parameter in Marquardt's
    method", IMM-REP-1999-05, Technical University of Denmark.
    """
    scalar = room.scalar
    evaluate(model, rows, room, 0)
    coarsen(model, room)
    for lane in range(LANES):
        # A start that is NaN or infinite is not good, and takes no step.
        scalar[GOOD, lane] = scalar[GOOD, lane] if scalar[COST, lane] < np.inf else 0.0
        scalar[ALIVE, lane] = scalar[GOOD, lane]
        scalar[DAMPING, lane], scalar[GROWTH, lane], scalar[STEPS, lane] = FIRST_DAMPING, FIRST_GROWTH, 0.0
    # All lanes step until none is ALIVE: further steps of a converged lane are discarded.
    for _ in range(limit):
        propose(model, room)
        evaluate(model, rows, room, 1)
        if not decide(room, tolerance):
            break


@compiled
def propose(model: EngineModel, room: EngineWorkspace) -> None:
    """Write the damped step to MOVE and its end to TRIAL.

    GAIN becomes the squared length of the step in standard deviations. SOLVABLE becomes 1.0 if the damped matrix is
    regular, else 0.0.
    """
    vector, matrix, scalar = room.vector, room.matrix, room.scalar
    d = vector.shape[1]
    diagonal, inverse, move, right, damping = (
        vector[DIAGONAL],
        vector[INVERSE],
        vector[MOVE],
        vector[G],
        scalar[DAMPING],
    )
    gain, solvable, information = scalar[GAIN], scalar[SOLVABLE], matrix[H]
    for lane in range(LANES):
        gain[lane], solvable[lane] = 0.0, 1.0
    for i in range(d):
        for lane in range(LANES):
            diagonal[i, lane] = information[i, i, lane] * (1.0 + damping[lane])
            move[i, lane] = right[i, lane]
    factor_plain(information, diagonal, matrix[LOWER], inverse)
    solve_plain(matrix[LOWER], inverse, move)
    project_step(model, room)
    x, trial = vector[X], vector[TRIAL]
    for i in range(d):
        for lane in range(LANES):
            gain[lane] += move[i, lane] * right[i, lane]
            trial[i, lane] = x[i, lane] + move[i, lane]
            # One over the share of its diagonal that a pivot keeps: at least one. It is infinite or negative without a
            # pivot.
            share = inverse[i, lane] * diagonal[i, lane]
            solvable[lane] = solvable[lane] if 0.0 < share < 1.0 / PIVOT else 0.0
    restore(model, room, 1)


@compiled
def decide(room: EngineWorkspace, tolerance: float) -> bool:
    """Keep steps that lower the cost, update the damping, end converged lanes; return whether any lane is ALIVE.

    SPARE becomes 1.0 for the lanes whose step was kept.
    """
    vector, matrix, scalar, face = room.vector, room.matrix, room.scalar, room.face
    d = vector.shape[1]
    # Converged lanes run through the same rule without effect: their step counts as unsolvable.
    kept, alive = scalar[SPARE], scalar[ALIVE]
    for lane in range(LANES):
        better, small, stuck, scalar[DAMPING, lane], scalar[GROWTH, lane] = judge_lane(
            scalar[COST, lane],
            scalar[COST_TRIAL, lane],
            scalar[GAIN, lane],
            alive[lane] * scalar[SOLVABLE, lane] != 0.0,
            scalar[BLUR, lane],
            scalar[DAMPING, lane],
            scalar[GROWTH, lane],
            tolerance,
            True,
        )
        scalar[COST, lane] = scalar[COST_TRIAL, lane] if better else scalar[COST, lane]
        scalar[STEPS, lane] += alive[lane]
        scalar[GOOD, lane] = 0.0 if stuck and alive[lane] != 0.0 else scalar[GOOD, lane]
        alive[lane] = 0.0 if small or stuck else alive[lane]
        kept[lane] = 1.0 if better else 0.0
    for i in range(d):
        for lane in range(LANES):
            # Selections instead of branches: all lanes run the same instructions, whether they keep their step or not.
            vector[X, i, lane] = vector[TRIAL, i, lane] if kept[lane] != 0.0 else vector[X, i, lane]
            vector[G, i, lane] = vector[G_TRIAL, i, lane] if kept[lane] != 0.0 else vector[G, i, lane]
        for j in range(i + 1):
            for lane in range(LANES):
                matrix[H, i, j, lane] = matrix[H_TRIAL, i, j, lane] if kept[lane] != 0.0 else matrix[H, i, j, lane]
    for k in range(len(room.push)):
        for j in range(room.d):
            for lane in range(LANES):
                face[0, k, j, lane] = face[1, k, j, lane] if kept[lane] != 0.0 else face[0, k, j, lane]
    left = 0.0
    for lane in range(LANES):
        left += alive[lane]
    return left > 0.0
