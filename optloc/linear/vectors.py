"""Parameter vectors from positions: the other unknowns get their prior mean, or the value that fits best.

Letters: N problems, q positions of each, d coordinates, `size` unknowns of a problem.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base.types import Array
from optloc.linear.evaluate import block_links, columns, predict
from optloc.problem.layout import emission_name
from optloc.problem.problem import Problem


def vectors(problem: Problem, position: Array | None) -> Array:
    """Return full parameter vectors (N, q, size) with given positions and every other unknown at its prior mean.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    position : array (N, q, d or more), optional
        Positions of the only target, optionally followed by velocity and acceleration. None: vectors (N, size) without
        any state.
    """
    layout = problem.layout
    x = np.zeros(((problem.batch_shape[0],) if position is None else position.shape[:-1]) + (layout.size,))
    means = [(prior.name, prior.mean) for prior in problem.priors]
    means += [(bias.name, np.ravel(bias.mean)) for bias in problem.biases if bias.sigma is not None]
    for name, mean in means:
        slot, shared = layout.find(name)
        if shared:
            each = mean if mean.ndim == 1 or position is None else mean[:, None]
            x[..., slot.start : slot.start + slot.size] = each
    if position is not None:
        slot, _ = layout.find("position")
        x[..., slot.start : slot.start + position.shape[-1]] = position
        x = _fit_emission_times(problem, x) if problem.emitting else x
    return x


def complete(problem: Problem, shared: Array) -> Array:
    """Return full parameter vectors (N, q, size) for shared unknowns (N, q, n); local ones fit best, or are zero."""
    x = np.zeros((*shared.shape[:-1], problem.layout.size))
    x[..., : shared.shape[-1]] = shared
    x[np.isnan(shared).any(-1)] = np.nan
    return _fit_emission_times(problem, x) if problem.emitting else x


def _fit_emission_times(problem: Problem, x: Array) -> Array:
    """Return vectors (N, q, size) with the emission times that fit best: the mean of the residuals without them.

    Vectors with NaN are not changed.
    """
    size, q = x.shape[:2]
    part, out = problem.take(np.repeat(np.arange(size), q)), x.reshape(size * q, x.shape[-1]).copy()
    usable = np.asarray(np.isfinite(out).all(-1))
    left = part.observed - predict(part, np.where(usable[:, None], out, 0.0))
    present, emissions = np.broadcast_to(part.weight > 0.0, left.shape), emission_columns(problem)
    # an emission time has the factor one in each of its rows, so the mean residual fits best; without a row it stays
    # zero
    for links, start in zip(block_links(problem), problem.starts, strict=True):
        own = np.isin(links.adds.column, emissions) & links.model.emission
        column, rows = links.adds.column[own], start + links.adds.row[own]
        if len(column):
            order = np.argsort(column, kind="stable")
            columns_of_rows, first = np.unique(column[order], return_index=True)
            counts = np.add.reduceat(1.0 * present[:, rows[order]], first, axis=-1)
            total = np.add.reduceat(np.where(present, left, 0.0)[:, rows[order]], first, axis=-1)
            out[:, columns_of_rows] += np.where(usable[:, None], total / np.maximum(counts, 1.0), 0.0)
    return out.reshape(size, q, -1)


def emission_columns(problem: Problem) -> Array:
    """Return the columns of all emission times in the full parameter vector."""
    names = [emission_name(target, len(problem.motions)) for target in problem.emitting]
    return np.concatenate([columns(problem.layout, name, np.arange(problem.epochs)).ravel() for name in names])


def problem_at_rest(problem: Problem) -> Problem:
    """Return the problem with a static target and no other unknowns than position and emission times."""
    motions = tuple(replace(motion, order=0) for motion in problem.motions)
    return replace(without_biases(problem), motions=motions)


def without_biases(problem: Problem) -> Problem:
    """Return a flat batch of problems without biases and priors: each bias is fixed at its prior mean.

    Offsets, drifts and scales without a prior are set to zero, and rotations always.
    """
    x, rows = vectors(problem, None), []
    for links, block in zip(block_links(problem), problem.rows, strict=True):
        gain, added = links.gains.total(x, block.count), links.adds.total(x, block.count)
        # a row is z = (1 + gain) h(x) + added + correction, solved for h(x)
        z = (block.z - block.correction - added) / (1.0 + gain)
        # rows without a bias are not changed, not even by rounding
        known = replace(block, z=z, correction=np.zeros(block.count))
        rows.append(known if gain.any() or added.any() else block)
    return replace(problem, rows=tuple(rows), biases=(), priors=())
