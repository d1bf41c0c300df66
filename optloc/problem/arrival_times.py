"""Differences of arrival times as arrival times: one row for each station, whose errors are independent.

Rows z = D tau + n that difference the arrivals tau = r + e of one emission e at several stations, with
cov n = D diag(v) D', are equivalent to the rows tau_s = r_s + e with independent variances v_s and e unknown: for every
position the least cost over e is the same. What is wrong with one station is then wrong with one row.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array, Rows
from optloc.problem.layout import Layout
from optloc.problem.noise import Block, Noise, dense, group
from optloc.problem.problem import Problem

# Relative error of a covariance that is taken for D diag(v) D': rounding is below it, noise of another form far above.
_EXACT = 1e-9
# Variance, as a share of the mean, of an arrival that the differences take for exact: the least that solvers bear.
_LEAST = 1e-6


@dataclass(frozen=True, slots=True)
class Arrivals:
    """A problem whose range differences were replaced by arrival times.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems; the arrival times are its first rows.
    origin : tuple of int arrays
        For each of its rows the global numbers of the rows of the problem it was made from.
    """

    problem: Problem
    origin: tuple[Array, ...]


@dataclass(frozen=True, slots=True)
class _Sighting:
    """The differences of one epoch and target: their rows (r,), stations (s,) and D (r, s)."""

    rows: Array
    stations: Array
    design: Array
    epoch: int
    target: int


def as_arrivals(problem: Problem) -> Arrivals | None:
    """Return a flat batch of problems with arrival times for range differences, or None where that is not the same.

    Parameters
    ----------
    problem : Problem
        N problems. Their differences must have the noise that combined arrivals have, link all stations of an epoch,
        and be touched by no bias; which rows are present must be the same in all problems.

    Returns
    -------
    Arrivals or None
        Rows that are absent everywhere are no part of it.
    """
    numbers = [np.arange(start, start + r.count) for r, start in zip(problem.rows, problem.starts, strict=True)]
    differences = [own for own, rows in zip(numbers, problem.rows, strict=True) if rows.kind == "tdoa"]
    if not differences or problem.biases or problem.emitting:
        return None
    weight = np.broadcast_to(problem.weight, (*problem.batch_shape, problem.count))
    # one set of arrivals for the batch: rows that are absent, or of less weight, in some problems forbid it
    present = weight[0] > 0.0
    taken = np.concatenate(differences)
    if ((weight > 0.0) != present).any() or (weight[:, taken[present[taken]]] != 1.0).any():
        return None
    sightings = list(_sightings(problem, taken[present[taken]]))
    found = [_find_arrivals(problem, one) for one in sightings]
    if (
        not found
        or any(one is None for one in found)
        or not _are_apart(problem.noise, sightings, taken[~present[taken]])
    ):
        return None
    z, variance = (np.concatenate([one[i] for one in found if one is not None], axis=-1) for i in range(2))
    return _assemble(problem, sightings, z, variance)


def _sightings(problem: Problem, taken: Array) -> Iterator[_Sighting]:
    """Yield the differences of each epoch and target."""
    a, b, epoch, target = (
        np.concatenate([getattr(rows, name) for rows in problem.rows])[taken] for name in ("a", "b", "epoch", "target")
    )
    for k, t in np.unique(np.column_stack([epoch, target]), axis=0).tolist():
        own = np.flatnonzero((epoch == k) & (target == t))
        stations = np.unique([a[own], b[own]])
        design = np.zeros((len(own), len(stations)))
        design[np.arange(len(own)), np.searchsorted(stations, a[own])] += 1.0
        design[np.arange(len(own)), np.searchsorted(stations, b[own])] -= 1.0
        yield _Sighting(taken[own], stations, design, k, t)


def _find_arrivals(problem: Problem, one: _Sighting) -> tuple[Array, Array] | None:
    """Return arrival times (N, s), up to a common one, and variances (N or 1, s); None where they do not exist."""
    design, s = one.design, len(one.stations)
    # fewer differences than stations less one fall into groups, each with a common arrival of its own
    if np.linalg.matrix_rank(design) < s - 1:
        return None
    covariance = dense(problem.noise, one.rows)
    # D diag(v) D' is linear in v: (r * r, s) times v is the covariance, flattened
    products = (design[:, None] * design[None]).reshape(-1, s)
    flat = covariance.reshape(*covariance.shape[:-2], -1)
    variance = flat @ np.linalg.pinv(products).T
    scale = np.abs(flat).max(-1, keepdims=True)
    same = np.abs(variance @ products.T - flat) <= _EXACT * scale
    if not same.all() or (variance < -_EXACT * scale).any():
        return None
    variance = np.maximum(variance, _LEAST * variance.mean(-1, keepdims=True))
    # the least-squares arrivals of mean zero: redundant differences agree, since their noise is that of arrivals
    return problem.observed[:, one.rows] @ np.linalg.pinv(design).T, variance.reshape(-1, s)


def _are_apart(noise: Noise, sightings: list[_Sighting], absent: Array) -> bool:
    """Return whether the differences of each sighting are correlated with nothing else."""
    for one in sightings:
        for block in noise.blocks:
            inside = np.isin(block.row, one.rows)
            mixed = inside.any(1) & ~(inside | np.isin(block.row, absent)).all(1)
            if mixed.any():
                return False
    return True


def _assemble(problem: Problem, sightings: list[_Sighting], z: Array, variance: Array) -> Arrivals:
    """Return the problem of the arrival times and of the rows of other kinds that are present."""
    sizes = [len(one.stations) for one in sightings]
    station = np.concatenate([one.stations for one in sightings])
    ones = np.ones(len(station))
    arrival = Rows(
        "toa",
        z,
        station,
        np.full(len(station), -1),
        np.repeat([one.epoch for one in sightings], sizes),
        np.repeat([one.target for one in sightings], sizes),
        ones,
        0.0 * ones,
    )
    # an arrival is made from all differences of its station
    origin = [one.rows[column != 0.0] for one in sightings for column in one.design.T]
    rows, number = [arrival], np.full(problem.count, -1)
    count = len(station)
    for block, start in zip(problem.rows, problem.starts, strict=True):
        if block.kind != "tdoa":
            number[start : start + block.count] = count + np.arange(block.count)
            origin += [np.array([start + i]) for i in range(block.count)]
            rows.append(block)
            count += block.count
    variance = variance[0] if len(variance) == 1 else variance
    own = Block(np.arange(len(station))[:, None], variance[..., None, None])
    noise = group([own, *_keep_noise(problem.noise, number)])
    return Arrivals(replace(problem, rows=tuple(rows), noise=noise), tuple(origin))


def _keep_noise(noise: Noise, number: Array) -> Iterator[Block]:
    """Yield the noise of the rows of other kinds, numbered anew."""
    for block in noise.blocks:
        kept = (number[block.row] >= 0).all(1)
        if kept.any():
            own = block.covariance if block.covariance.shape[-3] == 1 else block.covariance[..., kept, :, :]
            yield Block(number[block.row[kept]], own)


def restore_order(layout: Layout, other: Layout, x: Array) -> Array:
    """Return vectors (..., size) in the order of a layout whose unknowns another layout has too, perhaps among more."""
    shared, local = other.split(x)
    columns = []
    for slot in layout.local:
        start = other.find(slot.name)[0].start
        columns.append(local[..., start : start + slot.size])
    flat = [np.concatenate(columns, axis=-1).reshape(*x.shape[:-1], -1)] if columns else []
    return np.concatenate([shared[..., shared_places(layout, other)], *flat], axis=-1)


def shared_places(layout: Layout, other: Layout) -> Array:
    """Return where the shared unknowns of a layout stand in another that has them too, (n,)."""
    starts = ((other.find(slot.name)[0].start, slot.size) for slot in layout.shared)
    return np.concatenate([np.arange(0), *(np.arange(start, start + size) for start, size in starts)])
