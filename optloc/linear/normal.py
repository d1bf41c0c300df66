"""Normal equations of a problem linearised at a point: one block for shared unknowns, and one block for each epoch.

The matrix has the shape of an arrow: local unknowns of different epochs are coupled only by shared unknowns, or by
walks. Letters: n shared unknowns, l local unknowns of each of k epochs, m rows, s stations, d coordinates. A *group*
contains r rows whose noise may be correlated; g groups have the same r.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from optloc.base import linalg
from optloc.base.arrays import as_array_like, as_number, eye, gather, library
from optloc.base.types import Array, Rows
from optloc.linear import chain
from optloc.linear.evaluate import differentiate
from optloc.linear.fences import fence_terms
from optloc.linear.walks import chain_at, walks
from optloc.models import MODELS
from optloc.problem.forms import form_of
from optloc.problem.noise import Block, Noise, Whitener, arrivals, gathered, group_members, whiten
from optloc.problem.problem import Problem

# Station errors of span "noise" are independent in each epoch and not estimated. They enlarge the noise of the rows.


def with_station_noise(problem: Problem, x: Array | None = None) -> Problem:
    """Return the problem with its station errors of span "noise" moved into the noise of its rows.

    The covariance of the rows of an epoch becomes R = Q + G P G'. G is the derivative of the rows with respect to the
    station positions, and P the covariance of their errors. The result is the same as if the errors were unknowns of
    each epoch and were eliminated from the normal equations. If P is isotropic and the rows combine ranges, G P G' does
    not depend on the position of the target. A station error is then equivalent to an arrival error of the same size.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    x : array (..., size), optional
        Vectors at which G is computed. None: all errors are treated as isotropic, for rows that combine ranges.

    Returns
    -------
    Problem
        Without station errors; the same problem if their span is not "noise".
    """
    stations = problem.stations
    if not stations.weighed:
        return problem
    groups = _groups(problem)
    if x is None or not depends_on_place(problem):
        # Ranges do not depend on velocities.
        nothing = np.zeros((stations.count, problem.dimension, problem.dimension))
        covariance = nothing if stations.covariance is None else stations.covariance
        more = [_isotropic_covariance(problem, members, covariance) for members in groups]
    else:
        # G is the Jacobian with respect to station errors as unknowns, which are the last of the local ones.
        named, x = with_offsets(problem, x, np.zeros(()))
        _, jacobian = differentiate(named, x)
        parts = np.split(jacobian[..., -offsets_of(problem) :], len(stations.errors), axis=-1)
        more = [_propagate_all(parts, members, problem) for members in groups]
    blocks = [
        Block(members, gathered(problem.noise, members) + extra) for members, extra in zip(groups, more, strict=True)
    ]
    exact_ones = replace(stations, covariance=None, velocity_covariance=None)
    return replace(problem, stations=exact_ones, noise=Noise(tuple(blocks)))


def depends_on_place(problem: Problem) -> bool:
    """Return whether the noise that station errors of span "noise" add depends on the position of the target."""
    if not problem.stations.weighed:
        return False
    # Isotropic errors project to the same range variance along every line of sight.
    return not problem.stations.isotropic or any(MODELS[rows.kind].ranges is None for rows in problem.rows)


def whitener_at(problem: Problem, x: Array) -> tuple[Whitener, ...]:
    """Return the whitening matrices of a problem's rows at vectors x, including station errors of span "noise"."""
    return whiten(with_station_noise(problem, x).noise, problem.weight)


def with_offsets(problem: Problem, x: Array, offsets: Array) -> tuple[Problem, Array]:
    """Return the problem with station errors of span "noise" as unknowns of each epoch, and vectors with their values.

    Parameters
    ----------
    problem : Problem
        k epochs, s stations, d dimensions.
    x : array (..., size)
        Parameter vectors of the problem.
    offsets : array (..., k, `offsets_of`) or ()
        Errors of the stations in the order of their slots: positions, metres; velocities, metres per second.
    """
    named = replace(problem, stations=replace(problem.stations, span="epoch"))
    shared, local = problem.layout.split(x)
    size = offsets_of(problem)
    batch = np.broadcast_shapes(x.shape[:-1], offsets.shape[:-2])
    more = np.broadcast_to(offsets, (*batch, problem.epochs, size))
    local = np.concatenate([np.broadcast_to(local, (*batch, *local.shape[-2:])), more], axis=-1)
    shared = np.broadcast_to(shared, (*batch, shared.shape[-1]))
    return named, np.concatenate([shared, local.reshape(*batch, -1)], axis=-1)


def offsets_of(problem: Problem) -> int:
    """Return the number of station errors in an epoch, of positions and of velocities together."""
    return len(problem.stations.errors) * problem.stations.count * problem.dimension


def _groups(problem: Problem) -> list[Array]:
    """Return the rows (g, r) that may be correlated: rows of one epoch, or all rows if noise correlates epochs."""
    epoch = problem.epoch
    if any((epoch[block.row] != epoch[block.row[:, :1]]).any() for block in problem.noise.blocks):
        return [np.arange(problem.count)[None]]
    return group_members(epoch)


def _isotropic_covariance(problem: Problem, members: Array, covariance: Array) -> Array:
    """Return the covariance (..., g, r, r) that isotropic station errors add to groups of rows `members` (g, r), m^2.

    `covariance` (..., s, d, d) belongs to the station positions. The errors have the effect of arrival errors with the
    variance of one axis.
    """
    # For isotropic errors, this is the variance of each axis; for others, the mean over all directions.
    variance = np.trace(covariance, axis1=-2, axis2=-1) / problem.dimension
    ends = []
    for place in (0, 1):
        station = np.concatenate([(rows.a, rows.b)[place] for rows in problem.rows])
        sign = np.concatenate([np.full(rows.count, _range_signs(rows)[place]) for rows in problem.rows])
        ends.append((station[members], sign[members]))
    return arrivals(ends, variance)


def _range_signs(rows: Rows) -> tuple[int, int]:
    """Return the coefficients of the ranges to both stations of rows; zeros if the kind has none."""
    return MODELS[rows.kind].ranges or (0, 0)


def _propagate_all(parts: Sequence[Array], members: Array, problem: Problem) -> Array:
    """Return the covariance (..., g, r, r) that all station errors add to groups of rows `members` (g, r).

    `parts` are the Jacobians (..., m, s * d) with respect to each sort of errors: positions, then velocities.
    """
    errors = problem.stations.errors
    added = [_propagate(part[..., members, :], c) for part, (_, _, c) in zip(parts, errors, strict=True)]
    return np.asarray(sum(added[1:], added[0]))


def _propagate(sensitivity: Array, covariance: Array) -> Array:
    """Return G P G' (..., g, r, r): the covariance that the errors of stations add to groups of rows.

    G is `sensitivity` (..., g, r, s * d), the derivative of the rows by the station coordinates. P is `covariance`
    (..., s, d, d) of each station.
    """
    s, d = covariance.shape[-3:-1]
    # Errors of stations are independent: P is applied station by station, without a matrix of s d by s d.
    own = sensitivity.reshape(*sensitivity.shape[:-1], s, d)
    spread = np.einsum("...grsd,...sde->...grse", own, covariance).reshape(sensitivity.shape)
    return np.asarray(spread @ np.swapaxes(sensitivity, -1, -2))


# The linearisation: residual and Jacobian of a problem at a point.


@dataclass(frozen=True, slots=True)
class Linear:
    """A problem linearised at a point.

    Parameters
    ----------
    residual : array (..., m)
        Measured minus predicted, z - h(x); angles are wrapped.
    shared : array (..., m, n)
        Derivative of h with respect to the shared unknowns.
    local : array (..., m, l)
        Derivative of h with respect to the local unknowns of the row's epoch.
    epoch : int array (m,)
        Epoch of each row.
    noise : tuple of Whitener
        Whitening matrices of the noise blocks.
    """

    residual: Array
    shared: Array
    local: Array
    epoch: Array
    noise: tuple[Whitener, ...]


def linearise(problem: Problem, x: Array, noise: tuple[Whitener, ...] | None = None) -> Linear:
    """Return residual, Jacobian and noise of a problem at a point.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    x : array (..., size)
        Parameter vectors, ordered by ``problem.layout``.
    noise : tuple of Whitener, optional
        Whitening matrices; by default computed from the problem, with station errors of span "noise" at `x`.

    Returns
    -------
    Linear
        With leading axes (...).
    """
    residual, jacobian = differentiate(problem, x)
    n = problem.layout.n_shared
    return Linear(
        residual,
        jacobian[..., :n],
        jacobian[..., n:],
        problem.epoch,
        whitener_at(problem, x) if noise is None else noise,
    )


# Sums of information, and results from them: elimination of local unknowns, steps, covariances.

OPEN = 1e-12
"""Share of its information below which an epoch of a run leaves a combination of its local unknowns undetermined.

The value is far above rounding. The elimination subtracts a term of this combination from the shared unknowns, so that
its digits must not be noise."""


@dataclass(frozen=True, slots=True)
class Normal:
    """Information about shared and local unknowns.

    Parameters
    ----------
    shared : array (..., n, n)
        Information of the shared unknowns.
    local : array (..., k, l, l)
        Information of the local unknowns of each epoch.
    cross : array (..., k, n, l)
        Coupling of shared and local unknowns.
    shared_vector : array (..., n)
        Right side of the shared unknowns.
    local_vector : array (..., k, l)
        Right side of the local unknowns.
    cost : array (...)
        Weighted sum of squared residuals, without a factor 1/2.
    link : array (..., k - 1, l, l), optional
        Coupling of the local unknowns of each epoch with those of the next, which comes from walks.
    """

    shared: Array
    local: Array
    cross: Array
    shared_vector: Array
    local_vector: Array
    cost: Array
    link: Array | None = None

    @property
    def parts(self) -> tuple[Array, ...]:
        """Return the arrays of all fields, in their order; `link` is left out if it is None."""
        own = (self.shared, self.local, self.cross, self.shared_vector, self.local_vector, self.cost)
        return own if self.link is None else (*own, self.link)

    def __add__(self, other: Normal) -> Normal:
        """Return the sum of the information of disjoint epochs.

        Shared parts are added, local parts are concatenated.
        """
        return total([self, other])


def total(parts: Sequence[Normal]) -> Normal:
    """Return the sum of the information of disjoint ranges of epochs, before priors; local parts are concatenated."""
    first = parts[0]
    if len(parts) == 1:
        return first
    shared, vector, cost = (sum(getattr(p, name) for p in parts) for name in ("shared", "shared_vector", "cost"))
    # Without local unknowns nothing is concatenated: the empty blocks do not change.
    if first.local.shape[-1] == 0:
        return Normal(shared, first.local, first.cross, vector, first.local_vector, cost)
    local, cross = (np.concatenate([getattr(p, name) for p in parts], axis=-3) for name in ("local", "cross"))
    return Normal(shared, local, cross, vector, np.concatenate([p.local_vector for p in parts], axis=-2), cost)


def normal(linear: Linear, epochs: int) -> Normal:
    """Return the normal equations of a linearised problem: information, right side and cost.

    The information is J' W J and the right side J' W residual, with the Jacobian J and the inverse noise covariance W.
    Priors are not included, see `with_priors`.

    Parameters
    ----------
    linear : Linear
        Residual, Jacobian and whitening matrices of the noise.
    epochs : int
        Number of epochs k. Without local unknowns, the result has one empty block for all epochs.
    """
    n, length, xp = linear.shared.shape[-1], linear.local.shape[-1], library(linear.residual)
    # Jacobian and residual as one matrix, whose Gram matrix contains information, right side and cost.
    stacked = xp.concat([linear.shared, linear.local, linear.residual[..., None]], axis=-1)
    single = epochs == 1 or length == 0
    gram: Any = as_array_like(np.zeros(()), linear.residual)
    for whitener in linear.noise:
        white = whitener.apply(stacked)
        if not single:
            white = _by_epoch(white, linear.epoch[whitener.row].reshape(-1), epochs)
        gram = gram + (white.mT @ white if not single else (white.mT @ white)[..., None, :, :])
    last = n + length
    flat = gram[..., 0, :, :] if single else xp.sum(gram, axis=-3)
    # Without local unknowns, one empty block represents all epochs.
    k = epochs if length else 1
    batch = flat.shape[:-2]
    return Normal(
        flat[..., :n, :n],
        xp.broadcast_to(gram[..., n:last, n:last], (*batch, k, length, length)),
        xp.broadcast_to(gram[..., :n, n:last], (*batch, k, n, length)),
        flat[..., :n, last],
        xp.broadcast_to(gram[..., n:last, last], (*batch, k, length)),
        flat[..., last, last],
    )


def _by_epoch(white: Any, epoch: Array, epochs: int) -> Any:
    """Return the rows (..., m, p) sorted by epoch, (..., k, r, p); r is the greatest number of rows of an epoch.

    `epoch` (m,) is the epoch of each row. Rows beyond the number of rows of an epoch are zero.
    """
    # All epochs have the same length in the array: shorter ones are filled with zeros, which add nothing.
    order = np.argsort(epoch, kind="stable")
    sizes = np.bincount(epoch, minlength=epochs)
    most = max(1, int(sizes.max(initial=0)))
    slot = np.arange(most)
    used = slot < sizes[:, None]
    table = order[np.where(used, (np.cumsum(sizes) - sizes)[:, None] + slot, 0)]
    rows = gather(white, table, -2)
    return rows if used.all() else rows * as_array_like(1.0 * used, white)[..., None]


def marginal(equations: Normal) -> tuple[Array, Array, Array]:
    """Return information (..., n, n) and right side (..., n) of the shared unknowns without the local ones, and ok.

    The function computes the Schur complement of each epoch. If one of several epochs leaves some of its local unknowns
    undetermined, its information about the shared unknowns is still used. `ok` (...) is False if the only epoch leaves
    local unknowns undetermined.
    """
    return _eliminate(equations)[:3]


def _eliminate(equations: Normal) -> tuple[Array, Array, Array, Array]:
    """Return the results of `marginal`, and the solutions (..., k, l, n + 1) of the local systems.

    The solutions contain the coupling (n columns), then the right side.
    """
    xp = library(equations.cost)
    right = xp.concat([equations.cross.mT, equations.local_vector[..., None]], axis=-1)
    if equations.local.shape[-1] == 0:
        return equations.shared, equations.shared_vector, xp.ones_like(equations.cost, dtype=xp.bool), right
    # One solution for coupling and vector together.
    solved, ok = _solve_local(equations, right)
    # One product over all epochs: separate products would store n^2 numbers for each epoch.
    lost = _joined(equations.cross.mT).mT @ _joined(solved)
    return equations.shared - lost[..., :-1], equations.shared_vector - lost[..., -1], ok, solved


def _joined(blocks: Array) -> Array:
    """Return blocks (..., k, l, p) of epochs as one matrix (..., k l, p)."""
    *batch, k, size, p = blocks.shape
    joined: Array = library(blocks).reshape(blocks, (*batch, k * size, p))
    return joined


def eliminated(equations: Normal) -> Normal:
    """Return the normal equations of the shared unknowns only; the local ones take the values that fit best."""
    information, vector, _, held = _eliminate(equations)
    cost = equations.cost
    if equations.local.shape[-1]:
        cost = cost - (held[..., -1] * equations.local_vector).sum((-1, -2))
    none = np.zeros((*cost.shape, 1, 0))
    return Normal(information, none[..., None], np.zeros((*cost.shape, 1, vector.shape[-1], 0)), vector, none, cost)


def _solve_local(equations: Normal, right: Array) -> tuple[Array, Array]:
    """Return the solutions (..., k, l, p) of the local systems for right sides of this shape, and ok (...).

    The solution has the least norm if a system is singular. `ok` is False if the only epoch leaves unknowns
    undetermined.
    """
    local, xp = equations.local, library(equations.local)
    if equations.link is not None:
        return chain.solve(_fix_unused(local), equations.link, right)
    # If a single epoch leaves its local unknowns undetermined, so is the fix; the caller handles this case.
    if local.shape[-3] == 1:
        solved, good = linalg.solve(_fix_unused(local), right)
        return solved, xp.all(good, axis=-1)
    solved, good = linalg.solve(local, right, OPEN)
    # In a run, an epoch may leave a combination undetermined (one arrival, unknown emission time). The least norm moves
    # only the determined part.
    if xp is np and not good.all():
        root, _ = linalg.root(local[~good])
        solved[~good] = root @ (root.mT @ np.broadcast_to(right, solved.shape)[~good])
    elif xp is not np:
        root, _ = linalg.root(local)
        solved = xp.where(good[..., None, None], solved, root @ (root.mT @ right))
    return solved, xp.ones_like(solved[..., 0, 0, 0], dtype=xp.bool)


def _fix_unused(local: Array) -> Array:
    """Return local blocks with 1 on the diagonal for unknowns without rows, so that their step is zero."""
    dead = library(local).linalg.diagonal(local) == 0.0
    grown: Array = local + as_number(dead, local)[..., None] * eye(local.shape[-1], local)
    return grown


def local_covariance(equations: Normal, shared: Array, size: int) -> Array:
    """Return the covariance (..., k, size, size) of the first local unknowns of each epoch; NaN if not determined.

    Parameters
    ----------
    equations : Normal
        Normal equations at the estimate.
    shared : array (..., n, n)
        Covariance of the shared unknowns.
    size : int
        Number of local unknowns in the result.
    """
    if equations.link is None:
        inverse, good = linalg.inverse(equations.local, OPEN)
        gain = inverse @ np.swapaxes(equations.cross, -1, -2)
    else:
        held = _fix_unused(equations.local)
        inverse, whole = chain.inverse_blocks(held, equations.link)
        gain, _ = chain.solve(held, equations.link, equations.cross.mT)
        # an epoch may still leave some of its other local unknowns undetermined
        good = whole[..., None] & linalg.solve(held, np.zeros((*held.shape[:-1], 0)), OPEN)[1]
    # The errors of the local unknowns, plus errors that come from the shared unknowns.
    full = inverse + gain @ shared[..., None, :, :] @ np.swapaxes(gain, -1, -2)
    return np.where(good[..., None, None], full, np.nan)[..., :size, :size]


def step(equations: Normal, damping: Array, along: Array | None = None) -> tuple[Array, Array]:
    """Return the damped step (..., size) of the full parameter vector, and whether it exists (...).

    Parameters
    ----------
    equations : Normal
        Information and right side.
    damping : array (...)
        Marquardt's factor: the diagonal of the information is multiplied by ``1 + damping``.
    along : array (..., n, q), optional
        Basis for the shared part of the step, for instance of the tangent space of equalities. None: all unknowns move.
    """
    damped = _damp(equations, damping)
    information, vector, ok, held = _eliminate(damped)
    if equations.link is not None:
        # Walks follow the shared unknowns, so that the rows have little information about these unknowns. This
        # information is damped.
        information = _scale_diagonal(information, damping)
    if along is not None:
        shared, good = linalg.solve_within(information, vector, along)
        ok = ok & good
    elif information.shape[-1]:
        shared, good = linalg.solve(information, vector[..., None])
        shared, ok = shared[..., 0], ok & good
    else:
        shared = vector
    if damped.local.shape[-1] == 0:
        return shared, ok
    # Back substitution: the step of the epoch for fixed shared unknowns, less its change by the shared step.
    local, xp = held[..., -1] - (held[..., :-1] @ shared[..., None, :, None])[..., 0], library(held)
    flat = xp.reshape(local, (*local.shape[:-2], -1))
    return xp.concat([shared, flat], axis=-1), ok


def _damp(equations: Normal, damping: Array) -> Normal:
    """Return normal equations with the diagonal times 1 + damping; the local unknowns of walks are not damped."""
    local = _scale_diagonal(equations.local, damping[..., None])
    if equations.link is None:
        return replace(equations, shared=_scale_diagonal(equations.shared, damping), local=local)
    # Walks are linear. Their steps have a high precision compared with the rows, and damping would keep them from
    # moving.
    walking = np.diagonal(equations.link, axis1=-2, axis2=-1).any(tuple(range(equations.link.ndim - 2)))
    return replace(equations, local=np.where(walking, equations.local, local))


def _scale_diagonal(matrix: Array, factor: Array) -> Array:
    """Return a matrix with its diagonal times (1 + factor): Marquardt's scaling is independent of units."""
    grown: Array = matrix * (1.0 + factor[..., None, None] * eye(matrix.shape[-1], matrix))
    return grown


def covariance(equations: Normal) -> tuple[Array, Array]:
    """Return the covariance (..., n, n) of the shared unknowns, NaN if singular, and whether it exists (...)."""
    information, _, ok = marginal(equations)
    inverse, good = linalg.inverse(information)
    xp = library(inverse)
    return xp.where((ok & good)[..., None, None], inverse, xp.nan), ok & good


def decrement(equations: Normal, move: Array, layout_n: int) -> Array:
    """Return the squared length (...) of a step in standard deviations; `layout_n` unknowns of it are shared."""
    shared = move[..., :layout_n]
    local = move[..., layout_n:].reshape(*equations.local_vector.shape)
    return np.asarray((shared * equations.shared_vector).sum(-1) + (local * equations.local_vector).sum((-1, -2)))


# Gaussian priors of named unknowns, as information.


def with_priors(problem: Problem, x: Array, equations: Normal, *, shared: bool = True, local: bool = True) -> Normal:
    """Return normal equations with the Gaussian priors and the fences of a problem added.

    Parameters
    ----------
    problem : Problem
        Priors on named unknowns, biases and station positions; and fences.
    x : array (..., size)
        Vectors at which the problem was linearised.
    equations : Normal
        Normal equations of the measurements.
    shared, local : bool
        Whether to add the priors of shared unknowns, and the priors of local unknowns.
    """
    layout = problem.layout
    terms: list[tuple[str, Any]] = [
        (name, partial(_gaussian, as_array_like(mean, x), as_array_like(precision, x)))
        for name, mean, precision in prior_parts(problem)
    ]
    terms += [(fence.name, fence) for fence in fence_terms(problem, x)]
    if local and walks(problem):
        equations = _with_walks(problem, x, equations)
    (at_shared, at_local), xp = layout.split(x), library(x)
    matrix, vector, cost = equations.shared, equations.shared_vector, equations.cost
    blocks, local_vector = equations.local, equations.local_vector
    for name, term in terms:
        slot, is_shared = layout.find(name)
        if not (shared if is_shared else local):
            continue
        width = layout.n_shared if is_shared else layout.n_local
        # A product with columns of the unit matrix places a block: some libraries cannot write into an array.
        part = slice(slot.start, slot.start + slot.size)
        pick = as_array_like(np.eye(width)[:, part], x)
        precision, pull, penalty = term((at_shared if is_shared else at_local)[..., part])
        block, right = pick @ precision @ pick.mT, (pick @ pull[..., None])[..., 0]
        if is_shared:
            matrix, vector, cost = matrix + block, vector + right, cost + penalty
        else:
            blocks, local_vector = blocks + block, local_vector + right
            cost = cost + xp.sum(penalty, axis=-1)
    return Normal(matrix, blocks, equations.cross, vector, local_vector, cost, equations.link)


def _gaussian(mean: Any, precision: Any, value: Any) -> tuple[Any, Any, Any]:
    """Return precision, pull (..., q) and penalty (...) of a Gaussian prior at values (..., q) of its unknown."""
    pull = (precision @ (mean - value)[..., None])[..., 0]
    return precision, pull, library(value).sum((mean - value) * pull, axis=-1)


def _with_walks(problem: Problem, x: Array, equations: Normal) -> Normal:
    """Return normal equations with the information of the walks about successive epochs added."""
    walked = chain_at(problem, x)
    link = np.broadcast_to(walked.link, (*equations.cost.shape, *walked.link.shape))
    return replace(
        equations,
        local=equations.local + walked.block,
        local_vector=equations.local_vector + walked.vector,
        cost=equations.cost + walked.cost,
        link=link,
    )


def prior_parts(problem: Problem) -> list[tuple[str, Array, Array]]:
    """Return (name, mean, precision) of every prior except walks; local ones have an epoch axis of length one.

    The precision is the inverse covariance.
    """
    parts, layout = [], problem.layout
    for prior in problem.priors:
        precision, _ = linalg.inverse(prior.covariance)
        _, is_shared = layout.find(prior.name)
        mean = prior.mean if is_shared else prior.mean[..., None, :]
        parts.append((prior.name, mean, precision if is_shared else precision[..., None, :, :]))
    for bias in problem.biases:
        # priors of walks couple epochs, see `chain_at`
        if bias.sigma is not None and form_of(bias).steps is None:
            sigma = np.ravel(bias.sigma)
            # Members of a bias are independent of each other a priori.
            parts.append((bias.name, np.broadcast_to(np.ravel(bias.mean), sigma.shape), np.diag(sigma**-2.0)))
    stations = problem.stations
    for name, _, covariance in stations.errors if stations.unknown_for else ():
        precision = linalg.block_diagonal(linalg.inverse(covariance)[0])
        if stations.unknown_for == "epoch":
            precision = precision[..., None, :, :]
        parts.append((name, np.zeros(precision.shape[-1]), precision))
    return parts
