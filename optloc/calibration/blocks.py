"""One station or pulse at a time, the others held: an ordinary fix, with the proof that ordinary fixes have."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array, Prior
from optloc.calibration.descent import EASE, FIRST, FLOOR, LEAST, MOST, NOTHING, STIFFEN
from optloc.calibration.likelihood import Estimate, Likelihood
from optloc.calibration.network import Network
from optloc.problem.build import assemble, measured
from optloc.problem.claims import GLOBAL
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers import solve
from optloc.solvers.policy import AMBIGUOUS_GAP, equal_cost

MOVED = 16.0
"""Cost that a block's other place may have beyond its present one for all to be refined from there: what is dearer by
four sigma with the others held hardly ends below when they move as well."""

# Steps of a block alone from a mirrored place: most are near their minimum then, and the rest is refined with
# all others anyway.
_ALONE = 15
# Rows above which a station's proof begins where it is.
_MANY = 100
# Share of the spread below which two places are one.
_APART = 1e-3

# Cost that tells no two places apart: a tenth of a sigma of one number.
_ALIKE = 0.01

# Deviation, as a share of the spread, of a coordinate that is known exactly beside others that are not.
_EXACT = 1e-7


@dataclass(frozen=True, slots=True)
class Block:
    """What became of one station or pulse with the others held.

    Parameters
    ----------
    name : str
        In words, for instance "station A3".
    station : bool
        A station, or else a pulse.
    index : int
        Which.
    proven : bool
        That no other place costs less, and none within `AMBIGUOUS_GAP` but those listed.
    cheapest : bool
        That no other place costs less.
    refuted : bool
        That another place costs less.
    gaps : tuple of float
        Cost of other places beyond the present one's.
    places : array (q, d)
        These places.
    """

    name: str
    station: bool
    index: int
    proven: bool
    cheapest: bool
    refuted: bool
    gaps: tuple[float, ...]
    places: Array


def blocks(lik: Likelihood, at: Estimate) -> tuple[Block, ...]:
    """Return what is proven of each station that is not known exactly, and of each pulse, with all others held.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : Estimate
        One estimate, S = 1.

    Returns
    -------
    tuple of Block
        Stations first. The proof is that of a fix from known stations; it does not exclude that several blocks move
        together.
    """
    net = lik.network
    d, cost = net.dimension, float(lik.cost(at)[0])
    found = []
    for i, fix in _stations(net, at, _sought(net)):
        at_best = _moved_station(lik, at, i, fix.position[:d])
        above = cost - float(lik.cost(at_best)[0])
        found.append(_block(fix, i, f"station {net.names[i]}", True, at.stations[0, i], above))
    fix = place_pulses(net, at, np.arange(net.pulses))
    # pulses do not know of each other: all are moved at once
    before = (lik.residual(at)[0] ** 2).sum(axis=1)
    after = (lik.residual(moved_pulses(lik, at, np.arange(net.pulses), fix.position))[0] ** 2).sum(axis=1)
    for j in range(net.pulses):
        above = float(before[j] - after[j])
        found.append(_block(fix[j], j, f"pulse {net.labels[j]}", False, at.pulses[0, j], above))
    return tuple(found)


def _sought(net: Network) -> list[int]:
    return [i for i in range(net.stations) if (net.place_sigma[i] > 0.0).any()]


@dataclass(frozen=True, slots=True)
class Points:
    """Blocks that see the same partners: B blocks, Q rows ``gain_0 |x - one| + gain_1 |x - two| + offset``."""

    one: Array  # (Q, d)
    two: Array
    gains: Array  # (2, Q)
    offset: Array  # (B, Q) what the block's own clock or emission counts
    value: Array  # (B, Q)
    root: Array
    place: Array  # (B, d) what is known of the place, and its inverse standard deviation
    prior: Array

    def equations(self, x: Array, t: Array) -> tuple[Array, Array]:
        """Return whitened residuals (B, K, Q + d) and derivatives (B, K, Q + d, d + 1) at places and offsets."""
        shape = (*x.shape[:2], self.one.shape[0])
        predicted = t[..., None] * self.offset[:, None]
        slope = np.zeros((*shape, x.shape[-1] + 1))
        for end, gain in zip((self.one, self.two), self.gains, strict=True):
            line = x[:, :, None] - end
            length = np.maximum(np.sqrt(np.sum(line * line, axis=-1)), 1e-300)
            predicted = predicted + gain * length
            slope[..., :-1] += line * (gain / length)[..., None]
        slope[..., -1] = self.offset[:, None]
        root = self.root[:, None]
        known = np.zeros((*x.shape, x.shape[-1] + 1))
        every = np.arange(x.shape[-1])
        known[..., every, every] = self.prior[:, None]
        off = (self.place[:, None] - x) * self.prior[:, None]
        residual = np.concatenate([(self.value[:, None] - predicted) * root, off], axis=-1)
        return residual, np.concatenate([slope * root[..., None], known], axis=-2)

    def repeated(self, count: int) -> Points:
        """Return each block `count` times in a row."""
        names = ("offset", "value", "root", "place", "prior")
        return replace(self, **{name: np.repeat(getattr(self, name), count, axis=0) for name in names})

    def mirrored(self, here: Array) -> Array:
        """Return places (B, K, d) mirrored in the partners' principal planes, and in their centre."""
        weight = (self.root > 0.0) / np.maximum((self.root > 0.0).sum(axis=1, keepdims=True), 1)
        middle = weight @ self.one
        centred = (self.one - middle[:, None]) * np.sqrt(weight)[..., None]
        axes = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)[1]
        along = np.einsum("bd,bdk->bk", here - middle, axes)
        single = here[:, None] - 2.0 * along[..., None] * np.swapaxes(axes, 1, 2)
        return np.concatenate([single, (2.0 * middle - here)[:, None]], axis=1)

    def settled(self, x: Array, t: Array | None = None) -> tuple[Array, Array, Array]:
        """Return minima (B, K, d) that places lead to, their offsets and costs (B, K)."""
        if t is None:
            weight = self.root**2 * self.offset
            residual = self.equations(x, np.zeros(x.shape[:2]))[0][..., : self.one.shape[0]]
            total = np.maximum((weight * self.offset).sum(axis=1), 1e-300)[:, None]
            t = np.einsum("bkq,bq->bk", residual, self.root * self.offset) / total
        damping = np.full(t.shape, FIRST)
        residual, slope = self.equations(x, t)
        cost = np.sum(residual**2, axis=-1)
        for _ in range(_ALONE):
            normal = np.swapaxes(slope, -1, -2) @ slope
            diagonal = np.einsum("bkii->bki", normal)
            diagonal += damping[..., None] * diagonal + FLOOR * diagonal.max(axis=-1, keepdims=True) + NOTHING
            step = np.linalg.solve(normal, np.einsum("bkqi,bkq->bki", slope, residual)[..., None])[..., 0]
            there, late = x + step[..., :-1], t + step[..., -1]
            after, change = self.equations(there, late)
            new = np.sum(after**2, axis=-1)
            good = new < cost
            x, t, cost = np.where(good[..., None], there, x), np.where(good, late, t), np.where(good, new, cost)
            residual = np.where(good[..., None], after, residual)
            slope = np.where(good[..., None, None], change, slope)
            damping = np.clip(np.where(good, damping * EASE, damping * STIFFEN), LEAST, MOST)
        return x, t, cost


def elsewhere(lik: Likelihood, at: Estimate) -> tuple[Block, ...]:
    """Return the likeliest other places of each station and pulse, the others held: nothing is proven.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : Estimate
        One minimum, S = 1.

    Returns
    -------
    tuple of Block
        Those that have other places, found from mirror images in the principal planes of their partners.
    """
    net = lik.network
    stations = np.array(_sought(net), dtype=int)
    groups = [(False, np.arange(net.pulses), at.pulses[0], pulses_alone(lik, at))]
    if stations.size:
        groups.append((True, stations, at.stations[0, stations], stations_alone(lik, at, stations)))
    near = _APART * float(np.ptp(np.concatenate([at.stations[0], at.pulses[0]]), axis=0).max())
    found = []
    for station, which, here, points in groups:
        x, _, cost = points.settled(points.mirrored(here))
        gap = cost - points.settled(here[:, None])[2]
        for n in np.flatnonzero(gap.min(axis=1) <= MOVED):
            places: list[Array] = []
            for k in np.flatnonzero(gap[n] <= MOVED):
                if all(np.linalg.norm(x[n, k] - other) > near for other in (here[n], *places)):
                    places.append(x[n, k])
                    name = f"station {net.names[which[n]]}" if station else f"pulse {net.labels[which[n]]}"
                    lower, gaps = bool(gap[n, k] < 0.0), (float(gap[n, k]),)
                    found.append(Block(name, station, int(which[n]), False, False, lower, gaps, x[n, k][None]))
    return tuple(found)


def pulses_alone(lik: Likelihood, at: Estimate) -> Points:
    """Return the pulses as blocks whose stations are held."""
    stations, clocks, net = at.stations[0], at.clocks[0], lik.network
    tick = lik.ticks[0] * clocks[lik.first] + lik.ticks[1] * clocks[lik.second]
    nothing = np.zeros((net.pulses, net.dimension))
    offset = lik.emits * lik.emission[:, None]
    one, two = stations[lik.first], stations[lik.second]
    return Points(one, two, lik.gains, offset, net.z - tick, lik.root, nothing, nothing)


def stations_alone(lik: Likelihood, at: Estimate, which: Array) -> Points:
    """Return some stations as blocks, with pulses and the other stations held."""
    net = lik.network
    places, groups = _station_rows(net, at)
    ends = np.concatenate([ends for _, ends, _, _ in groups])
    timed = np.concatenate([np.full(len(ends), float(kind == "toa")) for kind, ends, _, _ in groups])
    value = np.concatenate([z[which] for _, _, _, z in groups], axis=1)
    with np.errstate(divide="ignore"):
        root = 1.0 / np.concatenate([sigma[which] for _, _, sigma, _ in groups], axis=1)
    gains = np.array([np.ones(len(ends)), np.zeros(len(ends))])
    offset = np.broadcast_to(timed, value.shape)
    one = places[ends]
    # a coordinate that is known exactly does not move
    exact = 1.0 / (_EXACT * (float(np.ptp(places)) or 1.0))
    prior = np.where(net.place_sigma[which] <= 0.0, exact, lik.prior[which])
    return Points(one, one, gains, offset, value, root, net.place[which], prior)


def _block(fix: Fix, index: int, name: str, station: bool, here: Array, above: float) -> Block:
    """Return a block from the fix that has its place: `above` is what the present place costs beyond the best."""
    claims, d = fix.claims, len(here)
    x = np.concatenate([fix.position[None, :d], fix.alternatives.x.reshape(-1, fix.x.shape[-1])[:, :d]])
    gaps = np.concatenate([[0.0], fix.alternatives.gap.ravel()])
    kept = np.isfinite(gaps) & np.isfinite(x).all(axis=1)
    x, gaps = x[kept], gaps[kept]
    # the present place is among those found, unless it is no minimum or too dear to be listed
    alike = np.abs(gaps - above) <= _ALIKE + equal_cost(float(fix.cost))
    apart = np.where(alike, np.linalg.norm(x - here, axis=1), np.inf)
    others = np.arange(len(x)) != (apart.argmin() if alike.any() else -1)
    refuted = above > _ALIKE + equal_cost(float(fix.cost))
    cheapest = claims.proof.item() == GLOBAL and not refuted
    proven = cheapest and claims.margin.item() >= AMBIGUOUS_GAP
    return Block(name, station, index, proven, cheapest, refuted, tuple(gaps[others] - above), x[others])


def place_pulses(net: Network, at: Estimate, which: Array, method: str = "auto") -> Fix:
    """Return fixes of some pulses from stations that are held.

    Parameters
    ----------
    net : Network
        What was measured.
    at : Estimate
        One estimate, S = 1; that of the pulses is not used.
    which : int array (n,)
        The pulses.
    method : str
        Of `optloc.solve`.

    Returns
    -------
    Fix
        A batch of n.
    """
    stations, clocks = at.stations[0], at.clocks[0]
    kinds = []
    for kind in dict.fromkeys(slot.kind for slot in net.slots):
        slots = np.array([r for r, slot in enumerate(net.slots) if slot.kind == kind])
        a = np.array([net.slots[r].a for r in slots])
        b = np.array([net.slots[r].b for r in slots])
        tick = 0.0 if kind == "range" else clocks[a] - (clocks[b] if kind == "tdoa" else 0.0)
        given = net.given[np.ix_(which, slots)]
        kinds.append(
            measured(
                kind,
                np.where(given, net.z[np.ix_(which, slots)] - tick, 0.0),
                a=a,
                b=b if kind == "tdoa" else None,
                sigma=_shared(np.where(given, net.sigma[np.ix_(which, slots)], 1.0)),
                weight=_shared(given.astype(float)),
            )
        )
    return solve(assemble(stations, *kinds), method)


def _shared(values: Array) -> Array:
    """Return values (n, q) as one row (q,) where all rows are equal: problems that share them are solved at once."""
    return np.asarray(values[0]) if (values == values[0]).all() else values


def _station_rows(net: Network, at: Estimate) -> tuple[Array, list[tuple[str, Array, Array, Array]]]:
    """Return places of all, and rows of stations: kind, which place, deviations and values (M, q)."""
    timed, ranged = _ranges(net, at)
    near = np.full((net.stations, net.stations), np.inf), np.zeros((net.stations, net.stations))
    for (i, k), distance, sigma in zip(net.between, net.distance, net.distance_sigma, strict=True):
        for one, other in ((i, k), (k, i)):
            near[0][one, other], near[1][one, other] = sigma, distance
    # clocks that are sought are to a station what the time of emission is to a pulse
    kinds = [("range" if net.synchronised else "toa", np.arange(net.pulses), *timed)]
    kinds.append(("range", np.arange(net.pulses), *ranged))
    kinds.append(("range", net.pulses + np.arange(net.stations), *near))
    return np.concatenate([at.pulses[0], at.stations[0]]), kinds


def _stations(net: Network, at: Estimate, which: list[int]) -> list[tuple[int, Fix]]:
    """Return fixes of some stations from pulses and stations that are held."""
    if not which:
        return []
    places, kinds = _station_rows(net, at)
    rows = []
    for kind, ends, sigma, z in kinds:
        given = np.isfinite(sigma[which])
        if given.any():
            rows.append(
                measured(
                    kind,
                    np.where(given, z[which], 0.0),
                    a=ends,
                    sigma=_shared(np.where(given, sigma[which], 1.0)),
                    weight=_shared(given.astype(float)),
                )
            )
    spread = float(np.ptp(places, axis=0).max()) or 1.0
    out, soft = [], np.asarray(np.isfinite(net.place_sigma[which]).any(axis=1))
    plain = [i for i, known in zip(which, soft, strict=True) if not known]
    problem = assemble(places, *rows)
    free = _fixes(problem.take(np.flatnonzero(~soft)), at.stations[0, plain]) if plain else None
    out += [(i, free[n]) for n, i in enumerate(plain) if free is not None]
    for n in np.flatnonzero(soft):
        i = which[n]
        # a coordinate of which nothing is known has a prior that says nothing, too
        sigma = np.clip(net.place_sigma[i], _EXACT * spread, 1e6 * spread)
        prior = Prior("position", net.place[i], np.diag(sigma**2))
        out.append((i, solve(replace(problem.take(np.array([n])), priors=(prior,)))[0]))
    return out


def _fixes(problem: Problem, here: Array) -> Fix:
    """Return fixes with their proof; of many rows from where they are, as other starts take matrices of all rows."""
    if problem.count <= _MANY:
        return solve(problem)
    start = np.zeros((len(here), problem.layout.size))
    start[:, : here.shape[1]] = here
    return solve(problem, "lsr+certify", start=start)


def _ranges(net: Network, at: Estimate) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return deviations and values (M, N) of what each station's rows say of its ranges: with and without its clock.

    Several rows of one pulse are one range: their mean by inverse variance.
    """
    m, n = net.stations, net.pulses
    information, sums = np.zeros((2, m, n)), np.zeros((2, m, n))
    apart = np.linalg.norm(at.stations[0][:, None] - at.pulses[0][None], axis=-1) + at.clocks[0][:, None]
    for r, slot in enumerate(net.slots):
        weight = np.where(net.given[:, r], net.sigma[:, r] ** -2.0, 0.0)
        z = net.z[:, r]
        ends: tuple[tuple[int, Array], ...]
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


def moved(lik: Likelihood, at: Estimate, block: Block, place: Array) -> Estimate:
    """Return an estimate with one block at another place, and its clock or emission as that place wants it."""
    if block.station:
        return _moved_station(lik, at, block.index, place)
    return moved_pulses(lik, at, np.array([block.index]), place[None])


def moved_pulses(lik: Likelihood, at: Estimate, which: Array, places: Array) -> Estimate:
    """Return an estimate with some pulses (n,) at other places (n, d), and their emission as these want it."""
    pulses, emission = at.pulses.copy(), at.emission.copy()
    pulses[0, which] = np.where(np.isfinite(places), places, pulses[0, which])
    there = replace(at, pulses=pulses)
    weight = lik.root[which] * lik.emits
    total = np.maximum((weight**2).sum(axis=1), 1e-300)
    shift = (lik.residual(there)[0, which] * weight).sum(axis=1) / total
    emission[0, which] += np.where(lik.emission[which], shift, 0.0)
    return replace(there, emission=emission)


def _moved_station(lik: Likelihood, at: Estimate, i: int, place: Array) -> Estimate:
    stations, clocks = at.stations.copy(), at.clocks.copy()
    stations[0, i] = np.where(np.isfinite(place), place, stations[0, i])
    there = replace(at, stations=stations)
    if lik.network.synchronised:
        return there
    own = np.where(lik.first == i, lik.ticks[0], 0.0) + np.where(lik.second == i, lik.ticks[1], 0.0)
    weight = lik.root * own
    clocks[0, i] += (lik.residual(there)[0] * weight).sum() / max(float((weight**2).sum()), 1e-300)
    return replace(there, clocks=clocks)
