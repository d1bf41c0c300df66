"""From refined candidates to the minima that the data allow: the best one, its curvature, and its rivals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from optloc.base.status import Status
from optloc.base.types import Array
from optloc.compute.sums import equations_at
from optloc.linear.normal import Normal
from optloc.problem.fix import Stage
from optloc.problem.problem import Problem
from optloc.solvers.policy import AMBIGUOUS_GAP, EQUAL_COST, FAR, FLAT, LISTED_GAP, SAME_PLACE
from optloc.solvers.pool import Curvature, Pool
from optloc.solvers.starts.position import distance_of
from optloc.solvers.verdict.curvature import measure_curvature
from optloc.solvers.verdict.horizon import lowest_sight

Equations = Callable[[Problem, Array], Normal]


def settle(problem: Problem, pool: Pool, stage: Stage, equations: Equations = equations_at) -> Pool:
    """Return the pool of the distinct minima of every problem: the best one first, with its curvature.

    Runs to infinity leave the pool where a finite minimum rivals them; candidates that lie within a tenth of a standard
    deviation of another, or cost too much to matter, leave it too.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Their refined candidates.
    stage : Stage
        What refined them.
    equations : callable
        Maps (problem, x) to the `Normal` equations at vectors (N, size) of the cost that was minimised.
    """
    pool = replace(pool, cost=np.where(np.isfinite(pool.cost), pool.cost, np.inf))
    pool, endless = _without_runs_to_infinity(problem, pool)
    pool = _sort(pool)
    rows, best = np.arange(len(pool)), _choose(problem, pool)
    x, cost, face = pool.x[rows, best], pool.cost[rows, best], pool.face[rows, best]
    found = np.isfinite(cost)
    with np.errstate(all="ignore"):
        # unfound ones are evaluated at zero: a batch has no holes, and their curvature is not shown
        at = equations(problem, np.where(found[:, None], x, 0.0))
        curvature = measure_curvature(problem, at, x, np.where(found, face, 0))
    slots = _rivals(problem, pool, x, cost, curvature)
    return replace(
        pool,
        x=np.concatenate([np.where(found[:, None], x, np.nan)[:, None], _at(pool.x, slots, np.nan)], axis=1),
        cost=np.concatenate([np.where(found, cost, np.inf)[:, None], _at(pool.cost, slots, np.inf)], axis=1),
        code=np.concatenate(
            [pool.code[rows, best, None], _at(pool.code, slots, Status.UNAVAILABLE)], axis=1, dtype=np.int8
        ),
        face=np.concatenate([face[:, None], _at(pool.face, slots, 0)], axis=1),
        stages=(*pool.stages, stage),
        refined=True,
        curvature=curvature,
        endless=endless if endless.any() else None,
    )


def _without_runs_to_infinity(problem: Problem, pool: Pool) -> tuple[Pool, Array]:
    """Return the pool without runs to infinity where a finite minimum rivals them, and where that was so, (N,)."""
    none = np.zeros(len(pool), dtype=bool)
    if not any(slot.name == "position" for slot in problem.layout.shared):
        return pool, none
    distance = distance_of(problem, problem.layout.take(pool.x, "position"))
    with np.errstate(invalid="ignore"):
        # an unfinished point out there is on its way; a finished one counts up to where fronts are flat
        remote = (distance > FLAT) | ((distance > FAR) & (pool.code != Status.OK))
    if not remote.any():
        return pool, none
    near = np.where(~remote & (pool.code == Status.OK), pool.cost, np.inf).min(1)
    far = np.where(remote, pool.cost, np.inf).min(1)
    with np.errstate(invalid="ignore"):
        rivals = np.isfinite(near) & (near - far <= AMBIGUOUS_GAP)
        # the finite minimum is answered, and the run to infinity is named where it costs no less by the margin
        alike = rivals & (far - near < AMBIGUOUS_GAP)
    return replace(pool, cost=np.where(remote & rivals[:, None], np.inf, pool.cost)), alike


def _sort(pool: Pool) -> Pool:
    """Return the candidates of every problem, the cheapest first."""
    if pool.cost.shape[1] == 1:
        return pool
    order = np.argsort(pool.cost, axis=1, kind="stable")
    cost, code, face = (np.take_along_axis(a, order, axis=1) for a in (pool.cost, pool.code, pool.face))
    return replace(pool, x=np.take_along_axis(pool.x, order[..., None], axis=1), cost=cost, code=code, face=face)


def _choose(problem: Problem, pool: Pool) -> Array:
    """Return the slot to answer with: the cheapest, or of finished ones that cost the same that with the best sight."""
    finished, least = pool.code == Status.OK, pool.cost[:, :1]
    with np.errstate(invalid="ignore"):
        near = finished & (pool.cost <= least + EQUAL_COST * (1.0 + np.abs(least)))
    best = np.where(near.any(1), near.argmax(1), 0)
    tied, slot = np.nonzero(near & (near.sum(1) > 1)[:, None])
    if len(tied) and problem.frame.geodetic:
        sight = np.full(pool.cost.shape, -np.inf)
        # sines of elevations, equal to the last digits for mirror images: rounded, so that the cheaper of them wins
        sight[tied, slot] = np.round(lowest_sight(problem.take(tied), pool.x[tied, slot]), 6)
        best[tied] = sight[tied].argmax(1)
    return best


def _rivals(problem: Problem, pool: Pool, x: Array, cost: Array, curvature: Curvature) -> Array:
    """Return the slots (N, r) of the other finished minima within the listed gap, cheapest first; -1 where none.

    Each is listed once. Those of a run are listed whatever they cost: they are few, and by how much the data exclude
    them is what its user asks.
    """
    n, limit = problem.layout.n_shared, np.inf if problem.epochs > 1 else LISTED_GAP
    with np.errstate(invalid="ignore"):
        gap = np.where(pool.code == Status.OK, pool.cost - cost[:, None], np.inf)
    gap = np.where(np.isfinite(gap) & (gap < limit), gap, np.inf)
    kept: list[tuple[Array, Array]] = [(x[:, :n], np.ones(len(x), dtype=bool))]
    slots = np.full(gap.shape, np.inf)
    for slot in np.flatnonzero(np.isfinite(gap).any(0)):
        new = np.isfinite(gap[:, slot])
        for other, present in kept:
            new &= ~_same(pool.x[:, slot, :n], other, curvature) | ~present
        if new.any():
            kept.append((pool.x[:, slot, :n], new))
            slots[:, slot] = np.where(new, gap[:, slot], np.inf)
    order = np.argsort(slots, axis=1, kind="stable")[:, : int(np.isfinite(slots).sum(1).max(initial=0))]
    return np.where(np.isfinite(np.take_along_axis(slots, order, axis=1)), order, -1)


def _at(values: Array, slots: Array, empty: float) -> Array:
    """Return values (N, q, ...) at slots (N, r); `empty` where the slot is -1."""
    extra = (1,) * (values.ndim - 2)
    index = slots.reshape(*slots.shape, *extra)
    return np.where(index < 0, empty, np.take_along_axis(values, np.maximum(index, 0), axis=1))


def _same(x: Array, y: Array, curvature: Curvature) -> Array:
    """Return where two points are nearer than a tenth of a standard deviation in every direction, or equal."""
    difference = x - y
    with np.errstate(all="ignore"):  # a point that constraints hold has no spread
        squared = (difference[:, None, :] @ curvature.information @ difference[..., None])[:, 0, 0]
        spread = np.trace(curvature.covariance, axis1=-2, axis2=-1)  # constraints leave directions without information
        squared = np.maximum(squared, (difference**2).sum(-1) / spread)
        equal = (np.abs(difference) <= 1e-9 * (1.0 + np.abs(x))).all(-1)  # rounding of two ways to one point
    return np.asarray(equal | (squared < SAME_PLACE))
