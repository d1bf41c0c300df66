"""What the equations do as they are printed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc import linalg
from optloc.linear import linearise
from optloc.normal import normal, step
from optloc.problem import Problem
from optloc.track.dynamics import Dynamics
from optloc.track.updates import Update, Updated, joseph, whitened
from optloc.types import Array


def twice_predicted(dynamics: Dynamics, interval: float, dimension: int) -> Update:
    """Return the update of equations 28 to 31 as printed: the transition is applied once more within H.

    Parameters
    ----------
    dynamics : Dynamics
        Model of motion.
    interval : float
        Seconds between epochs.
    dimension : int
        2 or 3.
    """
    n = (dynamics.order + 1) * dimension
    F = dynamics.step(interval, np.zeros(n), dimension)[0]

    def update(scan: Problem, mean: Array, cov: Array) -> Updated:
        white = whitened(scan, mean)
        H = white.H @ F
        S = H @ cov @ np.swapaxes(H, -1, -2) + np.eye(H.shape[-2])
        gain = np.swapaxes(linalg.solve(S, H @ cov)[0], -1, -2)
        solved = linalg.solve(S, white.residual[..., None])[0][..., 0]
        nis = (white.residual * solved).sum(-1)
        lower, _ = linalg.factor(S)
        logdet = white.logdet + 2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
        moved = mean + (gain @ white.residual[..., None])[..., 0]
        return Updated(moved, joseph(H, gain, cov), nis, -0.5 * (nis + logdet), white.count)

    return update


def taylor(problem: Problem, start: Array, *, sign: float = 1.0, steps: int = 50) -> Array:
    """Return positions after undamped steps of the linearised fix, equations 5 to 8.

    Parameters
    ----------
    problem : Problem
        Batch (...) of single epochs.
    start : array (..., d)
        Starting positions, metres.
    sign : float
        1, or -1 for the residual with the sign that equations 8 and 15 print.
    steps : int
        Number of steps.

    Returns
    -------
    array (..., d)
        Not finite where the steps ran away.
    """
    x = np.broadcast_to(start, (*problem.batch_shape, start.shape[-1]))
    with np.errstate(all="ignore"):
        for _ in range(steps):
            linear = linearise(problem, x)
            move, ok = step(normal(replace(linear, residual=sign * linear.residual), 1), np.zeros(x.shape[:-1]))
            x = x + np.where(ok[..., None], move, np.nan)
    return x


def weighting(problem: Problem, place: Array, covariance: Array) -> tuple[float, float]:
    """Return root mean square errors of a fix with equal weights and with those of the covariance, to first order.

    Parameters
    ----------
    problem : Problem
        One epoch.
    place : array (d,)
        Target, metres.
    covariance : array (m, m)
        True covariance of the rows.
    """
    H = linearise(problem, place).shared
    plain = np.linalg.solve(H.T @ H, H.T)
    best = np.linalg.inv(H.T @ np.linalg.solve(covariance, H))
    return float(np.sqrt(np.trace(plain @ covariance @ plain.T))), float(np.sqrt(np.trace(best)))
