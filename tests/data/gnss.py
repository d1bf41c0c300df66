"""Reader of `gnss_static`: pseudoranges of two fixed receivers, as epochs of many satellites or draws of three. ECEF.

Satellites move, so every problem of a batch has stations of its own. Noise: 1 m a pseudorange in a draw of three, about
the robust spread in the README (0.4 to 2 m, mostly slow errors of each satellite); 1 m over the sine of the elevation
where an epoch has all its satellites, which is the loss that reproduces the README's table.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from data.reference import Reference, centred, descend, ecef, horizontal

from optloc import ECEF, Bias, Motion, Problem, assemble, measured, station_array
from optloc.constraints import height, visible

SIGMA = 1.0
MASK = np.deg2rad(10.0)


@dataclass(frozen=True)
class Receptions:
    """Problems of one session: satellites (n, s, 3), pseudoranges, sigmas and weights (n, s), their systems (s,).

    `truth` is the receiver (3,), `geodetic` its latitude, longitude (radians) and height.
    """

    satellites: np.ndarray
    z: np.ndarray
    sigma: np.ndarray
    weight: np.ndarray
    systems: tuple[str, ...]
    truth: np.ndarray
    geodetic: tuple[float, float, float]

    def by_arrival(self, offset: tuple[str, ...]) -> Problem:
        """Return the epochs as arrivals with an unknown clock, and an unknown offset of some systems against it."""
        touched = [i for i, system in enumerate(self.systems) if system in offset]
        member = np.array([offset.index(self.systems[i]) for i in touched])
        bias = Bias("system", offset, np.array(touched), member, np.ones(len(touched)))
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

        `masked`: the receiver's elevation mask is known too.
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

    def epochs_from_truth(self, offset: tuple[str, ...]) -> Reference:
        """Return least squares of `by_arrival` started at the truth."""
        shared = [np.ones(len(self.systems)), *(np.array([s == n for s in self.systems], dtype=float) for n in offset)]
        whiten = self.weight / self.sigma
        nuisance = np.stack([column * whiten for column in shared], axis=-1)
        inverse = np.linalg.pinv(nuisance)

        def residual(x: np.ndarray) -> np.ndarray:
            off = (self._off(x) * whiten)[..., None]
            return (off - nuisance @ (inverse @ off))[..., 0]

        return Reference(*descend(residual, np.tile(self.truth, (len(self.z), 1)), 10.0))

    def draws_from_truth(self) -> Reference:
        """Return least squares of `by_difference` started at the truth: arrivals with a common clock."""
        lat, lon, h = self.geodetic
        start = np.tile([lat, lon], (len(self.z), 1))
        coordinates, cost = descend(lambda u: centred(self._off(ecef(u, h)), self.weight) / SIGMA, start, 1e-6)
        return Reference(ecef(coordinates, h), cost)

    def horizontal(self, position: np.ndarray) -> np.ndarray:
        """Return horizontal errors (...), metres."""
        return horizontal(position, self.truth, *(np.asarray(v) for v in self.geodetic[:2]))

    @property
    def conditioned(self) -> np.ndarray:
        """Return the smallest singular value (n,) of a draw's horizontal difference directions, as in the README."""
        lat, lon = self.geodetic[:2]
        up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        line = self.satellites - self.truth
        line = line / np.linalg.norm(line, axis=-1, keepdims=True)
        apart = line[:, 1:] - line[:, :1]
        return np.linalg.svd(apart - (apart @ up)[..., None] * up, compute_uv=False)[:, 1]

    def _off(self, x: np.ndarray) -> np.ndarray:
        return self.z - np.linalg.norm(x[:, None] - self.satellites, axis=-1)


@dataclass(frozen=True)
class Session:
    """All rows of one session above the mask, and its receiver."""

    rows: pd.DataFrame
    column: str
    truth: np.ndarray
    geodetic: tuple[float, float, float]

    def epochs(self, every: int = 1) -> Receptions:
        """Return every n-th epoch with all its satellites."""
        times = np.unique(self.rows["t_gps_s"])[::every]
        rows = self.rows[self.rows["t_gps_s"].isin(times)]
        names = sorted(rows["sat"].unique())
        k, s = np.searchsorted(times, rows["t_gps_s"]), np.searchsorted(names, rows["sat"])
        shape = (len(times), len(names))
        z, sigma, weight = np.zeros(shape), np.ones(shape), np.zeros(shape)
        place = np.empty((*shape, 3))
        place[:] = rows.groupby("sat")[list(_XYZ)].first().loc[names].to_numpy()
        z[k, s], weight[k, s], place[k, s] = rows[self.column], 1.0, rows[list(_XYZ)].to_numpy()
        sigma[k, s] = SIGMA / np.sin(rows["el_rad"])
        return Receptions(place, z, sigma, weight, tuple(n[0] for n in names), self.truth, self.geodetic)

    def run(self, column: str | None = None) -> Problem:
        """Return all epochs as one problem of a receiver that stays: arrivals at a clock of each epoch."""
        rows, column = self.rows, column or self.column
        (times, k), (names, s) = (np.unique(rows[c], return_inverse=True) for c in ("t_gps_s", "sat"))
        place = np.zeros((len(times), len(names), 3))
        place[k, s] = rows[list(_XYZ)]
        return assemble(
            station_array(place, names.tolist()),
            measured("toa", rows[column].to_numpy(), a=s, epoch=k, sigma=SIGMA / np.sin(rows["el_rad"].to_numpy())),
            times=times - times[0],
            frame=ECEF,
        )

    def three(self) -> Problem:
        """Return the differences of three satellites that are heard all the time, with the true height known exactly.

        Of all such GPS satellites these are the three with the best horizontal geometry at the first epoch.
        """
        times = np.unique(self.rows["t_gps_s"])
        rows = self.rows[self.rows["sat"].str.startswith("G")]
        always = [name for name, heard in rows.groupby("sat").size().items() if heard == len(times)]
        table = rows[rows["sat"].isin(always)].pivot_table([*_XYZ, self.column], "t_gps_s", "sat")
        place = np.stack([table[column][always].to_numpy() for column in _XYZ], axis=-1)
        triples = np.array(list(combinations(range(len(always)), 3)))
        first = np.stack([place[0, chosen] for chosen in triples])
        one = np.ones(first.shape[:2])
        conditioned = Receptions(first, one, one, one, ("", "", ""), self.truth, self.geodetic).conditioned
        best = triples[np.argmax(conditioned)]
        z = table[self.column][always].to_numpy()[:, best]
        k = len(times)
        rows_of = measured(
            "tdoa",
            (z[:, 1:] - z[:, :1]).ravel(),
            a=np.tile([1, 2], k),
            b=np.zeros(2 * k, dtype=int),
            epoch=np.repeat(np.arange(k), 2),
            arrival_sigma=SIGMA,
        )
        return assemble(
            station_array(place[:, best]),
            rows_of,
            times=times - times[0],
            frame=ECEF,
            constraints=[height(exactly=self.geodetic[2])],
        )

    def draws(self, count: int, seed: int) -> Receptions:
        """Return three random satellites of a random epoch, `count` times."""
        rng = np.random.default_rng(seed)
        members = list(self.rows.groupby("t_gps_s").indices.values())
        chosen = np.array([rng.choice(members[rng.integers(len(members))], 3, replace=False) for _ in range(count)])
        place = self.rows[list(_XYZ)].to_numpy()[chosen]
        z = self.rows[self.column].to_numpy()[chosen]
        return Receptions(place, z, np.full_like(z, SIGMA), np.ones_like(z), ("", "", ""), self.truth, self.geodetic)


_XYZ = ("sat_x_m", "sat_y_m", "sat_z_m")


def load(folder: Path, session: str, column: str) -> Session:
    """Return one session by `column`, "prc_l1_m" or "prc_if_m"."""
    tables = [pd.read_csv(folder / f"{name}.csv") for name in ("truth", "measurements")]
    truth, rows = (table[table["session"] == session] for table in tables)
    site = truth.iloc[0]
    rows = rows[(rows["el_rad"] > MASK) & rows[column].notna()]
    place = (np.deg2rad(site["lat_deg"]), np.deg2rad(site["lon_deg"]), float(site["h_m"]))
    return Session(rows, column, site[["x_m", "y_m", "z_m"]].to_numpy(dtype=float), place)
