"""Tables of satellites: pseudoranges with positions at transmission, GNSS receiver files, orbits at given times."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import ECEF
from optloc.base.inputs import check_budget
from optloc.base.types import Array
from optloc.base.units import UNITS
from optloc.files.cell_text import column_times, date_texts, is_dated
from optloc.files.columns import PLACE, unit_of
from optloc.files.csv_formats import read_table
from optloc.files.orbits import read_orbits
from optloc.files.pseudoranges import at_reception, received
from optloc.files.reading_report import unused_columns
from optloc.files.roles import ColumnPlaces, Roles, check_column_hints, places_of, scaled
from optloc.files.settings import Units
from optloc.files.shapes import epoch_lines, sigma_column, sigma_of
from optloc.files.table_import import ColumnHints, sort_named
from optloc.files.table_problem import Converted, Section, TableProblem, no_sigma
from optloc.files.words import distinct
from optloc.files.writer import write_csv

# A satellite is farther from the centre of the Earth than this radius, m; a smaller distance means a wrong unit.
_SURFACE = 6.4e6
# Comment on satellites in a problem file, and the note on satellites that were rotated.
AT_RECEPTION = ("# Satellite positions are at transmission, in the Earth axes at reception.",)
_ROTATED_NOTE = "satellite positions are rotated with the Earth during the signal flight; --turned uses them unchanged"


def pseudoranges(source: Path, roles: Roles, hints: ColumnHints) -> TableProblem:
    """Return the problem of a pseudorange table: arrivals with a clock error per epoch, moving satellites in ECEF.

    `roles` has the table and the roles of its columns. `hints` has the options: unless `--turned` is stated, satellite
    positions are rotated with the Earth during the signal flight.
    """
    form = sort_named("arrivals")
    sigma_of_rows = sigma_column(roles, form, hints, [form])
    if hints.sigma is None and sigma_of_rows is None:
        raise no_sigma("2 m")
    by = "message" if roles.find("message") is not None else "time"
    epoch, satellite, z = roles.labels(by), roles.labels("satellite"), roles.numbers("toa")
    unit = hints.unit or unit_of(roles.column("toa"), UNITS["length"]) or "m"
    Units("length").conversion(unit, "--unit")
    length = unit_of(roles.column("x"), UNITS["length"]) or "m"
    place = np.stack([scaled(roles, axis, "length", length) for axis in "xyz"], axis=-1)
    _check_far(roles, place * UNITS["length"][length])
    _check_once(roles, epoch, satellite)
    notes = roles.table.notes
    if not hints.turned:
        metres, ranges = place * UNITS["length"][length], Units("length").conversion(unit, "--unit").to_si(z)
        place = at_reception(source, epoch, metres, ranges) / UNITS["length"][length]
        notes += (_ROTATED_NOTE,)
    columns = {"epoch": epoch, "a": satellite, "z": z}  # each satellite is a station
    when = roles.find("time")
    if when is not None:
        seconds = column_times(roles, when, hints.zone, hints.time_unit, hints.time_scale)
        known = roles.numbers("time") if seconds is None else seconds
        columns["time"] = date_texts(known) if is_dated(roles.table, when) else known
    after = epoch_lines(hints, columns, roles.table.source)
    uses = {roles.column(role): role for role in ("satellite", "toa", *"xyz")}
    uses |= dict.fromkeys(roles.column(by).split("+"), by) | ({} if when is None else {when: "time"})
    if sigma_of_rows is not None:
        columns["sigma"] = sigma_of(roles.table, sigma_of_rows, form, unit, np.arange(len(z)))
        uses[sigma_of_rows] = "sigma_toa"
    rest = unused_columns(roles, uses, (), lengths=True)
    satellites = {"name": satellite, "epoch": epoch} | dict(zip("xyz", place.T, strict=True))
    section = Section("toa", columns, unit, hints.sigma, "the range and the receiver's clock")
    when_ = "reception" if hints.turned else "transmission"
    read = [
        ("pseudoranges", f"{len(z)} readings in {unit} from {roles.column('toa')}, with a clock of each epoch"),
        ("epochs", f"{len(set(epoch.tolist()))} by column {roles.column(by)}"),
        ("satellites", f"{len(set(satellite.tolist()))} at x, y, z in {length}, in ECEF axes at {when_}"),
    ]
    read += [("sigma", f"of pseudoranges, from column {sigma_of_rows}")] if "sigma" in columns else []
    read += [("not used", ", ".join(rest))] if rest else []
    places = ColumnPlaces(satellites, "ecef", length)
    return TableProblem(source, (section,), places, tuple(read), notes, AT_RECEPTION, after, uses=uses)


def gnss(source: Path, hints: ColumnHints) -> TableProblem:
    """Return the problem of a GNSS receiver file, in the same form as for a pseudorange table."""
    if hints.columns or hints.ignore:
        flag = "--column" if hints.columns else "--ignore"
        raise InvalidProblem(f"{source.name} has no column names", flag, "remove this option")
    found = received(source, hints.navigation, hints.sigma, system=hints.system, mask=hints.mask)
    columns = {"epoch": found.epoch, "time": found.time, "a": found.satellite, "z": np.round(found.z, 4)}
    columns["sigma"] = np.round(found.sigma, 3)
    places = {"name": found.satellite, "epoch": found.epoch} | dict(zip("xyz", np.round(found.place, 4).T, strict=True))
    section = Section("toa", columns, "m", None, "the range and the receiver's clock")
    after = ("", "[epochs]", 'time_scale = "gps"')
    stations = ColumnPlaces(places, "ecef", "m")
    return TableProblem(source, (section,), stations, found.about, found.notes, AT_RECEPTION, after)


def _check_once(roles: Roles, epoch: Array, satellite: Array) -> None:
    """Raise InvalidProblem for a satellite that occurs twice in an epoch."""
    seen: dict[tuple[str, str], int] = {}
    for row, key in enumerate(zip(epoch.tolist(), satellite.tolist(), strict=True)):
        if key in seen:
            what = f"satellite {key[1]!r} occurs again at epoch {key[0]!r}, first in row {seen[key] + 1}"
            raise InvalidProblem(what, roles.table.at(row), "remove one of them")
        seen[key] = row


def _check_far(roles: Roles, place: np.ndarray) -> None:
    """Raise InvalidProblem for a satellite inside the Earth, which means a wrong unit or wrong columns.

    `place` (m, 3) are the positions in ECEF, m.
    """
    near = np.flatnonzero(np.linalg.norm(place, axis=-1) < _SURFACE)
    if len(near):
        where = roles.table.where(roles.column("x"), int(near[0]))
        away = np.linalg.norm(place[near[0]]) / 1e3
        what = f"the satellite is {away:.4g} km from the centre of the Earth"
        raise InvalidProblem(
            what, where, "state the columns with --column x=NAME and so on; a name such as x_km states the unit"
        )


# Orbits at the times of measurements.


def write_satellites(
    source: Path, out: Path, stated: Mapping[str, str], times: Path | None, stations: Path | None
) -> Converted:
    """Write positions and velocities of satellites at the times of measurements, as a table of stations in ECEF.

    `source` has the orbits and `times` the measurements. `stated` has the stated columns by role. `stations` has fixed
    stations, which are added at each time with zero velocity; None for no fixed stations. If the measurements name
    satellites, each satellite is written at its own times. Otherwise all satellites are written at all times.
    """
    if times is None:
        advice = "give the table of the measurements with --times; it needs times, and may have satellites"
        raise InvalidProblem("the times of the satellite positions are unknown", "--times", advice)
    if out.suffix.lower() != ".csv":
        what = "satellites are moving stations, which are written as a CSV table"
        raise InvalidProblem(what, str(out), "use the ending .csv after --out")
    stated_columns = {role: name for role, name in stated.items() if stations is None or role not in PLACE}
    orbits, roles = read_orbits(source), Roles.of(read_table(times), stated_columns)
    check_column_hints(roles, ("time", "satellite"))
    written, seconds = roles.table.raw(roles.column("time")), roles.table.times(roles.column("time"), 1.0)
    satellite_of_row = roles.labels("satellite") if roles.find("satellite") is not None else None
    wanted = distinct(satellite_of_row)[0] if satellite_of_row is not None else list(orbits.courses)
    check_budget("cells", 7 * len(wanted) * len(seconds), roles.table.source)
    parts: list[tuple[Array, ...]] = []
    for name in wanted:
        rows = np.arange(len(seconds)) if satellite_of_row is None else np.flatnonzero(satellite_of_row == name)
        rows = rows[np.unique(seconds[rows], return_index=True)[1]]  # one row for each distinct time
        parts.append((np.full(len(rows), name, dtype=object), rows, *orbits.at(name, seconds[rows])))
    rows = np.unique(seconds, return_index=True)[1]
    for name, place in _fixed_stations(stations, stated).items():
        still = np.zeros((len(rows), 3))
        parts.append((np.full(len(rows), name, dtype=object), rows, place + still, still))
    names, rows, position, velocity = (np.concatenate(part) for part in zip(*parts, strict=True))
    columns = {"name": names, "time": written[rows]} | dict(zip("xyz", position.T, strict=True))
    write_csv(out, columns | dict(zip(("vx", "vy", "vz"), velocity.T, strict=True)))
    return Converted((out,), None, ('positions are in ECEF: write kind = "ecef" in [frame]',))


def _fixed_stations(path: Path | None, stated: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return the ECEF positions (3,) of fixed stations by name, m; empty without a file."""
    if path is None:
        return {}
    stated_columns = {role: name for role, name in stated.items() if role in PLACE}
    place = places_of(path, stated_columns, "ecef")
    columns, scale = place.columns, UNITS["length"][place.unit]
    if place.frame == "geodetic":
        lat, lon = np.radians(columns["lat_deg"]), np.radians(columns["lon_deg"])
        found = ECEF.from_geodetic(lat, lon, scale * columns["height"], where=path.name, first_row=1)
    elif "z" in columns:
        found = scale * np.stack([columns[axis] for axis in "xyz"], axis=-1)
    else:
        raise InvalidProblem(
            "stations have no z, which satellites need", path.name, "give x, y and z, or latitude and longitude"
        )
    return dict(zip(place.names, found, strict=True))
