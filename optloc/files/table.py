"""A table as it was read: columns of text or numbers, what to call its rows in a complaint, its rows by epoch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Array
from optloc.files.schema import DataTable, find_file, join, read_text

_PARQUET = (".parquet", ".pq")
_FILES = (".csv", ".txt", ".tsv", *_PARQUET)


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of equal length.

    Parameters
    ----------
    source : str
        File, or place in a file, to name.
    columns : mapping of str to array (m,)
        Numbers, datetimes, or objects (text, None where a cell is empty).
    count : int
        Number of rows m.
    names : mapping of str to str
        What the columns that are asked for are called here.
    first : int array (m,), optional
        Row of the source that each row was, where it is a part of a table.
    """

    source: str
    columns: Mapping[str, Array]
    count: int
    names: Mapping[str, str] = field(default_factory=dict)
    first: Array | None = None

    def take(self, pick: Array) -> Table:
        """Return some of the rows."""
        columns = {name: column[pick] for name, column in self.columns.items()}
        return Table(self.source, columns, len(pick), self.names, pick)

    def name(self, key: str) -> str:
        """Return what a column is called in this table."""
        return self.names.get(key, key)

    def has(self, key: str) -> bool:
        """Return whether there is such a column."""
        return self.name(key) in self.columns

    def where(self, key: str, row: int | None = None) -> str:
        """Return the place of a cell (0-based row) or of a column."""
        return join(self.source if row is None else self.at(row), f"column {self.name(key)!r}")

    def at(self, row: int) -> str:
        """Return the place of a row (0-based)."""
        return f"{self.source}, row {(row if self.first is None else int(self.first[row])) + 1}"

    def raw(self, key: str) -> Array:
        """Return a column as it was read; raise InvalidProblem where there is none."""
        name = self.name(key)
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
        bad = np.isinf(values) if optional else ~np.isfinite(values)
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            given = column[row]
            what = "the cell is empty" if _empty(given) else f"{given} is not a finite number"
            raise InvalidProblem(what, self.where(key, row), "give a number, or leave the row out")
        return values

    def labels(self, key: str) -> Array:
        """Return a column as text (m,); an empty cell is refused."""
        column = self.raw(key)
        if column.dtype.kind in "iu":
            return column.astype(str).astype(object)
        if column.dtype.kind == "f":
            # Labels that a table has as floats: 3.0 is the station 3; 15 digits keep every whole number that a float
            # can.
            column = np.array([None if np.isnan(v) else f"{v:.15g}" for v in column], dtype=object)
        elif column.dtype.kind == "M":
            column = np.datetime_as_string(column).astype(object)
        # Each different cell is spelled once: millions of rows have few names.
        spelled = {cell: "" if _empty(cell) else str(cell).strip() for cell in set(column.tolist())}
        out = np.array(list(map(spelled.__getitem__, column.tolist())), dtype=object)
        if "" in spelled.values():
            raise InvalidProblem("the cell is empty", self.where(key, int(np.flatnonzero(out == "")[0])), "give a name")
        return out

    def times(self, key: str, factor: float) -> Array:
        """Return a column of numbers (times `factor` seconds) or ISO 8601 dates as seconds (m,)."""
        column = self.raw(key)
        # A date has two hyphens: 2024-05-01; a negative number has one.
        if column.dtype.kind == "O" and len(column) and isinstance(column[0], str) and column[0].count("-") >= 2:
            try:
                column = column.astype("datetime64[ns]")
            except ValueError as error:
                raise InvalidProblem(f"a date cannot be read ({error})", self.where(key), "use ISO 8601") from None
        if column.dtype.kind == "M":
            return column.astype("datetime64[ns]").astype(np.int64) * 1e-9
        return self.numbers(key) * factor

    def _parse(self, key: str, column: Array) -> Array:
        # All at once where all are numbers; else cell by cell, to name the one that is not.
        try:
            return column.astype(np.float64)
        except (TypeError, ValueError):
            pass
        values = np.full(len(column), np.nan)
        for row, cell in enumerate(column):
            if _empty(cell):
                continue
            try:
                values[row] = float(cell)
            except (TypeError, ValueError):
                raise InvalidProblem(f"{cell!r} is not a number", self.where(key, row), "give a number") from None
        return values


def _empty(cell: object) -> bool:
    return cell is None or cell == "" or (isinstance(cell, float) and np.isnan(cell)) or str(cell).isspace()


# Tables from CSV and Parquet files, from rows in a problem file and from data frames.


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
        parquet(find_file(path), section.columns)
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
    return Table(where, {key: _to_column([row.get(key) for row in rows]) for key in keys}, len(rows), names)


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
    # The header is read by hand: its names may stand twice or be empty, and pyarrow would go on.
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
            # All cells as text: what a number is, is decided where the column is known, and told with its row.
            convert_options=reader.ConvertOptions(
                column_types=dict.fromkeys(header, pa.string()), strings_can_be_null=True, null_values=[""]
            ),
        )
    except pa.ArrowInvalid as error:
        # pyarrow counts from the first line after the header that it skipped.
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


def _to_column(cells: list[Any]) -> Array:
    # A column of numbers is an array of them; anything else stays as it was written.
    if all(isinstance(cell, int | float) and not isinstance(cell, bool) for cell in cells):
        return np.array(cells)
    column = np.empty(len(cells), dtype=object)
    column[:] = cells
    return column


# Put rows together to epochs: by a column of labels, by exact time, or by windows of time.

# Share of a window by which a time may be short of the next one: times such as 0.3 are not multiples of 0.1 in binary.
_ROUNDING = 1e-9


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
        Where the times of an epoch have a whole other epoch between them.
    """
    index, labels, times = _group(keys, count, window)
    _check_instants(keys, labels, index, source)
    if keys.target is None:
        return Epochs(index, np.zeros(count, dtype=np.int64), labels, times, ("target",))
    names, target = np.unique(keys.target.astype(str), return_inverse=True)
    # Rows of a moving target or of one epoch stay together: its targets share the epoch.
    if len(names) == 1 or not (len(labels) > 1 if free is None else free):
        return Epochs(index, target, labels, times, tuple(names.tolist()))
    # Targets that are free share nothing between epochs or with each other: each pair is an epoch of its own.
    pairs, index = np.unique(index * len(names) + target, return_inverse=True)
    epoch, owner = pairs // len(names), pairs % len(names)
    owners = tuple(names[owner].tolist())
    chosen = tuple(np.array(labels, dtype=object)[epoch].tolist())
    return Epochs(index, np.zeros(count, dtype=np.int64), chosen, times[epoch], owners, own=True)


def _group(keys: Keys, count: int, window: float | None) -> tuple[Array, tuple[str, ...], Array]:
    """Return index (m,), labels and times (k,), in the order of time, else of number, else of appearance."""
    if keys.label is None and keys.time is None:
        return np.zeros(count, dtype=np.int64), ("0",), np.full(1, np.nan)
    if keys.label is not None:
        values, first, index = np.unique(keys.label.astype(str), return_index=True, return_inverse=True)
        # Labels that are numbers go by size (2 before 10), others as they appear; times, where given, outweigh both.
        rank = _numbers(values)
        order = np.argsort(first if rank is None else rank, kind="stable")
        labels = values.astype(object)
    else:
        assert keys.time is not None
        assert keys.written is not None
        bins = keys.time if window is None else np.floor((keys.time - keys.time.min()) / window + _ROUNDING)
        _, first, index = np.unique(bins, return_index=True, return_inverse=True)
        order, labels = np.arange(len(first)), keys.written[first].astype(str).astype(object)
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


def _numbers(values: Array) -> Array | None:
    try:
        return values.astype(np.float64)
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
