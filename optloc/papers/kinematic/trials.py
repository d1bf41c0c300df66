"""Filters on the scene of the paper, and what is measured of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.bounds import crlb
from optloc.papers.kinematic.scenario import Draw, Scenario, baseline, draw, unlabelled
from optloc.solve import solve
from optloc.track import Dynamics, State, Track, followed, polynomial
from optloc.track.associate import Associate, Clutter, assigned, joint, nearest
from optloc.track.bound import posterior_bound
from optloc.track.imm import imm
from optloc.track.multiple import Missing, associated
from optloc.track.parallel import parallel, resized
from optloc.track.updates import Update
from optloc.types import Array, Motion, Prior
from optloc.windows import cut

LOST = 10e3
"""An error at the last epoch from which a track counts as lost, metres."""


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of many tracks.

    Parameters
    ----------
    error : array (n, t, k)
        Distances from the truth, metres.
    nees : array (n, t, k)
        Normalised estimation errors squared of the positions; 2 on average where covariances are right.
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
    def lost(self) -> float:
        """Return the share of tracks that end further than `LOST` from the truth."""
        return float((self.error[..., -1] > LOST).mean())


def score(drawn: Draw, position: Array, cov: Array | None = None) -> Score:
    """Return the errors of positions (n, t, k, 2) behind the first epoch, with their covariances where known."""
    away = position - drawn.position
    nees = np.full(away.shape[:-1], np.nan)
    if cov is not None:
        nees = (away * np.linalg.solve(cov, away[..., None])[..., 0]).sum(-1)
    return Score(np.linalg.norm(away, axis=-1), nees)


def started(drawn: Draw, order: int) -> State:
    """Return the state of the first epoch: the fix, and priors of what it does not see."""
    return resized(drawn.fix, order, 2, speed=drawn.scenario.speed, rate=drawn.scenario.rate)


def tracked(drawn: Draw, dynamics: Dynamics, update: Update | str = "ekf") -> Track:
    """Return the tracks of all runs by one model."""
    return followed(drawn.runs, started(drawn, dynamics.order), dynamics, update)


def scored(drawn: Draw, track: Track) -> Score:
    """Return the errors of tracks."""
    return score(drawn, track.position, track.cov[..., :2, :2])


def fixes(drawn: Draw) -> Score:
    """Return the errors of fixes of single epochs, each without a guess and without the others.

    The first epoch is left out, as it is with tracks.
    """
    found = solve(replace(drawn.runs, motions=(Motion(0, span="epoch"),)))
    return score(drawn, found.position[..., 1:, :], found.covariance()[..., 1:, :, :])


def batch(drawn: Draw, order: int) -> Score:
    """Return the errors at the last epoch of maximum-likelihood estimates of whole runs, without a guess."""
    sizes = {"velocity": drawn.scenario.speed, "acceleration": drawn.scenario.rate}
    priors = [Prior(name, np.zeros(2), size**2 * np.eye(2)) for name, size in list(sizes.items())[:order]]
    found = solve(replace(drawn.runs, motions=(Motion(order),), priors=tuple(priors)))
    T = float(drawn.scenario.times[-1])
    ahead = np.kron([1.0, T, 0.5 * T * T][: order + 1], np.eye(2))
    away = found.x @ ahead.T - drawn.position[:, -1]
    cov = ahead @ found.cov @ ahead.T
    nees = (away * np.linalg.solve(cov, away[..., None])[..., 0]).sum(-1)
    return Score(np.linalg.norm(away, axis=-1)[..., None], nees[..., None])


def bounds(scenario: Scenario, truth: Array, order: int) -> Array:
    """Return the posterior Cramer-Rao bound of the position (t, k, 2, 2), that of the first fix included."""
    made = replace(scenario.problem(), motions=(Motion(0),))
    first = crlb(cut(made, 0, 1), truth[:, 0, :2])
    n = 2 * (order + 1)
    fix = State(float(scenario.times[0]), truth[:, 0, :2], first)
    start = resized(fix, order, 2, speed=scenario.speed, rate=scenario.rate)
    later = posterior_bound(made, truth[..., :n], start, polynomial(order))
    return np.concatenate([first[:, None], later[..., :2, :2]], axis=1)


def mean_error(cov: Array) -> Array:
    """Return the mean distance (...) from its mean of a normal vector in the plane with covariances (..., 2, 2).

    References
    ----------
    M. Abramowitz, I. A. Stegun, "Handbook of Mathematical Functions" (1964), 17.3.3, applied to the mean over angles.
    """
    from scipy.special import ellipe

    small, large = np.moveaxis(np.linalg.eigvalsh(cov), -1, 0)
    return np.asarray(np.sqrt(2.0 / np.pi * large) * ellipe(1.0 - small / large))


def polynomial_ratio(order: int, points: int) -> float:
    """Return the end-point error of a line (order 1) or parabola (2) through equally good points, over that of one."""
    k = points
    if order == 1:
        return float(np.sqrt(2.0 * (2 * k - 1) / (k * (k + 1))))
    return float(np.sqrt(3.0 * (3 * k * k - 3 * k + 2) / (k * (k + 1) * (k + 2))))


def theory(order: int, steps: int) -> float:
    """Return the mean of `polynomial_ratio` over the steps behind one fix."""
    return float(np.mean([polynomial_ratio(order, k) for k in range(2, steps + 2)]))


@dataclass(frozen=True, slots=True)
class Filter:
    """A way from measurements to positions.

    Parameters
    ----------
    name : str
        As tables call it.
    models : tuple of Dynamics
        One model, or several.
    switch : float
        Probability to change the model from scan to scan; 0: the models run side by side and the best is taken.
    """

    name: str
    models: tuple[Dynamics, ...]
    switch: float = 0.0

    def run(self, drawn: Draw) -> Score:
        """Return the errors of a draw."""
        scene = drawn.scenario
        if len(self.models) == 1:
            return scored(drawn, tracked(drawn, self.models[0]))
        if not self.switch:
            made = parallel(drawn.runs, drawn.fix, self.models, speed=scene.speed, rate=scene.rate, update="ekf")
            return score(drawn, made.position)
        q = len(self.models)
        chain = np.full((q, q), self.switch / (q - 1)) + (1.0 - self.switch * q / (q - 1)) * np.eye(q)
        found = imm(drawn.runs, drawn.fix, self.models, chain, speed=scene.speed, rate=scene.rate, update="ekf")
        return scored(drawn, found.track)


PLAIN = tuple(polynomial(order) for order in (0, 1, 2))
"""Static, uniform and accelerated, without process noise."""

FILTERS = (
    Filter("CV, Q = 0 (paper)", PLAIN[1:2]),
    Filter("CV, sd(a) = 0.1 km/s²", (polynomial(1, 100.0),)),
    Filter("CA, Q = 0 (paper)", PLAIN[2:]),
    Filter("best of static, CV, CA by likelihood", PLAIN),
    Filter("IMM of CV and CA with sd(jerk) = 0.05 km/s³", (polynomial(1), polynomial(2, 50.0)), 0.05),
)
"""What is tried against a motion that is not the model's."""


@dataclass(frozen=True, slots=True)
class Rule:
    """A way to tell whose a row is.

    Parameters
    ----------
    name : str
        As tables call it.
    associate : Associate
        The rule.
    missing : "drop" or "expect"
        "expect" where a missed row repeats the prediction.
    """

    name: str
    associate: Associate
    missing: Missing = "drop"


@dataclass(frozen=True, slots=True)
class Association:
    """The association test of one motion.

    Parameters
    ----------
    drawn : Draw
        The truth, and labelled measurements.
    scores : dict of str to Score
        By rule.
    """

    drawn: Draw
    scores: dict[str, Score]


def rules(scenario: Scenario, detection: float, false: float) -> tuple[Rule, ...]:
    """Return the rules that are compared."""
    known = Clutter(detection, false / (2.0 * baseline(scenario)))
    return (
        Rule("nearest, missed := predicted (paper)", nearest(), "expect"),
        Rule("nearest, missed row dropped", nearest()),
        Rule("whole sets, each target alone", joint(known)),
        Rule("whole sets, one to one", assigned(known)),
    )


def association(
    scenario: Scenario, order: int, trials: int, key: tuple[int, ...], detection: float = 0.7, false: float = 2.0
) -> Association:
    """Return the errors of every rule on the same unlabelled rows.

    Parameters
    ----------
    scenario : Scenario
        The scene.
    order : 0 or 1
        Motion of the targets and model of the filter.
    trials : int
        Independent trials, three targets each.
    key : tuple of int
        Decides the draw.
    detection, false : float
        Probability that a row is seen; mean number of false rows of a channel and epoch.
    """
    drawn = draw(scenario, scenario.course(order), trials, (*key, 0))
    given = unlabelled(drawn, detection, false, (*key, 1))
    scores = {}
    for rule in rules(scenario, detection, false):
        found = associated(given, started(drawn, order), polynomial(order), rule.associate, "ekf", missing=rule.missing)
        scores[rule.name] = scored(drawn, found.track)
    return Association(drawn, scores)
