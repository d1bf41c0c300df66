"""Starts for more than one position: target by target, epoch by epoch, then a polynomial through the fixes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import factorial

import numpy as np

from optloc import linalg
from optloc.constraints import is_exact, needs_velocity
from optloc.epochs import by_epoch, untied
from optloc.fix import Fix
from optloc.layout import state_names
from optloc.plan import elapsed
from optloc.problem import Problem
from optloc.solve.bistatic import course_starts
from optloc.solve.start import static, vectors
from optloc.types import Array, Motion


def one_position(problem: Problem) -> bool:
    """Return whether a single position, seen from stations that stay, is all that needs a start."""
    if len(problem.motions) != 1 or problem.motions[0].known is not None or problem.motions[0].span == "epoch":
        return False
    still = problem.stations.position.shape[-3] == 1 and problem.motions[0].order == 0
    return still or problem.epochs == 1


def from_pieces(problem: Problem, fixed: Callable[[Problem], Fix]) -> Array:
    """Return one starting vector (N, 1, size) for a flat batch of problems with several targets or epochs.

    Parameters
    ----------
    problem : Problem
        N problems.
    fixed : callable
        Maps a flat batch of problems of one position to its fix.
    """
    x = vectors(problem, None)[:, None]
    n, length = problem.layout.n_shared, problem.layout.n_local
    for i, motion in enumerate(problem.motions):
        if motion.known is not None:
            continue
        names = state_names(i, len(problem.motions), motion.order)
        state = _state(_alone(problem, i), fixed)
        for j, name in enumerate(names):
            slot, shared = problem.layout.find(name)
            if shared:
                x[:, 0, slot.start : slot.start + slot.size] = state[:, 0, j]
                continue
            for k in range(problem.epochs):
                start = n + k * length + slot.start
                x[:, 0, start : start + slot.size] = state[:, k, j]
    return x


def _alone(problem: Problem, target: int) -> Problem:
    """Return the problem of one target: the rows of the others are absent."""
    rows = tuple(
        replace(r, weight=np.where(r.target == target, r.weight, 0.0), target=np.zeros_like(r.target))
        for r in problem.rows
    )
    motion = problem.motions[target]
    # What bounds a moving target holds at its reference time only, but a known height is as good a start elsewhere.
    constraints = tuple(
        replace(c, target=0)
        for c in problem.constraints
        if c.target == target and (motion.order == 0 or (is_exact(c) and not needs_velocity(c)))
    )
    return replace(problem, rows=rows, motions=(motion,), biases=(), priors=(), constraints=constraints)


def _state(problem: Problem, fixed: Callable[[Problem], Fix]) -> Array:
    """Return the state (N, k or 1, order + 1, d) of the only target; NaN where it has no fix."""
    motion, size = problem.motions[0], problem.batch_shape[0]
    if one_position(problem):
        position = fixed(static(problem)).position
        state = np.zeros((size, 1, motion.order + 1, problem.dimension))
        state[:, 0, 0] = position
        return state
    ahead = course_starts(problem) if motion.span == "run" else None
    if ahead is not None and np.isfinite(ahead).all():
        return ahead[:, None]
    free = by_epoch(untied(replace(problem, motions=(Motion(span="epoch"),))))
    fix = fixed(free.flat()).reshape((size, problem.epochs))
    if motion.span == "epoch":
        state = np.zeros((size, problem.epochs, motion.order + 1, problem.dimension))
        state[:, :, 0] = fix.position
        return state
    return _polynomial(fix, elapsed(problem, 0), motion.order)[:, None]


def _polynomial(fix: Fix, since: Array, order: int) -> Array:
    """Return the state (N, order + 1, d) of the polynomial nearest to the fixes (N, k), weighted by their variances."""
    variance = np.trace(fix.covariance(), axis1=-2, axis2=-1)
    good = fix.answered & np.isfinite(variance) & np.isfinite(fix.position).all(-1)
    weight = np.where(good, 1.0 / np.where(good, variance, 1.0), 0.0)
    design = np.stack([since**j / factorial(j) for j in range(order + 1)], axis=-1)
    weighted = np.swapaxes(design, -1, -2) * weight[:, None, :]
    state, ok = linalg.solve(weighted @ design, weighted @ np.where(good[..., None], fix.position, 0.0))
    return np.where(ok[:, None, None], state, np.nan)
