"""Which number goes where: the indices that the compiled core follows, made once for problems of equal structure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from optloc.kernels.order import Columns, Entries, Groups, Order, starts
from optloc.kernels.trace import Traced, traced
from optloc.plan import Plan, plans
from optloc.problem import Problem
from optloc.states import given
from optloc.types import Array

class Tables(NamedTuple):
    """The indices of a structure; rows are numbered in the order in which they are evaluated.

    Rows whose noise is correlated form a group, groups follow each other in time, and a stretch of groups whose rows
    are evaluated together is a packet. An integer array `..._at` holds the first entry of each item, and the end.
    """

    code: Array  # operations of all kinds, see `Tape`
    code_at: Array
    constant_register: Array
    constant: Array
    constant_at: Array
    input_register: Array  # inputs of all kinds
    partial_register: Array  # where the derivative by each input is found; -1 for none
    input_at: Array
    value_register: Array  # of each kind
    periodic: Array
    row: Array  # number of each row in the problem
    place: Array  # of each row in the packet
    last: Array  # number of columns of its group
    source: Array  # of each input of each row: >= 0 a number that all problems share, else -1 - one of its own
    source_at: Array
    feed_column: Array  # unknowns that move each input of each row
    feed_slot: Array
    feed_factor: Array
    feed_at: Array
    scale_column: Array  # unknowns that scale each row
    scale_slot: Array
    scale_factor: Array
    scale_at: Array
    add_column: Array  # unknowns that add to each row
    add_slot: Array
    add_factor: Array
    add_at: Array
    packet_group: Array
    packet_row: Array  # (packets, kinds + 1): rows of each kind
    group_row: Array  # first place of each group in its packet
    group_size: Array
    group_epoch: Array
    group_number: Array  # which of the groups of the whiteners it is
    column: Array  # unknowns that each group touches, ascending: shared ones, then local ones of its epoch
    column_at: Array
    shared: int
    local: int
    epochs: int
    registers: int
    width: int  # most columns of a group, and one for the residual
    rows: int  # most rows of a packet
    size: int  # most rows of a group


@dataclass(frozen=True, slots=True)
class Sources:
    """The data arrays that inputs come from, in order, and where each begins: the first number of all is zero.

    Parameters
    ----------
    arrays : tuple of (array, core rank)
        Station positions, rates, axes, known targets.
    start : tuple of int
        Number of the first entry of each, counted over one problem.
    """

    arrays: tuple[tuple[Array, int], ...]
    start: tuple[int, ...]

    @classmethod
    def of(cls, problem: Problem) -> Sources:
        """Return the data arrays of a flat batch of problems."""
        s = problem.stations
        found = [(s.position, 3), (s.velocity, 3), (s.axes, 4), *((m.known, 3) for m in problem.motions)]
        arrays = tuple((array, core) for array, core in found if array is not None)
        sizes = [int(np.prod(array.shape[array.ndim - core :])) for array, core in arrays]
        return cls(arrays, tuple(int(n) for n in np.cumsum([1, *sizes[:-1]])))

    @property
    def own(self) -> tuple[bool, ...]:
        """Return whether each problem of the batch has its own array."""
        return tuple(array.ndim > core and array.shape[0] > 1 for array, core in self.arrays)

    def numbered(self, problem: Problem) -> Problem:
        """Return the problem with every number of these arrays replaced by its place among them."""
        places = iter(
            start + np.arange(np.prod(array.shape[array.ndim - core :]), dtype=float).reshape(array.shape[-core:])
            for (array, core), start in zip(self.arrays, self.start, strict=True)
        )

        def place(array: Array | None) -> Array | None:
            return None if array is None else next(places)

        s = problem.stations
        stations = replace(s, position=next(places), velocity=place(s.velocity), axes=place(s.axes))
        motions = tuple(replace(m, known=place(m.known)) for m in problem.motions)
        return replace(problem, stations=stations, motions=motions)

    def lookup(self) -> Array:
        """Return for each number its place among those that all problems share, or -1 - its place among their own."""
        shared, own, out = 1, 0, [np.zeros(1, dtype=np.int64)]
        for (array, core), mine in zip(self.arrays, self.own, strict=True):
            count = int(np.prod(array.shape[array.ndim - core :]))
            out.append(-1 - own - np.arange(count) if mine else shared + np.arange(count))
            own, shared = (own + count, shared) if mine else (own, shared + count)
        return np.concatenate(out)


_KEPT: dict[tuple[Any, ...], Tables | None] = {}
# Tables of longer problems are made anew each time: that takes less time than a fix, and no memory that lasts.
_KEPT_ROWS = 4096


def tables(problem: Problem, groups: tuple[Array, ...]) -> Tables | None:
    """Return the tables of a flat batch of problems, or None where the compiled core does not serve it.

    Parameters
    ----------
    problem : Problem
        N problems.
    groups : tuple of int array (g, r)
        Rows whose noise is correlated, every row in exactly one group.
    """
    sources = Sources.of(problem)
    if problem.count > _KEPT_ROWS:
        return _tables(problem, groups, sources)
    shapes = tuple(array.shape[array.ndim - core :] for array, core in sources.arrays)
    key = (problem.structure, shapes, sources.own, *((g.shape, g.tobytes()) for g in groups))
    if key not in _KEPT:
        if sum(len(kept.row) for kept in _KEPT.values() if kept is not None) > 2 * _KEPT_ROWS:
            _KEPT.clear()
        _KEPT[key] = _tables(problem, groups, sources)
    return _KEPT[key]


def _tables(problem: Problem, groups: tuple[Array, ...], sources: Sources) -> Tables | None:
    layout = problem.layout
    if layout.n_shared + layout.n_local == 0 or _spanning(problem, groups):
        return None
    numbered, found = sources.numbered(problem), []
    for plan in plans(problem):
        inputs = given(numbered, plan)
        moved = frozenset(feed.seed for feed in plan.feeds)
        trace = traced(problem, plan, frozenset(inputs), moved)
        if trace is None:
            return None
        found.append(_Kind(plan, trace, inputs))
    return _filled(problem, Groups.sorted(problem, groups), found, sources.lookup())


def _spanning(problem: Problem, groups: tuple[Array, ...]) -> bool:
    """Return whether noise ties epochs that have unknowns of their own."""
    epoch = problem.epoch
    several = problem.layout.n_local > 0 and problem.epochs > 1
    return several and any(bool((epoch[group] != epoch[group[:, :1]]).any()) for group in groups)


@dataclass(frozen=True, slots=True)
class _Kind:
    """A block of rows, its tape, and the number of each input of each row among the sources."""

    plan: Plan
    trace: Traced
    inputs: dict[int, Array]


def _filled(problem: Problem, groups: Groups, found: list[_Kind], lookup: Array) -> Tables:
    pairs = list(zip(found, problem.starts, strict=True))
    feeds = Entries.joined([Entries.feeds(kind.plan, kind.trace, start) for kind, start in pairs])
    scales = Entries.joined([Entries.terms(kind.plan.gains, start) for kind, start in pairs])
    adds = Entries.joined([Entries.terms(kind.plan.adds, start) for kind, start in pairs])
    columns, slots = Columns.of(problem, groups, [feeds, scales, adds])
    count = np.diff(columns.at)
    order = Order.of(problem, groups, int(count.max()) + 1)
    inputs = np.concatenate([np.full(kind.plan.block.count, len(kind.trace.tape.inputs)) for kind in found])
    source_at = starts(inputs[order.row])
    place = source_at[order.at[feeds.row]] + feeds.place
    first = starts(groups.size)
    return Tables(
        **_tapes([kind.trace for kind in found]),
        periodic=np.array([kind.plan.model.period is not None for kind in found], dtype=np.int64),
        row=order.row,
        place=order.place,
        last=count[groups.of[order.row]],
        source=_sources(found, source_at, order, lookup),
        source_at=source_at,
        **_listed("feed", feeds, slots[0], place, int(source_at[-1])),
        **_listed("scale", scales, slots[1], order.at[scales.row], problem.count),
        **_listed("add", adds, slots[2], order.at[adds.row], problem.count),
        packet_group=order.packet_group,
        packet_row=order.packet_row,
        group_row=first[:-1] - first[np.repeat(order.packet_group[:-1], np.diff(order.packet_group))],
        group_size=groups.size,
        group_epoch=groups.epoch,
        group_number=groups.number,
        column=columns.column,
        column_at=columns.at,
        shared=problem.layout.n_shared,
        local=problem.layout.n_local,
        epochs=problem.epochs,
        registers=max(kind.trace.tape.registers for kind in found),
        width=int(count.max()) + 1,
        rows=int(order.place.max()) + 1,
        size=int(groups.size.max()),
    )


def _sources(found: list[_Kind], source_at: Array, order: Order, lookup: Array) -> Array:
    """Return where each input of each row evaluated is found."""
    out, start = np.zeros(int(source_at[-1]), dtype=np.int64), 0
    for kind in found:
        count = kind.plan.block.count
        first = source_at[order.at[start : start + count]]
        for i, (seed, _) in enumerate(kind.trace.tape.inputs):
            if seed in kind.inputs:
                out[first + i] = kind.inputs[seed]
        start += count
    return lookup[out]


def _listed(name: str, entries: Entries, slot: Array, owner: Array, owners: int) -> dict[str, Array]:
    """Return entries one after the other, owner by owner."""
    order = np.argsort(owner, kind="stable")
    return {
        f"{name}_column": entries.column[order].astype(np.int64),
        f"{name}_slot": slot[order].astype(np.int64),
        f"{name}_factor": entries.factor[order].astype(float),
        f"{name}_at": starts(np.bincount(owner, minlength=owners)),
    }


def _tapes(found: list[Traced]) -> dict[str, Any]:
    """Return the tapes of all kinds, one after the other."""
    constants = [pair for trace in found for pair in trace.tape.constants]
    inputs = [register for trace in found for _, register in trace.tape.inputs]
    partials: list[int] = []
    for trace in found:
        where = dict(zip(trace.seeds, trace.tape.outputs[1:], strict=True))
        partials.extend(where.get(seed, -1) for seed, _ in trace.tape.inputs)
    return {
        "code": np.concatenate([trace.tape.code for trace in found]),
        "code_at": starts([len(trace.tape.code) for trace in found]),
        "constant_register": np.array([register for register, _ in constants], dtype=np.int64),
        "constant": np.array([value for _, value in constants], dtype=float),
        "constant_at": starts([len(trace.tape.constants) for trace in found]),
        "input_register": np.array(inputs, dtype=np.int64),
        "partial_register": np.array(partials, dtype=np.int64),
        "input_at": starts([len(trace.tape.inputs) for trace in found]),
        "value_register": np.array([trace.tape.outputs[0] for trace in found], dtype=np.int64),
    }
