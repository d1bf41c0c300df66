"""A thread-safe cache of values that problems of equal structure share, such as compiled programs and tables.

Links, tables, traces, linear maps and programs of IPOPT are in caches of this type. Their keys are
`optloc.problem.problem.Problem.structure` and other values on which they depend. Functions of a few plain numbers, such
as the moments of a loss, use `functools.lru_cache` instead. It is also locked and bounded, but two threads can compute
the same value at once, which costs microseconds.

All threads share the cached values, so code must not modify them.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from threading import Lock
from typing import Any, Generic, TypeVar, cast

import numpy as np

from optloc.base.forks import held_by_forks

Value = TypeVar("Value")

# Maximum number of entries of an array in a key: copying and hashing this number takes about 30 us.
_ENTRIES = 4096
# Immutable types. Values of the second group can be equal across types, so the key contains the type.
_ATOMS, _WHOLE = frozenset({str, bytes, float, type(None)}), frozenset({int, bool, complex})

# Marks an entry whose value is not computed yet. None is a valid value: some structures have no tables.
_NOTHING = object()


@dataclass(slots=True, eq=False)
class _CachePlace:
    """Entry of one key: the value, its weight and a lock. The thread that computes the value acquires the lock."""

    value: object = _NOTHING
    weight: int = 0
    lock: Lock = field(default_factory=Lock)


class Cache(Generic[Value]):
    """Values by key, computed at the first use. If the cache is full, it drops the least recently used values.

    A value is computed once, by the first thread that needs it. Other threads wait for it, but they can use and compute
    values of other keys meanwhile. If the computation raises, the cache stores nothing. The computation of a value may
    use other caches and other keys, but never its own key.

    A cache lives as long as the process, so create it at module level, not in an object.

    Parameters
    ----------
    most : int
        Maximum total weight of the stored values. A value with a larger weight is returned but not stored.
    weigh : callable, optional
        Function that returns the weight of a value. Default: 1, so that `most` is a number of values.
    """

    __slots__ = ("_lock", "_most", "_places", "_total", "_weigh")

    def __init__(self, most: int, weigh: Callable[[Value], int] | None = None) -> None:
        """Make an empty cache; a fork waits until its lock is free."""
        self._most, self._weigh = most, weigh
        self._lock, self._total = Lock(), 0
        self._places: dict[Hashable, _CachePlace] = {}  # in the order of their last use
        held_by_forks(self._lock, self._begin_child)

    def _begin_child(self) -> None:
        """Remove entries without a value.

        The threads that compute missing values do not exist in a forked child, so the child computes them again.
        """
        self._places = {key: place for key, place in self._places.items() if place.value is not _NOTHING}

    def __len__(self) -> int:
        """Return the number of entries, including values that a thread computes now."""
        return len(self._places)

    def clear(self) -> None:
        """Remove all values."""
        with self._lock:
            self._places.clear()
            self._total = 0

    def find(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return the value of a key; if it is not stored, compute it with ``make()``."""
        with self._lock:
            place = self._places.pop(key, None) or _CachePlace()
            self._places[key] = place
        if place.value is _NOTHING:
            # Use the lock of the entry, not of the cache: a program takes a second, and tables need links from the
            # cache.
            with place.lock:
                if place.value is _NOTHING:
                    self._fill(key, place, make)
        return cast("Value", place.value)

    def call(self, make: Callable[..., Value], *values: Any) -> Value:
        """Return ``make(*values)``, from the cache if the content of the values has a key, otherwise computed again."""
        key = key_of(*values)
        return make(*values) if key is None else self.find(key, lambda: make(*values))

    def _fill(self, key: Hashable, place: _CachePlace, make: Callable[[], Value]) -> None:
        """Compute the value of an entry and store it; then remove old values until the total weight fits.

        The caller holds the lock of the entry `place`. If ``make()`` raises, the entry is removed.
        """
        try:
            value = make()
        except BaseException:
            with self._lock:
                if self._places.get(key) is place:
                    del self._places[key]
            raise
        with self._lock:
            place.value, place.weight = value, 1 if self._weigh is None else self._weigh(value)
            if self._places.get(key) is not place:  # dropped during the computation
                return
            if place.weight > self._most:
                del self._places[key]
                return
            self._total += place.weight
            while self._total > self._most:
                self._total -= self._places.pop(next(iter(self._places))).weight


class _NoKeyError(Exception):
    """A value has no key: it is too large, or its type can change without notice."""


def key_of(*values: Any) -> Hashable | None:
    """Return a key that is equal for equal content; None if a value is too large or has an unsupported type.

    Parameters
    ----------
    *values : object
        Numbers, texts, NumPy arrays, and tuples, lists, dictionaries and dataclasses of these.
    """
    try:
        return tuple([_content(value) for value in values])
    except _NoKeyError:
        return None


def _content(value: Any) -> Any:
    """Return a hashable object that is equal for equal type and content; raise _NoKeyError for unsupported content."""
    kind = type(value)
    if kind in _ATOMS:
        return value
    if kind is np.ndarray:
        if value.size > _ENTRIES or value.dtype.hasobject:
            raise _NoKeyError
        return value.shape, value.dtype.str, value.tobytes()
    if kind is tuple or kind is list:
        return (kind, *[_content(each) for each in value])
    if kind is dict:
        return (kind, *[_content(each) for pair in value.items() for each in pair])
    if kind in _WHOLE:
        return kind, value
    if isinstance(value, np.generic):
        return kind, value.item()
    return (kind, *[_content(getattr(value, name)) for name in _fields(kind)])  # type: ignore[arg-type]  # types are hashable


@cache
def _fields(kind: Any) -> tuple[str, ...]:
    """Return the names of the fields of a dataclass; raise _NoKeyError for other types."""
    if not is_dataclass(kind):
        raise _NoKeyError
    return tuple(one.name for one in fields(kind))
