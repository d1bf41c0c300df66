"""The function `locate`: from measurements to a fix in one call, with numpy or pandas input and common units.

It builds a problem with `optloc.problem.build.measured` and `assemble`. Use these functions for cases that `locate`
does not cover.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from datetime import date
from typing import TYPE_CHECKING, Any, TypeAlias, cast, overload

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.cache import Cache
from optloc.base.errors import InvalidProblem
from optloc.base.moved import renamed
from optloc.base.types import Amount, Band, Motion, Status
from optloc.base.units import Conversion, Quantity, in_si
from optloc.files.by_station import ARGUMENTS, RowLabels, station_values
from optloc.files.call_rows import North, Receivers, check_north, from_north, per_word, rows_of, scale_of
from optloc.files.constraint_reader import Limit, StatedConstraints, constraints_of, stated_arguments
from optloc.files.physics import warn_of_values
from optloc.files.pick_argument import PICKS, pick_rows, wave_of_picks
from optloc.files.propagation import is_time
from optloc.files.roles import with_standard_columns
from optloc.files.schema import FrameTable, StationsTable
from optloc.files.settings import Units
from optloc.files.stations import station_table, survey
from optloc.files.table_import import CARTESIAN, COMPASS
from optloc.files.wave_argument import Wave, medium_at, wave_of, with_speed, with_way, without_turn_around
from optloc.linear import constraints
from optloc.model_checks.plausibility import refuse_impossible
from optloc.models import MODELS
from optloc.models.medium import Layers, Medium
from optloc.problem.build import Measured, assemble, station_array
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers.floors import solve_on_floors
from optloc.solvers.solution import solve

if TYPE_CHECKING:
    import pandas as pd

Places: TypeAlias = "Mapping[str, Sequence[float]] | ArrayLike | pd.DataFrame"
"""Coordinates by name, as an array (s, 2 or 3), or as a table."""
Values: TypeAlias = (
    "Mapping[str, ArrayLike] | Mapping[tuple[str, str], ArrayLike] | ArrayLike | pd.Series | pd.DataFrame"
)
"""Measurements by station or by pair of stations, in the order of the stations, or as a table."""

# Smallest distance of a point on Earth from the centre (at the poles), metres.
_SURFACE = 6.3e6
# Caches of receivers and of unit conversions with standard deviations: repeated calls reuse them.
_PLACES, _SCALES = Cache["Receivers"](64), Cache[tuple[Conversion, float]](256)
# Quantities whose bounds determine the level of a target.
_LEVELS = ("height", "terrain")
# Length of a band of heights: the least and the greatest.
_BAND = 2


@overload
def locate(
    stations: Places,
    *,
    latlon: None = None,
    toa: Values | None = None,
    tdoa: Values | None = None,
    ranges: Values | None = None,
    pseudoranges: Values | None = None,
    bearings: Values | None = None,
    elevations: Values | None = None,
    sigma: Amount | Mapping[str, Amount] | None = None,
    unit: str | Mapping[str, str] | None = None,
    reference: str | None = None,
    height: Amount | Collection[Amount] | None = None,
    constraints: StatedConstraints = (),
    azimuth: str = COMPASS,
    declination: Amount | date | None = None,
    frame: str = "cartesian",
    wave_speed: Amount | tuple[Amount, Amount] | Medium | None = None,
    p: Values | None = None,
    s: Values | None = None,
    vp: Amount | Layers | None = None,
    vs: Amount | None = None,
    wind: str | Sequence[float] | None = None,
    two_way: bool = False,
    turn_around: Amount | None = None,
    method: str = "auto",
    speed: Amount | tuple[Amount, Amount] | Medium | None = None,
) -> Fix: ...
@overload
def locate(
    stations: None = None,
    *,
    latlon: Places,
    toa: Values | None = None,
    tdoa: Values | None = None,
    ranges: Values | None = None,
    pseudoranges: Values | None = None,
    bearings: Values | None = None,
    elevations: Values | None = None,
    sigma: Amount | Mapping[str, Amount] | None = None,
    unit: str | Mapping[str, str] | None = None,
    reference: str | None = None,
    height: Amount | Collection[Amount] | None = None,
    constraints: StatedConstraints = (),
    azimuth: str = COMPASS,
    declination: Amount | date | None = None,
    frame: str = "cartesian",
    wave_speed: Amount | tuple[Amount, Amount] | Medium | None = None,
    p: Values | None = None,
    s: Values | None = None,
    vp: Amount | Layers | None = None,
    vs: Amount | None = None,
    wind: str | Sequence[float] | None = None,
    two_way: bool = False,
    turn_around: Amount | None = None,
    method: str = "auto",
    speed: Amount | tuple[Amount, Amount] | Medium | None = None,
) -> Fix: ...
def locate(
    stations: Places | None = None,
    *,
    latlon: Places | None = None,
    toa: Values | None = None,
    tdoa: Values | None = None,
    ranges: Values | None = None,
    pseudoranges: Values | None = None,
    bearings: Values | None = None,
    elevations: Values | None = None,
    sigma: Amount | Mapping[str, Amount] | None = None,
    unit: str | Mapping[str, str] | None = None,
    reference: str | None = None,
    height: Amount | Collection[Amount] | None = None,
    constraints: StatedConstraints = (),
    azimuth: str = COMPASS,
    declination: Amount | date | None = None,
    frame: str = "cartesian",
    wave_speed: Amount | tuple[Amount, Amount] | Medium | None = None,
    p: Values | None = None,
    s: Values | None = None,
    vp: Amount | Layers | None = None,
    vs: Amount | None = None,
    wind: str | Sequence[float] | None = None,
    two_way: bool = False,
    turn_around: Amount | None = None,
    method: str = "auto",
    speed: Amount | tuple[Amount, Amount] | Medium | None = None,
) -> Fix:
    """Return the fix of a target from the measurements of receivers, in one call.

    Measurements are mappings of station names to values, arrays (..., s) in the order of the stations, pandas series,
    or data frames. A data frame has one column for each station (each row is a separate fix), or the columns station,
    value and optionally epoch. An unknown station name raises an error. Missing measurements are NaN. You can give
    several kinds together. The position has the same coordinates as the stations: without altitudes, a target on Earth
    is assumed to be at the level of the stations, 0 m.

    Parameters
    ----------
    stations : mapping of name to coordinates, array (s, 2 or 3), or table with name, x, y, z or name, lat, lon, alt
        Receivers or anchors: metres; degrees and metres in columns with the names lat, lon and alt.
    latlon : mapping of name to (latitude, longitude) or (latitude, longitude, altitude), or array (s, 2 or 3)
        Receivers in degrees and metres above the WGS 84 ellipsoid, instead of `stations`.
    toa : measurements, optional
        Times of arrival by one clock, seconds; numpy.datetime64 or whole nanoseconds keep all their digits.
    tdoa : measurements, optional
        Differences of arrival times, seconds: a mapping of (A, B) to the time at A minus the time at B; or of A, and B
        is the `reference`.
    ranges : measurements, optional
        Distances to the target, metres.
    pseudoranges : measurements, optional
        Distances that share an unknown clock error, metres. Give satellite positions at transmission, in the Earth axes
        at reception: rotate positions in the axes at transmission by the Earth rotation during the flight time.
    bearings : measurements, optional
        Compass bearings, degrees from true north (the y axis), clockwise; see `azimuth` and `declination`.
    elevations : measurements, optional
        Angles above the horizon, degrees.
    sigma : float, str, or mapping of argument to these
        Standard deviation of one value, in its unit, or text with a unit such as "20 ns"; for several kinds
        ``{"toa": 20e-9, "bearings": 2.0}``. The sigma of a time difference includes the errors of both arrivals.
    unit : str, or mapping of argument to str, optional
        Unit of the values: "ns", "km", "rad" and others.
    reference : str, optional
        Reference station of time differences; by default the first.
    height : float, str, (least, greatest), set or list, optional
        Known height of the target, metres or text such as "1640 ft": above the WGS 84 ellipsoid, or along z if the
        frame is not on Earth. A set, or a list of three or more, has the floors on one of which the target is.
    constraints : sequence of constraints or mappings, optional
        Constraints of `optloc.constraints`, or tables as in problem files, such as
        ``{"kind": "disc", "lat": 47.1, "lon": 8.2, "radius": "2 km"}``.
    azimuth : "north-clockwise", "north-counterclockwise" or "east-counterclockwise"
        Zero direction and sense of bearings.
    declination : float, str or date, optional
        Declination of bearings from magnetic north, east positive: in the unit of the bearings, text such as "4 deg",
        or a date such as "2026-06-01". For a date, the World Magnetic Model gives the declination at each station on
        Earth. It is added to compass bearings.
    frame : "cartesian" or "ecef"
        Frame of x, y, z of the stations.
    wave_speed : float, str, (float, float), Layers, Atmosphere or Wind
        Wave speed: m/s; a text such as "1480 m/s", "343+-5 m/s", "air:20C", "air:20C,50%" (humid), "water:8C,35,50m"
        (salinity, depth), or the file of a profile; a pair of a speed and its standard deviation; or a medium of
        `optloc.models`, in which rays bend or the wind carries the wave. By default light. A speed with a standard
        deviation is estimated with the position, from all measurements that are times.
    p, s : measurements, optional
        Arrival times of P and S waves, seconds or dates, with one unknown origin time. A station may have either or
        both. Other measurements are then not allowed.
    vp, vs : float, str or Layers, optional
        Speeds of P and S waves, such as "6 km/s"; or `vp` is the file of a table of layers, or a medium of constant
        layers, and `vs` a ratio such as "vp/1.73". A medium `PhaseLayers` has both speeds.
    wind : str or sequence of float, optional
        Velocity of the medium: "5 m/s from 270" (from the west), or towards the axes x and y, m/s. East and north for
        stations on Earth.
    two_way : bool
        Whether `ranges` are times of the way there and back.
    turn_around : float or str, optional
        Time between arrival and reply at the other end, seconds or text such as "2 ms", for two-way times.
    method : str
        Method as in `optloc.solve`.
    speed : float, str, (float, float), Layers or Atmosphere
        Old name of `wave_speed`.

    Returns
    -------
    Fix
        One position, or a batch (...) of positions; you can print it. On Earth, `Fix.latlon` has latitude and
        longitude.

    Raises
    ------
    InvalidProblem
        The message names the wrong argument and the station.

    Examples
    --------
    >>> import optloc
    >>> anchors = {"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (0.0, 6.0), "D": (8.0, 6.0)}
    >>> fix = optloc.locate(anchors, ranges={"A": 5.01, "B": 5.02, "C": 4.98, "D": 5.01}, sigma=0.05)
    >>> fix.status.label, fix.position.round(1).tolist()
    ('ok', [4.0, 3.0])
    """
    arguments = {"toa": toa, "tdoa": tdoa, "ranges": ranges, "pseudoranges": pseudoranges}
    arguments |= {"bearings": bearings, "elevations": elevations, "p": p, "s": s}
    given = {word: values for word, values in arguments.items() if values is not None}
    if not given:
        raise InvalidProblem("there are no measurements", "locate", f"give one of {', '.join(arguments)}")
    texts = (("reference", reference), ("frame", frame), ("method", method), ("azimuth", azimuth), *_texts(unit))
    for name, text in texts:
        if text is not None and not isinstance(text, str):
            raise InvalidProblem(f"{type(text).__name__} is not text", name, "give text, such as 'ns' for a unit")
    north = North(azimuth, declination)
    check_north(north, given)
    wave = with_way(wave_of(renamed("speed", speed, "wave_speed", wave_speed)), wind, two_way, turn_around, given)
    wave = wave_of_picks(vp, vs, wave, given)
    floors = _floors(height)
    made = [
        _problem_of(stations, latlon, given, sigma, unit, reference, level, constraints, frame, wave, north)
        for level in floors or [height]
    ]
    refuse_impossible(made[0][0], lambda _: "ranges", "python")
    fix = solve_on_floors([problem for problem, _ in made], method) if floors else solve(made[0][0], method=method)
    if (np.asarray(fix.code) != Status.OK).any():  # values of another unit fit no position, so these checks may wait
        warn_of_values(made[0][0], unit, "toa" in given, wave.speed)
    return _labelled(fix, made[0][1])


def _labelled(fix: Fix, labels: RowLabels | None) -> Fix:
    """Return fixes with the index of the data frame of the measurements as labels, and with its name.

    If the number of labels differs from the number of fixes, the fixes are returned unchanged.
    """
    if labels is None or fix.shape != (len(labels.values),):
        return fix
    as_objects = np.empty(len(labels.values), dtype=object)
    as_objects[:] = labels.values
    return replace(fix, labels=as_objects, label_names=labels.names)


def _texts(unit: Any) -> list[tuple[str, Any]]:
    """Return pairs of name and value that must be text, for a unit or a mapping of units."""
    return [("unit", each) for each in (unit.values() if isinstance(unit, Mapping) else (unit,))]


def _problem_of(
    stations: Any,
    latlon: Any,
    given: Mapping[str, Any],
    sigma: Any,
    unit: Any,
    reference: str | None,
    height: Any,
    limits: StatedConstraints,
    frame: str,
    wave: Wave,
    north: North,
) -> tuple[Problem, RowLabels | None]:
    """Return the problem of the arguments of `locate`, and the labels of its rows; None without labels.

    `given` has the measurements by the name of their argument. `wave` is the wave that converts times to lengths.
    `north` is the zero direction of bearings. The other parameters are arguments of `locate`.
    """
    places = _PLACES.call(_receivers, stations, latlon, frame)
    rows, timed, joint = list[Measured](), list[bool](), None
    labels: RowLabels | None = None
    if any(word in PICKS for word in given):
        picks = pick_rows(given, sigma, unit, places, wave)
        rows, joint, labels = [*picks.rows], picks.covariance, picks.labels
    for word, values in given.items():
        if word in PICKS:
            continue
        speed = wave.range_speed if word == "ranges" else wave.speed
        found = station_values(word, values, places.names, reference)
        labels = found.labels if labels is None else labels
        value_unit = per_word(unit, word, given, "unit") or found.unit or ARGUMENTS[word].unit
        convention = north.azimuth if word == "bearings" else CARTESIAN
        step, sigma_si = _SCALES.call(scale_of, word, value_unit, sigma, list(given), speed, convention)
        timed.append(is_time(Units(cast("Quantity", MODELS[ARGUMENTS[word].kind].quantity), speed), value_unit, "unit"))
        if word == "ranges" and wave.two_way:
            step = without_turn_around(step, wave, value_unit)
        made = rows_of(word, found, sigma_si, step, places, wave, timed=timed[-1])
        rows.append(from_north(made, north, value_unit, places) if word == "bearings" else made)
    if wave.wind is not None and not any(timed):
        raise InvalidProblem("no measurement is a time, so the wind has no effect", "wind", "remove this argument")
    stated, motions = _constraints(height, limits, places, given, wave.speed)
    problem = assemble(
        places.stations, *rows, frame=places.frame, constraints=stated, motions=motions, covariance=joint,
        medium=medium_at(wave, places.frame, places.stations),
    )  # fmt: skip
    return with_speed(problem, wave, timed), labels


# Receivers.


def _receivers(stations: Any, latlon: Any, frame: str) -> Receivers:
    """Return the stations of `locate` with their frame; raise InvalidProblem for invalid stations.

    Stations in degrees get a frame of east, north and up; otherwise `frame` is "cartesian" or "ecef".
    """
    if (stations is None) == (latlon is None):
        what = "the stations are missing" if stations is None else "the stations are given twice"
        raise InvalidProblem(what, "stations", "give stations= in metres, or latlon= in degrees")
    if frame not in ("cartesian", "ecef"):
        raise InvalidProblem(f"there is no frame {frame!r}", "frame", 'use "cartesian" or "ecef", or latlon=')
    where, axes = ("stations", "xyz") if latlon is None else ("latlon", ("lat_deg", "lon_deg", "height"))
    table = with_standard_columns(station_table(stations if latlon is None else latlon, where, axes), "m")
    geodetic = table.has("lat_deg") or table.has("lon_deg")
    if latlon is not None and not geodetic:
        raise InvalidProblem("there are no latitudes", "latlon", "name the columns lat and lon, or use stations=")
    kind = "enu" if geodetic else frame
    found, frame_of_stations = survey(StationsTable(), table, FrameTable(kind=cast("Any", kind)), where)
    if len(found.position) > len(found.names):
        raise InvalidProblem(
            "a station has several positions", where, "give one for each station, or use optloc.from_table"
        )
    order = np.argsort(found.index)
    axes_of = None if found.axes is None else found.axes[order]
    made = station_array(found.position[order], found.names, axes=axes_of)
    extent = float(np.ptp(made.position, axis=-2).max())
    return Receivers(made, frame_of_stations, geodetic and not table.has("height"), extent)


def _constraints(
    height: Any, limits: StatedConstraints, places: Receivers, given: Mapping[str, Any], speed: float
) -> tuple[tuple[Limit, ...], tuple[Motion, ...]]:
    """Return the constraints of the target, and its motion.

    `height` and `limits` are the arguments `height` and `constraints` of `locate`. `given` has the measurements by
    argument, and `speed` is the propagation speed, m/s.
    """
    still = (Motion(),)
    demands = stated_arguments(limits)
    if not demands:
        return _heights(height, places, given), still

    def found(more: dict[str, Any]) -> tuple[tuple[Limit, ...], tuple[Motion, ...]]:
        """Return the stated constraints together with `more`."""
        return constraints_of(demands | more, places.stations, places.frame, still, ("target",), np.zeros(1), speed)

    stated, motions = found({})
    # A stated height or a terrain replaces the height 0 m of stations without altitudes.
    level = any(isinstance(each, Band) and each.kind in _LEVELS for each in stated)
    if height is None and level:
        return stated, motions
    return found({"height": _heights(height, places, given)})


def _floors(height: Any) -> list[Any]:
    """Return the floors of the argument `height`: the heights of a set, or of a list of three or more; else none."""
    several = isinstance(height, set | frozenset) or (isinstance(height, list | tuple) and len(height) > _BAND)
    if not several:
        return []
    if not height:
        raise InvalidProblem("there are no heights", "height", "give the heights of the floors, such as {0.0, 3.5}")
    return sorted(height, key=str) if any(isinstance(each, str) for each in height) else sorted(height)


def _heights(height: Any, places: Receivers, given: Mapping[str, Any]) -> tuple[Band, ...]:
    """Return the constraint on the height of the target; an empty tuple for a free height.

    `height` is the argument of `locate`: a height, or the least and the greatest height, m. Stations on Earth without
    altitudes give the height 0 m. Raise InvalidProblem if bearings alone leave the height free, or if the height is
    invalid.
    """
    d = places.stations.position.shape[-1]
    if height is None and places.level:
        height = 0.0
    if height is None:
        if d == 3 and set(given) == {"bearings"}:
            advice = "give height= of the target in metres, elevations=, or stations without altitudes"
            raise InvalidProblem("bearings alone do not determine the height of the target", "bearings", advice)
        return ()
    try:
        ends = (height, height) if isinstance(height, str) or not np.ndim(height) else height
        low, high = (float(in_si(end, "length", "height", place=True)) for end in ends)
    except InvalidProblem:
        raise
    except (TypeError, ValueError):
        low = high = np.nan
    if not low <= high:
        raise InvalidProblem("this is not a height", "height", "give metres, or the least and the greatest height")
    if places.frame.geodetic:
        return constraints.height(low, high)
    if d == 2:
        raise InvalidProblem(
            "stations in the plane have no height", "height", "give x, y, z of each station, or remove this argument"
        )
    if np.linalg.norm(places.stations.position, axis=-1).min() > _SURFACE:
        advice = 'write frame="ecef" if they are Earth-centred'
        raise InvalidProblem("the stations are thousands of kilometres from the origin", "height", advice)
    return constraints.box([-np.inf, -np.inf, low], [np.inf, np.inf, high])
