"""Bearings of markers from a moving, tracked camera: groups of six of one marker, or a whole run as one problem.

Each bearing is an azimuth and an elevation in the camera's own axes; every group is a problem of its own, whose six
stations are the camera's places and attitudes at those frames. Noise: 0.3 deg an angle (robust spread 0.2 deg).

A whole run is one problem too: one camera that moves, and markers that stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optloc.lab.datasets.reading import choose, places, table
from optloc.problem import Array, Motion, Problem, assemble, measured, station_array

if TYPE_CHECKING:
    import pandas as pd

SIGMA = np.deg2rad(0.3)  # of an angle in a group: half as much again as its robust spread
# As the camera turns the noise grows: bearings and poses are 0.09 s apart, by a fit of the residuals at the true places
# to the rate.
STILL, LAG = np.deg2rad(0.2), 0.09
SIZE = 6  # bearings in a group; markers that were seen less often are left out
_QUATERNION = ["qx", "qy", "qz", "qw"]


@dataclass(frozen=True, slots=True)
class MarkGroups:
    """Camera places (n, 6, 3) and axes (n, 6, 3, 3; rows are its axes in the room), angles (n, 6, 2), truth (n, 3).

    `rate` (n, 6) is how fast the camera turns, radians a second.
    """

    place: Array
    axes: Array
    angles: Array
    truth: Array
    rate: Array

    def problem(self, *, turning: bool = False, known: bool = False) -> Problem:
        """Return the groups as a batch of problems.

        `turning`: with noise that grows as the camera turns; `known`: of markers whose places are not asked for.
        """
        stations = replace(station_array(self.place[:, None]), axes=self.axes[:, None])
        sigma, each = _sigma(self.rate) if turning else SIGMA, np.arange(SIZE)
        rows = [
            measured(kind, self.angles[..., i], a=each, sigma=sigma) for i, kind in enumerate(("azimuth", "elevation"))
        ]
        return assemble(stations, *rows, motions=(Motion(known=self.truth[:, None, None]) if known else Motion(),))

    def turned(self, turn: Array) -> MarkGroups:
        """Return the groups with the camera's axes turned by a rotation vector (3,) of its mount, radians.

        The same rotation as optloc's boresight, made by another library: the unit quaternion along (1, turn / 2).
        """
        from scipy.spatial.transform import Rotation

        mount = Rotation.from_quat([*(turn / 2.0), 1.0]).inv().as_matrix()
        return replace(self, axes=mount @ self.axes)


@dataclass(frozen=True, slots=True)
class CameraBearings:
    """One run: all bearings of the markers that are left in, in the order of time, and the camera's poses by frame."""

    poses: pd.DataFrame
    rows: pd.DataFrame
    markers: pd.DataFrame

    def half(self, number: int) -> CameraBearings:
        """Return every other frame, from the first (0) or the second (1) on."""
        frames = np.unique(self.rows["frame"])[number::2]
        return replace(self, rows=self.rows[self.rows["frame"].isin(frames)])

    def often(self) -> CameraBearings:
        """Return the markers that were seen at least six times."""
        counts = self.rows["tag"].value_counts()
        return replace(self, rows=self.rows[self.rows["tag"].isin(counts.index[counts >= SIZE])])

    @property
    def truth(self) -> Array:
        """Return the places of the markers (t, 3), metres, in the order of `problem`."""
        return places(self.markers.loc[np.unique(self.rows["tag"])])

    def problem(self) -> Problem:
        """Return the run as one problem: a camera that moves, markers that stay."""
        frames, epoch = np.unique(self.rows["frame"].to_numpy(), return_inverse=True)
        tags, target = np.unique(self.rows["tag"].to_numpy(), return_inverse=True)
        poses = self.poses.loc[frames]
        camera = station_array(places(poses)[:, None], ("camera",))
        sigma = _sigma(poses["rate"].to_numpy()[epoch])
        return assemble(
            replace(camera, axes=_axes(poses)[:, None]),
            *(
                measured(kind, self.rows[column].to_numpy(), a=0, epoch=epoch, target=target, sigma=sigma)
                for kind, column in (("azimuth", "az_rad"), ("elevation", "el_rad"))
            ),
            times=poses["t_s"].to_numpy(),
            motions=tuple(Motion() for _ in tags),
        )

    def groups(self, count: int, seed: int) -> MarkGroups:
        """Return groups of six random bearings of a marker."""
        rng = np.random.default_rng(seed)
        counts = self.rows["tag"].value_counts().sort_index()
        counts = counts[counts >= SIZE]
        # groups fall to markers as their bearings do, so that every bearing is as likely
        tags = rng.choice(counts.index.to_numpy(), count, p=counts.to_numpy() / counts.sum())
        members = np.stack([rng.choice(np.flatnonzero(self.rows["tag"] == tag), SIZE, replace=False) for tag in tags])
        pose = self.poses.loc[self.rows["frame"].to_numpy()[members].ravel()]
        rate = pose["rate"].to_numpy().reshape(count, SIZE)
        return MarkGroups(
            places(pose).reshape(count, SIZE, 3),
            _axes(pose).reshape(count, SIZE, 3, 3),
            self.rows[["az_rad", "el_rad"]].to_numpy()[members],
            places(self.markers.loc[tags]),
            rate,
        )


def dataset(
    folder: Path,
    *,
    run: str = "R1",
    attitude: str = "nom",
    form: str = "groups",
    count: int = 200,
    seed: int = 1,
    without: tuple[int, ...] = (),
) -> tuple[Problem, Array]:
    """Return a run, and the truth of its markers, (n, 3).

    `form` is "groups", a batch of `count` groups of six bearings of one marker, or "run", the whole run with the
    markers that were seen at least six times.
    """
    choose(form, ("groups", "run"), "form")
    data = read_run(folder, run, attitude, without=without)
    if form == "run":
        return data.often().problem(), data.often().truth
    found = data.groups(count, seed)
    return found.problem(), found.truth


def read_run(folder: Path, name: str, attitude: str, *, without: tuple[int, ...] = ()) -> CameraBearings:
    """Return one run, with the attitude of the mount by design ("nom") or calibrated ("cal"), without some markers."""
    tables = [table(folder, file) for file in ("stations", "truth", "measurements")]
    choose(name, tables[0]["run"].unique(), "run")
    choose(attitude, ("nom", "cal"), "attitude")
    stations, truth, rows = (found[found["run"] == name] for found in tables)
    poses = stations.set_index("frame").sort_index()
    poses = poses.rename(columns={f"{attitude}_{c}": c for c in ("x_m", "y_m", "z_m", *_QUATERNION)})
    return CameraBearings(poses.assign(rate=_rate(poses)), rows[~rows["tag"].isin(without)], truth.set_index("tag"))


def load(folder: Path, name: str, attitude: str, groups: int, seed: int) -> MarkGroups:
    """Return groups of one run, with the attitude of the mount by design ("nom") or calibrated ("cal")."""
    return read_run(folder, name, attitude).groups(groups, seed)


def _sigma(rate: Array) -> Array:
    """Return the standard deviation of angles while the camera turns, radians."""
    return np.hypot(STILL, LAG * rate)


def _axes(poses: pd.DataFrame) -> Array:
    """Return the axes (n, 3, 3) of the camera in the room, as rows."""
    from scipy.spatial.transform import Rotation

    return np.swapaxes(Rotation.from_quat(poses[_QUATERNION].to_numpy()).as_matrix(), -1, -2)


def _rate(poses: pd.DataFrame) -> Array:
    """Return how fast the camera turns at each frame, radians a second: the faster of the steps before and after."""
    from scipy.spatial.transform import Rotation

    # the first and the last frame have one step only
    attitude, times = Rotation.from_quat(poses[_QUATERNION].to_numpy()), poses["t_s"].to_numpy()
    step = (attitude[:-1].inv() * attitude[1:]).magnitude() / np.diff(times)
    return np.asarray(np.maximum(np.append(step, 0.0), np.insert(step, 0, 0.0)))
