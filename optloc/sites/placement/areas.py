"""Polygons of GeoJSON files, their convex parts, and lines of sight over terrain.

A ring is a closed polygon (v, 2): x and y of its v corners, without a repeated last corner. Letters: P
places, s stations, q points.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from formulations.placement import PlacementGround, PlacementRegion
from optloc.files import DataTable, json_of, read_text, table_of
from optloc.problem import Array, Frame, InvalidProblem

# Points between a site and a place at which the line is compared with the ground, and grid points per side that
# a spline needs.
_SAMPLES, _NODES = 200, 4


def polygons_of(path: Path) -> list[Array]:
    """Return the outer rings of all polygons of a GeoJSON file (RFC 7946), each (v, 2), as in the file.

    A repeated last corner is removed. Holes in the polygons are ignored. A file without a polygon, or with a
    ring of fewer than four positions, is an error.
    """
    source = path.name
    data = json_of(read_text(path), source)
    items = data.get("features", [data]) if isinstance(data, dict) else []
    rings = []
    for item in items if isinstance(items, list) else []:
        shape = item.get("geometry", item) if isinstance(item, dict) else {}
        parts = shape.get("coordinates", []) if isinstance(shape, dict) else []
        kind = shape.get("type") if isinstance(shape, dict) else None
        found = [parts] if kind == "Polygon" else parts if kind == "MultiPolygon" else []
        for polygon in found:
            try:
                ring = np.array([[float(v) for v in corner[:2]] for corner in polygon[0]])
            except (TypeError, ValueError, IndexError, KeyError):
                ring = np.zeros((0, 2))
            if len(ring) < 4 or ring.shape[1] != 2 or not np.isfinite(ring).all():
                raise InvalidProblem(
                    "a ring is not a list of at least four corners", source, "close the ring as RFC 7946 requires"
                )
            rings.append(ring[:-1] if np.array_equal(ring[0], ring[-1]) else ring)
    if not rings:
        raise InvalidProblem("the file has no polygon", source, "give a GeoJSON Polygon, or a Feature with one")
    return rings


def corners_in_frame(ring: Array, frame: Frame, where: str) -> Array:
    """Return the corners (v, 2) of a ring in frame coordinates, metres.

    In a geodetic frame, the corners are longitude and latitude, degrees. The frame must then be a local frame
    with axes east and north. Other frames return the corners unchanged. `where` is the location in the file
    for error messages.
    """
    if not frame.geodetic:
        return ring
    if frame.kind != "enu":
        raise InvalidProblem(
            "an area needs a local frame with east and north axes", where, 'write kind = "enu" in [frame]'
        )
    return frame.from_geodetic(np.radians(ring[:, 1]), np.radians(ring[:, 0]), np.zeros(len(ring)))[:, :2]


def inside(points: Array, ring: Array) -> Array:
    """Return a mask (q,) of the points (q, 2) inside a ring (v, 2).

    A point is inside if a ray from it to the right crosses an odd number of edges.
    """
    a, b = ring, np.roll(ring, -1, axis=0)
    x, y = points[:, :1], points[:, 1:]
    span = (a[:, 1] > y) != (b[:, 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return np.asarray((span & (x < cross)).sum(-1) % 2 == 1)


def visible(ground: PlacementGround, places: Array, stations: Array) -> Array:
    """Return an array (P, s) for P places and s stations: 1 if their line stays above the ground, otherwise 0.

    Places (P, 3) and stations (s, 3) are positions, metres. The line is compared with the ground at
    `_SAMPLES` points.
    """
    share = np.linspace(0.0, 1.0, _SAMPLES + 2)[1:-1, None]
    out = np.ones((len(places), len(stations)))
    for p, place in enumerate(places):
        for s, station in enumerate(stations):
            line = station + share * (place - station)
            out[p, s] = float((line[:, 2] >= ground.at(line[:, :2])).all())
    return out


def ground_of(path: Path, where: str) -> PlacementGround:
    """Return the terrain of a CSV file that has columns x, y, z on a full grid, metres.

    `where` is the location of the file name in the selection file, for error messages.
    """
    table = table_of(DataTable(file=path.name), path.parent, where)
    x, y, z = (table.numbers(key) for key in "xyz")
    xs, ys = np.unique(x), np.unique(y)
    if len(xs) * len(ys) != len(z) or len(xs) < _NODES or len(ys) < _NODES:
        what = f"{len(z)} rows are not a full grid of at least {_NODES} by {_NODES} points"
        raise InvalidProblem(what, table.source, "give one z for each pair of x and y")
    height = np.full((len(xs), len(ys)), np.nan)
    height[np.searchsorted(xs, x), np.searchsorted(ys, y)] = z
    if np.isnan(height).any():
        raise InvalidProblem("a grid point occurs twice", table.source, "give one z for each pair of x and y")
    return PlacementGround(xs, ys, height)


def region_of(ring: Array, low: float, high: float) -> PlacementRegion:
    """Return a convex counter-clockwise ring (v, 2) as a region: half-planes normal'x <= offset, and heights.

    The heights are between `low` and `high`, metres.
    """
    along = np.roll(ring, -1, axis=0) - ring
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    return PlacementRegion(normal, (normal * ring).sum(1), low, high)


def _crosses(ring: Array) -> bool:
    """Return whether two edges of a ring (v, 2) cross at a point inside both edges.

    Edges that only touch, for instance neighbours, do not cross.
    """
    ends = np.roll(ring, -1, axis=0)
    along = ends - ring

    def side(points: Array) -> Array:
        """Return the side (v, v) of point j (columns) from the line through edge i (rows): 1 left, -1 right."""
        away = points - ring[:, None]
        return np.asarray(np.sign(along[:, :1] * away[..., 1] - along[:, 1:] * away[..., 0]))

    apart = side(ring) * side(ends) < 0.0
    return bool((apart & apart.T).any())


def convex_parts(ring: Array) -> list[Array]:
    """Return convex counter-clockwise rings that together cover a simple polygon (v, 2).

    A region of the refinement must be convex. A convex polygon gives one ring; any other polygon is cut into
    triangles (ear clipping). A polygon whose edges cross is an error.

    G. H. Meisters, "Polygons have ears", Amer. Math. Monthly 82 (1975).
    """
    if _crosses(ring):
        raise InvalidProblem("the edges of a polygon cross each other", "polygon", "reorder or correct its corners")
    x, y = ring.T
    area = 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
    points = ring if area > 0.0 else ring[::-1]

    def turn(a: Array, b: Array, c: Array) -> float:
        """Return twice the signed area of a triangle, m^2: positive for a left turn at b."""
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    count = len(points)
    if all(turn(points[i - 1], points[i], points[(i + 1) % count]) >= 0.0 for i in range(count)):
        return [points]
    remaining, parts = list(range(count)), []
    while len(remaining) > 3:
        for k in range(len(remaining)):
            a, b, c = (points[remaining[(k + s) % len(remaining)]] for s in (-1, 0, 1))
            others = [points[i] for i in remaining if not any(points[i] is p for p in (a, b, c))]
            covered = [turn(a, b, p) > 0 and turn(b, c, p) > 0 and turn(c, a, p) > 0 for p in others]
            if turn(a, b, c) > 0.0 and not any(covered):
                parts.append(np.array([a, b, c]))
                del remaining[k]
                break
        else:
            raise InvalidProblem("the edges of a polygon cross each other", "polygon", "reorder or correct its corners")
    return [*parts, points[remaining]]
