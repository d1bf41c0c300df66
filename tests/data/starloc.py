"""Reader of `starloc_aoa`: groups of six random bearings of one marker, from six places of a moving, tracked camera.

Each bearing is an azimuth and an elevation in the camera's own axes; every group is a problem of its own, whose six
stations are the camera's places and attitudes at those frames. Noise: 0.3 deg an angle (robust spread 0.2 deg).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from data.reference import Reference, descend
from scipy.spatial.transform import Rotation

from optloc import Problem, assemble, measured, station_array

SIGMA = np.deg2rad(0.3)
SIZE = 6


@dataclass(frozen=True)
class Groups:
    """Camera places (n, 6, 3) and axes (n, 6, 3, 3; rows are its axes in the room), angles (n, 6, 2), truth (n, 3)."""

    place: np.ndarray
    axes: np.ndarray
    angles: np.ndarray
    truth: np.ndarray

    def problem(self) -> Problem:
        """Return the groups as a batch of problems."""
        stations = replace(station_array(self.place[:, None]), axes=self.axes[:, None])
        each = np.arange(SIZE)
        rows = [
            measured(kind, self.angles[..., i], a=each, sigma=SIGMA) for i, kind in enumerate(("azimuth", "elevation"))
        ]
        return assemble(stations, *rows)

    def from_truth(self) -> Reference:
        """Return least squares started at the truth."""
        return Reference(*descend(self._residual, self.truth, 1e-5))

    def _residual(self, x: np.ndarray) -> np.ndarray:
        u, v, w = np.moveaxis(np.einsum("ksij,ksj->ksi", self.axes, x[:, None] - self.place), -1, 0)
        model = np.stack([np.arctan2(v, u), np.arctan2(w, np.hypot(u, v))], axis=-1)
        off = (self.angles - model + np.pi) % (2.0 * np.pi) - np.pi
        return off.reshape(len(x), -1) / SIGMA


def load(folder: Path, run: str, attitude: str, groups: int, seed: int) -> Groups:
    """Return groups of one run, with the attitude of the mount by design ("nom") or calibrated ("cal")."""
    tables = [pd.read_csv(folder / f"{name}.csv") for name in ("stations", "truth", "measurements")]
    stations, truth, rows = (table[table["run"] == run] for table in tables)
    stations, truth = stations.set_index("frame"), truth.set_index("tag")
    rng = np.random.default_rng(seed)
    counts = rows["tag"].value_counts().sort_index()
    counts = counts[counts >= SIZE]
    tags = rng.choice(counts.index.to_numpy(), groups, p=counts.to_numpy() / counts.sum())
    members = np.stack([rng.choice(np.flatnonzero(rows["tag"] == tag), SIZE, replace=False) for tag in tags])
    frames = rows["frame"].to_numpy()[members].ravel()
    columns = [f"{attitude}_{c}" for c in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]
    pose = stations.loc[frames, columns].to_numpy()
    turn = Rotation.from_quat(pose[:, 3:]).as_matrix()
    return Groups(
        pose[:, :3].reshape(groups, SIZE, 3),
        np.swapaxes(turn, -1, -2).reshape(groups, SIZE, 3, 3),
        rows[["az_rad", "el_rad"]].to_numpy()[members],
        truth.loc[tags, ["x_m", "y_m", "z_m"]].to_numpy(),
    )
