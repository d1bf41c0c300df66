"""What one scan says about a predicted state: one small function for each filter, all on the same linearisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optloc.base import linalg
from optloc.base.registry import Table
from optloc.base.types import Array
from optloc.linear.normal import linearise
from optloc.problem.noise import Whitener
from optloc.problem.problem import Problem


@dataclass(frozen=True, slots=True)
class White:
    """The rows of one scan, linearised, with unit covariance.

    Parameters
    ----------
    residual : array (..., m)
        Whitened z - h(x).
    H : array (..., m, n)
        Whitened derivative.
    count : array (...)
        Number of rows that are present.
    logdet : array (...)
        Logarithm of the determinant of 2 pi R of the rows that are present.
    """

    residual: Array
    H: Array
    count: Array
    logdet: Array


@dataclass(frozen=True, slots=True)
class Updated:
    """A state after a scan.

    Parameters
    ----------
    mean : array (..., n)
        State.
    cov : array (..., n, n)
        Covariance.
    nis : array (...)
        Normalised innovation squared at the prediction; chi-square distributed with `count` degrees of freedom.
    loglikelihood : array (...)
        Of the scan given the prediction.
    count : array (...)
        Rows used.
    """

    mean: Array
    cov: Array
    nis: Array
    loglikelihood: Array
    count: Array


Update = Callable[[Problem, Array, Array], Updated]
"""Maps a scan (a problem of one epoch whose only unknown is the state), means and covariances to the updated state."""


def whitened(scan: Problem, x: Array, noise: tuple[Whitener, ...] | None = None) -> White:
    """Return the rows of a scan linearised at states x (..., n), whitened; absent rows are zero."""
    linear = linearise(scan, x, noise)
    both = np.concatenate([linear.shared, linear.residual[..., None]], axis=-1)
    white = np.concatenate([w.apply(both) for w in linear.noise], axis=-2)
    count, logdet = np.zeros(white.shape[:-2]), np.zeros(white.shape[:-2])
    for w in linear.noise:
        pivots = np.diagonal(w.matrix, axis1=-2, axis2=-1)
        present = pivots > 0.0
        share = len(w.row) if w.matrix.shape[-3] == 1 else 1
        count = count + share * present.sum((-1, -2))
        logdet = logdet - 2.0 * share * np.log(np.where(present, pivots, 1.0)).sum((-1, -2))
    return White(white[..., -1], white[..., :-1], count, logdet + count * np.log(2.0 * np.pi))


def ekf(scan: Problem, mean: Array, cov: Array) -> Updated:
    """Return the update of the extended Kalman filter: one linearisation at the prediction.

    The same as the "log-likelihood pseudo-linear" update of angle trackers: normal equations of the rows linearised at
    the prediction, with the prediction as prior.

    References
    ----------
    A. H. Jazwinski, "Stochastic Processes and Filtering Theory" (1970), theorem 8.1.
    """
    white = whitened(scan, mean)
    gain = _gain(white.H, cov)
    moved = mean + (gain @ white.residual[..., None])[..., 0]
    return _finished(white, cov, moved, joseph(white.H, gain, cov))


def iekf(scan: Problem, mean: Array, cov: Array, *, limit: int = 20, tolerance: float = 1e-6) -> Updated:
    """Return the update of the iterated extended Kalman filter: Gauss-Newton to the maximum a posteriori point.

    Steps that would raise the cost are halved.

    References
    ----------
    B. M. Bell, F. W. Cathey, "The iterated Kalman filter update as a Gauss-Newton method", IEEE Trans. Autom. Control
    38 (1993).
    """
    first = whitened(scan, mean)
    prior = linalg.whitening(cov)
    x, white, moving = mean, first, np.ones(mean.shape[:-1], dtype=bool)
    cost = (first.residual**2).sum(-1)
    for _ in range(limit):
        gain = _gain(white.H, cov)
        misfit = white.residual - (white.H @ (mean - x)[..., None])[..., 0]
        step = mean + (gain @ misfit[..., None])[..., 0] - x
        x, white, cost, length = _shortened(scan, mean, prior, x, step, cost, moving)
        moving &= length > tolerance
        if not moving.any():
            break
    return _finished(first, cov, x, joseph(white.H, _gain(white.H, cov), cov))


def mgekf(scan: Problem, mean: Array, cov: Array) -> Updated:
    """Return the update of the modified-gain extended Kalman filter.

    Its covariance uses a g with h(x) - h(y) = g (x - y) exactly, y the prediction and x the updated state: the mean of
    the derivative over the way from one to the other, which is such a g for every kind of measurement.

    References
    ----------
    T. L. Song, J. L. Speyer, "A stochastic analysis of a modified gain extended Kalman filter with applications to
    estimation with bearings only measurements", IEEE Trans. Autom. Control 30 (1985), eq. 9 to 13.
    """
    white = whitened(scan, mean)
    gain = _gain(white.H, cov)
    x = mean + (gain @ white.residual[..., None])[..., 0]
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    g = sum(
        0.5 * weight * whitened(scan, mean + 0.5 * (1.0 + node) * (x - mean)).H
        for node, weight in zip(nodes, weights, strict=True)
    )
    return _finished(white, cov, x, joseph(np.asarray(g), gain, cov))


def mvekf(scan: Problem, mean: Array, cov: Array) -> Updated:
    """Return the update of the modified-covariance extended Kalman filter: the covariance is linearised after the step.

    The state is that of `ekf`; only the next gain differs.
    """
    white = whitened(scan, mean)
    x = mean + (_gain(white.H, cov) @ white.residual[..., None])[..., 0]
    after = whitened(scan, x)
    return _finished(white, cov, x, joseph(after.H, _gain(after.H, cov), cov))


UPDATES: Table[Update] = Table("optloc.trackers", callable, {"ekf": ekf, "iekf": iekf, "mgekf": mgekf, "mvekf": mvekf})
"""Filters by name: add one function and one line, or from another package an entry point of ``optloc.trackers``."""

_NODES = 5
_HALVINGS = 8


def joseph(H: Array, gain: Array, cov: Array) -> Array:
    """Return (I - K H) P (I - K H)' + K K', (..., n, n), for whitened rows: symmetric and positive for any gain."""
    left = np.eye(cov.shape[-1]) - gain @ H
    out = left @ cov @ np.swapaxes(left, -1, -2) + gain @ np.swapaxes(gain, -1, -2)
    return np.asarray(0.5 * (out + np.swapaxes(out, -1, -2)))


def _gain(H: Array, cov: Array) -> Array:
    S = H @ cov @ np.swapaxes(H, -1, -2) + np.eye(H.shape[-2])
    solved, _ = linalg.solve(S, H @ cov)
    return np.swapaxes(solved, -1, -2)


def _finished(white: White, cov: Array, mean: Array, after: Array) -> Updated:
    S = white.H @ cov @ np.swapaxes(white.H, -1, -2) + np.eye(white.H.shape[-2])
    lower, _ = linalg.factor(S)
    solved, _ = linalg.solve(S, white.residual[..., None])
    nis = (white.residual * solved[..., 0]).sum(-1)
    logdet = white.logdet + 2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return Updated(mean, after, nis, -0.5 * (nis + logdet), white.count)


def _shortened(
    scan: Problem, mean: Array, prior: Array, x: Array, step: Array, cost: Array, moving: Array
) -> tuple[Array, White, Array, Array]:
    """Return the states after steps that do not raise the cost, their rows and costs, and the lengths in sigma."""
    share = np.where(moving, 1.0, 0.0)
    for _ in range(_HALVINGS):
        tried = x + share[..., None] * step
        white = whitened(scan, tried)
        away = (prior @ (tried - mean)[..., None])[..., 0]
        now = (white.residual**2).sum(-1) + (away**2).sum(-1)
        worse = moving & ~(now <= cost + 1e-9 * (1.0 + np.abs(cost)))
        if not worse.any():
            break
        share = np.where(worse, 0.5 * share, share)
    length = np.sqrt(((prior @ (share[..., None] * step)[..., None])[..., 0] ** 2).sum(-1))
    return tried, white, np.where(moving, now, cost), length
