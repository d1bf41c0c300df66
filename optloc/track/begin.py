"""Where a track begins: the first scans that determine a state and do not contradict each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.fix import Fix
from optloc.problem import Problem
from optloc.status import Status
from optloc.track.dynamics import Dynamics
from optloc.track.start import counts, first_fix, state_of
from optloc.track.track import State
from optloc.types import Array
from optloc.windows import cut

# Rows of a start whose chi-square is less likely than this contradict each other: the next scan is tried.
_PLAUSIBLE = 1e-4
# So many first scans are tried before a start that contradicts itself is taken, and so many scans for a clear one.
_SLIDES, _CLEAR = 20, 24


@dataclass(frozen=True, slots=True)
class Begun:
    """A start, or why there is none.

    Parameters
    ----------
    last : int
        Last scan that was used, or given up.
    state : State or None
        At that scan.
    code : Status
        Ok; ambiguous where the state has alternatives; rejected where the rows contradict each other.
    waiting : Status
        Of the scans before: ok where a start follows.
    reason : str
        A sentence where the status is not ok.
    """

    last: int
    state: State | None
    code: Status
    waiting: Status
    reason: str = ""


@dataclass(frozen=True, slots=True)
class _Found:
    fix: Fix
    last: int
    state: State
    p: float


def beginning(problem: Problem, first: int, dynamics: Dynamics, speed: float | None, rate: float | None) -> Begun:
    """Return a start from the scan `first` on, without a guess.

    The fewest scans that determine the state are solved as one problem. Where their rows contradict each other the
    stretch begins one scan later, where several states explain them it is made longer.

    Parameters
    ----------
    problem : Problem
        A single run of one target.
    first : int
        First scan that may be used.
    dynamics : Dynamics
        Gives the order of the state.
    speed, rate : float, optional
        Prior standard deviations, see `begun`.
    """
    doubtful: list[_Found] = []
    verdict = Status.TOO_FEW_ROWS
    heard = _heard(problem, first)
    for k in heard[:_SLIDES].tolist():
        found, verdict = _stretch(problem, k, dynamics, speed, rate)
        if found is None:
            break  # what all later scans leave open, fewer of them do too
        if found.p >= _PLAUSIBLE and int(found.fix.code) == Status.OK:
            return Begun(found.last, found.state, Status.OK, Status.OK)
        doubtful.append(found)
        if found.p >= _PLAUSIBLE:
            break
    if not doubtful:
        reason = f"the scans that are left do not determine a state: {verdict.label}"
        return Begun(problem.epochs - 1, None, verdict, verdict, reason)
    best = max(doubtful, key=lambda each: each.p)
    if best.p < _PLAUSIBLE:
        reason = f"the rows of the start contradict each other (p = {best.p:.2g})"
        return Begun(best.last, best.state, Status.REJECTED, Status.OK, reason)
    others = int(np.isfinite(best.fix.alternatives.gap).sum())
    reason = f"the start has {others} alternative{'s' if others > 1 else ''}"
    return Begun(best.last, best.state, Status.AMBIGUOUS, Status.OK, reason)


def reach(problem: Problem, position: Array) -> float:
    """Return the spread of the stations, or the range of a position (d,) from their centre if that is more, metres."""
    stations = problem.stations.position.reshape(-1, problem.dimension)
    centre = stations.mean(0)
    spread = float(np.linalg.norm(stations - centre, axis=-1).max())
    return max(spread, float(np.linalg.norm(position - centre)))


def _heard(problem: Problem, first: int) -> Array:
    """Return the scans from `first` on that have a valid row."""
    scans = np.unique(problem.epoch[problem.weight > 0.0])
    return np.asarray(scans[scans >= first])


def _stretch(
    problem: Problem, k: int, dynamics: Dynamics, speed: float | None, rate: float | None
) -> tuple[_Found | None, Status]:
    """Return the first clear start from scan k on, else the first one that is answered, and the last verdict."""
    run, ambiguous, verdict = cut(problem, k, problem.epochs), None, Status.TOO_FEW_ROWS
    for count in counts(run.epochs, dynamics.order, speed, rate):
        if ambiguous is not None and count > _CLEAR:
            break
        fix = first_fix(run, dynamics, count, speed=speed, rate=rate)
        verdict = Status(int(fix.code))
        if verdict not in (Status.OK, Status.AMBIGUOUS, Status.SEARCHED):
            continue
        state = state_of(run, fix, count)
        d = problem.dimension
        sigma = float(np.sqrt(np.linalg.eigvalsh(state.cov[:d, :d])[-1]))
        if not sigma <= reach(problem, state.mean[:d]):
            continue
        p = float(fix.p_value)
        found = _Found(fix, k + count - 1, state, 1.0 if np.isnan(p) else p)
        if found.p < _PLAUSIBLE:
            return ambiguous or found, verdict
        if verdict == Status.OK:
            return found, verdict
        ambiguous = ambiguous or found
    return ambiguous, verdict
