"""Quantities of a target that a constraint can bound, written once and elementwise like the measurement kinds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from optloc.models.primitives import Components, Point, dot, geodetic_height, geodetic_normal, norm, subtract


@dataclass(frozen=True, slots=True)
class Surface:
    """A quantity that a constraint can bound.

    Parameters
    ----------
    g : callable of (t, c)
        The quantity of target `t` with coefficients `c`, SI units.
    summary : str
        One line for listings.
    unit : str
        SI unit of g.
    coefficients : int
        Number of coefficients; -1 for the dimension of the problem.
    velocity, ecef : bool
        Whether the target needs a velocity or ECEF coordinates.
    """

    g: Callable[[Point, Components], Any]
    summary: str
    unit: str
    coefficients: int = 0
    velocity: bool = False
    ecef: bool = False


def _height(t: Point, c: Components) -> Any:
    """Return the height of the target above the WGS 84 ellipsoid, metres."""
    assert t.ecef is not None
    return geodetic_height(t.ecef)


def _visible(t: Point, c: Components) -> Any:
    """Return the sine of the elevation of a point `c`, ECEF in metres, above the horizon of the target."""
    assert t.ecef is not None
    line = subtract(c, t.ecef)
    # The sine instead of the angle, because it is smooth and increases with the angle from nadir to zenith.
    return dot(line, geodetic_normal(t.ecef)) / norm(line)


def _speed(t: Point, c: Components) -> Any:
    """Return the speed of the target, metres per second."""
    assert t.velocity is not None
    return norm(t.velocity)


# Each quantity is smooth at usual positions of targets, so its gradient can keep an estimate on the constraint.
SURFACES: dict[str, Surface] = {
    "plane": Surface(lambda t, c: dot(c, t.position), "linear form c . x of the position", "m", -1),
    "height": Surface(_height, "height above the WGS 84 ellipsoid", "m", ecef=True),
    "visible": Surface(
        _visible, "sine of the elevation of a point c (ECEF) above the target's horizon", "1", 3, ecef=True
    ),
    "speed": Surface(_speed, "speed of the target", "m/s", velocity=True),
}
