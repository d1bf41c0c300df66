"""Messages of airliners, each received by five of 27 receivers: arrival times and a height, in ECEF.

Each message is an epoch with a free position and an unknown emission time. Arrival times are counted from the first
arrival of the message, so that metres keep their digits. They are multiplied by the speed of light. The height is from
the GNSS of the aircraft.

Noise: arrivals 30 m, the robust residual spread that comes with the set. Timing is 10 m of it; the rest are station
biases, refraction and errors of the truth. Heights have 30 m (their quantum is 25 ft). Propagation is as in vacuum, or
through air, as a known correction of each arrival. The refractivity of air is 315 ppm at sea level, with a scale height
of 7.5 km.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from optloc.engine import height
from optloc.lab.datasets.reading import choose, places, table
from optloc.problem import ECEF, SPEED_OF_LIGHT, Array, Motion, Problem, assemble, measured, station_array

ARRIVAL = 30.0  # metres: the robust spread of the residuals at the truth that comes with the set
HEIGHT = 30.0  # metres: four times the quantum of the reports, 25 ft
# Mean refractivity at sea level, and the height in metres over which it falls to 1/e: a standard atmosphere.
REFRACTIVITY, SCALE_HEIGHT = 315e-6, 7500.0


@dataclass(frozen=True, slots=True)
class Messages:
    """All messages as one problem, and the true positions (k, 3), ECEF metres."""

    problem: Problem
    truth: Array

    def horizontal(self, position: Array, messages: Array) -> Array:
        """Return the horizontal errors (n,) of positions (n, 3) of the messages with these indices (n,), metres."""
        truth = self.truth[messages]
        local = np.einsum("kij,kj->ki", ECEF.enu_axes(truth), position - truth)
        return np.asarray(np.linalg.norm(local[:, :2], axis=1))


@dataclass(frozen=True, slots=True)
class Heard:
    """Messages as a batch: each message has its own stations, so every array has the message as its first axis.

    `stations` (n, s, 3) are ECEF metres. `arrival` (n, s) are arrival times and `excess` (n, s) the known excess of
    each path, in metres. `geodetic` (n, 3) is the true latitude, longitude (radians) and height (metres) of each
    aircraft.
    """

    stations: Array
    arrival: Array
    excess: Array
    geodetic: Array

    @property
    def truth(self) -> Array:
        """Return the true positions (n, 3), ECEF metres."""
        return ECEF.from_geodetic(*np.moveaxis(self.geodetic, -1, 0))

    def problem(self, given: str) -> Problem:
        """Return the messages as a batch of problems.

        `given` selects the use of the height: "exactly" (a constraint), "row" (a measurement) or "nothing".
        """
        choose(given, ("exactly", "row", "nothing"), "given")
        stations = np.arange(self.arrival.shape[1])
        rows = [measured("toa", self.arrival, a=stations, sigma=ARRIVAL, correction=self.excess)]
        if given == "row":
            rows.append(measured("height", self.geodetic[:, 2:], sigma=HEIGHT))
        known = [height(exactly=self.geodetic[:, 2])] if given == "exactly" else []
        return assemble(station_array(self.stations[:, None]), *rows, frame=ECEF, constraints=known)

    def triplets(self) -> Heard:
        """Return all choices of three of the five stations: ten problems for each message, ordered by message."""
        picked = np.array(list(combinations(range(self.arrival.shape[1]), 3)))
        stations, arrival, excess = (v[:, picked] for v in (self.stations, self.arrival, self.excess))
        geodetic = np.repeat(self.geodetic, len(picked), axis=0)
        return Heard(stations.reshape(-1, 3, 3), arrival.reshape(-1, 3), excess.reshape(-1, 3), geodetic)

    def unbiased(self) -> Heard:
        """Return the messages with the median residual of each station at the truth as a further known correction."""
        residual = self.arrival - self.excess - np.linalg.norm(self.truth[:, None] - self.stations, axis=-1)
        # The median of the five residuals of a message estimates its emission time.
        residual = residual - np.median(residual, axis=1, keepdims=True)
        _, station = np.unique(self.stations.reshape(-1, 3), axis=0, return_inverse=True)
        station = station.reshape(residual.shape)
        bias = np.array([np.median(residual[station == s]) for s in range(station.max() + 1)])
        return replace(self, excess=self.excess + bias[station])

    def take(self, index: Array) -> Heard:
        """Return the messages with these indices."""
        return Heard(self.stations[index], self.arrival[index], self.excess[index], self.geodetic[index])


def dataset(folder: Path, *, refraction: bool = False) -> tuple[Problem, Array]:
    """Return the problem of all messages, each an epoch with arrivals and a height, and the truth (k, 3), metres."""
    data = load(folder, refraction=refraction)
    return data.problem, data.truth


def load(folder: Path, *, refraction: bool = False) -> Messages:
    """Return all messages as one problem; with `refraction`, the arrivals are corrected for the air."""
    import pandas as pd

    stations, rows, truth = (table(folder, name) for name in ("stations", "measurements", "truth"))
    messages = pd.MultiIndex.from_frame(truth[["set", "msg"]])
    epoch = messages.get_indexer(pd.MultiIndex.from_frame(rows[["set", "msg"]]))
    # Count from the first arrival: seconds of the day times c would leave few digits for metres.
    first = rows.groupby(["set", "msg"])["toa_s"].transform("min")
    z = SPEED_OF_LIGHT * (rows["toa_s"] - first).to_numpy()
    position, true_position = places(stations), places(truth)
    a, excess = pd.Index(stations["station"]).get_indexer(rows["station"]), np.zeros(len(rows))
    if refraction:
        distance = np.linalg.norm(true_position[epoch] - position[a], axis=-1)
        excess = _refraction(stations["h_m"].to_numpy()[a], truth["h_geo_m"].to_numpy()[epoch], distance)
    problem = assemble(
        station_array(position, stations["station"].astype(str).tolist()),
        measured("toa", z, a=a, sigma=ARRIVAL, epoch=epoch, correction=excess),
        measured("height", truth["h_geo_m"].to_numpy(), sigma=HEIGHT, epoch=np.arange(len(truth))),
        motions=(Motion(span="epoch"),),
        frame=ECEF,
    )
    return Messages(problem, true_position)


def heard(folder: Path, *, refraction: bool = False) -> Heard:
    """Return all messages as a batch, each with the five stations that received it.

    With `refraction`, the arrivals are corrected for the air.
    """
    import pandas as pd

    stations, rows, truth = (table(folder, name) for name in ("stations", "measurements", "truth"))
    stations = stations.set_index("station")
    keys = pd.MultiIndex.from_frame(truth[["set", "msg"]])
    message = keys.get_indexer(pd.MultiIndex.from_frame(rows[["set", "msg"]]))
    # Sorted by message: five rows for each, so that the columns fold to (n, 5).
    rows = rows.iloc[np.argsort(message, kind="stable")]
    toa = rows["toa_s"].to_numpy().reshape(len(truth), -1)
    receivers = stations.loc[rows["station"]]
    position = places(receivers).reshape(*toa.shape, 3)
    geodetic = np.column_stack([np.deg2rad(truth[["lat_deg", "lon_deg"]]), truth["h_geo_m"]])
    arrival = SPEED_OF_LIGHT * (toa - toa.min(-1, keepdims=True))
    batch = Heard(position, arrival, np.zeros_like(arrival), geodetic)
    if not refraction:
        return batch
    distance = np.linalg.norm(batch.truth[:, None] - position, axis=-1)
    return replace(batch, excess=_refraction(receivers["h_m"].to_numpy().reshape(toa.shape), geodetic[:, 2:], distance))


def _refraction(low: Array, high: Array, distance: Array) -> Array:
    """Return the excess of optical paths through air between two heights, metres.

    `low` and `high` are the heights of receiver and aircraft, and `distance` the lengths of the paths, metres.
    """
    # Mean refractivity of an exponential atmosphere along a straight path between the heights.
    drop = np.exp(-low / SCALE_HEIGHT) - np.exp(-high / SCALE_HEIGHT)
    return np.asarray(REFRACTIVITY * SCALE_HEIGHT * drop / (high - low) * distance)
