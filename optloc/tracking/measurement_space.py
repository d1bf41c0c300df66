"""Smoothing in measurement space: polynomials through the rows of a run, and a fix of their values.

Letters: k epochs, m rows of an epoch, d coordinates, N runs of a batch (...). A fitted polynomial has q =
1 or 2 numbers for each row: its present value and, for an order above 0, its rate per second.

Arguments of many functions: `problem` is the run, and `apart` is this run with a separate problem for
each epoch. `window` is the number of past epochs in a fit, or None for all. `scan` is one epoch of N
runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Motion, Status
from optloc.linear.normal import linearise
from optloc.models import MODELS
from optloc.problem import noise as noises
from optloc.problem.epochs import by_epoch, cut
from optloc.problem.noise import Block, Noise
from optloc.problem.problem import Problem
from optloc.solvers.solution import solve
from optloc.solvers.starts.angles import course_starts, pair
from optloc.tracking.track import Track, check_trackable, status_of_scans

# Kinds of a scan of the simplified recursion, in the order of its state: range, azimuth, elevation.
_KINDS = ("range_sum", "azimuth", "elevation")
# Smallest relative pivot of a normal matrix of powers: below it the window does not determine the polynomial.
_SINGULAR = 1e-12


# Polynomials through all rows.


def lines(problem: Problem, order: int = 1, window: int | None = None) -> Track:
    """Return the track of a slow target from static stations, by polynomials that are fitted to its measurements.

    At each epoch, a polynomial in time is fitted to every row of the epochs so far. Its present values are solved like
    the scan of one epoch, without a guess. The noise is averaged before any linearisation. But the measurements must be
    close to the polynomial. Order 0 is the maximum-likelihood fix of a static target if one epoch has
    at least one row per coordinate of the position.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs of one target. Every row type must occur once per epoch; absent rows have weight zero.
    order : int
        Order of the polynomial: 0, 1 or 2.
    window : int, optional
        Number of past epochs in the fit; None for all epochs.

    Returns
    -------
    Track
        From the first epoch with `order` + 1 epochs of every row: position, and velocity for an order above 0. The
        covariance follows to first order from the values and rates of the polynomial. The status is the status of the
        fix of each epoch, or "too few rows" if the window does not determine the polynomial.

    Raises
    ------
    InvalidProblem
        If stations move, there are priors or constraints, or the run has several targets.

    References
    ----------
    S. M. Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory" (1993), section 4.4 (line fit).
    """
    check_trackable(problem)
    _check_lines(problem, order, window)
    # Make a separate problem of every epoch: its rows are solved as if the target were static.
    apart = by_epoch(replace(problem, motions=(Motion(0, "epoch"),)))
    z, weight = _unwrap(apart), _weights(apart)
    # Compute one estimator for each length of the past: it depends on times and weights alone, not on measurements.
    values, covs, known = [], [], []
    for k in range(order, problem.epochs):
        past = slice(0 if window is None else max(0, k + 1 - window), k + 1)
        estimator, ok = _estimator(problem.times[past] - problem.times[k], weight[..., past, :], order)
        values.append(np.einsum("...qkm,...km->...qm", estimator, z[..., past, :]))
        covs.append(_propagate(estimator, apart, past))
        known.append(ok)
    fitted, cov, ok = np.stack(values, -3), np.stack(covs, -5), np.stack(known, -1)
    return _line_track(problem, apart, fitted, cov, ok)


def _check_lines(problem: Problem, order: int, window: int | None) -> None:
    """Raise InvalidProblem if polynomials of measurements do not apply to the run."""
    if order not in (0, 1, 2):
        raise InvalidProblem(f"the order of the polynomial is {order}", "order", "use 0, 1 or 2")
    if problem.stations.position.shape[-3] > 1:
        raise InvalidProblem(
            "the stations move", "lines", "their measurements are no polynomials in time: use a filter"
        )
    if problem.constraints or problem.fences or problem.priors:
        raise InvalidProblem("there are constraints, fences or priors", "lines", "remove them, or use a filter")
    if problem.stations.errors:
        raise InvalidProblem("station positions or velocities have errors", "lines", "use a filter")
    if problem.epochs <= order or (window is not None and window <= order):
        raise InvalidProblem(
            f"too few epochs for a polynomial of order {order}", "lines", "give more epochs, or a longer window"
        )


def _unwrap(apart: Problem) -> Array:
    """Return the measurements (..., k, m) minus corrections, with unwrapped angles; absent values are filled in.

    `apart` is the run with a separate problem for each epoch.
    """
    weight = _weights(apart)
    columns = []
    period = [MODELS[rows.kind].period for rows in apart.rows for _ in range(rows.count)]
    for i, full in enumerate(period):
        # An absent row repeats the last present row, so that the angle makes no turn there; its weight is zero.
        there = np.broadcast_to(weight[..., i] > 0.0, apart.observed.shape[:-1])
        last = np.maximum.accumulate(np.where(there, np.arange(there.shape[-1]), -1), axis=-1)
        first = there.argmax(-1)[..., None]
        value = np.take_along_axis(apart.observed[..., i], np.where(last < 0, first, last), axis=-1)
        columns.append(value if full is None else np.unwrap(value, axis=-1, period=full))
    return np.where(np.isfinite(columns), columns, 0.0).transpose(*range(1, apart.observed.ndim), 0)


def _weights(apart: Problem) -> Array:
    """Return weights divided by variances (..., k, m); zero for rows that are absent or not finite.

    If all runs of a batch have the same weights, the result has no batch axes.
    """
    variance = noises.variances(apart.noise, apart.count)
    weight = np.asarray(np.where(np.isfinite(apart.z), apart.weight, 0.0) / variance)
    # Store weights that all runs of a batch share once, so that the estimator is computed once.
    one = weight[(0,) * (weight.ndim - 2)]
    return one if np.array_equal(np.broadcast_to(one, weight.shape), weight) else weight


def _estimator(since: Array, weight: Array, order: int) -> tuple[Array, Array]:
    """Return the linear estimator (..., q, k, m) of present value and rate, and a mask (...) of its existence.

    `since` (k,) are times before the present, s (at most 0), and `weight` (..., k, m) are inverse variances.
    The estimator times the measurements (..., k, m), summed over k, gives the values (..., q, m). It is 0 if
    a polynomial is not determined.
    """
    # Times as shares of the window: powers of seconds would make the normal matrix ill-conditioned.
    span = float(np.abs(since).max(initial=0.0)) or 1.0
    powers = (since / span)[:, None] ** np.arange(order + 1)
    information = np.einsum("kqr,...km->...mqr", powers[:, :, None] * powers[:, None, :], weight)
    inverse, ok = linalg.inverse(information, _SINGULAR)
    # Keep value and rate now; a curvature is fitted, but positions do not need it.
    kept = min(order, 1) + 1
    both = (inverse[..., :kept, :] @ powers.T).swapaxes(-1, -3).swapaxes(-1, -2)  # (..., k, m, q)
    scale = np.array([1.0, 1.0 / span])[:kept]
    good = np.asarray(ok.all(-1))
    estimator = np.moveaxis(both * weight[..., None] * scale, -1, -3)
    return np.where(good[..., None, None, None], estimator, 0.0), good


def _propagate(estimator: Array, apart: Problem, past: slice) -> Array:
    """Return the covariance (..., q, m, q, m) of the fitted values and rates.

    `estimator` (..., q, k, m) is the result of `_estimator` for the epochs `past`, whose noise comes from
    `apart`.
    """
    R = noises.dense(apart.noise, np.arange(apart.count))
    k = estimator.shape[-2]
    R = R[..., past, :, :] if R.ndim > 2 and R.shape[-3] > 1 else np.broadcast_to(R, (k, *R.shape[-2:]))
    spread = np.einsum("...qki,...kij->...qijk", estimator, R)
    return np.asarray(np.einsum("...qijk,...rkj->...qirj", spread, estimator))


def _line_track(problem: Problem, apart: Problem, fitted: Array, cov: Array, ok: Array) -> Track:
    """Return the track of fitted values (..., k, q, m) with covariance `cov` (..., k, q, m, q, m).

    Here k counts only the epochs that can have a polynomial: epochs without enough predecessors are omitted. The q
    derivatives are the value and its rates. The state is the position and, with a rate, the velocity. `ok` (..., k)
    marks epochs with a polynomial. `apart` is the run of stations that stay, with a separate problem for each epoch.
    """
    d, m, batch = problem.dimension, apart.count, fitted.shape[:-2]
    n = fitted.shape[-2] * d
    # The fitted values form a scan, and their covariance is its noise; the unit matrix if there is no fit.
    alone = np.where(ok[..., None, None], cov[..., 0, :, 0, :], np.eye(m))
    rows = tuple(replace(block, correction=np.zeros(block.count)) for block in apart.rows)
    scan = replace(apart, rows=rows, noise=Noise((Block(np.arange(m)[None], alone[..., None, :, :]),)))
    scan = scan.with_rows(z=fitted[..., 0, :], weight=np.ones(m))
    position, code = _solve_scans(scan)
    linear = linearise(scan, position)
    # The derivative of the least-squares position by the values maps rates to a velocity, and covariances to
    # covariances of states.
    W = np.concatenate([w.apply(np.broadcast_to(np.eye(m), (*batch, m, m))) for w in linear.noise], axis=-2)
    white = W @ linear.shared
    back, _ = linalg.solve(np.swapaxes(white, -1, -2) @ white, np.swapaxes(white, -1, -2) @ W)
    rates = (back[..., None, :, :] @ fitted[..., 1:, :, None])[..., 0]
    mean = np.concatenate([position, rates.reshape(*batch, n - d)], axis=-1)
    spread = np.einsum("...ai,...qirj,...bj->...qarb", back, cov, back, optimize=True).reshape(*batch, n, n)
    good = np.broadcast_to(ok, batch)
    observed = (_weights(apart) > 0.0).sum(-1)[..., problem.epochs - batch[-1] :]
    none = np.zeros(batch)
    return Track(
        problem.times[problem.epochs - batch[-1] :],
        np.where(good[..., None], mean, np.nan),
        np.where(good[..., None, None], spread, np.nan),
        none + np.nan,
        np.broadcast_to(observed, batch),
        none,
        np.where(good, code, int(Status.TOO_FEW_ROWS)).astype(np.int8),
        d,
        problem.dated,
    )


def _solve_scans(scan: Problem) -> tuple[Array, Array]:
    """Return positions (..., k, d), metres, and statuses (..., k) of k scans.

    The fix of the last epoch is the start of the other fixes. `scan` is a batch (..., k) of single scans.
    """
    shape, flat = scan.batch_shape, scan.flat()
    size, count = int(np.prod(shape)), shape[-1]
    course, doubt = course_starts(flat), np.zeros(size, dtype=bool)
    if course is not None:  # one bistatic pair: a closed form without another solution
        start = course[:, 0]
    else:
        # The last epoch has the longest past, so the best values; its position starts the iterations of the others.
        last = solve(flat.take(np.arange(count - 1, size, count)))
        start, doubt = np.repeat(last.position, count, axis=0), np.repeat(last.has(Status.AMBIGUOUS), count)
    fix = solve(flat, "lsr", start=np.where(np.isfinite(start), start, 0.0))
    position, code = np.array(fix.position), status_of_scans(fix)
    # If another position explains the last epoch, it may explain the others.
    code = np.where((code == Status.OK) & doubt, Status.AMBIGUOUS, code)
    # Early epochs may be too far from this start: solve them again without a start.
    again = np.flatnonzero((code != Status.OK) & (code != Status.AMBIGUOUS))
    if len(again):
        redone = solve(flat.take(again))
        position[again], code[again] = redone.position, status_of_scans(redone)
    return position.reshape(*shape, -1), code.reshape(shape)


# One receiver and one illuminator: the simplified recursion in range, azimuth and elevation.


def simplified(problem: Problem, *, restart: int | None = None, mean: int = 1, floor: float = 0.0) -> Track:
    """Return the track of a target by the simplified recursion: running means of the angles and a scalar gain in range.

    Angles are averaged. The range is updated with a scalar least-squares gain, by the part of the excess path that
    the step of the angles does not explain. For a static target, its variance in range approaches twice the
    variance of the maximum-likelihood fix. For a moving target, the track lags, and the covariance does not include
    this error.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs: range sums of one pair of static stations, azimuth and elevation at one of them, each
        once per epoch. An epoch without all three does not change the state.
    restart : int, optional
        Number of epochs after which the recursion starts again; None for never.
    mean : int
        Number of epochs, including the present one, whose mean measurement gives the start.
    floor : float
        Smallest gain of angles and range, from 0 (no floor) to 1 (independent fixes).

    Returns
    -------
    Track
        Positions, one for each epoch. The covariance is the first-order covariance of the recursion for a static
        target.

    Raises
    ------
    InvalidProblem
        For other rows, or options out of range.

    References
    ----------
    M. I. Skolnik, "An analysis of bistatic radar", IRE Trans. Aerosp. Navig. Electron. ANE-8 (1961) (the ellipse).
    The recursion is taken from the paper of the page "One receiver and one illuminator", with corrected signs and
    indices.
    """
    check_trackable(problem)
    _check_smoothing(restart, mean, floor)
    flat = problem.flat()
    home = _receiver(flat)
    apart = by_epoch(replace(flat, motions=(Motion(0, "epoch"),))).flat()
    size, epochs = flat.batch_shape[0], problem.epochs
    state = _SpaceState(np.full((size, 3), np.nan), np.full((size, 3, 3), np.nan), np.zeros(size), np.zeros(size))
    steps = []
    for k in range(epochs):
        scan = apart.take(np.arange(k, size * epochs, epochs))
        observed = np.asarray((np.isfinite(scan.z) & (scan.weight > 0.0)).all(-1))
        # Start again while the first mean is not full, at every restart, and for every lost state.
        again = observed & (
            (k < mean or (restart is not None and k % restart == 0)) | ~np.isfinite(state.value).all(-1)
        )
        with np.errstate(invalid="ignore"):
            moved = _advance(state, scan, home, floor)
        state = _choose(observed & ~again, moved, state)
        if again.any():
            begun = _restart(cut(flat, max(0, k + 1 - mean), k + 1), scan, home)
            state = _choose(again, begun, state)
        at, axes, _, _ = _linearise_at(state.value, scan, home)
        code = np.where(observed, np.where(np.isfinite(at).all(-1), Status.OK, Status.NUMERICAL), Status.TOO_FEW_ROWS)
        steps.append((at, axes @ state.cov @ np.swapaxes(axes, -1, -2), np.where(observed, 3, 0), code))
    return _bistatic_track(problem, steps)


@dataclass(frozen=True, slots=True)
class _SpaceState:
    """State of the simplified recursion for N runs. Range and angles are relative to the receiver.

    - value (N, 3), cov (N, 3, 3): range (m), azimuth and elevation (rad), and their covariance.
    - P (N,): variance of the range in variances of one range sum. The gain is P x / (1 + x P x), with the path
      slope x (derivative of the range sum by the range).
    - count (N,): number of used epochs.
    """

    value: Array
    cov: Array
    P: Array
    count: Array


def _check_smoothing(restart: int | None, mean: int, floor: float) -> None:
    """Raise InvalidProblem for options of `simplified` out of range."""
    if restart is not None and restart < 1:
        raise InvalidProblem(f"restart is {restart}", "restart", "give a number of epochs, or None")
    if mean < 1:
        raise InvalidProblem(f"mean is {mean}", "mean", "give a number of epochs")
    if not 0.0 <= floor <= 1.0:
        raise InvalidProblem(f"the gain floor is {floor}", "floor", "give a share between 0 and 1")


def _receiver(problem: Problem) -> int:
    """Return the station number of the receiver of a bistatic pair; raise InvalidProblem for other rows."""
    found = pair(problem)
    if found is None:
        advice = "give range_sum of one pair of static stations, azimuth and elevation at one of them, once per epoch"
        raise InvalidProblem("the rows do not belong to one receiver and one illuminator", "simplified", advice)
    return found[0]


def _choose(mask: Array, one: _SpaceState, other: _SpaceState) -> _SpaceState:
    """Return the state `one` for problems in a mask (N,), and `other` for the rest."""
    return _SpaceState(
        np.where(mask[:, None], one.value, other.value),
        np.where(mask[:, None, None], one.cov, other.cov),
        np.where(mask, one.P, other.P),
        np.where(mask, one.count, other.count),
    )


def _row_order(scan: Problem) -> list[int]:
    """Return the indices of range sum, azimuth and elevation, in this order, in a scan."""
    kinds = [block.kind for block in scan.rows]
    return [kinds.index(kind) for kind in _KINDS]


def _linearise_at(value: Array, scan: Problem, home: int) -> tuple[Array, Array, Array, Array]:
    """Return position, axes, residuals and path slopes of states in range, azimuth and elevation.

    - Position (N, 3), metres, at `value` (N, 3): range (m), azimuth and elevation (rad) from station `home`.
    - Axes (N, 3, 3): derivatives of the position by range, azimuth and elevation (columns).
    - Residuals (N, 3) of range sum, azimuth and elevation.
    - Path slopes (N, 3): derivatives of the range sum by range, azimuth and elevation.
    """
    r, azimuth, elevation = value.T
    ahead = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    u = np.stack(ahead, axis=-1)
    if scan.stations.axes is not None:
        u = (u[:, None] @ scan.stations.axes[..., 0, home, :, :])[:, 0]
    at = scan.stations.position[..., 0, home, :] + r[:, None] * u
    linear, order = linearise(scan, at), _row_order(scan)
    H = linear.shared[:, order]
    # Range, azimuth and elevation increase along three orthogonal directions: the inverse needs no elimination.
    outward = np.concatenate([u[:, None], H[:, 1:]], axis=1)
    axes = np.swapaxes(outward / (outward**2).sum(-1, keepdims=True), -1, -2)
    return at, axes, linear.residual[:, order], (H[:, :1] @ axes)[:, 0]


def _advance(state: _SpaceState, scan: Problem, home: int, floor: float) -> _SpaceState:
    """Return the state after one more scan: a step of the angles, then a step of the range by the rest of the path.

    `home` is the number of the receiver. `floor` is the smallest share (0 to 1) of a residual that a step removes.
    """
    _, _, residual, slopes = _linearise_at(state.value, scan, home)
    x, across = slopes[:, 0], slopes[:, 1:]
    # Running means of the angles: the n-th value has a share of 1/n, but at least the floor.
    share = np.maximum(1.0 / (state.count + 1.0), floor)
    turned = share[:, None] * residual[:, 1:]
    # The residual of the path that the step of the angles does not explain.
    y = residual[:, 0] - (across * turned).sum(-1)
    optimal = state.P * x / (1.0 + x * state.P * x)
    # A step of `gain * y` removes the share `gain * x` of y, so the floor is divided by x.
    gain = np.maximum(optimal, floor / np.where(x > 0.0, x, np.inf))
    value = state.value + np.concatenate([(gain * y)[:, None], turned], axis=-1)
    # New error = A old error + B noise, to first order; the first row is the range, which depends on the angles.
    A = np.eye(3) * (1.0 - share)[:, None, None]
    B = np.eye(3) * share[:, None, None]
    A[:, 0, 0], B[:, 0, 0] = 1.0 - gain * x, gain
    A[:, 0, 1:] = -gain[:, None] * across * (1.0 - share)[:, None]
    B[:, 0, 1:] = -gain[:, None] * across * share[:, None]
    R = noises.dense(scan.noise, np.array(_row_order(scan)))
    cov = A @ state.cov @ np.swapaxes(A, -1, -2) + B @ R @ np.swapaxes(B, -1, -2)
    return _SpaceState(value, cov, state.P - optimal * x * state.P, state.count + 1.0)


def _restart(stretch: Problem, scan: Problem, home: int) -> _SpaceState:
    """Return the state (N runs) from the mean measurements of a stretch of scans, see `_SpaceState`.

    `lines` of order 0 averages each row (range sum, azimuth, elevation) over the scans, weighted by inverse
    variance. Then it solves the three means for a position. This position and its covariance are converted
    to range, azimuth and elevation from the receiver. `scan` is the last scan of the stretch, and `home` is
    the station number of the receiver. A run without a fix gets the value NaN.
    """
    track = lines(stretch, 0)
    # `used` is the number of scans in the mean, for each run.
    start, used = track.last, (track.count > 0).sum(-1)
    at = scan.stations.position[..., 0, home, :]
    # Without a solution, use any direction: the value is set to NaN below.
    away = np.where(np.isfinite(start.mean), start.mean - at, 1.0)
    r = np.sqrt((away**2).sum(-1))
    linear = linearise(scan, at + away)
    order = _row_order(scan)[1:]
    # Measurement minus residual is the predicted angle, in the same turn as the measurement.
    value = np.concatenate([r[:, None], (scan.observed - linear.residual)[:, order]], axis=-1)
    # Rows: derivatives of range, azimuth and elevation by the position.
    outward = np.concatenate([(away / r[:, None])[:, None], linear.shared[:, order]], axis=1)
    cov = outward @ start.cov @ np.swapaxes(outward, -1, -2)
    good = np.asarray(np.isfinite(start.mean).all(-1))
    # P = 1 / n is the weight of the recursion after n scans with path slope 1.
    return _SpaceState(np.where(good[:, None], value, np.nan), cov, 1.0 / np.maximum(used, 1), used.astype(float))


def _bistatic_track(problem: Problem, steps: list[tuple[Array, Array, Array, Array]]) -> Track:
    """Return position, covariance, count and status of all scans (`steps`, for N runs each) as a track."""
    batch, k = problem.batch_shape, len(steps)
    mean, cov, count, code = (np.stack([step[i] for step in steps], axis=1) for i in range(4))
    none = np.zeros((*batch, k))
    return Track(
        problem.times,
        mean.reshape(*batch, k, 3),
        cov.reshape(*batch, k, 3, 3),
        none + np.nan,
        count.reshape(*batch, k),
        none,
        code.reshape(*batch, k).astype(np.int8),
        3,
        problem.dated,
    )
