"""From refined candidates to a fix: the best one, the others that the data allow, and the status."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc import linalg
from optloc.fix import Alternatives, Fix, Stage
from optloc.models import MODELS
from optloc.noise import whiten
from optloc.normal import Normal, marginal
from optloc.problem import Problem
from optloc.solve.reduce import ranges
from optloc.status import Certificate, Status
from optloc.types import Array

AMBIGUOUS_GAP = 9.0
LISTED_GAP = 25.0
DOUBT = 1e-3
_SAME = 1e-2
_WEAK = 1e-12
_FAR = 1e4

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
    x, cost, code = _sorted(pool)
    best, code = _preferred(cost, code)
    rows = np.arange(size)
    chosen, value, status = x[rows, best], cost[rows, best], code[rows, best].astype(np.int8)
    found = np.isfinite(value)
    with np.errstate(all="ignore"):
        at = equations(problem, np.where(found[:, None], chosen, 0.0))
        information, _, ok = marginal(at)
        cov, regular = linalg.inverse(information)
    cov = np.where((found & ok & regular)[:, None, None], cov, np.nan)
    others = _alternatives(problem, x, cost, code, chosen, value, information)
    reason = np.empty(size, dtype=object)
    reason[:] = ""
    fix = Fix(
        np.where(found[:, None], chosen, np.nan),
        cov,
        problem.layout,
        problem.frame,
        status,
        reason,
        _fill(size, _LOCAL),
        others,
        np.where(found, value, np.nan),
        degrees_of_freedom(problem),
        np.broadcast_to(problem.weight, (size, problem.count)),
        stages,
    )
    _explain(problem, fix, information, found & ok & regular)
    return fix


def _sorted(pool: Candidates) -> tuple[Array, Array, Array]:
    """Return points, costs and codes of every problem, the cheapest first."""
    if pool.cost.shape[1] == 1:
        return pool.x, pool.cost, pool.code
    order = np.argsort(pool.cost, axis=1, kind="stable")
    x = np.take_along_axis(pool.x, order[..., None], axis=1)
    return x, np.take_along_axis(pool.cost, order, axis=1), np.take_along_axis(pool.code, order, axis=1)


def _preferred(cost: Array, code: Array) -> tuple[Array, Array]:
    """Return the slot to answer with: the cheapest, or a finished one that costs the same."""
    finished = code == Status.OK
    lowest = cost[:, :1]
    near = finished & (cost <= lowest + 1e-6 * (1.0 + np.abs(lowest)))
    return np.where(near.any(1), near.argmax(1), 0), code


def _alternatives(
    problem: Problem, x: Array, cost: Array, code: Array, chosen: Array, value: Array, information: Array
) -> Alternatives:
    """Return the other finished minima within the listed gap, each once."""
    n = problem.layout.n_shared
    with np.errstate(invalid="ignore"):
        gap = np.where(code == Status.OK, cost - value[:, None], np.inf)
    gap = np.where(np.isfinite(gap) & (gap < LISTED_GAP), gap, np.inf)
    kept: list[tuple[Array, Array]] = [(chosen, np.full(len(x), -1.0))]
    used = np.isfinite(gap).any(0)
    for slot in np.flatnonzero(used):
        new = np.isfinite(gap[:, slot])
        for other, other_gap in kept:
            new &= ~_same(x[:, slot, :n], other[:, :n], information) | ~np.isfinite(other_gap)
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


def _same(x: Array, y: Array, information: Array) -> Array:
    """Return where two points are nearer than a tenth of a standard deviation, or equal to rounding."""
    difference = x - y
    with np.errstate(invalid="ignore", over="ignore"):
        squared = (difference[:, None, :] @ information @ difference[..., None])[:, 0, 0]
        equal = (np.abs(difference) <= 1e-9 * (1.0 + np.abs(x))).all(-1)
    return np.asarray(equal | (squared < _SAME))


def degrees_of_freedom(problem: Problem) -> Array:
    """Return rows present (the rank of their noise) less unknowns without a prior, (N,)."""
    rank = np.zeros(problem.batch_shape, dtype=int)
    for whitener in whiten(problem.noise, problem.weight):
        rank = rank + (whitener.matrix != 0.0).any(-1).sum((-1, -2)) * (
            len(whitener.row) if whitener.matrix.shape[-3] == 1 and len(whitener.row) > 1 else 1
        )
    known = (
        {prior.name for prior in problem.priors}
        | {b.name for b in problem.biases if b.sigma is not None}
        | {"stations"}
    )
    layout = problem.layout
    unknowns = sum(slot.size for slot in layout.shared if slot.name not in known)
    heard = [bool((problem.epoch == k).any()) for k in range(problem.epochs)]
    unknowns += sum(heard) * sum(slot.size for slot in layout.local if slot.name not in known)
    return np.broadcast_to(rank - unknowns, problem.batch_shape).astype(np.int32)


def _fill(size: int, value: Any) -> Array:
    out = np.empty(size, dtype=object)
    out[:] = value
    return out


def _explain(problem: Problem, fix: Fix, information: Array, regular: Array) -> None:
    """Settle the status of every fix and say why; writes into the fresh arrays of `fix`."""
    finite = np.isfinite(problem.z) | (problem.weight == 0.0)
    broken = ~np.broadcast_to(finite.all(-1), fix.code.shape)
    few = (fix.dof < 0) & ~broken
    missing = ~np.isfinite(fix.cost) & ~broken & ~few
    answered = ~(broken | few | missing)
    weak = answered & (_weakest(information) < _WEAK) | (answered & ~regular)
    far = answered & ~weak & (fix.code != Status.OK) & (_distance(problem, fix) > _FAR)
    fix.code[broken], fix.code[few], fix.code[far] = Status.REJECTED, Status.TOO_FEW_ROWS, Status.UNBOUNDED
    fix.code[weak] = Status.SINGULAR_GEOMETRY
    gap = np.min(fix.alternatives.gap, axis=1, initial=np.inf)
    fix.code[(fix.code == Status.OK) & (gap < AMBIGUOUS_GAP)] = Status.AMBIGUOUS
    doubtful = (fix.code == Status.OK) & (fix.p_value < DOUBT)
    p_value = fix.p_value
    for i in np.flatnonzero(doubtful):
        fix.reason[i] = f"the residuals are larger than the noise allows (p = {p_value[i]:.1g})"
    for i in np.flatnonzero(few):
        fix.reason[i] = f"there are {-int(fix.dof[i])} measurements fewer than unknowns"
    for i in np.flatnonzero(weak):
        fix.reason[i] = weak_direction(problem, information[i])
    for i in np.flatnonzero(fix.code == Status.AMBIGUOUS):
        fix.reason[i] = f"another position costs only {gap[i]:.2g} more"
    if missing.any():
        _explain_missing(problem, fix, np.flatnonzero(missing))
    unsure = ~np.isin(fix.code, (Status.OK, Status.AMBIGUOUS))
    fix.certificate[unsure] = _UNKNOWN
    gone = broken | few | missing | weak
    fix.x[gone & ~weak] = np.nan
    fix.cov[gone] = np.nan


def _explain_missing(problem: Problem, fix: Fix, items: Array) -> None:
    found = ranges(problem.take(items))
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


def _weakest(information: Array) -> Array:
    """Return the smallest squared pivot of the information scaled to a unit diagonal, (N,)."""
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 1.0 / np.sqrt(diagonal)
        lower, ok = linalg.factor(information * scale[..., :, None] * scale[..., None, :])
        pivots = np.diagonal(lower, axis1=-2, axis2=-1).min(-1) ** 2
    return np.where(ok & np.isfinite(pivots), pivots, 0.0)


def _distance(problem: Problem, fix: Fix) -> Array:
    """Return how far a fix is from the stations, in units of their spread."""
    if not any(slot.name == "position" for slot in problem.layout.shared):
        return np.zeros(len(fix.x))
    stations = problem.stations.position.reshape(*problem.stations.position.shape[:-3], -1, problem.dimension)
    centre = stations.mean(-2)
    spread = np.linalg.norm(stations - centre[..., None, :], axis=-1).max(-1)
    return np.asarray(np.linalg.norm(fix.position - centre, axis=-1) / np.where(spread > 0.0, spread, 1.0))


def weak_direction(problem: Problem, information: Array) -> str:
    """Return a sentence that names the combination of unknowns that the data leave open."""
    diagonal = np.diagonal(information)
    if not np.isfinite(information).all():
        return "the information is not finite"
    labels = problem.layout.labels()
    dead = np.flatnonzero(diagonal <= 1e-300)
    if len(dead):
        return "nothing measures " + ", ".join(labels[i] for i in dead)
    scale = 1.0 / np.sqrt(diagonal)
    _, vectors = np.linalg.eigh(information * scale[:, None] * scale[None])
    direction = vectors[:, 0] * scale
    direction = direction / np.abs(direction).max()
    terms = [f"{value:+.2g} {labels[i]}" for i, value in enumerate(direction) if abs(value) > 0.05]
    return "undetermined along " + " ".join(terms)


def station_direction(problem: Problem) -> str:
    """Return a sentence that names why the stations of one problem cannot fix a position."""
    position = problem.stations.position.reshape(-1, problem.dimension)
    used = sorted({int(s) for rows in problem.rows for s in (*rows.a, *rows.b) if s >= 0})
    places = position[used]
    values, vectors = np.linalg.eigh(np.cov(places.T, bias=True)) if len(used) > 1 else (np.zeros(1), np.eye(1))
    spread = np.sqrt(np.maximum(values, 0.0))
    if spread[-1] <= 1e-9 * (1.0 + np.abs(places).max()):
        return "the stations stand at one point"
    flat = int((spread < 1e-6 * spread[-1]).sum())
    axis = ", ".join(f"{v:.2f}" for v in vectors[:, -1])
    if flat >= problem.dimension - 1 and problem.dimension > 1:
        return f"the stations stand on one line along ({axis}); turning about it changes nothing"
    axis = ", ".join(f"{v:.2f}" for v in vectors[:, 0])
    return f"the rows leave more than one direction open; the stations spread least along ({axis})"


__all__ = ["Candidates", "Normal", "degrees_of_freedom", "judge", "weak_direction"]
