"""The stages that a method is made of: (problem, pool or None) -> pool."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
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
from optloc.problem.fix import Fix, Stage
from optloc.problem.problem import Problem
from optloc.proof.scope import is_scaled, why_unsupported
from optloc.solvers.coplanar import join_sides
from optloc.solvers.formulations import FORMULATIONS
from optloc.solvers.inequalities import bound_pool, is_hidden, least_finished
from optloc.solvers.layered import equations_in_layers, in_every_layer, refine_in_layers, strata_of
from optloc.solvers.policy import P_SUSPECT
from optloc.solvers.pool import Pool, chunk_size, in_parts, offer, pack
from optloc.solvers.starts.best_first import best_first_starts
from optloc.solvers.starts.moving import moves_at_once, moving_starts
from optloc.solvers.starts.orientation import headings, oriented_starts, unwind
from optloc.solvers.starts.position import along_the_valley, is_registration_run, spread_of, subarray_starts
from optloc.solvers.starts.registration import step_beside
from optloc.solvers.starts.several_positions import from_pieces
from optloc.solvers.verdict.judge import judge, surviving_candidates
from optloc.solvers.verdict.minima import is_measured, settle

Solver = Callable[[Problem, Pool | None], Pool]

# What more candidates may change; what a proof or a look around the fix says is known only once all of them are there.
_UNSETTLED = (Status.AMBIGUOUS, Status.UNBOUNDED, Status.CONTRADICTORY, Status.MISFIT)
# Share of its distance from the stations beyond which the error of a fix calls for a look along the valley: from
# there on the cost may be far from quadratic over the ellipsoid, and have another minimum a few sigma away.
_WEAK = 1e-2


def start_with(word: str) -> Solver:
    """Return the stage that offers the candidates of all formulations which start fixes under a word of a method."""

    def start(problem: Problem, pool: Pool | None) -> Pool:
        began, turned = perf_counter(), headings(problem)
        if turned is not None:
            x = oriented_starts(problem, turned, lambda part: begin(part, None).x)
            return offer(problem, x, pool, word, began)
        return begin(problem, pool)

    def begin(problem: Problem, pool: Pool | None) -> Pool:
        began = perf_counter()
        # rays are the refinement's: what starts a fix knows straight lines
        whole, problem = problem, problem.straightened()
        serving = [form for form in FORMULATIONS.values() if word in form.starts and form.serves(problem)]
        # what serves fewer problems knows more of this one: where nothing refines the starts, its answer is the fix
        serving.sort(key=lambda form: form.serves is one_position)
        if one_position(problem):
            alone = problem_at_rest(problem)
            # an empty slot, so that rows which no formulation starts give a pool without candidates
            nowhere = np.full((problem.batch_shape[0], 1, problem.dimension), np.nan)
            position = np.concatenate([*(form.starts[word](alone) for form in serving), nowhere], axis=1)
            return _place(whole, position, pool, word, began)
        if serving:
            x = np.concatenate([form.starts[word](problem) for form in serving], axis=1)
        else:
            x = from_pieces(problem, lambda piece: fix_by(piece, lambda one: start(one, None)))
        return offer(whole, x, pool, word, began)

    return lambda problem, pool: explain_absence(problem, start(problem, pool), word)


def explain_absence(problem: Problem, pool: Pool, word: str) -> Pool:
    """Return a pool of starts that says why a word of a method found none for rows that have some of other words.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Their starts.
    word : str
        What made them: a key of the starts of a formulation, or the name of a stage.
    """
    items = np.zeros(0, dtype=int) if word in _COMPLETE else np.flatnonzero(pool.empty)
    if not len(items):
        return pool
    if failures():  # not the rows are the reason
        return pool
    part = problem.take(items)
    # of what starts nowhere else, and determines nothing, the verdict knows more
    items = items[~roots(part, None).empty | is_measured(part)]
    forms = FORMULATIONS.values()
    own = [form for form in forms if word in form.starts] or [form for form in forms if word in form.words]
    needs = [form.needs(problem) for form in own]
    told = needs[0] if needs and all(needs) else "finds no start from these rows"
    return pool.without(items, f"{word} {told}: use 'auto'", Status.UNAVAILABLE)


# Words whose starts serve all rows that any closed form serves.
_COMPLETE = ("gtrs", "roots")

gtrs, roots = start_with("gtrs"), start_with("roots")

# Squared length of the undamped step, in standard deviations, below which a refinement has arrived: a hundredth of one.
_ARRIVED = 1e-4


def lsr_with_mirror(problem: Problem, start: Pool) -> Pool:
    """Return starts and their mirror images, refined.

    The image in the plane (or line) that fits the stations best is where flat networks have their second minimum; one
    that ends where an undamped step would lead on is no minimum.

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
    # where an image runs to infinity its cost is one of many there, and not the least: nobody has looked
    return replace(_without_halted(problem, lsr(problem, both)), infinity=None)


def _without_halted(problem: Problem, pool: Pool) -> Pool:
    """Return a settled pool without the rivals at which an undamped step would lead on."""
    item, slot = pool.occupied
    item, slot = item[slot > 0], slot[slot > 0]
    # constraints and interfaces hold points that free steps would leave
    if not len(item) or problem.constraints or strata_of(problem) is not None:
        return pool
    at, x = equations_at(problem.take(item), pool.x[item, slot]), np.array(pool.x)
    with np.errstate(all="ignore"):
        move, ok = step(at, np.zeros(len(item)))
        halted = ~(ok & (decrement(at, move, problem.layout.n_shared) < _ARRIVED))
    cost, code, lost = np.array(pool.cost), np.array(pool.code), (item[halted], slot[halted])
    x[lost], cost[lost], code[lost] = np.nan, np.inf, Status.UNAVAILABLE
    left = max(1, int(np.isfinite(cost).sum(1).max(initial=0)))
    order = np.argsort(~np.isfinite(cost), axis=1, kind="stable")[:, :left]
    cost, code, face = (np.take_along_axis(array, order, axis=1) for array in (cost, code, pool.face))
    return replace(pool, x=np.take_along_axis(x, order[..., None], axis=1), cost=cost, code=code, face=face)


def fix_by(problem: Problem, start: Callable[[Problem], Pool]) -> Fix:
    """Return the refined and judged fixes of a flat batch of problems from starts."""
    return judge(problem, lsr(problem, start(problem)))


def add_candidates(problem: Problem, pool: Pool | None) -> Pool:
    """Return a refined pool with mirror images beside it, and where the verdict is not clean starts of sub-arrays."""
    if pool is None:
        raise InvalidProblem("widen adds candidates to a fix", "method", "put it behind a refinement")
    if is_registration_run(problem):
        began, fix = perf_counter(), judge(problem, pool)
        around = step_beside(problem, fix.x, fix.covariance())
        return _beside(problem, pool, fix, around, began) if np.isfinite(around).any() else pool
    if not one_position(problem):
        return pool
    return in_parts(problem, lambda part, own: _widen(part, take(pool, own)), chunk_size(problem))


def _widen(problem: Problem, pool: Pool) -> Pool:
    """Return the candidates of a refined pool of problems of one position, and more."""
    began, fix, alone = perf_counter(), judge(problem, pool), problem_at_rest(problem.straightened())
    seen = problem.layout.take(surviving_candidates(pool, fix), "position")
    parts = [mirror(alone, fix.position[:, None])]
    # the mirror image is one start and always tried; the others are many: where the verdict is not clean
    unsettled = ~fix.answered | fix.has(*_UNSETTLED) | (fix.p_value < P_SUSPECT)
    valley = np.flatnonzero(unsettled | _weak(problem, fix))
    for items, more in (
        (np.flatnonzero(unsettled), _subarrays),
        (valley, lambda part, at: along_the_valley(part, at.position, at.covariance())),
    ):
        if len(items):
            found = more(alone.take(items), fix[items])
            spread = np.full((len(fix.x), *found.shape[1:]), np.nan)
            spread[items] = found
            parts.append(spread)
    fresh = vectors(problem, _fresh(problem, fix, seen, np.concatenate(parts, axis=1)))
    return _beside(problem, pool, fix, fresh, began)


def _beside(problem: Problem, pool: Pool, fix: Fix, x: Array, began: float) -> Pool:
    return offer(problem, pack(np.concatenate([surviving_candidates(pool, fix), x], axis=1)), pool, "widen", began)


def _subarrays(problem: Problem, fix: Fix) -> Array:
    found = subarray_starts(problem)
    return np.concatenate([found, mirror(problem, found)], axis=1)


def _weak(problem: Problem, fix: Fix) -> Array:
    """Return which fixes have an error of more than a hundredth of their distance from the stations, (N,)."""
    centre, _ = spread_of(problem)
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.trace(fix.covariance(), axis1=-2, axis2=-1))
        return np.asarray(~(spread < _WEAK * np.sqrt(((fix.position - centre) ** 2).sum(-1))))


def _fresh(problem: Problem, fix: Fix, seen: Array, more: Array) -> Array:
    """Return those of more positions that are not within one standard deviation of those seen; the others are NaN."""
    covariance = fix.covariance()
    usable = np.asarray(np.isfinite(covariance).all((-1, -2)))
    information, ok = linalg.inverse(np.where(usable[:, None, None], covariance, np.eye(problem.dimension)))
    near = np.zeros(more.shape[:2], dtype=bool)
    for point in np.moveaxis(seen, 1, 0):
        apart = more - point[:, None]
        with np.errstate(invalid="ignore"):
            # within one sigma refinement of either leads to the same minimum
            near |= ((apart @ information) * apart).sum(-1) < 1.0
    return np.where((near & (usable & ok)[:, None])[..., None], np.nan, more)


# The last resort, a seeded search from many places, for mixtures that no closed form starts: directions are uniform and
# distances log-uniform, so many that in space each of the 8 octants is tried at 12 scales; the dozen cheapest go on:
# more than a handful, because the few steps before rank them only roughly and many lead to the same minimum.
_PLACES, _KEPT = 96, 12
_FEW = 8  # steps that tell promising places from others
_SEED = 20261121  # any: the same problem always gets the same places

# More starts change nothing about these.
_SETTLED = (Status.REJECTED, Status.TOO_FEW_ROWS, Status.INFEASIBLE, Status.CONTRADICTORY)
# Of these no closed form had a start.
_STARTLESS = (Status.DISCONNECTED, Status.UNAVAILABLE)


def search(problem: Problem, pool: Pool | None) -> Pool:
    """Return a pool whose unanswered problems were searched: box by box where a proof bounds their cost, or by places.

    Only of those that were searched from places does the pool say so.
    """
    if pool is None or pool.curvature is None:
        raise InvalidProblem("search fills the gaps of a fix", "method", "put it behind a refinement")
    if not (why_unsupported(problem) or is_scaled(problem)):
        pool = _answer(problem, pool, lambda part: _with_offsets(part, best_first_starts(part)), lambda why: {})
    elif moves_at_once(problem):
        pool = _answer(problem, pool, lambda part: _with_offsets(part, moving_starts(part)), lambda why: {})
    if one_position(problem):
        pool = _answer(problem, pool, lambda part: vectors(part, pack(_search_starts(part))), _searched)
    return pool


def _answer(
    problem: Problem, pool: Pool, starts: Callable[[Problem], Array], says: Callable[[Array], dict[str, Any]]
) -> Pool:
    """Return a pool whose unanswered problems begin anew, and keep what they had where that answers nothing either."""
    fix = judge(problem, pool)
    # where all that is known is hidden by the Earth, another minimum may be in sight
    hidden = np.zeros(len(fix.code), dtype=bool) if pool.hidden is None else pool.hidden != ""
    # closed forms start with straight lines: in layers none of their starts need have a ray to every station
    bent = isinstance(problem.medium, Layers) & (fix.code == Status.INFEASIBLE)
    lost = ~fix.answered & (hidden | bent | ~np.isin(fix.code, _SETTLED))
    refuted = fix.answered & (fix.code == Status.MISFIT) & problem.frame.geodetic
    behind: Array = np.flatnonzero(refuted)
    lost[behind] = is_hidden(problem.take(behind), fix.x[behind]) if len(behind) else False
    lost &= fix.dof >= 0
    items = np.flatnonzero(lost)
    if not len(items):
        return pool
    began = perf_counter()
    part = problem.take(items)
    found = lsr(part, offer(part, starts(part), take(pool, items), "search", began))
    now = judge(part, found)
    # a minimum with an objection is better news than a missing start
    better = np.isin(fix.code[items], _STARTLESS) & ~np.isin(now.code, _STARTLESS)
    good = np.flatnonzero(now.answered | better)
    found = replace(found, **says(fix.reason[items]))
    stage = Stage("search", f"{int(now.answered.sum())} of {len(items)} found", perf_counter() - began)
    return pool.merge(items[good], take(found, good), stage)


def _with_offsets(problem: Problem, position: Array) -> Array:
    """Return vectors (N, q, size) of positions (N, q, d), the other shared unknowns as fit them.

    They are linear where a proof bounds the cost. Beside the minimum of a weak pair a refinement from other offsets
    creeps along a valley and stops short.
    """
    x = vectors(problem, pack(position))
    slot, _ = problem.layout.find("position")
    others = np.delete(np.arange(problem.layout.n_shared), np.s_[slot.start : slot.start + slot.size])
    item, place = np.nonzero(np.isfinite(x).all(-1))
    if len(others) and len(item):
        at = equations_at(problem.take(item), x[item, place])
        # a combination of offsets that no row feels stays as it is
        solved = np.linalg.pinv(at.shared[:, others[:, None], others], hermitian=True)
        x[item[:, None], place[:, None], others] += (solved @ at.shared_vector[:, others, None])[..., 0]
    return x


def _searched(why: Array) -> dict[str, Any]:
    """Return what a pool says of problems that were searched from places, after what was wrong before."""
    remark = np.array([_searched_sentence(each) for each in why], dtype=object)
    return {"searched": np.ones(len(why), dtype=bool), "remark": remark}


def _search_starts(problem: Problem) -> Array:
    """Return the best starting positions (N, q, d) of a flat batch among places around the stations.

    Directions are uniform, distances log-uniform from a tenth of the stations' spread to a hundred times it; every
    place is refined for a few steps and the cheapest are kept. The same problem always gets the same places.

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
    rng = np.random.default_rng(_SEED)
    direction = rng.standard_normal((_PLACES, d))
    # normal deviates over their length are uniform on the sphere, in any dimension
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # a tenth of the spread is amid the stations; at a hundred of it wave fronts are all but flat
    return direction * 10.0 ** rng.uniform(-1.0, 2.0, (_PLACES, 1))


def _searched_sentence(why: str) -> str:
    return f"{why}; best of a search from {_PLACES} places" if why else f"best of {_PLACES} places"


def search_widely(problem: Problem) -> Pool:
    """Return what the method "searched" returns: every start that is known, and a search where there is none."""
    return search(problem, lsr(problem, add_candidates(problem, lsr(problem, roots(problem, None)))))


def lsr(problem: Problem, pool: Pool | None, *, damped: bool = True, limit: int = 100) -> Pool:
    """Return the minima that damped least squares reaches from all candidates of the pool before."""
    if pool is None:
        raise InvalidProblem("lsr refines a start", "method", "give start= or a method such as 'gtrs+lsr'")
    if damped and pool.refined and not pool.unfinished:
        return pool  # nothing was added since
    began = perf_counter()
    strata = strata_of(problem, exact(problem)) if damped else None
    if strata is not None:
        wider = offer(problem, pack(in_every_layer(strata, pool.x)), pool, "", began)
        pool = replace(wider, stages=pool.stages)
    x, shape = pool.x.copy(), pool.x.shape[:2]
    cost, code = np.full(shape, np.inf), np.full(shape, int(Status.NUMERICAL), dtype=np.int8)
    item, slot = pool.occupied
    detail = "nothing to refine"
    if len(item):
        # one candidate each: no copy of the problems is made
        whole = len(item) == len(pool) and bool((item == np.arange(len(pool))).all())
        face = exact(problem) if damped else ()
        own = None if whole else item
        # a hundred steps by default: damped ones along a flat valley are short; what is unfinished then runs away
        if strata is None:
            done = refine(problem, x[item, slot], item=own, damped=damped, limit=limit, face=face)
        else:
            done = refine_in_layers(problem, strata, x[item, slot], item, face, limit)
        x[item, slot], cost[item, slot], code[item, slot] = done.x, done.cost, done.status
        detail = f"{len(item)} candidates, {int(done.iterations.max())} steps at most"
        count("lsr", int(done.iterations.sum()))
        turned = headings(problem)
        x = x if turned is None else unwind(turned, x)
    weights = np.broadcast_to(problem.weight, (len(pool), problem.count))
    # on the face without inequalities, number 0; `bound_pool` adds those on others
    inside, told = np.zeros(shape, dtype=int), pool.missing
    refined = Pool(x, cost, code, inside, weights, pool.dof, pool.stages, missing=told, hidden=pool.hidden)
    free = least_finished(refined) if problem.constraints else None
    refined = replace(bound_pool(problem, refined) if damped else refined, free=free)
    stage = Stage("lsr" if damped else "taylor", detail, perf_counter() - began)
    settled = settle(problem, refined, stage, equations_at if strata is None else equations_in_layers)
    return join_sides(problem, settled) if damped else settled


def taylor(problem: Problem, pool: Pool | None) -> Pool:
    """Return the result of plain undamped Taylor iteration: a baseline that diverges silently, kept for comparison."""
    # plain steps converge within a few or never: fifty leave no doubt which
    return lsr(problem, pool, damped=False, limit=50)


def _place(problem: Problem, position: Array, pool: Pool | None, name: str, began: float) -> Pool:
    return offer(problem, vectors(problem, pack(position)), pool, name, began)
