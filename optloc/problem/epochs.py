"""Epochs of a run: convert them to a batch, iterate over windows of constant size, cut a run and join two runs.

Letters: k epochs and m rows of the run, g groups of r rows in a noise block, s stations. `core` is the rank of an array
without batch axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Bias, Motion, Rows, Stations
from optloc.problem.noise import Block, Noise, group
from optloc.problem.problem import Problem, spread_over_epochs

# Epochs without shared unknowns become a batch of problems with one epoch each.


def separable(problem: Problem) -> bool:
    """Return whether no unknown is shared between the epochs of a problem, so that `by_epoch` applies."""
    run_long_errors = problem.stations.unknown_for == "run"
    # A target with a known motion shares no unknown, but it counts as free only if its span is "epoch".
    free = all(motion.span == "epoch" for motion in problem.motions)
    return (
        problem.epochs > 1
        and free
        and not problem.biases
        and not run_long_errors
        and not has_correlated_epochs(problem)
    )


def has_correlated_epochs(problem: Problem) -> bool:
    """Return whether the noise of rows of different epochs is correlated."""
    epoch = problem.epoch
    for block in problem.noise.blocks:
        epochs = epoch[block.row]
        # A group can contain several epochs, for instance with a joint covariance. Only nonzero correlation counts.
        different = epochs[:, :, None] != epochs[:, None, :]
        if different.any() and np.any(np.where(different, block.covariance, 0.0)):
            return True
    return False


def by_epoch(problem: Problem) -> Problem:
    """Return the epochs of a problem as a batch of independent problems, with leading axes (..., k) and one epoch each.

    Rows with the same kind, stations and target use the same row of the batch. A row that an epoch lacks has weight
    zero.

    Parameters
    ----------
    problem : Problem
        Leading axes (...), k epochs, no biases. The state of each target becomes its state at the epoch.

    Raises
    ------
    InvalidProblem
        If the epochs share a bias or correlated noise.
    """
    # Problems of a batch are independent, so they cannot share a bias or correlated noise.
    if problem.biases or has_correlated_epochs(problem):
        cause = f"the bias {problem.biases[0].name!r} is" if problem.biases else "correlated noise is"
        raise InvalidProblem(f"{cause} shared by several epochs", "by_epoch", "solve them as one problem")
    parts = [_distinct_rows(rows) for rows in problem.rows]
    batch_row, size = _joined(parts)
    batch, k = problem.batch_shape, problem.epochs
    rows = []
    for old, (keys, batch_rows) in zip(problem.rows, parts, strict=True):
        # A row of the batch is one (stations, target, occurrence): a pair measured twice in an epoch has two rows.
        a, b, target, _ = keys.T

        def spread(values: Array, old: Rows = old, batch_rows: Array = batch_rows, size: int = len(keys)) -> Array:
            """Return values (..., m) of one kind at their rows of the batch, (..., k, size); zero for absent rows."""
            out = np.zeros((*batch, k, size))
            out[..., old.epoch, batch_rows] = values
            return out

        rows.append(
            replace(
                old,
                z=spread(old.z),
                a=a,
                b=b,
                epoch=np.zeros_like(a),
                target=target,
                weight=spread(old.weight),
                correction=spread(old.correction),
            )
        )
    noise = _batch_noise(problem, batch_row, size)
    return replace(states_by_epoch(problem), rows=tuple(rows), noise=noise)


def rows_by_epoch(problem: Problem) -> Array:
    """Return, for each row (m,) of a run, its row number in the batch of `by_epoch`."""
    return _joined([_distinct_rows(rows) for rows in problem.rows])[0]


def _joined(parts: Sequence[tuple[Array, Array]]) -> tuple[Array, int]:
    """Return the batch row of each row (m,), and the number of batch rows; `parts` is `_distinct_rows` of each kind."""
    starts = np.cumsum([0, *(len(keys) for keys, _ in parts)])
    return np.concatenate([start + row_in_kind for (_, row_in_kind), start in zip(parts, starts, strict=False)]), int(
        starts[-1]
    )


def states_by_epoch(problem: Problem) -> Problem:
    """Return the batch of `by_epoch` without rows and biases: states, stations, priors and constraints."""
    motions = tuple(
        replace(m, span="run", known=None if m.known is None else _split_epochs(m.known, 3), rise=None)
        for m in problem.motions
    )
    s = problem.stations
    stations = replace(
        s,
        position=_split_epochs(s.position, 3),
        velocity=None if s.velocity is None else _split_epochs(s.velocity, 3),
        axes=None if s.axes is None else _split_epochs(s.axes, 4),
        covariance=None if s.covariance is None else _add_epoch_axis(s.covariance, 3),
        velocity_covariance=None if s.velocity_covariance is None else _add_epoch_axis(s.velocity_covariance, 3),
    )
    priors = tuple(
        replace(p, mean=_add_epoch_axis(p.mean, 1), covariance=_add_epoch_axis(p.covariance, 2)) for p in problem.priors
    )
    constraints = tuple(spread_over_epochs(c, problem.motions[c.target].rise) for c in problem.constraints)
    spread = _add_epoch_axis
    fences = tuple(
        replace(f, normal=spread(f.normal, 1), offset=spread(f.offset, 0), sigma=spread(f.sigma, 0))
        for f in problem.fences
    )
    bare = replace(problem, rows=(), noise=Noise(()), biases=(), times=np.zeros(1))
    return replace(bare, stations=stations, motions=motions, priors=priors, constraints=constraints, fences=fences)


def without_epoch_correlation(problem: Problem) -> Problem:
    """Return the problem with noise blocks of one epoch each; correlation between epochs is dropped."""
    epoch = problem.epoch
    if all((epoch[block.row] == epoch[block.row[:, :1]]).all() for block in problem.noise.blocks):
        return problem
    parts = [part for block in problem.noise.blocks for part in _cut_block(block, epoch)]
    return replace(problem, noise=group(parts))


def _distinct_rows(rows: Rows) -> tuple[Array, Array]:
    """Return the distinct rows (q, 4) of all epochs (a, b, target, occurrence), and the index (m,) of each row in them.

    They are in the order of appearance. `occurrence` counts equal rows of one epoch.
    """
    columns = np.stack([rows.a, rows.b, rows.target])
    # Indices begin at -1. One number for each row and epoch sorts faster than four.
    named = np.ravel_multi_index(tuple(columns + 1), tuple(columns.max(axis=1, initial=0) + 2))  # a, b and target
    occurrence = _occurrences(named * (1 + rows.epoch.max(initial=0)) + rows.epoch)
    each = named * (1 + occurrence.max(initial=0)) + occurrence
    _, first, index = np.unique(each, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    first = first[order]
    return np.column_stack([columns[:, first].T, occurrence[first]]), number[index]


def _occurrences(values: Array) -> Array:
    """Return, for each entry of values (m,), the number of equal entries before it."""
    order = np.argsort(values, kind="stable")
    number, sorted_ = np.arange(len(values)), values[order]
    begins = np.append(True, sorted_[1:] != sorted_[:-1])[: len(values)]  # first entry of each value
    out = np.empty_like(number)
    out[order] = number - np.maximum.accumulate(np.where(begins, number, 0))
    return out


def _split_epochs(array: Array, core: int) -> Array:
    """Return a per-epoch array (..., k or 1, s, ...) as (..., k, 1, s, ...); unchanged if all epochs share it."""
    # `core` is the number of axes without batch axes. A value that all epochs and problems share needs no new axis.
    if array.ndim == core and array.shape[0] == 1:
        return array
    return np.expand_dims(array, array.ndim - core + 1)


def _add_epoch_axis(array: Array, core: int) -> Array:
    """Return an array with a new batch axis for the epochs, unless all share it; `core` is as for `_split_epochs`."""
    return array if array.ndim == core else np.expand_dims(array, array.ndim - core)


def _cut_block(block: Block, epoch: Array) -> list[Block]:
    """Return the block as blocks with groups of rows of one epoch each; `epoch` (m,) is the epoch of each row."""
    epochs = epoch[block.row]
    if (epochs == epochs[:, :1]).all():
        return [block]
    blocks = []
    for g, (rows, times) in enumerate(zip(block.row, epochs, strict=True)):
        covariance = block.covariance[..., g if block.covariance.shape[-3] > 1 else 0, :, :]
        for k in np.unique(times):
            inside = np.flatnonzero(times == k)
            blocks.append(Block(rows[None, inside], covariance[..., None, inside[:, None], inside]))
    return blocks


def _batch_noise(problem: Problem, batch_row: Array, size: int) -> Noise:
    """Return the noise of the batch, of `size` rows; `batch_row` (m,) gives the row in the batch of each row."""
    epoch, k = problem.epoch, problem.epochs
    blocks = group([part for block in problem.noise.blocks for part in _cut_block(block, epoch)]).blocks
    if all(block.row.shape[1] == 1 for block in blocks):
        return _independent_noise(blocks, batch_row, epoch, size, k)
    # Rows of the batch that are correlated in any epoch get the same label, so overlapping groups merge.
    label = np.arange(size)
    for block in blocks:
        for members in batch_row[block.row]:
            joined = np.isin(label, label[members])
            label[joined] = label[members[0]]
    grouped = []
    for name in np.unique(label):
        members = np.flatnonzero(label == name)
        grouped.append(_group_noise(blocks, batch_row, epoch, members, k))
    return group(grouped)


def _independent_noise(blocks: tuple[Block, ...], batch_row: Array, epoch: Array, size: int, k: int) -> Noise:
    """Return the noise of a batch of independent rows, in one operation for speed; arguments as for `_batch_noise`."""
    shape = np.broadcast_shapes(*(block.covariance.shape[:-3] for block in blocks))
    # A row that an epoch lacks has weight zero. Its variance of one keeps the matrix regular.
    out = np.ones((*shape, k, size, 1, 1))
    for block in blocks:
        rows = block.row[:, 0]
        out[..., epoch[rows], batch_row[rows], :, :] = block.covariance
    return Noise((Block(np.arange(size)[:, None], out),))


def _group_noise(blocks: tuple[Block, ...], batch_row: Array, epoch: Array, members: Array, k: int) -> Block:
    """Return the covariance of one group of correlated rows of the batch, for all k epochs.

    `blocks` are the noise blocks of the run, each group in one epoch. `members` (r,) are the rows of the batch that
    form the group. `batch_row` (m,) and `epoch` (m,) refer to the rows of the run.
    """
    slot = {int(row): i for i, row in enumerate(members)}  # index in the group of each row of the batch
    shape = np.broadcast_shapes(*(block.covariance.shape[:-3] for block in blocks))
    out = np.zeros((*shape, k, 1, len(members), len(members)))
    # A row that an epoch lacks has weight zero. Its variance of one keeps the matrix of its group regular.
    out[..., np.arange(len(members)), np.arange(len(members))] = 1.0
    for block in blocks:
        inside = np.flatnonzero(np.isin(batch_row[block.row[:, 0]], members))
        if not len(inside):
            continue
        slots = np.vectorize(slot.__getitem__)(batch_row[block.row[inside]])
        covariance = np.broadcast_to(
            block.covariance, (*block.covariance.shape[:-3], *block.row.shape, block.row.shape[1])
        )[..., inside, :, :]
        out[..., epoch[block.row[inside, 0]][:, None, None], 0, slots[:, :, None], slots[:, None, :]] = covariance
    return Block(members[None], out)


# Windows: sums over a run are computed for one stretch of epochs at a time.

# Numbers in the Jacobians of a window: 512 kB of doubles. They fit into the second-level cache, and the memory does not
# grow with the run.
_NUMBERS = 2**16
_ROW_ARRAYS = ("z", "a", "b", "epoch", "target", "weight", "correction")


def windows(problem: Problem, batch: int = 1) -> Iterator[tuple[int, int, Problem]]:
    """Yield the windows (first, last, problem) of a run, in order. The Jacobians of each window fit into the cache.

    Parameters
    ----------
    problem : Problem
        A run of k epochs. If noise correlates its epochs, the run is one window.
    batch : int
        Number of problems that are solved together.
    """
    length = epochs_of(problem, batch)
    if length >= problem.epochs:
        yield 0, problem.epochs, problem
        return
    for first in range(0, problem.epochs, length):
        last = min(first + length, problem.epochs)
        yield first, last, window(problem, first, last)


def is_one_window(problem: Problem, batch: int = 1) -> bool:
    """Return whether the run, for `batch` problems, is one window."""
    return epochs_of(problem, batch) >= problem.epochs


def epochs_of(problem: Problem, batch: int = 1) -> int:
    """Return the number of epochs whose Jacobians, for `batch` problems, fit into the cache together."""
    if problem.epochs == 1 or problem.count == 0 or has_correlated_epochs(problem):
        return problem.epochs
    # One more column for the residual.
    columns = problem.layout.n_shared + problem.layout.n_local + 1
    return max(1, int(_NUMBERS * problem.epochs / (batch * problem.count * columns)))


def window(problem: Problem, first: int, last: int) -> Problem:
    """Return the problem with the rows of epochs first <= k < last only. Times, stations and unknowns stay.

    Parameters
    ----------
    problem : Problem
        A run whose noise does not correlate epochs.
    first, last : int
        First epoch, and the epoch after the last.
    """
    return _with_rows_of(problem, lambda epoch: _inside(epoch, first, last))


def _with_rows_of(problem: Problem, inside: Callable[[Array], slice | Array]) -> Problem:
    """Return the problem with the rows of some epochs only; `inside` maps epochs (n,) to the selected entries."""
    kept = [inside(block.epoch) for block in problem.rows]
    rows = tuple(_select(block, selected) for block, selected in zip(problem.rows, kept, strict=True))
    number = _Numbers.of(problem, kept, [block.count for block in rows])
    blocks = []
    for block in problem.noise.blocks:
        groups = inside(number.epoch(problem, block.row[:, 0]))
        # Each group has rows of one epoch, so the epoch of its first row is the epoch of all.
        covariance = block.covariance if block.covariance.shape[-3] == 1 else block.covariance[..., groups, :, :]
        if len(block.row[groups]):
            blocks.append(Block(number.new(block.row[groups]), covariance))
    biases = tuple(_select_bias(problem, bias, number, inside) for bias in problem.biases)
    return replace(problem, rows=rows, noise=Noise(tuple(blocks)), biases=biases)


@dataclass(frozen=True, slots=True)
class _Numbers:
    """Row numbers of a run and of its window, with one entry for each kind of rows."""

    start: Array  # first row in the run
    kept: list[slice | Array]  # selected rows, counted within the kind
    taken: Array  # first row in the window

    @classmethod
    def of(cls, problem: Problem, kept: list[slice | Array], counts: list[int]) -> _Numbers:
        """Return the numbers for selected rows `kept` of each kind; `counts` are the numbers of selected rows."""
        return cls(np.array(problem.starts), kept, np.cumsum([0, *counts[:-1]]))

    def epoch(self, problem: Problem, rows: Array) -> Array:
        """Return the epochs of rows (any shape), given by their numbers in the run."""
        if len(self.kept) == 1:
            return problem.rows[0].epoch[rows]
        kind = np.searchsorted(self.start, rows, side="right") - 1
        out = np.empty(rows.shape, dtype=np.int64)
        for i, block in enumerate(problem.rows):
            out[kind == i] = block.epoch[rows[kind == i] - self.start[i]]
        return out

    def new(self, rows: Array) -> Array:
        """Return the numbers in the window of rows (any shape), given by their numbers in the run."""
        kind = np.searchsorted(self.start, rows, side="right") - 1
        out = np.empty(rows.shape, dtype=np.int64)
        for i, kept in enumerate(self.kept):
            selected = rows[kind == i] - self.start[i]
            out[kind == i] = self.taken[i] + (
                selected - kept.start if isinstance(kept, slice) else np.searchsorted(kept, selected)
            )
        return out


def cut(problem: Problem, first: int, last: int) -> Problem:
    """Return the epochs first <= k < last of a run as a separate run. The reference time of its states is unchanged.

    Parameters
    ----------
    problem : Problem
        A run whose noise does not correlate epochs.
    first, last : int
        First epoch, and the epoch after the last; at least one epoch.

    Raises
    ------
    InvalidProblem
        If no rows belong to these epochs.
    """
    part = window(problem, first, last)
    if part.count == 0:
        raise InvalidProblem(f"epochs {first} to {last} have no rows", "cut", "take a longer stretch")
    return _as_separate_run(problem, part, slice(first, last))


def some_epochs(problem: Problem, epochs: Array) -> Problem:
    """Return the epochs (n,) of a run, which must increase, as a separate run; otherwise like `cut`."""
    part = _with_rows_of(problem, lambda epoch: np.flatnonzero(np.isin(epoch, epochs)))
    return _as_separate_run(problem, part, epochs)


def _as_separate_run(problem: Problem, part: Problem, when: slice | Array) -> Problem:
    """Return `part`, the rows of some increasing epochs `when` of a run, as a run that has these epochs only."""

    def select(values: Array | None, core: int) -> Array | None:  # `core` axes from the epoch axis to the last
        if values is None or values.shape[-core] == 1:
            return values
        return np.moveaxis(np.moveaxis(values, -core, 0)[when], 0, -core)

    s, number = problem.stations, np.arange(problem.epochs)[when]
    # Station numbers, reference times and unknowns of the run stay. Only arrays with an epoch axis are cut.
    position = select(s.position, 3)
    assert position is not None
    motions = tuple(
        replace(m, known=select(m.known, 3), reference=_reference(problem, m), rise=select(m.rise, 2))
        for m in problem.motions
    )
    return replace(
        part,
        stations=replace(s, position=position, velocity=select(s.velocity, 3), axes=select(s.axes, 4)),
        rows=tuple(replace(rows, epoch=np.searchsorted(number, rows.epoch)) for rows in part.rows),
        times=problem.times[when],
        motions=motions,
    )


def _reference(problem: Problem, motion: Motion) -> float | None:
    """Return the reference time of a motion, seconds; by default the first epoch of the run."""
    return float(problem.times[0]) if motion.reference is None else motion.reference


def _inside(epoch: Array, first: int, last: int) -> slice | Array:
    """Return the indices of entries with first <= epoch < last: a slice (hence a view) if the epochs are sorted."""
    if np.all(epoch[1:] >= epoch[:-1]):
        # Real runs are sorted. Views of millions of rows take no memory; copies would double it.
        return slice(*np.searchsorted(epoch, (first, last)).tolist())
    return np.flatnonzero((epoch >= first) & (epoch < last))


def _select(block: Rows, kept: slice | Array) -> Rows:
    """Return the selected rows of a block; `kept` is a slice or indices within the block."""
    return replace(block, **{name: getattr(block, name)[..., kept] for name in _ROW_ARRAYS})


def _select_bias(problem: Problem, bias: Bias, number: _Numbers, inside: Callable[[Array], slice | Array]) -> Bias:
    """Return the bias with the entries whose epochs `inside` selects, and with the row numbers of the window."""
    kept = inside(number.epoch(problem, bias.row))
    return replace(bias, row=number.new(bias.row[kept]), member=bias.member[kept], coefficient=bias.coefficient[kept])


# Join two runs.


def joined(problem: Problem, more: Problem) -> Problem:
    """Return one run with the epochs of both runs; the epochs of `more` are last.

    States refer to the reference time of the first run.

    Parameters
    ----------
    problem, more : Problem
        Runs with the same stations, targets, biases and priors. All times of `more` are later. The kinds can differ.

    Raises
    ------
    InvalidProblem
        If the runs do not fit. The message names the difference.
    """
    _check_alike(problem, more)
    k = problem.epochs
    first_blocks, second_blocks = _named(problem.rows), _named(more.rows)
    names = list(dict.fromkeys((*first_blocks, *second_blocks)))
    empty = [_empty_block(kind) for kind, _ in names]
    first = [first_blocks.get(name, block) for name, block in zip(names, empty, strict=True)]
    second = [second_blocks.get(name, block) for name, block in zip(names, empty, strict=True)]
    rows = tuple(_append(one, replace(two, epoch=two.epoch + k)) for one, two in zip(first, second, strict=True))
    # Row numbers of both runs in the result: for each kind the rows of the first run, then the rows of the second.
    counts = [(one.count, two.count) for one, two in zip(first, second, strict=True)]
    starts = dict(zip(names, np.cumsum([0, *(a + b for a, b in counts)]).tolist(), strict=False))
    rows_of_first = np.concatenate([starts[name] + np.arange(block.count) for name, block in first_blocks.items()])
    rows_of_second = np.concatenate(
        [
            starts[name] + (first_blocks[name].count if name in first_blocks else 0) + np.arange(block.count)
            for name, block in second_blocks.items()
        ]
    )
    blocks = [Block(rows_of_first[block.row], block.covariance) for block in problem.noise.blocks]
    blocks += [Block(rows_of_second[block.row], block.covariance) for block in more.noise.blocks]
    biases = tuple(
        replace(
            one,
            row=np.concatenate([rows_of_first[one.row], rows_of_second[two.row]]),
            member=np.concatenate([one.member, two.member]),
            coefficient=np.concatenate([one.coefficient, two.coefficient]),
        )
        for one, two in zip(problem.biases, more.biases, strict=True)
    )
    return replace(
        problem,
        stations=_stations(problem, more),
        rows=rows,
        noise=Noise(tuple(blocks)),
        times=np.concatenate([problem.times, more.times]),
        motions=_motions(problem, more),
        biases=biases,
    )


def _named(rows: tuple[Rows, ...]) -> dict[tuple[str, int], Rows]:
    """Return the blocks of a run by (kind, i), where i counts the blocks of the same kind."""
    kinds = [block.kind for block in rows]
    return {(kind, kinds[:i].count(kind)): block for i, (kind, block) in enumerate(zip(kinds, rows, strict=True))}


def _empty_block(kind: str) -> Rows:
    """Return an empty block of a kind, for the run that has no rows of this kind."""
    none, numbers = np.zeros(0), np.zeros(0, dtype=np.int64)
    return Rows(kind, none, numbers, numbers, numbers, numbers, none, none)


def _append(one: Rows, two: Rows) -> Rows:
    """Return one block with the rows of two blocks of a kind. A batch axis appears only if one of them has it."""
    batch = np.broadcast_shapes(one.z.shape[:-1], two.z.shape[:-1])

    def both(a: Array, b: Array) -> Array:
        shape = batch if a.ndim > 1 or b.ndim > 1 else ()
        return np.concatenate([np.broadcast_to(v, (*shape, v.shape[-1])) for v in (a, b)], axis=-1)

    arrays: dict[str, Any] = {name: both(getattr(one, name), getattr(two, name)) for name in _ROW_ARRAYS}
    return replace(one if one.count else two, **arrays)


def _stations(problem: Problem, more: Problem) -> Stations:
    """Return the stations of the joined run, with positions, velocities and axes at the epochs of both runs."""
    one, two = problem.stations, more.stations

    def both(a: Array | None, b: Array | None, core: int) -> Array | None:
        if a is None or b is None:
            return None
        return _join_epochs(a, problem.epochs, b, more.epochs, core)

    position = _join_epochs(one.position, problem.epochs, two.position, more.epochs, 3)
    return replace(
        one, position=position, velocity=both(one.velocity, two.velocity, 3), axes=both(one.axes, two.axes, 4)
    )


def _motions(problem: Problem, more: Problem) -> tuple[Motion, ...]:
    """Return the motions of the joined run, with known states and heights at the epochs of both runs."""
    joint = []
    for one, two in zip(problem.motions, more.motions, strict=True):
        known = one.known
        if known is not None and two.known is not None:
            known = _join_epochs(known, problem.epochs, two.known, more.epochs, 3)
        rise = one.rise
        if rise is not None and two.rise is not None:
            rise = _join_epochs(rise, problem.epochs, two.rise, more.epochs, 2)
        joint.append(replace(one, known=known, reference=_reference(problem, one), rise=rise))
    return tuple(joint)


def _join_epochs(one: Array, first: int, two: Array, second: int, core: int) -> Array:
    """Return an array with the values of both runs at each epoch (..., k, ...); unchanged if it is constant in both.

    `first` and `second` are the numbers of epochs of the runs. `core` counts the axes from the epoch axis to the last.
    """
    if one.shape[-core] == 1 and two.shape[-core] == 1 and np.array_equal(one, two):
        return one
    axis = -core
    # A value that is constant in one run and changes in the other is repeated for each epoch.
    parts = [np.repeat(a, n, axis) if a.shape[axis] == 1 else a for a, n in ((one, first), (two, second))]
    batch = np.broadcast_shapes(*(part.shape[:axis] for part in parts))
    return np.concatenate([np.broadcast_to(part, (*batch, *part.shape[axis:])) for part in parts], axis)


def _check_alike(problem: Problem, more: Problem) -> None:
    """Raise if two runs differ in stations, targets, biases, frame or medium, or if the second does not start later."""
    one, two = problem, more
    for noun, equal in (
        ("stations", one.stations.names == two.stations.names and one.stations.span == two.stations.span),
        (
            "targets",
            [(m.order, m.span, m.known is None, m.over, m.rise is None) for m in one.motions]
            == [(m.order, m.span, m.known is None, m.over, m.rise is None) for m in two.motions],
        ),
        (
            "biases",
            [(b.name, b.members, b.form) for b in one.biases] == [(b.name, b.members, b.form) for b in two.biases],
        ),
        ("frames", one.frame == two.frame),
        ("media", one.medium == two.medium),
    ):
        if not equal:
            raise InvalidProblem(f"the {noun} of the two runs differ", "update", "give the same ones in the same order")
    if two.times[0] <= one.times[-1]:
        raise InvalidProblem(
            f"its first epoch, at {two.times[0]} s, is not later than the last epoch of the run, at {one.times[-1]} s",
            "update",
            "give epochs in the order of time",
        )
