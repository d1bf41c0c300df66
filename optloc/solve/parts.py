"""Very large batches are worked on part by part: memory beyond the answers does not grow with the batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from optloc.fix import Alternatives, Fix, Stage
from optloc.problem import Problem
from optloc.types import Array

PART = 2**15
_NAMES = ("x", "cov", "code", "reason", "certificate", "cost", "dof", "active", "local", "explanations")


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
        for name in _NAMES:
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
