"""Draws, starts, tracks and their scores; all trials of a setting run as one batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from optloc.bounds import crlb
from optloc.epochs import by_epoch
from optloc.papers.angles.scenario import TIME_CONSTANT, Scenario
from optloc.problem import Problem
from optloc.simulate import simulate
from optloc.solve import solve
from optloc.track import Dynamics, State, Track, followed, singer
from optloc.track.batch import fitted
from optloc.track.bound import posterior_bound
from optloc.types import Array, Motion
from optloc.windows import cut

LOST = 10.0
"""A track of simulation 1 or 2 that ends further from the truth than this is lost, metres."""

Sigmas = tuple[float, float, float]
"""Standard deviations of each coordinate of position, velocity and acceleration at the start."""


@dataclass(frozen=True, slots=True)
class Draw:
    """Trials of a simulation.

    Parameters
    ----------
    scenario : Scenario
        What is simulated.
    problem : Problem
        Its run, measured (trials,) times.
    trials : int
        Number of them.
    rng : callable
        ``() -> Generator`` of the starts, the same at each call.
    """

    scenario: Scenario
    problem: Problem
    trials: int
    rng: Callable[[], np.random.Generator]


def draw(scenario: Scenario, trials: int, seed: int, key: int) -> Draw:
    """Return trials of a simulation that depend on seed and key alone."""
    one, two = np.random.SeedSequence(seed, spawn_key=(key,)).spawn(2)
    truth = scenario.states[1:, 0].ravel()
    problem = simulate(scenario.problem(), truth, one, trials=trials)
    return Draw(scenario, problem, trials, lambda: np.random.default_rng(two))


def placed(drawn: Draw, sigmas: Sigmas, *, known: int = 3) -> State:
    """Return starts at t = 0 that are the truth, but for derivatives from `known` on, which are zero."""
    d, mean = drawn.scenario.dimension, drawn.scenario.truth[0].copy()
    mean[known * d :] = 0.0
    return _repeated(mean, _diagonal(sigmas, d), drawn.trials)


def scattered(drawn: Draw, sigmas: Sigmas) -> State:
    """Return starts at t = 0 drawn around the truth with the covariance that they claim."""
    d = drawn.scenario.dimension
    state = _repeated(drawn.scenario.truth[0], _diagonal(sigmas, d), drawn.trials)
    error = drawn.rng().standard_normal(state.mean.shape) * np.repeat(sigmas, d)
    return replace(state, mean=state.mean + error)


def fitted_start(drawn: Draw, epochs: int, order: int = 2) -> State:
    """Return the states after some epochs, fitted to them without a guess."""
    fix = fitted(cut(drawn.problem, 0, epochs), order)
    mean, cov = fix.gaussian()
    return State(float(epochs), np.asarray(mean), np.asarray(cov))


def first_fix(drawn: Draw, speed: float, rate: float) -> State:
    """Return the fix of the first epoch, with velocity and acceleration zero of given standard deviations."""
    d = drawn.scenario.dimension
    fix = solve(replace(cut(drawn.problem, 0, 1), motions=(Motion(),)))
    cov = np.zeros((drawn.trials, 3 * d, 3 * d))
    cov[:] = _diagonal((0.0, speed, rate), d)
    cov[:, :d, :d] = fix.covariance()
    return State(1.0, np.concatenate([fix.position, np.zeros((drawn.trials, 2 * d))], axis=-1), cov)


def fixes(drawn: Draw) -> tuple[Array, Array]:
    """Return the fix (trials, k, d) of every epoch by itself, and its covariance (trials, k, d, d)."""
    fix = solve(drawn.problem, "wiv+lsr")
    return fix.position, fix.covariance()


def linear_track(places: tuple[Array, Array], start: State, dynamics: Dynamics) -> Array:
    """Return the states (trials, k, n) of a linear Kalman filter whose measurements are fixes.

    Parameters
    ----------
    places : tuple of array
        Fixes at 1, 2, ... seconds and their covariances.
    start : State
        Before the first fix used.
    dynamics : Dynamics
        Model of motion.
    """
    mean, cov, out = start.mean, start.cov, []
    d = places[0].shape[-1]
    for k in range(int(start.time), places[0].shape[1]):
        F, Q, drive = dynamics.step(1.0, mean, d)
        mean, cov = (F @ mean[..., None])[..., 0] + drive, F @ cov @ F.T + Q
        S = cov[..., :d, :d] + places[1][:, k]
        gain = np.swapaxes(np.linalg.solve(S, cov[..., :d, :]), -1, -2)
        mean = mean + (gain @ (places[0][:, k] - mean[..., :d])[..., None])[..., 0]
        cov = cov - gain @ S @ np.swapaxes(gain, -1, -2)
        out.append(mean)
    return np.stack(out, axis=1)


def fixed_variance(limit: float) -> Dynamics:
    """Return Singer's model with the variance that the current statistical model has where it sees no acceleration."""
    return singer(TIME_CONSTANT, float(np.sqrt((4.0 - np.pi) / np.pi)) * limit)


def errors(drawn: Draw, track: Track | Array) -> Array:
    """Return the errors (trials, q, 3, d) of position, velocity and acceleration at the last q epochs."""
    mean = track.mean if isinstance(track, Track) else track
    true = drawn.scenario.states[-mean.shape[1] :]
    return np.asarray(mean.reshape(*mean.shape[:2], 3, -1) - true)


def rms(error: Array, axes: tuple[int, ...] = (0, 1)) -> Array:
    """Return root mean square lengths of errors (trials, q, ..., d) over trials and epochs."""
    return np.asarray(np.sqrt((error**2).sum(-1).mean(axes)))


def distances(drawn: Draw, track: Track) -> Array:
    """Return the distances (trials,) of the last states from the truth, metres."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.sqrt((errors(drawn, track)[:, -1, 0] ** 2).sum(-1)))


def lost(drawn: Draw, track: Track) -> float:
    """Return the share of tracks that end further than `LOST` from the truth, or nowhere."""
    return float((~(distances(drawn, track) < LOST)).mean())


def tracked(drawn: Draw, start: State, dynamics: Dynamics, update: str = "ekf") -> Track:
    """Return the tracks of all trials."""
    return followed(drawn.problem, start, dynamics, update)


def bound(scenario: Scenario, start: State, dynamics: Dynamics) -> Array:
    """Return the posterior bound (q, 3) of the root mean square error of position, velocity and acceleration."""
    alone = State(start.time, scenario.truth[int(start.time)], start.cov[0])
    cov = posterior_bound(scenario.problem(), scenario.truth[1:], alone, dynamics)
    variance = np.diagonal(cov, axis1=-2, axis2=-1).reshape(len(cov), 3, -1)
    return np.asarray(np.sqrt(variance.sum(-1)))


def snapshot_bound(scenario: Scenario) -> Array:
    """Return the bound (k,) of the position error of every epoch by itself, metres."""
    cov = crlb(by_epoch(scenario.problem()), scenario.states[1:, 0])
    return np.asarray(np.sqrt(np.trace(cov, axis1=-2, axis2=-1)))


def _diagonal(sigmas: Sigmas, d: int) -> Array:
    return np.diag(np.repeat(np.square(sigmas), d))


def _repeated(mean: Array, cov: Array, trials: int) -> State:
    return State(0.0, np.tile(mean, (trials, 1)), np.tile(cov, (trials, 1, 1)))
