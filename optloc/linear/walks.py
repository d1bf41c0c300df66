"""Random walks of biases as information that couples the unknowns of successive epochs.

Letters: k epochs, l local unknowns of each. A walk has q members with o states each: a value, and a rate if it has one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from optloc.base import linalg
from optloc.base.types import Array, Bias
from optloc.problem.clocks import state_of
from optloc.problem.forms import form_of
from optloc.problem.layout import Layout
from optloc.problem.problem import Problem


def walks(problem: Problem) -> tuple[Bias, ...]:
    """Return the biases of a problem that walk from epoch to epoch."""
    return tuple(bias for bias in problem.biases if form_of(bias).steps is not None)


def walk_names(problem: Problem) -> tuple[str, ...]:
    """Return the names of the local unknowns that walk: values and rates."""
    return tuple(name for bias in walks(problem) for name in state_of(bias))


def count_free_unknowns(problem: Problem) -> int:
    """Return the number of initial values of all walks without a prior; the steps of walks do not count."""
    return sum(len(b.members) * len(state_of(b)) - (0 if b.sigma is None else np.size(b.sigma)) for b in walks(problem))


@dataclass(frozen=True, slots=True)
class Chain:
    """Information about the unknowns of k epochs that couples each epoch to the next.

    Parameters
    ----------
    block : array (k, l, l)
        Information about the unknowns of an epoch.
    link : array (k - 1, l, l)
        Coupling: rows of an epoch, columns of the next.
    vector : array (..., k, l)
        Right side at given vectors.
    cost : array (...)
        Cost of the steps at these vectors.
    """

    block: Array
    link: Array
    vector: Array
    cost: Array


def chain_at(problem: Problem, x: Array) -> Chain:
    """Return the information of the walks of a problem at vectors x (..., size).

    The states of epoch j + 1 are ``x_{j+1} = F x_j`` plus noise of covariance Q. The step ``e = x_{j+1} - F x_j`` with
    precision W = Q^-1 has the information ``F'WF``, ``-F'W`` and ``W``. Its right side is ``F'We`` and ``-We``.
    """
    layout, k = problem.layout, problem.epochs
    local = layout.split(x)[1]
    block, link = np.zeros((k, layout.n_local, layout.n_local)), np.zeros((k - 1, layout.n_local, layout.n_local))
    vector, cost = np.zeros(local.shape), np.zeros(x.shape[:-1])
    for bias, place, F, Q in _steps(problem):
        W = linalg.inverse(Q, 0.0)[0]
        # `error` is the step e, `pull` is W e
        state = local[..., place]  # (..., k, q, o)
        error = state[..., 1:, :, :] - (F[:, None] @ state[..., :-1, :, :, None])[..., 0]
        pull = (W @ error[..., None])[..., 0]
        across = F.mT[:, None] @ W
        one, two = place[:, :, None], place[:, None, :]
        block[:-1, one, two] += across @ F[:, None]
        block[1:, one, two] += W
        link[:, one, two] -= across
        vector[..., :-1, place] += (F.mT[:, None] @ pull[..., None])[..., 0]
        vector[..., 1:, place] -= pull
        cost = cost + (error * pull).sum((-1, -2, -3))
        if bias.sigma is not None:  # the prior applies to the value at the first epoch, not to its rate
            first, precision = place[:, 0], np.ravel(bias.sigma) ** -2.0
            off = np.ravel(bias.mean) - local[..., 0, first]
            block[0, first, first] += precision
            vector[..., 0, first] += precision * off
            cost = cost + (precision * off**2).sum(-1)
    return Chain(block, link, vector, cost)


def _steps(problem: Problem) -> Iterator[tuple[Bias, Array, Array, Array]]:
    """Yield each walk, the local columns (q, o) of its states, and the transitions F and covariances Q of its steps."""
    for bias in problem.biases:
        steps = form_of(bias).steps
        if steps is not None:
            yield bias, state_columns(problem.layout, bias), *steps(bias, problem.times)


def state_columns(layout: Layout, bias: Bias) -> Array:
    """Return the local columns (q, o) of the states of a walk."""
    starts = [layout.find(name)[0].start for name in state_of(bias)]
    return np.stack([start + np.arange(len(bias.members)) for start in starts], axis=1)


def simulate_walks(
    problem: Problem, truth: Array, seed: int | np.random.SeedSequence, trials: int | None = None
) -> Array:
    """Return true parameter vectors with simulated walks, which begin at the given values.

    Parameters
    ----------
    problem : Problem
        Problem with the walks.
    truth : array (..., size)
        True parameter vectors in the order of ``problem.layout``. For a walk, only the value at the first epoch is
        used.
    seed : int or SeedSequence
        Seed of the random numbers.
    trials : int, optional
        Number of independent draws; they become the first axis.

    Returns
    -------
    array (trials, ..., size) or (..., size)
        Vectors for `optloc.simulate`, which draws the noise of the rows.
    """
    rng, truth = np.random.default_rng(seed), np.asarray(truth, dtype=float)
    shape = truth.shape if trials is None else (trials, *truth.shape)
    out = np.array(np.broadcast_to(truth, shape))
    local = out[..., problem.layout.n_shared :].reshape(*shape[:-1], problem.epochs, problem.layout.n_local)
    for _, place, F, Q in _steps(problem):
        # not by eigenvectors, for the reason in `optloc.linear.simulate.samples`
        root = linalg.factor_semidefinite(Q)
        noise = (root @ rng.standard_normal((*shape[:-1], *Q.shape[:-1], 1)))[..., 0]
        for j in range(problem.epochs - 1):
            before = local[..., j, :][..., place]
            local[..., j + 1, place] = (F[j] @ before[..., None])[..., 0] + noise[..., j, :, :]
    out[..., problem.layout.n_shared :] = local.reshape(*shape[:-1], -1)
    return out
