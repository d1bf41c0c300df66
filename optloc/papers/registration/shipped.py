"""The problem file ``registration.toml`` that is shipped with optloc: stations that span space, ten minutes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from optloc.papers.registration.scenario import SPATIAL
from optloc.units import SPEED_OF_LIGHT

NAMES = ("R1", "R2", "R3", "R4", "R5")
DELAYS = (100.0, -133.0, 167.0, -100.0)
"""Nanoseconds by which the clocks of R2 to R5 are late."""

_EPOCHS, _INTERVAL, _SEED = 200, 3.0, 20170502
_ARRIVAL, _STATION = 10.0, 1.0  # ns, m

_PROBLEM = """\
# Five aircraft time an emitter 360 km away for ten minutes, each by a clock of its own. The emitter stands at 200 km,
# 300 km, 0; the clocks of R2 to R5 are 100, -133, 167 and -100 ns late against that of R1.
format = 1
title = "Five aircraft, one emitter, four clock errors"

[stations]
file = "registration-stations.csv"   # where each aircraft is at the first and at the last second
sigma = "1 m"                        # of each coordinate of its position
span = "noise"                       # drawn anew at every epoch

[[measurements]]
kind = "tdoa"
file = "registration-rows.csv"
unit = "ns"
b = "R1"
arrival_sigma = 10.0

[target]
motion = "static"

[[biases]]
name = "clock"
members = ["R2", "R3", "R4", "R5"]   # against that of R1
"""


def files() -> Mapping[str, str]:
    """Return the texts of the problem file and its tables, by name.

    The measurements are drawn here from arrivals at displaced stations, apart from `optloc.simulate`.
    """
    rng = np.random.default_rng(_SEED)
    times = _INTERVAL * np.arange(_EPOCHS)
    track = SPATIAL.position + times[:, None, None] * SPATIAL.velocity
    true = track + _STATION * rng.standard_normal(track.shape)
    arrival = 1e9 / SPEED_OF_LIGHT * np.sqrt(((SPATIAL.target - true) ** 2).sum(-1))
    arrival += _ARRIVAL * rng.standard_normal(arrival.shape) + np.array([0.0, *DELAYS])
    rows = [
        f"{t:.0f},{name},{value:.1f}"
        for t, late in zip(times, arrival - arrival[:, :1], strict=True)
        for name, value in zip(NAMES[1:], late[1:], strict=True)
    ]
    ends = [
        f"{name},{times[k]:.0f},{x:.0f},{y:.0f},{z:.0f}"
        for k in (0, -1)
        for name, (x, y, z) in zip(NAMES, track[k], strict=True)
    ]
    return {
        "registration.toml": _PROBLEM,
        "registration-stations.csv": "\n".join(["name,time,x,y,z", *ends]) + "\n",
        "registration-rows.csv": "\n".join(["time,a,z", *rows]) + "\n",
    }
