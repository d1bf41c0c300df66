"""Reader of `locards_adsb`: airliners' messages, each heard by five of 27 receivers, as arrivals and a height.

Each message is an epoch with a free position and an unknown emission time; arrival times are counted from the first
arrival of their message, so that metres keep their digits. Frame: ECEF. The height is the aircraft's own h_geo.

Noise: arrivals 30 m, the robust residual spread in the set's README (10 m of it is timing; the rest are station biases,
refraction and errors of the truth), height 30 m (the quantum is 25 ft). Propagation is taken as in vacuum, or with the
refractivity of the README, 315 ppm at sea level with a scale height of 7.5 km, as a known correction of each arrival.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from data.reference import Reference, centred, descend, ecef, horizontal
from scipy.constants import speed_of_light

from optloc import ECEF, Motion, Problem, assemble, measured, station_array
from optloc.constraints import height

ARRIVAL, HEIGHT = 30.0, 30.0
REFRACTIVITY, SCALE_HEIGHT = 315e-6, 7500.0
RADIUS = 6.4e6


@dataclass(frozen=True)
class Messages:
    """The problem and the true positions (k, 3), ECEF metres."""

    problem: Problem
    truth: np.ndarray

    def horizontal(self, position: np.ndarray, messages: np.ndarray) -> np.ndarray:
        """Return horizontal errors (n,) of the positions (n, 3) of some messages, metres."""
        there = self.truth[messages]
        local = np.einsum("kij,kj->ki", ECEF.enu_axes(there), position - there)
        return np.linalg.norm(local[:, :2], axis=1)


def load(folder: Path, *, refraction: bool = False) -> Messages:
    """Return all messages as one problem."""
    stations = pd.read_csv(folder / "stations.csv")
    rows = pd.read_csv(folder / "measurements.csv")
    truth = pd.read_csv(folder / "truth.csv")
    messages = pd.MultiIndex.from_frame(truth[["set", "msg"]])
    epoch = messages.get_indexer(pd.MultiIndex.from_frame(rows[["set", "msg"]]))
    first = rows.groupby(["set", "msg"])["toa_s"].transform("min")
    z = speed_of_light * (rows["toa_s"] - first).to_numpy()
    place, there = (table[["x_m", "y_m", "z_m"]].to_numpy() for table in (stations, truth))
    a, excess = pd.Index(stations["station"]).get_indexer(rows["station"]), 0.0
    if refraction:
        distance = np.linalg.norm(there[epoch] - place[a], axis=-1)
        excess = _refracted(stations["h_m"].to_numpy()[a], truth["h_geo_m"].to_numpy()[epoch], distance)
    problem = assemble(
        station_array(place, stations["station"].astype(str)),
        measured("toa", z, a=a, sigma=ARRIVAL, epoch=epoch, correction=excess),
        measured("height", truth["h_geo_m"].to_numpy(), sigma=HEIGHT, epoch=np.arange(len(truth))),
        motions=(Motion(span="epoch"),),
        frame=ECEF,
    )
    return Messages(problem, there)


@dataclass(frozen=True)
class Heard:
    """Messages with stations of their own: places (n, s, 3), arrivals (n, s), known excess of each (n, s), metres.

    `geodetic` is the true latitude, longitude (radians) and height of each aircraft, (n, 3).
    """

    stations: np.ndarray
    arrival: np.ndarray
    excess: np.ndarray
    geodetic: np.ndarray

    @property
    def truth(self) -> np.ndarray:
        return ecef(self.geodetic[:, :2], self.geodetic[:, 2])

    def problem(self, given: str) -> Problem:
        """Return the messages as a batch; `given` is how the height enters: "exactly", "row", or "nothing"."""
        rows = [
            measured("toa", self.arrival, a=np.arange(self.arrival.shape[1]), sigma=ARRIVAL, correction=self.excess)
        ]
        if given == "row":
            rows.append(measured("height", self.geodetic[:, 2:], sigma=HEIGHT))
        known = [height(exactly=self.geodetic[:, 2])] if given == "exactly" else []
        return assemble(station_array(self.stations[:, None]), *rows, frame=ECEF, constraints=known)

    def from_truth(self, given: str) -> Reference:
        """Return least squares started at the truth, in latitude, longitude and, unless exact, scaled height."""
        altitude, everywhere = self.geodetic[:, 2], np.ones_like(self.arrival)

        def place(u: np.ndarray) -> np.ndarray:
            return ecef(u[:, :2], altitude if given == "exactly" else RADIUS * u[:, 2])

        def residual(u: np.ndarray) -> np.ndarray:
            distance = np.linalg.norm(place(u)[:, None] - self.stations, axis=-1)
            off = centred(self.arrival - self.excess - distance, everywhere) / ARRIVAL
            if given != "row":
                return off
            return np.concatenate([off, (RADIUS * u[:, 2:] - altitude[:, None]) / HEIGHT], axis=1)

        start = self.geodetic[:, :2] if given == "exactly" else self.geodetic / (1.0, 1.0, RADIUS)
        u, cost = descend(residual, start, 1e-7)
        return Reference(place(u), cost)

    def horizontal(self, position: np.ndarray) -> np.ndarray:
        """Return horizontal errors (..., n), metres."""
        return horizontal(position, self.truth, self.geodetic[:, 0], self.geodetic[:, 1])

    def triplets(self) -> Heard:
        """Return every three of the five stations, ten problems for each message in turn."""
        chosen = np.array(list(combinations(range(self.arrival.shape[1]), 3)))
        stations, arrival, excess = (v[:, chosen] for v in (self.stations, self.arrival, self.excess))
        geodetic = np.repeat(self.geodetic, len(chosen), axis=0)
        return Heard(stations.reshape(-1, 3, 3), arrival.reshape(-1, 3), excess.reshape(-1, 3), geodetic)

    @property
    def width(self) -> np.ndarray:
        """Return the least distance between two stations of each message, metres, (n,)."""
        apart = np.linalg.norm(self.stations[:, :, None] - self.stations[:, None], axis=-1)
        return (apart + np.where(np.eye(apart.shape[-1]), np.inf, 0.0)).min((1, 2))

    def unbiased(self) -> Heard:
        """Return the messages less the median residual of each station at the truth."""
        off = self.arrival - self.excess - np.linalg.norm(self.truth[:, None] - self.stations, axis=-1)
        off = off - np.median(off, axis=1, keepdims=True)
        _, station = np.unique(self.stations.reshape(-1, 3), axis=0, return_inverse=True)
        station = station.reshape(off.shape)
        bias = np.array([np.median(off[station == s]) for s in range(station.max() + 1)])
        return replace(self, excess=self.excess + bias[station])

    def take(self, index: np.ndarray) -> Heard:
        """Return some messages."""
        return Heard(self.stations[index], self.arrival[index], self.excess[index], self.geodetic[index])


def heard(folder: Path, *, refraction: bool = False) -> Heard:
    """Return all messages, each with the five stations that heard it."""
    stations, rows, truth = (pd.read_csv(folder / f"{name}.csv") for name in ("stations", "measurements", "truth"))
    stations = stations.set_index("station")
    keys = pd.MultiIndex.from_frame(truth[["set", "msg"]])
    message = keys.get_indexer(pd.MultiIndex.from_frame(rows[["set", "msg"]]))
    rows = rows.iloc[np.argsort(message, kind="stable")]
    toa = rows["toa_s"].to_numpy().reshape(len(truth), -1)
    own = stations.loc[rows["station"]]
    place = own[["x_m", "y_m", "z_m"]].to_numpy().reshape(*toa.shape, 3)
    geodetic = np.column_stack([np.deg2rad(truth[["lat_deg", "lon_deg"]]), truth["h_geo_m"]])
    arrival = speed_of_light * (toa - toa.min(-1, keepdims=True))
    made = Heard(place, arrival, np.zeros_like(arrival), geodetic)
    if not refraction:
        return made
    distance = np.linalg.norm(made.truth[:, None] - place, axis=-1)
    return replace(made, excess=_refracted(own["h_m"].to_numpy().reshape(toa.shape), geodetic[:, 2:], distance))


def _refracted(low: np.ndarray, high: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return by how much air lengthens paths between two heights, metres."""
    drop = np.exp(-low / SCALE_HEIGHT) - np.exp(-high / SCALE_HEIGHT)
    return REFRACTIVITY * SCALE_HEIGHT * drop / (high - low) * distance
