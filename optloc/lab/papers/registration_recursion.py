"""Algorithm of the paper on TDOA and GROA registration as printed: two undamped steps over all past data at each epoch.

It starts from a given position at the fortieth epoch and does not search for another minimum: a baseline. Equation
numbers are those of the paper. In shapes, k are epochs, s stations, m = s - 1 channels, n unknowns of the target.
"""

from __future__ import annotations

import numpy as np

from optloc.engine import linalg
from optloc.problem import Array

FIRST = 40
"""Epochs that are collected before the first estimate, as printed."""

_BLOCK = 8  # trials whose arrays, 5 stations by 700 epochs by 3 coordinates, fit a cache of 1 MB together


def recursion(track: Array, times: Array, z: Array, start: Array, *, first: int = FIRST, iterations: int = 2) -> Array:
    """Return the estimates of the paper's recursion after every epoch.

    Parameters
    ----------
    track : array (k, s, 3)
        Stations, metres.
    times : array (k,)
        Seconds.
    z : array (trials, k, s - 1)
        Range differences against the first station, metres.
    start : array (trials, n)
        Start of the first estimate: position, or position and velocity at time zero.
    first : int
        Epochs of the first estimate.
    iterations : int
        Steps at each epoch.

    Returns
    -------
    array (trials, k - first + 1, n + s - 1)
        State and biases after `first`, `first + 1` ... epochs; NaN after the steps have diverged.
    """
    trials, epochs = z.shape[:2]
    estimates = np.empty((trials, epochs - first + 1, start.shape[-1] + z.shape[-1]))
    arrivals = np.zeros((trials, z.shape[-1] + 1, epochs))
    arrivals[:, 1:] = z.swapaxes(1, 2)
    track = np.ascontiguousarray(track.T)  # (3, s, k), as `step` needs it
    with np.errstate(all="ignore"):  # steps that diverge overflow, and stay lost
        for first_trial in range(0, trials, _BLOCK):
            block = slice(first_trial, first_trial + _BLOCK)
            state = start[block]
            for k in range(first, epochs + 1):
                for _ in range(iterations):
                    move, bias = step(state, arrivals[block, :, :k], track[..., :k], times[:k])
                    state = state + move
                estimates[block, k - first] = np.concatenate([state, bias], axis=-1)
    return estimates


def step(state: Array, arrivals: Array, track: Array, times: Array) -> tuple[Array, Array]:
    """Return one Gauss-Newton step (trials, n) of the state, and the biases (trials, s - 1) after the step.

    The step uses the sums of eq. 11 and 12 over the epochs. The covariance R of an epoch is proportional to I + 11', so
    its inverse removes the mean of each epoch from the arrivals. Elimination of the unknown biases removes the mean of
    each channel over the run. The sums are computed from the remainders. The step is NaN if the equations are singular.

    Parameters
    ----------
    state : array (trials, n)
        Position (n = 3), or position and velocity at time zero (n = 6), SI units.
    arrivals : array (trials, s, k)
        Range differences against the first station, metres; the first station has zero.
    track : array (3, s, k)
        Stations, metres.
    times : array (k,)
        Seconds.
    """
    trials, n = state.shape
    target = state[:, :3, None, None]
    if n > 3:
        target = target + state[:, 3:, None, None] * times
    slope = target - track
    distance = np.sqrt(np.einsum("tcsk,tcsk->tsk", slope, slope))
    slope /= distance[:, None]  # unit vectors (trials, 3, s, k)
    misfit = arrivals - distance  # (trials, s, k)
    # First the mean of each epoch over the stations, then the mean of each channel over the epochs, in the sums below.
    misfit -= misfit.mean(1, keepdims=True)
    slope -= slope.mean(2, keepdims=True)
    if n > 3:
        slope = np.concatenate([slope, slope * times], axis=1)
    # To subtract k times the product of the means is the same as to remove the mean of each channel first.
    rows, mean, offset = slope.reshape(trials, n, -1), slope.mean(3), misfit.mean(2)
    information = rows @ rows.swapaxes(1, 2) - len(times) * (mean @ mean.swapaxes(1, 2))
    vector = rows @ misfit.reshape(trials, -1, 1) - len(times) * (mean @ offset[..., None])
    solved, ok = linalg.solve(information, vector)
    # A singular system has no step: return NaN, which counts as lost, instead of an arbitrary solution.
    move = np.where(ok[:, None], solved[..., 0], np.nan)
    # The mean misfit of each station after the step is its bias; biases are relative to the first station.
    offset = offset - (move[:, None] @ mean)[:, 0]
    return move, offset[:, 1:] - offset[:, :1]


# The recursion with gain ratios and range differences (section 3.2), whose weights depend on the position.


def joint_recursion(
    track: Array,
    z: Array,
    gains: Array,
    start: Array,
    sigma: tuple[float, float, float],
    *,
    first: int = FIRST,
    iterations: int = 2,
) -> Array:
    """Return the estimates of the paper's joint recursion for a fixed target after every epoch.

    The weight of an epoch is computed at the estimate when the epoch arrives, and then stays. Its residuals and
    derivatives are computed at the present estimate.

    Parameters
    ----------
    track : array (k, s, 3)
        Stations, metres.
    z, gains : array (trials, k, s - 1)
        Range differences against the first station, metres, and gain ratios.
    start : array (trials, 3)
        Position at which the first estimate starts, metres.
    sigma : (float, float, float)
        Standard deviations of an arrival (metres), of a gain, and of a coordinate of a station (metres).
    first : int
        Epochs of the first estimate.
    iterations : int
        Steps at each epoch.

    Returns
    -------
    array (trials, k - first + 1, 3 + 2 (s - 1))
        Position and biases of both kinds after `first`, `first + 1` ... epochs; NaN after the steps have diverged.
    """
    trials, epochs = z.shape[:2]
    measured = np.concatenate([z, gains], axis=-1)
    estimates = np.empty((trials, epochs - first + 1, start.shape[-1] + measured.shape[-1]))
    with np.errstate(all="ignore"):  # steps that diverge overflow, and stay lost
        for first_trial in range(0, trials, _BLOCK):
            block = slice(first_trial, first_trial + _BLOCK)
            state, weights = start[block], joint_weights(start[block], track[:first], sigma)
            weight = np.empty((len(state), epochs, *weights.shape[-2:]))
            # `total` is the sum of the weights of all epochs so far.
            weight[:, :first], total = weights, weights.sum(1)
            for k in range(first, epochs + 1):
                if k > first:
                    weight[:, k - 1] = joint_weights(state, track[k - 1 : k], sigma)[:, 0]
                    total += weight[:, k - 1]
                for _ in range(iterations):
                    move, bias = joint_step(state, measured[block, :k], track[:k], weight[:, :k], total)
                    state = state + move
                estimates[block, k - first] = np.concatenate([state, bias], axis=-1)
    return estimates


def joint_weights(state: Array, track: Array, sigma: tuple[float, float, float]) -> Array:
    """Return the inverse covariances (trials, k, 2 m, 2 m) of m differences and m ratios.

    `state` (trials, 3) are the positions of the target. `sigma` are the standard deviations of `joint_recursion`; the
    third is `size`. The covariance is R of eq. 40: noise of one kind is sigma^2 (I + 11'). The errors of the stations
    couple both kinds by G_i . G_j' = size^2 (1 + delta) of the lines of sight. The code writes these products with r_1,
    the range of the first station, and the ratios of the ranges.
    """
    arrival, gain, size = sigma
    distance = np.linalg.norm(state[:, None, None] - track, axis=-1)
    first, ratio = distance[..., :1, None], distance[..., 1:, None] / distance[..., :1, None]
    count = ratio.shape[-2]
    shape, ones = np.eye(count) + 1.0, np.ones_like(ratio)
    coupling = size**2 * (ones @ ratio.swapaxes(-1, -2) + np.eye(count)) / first
    ratio_part = size**2 * (ratio @ ratio.swapaxes(-1, -2) + np.eye(count)) / first**2
    upper = np.concatenate([np.broadcast_to((arrival**2 + size**2) * shape, ratio_part.shape), coupling], axis=-1)
    lower = np.concatenate([coupling.swapaxes(-1, -2), ratio_part + gain**2 * shape], axis=-1)
    return linalg.inverse(np.concatenate([upper, lower], axis=-2))[0]


def joint_step(state: Array, measured: Array, track: Array, weight: Array, total: Array) -> tuple[Array, Array]:
    """Return one Gauss-Newton step (trials, 3) of the position, and the biases (trials, 2 m) after the step.

    The step uses the sums of eq. 11 and 12 with the matrices of eq. 39; the constant biases are eliminated. The step is
    NaN if the equations are singular.

    Parameters
    ----------
    state : array (trials, 3)
        Positions, metres.
    measured : array (trials, k, 2 m)
        Range differences in metres, then gain ratios.
    track : array (k, s, 3)
        Stations, metres.
    weight : array (trials, k, 2 m, 2 m)
        Inverse covariances of the measurements of each epoch.
    total : array (trials, 2 m, 2 m)
        Sum of `weight` over the epochs.
    """
    line = state[:, None, None] - track
    distance = np.linalg.norm(line, axis=-1, keepdims=True)
    sight = line / distance
    ratio = distance[..., 1:, :] / distance[..., :1, :]
    # Derivatives (trials, k, 2 m, 3) of the range differences and of the gain ratios by the position.
    slope = np.concatenate(
        [sight[..., 1:, :] - sight[..., :1, :], (sight[..., 1:, :] - ratio * sight[..., :1, :]) / distance[..., :1, :]],
        axis=-2,
    )
    value = np.concatenate([distance[..., 1:, 0] - distance[..., :1, 0], ratio[..., 0]], axis=-1)
    slope_and_misfit = np.concatenate([slope, (measured - value)[..., None]], axis=-1)  # (trials, k, 2 m, 4)
    weighted = weight @ slope_and_misfit
    trials, columns = len(state), slope_and_misfit.shape[-1]
    sums = slope_and_misfit.reshape(trials, -1, columns).swapaxes(1, 2) @ weighted.reshape(trials, -1, columns)
    shared = weighted.sum(1)
    # Eliminate the biases (Schur complement). The first three columns of `bias_of` are the change of the biases by the
    # position; the last column is the biases without a step.
    bias_of, total_ok = linalg.solve(total, shared)
    reduced = sums - shared.swapaxes(1, 2) @ bias_of
    solution, ok = linalg.solve(reduced[:, :-1, :-1], reduced[:, :-1, -1:])
    # A singular system has no step: return NaN, which counts as lost, instead of an arbitrary solution.
    move = np.where((ok & total_ok)[:, None], solution[..., 0], np.nan)
    return move, bias_of[..., -1] - (bias_of[..., :-1] @ move[..., None])[..., 0]
