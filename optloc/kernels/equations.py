"""Normal equations of many problems in one call.

The equations are summed over the epochs of a run; the unknowns of each epoch keep separate blocks. Letters: n shared
unknowns, `local` (or `size`) local unknowns of an epoch, B lanes. `m` is the memory (cells, B), `room` its addresses, r
are registers, t the tables and c the numbers of the problems, see `optloc.kernels.batched_rows`. `used` is the number
of lanes in use; lane b contains vector `begin` + b. If `priors` is True, Gaussian priors are added.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from optloc.base.threads import map_on_threads, thread_count
from optloc.base.types import Array
from optloc.kernels.batched_rows import (
    LaneCells,
    add_groups,
    add_priors,
    blocks,
    cell_layout,
    clear,
    load,
    memory,
    write_equations,
)
from optloc.kernels.jit import compiled
from optloc.kernels.pack import Numbers, Packed
from optloc.kernels.tables import Tables
from optloc.linear.normal import Normal

# Least number of starts for a thread: one block of lanes, see `optloc.kernels.batched_rows`.
_SHARE = 64


class Sums(NamedTuple):
    """The arrays of `optloc.linear.normal.Normal` for M vectors, with k epochs, n shared and l local unknowns.

    `shared` (M, n, n), `local` (M, k, l, l), `cross` (M, k, n, l), `shared_vector` (M, n), `local_vector` (M, k, l) and
    `cost` (M,).
    """

    shared: Array
    local: Array
    cross: Array
    shared_vector: Array
    local_vector: Array
    cost: Array


def chunks(count: int) -> list[tuple[int, int]]:
    """Return ranges (first, last) of the numbers of `count` starts, one range for each thread that saves time."""
    # Ranges of equal length: starts take about the same time, and each range has its own memory.
    parts = max(1, min(thread_count(), count // _SHARE))
    ends = np.linspace(0, count, parts + 1).round().astype(int).tolist()
    return list(pairwise(ends))


def normal_at(packed: Packed, x: Array, item: Array, *, priors: bool = False) -> Normal:
    """Return the normal equations of problems at given vectors.

    Parameters
    ----------
    packed : Packed
        N problems.
    x : array (M, size)
        Parameter vectors.
    item : int64 array (M,)
        Problem of each vector.
    priors : bool
        Whether Gaussian priors are added.
    """
    t, count = packed.tables, len(x)
    n, local, epochs = t.shared, t.local, t.epochs if t.local else 1
    sums = Sums(
        np.empty((count, n, n)),
        np.empty((count, epochs, local, local)),
        np.empty((count, epochs, n, local)),
        np.empty((count, n)),
        np.empty((count, epochs, local)),
        np.empty(count),
    )
    at = np.require(x, np.float64, ["C", "W"])
    map_on_threads(lambda part: normal_block(packed, at, item, part[0], part[1], priors, sums), chunks(count))
    return Normal(*sums)


@compiled
def normal_block(packed: Packed, x: Array, item: Array, first: int, last: int, priors: bool, out: Sums) -> None:
    """Write the normal equations at the vectors first <= i < last of x (M, size) to `out`.

    `item` (M,) is the problem of each vector.
    """
    t, c = packed
    size = x.shape[1]
    lanes, room = blocks(packed, size, last - first), cell_layout(t, c, size)
    m, r = memory(t, room, lanes)
    width = t.shared + t.local + 1
    for begin in range(first, last, lanes):
        used = min(lanes, last - begin)
        for b in range(used):
            # Several vectors may belong to one problem: its numbers are copied into each of their lanes.
            load(m, b, item[begin + b], c.source, c.white, c.prior, c.observed, c.present)
            for i in range(size):
                m[room.trial + i, b] = x[begin + b, i]
        # With one epoch, the local unknowns are columns after the shared ones. With several epochs most columns would
        # be zero.
        if t.local > 0 and t.epochs > 1:
            _epochs(t, c, m, r, room, begin, used, priors, out.local, out.cross, out.local_vector)
        else:
            write_equations(t, c, m, r, room, priors, used)
            _own(m, room.after, t.shared, t.local, begin, 0, used, out.local, out.cross, out.local_vector)
        _whole(m, room.after, t.shared, width, begin, used, out.shared, out.shared_vector, out.cost)


@compiled
def _epochs(
    t: Tables,
    c: Numbers,
    m: Array,
    r: Array,
    room: LaneCells,
    begin: int,
    used: int,
    priors: bool,
    local: Array,
    cross: Array,
    vector: Array,
) -> None:
    """Write the equations of the local unknowns of each epoch to `local`, `cross` and `vector`.

    The equations of the shared unknowns are summed in `room.after`. The arrays are fields of `Sums`.
    """
    group, packet, last = 0, 0, t.shared + t.local
    clear(m, room.now, (last + 1) ** 2, used)
    for epoch in range(t.epochs):
        clear(m, room.after, (last + 1) ** 2, used)
        group, packet = add_groups(t, c, m, r, room, room.trial, epoch, group, packet, used)
        if priors:
            add_priors(t, c, m, room, room.trial, True, epoch, used)
        _own(m, room.after, t.shared, t.local, begin, epoch, used, local, cross, vector)
        # Only the equations of the shared unknowns are summed. The couplings belong to one epoch, and are written out.
        for i in range(last + 1):
            if i < t.shared or i == last:
                for j in range(i + 1):
                    cell = i * (last + 1) + j
                    for b in range(used):
                        m[room.now + cell, b] += m[room.after + cell, b]
    for cell in range((last + 1) ** 2):
        for b in range(used):
            m[room.after + cell, b] = m[room.now + cell, b]
    if priors:
        add_priors(t, c, m, room, room.trial, False, 0, used)


@compiled
def _own(
    m: Array, to: int, n: int, size: int, begin: int, epoch: int, used: int, local: Array, cross: Array, vector: Array
) -> None:
    """Write the equations of the local unknowns of one epoch, and their coupling with the shared unknowns.

    They are copied from the memory, where the equations begin at cell `to`, to entries of `local`, `cross` and
    `vector`.
    """
    width = n + size + 1
    for i in range(size):
        line = to + (n + i) * width
        for b in range(used):
            vector[begin + b, epoch, i] = m[to + (width - 1) * width + n + i, b]
            for j in range(n):
                cross[begin + b, epoch, j, i] = m[line + j, b]
            for j in range(i + 1):
                local[begin + b, epoch, i, j] = m[line + n + j, b]
                local[begin + b, epoch, j, i] = m[line + n + j, b]


@compiled
def _whole(
    m: Array, to: int, n: int, width: int, begin: int, used: int, shared: Array, vector: Array, cost: Array
) -> None:
    """Write the equations of the unknowns that all epochs share to `shared` and `vector`, and the cost to `cost`.

    They are copied from the memory, where the equations begin at cell `to`; `width` is the number of unknowns plus one.
    """
    last = to + (width - 1) * width
    for b in range(used):
        cost[begin + b] = m[last + width - 1, b]
        for i in range(n):
            vector[begin + b, i] = m[last + i, b]
            for j in range(i + 1):
                shared[begin + b, i, j] = m[to + i * width + j, b]
                shared[begin + b, j, i] = m[to + i * width + j, b]
