"""Whole-run fits: one polynomial course through all scans at once, without a guess."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Motion, Status
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers.solution import solve
from optloc.tracking.dynamics import Dynamics, polynomial
from optloc.tracking.track import State, Track, check_trackable, collect, scans, status_of_scans
from optloc.tracking.updates import Updated, joseph, whitened


def fitted(problem: Problem, order: int, *, reference: float | None = None, method: str = "auto") -> Fix:
    """Return the maximum-likelihood polynomial course through all scans of a run.

    Where the target really moves so, no filter with process noise comes near it.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs of one target without biases; what it says of the motion does not matter.
    order : 0, 1 or 2
        Static, constant velocity, constant acceleration.
    reference : float, optional
        Time at which the state holds, seconds; None: the last scan.
    method : str
        Of `optloc.solve`.

    Returns
    -------
    Fix
        Of the batch; failure is a status.

    Raises
    ------
    InvalidProblem
        For an unknown order, or a run that is not one target's.
    """
    if order not in (0, 1, 2):
        raise InvalidProblem(f"a motion of order {order}", "order", "use 0, 1 or 2")
    check_trackable(problem)
    time = float(problem.times[-1]) if reference is None else reference
    return solve(replace(problem, motions=(Motion(order, reference=time),)), method)


def along(state: State, times: Array, dimension: int) -> tuple[Array, Array]:
    """Return states and covariances along a polynomial course, before or after the state.

    Parameters
    ----------
    state : State
        Mean (..., n) and covariance; position, and velocity and acceleration if it has them.
    times : array (k,)
        Seconds.
    dimension : int
        2 or 3.

    Returns
    -------
    tuple of array
        Means (..., k, n) and covariances (..., k, n, n).
    """
    # Without process noise the transition is exact in either direction of time.
    model = polynomial(state.mean.shape[-1] // dimension - 1)
    F = np.stack([model.step(float(t) - state.time, state.mean, dimension)[0] for t in np.asarray(times)])
    mean = (F @ state.mean[..., None, :, None])[..., 0]
    return mean, F @ state.cov[..., None, :, :] @ np.swapaxes(F, -1, -2)


def smoothed(problem: Problem, order: int, *, method: str = "auto") -> Track:
    """Return the maximum-likelihood polynomial course through all scans as a track.

    Parameters
    ----------
    problem : Problem
        See `fitted`.
    order : 0, 1 or 2
        Of the course.
    method : str
        Of `optloc.solve`.

    Returns
    -------
    Track
        States at the scans given all of them. `nis` is what the rows of a scan add to the chi-square of the fit, and
        the status of all scans is that of the fit (see `optloc.tracking.track.status_of_scans`), but for those without
        a row.

    Raises
    ------
    InvalidProblem
        For an unknown order, or a run that is not one target's.
    """
    fix = fitted(problem, order, method=method)
    told = status_of_scans(fix)
    state = State(float(problem.times[-1]), *(np.asarray(part) for part in (fix.x, fix.cov)))
    mean, cov = along(state, problem.times, problem.dimension)
    steps = []
    # All states come from one fit: what a scan adds to its chi-square is that of its rows at its own state.
    for k, (_, scan) in enumerate(scans(problem, order)):
        at, spread = mean[..., k, :], cov[..., k, :, :]
        none = np.zeros(at.shape[:-1])
        if not scan.count:
            empty = Updated(at, spread, np.full(at.shape[:-1], np.nan), none, none)
            steps.append((empty, np.full(at.shape[:-1], int(Status.TOO_FEW_ROWS), dtype=np.int8)))
            continue
        with np.errstate(invalid="ignore"):
            white = whitened(scan, at)
            square = (white.residual**2).sum(-1)
        found = Updated(at, spread, square, -0.5 * (square + white.logdet), np.broadcast_to(white.count, none.shape))
        code = np.where(white.count > 0, told, int(Status.TOO_FEW_ROWS)).astype(np.int8)
        steps.append((found, np.broadcast_to(code, none.shape)))
    return collect(np.asarray(problem.times), steps, problem.dimension)


def posterior_bound(problem: Problem, truth: Array, start: State, dynamics: Dynamics) -> Array:
    """Return the posterior Cramer-Rao bound of the state after each scan that is later than the start.

    In covariance form, so that process noise may be singular: the extended Kalman filter's covariance with rows
    linearised at the truth. With noise, it averages over the tracks of the model: a smoother track can beat it.

    Parameters
    ----------
    problem : Problem
        A run of k epochs, see `optloc.tracking.track.scans`; its measurements do not matter.
    truth : array (..., k, n)
        True state [p, v, a] at every epoch.
    start : State
        Its covariance is the prior's.
    dynamics : Dynamics
        Model of motion; where its noise depends on the state, it is that of the true one.

    Returns
    -------
    array (..., q, n, n)
        Covariance bound at the q epochs that are later than the start.

    References
    ----------
    P. Tichavsky, C. H. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear filtering",
    IEEE Trans. Signal Process. 46 (1998), eq. 21 with the truth for the average.
    """
    cov, at, now, out = start.cov, start.mean, start.time, []
    for k, (time, scan) in enumerate(scans(problem, dynamics.order)):
        if time <= start.time:
            continue
        F, Q, _ = dynamics.step(time - now, at, problem.dimension)
        # Noise that depends on the state is that of the true one, at the time before.
        cov, at, now = F @ cov @ F.T + Q, truth[..., k, :], time
        if scan.count:
            H = whitened(scan, at).H
            gain, _ = linalg.solve(H @ cov @ np.swapaxes(H, -1, -2) + np.eye(H.shape[-2]), H @ cov)
            cov = joseph(H, np.swapaxes(gain, -1, -2), cov)
        out.append(cov)
    return np.stack(out, axis=-3)
