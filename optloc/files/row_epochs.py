"""Epochs of rows: by a column of labels, by exact time, or by time windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.time_scales import TimeScale
from optloc.base.types import Array
from optloc.files.settings import join
from optloc.files.words import distinct

# Tolerance of window limits, as a share of a window: times such as 0.3 are not multiples of 0.1 in binary.
_ROUNDING = 1e-9
# Larger window numbers are not exact in a double.
_COUNTED = 2.0**53


@dataclass(frozen=True, slots=True)
class Keys:
    """Columns of all measurement rows that determine their epochs.

    Parameters
    ----------
    label : object array (m,), optional
        Epoch column.
    time : array (m,), optional
        Time column, seconds.
    written : object array (m,), optional
        Time column as text.
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
        Target of each row; 0 with `own`.
    labels : tuple of k str
        Labels of the epochs.
    times : array (k,)
        Times of the epochs in the file, s; NaN if missing.
    targets : tuple of str
        Names of the targets; with `own`, the name of the target of each epoch.
    own : bool
        Whether each epoch belongs to one target. Targets that are free at each epoch share no unknowns, so rows of two
        targets at one time become two epochs.
    scale : TimeScale
        Scale of numbers in columns of times of the file.
    dated : bool
        Whether the times are seconds since 1970, UTC.
    """

    index: Array
    target: Array
    labels: tuple[str, ...]
    times: Array
    targets: tuple[str, ...]
    own: bool = False
    scale: TimeScale = "none"
    dated: bool = False

    @property
    def count(self) -> int:
        """Return the number of epochs k."""
        return len(self.labels)

    @property
    def clock(self) -> Array:
        """Return strictly increasing seconds (k,).

        These are the times, or the epoch numbers if times are missing or not increasing.
        """
        dated = bool(np.isfinite(self.times).all() and (np.diff(self.times) > 0.0).all())
        return self.times if dated else np.arange(float(self.count))


def epochs_of(keys: Keys, count: int, window: float | None, free: bool | None, source: str = "") -> Epochs:
    """Return the epochs of rows, and the target of each row, from the columns that determine them.

    `keys` has these columns (m,), and `count` is the number of rows m. `window` is the length of an epoch, s; None
    joins rows of exactly equal time. `free` is whether a target has an independent position at each epoch; None means
    independent if there are several epochs. With several free targets, each pair of an epoch and a target becomes an
    epoch. `source` is the place for messages.

    Raise InvalidProblem if an epoch has times before and after another epoch, or windows are too short to count.
    """
    if window is not None and keys.time is not None and np.ptp(keys.time) > _COUNTED * window:
        what = f"windows of {window:g} s are too short to be counted over {np.ptp(keys.time):g} s"
        raise InvalidProblem(what, join(source, "[epochs]", "key 'window'"), "give a longer window")
    index, labels, times = _group(keys, count, window)
    _check_instants(keys, labels, index, source)
    if keys.target is None:
        return Epochs(index, np.broadcast_to(0, (count,)), labels, times, ("target",))
    names, _, target = distinct(keys.target)
    # Rows of one epoch stay together for moving targets: the targets share the epoch.
    if len(names) == 1 or not (len(labels) > 1 if free is None else free):
        return Epochs(index, target, labels, times, tuple(names))
    # Free targets share nothing, so each pair of an epoch and a target becomes an epoch.
    pairs, index = np.unique(index * len(names) + target, return_inverse=True)
    epoch, owner = pairs // len(names), pairs % len(names)
    owners = tuple(names[i] for i in owner.tolist())
    chosen = tuple(np.array(labels, dtype=object)[epoch].tolist())
    return Epochs(index, np.zeros(count, dtype=np.int64), chosen, times[epoch], owners, own=True)


def _group(keys: Keys, count: int, window: float | None) -> tuple[Array, tuple[str, ...], Array]:
    """Return the epoch of each row (m,), the labels of the k epochs, and their times (k,), s, NaN if missing.

    Epochs are sorted by time, else by number, else by appearance. Parameters are as in `epochs_of`.
    """
    if keys.label is None and keys.time is None:
        return np.zeros(count, dtype=np.int64), ("0",), np.full(1, np.nan)
    if keys.label is not None:
        values, first, index = distinct(keys.label)
        # Numeric labels are sorted by value (2 before 10), other labels by appearance; times take precedence.
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
        # Average differences from the first row, so that equal times stay exact.
        base = keys.time[first]
        times = base + np.bincount(index, keys.time - base[index]) / np.bincount(index)
        order = order[np.argsort(times[order], kind="stable")]
    # Inverse permutation: the place of each group in the order.
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return place[index], tuple(labels[order].tolist()), times[order]


def _check_instants(keys: Keys, labels: Sequence[str], index: Array, source: str) -> None:
    """Raise InvalidProblem for a label with times before and after all times of another label.

    `labels` are the labels of the epochs, and `index` (m,) is the epoch of each row.
    """
    if keys.label is None or keys.time is None or len(labels) < 2:
        return
    first, last = np.full(len(labels), np.inf), np.full(len(labels), -np.inf)
    np.minimum.at(first, index, keys.time)
    np.maximum.at(last, index, keys.time)
    # Comparing neighbours in the order of first times is enough: an epoch that encloses another encloses the next.
    order = np.argsort(first, kind="stable")
    outer, inner = order[:-1], order[1:]
    enclosing = np.flatnonzero((first[outer] < first[inner]) & (last[inner] < last[outer]))
    if len(enclosing):
        one, two = outer[enclosing[0]], inner[enclosing[0]]
        what = f"epoch {labels[one]!r} has the times {first[one]:.10g} s and {last[one]:.10g} s"
        advice = "give each instant a different label"
        raise InvalidProblem(f"{what}, and epoch {labels[two]!r} is between them", source, advice)


def _numbers(values: Sequence[str]) -> Array | None:
    """Return texts as numbers (m,); None if one of them is not a number."""
    try:
        return np.array([float(value) for value in values])
    except ValueError:
        return None


def need_clock(epochs: Epochs, why: str, source: str) -> Array:
    """Return strictly increasing times of the epochs (k,), s; raise InvalidProblem if the file has none.

    `why` is the reason for which times are needed, for messages.
    """
    if epochs.count > 1 and not np.isfinite(epochs.times).all():
        raise InvalidProblem(f"{why} needs the time of each epoch", source, "give the measurements a column 'time'")
    twice = np.flatnonzero(np.diff(epochs.times) <= 0.0)
    if len(twice):
        one, two = epochs.labels[twice[0]], epochs.labels[twice[0] + 1]
        raise InvalidProblem(
            f"the epochs {one!r} and {two!r} have the same time, but {why} needs different times",
            source,
            "correct the times, or give both epochs the same label",
        )
    return epochs.clock
