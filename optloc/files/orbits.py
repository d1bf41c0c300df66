"""Satellites as stations: ECEF positions and velocities at given times, from orbital elements or SP3 files.

SGP4 propagates two-line elements and mean elements (OMM in JSON or CSV). The library skyfield rotates the result from
the frame of date (TEME) to ECEF, with the rate of rotation. So velocities are relative to the ground. SP3 files have
ECEF positions, which are interpolated; the velocities are their derivatives.

Sources: D. A. Vallado, P. Crawford, R. Hujsak, T. S. Kelso, "Revisiting Spacetrack Report #3", AIAA 2006-6753;
S. Hilla, "The Extended Standard Product 3 Orbit Format (SP3-d)" (2016).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache, partial
from itertools import pairwise
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.inputs import Budget, access, check_budget, has_controls, json_of, read_text
from optloc.base.time_scales import tai_minus_utc
from optloc.base.types import Array, Stations
from optloc.files.table import csv, of_frame

# Largest age of an element set, days. The error of a low satellite grows by about 2 km a day, and an error of 60 km
# along the track is too large for a model of the pass.
_OLDEST = 30.0
_DAY = 86400.0
_EPOCH_1970 = 2440587.5  # Julian date of 1970-01-01
# Times per call of the rotation to ECEF: the model of the Earth's axis needs 11 kB for each.
_AT_ONCE = 4096
# Points of the interpolation of SP3 positions, points of a second one for comparison, and the permitted difference, m.
# For positions of GNSS satellites 15 minutes apart, both agree within 0.1 m, even near the ends.
_POINTS, _CHECK_POINTS, _MAX_DIFFERENCE = 10, 8, 1.0
# Relative difference of time steps above which a position is missing; less is rounding of times.
_UNEVEN = 1e-3
# Offset from the clocks of SP3 files to atomic time (TAI), s; None is UTC.
_CLOCKS = {"GPS": -19.0, "GAL": -19.0, "QZS": -19.0, "IRN": -19.0, "BDT": -33.0, "TAI": 0.0, "UTC": None, "GLO": None}
_KILOMETRE = 1e3

# Position (k, 3), m, and velocity (k, 3), m/s, at seconds (k,) since 1970 UTC.
_Course = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True, slots=True)
class Orbits:
    """The satellites of a file.

    Parameters
    ----------
    source : str
        Name of the file.
    courses : mapping of str to callable
        Function for position and velocity of each satellite at given times.
    aliases : mapping of str to str
        Name of the satellite for each catalogue number.
    """

    source: str
    courses: Mapping[str, _Course]
    aliases: Mapping[str, str]

    def at(self, name: str, seconds: Array) -> tuple[Array, Array]:
        """Return ECEF position (k, 3) and velocity (k, 3) of a satellite, metres and metres per second.

        `name` is its name or catalogue number; `seconds` (k,) are since 1970, UTC. Raise InvalidProblem for an unknown
        name, a time outside the orbit data, and invalid elements.
        """
        course = self.courses.get(self.aliases.get(name, name))
        if course is None:
            raise InvalidProblem(f"there is no satellite {name!r}", self.source, nearest(name, [*self.courses]))
        return course(seconds)


def satellites(
    path: str | Path, times: Any, names: Sequence[str] | None = None, *, budget: Budget | None = None
) -> Stations:
    """Return satellites as stations with position and velocity in ECEF.

    Parameters
    ----------
    path : str or Path
        Two-line elements, OMM as JSON or CSV, or SP3.
    times : array (k,)
        Dates (datetime64, or text in ISO 8601), or seconds since 1970; UTC.
    names : sequence of s str, optional
        Names, or catalogue numbers; by default all satellites of the file.
    budget : Budget, optional
        Limits on the size of the file.

    Returns
    -------
    Stations
        Position and velocity (k, s, 3), metres and metres per second.

    Raises
    ------
    InvalidProblem
        The message names the file and the line, or the satellite.
    """
    with access(budget=budget):
        orbits = read_orbits(Path(path))
        seconds = of_frame({"time": np.ravel(times)}, "times", {}).times("time", 1.0)
        chosen = tuple(orbits.courses if names is None else names)
        check_budget("cells", 6 * len(chosen) * len(seconds), "times")
        places = [orbits.at(name, seconds) for name in chosen]
    position, velocity = (np.stack(parts, axis=1) for parts in zip(*places, strict=True))
    return Stations(position, chosen, velocity)


def read_orbits(path: Path) -> Orbits:
    """Return the satellites of a file; the format is found from the content."""
    text = read_text(path)
    start = text.lstrip()[:1]
    if start == "<":
        raise InvalidProblem(
            "elements in XML are not supported", path.name, "save them as JSON, CSV or two-line elements"
        )
    if start == "#":
        return _sp3(text, path.name)
    if start in ("{", "["):
        return _of_elements(_json_sets(text, path.name), path.name)
    if "MEAN_MOTION" in text.partition("\n")[0]:
        return _of_elements(_csv_sets(path), path.name)
    return _of_elements(_line_sets(text, path.name), path.name)


# Orbital elements. A satellite may have several sets, from different days.


@dataclass(frozen=True, slots=True)
class _Set:
    """An element set of a satellite.

    name: name of the satellite, or empty. number: catalogue number. where: place in the file for messages. made:
    function that creates the satellite object of skyfield from the two lines or the fields of an OMM, when it is
    needed.
    """

    name: str
    number: str
    where: str
    made: Callable[[], Any]

    def satellite(self) -> Any:
        """Return the satellite object of skyfield; raise InvalidProblem for invalid elements."""
        with _as_invalid_problem(self.where):
            found = self.made()
        if found.model.error:
            raise _no_elements(self.where)
        return found


def _no_elements(where: str) -> InvalidProblem:
    """Return the error for elements that the library rejects."""
    return InvalidProblem("these are not valid elements of an orbit", where, "download them again, unchanged")


@contextmanager
def _as_invalid_problem(where: str) -> Iterator[None]:
    """Convert errors of the library to InvalidProblem."""
    try:
        yield
    except InvalidProblem:
        raise
    except KeyError as error:
        raise InvalidProblem(
            f"the element {error.args[0]} is missing", where, "download them again, unchanged"
        ) from None
    except (ValueError, TypeError, AttributeError, OverflowError, ZeroDivisionError):
        raise _no_elements(where) from None


def _of_elements(sets: Sequence[_Set], source: str) -> Orbits:
    """Return the satellites of element sets; satellites that share a name get their catalogue numbers as names."""
    if not sets:
        what = "the file has no orbits"
        raise InvalidProblem(what, source, "give two-line elements, OMM as JSON or CSV, or SP3")
    by_number: dict[str, list[_Set]] = {}
    for found in sets:
        if has_controls(found.name):
            raise InvalidProblem(f"the name {found.name!r} has control characters", found.where, "use another name")
        by_number.setdefault(found.number, []).append(found)
    name_by_number = {number: sets_of_satellite[-1].name or number for number, sets_of_satellite in by_number.items()}
    # Pieces of one launch share names such as OBJECT A; use their catalogue numbers instead.
    shared = {name for name, count in Counter(name_by_number.values()).items() if count > 1}
    names = {number: number if name in shared else name for number, name in name_by_number.items()}
    return Orbits(
        source,
        {names[number]: partial(_propagate_sets, sets_of_satellite) for number, sets_of_satellite in by_number.items()},
        names,
    )


def _propagate_sets(sets: Sequence[_Set], seconds: Array) -> tuple[Array, Array]:
    """Return ECEF positions (k, 3), m, and velocities (k, 3), m/s, from the element set with the nearest epoch.

    `seconds` (k,) are since 1970, UTC. Raise InvalidProblem for a time that is more than 30 days from all epochs.
    """
    found = [one.satellite() for one in sets]
    epochs = np.array([sat.model.jdsatepoch + sat.model.jdsatepochF for sat in found])
    age = np.abs(seconds[:, None] / _DAY + _EPOCH_1970 - epochs)
    pick = age.argmin(axis=1)
    old = np.flatnonzero(age.min(axis=1) > _OLDEST)
    if len(old):
        days = age[old[0], pick[old[0]]]
        what = f"the elements of {sets[0].name or sets[0].number!r} are {days:.0f} days from {_date(seconds[old[0]])}"
        advice = "download the elements of that day; times are dates, or seconds since 1970, UTC"
        raise InvalidProblem(what, sets[pick[old[0]]].where, advice)
    position, velocity = np.empty((len(seconds), 3)), np.empty((len(seconds), 3))
    for i in np.unique(pick).tolist():
        mine = np.flatnonzero(pick == i)
        for part in np.split(mine, range(_AT_ONCE, len(mine), _AT_ONCE)):
            position[part], velocity[part] = _propagate(found[i], seconds[part], sets[i].where)
    return position, velocity


def _propagate(satellite: Any, seconds: Array, where: str) -> tuple[Array, Array]:
    """Return ECEF position (k, 3), m, and velocity (k, 3), m/s, of a satellite object of skyfield.

    `seconds` (k,) are since 1970, UTC. Velocities are relative to the ground. Raise InvalidProblem, with the place
    `where`, if the orbit cannot be computed.
    """
    from skyfield.framelib import itrs

    found = satellite.at(_instants(seconds))
    place, rate = found.frame_xyz_and_velocity(itrs)
    position, velocity = place.m.T, rate.km_per_s.T * _KILOMETRE
    bad = np.flatnonzero(~np.isfinite(position).all(axis=1))
    if len(bad):
        why = str((found.message or {})[bad[0]]) if found.message is not None else "it has no position"
        what = f"the orbit cannot be computed at {_date(seconds[bad[0]])} ({why})"
        raise InvalidProblem(what, where, "the satellite may have decayed: remove it")
    return position, velocity


def _date(seconds: float) -> str:
    """Return a time in seconds since 1970 as text, such as 2026-06-01T12:00:00 UTC."""
    return str(np.datetime64(int(seconds), "s")) + " UTC"


@cache
def _library() -> Any:
    """Return the time scale of skyfield."""
    try:
        from skyfield.api import load
    except ImportError:
        what, advice = "orbits need the library skyfield", "pip install 'optloc[satellites]'"
        raise InvalidProblem(what, "satellites", advice) from None
    # Leap seconds and Earth rotation come with the library: nothing is downloaded.
    return load.timescale(builtin=True)


def _instants(seconds: Array) -> Any:
    """Return times in seconds since 1970, UTC, as a time object of skyfield."""
    day = np.floor(seconds / _DAY)
    return _library().utc(1970, 1, 1 + day.astype(np.int64), 0, 0, seconds - day * _DAY)


def _line_sets(text: str, source: str) -> list[_Set]:
    """Return the sets of two-line elements, each with the name in the line before, if any."""
    lines = [(i, line.rstrip()) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    sets, name = [], ""
    # Pairs of a line and the next line, each with its number; the last line is followed by an empty line.
    following = iter([*pairwise(lines), (lines[-1], (0, ""))] if lines else [])
    for (i, line), (_, after) in following:
        where = f"{source}, line {i}"
        if not line.startswith("1 "):
            if line.startswith("2 "):
                raise InvalidProblem("a second line of elements has no first line", where, "give both lines, unchanged")
            # Any other line may be a name. In a file of another format, no element lines follow.
            name = re.sub("^0 ", "", line).strip()
            continue
        if not after.startswith("2 "):
            raise InvalidProblem("a first line of elements has no second line", where, "give both lines, unchanged")
        sets.append(_Set(name, line[2:7].strip(), where, partial(_from_lines, name, line, after, where)))
        name = ""
        next(following)  # the second line of elements was used
    return sets


def _from_lines(name: str, one: str, two: str, where: str) -> Any:
    """Return the satellite object of skyfield for two lines of elements, `one` and `two`.

    Raise InvalidProblem for a wrong check digit, ValueError for columns that are not numbers.
    """
    _library()
    from sgp4.earth_gravity import wgs72
    from sgp4.io import twoline2rv, verify_checksum
    from skyfield.api import EarthSatellite

    # The fast reader accepts any text as elements, so the slow reader checks all columns first.
    try:
        verify_checksum(one, two)
    except ValueError:
        what = "the check digit at the end of a line does not match the line"
        raise InvalidProblem(what, where, "download the elements again, unchanged") from None
    twoline2rv(one, two, wgs72)
    return EarthSatellite(one, two, name or None, _library())


def _json_sets(text: str, source: str) -> list[_Set]:
    """Return the element sets of an OMM file in JSON: one message, or a list of messages."""
    data = json_of(text, source)
    messages = data if isinstance(data, list) else [data]
    check_budget("rows", len(messages), source)
    for i, fields in enumerate(messages, 1):
        if not isinstance(fields, dict):
            what = "this is not an orbit mean-elements message"
            raise InvalidProblem(what, f"{source}, message {i}", "give a list of objects with EPOCH, MEAN_MOTION ...")
    return [_of_fields(fields, f"{source}, message {i}") for i, fields in enumerate(messages, 1)]


def _csv_sets(path: Path) -> list[_Set]:
    """Return the element sets of an OMM file in CSV: one message in each row."""
    table = csv(path, None, {})
    rows = zip(*(table.columns[name] for name in table.columns), strict=True)
    found = (dict(zip(table.columns, row, strict=True)) for row in rows)
    return [_of_fields(fields, table.at(i)) for i, fields in enumerate(found)]


# Conventions of SGP4 elements; a message may state others.
_CONVENTIONS = {"REF_FRAME": "TEME", "TIME_SYSTEM": "UTC", "MEAN_ELEMENT_THEORY": "SGP4", "CENTER_NAME": "EARTH"}


def _of_fields(fields: Mapping[str, Any], where: str) -> _Set:
    """Return the element set of the fields of an OMM; raise InvalidProblem for conventions that SGP4 does not use."""
    for key, meant in _CONVENTIONS.items():
        if fields.get(key) not in (None, "", meant):
            what = f"{key} is {str(fields[key])[:40]!r}"
            raise InvalidProblem(what, where, f"only elements with {key} = {meant} are supported")
    number = str(fields.get("NORAD_CAT_ID") or "").strip()
    name = str(fields.get("OBJECT_NAME") or "").strip()
    if not (number or name):
        raise InvalidProblem("the element NORAD_CAT_ID is missing", where, "download the elements again, unchanged")
    return _Set(name, number or name, where, partial(_from_fields, fields))


def _from_fields(fields: Mapping[str, Any]) -> Any:
    """Return the satellite object of skyfield for the fields of an OMM.

    The library accepts only an epoch with a fraction of a second and without a Z.
    """
    load = _library()
    from skyfield.api import EarthSatellite

    epoch = str(fields["EPOCH"]).removesuffix("Z")
    return EarthSatellite.from_omm(load, {**fields, "EPOCH": epoch if "." in epoch else f"{epoch}.0"})


# SP3: positions at equal time steps, interpolated.


def _sp3(text: str, source: str) -> Orbits:
    """Return the satellites of an SP3 file, versions a to d."""
    clock, time = "GPS", 0.0
    times: dict[str, list[float]] = {}
    places: dict[str, list[list[float]]] = {}
    for i, line in enumerate(text.splitlines(), 1):
        where = f"{source}, line {i}"
        if i == 1 and line[1:2] not in tuple("abcd"):
            raise InvalidProblem("this is not an SP3 file of version a to d", where, "check the first two characters")
        if line.startswith("%c") and clock == "GPS" and line[9:12].strip("c "):
            clock = line[9:12]
        elif line.startswith("* "):
            time = _calendar(line, where)
        elif line.startswith("P") and line[4:].strip():
            place = [_number(line[4 + 14 * k : 18 + 14 * k], where) for k in range(3)]
            if any(place):  # zeros mean an unknown position
                name = line[1:4].strip()
                times.setdefault(name, []).append(time)
                places.setdefault(name, []).append(place)
        elif line.startswith("EOF"):
            break
    if clock not in _CLOCKS:
        raise InvalidProblem(f"the clock {clock!r} is unknown", source, f"use {', '.join(_CLOCKS)}")
    if not places:
        raise InvalidProblem("the file has no positions", source, "give a file with lines that begin with P")
    courses = {}
    for name, seconds in times.items():
        if has_controls(name) or (np.diff(seconds) <= 0.0).any():
            raise InvalidProblem(f"the times of satellite {name!r} do not increase", source, "download the file again")
        nodes = np.array(seconds), _KILOMETRE * np.array(places[name])
        courses[name] = partial(_interpolate, *nodes, _CLOCKS[clock], name, source)
    return Orbits(source, courses, {})


def _number(text: str, where: str) -> float:
    """Return a number of an SP3 file; raise InvalidProblem, with the line `where`, for other text."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    # A coordinate of 1e9 km exceeds any orbit around the Earth.
    if not (isfinite(value) and abs(value) < 1e9 and "_" not in text):
        raise InvalidProblem(f"{text.strip()[:40]!r} is not a number", where, "download the file again")
    return value


def _calendar(line: str, where: str) -> float:
    """Return the time of an SP3 epoch line as seconds since 1970, in the clock of the file.

    The line has year, month, day, hour, minute and second after "*". Leap seconds are not removed: `_interpolate`
    converts UTC to the clock of the file. Raise InvalidProblem, with the line `where`, for an invalid date.
    """
    parts = line[1:].split()
    try:
        date = datetime(*(int(part) for part in parts[:5]), tzinfo=UTC)  # type: ignore[misc,arg-type]  # five integers
    except (ValueError, TypeError):
        raise InvalidProblem("this is not a date", where, "download the file again") from None
    return date.timestamp() + _number(parts[5] if len(parts) > 5 else "", where)


def _interpolate(
    nodes: Array, places: Array, ahead: float | None, name: str, source: str, seconds: Array
) -> tuple[Array, Array]:
    """Return ECEF position (k, 3), m, and velocity (k, 3), m/s, at `seconds` (k,) since 1970, UTC.

    They are interpolated from the positions `places` (n, 3), m, at the clock times `nodes` (n,), s. `ahead` is the
    clock of the file minus TAI, s; None for UTC. Raise InvalidProblem for times outside the file, or positions that are
    too far apart in time.
    """
    at = seconds + (0.0 if ahead is None else ahead + tai_minus_utc(seconds))
    where = f"{source}, satellite {name}"
    if len(nodes) < _POINTS:
        raise InvalidProblem(f"there are {len(nodes)} positions", where, f"interpolation needs {_POINTS}")
    outside = np.flatnonzero((at < nodes[0]) | (at > nodes[-1]))
    if len(outside):
        what = f"{_date(seconds[outside[0]])} is before the first or after the last position"
        raise InvalidProblem(what, where, "use the file of that day; times are dates, or seconds since 1970, UTC")
    position, velocity = _polynomial(nodes, places, at, _POINTS, where)
    # The difference to a polynomial through fewer points estimates the error of the interpolation, m.
    off = np.linalg.norm(position - _polynomial(nodes, places, at, _CHECK_POINTS, where)[0], axis=1).max(initial=0.0)
    if off > _MAX_DIFFERENCE:
        step = float(np.diff(nodes).min())
        what = f"the positions are {step:g} s apart, so the interpolation is accurate to {off:.2g} m only"
        raise InvalidProblem(what, where, "use a file with smaller steps")
    return position, velocity


def _polynomial(nodes: Array, places: Array, at: Array, count: int, where: str) -> tuple[Array, Array]:
    """Return positions (k, 3), m, and velocities (k, 3), m/s, of polynomials through the nearest points of each time.

    `nodes` (n,) are the times of the points, s, and `places` (n, 3) their positions, m. `at` (k,) are the times of the
    result, and `count` is the number of points of a polynomial. Raise InvalidProblem if positions are missing between
    the points.
    """
    from scipy.interpolate import KroghInterpolator

    start = (np.searchsorted(nodes, at) - count // 2).clip(0, len(nodes) - count)
    position, velocity = np.empty((len(at), 3)), np.empty((len(at), 3))
    for first in np.unique(start).tolist():
        mine, times_of_points = start == first, nodes[first : first + count]
        steps = np.diff(times_of_points)
        if np.ptp(steps) > _UNEVEN * steps.min():
            raise InvalidProblem(f"positions are missing around {_date(at[mine][0])}", where, "use another file")
        # Scale time to steps from the first point: powers of seconds would lose digits.
        step = float(steps.mean())
        through = KroghInterpolator((times_of_points - times_of_points[0]) / step, places[first : first + count])
        position[mine], velocity[mine] = through.derivatives((at[mine] - times_of_points[0]) / step, 2)
        velocity[mine] /= step  # from metres per step to metres per second
    return position, velocity
