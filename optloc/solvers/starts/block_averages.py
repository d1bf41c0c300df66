"""Block averages: a long run as a short run with the same unknowns, as the start of a fix.

A *block* is a number of consecutive epochs. A line is fitted to the old rows of a block with the same kind, stations
and target. The new row is the value of this line in the middle of the block.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from scipy import sparse

from optloc.base.types import Array, Bias, Rows, Stations
from optloc.linear.normal import with_station_noise
from optloc.models import MODELS
from optloc.models.primitives import wrap
from optloc.problem.epochs import cut, epochs_of, joined
from optloc.problem.noise import Block, Noise, group_members
from optloc.problem.problem import Problem

# A block that lasts this many times the median duration contains a gap, and a line through its values is meaningless.
_GAP = 2.0


def average_blocks(problem: Problem, count: int) -> Problem:
    """Return the run as blocks with an equal number of epochs, with the values of its rows in the middle of each block.

    Blocks have equal length, so that an average ignores the same curvature in all of them, and a bias absorbs it. The
    last epochs that do not fill a block are dropped. Blocks with a gap in time are dropped too.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs of k epochs; states last the whole run. Station errors become noise.
    count : int
        Number of blocks wanted; at most twice as many result.

    Returns
    -------
    Problem
        Batch (...) with one epoch per block. A line through the values of a row gives its value in the middle of the
        block. A row exists if it is present in all problems of the batch. Biases are unchanged, and states have the
        same reference time.
    """
    length = max(1, problem.epochs // count)
    # the run is too short for averages: its epochs are the blocks
    if length == 1:
        return _with_station_noise(problem)
    last = length * (problem.epochs // length)
    # seconds from the first epoch of each block to its last
    lasting = problem.times[length - 1 : last : length] - problem.times[:last:length]
    longest = _GAP * float(np.median(lasting))
    # parts of whole blocks that fit the memory, so that a long run is never copied as a whole
    stretch = length * max(1, epochs_of(problem, int(np.prod(problem.batch_shape))) // length)
    if stretch >= last:
        return _blocks(_with_station_noise(problem), length, longest)
    parts = (cut(problem, first, min(first + stretch, last)) for first in range(0, last, stretch))
    return reduce(joined, (_blocks(_with_station_noise(part), length, longest) for part in parts))


def _blocks(problem: Problem, length: int, longest: float) -> Problem:
    """Return the blocks of a given length (epochs) of a run, except those that last longer than `longest` seconds."""
    blocks = problem.epochs // length
    times = problem.times[: blocks * length].reshape(blocks, length)
    kept = np.flatnonzero(times[:, -1] - times[:, 0] <= longest)
    middle = 0.5 * (times[kept, 0] + times[kept, -1])
    place = np.full(problem.epochs, -1)
    place[(kept[:, None] * length + np.arange(length)).ravel()] = np.repeat(np.arange(len(kept)), length)
    since = np.zeros(problem.epochs)
    # seconds since the middle of the block of each epoch
    since[place >= 0] = (times[kept] - middle[:, None]).ravel()
    when = _Blocks(place, since, middle)
    present = np.asarray((problem.weight > 0.0).reshape(-1, problem.count).all(0))
    means: list[_Mean] = []
    taken = 0
    for kind, start in zip(problem.rows, problem.starts, strict=True):
        means.append(_means(kind, when, present[start : start + kind.count], start, taken))
        taken += len(means[-1].first)
    rows = tuple(_average_rows(block, mean) for block, mean in zip(problem.rows, means, strict=True))
    return replace(
        problem,
        stations=_stations(problem.stations, when),
        rows=rows,
        noise=_noise(problem, means, np.concatenate([block.epoch for block in rows])),
        times=middle,
        motions=tuple(
            replace(m, reference=_reference(problem, m.reference), rise=_rise_at(problem.times, m.rise, middle))
            for m in problem.motions
        ),
        biases=tuple(_bias(bias, np.concatenate([mean.first for mean in means])) for bias in problem.biases),
    )


@dataclass(frozen=True, slots=True)
class _Blocks:
    """The division of k epochs into b blocks.

    `place` (k,) is the block of each epoch, -1 for none. `since` (k,) are the seconds since the middle of this block.
    `middle` (b,) are the times of the middles, seconds.
    """

    place: Array
    since: Array
    middle: Array


@dataclass(frozen=True, slots=True)
class _Mean:
    """The old rows of a kind in each new row, sorted by block, with their coefficients.

    `order` (e,) are the old rows, numbers within the kind, and `coefficient` (e,) their factors. `row` (e,) is the new
    row of each. `head` are the first entries of the new rows among the e old rows. `block` and `first` give the block
    of each new row and the global number of one of its old rows. `start` and `taken` are the numbers of the first old
    and the first new row of the kind.
    """

    order: Array
    head: Array
    row: Array
    coefficient: Array
    block: Array
    first: Array
    start: int
    taken: int


def _with_station_noise(problem: Problem) -> Problem:
    """Return the problem with its station errors of each epoch in the noise."""
    return with_station_noise(replace(problem, stations=problem.stations.with_noise()))


def _reference(problem: Problem, reference: float | None) -> float:
    """Return the reference time of a motion, seconds; by default the first epoch."""
    return float(problem.times[0]) if reference is None else reference


def _rise_at(times: Array, rise: Array | None, middle: Array) -> Array | None:
    """Return the known shape of a height (..., b, 2) at the middles (b,) of b blocks; None without a known shape.

    The shape `rise` (..., k, 2) at the times (k,) of the epochs is interpolated linearly.
    """
    if rise is None:
        return None
    after = np.clip(np.searchsorted(times, middle), 1, len(times) - 1)
    share = ((middle - times[after - 1]) / (times[after] - times[after - 1]))[:, None]
    return np.asarray(rise[..., after - 1, :] * (1.0 - share) + rise[..., after, :] * share)


def _means(rows: Rows, when: _Blocks, present: Array, start: int, taken: int) -> _Mean:
    """Return the averages of the rows of a kind as combinations of old rows.

    `when` is the division into blocks, and `present` flags the old rows to use. `start` is the global number of their
    first row, and `taken` the number of new rows of earlier kinds.
    """
    inside = np.flatnonzero((when.place[rows.epoch] >= 0) & present)
    key = np.stack([when.place[rows.epoch], rows.a, rows.b, rows.target])[:, inside]
    # lexsort takes its last key first: block, then stations, then target
    order = np.lexsort(key[::-1])
    key, order = key[:, order], inside[order]
    new = np.ones(len(order), dtype=bool)
    # an entry that differs from the entry before begins a new row
    new[1:] = (key[:, 1:] != key[:, :-1]).any(0)
    head, row = np.flatnonzero(new), np.cumsum(new) - 1
    since = when.since[rows.epoch[order]]
    coefficient = _line_coefficients(since, row)
    return _Mean(order, head, row, coefficient, key[0][head], start + order[head], start, taken)


def _line_coefficients(since: Array, row: Array) -> Array:
    """Return the coefficients (e,) of old values in new rows: the line through the values of a new row at time zero.

    `since` (e,) are seconds since the middle of the block, and `row` (e,) the new row of each old value.
    """
    total = [np.bincount(row, since**j) for j in range(3)]
    spread = total[0] * total[2] - total[1] ** 2
    # Values at one time have no slope. By the inequality of Cauchy and Schwarz the spread is between zero and the
    # product. Below a millionth of the product the slope is rounding, so such rows use the plain mean.
    line = spread > 1e-6 * total[0] * total[2]
    slope = np.where(line, total[1], 0.0)[row] * since
    level = np.where(line, total[2], 1.0)[row]
    return np.asarray((level - slope) / np.where(line, spread, total[0])[row])


def _average_rows(rows: Rows, mean: _Mean) -> Rows:
    """Return the averaged rows of one kind; angles are averaged relative to one angle of their row.

    `mean` has the old rows of each new row, with their coefficients.
    """

    def middle(values: Array, wrapped: bool) -> Array:
        sorted_, base = values[..., mean.order], np.zeros(())
        if wrapped:
            base = sorted_[..., mean.head]
            # angles are averaged relative to the first angle of their row: within half a turn of it there is no jump
            sorted_ = wrap(sorted_ - base[..., mean.row])
        if not len(mean.head):
            return sorted_
        return np.asarray(base + np.add.reduceat(sorted_ * mean.coefficient, mean.head, axis=-1))

    one = mean.order[mean.head]
    z = middle(rows.z, MODELS[rows.kind].period is not None)
    # the weights of old rows are in the noise of the new rows, so new rows have weight one
    weight, correction = np.ones(len(one)), middle(rows.correction, wrapped=False)
    return Rows(rows.kind, z, rows.a[one], rows.b[one], mean.block, rows.target[one], weight, correction)


def _stations(stations: Stations, when: _Blocks) -> Stations:
    """Return the stations with positions, velocities and axes averaged over blocks."""
    inside = np.flatnonzero(when.place >= 0)
    coefficient = _line_coefficients(when.since[inside], when.place[inside])
    head = np.flatnonzero(np.diff(when.place[inside], prepend=-1))

    def middle(values: Array | None, core: int) -> Array | None:
        if values is None or values.shape[-core] == 1:
            return values
        # epochs last: reduceat adds along the last axis
        moved = np.moveaxis(values, -core, -1)[..., inside]
        return np.moveaxis(np.add.reduceat(moved * coefficient, head, axis=-1), -1, -core)

    position = middle(stations.position, 3)
    assert position is not None
    axes = middle(stations.axes, 4)
    if axes is not None and axes is not stations.axes:
        left, _, right = np.linalg.svd(axes)  # the rotation nearest to the mean of rotations
        axes = left @ right
    return replace(stations, position=position, velocity=middle(stations.velocity, 3), axes=axes)


def _noise(problem: Problem, means: list[_Mean], block: Array) -> Noise:
    """Return the covariance of the new rows, C R C', with one noise block for each block of epochs.

    R is the covariance of the old rows, and C has the coefficients of old rows in new rows, from the `means` of each
    kind. `block` is the block of each new row.
    """
    count, size = problem.count, sum(len(mean.head) for mean in means)
    # C (new rows, old rows) is sparse
    entries = [(mean.taken + mean.row, mean.start + mean.order, mean.coefficient) for mean in means]
    place, old, coefficient = (np.concatenate([entry[i] for entry in entries]) for i in range(3))
    C = sparse.csr_array((coefficient, (place, old)), shape=(size, count))
    covariance = (C @ _sparse(problem) @ C.T).tocsr()
    blocks = []
    for members in group_members(block):
        one, two = np.broadcast_arrays(members[:, :, None], members[:, None, :])
        values = np.asarray(covariance[one.ravel(), two.ravel()]).reshape(one.shape)
        blocks.append(Block(members, values))
    return Noise(tuple(blocks))


def _sparse(problem: Problem) -> sparse.csr_array:
    """Return the covariance of all rows (m, m) as a sparse matrix; for a batch, the mean of all problems."""
    parts = []
    for block in problem.noise.blocks:
        covariance = block.covariance.reshape(-1, *block.covariance.shape[-3:]).mean(0)
        one, two = np.broadcast_arrays(block.row[:, :, None], block.row[:, None, :])
        parts.append((np.broadcast_to(covariance, one.shape).ravel(), one.ravel(), two.ravel()))
    value, one, two = (np.concatenate([part[i] for part in parts]) for i in range(3))
    return sparse.csr_array((value, (one, two)), shape=(problem.count, problem.count))


def _bias(bias: Bias, first: Array) -> Bias:
    """Return the bias with the effect on the new rows; `first` is the number of one old row of each new row."""
    # old rows of one new row have the same stations and target, so a bias affects all of them equally
    new = np.full(int(max(first.max(initial=0), bias.row.max(initial=0))) + 1, -1)
    new[first] = np.arange(len(first))
    kept = new[bias.row] >= 0
    return replace(bias, row=new[bias.row[kept]], member=bias.member[kept], coefficient=bias.coefficient[kept])
