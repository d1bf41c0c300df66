"""Initial states: a fix of one epoch, or of as many as it takes to see a velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base.errors import InvalidProblem, NoSolution
from optloc.base.types import Band, Motion, Prior, Rows, Status
from optloc.problem.epochs import cut
from optloc.problem.fix import Fix
from optloc.problem.noise import Block, Noise
from optloc.problem.problem import Problem
from optloc.solvers import solve
from optloc.track.dynamics import Dynamics
from optloc.track.track import State, check_trackable

# Metres: below every other error; of ECEF coordinates a millimetre has too few digits to converge on.
_EXACT = 1e-2


def begun(
    problem: Problem,
    dynamics: Dynamics,
    *,
    epochs: int | None = None,
    speed: float | None = None,
    rate: float | None = None,
) -> State:
    """Return the initial state of a run's target, without a guess.

    The first epochs are solved as one problem of the order of the dynamics: as many as it takes until position,
    velocity and acceleration are determined. With prior standard deviations the first epoch alone may do.

    Parameters
    ----------
    problem : Problem
        A single run.
    dynamics : Dynamics
        Gives the order of the state.
    epochs : int, optional
        Number of epochs to start from; None: the fewest that determine the state.
    speed, rate : float, optional
        Prior standard deviation of each coordinate of velocity (m/s) and acceleration (m/s^2), about zero.

    Returns
    -------
    State
        At the time of the last epoch used.

    Raises
    ------
    InvalidProblem
        Where the run is not one target's.
    NoSolution
        Where no number of epochs determines the state; it carries the last fix.
    """
    check_trackable(problem)
    order = dynamics.order
    fix, used = None, 0
    for used in [epochs] if epochs is not None else counts(problem.epochs, order, speed, rate):
        fix = first_fix(problem, dynamics, used, speed=speed, rate=rate)
        if is_one_gaussian(fix):
            return state_of(problem, fix, used)
    if fix is None:
        raise InvalidProblem("there are no epochs", "start", "give a run of at least one scan")
    raise NoSolution(problem, fix)


def is_one_gaussian(fix: Fix) -> bool:
    """Return whether a fix is one place with a covariance that covers: what a filter begins with.

    That no other place exists is proven of single scans at most; of runs it is enough that none was found.
    """
    against = (Status.MISFIT, Status.UNBOUNDED, Status.AMBIGUOUS, Status.CURVED)
    return bool(fix.answered) and not bool(fix.has(*against))


def two_point(first: Fix, second: Fix, times: tuple[float, float]) -> State:
    """Return the state at the second of two fixes, with velocity and the covariance between both.

    Parameters
    ----------
    first, second : Fix
        Fixes (...) of static positions with independent errors.
    times : tuple of two float
        Seconds.

    Raises
    ------
    InvalidProblem
        Where the second fix is not later than the first.

    References
    ----------
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), eq.
    5.5.3-4, with the covariance of each fix.
    """
    # The error of the second fix is in both parts of the state: its covariance is what ties velocity to position.
    T = times[1] - times[0]
    if not T > 0.0:
        raise InvalidProblem(f"fixes at {times[0]} and {times[1]} s", "times", "give the earlier fix first")
    one, two = first.covariance(), second.covariance()
    mean = np.concatenate([second.position, (second.position - first.position) / T], axis=-1)
    upper = np.concatenate([two, two / T], axis=-1)
    lower = np.concatenate([two / T, (one + two) / T**2], axis=-1)
    return State(times[1], mean, np.concatenate([upper, lower], axis=-2))


def counts(epochs: int, order: int, speed: float | None = None, rate: float | None = None) -> list[int]:
    """Return the numbers of first epochs, of so many, that a start tries: each next by half more; as `begun`."""
    # With a prior of every rate one epoch may do; else a state of order q has q + 1 scans at the least.
    known = speed is not None and (order < 2 or rate is not None)
    count = 1 if order == 0 or known else order + 1
    out = []
    while count < epochs:
        out.append(count)
        # Half more each time: the work of all tries together is some three times that of the last.
        count = max(count + 1, count * 3 // 2)
    return [*out, epochs]


def first_fix(
    problem: Problem, dynamics: Dynamics, count: int, *, speed: float | None = None, rate: float | None = None
) -> Fix:
    """Return the fix of the first epochs of a run, a target that moves by the order of the dynamics; as `begun`."""
    return solve(_first(problem, count, dynamics.order, speed, rate))


def _first(problem: Problem, count: int, order: int, speed: float | None, rate: float | None) -> Problem:
    part = cut(problem, 0, count)
    d = problem.dimension
    priors = [
        Prior(name, np.zeros(d), sigma**2 * np.eye(d))
        for name, sigma in (("velocity", speed), ("acceleration", rate))[:order]
        if sigma is not None
    ]
    # The state is asked for at the last scan used, where tracking goes on.
    motion = Motion(order, reference=float(problem.times[count - 1]))
    return replace(part, motions=(motion,), priors=tuple(priors))


def state_of(problem: Problem, fix: Fix, used: int) -> State:
    """Return the `first_fix` of so many epochs as a state at the last of them."""
    mean, cov = fix.gaussian()
    return State(float(problem.times[used - 1]), np.array(mean), np.array(cov))


def with_height_rows(problem: Problem) -> Problem:
    """Return a run whose exact height, if it has one, is measured at every epoch within a centimetre.

    Bounds stay: they tell starts apart. Epochs without rows stay without.

    Parameters
    ----------
    problem : Problem
        A run of one target.

    Raises
    ------
    InvalidProblem
        For an equality other than that of the height: updates would not hold it.
    """
    # An exact height as a row of every scan, so that updates hold it as starts do.
    exact = [c for c in problem.constraints if isinstance(c, Band) and np.array_equal(c.lower, c.upper)]
    if not exact:
        return problem
    other = next((c for c in exact if c.kind != "height"), None)
    if other is not None:
        advice = "give bounds, or solve the run as one problem"
        raise InvalidProblem(f"the constraint {other.name!r} is an equality", "track", advice)
    heard = np.unique(problem.epoch[problem.weight > 0.0])
    m, none = len(heard), np.full(len(heard), -1)
    z = np.broadcast_to(exact[0].lower, (m,))
    rows = Rows("height", z, none, none, heard, np.zeros_like(heard), np.ones(m), np.zeros(m))
    block = Block(problem.count + np.arange(m)[:, None], np.full((1, 1, 1), _EXACT**2))
    kept = tuple(c for c in problem.constraints if not any(c is e for e in exact))
    return replace(problem, rows=(*problem.rows, rows), noise=Noise((*problem.noise.blocks, block)), constraints=kept)
