"""The algorithm of the paper as printed: two undamped steps over all past data at every new epoch.

It starts from a given place at the fortieth epoch and never looks for another minimum: a baseline.
"""

from __future__ import annotations

import numpy as np

from optloc import linalg
from optloc.papers.registration.scenario import Scenario
from optloc.types import Array

FIRST = 40
"""Epochs that are collected before the first estimate."""

_BLOCK = 8  # trials whose arrays fit the cache together


def recursion(scenario: Scenario, z: Array, start: Array, *, first: int = FIRST, iterations: int = 2) -> Array:
    """Return the estimates of the paper's recursion after every epoch.

    Parameters
    ----------
    scenario : Scenario
        Stations.
    z : array (trials, k, s - 1)
        Range differences against the first station, metres.
    start : array (trials, n)
        Position, or position and velocity at time zero, from which the first estimate is made.
    first : int
        Epochs of the first estimate.
    iterations : int
        Steps at each epoch.

    Returns
    -------
    array (trials, k - first + 1, n + s - 1)
        State and biases after `first`, `first + 1` ... epochs; NaN from where the steps ran away.
    """
    trials, epochs = z.shape[:2]
    out = np.empty((trials, epochs - first + 1, start.shape[-1] + z.shape[-1]))
    arrivals = np.zeros((trials, z.shape[-1] + 1, epochs))
    arrivals[:, 1:] = z.swapaxes(1, 2)
    track, times = np.ascontiguousarray(scenario.track(epochs).T), scenario.times(epochs)
    with np.errstate(all="ignore"):
        for low in range(0, trials, _BLOCK):
            part = slice(low, low + _BLOCK)
            state = start[part]
            for k in range(first, epochs + 1):
                for _ in range(iterations):
                    move, bias = step(state, arrivals[part, :, :k], track[..., :k], times[:k])
                    state = state + move
                out[part, k - first] = np.concatenate([state, bias], axis=-1)
    return out


def step(state: Array, arrivals: Array, track: Array, times: Array) -> tuple[Array, Array]:
    """Return one Gauss-Newton step (trials, n) of the state and the biases (trials, s - 1) that go with it.

    The sums of eq. 11 and 12 over the epochs. The inverse of R, proportional to I + 11', takes the mean of each epoch
    out of the arrivals, and eliminating the unknown biases takes the mean of the run out of each channel: what is left
    are outer products.

    Parameters
    ----------
    state : array (trials, n)
        Position, or position and velocity at time zero.
    arrivals : array (trials, s, k)
        Range differences against the first station, whose own are zero.
    track : array (3, s, k)
        Stations.
    times : array (k,)
        Seconds.
    """
    trials, n = state.shape
    target = state[:, :3, None, None]
    if n > 3:
        target = target + state[:, 3:, None, None] * times
    slope = target - track
    distance = np.sqrt(np.einsum("tcsk,tcsk->tsk", slope, slope))
    slope /= distance[:, None]
    misfit = arrivals - distance
    misfit -= misfit.mean(1, keepdims=True)
    slope -= slope.mean(2, keepdims=True)
    if n > 3:
        slope = np.concatenate([slope, slope * times], axis=1)
    rows, mean, left = slope.reshape(trials, n, -1), slope.mean(3), misfit.mean(2)
    information = rows @ rows.swapaxes(1, 2) - len(times) * (mean @ mean.swapaxes(1, 2))
    vector = rows @ misfit.reshape(trials, -1, 1) - len(times) * (mean @ left[..., None])
    solved, ok = linalg.solve(information, vector)
    move = np.where(ok[:, None], solved[..., 0], np.nan)
    left = left - (move[:, None] @ mean)[:, 0]
    return move, left[:, 1:] - left[:, :1]
