"""Polygons in the plan: the side of a point, the distance from the boundary, and the corners.

Letters: v corners of a polygon, N points.
"""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array, Band, Polygon


def edge_of(region: Polygon, number: int) -> Band:
    """Return an edge of a polygon as a plane; it is a line without ends."""
    here, there = region.vertices[number], region.vertices[(number + 1) % len(region.vertices)]
    along = there - here
    # Unit length, so that a level is in metres; it points outwards if corners are counter-clockwise.
    normal = np.array([along[1], -along[0]]) / np.hypot(*along)
    value = np.asarray(normal @ here, dtype=float)
    return Band("plane", value, value, normal, region.name, region.target)


def orientation(vertices: Array) -> float:
    """Return 1 if corners (v, 2) are in counter-clockwise order around their interior, -1 if clockwise."""
    # relative to the first corner, because products of large coordinates lose the digits of an area
    (x, y) = (vertices - vertices[0]).T
    u, v = np.roll(x, -1), np.roll(y, -1)
    return float(np.sign((x * v - u * y).sum()))


def sense_of(region: Polygon) -> float:
    """Return 1 if the normals of `edge_of` point out of the admitted side of a polygon, -1 otherwise."""
    return orientation(region.vertices) * (-1.0 if region.outside else 1.0)


def is_reflex(region: Polygon, edge: int) -> bool:
    """Return whether the admitted side at the corner at the end of an edge has an angle above 180 degrees."""
    count = len(region.vertices)
    corner = region.vertices[[edge, (edge + 1) % count, (edge + 2) % count]]
    return sense_of(region) * orientation(corner) < 0.0


def is_convex(region: Polygon) -> bool:
    """Return whether the admitted side of a polygon is convex."""
    corners = region.vertices
    edge = np.roll(corners, -1, axis=0) - corners
    turn = edge[:, 0] * np.roll(edge, -1, axis=0)[:, 1] - edge[:, 1] * np.roll(edge, -1, axis=0)[:, 0]
    return not region.outside and bool((turn >= 0.0).all() or (turn <= 0.0).all())


def distances_from_edges(region: Polygon, points: Array) -> Array:
    """Return the distances (N, v) of points (N, 2) from the edges of a polygon between their ends, metres."""
    a, b = region.vertices, np.roll(region.vertices, -1, axis=0)
    along, to = b - a, points[:, None] - a
    share = np.clip((to * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    return np.asarray(np.sqrt(((to - share[..., None] * along) ** 2).sum(-1)))


def is_inside(region: Polygon, points: Array) -> Array:
    """Return flags (N,) of points (N, 2) inside the corners of a polygon, whatever its admitted side is."""
    a, b = region.vertices, np.roll(region.vertices, -1, axis=0)
    p, along = points[:, None], b - a
    # Even-odd rule: a ray from inside to the right crosses the boundary an odd number of times.
    crosses = (a[:, 1] > p[..., 1]) != (b[:, 1] > p[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (p[..., 1] - a[:, 1]) * along[:, 0] / along[:, 1]
    return np.asarray((crosses & (p[..., 0] < at)).sum(1) % 2 == 1)


def polygon_violation(region: Polygon, points: Array) -> Array:
    """Return the distance (N,) of points (N, 2) from the admitted side, divided by one plus the greatest coordinate.

    It is zero on the admitted side.
    """
    distance = distances_from_edges(region, points).min(1)
    admitted = is_inside(region, points) != region.outside
    return np.where(admitted, 0.0, distance / (1.0 + np.abs(region.vertices).max()))
