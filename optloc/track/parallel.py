"""Several models of motion from one start, side by side: the data say which is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.errors import InvalidProblem
from optloc.problem import Problem
from optloc.status import Status
from optloc.track.dynamics import Dynamics
from optloc.track.track import State, Track, followed
from optloc.track.updates import Update
from optloc.types import Array


@dataclass(frozen=True, slots=True)
class Parallel:
    """Tracks of one target by several models.

    Parameters
    ----------
    models : tuple of q Dynamics
        Models of motion.
    tracks : tuple of q Track
        One for each; all have the same scans.
    score : array (..., k, q)
        Logarithm of the likelihood of all scans so far; minus infinity from the scan on where a model lost the state.
    """

    models: tuple[Dynamics, ...]
    tracks: tuple[Track, ...]
    score: Array

    @property
    def choice(self) -> Array:
        """Return which model (..., k) explains the scans so far best."""
        return np.asarray(self.score.argmax(-1))

    @property
    def probability(self) -> Array:
        """Return the probability (..., k, q) of each model, all being equally likely before the first scan."""
        return softmax(self.score)

    @property
    def position(self) -> Array:
        """Return the positions (..., k, d) of the model that is chosen at each scan, metres."""
        every = np.stack([track.position for track in self.tracks], axis=-2)
        return np.asarray(np.take_along_axis(every, self.choice[..., None, None], axis=-2)[..., 0, :])


def parallel(
    problem: Problem,
    start: State,
    models: Sequence[Dynamics],
    *,
    speed: float | None = None,
    rate: float | None = None,
    update: Update | str = "iekf",
) -> Parallel:
    """Return the tracks of several models from one start, and the likelihood of each.

    The prior of velocity and acceleration is what keeps a larger model from being preferred to a smaller one that
    explains the data as well.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs of one target.
    start : State
        A position, with velocity and acceleration where they are known.
    models : sequence of Dynamics
        For instance ``[polynomial(0), polynomial(1), polynomial(2)]``.
    speed, rate : float, optional
        Prior standard deviation of each coordinate of velocity (m/s) and acceleration (m/s^2), about zero, where the
        start does not hold them.
    update : callable or str
        A filter, or its name in `UPDATES`.

    Raises
    ------
    InvalidProblem
        Where there are no models, or a prior that is needed is missing.

    References
    ----------
    D. T. Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE Trans. Autom. Control 10 (1965).
    """
    check_models(models)
    d, start = problem.dimension, spread(start, problem.batch_shape)
    tracks = tuple(
        followed(problem, resized(start, model.order, d, speed=speed, rate=rate), model, update) for model in models
    )
    each = [np.where(track.code == Status.NUMERICAL, -np.inf, track.loglikelihood) for track in tracks]
    return Parallel(tuple(models), tracks, np.stack([np.cumsum(value, axis=-1) for value in each], axis=-1))


def resized(
    state: State, order: int, dimension: int, *, speed: float | None = None, rate: float | None = None
) -> State:
    """Return a state of another order: parts that are too many are left out, missing ones are added as priors.

    Parameters
    ----------
    state : State
        Of any order.
    order : 0, 1 or 2
        Order wanted.
    dimension : int
        2 or 3.
    speed, rate : float, optional
        Standard deviation of each coordinate of velocity (m/s) and acceleration (m/s^2), about zero, where they are
        missing.

    Raises
    ------
    InvalidProblem
        Where a missing part has no prior.
    """
    n, held = (order + 1) * dimension, state.mean.shape[-1]
    if held >= n:
        return State(state.time, state.mean[..., :n], state.cov[..., :n, :n])
    sizes = {1: ("velocity", "speed", speed), 2: ("acceleration", "rate", rate)}
    variance = []
    for part in range(held // dimension, order + 1):
        name, argument, size = sizes[part]
        if size is None:
            raise InvalidProblem(f"the start has no {name}", argument, "give its prior standard deviation")
        variance += [float(size) ** 2] * dimension
    batch = np.broadcast_shapes(state.mean.shape[:-1], state.cov.shape[:-2])
    mean, cov = np.zeros((*batch, n)), np.zeros((*batch, n, n))
    mean[..., :held], cov[..., :held, :held] = state.mean, state.cov
    cov[..., range(held, n), range(held, n)] = variance
    return State(state.time, mean, cov)


def spread(state: State, batch: tuple[int, ...]) -> State:
    """Return a state with at least the leading axes of a batch.

    Parameters
    ----------
    state : State
        With leading axes that fit.
    batch : tuple of int
        Leading axes.
    """
    shape, n = np.broadcast_shapes(state.mean.shape[:-1], state.cov.shape[:-2], batch), state.mean.shape[-1]
    return State(state.time, np.broadcast_to(state.mean, (*shape, n)), np.broadcast_to(state.cov, (*shape, n, n)))


def check_models(models: Sequence[Dynamics]) -> None:
    """Refuse an empty list of models; raise InvalidProblem."""
    if not models:
        raise InvalidProblem("there are no models of motion", "models", "give at least one")


def softmax(score: Array) -> Array:
    """Return exp(score) over its sum along the last axis; equal shares where all are minus infinity."""
    top = score.max(-1, keepdims=True)
    weight = np.where(np.isfinite(top), np.exp(score - np.where(np.isfinite(top), top, 0.0)), 1.0)
    return np.asarray(weight / weight.sum(-1, keepdims=True))
