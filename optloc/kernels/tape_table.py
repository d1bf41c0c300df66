"""Several tapes in one table, because each array argument of a kernel costs time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.batched_rows import run_operations
from optloc.kernels.jit import compiled
from optloc.kernels.tables import starts
from optloc.kernels.trace import Tape

CODE, CONSTANT, INPUT, OUTPUT = range(4)
"""Columns of the first lines of `TapeTable.table`."""


class TapeTable(NamedTuple):
    """Tapes as one table.

    Parameters
    ----------
    table : int64 array (n, 4)
        First, one line for each tape and one more line: the first line of its operations, constants, inputs and outputs
        in this table. Then the operations of all tapes (see `optloc.kernels.trace.Tape`), the registers of constants,
        register and seed of each input, and the registers of outputs (-1 for an output that is zero).
    value : array (c,)
        Values of the constants.
    registers : int
        Number of registers.
    """

    table: Array
    value: Array
    registers: int


def tape_table(tapes: Sequence[Tape], outputs: Sequence[Sequence[int]]) -> TapeTable:
    """Return tapes as one table; `outputs` has the registers of the outputs of each tape, -1 for a zero output."""
    columns = (
        [one.code for one in tapes],
        [[(register, 0, 0, 0) for register, _ in one.constants] for one in tapes],
        [[(register, seed, 0, 0) for seed, register in one.inputs] for one in tapes],
        [[(register, 0, 0, 0) for register in own] for own in outputs],
    )
    lines, begin = [], len(tapes) + 1
    for parts in columns:
        at = starts([len(part) for part in parts])
        lines.append(begin + at)
        begin += int(at[-1])
    rows = [np.array(part, dtype=np.int64).reshape(-1, 4) for parts in columns for part in parts]
    return TapeTable(
        np.concatenate([np.stack(lines, axis=1), *rows]),
        np.array([value for one in tapes for _, value in one.constants], dtype=float),
        max((one.registers for one in tapes), default=1),
    )


@compiled
def run_tape(t: TapeTable, k: int, r: Array, count: int) -> None:
    """Run tape k on the first `count` columns of the registers r (registers, n).

    The columns are the problems. The registers already contain the inputs; the outputs are then in the registers that
    the table names.
    """
    table = t.table
    for i in range(table[k, CONSTANT], table[k + 1, CONSTANT]):
        value = t.value[i - table[0, CONSTANT]]
        for lane in range(count):
            r[table[i, 0], lane] = value
    run_operations(table, table[k, CODE], table[k + 1, CODE], r, count)
