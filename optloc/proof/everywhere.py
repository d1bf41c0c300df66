"""The proof for all positions: an enclosure where there is one, else the atlas of all space."""

from __future__ import annotations

from math import inf, isnan, nan, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, inlined, put, zero
from optloc.proof.atlas import (
    Atlas,
    atlas_of,
    clip_to_corners,
    first_minima,
    infinity,
    one_more,
    position,
    set_centre,
    widen_around,
    with_minima,
)
from optloc.proof.box import (
    DEPTH,
    PIECE,
    cost_at,
    cube,
    cut_out,
    digits,
    first_below,
    is_empty,
    last_above_zero,
    least_left,
    least_residual,
    linearise_rows,
    pop,
    reaches,
    reaches_infinity,
    rounding,
    share_left,
    shrink,
    steepest_side,
    take_back,
    uncut,
)
from optloc.proof.convex_boxes import accuracy_floor_far, set_minimum, widen_core
from optloc.proof.curvature import has_no_infimum, most_curved_side, spread_of, sum_up
from optloc.proof.descents import descend
from optloc.proof.near import BETTER, BUDGET, COARSE, OPEN, OTHER, SINGULAR, STATIONARY, UNIQUE, VALUE, prove, region_of
from optloc.proof.nodes.dispatch import bound_pieces, curve_pieces
from optloc.proof.pieces import (
    CAPACITY,
    SHRUNK,
    SPARE,
    end_at_infinity,
    is_left,
    is_listed,
    is_tiny,
    keep_rest,
    push_core,
    push_pieces,
    touches_infinity,
)
from optloc.proof.search_space import (
    COARSEST,
    HIDDEN_REACH,
    Box,
    Chart,
    Cost,
    Known,
    chart_at,
    empty_box,
    equal_within,
)
from optloc.proof.squares import Squares, bend_of, clip_to_squares, squares_of

# Branch and bound over all positions, for costs that nothing encloses.

# What a search finds: nothing, a cheaper point, another minimum below the level, no end within the budget, or a cost at
# infinity below the level.
CLEAR, CHEAPER, ANOTHER, SPENT, INFINITE = range(5)
# The test for stationary points is made where the cost at the centre is within so many levels: elsewhere the box is too
# large, or its bound will do when it is halved. Over 8 fixes by range differences one level took four times as many
# boxes; a test everywhere took a quarter more time for the same. Over 500 fixes of five stations ten and a hundred
# levels took the same time.
_NEAR = 10.0
# How often in turn a box is clipped to its squared rows, while that takes off half: from all of a face three times do.
_LOOKS = 8
# What ranges bend over a box, squared and over the level, from which on its squared rows are looked at. Over 100 fixes
# of five stations a ninth took 4 % fewer boxes for twice as many looks, and ten times as much 8 % more.
_BENT = 9.0


@compiled
def search_everywhere(
    cost: Cost,
    atlas: Atlas,
    chart: Chart,
    corners: Array,
    squares: Squares,
    levels: Array,
    eps: float,
    whole: bool,
    budget: int,
    rivals: Array,
    found: Array,
) -> tuple[int, int, float, int, int]:
    """Search all positions but some boxes for minima that cost less than a level, the lowest level first.

    A box is done where the cost is at least the first level, or where it has no minimum, its gradient or its curvature
    being of one sign: the least cost over all positions, if it is attained, is attained elsewhere. What of a box can be
    neither is all that is looked at again. Around known minima boxes lie along their principal axes, and around those
    that are met as well. Boxes that cost more than a lower level wait until that is shown: so one tree tells how far
    the budget goes.

    Parameters
    ----------
    cost : Cost
        The cost; `optloc.proof.box.reaches_infinity` holds.
    atlas : Atlas
        The pieces, known minima among them.
    chart : Chart
        Search coordinates around the fix, in which low points descend.
    corners : array (2, 3)
        Corners in these coordinates beyond which the cost is at least the first level; NaN where none are known.
    squares : Squares
        Squared rows, of which boxes are clipped.
    levels : array (G,)
        Costs to exceed, falling; a point that costs less than the last refutes the fix.
    eps : float
        How far the last is below the cost of the fix.
    whole : bool
        Whether a box is done as well where it has no minimum; otherwise only if it costs at least the last level.
    budget : int
        How many boxes may be looked at.
    rivals : array (F, D)
        Written: minima that cost less than the first level and were met.
    found : array (D,)
        Written: the point of the outcomes CHEAPER and ANOTHER.

    Returns
    -------
    outcome : int
        CLEAR: no minimum beside those known and met costs less than a level. CHEAPER: `found` costs less than the
        last. ANOTHER: `found` is a minimum that costs less than the first, and was not searched around. SPENT: boxes
        are left. INFINITE: the cost at infinity is below the level.
    boxes : int
        How many boxes were looked at.
    bound : float
        A lower bound of f: the last level, unless boxes are left.
    shown : int
        Which of the levels is exceeded.
    met : int
        How many rivals there are.
    """
    box, near = empty_box(cost.K.shape[0], cost.K.shape[1]), empty_box(cost.K.shape[0], cost.K.shape[1])
    stack, aside, d = np.empty((CAPACITY, DEPTH)), np.empty((CAPACITY, DEPTH)), atlas.dimension
    size, waiting, boxes, lows, met = push_pieces(stack, atlas), zero(), 0, 0, zero()
    floor, first, now, value = accuracy_floor_far(cost, atlas), zero(), last_above_zero(levels), levels[-1]
    if now < first:  # no cost is below zero
        return CLEAR, 0, value, first, met
    while True:
        if size == 0:  # nothing below this level is left
            if now <= first:
                return CLEAR, boxes, value, now, met
            now -= 1
            size, waiting = take_back(stack, aside, waiting, levels[now])
            continue
        shown, level = now + 1, levels[first]
        if boxes >= budget or size + SPARE > CAPACITY:
            spent = shown == levels.shape[0]
            return SPENT if spent else CLEAR, boxes, least_left(stack, size) if spent else value, shown, met
        size, boxes, piece = size - 1, boxes + 1, int(stack[size - 1, PIECE])
        low = _bound_of_row(cost, atlas, chart, corners, squares, level, floor, box, stack, size)
        if low == inf:
            continue
        here, noise = cost_at(cost.K, cost.w, box.nodes), rounding(cost.K, cost.weight, floor, box.nodes)
        if here < value:
            position(atlas, found)
            return CHEAPER, boxes, 0.0, shown, met
        touching = touches_infinity(box, d - 1, infinity(atlas, piece))
        # The test for minima is dear, and fails in large boxes: only where the cost is low it can spare splits.
        sound = (whole or reaches(low, value)) and here < _NEAR * (level + 1.0)
        side = _side_of_rest(cost, atlas, box, touching, sqrt(max(level, 0.0)), noise, sound)
        if side < 0:
            continue
        lows += int(here < level)
        # At the first, second, fourth, eighth ... low centre: found early, and seldom looked for in vain.
        if here < level and lows & (lows - 1) == 0:
            met, size, atlas = _meet(cost, atlas, chart, near, levels, first, eps, stack, size, rivals, met, found)
            if met < 0:
                return ANOTHER, boxes, 0.0, shown, 0
            set_centre(atlas, piece, box.at)
        if touching and is_tiny(box, piece, d):
            first = first_below(levels, first, _at_infinity(cost, atlas, box, piece))
            if first > now:
                return CLEAR if shown < levels.shape[0] else INFINITE, boxes, value, shown, met
        size, waiting = keep_rest(stack, size, aside, waiting, box, side, low, piece, levels[now])


@compiled
def _bound_of_row(
    cost: Cost,
    atlas: Atlas,
    chart: Chart,
    corners: Array,
    squares: Squares,
    level: float,
    floor: float,
    box: Box,
    stack: Array,
    row: int,
) -> float:
    """Return a lower bound of the residual in a box of the stack, infinite where all costs exceed a level."""
    piece = int(stack[row, PIECE])
    if not _take(stack, row, atlas, chart, corners, box, piece):
        return inf
    if not _squeeze(cost, atlas, squares, level, box, piece):
        return inf
    low = _bound(cost, atlas, box, floor)
    return inf if reaches(low, level) else low


@inlined
def _bound(cost: Cost, atlas: Atlas, box: Box, floor: float) -> float:
    """Return a lower bound of the residual's length over a box whose centre is set; its tables are filled."""
    bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    return least_residual(cost.K, cost.weight, floor, box.half, box.nodes, box.rows)


@inlined
def _side_of_rest(cost: Cost, atlas: Atlas, box: Box, touching: bool, rho: float, noise: float, sound: bool) -> int:
    """Return the side across which to halve what of a box may hold a residual shorter than rho; -1 for nothing of it.

    Nor may it be without a minimum, where that is `sound`. What is left are the ends of ``box.cut``.
    """
    uncut(box.half, box.cut)
    flat = box.half[2] == 0.0
    shrink(cost.K, cost.weight, rho + noise, box.half, flat, box.nodes, box.rows, box.cut, box.solve)
    if is_empty(box.cut):
        return -1
    # What that leaves little of is looked at anew, which is cheaper.
    if not sound or share_left(box.cut, box.half) <= SHRUNK:
        return int(steepest_side(box.half, box.rows, atlas.dimension))
    if _clips_away(cost, atlas, box, touching, noise):
        return -1
    curved = most_curved_side(box.half, box.sums, atlas.dimension)
    return int(curved if curved >= 0 else steepest_side(box.half, box.rows, atlas.dimension))


@compiled
def _meet(
    cost: Cost,
    atlas: Atlas,
    chart: Chart,
    near: Box,
    levels: Array,
    first: int,
    eps: float,
    stack: Array,
    size: int,
    rivals: Array,
    met: int,
    found: Array,
) -> tuple[int, int, Atlas]:
    """Descend from the centre set; where that ends in another minimum, write it and push boxes around it.

    Returns how many rivals there are, -1 where that one cannot be searched around; the size of the stack; the atlas.
    """
    if not _another(cost, atlas, chart, near, levels[first], found):
        return met, size, atlas
    known, wider, value = atlas.minima.home.shape[0], one_more(atlas), levels[-1]
    # As of those that are known all its convex box must cost at least what nothing may fall short of.
    slack = max(0.5 * (cost_at(cost.K, cost.w, near.nodes) - value), 0.5 * eps)
    if met == rivals.shape[0] or not set_minimum(
        cost, near, wider, known, found, value + 0.5 * slack, 0.5 * slack, inf
    ):
        return -1, size, atlas
    widen_core(wider, known, inf)
    for k in range(atlas.dimension):
        rivals[met, k] = found[k]
    return met + 1, push_core(stack, size, wider, known), wider


@inlined
def _take(stack: Array, row: int, atlas: Atlas, chart: Chart, corners: Array, box: Box, piece: int) -> bool:
    """Take a box off the stack and set its centre; return False where nothing of it is to be looked at.

    What lies beyond the corners, if they are known, is left out.
    """
    faces = 2 * atlas.dimension
    pop(stack, row, box.at, box.half)
    end_at_infinity(box, atlas.dimension - 1, infinity(atlas, piece))
    set_centre(atlas, piece, box.at)
    if piece > faces:
        widen_around(atlas, piece - faces - 1, box.half)
    if is_left(atlas, box, piece):
        return False
    if isnan(corners[0, 0]):
        return True
    uncut(box.half, box.cut)
    clip_to_corners(atlas, chart.origin, chart.back, corners, box.half, box.cut)
    share = cut_out(box.cut, box.at, box.half)
    if 0.0 < share < 1.0:
        end_at_infinity(box, atlas.dimension - 1, infinity(atlas, piece))
        set_centre(atlas, piece, box.at)
    return share > 0.0


@compiled
def _squeeze(cost: Cost, atlas: Atlas, squares: Squares, level: float, box: Box, piece: int) -> bool:
    """Clip a box whose centre is set to its squared rows, again while that helps; return whether anything is left."""
    if squares.groups == 0 or bend_of(atlas, squares, box.half) ** 2 <= _BENT * level:
        return True
    for _ in range(_LOOKS):
        if not clip_to_squares(cost, atlas, squares, sqrt(max(level, 0.0)), box):
            return False
        share = cut_out(box.cut, box.at, box.half)
        if not share > 0.0:
            return False
        if share < 1.0:
            end_at_infinity(box, atlas.dimension - 1, infinity(atlas, piece))
            set_centre(atlas, piece, box.at)
        if share > SHRUNK:
            break
    return True


@compiled
def _another(cost: Cost, atlas: Atlas, chart: Chart, near: Box, level: float, found: Array) -> bool:
    """Return whether the centre of a box descends to a minimum below the level that is not known, and write it."""
    d = atlas.dimension
    position(atlas, found)
    for k in range(3):
        near.at[k] = 0.0
        for m in range(d):
            near.at[k] += chart.back[k, m] * (found[m] - chart.origin[m])
    if not descend(cost, chart, near) < level:
        return False
    if is_listed(atlas, near.centre):
        return False
    for m in range(d):
        found[m] = near.centre[m]
    return True


@compiled
def leaves(cost: Cost, atlas: Atlas, box: Box, touching: bool, floor: float) -> bool:
    """Return whether no infimum of the cost can lie in a box whose nodes are bounded; `touching`: infinity is there."""
    uncut(box.half, box.cut)
    return _clips_away(cost, atlas, box, touching, rounding(cost.K, cost.weight, floor, box.nodes))


@inlined
def _clips_away(cost: Cost, atlas: Atlas, box: Box, touching: bool, noise: float) -> bool:
    """Return the same as `leaves` of the part between the ends of ``box.cut``, clipped to where an infimum may lie."""
    curve_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes, box.curves)
    sum_up(cost.K, cost.w, cost.weight, noise, box.nodes, box.curves, box.sums)
    ball = spread_of(cost.A, box.half, box.nodes, box.curves, box.sums)
    return has_no_infimum(atlas.dimension, touching, box.half, box.sums, ball, box.cut, box.solve)


@compiled
def _at_infinity(cost: Cost, atlas: Atlas, box: Box, piece: int) -> float:
    """Return the cost at infinity next to the centre of a box that reaches there; its table of nodes is lost."""
    at = box.at.copy()
    at[atlas.dimension - 1] = infinity(atlas, piece)
    set_centre(atlas, piece, at)
    atlas.scale[0] = 0.0
    bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
    return cost_at(cost.K, cost.w, box.nodes)


# A verdict beside those of `optloc.proof.near`: the cost at infinity is within the gap.
UNBOUNDED = 8
# How many times as large as the convex box around the fix an enclosure may be for its search to be tried, of a fix
# between the stations and of others, and boxes after which that is given up for the atlas. What is six times as large
# takes some sixteen boxes, as an atlas of a fix outside does; of what is fifty times as large few end with a hundred.
_REACH, _REACH_OUTSIDE, _SOON = 50.0, 6.0, 100
# Distance, relative to that of the fix, within which two minima are the same: a descent's own accuracy.
_CLOSE = 1e-3


@inlined
def prove_everywhere(
    cost: Cost, box: Box, x: Array, beside: Known, gaps: Array, eps: float, budget: int, rivals: Array, found: Array
) -> tuple[int, int, float, float, int]:
    """Prove that no position costs less than a fix, and that no other minimum has a gap below as much as can be shown.

    The claim is for all positions, to infinity. Where something encloses the cheap ones, that is searched first; where
    nothing does, or the search does not end soon, and the cost stays finite at infinity, the atlas of all space: along
    inverse ranges a long valley is straight, and the cost convex on wider boxes.

    Parameters
    ----------
    cost, box, x, beside, eps, budget, found
        As of `optloc.proof.near.prove`.
    gaps : array (G,)
        Gaps that will do, falling, the last 0 for the value alone. Only the atlas tries more than the first.
    rivals : array (F, D)
        Written: minima within the first gap that were met, and beside which the claim holds.

    Returns
    -------
    verdict : int
        As of `optloc.proof.near.prove`. UNBOUNDED: the cost at infinity is below that of the fix plus every gap.
    boxes : int
        How many boxes were looked at.
    bound : float
        A certified lower bound of f over all positions; -inf where there is none.
    gap : float
        The gap that is proven, or where none is the smallest that was tried.
    met : int
        How many rivals there are.
    """
    nowhere, bound_to = np.full(x.shape[0], np.nan), beside.planes.shape[0] + beside.surface.shape[0] > 0
    open_end = not bound_to and reaches_infinity(cost.kinds, cost.K)  # the atlas is of all space
    first, reach = (min(budget, _SOON), _reach_of(cost, x)) if open_end else (budget, inf)
    verdict, boxes, bound = prove(cost, box, x, beside, gaps[0], eps, first, reach, nowhere, nowhere, False, found)
    again = verdict in (OPEN, BUDGET, STATIONARY, SINGULAR) or (verdict == OTHER and _listed(x, beside.points, found))
    if not open_end or not again or boxes >= budget:
        return verdict, boxes, bound, gaps[0], 0
    verdict, more, bound, gap, met = prove_atlas(cost, box, x, beside, gaps, eps, budget - boxes, rivals, found)
    return verdict, boxes + more, bound, gap, met


@compiled
def _reach_of(cost: Cost, x: Array) -> float:
    """Return how many times as large as a convex box an enclosure may be for its search to be tried."""
    middle, radius = cube(cost.kinds, cost.data, x)
    between = True
    for k in range(x.shape[0]):
        between = between and abs(x[k] - middle[k]) < radius
    return _REACH if between else _REACH_OUTSIDE


@compiled
def prove_atlas(
    cost: Cost, box: Box, x: Array, beside: Known, gaps: Array, eps: float, budget: int, rivals: Array, found: Array
) -> tuple[int, int, float, float, int]:
    """Prove the same as `prove_everywhere` with the atlas alone, where `optloc.proof.box.reaches_infinity` holds."""
    chart, _ = chart_at(cost, x, box)
    least, corners, nowhere = cost_at(cost.K, cost.w, box.nodes), np.empty((2, 3)), np.full(x.shape[0], nan)
    noise = rounding(cost.K, cost.weight, chart.floor, box.nodes)
    if not region_of(cost, chart, box, sqrt(least + gaps[0]), nowhere, nowhere, corners[0], corners[1]):
        corners[:] = nan
    others = beside.points
    middle, radius = cube(cost.kinds, cost.data, x)
    squares = squares_of(cost, box, middle, radius)
    atlas = atlas_of(middle, radius, x.shape[0], 1 + (others.shape[0] if gaps[0] > 0.0 else 0))
    most, noise = max(COARSEST, eps), max(noise, digits(cost.K) * accuracy_floor_far(cost, atlas))
    eps = equal_within(eps, least, noise)
    if not eps <= most:
        return COARSE, 0, -inf, gaps[0], 0
    known, place = zero(), np.empty(x.shape[0])
    for p in range(atlas.minima.home.shape[0]):
        put(x if p == 0 else others[p - 1], place)
        hidden = p > others.shape[0] - beside.hidden
        least_here, limit = (-inf, HIDDEN_REACH) if hidden else (least - 0.5 * eps, inf)
        if set_minimum(cost, box, atlas, known, place, least_here, 0.5 * eps, limit):
            widen_core(atlas, known, limit)
            known += 1
        elif p == 0:
            return STATIONARY, 0, -inf, gaps[0], 0
    atlas = with_minima(middle, radius, x.shape[0], first_minima(atlas.minima, known))
    levels = np.empty(gaps.shape[0])
    for k in range(gaps.shape[0]):
        levels[k] = least + gaps[k] if gaps[k] > 0.0 else least - eps
    whole = beside.hidden == 0
    outcome, boxes, bound, shown, met = search_everywhere(
        cost, atlas, chart, corners, squares, levels, eps, whole, budget, rivals, found
    )
    return verdict_of(outcome, boxes, bound, shown, met, gaps, least - eps)


@inlined
def verdict_of(
    outcome: int, boxes: int, bound: float, shown: int, met: int, gaps: Array, least: float
) -> tuple[int, int, float, float, int]:
    """Return the results of `prove_everywhere` for the outcome of a search; `least` is the lowest level."""
    if outcome == CLEAR:
        return UNIQUE if gaps[shown] > 0.0 else VALUE, boxes, bound, gaps[shown], met
    if outcome == CHEAPER:
        return BETTER, boxes, bound, gaps[0], 0
    if outcome == ANOTHER:
        return OTHER, boxes, bound, gaps[0], 0
    return UNBOUNDED if outcome == INFINITE else BUDGET, boxes, min(bound, least), gaps[-1], 0


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
