"""The cost at infinity: the least cost over all directions, on a sphere so wide that wave fronts are flat.

Names in capitals, such as X or BEYOND, are rows of the arrays of `optloc.engine.memory.EngineWorkspace`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.engine.admission import restore
from optloc.engine.candidates import look_around
from optloc.engine.images import keep_fix
from optloc.engine.memory import (
    BEYOND,
    COST,
    FIX,
    FIX_H,
    GOOD,
    RADIUS,
    SPREAD,
    EngineModel,
    EngineWorkspace,
    H,
    X,
)
from optloc.engine.refinement import refine
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES

# Radius of the sphere that represents infinity, in spreads of the stations. Wave fronts there bend by 5e-8 of the
# spread, and the rounding error of a difference of ranges is 1e-9 of the spread.
_INFINITE = 1e7
# Tolerance and steps of the refinement of directions: their costs are compared with gaps of several units.
_TOLERANCE, _STEPS = 1e-2, 12


@compiled
def search_sphere(model: EngineModel, rows: Any, room: EngineWorkspace, spot: Array) -> None:
    """Write the least cost at infinity to BEYOND; row X and its information do not change.

    The search refines the direction of the fix, and the cheapest direction of each sector. `spot` is scratch for
    candidates, see `optloc.engine.candidates.refine_candidates`.
    """
    scalar, vector, d = room.scalar, room.vector, room.d
    keep_fix(room)
    for lane in range(LANES):
        scalar[BEYOND, lane] = np.inf
        scalar[RADIUS, lane] = _INFINITE * scalar[SPREAD, lane]
    look_around(model, rows, room, spot, 1)
    # start -1 is the fix, from which the search leaves in its direction; the others are the candidates
    for k in range(-1, len(spot)):
        for lane in range(LANES):
            scalar[GOOD, lane] = 1.0 if k < 0 or spot[k, 0, lane] < np.inf else 0.0
            for j in range(vector.shape[1]):
                there = spot[k, j, lane] if k >= 0 and j < d else vector[FIX, j, lane]
                vector[X, j, lane] = there if scalar[GOOD, lane] != 0.0 else vector[FIX, j, lane]
        restore(model, room, 0)
        refine(model, rows, room, _TOLERANCE, _STEPS)
        for lane in range(LANES):
            scalar[BEYOND, lane] = min(scalar[BEYOND, lane], scalar[COST, lane])
    for lane in range(LANES):
        scalar[RADIUS, lane] = 0.0
    _bring_back(room)


@compiled
def _bring_back(room: EngineWorkspace) -> None:
    """Copy row FIX and its information to row X: the state before the search."""
    vector, matrix = room.vector, room.matrix
    for i in range(vector.shape[1]):
        for lane in range(LANES):
            vector[X, i, lane] = vector[FIX, i, lane]
        for j in range(i + 1):
            for lane in range(LANES):
                matrix[H, i, j, lane] = matrix[FIX_H, i, j, lane]
