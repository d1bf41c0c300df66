"""Gross measurements of a network: which rows the others contradict, found without a guess.

Weighted steps as of the loss of Geman and McClure lead from random places to networks that most rows agree with; blocks
are placed anew where many of their rows do not; the truncated cost says which network is best.

Source: S. Geman and D. McClure, "Statistical methods for tomographic image reconstruction", Bull. Int. Stat. Inst. 52
(1987).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base.types import Array
from optloc.calibration.blocks import Points, moved_pulses, moved_stations, pulses_alone, stations_alone
from optloc.calibration.likelihood import Estimate, Likelihood, likelihood, together
from optloc.calibration.network import Network
from optloc.calibration.rounds import Starts, starts_of

PRICE = 16.0
"""Cost of a row that is left out: beyond four sigma it is cheaper than what it says, as with suspects of a fix."""

# Starts, and how many of the cheapest are gone on with: a prototype had the network of ten in twelve 12 x 20 halls
# with one row in ten wrong among thirty starts.
_STARTS, _BEST = 40, 3
# Rounds of weights, of a start and of one that goes on, and the steps of each.
_ROUNDS, _MORE, _STEPS = 14, 5, 10
# Width of the weights: twice the median residual, no less than three sigma.
_MEDIANS, _LEAST = 2.0, 3.0
# Sweeps in which blocks are placed anew, places that each is begun at, and rounds of weights of these.
_SWEEPS, _PLACES, _ALONE = 2, 6, 3
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
    at, cost = truncated(lik, reweighted(lik, starts.random(_STARTS), _ROUNDS))
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


def reweighted(lik: Likelihood, at: Estimate, rounds: int) -> Estimate:
    """Refine networks (S) in rounds of weights."""
    at, _ = lik.refine(at, _STEPS)
    for _ in range(rounds):
        root = lik.root * np.sqrt(weights(lik.residual(at), lik.network.given))
        at, _ = replace(lik, root=root).refine(at, _STEPS)
    return at


def truncated(lik: Likelihood, at: Estimate) -> tuple[Estimate, Array]:
    """Refine networks (S) without what is beyond four sigma; return them and their truncated costs (S,)."""
    for _ in range(_SETTLING):
        at, _ = replace(lik, root=lik.root * (lik.residual(at) ** 2 < PRICE)).refine(at, 2 * _STEPS)
    square = lik.residual(at) ** 2
    return at, np.asarray(lik.total(at, np.minimum(square, PRICE) ** 0.5))


def placed_anew(lik: Likelihood, starts: Starts, at: Estimate) -> Estimate:
    """Return a network (S = 1) with pulses, and then stations, at the places that most of their rows agree with."""
    net = lik.network
    pulses = _agreed(pulses_alone(lik, at), at.pulses[0], starts)
    at = moved_pulses(lik, at, np.arange(net.pulses), pulses, PRICE)
    which = np.flatnonzero((net.place_sigma > 0.0).any(axis=1))
    if not which.size:
        return at
    stations = _agreed(stations_alone(lik, at, which), at.stations[0, which], starts)
    return moved_stations(at, which, stations)


def _agreed(points: Points, here: Array, starts: Starts) -> Array:
    """Return the places (B, d) of least truncated cost from where blocks are, mirror images and random places."""
    size, d = here.shape
    random = starts.rng.random((size, _PLACES, d)) - 0.5
    middle, spread = points.one.mean(axis=0), np.ptp(points.one, axis=0) * 2.0 + 1e-3 * starts.spread
    x = np.concatenate([here[:, None], points.mirrored(here), middle + random * spread], axis=1)
    many = points.repeated(x.shape[1])
    x, t = many.settled(x.reshape(-1, 1, d))[:2]
    for _ in range(_ALONE):
        residual = many.equations(x, t)[0][:, 0, : points.one.shape[0]]
        own = replace(many, root=many.root * np.sqrt(weights(residual, many.root > 0.0)))
        x, t = own.settled(x, t)[:2]
    residual = many.equations(x, t)[0][:, 0]
    cost = np.minimum(residual**2, PRICE).sum(axis=1).reshape(size, -1)
    return np.asarray(x[:, 0].reshape(size, -1, d)[np.arange(size), cost.argmin(axis=1)])
