"""Conditions that an answer must meet: inequalities; a target that the Earth hides from a station is refused too.

If the best candidate breaks an inequality, the cost is minimised along every face of the inequalities. A *face* is a
set of inequalities that are satisfied with equality.

Letters: N problems, q slots for candidates, M starts or points of several problems, `size` numbers of a
parameter vector. Costs are chi-square values.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace

import numpy as np

from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array, Status
from optloc.kernels.least_squares import refine
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import (
    TOLERANCE,
    Face,
    exact,
    faces,
    is_held,
    levels,
    outwards,
    violation,
)
from optloc.linear.normal import marginal
from optloc.problem.chart import tail_probability
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.solvers.around import starts_around
from optloc.solvers.face_starts import limited_to, spread_along, structure
from optloc.solvers.horizon import first_sentence, is_hidden, name_hidden
from optloc.solvers.layered import in_every_layer, refine_in_layers, strata_of
from optloc.solvers.policy import P_MISFIT
from optloc.solvers.pool import Pool
from optloc.solvers.retraction import descend_along, is_on

Descend = Callable[[Problem, Array, Array, Face], tuple[Array, Array, Array]]
"""Maps problems, starts (M, size), the problem of each start (M,) and a face to points, costs and statuses there."""

# Starts on each face: the cheapest candidates. Those that break a constraint are beyond the face that will be active,
# and its minimum is next to one of them. Each start takes a refinement on every face.
_STARTS = 3


# As many steps as in `lsr`: minima on a face must converge as well as minima inside.
_STEPS = 100


def by_least_squares(problem: Problem, start: Array, item: Array, face: Face) -> tuple[Array, Array, Array]:
    """Return x (M, size), cost (M,) and status (M,) of the minima on a face next to starts.

    `start` (M, size) are the starts, and `item` (M,) is the problem of each start.
    """
    strata = strata_of(problem, face)
    if strata is not None:
        done = refine_in_layers(problem, strata, start, item, face, _STEPS)
        return done.x, done.cost, done.status
    done = refine(problem, start, item=item, face=face, limit=_STEPS)
    x, cost, status = done.x, done.cost, done.status
    # other unknowns of single epochs than emission times would have to be fitted after each projection
    simple = problem.layout.size == problem.layout.n_shared or bool(problem.emitting)
    if not (simple and face):
        return x, cost, status
    left = np.flatnonzero((status != Status.OK) & ~is_on(problem.take(item), face, x))
    if not len(left):
        return x, cost, status
    again, least, code = descend_along(problem.take(item[left]), face, start[left])
    held = code != Status.NUMERICAL
    if not held.any():
        return x, cost, status
    left, again, least, code = left[held], again[held], least[held], code[held]
    # the last digits, unless the refinement leaves the face again
    part = problem.take(item[left])
    last = refine(part, again, face=face, limit=_STEPS)
    better = (last.status == Status.OK) & is_on(part, face, last.x) & (last.cost <= least)
    x, cost, status = x.copy(), cost.copy(), status.copy()
    x[left] = np.where(better[:, None], last.x, again)
    cost[left] = np.where(better, last.cost, least)
    status[left] = np.where(better, np.int8(Status.OK), code)
    return x, cost, status


def bound_pool(problem: Problem, pool: Pool, descend: Descend = by_least_squares) -> Pool:
    """Return the feasible candidates of a flat batch, with candidates on faces if the cheapest breaks a constraint.

    A target that the Earth hides from a station with a row of it is not feasible either.

    A face is a set of inequalities that can be satisfied with equality together. The cost is minimised on each face
    from the cheapest candidates, and the feasible results compete. The cheapest one meets the conditions of Karush,
    Kuhn and Tucker.

    Parameters
    ----------
    problem : Problem
        N problems with constraints.
    pool : Pool
        Refined under the equalities only.
    descend : callable
        Minimises the cost of the pool on a face; its arguments are problems, starts, the problem of each start, and the
        face.

    Returns
    -------
    Pool
        Infeasible candidates have infinite cost and status `infeasible`.
    """
    broken = _breaks(problem, pool)
    if not broken.any():
        return pool
    return _keep_misfits(problem, pool, broken, _bound(problem, pool, broken, descend))


def _bound(problem: Problem, pool: Pool, broken: Array, descend: Descend) -> Pool:
    """Return the pool of `bound_pool`: flagged candidates are infeasible, and minima on faces are added.

    `broken` (N, q) flags the candidates that break a constraint or are hidden. `descend` minimises the cost on a face.
    """
    sides = faces(problem)
    first = np.argmin(np.where(np.isfinite(pool.cost), pool.cost, np.inf), axis=1)
    unanswered = np.flatnonzero(broken[np.arange(len(first)), first])
    # finished candidates that noise explains, but that are not admitted: a sentence names those behind the Earth
    refused = np.where(broken & (pool.code == Status.OK) & _fits(pool, pool.cost), pool.cost, np.inf)
    kept = replace(
        _mark_infeasible(pool, broken), hidden=first_sentence(name_hidden(problem, pool.x, refused), pool.hidden)
    )
    # a feasible cheapest candidate is the answer, and without inequalities there is no other face
    if not len(unanswered) or sides == [exact(problem)]:
        return kept
    found = _search(problem, pool, kept, sides, unanswered, descend)
    x, cost, code, face, refused_on_faces = _in_rows(found, unanswered, len(pool.x))
    refused_on_faces = np.where(_fits(pool, refused_on_faces), refused_on_faces, np.inf)
    # the slope of the cost inwards is computed for least squares, so a robust loss is not tested
    if not pool.loss:
        inside = np.where(kept.code == Status.OK, kept.cost, np.inf).min(1)
        falling = _falls(problem, sides, inside, x, cost, face)
        cost, code = np.where(falling, np.inf, cost), np.where(falling, np.int8(Status.INFEASIBLE), code)
    return replace(
        kept,
        hidden=first_sentence(kept.hidden, name_hidden(problem, x, refused_on_faces)),
        x=np.concatenate([kept.x, x], axis=1),
        cost=np.concatenate([kept.cost, cost], axis=1),
        code=np.concatenate([kept.code, code], axis=1),
        face=np.concatenate([kept.face, face], axis=1),
    )


Found = tuple[Array, Array, Array, Array, Array]
"""Minima on faces: x (n, q, size), and cost, code, face and cost if infeasible (n, q); infinite costs if none."""

# Rise of chi-square above the cheapest candidate from which minima are searched all along the faces: the constraints
# move the fix by two standard deviations. Below that the least minimum is next to the candidate.
_RISE = 4.0
# Minima of the wider search that are kept for each problem, the cheapest.
_KEPT = 12


def _search(problem: Problem, pool: Pool, kept: Pool, sides: list[Face], items: Array, descend: Descend) -> Found:
    """Return the minima on all faces of the problems `items` (n,), whose cheapest candidate is not admitted.

    `pool` and `kept` are the candidates with and without those that are not admitted, and `sides` are all faces. If the
    faces cost much more than the cheapest candidate, they are searched along their whole length.
    """
    starts, strata = _cheapest(pool, items, _STARTS), strata_of(problem)
    starts = starts if strata is None else in_every_layer(strata, starts)
    # face 0 has no inequality, and its minima are in the pool already
    around = [starts_around(problem, side, items, starts[:, 0]) for side in sides[1:]]
    wider = [np.concatenate([starts, one], axis=1) for one in around]
    found = _on_faces(problem, sides, items, wider, descend)
    inside = np.where(kept.code == Status.OK, kept.cost, np.inf)[items].min(1)
    least = np.minimum(found[1].min(1, initial=np.inf), inside)
    finished = np.where((pool.code == Status.OK) & np.isfinite(pool.cost), pool.cost, np.inf)[items].min(1)
    with np.errstate(invalid="ignore"):
        rise = np.where(np.isfinite(least), least - finished, np.inf)
    again = np.flatnonzero((rise > _RISE) & np.isfinite(finished))
    if not len(again):
        return found
    part, candidates = problem.take(items[again]), _cheapest(pool, items[again], pool.x.shape[1])
    spread = spread_along(part, sides, candidates, rise[again])
    more = _cheapest_found(_on_faces(problem, sides, items[again], spread, descend), _KEPT)
    more = _in_rows(more, again, len(items))
    x, cost, code, face, refused = (np.concatenate(both, axis=1) for both in zip(found, more, strict=True))
    return x, cost, code, face, refused


def _cheapest_found(found: Found, count: int) -> Found:
    """Return the `count` cheapest minima of each problem."""
    x, cost, code, face, refused = found
    order = np.argsort(cost, axis=1, kind="stable")[:, :count]
    x = np.take_along_axis(x, order[..., None], axis=1)
    cost, code, face, refused = (np.take_along_axis(one, order, axis=1) for one in (cost, code, face, refused))
    return x, cost, code, face, refused


def _in_rows(found: Found, items: Array, size: int) -> Found:
    """Return the minima of the problems `items` (n,) in arrays for all `size` problems; the others have no minimum."""
    count = found[1].shape[1]
    x = np.full((size, count, found[0].shape[-1]), np.nan)
    cost, refused = (np.full((size, count), np.inf) for _ in range(2))
    code, face = np.full((size, count), int(Status.INFEASIBLE), dtype=np.int8), np.zeros((size, count), dtype=int)
    x[items], cost[items], code[items], face[items], refused[items] = found
    return x, cost, code, face, refused


def _keep_misfits(problem: Problem, before: Pool, broken: Array, pool: Pool) -> Pool:
    """Return a pool that keeps misfits behind the Earth for problems without a visible minimum.

    A wrong row may move the best minimum of a good network behind the Earth. Then the reason is the misfit, not the
    horizon. `before` is the pool before the candidates `broken` (N, q) lost their costs.
    """
    unseen = ~((pool.code == Status.OK) & np.isfinite(pool.cost)).any(1)
    restored = broken & unseen[:, None] & (before.code == Status.OK) & ~_fits(before, before.cost)
    item, slot = np.nonzero(restored & np.isfinite(before.x).all(-1))
    if not len(item):
        return pool
    inside = violation(problem.take(item), before.x[item, slot]) <= TOLERANCE
    item, slot = item[inside], slot[inside]
    cost, code = pool.cost.copy(), pool.code.copy()
    cost[item, slot], code[item, slot] = before.cost[item, slot], before.code[item, slot]
    return replace(pool, cost=cost, code=code)


def _fits(pool: Pool, cost: Array) -> Array:
    """Return flags (N, q) of costs (N, q) that noise explains; all True for a robust loss, which has no such test."""
    if pool.loss:
        return np.ones(cost.shape, dtype=bool)
    return ~(tail_probability(cost, pool.dof[:, None]) < P_MISFIT)


def without_broken(problem: Problem, pool: Pool) -> Pool:
    """Return a pool in which candidates that break a constraint, or are hidden, are infeasible: infinite cost."""
    return _mark_infeasible(pool, _breaks(problem, pool))


def _breaks(problem: Problem, pool: Pool) -> Array:
    """Return flags (N, q) of candidates that break a constraint, or that the Earth hides from a station."""
    broken = np.zeros(pool.cost.shape, dtype=bool)
    item, slot = np.nonzero(np.isfinite(pool.x).all(-1))
    if len(item) and (problem.constraints or problem.frame.geodetic):
        part, x = problem.take(item), pool.x[item, slot]
        broken[item, slot] = (violation(part, x) > TOLERANCE) | is_hidden(part, x)
    return broken


def _mark_infeasible(pool: Pool, broken: Array) -> Pool:
    """Return a pool in which the candidates `broken` (N, q) are infeasible, with infinite cost."""
    cost = np.where(broken, np.inf, pool.cost)
    return replace(pool, cost=cost, code=np.where(broken, np.int8(Status.INFEASIBLE), pool.code))


def _cheapest(pool: Pool, items: Array, count: int) -> Array:
    """Return the cheapest candidates (n, q, size) of problems `items` (n,), q at most `count`; NaN in empty slots."""
    order = np.argsort(pool.cost[items], axis=1, kind="stable")[:, :count]
    x = np.take_along_axis(pool.x[items], order[..., None], axis=1)
    good = np.isfinite(np.take_along_axis(pool.cost[items], order, axis=1))
    return np.where(good[..., None], x, np.nan)


# Most starts that are refined together: their normal equations need some tens of megabytes.
_TOGETHER = 2**14


def _on_faces(problem: Problem, sides: list[Face], items: Array, starts: list[Array], descend: Descend) -> Found:
    """Return the minima on each face but the first, one face after the other.

    `sides` is the list of all faces. `items` (n,) are the numbers of the problems, and `starts` has the starts (n, q,
    size) on each face but the first. Faces with the same quantities are one batch: a road has many of them.
    """
    found: dict[int, Found] = {}
    groups: dict[tuple[Hashable, ...], list[int]] = {}
    for number in range(1, len(sides)):
        groups.setdefault(structure(problem, sides[number]), []).append(number)
    most = max(1, _TOGETHER // max(1, len(items) * max((one.shape[1] for one in starts), default=1)))
    for numbers in groups.values():
        for first in range(0, len(numbers), most):
            chosen = numbers[first : first + most]
            own = [starts[number - 1] for number in chosen]
            found |= dict(zip(chosen, _on_alike(problem, sides, chosen, items, own, descend), strict=True))
    ordered = [found[number] for number in range(1, len(sides))]
    x, cost, code, face, refused = (np.concatenate(parts, axis=1) for parts in zip(*ordered, strict=True))
    return x, cost, code, face, refused


def _on_alike(
    problem: Problem, sides: list[Face], numbers: list[int], items: Array, starts: list[Array], descend: Descend
) -> list[Found]:
    """Return the minima on faces with the same quantities, one entry for each face.

    `numbers` are the indices of these faces in `sides`, and `starts` has the starts (n, q, size) on each of them.
    `items` are as for `_on_faces`. Costs are infinite in slots without a minimum.
    """
    places = [np.nonzero(np.isfinite(one).all(-1)) for one in starts]
    own = np.concatenate([items[row] for row, _ in places])
    start = np.concatenate([one[place] for one, place in zip(starts, places, strict=True)])
    if not len(own):
        empty = np.zeros(0)
        return [
            _filled(n, one, place, start, empty, empty, empty)
            for n, one, place in zip(numbers, starts, places, strict=True)
        ]
    part = problem.take(own)
    limited, face = limited_to(problem, [sides[n] for n in numbers], own, [len(row) for row, _ in places])
    ends, cost, status = descend(limited, start, np.arange(len(own)), face)
    # bent levels need not meet, and a point on one of them only is no minimum on both
    on_levels = is_on(limited, face, ends)
    # a minimum on a face may break another constraint; the face of both constraints is tried too
    inside = on_levels & (violation(part, ends) <= TOLERANCE) & ~is_hidden(part, ends) & np.isfinite(cost)
    code = np.where(inside, status, np.int8(Status.INFEASIBLE))
    refused = np.where(inside | (status != Status.OK), np.inf, cost)
    out, first = [], 0
    for number, one, place in zip(numbers, starts, places, strict=True):
        end = first + len(place[0])
        least = np.where(inside, cost, np.inf)[first:end]
        out.append(_filled(number, one, place, ends[first:end], least, code[first:end], refused[first:end]))
        first = end
    return out


def _filled(
    number: int, starts: Array, place: tuple[Array, ...], x: Array, cost: Array, code: Array, refused: Array
) -> Found:
    """Return the results of one face in the slots `place` of its `starts` (n, q, size); see `_on_alike`."""
    shape = starts.shape[:2]
    costs, codes = np.full(shape, np.inf), np.full(shape, int(Status.INFEASIBLE), dtype=np.int8)
    ends, left = np.array(starts), np.full(shape, np.inf)
    ends[place], costs[place], codes[place], left[place] = x, cost, code, refused
    return ends, costs, codes, np.full(shape, number), left


def is_minimum(problem: Problem, face: Face, x: Array) -> Array:
    """Return flags (N,) of minima x (N, size) along a face that are minima of all admitted positions.

    The minimum must meet every constraint and be visible from every station with a row of it. The cost must grow from
    the face inwards: the conditions of Karush, Kuhn and Tucker.
    """
    good = (violation(problem, x) <= TOLERANCE) & ~is_hidden(problem, x)
    if len(x) and len(face) > len(exact(problem)):
        beside = _inwards(problem, face, x)
        information, vector, _ = marginal(equations_at(problem, beside))
        good &= is_held(problem, face, x, vector, information)
    return np.asarray(good)


# Share of the spread of the stations by which a point is moved off a face.
_INSIDE = 1e-6


def _inwards(problem: Problem, face: Face, x: Array) -> Array:
    """Return points (N, size) slightly inside a face, from points x (N, size) on it.

    The slope of the cost is taken there: on a plane of symmetry a saddle has no slope.
    """
    gradients = levels(problem, face, x)[1]
    sense = np.array([outwards(problem, level) for level in face])
    away = (sense[:, None] * gradients).sum(1)
    names = {state_names(target, len(problem.motions), 0)[0] for target in range(len(problem.motions))}
    own = [slot for slot in problem.layout.shared if slot.name in names]
    part = np.concatenate([np.arange(slot.start, slot.start + slot.size) for slot in own])
    length = np.sqrt((away[:, part] ** 2).sum(-1, keepdims=True))
    _, spread = centre_and_spread(problem.stations.places)
    out = np.array(x)
    with np.errstate(invalid="ignore", divide="ignore"):
        step = _INSIDE * np.reshape(spread, (-1, 1)) * away[:, part] / length
    out[:, part] -= np.where(np.isfinite(step), step, 0.0)
    return out


def _falls(problem: Problem, sides: list[Face], inside: Array, x: Array, cost: Array, face: Array) -> Array:
    """Return flags (N, q) of minima on faces from which the cost falls inwards, except for the cheapest minimum.

    `inside` (N,) is the least cost of a minimum on no face. `sides` is the list of all faces, and `face` (N, q) the
    index of the face of each minimum. The cheapest of all minima is always a minimum of the admitted positions. If a
    descent missed it, the cheapest minimum found is kept alone.
    """
    minimal = np.zeros(cost.shape, dtype=bool)
    for number in range(1, len(sides)):
        item, slot = np.nonzero(np.isfinite(cost) & (face == number))
        minimal[item, slot] = is_minimum(problem.take(item), sides[number], x[item, slot])
    least = np.minimum(np.where(minimal, cost, np.inf).min(1), inside)
    cheapest = np.minimum(cost.min(1, initial=np.inf), inside)
    return np.asarray(~minimal & ((cost >= least[:, None]) | (cost > cheapest[:, None])))


def without_falling(problem: Problem, pool: Pool) -> Pool:
    """Return a pool in which minima on faces from which the cost falls inwards are infeasible; the cheapest stays.

    A new minimum may show that the cheapest point before is no minimum. A pool of a robust loss is unchanged.
    """
    if pool.loss:
        return pool
    on_face = pool.face > 0
    inside = np.where((pool.code == Status.OK) & ~on_face, pool.cost, np.inf).min(1, initial=np.inf)
    cost = np.where(on_face, pool.cost, np.inf)
    return _mark_infeasible(pool, on_face & _falls(problem, faces(problem), inside, pool.x, cost, pool.face))
