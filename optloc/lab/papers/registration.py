"""Moving stations with biases, by time differences and gain ratios: the recursion of a paper and fixes without a guess.

Both run on the same data. `optloc.lab.papers.registration_tables` makes the tables and figures; the page is
``registration.md``.

Letters in shapes: s stations, k epochs, n unknowns (the parameter vector: position, velocity of a moving target, delays
of s - 1 stations in metres, gains of s - 1 stations). Units are SI units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import erfc, sqrt
from typing import Literal

import numpy as np

from optloc.bounds import crlb, crlb_course
from optloc.engine import predict, simulate
from optloc.lab.papers.registration_recursion import FIRST, joint_recursion, recursion
from optloc.problem import (
    SPEED_OF_LIGHT,
    Array,
    Block,
    Fix,
    Motion,
    Noise,
    Problem,
    Stations,
    assemble,
    measured,
    with_bias,
)
from optloc.solvers import solve

# The scenes of the paper, as printed, and a scene whose stations span space and never meet.

SPEED = 3e8
"""Speed of light of the paper, metres per second; with it 100 ns are exactly 30 m."""

NANOSECOND = 1e-9 * SPEED
"""Metres that a signal travels in a nanosecond."""

Shape = Literal["full", "half", "diag"]

# Variance of the independent noise of a row, and of the common noise of all rows of an epoch, over sigma squared. The
# shapes are readings of the paper, see `problem`.
_SHAPES: dict[Shape, tuple[float, float]] = {"full": (1.0, 1.0), "half": (0.5, 0.5), "diag": (1.0, 0.0)}


@dataclass(frozen=True, slots=True)
class RegistrationScenario:
    """Stations that fly straight, one target, and the systematic errors of their channels.

    The first station is the reference of every difference and ratio.

    Parameters
    ----------
    position, velocity : array (s, 3)
        Stations at t = 0, metres and metres per second.
    target : array (3,)
        Position of the target at t = 0, metres.
    course : array (3,), optional
        Velocity of the target, metres per second. None: the target is fixed, and only its position is unknown.
    delays : array (s - 1,)
        Biases of the range differences, metres.
    gains : array (s - 1,)
        Biases of the gain ratios.
    sigma : float
        Standard deviation of an arrival, metres.
    interval : float
        Seconds between epochs.
    """

    position: Array
    velocity: Array
    target: Array
    course: Array | None = None
    delays: Array = field(default_factory=lambda: np.array([30.0, -40.0, 50.0, -30.0]))
    gains: Array = field(default_factory=lambda: np.array([0.3, -0.4, 0.5, -0.3]))
    # 10 ns, although the text says 20: only 10 ns reproduces the printed sigma0 of this scene.
    sigma: float = 3.0
    interval: float = 1.0

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the stations: "1", "2" and so on."""
        return tuple(str(i + 1) for i in range(len(self.position)))

    def times(self, epochs: int) -> Array:
        """Return the times (k,) of the first `epochs` epochs, seconds."""
        return self.interval * np.arange(epochs)

    def track(self, epochs: int) -> Array:
        """Return the positions (k, s, 3) of the stations at the first `epochs` epochs, metres."""
        return np.asarray(self.position + self.times(epochs)[:, None, None] * self.velocity)


def _fleet(*rows: tuple[float, ...]) -> tuple[Array, Array]:
    """Return positions (s, 3) in metres and velocities (s, 3) in m/s of stations.

    Each row has three coordinates in kilometres, and three of the velocity in metres per second.
    """
    table = np.array(rows, dtype=float)
    return 1e3 * table[:, :3], table[:, 3:]


PRINTED = RegistrationScenario(
    *_fleet(
        (0, 0, 10, 0, 300, 0),
        (-15, 0, 10, 0, 300, 0),
        (15, 0, 10, 0, 300, 0),
        (-5, 30, 0, 100, 300, 0),
        (5, 30, 0, -100, 300, 0),
    ),
    target=np.array([200e3, 300e3, 0.0]),
)
"""Table 1 as printed: all stations are in one plane at every epoch, and the fourth and fifth meet at 50 s."""

MOVING = replace(PRINTED, target=np.array([200e3, 300e3, 5e3]), course=np.array([-100.0, 0.0, 0.0]))
"""The same stations and the target of section 4.4, which flies straight."""

SPATIAL = RegistrationScenario(
    *_fleet(
        (0, 0, 10, 0, 300, 0),
        (-15, 0, 6, -20, 290, 0),
        (15, 0, 9, 20, 290, 0),
        (-8, 30, 3, -60, 300, 0),
        (8, 30, 11, 60, 280, 0),
    ),
    target=np.array([200e3, 300e3, 0.0]),
)
"""Stations of similar size and speed that span space at every epoch and keep their distance."""


def problem(
    scenario: RegistrationScenario,
    epochs: int,
    *,
    sigma: float | None = None,
    station_sigma: float = 1.0,
    gain_sigma: float | None = None,
    prior: float | None = None,
    shape: Shape = "full",
) -> Problem:
    """Return the estimation problem of the first epochs of a scene, without measurements.

    Parameters
    ----------
    scenario : RegistrationScenario
        Stations and target.
    epochs : int
        Number of epochs K.
    sigma : float, optional
        The sigma in the formula of `shape`, metres: with "full", the standard deviation of an arrival. By default the
        value of the scene.
    station_sigma : float
        Standard deviation of each coordinate of a station, drawn at each epoch, metres; 0 for exact stations.
    gain_sigma : float, optional
        The sigma of gain ratios in the formula of `shape`, without a unit; None: time differences only.
    prior : float, optional
        Prior standard deviation of the biases of the range differences, metres; None: unknown.
    shape : "full", "half" or "diag"
        Covariance of the rows of one kind and epoch: sigma^2 times I + 11', its half, or I. The text of the paper
        allows all three, its numbers only the first.

    Returns
    -------
    Problem
        Unknowns: position, velocity if the target moves, "delay", and "gain" with gain ratios.
    """
    stations, arrival_sigma = len(scenario.position), scenario.sigma if sigma is None else sigma
    a, epoch = np.tile(np.arange(1, stations), epochs), np.repeat(np.arange(epochs), stations - 1)
    kinds = {"tdoa": arrival_sigma} if gain_sigma is None else {"tdoa": arrival_sigma, "groa": gain_sigma}
    rows = [measured(kind, a=a, b=0, epoch=epoch, sigma=size) for kind, size in kinds.items()]
    covariance = np.broadcast_to(station_sigma**2 * np.eye(3), (stations, 3, 3)) if station_sigma else None
    # The reference is station 0. With span="noise", each station has a new position error at each epoch.
    problem = assemble(
        Stations(scenario.track(epochs), scenario.names, covariance=covariance, span="noise"),
        *rows,
        times=scenario.times(epochs),
        motions=[Motion(order=0 if scenario.course is None else 1)],
    )
    independent, common = _SHAPES[shape]
    unit = independent * np.eye(stations - 1) + common
    members = np.arange(problem.count).reshape(-1, stations - 1)
    # One block for each epoch and kind: (epochs, s - 1) rows that share the arrival at the reference.
    blocks = [
        Block(part, size**2 * unit[None])
        for part, size in zip(np.split(members, len(kinds)), kinds.values(), strict=True)
    ]
    problem = with_bias(replace(problem, noise=Noise(tuple(blocks))), "delay", per="pair", kind="tdoa", sigma=prior)
    return problem if gain_sigma is None else with_bias(problem, "gain", per="pair", kind="groa")


def truth(scenario: RegistrationScenario, problem: Problem) -> Array:
    """Return the true parameter vector (size,) of a problem of a scene."""
    values = {
        "position": scenario.target,
        "velocity": scenario.course,
        "delay": scenario.delays,
        "gain": scenario.gains,
    }
    return np.concatenate([np.asarray(values[slot.name], dtype=float) for slot in problem.layout.shared])


FAR = 10.0
"""An estimate further from the truth than this number of bounds is lost: noise does not explain the distance."""


@dataclass(frozen=True, slots=True)
class RegistrationSetting:
    """Setting of a draw.

    Parameters
    ----------
    scenario : RegistrationScenario
        Stations and target.
    trials : int
        Independent draws.
    seed : int
        Seed of the whole reproduction.
    key : int
        Number of this draw within the reproduction.
    sigma, station_sigma, gain_sigma : float, optional
        As in `problem`.
    """

    scenario: RegistrationScenario
    trials: int
    seed: int
    key: int
    sigma: float | None = None
    station_sigma: float = 1.0
    gain_sigma: float | None = None

    def problem(self, epochs: int) -> Problem:
        """Return the problem of the first `epochs` epochs, without measurements."""
        return problem(
            self.scenario,
            epochs,
            sigma=self.sigma,
            station_sigma=self.station_sigma,
            gain_sigma=self.gain_sigma,
        )

    def draw(self, epochs: int) -> Problem:
        """Return the problem of the first `epochs` epochs with the simulated measurements of all trials."""
        problem = self.problem(epochs)
        return simulate(problem, truth(self.scenario, problem), self._sequence(0), self.trials)

    def first(self, drawn: Problem, epochs: int) -> Problem:
        """Return the first `epochs` epochs of a draw."""
        return self.problem(epochs).with_rows(z=drawn.z[..., drawn.epoch < epochs])

    def bound(self, epochs: int) -> Array:
        """Return the Cramer-Rao bound (n, n) of the unknowns after `epochs` epochs, in SI units."""
        return np.asarray(self.bounds((epochs,))[0])

    def bounds(self, epochs: Sequence[int] | Array) -> Array:
        """Return the Cramer-Rao bounds (t, n, n) after each of the t numbers of epochs in `epochs`."""
        problem = self.problem(max(epochs))
        return crlb_course(problem, truth(self.scenario, problem), epochs).covariance

    def starts(self, width: float) -> Array:
        """Return Gaussian starts (trials, n) around the truth, `width` one-shot standard deviations wide, SI units.

        The velocity of a moving target has an error of `width` times 10 m/s in each coordinate.
        """
        scene = self.scenario
        rng = np.random.default_rng(self._sequence(1))
        spread, centre = one_shot(scene, sigma=self.sigma), scene.target
        # One epoch does not determine the velocity: 10 m/s is a tenth of the target's speed.
        if scene.course is not None:
            spread, centre = np.concatenate([spread, np.full(3, 10.0)]), np.concatenate([centre, scene.course])
        return np.asarray(centre + width * spread * rng.standard_normal((self.trials, len(centre))))

    def _sequence(self, purpose: int) -> np.random.SeedSequence:
        """Return the seed for one purpose of the draw: 0 for measurements, 1 for starts."""
        return np.random.SeedSequence(self.seed, spawn_key=(self.key, purpose))


def one_shot(scenario: RegistrationScenario = PRINTED, *, sigma: float | None = None, shape: Shape = "full") -> Array:
    """Return the paper's sigma0: the bound of each coordinate (3,) from the first epoch with known biases, metres.

    The paper measures the width of starts in sigma0. `sigma` and `shape` are as in `problem`.
    """
    fixed = replace(scenario, course=None)
    first_epoch = problem(fixed, 1, sigma=sigma, prior=1e-6, shape=shape)  # a micrometre: the biases are known
    return np.asarray(np.sqrt(np.diagonal(crlb(first_epoch, truth(fixed, first_epoch)))[:3]))


def rms(bound: Array) -> float:
    """Return the root mean square length of a position error with a covariance (n, n), metres."""
    return float(np.sqrt(np.trace(bound[:3, :3])))


@dataclass(frozen=True, slots=True)
class RegistrationScore:
    """Errors of one kind of estimate in all trials.

    Parameters
    ----------
    error : array (trials, n)
        Estimate less truth, SI units; not finite without an estimate.
    lost : bool array (trials,)
        Useless estimates: not finite, or further away than `FAR` bounds.
    """

    error: Array
    lost: Array

    @property
    def rmse(self) -> float:
        """Return the root mean square position error of the trials that are not lost, metres."""
        kept = self.error[~self.lost, :3]
        return float(np.sqrt((kept**2).sum(-1).mean())) if len(kept) else float("nan")

    @property
    def share(self) -> float:
        """Return the share of lost trials."""
        return float(self.lost.mean())


def score(estimate: Array, exact: Array, bound: Array) -> RegistrationScore:
    """Return the errors of estimates (trials, n) of a true vector (n,), and the lost trials by the bound (n, n)."""
    error = estimate - exact
    with np.errstate(invalid="ignore", over="ignore"):
        # Written so that NaN counts as far.
        far = ~((error[:, :3] ** 2).sum(-1) < (FAR * rms(bound)) ** 2)
    return RegistrationScore(error, far | ~np.isfinite(error).all(-1))


def branch(fix: Fix, exact: Array) -> Array:
    """Return, from every fix and its alternatives, the vector (trials, n) whose position is nearest to the truth.

    For a target that moves straight, two mirror images explain the data exactly, and a fix lists both.
    """
    candidates = np.concatenate([fix.x[:, None], fix.alternatives.x], axis=1)
    with np.errstate(invalid="ignore"):
        distance = ((candidates[..., :3] - exact[:3]) ** 2).sum(-1)
    nearest = np.argmin(np.where(np.isfinite(distance), distance, np.inf), axis=1)
    return np.asarray(candidates[np.arange(len(candidates)), nearest])


def wander(
    setting: RegistrationSetting,
    drawn: Problem,
    epochs: Sequence[int],
    bounds: Sequence[Array] | Array,
    *,
    width: float = 1.0,
    first: int = FIRST,
) -> tuple[RegistrationScore, ...]:
    """Return the scores of the paper's recursion after each of the numbers of epochs `epochs`.

    `drawn` are the measurements of all trials. `bounds` are the bounds (n, n) of all n unknowns after these epochs, in
    squared SI units. `width` is the width of the starts in one-shot standard deviations, see `starts`. `first` is the
    number of epochs of the first estimate.
    """
    scene, last = setting.scenario, max(epochs)
    # Rows of each kind as (trials, last, s - 1). Gain ratios are present only with `gain_sigma`.
    z, *gains = (rows.z.reshape(setting.trials, drawn.epochs, -1)[:, :last] for rows in drawn.rows)
    track, times, start = scene.track(last), scene.times(last), setting.starts(width)
    if setting.gain_sigma is None:
        estimates = recursion(track, times, z, start, first=first)
    else:
        sigma = (scene.sigma if setting.sigma is None else setting.sigma, setting.gain_sigma, setting.station_sigma)
        estimates = joint_recursion(track, z, gains[0], start, sigma, first=first)
    exact = truth(scene, drawn)[: estimates.shape[-1]]
    return tuple(score(estimates[:, k - first], exact, bound) for k, bound in zip(epochs, bounds, strict=True))


# The second minimum of a flat array: the target's image in the plane of the stations.

_SAME = 1.0  # metres: without noise the truth is found to far less, and an image is kilometres away


@dataclass(frozen=True, slots=True)
class GhostSolution:
    """Another minimum of the cost of noise-free measurements.

    Parameters
    ----------
    x : array (n,)
        Its parameter vector.
    gap : float
        Its cost: a weighted sum of squares, zero at the truth.
    """

    x: Array
    gap: float

    @property
    def doubt(self) -> float:
        """Return the probability that noise makes this minimum cheaper than the truth."""
        # The difference of both costs is normal with mean `gap` and standard deviation 2 sqrt(gap).
        return 0.5 * erfc(sqrt(self.gap) / 2.0 / sqrt(2.0))


def mirror(scenario: RegistrationScenario) -> tuple[Array, Array]:
    """Return position at t = 0 and velocity, (3,) each, of the target's image in the plane of the stations, SI units.

    The plane fits the stations best at t = 0, and moves with their mean velocity.
    """
    centre = scenario.position.mean(0)
    normal = np.linalg.svd(scenario.position - centre)[2][-1]  # the direction of least spread
    course = np.zeros(3) if scenario.course is None else scenario.course
    drift = scenario.velocity.mean(0)
    position = scenario.target - 2.0 * ((scenario.target - centre) @ normal) * normal
    return position, course - 2.0 * ((course - drift) @ normal) * normal


def ghost(
    scenario: RegistrationScenario, epochs: int, *, sigma: float | None = None, station_sigma: float = 1.0
) -> GhostSolution | None:
    """Return the second minimum of the cost for noise-free measurements of a scene, or None.

    Least squares starts at the mirror image of the target. The result is None if it ends at the truth.

    Parameters
    ----------
    scenario : RegistrationScenario
        Stations and target.
    epochs : int
        Number of epochs.
    sigma, station_sigma : float
        As in `problem`.
    """
    without_rows = problem(scenario, epochs, sigma=sigma, station_sigma=station_sigma)
    exact = truth(scenario, without_rows)
    position, velocity = mirror(scenario)  # of the image at time zero
    if scenario.course is None:
        # The image drifts with the stations; the best fixed target is at the middle of its path.
        state = position + 0.5 * scenario.times(epochs)[-1] * velocity
    else:
        state = np.concatenate([position, velocity])
    start = np.concatenate([state, exact[len(state) :]])
    fix = solve(without_rows.with_rows(z=predict(without_rows, exact)), "lsr", start=start)
    if np.linalg.norm(fix.x[:3] - exact[:3]) < _SAME:
        return None
    return GhostSolution(fix.x, float(fix.cost))


# The problem file ``registration.toml`` that is shipped with optloc: stations that span space, ten minutes.

NAMES = ("R1", "R2", "R3", "R4", "R5")
DELAYS = (100.0, -133.0, 167.0, -100.0)
"""Delays of the clocks of R2 to R5, nanoseconds: 30, -40, 50 and -30 m, the biases of `RegistrationScenario`."""

# Ten minutes in a file of a dozen kilobytes, and the noise of the paper: nanoseconds, metres.
_EPOCHS, _INTERVAL, _SEED = 200, 3.0, 20170502
_ARRIVAL, _STATION = 10.0, 1.0

_PROBLEM = """\
# Five aircraft measure the arrival times of an emitter 360 km away for ten minutes, each with a separate clock. The
# emitter is at 200 km, 300 km, 0. The clocks of R2 to R5 are 100, -133, 167 and -100 ns late against the clock of R1.
format = 2
title = "Five aircraft, one emitter, four clock errors"

[stations]
file = "registration-stations.csv"   # position of each aircraft at the first and at the last second
sigma = "1 m"                        # of each coordinate of the position
span = "noise"                       # independent at every epoch

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
members = ["R2", "R3", "R4", "R5"]   # against the clock of R1
"""


def files() -> Mapping[str, str]:
    """Return the texts of the problem file and its tables, by name.

    The measurements are drawn here from arrivals at displaced stations, independently of `optloc.simulate`.
    """
    rng = np.random.default_rng(_SEED)
    times = _INTERVAL * np.arange(_EPOCHS)
    track = SPATIAL.position + times[:, None, None] * SPATIAL.velocity
    displaced = track + _STATION * rng.standard_normal(track.shape)
    # Nanoseconds. The delays are constant errors of all stations but the first, which is the reference.
    arrival = 1e9 / SPEED_OF_LIGHT * np.sqrt(((SPATIAL.target - displaced) ** 2).sum(-1))
    arrival += _ARRIVAL * rng.standard_normal(arrival.shape) + np.array([0.0, *DELAYS])
    rows = [
        f"{t:.0f},{name},{value:.1f}"
        for t, difference in zip(times, arrival - arrival[:, :1], strict=True)
        for name, value in zip(NAMES[1:], difference[1:], strict=True)
    ]
    end_rows = [
        f"{name},{times[k]:.0f},{x:.0f},{y:.0f},{z:.0f}"
        for k in (0, -1)
        for name, (x, y, z) in zip(NAMES, track[k], strict=True)
    ]
    return {
        "registration.toml": _PROBLEM,
        "registration-stations.csv": "\n".join(["name,time,x,y,z", *end_rows]) + "\n",
        "registration-rows.csv": "\n".join(["time,a,z", *rows]) + "\n",
    }
