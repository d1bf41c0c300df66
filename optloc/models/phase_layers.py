"""Layers with two speeds: P waves, and S waves with a separate profile over the same depths."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from optloc.base.errors import InvalidProblem
from optloc.models.layers import Layers
from optloc.models.primitives import Point

S_TOA = "s_toa"
"""Kind of the arrival time of an S wave, times the `unit_speed` of the P waves; it needs a medium `PhaseLayers`."""


@dataclass(frozen=True, slots=True)
class PhaseLayers(Layers):
    """Layers for P and S waves, whose rays differ because the ratio of their speeds differs between layers.

    Parameters
    ----------
    s_speed : tuple of float
        Speed of S waves at each depth, m/s; `speed` has the speeds of P waves. The other fields are as in `Layers`.

    Raises
    ------
    InvalidProblem
        For S waves that are not slower than P waves, and for the reasons of `Layers`.
    """

    s_speed: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        Layers.__post_init__(self)
        if len(self.s_speed) != len(self.speed):
            what = f"there are {len(self.speed)} speeds of P and {len(self.s_speed)} of S waves"
            raise InvalidProblem(what, "s_speed", "give one of each for every depth")
        pair = next((pair for pair in zip(self.speed, self.s_speed, strict=True) if not 0.0 < pair[1] < pair[0]), None)
        if pair is not None:
            what = f"P waves of {pair[0]:g} m/s are not faster than S waves of {pair[1]:g} m/s"
            raise InvalidProblem(what, "s_speed", "correct the speeds")

    @property
    def shear(self) -> Layers:
        """Return the layers of the S waves; their times are multiplied by the `unit_speed` of the P waves."""
        return _shear_of(self)

    @property
    def words(self) -> str:
        """Return a short description of the table."""
        speeds = f"{min(self.s_speed):.6g} to {max(self.s_speed):.6g} m/s"
        primary = Layers(self.depth, self.speed, self.between, self.surface, self.reference)
        return f"P waves {primary.words}; S waves {speeds}"


@lru_cache(maxsize=64)
def _shear_of(layers: PhaseLayers) -> Layers:
    """Return the layers of the S waves of a medium."""
    return Layers(layers.depth, layers.s_speed, layers.between, layers.surface, layers.unit_speed)


def shear_path(t: Point, a: Point) -> Any:
    """Return the travel time of the first S wave between two points, times `unit_speed`, metres."""
    return t.medium.shear.path(t, a)
