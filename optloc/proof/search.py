"""Branch and bound around a fix: nothing costs less, and no other minimum costs nearly as little."""

from __future__ import annotations

from math import inf, isnan, sqrt

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.branch import CHEAPER, CLEAR, SPENT, Aim, branch
from optloc.proof.chart import (
    Box,
    Chart,
    Cost,
    accuracy_floor,
    chart_at,
    cost_of,
    curve_box,
    empty_box,
    is_convex,
    value_at,
)
from optloc.proof.convex import convex
from optloc.proof.enclosure import enclose
from optloc.proof.grow import grow
from optloc.proof.stack import CAPACITY, DEPTH, push_around
from optloc.types import Array

# Verdicts of a proof.
UNIQUE, VALUE, BETTER, OTHER, BUDGET, OPEN, STATIONARY, SINGULAR = range(8)


@compiled
def prove(
    kinds: Array,
    data: Array,
    K: Array,
    w: Array,
    x: Array,
    others: Array,
    kappa: float,
    eps: float,
    budget: int,
    lower: Array,
    upper: Array,
    closed: bool,
    found: Array,
) -> tuple[int, int, float]:
    """Prove that a fix is the least point of ``f = |K phi(x) - w|^2``, and the only minimum below ``f(x) + kappa``.

    Parameters
    ----------
    kinds : int64 array (J,)
        Codes of the nodes (`optloc.proof.nodes`).
    data : array (J, WIDTH)
        Their numbers.
    K : array (q, J)
        Whitened rows; unknowns other than the position have been projected out.
    w : array (q,)
        Whitened measurements.
    x : array (D,)
        The fix, polished.
    others : array (P, D)
        Other minima that are known, polished; boxes around them where the cost is convex are set aside.
    kappa : float
        Gap to prove; 0 proves the value alone.
    eps : float
        How far below the cost of the fix still counts as equal, 1e-6 (1 + f) or so: covers rounding.
    budget : int
        How many boxes may be looked at.
    lower, upper : array (D,)
        Corners of the region to search, in the frame of x; NaN in lower[0] asks for an enclosure of all points that
        cost less than f(x) + kappa, which makes the claim a global one.
    closed : bool
        With a region: whether points outside it are dealt with elsewhere, so that a place where the gradient cannot
        vanish need not be bounded. False: the claim is for the region alone.
    found : array (D,)
        Written: the better or other point (verdicts BETTER and OTHER).

    Returns
    -------
    verdict : int
        UNIQUE: the value is proven, and no other minimum (beside `others`) has a gap below kappa. VALUE: kappa is 0 and
        the value is proven. BETTER: `found` costs less. OTHER: `found` is close to another minimum whose gap is below
        kappa. BUDGET: boxes are left. OPEN: there is no enclosure. STATIONARY: the fix is no strict minimum, or not
        polished enough. SINGULAR: the rows do not determine a position near the fix.
    boxes : int
        How many boxes were looked at.
    bound : float
        A certified lower bound of f over the region or over all positions; -inf where there is none.
    """
    cost, box = cost_of(kinds, data, K, w), empty_box(K.shape[0], K.shape[1])
    chart, good = chart_at(cost, x, box)
    if not good:
        return SINGULAR, 0, -inf
    box.half[:] = 0.0
    box.at[:] = 0.0
    least = value_at(cost, chart, box)
    curve_box(cost, chart, box)
    sums = box.sums
    margin = (sums[6] * sums[6] + sums[7] * sums[7] + sums[8] * sums[8]) / eps
    if not convex(kinds, cost.A, box.half, box.nodes, box.curves, sums, margin):
        return STATIONARY, 0, -inf
    level = least + kappa if kappa > 0.0 else least - eps
    low, high = np.empty(3), np.empty(3)
    if not _start(cost, chart, box, sqrt(least + kappa), lower, upper, low, high):
        return OPEN, 0, -inf
    minima, sides, known = _minima(cost, chart, box, others, low, high, margin)
    if known == 0:
        return STATIONARY, 0, -inf
    if kappa <= 0.0:
        known = 1
    aim = Aim(level, least - eps, least - 0.5 * eps, closed or isnan(lower[0]), accuracy_floor(cost, chart))
    stack = np.empty((CAPACITY, DEPTH))
    size = push_around(stack, low, high, sides[0])
    outcome, boxes, bound = branch(cost, chart, box, minima[:known], sides[:known], aim, budget, stack, size)
    if outcome == CLEAR:
        return UNIQUE if kappa > 0.0 else VALUE, boxes, least - eps
    if outcome == SPENT:
        return BUDGET, boxes, min(bound, least - eps)
    for k in range(x.shape[0]):
        found[k] = box.centre[k]
    return BETTER if outcome == CHEAPER else OTHER, boxes, 0.0


@compiled
def _start(cost: Cost, chart: Chart, box: Box, rho: float, lower: Array, upper: Array, low: Array, high: Array) -> bool:
    """Write the corners of the box to search: the region, or an enclosure of all that costs less than rho^2."""
    if isnan(lower[0]):
        if not enclose(
            cost.kinds,
            cost.data,
            cost.A,
            box.curves[:, 10].copy(),
            box.nodes[:, 0].copy(),
            chart.origin,
            chart.sense,
            chart.back,
            rho,
            low,
            high,
        ):
            return False
    else:
        for k in range(3):
            middle, reach = 0.0, 0.0
            for m in range(lower.shape[0]):
                middle += chart.back[k, m] * (0.5 * (lower[m] + upper[m]) - chart.origin[m])
                reach += abs(chart.back[k, m]) * 0.5 * (upper[m] - lower[m])
            low[k], high[k] = middle - reach, middle + reach
    widest = 0.0
    for k in range(3):
        slack = 1e-9 * (1.0 + abs(low[k]) + abs(high[k])) if high[k] > low[k] else 0.0
        low[k], high[k] = low[k] - slack, high[k] + slack
        widest = max(widest, abs(low[k]), abs(high[k]))
    return widest < 1e300


@compiled
def _minima(
    cost: Cost, chart: Chart, box: Box, others: Array, low: Array, high: Array, margin: float
) -> tuple[Array, Array, int]:
    """Return the known minima (1 + P, 3) in search coordinates, half-widths of convex boxes around them, their number.

    The fix comes first; the number is 0 where the cost is not convex around it. Points that are no minima are left out.
    """
    count = 0
    minima, sides, hull = np.zeros((1 + others.shape[0], 3)), np.zeros((1 + others.shape[0], 3)), np.empty(3)
    for p in range(1 + others.shape[0]):
        box.at[:] = 0.0
        if p > 0:
            for k in range(3):
                for m in range(others.shape[1]):
                    box.at[k] += chart.back[k, m] * (others[p - 1, m] - chart.origin[m])
            box.half[:] = 0.0
            if not is_convex(cost, chart, box, 0.0):
                continue
            sums = box.sums
            # Within a hundredth of a standard deviation of its minimum.
            margin = 100.0 * sqrt(sums[6] * sums[6] + sums[7] * sums[7] + sums[8] * sums[8])
        for k in range(3):
            hull[k] = max(high[k] - box.at[k], box.at[k] - low[k], 0.0)
        if grow(cost, chart, box, hull, margin, sides[count]):
            minima[count] = box.at
            count += 1
        elif p == 0:
            return minima, sides, 0
    return minima, sides, count
