"""Courses over ground: the path follows a great circle, and the height is exact."""

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

# Added to the squared angle, so that a target at rest has a derivative. It shortens a path by a share of 2e-15.
_STILL = 1e-14


def carry(start: Components, straight: Components, rise: Any) -> Components:
    """Return the position on a course over ground that starts like a given straight course.

    The straight displacement is split at its start into an upward and a horizontal part. The horizontal part becomes a
    path along a great circle. Its sphere fits the ellipsoid there: the radius is Gauss's mean radius plus the height of
    the start. The point is then moved along the normal of WGS 84, which keeps latitude and longitude. Its height
    becomes the height of the start plus the upward part plus `rise`, up to rounding (4e-9 m). After a distance s the
    error relative to the geodesic with the same speed is at most s^3 / 1800 R^2: 1.4 cm after 100 km and 1.7 m after
    500 km.

    Parameters
    ----------
    start : tuple of 3 numbers
        Position at the reference time of the state, ECEF, metres: arrays, jets or symbols.
    straight : tuple of 3 numbers
        Position that the same state reaches on a straight course in space, ECEF, metres.
    rise : number
        Additional height, metres.

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
    displacement = subtract(straight, start)
    climb = dot(displacement, up)
    horizontal = tuple(w - climb * u for w, u in zip(displacement, up, strict=True))
    radius = WGS84_A * (1.0 - e2) ** 0.5 / (1.0 - e2 * up[2] * up[2]) + height
    squared = dot(horizontal, horizontal)
    half_angle = 0.5 * xp.sqrt(squared / (radius * radius) + _STILL)
    sinc = xp.sin(half_angle) / half_angle
    # With the angle w: sin w / w of the displacement, and downwards (1 - cos w) / w^2 of its square over the radius.
    along, drop = sinc * xp.cos(half_angle), 0.5 * sinc * sinc * squared / radius
    place = tuple(s + along * v - drop * u for s, v, u in zip(start, horizontal, up, strict=True))
    missing_height = height + climb + rise - geodetic_height(place)
    return tuple(p + missing_height * u for p, u in zip(place, geodetic_normal(place), strict=True))
