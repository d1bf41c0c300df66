"""Damped Gauss-Newton for many problems in one call: the rules of `optloc.solve.refine`, lane by lane.

A lane whose problem is finished takes the next one, so that the lanes are full until the problems run out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.kernels.dense import step
from optloc.kernels.equations import chunks
from optloc.kernels.gather import gather
from optloc.kernels.jit import compiled
from optloc.kernels.pack import Numbers, Packed
from optloc.kernels.room import Room, blocks, furnished, load, memory
from optloc.status import Status
from optloc.threads import mapped
from optloc.types import Array

_OK, _LIMIT, _STALLED, _NUMERICAL = (
    int(status) for status in (Status.OK, Status.MAX_ITERATIONS, Status.STALLED, Status.NUMERICAL)
)
_EPSILON = float(np.finfo(float).eps)


class Rules(NamedTuple):
    """When a refinement ends; see `optloc.solve.refine.refine`."""

    tolerance: float = 1e-7
    limit: int = 60
    damped: bool = True


class Answers(NamedTuple):
    """Where the refinements of M starts ended; p unknowns, shared ones and then local ones."""

    x: Array  # (M, p): starts, replaced by the answers
    cost: Array  # (M,)
    status: Array  # int8 (M,)
    iterations: Array  # int32 (M,)
    matrix: Array  # (M, p, p): information at the answers
    vector: Array  # (M, p)


# Cells that a refinement keeps of every problem, from `room.state` on; `room.STATE` of them.
_DAMPING, _GROWTH, _BLUR, _GAIN, _SOLVABLE, _BETTER = range(6)
# What it keeps beside them: which start it is, 1 while nothing but the start is
# known and 2 before it is there, steps tried, status.
_START, _FRESH, _STEPS, _STATUS = range(4)
_EMPTY = 2


def answers(start: Array) -> Answers:
    """Return room for the answers of starts (M, p), which are copied."""
    count, size = start.shape
    return Answers(
        np.array(start, dtype=float, order="C"),
        np.empty(count),
        np.empty(count, dtype=np.int8),
        np.empty(count, dtype=np.int32),
        np.empty((count, size, size)),
        np.empty((count, size)),
    )


def refined(packed: Packed, item: Array, start: Array, rules: Rules) -> Answers:
    """Return where the refinements of starts (M, p) of given problems end; see `refine_block`."""
    out = answers(start)
    mapped(lambda part: refine_block(packed, item, part[0], part[1], rules, out), chunks(len(start)))
    return out


@compiled
def refine_block(packed: Packed, item: Array, first: int, last: int, rules: Rules, out: Answers) -> None:
    """Refine the starts first <= i < last; several threads may work on one set of answers.

    Parameters
    ----------
    packed : Packed
        N problems of one epoch, or without unknowns local to the epochs.
    item : int64 array (M,)
        Problem of each start.
    first, last : int
        Which starts.
    rules : Rules
        When to stop.
    out : Answers
        Starts; they become the answers. Status: ok, max iterations, stalled, numerical.
    """
    t, c = packed
    size = out.x.shape[1]
    lanes, room = blocks(packed, size, last - first), furnished(t, c, size)
    m, r = memory(t, room, lanes)
    tag = np.zeros((4, lanes), np.int64)
    used, following = 0, first
    while used < lanes:
        tag[_START, used], tag[_FRESH, used] = following, _EMPTY
        used, following = used + 1, following + 1
    while used > 0:
        _begin(c, m, room, tag, used, item, out.x)
        gather(t, c, m, r, room, True, used)
        _judge(m, room, size, tag, rules, used)
        b = 0
        while b < used:
            if tag[_STATUS, b] == _LIMIT and tag[_STEPS, b] < rules.limit:
                b += 1
                continue
            _finish(m, room, tag, b, out)
            if following < last:
                tag[_START, b], tag[_FRESH, b] = following, _EMPTY
                following, b = following + 1, b + 1
            else:
                used -= 1
                _move(m, room.cells, tag, b, used)
        _advance(m, room, t.shared, t.local, tag, rules.damped, used)


@compiled
def _begin(c: Numbers, m: Array, room: Room, tag: Array, used: int, item: Array, x: Array) -> None:
    """Bring the starts of empty lanes into them."""
    for b in range(used):
        if tag[_FRESH, b] == _EMPTY:
            start = tag[_START, b]
            tag[_FRESH, b], tag[_STEPS, b], tag[_STATUS, b] = 1, 0, _LIMIT
            load(m, b, item[start], c.source, c.white, c.prior, c.observed, c.present)
            for i in range(x.shape[1]):
                m[room.trial + i, b] = x[start, i]
            m[room.state + _DAMPING, b], m[room.state + _GROWTH, b] = 1e-6, 2.0
            m[room.state + _BLUR, b] = _blur(c.sigma, c.size, m, room, b, item[start])


@compiled
def _blur(sigma: Array, size: Array, m: Array, room: Room, lane: int, item: int) -> float:
    """Return the rounding error of the whitened residuals: arrival times that count from long ago are coarse."""
    row, squares = item if sigma.shape[0] > 1 else 0, 0.0
    for i in range(sigma.shape[1]):
        if not room.absent or m[room.present + i, lane] != 0.0:
            ratio = (abs(m[room.observed + i, lane]) + size[i]) / sigma[row, i]
            squares += ratio * ratio
    coarse = 4.0 * _EPSILON * np.sqrt(squares)
    return coarse if np.isfinite(coarse) else 0.0


@compiled
def _move(m: Array, cells: int, tag: Array, to: int, lane: int) -> None:
    """Bring the problem of one lane into another."""
    if to != lane:
        for i in range(tag.shape[0]):
            tag[i, to] = tag[i, lane]
        for i in range(cells):
            m[i, to] = m[i, lane]


@compiled
def _judge(m: Array, room: Room, size: int, tag: Array, rules: Rules, used: int) -> None:
    """Take the places tried that are better, and set damping and status."""
    line = size + 1
    better, cost = room.state + _BETTER, line * line - 1
    for b in range(used):
        if tag[_FRESH, b]:
            m[better, b], tag[_FRESH, b] = 1.0, 0
            if not np.isfinite(m[room.after + cost, b]):
                tag[_STATUS, b] = _NUMERICAL
        else:
            tag[_STATUS, b] = _judged(m, room, room.now + cost, room.after + cost, rules, b)
    for i in range(size):
        for b in range(used):
            m[room.best + i, b] = m[room.trial + i, b] if m[better, b] != 0.0 else m[room.best + i, b]
    for i in range(line):
        for cell in range(i * line, i * line + i + 1):
            for b in range(used):
                m[room.now + cell, b] = m[room.after + cell, b] if m[better, b] != 0.0 else m[room.now + cell, b]


@compiled
def _judged(m: Array, room: Room, now: int, after: int, rules: Rules, b: int) -> int:
    """Return the status of a lane after a step; say whether it is better and set the damping."""
    state, status = room.state, _LIMIT
    cost, new, gain, blur = m[now, b], m[after, b], m[state + _GAIN, b], m[state + _BLUR, b]
    damping, solvable = m[state + _DAMPING, b], m[state + _SOLVABLE, b] != 0.0
    achieved, floor = cost - new, 1e-13 * (1.0 + cost)
    rounding = floor + 2.0 * blur * np.sqrt(1.0 + cost)
    better = solvable and np.isfinite(new) and (achieved >= -rounding or not rules.damped)
    if solvable and abs(gain) * (1.0 + damping) <= max(rules.tolerance * rules.tolerance, floor + blur * blur):
        status = _OK
    if better:
        ratio = achieved / (gain if gain > 0.0 else 1.0)
        middle = 2.0 * min(max(ratio, 0.0), 1.0) - 1.0
        change = 0.1 if ratio > 0.9 else max(1.0 / 3.0, 1.0 - middle * middle * middle)
        m[state + _DAMPING, b], m[state + _GROWTH, b] = max(damping * change, 1e-12), 2.0
    else:
        m[state + _DAMPING, b] = damping * m[state + _GROWTH, b] + 1e-12
        m[state + _GROWTH, b] *= 2.0
        if m[state + _DAMPING, b] > 1e12:
            status = _STALLED
        if not rules.damped:
            status = _NUMERICAL
    m[state + _BETTER, b] = 1.0 if better else 0.0
    return status


@compiled
def _finish(m: Array, room: Room, tag: Array, lane: int, out: Answers) -> None:
    """Write the answer of a lane."""
    start, size = tag[_START, lane], out.x.shape[1]
    last = room.now + size * (size + 1)
    out.cost[start], out.iterations[start] = m[last + size, lane], tag[_STEPS, lane]
    out.status[start] = tag[_STATUS, lane]
    for i in range(size):
        out.x[start, i], out.vector[start, i] = m[room.best + i, lane], m[last + i, lane]
        for j in range(i + 1):
            entry = m[room.now + i * (size + 1) + j, lane]
            out.matrix[start, i, j], out.matrix[start, j, i] = entry, entry


@compiled
def _advance(m: Array, room: Room, n: int, local: int, tag: Array, damped: bool, used: int) -> None:
    """Write the next place to try of every lane that is not fresh, and the squared length of the step."""
    size, damping, gain = n + local, room.state + _DAMPING, room.state + _GAIN
    vector = room.now + size * (size + 1)
    for b in range(used):
        m[damping, b] = m[damping, b] if damped else 0.0
        m[gain, b] = 0.0
    step(m, room, n, local, damping, room.state + _SOLVABLE, used)
    for i in range(size):
        for b in range(used):
            m[gain, b] += m[room.step + i, b] * m[vector + i, b]
            m[room.trial + i, b] = m[room.trial + i, b] if tag[_FRESH, b] else m[room.best + i, b] + m[room.step + i, b]
    for b in range(used):
        tag[_STEPS, b] += 1 - tag[_FRESH, b]
