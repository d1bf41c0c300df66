"""Records: frozen dataclasses of arrays that share batch axes, and what is done to all of these at once.

Each field of arrays says once how it is laid out: how many axes follow the batch axes, whether the first of these are
slots whose number differs from record to record, and what an empty entry holds. Slicing, merging and joining follow
from that, so that a new field of a `Fix` or a `Pool` is typed in one place.
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
    """How an array of a record is laid out: ``x: Annotated[Array, Axes(1)]``.

    Parameters
    ----------
    core : int
        Axes behind the batch axes.
    slots : bool
        Whether the first of them counts slots.
    empty : object
        What stands in an entry that nobody has filled.
    """

    core: int
    slots: bool = False
    empty: Any = np.nan


def change(record: Record, function: Callable[[Array, int], Array]) -> Record:
    """Return a record whose every array is mapped by ``(array, axes behind the batch axes) -> array``."""
    changed = {name: function(value, layout.core) for name, value, layout in _arrays(record) if value is not None}
    changed |= {name: change(value, function) for name, value in _parts(record)}
    return replace(record, **changed)  # type: ignore[type-var]


def take(record: Record, items: Any) -> Record:
    """Return some entries of a flat batch, by an index or a slice."""
    return change(record, lambda array, core: array[items])


def overwrite(record: Record, items: Array, other: Record) -> Record:
    """Return a flat batch in which other records take the place of some; what the batch has beside arrays stays.

    Parameters
    ----------
    record : record
        N entries.
    items : int array (q,)
        Which are replaced.
    other : record
        The q entries that take their place.
    """
    changed: dict[str, Any] = {}
    for (name, mine, layout), (_, theirs, _) in zip(_arrays(record), _arrays(other), strict=True):
        if mine is None and theirs is None:
            continue
        old, new = _filled(record, mine, theirs, layout), _filled(other, theirs, mine, layout)
        width = max(old.shape[1], new.shape[1]) if layout.slots else 0
        changed[name] = np.array(_widen(old, layout, width))
        changed[name][items] = _widen(new, layout, width)
    parts, others = dict(_parts(record)), dict(_parts(other))
    for name in parts | others:
        part = parts[name] if name in parts else _blank(others[name], _count(record))
        changed[name] = overwrite(part, items, others[name] if name in others else _blank(part, _count(other)))
    return replace(record, **changed)  # type: ignore[type-var]


def join(parts: Iterable[Record], count: int) -> Record:
    """Return records of flat batches one behind the other as one; what they have beside arrays is the first's.

    Each part is copied into place as it comes and may be forgotten: memory beyond the answers does not grow with the
    batch. An array that all entries of all parts share stays one row; entries of a part that lacks one are empty.

    Parameters
    ----------
    parts : iterable of records
        At least one.
    count : int
        Entries of all of them.
    """
    whole: dict[str, _Column] = {}
    pieces: dict[str, list[tuple[int, Any]]] = {}
    first, start = None, 0
    for part in parts:
        first, size = part if first is None else first, _count(part)
        for name, value, layout in _arrays(part):
            whole.setdefault(name, _Column(layout, count)).put(slice(start, start + size), value)
        for name, piece in _parts(part):
            pieces.setdefault(name, []).append((start, piece))
        start += size
    assert first is not None
    changed: dict[str, Any] = {name: column.array() for name, column in whole.items()}
    changed |= {name: join(_without_gaps(own, count), count) for name, own in pieces.items()}
    return replace(first, **changed)  # type: ignore[type-var]


def _without_gaps(pieces: list[tuple[int, Any]], count: int) -> Iterator[Any]:
    """Yield records with where each begins, and empty ones for the entries between them, of so many."""
    end = 0
    for start, piece in [*pieces, (count, None)]:
        if start > end:
            yield _blank(pieces[0][1], start - end)
        if piece is not None:
            yield piece
            end = start + _count(piece)


def _blank(record: Record, count: int) -> Record:
    """Return so many entries that nobody has filled, of records like another."""
    changed: dict[str, Any] = {
        name: _empty((count, *value.shape[1:]), layout, value.dtype)
        for name, value, layout in _arrays(record)
        if value is not None
    }
    changed |= {name: _blank(value, count) for name, value in _parts(record)}
    return replace(record, **changed)  # type: ignore[type-var]


class _Column:
    """One array of all entries, filled part by part."""

    def __init__(self, layout: Axes, count: int) -> None:
        self.layout, self.count = layout, count
        self.parts: list[tuple[slice, Array]] = []  # slots differ in number, and shared rows wait for another
        self.whole: Array | None = None
        self.lacking: list[slice] = []

    def put(self, place: slice, value: Array | None) -> None:
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
        if self.whole is None and self.parts:
            value = self.parts[0][1]
            if self._is_shared():
                return np.broadcast_to(value[:1], (self.count, *value.shape[1:]))
            width = max(own.shape[1] for _, own in self.parts) if self.layout.slots else 0
            self._allocate(value, (width, *value.shape[2:]) if self.layout.slots else value.shape[1:])
        whole = self.whole
        if whole is not None:
            for place in self.lacking:
                whole[place].fill(self.layout.empty)
        return whole

    def _shares(self, value: Array) -> bool:
        """Return whether a part is one row for all, the same as of the parts before."""
        return value.strides[0] == 0 and all(_is_equal(own[:1], value[:1]) for _, own in self.parts[:1])

    def _is_shared(self) -> bool:
        """Return whether all parts are one row for all entries."""
        own = [value for _, value in self.parts]
        if sum(map(len, own)) < self.count or len({value.shape[1:] for value in own}) > 1:
            return False
        return not self.layout.slots or all(map(self._shares, own))

    def _allocate(self, like: Array, shape: tuple[int, ...]) -> None:
        if self.whole is None:
            whole = (self.count, *shape)
            self.whole = _empty(whole, self.layout, like.dtype) if self.layout.slots else np.empty(whole, like.dtype)
            for place, value in self.parts:
                self.whole[place] = _widen(value, self.layout, shape[0] if self.layout.slots else 0)
            self.parts = []


def _is_equal(a: Array, b: Array) -> bool:
    # NaN is not equal to itself, but what lies at the same place is
    same = a.ctypes.data == b.ctypes.data and (a.shape, a.strides, a.dtype) == (b.shape, b.strides, b.dtype)
    return same or np.array_equal(a, b)


@cache
def _layouts(kind: Any) -> dict[str, Axes]:
    """Return the layout of every field of arrays of a record, by its annotation."""
    hints = get_type_hints(kind, include_extras=True)
    return {
        name: note
        for name, hint in hints.items()
        for part in (hint, *get_args(hint))  # an optional array is a union with an annotated part
        for note in getattr(part, "__metadata__", ())
        if isinstance(note, Axes)
    }


def _arrays(record: Any) -> Iterator[tuple[str, Array | None, Axes]]:
    kind: Any = type(record)
    for name, layout in _layouts(kind).items():
        yield name, getattr(record, name), layout


def _parts(record: Any) -> Iterator[tuple[str, Any]]:
    """Yield the fields that are records themselves."""
    kind: Any = type(record)
    for name in _others(kind):
        value = getattr(record, name)
        own: Any = type(value)
        if _is_record(own):
            yield name, value


@cache
def _others(kind: Any) -> tuple[str, ...]:
    """Return the fields of a record that hold no arrays."""
    return tuple(each.name for each in fields(kind) if each.name not in _layouts(kind))


@cache
def _is_record(kind: Any) -> bool:
    own: Any = kind
    return is_dataclass(kind) and bool(_layouts(own))


def _count(record: Any) -> int:
    return next(len(value) for _, value, _ in _arrays(record) if value is not None)


def _filled(record: Any, array: Array | None, like: Array | None, layout: Axes) -> Array:
    """Return an array of a record, or where it has none empty entries that look like another's."""
    if array is not None:
        return array
    assert like is not None
    return _empty((_count(record), *like.shape[1:]), layout, like.dtype)


def _widen(array: Array, layout: Axes, width: int) -> Array:
    """Return an array with at least so many slots; the new ones are empty."""
    if not layout.slots or array.shape[1] >= width:
        return array
    more = _empty((len(array), width - array.shape[1], *array.shape[2:]), layout, array.dtype)
    return np.concatenate([array, more], axis=1)


def _empty(shape: tuple[int, ...], layout: Axes, dtype: Any) -> Array:
    out = np.empty(shape, dtype=dtype)
    out.fill(layout.empty)
    return out


def present(entries: Array) -> Array:
    """Return which entries (N,) of an array of objects are not None."""
    # By identity: `entries != None` asks every record whether it is equal to None.
    return np.array([entry is not None for entry in entries], dtype=bool)
