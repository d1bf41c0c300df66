"""What one scan says about a predicted state: one small function for each filter, all on the same linearisation."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass

import numpy as np

from optloc.base import linalg
from optloc.base.cache import Cache
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.registry import Table
from optloc.base.types import Array
from optloc.compute.filter import Absorbed, absorb
from optloc.compute.jit import at_hand
from optloc.compute.pack import Packed, observed, pack
from optloc.linear.evaluate import differentiate
from optloc.linear.normal import depends_on_place, linearise, whitener_at
from optloc.problem.loss import LOSSES, Loss
from optloc.problem.noise import Whitener
from optloc.problem.problem import Problem
from optloc.solvers.robust.reweighting import Doubt, fold_signs

# Gauss-Legendre nodes along the step: exact up to degree 9, and derivatives of ranges and angles are smooth over it.
_NODES = 5
# Halvings of a step that raises the cost: the last is a 256th, beyond which the point is as good as stationary.
_HALVINGS = 8
# Rise of a cost, as a share of it, that is rounding and no reason to halve.
_RISE = 1e-9
# Turns of weights and updates, and the change of all weights that ends them: it moves a state by less than a thousandth
# of a sigma. A turn costs what a plain update does and takes about two thirds off the change: seven as a rule.
_TURNS, _SETTLED = 30, 1e-4


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


def ekf(scan: Problem, mean: Array, cov: Array) -> Updated:
    """Return the update of the extended Kalman filter: one linearisation at the prediction.

    The same as the "log-likelihood pseudo-linear" update of angle trackers: normal equations of the rows linearised at
    the prediction, with the prediction as prior.

    References
    ----------
    A. H. Jazwinski, "Stochastic Processes and Filtering Theory" (1970), theorem 8.1.
    """
    quick = _by_machine_code(scan, mean, cov, 1, 0.0)
    if quick is not None:
        return quick
    white = whitened(scan, mean)
    gain = _gain(white.H, cov)
    moved = mean + (gain @ white.residual[..., None])[..., 0]
    return _finish(white, cov, moved, joseph(white.H, gain, cov))


# Gauss-Newton converges in two to four steps near its answer; a step of a millionth of a sigma is none.
def iekf(scan: Problem, mean: Array, cov: Array, *, limit: int = 20, tolerance: float = 1e-6) -> Updated:
    """Return the update of the iterated extended Kalman filter: Gauss-Newton to the maximum a posteriori point.

    Steps that would raise the cost are halved.

    References
    ----------
    B. M. Bell, F. W. Cathey, "The iterated Kalman filter update as a Gauss-Newton method", IEEE Trans. Autom. Control
    38 (1993).
    """
    quick = _by_machine_code(scan, mean, cov, limit, tolerance)
    if quick is not None:
        return quick
    first = whitened(scan, mean)
    # The prior is one more whitened row block: the cost that steps may not raise is that of rows and prior together.
    prior = linalg.whitening(cov)
    x, white, moving = mean, first, np.ones(mean.shape[:-1], dtype=bool)
    cost = (first.residual**2).sum(-1)
    for _ in range(limit):
        gain = _gain(white.H, cov)
        # Gauss-Newton in the form of the filter: rows linearised at x, prior at the prediction.
        misfit = white.residual - (white.H @ (mean - x)[..., None])[..., 0]
        step = mean + (gain @ misfit[..., None])[..., 0] - x
        x, white, cost, length = _shorten(scan, mean, prior, x, step, cost, moving)
        # Each target of a batch stops by itself, at a step of a millionth of a standard deviation.
        moving &= length > tolerance
        if not moving.any():
            break
    return _finish(first, cov, x, joseph(white.H, _gain(white.H, cov), cov))


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
    # The state moves as in `ekf`; only the covariance is another one.
    x = mean + (gain @ white.residual[..., None])[..., 0]
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    g = sum(
        0.5 * weight * whitened(scan, mean + 0.5 * (1.0 + node) * (x - mean)).H
        for node, weight in zip(nodes, weights, strict=True)
    )
    return _finish(white, cov, x, joseph(np.asarray(g), gain, cov))


def mvekf(scan: Problem, mean: Array, cov: Array) -> Updated:
    """Return the update of the modified-covariance extended Kalman filter: the covariance is linearised after the step.

    The state is that of `ekf`; only the next gain differs.
    """
    white = whitened(scan, mean)
    x = mean + (_gain(white.H, cov) @ white.residual[..., None])[..., 0]
    after = whitened(scan, x)
    return _finish(white, cov, x, joseph(after.H, _gain(after.H, cov), cov))


UPDATES: Table[Update] = Table("optloc.trackers", callable, {"ekf": ekf, "iekf": iekf, "mgekf": mgekf, "mvekf": mvekf})
"""Filters by name: add one function and one line, or from another package an entry point of ``optloc.trackers``."""


def filter_of(update: Update | str) -> Update:
    """Return a filter by name; raise InvalidProblem for an unknown one."""
    if not isinstance(update, str):
        return update
    if update not in UPDATES:
        raise InvalidProblem(f"unknown filter {update!r}", "filter", nearest(update, list(UPDATES)))
    return UPDATES[update]


def reweighted(update: Update | str, loss: Loss | str) -> Update:
    """Return a filter whose update is repeated with rows weighed by a loss of their residuals, until the weights stay.

    The first weights are those of the innovations in their own standard deviations, prediction included; later ones
    those of the residuals at the updated state, as in `optloc.solve` with this loss. With "iekf" the state is then a
    stationary point of prior and loss together; the covariance is that of least squares with these weights.

    Parameters
    ----------
    update : callable or str
        A filter, or its name in `UPDATES`.
    loss : Loss or str
        A loss, or its name in `optloc.LOSSES`.

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
        # Scan and state may each have the leading axes that the other lacks; the loss works on a flat batch.
        many = np.broadcast_shapes(scan.batch_shape, mean.shape[:-1])
        x, flat = np.broadcast_to(mean, (*many, mean.shape[-1])).reshape(-1, mean.shape[-1]), scan.flat()
        doubt = Doubt.of(flat, x)
        # An innovation has the prediction's uncertainty: a row is not doubted for what the state is unsure of.
        residual, H = differentiate(flat, x)
        spread = ((H @ np.broadcast_to(cov, (*many, *cov.shape[-2:])).reshape(-1, *cov.shape[-2:])) * H).sum(-1)
        u = np.where(doubt.base > 0.0, residual, 0.0) / np.sqrt(doubt.own + spread)
        weight = chosen.weight(fold_signs(chosen, u, doubt.sided))
        for _ in range(_TURNS):
            found = rule(scan.with_rows(weight=doubt.row_weight(weight).reshape(*many, -1)), mean, cov)
            # From here on residuals at the updated state, as in a fix: the update has taken what it believes.
            u = doubt.residual(flat, found.mean.reshape(x.shape), weight)
            fresh = chosen.weight(fold_signs(chosen, u, doubt.sided))
            # each of a batch stops by itself
            moving = np.abs(fresh - weight).max(-1, initial=0.0) >= _SETTLED
            if not moving.any():
                break
            weight = np.where(moving[:, None], fresh, weight)
        return found

    return robust


# One state and one scan by machine code: all but the measurements is kept for scans of the same rows.


@dataclass(frozen=True, slots=True)
class _Kept:
    """What scans share that differ in time and measurements alone."""

    packed: Packed
    count: Array
    logdet: Array


# A network has a few sets of rows that hear a target together; each takes some kilobytes.
_KEPT = Cache["_Kept | None"](256)


def _by_machine_code(scan: Problem, mean: Array, cov: Array, limit: int, tolerance: float) -> Updated | None:
    """Return the update of one state by one scan, or None where it takes numpy: others, or no machine code at hand."""
    if mean.ndim != 1 or type(mean) is not np.ndarray or not at_hand(absorb) or not _is_plain(scan):
        return None
    kept = _KEPT.find(_key_of(scan), lambda: _prepared(scan))
    if kept is None or kept.packed.tables.shared != len(mean):
        return None
    numbers = kept.packed.numbers._replace(observed=observed(scan))
    out = Absorbed(np.empty(len(mean)), np.empty((len(mean), len(mean))), np.empty(2))
    x, P = (np.require(array, float, ["C", "W"]) for array in (mean, cov))
    if absorb(kept.packed._replace(numbers=numbers), x, P, limit, tolerance, out) < 0:
        return None
    nis, logdet = out.said
    return Updated(out.mean, out.cov, nis, -0.5 * (nis + logdet + kept.logdet), kept.count)


def _is_plain(scan: Problem) -> bool:
    """Return whether the state of one target at the time of the scan is all that is unknown."""
    motion = scan.motions[0]
    return (
        not scan.batch_shape
        and len(scan.times) == len(scan.motions) == 1
        and motion.known is None
        and motion.reference in (None, scan.times[0])
        and not (scan.biases or scan.priors or scan.constraints)
        and not scan.stations.unknown_for
    )


def _key_of(scan: Problem) -> tuple[Hashable, ...]:
    """Return a key of all that a scan is made of but its time and its measurements."""
    s = scan.stations
    arrays = [s.position, s.velocity, s.axes, s.covariance, s.velocity_covariance]
    arrays += [b.covariance for b in scan.noise.blocks]
    arrays += [array for b in scan.noise.blocks for array in (b.row,)]
    arrays += [array for r in scan.rows for array in (r.a, r.b, r.target, r.weight, r.correction)]
    sizes = tuple((r.kind, r.count) for r in scan.rows), tuple(b.row.shape for b in scan.noise.blocks)
    numbers = tuple(None if array is None else array.tobytes() for array in arrays)
    return (sizes, numbers, s.count, scan.dimension, scan.frame, scan.motions[0].order)


def _prepared(scan: Problem) -> _Kept | None:
    if scan.emitting or depends_on_place(scan):
        return None
    noise = whitener_at(scan, np.zeros(scan.layout.size))
    packed = pack(scan, noise)
    return None if packed is None or packed.tables.local else _Kept(packed, *_size_of(noise, ()))


# Rows of a scan, whitened, and what all filters make of them.


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


def whitened(scan: Problem, x: Array, noise: tuple[Whitener, ...] | None = None) -> White:
    """Return the rows of a scan linearised at states x (..., n), whitened; absent rows are zero."""
    linear = linearise(scan, x, noise)
    both = np.concatenate([linear.shared, linear.residual[..., None]], axis=-1)
    white = np.concatenate([w.apply(both) for w in linear.noise], axis=-2)
    count, logdet = _size_of(linear.noise, white.shape[:-2])
    return White(white[..., -1], white[..., :-1], count, logdet)


def _size_of(noise: tuple[Whitener, ...], shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the number of rows that are present, and the logarithm of the determinant of 2 pi R, each (...)."""
    count, logdet = np.zeros(shape), np.zeros(shape)
    for w in noise:
        # A whitener is triangular: the product of its pivots is one over the root of |R|; absent rows have none.
        pivots = np.diagonal(w.matrix, axis1=-2, axis2=-1)
        present = pivots > 0.0
        # A block that is common to many groups of rows is stored once.
        share = len(w.row) if w.matrix.shape[-3] == 1 else 1
        count = count + share * present.sum((-1, -2))
        logdet = logdet - 2.0 * share * np.log(np.where(present, pivots, 1.0)).sum((-1, -2))
    return count, logdet + count * np.log(2.0 * np.pi)


def joseph(H: Array, gain: Array, cov: Array) -> Array:
    """Return (I - K H) P (I - K H)' + K K', (..., n, n), for whitened rows: symmetric and positive for any gain."""
    # The short form (I - K H) P is right for the optimal gain alone, and loses symmetry by rounding.
    left = np.eye(cov.shape[-1]) - gain @ H
    out = left @ cov @ np.swapaxes(left, -1, -2) + gain @ np.swapaxes(gain, -1, -2)
    return np.asarray(0.5 * (out + np.swapaxes(out, -1, -2)))


def _gain(H: Array, cov: Array) -> Array:
    # Whitened rows: S is regular whatever the prior is, even where a state is known exactly.
    S = H @ cov @ np.swapaxes(H, -1, -2) + np.eye(H.shape[-2])
    solved, _ = linalg.solve(S, H @ cov)
    return np.swapaxes(solved, -1, -2)


def _finish(white: White, cov: Array, mean: Array, after: Array) -> Updated:
    S = white.H @ cov @ np.swapaxes(white.H, -1, -2) + np.eye(white.H.shape[-2])
    # ln|2 pi S| of the rows as measured: that of the whitened ones, and what whitening took out.
    lower, _ = linalg.factor(S)
    solved, _ = linalg.solve(S, white.residual[..., None])
    nis = (white.residual * solved[..., 0]).sum(-1)
    logdet = white.logdet + 2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return Updated(mean, after, nis, -0.5 * (nis + logdet), white.count)


def _shorten(
    scan: Problem, mean: Array, prior: Array, x: Array, step: Array, cost: Array, moving: Array
) -> tuple[Array, White, Array, Array]:
    """Return the states after steps that do not raise the cost, their rows and costs, and the lengths in sigma."""
    share = np.where(moving, 1.0, 0.0)
    for _ in range(_HALVINGS):
        tried = x + share[..., None] * step
        white = whitened(scan, tried)
        away = (prior @ (tried - mean)[..., None])[..., 0]
        now = (white.residual**2).sum(-1) + (away**2).sum(-1)
        # NaN counts as worse: a step beyond where h is defined is halved, too.
        worse = moving & ~(now <= cost + _RISE * (1.0 + np.abs(cost)))
        if not worse.any():
            break
        share = np.where(worse, 0.5 * share, share)
    length = np.sqrt(((prior @ (share[..., None] * step)[..., None])[..., 0] ** 2).sum(-1))
    return tried, white, np.where(moving, now, cost), length
