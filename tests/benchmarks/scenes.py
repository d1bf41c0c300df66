"""The data that every method of the table fixes: range differences of six stations, drawn once and kept in a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

Array = np.ndarray
COUNT, STATIONS, SIGMA = 10_000, 6, 10.0
SCENES = ("inside", "outside")


@dataclass(frozen=True)
class Scene:
    """Range differences of N emitters to the first station of an array of their own.

    Parameters
    ----------
    stations : array (N, s, 3)
        Metres.
    z : array (N, s - 1)
        Measured differences to the first station, metres.
    truth : array (N, 3)
        Metres.
    covariance : array (s - 1, s - 1)
        Of the differences, square metres.
    """

    stations: Array
    z: Array
    truth: Array
    covariance: Array

    @property
    def white(self) -> Array:
        """Return the whitening matrix (s - 1, s - 1)."""
        return np.linalg.inv(np.linalg.cholesky(self.covariance))

    def first(self, count: int) -> Scene:
        """Return the first problems, from the start again where there are fewer."""
        index = np.arange(count) % len(self.z)
        return Scene(self.stations[index], self.z[index], self.truth[index], self.covariance)

    def save(self, path: Path) -> None:
        np.savez(path, **{name: getattr(self, name) for name in self.__dataclass_fields__})


def load(path: str) -> Scene:
    """Return a scene that was saved."""
    with np.load(path) as kept:
        return Scene(*(kept[name] for name in Scene.__dataclass_fields__))
