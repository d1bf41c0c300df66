"""One call from what receivers measured to a fix: the field's words and units, numpy or pandas in.

Everything becomes `optloc.problem.build.measured` and `assemble`; what these functions cannot say, those can.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import Any, NamedTuple, cast, get_args

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.frames import Frame
from optloc.base.types import Array, Band, Stations
from optloc.base.units import SPEED_OF_LIGHT, AzimuthConvention, Conversion, Quantity, conversion
from optloc.files.columns import stem, unit_of
from optloc.files.declination import angle_of, date_of, declinations
from optloc.files.readings import CARTESIAN, COMPASS
from optloc.files.roles import WORDS, worded
from optloc.files.schema import FrameTable, StationsTable, Units
from optloc.files.stations import survey
from optloc.files.table import Table, of_frame
from optloc.linear import constraints
from optloc.models import MODELS
from optloc.models.medium import Medium
from optloc.problem.build import Measured, assemble, measured, station_array
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers import solve


class _Word(NamedTuple):
    """What an argument of `locate` is: a kind, the unit of bare numbers, and what messages call its values."""

    kind: str
    unit: str
    noun: str


_WORDS = {
    "toa": _Word("toa", "s", "times of arrival"),
    "tdoa": _Word("tdoa", "s", "time differences"),
    "ranges": _Word("range", "m", "ranges"),
    "pseudoranges": _Word("toa", "m", "pseudoranges"),
    "bearings": _Word("azimuth", "deg", "bearings"),
    "elevations": _Word("elevation", "deg", "elevations"),
}
# Nothing is nearer to the centre of the Earth than its poles, metres.
_SURFACE = 6.3e6
# Arrivals differ by no more than the way between two stations; that many times as much is another unit.
_TOO_FAR = 100.0
# Steps between two floats that stand for an instant, as a share of its standard deviation, which nobody would see.
_STEP = 0.1


@dataclass(frozen=True, slots=True)
class _Receivers:
    """Stations in their frame, and whether heights were left out on Earth."""

    stations: Stations
    frame: Frame
    level: bool

    @property
    def names(self) -> tuple[str, ...]:
        return self.stations.names

    @property
    def extent(self) -> float:
        """Return the greatest distance between two stations along one axis."""
        return float(np.ptp(self.stations.position, axis=-2).max())


class _North(NamedTuple):
    """From where bearings are counted, and the declination of magnetic north, None for true north."""

    azimuth: str
    declination: Any


class _Readings(NamedTuple):
    """Values (..., m) as they are given, what each belongs to, and the unit that their column names."""

    values: Array
    keys: list[Any]
    unit: str | None = None


def locate(
    stations: Any = None,
    *,
    latlon: Any = None,
    toa: Any = None,
    tdoa: Any = None,
    ranges: Any = None,
    pseudoranges: Any = None,
    bearings: Any = None,
    elevations: Any = None,
    sigma: Any = None,
    unit: Any = None,
    reference: str | None = None,
    height: Any = None,
    azimuth: str = COMPASS,
    declination: Any = None,
    frame: str = "cartesian",
    speed: float | Medium = SPEED_OF_LIGHT,
    method: str = "auto",
) -> Fix:
    """Return where something is from what receivers measured of it, in one call.

    Measurements are mappings of a station's name to a value, arrays (..., s) in the order of the stations, pandas
    series, or data frames with one column for each station (each row is a fix of its own) or with the columns station,
    value and, where wanted, epoch. Every name must be that of a station, those of all columns of a frame with one for
    each station included; an unknown one is refused. What was not heard is NaN. Several kinds may be given together. As
    many coordinates come out as go in: without altitudes a target on Earth is taken to be at the level of the stations,
    0 m.

    Parameters
    ----------
    stations : mapping of name to coordinates, array (s, 2 or 3), or table with name, x, y, z or name, lat, lon, alt
        Receivers or anchors: metres; degrees and metres in columns that are called lat, lon and alt.
    latlon : mapping of name to (latitude, longitude) or (latitude, longitude, altitude), or array (s, 2 or 3)
        Receivers in degrees and metres above the WGS 84 ellipsoid, in the place of `stations`.
    toa : measurements, optional
        Times of arrival by one clock, seconds; numpy.datetime64 or whole nanoseconds keep all their digits.
    tdoa : measurements, optional
        Differences of arrival times, seconds: a mapping of (A, B) to the time at A less that at B; or of A, and B is
        the `reference`.
    ranges : measurements, optional
        Distances of a tag, metres.
    pseudoranges : measurements, optional
        Distances that share an unknown clock error, metres. Satellites are where they were when they sent, along the
        axes of the Earth at reception: turn places of the time of sending by the rotation of the Earth in the flight.
    bearings : measurements, optional
        Compass bearings, degrees from true north (the y axis), clockwise; see `azimuth` and `declination`.
    elevations : measurements, optional
        Angles above the horizon, degrees.
    sigma : float, str, or mapping of argument to these
        Standard deviation of one value, in its unit, or text with a unit such as "20 ns"; of several kinds
        ``{"toa": 20e-9, "bearings": 2.0}``. That of a time difference is of both arrivals together.
    unit : str, or mapping of argument to str, optional
        Unit of the values: "ns", "km", "rad" and so on.
    reference : str, optional
        Station that time differences are taken to; the first by default.
    height : float, or (least, greatest), optional
        Known height of the target: metres above the WGS 84 ellipsoid, or along z where there is no Earth.
    azimuth : "north-clockwise", "north-counterclockwise" or "east-counterclockwise"
        Where bearings are counted from, and which way.
    declination : float, str or date, optional
        Of bearings from magnetic north, east positive: in the unit of the bearings, text such as "4 deg", or a date
        such as "2026-06-01", at which the World Magnetic Model gives that of each station on Earth. It is added to
        compass bearings.
    frame : "cartesian" or "ecef"
        What x, y, z of stations mean.
    speed : float, Layers or Atmosphere
        Propagation speed, m/s: light, or `optloc.units.sound_in_air` and `sound_in_water`; or `optloc.Layers` and
        `optloc.Atmosphere`, through which rays bend.
    method : str
        As of `optloc.solve`.

    Returns
    -------
    Fix
        Of one position, or a batch (...) of them: print it. On Earth `Fix.latlon` has latitude and longitude.

    Raises
    ------
    InvalidProblem
        Naming the argument and the station that cannot be right.

    Examples
    --------
    >>> import optloc
    >>> anchors = {"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (0.0, 6.0), "D": (8.0, 6.0)}
    >>> fix = optloc.locate(anchors, ranges={"A": 5.01, "B": 5.02, "C": 4.98, "D": 5.01}, sigma=0.05)
    >>> fix.status.label, fix.position.round(1).tolist()
    ('ok', [4.0, 3.0])
    """
    arguments = {"toa": toa, "tdoa": tdoa, "ranges": ranges, "pseudoranges": pseudoranges}
    arguments |= {"bearings": bearings, "elevations": elevations}
    given = {word: values for word, values in arguments.items() if values is not None}
    if not given:
        raise InvalidProblem("there are no measurements", "locate", f"give one of {', '.join(arguments)}")
    texts = (("reference", reference), ("frame", frame), ("method", method), ("azimuth", azimuth), *_texts(unit))
    for name, text in texts:
        if text is not None and not isinstance(text, str):
            raise InvalidProblem(f"{type(text).__name__} is no name", name, "give text, such as 'ns' for a unit")
    north = _North(azimuth, declination)
    _check_north(north, given)
    problem = _problem_of(stations, latlon, given, sigma, unit, reference, height, frame, _speed(speed), north)
    return solve(problem, method=method)


def _check_north(north: _North, given: Mapping[str, Any]) -> None:
    """Refuse conventions of azimuths that there are none of, and a declination without bearings from north."""
    known = get_args(AzimuthConvention)
    if north.azimuth not in known:
        raise InvalidProblem(f"there is no convention {north.azimuth!r}", "azimuth", nearest(north.azimuth, known))
    if north.declination is None:
        return
    if "bearings" not in given:
        raise InvalidProblem("there are no bearings", "declination", "leave it out")
    if north.azimuth == CARTESIAN:
        raise InvalidProblem("angles from the x axis have no declination", "declination", "leave it out")


def _speed(given: Any) -> float | Medium:
    if isinstance(given, Medium):
        return given
    if isinstance(given, bool) or not isinstance(given, float | int | np.number) or not 0.0 < given < np.inf:
        advice = "give metres per second, optloc.Layers or optloc.Atmosphere"
        raise InvalidProblem("the speed is no positive number", "speed", advice)
    return float(given)


def _texts(unit: Any) -> list[tuple[str, Any]]:
    """Return what must be text in an argument that may have one for each kind."""
    return [("unit", each) for each in (unit.values() if isinstance(unit, Mapping) else (unit,))]


def _problem_of(
    stations: Any,
    latlon: Any,
    given: Mapping[str, Any],
    sigma: Any,
    unit: Any,
    reference: str | None,
    height: Any,
    frame: str,
    through: float | Medium,
    north: _North,
) -> Problem:
    """Return the problem of the arguments of `locate`."""
    medium, speed = (through, through.unit_speed) if isinstance(through, Medium) else (None, through)
    places = _receivers(stations, latlon, frame)
    rows = []
    for word, values in given.items():
        found = _readings(word, values, places.names, reference)
        units = Units(cast("Quantity", MODELS[_WORDS[word].kind].quantity), speed)
        own = _per_word(unit, word, given, "unit") or found.unit or _WORDS[word].unit
        convention = cast("AzimuthConvention", north.azimuth if word == "bearings" else CARTESIAN)
        step = replace(units, convention=convention).conversion(own, f"unit of {word}")
        spread = _spread(_per_word(sigma, word, given, "sigma"), word, units, own)
        made = _rows(word, found, spread, step, places, speed)
        rows.append(_from_north(made, north, own, places) if word == "bearings" else made)
    at = _heights(height, places, given)
    return assemble(places.stations, *rows, frame=places.frame, constraints=at, medium=medium)


# Where the receivers are.


def _receivers(stations: Any, latlon: Any, frame: str) -> _Receivers:
    if (stations is None) == (latlon is None):
        what = "the stations are missing" if stations is None else "the stations are given twice"
        raise InvalidProblem(what, "stations", "give stations= in metres, or latlon= in degrees")
    if frame not in ("cartesian", "ecef"):
        raise InvalidProblem(f"there is no frame {frame!r}", "frame", 'use "cartesian" or "ecef", or latlon=')
    if isinstance(stations, Stations):
        stations = dict(zip(stations.names, stations.position[..., 0, :, :], strict=True))
    where, axes = ("stations", "xyz") if latlon is None else ("latlon", ("lat_deg", "lon_deg", "height"))
    table = worded(_station_table(stations if latlon is None else latlon, where, axes), "m")
    globe = table.has("lat_deg") or table.has("lon_deg")
    if latlon is not None and not globe:
        raise InvalidProblem("there are no latitudes", "latlon", "call the columns lat and lon, or use stations=")
    kind = "enu" if globe else frame
    found, own = survey(StationsTable(), table, FrameTable(kind=cast("Any", kind)), where)
    if len(found.position) > len(found.names):
        raise InvalidProblem("a station has several places", where, "give one for each, or use optloc.from_table")
    order = np.argsort(found.index)
    axes_of = None if found.axes is None else found.axes[order]
    made = station_array(found.position[order], found.names, axes=axes_of)
    return _Receivers(made, own, globe and not table.has("height"))


def _station_table(given: Any, where: str, axes: Sequence[str]) -> Table:
    """Return stations as a table, whatever they are given as."""
    if hasattr(given, "columns") and hasattr(given, "index"):
        table = of_frame(given, where, {})
        stems = {stem(name) for name in table.columns}
        if stems & set(WORDS["name"].split()):
            return table
        return of_frame({"name": np.array([str(label) for label in given.index], dtype=object)} | {
            name: table.columns[name] for name in table.columns
        }, where, {})  # fmt: skip
    if isinstance(given, Mapping) and {stem(str(key)) for key in given} & {"x", *WORDS["lat_deg"].split(), "latdeg"}:
        return of_frame(given, where, {})
    names = [str(name) for name in given] if isinstance(given, Mapping) else None
    rows = list(given.values()) if isinstance(given, Mapping) else given
    if isinstance(given, Mapping) and rows and all(isinstance(row, Mapping) for row in rows):
        keys = dict.fromkeys(key for row in rows for key in row)
        columns = {key: np.array([row.get(key) for row in rows], dtype=object) for key in keys}
        return of_frame({"name": np.array(names, dtype=object)} | columns, where, {})
    try:
        place = np.array([np.asarray(row, dtype=float) for row in rows])
    except (TypeError, ValueError):
        place = np.zeros(0)
    if place.ndim != 2 or place.shape[1] not in (2, 3):
        what = "these are no positions of 2 or 3 coordinates each"
        raise InvalidProblem(what, where, "give name: (x, y, z), or an array with a row for each station")
    labels = names or [f"S{i}" for i in range(len(place))]
    named = {"name": np.array(labels, dtype=object)}
    return of_frame(named | dict(zip(axes, place.T, strict=False)), where, {})


def _heights(height: Any, places: _Receivers, given: Mapping[str, Any]) -> tuple[Band, ...]:
    """Return what is known of the target's height."""
    d = places.stations.position.shape[-1]
    if height is None and places.level:
        height = 0.0
    if height is None:
        if d == 3 and set(given) == {"bearings"}:
            advice = "give height= of the target in metres, elevations=, or stations without altitudes"
            raise InvalidProblem("bearings alone do not tell how high the target is", "bearings", advice)
        return ()
    try:
        low, high = (float(end) for end in (height if np.ndim(height) else (height, height)))
    except (TypeError, ValueError):
        low = high = np.nan
    if not low <= high:
        what = f"{height!r} is no height" if isinstance(height, str) else "this is no height"
        raise InvalidProblem(what, "height", "give metres, or the least and the greatest")
    if places.frame.geodetic:
        return constraints.height(low, high)
    if d == 2:
        raise InvalidProblem("stations in the plane have no height", "height", "give x, y, z of each, or leave it out")
    if np.linalg.norm(places.stations.position, axis=-1).min() > _SURFACE:
        advice = 'say frame="ecef" if they are Earth-centred'
        raise InvalidProblem("the stations are some thousand kilometres from their origin", "height", advice)
    return constraints.box([-np.inf, -np.inf, low], [np.inf, np.inf, high])


# What they measured.


def _per_word(given: Any, word: str, words: Mapping[str, Any], name: str) -> Any:
    """Return what an argument that may be one for each kind says of a kind."""
    if isinstance(given, Mapping):
        unknown = [key for key in given if key not in words]
        if unknown:
            advice = f"use {', '.join(words)}"
            raise InvalidProblem(f"there are no measurements called {unknown[0]!r}", name, advice)
        return given.get(word)
    if name == "sigma" and given is not None and not isinstance(given, str) and len(words) > 1:
        example = ", ".join(f'"{each}": ...' for each in words)
        raise InvalidProblem("one number cannot be the error of several kinds", name, f"give {{{example}}}")
    return given


def _spread(sigma: Any, word: str, units: Units, unit: str) -> float:
    """Return the standard deviation of one value, SI."""
    noun, default = _WORDS[word].noun, units.conversion(unit, f"unit of {word}")
    if sigma is None:
        advice = f"give their standard deviation in {unit}, such as sigma=..., or as text with a unit"
        raise InvalidProblem(f"nothing says how accurate the {noun} are", "sigma", advice)
    if not isinstance(sigma, str | float | int | np.number) or isinstance(sigma, bool):
        raise InvalidProblem(
            f"{type(sigma).__name__} is no standard deviation", "sigma", "give a number, or optloc.measured"
        )
    number, own = units.amount(sigma if isinstance(sigma, str) else float(sigma), default, "sigma")
    value = float(own.sigma_to_si(number))
    if not value > 0.0:
        raise InvalidProblem(
            f"the standard deviation {sigma} of the {noun} is not positive", "sigma", "give what is expected"
        )
    return value


def _readings(word: str, given: Any, names: Sequence[str], reference: str | None) -> _Readings:
    """Return values by what they belong to: a station, or of time differences a pair of them."""
    if reference is not None and reference not in names:
        raise InvalidProblem(f"there is no station {reference!r}", "reference", nearest(str(reference), names))
    first = names[0] if reference is None else reference
    given = _with_names(given)
    if hasattr(given, "columns") and hasattr(given, "index"):
        found = _of_table(word, given, names, first)
    elif hasattr(given, "index") and hasattr(given, "to_numpy"):
        found = _Readings(_numbers(word, given.to_numpy()), list(given.index))
    elif isinstance(given, Mapping):
        columns = [_numbers(word, value) for value in given.values()]
        if len({np.shape(column) for column in columns}) > 1:
            raise InvalidProblem("some stations have more values than others", word, "give each as many, NaN for none")
        if any(column.dtype.kind == "M" for column in columns):
            columns = [column if column.dtype.kind == "M" else _no_dates(word, column) for column in columns]
        found = _Readings(np.stack(columns, axis=-1) if columns else np.zeros(0), list(given))
    else:
        values, keys = _numbers(word, given), list(names)
        if word == "tdoa" and values.ndim and values.shape[-1] == len(names) - 1:
            keys.remove(first)
        if values.ndim == 0 or values.shape[-1] != len(keys):
            what = f"{values.shape[-1] if values.ndim else 1} values for {len(names)} stations"
            raise InvalidProblem(what, word, "give one for each, NaN where there is none, or name: value")
        found = _Readings(values, keys)
    if not found.keys:
        raise InvalidProblem("there are no values", word, "give name: value")
    ends = [_ends(word, key, names, first) for key in found.keys]
    kept = [i for i, (a, b) in enumerate(ends) if a != b]  # the reference against itself says nothing
    if not kept:
        raise InvalidProblem("there is nothing but the reference", word, "give the other stations")
    return _Readings(found.values[..., kept], [ends[i] for i in kept], found.unit)


def _with_names(given: Any) -> Any:
    """Return a structured array as a mapping, and tables of polars, pyarrow and xarray as pandas has them.

    Each of them names what its values belong to: an array alone would take them in the order of the stations.
    """
    fields = getattr(getattr(given, "dtype", None), "names", None)
    if fields:
        return {name: given[name] for name in fields}
    return given.to_pandas() if hasattr(given, "to_pandas") else given


def _ends(word: str, key: Any, names: Sequence[str], reference: str) -> tuple[int, int]:
    """Return the numbers of the stations that a key names; -1 where there is one station only."""
    pair = key if isinstance(key, tuple) else (key,)
    if word == "tdoa" and len(pair) == 1 and str(key) not in names:
        cut = [(str(key)[:i], str(key)[i + 1 :]) for i, sign in enumerate(str(key)) if sign == "-"]
        pair = next((each for each in cut if set(each) <= set(names)), pair)
    if word == "tdoa" and len(pair) == 1:
        pair = (pair[0], reference)
    if len(pair) != (2 if word == "tdoa" else 1):
        raise InvalidProblem(f"{key!r} does not name what was measured", word, "use the name of a station")
    unknown = [str(name) for name in pair if str(name) not in names]
    if unknown:
        raise InvalidProblem(f"there is no station {unknown[0]!r}", word, nearest(unknown[0], names))
    one, *other = (names.index(str(name)) for name in pair)
    return one, other[0] if other else -1


def _named(word: str, columns: Sequence[Any], names: Sequence[str], reference: str) -> list[Any]:
    """Return the columns of a data frame whose names are those of stations, or of pairs of them."""
    found = []
    for column in columns:
        try:
            _ends(word, column, names, reference)
        except InvalidProblem:
            continue
        found.append(column)
    return found


def _wide(word: str, frame: Any, names: Sequence[str], reference: str) -> _Readings:
    """Return the values of a data frame with one column for each station or pair; every column must be one."""
    columns = list(frame.columns)
    for column in columns:
        try:
            _ends(word, column, names, reference)
        except InvalidProblem as error:
            advice = f"{error.advice}; drop a column that holds no {_WORDS[word].noun}"
            raise InvalidProblem(error.what, f"{word}, column {column!r}", advice) from None
    # By number: two columns may have one name.
    values = [_numbers(word, frame.iloc[:, i].to_numpy()) for i in range(len(columns))]
    return _Readings(np.stack(values, axis=-1), columns)


def _of_table(word: str, frame: Any, names: Sequence[str], reference: str) -> _Readings:
    """Return the values of a data frame: one column for each station, or one row for each value."""
    columns = list(frame.columns)
    wide = _named(word, columns, names, reference)
    if wide and len(wide) == len(columns):
        return _wide(word, frame, names, reference)
    stems = {stem(str(name)): name for name in reversed(list(frame.columns))}
    kind = _WORDS[word].kind
    value_words = [*WORDS["z"].split(), *(stem(each) for each in (word, word.rstrip("s"), kind, *MODELS[kind].aliases))]
    value_words += ["time", "timestamp"] if word == "toa" else []
    chosen = {
        role: next((stems[each] for each in words if each in stems), None)
        for role, words in (("a", WORDS["a"].split()), ("b", WORDS["b"].split()), ("z", value_words))
    }
    tidy = None not in (chosen["a"], chosen["z"]) and {*wide} <= {*chosen.values()}
    if wide and not tidy:
        return _wide(word, frame, names, reference)
    for role, text in (("a", "station"), ("z", "value")):
        if chosen[role] is None:
            listed = ", ".join(str(name) for name in columns)
            advice = "call columns by the stations, or use the columns station and value"
            if {str(label) for label in frame.index} <= {*names}:
                advice = "its rows are the stations: give the transposed frame, .T"
            raise InvalidProblem(f"no column is a {text}; there are {listed}", word, advice)
    epochs = next((stems[each] for each in ("epoch", "message", "msg", "pulse") if each in stems), None)
    ends = [str(name) for name in frame[chosen["a"]]]
    if word == "tdoa" and chosen["b"] is not None:
        ends = list(zip(ends, (str(name) for name in frame[chosen["b"]]), strict=True))  # type: ignore[arg-type]
    labels = [None] * len(ends) if epochs is None else frame[epochs].tolist()
    keys, rows = ({one: i for i, one in enumerate(dict.fromkeys(each))} for each in (ends, labels))
    values = _numbers(word, frame[chosen["z"]].to_numpy())
    grid = np.full(
        (len(rows), len(keys)),
        np.datetime64("NaT") if values.dtype.kind == "M" else np.nan,
        dtype=values.dtype if values.dtype.kind == "M" else float,
    )
    seen: set[tuple[int, int]] = set()
    # Whole numbers are counted from the least, so that nanoseconds of today keep their digits as floats.
    values = values - values.min() if values.dtype.kind in "iu" else values
    for value, key, label in zip(values, ends, labels, strict=True):
        place = (rows[label], keys[key])
        if place in seen:
            what = f"{key} has two values" + ("" if label is None else f" at {label}")
            raise InvalidProblem(what, word, "leave one of them out, or give a column epoch")
        seen.add(place)
        grid[place] = value
    named = unit_of(str(chosen["z"]), ("s", "ms", "us", "ns", "ps", "m", "km", "cm", "mm", "ft", "deg", "rad"))
    return _Readings(grid if epochs is not None else grid[0], list(keys), named)


def _no_dates(word: str, values: Array) -> Array:
    """Return missing dates in the place of missing numbers; numbers beside dates are refused."""
    if not np.isnan(values).all():
        raise InvalidProblem("some instants are dates, and others are numbers", word, "give all as one or the other")
    return np.full(values.shape, np.datetime64("NaT", "ns"))


def _numbers(word: str, values: Any) -> Array:
    """Return values as an array of numbers or dates; None is NaN."""
    try:
        array = np.asarray(values)
        if array.dtype.kind in "OSU":
            array = np.where(array == None, np.nan, array).astype(float)  # noqa: E711  (of every entry)
    except (TypeError, ValueError):
        array = np.zeros(0, dtype=bool)
    if array.dtype.kind not in "iufM" or (array.dtype.kind == "M" and word != "toa"):
        raise InvalidProblem("these are not numbers", word, "give numbers, NaN where there is none")
    return array


def _rows(word: str, found: _Readings, sigma: float, unit: Conversion, places: _Receivers, speed: float) -> Measured:
    """Return readings in SI units as rows."""
    kind = _WORDS[word].kind
    a, b = np.array(found.keys, dtype=np.int64).T
    values = found.values
    if word == "toa":
        # Dates become seconds, whatever the unit of sigma is.
        unit = conversion("s", "length", propagation_speed=speed) if values.dtype.kind == "M" else unit
        values = _since_first(values, sigma, unit)
    z = np.asarray(unit.to_si(values), dtype=float)
    heard = np.isfinite(z)
    if np.isinf(z).any():
        raise InvalidProblem("a value is infinite", word, "use NaN where there is none")
    if word in ("toa", "tdoa"):
        _check_far(word, z, sigma, places)
    own = {"weight": heard.astype(float), "a": a, "b": None if word != "tdoa" else b}
    # Differences to one station share its error: half of the variance of each is that of either arrival. Of pairs that
    # close loops this claims the least: what follows from the others says nothing more.
    noise = {"arrival_sigma": sigma / np.sqrt(2.0)} if word == "tdoa" else {"sigma": sigma}
    return measured(kind, np.where(heard, z, 0.0), **own, **noise)


def _from_north(made: Measured, north: _North, unit: str, places: _Receivers) -> Measured:
    """Return rows of bearings with the declination of magnetic north, and the sense in which they are counted."""
    rows, east = made.rows.clockwise() if north.azimuth == COMPASS else made.rows, north.declination
    if east is None:
        return replace(made, rows=rows)
    if isinstance(east, bool) or not isinstance(east, str | date | float | int | np.number):
        what = f"{type(east).__name__} is no declination"
        raise InvalidProblem(what, "declination", 'give a number, "4 deg", or a date such as "2026-06-01"')
    day = date_of(east, "declination")
    if day is None:
        amount = angle_of(str(east), unit, "declination")
        return replace(made, rows=replace(rows, correction=rows.correction + amount))
    each = declinations(places.stations.position[0], places.frame, day, "declination")
    return replace(made, rows=replace(rows, correction=rows.correction + each[rows.a]))


def _since_first(times: Array, sigma: float, unit: Conversion) -> Array:
    """Return times counted from the first arrival, in their unit (dates in seconds), before any digit is lost."""
    if times.dtype.kind == "M":
        known = ~np.isnat(times)
        counted = times.astype("datetime64[ns]").astype(np.int64)
        first = np.where(known, counted, np.iinfo(np.int64).max).min(-1, keepdims=True)
        return np.where(known, (counted - first) * 1e-9, np.nan)
    if times.dtype.kind in "iu":
        return np.asarray((times - times.min(-1, keepdims=True)).astype(float))
    coarse = np.spacing(np.nanmax(np.abs(times))) * unit.factor if np.isfinite(times).any() else 0.0
    if coarse > _STEP * sigma:
        what = f"these instants are rounded to {coarse:.3g} m of the way, more than their sigma tells"
        advice = "give whole nanoseconds with unit='ns', numpy.datetime64, or times since a recent instant"
        raise InvalidProblem(what, "toa", advice)
    with np.errstate(all="ignore"):
        return np.asarray(
            times - np.nanmin(np.where(np.isfinite(times).any(-1, keepdims=True), times, 0.0), axis=-1, keepdims=True)
        )


def _check_far(word: str, z: Array, sigma: float, places: _Receivers) -> None:
    """Refuse times that no signal takes between stations: they have another unit."""
    most = float(np.nanmax(np.abs(z), initial=0.0))
    if most > _TOO_FAR * max(places.extent, sigma):
        what = f"the arrivals are {most / 1e3:.3g} km apart, and the stations {places.extent / 1e3:.3g} km"
        raise InvalidProblem(what, word, "say the unit of the times, such as unit='ns', or correct them")
