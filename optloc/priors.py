"""Gaussian prior knowledge of named unknowns, as information."""

from __future__ import annotations

import numpy as np

from optloc import linalg
from optloc.arrays import library, placed
from optloc.normal import Normal
from optloc.problem import Problem
from optloc.types import Array


def with_priors(problem: Problem, x: Array, equations: Normal, *, shared: bool = True, local: bool = True) -> Normal:
    """Return normal equations with the Gaussian priors of a problem added.

    Parameters
    ----------
    problem : Problem
        Priors on named unknowns, biases and station positions.
    x : array (..., size)
        Where the problem was linearised.
    equations : Normal
        Of the measurements alone.
    shared, local : bool
        Which priors are added: those of shared unknowns, those of unknowns local to each epoch.
    """
    layout = problem.layout
    parts = [part for part in prior_parts(problem) if (shared if layout.find(part[0])[1] else local)]
    if not parts:
        return equations
    (at_shared, at_local), xp = layout.split(x), library(x)
    matrix, vector, cost = equations.shared, equations.shared_vector, equations.cost
    blocks, local_vector = equations.local, equations.local_vector
    for name, mean, precision in parts:
        slot, is_shared = layout.find(name)
        width = layout.n_shared if is_shared else layout.n_local
        pick = placed(np.eye(width)[:, slot.start : slot.start + slot.size], x)
        precision = placed(precision, x)  # noqa: PLW2901  # the same numbers, elsewhere
        error = placed(mean, x) - (at_shared if is_shared else at_local)[..., slot.start : slot.start + slot.size]
        pull = (precision @ error[..., None])[..., 0]
        penalty = xp.sum(error * pull, axis=-1)
        if is_shared:
            matrix, vector = matrix + pick @ precision @ pick.mT, vector + (pick @ pull[..., None])[..., 0]
            cost = cost + penalty
        else:
            blocks, local_vector = (
                blocks + pick @ precision @ pick.mT,
                local_vector + (pick @ pull[..., None])[..., 0],
            )
            cost = cost + xp.sum(penalty, axis=-1)
    return Normal(matrix, blocks, equations.cross, vector, local_vector, cost)


def prior_parts(problem: Problem) -> list[tuple[str, Array, Array]]:
    """Return (name, mean, precision) of every prior; local ones have an epoch axis of length one."""
    parts, layout = [], problem.layout
    for prior in problem.priors:
        precision, _ = linalg.inverse(prior.covariance)
        _, is_shared = layout.find(prior.name)
        mean = prior.mean if is_shared else prior.mean[..., None, :]
        parts.append((prior.name, mean, precision if is_shared else precision[..., None, :, :]))
    for bias in problem.biases:
        if bias.sigma is not None:
            sigma = np.ravel(bias.sigma)
            parts.append((bias.name, np.broadcast_to(np.ravel(bias.mean), sigma.shape), np.diag(sigma**-2.0)))
    stations = problem.stations
    if stations.covariance is not None and stations.span != "noise":
        precision = _block_diagonal(linalg.inverse(stations.covariance)[0])
        if stations.span == "epoch":
            precision = precision[..., None, :, :]
        parts.append(("stations", np.zeros(precision.shape[-1]), precision))
    return parts


def _block_diagonal(blocks: Array) -> Array:
    s, d = blocks.shape[-3], blocks.shape[-1]
    apart = placed(np.eye(s)[:, None, :, None], blocks) * blocks[..., :, :, None, :]
    whole: Array = library(blocks).reshape(apart, (*blocks.shape[:-3], s * d, s * d))
    return whole
