"""From derivatives and residuals to normal equations: whitened, multiplied with themselves, summed over groups."""

from __future__ import annotations

from optloc.kernels.jit import compiled
from optloc.kernels.lanes import measure
from optloc.kernels.pack import Numbers
from optloc.kernels.room import Room
from optloc.kernels.tables import Tables
from optloc.types import Array


@compiled
def gather(t: Tables, c: Numbers, m: Array, r: Array, room: Room, priors: bool, lanes: int) -> None:
    """Write the normal equations at `room.trial` into `room.after`.

    Parameters
    ----------
    t : Tables
        Indices of problems of one epoch, or without unknowns local to the epochs.
    c : Numbers
        What the problems share.
    m : array (cells, B)
        Memory.
    r : array (registers, LENGTH)
        Registers.
    room : Room
        Where things stand.
    priors : bool
        Whether Gaussian priors are added.
    lanes : int
        How many lanes hold a problem.
    """
    last = t.shared + t.local
    clear(m, room.after, (last + 1) ** 2, lanes)
    for packet in range(t.packets):
        measure(t, c.common, m, r, room, packet, room.trial, lanes)
        for group in range(t.table[t.packet + packet, 0], t.table[t.packet + packet + 1, 0]):
            add_group(t, c.common, c.place, m, room, group, lanes)
    for i in range(t.groups, c.place.shape[0] if priors else t.groups):
        start = c.place[i, 1] + (t.shared if c.place[i, 3] else 0)
        add_prior(c.common, c.place[i, 0], c.place[i, 2], m, room, room.trial + start, start, last, lanes)


@compiled
def clear(m: Array, first: int, count: int, lanes: int) -> None:
    """Write zeros."""
    for cell in range(first, first + count):
        for b in range(lanes):
            m[cell, b] = 0.0


@compiled
def add_group(t: Tables, common: Array, place: Array, m: Array, room: Room, group: int, lanes: int) -> None:
    """Add the whitened rows of a group to the equations in `room.after`."""
    line = t.group + group
    columns, column = t.table[line + 1, 3] - t.table[line, 3] + 1, t.column + t.table[line, 3]
    first = whiten_group(t, common, place, m, room, group, False, lanes)
    _square(t.table, column, m, first, t.width, t.table[line, 1], columns, room.after, t.shared + t.local, lanes)


@compiled
def whiten_group(
    t: Tables, common: Array, place: Array, m: Array, room: Room, group: int, residual: bool, lanes: int
) -> int:
    """Whiten the rows of a group, or their residuals alone, and return the cell of the first."""
    line = t.group + group
    columns = t.table[line + 1, 3] - t.table[line, 3]
    begin = room.rows + t.table[line, 0] * t.width + (columns if residual else 0)
    count, size = (1 if residual else columns + 1), t.table[line, 1]
    _whiten(common, place[group, 0], place[group, 1], m, room.own, begin, t.width, size, count, room.whitened, lanes)
    return room.whitened


@compiled
def _whiten(
    common: Array,
    place: int,
    full: int,
    m: Array,
    own: int,
    first: int,
    width: int,
    size: int,
    columns: int,
    to: int,
    lanes: int,
) -> None:
    """Write `size` rows from cell `first` on, whitened, to cell `to`."""
    for i in range(size):
        for s in range(columns):
            cell = to + i * width + s
            for b in range(lanes):
                m[cell, b] = 0.0
            for j in range(size if full else i + 1):
                row = first + j * width + s
                if place >= 0:
                    factor = common[place + i * size + j]
                    for b in range(lanes):
                        m[cell, b] += factor * m[row, b]
                else:
                    matrix = own - 1 - place + i * size + j
                    for b in range(lanes):
                        m[cell, b] += m[matrix, b] * m[row, b]


@compiled
def _square(
    index: Array,
    column: int,
    m: Array,
    first: int,
    width: int,
    size: int,
    columns: int,
    to: int,
    last: int,
    lanes: int,
) -> None:
    """Add the products of the columns of whitened rows; the last column is the residual."""
    for i in range(columns):
        line = to + (index[column + i, 0] if i < columns - 1 else last) * (last + 1)
        for j in range(i + 1):
            cell = line + (index[column + j, 0] if j < columns - 1 else last)
            r, u, v = 0, first + i, first + j
            while r + 3 < size:
                for b in range(lanes):
                    m[cell, b] += (m[u, b] * m[v, b] + m[u + width, b] * m[v + width, b]) + (
                        m[u + 2 * width, b] * m[v + 2 * width, b] + m[u + 3 * width, b] * m[v + 3 * width, b]
                    )
                r, u, v = r + 4, u + 4 * width, v + 4 * width
            while r < size:
                for b in range(lanes):
                    m[cell, b] += m[u, b] * m[v, b]
                r, u, v = r + 1, u + width, v + width


@compiled
def add_prior(
    common: Array, place: int, size: int, m: Array, room: Room, x: int, start: int, last: int, lanes: int
) -> None:
    """Add a Gaussian prior of the `size` unknowns at cell x on, whose first column is `start`."""
    error, pull, to = room.error, room.error + size, room.after
    vector = to + last * (last + 1)
    for i in range(size):
        for b in range(lanes):
            m[error + i, b] = (common[place + i] if place >= 0 else m[room.own - 1 - place + i, b]) - m[x + i, b]
            m[pull + i, b] = 0.0
    for i in range(size):
        for j in range(size):
            at, cell = size + i * size + j, to + (start + i) * (last + 1) + start + j
            for b in range(lanes):
                precision = common[place + at] if place >= 0 else m[room.own - 1 - place + at, b]
                m[pull + i, b] += precision * m[error + j, b]
                if j <= i:
                    m[cell, b] += precision
    for i in range(size):
        for b in range(lanes):
            m[vector + start + i, b] += m[pull + i, b]
            m[vector + last, b] += m[error + i, b] * m[pull + i, b]
