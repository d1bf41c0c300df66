"""Starts by branch and bound: the minima of a cost from nothing, the boxes of least bound first.

What a proof can bound it can start: the centres of promising boxes descend to minima, and boxes that cost more than the
best by a gap are dropped. When none is left, or the budget is spent, every minimum within the gap that was met is
listed. Nothing is claimed of them: that is the proof's part, which begins at the best.
"""

from __future__ import annotations

from heapq import heappop, heappush
from math import inf, nan, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.threads import mapped
from optloc.base.types import Array
from optloc.compute.jit import FEW, compiled, enabled, plain, ready, usable, zero
from optloc.proof.atlas import atlas_of, first_minima, position, set_centre, widen_around, with_minima
from optloc.proof.batch import FIRST_BOXES, PLAIN_BOXES, SMALL, plainly, present_in
from optloc.proof.box import (
    DEPTH,
    PIECE,
    bound_nodes,
    cost_at,
    cube,
    cut_out,
    least_residual,
    linearise_rows,
    pop,
    push_around,
    push_halves,
    reaches_infinity,
    rounding,
    shrink,
    steepest_side,
    uncut,
)
from optloc.proof.convex_boxes import accuracy_floor_far, is_known, known_minima, set_minimum
from optloc.proof.curvature import clip_to_stationary
from optloc.proof.descents import descend
from optloc.proof.everywhere import is_left, leaves, push_pieces
from optloc.proof.near import cut_side, lay_or_halve, region_of
from optloc.proof.nodes.dispatch import bound_pieces
from optloc.proof.position_costs import PositionCosts
from optloc.proof.search_space import (
    Box,
    Chart,
    Cost,
    Known,
    chart_on,
    cost_of,
    curve_box,
    empty_box,
    turned,
    widen,
)
from optloc.proof.search_space import place as set_place
from optloc.proof.surface import SIDES, reach_of_piece

# Standard deviations within which two minima are one: descents end a thousandth of one from their minimum.
_SAME = 0.1
# Rounds of a descent, each in the axes of where the one before ended. Two where a minimum is near; along the sphere of
# a sharp range, a thousand times as long as it is thick, up to fifteen.
_ROUNDS = 16
# Standard deviations: a round that ends so near to where it began has nothing left to find.
_STILL = 1e-3
# Distance, reaches of the stations, beyond which a descent has run away.
_AWAY = 1e5
# The test for stationary points is made where the cost at the centre is within so many levels; boxes at infinity are
# not split below a size. Both as in `optloc.proof.everywhere`, and only a matter of time.
_NEAR, _TINY = 100.0, 1e-5
# How far the cost may fall below that of a minimum in its convex box: what its polish leaves.
_POLISHED = 1e-6
# A centre that costs less than this share of the cheapest before is promising.
_HALF = 0.5
# Boxes for a first look at each side of the Earth: enough for a good minimum, which spares most of the others.
_LOOK = 32


class Aim(NamedTuple):
    """What is looked for.

    Parameters
    ----------
    planes, surface : array (e, 3), (0,) or (SURFACE_WIDTH,)
        To which the minima are limited, see `optloc.proof.search_space.Known`.
    gap : float
        By how much a minimum may cost more than the best.
    reach : float
        Metres beyond which a descent has run away.
    points : array (P, D)
        Written: minima.
    costs : array (P,)
        Written: what they cost.
    """

    planes: Array
    surface: Array
    gap: float
    reach: float
    points: Array
    costs: Array


@compiled
def _add(cost: Cost, near: Box, aim: Aim, x: Array, count: int, level: float) -> int:
    """Descend from a place (D,) to a minimum; return how many are known with it, one more if it is new.

    `x` is the minimum afterwards; what costs more than a level is none of interest.
    """
    D, value, arrived = x.shape[0], inf, 0
    # Until it has arrived twice: in the axes of a place beside, and in those of the minimum, where a sigma is one.
    for _ in range(_ROUNDS):
        chart, _ = chart_on(cost, x, near, aim.planes, aim.surface)
        near.at[:] = 0.0
        value = descend(cost, chart, near)
        for k in range(D):
            x[k] = near.centre[k]
        arrived = arrived + 1 if value < inf else 0
        if max(abs(near.at[0]), abs(near.at[1]), abs(near.at[2])) < _STILL:
            # At the minimum of a sharp cost its rounding hides whether a step still falls.
            value, arrived = cost_at(cost.K, cost.w, near.nodes), 2
        if arrived == 2 or (arrived == 1 and not value < level):
            break
    if arrived < 2 or not value < level:
        return count
    chart, _ = chart_on(cost, x, near, aim.planes, aim.surface)
    for k in range(D):
        if not abs(x[k]) < aim.reach:
            return count
    for p in range(count):
        square = 0.0
        for k in range(3 - int(aim.surface.shape[0] > 0)):
            away = 0.0
            for m in range(D):
                away += chart.back[k, m] * (aim.points[p, m] - x[m])
            square += away * away
        if square < _SAME * _SAME:
            return count
    at = count if count < aim.points.shape[0] else int(np.argmax(aim.costs))
    if count == aim.points.shape[0] and not value < aim.costs[at]:
        return count
    aim.points[at], aim.costs[at] = x, value
    return int(min(count + 1, aim.points.shape[0]))


@compiled
def _least(aim: Aim, count: int) -> float:
    """Return the cost of the best minimum."""
    best = inf
    for p in range(count):
        best = min(best, aim.costs[p])
    return best


@compiled
def _is_due(lows: int, low: bool, boxes: int) -> bool:
    """Return whether a centre descends: the first, second, fourth, eighth ... that is low, and of all."""
    return bool((low and lows & (lows - 1) == 0) or boxes & (boxes - 1) == 0)


@compiled
def _bound(cost: Cost, box: Box, floor: float) -> tuple[float, float]:
    """Return the bound of the cost over a box whose nodes are bounded, and the cost at its centre."""
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    low = least_residual(cost.K, cost.weight, floor, box.half, box.nodes, box.rows)
    return low * low if low > 0.0 else 0.0, cost_at(cost.K, cost.w, box.nodes)


# All positions, to infinity.


@compiled
def _search_everywhere(cost: Cost, box: Box, near: Box, x: Array, aim: Aim, budget: int) -> tuple[int, int]:
    """Look for minima over all positions; return how many were met, and the boxes that it took."""
    d, most = x.shape[0], aim.points.shape[0]
    middle, radius = cube(cost.kinds, cost.data, x)
    minima, at = atlas_of(middle, radius, d, most).minima, np.empty(d)
    atlas, known = with_minima(middle, radius, d, first_minima(minima, 0)), 0
    stack = np.zeros((2 * budget + 4 * (d + 1) + 6 * most, DEPTH))
    size, boxes, lows, count, cheapest = push_pieces(stack, atlas), 0, 0, zero(), inf
    queue = [(0.0, i) for i in range(size)]
    floor = accuracy_floor_far(cost, atlas)
    while len(queue) > 0 and boxes < budget:
        before, i = heappop(queue)
        level = _least(aim, count) + aim.gap
        if before >= level:
            break
        boxes += 1
        pop(stack, i, box.at, box.half)
        piece = int(stack[i, PIECE])
        set_centre(atlas, piece, box.at)
        if piece > 2 * d:
            widen_around(atlas, piece - 2 * d - 1, box.half)
        if is_left(atlas, box, piece):
            continue
        bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
        low, here = _bound(cost, box, floor)
        if low >= level:
            continue
        touching = piece < 2 * d and box.at[d - 1] <= box.half[d - 1]
        if touching and max(box.half[0], box.half[1], box.half[2]) < _TINY:
            continue
        position(atlas, at)
        exact, side = piece <= 2 * d, steepest_side(box.half, box.rows, d)
        if level < inf and here < _NEAR * (level + 1.0) and leaves(cost, atlas, box, touching, floor):
            continue
        lows, promising = lows + int(here < level), here < _HALF * cheapest
        cheapest = min(cheapest, here)
        if promising or _is_due(lows, here < level, boxes):
            more = _add(cost, near, aim, at, count, level)
            trial = with_minima(middle, radius, d, first_minima(minima, known + 1))
            if more > count and known < most and set_minimum(cost, near, trial, known, at, -inf, _POLISHED, inf):
                known, atlas, first = known + 1, trial, size
                core, sides = minima.core[known - 1], minima.sides[known - 1]
                size = push_around(stack, size, core[0], core[1], sides, 2 * d + known)
                _queue_up(queue, 0.0, first, size)
            count = more
        size = push_halves(stack, size, side, box.at, box.half, low, piece, exact)
        _queue_up(queue, low, size - 2, size)
    return count, boxes


@compiled
def _queue_up(queue: list[tuple[float, int]], low: float, first: int, last: int) -> None:
    """Put boxes of a stack into the queue by their bound."""
    for i in range(first, last):
        heappush(queue, (low, i))


# Planes, the surface of a height, and what encloses the cheap positions.


@compiled
def _search_chart(
    cost: Cost, chart: Chart, box: Box, near: Box, aim: Aim, corners: Array, budget: int, count: int
) -> tuple[int, int]:
    """Look for minima between corners (2, 3) of search coordinates; return how many are known, and the boxes."""
    bent, boxes, lows, cheapest = chart.surface.shape[0] > 0, 0, 0, inf
    gram = box.gram if bent else chart.gram
    stack, at = np.zeros((2 * budget + 8, DEPTH)), np.empty(aim.points.shape[1])
    size = push_around(stack, 0, corners[0], corners[1], np.zeros(3), 0)
    queue = [(0.0, i) for i in range(size)]
    minima, sides, known = _around(cost, chart, near, aim, corners, count)
    while len(queue) > 0 and boxes < budget:
        before, i = heappop(queue)
        level = _least(aim, count) + aim.gap
        if before >= level:
            break
        boxes += 1
        pop(stack, i, box.at, box.half)
        set_place(chart.origin, chart.sense, box.at, box.centre)
        widen(chart, box.centre, box.half)
        if bent:
            left = lay_or_halve(cost, chart, box, stack, size)
            if left >= 0:
                _queue_up(queue, before, size, left)
                size = left
                continue
        else:
            bound_nodes(cost.kinds, cost.data, box.centre, chart.sense, gram, box.half, box.line, box.nodes)
        low, here = _bound(cost, box, chart.floor)
        if low >= level or is_known(box.at, box.half, minima[:known], sides[:known]):
            continue
        for k in range(at.shape[0]):
            at[k] = box.centre[k]
        side = _cut(cost, chart, box, gram, level, here < level)
        lows, promising = lows + int(here < level), here < _HALF * cheapest
        cheapest = min(cheapest, here)
        if promising or _is_due(lows, here < level, boxes):
            more = _add(cost, near, aim, at, count, level)
            if more > count:
                minima, sides, known = _around(cost, chart, near, aim, corners, more)
            count = more
        share = cut_out(box.cut, box.at, box.half)
        if share > 0.0:
            size = push_halves(stack, size, side, box.at, box.half, low, 0, False)
            _queue_up(queue, low, size - 2, size)
    return count, boxes


@compiled
def _cut(cost: Cost, chart: Chart, box: Box, gram: Array, level: float, inside: bool) -> int:
    """Write the ends of the part of a box that may hold a minimum below a level; return the side to halve."""
    noise = rounding(cost.K, cost.weight, chart.floor, box.nodes)
    uncut(box.half, box.cut)
    if level < inf:
        flat = box.half[2] == 0.0
        shrink(cost.K, cost.weight, sqrt(level) + noise, box.half, flat, box.nodes, box.rows, box.cut, box.solve)
    side = cut_side(cost.kinds, cost.K, gram, box.half, box.nodes, box.rows, inside)
    curve_box(cost, chart, box)
    clip_to_stationary(cost.A, box.half, box.nodes, box.curves, box.sums, box.cut, box.solve)
    return int(side)


@compiled
def _around(cost: Cost, chart: Chart, near: Box, aim: Aim, corners: Array, count: int) -> tuple[Array, Array, int]:
    """Return the minima that are known in search coordinates (P, 3), convex boxes around them, and how many of them."""
    known = Known(aim.points[:count], 0, aim.planes, aim.surface)
    minima, sides, number, _ = known_minima(cost, chart, near, known, corners[0], corners[1], 0.0, -inf, False)
    return minima, sides, number


@compiled
def _search_sides(cost: Cost, box: Box, near: Box, x: Array, aim: Aim, budget: int) -> tuple[int, int]:
    """Look for minima all around the surface of a height."""
    around, _ = chart_on(cost, x, box, aim.planes, aim.surface)
    corners, count, boxes = np.empty((2, 3)), zero(), zero()
    for look in (_LOOK, budget):
        for side in range(SIDES):
            chart = turned(cost, around, side)
            corners[0], corners[1] = -inf, inf
            reach_of_piece(chart.surface, chart.origin, chart.sense, corners[0], corners[1])
            most = min(look, budget - boxes)
            count, more = _search_chart(cost, chart, box, near, aim, corners, most, count)
            boxes += more
    return count, boxes


@compiled
def _search_region(cost: Cost, box: Box, near: Box, x: Array, aim: Aim, region: Array, budget: int) -> tuple[int, int]:
    """Look for minima where positions cost less than x (D,), or where these are not enclosed in a region (2, D)."""
    chart, _ = chart_on(cost, x, box, aim.planes, aim.surface)
    corners, nowhere = np.empty((2, 3)), np.full(x.shape[0], nan)
    level = cost_at(cost.K, cost.w, box.nodes) + aim.gap
    if not region_of(cost, chart, box, sqrt(level), nowhere, nowhere, corners[0], corners[1]):
        region_of(cost, chart, box, sqrt(level), region[0], region[1], corners[0], corners[1])
    return _search_chart(cost, chart, box, near, aim, corners, budget, zero())


class Places(NamedTuple):
    """Where the minima of n costs are looked for.

    Parameters
    ----------
    x : array (n, d)
        A place each: on its planes or surface, and where nothing else encloses the cheap positions a rather good one.
    region : array (n, 2, d)
        Corners of what is searched where nothing encloses them.
    planes, surface : array (n, e, 3), (n, 0) or (n, SURFACE_WIDTH)
        To which the minima are limited, see `optloc.proof.search_space.Known`.
    """

    x: Array
    region: Array
    planes: Array
    surface: Array

    def take(self, i: int) -> Places:
        """Return the place of one of the costs, without the first axis."""
        return Places(*(array[i] for array in self))


def find_minima(costs: PositionCosts, places: Places, gap: float, budget: int, most: int) -> tuple[Array, Array]:
    """Return the minima of n costs that a best-first search meets, from nothing.

    Parameters
    ----------
    costs : PositionCosts
        The costs.
    places : Places
        Where they are looked for.
    gap : float
        By how much the cost of a minimum may exceed that of the best.
    budget : int
        How many boxes may be looked at for each.
    most : int
        How many minima are kept for each, the cheapest.

    Returns
    -------
    points : array (n, most, d)
        The minima by their cost, NaN behind the last.
    boxes : int array (n,)
        Boxes looked at; where they are fewer than the budget, none was left that bounds did not drop.
    """
    n, d = places.x.shape
    points, boxes = np.full((n, most, d), np.nan), np.zeros(n, dtype=np.int64)
    costs, places = PositionCosts(*map(plainly, costs)), Places(*map(plainly, places))

    def search(i: int, budget: int) -> None:
        with np.errstate(all="ignore"):  # plain Python would warn of what has no bound
            points[i], boxes[i] = _search(costs.take(slice(i, i + 1)), places.take(i), gap, budget, most)

    asked = list(range(n))
    if n <= FEW and len(costs.kinds) <= SMALL and not ready(present_in):
        # As few proofs are: most need few boxes, and machine code takes longer to load.
        first = min(budget, FIRST_BOXES // n)
        with plain():
            for i in asked:
                search(i, first)
        asked = np.flatnonzero(boxes == first).tolist() if first < budget and enabled() else []
    if enabled() and all(usable(kernel, n) for kernel in (_search_everywhere, _search_sides, _search_region)):
        mapped(lambda i: search(i, budget), asked)
        return points, boxes
    # Plain Python holds the interpreter: threads would wait for each other.
    few = min(budget, max(FIRST_BOXES, PLAIN_BOXES // max(len(asked), 1))) if enabled() else budget
    with plain():
        for i in asked:
            search(i, few)
    return points, boxes


def _search(costs: PositionCosts, place: Places, gap: float, budget: int, most: int) -> tuple[Array, int]:
    """Return the minima (most, d) of one cost, and the boxes that it took; places without their first axis."""
    cost = present_in(cost_of(costs.kinds, costs.data[0], costs.K[0], costs.w[0]))
    _, radius = cube(cost.kinds, cost.data, place.x)
    found, least = np.zeros((most, len(place.x))), np.full(most, inf)
    aim = Aim(place.planes, place.surface, gap, _AWAY * radius, found, least)
    box, near = empty_box(*cost.K.shape), empty_box(*cost.K.shape)
    if len(place.surface):
        _, boxes = _search_sides(cost, box, near, place.x, aim, budget)
    elif not len(place.planes) and reaches_infinity(cost.kinds, cost.K):
        _, boxes = _search_everywhere(cost, box, near, place.x, aim, budget)
    else:
        _, boxes = _search_region(cost, box, near, place.x, aim, place.region, budget)
    order = np.argsort(least)
    points = np.full(found.shape, np.nan)
    good = order[least[order] < least.min() + gap]
    points[: len(good)] = found[good]
    return points, boxes
