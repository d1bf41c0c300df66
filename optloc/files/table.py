"""A table as it was read: columns of text or numbers, what to call its rows in a complaint, its rows by epoch."""

from __future__ import annotations

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
from optloc.base.types import Array
from optloc.base.units import LARGEST
from optloc.files.schema import DataTable, join
from optloc.files.words import Words, distinct, objects, words_of

_PARQUET = (".parquet", ".pq")
_FILES = (".csv", ".txt", ".tsv", *_PARQUET)
_TWICE = "column {!r} occurs twice"
# What is repeated of a cell that is refused.
_WORD = 40


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of equal length.

    Parameters
    ----------
    source : str
        File, or place in a file, to name.
    columns : mapping of str to array (m,) or Words
        NumberColumn, datetimes, or objects (text, None where a cell is empty).
    count : int
        Number of rows m.
    names : mapping of str to str
        What the columns that are asked for are called here.
    first : int array (m,), optional
        Row of the source that each row was, where it is a part of a table.
    others : mapping of str to str
        Type of each column that is neither numbers, dates nor text.
    notes : tuple of str
        What was done to make a table of the file.
    """

    source: str
    columns: Mapping[str, Array | Words]
    count: int
    names: Mapping[str, str] = field(default_factory=dict)
    first: Array | None = None
    others: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def take(self, pick: Array) -> Table:
        """Return some of the rows."""
        columns = {name: column[pick] for name, column in self.columns.items()}
        return Table(self.source, columns, len(pick), self.names, pick, self.others)

    def name(self, key: str) -> str:
        """Return what a column is called in this table."""
        return self.names.get(key, key)

    def has(self, key: str) -> bool:
        """Return whether there is such a column."""
        return self.name(key) in self.columns or self.name(key) in self.others

    def where(self, key: str, row: int | None = None) -> str:
        """Return the place of a cell (0-based row) or of a column."""
        return join(self.source if row is None else self.at(row), f"column {self.name(key)!r}")

    def at(self, row: int) -> str:
        """Return the place of a row (0-based)."""
        return f"{self.source}, row {(row if self.first is None else int(self.first[row])) + 1}"

    def raw(self, key: str) -> Array:
        """Return a column as it was read; raise InvalidProblem where there is none."""
        return np.asarray(self.cells(key))

    def cells(self, key: str) -> Array | Words:
        """Return a column as it is kept; raise InvalidProblem where it is missing."""
        name = self.name(key)
        if name in self.others:
            what = f"it holds {self.others[name]}, which is neither numbers, dates nor text"
            raise InvalidProblem(what, self.where(key), "write it as numbers or text")
        if name not in self.columns:
            what = f"there is no column {name!r}" + (f" (for {key})" if name != key else "")
            # Columns that already have a role are no suggestion.
            renamed = set(self.names.values())
            advice = nearest(name, sorted(set(self.columns) - renamed) or sorted(self.columns))
            hint = "" if key in self.names else f', or name it by columns = {{ {key} = "..." }}'
            raise InvalidProblem(what, self.source, advice + hint)
        return self.columns[name]

    def numbers(self, key: str, optional: bool = False) -> Array:
        """Return a column as finite numbers (m,); an empty cell is NaN where `optional`, else refused."""
        column = self.raw(key)
        values = column.astype(np.float64) if column.dtype.kind in "iuf" else self._parse(key, column)
        bad = (np.abs(values) > LARGEST) if optional else ~(np.abs(values) <= LARGEST)
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            given = column[row]
            why = f"beyond {LARGEST:g}" if np.isfinite(values[row]) else "not a finite number"
            what = "the cell is empty" if is_empty(given) else f"{str(given)[:_WORD]} is {why}"
            raise InvalidProblem(what, self.where(key, row), "give a number, or leave the row out")
        return values

    def labels(self, key: str) -> Array:
        """Return a column as text (m,); an empty cell is refused."""
        column = self.cells(key)
        if column.dtype.kind in "iu":
            column = np.asarray(column).astype(str).astype(object)
        if column.dtype.kind == "M":
            column = np.datetime_as_string(np.asarray(column)).astype(object)
        words = column if isinstance(column, Words) else words_of(column)
        # Each different cell is spelled once: millions of rows have few names.
        spelled = [_spelled(cell) for cell in words.cells]
        if not all(spelled) or has_controls("".join(spelled)):
            wrong = next((i for i in words.index.tolist() if not spelled[i] or has_controls(spelled[i])), None)
            if wrong is not None:
                what = f"{spelled[wrong]!r} holds control characters" if spelled[wrong] else "the cell is empty"
                row = int(np.flatnonzero(words.index == wrong)[0])
                raise InvalidProblem(what, self.where(key, row), "give a name")
        return cast("Array", words.renamed(spelled))  # NumPy takes words for an array

    def times(self, key: str, factor: float) -> Array:
        """Return a column of numbers (times `factor` seconds) or ISO 8601 dates as seconds (m,)."""
        column = self.raw(key)
        # A date has two hyphens: 2024-05-01; a negative number has one.
        if column.dtype.kind == "O" and len(column) and isinstance(column[0], str) and column[0].count("-") >= 2:
            column = self._dates(key, column)
        if column.dtype.kind == "M":
            late = np.isnat(column) | (np.abs(column.astype("datetime64[Y]").astype(np.int64)) > _YEARS)
            if late.any():
                place = self.where(key, int(np.flatnonzero(late)[0]))
                raise InvalidProblem("the date is missing, or not in these centuries", place, "write it as 2024-05-01")
            return column.astype("datetime64[ns]").astype(np.int64) * 1e-9
        return self.numbers(key) * factor

    def _dates(self, key: str, column: Array) -> Array:
        import pandas as pd

        # What is no text is no date: pandas would take a number for nanoseconds.
        other = next((row for row, cell in enumerate(column) if not isinstance(cell, str | None)), None)
        if other is not None:
            what = f"{column[other]!r} is no date, but others are"
            raise InvalidProblem(what, self.where(key, other), "use ISO 8601 everywhere, or numbers")
        try:
            # pandas knows time zones, which numpy does not; one that is not written is UTC.
            return np.asarray(pd.to_datetime(column, format="ISO8601", utc=True).tz_localize(None).to_numpy())
        except (ValueError, OverflowError, TypeError) as error:
            what = str(error).partition(",")[0].partition(". You")[0]
            raise InvalidProblem(f"a date cannot be read ({what})", self.where(key), "use ISO 8601") from None

    def _parse(self, key: str, column: Array) -> Array:
        # Dates and truth values become numbers in numpy, and mean none.
        if column.dtype.kind not in "OSU":
            raise InvalidProblem(f"it holds {column.dtype}, not numbers", self.where(key), "give numbers")
        cells = column.tolist()
        # All at once where all are numbers; else cell by cell, to name the one that is not.
        if all(isinstance(cell, str) and "_" not in cell for cell in cells):
            with suppress(ValueError):
                return column.astype(np.float64)
        return np.array([np.nan if is_empty(cell) else self._number(key, row, cell) for row, cell in enumerate(cells)])

    def _number(self, key: str, row: int, cell: Any) -> float:
        # Python reads 1_000 as a thousand, which in a table is a slip, and yes as one.
        if not isinstance(cell, bool) and "_" not in str(cell):
            with suppress(TypeError, ValueError, OverflowError):
                return float(cell)
        raise InvalidProblem(f"{cell!r} is not a number", self.where(key, row), "give a number")


# Years from 1970 that fit into nanoseconds of 64 bits; numpy goes on with others, and means an earlier century.
_YEARS = 290


def _spelled(cell: object) -> str:
    """Return a name as text, empty where the cell is."""
    if isinstance(cell, str):
        return cell.strip()
    if is_empty(cell):
        return ""
    # Names that a table has as floats: 3.0 is the station 3; of larger ones no float knows the last digit.
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < 2.0**53:
        return str(int(cell))
    return str(cell).strip()


def is_empty(cell: object) -> bool:
    """Return whether a cell holds nothing."""
    return cell is None or cell == "" or (isinstance(cell, float) and np.isnan(cell)) or str(cell).isspace()


# Tables from CSV and Parquet files, from rows in a problem file and from data frames.


def table_of(section: DataTable, folder: Path, where: str) -> Table:
    """Return the rows that a table of a problem file names or holds."""
    if (section.file is None) == (section.rows is None):
        raise InvalidProblem("the rows must be given once", where, 'write file = "..." or rows = [ ... ]')
    if section.rows is not None:
        return of_rows(section.rows, where, section.columns)
    assert section.file is not None
    place = join(where, "key 'file'")
    path = within(folder, section.file, place)
    suffix = path.suffix.lower()
    if suffix not in _FILES and not path.is_dir():
        raise InvalidProblem(f"{section.file!r} is of no known type", place, f"use {', '.join(_FILES)}")
    found = parquet(path, section.columns) if suffix in _PARQUET else csv(path, section.separator, section.columns)
    if not found.count:
        raise InvalidProblem("the table has no rows", found.source, "give at least one")
    return found


def of_rows(rows: Sequence[Mapping[str, Any]], where: str, names: Mapping[str, str]) -> Table:
    """Return the table of inline rows; a key that a row lacks is an empty cell."""
    if not rows:
        raise InvalidProblem("the table has no rows", where, "give at least one")
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
    """Return the table of a CSV file with a header, all cells as text; without a separator it is seen in the header."""
    import pyarrow as pa
    from pyarrow import csv as reader

    data = read_bytes(path, lines=True)
    top = decoded(data.partition(b"\n")[0], path.name).strip()
    # What separates is what the header has most of.
    separator = max(",;\t", key=top.count) if separator is None else separator
    header = _header(top, separator, path.name)
    try:
        read = reader.read_csv(
            pa.BufferReader(data),
            read_options=reader.ReadOptions(column_names=header, skip_rows=1, use_threads=False),
            parse_options=reader.ParseOptions(delimiter=separator),
            # All cells as text: what a number is, is decided where the column is known, and told with its row.
            convert_options=reader.ConvertOptions(
                column_types=dict.fromkeys(header, pa.string()), strings_can_be_null=True, null_values=[""]
            ),
        )
    except pa.ArrowInvalid as error:
        decoded(data, path.name)  # what is not UTF-8 is told with its line
        raise _no_csv(str(error), path.name) from None
    check_budget("cells", read.num_rows * len(header), path.name)
    columns = {name: _text_column(pa, read.column(name)) for name in header}
    count = read.num_rows
    del read, data
    # Its pool would keep the memory of the file for the rest of the program.
    pa.default_memory_pool().release_unused()
    return Table(path.name, columns, count, names)


def _header(line: str, separator: str, source: str) -> list[str]:
    """Return the names of the columns; pyarrow would go on where one is empty or stands twice."""
    check_budget("columns", line.count(separator) + 1, source)
    try:
        header = [name.strip() for name in next(lines_of([line], delimiter=separator, strict=True), [])]
    except CSVError as error:
        raise _no_csv(str(error), join(source, "header")) from None
    if not any(header):
        raise InvalidProblem("the file is empty or has no header", source, "begin it with the names of its columns")
    check_once(header, _TWICE, join(source, "header"))
    return header


def _no_csv(complaint: str, source: str) -> InvalidProblem:
    # pyarrow counts from the first line after the header that it skipped.
    what = (complaint.partition("CSV parse error: ")[2] or complaint).splitlines()[0]
    line, found, rest = what.rpartition(": Expected")
    number = line.removeprefix("Row #")
    place = join(source, f"row {int(number) - 1}" if number.isdigit() else None)
    what = f"expected{rest}" if found else what
    return InvalidProblem(f"this is no CSV table: {what}", place, "check its separators and quotes")


def parquet(path: Path, names: Mapping[str, str]) -> Table:
    """Return the table of a Parquet file; columns that are neither numbers, dates nor text are known by name only."""
    import pyarrow as pa
    from pyarrow import parquet as reader

    data = pa.BufferReader(read_bytes(path))
    try:
        about = reader.ParquetFile(data)
        schema = about.schema_arrow
        # What it declares is held against the budget before anything is unpacked: 1 KiB may stand for terabytes.
        _check_size(about.metadata, schema, path.name)
        texts = [
            entry.name for entry in schema if pa.types.is_string(entry.type) or pa.types.is_large_string(entry.type)
        ]
        fit = {entry.name: _fits(pa, entry.type) for entry in schema}
        # Text stays in the dictionary that it is stored with: a long word that all rows share is there once.
        read = reader.ParquetFile(data, read_dictionary=texts).read(columns=[name for name in fit if fit[name]])
        # A damaged page may name words that its dictionary has not.
        read.validate(full=True)
        columns = {name: _column_of(pa, read.column(name)) for name in read.column_names}
    except (pa.ArrowException, OSError, UnicodeDecodeError, OverflowError) as error:
        text = isinstance(error, UnicodeDecodeError) or "UTF8" in str(error)
        what = "a column of text is not UTF-8" if text else "the file is not Parquet"
        raise InvalidProblem(what, path.name, "write it again, or name a CSV file .csv") from None
    others = {entry.name: str(entry.type) for entry in schema if not fit[entry.name]}
    return Table(path.name, columns, read.num_rows if columns else about.metadata.num_rows, names, others=others)


def _check_size(about: Any, schema: Any, source: str) -> None:
    """Hold what a Parquet file says of itself against the budget."""
    check_budget("columns", len(schema), source)
    check_budget("rows", about.num_rows, source)
    check_budget("cells", about.num_rows * len(schema), source)
    groups = [about.row_group(i) for i in range(about.num_row_groups)]
    check_budget("bytes", sum(max(group.total_byte_size, 0) for group in groups), source)
    if sum(group.num_rows for group in groups) != about.num_rows:
        raise InvalidProblem("its parts have other numbers of rows than it says", source, "write it again")
    check_once(schema.names, _TWICE, source)


def _fits(pa: Any, kind: Any) -> bool:
    """Return whether a column of a Parquet file can be one of a table: numbers, dates or text."""
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    tests = "is_integer is_floating is_decimal is_timestamp is_date is_string is_large_string is_null"
    return any(getattr(pa.types, test)(kind) for test in tests.split())


# Cells from which it is seen whether a column repeats its words.
_SAMPLE = 2000


def _text_column(pa: Any, column: Any) -> Array | Words:
    """Return a column of text; words that it repeats are there once, which saves time and memory in what follows."""
    sample = column.slice(0, _SAMPLE)
    repeats = 2 * len(sample.unique()) <= len(sample)
    return _column_of(pa, column.dictionary_encode() if repeats else column)


def _column_of(pa: Any, column: Any) -> Array | Words:
    if not pa.types.is_dictionary(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False))
    column = column.unify_dictionaries().combine_chunks()  # each group of rows has a dictionary of its own
    words = objects([*column.dictionary.to_pylist(), None])
    index = column.indices.fill_null(len(words) - 1).to_numpy(zero_copy_only=False)
    first = first_rows(index)[0]  # a file may have words in its dictionary that no row has
    place = np.zeros(len(words), dtype=index.dtype)
    place[index[first]] = np.arange(len(first))
    return Words(words[index[first]], place[index])


def _to_column(cells: list[Any]) -> Array:
    # A column of numbers is an array of them, where floats keep all their digits; anything else stays as written.
    if all(isinstance(cell, float) or (type(cell) is int and abs(cell) < 2**53) for cell in cells):
        return np.array(cells)
    column = np.empty(len(cells), dtype=object)
    column[:] = cells
    return column


# Put rows together to epochs: by a column of labels, by exact time, or by windows of time.

# Share of a window by which a time may be short of the next one: times such as 0.3 are not multiples of 0.1 in binary.
_ROUNDING = 1e-9
# Windows beyond this number have no number of their own in a double.
_COUNTED = 2.0**53


@dataclass(frozen=True, slots=True)
class Keys:
    """What the rows of all measurements say about their epochs.

    Parameters
    ----------
    label : object array (m,), optional
        Epoch column.
    time : array (m,), optional
        Time column, seconds.
    written : object array (m,), optional
        The time column as it was written.
    target : object array (m,), optional
        Target column.
    """

    label: Array | None
    time: Array | None
    written: Array | None
    target: Array | None


@dataclass(frozen=True, slots=True)
class Epochs:
    """The epochs of a problem.

    Parameters
    ----------
    index : int array (m,)
        Epoch of each row.
    target : int array (m,)
        Target of each row.
    labels : tuple of k str
        What the file calls them.
    times : array (k,)
        Seconds as the file gives them; NaN where it gives none.
    targets : tuple of str
        Names of the targets, or of the target of each epoch where `own`.
    own : bool
        Whether every epoch belongs to one target: free targets share nothing.
    """

    index: Array
    target: Array
    labels: tuple[str, ...]
    times: Array
    targets: tuple[str, ...]
    own: bool = False

    @property
    def count(self) -> int:
        """Return the number of epochs k."""
        return len(self.labels)

    @property
    def clock(self) -> Array:
        """Return strictly increasing seconds (k,): the times, or the numbers of the epochs where they are not."""
        dated = bool(np.isfinite(self.times).all() and (np.diff(self.times) > 0.0).all())
        return self.times if dated else np.arange(float(self.count))


def epochs_of(keys: Keys, count: int, window: float | None, free: bool | None, source: str = "") -> Epochs:
    """Return the epochs of rows.

    Parameters
    ----------
    keys : Keys
        Columns of all rows.
    count : int
        Number of rows m.
    window : float, optional
        Seconds that make one epoch; None: rows of exactly equal time.
    free : bool, optional
        Whether targets are free at each epoch; None: where there are several epochs.
    source : str
        Place to name.

    Raises
    ------
    InvalidProblem
        Where the times of an epoch have a whole other epoch between them, or windows are too short to be counted.
    """
    if window is not None and keys.time is not None and np.ptp(keys.time) > _COUNTED * window:
        what = f"windows of {window:g} s are too short to be counted over {np.ptp(keys.time):g} s"
        raise InvalidProblem(what, join(source, "[epochs]", "key 'window'"), "give a longer one")
    index, labels, times = _group(keys, count, window)
    _check_instants(keys, labels, index, source)
    if keys.target is None:
        return Epochs(index, np.broadcast_to(0, (count,)), labels, times, ("target",))
    names, _, target = distinct(keys.target)
    # Rows of a moving target or of one epoch stay together: its targets share the epoch.
    if len(names) == 1 or not (len(labels) > 1 if free is None else free):
        return Epochs(index, target, labels, times, tuple(names))
    # Targets that are free share nothing between epochs or with each other: each pair is an epoch of its own.
    pairs, index = np.unique(index * len(names) + target, return_inverse=True)
    epoch, owner = pairs // len(names), pairs % len(names)
    owners = tuple(names[i] for i in owner.tolist())
    chosen = tuple(np.array(labels, dtype=object)[epoch].tolist())
    return Epochs(index, np.zeros(count, dtype=np.int64), chosen, times[epoch], owners, own=True)


def _group(keys: Keys, count: int, window: float | None) -> tuple[Array, tuple[str, ...], Array]:
    """Return index (m,), labels and times (k,), in the order of time, else of number, else of appearance."""
    if keys.label is None and keys.time is None:
        return np.zeros(count, dtype=np.int64), ("0",), np.full(1, np.nan)
    if keys.label is not None:
        values, first, index = distinct(keys.label)
        # Labels that are numbers go by size (2 before 10), others as they appear; times, where given, outweigh both.
        rank = _numbers(values)
        order = np.argsort(first if rank is None else rank, kind="stable")
        labels = np.array(values, dtype=object)
    else:
        assert keys.time is not None
        assert keys.written is not None
        bins = keys.time if window is None else np.floor((keys.time - keys.time.min()) / window + _ROUNDING)
        _, first, index = np.unique(bins, return_index=True, return_inverse=True)
        order, labels = np.arange(len(first)), np.asarray(keys.written[first])
    times = np.full(len(first), np.nan)
    if keys.time is not None:
        # Differences from the first row: equal times stay exactly themselves.
        base = keys.time[first]
        times = base + np.bincount(index, keys.time - base[index]) / np.bincount(index)
        order = order[np.argsort(times[order], kind="stable")]
    # The inverse of a permutation: the place of each group in the order.
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return place[index], tuple(labels[order].tolist()), times[order]


def _check_instants(keys: Keys, labels: Sequence[str], index: Array, source: str) -> None:
    """Refuse a label whose rows have times with a whole other epoch between them."""
    if keys.label is None or keys.time is None or len(labels) < 2:
        return
    first, last = np.full(len(labels), np.inf), np.full(len(labels), -np.inf)
    np.minimum.at(first, index, keys.time)
    np.maximum.at(last, index, keys.time)
    # Neighbours in the order of their first times are enough: a label that holds any other epoch holds the next.
    order = np.argsort(first, kind="stable")
    outer, inner = order[:-1], order[1:]
    held = np.flatnonzero((first[outer] < first[inner]) & (last[inner] < last[outer]))
    if len(held):
        one, two = outer[held[0]], inner[held[0]]
        what = f"epoch {labels[one]!r} has the times {first[one]:.10g} s and {last[one]:.10g} s"
        advice = "give every instant a label of its own"
        raise InvalidProblem(f"{what}, and epoch {labels[two]!r} lies between them", source, advice)


def _numbers(values: Sequence[str]) -> Array | None:
    try:
        return np.array([float(value) for value in values])
    except ValueError:
        return None


def need_clock(epochs: Epochs, why: str, source: str) -> Array:
    """Return strictly increasing times; raise InvalidProblem where the file gives none."""
    if epochs.count > 1 and not np.isfinite(epochs.times).all():
        raise InvalidProblem(f"{why} needs the time of each epoch", source, "give the measurements a column 'time'")
    twice = np.flatnonzero(np.diff(epochs.times) <= 0.0)
    if len(twice):
        one, two = epochs.labels[twice[0]], epochs.labels[twice[0] + 1]
        raise InvalidProblem(
            f"the epochs {one!r} and {two!r} have the same time, but {why} tells epochs apart by their times",
            source,
            "correct the times, or give both one label",
        )
    return epochs.clock
