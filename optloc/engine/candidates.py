"""Candidates for starts if squared ranges have too few rows, for example the cheapest of many positions.

A few candidates are refined, and the cheapest two at different minima are used. The second one replaces the mirror
image of the fix. `spot` contains the candidates of a block of W problems: d coordinates and the cost of each.

`room` is the workspace of the block. Names in capitals, such as X or FIX, are rows of the arrays of
`optloc.engine.memory.EngineWorkspace`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.engine.admission import check_constraints, restore
from optloc.engine.evaluator import complete, costs
from optloc.engine.images import LISTED, NEAR
from optloc.engine.memory import (
    ALIVE,
    CENTRE,
    COST,
    COST_TRIAL,
    FIX,
    FIX_COST,
    FIX_H,
    GOOD,
    HIGH,
    OTHER,
    SECOND,
    SPREAD,
    TRIAL,
    EngineModel,
    EngineWorkspace,
    H,
    X,
)
from optloc.engine.refinement import refine
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES

CANDIDATES = 4
"""Number of candidates of a fix: roots of a quartic, or sectors of positions."""

# Tolerance and steps of the refinement of candidates. A hundredth of a standard deviation separates minima. A candidate
# that has not converged after these steps diverges to infinity.
_TOLERANCE, _STEPS = 1e-2, 40


@compiled
def refine_candidates(model: EngineModel, rows: Any, room: EngineWorkspace, spot: Array) -> None:
    """Refine candidates; write the best one to row X, and another minimum, if there is one, to row OTHER.

    Parameters
    ----------
    model : EngineModel
        Maps from measurements to a start.
    rows : named tuple
        Rows of the evaluator.
    room : EngineWorkspace
        Workspace of the block; lanes without an admitted candidate become not good.
    spot : array (CANDIDATES, d + 1, W)
        In: candidates relative to the origin, metres; the first coordinate is NaN if the candidate is absent. Out: the
        refined candidates, and after the coordinates their costs; infinite if the candidate is not valid.
    """
    vector, scalar, d = room.vector, room.scalar, room.d
    for lane in range(LANES):
        scalar[HIGH, lane], scalar[FIX_COST, lane] = scalar[GOOD, lane], np.inf
    for k in range(CANDIDATES):
        for lane in range(LANES):
            there = spot[k, 0, lane] < np.inf
            scalar[GOOD, lane] = scalar[HIGH, lane] if there else 0.0
            for j in range(d):
                vector[X, j, lane] = spot[k, j, lane] if there else vector[CENTRE, j, lane]
        restore(model, room, 0)
        complete(rows, room)
        refine(model, rows, room, _TOLERANCE, _STEPS)
        for lane in range(LANES):
            scalar[GOOD, lane] *= 1.0 - scalar[ALIVE, lane]
        check_constraints(model, room, scalar[GOOD])
        _keep(room, spot[k])
    _choose(model, room, spot)


@compiled
def _keep(room: EngineWorkspace, spot: Array) -> None:
    """Write row X, a refined candidate, and its cost to `spot` (d + 1, W), and store the best candidate so far in FIX.

    The cost is infinite for lanes that are not good.
    """
    vector, scalar, d = room.vector, room.scalar, room.d
    for lane in range(LANES):
        good = scalar[GOOD, lane] != 0.0
        spot[d, lane] = scalar[COST, lane] if good else np.inf
        better = spot[d, lane] < scalar[FIX_COST, lane]
        for j in range(d):
            spot[j, lane] = vector[X, j, lane]
        if better:
            scalar[FIX_COST, lane] = scalar[COST, lane]
            for i in range(vector.shape[1]):
                vector[FIX, i, lane] = vector[X, i, lane]
                for j in range(i + 1):
                    room.matrix[FIX_H, i, j, lane] = room.matrix[H, i, j, lane]


@compiled
def _choose(model: EngineModel, room: EngineWorkspace, spot: Array) -> None:
    """Write the best candidate to row X, and the cheapest candidate at another minimum to row OTHER.

    SECOND becomes 1.0 if this other candidate is a rival of the best one. GOOD becomes 0.0 for three reasons: no
    candidate is admitted, a third minimum is a rival too, or the best candidate fits poorly. In the last case a
    position between the candidates may be a better minimum.
    """
    vector, scalar, d = room.vector, room.scalar, room.d
    for lane in range(LANES):
        least = scalar[FIX_COST, lane] + LISTED
        found = least < np.inf and scalar[FIX_COST, lane] <= model.limit
        scalar[GOOD, lane], scalar[SECOND, lane] = 1.0 if found else 0.0, 0.0
        if not found:
            continue
        for i in range(vector.shape[1]):
            vector[X, i, lane] = vector[FIX, i, lane]
        for k in range(CANDIDATES):
            if spot[k, d, lane] <= least and _is_apart(room, spot[k], FIX, lane):
                least, scalar[SECOND, lane] = spot[k, d, lane], 1.0
                for j in range(d):
                    vector[OTHER, j, lane] = spot[k, j, lane]
        for k in range(CANDIDATES):
            rivals = spot[k, d, lane] <= scalar[FIX_COST, lane] + LISTED and scalar[SECOND, lane] != 0.0
            if rivals and _is_apart(room, spot[k], FIX, lane) and _is_apart(room, spot[k], OTHER, lane):
                scalar[GOOD, lane] = 0.0


@compiled
def _is_apart(room: EngineWorkspace, spot: Array, row: int, lane: int) -> bool:
    """Return whether a candidate is more than three standard deviations from a row of `room.vector`, in one lane.

    `row` is FIX or OTHER. FIX gives the standard deviations.
    """
    apart = 0.0
    for i in range(room.d):
        for j in range(room.d):
            across = room.matrix[FIX_H, max(i, j), min(i, j), lane]
            first, second = spot[i, lane] - room.vector[row, i, lane], spot[j, lane] - room.vector[row, j, lane]
            apart += across * first * second
    return bool(apart > NEAR)


# The cheapest of many positions.

# Distances of positions in spreads of the stations: from between the stations to where wave fronts are nearly flat.
_RADII = (0.4, 1.0, 2.5, 8.0)
RINGS = len(_RADII)
"""Number of rings of positions."""


@compiled
def look_around(model: EngineModel, rows: Any, room: EngineWorkspace, spot: Array, rings: int) -> None:
    """Write the cheapest position of each sector about the stations, and its cost, to `spot`, see `refine_candidates`.

    `rings` is the number of distances that are tried, from the nearest. Each position is first projected onto the exact
    surfaces. If no position of a sector has a finite cost, its coordinates are NaN and its cost is infinite.
    """
    vector, scalar, d = room.vector, room.scalar, room.d
    each = len(model.ahead) // CANDIDATES
    for k in range(CANDIDATES):
        for lane in range(LANES):
            spot[k, d, lane] = np.inf
            for j in range(d):
                spot[k, j, lane] = np.nan
        for i in range(each * rings):
            for lane in range(LANES):
                for j in range(d):
                    step = scalar[SPREAD, lane] * _RADII[i // each] * model.ahead[k * each + i % each, j]
                    vector[TRIAL, j, lane] = vector[CENTRE, j, lane] + step
                for j in range(d, vector.shape[1]):
                    vector[TRIAL, j, lane] = vector[X, j, lane]
            restore(model, room, 1)
            costs(rows, room)
            for lane in range(LANES):
                if scalar[COST_TRIAL, lane] < spot[k, d, lane]:
                    spot[k, d, lane] = scalar[COST_TRIAL, lane]
                    for j in range(d):
                        spot[k, j, lane] = vector[TRIAL, j, lane]


# Number of directions in a sector, by dimension.
_FAN = {2: 4, 3: 12}


def directions(d: int) -> Array:
    """Return unit vectors (n, d), sorted by sector and spread as evenly as possible, for d = 2 or 3 coordinates."""
    count = CANDIDATES * _FAN[d]
    number = np.arange(count) + 0.5
    if d == 2:
        turn = 2.0 * np.pi * number / count
        return np.stack([np.cos(turn), np.sin(turn)], axis=1)
    # a spiral with equal steps of height and of the golden angle
    up, turn = 1.0 - 2.0 * number / count, number * np.pi * (3.0 - np.sqrt(5.0))
    level = np.sqrt(1.0 - up * up)
    ahead = np.stack([level * np.cos(turn), level * np.sin(turn), up], axis=1)
    return np.asarray(ahead[np.argsort(np.arctan2(ahead[:, 1], ahead[:, 0]), kind="stable")])
