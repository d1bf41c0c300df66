"""Gaussian prior knowledge of named unknowns, as information."""

from __future__ import annotations

import numpy as np

from optloc import linalg
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
    at_shared, at_local = layout.split(x)
    matrix, vector, cost = equations.shared.copy(), equations.shared_vector.copy(), equations.cost
    blocks, local_vector = equations.local.copy(), equations.local_vector.copy()
    for name, mean, precision in parts:
        slot, is_shared = layout.find(name)
        part = slice(slot.start, slot.start + slot.size)
        error = mean - (at_shared[..., part] if is_shared else at_local[..., part])
        pull = (precision @ error[..., None])[..., 0]
        penalty = (error * pull).sum(-1)
        if is_shared:
            matrix[..., part, part] += precision
            vector[..., part] += pull
            cost = cost + penalty
        else:
            blocks[..., part, part] += precision
            local_vector[..., part] += pull
            cost = cost + penalty.sum(-1)
    return Normal(matrix, blocks, equations.cross, vector, local_vector, cost)


def prior_parts(problem: Problem) -> list[tuple[str, Array, Array]]:
    """Return (name, mean, precision) of every prior; local ones have an epoch axis of length one."""
    parts = []
    for prior in problem.priors:
        precision, _ = linalg.inverse(prior.covariance)
        _, is_shared = problem.layout.find(prior.name)
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
    out = np.zeros((*blocks.shape[:-3], s, d, s, d))
    index = np.arange(s)
    out[..., index, :, index, :] = np.moveaxis(blocks, -3, 0)
    return out.reshape(*blocks.shape[:-3], s * d, s * d)
