"""Columns of text as distinct words and word numbers of the rows, since long tables repeat few words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base.arrays import first_rows
from optloc.base.types import Array


@dataclass(frozen=True, slots=True, eq=False)
class Words:
    """A column (m,) of text; NumPy converts it to an array of objects.

    Parameters
    ----------
    cells : object array (n,)
        The distinct cells, in the order of their appearance.
    index : int array (m,)
        Number of the cell of each row.
    """

    cells: Array
    index: Array

    @property
    def dtype(self) -> Any:
        """Return the type of its cells."""
        return self.cells.dtype

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.asarray(self.cells[self.index], dtype=dtype)

    def __len__(self) -> int:
        return len(self.index)

    def __iter__(self) -> Iterator[Any]:
        cells = self.cells
        return (cells[i] for i in self.index)

    def __getitem__(self, pick: Any) -> Any:
        """Return one cell, or the selected rows as words."""
        index = self.index[pick]
        return self.cells[index] if np.ndim(index) == 0 else Words(self.cells, index)

    def __eq__(self, other: object) -> Any:
        return np.asarray(self) == np.asarray(other)

    __hash__ = None  # type: ignore[assignment]  # like arrays, which are compared entry by entry

    def __arrow_array__(self, type: Any = None) -> Any:  # noqa: A002  (its name in the protocol)
        """Return the column as an array of pyarrow, by the protocol of that library."""
        import pyarrow as pa

        return pa.array(np.asarray(self), type)

    def renamed(self, cells: Sequence[Any]) -> Words:
        """Return the column with new cells (n,) instead of its distinct cells; equal new cells are joined."""
        names, number = numbered(objects(cells))
        return Words(objects(names), number[self.index])

    def tolist(self) -> list[Any]:
        """Return the cells of all rows."""
        return list(self.cells[self.index])


# Most cells that Python numbers itself: it takes 20 ms, where the import of pyarrow and pandas takes 700 ms.
_FEW = 100_000


def numbered(column: Array | Words) -> tuple[list[Any], Array]:
    """Return the distinct cells of a column in the order of their appearance, and the cell number of each row (m,)."""
    if isinstance(column, Words):
        first, index = first_rows(column.index)
        return column.cells[column.index[first]].tolist(), index
    if column.dtype == object and len(column) <= _FEW and all(type(cell) is str for cell in column):
        return _numbered_cells(column)
    import pyarrow as pa

    try:
        words = pa.array(column, pa.string()).dictionary_encode(null_encoding="encode")
        return words.dictionary.to_pylist(), words.indices.to_numpy()
    except (pa.ArrowException, UnicodeEncodeError, TypeError):
        return _numbered_cells(column)


def _numbered_cells(column: Array) -> tuple[list[Any], Array]:
    """Return the result of `numbered` for cells of any type."""
    # Create the list once: two NaN cells are equal only if they are the same object.
    cells = column.tolist()
    number = {cell: i for i, cell in enumerate(dict.fromkeys(cells))}
    return list(number), np.array(list(map(number.__getitem__, cells)), dtype=np.int64)


def words_of(column: Array) -> Words:
    """Return a column of text as words."""
    cells, index = numbered(column)
    return Words(objects(cells), index)


def objects(cells: Sequence[Any]) -> Array:
    """Return cells as an array of objects."""
    out = np.empty(len(cells), dtype=object)
    out[:] = cells
    return out


def equal_rows(columns: Sequence[Array | Words], count: int) -> tuple[Array, Array]:
    """Return the first row (n,) of each group of equal rows, and the group of each row (m,).

    Rows are equal if their cells are equal in all columns (m,). `count` is the number of rows m; without columns, all
    rows are equal.
    """
    if not columns:
        return np.zeros(min(count, 1), dtype=np.int64), np.zeros(count, dtype=np.int64)
    return first_rows(*(c.index if isinstance(c, Words) else _numbers(c) for c in columns))


def _numbers(column: Array) -> Array:
    """Return the number (m,) of the distinct cell of each row."""
    return np.unique(column, return_inverse=True)[1] if column.dtype.kind == "f" else numbered(column)[1]


def distinct(labels: Array | Words) -> tuple[list[str], Array, Array]:
    """Return distinct labels as `np.unique` does: the sorted names, the first row (n,) and the number (m,) of each.

    A fixed-width array would need the length of the longest name for each row, so labels are objects or Words.
    """
    names, number = numbered(labels)
    order = sorted(range(len(names)), key=names.__getitem__)
    place = np.empty(len(names), dtype=np.int64)
    place[order] = np.arange(len(names))
    index = place[number]
    first = np.full(len(names), len(labels))
    np.minimum.at(first, index, np.arange(len(labels)))
    return [names[i] for i in order], first, index
