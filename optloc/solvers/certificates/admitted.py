"""Proofs for problems with inequalities: whether a fix is the best position that the constraints admit.

A minimum under inequalities is a minimum over all positions, or a minimum along a face: a set of inequalities that are
satisfied with equality. So every candidate is among the minima along the faces, and each face is a problem without
inequalities. Minima that violate another constraint do not count. Minima from which the cost falls inwards do not
count either.

Face 0 has no inequality, so it is the problem without inequalities. In messages, a face with inequalities is an edge.

Letters: n problems, q slots for minima of a problem, d coordinates, `size` numbers of a parameter vector. Costs are
chi-square values. `margin` is the difference of costs to prove: other minimum minus fix. `effort` multiplies the
number of boxes that a proof may use.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Annotated

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.records import Axes, overwrite, take
from optloc.base.types import Array, Status
from optloc.kernels.least_squares import refine
from optloc.linear.constraints import (
    Face,
    exact,
    face_names,
    faces,
    is_corner,
    is_exact,
    on_face,
    restore,
    violation_names,
)
from optloc.linear.vectors import vectors
from optloc.model_checks.truncation import has_law
from optloc.problem.claims import GLOBAL, REGION, Claims, empty_claims
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Stage
from optloc.problem.problem import Problem
from optloc.proof.batch import ProofRequest
from optloc.proof.local_search import BETTER, STATIONARY, VALUE
from optloc.proof.position_costs import PositionCosts
from optloc.proof.scope import is_run, why_unsupported
from optloc.solvers.certificates.branch_and_bound import (
    HELD,
    RESTLESS,
    budgets,
    certified_freely,
    certify_stage,
    claims_before,
    fixes_to_prove,
    keep_evidence,
    state_claims,
    unknown_claim,
)
from optloc.solvers.certificates.known_positions import certified_linear, is_linear
from optloc.solvers.certificates.known_targets import certified_alone, has_known_target
from optloc.solvers.certificates.moving_medium import certified_at_rest, problem_at_rest
from optloc.solvers.certificates.out_of_reach import edges_of, out_of_reach
from optloc.solvers.certificates.position_cost import (
    Costs,
    admitted_states,
    costs_of,
    eliminate_nuisance,
    is_free,
    prove,
    state_columns,
    surfaces_of,
)
from optloc.solvers.inequalities import is_minimum, without_falling
from optloc.solvers.outside import accept
from optloc.solvers.policy import AMBIGUOUS_GAP, LISTED_GAP, equal_cost
from optloc.solvers.pool import Pool, in_parts, noting_place, offer, pack
from optloc.solvers.stages import lsr
from optloc.solvers.verdict.judge import failed_fixes, filled_objects, judge, verdict
from optloc.solvers.verdict.minima import settle

# Most restarts of a proof that a face costs too much, and refinement steps of a restart. A proof restarts at a cheaper
# position that it found, or some steps nearer to the minimum if the cost is steep at its position.
_BEGINS, _STEPS = 12, 8
# Rounds of new minima along faces and repeated proofs: one round is enough except for batches of bad fixes.
_ROUNDS = 4
UNFOLLOWED = "the proof does not cover the edge {}: {}"
LEFT = "no minimum was found along the edge {}"


def certified(
    problem: Problem, pool: Pool | None, region: Array | None = None, margin: float = LISTED_GAP, effort: float = 1
) -> Pool:
    """Return the pools of a flat batch with certificates: the stage "certify".

    `region` (2, d) has the corners of the requested box, metres, as of `certify`. `margin` is the gap of cost to prove
    to other minima. `effort` multiplies the number of boxes that a proof may use.
    """
    if pool is not None and not pool.loss and region is None and is_linear(problem):
        return certified_linear(problem, pool, margin)
    if pool is not None and not pool.loss and has_known_target(problem):
        return certified_alone(problem, pool, certified, region, margin, effort)
    still = problem_at_rest(problem)
    if still is not None and pool is not None and not pool.loss:
        return certified_at_rest(problem, pool, still, certified, region, margin, effort)
    limited = any(not is_exact(constraint) for constraint in problem.constraints)
    if pool is None or region is not None or not limited or why_unsupported(problem) or problem.motions[0].order:
        return certified_freely(problem, pool, region, margin, effort)
    began, stages, fix = perf_counter(), pool.stages, judge(problem, pool)
    proven = claims_before(pool)
    asked, proven_before = fixes_to_prove(pool, fix)
    if pool.tried_before is not None:
        proven.write(proven_before, take(pool.tried_before.proven, proven_before))
    items, more = np.flatnonzero(asked & ~proven_before), 0
    pool, claims, done = _prove_freely(problem, pool, items, margin, effort)
    proven.write(items[done], take(claims, done))
    items, fix = items[~done], judge(problem, pool)
    for _ in range(_ROUNDS):
        if not len(items):
            break
        part, part_pool = problem.take(items), take(pool, items)
        claims, minima = _prove_within(part, part_pool, fix[items], margin, effort)
        new = _with_minima(part, part_pool, minima)
        better = judge(part, new)
        changed = np.flatnonzero(_is_new(fix[items], better))
        proven.write(items, claims)
        if not has_law(problem):  # the covariance of a fix with an active inequality describes the edge only
            proven.write(items[~is_free(problem, fix, items)], unknown_claim(HELD))
        more += len(changed)
        pool = pool.merge(items[changed], take(new, changed))
        fix = overwrite(fix, items[changed], better[changed])
        # fixes that changed and have an answer need another proof
        items = items[changed[better.answered[changed]]]
    # the fixes that still change after the last round
    proven.write(items, unknown_claim(RESTLESS))
    detail = f"{int(asked.sum())} within {violation_names(problem)}" + (f", {more} other minima found" if more else "")
    return replace(pool, proven=proven, stages=(*stages, certify_stage(detail, began)))


def _prove_freely(
    problem: Problem, pool: Pool, items: Array, margin: float, effort: float
) -> tuple[Pool, Claims, Array]:
    """Return pools after proofs of items without inequalities, claims of the items, and flags (n,) of valid claims.

    A claim is valid if the bounds are out of reach: then the fix is the only minimum, with and without bounds. `items`
    (n,) are numbers of problems. The claims have n entries.
    """
    edges, part = edges_of(problem), problem.take(items)
    if edges is None or is_run(problem) or not len(items):
        return pool, empty_claims(len(items)), np.zeros(len(items), dtype=bool)
    new = certified_freely(part, take(pool, items), None, margin, effort)
    fix, claims = judge(part, new), new.proven
    assert claims is not None
    alone = ~np.isfinite(fix.alternatives.gap).any(-1) & fix.answered & is_free(part, fix, np.arange(len(items)))
    sure = np.flatnonzero(alone & (claims.proof == GLOBAL) & claims.unique & (claims.margin >= margin))
    holds = np.zeros(len(items), dtype=bool)
    if len(sure):
        costs = eliminate_nuisance(part.take(sure))
        assert isinstance(costs, PositionCosts)
        holds[sure] = out_of_reach(part.take(sure), edges, costs, fix[sure], margin)
    # a better minimum that the proof found is kept
    kept = replace(new, proven=pool.proven if pool.proven is None else take(pool.proven, items))
    return pool.merge(items, kept), claims, holds


def _is_new(fix: Fix, other: Fix) -> Array:
    """Return flags (n,) of other fixes that replace the fixes: lower cost, more alternatives, or no answer.

    A replaced fix needs a new proof.
    """
    with np.errstate(invalid="ignore"):
        lower = other.cost < fix.cost - equal_cost(fix.cost)
    more = np.isfinite(other.alternatives.gap).sum(1) > np.isfinite(fix.alternatives.gap).sum(1)
    return np.asarray(lower | more | ~other.answered)


@dataclass(frozen=True, slots=True)
class FaceMinima:
    """Minima and bounds of n problems along one face.

    Parameters
    ----------
    x : array (n, q, size)
        Minima along the face; NaN in empty slots.
    cost : array (n, q)
        Their costs; infinite in empty slots.
    least, rest : array (n,)
        Lower bounds of the cost minus the cost of the fix; -inf if not proven. `least` is the bound for every point of
        the face, and `rest` the bound for every minimum that is not in `x`.
    boxes : int array (n,)
        Boxes used.
    why : object array (n,)
        Why nothing is proven, or "".
    """

    x: Annotated[Array, Axes(2, slots=True)]
    cost: Annotated[Array, Axes(1, slots=True, empty=np.inf)]
    least: Annotated[Array, Axes(0)]
    rest: Annotated[Array, Axes(0)]
    boxes: Annotated[Array, Axes(0)]
    why: Annotated[Array, Axes(0)]


Minima = tuple[Array, Array, Array]
"""Vectors (n, q, size), costs (n, q) and numbers of faces (n, q); infinite costs in empty slots."""


def _with_minima(problem: Problem, pool: Pool, minima: Minima) -> Pool:
    """Return settled pools with additional minima, which are already refined.

    The caller judges these pools again, since a new minimum may be the best one or an alternative.
    """
    x, cost, face = minima
    filled = np.isfinite(cost)
    code = np.where(filled, np.int8(Status.OK), np.int8(Status.INFEASIBLE))

    def join(one: Array, other: Array) -> Array:
        return np.concatenate([one, other], axis=1)

    both = replace(
        pool,
        x=join(pool.x, x),
        cost=join(pool.cost, cost),
        code=join(pool.code, code),
        face=join(pool.face, face),
    )
    stage = Stage("certify", f"{int(filled.sum())} minima along edges", 0.0)
    return keep_evidence(settle(problem, without_falling(problem, both), stage), pool)


def _prove_within(problem: Problem, pool: Pool, fix: Fix, margin: float, effort: float) -> tuple[Claims, Minima]:
    """Return claims (n,) about fixes under inequalities, and the minima along all explored faces.

    The cost of a minimum that the constraints do not admit is infinite.
    """
    all_faces, known, found_minima, costs = (
        faces(problem),
        dict[Face, FaceMinima](),
        list[Minima](),
        eliminate_nuisance(problem),
    )
    proven_gap, boxes = np.full(len(pool), margin), np.zeros(len(pool), dtype=np.int64)
    reasons, seeds, all_admitted = filled_objects(len(pool), ""), pool.x, np.zeros(len(pool), dtype=bool)
    for number, face in enumerate(all_faces):
        # the cost along a part of an edge is at least the cost along the whole edge
        above = _least_around(known, face, len(pool))
        if not (above < margin).any():
            continue
        along = known[face] = _explore_face(problem, costs, fix, face, seeds, margin, effort)
        face_gap, admitted = np.maximum(above, along.rest), _is_admitted(problem, face, along)
        if number:
            # The proof does not cover every edge. If all free minima are admitted, the cost falls from an uncovered
            # edge to one of them, so this edge needs no proof.
            face_gap = np.where(np.isfinite(along.rest) | ~all_admitted, face_gap, margin)
        else:
            # the minima without inequalities start the searches along all other faces
            seeds = pack(np.concatenate([fix.x[:, None], along.x], axis=1))
            all_admitted = np.asarray((admitted | ~(along.cost < fix.cost[:, None] + margin)).all(1))
        found_minima.append((along.x, np.where(admitted, along.cost, np.inf), np.full(admitted.shape, number)))
        proven_gap, boxes = np.minimum(proven_gap, face_gap), boxes + along.boxes
        reasons = np.where((face_gap < 0.0) & (reasons == ""), along.why, reasons)
    # -inf means that a face is not proven; any other negative gap means that a cheaper minimum is not excluded
    listed = (fix.alternatives.gap < proven_gap[:, None]).sum(1)
    bound = fix.cost - equal_cost(fix.cost)
    claims, unproven = state_claims(fix.cost, bound, proven_gap, boxes, listed), proven_gap < 0.0
    claims.write(unproven, unknown_claim(""))
    claims.reason[unproven], claims.boxes[unproven] = reasons[unproven], boxes[unproven]
    x, cost, face_of = (np.concatenate(each, axis=1) for each in zip(*found_minima, strict=True))
    return claims, (x, cost, face_of)


def _least_around(known: dict[Face, FaceMinima], face: Face, size: int) -> Array:
    """Return lower bounds (n,) of the cost of a face minus the cost of the fixes, from faces that contain it.

    `known` has the faces explored before; -inf without a bound. A face with fewer constraints contains the face. `size`
    is n.
    """
    levels_of_face = set(face)
    around = [along.least for other, along in known.items() if levels_of_face > {*other}]
    return np.asarray(np.max([np.full(size, -np.inf), *around], axis=0))


def _explore_face(
    problem: Problem, costs: Costs, fix: Fix, face: Face, seeds: Array, margin: float, effort: float
) -> FaceMinima:
    """Return minima and bounds of n problems along a face; without minima if the whole face costs too much.

    Most faces are far from the region that the data support. Their proof needs few boxes, and a search for their
    minima, which may be flat and hard to find, is skipped. `costs` are the position costs of the problems, and `seeds`
    (n, q, size) are the starts of the search for minima.
    """
    n, size = len(seeds), seeds.shape[-1]
    costly, boxes = np.zeros(n, dtype=bool), np.zeros(n, dtype=np.int64)
    # a face with inequalities may cost too much as a whole
    if len(face) > len(exact(problem)) and not why_unsupported(on_face(problem, face)):
        limits = admitted_states(problem, problem.dimension)
        costly, boxes = _is_costly(on_face(problem, face), limits, costs, seeds, fix.cost + margin, effort)
    # a face that costs too much is at least the margin above the fix, and has no minimum of interest
    least = np.full(n, margin)
    out = FaceMinima(np.full((n, 1, size), np.nan), np.full((n, 1), np.inf), least, least, boxes, filled_objects(n, ""))
    rest = np.flatnonzero(~costly)
    if not len(rest):
        return out
    result = _prove_face(problem.take(rest), fix[rest], face, seeds[rest], margin, effort)
    return overwrite(out, rest, replace(result, boxes=result.boxes + boxes[rest]))


def _is_costly(
    on: Problem, limits: Array, costs: Costs, seeds: Array, level: Array, effort: float
) -> tuple[Array, Array]:
    """Return flags (n,) of problems on a face whose cost is at least `level` (n,) everywhere, and the boxes used (n,).

    `on` has the n problems with the face as equalities. `costs` are the position costs without the face, and `seeds`
    (n, q, size) are starts. The proof covers positions within the limits (2, d) of the coordinates: no position beyond
    is admitted.

    A proof has the form: no position costs less than a given position by more than a difference. Here the difference is
    the cost of that position minus the level. So every position above the level will do; it need not be a minimum. If
    the cost is steep at the position, the proof restarts nearer to the minimum. It also restarts if it found a position
    with less than half of the difference.
    """
    costly, boxes = np.zeros(len(seeds), dtype=bool), np.zeros(len(seeds), dtype=np.int64)
    x, cost = _cheapest(on, costs, seeds)
    # angles may be off by a whole turn, and then costs above `costs.level` are not the costs of the rows
    items = np.flatnonzero(np.isfinite(cost) & (costs.level > level))
    for _ in range(_BEGINS):
        items = items[cost[items] - level[items] > equal_cost(level[items])]
        if not len(items):
            break
        part, part_costs = on.take(items), costs.take(items)
        answer = prove(part_costs, _request(part, limits, part_costs, x[items], cost[items] - level[items], effort))
        boxes[items] += answer.boxes
        # coarse rounding may make the proven bound lower than requested
        costly[items] = (answer.verdict == VALUE) & (answer.bound > level[items] - equal_cost(level[items]))
        next_x, cheaper, steep = x[items], *(np.flatnonzero(answer.verdict == code) for code in (BETTER, STATIONARY))
        if len(cheaper):
            next_x[cheaper] = vectors(part.take(cheaper), answer.found[cheaper][:, None])[:, 0]
        if len(steep):
            next_x[steep] = refine(part.take(steep), next_x[steep], face=exact(on), limit=_STEPS).x
        x[items], before = next_x, cost[items]
        cost[items] = _costs(part, part_costs, next_x[:, None])[:, 0]
        items = items[cost[items] < before]
    return costly, boxes


def _cheapest(on: Problem, costs: Costs, seeds: Array) -> tuple[Array, Array]:
    """Return the cheapest vectors (n, size) and their costs (n,), after a move of all vectors onto the face.

    `on` has the n problems with the face as equalities; `seeds` (n, q, size) are the vectors to move.
    """
    n, q, size = seeds.shape
    with np.errstate(all="ignore"):
        x = restore(on.take(np.repeat(np.arange(n), q)), exact(on), seeds.reshape(-1, size)).reshape(seeds.shape)
    cost = _costs(on, costs, x)
    best = np.arange(n), np.argmin(cost, axis=1)
    return x[best], cost[best]


def _costs(problem: Problem, costs: Costs, x: Array) -> Array:
    """Return position costs (n, q) of parameter vectors (n, q, size); infinite for costs that are not finite."""
    with np.errstate(all="ignore"):
        cost = costs_of(costs, x[..., state_columns(problem)])[0]
    return np.where(np.isfinite(cost), cost, np.inf)


def _request(on: Problem, limits: Array, costs: Costs, x: Array, difference: Array, effort: float) -> ProofRequest:
    """Return the request to prove that no position of a face costs less than vector x by more than a difference (n,).

    `on` has the n problems with the face as equalities. `limits` (2, d) are the least and greatest coordinates. x has
    shape (n, size).
    """
    place = x[:, state_columns(on)]
    (n, d), value = place.shape, np.zeros(len(x))
    planes, surface = surfaces_of(on, place)
    region = limits if np.isfinite(limits).all() else np.full_like(limits, np.nan)
    # a gap of 0 proves the value alone, and `eps` is the difference up to which a lower cost counts as equal
    return ProofRequest(
        x=place,
        others=np.zeros((n, 0, d)),
        known=np.zeros(n, dtype=np.int64),
        hidden=np.zeros(n, dtype=np.int64),
        gaps=value[:, None],
        eps=difference,
        region=np.repeat(region[None], n, axis=0),
        fallback=np.full((n, 2, d), np.nan),
        budget=budgets(n, costs.dense, effort),
        planes=planes,
        surface=surface,
    )


def _prove_face(problem: Problem, fix: Fix, face: Face, seeds: Array, margin: float, effort: float) -> FaceMinima:
    """Return minima and bounds of n problems along a face; the search for minima starts at seeds (n, q, size).

    `fix` has the fixes that the costs are compared with. `margin` is the gap of cost to prove above the fixes.
    """
    began, on, limits = perf_counter(), on_face(problem, face), admitted_states(problem, problem.dimension)
    names = " and ".join(face_names(problem, face)) or "inside"
    pool = lsr(on, offer(on, seeds, None, "certify", began))
    alone = judge(on, pool)
    corner, reason = is_corner(problem, face), why_unsupported(on)
    if corner or reason:
        lost = np.full(len(seeds), -np.inf)
        none, least = np.zeros(len(seeds), dtype=np.int64), _excess(alone.cost, fix.cost) if corner else lost
        # a corner is a single point, so it is its only minimum
        rest = np.where(np.isfinite(least), np.inf, -np.inf)
        return FaceMinima(
            *_minima(alone), least, rest, none, filled_objects(len(seeds), UNFOLLOWED.format(names, reason))
        )
    gain = _excess(alone.cost, fix.cost)
    # If a face costs more than the fix by the margin, its minima need no distinction. If a minimum that is not admitted
    # costs less than the fix, the proof must find all minima up to the margin above the fix. Gaps are rounded up to
    # whole numbers, so that fixes of a batch share a request.
    above = np.where(gain > -LISTED_GAP, max(margin, AMBIGUOUS_GAP) - gain, max(margin, AMBIGUOUS_GAP))
    wanted = np.where(gain >= margin, 0.0, np.where(gain < 0.0, np.ceil(above), margin))
    proven = empty_claims(len(seeds))
    proven.write(np.arange(len(seeds)), unknown_claim(LEFT.format(names)))

    def prove(asked: Array) -> None:
        nonlocal pool
        for gap in np.unique(wanted[asked]):
            items = np.flatnonzero(asked & (wanted == gap))
            part = on.take(items)
            done = certified_freely(part, take(pool, items), None, float(gap), effort)
            done = _within_limits(part, done, limits, float(gap), effort)
            pool = pool.merge(items, done)
            assert done.proven is not None
            tried = done.proven.tried
            proven.write(items[tried], take(done.proven, tried))

    prove(alone.answered)
    alone = judge(on, replace(pool, proven=None))
    gain = _excess(alone.cost, fix.cost)
    # An unfinished proof falls back to the gap of `ambiguous`. This gap counts from the least minimum, which may cost
    # less than the fix if it is not admitted.
    enough = np.ceil(AMBIGUOUS_GAP - gain)
    short = alone.answered & (gain < 0.0) & (wanted > enough) & (proven.margin + gain < AMBIGUOUS_GAP)
    if short.any():
        wanted = np.where(short, enough, wanted)
        prove(short)
        alone = judge(on, replace(pool, proven=None))
        gain = _excess(alone.cost, fix.cost)
    sure, gap = _is_sure(proven, limits), proven.margin
    least, rest = np.where(sure, gain, -np.inf), np.where(sure, gain + gap, -np.inf)
    return FaceMinima(*_minima(alone), least, rest, proven.boxes, proven.reason)


def _excess(cost: Array, best: Array) -> Array:
    """Return costs (n,) minus the costs `best` (n,) of fixes: 0 within rounding, -inf for a cost that is not finite."""
    excess = np.where(np.isfinite(cost), cost - best, -np.inf)
    return np.where(np.abs(excess) <= equal_cost(best), 0.0, excess)


def _minima(fix: Fix) -> tuple[Array, Array]:
    """Return the fix and the alternatives of each problem: vectors (n, q, size) and costs (n, q).

    The fix is in slot 0. Costs are infinite in empty slots.
    """
    others = fix.alternatives
    cost = np.concatenate([fix.cost[:, None], fix.cost[:, None] + others.gap], axis=1)
    return np.concatenate([fix.x[:, None], others.x], axis=1), np.where(np.isfinite(cost), cost, np.inf)


def _is_sure(claims: Claims, limits: Array) -> Array:
    """Return flags (n,) of claims that cover all positions, or a region that contains the limits (2, d)."""
    out = np.asarray(claims.proof == GLOBAL)
    for i in np.flatnonzero(claims.proof == REGION):
        lower, upper = np.array(claims.region[i])
        out[i] = (lower <= limits[0]).all() and (upper >= limits[1]).all()
    return out


def _within_limits(problem: Problem, pool: Pool, limits: Array, margin: float, effort: float) -> Pool:
    """Return pools whose claims cover the box `limits` (2, d) if they cannot cover all positions.

    Pools do not change if a limit is infinite. The constraints admit no position outside the box.
    """
    assert pool.proven is not None
    open_ones = np.flatnonzero(~_is_sure(pool.proven, limits))
    if not len(open_ones) or not np.isfinite(limits).all():
        return pool
    part = replace(take(pool, open_ones), proven=None)
    again = certified_freely(problem.take(open_ones), part, limits, margin, effort)
    return pool.merge(open_ones, again)


def _is_admitted(problem: Problem, face: Face, along: FaceMinima) -> Array:
    """Return flags (n, q) of minima along a face that are also minima under all constraints."""
    out = np.isfinite(along.cost)
    item, slot = np.nonzero(out)
    out[item, slot] = is_minimum(problem.take(item), face, along.x[item, slot])
    return out


# An explicit call of `certify` gets more boxes than a proof within a method, which can continue without it.
_EFFORT = 4


def certify(
    problem: Problem, fix: Fix, region: tuple[Array, Array] | None = None, *, margin: float = LISTED_GAP
) -> Fix:
    """Return a fix with a certificate, and with every better or other minimum that the proof found.

    The proof encloses all positions that could cost less, and shows that the cost is convex around the fix. It splits
    the remaining space into boxes until a lower bound excludes each box. A better position replaces the fix, which is
    then proven again. Other minima with a cost within 25 are listed as alternatives.

    Parameters
    ----------
    problem : Problem
        Batch (...) of problems.
    fix : Fix
        Their fixes, refined.
    region : (lower, upper), optional
        Corners (d,) of the box to which the claim may be limited, in the frame of the problem, metres. None: all
        positions, or a box around the stations if the search cannot be bounded; the certificate names this box. For a
        moving target the corners are (2 d,): velocities in metres per second follow the coordinates. None then means
        the region that the constraints admit, see `optloc.solvers.certificates.position_cost.regions_of`.
    margin : float
        Gap between the cost of the fix and the cost of any other minimum that the proof tries first. If this proof is
        not finished, the gap 9 of `ambiguous` and then the value alone follow. 0 proves the value only, which is
        faster.

    Returns
    -------
    Fix
        Like `fix`. Fixes without an answer do not change. A fix without a proof has the certificate "unknown" with the
        reason. A fix whose proof fails numerically has the status `numerical`.

    Raises
    ------
    InvalidProblem
        For a fix of another shape, corners that do not bound a box, or a negative margin.
    """
    if separable(problem):
        problem = by_epoch(problem)
    shape, flat = problem.batch_shape, problem.flat()
    if fix.shape != shape:
        raise InvalidProblem(
            f"the fix has shape {fix.shape}, and the problem has shape {shape}", "fix", "give the fix of this problem"
        )
    if not 0.0 <= margin < np.inf:
        raise InvalidProblem(f"the margin is {margin}", "margin", "give 0 or a positive number")
    corners = None if region is None else _corners(problem, region)
    given = fix.reshape((flat.batch_shape[0],))

    def work(some: Problem, part: slice) -> Fix:
        with noting_place("certify"):
            return verdict(some, certified(some, accept(some, given[part]), corners, margin, _EFFORT))

    return in_parts(flat, work, failed=failed_fixes).reshape(shape)


def value_certified(problem: Problem, pool: Pool | None) -> Pool:
    """Return the pools of a flat batch with a proof that no position costs less than the fix: the stage "value"."""
    return certified(problem, pool, margin=0.0)


def _corners(problem: Problem, region: tuple[Array, Array]) -> Array:
    """Return the corners (2, d) of a box, or (2, 2 d) with velocities; raise InvalidProblem if it is no box."""
    corners = np.array([np.asarray(corner, dtype=float) for corner in region])
    sizes = sorted({problem.dimension, problem.dimension * (problem.motions[0].order + 1)})
    shaped = corners.ndim == 2 and len(corners) == 2 and corners.shape[1] in sizes
    if not shaped or not np.isfinite(corners).all() or (corners[0] >= corners[1]).any():
        count = " or ".join(map(str, sizes))
        raise InvalidProblem(
            "the region is not a box", "region", f"give (lower, upper) with {count} finite coordinates each"
        )
    return corners
