"""The proof for all positions: an enclosure where there is one, else a cube and everything outside it."""

from __future__ import annotations

from math import inf

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.chart import Box, Chart, Cost, chart_at, cost_of, empty_box, value_at
from optloc.proof.far import far_from, reaches_infinity
from optloc.proof.far_search import CHEAPER, CLEAR, INFINITE, LOW, search_far
from optloc.proof.nodes import RATIO
from optloc.proof.search import BETTER, BUDGET, OPEN, OTHER, SINGULAR, UNIQUE, VALUE, prove
from optloc.types import Array

# A verdict beside those of `optloc.proof.search`: the cost at infinity is within the gap.
UNBOUNDED = 8
# Half-width of the cube: reaches of the stations, and distances of the fix and of other minima from their middle.
_REACHES, _DISTANCES = 1.5, 1.5


@compiled
def prove_everywhere(
    kinds: Array,
    data: Array,
    K: Array,
    w: Array,
    x: Array,
    others: Array,
    kappa: float,
    eps: float,
    budget: int,
    found: Array,
) -> tuple[int, int, float]:
    """Prove that no position costs less than a fix, and that no other minimum has a gap below kappa.

    Parameters and results are those of `optloc.proof.search.prove` without a region; where that finds no enclosure, a
    cube around the stations and the fix is searched, and its outside in the inverse-range chart. One verdict more,
    UNBOUNDED: at infinity the cost is below that of the fix plus kappa.
    """
    nowhere = np.full(x.shape[0], np.nan)
    verdict, boxes, bound = prove(kinds, data, K, w, x, others, kappa, eps, budget, nowhere, nowhere, False, found)
    if verdict != OPEN or not reaches_infinity(kinds, K):
        return verdict, boxes, bound
    middle, radius = cube(kinds, data, x, others)
    verdict, more, bound = prove_far(kinds, data, K, w, x, others, kappa, eps, budget, middle, radius, found)
    boxes += more
    if verdict not in (UNIQUE, VALUE):
        return verdict, boxes, bound
    lower, upper = np.empty(x.shape[0]), np.empty(x.shape[0])
    for k in range(x.shape[0]):
        lower[k], upper[k] = middle[k] - radius, middle[k] + radius
    verdict, more, bound = prove(kinds, data, K, w, x, others, kappa, eps, budget, lower, upper, True, found)
    return verdict, boxes + more, bound


@compiled
def prove_far(
    kinds: Array,
    data: Array,
    K: Array,
    w: Array,
    x: Array,
    others: Array,
    kappa: float,
    eps: float,
    budget: int,
    middle: Array,
    radius: float,
    found: Array,
) -> tuple[int, int, float]:
    """Prove that no position outside a cube costs less than a fix, and no other minimum there less than kappa more.

    Parameters
    ----------
    kinds, data, K, w, x, others, kappa, eps, budget, found
        As of `optloc.proof.search.prove`; `optloc.proof.far.reaches_infinity` holds.
    middle : array (3,)
        Centre of the cube, metres.
    radius : float
        Half its side, metres; stations, fix and other minima lie inside.

    Returns
    -------
    verdict : int
        UNIQUE or VALUE (the outside is clear), BETTER, OTHER, BUDGET, SINGULAR or UNBOUNDED.
    boxes : int
        How many boxes were looked at.
    bound : float
        A certified lower bound of f outside.
    """
    cost, box = cost_of(kinds, data, K, w), empty_box(K.shape[0], K.shape[1])
    chart, good = chart_at(cost, x, box)
    if not good:
        return SINGULAR, 0, -inf
    minima = _in_chart(chart, others)
    level, value = _levels(cost, chart, box, kappa, eps)
    far = far_from(middle, radius, x.shape[0])
    outcome, boxes, bound = search_far(cost, far, box, chart, minima, level, value, budget, found)
    if outcome == CLEAR:
        return UNIQUE if kappa > 0.0 else VALUE, boxes, bound
    if outcome == CHEAPER:
        return BETTER, boxes, bound
    if outcome == LOW:
        return OTHER, boxes, bound
    return UNBOUNDED if outcome == INFINITE else BUDGET, boxes, bound


@compiled
def _levels(cost: Cost, chart: Chart, box: Box, kappa: float, eps: float) -> tuple[float, float]:
    """Return the cost to exceed, and the one below which a point refutes the fix."""
    box.half[:] = 0.0
    box.at[:] = 0.0
    least = value_at(cost, chart, box)
    return least + kappa if kappa > 0.0 else least - eps, least - eps


@compiled
def _in_chart(chart: Chart, others: Array) -> Array:
    """Return the fix and other minima (P, D) in search coordinates (1 + P, 3)."""
    minima = np.zeros((1 + others.shape[0], 3))
    for p in range(others.shape[0]):
        for k in range(3):
            for m in range(others.shape[1]):
                minima[1 + p, k] += chart.back[k, m] * (others[p, m] - chart.origin[m])
    return minima


@compiled
def cube(kinds: Array, data: Array, x: Array, others: Array) -> tuple[Array, float]:
    """Return centre (3,) and half-width of a cube that holds the stations, a fix (D,) and other minima (P, D) well.

    Parameters
    ----------
    kinds, data : array (J,), (J, WIDTH)
        Nodes that have stations.
    x, others : array
        Positions, metres.
    """
    low, high = np.full(3, inf), np.full(3, -inf)
    for j in range(kinds.shape[0]):
        for first in range(0, 6 if kinds[j] == RATIO else 3, 3):
            for k in range(3):
                low[k], high[k] = min(low[k], data[j, first + k]), max(high[k], data[j, first + k])
    reach = distance = 0.0
    middle = 0.5 * (low + high)
    for k in range(x.shape[0]):
        reach = max(reach, 0.5 * (high[k] - low[k]))
        distance = max(distance, abs(x[k] - middle[k]))
        for p in range(others.shape[0]):
            distance = max(distance, abs(others[p, k] - middle[k]))
    return middle, max(_REACHES * reach, _DISTANCES * distance, 1e-3)
