"""Stations from a table or from GeoJSON points."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optloc.convert.roles import Roles, read_table, unit_of
from optloc.errors import InvalidProblem
from optloc.files.document import read_text
from optloc.types import Array
from optloc.units import UNITS

GEOJSON = (".geojson", ".json")
_NAMES = ("name", "station", "title", "callsign", "id", "receiver", "sensor")
_HEIGHTS = ("height", "height_m", "altitude", "alt", "elevation", "ele", "h_m", "h")


@dataclass(frozen=True, slots=True)
class Places:
    """Stations: the columns of a stations table (s,), the frame that they need, and the unit of lengths."""

    columns: Mapping[str, Array]
    frame: str
    unit: str = "m"
    note: str = ""

    @property
    def names(self) -> list[str]:
        """Return the names of the stations."""
        return [str(name) for name in self.columns["name"]]


def places_of(path: Path, told: Mapping[str, str], frame: str | None) -> Places:
    """Return the stations of a file; `frame` is that of x, y, z."""
    return _of_geojson(path) if path.suffix.lower() in GEOJSON else _of_table(path, told, frame or "cartesian")


def _of_table(path: Path, told: Mapping[str, str], frame: str) -> Places:
    roles = Roles(read_table(path), told)
    names = roles.labels("name")
    lat, x = roles.find("lat"), roles.find("x")
    if lat is None and x is None:
        columns = ", ".join(roles.table.columns)
        advice = f"name them with --column lat=NAME or --column x=NAME; the columns are {columns}"
        raise InvalidProblem("no columns look like latitude and longitude, or x and y", roles.table.source, advice)
    if lat is not None:
        height = roles.find("height")
        unit = "m" if height is None else unit_of(height, UNITS["length"]) or "m"
        degrees = {"lat_deg": roles.numbers("lat"), "lon_deg": roles.numbers("lon")}
        degrees["height"] = np.zeros(len(names)) if height is None else roles.numbers("height")
        return Places({"name": names} | degrees, "geodetic", unit, "" if height else _FLAT)
    axes = [axis for axis in "xyz" if roles.find(axis) is not None]
    assert x is not None
    unit = unit_of(x, UNITS["length"]) or "m"
    return Places({"name": names} | {axis: roles.numbers(axis) for axis in axes}, frame, unit)


_FLAT = "no heights are given: all stations are taken to be at height 0"


def _of_geojson(path: Path) -> Places:
    """Return the points of a GeoJSON feature collection (RFC 7946: longitude, latitude, height above WGS 84)."""
    try:
        data = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        what = f"this is not JSON: {error.msg.lower()}"
        raise InvalidProblem(what, f"{path.name}, line {error.lineno}", "write it again") from None
    features = data.get("features") if isinstance(data, dict) else None
    if not isinstance(features, list):
        raise InvalidProblem("there is no list of features", path.name, "give a GeoJSON FeatureCollection of points")
    points = [
        _point(feature, f"{path.name}, feature {i + 1}")
        for i, feature in enumerate(features)
        if isinstance(feature, dict) and _kind(feature) == "Point"
    ]
    if not points:
        raise InvalidProblem("there is no point among the features", path.name, "give each station as a Point")
    names, lon, lat, height = (list(column) for column in zip(*points, strict=True))
    columns = {"name": np.array(names, dtype=object), "lat_deg": np.array(lat), "lon_deg": np.array(lon)}
    known = [h is not None for h in height]
    columns["height"] = np.array([0.0 if h is None else h for h in height])
    lacking = "" if all(known) else f"{known.count(False)} of {len(known)} points have no height: it is taken to be 0"
    return Places(columns, "geodetic", "m", _FLAT if not any(known) else lacking)


def _kind(feature: Mapping[str, Any]) -> Any:
    geometry = feature.get("geometry")
    return geometry.get("type") if isinstance(geometry, dict) else None


def _point(feature: Mapping[str, Any], where: str) -> tuple[str, float, float, float | None]:
    """Return name, longitude, latitude and height of a point."""
    about = feature.get("properties") or {}
    name = next((about[key] for key in _NAMES if about.get(key) not in (None, "")), feature.get("id"))
    if name is None:
        raise InvalidProblem("the point has no name", where, 'give it a property "name"')
    place = feature["geometry"].get("coordinates")
    number = isinstance(place, list) and all(isinstance(v, int | float) and np.isfinite(v) for v in place)
    if not number or len(place) not in (2, 3) or abs(place[1]) > 90.0:
        raise InvalidProblem(f"{place} is no point", where, "write [longitude, latitude, height]")
    height = place[2] if len(place) == 3 else next((about[key] for key in _HEIGHTS if key in about), None)
    try:
        return str(name), float(place[0]), float(place[1]), None if height is None else float(height)
    except (TypeError, ValueError):
        raise InvalidProblem(f"the height {height!r} is not a number", where, "give metres") from None
