"""Functions with which users state that a target is in a region, outside one, or near a line or a ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Amount, AnyOf, Array, Band, Polygon
from optloc.linear.constraints.arguments import (
    check_order,
    direction_of,
    float_array,
    least_of,
    metres,
    numbers_of,
    point_of,
    radius_of,
)
from optloc.models.surfaces import SURFACES
from optloc.models.terrain import Terrain


def half_plane(normal: ArrayLike, offset: Amount, *, target: int = 0, name: str = "half-plane") -> tuple[Band, ...]:
    """Return the constraint ``normal . x <= offset``: a half-plane, or a half-space in three dimensions.

    Parameters
    ----------
    normal : array (d,)
        Direction out of the half-plane. It is scaled to unit length, and the offset with it.
    offset : float or str
        Greatest value of ``normal . x``: metres for a normal of length one.
    target : int
        Number of the target.
    name : str
        Name in reports.
    """
    return band(normal, -np.inf, offset, target=target, name=name)


def band(normal: ArrayLike, lower: Amount, upper: Amount, *, target: int = 0, name: str = "band") -> tuple[Band, ...]:
    """Return the constraint ``lower <= normal . x <= upper``: the region between two parallel lines or planes.

    Parameters
    ----------
    normal : array (d,)
        Direction across the band. It is scaled to unit length, and the limits with it.
    lower, upper : float or str
        Limits: metres for a normal of length one; equal for a known line or plane.
    target : int
        Number of the target.
    name : str
        Name in reports.
    """
    direction, length = direction_of(normal, name)
    least, most = float(metres(lower, name)) / length, float(metres(upper, name)) / length
    check_order(least, most, name, "m")
    return (Band("plane", float_array(least), float_array(most), direction, name, target),)


def polyhedron(
    normals: ArrayLike, offsets: Sequence[Amount] | Array, *, target: int = 0, name: str = "polyhedron"
) -> tuple[Band, ...]:
    """Return the constraint ``normal . x <= offset`` for each of several normals: a convex region.

    Parameters
    ----------
    normals : array (q, d)
        Directions out of the region. Each is scaled to unit length, and its offset with it.
    offsets : sequence of q float or str
        Greatest values of ``normal . x``: metres for normals of length one.
    target : int
        Number of the target.
    name : str
        Name in reports, before the number of the face.
    """
    directions, limits = numbers_of(normals, name), np.ravel(metres(offsets, name))
    if directions.ndim != 2 or len(directions) != len(limits):
        what = f"{len(limits)} offsets for normals of shape {directions.shape}"
        raise InvalidProblem(what, name, "give one offset for each row of the normals")
    faces = [
        half_plane(one, float(limit), target=target, name=f"{name} {i + 1}")
        for i, (one, limit) in enumerate(zip(directions, limits, strict=True))
    ]
    return tuple(face for single in faces for face in single)


def disc(centre: Sequence[Amount] | Array, radius: Amount, *, target: int = 0, name: str = "disc") -> tuple[Band, ...]:
    """Return the constraint that a target is in a disc of the plan, at any height.

    Parameters
    ----------
    centre : sequence of 2 float or str
        First two coordinates of the centre, metres.
    radius : float or str
        Radius, metres.
    target : int
        Number of the target.
    name : str
        Name in reports.
    """
    return _within(point_of(centre, (2,), name), -np.inf, radius_of(radius, name), target, name)


def annulus(
    centre: Sequence[Amount] | Array, inner: Amount, outer: Amount, *, target: int = 0, name: str = "annulus"
) -> tuple[Band, ...]:
    """Return the constraint that the plan distance of a target from a point is between two radii.

    Parameters
    ----------
    centre : sequence of 2 float or str
        First two coordinates of the centre, metres.
    inner, outer : float or str
        Radii, metres; equal for a known distance.
    target : int
        Number of the target.
    name : str
        Name in reports.
    """
    most, least = radius_of(outer, name), float(metres(inner, name))
    check_order(least, most, name, "m")
    return _within(point_of(centre, (2,), name), least_of(least), most, target, name)


def keep_out_disc(
    centre: Sequence[Amount] | Array, radius: Amount, *, target: int = 0, name: str = "keep-out disc"
) -> tuple[Band, ...]:
    """Return the constraint that a target is outside a disc of the plan, at any height; arguments as of `disc`."""
    return _within(point_of(centre, (2,), name), radius_of(radius, name), np.inf, target, name)


def ball(centre: Sequence[Amount] | Array, radius: Amount, *, target: int = 0, name: str = "ball") -> tuple[Band, ...]:
    """Return the constraint that a target is in a ball.

    Parameters
    ----------
    centre : sequence of d float or str
        Centre, metres.
    radius : float or str
        Radius, metres.
    target : int
        Number of the target.
    name : str
        Name in reports.
    """
    return _within(point_of(centre, (2, 3), name), -np.inf, radius_of(radius, name), target, name)


def keep_out_ball(
    centre: Sequence[Amount] | Array, radius: Amount, *, target: int = 0, name: str = "keep-out ball"
) -> tuple[Band, ...]:
    """Return the constraint that a target is outside a ball; arguments as of `ball`."""
    return _within(point_of(centre, (2, 3), name), radius_of(radius, name), np.inf, target, name)


def polygon(vertices: ArrayLike, *, target: int = 0, name: str = "polygon") -> tuple[Polygon, ...]:
    """Return the constraint that a target's plan position is in a simple polygon.

    Parameters
    ----------
    vertices : array (v, 2)
        Corners in order, metres. The polygon need not be convex.
    target : int
        Number of the target.
    name : str
        Name in reports.
    """
    return (Polygon(numbers_of(vertices, name), name, target),)


def keep_out_polygon(vertices: ArrayLike, *, target: int = 0, name: str = "keep-out polygon") -> tuple[Polygon, ...]:
    """Return the constraint that a target's plan position is outside a simple polygon; arguments as of `polygon`."""
    return (Polygon(numbers_of(vertices, name), name, target, outside=True),)


def polyline(
    points: ArrayLike, tolerance: Amount, *, target: int = 0, name: str = "polyline"
) -> tuple[AnyOf | Band, ...]:
    """Return the constraint that a target is on a road or a track: near at least one segment of a line.

    Parameters
    ----------
    points : array (q, 2) or (q, 3)
        Points of the line in order, metres; in the plan if they have two coordinates.
    tolerance : float or str
        Greatest distance from the line, metres.
    target : int
        Number of the target.
    name : str
        Name in reports.

    Returns
    -------
    tuple of AnyOf or Band
        The union of the regions near each segment. For one segment it is a single region, which is convex.
    """
    line, width = numbers_of(points, name), float(metres(tolerance, name))
    if line.ndim != 2 or line.shape[-1] not in (2, 3) or len(line) < 2:
        what = f"points of shape {line.shape} are no line"
        raise InvalidProblem(what, name, "give two points or more, with two or three coordinates each")
    if not np.isfinite(line).all():
        raise InvalidProblem("a point of the line is not finite", name, "give numbers in metres")
    if not width > 0.0:
        raise InvalidProblem(f"the tolerance is {width:g} m", name, "give a positive distance")
    same = np.flatnonzero((np.diff(line, axis=0) == 0.0).all(-1))
    if len(same):
        raise InvalidProblem(f"point {same[0] + 2} repeats point {same[0] + 1}", name, "leave one of them out")
    members = tuple(
        (Band("segment", float_array(-np.inf), float_array(width), np.ravel(ends), f"{name} {i + 1}", target),)
        for i, ends in enumerate(np.stack([line[:-1], line[1:]], axis=1))
    )
    return members[0] if len(members) == 1 else (AnyOf(members, name, target),)


def terrain(
    x: ArrayLike,
    y: ArrayLike,
    height: ArrayLike,
    *,
    lower: Amount = -np.inf,
    upper: Amount = np.inf,
    exactly: Amount | None = None,
    target: int = 0,
    name: str = "terrain",
) -> tuple[Band, ...]:
    """Return the constraint on a target's height above the ground, which a grid gives.

    The third axis of the frame must point upwards: a plain Cartesian frame, or "enu". Between the points of the grid
    the ground is a bicubic spline. Outside the grid it has the height of the nearest point on the edge.

    Parameters
    ----------
    x, y : array (p,), (q,)
        Coordinates of the grid, metres, ascending.
    height : array (p, q)
        Third coordinate of the ground, metres.
    lower, upper : float or str
        Least and greatest height above the ground, metres.
    exactly : float or str, optional
        Known height above the ground instead; 0 is "on the ground".
    target : int
        Number of the target.
    name : str
        Name in reports.
    """
    low, high = (lower, upper) if exactly is None else (exactly, exactly)
    least, most = float(metres(low, name)), float(metres(high, name))
    check_order(least, most, name, "m")
    table = Terrain(*(np.asarray(part) for part in (x, y, height)))
    return (Band("terrain", float_array(least), float_array(most), np.zeros(0), name, target, table=table),)


def quantity(
    kind: str,
    lower: float = -np.inf,
    upper: float = np.inf,
    coefficients: ArrayLike = (),
    *,
    target: int = 0,
    along: bool = False,
    other: int | None = None,
    table: Any = None,
    name: str = "",
) -> tuple[Band, ...]:
    """Return the constraint on any quantity of the table `optloc.models.surfaces.SURFACES`, also of other packages.

    Parameters
    ----------
    kind : str
        Name of the quantity.
    lower, upper : float
        Limits in the SI unit of the quantity; equal for an equality, infinite for none.
    coefficients : array (c,)
        Coefficients of the quantity, SI units.
    target : int
        Number of the target.
    along : bool
        Whether the limits apply at every epoch of a run, or at the reference time only.
    other : int, optional
        Number of the second target, for a quantity of two.
    table : object, optional
        Data of the quantity, for instance an `optloc.models.terrain.Terrain`.
    name : str
        Name in reports; by default the name of the quantity.
    """
    if kind not in SURFACES:
        raise InvalidProblem(f"unknown quantity {kind!r}", name or "quantity", nearest(kind, SURFACES))
    least, most = float_array(lower), float_array(upper)
    return (Band(kind, least, most, numbers_of(coefficients, name or kind), name or kind, target, along, other, table),)


def _within(centre: Array, lower: float | Array, upper: float, target: int, name: str) -> tuple[Band, ...]:
    """Return the constraint that the distance from a point is between two limits, metres."""
    return (Band("distance", float_array(lower), float_array(upper), centre, name, target),)
