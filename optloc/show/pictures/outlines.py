"""Outlines of 95 % regions whose ellipse is not valid, in pictures and as GeoJSON on Earth.

An ellipse is *valid* if it covers the true position with the stated probability. The region of a far fix is egg-shaped;
other regions can be bananas or rings. GeoJSON lines are cut at the antimeridian and closed around the poles. A place is
longitude, latitude (degrees) and, if known, height (m).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from optloc.base.frames import Frame
from optloc.base.types import Array
from optloc.problem.chart import CARTESIAN
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.uncertainty.contour import holds
from optloc.uncertainty.outline import Outline, outline_of

# Maximum number of regions whose outline is computed: in three dimensions each takes half a second.
_MOST = 12


def outlines_of(problem: Problem, fix: Fix, planes: Sequence[Array], level: float = 0.95) -> list[list[Outline]]:
    """Return the 95 % regions of fixes whose ellipse is not valid, in each plane; each fix has one position.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    fix : Fix
        Their fixes.
    planes : sequence of array (2, d) or (n, 2, d)
        Axes of planes through the fixes, the same for all fixes or one plane for each fix.
    level : float
        Probability that a region contains the projection of the target.

    Returns
    -------
    list of list of Outline
        For each fix, its region in each plane. The list is empty if the ellipse is valid or the region is unknown.
    """
    flat = fix if len(fix.shape) == 1 else fix.flat()
    if flat.chart is None:
        return [[] for _ in range(len(flat))]
    shaped = ((flat.chart.kind != CARTESIAN) | flat.chart.cut_off) & np.isfinite(flat.cov).all((-1, -2))
    problems = _problem_of_each_fix(problem, len(flat))
    if problems is None or shaped.sum() > _MOST:
        return [[] for _ in range(len(flat))]
    found: list[list[Outline]] = []
    for i in range(len(flat)):
        made = []
        if shaped[i]:
            one, fixed = problems.take(np.array([i])), flat[i]
            made = [outline_of(one, fixed, plane if plane.ndim == 2 else plane[i], level) for plane in planes]
        # One unknown outline makes the region unknown, because a picture needs all planes of a fix.
        found.append([] if any(one is None for one in made) else [one for one in made if one is not None])
    return found


def level_planes(problem: Problem, position: Array) -> Array:
    """Return the directions east and north (n, 2, d) at positions (n, d) on Earth, m.

    A position that is NaN gets the directions at the centre of the stations.
    """
    centre = problem.stations.places.reshape(-1, problem.dimension).mean(0)
    known = np.where(np.isfinite(position).all(-1, keepdims=True), position, centre)
    return np.stack([problem.frame.enu_axes(place)[:2] for place in known]).reshape(-1, 2, problem.dimension)


def _problem_of_each_fix(problem: Problem, count: int) -> Problem | None:
    """Return a flat batch with one problem for each of `count` fixes; None if the numbers do not match."""
    flat = problem.flat()
    if flat.batch_shape[0] != count and problem.batch_shape == () and separable(problem):
        flat = by_epoch(problem).flat()
    return flat if flat.batch_shape[0] == count else None


# GeoJSON on Earth: RFC 7946, sections 3.1.6 and 3.1.9.

# Decimals of a degree (0.1 mm, so that an ellipse of centimetres is round) and of a height in metres (1 mm).
_DIGITS, _MILLIMETRES = 9, 3
# Maximum difference in longitude between neighbours on a line, degrees: maps draw straight lines in degrees.
_STEP = 5.0
# Maximum number of halvings of a line to meet that limit: enough if a line passes a pole at a thousandth of its length.
_HALVINGS = 10
# Distance from the antimeridian, degrees, to which points on it are moved. Each point is then on one side, so that
# crossings are found.
_INSIDE = 1e-9
# The edge of the map, counter-clockwise from its lower right corner: its length, degrees, and the corners by their
# distance along the edge.
_AROUND = 1080.0
_EDGES = {180.0: (180.0, 90.0), 540.0: (-180.0, 90.0), 720.0: (-180.0, -90.0), 0.0: (180.0, -90.0)}


def feature(geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    """Return a GeoJSON feature."""
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def point_geometry(place: Array, digits: int = _DIGITS) -> dict[str, Any]:
    """Return a GeoJSON point from longitude, latitude (degrees) and an optional height (m): (2,) or (3,)."""
    return {"type": "Point", "coordinates": _rounded(_wrap_longitudes(place[None]), digits)[0]}


def line_geometry(lines: Sequence[Array], digits: int = _DIGITS) -> dict[str, Any]:
    """Return GeoJSON lines, cut at the antimeridian.

    Each line is (n, 2) or (n, 3): longitude, latitude (degrees) and an optional height (m).
    """
    parts = [_rounded(part, digits) for line in lines for part in _parts_between_crossings(_wrap_longitudes(line))]
    return {"type": "MultiLineString", "coordinates": [part for part in parts if len(part) > 1]}


def polygon_geometry(polygons: Sequence[Sequence[Array]], digits: int = _DIGITS) -> dict[str, Any]:
    """Return GeoJSON polygons, cut at the antimeridian and closed along the edge of the map around a pole.

    Parameters
    ----------
    polygons : sequence of sequence of array (n, 2 or 3)
        Closed lines of longitude, latitude (degrees) and height (m). The outer line of each polygon is first and runs
        counter-clockwise as seen from above; lines around holes run clockwise. So the interior is on the left of each
        line.
    digits : int
        Decimals of a degree.
    """
    found = [piece for polygon in polygons for piece in _cut_polygon([_wrap_longitudes(line) for line in polygon])]
    rounded = [[ring for line in piece if len(ring := _rounded(line, digits)) > 3] for piece in found]
    kept = [piece for piece in rounded if piece]
    if len(kept) == 1:
        return {"type": "Polygon", "coordinates": kept[0]}
    return {"type": "MultiPolygon", "coordinates": kept}


def earth_line(frame: Frame, line: Array) -> Array:
    """Return a line (n, d), m, as longitude, latitude (degrees), height (m) (k, 3), with extra points near a pole.

    Points are added in the middle of an edge until its ends differ by at most `_STEP` in longitude.
    """
    place = earth_points(frame, line)
    for _ in range(_HALVINGS):
        wide = np.abs((np.diff(place[:, 0]) + 180.0) % 360.0 - 180.0) > _STEP
        if not wide.any():
            break
        at = np.flatnonzero(wide) + 1
        line = np.insert(line, at, 0.5 * (line[at - 1] + line[at]), axis=0)
        place = earth_points(frame, line)
    return place


def earth_points(frame: Frame, position: Array) -> Array:
    """Return positions (n, d), m, as longitude, latitude (degrees) and height (m) (n, 3)."""
    lat, lon, height = frame.to_geodetic(position)
    return np.stack([np.degrees(lon), np.degrees(lat), height], axis=-1)


def _wrap_longitudes(place: Array) -> Array:
    """Return places (n, 2) or (n, 3) with longitudes within ±180 degrees."""
    out = np.array(place, dtype=float)
    out[:, 0] = np.clip((out[:, 0] + 180.0) % 360.0 - 180.0, -180.0 + _INSIDE, 180.0 - _INSIDE)
    return out


def _rounded(line: Array, digits: int) -> list[list[float]]:
    """Return a line of places as lists of rounded numbers, without repeated points.

    `digits` are the decimals of the degrees; heights have three decimals.
    """
    out = np.round(line, digits)
    out[:, 2:] = np.round(line[:, 2:], _MILLIMETRES)
    kept = np.append(True, (np.diff(out[:, :2], axis=0) != 0.0).any(-1))
    return out[kept].tolist()  # type: ignore[no-any-return]


def _parts_between_crossings(line: Array) -> list[Array]:
    """Return the parts of a line between its crossings of the antimeridian; each cut adds a point on either side."""
    parts, part = [], [line[0]]
    for one, two in pairwise(line):
        if abs(two[0] - one[0]) > 180.0:  # The shorter way between the points crosses the antimeridian.
            # The line leaves the map at the longitude `side`. `before` and `after` are the differences in longitude
            # between the crossing and its two neighbours.
            side = float(np.copysign(180.0, one[0]))
            before, after = side - one[0], two[0] + side
            middle = one + before / (before + after) * (two - one)
            middle[0] = side
            parts.append(np.stack([*part, middle]))
            middle = middle.copy()
            middle[0] = -side
            part = [middle]
        part.append(two)
    return [*parts, np.stack(part)]


def _cut_polygon(rings: Sequence[Array]) -> list[list[Array]]:
    """Return a polygon as polygons within the map: the parts of its lines are joined along the edge of the map.

    The interior is on the left of every line. From the end of a part, the outline continues along the edge,
    counter-clockwise, to the next start of a part. Around a pole, this path passes the corners of the map.
    """
    whole: list[Array] = []
    parts: list[Array] = []
    for ring in rings:
        closed = ring if (ring[0] == ring[-1]).all() else np.concatenate([ring, ring[:1]])
        found = _parts_between_crossings(closed)
        if len(found) == 1:
            whole.append(closed)
        else:  # The start of the ring is no cut: join the last and the first part.
            parts += [np.concatenate([found[-1], found[0][1:]]), *found[1:-1]]
    if not parts:
        return [whole]
    outers = [[line] for line in _join_along_edge(parts)]
    # A line that crosses nothing is a hole of the outline that holds it.
    for hole in whole:
        next((piece for piece in outers if holds(piece[0][:, :2], hole[0])), outers[0]).append(hole)
    return outers


def _join_along_edge(parts: list[Array]) -> list[Array]:
    """Return closed lines from parts that begin and end on the edge of the map, joined along the edge.

    From the end of a part, the next start along the edge, counter-clockwise, continues the line. Corners of the map
    between them become points of the line. A line is closed when the next start is the start of its first part.
    """
    begins = [_distance_along_edge(part[0]) for part in parts]
    unused, found = set(range(len(parts))), []
    while unused:
        first = here = min(unused)
        line: list[Array] = []
        while here != first or not line:
            # `here` is the current part, and `first` the part with which the line began.
            unused.discard(here)
            line.append(parts[here])
            end = _distance_along_edge(parts[here][-1])
            here = min({*unused, first}, key=lambda i: (begins[i] - end) % _AROUND)
            way = (begins[here] - end) % _AROUND
            # Add the corners of the map between the end and the next start; heights stay the same.
            for corner, place in sorted(_EDGES.items(), key=lambda each: (each[0] - end) % _AROUND):
                if (corner - end) % _AROUND < way:
                    line.append(np.array([[*place, *line[-1][-1, 2:]]]))
        found.append(np.concatenate([*line, line[0][:1]]))
    return found


def _distance_along_edge(place: Array) -> float:
    """Return the distance along the edge of the map, degrees, of a point on its left or right side.

    The distance counts counter-clockwise from the lower right corner.
    """
    return float(90.0 + place[1] if place[0] > 0.0 else 630.0 - place[1])
