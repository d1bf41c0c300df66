"""Damped Gauss-Newton for many problems in one call, with the rules of `optloc.kernels.least_squares` in lanes.

When a problem in a lane has ended, the lane takes the next problem, so that all lanes work until no problem is left.
Letters: n shared unknowns, `local` local unknowns of an epoch, B lanes. `m` is the memory (cells, B), `room` its
addresses, r are registers, t the tables and c the numbers of the problems, see `optloc.kernels.batched_rows`. `tag`
(4, B) is the integer state of every lane, `used` is the number of open lanes. A *fresh* lane has a start that was not
evaluated yet. `limit` and `damped` are fields of the rules, see `StopRules`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.linalg import PIVOT
from optloc.base.threads import map_on_threads
from optloc.base.types import Array, Status
from optloc.kernels.batched_rows import (
    LaneCells,
    add_groups,
    add_priors,
    blocks,
    cell_layout,
    clear,
    load,
    memory,
    rounding_of_residuals,
    write_cost,
    write_equations,
)
from optloc.kernels.damping import FIRST_DAMPING, FIRST_GROWTH, StopRules, judge_lane
from optloc.kernels.equations import chunks, normal_at
from optloc.kernels.jit import compiled
from optloc.kernels.pack import Numbers, Packed
from optloc.kernels.systems import backward, complete, eliminate, factor, factor_local, forward, step
from optloc.kernels.tables import Tables
from optloc.linear.normal import OPEN, Normal

_OK, LIMIT, _STALLED, NUMERICAL = (
    int(status) for status in (Status.OK, Status.MAX_ITERATIONS, Status.STALLED, Status.NUMERICAL)
)


class Answers(NamedTuple):
    """The results of the refinements of M starts with p unknowns, first the shared ones, then the local ones."""

    x: Array  # (M, p): starts, replaced by the refined vectors
    cost: Array  # (M,)
    status: Array  # int8 (M,)
    iterations: Array  # int32 (M,)
    matrix: Array  # (M, p, p): information at the refined vectors
    vector: Array  # (M, p)


# Cells with the state of the refinement of every lane, from `room.state` on. Their number is
# `optloc.kernels.batched_rows.STATE`.
DAMPING, GROWTH, BLUR, GAIN, SOLVABLE, BETTER, COST, CLOSED = range(8)
# Integer state of every lane: the number of the start; FRESH (2 before the start is loaded, 1 until it is evaluated,
# then 0); the steps tried; the status.
START, FRESH, STEPS, STATUS = range(4)
_TAGS = 4
# Value of FRESH of a lane that waits for its start.
EMPTY = 2


def new_answers(start: Array, kept: int | None = None) -> Answers:
    """Return arrays for the results of starts (M, p), which are copied.

    They contain information and right side of the first `kept` unknowns, by default of all.
    """
    count, size = len(start), start.shape[1] if kept is None else kept
    return Answers(
        np.array(start, dtype=float, order="C"),
        np.empty(count),
        np.empty(count, dtype=np.int8),
        np.empty(count, dtype=np.int32),
        np.empty((count, size, size)),
        np.empty((count, size)),
    )


LEFT_OPEN = -1
"""Status of a start if an epoch does not determine its local unknowns during the refinement: then numpy refines the
start."""


@compiled
def refine_block(packed: Packed, item: Array, first: int, last: int, rules: StopRules, out: Answers) -> None:
    """Refine the starts first <= i < last; several threads may write to one `Answers`.

    Parameters
    ----------
    packed : Packed
        N problems.
    item : int64 array (M,)
        Problem of each start.
    first, last : int
        Range of the starts.
    rules : StopRules
        Conditions to stop.
    out : Answers
        In: starts. Written: the results. Status: ok, max iterations, stalled, numerical, `LEFT_OPEN`. For runs whose
        epochs have local unknowns, neither information nor vector is written.
    """
    t, c = packed
    size, runs = out.x.shape[1], is_run(t)
    lanes, room = blocks(packed, size, last - first), cell_layout(t, c, size)
    m, r = memory(t, room, lanes)
    tag, used, following = np.zeros((_TAGS, lanes), np.int64), lanes, first + lanes
    for b in range(lanes):
        tag[START, b], tag[FRESH, b] = first + b, EMPTY
    while used > 0:
        begin(c, m, room, tag, used, item, out.x)
        if runs:
            write_cost(t, c, m, r, room, used)
        else:
            write_equations(t, c, m, r, room, True, used)
        _judge(m, room, size, runs, t.shared + t.local + 1, tag, rules, used)
        for b in range(used):
            if is_over(tag, b, rules.limit):
                _finish(m, room, tag, b, out)
        used, following = refill(m, room.cells, tag, used, following, last, rules.limit)
        if runs:
            _advance_run(t, c, m, r, room, tag, rules.damped, used)
        else:
            _advance(m, room, t.shared, t.local, tag, rules.damped, used)


@compiled
def is_run(t: Tables) -> bool:
    """Return whether problems have several epochs with local unknowns, which are eliminated epoch by epoch."""
    return t.local > 0 and t.epochs > 1


@compiled
def is_over(tag: Array, lane: int, limit: int) -> bool:
    """Return whether the start in a lane has ended: it has a final status, or `limit` steps were tried."""
    return bool(tag[STATUS, lane] != LIMIT or tag[STEPS, lane] >= limit)


@compiled
def refill(m: Array, cells: int, tag: Array, used: int, following: int, last: int, limit: int) -> tuple[int, int]:
    """Give the lanes of ended starts to the next starts, or close them.

    Returns the number of open lanes and the number of the next start. `following` is the next start before, `last` the
    end of the range, `cells` the number of cells of a lane.
    """
    b = 0
    while b < used:
        if not is_over(tag, b, limit):
            b += 1
        elif following < last:
            tag[START, b], tag[FRESH, b], tag[STATUS, b], tag[STEPS, b] = following, EMPTY, LIMIT, 0
            following, b = following + 1, b + 1
        else:
            used -= 1
            move(m, cells, tag, b, used)
    return used, following


@compiled
def begin(c: Numbers, m: Array, room: LaneCells, tag: Array, used: int, item: Array, x: Array) -> None:
    """Load the starts of empty lanes: numbers of the problems `item`, and vectors x (M, size)."""
    for b in range(used):
        if tag[FRESH, b] == EMPTY:
            start = tag[START, b]
            tag[FRESH, b], tag[STEPS, b], tag[STATUS, b] = 1, 0, LIMIT
            load(m, b, item[start], c.source, c.white, c.prior, c.observed, c.present)
            for i in range(x.shape[1]):
                m[room.trial + i, b] = x[start, i]
            m[room.state + DAMPING, b], m[room.state + GROWTH, b] = FIRST_DAMPING, FIRST_GROWTH
            m[room.state + BLUR, b] = rounding_of_residuals(c.sigma, c.size, m, room, b, item[start])


@compiled
def move(m: Array, cells: int, tag: Array, to: int, lane: int) -> None:
    """Copy the problem of one lane, memory and state, into another lane `to`."""
    if to != lane:
        for i in range(tag.shape[0]):
            tag[i, to] = tag[i, lane]
        for i in range(cells):
            m[i, to] = m[i, lane]


@compiled
def _judge(
    m: Array, room: LaneCells, size: int, runs: bool, line: int, tag: Array, rules: StopRules, used: int
) -> None:
    """Accept the trial vectors that are better, and update damping and status.

    `size` is the length of a vector, `line` the number of unknowns of the equations plus one. If `runs` is True, only
    vectors are stored, not equations.
    """
    state, total = room.state, room.after + line * line - 1
    better, cost = state + BETTER, state + COST
    for b in range(used):
        if tag[FRESH, b]:
            m[better, b], m[state + CLOSED, b], tag[FRESH, b] = 1.0, 1.0, 0
            if not np.isfinite(m[total, b]):
                tag[STATUS, b] = NUMERICAL
        elif runs and m[state + CLOSED, b] == 0.0:
            m[better, b], tag[STATUS, b] = 0.0, LEFT_OPEN
        else:
            tag[STATUS, b] = judge_trial(m, room, cost, total, rules, b)
        m[cost, b] = m[total, b] if m[better, b] != 0.0 else m[cost, b]
    for i in range(size):
        for b in range(used):
            m[room.best + i, b] = m[room.trial + i, b] if m[better, b] != 0.0 else m[room.best + i, b]
    for i in range(0 if runs else line):
        for cell in range(i * line, i * line + i + 1):
            for b in range(used):
                m[room.now + cell, b] = m[room.after + cell, b] if m[better, b] != 0.0 else m[room.now + cell, b]


@compiled
def judge_trial(m: Array, room: LaneCells, now: int, after: int, rules: StopRules, b: int) -> int:
    """Return the status of lane b after a step; write whether the step is better, and the new damping.

    `now` and `after` are the cells of the costs before and after the step.
    """
    state = room.state
    better, small, stuck, m[state + DAMPING, b], m[state + GROWTH, b] = judge_lane(
        m[now, b],
        m[after, b],
        m[state + GAIN, b],
        m[state + SOLVABLE, b] != 0.0,
        m[state + BLUR, b],
        m[state + DAMPING, b],
        m[state + GROWTH, b],
        rules.tolerance,
        rules.damped,
    )
    m[state + BETTER, b] = 1.0 if better else 0.0
    if not better and not rules.damped:
        return NUMERICAL
    return _STALLED if stuck else _OK if small else LIMIT


@compiled
def _finish(m: Array, room: LaneCells, tag: Array, lane: int, out: Answers) -> None:
    """Write the result of a lane, whose start has ended, to `out`."""
    start, size = tag[START, lane], out.matrix.shape[-1]
    last = room.now + size * (size + 1)
    out.cost[start], out.iterations[start] = m[room.state + COST, lane], tag[STEPS, lane]
    out.status[start] = tag[STATUS, lane]
    for i in range(out.x.shape[1]):
        out.x[start, i] = m[room.best + i, lane]
    for i in range(size):
        out.vector[start, i] = m[last + i, lane]
        for j in range(i + 1):
            entry = m[room.now + i * (size + 1) + j, lane]
            out.matrix[start, i, j], out.matrix[start, j, i] = entry, entry


@compiled
def _advance(m: Array, room: LaneCells, n: int, local: int, tag: Array, damped: bool, used: int) -> None:
    """Write the next trial vector of every lane that is not fresh, and the squared length of the step to GAIN."""
    size, damping, gain = n + local, room.state + DAMPING, room.state + GAIN
    vector = room.now + size * (size + 1)
    for b in range(used):
        m[damping, b] = m[damping, b] if damped else 0.0
        m[gain, b] = 0.0
    step(m, room, n, local, damping, room.state + SOLVABLE, used)
    for i in range(size):
        for b in range(used):
            m[gain, b] += m[room.step + i, b] * m[vector + i, b]
            m[room.trial + i, b] = m[room.trial + i, b] if tag[FRESH, b] else m[room.best + i, b] + m[room.step + i, b]
    for b in range(used):
        tag[STEPS, b] += 1 - tag[FRESH, b]


# Runs whose epochs have local unknowns: these are eliminated epoch by epoch, and no data of an epoch are stored.  A
# step takes three passes over the epochs. The first sums the equations of the shared unknowns. The second computes the
# steps of the local unknowns. The third computes the cost at the trial vector.


@compiled
def _advance_run(
    t: Tables, c: Numbers, m: Array, r: Array, room: LaneCells, tag: Array, damped: bool, used: int
) -> None:
    """Write the next trial vector of every lane that is not fresh, and the squared length of the step to GAIN."""
    n, damping, gain = t.shared, room.state + DAMPING, room.state + GAIN
    vector = room.now + (n + t.local) * (n + t.local + 1)
    for b in range(used):
        m[damping, b] = m[damping, b] if damped else 0.0
    _pass(t, c, m, r, room, tag, True, used)
    factor(m, room.shared, n, room.shared_scale, room.state + SOLVABLE, PIVOT, used)
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
def _pass(t: Tables, c: Numbers, m: Array, r: Array, room: LaneCells, tag: Array, summing: bool, lanes: int) -> None:
    """Process all epochs at `room.best`.

    If `summing` is True, sum the shared system (undamped in `room.now`). Otherwise compute the local steps.
    """
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
        whole = epoch == t.epochs  # after the last epoch come the priors of unknowns of the run
        group, packet = add_groups(t, c, m, r, room, room.best, epoch, group, packet, lanes)
        add_priors(t, c, m, room, room.best, not whole, epoch, lanes)
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
        _add(m, room, n, line, lanes)


@compiled
def _own(m: Array, room: LaneCells, tag: Array, n: int, local: int, epoch: int, lanes: int) -> None:
    """Write the step of the local unknowns of an epoch to `room.trial`, and add its squared length to GAIN."""
    complete(m, room, n, local, lanes)
    vector, at = room.after + (n + local) * (n + local + 1) + n, n + epoch * local
    for a in range(local):
        for b in range(lanes):
            m[room.state + GAIN, b] += m[room.step + n + a, b] * m[vector + a, b]
            if tag[FRESH, b] == 0:
                m[room.trial + at + a, b] = m[room.best + at + a, b] + m[room.step + n + a, b]


@compiled
def _add(m: Array, room: LaneCells, n: int, line: int, lanes: int) -> None:
    """Add the damped sums of all epochs to the terms from the elimination of the local unknowns.

    `line` is the number of unknowns of an epoch plus one.
    """
    for i in range(n):
        for j in range(i + 1):
            for b in range(lanes):
                grown = 1.0 + m[room.state + DAMPING, b] if i == j else 1.0
                m[room.shared + i * n + j, b] += m[room.now + i * line + j, b] * grown
        for b in range(lanes):
            m[room.step + i, b] += m[room.now + (line - 1) * line + i, b]


# Refinements of many starts in several threads, by the kernel for the problem.


def refined(packed: Packed, item: Array, start: Array, rules: StopRules) -> tuple[Answers, Array]:
    """Return the refined starts (M, size) of given problems, and whether numpy must refine them instead (M,).

    Parameters
    ----------
    packed : Packed
        N problems.
    item : int64 array (M,)
        Problem of each start.
    start : array (M, size)
        Starting vectors.
    rules : StopRules
        Conditions to stop.
    """
    out = new_answers(start, 0 if is_run(packed.tables) else None)
    item = np.ascontiguousarray(item)  # a strided array would need separate machine code
    map_on_threads(lambda part: refine_block(packed, item, part[0], part[1], rules, out), chunks(len(start)))
    return out, np.asarray(out.status == LEFT_OPEN)


def equations(packed: Packed, item: Array, done: Answers) -> Normal:
    """Return the normal equations at the refined vectors `done`, of the problems `item` (M,).

    They are computed again if they were not stored.
    """
    n, matrix, vector = packed.tables.shared, done.matrix, done.vector
    if matrix.shape[-1] == 0:
        return normal_at(packed, done.x, item, priors=True)
    return Normal(
        matrix[:, :n, :n],
        matrix[:, None, n:, n:],
        matrix[:, None, :n, n:],
        vector[:, :n],
        vector[:, None, n:],
        done.cost,
    )
