"""Reader of `locards_adsb`: airliners' messages, each heard by five of 27 receivers, as arrivals and a height.

Each message is an epoch with a free position and an unknown emission time; arrival times are counted from the first
arrival of their message, so that metres keep their digits. Frame: ECEF. The height is the aircraft's own h_geo.

Noise: arrivals 30 m, the robust residual spread in the set's README (10 m of it is timing; the rest are station biases,
refraction and errors of the truth), height 30 m (the quantum is 25 ft). Propagation is taken as in vacuum.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

from optloc import ECEF, Motion, Problem, assemble, measured, station_array

ARRIVAL, HEIGHT = 30.0, 30.0


@dataclass(frozen=True)
class Messages:
    """The problem and the true positions (k, 3), ECEF metres."""

    problem: Problem
    truth: np.ndarray


def load(folder: Path) -> Messages:
    """Return all messages as one problem."""
    stations = pd.read_csv(folder / "stations.csv")
    rows = pd.read_csv(folder / "measurements.csv")
    truth = pd.read_csv(folder / "truth.csv")
    messages = pd.MultiIndex.from_frame(truth[["set", "msg"]])
    epoch = messages.get_indexer(pd.MultiIndex.from_frame(rows[["set", "msg"]]))
    first = rows.groupby(["set", "msg"])["toa_s"].transform("min")
    z = speed_of_light * (rows["toa_s"] - first).to_numpy()
    problem = assemble(
        station_array(stations[["x_m", "y_m", "z_m"]].to_numpy(), stations["station"].astype(str)),
        measured("toa", z, a=pd.Index(stations["station"]).get_indexer(rows["station"]), sigma=ARRIVAL, epoch=epoch),
        measured("height", truth["h_geo_m"].to_numpy(), sigma=HEIGHT, epoch=np.arange(len(truth))),
        motions=(Motion(span="epoch"),),
        frame=ECEF,
    )
    return Messages(problem, truth[["x_m", "y_m", "z_m"]].to_numpy())
