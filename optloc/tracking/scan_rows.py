"""Rows of the scans of a run as arrays, prepared once, so that each scan is one call of compiled code.

Scans have the same structure if their rows have the same kinds, stations and targets. Such scans share
one `ScanRows`.

Letters: m rows of a scan, n numbers of a state, G scans of one structure, N states of a batch (...).

Arguments of many functions: `problem` is the run, and `order` is the order of the state (0: position, 1:
with velocity, 2: with acceleration).
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from optloc.base import linalg
from optloc.base.cache import Cache
from optloc.base.types import Array, Motion
from optloc.kernels.filter import COLUMNS, VALUES, Filtered, Filtering, Move, ScanRows, filter_scan
from optloc.kernels.jit import is_available
from optloc.kernels.pack import sources
from optloc.kernels.tables import tables
from optloc.linear.normal import depends_on_place, with_station_noise
from optloc.problem.epochs import cut, has_correlated_epochs
from optloc.problem.noise import gathered, variances
from optloc.problem.problem import Problem

# Cache for scans that arrive one by one: a network has a few sets of rows that observe a target together, of some
# kilobytes each.
_KEPT = Cache["ScanRows | None"](256)


@dataclass(frozen=True, slots=True)
class Scans:
    """The scans of a run of one target for the compiled update.

    All shipped filters use these arrays. The general form of `optloc.tracking.updates` handles all other cases:
    kinds without a tape (compiled formula), biases among the states, and station errors whose noise depends on the
    position. It also handles noise that correlates epochs, batches with different stations or noise, and arrays of
    other libraries.

    - problem: the run, see `optloc.tracking.track.scans`; its model of motion is ignored.
    - order: order of the states (0: position, 1: with velocity, 2: with acceleration).
    - rows: rows of each of k scans; None for a scan of the general form, or without rows.
    - item: number of each scan among the scans with the same structure.
    - memory: length of the memory array of a track, see `filter_scan`.
    """

    problem: Problem
    order: int
    rows: list[ScanRows | None]
    item: list[int]
    memory: int

    @classmethod
    def of(cls, problem: Problem, order: int) -> Scans:
        """Return the scans of a run for states of an order."""
        rows: list[ScanRows | None] = [None] * problem.epochs
        item = [0] * problem.epochs
        if problem.count and is_available(filter_scan):
            observed, weight = problem.observed, problem.weight
            for epochs, index, kept in _structures(problem, order):
                made = kept
                if kept is not None:
                    made = kept._replace(z=_by_scan(observed, index), weight=_by_scan(weight, index))
                for i, k in enumerate(epochs.tolist()):
                    rows[k], item[k] = made, i
        most = max((made.z.shape[2] for made in rows if made is not None), default=0)
        errors = len(problem.rows) * int(problem.stations.places.shape[-2])
        return cls(problem, order, rows, item, COLUMNS + errors + most * ((order + 1) * problem.dimension + 2))

    def filtered(
        self,
        k: int,
        mean: Array,
        cov: Array,
        how: Filtering,
        move: Move | None = None,
        more: tuple[Array, Array] | None = None,
        memory: Array | None = None,
    ) -> Filtered | None:
        """Return states (..., n) after scan k, or None if the scan needs the general form.

        `mean` (..., n) and `cov` (..., n, n) are the states before the prediction `move`. `move` is None for
        states at the time of the scan. `how` is the filter. `more` replaces the measurements minus corrections
        (..., m) and the weights (..., m). `memory` is the array of a track with a single state, see
        `filter_scan`.
        """
        rows, n = self.rows[k], mean.shape[-1]
        if rows is None or type(mean) is not np.ndarray or rows.tables.shared != n:
            return None
        item, shape = self.item[k], mean.shape[:-1]
        if cov.ndim > 2:
            shape = np.broadcast_shapes(shape, cov.shape[:-2])
        if more is not None or shape or self.problem.batch_shape:
            rows, shape = self._spread(rows, item, more, shape)
            mean, cov = np.broadcast_to(mean, (*shape, n)), np.broadcast_to(cov, (*shape, n, n))
        count, move = math.prod(shape), move or _no_move(n)
        ahead = Move(owned(move.F), _per_state(move.Q, 2, shape), _per_state(move.drive, 1, shape))
        out = Filtered(np.empty((count, n)), np.empty((count, n, n)), np.empty((count, VALUES)))
        filter_scan(
            rows,
            item,
            ahead,
            _per_state(mean, 1, shape),
            _per_state(cov, 2, shape),
            how,
            _NONE if memory is None else memory,
            out,
        )
        if not shape:
            return Filtered(out.mean[0], out.cov[0], out.values[0])
        return Filtered(*(part.reshape(*shape, *part.shape[1:]) for part in out))

    def _spread(
        self, rows: ScanRows, item: int, more: tuple[Array, Array] | None, shape: tuple[int, ...]
    ) -> tuple[ScanRows, tuple[int, ...]]:
        """Return the rows of scan `item` with values for each state, and the common batch shape of rows and states.

        The values are measurements and weights (1, N or 1, m). `more` replaces them, as in `filtered`. `shape` is
        the batch shape of the states.
        """
        batch, m = self.problem.batch_shape, rows.z.shape[2]
        if more is None:
            own = (part[item if len(part) > 1 else 0] for part in (rows.z, rows.weight))
            more = tuple(part[0] if len(part) == 1 else part.reshape(*batch, m) for part in own)
            shape = np.broadcast_shapes(shape, batch)
        shape = np.broadcast_shapes(shape, *(part.shape[:-1] for part in more))
        z, weight = (_per_state(part, 1, shape)[None] for part in more)
        return rows._replace(z=z, weight=weight), shape


def owned(values: Array) -> Array:
    """Return an array of the type that the compiled code accepts: float, C order, writable."""
    return values if values.flags.carray and values.dtype == float else np.array(values, dtype=float, order="C")


def _per_state(values: Array, core: int, shape: tuple[int, ...]) -> Array:
    """Return values (..., core axes) of states (...) as (N, core axes), or (1, core axes) if all states share them.

    `core` is the number of core axes, and `shape` is the batch shape (...).
    """
    if values.ndim == core:
        return owned(values)[None]
    inner = values.shape[values.ndim - core :]
    return owned(np.broadcast_to(values, (*shape, *inner)).reshape(-1, *inner))


_NONE = np.zeros(0)
_SIGNS = {"range_sum": 1.0, "azimuth": 0.0, "elevation": 0.0}


def touched(problem: Problem) -> tuple[Array, Array]:
    """Return the error numbers of the stations of rows (m, 2), -1 for none, and the sign of the second station (m,).

    A station has one error for each kind of rows, in the order of the names of the kinds. The sign is 0 for angles,
    which have one station.
    """
    names = sorted({rows.kind for rows in problem.rows})
    count = problem.stations.places.shape[-2]
    first = np.repeat([names.index(rows.kind) * count for rows in problem.rows], [rows.count for rows in problem.rows])
    pairs = np.concatenate([np.stack([rows.a, rows.b], axis=1) for rows in problem.rows])
    # a ratio has the same signs as a difference
    sign = np.concatenate([np.full(rows.count, _SIGNS.get(rows.kind, -1.0)) for rows in problem.rows])
    return np.where(pairs >= 0, first[:, None] + pairs, -1).astype(np.int64), sign


@cache
def _no_move(n: int) -> Move:
    """Return the prediction step for no elapsed time: a state of n numbers does not change."""
    return Move(np.eye(n), np.zeros((n, n)), np.zeros(n))


def _is_plain(problem: Problem) -> bool:
    """Return whether the compiled filter supports the run.

    The state must be the only unknown, and a batch may differ only in measurements and weights.
    """
    stations = problem.stations
    shared = [(stations.position, 3), (stations.velocity, 3), (stations.axes, 4)]
    shared += [(covariance, 3) for _, _, covariance in stations.errors]
    shared += [(block.covariance, 3) for block in problem.noise.blocks]
    return (
        problem.count > 0
        and len(problem.motions) == 1
        and all(array is None or (type(array) is np.ndarray and array.ndim == core) for array, core in shared)
        and not (problem.biases or problem.emitting or stations.unknown_for)
        and not depends_on_place(problem)
        and not has_correlated_epochs(problem)
    )


def _structures(problem: Problem, order: int) -> Iterator[tuple[Array, Array, ScanRows | None]]:
    """Yield, for each structure of scans, its epochs (G,), their rows (G, m), and the prepared rows.

    The prepared rows are None if the compiled filter does not support the scans.
    """
    if problem.epochs == 1:
        one = np.zeros(1, dtype=np.int64), np.arange(problem.count)[None]
        made = _KEPT.find(_key(problem, order), lambda: _prepared(problem, order, *one) if _is_plain(problem) else None)
        yield *one, made
    elif _is_plain(problem):
        for epochs, index in _group_by_structure(problem):
            yield epochs, index, _prepared(problem, order, epochs, index)


def _key(scan: Problem, order: int) -> Hashable:
    """Return a cache key of a scan without its time, measurements and weights; `order` is the order of the state."""
    s = scan.stations
    arrays = [s.position, s.velocity, s.axes, s.covariance, s.velocity_covariance]
    arrays += [array for block in scan.noise.blocks for array in (block.covariance, block.row)]
    arrays += [array for rows in scan.rows for array in (rows.a, rows.b, rows.target)]
    numbers = tuple(None if array is None else (array.shape, array.tobytes()) for array in arrays)
    kinds, biases = tuple(rows.kind for rows in scan.rows), len(scan.biases)
    return (numbers, kinds, s.span, scan.frame, scan.medium, len(scan.motions), biases, order)


def _group_by_structure(problem: Problem) -> list[tuple[Array, Array]]:
    """Return the epochs (G,) of each structure of scans, and the indices of their rows (G, m)."""
    epoch = problem.epoch
    order = np.argsort(epoch, kind="stable")
    start = np.searchsorted(epoch[order], np.arange(problem.epochs + 1))
    kind = np.repeat(np.arange(len(problem.rows)), [block.count for block in problem.rows])
    parts = [np.concatenate([getattr(block, name) for block in problem.rows]) for name in ("a", "b", "target")]
    line = np.stack([kind, *parts], axis=1)[order]
    found: dict[bytes, list[int]] = {}
    for k, (first, last) in enumerate(zip(start.tolist(), start[1:].tolist(), strict=False)):
        if last > first:
            found.setdefault(line[first:last].tobytes(), []).append(k)
    out = []
    for members in found.values():
        epochs = np.array(members)
        count = start[members[0] + 1] - start[members[0]]
        out.append((epochs, order[start[epochs][:, None] + np.arange(count)]))
    return out


def _by_scan(values: Array, index: Array) -> Array:
    """Return values (..., m) at rows (G, r) as (G, N, r): N is the size of the flattened leading axes."""
    if index.shape[0] == 1 and values.ndim == 1:
        return values[index][None]
    picked = np.moveaxis(values[..., index], -2, 0)
    return np.ascontiguousarray(picked.reshape(len(index), -1, index.shape[1]))


def _prepared(problem: Problem, order: int, epochs: Array, index: Array) -> ScanRows | None:
    """Return prepared scans without measurements and weights, or None if a kind has no tape (compiled formula).

    `epochs` (G,) are the scans, and `index` (G, m) are their rows.
    """
    problem, m = with_station_noise(problem), index.shape[1]
    scan = _first_of(problem, order, epochs)
    found = tables(scan, (np.arange(m)[None],))
    if found is None or found.tables.local:
        return None
    # `white` are whitening matrices, and `total` is their `size_of`. Independent rows need neither: empty and zero.
    divided, white, total = sources(scan), np.zeros((1, 0)), np.zeros((1, 2))
    covariance = variances(problem.noise, problem.count)[index]
    if any(block.row.shape[1] > 1 for block in problem.noise.blocks):
        dense = gathered(problem.noise, index)
        if (dense * (1.0 - np.eye(m))).any():
            covariance = dense.reshape(len(index), m * m)
    # Variances (G, m) or covariances (G, m m); one line if all scans have the same.
    covariance = np.ascontiguousarray(covariance[:1] if (covariance == covariance[:1]).all() else covariance)
    if covariance.shape[1] > m:
        matrix = linalg.whitening(covariance.reshape(-1, m, m))
        white, total = np.ascontiguousarray(matrix.reshape(len(matrix), m * m)), size_of(matrix)
    # Placeholders for measurements and weights, which `Scans.of` replaces.
    none = np.zeros((1, 1, m))
    station, sign = touched(problem)
    pairs, signs = np.ascontiguousarray(station[index[0]]), sign[index[0]]
    return ScanRows(found.tables, divided.common, divided.own, covariance, white, total, none, none, pairs, signs)


def _first_of(problem: Problem, order: int, epochs: Array) -> Problem:
    """Return the first of some scans with the stations of all these scans, as a batch; `epochs` (G,) are the scans."""
    first, s = int(epochs[0]), problem.stations
    one = cut(replace(problem, motions=(Motion(order),), priors=(), constraints=()), first, first + 1)
    every = ((name, getattr(s, name)) for name in ("position", "velocity", "axes"))
    moving = {name: array[epochs][:, None] for name, array in every if array is not None and len(array) > 1}
    motion = Motion(order, reference=0.0)
    return replace(one, stations=replace(one.stations, **moving), times=np.zeros(1), motions=(motion,))


def size_of(white: Array) -> Array:
    """Return rank and ln det(2 pi R), (..., 2), of covariances R from their whitening matrices `white` (..., r, r).

    For a singular covariance, the determinant follows from the nonzero singular values of the matrix.
    """
    pivots = np.diagonal(white, axis1=-2, axis2=-1)
    if np.triu(white, 1).any():
        pivots = np.linalg.svd(white, compute_uv=False)
        # the matrix of a singular covariance has rows of zeros
        pivots = np.where(np.arange(white.shape[-1]) < (white != 0.0).any(-1).sum(-1, keepdims=True), pivots, 0.0)
    present = pivots > 0.0
    logdet = np.log(2.0 * np.pi) * present.sum(-1) - 2.0 * np.log(np.where(present, pivots, 1.0)).sum(-1)
    return np.stack([present.sum(-1).astype(float), logdet], axis=-1)
