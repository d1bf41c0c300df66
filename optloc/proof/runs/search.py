"""The search of a run: boxes of all space, along a surface or of a region.

Each box is first bounded with the rows of a few epochs, whose cost is never more than the cost of all rows. All rows
are used only if this bound is not sufficient.
"""

from __future__ import annotations

from math import inf, nan, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, put
from optloc.kernels.systems import positive_along
from optloc.proof.atlas import set_centre
from optloc.proof.box import (
    PIECE,
    cost_at,
    exceeds_level,
    least_left,
    least_residual,
    linearise_rows,
    pop,
    push_halves,
    reset_cut,
    steepest_side,
)
from optloc.proof.convex_boxes import is_known
from optloc.proof.curvature import has_no_infimum
from optloc.proof.descents import damped_step
from optloc.proof.local_search import ANOTHER, CHEAPER, CLEAR, INFINITE, SPENT, Goal
from optloc.proof.nodes.dispatch import bound_pieces
from optloc.proof.nodes.node import H00, H01, H02, H11, H12, H22
from optloc.proof.pieces import is_listed
from optloc.proof.runs.rows import (
    RunWorkspace,
    least_length,
    multiply,
    project_out_unknowns,
    residual_at,
    rounding_of_residual,
    sum_up_rows,
    workspace_of,
)
from optloc.proof.runs.run_costs import RunCost
from optloc.proof.search_space import (
    Box,
    empty_box,
)
from optloc.proof.space import Space, bound_or_halve, floor_of, place_of, set_curves, set_nodes, set_place
from optloc.proof.surface import SLIP


class RunTables(NamedTuple):
    """Working memory: a box for the nodes of few epochs (`small`), a box for all nodes, and arrays for all rows."""

    small: Box
    box: Box
    sheet: RunWorkspace


@compiled
def tables_of(run: RunCost) -> RunTables:
    """Return working memory for a run."""
    box = empty_box(0, run.cost.kinds.shape[0])
    box.lean[:], box.graph[:] = 0.0, 0.0  # only boxes on a surface write these
    return RunTables(empty_box(run.look.K.shape[0], run.look.K.shape[1]), box, workspace_of(run.rows))


@compiled
def sum_at(run: RunCost, space: Space, tables: RunTables, floor: float) -> tuple[float, float]:
    """Return the cost at the centre of a box that is set, and the norm of the rest of its Hessian's change.

    The sums of the box are filled. `floor` is the result of `floor_of`. Both results are infinite if the nodes cannot
    be bounded.
    """
    box, sheet = tables.box, tables.sheet
    if not set_nodes(space, run.cost, box):
        return inf, inf
    set_curves(space, run.cost, box)
    here = residual_at(run.rows, box.nodes, sheet)
    noise = rounding_of_residual(run.rows, floor, box.nodes)
    return here, sum_up_rows(run.rows, box.half, box.nodes, box.curves, noise, sheet, box.sums)


# The search.

# All rows are used if the few rows cost less than this many levels at the centre of a box. Otherwise few rows will
# exclude the halves of the box as well.
_WORTH = 4.0
# The test for stationary points runs if the cost at the centre is within this many levels, as in
# `optloc.proof.global_search`; and boxes at infinity are not split below this size.
_NEAR, _TINY = 100.0, 1e-5
# Boxes on the stack: pieces, slabs around known minima, and one for each halving of the deepest box.
CAPACITY = 4096
# Greatest number of bounds with few rows, as a multiple of the budget for all rows: few rows take a twentieth of the
# time.
_LOOKS = 10


@compiled
def search_run(
    run: RunCost,
    space: Space,
    tables: RunTables,
    stack: Array,
    size: int,
    aim: Goal,
    budget: int,
    found: Array,
) -> tuple[int, int, float]:
    """Search boxes for minima of a run that cost less than a level.

    Parameters
    ----------
    run : RunCost
        The cost.
    space : Space
        Space of the boxes.
    tables : RunTables
        Working memory.
    stack, size : array (capacity, DEPTH), int
        The boxes.
    aim : Goal
        The conditions to show for each box.
    budget : int
        Greatest number of boxes with all rows; with few rows, `_LOOKS` times this number is allowed.
    found : array (D,)
        Written: the point of the outcomes CHEAPER and ANOTHER.

    Returns
    -------
    outcome : int
        CLEAR, CHEAPER, ANOTHER, SPENT or INFINITE, as in `optloc.proof.level_search.search_levels`.
    boxes : int
        Number of boxes that were taken from the stack.
    bound : float
        A lower bound of f for the outcomes CLEAR and SPENT, otherwise 0.
    """
    look, small, d, boxes, looks, lows = run.look, tables.small, found.shape[0], 0, 0, 0
    floors = floor_of(space, look), floor_of(space, run.cost)
    while size > 0:
        if boxes >= budget or looks >= _LOOKS * budget or size + 2 > stack.shape[0]:
            return SPENT, looks, least_left(stack, size)
        size -= 1
        looks += 1
        pop(stack, size, small.at, small.half)
        piece = int(stack[size, PIECE])
        left = bound_or_halve(space, look, small, piece, stack, size)
        if left >= 0:
            size = left
            continue
        linearise_rows(look.K, look.w, small.nodes, small.rows)
        low = least_residual(look.K, look.weight, floors[0], small.half, small.nodes, small.rows)
        if exceeds_level(low, aim.level):
            continue
        side = steepest_side(small.half, small.rows, d)
        if cost_at(look.K, look.w, small.nodes) < _WORTH * (aim.level + 1.0):
            boxes += 1
            put(small.at, tables.box.at)
            put(small.half, tables.box.half)
            touching = space.far and piece < 2 * d and small.at[d - 1] <= small.half[d - 1]
            here, more = _bound(run, space, tables, floors[1], aim.level)
            low = max(low, more)
            if here < aim.better:
                place_of(space, tables.box, found)
                return CHEAPER, looks, 0.0
            if _is_done(run, space, tables, aim, here, low, touching, floors[1]):
                continue
            lows += int(here < aim.level)
            # At low centre number 1, 2, 4 and so on: minima are found early, with few descents in vain.
            if here < aim.level and lows & (lows - 1) == 0:
                if _descends(run, space, tables, aim.level, found):
                    return ANOTHER, looks, 0.0
                set_place(space, small, piece)
            if touching and _is_flat_out(run, space, tables, aim.level):
                return INFINITE, looks, 0.0
        size = push_halves(stack, size, side, small.at, small.half, low, piece, space.far and piece <= 2 * d)
    return CLEAR, looks, aim.value


@compiled
def _is_done(
    run: RunCost,
    space: Space,
    tables: RunTables,
    aim: Goal,
    here: float,
    low: float,
    touching: bool,
    floor: float,
) -> bool:
    """Return whether a box is finished: its cost is at least the level, or it contains no minimum.

    `here` is the cost at its centre, `low` a lower bound of the residual, `touching` whether it reaches infinity, and
    `floor` the result of `floor_of`.
    """
    if exceeds_level(low, aim.level):
        return True
    if not (aim.whole or exceeds_level(low, aim.value)) or not here < _NEAR * (aim.level + 1.0):
        return False
    box, d = tables.box, space.atlas.dimension if space.far else 3
    _, ball = sum_at(run, space, tables, floor)
    reset_cut(box.half, box.cut)
    return has_no_infimum(d, touching, box.half, box.sums, ball, box.cut, box.solve)


@compiled
def _is_flat_out(run: RunCost, space: Space, tables: RunTables, level: float) -> bool:
    """Return whether a box at infinity is small and its cost at infinity is below a level.

    Halving this box would never exclude it, so the search ends.
    """
    half, box = tables.small.half, tables.box
    if not max(half[0], half[1], half[2]) < _TINY:
        return False
    space.atlas.scale[0] = 0.0
    bound_pieces(space.atlas, run.cost.kinds, run.cost.data, half, box.nodes)
    return residual_at(run.rows, box.nodes, tables.sheet) < level


@compiled
def _bound(run: RunCost, space: Space, tables: RunTables, floor: float, level: float) -> tuple[float, float]:
    """Return the cost at the centre of a box, and a lower bound of the residual over it, negative without a bound.

    All rows are used. Second derivatives are computed only if the bound without them is below `level`. `floor` is the
    result of `floor_of`.
    """
    box, sheet, rows = tables.box, tables.sheet, run.rows
    if not set_nodes(space, run.cost, box):
        return inf, -1.0
    here = residual_at(rows, box.nodes, sheet)
    if here < level:  # no bound can exceed the level
        return here, -1.0
    noise, slip = rounding_of_residual(rows, floor, box.nodes), box.graph[SLIP]
    low = least_length(box.half, box.nodes, box.curves, box.lean, slip, sheet, here, False) - noise
    if exceeds_level(low, level):
        return here, low
    set_curves(space, run.cost, box)
    return here, max(low, least_length(box.half, box.nodes, box.curves, box.lean, slip, sheet, here, True) - noise)


# Descents.

# Greatest number of steps, and the length of the last step, standard deviations.
_STEPS, _CLOSE = 40, 1e-3
# Greatest coordinate of a descent in an atlas, whose pieces end at 1. Beyond it, boxes of other pieces descend.
_ASIDE = 1.5


@compiled
def _descends(run: RunCost, space: Space, tables: RunTables, level: float, found: Array) -> bool:
    """Return whether the centre of a box descends to an unknown minimum below the level.

    If so, `found` (D,) is this minimum, metres.
    """
    box, d, home = tables.box, found.shape[0], 0
    u, before, face = box.at.copy(), np.zeros(3), False
    if space.far:
        home = int(space.atlas.place[0])
        face = home < 2 * d
        for k in range(d):
            u[k] = space.atlas.place[1 + k]
    now, damping, floor = cost_at_coordinates(run, space, tables, home, u), 1e-3, floor_of(space, run.cost)
    noise = rounding_at_place(run, space, tables, floor)
    for _ in range(_STEPS):
        length = _step(box, damping)
        if not length >= 0.0:
            return False
        put(u, before)
        inside = True
        for k in range(3):
            u[k] -= box.solve[0, k]
            inside = inside and (not space.far or abs(u[k]) <= _ASIDE)
        inside = inside and not (face and not u[d - 1] > 0.0)
        after = cost_at_coordinates(run, space, tables, home, u) if inside else inf
        if after <= now + noise * (2.0 * sqrt(now) + noise):
            now, damping, noise = after, 0.1 * damping, rounding_at_place(run, space, tables, floor)
            if length < _CLOSE * _CLOSE + noise * noise:
                place_of(space, box, found)
                known = is_listed(space.atlas, found) if space.far else is_known(u, box.half, space.minima, space.sides)
                return now < level and not known
        else:
            put(before, u)
            damping = max(10.0 * damping, 1e-4)
            cost_at_coordinates(run, space, tables, home, u)
    return False


@compiled
def cost_at_coordinates(run: RunCost, space: Space, tables: RunTables, home: int, u: Array) -> float:
    """Return the cost at coordinates u (3,) of the piece `home`.

    Its derivatives are written into the sums of the box.
    """
    tables.box.half[:] = 0.0
    put(u, tables.box.at)
    if space.far:
        set_centre(space.atlas, home, u)
    return sum_at(run, space, tables, 0.0)[0]


@compiled
def rounding_at_place(run: RunCost, space: Space, tables: RunTables, floor: float) -> float:
    """Return a bound of the rounding of a residual, as a length, at a point whose nodes are bounded.

    On a surface, the rounding of the height is included, see `optloc.proof.search_space.rounding_at_centre`. `floor` is
    the result of `floor_of`.
    """
    box, values, total = tables.box, tables.sheet.length, 0.0
    multiply(run.rows, box.lean, values)  # zero except on a surface
    project_out_unknowns(run.rows, values)
    for value in values:
        total += value * value
    return float(rounding_of_residual(run.rows, floor, box.nodes) + sqrt(total) * box.graph[SLIP])


@compiled
def _step(box: Box, damping: float) -> float:
    """Write a damped Newton step into box.solve[0]; return its squared length in squared standard deviations.

    `damping` is the share by which the diagonal of the Hessian grows. The result is NaN if the Hessian is not positive
    definite.
    """
    sums = box.sums
    h0, h1, h2, h3, h4, h5 = sums[H00], sums[H01], sums[H02], sums[H11], sums[H12], sums[H22]
    if not positive_along(h0, h1, h2, h3, h4, h5, h3 != 0.0, h5 != 0.0):
        return nan
    h3, h5 = h3 if h3 != 0.0 else 1.0, h5 if h5 != 0.0 else 1.0
    return damped_step(box, h0, h1, h2, h3, h4, h5, damping)
