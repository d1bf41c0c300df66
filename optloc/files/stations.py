"""Stations and frame from a table: lengths in any unit, latitudes and longitudes, moving stations.

In shapes, n is the number of rows of the table, s the number of stations, k the number of epochs, d the dimension.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, no_station
from optloc.base.frames import CARTESIAN, ECEF, Frame, ecef_to_geodetic
from optloc.base.inputs import check_budget
from optloc.base.types import Array, Stations
from optloc.files.columns import stem
from optloc.files.roles import WORDS, with_standard_columns
from optloc.files.row_epochs import Epochs
from optloc.files.schema import FrameTable, StationsTable
from optloc.files.settings import Units, join
from optloc.files.table import Table, of_frame
from optloc.files.words import distinct

_XYZ, _GEODETIC, _RATES = ("x", "y", "z"), ("lat_deg", "lon_deg", "height"), ("vx", "vy", "vz")
_QUATERNION = ("qw", "qx", "qy", "qz")
# Column names of coordinates: a mapping with one of these keys is a table.
_COLUMNS = {"x", *WORDS["lat_deg"].split(), "latdeg"}
# Larger deviations of the length of a quaternion from 1 are not rounding of two or three digits: the order is wrong.
_UNIT = 1e-2
# Difference from the axes of the frame that is rounding of a rotation: these stations need no separate axes.
_SAME = 1e-15


@dataclass(frozen=True, slots=True)
class Survey:
    """Stations in the rows of their table, before they are assigned to epochs.

    Parameters
    ----------
    names : tuple of s str
        Stations in the order of appearance.
    index : int array (n,)
        Station of each row.
    position : array (n, d)
        Metres, in the frame.
    velocity : array (n, d), optional
        Metres per second.
    axes : array (n, d, d), optional
        Unit vectors in rows.
    sigma, velocity_sigma : array (n,), optional
        Standard deviations of each coordinate, metres, and of the velocities, metres per second.
    table : Table
        The rows.
    noun : str
        Noun for messages.
    """

    names: tuple[str, ...]
    index: Array
    position: Array
    velocity: Array | None
    axes: Array | None
    sigma: Array | None
    velocity_sigma: Array | None
    table: Table
    noun: str = "station"

    @property
    def moving(self) -> bool:
        """Return whether the table has times or epochs."""
        return self.table.has("time") or self.table.has("epoch")


def numbers_of(names: Sequence[str], stations: Sequence[str], where: str | Callable[[int], str]) -> Array:
    """Return the station number of each name (n,); raise InvalidProblem for an unknown name.

    `where` is the place of all names for messages, or a function that returns the place of a name by its index.
    """
    number = {name: i for i, name in enumerate(stations)}
    for i, name in enumerate(names):
        if name not in number:
            raise no_station(name, where if isinstance(where, str) else where(i), stations)
    return np.array([number[name] for name in names], dtype=np.int64)


def station_table(
    given: Any, where: str, axes: Sequence[str] = ("x", "y", "z"), names: Mapping[str, str] | None = None
) -> Table:
    """Return the table of stations from a Python argument.

    `given` is a Stations object, data frame, mapping of name to coordinates or to a row, mapping of columns, or array
    (s, d). Stations without names get the names S0, S1 and so on. `where` is the argument for messages. `axes` are the
    columns of the coordinates of an array. `names` are the column names in the table.
    """
    names = names or {}
    if isinstance(given, Stations):
        if given.position.shape[:-2] != (1,):
            raise InvalidProblem("these stations move or are a batch", where, "give a table with a column 'time'")
        given = dict(zip(given.names, given.position[0], strict=True))
    if hasattr(given, "columns") and hasattr(given, "index"):
        table = of_frame(given, where, names)
        if table.has("name") or {stem(name) for name in table.columns} & set(WORDS["name"].split()):
            return table
        labels = np.array([str(label) for label in given.index], dtype=object)
        return of_frame({"name": labels} | {name: table.columns[name] for name in table.columns}, where, names)
    mapped = isinstance(given, Mapping)
    if mapped and (names.get("name", "name") in given or {stem(str(key)) for key in given} & _COLUMNS):
        return of_frame(given, where, names)
    rows = list(given.values()) if mapped else given
    if mapped and rows and all(isinstance(row, Mapping) for row in rows):
        keys = dict.fromkeys(key for row in rows for key in row)
        columns = {key: np.array([row.get(key) for row in rows], dtype=object) for key in keys}
        return of_frame({"name": np.array([str(name) for name in given], dtype=object)} | columns, where, names)
    _check_heights(given, where)
    try:
        place = np.array([np.asarray(row, dtype=float) for row in rows])
    except (TypeError, ValueError):
        place = np.zeros(0)
    if place.ndim != 2 or place.shape[1] not in (2, 3):
        what = "these are not positions with 2 or 3 coordinates"
        raise InvalidProblem(what, where, "give name: (x, y, z), or an array with a row for each station")
    labels = np.array([str(name) for name in given] if mapped else [f"S{i}" for i in range(len(place))], dtype=object)
    return of_frame({"name": labels} | dict(zip(axes, place.T, strict=False)), where, names)


def _check_heights(given: Any, where: str) -> None:
    """Raise InvalidProblem if some stations of a mapping or sequence have a height and others have none."""
    rows = given.items() if isinstance(given, Mapping) else ((f"S{i}", row) for i, row in enumerate(given))
    count = {str(name): np.size(row) for name, row in rows}
    flat = [name for name, n in count.items() if n == 2]
    if flat and 3 in count.values():
        what = f"{len(flat)} of {len(count)} stations have no height, the first is {flat[0]}"
        raise InvalidProblem(what, where, "give every station three coordinates, or every station two")


def survey(section: StationsTable, table: Table, frame_table: FrameTable, where: str) -> tuple[Survey, Frame]:
    """Return the stations of a table, and the frame of the problem.

    `section` has the settings of the stations, `frame_table` the stated frame. Raise InvalidProblem for invalid
    columns, or for a name that occurs twice unless the stations move.
    """
    table = with_standard_columns(table, section.unit)
    labels = table.labels("name")
    found, first, index = distinct(labels)
    order = np.argsort(first)
    names = tuple(found[i] for i in order.tolist())
    # Keep the order of appearance, for messages and results.
    index = np.argsort(order)[index]
    if len(names) < table.count and not (table.has("time") or table.has("epoch")):
        row = int(np.setdiff1d(np.arange(table.count), first)[0])
        advice = "rename one station, or give moving stations a column 'time' or 'epoch'"
        raise InvalidProblem(f"station name {labels[row]!r} is used twice", table.where("name", row), advice)
    position, frame = _positions(table, frame_table, Units("length").conversion(section.unit, where).factor, where)
    d = position.shape[-1]
    rates = [key for key in _RATES[:d] if table.has(key)]
    velocity = None
    if rates:
        factor = Units("speed").conversion(section.speed_unit, where).factor
        velocity = factor * np.stack([table.numbers(key) for key in _RATES[:d]], axis=-1)
        # With latitude and longitude, velocities are east, north, up; the frame is ECEF.
        if frame.geodetic and frame_table.kind == "geodetic":
            velocity = np.einsum("nij,ni->nj", frame.enu_axes(position), velocity)
    axes = _axes(section, table, frame, position)
    # standard deviations of the positions, and of the velocities
    sigma, of_rates = (_sigma(section, table, where, key) for key in ("sigma", "velocity_sigma"))
    return Survey(names, index, position, velocity, axes, sigma, of_rates, table), frame


def _positions(table: Table, wanted: FrameTable, factor: float, where: str) -> tuple[Array, Frame]:
    """Return the positions (n, d) of the rows, m, and their frame.

    `wanted` is the frame in the file, and `factor` the metres in one unit of the table. Raise InvalidProblem if the
    columns do not fit the frame.
    """
    plane, globe = table.has("x") or table.has("y"), table.has("lat_deg") or table.has("lon_deg")
    if plane and globe:
        advice = "give x, y, z in all rows, or lat_deg, lon_deg, height"
        raise InvalidProblem("the rows mix x, y with latitude and longitude", table.source, advice)
    if globe and wanted.kind == "cartesian":
        advice = 'write kind = "geodetic", "ecef" or "enu" in [frame]'
        raise InvalidProblem("latitudes and longitudes do not fit a cartesian frame", table.source, advice)
    if not globe:
        if wanted.kind == "geodetic":
            raise InvalidProblem(
                "the frame is geodetic, but there are no columns lat_deg and lon_deg", table.source, "add the columns"
            )
        if not plane:
            what = f"there are no coordinates among {', '.join(map(str, table.columns))}"
            advice = "name them x, y, z, or lat_deg, lon_deg, height; optloc calibrate estimates unknown positions"
            raise InvalidProblem(what, table.source, advice)
        d = wanted.dimension or (3 if table.has("z") else 2)
        return factor * np.stack([table.numbers(key) for key in _XYZ[:d]], axis=-1), _frame(wanted, where)
    lat, lon = (np.radians(table.numbers(key)) for key in _GEODETIC[:2])
    height = factor * table.numbers("height") if table.has("height") else np.zeros(table.count)
    ecef = ECEF.from_geodetic(lat, lon, height, where=table.source, first_row=1)
    # An origin at the mean of the stations keeps coordinates small, and the plane near the ground.
    if wanted.kind == "enu" and wanted.origin is None:
        frame = Frame("enu", tuple(float(v) for v in ecef_to_geodetic(ecef.mean(0))))  # type: ignore[arg-type]
    else:
        frame = _frame(wanted, where)
    return frame.from_ecef(ecef)[:, : _dimension(wanted, frame, where)], frame


def _dimension(wanted: FrameTable, frame: Frame, where: str) -> int:
    """Return the dimension of positions with latitude and longitude, 2 or 3; only an ENU frame may have two."""
    if wanted.dimension == 2 and frame.kind != "enu":
        raise InvalidProblem(
            "only a cartesian or enu frame has two dimensions", join(where, "[frame]"), 'use kind = "enu"'
        )
    return wanted.dimension or 3


def _frame(wanted: FrameTable, where: str) -> Frame:
    """Return the frame that a file states; raise InvalidProblem for a missing or superfluous origin.

    `wanted` is the table ``[frame]``, and `where` the place of the stations for messages.
    """
    place = wanted.origin
    if wanted.kind == "enu" and place is not None:
        return Frame.enu(lat_deg=place.lat_deg, lon_deg=place.lon_deg, height=place.height)
    if wanted.kind == "enu":
        advice = "write origin = { lat_deg = ..., lon_deg = ..., height = ... }"
        raise InvalidProblem("an enu frame of stations in x, y, z needs an origin", join(where, "[frame]"), advice)
    if place is not None:
        raise InvalidProblem(
            f"the frame {wanted.kind!r} has no origin", join(where, "[frame]"), 'only kind = "enu" has one'
        )
    return CARTESIAN if wanted.kind == "cartesian" else ECEF


def _axes(section: StationsTable, table: Table, frame: Frame, position: Array) -> Array | None:
    """Return the axes of each row as unit vectors (n, d, d) in rows; None if they are the axes of the frame."""
    n, d = position.shape
    local = section.axes == "enu" or (section.axes is None and frame.geodetic)
    base = frame.enu_axes(position) if local else np.broadcast_to(np.eye(d), (n, d, d))
    # A rotation is from the axes of the frame, or from east, north, up, to the axes of the station.
    turn = _turn(table, d)
    if turn is None:
        stated = frame.kind == "ecef" and section.axes is not None
        return base if stated or not np.allclose(base, np.eye(d), rtol=0.0, atol=_SAME) else None
    return np.asarray(np.swapaxes(turn, -1, -2) @ base)


def _turn(table: Table, d: int) -> Array | None:
    """Return the rotations (n, d, d) in the table, from the axes of the station to the base axes; None without any."""
    if not any(table.has(key) for key in ("yaw_deg", "heading_deg", *_QUATERNION)):
        return None
    from scipy.spatial.transform import Rotation  # a lazy import: it takes 0.2 s, and most fixes do not need it

    # Yaw is positive from x towards y; a heading is positive from north towards east, so the sign changes.
    if table.has("yaw_deg") or table.has("heading_deg"):
        yaw = table.numbers("yaw_deg") if table.has("yaw_deg") else -table.numbers("heading_deg")
        return np.asarray(Rotation.from_euler("z", yaw[:, None], degrees=True).as_matrix()[:, :d, :d])
    if d == 2:
        raise InvalidProblem(
            "a quaternion rotates axes in space, but the stations have x and y only", table.source, "use yaw_deg"
        )
    parts = np.stack([table.numbers(key) for key in _QUATERNION], axis=-1)
    length = np.linalg.norm(parts, axis=-1)
    bad = np.flatnonzero(np.abs(length - 1.0) > _UNIT)
    if len(bad):
        what = f"the quaternion has length {length[bad[0]]:.4g}, not 1"
        raise InvalidProblem(what, table.where("qw", int(bad[0])), "check the order w, x, y, z")
    # scipy expects the scalar part last, files have it first.
    return np.asarray(Rotation.from_quat(parts[:, [1, 2, 3, 0]]).as_matrix())


def _sigma(section: StationsTable, table: Table, where: str, key: str) -> Array | None:
    """Return the standard deviations (n,) of positions, m, or velocities, m/s; None if the file states none.

    `key` is "sigma" or "velocity_sigma": a column, or a setting of the section.
    """
    stated, place = getattr(section, key), join(where, "[stations]", f"key {key!r}")
    units, plain_unit = (Units("length"), section.unit) if key == "sigma" else (Units("speed"), section.speed_unit)
    unit = units.conversion(plain_unit, where)
    if table.has(key):
        sigma = unit.sigma_to_si(table.numbers(key))
    elif stated is not None:
        number, unit = units.amount(stated, unit, place)
        sigma = np.full(table.count, float(unit.sigma_to_si(number)))
    else:
        return None
    bad = np.flatnonzero(sigma <= 0.0)
    if len(bad):
        place = table.where(key, int(bad[0])) if table.has(key) else place
        raise InvalidProblem("a standard deviation is not positive", place, f"remove {key} if there is no error")
    return sigma


def over_epochs(found: Survey, section: StationsTable, epochs: Epochs, used: Sequence[Array]) -> Stations:
    """Return the stations at the epochs: fixed stations once, moving stations with a position at each epoch.

    `found` are the stations of a table, and `section` has their settings. `used` has pairs (epoch, station) (u, 2)
    whose position is required, one array for each chunk of rows.
    """
    if found.moving:
        position, velocity, axes = stations_over_epochs(found, section, epochs, np.concatenate(used))
    else:
        order = np.argsort(found.index)
        position = found.position[order][None]
        velocity, axes = (None if v is None else v[order][None] for v in (found.velocity, found.axes))
    identity = np.eye(found.position.shape[-1])
    covariance, of_rates = (
        None if sigma is None else sigma[_first(found), None, None] ** 2 * identity
        for sigma in (found.sigma, found.velocity_sigma)
    )
    return Stations(position, found.names, velocity, axes, covariance, section.span, of_rates)


# Moving stations: rows are matched to epochs by label, or interpolated in time.


def stations_over_epochs(
    found: Survey, section: StationsTable, epochs: Epochs, used: Array
) -> tuple[Array, Array | None, Array | None]:
    """Return position (k, s, d), m, velocity (k, s, d), m/s, and axes (k, s, d, d) of moving stations at the epochs.

    Rows of the table belong to epochs by their labels, or are interpolated in time. `used` (u, 2) are the pairs (epoch,
    station) whose position is required. At an epoch without rows of a station, its position has no effect: the first
    known position is used. Velocity and axes are None if the table has none.
    """
    # Rows of the table before and after each epoch (-1 without a row), and the weight of the row after.
    low, high, share = _by_label(found, epochs) if found.table.has("epoch") else _by_time(found, section, epochs)
    missing = low[used[:, 0], used[:, 1]] < 0
    if missing.any():
        epoch, station = used[int(np.flatnonzero(missing)[0])]
        what = f"{found.noun} {found.names[station]!r} has no position at epoch {epochs.labels[epoch]!r}"
        raise InvalidProblem(what, found.table.source, "add the position, or remove the measurements of that epoch")
    first = _first(found)
    # Any finite position serves where it has no effect: use the first.
    low, high = np.where(low < 0, first, low), np.where(high < 0, first, high)

    def between(values: Array) -> Array:
        """Return values of rows (n, ...) interpolated to the epochs (k, s, ...)."""
        weight = share.reshape(*share.shape, *[1] * (values.ndim - 1))
        return np.asarray(np.where(weight == 0.0, values[low], (1.0 - weight) * values[low] + weight * values[high]))

    # Positions are interpolated linearly. Rotations are not interpolated, since the path of a rotation is unknown.
    if found.axes is not None and np.any((share > 0.0) & (low != high)) and _turning(found):
        raise InvalidProblem(
            "the axes of stations rotate between the times of their rows",
            found.table.source,
            "give rows at the times of the epochs",
        )
    velocity = None if found.velocity is None else between(found.velocity)
    return between(found.position), velocity, None if found.axes is None else found.axes[low]


def _first(found: Survey) -> Array:
    """Return the first row (s,) of each station."""
    return np.asarray(np.unique(found.index, return_index=True)[1])


def _turning(found: Survey) -> bool:
    """Return whether the stations have columns of rotations, which may change in time."""
    return any(found.table.has(key) for key in ("yaw_deg", "heading_deg", "qw"))


def _by_label(found: Survey, epochs: Epochs) -> tuple[Array, Array, Array]:
    """Return the rows of the stations at the epochs with the same label, in the form of `_by_time`.

    Both rows are the same, and the weights are zero.
    """
    labels = found.table.labels("epoch")
    known, _, place = distinct(labels)
    number = {label: i for i, label in enumerate(known)}
    at = np.array([number.get(label, -1) for label in epochs.labels])
    check_budget("cells", max(len(known), epochs.count) * len(found.names), found.table.source)
    # Row of each label and station; the last line, -1, is for labels that are not in the table.
    grid = np.full((len(known) + 1, len(found.names)), -1)
    grid[place, found.index] = np.arange(len(labels))
    again = np.flatnonzero(grid[place, found.index] != np.arange(len(labels)))
    if len(again):
        row = int(again[0])
        what = f"{found.noun} {found.names[found.index[row]]!r} occurs twice at epoch {labels[row]!r}"
        raise InvalidProblem(what, found.table.where("name", row), "remove one of them")
    low = grid[at]
    return low, low, np.zeros(low.shape)


def _by_time(found: Survey, section: StationsTable, epochs: Epochs) -> tuple[Array, Array, Array]:
    """Return the rows before and after each epoch (k, s), and the weight of the row after (k, s), from 0 to 1.

    Positions are interpolated between the two rows. The rows are -1 outside the times of a station.
    """
    unit = Units("time").conversion(section.time_unit, found.table.source)
    times, k = found.table.times("time", unit.factor, epochs.scale), epochs.count
    if not np.isfinite(epochs.times).all():
        advice = "give the measurements a column 'time', or the stations a column 'epoch'"
        raise InvalidProblem(
            "the stations move in time, but the measurements have no times", found.table.source, advice
        )
    # Each station has a position at each epoch, even without rows.
    check_budget("cells", k * len(found.names), found.table.source)
    low = np.full((k, len(found.names)), -1)
    high, share = low.copy(), np.zeros(low.shape)
    order = np.lexsort((times, found.index))
    for station, rows in enumerate(np.split(order, np.cumsum(np.bincount(found.index))[:-1])):
        times_of_station = times[rows]
        again = np.flatnonzero(np.diff(times_of_station) == 0.0)
        if len(again):
            row = int(rows[again[0] + 1])
            what = f"{found.noun} {found.names[station]!r} occurs twice at time {times_of_station[again[0]]:.10g} s"
            raise InvalidProblem(what, found.table.where("name", row), "remove one of them")
        inside = (epochs.times >= times_of_station[0]) & (epochs.times <= times_of_station[-1])
        # Outside the times of its rows, the position of a station is unknown; do not extrapolate.
        before = np.searchsorted(times_of_station, epochs.times, side="right").clip(1, len(times_of_station)) - 1
        after = (before + 1).clip(max=len(times_of_station) - 1)
        gap = np.where(after > before, times_of_station[after] - times_of_station[before], 1.0)
        low[:, station] = np.where(inside, rows[before], -1)
        high[:, station] = np.where(inside, rows[after], -1)
        share[:, station] = np.where(inside, (epochs.times - times_of_station[before]) / gap, 0.0).clip(0.0, 1.0)
    return low, high, share
