"""Simulated measurements of a known truth; the same seed gives identical numbers on every processor."""

from __future__ import annotations

import numpy as np

from optloc.base import arrays, linalg
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
        Stations, rows and noise; its measurements are ignored. Station errors of span "noise" are drawn as well.
    truth : array (..., size)
        True parameter vectors in the order of ``problem.layout``; leading axes must fit the axes of the problem.
    seed : int or SeedSequence
        Seed of the random numbers; nothing else changes the result.
    trials : int, optional
        Number of independent draws of each truth; they become the first axis.

    Returns
    -------
    Problem
        Problem with leading axes (trials, ...), or (...).
    """
    rng = np.random.default_rng(seed)
    truth = np.asarray(truth, dtype=float)
    shape = np.broadcast_shapes(truth.shape[:-1], problem.batch_shape)
    if trials is not None:
        shape = (trials, *shape)
    noise = draw(problem.noise, problem.count, shape, rng)
    # Noise is drawn before station errors, so that problems with and without station errors have the same noise.
    real, x = _displace(problem, truth, shape, rng)
    # `Portable` computes sines and other functions without the C library, whose last bit depends on the platform.
    z = noise + np.asarray(predict(real, x.view(arrays.Portable)))
    values = []
    # measurements of angles are wrapped, and contain the known corrections that the model leaves out
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        part = z[..., start : start + rows.count]
        turned = np.asarray(wrap(part.view(arrays.Portable))) if MODELS[rows.kind].period is not None else part
        values.append(turned + rows.correction)
    return problem.with_rows(z=np.concatenate(values, axis=-1))


def _displace(
    problem: Problem, truth: Array, shape: tuple[int, ...], rng: np.random.Generator
) -> tuple[Problem, Array]:
    """Return the problem with randomly drawn station errors, and the true vectors that contain these errors.

    Station errors of span "noise" are independent in each epoch and not estimated. In the returned problem they are
    unknowns of each epoch, so that `predict` adds them to the stations. Without these errors, problem and truth are
    returned unchanged.

    Parameters
    ----------
    problem : Problem
        k epochs, s stations, d dimensions.
    truth : array (..., size)
        True parameter vectors of `problem`.
    shape : tuple of int
        Leading axes of the draws.
    rng : Generator
        Source of the random numbers.
    """
    stations = problem.stations
    if not stations.weighed:
        return problem, truth
    # one draw for each epoch and station, of positions, then of velocities
    drawn = [
        samples(covariance[..., None, :, :, :], (*shape, problem.epochs, stations.count), rng)
        for _, _, covariance in stations.errors
    ]
    errors = [each.reshape(*shape, problem.epochs, -1) for each in drawn]
    return with_offsets(problem, truth, np.concatenate(errors, axis=-1))


def samples(covariance: Array, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return samples (*shape, r) of normal distributions with mean zero and covariances (..., r, r).

    The leading axes of the covariances must be broadcastable to `shape`.
    """
    # Not by eigenvectors: for equal eigenvalues they depend on the BLAS library, and so would the data.
    factor = linalg.factor_semidefinite(covariance)
    return arrays.product(rng.standard_normal((*shape, covariance.shape[-1])), np.swapaxes(factor, -1, -2))


def draw(noise: Noise, count: int, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return noise samples (*shape, count) with the covariance of a problem's rows.

    `count` is the number of rows, and `shape` contains the leading axes.
    """
    out = np.zeros((*shape, count))
    for block in noise.blocks:
        out[..., block.row] = samples(block.covariance, (*shape, len(block.row)), rng)
    return out
