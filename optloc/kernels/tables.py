"""The indices that the compiled kernels follow, computed once for problems of equal structure.

They define which data enter which row, and which unknowns a row depends on. A *group* contains rows whose noise is
correlated. An *input* is a component of a point of the measurement function, for instance a coordinate. Letters: m
rows, g groups, n entries of a table.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from optloc.base.cache import Cache
from optloc.base.types import Array
from optloc.kernels.trace import Traced, trace
from optloc.linear.evaluate import BlockLinks, Terms, block_links, given
from optloc.problem.problem import Problem

# The order in which rows are evaluated, and the unknowns of each group of rows.

# Approximate number of derivatives per lane that are computed together, so that they stay in the cache; most and least
# rows of a packet.
_NUMBERS, _MOST, _LEAST = 512, 128, 8


def starts(counts: Any) -> Array:
    """Return the first index of each of several parts of given lengths, and the total length."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


@dataclass(frozen=True, slots=True)
class RowGroups:
    """Groups of correlated rows, sorted by epoch.

    Parameters
    ----------
    of : int array (m,)
        Group of each row of the problem.
    member : int array (m,)
        Index of each row in its group.
    size, epoch : int array (g,)
        Number of rows of each group, and the epoch of its first row.
    number : int array (g,)
        Number of each group in the original order.
    """

    of: Array
    member: Array
    size: Array
    epoch: Array
    number: Array

    @classmethod
    def sorted(cls, problem: Problem, groups: tuple[Array, ...]) -> RowGroups:
        """Return the groups of a problem, sorted by epoch; `groups` has one array (g, r) for each number r of rows."""
        rows = np.concatenate([group.ravel() for group in groups])
        size = np.concatenate([np.full(len(group), group.shape[1]) for group in groups])
        head = starts(size)[:-1]
        epoch = problem.epoch[rows[head]]
        # By epoch, so that sums over a run pass each epoch once.
        number = np.argsort(epoch, kind="stable")
        rank = np.empty_like(number)
        rank[number] = np.arange(len(number))
        of, member = np.full(problem.count, -1), np.zeros(problem.count, dtype=np.int64)
        of[rows] = np.repeat(rank, size)
        member[rows] = np.arange(len(rows)) - np.repeat(head, size)
        return cls(of, member, size[number], epoch[number], number)


@dataclass(frozen=True, slots=True)
class Entries:
    """The dependences of rows on unknowns, one entry for each; rows are numbered in the problem.

    Parameters
    ----------
    row, column : int array (n,)
        Row, and column of the full parameter vector.
    factor : array (n,)
        Coefficient of the unknown.
    place : int array (n,)
        Index of the input that the unknown changes; zero if it changes the measurement directly.
    """

    row: Array
    column: Array
    factor: Array
    place: Array

    @classmethod
    def joined(cls, parts: list[Entries]) -> Entries:
        """Return the entries of several parts as one."""
        none = np.zeros(0, dtype=np.int64)
        parts = [cls(none, none, np.zeros(0), none), *parts]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__slots__))

    @classmethod
    def terms(cls, terms: Terms, start: int) -> Entries:
        """Return the entries of the linear terms of a block whose first row has the number `start`."""
        return cls(start + terms.row, terms.column, terms.coefficient, np.zeros_like(terms.row))

    @classmethod
    def feeds(cls, links: BlockLinks, trace: Traced, start: int) -> Entries:
        """Return the entries of those inputs of a block that its function needs.

        `start` is the number of the first row of the block in the problem.
        """
        place, parts = {seed: i for i, (seed, _) in enumerate(trace.tape.inputs)}, []
        for feed in links.feeds:
            if feed.seed in place:
                rows = np.arange(links.block.count)[feed.rows]
                gain = np.broadcast_to(np.asarray(feed.gain, dtype=float), rows.shape)
                parts.append(cls(start + rows, feed.column, gain, np.full(rows.shape, place[feed.seed])))
        return cls.joined(parts)


@dataclass(frozen=True, slots=True)
class RowColumns:
    """The unknowns of each group: shared unknowns, then the local unknowns of its epoch.

    Parameters
    ----------
    column : int array (c,)
        Columns of all groups, one group after the other, ascending in each.
    at : int array (g + 1,)
        First index of each group.
    """

    column: Array
    at: Array

    @classmethod
    def of(cls, problem: Problem, groups: RowGroups, entries: list[Entries]) -> tuple[RowColumns, list[Array]]:
        """Return the columns of each group, and the index of each entry in the columns of its group."""
        n, length = problem.layout.n_shared, problem.layout.n_local
        keys = []  # group and column as one number, so that one sort finds the different columns of all groups
        for part in entries:
            # The local columns of all epochs have the same numbers, because a group has rows of a single epoch.
            folded = np.where(part.column < n, part.column, n + (part.column - n) % max(length, 1))
            keys.append(groups.of[part.row] * (n + length) + folded)
        found, place = np.unique(np.concatenate(keys), return_inverse=True)
        at = np.searchsorted(found, np.arange(len(groups.size) + 1) * (n + length))
        slots = place - at[np.concatenate(keys) // (n + length)]
        return cls(found % (n + length), at), np.split(slots, starts([len(key) for key in keys])[1:-1])


@dataclass(frozen=True, slots=True)
class Order:
    """The order of evaluation: packets of groups, and in each packet its rows kind by kind.

    Parameters
    ----------
    row : int array (m,)
        Number in the problem of each row in the order of evaluation.
    at : int array (m,)
        Position of each row of the problem in the order of evaluation.
    place : int array (m,)
        Index of each evaluated row in its packet, where the rows of a group are adjacent.
    packet_group : int array (p + 1,)
        First group of each packet.
    packet_row : int array (p, q + 1)
        First evaluated row of each kind in each packet.
    """

    row: Array
    at: Array
    place: Array
    packet_group: Array
    packet_row: Array

    @classmethod
    def of(cls, problem: Problem, groups: RowGroups, width: int) -> Order:
        """Return the order of evaluation for groups whose rows have at most `width` columns."""
        # If rows are wide, a packet has fewer rows, so that its numbers stay in the first-level cache.
        limit = int(np.clip(_NUMBERS // width, _LEAST, _MOST))
        first = starts(groups.size)
        packet = np.unique(first[:-1] // limit, return_inverse=True)[1]
        packets, kinds = int(packet[-1]) + 1, len(problem.rows)
        packet_group = np.searchsorted(packet, np.arange(packets + 1))
        kind = np.repeat(np.arange(kinds), [rows.count for rows in problem.rows])
        place = first[groups.of] + groups.member
        mine = packet[groups.of]
        # Within a packet, rows are sorted by kind: each tape runs over as many rows as possible.
        row = np.lexsort((place, kind, mine))
        at = np.empty_like(row)
        at[row] = np.arange(len(row))
        counts = np.bincount(mine * kinds + kind, minlength=packets * kinds)
        begin = starts(counts)[np.arange(packets)[:, None] * kinds + np.arange(kinds + 1)]
        return cls(row, at, (place - first[packet_group[mine]])[row], packet_group, begin)


# Columns of the integer tables. The operations of `code` are those of `Tape.code`; tables of one column (constant,
# packet, part, column) are read at FIRST or REGISTER.
FIRST = REGISTER = 0
DERIVATIVE = 1  # register of the derivative by an input, -1 for none
KIND_CODE, KIND_CONSTANT, KIND_INPUT, KIND_VALUE, KIND_PERIODIC = range(5)
ROW_NUMBER, ROW_PLACE, ROW_WIDTH, ROW_SOURCE, ROW_SCALE, ROW_ADDEND = range(6)
SOURCE_NUMBER, SOURCE_FEED = range(2)
TERM_COLUMN, TERM_SLOT = range(2)
GROUP_ROWS, GROUP_EPOCH, GROUP_COLUMN = range(1, 4)  # after the first row of the group in the packet
_WIDEST = 6


class Tables(NamedTuple):
    """The indices of a structure; rows are numbered in the order of evaluation.

    Rows with correlated noise form a group. Groups are sorted by time, and successive groups whose rows are evaluated
    together form a packet. All tables are stored in one array, because each array argument of a kernel costs time. An
    entry "first" of a table is an index whose end is in the next line.
    """

    table: Array  # int64 (n, 6): all tables, one after the other
    real: Array  # constants and factors
    # First line of each table in `table`.
    code: int  # operation, target, operands, see `Tape`; the tapes of all kinds
    kind: int  # first operation, constant, input; register of the value; 1 for an angle
    constant: int  # register; its values are the first of `real`
    input: int  # register, and the register of the derivative by it; -1 for none
    row: int  # number in the problem, index in the packet, columns of the group; first source, scale, addend
    source: int  # input of a row: >= 0 a shared number, else -1 - a number of each problem; first feed
    term: int  # column of the vector, index in the columns of the group: of feeds, scales, addends
    packet: int  # first group
    part: int  # first row, for each packet and kind
    group: int  # first row in the packet, rows, epoch; first column
    column: int  # unknowns of a group, ascending: shared ones, then local ones of its epoch
    factor: int  # first index of the factors of the terms in `real`
    kinds: int  # number of kinds of rows
    packets: int  # number of packets
    groups: int  # number of groups
    shared: int  # number of unknowns that all epochs share
    local: int  # number of unknowns of each epoch
    epochs: int  # number of epochs
    registers: int  # greatest number of registers of a tape
    width: int  # greatest number of columns of a group, plus one for the residual
    rows: int  # greatest number of rows of a packet
    size: int  # greatest number of rows of a group


@dataclass(frozen=True, slots=True)
class CachedTables:
    """Tables, and the number of each group among the groups of the whitening matrices.

    `tables` are the indices. `number` (groups,) is the original number of each sorted group.
    """

    tables: Tables
    number: Array


@dataclass(frozen=True, slots=True)
class Sources:
    """The data arrays that contain the inputs, in order, and the number of their first entries.

    Number 0 is the constant zero.

    Parameters
    ----------
    arrays : tuple of (array, core rank)
        Station positions, rates, axes, known targets, known shapes of heights.
    start : tuple of int
        Number of the first entry of each array, counted for one problem.
    """

    arrays: tuple[tuple[Array, int], ...]
    start: tuple[int, ...]

    @classmethod
    def of(cls, problem: Problem) -> Sources:
        """Return the data arrays of a flat batch of problems."""
        s = problem.stations
        found = [(s.position, 3), (s.velocity, 3), (s.axes, 4), *((m.known, 3) for m in problem.motions)]
        found += [(m.rise, 2) for m in problem.motions]
        arrays = tuple((array, core) for array, core in found if array is not None)
        sizes = [int(np.prod(array.shape[array.ndim - core :])) for array, core in arrays]
        return cls(arrays, tuple(int(n) for n in np.cumsum([1, *sizes[:-1]])))

    @property
    def own(self) -> tuple[bool, ...]:
        """Return for each array whether each problem of the batch has different values."""
        return tuple(array.ndim > core and array.shape[0] > 1 for array, core in self.arrays)

    def numbered(self, problem: Problem) -> Problem:
        """Return the problem with each number of these arrays replaced by its index, counted for one problem.

        After the usual operations on the data, the indices in the inputs show their sources.
        """
        places = iter(
            start + np.arange(np.prod(array.shape[array.ndim - core :]), dtype=float).reshape(array.shape[-core:])
            for (array, core), start in zip(self.arrays, self.start, strict=True)
        )

        def place(array: Array | None) -> Array | None:
            """Return the indices of the next array, or None if the problem does not have this array."""
            return None if array is None else next(places)

        s = problem.stations
        stations = replace(s, position=next(places), velocity=place(s.velocity), axes=place(s.axes))
        motions = tuple(replace(m, known=place(m.known)) for m in problem.motions)
        motions = tuple(replace(m, rise=place(m.rise)) for m in motions)
        return replace(problem, stations=stations, motions=motions)

    def lookup(self) -> Array:
        """Return for each number its index in the shared numbers, or -1 - its index in the numbers of each problem."""
        shared, own, out = 1, 0, [np.zeros(1, dtype=np.int64)]
        for (array, core), mine in zip(self.arrays, self.own, strict=True):
            count = int(np.prod(array.shape[array.ndim - core :]))
            out.append(-1 - own - np.arange(count) if mine else shared + np.arange(count))
            own, shared = (own + count, shared) if mine else (own, shared + count)
        return np.concatenate(out)


# Tables of longer problems are not cached: to compute them takes less time than a fix.
_KEPT_ROWS = 2**13
# 2**19 lines of six integers are 24 MB; a structure without tables counts as one line.
_KEPT = Cache["CachedTables | None"](2**19, lambda kept: 1 if kept is None else len(kept.tables.table))


def tables(problem: Problem, groups: tuple[Array, ...]) -> CachedTables | None:
    """Return the tables of a flat batch of problems, or None if the compiled kernels do not support it.

    Parameters
    ----------
    problem : Problem
        N problems.
    groups : tuple of int array (g, r)
        Rows with correlated noise; every row is in exactly one group.
    """
    sources = Sources.of(problem)
    if problem.count > _KEPT_ROWS:
        return _tables(problem, groups, sources)
    shapes = tuple(array.shape[array.ndim - core :] for array, core in sources.arrays)
    key = (problem.structure, shapes, sources.own, *((g.shape, g.tobytes()) for g in groups))
    return _KEPT.find(key, lambda: _tables(problem, groups, sources))


def _tables(problem: Problem, groups: tuple[Array, ...], sources: Sources) -> CachedTables | None:
    """Return the tables of a problem with the data arrays `sources`, see `tables`, without the cache."""
    layout = problem.layout
    if layout.n_shared + layout.n_local == 0 or _spanning(problem, groups):
        return None
    # The entries of the data are replaced by their numbers. After the usual operations on the data, the numbers in the
    # inputs show their sources.
    numbered, found = sources.numbered(problem), []
    for links in block_links(problem):
        inputs = given(numbered, links)
        moved = frozenset(feed.seed for feed in links.feeds)
        made = trace(problem, links, frozenset(inputs), moved)
        if made is None:
            return None
        found.append(_TracedRows(links, made, inputs))
    return _build_tables(problem, RowGroups.sorted(problem, groups), found, sources.lookup())


def _spanning(problem: Problem, groups: tuple[Array, ...]) -> bool:
    """Return whether noise correlates rows of several epochs with local unknowns."""
    epoch = problem.epoch
    several = problem.layout.n_local > 0 and problem.epochs > 1
    return several and any(bool((epoch[group] != epoch[group[:, :1]]).any()) for group in groups)


@dataclass(frozen=True, slots=True)
class _TracedRows:
    """A block of rows, its tape, and the number in `Sources` of each input of each row.

    `links` contains the rows, `trace` the tape. `inputs` maps the seed of an input to the numbers (m,).
    """

    links: BlockLinks
    trace: Traced
    inputs: dict[int, Array]


def _build_tables(problem: Problem, groups: RowGroups, found: list[_TracedRows], lookup: Array) -> CachedTables:
    """Return the tables of the traced blocks `found`; `lookup` is the result of `Sources.lookup`."""
    pairs = list(zip(found, problem.starts, strict=True))
    feeds = Entries.joined([Entries.feeds(kind.links, kind.trace, start) for kind, start in pairs])
    scales = Entries.joined([Entries.terms(kind.links.gains, start) for kind, start in pairs])
    adds = Entries.joined([Entries.terms(kind.links.adds, start) for kind, start in pairs])
    columns, slots = RowColumns.of(problem, groups, [feeds, scales, adds])
    count, tapes = np.diff(columns.at), [kind.trace.tape for kind in found]
    order = Order.of(problem, groups, int(count.max()) + 1)
    inputs = np.concatenate([np.full(k.links.block.count, len(t.inputs)) for k, t in zip(found, tapes, strict=True)])
    source_at = starts(inputs[order.row])
    place = source_at[order.at[feeds.row]] + feeds.place
    term, factor, at = _sort_by_owner(
        [feeds, scales, adds],
        slots,
        [place, order.at[scales.row], order.at[adds.row]],
        [int(source_at[-1]), problem.count, problem.count],
    )
    first = starts(groups.size)[:-1]
    head = first[np.repeat(order.packet_group[:-1], np.diff(order.packet_group))]
    constant, parts = _tapes(found)
    parts |= {
        "row": _table(order.row, order.place, count[groups.of[order.row]], source_at, at[1], at[2]),
        "source": _table(_sources(found, source_at, order, lookup), at[0]),
        "term": term,
        "packet": _table(order.packet_group),
        "part": _table(order.packet_row.ravel()),
        "group": _table(first - head, groups.size, groups.epoch, columns.at),
        "column": _table(columns.column),
    }
    begin = starts([len(part) for part in parts.values()])
    index = np.zeros((int(begin[-1]), _WIDEST), dtype=np.int64)
    for start, part in zip(begin, parts.values(), strict=False):
        index[start : start + len(part), : part.shape[1]] = part
    tables = Tables(
        index,
        np.concatenate([constant, factor]),
        **dict(zip(parts, begin.tolist(), strict=False)),
        factor=len(constant),
        kinds=len(found),
        packets=len(order.packet_row),
        groups=len(groups.size),
        shared=problem.layout.n_shared,
        local=problem.layout.n_local,
        epochs=problem.epochs,
        registers=max(tape.registers for tape in tapes),
        width=int(count.max()) + 1,
        rows=int(order.place.max()) + 1,
        size=int(groups.size.max()),
    )
    return CachedTables(tables, groups.number)


def _table(*columns: Array) -> Array:
    """Return columns side by side; shorter columns are filled with zeros."""
    out = np.zeros((max(len(column) for column in columns), len(columns)), dtype=np.int64)
    for i, column in enumerate(columns):
        out[: len(column), i] = column
    return out


def _sources(found: list[_TracedRows], source_at: Array, order: Order, lookup: Array) -> Array:
    """Return the index of each input of each evaluated row, see `Sources.lookup`.

    `found` are the blocks of rows. `source_at` is the first input of each evaluated row.
    """
    out, start = np.zeros(int(source_at[-1]), dtype=np.int64), 0
    for kind in found:
        count = kind.links.block.count
        first = source_at[order.at[start : start + count]]
        for i, (seed, _) in enumerate(kind.trace.tape.inputs):
            if seed in kind.inputs:
                out[first + i] = kind.inputs[seed]
        start += count
    return np.asarray(lookup[out])


def _sort_by_owner(
    parts: list[Entries], slots: list[Array], owners: list[Array], counts: list[int]
) -> tuple[Array, Array, list[Array]]:
    """Return entries sorted by owner (an input or a row): indices, factors, and the first entry of each owner.

    `parts` are the entries of feeds, scales and addends. For each part, `slots` has the columns of its entries in their
    group, `owners` the owner of each entry, and `counts` the number of owners.
    """
    terms, factors, at, start = [], [], [], 0
    for part, slot, owner, count in zip(parts, slots, owners, counts, strict=True):
        order = np.argsort(owner, kind="stable")
        terms.append(_table(part.column, slot)[order])
        factors.append(part.factor[order].astype(float))
        at.append(start + starts(np.bincount(owner, minlength=count)))
        start += len(order)
    return np.concatenate(terms), np.concatenate(factors), at


def _tapes(found: list[_TracedRows]) -> tuple[Array, dict[str, Array]]:
    """Return the constants of the tapes of the blocks `found`, and four tables by name: code, kind, constant, input."""
    tapes = [kind.trace.tape for kind in found]
    constants = [pair for tape in tapes for pair in tape.constants]
    inputs: list[tuple[int, int]] = []
    for kind in found:
        where = dict(zip(kind.trace.seeds, kind.trace.tape.outputs[1:], strict=True))
        inputs.extend((register, where.get(seed, -1)) for seed, register in kind.trace.tape.inputs)
    parts = [[len(t.code) for t in tapes], [len(t.constants) for t in tapes], [len(t.inputs) for t in tapes]]
    kinds = _table(
        *(starts(part) for part in parts),
        np.array([tape.outputs[0] for tape in tapes]),
        np.array([kind.links.model.period is not None for kind in found]),
    )
    return np.array([value for _, value in constants], dtype=float), {
        "code": np.concatenate([tape.code for tape in tapes]),
        "kind": kinds,
        "constant": np.array([register for register, _ in constants], dtype=np.int64).reshape(-1, 1),
        "input": np.array(inputs, dtype=np.int64).reshape(-1, 2),
    }
