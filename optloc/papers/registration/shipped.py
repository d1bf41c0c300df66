"""The problem file ``registration.toml`` that is shipped with optloc: stations that span space, eight minutes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from optloc.papers.registration.scenario import SPATIAL
from optloc.units import SPEED_OF_LIGHT

NAMES = ("A", "B", "C", "D", "E")
DELAYS = (100.0, -133.0, 167.0, -100.0)
"""Nanoseconds by which the receivers B to E are late."""

_EPOCHS, _INTERVAL, _SEED = 240, 2.0, 20170502
_ARRIVAL, _STATION = 10.0, 1.0  # ns, m

_PROBLEM = """\
# Five aircraft time the pulses of one emitter on the ground, 360 km away, every two seconds for eight minutes. The clock
# of each runs late by an unknown amount, and the positions that they report are wrong by a metre. True place: 200 km,
# 300 km, 0; true delays of B to E against A: 100, -133, 167, -100 ns.
format = 1
title = "Five moving receivers with unknown delays"

[stations]
file = "registration-stations.csv"
sigma = "1 m"
span = "noise"

[target]
motion = "static"

[[measurements]]
kind = "tdoa"
file = "registration-tdoa.csv"
columns = { a = "receiver", time = "t", z = "tdoa" }
b = "A"
unit = "ns"
arrival_sigma = 10.0

[[biases]]
name = "delay"
members = ["B", "C", "D", "E"]
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
        f"{t:.0f},{name},{value:.2f}"
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
        "registration-tdoa.csv": "\n".join(["t,receiver,tdoa", *rows]) + "\n",
    }
