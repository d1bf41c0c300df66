"""Cells of the proof's tables: stations, emitters and rows whose fixes are proven, and random trials of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from optloc import Frame, Problem, Stations, assemble, measured
from optloc.linear.constraints import height

Array = np.ndarray
Rng = np.random.Generator
SEED = 20261121
BOX = np.array([10e3, 10e3, 6e3])


@dataclass(frozen=True)
class Cell:
    """One kind of trial.

    Parameters
    ----------
    name : str
        Also decides the seed.
    build : callable
        ``(rng, trials) -> (problem, truth)``.
    """

    name: str
    build: Callable[[Rng, int], tuple[Problem, Array]]

    def drawn(self, trials: int, more: int = 0, seed: int = 0) -> tuple[Problem, Array]:
        """Return problems with measurements and their emitters (N, d); `more` and `seed` ask for other trials."""
        return self.build(np.random.default_rng([SEED + seed, crc32(self.name.encode()), more]), trials)


def random_box(rng: Rng, n: int, s: int) -> Array:
    return rng.uniform(-0.5, 0.5, (n, s, 3)) * BOX


def flat_box(rng: Rng, n: int, s: int) -> Array:
    """Return stations that are a plane but for 100 m."""
    return random_box(rng, n, s) * [1.0, 1.0, 100.0 / BOX[2]]


def inside(rng: Rng, n: int) -> Array:
    return rng.uniform(-0.5, 0.5, (n, 3)) * BOX


def outside(rng: Rng, n: int) -> Array:
    way = rng.standard_normal((n, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(10e3, 30e3, (n, 1))


def ranges(stations: Array, x: Array) -> Array:
    return np.linalg.norm(x[:, None] - stations, axis=-1)


def rows(kind: str, stations: Array, x: Array, sigma: float, rng: Rng):
    """Return measured rows of one kind: pairs to station 0, or single stations."""
    n, s = stations.shape[:2]
    r, apart = ranges(stations, x), x[:, None] - stations
    a, b = np.arange(1, s), np.zeros(s - 1, dtype=int)
    if kind == "tdoa":
        arrival = r + sigma * rng.standard_normal((n, s))
        return [measured("tdoa", arrival[:, 1:] - arrival[:, :1], a=a, b=b, arrival_sigma=sigma)]
    if kind == "groa":
        z = r[:, 1:] / r[:, :1] + sigma * rng.standard_normal((n, s - 1))
        return [measured("groa", z, a=a, b=b, sigma=sigma)]
    if kind == "rss_difference":
        level = -20.0 * np.log10(r) + sigma * rng.standard_normal((n, s))
        return [measured(kind, level[:, 1:] - level[:, :1], a=a, b=b, arrival_sigma=sigma)]
    if kind == "pairs":  # range differences of stations none of which has two
        a, b = np.arange(0, s - 1, 2), np.arange(1, s, 2)
        z = r[:, a] - r[:, b] + sigma * rng.standard_normal((n, len(a)))
        return [measured("tdoa", z, a=a, b=b, sigma=sigma)]
    if kind == "range_sum":
        z = r[:, 1:] + r[:, :1] + sigma * rng.standard_normal((n, s - 1))
        return [measured("range_sum", z, a=a, b=b, sigma=sigma)]
    if kind in ("range", "toa"):
        late = rng.uniform(-1e5, 1e5, (n, 1)) if kind == "toa" else 0.0
        return [measured(kind, r + late + sigma * rng.standard_normal((n, s)), a=np.arange(s), sigma=sigma)]
    assert kind == "aoa"
    azimuth = np.arctan2(apart[..., 1], apart[..., 0]) + sigma * rng.standard_normal((n, s))
    found = [measured("azimuth", azimuth, a=np.arange(s), sigma=sigma)]
    if stations.shape[-1] == 3:
        elevation = np.arcsin(apart[..., 2] / r) + sigma * rng.standard_normal((n, s))
        found.append(measured("elevation", elevation, a=np.arange(s), sigma=sigma))
    return found


def spatial(
    parts: tuple[tuple[str, int, float], ...], where: Callable[[Rng, int], Array], place: Callable = random_box
) -> Callable[[Rng, int], tuple[Problem, Array]]:
    """Return the builder of trials whose rows are (kind, number of stations, sigma): each takes the first stations."""

    def build(rng: Rng, n: int) -> tuple[Problem, Array]:
        stations, x = place(rng, n, max(s for _, s, _ in parts)), where(rng, n)
        made = [row for kind, s, sigma in parts for row in rows(kind, stations[:, :s], x, sigma, rng)]
        return assemble(stations[:, None], *made), x

    return build


def planar(kind: str, s: int, sigma: float, reach: float) -> Callable[[Rng, int], tuple[Problem, Array]]:
    """Return the builder of trials in the plane: stations in a box of 10 km, emitters within `reach`."""

    def build(rng: Rng, n: int) -> tuple[Problem, Array]:
        stations, x = rng.uniform(-5e3, 5e3, (n, s, 2)), rng.uniform(-reach, reach, (n, 2))
        return assemble(stations[:, None], *rows(kind, stations, x, sigma, rng)), x

    return build


def bistatic(rng: Rng, n: int) -> tuple[Problem, Array]:
    """Return trials of one receiver with angles and two illuminators."""
    stations, x = random_box(rng, n, 3), inside(rng, n) + np.array([0.0, 0.0, 5e3])
    r = ranges(stations, x)
    sums = measured(
        "range_sum", r[:, 1:] + r[:, :1] + 10.0 * rng.standard_normal((n, 2)), a=[1, 2], b=[0, 0], sigma=10.0
    )
    return assemble(stations[:, None], sums, *rows("aoa", stations[:, :1], x, 5e-3, rng)), x


def satellites(rng: Rng, n: int) -> tuple[Problem, Array]:
    """Return trials of three satellites and a known height: range differences to 15 m."""
    earth = Frame("ecef")
    lat, lon = np.radians(rng.uniform(-60.0, 60.0, n)), np.radians(rng.uniform(-180.0, 180.0, n))
    truth = earth.from_geodetic(lat, lon, np.zeros(n))
    turn = rng.uniform(0.0, 2.0 * np.pi, (n, 1)) + 2.1 * np.arange(3) + rng.uniform(-0.5, 0.5, (n, 3))
    tilt = np.radians(rng.uniform(4.0, 9.0, (n, 3)))
    place = earth.from_geodetic(
        np.clip(lat[:, None] + tilt * np.sin(turn), -1.5, 1.5),
        (lon[:, None] + tilt * np.cos(turn) / np.cos(lat[:, None]) + np.pi) % (2 * np.pi) - np.pi,
        np.full((n, 3), 800e3),
    )
    names = ("A", "B", "C")
    tdoa = rows("tdoa", place, truth, 15.0, rng)
    return assemble(Stations(place[:, None], names), *tdoa, frame=earth, constraints=height(exactly=0.0)), truth


def _family(label: str, parts: Callable[[float], tuple], sigmas: tuple[float, ...], unit: str, place: Callable):
    return [
        Cell(f"{label}, {where}, {sigma * (1e3 if unit == 'mrad' else 1):g} {unit}", spatial(parts(sigma), emit, place))
        for where, emit in (("inside", inside), ("outside", outside))
        for sigma in sigmas
    ]


METRES = (1.0, 10.0, 30.0)
CELLS = [
    *_family("TDOA, 6 stations", lambda s: (("tdoa", 6, s),), METRES, "m", random_box),
    *_family("TDOA, 5 stations", lambda s: (("tdoa", 5, s),), METRES, "m", random_box),
    *_family("TDOA, 6 stations, near-coplanar", lambda s: (("tdoa", 6, s),), (10.0, 30.0), "m", flat_box),
    *_family("TDOA, 5 stations, near-coplanar", lambda s: (("tdoa", 5, s),), (10.0, 30.0), "m", flat_box),
    *_family("range, 5 stations", lambda s: (("range", 5, s),), METRES, "m", random_box),
    *_family("TOA, 6 stations", lambda s: (("toa", 6, s),), METRES, "m", random_box),
    *_family("range sum, 6 stations", lambda s: (("range_sum", 6, s),), METRES, "m", random_box),
    *_family("AOA, 4 stations", lambda s: (("aoa", 4, s),), (5e-3, 20e-3), "mrad", random_box),
    *_family("GROA + TDOA, 5 stations", lambda s: (("tdoa", 5, s), ("groa", 5, 0.01)), (10.0,), "m", random_box),
    *_family("AOA + TDOA, 4 stations", lambda s: (("tdoa", 4, s), ("aoa", 1, 0.01)), (10.0,), "m", random_box),
    *_family("GROA, 6 stations", lambda s: (("groa", 6, 1e-3 * s),), (2.0,), "permille", random_box),
    *_family("RSS, 6 stations", lambda s: (("rss_difference", 6, s),), (0.1,), "dB", random_box),
    *_family("TDOA, 3 disjoint pairs", lambda s: (("pairs", 6, s),), (3.0,), "m", random_box),
    Cell("RSS in the plane, 5 stations, 0.5 dB", planar("rss_difference", 5, 0.5, 20e3)),
    Cell("TDOA in the plane, 2 disjoint pairs, 3 m", planar("pairs", 4, 3.0, 20e3)),
    Cell("TDOA in the plane, 4 stations, 10 m", planar("tdoa", 4, 10.0, 20e3)),
    Cell("AOA in the plane, 3 stations, 10 mrad", planar("aoa", 3, 10e-3, 20e3)),
    Cell("bistatic, two illuminators, 10 m, 5 mrad", bistatic),
    Cell("three satellites and a height, 15 m", satellites),
]
BY_NAME = {cell.name: cell for cell in CELLS}
