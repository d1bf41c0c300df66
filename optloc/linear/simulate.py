"""Draw measurements of a known truth."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.linear.evaluate import predict
from optloc.linear.normal import with_offsets
from optloc.models import MODELS
from optloc.models.primitives import wrap
from optloc.problem.noise import Noise
from optloc.problem.problem import Problem


def simulate(problem: Problem, truth: Array, seed: int | np.random.SeedSequence, trials: int | None = None) -> Problem:
    """Return a problem whose measurements are drawn from the model at a truth.

    Parameters
    ----------
    problem : Problem
        Stations, rows and noise; its measurements are ignored. Position errors of span "noise" are drawn as well.
    truth : array (..., size)
        True parameter vectors in the order of ``problem.layout``; leading axes must fit the problem's.
    seed : int or SeedSequence
        Decides the draw, whatever else runs.
    trials : int, optional
        Number of independent draws of each truth; they become the first axis.

    Returns
    -------
    Problem
        With leading axes (trials, ...), or (...).
    """
    rng = np.random.default_rng(seed)
    truth = np.asarray(truth, dtype=float)
    shape = np.broadcast_shapes(truth.shape[:-1], problem.batch_shape)
    if trials is not None:
        shape = (trials, *shape)
    noise = draw(problem.noise, problem.count, shape, rng)
    # Noise is drawn before station errors: problems with and without those meet the same noise.
    z = noise + predict(*_displace(problem, truth, shape, rng))
    values = []
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        part = z[..., start : start + rows.count]
        values.append((wrap(part) if MODELS[rows.kind].period is not None else part) + rows.correction)
    return problem.with_rows(z=np.concatenate(values, axis=-1))


def _displace(
    problem: Problem, truth: Array, shape: tuple[int, ...], rng: np.random.Generator
) -> tuple[Problem, Array]:
    """Return the problem with the stations where they really are, as far as their errors are noise, and its truth."""
    stations = problem.stations
    if stations.covariance is None or stations.span != "noise":
        return problem, truth
    errors = samples(stations.covariance[..., None, :, :, :], (*shape, problem.epochs, stations.count), rng)
    return with_offsets(problem, truth, errors.reshape(*shape, problem.epochs, -1))


def samples(covariance: Array, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return normal samples (*shape, r) of covariances (..., r, r) whose leading axes fit the shape."""
    # Not by Cholesky: rows that close a loop have a singular covariance.
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return np.asarray((root @ rng.standard_normal((*shape, covariance.shape[-1], 1)))[..., 0])


def draw(noise: Noise, count: int, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return noise samples (*shape, count) with the covariance of a problem's rows."""
    out = np.zeros((*shape, count))
    for block in noise.blocks:
        out[..., block.row] = samples(block.covariance, (*shape, len(block.row)), rng)
    return out
