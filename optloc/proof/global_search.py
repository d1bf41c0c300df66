"""The proof for all positions: first within an enclosure if there is one, else over the atlas of all space.

An *enclosure* is a box around the fix that contains all points below a cost (`optloc.proof.enclosure`). The *atlas*
covers all positions to infinity with boxes of finite size (`optloc.proof.atlas`). *Squared rows*
(`optloc.proof.squares`) contract large boxes.
"""

from __future__ import annotations

from math import inf, isnan, nan, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined, put, specialise, zero
from optloc.proof.atlas import (
    Atlas,
    atlas_of,
    contract_to_corners,
    first_minima,
    infinity_coordinate,
    set_centre,
    widen_around,
    with_minima,
)
from optloc.proof.box import (
    DEPTH,
    PIECE,
    contract_box,
    cost_at,
    cut_out,
    exceeds_level,
    is_empty,
    least_residual,
    linearise_rows,
    pop,
    reaches_infinity,
    relative_rounding,
    reset_cut,
    rounding_error,
    share_left,
    station_cube,
    steepest_side,
)
from optloc.proof.convex_boxes import accuracy_floor_far, set_minimum, widen_core
from optloc.proof.curvature import has_no_infimum, most_curved_side, spread_of, sum_up
from optloc.proof.descents import descend
from optloc.proof.level_search import (
    bound_row,
    cost_set,
    descend_near,
    search_levels,
    set_rival,
    side_of_rest,
)
from optloc.proof.local_search import (
    ANOTHER,
    BETTER,
    BUDGET,
    CHEAPER,
    CLEAR,
    COARSE,
    INFINITE,
    OPEN,
    OTHER,
    SINGULAR,
    STATIONARY,
    UNIQUE,
    VALUE,
    prove_locally,
    region_of,
)
from optloc.proof.nodes.dispatch import bound_pieces, curve_pieces
from optloc.proof.pieces import (
    CAPACITY,
    SHRUNK,
    contract_at_infinity,
    is_left,
    push_pieces,
)
from optloc.proof.search_space import (
    COARSEST,
    HIDDEN_REACH,
    Box,
    Cost,
    KnownMinima,
    LocalAxes,
    chart_at,
    empty_box,
    equal_within,
)
from optloc.proof.space import Space, in_atlas
from optloc.proof.squares import Squares, change_of_residual, clip_to_squares, squares_of

# Branch and bound over all positions, for costs without an enclosure.

# Greatest number of contractions of a box by its squared rows; they end when one removes less than half. A whole face
# of the cube needs three.
_LOOKS = 8
# Squared rows contract a box only if the remainder of ranges changes the squared residual by more than this many
# levels. Over 100 fixes of five stations, a ninth of this value took 4 % fewer boxes, but twice the contractions. Ten
# times this value took 8 % more boxes.
_BENT = 9.0


class GlobalWorkspace(NamedTuple):
    """A cost that stays finite at infinity (`optloc.proof.box.reaches_infinity`), and working memory for its search.

    Parameters
    ----------
    cost : Cost
        The cost.
    corners : array (2, 3)
        Corners in search coordinates around the fix, outside which the cost is at least the first level; NaN if
        unknown.
    squares : Squares
        Squared rows, which contract boxes.
    floor : float
        Sizes of measurements and coordinates for `optloc.proof.box.rounding_error`.
    box, near : Box
        Tables for a box of the atlas, and for a box around a position.
    """

    cost: Cost
    corners: Array
    squares: Squares
    floor: float
    box: Box
    near: Box


@compiled
def _bound_row(work: GlobalWorkspace, space: Space, stack: Array, row: int, level: float) -> tuple[float, float]:
    """Return a bound of the residual in a box of the stack, infinite if excluded, and the cost at its centre.

    This is `optloc.proof.level_search.bound_row` for a cost without unknown factors.
    """
    atlas, box, cost, piece = space.atlas, work.box, work.cost, int(stack[row, PIECE])
    if not _take(stack, row, atlas, space.chart, work.corners, box, piece):
        return inf, inf
    if not _squeeze(cost, atlas, work.squares, level, box, piece):
        return inf, inf
    low = _bound(cost, atlas, box, work.floor)
    return (inf, inf) if exceeds_level(low, level) else (low, cost_at(cost.K, cost.w, box.nodes))


@inlined
def _bound(cost: Cost, atlas: Atlas, box: Box, floor: float) -> float:
    """Return a lower bound of the residual's length over a box whose centre is set; fill the tables of the box.

    A negative result means that no bound is known.
    """
    bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    return least_residual(cost.K, cost.weight, floor, box.half, box.nodes, box.rows)


@inlined
def _side_of_rest(work: GlobalWorkspace, space: Space, touching: bool, rho: float, sound: bool) -> int:
    """Contract a box and return the side across which to halve the rest; -1 if no part remains.

    This is `optloc.proof.level_search.side_of_rest` for a cost without unknown factors.
    """
    cost, atlas, box = work.cost, space.atlas, work.box
    noise = rounding_error(cost.K, cost.weight, work.floor, box.nodes)
    reset_cut(box.half, box.cut)
    flat = box.half[2] == 0.0
    contract_box(cost.K, cost.weight, rho + noise, box.half, flat, box.nodes, box.rows, box.cut, box.solve)
    if is_empty(box.cut):
        return -1
    # If little of the box remains, the smaller box is bounded again, which takes less time than the tests below.
    if not sound or share_left(box.cut, box.half) <= SHRUNK:
        return int(steepest_side(box.half, box.rows, atlas.dimension))
    if _clips_away(cost, atlas, box, touching, noise):
        return -1
    curved = most_curved_side(box.half, box.sums, atlas.dimension)
    return int(curved if curved >= 0 else steepest_side(box.half, box.rows, atlas.dimension))


@inlined
def _take(stack: Array, row: int, atlas: Atlas, chart: LocalAxes, corners: Array, box: Box, piece: int) -> bool:
    """Take a box off the stack and set its centre; return False if no part of it needs a search.

    `row` is its row in the stack, and `piece` its piece of the atlas. If `corners` (2, 3), search coordinates, are
    known, the part of the box outside them is cut off: its cost is above the levels.
    """
    faces = 2 * atlas.dimension
    pop(stack, row, box.at, box.half)
    contract_at_infinity(box, atlas.dimension - 1, infinity_coordinate(atlas, piece))
    set_centre(atlas, piece, box.at)
    if piece > faces:
        widen_around(atlas, piece - faces - 1, box.half)
    if is_left(atlas, box, piece):
        return False
    if isnan(corners[0, 0]):
        return True
    reset_cut(box.half, box.cut)
    contract_to_corners(atlas, chart.origin, chart.back, corners, box.half, box.cut)
    share = cut_out(box.cut, box.at, box.half)
    if 0.0 < share < 1.0:
        contract_at_infinity(box, atlas.dimension - 1, infinity_coordinate(atlas, piece))
        set_centre(atlas, piece, box.at)
    return share > 0.0


@compiled
def _squeeze(cost: Cost, atlas: Atlas, squares: Squares, level: float, box: Box, piece: int) -> bool:
    """Contract a box of an atlas by its squared rows; return False if the whole box costs at least `level`.

    `piece` is the number of the box's piece of the atlas (`optloc.proof.atlas`), and the centre of the box must be set
    in the atlas. Parts that cost at least `level` are cut off, at most `_LOOKS` times. The rest of the box is written
    into `box`, and its centre is set. If squared rows cannot help, the box stays as it is.
    """
    # There are no squared rows, or ranges are so close to linear over the box that the plain rows contract it as well.
    if squares.groups == 0 or change_of_residual(atlas, squares, box.half) ** 2 <= _BENT * level:
        return True
    for _ in range(_LOOKS):
        if not clip_to_squares(cost, atlas, squares, sqrt(max(level, 0.0)), box):
            return False
        share = cut_out(box.cut, box.at, box.half)  # the share of the box that remains
        if not share > 0.0:
            return False
        if share < 1.0:  # the box has a new centre
            contract_at_infinity(box, atlas.dimension - 1, infinity_coordinate(atlas, piece))
            set_centre(atlas, piece, box.at)
        if share > SHRUNK:  # too little was cut off for a further contraction
            break
    return True


@compiled
def excludes_infimum(cost: Cost, atlas: Atlas, box: Box, touching: bool, floor: float) -> bool:
    """Return whether a box with bounded nodes contains no infimum of the cost.

    `touching` means that the box reaches infinity. `floor` is the result of `accuracy_floor_far`.
    """
    reset_cut(box.half, box.cut)
    return _clips_away(cost, atlas, box, touching, rounding_error(cost.K, cost.weight, floor, box.nodes))


@inlined
def _clips_away(cost: Cost, atlas: Atlas, box: Box, touching: bool, noise: float) -> bool:
    """Return the result of `excludes_infimum` for the part between the ends of ``box.cut``, which is contracted.

    `noise` bounds the rounding of a residual.
    """
    curve_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes, box.curves)
    sum_up(cost.K, cost.w, cost.weight, noise, box.nodes, box.curves, box.sums)
    ball = spread_of(cost.A, box.half, box.nodes, box.curves, box.sums)
    return has_no_infimum(atlas.dimension, touching, box.half, box.sums, ball, box.cut, box.solve)


@compiled
def _descend_near(work: GlobalWorkspace, chart: LocalAxes) -> float:
    """Move the box around a position to a minimum; return its cost, or infinity if no minimum is reached.

    This is `optloc.proof.level_search.descend_near` for a cost without unknown factors.
    """
    return descend(work.cost, chart, work.near)


@compiled
def _set_rival(
    work: GlobalWorkspace,
    atlas: Atlas,
    _chart: LocalAxes,
    i: int,
    x: Array,
    value: float,
    eps: float,
    _rho: float,
) -> bool:
    """Write minimum i, at x, and the boxes around it into an atlas; return False if it is no minimum.

    This is `optloc.proof.level_search.set_rival` for a cost without unknown factors.
    """
    return set_minimum(work.cost, work.near, atlas, i, x, value, eps, inf)


@compiled
def _cost_set(work: GlobalWorkspace, atlas: Atlas) -> float:
    """Return the cost at the current centre of the atlas; the tables of the box are overwritten.

    This is `optloc.proof.level_search.cost_set` for a cost without unknown factors.
    """
    bound_pieces(atlas, work.cost.kinds, work.cost.data, work.box.half, work.box.nodes)
    return cost_at(work.cost.K, work.cost.w, work.box.nodes)


search_everywhere = specialise(
    search_levels,
    "everywhere",
    {
        bound_row: _bound_row,
        side_of_rest: _side_of_rest,
        descend_near: _descend_near,
        set_rival: _set_rival,
        cost_set: _cost_set,
    },
)


# A verdict in addition to the verdicts of `optloc.proof.local_search`: the cost at infinity is within the gap.
UNBOUNDED = 8
# Greatest size of an enclosure to search, as a multiple of the convex box around the fix: between the stations, and
# outside. The third number is the number of boxes after which the atlas replaces the enclosure. An enclosure of six
# times the size takes about sixteen boxes, like an atlas of a fix outside. Of enclosures of fifty times the size, few
# need less than a hundred boxes.
_REACH, _REACH_OUTSIDE, _SOON = 50.0, 6.0, 100
# Distance, relative to the distance from the fix, within which two minima are the same: the accuracy of a descent.
_CLOSE = 1e-3


@inlined
def prove_globally(
    cost: Cost,
    box: Box,
    x: Array,
    beside: KnownMinima,
    gaps: Array,
    eps: float,
    budget: int,
    rivals: Array,
    found: Array,
) -> tuple[int, int, float, float, int]:
    """Prove that no position costs less than a fix, and that no other minimum has a gap below the largest provable gap.

    The claim is for all positions, to infinity. If there is an enclosure, it is searched first. If its search does not
    end soon, or there is no enclosure, the atlas of all space is searched. The atlas needs a cost that stays finite at
    infinity. In terms of inverse ranges a long valley is straight, and the cost is convex on wider boxes.

    Parameters
    ----------
    cost, box, x, beside, eps, budget, found
        As in `optloc.proof.local_search.prove_locally`.
    gaps : array (G,)
        Accepted gaps in descending order; a last gap of 0 proves the value alone. Only the atlas tries more than the
        first gap.
    rivals : array (F, D)
        Written: minima within the first gap that the search found; the claim excepts them.

    Returns
    -------
    verdict : int
        As in `optloc.proof.local_search.prove_locally`. UNBOUNDED: the cost at infinity is below the cost of the fix
        plus each gap.
    boxes : int
        Number of boxes searched.
    bound : float
        A certified lower bound of f over all positions; -inf without a bound.
    gap : float
        The proven gap; if no gap is proven, the smallest gap that was tried.
    met : int
        Number of rivals.
    """
    nowhere, bound_to = np.full(x.shape[0], np.nan), beside.planes.shape[0] + beside.surface.shape[0] > 0
    open_end = not bound_to and reaches_infinity(cost.kinds, cost.K)  # the atlas covers space, no plane
    first, reach = (min(budget, _SOON), _reach_of(cost, x)) if open_end else (budget, inf)
    verdict, boxes, bound = prove_locally(
        cost, box, x, beside, gaps[0], eps, first, reach, nowhere, nowhere, False, found
    )
    # The atlas may decide these cases. OTHER with a known minimum means that the axes of the fix did not suit it.
    again = verdict in (OPEN, BUDGET, STATIONARY, SINGULAR) or (verdict == OTHER and _listed(x, beside.points, found))
    if not open_end or not again or boxes >= budget:
        return verdict, boxes, bound, gaps[0], 0
    verdict, more, bound, gap, met = prove_atlas(cost, box, x, beside, gaps, eps, budget - boxes, rivals, found)
    return verdict, boxes + more, bound, gap, met


@compiled
def _reach_of(cost: Cost, x: Array) -> float:
    """Return the greatest size of an enclosure to search, as a multiple of the convex box around a fix x (D,).

    It is larger for a fix between the stations. A larger enclosure takes more boxes than the atlas.
    """
    middle, radius = station_cube(cost.kinds, cost.data, x)
    between = True
    for k in range(x.shape[0]):
        between = between and abs(x[k] - middle[k]) < radius
    return _REACH if between else _REACH_OUTSIDE


@compiled
def prove_atlas(
    cost: Cost,
    box: Box,
    x: Array,
    beside: KnownMinima,
    gaps: Array,
    eps: float,
    budget: int,
    rivals: Array,
    found: Array,
) -> tuple[int, int, float, float, int]:
    """Prove the same as `prove_globally` with the atlas alone; arguments and results are the same.

    The cost must stay finite at infinity (`optloc.proof.box.reaches_infinity`).
    """
    chart, _ = chart_at(cost, x, box)
    least, corners, nowhere = cost_at(cost.K, cost.w, box.nodes), np.empty((2, 3)), np.full(x.shape[0], nan)
    noise = rounding_error(cost.K, cost.weight, chart.floor, box.nodes)
    if not region_of(cost, chart, box, sqrt(least + gaps[0]), nowhere, nowhere, corners[0], corners[1]):
        corners[:] = nan
    others = beside.points
    middle, radius = station_cube(cost.kinds, cost.data, x)
    squares = squares_of(cost, box, middle, radius)
    atlas = atlas_of(middle, radius, x.shape[0], 1 + (others.shape[0] if gaps[0] > 0.0 else 0))
    most, noise = max(COARSEST, eps), max(noise, relative_rounding(cost.K) * accuracy_floor_far(cost, atlas))
    eps = equal_within(eps, least, noise)
    if not eps <= most:
        return COARSE, 0, -inf, gaps[0], 0
    known, place = zero(), np.empty(x.shape[0])
    for p in range(atlas.minima.home.shape[0]):
        put(x if p == 0 else others[p - 1], place)
        # The last minima are hidden: they may have any cost, but only points near them are left out.
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
    q, J = cost.K.shape
    work = GlobalWorkspace(cost, corners, squares, accuracy_floor_far(cost, atlas), empty_box(q, J), empty_box(q, J))
    space, stack, whole = in_atlas(atlas, chart), np.empty((CAPACITY, DEPTH)), beside.hidden == 0
    outcome, boxes, bound, shown, met = search_everywhere(
        work, space, stack, push_pieces(stack, atlas), levels, eps, whole, budget, rivals, found
    )
    return verdict_of(outcome, boxes, bound, shown, met, gaps, least - eps)


@inlined
def verdict_of(
    outcome: int, boxes: int, bound: float, shown: int, met: int, gaps: Array, least: float
) -> tuple[int, int, float, float, int]:
    """Return the results of `prove_globally` for the outcome of a search; `least` is the lowest level.

    `outcome`, `boxes`, `bound`, `shown` and `met` are the results of `optloc.proof.level_search.search_levels`.
    """
    if outcome == CLEAR:
        return UNIQUE if gaps[shown] > 0.0 else VALUE, boxes, bound, gaps[shown], met
    if outcome == CHEAPER:
        return BETTER, boxes, bound, gaps[0], 0
    if outcome == ANOTHER:
        return OTHER, boxes, bound, gaps[0], 0
    return UNBOUNDED if outcome == INFINITE else BUDGET, boxes, min(bound, least), gaps[-1], 0


@compiled
def _listed(x: Array, others: Array, found: Array) -> bool:
    """Return whether the point `found` (D,) is one of the known minima `others` (P, D).

    The fix is `x` (D,), and all points are in metres. A search in the axes of the fix may find a known minimum again,
    if no box along these axes is convex around it.
    """
    for p in range(others.shape[0]):
        apart = away = 0.0
        for k in range(x.shape[0]):
            apart += (found[k] - others[p, k]) ** 2
            away += (x[k] - others[p, k]) ** 2
        if apart <= _CLOSE * _CLOSE * away:
            return True
    return False
