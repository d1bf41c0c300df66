"""Tables from CSV and Parquet files, from rows in a problem file and from data frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optloc.errors import InvalidProblem
from optloc.files.document import existing, read_text
from optloc.files.schema import DataTable
from optloc.files.table import Table
from optloc.files.words import join
from optloc.types import Array

_PARQUET = (".parquet", ".pq")
_FILES = (".csv", ".txt", ".tsv", *_PARQUET)


def table_of(section: DataTable, folder: Path, where: str) -> Table:
    """Return the rows that a table of a problem file names or holds."""
    if (section.file is None) == (section.rows is None):
        raise InvalidProblem("the rows must be given once", where, 'write file = "..." or rows = [ ... ]')
    if section.rows is not None:
        return of_rows(section.rows, where, section.columns)
    assert section.file is not None
    path = folder / section.file
    suffix = path.suffix.lower()
    if suffix not in _FILES and not path.is_dir():
        raise InvalidProblem(
            f"{section.file!r} is of no known type", join(where, "key 'file'"), f"use {', '.join(_FILES)}"
        )
    found = (
        parquet(existing(path), section.columns)
        if suffix in _PARQUET
        else csv(path, section.separator, section.columns)
    )
    if not found.count:
        raise InvalidProblem("the table has no rows", found.source, "give at least one")
    return found


def of_rows(rows: Sequence[Mapping[str, Any]], where: str, names: Mapping[str, str]) -> Table:
    """Return the table of inline rows; a key that a row lacks is an empty cell."""
    if not rows:
        raise InvalidProblem("the table has no rows", where, "give at least one")
    keys = dict.fromkeys(key for row in rows for key in row)
    return Table(where, {key: _typed([row.get(key) for row in rows]) for key in keys}, len(rows), names)


def of_frame(frame: Any, where: str, names: Mapping[str, str]) -> Table:
    """Return the table of a pandas data frame, or of a mapping from names to columns."""
    columns = {str(name): np.asarray(frame[name]) for name in (frame.columns if hasattr(frame, "columns") else frame)}
    sizes = {len(column) for column in columns.values()}
    if len(sizes) != 1 or not sizes.copy().pop():
        raise InvalidProblem("the table has no rows, or columns of unequal length", where, "give at least one row")
    return Table(where, columns, sizes.pop(), names)


def csv(path: Path, separator: str, names: Mapping[str, str]) -> Table:
    """Return the table of a CSV file with a header, all cells as text."""
    import pyarrow as pa
    from pyarrow import csv as reader

    text = read_text(path)
    header = [name.strip().strip('"') for name in text.partition("\n")[0].strip().split(separator)]
    if not any(header):
        raise InvalidProblem("the file is empty or has no header", path.name, "begin it with the names of its columns")
    twice = next((name for i, name in enumerate(header) if name in header[:i]), None)
    if twice is not None:
        raise InvalidProblem(f"column {twice!r} occurs twice", join(path.name, "header"), "rename one of them")
    try:
        read = reader.read_csv(
            pa.BufferReader(text.encode()),
            read_options=reader.ReadOptions(column_names=header, skip_rows=1, use_threads=False),
            parse_options=reader.ParseOptions(delimiter=separator),
            convert_options=reader.ConvertOptions(
                column_types=dict.fromkeys(header, pa.string()), strings_can_be_null=True, null_values=[""]
            ),
        )
    except pa.ArrowInvalid as error:
        what = str(error).partition("CSV parse error: ")[2] or str(error)
        line, _, rest = what.splitlines()[0].rpartition(": Expected")
        number = line.removeprefix("Row #")
        place = join(path.name, f"row {int(number) - 1}" if number.isdigit() else None)
        what = f"expected{rest}" if rest else what
        raise InvalidProblem(f"this is no CSV table: {what}", place, "check its separators and quotes") from None
    columns = {name: read.column(name).to_numpy(zero_copy_only=False).astype(object) for name in header}
    return Table(path.name, columns, read.num_rows, names)


def parquet(path: Path, names: Mapping[str, str]) -> Table:
    """Return the table of a Parquet file."""
    import pyarrow as pa
    from pyarrow import parquet as reader

    try:
        read = reader.read_table(path)
    except (pa.ArrowException, OSError):
        raise InvalidProblem("the file is not Parquet", path.name, "write it again, or name a CSV file .csv") from None
    columns = {name: read.column(name).to_numpy(zero_copy_only=False) for name in read.column_names}
    return Table(path.name, columns, read.num_rows, names)


def _typed(cells: list[Any]) -> Array:
    if all(isinstance(cell, int | float) and not isinstance(cell, bool) for cell in cells):
        return np.array(cells)
    column = np.empty(len(cells), dtype=object)
    column[:] = cells
    return column
