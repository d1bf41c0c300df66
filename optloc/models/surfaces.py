"""Quantities of a target that a constraint may bound, written once and elementwise like the measurement kinds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from optloc.models.primitives import Components, Point, dot, geodetic_height, geodetic_normal, norm, subtract


@dataclass(frozen=True, slots=True)
class Surface:
    """A bounded quantity.

    Parameters
    ----------
    g : callable of (t, c)
        The quantity of target `t` with coefficients `c`, SI units.
    summary : str
        One line for listings.
    unit : str
        SI unit of g.
    coefficients : int
        How many coefficients it takes; -1 for as many as the problem has dimensions.
    velocity, ecef : bool
        What the target must carry beyond its position.
    """

    g: Callable[[Point, Components], Any]
    summary: str
    unit: str
    coefficients: int = 0
    velocity: bool = False
    ecef: bool = False


def _height(t: Point, c: Components) -> Any:
    assert t.ecef is not None
    return geodetic_height(t.ecef)


def _visible(t: Point, c: Components) -> Any:
    assert t.ecef is not None
    line = subtract(c, t.ecef)
    # The sine and not the angle: it is smooth, and grows with it from nadir to zenith.
    return dot(line, geodetic_normal(t.ecef)) / norm(line)


def _speed(t: Point, c: Components) -> Any:
    assert t.velocity is not None
    return norm(t.velocity)


# Each is smooth where targets are, so that an answer can be held on it by its gradient.
SURFACES: dict[str, Surface] = {
    "plane": Surface(lambda t, c: dot(c, t.position), "linear form c . x of the position", "m", -1),
    "height": Surface(_height, "height above the WGS 84 ellipsoid", "m", ecef=True),
    "visible": Surface(
        _visible, "sine of the elevation of a point c (ECEF) above the target's horizon", "1", 3, ecef=True
    ),
    "speed": Surface(_speed, "speed of the target", "m/s", velocity=True),
}
