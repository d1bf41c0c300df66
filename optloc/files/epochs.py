"""Put rows together to epochs: by a column of labels, by exact time, or by windows of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array

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
