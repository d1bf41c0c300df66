"""Monte Carlo trials of a scene: the paper's recursion and the route without a guess on the same data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.bounds import crlb, crlb_course
from optloc.fix import Fix
from optloc.papers.registration.recursion import FIRST, recursion
from optloc.papers.registration.scenario import PRINTED, Scenario, Shape, problem, truth
from optloc.papers.report import Tick
from optloc.problem import Problem
from optloc.simulate import simulate
from optloc.solve import solve
from optloc.status import Status
from optloc.types import Array

FAR = 10.0
"""An estimate further from the truth than this many bounds is lost."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What is drawn.

    Parameters
    ----------
    scenario : Scenario
        Stations and target.
    trials : int
        Independent draws.
    seed : int
        Seed of the whole reproduction.
    key : int
        Number of this draw within it.
    sigma, station_sigma, gain_sigma : float, optional
        As `problem` takes them.
    """

    scenario: Scenario
    trials: int
    seed: int
    key: int
    sigma: float | None = None
    station_sigma: float = 1.0
    gain_sigma: float | None = None

    def problem(self, epochs: int) -> Problem:
        """Return the problem of the first epochs, without measurements."""
        return problem(
            self.scenario,
            epochs,
            sigma=self.sigma,
            station_sigma=self.station_sigma,
            gain_sigma=self.gain_sigma,
        )

    def draw(self, epochs: int) -> Problem:
        """Return all trials, measured."""
        made = self.problem(epochs)
        return simulate(made, truth(self.scenario, made), self._sequence(0), self.trials)

    def first(self, drawn: Problem, epochs: int) -> Problem:
        """Return the first epochs of what was drawn."""
        return self.problem(epochs).with_rows(z=drawn.z[..., drawn.epoch < epochs])

    def bound(self, epochs: int) -> Array:
        """Return the Cramer-Rao bound of the shared unknowns (n, n) after some epochs."""
        return np.asarray(self.bounds((epochs,))[0])

    def bounds(self, epochs: Sequence[int] | Array) -> Array:
        """Return the bounds (t, n, n) after several numbers of epochs."""
        made = self.problem(max(epochs))
        return crlb_course(made, truth(self.scenario, made), epochs).covariance

    def starts(self, width: float) -> Array:
        """Return Gaussian starts (trials, n) around the truth, `width` one-shot standard deviations wide.

        The velocity of a moving target is wrong by `width` times 10 m/s in each coordinate.
        """
        scene = self.scenario
        rng = np.random.default_rng(self._sequence(1))
        spread, centre = one_shot(scene, sigma=self.sigma), scene.target
        if scene.course is not None:
            spread, centre = np.concatenate([spread, np.full(3, 10.0)]), np.concatenate([centre, scene.course])
        return np.asarray(centre + width * spread * rng.standard_normal((self.trials, len(centre))))

    def _sequence(self, purpose: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(self.seed, spawn_key=(self.key, purpose))


def one_shot(scenario: Scenario = PRINTED, *, sigma: float | None = None, shape: Shape = "full") -> Array:
    """Return the paper's sigma0, metres: the bound of each coordinate (3,) from the first epoch with known biases."""
    still = replace(scenario, course=None)
    made = problem(still, 1, sigma=sigma, prior=1e-6, shape=shape)
    return np.asarray(np.sqrt(np.diagonal(crlb(made, truth(still, made)))[:3]))


def rms(bound: Array) -> float:
    """Return the root mean square of the length of a position error with a covariance (n, n)."""
    return float(np.sqrt(np.trace(bound[:3, :3])))


@dataclass(frozen=True, slots=True)
class Score:
    """Estimates of one kind of all trials, against the truth.

    Parameters
    ----------
    error : array (trials, n)
        Estimate less truth, SI units; not finite where there is none.
    lost : bool array (trials,)
        Estimates without sense: not finite, or further away than `FAR` bounds.
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


def score(estimate: Array, exact: Array, bound: Array) -> Score:
    """Return the score of estimates (trials, n) of a truth (n,) with a bound (n, n)."""
    error = estimate - exact
    with np.errstate(invalid="ignore", over="ignore"):
        far = ~((error[:, :3] ** 2).sum(-1) < (FAR * rms(bound)) ** 2)
    return Score(error, far | ~np.isfinite(error).all(-1))


def branch(fix: Fix, exact: Array) -> Array:
    """Return of every fix and its alternatives the vector (trials, n) nearest to a truth in position.

    For a target that moves straight two mirror images explain the data exactly; both are listed.
    """
    pool = np.concatenate([fix.x[:, None], fix.alternatives.x], axis=1)
    with np.errstate(invalid="ignore"):
        apart = ((pool[..., :3] - exact[:3]) ** 2).sum(-1)
    best = np.argmin(np.where(np.isfinite(apart), apart, np.inf), axis=1)
    return np.asarray(pool[np.arange(len(pool)), best])


@dataclass(frozen=True, slots=True)
class History:
    """Scores after growing numbers of epochs.

    Parameters
    ----------
    setting : Setting
        What was drawn.
    epochs : tuple of int
        Numbers of epochs.
    bounds : array (t, n, n)
        Cramer-Rao bound at each.
    plain : tuple of Score, or None
        The paper's recursion on the range differences.
    found : tuple of Score
        The fix without a guess.
    ambiguous : tuple of float
        Share of fixes that say that the data allow another place.
    silent : tuple of float
        Share of fixes that are lost and say ok.
    """

    setting: Setting
    epochs: tuple[int, ...]
    bounds: Array
    plain: tuple[Score, ...] | None
    found: tuple[Score, ...]
    ambiguous: tuple[float, ...]
    silent: tuple[float, ...]


def history(setting: Setting, epochs: Sequence[int], tick: Tick, *, plain: bool = True, first: int = FIRST) -> History:
    """Return the scores of both routes on the same data.

    Parameters
    ----------
    setting : Setting
        What is drawn.
    epochs : sequence of int
        Numbers of epochs to look at.
    tick : callable
        Called after each of them, and after the recursion.
    plain : bool
        Whether the recursion runs as well.
    first : int
        Epochs of its first estimate.
    """
    drawn = setting.draw(max(epochs))
    bounds = setting.bounds(epochs)
    exact = truth(setting.scenario, drawn)
    wandered = None
    if plain:
        wandered = wander(setting, drawn, epochs, bounds, first=first)
        tick()
    found, ambiguous, silent = [], [], []
    for k, bound in zip(epochs, bounds, strict=True):
        fix = solve(setting.first(drawn, k))
        found.append(score(fix.x if setting.scenario.course is None else branch(fix, exact), exact, bound))
        ambiguous.append(float((fix.code == Status.AMBIGUOUS).mean()))
        silent.append(float((found[-1].lost & (fix.code == Status.OK)).mean()))
        tick()
    return History(setting, tuple(epochs), bounds, wandered, tuple(found), tuple(ambiguous), tuple(silent))


def wander(
    setting: Setting,
    drawn: Problem,
    epochs: Sequence[int],
    bounds: Sequence[Array] | Array,
    *,
    width: float = 1.0,
    first: int = FIRST,
) -> tuple[Score, ...]:
    """Return the scores of the paper's recursion after some numbers of epochs; arguments as `course`.

    Parameters
    ----------
    width : float
        Width of the starts in one-shot standard deviations.
    """
    scene = setting.scenario
    z = drawn.rows[0].z.reshape(setting.trials, drawn.epochs, -1)
    estimates = recursion(scene, z[:, : max(epochs)], setting.starts(width), first=first)
    exact = truth(scene, drawn)[: estimates.shape[-1]]
    return tuple(score(estimates[:, k - first], exact, bound) for k, bound in zip(epochs, bounds, strict=True))
