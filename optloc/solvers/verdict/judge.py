"""From refined candidates to a fix: the best one, the others that the data allow, and the status."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base.status import Certificate, Status
from optloc.base.types import Array
from optloc.linear.degrees_of_freedom import degrees_of_freedom
from optloc.linear.normal import Normal, local_covariance
from optloc.problem.fix import Alternatives, Fix, Stage
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.solvers.policy import AMBIGUOUS_GAP, FAR, FLAT, LISTED_GAP
from optloc.solvers.pool import Candidates
from optloc.solvers.starts.position import distance_of
from optloc.solvers.verdict.curvature import Curvature, curved
from optloc.solvers.verdict.horizon import lowest
from optloc.solvers.verdict.status import explain

_SAME = 1e-2

_LOCAL = Certificate(
    "local",
    "a stationary point with a positive definite normal matrix; the best of all candidates refined",
    "refinement",
)


def judge(problem: Problem, pool: Candidates, equations: Any, stages: tuple[Stage, ...]) -> Fix:
    """Return the fix of a flat batch of problems from their refined candidates.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Candidates
        Their refined candidates.
    equations : callable
        Maps (problem, x) to `Normal` equations at x (N, size).
    stages : tuple of Stage
        What was done so far.
    """
    size = len(pool.x)
    pool, endless = _finite(problem, pool)
    pool = _sorted(pool)
    best = _preferred(problem, pool)
    rows = np.arange(size)
    chosen, value, face = pool.x[rows, best], pool.cost[rows, best], pool.face[rows, best]
    found = np.isfinite(value)
    with np.errstate(all="ignore"):
        at = equations(problem, np.where(found[:, None], chosen, 0.0))
        curvature = curved(problem, at, chosen, np.where(found, face, 0))
    others = _alternatives(problem, pool, chosen, value, curvature)
    reason = np.empty(size, dtype=object)
    reason[:] = ""
    fix = Fix(
        np.where(found[:, None], chosen, np.nan),
        np.where((found & curvature.regular)[:, None, None], curvature.covariance, np.nan),
        problem.layout,
        problem.frame,
        pool.code[rows, best].astype(np.int8),
        reason,
        _fill(size, _LOCAL),
        others,
        np.where(found, value, np.nan),
        degrees_of_freedom(problem),
        np.broadcast_to(problem.weight, (size, problem.count)),
        stages,
        curvature.active,
        _local(problem, at, curvature.covariance),
    )
    explain(problem, fix, curvature)
    rivalled = endless & (fix.code == Status.OK)
    fix.code[rivalled], fix.reason[rivalled] = Status.AMBIGUOUS, "positions ever farther away explain the data as well"
    return fix


def _finite(problem: Problem, pool: Candidates) -> tuple[Candidates, Array]:
    """Return the pool without runs to infinity where a finite minimum rivals them, and where that was so, (N,)."""
    none = np.zeros(len(pool.x), dtype=bool)
    if not any(slot.name == "position" for slot in problem.layout.shared):
        return pool, none
    distance = distance_of(problem, problem.layout.take(pool.x, "position"))
    with np.errstate(invalid="ignore"):
        remote = (distance > FLAT) | ((distance > FAR) & (pool.code != Status.OK))
    if not remote.any():
        return pool, none
    near = np.where(~remote & (pool.code == Status.OK), pool.cost, np.inf).min(1)
    far = np.where(remote, pool.cost, np.inf).min(1)
    with np.errstate(invalid="ignore"):
        rivals = np.isfinite(near) & (near - far <= AMBIGUOUS_GAP)
        alike = rivals & (far - near < AMBIGUOUS_GAP)
    return replace(pool, cost=np.where(remote & rivals[:, None], np.inf, pool.cost)), alike


def _sorted(pool: Candidates) -> Candidates:
    """Return the candidates of every problem, the cheapest first."""
    if pool.cost.shape[1] == 1:
        return pool
    order = np.argsort(pool.cost, axis=1, kind="stable")
    cost, code, face = (np.take_along_axis(a, order, axis=1) for a in (pool.cost, pool.code, pool.face))
    return Candidates(np.take_along_axis(pool.x, order[..., None], axis=1), cost, code, face)


def _preferred(problem: Problem, pool: Candidates) -> Array:
    """Return the slot to answer with: the cheapest, or of finished ones that cost the same that with the best sight."""
    finished, lowest_cost = pool.code == Status.OK, pool.cost[:, :1]
    with np.errstate(invalid="ignore"):
        near = finished & (pool.cost <= lowest_cost + 1e-6 * (1.0 + np.abs(lowest_cost)))
    best = np.where(near.any(1), near.argmax(1), 0)
    tied, slot = np.nonzero(near & (near.sum(1) > 1)[:, None])
    if len(tied) and problem.frame.geodetic:
        sight = np.full(pool.cost.shape, -np.inf)
        sight[tied, slot] = np.round(lowest(problem.take(tied), pool.x[tied, slot]), 6)
        best[tied] = sight[tied].argmax(1)
    return best


def _alternatives(
    problem: Problem, pool: Candidates, chosen: Array, value: Array, curvature: Curvature
) -> Alternatives:
    """Return the other finished minima within the listed gap, each once; those of a run whatever they cost.

    The rivals of a run are few, and by how much the data exclude them is what its user asks.
    """
    n, x = problem.layout.n_shared, pool.x
    limit = np.inf if problem.epochs > 1 else LISTED_GAP
    with np.errstate(invalid="ignore"):
        gap = np.where(pool.code == Status.OK, pool.cost - value[:, None], np.inf)
    gap = np.where(np.isfinite(gap) & (gap < limit), gap, np.inf)
    kept: list[tuple[Array, Array]] = [(chosen, np.full(len(x), -1.0))]
    used = np.isfinite(gap).any(0)
    for slot in np.flatnonzero(used):
        new = np.isfinite(gap[:, slot])
        for other, other_gap in kept:
            new &= ~_same(x[:, slot, :n], other[:, :n], curvature) | ~np.isfinite(other_gap)
        if new.any():
            kept.append((np.where(new[:, None], x[:, slot], np.nan), np.where(new, gap[:, slot], np.inf)))
    if len(kept) == 1:
        return Alternatives(np.full((len(x), 0, x.shape[-1]), np.nan), np.full((len(x), 0), np.inf))
    points, gaps = np.stack([k[0] for k in kept[1:]], axis=1), np.stack([k[1] for k in kept[1:]], axis=1)
    order = np.argsort(gaps, axis=1, kind="stable")
    keep = int(np.isfinite(gaps).sum(1).max())
    return Alternatives(
        np.take_along_axis(points, order[..., None], axis=1)[:, :keep],
        np.take_along_axis(gaps, order, axis=1)[:, :keep],
    )


def _same(x: Array, y: Array, curvature: Curvature) -> Array:
    """Return where two points are nearer than a tenth of a standard deviation in every direction, or equal."""
    difference = x - y
    with np.errstate(all="ignore"):  # a point that constraints hold has no spread
        squared = (difference[:, None, :] @ curvature.information @ difference[..., None])[:, 0, 0]
        spread = np.trace(curvature.covariance, axis1=-2, axis2=-1)  # constraints leave directions without information
        squared = np.maximum(squared, (difference**2).sum(-1) / spread)
        equal = (np.abs(difference) <= 1e-9 * (1.0 + np.abs(x))).all(-1)
    return np.asarray(equal | (squared < _SAME))


def _fill(size: int, value: Any) -> Array:
    out = np.empty(size, dtype=object)
    out[:] = value
    return out


def _local(problem: Problem, equations: Normal, shared: Array) -> Array | None:
    """Return the covariance of the states that targets have at each epoch of a run, or None where there are none."""
    names = {name for i, m in enumerate(problem.motions) for name in state_names(i, len(problem.motions), m.order)}
    size = sum(slot.size for slot in problem.layout.local if slot.name in names)
    with np.errstate(all="ignore"):
        return local_covariance(equations, shared, size) if size else None
