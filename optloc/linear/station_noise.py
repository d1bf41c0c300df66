"""Station errors that are drawn anew at each epoch and not estimated: they enlarge the noise of the rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base.types import Array, Rows
from optloc.linear.evaluate import differentiate
from optloc.models import MODELS
from optloc.problem.noise import Block, Noise, Whitener, arrivals, gathered, together, whiten
from optloc.problem.problem import Problem


def weighed(problem: Problem, x: Array | None = None) -> Problem:
    """Return the problem with its station errors of span "noise" moved into the noise of its rows.

    The covariance of the rows of an epoch becomes R = Q + G P G', with G the derivative of the rows with respect to
    the station positions and P the covariance of their errors: what is left when the errors are unknowns of each epoch
    and are eliminated from the normal equations. Where P is isotropic and the rows combine ranges, G P G' does not
    depend on the place of the target: a station error is then nothing but an arrival error of the same size.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    x : array (..., size), optional
        Where G is taken; None: as if all errors were isotropic, and only for rows that combine ranges.

    Returns
    -------
    Problem
        Without station errors; the same problem where their span is not "noise".
    """
    covariance = problem.stations.covariance
    if covariance is None or problem.stations.span != "noise":
        return problem
    groups = _groups(problem)
    if x is None or not depends_on_place(problem):
        more = [_alike(problem, members, covariance) for members in groups]
    else:
        # G is the Jacobian to station offsets as if they were unknowns; they stand last among the local ones.
        named, x = with_offsets(problem, x, np.zeros(()))
        _, jacobian = differentiate(named, x)
        last = covariance.shape[-3] * problem.dimension
        more = [_propagate(jacobian[..., members, -last:], covariance) for members in groups]
    blocks = [
        Block(members, gathered(problem.noise, members) + extra) for members, extra in zip(groups, more, strict=True)
    ]
    return replace(problem, stations=replace(problem.stations, covariance=None), noise=Noise(tuple(blocks)))


def depends_on_place(problem: Problem) -> bool:
    """Return whether what station errors of span "noise" add to the noise depends on where the target is."""
    covariance = problem.stations.covariance
    if covariance is None or problem.stations.span != "noise":
        return False
    # Isotropic errors of ranges project to the same variance along every line of sight.
    same = np.eye(problem.dimension) * covariance[..., :1, :1]
    return not np.array_equal(covariance, same) or any(MODELS[rows.kind].ranges is None for rows in problem.rows)


def whitener_at(problem: Problem, x: Array) -> tuple[Whitener, ...]:
    """Return the whitening matrices of a problem's rows, station errors of span "noise" included, at vectors x."""
    return whiten(weighed(problem, x).noise, problem.weight)


def with_offsets(problem: Problem, x: Array, offsets: Array) -> tuple[Problem, Array]:
    """Return the problem with station errors of span "noise" as unknowns of each epoch, and vectors with their values.

    Parameters
    ----------
    problem : Problem
        k epochs, s stations, d dimensions.
    x : array (..., size)
        Parameter vectors of the problem.
    offsets : array (..., k, s * d) or ()
        Errors of the station positions, metres.
    """
    named = replace(problem, stations=replace(problem.stations, span="epoch"))
    shared, local = problem.layout.split(x)
    size = problem.stations.count * problem.dimension
    batch = np.broadcast_shapes(x.shape[:-1], offsets.shape[:-2])
    more = np.broadcast_to(offsets, (*batch, problem.epochs, size))
    local = np.concatenate([np.broadcast_to(local, (*batch, *local.shape[-2:])), more], axis=-1)
    shared = np.broadcast_to(shared, (*batch, shared.shape[-1]))
    return named, np.concatenate([shared, local.reshape(*batch, -1)], axis=-1)


def _groups(problem: Problem) -> list[Array]:
    """Return the rows (g, r) that may be correlated: those of one epoch, or all where noise ties the epochs."""
    epoch = problem.epoch
    if any((epoch[block.row] != epoch[block.row[:, :1]]).any() for block in problem.noise.blocks):
        return [np.arange(problem.count)[None]]
    return together(epoch)


def _alike(problem: Problem, members: Array, covariance: Array) -> Array:
    """Return what isotropic errors add to groups of rows (g, r): arrival errors of the mean variance of an axis."""
    # Of isotropic errors this is the variance of each axis; of others it is their mean over all directions.
    variance = np.trace(covariance, axis1=-2, axis2=-1) / problem.dimension
    ends = []
    for place in (0, 1):
        station = np.concatenate([(rows.a, rows.b)[place] for rows in problem.rows])
        sign = np.concatenate([np.full(rows.count, _signs(rows)[place]) for rows in problem.rows])
        ends.append((station[members], sign[members]))
    return arrivals(ends, variance)


def _signs(rows: Rows) -> tuple[int, int]:
    return MODELS[rows.kind].ranges or (0, 0)


def _propagate(sensitivity: Array, covariance: Array) -> Array:
    """Return G P G' (..., g, r, r) of derivatives G (..., g, r, s * d) and station covariances P (..., s, d, d)."""
    s, d = covariance.shape[-3:-1]
    # Stations err independently: P is applied station by station, never as one s d by s d matrix.
    own = sensitivity.reshape(*sensitivity.shape[:-1], s, d)
    spread = np.einsum("...grsd,...sde->...grse", own, covariance).reshape(sensitivity.shape)
    return np.asarray(spread @ np.swapaxes(sensitivity, -1, -2))
