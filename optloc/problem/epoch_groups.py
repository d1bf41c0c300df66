"""Groups of epochs with one structure, as batches. The stations of each epoch are data, so they can differ.

A run often has epochs that different stations received. One compiled plan solves all epochs of a group at once.

Letters: k epochs of the run, n epochs of a group, r rows of an epoch, s stations of an epoch, m rows of the run.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.arrays import first_rows
from optloc.base.types import Array, Rows, Stations
from optloc.problem.epochs import by_epoch, rows_by_epoch, separable, states_by_epoch
from optloc.problem.explanations import Explanation
from optloc.problem.fix import Fix
from optloc.problem.noise import Block, Noise, gathered, group
from optloc.problem.problem import Problem, map_numbers

# Private-use characters around the number of a station. No station name contains them.
_MARK = re.compile("\ue000(\\d+)\ue001")


@dataclass(frozen=True, slots=True)
class EpochGroup:
    """Epochs of a run that have the same structure. Only their numbers and their stations differ.

    Parameters
    ----------
    epochs : int array (n,)
        Epochs of the run, in increasing order.
    run : Problem
        The run.
    rows : int array (n, r), optional
        Row numbers of each epoch, in the same order of kinds; None if `by_epoch` makes the batch.
    ends : int array (2, r), optional
        First and second stations of these rows, as station numbers in the batch.
    stations : int array (n, s), optional
        Station number in the run of each station of the batch; None if the batch has the stations of the run.
    """

    epochs: Array
    run: Problem
    rows: Array | None = None
    ends: Array | None = None
    stations: Array | None = None

    @property
    def problem(self) -> Problem:
        """Return the epochs as a flat batch of n problems."""
        if self.rows is None or self.ends is None:
            return by_epoch(self.run).take(self.epochs)
        epochs = self.epochs
        # The stations, states, priors and constraints of these epochs, without rows. An array with only its own axes
        # (`core`) has no epoch axis: all epochs share it.
        bare = map_numbers(
            states_by_epoch(self.run), lambda array, core: array if array.ndim == core else array[epochs]
        )
        stations = bare.stations if self.stations is None else _stations_of(bare.stations, self.stations)
        block = np.searchsorted(self.run.starts, self.rows[0], side="right") - 1
        made = []
        for number, one in enumerate(self.run.rows):
            members = np.flatnonzero(block == number)
            if len(members):
                made.append(_batch_rows(one, self.rows[:, members] - self.run.starts[number], *self.ends[:, members]))
        return replace(bare, stations=stations, rows=tuple(made), noise=_batch_noise(self.run.noise, self.rows)).flat()

    def take(self, items: slice) -> EpochGroup:
        """Return some of the epochs as a group; `items` selects positions in `epochs`."""
        rows, stations = (None if array is None else array[items] for array in (self.rows, self.stations))
        return EpochGroup(self.epochs[items], self.run, rows, self.ends, stations)

    def parts(self, most: int) -> Iterator[EpochGroup]:
        """Yield parts of the group with at most `most` epochs each."""
        yield from (self.take(slice(first, first + most)) for first in range(0, len(self.epochs), most))

    def label(self, text: str, item: int) -> str:
        """Return `text`, in which placeholders of stations are replaced by their names in the run.

        `item` is the number of the problem in the batch.
        """
        if self.stations is None:
            return text
        numbers = self.stations[item]
        return _MARK.sub(lambda match: self.run.stations.names[numbers[int(match[1])]], text)

    def name(self, fix: Fix) -> Fix:
        """Return the fixes of the batch with the names that their stations have in the run.

        Reasons and suspects of a fix contain placeholders for stations, because the problems of a batch share their
        names.
        """
        if self.stations is None:
            return fix
        reason = fix.reason.copy()
        for i, text in enumerate(reason.tolist()):
            if "\ue000" in text:
                reason[i] = self.label(text, i)
        if fix.explanations is None:
            return replace(fix, reason=reason)
        explanations = np.empty(len(reason), dtype=object)
        for i, explanations_of_fix in enumerate(fix.explanations):
            explanations[i] = tuple(self._name_suspects(one, i) for one in explanations_of_fix)
        return replace(fix, reason=reason, explanations=explanations)

    def _name_suspects(self, one: Explanation, item: int) -> Explanation:
        """Return the explanation with the station names of the run; `item` is the number of the problem."""
        return replace(one, suspects=tuple(replace(s, name=self.label(s.name, item)) for s in one.suspects))


def epoch_groups(problem: Problem) -> tuple[EpochGroup, ...]:
    """Return groups of the epochs of a run, each with one structure. The epochs share no unknown.

    Epochs of a group have the same number of rows of each kind, and these rows link their stations in the same way. If
    all epochs have the same rows, the result is the batch of `by_epoch`.

    Parameters
    ----------
    problem : Problem
        A separable run, without batch axes.
    """
    assert separable(problem)
    one_group = (EpochGroup(np.arange(problem.epochs), problem),)
    # A plan contains the names of stations with unknown errors, and the axes of stations, so stations must not differ.
    if problem.batch_shape or problem.stations.unknown_for or problem.stations.axes is not None:
        return one_group
    table = _RowTable.of(problem)
    groups = [_epoch_group(problem, table, epochs, rows) for epochs, rows in table.alike()]
    layouts = [one.take(slice(1)).problem.layout if one.rows is not None and one.rows.size else None for one in groups]
    # Epochs without rows, or without an unknown that other epochs have, fit into one common batch only.
    return one_group if any(layout != layouts[0] or layout is None for layout in layouts) else tuple(groups)


def problem_of(groups: Sequence[EpochGroup], epoch: int) -> Problem:
    """Return the problem of one epoch, as a flat batch of one, with the station names of the run.

    `groups` are the groups of the run. `epoch` is the number of the epoch in the run. Raise LookupError if no group
    contains it.
    """
    for one in groups:
        item = int(np.searchsorted(one.epochs, epoch))
        if item < len(one.epochs) and one.epochs[item] == epoch:
            problem = one.take(slice(item, item + 1)).problem
            names = tuple(one.label(name, item) for name in problem.stations.names)
            return replace(problem, stations=replace(problem.stations, names=names))
    raise LookupError(epoch)


def explanations_by_epoch(problem: Problem, explanations: Array) -> Array:
    """Return explanations (k,) of fixes by `epoch_groups`, with the row numbers of the batch of `by_epoch`.

    `explanations` (k,) is an object array with a tuple of explanations for each epoch.
    """
    out, batch_row = explanations.copy(), rows_by_epoch(problem)
    for one in epoch_groups(problem):
        if one.rows is not None:
            for epoch, rows in zip(one.epochs, batch_row[one.rows], strict=True):
                out[epoch] = tuple(_renumbered(each, rows) for each in out[epoch])
    return out


def _renumbered(one: Explanation, rows: Array) -> Explanation:
    """Return the explanation with new row numbers; `rows` (r,) is the new number of each row."""
    suspects = (replace(s, rows=tuple(rows[np.array(s.rows, dtype=int)].tolist())) for s in one.suspects)
    return replace(one, suspects=tuple(suspects))


@dataclass(frozen=True, slots=True)
class _RowTable:
    """The rows (m,) of all kinds of a run, as columns.

    `block` is the number of the row's entry in `Problem.rows`. `a` and `b` are its stations, `target` and `epoch` are
    its target and its epoch. `present` is whether its weight is above zero. `noise` is a number that correlated rows
    share. `epochs` is the number of epochs.

    `order` (m,) sorts the rows by epoch, then as `by_epoch` does: by the first appearance of their kind, stations and
    target.
    """

    block: Array
    a: Array
    b: Array
    target: Array
    epoch: Array
    present: Array
    noise: Array
    order: Array
    epochs: int

    @classmethod
    def of(cls, problem: Problem) -> _RowTable:
        """Return the table of a run without batch axes."""
        block = np.repeat(np.arange(len(problem.rows)), [rows.count for rows in problem.rows]).astype(np.int32)
        a, b, target, epoch, weight = (
            np.concatenate([getattr(rows, name) for rows in problem.rows])
            for name in ("a", "b", "target", "epoch", "weight")
        )
        noise = np.arange(len(block))
        for one in problem.noise.blocks:
            if one.row.shape[1] > 1:
                noise[one.row] = one.row[:, :1]
        _, kind_of_row = first_rows(block, a + 1, b + 1, target + 1)  # -1 is no station
        order = np.lexsort((kind_of_row, block, epoch))
        return cls(block, a, b, target, epoch, weight > 0.0, noise, order, problem.epochs)

    def alike(self) -> Iterator[tuple[Array, Array]]:
        """Yield the epochs (n,) of each structure, and the row numbers (n, r) of these epochs."""
        # Number of rows of each epoch, and its first entry in `order`, which is sorted by epoch.
        size = np.bincount(self.epoch, minlength=self.epochs)
        start = np.cumsum(size) - size
        for count in np.unique(size).tolist():
            epochs = np.flatnonzero(size == count)
            members = self.order[start[epochs, None] + np.arange(count)]
            for pick in _equal_rows(self._structure(members)):
                yield epochs[pick], members[pick]

    def _structure(self, members: Array) -> Array:
        """Return the structure of each epoch as integers (n, c); epochs with equal integers fit into one batch.

        `members` (n, r) are the row numbers of each epoch. Stations enter by their order of appearance, not by number.
        """
        ends = np.concatenate([self.a[members], self.b[members]], axis=1)
        columns = [self.block[members], self.target[members], self.present[members], _number_by_appearance(ends)]
        return np.concatenate([*columns, _number_by_appearance(self.noise[members])], axis=1, dtype=np.int32)


def _number_by_appearance(values: Array) -> Array:
    """Return the entries of each row of values (n, r), numbered in the order of appearance; -1 if negative.

    For example, (7, 3, 7, -1) gives (0, 1, 0, -1).
    """
    out = np.full(values.shape, -1, dtype=np.int32)
    count = np.zeros(len(values), dtype=np.int32)
    for j in range(values.shape[1]):
        # An entry that occurs in an earlier column gets the number of its first occurrence, other entries a new number.
        same = values[:, :j] == values[:, j : j + 1]
        earlier = same.any(1) if j else np.zeros(len(values), dtype=bool)
        is_new = ~earlier & (values[:, j] >= 0)
        if j:
            out[earlier, j] = out[earlier, same.argmax(1)[earlier]]
        out[is_new, j] = count[is_new]
        count += is_new
    return out


def _equal_rows(table: Array) -> list[Array]:
    """Return the indices of equal rows of a table (n, c), one array per group, in the order of first appearance."""
    # Columns with equal entries do not distinguish rows. Without them the search is faster.
    varying = table[:, (table != table[:1]).any(0)]
    if not varying.shape[1]:
        return [np.arange(len(table))]
    _, first, inverse = np.unique(varying, axis=0, return_index=True, return_inverse=True)
    return [np.flatnonzero(inverse.ravel() == i) for i in np.argsort(first)]


def _epoch_group(problem: Problem, table: _RowTable, epochs: Array, rows: Array) -> EpochGroup:
    """Return epochs (n,) with row numbers (n, r) as one group.

    If all epochs have the same stations, the batch has the stations of the run. Otherwise the stations get numbers by
    appearance.
    """
    ends = np.stack([table.a[rows], table.b[rows]], axis=1)
    if (ends == ends[:1]).all():
        return EpochGroup(epochs, problem, rows, ends[0])
    # `local` is the station number in the batch of each end of a row; all epochs have the same. `first` is the column
    # in which each station occurs first.
    local = _number_by_appearance(ends[:1].reshape(1, -1))[0].astype(np.int64)
    first = [int(np.flatnonzero(local == i)[0]) for i in range(int(local.max(initial=-1)) + 1)]
    return EpochGroup(epochs, problem, rows, local.reshape(2, -1), ends.reshape(len(ends), -1)[:, first])


def _stations_of(stations: Stations, numbers: Array) -> Stations:
    """Return the stations of each problem of a batch, with names that are placeholders with their numbers.

    `numbers` (n, s) are the station numbers in the run.
    """

    def pick(array: Array | None) -> Array | None:
        """Return the entries (n, 1, s, d) of the stations of each problem; None for None."""
        if array is None:
            return None
        if array.ndim == 3:  # all epochs have the same positions
            return np.asarray(array[0][numbers][:, None])
        return np.asarray(np.take_along_axis(array, numbers[:, None, :, None], axis=2))

    position = pick(stations.position)
    assert position is not None
    names = tuple(f"\ue000{i}\ue001" for i in range(numbers.shape[1]))
    # Covariances of station errors that act as noise belong to the stations, so they are selected too.
    both = (stations.covariance, stations.velocity_covariance)
    errors = [None if each is None else _without_equal_axis(each[numbers]) for each in both]
    return Stations(position, names, pick(stations.velocity), None, errors[0], stations.span, errors[1])


def _batch_rows(one: Rows, chosen: Array, a: Array, b: Array) -> Rows:
    """Return chosen rows (n, r) of a kind as rows of a batch; arrays that all problems share get no batch axis.

    `chosen` (n, r) are row numbers within the kind. `a` and `b` (r,) are the stations of the rows in the batch.
    """
    zeros = np.zeros(len(a), dtype=np.int64)
    return replace(
        one,
        z=one.z[chosen],
        a=a,
        b=b,
        epoch=zeros,
        target=one.target[chosen[0]],
        weight=_without_equal_axis(one.weight[chosen]),
        correction=_without_equal_axis(one.correction[chosen]),
    )


def _without_equal_axis(values: Array) -> Array:
    """Return values (n, ...) without the batch axis if all problems have the same values."""
    return values[0] if (values == values[:1]).all() else values


def _batch_noise(noise: Noise, rows: Array) -> Noise:
    """Return the noise of rows (n, r) as noise of a batch of n problems; `rows` are row numbers of the run."""
    first_member = np.full(1 + max(int(block.row.max()) for block in noise.blocks), -1)
    for block in noise.blocks:
        first_member[block.row] = block.row[:, :1]
    # Rows with equal labels are in one group of correlated rows. `alone` are rows that are independent of all others.
    label, blocks = first_member[rows[0]], []
    alone = np.flatnonzero((label[:, None] == label).sum(1) == 1)
    if len(alone):
        variance = gathered(noise, rows[:, alone].reshape(-1, 1)).reshape(len(rows), len(alone), 1, 1)
        blocks.append(Block(alone[:, None], _without_equal_axis(variance)))
    for name in np.unique(np.delete(label, alone)):
        members = np.flatnonzero(label == name)
        blocks.append(Block(members[None], _without_equal_axis(gathered(noise, rows[:, members])[:, None])))
    return group(blocks)
