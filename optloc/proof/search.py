"""Branch and bound around a fix: nothing costs less, and no other minimum costs nearly as little."""

from __future__ import annotations

from math import inf, isnan, sqrt
from typing import NamedTuple

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.boxes import cost_at, cut_out, rounding, shrink
from optloc.proof.chart import (
    Box,
    Chart,
    Cost,
    accuracy_floor,
    bound_box,
    chart_at,
    cost_of,
    curve_box,
    empty_box,
    is_convex,
    value_at,
)
from optloc.proof.convex import clip_to_stationary, convex
from optloc.proof.descend import descend
from optloc.proof.enclosure import enclose
from optloc.proof.grow import grow
from optloc.proof.stack import CAPACITY, DEPTH, push, push_around, push_halves
from optloc.types import Array

# Verdicts of a proof.
UNIQUE, VALUE, BETTER, OTHER, BUDGET, OPEN, STATIONARY, SINGULAR = range(8)
_GOING = -1
# Share of a box below which what is left is looked at again before it is cut.
_SHRUNK = 0.5


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
    verdict, boxes, bound = _search(cost, chart, box, minima[:known], sides[:known], aim, budget, stack, size)
    if verdict in (BETTER, OTHER):
        for k in range(x.shape[0]):
            found[k] = box.centre[k]
    if verdict == _GOING:
        return UNIQUE if kappa > 0.0 else VALUE, boxes, least - eps
    return verdict, boxes, min(bound, least - eps)


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


class Aim(NamedTuple):
    """What is to be shown of every box.

    Parameters
    ----------
    level : float
        Cost from which on a box is done.
    value : float
        Cost that every point must be shown to have.
    better : float
        Cost below which a point refutes the fix; above `value`, so that no sliver is left between the two.
    whole : bool
        Whether a box is done as well where the gradient cannot vanish, because the search as a whole leaves no way out;
        otherwise only if its cost is at least `value`.
    floor : float
        See `optloc.proof.boxes.least_residual`.
    """

    level: float
    value: float
    better: float
    whole: bool
    floor: float


@compiled
def _search(
    cost: Cost, chart: Chart, box: Box, minima: Array, sides: Array, aim: Aim, budget: int, stack: Array, size: int
) -> tuple[int, int, float]:
    """Empty the stack; return the verdict (-1: all boxes are dealt with), the boxes looked at, and a lower bound."""
    boxes, low_points = 0, 0
    while size > 0:
        if boxes >= budget or size + 2 > stack.shape[0]:
            return BUDGET, boxes, _lowest(stack, size)
        size -= 1
        box.at[:], box.half[:] = stack[size, :3], stack[size, 3:6]
        boxes += 1
        low = bound_box(cost, chart, box, aim.floor)
        if low > 0.0 and low * low >= aim.level:
            continue
        here = cost_at(cost.K, cost.w, box.nodes)
        if here < aim.better:
            return BETTER, boxes, 0.0
        for k in range(3):
            box.cut[k], box.cut[3 + k] = -box.half[k], box.half[k]
        _shrink(cost, box, aim)
        if aim.level > aim.value:
            if aim.whole or (low > 0.0 and low * low >= aim.value):
                if _known(box, minima, sides):
                    continue
                curve_box(cost, chart, box)
                clip_to_stationary(cost.A, box.half, box.nodes, box.curves, box.sums, box.cut, box.solve)
            else:
                curve_box(cost, chart, box)
            low_points += here < aim.level
            early = here < aim.level and low_points & (low_points - 1) == 0
            if not _empty(box.cut) and (early or _is_bowl(cost, box)):
                verdict = _follow(cost, chart, box, minima, sides, aim)
                if verdict != _GOING:
                    return verdict, boxes, 0.0
        side = _side(cost, chart, box, sqrt(max(aim.level, 0.0)) - low)
        share = cut_out(box.cut, box.at, box.half)
        if 0.0 < share < _SHRUNK:
            size = push(stack, size, box.at, box.half, low)
        elif share > 0.0:
            size = push_halves(stack, size, side, box.at, box.half, low)
    return _GOING, boxes, inf


@compiled
def _shrink(cost: Cost, box: Box, aim: Aim) -> None:
    rho = sqrt(max(aim.level, 0.0)) + rounding(cost.K, cost.weight, aim.floor, box.nodes)
    shrink(cost.K, rho, box.half[2] == 0.0, box.nodes, box.rows, box.cut, box.solve)


@compiled
def _empty(cut: Array) -> bool:
    return bool(cut[0] > cut[3] or cut[1] > cut[4] or cut[2] > cut[5])


@compiled
def _is_bowl(cost: Cost, box: Box) -> bool:
    return convex(cost.kinds, cost.A, box.half, box.nodes, box.curves, box.sums, 0.0)


@compiled
def _follow(cost: Cost, chart: Chart, box: Box, minima: Array, sides: Array, aim: Aim) -> int:
    """Descend from the centre of a box to a minimum; return a verdict if it is better or not known, else -1.

    The box is as it was afterwards (but for its tables), or the minimum where there is a verdict.
    """
    at0, at1, at2 = box.at[0], box.at[1], box.at[2]
    h0, h1, h2 = box.half[0], box.half[1], box.half[2]
    least = descend(cost, chart, box)
    if least < aim.better:
        return BETTER
    if least < aim.level and not _known(box, minima, sides):
        return OTHER
    box.at[0], box.at[1], box.at[2] = at0, at1, at2
    box.half[0], box.half[1], box.half[2] = h0, h1, h2
    return _GOING


@compiled
def _side(cost: Cost, chart: Chart, box: Box, missing: float) -> int:
    """Return the coordinate across which to cut a box: where the remainders that matter shrink most.

    The remainder of a range is nearly ``s'N s / 2``, so coordinate k has the share ``h_k sum_m |N_km| h_m`` in it; it
    matters with its pull ``|K_j.v|`` on the bound. Where ranges have no part in the bound, or where it would miss the
    level even without remainders, the widest side is cut.
    """
    t0, t1, t2, length = 0.0, 0.0, 0.0, 0.0
    nodes, half, gram = box.nodes, box.half, chart.gram
    h0, h1, h2 = half[0], half[1], half[2]
    for i in range(box.rows.shape[0]):
        length += box.rows[i, 4] * box.rows[i, 4]
    for j in range(cost.kinds.shape[0]):
        wide = nodes[j, 5] - nodes[j, 4]
        if wide > 0.0:
            pull = 0.0
            for i in range(cost.K.shape[0]):
                pull += cost.K[i, j] * box.rows[i, 4]
            g0, g1, g2 = nodes[j, 1], nodes[j, 2], nodes[j, 3]
            a = abs(gram[0, 1] - g0 * g1) * h0 * h1
            b = abs(gram[0, 2] - g0 * g2) * h0 * h2
            c = abs(gram[1, 2] - g1 * g2) * h1 * h2
            x, y = (gram[0, 0] - g0 * g0) * h0 * h0 + a + b, (gram[1, 1] - g1 * g1) * h1 * h1 + a + c
            z = (gram[2, 2] - g2 * g2) * h2 * h2 + b + c
            pull = abs(pull) * wide / (x + y + z + 1e-300)
            t0 += pull * x
            t1 += pull * y
            t2 += pull * z
    most = max(t0, t1, t2)
    if not most > 0.0 or 0.5 * (t0 + t1 + t2) < missing * sqrt(length):
        return _widest(half)
    return 0 if t0 == most else (1 if t1 == most else 2)


@compiled
def _widest(half: Array) -> int:
    if half[0] >= half[1] and half[0] >= half[2]:
        return 0
    return 1 if half[1] >= half[2] else 2


@compiled
def _known(box: Box, minima: Array, sides: Array) -> bool:
    """Return whether a box lies inside the convex box of a known minimum."""
    for p in range(minima.shape[0]):
        inside = True
        for k in range(3):
            inside = inside and abs(box.at[k] - minima[p, k]) + box.half[k] <= sides[p, k]
        if inside:
            return True
    return False


@compiled
def _lowest(stack: Array, size: int) -> float:
    """Return a lower bound of the cost in the boxes left."""
    least = inf
    for i in range(size):
        low = max(stack[i, 6], 0.0)
        least = min(least, low * low)
    return least
