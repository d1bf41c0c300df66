"""Azimuths and ranges from landmarks to a robot, in the plane. Each short epoch has a free target.

The azimuth is from landmark to robot in world axes. Noise: 2 deg an azimuth (their robust spread is 0.5 deg; 1 in 100
is beyond 5 deg) and 0.1 m a range. Ranges without azimuths have 0.15 m, the spread of their residuals. This number
changes the statistics of the fixes, but not the positions of the minima. In shapes, s are landmarks and k epochs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optloc.lab.datasets.reading import choose, places, table
from optloc.problem import Array, Motion, Problem, assemble, measured

# Radians and metres. Four times the robust spread of azimuths, because one in a hundred is beyond 5 degrees.
SIGMA = {"azimuth": np.deg2rad(2.0), "range": 0.1}
ALONE = {**SIGMA, "range": 0.15}  # metres: the spread of the residuals of ranges in fixes without azimuths
COLUMN = {"azimuth": "az_rad", "range": "range_m"}


@dataclass(frozen=True, slots=True)
class Sightings:
    """One set: landmarks, true positions and measurements.

    `landmarks` (s, 2) and `truth` (k, 2) are in metres. Each of the m rows has a landmark `a` (m,) and an `epoch` (m,).
    `z` are the values (m,) by kind, radians or metres: a row has an azimuth and a range.
    """

    landmarks: Array
    truth: Array
    a: Array
    epoch: Array
    z: dict[str, Array]

    def every(self, n: int, first: int = 0) -> Sightings:
        """Return every n-th epoch, counted from the epoch `first`."""
        inside = self.epoch % n == first
        z = {kind: values[inside] for kind, values in self.z.items()}
        return Sightings(self.landmarks, self.truth[first::n], self.a[inside], self.epoch[inside] // n, z)

    def problem(self, kinds: tuple[str, ...], *, known: bool = False) -> Problem:
        """Return the epochs with rows of these kinds as one problem; with `known`, the true positions are given."""
        sigma = sigmas(kinds)
        rows = [measured(kind, self.z[kind], a=self.a, sigma=sigma[kind], epoch=self.epoch) for kind in kinds]
        motion = Motion(span="epoch", known=self.truth[:, None] if known else None)
        return assemble(self.landmarks, *rows, motions=(motion,))


def sigmas(kinds: tuple[str, ...]) -> dict[str, float]:
    """Return the standard deviation of each kind, radians or metres; a range without an azimuth has a larger one."""
    return ALONE if len(kinds) == 1 else SIGMA


def dataset(
    folder: Path, *, number: int = 1, kinds: tuple[str, ...] = ("azimuth", "range"), every: int = 1
) -> tuple[Problem, Array]:
    """Return every `every`-th epoch of a set with rows of these kinds, and the true positions (k, 2), metres.

    `number` is the number of the set: 1, 2 or 5.
    """
    for kind in kinds:
        choose(kind, COLUMN, "kinds")
    data = load(folder, number).every(every)
    return data.problem(tuple(kinds)), data.truth


def load(folder: Path, number: int) -> Sightings:
    """Return the set with this number: 1, 2 or 5."""
    import pandas as pd

    tables = [table(folder, name) for name in ("stations", "truth", "measurements")]
    choose(number, np.unique(tables[0]["set"]).tolist(), "number")
    stations, truth, rows = (found[found["set"] == number] for found in tables)
    epoch = pd.Index(truth["epoch"]).get_indexer(rows["epoch"])
    order = np.argsort(epoch, kind="stable")  # stable: rows of one epoch keep the order of the file
    rows = rows.iloc[order]
    return Sightings(
        places(stations),
        places(truth),
        pd.Index(stations["station"]).get_indexer(rows["station"]),
        epoch[order],
        {kind: rows[column].to_numpy() for kind, column in COLUMN.items()},
    )
