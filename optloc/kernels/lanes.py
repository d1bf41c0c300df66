"""Measurements and derivatives of many problems at once: one interpreter runs the tape of a kind over lanes.

Numbers are reached by whole indices, never by views of arrays: a view counts references, which takes longer than what
is done with it.
"""

from __future__ import annotations

from math import pi

import numpy as np

from optloc.kernels.jit import compiled
from optloc.kernels.room import LENGTH, Room
from optloc.kernels.symbol import ADD, ATAN2, COS, DIV, HYPOT, LOG, MUL, NEG, SIN, SQRT, SUB
from optloc.kernels.tables import Tables
from optloc.types import Array


@compiled
def run(code: Array, first: int, last: int, r: Array, count: int) -> None:
    """Run operations on the first numbers of registers; see `Tape` and `symbol.OPERATIONS`."""
    for step in range(first, last):
        operation, to, u, v = code[step, 0], code[step, 1], code[step, 2], code[step, 3]
        if operation == MUL:
            for i in range(count):
                r[to, i] = r[u, i] * r[v, i]
        elif operation == ADD:
            for i in range(count):
                r[to, i] = r[u, i] + r[v, i]
        elif operation == SUB:
            for i in range(count):
                r[to, i] = r[u, i] - r[v, i]
        elif operation == DIV:
            for i in range(count):
                r[to, i] = r[u, i] / r[v, i]
        elif operation == SQRT:
            for i in range(count):
                r[to, i] = np.sqrt(r[u, i])
        else:
            _rare(operation, r, to, u, v, count)


@compiled
def _rare(operation: int, r: Array, to: int, u: int, v: int, count: int) -> None:
    if operation == NEG:
        for i in range(count):
            r[to, i] = -r[u, i]
    elif operation == HYPOT:
        for i in range(count):
            r[to, i] = np.sqrt(r[u, i] * r[u, i] + r[v, i] * r[v, i])
    elif operation == ATAN2:
        for i in range(count):
            r[to, i] = np.arctan2(r[u, i], r[v, i])
    elif operation == SIN:
        for i in range(count):
            r[to, i] = np.sin(r[u, i])
    elif operation == COS:
        for i in range(count):
            r[to, i] = np.cos(r[u, i])
    elif operation == LOG:
        for i in range(count):
            r[to, i] = np.log(r[u, i])
    else:
        for i in range(count):
            r[to, i] = np.exp(r[u, i])


@compiled
def measure(t: Tables, common: Array, m: Array, r: Array, room: Room, packet: int, x: int, lanes: int) -> None:
    """Write derivatives and residuals of a packet: columns of the row's group, then the residual.

    Parameters
    ----------
    t : Tables
        Indices.
    common : array
        What the problems share.
    m : array (cells, B)
        Memory; the rows of the packet are written to `room.rows`.
    r : array (registers, LENGTH)
        Registers.
    room : Room
        Where things stand.
    packet : int
        Which rows.
    x : int
        Cell of the parameter vectors.
    lanes : int
        How many lanes hold a problem.
    """
    index, together = t.table, LENGTH // max(1, min(lanes, LENGTH))
    for number in range(t.kinds):
        kind, part = t.kind + number, t.part + packet * (t.kinds + 1) + number
        for row in range(index[part, 0], index[part + 1, 0], together):
            end = min(row + together, index[part + 1, 0])
            count, begin = (end - row) * lanes, t.input + index[kind, 2]
            _inputs(t, common, m, room.own, r, begin, row, end, x, lanes)
            for i in range(index[kind, 1], index[kind + 1, 1]):
                for j in range(count):
                    r[index[t.constant + i, 0], j] = t.real[i]
            run(index, t.code + index[kind, 0], t.code + index[kind + 1, 0], r, count)
            for one in range(row, end):
                line, low = t.row + one, (one - row) * lanes
                to = room.rows + index[line, 1] * t.width
                _derivatives(t, m, r, begin, line, low, to, lanes)
                _measurement(t, m, r, index[kind, 3], line, low, to, x, room.scale, lanes)
                _residual(m, to + index[line, 2], room.observed + index[line, 0], index[kind, 4], lanes)
                if room.absent:
                    _masked(m, to + index[line, 2], room.present + index[line, 0], lanes)


@compiled
def _inputs(
    t: Tables, common: Array, m: Array, own: int, r: Array, begin: int, row: int, end: int, x: int, lanes: int
) -> None:
    """Write the inputs of rows of one kind, which `begin` in the table of inputs, into their registers."""
    index = t.table
    for one in range(row, end):
        low, source = (one - row) * lanes, index[t.row + one, 3]
        for i in range(index[t.row + one + 1, 3] - source):
            to, line = index[begin + i, 0], t.source + source + i
            place = index[line, 0]
            if place >= 0:
                for b in range(lanes):
                    r[to, low + b] = common[place]
            else:
                for b in range(lanes):
                    r[to, low + b] = m[own - 1 - place, b]
            for f in range(index[line, 1], index[line + 1, 1]):
                column, factor = x + index[t.term + f, 0], t.real[t.factor + f]
                for b in range(lanes):
                    r[to, low + b] += factor * m[column, b]


@compiled
def _derivatives(t: Tables, m: Array, r: Array, begin: int, line: int, low: int, to: int, lanes: int) -> None:
    """Write the derivatives of h of one row by the unknowns that move its inputs."""
    index = t.table
    source = index[line, 3]
    for j in range(index[line, 2]):
        for b in range(lanes):
            m[to + j, b] = 0.0
    for i in range(index[line + 1, 3] - source):
        place = index[begin + i, 1]
        if place >= 0:
            for f in range(index[t.source + source + i, 1], index[t.source + source + i + 1, 1]):
                cell, factor = to + index[t.term + f, 1], t.real[t.factor + f]
                for b in range(lanes):
                    m[cell, b] += factor * r[place, low + b]


@compiled
def _measurement(
    t: Tables, m: Array, r: Array, place: int, line: int, low: int, to: int, x: int, scale: int, lanes: int
) -> None:
    """Write the value of one row behind its derivatives, and what scales and offsets do to both."""
    index = t.table
    value, first, last, end = to + index[line, 2], index[line, 4], index[line + 1, 4], index[line + 1, 5]
    for b in range(lanes):
        m[value, b] = r[place, low + b]
    if last > first:
        for b in range(lanes):
            m[scale, b] = 1.0
        for i in range(first, last):
            for b in range(lanes):
                m[scale, b] += t.real[t.factor + i] * m[x + index[t.term + i, 0], b]
        for cell in range(to, value):
            for b in range(lanes):
                m[cell, b] *= m[scale, b]
        for i in range(first, last):
            for b in range(lanes):
                m[to + index[t.term + i, 1], b] += t.real[t.factor + i] * m[value, b]
        for b in range(lanes):
            m[value, b] *= m[scale, b]
    for i in range(index[line, 5], end):
        factor, cell, column = t.real[t.factor + i], to + index[t.term + i, 1], x + index[t.term + i, 0]
        for b in range(lanes):
            m[cell, b] += factor
        for b in range(lanes):
            m[value, b] += factor * m[column, b]


@compiled
def _residual(m: Array, value: int, observed: int, periodic: int, lanes: int) -> None:
    """Replace values by residuals, angles wrapped."""
    for b in range(lanes):
        m[value, b] = m[observed, b] - m[value, b]
    if periodic:
        for b in range(lanes):
            if not -pi < m[value, b] <= pi:
                m[value, b] = np.arctan2(np.sin(m[value, b]), np.cos(m[value, b]))


@compiled
def _masked(m: Array, value: int, present: int, lanes: int) -> None:
    """Make the residuals of absent rows zero."""
    for b in range(lanes):
        m[value, b] = m[value, b] if m[present, b] != 0.0 else 0.0
