"""Files that constraints name: polygons and lines (GeoJSON, CSV), and grids of heights (CSV, ESRI ASCII).

A file becomes the keys that its contents could have in the problem file: `corners`, `points`, or `x`, `y` and `height`.
Letters: v points, a grid of (p, q) heights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import check_budget, decoded, json_of, read_bytes, read_text, within
from optloc.base.types import Array
from optloc.files.constraint_table import ConstraintTable
from optloc.files.roles import with_standard_columns
from optloc.files.settings import join
from optloc.files.table import Table, csv

# Key of the points of each kind that reads a file, and the geometry of GeoJSON that it needs.
_SHAPES = {
    "polygon": ("corners", "Polygon"),
    "keep-out-polygon": ("corners", "Polygon"),
    "polyline": ("points", "LineString"),
}
_GEOJSON, _TABLES = (".geojson", ".json"), (".csv", ".txt", ".tsv")


@dataclass(frozen=True, slots=True)
class StatedConstraint:
    """A constraint table, together with the contents of the file that it names.

    Parameters
    ----------
    table : ConstraintTable
        The table.
    contents : mapping of str to value
        Keys with the contents of the file; empty without a file.
    geojson : bool
        Whether the points come from GeoJSON: on Earth they are longitude and latitude, otherwise x and y.
    """

    table: ConstraintTable
    contents: Mapping[str, Any] = field(default_factory=dict)
    geojson: bool = False

    def keys(self, geodetic: bool) -> dict[str, Any]:
        """Return the given keys, with the contents of the file instead of its name.

        `geodetic` is whether the frame of the problem is on Earth.
        """
        given = {key: getattr(self.table, key) for key in self.table.model_fields_set}
        contents = dict(self.contents)
        if contents:
            given.pop("file")
        if self.geojson and geodetic:
            contents = {
                f"{key}_deg": [[point[1], point[0], *point[2:]] for point in points] for key, points in contents.items()
            }
        return {key: value for key, value in (given | contents).items() if value is not None}


def stated(table: ConstraintTable, folder: Path | None, where: str) -> StatedConstraint:
    """Return a constraint with the contents of its file.

    Parameters
    ----------
    table : ConstraintTable
        The constraint.
    folder : Path, optional
        Folder of the problem file that names the file, and that must contain it. None: the user names the file, which
        can be in any folder.
    where : str
        Place for messages.

    Raises
    ------
    InvalidProblem
        If the file is missing, has the wrong type, or is invalid.
    """
    if table.file is None:
        return StatedConstraint(table)
    place = join(where, "key 'file'")
    path = Path(table.file) if folder is None else within(folder, table.file, place)
    double = next((key for key in (*_POINTS, "x", "y", "height") if getattr(table, key) is not None), None)
    if double is not None:
        raise InvalidProblem(f"{double!r} and 'file' are both given", where, "remove one of them")
    kinds = (*_SHAPES, "terrain")
    if table.kind not in kinds:
        raise InvalidProblem(f"{table.kind} has no key 'file'", where, f"files are for {', '.join(kinds)}")
    known = (*_TABLES, ".asc") if table.kind == "terrain" else (*_GEOJSON, *_TABLES)
    if path.suffix.lower() not in known:
        raise InvalidProblem(f"{table.file!r} has an unknown type", place, f"use {', '.join(known)}")
    unit = table.unit or "m"
    if table.kind == "terrain":
        grid = read_ascii_grid(path) if path.suffix.lower() == ".asc" else read_grid(path, unit)
        return StatedConstraint(table, dict(zip(("x", "y", "height"), grid, strict=True)))
    key, geometry = _SHAPES[table.kind]
    if path.suffix.lower() in _GEOJSON:
        return StatedConstraint(table, {key: read_geojson(path, geometry)}, geojson=True)
    points, degrees = read_points(path, unit)
    if key == "corners":
        points = [point[:2] for point in points]
    return StatedConstraint(table, {f"{key}_deg" if degrees else key: points})


_POINTS = ("corners", "corners_deg", "points", "points_deg")


# Lines and polygons.


def read_geojson(path: Path, geometry: str) -> list[list[float]]:
    """Return the points (v, 2 or 3) of the only line or polygon of a GeoJSON file (RFC 7946), as in the file.

    `geometry` is "LineString" or "Polygon". Holes of a polygon, and a repeated last corner, are left out.
    """
    source, noun = path.name, geometry.lower().removesuffix("string")
    found = [shape for shape in _geometries(json_of(read_text(path), source)) if shape.get("type") == geometry]
    if len(found) != 1:
        what = f"the file has no {noun}" if not found else f"the file has {len(found)} {noun}s"
        raise InvalidProblem(what, source, f"give one GeoJSON {geometry}, or one Feature with it")
    parts = found[0].get("coordinates")
    if geometry == "Polygon":
        parts = parts[0] if isinstance(parts, list) and parts else []
    try:
        points = [[float(value) for value in point] for point in parts]  # type: ignore[union-attr]  # caught below
    except (TypeError, ValueError):
        points = []
    if len(points) < 2 or not {len(point) for point in points} <= {2, 3}:
        raise InvalidProblem(f"the {noun} is not a list of points", source, "give two or three numbers for each point")
    if len({len(point) for point in points}) > 1 or geometry == "Polygon":
        points = [point[:2] for point in points]  # a polygon is in the plan, and some lines have heights of some points
    return points[:-1] if geometry == "Polygon" and points[0] == points[-1] else points


def _geometries(data: Any) -> list[dict[str, Any]]:
    """Return the geometries of GeoJSON data: of a geometry, a feature, or a collection of them."""
    if not isinstance(data, dict):
        return []
    for key in ("features", "geometries"):
        if isinstance(data.get(key), list):
            return [shape for item in data[key] for shape in _geometries(item)]
    return _geometries(data["geometry"]) if isinstance(data.get("geometry"), dict) else [data]


def read_points(path: Path, unit: str) -> tuple[list[list[float]], bool]:
    """Return the points of a CSV file, and whether they are latitude, longitude (degrees) and perhaps height (m).

    Otherwise they are x, y and perhaps z in `unit`.
    """
    table = with_standard_columns(csv(path, None, {}), unit)
    degrees = table.has("lat_deg")
    keys = ("lat_deg", "lon_deg", "height") if degrees else ("x", "y", "z")
    columns = [table.numbers(key) for key in keys if key in keys[:2] or table.has(key)]
    return np.stack(columns, axis=-1).tolist(), degrees


# Grids of heights.


def read_grid(path: Path, unit: str) -> tuple[Array, Array, Array]:
    """Return x (p,), y (q,) and heights (p, q) of a CSV file with the columns x, y and height (or z), in `unit`."""
    table = with_standard_columns(csv(path, None, {}), unit)
    x, y = (table.numbers(key) for key in "xy")
    values = table.numbers("height" if table.has("height") or not table.has("z") else "z")
    return _grid(x, y, values, table)


def _grid(x: Array, y: Array, values: Array, table: Table) -> tuple[Array, Array, Array]:
    """Return the lines x (p,) and y (q,) of a grid and its values (p, q), from one row for each point."""
    xs, ys = np.unique(x), np.unique(y)
    advice = "give one height for each pair of x and y"
    if len(xs) * len(ys) != len(values):
        what = f"{len(values)} rows are not a full grid of {len(xs)} by {len(ys)} points"
        raise InvalidProblem(what, table.source, advice)
    heights = np.full((len(xs), len(ys)), np.nan)
    heights[np.searchsorted(xs, x), np.searchsorted(ys, y)] = values
    if np.isnan(heights).any():
        raise InvalidProblem("a grid point occurs twice", table.source, advice)
    return xs, ys, heights


# Keys of the header of an ESRI ASCII grid. The origin is the corner or the centre of the lower left cell.
_HEADER = {"ncols", "nrows", "xllcorner", "yllcorner", "xllcenter", "yllcenter", "cellsize", "nodata_value"}


def read_ascii_grid(path: Path) -> tuple[Array, Array, Array]:
    """Return x (p,), y (q,) of the centres of the cells of an ESRI ASCII grid, and its heights (p, q), as in the file.

    The first row of the file is the northernmost. Source: Esri, "Esri ASCII raster format", ArcGIS documentation.
    """
    source = path.name
    words = decoded(read_bytes(path, lines=True), source).split()
    header: dict[str, float] = {}
    while len(words) > 2 * len(header) + 1 and words[2 * len(header)].lower() in _HEADER - header.keys():
        key, value = words[2 * len(header)].lower(), words[2 * len(header) + 1]
        header[key] = _number(value, key, source)
    for keys in (("ncols",), ("nrows",), ("cellsize",), ("xllcorner", "xllcenter"), ("yllcorner", "yllcenter")):
        if not header.keys() & set(keys):
            raise InvalidProblem(f"the header has no {keys[0]}", source, "give an ESRI ASCII grid")
    columns, rows, size = int(header["ncols"]), int(header["nrows"]), header["cellsize"]
    cells = words[2 * len(header) :]
    check_budget("cells", len(cells), source)
    if columns < 2 or rows < 2 or len(cells) != columns * rows or not size > 0.0:
        what = f"{len(cells)} heights are not {columns} columns by {rows} rows"
        raise InvalidProblem(what, source, "correct the header, or the heights")
    try:
        heights = np.array(cells, dtype=float).reshape(rows, columns)
    except ValueError:
        bad = next(cell for cell in cells if not _is_number(cell))
        raise InvalidProblem(f"{bad[:20]!r} is not a height", source, "give numbers") from None
    missing = ~np.isfinite(heights) | (heights == header.get("nodata_value", np.nan))
    if missing.any():
        raise InvalidProblem(f"{int(missing.sum())} cells have no height", source, "fill the gaps, or cut the grid")
    start = [header.get(f"{axis}llcenter", header.get(f"{axis}llcorner", 0.0) + size / 2.0) for axis in "xy"]
    x, y = (first + size * np.arange(count) for first, count in zip(start, (columns, rows), strict=True))
    return x, y, heights[::-1].T


def _number(text: str, key: str, source: str) -> float:
    """Return a number of a header."""
    if not _is_number(text):
        raise InvalidProblem(f"{key} is {text[:20]!r}", source, "give a number")
    return float(text)


def _is_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
