"""Constant unknowns as states: an assumed height or a late clock is estimated while a target is tracked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Motion
from optloc.problem.epochs import cut
from optloc.problem.forms import form_of
from optloc.problem.problem import Problem
from optloc.solvers.solution import solve
from optloc.tracking.dynamics import Dynamics
from optloc.tracking.track import State, Track, check_state, check_trackable, follow
from optloc.tracking.updates import Update, filter_of


def begun_with_constants(problem: Problem, dynamics: Dynamics, epochs: int) -> State:
    """Return the joint state of a target and of the biases of its run, from the first epochs, without a guess.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs of one target. Biases are offsets, scales or rotations. A bias that the first epochs do not
        determine needs a prior.
    dynamics : Dynamics
        Gives the order of the state.
    epochs : int
        Number of first epochs for the start.

    Returns
    -------
    State
        At the last used epoch: [p, v, a], then the biases in the order of the layout; NaN if there is no fix.
    """
    _check_constants(problem)
    time = float(problem.times[epochs - 1])
    # The state is estimated at the last used epoch, so that no scan is used twice.
    fix = solve(replace(cut(problem, 0, epochs), motions=(Motion(dynamics.order, reference=time),)))
    mean, cov = fix.gaussian()
    return State(time, np.where(fix.answered[..., None], mean, np.nan), np.array(cov))


def followed_with_constants(problem: Problem, start: State, dynamics: Dynamics, update: Update | str = "iekf") -> Track:
    """Return the track of a target from a given state, with the biases of the run as additional states.

    A constant has no process noise. The common error of all scans stays in the covariance, whereas white noise of the
    same size would average out.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs, see `begun_with_constants`; scans at or before the start are ignored.
    start : State
        [p, v, a] and the biases, at or before the first used scan.
    dynamics : Dynamics
        Model of motion.
    update : callable or str
        A filter, or its name in `UPDATES`.

    Returns
    -------
    Track
        Its means hold [p, v, a], then the biases.

    Raises
    ------
    InvalidProblem
        If the filter is unknown, a bias drifts, or the state does not fit.

    References
    ----------
    B. Friedland, "Treatment of bias in recursive filtering", IEEE Trans. Autom. Control 14 (1969): the augmented state.
    """
    _check_constants(problem)
    d = problem.dimension
    # All shared unknowns of the layout except the states of motion are constants of the run.
    constants = problem.layout.n_shared - sum((motion.order + 1) * d for motion in problem.motions)
    check_state(start, (dynamics.order + 1) * d + constants)
    return follow(problem, start, _with_constants(dynamics, constants), filter_of(update))


def _check_constants(problem: Problem) -> None:
    """Raise InvalidProblem if a tracker cannot use the run, or if a bias changes with time."""
    check_trackable(replace(problem, biases=()))
    # A bias that changes with time is not constant within a scan: its model would need the time.
    changing = next((bias for bias in problem.biases if form_of(bias).changes), None)
    if changing is not None:
        what = f"the {changing.form} {changing.name!r} changes with time"
        raise InvalidProblem(what, "track", "estimate it first, then call `with_known_bias`")


def _with_constants(dynamics: Dynamics, constants: int) -> Dynamics:
    """Return dynamics of a state with additional constants at its end; `constants` is their number."""

    def step(dt: float, mean: Array, d: int) -> tuple[Array, Array, Array]:
        """Return F, Q and drive of the state with its constants; see `Step` of `optloc.tracking.dynamics`."""
        n = mean.shape[-1] - constants
        F, Q, drive = dynamics.step(dt, mean[..., :n], d)
        none = [(0, 0)] * (Q.ndim - 2)
        pad = (0, constants)
        # Constants do not change: identity in F, zero in Q and drive.
        whole = np.pad(F, [(0, 0)] * (F.ndim - 2) + [pad, pad])
        whole[..., range(n, n + constants), range(n, n + constants)] = 1.0
        return whole, np.pad(Q, [*none, pad, pad]), np.pad(drive, [(0, 0)] * (drive.ndim - 1) + [pad])

    return Dynamics(f"{dynamics.name} with constants", dynamics.order, step)
