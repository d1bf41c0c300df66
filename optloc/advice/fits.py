"""Least-squares fits of many changes of one problem, as one batch.

E changes of K epochs are L = E K problems of one structure, so that they share one plan of the engine. The parameters
of a change are estimated by Gauss-Newton steps, with the other unknowns eliminated at every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.advice.change import Change, MisfitCase
from optloc.base import linalg
from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array
from optloc.kernels.sums import equations_at
from optloc.linear.equalities import Equalities
from optloc.linear.evaluate import predict
from optloc.linear.normal import Normal, linearise
from optloc.model_checks.score import descend, fit_anywhere
from optloc.problem.noise import Block, Noise
from optloc.problem.problem import Problem

# Largest number of steps of the parameters. Errors that are linear in the rows need two or three.
_STEPS = 8
# Fall of the cost below which the steps end; a thousandth of the difference that decides anything.
_DONE = 1e-3
# Share of the diagonal of an information matrix below which a parameter is undetermined: far above rounding.
_ROUNDING = 1e-9
# Number of descents of a search that go to the end, by their cost after a few steps: others end at the same positions.
_STARTS = 6
# Distance from the stations, in spreads, beyond which a position is only a direction.
_FAR = 1e4
# Distance from the centre of the Earth below which nothing is located, m: the deepest earthquakes are 700 km deep.
_DEPTH = 5.6e6


@dataclass(frozen=True, slots=True)
class Fits:
    """The fits of E changes.

    Parameters
    ----------
    x : array (E, K, size)
        Unknowns of the epochs.
    theta, sigma : array (E, q)
        Parameters and their standard deviations; zero beyond the parameters of a change.
    cost : array (E, K)
        Cost of each epoch; infinite if a position is not determined.
    """

    x: Array
    theta: Array
    sigma: Array
    cost: Array

    def take(self, items: Array) -> Fits:
        """Return the fits at these indices."""
        return Fits(self.x[items], self.theta[items], self.sigma[items], self.cost[items])


def changed(case: MisfitCase, changes: Sequence[Change], theta: Array) -> Problem:
    """Return the problems (L,) after the changes, with their parameters at `theta` (E, q).

    An error that scales the prediction h enters as values and noise divided by the scale: the whitened residual is the
    same.
    """
    base, count, k = case.base, len(changes), len(case.times)
    shape = (count, k, base.count)
    lanes = base.take(np.tile(np.arange(k), count))
    added, scale = np.zeros(shape), np.ones(shape)
    for e, change in enumerate(changes):
        for j, column in enumerate(change.columns):
            target = added if column.enters == "adds" else scale
            target[e] += theta[e, j] * column.coefficient

    def stacked(name: str) -> Array:
        out = np.empty(shape)
        for e, change in enumerate(changes):
            out[e] = getattr(change, name)
        return out

    factor, correction = stacked("factor"), np.broadcast_to(base.correction, shape[1:])
    observed = np.where(case.present, np.broadcast_to(base.z, shape[1:]), 0.0) - correction
    z = (stacked("shift") + factor * observed - added) / scale + correction
    weight = np.broadcast_to(base.weight, shape[1:]) * stacked("weight")
    lanes = lanes.with_rows(z=z.reshape(-1, base.count), weight=weight.reshape(-1, base.count))
    size = np.abs(factor) * stacked("spread") / np.abs(scale)
    if (size != 1.0).any():
        lanes = replace(lanes, noise=_rescaled(base.noise, size))
    return _relocated(case, lanes, changes, theta)


def in_base(case: MisfitCase, change: Change) -> MisfitCase:
    """Return the case in the structure that a change states."""
    assert change.base is not None
    x = np.zeros((len(case.times), change.base.layout.size))
    new, old = change.base.layout, case.base.layout
    for slot in old.shared:
        there, _ = new.find(slot.name)
        size = min(slot.size, there.size)
        x[:, there.start : there.start + size] = case.x[:, slot.start : slot.start + size]
    x[:, new.n_shared :] = case.x[:, old.n_shared :]
    return replace(case, base=change.base, x=x, cost=None)


def _rescaled(noise: Noise, size: Array) -> Noise:
    """Return the noise of all lanes, with the standard deviations multiplied by `size` (E, K, m)."""
    blocks = []
    for block in noise.blocks:
        own = size[..., block.row]
        covariance = block.covariance * own[..., :, None] * own[..., None, :]
        blocks.append(Block(block.row, covariance.reshape(-1, *covariance.shape[2:])))
    return Noise(tuple(blocks))


def _relocated(case: MisfitCase, lanes: Problem, changes: Sequence[Change], theta: Array) -> Problem:
    """Return the lanes with the positions of the stations that the changes state or estimate."""
    if not any(change.position is not None or change.moved >= 0 for change in changes):
        return lanes
    stated = case.base.stations.position
    core, d = stated.shape[-3:], case.base.dimension
    all_places = np.broadcast_to(stated, (len(case.times), *core)) + np.zeros((len(changes), 1, 1, 1, 1))
    for e, change in enumerate(changes):
        if change.position is not None:
            all_places[e] = change.position
        if change.moved >= 0:
            first = len(change.columns)
            all_places[e, ..., change.moved, :] += theta[e, first : first + d]
    return replace(lanes, stations=replace(lanes.stations, position=all_places.reshape(-1, *core)))


@np.errstate(divide="ignore", invalid="ignore", over="ignore")  # a scale that becomes zero has no finite cost
def fit(case: MisfitCase, changes: Sequence[Change], most: int | None = _STARTS) -> Fits:
    """Return the best fit of each change.

    A change with parameters and without starts affects a few rows: its fit starts at the fit without these rows.

    Parameters
    ----------
    case : MisfitCase
        The problem.
    changes : sequence of Change
        E changes.
    most : int, optional
        Number of descents of a search that go to the end; None for all.
    """
    d = case.base.dimension
    width = max(1, *(change.size(d) for change in changes))
    lane = [e for e, change in enumerate(changes) for _ in range(max(1, len(change.starts)))]
    theta = np.zeros((len(lane), width))
    for i, given in enumerate(s for change in changes for s in (change.starts or ((),))):
        theta[i, : len(given)] = given
    many = [changes[e] for e in lane]
    found = np.stack([case.x if change.x is None else change.x for change in many])
    blind = [i for i, change in enumerate(many) if change.x is None]
    if blind:
        found[blind] = _search(case, [_without(many[i]) for i in blind], theta[blind], found[blind], most)
    theta = np.where([[not change.starts] for change in many], _first_values(case, many, theta, found), theta)
    done = _descend(case, many, theta, found)
    total = done.cost.sum(-1)
    order = np.lexsort((total, lane))
    first = order[np.unique(np.asarray(lane)[order], return_index=True)[1]]
    return done.take(first)


def _without(change: Change) -> Change:
    """Return a change without the rows that its parameters affect; unchanged if it states starts."""
    if change.starts or not change.columns:
        return change
    affected = np.any([column.coefficient != 0.0 for column in change.columns], axis=0)
    return replace(change, weight=np.where(affected, 0.0, change.weight), columns=(), moved=-1)


def _search(case: MisfitCase, changes: Sequence[Change], theta: Array, x: Array, most: int | None) -> Array:
    """Return the unknowns (E, K, size) of the best positions of a search; `x` are more starts."""
    lanes, flat = changed(case, changes, theta), x.reshape(-1, x.shape[-1])
    if case.base.layout.shares("position") and case.base.layout.n_shared:
        return fit_anywhere(lanes, flat, most).x.reshape(x.shape)
    return descend(lanes, flat)[0].reshape(x.shape)


def _first_values(case: MisfitCase, changes: Sequence[Change], theta: Array, x: Array) -> Array:
    """Return the least-squares parameters (E, q) at fixed positions `x` (E, K, size)."""
    if not any(change.columns for change in changes):
        return theta
    system = _system(case, changes, theta, x)
    own = np.einsum("ekmp,ekmq->epq", system.columns, system.columns)
    pull = np.einsum("ekmp,ekm->ep", system.columns, system.residual)
    return theta + _solve(own, pull)


@dataclass(frozen=True, slots=True)
class _System:
    """Whitened residuals (E, K, m), columns of the parameters (E, K, m, q), and their coupling (E, K, size, q)."""

    lanes: Problem
    residual: Array
    columns: Array
    information: Array
    vector: Array
    coupling: Array


def _system(case: MisfitCase, changes: Sequence[Change], theta: Array, x: Array) -> _System:
    """Return the linearised system of all lanes at parameters `theta` (E, q) and unknowns `x` (E, K, size)."""
    lanes, shape = changed(case, changes, theta), x.shape
    flat = x.reshape(-1, shape[-1])
    linear = linearise(lanes, flat)
    columns = _columns(case, lanes, changes, theta, flat)
    jacobian = _dense(lanes, linear.shared, linear.local)
    stacked = np.concatenate([linear.residual[..., None], jacobian, columns], axis=-1)
    white = np.concatenate([whitener.apply(stacked) for whitener in linear.noise], axis=-2)
    n, equations = shape[-1], equations_at(lanes, flat)
    information, vector = joined(lanes, equations)
    columns = white[..., 1 + n :]
    coupling = np.swapaxes(white[..., 1 : 1 + n], -1, -2) @ columns
    parts = (white[..., 0], columns, information, vector, coupling)
    return _System(lanes, *(part.reshape(*shape[:2], *part.shape[1:]) for part in parts))


def _dense(problem: Problem, shared: Array, local: Array) -> Array:
    """Return the Jacobian (L, m, size) with the local unknowns of all epochs."""
    n, length, k = shared.shape[-1], local.shape[-1], problem.epochs
    if length == 0 or k == 1:
        return np.concatenate([shared, local], axis=-1)
    out = np.zeros((*shared.shape[:-1], n + k * length))
    out[..., :n] = shared
    rows = np.arange(problem.count)
    for j in range(length):
        out[..., rows, n + length * problem.epoch + j] = local[..., j]
    return out


def joined(problem: Problem, equations: Normal) -> tuple[Array, Array]:
    """Return the information (L, size, size) and the right side (L, size) of all unknowns."""
    n, length, k = problem.layout.n_shared, problem.layout.n_local, problem.epochs
    size, count = n + k * length, len(equations.shared)
    information, vector = np.zeros((count, size, size)), np.zeros((count, size))
    information[:, :n, :n], vector[:, :n] = equations.shared, equations.shared_vector
    for e in range(k if length else 0):
        part = slice(n + e * length, n + (e + 1) * length)
        information[:, part, part] = equations.local[:, e]
        information[:, :n, part] = equations.cross[:, e]
        information[:, part, :n] = np.swapaxes(equations.cross[:, e], -1, -2)
        vector[:, part] = equations.local_vector[:, e]
    return information, vector


def _columns(case: MisfitCase, lanes: Problem, changes: Sequence[Change], theta: Array, flat: Array) -> Array:
    """Return the derivatives (L, m, q) of the predictions of `changed` with respect to the parameters."""
    count, k, m = len(changes), len(case.times), case.base.count
    out, scale = np.zeros((count, k, m, theta.shape[1])), np.ones((count, k, m))
    for e, change in enumerate(changes):
        for j, column in enumerate(change.columns):
            if column.enters == "scales":
                scale[e] += theta[e, j] * column.coefficient
    predicted = predict(lanes, flat).reshape(count, k, m)
    for e, change in enumerate(changes):
        for j, column in enumerate(change.columns):
            effect = column.coefficient * (1.0 if column.enters == "adds" else predicted[e])
            out[e, ..., j] = effect / scale[e]
    if any(change.moved >= 0 for change in changes):
        step = 1e-6 * case.extent  # the differences lose half of the digits, which a direction of descent allows
        for i in range(case.base.dimension):
            aside = theta.copy()
            for e, change in enumerate(changes):
                if change.moved >= 0:
                    aside[e, len(change.columns) + i] += step
            other = predict(_relocated(case, lanes, changes, aside), flat).reshape(count, k, m)
            for e, change in enumerate(changes):
                if change.moved >= 0:
                    out[e, ..., len(change.columns) + i] = (other[e] - predicted[e]) / step
    out = np.where(np.isfinite(out), out, 0.0) * (np.reshape(lanes.weight, (count, k, m)) > 0.0)[..., None]
    return out.reshape(-1, m, theta.shape[1])


def _solve(information: Array, vector: Array) -> Array:
    """Return the solutions (E, q); zero for parameters without information."""
    root, _ = linalg.root(information)
    return np.asarray((root @ (np.swapaxes(root, -1, -2) @ vector[..., None]))[..., 0])


def _reduced(system: _System, x: Array) -> tuple[Array, Array, Array]:
    """Return information (E, q, q) and right side (E, q) of the parameters, and whether x is determined (E, K)."""
    shape, lanes = x.shape, system.lanes
    space = np.broadcast_to(np.eye(shape[-1]), (shape[0] * shape[1], shape[-1], shape[-1]))
    equalities = Equalities.of(lanes)
    if equalities.lasting:
        along, n = equalities.lasting_space(x.reshape(-1, shape[-1])), lanes.layout.n_shared
        left = shape[-1] - n
        space = np.zeros((len(along), shape[-1], along.shape[-1] + left))
        space[:, :n, : along.shape[-1]] = along
        space[:, n:, along.shape[-1] :] = np.eye(left)
    space = space.reshape(*shape[:2], *space.shape[1:])
    across = np.swapaxes(space, -1, -2)
    inner = across @ system.information @ space
    diagonal = np.diagonal(inner, axis1=-2, axis2=-1)
    unit = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = inner * unit[..., :, None] * unit[..., None, :]
    scaled = np.where(np.isfinite(scaled).all((-1, -2), keepdims=True), scaled, 0.0)
    determined = np.linalg.eigvalsh(scaled)[..., 0] > 1e-12 if inner.shape[-1] else np.ones(shape[:2], dtype=bool)
    root = space @ linalg.root(np.where(np.isfinite(inner), inner, 0.0))[0]
    pulled = np.swapaxes(root, -1, -2) @ system.coupling
    own = np.einsum("ekmp,ekmq->ekpq", system.columns, system.columns)
    left = own - np.swapaxes(pulled, -1, -2) @ pulled
    pull = np.einsum("ekmp,ekm->ekp", system.columns, system.residual)
    pull = pull - (np.swapaxes(pulled, -1, -2) @ (np.swapaxes(root, -1, -2) @ system.vector[..., None]))[..., 0]
    weak = np.diagonal(left.sum(1), axis1=-2, axis2=-1) <= _ROUNDING * np.diagonal(own.sum(1), axis1=-2, axis2=-1)
    total = np.where(weak[..., :, None] | weak[..., None, :], 0.0, left.sum(1))
    return total, np.where(weak, 0.0, pull.sum(1)), determined


def _descend(case: MisfitCase, changes: Sequence[Change], theta: Array, x: Array) -> Fits:
    """Return the fits from parameters `theta` (E, q) and unknowns `x` (E, K, size), by steps that lower the cost."""
    shape = x.shape

    def settle(values: Array, places: Array, items: Array) -> tuple[Array, Array]:
        some = [changes[int(i)] for i in items]
        lanes = changed(case, some, values)
        y, cost = descend(lanes, places.reshape(-1, shape[-1]))
        return y.reshape(-1, *shape[1:]), np.where(np.isfinite(cost), cost, np.inf).reshape(-1, shape[1])

    every = np.arange(len(changes))
    x, cost = settle(theta, x, every)
    sizes = np.array([change.size(case.base.dimension) for change in changes])
    active, length = np.flatnonzero(sizes > 0), np.ones(len(changes))
    for _ in range(_STEPS):
        if not len(active):
            break
        some = [changes[int(i)] for i in active]
        information, pull, _ = _reduced(_system(case, some, theta[active], x[active]), x[active])
        step = _solve(information, pull)
        # the fall that a step promises: without it, the steps have ended
        promising = (pull * step).sum(-1) > _DONE
        active, step = active[promising], step[promising]
        some = [changes[int(i)] for i in active]
        if not some:
            break
        step = _bounded(some, theta[active], step * length[active, None])
        new, new_cost = settle(theta[active] + step, x[active], active)
        fall = cost[active].sum(-1) - new_cost.sum(-1)
        better = fall > 0.0
        kept = active[better]
        theta[kept] += step[better]
        x[kept], cost[kept] = new[better], new_cost[better]
        length[active] = np.where(better, np.minimum(1.0, 3.0 * length[active]), 0.25 * length[active])
        active = active[(better & (fall > _DONE)) | (~better & (length[active] > 0.01))]
    return _assessed(case, changes, theta, x, cost)


def _bounded(changes: Sequence[Change], theta: Array, step: Array) -> Array:
    """Return steps that keep every scale above a third of its value: a scale has no second sign."""
    out = np.where(np.isfinite(step), step, 0.0)
    for e, change in enumerate(changes):
        for j, column in enumerate(change.columns):
            if column.enters == "scales":
                scale = 1.0 + theta[e, j]
                out[e, j] = np.clip(out[e, j], -0.67 * abs(scale), 2.0 * abs(scale))
    return out


def _assessed(case: MisfitCase, changes: Sequence[Change], theta: Array, x: Array, cost: Array) -> Fits:
    """Return the fits, with infinite costs where the data determine no position, and sigmas of the parameters."""
    system = _system(case, changes, theta, x)
    information, _, determined = _reduced(system, x)
    sizes = np.array([change.size(case.base.dimension) for change in changes])
    used = np.arange(theta.shape[1]) < sizes[:, None]
    root, _ = linalg.root(information)
    variance = (root**2).sum(-1)
    sigma = np.sqrt(np.where(used & (np.diagonal(information, axis1=-2, axis2=-1) > 0.0), variance, np.inf))
    cost = np.where(determined & ~_is_far(system.lanes, x), cost, np.inf)
    # a parameter without information changes nothing, so that the change is no explanation
    open_parameter = np.asarray((used & ~np.isfinite(sigma)).any(-1))
    cost = np.where(open_parameter[:, None], np.inf, cost)
    return Fits(x, np.where(used, theta, 0.0), np.where(used, sigma, 0.0), cost)


def _is_far(lanes: Problem, x: Array) -> Array:
    """Return flags (E, K) of positions that are so far away that they are only directions, or that are out of reach.

    `lanes` are the problems (E K,) at whose unknowns `x` (E, K, size) the positions are.
    """
    slot = _position_slot(lanes)
    if slot is None:
        return np.zeros(x.shape[:-1], dtype=bool)
    centre, spread = centre_and_spread(lanes.stations.places)
    away = np.abs(x.reshape(-1, x.shape[-1])[:, slot] - centre).max(-1)
    return np.asarray((away > _FAR * np.ravel(spread)).reshape(x.shape[:-1]) | is_out_of_reach(lanes, x))


def is_out_of_reach(lanes: Problem, x: Array) -> Array:
    """Return flags (E, K) of positions deep in the Earth, or on its other side, which no signal reaches.

    The arguments are as in `_is_far`. Stations all around the Earth have no other side.
    """
    slot = _position_slot(lanes)
    if slot is None or not lanes.frame.geodetic:
        return np.zeros(x.shape[:-1], dtype=bool)
    centre, _ = centre_and_spread(lanes.stations.places)
    middle, place = lanes.frame.to_ecef(centre), lanes.frame.to_ecef(x.reshape(-1, x.shape[-1])[:, slot])
    hidden = ((place * middle).sum(-1) < 0.0) | (np.linalg.norm(place, axis=-1) < _DEPTH)
    return np.asarray((hidden & (np.linalg.norm(middle, axis=-1) > _DEPTH)).reshape(x.shape[:-1]))


def _position_slot(problem: Problem) -> slice | None:
    """Return the slice of the position in the unknowns; None if the rows share no position."""
    if not problem.layout.shares("position"):
        return None
    slot, _ = problem.layout.find("position")
    return slice(slot.start, slot.start + slot.size)
