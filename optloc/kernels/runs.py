"""Runs whose epochs have local unknowns, by machine code: each lane is an epoch.

The normal equations of a run have an arrow shape: one block for the unknowns that epochs share, and for each epoch a
block for the local unknowns, with a coupling. A block of lanes evaluates the rows of 64 epochs together. Then the local
unknowns of each epoch are eliminated (Schur complement), and the reduced equations are summed in the order of the
epochs.

Letters: n shared unknowns, `local` (l) local unknowns of each of k epochs, B lanes. `m` is the memory (cells, B),
`room` its addresses, r are registers, see `optloc.kernels.batched_rows`. `used` is the number of lanes in use, and
`now` the equations at the present vector. `packed` are the epochs of all runs as problems. `damping` is Marquardt's
factor f, which multiplies diagonals by 1 + f.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.linalg import PIVOT
from optloc.base.threads import map_on_threads
from optloc.base.types import Array, Status
from optloc.kernels.batched_rows import (
    LaneCells,
    add_priors,
    blocks,
    cell_layout,
    clear,
    load,
    memory,
    rounding_of_residuals,
    write_equations,
)
from optloc.kernels.damping import FIRST_DAMPING, FIRST_GROWTH, StopRules, judge_lane
from optloc.kernels.equations import Sums
from optloc.kernels.jit import compiled
from optloc.kernels.pack import Packed, PackedRuns
from optloc.kernels.refine import CLOSED, DAMPING, LIMIT, NUMERICAL, SOLVABLE, Answers, new_answers
from optloc.kernels.systems import backward, complete, eliminate, factor, factor_local, forward
from optloc.linear.normal import OPEN, Normal

_OK, _STALLED = int(Status.OK), int(Status.STALLED)

LEFT_OPEN = -1
"""Status of a start if an epoch does not determine its local unknowns: then numpy refines the start."""


class EpochShare(NamedTuple):
    """Sums over the epochs of a run, and the local equations of each epoch.

    Parameters
    ----------
    matrix : array (n, n)
        Information, lower triangle.
    vector : array (n,)
        Right side.
    cost : array (1,)
        Weighted sum of squared residuals.
    own : array (q, cells, B)
        Equations of the local unknowns of each epoch, in q blocks of lanes: l rows of n + l + 1 cells, then l right
        sides.
    """

    matrix: Array
    vector: Array
    cost: Array
    own: Array


@compiled
def _share(n: int, local: int, parts: int, lanes: int) -> EpochShare:
    # Return empty sums for n shared and `local` local unknowns, in `parts` blocks of lanes.
    return EpochShare(np.zeros((n, n)), np.zeros(n), np.zeros(1), np.zeros((parts, local * (n + local + 2), lanes)))


@compiled
def _evaluate(
    packed: Packed, m: Array, r: Array, room: LaneCells, item: int, epochs: int, x: Array, priors: bool, out: EpochShare
) -> None:
    """Write the equations of a run at its vector x (n + k l,) to `out`.

    Each lane evaluates one epoch. The equations of the shared unknowns are summed. The equations of the local unknowns
    are stored for the elimination. `item` is the number of the run, `epochs` is k. If `priors` is True, Gaussian priors
    are added.
    """
    t, c = packed
    n, local, lanes = t.shared, t.local, m.shape[1]
    line, last = n + local + 1, room.after + (n + local) * (n + local + 1)
    out.matrix[:], out.vector[:], out.cost[:] = 0.0, 0.0, 0.0
    for part in range(len(out.own)):
        first = part * lanes
        used = min(lanes, epochs - first)
        for b in range(used):
            load(m, b, item * epochs + first + b, c.source, c.white, c.prior, c.observed, c.present)
            for i in range(n):
                m[room.trial + i, b] = x[i]
            for i in range(local):
                m[room.trial + n + i, b] = x[n + (first + b) * local + i]
        write_equations(t, c, m, r, room, False, used)
        if priors:
            add_priors(t, c, m, room, room.trial, True, 0, used)
        _keep(m, room.after + n * line, last + n, local * line, local, out.own[part], used)
        _sum(m, room.after, line, last, last + line - 1, n, used, out)
    if priors:
        clear(m, room.after, line * line, 1)
        add_priors(t, c, m, room, room.trial, False, 0, 1)
        _sum(m, room.after, line, last, last + line - 1, n, 1, out)


@compiled
def _blur(packed: Packed, m: Array, room: LaneCells, item: int, epochs: int) -> float:
    """Return the rounding error of the whitened residuals of run number `item`, in standard deviations."""
    c, squares = packed.numbers, 0.0
    for i in range(item * epochs, (item + 1) * epochs):
        load(m, 0, i, c.source, c.white, c.prior, c.observed, c.present)
        blur = rounding_of_residuals(c.sigma, c.size, m, room, 0, i)
        squares += blur * blur
    return float(np.sqrt(squares))


@compiled
def _keep(m: Array, rows: int, vector: int, count: int, local: int, own: Array, used: int) -> None:
    """Copy the equations of the local unknowns to `own` (cells, B), because the next block overwrites the memory.

    `rows` is the first of `count` cells with the rows of the local unknowns; `vector` is the first cell of their right
    sides.
    """
    for cell in range(count):
        for b in range(used):
            own[cell, b] = m[rows + cell, b]
    for i in range(local):
        for b in range(used):
            own[count + i, b] = m[vector + i, b]


@compiled
def _sum(m: Array, matrix: int, line: int, vector: int, cost: int, n: int, used: int, out: EpochShare) -> None:
    """Add the equations of the shared unknowns and the costs of all lanes to `out`.

    `matrix`, `vector` and `cost` are the first cells of information, right side and cost; `line` is the length of a row
    of the information.
    """
    for i in range(n):
        for j in range(i + 1):
            for b in range(used):
                out.matrix[i, j] += m[matrix + i * line + j, b]
        for b in range(used):
            out.vector[i] += m[vector + i, b]
    for b in range(used):
        out.cost[0] += m[cost, b]


@compiled
def _factor_epochs(m: Array, room: LaneCells, n: int, local: int, own: Array, damping: float, used: int) -> None:
    """Factor the damped systems of the local unknowns `own` (cells, B); CLOSED becomes 1.0 if they are determined."""
    line = n + local + 1
    for cell in range(local * line):
        for b in range(used):
            m[room.after + n * line + cell, b] = own[cell, b]
    for i in range(local):
        for b in range(used):
            m[room.after + (n + local) * line + n + i, b] = own[local * line + i, b]
    for b in range(used):
        m[room.state + DAMPING, b], m[room.state + CLOSED, b] = damping, 1.0
    factor_local(m, room, room.after, n, local, room.state + DAMPING, room.state + CLOSED, OPEN, used)


@compiled
def _reduce(
    m: Array,
    room: LaneCells,
    n: int,
    local: int,
    epochs: int,
    now: EpochShare,
    damping: float,
    matrix: Array,
    vector: Array,
) -> bool:
    """Write the shared system without the local unknowns, and return whether each epoch determines all of its unknowns.

    The lower triangle is written to `matrix` (n, n), the right side to `vector` (n,). The diagonals are multiplied by 1
    + damping.
    """
    lanes, closed = m.shape[1], True
    for i in range(n):
        vector[i] = now.vector[i]
        for j in range(i + 1):
            matrix[i, j] = now.matrix[i, j] * (1.0 + damping if i == j else 1.0)
    for part in range(len(now.own)):
        used = min(lanes, epochs - part * lanes)
        _factor_epochs(m, room, n, local, now.own[part], damping, used)
        clear(m, room.shared, n * n, used)
        clear(m, room.step, n, used)
        eliminate(m, room, n, local, used)
        for b in range(used):
            closed = closed and m[room.state + CLOSED, b] != 0.0
        for i in range(n):
            for j in range(i + 1):
                for b in range(used):
                    matrix[i, j] += m[room.shared + i * n + j, b]
            for b in range(used):
                vector[i] += m[room.step + i, b]
    return closed


@compiled
def _factor_shared(m: Array, room: LaneCells, n: int, matrix: Array) -> bool:
    """Factor the shared system `matrix` (n, n) in the first lane, and return whether it is positive definite."""
    for i in range(n):
        for j in range(i + 1):
            m[room.shared + i * n + j, 0] = matrix[i, j]
    m[room.state + SOLVABLE, 0] = 1.0
    factor(m, room.shared, n, room.shared_scale, room.state + SOLVABLE, PIVOT, 1)
    return bool(m[room.state + SOLVABLE, 0] != 0.0)


@compiled
def _solve_shared(m: Array, room: LaneCells, n: int, right: Array) -> None:
    """Replace the vector `right` (n,) by the solution of the shared system, which `_factor_shared` has factored."""
    for i in range(n):
        m[room.step + i, 0] = right[i]
    forward(m, room.shared, n, room.shared_scale, room.step, 1)
    backward(m, room.shared, n, room.shared_scale, room.step, 1)
    for i in range(n):
        right[i] = m[room.step + i, 0]


@compiled
def _step(
    m: Array,
    room: LaneCells,
    n: int,
    local: int,
    epochs: int,
    now: EpochShare,
    damping: float,
    matrix: Array,
    move: Array,
) -> int:
    """Write the damped step of the shared unknowns to `move` (n,), and return its status.

    The status is ok, numerical (the shared system is singular) or LEFT_OPEN. `matrix` (n, n) is scratch.
    """
    if not _reduce(m, room, n, local, epochs, now, damping, matrix, move):
        return LEFT_OPEN
    if not _factor_shared(m, room, n, matrix):
        return NUMERICAL
    _solve_shared(m, room, n, move)
    return _OK


@compiled
def _move(
    m: Array,
    room: LaneCells,
    n: int,
    local: int,
    epochs: int,
    now: EpochShare,
    damping: float,
    move: Array,
    x: Array,
    to: Array,
) -> float:
    """Write the vector after one step from x to `to`, and return the squared length of the step in standard deviations.

    `move` (n,) is the step of the shared unknowns; the steps of the local ones follow from it.
    """
    lanes, gain = m.shape[1], 0.0
    for i in range(n):
        to[i] = x[i] + move[i]
        gain += move[i] * now.vector[i]
    for part in range(len(now.own)):
        first = part * lanes
        used = min(lanes, epochs - first)
        _factor_epochs(m, room, n, local, now.own[part], damping, used)
        for i in range(n):
            for b in range(used):
                m[room.step + i, b] = move[i]
        complete(m, room, n, local, used)
        for b in range(used):
            for i in range(local):
                own = m[room.step + n + i, b]
                gain += own * now.own[part, local * (n + local + 1) + i, b]
                to[n + (first + b) * local + i] = x[n + (first + b) * local + i] + own
    return gain


class Spread(NamedTuple):
    """Information and covariances of M runs at given vectors.

    Parameters
    ----------
    information, covariance : array (M, n, n)
        Matrices of the shared unknowns; local unknowns are eliminated.
    local : array (M, k, q, q)
        Covariance of the first q unknowns of each epoch.
    weakest : array (M,)
        Smallest squared pivot of the information scaled to a unit diagonal.
    regular : bool array (M,)
        Whether run and epochs determine all unknowns; otherwise the other fields have no meaning.
    """

    information: Array
    covariance: Array
    local: Array
    weakest: Array
    regular: Array


@compiled
def _spread(
    m: Array, room: LaneCells, n: int, local: int, epochs: int, now: EpochShare, vector: Array, start: int, out: Spread
) -> None:
    """Write the covariances of a run from its equations to entry `start` of `out`; `vector` (n,) is scratch."""
    lanes, matrix, covariance = m.shape[1], out.information[start], out.covariance[start]
    closed = _reduce(m, room, n, local, epochs, now, 0.0, matrix, vector)
    out.regular[start] = _factor_shared(m, room, n, matrix) and closed
    weakest = 1.0
    for i in range(n):
        pivot = m[room.shared + i * n + i, 0]  # `factor` stores inverse pivots
        weakest = min(weakest, 1.0 / (pivot * pivot))
        for j in range(n):
            matrix[i, j] = matrix[max(i, j), min(i, j)]
            vector[j] = 1.0 if i == j else 0.0
        _solve_shared(m, room, n, vector)
        covariance[i, :] = vector
    out.weakest[start] = weakest
    if out.regular[start]:
        for part in range(len(now.own)):
            used = min(lanes, epochs - part * lanes)
            _factor_epochs(m, room, n, local, now.own[part], 0.0, used)
            _spread_epochs(m, room, n, local, covariance, part * lanes, used, out.local[start])


@compiled
def _spread_epochs(
    m: Array, room: LaneCells, n: int, local: int, covariance: Array, first: int, used: int, out: Array
) -> None:
    """Write the covariances (used, q, q) of the first q local unknowns of epochs to `out`, from `first` on.

    The systems of these epochs are factored; `covariance` (n, n) belongs to the shared unknowns.
    """
    size = out.shape[1]
    for j in range(n):
        backward(m, room.local, local, room.local_scale, room.half + j * local, used)
    clear(m, room.now, size * local, used)
    for i in range(size):
        for b in range(used):
            m[room.now + i * local + i, b] = 1.0
        forward(m, room.local, local, room.local_scale, room.now + i * local, used)
        backward(m, room.local, local, room.local_scale, room.now + i * local, used)
    for b in range(used):
        for u in range(size):
            for v in range(u + 1):
                # the errors of the epoch, plus the errors that come from the shared unknowns
                total = m[room.now + u * local + v, b]
                for i in range(n):
                    for j in range(n):
                        gain = m[room.half + i * local + u, b] * m[room.half + j * local + v, b]
                        total += covariance[i, j] * gain
                out[first + b, u, v], out[first + b, v, u] = total, total


@compiled
def refine_runs(
    packed: Packed, item: Array, epochs: int, first: int, last: int, rules: StopRules, out: Answers, spread: Spread
) -> None:
    """Refine the starts first <= i < last of runs; several threads may write to one `Answers`.

    Parameters
    ----------
    packed : Packed
        The epochs of N runs, as N k problems.
    item : int64 array (M,)
        Run of each start.
    epochs : int
        Number k of epochs of a run.
    first, last : int
        Range of the starts.
    rules : StopRules
        Conditions to stop.
    out : Answers
        In: starts. Written: the results. Status: ok, max iterations, stalled, numerical, `LEFT_OPEN`. Neither
        information nor vector is written.
    spread : Spread
        Written at the results, unless it has no runs.
    """
    t, c = packed
    n, local = t.shared, t.local
    lanes, room = blocks(packed, n + local, epochs), cell_layout(t, c, n + local)
    m, r = memory(t, room, lanes)
    parts = (epochs + lanes - 1) // lanes
    now, after = _share(n, local, parts, lanes), _share(n, local, parts, lanes)
    matrix, move, trial = np.empty((n, n)), np.empty(n), np.empty(out.x.shape[1])
    for start in range(first, last):
        x, damping, growth, status, steps = out.x[start], FIRST_DAMPING, FIRST_GROWTH, LIMIT, 0
        blur = _blur(packed, m, room, item[start], epochs)
        _evaluate(packed, m, r, room, item[start], epochs, x, True, now)
        if not np.isfinite(now.cost[0]):
            status = NUMERICAL
        while status == LIMIT and steps < rules.limit:
            damping = damping if rules.damped else 0.0
            solved = _step(m, room, n, local, epochs, now, damping, matrix, move)
            if solved == LEFT_OPEN:
                status = LEFT_OPEN
                break
            gain = _move(m, room, n, local, epochs, now, damping, move, x, trial) if solved == _OK else 0.0
            if solved == _OK:
                _evaluate(packed, m, r, room, item[start], epochs, trial, True, after)
            better, small, stuck, damping, growth = judge_lane(
                now.cost[0], after.cost[0], gain, solved == _OK, blur, damping, growth, rules.tolerance, rules.damped
            )
            steps += 1
            if better:
                x[:] = trial
                now, after = after, now
            elif not rules.damped:
                status = NUMERICAL
            if status == LIMIT:
                status = _STALLED if stuck else _OK if small else LIMIT
        out.cost[start], out.status[start], out.iterations[start] = now.cost[0], status, steps
        if len(spread.regular) > 0:
            _spread(m, room, n, local, epochs, now, move, start, spread)


@compiled
def sum_runs(
    packed: Packed, x: Array, item: Array, epochs: int, first: int, last: int, priors: bool, out: Sums
) -> None:
    """Write the normal equations of runs at the vectors first <= i < last of x (M, n + k l) to `out`.

    `item` (M,) is the run of each vector.
    """
    t, c = packed
    n, local = t.shared, t.local
    lanes, room = blocks(packed, n + local, epochs), cell_layout(t, c, n + local)
    m, r = memory(t, room, lanes)
    line = n + local + 1
    now = _share(n, local, (epochs + lanes - 1) // lanes, lanes)
    for start in range(first, last):
        _evaluate(packed, m, r, room, item[start], epochs, x[start], priors, now)
        out.cost[start] = now.cost[0]
        for i in range(n):
            out.shared_vector[start, i] = now.vector[i]
            for j in range(i + 1):
                out.shared[start, i, j] = now.matrix[i, j]
                out.shared[start, j, i] = now.matrix[i, j]
        for epoch in range(epochs):
            own, b = now.own[epoch // lanes], epoch % lanes
            for i in range(local):
                out.local_vector[start, epoch, i] = own[local * line + i, b]
                for j in range(n):
                    out.cross[start, epoch, j, i] = own[i * line + j, b]
                for j in range(i + 1):
                    out.local[start, epoch, i, j] = own[i * line + n + j, b]
                    out.local[start, epoch, j, i] = own[i * line + n + j, b]


# Calls from Python, for runs whose epochs have equal rows.


def refined_runs(runs: PackedRuns, item: Array, start: Array, rules: StopRules) -> tuple[Answers, Array]:
    """Return the refined starts (M, size), and whether numpy must refine them instead (M,).

    `item` (M,) is the run of each start.
    """
    done, _ = fixed_runs(runs, item, start, rules, None)
    return done, np.asarray(done.status == LEFT_OPEN)


def fixed_runs(
    runs: PackedRuns, item: Array, start: Array, rules: StopRules, size: int | None
) -> tuple[Answers, Spread]:
    """Return the refined starts (M, size), and their covariances; `item` (M,) is the run of each start.

    The `rules` end a refinement. The covariances contain the first `size` local unknowns of each epoch. If `size` is
    None, they are empty.
    """
    n, out, item = runs.packed.tables.shared, new_answers(start, 0), np.ascontiguousarray(item)
    count, wanted = len(start), 0 if size is None else len(start)
    spread = Spread(
        np.empty((wanted, n, n)),
        np.empty((wanted, n, n)),
        np.empty((wanted, runs.epochs, size or 0, size or 0)),
        np.empty(wanted),
        np.empty(wanted, dtype=np.bool_),
    )

    def work(i: int) -> None:
        """Refine start number i."""
        refine_runs(runs.packed, item, runs.epochs, i, i + 1, rules, out, spread)

    map_on_threads(work, range(count))
    return out, spread


def sums_of_runs(runs: PackedRuns, x: Array, item: Array, *, priors: bool = False) -> Normal:
    """Return the normal equations of runs at vectors x (M, size); `item` (M,) is the run of each vector.

    If `priors` is True, Gaussian priors are added.
    """
    t, count, k = runs.packed.tables, len(x), runs.epochs
    sums = Sums(
        np.empty((count, t.shared, t.shared)),
        np.empty((count, k, t.local, t.local)),
        np.empty((count, k, t.shared, t.local)),
        np.empty((count, t.shared)),
        np.empty((count, k, t.local)),
        np.empty(count),
    )
    at, item = np.require(x, np.float64, ["C", "W"]), np.ascontiguousarray(item)
    map_on_threads(lambda i: sum_runs(runs.packed, at, item, k, i, i + 1, priors, sums), range(count))
    return Normal(*sums)
