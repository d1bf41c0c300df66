"""Measurements and derivatives of many problems at once: one interpreter runs the tape of a kind over lanes.

A lane is a problem; arrays end with the axis of the lanes. Rows of one kind are put behind each other until the
registers are as long as they should be, so that a single problem with many rows is no slower than many problems.
"""

from __future__ import annotations

from math import atan2, cos, pi, sin
from typing import NamedTuple

import numpy as np

from optloc.kernels.jit import compiled
from optloc.kernels.pack import Numbers, Packed
from optloc.kernels.symbol import ADD, ATAN2, COS, DIV, HYPOT, LOG, MUL, NEG, SIN, SQRT, SUB
from optloc.kernels.tables import Tables
from optloc.types import Array

LENGTH = 128
"""Length of a register."""


class Scratch(NamedTuple):
    """Working memory for B lanes."""

    own: Array  # (numbers, B): what each problem has to itself
    observed: Array  # (m, B)
    present: Array  # (m, B), or none where all rows count
    white: Array  # (numbers, B)
    prior: Array  # (numbers, B)
    registers: Array  # (registers, LENGTH)
    rows: Array  # (rows of a packet, columns and residual, B)
    whitened: Array  # (rows of a group, columns and residual, B)
    error: Array  # (2 * largest prior, B)
    scale: Array  # (B,)


@compiled
def scratch(packed: Packed, lanes: int) -> Scratch:
    """Return working memory for a number of lanes."""
    t, c = packed
    largest = 1
    for size in c.prior_size:
        largest = max(largest, size)
    return Scratch(
        np.zeros((c.own.shape[1], lanes)),
        np.zeros((c.observed.shape[1], lanes)),
        np.zeros((c.present.shape[1], lanes)),
        np.zeros((c.white_own.shape[1], lanes)),
        np.zeros((c.prior_own.shape[1], lanes)),
        np.zeros((t.registers, max(LENGTH, lanes))),
        np.zeros((t.rows, t.width, lanes)),
        np.zeros((t.size, t.width, lanes)),
        np.zeros((2 * largest, lanes)),
        np.zeros(lanes),
    )


@compiled
def _fill(target: Array, lane: int, source: Array, item: int) -> None:
    row = source[item if source.shape[0] > 1 else 0]
    for i in range(row.shape[0]):
        target[i, lane] = row[i]


@compiled
def load(packed: Packed, work: Scratch, lane: int, item: int) -> None:
    """Bring the numbers of a problem into a lane."""
    c = packed.numbers
    _fill(work.own, lane, c.own, item)
    _fill(work.observed, lane, c.observed, item)
    _fill(work.present, lane, c.present, item)
    _fill(work.white, lane, c.white_own, item)
    _fill(work.prior, lane, c.prior_own, item)


@compiled
def move(work: Scratch, to: int, lane: int) -> None:
    """Bring the numbers of one lane into another."""
    for array in (work.own, work.observed, work.present, work.white, work.prior):
        for i in range(array.shape[0]):
            array[i, to] = array[i, lane]


@compiled
def run(code: Array, first: int, last: int, registers: Array, count: int) -> None:
    """Run operations on the first numbers of the registers; see `Tape` and `symbol.OPERATIONS`."""
    for step in range(first, last):
        operation = code[step, 0]
        out, u, v = registers[code[step, 1]], registers[code[step, 2]], registers[code[step, 3]]
        if operation == MUL:
            for i in range(count):
                out[i] = u[i] * v[i]
        elif operation == ADD:
            for i in range(count):
                out[i] = u[i] + v[i]
        elif operation == SUB:
            for i in range(count):
                out[i] = u[i] - v[i]
        elif operation == DIV:
            for i in range(count):
                out[i] = u[i] / v[i]
        elif operation == SQRT:
            for i in range(count):
                out[i] = np.sqrt(u[i])
        elif operation == NEG:
            for i in range(count):
                out[i] = -u[i]
        elif operation == HYPOT:
            for i in range(count):
                out[i] = np.sqrt(u[i] * u[i] + v[i] * v[i])
        else:
            _rare(operation, out, u, v, count)


@compiled
def _rare(operation: int, out: Array, u: Array, v: Array, count: int) -> None:
    for i in range(count):
        if operation == ATAN2:
            out[i] = atan2(u[i], v[i])
        elif operation == SIN:
            out[i] = np.sin(u[i])
        elif operation == COS:
            out[i] = np.cos(u[i])
        elif operation == LOG:
            out[i] = np.log(u[i])
        else:
            out[i] = np.exp(u[i])


@compiled
def measure(packed: Packed, work: Scratch, x: Array, packet: int, lanes: int) -> None:
    """Write derivatives and residuals of a packet into `work.rows`: columns of the row's group, then the residual.

    Parameters
    ----------
    packed : Packed
        The problems.
    work : Scratch
        Their numbers.
    x : array (size, B)
        Parameter vectors.
    packet : int
        Which rows.
    lanes : int
        How many lanes hold a problem.
    """
    t, c = packed
    together = max(1, LENGTH // lanes)
    for kind in range(t.value_register.shape[0]):
        first, last = t.packet_row[packet, kind], t.packet_row[packet, kind + 1]
        for row in range(first, last, together):
            end = min(row + together, last)
            count = (end - row) * lanes
            _inputs(t, c, work, x, kind, row, end, lanes)
            for i in range(t.constant_at[kind], t.constant_at[kind + 1]):
                work.registers[t.constant_register[i], :count] = t.constant[i]
            run(t.code, t.code_at[kind], t.code_at[kind + 1], work.registers, count)
            for one in range(row, end):
                _derivatives(t, work, kind, one, (one - row) * lanes, lanes)
                _measurement(t, work, x, kind, one, (one - row) * lanes, lanes)


@compiled
def _inputs(
    t: Tables, c: Numbers, work: Scratch, x: Array, kind: int, row: int, end: int, lanes: int
) -> None:
    """Write the inputs of rows of one kind into their registers."""
    begin = t.input_at[kind]
    for one in range(row, end):
        low, source = (one - row) * lanes, t.source_at[one]
        for i in range(t.source_at[one + 1] - source):
            register = work.registers[t.input_register[begin + i]][low : low + lanes]
            place = t.source[source + i]
            if place >= 0:
                register[:] = c.common[place]
            else:
                register[:] = work.own[-1 - place][:lanes]
            for f in range(t.feed_at[source + i], t.feed_at[source + i + 1]):
                column, factor = x[t.feed_column[f]], t.feed_factor[f]
                for b in range(lanes):
                    register[b] += factor * column[b]


@compiled
def _derivatives(t: Tables, work: Scratch, kind: int, row: int, low: int, lanes: int) -> None:
    """Write the derivatives of h of one row by the unknowns that move its inputs."""
    target, begin, source = work.rows[t.place[row]], t.input_at[kind], t.source_at[row]
    target[: t.last[row], :lanes] = 0.0
    for i in range(t.source_at[row + 1] - source):
        place = t.partial_register[begin + i]
        if place >= 0:
            partial = work.registers[place][low : low + lanes]
            for f in range(t.feed_at[source + i], t.feed_at[source + i + 1]):
                column, factor = target[t.feed_slot[f]], t.feed_factor[f]
                for b in range(lanes):
                    column[b] += factor * partial[b]


@compiled
def _measurement(t: Tables, work: Scratch, x: Array, kind: int, row: int, low: int, lanes: int) -> None:
    """Write the residual of one row, and what scales and offsets do to its derivatives."""
    target = work.rows[t.place[row]]
    value = work.registers[t.value_register[kind]][low : low + lanes]
    residual = target[t.last[row]]
    for b in range(lanes):
        residual[b] = value[b]
    if t.scale_at[row + 1] > t.scale_at[row]:
        _scaled(t, work, x, row, target, residual, lanes)
    for i in range(t.add_at[row], t.add_at[row + 1]):
        column, derivative, factor = x[t.add_column[i]], target[t.add_slot[i]], t.add_factor[i]
        for b in range(lanes):
            derivative[b] += factor
            residual[b] += factor * column[b]
    observed = work.observed[t.row[row]]
    for b in range(lanes):
        residual[b] = observed[b] - residual[b]
    if t.periodic[kind]:
        for b in range(lanes):
            if not -pi < residual[b] <= pi:
                residual[b] = atan2(sin(residual[b]), cos(residual[b]))
    if work.present.shape[0] > 0:
        present = work.present[t.row[row]]
        for b in range(lanes):
            if present[b] == 0.0:
                residual[b] = 0.0


@compiled
def _scaled(t: Tables, work: Scratch, x: Array, row: int, target: Array, value: Array, lanes: int) -> None:
    """Scale the value of a row and its derivatives, and write those by the scale factors."""
    scale = work.scale
    scale[:lanes] = 1.0
    for i in range(t.scale_at[row], t.scale_at[row + 1]):
        column, factor = x[t.scale_column[i]], t.scale_factor[i]
        for b in range(lanes):
            scale[b] += factor * column[b]
    for j in range(t.last[row]):
        for b in range(lanes):
            target[j, b] *= scale[b]
    for i in range(t.scale_at[row], t.scale_at[row + 1]):
        derivative, factor = target[t.scale_slot[i]], t.scale_factor[i]
        for b in range(lanes):
            derivative[b] += factor * value[b]
    for b in range(lanes):
        value[b] *= scale[b]
