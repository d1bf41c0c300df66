"""What covers where an ellipse does not, as lines of a picture: an egg for a far fix, a banana or a ring as it is.

And such lines on the Earth as GeoJSON has them: cut at the antimeridian, closed around the poles.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.types import Array
from optloc.linear.constraints import exact
from optloc.problem.chart import CARTESIAN, CURVED, INVERSE_RANGE, Chart, quantile
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.uncertainty.region import cells_along, directions, likelihood_region

# Cells of a region that is drawn, by dimension: finer than a picture shows. And regions that are drawn as they are:
# each takes a tenth of a second.
_CELLS, _MOST = {2: 400, 3: 3000}, 12
# Where a region that goes on to infinity is cut off in a picture: so many times the distance of the fix.
_FAR = 3.0
# Half the width of a region that is a line, of its length: it is seen, and not taken for an area.
_WIDTH = 2e-3
# Points around an outline in the plane, and on a spiral around one in space: 4 degrees apart.
_POINTS, _SPIRAL = 181, 3000
# Points of the grid on which many cells are joined, and steps up to which a cell is all of the rectangle around it.
_GRID, _SMALL = 300, 3

Pieces = tuple[Array, ...]
"""Convex parts of a region, the corners (v, d) of each."""


def pieces_of(problem: Problem, fix: Fix, level: float = 0.95) -> list[Pieces]:
    """Return the regions of the fixes of a batch of one position where an ellipse does not cover.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    fix : Fix
        Their fixes.
    level : float
        Probability that a region contains the target.

    Returns
    -------
    list of tuple of array (v, d)
        Metres in the problem's frame; empty where the ellipse covers, or nothing is known of what does.
    """
    flat = fix if len(fix.shape) == 1 else fix.flat()
    if flat.chart is None:
        return [() for _ in range(len(flat))]
    kinds = np.where(np.isfinite(flat.cov).all((-1, -2)), flat.chart.kind, -1)
    own = _one_each(problem, len(flat))
    found: list[Pieces] = []
    held = bool(exact(problem))
    for i, kind in enumerate(kinds):
        if held and kind in (CURVED, INVERSE_RANGE) and own is not None and (kinds > CARTESIAN).sum() <= _MOST:
            found.append(_on_surface(own.take(np.array([i])), flat[i], level))
        elif held:
            found.append(())
        elif kind == INVERSE_RANGE:
            found.append((far_hull(_item(flat.chart, i), level),))
        elif kind == CURVED and own is not None and (kinds == CURVED).sum() <= _MOST:
            found.append(_cells(own.take(np.array([i])), flat[i], level))
        else:
            found.append(())
    return found


def _one_each(problem: Problem, count: int) -> Problem | None:
    """Return the problems of so many fixes as a flat batch: those of a batch, or of the epochs of a file."""
    flat = problem.flat()
    if flat.batch_shape[0] != count and problem.batch_shape == () and separable(problem):
        flat = by_epoch(problem).flat()
    return flat if flat.batch_shape[0] == count else None


def _item(charts: Chart, i: int) -> Chart:
    return Chart(charts.kind[i], charts.position[i], charts.covariance[i], charts.centre[i])


def far_hull(chart: Chart, level: float) -> Array:
    """Return points (v, d) whose convex hull is the plan of the region of a fix that is Gaussian in its inverse range.

    It is cut off at three times the distance of the fix: pictures have an end.
    """
    d = len(chart.position)
    if d == 2:
        turn = 2.0 * np.pi * np.arange(_POINTS) / _POINTS
        ways = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    else:
        high = np.linspace(-1.0, 1.0, _SPIRAL)  # from pole to pole
        turn, across = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(_SPIRAL), np.sqrt(1.0 - high**2)
        ways = np.concatenate([np.stack([across * np.cos(turn), across * np.sin(turn), high], -1), directions(d)])
    # Two coordinates of it are seen: their ellipse holds the level, as that of a covariance does.
    scale = np.sqrt(np.diagonal(chart.spread))
    lower = scale[:, None] * np.linalg.cholesky(chart.spread / np.outer(scale, scale))
    away = np.sqrt(quantile(level, 2)) * ways @ lower.T
    # What would be farther is pulled back along its chord to the fix.
    share = np.where(away[:, -1] < 0.0, np.minimum(1.0, (1.0 - 1.0 / _FAR) / np.maximum(-away[:, -1], 1e-300)), 1.0)
    return chart.to_position(chart.mean + share[:, None] * away)


def _on_surface(problem: Problem, fix: Fix, level: float) -> Pieces:
    """Return the cells of the region of a fix that an equality holds: a part of a surface, or of a line."""
    assert fix.chart is not None
    cells = cells_along(problem, fix, level, _FAR * float(fix.chart.distance))
    if len(cells) and cells.shape[1] == 2:  # of a line, which has no width: in a picture it has
        along = (cells[:, 1] - cells[:, 0])[:, :2]
        length = np.maximum(np.sqrt((along**2).sum(-1, keepdims=True)), np.finfo(float).tiny)
        aside = np.zeros_like(cells[:, :1])
        aside[:, 0, :2] = _WIDTH * np.ptp(cells, axis=(0, 1)).max() * along[:, ::-1] / length * [-1.0, 1.0]
        cells = np.concatenate([cells - aside, cells + aside], axis=1)
    return tuple(cells)


def _cells(problem: Problem, fix: Fix, level: float) -> Pieces:
    """Return the cells of the region of a curved fix; none where it cannot be enclosed."""
    try:
        region = likelihood_region(problem, fix, level, boxes=_CELLS[problem.dimension])
    except InvalidProblem:
        return ()
    if region.cells is None:
        return ()
    centre, reach = region.surface.chart.centre, _FAR * float(region.surface.chart.distance)
    corners = region.cells.corners
    corners = np.where(np.isfinite(corners).all(-1, keepdims=True), corners, centre + reach * region.cells.directions)
    return tuple(corners)


# Lines around convex parts.


def rings(pieces: Sequence[Array]) -> list[Array]:
    """Return closed lines (r, 2) around the union of convex parts, given by their corners (v, 2)."""
    return [line for polygon in polygons(pieces) for line in polygon]


def polygons(pieces: Sequence[Array]) -> list[list[Array]]:
    """Return the union of convex parts, given by their corners (v, 2), as polygons: closed lines (r, 2), then holes.

    Lines run counter-clockwise, those around holes clockwise.
    """
    if not pieces:
        return []
    if len(pieces) == 1:
        return [[hull(pieces[0])]]
    try:
        from contourpy import FillType, contour_generator
    except ImportError:  # it comes with the pictures' library; without it the parts stay apart
        return [[hull(piece)] for piece in pieces]
    corners = np.stack(pieces)
    low, high = corners.min((0, 1)), corners.max((0, 1))
    # One step both ways, as pictures have one scale; and a rim, so that lines close.
    step = max(float((high - low).max()), np.finfo(float).tiny) / (_GRID - 6)
    place = (corners - low) / step + 3.0
    mask = np.zeros((_GRID + 1, _GRID + 1))
    for one in place:
        first, last = np.floor(one.min(0)).astype(int), np.ceil(one.max(0)).astype(int)
        inside = 1.0 if (last - first).max() <= _SMALL else _nodes_inside(one, first, last)
        part = mask[first[0] : last[0] + 1, first[1] : last[1] + 1]
        np.maximum(part, inside, out=part)
    found: Any = contour_generator(z=mask.T, fill_type=FillType.OuterOffset).filled(0.5, 2.0)
    return [
        [low + (part - 3.0) * step for part in np.split(np.asarray(line), np.asarray(end, dtype=int)[1:-1])]
        for line, end in zip(*found, strict=True)
    ]


def _nodes_inside(corners: Array, first: Array, last: Array) -> Array:
    """Return which nodes of a grid, from the first to the last (2,), lie in a convex hull or half a step from it."""
    from scipy.spatial import ConvexHull

    # Joggled: a flat cell has a hull, too.
    sides = ConvexHull(corners, qhull_options="QJ").equations
    x, y = (np.arange(first[k], last[k] + 1) for k in range(2))
    away = sides[:, 0, None, None] * x[:, None] + sides[:, 1, None, None] * y + sides[:, 2, None, None]
    return np.asarray((away <= 0.5).all(0), dtype=float)


def hull(points: Array) -> Array:
    """Return the convex hull of points (v, 2) as a closed line (r, 2)."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        # Scaled: a needle is no degenerate hull.
        size = np.maximum(np.ptp(points, axis=0), np.finfo(float).tiny)
        around = ConvexHull((points - points.min(0)) / size).vertices
    except QhullError:
        return points
    return np.asarray(points[np.append(around, around[0])])


# On the Earth, as GeoJSON: RFC 7946, sections 3.1.6 and 3.1.9.

# Decimals of a degree: a tenth of a millimetre, so that the ellipse of a fix of centimetres is round; of metres.
_DIGITS, _MILLIMETRES = 9, 3
# Longitudes of neighbours on a line differ by this many degrees at most, as lines of a map are straight in degrees.
_STEP = 5.0
# Halvings by which that is sought, enough for a line that passes a pole at a thousandth of its length.
_HALVINGS = 10
# How far inside the antimeridian a point on it is taken to be, degrees: it is on one side, and crossings are crossings.
_INSIDE = 1e-9
# The edge of the map counter-clockwise from its lower right corner: its length, degrees, and how far the corners are.
_AROUND = 1080.0
_EDGES = {180.0: (180.0, 90.0), 540.0: (-180.0, 90.0), 720.0: (-180.0, -90.0), 0.0: (180.0, -90.0)}


def feature(geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    """Return a feature of GeoJSON."""
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def point_geometry(place: Array, digits: int = _DIGITS) -> dict[str, Any]:
    """Return a point (2 or 3,) of longitude, latitude (degrees) and height (metres)."""
    return {"type": "Point", "coordinates": _rounded(_wrapped(place[None]), digits)[0]}


def line_geometry(lines: Sequence[Array], digits: int = _DIGITS) -> dict[str, Any]:
    """Return lines (n, 2 or 3) of longitude, latitude (degrees) and height (metres), cut at the antimeridian."""
    parts = [_rounded(part, digits) for line in lines for part in _parts(_wrapped(line))]
    return {"type": "MultiLineString", "coordinates": [part for part in parts if len(part) > 1]}


def polygon_geometry(polygons: Sequence[Sequence[Array]], digits: int = _DIGITS) -> dict[str, Any]:
    """Return polygons on the Earth, cut at the antimeridian, and closed along the edge of the map around a pole.

    Parameters
    ----------
    polygons : sequence of sequence of array (n, 2 or 3)
        Closed lines of longitude, latitude (degrees) and height (metres), the outer one counter-clockwise as seen from
        above, then those around holes, clockwise: what is on the left of a line is inside.
    digits : int
        Decimals of a degree.
    """
    found = [piece for polygon in polygons for piece in _cut([_wrapped(line) for line in polygon])]
    rounded = [[ring for line in piece if len(ring := _rounded(line, digits)) > 3] for piece in found]
    kept = [piece for piece in rounded if piece]
    if len(kept) == 1:
        return {"type": "Polygon", "coordinates": kept[0]}
    return {"type": "MultiPolygon", "coordinates": kept}


def earth_line(frame: Frame, line: Array) -> Array:
    """Return a line (n, d) in metres as longitude, latitude (degrees) and height (metres) (m, 3), finer near a pole."""
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
    """Return positions (n, d) in metres as longitude, latitude (degrees) and height (metres) (n, 3)."""
    lat, lon, height = frame.to_geodetic(position)
    return np.stack([np.degrees(lon), np.degrees(lat), height], axis=-1)


def _wrapped(place: Array) -> Array:
    """Return places with longitudes within ±180 degrees."""
    out = np.array(place, dtype=float)
    out[:, 0] = np.clip((out[:, 0] + 180.0) % 360.0 - 180.0, -180.0 + _INSIDE, 180.0 - _INSIDE)
    return out


def _rounded(line: Array, digits: int) -> list[list[float]]:
    """Return a line as JSON has it, without neighbours that are one place."""
    out = np.round(line, digits)
    out[:, 2:] = np.round(line[:, 2:], _MILLIMETRES)
    kept = np.append(True, (np.diff(out[:, :2], axis=0) != 0.0).any(-1))
    return out[kept].tolist()  # type: ignore[no-any-return]


def _parts(line: Array) -> list[Array]:
    """Return a line cut where it crosses the antimeridian; each part begins and ends on it where it was cut."""
    parts, part = [], [line[0]]
    for one, two in pairwise(line):
        if abs(two[0] - one[0]) > 180.0:  # the shorter way
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


def _cut(rings: Sequence[Array]) -> list[list[Array]]:
    """Return one polygon as polygons within the map: parts of its lines, joined along the edge of the map.

    The interior is on the left of every line: from the end of a part it goes on along the edge, counter-clockwise, to
    the next beginning; around a pole that way leads over the corners.
    """
    whole: list[Array] = []
    parts: list[Array] = []
    for ring in rings:
        closed = ring if (ring[0] == ring[-1]).all() else np.concatenate([ring, ring[:1]])
        found = _parts(closed)
        if len(found) == 1:
            whole.append(closed)
        else:  # where the line begins it is not cut
            parts += [np.concatenate([found[-1], found[0][1:]]), *found[1:-1]]
    if not parts:
        return [whole]
    outers = [[line] for line in _joined(parts)]
    for hole in whole:
        next((piece for piece in outers if _inside(hole[0], piece[0])), outers[0]).append(hole)
    return outers


def _joined(parts: list[Array]) -> list[Array]:
    """Return parts of lines that begin and end on the edge of the map as closed lines along it."""
    begins = [_along(part[0]) for part in parts]
    left, found = set(range(len(parts))), []
    while left:
        first = here = min(left)
        line: list[Array] = []
        while here != first or not line:
            left.discard(here)
            line.append(parts[here])
            end = _along(parts[here][-1])
            here = min({*left, first}, key=lambda i: (begins[i] - end) % _AROUND)
            way = (begins[here] - end) % _AROUND
            for corner, place in sorted(_EDGES.items(), key=lambda each: (each[0] - end) % _AROUND):
                if (corner - end) % _AROUND < way:
                    line.append(np.array([[*place, *line[-1][-1, 2:]]]))
        found.append(np.concatenate([*line, line[0][:1]]))
    return found


def _along(place: Array) -> float:
    """Return how far along the edge of the map a place on its left or right side is."""
    return float(90.0 + place[1] if place[0] > 0.0 else 630.0 - place[1])


def _inside(place: Array, ring: Array) -> bool:
    """Return whether a place is inside a closed line, by the crossings of a ray to the east."""
    (x0, y0), (x1, y1) = ring[:-1, :2].T, ring[1:, :2].T
    crosses = (y0 > place[1]) != (y1 > place[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = x0 + (place[1] - y0) / (y1 - y0) * (x1 - x0)
    return bool((crosses & (x > place[0])).sum() % 2)
