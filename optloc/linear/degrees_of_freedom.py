"""Degrees of freedom: what the rows say more than the unknowns need."""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.linear.constraints import exact
from optloc.problem.epochs import windows
from optloc.problem.noise import whiten
from optloc.problem.problem import Problem


def degrees_of_freedom(problem: Problem) -> Array:
    """Return rows present (the rank of their noise) less unknowns without a prior, (N,)."""
    rank: Any = np.zeros(problem.batch_shape, dtype=int)
    heard: Any = 0
    for _, _, part in windows(problem, len(problem.weight) if problem.weight.ndim > 1 else 1):
        for whitener in whiten(part.noise, part.weight):
            # One matrix may stand for all groups; a whitener has as many rows that are not zero as its covariance has
            # rank.
            same = len(whitener.row) if whitener.matrix.shape[-3] == 1 else 1
            rank = rank + same * (whitener.matrix != 0.0).any(-1).sum((-1, -2))
        heard = heard + _heard(part)
    # What has a prior brings a row of its own, and counts for nothing.
    known = (
        {prior.name for prior in problem.priors}
        | {b.name for b in problem.biases if b.sigma is not None}
        | {"stations"}
    )
    layout = problem.layout
    unknowns: Any = sum(slot.size for slot in layout.shared if slot.name not in known)
    unknowns = unknowns + heard * sum(slot.size for slot in layout.local if slot.name not in known)
    return np.broadcast_to(rank - unknowns + len(exact(problem)), problem.batch_shape).astype(np.int32)


def _heard(problem: Problem) -> Array:
    """Return the number of epochs with a row that is present, (...)."""
    # Local unknowns of an epoch without a row are no unknowns of these data.
    order = np.argsort(problem.epoch, kind="stable")
    _, first = np.unique(problem.epoch[order], return_index=True)
    return np.asarray(np.maximum.reduceat(problem.weight[..., order] > 0.0, first, axis=-1).sum(-1))
