"""Tables as read from files: columns of text or numbers, and places of cells for messages."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from csv import Error as CSVError, reader as lines_of
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from optloc.base.arrays import first_rows
from optloc.base.errors import InvalidProblem, check_once, nearest
from optloc.base.inputs import check_budget, decoded, has_controls, read_bytes, within
from optloc.base.time_scales import TimeScale, unix_seconds
from optloc.base.types import Array
from optloc.base.units import LARGEST
from optloc.files.schema import DataTable
from optloc.files.settings import join
from optloc.files.words import Words, objects, words_of

_PARQUET = (".parquet", ".pq")
_FILES = (".csv", ".txt", ".tsv", *_PARQUET)
_REPEATED_COLUMN = "column {!r} occurs twice"
# Largest number of characters of an invalid cell in a message.
_WORD = 40


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of equal length.

    Parameters
    ----------
    source : str
        File, or place in a file, for messages.
    columns : mapping of str to array (m,) or Words
        Numbers, datetimes, or objects (text, None for an empty cell).
    count : int
        Number of rows m.
    names : mapping of str to str
        Names in this table of the standard columns.
    first : int array (m,), optional
        Row numbers in the source, for a part of a table.
    others : mapping of str to str
        Types of columns that are neither numbers, dates nor text.
    notes : tuple of str
        Notes on the conversion of the file.
    """

    source: str
    columns: Mapping[str, Array | Words]
    count: int
    names: Mapping[str, str] = field(default_factory=dict)
    first: Array | None = None
    others: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def take(self, pick: Array) -> Table:
        """Return the rows with the indices `pick`."""
        columns = {name: column[pick] for name, column in self.columns.items()}
        return Table(self.source, columns, len(pick), self.names, pick, self.others)

    def name(self, key: str) -> str:
        """Return the name of a standard column in this table."""
        return self.names.get(key, key)

    def has(self, key: str) -> bool:
        """Return whether the table has a column."""
        return self.name(key) in self.columns or self.name(key) in self.others

    def where(self, key: str, row: int | None = None) -> str:
        """Return the place of a cell (0-based row) or of a column, for messages."""
        return join(self.source if row is None else self.at(row), f"column {self.name(key)!r}")

    def at(self, row: int) -> str:
        """Return the place of a row (0-based), for messages."""
        return f"{self.source}, row {(row if self.first is None else int(self.first[row])) + 1}"

    def raw(self, key: str) -> Array:
        """Return a column as read, as an array; raise InvalidProblem if it is missing."""
        return np.asarray(self.cells(key))

    def cells(self, key: str) -> Array | Words:
        """Return a column in its stored form; raise InvalidProblem if it is missing."""
        name = self.name(key)
        if name in self.others:
            what = f"the column has the type {self.others[name]}, which is neither numbers, dates nor text"
            raise InvalidProblem(what, self.where(key), "write the column as numbers or text")
        if name not in self.columns:
            what = f"there is no column {name!r}" + (f" (for {key})" if name != key else "")
            # Do not suggest columns that already have a role.
            renamed = set(self.names.values())
            advice = nearest(name, sorted(set(self.columns) - renamed) or sorted(self.columns))
            hint = "" if key in self.names else f', or state it as columns = {{ {key} = "..." }}'
            raise InvalidProblem(what, self.source, advice + hint)
        return self.columns[name]

    def numbers(self, key: str, optional: bool = False) -> Array:
        """Return a column as finite numbers (m,); an empty cell is NaN if `optional`, else an error."""
        column = self.raw(key)
        values = column.astype(np.float64) if column.dtype.kind in "iuf" else self._parse(key, column)
        bad = (np.abs(values) > LARGEST) if optional else ~(np.abs(values) <= LARGEST)
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            given = column[row]
            why = f"larger than {LARGEST:g}" if np.isfinite(values[row]) else "not a finite number"
            what = "the cell is empty" if is_empty(given) else f"{str(given)[:_WORD]} is {why}"
            raise InvalidProblem(what, self.where(key, row), "give a number, or remove the row")
        return values

    def labels(self, key: str) -> Array:
        """Return a column as text (m,); raise InvalidProblem for an empty cell."""
        column = self.cells(key)
        if column.dtype.kind in "iu":
            column = np.asarray(column).astype(str).astype(object)
        if column.dtype.kind == "M":
            column = np.datetime_as_string(np.asarray(column)).astype(object)
        words = column if isinstance(column, Words) else words_of(column)
        # Convert each distinct cell once: millions of rows have few names.
        spelled = [_spelled(cell) for cell in words.cells]
        if not all(spelled) or has_controls("".join(spelled)):
            wrong = next((i for i in words.index.tolist() if not spelled[i] or has_controls(spelled[i])), None)
            if wrong is not None:
                what = f"{spelled[wrong]!r} has control characters" if spelled[wrong] else "the cell is empty"
                row = int(np.flatnonzero(words.index == wrong)[0])
                raise InvalidProblem(what, self.where(key, row), "give a name")
        return cast("Array", words.renamed(spelled))  # for type checkers, Words is an array

    def has_dates(self, key: str) -> bool:
        """Return whether a column has dates, by its type or its first cell."""
        column = self.raw(key)
        # A date has two hyphens: 2024-05-01; a negative number has one.
        text = column.dtype.kind == "O" and len(column) and isinstance(column[0], str) and column[0].count("-") >= 2
        return bool(text) or column.dtype.kind == "M"

    def times(self, key: str, factor: float, scale: TimeScale = "none") -> Array:
        """Return a column of numbers (times `factor`) or ISO 8601 dates as seconds (m,).

        With a time scale, the numbers become seconds since 1970, UTC, as the dates.
        """
        column = self.raw(key)
        if column.dtype.kind == "O" and self.has_dates(key):
            column = self._dates(key, column)
        if column.dtype.kind == "M":
            late = np.isnat(column) | (np.abs(column.astype("datetime64[Y]").astype(np.int64)) > _YEARS)
            if late.any():
                place = self.where(key, int(np.flatnonzero(late)[0]))
                raise InvalidProblem(
                    "the date is missing, or too far from the present", place, "write it as 2024-05-01"
                )
            return column.astype("datetime64[ns]").astype(np.int64) * 1e-9
        return unix_seconds(self.numbers(key) * factor, scale)

    def _dates(self, key: str, column: Array) -> Array:
        """Return a column of ISO 8601 text as dates (m,), UTC; raise InvalidProblem for other cells."""
        import pandas as pd

        # pandas would read a number as nanoseconds, so reject cells without text.
        other = next((row for row, cell in enumerate(column) if not isinstance(cell, str | None)), None)
        if other is not None:
            what = f"{column[other]!r} is not a date, but other cells are"
            raise InvalidProblem(what, self.where(key, other), "use only ISO 8601 dates, or only numbers")
        try:
            # pandas reads time zones, which numpy does not; without a zone, UTC is assumed.
            return np.asarray(pd.to_datetime(column, format="ISO8601", utc=True).tz_localize(None).to_numpy())
        except (ValueError, OverflowError, TypeError) as error:
            what = str(error).partition(",")[0].partition(". You")[0]
            raise InvalidProblem(f"a date cannot be read ({what})", self.where(key), "use ISO 8601") from None

    def _parse(self, key: str, column: Array) -> Array:
        """Return a column of text as numbers (m,); an empty cell is NaN. Raise InvalidProblem for other text."""
        # numpy converts dates and booleans to numbers without a meaning, so reject them.
        if column.dtype.kind not in "OSU":
            raise InvalidProblem(
                f"the column has the type {column.dtype}, not numbers", self.where(key), "give numbers"
            )
        cells = column.tolist()
        # Convert all cells at once if possible; else cell by cell, to find the invalid cell.
        if all(isinstance(cell, str) and "_" not in cell for cell in cells):
            with suppress(ValueError):
                return column.astype(np.float64)
        return np.array([np.nan if is_empty(cell) else self._number(key, row, cell) for row, cell in enumerate(cells)])

    def _number(self, key: str, row: int, cell: Any) -> float:
        """Return one cell as a number; raise InvalidProblem for other cells."""
        # Python reads 1_000 as a thousand and True as 1; in a table these are typing errors.
        if not isinstance(cell, bool) and "_" not in str(cell):
            with suppress(TypeError, ValueError, OverflowError):
                return float(cell)
        raise InvalidProblem(f"{cell!r} is not a number", self.where(key, row), number_advice(cell, "give a number"))


# A number with a decimal comma, of a length that fits a message.
_DECIMAL_COMMA = re.compile(r"[-+]?\d{1,9},\d{1,9}")


def number_advice(cell: object, usual: str) -> str:
    """Return the next step for a cell that is not a number: a decimal point for a comma, else `usual`."""
    text = str(cell).strip()
    if _DECIMAL_COMMA.fullmatch(text) is None:
        return usual
    return f"write decimal points in all cells, such as {text.replace(',', '.')}"


# Years from 1970 that fit into 64-bit nanoseconds; numpy overflows beyond to an earlier century.
_YEARS = 290


def _spelled(cell: object) -> str:
    """Return a name as text; empty for an empty cell."""
    if isinstance(cell, str):
        return cell.strip()
    if is_empty(cell):
        return ""
    # Names that a table stores as floats: 3.0 is the station 3. Larger floats have lost their last digit.
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < 2.0**53:
        return str(int(cell))
    return str(cell).strip()


def is_empty(cell: object) -> bool:
    """Return whether a cell is empty."""
    return cell is None or cell == "" or (isinstance(cell, float) and np.isnan(cell)) or str(cell).isspace()


# Tables from CSV and Parquet files, from rows in a problem file and from data frames.


def table_of(section: DataTable, folder: Path, where: str) -> Table:
    """Return the rows in a table of a problem file, or in the file that it names.

    `section` is that table, and `folder` the folder of the problem file. Raise InvalidProblem if the table has both or
    neither.
    """
    if (section.file is None) == (section.rows is None):
        raise InvalidProblem("the rows must be given once", where, 'write file = "..." or rows = [ ... ]')
    if section.rows is not None:
        return of_rows(section.rows, where, section.columns)
    assert section.file is not None
    place = join(where, "key 'file'")
    path = within(folder, section.file, place)
    suffix = path.suffix.lower()
    if suffix not in _FILES and not path.is_dir():
        raise InvalidProblem(f"{section.file!r} has an unknown type", place, f"use {', '.join(_FILES)}")
    found = parquet(path, section.columns) if suffix in _PARQUET else csv(path, section.separator, section.columns)
    if not found.count:
        raise InvalidProblem("the table has no rows", found.source, "give at least one row")
    return found


def of_rows(rows: Sequence[Mapping[str, Any]], where: str, names: Mapping[str, str]) -> Table:
    """Return the table of inline rows; a missing key is an empty cell."""
    if not rows:
        raise InvalidProblem("the table has no rows", where, "give at least one row")
    keys = dict.fromkeys(key for row in rows for key in row)
    return Table(where, {key: _to_column([row.get(key) for row in rows]) for key in keys}, len(rows), names)


def of_frame(frame: Any, where: str, names: Mapping[str, str]) -> Table:
    """Return the table of a pandas data frame, or of a mapping from names to columns."""
    columns = {str(name): np.asarray(frame[name]) for name in (frame.columns if hasattr(frame, "columns") else frame)}
    sizes = {len(column) if column.ndim == 1 else 0 for column in columns.values()}
    if len(sizes) != 1 or not sizes.copy().pop():
        raise InvalidProblem("the table has no rows, or columns of unequal length", where, "give at least one row")
    return Table(where, columns, sizes.pop(), names)


def csv(path: Path, separator: str | None, names: Mapping[str, str]) -> Table:
    """Return the table of a CSV file with a header, all cells as text.

    Without `separator`, the header determines it. `names` has the names in this table of the standard columns.
    """
    import pyarrow as pa
    from pyarrow import csv as reader

    data = read_bytes(path, lines=True)
    top = decoded(data.partition(b"\n")[0], path.name).strip()
    # The separator is the most frequent candidate in the header.
    separator = max(",;\t", key=top.count) if separator is None else separator
    header = _header(top, separator, path.name)
    try:
        read = reader.read_csv(
            pa.BufferReader(data),
            read_options=reader.ReadOptions(column_names=header, skip_rows=1, use_threads=False),
            parse_options=reader.ParseOptions(delimiter=separator),
            # Read all cells as text. They are converted when the column is used, so that errors have a row.
            convert_options=reader.ConvertOptions(
                column_types=dict.fromkeys(header, pa.string()), strings_can_be_null=True, null_values=[""]
            ),
        )
    except pa.ArrowInvalid as error:
        decoded(data, path.name)  # reports bytes that are not UTF-8 with their line
        raise _no_csv(str(error), path.name) from None
    check_budget("cells", read.num_rows * len(header), path.name)
    columns = {name: _text_column(pa, read.column(name)) for name in header}
    count = read.num_rows
    del read, data
    # The memory pool of pyarrow would keep the memory of the file.
    pa.default_memory_pool().release_unused()
    return Table(path.name, columns, count, names)


def _header(line: str, separator: str, source: str) -> list[str]:
    """Return the names of the columns; raise InvalidProblem for an empty header or repeated names.

    The library pyarrow does not reject them.
    """
    check_budget("columns", line.count(separator) + 1, source)
    try:
        header = [name.strip() for name in next(lines_of([line], delimiter=separator, strict=True), [])]
    except CSVError as error:
        raise _no_csv(str(error), join(source, "header")) from None
    if not any(header):
        raise InvalidProblem(
            "the file is empty or has no header", source, "begin the file with the names of its columns"
        )
    check_once(header, _REPEATED_COLUMN, join(source, "header"))
    return header


def _no_csv(complaint: str, source: str) -> InvalidProblem:
    """Return the error for a text that is not a CSV table, from the complaint of the library."""
    # pyarrow counts rows from the line after the header.
    what = (complaint.partition("CSV parse error: ")[2] or complaint).splitlines()[0]
    line, found, rest = what.rpartition(": Expected")
    number = line.removeprefix("Row #")
    place = join(source, f"row {int(number) - 1}" if number.isdigit() else None)
    what = f"expected{rest}" if found else what
    return InvalidProblem(f"this is not a CSV table: {what}", place, "check separators and quotes")


def parquet(path: Path, names: Mapping[str, str]) -> Table:
    """Return the table of a Parquet file.

    For columns that are neither numbers, dates nor text, only names are stored.
    """
    import pyarrow as pa
    from pyarrow import parquet as reader

    data = pa.BufferReader(read_bytes(path))
    try:
        about = reader.ParquetFile(data)
        schema = about.schema_arrow
        # Check the declared sizes before decompression: 1 KiB may expand to terabytes.
        _check_size(about.metadata, schema, path.name)
        texts = [
            entry.name for entry in schema if pa.types.is_string(entry.type) or pa.types.is_large_string(entry.type)
        ]
        fit = {entry.name: _fits(pa, entry.type) for entry in schema}
        # Keep text in its stored dictionary: a long word that all rows share is stored once.
        read = reader.ParquetFile(data, read_dictionary=texts).read(columns=[name for name in fit if fit[name]])
        # A damaged page may refer to words that are not in the dictionary.
        read.validate(full=True)
        columns = {name: _column_of(pa, read.column(name)) for name in read.column_names}
    except (pa.ArrowException, OSError, UnicodeDecodeError, OverflowError) as error:
        text = isinstance(error, UnicodeDecodeError) or "UTF8" in str(error)
        what = "a column of text is not UTF-8" if text else "the file is not Parquet"
        raise InvalidProblem(what, path.name, "save it again, or use the ending .csv for a CSV file") from None
    others = {entry.name: str(entry.type) for entry in schema if not fit[entry.name]}
    return Table(path.name, columns, read.num_rows if columns else about.metadata.num_rows, names, others=others)


def of_arrow(read: Any, source: str) -> Table:
    """Return a table of pyarrow as the reader of a Parquet file returns it; `source` is its name for messages."""
    import pyarrow as pa

    check_once(read.schema.names, _REPEATED_COLUMN, source)
    kinds = {entry.name: entry.type for entry in read.schema}
    text = {name for name, kind in kinds.items() if pa.types.is_string(kind) or pa.types.is_large_string(kind)}
    columns = {}
    for name in (name for name, kind in kinds.items() if _fits(pa, kind)):
        column = read.column(name)
        columns[name] = _column_of(pa, column.dictionary_encode() if name in text else column)
    others = {name: str(kind) for name, kind in kinds.items() if name not in columns}
    return Table(source, columns, read.num_rows, {}, others=others)


def _check_size(about: Any, schema: Any, source: str) -> None:
    """Raise InvalidProblem if a Parquet file declares sizes beyond the budget, or sizes that contradict each other.

    `about` has the metadata of the file, and `schema` its columns.
    """
    check_budget("columns", len(schema), source)
    check_budget("rows", about.num_rows, source)
    check_budget("cells", about.num_rows * len(schema), source)
    groups = [about.row_group(i) for i in range(about.num_row_groups)]
    check_budget("bytes", sum(max(group.total_byte_size, 0) for group in groups), source)
    if sum(group.num_rows for group in groups) != about.num_rows:
        raise InvalidProblem("the numbers of rows in the file do not agree", source, "save it again")
    check_once(schema.names, _REPEATED_COLUMN, source)


def _fits(pa: Any, kind: Any) -> bool:
    """Return whether a Parquet column of the type `kind` has numbers, dates or text; `pa` is the library pyarrow."""
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    tests = "is_integer is_floating is_decimal is_timestamp is_date is_string is_large_string is_null"
    return any(getattr(pa.types, test)(kind) for test in tests.split())


# Number of cells that decide whether a column repeats its words.
_SAMPLE = 2000


def _text_column(pa: Any, column: Any) -> Array | Words:
    """Return a column of text; repeated words are stored once, which saves time and memory later."""
    sample = column.slice(0, _SAMPLE)
    repeats = 2 * len(sample.unique()) <= len(sample)
    return _column_of(pa, column.dictionary_encode() if repeats else column)


def _column_of(pa: Any, column: Any) -> Array | Words:
    """Return a column of pyarrow as an array; text with repeated words is stored as distinct words and indices."""
    if not pa.types.is_dictionary(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False))
    column = column.unify_dictionaries().combine_chunks()  # each group of rows has a separate dictionary
    words = objects([*column.dictionary.to_pylist(), None])
    index = column.indices.fill_null(len(words) - 1).to_numpy(zero_copy_only=False)
    first = first_rows(index)[0]  # the dictionary may have words that no row uses
    place = np.zeros(len(words), dtype=index.dtype)
    place[index[first]] = np.arange(len(first))
    return Words(words[index[first]], place[index])


def _to_column(cells: list[Any]) -> Array:
    """Return cells as a column (m,): numbers as floats or integers, other cells unchanged."""
    # Numbers become an array if floats keep all their digits; other cells are kept unchanged.
    if all(isinstance(cell, float) or (type(cell) is int and abs(cell) < 2**53) for cell in cells):
        return np.array(cells)
    column = np.empty(len(cells), dtype=object)
    column[:] = cells
    return column
