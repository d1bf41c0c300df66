"""Bearings of markers from a moving camera of known pose: groups of six bearings of a marker, or a run as one problem.

Each bearing is an azimuth and an elevation in the axes of the camera. Every group is a separate problem: its six
stations are the poses of the camera at six frames. Noise: 0.3 deg an angle (robust spread 0.2 deg).

A whole run is also one problem: one moving camera and fixed markers.
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

SIGMA = np.deg2rad(0.3)  # of an angle in a group: 1.5 times the robust spread
# Radians and seconds. The noise grows with the turning rate, because bearings and poses are 0.09 s apart. The number is
# a fit of the residuals at the true positions against the rate.
STILL, LAG = np.deg2rad(0.2), 0.09
SIZE = 6  # bearings in a group; markers with fewer bearings are left out
_QUATERNION = ["qx", "qy", "qz", "qw"]


@dataclass(frozen=True, slots=True)
class MarkGroups:
    """Groups of six bearings of one marker each, in SI units and radians.

    `place` (n, 6, 3) are the positions of the camera in metres. `axes` (n, 6, 3, 3) are its axes in the room, one axis
    in each row. `angles` (n, 6, 2) are azimuths and elevations. `truth` (n, 3) are the positions of the markers in
    metres, and `rate` (n, 6) the turning rates of the camera in rad/s.
    """

    place: Array
    axes: Array
    angles: Array
    truth: Array
    rate: Array

    def problem(self, *, turning: bool = False, known: bool = False) -> Problem:
        """Return the groups as a batch of problems.

        With `turning`, the noise grows with the turning rate; with `known`, the positions of the markers are given.
        """
        stations = replace(station_array(self.place[:, None]), axes=self.axes[:, None])
        sigma, each = _sigma(self.rate) if turning else SIGMA, np.arange(SIZE)
        rows = [
            measured(kind, self.angles[..., i], a=each, sigma=sigma) for i, kind in enumerate(("azimuth", "elevation"))
        ]
        return assemble(stations, *rows, motions=(Motion(known=self.truth[:, None, None]) if known else Motion(),))

    def turned(self, turn: Array) -> MarkGroups:
        """Return the groups with the camera's axes turned by the rotation vector `turn` (3,) of its mount, radians.

        SciPy makes the same rotation as optloc's boresight: the unit quaternion along (1, turn / 2).
        """
        from scipy.spatial.transform import Rotation

        mount = Rotation.from_quat([*(turn / 2.0), 1.0]).inv().as_matrix()
        return replace(self, axes=mount @ self.axes)


@dataclass(frozen=True, slots=True)
class CameraBearings:
    """One run of the camera.

    `poses` are the poses of the camera by frame. `rows` are the bearings of the markers in order of time. `markers` are
    the positions of the markers by tag.
    """

    poses: pd.DataFrame
    rows: pd.DataFrame
    markers: pd.DataFrame

    def half(self, number: int) -> CameraBearings:
        """Return the even frames (`number` 0) or the odd frames (1)."""
        frames = np.unique(self.rows["frame"])[number::2]
        return replace(self, rows=self.rows[self.rows["frame"].isin(frames)])

    def often(self) -> CameraBearings:
        """Return the run without the markers that have fewer than six bearings."""
        counts = self.rows["tag"].value_counts()
        return replace(self, rows=self.rows[self.rows["tag"].isin(counts.index[counts >= SIZE])])

    @property
    def truth(self) -> Array:
        """Return the positions of the markers (t, 3), metres, in the order of `problem`."""
        return places(self.markers.loc[np.unique(self.rows["tag"])])

    def problem(self) -> Problem:
        """Return the run as one problem: a moving camera, and a fixed target for each marker."""
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
        """Return `count` groups of six random bearings of a marker; the markers are random too."""
        rng = np.random.default_rng(seed)
        counts = self.rows["tag"].value_counts().sort_index()
        counts = counts[counts >= SIZE]
        # Markers are drawn in proportion to their bearings, so that all bearings have the same probability.
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
    """Return the problem of a run, and the true positions (n, 3), metres.

    `form` is "groups", a batch of `count` groups of six bearings of one marker. Or it is "run", the whole run with the
    markers that have at least six bearings. `seed` is the seed of the groups; `count` and `seed` have no effect on
    "run". `attitude` of the mount is "nom" (by design) or "cal" (calibrated). `without` are markers to leave out.
    """
    choose(form, ("groups", "run"), "form")
    data = read_run(folder, run, attitude, without=without)
    if form == "run":
        return data.often().problem(), data.often().truth
    found = data.groups(count, seed)
    return found.problem(), found.truth


def read_run(folder: Path, name: str, attitude: str, *, without: tuple[int, ...] = ()) -> CameraBearings:
    """Return one run without some markers; `attitude` of the mount: by design ("nom") or calibrated ("cal")."""
    tables = [table(folder, file) for file in ("stations", "truth", "measurements")]
    choose(name, tables[0]["run"].unique(), "run")
    choose(attitude, ("nom", "cal"), "attitude")
    stations, truth, rows = (found[found["run"] == name] for found in tables)
    poses = stations.set_index("frame").sort_index()
    poses = poses.rename(columns={f"{attitude}_{c}": c for c in ("x_m", "y_m", "z_m", *_QUATERNION)})
    return CameraBearings(poses.assign(rate=_rate(poses)), rows[~rows["tag"].isin(without)], truth.set_index("tag"))


def load(folder: Path, name: str, attitude: str, groups: int, seed: int) -> MarkGroups:
    """Return `groups` random groups of one run; `attitude` of the mount: by design ("nom") or calibrated ("cal")."""
    return read_run(folder, name, attitude).groups(groups, seed)


def _sigma(rate: Array) -> Array:
    """Return the standard deviations of angles in radians, at turning rates in rad/s."""
    return np.hypot(STILL, LAG * rate)


def _axes(poses: pd.DataFrame) -> Array:
    """Return the axes (n, 3, 3) of the camera in the room, one axis in each row."""
    from scipy.spatial.transform import Rotation

    return np.swapaxes(Rotation.from_quat(poses[_QUATERNION].to_numpy()).as_matrix(), -1, -2)


def _rate(poses: pd.DataFrame) -> Array:
    """Return the turning rate of the camera at each frame (n,), rad/s: the larger of the rates before and after it."""
    from scipy.spatial.transform import Rotation

    # The first and the last frame have one neighbour only.
    attitude, times = Rotation.from_quat(poses[_QUATERNION].to_numpy()), poses["t_s"].to_numpy()
    step = (attitude[:-1].inv() * attitude[1:]).magnitude() / np.diff(times)
    return np.asarray(np.maximum(np.append(step, 0.0), np.insert(step, 0, 0.0)))
