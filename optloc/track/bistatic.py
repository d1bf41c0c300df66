"""One receiver and one illuminator: the simplified recursion in range, azimuth and elevation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc import noise as noises
from optloc.epochs import by_epoch
from optloc.errors import InvalidProblem
from optloc.linear import linearise
from optloc.problem import Problem
from optloc.solve.bistatic import pair
from optloc.status import Status
from optloc.track.measurement_space import lines
from optloc.track.track import Track, check_trackable
from optloc.types import Array, Motion
from optloc.windows import cut

KINDS = ("range_sum", "azimuth", "elevation")
"""What a scan holds."""


def simplified(problem: Problem, *, restart: int | None = None, mean: int = 1, floor: float = 0.0) -> Track:
    """Return the track of a target by the simplified recursion: running means of the angles, a scalar gain in range.

    Angles are averaged; the range follows, by a scalar least-squares gain, what the excess path says beyond the step of
    the angles. For a target that stays its variance in range tends to twice that of the maximum-likelihood fix; a
    target that moves is followed late, which the covariance does not tell.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs: range sums of one pair of stations that stay, azimuth and elevation at one of them, each
        once an epoch. Epochs without all three leave the state as it was.
    restart : int, optional
        Begin anew every so many epochs; None: never.
    mean : int
        Begin from the mean measurement of so many epochs, the present one and those before it.
    floor : float
        Least gain of angles and range, from 0 (none) to 1 (every fix alone).

    Returns
    -------
    Track
        Positions, one for each epoch. The covariance is that of the recursion for a target that stays, to first order.

    Raises
    ------
    InvalidProblem
        For other rows, or options out of range.

    References
    ----------
    M. I. Skolnik, "An analysis of bistatic radar", IRE Trans. Aerosp. Navig. Electron. ANE-8 (1961) (the ellipse). The
    recursion is that of the paper `bistatic`, its signs and indices corrected.
    """
    check_trackable(problem)
    _check(restart, mean, floor)
    flat = problem.flat()
    home = _receiver(flat)
    apart = by_epoch(replace(flat, motions=(Motion(0, "epoch"),))).flat()
    size, epochs = flat.batch_shape[0], problem.epochs
    state = _State(np.full((size, 3), np.nan), np.full((size, 3, 3), np.nan), np.zeros(size), np.zeros(size))
    steps = []
    for k in range(epochs):
        scan = apart.take(np.arange(k, size * epochs, epochs))
        heard = np.asarray((np.isfinite(scan.z) & (scan.weight > 0.0)).all(-1))
        again = heard & ((k < mean or (restart is not None and k % restart == 0)) | ~np.isfinite(state.value).all(-1))
        with np.errstate(invalid="ignore"):
            moved = _moved(state, scan, home, floor)
        state = _chosen(heard & ~again, moved, state)
        if again.any():
            begun = _begun(cut(flat, max(0, k + 1 - mean), k + 1), scan, home)
            state = _chosen(again, begun, state)
        at, axes, _, _ = _seen(state.value, scan, home)
        code = np.where(heard, np.where(np.isfinite(at).all(-1), Status.OK, Status.NUMERICAL), Status.TOO_FEW_ROWS)
        steps.append((at, axes @ state.cov @ np.swapaxes(axes, -1, -2), np.where(heard, 3, 0), code))
    return _track(problem, steps)


@dataclass(frozen=True, slots=True)
class _State:
    """Range, azimuth and elevation (N, 3), their covariance, the recursion's own weight P (N,), and epochs used."""

    value: Array
    cov: Array
    P: Array
    count: Array


def _check(restart: int | None, mean: int, floor: float) -> None:
    if restart is not None and restart < 1:
        raise InvalidProblem(f"restart is {restart}", "restart", "give a number of epochs, or None")
    if mean < 1:
        raise InvalidProblem(f"mean is {mean}", "mean", "give a number of epochs")
    if not 0.0 <= floor <= 1.0:
        raise InvalidProblem(f"the gain floor is {floor}", "floor", "give a share between 0 and 1")


def _receiver(problem: Problem) -> int:
    found = pair(problem)
    if found is None:
        advice = "give range_sum of one pair of stations that stay, azimuth and elevation at one of them, once an epoch"
        raise InvalidProblem("the rows are not those of one receiver and one illuminator", "simplified", advice)
    return found[0]


def _chosen(mask: Array, one: _State, other: _State) -> _State:
    return _State(
        np.where(mask[:, None], one.value, other.value),
        np.where(mask[:, None, None], one.cov, other.cov),
        np.where(mask, one.P, other.P),
        np.where(mask, one.count, other.count),
    )


def _rows(scan: Problem) -> list[int]:
    kinds = [block.kind for block in scan.rows]
    return [kinds.index(kind) for kind in KINDS]


def _seen(value: Array, scan: Problem, home: int) -> tuple[Array, Array, Array, Array]:
    """Return, at (range, azimuth, elevation), the place (N, 3), its partials (N, 3, 3), residuals and path partials."""
    r, azimuth, elevation = value.T
    ahead = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    u = np.stack(ahead, axis=-1)
    if scan.stations.axes is not None:
        u = (u[:, None] @ scan.stations.axes[..., 0, home, :, :])[:, 0]
    at = scan.stations.position[..., 0, home, :] + r[:, None] * u
    linear, order = linearise(scan, at), _rows(scan)
    H = linear.shared[:, order]
    # Range, azimuth and elevation grow along three orthogonal directions: the inverse needs no elimination.
    outward = np.concatenate([u[:, None], H[:, 1:]], axis=1)
    axes = np.swapaxes(outward / (outward**2).sum(-1, keepdims=True), -1, -2)
    return at, axes, linear.residual[:, order], (H[:, :1] @ axes)[:, 0]


def _moved(state: _State, scan: Problem, home: int, floor: float) -> _State:
    """Return the state after one more scan: a step of the angles, and one of the range by what the path says beyond."""
    _, _, residual, slopes = _seen(state.value, scan, home)
    x, across = slopes[:, 0], slopes[:, 1:]
    share = np.maximum(1.0 / (state.count + 1.0), floor)
    turned = share[:, None] * residual[:, 1:]
    y = residual[:, 0] - (across * turned).sum(-1)
    optimal = state.P * x / (1.0 + x * state.P * x)
    gain = np.maximum(optimal, floor / np.where(x > 0.0, x, np.inf))
    value = state.value + np.concatenate([(gain * y)[:, None], turned], axis=-1)
    A = np.eye(3) * (1.0 - share)[:, None, None]
    B = np.eye(3) * share[:, None, None]
    A[:, 0, 0], B[:, 0, 0] = 1.0 - gain * x, gain
    A[:, 0, 1:] = -gain[:, None] * across * (1.0 - share)[:, None]
    B[:, 0, 1:] = -gain[:, None] * across * share[:, None]
    R = noises.dense(scan.noise, np.array(_rows(scan)))
    cov = A @ state.cov @ np.swapaxes(A, -1, -2) + B @ R @ np.swapaxes(B, -1, -2)
    return _State(value, cov, state.P - optimal * x * state.P, state.count + 1.0)


def _begun(stretch: Problem, scan: Problem, home: int) -> _State:
    """Return the state of the mean measurement of a stretch, solved in closed form and refined."""
    track = lines(stretch, 0)
    start, used = track.last, (track.count > 0).sum(-1)
    at = scan.stations.position[..., 0, home, :]
    away = np.where(np.isfinite(start.mean), start.mean - at, 1.0)
    r = np.sqrt((away**2).sum(-1))
    linear = linearise(scan, at + away)
    order = _rows(scan)[1:]
    value = np.concatenate([r[:, None], (scan.observed - linear.residual)[:, order]], axis=-1)
    outward = np.concatenate([(away / r[:, None])[:, None], linear.shared[:, order]], axis=1)
    cov = outward @ start.cov @ np.swapaxes(outward, -1, -2)
    good = np.asarray(np.isfinite(start.mean).all(-1))
    return _State(np.where(good[:, None], value, np.nan), cov, 1.0 / np.maximum(used, 1), used.astype(float))


def _track(problem: Problem, steps: list[tuple[Array, Array, Array, Array]]) -> Track:
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
    )
