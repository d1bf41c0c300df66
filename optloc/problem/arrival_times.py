"""Conversion of range differences to arrival times: one row per station, with independent errors.

Range differences are z = D tau + n, with arrival times tau = r + e in metres. r is the range from each station to the
target, and e is the unknown emission time. Each row of D has one entry 1 and one entry -1, for its two stations.

If the noise n has the covariance D diag(v) D', the rows tau_s = r_s + e are equivalent. The arrival times have
independent variances v_s. At every position, the least cost over e is the same as before. An error of one station then
affects one row only, so the search for a bad station is simpler.

Letters: N problems of a batch, r range differences and s stations of one epoch and target.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array, Rows
from optloc.problem.layout import Layout
from optloc.problem.noise import Block, Noise, dense, group
from optloc.problem.problem import Problem

# Relative error up to which a covariance counts as D diag(v) D'. Rounding is smaller, any other form is far larger.
_EXACT = 1e-9
# Least variance of an arrival, as a share of the mean variance: smaller values make the solvers inaccurate.
_LEAST = 1e-6


@dataclass(frozen=True, slots=True)
class Arrivals:
    """A problem in which arrival times replace the range differences.

    `origin` maps each suspect row of the new problem back to the original measurements.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems. Its first rows are the arrival times.
    origin : tuple of int arrays
        For each row of `problem`, the global numbers of the original rows from which it was computed.
    """

    problem: Problem
    origin: tuple[Array, ...]


@dataclass(frozen=True, slots=True)
class _DifferenceSet:
    """The range differences of one epoch and target.

    `rows` (r,) are their global row numbers. `stations` (s,) are the station numbers that occur in them. `design` is
    the matrix D (r, s) with entries 1, -1 and 0. `epoch` and `target` are numbers.
    """

    rows: Array
    stations: Array
    design: Array
    epoch: int
    target: int


def as_arrivals(problem: Problem) -> Arrivals | None:
    """Return the problem with arrival times instead of range differences, or None if the two are not equivalent.

    Parameters
    ----------
    problem : Problem
        N problems. Three conditions apply to the range differences: their noise comes from combined arrivals, they link
        all stations of an epoch, and no bias affects them. The same rows must be present in all problems.

    Returns
    -------
    Arrivals or None
        A flat batch of problems. It omits rows that are absent in all problems.
    """
    numbers = [np.arange(start, start + r.count) for r, start in zip(problem.rows, problem.starts, strict=True)]
    differences = [row_numbers for row_numbers, rows in zip(numbers, problem.rows, strict=True) if rows.kind == "tdoa"]
    if not differences or problem.biases or problem.emitting:
        return None
    weight = np.broadcast_to(problem.weight, (*problem.batch_shape, problem.count))
    # The batch shares one set of arrivals, so each row must be present with weight 1 in all problems, or absent in all.
    present = weight[0] > 0.0
    tdoa_rows = np.concatenate(differences)
    if ((weight > 0.0) != present).any() or (weight[:, tdoa_rows[present[tdoa_rows]]] != 1.0).any():
        return None
    sets = list(_difference_sets(problem, tdoa_rows[present[tdoa_rows]]))
    arrivals = [_find_arrivals(problem, one) for one in sets]
    if (
        not arrivals
        or any(one is None for one in arrivals)
        or not _are_uncorrelated(problem.noise, sets, tdoa_rows[~present[tdoa_rows]])
    ):
        return None
    z, variance = (np.concatenate([one[i] for one in arrivals if one is not None], axis=-1) for i in range(2))
    return _assemble(problem, sets, z, variance)


def _difference_sets(problem: Problem, numbers: Array) -> Iterator[_DifferenceSet]:
    """Yield the range differences of each epoch and target; `numbers` (n,) are the global row numbers to group."""
    a, b, epoch, target = (
        np.concatenate([getattr(rows, name) for rows in problem.rows])[numbers]
        for name in ("a", "b", "epoch", "target")
    )
    for k, t in np.unique(np.column_stack([epoch, target]), axis=0).tolist():
        members = np.flatnonzero((epoch == k) & (target == t))
        stations = np.unique([a[members], b[members]])
        # The matrix D: each difference is the arrival at station a minus the arrival at station b.
        design = np.zeros((len(members), len(stations)))
        design[np.arange(len(members)), np.searchsorted(stations, a[members])] += 1.0
        design[np.arange(len(members)), np.searchsorted(stations, b[members])] -= 1.0
        yield _DifferenceSet(numbers[members], stations, design, k, t)


def _find_arrivals(problem: Problem, differences: _DifferenceSet) -> tuple[Array, Array] | None:
    """Return arrival times (N, s), metres, and their variances (N or 1, s), square metres, of one epoch and target.

    The arrival times have mean zero, because the data do not determine a common offset. The result is None if the
    differences do not connect all stations, or if their covariance is not D diag(v) D'.
    """
    design, s = differences.design, len(differences.stations)
    # With fewer differences the stations fall into groups, and the arrivals of each group have a separate offset.
    if np.linalg.matrix_rank(design) < s - 1:
        return None
    covariance = dense(problem.noise, differences.rows)
    # D diag(v) D' is linear in v: (r * r, s) times v is the covariance, flattened
    products = (design[:, None] * design[None]).reshape(-1, s)
    flat = covariance.reshape(*covariance.shape[:-2], -1)
    variance = flat @ np.linalg.pinv(products).T
    scale = np.abs(flat).max(-1, keepdims=True)
    same = np.abs(variance @ products.T - flat) <= _EXACT * scale
    if not same.all() or (variance < -_EXACT * scale).any():
        return None
    variance = np.maximum(variance, _LEAST * variance.mean(-1, keepdims=True))
    # Least-squares arrivals of mean zero. Redundant differences agree, because their noise is a difference of arrivals.
    return problem.observed[:, differences.rows] @ np.linalg.pinv(design).T, variance.reshape(-1, s)


def _are_uncorrelated(noise: Noise, sets: list[_DifferenceSet], absent: Array) -> bool:
    """Return whether the differences of each epoch and target are uncorrelated with all other present rows.

    `sets` are the results of `_difference_sets`. `absent` (n,) are the global numbers of the absent range differences.
    Their correlations do not count.
    """
    for differences in sets:
        for block in noise.blocks:
            inside = np.isin(block.row, differences.rows)
            mixed = inside.any(1) & ~(inside | np.isin(block.row, absent)).all(1)
            if mixed.any():
                return False
    return True


def _assemble(problem: Problem, sets: list[_DifferenceSet], z: Array, variance: Array) -> Arrivals:
    """Return the problem that consists of the arrival times and of the rows of other kinds.

    `z` (N, n) are the arrival times, metres, and `variance` (N or 1, n) their variances. n counts the stations of all
    sets, in the order of `sets`.
    """
    sizes = [len(differences.stations) for differences in sets]
    station = np.concatenate([differences.stations for differences in sets])
    ones = np.ones(len(station))
    arrival = Rows(
        "toa",
        z,
        station,
        np.full(len(station), -1),
        np.repeat([differences.epoch for differences in sets], sizes),
        np.repeat([differences.target for differences in sets], sizes),
        ones,
        0.0 * ones,
    )
    # `origin` are the original rows of each new row. `number` is the new number of each original row; -1 for range
    # differences. Each arrival depends on all differences that involve its station.
    origin = [differences.rows[column != 0.0] for differences in sets for column in differences.design.T]
    rows, number = [arrival], np.full(problem.count, -1)
    count = len(station)
    for block, start in zip(problem.rows, problem.starts, strict=True):
        if block.kind != "tdoa":
            number[start : start + block.count] = count + np.arange(block.count)
            origin += [np.array([start + i]) for i in range(block.count)]
            rows.append(block)
            count += block.count
    variance = variance[0] if len(variance) == 1 else variance
    arrival_noise = Block(np.arange(len(station))[:, None], variance[..., None, None])
    noise = group([arrival_noise, *_keep_noise(problem.noise, number)])
    return Arrivals(replace(problem, rows=tuple(rows), noise=noise), tuple(origin))


def _keep_noise(noise: Noise, number: Array) -> Iterator[Block]:
    """Yield the noise blocks of the rows of other kinds, with the new row numbers.

    `number` (m,) is the new number of each original row, and -1 for range differences.
    """
    for block in noise.blocks:
        has_number = (number[block.row] >= 0).all(1)
        if has_number.any():
            covariance = (
                block.covariance if block.covariance.shape[-3] == 1 else block.covariance[..., has_number, :, :]
            )
            yield Block(number[block.row[has_number]], covariance)


def restore_order(layout: Layout, other: Layout, x: Array) -> Array:
    """Return parameter vectors x (..., size) of layout `other` in the order of `layout`.

    `other` contains all unknowns of `layout` and may contain more.

    The arrival-time problem orders its unknowns differently and adds emission times. The result has the order of the
    original problem.
    """
    shared, local = other.split(x)
    columns = []
    for slot in layout.local:
        start = other.find(slot.name)[0].start
        columns.append(local[..., start : start + slot.size])
    flat = [np.concatenate(columns, axis=-1).reshape(*x.shape[:-1], -1)] if columns else []
    return np.concatenate([shared[..., shared_places(layout, other)], *flat], axis=-1)


def shared_places(layout: Layout, other: Layout) -> Array:
    """Return the indices (n,), in layout `other`, of the n shared unknowns of `layout`."""
    starts = ((other.find(slot.name)[0].start, slot.size) for slot in layout.shared)
    return np.concatenate([np.arange(0), *(np.arange(start, start + size) for start, size in starts)])
