"""Reader of `starloc_aoa`: groups of six random bearings of one marker, from six places of a moving, tracked camera.

Each bearing is an azimuth and an elevation in the camera's own axes; every group is a problem of its own, whose six
stations are the camera's places and attitudes at those frames. Noise: 0.3 deg an angle (robust spread 0.2 deg).

A whole run is one problem too: one camera that moves, and markers that stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from data.reference import Reference, descend
from scipy.spatial.transform import Rotation

from optloc import Motion, Problem, assemble, measured, station_array

SIGMA = np.deg2rad(0.3)
# Where a whole run is one problem the noise grows as the camera turns: bearings and poses are 0.09 s apart, by a fit of
# the residuals at the true places to the rate.
STILL, LAG = np.deg2rad(0.2), 0.09
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

    def turned(self, turn: np.ndarray) -> Groups:
        """Return the groups with the camera's axes turned by a rotation vector (3,) of its mount, radians.

        The same rotation as optloc's boresight, made by another library: the unit quaternion along (1, turn / 2).
        """
        mount = Rotation.from_quat([*(turn / 2.0), 1.0]).inv().as_matrix()
        return replace(self, axes=mount @ self.axes)


@dataclass(frozen=True)
class Bearings:
    """One run: all bearings of the markers that are left in, in the order of time, and the camera's poses by frame."""

    poses: pd.DataFrame
    rows: pd.DataFrame
    markers: pd.DataFrame

    def half(self, number: int) -> Bearings:
        """Return every other frame, from the first (0) or the second (1) on."""
        frames = np.unique(self.rows["frame"])[number::2]
        return replace(self, rows=self.rows[self.rows["frame"].isin(frames)])

    def often(self) -> Bearings:
        """Return the markers that were seen at least six times."""
        counts = self.rows["tag"].value_counts()
        return replace(self, rows=self.rows[self.rows["tag"].isin(counts.index[counts >= SIZE])])

    @property
    def truth(self) -> np.ndarray:
        """Return the places of the markers (t, 3), in the order of `problem`."""
        return self.markers.loc[np.unique(self.rows["tag"]), ["x_m", "y_m", "z_m"]].to_numpy()

    def problem(self) -> Problem:
        """Return the run as one problem: a camera that moves, markers that stay."""
        (frames, epoch), (tags, target) = (np.unique(self.rows[c], return_inverse=True) for c in ("frame", "tag"))
        poses = self.poses.loc[frames]
        camera = station_array(poses[["x_m", "y_m", "z_m"]].to_numpy()[:, None], ("camera",))
        axes = np.swapaxes(Rotation.from_quat(poses[["qx", "qy", "qz", "qw"]].to_numpy()).as_matrix(), -1, -2)
        sigma = np.hypot(STILL, LAG * poses["rate"].to_numpy()[epoch])
        return assemble(
            replace(camera, axes=axes[:, None]),
            *(
                measured(kind, self.rows[column].to_numpy(), a=0, epoch=epoch, target=target, sigma=sigma)
                for kind, column in (("azimuth", "az_rad"), ("elevation", "el_rad"))
            ),
            times=poses["t_s"].to_numpy(),
            motions=tuple(Motion() for _ in tags),
        )

    def groups(self, count: int, seed: int) -> Groups:
        """Return groups of six random bearings of a marker."""
        rng = np.random.default_rng(seed)
        counts = self.rows["tag"].value_counts().sort_index()
        counts = counts[counts >= SIZE]
        tags = rng.choice(counts.index.to_numpy(), count, p=counts.to_numpy() / counts.sum())
        members = np.stack([rng.choice(np.flatnonzero(self.rows["tag"] == tag), SIZE, replace=False) for tag in tags])
        pose = self.poses.loc[self.rows["frame"].to_numpy()[members].ravel()]
        turn = Rotation.from_quat(pose[["qx", "qy", "qz", "qw"]].to_numpy()).as_matrix()
        return Groups(
            pose[["x_m", "y_m", "z_m"]].to_numpy().reshape(count, SIZE, 3),
            np.swapaxes(turn, -1, -2).reshape(count, SIZE, 3, 3),
            self.rows[["az_rad", "el_rad"]].to_numpy()[members],
            self.markers.loc[tags, ["x_m", "y_m", "z_m"]].to_numpy(),
        )


def run(folder: Path, name: str, attitude: str, *, without: tuple[int, ...] = ()) -> Bearings:
    """Return one run, with the attitude of the mount by design ("nom") or calibrated ("cal"), without some markers."""
    tables = [pd.read_csv(folder / f"{table}.csv") for table in ("stations", "truth", "measurements")]
    stations, truth, rows = (table[table["run"] == name] for table in tables)
    poses = stations.set_index("frame").sort_index()
    poses = poses.rename(columns={f"{attitude}_{c}": c for c in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")})
    return Bearings(poses.assign(rate=_rate(poses)), rows[~rows["tag"].isin(without)], truth.set_index("tag"))


def _rate(poses: pd.DataFrame) -> np.ndarray:
    """Return how fast the camera turns at each frame, radians a second: the faster of the steps before and after."""
    attitude, times = Rotation.from_quat(poses[["qx", "qy", "qz", "qw"]].to_numpy()), poses["t_s"].to_numpy()
    step = (attitude[:-1].inv() * attitude[1:]).magnitude() / np.diff(times)
    return np.maximum(np.append(step, 0.0), np.insert(step, 0, 0.0))


def load(folder: Path, name: str, attitude: str, groups: int, seed: int) -> Groups:
    """Return groups of one run, with the attitude of the mount by design ("nom") or calibrated ("cal")."""
    return run(folder, name, attitude).groups(groups, seed)
