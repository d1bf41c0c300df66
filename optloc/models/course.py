"""Courses that follow the Earth: ways over ground as great circles, and heights that are kept exactly."""

from __future__ import annotations

from typing import Any

from optloc.models.primitives import (
    WGS84_A,
    WGS84_F,
    Components,
    dot,
    geodetic_height,
    geodetic_normal,
    namespace,
    subtract,
)

# Added to the squared angle of a way, so that a target at rest has a derivative: it shortens a way by 2e-15 of it.
_STILL = 1e-14


def carry(start: Components, straight: Components, rise: Any) -> Components:
    """Return the place on a course over ground that a straight line would have left.

    The straight way is parted at its start into what is upward and what is level. The level part is gone along a great
    circle of the sphere that fits the ellipsoid there (Gauss's mean radius, and the height of the start), and the place
    is then moved along the normal of WGS 84, on which its latitude and longitude stay, to the height of the start plus
    the upward part plus `rise`: to rounding (4e-9 m). Of the geodesic that keeps its speed the course is off by
    s^3 / 1800 R^2 at most, 1.4 cm after 100 km and 1.7 m after 500 km.

    Parameters
    ----------
    start : tuple of 3 numbers
        Where the state holds, ECEF, metres: arrays, jets or symbols.
    straight : tuple of 3 numbers
        Where the same position, velocity and acceleration lead in space, ECEF, metres.
    rise : number
        Height beyond the start's and the upward part, metres.

    Returns
    -------
    tuple of 3 numbers
        ECEF, metres.

    References
    ----------
    M. P. do Carmo, "Differential Geometry of Curves and Surfaces" (1976), section 4.4 (geodesics); W. Torge and J.
    Mueller, "Geodesy" (2012), section 4.1.3 (Gaussian radius of curvature).
    """
    e2 = WGS84_F * (2.0 - WGS84_F)
    up, height = geodetic_normal(start), geodetic_height(start)
    xp = namespace(height)
    way = subtract(straight, start)
    climb = dot(way, up)
    level = tuple(w - climb * u for w, u in zip(way, up, strict=True))
    radius = WGS84_A * (1.0 - e2) ** 0.5 / (1.0 - e2 * up[2] * up[2]) + height
    squared = dot(level, level)
    half = 0.5 * xp.sqrt(squared / (radius * radius) + _STILL)
    share = xp.sin(half) / half
    # with the angle w: sin w / w of the way, and (1 - cos w) / w^2 of its square over the radius downwards
    along, drop = share * xp.cos(half), 0.5 * share * share * squared / radius
    place = tuple(s + along * v - drop * u for s, v, u in zip(start, level, up, strict=True))
    short = height + climb + rise - geodetic_height(place)
    return tuple(p + short * u for p, u in zip(place, geodetic_normal(place), strict=True))
