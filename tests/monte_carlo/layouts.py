"""The cases: stations, emitters and noise of every Monte Carlo table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from zlib import crc32

import numpy as np
from monte_carlo.reference import Model
from scipy.constants import speed_of_light

from optloc import Problem, assemble, measured

Array = np.ndarray
Rng = np.random.Generator

SEED = 20251121
BOX = np.array([10e3, 10e3, 6e3])
# Specification of the paper `kinematic`, A4 and A7.
Y_ARRAY = 100e3 * np.array([[0.0, 0.0], [0.0, 1.0], [-np.sqrt(0.75), -0.5], [np.sqrt(0.75), -0.5]])
Y_TARGETS = 1e3 * np.array([[300.0, 400.0], [350.0, 450.0], [250.0, 350.0]])


@dataclass(frozen=True)
class Kind:
    """How stations become rows: for the reference a matrix on ranges, for the package a problem."""

    combine: Callable[[int], Array | None]
    problem: Callable[[Array, Array, float], Problem]
    covariance: Callable[[int, float], Array]
    emission: bool = False


@dataclass(frozen=True)
class Case:
    """One line of the tables.

    Parameters
    ----------
    name : str
        Also decides the seed.
    kind : str
        Key of `KINDS`.
    stations : callable
        ``(rng, trials) -> (trials, s, d)``.
    emitters : callable
        ``(rng, trials) -> (trials, d)``.
    sigma : float
        Metres or radians.
    box : float
        Half-width of the box of wild starts, metres.
    """

    name: str
    kind: str
    stations: Callable[[Rng, int], Array]
    emitters: Callable[[Rng, int], Array]
    sigma: float
    box: float

    @property
    def seed(self) -> np.random.SeedSequence:
        return np.random.SeedSequence([SEED, crc32(self.name.encode())])


def _pairs(s: int) -> tuple[Array, Array]:
    a = np.arange(1, s)
    return a, np.zeros_like(a)


def _to_first(sign: float, s: int) -> Array:
    return np.concatenate([np.full((s - 1, 1), sign), np.eye(s - 1)], axis=1)


def _paired(kind: str, noise: str, stations: Array, z: Array, sigma: float) -> Problem:
    a, b = _pairs(stations.shape[1])
    scaled = {"sigma": sigma} if noise == "sigma" else {"arrival_sigma": sigma / np.sqrt(2.0)}
    return assemble(stations[:, None], measured(kind, z, a=a, b=b, **scaled))


def _single(kind: str, stations: Array, z: Array, sigma: float) -> Problem:
    return assemble(stations[:, None], measured(kind, z, a=np.arange(stations.shape[1]), sigma=sigma))


def _angles(stations: Array, z: Array, sigma: float) -> Problem:
    s = stations.shape[1]
    azimuth = measured("azimuth", z[:, :s], a=np.arange(s), sigma=sigma)
    return assemble(stations[:, None], azimuth, measured("elevation", z[:, s:], a=np.arange(s), sigma=sigma))


def _shared(m: int, sigma: float) -> Array:
    return 0.5 * sigma**2 * (np.eye(m) + 1.0)


def _white(m: int, sigma: float) -> Array:
    return sigma**2 * np.eye(m)


KINDS = {
    "tdoa": Kind(partial(_to_first, -1.0), partial(_paired, "tdoa", "arrival"), _shared),
    "tdoa, white": Kind(partial(_to_first, -1.0), partial(_paired, "tdoa", "sigma"), _white),
    "range sum": Kind(partial(_to_first, 1.0), partial(_paired, "range_sum", "sigma"), _white),
    "range": Kind(np.eye, partial(_single, "range"), _white),
    "toa": Kind(np.eye, partial(_single, "toa"), _white, emission=True),
    "angles": Kind(lambda s: None, _angles, _white),
}


def model(kind: Kind, stations: Array, sigma: float) -> Model:
    """Return the reference's own model of a case."""
    combine = kind.combine(stations.shape[1])
    m = 2 * stations.shape[1] if combine is None else len(combine)
    white = np.linalg.inv(np.linalg.cholesky(kind.covariance(m, sigma)))
    if kind.emission:  # rows are h + t, equally weighted: least squares over t takes the mean off
        white = white @ (np.eye(m) - 1.0 / m)
    return Model(stations, combine, white)


def anywhere(s: int, rng: Rng, trials: int) -> Array:
    """Return stations placed at random in the box, anew in every trial."""
    return rng.uniform(-0.5, 0.5, (trials, s, 3)) * BOX


def inside(rng: Rng, trials: int) -> Array:
    return rng.uniform(-0.5, 0.5, (trials, 3)) * BOX


def outside(rng: Rng, trials: int) -> Array:
    """Return emitters 10 to 30 km from the middle of the box, in all directions."""
    way = rng.standard_normal((trials, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(10e3, 30e3, (trials, 1))


def fixed(places: Array, rng: Rng, trials: int) -> Array:
    return np.broadcast_to(places, (trials, *places.shape))


def near_targets(rng: Rng, trials: int) -> Array:
    """Return points within some 10 km of the paper's three targets."""
    return Y_TARGETS[rng.integers(3, size=trials)] + rng.normal(0.0, 5e3, (trials, 2))


def square(rng: Rng, trials: int) -> Array:
    return rng.uniform(-600e3, 600e3, (trials, 2))


def _in_space(label: str, kind: str, s: int, sigmas: tuple[float, ...], unit: tuple[float, str]) -> list[Case]:
    return [
        Case(f"{label}, {where}, {sigma / unit[0]:g} {unit[1]}", kind, partial(anywhere, s), emitters, sigma, 50e3)
        for where, emitters in (("inside", inside), ("outside", outside))
        for sigma in sigmas
    ]


def _in_plane(label: str, emitters: Callable[[Rng, int], Array]) -> list[Case]:
    stations = partial(fixed, Y_ARRAY)
    return [
        Case(
            f"planar TDOA, {label}, {time * 1e9:g} ns", "tdoa, white", stations, emitters, time * speed_of_light, 1000e3
        )
        for time in (1e-9, 10e-9, 100e-9, 1e-6)
    ]


METRES, MILLIRADIANS = (1.0, "m"), (1e-3, "mrad")
CASES = [
    *_in_space("TDOA, 5 stations", "tdoa", 5, (1.0, 10.0, 30.0), METRES),
    *_in_space("TDOA, 6 stations", "tdoa", 6, (1.0, 10.0, 30.0), METRES),
    *_in_plane("3 targets", near_targets),
    *_in_plane("random", square),
    *_in_space("azimuth and elevation, 4 stations", "angles", 4, (5e-3, 20e-3, 50e-3), MILLIRADIANS),
    *_in_space("range, 5 stations", "range", 5, (1.0, 10.0, 30.0), METRES),
    *_in_space("TOA, 6 stations", "toa", 6, (1.0, 10.0, 30.0), METRES),
    *_in_space("range sum, 6 stations", "range sum", 6, (1.0, 10.0, 30.0), METRES),
]
NAMES = [case.name for case in CASES]


def _extremes(names: list[str]) -> list[str]:
    """Return the least and the greatest noise of every family of cases."""
    families: dict[str, list[str]] = {}
    for name in names:
        families.setdefault(name.rpartition(", ")[0], []).append(name)
    return [name for family in families.values() for name in (family[0], family[-1])]


# What runs every day; all of them run in full.
DAILY = _extremes(NAMES)
