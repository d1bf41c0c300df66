"""Roles of the columns of a table, stated by the user or found by name, and alternative names in problem files.

Also: stations from tables and from GeoJSON.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite, nan
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.inputs import json_of, read_text
from optloc.base.types import Array
from optloc.base.units import LARGEST, UNITS
from optloc.files.columns import PLACE, any_unit, check_unit, rank, role_named, role_of, stem, unit_of
from optloc.files.csv_formats import read_table, records
from optloc.files.lone_columns import names_stations
from optloc.files.schema import MeasurementsTable, ProblemFile
from optloc.files.settings import join
from optloc.files.table import Table
from optloc.files.words import Words, equal_rows, numbered, objects
from optloc.models import BEARING, MODELS, kind_named

WORDS = {
    "name": "name station receiver rx sensor anchor beacon id site callsign node stationid receiverid sensorid",
    "lat_deg": "lat latitude",
    "lon_deg": "lon long lng longitude",
    "height": "height h alt altitude elevation ellipsoidalheight",
    "a": "a station receiver rx sensor anchor node site stationa receivera station1 receiver1 rx1",
    "b": "b reference ref stationb receiverb station2 receiver2 rx2",
    "z": "z value measured measurement",
}
"""Alternative names of the required columns of problem files, the most likely first; in lower case, without unit and
punctuation. A column of measured values may also have the name of its kind (`optloc.models.Model.aliases`). Optional
columns have no alternative names: an unrelated column must not change the meaning of a table."""

GEOJSON = (".geojson", ".json")
# Properties of a GeoJSON point that may be its name or its height, the most likely first.
_NAMES = ("name", "station", "title", "callsign", "id", "receiver", "sensor")
_HEIGHTS = ("height", "height_m", "altitude", "alt", "elevation", "ele", "h_m", "h")
_NO_HEIGHTS = "no heights are given: all stations are assumed at height 0; add a column height"


@dataclass(frozen=True, slots=True)
class Roles:
    """The columns of a table by role; a column has at most one role.

    Parameters
    ----------
    table : Table
        The table.
    by_role : mapping of str to str
        Column of each role; "+" joins several columns to one label.
    stated : frozenset of str
        Roles that the user stated.
    """

    table: Table
    by_role: Mapping[str, str]
    stated: frozenset[str] = frozenset()

    @classmethod
    def of(cls, table: Table, stated: Mapping[str, str], readings: Collection[str] = ()) -> Roles:
        """Return the roles of a table: stated by the user, then suggested by column names.

        `stated` has columns by role, or by another word for the role. `readings` are the columns of receiver readings,
        which have no other role. Raise InvalidProblem for an unknown role or column, a unit that does not fit, and a
        column with two roles.
        """
        given = _stated_columns(table, stated)
        used = {part for name in given.values() for part in name.split("+")} | set(readings)
        found: dict[str, str] = {}
        for column in table.columns:
            role = None if column in used else role_of(column)
            if role is not None and (role not in found or rank(role, column) < rank(role, found[role])):
                found[role] = column
        return cls(table, found | given, frozenset(given))

    def find(self, role: str) -> str | None:
        """Return the column of a role, or None.

        A column of another role may replace it: a station can be named in the column `id`, for instance.
        """
        if role == "name" and stem(self.by_role.get("name", "")) != "name" and "name" not in self.stated:
            role = "station"  # a callsign names a station only if no other column does
        if role in self.by_role:
            return self.by_role[role]
        if role in ("station", "name"):
            return next((self.by_role[other] for other in _NAMES_STATION if other in self.by_role), None)
        # An `id` is the label of a message if another column names the station.
        if role == "message" and any(other in self.by_role for other in _NAMES_STATION[:-1]):
            return self.by_role.get("id")
        return None

    def without_stations(self) -> Roles:
        """Return the roles of a table whose columns are named after stations.

        An `id` is then the label of a message.
        """
        kept = {role: name for role, name in self.by_role.items() if role not in (*_NAMES_STATION, "reference")}
        if "id" in self.by_role:
            kept = {"message": self.by_role["id"], **kept}
        return replace(self, by_role=kept)

    def column(self, role: str) -> str:
        """Return the column of a role; raise InvalidProblem without one."""
        found = self.find(role)
        if found is None:
            columns = ", ".join(self.table.columns)
            advice = f"state it with --column {role}=NAME; the columns are {columns}"
            raise InvalidProblem(f"no column looks like the {role}", self.table.source, advice)
        return found

    def labels(self, role: str) -> Array:
        """Return labels (m,) of a role; labels of several columns are joined by "-"."""
        parts = [self.table.labels(part) for part in self.column(role).split("+")]
        if len(parts) == 1:
            return parts[0]
        first, index = equal_rows(parts, self.table.count)
        joined = ["-".join(row) for row in zip(*(part[first] for part in parts), strict=True)]
        return cast("Array", Words(first, index).renamed(joined))  # for type checkers, Words is an array

    def numbers(self, role: str) -> Array:
        """Return finite numbers (m,)."""
        return self.table.numbers(self.column(role))


# Roles whose columns can name the station of a row, the most likely first.
_NAMES_STATION = ("station", "name", "id")


def _stated_columns(table: Table, stated: Mapping[str, str]) -> dict[str, str]:
    """Return the columns that the user states, by role.

    Raise InvalidProblem for a column that does not fit its role.
    """
    given: dict[str, str] = {}
    owner: dict[str, str] = {}
    for word, name in stated.items():
        role = role_named(word)
        role = _epoch_role(name) if role == "epoch" else role
        if role in given:
            what = f"the role {role} is given to two columns, {given[role]!r} and {name!r}"
            raise InvalidProblem(what, "--column", "state one column; ONE+TWO joins two columns to one label")
        for part in name.split("+"):
            if part not in table.columns:
                what = f"there is no column {part!r} for the {word}"
                raise InvalidProblem(what, table.source, nearest(part, list(table.columns)))
            if part in owner:
                what = f"the column {part!r} is given two roles, {owner[part]} and {role}"
                raise InvalidProblem(what, "--column", "give the column one role")
            check_unit(role, part)
            owner[part] = role
        given[role] = name
    return given


def _epoch_role(name: str) -> str:
    """Return the role of a column that the user states as epoch: a time, or a label."""
    return "time" if role_of(name) == "time" else "message"


# Alternative names of kinds and columns in problem files, and defaults of the file format.


def with_standard_names(
    file: ProblemFile, stations: Table, tables: Sequence[Table], source: str
) -> tuple[ProblemFile, Table, list[Table]]:
    """Return a problem file and its tables with standard names of kinds and columns, and with explicit defaults.

    `tables` are the rows of each ``[[measurements]]``; `source` is the name of the settings for messages.
    """
    stations = with_standard_columns(stations, file.stations.unit)
    frame = file.frame
    if "kind" not in frame.model_fields_set and (stations.has("lat_deg") or stations.has("lon_deg")):
        frame = frame.model_copy(update={"kind": "enu" if frame.origin or frame.dimension == 2 else "geodetic"})
    compass = file.format > 1 and frame.kind != "cartesian"
    places = [join(source, f"[[measurements]] {i + 1}") for i in range(len(tables))]
    read = [
        _with_standard_rows(section, table, place, compass)
        for section, table, place in zip(file.measurements, tables, places, strict=True)
    ]
    biases = [
        b.model_copy(update={"kind": kind_named(b.kind, f"bias {b.name!r}")}) if b.kind else b for b in file.biases
    ]
    file = file.model_copy(update={"frame": frame, "measurements": [one for one, _ in read], "biases": biases})
    return file, stations, [table for _, table in read]


def with_standard_columns(table: Table, unit: str) -> Table:
    """Return a table of stations with standard column names; coordinates are converted to the unit of the table."""
    words = {key: WORDS[key] for key in ("name", "lat_deg", "lon_deg", "height")}
    found = {key: name for key, word in words.items() if (name := _column(table, word))}
    # In a table with latitudes, x is an unrelated column.
    if not any(key in found or table.has(key) for key in ("lat_deg", "lon_deg")):
        axes = {key: name for key in "xyz" if (name := _column(table, key))}
        found |= {key: name for key, name in axes.items() if any_unit(name) in (None, *UNITS["length"])}
    found = {key: name for key, name in found.items() if not table.has(key) and key not in table.names}
    # Ignore a column whose unit does not fit: latitudes in radians, or an angle with the name elevation.
    fits = {"lat_deg": ("deg",), "lon_deg": ("deg",), "height": tuple(UNITS["length"])}
    named = {key: name for key, name in found.items() if any_unit(name) in (None, *fits.get(key, (any_unit(name),)))}
    columns = dict(table.columns)
    for key in ("height", *"xyz"):
        name = named.get(key, "")
        unit_in_name = unit_of(name, UNITS["length"])
        if unit_in_name is not None and unit_in_name != unit and unit in UNITS["length"]:
            columns[name] = table.numbers(name, optional=True) * (UNITS["length"][unit_in_name] / UNITS["length"][unit])
    return replace(table, columns=columns, names={**table.names, **named})


def _with_standard_rows(
    section: MeasurementsTable, table: Table, where: str, compass: bool
) -> tuple[MeasurementsTable, Table]:
    """Return measurements with standard names of kinds and columns, and with an explicit azimuth convention.

    `where` is the place for messages. `compass` is whether azimuths without a stated convention are compass bearings.
    """
    words = [] if section.kind is None else [section.kind]  # kinds as they are written in the file
    if section.kind is None and table.has("kind"):
        words = sorted(numbered(table.labels("kind"))[0])
    places = {word: _place_of(word, section, table, where) for word in words}
    kinds = {word: kind_named(word, places[word]) for word in words}
    bearing = {word for word, kind in kinds.items() if kind == "azimuth" and word.strip().lower() == BEARING}
    changes: dict[str, Any] = {}
    if section.azimuth is None and "azimuth" in kinds.values():
        if 0 < len(bearing) < list(kinds.values()).count("azimuth"):
            what = "some azimuths have the kind bearing, and others do not"
            raise InvalidProblem(
                what, where, 'state one convention: azimuth = "north-clockwise", or "east-counterclockwise"'
            )
        changes["azimuth"] = "north-clockwise" if bearing or compass else "east-counterclockwise"
    if section.kind is None:
        # Keep a column that already has standard names: do not process millions of rows.
        if any(word != kind for word, kind in kinds.items()):
            labels = table.labels("kind")
            cells, index = numbered(labels)
            spelled = Words(objects(cells), index).renamed([kinds[word] for word in cells])
            table = replace(table, columns={**table.columns, table.name("kind"): spelled})
        return _units_by_kind(section.model_copy(update=changes)), _ends(section, table)
    changes["kind"] = kinds[section.kind]
    table, unit = _value(_ends(section, table), kinds[section.kind], where)
    if unit is not None and isinstance(section.unit, str) and section.unit != unit:
        what = f"the name of the column {table.name('z')!r} has another unit than {section.unit!r}"
        raise InvalidProblem(what, join(where, "key 'unit'"), "remove the key, or rename the column")
    if section.unit is None and (unit or bearing):
        changes["unit"] = unit or "deg"
    return _units_by_kind(section.model_copy(update=changes)), table


def _units_by_kind(section: MeasurementsTable) -> MeasurementsTable:
    """Return a section whose units by kind have standard names of the kinds."""
    if not isinstance(section.unit, dict):
        return section
    return section.model_copy(update={"unit": {kind_named(kind): unit for kind, unit in section.unit.items()}})


def _place_of(word: str, section: MeasurementsTable, table: Table, where: str) -> str:
    """Return the place of a kind for messages: the key, or the first row."""
    if section.kind is not None:
        return join(where, "key 'kind'")
    return table.where("kind", table.labels("kind").tolist().index(word))


def _ends(section: MeasurementsTable, table: Table) -> Table:
    """Return a table with standard names of its station columns, unless the section names the station."""
    found = {key: _column(table, WORDS[key]) for key in "ab" if getattr(section, key) is None and not table.has(key)}
    return replace(table, names={**{key: name for key, name in found.items() if name}, **table.names})


def _value(table: Table, kind: str, where: str) -> tuple[Table, str | None]:
    """Return a table whose values have the name z, and the unit at the end of the original column name.

    The unit is None if the column already has the name z, or has no unit.
    """
    if table.has("z") or "z" in table.names:
        return table, None
    model = MODELS[kind]
    name = _column(table, " ".join([WORDS["z"], *(stem(word) for word in (kind, *model.aliases))]))
    if name is None or (any_unit(name) is not None and unit_of(name, UNITS[model.quantity]) is None):  # type: ignore[index]
        return table, None
    return replace(table, names={**table.names, "z": name}), unit_of(name, UNITS[model.quantity])  # type: ignore[index]


def _column(table: Table, words: str) -> str | None:
    """Return the column without a role whose name is among `words`, or None."""
    taken = set(table.names.values())
    stems = {stem(name): name for name in reversed([*table.columns]) if name not in taken}
    return next((stems[word] for word in words.split() if word in stems), None)


ASSUMED = " (no convention is stated)"
"""Remark on azimuths of format 1 without a stated convention."""
_OTHER = {
    "north-clockwise": "east-counterclockwise",
    "east-counterclockwise": "north-clockwise",
    "north-counterclockwise": "north-clockwise",
}
_CONVENTION_TEXT = {
    "north-clockwise": "the compass, clockwise from north (+y)",
    "east-counterclockwise": "the axes, anticlockwise from east (+x)",
    "north-counterclockwise": "north (+y), anticlockwise",
}


def azimuths_of(written: ProblemFile, read: ProblemFile) -> str:
    """Return a text with the convention of azimuths and the setting that changes it; empty without azimuths.

    `written` are the settings of the file; `read` are the settings that `with_standard_names` returns.
    """
    texts: dict[str, None] = {}
    for before, after in zip(written.measurements, read.measurements, strict=True):
        if after.azimuth is not None:
            assumed = before.azimuth is None and str(before.kind).lower() != BEARING
            why = ASSUMED if assumed and written.format == 1 else ""
            texts[f'{_CONVENTION_TEXT[after.azimuth]}{why}; otherwise write azimuth = "{_OTHER[after.azimuth]}"'] = None
    return "; ".join(texts)


# Stations from a table or from GeoJSON points.


@dataclass(frozen=True, slots=True)
class ColumnPlaces:
    """Stations of a table.

    columns: columns of a stations table (s,), such as name, x, y, z or name, lat_deg, lon_deg, height. frame:
    "cartesian", "ecef" or "geodetic". unit: unit of lengths. note: assumptions about names and heights, or empty.
    source: name of the table, for messages; empty if it is unknown.
    """

    columns: Mapping[str, Array]
    frame: str
    unit: str = "m"
    note: str = ""
    source: str = ""

    @property
    def names(self) -> list[str]:
        """Return the names of the stations."""
        return [str(name) for name in self.columns["name"]]


def places_of(path: Path | Table, stated: Mapping[str, str], frame: str | None) -> ColumnPlaces:
    """Return the stations of a file or table; `stated` has columns by role, and `frame` applies to x, y, z."""
    if isinstance(path, Table):
        return _of_table(path, stated, frame)
    if path.suffix.lower() == ".geojson":
        return _of_geojson(json_of(read_text(path), path.name), path.name)
    if path.suffix.lower() == ".json":
        data = json_of(read_text(path), path.name)
        if isinstance(data, list) or (isinstance(data, dict) and "features" in data):
            return _of_geojson(data, path.name)
        return _of_table(records(data, path.name), stated, frame)
    return _of_table(read_table(path), stated, frame)


def _of_table(table: Table, stated: Mapping[str, str], frame: str | None) -> ColumnPlaces:
    """Return the stations of a table; arguments as for `places_of`."""
    roles, note = _with_names(Roles.of(table, stated))
    found = replace(_noted(placed(roles, frame), note), source=roles.table.source)
    _check_names(roles, found.names)
    column = roles.find("heading")
    if column is not None:
        factor = UNITS["angle"][unit_of(column, UNITS["angle"]) or "deg"] / UNITS["angle"]["deg"]
        headings = {"heading_deg": factor * roles.table.numbers(column, optional=True)}
        found = replace(found, columns={**found.columns, **headings})
    check_column_hints(roles, ("name", "heading", *place_roles(roles)))
    return found


def _check_names(roles: Roles, names: Sequence[str]) -> None:
    """Raise InvalidProblem for a station name that occurs twice in a table; `names` (s,) are the names of its rows."""
    first: dict[str, int] = {}
    for row, name in enumerate(names):
        if first.setdefault(name, row) != row:
            where = roles.table.where(roles.column("name"), row)
            raise InvalidProblem(f"the station {name!r} occurs twice", where, "give each station its own name")


def _with_names(roles: Roles) -> tuple[Roles, str]:
    """Return roles with a column of station names, and a note if no word but only its cells identify this column."""
    taken = {part for role in (*roles.stated, *PLACE) for part in roles.by_role.get(role, "").split("+")}
    column = names_stations(roles.table, taken) if roles.find("name") is None else None
    if column is None:
        return roles, ""
    kept = {role: name for role, name in roles.by_role.items() if name != column}
    note = f"the column {column!r} of {roles.table.source} has the station names; --column name=NAME states another"
    return replace(roles, by_role={**kept, "name": column}), note


def _noted(stations: ColumnPlaces, note: str) -> ColumnPlaces:
    """Return stations with one more note, which may be empty."""
    return replace(stations, note="; ".join(text for text in (stations.note, note) if text))


def place_roles(roles: Roles) -> tuple[str, ...]:
    """Return the roles of the position columns that `placed` reads, such as "lat", "lon" and "height"."""
    across, ups = (
        (("lat", "lon"), _HEIGHT_ROLES["height"]) if roles.find("lat") is not None else (("x", "y"), _HEIGHT_ROLES["z"])
    )
    return (*across, *[role for role in ups if roles.find(role) is not None][:1])


def check_column_hints(roles: Roles, used: Collection[str]) -> None:
    """Raise InvalidProblem for a stated role that is not in `used`, since a table of this form does not use it."""
    for role in sorted(roles.stated - set(used)):
        what = f"the role {role} of the column {roles.by_role[role]!r} is not used in {roles.table.source}"
        raise InvalidProblem(what, "--column", "remove it, or state the content of the table with --as")


def placed(roles: Roles, frame: str | None, names: Array | None = None) -> ColumnPlaces:
    """Return the stations of a table; raise InvalidProblem if no columns look like coordinates.

    `names` (s,) are the names of the stations; None reads them from the table. `frame` applies to x, y, z; None means
    "ecef" if the column names contain it, else "cartesian".
    """
    names = roles.labels("name") if names is None else names
    # Columns of latitude take precedence over columns x and y.
    lat, x = roles.find("lat"), roles.find("x")
    if lat is None and x is None:
        columns = ", ".join(roles.table.columns)
        advice = f"state them with --column lat=NAME or --column x=NAME; the columns are {columns}"
        raise InvalidProblem("no columns look like latitude and longitude, or x and y", roles.table.source, advice)
    if lat is not None:
        degrees = {f"{axis}_deg": scaled(roles, axis, "angle", "deg") for axis in ("lat", "lon")}
        height, unit = _heights(roles, "height")
        degrees["height"] = np.zeros(len(names)) if height is None else height
        return ColumnPlaces({"name": names} | degrees, "geodetic", unit, _NO_HEIGHTS if height is None else "")
    up, unit = _heights(roles, "z")
    assert x is not None
    unit = unit_of(x, UNITS["length"]) or "m"
    axes = {axis: scaled(roles, axis, "length", unit) for axis in "xy"}
    if up is not None:
        axes["z"] = _heights(roles, "z", unit)[0]
    # Columns with "ecef" in the name are in ECEF, so fixes have latitudes.
    return ColumnPlaces({"name": names} | axes, frame or ("ecef" if "ecef" in stem(x) else "cartesian"), unit)


def in_space(stations: ColumnPlaces) -> ColumnPlaces:
    """Return stations with a third coordinate, which is 0 if the table has none."""
    if stations.frame == "geodetic" or "z" in stations.columns:
        return stations
    flat = {"z": np.zeros(len(stations.names))}
    return _noted(replace(stations, columns={**stations.columns, **flat}), _NO_HEIGHTS.replace("height 0", "z = 0"))


def scaled(roles: Roles, role: str, quantity: Literal["length", "angle"], unit: str) -> Array:
    """Return the numbers (m,) of a role in `unit`, which is also the unit of a column name without a unit."""
    unit_in_name = unit_of(roles.column(role), UNITS[quantity]) or unit
    values = roles.numbers(role)
    return values if unit_in_name == unit else values * UNITS[quantity][unit_in_name] / UNITS[quantity][unit]


# Roles of the third coordinate, the most likely first: with latitude and longitude, and with x and y.
_HEIGHT_ROLES = {"height": ("height", "depth"), "z": ("z", "height", "depth")}


def _heights(roles: Roles, role: Literal["height", "z"], unit: str | None = None) -> tuple[Any, str]:
    """Return heights (m,) and their unit; depths become negative heights.

    The heights are None without a column. `role` is "height" with latitudes and "z" with x and y. `unit` is the unit of
    the result; None means the unit of the column, else metres.
    """
    found = next((one for one in _HEIGHT_ROLES[role] if roles.find(one) is not None), None)
    if found is None:
        return None, unit or "m"
    unit = unit or unit_of(roles.column(found), UNITS["length"]) or "m"
    values = scaled(roles, found, "length", unit)
    return (-values if found == "depth" else values), unit


def _of_geojson(data: Any, source: str) -> ColumnPlaces:
    """Return the points of a GeoJSON feature collection (RFC 7946: longitude, latitude, height above WGS 84)."""
    features = data.get("features") if isinstance(data, dict) else None
    if not isinstance(features, list):
        raise InvalidProblem("there is no list of features", source, "give a GeoJSON FeatureCollection of points")
    points = [
        _point(feature, f"{source}, feature {i + 1}")
        for i, feature in enumerate(features)
        if isinstance(feature, dict) and _geometry_type(feature) == "Point"
    ]
    if not points:
        raise InvalidProblem("there is no point among the features", source, "give each station as a Point")
    names, lon, lat, height = (list(column) for column in zip(*points, strict=True))
    columns = {"name": np.array(names, dtype=object), "lat_deg": np.array(lat), "lon_deg": np.array(lon)}
    known = [h is not None for h in height]
    columns["height"] = np.array([0.0 if h is None else h for h in height])
    lacking = (
        ""
        if all(known)
        else f"{known.count(False)} of {len(known)} points have no height: 0 is assumed; add their heights"
    )
    return ColumnPlaces(columns, "geodetic", "m", _NO_HEIGHTS if not any(known) else lacking)


def _geometry_type(feature: Mapping[str, Any]) -> Any:
    """Return the type of the geometry of a GeoJSON feature, such as "Point"; None without a geometry."""
    geometry = feature.get("geometry")
    return geometry.get("type") if isinstance(geometry, dict) else None


def _point(feature: Mapping[str, Any], where: str) -> tuple[str, float, float, float | None]:
    """Return name, longitude, latitude (degrees) and height (m) of a GeoJSON point; the height is None if missing."""
    about = feature.get("properties") or {}
    if not isinstance(about, dict):
        raise InvalidProblem("the properties are not an object", where, 'write "properties": {"name": "..."}')
    # A list or a table is not a name, and true is not a number.
    words = [about.get(key) for key in _NAMES] + [feature.get("id")]
    name = next((str(word).strip() for word in words if type(word) in (str, int, float) and str(word).strip()), None)
    if name is None:
        raise InvalidProblem("the point has no name", where, 'give it a property "name"')
    place = feature["geometry"].get("coordinates")
    number = isinstance(place, list) and all(type(v) in (int, float) and isfinite(v) for v in place)
    if not number or len(place) not in (2, 3) or abs(place[1]) > 90.0:
        raise InvalidProblem(f"{str(place)[:80]} is not a point", where, "write [longitude, latitude, height]")
    height = place[2] if len(place) == 3 else next((about[key] for key in _HEIGHTS if key in about), None)
    if height is None:
        return name, float(place[0]), float(place[1]), None
    try:
        metres = float(height)
    except (TypeError, ValueError):
        metres = nan
    if not abs(metres) <= LARGEST:
        raise InvalidProblem(f"the height {str(height)[:80]!r} is not a number", where, "give metres") from None
    return name, float(place[0]), float(place[1]), metres
