"""The cases of the study of covariances: networks and arrays at stated distances, a batch of each."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from optloc import Problem, assemble, measured, simulate

Array = np.ndarray
BOX = np.array([10e3, 10e3, 6e3])


def _directions(rng: np.random.Generator, count: int, d: int) -> Array:
    ahead = rng.standard_normal((count, d))
    return ahead / np.linalg.norm(ahead, axis=1, keepdims=True)


def tdoa(d: int, n: int, far: float, count: int, seed: list[int]) -> tuple[Problem, Array]:
    """Receivers at random in 10 x 10 (x 6) km, 10 m an arrival, the emitter so many kilometres from their middle."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(-0.5, 0.5, (count, 1, n, d)) * BOX[:d]
    truth = far * 1e3 * _directions(rng, count, d) if far else rng.uniform(-0.5, 0.5, (count, d)) * BOX[:d]
    return simulate(assemble(place, measured("tdoa", a=range(1, n), b=0, arrival_sigma=10.0)), truth, seed), truth


def azel(n: int, far: float, count: int, seed: list[int]) -> tuple[Problem, Array]:
    """Azimuths and elevations of 10 mrad."""
    rng = np.random.default_rng(seed)
    place, truth = rng.uniform(-0.5, 0.5, (count, 1, n, 3)) * BOX, far * 1e3 * _directions(rng, count, 3)
    angles = [measured(kind, a=range(n), sigma=0.01) for kind in ("azimuth", "elevation")]
    return simulate(assemble(place, *angles), truth, seed), truth


def aoa(n: int, far: float, mrad: float, count: int, seed: list[int]) -> tuple[Problem, Array]:
    """Bearings, stations in 2 x 2 km."""
    rng = np.random.default_rng(seed)
    place, truth = rng.uniform(-1e3, 1e3, (count, 1, n, 2)), far * 1e3 * _directions(rng, count, 2)
    return simulate(assemble(place, measured("azimuth", a=range(n), sigma=1e-3 * mrad)), truth, seed), truth


def plane(uneven: float, height: float, count: int, seed: list[int]) -> tuple[Problem, Array]:
    """Five ranges of 10 m, station heights N(0, h), the emitter at a height."""
    rng = np.random.default_rng(seed)
    place = np.concatenate([rng.uniform(-5e3, 5e3, (count, 5, 2)), uneven * rng.standard_normal((count, 5, 1))], -1)
    truth = np.concatenate([rng.uniform(-5e3, 5e3, (count, 2)), np.full((count, 1), height)], -1)
    return simulate(assemble(place[:, None], measured("range", a=range(5), sigma=10.0)), truth, seed), truth


def line(count: int, seed: list[int]) -> tuple[Problem, Array]:
    """Eight ranges of 1 m, stations within 1 m of a line of 10 km."""
    rng = np.random.default_rng(seed)
    along = np.broadcast_to(np.linspace(0.0, 10e3, 8)[:, None], (count, 8, 1))
    place = np.concatenate([along, rng.uniform(-1.0, 1.0, (count, 8, 2))], -1)
    truth = np.concatenate([rng.uniform(0.0, 10e3, (count, 1)), rng.uniform(-5e3, 5e3, (count, 2))], -1)
    return simulate(assemble(place[:, None], measured("range", a=range(8), sigma=1.0)), truth, seed), truth


def ranges_in_the_plane(count: int, seed: list[int]) -> tuple[Problem, Array]:
    """Four ranges of 10 m in the plane."""
    rng = np.random.default_rng(seed)
    place, truth = rng.uniform(-5e3, 5e3, (count, 1, 4, 2)), rng.uniform(-5e3, 5e3, (count, 2))
    return simulate(assemble(place, measured("range", a=range(4), sigma=10.0)), truth, seed), truth


def ground(n: int, uneven: float, count: int, seed: list[int]) -> tuple[Problem, Array]:
    """Receivers on nearly flat ground, 6 x 6 km, heights N(0, h), 10 m a difference, an aircraft 9 km high."""
    rng = np.random.default_rng(seed)
    place = np.concatenate([rng.uniform(-3e3, 3e3, (count, n, 2)), uneven * rng.standard_normal((count, n, 1))], -1)
    truth = np.concatenate([rng.uniform(-3e3, 3e3, (count, 2)), np.full((count, 1), 9e3)], -1)
    rows = measured("tdoa", a=range(1, n), b=0, arrival_sigma=10.0)
    return simulate(assemble(place[:, None], rows), truth, seed), truth


def aircraft(count: int, seed: list[int]) -> tuple[Problem, Array]:
    """Five receivers of a wide-area network, 0 to 800 m high, 20 m an arrival, aircraft 3 to 12 km high and around."""
    rng = np.random.default_rng(seed)
    place = np.concatenate([rng.uniform(-40e3, 40e3, (count, 5, 2)), rng.uniform(0.0, 800.0, (count, 5, 1))], -1)
    truth = np.concatenate([rng.uniform(-80e3, 80e3, (count, 2)), rng.uniform(3e3, 12e3, (count, 1))], -1)
    rows = measured("tdoa", a=range(1, 5), b=0, arrival_sigma=20.0)
    return simulate(assemble(place[:, None], rows), truth, seed), truth


Case = Callable[[int, list[int]], tuple[Problem, Array]]
CASES: dict[str, Case] = {
    "tdoa 2 5 0": partial(tdoa, 2, 5, 0.0),
    "tdoa 2 5 30": partial(tdoa, 2, 5, 30.0),
    "tdoa 2 5 100": partial(tdoa, 2, 5, 100.0),
    "tdoa 2 5 300": partial(tdoa, 2, 5, 300.0),
    "tdoa 3 5 30": partial(tdoa, 3, 5, 30.0),
    "tdoa 3 6 0": partial(tdoa, 3, 6, 0.0),
    "tdoa 3 6 30": partial(tdoa, 3, 6, 30.0),
    "tdoa 3 6 100": partial(tdoa, 3, 6, 100.0),
    "azel 4 30": partial(azel, 4, 30.0),
    "azel 4 100": partial(azel, 4, 100.0),
    "azel 4 300": partial(azel, 4, 300.0),
    "aoa 3 5 10": partial(aoa, 3, 5.0, 10.0),
    "aoa 3 20 10": partial(aoa, 3, 20.0, 10.0),
    "aoa 3 50 10": partial(aoa, 3, 50.0, 10.0),
    "plane 5 100": partial(plane, 5.0, 100.0),
    "plane 50 400": partial(plane, 50.0, 400.0),
    "plane 200 1000": partial(plane, 200.0, 1000.0),
    "line": line,
    "r2": ranges_in_the_plane,
}
"""Kind, dimension, receivers and kilometres; angles in milliradians last; heights of stations and emitter."""

GROUND: dict[str, Case] = {
    "ground 5 30": partial(ground, 5, 30.0),
    "ground 5 100": partial(ground, 5, 100.0),
    "ground 6 30": partial(ground, 6, 30.0),
    "aircraft": aircraft,
}
"""Mirror images: receivers in nearly one plane."""
