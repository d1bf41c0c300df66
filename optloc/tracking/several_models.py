"""Several models of motion for one target: in parallel, or interacting (IMM) for a target that changes its motion.

Letters: k scans, q models, n numbers of a state, d coordinates, (...) a batch of targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.problem.problem import Problem
from optloc.tracking.dynamics import Dynamics
from optloc.tracking.scan_rows import Scans
from optloc.tracking.track import State, Track, check_state, check_trackable, collect, followed, step
from optloc.tracking.updates import Update, Updated, filter_of

# Parallel models from one start: the likelihoods of the data decide between the models.


@dataclass(frozen=True, slots=True)
class Parallel:
    """Tracks of one target by several models (k scans, q models).

    - models: q models of motion.
    - tracks: one track for each model; all have the same scans.
    - score (..., k, q): log-likelihood of all scans so far; minus infinity after a model has lost the state.
    """

    models: tuple[Dynamics, ...]
    tracks: tuple[Track, ...]
    score: Array

    @property
    def choice(self) -> Array:
        """Return the number of the most likely model (..., k) for the scans so far."""
        return np.asarray(self.score.argmax(-1))

    @property
    def probability(self) -> Array:
        """Return the probability (..., k, q) of each model; all models are equally likely before the first scan."""
        return softmax(self.score)

    @property
    def position(self) -> Array:
        """Return the positions (..., k, d) of the most likely model at each scan, metres."""
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

    Without a prior of velocity and acceleration, a larger model would be preferred to a smaller model that explains the
    data equally well.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs of one target.
    start : State
        A position, with velocity and acceleration if they are known.
    models : sequence of Dynamics
        For instance ``[polynomial(0), polynomial(1), polynomial(2)]``.
    speed, rate : float, optional
        Prior standard deviation of each coordinate of velocity (m/s) and acceleration (m/s^2), about zero, if the start
        does not hold them.
    update : callable or str
        A filter, or its name in `UPDATES`.

    Raises
    ------
    InvalidProblem
        If there are no models, or a necessary prior is missing.

    References
    ----------
    D. T. Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE Trans. Autom. Control 10 (1965).
    """
    check_models(models)
    d, start = problem.dimension, spread(start, problem.batch_shape)
    tracks = tuple(
        followed(problem, resized(start, model.order, d, speed=speed, rate=rate), model, update) for model in models
    )
    # A model that lost the state has no likelihood from there on.
    each = [np.where(track.code == Status.NUMERICAL, -np.inf, track.loglikelihood) for track in tracks]
    return Parallel(tuple(models), tracks, np.stack([np.cumsum(value, axis=-1) for value in each], axis=-1))


# Interacting models: the model may change from scan to scan.


@dataclass(frozen=True, slots=True)
class Mixed:
    """The track of a target by interacting models.

    - models: q models of motion.
    - track: mean and covariance over all models, in the largest order; the missing velocity or acceleration of a model
      is zero. The squared innovations are weighted by the probabilities, and the likelihood is the likelihood of the
      mixture.
    - probability (..., k, q): probability of each model after each scan.
    """

    models: tuple[Dynamics, ...]
    track: Track
    probability: Array


def imm(
    problem: Problem,
    start: State,
    models: Sequence[Dynamics],
    transition: Array,
    *,
    speed: float | None = None,
    rate: float | None = None,
    update: Update | str = "iekf",
) -> Mixed:
    """Return the track of a target that may change its model of motion from scan to scan.

    Models may differ in order. When a smaller model is mixed into a larger model, its missing components come from the
    larger model: zeros would pull the velocity or acceleration to zero.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs of one target.
    start : State
        A position, with velocity and acceleration if they are known.
    models : sequence of q Dynamics
        Models of motion.
    transition : array (q, q)
        Probability of a change from the model of a row to the model of a column, from one scan to the next.
    speed, rate : float, optional
        Prior standard deviation of each coordinate of velocity (m/s) and acceleration (m/s^2), about zero, if the start
        does not hold them.
    update : callable or str
        A filter, or its name in `UPDATES`.

    Raises
    ------
    InvalidProblem
        If there are no models, a necessary prior is missing, or the transition is not a table of probabilities.

    References
    ----------
    H. A. P. Blom, Y. Bar-Shalom, "The interacting multiple model algorithm for systems with Markovian switching
    coefficients", IEEE Trans. Autom. Control 33 (1988).
    T. Yuan, Y. Bar-Shalom, P. Willett, E. Mozeson, S. Pollak, D. Hardiman, "A multiple IMM estimation approach with
    unbiased mixing for thrusting projectiles", IEEE Trans. Aerosp. Electron. Syst. 48 (2012).
    """
    check_models(models)
    chain, rule, d = _transition(transition, len(models)), filter_of(update), problem.dimension
    start = spread(start, problem.batch_shape)
    states = [resized(start, model.order, d, speed=speed, rate=rate) for model in models]
    for model, state in zip(models, states, strict=True):
        check_state(state, (model.order + 1) * d)
    # Before the first scan, all models are equally likely.
    weight = np.full((*start.mean.shape[:-1], len(models)), 1.0 / len(models))
    steps, times, weights = [], [], []
    check_trackable(problem)
    given = {order: Scans.of(problem, order) for order in {model.order for model in models}}
    for k, time in enumerate(problem.times.tolist()):
        if time <= start.time:
            continue
        # Mixing precedes prediction: each model starts from a mixture of all states.
        states, coming = mixed(states, weight, chain)
        both = zip(states, models, strict=True)
        done = [step(given[model.order], k, state, model, rule) for state, model in both]
        states = [State(time, each.mean, each.cov) for each, _ in done]
        weight, total = _weigh(done, coming)
        steps.append(_combine(done, weight, total))
        times.append(time)
        weights.append(weight)
    track = collect(np.array(times), steps, d, dated=problem.dated)
    return Mixed(tuple(models), track, np.stack(weights, axis=-2))


def mixed(states: Sequence[State], weight: Array, transition: Array) -> tuple[list[State], Array]:
    """Return the mixed state of each model before the next prediction, and the predicted probabilities (..., q).

    The mixed state of a model is a mixture of the states of all models, weighted by the probability that each was
    the last model. `states` are the states of q models after the last scan, possibly of different orders. `weight`
    (..., q) are the probabilities after the last scan, and `transition` (q, q) is the table of `imm`. The mixed
    states keep the orders.
    """
    coming = weight @ transition
    # Probability that the model was i, given that it is j now; for an unreachable model, avoid 0 / 0.
    share = weight[..., :, None] * transition / np.maximum(coming, np.finfo(float).tiny)[..., None, :]
    out = []
    for j, own in enumerate(states):
        parts = [_in_order_of(state, own) for state in states]
        mean, cov = moments([p.mean for p in parts], [p.cov for p in parts], share[..., j])
        # An unreachable model keeps its state.
        kept = coming[..., j] <= 0.0
        mean = np.where(kept[..., None], own.mean, mean)
        out.append(State(own.time, mean, np.where(kept[..., None, None], own.cov, cov)))
    return out, coming


def _transition(transition: Array, count: int) -> Array:
    """Return the transition as an array (q, q) for q = `count` models.

    A table that does not contain probabilities raises InvalidProblem.
    """
    chain = np.asarray(transition, dtype=float)
    good = chain.shape == (count, count) and bool(np.all(chain >= 0.0))
    # Rows with three digits, such as 0.333, do not add up to one: they are refused, not scaled.
    if not good or not np.allclose(chain.sum(-1), 1.0, atol=1e-9):
        raise InvalidProblem(
            f"the transition is not a {count} x {count} table of probabilities",
            "transition",
            "make the sum of each row 1",
        )
    return chain


def _in_order_of(state: State, own: State) -> State:
    """Return a state in the order of the state `own`, which also provides missing components and their covariance."""
    n, present = own.mean.shape[-1], state.mean.shape[-1]
    if present >= n:
        return State(state.time, state.mean[..., :n], state.cov[..., :n, :n])
    batch = np.broadcast_shapes(state.mean.shape[:-1], own.mean.shape[:-1])
    mean, cov = np.broadcast_to(own.mean, (*batch, n)).copy(), np.zeros((*batch, n, n))
    mean[..., :present] = state.mean
    cov[..., :present, :present], cov[..., present:, present:] = state.cov, own.cov[..., present:, present:]
    return State(state.time, mean, cov)


def _weigh(done: Sequence[tuple[Updated, Array]], coming: Array) -> tuple[Array, Array]:
    """Return the probabilities (..., q) of the models after a scan, and the log-likelihood (...) of the scan.

    `done` are the update and status of each model. `coming` (..., q) are the probabilities before the scan.
    """
    fit = [np.where(code == Status.NUMERICAL, -np.inf, each.loglikelihood) for each, code in done]
    with np.errstate(divide="ignore"):
        score = np.log(coming) + np.stack(fit, axis=-1)
    # Subtract the highest score before the exponential: likelihoods of many rows underflow.
    top = score.max(-1)
    known = np.isfinite(top)
    # If no model has a likelihood, the scan does not change the probabilities.
    weight = np.where(known[..., None], softmax(score), coming)
    peak = np.where(known, top, 0.0)
    total = peak + np.log(np.where(known[..., None], np.exp(score - peak[..., None]), 1.0 / score.shape[-1]).sum(-1))
    return weight, total


def _combine(done: Sequence[tuple[Updated, Array]], weight: Array, total: Array) -> tuple[Updated, Array]:
    """Return the update over all models, and its status (...): the best status of the models.

    `done` are the update and status of each model. `weight` (..., q) are the probabilities of the models, and
    `total` (...) is the log-likelihood of the scan.
    """
    n = max(each.mean.shape[-1] for each, _ in done)
    both = [_padded(each, n) for each, _ in done]
    mean, cov = moments([one for one, _ in both], [around for _, around in both], weight)
    nis = np.stack([each.nis for each, _ in done], axis=-1)
    used = np.where(weight > 0.0, nis, 0.0)
    count = np.max([np.broadcast_to(each.count, total.shape) for each, _ in done], axis=0)
    # Ok is the lowest code: one model that follows the target is enough.
    code = np.min([code for _, code in done], axis=0).astype(np.int8)
    return Updated(mean, cov, (weight * used).sum(-1), total, count), code


def _padded(done: Updated, n: int) -> tuple[Array, Array]:
    """Return mean (..., n) and covariance (..., n, n); missing velocity or acceleration is zero without variance.

    `done` is the update of one model, and `n` is the size of the largest model.
    """
    present = done.mean.shape[-1]
    if present == n:
        return done.mean, done.cov
    mean, cov = np.zeros((*done.mean.shape[:-1], n)), np.zeros((*done.cov.shape[:-2], n, n))
    mean[..., :present], cov[..., :present, :present] = done.mean, done.cov
    return mean, cov


# Functions of both methods.


def check_models(models: Sequence[Dynamics]) -> None:
    """Raise InvalidProblem for an empty list of models."""
    if not models:
        raise InvalidProblem("there are no models of motion", "models", "give at least one model")


def resized(
    state: State, order: int, dimension: int, *, speed: float | None = None, rate: float | None = None
) -> State:
    """Return a state of another order: extra components are removed, and missing components get priors about zero.

    Parameters
    ----------
    state : State
        State of any order.
    order : 0, 1 or 2
        Order of the result.
    dimension : int
        2 or 3.
    speed, rate : float, optional
        Standard deviation of each coordinate of velocity (m/s) and acceleration (m/s^2), about zero, if they are
        missing.

    Raises
    ------
    InvalidProblem
        If a missing component has no prior.
    """
    n, present = (order + 1) * dimension, state.mean.shape[-1]
    if present >= n:
        return State(state.time, state.mean[..., :n], state.cov[..., :n, :n])
    sizes = {1: ("velocity", "speed", speed), 2: ("acceleration", "rate", rate)}
    variance = []
    for part in range(present // dimension, order + 1):
        name, argument, size = sizes[part]
        if size is None:
            raise InvalidProblem(f"the start has no {name}", argument, "give its prior standard deviation")
        variance += [float(size) ** 2] * dimension
    batch = np.broadcast_shapes(state.mean.shape[:-1], state.cov.shape[:-2])
    mean, cov = np.zeros((*batch, n)), np.zeros((*batch, n, n))
    mean[..., :present], cov[..., :present, :present] = state.mean, state.cov
    # Priors of single coordinates are independent of the components of the start.
    cov[..., range(present, n), range(present, n)] = variance
    return State(state.time, mean, cov)


def spread(state: State, batch: tuple[int, ...]) -> State:
    """Return a state with at least the leading axes `batch`, by broadcasting."""
    shape, n = np.broadcast_shapes(state.mean.shape[:-1], state.cov.shape[:-2], batch), state.mean.shape[-1]
    return State(state.time, np.broadcast_to(state.mean, (*shape, n)), np.broadcast_to(state.cov, (*shape, n, n)))


def softmax(score: Array) -> Array:
    """Return exp(score) divided by its sum along the last axis; equal shares if all scores are minus infinity.

    Log-likelihoods become probabilities.
    """
    top = score.max(-1, keepdims=True)
    weight = np.where(np.isfinite(top), np.exp(score - np.where(np.isfinite(top), top, 0.0)), 1.0)
    return np.asarray(weight / weight.sum(-1, keepdims=True))


def moments(means: Sequence[Array], covs: Sequence[Array], weight: Array) -> tuple[Array, Array]:
    """Return mean (..., n) and covariance (..., n, n) of a Gaussian mixture of q components.

    `means` (..., n) and `covs` (..., n, n) belong to the components, and `weight` (..., q) are their probabilities.
    """
    centre, each = np.stack(means, axis=-2), np.stack(covs, axis=-3)
    mean = (weight[..., None, :] @ centre)[..., 0, :]
    away = centre - mean[..., None, :]
    cov = (weight[..., None, None] * (each + away[..., :, None] * away[..., None, :])).sum(-3)
    return mean, cov
