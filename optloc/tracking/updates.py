"""Update of a predicted state by one scan: all filters use the same linearised rows.

Letters: m rows of a scan, n numbers of a state, (...) a batch of states. H (m, n) is the derivative of
the rows, and R (m, m) is their covariance. P (n, n) is the covariance of the predicted state, K (n, m) is the
gain, and S = H P H' + R is the covariance of the innovations. Whitened rows have R = I.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.registry import Registry
from optloc.base.types import Array
from optloc.kernels.filter import (
    CODE,
    COUNT,
    EKF,
    GENERAL,
    HALVINGS,
    IEKF,
    LOGLIKELIHOOD,
    MGEKF,
    MVEKF,
    NIS,
    NODES,
    RISE,
    SHARES,
    Filtered,
    Filtering,
)
from optloc.linear.evaluate import differentiate
from optloc.linear.normal import linearise, with_station_noise
from optloc.problem import noise as noises
from optloc.problem.loss import LOSSES, Loss
from optloc.problem.noise import Whitener
from optloc.problem.problem import Problem
from optloc.solvers.robust.reweighting import Doubt, fold_signs
from optloc.tracking.scan_rows import Scans, size_of

# Largest number of iterations of weights and updates, and the change of all weights that ends them. This change moves a
# state by less than a thousandth of a sigma. An iteration takes as long as a plain update and reduces the change by
# about two thirds: typically seven iterations.
_TURNS, _SETTLED = 30, 1e-4


@dataclass(frozen=True, slots=True)
class Updated:
    """A state after a scan.

    Parameters
    ----------
    mean : array (..., n)
        State [p, v, a]: m, m/s, m/s^2.
    cov : array (..., n, n)
        Covariance of the state.
    nis : array (...)
        Normalised innovation squared at the prediction; chi-square distributed with `count` degrees of freedom.
    loglikelihood : array (...)
        Log-likelihood of the scan given the prediction.
    count : array (...)
        Number of rows used.
    """

    mean: Array
    cov: Array
    nis: Array
    loglikelihood: Array
    count: Array


Update = Callable[[Problem, Array, Array], Updated]
"""Function of a scan (a problem of one epoch with the state as unknown), means and covariances; returns `Updated`."""


@dataclass(frozen=True, slots=True)
class Filter:
    """A shipped filter: an `Update` with one call of compiled code for each scan.

    - The extended Kalman filter linearises once, at the prediction [1]_. It is the same as the "log-likelihood
      pseudo-linear" update of angle trackers: normal equations of the rows, with the prediction as prior.
    - The iterated filter takes Gauss-Newton steps to the maximum a posteriori point [2]_. It halves a step that raises
      the cost.
    - The modified-gain filter has the state of the extended Kalman filter but another covariance [3]_. This covariance
      uses a matrix g with h(x) - h(y) = g (x - y) exactly. Here y is the prediction and x the updated state. The mean
      derivative between y and x is such a g for every kind of measurement.
    - The modified-covariance filter has the state of the extended Kalman filter, and a covariance linearised after the
      step.

    Parameters
    ----------
    summary : str
        One line for listings.
    how : Filtering
        Form, steps and gate.

    References
    ----------
    .. [1] A. H. Jazwinski, "Stochastic Processes and Filtering Theory" (1970), theorem 8.1.
    .. [2] B. M. Bell, F. W. Cathey, "The iterated Kalman filter update as a Gauss-Newton method", IEEE Trans. Autom.
       Control 38 (1993).
    .. [3] T. L. Song, J. L. Speyer, "A stochastic analysis of a modified gain extended Kalman filter with applications
       to estimation with bearings only measurements", IEEE Trans. Autom. Control 30 (1985), eq. 9 to 13.
    """

    summary: str
    how: Filtering

    def __call__(self, scan: Problem, mean: Array, cov: Array) -> Updated:
        """Return the update of states (..., n) at the time of a scan."""
        motion = scan.motions[0]
        if scan.epochs == 1 and motion.known is None and motion.reference in (None, scan.times[0]):
            found = Scans.of(scan, motion.order).filtered(0, mean, cov, self.how._replace(d=scan.dimension))
            if found is not None and not (found.values[..., CODE] == GENERAL).any():
                return read(found)
        return self._general(scan, mean, cov)

    def _general(self, scan: Problem, mean: Array, cov: Array) -> Updated:
        """Return the update in NumPy, for scans that `optloc.tracking.scan_rows.Scans` does not support.

        `mean` (..., n) and `cov` (..., n, n) are the predicted states.
        """
        form, gate = self.how.form, self.how.gate
        if np.isfinite(gate):
            scan = scan.with_rows(weight=weights_within(scan, mean, cov, gate))
        white = whitened(scan, mean)
        slope, gain = white.H, _gain(white.H, cov)
        x = mean + (gain @ white.residual[..., None])[..., 0]
        if form == IEKF:
            x = _map_states(scan, mean, cov, white, self.how)
        if form in (IEKF, MVEKF):
            slope = whitened(scan, x).H
            gain = _gain(slope, cov)
        if form == MGEKF:
            parts = [w * whitened(scan, mean + node * (x - mean)).H for node, w in zip(NODES, SHARES, strict=True)]
            slope = np.sum(parts, axis=0)
        return _with_likelihood(white, cov, x, joseph(slope, gain, cov))


ekf = Filter("the extended Kalman filter: one linearisation at the prediction", Filtering(EKF))
"""The extended Kalman filter."""
# Gauss-Newton converges in two to four steps near its solution; a step of a millionth of a sigma ends it.
iekf = Filter(
    "the iterated extended Kalman filter: Gauss-Newton to the maximum a posteriori point", Filtering(IEKF, 20, 1e-6)
)
"""The iterated extended Kalman filter."""
mgekf = Filter("the modified-gain extended Kalman filter", Filtering(MGEKF))
"""The modified-gain extended Kalman filter."""
mvekf = Filter("the modified-covariance extended Kalman filter: linearised after the step", Filtering(MVEKF))
"""The modified-covariance extended Kalman filter."""

UPDATES: Registry[Update] = Registry(
    "optloc.trackers", callable, {"ekf": ekf, "iekf": iekf, "mgekf": mgekf, "mvekf": mvekf}
)
"""Filters by name. Add one function and one line, or, in another package, an entry point of ``optloc.trackers``."""


def filter_of(update: Update | str) -> Update:
    """Return the filter with a name in `UPDATES`, or the given filter; an unknown name raises InvalidProblem."""
    if not isinstance(update, str):
        return update
    if update not in UPDATES:
        raise InvalidProblem(f"unknown filter {update!r}", "filter", nearest(update, list(UPDATES)))
    return UPDATES[update]


def gated(update: Update | str, width: float = 5.0) -> Update:
    """Return a filter with a gate: it rejects rows with an innovation that is too large.

    Parameters
    ----------
    update : callable or str
        The filter, or its name in `UPDATES`.
    width : float
        Half width of the gate in standard deviations of each row's innovation, prediction included.

    Returns
    -------
    callable
        A filter; `Updated.count` is the number of rows that passed.

    Raises
    ------
    InvalidProblem
        For an unknown filter or a width that is not positive.
    """
    rule = filter_of(update)
    check_width(width)
    if isinstance(rule, Filter):
        return replace(rule, how=rule.how._replace(gate=min(float(width), rule.how.gate)))
    return lambda scan, mean, cov: rule(scan.with_rows(weight=weights_within(scan, mean, cov, width)), mean, cov)


def reweighted(update: Update | str, loss: Loss | str) -> Update:
    """Return a filter that iterates its update with rows weighted by a loss of their residuals.

    The first weights come from the innovations in their standard deviations, prediction included. Later weights come
    from the residuals at the updated state, as in `optloc.solve` with this loss. With "iekf", the state is a stationary
    point of prior and loss together. The covariance is the covariance of least squares with these weights.

    Parameters
    ----------
    update : callable or str
        A filter, or its name in `UPDATES`.
    loss : Loss or str
        A loss, or its name in `optloc.problem.LOSSES`.

    Raises
    ------
    InvalidProblem
        For an unknown filter or loss.

    References
    ----------
    C. J. Masreliez, R. D. Martin, "Robust Bayesian estimation for the linear model and robustifying the Kalman filter",
    IEEE Trans. Autom. Control 22 (1977).
    """
    rule = filter_of(update)
    if isinstance(loss, str):
        if loss not in LOSSES:
            raise InvalidProblem(f"unknown loss {loss!r}", "loss", nearest(loss, list(LOSSES)))
        loss = LOSSES[loss]
    chosen: Loss = loss

    def robust(scan: Problem, mean: Array, cov: Array) -> Updated:
        """Return the update with weighted rows, repeated until the weights are constant.

        `mean` (..., n) and `cov` (..., n, n) are the predicted states.
        """
        # Scan and state may have different leading axes; the loss works on a flat batch.
        many = np.broadcast_shapes(scan.batch_shape, mean.shape[:-1])
        x, flat = np.broadcast_to(mean, (*many, mean.shape[-1])).reshape(-1, mean.shape[-1]), scan.flat()
        # `doubt` contains, for each row, `base` (weight without the loss), `own` (variance) and `sided` (gross errors
        # are positive only).
        doubt = Doubt.of(flat, x)
        # An innovation includes the uncertainty of the prediction, so an uncertain state does not reduce the weight of
        # a row.
        residual, H = differentiate(flat, x)
        spread = ((H @ np.broadcast_to(cov, (*many, *cov.shape[-2:])).reshape(-1, *cov.shape[-2:])) * H).sum(-1)
        # `spread` is the variance of each row's prediction; u is the innovation in its standard deviations.
        u = np.where(doubt.base > 0.0, residual, 0.0) / np.sqrt(doubt.own + spread)
        weight = chosen.weight(fold_signs(chosen, u, doubt.sided))
        for _ in range(_TURNS):
            found = rule(scan.with_rows(weight=doubt.row_weight(weight).reshape(*many, -1)), mean, cov)
            # From here on, use residuals at the updated state, as in a fix.
            u = doubt.residual(flat, found.mean.reshape(x.shape), weight)
            fresh = chosen.weight(fold_signs(chosen, u, doubt.sided))
            # each problem of a batch stops separately
            moving = np.abs(fresh - weight).max(-1, initial=0.0) >= _SETTLED
            if not moving.any():
                break
            weight = np.where(moving[:, None], fresh, weight)
        return found

    return robust


def read(found: Filtered) -> Updated:
    """Return the states after a scan from the output of the compiled filter."""
    values = found.values
    return Updated(found.mean, found.cov, values[..., NIS], values[..., LOGLIKELIHOOD], values[..., COUNT])


# Whitened rows of a scan, and the functions of all filters.


@dataclass(frozen=True, slots=True)
class White:
    """The rows of one scan, linearised, with unit covariance.

    - residual (..., m): whitened z - h(x).
    - H (..., m, n): whitened derivative.
    - count (...): number of present rows.
    - logdet (...): logarithm of the determinant of 2 pi R of the present rows.
    """

    residual: Array
    H: Array
    count: Array
    logdet: Array


def whitened(scan: Problem, x: Array, noise: tuple[Whitener, ...] | None = None) -> White:
    """Return the rows of a scan linearised at states x (..., n) and whitened; absent rows are zero.

    `noise` are whitening matrices from an earlier call; None: compute them.
    """
    linear = linearise(scan, x, noise)
    both = np.concatenate([linear.shared, linear.residual[..., None]], axis=-1)
    white = np.concatenate([w.apply(both) for w in linear.noise], axis=-2)
    count, logdet = _size_of(linear.noise, white.shape[:-2])
    return White(white[..., -1], white[..., :-1], count, logdet)


def _size_of(noise: tuple[Whitener, ...], shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the number of present rows and the logarithm of the determinant of 2 pi R, each (...).

    `noise` are the whitening matrices of the rows, and `shape` is the batch shape (...).
    """
    total = np.zeros((*shape, 2))
    for w in noise:
        # A block that many groups of rows share is stored once.
        total = total + (len(w.row) if w.matrix.shape[-3] == 1 else 1) * size_of(w.matrix).sum(-2)
    return total[..., 0], total[..., 1]


def joseph(H: Array, gain: Array, cov: Array) -> Array:
    """Return (I - K H) P (I - K H)' + K K', (..., n, n), for whitened rows: symmetric and positive for any gain.

    This is the covariance after an update. `gain` is K (..., n, m), and `cov` is P (..., n, n).
    """
    # The short form (I - K H) P is correct only for the optimal gain, and rounding makes it asymmetric.
    left = np.eye(cov.shape[-1]) - gain @ H
    out = left @ cov @ np.swapaxes(left, -1, -2) + gain @ np.swapaxes(gain, -1, -2)
    return np.asarray(0.5 * (out + np.swapaxes(out, -1, -2)))


def _gain(H: Array, cov: Array) -> Array:
    """Return the Kalman gain K (..., n, m) for whitened rows H (..., m, n) and predicted covariances (..., n, n)."""
    # With whitened rows, S is regular for any prior, even for an exactly known state.
    S = H @ cov @ np.swapaxes(H, -1, -2) + np.eye(H.shape[-2])
    solved, _ = linalg.solve(S, H @ cov)
    return np.swapaxes(solved, -1, -2)


def _with_likelihood(white: White, cov: Array, mean: Array, after: Array) -> Updated:
    """Return the updated state with its NIS and log-likelihood, from the rows at the prediction.

    `white` are the whitened rows and `cov` (..., n, n) is the covariance, both at the prediction. `mean`
    (..., n) and `after` (..., n, n) are the updated state.
    """
    S = white.H @ cov @ np.swapaxes(white.H, -1, -2) + np.eye(white.H.shape[-2])
    # ln|2 pi S| of the rows as measured: the value of the whitened rows plus the logarithm of the whitening.
    lower, _ = linalg.factor(S)
    solved, _ = linalg.solve(S, white.residual[..., None])
    nis = (white.residual * solved[..., 0]).sum(-1)
    logdet = white.logdet + 2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return Updated(mean, after, nis, -0.5 * (nis + logdet), white.count)


def _map_states(scan: Problem, mean: Array, cov: Array, white: White, how: Filtering) -> Array:
    """Return the maximum a posteriori states (..., n) by Gauss-Newton, starting from the predictions.

    `mean` (..., n) and `cov` (..., n, n) are the predictions, and `white` are the rows linearised there.
    `how.limit` is the largest number of steps. `how.tolerance` is the step length, in standard deviations of
    the prediction, that ends the iteration.
    """
    # The prior is one more block of whitened rows: steps must not increase the cost of rows and prior together.
    prior = linalg.whitening(cov)
    # At the prediction the prior costs nothing. `moving` marks the states that have not converged.
    x, cost, moving = mean, (white.residual**2).sum(-1), np.ones(mean.shape[:-1], dtype=bool)
    for _ in range(how.limit):
        # Gauss-Newton in the form of the filter: rows linearised at x, prior at the prediction.
        misfit = white.residual - (white.H @ (mean - x)[..., None])[..., 0]
        step = mean + (_gain(white.H, cov) @ misfit[..., None])[..., 0] - x
        # The whole step first, then halves of it; a converged state does not move.
        share = np.where(moving, 1.0, 0.0)
        for _ in range(HALVINGS):
            tried = x + share[..., None] * step
            white = whitened(scan, tried)
            away = (prior @ (tried - mean)[..., None])[..., 0]
            now = (white.residual**2).sum(-1) + (away**2).sum(-1)
            # RISE is the relative rise of the cost that counts as rounding.
            # NaN counts as worse: a step to a point where h is undefined is halved, too.
            worse = moving & ~(now <= cost + RISE * (1.0 + np.abs(cost)))
            if not worse.any():
                break
            share = np.where(worse, 0.5 * share, share)
        # Each target of a batch stops separately, at a step of a millionth of a standard deviation.
        length = np.sqrt(((prior @ (tried - x)[..., None])[..., 0] ** 2).sum(-1))
        x, cost, moving = tried, np.where(moving, now, cost), moving & (length > how.tolerance)
        if not moving.any():
            break
    return x


# Gates: tests of the rows of a scan against a predicted state.


@dataclass(frozen=True, slots=True)
class Innovation:
    """Measurements of a scan minus their predictions, with the covariance of the difference.

    - value (..., m): z - h(x) of each row in its SI unit, angles wrapped; zero for absent rows.
    - covariance (..., m, m): S = H P H' + R.
    """

    value: Array
    covariance: Array

    @property
    def normalised(self) -> Array:
        """Return each row's innovation divided by its standard deviation, (..., m)."""
        return np.asarray(self.value / np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1)))


def innovation(scan: Problem, mean: Array, cov: Array) -> Innovation:
    """Return the innovation of every row of a scan.

    Parameters
    ----------
    scan : Problem
        A problem of one epoch whose only unknown is the state.
    mean : array (..., n)
        Predicted states.
    cov : array (..., n, n)
        Covariances of the predicted states.

    References
    ----------
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), eq.
    5.2.3-9.
    """
    linear = linearise(scan, mean, ())  # no whitening is needed here
    H = linear.shared
    # Station errors are part of the noise, and their effect depends on the position of the target.
    R = noises.dense(with_station_noise(scan, mean).noise, np.arange(scan.count))
    return Innovation(linear.residual, H @ cov @ np.swapaxes(H, -1, -2) + R)


def weights_within(scan: Problem, mean: Array, cov: Array, width: float) -> Array:
    """Return the weights (..., m) of a scan's rows; zero for an innovation outside the gate of `width` sigmas."""
    with np.errstate(invalid="ignore"):  # a lost state has no row in its gate
        inside = np.abs(innovation(scan, mean, cov).normalised) <= width
    return np.asarray(np.where(inside, scan.weight, 0.0))


def check_width(width: float) -> None:
    """Raise InvalidProblem if the width of a gate is not positive."""
    if not width > 0.0:
        raise InvalidProblem(
            f"the width of the gate is {width}", "width", "give a number of standard deviations above 0"
        )
