"""Smoothing where measurements are exact: a polynomial through the rows of a run, turned into places at the end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc import linalg
from optloc import noise as noises
from optloc.epochs import by_epoch
from optloc.errors import InvalidProblem
from optloc.linear import linearise
from optloc.models import MODELS
from optloc.noise import Block, Noise
from optloc.problem import Problem
from optloc.solve import solve
from optloc.solve.bistatic import course_starts
from optloc.status import Status
from optloc.track.track import Track, check_trackable
from optloc.types import Array, Motion


def lines(problem: Problem, order: int = 1, window: int | None = None) -> Track:
    """Return the track of a slow target seen by stations that stay, from polynomials fitted to its measurements.

    At each epoch a polynomial in time goes through every row of the epochs so far, and its present values are solved
    like the scan of one epoch, without a guess. Nothing is linearised before the noise is averaged; but the
    measurements of a target must not bend more than the polynomial does. Order 0 is the maximum-likelihood fix of a
    target that stays, wherever one epoch has as many rows as the place has coordinates.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs of one target. Every row type must occur once an epoch; absent rows have weight zero.
    order : int
        Order of the polynomial: 0, 1 or 2.
    window : int, optional
        Number of past epochs that count; None: all.

    Returns
    -------
    Track
        From the first epoch at which `order` + 1 epochs of every row are there: position, and with an order above 0
        velocity. The covariance is that of the polynomial's values and rates, to first order. Status: that of the fix
        of each epoch; "too few rows" where the window does not determine the polynomial.

    Raises
    ------
    InvalidProblem
        For stations that move, priors or constraints, and runs that are not one target's.

    References
    ----------
    S. M. Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory" (1993), section 4.4 (line fit).
    """
    check_trackable(problem)
    _check(problem, order, window)
    apart = by_epoch(replace(problem, motions=(Motion(0, "epoch"),)))
    z, weight = _unwrapped(apart), _weights(apart)
    values, covs, known = [], [], []
    for k in range(order, problem.epochs):
        past = slice(0 if window is None else max(0, k + 1 - window), k + 1)
        estimator, ok = _estimator(problem.times[past] - problem.times[k], weight[..., past, :], order)
        values.append(np.einsum("...qkm,...km->...qm", estimator, z[..., past, :]))
        covs.append(_propagated(estimator, apart, past))
        known.append(ok)
    fitted, cov, ok = np.stack(values, -3), np.stack(covs, -5), np.stack(known, -1)
    return _track(problem, apart, fitted, cov, ok)


def _check(problem: Problem, order: int, window: int | None) -> None:
    if order not in (0, 1, 2):
        raise InvalidProblem(f"a polynomial of order {order}", "order", "use 0, 1 or 2")
    if problem.stations.position.shape[-3] > 1:
        raise InvalidProblem(
            "the stations move", "lines", "their measurements bend even of a still target: use a filter"
        )
    if problem.constraints or problem.priors:
        raise InvalidProblem("there are constraints or priors", "lines", "leave them out, or use a filter")
    if problem.stations.covariance is not None:
        raise InvalidProblem("station positions have errors", "lines", "use a filter")
    if problem.epochs <= order or (window is not None and window <= order):
        raise InvalidProblem(
            f"too few epochs for a polynomial of order {order}", "lines", "give more, or a wider window"
        )


def _unwrapped(apart: Problem) -> Array:
    """Return the measured values (..., k, m) less their corrections, angles without jumps, absent ones repeated."""
    weight = _weights(apart)
    columns = []
    period = [MODELS[rows.kind].period for rows in apart.rows for _ in range(rows.count)]
    for i, full in enumerate(period):
        there = np.broadcast_to(weight[..., i] > 0.0, apart.observed.shape[:-1])
        last = np.maximum.accumulate(np.where(there, np.arange(there.shape[-1]), -1), axis=-1)
        first = there.argmax(-1)[..., None]
        value = np.take_along_axis(apart.observed[..., i], np.where(last < 0, first, last), axis=-1)
        columns.append(value if full is None else np.unwrap(value, axis=-1, period=full))
    return np.where(np.isfinite(columns), columns, 0.0).transpose(*range(1, apart.observed.ndim), 0)


def _weights(apart: Problem) -> Array:
    """Return weights (..., k, m) over variances; zero for rows that are absent or not finite."""
    variance = noises.variances(apart.noise, apart.count)
    weight = np.asarray(np.where(np.isfinite(apart.z), apart.weight, 0.0) / variance)
    one = weight[(0,) * (weight.ndim - 2)]
    return one if np.array_equal(np.broadcast_to(one, weight.shape), weight) else weight


def _estimator(since: Array, weight: Array, order: int) -> tuple[Array, Array]:
    """Return what maps values (..., k, m) to value and rate now, (..., 1 or 2, k, m), and where it exists (...)."""
    span = float(np.abs(since).max(initial=0.0)) or 1.0
    powers = (since / span)[:, None] ** np.arange(order + 1)
    information = np.einsum("kqr,...km->...mqr", powers[:, :, None] * powers[:, None, :], weight)
    inverse, ok = linalg.inverse(information, 1e-12)
    kept = min(order, 1) + 1
    both = (inverse[..., :kept, :] @ powers.T).swapaxes(-1, -3).swapaxes(-1, -2)  # (..., k, m, q)
    scale = np.array([1.0, 1.0 / span])[:kept]
    good = np.asarray(ok.all(-1))
    estimator = np.moveaxis(both * weight[..., None] * scale, -1, -3)
    return np.where(good[..., None, None, None], estimator, 0.0), good


def _propagated(estimator: Array, apart: Problem, past: slice) -> Array:
    """Return the covariance (..., q, m, q, m) of values and rates."""
    R = noises.dense(apart.noise, np.arange(apart.count))
    k = estimator.shape[-2]
    R = R[..., past, :, :] if R.ndim > 2 and R.shape[-3] > 1 else np.broadcast_to(R, (k, *R.shape[-2:]))
    spread = np.einsum("...qki,...kij->...qijk", estimator, R)
    return np.asarray(np.einsum("...qijk,...rkj->...qirj", spread, estimator))


def _track(problem: Problem, apart: Problem, fitted: Array, cov: Array, ok: Array) -> Track:
    """Return places and velocities of fitted values (..., k, q, m) with covariance (..., k, q, m, q, m)."""
    d, m, batch = problem.dimension, apart.count, fitted.shape[:-2]
    n = fitted.shape[-2] * d
    alone = np.where(ok[..., None, None], cov[..., 0, :, 0, :], np.eye(m))
    rows = tuple(replace(block, correction=np.zeros(block.count)) for block in apart.rows)
    scan = replace(apart, rows=rows, noise=Noise((Block(np.arange(m)[None], alone[..., None, :, :]),)))
    scan = scan.with_rows(z=fitted[..., 0, :], weight=np.ones(m))
    position, code = _solved(scan)
    linear = linearise(scan, position)
    W = np.concatenate([w.apply(np.broadcast_to(np.eye(m), (*batch, m, m))) for w in linear.noise], axis=-2)
    white = W @ linear.shared
    back, _ = linalg.solve(np.swapaxes(white, -1, -2) @ white, np.swapaxes(white, -1, -2) @ W)
    rates = (back[..., None, :, :] @ fitted[..., 1:, :, None])[..., 0]
    mean = np.concatenate([position, rates.reshape(*batch, n - d)], axis=-1)
    spread = np.einsum("...ai,...qirj,...bj->...qarb", back, cov, back, optimize=True).reshape(*batch, n, n)
    good = np.broadcast_to(ok, batch)
    heard = (_weights(apart) > 0.0).sum(-1)[..., problem.epochs - batch[-1] :]
    none = np.zeros(batch)
    return Track(
        problem.times[problem.epochs - batch[-1] :],
        np.where(good[..., None], mean, np.nan),
        np.where(good[..., None, None], spread, np.nan),
        none + np.nan,
        np.broadcast_to(heard, batch),
        none,
        np.where(good, code, int(Status.TOO_FEW_ROWS)).astype(np.int8),
        d,
    )


def _solved(scan: Problem) -> tuple[Array, Array]:
    """Return position (..., k, d) and status (..., k); solved at the last epoch, which starts the others."""
    shape, flat = scan.batch_shape, scan.flat()
    size, count = int(np.prod(shape)), shape[-1]
    course, doubt = course_starts(flat), np.zeros(size, dtype=bool)
    if course is not None:  # one bistatic pair: in closed form, and there is no other place
        start = course[:, 0]
    else:
        last = solve(flat.take(np.arange(count - 1, size, count)))
        start, doubt = np.repeat(last.position, count, axis=0), np.repeat(last.code == Status.AMBIGUOUS, count)
    fix = solve(flat, "lsr", start=np.where(np.isfinite(start), start, 0.0))
    position, code = np.array(fix.position), np.array(fix.code)
    # Another place that explains the last epoch may explain the others.
    code = np.where((code == Status.OK) & doubt, Status.AMBIGUOUS, code)
    again = np.flatnonzero((code != Status.OK) & (code != Status.AMBIGUOUS))
    if len(again):
        redone = solve(flat.take(again))
        position[again], code[again] = redone.position, redone.code
    return position.reshape(*shape, -1), code.reshape(shape)
