"""Fixes of a single station or pulse of a network while all others are fixed, with the proof of an ordinary fix.

A block is one station or one pulse. Its partners are the stations and pulses that share rows with it. So
a block is a fix from its partners, which are the stations of this fix.

Letters: M stations, N pulses, R slots (columns of measurements), S estimates, B blocks with K start positions
each, n selected pulses or stations, q rows of a block, d coordinates. A clock is an offset times the
propagation speed, metres.

Arguments of many functions: `net` is the network, `lik` is its likelihood, and `at` are estimates of all
unknowns (one estimate, S = 1, unless a function says otherwise).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.engine import refine, vectors
from optloc.models import MODELS
from optloc.problem import GLOBAL, Array, Fix, Measured, Prior, Problem, assemble, measured
from optloc.sites.calibration.likelihood import Likelihood, NetworkEstimate, clock_signs, together
from optloc.sites.calibration.network import Network
from optloc.solvers import AMBIGUOUS_GAP, equal_cost, solve

MOVED = 16.0
"""Largest extra cost of a block at another position for a refinement of the whole network from there. If the cost rises
by more than four sigma while the others are fixed, a joint refinement hardly ever ends below the present cost."""

# Steps of a single block, and step length in standard deviations at which it ends: most blocks are then close
# to their minimum, and the joint refinement does the rest.
_ALONE, _LAST = 30, 1e-3
# Number of rows above which the proof of a station starts at its present position.
_MANY = 100
# Distance, as a share of the spread, below which two positions are the same.
_APART = 1e-3

# Difference of cost below which two positions are the same: a tenth of a standard deviation of one measurement.
_ALIKE = 0.01

# Standard deviation, as a share of the spread, of an exact coordinate if other coordinates are unknown.
_EXACT = 1e-7


@dataclass(frozen=True, slots=True)
class StationBlock:
    """The proof and the other positions of one station or pulse while all others are fixed.

    Parameters
    ----------
    name : str
        Description, for instance "station A3".
    station : bool
        True for a station, False for a pulse.
    index : int
        Number of the station or pulse.
    proven : bool
        Whether it is proven that no other position costs less, and that all positions within `AMBIGUOUS_GAP` are
        listed.
    cheapest : bool
        Whether it is proven that no other position costs less.
    refuted : bool
        Whether another position costs less.
    gaps : tuple of float
        Costs (chi-square) of the other positions minus the cost of the present position.
    places : array (q, d)
        The other positions, metres, in the order of `gaps`.
    """

    name: str
    station: bool
    index: int
    proven: bool
    cheapest: bool
    refuted: bool
    gaps: tuple[float, ...]
    places: Array


def blocks(lik: Likelihood, at: NetworkEstimate) -> tuple[StationBlock, ...]:
    """Return the proof of each pulse and of each station that is not exact, while all others are fixed.

    Stations come first. `lik` is the likelihood of the network and `at` is one estimate, S = 1. Each proof is
    the proof of a fix from known stations; it does not exclude that several blocks move together.
    """
    net = lik.network
    d, cost, found = net.dimension, float(lik.cost(at)[0]), list[StationBlock]()
    fixes = _station_fixes(net, at, _inexact_stations(net))
    if fixes:
        costs = lik.cost(together(*(_moved_station(lik, at, i, fix.position[:d]) for i, fix in fixes)))
        for (i, fix), best in zip(fixes, costs, strict=True):
            name = f"station {net.names[i]}"
            found.append(_block_of_fix(fix, i, name, station=True, here=at.stations[0, i], above=cost - float(best)))
    fix = place_pulses(net, at, np.arange(net.pulses))
    # pulses do not affect each other, so all of them move at once
    before = (lik.residual(at)[0] ** 2).sum(axis=1)
    after = (lik.residual(moved_pulses(lik, at, np.arange(net.pulses), fix.position))[0] ** 2).sum(axis=1)
    for j in range(net.pulses):
        above = float(before[j] - after[j])
        name = f"pulse {net.labels[j]}"
        found.append(_block_of_fix(fix[j], j, name, station=False, here=at.pulses[0, j], above=above))
    return tuple(found)


def _inexact_stations(net: Network) -> list[int]:
    """Return the numbers of the stations with a coordinate that is not known exactly."""
    return [i for i in range(net.stations) if (net.place_sigma[i] > 0.0).any()]


def mirrored(problem: Problem, here: Array) -> Array:
    """Return mirror positions (B, d + 1, d) of blocks: in the principal planes of their partners, and in their centre.

    `problem` is a batch of B blocks, and `here` (B, d) are their positions, metres. Flat partners make a
    block ambiguous, so its other minimum is often close to a mirror position.
    """
    partners = problem.stations.position[..., 0, np.concatenate([rows.a for rows in problem.rows]), :]
    weight = np.broadcast_to(problem.weight > 0.0, (len(here), problem.count))
    weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1)
    middle = (weight[:, None] @ partners)[:, 0]
    centred = (partners - middle[:, None]) * np.sqrt(weight)[..., None]
    axes = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)[1]
    along = np.einsum("bd,bdk->bk", here - middle, axes)
    # `along` are the coordinates of a block in the principal axes: a mirror image changes the sign of one of them.
    single = here[:, None] - 2.0 * along[..., None] * np.swapaxes(axes, 1, 2)
    return np.concatenate([single, (2.0 * middle - here)[:, None]], axis=1)


def minima(problem: Problem, places: Array) -> tuple[Array, Array]:
    """Return the minima (B, K, size) that refinements of blocks reach from start positions, and their costs (B, K).

    `problem` is a batch of B blocks, and `places` (B, K, d) are the start positions, metres. `size` is the
    number of unknowns of a block: d, plus one for an emission time or a clock.
    """
    count, each = places.shape[:2]
    start = vectors(problem, places).reshape(count * each, -1)
    done = refine(problem, start, item=np.repeat(np.arange(count), each), tolerance=_LAST, limit=_ALONE)
    return done.x.reshape(count, each, -1), done.cost.reshape(count, each)


def elsewhere(lik: Likelihood, at: NetworkEstimate) -> tuple[StationBlock, ...]:
    """Return the likeliest other positions of each station and pulse, without a proof.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : NetworkEstimate
        One minimum, S = 1.

    Returns
    -------
    tuple of StationBlock
        One block for each other position that costs at most `MOVED` more. The refinement starts from mirror images
        in the principal planes and in the centre of the block's partners.
    """
    net = lik.network
    stations, d = np.array(_inexact_stations(net), dtype=int), net.dimension
    # Entries: True for stations, numbers, present positions, and the batch of their fixes.
    groups = [(False, np.arange(net.pulses), at.pulses[0], pulses_alone(net, at))]
    if stations.size:
        groups.append((True, stations, at.stations[0, stations], stations_alone(net, at, stations)))
    near = _APART * float(np.ptp(np.concatenate([at.stations[0], at.pulses[0]]), axis=0).max())
    found = []
    for station, which, here, problem in groups:
        # Start 0 is the present position: its cost is the reference of the gaps.
        x, cost = minima(problem, np.concatenate([here[:, None], mirrored(problem, here)], axis=1))
        x, gap = x[:, 1:, :d], np.where(np.isfinite(cost[:, 1:]), cost[:, 1:] - cost[:, :1], np.inf)
        for n in np.flatnonzero(gap.min(axis=1) <= MOVED):
            places: list[Array] = []
            for k in np.flatnonzero(gap[n] <= MOVED):
                if all(np.linalg.norm(x[n, k] - other) > near for other in (here[n], *places)):
                    places.append(x[n, k])
                    name = f"station {net.names[which[n]]}" if station else f"pulse {net.labels[which[n]]}"
                    block = StationBlock(
                        name,
                        station,
                        int(which[n]),
                        proven=False,
                        cheapest=False,
                        refuted=bool(gap[n, k] < 0.0),
                        gaps=(float(gap[n, k]),),
                        places=x[n, k][None],
                    )
                    found.append(block)
    return tuple(found)


def pulses_alone(net: Network, at: NetworkEstimate, which: Array | None = None) -> Problem:
    """Return n pulses of S estimates (all pulses by default) as a batch of S n fixes from fixed stations.

    `which` (n,) are the numbers of the pulses. The clocks of the stations are subtracted from the measurements.
    """
    which = np.arange(net.pulses) if which is None else which
    first, second, sign = clock_signs(net)
    tick = (sign[0] * at.clocks[:, first] + sign[1] * at.clocks[:, second])[:, None]
    z, given = (net.z[which] - tick).reshape(-1, len(net.slots)), np.tile(net.given[which], (at.count, 1))
    sigma, kinds = np.tile(net.sigma[which], (at.count, 1)), np.array([slot.kind for slot in net.slots])
    rows = []
    for kind in dict.fromkeys(kinds.tolist()):
        slots = np.flatnonzero(kinds == kind)
        ends = {"a": first[slots], "b": second[slots]}
        rows.append(_masked_rows(kind, z[:, slots], sigma[:, slots], given[:, slots], **ends))
    one = at.count == 1
    return assemble(at.stations[0] if one else np.repeat(at.stations, len(which), axis=0)[:, None], *rows).flat()


def _masked_rows(kind: str, z: Array, sigma: Array, given: Array, **ends: Array) -> Measured:
    """Return rows (B, q) of one kind for B blocks; rows that are not given have weight 0.

    `z` and `sigma` (B, q) are values and standard deviations, metres. `given` (B, q) marks the measured
    entries. `ends` are the stations `a` and, if the kind needs them, `b` of each row (q,).
    """
    deviation, weight = _common_row(np.where(given, sigma, 1.0)), _common_row(given.astype(float))
    return measured(kind, np.where(given, z, 0.0), sigma=deviation, weight=weight, **ends)


def settled(net: Network, at: NetworkEstimate) -> NetworkEstimate:
    """Return the estimates with their pulses, and emission times, at the best fit to the fixed stations."""
    problem = pulses_alone(net, at)
    done = minima(problem, at.pulses.reshape(-1, 1, net.dimension))[0].reshape(at.count, net.pulses, -1)
    d = net.dimension
    return replace(at, pulses=done[..., :d], emission=done[..., d] if done.shape[-1] > d else at.emission)


def stations_alone(net: Network, at: NetworkEstimate, which: Array) -> Problem:
    """Return stations as a batch of fixes from the pulses and the other stations, which are fixed.

    `at` is one estimate, S = 1. `which` (n,) are the numbers of the stations. Their prior positions become
    priors of the fixes.
    """
    places, kinds = _station_rows(net, at)
    rows = []
    for kind, ends, sigma, z in kinds:
        given = np.isfinite(sigma[which])
        if given.any():
            rows.append(_masked_rows(kind, z[which], sigma[which], given, a=ends))
    has_prior = np.isfinite(net.place_sigma[which])
    # the prior covers all coordinates of a station, so unknown coordinates get a wide one
    spread = float(np.ptp(places, axis=0).max()) or 1.0
    sigma = np.clip(net.place_sigma[which], _EXACT * spread, 1e6 * spread)
    prior = Prior("position", net.place[which], sigma[..., None] ** 2 * np.eye(net.dimension))
    return assemble(places, *rows, priors=(prior,) if has_prior.any() else ()).flat()


def _block_of_fix(fix: Fix, index: int, name: str, station: bool, here: Array, above: float) -> StationBlock:
    """Return the proof and the other positions of a block from its fix.

    `index`, `name` and `station` are as in `StationBlock`. `here` (d,) is the present position, metres.
    `above` is the cost of the present position minus the cost of the fix.
    """
    claims, d = fix.claims, len(here)
    # The candidates are the fix (gap 0) and its alternatives.
    x = np.concatenate([fix.position[None, :d], fix.alternatives.x.reshape(-1, fix.x.shape[-1])[:, :d]])
    gaps = np.concatenate([[0.0], fix.alternatives.gap.ravel()])
    kept = np.isfinite(gaps) & np.isfinite(x).all(axis=1)
    x, gaps = x[kept], gaps[kept]
    # The present position is in this list, unless it is no minimum or its cost is above the limit of the list.
    alike = np.abs(gaps - above) <= _ALIKE + equal_cost(float(fix.cost))
    apart = np.where(alike, np.linalg.norm(x - here, axis=1), np.inf)
    others = np.arange(len(x)) != (apart.argmin() if alike.any() else -1)
    refuted = above > _ALIKE + equal_cost(float(fix.cost))
    cheapest = claims.proof.item() == GLOBAL and not refuted
    proven = cheapest and claims.margin.item() >= AMBIGUOUS_GAP
    return StationBlock(name, station, index, proven, cheapest, refuted, tuple(gaps[others] - above), x[others])


def place_pulses(net: Network, at: NetworkEstimate, which: Array, method: str = "auto") -> Fix:
    """Return a batch of n fixes of pulses from fixed stations.

    `at` is one estimate (S = 1); only its stations and clocks are used. `which` (n,) selects the pulses. `method`
    is a method of `optloc.solve`.
    """
    return solve(pulses_alone(net, at, which), method)


def _common_row(values: Array) -> Array:
    """Return values (n, q) as one row (q,) if all rows are equal; values that all problems share need less memory."""
    return np.asarray(values[0]) if (values == values[0]).all() else values


def _station_rows(net: Network, at: NetworkEstimate) -> tuple[Array, list[tuple[str, Array, Array, Array]]]:
    """Return the positions (N + M, d) of pulses and stations, and the rows of all stations for each kind.

    The rows of a kind are a tuple: kind, numbers (q,) of the partners, standard deviations (M, q) and values
    (M, q), metres. A partner is a pulse (0 to N - 1) or a station (N and above). The standard deviation is
    infinite without a measurement.
    """
    timed, ranged = _ranges_to_pulses(net, at)
    near = np.full((net.stations, net.stations), np.inf), np.zeros((net.stations, net.stations))
    for (i, k), distance, sigma in zip(net.between, net.distance, net.distance_sigma, strict=True):
        for one, other in ((i, k), (k, i)):
            near[0][one, other], near[1][one, other] = sigma, distance
    # An unknown clock has the same effect on a station's rows as an emission time on a pulse's rows: kind toa.
    kinds = [("range" if net.synchronised else "toa", np.arange(net.pulses), *timed)]
    kinds.append(("range", np.arange(net.pulses), *ranged))
    kinds.append(("range", net.pulses + np.arange(net.stations), *near))
    return np.concatenate([at.pulses[0], at.stations[0]]), kinds


def _station_fixes(net: Network, at: NetworkEstimate, which: list[int]) -> list[tuple[int, Fix]]:
    """Return pairs of a station number and its fix from fixed pulses and stations; `which` are the station numbers.

    Stations without a prior are one batch. Each station with a prior is solved alone.
    """
    has_prior = np.isfinite(net.place_sigma[which]).any(axis=1) if which else np.zeros(0, dtype=bool)
    plain = np.array(which, dtype=int)[~has_prior]
    free = _fixes_with_proof(stations_alone(net, at, plain), at.stations[0, plain]) if plain.size else None
    out = [(int(i), free[n]) for n, i in enumerate(plain) if free is not None]
    known = np.array(which, dtype=int)[has_prior]
    return out + [(int(i), solve(stations_alone(net, at, np.array([i])))[0]) for i in known]


def _fixes_with_proof(problem: Problem, here: Array) -> Fix:
    """Return fixes of a batch of blocks (`problem`) with their proof.

    With more than `_MANY` rows, the refinement starts from the present positions `here` (n, d), metres, because
    a search needs matrices of all rows.
    """
    if problem.count <= _MANY:
        return solve(problem)
    start = np.zeros((len(here), problem.layout.size))
    start[:, : here.shape[1]] = here
    return solve(problem, "lsr+certify", start=start)


def _ranges_to_pulses(net: Network, at: NetworkEstimate) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return sigmas and values (M, N) of the ranges from stations to pulses, in two pairs.

    The first pair contains the clock of the station (kinds toa and tdoa); the second pair does not (kind
    range). Several rows of one pulse are combined to their mean, weighted by inverse variance. Sigma is
    infinite without a row.
    """
    m, n = net.stations, net.pulses
    information, sums = np.zeros((2, m, n)), np.zeros((2, m, n))
    apart = np.linalg.norm(at.stations[0][:, None] - at.pulses[0][None], axis=-1) + at.clocks[0][:, None]
    for r, slot in enumerate(net.slots):
        weight = np.where(net.given[:, r], net.sigma[:, r] ** -2.0, 0.0)
        z = net.z[:, r]
        ends: tuple[tuple[int, Array], ...]
        # A difference gives an arrival at one station if the distance from the other station is known.
        if slot.kind == "tdoa":
            ends = ((slot.a, z + apart[slot.b]), (slot.b, apart[slot.a] - z))
        else:
            ends = ((slot.a, z - (at.emission[0] if slot.kind == "toa" else 0.0)),)
        for i, value in ends:
            information[int(slot.kind == "range"), i] += weight
            sums[int(slot.kind == "range"), i] += weight * value
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.where(information > 0.0, sums / information, 0.0)
        sigma = information**-0.5
    return (sigma[0], values[0]), (sigma[1], values[1])


def moved(lik: Likelihood, at: NetworkEstimate, block: StationBlock, place: Array) -> NetworkEstimate:
    """Return an estimate with one block at another position, and with the clock or emission time that fits there.

    `at` is one estimate (S = 1), and `place` (d,) is the position, metres.
    """
    if block.station:
        return _moved_station(lik, at, block.index, place)
    return moved_pulses(lik, at, np.array([block.index]), place[None])


def moved_pulses(lik: Likelihood, at: NetworkEstimate, which: Array, places: Array) -> NetworkEstimate:
    """Return an estimate (S = 1) with some pulses at other positions, with the emission times that fit there.

    `which` (n,) are the numbers of the pulses, and `places` (n, d) are the positions, metres. A pulse whose
    new position is NaN does not move.
    """
    net, pulses, emission = lik.network, at.pulses.copy(), at.emission.copy()
    pulses[0, which] = np.where(np.isfinite(places), places, pulses[0, which])
    there = replace(at, pulses=pulses)
    emits = np.array([MODELS[slot.kind].emission for slot in net.slots])
    emission[0, which] += _best_change(lik.residual(there)[0, which], (emits / net.sigma)[which])
    return replace(there, emission=np.where(net.emission, emission, at.emission))


def _moved_station(lik: Likelihood, at: NetworkEstimate, i: int, place: Array) -> NetworkEstimate:
    """Return an estimate (S = 1) with station `i` at the position `place` (d,), metres.

    Its clock is changed to the value that fits there best. A coordinate of `place` that is NaN does not change.
    """
    stations, clocks, net = at.stations.copy(), at.clocks.copy(), lik.network
    stations[0, i] = np.where(np.isfinite(place), place, stations[0, i])
    there = replace(at, stations=stations)
    if net.synchronised:
        return there
    first, second, sign = clock_signs(net)
    sign_here = np.where(first == i, sign[0], 0.0) + np.where(second == i, sign[1], 0.0)
    clocks[0, i] += _best_change(lik.residual(there)[0].ravel(), (sign_here / net.sigma).ravel())
    return replace(there, clocks=clocks)


def _best_change(residual: Array, slope: Array) -> Array:
    """Return the change (...) of an unknown that best fits whitened residuals (..., q) with given slopes (..., q).

    A slope is the derivative of a whitened measurement by the unknown, 1 / m. Least squares gives the change,
    metres.
    """
    return np.asarray((residual * slope).sum(axis=-1) / np.maximum((slope**2).sum(axis=-1), 1e-300))
