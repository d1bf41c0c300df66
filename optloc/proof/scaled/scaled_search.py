"""The search of all positions for minima of a cost with an unknown factors, in the pieces of an atlas."""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, inlined, zero
from optloc.proof.atlas import Atlas, home_of, infinity, one_more, set_centre
from optloc.proof.box import (
    DEPTH,
    PIECE,
    bound_nodes,
    first_below,
    is_empty,
    last_above_zero,
    least_left,
    pop,
    reaches,
    share_left,
    steepest_side,
    take_back,
)
from optloc.proof.convex_boxes import is_known, set_axes, set_hull, widen_core
from optloc.proof.curvature import curve_nodes, most_curved_side, sum_up
from optloc.proof.descents import newton_step
from optloc.proof.everywhere import ANOTHER, CHEAPER, CLEAR, INFINITE, SPENT
from optloc.proof.nodes.dispatch import bound_pieces
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
    touches_infinity,
)
from optloc.proof.scaled.joint_curvature import clip_stationary, is_convex_scaled, slope_of
from optloc.proof.scaled.reduction import (
    HERE,
    Scaled,
    Sheet,
    bound_factors,
    bound_rows,
    clip_rows,
    is_bounded,
    look_at,
    reduce_rows,
    sheet_of,
)
from optloc.proof.search_space import Box, Chart, Cost, empty_box, place, widen
from optloc.proof.space import Space, floor_of, place_of, set_box, set_curves, set_nodes, set_place

# The test for stationary points is made where the cost at the centre is within this number of levels.
_NEAR = 10.0


class Tables(NamedTuple):
    """Working memory: a box of the atlas with its sheet, one around a position, and rows without factors."""

    box: Box
    sheet: Sheet
    near: Box
    look: Cost


@compiled
def tables_of(scaled: Scaled) -> Tables:
    """Return tables for a cost."""
    cost = scaled.cost
    q, J = cost.K.shape
    look = Cost(cost.kinds, cost.data, np.zeros((q, J)), np.zeros(q), cost.A, cost.weight, cost.groups)
    return Tables(empty_box(q, J), sheet_of(scaled), empty_box(q, J), look)


@compiled
def in_atlas(atlas: Atlas, chart: Chart) -> Space:
    """Return an atlas as the space of a search."""
    none = np.empty((0, 3))
    return Space(True, atlas, chart, none, none)


# The cost at a position, and descents.


@compiled
def cost_near(scaled: Scaled, chart: Chart, tables: Tables) -> float:
    """Return the least cost over the factors at the centre of the box around a position; its sums are filled."""
    near, cost = tables.near, scaled.cost
    near.half[:] = 0.0
    place(chart.origin, chart.sense, near.at, near.centre)
    bound_nodes(cost.kinds, cost.data, near.centre, chart.sense, chart.gram, near.half, near.line, near.nodes)
    reduce_rows(scaled, chart.floor, near, tables.sheet)
    look_at(scaled, tables.sheet, near, tables.look)
    curve_nodes(
        cost.kinds,
        cost.data,
        near.centre,
        chart.sense,
        chart.gram,
        near.half,
        near.line,
        near.solve,
        near.nodes,
        near.curves,
    )
    sum_up(tables.look.K, tables.look.w, cost.weight, 0.0, near.nodes, near.curves, near.sums)
    return float(tables.sheet.span[HERE])


# Steps of a descent, the length of the shortest in standard deviations, and damping, as in `optloc.proof.descents`.
_STEPS, _CLOSE, _DAMPING, _LESS, _MORE, _LEAST = 40, 1e-3, 1e-6, 0.1, 10.0, 1e-4
_SAME_COST = 1e-13


@compiled
def descend_scaled(scaled: Scaled, chart: Chart, tables: Tables) -> float:
    """Move the box around a position to a minimum; return its cost, or infinity where none is reached."""
    near = tables.near
    now, damping, start = cost_near(scaled, chart, tables), _DAMPING, near.at.copy()
    for _ in range(_STEPS):
        length = newton_step(tables.look, near, damping)
        if not length >= 0.0:
            return inf
        for k in range(3):
            start[k] = near.at[k]
            near.at[k] -= near.solve[0, k]
        after = cost_near(scaled, chart, tables)
        if after <= now + _SAME_COST * (1.0 + now):
            now = after
            if length < _CLOSE * _CLOSE:
                return now
            damping *= _LESS
        else:
            for k in range(3):
                near.at[k] = start[k]
            damping = max(_MORE * damping, _LEAST)
            now = cost_near(scaled, chart, tables)
    return inf


# Known minima.

# First half-widths of a convex box, standard deviations, and its growth; the surroundings that are searched along its
# axes, as in `optloc.proof.convex_boxes`.
_FIRST, _GROWTH, _WIDEST, _WIDER, _WIDE = 3.0, 2.0, 1e4, 3.0, 3.0
_SMALLEST = 1e-6  # standard deviations: a smaller box holds only rounding


@compiled
def _convex(
    scaled: Scaled, tables: Tables, space: Space, piece: int, at: Array, half: Array, rho: float, margin: float
) -> bool:
    """Return whether the cost has one minimum on a box around a minimum."""
    box = tables.box
    for k in range(3):
        box.at[k], box.half[k] = at[k], half[k]
    _fill(scaled, tables, space, piece, floor_of(space, scaled.cost))
    if not bound_factors(scaled, rho, box, tables.sheet):
        return True
    set_curves(space, scaled.cost, box)
    return is_convex_scaled(scaled, margin, box, tables.sheet)


@inlined
def _fill(scaled: Scaled, tables: Tables, space: Space, piece: int, floor: float) -> None:
    """Set the centre of a box, bound its nodes and reduce its rows."""
    set_place(space, tables.box, piece)
    set_nodes(space, scaled.cost, tables.box)
    reduce_rows(scaled, floor, tables.box, tables.sheet)


@compiled
def set_scaled_minimum(
    scaled: Scaled, tables: Tables, atlas: Atlas, chart: Chart, i: int, x: Array, value: float, eps: float, rho: float
) -> bool:
    """Write a minimum and its surroundings into an atlas; return False if it is no minimum or costs too little.

    Parameters
    ----------
    scaled, tables : Scaled, Tables
        The cost, and working memory.
    chart : Chart
        Search coordinates around the fix.
    atlas, i, x, value, eps
        As of `optloc.proof.convex_boxes.set_minimum`.
    rho : float
        Longest residual of interest.
    """
    minima, d, hull = atlas.minima, atlas.dimension, np.zeros(3)
    space, piece = in_atlas(atlas, chart), 2 * d + 1 + i
    minima.home[i] = home_of(atlas, x, minima.start[i])
    minima.axes[i, :], minima.back[i, :] = 0.0, 0.0
    for k in range(3):
        minima.axes[i, k, k] = minima.back[i, k, k] = 1.0
    tables.box.at[:] = 0.0
    tables.box.half[:] = 0.0
    _fill(scaled, tables, space, piece, floor_of(space, scaled.cost))
    look_at(scaled, tables.sheet, tables.box, tables.look)
    if not tables.sheet.span[HERE] >= value or not set_axes(tables.look, tables.box, atlas, i):
        return False
    if not _convex(scaled, tables, space, piece, np.zeros(3), hull, rho, 0.0):
        return False
    margin, sides, core = slope_of(tables.box, eps), minima.sides[i], minima.core[i]
    set_hull(atlas, i, hull, inf)
    if not _grow(scaled, tables, space, piece, np.zeros(3), hull, rho, margin, sides):
        return False
    for k in range(d):
        core[1, k] = min(max(_WIDER * sides[k], _WIDE), hull[k])
        core[0, k] = -core[1, k]
    return True


@compiled
def set_near_minimum(
    scaled: Scaled, tables: Tables, space: Space, i: int, hull: Array, value: float, eps: float, rho: float
) -> bool:
    """Write the half-widths of a box around minimum i of search coordinates; return False if it is no minimum.

    Parameters
    ----------
    scaled, tables, space : Scaled, Tables, Space
        The cost, working memory, and search coordinates, in which the minimum is written.
    i, hull : int, array (3,)
        Which minimum, and half-widths beyond which nothing is searched.
    value, eps, rho
        As of `set_scaled_minimum`.
    """
    at, sides, shift = space.minima[i], space.sides[i], np.zeros(3)
    if not _convex(scaled, tables, space, 0, at, np.zeros(3), rho, 0.0) or not tables.sheet.span[HERE] >= value:
        return False
    margin = slope_of(tables.box, eps)
    if not _grow(scaled, tables, space, 0, at, hull, rho, margin, sides):
        return False
    widen(space.chart, tables.box.centre, shift)
    for k in range(3):
        sides[k] = max(sides[k] - shift[k], 0.0)
    return True


@compiled
def _grow(
    scaled: Scaled,
    tables: Tables,
    space: Space,
    piece: int,
    at: Array,
    hull: Array,
    rho: float,
    margin: float,
    sides: Array,
) -> bool:
    """Write the sides of a convex box around a minimum; return False where there is no box."""
    size = _FIRST
    while not _convex(scaled, tables, space, piece, at, np.minimum(hull, size), rho, margin):
        size *= 0.5
        if size < _SMALLEST:
            return False
    while size < _WIDEST and _convex(scaled, tables, space, piece, at, np.minimum(hull, _GROWTH * size), rho, margin):
        size *= _GROWTH
    for k in range(3):
        sides[k] = min(hull[k], size)
    for k in range(space.atlas.dimension):
        trial = sides.copy()
        trial[k] = min(_GROWTH * sides[k], hull[k])
        while trial[k] > sides[k] and _convex(scaled, tables, space, piece, at, trial, rho, margin):
            sides[k] = trial[k]
            trial[k] = min(_GROWTH * sides[k], hull[k])
    return True


# The search.


@compiled
def search_scaled(
    scaled: Scaled,
    tables: Tables,
    space: Space,
    stack: Array,
    size: int,
    levels: Array,
    eps: float,
    budget: int,
    rivals: Array,
    found: Array,
) -> tuple[int, int, float, int, int]:
    """Search the boxes of a stack for minima that cost less than a level, the lowest level first.

    Parameters
    ----------
    scaled, tables : Scaled, Tables
        The cost, and working memory.
    space : Space
        Where the boxes are: an atlas of all positions, or search coordinates around the fix.
    stack, size : array (CAPACITY, DEPTH), int
        The boxes.
    levels, eps, budget, rivals, found
        As of `optloc.proof.everywhere.search_everywhere`.

    Returns
    -------
    outcome, boxes, bound, shown, met
        As of `optloc.proof.everywhere.search_everywhere`.
    """
    box, sheet, d, value = tables.box, tables.sheet, space.atlas.dimension, levels[-1]
    aside, waiting, boxes, lows, met = np.empty((CAPACITY, DEPTH)), zero(), 0, 0, zero()
    floor, first, now, end = floor_of(space, scaled.cost), zero(), last_above_zero(levels), -inf
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
        end = infinity(space.atlas, piece) if space.far else -inf
        low = _bound_of_row(scaled, tables, space, level, floor, end, stack, size)
        if low == inf:
            continue
        here = sheet.span[HERE]
        if here < value:
            place_of(space, box, found)
            return CHEAPER, boxes, 0.0, shown, met
        touching = touches_infinity(box, d - 1, end)
        side = _side_of_rest(scaled, tables, space, touching, sqrt(max(level, 0.0)), here < _NEAR * (level + 1.0))
        if side < 0:
            continue
        lows += int(here < level)
        # At the first, second, fourth, eighth ... low centre: found early, and seldom looked for in vain.
        if here < level and lows & (lows - 1) == 0:
            cut, at, half = box.cut.copy(), box.at.copy(), box.half.copy()
            met, size, space = _meet(scaled, tables, space, levels, first, eps, stack, size, rivals, met, found)
            if met < 0:
                return ANOTHER, boxes, 0.0, shown, 0
            for k in range(3):
                box.at[k], box.half[k], box.cut[k], box.cut[3 + k] = at[k], half[k], cut[k], cut[3 + k]
            set_place(space, box, piece)
        if touching and is_tiny(box, piece, d):
            first = first_below(levels, first, _at_infinity(scaled, tables, space.atlas, piece, floor))
            if first > now:
                return CLEAR if shown < levels.shape[0] else INFINITE, boxes, value, shown, met
        size, waiting = keep_rest(stack, size, aside, waiting, box, side, low, piece, levels[now])


@compiled
def _bound_of_row(
    scaled: Scaled, tables: Tables, space: Space, level: float, floor: float, end: float, stack: Array, row: int
) -> float:
    """Return a lower bound of the residual in a box of the stack, infinite where all costs exceed a level."""
    box, piece = tables.box, int(stack[row, PIECE])
    pop(stack, row, box.at, box.half)
    end_at_infinity(box, space.atlas.dimension - 1, end)
    set_box(space, box, piece)
    if is_left(space.atlas, box, piece) if space.far else is_known(box.at, box.half, space.minima, space.sides):
        return inf
    set_nodes(space, scaled.cost, box)
    reduce_rows(scaled, floor, box, tables.sheet)
    if not bound_factors(scaled, sqrt(max(level, 0.0)), box, tables.sheet):
        return inf
    low = bound_rows(scaled, box, tables.sheet)
    return inf if reaches(low, level) else low


@compiled
def _side_of_rest(scaled: Scaled, tables: Tables, space: Space, touching: bool, rho: float, sound: bool) -> int:
    """Return the side across which to halve what of a box may hold a minimum; -1 for nothing of it."""
    box, sheet, d = tables.box, tables.sheet, space.atlas.dimension
    if not is_bounded(sheet):
        for k in range(3):
            box.cut[k], box.cut[3 + k] = -box.half[k], box.half[k]
        return _widest(box.half)
    clip_rows(scaled, rho, box, sheet)
    if is_empty(box.cut):
        return -1
    side = int(steepest_side(box.half, sheet.rows, d))
    if not sound or touching or share_left(box.cut, box.half) <= SHRUNK:
        return side
    low, high = box.cut[:3].copy(), box.cut[3:].copy()
    set_curves(space, scaled.cost, box)
    box.sums[:] = 0.0
    if not clip_stationary(scaled, box, sheet):
        return -1
    for k in range(3):
        box.cut[k], box.cut[3 + k] = max(box.cut[k], low[k]), min(box.cut[3 + k], high[k])
    if is_empty(box.cut):
        return -1
    curved = most_curved_side(box.half, box.sums, d)
    return int(curved if curved >= 0 else side)


@inlined
def _widest(half: Array) -> int:
    """Return the widest side of a box."""
    if half[0] >= half[1] and half[0] >= half[2]:
        return 0
    return 1 if half[1] >= half[2] else 2


@compiled
def _meet(
    scaled: Scaled,
    tables: Tables,
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
    """Descend from the centre set; where that ends in another minimum, write it and push boxes around it.

    Returns the number of rivals, -1 where one cannot be searched around; the size of the stack; the space.
    """
    atlas, chart, near, d = space.atlas, space.chart, tables.near, space.atlas.dimension
    place_of(space, tables.box, found)
    for k in range(3):
        near.at[k] = 0.0
        for m in range(d):
            near.at[k] += chart.back[k, m] * (found[m] - chart.origin[m])
    least = descend_scaled(scaled, chart, tables)
    known = is_listed(atlas, near.centre) if space.far else is_known(near.at, near.half, space.minima, space.sides)
    if not least < levels[first] or known:
        return met, size, space
    for m in range(d):
        found[m] = near.centre[m]
    if not space.far or met == rivals.shape[0]:
        return -1, size, space
    count, wider, value = atlas.minima.home.shape[0], one_more(atlas), levels[-1]
    slack, rho = max(0.5 * (least - value), 0.5 * eps), sqrt(max(levels[0], 0.0))
    if not set_scaled_minimum(scaled, tables, wider, chart, count, found, value + 0.5 * slack, 0.5 * slack, rho):
        return -1, size, space
    widen_core(wider, count, inf)
    for k in range(d):
        rivals[met, k] = found[k]
    return met + 1, push_core(stack, size, wider, count), in_atlas(wider, chart)


@compiled
def _at_infinity(scaled: Scaled, tables: Tables, atlas: Atlas, piece: int, floor: float) -> float:
    """Return the cost at infinity next to the centre of a box that reaches there; its tables are lost."""
    at = tables.box.at.copy()
    at[atlas.dimension - 1] = infinity(atlas, piece)
    set_centre(atlas, piece, at)
    atlas.scale[0] = 0.0
    bound_pieces(atlas, scaled.cost.kinds, scaled.cost.data, tables.box.half, tables.box.nodes)
    reduce_rows(scaled, floor, tables.box, tables.sheet)
    return float(tables.sheet.span[HERE])
