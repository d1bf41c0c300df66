"""Branch and bound around a fix: no point costs less, and no other minimum has nearly the same cost.

Boxes are in search coordinates around the fix, in standard deviations (`optloc.proof.search_space.LocalAxes`), and wait
on a stack (`optloc.proof.box`). A box is dropped if its least cost is at least a level, or if it contains no minimum.
Otherwise it is contracted, halved and pushed back.
"""

from __future__ import annotations

from math import inf, isnan, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined, put
from optloc.proof.box import (
    DEPTH,
    DIRECTION,
    bound_nodes,
    contract_box,
    cost_at,
    exceeds_level,
    is_empty,
    least_left,
    least_residual,
    linearise_rows,
    pop,
    push_around,
    push_halves,
    reset_cut,
    rounding_error,
    widest,
)
from optloc.proof.convex_boxes import is_known, known_minima
from optloc.proof.curvature import G0, G1, G2, contract_to_minima, curve_nodes, is_convex_over_box, sum_up
from optloc.proof.descents import descend
from optloc.proof.enclosure import around_node, enclose
from optloc.proof.nodes.node import (
    HEIGHT,
    HIGH,
    LOW,
    RANGE,
    SLOPE0,
    SLOPE1,
    SLOPE2,
)
from optloc.proof.pieces import push_rest
from optloc.proof.search_space import (
    COARSEST,
    Box,
    Cost,
    KnownMinima,
    LocalAxes,
    axes_of_next_piece,
    chart_on,
    curve_along,
    curve_box,
    equal_within,
    lay_on_surface,
    rounding_at_centre,
    shapes_of,
    value_at,
    widen_by_rounding,
    write_centre,
)
from optloc.proof.surface import DATA, LEVEL, MIDDLE, SIDES, is_beyond, is_one_side, reach_of_piece

# Branch and bound over boxes in search coordinates around a fix.

# Outcomes of a search: all is shown, a cheaper point, another minimum below the level, budget spent, or a cost at
# infinity below the level.
CLEAR, CHEAPER, ANOTHER, SPENT, INFINITE = range(5)
# Boxes on the stack: a depth-first stack has one box for each halving, and no box remains after 512 halvings.
_CAPACITY = 512


class Goal(NamedTuple):
    """Conditions that a search shows for each box.

    Parameters
    ----------
    level : float
        A box whose cost is at least this is finished.
    value : float
        Cost that each point must be shown to have at least.
    better : float
        A point below this cost refutes the fix. It is above `value`, so that no thin region remains between the two.
    whole : bool
        Whether a box without a stationary point is finished. This holds if the search as a whole has no open boundary.
        Otherwise such a box also needs a cost of at least `value`.
    free : int
        The first `free` known minima are the fix or hidden: points in their boxes do not count.
    own : int
        Number of these that are the fix: 1, or 0 on another piece of a surface.
    """

    level: float
    value: float
    better: float
    whole: bool
    free: int
    own: int


@compiled
def search_boxes(
    cost: Cost, chart: LocalAxes, box: Box, minima: Array, sides: Array, aim: Goal, budget: int, stack: Array, size: int
) -> tuple[int, int, float]:
    """Search the boxes of a stack until none is left or the outcome is decided.

    Parameters
    ----------
    cost, chart : Cost, LocalAxes
        The cost and its search coordinates.
    box : Box
        Tables; after the outcomes CHEAPER and ANOTHER it contains the point.
    minima, sides : array (P, 3)
        Known minima, and half-widths of boxes around them in which the cost is convex.
    aim : Goal
        The conditions to show.
    budget : int
        Greatest number of boxes.
    stack, size : array (capacity, DEPTH), int
        The boxes (`optloc.proof.box`).

    Returns
    -------
    outcome : int
        CLEAR: all is shown. CHEAPER: a point below `aim.better`. ANOTHER: a minimum below `aim.level`. SPENT: boxes
        are left.
    boxes : int
        Number of boxes searched.
    bound : float
        A lower bound of f in the remaining boxes; infinite without remaining boxes.
    """
    # Arrays as local variables: passing a record on counts references to all its arrays, for each box.
    kinds, data, K, w, A = cost.kinds, cost.data, cost.K, cost.w, cost.A
    bent, shapes = chart.surface.shape[0] > 0, shapes_of(cost, chart)
    gram = box.gram if bent else chart.gram  # a box on a surface has other axes
    sense, at, half, centre, line = chart.sense, box.at, box.half, box.centre, box.line
    nodes, rows, curves, sums, solve, cut = box.nodes, box.rows, box.curves, box.sums, box.solve, box.cut
    # `unique`: the claim is about other minima, too, and not about the value alone.
    weight, origin, floor, unique = cost.weight, chart.origin, chart.floor, aim.level > aim.value
    rho = sqrt(max(aim.level, 0.0))
    boxes, low_points = 0, 0
    while size > 0:
        if boxes >= budget or size + 2 > stack.shape[0]:
            return SPENT, boxes, least_left(stack, size)
        size -= 1
        pop(stack, size, at, half)
        boxes += 1
        write_centre(origin, sense, at, centre)
        widen_by_rounding(chart, centre, half)
        if bent:
            left = lay_or_halve(cost, chart, box, stack, size)
            if left >= 0:
                size = left
                continue
        else:
            bound_nodes(kinds, data, centre, sense, gram, half, line, nodes)
        linearise_rows(K, w, nodes, rows)
        low = least_residual(K, weight, floor, half, nodes, rows)
        # `low` is a length and the level a cost, so the length is squared.
        if exceeds_level(low, aim.level):
            continue
        here, noise = cost_at(K, w, nodes), rounding_error(K, weight, floor, nodes)
        if here < aim.better:
            return CHEAPER, boxes, 0.0
        # Parts with residuals longer than rho, and parts that contain no minimum, are cut off from all sides.
        reset_cut(half, cut)
        contract_box(K, weight, rho + noise, half, half[2] == 0.0, nodes, rows, cut, solve)
        sound = aim.whole or exceeds_level(low, aim.value)
        if _is_done(at, half, minima, sides, aim, (unique or aim.whole) and sound):
            continue
        if unique or aim.whole:
            if bent:
                curve_along(cost, chart, box)
            else:
                curve_nodes(kinds, data, centre, sense, gram, half, line, solve, nodes, curves)
            sum_up(K, w, weight, noise, nodes, curves, sums)
            if sound and not contract_to_minima(A, half, nodes, curves, sums, cut, solve):
                continue
            if here < aim.level and not is_empty(cut):
                low_points += 1
                seldom = low_points & (low_points - 1) == 0
                if seldom or is_convex_over_box(shapes, A, half, nodes, curves, sums, 0.0):
                    outcome = _follow(cost, chart, box, minima, sides, aim)
                    if outcome != CLEAR:
                        return outcome, boxes, 0.0
        side = cut_side(kinds, K, gram, half, nodes, rows, here < aim.level)
        size = push_rest(stack, size, cut, at, half, side, low, 0)
    return CLEAR, boxes, inf


@inlined
def _is_done(at: Array, half: Array, minima: Array, sides: Array, aim: Goal, enough: bool) -> bool:
    """Return whether a box needs no further search because it is in the convex box of a known minimum.

    `at` and `half` (3,) are the centre and half-widths of the box. `minima` and `sides` (P, 3) are the known minima and
    the half-widths of their convex boxes: the fix first, then hidden minima, as `aim` counts them. A convex box
    contains no second minimum, but it may contain a point of lower cost. If `enough`, the convex box of any known
    minimum finishes the box. Otherwise only convex boxes of the fix and of hidden minima do. If the search has no open
    boundary, the box of the fix contains nothing cheaper.
    """
    first = 0 if aim.whole else aim.own
    if is_known(at, half, minima[first : aim.free], sides[first : aim.free]):
        return True
    return enough and is_known(at, half, minima, sides)


@compiled
def _follow(cost: Cost, chart: LocalAxes, box: Box, minima: Array, sides: Array, aim: Goal) -> int:
    """Descend from the centre of a box to a minimum; return CHEAPER, or ANOTHER for an unknown minimum, or CLEAR.

    CHEAPER means that the minimum costs less than `aim.better`, and ANOTHER that it costs less than `aim.level`. The
    centre of the box is then at the minimum. After CLEAR, centre and half-widths are restored, but not the tables.
    """
    at, half = box.at.copy(), box.half.copy()
    least = descend(cost, chart, box)
    if least < aim.better:
        return CHEAPER
    if least < aim.level and not is_known(box.at, box.half, minima, sides):
        return ANOTHER
    put(at, box.at)
    put(half, box.half)
    return CLEAR


@inlined
def cut_side(kinds: Array, K: Array, gram: Array, half: Array, nodes: Array, rows: Array, inside: bool) -> int:
    """Return the coordinate (0, 1 or 2) across which halving a box reduces the remainders in its bound most.

    The remainder of a range is the range minus its linear approximation at the centre of the box, nearly ``s'N s / 2``.
    N is the Hessian of the range, and h (`half`) the half-widths. So coordinate k has the share ``h_k sum_m |N_km|
    h_m`` in the remainder. These shares are scaled to sum to the width of the remainder's interval. The weight of
    range j is its pull ``|K_j.v|`` on the bound, with v the direction of the bound
    (`optloc.proof.box.least_residual`). Only ranges count. If the centre is below the level (`inside`), no bound
    suffices. In this case, and if ranges have no part in the bound, the result is the widest side.

    Parameters
    ----------
    kinds, K : array (J,), (q, J)
        Codes of the nodes, and whitened rows over the nodes.
    gram : array (3, 3)
        T'T of the search coordinates: x = origin + T s.
    half : array (3,)
        Half-widths of the box.
    nodes, rows : array (J, NODE_WIDTH), (q, ROW_WIDTH)
        Filled tables of the box: intervals and slopes of the nodes, and the direction v in column DIRECTION of `rows`.
    inside : bool
        Whether the cost at the centre is below the level.
    """
    if inside:
        return widest(half)
    t0, t1, t2, h0, h1, h2 = 0.0, 0.0, 0.0, half[0], half[1], half[2]
    for j in range(kinds.shape[0]):
        wide = nodes[j, HIGH] - nodes[j, LOW]
        if kinds[j] == RANGE and wide > 0.0:
            pull = 0.0
            for i in range(K.shape[0]):
                pull += K[i, j] * rows[i, DIRECTION]
            # Times the range r, N is T'T minus the square of the slopes. The factor 1/r cancels in the shares.
            e0, e1, e2 = nodes[j, SLOPE0] * h0, nodes[j, SLOPE1] * h1, nodes[j, SLOPE2] * h2
            a, b = abs(gram[0, 1] * h0 * h1 - e0 * e1), abs(gram[0, 2] * h0 * h2 - e0 * e2)
            c = abs(gram[1, 2] * h1 * h2 - e1 * e2)
            x, y = gram[0, 0] * h0 * h0 - e0 * e0 + a + b, gram[1, 1] * h1 * h1 - e1 * e1 + a + c
            z = gram[2, 2] * h2 * h2 - e2 * e2 + b + c
            pull = abs(pull) * wide / (x + y + z + 1e-300)  # avoids 0 / 0 for a box without width
            t0 += pull * x
            t1 += pull * y
            t2 += pull * z
    most = max(t0, t1, t2)
    if not most > 0.0:
        return widest(half)
    return 0 if t0 == most else (1 if t1 == most else 2)


@compiled
def lay_or_halve(cost: Cost, chart: LocalAxes, box: Box, stack: Array, size: int) -> int:
    """Move a box onto a surface, and bound its nodes; return -1, or the stack's size if it is dropped or halved.

    A box that belongs to another piece of the surface is dropped. A box over which the surface is no graph is halved
    across its longer side.
    """
    half, sense = box.half, chart.sense
    if is_beyond(chart.surface, box.centre, sense, half):
        return size
    if lay_on_surface(cost, chart, box):
        return -1
    first = (sense[0, 0] * sense[0, 0] + sense[1, 0] * sense[1, 0] + sense[2, 0] * sense[2, 0]) * half[0] * half[0]
    second = (sense[0, 1] * sense[0, 1] + sense[1, 1] * sense[1, 1] + sense[2, 1] * sense[2, 1]) * half[1] * half[1]
    # Without a bound of the parent box, in piece 0, and with rounding of the halves.
    return push_halves(stack, size, 0 if first >= second else 1, box.at, half, 0.0, 0, False)


# The proof.

# Half-width above which a box does not count as an enclosure: its products would overflow.
_ENDLESS = 1e300
# Corners of the region to search are moved outwards by this share, for the rounding of the enclosure.
_OUTWARDS = 1e-9

# If the level is this far below the cost of a position, the position need not be a minimum. Rounding is far less.
_MUCH = 1.0
# Share of a cost within which costs count as equal (`optloc.solvers.policy.equal_cost`).
_EQUAL = 1e-6

# Verdicts of a proof.
UNIQUE, VALUE, BETTER, OTHER, BUDGET, OPEN, STATIONARY, SINGULAR = range(8)
COARSE = 9
"""A further verdict: the rounding of residuals exceeds the stated noise so far that costs cannot be compared."""


@compiled
def prove_locally(
    cost: Cost,
    box: Box,
    x: Array,
    known: KnownMinima,
    kappa: float,
    eps: float,
    budget: int,
    reach: float,
    lower: Array,
    upper: Array,
    closed: bool,
    found: Array,
) -> tuple[int, int, float]:
    """Prove that a fix is the least point of ``f = |K phi(x) - w|^2``, and the only minimum below ``f(x) + kappa``.

    Parameters
    ----------
    cost : Cost
        The cost of the position; other unknowns have been projected out.
    box : Box
        Working memory, see `optloc.proof.search_space.empty_box`.
    x : array (D,)
        The polished fix, metres.
    known : KnownMinima
        Other known minima, and planes or a surface to which the claim is limited.
    kappa : float
        Gap to prove; 0 proves the value alone.
    eps : float
        A cost that is lower than the cost of the fix by at most eps counts as equal; usually about 1e-6 (1 + f). If
        the rounding of residuals needs more, eps is raised (`optloc.proof.search_space.equal_within`).
    budget : int
        Greatest number of boxes.
    reach : float
        Greatest size of the region to search, as a multiple of the convex box around the fix. If the region is larger,
        no box is searched.
    lower, upper : array (D,)
        Corners of the region to search, in the frame of x, metres. If lower[0] is NaN, the function searches an
        enclosure of all points that cost less than f(x) + kappa, so that the claim holds for all positions.
    closed : bool
        For a region: whether another proof covers the points outside. If so, a box without a stationary point needs no
        bound. If not, the claim is for the region alone.
    found : array (D,)
        Written: the better or other point (verdicts BETTER and OTHER), metres.

    Returns
    -------
    verdict : int
        UNIQUE: the value is proven, and no unknown minimum has a gap below kappa. VALUE: kappa is 0, and the value is
        proven. BETTER: `found` costs less. OTHER: `found` is close to another minimum whose gap is below kappa.
        BUDGET: boxes are left. OPEN: there is no enclosure. STATIONARY: the fix is no strict minimum, or is not
        polished enough. SINGULAR: the rows do not determine a position near the fix. COARSE: the noise is finer than
        rounding.
    boxes : int
        Number of boxes searched.
    bound : float
        A certified lower bound of f over the region or over all positions; -inf without a bound. For a proven value it
        is below the cost of the fix by the final eps.
    """
    # Units are standard deviations of the fix: boxes are about as wide as the cost requires.
    chart, good = chart_on(cost, x, box, known.planes, known.surface)
    if not good:
        return SINGULAR, 0, -inf
    least, sums, bent = cost_at(cost.K, cost.w, box.nodes), box.sums, chart.surface.shape[0] > 0
    slope, noise = (sums[G0], sums[G1], sums[G2]), rounding_at_centre(cost, chart, box) if not bent else 0.0
    low, high, alone, most, there = np.empty(3), np.empty(3), True, max(COARSEST, eps), least
    if not region_of(cost, chart, box, sqrt(least + kappa), lower, upper, low, high):
        return OPEN, 0, -inf
    if bent:
        alone = is_one_side(chart.surface, chart.origin, chart.sense, low, high)
        if not alone and not isnan(lower[0]):  # a region that reaches around the Earth
            return OPEN, 0, -inf
        reach_of_piece(chart.surface, chart.origin, chart.sense, low, high)
        there, noise = _laid(cost, chart, box)
        slope = (box.sums[G0], box.sums[G1], 0.0)
    eps = equal_within(eps, least, noise)
    # A fix is off its surface by rounding; half of eps is allowed for the change of cost.
    if not abs(there - least) <= 0.5 * eps:
        return STATIONARY, 0, -inf
    if not eps <= most:
        return COARSE, 0, -inf
    # On a box whose Hessian exceeds a margin, the cost falls below the cost of its centre by at most slope^2 / margin.
    margin = steepness(slope, noise) / (0.5 * eps if bent else eps)
    minima, sides, count, free = known_minima(cost, chart, box, known, low, high, margin, least - eps, True)
    if count == 0 and not (kappa <= 0.0 and eps > _MUCH and _holds_origin(low, high)):
        return STATIONARY, 0, -inf
    if count and not _extent(low, high, sides[0]) <= reach:
        return BUDGET, 0, -inf
    own, free, hole = (1, free, sides[0]) if count else (0, 0, np.zeros(3))
    count = free if kappa <= 0.0 else count  # for the value alone, boxes of other minima are bounded like all others
    # Hidden minima leave an open boundary: where the position becomes visible, the least cost may have a slope.
    better, whole = _refuting(least, eps, noise), (closed or isnan(lower[0])) and known.hidden == 0
    level = least + kappa if kappa > 0.0 else least - eps
    aim, stack = Goal(level, least - eps, better, whole, free, own), np.empty((_CAPACITY, DEPTH))
    size = push_around(stack, 0, low, high, hole, 0)
    outcome, boxes, bound = search_boxes(cost, chart, box, minima[:count], sides[:count], aim, budget, stack, size)
    if outcome == CLEAR and not alone:
        outcome, boxes = _search_sides(cost, chart, box, known, aim, budget, boxes, stack)
    if outcome == CLEAR:
        return UNIQUE if kappa > 0.0 else VALUE, boxes, least - eps
    if outcome == SPENT:  # other sides have no bound
        return BUDGET, boxes, min(bound, least - eps) if alone else -inf
    for k in range(x.shape[0]):
        found[k] = box.centre[k]
    return BETTER if outcome == CHEAPER else OTHER, boxes, 0.0


@inlined
def _refuting(least: float, eps: float, noise: float) -> float:
    """Return the cost below which a point refutes the claim that all costs are at least the cost of the fix less eps.

    `least` is the cost of the fix, and `noise` bounds the rounding of a residual. The result is halfway between `least`
    and ``least - eps``. So a cheaper point is cheaper by more than rounding, and no box remains that is cheaper by
    less. If eps is large, a point far below the cost of the position, but above the level, refutes nothing.
    """
    if eps > _MUCH:
        return least - eps + 0.5 * equal_within(_EQUAL * (1.0 + least - eps), least, noise)
    return least - 0.5 * eps


@inlined
def _holds_origin(low: Array, high: Array) -> bool:
    """Return whether the region to search contains the fix, which is the origin of search coordinates.

    `low` and `high` (3,) are the corners of the region.
    """
    inside = True
    for k in range(3):
        inside = inside and low[k] <= 0.0 <= high[k]
    return inside


@inlined
def _extent(low: Array, high: Array, sides: Array) -> float:
    """Return the greatest ratio of the region to search to the convex box around a fix, over all axes.

    `low` and `high` (3,) are the corners of the region, and `sides` (3,) the half-widths of the convex box.
    """
    most = 0.0
    for k in range(3):
        if sides[k] > 0.0:
            most = max(most, max(high[k], -low[k]) / sides[k])
    return most


@inlined
def steepness(slope: tuple[float, float, float], noise: float) -> float:
    """Return the greatest squared length of a slope of f/2 if residuals are off by `noise`.

    `slope` has three components, per standard deviation. The Jacobian columns have length one in these units.
    """
    a, b, c = abs(slope[0]) + noise, abs(slope[1]) + noise, abs(slope[2]) + noise
    return a * a + b * b + c * c


@compiled
def _laid(cost: Cost, chart: LocalAxes, box: Box) -> tuple[float, float]:
    """Return the cost of a fix moved onto its surface (infinite if impossible), and its rounding; fill the sums.

    The second number bounds the rounding of the length of the residual.
    """
    box.at[:], box.half[:] = 0.0, 0.0
    there, noise = value_at(cost, chart, box), 0.0
    if there < inf:
        noise = rounding_at_centre(cost, chart, box)
        curve_box(cost, chart, box)
    return there, noise


@compiled
def _search_sides(
    cost: Cost,
    around: LocalAxes,
    box: Box,
    known: KnownMinima,
    aim: Goal,
    budget: int,
    boxes: int,
    stack: Array,
) -> tuple[int, int]:
    """Search all pieces of a surface other than the piece of the fix; return the outcome and the boxes in total.

    `around` are the search coordinates of the fix, `boxes` is the number of boxes before, and `budget` the greatest
    number in all. Other arguments are as in `search_boxes` and `prove_locally`. The search ends at the first piece with
    an outcome other than CLEAR.
    """
    corners, outcome = np.empty((2, 3)), CLEAR
    for side in range(1, SIDES):
        chart = axes_of_next_piece(cost, around, side)
        low, high = corners[0], corners[1]
        low[:], high[:] = -inf, inf
        reach_of_piece(chart.surface, chart.origin, chart.sense, low, high)
        minima, sides, count, free = known_minima(cost, chart, box, known, low, high, 0.0, aim.value, False)
        if not aim.level > aim.value:
            count = free
        own = Goal(aim.level, aim.value, aim.better, aim.whole, free, own=0)
        # No hole: the origin of a piece is no minimum.
        size = push_around(stack, 0, low, high, np.zeros(3), 0)
        outcome, more, _ = search_boxes(
            cost, chart, box, minima[:count], sides[:count], own, budget - boxes, stack, size
        )
        boxes += more
        if outcome != CLEAR:
            break
    return outcome, boxes


@inlined
def region_of(
    cost: Cost, chart: LocalAxes, box: Box, rho: float, lower: Array, upper: Array, low: Array, high: Array
) -> bool:
    """Write the corners of the box to search: the region, or an enclosure of all points that cost less than rho^2.

    The corners `low` and `high` (3,) are in search coordinates. The region has the corners `lower` and `upper` (D,),
    metres; if lower[0] is NaN, the enclosure is written. Return False if there is no enclosure.
    """
    if isnan(lower[0]):
        bounded = enclose(cost, chart, box, rho, low, high)
        if chart.surface.shape[0] > 0:  # a surface is bounded by its height
            value = chart.surface[LEVEL]
            around_node(HEIGHT, chart.surface[DATA:MIDDLE], value, value, chart.origin, chart.back, low, high)
        elif not bounded:
            return False
    else:
        for k in range(3):
            middle, reach = 0.0, 0.0
            for m in range(lower.shape[0]):
                middle += chart.back[k, m] * (0.5 * (lower[m] + upper[m]) - chart.origin[m])
                reach += abs(chart.back[k, m]) * 0.5 * (upper[m] - lower[m])
            low[k], high[k] = middle - reach, middle + reach
    widest, size = 0.0, 0.0
    for k in range(3):
        for m in range(3):
            size += abs(chart.sense[k, m]) * max(abs(low[m]), abs(high[m]))
    for k in range(3):
        # By a share, and by the rounding of search coordinates of points at this distance.
        slack = _OUTWARDS * (1.0 + abs(low[k]) + abs(high[k])) if high[k] > low[k] else 0.0
        slack += chart.slip[k] * size
        low[k], high[k] = low[k] - slack, high[k] + slack
        widest = max(widest, abs(low[k]), abs(high[k]))
    return widest < _ENDLESS
