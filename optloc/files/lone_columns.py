"""Columns and stations that only one choice fits: the names of stations, and the reference of differences.

Tables often name stations by unusual words, such as the file of a recorder. These functions return a choice only
if it is the only one, and otherwise None; the caller then raises an error.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from datetime import datetime

import numpy as np

from optloc.base.types import Array
from optloc.files.table import Table, is_empty
from optloc.files.words import Words


def names_stations(table: Table, taken: Collection[str]) -> str | None:
    """Return the only column of text whose cells are distinct and not empty, or None.

    `taken` are the columns that have another use. One row does not show whether the cells of a column are distinct.
    """
    if table.count < 2:
        return None
    fitting = [
        name
        for name in text_columns(table, taken)
        if len({str(cell).strip() for cell in table.raw(name).tolist()}) == table.count
    ]
    return fitting[0] if len(fitting) == 1 else None


def text_columns(table: Table, taken: Collection[str]) -> list[str]:
    """Return the columns without `taken` whose cells are text: no cell is empty, a number or a date."""
    return [name for name in table.columns if name not in taken and _is_text(table.columns[name])]


def _is_text(column: Array | Words) -> bool:
    """Return whether all cells of a column are text, and at least one exists."""
    if column.dtype.kind not in "OUT":
        return False
    cells = column.cells.tolist() if isinstance(column, Words) else column.tolist()
    return bool(cells) and all(
        isinstance(cell, str) and not is_empty(cell) and not _is_number_or_date(cell.strip()) for cell in cells
    )


def _is_number_or_date(cell: str) -> bool:
    """Return whether a cell is a number, or a date in the form of ISO 8601."""
    for read in (float, datetime.fromisoformat):
        try:
            read(cell)
        except ValueError:
            continue
        return True
    return False


def without_difference(stations: Sequence[str], a: Array, differs: Array) -> str | None:
    """Return the only station that has no difference, which is the reference of the others; else None.

    Parameters
    ----------
    stations : sequence of str
        All stations of the network.
    a : object array (m,)
        Station of each difference.
    differs : bool array (m,)
        Whether the difference is not zero. Zeros are no differences here, since tables have them for the reference.
    """
    having = set(np.asarray(a)[differs].tolist())
    silent = [name for name in stations if name not in having]
    return silent[0] if len(silent) == 1 else None
