"""The posterior Cramer-Rao bound: what no filter of a model of motion can beat on average."""

from __future__ import annotations

import numpy as np

from optloc import linalg
from optloc.problem import Problem
from optloc.track.dynamics import Dynamics
from optloc.track.track import State, scans
from optloc.track.updates import joseph, whitened
from optloc.types import Array


def posterior_bound(problem: Problem, truth: Array, start: State, dynamics: Dynamics) -> Array:
    """Return the posterior Cramer-Rao bound of the state after each scan that is later than the start.

    In covariance form, so that process noise may be singular: the extended Kalman filter's covariance with rows
    linearised at the truth. With noise, it averages over the tracks of the model: a smoother track can beat it.

    Parameters
    ----------
    problem : Problem
        A run of k epochs, see `optloc.track.track.scans`; its measurements do not matter.
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
        cov, at, now = F @ cov @ F.T + Q, truth[..., k, :], time
        if scan.count:
            H = whitened(scan, at).H
            gain, _ = linalg.solve(H @ cov @ np.swapaxes(H, -1, -2) + np.eye(H.shape[-2]), H @ cov)
            cov = joseph(H, np.swapaxes(gain, -1, -2), cov)
        out.append(cov)
    return np.stack(out, axis=-3)
