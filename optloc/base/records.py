"""Records: frozen dataclasses of arrays with common batch axes, and functions to slice, merge and join them.

The annotation of each array field states its layout: the number of axes after the batch axes and the value of an empty
entry. It also states whether the first of these axes counts slots, whose number can differ between records. For
example, alternatives of a fix are slots. The functions of this module use these annotations, so a new field of a `Fix`
or a `Pool` is declared in one place.

A batch has N entries. A flat batch has one batch axis (N, ...).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np

from optloc.base.types import Array

Record = TypeVar("Record")


@dataclass(frozen=True, slots=True)
class Axes:
    """Layout of an array field of a record: ``x: Annotated[Array, Axes(1)]``.

    Parameters
    ----------
    core : int
        Number of axes after the batch axes.
    slots : bool
        Whether the first of these axes counts slots.
    empty : object
        Value of an empty entry.
    """

    core: int
    slots: bool = False
    empty: Any = np.nan


def change(record: Record, function: Callable[[Array, int], Array]) -> Record:
    """Return the record with ``function(array, number of axes after the batch axes)`` applied to every array."""
    changed = {name: function(value, layout.core) for name, value, layout in _arrays(record) if value is not None}
    changed |= {name: change(value, function) for name, value in _parts(record)}
    return replace(record, **changed)  # type: ignore[type-var]


def take(record: Record, items: Any) -> Record:
    """Return the entries of a flat batch at `items`: an index, a slice or a mask."""
    return change(record, lambda array, core: array[items])


def overwrite(record: Record, items: Array, other: Record) -> Record:
    """Return a flat batch in which the entries at `items` are replaced. Fields without arrays do not change.

    Parameters
    ----------
    record : record
        A batch of N entries.
    items : int array (q,)
        Numbers of the entries to replace.
    other : record
        The q new entries.
    """
    changed: dict[str, Any] = {}
    for (name, old_value, layout), (_, new_value, _) in zip(_arrays(record), _arrays(other), strict=True):
        if old_value is None and new_value is None:
            continue
        old, new = _filled(record, old_value, new_value, layout), _filled(other, new_value, old_value, layout)
        # Both arrays get the larger number of slots.
        width = max(old.shape[1], new.shape[1]) if layout.slots else 0
        changed[name] = np.array(_widen(old, layout, width))
        changed[name][items] = _widen(new, layout, width)
    parts, others = dict(_parts(record)), dict(_parts(other))
    for name in parts | others:
        part = parts[name] if name in parts else _blank(others[name], _count(record))
        changed[name] = overwrite(part, items, others[name] if name in others else _blank(part, _count(other)))
    return replace(record, **changed)  # type: ignore[type-var]


def join(parts: Iterable[Record], count: int) -> Record:
    """Return flat batches as one batch, in their order. Fields without arrays come from the first part.

    Each part is copied when it arrives and can then be freed, so extra memory does not grow with the batch. An array
    that all entries of all parts share stays one row. If a part lacks a field, its entries are empty.

    Parameters
    ----------
    parts : iterable of records
        At least one part.
    count : int
        Total number of entries.
    """
    columns: dict[str, _Column] = {}
    pieces: dict[str, list[tuple[int, Any]]] = {}
    first, start = None, 0
    for part in parts:
        first, size = part if first is None else first, _count(part)
        for name, value, layout in _arrays(part):
            columns.setdefault(name, _Column(layout, count)).put(slice(start, start + size), value)
        for name, piece in _parts(part):
            pieces.setdefault(name, []).append((start, piece))
        start += size
    assert first is not None
    changed: dict[str, Any] = {name: column.array() for name, column in columns.items()}
    changed |= {name: join(_fill_gaps(records_of_field, count), count) for name, records_of_field in pieces.items()}
    return replace(first, **changed)  # type: ignore[type-var]


def _fill_gaps(pieces: list[tuple[int, Any]], count: int) -> Iterator[Any]:
    """Yield the records in order, with records of empty entries between them, up to `count` entries in total.

    Each of the `pieces` has the number of its first entry and the record.
    """
    end = 0
    for start, piece in [*pieces, (count, None)]:
        if start > end:
            yield _blank(pieces[0][1], start - end)
        if piece is not None:
            yield piece
            end = start + _count(piece)


def _blank(record: Record, count: int) -> Record:
    """Return a record with `count` empty entries and the same fields as `record`."""
    changed: dict[str, Any] = {
        name: _empty((count, *value.shape[1:]), layout, value.dtype)
        for name, value, layout in _arrays(record)
        if value is not None
    }
    changed |= {name: _blank(value, count) for name, value in _parts(record)}
    return replace(record, **changed)  # type: ignore[type-var]


class _Column:
    """One array field of all entries, filled part by part.

    `parts` are arrays that wait for allocation, with their places. `whole` is the array of all entries, and `lacking`
    are the places of parts without this field.
    """

    def __init__(self, layout: Axes, count: int) -> None:
        """Make an empty column for `count` entries."""
        self.layout, self.count = layout, count
        self.parts: list[tuple[slice, Array]] = []  # parts that cannot be copied yet: slots, or one row for all entries
        self.whole: Array | None = None
        self.lacking: list[slice] = []

    def put(self, place: slice, value: Array | None) -> None:
        """Store the values of the entries at `place`; None if the part lacks this field: its entries are empty."""
        if value is None:
            self.lacking.append(place)
            return
        if self.whole is None and (self.layout.slots or self._shares(value)):
            self.parts.append((place, value))
            return
        self._allocate(value, value.shape[1:])
        assert self.whole is not None
        self.whole[place] = value

    def array(self) -> Array | None:
        """Return the array of all entries; None if all parts lack the field.

        If all entries share one row, the result is a view that repeats this row.
        """
        if self.whole is None and self.parts:
            value = self.parts[0][1]
            if self._is_shared():
                return np.broadcast_to(value[:1], (self.count, *value.shape[1:]))
            width = max(value_of_part.shape[1] for _, value_of_part in self.parts) if self.layout.slots else 0
            self._allocate(value, (width, *value.shape[2:]) if self.layout.slots else value.shape[1:])
        whole = self.whole
        if whole is not None:
            for place in self.lacking:
                whole[place].fill(self.layout.empty)
        return whole

    def _shares(self, value: Array) -> bool:
        """Return whether a part is one row for all its entries, equal to the row of the earlier parts."""
        return value.strides[0] == 0 and all(_is_equal(earlier[:1], value[:1]) for _, earlier in self.parts[:1])

    def _is_shared(self) -> bool:
        """Return whether all entries of all parts share one row."""
        values = [value for _, value in self.parts]
        if sum(map(len, values)) < self.count or len({value.shape[1:] for value in values}) > 1:
            return False
        return not self.layout.slots or all(map(self._shares, values))

    def _allocate(self, like: Array, shape: tuple[int, ...]) -> None:
        """Allocate the array of all entries with rows of this shape, and copy the waiting parts into it.

        `like` gives the data type. Later calls do nothing.
        """
        if self.whole is None:
            whole = (self.count, *shape)
            self.whole = _empty(whole, self.layout, like.dtype) if self.layout.slots else np.empty(whole, like.dtype)
            for place, value in self.parts:
                self.whole[place] = _widen(value, self.layout, shape[0] if self.layout.slots else 0)
            self.parts = []


def _is_equal(a: Array, b: Array) -> bool:
    """Return whether two arrays have the same content; NaN counts as equal if both arrays use the same memory."""
    # NaN differs from itself, but arrays in the same memory are equal.
    same = a.ctypes.data == b.ctypes.data and (a.shape, a.strides, a.dtype) == (b.shape, b.strides, b.dtype)
    return same or np.array_equal(a, b)


@cache
def _layouts(kind: Any) -> dict[str, Axes]:
    """Return the layout of every array field of a record type, from its annotations."""
    hints = get_type_hints(kind, include_extras=True)
    return {
        name: note
        for name, hint in hints.items()
        for part in (hint, *get_args(hint))  # an optional array is a union with an annotated part
        for note in getattr(part, "__metadata__", ())
        if isinstance(note, Axes)
    }


def _arrays(record: Any) -> Iterator[tuple[str, Array | None, Axes]]:
    """Yield the name, the array (or None) and the layout of every array field of a record."""
    kind: Any = type(record)
    for name, layout in _layouts(kind).items():
        yield name, getattr(record, name), layout


def _parts(record: Any) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of fields that are records."""
    kind: Any = type(record)
    for name in _others(kind):
        value = getattr(record, name)
        kind_of_value: Any = type(value)
        if _is_record(kind_of_value):
            yield name, value


@cache
def _others(kind: Any) -> tuple[str, ...]:
    """Return the names of the fields of a record type that are not arrays."""
    return tuple(each.name for each in fields(kind) if each.name not in _layouts(kind))


@cache
def _is_record(kind: Any) -> bool:
    """Return whether a type is a dataclass with array fields."""
    record_type: Any = kind
    return is_dataclass(kind) and bool(_layouts(record_type))


def _count(record: Any) -> int:
    """Return the number of entries of a flat batch."""
    return next(len(value) for _, value, _ in _arrays(record) if value is not None)


def _filled(record: Any, array: Array | None, like: Array | None, layout: Axes) -> Array:
    """Return an array of a record or, if it is None, empty entries with the shape and type of `like`."""
    if array is not None:
        return array
    assert like is not None
    return _empty((_count(record), *like.shape[1:]), layout, like.dtype)


def _widen(array: Array, layout: Axes, width: int) -> Array:
    """Return an array with at least `width` slots; the new slots are empty."""
    if not layout.slots or array.shape[1] >= width:
        return array
    more = _empty((len(array), width - array.shape[1], *array.shape[2:]), layout, array.dtype)
    return np.concatenate([array, more], axis=1)


def _empty(shape: tuple[int, ...], layout: Axes, dtype: Any) -> Array:
    """Return a new array in which every entry has the empty value of the layout."""
    out = np.empty(shape, dtype=dtype)
    out.fill(layout.empty)
    return out


def present(entries: Array) -> Array:
    """Return a mask (N,) of the entries of an object array that are not None."""
    # By identity, because `entries != None` would call the comparison of every record.
    return np.array([entry is not None for entry in entries], dtype=bool)
