"""Gross errors in the rows of a network, found without a first guess.

Refinements with the weights of the Geman-McClure loss lead from random positions to networks that agree
with most rows. Stations and pulses with many contradicting rows are then placed again from random subsets
of their rows. The network with the least truncated cost wins. The truncated cost counts each squared
residual up to `PRICE`.

Letters: S networks, N pulses, R slots, B blocks (a block is one station or pulse), d coordinates.

Source: S. Geman and D. McClure, "Statistical methods for tomographic image reconstruction", Bull. Int.
Stat. Inst. 52 (1987).

Arguments of many functions: `lik` is the likelihood of the network, and `at` are estimates of all
unknowns. `starts` provides random numbers and the size of the network.
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
"""Cost of a row that is left out: a residual beyond four sigma costs more. Suspects of a fix have the same price."""

# Starts, and number of best starts that continue. In 15 simulated halls of 12 x 20 with 10 % wrong rows, forty
# starts with three continued missed the stations of three halls; sixty with four missed none.
_STARTS, _BEST = 60, 4
# Rounds of weights for a start and for a continued start, and refinement steps in each round.
_ROUNDS, _MORE, _STEPS = 14, 5, 10
# Width of the weights: this factor times the median residual, but at least three standard deviations.
_MEDIANS, _LEAST = 2.0, 3.0
# Sweeps that place all blocks again; random subsets of rows for each block; rows of a subset in addition to the
# number of coordinates; rounds of weights after a subset. With 20 % gross rows, two of five subsets of four
# rows have no gross row.
_SWEEPS, _PLACES, _SPARE, _ALONE = 2, 40, 1, 2
# Rounds of truncation: far more than the set of excluded rows needs to become constant.
_SETTLING = 8


def outliers(network: Network, seed: int) -> Array:
    """Return a mask (N, R) of gross rows: beyond four sigma of the network that agrees with most rows.

    `seed` sets the random starts.
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
    """Return weights of whitened residuals (S, ..., R): near 1 for small ones, falling with the fourth power.

    `given` (..., R) marks the measured entries. The width of the weights follows the median residual of each
    network.
    """
    size = np.where(given, np.abs(residual), np.nan)
    axes = tuple(range(1, residual.ndim))
    width = np.maximum(_MEDIANS * np.nanmedian(size, axis=axes, keepdims=True), _LEAST)
    return np.asarray((1.0 + (residual / width) ** 2) ** -2.0)


def reweighted(lik: Likelihood, at: NetworkEstimate, rounds: int) -> NetworkEstimate:
    """Return S networks refined in `rounds` rounds of weights; without weights, gross rows dominate the steps.

    Each round computes the weights from the residuals of the round before.
    """
    for _ in range(rounds):
        row_weights = weights(lik.residual(at), lik.network.given)
        at, _ = replace(lik, weight=row_weights).refine(at, _STEPS)
    return at


def truncated(lik: Likelihood, at: NetworkEstimate) -> tuple[NetworkEstimate, Array]:
    """Return S networks refined without rows beyond four standard deviations, and their truncated costs (S,)."""
    for _ in range(_SETTLING):
        at, _ = replace(lik, weight=1.0 * (lik.residual(at) ** 2 < PRICE)).refine(at, 2 * _STEPS)
    square = lik.residual(at) ** 2
    return at, np.asarray(lik.cost(at) - np.maximum(square - PRICE, 0.0).sum(axis=(1, 2)))


def placed_anew(lik: Likelihood, starts: Starts, at: NetworkEstimate) -> NetworkEstimate:
    """Return a network (S = 1) with pulses, then stations, moved to positions that agree with most of their rows.

    `starts` provides the random numbers and the size of the network.
    """
    net, d = lik.network, lik.network.dimension
    x = _random_consensus(pulses_alone(net, at), at.pulses[0], starts)
    emission = x[:, d] if x.shape[1] > d else at.emission[0]
    at = replace(at, pulses=x[None, :, :d], emission=np.where(net.emission, emission, at.emission[0])[None])
    which = np.flatnonzero((net.place_sigma > 0.0).any(axis=1))
    if not which.size:
        return at
    x = _random_consensus(stations_alone(net, at, which), at.stations[0, which], starts)
    stations, clocks = at.stations.copy(), at.clocks.copy()
    stations[0, which] = x[:, :d]
    if not net.synchronised:
        clocks[0, which] = x[:, d]
    return replace(at, stations=stations, clocks=clocks)


def _random_consensus(problem: Problem, here: Array, starts: Starts) -> Array:
    """Return the unknowns (B, size) of each block with the least truncated cost.

    `problem` is a batch of B blocks, and `here` (B, d) are their positions, metres. The candidates are the
    present position and fits to random subsets of the rows. A fit to all rows fails if some rows are gross,
    but many small subsets have no gross row.

    Source: M. Fischler and R. Bolles, "Random sample consensus", Commun. ACM 24 (1981).
    """
    size, d = here.shape
    partners = problem.stations.places
    middle, spread = partners.mean(axis=-2), np.ptp(partners, axis=-2) * 2.0 + 1e-3 * starts.spread
    # Random start positions of each subset, in a box of twice the extent of the partners.
    x = middle + (starts.rng.random((size, _PLACES, d)) - 0.5) * spread
    many = problem.take(np.repeat(np.arange(size), _PLACES))
    given = np.broadcast_to(many.weight > 0.0, (size * _PLACES, many.count))
    # Random numbers below 1 sort the given rows first, in random order; `few` selects the first d + 1 of them.
    order = np.argsort(starts.rng.random(given.shape) + ~given, axis=1)
    few = np.zeros(given.shape)
    np.put_along_axis(few, order[:, : d + _SPARE], 1.0, axis=1)
    x = minima(many.with_rows(weight=few * given), x.reshape(-1, 1, d))[0][:, 0]
    for _ in range(_ALONE):
        row_weights = weights(whitened(many, x), given) * given
        x = minima(many.with_rows(weight=row_weights), x[:, None, :d])[0][:, 0]
    # Candidate 0 is the present position, with the emission time or clock that fits there.
    now = vectors(problem, here[:, None])
    x = np.concatenate([now, x.reshape(size, _PLACES, -1)], axis=1)
    cost = np.stack([np.minimum(whitened(problem, x[:, k]) ** 2, PRICE).sum(axis=-1) for k in range(1 + _PLACES)])
    return np.asarray(x[np.arange(size), cost.argmin(axis=0)])


def whitened(problem: Problem, x: Array) -> Array:
    """Return residuals (B, q) of a batch in standard deviations at the vectors x (B, size); 0 for absent rows."""
    left = np.where(problem.weight > 0.0, problem.observed - predict(problem, x), 0.0)
    return np.asarray(left / np.sqrt(variances(problem.noise, problem.count)))
