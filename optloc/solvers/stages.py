"""The stages that a method is made of; each is a solver of its own: (problem, fix or None) -> fix."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np

from formulations.backend import count
from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.status import Status
from optloc.base.types import Array
from optloc.compute.sums import equations_at
from optloc.linear.constraints import exact
from optloc.linear.normal import Normal
from optloc.problem.fix import Fix, Stage
from optloc.problem.problem import Problem
from optloc.solvers.inequalities import bounded, contradicted
from optloc.solvers.policy import DOUBT
from optloc.solvers.pool import Candidates, merged, packed, pooled, unrefined
from optloc.solvers.refine import refine
from optloc.solvers.search import PLACES, searched_starts
from optloc.solvers.starts.angles import Bearings, bearings, by_directions, instrumental, least_worst
from optloc.solvers.starts.heights import height_starts
from optloc.solvers.starts.position import (
    along_the_valley,
    mirrored,
    squared_range_starts,
    static,
    subarray_starts,
    vectors,
)
from optloc.solvers.starts.registration import beside, closed_form, registrable, relaxed, run_starts
from optloc.solvers.starts.several_positions import from_pieces, one_position
from optloc.solvers.starts.squared_range import Pick, every, hull, minimum, shor
from optloc.solvers.verdict.judge import judge

Solver = Callable[[Problem, Fix | None], Fix]

_WEAK = 1e-2


def gtrs(problem: Problem, fix: Fix | None) -> Fix:
    """Return the minimiser of the weighted squared-range problem, unrefined: one candidate, the cheapest start."""
    return _squared(problem, fix, "gtrs", minimum)


def roots(problem: Problem, fix: Fix | None) -> Fix:
    """Return every stationary point of the squared-range problem in two weightings, unrefined."""
    return _squared(problem, fix, "roots", every)


def sdp(problem: Problem, fix: Fix | None) -> Fix:
    """Return the answer of Shor's semidefinite relaxation of the squared-range problem, unrefined."""
    return _squared(problem, fix, "sdp", shor)


def socp(problem: Problem, fix: Fix | None) -> Fix:
    """Return the answer of the second-order cone relaxation of the squared-range problem, unrefined."""
    return _squared(problem, fix, "socp", hull)


def wiv(problem: Problem, fix: Fix | None) -> Fix:
    """Return the instrumental-variable fix of the angles, unrefined: the pseudo-linear start without its bias."""
    return _angular(problem, fix, "wiv", instrumental)


def directions(problem: Problem, fix: Fix | None) -> Fix:
    """Return the fix of the unit-direction semidefinite relaxation of the angles, unrefined."""
    return _angular(problem, fix, "directions", by_directions)


def minimax(problem: Problem, fix: Fix | None) -> Fix:
    """Return the fix whose worst angle in sigma is least, unrefined: for bounded errors."""
    return _angular(problem, fix, "minimax", least_worst)


def _angular(problem: Problem, fix: Fix | None, name: str, locate: Callable[[Bearings], Array]) -> Fix:
    began = perf_counter()
    if not one_position(problem):
        x = from_pieces(problem, lambda piece: lsr(piece, _angular(piece, None, name, locate)))
        return unrefined(problem, x, fix, name, began)
    seen = bearings(static(problem))
    nowhere = np.full((problem.batch_shape[0], 1, problem.dimension), np.nan)
    return _placed(problem, nowhere if seen is None else locate(seen), fix, name, began)


def _squared(problem: Problem, fix: Fix | None, name: str, pick: Pick) -> Fix:
    began = perf_counter()
    if one_position(problem):
        alone = static(problem)
        heights = height_starts(alone, relax=pick is shor)
        position = np.concatenate([squared_range_starts(alone, pick), heights], axis=1)
        return _placed(problem, position, fix, name, began)
    if registrable(problem):
        return unrefined(problem, run_starts(problem, relaxed if pick is shor else closed_form), fix, name, began)
    x = from_pieces(problem, lambda piece: lsr(piece, _squared(piece, None, name, pick)))
    return unrefined(problem, x, fix, name, began)


def widen(problem: Problem, fix: Fix | None) -> Fix:
    """Return a refined fix with its mirror image beside it, and where the verdict is not clean those of sub-arrays."""
    if fix is None:
        raise InvalidProblem("widen adds candidates to a fix", "method", "put it behind a refinement")
    began = perf_counter()
    if registrable(problem):
        around = beside(problem, fix.x, fix.covariance())
        if not np.isfinite(around).any():
            return fix
        return unrefined(problem, packed(np.concatenate([pooled(fix)[0], around], axis=1)), fix, "widen", began)
    if not one_position(problem):
        return fix
    alone = static(problem)
    seen = _positions(problem, fix)
    parts = [mirrored(alone, seen[:, :1])]
    unsettled = (fix.code != Status.OK) | (fix.p_value < DOUBT)
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
    return unrefined(problem, packed(np.concatenate([pooled(fix)[0], fresh], axis=1)), fix, "widen", began)


def _subarrays(problem: Problem, fix: Fix) -> Array:
    found = subarray_starts(problem)
    return np.concatenate([found, mirrored(problem, found)], axis=1)


def _weak(problem: Problem, fix: Fix) -> Array:
    """Return which fixes have an error of more than a hundredth of their distance from the stations, (N,)."""
    stations = problem.stations.position
    centre = stations.reshape(*stations.shape[:-3], -1, stations.shape[-1]).mean(-2)
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
            near |= ((apart @ information) * apart).sum(-1) < 1.0
    return np.where((near & (usable & ok)[:, None])[..., None], np.nan, more)


def search(problem: Problem, fix: Fix | None) -> Fix:
    """Return a fix whose unanswered problems were searched from many places; such answers say so in their status."""
    if fix is None:
        raise InvalidProblem("search fills the gaps of a fix", "method", "put it behind a refinement")
    settled = (Status.REJECTED, Status.TOO_FEW_ROWS, Status.INFEASIBLE, Status.CONTRADICTORY)
    lost = ~fix.answered & ~np.isin(fix.code, settled)
    lost &= fix.dof >= np.where(fix.code == Status.DISCONNECTED, 1, 0)
    items = np.flatnonzero(lost)
    if not len(items) or not one_position(problem):
        return fix
    began = perf_counter()
    part = problem.take(items)
    found = lsr(part, _placed(part, searched_starts(part), fix[items], "search", began))
    good = np.flatnonzero(found.answered)
    found.code[found.code == Status.OK] = Status.SEARCHED
    for i in good:
        why = fix.reason[items[i]]
        found.reason[i] = f"{why}; best of a search from {PLACES} places" if why else f"best of {PLACES} places"
    stage = Stage("search", f"{len(good)} of {len(items)} found", perf_counter() - began)
    return merged(fix, items[good], found[good], stage)


def lsr(problem: Problem, fix: Fix | None, *, damped: bool = True, limit: int = 100) -> Fix:
    """Return the refined maximum-likelihood fix: best of all candidates of the stage before."""
    if fix is None:
        raise InvalidProblem("lsr refines a start", "method", "give start= or a method such as 'gtrs+lsr'")
    unfinished = np.isin(fix.code, (Status.MAX_ITERATIONS, Status.STALLED)).any()
    if damped and fix.stages and fix.stages[-1].name == "lsr" and not unfinished:
        return fix  # nothing was added since
    began = perf_counter()
    pool, item, slot = pooled(fix)
    cost, code = np.full(pool.shape[:2], np.inf), np.full(pool.shape[:2], int(Status.NUMERICAL), dtype=np.int8)
    detail = "nothing to refine"
    if len(item):
        whole = len(item) == len(pool) and bool((item == np.arange(len(pool))).all())
        face = exact(problem) if damped else ()
        own = None if whole else item
        done = refine(problem, pool[item, slot], item=own, damped=damped, limit=limit, face=face)
        pool[item, slot], cost[item, slot], code[item, slot] = done.x, done.cost, done.status
        detail = f"{len(item)} candidates, {int(done.iterations.max())} steps at most"
        count("lsr", int(done.iterations.sum()))
    candidates = Candidates(pool, cost, code, np.zeros(cost.shape, dtype=int))
    free = candidates
    if damped:
        candidates = bounded(problem, candidates)
    refined = finished(problem, fix, candidates, Stage("lsr" if damped else "taylor", detail, perf_counter() - began))
    return contradicted(refined, free) if problem.constraints else refined


def finished(problem: Problem, fix: Fix, pool: Candidates, stage: Stage) -> Fix:
    """Return the judged fix of refined candidates."""
    pool = Candidates(pool.x, np.where(np.isfinite(pool.cost), pool.cost, np.inf), pool.code, pool.face)
    return judge(problem, pool, _equations, (*fix.stages, stage))


def taylor(problem: Problem, fix: Fix | None) -> Fix:
    """Return the result of plain undamped Taylor iteration: a baseline that diverges silently, kept for comparison."""
    return lsr(problem, fix, damped=False, limit=50)


def _positions(problem: Problem, fix: Fix) -> Array:
    """Return the positions (N, q, d) of a fix and its alternatives."""
    slot, _ = problem.layout.find("position")
    return pooled(fix)[0][..., slot.start : slot.start + slot.size]


def _placed(problem: Problem, position: Array, fix: Fix | None, name: str, began: float) -> Fix:
    return unrefined(problem, vectors(problem, packed(position)), fix, name, began)


def _equations(problem: Problem, x: Array) -> Normal:
    return equations_at(problem, x)
