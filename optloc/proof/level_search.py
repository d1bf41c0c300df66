"""The search of boxes for minima below a list of cost levels: one loop for costs with and without unknown factors.

A box is finished if its cost is at least the first level. It is also finished if it contains no minimum, because a
component of the gradient or the curvature has a fixed sign: the least cost over all positions is then attained
elsewhere, if at all. Only the remaining part of a box is searched again. Around known and found minima, boxes follow
the principal axes. A box whose cost exceeds a lower level is postponed until the lower level is shown. So one search
shows as much as the budget allows.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, zero
from optloc.proof.atlas import Atlas, infinity_coordinate, set_centre, with_room_for_minimum
from optloc.proof.box import DEPTH, LEAST, PIECE, exceeds_level, least_left
from optloc.proof.convex_boxes import is_known, widen_core
from optloc.proof.local_search import ANOTHER, CHEAPER, CLEAR, INFINITE, SPENT
from optloc.proof.pieces import CAPACITY, SPARE, is_listed, is_tiny, push_core, push_or_defer, touches_infinity
from optloc.proof.search_space import LocalAxes
from optloc.proof.space import Space, in_atlas, place_of, set_place

# The test for stationary points runs if the cost at the centre is within this many levels. Elsewhere the box is too
# large for the test, or its bound suffices after halving. Over 8 fixes by range differences one level took four times
# as many boxes; a test everywhere took a quarter more time for the same. Over 500 fixes of five stations ten and a
# hundred levels took the same time.
_NEAR = 10.0

# Placeholders for the parts that differ between costs: kernels of these names replace them
# (`optloc.kernels.jit.specialise`).


@compiled
def bound_row(work: Any, space: Space, stack: Array, row: int, level: float) -> tuple[float, float]:
    """Return a bound of the residual in a box of the stack, infinite if excluded, and the cost at its centre.

    `row` is the row of the box in the stack. `level` is the cost from which a box is excluded.
    """
    raise NotImplementedError


@compiled
def side_of_rest(work: Any, space: Space, touching: bool, rho: float, sound: bool) -> int:
    """Return the side across which to halve a contracted box; -1 if no part of the box remains.

    The box is contracted to residuals shorter than rho, and if `sound`, to points that may be minima. `touching` means
    that it reaches infinity. The ends of the remaining part are in ``box.cut``.
    """
    raise NotImplementedError


@compiled
def descend_near(work: Any, chart: LocalAxes) -> float:
    """Move the box around a position to a minimum; return its cost, or infinity if no minimum is reached."""
    raise NotImplementedError


@compiled
def set_rival(
    work: Any, atlas: Atlas, chart: LocalAxes, i: int, x: Array, value: float, eps: float, rho: float
) -> bool:
    """Write minimum i, at x (D,), and the boxes around it into an atlas.

    Return False if x is no minimum or costs less than `value`. In its convex box the cost falls at most `eps` below the
    cost of x. `rho` is the root of the first level, and `chart` the search coordinates around the fix.
    """
    raise NotImplementedError


@compiled
def cost_set(work: Any, atlas: Atlas) -> float:
    """Return the cost at the current centre; the tables of the box are overwritten."""
    raise NotImplementedError


# The search.


@compiled
def search_levels(
    work: Any,
    space: Space,
    stack: Array,
    size: int,
    levels: Array,
    eps: float,
    whole: bool,
    budget: int,
    rivals: Array,
    found: Array,
) -> tuple[int, int, float, int, int]:
    """Search the boxes of a stack for minima that cost less than a level, the lowest level first.

    Parameters
    ----------
    work : NamedTuple
        The cost, and working memory: `box`, and `near` for boxes around a position.
    space : Space
        Space of the boxes: an atlas of all positions, or search coordinates around the fix.
    stack, size : array (CAPACITY, DEPTH), int
        The boxes.
    levels : array (G,)
        Costs to exceed, in descending order; a point that costs less than the last level refutes the fix.
    eps : float
        Cost of the fix minus the last level.
    whole : bool
        Whether a box without a minimum is finished. Otherwise such a box also needs a cost of at least the last level.
    budget : int
        Greatest number of boxes.
    rivals : array (F, D)
        Written: minima that cost less than the first level and were found.
    found : array (D,)
        Written: the point of the outcomes CHEAPER and ANOTHER.

    Returns
    -------
    outcome : int
        CLEAR: no minimum other than known and found ones costs less than a level. CHEAPER: `found` costs less than the
        last level. ANOTHER: `found` is a minimum that costs less than the first level, and no boxes were made around
        it. SPENT: boxes are left. INFINITE: the cost at infinity is below the level.
    boxes : int
        Number of boxes searched.
    bound : float
        A lower bound of f: the last level, unless boxes are left.
    shown : int
        Index of the greatest level that is exceeded.
    met : int
        Number of rivals.
    """
    box, d, value = work.box, space.atlas.dimension, levels[-1]
    aside, waiting, boxes, lows, met = np.empty((CAPACITY, DEPTH)), zero(), 0, 0, zero()
    first, now = zero(), _last_above_zero(levels)
    if now < first:  # no cost is below zero
        return CLEAR, 0, value, first, met
    while True:
        if size == 0:  # no box below this level is left
            if now <= first:
                return CLEAR, boxes, value, now, met
            now -= 1
            size, waiting = _take_back(stack, aside, waiting, levels[now])
            continue
        shown, level = now + 1, levels[first]
        if boxes >= budget or size + SPARE > CAPACITY:
            spent = shown == levels.shape[0]
            return SPENT if spent else CLEAR, boxes, least_left(stack, size) if spent else value, shown, met
        size, boxes, piece = size - 1, boxes + 1, int(stack[size - 1, PIECE])
        low, here = bound_row(work, space, stack, size, level)
        if low == inf:
            continue
        if here < value:
            place_of(space, box, found)
            return CHEAPER, boxes, 0.0, shown, met
        touching = touches_infinity(box, d - 1, infinity_coordinate(space.atlas, piece) if space.far else -inf)
        # The test for minima takes long, and fails in large boxes. It saves halvings only if the cost is low.
        sound = (whole or exceeds_level(low, value)) and here < _NEAR * (level + 1.0)
        side = side_of_rest(work, space, touching, sqrt(max(level, 0.0)), sound)
        if side < 0:
            continue
        lows += int(here < level)
        # At low centre number 1, 2, 4, 8 and so on: minima are found early, with few descents in vain.
        if here < level and lows & (lows - 1) == 0:
            at, half, cut = box.at.copy(), box.half.copy(), box.cut.copy()
            met, size, space = _meet(work, space, levels, first, eps, stack, size, rivals, met, found)
            if met < 0:
                return ANOTHER, boxes, 0.0, shown, 0
            for k in range(3):
                box.at[k], box.half[k], box.cut[k], box.cut[3 + k] = at[k], half[k], cut[k], cut[3 + k]
            set_place(space, box, piece)
        if touching and is_tiny(box, piece, d):
            first = _first_below(levels, first, _at_infinity(work, space.atlas, piece))
            if first > now:
                return CLEAR if shown < levels.shape[0] else INFINITE, boxes, value, shown, met
        size, waiting = push_or_defer(stack, size, aside, waiting, box, side, low, piece, levels[now])


@compiled
def _meet(
    work: Any,
    space: Space,
    levels: Array,
    first: int,
    eps: float,
    stack: Array,
    size: int,
    rivals: Array,
    met: int,
    found: Array,
) -> tuple[int, int, Space]:
    """Descend from the current centre; if the descent ends in an unknown minimum, store it and push boxes around it.

    Return the number of rivals (-1 if no boxes can be made around the minimum), the size of the stack, and the space.
    The arguments are as in `search_levels`; `first` is the index of the first level that can still be shown, and `met`
    the number of rivals before.
    """
    atlas, chart, near, d = space.atlas, space.chart, work.near, space.atlas.dimension
    place_of(space, work.box, found)
    for k in range(3):
        near.at[k] = 0.0
        for m in range(d):
            near.at[k] += chart.back[k, m] * (found[m] - chart.origin[m])
    least = descend_near(work, chart)
    if not least < levels[first]:
        return met, size, space
    if is_listed(atlas, near.centre) if space.far else is_known(near.at, near.half, space.minima, space.sides):
        return met, size, space
    for m in range(d):
        found[m] = near.centre[m]
    if not space.far or met == rivals.shape[0]:
        return -1, size, space
    known, wider, value = atlas.minima.home.shape[0], with_room_for_minimum(atlas), levels[-1]
    # As for known minima, the whole convex box must cost at least the last level, with a margin.
    slack, rho = max(0.5 * (least - value), 0.5 * eps), sqrt(max(levels[0], 0.0))
    if not set_rival(work, wider, chart, known, found, value + 0.5 * slack, 0.5 * slack, rho):
        return -1, size, space
    widen_core(wider, known, inf)
    for k in range(d):
        rivals[met, k] = found[k]
    return met + 1, push_core(stack, size, wider, known), in_atlas(wider, chart)


@compiled
def _at_infinity(work: Any, atlas: Atlas, piece: int) -> float:
    """Return the cost at infinity next to the centre of a box that reaches infinity; its tables are overwritten.

    It is the cost at v = 0, with the other coordinates of the centre.
    """
    at = work.box.at.copy()
    at[atlas.dimension - 1] = infinity_coordinate(atlas, piece)
    set_centre(atlas, piece, at)
    atlas.scale[0] = 0.0
    return cost_set(work, atlas)


# Levels for costs, and boxes that are postponed to a lower level.


@compiled
def _last_above_zero(levels: Array) -> int:
    """Return the index of the last level above zero, or -1 without such a level."""
    last: int = levels.shape[0] - 1
    while last >= 0 and levels[last] <= 0.0:
        last -= 1
    return last


@compiled
def _first_below(levels: Array, first: int, ends: float) -> int:
    """Return the index of the first level, from `first` on, that the cost `ends` reaches, or the number of levels.

    The levels are in descending order. Levels above the cost at infinity cannot be shown.
    """
    while first < levels.shape[0] and ends < levels[first]:
        first += 1
    return first


@compiled
def _take_back(stack: Array, aside: Array, waiting: int, level: float) -> tuple[int, int]:
    """Move the boxes whose bound is below a level from `aside` to the empty stack; return the numbers of boxes on both.

    `waiting` is the number of boxes on `aside`, where they wait for this level.
    """
    size, left = zero(), zero()
    for i in range(waiting):
        if aside[i, LEAST] * aside[i, LEAST] < level:
            stack[size] = aside[i]
            size += 1
        else:
            aside[left] = aside[i]
            left += 1
    return size, left
