"""Gross measurements of a network: which rows the others contradict, found without a guess.

Weighted steps as of the loss of Geman and McClure lead from random places to networks that most rows agree with; blocks
are placed anew where many of their rows do not; the truncated cost says which network is best.

Source: S. Geman and D. McClure, "Statistical methods for tomographic image reconstruction", Bull. Int. Stat. Inst. 52
(1987).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.engine import predict, vectors
from optloc.problem import Array, Problem, variances
from optloc.sites.calibration.blocks import minima, pulses_alone, stations_alone
from optloc.sites.calibration.likelihood import Likelihood, NetworkEstimate, likelihood, together
from optloc.sites.calibration.network import Network
from optloc.sites.calibration.restarts import Starts, starts_of

PRICE = 16.0
"""Cost of a row that is left out: beyond four sigma it is cheaper than what it says, as with suspects of a fix."""

# Starts, and how many of the cheapest are gone on with: of 15 halls of 12 x 20 with one row in ten wrong forty and
# three missed the stations of three, sixty and four of none.
_STARTS, _BEST = 60, 4
# Rounds of weights, of a start and of one that goes on, and the steps of each.
_ROUNDS, _MORE, _STEPS = 14, 5, 10
# Width of the weights: twice the median residual, no less than three sigma.
_MEDIANS, _LEAST = 2.0, 3.0
# Sweeps in which blocks are placed anew; handfuls of rows that each is placed by, how many rows they have beyond the
# coordinates, and rounds of weights that follow: of four rows with one in five gross two handfuls in five have none.
_SWEEPS, _PLACES, _SPARE, _ALONE = 2, 40, 1, 2
# Rounds of truncation: far more than it takes the rows that are left out to settle.
_SETTLING = 8


def outliers(network: Network, seed: int) -> Array:
    """Return which rows of a network are gross (N, R): beyond four sigma of the network that most rows agree with.

    Parameters
    ----------
    network : Network
        What was measured.
    seed : int
        Decides the starts.
    """
    lik = likelihood(network)
    starts = starts_of(lik, seed)
    at, cost = truncated(lik, reweighted(lik, lik.refine(starts.random(_STARTS), _STEPS)[0], _ROUNDS))
    best = np.argsort(cost, kind="stable")[:_BEST]
    at, cost = at.take(best), cost[best]
    for _ in range(_SWEEPS):
        tried = together(*(placed_anew(lik, starts, at.take(np.array([i]))) for i in range(at.count)))
        there, costs = truncated(lik, reweighted(lik, tried, _MORE))
        at, cost = there.where(costs < cost, at), np.minimum(cost, costs)
    found = at.take(np.array([int(cost.argmin())]))
    return np.asarray(network.given & (lik.residual(found)[0] ** 2 > PRICE))


def weights(residual: Array, given: Array) -> Array:
    """Return weights of whitened residuals (S, ..., R): near one, and falling with the fourth power far away."""
    size = np.where(given, np.abs(residual), np.nan)
    axes = tuple(range(1, residual.ndim))
    width = np.maximum(_MEDIANS * np.nanmedian(size, axis=axes, keepdims=True), _LEAST)
    return np.asarray((1.0 + (residual / width) ** 2) ** -2.0)


def reweighted(lik: Likelihood, at: NetworkEstimate, rounds: int) -> NetworkEstimate:
    """Refine networks (S) in rounds of weights: steps without them would lead away from what most rows agree with."""
    for _ in range(rounds):
        own = weights(lik.residual(at), lik.network.given)
        at, _ = replace(lik, weight=own).refine(at, _STEPS)
    return at


def truncated(lik: Likelihood, at: NetworkEstimate) -> tuple[NetworkEstimate, Array]:
    """Refine networks (S) without what is beyond four sigma; return them and their truncated costs (S,)."""
    for _ in range(_SETTLING):
        at, _ = replace(lik, weight=1.0 * (lik.residual(at) ** 2 < PRICE)).refine(at, 2 * _STEPS)
    square = lik.residual(at) ** 2
    return at, np.asarray(lik.cost(at) - np.maximum(square - PRICE, 0.0).sum(axis=(1, 2)))


def placed_anew(lik: Likelihood, starts: Starts, at: NetworkEstimate) -> NetworkEstimate:
    """Return a network (S = 1) with pulses, and then stations, at the places that most of their rows agree with."""
    net, d = lik.network, lik.network.dimension
    x = _agreed(pulses_alone(net, at), at.pulses[0], starts)
    emission = x[:, d] if x.shape[1] > d else at.emission[0]
    at = replace(at, pulses=x[None, :, :d], emission=np.where(net.emission, emission, at.emission[0])[None])
    which = np.flatnonzero((net.place_sigma > 0.0).any(axis=1))
    if not which.size:
        return at
    x = _agreed(stations_alone(net, at, which), at.stations[0, which], starts)
    stations, clocks = at.stations.copy(), at.clocks.copy()
    stations[0, which] = x[:, :d]
    if not net.synchronised:
        clocks[0, which] = x[:, d]
    return replace(at, stations=stations, clocks=clocks)


def _agreed(problem: Problem, here: Array, starts: Starts) -> Array:
    """Return the values (B, size) of least truncated cost: of blocks where they are, or where a few rows alone lead.

    A handful of rows drawn at random has no gross one in it often enough, where all rows at once lead astray.

    Source: M. Fischler and R. Bolles, "Random sample consensus", Commun. ACM 24 (1981).
    """
    size, d = here.shape
    partners = problem.stations.places
    middle, spread = partners.mean(axis=-2), np.ptp(partners, axis=-2) * 2.0 + 1e-3 * starts.spread
    x = middle + (starts.rng.random((size, _PLACES, d)) - 0.5) * spread
    many = problem.take(np.repeat(np.arange(size), _PLACES))
    given = np.broadcast_to(many.weight > 0.0, (size * _PLACES, many.count))
    order = np.argsort(starts.rng.random(given.shape) + ~given, axis=1)
    few = np.zeros(given.shape)
    np.put_along_axis(few, order[:, : d + _SPARE], 1.0, axis=1)
    x = minima(many.with_rows(weight=few * given), x.reshape(-1, 1, d))[0][:, 0]
    for _ in range(_ALONE):
        own = weights(whitened(many, x), given) * given
        x = minima(many.with_rows(weight=own), x[:, None, :d])[0][:, 0]
    now = vectors(problem, here[:, None])
    x = np.concatenate([now, x.reshape(size, _PLACES, -1)], axis=1)
    cost = np.stack([np.minimum(whitened(problem, x[:, k]) ** 2, PRICE).sum(axis=-1) for k in range(1 + _PLACES)])
    return np.asarray(x[np.arange(size), cost.argmin(axis=0)])


def whitened(problem: Problem, x: Array) -> Array:
    """Return residuals (B, q) in deviations, zero of absent rows."""
    left = np.where(problem.weight > 0.0, problem.observed - predict(problem, x), 0.0)
    return np.asarray(left / np.sqrt(variances(problem.noise, problem.count)))
