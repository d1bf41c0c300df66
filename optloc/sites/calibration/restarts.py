"""Starts of a network without a first guess: low-rank fits and random positions, refined in rounds.

A low-rank fit uses that the squared distances between stations and pulses form a matrix of low rank. It
gives all positions without a first guess, but needs many stations and pulses.

Letters: S networks, M stations, N pulses, d coordinates. Times are multiplied by the propagation speed,
metres.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from formulations.low_rank_network import fit_low_rank, random_stations
from formulations.metric_upgrade import unknowns, upgrade
from optloc.problem import Array
from optloc.sites.calibration.likelihood import Likelihood, NetworkEstimate, likelihood, together
from optloc.sites.calibration.network import Network

# Starts per round: a batch of eight takes little longer than one start.
_LOW_RANK, _RANDOM = 8, 8
# From this number of stations, the first round has only random positions: most of them reach the optimum, in a
# tenth of the time.
_MANY = 10
# Fits with a relaxed cost below this factor times the best are refined: the relaxation weights errors
# differently from the likelihood, so its best fit need not lead to the best network.
_NEARLY = 2.0
# Steps of the refinement as a free network, before the network is aligned with known coordinates.
_ROUGH = 15
# Initial orientations for the alignment with known coordinates, and steps of the alignment.
_TURNS, _LAID = 24, 12
# Smallest standard deviation of known coordinates during the alignment, as a share of the network size.
_LOOSE = 1e-4


@dataclass(frozen=True, slots=True)
class RoundEnds:
    """The minima of several starts.

    Parameters
    ----------
    at : NetworkEstimate
        S minima.
    cost : array (S,)
        Costs of the minima.
    start : int array (S,)
        Number of the start of each minimum. Starts with the same low-rank fit share a number: their agreement is
        no evidence, since they lead to the same network, right or wrong.
    """

    at: NetworkEstimate
    cost: Array
    start: Array

    def take(self, which: Array) -> RoundEnds:
        """Return a selection of the minima (mask or indices)."""
        return RoundEnds(self.at.take(which), self.cost[which], self.start[which])

    def counted(self, which: Array) -> int:
        """Return the number of different starts among the minima that the mask `which` (S,) selects."""
        return len(np.unique(self.start[which]))


def joined(some: list[RoundEnds]) -> RoundEnds:
    """Return the minima of several rounds, `some`, as one object."""
    arrays = (np.concatenate([getattr(one, name) for one in some]) for name in ("cost", "start"))
    return RoundEnds(together(*(one.at for one in some)), *arrays)


def arrivals(network: Network) -> tuple[Array, Array, Array]:
    """Return one arrival or range per pulse and station, and its weight.

    Parameters
    ----------
    network : Network
        Measurements and prior knowledge.

    Returns
    -------
    z, weight : array (N, M)
        Arrivals or ranges, metres, and their inverse standard deviations; 0 without a measurement. Differences are
        converted to arrivals by least squares, up to an unknown constant per pulse.
    emission : bool array (N,)
        Whether a pulse has an unknown offset.
    """
    n, m = network.pulses, network.stations
    z, weight, emission = np.zeros((n, m)), np.zeros((n, m)), np.ones(n, dtype=bool)
    kinds = np.array([slot.kind for slot in network.slots])
    ends = np.array([[slot.a, slot.b] for slot in network.slots])
    for j in range(n):
        given = network.given[j]
        for kind in ("toa", "range", "tdoa"):
            rows = np.flatnonzero(given & (kinds == kind))
            if rows.size:
                values, deviation = network.z[j, rows], network.sigma[j, rows]
                convert = _arrivals_of_differences if kind == "tdoa" else _arrivals_of_stations
                z[j], weight[j] = convert(ends[rows], values, 1.0 / deviation**2, m)
                emission[j] = kind != "range"
                break
    return z, weight, emission


def _arrivals_of_stations(ends: Array, values: Array, weight: Array, m: int) -> tuple[Array, Array]:
    """Return the mean value (M,) of each station's rows of one pulse, metres, and its inverse standard deviation (M,).

    `ends` (q, 2) are the stations of the q rows. `values` (q,) and `weight` (q,) are their values and inverse
    variances. `m` is the number of stations.
    """
    total, sums = np.zeros(m), np.zeros(m)
    np.add.at(total, ends[:, 0], weight)
    np.add.at(sums, ends[:, 0], weight * values)
    return np.divide(sums, total, out=np.zeros(m), where=total > 0.0), np.sqrt(total)


def _arrivals_of_differences(ends: Array, values: Array, weight: Array, m: int) -> tuple[Array, Array]:
    """Return the arrivals (M,), metres, and weights (M,) of the largest group of stations that differences link.

    The arrivals of one pulse have an unknown common constant; stations outside the group have weight 0.
    `ends`, `values`, `weight` and `m` are as in `_arrivals_of_stations`.
    """
    linked = np.zeros((m, m))
    np.add.at(linked, (ends[:, 0], ends[:, 1]), weight)
    _, group = connected_components(linked, directed=False)
    largest = np.bincount(group).argmax()
    inside = group[ends[:, 0]] == largest
    design = np.zeros((len(ends), m))
    design[np.arange(len(ends)), ends[:, 0]], design[np.arange(len(ends)), ends[:, 1]] = 1.0, -1.0
    design, values, weight = design[inside], values[inside], weight[inside]
    found = np.linalg.lstsq(design * np.sqrt(weight)[:, None], values * np.sqrt(weight), rcond=None)[0]
    # The weight of each difference is divided between its two stations.
    total = (np.abs(design) * weight[:, None]).sum(axis=0)
    return np.where(group == largest, found, 0.0), np.where(group == largest, np.sqrt(total / 2.0), 0.0)


@dataclass(frozen=True, slots=True)
class Starts:
    """Generator of starts for one network, used by `rounds`.

    `lik` is the likelihood of the network. `z`, `weight` and `emission` come from `arrivals`. `shift` (N,) is
    the median arrival of each pulse, and `spread` is the size of the network, both in metres. `rng` draws the
    random numbers.
    """

    lik: Likelihood
    z: Array
    weight: Array
    emission: Array
    shift: Array
    spread: float
    rng: np.random.Generator

    @property
    def dimension(self) -> int:
        """Return the number of dimensions, 2 or 3."""
        return self.lik.network.dimension

    def low_rank(self, count: int) -> tuple[NetworkEstimate, Array]:
        """Return networks from the low-rank fits of `count` random starts, and the fit number (S,) of each network.

        One fit can give several networks, or none.
        """
        net, d = self.lik.network, self.dimension
        # `full` marks the pulses with at least d + 3 arrivals, which the fit needs. The fit has no units: lengths are
        # divided by `spread`, and arrivals are relative to `shift`.
        full = (self.weight > 0.0).sum(axis=1) >= d + 3
        relative = self.weight / self.weight.max()
        begun = random_stations(self.rng, count, net.stations, d)
        z = (self.z - self.shift[:, None]) / self.spread
        fit = fit_low_rank(z[full], relative[full], self.emission[full], begun, clocks=not net.synchronised)
        keep = np.flatnonzero(fit.cost <= _NEARLY * np.nanmin(fit.cost))
        # starts with the same fit lead to the same network: keep the first
        order = keep[np.argsort(fit.cost[keep], kind="stable")]
        new = np.diff(fit.cost[order], prepend=-1.0) > 1e-6 * fit.cost[order] + 1e-24
        stations, pulses, which = upgrade(fit.take(order[new]))
        if not len(which):
            return _no_estimates(net), np.zeros(0, dtype=int)
        # The fit calls the clock of a station b and the offset of a pulse o.
        b = fit.stations.b[order[new]][which] * self.spread
        places = np.zeros((len(which), net.pulses, d))
        places[:, full] = pulses * self.spread
        # Pulses outside the fit start at the centre of the stations.
        places[:, ~full] = stations.mean(axis=1, keepdims=True) * self.spread
        offsets = np.zeros((len(which), net.pulses))
        offsets[:, full] = fit.pulses.o[order[new]][which] * self.spread
        offsets = np.where(self.emission, offsets + self.shift, 0.0)
        made = NetworkEstimate(stations * self.spread, b, places, offsets * net.emission)
        self._set_emission(made, ~full)
        return made, which

    def _set_emission(self, made: NetworkEstimate, few: Array) -> None:
        """Set the emission of pulses that the fit did not use (mask `few` (N,)) to the mean that fits their position.

        `made` is changed.
        """
        if few.any():
            apart = np.linalg.norm(made.stations[:, None] - made.pulses[:, few, None], axis=-1)
            weight = self.weight[few] / np.maximum(self.weight[few].sum(axis=1, keepdims=True), 1e-300)
            offset = ((self.z[few] - apart) * weight).sum(axis=-1)
            made.emission[:, few] = offset * self.lik.network.emission[few]

    def random(self, count: int) -> NetworkEstimate:
        """Return `count` networks with random positions; the arrivals determine the size of the area."""
        net, d = self.lik.network, self.dimension
        size = np.full(d, self.spread)
        box = np.ones((count, 1, d)) * size
        # In every second network, the last axis has only 30 % of the size: stations are often nearly flat.
        box[::2, :, -1] *= 0.3
        stations = (self.rng.random((count, net.stations, d)) - 0.5) * box
        pulses = (self.rng.random((count, net.pulses, d)) - 0.5) * box
        apart = np.linalg.norm(stations[:, None] - pulses[:, :, None], axis=-1)
        weight = self.weight / np.maximum(self.weight.sum(axis=1, keepdims=True), 1e-300)
        offset = ((self.z - apart) * weight).sum(axis=-1)
        return NetworkEstimate(stations, np.zeros((count, net.stations)), pulses, offset * net.emission)

    def ends(self, at: NetworkEstimate, start: Array) -> RoundEnds:
        """Return the minima of refined networks; both mirror images are aligned with prior coordinates, if any.

        `at` are S networks, and `start` (S,) are the numbers of their starts.
        """
        net = self.lik.network
        if np.isfinite(net.place_sigma).any():
            free = replace(net, place_sigma=np.full(net.place.shape, np.inf), place=np.zeros(net.place.shape))
            rough, _ = likelihood(free).refine(at, _ROUGH)
            at, start = laid(rough, net, self.rng), np.tile(start, 2)
        found, cost = self.lik.refine(at)
        return RoundEnds(found, cost, start)


def _no_estimates(net: Network) -> NetworkEstimate:
    """Return an empty set of estimates (S = 0)."""
    m, n, d = net.stations, net.pulses, net.dimension
    return NetworkEstimate(np.zeros((0, m, d)), np.zeros((0, m)), np.zeros((0, n, d)), np.zeros((0, n)))


def starts_of(lik: Likelihood, seed: int) -> Starts:
    """Return the generator of starts for a network; `seed` is the seed of its random numbers.

    `lik` is the likelihood of the network. The extent of a pulse is its largest range, or the difference between
    its last and first arrivals. The size of the network is the 90 % quantile of these extents.
    """
    z, weight, emission = arrivals(lik.network)
    measured = weight > 0.0
    shift = np.where(emission, [np.median(z[j, measured[j]]) if measured[j].any() else 0.0 for j in range(len(z))], 0.0)
    high = np.where(measured, z, -np.inf).max(axis=1) - np.where(emission, np.where(measured, z, np.inf).min(axis=1), 0)
    finite = high[np.isfinite(high) & (high > 0.0)]
    spread = float(np.quantile(finite, 0.9)) if finite.size else 1.0
    return Starts(lik, z, weight, emission, shift, spread, np.random.default_rng(seed))


def rounds(starts: Starts) -> Iterator[tuple[int, RoundEnds]]:
    """Yield, for each round, the number of starts so far and the minima that the starts of this round reach.

    The starts are low-rank fits and random positions. The rounds never end; the caller stops the iteration.
    """
    net, d = starts.lik.network, starts.dimension
    full = int(((starts.weight > 0.0).sum(axis=1) >= d + 3).sum())
    able = net.stations >= d + 3 and full > 0 and max(net.stations, full) >= unknowns(d)
    # `able`: a low-rank fit has enough stations and pulses. `patient`: the first round has only random positions.
    begun, patient = 0, net.stations >= _MANY
    while True:
        at, start = starts.random(_RANDOM), np.arange(_RANDOM) + begun
        begun += _RANDOM
        if able and not patient:
            # one batch refines all starts together
            fits, which = starts.low_rank(_LOW_RANK)
            at, start = together(fits, at), np.concatenate([which + begun, start])
            begun += _LOW_RANK
        patient = False
        yield begun, starts.ends(at, start)


def laid(at: NetworkEstimate, net: Network, rng: np.random.Generator) -> NetworkEstimate:
    """Return networks aligned with the prior coordinates of the stations: S networks, then their S mirror images.

    A free network fits in any frame, and its mirror image fits too. The prior coordinates select the frame
    and the side.

    Parameters
    ----------
    at : NetworkEstimate
        S networks.
    net : Network
        A network with prior coordinates; each coordinate can be known alone.
    rng : numpy.random.Generator
        Draws the initial orientations.

    Returns
    -------
    NetworkEstimate
        2 S networks; coordinates that are known exactly have their known values.
    """
    d = net.dimension
    mirror = np.ones(d)
    mirror[-1] = -1.0
    both = together(at, replace(at, stations=at.stations * mirror, pulses=at.pulses * mirror))
    middle = both.stations.mean(axis=1, keepdims=True)
    points, pulses = both.stations - middle, both.pulses - middle
    extent = np.sqrt(np.mean(points**2)) or 1.0
    weight = 1.0 / np.maximum(net.place_sigma, _LOOSE * extent)
    turn, move = _align(points, net.place, weight, rng)
    stations = points @ np.swapaxes(turn, 1, 2) + move[:, None]
    exact = net.place_sigma <= 0.0
    return replace(
        both,
        stations=np.where(exact, net.place, stations),
        pulses=pulses @ np.swapaxes(turn, 1, 2) + move[:, None],
    )


def _align(points: Array, place: Array, weight: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return rotations (S, d, d) and shifts (S, d) that minimise the weighted distance from known coordinates.

    `points` (S, M, d) are centred stations, and `place` (M, d) are the known coordinates, metres. `weight`
    (M, d) are inverse standard deviations, 0 for unknown coordinates. Gauss-Newton steps start from `_TURNS`
    random rotations (from `rng`), because there can be several minima.
    """
    s, m, d = points.shape
    # Axes: S networks, `_TURNS` starts (t), M stations, d coordinates, rotation generators (g). The random matrices are
    # orthogonal; a change of one sign makes each of them a rotation.
    generators = np.array([_generator(i, k, d) for i in range(d) for k in range(i)])
    turn = np.linalg.qr(rng.standard_normal((_TURNS, d, d)))[0]
    turn[np.linalg.det(turn) < 0, 0] *= -1.0
    turn = np.broadcast_to(turn, (s, _TURNS, d, d)).copy()
    known = weight > 0.0
    centre = np.where(known.any(axis=0), (place * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300), 0.0)
    move = np.broadcast_to(centre, (s, _TURNS, d)).copy()
    for _ in range(_LAID):
        turned = points[:, None] @ np.swapaxes(turn, -1, -2)
        residual = ((place - turned - move[:, :, None]) * weight).reshape(s, _TURNS, m * d)
        # `spun` and `shifts` are the whitened derivatives of the stations by the rotation and by the shift.
        spun = np.einsum("gab,stmb->stmag", generators, turned) * weight[..., None]
        shifts = np.broadcast_to(np.eye(d) * weight[..., None], (s, _TURNS, m, d, d))
        columns = np.concatenate([spun, shifts], axis=-1).reshape(s, _TURNS, m * d, -1)
        normal = np.swapaxes(columns, -1, -2) @ columns
        # `diagonal` is a view of the normal matrix. The small terms keep the matrix regular if some coordinates are
        # unknown.
        diagonal = np.einsum("stii->sti", normal)
        diagonal += 1e-6 * diagonal + 1e-9 * diagonal.max(axis=-1, keepdims=True) + 1e-290
        gradient = np.einsum("stqp,stq->stp", columns, residual)
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        half = 0.5 * np.einsum("stg,gab->stab", step[..., : len(generators)], generators)
        # the Cayley map gives a rotation for any step
        turn = np.linalg.solve(np.eye(d) - half, (np.eye(d) + half) @ turn)
        move = move + step[..., len(generators) :]
    turned = points[:, None] @ np.swapaxes(turn, -1, -2)
    cost = (((place - turned - move[:, :, None]) * weight) ** 2).sum(axis=(2, 3))
    best = np.nanargmin(np.where(np.isfinite(cost), cost, 1e300), axis=1)
    every = np.arange(s)
    return turn[every, best], move[every, best]


def _generator(i: int, k: int, d: int) -> Array:
    """Return the skew-symmetric matrix (d, d) of a rotation in the plane of axes i and k."""
    out = np.zeros((d, d))
    out[i, k], out[k, i] = 1.0, -1.0
    return out
