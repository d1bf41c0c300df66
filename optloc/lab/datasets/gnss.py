"""Pseudoranges of two fixed receivers, in ECEF: epochs of many satellites, or random draws of three.

Satellites move, so every problem of a batch has its own stations. A draw of three has noise of 1 m a pseudorange. This
is about the robust spread that comes with the set (0.4 to 2 m, mostly slow errors of each satellite). In an epoch with
all satellites the noise is 1 m over the sine of the elevation. Satellites below 10 deg are left out. In shapes, n are
problems and s satellites.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optloc.engine import height, visible
from optloc.lab.datasets.reading import choose, places, table
from optloc.problem import ECEF, Array, Bias, Motion, Problem, assemble, measured, station_array

if TYPE_CHECKING:
    import pandas as pd

SIGMA = 1.0  # metres: between the robust spreads of 0.4 to 2 m that come with the set
MASK = np.deg2rad(10.0)  # below it, errors of troposphere and reflections exceed the noise: the usual mask of surveyors
_XYZ = ("sat_x_m", "sat_y_m", "sat_z_m")


@dataclass(frozen=True, slots=True)
class Receptions:
    """Problems of one session, each with its own satellites.

    `satellites` (n, s, 3) are positions in ECEF metres. `z`, `sigma` and `weight` (n, s) are the pseudoranges and their
    standard deviations in metres, and weights: 0 for an absent satellite, else 1. `systems` (s,) are the initials of
    the satellite systems. `truth` is the receiver (3,), ECEF metres. `geodetic` is its latitude, longitude (radians)
    and height (metres).
    """

    satellites: Array
    z: Array
    sigma: Array
    weight: Array
    systems: tuple[str, ...]
    truth: Array
    geodetic: tuple[float, float, float]

    def by_arrival(self, offset: tuple[str, ...]) -> Problem:
        """Return the epochs as arrivals with an unknown clock, and unknown clock offsets of the systems in `offset`."""
        # A bias affects rows by their station: each satellite of a system refers to the offset of the system.
        offset_satellites = [i for i, system in enumerate(self.systems) if system in offset]
        member = np.array([offset.index(self.systems[i]) for i in offset_satellites])
        bias = Bias("system", offset, np.array(offset_satellites), member, np.ones(len(offset_satellites)))
        count = self.satellites.shape[-2]
        return assemble(
            station_array(self.satellites[:, None]),
            measured("toa", self.z, a=np.arange(count), sigma=self.sigma, weight=self.weight),
            motions=(Motion(),),
            biases=(bias,),
            frame=ECEF,
        )

    def by_difference(self, *, masked: bool = False) -> Problem:
        """Return the draws as differences to their first satellite, with the true height known exactly.

        `masked` adds the constraint that the satellites are above the elevation mask of the receiver.
        """
        known = height(exactly=self.geodetic[2])
        if masked:
            known += visible(np.moveaxis(self.satellites, 1, 0), elevation=MASK)
        others = np.arange(1, self.satellites.shape[-2])
        return assemble(
            station_array(self.satellites[:, None]),
            measured("tdoa", self.z[:, 1:] - self.z[:, :1], a=others, b=np.zeros_like(others), arrival_sigma=SIGMA),
            frame=ECEF,
            constraints=[known],
        )


@dataclass(frozen=True, slots=True)
class Session:
    """All rows of one session above the mask, the column of the pseudorange, and the position of the receiver.

    `truth` (3,) is in ECEF metres, `geodetic` is latitude, longitude (radians) and height (metres).
    """

    rows: pd.DataFrame
    column: str
    truth: Array
    geodetic: tuple[float, float, float]

    def epochs(self, every: int = 1) -> Receptions:
        """Return every `every`-th epoch with all its satellites."""
        times = np.unique(self.rows["t_gps_s"])[::every]
        rows = self.rows[self.rows["t_gps_s"].isin(times)]
        names = sorted(rows["sat"].unique())
        k, s = np.searchsorted(times, rows["t_gps_s"]), np.searchsorted(names, rows["sat"])
        shape = (len(times), len(names))
        z, sigma, weight = np.zeros(shape), np.ones(shape), np.zeros(shape)
        # `k` and `s` are the epoch and the satellite of each row.
        # An absent satellite has weight zero and the position of its first epoch, because no row may be NaN.
        position = np.empty((*shape, 3))
        position[:] = places(rows.groupby("sat")[list(_XYZ)].first().loc[names], _XYZ)
        z[k, s], weight[k, s], position[k, s] = rows[self.column], 1.0, places(rows, _XYZ)
        # The path through the atmosphere, and with it the error of atmospheric models, grows as 1 / sin of the
        # elevation.
        sigma[k, s] = SIGMA / np.sin(rows["el_rad"])
        return Receptions(position, z, sigma, weight, tuple(name[0] for name in names), self.truth, self.geodetic)

    def run(self, column: str | None = None) -> Problem:
        """Return all epochs as one problem of a fixed receiver: arrivals, with an unknown clock in each epoch.

        `column` is the column of the pseudorange; by default the column of the session.
        """
        rows, column = self.rows, column or self.column
        (times, k), (names, s) = (np.unique(rows[c].to_numpy(), return_inverse=True) for c in ("t_gps_s", "sat"))
        position = np.zeros((len(times), len(names), 3))
        position[k, s] = places(rows, _XYZ)
        return assemble(
            station_array(position, names.tolist()),
            measured("toa", rows[column].to_numpy(), a=s, epoch=k, sigma=SIGMA / np.sin(rows["el_rad"].to_numpy())),
            times=times - times[0],
            frame=ECEF,
        )

    def three(self) -> Problem:
        """Return the problem of three satellites that are present in all epochs: differences, and the exact height.

        Of all such GPS satellites these are the three with the best horizontal geometry at the first epoch. The
        differences are against the first of the three.
        """
        times = np.unique(self.rows["t_gps_s"])
        rows = self.rows[self.rows["sat"].str.startswith("G")]
        present = [str(name) for name, count in rows.groupby("sat").size().items() if count == len(times)]
        table = rows[rows["sat"].isin(present)].pivot_table([*_XYZ, self.column], "t_gps_s", "sat")
        # (k, satellites, 3), ECEF metres
        position = np.stack([table[column][present].to_numpy() for column in _XYZ], axis=-1)
        triples = np.array(list(combinations(range(len(present)), 3)))
        best = triples[np.argmax(conditioning(position[0, triples], self.truth, self.geodetic))]
        z = table[self.column][present].to_numpy()[:, best]
        k = len(times)
        differences = measured(
            "tdoa",
            (z[:, 1:] - z[:, :1]).ravel(),
            a=np.tile([1, 2], k),
            b=np.zeros(2 * k, dtype=int),
            epoch=np.repeat(np.arange(k), 2),
            arrival_sigma=SIGMA,
        )
        return assemble(
            station_array(position[:, best]),
            differences,
            times=times - times[0],
            frame=ECEF,
            constraints=[height(exactly=self.geodetic[2])],
        )

    def draws(self, count: int, seed: int) -> Receptions:
        """Return `count` random draws: a random epoch, and three random satellites of this epoch."""
        rng = np.random.default_rng(seed)
        members = list(self.rows.groupby("t_gps_s").indices.values())
        drawn = np.array([rng.choice(members[rng.integers(len(members))], 3, replace=False) for _ in range(count)])
        position = places(self.rows, _XYZ)[drawn]
        z = self.rows[self.column].to_numpy()[drawn]
        return Receptions(position, z, np.full_like(z, SIGMA), np.ones_like(z), ("", "", ""), self.truth, self.geodetic)


def conditioning(satellites: Array, truth: Array, geodetic: tuple[float, float, float]) -> Array:
    """Return the smallest singular value (n,) of the horizontal differences of the directions to three satellites.

    A large value means a good horizontal geometry. `satellites` (n, 3, 3) and `truth` (3,) are in ECEF metres;
    `geodetic` is the latitude, longitude (radians) and height of `truth`.
    """
    lat, lon = geodetic[:2]
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    direction = satellites - truth
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    # The height is known, so only the horizontal components matter.
    difference = direction[:, 1:] - direction[:, :1]
    return np.asarray(np.linalg.svd(difference - (difference @ up)[..., None] * up, compute_uv=False)[:, 1])


def dataset(
    folder: Path, *, session: str = "K078", column: str = "prc_l1_m", form: str = "epochs", every: int = 1
) -> tuple[Problem, Array]:
    """Return the problem of a session, and the true receiver (3,), ECEF metres.

    `form` is "epochs", a batch of arrivals with the offsets of Galileo and QZSS; "run", all epochs of a fixed receiver;
    or "three", differences of three satellites and the known height.
    """
    choose(form, ("epochs", "run", "three"), "form")
    data = load(folder, session, column)
    if form == "epochs":
        found = data.epochs(every)
        return found.by_arrival(tuple(sorted(set(found.systems) - {"G"}))), data.truth
    return data.run() if form == "run" else data.three(), data.truth


def load(folder: Path, session: str, column: str) -> Session:
    """Return one session; `column` selects the pseudorange: "prc_l1_m" (L1) or "prc_if_m" (ionosphere-free)."""
    tables = [table(folder, name) for name in ("truth", "measurements")]
    choose(session, tables[0]["session"], "session")
    choose(column, ("prc_l1_m", "prc_if_m"), "column")
    truth, rows = (found[found["session"] == session] for found in tables)
    site = truth.iloc[0]
    rows = rows[(rows["el_rad"] > MASK) & rows[column].notna()]
    geodetic = (float(np.deg2rad(site["lat_deg"])), float(np.deg2rad(site["lon_deg"])), float(site["h_m"]))
    return Session(rows, column, places(truth)[0], geodetic)
