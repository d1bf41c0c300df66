"""Problems of the benchmark of kinds: one fix of every kind of measurements, with priors, constraints and errors."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from benchmarks import opponents as op
from benchmarks.opponents import Opponent, independent, joined, shared_arrival, stacked

import optloc
from optloc import Problem, assemble, constraints, measured, with_bias
from optloc.base.types import Prior, Stations, Status

Array = np.ndarray
TRIALS, BATCH = 12, 10_000
FAST = "gtrs+lsr"
# Metres, radians, one, decibels, metres.
SIGMA, ANGLE, RATIO, LEVEL, CLOCK = 7.0, 0.01, 0.01, 0.2, 5.0


@dataclass(frozen=True)
class Answers:
    """Answers of the trials of a row.

    Parameters
    ----------
    status : sequence of str
        Labels; empty where a method has no status.
    cost : array (N,)
        Weighted sum of squared residuals.
    error : array (N,)
        Distance from the truth, metres.
    """

    status: Sequence[str]
    cost: Array
    error: Array


@dataclass(frozen=True)
class Way:
    """One way to solve the trials of a row.

    Parameters
    ----------
    ready : callable
        Returns a call for each trial, on objects that no call used before.
    read : callable
        Returns the answers of the results of these calls.
    size : int
        Answers of one call.
    """

    ready: Callable[[], list[Callable[[], Any]]]
    read: Callable[[list[Any]], Answers]
    size: int = 1


@dataclass(frozen=True)
class Case:
    """One row of the table.

    Parameters
    ----------
    name : str
        Of the row.
    ways : dict of str to Way
        Columns that it has: "prepare", "solve", "auto", "batch", "opponent".
    opponent : str
        Opponent, and its start.
    """

    name: str
    ways: dict[str, Way]
    opponent: str = "SciPy LM from the truth"


def labels(code: Array) -> list[str]:
    """Return the labels of status numbers (N,)."""
    return [Status(int(number)).label for number in np.ravel(code)]


def generator(name: str) -> np.random.Generator:
    """Return the random numbers of a row: they stay where rows are added."""
    return np.random.default_rng(zlib.crc32(name.encode()))


@dataclass(frozen=True)
class Kind:
    """Fixes of one kind: the same problem for optloc and for the opponent.

    Parameters
    ----------
    name : str
        Of the row.
    pose : callable
        Returns optloc's problem of measurements (..., m).
    opponent : Opponent
        The problem in plain NumPy.
    truth : array (n,) or callable
        Unknowns of the opponent, or a function of a generator and a count that returns (N, n).
    batch : int
        Fixes of a batch.
    place : callable
        Returns the position of unknowns of the opponent.
    """

    name: str
    pose: Callable[[Array], Problem]
    opponent: Opponent
    truth: Array | Callable[[np.random.Generator, int], Array]
    batch: int = BATCH
    place: Callable[[Array], Array] = field(default=lambda p: p)

    @cached_property
    def drawn(self) -> tuple[Array, Array]:
        """Return the truth (N, n) and measurements (N, m); trials and batch are the first of them."""
        rng = generator(self.name)
        # Always the same number: the size of a batch must not change the trials.
        truth = self.truth(rng, BATCH) if callable(self.truth) else np.tile(self.truth, (BATCH, 1))
        return truth, self.opponent.draw(truth, rng)

    @property
    def trials(self) -> list[tuple[Array, Array]]:
        """Return truth and measurements of each trial."""
        truth, z = self.drawn
        return list(zip(truth[:TRIALS], z[:TRIALS], strict=True))

    def case(self) -> Case:
        """Return the row of the table."""
        prepared = optloc.prepare(self.pose(self.trials[0][1]), FAST)
        batch = self.drawn[1][: self.batch]

        def single(method: str) -> list[Callable[[], Any]]:
            problems = [self.pose(z) for _, z in self.trials]
            return [lambda p=p: optloc.solve(p, method) for p in problems]

        def many() -> list[Callable[[], Any]]:
            problem = self.pose(batch)
            return [lambda: optloc.solve(problem, FAST)]

        ways = {
            "prepare": Way(lambda: [lambda z=z: prepared(z) for _, z in self.trials], self.read),
            "solve": Way(lambda: single(FAST), self.read),
            "auto": Way(lambda: single("auto"), self.read),
            "batch": Way(many, self.read, len(batch)),
            "opponent": Way(lambda: [self.opponent.ready(z, p) for p, z in self.trials], self.read_opponent),
        }
        return Case(self.name, ways)

    def read(self, fixes: list[Any]) -> Answers:
        """Return the answers of fixes of optloc."""
        flat = [fix if fix.shape else fix.flat() for fix in fixes]
        code, cost, x = (
            np.concatenate(parts) for parts in zip(*((f.code, f.cost, f.position) for f in flat), strict=True)
        )
        truth = np.array([self.place(p) for p in self.drawn[0][: len(x)]])
        return Answers(labels(code), cost, np.linalg.norm(x - truth, axis=1))

    def read_opponent(self, found: list[Any]) -> Answers:
        """Return the answers of SciPy."""
        x = np.array([self.place(one.x) for one in found])
        truth = np.array([self.place(p) for p, _ in self.trials])
        return Answers([], np.array([2.0 * one.cost for one in found]), np.linalg.norm(x - truth, axis=1))


# Six stations in space and an emitter among them.

S = 1e3 * np.array([[0.0, 0, 0], [10, 0, 6], [0, 10, 3], [10, 10, 0], [5, 5, 6], [2, 7, 1]])
T = np.array([3e3, 4e3, 2e3])
FLAT, LINE = S * [1.0, 1.0, 0.0], S * [1.0, 0.0, 0.0]
ALL, OTHERS, NAMES = np.arange(6), np.arange(1, 6), tuple("ABCDEF")
ENU, TANGENT = optloc.Frame.enu(lat_deg=47.0, lon_deg=11.0), op.Tangent(np.radians(47.0), np.radians(11.0))
HEIGHT = float(TANGENT.geodetic(T)[2])
WITH_EMISSION = np.r_[T, 0.0]
ISOTROPIC, UPRIGHT = np.eye(3) * 4.0, np.diag([4.0, 4.0, 100.0])


def tdoa(z: Array, stations: Any = S, **more: Any) -> Problem:
    """Return differences to the first station whose arrivals have independent errors."""
    a = np.arange(1, z.shape[-1] + 1)
    return assemble(stations, measured("tdoa", z, a=a, b=0, arrival_sigma=SIGMA), **more)


def of_kind(kind: str, sigma: float, a: Array, stations: Array = S, **more: Any) -> Callable[[Array], Problem]:
    """Return rows of one kind with independent errors; `more` are options of the rows."""
    return lambda z: assemble(stations, measured(kind, z, a=a, sigma=sigma, **more))


def mixed(*parts: tuple[str, int, dict[str, Any]], stations: Any = S, **more: Any) -> Callable[[Array], Problem]:
    """Return rows of several kinds: kind, count and options of each."""
    cuts = np.cumsum([count for _, count, _ in parts])[:-1]

    def pose(z: Array) -> Problem:
        values = np.split(z, cuts, axis=-1)
        rows = [measured(kind, value, **options) for (kind, _, options), value in zip(parts, values, strict=True)]
        return assemble(stations, *rows, **more)

    return pose


def erring(covariance: Array, span: str) -> Stations:
    """Return six stations whose positions have errors."""
    return Stations(S[None], NAMES, covariance=np.broadcast_to(covariance, (6, 3, 3)), span=span)


def with_errors(covariance: Array) -> tuple[Opponent, Callable[[np.random.Generator, int], Array]]:
    """Return the opponent that estimates 18 station errors, too, and its truth: errors are drawn."""
    root = np.linalg.cholesky(covariance)

    def truth(rng: np.random.Generator, count: int) -> Array:
        errors = rng.standard_normal((count, 6, 3)) @ root.T
        return np.concatenate([np.tile(T, (count, 1)), errors.reshape(count, 18)], axis=1)

    blocks = joined(shared_arrival(5, SIGMA), *[covariance] * 6)
    return Opponent(op.with_station_errors(S), blocks, np.zeros(18)), truth


def weighed(covariance: Array) -> Callable[[Array], Array]:
    """Return the covariance of differences as a function of the position: station errors along the lines of sight."""

    def at(x: Array) -> Array:
        unit = op.unit_vectors(S, x)[1]
        variance = ((unit @ covariance) * unit).sum(1)
        return shared_arrival(5, SIGMA) + variance[0] + np.diag(variance[1:])

    return at


RANGES, TDOA = op.ranges(S), op.differences(S)
PLAIN = Opponent(TDOA, shared_arrival(5, SIGMA))
SLANT = Opponent(RANGES, independent((6, SIGMA)))
BEARINGS = stacked(op.azimuths(S), op.elevations(S))
AT_HEIGHT = TANGENT.at_height(HEIGHT)
AZIMUTH, ELEVATION = {"a": ALL, "sigma": ANGLE}, {"a": ALL, "sigma": ANGLE}
CLOCKS = ("S1", "S2", "S3", "S4", "S5")
PRIOR = Prior("position", T + 100.0, np.eye(3) * 1e4)


def with_clocks(z: Array) -> Problem:
    """Return differences whose first station has the right clock; the opponent has the prior of the others as noise."""
    return with_bias(tdoa(z), "clock", members=CLOCKS, sigma=CLOCK)


def station_errors(name: str, covariance: Array, batch: int) -> Kind:
    opponent, truth = with_errors(covariance)
    return Kind(name, lambda z: tdoa(z, erring(covariance, "epoch")), opponent, truth, batch, lambda p: p[..., :3])


SIX = (
    Kind("tdoa", tdoa, PLAIN, T),
    Kind(
        "tdoa, independent errors",
        of_kind("tdoa", SIGMA, OTHERS, b=0),
        Opponent(TDOA, independent((5, SIGMA))),
        T,
    ),
    Kind("tdoa, ENU frame", lambda z: tdoa(z, frame=ENU), PLAIN, T),
    Kind(
        "tdoa + exact height, ENU",
        lambda z: tdoa(z, frame=ENU, constraints=[constraints.height(exactly=HEIGHT)]),
        Opponent(op.through(TDOA, AT_HEIGHT), shared_arrival(5, SIGMA), scale="jac"),
        np.array(TANGENT.geodetic(T)[:2]),
        200,
        AT_HEIGHT.value,
    ),
    Kind("tdoa + above ground", lambda z: tdoa(z, frame=ENU, constraints=[constraints.height(lower=0.0)]), PLAIN, T),
    Kind("tdoa + box", lambda z: tdoa(z, constraints=[constraints.box([-1e4] * 3, [2e4] * 3)]), PLAIN, T),
    Kind(
        "toa",
        of_kind("toa", SIGMA, ALL),
        Opponent(op.with_emission(RANGES), independent((6, SIGMA))),
        WITH_EMISSION,
        place=lambda p: p[..., :3],
    ),
    Kind("range", of_kind("range", SIGMA, ALL), SLANT, T),
    Kind(
        "range_sum",
        lambda z: assemble(S, measured("range_sum", z, a=0, b=OTHERS, sigma=SIGMA)),
        Opponent(op.differences(S, sign=1.0), independent((5, SIGMA))),
        T,
    ),
    Kind(
        "range + tdoa",
        mixed(
            ("range", 3, {"a": ALL[:3], "sigma": SIGMA}),
            ("tdoa", 3, {"a": ALL[3:], "b": 0, "sigma": SIGMA}),
        ),
        Opponent(stacked(op.ranges(S, slice(3)), op.differences(S, slice(3, None))), independent((6, SIGMA))),
        T,
    ),
    Kind(
        "tdoa + azimuth",
        mixed(
            ("tdoa", 5, {"a": OTHERS, "b": 0, "arrival_sigma": SIGMA}),
            ("azimuth", 1, {"a": [0], "sigma": ANGLE}),
        ),
        Opponent(
            stacked(TDOA, op.azimuths(S, slice(1))),
            joined(shared_arrival(5, SIGMA), independent((1, ANGLE))),
            angles=slice(5, 6),
        ),
        T,
    ),
    Kind(
        "toa + measured height, ENU",
        mixed(("toa", 6, {"a": ALL, "sigma": SIGMA}), ("height", 1, {"sigma": 10.0}), frame=ENU),
        Opponent(op.with_emission(RANGES, TANGENT.height()), independent((6, SIGMA), (1, 10.0))),
        WITH_EMISSION,
        2_000,
        lambda p: p[..., :3],
    ),
    Kind("groa", of_kind("groa", RATIO, OTHERS, b=0), Opponent(op.ratios(S), independent((5, RATIO))), T),
    Kind(
        "rss_difference",
        of_kind("rss_difference", LEVEL, OTHERS, b=0),
        Opponent(op.level_differences(S), independent((5, LEVEL))),
        T,
    ),
    Kind(
        "azimuth, in the plane",
        of_kind("azimuth", ANGLE, ALL, S[:, :2]),
        Opponent(op.azimuths(S[:, :2]), independent((6, ANGLE)), angles=slice(6)),
        T[:2],
    ),
    Kind(
        "azimuth + elevation",
        mixed(("azimuth", 6, AZIMUTH), ("elevation", 6, ELEVATION)),
        Opponent(BEARINGS, independent((12, ANGLE)), angles=slice(6)),
        T,
    ),
    Kind("tdoa, clock prior", with_clocks, Opponent(TDOA, shared_arrival(5, SIGMA) + CLOCK**2 * np.eye(5)), T),
    Kind(
        "tdoa, position prior",
        lambda z: tdoa(z, priors=[PRIOR]),
        Opponent(stacked(TDOA, op.coordinates(3)), joined(shared_arrival(5, SIGMA), np.eye(3) * 1e4), T + 100.0),
        T,
    ),
    station_errors("tdoa, station errors", ISOTROPIC, 2_000),
    station_errors("tdoa, station errors, upright", UPRIGHT, 2_000),
    Kind(
        "tdoa, station errors, upright, as noise",
        lambda z: tdoa(z, erring(UPRIGHT, "noise")),
        Opponent(TDOA, weighed(UPRIGHT)),
        T,
    ),
)

# Minimal and degenerate sets: as many rows as unknowns, a mirror image, a circle of positions.

FEW = (
    Kind("tdoa, 4 stations", lambda z: tdoa(z, S[:4]), Opponent(op.differences(S[:4]), shared_arrival(3, SIGMA)), T),
    Kind(
        "tdoa, 6 stations in a plane",
        lambda z: tdoa(z, FLAT),
        Opponent(op.differences(FLAT), shared_arrival(5, SIGMA)),
        T,
    ),
    Kind(
        "range, 3 stations",
        of_kind("range", SIGMA, ALL[:3], S[:3]),
        Opponent(op.ranges(S[:3]), independent((3, SIGMA))),
        T,
    ),
    Kind(
        "range, 6 stations in a plane",
        of_kind("range", SIGMA, ALL, FLAT),
        Opponent(op.ranges(FLAT), independent((6, SIGMA))),
        T,
    ),
    Kind(
        "range, 6 stations on a line",
        of_kind("range", SIGMA, ALL, LINE),
        Opponent(op.ranges(LINE), independent((6, SIGMA))),
        T,
        1_000,
    ),
)

# A pair of aircraft, a bistatic radar, satellites.

PAIR_TIMES = np.array([0.0, 10.0, 20.0])
PAIR_VELOCITY = np.array([[120.0, 20.0], [110.0, -30.0]])
PAIR = np.array([[-10e3, 0.0], [10e3, 0.0]]) + PAIR_TIMES[:, None, None] * PAIR_VELOCITY
RADAR = np.array([[0.0, 0.0, 0.0], [12e3, 3e3, 400.0], [-4e3, 15e3, 200.0]])
COARSE = np.radians(1.0)
SATELLITES = op.ecef(np.radians([50.0, 45.0, 49.0]), np.radians([5.0, 12.0, 18.0]), 600e3)
SEA = op.Tangent().at_height(0.0)
SATELLITE_SIGMA = 100.0 / np.sqrt(2.0)


def pair(z: Array) -> Problem:
    """Return differences of range and of Doppler of two aircraft at three epochs."""
    stations = optloc.station_array(PAIR, velocity=np.broadcast_to(PAIR_VELOCITY, PAIR.shape))
    epoch = np.arange(3)
    rows = (
        measured("tdoa", z[..., :3], a=0, b=1, epoch=epoch, sigma=30.0),
        measured("fdoa", z[..., 3:], a=0, b=1, epoch=epoch, sigma=0.3),
    )
    return assemble(stations, *rows, times=PAIR_TIMES)


def satellites(z: Array) -> Problem:
    """Return differences of three satellites for an emitter on the ellipsoid."""
    rows = measured("tdoa", z, a=[1, 2], b=0, arrival_sigma=SATELLITE_SIGMA)
    return assemble(SATELLITES, rows, frame=optloc.problem.ECEF, constraints=[constraints.height(exactly=0.0)])


MOVING = (
    Kind(
        "tdoa + fdoa, a pair over 3 epochs",
        pair,
        Opponent(op.pair_with_rates(PAIR, PAIR_VELOCITY), independent((3, 30.0), (3, 0.3))),
        lambda rng, n: np.stack([rng.uniform(-15e3, 15e3, n), rng.uniform(5e3, 30e3, n)], axis=1),
    ),
    Kind(
        "range_sum + azimuth + elevation",
        mixed(
            ("range_sum", 2, {"a": 0, "b": [1, 2], "sigma": 30.0}),
            ("azimuth", 1, {"a": [0], "sigma": COARSE}),
            ("elevation", 1, {"a": [0], "sigma": COARSE}),
            stations=RADAR,
        ),
        Opponent(
            stacked(op.differences(RADAR, sign=1.0), op.azimuths(RADAR, slice(1)), op.elevations(RADAR, slice(1))),
            independent((2, 30.0), (2, COARSE)),
            angles=slice(2, 3),
        ),
        lambda rng, n: np.c_[rng.uniform(-20e3, 20e3, (n, 2)), rng.uniform(1e3, 8e3, n)],
    ),
    Kind(
        "tdoa of satellites + exact height",
        satellites,
        Opponent(op.through(op.differences(SATELLITES), SEA), shared_arrival(2, SATELLITE_SIGMA), scale="jac"),
        lambda rng, n: np.radians(np.stack([48.0 + rng.uniform(-3, 3, n), 11.0 + rng.uniform(-4, 4, n)], axis=1)),
        500,
        SEA.value,
    ),
)

KINDS = SIX + FEW + MOVING
