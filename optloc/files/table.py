"""A table as it was read: columns of text or numbers, and what to call its rows in a complaint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from optloc.errors import InvalidProblem
from optloc.files.words import join, nearest
from optloc.types import Array


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
            renamed = set(self.names.values())
            advice = nearest(name, sorted(set(self.columns) - renamed) or sorted(self.columns))
            hint = "" if key in self.names else f', or name it by columns = {{ {key} = "..." }}'
            raise InvalidProblem(what, self.source, advice + hint)
        return self.columns[name]

    def numbers(self, key: str, optional: bool = False) -> Array:
        """Return a column as finite numbers (m,); an empty cell is NaN where `optional`, else refused."""
        column = self.raw(key)
        values = column.astype(np.float64) if column.dtype.kind in "iuf" else self._parsed(key, column)
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
            column = np.array([None if np.isnan(v) else f"{v:.15g}" for v in column], dtype=object)
        elif column.dtype.kind == "M":
            column = np.datetime_as_string(column).astype(object)
        spelled = {cell: "" if _empty(cell) else str(cell).strip() for cell in set(column.tolist())}
        out = np.array(list(map(spelled.__getitem__, column.tolist())), dtype=object)
        if "" in spelled.values():
            raise InvalidProblem("the cell is empty", self.where(key, int(np.flatnonzero(out == "")[0])), "give a name")
        return out

    def times(self, key: str, factor: float) -> Array:
        """Return a column of numbers (times `factor` seconds) or ISO 8601 dates as seconds (m,)."""
        column = self.raw(key)
        if column.dtype.kind == "O" and len(column) and isinstance(column[0], str) and column[0].count("-") >= 2:
            try:
                column = column.astype("datetime64[ns]")
            except ValueError as error:
                raise InvalidProblem(f"a date cannot be read ({error})", self.where(key), "use ISO 8601") from None
        if column.dtype.kind == "M":
            return column.astype("datetime64[ns]").astype(np.int64) * 1e-9
        return self.numbers(key) * factor

    def _parsed(self, key: str, column: Array) -> Array:
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
