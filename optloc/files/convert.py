"""Common inputs as a problem file with CSV tables beside it: arrival times, pseudoranges, stations, satellites."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.frames import ECEF
from optloc.base.inputs import at_most
from optloc.base.outputs import claim, together, write_text
from optloc.base.types import Array
from optloc.base.units import UNITS
from optloc.files.orbits import read_orbits
from optloc.files.reader import Loaded, read
from optloc.files.roles import GEOJSON, GUESSES, Places, Roles, places_of, read_table, stem, unit_of
from optloc.files.schema import Units
from optloc.files.table import distinct
from optloc.files.writer import write_csv

INPUTS = ("arrivals", "pseudoranges", "stations")

# Nothing is nearer to the centre of the Earth than its poles but what has another unit, metres.
_SURFACE = 6.4e6
# What files of orbits are called; where times are given, any file is one.
_ORBITS = (".tle", ".2le", ".3le", ".sp3", ".omm")
# Arrivals that place a target in the plane; of fewer the user is told.
_FEW = 3


@dataclass(frozen=True, slots=True)
class Measured:
    """The columns (m,) of a measurements table, their unit, what they are, and what had to be assumed."""

    columns: Mapping[str, Any]
    unit: str
    comment: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Converted:
    """What was written, the problem that it is (None of stations alone), and what had to be assumed."""

    written: tuple[Path, ...]
    loaded: Loaded | None
    notes: tuple[str, ...] = ()


def convert(
    source: Path,
    out: Path,
    *,
    stations: Path | None = None,
    sigma: str | None = None,
    what: str | None = None,
    columns: Mapping[str, str] | None = None,
    unit: str | None = None,
    frame: str | None = None,
    times: Path | None = None,
) -> Converted:
    """Write a table as a problem file.

    Parameters
    ----------
    source : Path
        Arrival times or pseudoranges as CSV or Parquet; or stations, as such a table or as GeoJSON; or orbits of
        satellites, as two-line elements, OMM (JSON, CSV) or SP3.
    out : Path
        Problem file to write, .toml; its tables go to CSV files beside it. Of stations alone: the CSV file.
    stations : Path, optional
        Where the stations of arrival times are: CSV, Parquet or GeoJSON. Beside orbits: stations that stay.
    sigma : str, optional
        Standard deviation of each row with its unit, such as "20 ns"; "estimate" finds it from many epochs.
    what : "arrivals", "pseudoranges" or "stations", optional
        What `source` holds; by default what its columns suggest.
    columns : mapping of str to str, optional
        Column of each role that is not found by its name: "message", "station", "time", "epoch", "satellite",
        "pseudorange", "name", "x", "y", "z", "lat", "lon", "height". "set+msg" puts two columns together.
    unit : str, optional
        Unit of the values; by default what the column's name ends in, else s of times and m of pseudoranges.
    frame : "cartesian" or "ecef", optional
        Frame of stations in x, y, z; cartesian by default.
    times : Path, optional
        Table of the measurements, whose times (dates, or seconds since 1970; UTC) satellites are wanted at, and whose
        column of satellites, where it has one, says which.

    Returns
    -------
    Converted
        The files, and the problem as it is read back from them.

    Raises
    ------
    InvalidProblem
        Naming the file, the row and the column.
    """
    told = dict(columns or {})
    for role in told:
        if role not in GUESSES:
            raise InvalidProblem(f"there is no role {role!r}", "--column", nearest(role, GUESSES))
    if frame not in (None, "cartesian", "ecef"):
        raise InvalidProblem(f"there is no frame {frame!r}", "--frame", nearest(str(frame), ("cartesian", "ecef")))
    if what is not None and what not in INPUTS:
        raise InvalidProblem(f"there is no input {what!r}", "--as", nearest(what, INPUTS))
    claim(out, *_tables(out), inputs=[source, *(path for path in (stations, times) if path)])
    if times is not None or source.suffix.lower() in _ORBITS:
        return _write_satellites(source, out, told, times, stations)
    if what == "stations" or source.suffix.lower() in GEOJSON:
        return _write_stations(source, out, told, frame)
    if out.suffix.lower() != ".toml":
        raise InvalidProblem("the problem file must end in .toml", str(out), "let the name behind --out end in it")
    roles = Roles(read_table(source), told)
    seen = what or _recognise(roles)
    if seen == "stations":
        return _write_stations(source, out, told, frame)
    if sigma is None:
        advice = "say it with --sigma '20 ns' (or metres); --sigma estimate finds it from many epochs"
        raise InvalidProblem("nothing is known of how accurate the rows are", "--sigma", advice)
    if seen == "arrivals":
        if stations is None:
            advice = "name a table or GeoJSON file with --stations"
            raise InvalidProblem("nothing is known of where the stations are", "--stations", advice)
        own = {role: name for role, name in told.items() if role in ("name", "x", "y", "z", "lat", "lon", "height")}
        place = places_of(stations, own, frame)
        found = arrivals(roles, place.names, stations.name, unit)
    else:
        found, place = pseudoranges(roles, unit)
    return _write(source, out, found, place, sigma)


def _recognise(roles: Roles) -> str:
    """Return what a table holds by its columns; raise InvalidProblem where they do not tell."""
    if roles.find("pseudorange") is not None and roles.find("satellite") is not None:
        return "pseudoranges"
    if roles.find("station") is not None and roles.find("time") is not None:
        return "arrivals"
    what = f"the columns {', '.join(roles.table.columns)} do not tell what this is"
    advice = f"say it with --as {', --as '.join(INPUTS)}, and name columns with --column ROLE=NAME"
    raise InvalidProblem(what, roles.table.source, advice)


def _write_stations(source: Path, out: Path, told: Mapping[str, str], frame: str | None) -> Converted:
    if out.suffix.lower() != ".csv":
        what = "stations alone are no problem: they become a CSV table"
        raise InvalidProblem(what, str(out), "let the name behind --out end in .csv, or convert the measurements")
    found = places_of(source, told, frame)
    write_csv(out, found.columns)
    return Converted((out,), None, (found.note,) if found.note else ())


def _write_satellites(
    source: Path, out: Path, told: Mapping[str, str], times: Path | None, stations: Path | None
) -> Converted:
    """Write where satellites are at the times of measurements, and with which velocity, as a table of stations."""
    if times is None:
        advice = "name the table of the measurements with --times: its times, and its satellites if it has them"
        raise InvalidProblem("nothing is known of when the satellites are wanted", "--times", advice)
    if out.suffix.lower() != ".csv":
        what = "satellites are stations that move: they become a CSV table"
        raise InvalidProblem(what, str(out), "let the name behind --out end in .csv")
    orbits, roles = read_orbits(source), Roles(read_table(times), told)
    written, seconds = roles.table.raw(roles.column("time")), roles.table.times(roles.column("time"), 1.0)
    whose = roles.labels("satellite") if roles.find("satellite") is not None else None
    wanted = distinct(whose)[0] if whose is not None else list(orbits.courses)
    at_most("cells", 7 * len(wanted) * len(seconds), roles.table.source)
    parts: list[tuple[Array, ...]] = []
    for name in wanted:
        rows = np.arange(len(seconds)) if whose is None else np.flatnonzero(whose == name)
        rows = rows[np.unique(seconds[rows], return_index=True)[1]]
        parts.append((np.full(len(rows), name, dtype=object), rows, *orbits.at(name, seconds[rows])))
    rows = np.unique(seconds, return_index=True)[1]
    for name, place in _resting(stations, told).items():
        still = np.zeros((len(rows), 3))
        parts.append((np.full(len(rows), name, dtype=object), rows, place + still, still))
    names, rows, position, velocity = (np.concatenate(part) for part in zip(*parts, strict=True))
    columns = {"name": names, "time": written[rows]} | dict(zip("xyz", position.T, strict=True))
    write_csv(out, columns | dict(zip(("vx", "vy", "vz"), velocity.T, strict=True)))
    return Converted((out,), None, ('positions are along ECEF: write kind = "ecef" in [frame]',))


def _resting(path: Path | None, told: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return where stations on the ground are in ECEF, by name."""
    if path is None:
        return {}
    own = {role: name for role, name in told.items() if role in ("name", "x", "y", "z", "lat", "lon", "height")}
    place = places_of(path, own, "ecef")
    held, scale = place.columns, UNITS["length"][place.unit]
    if place.frame == "geodetic":
        lat, lon = np.radians(held["lat_deg"]), np.radians(held["lon_deg"])
        found = ECEF.from_geodetic(lat, lon, scale * held["height"], where=path.name, first_row=1)
    elif "z" in held:
        found = scale * np.stack([held[axis] for axis in "xyz"], axis=-1)
    else:
        raise InvalidProblem("stations beside satellites have x, y and z", path.name, "or latitude and longitude")
    return dict(zip(place.names, found, strict=True))


def _tables(out: Path) -> tuple[Path, ...]:
    """Return the names of the tables beside a problem file; stations alone have none."""
    names = ("stations", "rows") if out.suffix.lower() == ".toml" else ()
    return tuple(out.with_name(f"{out.stem}-{name}.csv") for name in names)


def _write(source: Path, out: Path, found: Measured, place: Places, sigma: str) -> Converted:
    tables = dict(zip(_tables(out), (place.columns, found.columns), strict=True))
    # JSON spells strings as TOML does, but for signs beyond 16 bits, which stay as they are.
    quoted = partial(json.dumps, ensure_ascii=False)
    one, two = (quoted(path.name) for path in tables)
    text = f"""# Made from {quoted(source.name)} by optloc convert.
format = 1
title = {quoted(source.stem)}

[frame]
kind = "{place.frame}"

[stations]
file = {one}
unit = "{place.unit}"

[[measurements]]
kind = "toa"                         # {found.comment}
file = {two}
unit = "{found.unit}"
sigma = {quoted(sigma)}
"""
    # Read before it is there: what cannot be read is not written.
    with TemporaryDirectory() as folder:
        _lay(text, tables, Path(folder) / out.name)
        loaded = read(Path(folder) / out.name)
    _lay(text, tables, out)
    notes = (*found.notes, *((place.note,) if place.note else ()))
    return Converted((out, *tables), loaded, notes)


def _lay(text: str, tables: Mapping[Path, Mapping[str, Any]], out: Path) -> None:
    """Write a problem file with its tables beside it."""
    with together():
        for path, columns in tables.items():
            write_csv(out.with_name(path.name), columns)
        write_text(out, text)


# A table of arrival times: which station heard which message when.


def arrivals(roles: Roles, stations: Sequence[str], where: str, unit: str | None) -> Measured:
    """Return arrivals, each counted from the first of its message so that no digit is lost.

    Parameters
    ----------
    roles : Roles
        The table: message, station, time.
    stations : sequence of str
        Names of the known stations.
    where : str
        Where these are known from.
    unit : str, optional
        Of the times; by default what the column's name ends in, else seconds.
    """
    message, heard, times = roles.labels("message"), roles.labels("station"), roles.exact("time")
    named = roles.column("time")
    stated = unit or unit_of(named, UNITS["time"])
    unit = stated or "s"
    factor = Decimal(repr(float(Units("time").conversion(unit, "--unit").factor)))
    known = set(stations)
    for row, name in enumerate(heard.tolist()):
        if name not in known:
            place = roles.table.where(roles.column("station"), row)
            raise InvalidProblem(f"there is no station {name!r} in {where}", place, nearest(name, stations))
    advice = "leave one of them out, or put columns together: --column message=ONE+TWO"
    _check_once(roles, message, heard, "station {1!r} hears message {0!r} again, first in row {2}", advice)
    # Seconds of today in nanoseconds have 19 digits, a float 16: differences are taken before anything is rounded.
    first: dict[str, Decimal] = {}
    for label, time in zip(message.tolist(), times, strict=True):
        first[label] = min(time, first.get(label, time))
    columns = {
        "epoch": message,
        "time": [float(first[label] * factor) for label in message.tolist()],
        "a": heard,
        "z": [f"{time - first[label]:f}" for label, time in zip(message.tolist(), times, strict=True)],
    }
    lone = np.unique(message, return_counts=True)[1]
    few = int((lone < _FEW).sum())
    assumed = () if stated else (f"the column {named!r} is taken to be in seconds; --unit says another",)
    notes = (f"{few} of {len(lone)} messages were heard by fewer than three stations",) if few else ()
    return Measured(columns, unit, "arrivals, counted from the first of each message", (*assumed, *notes))


def _check_once(roles: Roles, group: Array, member: Array, what: str, advice: str) -> None:
    """Refuse a member that a group has twice; {0}, {1} and {2} of `what` are both names and the first row."""
    seen: dict[tuple[str, str], int] = {}
    for row, key in enumerate(zip(group.tolist(), member.tolist(), strict=True)):
        if key in seen:
            raise InvalidProblem(what.format(*key, seen[key] + 1), roles.table.at(row), advice)
        seen[key] = row


# A table of pseudoranges: which satellite was received when, from where, and how far it seemed.


def pseudoranges(roles: Roles, unit: str | None) -> tuple[Measured, Places]:
    """Return pseudoranges as arrivals with a clock of each epoch, and the satellites as stations that move, in ECEF."""
    epoch, satellite, z = roles.labels("epoch"), roles.labels("satellite"), roles.numbers("pseudorange")
    unit = unit or unit_of(roles.column("pseudorange"), UNITS["length"]) or "m"
    Units("length").conversion(unit, "--unit")
    length = unit_of(roles.column("x"), UNITS["length"]) or "m"
    place = np.stack([roles.numbers(axis) for axis in "xyz"], axis=-1)
    _check_far(roles, place * UNITS["length"][length])
    advice = "leave one of them out"
    _check_once(roles, epoch, satellite, "satellite {1!r} occurs again at epoch {0!r}, first in row {2}", advice)
    columns = {"epoch": epoch, "a": satellite, "z": z}
    if stem(roles.column("epoch")) != "epoch" and "+" not in roles.column("epoch"):
        columns["time"] = roles.numbers("epoch")
    satellites = {"name": satellite, "epoch": epoch} | dict(zip("xyz", place.T, strict=True))
    return Measured(columns, unit, "the range and the receiver's clock"), Places(satellites, "ecef", length)


def _check_far(roles: Roles, place: np.ndarray) -> None:
    """Raise InvalidProblem where a satellite is within the Earth: its unit or its columns are other ones."""
    near = np.flatnonzero(np.linalg.norm(place, axis=-1) < _SURFACE)
    if len(near):
        where = roles.table.where(roles.column("x"), int(near[0]))
        away = np.linalg.norm(place[near[0]]) / 1e3
        what = f"the satellite is {away:.4g} km from the centre of the Earth"
        raise InvalidProblem(what, where, "name the columns with --column x=NAME and so on; a unit is seen from x_km")
