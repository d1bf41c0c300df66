"""Stations that move: their rows are matched to epochs by label, or interpolated in time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optloc.errors import InvalidProblem
from optloc.files.epochs import Epochs
from optloc.files.schema import StationsTable
from optloc.files.words import Units
from optloc.types import Array

if TYPE_CHECKING:
    from optloc.files.stations import Survey


def spread(
    found: Survey, section: StationsTable, epochs: Epochs, used: Array
) -> tuple[Array, Array | None, Array | None]:
    """Return position (k, s, d), velocity (k, s, d) and axes (k, s, d, d) of stations at the epochs.

    A station that an epoch does not need may be anywhere there; it is put where it was first seen.
    """
    low, high, share = _by_label(found, epochs) if found.table.has("epoch") else _by_time(found, section, epochs)
    missing = low[used[:, 0], used[:, 1]] < 0
    if missing.any():
        epoch, station = used[int(np.flatnonzero(missing)[0])]
        what = f"{found.noun} {found.names[station]!r} has no position at epoch {epochs.labels[epoch]!r}"
        raise InvalidProblem(what, found.table.source, "add it, or leave out what it measured then")
    first = np.array([np.flatnonzero(found.index == i)[0] for i in range(len(found.names))])
    low, high = np.where(low < 0, first, low), np.where(high < 0, first, high)

    def between(values: Array) -> Array:
        weight = share.reshape(*share.shape, *[1] * (values.ndim - 1))
        return np.asarray(np.where(weight == 0.0, values[low], (1.0 - weight) * values[low] + weight * values[high]))

    if found.axes is not None and np.any((share > 0.0) & (low != high)) and _turning(found):
        raise InvalidProblem(
            "the axes of stations turn between the times of their rows",
            found.table.source,
            "give rows at the epochs' times",
        )
    velocity = None if found.velocity is None else between(found.velocity)
    return between(found.position), velocity, None if found.axes is None else found.axes[low]


def _turning(found: Survey) -> bool:
    return any(found.table.has(key) for key in ("yaw_deg", "heading_deg", "qw"))


def _by_label(found: Survey, epochs: Epochs) -> tuple[Array, Array, Array]:
    labels = found.table.labels("epoch").astype(str)
    known, place = np.unique(labels, return_inverse=True)
    at = np.searchsorted(known, np.array(epochs.labels)).clip(max=len(known) - 1)
    at = np.where(known[at] == np.array(epochs.labels), at, -1)
    grid = np.full((len(known) + 1, len(found.names)), -1)
    grid[place, found.index] = np.arange(len(labels))
    again = np.flatnonzero(grid[place, found.index] != np.arange(len(labels)))
    if len(again):
        row = int(again[0])
        what = f"{found.noun} {found.names[found.index[row]]!r} occurs twice at epoch {labels[row]!r}"
        raise InvalidProblem(what, found.table.where("name", row), "leave one of them out")
    low = grid[at]
    return low, low, np.zeros(low.shape)


def _by_time(found: Survey, section: StationsTable, epochs: Epochs) -> tuple[Array, Array, Array]:
    unit = Units("time").conversion(section.time_unit, found.table.source)
    times, k = found.table.times("time", unit.factor), epochs.count
    if not np.isfinite(epochs.times).all():
        advice = "give the measurements a column 'time', or the stations a column 'epoch'"
        raise InvalidProblem(
            "the stations move in time, but the measurements are not dated", found.table.source, advice
        )
    low = np.full((k, len(found.names)), -1)
    high, share = low.copy(), np.zeros(low.shape)
    for station in range(len(found.names)):
        rows = np.flatnonzero(found.index == station)
        rows = rows[np.argsort(times[rows], kind="stable")]
        own = times[rows]
        again = np.flatnonzero(np.diff(own) == 0.0)
        if len(again):
            row = int(rows[again[0] + 1])
            what = f"{found.noun} {found.names[station]!r} occurs twice at time {own[again[0]]:.10g} s"
            raise InvalidProblem(what, found.table.where("name", row), "leave one of them out")
        inside = (epochs.times >= own[0]) & (epochs.times <= own[-1])
        before = np.searchsorted(own, epochs.times, side="right").clip(1, len(own)) - 1
        after = (before + 1).clip(max=len(own) - 1)
        gap = np.where(after > before, own[after] - own[before], 1.0)
        low[:, station] = np.where(inside, rows[before], -1)
        high[:, station] = np.where(inside, rows[after], -1)
        share[:, station] = np.where(inside, (epochs.times - own[before]) / gap, 0.0).clip(0.0, 1.0)
    return low, high, share
