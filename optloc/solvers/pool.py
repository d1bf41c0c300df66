"""Put better fixes of some problems into the fixes of all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from optloc.base.status import Certificate, Status
from optloc.base.types import Array
from optloc.linear.degrees_of_freedom import degrees_of_freedom
from optloc.problem.fix import Alternatives, Fix, Stage
from optloc.problem.problem import Problem

_NAMES = "x cov code reason certificate cost dof weights active local explanations".split()


def merged(fix: Fix, items: Array, other: Fix, stage: Stage) -> Fix:
    """Return a flat batch of fixes with some of them replaced by others, and one more stage.

    Parameters
    ----------
    fix : Fix
        N fixes.
    items : int array (q,)
        Which are replaced.
    other : Fix
        The q fixes that take their place.
    stage : Stage
        What was done.
    """
    width = max(fix.alternatives.gap.shape[1], other.alternatives.gap.shape[1])
    mine, theirs = _padded(fix.alternatives, width), _padded(other.alternatives, width)
    mine.x[items], mine.gap[items] = theirs.x, theirs.gap
    changed: dict[str, Array] = {}
    for name in _NAMES:
        if (old := getattr(fix, name)) is not None:
            changed[name] = np.array(old)
            changed[name][items] = getattr(other, name)
    return replace(fix, alternatives=mine, stages=(*fix.stages, stage), **changed)  # type: ignore[arg-type]


def stacked(fixes: Sequence[Fix]) -> Fix:
    """Return single fixes of one layout as a batch."""
    width = max(len(fix.alternatives.gap) for fix in fixes)
    every = [_padded(fix.flat().alternatives, width) for fix in fixes]
    others = Alternatives(np.concatenate([a.x for a in every]), np.concatenate([a.gap for a in every]))
    arrays = {name: np.stack([getattr(fix, name) for fix in fixes]) for name in _NAMES if _has(fixes, name)}
    return replace(fixes[0], alternatives=others, **arrays)  # type: ignore[arg-type]


def _has(fixes: Sequence[Fix], name: str) -> bool:
    return all(getattr(fix, name) is not None for fix in fixes)


def _padded(alternatives: Alternatives, width: int) -> Alternatives:
    more = width - alternatives.gap.shape[1]
    x = np.pad(alternatives.x, ((0, 0), (0, more), (0, 0)), constant_values=np.nan)
    return Alternatives(x, np.pad(alternatives.gap, ((0, 0), (0, more)), constant_values=np.inf))


# Very large batches are worked on part by part: memory beyond the answers does not grow with the batch.

PART = 2**15
_FIELDS = ("x", "cov", "code", "reason", "certificate", "cost", "dof", "active", "local", "explanations")


def in_parts(problem: Problem, work: Callable[[Problem, slice], Fix], most: int = PART) -> Fix:
    """Return the fixes of a flat batch of problems, at most so many at a time.

    Parameters
    ----------
    problem : Problem
        N problems.
    work : callable
        Maps some of the problems, and which they are, to their fixes.
    most : int
        Problems in one part.
    """
    count = problem.batch_shape[0]
    if count <= most:
        return work(problem, slice(0, count))
    arrays: dict[str, Array] = {}
    others: list[Alternatives] = []
    stages: list[tuple[Stage, ...]] = []
    weights: list[Array] = []
    fix = None
    for first in range(0, count, most):
        part = slice(first, min(first + most, count))
        fix = work(problem.take(np.arange(part.start, part.stop)), part)
        for name in _FIELDS:
            value = getattr(fix, name)
            if value is not None:
                if name not in arrays:
                    arrays[name] = np.empty((count, *value.shape[1:]), dtype=value.dtype)
                arrays[name][part] = value
        others.append(fix.alternatives)
        stages.append(fix.stages)
        weights.append(fix.weights)
    assert fix is not None
    given = np.broadcast_to(problem.weight, (count, problem.count))
    kept = all(np.array_equal(part, given[: len(part)]) for part in weights) and not given.strides[0]
    used = given if kept else np.concatenate(weights)
    whole = replace(fix, alternatives=_joined(others), weights=used, stages=_summed(stages))
    return replace(whole, **arrays)  # type: ignore[arg-type]


def _joined(parts: list[Alternatives]) -> Alternatives:
    """Return the alternatives of all parts, with as many slots as the fullest needs."""
    count, width = sum(len(part.gap) for part in parts), max(part.gap.shape[1] for part in parts)
    x, gap = np.full((count, width, parts[0].x.shape[2]), np.nan), np.full((count, width), np.inf)
    first = 0
    for part in parts:
        rows, slots = slice(first, first + len(part.gap)), slice(0, part.gap.shape[1])
        x[rows, slots], gap[rows, slots] = part.x, part.gap
        first += len(part.gap)
    return Alternatives(x, gap)


def _summed(parts: list[tuple[Stage, ...]]) -> tuple[Stage, ...]:
    """Return the stages of the part that took most of them, with the seconds of all."""
    longest = max(parts, key=len)
    seconds = dict.fromkeys(range(len(longest)), 0.0)
    for stages in parts:
        for i, stage in enumerate(stages):
            seconds[i] += stage.seconds
    return tuple(
        Stage(stage.name, f"{stage.detail} (one of {len(parts)} parts)", seconds[i]) for i, stage in enumerate(longest)
    )


def pooled(fix: Fix) -> tuple[Array, Array, Array]:
    """Return a fix and its alternatives as one pool (N, q, size), and item and slot of every point in it."""
    pool = np.concatenate([fix.x[:, None], fix.alternatives.x], axis=1)
    item, slot = np.nonzero(np.isfinite(pool).all(-1))
    return pool, item, slot


def packed(points: Array) -> Array:
    """Return points (N, q, n) with the finite ones of each problem first, and no more slots than needed."""
    if points.shape[1] <= 1:
        return points
    finite = np.isfinite(points).all(-1)
    order = np.argsort(~finite, axis=1, kind="stable")
    keep = max(1, int(finite.sum(1).max(initial=0)))
    return np.take_along_axis(points, order[..., None], axis=1)[:, :keep]


def unrefined(problem: Problem, x: Array, fix: Fix | None, name: str, began: float) -> Fix:
    """Return starts (N, q, size) as a fix whose status says that they are not refined."""
    size, n = len(x), problem.layout.n_shared
    reason, certificate = np.empty(size, dtype=object), np.empty(size, dtype=object)
    reason[:], certificate[:] = "not refined", Certificate("unknown", "a start, not refined", name)
    stage = Stage(name, f"{x.shape[1]} candidates at most", perf_counter() - began)
    return Fix(
        x[:, 0],
        np.full((size, n, n), np.nan),
        problem.layout,
        problem.frame,
        np.full(size, int(Status.UNAVAILABLE), dtype=np.int8),
        reason,
        certificate,
        Alternatives(x[:, 1:], np.full((size, x.shape[1] - 1), np.nan)),
        np.full(size, np.nan),
        degrees_of_freedom(problem),
        np.broadcast_to(problem.weight, (size, problem.count)),
        (*(fix.stages if fix else ()), stage),
    )


def given(problem: Problem, start: Array) -> Fix:
    """Return a given start (N, size) or (N, q, size) as an unrefined fix."""
    began = perf_counter()
    x = np.asarray(start, dtype=float)
    x = x[:, None] if x.ndim == 2 else x
    return unrefined(problem, x, None, "start", began)


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
        Number of the face of `optloc.linear.constraints.faces` on which each was refined; 0 without inequalities.
    """

    x: Array
    cost: Array
    code: Array
    face: Array
