"""Robust fixes: the minimum of a loss that gross errors cannot drag away, without a guess."""

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
from optloc.problem.fix import Fix, Stage
from optloc.problem.loss import LOSSES, Loss
from optloc.problem.problem import Problem
from optloc.solvers.inequalities import bound_pool, least_finished
from optloc.solvers.policy import AMBIGUOUS_GAP, REJECTED
from optloc.solvers.pool import Pool, chunk_size, in_parts, pack
from optloc.solvers.robust.reweighting import Doubt, residuals, reweight, robust_equations, weigh_by
from optloc.solvers.robust.starts import flip_rows, robust_starts
from optloc.solvers.robust.statement import stated
from optloc.solvers.verdict.judge import judge, surviving_candidates
from optloc.solvers.verdict.minima import settle

Minimise = Callable[[Problem, Array | None], Pool]
"""Maps a flat batch of problems and starting vectors (N, q, size), or None, to the settled minima of a loss."""


def by_arrivals(problem: Problem, start: Array | None, minimise: Minimise) -> Pool:
    """Return the minima of a loss; differences of arrival times are taken apart first, where that is the same problem.

    An error of one arrival is in every difference that it is part of, with either sign: no loss of the differences
    names it, whereas among the arrivals it is one bad row. A difference then has the lesser weight of its two arrivals.

    Parameters
    ----------
    problem : Problem
        N problems.
    start : array (N, q, size), optional
        Where to begin.
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
    """Return vectors (N, q, size) with the emission time that the median arrival gives, of vectors without it."""
    whole = np.concatenate([x, np.zeros((*x.shape[:-1], problem.layout.size - x.shape[-1]))], axis=-1)
    item, slot = np.nonzero(np.isfinite(x).all(-1))
    if len(item):
        arrivals = problem.rows[0].count
        # at emission time zero the residual of an arrival is the emission time and its error: gross ones do not move a
        # median
        left = residuals(problem.take(item), whole[item, slot])[:, :arrivals]
        whole[item, slot, -1] = np.median(left, axis=-1)
    known = np.asarray(np.isfinite(x).all(-1))
    return np.where(known[..., None], whole, np.nan)


def _weights(problem: Problem, taken: Arrivals, found: Pool) -> Array:
    """Return the weight (N, m) of each row: the least of those of the rows that were made from it."""
    weights = np.array(np.broadcast_to(problem.weight, (len(found), problem.count)))
    for row, origin in enumerate(taken.origin):
        weights[:, origin] = np.minimum(weights[:, origin], found.weights[:, row, None])
    return weights


# Times that the weights of correlated rows are made anew at an answer: each depends on those of its partners, changes
# by less each time, and thirty cost as much as a few steps.
_WEIGHINGS = 30
# Gap of a rival that leaves out no more than the cheapest candidate does: the loss alone is no evidence between them.
# Not zero, so that the cheapest stays first.
_CLOSE = 1e-2
# Minima that cost more than twice the least doubt so many more rows that no search from them ends near it.
_DEARER = 2.0
# Content of the ellipsoid within which candidates are one answer with the same rows doubted a little differently.
_ONE_ANSWER = 0.95


@dataclass(frozen=True, slots=True)
class Robust:
    """The stage that minimises a loss: from all candidates of a fix, or without one from starts of its own.

    Parameters
    ----------
    loss : Loss
        For instance ``LOSSES["cauchy"]``.
    states : bool
        Whether to test the minima that it has searched for, so that fixes may be `ok`.
    """

    loss: Loss
    states: bool = False

    def __call__(self, problem: Problem, pool: Pool | None) -> Pool:
        """Return the settled minima for a flat batch of problems; their weights are those of the loss."""
        start = None if pool is None else pack(surviving_candidates(pool, judge(problem, pool)))
        stages = () if pool is None else pool.stages

        def work(some: Problem, part: slice) -> Pool:
            own = None if start is None else start[part]
            return by_arrivals(some, own, lambda one, x: self._minima(one, x, stages))

        return in_parts(problem, work, chunk_size(problem))

    def _minima(self, problem: Problem, start: Array | None, stages: tuple[Stage, ...]) -> Pool:
        found = _minimise(problem, self.loss, start, stages)
        # from given starts the minima are those next to them
        return stated(problem, self.loss, found) if self.states and start is None else found


def _minimise(problem: Problem, loss: Loss, start: Array | None, stages: tuple[Stage, ...]) -> Pool:
    began = perf_counter()
    pool = _minima(problem, loss, robust_starts(problem, loss) if start is None else start)
    # a flat loss has a minimum for almost every set of rows: come from a loss that rises, and try sets next to the best
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
    # rows are doubted at a place; where the verdict leaves none they keep the weights that they had
    answered = np.asarray(np.isfinite(surviving_candidates(found, judge(problem, found))[:, 0]).all(-1))
    weights = _equations(problem, loss, np.where(answered[:, None], found.x[:, 0], 0.0))[1]
    return replace(found, refined=False, weights=np.where(answered[:, None], weights, found.weights))


def _on_face(loss: Loss, problem: Problem, start: Array, item: Array, face: Face) -> tuple[Array, Array, Array]:
    """Return x (M, size), cost (M,) and status (M,) of the minima of a loss on a face of the constraints."""
    part = problem.take(item)
    done = reweight(part, start, loss, Doubt.of(part, start), face=face)
    return done.x, done.cost, done.status


def _join(one: Pool, two: Pool) -> Pool:
    """Return the candidates of both pools."""
    return replace(
        one,
        x=np.concatenate([one.x, two.x], axis=1),
        cost=np.concatenate([one.cost, two.cost], axis=1),
        code=np.concatenate([one.code, two.code], axis=1),
        face=np.concatenate([one.face, two.face], axis=1),
    )


def doubted_minima(problem: Problem, loss: Loss, most: int) -> list[tuple[Array, Array]]:
    """Return the cheap minima of a loss, found without a guess: vector (size,) and the rows (m,) hardly counted each.

    Parameters
    ----------
    problem : Problem
        Flat batch of one problem.
    loss : Loss
        For instance ``LOSSES["truncated"]``.
    most : int
        Minima at most.
    """
    pool = Robust(loss)(problem, None)
    order = np.argsort(pool.cost[0])[:most]
    cost = pool.cost[0, order]
    x = pool.x[0, order][np.isfinite(cost) & (cost <= _DEARER * cost[0])]
    many = problem.take(np.zeros(len(x), dtype=int))
    weights = _equations(many, loss, x)[1] if len(x) else np.zeros((0, problem.count))
    return list(zip(x, weights < REJECTED * many.weight, strict=True))


def rejected(problem: Problem, fix: Fix) -> Array:
    """Return which rows (..., m) that were present a fix hardly counts: their weight fell below a quarter.

    Parameters
    ----------
    problem : Problem
        As it was solved; epochs that share nothing as a batch, see `optloc.problem.by_epoch`.
    fix : Fix
        Of a robust method.
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
    """Return the normal equations of the estimates x (N, size), and the weights of all rows there."""
    doubt = Doubt.of(problem, x)
    weight = np.ones(doubt.base.shape)
    with np.errstate(all="ignore"):
        for _ in range(_WEIGHINGS if any(b.row.shape[1] > 1 for b in problem.noise.blocks) else 1):
            weight = weigh_by(loss, problem, doubt, x, weight)
        return robust_equations(loss, problem, doubt, x, weight), doubt.row_weight(weight)


def _drop_near(problem: Problem, loss: Loss, pool: Pool) -> Pool:
    """Return candidates without those that lie in the 95 % ellipsoid of the cheapest: they are the same answer."""
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
    # the cheapest is near itself, and stays
    near[np.arange(len(rows)), best[rows]] = False
    cost[rows] = np.where(near, np.inf, cost[rows])
    return replace(pool, cost=cost)


def _rivals(problem: Problem, loss: Loss, pool: Pool) -> Pool:
    """Return candidates with gaps, counted from the cheapest, that tell how well the data exclude them.

    A loss that still rises for gross errors holds it for unlikely that one is larger than another; so large a gap is
    no evidence. Of truncated least squares, where all gross errors cost the same, it is, if a row that has to be left
    out costs as much as a rival may: one more than the cheapest leaves out is a reason of its own not to believe it.
    """
    found = np.isfinite(pool.cost) & (pool.code == Status.OK)
    item, slot = np.nonzero(found & (found.sum(1) > 1)[:, None])
    if not len(item):
        return pool
    evidence, truncated = np.full(pool.cost.shape, np.inf), LOSSES["truncated"]
    part, start = problem.take(item), pool.x[item, slot]
    doubt = Doubt.of(part, start)
    done = reweight(part, start, truncated, doubt, face=exact(problem))
    out = ((done.weight == 0.0) & (doubt.base > 0.0)).sum(-1)
    # a row left out costs what a rival may: else leaving out more rows would always be the cheaper answer
    price = AMBIGUOUS_GAP * out
    evidence[item, slot] = np.where(done.status == Status.OK, done.cost + price, np.inf)
    best = np.where(found, pool.cost, np.inf).argmin(1)[:, None]
    least, base = np.take_along_axis(pool.cost, best, 1), np.take_along_axis(evidence, best, 1)
    with np.errstate(invalid="ignore"):
        rival = least + np.maximum(evidence - base, _CLOSE)
    rival = np.where(np.isnan(rival), np.inf, rival)
    # a loss that still rises may only say that a rival is nearer than the evidence says, never farther
    cost = np.where(found, rival if loss.flat else np.minimum(pool.cost, rival), pool.cost)
    np.put_along_axis(cost, best, least, 1)
    return replace(pool, cost=cost)
