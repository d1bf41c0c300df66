"""Robust fixes: the minimum of a loss that limits the effect of gross errors, without a first guess.

Letters: N problems, q slots for candidates, m rows, M starts, `size` numbers of a parameter vector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter

import numpy as np

from optloc.base.types import Array, Status
from optloc.linear.constraints import Face, exact
from optloc.linear.normal import Normal, marginal
from optloc.linear.redundancy import degrees_of_freedom
from optloc.problem.arrival_times import Arrivals, as_arrivals, restore_order
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Stage
from optloc.problem.loss import LOSSES, Loss
from optloc.problem.problem import Problem
from optloc.solvers.inequalities import bound_pool
from optloc.solvers.policy import AMBIGUOUS_GAP, REJECTED
from optloc.solvers.pool import Pool, chunk_size, in_parts, least_finished, pack
from optloc.solvers.robust.reweighting import Doubt, residuals, reweight, robust_equations, weigh_by
from optloc.solvers.robust.starts import flip_rows, robust_starts
from optloc.solvers.robust.statement import check_minima
from optloc.solvers.verdict.judge import judge, surviving_candidates
from optloc.solvers.verdict.minima import settle

Minimise = Callable[[Problem, Array | None], Pool]
"""Maps a flat batch of problems and starting vectors (N, q, size), or None, to the settled minima of a loss."""


def by_arrivals(problem: Problem, start: Array | None, minimise: Minimise) -> Pool:
    """Return the minima of a loss, computed with arrival times instead of differences if both are equivalent.

    An error of one arrival is part of several differences, with either sign, so a loss on differences cannot name it.
    Among the arrivals it is one bad row. A difference then gets the smaller weight of its two arrivals.

    Parameters
    ----------
    problem : Problem
        N problems.
    start : array (N, q, size), optional
        Starts; None: the robust starts of `minimise`.
    minimise : callable
        Finds the minima.
    """
    taken = as_arrivals(problem) if problem.epochs == 1 and not problem.layout.n_local else None
    if taken is None:
        return minimise(problem, start)
    found = minimise(taken.problem, None if start is None else _add_emission_time(taken.problem, start))
    assert found.curvature is not None
    return replace(
        found,
        x=restore_order(problem.layout, taken.problem.layout, found.x),
        dof=degrees_of_freedom(problem),
        weights=_weights(problem, taken, found),
        curvature=replace(found.curvature, local=None),
    )


def _add_emission_time(problem: Problem, x: Array) -> Array:
    """Return vectors (N, q, size + 1) with an emission time as last entry, from vectors x (N, q, size) without it.

    The emission time is the median of the arrivals minus the travel times, in metres.
    """
    whole = np.concatenate([x, np.zeros((*x.shape[:-1], problem.layout.size - x.shape[-1]))], axis=-1)
    item, slot = np.nonzero(np.isfinite(x).all(-1))
    if len(item):
        arrivals = problem.rows[0].count
        # At emission time zero the residual of an arrival is the emission time plus its error. Gross errors do not move
        # a median.
        residual = residuals(problem.take(item), whole[item, slot])[:, :arrivals]
        whole[item, slot, -1] = np.median(residual, axis=-1)
    known = np.asarray(np.isfinite(x).all(-1))
    return np.where(known[..., None], whole, np.nan)


def _weights(problem: Problem, taken: Arrivals, found: Pool) -> Array:
    """Return the weight (N, m) of each row: the least weight of the arrivals that were made from it.

    `taken` has the arrivals of the problem, and `found` the minima with their weights.
    """
    weights = np.array(np.broadcast_to(problem.weight, (len(found), problem.count)))
    for row, origin in enumerate(taken.origin):
        weights[:, origin] = np.minimum(weights[:, origin], found.weights[:, row, None])
    return weights


# Updates of the weights of correlated rows at an answer. Each weight depends on the weights of its partners and changes
# less each time; thirty updates take as long as a few steps.
_WEIGHINGS = 30
# Gap of a rival that leaves out no more than the cheapest candidate: a loss alone is no evidence between the two. The
# gap is not zero, so that the cheapest candidate stays first.
_CLOSE = 1e-2
# Minima that cost more than twice the least reject many more rows, so that a search from them does not end near it.
_DEARER = 2.0
# Content of the ellipsoid within which candidates are one answer with slightly different weights.
_ONE_ANSWER = 0.95


@dataclass(frozen=True, slots=True)
class Robust:
    """The stage that minimises a loss: from all candidates of a fix, or from robust starts if there is no fix.

    Parameters
    ----------
    loss : Loss
        For instance ``LOSSES["cauchy"]``.
    states : bool
        Whether the minima of a search are tested, so that fixes may be `ok`.
    """

    loss: Loss
    states: bool = False

    def __call__(self, problem: Problem, pool: Pool | None) -> Pool:
        """Return the settled minima for a flat batch of problems; their weights are the weights of the loss."""
        start = None if pool is None else pack(surviving_candidates(pool, judge(problem, pool)))
        stages = () if pool is None else pool.stages

        def work(some: Problem, part: slice) -> Pool:
            own = None if start is None else start[part]
            return by_arrivals(some, own, lambda one, x: self._minima(one, x, stages))

        return in_parts(problem, work, chunk_size(problem))

    def _minima(self, problem: Problem, start: Array | None, stages: tuple[Stage, ...]) -> Pool:
        """Return the settled minima of the loss; minima of a search are tested if `states` is True."""
        found = _minimise(problem, self.loss, start, stages)
        # given starts lead to the nearest minima only, so these are not tested
        return check_minima(problem, self.loss, found) if self.states and start is None else found


def _minimise(problem: Problem, loss: Loss, start: Array | None, stages: tuple[Stage, ...]) -> Pool:
    """Return the settled minima of a loss, from starts `start` (N, q, size), or from robust starts if it is None.

    `stages` are the stages that ran before.
    """
    began = perf_counter()
    pool = _minima(problem, loss, robust_starts(problem, loss) if start is None else start)
    # A flat loss is constant for large residuals, and has a minimum for almost every set of rows. So start from a
    # rising loss, and try sets of rows that differ from the best set in one row.
    if start is None and loss.flat:
        pool = _join(pool, _minima(problem, loss, _minima(problem, LOSSES["cauchy"], pool.x).x))
        pool = _join(pool, _minima(problem, loss, flip_rows(problem, loss, pool)))
    free = least_finished(pool) if problem.constraints else None
    pool = bound_pool(problem, pool, partial(_on_face, loss))
    pool = _rivals(problem, loss, _drop_near(problem, loss, pool))
    detail = f"{int(np.isfinite(pool.cost).sum(1).max(initial=0))} candidates at most"
    stage = Stage(loss.name, detail, perf_counter() - began)
    pool = replace(pool, stages=stages, free=free, loss=loss.name)
    found = settle(problem, pool, stage, lambda some, x: _equations(some, loss, x)[0])
    # The weights belong to a position. If the verdict shows no position, rows keep their earlier weights.
    answered = np.asarray(np.isfinite(surviving_candidates(found, judge(problem, found))[:, 0]).all(-1))
    weights = _equations(problem, loss, np.where(answered[:, None], found.x[:, 0], 0.0))[1]
    # `refined` is False, so that a following least squares runs
    return replace(found, refined=False, weights=np.where(answered[:, None], weights, found.weights))


def _on_face(loss: Loss, problem: Problem, start: Array, item: Array, face: Face) -> tuple[Array, Array, Array]:
    """Return x (M, size), cost (M,) and status (M,) of the minima of a loss on a face of the constraints.

    `start` (M, size) are the starts, and `item` (M,) is the problem of each start.
    """
    part = problem.take(item)
    done = reweight(part, start, loss, Doubt.of(part, start), face=face)
    return done.x, done.cost, done.status


def _join(one: Pool, two: Pool) -> Pool:
    """Return a pool with the candidates of both pools of the same problems."""
    return replace(
        one,
        x=np.concatenate([one.x, two.x], axis=1),
        cost=np.concatenate([one.cost, two.cost], axis=1),
        code=np.concatenate([one.code, two.code], axis=1),
        face=np.concatenate([one.face, two.face], axis=1),
    )


def doubted_minima(problem: Problem, loss: Loss, most: int) -> list[tuple[Array, Array]]:
    """Return the cheap minima of a loss from robust starts: vectors (size,) and flags (m,) of rejected rows.

    Parameters
    ----------
    problem : Problem
        Flat batch of one problem.
    loss : Loss
        For instance ``LOSSES["truncated"]``.
    most : int
        Most minima.
    """
    pool = Robust(loss)(problem, None)
    order = np.argsort(pool.cost[0])[:most]
    cost = pool.cost[0, order]
    x = pool.x[0, order][np.isfinite(cost) & (cost <= _DEARER * cost[0])]
    many = problem.take(np.zeros(len(x), dtype=int))
    weights = _equations(many, loss, x)[1] if len(x) else np.zeros((0, problem.count))
    return list(zip(x, weights < REJECTED * many.weight, strict=True))


def rejected(problem: Problem, fix: Fix) -> Array:
    """Return flags (..., m) of rows that a robust fix rejects: their weight is below a quarter of the original one.

    Parameters
    ----------
    problem : Problem
        Problem as solved; epochs that share nothing are a batch, see `optloc.problem.by_epoch`.
    fix : Fix
        Fix of a robust method.
    """
    return np.asarray((problem.weight > 0.0) & (fix.weights < REJECTED * problem.weight))


def _minima(problem: Problem, loss: Loss, pool: Array) -> Pool:
    """Return the minima of a loss next to the starts (N, q, size) of N problems."""
    x, cost = np.array(pool), np.full(pool.shape[:2], np.inf)
    code = np.full(pool.shape[:2], int(Status.NUMERICAL), dtype=np.int8)
    item, slot = np.nonzero(np.isfinite(pool).all(-1))
    if len(item):
        part, start = problem.take(item), pool[item, slot]
        done = reweight(part, start, loss, Doubt.of(part, start), face=exact(problem))
        x[item, slot], cost[item, slot], code[item, slot] = done.x, done.cost, done.status
    weights = np.broadcast_to(problem.weight, (len(x), problem.count))
    return Pool(x, cost, code, np.zeros(cost.shape, dtype=int), weights, degrees_of_freedom(problem))


def _equations(problem: Problem, loss: Loss, x: Array) -> tuple[Normal, Array]:
    """Return the normal equations of the estimates x (N, size), and the weights (N, m) of all rows there."""
    doubt = Doubt.of(problem, x)
    weight = np.ones(doubt.base.shape)
    with np.errstate(all="ignore"):
        for _ in range(_WEIGHINGS if any(b.row.shape[1] > 1 for b in problem.noise.blocks) else 1):
            weight = weigh_by(loss, problem, doubt, x, weight)
        return robust_equations(loss, problem, doubt, x, weight), doubt.row_weight(weight)


def _drop_near(problem: Problem, loss: Loss, pool: Pool) -> Pool:
    """Return candidates without those in the 95 % ellipsoid of the cheapest, which are the same answer.

    The cost of a removed candidate is infinite.
    """
    from scipy.special import gammaincinv

    finished = np.where(pool.code == Status.OK, pool.cost, np.inf)
    best = finished.argmin(1)
    rows = np.flatnonzero(np.isfinite(finished[np.arange(len(best)), best]))
    if not len(rows):
        return pool
    n, cost = problem.layout.n_shared, np.array(pool.cost)
    x = pool.x[rows, best[rows]]
    information, _, _ = marginal(_equations(problem.take(rows), loss, x)[0])
    apart = pool.x[rows, :, :n] - x[:, None, :n]
    with np.errstate(invalid="ignore"):
        near = ((apart @ information) * apart).sum(-1) < 2.0 * gammaincinv(n / 2.0, _ONE_ANSWER)
    # the cheapest is near itself, and is kept
    near[np.arange(len(rows)), best[rows]] = False
    cost[rows] = np.where(near, np.inf, cost[rows])
    return replace(pool, cost=cost)


def _rivals(problem: Problem, loss: Loss, pool: Pool) -> Pool:
    """Return candidates with costs whose gaps to the cheapest measure how clearly the data exclude them.

    A loss that rises without limit also compares sizes of gross errors, and a gap from these sizes is no evidence.
    Under truncated least squares all gross errors cost the same. Its gap is evidence if each row left out adds the gap
    of a rival, 9. A candidate that leaves out one more row than the cheapest is then less likely.
    """
    finished = np.isfinite(pool.cost) & (pool.code == Status.OK)
    item, slot = np.nonzero(finished & (finished.sum(1) > 1)[:, None])
    if not len(item):
        return pool
    evidence, truncated = np.full(pool.cost.shape, np.inf), LOSSES["truncated"]
    part, start = problem.take(item), pool.x[item, slot]
    doubt = Doubt.of(part, start)
    done = reweight(part, start, truncated, doubt, face=exact(problem))
    left_out = ((done.weight == 0.0) & (doubt.base > 0.0)).sum(-1)
    # without this price, leaving out more rows would always cost less
    price = AMBIGUOUS_GAP * left_out
    evidence[item, slot] = np.where(done.status == Status.OK, done.cost + price, np.inf)
    best = np.where(finished, pool.cost, np.inf).argmin(1)[:, None]
    least, base = np.take_along_axis(pool.cost, best, 1), np.take_along_axis(evidence, best, 1)
    with np.errstate(invalid="ignore"):
        rival = least + np.maximum(evidence - base, _CLOSE)
    rival = np.where(np.isnan(rival), np.inf, rival)
    # a rising loss may only reduce the gap below the evidence, never increase it
    cost = np.where(finished, rival if loss.flat else np.minimum(pool.cost, rival), pool.cost)
    np.put_along_axis(cost, best, least, 1)
    return replace(pool, cost=cost)
