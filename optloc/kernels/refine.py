"""Damped Gauss-Newton for many problems in one call: the rules of `optloc.solve.refine`, lane by lane.

A lane whose problem is finished takes the next one, so that the lanes are full until the problems run out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.kernels.dense import Systems, step, systems
from optloc.kernels.gather import gather
from optloc.kernels.jit import compiled
from optloc.kernels.lanes import Scratch, load, move, scratch
from optloc.kernels.pack import Numbers, Packed
from optloc.status import Status
from optloc.types import Array

_OK, _LIMIT, _STALLED, _NUMERICAL = (
    int(status) for status in (Status.OK, Status.MAX_ITERATIONS, Status.STALLED, Status.NUMERICAL)
)
_EPSILON = float(np.finfo(float).eps)
_LANES, _MEMORY = 64, 2**17


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


class _State(NamedTuple):
    """What is remembered of the problem of each of B lanes."""

    start: Array  # int64 (B,): which start it is
    fresh: Array  # int64 (B,): 1 while nothing but its start is known
    steps: Array  # int64 (B,)
    x: Array  # (p, B): best place so far
    trial: Array  # (p, B): place to try
    now: Array  # (p + 1, p + 1, B): equations at the best place
    after: Array  # (p + 1, p + 1, B): equations at the place tried
    damping: Array  # (B,)
    growth: Array  # (B,)
    blur: Array  # (B,)
    gain: Array  # (B,): squared length of the step tried
    solvable: Array  # (B,)
    better: Array  # (B,): 1.0 where the place tried is taken


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
    t, size = packed.tables, out.x.shape[1]
    fitting = _MEMORY // max(1, t.rows * t.width + 2 * (size + 1) * (size + 1))
    lanes = min(last - first, min(_LANES, max(8, 8 * (fitting // 8))))
    work, room, state = scratch(packed, lanes), systems(t.shared, size - t.shared, lanes), _state(size, lanes)
    used, following = 0, first
    while used < lanes:
        _begin(packed, work, state, used, following, item, out)
        used, following = used + 1, following + 1
    while used > 0:
        gather(packed, work, state.trial, used, state.after)
        _judge(state, rules, out, used)
        b = 0
        while b < used:
            if out.status[state.start[b]] == _LIMIT and state.steps[b] < rules.limit:
                b += 1
                continue
            _finish(state, b, out)
            if following < last:
                _begin(packed, work, state, b, following, item, out)
                following, b = following + 1, b + 1
            else:
                used -= 1
                _move(work, state, b, used)
        _advance(state, room, rules, used)


@compiled
def _state(size: int, lanes: int) -> _State:
    return _State(
        np.zeros(lanes, np.int64),
        np.zeros(lanes, np.int64),
        np.zeros(lanes, np.int64),
        np.zeros((size, lanes)),
        np.zeros((size, lanes)),
        np.zeros((size + 1, size + 1, lanes)),
        np.zeros((size + 1, size + 1, lanes)),
        np.zeros(lanes),
        np.zeros(lanes),
        np.zeros(lanes),
        np.zeros(lanes),
        np.zeros(lanes),
        np.zeros(lanes),
    )


@compiled
def _begin(packed: Packed, work: Scratch, state: _State, lane: int, start: int, item: Array, out: Answers) -> None:
    """Bring a start into a lane."""
    load(packed, work, lane, item[start])
    state.start[lane], state.fresh[lane], state.steps[lane] = start, 1, 0
    for i in range(state.x.shape[0]):
        state.trial[i, lane] = out.x[start, i]
    state.damping[lane], state.growth[lane] = 1e-6, 2.0
    state.blur[lane] = _blur(packed.numbers, work, lane, item[start])
    out.status[start] = _LIMIT


@compiled
def _blur(c: Numbers, work: Scratch, lane: int, item: int) -> float:
    """Return the rounding error of the whitened residuals: arrival times that count from long ago are coarse."""
    sigma, squares = c.sigma[item if c.sigma.shape[0] > 1 else 0], 0.0
    for i in range(sigma.shape[0]):
        if work.present.shape[0] == 0 or work.present[i, lane] != 0.0:
            ratio = work.observed[i, lane] / sigma[i]
            squares += ratio * ratio
    coarse = 4.0 * _EPSILON * np.sqrt(squares)
    return coarse if np.isfinite(coarse) else 0.0


@compiled
def _move(work: Scratch, state: _State, to: int, lane: int) -> None:
    """Bring the problem of one lane into another, with its equations before and after."""
    if to == lane:
        return
    move(work, to, lane)
    for ints in (state.start, state.fresh, state.steps):
        ints[to] = ints[lane]
    for one in (state.damping, state.growth, state.blur):
        one[to] = one[lane]
    for i in range(state.x.shape[0]):
        state.x[i, to], state.trial[i, to] = state.x[i, lane], state.trial[i, lane]
    for i in range(state.now.shape[0]):
        for j in range(i + 1):
            state.now[i, j, to] = state.now[i, j, lane]


@compiled
def _judge(state: _State, rules: Rules, out: Answers, used: int) -> None:
    """Take the places tried that are better, and set damping and status."""
    size = state.x.shape[0]
    for b in range(used):
        after = state.after[size, size, b]
        if state.fresh[b]:
            state.better[b], state.fresh[b] = 1.0, 0
            if not np.isfinite(after):
                out.status[state.start[b]] = _NUMERICAL
        else:
            out.status[state.start[b]] = _judged(state, rules, b, after)
    for i in range(size + 1):
        if i < size:
            best, trial = state.x[i], state.trial[i]
            for b in range(used):
                best[b] = trial[b] if state.better[b] else best[b]
        for j in range(i + 1):
            now, fresh = state.now[i, j], state.after[i, j]
            for b in range(used):
                now[b] = fresh[b] if state.better[b] else now[b]


@compiled
def _judged(state: _State, rules: Rules, b: int, after: float) -> int:
    """Return the status of the problem of a lane after a step; say whether it is better and set the damping."""
    cost, damping, gain = state.now[-1, -1, b], state.damping[b] if rules.damped else 0.0, state.gain[b]
    solvable, blur, status = state.solvable[b] != 0.0, state.blur[b], _LIMIT
    achieved, floor = cost - after, 1e-13 * (1.0 + cost)
    rounding = floor + 2.0 * blur * np.sqrt(1.0 + cost)
    better = solvable and np.isfinite(after) and (achieved >= -rounding or not rules.damped)
    small = solvable and abs(gain) * (1.0 + damping) <= max(rules.tolerance * rules.tolerance, floor + blur * blur)
    if better:
        ratio = achieved / (gain if gain > 0.0 else 1.0)
        middle = 2.0 * min(max(ratio, 0.0), 1.0) - 1.0
        change = 0.1 if ratio > 0.9 else max(1.0 / 3.0, 1.0 - middle * middle * middle)
        state.damping[b], state.growth[b] = max(damping * change, 1e-12), 2.0
    else:
        state.damping[b] = damping * state.growth[b] + 1e-12
        state.growth[b] *= 2.0
    if small:
        status = _OK
    if not better and state.damping[b] > 1e12:
        status = _STALLED
    if not rules.damped and not better:
        status = _NUMERICAL
    state.better[b] = 1.0 if better else 0.0
    return status


@compiled
def _finish(state: _State, lane: int, out: Answers) -> None:
    """Write the answer of a lane."""
    start, size = state.start[lane], state.x.shape[0]
    out.cost[start], out.iterations[start] = state.now[size, size, lane], state.steps[lane]
    for i in range(size):
        out.x[start, i], out.vector[start, i] = state.x[i, lane], state.now[size, i, lane]
        for j in range(i + 1):
            out.matrix[start, i, j] = out.matrix[start, j, i] = state.now[i, j, lane]


@compiled
def _advance(state: _State, room: Systems, rules: Rules, used: int) -> None:
    """Write the next place to try of every lane that is not fresh, and the length of the step."""
    size = state.x.shape[0]
    for b in range(used):
        if not rules.damped:
            state.damping[b] = 0.0
    step(state.now, state.damping, room, used)
    state.gain[:used] = 0.0
    for i in range(size):
        trial, best, change, vector = state.trial[i], state.x[i], room.step[i], state.now[size, i]
        for b in range(used):
            state.gain[b] += change[b] * vector[b]
            trial[b] = trial[b] if state.fresh[b] else best[b] + change[b]
    for b in range(used):
        state.solvable[b] = room.ok[b]
        state.steps[b] += 1 - state.fresh[b]
