"""Several tapes in one table, because every array that a kernel takes costs time."""

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
        A line for each tape, and one behind: where its operations, constants, inputs and outputs begin in this table.
        Then the operations of all tapes, see `optloc.kernels.trace.Tape`; registers of constants; registers of inputs,
        and the seed of each; registers of outputs, -1 for what is zero.
    value : array (c,)
        What the registers of constants hold.
    registers : int
        How many.
    """

    table: Array
    value: Array
    registers: int


def tape_table(tapes: Sequence[Tape], outputs: Sequence[Sequence[int]]) -> TapeTable:
    """Return tapes as one table, with the registers of the outputs of each; -1 for what is zero."""
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
    """Run a tape on the first numbers of registers (registers, n), whose inputs are there."""
    table = t.table
    for i in range(table[k, CONSTANT], table[k + 1, CONSTANT]):
        value = t.value[i - table[0, CONSTANT]]
        for lane in range(count):
            r[table[i, 0], lane] = value
    run_operations(table, table[k, CODE], table[k + 1, CODE], r, count)
