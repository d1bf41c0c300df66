"""Normal equations of many problems in lanes: memory, measurements with derivatives, sums over groups of rows.

A lane is a problem; one interpreter runs the tape of a kind over all lanes. A cell of the memory m (cells, B) contains
one number of each of the B lanes. Addresses, such as those in `room`, `own`, `to` and x (the first cell of a vector),
are numbers of cells. `lanes` is the number of lanes in use. The registers of the tapes are r, and `low` is the first
column of a row in them. The tables are t, with lines such as `line`. The numbers of the problems are c (`common`,
`place`). A *group* contains rows whose noise is correlated. A *packet* contains groups whose rows are evaluated
together.

All cells are in one array, because each array argument of a kernel costs as much time as dozens of multiplications.
Kernels use integer indices instead of views: a view counts references, which takes longer than the arithmetic.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import Constant, compiled
from optloc.kernels.pack import AT, FULL, PRIOR_LOCAL, PRIOR_SIZE, PRIOR_START, Numbers, Packed
from optloc.kernels.tables import (
    DERIVATIVE,
    FIRST,
    GROUP_COLUMN,
    GROUP_EPOCH,
    GROUP_ROWS,
    KIND_CODE,
    KIND_CONSTANT,
    KIND_INPUT,
    KIND_PERIODIC,
    KIND_VALUE,
    REGISTER,
    ROW_ADDEND,
    ROW_NUMBER,
    ROW_PLACE,
    ROW_SCALE,
    ROW_SOURCE,
    ROW_WIDTH,
    SOURCE_FEED,
    SOURCE_NUMBER,
    TERM_COLUMN,
    TERM_SLOT,
    Tables,
)
from optloc.kernels.trace import ADD, ATAN2, COS, DIV, HYPOT, LOG, MUL, NEG, SIN, SQRT, SUB

# Working memory of a block of lanes, and the addresses of its parts.

LENGTH = 128
"""Length of a register, in numbers: it contains several rows of one kind, each with a number for each lane.

So an operation is selected once for several rows. The length is two rows of a full block of 64 lanes.
"""


class LaneCells(NamedTuple):
    """First cell of each part, for p unknowns of which n are shared and l are local."""

    own: int  # sources, whitening matrices and priors that differ between problems
    observed: int  # (m,)
    present: int  # (m,), or empty if all rows are present
    rows: int  # (rows of a packet, columns and residual)
    whitened: int  # (rows of a group, columns and residual)
    error: int  # (2 * largest prior,)
    scale: int  # scratch for the scale factor of a row
    trial: int  # (p,): vector at which the equations are computed
    best: int  # (p,)
    after: int  # (n + l + 1, n + l + 1): equations at `trial`, lower triangle, then vector and cost
    now: int  # the same at `best`
    step: int  # (n + l,)
    shared: int  # (n, n): factor of the shared system
    shared_scale: int  # (n,)
    local: int  # (l, l)
    local_scale: int  # (l,)
    half: int  # (n + 1, l): the local factor's inverse times coupling and vector
    state: int  # state of a refinement
    cells: int  # number of cells of a lane
    absent: int  # 1 if some rows are absent


STATE = 8
"""Number of cells of a lane for the state of a refinement."""
_EPSILON = float(np.finfo(float).eps)

# Lanes of a block: so few that the frequently used cells (2**18 doubles, 2 MB) stay in the cache, and that all cells
# fit into 64 MB. 64 lanes share the cost of selecting an operation; eight lanes fill a vector register.
_LANES, _FEWEST, _CELLS, _MOST = 64, 8, 2**18, 2**23


@compiled
def cell_layout(t: Tables, c: Numbers, size: int) -> LaneCells:
    """Return the addresses of all parts of the memory for problems of p = `size` unknowns."""
    n, local, largest = t.shared, t.local, 0
    for i in range(t.groups, c.place.shape[0]):
        largest = max(largest, c.place[i, PRIOR_SIZE])
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
    return LaneCells(
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
    """Copy the numbers of problem `item` into a lane of the memory; the arrays are fields of `Numbers`."""
    cell = _fill(m, 0, lane, source, item)
    cell = _fill(m, cell, lane, white, item)
    cell = _fill(m, cell, lane, prior, item)
    cell = _fill(m, cell, lane, observed, item)
    _fill(m, cell, lane, present, item)


@compiled
def rounding_of_residuals(sigma: Array, size: Array, m: Array, room: LaneCells, lane: int, item: int) -> float:
    """Return the rounding error of a lane's whitened residuals; it is large for arrival times from long ago."""
    row, squares = item if sigma.shape[0] > 1 else 0, 0.0
    for i in range(sigma.shape[1]):
        if not room.absent or m[room.present + i, lane] != 0.0:
            ratio = (abs(m[room.observed + i, lane]) + size[i]) / sigma[row, i]
            squares += ratio * ratio
    # Four roundings, as in `optloc.kernels.least_squares`.
    coarse = 4.0 * _EPSILON * np.sqrt(squares)
    return coarse if np.isfinite(coarse) else 0.0


@compiled
def _fill(m: Array, cell: int, lane: int, source: Array, item: int) -> int:
    # Copy the numbers of a problem to a lane, from `cell` on, and return the next cell.
    row = item if source.shape[0] > 1 else 0
    for i in range(source.shape[1]):
        m[cell + i, lane] = source[row, i]
    return int(cell + source.shape[1])


@compiled
def blocks(packed: Packed, size: int, count: int) -> int:
    """Return the number of lanes of a block for `count` problems of p = `size` unknowns.

    The block is so small that its cells stay in the cache.
    """
    t = packed.tables
    # Cells that one step uses repeatedly: rows of a packet, and the equations at two vectors.
    each = t.rows * t.width + 2 * (t.shared + t.local + 1) ** 2
    fitting = min(_CELLS // each, _MOST // (each + 2 * size + packed.numbers.observed.shape[1]))
    return int(max(1, min(count, _LANES, max(_FEWEST, _FEWEST * (fitting // _FEWEST)))))


@compiled
def memory(t: Tables, room: LaneCells, lanes: Constant) -> tuple[Array, Array]:
    """Return cells (cells, lanes) and registers (registers, LENGTH or more) for a number of lanes."""
    return np.zeros((room.cells, lanes)), np.empty((t.registers, max(LENGTH, lanes)))


@compiled
def run_operations(code: Array, first: int, last: int, r: Array, count: Constant) -> None:
    """Run operations first <= i < last of `code` on the first `count` columns of the registers, see `Tape.code`."""
    # The operation is selected once for all lanes, and the compiler turns each loop into vector instructions.
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
def _rare(operation: int, r: Array, to: int, u: int, v: int, count: Constant) -> None:
    # Run one of the less frequent operations on the first `count` numbers of registers.
    if operation == NEG:
        for i in range(count):
            r[to, i] = -r[u, i]
    elif operation == HYPOT:
        for i in range(count):
            # Squares of metres do not overflow, and a call of hypot would prevent vector instructions.
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
def write_derivatives(
    t: Tables, common: Array, m: Array, r: Array, room: LaneCells, packet: int, x: int, lanes: Constant
) -> None:
    """Write derivatives and residuals of the rows of a packet: the columns of the row's group, then the residual.

    Parameters
    ----------
    t : Tables
        Indices.
    common : array
        Numbers that the problems share.
    m : array (cells, B)
        Memory; the rows of the packet are written to `room.rows`.
    r : array (registers, LENGTH)
        Registers.
    room : LaneCells
        Addresses in the memory.
    packet : int
        Number of the packet.
    x : int
        Cell of the parameter vectors.
    lanes : int
        Number of lanes that contain a problem.
    """
    index, together = t.table, LENGTH // max(1, min(lanes, LENGTH))
    for number in range(t.kinds):
        kind, part = t.kind + number, t.part + packet * (t.kinds + 1) + number
        for row in range(index[part, FIRST], index[part + 1, FIRST], together):
            end = min(row + together, index[part + 1, FIRST])
            count, begin = (end - row) * lanes, t.input + index[kind, KIND_INPUT]
            _inputs(t, common, m, room.own, r, begin, row, end, x, lanes)
            for i in range(index[kind, KIND_CONSTANT], index[kind + 1, KIND_CONSTANT]):
                for j in range(count):
                    r[index[t.constant + i, REGISTER], j] = t.real[i]
            run_operations(index, t.code + index[kind, KIND_CODE], t.code + index[kind + 1, KIND_CODE], r, count)
            for one in range(row, end):
                line, low = t.row + one, (one - row) * lanes
                to = room.rows + index[line, ROW_PLACE] * t.width
                _derivatives(t, m, r, begin, line, low, to, lanes)
                _measurement(t, m, r, index[kind, KIND_VALUE], line, low, to, x, room.scale, lanes)
                value, seen = to + index[line, ROW_WIDTH], index[line, ROW_NUMBER]
                _residual(m, value, room.observed + seen, index[kind, KIND_PERIODIC], lanes)
                if room.absent:
                    _mask(m, value, room.present + seen, lanes)


@compiled
def _inputs(
    t: Tables, common: Array, m: Array, own: int, r: Array, begin: int, row: int, end: int, x: int, lanes: Constant
) -> None:
    """Write the inputs of rows of a kind to registers; `begin` is their first line in the table of inputs."""
    index = t.table
    for one in range(row, end):
        low, source = (one - row) * lanes, index[t.row + one, ROW_SOURCE]
        for i in range(index[t.row + one + 1, ROW_SOURCE] - source):
            to, line = index[begin + i, REGISTER], t.source + source + i
            place = index[line, SOURCE_NUMBER]
            if place >= 0:
                for b in range(lanes):
                    r[to, low + b] = common[place]
            else:
                for b in range(lanes):
                    r[to, low + b] = m[own - 1 - place, b]
            for f in range(index[line, SOURCE_FEED], index[line + 1, SOURCE_FEED]):
                column, factor = x + index[t.term + f, TERM_COLUMN], t.real[t.factor + f]
                for b in range(lanes):
                    r[to, low + b] += factor * m[column, b]


@compiled
def _derivatives(t: Tables, m: Array, r: Array, begin: int, line: int, low: int, to: int, lanes: Constant) -> None:
    """Write the derivatives of h of one row by the unknowns of its group to the cells from `to` on."""
    index = t.table
    source = index[line, ROW_SOURCE]
    for j in range(index[line, ROW_WIDTH]):
        for b in range(lanes):
            m[to + j, b] = 0.0
    for i in range(index[line + 1, ROW_SOURCE] - source):
        place = index[begin + i, DERIVATIVE]
        if place >= 0:
            for f in range(index[t.source + source + i, SOURCE_FEED], index[t.source + source + i + 1, SOURCE_FEED]):
                cell, factor = to + index[t.term + f, TERM_SLOT], t.real[t.factor + f]
                for b in range(lanes):
                    m[cell, b] += factor * r[place, low + b]


@compiled
def _measurement(
    t: Tables, m: Array, r: Array, place: int, line: int, low: int, to: int, x: int, scale: int, lanes: Constant
) -> None:
    """Write the value of one row after its derivatives (from cell `to` on), and apply scales and offsets to both."""
    index = t.table
    value, end = to + index[line, ROW_WIDTH], index[line + 1, ROW_ADDEND]
    first, last = index[line, ROW_SCALE], index[line + 1, ROW_SCALE]
    for b in range(lanes):
        m[value, b] = r[place, low + b]
    # Nearly all rows have no scale, and are not changed.
    if last > first:
        for b in range(lanes):
            m[scale, b] = 1.0
        for i in range(first, last):
            for b in range(lanes):
                m[scale, b] += t.real[t.factor + i] * m[x + index[t.term + i, TERM_COLUMN], b]
        for cell in range(to, value):
            for b in range(lanes):
                m[cell, b] *= m[scale, b]
        for i in range(first, last):
            for b in range(lanes):
                m[to + index[t.term + i, TERM_SLOT], b] += t.real[t.factor + i] * m[value, b]
        for b in range(lanes):
            m[value, b] *= m[scale, b]
    for i in range(index[line, ROW_ADDEND], end):
        cell, column = to + index[t.term + i, TERM_SLOT], x + index[t.term + i, TERM_COLUMN]
        factor = t.real[t.factor + i]
        for b in range(lanes):
            m[cell, b] += factor
        for b in range(lanes):
            m[value, b] += factor * m[column, b]


@compiled
def _residual(m: Array, value: int, observed: int, periodic: int, lanes: Constant) -> None:
    """Replace the values in cell `value` by residuals, measured minus predicted; angles are wrapped to (-pi, pi]."""
    for b in range(lanes):
        m[value, b] = m[observed, b] - m[value, b]
    if periodic:
        for b in range(lanes):
            # Wrapped only if necessary, because wrapping takes three transcendental functions.
            if not -pi < m[value, b] <= pi:
                m[value, b] = np.arctan2(np.sin(m[value, b]), np.cos(m[value, b]))


@compiled
def _mask(m: Array, value: int, present: int, lanes: Constant) -> None:
    """Set the residuals in cell `value` to zero where the row is absent."""
    for b in range(lanes):
        m[value, b] = m[value, b] if m[present, b] != 0.0 else 0.0


# From derivatives and residuals to normal equations: rows are whitened, multiplied, and summed over groups.


@compiled
def write_equations(t: Tables, c: Numbers, m: Array, r: Array, room: LaneCells, priors: bool, lanes: Constant) -> None:
    """Write the normal equations at `room.trial` to `room.after`.

    Parameters
    ----------
    t : Tables
        Indices of problems of one epoch, or without local unknowns.
    c : Numbers
        Numbers that the problems share.
    m : array (cells, B)
        Memory.
    r : array (registers, LENGTH)
        Registers.
    room : LaneCells
        Addresses in the memory.
    priors : bool
        Whether Gaussian priors are added.
    lanes : int
        Number of lanes that contain a problem.
    """
    clear(m, room.after, (t.shared + t.local + 1) ** 2, lanes)
    add_groups(t, c, m, r, room, room.trial, ALL, 0, 0, lanes)
    if priors:
        add_priors(t, c, m, room, room.trial, False, 0, lanes)
        add_priors(t, c, m, room, room.trial, True, 0, lanes)


@compiled
def write_cost(t: Tables, c: Numbers, m: Array, r: Array, room: LaneCells, lanes: Constant) -> None:
    """Write the cost at `room.trial`, with all priors, to the last cell of `room.after`."""
    total = room.after + (t.shared + t.local + 1) ** 2 - 1
    for b in range(lanes):
        m[total, b] = 0.0
    for packet in range(t.packets):
        write_derivatives(t, c.common, m, r, room, packet, room.trial, lanes)
        for group in range(t.table[t.packet + packet, FIRST], t.table[t.packet + packet + 1, FIRST]):
            residual = whiten_group(t, c.common, c.place, m, room, group, True, lanes)
            for i in range(t.table[t.group + group, GROUP_ROWS]):
                for b in range(lanes):
                    m[total, b] += m[residual + i * t.width, b] * m[residual + i * t.width, b]
    add_priors(t, c, m, room, room.trial, False, 0, lanes)
    for epoch in range(t.epochs):
        add_priors(t, c, m, room, room.trial, True, epoch, lanes)


ALL = -1
"""Value of the argument `epoch` that selects the groups of all epochs."""


@compiled
def add_groups(
    t: Tables,
    c: Numbers,
    m: Array,
    r: Array,
    room: LaneCells,
    x: int,
    epoch: int,
    group: int,
    packet: int,
    lanes: Constant,
) -> tuple[int, int]:
    """Add the rows of an epoch at the vectors in cell x to `room.after`; return the next group and packet.

    Groups are sorted by epoch, and packets by group, so that one pass visits all of them.
    """
    while group < t.groups and (epoch == ALL or t.table[t.group + group, GROUP_EPOCH] == epoch):
        if packet < t.packets and t.table[t.packet + packet, FIRST] == group:
            write_derivatives(t, c.common, m, r, room, packet, x, lanes)
            packet += 1
        add_group(t, c.common, c.place, m, room, group, lanes)
        group += 1
    return group, packet


@compiled
def add_priors(
    t: Tables, c: Numbers, m: Array, room: LaneCells, x: int, local: bool, epoch: int, lanes: Constant
) -> None:
    """Add the priors of the shared unknowns, or of the unknowns of an epoch, to the equations in `room.after`."""
    for i in range(t.groups, c.place.shape[0]):
        if (c.place[i, PRIOR_LOCAL] == 1) == local:
            start = c.place[i, PRIOR_START] + (t.shared if local else 0)
            at = x + start + (epoch * t.local if local else 0)
            _add_prior(c.common, c.place[i, AT], c.place[i, PRIOR_SIZE], m, room, at, start, t.shared + t.local, lanes)


@compiled
def clear(m: Array, first: int, count: int, lanes: Constant) -> None:
    """Set `count` cells from `first` on to zero."""
    for cell in range(first, first + count):
        for b in range(lanes):
            m[cell, b] = 0.0


@compiled
def add_group(t: Tables, common: Array, place: Array, m: Array, room: LaneCells, group: int, lanes: Constant) -> None:
    """Add the whitened rows of a group to the equations in `room.after`."""
    line = t.group + group
    begin, size = t.table[line, GROUP_COLUMN], t.table[line, GROUP_ROWS]
    columns = t.table[line + 1, GROUP_COLUMN] - begin + 1
    first = whiten_group(t, common, place, m, room, group, False, lanes)
    _square(t.table, t.column + begin, m, first, t.width, size, columns, room.after, t.shared + t.local, lanes)


@compiled
def whiten_group(
    t: Tables, common: Array, place: Array, m: Array, room: LaneCells, group: int, residual: bool, lanes: Constant
) -> int:
    """Whiten the rows of a group, or only their residuals, and return the cell of the first whitened row."""
    line = t.group + group
    columns = t.table[line + 1, GROUP_COLUMN] - t.table[line, GROUP_COLUMN]
    begin = room.rows + t.table[line, FIRST] * t.width + (columns if residual else 0)
    count, size = (1 if residual else columns + 1), t.table[line, GROUP_ROWS]
    at, full = place[group, AT], place[group, FULL]
    _whiten(common, at, full, m, room.own, begin, t.width, size, count, room.whitened, lanes)
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
    lanes: Constant,
) -> None:
    """Write `size` rows of `columns` cells, from cell `first` on, times the whitening matrix, to cell `to`.

    Rows are `width` cells apart. `full` is 0 if the matrix is lower triangular, else 1.
    """
    for i in range(size):
        for s in range(columns):
            cell = to + i * width + s
            for b in range(lanes):
                m[cell, b] = 0.0
            # Whitening matrices are lower triangular, except for singular covariances.
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
    lanes: Constant,
) -> None:
    """Add the products of the columns of `size` whitened rows to the equations at `to`; the residual is last."""
    for i in range(columns):
        line = to + (index[column + i, FIRST] if i < columns - 1 else last) * (last + 1)
        for j in range(i + 1):
            cell = line + (index[column + j, FIRST] if j < columns - 1 else last)
            r, u, v = 0, first + i, first + j
            # Four rows at a time in two sums, so that a cell is loaded and stored once for four products.
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
def _add_prior(
    common: Array, place: int, size: int, m: Array, room: LaneCells, x: int, start: int, last: int, lanes: Constant
) -> None:
    """Add a Gaussian prior of the `size` unknowns from cell x on, whose first column of `last` columns is `start`."""
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
