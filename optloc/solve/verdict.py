"""From refined candidates to a fix: the best one, the others that the data allow, and the status."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optloc.constraints import exact, violation_names
from optloc.fix import Alternatives, Fix, Stage
from optloc.models import MODELS
from optloc.noise import whiten
from optloc.observe import open_sentences
from optloc.problem import Problem
from optloc.solve.curvature import Curvature, curved, station_direction, weak_direction
from optloc.solve.reduce import ranges
from optloc.solve.scale import distance_of, spread_of
from optloc.solve.sight import lowest
from optloc.status import Certificate, Status
from optloc.types import Array
from optloc.windows import windows

AMBIGUOUS_GAP = 9.0
LISTED_GAP = 25.0
DOUBT = 1e-3
_SAME = 1e-2
_EQUAL = 1e-3
_WEAK = 1e-12
# Spreads of the stations: from here on a fix must be a good one, and from there on every wave front is flat.
_FAR, _FLAT = 1e4, 1e6

_LOCAL = Certificate(
    "local",
    "a stationary point with a positive definite normal matrix; the best of all candidates refined",
    "refinement",
)
_UNKNOWN = Certificate("unknown", "there is no refined answer to prove anything about", "none")


@dataclass(frozen=True, slots=True)
class Candidates:
    """Points that compete for each problem of a flat batch of N, q slots each.

    Parameters
    ----------
    x : array (N, q, size)
        Parameter vectors; NaN in empty slots.
    cost : array (N, q)
        Infinite in empty slots.
    code : int array (N, q)
        `Status` of their refinement.
    face : int array (N, q)
        Number of the face of `optloc.constraints.faces` on which each was refined; 0 without inequalities.
    """

    x: Array
    cost: Array
    code: Array
    face: Array


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
    )
    _explain(problem, fix, curvature)
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
        remote = (distance > _FLAT) | ((distance > _FAR) & (pool.code != Status.OK))
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


def degrees_of_freedom(problem: Problem) -> Array:
    """Return rows present (the rank of their noise) less unknowns without a prior, (N,)."""
    rank: Any = np.zeros(problem.batch_shape, dtype=int)
    heard: Any = 0
    for _, _, part in windows(problem, len(problem.weight) if problem.weight.ndim > 1 else 1):
        for whitener in whiten(part.noise, part.weight):
            same = len(whitener.row) if whitener.matrix.shape[-3] == 1 else 1
            rank = rank + same * (whitener.matrix != 0.0).any(-1).sum((-1, -2))
        heard = heard + _heard(part)
    known = (
        {prior.name for prior in problem.priors}
        | {b.name for b in problem.biases if b.sigma is not None}
        | {"stations"}
    )
    layout = problem.layout
    unknowns: Any = sum(slot.size for slot in layout.shared if slot.name not in known)
    unknowns = unknowns + heard * sum(slot.size for slot in layout.local if slot.name not in known)
    return np.broadcast_to(rank - unknowns + len(exact(problem)), problem.batch_shape).astype(np.int32)


def _heard(problem: Problem) -> Array:
    """Return the number of epochs with a row that is present, (...)."""
    order = np.argsort(problem.epoch, kind="stable")
    _, first = np.unique(problem.epoch[order], return_index=True)
    return np.asarray(np.maximum.reduceat(problem.weight[..., order] > 0.0, first, axis=-1).sum(-1))


def _fill(size: int, value: Any) -> Array:
    out = np.empty(size, dtype=object)
    out[:] = value
    return out


def _explain(problem: Problem, fix: Fix, curvature: Curvature) -> None:
    """Settle the status of every fix and say why; writes into the fresh arrays of `fix`."""
    finite = np.isfinite(problem.z) | (problem.weight == 0.0)
    broken = ~np.broadcast_to(finite.all(-1), fix.code.shape)
    few = (fix.dof < 0) & ~broken
    missing = ~np.isfinite(fix.cost) & ~broken & ~few
    answered = ~(broken | few | missing)
    weak = answered & ~(curvature.regular & (curvature.weakest >= _WEAK))
    distance = distance_of(problem, _position(problem, fix))
    with np.errstate(invalid="ignore"):
        loose = np.trace(fix.cov, axis1=-2, axis2=-1) > (distance * spread_of(problem)[1]) ** 2
        lost = weak | loose | (fix.code != Status.OK) | (fix.p_value < DOUBT)
        far = answered & ((lost & (distance > _FAR)) | (distance > _FLAT))
    weak &= ~far
    fix.code[broken], fix.code[few], fix.code[far] = Status.REJECTED, Status.TOO_FEW_ROWS, Status.UNBOUNDED
    fix.code[weak] = Status.SINGULAR_GEOMETRY
    gap = np.min(fix.alternatives.gap, axis=1, initial=np.inf)
    fix.code[(fix.code == Status.OK) & (gap < AMBIGUOUS_GAP)] = Status.AMBIGUOUS
    doubtful = (fix.code == Status.OK) & (fix.p_value < DOUBT)
    p_value = fix.p_value
    for i in np.flatnonzero(doubtful):
        fix.reason[i] = f"the residuals are larger than the noise allows (p = {p_value[i]:.1g})"
    for i in np.flatnonzero(few):
        lacking = -int(fix.dof[i])
        some = "is 1 measurement" if lacking == 1 else f"are {lacking} measurements"
        fix.reason[i] = f"there {some} fewer than unknowns"
    for i in np.flatnonzero(answered & np.isin(fix.code, (Status.UNBOUNDED, Status.MAX_ITERATIONS, Status.STALLED))):
        fix.reason[i] = f"the refinement stopped {distance[i]:.3g} spreads of the stations away"
    for i in np.flatnonzero(weak):
        fix.reason[i] = _open(problem, curvature.information[i])
    for i in np.flatnonzero(fix.code == Status.AMBIGUOUS):
        alike = gap[i] < _EQUAL
        fix.reason[i] = "another position " + ("fits as well" if alike else f"costs only {gap[i]:.2g} more")
        if problem.epochs > 1 and any(motion.order > 0 for motion in problem.motions):
            fix.reason[i] += ": a bound on height, speed or place would decide"
    barred = missing & (fix.code == Status.INFEASIBLE)
    for i in np.flatnonzero(barred):
        names = violation_names(problem)
        fix.reason[i] = (
            f"no minimum meets all of: {names}" if names else "the Earth hides every position from a satellite"
        )
    missing = missing & ~barred
    if missing.any():
        _explain_missing(problem, fix, np.flatnonzero(missing))
    unsure = ~np.isin(fix.code, (Status.OK, Status.AMBIGUOUS))
    fix.certificate[unsure] = _UNKNOWN
    gone = broken | few | missing | barred | weak | far
    fix.x[gone] = np.nan
    fix.cov[gone] = np.nan


def _open(problem: Problem, information: Array) -> str:
    """Return what the data leave open: combinations of biases by name, else the direction of the position."""
    named = open_sentences(problem.layout, information) if problem.biases and np.isfinite(information).all() else ()
    return "; ".join(named) or weak_direction(problem, information)


def _explain_missing(problem: Problem, fix: Fix, items: Array) -> None:
    single = problem.epochs == 1 or problem.stations.position.shape[-3] == 1
    found = ranges(problem.take(items)) if single else None
    for place, i in enumerate(items):
        groups = () if found is None else found.groups[int(found.pattern[place])]
        if len(groups) > 1:
            names = problem.stations.names
            fix.code[i] = Status.DISCONNECTED
            fix.reason[i] = "no row links " + " with ".join(
                "{" + ", ".join(names[s] for s in sorted(set(group))) + "}" for group in groups
            )
        elif not any(MODELS[rows.kind].ranges or MODELS[rows.kind].lifted for rows in problem.rows):
            fix.code[i] = Status.UNAVAILABLE
            fix.reason[i] = "no closed form starts from " + " and ".join(rows.kind for rows in problem.rows)
        else:
            fix.code[i] = Status.SINGULAR_GEOMETRY
            fix.reason[i] = station_direction(problem.take(np.array([i])))


def _position(problem: Problem, fix: Fix) -> Array:
    """Return the position (N, d) of the only target, or the centre of the stations where there is no such thing."""
    if any(slot.name == "position" for slot in problem.layout.shared):
        return fix.position
    return np.broadcast_to(spread_of(problem)[0], (len(fix.x), problem.dimension))
