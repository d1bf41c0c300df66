"""Draw measurements of a known truth."""

from __future__ import annotations

import numpy as np

from optloc.linear import predict
from optloc.models import MODELS
from optloc.models.primitives import wrap
from optloc.noise import Noise
from optloc.problem import Problem
from optloc.types import Array


def simulate(problem: Problem, truth: Array, seed: int | np.random.SeedSequence, trials: int | None = None) -> Problem:
    """Return a problem whose measurements are drawn from the model at a truth.

    Parameters
    ----------
    problem : Problem
        Stations, rows and noise; its measurements are ignored.
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
    exact = predict(problem, np.asarray(truth, dtype=float))
    shape = np.broadcast_shapes(exact.shape[:-1], problem.batch_shape)
    if trials is not None:
        shape = (trials, *shape)
    z = exact + draw(problem.noise, problem.count, shape, rng)
    values = []
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        part = z[..., start : start + rows.count]
        values.append((wrap(part) if MODELS[rows.kind].period is not None else part) + rows.correction)
    return problem.with_rows(z=np.concatenate(values, axis=-1))


def draw(noise: Noise, count: int, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return noise samples (*shape, count) with the covariance of a problem's rows."""
    out = np.zeros((*shape, count))
    for block in noise.blocks:
        values, vectors = np.linalg.eigh(block.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
        normal = rng.standard_normal((*shape, *block.row.shape, 1))
        out[..., block.row] = (root @ normal)[..., 0]
    return out
