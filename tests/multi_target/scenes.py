"""Epochs of several emitters with rows without names, false rows and missed ones."""

from dataclasses import dataclass

import numpy as np

import optloc
from optloc.multi_target import Clutter

RADIUS, SIGMA, BEARING, DETECTION = 10e3, 10.0, 2e-3, 0.9
TURN = 2.0 * np.pi * np.arange(6) / 6
RING = RADIUS * np.stack([np.cos(TURN), 0.9 * np.sin(TURN)], axis=-1)
HEIGHTS = np.array([0.0, 800.0, 100.0, 1500.0, 300.0, 1000.0])
STAR = [(i, 0) for i in range(1, 6)]
# An epoch of bearings, for `drawn`.
AZIMUTHS = {"kind": "azimuth", "channels": [0, 1, 2, 3, 4]}
EVERY = [(i, j) for i in range(6) for j in range(i)]


@dataclass(frozen=True)
class Drawn:
    """An epoch and its truth."""

    problem: optloc.Problem
    stations: np.ndarray  # (s, d)
    channels: list  # pairs of stations, or single stations
    kind: str
    sigma: float
    density: float
    emitters: np.ndarray  # (n, d)
    owner: np.ndarray  # (m,) of each row, -1 false

    @property
    def clutter(self):
        return Clutter(DETECTION, self.density)

    def values(self):
        """Return global rows of each channel."""
        rows = self.problem.rows[0]
        keys = list(zip(rows.a.tolist(), rows.b.tolist(), strict=True))
        return [
            np.array([r for r, key in enumerate(keys) if key == c], dtype=int)
            for c in ((c if isinstance(c, tuple) else (c, -1)) for c in self.channels)
        ]


def model(kind, stations, channels, x):
    """Return h (..., m) at places x (..., d), written out."""
    if kind == "azimuth":
        away = x[..., None, :] - stations[channels]
        return np.arctan2(away[..., 1], away[..., 0])
    r = np.sqrt(((x[..., None, :] - stations) ** 2).sum(-1))
    a, b = np.array(channels).T
    return r[..., a] - r[..., b]


def drawn(seed, count, *, d=2, channels=STAR, kind="tdoa", false=1, detection=DETECTION, places=None):
    """Return an epoch; every channel has `false` false rows, anywhere a true one can be."""
    rng = np.random.default_rng(seed)
    stations = RING if d == 2 else np.column_stack([RING, HEIGHTS])
    x = rng.uniform(-RADIUS, RADIUS, (count, d))
    if d == 3:
        x[:, 2] = rng.uniform(2e3, 8e3, count)
    if places is not None:
        x = np.array(places, dtype=float)
    sigma = SIGMA if kind == "tdoa" else BEARING
    true = model(kind, stations, channels, x) if count else np.zeros((0, len(channels)))
    reach = [np.pi if kind == "azimuth" else np.linalg.norm(stations[c[0]] - stations[c[1]]) for c in channels]
    rows = []
    for i, channel in enumerate(channels):
        seen = [k for k in range(count) if rng.random() < detection]
        rows += [(channel, true[k, i] + sigma * rng.standard_normal(), k) for k in seen]
        rows += [(channel, rng.uniform(-reach[i], reach[i]), -1) for _ in range(false)]
    ends = [c if isinstance(c, tuple) else (c, -1) for c, _, _ in rows]
    a, b = np.array(ends).T
    z = np.array([value for _, value, _ in rows])
    given = optloc.measured(kind, z, a=a, b=b if kind == "tdoa" else None, sigma=sigma, target=-1)
    density = max(false, 1) / (2.0 * np.mean(reach))
    owner = np.array([k for _, _, k in rows])
    return Drawn(optloc.assemble(stations, given), stations, channels, kind, sigma, density, x, owner)
