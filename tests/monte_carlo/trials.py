"""One run of a case: measurements, the brute-force minimum, and what became of each trial."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from monte_carlo.layouts import CASES, KINDS, Case, model
from monte_carlo.reference import TIE, Minimum, Model, global_minimum

from optloc import Fix, Problem, Status, solve

Array = np.ndarray
BY_NAME = {case.name: case for case in CASES}


@dataclass(frozen=True)
class Trials:
    """The same N trials for every method.

    Parameters
    ----------
    case : Case
        Where they come from.
    model : Model
        The reference's model.
    z : array (N, m)
        Measurements.
    truth : array (N, d)
        Emitters.
    problem : Problem
        The package's problem.
    best : Minimum
        The reference.
    wild : array (N, size)
        Starting vectors anywhere in the box of the case.
    """

    case: Case
    model: Model
    z: Array
    truth: Array
    problem: Problem
    best: Minimum
    wild: Array


@cache
def trials(name: str, count: int) -> Trials:
    """Return the trials of a case; the same name and count give the same numbers, whatever else runs."""
    case = BY_NAME[name]
    draw, search, wild = case.seed.spawn(3)
    rng = np.random.default_rng(draw)
    stations, truth = case.stations(rng, count), case.emitters(rng, count)
    kind = KINDS[case.kind]
    own = model(kind, stations, case.sigma)
    exact = own.exact(truth)
    root = np.linalg.cholesky(kind.covariance(exact.shape[1], case.sigma))
    z = exact + rng.standard_normal(exact.shape) @ root.T
    if kind.emission:
        z = z + rng.uniform(-1e5, 1e5, (count, 1))
    problem = kind.problem(stations, z, case.sigma)
    start = np.zeros((count, problem.layout.size))
    d = truth.shape[1]
    start[:, :d] = np.random.default_rng(wild).uniform(-case.box, case.box, (count, d))
    return Trials(case, own, z, truth, problem, global_minimum(own, z, truth, search), start)


@cache
def automatic(name: str, count: int) -> Fix:
    """Return the fixes of a case without a guess."""
    return solve(trials(name, count).problem)


def position(fix: Fix) -> Array:
    """Return positions (N, d) of fixes of one epoch."""
    return fix.x[:, : fix.layout.find("position")[0].size]


@dataclass(frozen=True)
class Outcome:
    """How many of N trials ended where.

    Parameters
    ----------
    trials : int
        N.
    reached : array (N,)
        The fix costs no more than the reference.
    listed : array (N,)
        It costs more, but it is ambiguous and an alternative does not.
    declined : array (N,)
        Neither, and its status says that there is no answer.
    silent : array (N,)
        Neither, and its status claims an answer.
    lower : array (N,)
        The fix is below the reference: the reference missed.
    endless : array (N,)
        There is no minimum to find, because the likelihood keeps rising towards infinity or into a station, and the
        status says that there is no answer.
    claimed : array (N,)
        The same, and the status claims an answer.
    """

    trials: int
    reached: Array
    listed: Array
    declined: Array
    silent: Array
    lower: Array
    endless: Array
    claimed: Array


def outcome(run: Trials, fix: Fix) -> Outcome:
    """Return what became of each trial, judged by the reference's own cost."""
    d = run.truth.shape[1]
    cost = run.model.cost(position(fix), run.z)
    others = run.model.cost(fix.alternatives.x[..., :d], run.z).min(1, initial=np.inf)
    slack = TIE * (1.0 + run.best.infimum)
    answered = fix.answered
    # Where infinity explains the data as well, no place is claimed.
    sure = answered & ~fix.has(Status.UNBOUNDED)
    reached = answered & (cost <= run.best.cost + slack)
    listed = ~reached & fix.has(Status.AMBIGUOUS) & (others <= run.best.cost + slack)
    # An infimum at infinity is approached, never attained: a finite fix below it is the better point.
    endless = run.best.at_infinity & ~(answered & (cost <= run.best.infimum + slack))
    reached, listed = reached & ~endless, listed & ~endless
    missed = ~(reached | listed | endless)
    # An ambiguous fix says that infinity rivals it.
    claimed = endless & sure & ~fix.has(Status.AMBIGUOUS)
    return Outcome(
        len(cost),
        reached,
        listed,
        missed & ~sure,
        missed & sure,
        answered & ~endless & (cost + slack < run.best.cost),
        endless & ~claimed,
        claimed,
    )
