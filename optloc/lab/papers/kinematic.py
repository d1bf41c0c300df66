"""Static, uniform and accelerated targets by range differences: scene, filters and errors of a paper.

`optloc.lab.papers.kinematic_tables` makes the tables and figures; the page is ``kinematic.md``.

Letters in shapes: n trials, t targets, s stations, k epochs (k = steps + 1; after the first epoch: k steps), q models.
A state is position, velocity and acceleration in the plane. CV and CA are models of constant velocity and acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from optloc.bounds import crlb
from optloc.engine import linalg, linearise, normal, simulate, step
from optloc.problem import SPEED_OF_LIGHT, Array, Motion, Prior, Problem, assemble, cut, measured
from optloc.solvers import solve
from optloc.tracking import (
    Associate,
    Clutter,
    Dynamics,
    Missing,
    RowCandidates,
    State,
    Track,
    Update,
    Updated,
    assigned,
    associated,
    followed,
    imm,
    joint,
    joseph,
    nearest,
    parallel,
    polynomial,
    posterior_bound,
    resized,
    whitened,
)

# The scene of the paper: three targets, four stations, twenty updates after one fix.

ORDERS = {"static": 0, "CV": 1, "CA": 2}
"""Orders of the models of motion, and of the motions of targets, by name."""


def _star(radius: float) -> Array:
    """Return the reference station at the origin and three around it, at 90, 210 and 330 degrees; metres."""
    angle = np.radians([90.0, 210.0, 330.0])
    return np.vstack([np.zeros(2), radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)])


@dataclass(frozen=True, slots=True)
class KinematicScenario:
    """Stations and targets in the plane; the first station is the reference.

    The paper gives targets, speeds, accelerations and the number of steps. The other values are chosen here; the page
    gives the reasons.

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
        Number of updates after the first fix.
    speed, rate : float
        Prior standard deviation of each coordinate of velocity and acceleration, SI units.
    """

    stations: Array = field(default_factory=lambda: _star(100e3))
    position: Array = field(default_factory=lambda: 1e3 * np.array([[300.0, 400.0], [350.0, 450.0], [250.0, 350.0]]))
    velocity: Array = field(default_factory=lambda: 1e3 * np.array([[0.0, 1.0], [0.0, -1.0], [0.0, 1.0]]))
    acceleration: Array = field(default_factory=lambda: 1e3 * np.array([[0.0, -0.1], [0.0, 0.1], [0.0, 0.1]]))
    # 80 ns and 2.25 s are fitted to two lines of table 1: the single fix, and CV on accelerated targets.
    sigma: float = 80e-9 * SPEED_OF_LIGHT
    interval: float = 2.25
    steps: int = 20
    # Loose: twice the speed and ten times the acceleration of the targets.
    speed: float = 2e3
    rate: float = 1e3

    @property
    def times(self) -> Array:
        """Return the seconds (k,) of the epochs."""
        return self.interval * np.arange(self.steps + 1)

    def course(self, order: int, since: float = 0.0) -> Array:
        """Return the true states [p, v, a] (t, k, 6) of static (0), uniform (1) or accelerated (2) targets.

        An acceleration begins at `since` seconds.
        """
        t = self.times[:, None]
        accelerated = np.maximum(t - since, 0.0)  # seconds of acceleration
        v = self.velocity[:, None] * (order > 0)
        a = self.acceleration[:, None] * (order > 1)
        position = self.position[:, None] + v * t + 0.5 * a * accelerated**2
        return np.concatenate([position, v + a * accelerated, a * (t >= since)], axis=-1)

    def problem(self) -> Problem:
        """Return a run of one target without measurements; every epoch has a free position."""
        k, others = self.steps + 1, len(self.stations) - 1
        a, epoch = np.tile(np.arange(1, others + 1), k), np.repeat(np.arange(k), others)
        rows = measured("tdoa", a=a, b=0, epoch=epoch, sigma=self.sigma)
        return assemble(self.stations, rows, times=self.times, motions=[Motion(0, span="epoch")])


@dataclass(frozen=True, slots=True)
class KinematicDraw:
    """Measurements of all targets.

    Parameters
    ----------
    scenario : KinematicScenario
        The scene.
    truth : array (t, k, 6)
        States of the targets, SI units.
    runs : Problem
        Batch (n, t) of runs of one target.
    fix : State
        Positions (n, t) from the first epoch, with their covariances.
    """

    scenario: KinematicScenario
    truth: Array
    runs: Problem
    fix: State

    @property
    def position(self) -> Array:
        """Return the true positions (t, k - 1, 2) after the first epoch, metres."""
        return self.truth[:, 1:, :2]


def draw(scenario: KinematicScenario, truth: Array, trials: int, key: tuple[int, ...]) -> KinematicDraw:
    """Return measurements of targets, and the fix of the first epoch, without a guess.

    `truth` (t, k, 6) is from `KinematicScenario.course`, `trials` is the number n of independent trials, `key` the
    seed.
    """
    positions = truth[..., :2].reshape(len(truth), -1)
    runs = simulate(scenario.problem(), positions, np.random.SeedSequence(key), trials=trials)
    # Drawn along the course. A tracker takes scan by scan, and a target is static within a scan.
    runs = replace(runs, motions=(Motion(0),))
    first = solve(cut(runs, 0, 1))
    return KinematicDraw(scenario, truth, runs, State(float(scenario.times[0]), first.position, first.covariance()))


def strip_labels(drawn: KinematicDraw, detection: float, false: float, key: tuple[int, ...]) -> RowCandidates:
    """Return the rows of all targets without the names of the targets; some are missing, and false rows are added.

    Parameters
    ----------
    drawn : KinematicDraw
        Measurements.
    detection : float
        Probability that a row is detected.
    false : float
        Mean number of false rows of a channel and epoch. Their values are uniform from minus to plus the longest
        baseline.
    key : tuple of int
        Seed of missing and false rows.
    """
    rng = np.random.default_rng(np.random.SeedSequence(key))
    # (n, k m, t): the rows of a channel are in one group without the target; m are the channels, NaN is a missing row.
    rows = np.moveaxis(drawn.runs.z, 1, -1)
    rows = np.where(rng.random(rows.shape) < detection, rows, np.nan)
    number = rng.poisson(false, rows.shape[:-1])[..., None]
    longest = baseline(drawn.scenario)
    false_rows = rng.uniform(-longest, longest, (*rows.shape[:-1], int(number.max(initial=0))))
    false_rows = np.where(np.arange(false_rows.shape[-1]) < number, false_rows, np.nan)
    channels = replace(drawn.scenario.problem(), motions=(Motion(0),))
    return RowCandidates(channels, np.concatenate([rows, false_rows], axis=-1))


def baseline(scenario: KinematicScenario) -> float:
    """Return the longest distance of a station from the reference, metres: the largest possible range difference."""
    return float(np.linalg.norm(scenario.stations - scenario.stations[0], axis=-1).max())


LOST = 10e3
"""A track with a larger error at the last epoch is lost, metres: ten times the error of a single fix."""


@dataclass(frozen=True, slots=True)
class KinematicScore:
    """Errors of many tracks.

    Parameters
    ----------
    error : array (n, t, k)
        Distances from the truth, metres.
    nees : array (n, t, k)
        Normalised estimation errors squared of the positions; 2 on average if the covariances are right.
    """

    error: Array
    nees: Array

    @property
    def mean(self) -> float:
        """Return the mean error over runs, targets and steps, metres."""
        return float(self.error.mean())

    @property
    def spread(self) -> float:
        """Return the standard error of the mean, metres: a run, with all its targets and steps, is one sample."""
        each = self.error.mean((-2, -1))
        return float(each.std() / np.sqrt(each.size))

    @property
    def last(self) -> float:
        """Return the root mean square error at the last step, metres."""
        return float(np.sqrt((self.error[..., -1] ** 2).mean()))

    @property
    def level(self) -> float:
        """Return the mean NEES at the last step; its expectation is 2 if the covariances are right."""
        return float(self.nees[..., -1].mean())

    @property
    def lost(self) -> float:
        """Return the share of tracks that end further than `LOST` from the truth."""
        return float((self.error[..., -1] > LOST).mean())


def score(drawn: KinematicDraw, position: Array, cov: Array | None = None) -> KinematicScore:
    """Return the errors of positions (n, t, k, 2) after the first epoch, and their NEES if covariances are given."""
    error = position - drawn.position
    nees = np.full(error.shape[:-1], np.nan)
    if cov is not None:
        nees = (error * np.linalg.solve(cov, error[..., None])[..., 0]).sum(-1)
    return KinematicScore(np.linalg.norm(error, axis=-1), nees)


def start_from_fix(drawn: KinematicDraw, order: int) -> State:
    """Return the state of the first epoch: the fix, and prior values of velocity and acceleration.

    `order` is the order of the state: 0 position only, 1 with velocity, 2 with acceleration.
    """
    return resized(drawn.fix, order, 2, speed=drawn.scenario.speed, rate=drawn.scenario.rate)


def track_all(drawn: KinematicDraw, dynamics: Dynamics, update: Update | str = "ekf") -> Track:
    """Return the tracks of all runs by one model; `update` is the filter or its name."""
    return followed(drawn.runs, start_from_fix(drawn, dynamics.order), dynamics, update)


def score_track(drawn: KinematicDraw, track: Track) -> KinematicScore:
    """Return the position errors and the NEES of tracks."""
    return score(drawn, track.position, track.cov[..., :2, :2])


def fixes(drawn: KinematicDraw) -> KinematicScore:
    """Return the errors of separate fixes of single epochs, without a guess.

    The first epoch is left out, as it is with tracks.
    """
    estimate = solve(replace(drawn.runs, motions=(Motion(0, span="epoch"),)))
    return score(drawn, estimate.position[..., 1:, :], estimate.covariance()[..., 1:, :, :])


def batch(drawn: KinematicDraw, order: int) -> KinematicScore:
    """Return the errors at the last epoch of maximum-likelihood estimates of whole runs, without a guess.

    `order` is the order of the motion, as in `start_from_fix`.
    """
    sizes = {"velocity": drawn.scenario.speed, "acceleration": drawn.scenario.rate}
    # Priors of mean zero with the standard deviations that the filters use for unknown velocities and accelerations.
    priors = [Prior(name, np.zeros(2), size**2 * np.eye(2)) for name, size in list(sizes.items())[:order]]
    estimate = solve(replace(drawn.runs, motions=(Motion(order),), priors=tuple(priors)))
    # Estimates are states at time zero; tracks are scored at the last epoch.
    T = float(drawn.scenario.times[-1])
    transition = np.kron([1.0, T, 0.5 * T * T][: order + 1], np.eye(2))
    error = estimate.x @ transition.T - drawn.position[:, -1]
    cov = transition @ estimate.cov @ transition.T
    nees = (error * np.linalg.solve(cov, error[..., None])[..., 0]).sum(-1)
    return KinematicScore(np.linalg.norm(error, axis=-1)[..., None], nees[..., None])


def bounds(scenario: KinematicScenario, truth: Array, order: int) -> Array:
    """Return the posterior Cramer-Rao bound of the position after each epoch (t, k, 2, 2), m^2.

    The bound begins with the bound of the first fix. `truth` (t, k, 6) are the true states; `order` is the order of the
    model.
    """
    static = replace(scenario.problem(), motions=(Motion(0),))
    first = crlb(cut(static, 0, 1), truth[:, 0, :2])
    n = 2 * (order + 1)
    fix = State(float(scenario.times[0]), truth[:, 0, :2], first)
    start = resized(fix, order, 2, speed=scenario.speed, rate=scenario.rate)
    later = posterior_bound(static, truth[..., :n], start, polynomial(order))
    return np.concatenate([first[:, None], later[..., :2, :2]], axis=1)


def mean_error(cov: Array) -> Array:
    """Return the mean length (...) of a zero-mean normal vector in the plane with covariances (..., 2, 2).

    References
    ----------
    M. Abramowitz, I. A. Stegun, "Handbook of Mathematical Functions" (1964), 17.3.3, applied to the mean over angles.
    """
    from scipy.special import ellipe

    # Over angles the length is the root of a quadratic form: a complete elliptic integral of the axes.
    small, large = np.moveaxis(np.linalg.eigvalsh(cov), -1, 0)
    return np.asarray(np.sqrt(2.0 / np.pi * large) * ellipe(1.0 - small / large))


def polynomial_ratio(order: int, points: int) -> float:
    """Return the end-point error of a line (order 1) or a parabola (order 2) through points of equal accuracy.

    The error is relative to the error of one point; `points` is the number of equidistant points.
    """
    # The corner of the inverse normal matrix of equidistant points, in closed form.
    k = points
    if order == 1:
        return float(np.sqrt(2.0 * (2 * k - 1) / (k * (k + 1))))
    return float(np.sqrt(3.0 * (3 * k * k - 3 * k + 2) / (k * (k + 1) * (k + 2))))


def theory(order: int, steps: int) -> float:
    """Return the mean of `polynomial_ratio` over `steps` epochs after one fix: the expected ratio of errors."""
    return float(np.mean([polynomial_ratio(order, k) for k in range(2, steps + 2)]))


@dataclass(frozen=True, slots=True)
class PaperFilter:
    """A filter from measurements to positions.

    Parameters
    ----------
    name : str
        Name in tables.
    models : tuple of Dynamics
        One model, or several.
    switch : float
        Probability of a change of the model from scan to scan; 0: the models run in parallel and the best is taken.
    """

    name: str
    models: tuple[Dynamics, ...]
    switch: float = 0.0

    def run(self, drawn: KinematicDraw) -> KinematicScore:
        """Return the errors of the filter on a draw."""
        # One model; or several in parallel, of which the best is used; or several with switches between them (IMM).
        scene = drawn.scenario
        if len(self.models) == 1:
            return score_track(drawn, track_all(drawn, self.models[0]))
        if not self.switch:
            best = parallel(drawn.runs, drawn.fix, self.models, speed=scene.speed, rate=scene.rate, update="ekf")
            return score(drawn, best.position)
        q = len(self.models)
        # Rows sum to one: a switch goes to each other model with equal probability.
        transitions = np.full((q, q), self.switch / (q - 1)) + (1.0 - self.switch * q / (q - 1)) * np.eye(q)
        mixed = imm(drawn.runs, drawn.fix, self.models, transitions, speed=scene.speed, rate=scene.rate, update="ekf")
        return score_track(drawn, mixed.track)


PLAIN = tuple(polynomial(order) for order in (0, 1, 2))
"""Static, uniform and accelerated, without process noise."""

FILTERS = (
    PaperFilter("CV, Q = 0 (paper)", PLAIN[1:2]),
    PaperFilter("CV, sd(a) = 0.1 km/s²", (polynomial(1, 100.0),)),
    PaperFilter("CA, Q = 0 (paper)", PLAIN[2:]),
    PaperFilter("best of static, CV, CA by likelihood", PLAIN),
    PaperFilter("IMM of CV and CA with sd(jerk) = 0.05 km/s³", (polynomial(1), polynomial(2, 50.0)), 0.05),
)
"""Filters for a motion that differs from the model; 0.1 km/s² is the true acceleration."""


@dataclass(frozen=True, slots=True)
class Rule:
    """Rule of association of rows with targets.

    Parameters
    ----------
    name : str
        Name in tables.
    associate : Associate
        The rule.
    missing : "drop" or "expect"
        "expect": a missing row repeats the prediction.
    """

    name: str
    associate: Associate
    missing: Missing = "drop"


@dataclass(frozen=True, slots=True)
class Association:
    """Result of the association test for one motion.

    Parameters
    ----------
    drawn : KinematicDraw
        The truth, and labelled measurements.
    scores : dict of str to KinematicScore
        Errors by rule.
    """

    drawn: KinematicDraw
    scores: dict[str, KinematicScore]


def rules(scenario: KinematicScenario, detection: float, false: float) -> tuple[Rule, ...]:
    """Return the rules of association that are compared.

    `detection` is the probability that a row is detected, and `false` the mean number of false rows of a channel and
    epoch.
    """
    # False rows are uniform over range differences from minus to plus the longest baseline.
    known = Clutter(detection, false / (2.0 * baseline(scenario)))
    return (
        Rule("nearest, missed := predicted (paper)", nearest(), "expect"),
        Rule("nearest, missed row dropped", nearest()),
        Rule("whole sets, each target alone", joint(known)),
        Rule("whole sets, one to one", assigned(known)),
    )


# A detection of 0.7, and two false rows for three true ones, separate the rules: the nearest row loses half of the
# uniform targets, whole sets a few per cent.
def association(
    scenario: KinematicScenario,
    order: int,
    trials: int,
    key: tuple[int, ...],
    detection: float = 0.7,
    false: float = 2.0,
) -> Association:
    """Return the errors of every rule on the same unlabelled rows.

    Parameters
    ----------
    scenario : KinematicScenario
        The scene.
    order : 0 or 1
        Motion of the targets and model of the filter.
    trials : int
        Independent trials, three targets each.
    key : tuple of int
        Seed of the draws.
    detection, false : float
        Probability that a row is detected; mean number of false rows of a channel and epoch.
    """
    drawn = draw(scenario, scenario.course(order), trials, (*key, 0))
    unlabelled = strip_labels(drawn, detection, false, (*key, 1))
    scores = {}
    for rule in rules(scenario, detection, false):
        result = associated(
            unlabelled, start_from_fix(drawn, order), polynomial(order), rule.associate, "ekf", missing=rule.missing
        )
        scores[rule.name] = score_track(drawn, result.track)
    return Association(drawn, scores)


# Effects of the equations as printed.


def predict_twice(dynamics: Dynamics, interval: float, dimension: int) -> Update:
    """Return the update of equations 28 to 31 as printed, which applies the transition a second time within H.

    H is the Jacobian of the measurements. `interval` is the time between epochs in seconds; `dimension` is 2 or 3.
    """
    n = (dynamics.order + 1) * dimension
    F = dynamics.step(interval, np.zeros(n), dimension)[0]

    def update(scan: Problem, mean: Array, cov: Array) -> Updated:
        white = whitened(scan, mean)
        H = white.H @ F  # the printed error: `mean` and `cov` are predictions already
        S = H @ cov @ np.swapaxes(H, -1, -2) + np.eye(H.shape[-2])  # whitened rows have the variance 1
        gain = np.swapaxes(linalg.solve(S, H @ cov)[0], -1, -2)
        solved = linalg.solve(S, white.residual[..., None])[0][..., 0]
        nis = (white.residual * solved).sum(-1)
        # The likelihood also belongs to the printed update, so that it can be compared with the right one.
        lower, _ = linalg.factor(S)
        logdet = white.logdet + 2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
        moved = mean + (gain @ white.residual[..., None])[..., 0]
        return Updated(moved, joseph(H, gain, cov), nis, -0.5 * (nis + logdet), white.count)

    return update


def taylor(problem: Problem, start: Array, *, sign: float = 1.0, steps: int = 50) -> Array:
    """Return positions (..., d) after undamped steps of the linearised fix, equations 5 to 8.

    Positions are not finite if the steps diverge.

    Parameters
    ----------
    problem : Problem
        Batch (...) of single epochs.
    start : array (..., d)
        Starting positions, metres.
    sign : float
        1, or -1 for the sign of the residual that equations 8 and 15 print.
    steps : int
        Number of steps.
    """
    # Undamped steps overflow if they diverge, and these runs are counted.
    x = np.broadcast_to(start, (*problem.batch_shape, start.shape[-1]))
    with np.errstate(all="ignore"):
        for _ in range(steps):
            linear = linearise(problem, x)
            move, ok = step(normal(replace(linear, residual=sign * linear.residual), 1), np.zeros(x.shape[:-1]))
            x = x + np.where(ok[..., None], move, np.nan)
    return x


def weighting(problem: Problem, position: Array, covariance: Array) -> tuple[float, float]:
    """Return the root mean square errors of a fix with equal weights and with optimal weights, to first order, metres.

    `position` (d,) is the target, `covariance` (m, m) the true covariance of the m rows of one epoch.
    """
    H = linearise(problem, position).shared
    unweighted = np.linalg.solve(H.T @ H, H.T)
    optimal = np.linalg.inv(H.T @ np.linalg.solve(covariance, H))
    return float(np.sqrt(np.trace(unweighted @ covariance @ unweighted.T))), float(np.sqrt(np.trace(optimal)))
