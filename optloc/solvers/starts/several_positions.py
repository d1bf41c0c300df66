"""Starts for more than one position: each target separately, by a closed form for all epochs, or epoch by epoch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import factorial

import numpy as np

from optloc.base import linalg
from optloc.base.types import Array, Band, Constraint, Motion, Stations
from optloc.linear.constraints import for_target, is_exact, is_of_one_target, needs_velocity
from optloc.linear.courses import elapsed
from optloc.linear.mirror import one_position
from optloc.linear.vectors import problem_at_rest, vectors, without_biases
from optloc.models import MODELS
from optloc.problem.epochs import by_epoch, without_epoch_correlation
from optloc.problem.fix import Fix
from optloc.problem.layout import state_names
from optloc.problem.noise import Block, Noise, group
from optloc.problem.problem import Problem
from optloc.solvers.starts.angles import course_starts, course_states


def from_pieces(problem: Problem, fixed: Callable[[Problem], Fix]) -> Array:
    """Return starting vectors (N, C, size) for a flat batch of problems with several targets or epochs.

    A state that its rows do not determine starts from its prior, if it has one. The first vector uses all rows as if no
    bias affected them. If biases affect a part of the rows, a second vector uses the others. A large error of one
    station moves the positions of the first vector, so that its descent can miss the best minimum.

    Parameters
    ----------
    problem : Problem
        N problems.
    fixed : callable
        Maps a flat batch of problems of one position to its fix.
    """
    x, others = _from_rows(problem, fixed), _without_biased_rows(problem)
    return x if others is None else np.concatenate([x, _from_rows(others, fixed)], axis=1)


def is_epochwise(problem: Problem) -> bool:
    """Return whether a problem has one target with a free position in each of several epochs."""
    return len(problem.motions) == 1 and problem.motions[0].span == "epoch" and problem.epochs > 1


def _without_biased_rows(problem: Problem) -> Problem | None:
    """Return a problem without the rows that its biases affect; None if these are all rows of an epoch, or none."""
    affected = np.zeros(problem.count, dtype=bool)
    for bias in problem.biases:
        affected[bias.row] = True
    if not affected.any() or len(np.unique(problem.epoch[~affected])) < len(np.unique(problem.epoch)):
        return None
    return problem.with_rows(weight=np.where(affected, 0.0, problem.weight))


def _from_rows(problem: Problem, fixed: Callable[[Problem], Fix]) -> Array:
    """Return one starting vector (N, 1, size) as if no bias affected the rows."""
    x = vectors(problem, None)[:, None]
    n, length = problem.layout.n_shared, problem.layout.n_local
    known = {prior.name for prior in problem.priors}
    for i, motion in enumerate(problem.motions):
        if motion.known is not None:
            continue
        names = state_names(i, len(problem.motions), motion.order)
        # a target without rows keeps its prior mean
        state = np.full((len(x), problem.epochs, len(names), problem.dimension), np.nan)
        if any((rows.target == i).any() for rows in problem.rows):
            state = _state(_isolate(problem, i), fixed)
        for j, name in enumerate(names):
            slot, shared = problem.layout.find(name)
            if shared:
                columns, found = slice(slot.start, slot.start + slot.size), state[:, 0, j]
                usable = np.isfinite(found) | (name not in known)  # otherwise the prior mean, which is in x, is kept
                x[:, 0, columns] = np.where(usable, found, x[:, 0, columns])
                continue
            for k in range(problem.epochs):
                start = n + k * length + slot.start
                x[:, 0, start : start + slot.size] = state[:, k, j]
    return x


def _isolate(problem: Problem, target: int) -> Problem:
    """Return the problem of one target: its rows and its constraints that help a start, without other unknowns."""
    problem = without_biases(problem)
    problem = _take_rows(problem, target) if len(problem.motions) > 1 else problem
    motion = problem.motions[target]
    # A constraint at the reference time may not apply at other times, but a known height is a good start.
    own = [c for c in problem.constraints if c.target == target and is_of_one_target(c)]
    constraints = tuple(
        for_target(c, 0)
        for c in own
        if motion.order == 0 or ((is_exact(c) or _applies_along(c)) and not needs_velocity(c))
    )
    return replace(problem, motions=(motion,), constraints=constraints, fences=())


def _applies_along(constraint: Constraint) -> bool:
    """Return whether a constraint applies along the whole course, not at the reference time only."""
    return isinstance(constraint, Band) and constraint.along


def _take_rows(problem: Problem, target: int) -> Problem:
    """Return the problem with the rows of one target only, which becomes target 0."""
    rows_of = [np.flatnonzero(rows.target == target) for rows in problem.rows]
    rows = [
        replace(
            r,
            z=r.z[..., i],
            a=r.a[i],
            b=r.b[i],
            epoch=r.epoch[i],
            target=0 * i,
            weight=r.weight[..., i],
            correction=r.correction[..., i],
        )
        for r, i in zip(problem.rows, rows_of, strict=True)
        if len(i)
    ]
    kept = np.concatenate([start + i for start, i in zip(problem.starts, rows_of, strict=True)])
    return replace(problem, rows=tuple(rows), noise=_take_noise(problem.noise, kept, problem.count))


def _take_noise(noise: Noise, kept: Array, count: int) -> Noise:
    """Return the noise of the rows `kept` among `count` rows; they get new numbers in their order."""
    # new number of each row; -1 for dropped rows
    number = np.full(count, -1)
    number[kept] = np.arange(len(kept))
    blocks = []
    for block in noise.blocks:
        present = number[block.row] >= 0
        # groups of a block may lose different rows; groups that lose the same rows stay one block
        for pattern in np.unique(present, axis=0):
            inside = np.flatnonzero(pattern)
            if not len(inside):
                continue
            groups = np.flatnonzero((present == pattern).all(1))
            covariance = block.covariance if block.covariance.shape[-3] == 1 else block.covariance[..., groups, :, :]
            blocks.append(Block(number[block.row[groups][:, inside]], covariance[..., inside[:, None], inside]))
    return group(blocks)


def _state(problem: Problem, fixed: Callable[[Problem], Fix]) -> Array:
    """Return the state (N, k or 1, order + 1, d) of the only target: position and derivatives; NaN without a fix.

    `fixed` maps problems of one position to their fixes.
    """
    motion, size = problem.motions[0], problem.batch_shape[0]
    if one_position(problem):
        position = fixed(problem_at_rest(problem)).position
        state = np.zeros((size, 1, motion.order + 1, problem.dimension))
        state[:, 0, 0] = position
        return state
    # rows of single stations give one fix, measured at any time, if the target is at rest
    if _can_merge_epochs(problem):
        return fixed(_merge_epochs(problem)).position[:, None, None]
    # closed forms of whole courses come first: a single epoch need not determine a position
    bistatic = course_starts(problem) if motion.span == "run" else None
    if bistatic is not None and np.isfinite(bistatic).all():
        return bistatic[:, None]
    from_angles = course_states(problem) if motion.span == "run" else None
    if from_angles is not None and np.isfinite(from_angles).all():
        return from_angles[:, None]
    # else epoch by epoch, and a polynomial through the fixes: inaccurate for weak epochs, but good enough as a start
    epochs = by_epoch(without_epoch_correlation(replace(problem, motions=(Motion(span="epoch", rise=motion.rise),))))
    fix = fixed(epochs.flat()).reshape((size, problem.epochs))
    if motion.span == "epoch":
        state = np.zeros((size, problem.epochs, motion.order + 1, problem.dimension))
        state[:, :, 0] = _fill_gaps(fix.position)
        return state
    state = _polynomial(fix, elapsed(problem, 0), motion.order)
    # the course from angles is better, since it uses all epochs
    if from_angles is not None:
        state = np.where(np.isfinite(from_angles).all((-2, -1), keepdims=True), from_angles, state)
    return state[:, None]


def _can_merge_epochs(problem: Problem) -> bool:
    """Return whether the rows of one target at rest may be merged into one epoch: each row has one station only."""
    motion = problem.motions[0]
    alone = all(MODELS[rows.kind].stations < 2 for rows in problem.rows)
    return motion.order == 0 and motion.span == "run" and alone and not problem.emitting


def _merge_epochs(problem: Problem) -> Problem:
    """Return the problem of a target at rest as one epoch: every position of a station becomes a station.

    Then one fix uses the rows of all epochs.
    """
    s = problem.stations
    nodes = [np.where(rows.a < 0, -1, rows.epoch * s.count + rows.a) for rows in problem.rows]
    used = np.unique(np.concatenate(nodes))
    used = used[used >= 0]
    epoch, station = np.divmod(used, s.count)

    def there(array: Array | None, rank: int) -> Array | None:
        if array is None:
            return None
        when = epoch if array.shape[-2 - rank] > 1 else 0 * epoch
        picked = array[..., when, station, :] if rank == 1 else array[..., when, station, :, :]
        return np.expand_dims(picked, -2 - rank)

    names = tuple(f"{s.names[i]} at {k}" for k, i in zip(epoch.tolist(), station.tolist(), strict=True))
    position, velocity, axes = there(s.position, 1), there(s.velocity, 1), there(s.axes, 2)
    assert position is not None
    rows = tuple(
        replace(r, a=np.where(node < 0, -1, np.searchsorted(used, node)), epoch=0 * r.epoch)
        for r, node in zip(problem.rows, nodes, strict=True)
    )
    stations = Stations(position, names, velocity, axes)
    return replace(problem, stations=stations, rows=rows, times=np.zeros(1))


def _fill_gaps(position: Array) -> Array:
    """Return positions (N, k, d) in which an epoch without a fix takes the last fix before it, or the first fix."""
    found = np.asarray(np.isfinite(position).all(-1))
    # index of the last fix so far; -1 before the first fix
    last = np.maximum.accumulate(np.where(found, np.arange(position.shape[1]), -1), axis=1)
    taken = np.where(last < 0, found.argmax(1)[:, None], last)
    return np.take_along_axis(position, taken[..., None], axis=1)


def _polynomial(fix: Fix, since: Array, order: int) -> Array:
    """Return the state (N, order + 1, d) of the polynomial nearest to the fixes (N, k), weighted by their variances.

    `since` (k,) are seconds since the reference time. NaN if too few epochs have a fix.
    """
    variance = np.trace(fix.covariance(), axis1=-2, axis2=-1)
    good = fix.answered & np.isfinite(variance) & np.isfinite(fix.position).all(-1)
    # a fix has the weight of its variance; epochs without a fix have weight zero
    weight = np.where(good, 1.0 / np.where(good, variance, 1.0), 0.0)
    design = np.stack([since**j / factorial(j) for j in range(order + 1)], axis=-1)
    weighted = np.swapaxes(design, -1, -2) * weight[:, None, :]
    state, ok = linalg.solve(weighted @ design, weighted @ np.where(good[..., None], fix.position, 0.0))
    return np.where(ok[:, None, None], state, np.nan)
