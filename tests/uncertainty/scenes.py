"""Scenes in which covariances in metres hold, or hold in the inverse range, or do not hold at all."""

from __future__ import annotations

from zlib import crc32

import numpy as np

import optloc

SEED = 20261122


def scene(name: str, item: int = 0):
    """Return the problem and the truth of a trial of a case.

    `tdoa d n D`: n receivers in 10 x 10 (x 6) km, 10 m an arrival, emitter D km from the middle; `azel n D`: angles of
    10 mrad; `aoa n D s`: bearings of s mrad from stations in 2 x 2 km; `plane h z`: 5 ranges of 10 m, station heights
    N(0, h), emitter at height z; `line`: 8 ranges of 1 m, stations within 1 m of a line of 10 km; `r2`: 4 ranges of
    10 m in the plane.
    """
    rng = np.random.default_rng([SEED, crc32(name.encode()), item])
    kind, *numbers = name.split()
    values = [float(number) for number in numbers]
    return _CASES[kind](rng, *values)


def fixed(name: str, item: int = 0, method: str = "auto"):
    """Return problem, truth and fix of a trial."""
    problem, truth = scene(name, item)
    return problem, truth, optloc.solve(problem, method)


def _direction(rng, d):
    way = rng.standard_normal(d)
    return way / np.linalg.norm(way)


def _problem_of(stations, truth, rng, *parts):
    template = optloc.assemble(stations, *parts)
    return optloc.simulate(template, truth, int(rng.integers(2**31))), truth


def _tdoa(rng, d, n, far):
    d, n = int(d), int(n)
    stations = rng.uniform(-0.5, 0.5, (n, d)) * np.array([10e3, 10e3, 6e3])[:d]
    truth = far * 1e3 * _direction(rng, d) if far else rng.uniform(-0.5, 0.5, d) * np.array([10e3, 10e3, 6e3])[:d]
    return _problem_of(stations, truth, rng, optloc.measured("tdoa", a=np.arange(1, n), b=0, arrival_sigma=10.0))


def _azel(rng, n, far):
    n = int(n)
    stations, way = rng.uniform(-0.5, 0.5, (n, 3)) * [10e3, 10e3, 6e3], _direction(rng, 3)
    rows = [optloc.measured(kind, a=np.arange(n), sigma=0.01) for kind in ("azimuth", "elevation")]
    return _problem_of(stations, far * 1e3 * way, rng, *rows)


def _aoa(rng, n, far, sigma):
    n = int(n)
    stations = rng.uniform(-1e3, 1e3, (n, 2))
    rows = optloc.measured("azimuth", a=np.arange(n), sigma=sigma * 1e-3)
    return _problem_of(stations, far * 1e3 * _direction(rng, 2), rng, rows)


def _plane(rng, high, z):
    stations = np.column_stack([rng.uniform(-5e3, 5e3, (5, 2)), high * rng.standard_normal(5)])
    truth = np.append(rng.uniform(-5e3, 5e3, 2), z)
    return _problem_of(stations, truth, rng, optloc.measured("range", a=np.arange(5), sigma=10.0))


def _line(rng):
    stations = np.column_stack([np.linspace(-5e3, 5e3, 8), rng.uniform(-1, 1, (8, 2))])
    truth = np.append(rng.uniform(-5e3, 5e3), 3e3 * _direction(rng, 2))
    return _problem_of(stations, truth, rng, optloc.measured("range", a=np.arange(8), sigma=1.0))


def _ranges(rng):
    stations, truth = rng.uniform(-5e3, 5e3, (4, 2)), rng.uniform(-5e3, 5e3, 2)
    return _problem_of(stations, truth, rng, optloc.measured("range", a=np.arange(4), sigma=10.0))


_CASES = {"tdoa": _tdoa, "azel": _azel, "aoa": _aoa, "plane": _plane, "line": _line, "r2": _ranges}
CASES = (
    "tdoa 2 5 0",
    "tdoa 2 5 30",
    "tdoa 2 5 100",
    "tdoa 2 5 300",
    "tdoa 3 6 0",
    "tdoa 3 6 30",
    "azel 4 300",
    "aoa 3 50 10",
    "plane 50 400",
    "plane 200 1000",
    "line",
    "r2",
)
