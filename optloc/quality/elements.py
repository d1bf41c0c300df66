"""The errors and offsets of many small problems, linearised at their fixes and packed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optloc import linalg
from optloc.constraints import exact, tangent_at
from optloc.epochs import by_epoch, separable
from optloc.errors import InvalidProblem
from optloc.evaluate import differentiate
from optloc.layout import emission_name
from optloc.models import MODELS
from optloc.noise import gathered
from optloc.priors import prior_parts
from optloc.problem import Problem
from optloc.quality.groups import By, ends_of, split
from optloc.types import Array
from optloc.weigh import weighed

_LARGEST = 2000
_PART = 2000


@dataclass(frozen=True, slots=True)
class Elements:
    """N linearised problems with their rows, errors and offsets packed; whatever is not there is zero.

    Parameters
    ----------
    names : tuple of G str
        Groups.
    residual : array (N, m)
        Measured less modelled.
    jacobian : array (N, m, p)
        Derivative with respect to the unknowns.
    effect : array (N, m, q)
        B: effect of each error of unit variance, in the rows' units.
    offset : array (N, m, c)
        E: effect of an offset of each group.
    fixed : array (N, m, m)
        C: covariance that belongs to no group.
    sigma : array (N, q)
        Stated standard deviation of each error, in the rows' units.
    of_effect, of_offset : int array (N, q), (N, c)
        Groups; -1 for none.
    path : array (N, c)
        Length of the path to a station, metres, on average over the rows of an offset; NaN where it is not one.
    """

    names: tuple[str, ...]
    residual: Array
    jacobian: Array
    effect: Array
    offset: Array
    fixed: Array
    sigma: Array
    of_effect: Array
    of_offset: Array
    path: Array

    def take(self, index: Any) -> Elements:
        """Return some of the problems."""
        arrays = ("residual", "jacobian", "effect", "offset", "fixed", "sigma", "of_effect", "of_offset", "path")
        return replace(self, **{name: getattr(self, name)[index] for name in arrays})


def batch_of(problem: Problem) -> Problem:
    """Return the independent problems that a problem consists of as a flat batch, station errors of epochs as noise.

    Raises
    ------
    InvalidProblem
        Where more rows than can be handled share unknowns.
    """
    stations = problem.stations
    if stations.covariance is not None and stations.span == "epoch":
        problem = replace(problem, stations=replace(stations, span="noise"))
    flat = (by_epoch(problem) if separable(problem) else problem).flat()
    if flat.count > _LARGEST and flat.epochs > 1:
        what = f"{flat.count} rows share unknowns"
        raise InvalidProblem(what, "noise", f"use at most {_LARGEST}, or epochs that are fixed one by one")
    return flat


def elements(problem: Problem, x: Array, by: By) -> Elements:
    """Return the elements of a flat batch of problems at parameter vectors.

    Parameters
    ----------
    problem : Problem
        N problems, of `batch_of`.
    x : array (N, size)
        Their fixes, finite.
    by : "station", "pair" or "kind"
        What makes a group.
    """
    ends = ends_of(problem, by)
    names = sorted({*ends.name.ravel().tolist()} - {""})
    parts = []
    for first in range(0, len(x), _PART):
        items = np.arange(first, min(first + _PART, len(x)))
        parts.append(_part(problem.take(items), x[items], by))
    more = sorted({name for part in parts for name in part.names} - set(names))
    return _joined((*names, *more), parts)


def _part(problem: Problem, x: Array, by: By) -> Elements:
    count, rows = len(x), problem.count
    present = np.broadcast_to(problem.weight > 0.0, (count, rows))
    residual, jacobian = _linear(problem, x)
    effect, error_names, sigma = _effects(problem, by, present)
    offset, offset_names = _offsets(problem, by)
    names = tuple(sorted({*error_names.tolist(), *offset_names.tolist()} - {""}))
    number = {name: i for i, name in enumerate(names)} | {"": -1}
    path = np.broadcast_to(_paths(problem, x, residual), present.shape)
    kept = _first(present)
    residual, present_packed = (np.take_along_axis(a, kept, 1) for a in (residual, present))
    jacobian, effect, offset = (
        np.take_along_axis(a, kept[..., None], 1) * present_packed[..., None]
        for a in (jacobian, effect, np.broadcast_to(offset, (count, *offset.shape)))
    )
    fixed = _fixed(problem, x)
    fixed = np.take_along_axis(np.take_along_axis(fixed, kept[..., None], 1), kept[:, None], 2)
    fixed = fixed * (present_packed[..., :, None] & present_packed[..., None, :])
    effect, of_effect, chosen = _packed(effect, np.array([number[n] for n in error_names], dtype=np.int64))
    sigma = np.take_along_axis(sigma, chosen, 1)
    offset, of_offset, _ = _packed(offset, np.array([number[n] for n in offset_names], dtype=np.int64))
    path = np.take_along_axis(path, kept, 1)[..., None]
    mean = np.where(offset != 0.0, path, 0.0).sum(1) / np.maximum((offset != 0.0).sum(1), 1)
    made = Elements(
        names, residual * present_packed, jacobian, effect, offset, fixed, sigma, of_effect, of_offset, mean
    )
    return _with_priors(problem, x, made)


def _linear(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return residuals (N, m) and Jacobians (N, m, p) along what equality constraints leave free."""
    residual, jacobian = differentiate(problem, x)
    if problem.epochs > 1 and problem.layout.n_local:
        n, length = problem.layout.n_shared, problem.layout.n_local
        spread = np.zeros((*residual.shape, problem.layout.size))
        spread[..., :n] = jacobian[..., :n]
        rows = np.arange(problem.count)[:, None]
        columns = n + problem.epoch[:, None] * length + np.arange(length)
        spread[..., rows, columns] = jacobian[..., n:]
        jacobian = spread
    face = exact(problem)
    if face:
        along, n = tangent_at(problem, face, x).along, problem.layout.n_shared
        jacobian = np.concatenate([jacobian[..., :n] @ along, jacobian[..., n:]], axis=-1)
    return residual, jacobian


def _paths(problem: Problem, x: Array, residual: Array) -> Array:
    """Return the modelled path (N, m) from target to station of rows that measure one; NaN of others."""
    parts, start = [], 0
    for rows in problem.rows:
        model = MODELS[rows.kind]
        path = rows.z - rows.correction - residual[..., start : start + rows.count]
        if model.ranges != (1, 0):
            path = np.full_like(path, np.nan)
        elif model.emission:
            late = [
                problem.layout.take(x, emission_name(int(t), len(problem.motions)))[:, :, 0] for t in problem.emitting
            ]
            place = np.searchsorted(problem.emitting, rows.target)
            path = path - np.stack(late, axis=1)[:, place, rows.epoch]
        parts.append(path)
        start += rows.count
    return np.concatenate(parts, axis=-1)


def _effects(problem: Problem, by: By, present: Array) -> tuple[Array, Array, Array]:
    """Return the effects (N, m, Q) of all errors, their groups (Q,) and standard deviations (N, Q)."""
    count, rows = present.shape
    effects, names, sigmas = [], [], []
    for block in problem.noise.blocks:
        own, name, sigma = split(problem, block, by, present)
        own = np.broadcast_to(own, (count, len(block.row), *own.shape[-2:]))
        g, _r, q = own.shape[1:]
        wide = np.zeros((count, rows, g, q))
        wide[:, block.row, np.arange(g)[:, None]] = own
        effects.append(wide.reshape(count, rows, g * q))
        names.append(name.reshape(-1))
        sigmas.append(np.broadcast_to(sigma, (count, g, q)).reshape(count, g * q))
    return np.concatenate(effects, axis=-1), np.concatenate(names), np.concatenate(sigmas, axis=-1)


def _offsets(problem: Problem, by: By) -> tuple[Array, Array]:
    """Return the effects (m, c) of offsets of groups, and their names (c,)."""
    ends = ends_of(problem, by)
    names = np.array(sorted({*ends.name.ravel().tolist()} - {""}), dtype=object)
    return ((ends.name[..., None] == names) * ends.sign[..., None]).sum(1), names


def _fixed(problem: Problem, x: Array) -> Array:
    """Return the covariance (N, m, m) that station errors and weights between 0 and 1 add to the noise."""
    rows = np.arange(problem.count)[None]
    stated = gathered(problem.noise, rows)[..., 0, :, :]
    whole = gathered(weighed(problem, x).noise, rows)[..., 0, :, :]
    weight = np.where(problem.weight > 0.0, problem.weight, 1.0)
    own = (1.0 / weight - 1.0) * np.diagonal(whole, axis1=-2, axis2=-1)
    added = whole - stated + own[..., None] * np.eye(problem.count)
    return np.broadcast_to(added, (len(x), *added.shape[-2:]))


def _first(present: Array) -> Array:
    """Return the rows (N, most) of each problem, those that are present first."""
    most = max(1, int(present.sum(1).max(initial=0)))
    return np.argsort(~present, axis=1, kind="stable")[:, :most]


def _packed(columns: Array, number: Array) -> tuple[Array, Array, Array]:
    """Return the columns (N, m, q) that are not zero, their groups (N, q), -1 for zeros, and which they are (N, q)."""
    used = (columns != 0.0).any(1)
    kept = _first(used)
    group = np.where(np.take_along_axis(used, kept, 1), number[kept], -1)
    return np.take_along_axis(columns, kept[:, None], 2), group, kept


def _with_priors(problem: Problem, x: Array, made: Elements) -> Elements:
    """Return the elements with the priors of a problem as rows that belong to no group."""
    parts = [] if exact(problem) else prior_parts(problem)
    for name, mean, precision in parts:
        slot, shared = problem.layout.find(name)
        start = slot.start if shared else problem.layout.n_shared + slot.start
        columns = start + np.arange(slot.size)
        more = np.zeros((len(x), slot.size, made.jacobian.shape[-1]))
        more[:, np.arange(slot.size), columns] = 1.0
        covariance, _ = linalg.inverse(np.broadcast_to(precision, (len(x), slot.size, slot.size)))
        error = np.broadcast_to(mean, (len(x), slot.size)) - x[:, columns]
        n, m = made.residual.shape
        fixed = np.zeros((n, m + slot.size, m + slot.size))
        fixed[:, :m, :m], fixed[:, m:, m:] = made.fixed, covariance
        below = ((0, 0), (0, slot.size), (0, 0))
        made = replace(
            made,
            residual=np.concatenate([made.residual, error], axis=1),
            jacobian=np.concatenate([made.jacobian, more], axis=1),
            effect=np.pad(made.effect, below),
            offset=np.pad(made.offset, below),
            fixed=fixed,
        )
    return made


def _joined(names: tuple[str, ...], parts: list[Elements]) -> Elements:
    """Return parts as one, with groups numbered alike and arrays padded to one size."""
    renamed = []
    for part in parts:
        number = np.array([*(names.index(name) for name in part.names), -1])
        renamed.append(replace(part, of_effect=number[part.of_effect], of_offset=number[part.of_offset]))

    def stacked(name: str, fill: float = 0.0) -> Array:
        arrays = [getattr(part, name) for part in renamed]
        shape = np.max([a.shape[1:] for a in arrays], axis=0)
        padded = [
            np.pad(
                a, [(0, 0), *((0, int(n) - k) for n, k in zip(shape, a.shape[1:], strict=True))], constant_values=fill
            )
            for a in arrays
        ]
        return np.concatenate(padded)

    joined = {name: stacked(name) for name in ("residual", "jacobian", "effect", "offset", "fixed", "sigma", "path")}
    return Elements(names, **joined, of_effect=stacked("of_effect", -1), of_offset=stacked("of_offset", -1))
