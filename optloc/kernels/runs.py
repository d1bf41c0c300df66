"""Damped Gauss-Newton for runs whose epochs have unknowns of their own: eliminated epoch by epoch, nothing is kept.

The rules are those of `optloc.kernels.refine`. A step takes two passes over the epochs: one sums up what they say about
the shared unknowns, one works out their own; a third one finds the cost of the place tried.
"""

from __future__ import annotations

import numpy as np

from optloc.kernels.dense import OPEN, backward, complete, eliminate, factor, factor_local, forward
from optloc.kernels.gather import add_group, add_prior, clear, whiten_group
from optloc.kernels.jit import compiled
from optloc.kernels.lanes import measure
from optloc.kernels.pack import Numbers, Packed
from optloc.kernels.refine import (
    BETTER,
    CLOSED,
    COST,
    DAMPING,
    EMPTY,
    FRESH,
    GAIN,
    NUMERICAL,
    SOLVABLE,
    START,
    STATUS,
    STEPS,
    TRIED,
    Answers,
    Rules,
    begin,
    ended,
    judged,
    refilled,
)
from optloc.kernels.room import Room, blocks, furnished, memory
from optloc.kernels.tables import Tables
from optloc.types import Array

LEFT_OPEN = -1
"""Status of a start on whose way an epoch left its own unknowns open: what then holds is left to numpy."""
_LEAST = 1e-15


@compiled
def refine_runs(packed: Packed, item: Array, first: int, last: int, rules: Rules, out: Answers) -> None:
    """Refine the starts first <= i < last of runs; see `optloc.kernels.refine.refine_block`.

    Neither information nor vector are written.
    """
    t, c = packed
    size = out.x.shape[1]
    lanes, room = blocks(packed, size, last - first), furnished(t, c, size)
    m, r = memory(t, room, lanes)
    tag, used, following = np.zeros((4, lanes), np.int64), lanes, first + lanes
    for b in range(lanes):
        tag[START, b], tag[FRESH, b] = first + b, EMPTY
    while used > 0:
        begin(c, m, room, tag, used, item, out.x)
        _price(t, c, m, r, room, used)
        _judge(m, room, size, tag, rules, used)
        for b in range(used):
            if ended(tag, b, rules.limit):
                _finish(m, room, tag, b, out)
        used, following = refilled(m, room.cells, tag, used, following, last, rules.limit)
        _advance(t, c, m, r, room, tag, rules.damped, used)


@compiled
def _price(t: Tables, c: Numbers, m: Array, r: Array, room: Room, lanes: int) -> None:
    """Write the cost at `room.trial`."""
    cost, last = room.state + TRIED, t.shared + t.local
    total = room.after + (last + 1) ** 2 - 1
    for b in range(lanes):
        m[total, b] = 0.0
    for packet in range(t.packets):
        measure(t, c.common, m, r, room, packet, room.trial, lanes)
        for group in range(t.table[t.packet + packet, 0], t.table[t.packet + packet + 1, 0]):
            residual = whiten_group(t, c.common, c.place, m, room, group, True, lanes)
            for i in range(t.table[t.group + group, 1]):
                for b in range(lanes):
                    m[total, b] += m[residual + i * t.width, b] * m[residual + i * t.width, b]
    _priors(t, c, m, room, room.trial, False, 0, lanes)
    for epoch in range(t.epochs):
        _priors(t, c, m, room, room.trial, True, epoch, lanes)
    for b in range(lanes):
        m[cost, b] = m[total, b]


@compiled
def _priors(t: Tables, c: Numbers, m: Array, room: Room, x: int, local: bool, epoch: int, lanes: int) -> None:
    """Add the priors of the shared unknowns, or of those of an epoch, to the equations in `room.after`."""
    for i in range(t.groups, c.place.shape[0]):
        if (c.place[i, 3] == 1) == local:
            start = c.place[i, 1] + (t.shared if local else 0)
            at = x + start + (epoch * t.local if local else 0)
            add_prior(c.common, c.place[i, 0], c.place[i, 2], m, room, at, start, t.shared + t.local, lanes)


@compiled
def _judge(m: Array, room: Room, size: int, tag: Array, rules: Rules, used: int) -> None:
    """Take the places tried that are better, and set damping and status."""
    better, cost, tried = room.state + BETTER, room.state + COST, room.state + TRIED
    for b in range(used):
        if tag[FRESH, b]:
            m[better, b], m[room.state + CLOSED, b], tag[FRESH, b] = 1.0, 1.0, 0
            if not np.isfinite(m[tried, b]):
                tag[STATUS, b] = NUMERICAL
        elif m[room.state + CLOSED, b] == 0.0:
            m[better, b], tag[STATUS, b] = 0.0, LEFT_OPEN
        else:
            tag[STATUS, b] = judged(m, room, cost, tried, rules, b)
        m[cost, b] = m[tried, b] if m[better, b] != 0.0 else m[cost, b]
    for i in range(size):
        for b in range(used):
            m[room.best + i, b] = m[room.trial + i, b] if m[better, b] != 0.0 else m[room.best + i, b]


@compiled
def _finish(m: Array, room: Room, tag: Array, lane: int, out: Answers) -> None:
    """Write the answer of a lane."""
    start = tag[START, lane]
    out.cost[start], out.iterations[start] = m[room.state + COST, lane], tag[STEPS, lane]
    out.status[start] = tag[STATUS, lane]
    for i in range(out.x.shape[1]):
        out.x[start, i] = m[room.best + i, lane]


@compiled
def _advance(t: Tables, c: Numbers, m: Array, r: Array, room: Room, tag: Array, damped: bool, used: int) -> None:
    """Write the next place to try of every lane that is not fresh, and the squared length of the step."""
    n, damping, gain = t.shared, room.state + DAMPING, room.state + GAIN
    vector = room.now + (n + t.local) * (n + t.local + 1)
    for b in range(used):
        m[damping, b] = m[damping, b] if damped else 0.0
    _pass(t, c, m, r, room, tag, True, used)
    factor(m, room.shared, n, room.shared_scale, room.state + SOLVABLE, _LEAST, used)
    forward(m, room.shared, n, room.shared_scale, room.step, used)
    backward(m, room.shared, n, room.shared_scale, room.step, used)
    for b in range(used):
        m[gain, b] = 0.0
    for i in range(n):
        for b in range(used):
            m[room.step + i, b] = m[room.step + i, b] if m[room.state + SOLVABLE, b] != 0.0 else 0.0
            m[gain, b] += m[room.step + i, b] * m[vector + i, b]
            if tag[FRESH, b] == 0:
                m[room.trial + i, b] = m[room.best + i, b] + m[room.step + i, b]
    _pass(t, c, m, r, room, tag, False, used)
    for b in range(used):
        tag[STEPS, b] += 1 - tag[FRESH, b]


@compiled
def _pass(t: Tables, c: Numbers, m: Array, r: Array, room: Room, tag: Array, summing: bool, lanes: int) -> None:
    """Go through the epochs at `room.best`: sum up the shared system (in `room.now` undamped), or step their own."""
    n, local, last = t.shared, t.local, t.shared + t.local
    group, packet, line = 0, 0, last + 1
    if summing:
        clear(m, room.now, line * line, lanes)
        clear(m, room.shared, n * n, lanes)
        clear(m, room.step, n, lanes)
        for b in range(lanes):
            m[room.state + SOLVABLE, b], m[room.state + CLOSED, b] = 1.0, 1.0
    for epoch in range(t.epochs + 1):
        clear(m, room.after, line * line, lanes)
        while group < t.groups and t.table[t.group + group, 2] == epoch:
            if packet < t.packets and t.table[t.packet + packet, 0] == group:
                measure(t, c.common, m, r, room, packet, room.best, lanes)
                packet += 1
            add_group(t, c.common, c.place, m, room, group, lanes)
            group += 1
        whole = epoch == t.epochs  # behind the last epoch come the priors of what lasts the run
        _priors(t, c, m, room, room.best, not whole, epoch, lanes)
        if not whole:
            closed = room.state + CLOSED
            factor_local(m, room, room.after, n, local, room.state + DAMPING, closed, OPEN, lanes)
            if summing:
                eliminate(m, room, n, local, lanes)
            else:
                _own(m, room, tag, n, local, epoch, lanes)
        if summing:
            for cell in range(line * line):
                for b in range(lanes):
                    m[room.now + cell, b] += m[room.after + cell, b]
    if summing:
        _added(m, room, n, line, lanes)


@compiled
def _own(m: Array, room: Room, tag: Array, n: int, local: int, epoch: int, lanes: int) -> None:
    """Write the step of the unknowns of an epoch."""
    complete(m, room, n, local, lanes)
    vector, at = room.after + (n + local) * (n + local + 1) + n, n + epoch * local
    for a in range(local):
        for b in range(lanes):
            m[room.state + GAIN, b] += m[room.step + n + a, b] * m[vector + a, b]
            if tag[FRESH, b] == 0:
                m[room.trial + at + a, b] = m[room.best + at + a, b] + m[room.step + n + a, b]


@compiled
def _added(m: Array, room: Room, n: int, line: int, lanes: int) -> None:
    """Add the damped sums of all epochs to what their unknowns cost them."""
    for i in range(n):
        for j in range(i + 1):
            for b in range(lanes):
                grown = 1.0 + m[room.state + DAMPING, b] if i == j else 1.0
                m[room.shared + i * n + j, b] += m[room.now + i * line + j, b] * grown
        for b in range(lanes):
            m[room.step + i, b] += m[room.now + (line - 1) * line + i, b]
