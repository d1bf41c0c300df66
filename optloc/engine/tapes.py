"""Rows of every kind as tapes of h(x) and its derivatives, with all other unknowns.

A tape is a list of elementary operations. This evaluator implements `optloc.engine.evaluator` for all problems that
`optloc.engine.ranges` does not serve. It refines all p unknowns together, the first d of which are the position.

A block has W problems, one in each lane. `room` is the workspace of the block. Names in capitals, such as X or COST,
are rows of the arrays of `optloc.engine.memory.EngineWorkspace`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.engine.candidates import CANDIDATES, RINGS, look_around, refine_candidates
from optloc.engine.heights import VECTORS, meet_ellipsoid
from optloc.engine.infinity import search_sphere
from optloc.engine.lifts import NUMBER, OFFSET, SEEN, STATION, Lifts
from optloc.engine.memory import (
    BEYOND,
    BLUR,
    BY_HEIGHT,
    COST,
    COST_TRIAL,
    DIAGONAL,
    H_TRIAL,
    MOVE,
    ORIGIN,
    REST,
    SCALE,
    SOLVABLE,
    SPARE,
    TRIAL,
    EngineModel,
    EngineWorkspace,
    G,
    H,
    X,
)
from optloc.engine.start import NEAR
from optloc.kernels.batched_rows import (
    LaneCells,
    cell_layout,
    load as load_lane,
    memory,
    rounding_of_residuals,
    write_cost,
    write_equations,
)
from optloc.kernels.gtrs import minimise
from optloc.kernels.jit import compiled
from optloc.kernels.pack import Numbers
from optloc.kernels.polynomial import DEGREE
from optloc.kernels.systems import LANES, eliminate_last, factor_plain, solve_plain
from optloc.kernels.tables import Tables
from optloc.kernels.tape_table import INPUT, OUTPUT, run_tape


class TapeRows(NamedTuple):
    """Rows of N problems as tapes.

    Parameters
    ----------
    tables : Tables
        Indices of rows, inputs and unknowns.
    numbers : Numbers
        Shared numbers, and the numbers of each problem except measurements.
    correction : array (m,)
        Known amount by which each measurement exceeds the model, in the unit of the measurement.
    base : array (p,)
        Start of the unknowns other than the position.
    lifts : Lifts
        Linear rows of other kinds than ranges.
    bounded : bool
        Whether the cost grows without bound at infinity.
    scaled : bool
        Whether unknown scale factors multiply rows. Their derivatives are as large as ranges, so that a search far away
        does not converge.
    """

    tables: Tables
    numbers: Numbers
    correction: Array
    base: Array
    lifts: Lifts
    bounded: bool
    scaled: bool


class TapeBlock(NamedTuple):
    """Rows with the memory of a block.

    Parameters
    ----------
    rows : TapeRows
        Rows of all problems.
    at, m : LaneCells, array
        Memory of the lanes (m), and addresses in this memory (at).
    r : array
        Registers of the tapes.
    spot, w : array
        Candidates for starts, and scratch for them.
    """

    rows: TapeRows
    at: LaneCells
    m: Array
    r: Array
    spot: Array
    w: Array


@compiled
def count_unknowns(rows: TapeRows, d: int, size: int) -> int:
    """Return the number of all unknowns, `size`: they are refined together."""
    return size


@compiled
def count_lifted(rows: TapeRows) -> int:
    """Return the number of linear rows of other kinds than ranges."""
    return len(rows.lifts.sigma)


@compiled
def keep(model: EngineModel, rows: TapeRows, stations: int, d: int, size: int) -> TapeBlock:
    """Return the rows with the memory for a block of problems with `size` unknowns and `d` coordinates."""
    at = cell_layout(rows.tables, rows.numbers, size)
    m, r = memory(rows.tables, at, LANES)
    if rows.lifts.tapes.registers > len(r):
        r = np.empty((rows.lifts.tapes.registers, r.shape[1]))
    spot, w = np.zeros((CANDIDATES, d + 1, LANES)), np.zeros((VECTORS, DEGREE + 2))
    return TapeBlock(rows, at, m, r, spot, w)


@compiled
def load(block: TapeBlock, z: Array, room: EngineWorkspace, anew: bool) -> None:
    """Copy the numbers and measurements z (N, m) of a block into its lanes, and write their rounding error to BLUR."""
    c, at, m = block.rows.numbers, block.at, block.m
    for lane in range(LANES):
        i = room.item[lane]
        load_lane(m, lane, i, c.source, c.white, c.prior, c.observed, c.present)
        for j in range(z.shape[1]):
            m[at.observed + j, lane] = z[i, j] - block.rows.correction[j]
        room.scalar[BLUR, lane] = rounding_of_residuals(c.sigma, c.size, m, at, lane, i)


@compiled
def minimise_start(model: EngineModel, block: TapeBlock, room: EngineWorkspace, first: bool) -> None:
    """Write the minimiser of the weighted squared-range rows and of the other linear rows to `room.y`.

    SOLVABLE becomes 1.0 if it is unique, else 0.0. `first` is True in the first of two passes.
    """
    _lift(block, room, first)
    if block.rows.lifts.flat:
        _minimise_flat(room)
    else:
        minimise(room.rows, model.reference >= 0, room.y, room.scalar[SOLVABLE], room.work)


@compiled
def _lift(block: TapeBlock, room: EngineWorkspace, first: bool) -> None:
    """Write the linear rows after the range rows of `room.rows`, weighted by their errors at the last minimiser.

    In the first pass (`first`), all targets count as one scale away.
    """
    lifts, r = block.rows.lifts, block.r
    s, scale, spare = len(room.place), room.scalar[SCALE], room.scalar[SPARE]
    together = max(1, r.shape[1] // LANES)  # number of linear rows in a run of a tape
    for lane in range(LANES):
        spare[lane] = 1.0 / scale[lane]
    for b in range(len(lifts.first) - 1):
        last = lifts.first[b + 1]
        for row in range(lifts.first[b], last, together):
            end = min(row + together, last)
            for one in range(row, end):
                _enter(lifts, b, room, r, one, (one - row) * LANES, spare)
            run_tape(lifts.tapes, b, r, (end - row) * LANES)
            for one in range(row, end):
                _weigh(lifts.tapes.table, b, lifts.sigma[one], r, (one - row) * LANES, first, room.rows[s + one])


@compiled
def _enter(lifts: Lifts, b: int, room: EngineWorkspace, r: Array, row: int, low: int, inverse: Array) -> None:
    """Write the inputs of linear row `row` of block b into their registers r.

    `low` is the first column of this row in the registers. `inverse` (W,) is one over the scale, 1/metres.
    """
    table = lifts.tapes.table
    begin = table[b, INPUT]
    for i in range(table[b + 1, INPUT] - begin):
        to, what, which = table[begin + i, 0], lifts.source[row, i, 0], lifts.source[row, i, 1]
        for lane in range(LANES):
            if what == NUMBER:
                value = lifts.number[which]
            elif what == SEEN:
                value = room.seen[which, lane]
            elif what == STATION:
                value = room.place[which // room.d, which % room.d, lane] * inverse[lane]
            elif what == OFFSET:
                value = room.value[which, lane] * inverse[lane]
            else:
                value = room.y[which, lane]
            r[to, low + lane] = value


@compiled
def _weigh(table: Array, b: int, sigma: float, r: Array, low: int, first: bool, out: Array) -> None:
    """Write one linear row (d + 2, W) divided by its error to `out`.

    `sigma` is the standard deviation of the measurement, `low` the first column of the row in the registers r. If
    `first` is True, the error of each row is the error at a distance of one scale.
    """
    begin, last = table[b, OUTPUT], len(out)
    for j in range(last):
        for lane in range(LANES):
            factor = 1.0 if first else max(abs(r[table[begin + last, 0], low + lane]), NEAR)
            out[j, lane] = r[table[begin + j, 0], low + lane] / (factor * sigma)


@compiled
def _minimise_flat(room: EngineWorkspace) -> None:
    """Write the least-squares position of rows that do not contain the last coordinate to `room.y`.

    SOLVABLE becomes 1.0 if the rows determine it. The quadric would determine a last coordinate that no row depends on.
    """
    rows, y, d, vector, work = room.rows, room.y, room.d, room.vector, room.axes[0]
    diagonal, inverse, solvable = vector[DIAGONAL][:d], vector[MOVE][:d], room.scalar[SOLVABLE]
    for i in range(d):
        for lane in range(LANES):
            y[i, lane], diagonal[i, lane] = 0.0, 0.0
        for j in range(i + 1):
            for lane in range(LANES):
                work[i, j, lane] = 0.0
    for k in range(len(rows)):
        for i in range(d):
            for lane in range(LANES):
                y[i, lane] += rows[k, i, lane] * rows[k, d + 1, lane]
            for j in range(i + 1):
                for lane in range(LANES):
                    work[i, j, lane] += rows[k, i, lane] * rows[k, j, lane]
    for lane in range(LANES):
        y[d, lane], solvable[lane] = 0.0, 1.0
    for i in range(d):
        for lane in range(LANES):
            diagonal[i, lane] = work[i, i, lane]
    factor_plain(work, diagonal, room.axes[1], inverse)
    solve_plain(room.axes[1], inverse, y[:d])
    for i in range(d):
        for lane in range(LANES):
            share = inverse[i, lane] * diagonal[i, lane]
            solvable[lane] = solvable[lane] if 0.0 < share < _MOST else 0.0


# One over the least share of its diagonal that a pivot must keep: below it a start has only three correct digits.
_MOST = 1e13


@compiled
def scout(model: EngineModel, block: TapeBlock, room: EngineWorkspace) -> None:
    """Write the best candidates to rows X and OTHER, for starts by a height or by many positions."""
    for k in range(room.d, room.vector.shape[1]):
        for lane in range(LANES):
            room.vector[X, k, lane] = block.rows.base[k]
    if model.start == BY_HEIGHT:
        meet_ellipsoid(model, room, block.w, block.spot)
    else:
        look_around(model, block, room, block.spot, RINGS)
    refine_candidates(model, block, room, block.spot)


@compiled
def complete(block: TapeBlock, room: EngineWorkspace) -> None:
    """Write the unknowns other than the position that minimise the linearised cost to row X.

    They are exact if the rows are linear in these unknowns.
    """
    vector, d, p = room.vector, room.d, room.vector.shape[1]
    if p == d:
        return
    for k in range(d, p):
        for lane in range(LANES):
            vector[X, k, lane] = block.rows.base[k]
    equations(block, room, 0)
    _copy(room, 0)
    left, right = room.matrix[REST], vector[MOVE]
    eliminate_last(left, right, room.scalar[SPARE], vector[DIAGONAL], d)
    for k in range(d, p):
        for lane in range(LANES):
            vector[TRIAL, k, lane] = left[k, k, lane] * right[k, lane]
        for j in range(d, k):
            for lane in range(LANES):
                vector[TRIAL, k, lane] -= left[k, j, lane] * vector[TRIAL, j, lane]
    for k in range(d, p):
        for lane in range(LANES):
            vector[X, k, lane] += vector[TRIAL, k, lane]


@compiled
def _copy(room: EngineWorkspace, shift: int) -> None:
    """Copy information and right side at row X, or at TRIAL if `shift` is 1, to REST and MOVE."""
    p, left = room.vector.shape[1], room.matrix[REST]
    for i in range(p):
        for lane in range(LANES):
            room.vector[MOVE, i, lane] = room.vector[G + shift, i, lane]
        for j in range(i + 1):
            for lane in range(LANES):
                left[i, j, lane] = room.matrix[H + shift, i, j, lane]


@compiled
def equations(block: TapeBlock, room: EngineWorkspace, shift: int) -> None:
    """Write information (lower half), right side and cost at row X, or at TRIAL if `shift` is 1."""
    m = _evaluate(block, room, shift)
    p, last = room.vector.shape[1], block.at.after
    matrix, vector = room.matrix[H + shift], room.vector[G + shift]
    for i in range(p):
        for j in range(i + 1):
            for lane in range(LANES):
                matrix[i, j, lane] = m[last + i * (p + 1) + j, lane]
        for lane in range(LANES):
            vector[i, lane] = m[last + p * (p + 1) + i, lane]
    for lane in range(LANES):
        room.scalar[COST + shift, lane] = m[last + p * (p + 2), lane]


@compiled
def _evaluate(block: TapeBlock, room: EngineWorkspace, shift: int) -> Any:
    """Return the memory of the lanes, with the normal equations at row X, or at TRIAL if `shift` is 1."""
    m = _enter_place(block, room, shift)
    write_equations(block.rows.tables, block.rows.numbers, m, block.r, block.at, True, LANES)
    return m


@compiled
def _enter_place(block: TapeBlock, room: EngineWorkspace, shift: int) -> Any:
    """Return the memory of the lanes after writing row X, or TRIAL if `shift` is 1, into it."""
    x, origin = room.vector[X + shift], room.vector[ORIGIN]
    for i in range(room.vector.shape[1]):
        for lane in range(LANES):
            block.m[block.at.trial + i, lane] = x[i, lane] + origin[i, lane]
    return block.m


@compiled
def costs(block: TapeBlock, room: EngineWorkspace) -> None:
    """Write the cost at the position TRIAL, minimised over the other unknowns, to COST_TRIAL."""
    p, d, at = room.vector.shape[1], room.d, block.at.after
    if p == d:
        m = _enter_place(block, room, 1)
        write_cost(block.rows.tables, block.rows.numbers, m, block.r, block.at, LANES)
    else:
        m = _evaluate(block, room, 1)
    for lane in range(LANES):
        room.scalar[COST_TRIAL, lane] = m[at + p * (p + 2), lane]
    if p == d:
        return
    left, right = room.matrix[REST], room.vector[MOVE]
    for i in range(p):
        for j in range(i + 1):
            for lane in range(LANES):
                left[i, j, lane] = m[at + i * (p + 1) + j, lane]
        for lane in range(LANES):
            right[i, lane] = m[at + p * (p + 1) + i, lane]
    eliminate_last(left, right, room.scalar[COST_TRIAL], room.vector[DIAGONAL], d)


@compiled
def bow_of(block: TapeBlock, room: EngineWorkspace) -> float:
    """Return infinity: for tapes no bound of the curvature is known."""
    return np.inf


@compiled
def note_nearest(block: TapeBlock, room: EngineWorkspace, least: Array) -> None:
    """Write an infinite range to the nearest station: tapes do not report ranges."""
    for lane in range(LANES):
        least[lane] = np.inf


@compiled
def bend(block: TapeBlock, room: EngineWorkspace) -> None:
    """Write the information to H_TRIAL in place of the second derivatives: tapes have first derivatives only."""
    p = room.vector.shape[1]
    for i in range(p):
        for j in range(i + 1):
            for lane in range(LANES):
                room.matrix[H_TRIAL, i, j, lane] = room.matrix[H, i, j, lane]


@compiled
def measure_infinity(block: TapeBlock, room: EngineWorkspace) -> None:
    """Write infinity to BEYOND if no far position fits, else NaN (not measured)."""
    for lane in range(LANES):
        room.scalar[BEYOND, lane] = np.inf if block.rows.bounded else np.nan


@compiled
def search_infinity(model: EngineModel, block: TapeBlock, room: EngineWorkspace) -> None:
    """Write the least cost at infinity to BEYOND by a search on a sphere."""
    if block.rows.bounded or block.rows.scaled:
        measure_infinity(block, room)
    else:
        search_sphere(model, block, room, block.spot)


@compiled
def finish(block: TapeBlock, z: Array, room: EngineWorkspace, size: int, mark: Array, marked: bool, x: Array) -> None:
    """Do nothing: all unknowns are refined, and `x` contains them already."""
