"""Starts by branch and bound: a search for the minima of a cost without any candidate, boxes of least bound first.

The centres of promising boxes descend to minima, and boxes that cost more than the best minimum by a gap are dropped.
The search ends when no box is left or the budget is spent, and lists all minima that it met within the gap. The search
proves nothing about them. The proof begins afterwards, at the best minimum.

In the functions here, `count` is the number of minima in the list, and `level` the cost of the best minimum plus the
gap. `size` is the number of boxes on the stack, and `near` is the working memory of descents.
"""

from __future__ import annotations

from heapq import heappop, heappush
from math import inf, nan, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.threads import map_on_threads
from optloc.base.types import Array
from optloc.kernels.jit import FEW, compiled, enabled, inlined, is_in_use, may_use_code, plain, zero
from optloc.proof.atlas import atlas_of, with_room_for_minimum
from optloc.proof.batch import FIRST_BOXES, PLAIN_BOXES, SMALL, plainly, without_unused_nodes
from optloc.proof.box import (
    DEPTH,
    PIECE,
    contract_box,
    cost_at,
    cut_out,
    least_residual,
    linearise_rows,
    pop,
    push_around,
    push_halves,
    reaches_infinity,
    reset_cut,
    rounding_error,
    station_cube,
    steepest_side,
)
from optloc.proof.convex_boxes import known_minima, set_minimum
from optloc.proof.curvature import contract_to_minima
from optloc.proof.descents import descend
from optloc.proof.global_search import excludes_infimum
from optloc.proof.local_search import cut_side, region_of
from optloc.proof.pieces import push_faces
from optloc.proof.position_costs import PositionCosts
from optloc.proof.search_space import (
    Box,
    Cost,
    KnownMinima,
    axes_of_next_piece,
    chart_on,
    cost_of,
    curve_box,
    empty_box,
)
from optloc.proof.space import Space, bound_or_halve, floor_of, place_of
from optloc.proof.surface import SIDES, reach_of_piece

# Standard deviations within which two minima count as one. Descents end within a thousandth of a standard deviation.
_SAME = 0.1
# Rounds of a descent; each round uses the axes of the point where the round before ended. Near a minimum two rounds
# suffice. Along the sphere of a sharp range, a thousand times as long as it is thick, a descent takes up to fifteen.
_ROUNDS = 16
# Standard deviations: a round that moves the point by less than this has converged.
_STILL = 1e-3
# Distance beyond which a descent counts as diverged, in half-widths of the cube around the stations.
_AWAY = 1e5
# The test for stationary points runs if the cost at the centre is at most this many levels. Boxes at infinity below
# the size `_TINY` are not split. Both are as in `optloc.proof.global_search`, and affect the run time only.
_NEAR, _TINY = 100.0, 1e-5
# Greatest fall of the cost below the cost of a minimum within its convex box: the remaining error of polishing.
_POLISHED = 1e-6
# A centre is promising if it costs less than this share of the cheapest centre before.
_HALF = 0.5
# Boxes of a first search on each side of the Earth: enough for a good minimum, whose cost excludes most other boxes.
_LOOK = 32


class SearchGoal(NamedTuple):
    """Goal of a search for minima, and the minima that it finds.

    Parameters
    ----------
    planes, surface : array (e, 3), (0,) or (SURFACE_WIDTH,)
        Planes or a surface that contain the minima, see `optloc.proof.search_space.KnownMinima`.
    gap : float
        Greatest cost of a minimum above the best one.
    reach : float
        Coordinate, metres, beyond which a descent counts as diverged.
    points : array (P, D)
        Written: minima, metres.
    costs : array (P,)
        Written: costs of the minima.
    """

    planes: Array
    surface: Array
    gap: float
    reach: float
    points: Array
    costs: Array


@compiled
def _add(cost: Cost, near: Box, aim: SearchGoal, x: Array, count: int, level: float) -> int:
    """Descend from a position x (D,), metres, to a minimum, and list it if it is new; return the number of minima.

    `x` is overwritten by the end of the descent. The list is in `aim`, and `count` is its length before. `near` is
    working memory. A minimum that costs `level` or more is not added. If the list is full, a new minimum replaces the
    most expensive one if it costs less.
    """
    D, value, arrived = x.shape[0], inf, 0
    # Until two rounds in succession (`arrived`) have converged: one in the axes of a nearby point, one in the axes of
    # the minimum, in which the unit is a standard deviation.
    for _ in range(_ROUNDS):
        chart, _ = chart_on(cost, x, near, aim.planes, aim.surface)
        near.at[:] = 0.0
        value = descend(cost, chart, near)
        for k in range(D):
            x[k] = near.centre[k]
        arrived = arrived + 1 if value < inf else 0
        if max(abs(near.at[0]), abs(near.at[1]), abs(near.at[2])) < _STILL:
            # At the minimum of a sharp cost, rounding hides whether a step still reduces the cost.
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
def _least(aim: SearchGoal, count: int) -> float:
    """Return the cost of the best of the first `count` minima."""
    best = inf
    for p in range(count):
        best = min(best, aim.costs[p])
    return best


@compiled
def _is_due(lows: int, low: bool, boxes: int) -> bool:
    """Return whether a centre descends: number 1, 2, 4, 8 and so on of the low centres, or of all centres.

    `lows` is the number of low centres so far, `low` whether this one is low (below the level), `boxes` the number of
    all.
    """
    return bool((low and lows & (lows - 1) == 0) or boxes & (boxes - 1) == 0)


@compiled
def search_minima(
    cost: Cost, box: Box, near: Box, x: Array, aim: SearchGoal, region: Array, budget: int
) -> tuple[int, int]:
    """Return the number of known minima and the number of boxes of a search for minima.

    The minima are written into `aim`. On a surface, the search goes all around it. Otherwise, if the cost stays finite
    at infinity, all positions are searched. In other cases the search is between corners. They are the corners of an
    enclosure of the positions that cost less than x (D,). Without an enclosure they are the corners of the region (2,
    D), metres. `box` and `near` are working memory, and `budget` is the greatest number of boxes.
    """
    around, _ = chart_on(cost, x, box, aim.planes, aim.surface)
    level, d, bent = cost_at(cost.K, cost.w, box.nodes) + aim.gap, x.shape[0], aim.surface.shape[0] > 0
    far = not bent and aim.planes.shape[0] == 0 and reaches_infinity(cost.kinds, cost.K)
    middle, radius = station_cube(cost.kinds, cost.data, x)
    atlas, none, nowhere = atlas_of(middle, radius, d, 0), np.empty((0, 3)), np.full(d, nan)
    stack, corners = np.zeros((2 * budget + 4 * (d + 1) + 6 * aim.points.shape[0], DEPTH)), np.empty((2, 3))
    chart, count, boxes = around, zero(), zero()
    # On a surface, a short search of each side comes first: a cheap minimum from any side lowers the level for all.
    for look in range(2 * SIDES if bent else 1):
        most = min(_LOOK, budget - boxes) if bent and look < SIDES else budget - boxes
        if bent:
            chart = axes_of_next_piece(cost, around, look % SIDES)
            corners[0], corners[1] = -inf, inf
            reach_of_piece(chart.surface, chart.origin, chart.sense, corners[0], corners[1])
        elif not far and not region_of(cost, chart, box, sqrt(level), nowhere, nowhere, corners[0], corners[1]):
            region_of(cost, chart, box, sqrt(level), region[0], region[1], corners[0], corners[1])
        space = Space(far, atlas, chart, none, none)
        if far:
            size = push_faces(stack, d)
        else:
            size = push_around(stack, 0, corners[0], corners[1], np.zeros(3), 0)  # no hole
            space = _with_known(cost, space, near, aim, corners, count)
        count, more = _search(cost, space, box, near, aim, corners, stack, size, most, count)
        boxes += more
    return count, boxes


@compiled
def _search(
    cost: Cost,
    space: Space,
    box: Box,
    near: Box,
    aim: SearchGoal,
    corners: Array,
    stack: Array,
    size: int,
    budget: int,
    count: int,
) -> tuple[int, int]:
    """Search the boxes of a stack for minima; return the number of known minima, and the number of boxes.

    `corners` (2, 3) are the corners of the region in search coordinates, and `budget` is the greatest number of boxes.
    New minima are written into `aim`, which has `count` minima before. `near` is working memory.
    """
    at, boxes, lows, cheapest, floor = np.empty(aim.points.shape[1]), zero(), zero(), inf, floor_of(space, cost)
    queue = [(0.0, i) for i in range(size)]
    while len(queue) > 0 and boxes < budget:
        before, i = heappop(queue)
        level, piece, known = _least(aim, count) + aim.gap, int(stack[i, PIECE]), count
        if before >= level:
            break
        boxes += 1
        pop(stack, i, box.at, box.half)
        left = bound_or_halve(space, cost, box, piece, stack, size)
        if left >= 0:
            _queue_up(queue, before, size, left)
            size = left
            continue
        low, here, side = _look(cost, space, box, piece, level, floor)
        if side < 0:
            continue
        place_of(space, box, at)
        lows, promising = lows + int(here < level), here < _HALF * cheapest
        cheapest = min(cheapest, here)
        if promising or _is_due(lows, here < level, boxes):
            count = _add(cost, near, aim, at, count, level)
        if count > known and space.far:
            space, more = _push_minimum(cost, space, near, at, stack, size)
            _queue_up(queue, 0.0, size, more)
            size = more
        elif count > known:
            space = _with_known(cost, space, near, aim, corners, count)
        size = _split(space, box, stack, queue, size, side, low, piece)
    return count, boxes


@inlined
def _split(
    space: Space,
    box: Box,
    stack: Array,
    queue: list[tuple[float, int]],
    size: int,
    side: int,
    low: float,
    piece: int,
) -> int:
    """Push the halves of the remaining part of a box; return the size of the stack.

    `side` is the side to halve, and `low` a lower bound of the cost over the box, by which the queue is ordered.
    `piece` is the number of the box's piece of the atlas, 0 around a fix, and `size` the size of the stack before.
    """
    if not cut_out(box.cut, box.at, box.half) > 0.0:
        return size
    exact = space.far and piece <= 2 * space.atlas.dimension
    _queue_up(queue, low, size, size + 2)
    return push_halves(stack, size, side, box.at, box.half, low, piece, exact)


@compiled
def _queue_up(queue: list[tuple[float, int]], low: float, first: int, last: int) -> None:
    """Put boxes first to last - 1 of a stack into the queue, ordered by their bound `low` of the cost."""
    for i in range(first, last):
        heappush(queue, (low, i))


@inlined
def _look(cost: Cost, space: Space, box: Box, piece: int, level: float, floor: float) -> tuple[float, float, int]:
    """Return the bound of the cost over a box with bounded nodes, the cost at its centre, and the side to halve.

    The side is -1 if the box contains no minimum below a level. Otherwise the ends of the part that may contain a
    minimum are written into ``box.cut``. `piece` is the number of the box's piece of the atlas, and `floor` the result
    of `optloc.proof.space.floor_of`.
    """
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    low = least_residual(cost.K, cost.weight, floor, box.half, box.nodes, box.rows)
    low, here = low * low if low > 0.0 else 0.0, cost_at(cost.K, cost.w, box.nodes)
    if low >= level:
        return low, here, -1
    side = _side_far(cost, space, box, piece, level, here, floor) if space.far else _cut(cost, space, box, level, here)
    return low, here, side


@inlined
def _side_far(cost: Cost, space: Space, box: Box, piece: int, level: float, here: float, floor: float) -> int:
    """Return the side to halve of a box of the atlas, or -1 if it contains no minimum; the box is not contracted.

    `piece` is the number of the box's piece of the atlas, and `here` the cost at the centre of the box. `floor` is the
    result of `optloc.proof.space.floor_of`. `level` is infinite as long as no minimum is known.
    """
    atlas, d = space.atlas, space.atlas.dimension
    touching = piece < 2 * d and box.at[d - 1] <= box.half[d - 1]
    if touching and max(box.half[0], box.half[1], box.half[2]) < _TINY:  # so small that halving would hardly change it
        return -1
    if level < inf and here < _NEAR * (level + 1.0) and excludes_infimum(cost, atlas, box, touching, floor):
        return -1
    reset_cut(box.half, box.cut)
    return int(steepest_side(box.half, box.rows, d))


@inlined
def _cut(cost: Cost, space: Space, box: Box, level: float, here: float) -> int:
    """Write the ends of the part of a box that may contain a minimum below a level; return the side to halve, or -1.

    The result is -1 if no part remains. `here` is the cost at the centre of the box.
    """
    chart = space.chart
    gram = box.gram if chart.surface.shape[0] > 0 else chart.gram
    noise = rounding_error(cost.K, cost.weight, chart.floor, box.nodes)
    reset_cut(box.half, box.cut)
    if level < inf:
        flat = box.half[2] == 0.0
        contract_box(cost.K, cost.weight, sqrt(level) + noise, box.half, flat, box.nodes, box.rows, box.cut, box.solve)
    side = cut_side(cost.kinds, cost.K, gram, box.half, box.nodes, box.rows, here < level)
    curve_box(cost, chart, box)
    minima = contract_to_minima(cost.A, box.half, box.nodes, box.curves, box.sums, box.cut, box.solve)
    return int(side) if minima else -1


@compiled
def _with_known(cost: Cost, space: Space, near: Box, aim: SearchGoal, corners: Array, count: int) -> Space:
    """Return search coordinates with the known minima and convex boxes around them, which the search leaves out."""
    known = KnownMinima(aim.points[:count], 0, aim.planes, aim.surface)
    # No margin of convexity, no least cost, and no fix among the minima.
    minima, sides, number, _ = known_minima(cost, space.chart, near, known, corners[0], corners[1], 0.0, -inf, False)
    return Space(False, space.atlas, space.chart, minima[:number], sides[:number])


@compiled
def _push_minimum(cost: Cost, space: Space, near: Box, x: Array, stack: Array, size: int) -> tuple[Space, int]:
    """Return the atlas with one more minimum x (D,), and push boxes around it; the same atlas if x is no minimum."""
    known, atlas = space.atlas.minima.home.shape[0], with_room_for_minimum(space.atlas)
    if not set_minimum(cost, near, atlas, known, x, -inf, _POLISHED, inf):
        return space, size
    core, sides = atlas.minima.core[known], atlas.minima.sides[known]
    size = push_around(stack, size, core[0], core[1], sides, 2 * atlas.dimension + 1 + known)
    return Space(True, atlas, space.chart, space.minima, space.sides), size


class FoundPlaces(NamedTuple):
    """Data of the searches for the minima of n costs.

    Parameters
    ----------
    x : array (n, d)
        One position for each cost, metres: on its planes or surface. If nothing encloses the positions of low cost,
        this position should have a low cost.
    region : array (n, 2, d)
        Corners of the region to search if nothing encloses the minima, metres.
    planes, surface : array (n, e, 3), (n, 0) or (n, SURFACE_WIDTH)
        Planes or a surface that contain the minima, see `optloc.proof.search_space.KnownMinima`.
    """

    x: Array
    region: Array
    planes: Array
    surface: Array

    def take(self, i: int) -> FoundPlaces:
        """Return the search data of cost i, without the first axis."""
        return FoundPlaces(*(array[i] for array in self))


def find_minima(costs: PositionCosts, places: FoundPlaces, gap: float, budget: int, most: int) -> tuple[Array, Array]:
    """Return the minima of n costs that a best-first search finds without starting points.

    Parameters
    ----------
    costs : PositionCosts
        The costs.
    places : FoundPlaces
        Data of the searches: positions, regions, planes or surfaces.
    gap : float
        Greatest difference between the cost of a listed minimum and the least cost found.
    budget : int
        Greatest number of boxes for each cost.
    most : int
        Number of minima to keep for each cost; the cheapest are kept.

    Returns
    -------
    points : array (n, most, d)
        The minima in order of cost, metres; NaN after the last one.
    boxes : int array (n,)
        Number of boxes. If it is below the budget, bounds have excluded all other boxes.
    """
    n, d = places.x.shape
    points, boxes = np.full((n, most, d), np.nan), np.zeros(n, dtype=np.int64)
    costs, places = PositionCosts(*map(plainly, costs)), FoundPlaces(*map(plainly, places))

    def search(i: int, budget: int) -> None:
        with np.errstate(all="ignore"):  # plain Python would warn of values without a bound
            points[i], boxes[i] = _minima_of(costs.take(slice(i, i + 1)), places.take(i), gap, budget, most)

    pending = list(range(n))
    if n <= FEW and len(costs.kinds) <= SMALL and not is_in_use(without_unused_nodes):
        # As in proofs of few fixes: most searches need few boxes, and loading compiled code takes longer.
        first = min(budget, FIRST_BOXES // n)
        with plain():
            for i in pending:
                search(i, first)
        pending = np.flatnonzero(boxes == first).tolist() if first < budget and enabled() else []
    if enabled() and may_use_code(search_minima, n):
        map_on_threads(lambda i: search(i, budget), pending)
        return points, boxes
    # Plain Python holds the interpreter lock, so threads would wait for each other.
    few = min(budget, max(FIRST_BOXES, PLAIN_BOXES // max(len(pending), 1))) if enabled() else budget
    with plain():
        for i in pending:
            search(i, few)
    return points, boxes


def _minima_of(costs: PositionCosts, place: FoundPlaces, gap: float, budget: int, most: int) -> tuple[Array, int]:
    """Return the minima (most, d), metres, of one cost in order of cost, and the number of boxes.

    `place` has no first axis. Only minima that cost less than the least cost plus `gap` count. Rows of NaN follow the
    last minimum. `budget` is the greatest number of boxes.
    """
    cost = without_unused_nodes(cost_of(costs.kinds, costs.data[0], costs.K[0], costs.w[0]))
    _, radius = station_cube(cost.kinds, cost.data, place.x)
    found, least = np.zeros((most, len(place.x))), np.full(most, inf)
    aim = SearchGoal(place.planes, place.surface, gap, _AWAY * radius, found, least)
    box, near = empty_box(*cost.K.shape), empty_box(*cost.K.shape)
    _, boxes = search_minima(cost, box, near, place.x, aim, place.region, budget)
    order = np.argsort(least)
    points = np.full(found.shape, np.nan)
    good = order[least[order] < least.min() + gap]
    points[: len(good)] = found[good]
    return points, boxes
