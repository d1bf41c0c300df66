"""Reader of `mrclam_aoa2d`: near-instant epochs of a robot that sees landmarks, in the plane, each with a free target.

The azimuth is from landmark to robot in world axes. Noise as in the README's own check: 2 deg an azimuth (their robust
spread is 0.5 deg; 1 in 100 is beyond 5 deg) and 0.1 m a range. Ranges alone get 0.15 m, the spread of their residuals:
what they say apart depends on it, where they put the minima does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from data.reference import Reference, descend

from optloc import Motion, Problem, assemble, measured

SIGMA = {"azimuth": np.deg2rad(2.0), "range": 0.1}
ALONE = {**SIGMA, "range": 0.15}
COLUMN = {"azimuth": "az_rad", "range": "range_m"}


@dataclass(frozen=True)
class Sightings:
    """One set: landmarks (s, 2), true positions (k, 2), and its rows: landmark, epoch, value by kind."""

    landmarks: np.ndarray
    truth: np.ndarray
    a: np.ndarray
    epoch: np.ndarray
    z: dict[str, np.ndarray]

    def every(self, n: int) -> Sightings:
        """Return every n-th epoch."""
        kept = self.epoch % n == 0
        z = {kind: values[kept] for kind, values in self.z.items()}
        return Sightings(self.landmarks, self.truth[::n], self.a[kept], self.epoch[kept] // n, z)

    def problem(self, kinds: tuple[str, ...]) -> Problem:
        """Return the epochs by some kinds of rows as one problem."""
        sigma = ALONE if len(kinds) == 1 else SIGMA
        rows = [measured(kind, self.z[kind], a=self.a, sigma=sigma[kind], epoch=self.epoch) for kind in kinds]
        return assemble(self.landmarks, *rows, motions=(Motion(span="epoch"),))

    def from_truth(self, kinds: tuple[str, ...]) -> Reference:
        """Return least squares started at the truth."""
        return Reference(*descend(lambda x: self._residual(x, kinds), self.truth, 1e-5))

    def _residual(self, x: np.ndarray, kinds: tuple[str, ...]) -> np.ndarray:
        line = x[self.epoch] - self.landmarks[self.a]
        model = {"azimuth": np.arctan2(line[:, 1], line[:, 0]), "range": np.hypot(line[:, 0], line[:, 1])}
        first = np.searchsorted(self.epoch, np.arange(len(self.truth)))
        place = np.arange(len(self.epoch)) - first[self.epoch]
        out = np.zeros((len(kinds), len(self.truth), place.max() + 1))
        for i, kind in enumerate(kinds):
            r = self.z[kind] - model[kind]
            r = (r + np.pi) % (2.0 * np.pi) - np.pi if kind == "azimuth" else r
            out[i, self.epoch, place] = r / (ALONE if len(kinds) == 1 else SIGMA)[kind]
        return np.moveaxis(out, 0, 1).reshape(len(self.truth), -1)


def load(folder: Path, number: int) -> Sightings:
    """Return one set: 1, 2 or 5."""
    tables = [pd.read_csv(folder / f"{name}.csv") for name in ("stations", "truth", "measurements")]
    stations, truth, rows = (table[table["set"] == number] for table in tables)
    epoch = pd.Index(truth["epoch"]).get_indexer(rows["epoch"])
    order = np.argsort(epoch, kind="stable")
    rows = rows.iloc[order]
    return Sightings(
        stations[["x_m", "y_m"]].to_numpy(),
        truth[["x_m", "y_m"]].to_numpy(),
        pd.Index(stations["station"]).get_indexer(rows["station"]),
        epoch[order],
        {kind: rows[column].to_numpy() for kind, column in COLUMN.items()},
    )
