"""Degrees of freedom of a problem: the number of rows less the number of unknowns."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import gammainccinv

from optloc.base.types import Array
from optloc.linear.constraints import exact
from optloc.linear.walks import count_free_unknowns, walk_names
from optloc.models import MODELS
from optloc.problem.epochs import windows
from optloc.problem.layout import emission_name, state_names
from optloc.problem.noise import whiten
from optloc.problem.problem import Problem


def degrees_of_freedom(problem: Problem) -> Array:
    """Return the number of present rows (rank of their noise) less unknowns without a prior, (N,).

    A local unknown, such as the emission time of a target, counts if a present row depends on it.
    """
    rank: Any = np.zeros(problem.batch_shape, dtype=int)
    local: Any = 0
    # Each unknown with a prior adds one row, so that both cancel.
    known = (
        {prior.name for prior in problem.priors}
        | {b.name for b in problem.biases if b.sigma is not None}
        | {name for name, _, _ in problem.stations.errors}
        | {*walk_names(problem)}
    )
    states, emissions = _sizes(problem, known)
    for _, _, part in windows(problem, len(problem.weight) if problem.weight.ndim > 1 else 1):
        for whitener in whiten(part.noise, part.weight):
            # One matrix may represent all groups. The number of nonzero rows of a whitening matrix is the rank of its
            # covariance.
            same = len(whitener.row) if whitener.matrix.shape[-3] == 1 else 1
            rank = rank + same * (whitener.matrix != 0.0).any(-1).sum((-1, -2))
        local = local + _local_unknowns(part, states, emissions)
    shared = sum(slot.size for slot in problem.layout.shared if slot.name not in known)
    # The steps of a walk add the same number of rows and unknowns, so that only its initial unknowns count.
    unknowns = shared + local + count_free_unknowns(problem)
    return np.broadcast_to(rank - unknowns + len(exact(problem)), problem.batch_shape).astype(np.int32)


def present_unknowns(problem: Problem) -> Array:
    """Return the number of unknowns (...) that present rows depend on; shared unknowns and walks always count."""
    layout = problem.layout
    states, emissions = _sizes(problem, set())
    local = problem.stations.errors if problem.stations.unknown_for == "epoch" else ()
    own = {name for name, _, _ in local} | {*walk_names(problem)}
    walked = problem.epochs * sum(slot.size for slot in layout.local if slot.name in own)
    return np.asarray(layout.n_shared + walked + _local_unknowns(problem, states, emissions))


def _sizes(problem: Problem, known: set[str]) -> tuple[Array, Array]:
    """Return two arrays (targets,): the number of state unknowns and of emission times of each target in an epoch.

    Slots whose names are in `known` do not count.
    """
    count = len(problem.motions)
    states, emissions = np.zeros(count, dtype=int), np.zeros(count, dtype=int)
    for i, motion in enumerate(problem.motions):
        if motion.known is None and motion.span == "epoch":
            states[i] = sum(problem.dimension for name in state_names(i, count, motion.order) if name not in known)
    for i in problem.emitting:
        emissions[i] = emission_name(i, count) not in known
    return states, emissions


def _local_unknowns(problem: Problem, states: Array, emissions: Array) -> Array:
    """Return the number of local unknowns (...) that a present row depends on.

    `states` and `emissions` (targets,) are the results of `_sizes`; only some kinds depend on the emission time.
    """
    total = np.zeros(problem.batch_shape, dtype=int)
    if not states.any() and not emissions.any():
        return total
    target, emits = (np.concatenate(parts) for parts in _targets(problem))
    epoch, weight = problem.epoch, problem.weight
    for size, rows in ((states, target >= 0), (emissions, emits & (target >= 0))):
        own = np.flatnonzero(rows & (size[target] > 0))
        if not len(own):
            continue
        # Rows of one target in one epoch depend on the same unknowns.
        pair = target[own] * problem.epochs + epoch[own]
        order = np.argsort(pair, kind="stable")
        pairs, first = np.unique(pair[order], return_index=True)
        present = np.maximum.reduceat(weight[..., own[order]] > 0.0, first, axis=-1)
        total = total + present @ size[pairs // problem.epochs]
    return total


def _targets(problem: Problem) -> tuple[list[Array], list[Array]]:
    """Return, for each kind, the targets of its rows, and whether its rows contain the emission time."""
    targets = [np.asarray(rows.target) for rows in problem.rows]
    return targets, [np.full(rows.count, MODELS[rows.kind].emission) for rows in problem.rows]


@lru_cache(maxsize=512)
def largest(dof: int, probability: float) -> float:
    """Return the cost that noise exceeds with a given probability; infinite without redundancy."""
    return float(2.0 * gammainccinv(dof / 2, probability)) if dof > 0 else np.inf
