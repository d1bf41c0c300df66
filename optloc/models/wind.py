"""A medium that moves: sound in a steady wind or in a current."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from optloc.base.errors import InvalidProblem
from optloc.models.primitives import Components, Point, dot, namespace, subtract

# Greatest accepted share of the wind in the wave speed. A hurricane has 0.2 of the speed of sound, and from 1 on no
# sound travels upwind.
_FASTEST = 0.5


@dataclass(frozen=True, slots=True)
class Wind:
    """A medium of one wave speed that moves with a constant velocity, such as air in a steady wind.

    Waves travel from the target to the stations. The medium carries the wave, so a path downwind takes less time. The
    paths are exact for a constant wind; a wind that increases with height bends the rays, which the model ignores.

    Parameters
    ----------
    velocity : tuple of d float
        Velocity of the medium in the axes of the frame, metres per second. East and north for a wind on Earth.
    speed : float
        Wave speed in the medium at rest, metres per second.

    Raises
    ------
    InvalidProblem
        For a velocity without two or three components, or above half of the wave speed.

    References
    ----------
    A. D. Pierce, "Acoustics" (2019), section 8.1: wavefronts in a moving medium.
    """

    velocity: tuple[float, ...]
    speed: float

    def __post_init__(self) -> None:
        # a number has no length
        count = len(self.velocity) if hasattr(self.velocity, "__len__") else 1
        if count not in (2, 3):
            what = f"the wind has {count} components"
            raise InvalidProblem(what, "wind", "give its velocity towards the axes x and y, such as (3.0, -4.0)")
        strength = sum(v * v for v in self.velocity) ** 0.5
        if not strength <= _FASTEST * self.speed:
            what = f"the wind of {strength:.3g} m/s is above half of the wave speed, {self.speed:.6g} m/s"
            raise InvalidProblem(what, "wind", "give it in metres per second, and check the wave speed")

    @property
    def unit_speed(self) -> float:
        """Return the speed that converts travel times to metres, metres per second."""
        return self.speed

    @property
    def straight(self) -> float:
        """Return the metres of a straight path per metre of a measurement, for starts without wind: 1."""
        return 1.0

    @property
    def words(self) -> str:
        """Return a short description of the medium."""
        parts = ", ".join(f"{v:.4g}" for v in self.velocity)
        return f"{self.speed:.6g} m/s in a medium that moves with ({parts}) m/s along the axes"

    def path(self, t: Point, a: Point) -> Any:
        """Return the travel time from target to station, multiplied by `speed`, in metres.

        The wavefront is a sphere of radius c T whose centre drifts by w T. Let r point from target to station,
        and let m = w / c. Then the equation ``|r - m c T| = c T`` has one positive solution c T.
        """
        along, root, rest, _, _ = self._terms(t, a)
        return (root - along) / rest

    def gradients(self, t: Point, a: Point) -> tuple[Components, Components]:
        """Return the gradients of `path` at both points: slowness times `speed`, normal to the wavefront."""
        along, root, rest, line, share = self._terms(t, a)
        at_a = tuple(((along / root - 1.0) * m + rest / root * r) / rest for m, r in zip(share, line, strict=True))
        return tuple(-1.0 * v for v in at_a), at_a

    def _terms(self, t: Point, a: Point) -> tuple[Any, Any, float, Components, tuple[float, ...]]:
        """Return m r, the root of (m r)^2 + (1 - m^2) r^2, 1 - m^2, r and m."""
        line = subtract(a.position, t.position)
        # a wind of two components is horizontal
        share = tuple(v / self.speed for v in (*self.velocity, 0.0)[: len(line)])
        rest = 1.0 - sum(m * m for m in share)
        along = dot(line, share)
        squared = along * along + rest * dot(line, line)
        return along, namespace(squared).sqrt(squared), rest, line, share
