"""A problem linearised at a point: normal equations shaped like an arrow, one block shared and one for each epoch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optloc.base import linalg
from optloc.base.arrays import as_array_like, as_number, eye, gather, library
from optloc.base.types import Array, Rows
from optloc.linear import chain
from optloc.linear.evaluate import differentiate
from optloc.linear.walks import chain_at, walks
from optloc.models import MODELS
from optloc.problem.forms import form_of
from optloc.problem.noise import Block, Noise, Whitener, arrivals, gathered, group_members, whiten
from optloc.problem.problem import Problem

# Station errors that are drawn anew at each epoch and not estimated: they enlarge the noise of the rows.


def with_station_noise(problem: Problem, x: Array | None = None) -> Problem:
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
    stations = problem.stations
    if not stations.weighed:
        return problem
    groups = _groups(problem)
    if x is None or not depends_on_place(problem):
        # Ranges depend on positions alone.
        nothing = np.zeros((stations.count, problem.dimension, problem.dimension))
        covariance = nothing if stations.covariance is None else stations.covariance
        more = [_alike(problem, members, covariance) for members in groups]
    else:
        # G is the Jacobian to station errors as if they were unknowns; they stand last among the local ones.
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
    """Return whether what station errors of span "noise" add to the noise depends on where the target is."""
    if not problem.stations.weighed:
        return False
    # Isotropic errors of ranges project to the same variance along every line of sight.
    return not problem.stations.isotropic or any(MODELS[rows.kind].ranges is None for rows in problem.rows)


def whitener_at(problem: Problem, x: Array) -> tuple[Whitener, ...]:
    """Return the whitening matrices of a problem's rows, station errors of span "noise" included, at vectors x."""
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
    """Return how many errors the stations have at an epoch, those of positions and of velocities together."""
    return len(problem.stations.errors) * problem.stations.count * problem.dimension


def _groups(problem: Problem) -> list[Array]:
    """Return the rows (g, r) that may be correlated: those of one epoch, or all where noise ties the epochs."""
    epoch = problem.epoch
    if any((epoch[block.row] != epoch[block.row[:, :1]]).any() for block in problem.noise.blocks):
        return [np.arange(problem.count)[None]]
    return group_members(epoch)


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


def _propagate_all(parts: Sequence[Array], members: Array, problem: Problem) -> Array:
    """Return what station errors of all sorts add to groups of rows (g, r), of Jacobians (..., m, s * d) to each."""
    errors = problem.stations.errors
    added = [_propagate(part[..., members, :], c) for part, (_, _, c) in zip(parts, errors, strict=True)]
    return np.asarray(sum(added[1:], added[0]))


def _propagate(sensitivity: Array, covariance: Array) -> Array:
    """Return G P G' (..., g, r, r) of derivatives G (..., g, r, s * d) and station covariances P (..., s, d, d)."""
    s, d = covariance.shape[-3:-1]
    # Stations err independently: P is applied station by station, never as one s d by s d matrix.
    own = sensitivity.reshape(*sensitivity.shape[:-1], s, d)
    spread = np.einsum("...grsd,...sde->...grse", own, covariance).reshape(sensitivity.shape)
    return np.asarray(spread @ np.swapaxes(sensitivity, -1, -2))


# One linearisation for everything: residual and Jacobian of a problem at a point.


@dataclass(frozen=True, slots=True)
class Linear:
    """A problem linearised at a point.

    Parameters
    ----------
    residual : array (..., m)
        Measured less modelled, z - h(x); angles wrapped.
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
        Whitening matrices made before; None: made from the problem, station errors of span "noise" at `x` included.

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


# Sums of information, and what is read off them: local unknowns eliminated, steps, covariances.

OPEN = 1e-12
"""Share of its information below which an epoch of a run leaves a combination of its own unknowns open.

Far above rounding: sums over epochs subtract what such a combination takes from the shared unknowns, so that its digits
must not be noise.
"""


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
        Coupling.
    shared_vector : array (..., n)
        Right-hand side of the shared unknowns.
    local_vector : array (..., k, l)
        Right-hand side of the local unknowns.
    cost : array (...)
        Weighted sum of squared residuals, without a factor 1/2.
    link : array (..., k - 1, l, l), optional
        Coupling of the local unknowns of each epoch with those of the next: of walks, which priors bring.
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
        """Return its arrays, in their order."""
        own = (self.shared, self.local, self.cross, self.shared_vector, self.local_vector, self.cost)
        return own if self.link is None else (*own, self.link)

    def __add__(self, other: Normal) -> Normal:
        """Return the sum of the information of disjoint epochs: shared parts add, local parts are joined."""
        return total([self, other])


def total(parts: Sequence[Normal]) -> Normal:
    """Return the sum of the information of disjoint stretches of epochs, before priors: local parts are joined once."""
    first = parts[0]
    if len(parts) == 1:
        return first
    shared, vector, cost = (sum(getattr(p, name) for p in parts) for name in ("shared", "shared_vector", "cost"))
    # Without local unknowns nothing is joined: blocks of length zero stay as they are.
    if first.local.shape[-1] == 0:
        return Normal(shared, first.local, first.cross, vector, first.local_vector, cost)
    local, cross = (np.concatenate([getattr(p, name) for p in parts], axis=-3) for name in ("local", "cross"))
    return Normal(shared, local, cross, vector, np.concatenate([p.local_vector for p in parts], axis=-2), cost)


def normal(linear: Linear, epochs: int) -> Normal:
    """Return the normal equations of a linearised problem.

    Parameters
    ----------
    linear : Linear
        Residual, Jacobian, noise.
    epochs : int
        Number of epochs k.
    """
    n, length, xp = linear.shared.shape[-1], linear.local.shape[-1], library(linear.residual)
    # Jacobian and residual as one matrix: its Gram matrix holds information, vector and cost.
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
    # Without local unknowns one empty block stands for all epochs.
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
    """Return the rows (..., m, p) of each epoch (..., k, r, p), zero beyond its own number of rows."""
    # Epochs of equal length in one array: rows of shorter ones are filled up with zeros, which add nothing.
    order = np.argsort(epoch, kind="stable")
    sizes = np.bincount(epoch, minlength=epochs)
    most = max(1, int(sizes.max(initial=0)))
    slot = np.arange(most)
    used = slot < sizes[:, None]
    table = order[np.where(used, (np.cumsum(sizes) - sizes)[:, None] + slot, 0)]
    rows = gather(white, table, -2)
    return rows if used.all() else rows * as_array_like(1.0 * used, white)[..., None]


def marginal(equations: Normal) -> tuple[Array, Array, Array]:
    """Return information (..., n, n) and vector (..., n) of the shared unknowns with the local ones eliminated, and ok.

    Schur complement epoch by epoch. Of several epochs one may leave some of its own unknowns open: what it says about
    the shared ones counts all the same. `ok` (...) is False where the only epoch does so.
    """
    return _eliminate(equations)[:3]


def _eliminate(equations: Normal) -> tuple[Array, Array, Array, Array]:
    """Return what `marginal` does, and the solutions (..., k, l, n + 1) of the local systems: coupling, then vector."""
    xp = library(equations.cost)
    right = xp.concat([equations.cross.mT, equations.local_vector[..., None]], axis=-1)
    if equations.local.shape[-1] == 0:
        return equations.shared, equations.shared_vector, xp.ones_like(equations.cost, dtype=xp.bool), right
    # Coupling and vector are solved for at once.
    solved, ok = _solve_local(equations, right)
    # One product over all epochs: their own products would take the square of the shared unknowns for each of them.
    lost = _joined(equations.cross.mT).mT @ _joined(solved)
    return equations.shared - lost[..., :-1], equations.shared_vector - lost[..., -1], ok, solved


def _joined(blocks: Array) -> Array:
    """Return blocks (..., k, l, p) of epochs as one matrix (..., k l, p)."""
    *batch, k, size, p = blocks.shape
    joined: Array = library(blocks).reshape(blocks, (*batch, k * size, p))
    return joined


def eliminated(equations: Normal) -> Normal:
    """Return the information about the shared unknowns alone: local ones take the values that fit best."""
    information, vector, _, held = _eliminate(equations)
    cost = equations.cost
    if equations.local.shape[-1]:
        cost = cost - (held[..., -1] * equations.local_vector).sum((-1, -2))
    none = np.zeros((*cost.shape, 1, 0))
    return Normal(information, none[..., None], np.zeros((*cost.shape, 1, vector.shape[-1], 0)), vector, none, cost)


def _solve_local(equations: Normal, right: Array) -> tuple[Array, Array]:
    """Return solutions (..., k, l, p) of the local systems, of least norm where they are singular, and ok (...)."""
    local, xp = equations.local, library(equations.local)
    if equations.link is not None:
        return chain.solve(_hold_untouched(local), equations.link, right)
    # A single epoch that leaves its own unknowns open leaves the fix open: that is for the caller to see.
    if local.shape[-3] == 1:
        solved, good = linalg.solve(_hold_untouched(local), right)
        return solved, xp.all(good, axis=-1)
    solved, good = linalg.solve(local, right, OPEN)
    # Of a run, an epoch may leave a combination open (one arrival, no emission time): least norm moves only what it
    # knows.
    if xp is np and not good.all():
        root, _ = linalg.root(local[~good])
        solved[~good] = root @ (root.mT @ np.broadcast_to(right, solved.shape)[~good])
    elif xp is not np:
        root, _ = linalg.root(local)
        solved = xp.where(good[..., None, None], solved, root @ (root.mT @ right))
    return solved, xp.ones_like(solved[..., 0, 0, 0], dtype=xp.bool)


def _hold_untouched(local: Array) -> Array:
    """Return local blocks with a one for every unknown that no row touches: it stays where it is and hides no other."""
    dead = library(local).linalg.diagonal(local) == 0.0
    grown: Array = local + as_number(dead, local)[..., None] * eye(local.shape[-1], local)
    return grown


def local_covariance(equations: Normal, shared: Array, size: int) -> Array:
    """Return the covariance (..., k, size, size) of the first local unknowns of each epoch; NaN where they are open.

    Parameters
    ----------
    equations : Normal
        Normal equations at an answer.
    shared : array (..., n, n)
        Covariance of the shared unknowns there.
    size : int
        How many of the local unknowns are wanted.
    """
    if equations.link is None:
        inverse, good = linalg.inverse(equations.local, OPEN)
        gain = inverse @ np.swapaxes(equations.cross, -1, -2)
    else:
        held = _hold_untouched(equations.local)
        inverse, whole = chain.inverse_blocks(held, equations.link)
        gain, _ = chain.solve(held, equations.link, equations.cross.mT)
        # of states of their own, an epoch may leave some open all the same
        good = whole[..., None] & linalg.solve(held, np.zeros((*held.shape[:-1], 0)), OPEN)[1]
    # Own errors, and those that come from the shared unknowns.
    full = inverse + gain @ shared[..., None, :, :] @ np.swapaxes(gain, -1, -2)
    return np.where(good[..., None, None], full, np.nan)[..., :size, :size]


def step(equations: Normal, damping: Array, along: Array | None = None) -> tuple[Array, Array]:
    """Return the damped step (..., size) of the full parameter vector, and where it exists (...).

    Parameters
    ----------
    equations : Normal
        Information and right-hand side.
    damping : array (...)
        Marquardt's factor: the diagonal of the information is multiplied by ``1 + damping``.
    along : array (..., n, q), optional
        Basis of the shared part of the step, for instance of the tangent space of equalities; None: all unknowns move.
    """
    damped = _damp(equations, damping)
    information, vector, ok, held = _eliminate(damped)
    if equations.link is not None:
        # Beside walks, which follow whatever is shared, little of what rows say of it is left: that is what is scaled.
        information = _grow(information, damping)
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
    # Back substitution: what an epoch does by itself, less what the shared step takes from it.
    local, xp = held[..., -1] - (held[..., :-1] @ shared[..., None, :, None])[..., 0], library(held)
    flat = xp.reshape(local, (*local.shape[:-2], -1))
    return xp.concat([shared, flat], axis=-1), ok


def _damp(equations: Normal, damping: Array) -> Normal:
    local = _grow(equations.local, damping[..., None])
    if equations.link is None:
        return replace(equations, shared=_grow(equations.shared, damping), local=local)
    # Walks enter linearly, and the precision of their steps beside that of the rows would hold them where they are.
    walking = np.diagonal(equations.link, axis1=-2, axis2=-1).any(tuple(range(equations.link.ndim - 2)))
    return replace(equations, local=np.where(walking, equations.local, local))


def _grow(matrix: Array, factor: Array) -> Array:
    """Return a matrix with its diagonal times (1 + factor): Marquardt's scaling knows no units."""
    grown: Array = matrix * (1.0 + factor[..., None, None] * eye(matrix.shape[-1], matrix))
    return grown


def covariance(equations: Normal) -> tuple[Array, Array]:
    """Return the covariance (..., n, n) of the shared unknowns, NaN where singular, and where it exists (...)."""
    information, _, ok = marginal(equations)
    inverse, good = linalg.inverse(information)
    xp = library(inverse)
    return xp.where((ok & good)[..., None, None], inverse, xp.nan), ok & good


def decrement(equations: Normal, move: Array, layout_n: int) -> Array:
    """Return the squared length of a step in units of its own standard deviations, (...)."""
    shared = move[..., :layout_n]
    local = move[..., layout_n:].reshape(*equations.local_vector.shape)
    return np.asarray((shared * equations.shared_vector).sum(-1) + (local * equations.local_vector).sum((-1, -2)))


# Gaussian prior knowledge of named unknowns, as information.


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
    if local and walks(problem):
        equations = _with_walks(problem, x, equations)
    if not parts:
        return equations
    (at_shared, at_local), xp = layout.split(x), library(x)
    matrix, vector, cost = equations.shared, equations.shared_vector, equations.cost
    blocks, local_vector = equations.local, equations.local_vector
    for name, mean, precision in parts:
        slot, is_shared = layout.find(name)
        width = layout.n_shared if is_shared else layout.n_local
        # Columns of the unit matrix put a block where it belongs: some libraries cannot write into an array.
        pick = as_array_like(np.eye(width)[:, slot.start : slot.start + slot.size], x)
        precision = as_array_like(precision, x)  # noqa: PLW2901  # the same numbers, elsewhere
        error = (
            as_array_like(mean, x) - (at_shared if is_shared else at_local)[..., slot.start : slot.start + slot.size]
        )
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
    return Normal(matrix, blocks, equations.cross, vector, local_vector, cost, equations.link)


def _with_walks(problem: Problem, x: Array, equations: Normal) -> Normal:
    """Return normal equations with what the walks say of neighbouring epochs."""
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
    """Return (name, mean, precision) of every prior but those of walks; local ones have an epoch axis of length one."""
    parts, layout = [], problem.layout
    for prior in problem.priors:
        precision, _ = linalg.inverse(prior.covariance)
        _, is_shared = layout.find(prior.name)
        mean = prior.mean if is_shared else prior.mean[..., None, :]
        parts.append((prior.name, mean, precision if is_shared else precision[..., None, :, :]))
    for bias in problem.biases:
        # what is known of walks ties epochs: `chain_at`
        if bias.sigma is not None and form_of(bias).steps is None:
            sigma = np.ravel(bias.sigma)
            # Members of a bias are independent of each other a priori.
            parts.append((bias.name, np.broadcast_to(np.ravel(bias.mean), sigma.shape), np.diag(sigma**-2.0)))
    stations = problem.stations
    for name, _, covariance in stations.errors if stations.unknown_for else ():
        precision = _block_diagonal(linalg.inverse(covariance)[0])
        if stations.unknown_for == "epoch":
            precision = precision[..., None, :, :]
        parts.append((name, np.zeros(precision.shape[-1]), precision))
    return parts


def _block_diagonal(blocks: Array) -> Array:
    s, d = blocks.shape[-3], blocks.shape[-1]
    apart = as_array_like(np.eye(s)[:, None, :, None], blocks) * blocks[..., :, :, None, :]
    whole: Array = library(blocks).reshape(apart, (*blocks.shape[:-3], s * d, s * d))
    return whole
