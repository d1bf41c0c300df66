"""The search of all positions for minima of a cost with unknown factors, in the pieces of an atlas.

For the cost, its factors and the reduced rows see `optloc.proof.scaled.reduction`; for the search itself
`optloc.proof.level_search`.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined, specialise, zero
from optloc.proof.atlas import Atlas, infinity_coordinate, piece_of
from optloc.proof.box import (
    PIECE,
    bound_nodes,
    contract_box,
    cost_at,
    exceeds_level,
    is_empty,
    least_residual,
    linearise_rows,
    pop,
    reset_cut,
    rounding_error,
    share_left,
    steepest_side,
    widest,
)
from optloc.proof.convex_boxes import is_known, set_axes, set_hull
from optloc.proof.curvature import most_curved_side, sum_up
from optloc.proof.descents import newton_step
from optloc.proof.level_search import bound_row, cost_set, descend_near, search_levels, set_rival, side_of_rest
from optloc.proof.nodes.dispatch import bound_pieces
from optloc.proof.nodes.node import PHI
from optloc.proof.pieces import (
    SHRUNK,
    contract_at_infinity,
    is_left,
)
from optloc.proof.scaled.joint_curvature import clip_stationary, is_convex_scaled, slope_of
from optloc.proof.scaled.reduction import (
    HERE,
    Scaled,
    ScaledWorkspace,
    bound_factors,
    bound_rows,
    clip_rows,
    is_bounded,
    reduce_rows,
    workspace_of,
)
from optloc.proof.search_space import (
    Box,
    Cost,
    LocalAxes,
    cost_of,
    curve_at,
    empty_box,
    widen_by_rounding,
    write_centre,
)
from optloc.proof.space import Space, floor_of, in_atlas, set_box, set_curves, set_nodes, set_place


class ScaledTables(NamedTuple):
    """Working memory of a search.

    `box` is a box of the atlas, and `sheet` its reduced rows. `near` is a box around a position, and `look` has rows
    without factors (see `look_at`).
    """

    box: Box
    sheet: ScaledWorkspace
    near: Box
    look: Cost


@compiled
def tables_of(scaled: Scaled) -> ScaledTables:
    """Return working memory for a cost."""
    cost = scaled.cost
    q, J = cost.K.shape
    look = Cost(cost.kinds, cost.data, np.zeros((q, J)), np.zeros(q), cost.A, cost.weight, cost.groups)
    return ScaledTables(empty_box(q, J), workspace_of(scaled), empty_box(q, J), look)


# The cost at a position, and descents.


@compiled
def look_at(scaled: Scaled, sheet: ScaledWorkspace, box: Box, look: Cost) -> None:
    """Write rows without factors that have the same cost, slope and information at a point whose rows are reduced.

    The rows are written into `look`, so that functions for costs without factors apply to them.
    """
    J = box.nodes.shape[0]
    for i in range(sheet.K.shape[0]):
        total = sheet.w[i]
        for j in range(J):
            g = scaled.group[j]
            factor = 1.0 if g < 0 else (sheet.best[g] if scaled.free else max(sheet.best[g], 0.0))
            look.K[i, j] = factor * sheet.K[i, j]
            total += look.K[i, j] * box.nodes[j, PHI]
        look.w[i] = total


@compiled
def cost_near(scaled: Scaled, chart: LocalAxes, tables: ScaledTables) -> float:
    """Return the least cost over the factors at the centre of the box around a position; fill its sums."""
    near, cost = tables.near, scaled.cost
    near.half[:] = 0.0
    write_centre(chart.origin, chart.sense, near.at, near.centre)
    bound_nodes(cost.kinds, cost.data, near.centre, chart.sense, chart.gram, near.half, near.line, near.nodes)
    reduce_rows(scaled, chart.floor, near, tables.sheet)
    look_at(scaled, tables.sheet, near, tables.look)
    curve_at(cost, chart, near)
    sum_up(tables.look.K, tables.look.w, cost.weight, 0.0, near.nodes, near.curves, near.sums)
    return float(tables.sheet.span[HERE])


# Steps of a descent, the length of the last step, standard deviations, and damping, as in `optloc.proof.descents`.
_STEPS, _CLOSE, _DAMPING, _LESS, _MORE, _LEAST = 40, 1e-3, 1e-6, 0.1, 10.0, 1e-4
_SAME_COST = 1e-13


@compiled
def descend_scaled(scaled: Scaled, chart: LocalAxes, tables: ScaledTables) -> float:
    """Move the box around a position to a minimum; return its cost, or infinity if no minimum is reached.

    The cost is the least cost over the factors. The box is ``tables.near``, in the search coordinates `chart`.
    """
    near = tables.near
    now, damping, start = cost_near(scaled, chart, tables), _DAMPING, near.at.copy()
    for _ in range(_STEPS):
        length = newton_step(near, damping)
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

# First half-widths of a convex box, standard deviations, and their growth; and the half-widths of the box searched
# along the axes of a minimum, as in `optloc.proof.convex_boxes`.
_FIRST, _GROWTH, _WIDEST, _WIDER, _WIDE = 3.0, 2.0, 1e4, 3.0, 3.0
_SMALLEST = 1e-6  # standard deviations: a smaller box is rounding


@compiled
def _convex(
    scaled: Scaled, tables: ScaledTables, space: Space, piece: int, at: Array, half: Array, rho: float, margin: float
) -> bool:
    """Return whether the cost has one minimum on the box with centre `at` and half-widths `half` (3,) around a minimum.

    `piece` is its piece of the atlas, rho the longest residual of interest, and `margin` the margin of the Hessian. The
    result is also True if no factors of the box give a residual shorter than rho.
    """
    box = tables.box
    for k in range(3):
        box.at[k], box.half[k] = at[k], half[k]
    _fill(scaled, tables, space, piece, floor_of(space, scaled.cost))
    if not bound_factors(scaled, rho, box, tables.sheet):
        return True
    set_curves(space, scaled.cost, box)
    return is_convex_scaled(scaled, margin, box, tables.sheet)


@inlined
def _fill(scaled: Scaled, tables: ScaledTables, space: Space, piece: int, floor: float) -> None:
    """Set the centre of ``tables.box``, bound its nodes and reduce its rows."""
    set_place(space, tables.box, piece)
    set_nodes(space, scaled.cost, tables.box)
    reduce_rows(scaled, floor, tables.box, tables.sheet)


@compiled
def set_scaled_minimum(
    scaled: Scaled,
    tables: ScaledTables,
    atlas: Atlas,
    chart: LocalAxes,
    i: int,
    x: Array,
    value: float,
    eps: float,
    rho: float,
) -> bool:
    """Write minimum i, at x, and the boxes around it into an atlas.

    Return False if x is no minimum or costs less than `value`. The boxes have half-widths in standard deviations along
    the axes of the minimum. `hull` has the greatest allowed half-widths, and `sides` the half-widths of the convex box.
    `core` has the corners of the wider box that is searched along these axes.

    Parameters
    ----------
    scaled, tables : Scaled, ScaledTables
        The cost, and working memory.
    atlas, i : Atlas, int
        Minimum i of the atlas is written.
    chart : LocalAxes
        Search coordinates around the fix; a search in an atlas needs them only as a field of `Space`.
    x : array (D,)
        Polished position of the minimum, metres.
    value : float
        Least allowed cost of the minimum: the convex box is not searched.
    eps : float
        Greatest fall of the cost below the cost of x in the convex box.
    rho : float
        Root of the greatest level. Factors with which the residual is longer than rho everywhere in a box are ignored.
    """
    minima, d, hull = atlas.minima, atlas.dimension, np.zeros(3)
    space, piece = in_atlas(atlas, chart), 2 * d + 1 + i
    minima.home[i] = piece_of(atlas, x, minima.start[i])
    # Identity axes first: the rows at the minimum, reduced there, then give its own axes (`set_axes`).
    minima.axes[i, :], minima.back[i, :] = 0.0, 0.0
    for k in range(3):
        minima.axes[i, k, k] = minima.back[i, k, k] = 1.0
    tables.box.at[:] = 0.0
    tables.box.half[:] = 0.0
    _fill(scaled, tables, space, piece, floor_of(space, scaled.cost))
    look_at(scaled, tables.sheet, tables.box, tables.look)
    if not tables.sheet.span[HERE] >= value or not set_axes(tables.look, tables.box, atlas, i):
        return False
    # `hull` is still zero, so this tests the point itself, and fills the sums for the margin.
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
    scaled: Scaled, tables: ScaledTables, space: Space, i: int, hull: Array, value: float, eps: float, rho: float
) -> bool:
    """Write the half-widths of a box around minimum i of search coordinates; return False if it is no minimum.

    Parameters
    ----------
    scaled, tables, space : Scaled, ScaledTables, Space
        The cost, working memory, and search coordinates, in which the minimum is written.
    i, hull : int, array (3,)
        Number of the minimum, and its greatest half-widths.
    value, eps, rho
        As in `set_scaled_minimum`.
    """
    at, sides, shift = space.minima[i], space.sides[i], np.zeros(3)
    if not _convex(scaled, tables, space, 0, at, np.zeros(3), rho, 0.0) or not tables.sheet.span[HERE] >= value:
        return False
    margin = slope_of(tables.box, eps)
    if not _grow(scaled, tables, space, 0, at, hull, rho, margin, sides):
        return False
    widen_by_rounding(space.chart, tables.box.centre, shift)
    for k in range(3):
        sides[k] = max(sides[k] - shift[k], 0.0)
    return True


@compiled
def _grow(
    scaled: Scaled,
    tables: ScaledTables,
    space: Space,
    piece: int,
    at: Array,
    hull: Array,
    rho: float,
    margin: float,
    sides: Array,
) -> bool:
    """Write the sides (3,) of a convex box around a minimum, at most `hull`; return False without a convex box.

    The other arguments are as in `_convex`.
    """
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


class ScaledSearchWorkspace(NamedTuple):
    """A cost and working memory for its search; `box` and `near` are also in the tables.

    If factors may be negative, `rest` has the rows without factors. Where the columns of the factors vanish, as with a
    velocity far away, only these rows bound the cost. For other costs `rest` has no rows.
    """

    scaled: Scaled
    tables: ScaledTables
    floor: float
    box: Box
    near: Box
    rest: Cost


@compiled
def rest_of(scaled: Scaled) -> Cost:
    """Return the cost of the rows without factors, over the first nodes.

    `optloc.proof.scaled.scaled_proof.velocity_costs` orders the rows and nodes: the rows without factors follow each
    other, and their nodes come first. If factors may not be negative, no row is returned.
    """
    K, first, count, nodes = scaled.cost.K, zero(), zero(), zero()
    for i in range(K.shape[0] if scaled.free else 0):
        last, own = zero(), True
        for j in range(K.shape[1]):
            if K[i, j] != 0.0:
                last, own = j + 1, own and scaled.group[j] < 0
        if not own:
            count, nodes = 0, 0
        elif last > 0:
            first = i if count == 0 else first
            count, nodes = i + 1 - first, max(nodes, last)
    part = K[first : first + count, :nodes].copy()
    return cost_of(scaled.cost.kinds[:nodes], scaled.cost.data[:nodes], part, scaled.cost.w[first : first + count])


@inlined
def _bound_rest(work: ScaledSearchWorkspace, space: Space, box: Box) -> float:
    """Return a lower bound of the residual over a box from the rows without factors; negative if no bound is known."""
    rest = work.rest
    if rest.w.shape[0] == 0:
        return -1.0
    rows = box.rows[: rest.w.shape[0]]
    set_nodes(space, rest, box)
    linearise_rows(rest.K, rest.w, box.nodes, rows)
    return float(least_residual(rest.K, rest.weight, work.floor, box.half, box.nodes, rows))


@compiled
def _bound_row(work: ScaledSearchWorkspace, space: Space, stack: Array, row: int, level: float) -> tuple[float, float]:
    """Return a bound of the residual in a box of the stack, infinite if excluded, and the cost at its centre.

    `row` is the row of the box in the stack, and `level` the cost from which a box is excluded. This is
    `optloc.proof.level_search.bound_row` for a cost with unknown factors.
    """
    scaled, box, sheet, piece = work.scaled, work.box, work.tables.sheet, int(stack[row, PIECE])
    pop(stack, row, box.at, box.half)
    contract_at_infinity(box, space.atlas.dimension - 1, infinity_coordinate(space.atlas, piece) if space.far else -inf)
    set_box(space, box, piece)
    if is_left(space.atlas, box, piece) if space.far else is_known(box.at, box.half, space.minima, space.sides):
        return inf, inf
    least = _bound_rest(work, space, box)
    if exceeds_level(least, level):
        return inf, inf
    set_nodes(space, scaled.cost, box)
    reduce_rows(scaled, work.floor, box, sheet)
    if not bound_factors(scaled, sqrt(max(level, 0.0)), box, sheet):
        return inf, inf
    low = max(bound_rows(scaled, box, sheet), least)
    return (inf, inf) if exceeds_level(low, level) else (low, sheet.span[HERE])


@compiled
def _side_of_rest(work: ScaledSearchWorkspace, space: Space, touching: bool, rho: float, sound: bool) -> int:
    # Contracts a box and returns the side across which to halve the rest; -1 if no part remains. This is
    # `optloc.proof.level_search.side_of_rest` for a cost with unknown factors.
    scaled, box, sheet, d = work.scaled, work.box, work.tables.sheet, space.atlas.dimension
    if not is_bounded(sheet):
        return _side_of_rows(work, rho, d)
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
def _side_of_rows(work: ScaledSearchWorkspace, rho: float, d: int) -> int:
    """Contract a box by the rows without factors and return the side across which to halve the rest.

    -1 if no part remains.
    It is for boxes whose factors have no bound. Residuals longer than rho are cut off, and d is the dimension.
    """
    rest, box = work.rest, work.box
    reset_cut(box.half, box.cut)
    if rest.w.shape[0] == 0:
        return int(widest(box.half))
    rows, flat = box.rows[: rest.w.shape[0]], box.half[2] == 0.0
    noise = rounding_error(rest.K, rest.weight, work.floor, box.nodes)
    contract_box(rest.K, rest.weight, rho + noise, box.half, flat, box.nodes, rows, box.cut, box.solve)
    return -1 if is_empty(box.cut) else int(steepest_side(box.half, rows, d))


@compiled
def _descend_near(work: ScaledSearchWorkspace, chart: LocalAxes) -> float:
    """Move the box around a position to a minimum; return its cost, or infinity if no minimum is reached.

    This is `optloc.proof.level_search.descend_near` for a cost with unknown factors.
    """
    return descend_scaled(work.scaled, chart, work.tables)


@compiled
def _set_rival(
    work: ScaledSearchWorkspace,
    atlas: Atlas,
    chart: LocalAxes,
    i: int,
    x: Array,
    value: float,
    eps: float,
    rho: float,
) -> bool:
    """Write minimum i, at x, and the boxes around it into an atlas; return False if it is no minimum.

    This is `optloc.proof.level_search.set_rival` for a cost with unknown factors.
    """
    return set_scaled_minimum(work.scaled, work.tables, atlas, chart, i, x, value, eps, rho)


@compiled
def _cost_set(work: ScaledSearchWorkspace, atlas: Atlas) -> float:
    """Return the cost at the current centre of the atlas; the tables of the box are overwritten.

    This is `optloc.proof.level_search.cost_set` for a cost with unknown factors.
    """
    bound_pieces(atlas, work.scaled.cost.kinds, work.scaled.cost.data, work.box.half, work.box.nodes)
    if work.scaled.free and not work.scaled.lift.any():  # the columns of factors vanish at infinity
        return float(cost_at(work.rest.K, work.rest.w, work.box.nodes))
    reduce_rows(work.scaled, work.floor, work.box, work.tables.sheet)
    return float(work.tables.sheet.span[HERE])


search_scaled = specialise(
    search_levels,
    "scaled",
    {
        bound_row: _bound_row,
        side_of_rest: _side_of_rest,
        descend_near: _descend_near,
        set_rival: _set_rival,
        cost_set: _cost_set,
    },
)
