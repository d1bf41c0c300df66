"""The algorithm of the paper as printed: undamped, two re-linearised steps over all past data at every new epoch.

It starts from a given place at the fortieth epoch and never looks for another minimum: a baseline.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from optloc import linalg
from optloc.papers.registration.scenario import Scenario
from optloc.types import Array

FIRST = 40
"""Epochs that are collected before the first estimate."""

_BLOCK = 16


def recursion(scenario: Scenario, z: Array, start: Array, *, first: int = FIRST, iterations: int = 2) -> Array:
    """Return the estimates after every epoch.

    Range differences of equal arrival noise, R proportional to I + 11': its inverse takes the mean of an epoch out of
    the arrivals, and unknown biases take the mean of the run out of each channel. What is left are sums of outer
    products over the epochs, the normal equations of eq. 11 and 12 with the biases eliminated.

    Parameters
    ----------
    scenario : Scenario
        Stations; a course means that velocity is estimated as well.
    z : array (trials, k, s - 1)
        Range differences against the first station, metres.
    start : array (trials, n)
        Position, or position and velocity, from which the first estimate is made.
    first : int
        Epochs of the first estimate.
    iterations : int
        Steps at each epoch.

    Returns
    -------
    array (trials, k - first + 1, n + s - 1)
        State and biases after `first`, `first + 1` ... epochs; not finite where the steps ran away.
    """
    trials, epochs = z.shape[:2]
    out = np.empty((trials, epochs - first + 1, start.shape[-1] + z.shape[-1]))
    arrivals = np.concatenate([np.zeros((trials, epochs, 1)), z], axis=-1).swapaxes(1, 2)
    track = scenario.track(epochs).T
    time = scenario.times(epochs)
    with np.errstate(all="ignore"):
        for part in _blocks(trials):
            state = np.array(start[part])
            for k in range(first, epochs + 1):
                for _ in range(iterations):
                    move, bias = step(state, arrivals[part, :, :k], track[..., :k], time[:k])
                    state = state + move
                out[part, k - first] = np.concatenate([state, bias], axis=-1)
    return out


def _blocks(trials: int) -> Iterator[slice]:
    """Yield slices of trials whose arrays fit the cache."""
    for low in range(0, trials, _BLOCK):
        yield slice(low, min(low + _BLOCK, trials))


def step(state: Array, arrivals: Array, track: Array, time: Array) -> tuple[Array, Array]:
    """Return the Gauss-Newton step (trials, n) of the state, and the biases (trials, s - 1) that go with it.

    Parameters
    ----------
    state : array (trials, n)
        Position, or position and velocity at time zero.
    arrivals : array (trials, s, k)
        Range differences against the first station, whose own are zero.
    track : array (3, s, k)
        Stations.
    time : array (k,)
        Seconds.
    """
    target = state[:, :3, None, None]
    if state.shape[-1] > 3:
        target = target + state[:, 3:, None, None] * time
    line = target - track
    distance = np.sqrt((line * line).sum(1))
    slope = line / distance[:, None]
    misfit = arrivals - distance
    slope = slope if state.shape[-1] == 3 else np.concatenate([slope, slope * time], axis=1)
    centred = slope - slope.mean(2, keepdims=True)
    centred -= centred.mean(3, keepdims=True)
    n = state.shape[-1]
    rows = centred.reshape(len(state), n, -1)
    information = rows @ rows.swapaxes(1, 2)
    vector = rows @ misfit.reshape(len(state), -1, 1)
    finite = np.isfinite(information).all((-1, -2)) & np.isfinite(vector).all((-1, -2))
    solved, ok = linalg.solve(np.where(finite[:, None, None], information, np.eye(n)), vector)
    move = np.where((finite & ok)[:, None], solved[..., 0], np.nan)
    left = misfit.mean(2) - (move[:, None, :] @ slope.mean(3).reshape(len(state), n, -1))[:, 0]
    return move, left[:, 1:] - left[:, :1]
