"""Branch and bound around a fix: nothing costs less, and no other minimum costs nearly as little."""

from __future__ import annotations

from math import inf, isnan, sqrt

import numpy as np

from optloc.kernels.jit import compiled, inlined
from optloc.proof.boxes import cost_at
from optloc.proof.branch import CHEAPER, CLEAR, SPENT, Aim, branch
from optloc.proof.chart import Box, Chart, Cost, accuracy_floor, chart_at, is_convex
from optloc.proof.enclosure import enclose
from optloc.proof.grow import set_convex
from optloc.proof.stack import CAPACITY, DEPTH, push_around
from optloc.types import Array

# Verdicts of a proof.
UNIQUE, VALUE, BETTER, OTHER, BUDGET, OPEN, STATIONARY, SINGULAR = range(8)


@compiled
def prove(
    cost: Cost,
    box: Box,
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
    cost : Cost
        The cost; unknowns other than the position have been projected out.
    box : Box
        Tables to work with, see `optloc.proof.chart.empty_box`.
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
    chart, good = chart_at(cost, x, box)
    if not good:
        return SINGULAR, 0, -inf
    least, sums = cost_at(cost.K, cost.w, box.nodes), box.sums
    # On a box whose Hessian exceeds a margin the cost falls below that of its centre by slope^2 / margin at most.
    margin = (sums[6] * sums[6] + sums[7] * sums[7] + sums[8] * sums[8]) / eps
    level = least + kappa if kappa > 0.0 else least - eps
    corners = np.empty((2, 3))
    low, high = corners[0], corners[1]
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


@inlined
def _start(cost: Cost, chart: Chart, box: Box, rho: float, lower: Array, upper: Array, low: Array, high: Array) -> bool:
    """Write the corners of the box to search: the region, or an enclosure of all that costs less than rho^2."""
    if isnan(lower[0]):
        chosen = chart.origin, chart.sense, chart.back
        if not enclose(cost.kinds, cost.data, cost.A, cost.groups, box.nodes, box.curves, *chosen, rho, low, high):
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


@inlined
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
        if set_convex(cost, chart, box, hull, margin):
            minima[count], sides[count] = box.at, box.half
            count += 1
        elif p == 0:
            return minima, sides, 0
    return minima, sides, count
