"""The proof for all positions: an enclosure where there is one, else the atlas of all space."""

from __future__ import annotations

from math import inf

import numpy as np

from optloc.kernels.jit import compiled, inlined, zero
from optloc.proof.atlas import atlas_of, cube, first_minima, with_minima
from optloc.proof.boxes import cost_at
from optloc.proof.chart import Box, Cost, chart_at
from optloc.proof.far import reaches_infinity
from optloc.proof.far_search import ANOTHER, CHEAPER, CLEAR, INFINITE, search_everywhere
from optloc.proof.search import BETTER, BUDGET, OPEN, OTHER, SINGULAR, STATIONARY, UNIQUE, VALUE, prove
from optloc.proof.surroundings import set_minimum
from optloc.types import Array

# A verdict beside those of `optloc.proof.search`: the cost at infinity is within the gap.
UNBOUNDED = 8
# Boxes after which the search of an enclosure is given up for the atlas, which takes some hundred.
_SOON = 500
# Distance, relative to that of the fix, within which two minima are the same.
_CLOSE = 1e-3


@inlined
def prove_everywhere(
    cost: Cost, box: Box, x: Array, others: Array, kappa: float, eps: float, budget: int, found: Array
) -> tuple[int, int, float]:
    """Prove that no position costs less than a fix, and that no other minimum has a gap below kappa.

    The claim is for all positions, to infinity. Where something encloses the cheap ones, that is searched first; where
    nothing does, or the search does not end soon, and the cost stays finite at infinity, the atlas of all space: along
    inverse ranges a long valley is straight, and the cost convex on wider boxes.

    Parameters
    ----------
    cost, box, x, others, kappa, eps, budget, found
        As of `optloc.proof.search.prove`.

    Returns
    -------
    verdict : int
        As of `optloc.proof.search.prove`. UNBOUNDED: the cost at infinity is below that of the fix plus kappa.
    boxes : int
        How many boxes were looked at.
    bound : float
        A certified lower bound of f over all positions; -inf where there is none.
    """
    nowhere, open_end = np.full(x.shape[0], np.nan), reaches_infinity(cost.kinds, cost.K)
    first = min(budget, _SOON) if open_end else budget
    verdict, boxes, bound = prove(cost, box, x, others, kappa, eps, first, nowhere, nowhere, False, found)
    again = verdict in (OPEN, BUDGET, STATIONARY, SINGULAR) or (verdict == OTHER and _listed(x, others, found))
    if not open_end or not again or boxes >= budget:
        return verdict, boxes, bound
    verdict, more, bound = prove_atlas(cost, box, x, others, kappa, eps, budget - boxes, found)
    return verdict, boxes + more, bound


@compiled
def prove_atlas(
    cost: Cost, box: Box, x: Array, others: Array, kappa: float, eps: float, budget: int, found: Array
) -> tuple[int, int, float]:
    """Prove the same as `prove_everywhere`, with the atlas alone; `optloc.proof.far.reaches_infinity` must hold."""
    chart, _ = chart_at(cost, x, box)
    least = cost_at(cost.K, cost.w, box.nodes)
    middle, radius = cube(cost.kinds, cost.data)
    atlas = atlas_of(middle, radius, x.shape[0], 1 + (others.shape[0] if kappa > 0.0 else 0))
    known, place = zero(), np.empty(x.shape[0])
    for p in range(atlas.minima.home.shape[0]):
        place[:] = x if p == 0 else others[p - 1]
        if set_minimum(cost, box, atlas, known, place, eps):
            known += 1
        elif p == 0:
            return STATIONARY, 0, -inf
    atlas = with_minima(middle, radius, x.shape[0], first_minima(atlas.minima, known))
    level = least + kappa if kappa > 0.0 else least - eps
    outcome, boxes, bound = search_everywhere(cost, atlas, chart, level, least - eps, budget, found)
    if outcome == CLEAR:
        return UNIQUE if kappa > 0.0 else VALUE, boxes, bound
    if outcome == CHEAPER:
        return BETTER, boxes, bound
    if outcome == ANOTHER:
        return OTHER, boxes, bound
    return UNBOUNDED if outcome == INFINITE else BUDGET, boxes, min(bound, least - eps)


@compiled
def _listed(x: Array, others: Array, found: Array) -> bool:
    """Return whether a minimum that was found is one of the others: around it no box along the axes of x is convex."""
    for p in range(others.shape[0]):
        apart = away = 0.0
        for k in range(x.shape[0]):
            apart += (found[k] - others[p, k]) ** 2
            away += (x[k] - others[p, k]) ** 2
        if apart <= _CLOSE * _CLOSE * away:
            return True
    return False
