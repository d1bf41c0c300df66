"""The proof of a run: no position costs less than a fix, and no other minimum is within a gap.

A run has many rows, which are sparse (`optloc.proof.runs.rows`). The search is over all space (functions `..._far`), or
in search coordinates around the fix (functions `..._near`). The last functions prove fixes of moving targets. Around
each known minimum there are boxes with half-widths (3,) in standard deviations. The *hull* is the greatest allowed box.
In the *convex box* (`sides`) the cost is convex. The *core* is a wider box that is searched along the axes of the
minimum. A *piece* is a part of the atlas of all space, with a number (`optloc.proof.atlas`). `RunTables` are working
memory.
"""

from __future__ import annotations

from math import inf, isnan, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.threads import map_on_threads
from optloc.base.types import Array
from optloc.kernels.jit import compiled, enabled, inlined, may_use_code, put, zero
from optloc.proof.atlas import Atlas, atlas_of, first_minima, piece_of, set_centre, with_minima
from optloc.proof.batch import ProofRequest, ProofResult, plainly, without_rivals
from optloc.proof.box import (
    DEPTH,
    bound_nodes,
    push_around,
    station_cube,
)
from optloc.proof.convex_boxes import accuracy_floor_far, is_elsewhere, limit_half_widths, set_axes, set_hull
from optloc.proof.curvature import G0, LENGTH0, symmetric_entry
from optloc.proof.global_search import UNBOUNDED
from optloc.proof.local_search import (
    BETTER,
    BUDGET,
    CHEAPER,
    CLEAR,
    COARSE,
    INFINITE,
    OPEN,
    OTHER,
    SINGULAR,
    SPENT,
    STATIONARY,
    UNIQUE,
    VALUE,
    Goal,
    region_of,
)
from optloc.proof.nodes.dispatch import infinity_of
from optloc.proof.nodes.node import DIFFERENCE, GROWS
from optloc.proof.pieces import push_pieces
from optloc.proof.runs.ground import Ground, axes_at, corners_on, over_ground, state_off, state_on
from optloc.proof.runs.rows import (
    is_balanced,
    is_convex_by,
    relative_rounding_of,
    residual_at,
    rounding_of_residual,
)
from optloc.proof.runs.run_costs import CourseCosts, RunCost, Runs
from optloc.proof.runs.search import (
    CAPACITY,
    RunTables,
    cost_at_coordinates,
    rounding_at_place,
    search_run,
    sum_at,
    tables_of,
)
from optloc.proof.runs.state_bounds import axes_of, hessian_of_state
from optloc.proof.runs.state_search import prove_course
from optloc.proof.runs.states import STATE, ConstantVelocityCost, cost_of_state
from optloc.proof.search_space import (
    COARSEST,
    HIDDEN_REACH,
    LINES,
    KnownMinima,
    LocalAxes,
    accuracy_floor,
    axes_of_next_piece,
    chart_on,
    equal_within,
    widen_by_rounding,
    without_differences,
)
from optloc.proof.space import Space, floor_of
from optloc.proof.surface import SIDES, is_one_side, reach_of_piece

# Boxes around known minima on which the cost is convex.

# First half-width, standard deviations, the factor by which it is reduced, and the number of trials, which reduce it
# to a millionth.
_WIDEST, _SMALLER, _TRIALS = 100.0, 0.8, 62
# Half-widths of the box searched along the axes of a minimum: in units of the convex box, and at least this many
# standard deviations. Outside, the cost of a run is high enough for boxes along the axes of space.
_WIDER, _WIDE = 3.0, 40.0


@compiled
def _convex_sides(
    run: RunCost, space: Space, tables: RunTables, at: Array, piece: int, hull: Array, margin: float, sides: Array
) -> bool:
    """Write half-widths (3,), at most the hull, of a box around a position on which the cost is convex.

    The position has the coordinates `at` (3,) in a piece of the atlas, or in search coordinates. `margin` is the margin
    of the Hessian of f/2. Return False without a convex box.
    """
    box, share, floor = tables.box, _WIDEST, floor_of(space, run.cost)
    for _ in range(_TRIALS):
        put(at, box.at)
        for k in range(3):
            box.half[k] = sides[k] = min(share, hull[k])
        if space.far:
            set_centre(space.atlas, piece, at)
        _, ball = sum_at(run, space, tables, floor)
        if is_convex_by(box.half, box.sums, ball, margin):
            return True
        share *= _SMALLER
    return False


@inlined
def _margin(tables: RunTables, noise: float, eps: float) -> float:
    """Return the margin of convexity for which the cost in a box falls at most eps below the cost of its centre.

    The slope is in ``box.sums``, and `noise` bounds the rounding of a residual.
    """
    total = 0.0
    for k in range(3):
        slope = abs(tables.box.sums[G0 + k]) + tables.box.sums[LENGTH0 + k] * noise
        total += slope * slope
    return total / eps


@compiled
def _set_far(
    run: RunCost, space: Space, tables: RunTables, i: int, x: Array, value: float, eps: float, limit: float
) -> bool:
    """Write minimum i, at x (d,), metres, and the boxes around it into the atlas of `space`; d is 2 or 3.

    Return False if x is no minimum or costs less than `value`: the search leaves the convex box out, so no cheaper
    point may be in it. In the convex box the cost falls at most `eps` below the cost of x. No box reaches farther than
    `limit` metres along any coordinate; infinity means no limit. `tables` is overwritten.
    """
    atlas, box, d, hull = space.atlas, tables.box, space.atlas.dimension, np.zeros(3)
    minima, piece = atlas.minima, 2 * d + 1 + i
    minima.home[i] = piece_of(atlas, x, minima.start[i])
    if not set_axes(run.look, tables.small, atlas, i):
        return False
    if not cost_at_coordinates(run, space, tables, piece, hull) >= value:
        return False
    for k in range(d):  # scale the axes, which few rows gave, to all rows
        own = box.sums[symmetric_entry(k, k)]
        if not own > 0.0:
            return False
        for m in range(d):
            minima.axes[i, m, k] /= sqrt(own)
            minima.back[i, k, m] *= sqrt(own)
    # Again in the new axes, because the margin needs the gradient along them. `hull` is still zero: the minimum itself.
    cost_at_coordinates(run, space, tables, piece, hull)
    margin = _margin(tables, rounding_at_place(run, space, tables, floor_of(space, run.cost)), eps)
    set_hull(atlas, i, hull, limit)
    if not _convex_sides(run, space, tables, np.zeros(3), piece, hull, margin, minima.sides[i]):
        return False
    for k in range(d):
        minima.core[i, 1, k] = min(max(_WIDER * minima.sides[i, k], _WIDE), hull[k])
        minima.core[i, 0, k] = -minima.core[i, 1, k]
    return True


@compiled
def _set_near(
    run: RunCost,
    space: Space,
    tables: RunTables,
    i: int,
    x: Array,
    corners: Array,
    value: float,
    eps: float,
    hidden: bool,
) -> bool:
    """Write minimum i, at x (D,), metres, into the minima of `space`, and the sides of a convex box around it.

    Both are in search coordinates, and `corners` (2, 3) of the region limit the box. In the box the cost falls at most
    `eps` below the cost of x. If `hidden`, no coordinate is farther than `HIDDEN_REACH` metres from x. Return False if
    x is no minimum or costs less than `value`. `tables` is overwritten.
    """
    chart, box, hull, shift, at = space.chart, tables.box, np.zeros(3), np.zeros(3), space.minima[i]
    for k in range(3):
        at[k] = 0.0
        for m in range(x.shape[0]):
            at[k] += chart.back[k, m] * (x[m] - chart.origin[m])
        hull[k] = max(corners[1, k] - at[k], at[k] - corners[0, k], 0.0)
    if chart.surface.shape[0] > 0:  # the surface has two coordinates, and gives the third one
        at[2] = 0.0
    if not cost_at_coordinates(run, space, tables, 0, at) >= value:
        return False
    margin = _margin(tables, rounding_at_place(run, space, tables, floor_of(space, run.cost)), eps)
    if is_elsewhere(chart, box, x):
        return False
    if hidden:
        limit_half_widths(box.sense if chart.surface.shape[0] > 0 else chart.sense, hull)
    if not _convex_sides(run, space, tables, at, 0, hull, margin, space.sides[i]):
        return False
    # The box is reduced by the rounding of its centre.
    widen_by_rounding(chart, box.centre, shift)
    for k in range(3):
        space.sides[i, k] = max(space.sides[i, k] - shift[k], 0.0)
    return True


# The proof.


@compiled
def _reaches_infinity(run: RunCost) -> bool:
    """Return whether the cost stays finite at infinity, so that the atlas applies; see `reaches_infinity`."""
    kinds, rows = run.cost.kinds, run.rows
    ones, out = np.zeros(kinds.shape[0]), np.zeros(rows.w.shape[0])
    for j in range(kinds.shape[0]):
        if infinity_of(kinds[j]) == GROWS:
            return False
        ones[j] = 1.0 if infinity_of(kinds[j]) == DIFFERENCE else 0.0
    return is_balanced(rows, ones, out)


@compiled
def cost_of_place(run: RunCost, x: Array, tables: RunTables) -> float:
    """Return the cost at a position x (D,), metres; the nodes are written into ``tables.box``."""
    cost, box, axes = run.cost, tables.box, np.zeros((3, 3))
    box.half[:], box.centre[:] = 0.0, 0.0
    for k in range(x.shape[0]):
        axes[k, k], box.centre[k] = 1.0, x[k]
    bound_nodes(cost.kinds, cost.data, box.centre, axes, axes, box.half, box.line, box.nodes)
    return residual_at(run.rows, box.nodes, tables.sheet)


class ProofTask(NamedTuple):
    """The request for a proof of one fix.

    Parameters
    ----------
    x : array (D,)
        The fix, metres.
    beside : KnownMinima
        Known minima, and planes or a surface.
    aim : Goal
        The conditions to show for each box.
    eps : float
        A cost that is lower than the cost of the fix by at most eps counts as equal.
    budget : int
        Greatest number of boxes.
    found : array (D,)
        Written: a better or other point.
    """

    x: Array
    beside: KnownMinima
    aim: Goal
    eps: float
    budget: int
    found: Array


@compiled
def prove_run(
    run: RunCost,
    x: Array,
    beside: KnownMinima,
    kappa: float,
    eps: float,
    budget: int,
    lower: Array,
    upper: Array,
    found: Array,
) -> tuple[int, int, float]:
    """Prove the claim of `optloc.proof.local_search.prove_locally` for a run; for arguments and result see there.

    If the cost stays finite at infinity, the search is over all space. Otherwise it is within a region, around a
    surface, or within an enclosure. The enclosure contains all positions at which the few rows cost less than the
    level.
    """
    tables, D = tables_of(run), x.shape[0]
    chart, good = chart_on(run.look, x, tables.small, beside.planes, beside.surface)
    # Without a reference position for ranges: it needs a cost that stays the same if all ranges change by the same
    # length. The cost of the few rows may have this property although the cost of all rows does not.
    chart = without_differences(chart)
    least = cost_of_place(run, x, tables)
    middle, radius = station_cube(run.cost.kinds, run.cost.data, x)
    bound_to = beside.planes.shape[0] + beside.surface.shape[0] > 0 or not isnan(lower[0])
    far = not bound_to and _reaches_infinity(run)
    most, eps = max(COARSEST, eps), equal_within(eps, least, _blur(run, chart, x, far, tables))
    if not eps <= most:
        return COARSE, 0, -inf
    level = least + kappa if kappa > 0.0 else least - eps
    # The search of a run does not read the last two fields, the numbers of minima that do not count.
    aim = Goal(level, least - eps, least - 0.5 * eps, beside.hidden == 0 and isnan(lower[0]), 0, 0)
    task = ProofTask(x, beside, aim, eps, budget, found)
    if far:
        return _prove_far(run, task, atlas_of(middle, radius, D, 1 + beside.points.shape[0]), chart, tables)
    if not good:
        return SINGULAR, 0, -inf
    return _prove_near(run, task, atlas_of(middle, radius, D, 0), chart, tables, lower, upper)


@compiled
def _blur(run: RunCost, chart: LocalAxes, x: Array, far: bool, tables: RunTables) -> float:
    """Return a bound of the rounding of a residual, as a length, at the fix x or (`far`) in the atlas."""
    middle, radius = station_cube(run.cost.kinds, run.cost.data, x)
    atlas, none = atlas_of(middle, radius, x.shape[0], 0), np.empty((0, 3))
    space = Space(False, atlas, chart, none, none)
    cost_at_coordinates(run, space, tables, 0, np.zeros(3))
    noise = rounding_at_place(run, space, tables, floor_of(space, run.cost))
    return float(max(noise, relative_rounding_of(run.rows) * accuracy_floor_far(run.cost, atlas)) if far else noise)


@compiled
def _prove_far(
    run: RunCost, task: ProofTask, atlas: Atlas, chart: LocalAxes, tables: RunTables
) -> tuple[int, int, float]:
    """Prove the claim of `task` over all space; return verdict, number of boxes, and lower bound of the cost."""
    none, known, place, aim = np.empty((0, 3)), zero(), np.empty(task.x.shape[0]), task.aim
    space, stack, others = Space(True, atlas, chart, none, none), np.zeros((CAPACITY, DEPTH)), task.beside.points
    for p in range(1 + others.shape[0]):
        put(task.x if p == 0 else others[p - 1], place)
        hidden = p > others.shape[0] - task.beside.hidden
        if p > 0 and not (hidden or aim.level > aim.value):
            continue
        # A hidden minimum may have any cost, but only points near it are left out.
        least, limit = (-inf, HIDDEN_REACH) if hidden else (aim.better, inf)
        if _set_far(run, space, tables, known, place, least, 0.5 * task.eps, limit):
            known += 1
        elif p == 0:
            return STATIONARY, 0, -inf
    own = with_minima(atlas.middle, atlas.radius, task.x.shape[0], first_minima(atlas.minima, known))
    size, space = push_pieces(stack, own), Space(True, own, chart, none, none)
    outcome, boxes, bound = search_run(run, space, tables, stack, size, aim, task.budget, task.found)
    return _verdict(outcome, aim), boxes, min(bound, aim.value)


@compiled
def _verdict(outcome: int, aim: Goal) -> int:
    """Return the verdict of a proof (UNIQUE, VALUE, BETTER, OTHER, BUDGET, UNBOUNDED) for the outcome of its search."""
    if outcome == CLEAR:
        return UNIQUE if aim.level > aim.value else VALUE
    if outcome == SPENT:
        return BUDGET
    if outcome == INFINITE:
        return UNBOUNDED
    return BETTER if outcome == CHEAPER else OTHER


@compiled
def _prove_near(
    run: RunCost, task: ProofTask, atlas: Atlas, around: LocalAxes, tables: RunTables, lower: Array, upper: Array
) -> tuple[int, int, float]:
    """Prove the claim in search coordinates around a fix: in a region, in an enclosure, or around a surface.

    `around` are the search coordinates around the fix. `lower` and `upper` (D,) are the corners of the region, metres;
    NaN for an enclosure. Return verdict, number of boxes, and lower bound of the cost.
    """
    corners, bent, aim = np.empty((2, 3)), around.surface.shape[0] > 0, task.aim
    stack, total, bound = np.zeros((CAPACITY, DEPTH)), 0, aim.value
    rho = sqrt(max(aim.level, aim.value + task.eps))
    if not region_of(run.look, around, tables.small, rho, lower, upper, corners[0], corners[1]):
        return OPEN, 0, -inf
    alone = not bent or is_one_side(around.surface, around.origin, around.sense, corners[0], corners[1])
    if not alone and not isnan(lower[0]):  # a region that reaches around the Earth
        return OPEN, 0, -inf
    for side in range(1 if alone else SIDES):
        chart = around if side == 0 else axes_of_next_piece(run.look, around, side)
        if side > 0:
            corners[0], corners[1] = -inf, inf
        if bent:
            reach_of_piece(chart.surface, chart.origin, chart.sense, corners[0], corners[1])
        space = _beside(run, task, atlas, chart, tables, corners, side == 0)
        if side == 0 and space.minima.shape[0] == 0:
            return STATIONARY, 0, -inf
        hole = space.sides[0] if side == 0 else np.zeros(3)
        size = push_around(stack, 0, corners[0], corners[1], hole, 0)
        outcome, boxes, low = search_run(run, space, tables, stack, size, aim, task.budget - total, task.found)
        total += boxes
        bound = min(bound, low)
        if outcome != CLEAR:
            return _verdict(outcome, aim), total, bound if alone else -inf
    return UNIQUE if aim.level > aim.value else VALUE, total, bound


@compiled
def _beside(
    run: RunCost, task: ProofTask, atlas: Atlas, chart: LocalAxes, tables: RunTables, corners: Array, own: bool
) -> Space:
    """Return the search coordinates of one piece of the search, with known minima that the search leaves out.

    If `own`, the piece contains the fix, which is the first minimum. Each minimum has a convex box within `corners` (2,
    3). If the fix is no minimum, the list is empty.
    """
    others, known, place = task.beside.points, zero(), np.empty(task.x.shape[0])
    room = np.zeros((2, 1 + others.shape[0], 3))
    space = Space(False, atlas, chart, room[0], room[1])
    for p in range(0 if own else 1, 1 + others.shape[0]):
        put(task.x if p == 0 else others[p - 1], place)
        hidden = p > others.shape[0] - task.beside.hidden
        if p > 0 and not (hidden or task.aim.level > task.aim.value):
            continue
        least = -inf if hidden else task.aim.better
        if _set_near(run, space, tables, known, place, corners, least, 0.5 * task.eps, hidden):
            known += 1
        elif p == 0:
            break
    return Space(False, atlas, chart, room[0, :known], room[1, :known])


def prove_runs(costs: Runs, asked: ProofRequest) -> ProofResult:
    """Return the results of the proofs of n fixes of n long problems, see `optloc.proof.batch.prove_all`.

    Plain Python would take a second for ten boxes. Without compiled code no box is searched.
    """
    n, d = asked.x.shape
    verdict, boxes, bound, everywhere = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n), np.ones(n, np.bool_)
    found, asked = np.full((n, d), np.nan), ProofRequest(*(plainly(array) for array in asked))

    def prove(i: int) -> None:
        """Write the result of proof i: for the requested region, then, if that region is open, for the fallback."""
        others = asked.others[i, : asked.known[i]]
        known = KnownMinima(others, int(asked.hidden[i]), asked.planes[i], asked.surface[i])
        for corners in (asked.region[i], asked.fallback[i]):
            verdict[i], boxes[i], bound[i] = prove_run(
                costs.runs[i],
                asked.x[i],
                known,
                asked.gaps[i, 0],
                asked.eps[i],
                int(asked.budget[i]),
                corners[0],
                corners[1],
                found[i],
            )
            everywhere[i] = np.isnan(corners[0, 0])
            if verdict[i] != OPEN or not everywhere[i]:
                break

    if may_use_code(prove_run, n):
        map_on_threads(prove, range(n))
    else:
        verdict[:], bound[:] = BUDGET, -inf
    return without_rivals(verdict, boxes, bound, everywhere, asked, found)


def runs_lack_code(costs: Runs | CourseCosts, count: int) -> bool:
    """Return whether proofs of `count` long problems were skipped because their compiled code is not yet available."""
    return enabled() and not may_use_code(prove_run if isinstance(costs, Runs) else prove_course, count)


def costs_of_runs(costs: Runs, x: Array) -> tuple[Array, Array]:
    """Return costs (n, P) at positions x (n, P, d), m, and the rounding of their residuals, see `costs_at`."""
    out = np.zeros((2, *x.shape[:2]))
    for i, run in enumerate(costs.runs):
        tables = tables_of(run)
        for p, place in enumerate(plainly(x[i])):
            out[0, i, p] = cost_of_place(run, place, tables)
            floor = accuracy_floor(run.cost.kinds, run.cost.data, run.cost.weight, run.cost.w, tables.box.centre, LINES)
            out[1, i, p] = rounding_of_residual(run.rows, floor, tables.box.nodes)
    return out[0], out[1]


# Targets that move.


def prove_courses(costs: CourseCosts, asked: ProofRequest) -> ProofResult:
    """Return the results of the proofs of n fixes of n problems of a moving target.

    The fixes x contain position and velocity, m and m/s. Without compiled code no box is searched, as in `prove_runs`.
    """
    n, size = asked.x.shape
    verdict, boxes, bound = np.full(n, BUDGET), np.zeros(n, np.int64), np.full(n, -inf)
    found = np.full((n, size), np.nan)

    def prove(i: int) -> None:
        """Write the result of proof i: within the requested region of states."""
        (whole, few), ground = _with_axes_around(costs.courses[i], asked.x[i])
        state, others, corners = asked.x[i], asked.others[i, : asked.known[i]], asked.region[i]
        if over_ground(ground):
            state, others, corners = state_on(ground, state), state_on(ground, others), corners_on(ground, corners)
        state, found_state = plainly(state), np.full(STATE, np.nan)
        axes = axes_of(hessian_of_state(whole, state), state, plainly(corners))
        if axes is None:
            verdict[i] = STATIONARY
            return
        verdict[i], boxes[i], bound[i] = prove_course(
            whole, few, axes, plainly(others), asked.gaps[i, 0], asked.eps[i], int(asked.budget[i]), found_state
        )
        found[i] = state_off(ground, found_state) if over_ground(ground) else found_state

    if may_use_code(prove_course, n):
        map_on_threads(prove, range(n))
    return without_rivals(verdict, boxes, bound, np.zeros(n, np.bool_), asked, found)


def _with_axes_around(
    courses: tuple[ConstantVelocityCost, ConstantVelocityCost], state: Array
) -> tuple[tuple[ConstantVelocityCost, ConstantVelocityCost], Ground]:
    """Return courses whose axes of states are set around one state, and the surface on which they move.

    The two courses are the cost of all rows and the cost of few rows. In the plane they stay as they are.
    """
    if not over_ground(courses[0].ground):
        return courses, courses[0].ground
    axes = axes_at(courses[0].ground.data, state[:3])
    whole, few = (course._replace(ground=course.ground._replace(axes=axes)) for course in courses)
    return (whole, few), whole.ground


def costs_of_courses(costs: CourseCosts, states: Array) -> tuple[Array, Array]:
    """Return costs (n, P) of states (n, P, 2 d), m and m/s, and the rounding of their residuals, see `costs_at`."""
    out = np.zeros((2, *states.shape[:2]))
    for i, (whole, _) in enumerate(costs.courses):
        for p, state in enumerate(plainly(states[i])):
            out[:, i, p] = cost_of_state(whole, state)
    return out[0], out[1]
