"""What is made once for problems of equal structure and kept: one type of cache for all of optloc, safe in threads.

Links, tables, traces, linear maps and programs of IPOPT live in caches of this type, keyed by
`optloc.problem.problem.Problem.structure` and what else they depend on. Functions of a few plain numbers, such as the
moments of a loss, are kept by `functools.lru_cache` instead, which is locked and bounded as well; there two threads may
make the same value at once, which costs microseconds.

What is kept is shared by all threads: nobody writes into it.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from threading import Lock
from typing import Any, Generic, TypeVar, cast

import numpy as np

from optloc.base.threads import held_by_forks

Value = TypeVar("Value")

# Most entries of an array in a key: copying and hashing them takes some 30 us.
_ENTRIES = 4096
# Types of values that cannot change; equal numbers of the second ones differ as text.
_ATOMS, _WHOLE = frozenset({str, bytes, float, type(None)}), frozenset({int, bool, complex})

# None is a value (there are no tables for some structures), so a place that waits for its value holds this.
_NOTHING = object()


@dataclass(slots=True, eq=False)
class _CachePlace:
    """Where the value of a key stands; its lock is held by the thread that makes the value."""

    value: object = _NOTHING
    weight: int = 0
    lock: Lock = field(default_factory=Lock)


class Cache(Generic[Value]):
    """Values by key, made when they are first asked for; those that were not used for longest leave first.

    A value is made once, whichever thread asks first: others wait for it, while values of other keys can be had and
    made. A call that raises leaves nothing behind. To make a value may take other caches, never the same key of this.

    A cache lives as long as the process: it is one of a module, not of an object.

    Parameters
    ----------
    most : int
        Bound on the sum of the weights of the values kept; a heavier value is handed out and not kept.
    weigh : callable, optional
        Weight of a value; 1 if absent, which makes `most` a count.
    """

    __slots__ = ("_lock", "_most", "_places", "_total", "_weigh")

    def __init__(self, most: int, weigh: Callable[[Value], int] | None = None) -> None:
        self._most, self._weigh = most, weigh
        self._lock, self._total = Lock(), 0
        self._places: dict[Hashable, _CachePlace] = {}  # in the order of their last use
        held_by_forks(self._lock, self._begin_child)

    def _begin_child(self) -> None:
        # The threads that make these values do not live in a forked child; who needs one makes it.
        self._places = {key: place for key, place in self._places.items() if place.value is not _NOTHING}

    def __len__(self) -> int:
        return len(self._places)

    def clear(self) -> None:
        """Forget all values."""
        with self._lock:
            self._places.clear()
            self._total = 0

    def find(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return the value of a key, made by a call without arguments where it is not kept."""
        with self._lock:
            place = self._places.pop(key, None) or _CachePlace()
            self._places[key] = place
        if place.value is _NOTHING:
            # Not under the lock of all: a program takes a second, and links are needed to make tables.
            with place.lock:
                if place.value is _NOTHING:
                    self._fill(key, place, make)
        return cast("Value", place.value)

    def call(self, make: Callable[..., Value], *values: Any) -> Value:
        """Return the result of a function of values, from the cache where their content has a key."""
        key = key_of(*values)
        return make(*values) if key is None else self.find(key, lambda: make(*values))

    def _fill(self, key: Hashable, place: _CachePlace, make: Callable[[], Value]) -> None:
        try:
            value = make()
        except BaseException:
            with self._lock:
                if self._places.get(key) is place:
                    del self._places[key]
            raise
        with self._lock:
            place.value, place.weight = value, 1 if self._weigh is None else self._weigh(value)
            if self._places.get(key) is not place:  # driven out while it was made
                return
            if place.weight > self._most:
                del self._places[key]
                return
            self._total += place.weight
            while self._total > self._most:
                self._total -= self._places.pop(next(iter(self._places))).weight


class _NoKeyError(Exception):
    """A value is too large for a key, or may change without notice."""


def key_of(*values: Any) -> Hashable | None:
    """Return a key that is equal for equal content; None where a value is too large or of another type.

    Parameters
    ----------
    *values : object
        Numbers, texts, numpy arrays, and tuples, lists, dictionaries and dataclasses of these.
    """
    try:
        return tuple([_content(value) for value in values])
    except _NoKeyError:
        return None


def _content(value: Any) -> Any:
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
    if not is_dataclass(kind):
        raise _NoKeyError
    return tuple(one.name for one in fields(kind))
