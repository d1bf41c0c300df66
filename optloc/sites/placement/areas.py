"""Areas and ground: polygons of GeoJSON, convex parts of them, and what the ground hides."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from formulations.placement import PlacementGround, PlacementRegion
from optloc.files import DataTable, json_of, read_text, table_of
from optloc.problem import Array, Frame, InvalidProblem

# Points between a site and a place at which the ground is looked at, and nodes of a side that a spline needs.
_SAMPLES, _NODES = 200, 4


def polygons_of(path: Path) -> list[Array]:
    """Return the outer rings (q, 2) of the polygons of a GeoJSON file (RFC 7946), without their repeated ends."""
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
                raise InvalidProblem("a ring is no list of four corners", source, "close the polygon as RFC 7946 says")
            rings.append(ring[:-1] if np.array_equal(ring[0], ring[-1]) else ring)
    if not rings:
        raise InvalidProblem("there is no polygon", source, "give a GeoJSON Polygon, or a Feature with one")
    return rings


def corners_in_frame(ring: Array, frame: Frame, where: str) -> Array:
    """Return corners (q, 2) in coordinates of the frame: from longitudes and latitudes on Earth, else as they are."""
    if not frame.geodetic:
        return ring
    if frame.kind != "enu":
        raise InvalidProblem("an area needs a frame with a plan", where, 'write kind = "enu" in [frame]')
    return frame.from_geodetic(np.radians(ring[:, 1]), np.radians(ring[:, 0]), np.zeros(len(ring)))[:, :2]


def inside(points: Array, ring: Array) -> Array:
    """Return which points (q, 2) are inside a ring (v, 2), by the number of edges that a ray crosses."""
    a, b = ring, np.roll(ring, -1, axis=0)
    x, y = points[:, :1], points[:, 1:]
    span = (a[:, 1] > y) != (b[:, 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return np.asarray((span & (x < cross)).sum(-1) % 2 == 1)


def visible(ground: PlacementGround, places: Array, stations: Array) -> Array:
    """Return 1 for pairs (P, s) of a place and a station whose line stays above the ground, else 0."""
    share = np.linspace(0.0, 1.0, _SAMPLES + 2)[1:-1, None]
    out = np.ones((len(places), len(stations)))
    for p, place in enumerate(places):
        for s, station in enumerate(stations):
            line = station + share * (place - station)
            out[p, s] = float((line[:, 2] >= ground.at(line[:, :2])).all())
    return out


def ground_of(path: Path, where: str) -> PlacementGround:
    """Return the ground of a CSV file with x, y, z on a full grid."""
    table = table_of(DataTable(file=path.name), path.parent, where)
    x, y, z = (table.numbers(key) for key in "xyz")
    xs, ys = np.unique(x), np.unique(y)
    if len(xs) * len(ys) != len(z) or len(xs) < _NODES or len(ys) < _NODES:
        what = f"{len(z)} rows are no full grid of at least {_NODES} by {_NODES} points"
        raise InvalidProblem(what, table.source, "give z at every pair of an x and a y")
    height = np.full((len(xs), len(ys)), np.nan)
    height[np.searchsorted(xs, x), np.searchsorted(ys, y)] = z
    if np.isnan(height).any():
        raise InvalidProblem("a point of the grid occurs twice", table.source, "give z once at every pair")
    return PlacementGround(xs, ys, height)


def region_of(ring: Array, low: float, high: float) -> PlacementRegion:
    """Return a convex ring (v, 2), counted counter-clockwise, as half-planes."""
    along = np.roll(ring, -1, axis=0) - ring
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    return PlacementRegion(normal, (normal * ring).sum(1), low, high)


def _crosses(ring: Array) -> bool:
    """Return whether two edges of a ring (v, 2) cross at a point inside both; edges that touch do not."""
    ends = np.roll(ring, -1, axis=0)
    along = ends - ring

    def side(points: Array) -> Array:
        """Return on which side of the line through edge i (rows) each point (columns) is: -1, 0 or 1."""
        away = points - ring[:, None]
        return np.asarray(np.sign(along[:, :1] * away[..., 1] - along[:, 1:] * away[..., 0]))

    apart = side(ring) * side(ends) < 0.0
    return bool((apart & apart.T).any())


def convex_parts(ring: Array) -> list[Array]:
    """Return convex rings that make up a simple one (v, 2): itself, or its triangles by cutting ears.

    G. H. Meisters, "Polygons have ears", Amer. Math. Monthly 82 (1975).
    """
    if _crosses(ring):
        raise InvalidProblem("the edges of a polygon cross each other", "polygon", "give a simple one")
    x, y = ring.T
    area = 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
    points = ring if area > 0.0 else ring[::-1]

    def turn(a: Array, b: Array, c: Array) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    count = len(points)
    if all(turn(points[i - 1], points[i], points[(i + 1) % count]) >= 0.0 for i in range(count)):
        return [points]
    left, parts = list(range(count)), []
    while len(left) > 3:
        for k in range(len(left)):
            a, b, c = (points[left[(k + s) % len(left)]] for s in (-1, 0, 1))
            others = [points[i] for i in left if not any(points[i] is p for p in (a, b, c))]
            held = [turn(a, b, p) > 0 and turn(b, c, p) > 0 and turn(c, a, p) > 0 for p in others]
            if turn(a, b, c) > 0.0 and not any(held):
                parts.append(np.array([a, b, c]))
                del left[k]
                break
        else:
            raise InvalidProblem("the edges of a polygon cross each other", "polygon", "give a simple one")
    return [*parts, points[left]]
