"""The stages of methods. A stage maps (problem, pool or None) to a pool.

Letters: N problems, q starts of a problem, d coordinates, `size` numbers of a parameter vector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from formulations.backend import count, failures
from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.records import take
from optloc.base.types import Array, Status
from optloc.kernels.least_squares import refine
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import exact
from optloc.linear.mirror import mirror, one_position
from optloc.linear.normal import decrement, step
from optloc.linear.vectors import problem_at_rest, vectors
from optloc.models.layers import Layers
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Stage
from optloc.problem.problem import Problem
from optloc.proof.scope import is_scaled, why_unsupported
from optloc.solvers.around import starts_on_equalities
from optloc.solvers.coplanar import join_sides
from optloc.solvers.formulations import FORMULATIONS
from optloc.solvers.horizon import is_hidden
from optloc.solvers.inequalities import bound_pool
from optloc.solvers.layered import equations_in_layers, in_every_layer, refine_in_layers, strata_of
from optloc.solvers.policy import P_SUSPECT
from optloc.solvers.pool import Pool, chunk_size, in_parts, least_finished, offer, pack
from optloc.solvers.starts.best_first import best_first_starts
from optloc.solvers.starts.course_search import TRIALS, course_search, has_course
from optloc.solvers.starts.moving import moves_at_once, moving_starts
from optloc.solvers.starts.orientation import headings, oriented_starts, unwind
from optloc.solvers.starts.position import along_the_valley, is_registration_run, spread_of, subarray_starts
from optloc.solvers.starts.registration import step_beside
from optloc.solvers.starts.several_positions import from_pieces, is_epochwise
from optloc.solvers.verdict.judge import judge, surviving_candidates
from optloc.solvers.verdict.minima import is_measured, settle

Solver = Callable[[Problem, Pool | None], Pool]

# Statuses that more candidates may change. Proofs and the cost at infinity come later, when all candidates are known.
_UNSETTLED = (Status.AMBIGUOUS, Status.UNBOUNDED, Status.CONTRADICTORY, Status.MISFIT)
# Error of a fix, as a share of its distance from the stations, above which more starts along the valley are tried. The
# cost may then be far from quadratic over the ellipsoid, with another minimum a few sigma away.
_WEAK = 1e-2


def start_with(word: str) -> Solver:
    """Return the stage of a word of a method, such as "gtrs": it offers the starts of all formulations for the word.

    If offsets of azimuths may be any part of a turn, the starts come from several trial offsets.
    """

    def start(problem: Problem, pool: Pool | None) -> Pool:
        began, offsets = perf_counter(), headings(problem)
        if offsets is not None:
            x = oriented_starts(problem, offsets, lambda part: begin(part, None).x)
            return offer(problem, x, pool, word, began)
        return begin(problem, pool)

    def begin(problem: Problem, pool: Pool | None) -> Pool:
        began = perf_counter()
        # closed forms use straight lines; the refinement follows rays
        whole, problem = problem, problem.straightened()
        serving = [form for form in FORMULATIONS.values() if word in form.starts and form.serves(problem)]
        # A formulation that serves fewer problems is more specific: without a refinement its answer is the fix, so it
        # comes first. The key is False for these formulations, and False sorts before True.
        serving.sort(key=lambda form: form.serves is one_position)
        if one_position(problem):
            at_rest = problem_at_rest(problem)
            # an empty slot, so that rows without a serving formulation give a pool without candidates
            nowhere = np.full((problem.batch_shape[0], 1, problem.dimension), np.nan)
            position = np.concatenate([*(form.starts[word](at_rest) for form in serving), nowhere], axis=1)
            return _offer_positions(whole, position, pool, word, began)
        if serving:
            x = np.concatenate([form.starts[word](problem) for form in serving], axis=1)
        else:
            x = from_pieces(problem, lambda piece: fix_by(piece, lambda one: start(one, None)))
        return offer(whole, x, pool, word, began)

    return lambda problem, pool: explain_absence(problem, start(problem, pool), word)


def explain_absence(problem: Problem, pool: Pool, word: str) -> Pool:
    """Return a pool of starts with reasons for problems without a start, if another method can start them.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Their starts.
    word : str
        Source of the starts: a key of the starts of a formulation, or the name of a stage.
    """
    items = np.zeros(0, dtype=int) if word in _COMPLETE else np.flatnonzero(pool.empty)
    if not len(items):
        return pool
    if failures():  # a back end failed, so the rows are not the reason
        return pool
    part = problem.take(items)
    # If no other method can start the rows, the verdict finds a better reason. If rows and equalities determine the
    # position, a search can start them.
    items = items[~roots(part, None).empty | is_measured(part)]
    forms = FORMULATIONS.values()
    own = [form for form in forms if word in form.starts] or [form for form in forms if word in form.words]
    needs = [form.needs(problem) for form in own]
    reason = needs[0] if needs and all(needs) else "finds no start from these rows"
    return pool.without(items, f"{word} {reason}: use 'auto'", Status.UNAVAILABLE)


# Words whose starts cover all rows that any closed form covers.
_COMPLETE = ("gtrs", "roots")

gtrs, roots = start_with("gtrs"), start_with("roots")

# Squared length of the undamped step, in standard deviations, below which a refinement has converged: 0.01 squared.
_ARRIVED = 1e-4


def lsr_with_mirror(problem: Problem, start: Pool) -> Pool:
    """Return starts and their mirror images, refined.

    Flat networks have their second minimum near the mirror image in the plane (or line) that fits the stations best. An
    image is no minimum if an undamped step would move on from its end point.

    Parameters
    ----------
    problem : Problem
        N problems.
    start : Pool
        Starts.
    """
    if not one_position(problem):
        return lsr(problem, start)
    slot, _ = problem.layout.find("position")
    position = start.x[..., slot.start : slot.start + slot.size]
    image = mirror(problem, position)
    x = np.concatenate([start.x, vectors(problem, image)], axis=1)
    x = pack(x)
    both = replace(offer(problem, x, start, "", perf_counter()), stages=start.stages)
    # an image that runs to infinity gives a cost there, but not the least one, so this cost is not kept
    return replace(_without_halted(problem, lsr(problem, both)), infinity=None)


def _without_halted(problem: Problem, pool: Pool) -> Pool:
    """Return a settled pool without rivals from which an undamped step would move on; such a point is no minimum."""
    item, slot = pool.occupied
    item, slot = item[slot > 0], slot[slot > 0]  # slot 0 has the best minimum, which stays
    # free steps would leave minima on constraints and interfaces
    if not len(item) or problem.constraints or strata_of(problem) is not None:
        return pool
    equations, x = equations_at(problem.take(item), pool.x[item, slot]), np.array(pool.x)
    with np.errstate(all="ignore"):
        move, ok = step(equations, np.zeros(len(item)))
        halted = ~(ok & (decrement(equations, move, problem.layout.n_shared) < _ARRIVED))
    cost, code, dropped = np.array(pool.cost), np.array(pool.code), (item[halted], slot[halted])
    x[dropped], cost[dropped], code[dropped] = np.nan, np.inf, Status.UNAVAILABLE
    width = max(1, int(np.isfinite(cost).sum(1).max(initial=0)))
    # move the remaining candidates to the first slots, in the same order
    order = np.argsort(~np.isfinite(cost), axis=1, kind="stable")[:, :width]
    cost, code, face = (np.take_along_axis(array, order, axis=1) for array in (cost, code, pool.face))
    return replace(pool, x=np.take_along_axis(x, order[..., None], axis=1), cost=cost, code=code, face=face)


def fix_by(problem: Problem, start: Callable[[Problem], Pool]) -> Fix:
    """Return the refined and judged fixes of a flat batch; `start` maps the problems to a pool of starts."""
    return judge(problem, lsr(problem, start(problem)))


def add_candidates(problem: Problem, pool: Pool | None) -> Pool:
    """Return a pool with more starts: mirror images, and starts of sub-arrays if the verdict has findings."""
    if pool is None:
        raise InvalidProblem("add_candidates needs a fix", "method", "put it after a refinement, as lsr+add_candidates")
    if is_registration_run(problem) or has_course(problem):
        return _more_courses(problem, pool)
    if not one_position(problem):
        return pool
    return in_parts(problem, lambda part, own: _more_candidates(part, take(pool, own)), chunk_size(problem))


def _more_candidates(problem: Problem, pool: Pool) -> Pool:
    """Return the candidates of a refined pool of problems of one position, and additional starts to refine."""
    began, fix, alone = perf_counter(), judge(problem, pool), problem_at_rest(problem.straightened())
    seen = problem.layout.take(surviving_candidates(pool, fix), "position")
    parts = [mirror(alone, fix.position[:, None])]
    # The mirror image is a single start, so it is always tried. The other starts are many, so they are tried only if
    # the verdict has findings.
    unsettled = ~fix.answered | fix.has(*_UNSETTLED) | (fix.p_value < P_SUSPECT)
    valley = np.flatnonzero(unsettled | _is_weak(problem, fix))
    for items, more in (
        (np.flatnonzero(unsettled), _subarrays),
        (valley, lambda part, at: along_the_valley(part, at.position, at.covariance())),
    ):
        if len(items):
            found = more(alone.take(items), fix[items])
            spread = np.full((len(fix.x), *found.shape[1:]), np.nan)
            spread[items] = found
            parts.append(spread)
    fresh = vectors(problem, _far_from_known(problem, fix, seen, np.concatenate(parts, axis=1)))
    return _with_starts(problem, pool, fix, fresh, began)


def _more_courses(problem: Problem, pool: Pool) -> Pool:
    """Return the candidates of a refined pool of runs, and additional starts to refine.

    Weak fixes of runs of ranges get starts along their error ellipsoids. Courses get the minima of a search.
    """
    began, fix = perf_counter(), judge(problem, pool)
    x = step_beside(problem, fix.x, fix.covariance()) if is_registration_run(problem) else pool.x[:, :0]
    # The search takes as long as all other stages. Proven courses do not come here, and each other course can be wrong:
    # among 1480 plausible ones, two had a lower minimum.
    answered = np.flatnonzero(fix.answered)
    if len(answered) and has_course(problem):
        found = course_search(problem.take(answered), fix.x[answered])
        spread = np.full((len(fix.x), *found.shape[1:]), np.nan)
        spread[answered] = found
        x = np.concatenate([x, spread], axis=1)
    return _with_starts(problem, pool, fix, x, began) if np.isfinite(x).any() else pool


def _with_starts(problem: Problem, pool: Pool, fix: Fix, x: Array, began: float) -> Pool:
    """Return a pool with the candidates of the fixes, and more starts x (N, q, size).

    `began` is the start time of the stage, by `time.perf_counter`.
    """
    candidates = pack(np.concatenate([surviving_candidates(pool, fix), x], axis=1))
    return offer(problem, candidates, pool, "add_candidates", began)


def _subarrays(problem: Problem, fix: Fix) -> Array:
    """Return the starts (N, q, d) of all arrays without one station, metres, and their mirror images.

    `fix` is not used: the function has the arguments of other sources of starts.
    """
    found = subarray_starts(problem)
    return np.concatenate([found, mirror(problem, found)], axis=1)


def _is_weak(problem: Problem, fix: Fix) -> Array:
    """Return flags (N,) of fixes whose error is unknown, or at least 1 % of the distance from the stations."""
    centre, _ = spread_of(problem)
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.trace(fix.covariance(), axis1=-2, axis2=-1))
        return np.asarray(~(spread < _WEAK * np.sqrt(((fix.position - centre) ** 2).sum(-1))))


def _far_from_known(problem: Problem, fix: Fix, seen: Array, more: Array) -> Array:
    """Return additional positions `more` (N, q, d), with NaN for positions within one standard deviation of known ones.

    `seen` (N, p, d) are the known positions. If the covariance of a fix is unknown, all its positions are returned.
    """
    covariance = fix.covariance()
    usable = np.asarray(np.isfinite(covariance).all((-1, -2)))
    information, ok = linalg.inverse(np.where(usable[:, None, None], covariance, np.eye(problem.dimension)))
    near = np.zeros(more.shape[:2], dtype=bool)
    for point in np.moveaxis(seen, 1, 0):
        apart = more - point[:, None]
        with np.errstate(invalid="ignore"):
            # within one sigma both refinements lead to the same minimum
            near |= ((apart @ information) * apart).sum(-1) < 1.0
    return np.where((near & (usable & ok)[:, None])[..., None], np.nan, more)


# The last resort is a seeded search from many positions, for mixtures that no closed form starts. Directions are
# uniform and distances log-uniform. 96 positions try each of the 8 octants of space at 12 scales. The 12 cheapest are
# refined fully, since the first steps rank them only roughly and many lead to the same minimum.
_PLACES, _KEPT = 96, 12
_FEW = 8  # steps that separate promising positions from others
_SEED = 20261121  # arbitrary: the same problem always gets the same positions

# Statuses that more starts do not change.
_SETTLED = (Status.REJECTED, Status.TOO_FEW_ROWS, Status.INFEASIBLE, Status.CONTRADICTORY)
# Statuses of problems for which no closed form had a start.
_STARTLESS = (Status.DISCONNECTED, Status.UNAVAILABLE)


def search(problem: Problem, pool: Pool | None) -> Pool:
    """Return a pool after a search for its unanswered problems.

    If a proof bounds their cost, the search goes over boxes, else from many positions. Only problems of a search from
    positions are marked as searched.
    """
    if pool is None or pool.curvature is None:
        raise InvalidProblem("search needs a fix", "method", "put it after a refinement, as in 'gtrs+lsr+search'")
    if not (why_unsupported(problem) or is_scaled(problem)):
        pool = _search_unanswered(
            problem, pool, lambda part: _with_offsets(part, best_first_starts(part)), lambda why: {}
        )
    elif moves_at_once(problem):
        pool = _search_unanswered(problem, pool, lambda part: _with_offsets(part, moving_starts(part)), lambda why: {})
    if has_course(problem):
        # only a candidate far away shows that the cost at infinity is small
        courses = partial(_searched, tried=f"{TRIALS} courses")
        pool = _search_unanswered(problem, pool, course_search, courses, keeps=True)
    if one_position(problem):
        positions = partial(_searched, tried=f"{_PLACES} positions")
        pool = _search_unanswered(problem, pool, lambda part: vectors(part, pack(_search_starts(part))), positions)
    elif is_epochwise(problem):
        # no closed form starts the epochs, but a search fixes each of them
        epochs = partial(_searched, tried=f"{_PLACES} positions of each epoch")
        pool = _search_unanswered(
            problem, pool, lambda part: from_pieces(part, lambda piece: fix_by(piece, search_widely)), epochs
        )
    return pool


def _search_unanswered(
    problem: Problem,
    pool: Pool,
    starts: Callable[[Problem], Array],
    fields_from: Callable[[Array], dict[str, Any]],
    keeps: bool = False,
) -> Pool:
    """Return a pool whose unanswered problems start again; problems without a better result keep their old pool.

    `starts` maps the unanswered problems to starts (n, q, size). `fields_from` maps the earlier reasons of their fixes
    to fields of the new pool. If `keeps` is true, the old candidates compete with the starts.
    """
    fix = judge(problem, pool)
    # if the Earth hides all known minima, another minimum may be visible
    hidden = np.zeros(len(fix.code), dtype=bool) if pool.hidden is None else pool.hidden != ""
    # closed forms use straight lines, so in layers their starts need not have a ray to every station
    bent = isinstance(problem.medium, Layers) & (fix.code == Status.INFEASIBLE)
    unanswered = ~fix.answered & (hidden | bent | ~np.isin(fix.code, _SETTLED))
    # on Earth a misfit whose position the Earth hides is searched again too
    refuted = fix.answered & (fix.code == Status.MISFIT) & problem.frame.geodetic
    misfits: Array = np.flatnonzero(refuted)
    unanswered[misfits] = is_hidden(problem.take(misfits), fix.x[misfits]) if len(misfits) else False
    unanswered &= fix.dof >= 0
    items = np.flatnonzero(unanswered)
    if not len(items):
        return pool
    began = perf_counter()
    part, before = problem.take(items), take(pool, items)
    x = pack(np.concatenate([before.x, starts(part)], axis=1)) if keeps else starts(part)
    found = lsr(part, offer(part, x, before, "search", began))
    new_fix = judge(part, found)
    # a minimum with a finding is better than a missing start
    better = np.isin(fix.code[items], _STARTLESS) & ~np.isin(new_fix.code, _STARTLESS)
    good = np.flatnonzero(new_fix.answered | better)
    found = replace(found, **fields_from(fix.reason[items]))
    stage = Stage("search", f"{int(new_fix.answered.sum())} of {len(items)} found", perf_counter() - began)
    return pool.merge(items[good], take(found, good), stage)


def _with_offsets(problem: Problem, position: Array) -> Array:
    """Return vectors (N, q, size) of positions (N, q, d), with the other shared unknowns at their best values.

    They are linear if a proof bounds the cost. With other offsets, a refinement of a weak pair creeps along a valley
    and stops before the minimum.
    """
    x = vectors(problem, pack(position))
    slot, _ = problem.layout.find("position")
    others = np.delete(np.arange(problem.layout.n_shared), np.s_[slot.start : slot.start + slot.size])
    item, place = np.nonzero(np.isfinite(x).all(-1))
    if len(others) and len(item):
        at = equations_at(problem.take(item), x[item, place])
        # a combination of offsets that no row measures does not change
        solved = np.linalg.pinv(at.shared[:, others[:, None], others], hermitian=True)
        x[item[:, None], place[:, None], others] += (solved @ at.shared_vector[:, others, None])[..., 0]
    return x


def _searched(why: Array, tried: str) -> dict[str, Any]:
    """Return fields of a pool for problems that a search answered; `why` (n,) are their earlier reasons.

    `tried` is the number and the name of the starts of the search, such as "96 positions".
    """
    remark = np.array(
        [f"{each}; best of a search from {tried}" if each else f"best of {tried}" for each in why], dtype=object
    )
    return {"searched": np.ones(len(why), dtype=bool), "remark": remark}


def _search_starts(problem: Problem) -> Array:
    """Return the best starting positions (N, q, d) of a flat batch among positions around the stations.

    Directions are uniform, and distances are log-uniform from a tenth of the spread of the stations to a hundred times
    it. Every position is refined for a few steps, and the cheapest are kept. The same problem always gets the same
    positions.

    Parameters
    ----------
    problem : Problem
        N problems with one target.
    """
    size, d = problem.batch_shape[0], problem.dimension
    centre, spread = spread_of(problem)
    places = np.broadcast_to(centre[:, None] + spread[:, None, None] * _directions(d), (size, _PLACES, d))
    x = vectors(problem, places)
    item = np.repeat(np.arange(size), _PLACES)
    done = refine(problem, x.reshape(-1, x.shape[-1]), item=item, limit=_FEW, face=exact(problem))
    cost = np.where(np.isfinite(done.cost), done.cost, np.inf).reshape(size, _PLACES)
    order = np.argsort(cost, axis=1, kind="stable")[:, :_KEPT]
    slot, _ = problem.layout.find("position")
    refined = done.x.reshape(size, _PLACES, -1)[..., slot.start : slot.start + d]
    return np.take_along_axis(refined, order[..., None], axis=1)


def _directions(d: int) -> Array:
    """Return the fixed positions (96, d) of the search, in spreads of the stations from their centre."""
    rng = np.random.default_rng(_SEED)
    direction = rng.standard_normal((_PLACES, d))
    # normal deviates divided by their length are uniform on the sphere, in any dimension
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # a tenth of the spread is between the stations; at a hundred spreads wave fronts are almost flat
    return direction * 10.0 ** rng.uniform(-1.0, 2.0, (_PLACES, 1))


def search_widely(problem: Problem) -> Pool:
    """Return the pool of the method "searched": from every known start, and from a search for problems without one."""
    return search(problem, lsr(problem, add_candidates(problem, lsr(problem, roots(problem, None)))))


def lsr(problem: Problem, pool: Pool | None, *, damped: bool = True, limit: int = 100) -> Pool:
    """Return the minima that damped least squares reaches from all candidates of the pool before.

    `limit` is the largest number of steps. A settled pool without new candidates is returned unchanged. If `damped` is
    False, the steps are plain Gauss-Newton steps that ignore constraints, layers and the plane of the stations.
    """
    if pool is None:
        raise InvalidProblem("lsr needs a start", "method", "give start= or a method such as 'gtrs+lsr'")
    if damped and pool.refined and not pool.unfinished:
        return pool  # no candidate was added since
    began = perf_counter()
    strata = strata_of(problem, exact(problem)) if damped else None
    if strata is not None:
        wider = offer(problem, pack(in_every_layer(strata, pool.x)), pool, "", began)
        pool = replace(wider, stages=pool.stages)
    around = starts_on_equalities(problem, pool.x) if damped else pool.x[:, :0]
    if around.shape[1]:
        wider = offer(problem, pack(np.concatenate([pool.x, around], axis=1)), pool, "", began)
        pool = replace(wider, stages=pool.stages)
    x, shape = pool.x.copy(), pool.x.shape[:2]
    cost, code = np.full(shape, np.inf), np.full(shape, int(Status.NUMERICAL), dtype=np.int8)
    item, slot = pool.occupied
    detail = "nothing to refine"
    if len(item):
        # With one candidate each, the problems are not copied: the argument None means that start i has problem i.
        whole = len(item) == len(pool) and bool((item == np.arange(len(pool))).all())
        face = exact(problem) if damped else ()
        item_of = None if whole else item
        # A hundred steps by default: damped steps along a flat valley are short. A refinement that needs more runs to
        # infinity.
        if strata is None:
            done = refine(problem, x[item, slot], item=item_of, damped=damped, limit=limit, face=face)
        else:
            done = refine_in_layers(problem, strata, x[item, slot], item, face, limit)
        x[item, slot], cost[item, slot], code[item, slot] = done.x, done.cost, done.status
        detail = f"{len(item)} candidates, {int(done.iterations.max())} steps at most"
        count("lsr", int(done.iterations.sum()))
        turned = headings(problem)
        x = x if turned is None else unwind(turned, x)
    weights = np.broadcast_to(problem.weight, (len(pool), problem.count))
    # face 0 has no inequalities; `bound_pool` adds candidates on other faces
    inside, missing = np.zeros(shape, dtype=int), pool.missing
    refined = Pool(x, cost, code, inside, weights, pool.dof, pool.stages, missing=missing, hidden=pool.hidden)
    # least cost without inequalities, from which the verdict finds contradictions between data and constraints
    free = least_finished(refined) if problem.constraints else None
    refined = replace(bound_pool(problem, refined) if damped else refined, free=free)
    stage = Stage("lsr" if damped else "taylor", detail, perf_counter() - began)
    settled = settle(problem, refined, stage, equations_at if strata is None else equations_in_layers)
    return join_sides(problem, settled) if damped else settled


def taylor(problem: Problem, pool: Pool | None) -> Pool:
    """Return the result of plain undamped Taylor iteration: a baseline that diverges silently, kept for comparison."""
    # undamped steps converge within a few steps or never; fifty steps decide
    return lsr(problem, pool, damped=False, limit=50)


def _offer_positions(problem: Problem, position: Array, pool: Pool | None, name: str, began: float) -> Pool:
    """Return positions (N, q, d), metres, as starts of the stage `name`.

    Emission times fit the positions, and other unknowns are at their prior means or zero.
    """
    return offer(problem, vectors(problem, pack(position)), pool, name, began)
