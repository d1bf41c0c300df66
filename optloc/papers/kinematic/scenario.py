"""The scene of the paper: three targets, four stations, twenty updates behind one fix."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from optloc.build import assemble, measured
from optloc.problem import Problem
from optloc.simulate import simulate
from optloc.solve import solve
from optloc.track import State
from optloc.track.candidates import Candidates
from optloc.types import Array, Motion
from optloc.units import SPEED_OF_LIGHT
from optloc.windows import cut

ORDERS = {"static": 0, "CV": 1, "CA": 2}
"""Models of motion, and how targets move, by name."""


def _star(radius: float) -> Array:
    """Return the reference station at the origin and three around it, at 90, 210 and 330 degrees."""
    angle = np.radians([90.0, 210.0, 330.0])
    return np.vstack([np.zeros(2), radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)])


@dataclass(frozen=True, slots=True)
class Scenario:
    """Stations and targets in the plane; the first station is the reference.

    The paper gives targets, speeds, accelerations and the number of steps; the rest was chosen, see the text of the
    reproduction.

    Parameters
    ----------
    stations : array (s, 2)
        Metres.
    position, velocity, acceleration : array (t, 2)
        Targets at the first epoch, SI units.
    sigma : float
        Standard deviation of a range difference, metres; differences are independent.
    interval : float
        Seconds between epochs.
    steps : int
        Updates behind the first fix.
    speed, rate : float
        Prior standard deviation of each coordinate of velocity and acceleration, SI units.
    """

    stations: Array = field(default_factory=lambda: _star(100e3))
    position: Array = field(default_factory=lambda: 1e3 * np.array([[300.0, 400.0], [350.0, 450.0], [250.0, 350.0]]))
    velocity: Array = field(default_factory=lambda: 1e3 * np.array([[0.0, 1.0], [0.0, -1.0], [0.0, 1.0]]))
    acceleration: Array = field(default_factory=lambda: 1e3 * np.array([[0.0, -0.1], [0.0, 0.1], [0.0, 0.1]]))
    sigma: float = 80e-9 * SPEED_OF_LIGHT
    interval: float = 2.25
    steps: int = 20
    speed: float = 2e3
    rate: float = 1e3

    @property
    def times(self) -> Array:
        """Return the seconds (k,) of the epochs."""
        return self.interval * np.arange(self.steps + 1)

    def course(self, order: int, since: float = 0.0) -> Array:
        """Return the states [p, v, a] (t, k, 6) of targets that stand (0), fly on (1) or accelerate (2).

        Parameters
        ----------
        order : 0, 1 or 2
            Which derivatives are not zero.
        since : float
            Time at which an acceleration begins, seconds.
        """
        t = self.times[:, None]
        late = np.maximum(t - since, 0.0)
        v = self.velocity[:, None] * (order > 0)
        a = self.acceleration[:, None] * (order > 1)
        place = self.position[:, None] + v * t + 0.5 * a * late**2
        return np.concatenate([place, v + a * late, a * (t >= since)], axis=-1)

    def problem(self) -> Problem:
        """Return a run of one target without measurements; a state is free at each epoch."""
        k, others = self.steps + 1, len(self.stations) - 1
        a, epoch = np.tile(np.arange(1, others + 1), k), np.repeat(np.arange(k), others)
        rows = measured("tdoa", a=a, b=0, epoch=epoch, sigma=self.sigma)
        return assemble(self.stations, rows, times=self.times, motions=[Motion(0, span="epoch")])


@dataclass(frozen=True, slots=True)
class Draw:
    """Measurements of all targets.

    Parameters
    ----------
    scenario : Scenario
        The scene.
    truth : array (t, k, 6)
        States of the targets.
    runs : Problem
        Batch (n, t) of runs of one target.
    fix : State
        Positions (n, t) that the first epoch gives.
    """

    scenario: Scenario
    truth: Array
    runs: Problem
    fix: State

    @property
    def position(self) -> Array:
        """Return the true positions (t, k - 1, 2) behind the first epoch, metres."""
        return self.truth[:, 1:, :2]


def draw(scenario: Scenario, truth: Array, trials: int, key: tuple[int, ...]) -> Draw:
    """Return measurements of targets, and the fix of the first epoch, without a guess.

    Parameters
    ----------
    scenario : Scenario
        The scene.
    truth : array (t, k, 6)
        See `Scenario.course`.
    trials : int
        Independent trials n.
    key : tuple of int
        Decides the draw.
    """
    places = truth[..., :2].reshape(len(truth), -1)
    runs = simulate(scenario.problem(), places, np.random.SeedSequence(key), trials=trials)
    runs = replace(runs, motions=(Motion(0),))
    first = solve(cut(runs, 0, 1))
    return Draw(scenario, truth, runs, State(float(scenario.times[0]), first.position, first.covariance()))


def unlabelled(drawn: Draw, detection: float, false: float, key: tuple[int, ...]) -> Candidates:
    """Return the rows of all targets without their names, some lost, among false ones.

    Parameters
    ----------
    drawn : Draw
        Measurements.
    detection : float
        Probability that a row is seen.
    false : float
        Mean number of false rows of a channel and epoch; they are uniform over the baseline.
    key : tuple of int
        Decides what is lost and added.
    """
    rng = np.random.default_rng(np.random.SeedSequence(key))
    seen = np.moveaxis(drawn.runs.z, 1, -1)
    seen = np.where(rng.random(seen.shape) < detection, seen, np.nan)
    count = rng.poisson(false, seen.shape[:-1])[..., None]
    reach = baseline(drawn.scenario)
    more = rng.uniform(-reach, reach, (*seen.shape[:-1], int(count.max(initial=0))))
    more = np.where(np.arange(more.shape[-1]) < count, more, np.nan)
    channels = replace(drawn.scenario.problem(), motions=(Motion(0),))
    return Candidates(channels, np.concatenate([seen, more], axis=-1))


def baseline(scenario: Scenario) -> float:
    """Return the longest distance of a station from the reference, metres: the largest possible range difference."""
    return float(np.linalg.norm(scenario.stations - scenario.stations[0], axis=-1).max())
