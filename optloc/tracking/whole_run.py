"""Whole-run fits: one polynomial course through all scans together, without a guess; and the posterior bound.

Letters: k epochs, n numbers of a state, (...) a batch of runs.
"""

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

    If the target really moves along a polynomial, this fit is far more accurate than any filter with process noise.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs of one target without biases; its model of motion is ignored.
    order : 0, 1 or 2
        Static, constant velocity, constant acceleration.
    reference : float, optional
        Time of the state in seconds; None for the last scan.
    method : str
        Method of `optloc.solve`.

    Returns
    -------
    Fix
        Fixes of the batch; a failure is a status.

    Raises
    ------
    InvalidProblem
        If the order is unknown, or the run has several targets.
    """
    if order not in (0, 1, 2):
        raise InvalidProblem(f"a motion of order {order}", "order", "use 0, 1 or 2")
    check_trackable(problem)
    time = float(problem.times[-1]) if reference is None else reference
    return solve(replace(problem, motions=(Motion(order, reference=time),)), method)


def along(state: State, times: Array, dimension: int) -> tuple[Array, Array]:
    """Return states (..., k, n) and covariances (..., k, n, n) along a polynomial course.

    The order of the course follows from the length n of the state: position, and velocity and acceleration if
    present. `times` (k,) are in seconds, before or after the state. `dimension` is 2 or 3.
    """
    # Without process noise, the transition is exact forward and backward in time.
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
        Order of the course.
    method : str
        Method of `optloc.solve`.

    Returns
    -------
    Track
        States at the scans given all scans. `nis` is the contribution of the rows of a scan to the chi-square of the
        fit. The status of a scan is the status of the fit (see `optloc.tracking.track.status_of_scans`), or too few
        rows for a scan without a row.

    Raises
    ------
    InvalidProblem
        If the order is unknown, or the run has several targets.
    """
    fix = fitted(problem, order, method=method)
    status = status_of_scans(fix)
    state = State(float(problem.times[-1]), *(np.asarray(part) for part in (fix.x, fix.cov)))
    mean, cov = along(state, problem.times, problem.dimension)
    steps = []
    # All states come from one fit: the contribution of a scan to its chi-square comes from its rows at its state.
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
        code = np.where(white.count > 0, status, int(Status.TOO_FEW_ROWS)).astype(np.int8)
        steps.append((found, np.broadcast_to(code, none.shape)))
    return collect(np.asarray(problem.times), steps, problem.dimension, dated=problem.dated)


def posterior_bound(problem: Problem, truth: Array, start: State, dynamics: Dynamics) -> Array:
    """Return the posterior Cramer-Rao bound of the state after each scan later than the start.

    The bound is the covariance of the extended Kalman filter with rows linearised at the true states. The covariance
    form allows singular process noise. With process noise, the bound is an average over the tracks of the model: on a
    smoother track, an estimate can have a smaller error.

    Parameters
    ----------
    problem : Problem
        A run of k epochs, see `optloc.tracking.track.scans`; its measurements are ignored.
    truth : array (..., k, n)
        True state [p, v, a] at every epoch.
    start : State
        Its covariance is the covariance of the prior.
    dynamics : Dynamics
        Model of motion. Noise that depends on the state is computed at the true state.

    Returns
    -------
    array (..., q, n, n)
        Covariance bound at the q epochs later than the start.

    References
    ----------
    P. Tichavsky, C. H. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear filtering",
    IEEE Trans. Signal Process. 46 (1998), eq. 21 with the true value instead of the average.
    """
    cov, at, now, out = start.cov, start.mean, start.time, []
    for k, (time, scan) in enumerate(scans(problem, dynamics.order)):
        if time <= start.time:
            continue
        F, Q, _ = dynamics.step(time - now, at, problem.dimension)
        # Noise that depends on the state is computed at the true state of the epoch before.
        cov, at, now = F @ cov @ F.T + Q, truth[..., k, :], time
        if scan.count:
            H = whitened(scan, at).H
            gain, _ = linalg.solve(H @ cov @ np.swapaxes(H, -1, -2) + np.eye(H.shape[-2]), H @ cov)
            cov = joseph(H, np.swapaxes(gain, -1, -2), cov)
        out.append(cov)
    return np.stack(out, axis=-3)
