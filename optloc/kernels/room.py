"""Working memory of a block of lanes: one array of cells, and where everything stands in it.

A lane is a problem; a cell holds one number of every lane. One array instead of many, because each array that is handed
to a kernel costs as much time as dozens of multiplications.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.kernels.jit import compiled
from optloc.kernels.pack import Numbers, Packed
from optloc.kernels.tables import Tables
from optloc.types import Array

LENGTH = 128
"""Length of a register: rows of one kind are put behind each other, lanes of one and then of the next."""


class Room(NamedTuple):
    """First cell of each part, for p unknowns of which n are shared and l local."""

    own: int  # sources, whitening matrices and priors that each problem has to itself
    observed: int  # (m,)
    present: int  # (m,), or none where all rows count
    rows: int  # (rows of a packet, columns and residual)
    whitened: int  # (rows of a group, columns and residual)
    error: int  # (2 * largest prior,)
    scale: int
    trial: int  # (p,): where equations are wanted
    best: int  # (p,)
    after: int  # (n + l + 1, n + l + 1): equations at `trial`, lower triangle, then vector and cost
    now: int  # the same at `best`
    step: int  # (n + l,)
    shared: int  # (n, n): factor of the shared system
    shared_scale: int  # (n,)
    local: int  # (l, l)
    local_scale: int  # (l,)
    half: int  # (n + 1, l): the local factor's inverse times coupling and vector
    state: int  # what a refinement remembers
    cells: int
    absent: int  # 1 where some rows do not count


STATE = 10
"""Cells that a refinement keeps of every problem."""

# Lanes of a block: as many as keep the cells that are used again and again in the cache, and all of them in bounds.
_LANES, _FEWEST, _CELLS, _MOST = 64, 8, 2**18, 2**23


@compiled
def furnished(t: Tables, c: Numbers, size: int) -> Room:
    """Return where things stand for problems of p = `size` unknowns."""
    n, local, largest = t.shared, t.local, 0
    for i in range(t.groups, c.place.shape[0]):
        largest = max(largest, c.place[i, 2])
    own = 0
    observed = own + c.source.shape[1] + c.white.shape[1] + c.prior.shape[1]
    present = observed + c.observed.shape[1]
    rows = present + c.present.shape[1]
    whitened = rows + t.rows * t.width
    error = whitened + t.size * t.width
    scale = error + 2 * largest
    trial = scale + 1
    best = trial + size
    after = best + size
    now = after + (n + local + 1) ** 2
    step = now + (n + local + 1) ** 2
    shared = step + n + local
    shared_scale = shared + n * n
    own_local = shared_scale + n
    local_scale = own_local + local * local
    half = local_scale + local
    state = half + (n + 1) * local
    return Room(
        own,
        observed,
        present,
        rows,
        whitened,
        error,
        scale,
        trial,
        best,
        after,
        now,
        step,
        shared,
        shared_scale,
        own_local,
        local_scale,
        half,
        state,
        state + STATE,
        min(1, c.present.shape[1]),
    )


@compiled
def load(
    m: Array, lane: int, item: int, source: Array, white: Array, prior: Array, observed: Array, present: Array
) -> None:
    """Bring the numbers of a problem into a lane of the memory (cells, B); the arrays are those of `Numbers`."""
    cell = _filled(m, 0, lane, source, item)
    cell = _filled(m, cell, lane, white, item)
    cell = _filled(m, cell, lane, prior, item)
    cell = _filled(m, cell, lane, observed, item)
    _filled(m, cell, lane, present, item)


@compiled
def _filled(m: Array, cell: int, lane: int, source: Array, item: int) -> int:
    row = item if source.shape[0] > 1 else 0
    for i in range(source.shape[1]):
        m[cell + i, lane] = source[row, i]
    return int(cell + source.shape[1])


@compiled
def blocks(packed: Packed, size: int, count: int) -> int:
    """Return how many of a number of problems of p = `size` unknowns are worked on together: they fit the cache."""
    t = packed.tables
    each = t.rows * t.width + 2 * (t.shared + t.local + 1) ** 2
    fitting = min(_CELLS // each, _MOST // (each + 2 * size + packed.numbers.observed.shape[1]))
    return int(max(1, min(count, _LANES, max(_FEWEST, _FEWEST * (fitting // _FEWEST)))))


@compiled
def memory(t: Tables, room: Room, lanes: int) -> tuple[Array, Array]:
    """Return cells and registers for a number of lanes."""
    return np.zeros((room.cells, lanes)), np.zeros((t.registers, max(LENGTH, lanes)))
