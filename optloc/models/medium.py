"""Media with a varying wave speed (layers or air), and measurements along their rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.units import SPEED_OF_LIGHT
from optloc.models.layers import Layers, as_number
from optloc.models.primitives import (
    Components,
    Point,
    distance,
    dot,
    geodetic_height,
    namespace,
    subtract,
    within,
)
from optloc.models.wind import Wind

# Mean radius of the Earth, metres. The layers of air are concentric with it. The curvature of the ellipsoid differs by
# half a percent, which is 0.2 m for a path of 400 km.
_RADIUS = 6371e3
# Greatest accepted refractivity in ppm, and greatest accepted scale height in metres.
_MOST = 1e6
# Gauss-Legendre nodes along a path. With twelve nodes the relative error of the mean refractivity between heights 100
# km apart is 1e-6.
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(12)
_SHARES = tuple(zip((0.5 + 0.5 * _NODE).tolist(), (0.5 * _WEIGHT).tolist(), strict=True))


@dataclass(frozen=True, slots=True)
class Atmosphere:
    """A medium for radio waves: air with a refractivity that decreases exponentially with height.

    Optical path lengths and wave directions are of first order in the refractivity. They are integrated along the
    straight line, with the curvature of the Earth. For an aircraft at 10 km height, paths over 100, 200 and 400 km are
    too long by 0.02, 0.2 and 2.6 m. The refraction of elevations is too small by 0.3, 1 and 6 %. Near the ground the
    errors are three times larger. The model has no ducts.

    Parameters
    ----------
    refractivity : float
        (n - 1) 1e6 at height zero above the ellipsoid.
    scale_height : float
        Height difference in metres over which the refractivity decreases to 1 / e.

    Raises
    ------
    InvalidProblem
        For a refractivity that is negative or not a number, or for a scale height that is not positive.

    References
    ----------
    Recommendation ITU-R P.453-14 (2019), the reference atmosphere of section 2: 315 and 7.35 km.
    """

    refractivity: float = 315.0
    scale_height: float = 7350.0

    def __post_init__(self) -> None:
        for name, value, low in (("refractivity", self.refractivity, 0.0), ("scale_height", self.scale_height, 1.0)):
            if not low <= as_number(value) <= _MOST:
                raise InvalidProblem(f"{value!r} is not a {name} of air", name, "use 315.0 and 7350.0 on average")

    @property
    def unit_speed(self) -> float:
        """Return the speed that converts travel times to metres, metres per second."""
        return SPEED_OF_LIGHT

    @property
    def words(self) -> str:
        """Return a short description of the medium."""
        return f"air of refractivity {self.refractivity:g} ppm at height 0, scale height {self.scale_height:g} m"

    @property
    def straight(self) -> float:
        """Return the metres of a straight path per metre of a measurement: 1, because refraction in air is small."""
        return 1.0

    def path(self, t: Point, a: Point) -> Any:
        """Return the optical path length, metres: travel time times the speed of light in vacuum."""
        more, _, _ = self._along(t, a)
        return distance(t, a) * (1.0 + more)

    def gradients(self, t: Point, a: Point) -> tuple[Components, Components]:
        """Return the gradients of `path` at both points: refractive index times unit vectors away from the other."""
        assert t.up is not None
        assert a.up is not None
        more, length, (by_t, by_a, by_length) = self._along(t, a)
        unit = tuple(v / length for v in subtract(t.position, a.position))
        # d r (1 + N) = (1 + N) dr + r dN. N depends on both heights, and on r through the lowest point of the line.
        along = 1.0 + more + by_length * length
        at_t = tuple(along * u + length * by_t * v for u, v in zip(unit, t.up, strict=True))
        at_a = tuple(-1.0 * along * u + length * by_a * v for u, v in zip(unit, a.up, strict=True))
        return at_t, at_a

    def _along(self, t: Point, a: Point) -> tuple[Any, Any, tuple[Any, Any, Any]]:
        """Return the mean refractivity n - 1 on the line, the length of the line, metres, and derivatives of the mean.

        The derivatives are with respect to the heights of `t` and `a` and to the length, per metre.
        """
        assert t.ecef is not None
        assert a.ecef is not None
        far, near = (_RADIUS + geodetic_height(p.ecef) for p in (t, a))  # type: ignore[arg-type]
        length = distance(t, a)
        squared, xp = length * length, namespace(length)
        total: list[Any] = [0.0, 0.0, 0.0, 0.0]
        for s, weight in _SHARES:
            # Stewart's theorem gives the distance of this point of the line from the centre of the Earth.
            radius = xp.sqrt((1.0 - s) * near * near + s * far * far - s * (1.0 - s) * squared)
            weighted = 1e-6 * self.refractivity * weight * xp.exp((_RADIUS - radius) / self.scale_height)
            slope_over_radius = -1.0 * weighted / (self.scale_height * radius)
            parts = (
                weighted,
                s * far * slope_over_radius,
                (1.0 - s) * near * slope_over_radius,
                -s * (1.0 - s) * length * slope_over_radius,
            )
            total = [partial_sum + part for partial_sum, part in zip(total, parts, strict=True)]
        return total[0], length, (total[1], total[2], total[3])


Medium = Layers | Atmosphere | Wind
__all__ = ["Atmosphere", "Layers", "Medium", "Wind", "arrival", "path", "path_rate"]


def path(t: Point, a: Point) -> Any:
    """Return the travel time between two points, multiplied by the `unit_speed` of the medium, in metres."""
    return t.medium.path(t, a)


def arrival(t: Point, a: Point) -> Components:
    """Return a vector from the station in the direction of the arriving wave, in the axes of the station.

    Its length is about `unit_speed` divided by the speed at the station.
    """
    return within(tuple(-1.0 * v for v in t.medium.gradients(t, a)[1]), a)


def path_rate(t: Point, a: Point) -> Any:
    """Return the rate of change of `path` due to the velocities of both points, metres per second."""
    assert t.velocity is not None
    assert a.velocity is not None
    at_t, at_a = t.medium.gradients(t, a)
    return dot(at_t, t.velocity) + dot(at_a, a.velocity)
