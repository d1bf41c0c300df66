"""The numbers of problems as plain arrays for the compiled kernels; `optloc.kernels.tables` has the indices.

Numbers that all problems share are stored once; the other numbers have one row for each problem. Letters: N problems or
runs, m rows, k epochs of a run, r rows of a group or epoch. A *group* contains rows whose noise is correlated; g is a
number of groups.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from optloc.base.cache import Cache
from optloc.base.types import Array, Bias, Rows
from optloc.kernels.tables import Sources, Tables, tables
from optloc.linear.courses import over_ground
from optloc.linear.normal import prior_parts
from optloc.models import MODELS
from optloc.models.primitives import WGS84_A
from optloc.problem.forms import form_of
from optloc.problem.noise import Block, Noise, Whitener, variances
from optloc.problem.problem import Problem

# Columns of `Numbers.place`. For a group: the index of its whitening matrix, and 1 unless the matrix is lower
# triangular. For a prior: the index of its mean, followed by its precision; the first unknown, the number of unknowns,
# and 1 for unknowns of an epoch.
AT, FULL = range(2)
PRIOR_START, PRIOR_SIZE, PRIOR_LOCAL = range(1, 4)
_COLUMNS = 4


class Numbers(NamedTuple):
    """The numbers of N problems; numbers that all problems share are stored once.

    An array (N or 1, ...) has one row if the problems share it. An index >= 0 counts in the shared numbers, an index of
    -1 - i in the numbers of each problem: sources, whitening matrices, priors.
    """

    common: Array  # shared numbers: zero; stations, rates, axes, known targets; whitening matrices; priors
    place: Array  # int64 (groups + priors, 4): the columns above
    source: Array  # (N or 1, ...)
    white: Array  # (N or 1, ...)
    prior: Array  # (N or 1, ...)
    observed: Array  # (N or 1, m): measurements less corrections
    present: Array  # (N or 1, m): 1 for a present row, else 0; (1, 0) if all rows are present
    sigma: Array  # (N or 1, m): standard deviations of the rows
    size: Array  # (m,): size of other numbers whose rounding enters the row's value


class Packed(NamedTuple):
    """Problems in the form that the compiled kernels take.

    Parameters
    ----------
    tables : Tables
        Indices, the same for all problems.
    numbers : Numbers
        Arrays.
    """

    tables: Tables
    numbers: Numbers


def pack(problem: Problem, noise: tuple[Whitener, ...]) -> Packed | None:
    """Return a flat batch of problems for the compiled kernels, or None if the kernels do not support them.

    Parameters
    ----------
    problem : Problem
        N problems, or one problem without a batch axis.
    noise : tuple of Whitener
        Whitening matrices of their rows.
    """
    kept = tables(problem, tuple(w.row for w in noise))
    if kept is None:
        return None
    source, white, prior = sources(problem), _whiteners(noise), _priors(problem)
    # The indices of one kind of numbers follow the indices of the kind before.
    for one, before in ((white, (source,)), (prior, (source, white))):
        shared, own = (sum(part.size(mine) for part in before) for mine in (False, True))
        one.place[:, AT] += np.where(one.place[:, AT] >= 0, shared, -own)
    # An empty array means that all rows are present, so that no kernel reads it.
    weight = problem.weight
    present = np.zeros((1, 0)) if np.all(weight > 0.0) else _contiguous(weight > 0.0, 1)
    return Packed(
        kept.tables,
        Numbers(
            np.concatenate([source.common, white.common, prior.common]),
            np.concatenate([white.place[kept.number], prior.place]),
            source.own,
            white.own,
            prior.own,
            observed(problem),
            present,
            _contiguous(np.sqrt(variances(problem.noise, problem.count)), 1),
            coarseness(problem),
        ),
    )


class PackedRuns(NamedTuple):
    """Runs in the form for machine code: their epochs as problems (`packed`), and the number of epochs of a run."""

    packed: Packed
    epochs: int


def pack_runs(problem: Problem, noise: tuple[Whitener, ...]) -> PackedRuns | None:
    """Return a flat batch of N runs for machine code, or None if the structures of their epochs differ.

    Parameters
    ----------
    problem : Problem
        N runs, whose epochs have local unknowns.
    noise : tuple of Whitener
        Whitening matrices of their rows.
    """
    found = folding(problem)
    if found is None:
        return None
    flat = problem.flat()
    own = fold_whiteners(noise, found, flat.batch_shape[0])
    packed = None if own is None else pack(fold(flat, found), own)
    return None if packed is None else PackedRuns(packed, problem.epochs)


def coarseness(problem: Problem) -> Array:
    """Return the size (m,) of the numbers, other than the measurement, whose rounding enters the value of each row."""
    # courses over ground are computed from the centre of the Earth
    far = [MODELS[rows.kind].ecef or over_ground(problem) for rows in problem.rows]
    return np.repeat(np.where(far, WGS84_A, 0.0), [rows.count for rows in problem.rows])


def observed(problem: Problem) -> Array:
    """Return the measurements less corrections of a flat batch of problems, (N or 1, m), for `Numbers.observed`."""
    if len(problem.rows) == 1 and not problem.rows[0].correction.any():
        return _contiguous(problem.rows[0].z, 1)
    return _contiguous(problem.observed, 1)


def _contiguous(values: Array, core: int) -> Array:
    """Return an array as contiguous doubles (N or 1, numbers); its last `core` axes belong to one problem."""
    shape = values.shape
    flat = values.reshape(shape[0] if len(shape) > core else 1, int(np.prod(shape[len(shape) - core :])))
    return np.require(flat, np.float64, ["C", "W"])


@dataclass(frozen=True, slots=True)
class Divided:
    """Numbers of several parts, split into shared numbers and numbers of each problem.

    `common` (numbers,) are the shared numbers, `own` (N or 1, numbers) the others. `place` (parts, 4) begins with the
    index of each part: >= 0 in `common`, or -1 - its index in `own`.
    """

    common: Array
    own: Array
    place: Array

    def size(self, own: bool) -> int:
        """Return the number of separate numbers of a problem if `own` is True, else the number of shared ones."""
        return self.own.shape[1] if own else len(self.common)

    @classmethod
    def of(cls, parts: list[Array]) -> Divided:
        """Return parts (N or 1, numbers) split into shared and separate numbers.

        A part with one row is shared.
        """
        place, lengths = np.zeros((len(parts), _COLUMNS), dtype=np.int64), [0, 0]
        for i, part in enumerate(parts):
            mine = int(len(part) > 1)
            place[i, AT] = -1 - lengths[1] if mine else lengths[0]
            lengths[mine] += part.shape[1]
        shared, own = ([part for part in parts if (len(part) > 1) == mine] for mine in (False, True))
        flat = np.concatenate([part[0] for part in shared]) if shared else np.zeros(0)
        if len(own) > 1:
            # A single array of separate numbers, mostly the stations, is used without a copy.
            own = [np.concatenate(own, axis=1)]
        return cls(flat, own[0] if own else np.zeros((1, 0)), place)


def sources(problem: Problem) -> Divided:
    """Return the data arrays of a flat batch of problems, see `optloc.kernels.tables.Sources`."""
    parts = [_contiguous(array, core) for array, core in Sources.of(problem).arrays]
    return Divided.of([np.zeros((1, 1)), *parts])


def _whiteners(noise: tuple[Whitener, ...]) -> Divided:
    """Return whitening matrices as `Divided`, with one line of `place` for each group."""
    divided, lines = Divided.of([_contiguous(w.matrix, 3) for w in noise]), []
    for start, w in zip(divided.place[:, AT], noise, strict=True):
        count, size = w.row.shape
        step = size * size if w.matrix.shape[-3] > 1 else 0
        line = np.zeros((count, _COLUMNS), dtype=np.int64)
        line[:, AT] = start + (step if start >= 0 else -step) * np.arange(count)
        line[:, FULL] = np.triu(w.matrix, 1).reshape(-1, w.matrix.shape[-3], size * size).any((0, 2))
        lines.append(line)
    return Divided(divided.common, divided.own, np.concatenate(lines))


def _priors(problem: Problem) -> Divided:
    """Return the means and precisions of the priors as `Divided`, with one line of `place` for each prior."""
    layout, parts, heads = problem.layout, [], []
    for name, mean, precision in prior_parts(problem):
        slot, shared = layout.find(name)
        arrays = (mean, precision) if shared else (_single(mean, 1), _single(precision, 2))
        both = (_contiguous(arrays[0], 1), _contiguous(arrays[1], 2))
        count = max(len(part) for part in both)
        parts.append(np.concatenate([np.broadcast_to(part, (count, part.shape[1])) for part in both], axis=1))
        heads.append((slot.start, slot.size, int(not shared)))
    divided = Divided.of(parts)
    divided.place[:, 1:] = np.array(heads, dtype=np.int64).reshape(-1, 3)
    return divided


def _single(values: Array, core: int) -> Array:
    """Return values of one epoch without the epoch axis of length one, if they have this axis."""
    return np.take(values, 0, axis=-1 - core) if values.ndim > core else values


# Epochs with equal rows are treated as a flat batch of problems of one epoch: then each lane is an epoch.


@dataclass(frozen=True, slots=True)
class Folding:
    """The common rows of the epochs of a run.

    Parameters
    ----------
    rows : tuple of int array (k, r)
        For each kind, the rows of each epoch, numbered within the kind.
    local : int array (m,)
        Number of each row of the run within its epoch.
    epoch : int array (m,)
        Epoch of each row of the run.
    touches : tuple of int array (n,)
        For each bias, its entries in the rows of one epoch.
    """

    rows: tuple[Array, ...]
    local: Array
    epoch: Array
    touches: tuple[Array, ...]

    @property
    def epochs(self) -> int:
        """Return the number of epochs."""
        return len(self.rows[0])

    def groups(self, row: Array) -> tuple[Array, Array] | None:
        """Return the groups (q, r) of rows of one epoch, and their numbers (k, q) in each epoch.

        `row` (g, r) are the groups of the run. The result is None if a group has rows of several epochs, or if the
        groups of two epochs differ.
        """
        epoch, local = self.epoch[row], self.local[row]
        own = _entries_of_epochs(epoch[:, 0], self.epochs, local)
        return None if own is None or (epoch != epoch[:, :1]).any() else (local[own[0]], own)


def _entries_of_epochs(epoch: Array, epochs: int, *values: Array) -> Array | None:
    """Return the entries (k, q) of each epoch, or None if they differ between epochs.

    `epoch` (n,) is the epoch of each entry. The arrays `values` (n, ...) must be equal in all epochs, also in order.
    """
    if not len(epoch) or len(epoch) % epochs:
        return np.zeros((epochs, 0), dtype=np.int64) if not len(epoch) else None
    own = np.argsort(epoch, kind="stable").reshape(epochs, -1)
    same = (epoch[own] == np.arange(epochs)[:, None]).all() and all((v[own] == v[own[:1]]).all() for v in values)
    return own if same else None


_KEPT = Cache["Folding | None"](2**19, lambda folding: 1 if folding is None else len(folding.local))


def folding(problem: Problem) -> Folding | None:
    """Return the common rows of the epochs of a run, or None if the structures of the epochs differ.

    The result requires that local unknowns, targets at rest and biases that do not depend on the time enter each epoch
    in the same way.
    """
    if problem.epochs == 1 or any(m.order or m.known is not None or m.rise is not None for m in problem.motions):
        return None
    return _KEPT.find(("folding", problem.structure), lambda: _fold(problem))


def _fold(problem: Problem) -> Folding | None:
    """Return the common rows of the epochs, see `folding`."""
    k, rows, local, start = problem.epochs, [], np.zeros(problem.count, dtype=np.int64), 0
    for block, first in zip(problem.rows, problem.starts, strict=True):
        own = _entries_of_epochs(block.epoch, k, block.a, block.b, block.target)
        if own is None:
            return None
        rows.append(own)
        local[first + own] = start + np.arange(own.shape[1])
        start += own.shape[1]
    epoch, touches = problem.epoch, []
    for bias in problem.biases:
        own = _entries_of_epochs(epoch[bias.row], k, local[bias.row], bias.member, bias.coefficient)
        form = form_of(bias)
        # Errors that depend on the time are a different function of their unknowns in each epoch.
        if own is None or form.changes or form.enters == "moves":
            return None
        touches.append(own[0])
    found = Folding(tuple(rows), local, epoch, tuple(touches))
    return found if all(found.groups(block.row) is not None for block in problem.noise.blocks) else None


def fold(problem: Problem, found: Folding) -> Problem:
    """Return the epochs of a flat batch of N runs as a flat batch of N k problems, sorted by run, then by epoch.

    Unknowns that the epochs share are unknowns of each problem, and have the priors of the run.

    Parameters
    ----------
    problem : Problem
        N runs of k epochs.
    found : Folding
        Common rows of the epochs.
    """
    count, k = problem.batch_shape[0], problem.epochs

    def spread(array: Array | None, core: int) -> Array | None:
        """Return an array for the batch of epochs, from an array with an axis of epochs of length 1 or k.

        `core` is the number of axes of one run, of which the axis of epochs is the first. A result without batch axis
        is shared by all epochs.
        """
        if array is None or (array.ndim == core and array.shape[0] == 1):
            return array
        whole = np.broadcast_to(array, (count, k, *array.shape[array.ndim - core + 1 :]))
        return whole.reshape(count * k, 1, *whole.shape[2:])

    def repeat(array: Array | None, core: int) -> Array | None:
        """Return an array for the batch of epochs, repeated for the epochs of each run.

        `core` is the number of axes of one run. Arrays that all runs share are returned unchanged.
        """
        return array if array is None or array.ndim == core or len(array) == 1 else np.repeat(array, k, axis=0)

    s = problem.stations
    position = spread(s.position, 3)
    assert position is not None
    stations = replace(
        s,
        position=position,
        velocity=spread(s.velocity, 3),
        axes=spread(s.axes, 4),
        covariance=repeat(s.covariance, 3),
        velocity_covariance=repeat(s.velocity_covariance, 3),
    )
    blocks = [Block(*_fold_groups(block.row, block.covariance, found, count)) for block in problem.noise.blocks]
    priors = tuple(
        replace(p, mean=np.asarray(repeat(p.mean, 1)), covariance=np.asarray(repeat(p.covariance, 2)))
        for p in problem.priors
    )
    return replace(
        problem,
        stations=stations,
        rows=tuple(_fold_rows(rows, own, count) for rows, own in zip(problem.rows, found.rows, strict=True)),
        noise=Noise(tuple(blocks)),
        times=problem.times[:1],
        biases=tuple(_fold_bias(bias, own, found) for bias, own in zip(problem.biases, found.touches, strict=True)),
        priors=priors,
        constraints=(),
    )


def _fold_bias(bias: Bias, own: Array, found: Folding) -> Bias:
    """Return a bias for the batch of epochs `found`; `own` are its entries in the rows of one epoch."""
    return replace(bias, row=found.local[bias.row[own]], member=bias.member[own], coefficient=bias.coefficient[own])


def fold_whiteners(noise: tuple[Whitener, ...], found: Folding, count: int) -> tuple[Whitener, ...] | None:
    """Return the whitening matrices of `count` runs for the batch of `fold`; `found` are the common rows of epochs.

    The result is None if the groups of two epochs differ.
    """
    if any(found.groups(whitener.row) is None for whitener in noise):
        return None
    return tuple(Whitener(*_fold_groups(whitener.row, whitener.matrix, found, count)) for whitener in noise)


def _fold_rows(rows: Rows, own: Array, count: int) -> Rows:
    """Return rows of one kind for the batch of epochs of `count` runs; `own` (k, r) are the rows of each epoch."""
    first = own[0]
    return replace(
        rows,
        z=_fold_values(rows.z, own, count),
        weight=_fold_values(rows.weight, own, count),
        correction=_fold_values(rows.correction, own, count),
        a=rows.a[first],
        b=rows.b[first],
        epoch=np.zeros(len(first), dtype=np.int64),
        target=rows.target[first],
    )


def _fold_values(values: Array, own: Array, count: int) -> Array:
    """Return values (N or none, m) of rows as (N k, r), or (r,) if all epochs have the same values.

    `own` (k, r) are the rows of each epoch, `count` is N.
    """
    picked = values[..., own]
    if values.ndim == 1 and (picked == picked[:1]).all():
        return np.asarray(picked[0])
    return np.broadcast_to(picked, (count, *own.shape)).reshape(-1, own.shape[1])


def _fold_groups(row: Array, matrix: Array, found: Folding, count: int) -> tuple[Array, Array]:
    """Return groups (g, r) and matrices (N or none, g or 1, r, r) for the batch of epochs.

    `found` are the common rows of the epochs, `count` is N.
    """
    groups = found.groups(row)
    assert groups is not None
    local, own = groups
    if matrix.shape[-3] == 1:
        shared = matrix.ndim == 3 or len(matrix) == 1
        return local, matrix.reshape(matrix.shape[-3:]) if shared else np.repeat(matrix, len(own), axis=0)
    picked = matrix[..., own, :, :]
    if matrix.ndim == 3 and (picked == picked[:1]).all():
        return local, picked[0]
    whole = np.broadcast_to(picked, (count, *own.shape, *matrix.shape[-2:]))
    return local, whole.reshape(-1, own.shape[1], *matrix.shape[-2:])
