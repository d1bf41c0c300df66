"""Manoeuvring targets by azimuth and elevation with the current statistical model: the three simulations of a paper.

All trials of a setting run as one batch. `optloc.lab.papers.angles_tables` makes the tables and figures; the page is
``angles.md``.

Letters in shapes: s stations, d coordinates, k epochs (one a second), q scored epochs (the last of a track). A state is
position, velocity and acceleration, n = 3 d numbers in SI units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from optloc.bounds import crlb
from optloc.engine import simulate
from optloc.lab.papers.report import Tick
from optloc.problem import Array, Motion, Problem, assemble, by_epoch, cut, measured
from optloc.solvers import courses, solve
from optloc.tracking import (
    Dynamics,
    State,
    Track,
    correlated,
    current_statistical,
    fitted,
    followed,
    posterior_bound,
    singer,
)

# The three simulations of the paper: as printed where this is possible, and repaired otherwise.

TIME_CONSTANT = 10.0
"""The "manoeuvre constant 10" of the paper: after these seconds a deviation of the acceleration has fallen to 1/e."""


@dataclass(frozen=True, slots=True)
class AnglesScenario:
    """Two fixed stations, and a target with known true states.

    Parameters
    ----------
    name : str
        Name in tables.
    stations : array (s, d)
        Metres; in the plane there are azimuths only.
    states : array (k + 1, 3, d)
        Position, velocity and acceleration of the target at 0, 1, ... k seconds, SI units; measurements begin at 1 s.
    sigma : float
        Standard deviation of an angle, radians.
    phases : tuple of int
        Last second of each phase.
    """

    name: str
    stations: Array
    states: Array
    sigma: float
    phases: tuple[int, ...]

    @property
    def epochs(self) -> int:
        """Return the number of epochs k."""
        return len(self.states) - 1

    @property
    def dimension(self) -> int:
        """Return 2 or 3."""
        return int(self.stations.shape[1])

    @property
    def truth(self) -> Array:
        """Return the true states (k + 1, 3 d), ordered [p, v, a]."""
        return self.states.reshape(len(self.states), -1)

    def problem(self) -> Problem:
        """Return the run without measurements; every epoch has a free position."""
        count, k = len(self.stations), self.epochs
        a, epoch = np.tile(np.arange(count), k), np.repeat(np.arange(k), count)
        kinds = ("azimuth", "elevation")[: self.dimension - 1]
        rows = [measured(kind, a=a, epoch=epoch, sigma=self.sigma) for kind in kinds]
        return assemble(self.stations, *rows, times=np.arange(1.0, k + 1.0), motions=(Motion(span="epoch"),))


def _states(*parts: tuple[Array, Array, Array]) -> Array:
    """Return the states (k + 1, 3, d) of a course from consecutive parts.

    Each part is positions, velocities and accelerations, (epochs, d) each. A part begins at the last epoch of the part
    before it, so its first epoch is left out.
    """
    return np.concatenate([np.stack(part, axis=1)[i > 0 :] for i, part in enumerate(parts)])


def _straight() -> AnglesScenario:
    """Return simulation 1: a straight course with constant acceleration."""
    # Printed: 2 m/s and 0.2 m/s² for 50 s. The direction is not printed.
    t, still = np.arange(51.0)[:, None], np.zeros((51, 2))
    direction = np.array([1.0, 0.0])
    states = _states(((2.0 * t + 0.1 * t**2) * direction, (2.0 + 0.2 * t) * direction, still + 0.2 * direction))
    return AnglesScenario("simulation 1", _BASE, states, _FINE, (50,))


def _winding() -> AnglesScenario:
    """Return simulation 2: a sine."""
    # Printed: x = 2t, y = 10 sin(5πt/180). The real and imaginary parts of a complex wave are cosine and sine.
    t, frequency = np.arange(51.0), np.pi / 36.0
    wave, zero = np.exp(1j * frequency * t), np.zeros(51)
    parts = [
        np.stack(pair, axis=-1)
        for pair in (
            (2.0 * t, 10.0 * wave.imag),
            (zero + 2.0, 10.0 * frequency * wave.real),
            (zero, -10.0 * frequency**2 * wave.imag),
        )
    ]
    return AnglesScenario("simulation 2", _BASE, _states((parts[0], parts[1], parts[2])), _FINE, (50,))


def fly_circle(name: str, slow: float, fast: float, rate: float, seconds: tuple[int, int, int]) -> AnglesScenario:
    """Return simulation 3: straight, in a circle, straight.

    Parameters
    ----------
    name : str
        Name in tables.
    slow, fast : float
        Speed on the straight parts, which begin towards (2, 1, 0), and in the circle, m/s.
    rate : float
        Turn to the left, radians per second.
    seconds : tuple of three int
        Duration of each part.

    Notes
    -----
    The last part has the velocity of the first, as printed, so the heading jumps at the end of the circle.
    """
    ahead, left = np.array([2.0, 1.0, 0.0]) / np.sqrt(5.0), np.array([-1.0, 2.0, 0.0]) / np.sqrt(5.0)
    straight_times, circle_times, last_times = (np.arange(n + 1.0)[:, None] for n in seconds)
    first_point, radius = np.array([-10e3, 50e3, 10e3]), fast / rate
    circle_start = first_point + slow * seconds[0] * ahead
    # The centre is to the left of the course. `0.0 * straight_times` and the like repeat a constant once a second.
    sine, cosine = np.sin(rate * circle_times), np.cos(rate * circle_times)
    circle = circle_start + radius * (sine * ahead + (1.0 - cosine) * left)
    states = _states(
        (
            first_point + slow * straight_times * ahead,
            slow * ahead + 0.0 * straight_times,
            0.0 * straight_times * ahead,
        ),
        (circle, fast * (cosine * ahead + sine * left), fast * rate * (cosine * left - sine * ahead)),
        (circle[-1] + slow * last_times * ahead, slow * ahead + 0.0 * last_times, 0.0 * last_times * ahead),
    )
    ends = np.cumsum(seconds)
    return AnglesScenario(name, _WIDE, states, 5e-3, (int(ends[0]), int(ends[1]), int(ends[2])))


# As printed, except for the second station of simulation 3: the text gives the same position for both.
_BASE = np.array([[0.0, 50.0], [0.0, 100.0]])
_WIDE = np.array([[-40e3, 0.0, 0.0], [40e3, 0.0, 0.0]])
_FINE = float(np.deg2rad(1e-3))  # a thousandth of a degree
_RATE, _RADIUS = 0.157, 3e3  # of the circle: rad/s, metres
_PRINTED = (1500, 500, 1000)  # seconds: straight, circle, straight

STRAIGHT = _straight()
"""Simulation 1: constant acceleration. The stations and the position at t = 0 are on one line."""

WINDING = _winding()
"""Simulation 2: a sine."""

WINDING_PEAK = float(np.linalg.norm(WINDING.states[:, 2], axis=-1).max())
"""Largest acceleration of simulation 2, m/s^2: the printed error is six times as large."""

# The radius is the printed one, 3 km. After a full turn the course has its old direction, so the velocity does not
# jump.
REPAIRED = fly_circle("repaired", _RADIUS * np.pi / 20.0, _RADIUS * np.pi / 20.0, np.pi / 20.0, (100, 40, 100))
"""Simulation 3 with one speed, 471 m/s, one full turn in 40 s, and straight parts of 100 s."""

READINGS = (
    fly_circle("as printed, in m/s", float(np.hypot(0.2, 0.1)), _RADIUS * _RATE, _RATE, _PRINTED),
    fly_circle("as printed, in km/s", 1e3 * float(np.hypot(0.2, 0.1)), _RADIUS * _RATE, _RATE, _PRINTED),
)
"""Simulation 3 as printed, with two units: the paper gives no unit for the speed of the straight parts."""


LOST = 10.0
"""A track of simulation 1 or 2 that ends further from the truth is lost, metres; the other tracks are 0.1 m off."""

Sigmas = tuple[float, float, float]
"""Standard deviations of each coordinate of position, velocity and acceleration at the start, SI units."""

STRAIGHT_START: Sigmas = (0.1, 0.1, 0.2)
WINDING_START: Sigmas = (0.1, 2.0, 1.0)
CIRCLE_START = (500.0, 50.0)
"""Standard deviations of the starts; of velocity and acceleration in simulation 3, which begins at a fix.

None is printed. The first two give the printed errors; the last are about the speed, 471 m/s, and the acceleration in
the circle, 74 m/s^2."""


@dataclass(frozen=True, slots=True)
class AnglesDraw:
    """Trials of a simulation.

    Parameters
    ----------
    scenario : AnglesScenario
        The simulation.
    problem : Problem
        Its run, measured (trials,) times.
    trials : int
        Number of trials.
    rng : callable
        ``() -> Generator`` for the starts; each call returns a generator with the same seed.
    """

    scenario: AnglesScenario
    problem: Problem
    trials: int
    rng: Callable[[], np.random.Generator]


def draw(scenario: AnglesScenario, trials: int, seed: int, key: int) -> AnglesDraw:
    """Return trials of a simulation; `seed` and `key` (number of the draw in the reproduction) decide the numbers."""
    measurements, starts = np.random.SeedSequence(seed, spawn_key=(key,)).spawn(2)
    truth = scenario.states[1:, 0].ravel()
    problem = simulate(scenario.problem(), truth, measurements, trials=trials)
    return AnglesDraw(scenario, problem, trials, lambda: np.random.default_rng(starts))


def start_at_truth(drawn: AnglesDraw, sigmas: Sigmas, *, known: int = 3) -> State:
    """Return the true state at t = 0 as the start of all trials, with the standard deviations `sigmas`.

    Derivatives from the order `known` on are zero: with 2, the acceleration is zero; with 1, also the velocity.
    """
    d, mean = drawn.scenario.dimension, drawn.scenario.truth[0].copy()
    mean[known * d :] = 0.0
    return _repeated(mean, _diagonal(sigmas, d), drawn.trials)


def scatter_starts(drawn: AnglesDraw, sigmas: Sigmas) -> State:
    """Return random starts at t = 0 around the truth, whose covariance is correct."""
    d = drawn.scenario.dimension
    state = _repeated(drawn.scenario.truth[0], _diagonal(sigmas, d), drawn.trials)
    error = drawn.rng().standard_normal(state.mean.shape) * np.repeat(sigmas, d)
    return replace(state, mean=state.mean + error)


def fit_start(drawn: AnglesDraw, epochs: int, order: int = 2) -> State:
    """Return the states after the first `epochs` epochs, fitted to these epochs without a guess.

    `order` is the order of the polynomial: 2 for a constant acceleration.
    """
    fix = fitted(cut(drawn.problem, 0, epochs), order)
    mean, cov = fix.gaussian()
    return State(float(epochs), np.asarray(mean), np.asarray(cov))


def first_fix(drawn: AnglesDraw, speed: float, rate: float) -> State:
    """Return the fix of the first epoch as a start, with velocity and acceleration zero.

    `speed` and `rate` are the standard deviations of each coordinate of velocity and acceleration, SI units.
    """
    d = drawn.scenario.dimension
    fix = solve(replace(cut(drawn.problem, 0, 1), motions=(Motion(),)))
    cov = np.zeros((drawn.trials, 3 * d, 3 * d))
    cov[:] = _diagonal((0.0, speed, rate), d)
    cov[:, :d, :d] = fix.covariance()
    return State(1.0, np.concatenate([fix.position, np.zeros((drawn.trials, 2 * d))], axis=-1), cov)


def fixes(drawn: AnglesDraw) -> tuple[Array, Array]:
    """Return the separate fix (trials, k, d) of every epoch in metres, and its covariance (trials, k, d, d)."""
    # A named method instead of "auto" solves every epoch of every trial in the same way.
    fix = solve(drawn.problem, "wiv+lsr")
    return fix.position, fix.covariance()


def linear_track(places: tuple[Array, Array], start: State, dynamics: Dynamics) -> Array:
    """Return the states (trials, k, n) of a linear Kalman filter whose measurements are fixes.

    `places` are the fixes (trials, k, d) at 1, 2, ... seconds and their covariances (trials, k, d, d), SI units.
    `start` is the state before the first fix that is used, at a whole second.
    """
    # Written out, because measurements of the position need no linearisation.
    mean, cov, states = start.mean, start.cov, []
    d = places[0].shape[-1]
    for k in range(int(start.time), places[0].shape[1]):
        F, Q, drive = dynamics.step(1.0, mean, d)
        mean, cov = (F @ mean[..., None])[..., 0] + drive, F @ cov @ F.T + Q
        S = cov[..., :d, :d] + places[1][:, k]
        gain = np.swapaxes(np.linalg.solve(S, cov[..., :d, :]), -1, -2)
        mean = mean + (gain @ (places[0][:, k] - mean[..., :d])[..., None])[..., 0]
        cov = cov - gain @ S @ np.swapaxes(gain, -1, -2)
        states.append(mean)
    return np.stack(states, axis=1)


def fixed_variance(limit: float) -> Dynamics:
    """Return Singer's model with the variance that the current statistical model has at acceleration zero.

    `limit` is the largest acceleration of that model, m/s^2.
    """
    return singer(TIME_CONSTANT, float(np.sqrt((4.0 - np.pi) / np.pi)) * limit)


def errors(drawn: AnglesDraw, track: Track | Array) -> Array:
    """Return the errors (trials, q, 3, d) of position, velocity and acceleration at the last q epochs, SI units.

    `track` is a track, or its states (trials, q, n).
    """
    mean = track.mean if isinstance(track, Track) else track
    true = drawn.scenario.states[-mean.shape[1] :]
    return np.asarray(mean.reshape(*mean.shape[:2], 3, -1) - true)


def rms(error: Array, axes: tuple[int, ...] = (0, 1)) -> Array:
    """Return root mean square lengths of errors (trials, q, ..., d) over `axes`: by default trials and epochs."""
    return np.asarray(np.sqrt((error**2).sum(-1).mean(axes)))


def distances(drawn: AnglesDraw, track: Track) -> Array:
    """Return the distances (trials,) of the last states from the truth, metres."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.sqrt((errors(drawn, track)[:, -1, 0] ** 2).sum(-1)))


def share_lost(drawn: AnglesDraw, track: Track) -> float:
    """Return the share of tracks that end further than `LOST` from the truth, or are not finite."""
    return float((~(distances(drawn, track) < LOST)).mean())  # NaN counts as lost


def track_all(drawn: AnglesDraw, start: State, dynamics: Dynamics, update: str = "ekf") -> Track:
    """Return the tracks of all trials from a start; `dynamics` is the motion model, `update` the name of the filter."""
    return followed(drawn.problem, start, dynamics, update)


def bound(scenario: AnglesScenario, start: State, dynamics: Dynamics) -> Array:
    """Return the posterior bound (q, 3) of the rms error of position, velocity and acceleration, SI units."""
    # The linearisation point is the truth, and all trials share the covariance of the start.
    single = State(start.time, scenario.truth[int(start.time)], start.cov[0])
    cov = posterior_bound(scenario.problem(), scenario.truth[1:], single, dynamics)
    variance = np.diagonal(cov, axis1=-2, axis2=-1).reshape(len(cov), 3, -1)
    return np.asarray(np.sqrt(variance.sum(-1)))


def snapshot_bound(scenario: AnglesScenario) -> Array:
    """Return the bound (k,) of the position error of a separate fix at each epoch, metres."""
    cov = crlb(by_epoch(scenario.problem()), scenario.states[1:, 0])
    return np.asarray(np.sqrt(np.trace(cov, axis1=-2, axis2=-1)))


def _diagonal(sigmas: Sigmas, d: int) -> Array:
    """Return the covariance (3 d, 3 d) of a state whose coordinates are independent."""
    return np.diag(np.repeat(np.square(sigmas), d))


def _repeated(mean: Array, cov: Array, trials: int) -> State:
    """Return the same mean and covariance at t = 0 for all trials."""
    return State(0.0, np.tile(mean, (trials, 1)), np.tile(cov, (trials, 1, 1)))


# Printed equations of the paper and its source, for comparison: never use these to track.


def printed_transition(time_constant: float, limit: float) -> Dynamics:
    """Return the current statistical model with the printed f33 = 1 - exp(-alpha T) instead of exp(-alpha T).

    `time_constant` is in seconds, `limit` is the largest acceleration of an axis in m/s^2.
    """
    correct = current_statistical(time_constant, limit)

    def step(dt: float, mean: Array, d: int) -> tuple[Array, Array, Array]:
        F, Q, drive = correct.step(dt, mean, d)
        F[2 * d :, 2 * d :] = (1.0 - np.exp(-dt / time_constant)) * np.eye(d)
        return F, Q, drive

    return replace(correct, name="printed f33", step=step)


def printed_variance(time_constant: float, limit: float) -> Dynamics:
    """Return the current statistical model with the variance as published: (4 - pi)/pi (limit - abs(a))^2, no clamp.

    The variance vanishes if the acceleration is near its limit, and grows without bound beyond. Parameters as for
    `printed_transition`.
    """
    correct = current_statistical(time_constant, limit)

    def step(dt: float, mean: Array, d: int) -> tuple[Array, Array, Array]:
        F, _, drive = correct.step(dt, mean, d)
        _, Q, _ = correlated(1.0 / time_constant, dt)
        variance = (4.0 - np.pi) / np.pi * (limit - np.abs(mean[..., 2 * d :])) ** 2
        noise = np.einsum("ij,...c,cb->...icjb", Q, variance, np.eye(d))
        return F, noise.reshape(*mean.shape, mean.shape[-1]), drive

    return replace(correct, name="no clamp", step=step)


# Fits to whole tracks and to a fixed target: pseudo-linear, instrumental variables, maximum likelihood.

PLACE = np.array([-10e3, 50e3, 10e3])
"""Position of the fixed target, metres: the start of the target of simulation 3."""


@dataclass(frozen=True, slots=True)
class SimulatedRays:
    """Errors of fixes of a fixed target.

    Parameters
    ----------
    stations : int
        Number of stations.
    sigma : float
        Standard deviation of an angle, radians.
    bound : float
        Root of the trace of the Cramer-Rao bound, metres.
    fixes : tuple of tuple of float
        Length of the mean error, and root mean square error, of each fix in metres: plain, weighted, instrumental,
        maximum likelihood.
    """

    stations: int
    sigma: float
    bound: float
    fixes: tuple[tuple[float, float], ...]


def whole_track_bound() -> Array:
    """Return the bound (3,) of position, velocity and acceleration at the end of simulation 1, SI units."""
    run = replace(STRAIGHT.problem(), motions=(Motion(2, reference=float(STRAIGHT.epochs)),))
    return np.asarray(np.sqrt(np.diagonal(crlb(run, STRAIGHT.truth[-1])).reshape(3, -1).sum(-1)))


def whole_track_errors(drawn: AnglesDraw, tick: Tick) -> list[tuple[str, Array]]:
    """Return the errors (3,) at the end of simulation 1, by method.

    The methods are three fits to the whole track in closed form, the most likely track, and the filter with two values
    of a_max. a_max is the largest acceleration of the filter's model in m/s^2. The errors are root mean squares over
    trials of position, velocity and acceleration, SI units. The function calls `tick` at its end.
    """
    problem = replace(drawn.problem, motions=(Motion(2, reference=float(STRAIGHT.epochs)),))
    true_state, scale_of_order = (
        STRAIGHT.truth[-1],
        np.array([1.0, 1.0, 2.0])[:, None],
    )  # the last coefficient is half of a
    # Fits are polynomials about the last epoch: coefficients (trials, 3, d).
    fits = courses(problem)
    assert fits is not None
    fits_by_name = {"plain": fits.plain, "weighted": fits.weighted, "instrumental variables": fits.instrumental}
    errors = [
        (name, _rms_by_order((scale_of_order * coefficients).reshape(len(coefficients), -1) - true_state))
        for name, coefficients in fits_by_name.items()
    ]
    errors.append(("maximum likelihood (optloc)", _rms_by_order(fitted(drawn.problem, 2).x - true_state)))
    start = start_at_truth(drawn, STRAIGHT_START, known=2)
    for limit in (30.0, 2.0):
        track = track_all(drawn, start, current_statistical(TIME_CONSTANT, limit))
        errors.append((f"filter, a_max {limit:g}", _rms_by_order(track.mean[:, -1] - true_state)))
    tick()
    return errors


def run_rays(count: int, seed: int, key: int, tick: Tick) -> list[SimulatedRays]:
    """Return the errors of `count` fixes of a fixed target, for few and for many stations.

    `key` is the number of the first draw in the reproduction: with `seed`, it decides the random numbers.
    """
    results = []
    # Noise of 0.02 and 0.05 rad is four and ten times the noise of simulation 3: the bias of plain fixes grows with it.
    for i, (stations, sigma) in enumerate(((2, 0.05), (4, 0.05), (50, 0.02), (50, 0.05))):
        problem = fixed_target(stations, sigma)
        drawn = simulate(problem, PLACE, np.random.SeedSequence(seed, spawn_key=(key + i,)), trials=count)
        fits = courses(drawn)
        assert fits is not None
        fixes = [coefficients[:, 0] for coefficients in (fits.plain, fits.weighted, fits.instrumental)]
        fixes.append(solve(drawn, "searched").position)  # proofs of a hundred rows would take most of the time
        least = float(np.sqrt(np.trace(crlb(problem, PLACE))))
        results.append(
            SimulatedRays(stations, sigma, least, tuple(_bias_and_error(position - PLACE) for position in fixes))
        )
        tick()
    return results


def fixed_target(count: int, sigma: float) -> Problem:
    """Return the problem of one epoch of angles to a fixed target; `count` is the number of stations.

    Two stations have the positions of simulation 3. The text gives no positions for more stations. Here they are
    between the two, and every second station is 20 km further away from the target.
    """
    stations = np.zeros((count, 3))
    stations[:, 0] = np.linspace(-40e3, 40e3, count)
    stations[:, 1] = np.where(np.arange(count) % 2, 0.0, -20e3) * (count > 2)
    a = np.arange(count)
    return assemble(stations, *(measured(kind, a=a, sigma=sigma) for kind in ("azimuth", "elevation")))


def _rms_by_order(error: Array) -> Array:
    """Return root mean square lengths (3,) of position, velocity and acceleration of errors (trials, 3 d)."""
    return rms(error.reshape(len(error), 3, -1), (0,))


def _bias_and_error(error: Array) -> tuple[float, float]:
    """Return the length of the mean error, and the root mean square error, of finite errors (trials, d)."""
    finite = error[np.isfinite(error).all(-1)]
    return float(np.linalg.norm(finite.mean(0))), float(np.sqrt((finite**2).sum(-1).mean()))
