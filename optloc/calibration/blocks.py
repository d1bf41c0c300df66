"""One station or pulse at a time, the others held: an ordinary fix, with the proof that ordinary fixes have."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optloc.base.types import Array, Prior
from optloc.calibration.likelihood import Estimate, Likelihood
from optloc.calibration.network import Network
from optloc.problem.build import assemble, measured
from optloc.problem.fix import Fix
from optloc.solvers import solve
from optloc.solvers.policy import AMBIGUOUS_GAP, equal_cost

MOVED = 16.0
"""Cost that a block's other place may have beyond its present one for all to be refined from there: what is dearer by
four sigma with the others held hardly ends below when they move as well."""

QUICK = "gtrs+lsr"
"""Method that tells a fix and its likeliest rivals, unproven."""

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
    refuted: bool
    gaps: tuple[float, ...]
    places: Array


def blocks(lik: Likelihood, at: Estimate, *, prove: bool = True) -> tuple[Block, ...]:
    """Return what is known of each station that is not known exactly, and of each pulse, with all others held.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : Estimate
        One estimate, S = 1.
    prove : bool
        Whether each is proven, or its likeliest other places are looked up alone.

    Returns
    -------
    tuple of Block
        Stations first. The proof is that of a fix from known stations; it does not exclude that several blocks move
        together.
    """
    net, method = lik.network, "auto" if prove else QUICK
    stations = [i for i in range(net.stations) if (net.place_sigma[i] > 0.0).any()]
    d, cost = net.dimension, float(lik.cost(at)[0])
    found = []
    for i, fix in _stations(net, at, stations, method):
        at_best = _moved_station(lik, at, i, fix.position[:d])
        above = cost - float(lik.cost(at_best)[0])
        found.append(_block(fix, i, f"station {net.names[i]}", True, at.stations[0, i], above))
    fix = place_pulses(net, at, np.arange(net.pulses), method)
    # pulses do not know of each other: all are moved at once
    before = (lik.residual(at)[0] ** 2).sum(axis=1)
    after = (lik.residual(moved_pulses(lik, at, np.arange(net.pulses), fix.position))[0] ** 2).sum(axis=1)
    for j in range(net.pulses):
        above = float(before[j] - after[j])
        found.append(_block(fix[j], j, f"pulse {net.labels[j]}", False, at.pulses[0, j], above))
    return tuple(found)


def _block(fix: Fix, index: int, name: str, station: bool, here: Array, above: float) -> Block:
    """Return a block from the fix that has its place: `above` is what the present place costs beyond the best."""
    certificate, d = fix.certificate, len(here)
    claim: Any = certificate.item() if isinstance(certificate, np.ndarray) else certificate
    x = np.concatenate([fix.position[None, :d], fix.alternatives.x.reshape(-1, fix.x.shape[-1])[:, :d]])
    gaps = np.concatenate([[0.0], fix.alternatives.gap.ravel()])
    kept = np.isfinite(gaps) & np.isfinite(x).all(axis=1)
    x, gaps = x[kept], gaps[kept]
    # the present place is among those found, unless it is no minimum or too dear to be listed
    alike = np.abs(gaps - above) <= _ALIKE + equal_cost(float(fix.cost))
    apart = np.where(alike, np.linalg.norm(x - here, axis=1), np.inf)
    others = np.arange(len(x)) != (apart.argmin() if alike.any() else -1)
    refuted = above > _ALIKE + equal_cost(float(fix.cost))
    proven = claim.proof == "global" and claim.unique and claim.margin >= AMBIGUOUS_GAP and not refuted
    return Block(name, station, index, proven, refuted, tuple(gaps[others] - above), x[others])


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
                sigma=np.where(given, net.sigma[np.ix_(which, slots)], 1.0),
                weight=given.astype(float),
            )
        )
    return solve(assemble(stations, *kinds), method)


def _stations(net: Network, at: Estimate, which: list[int], method: str) -> list[tuple[int, Fix]]:
    """Return fixes of some stations from pulses and stations that are held."""
    if not which:
        return []
    timed, ranged = _ranges(net, at)
    near = np.full((net.stations, net.stations), np.inf), np.zeros((net.stations, net.stations))
    for (i, k), distance, sigma in zip(net.between, net.distance, net.distance_sigma, strict=True):
        for one, other in ((i, k), (k, i)):
            near[0][one, other], near[1][one, other] = sigma, distance
    # clocks that are sought are to a station what the time of emission is to a pulse
    kinds = [("range" if net.synchronised else "toa", np.arange(net.pulses), *timed)]
    kinds.append(("range", np.arange(net.pulses), *ranged))
    kinds.append(("range", net.pulses + np.arange(net.stations), *near))
    places = np.concatenate([at.pulses[0], at.stations[0]])
    rows = []
    for kind, ends, sigma, z in kinds:
        given = np.isfinite(sigma[which])
        if given.any():
            rows.append(
                measured(
                    kind,
                    np.where(given, z[which], 0.0),
                    a=ends,
                    sigma=np.where(given, sigma[which], 1.0),
                    weight=given.astype(float),
                )
            )
    spread = float(np.ptp(places, axis=0).max()) or 1.0
    out, soft = [], np.asarray(np.isfinite(net.place_sigma[which]).any(axis=1))
    plain = [i for i, known in zip(which, soft, strict=True) if not known]
    problem = assemble(places, *rows)
    free = solve(problem.take(np.flatnonzero(~soft)), method) if plain else None
    out += [(i, free[n]) for n, i in enumerate(plain) if free is not None]
    for n in np.flatnonzero(soft):
        i = which[n]
        # a coordinate of which nothing is known has a prior that says nothing, too
        sigma = np.clip(net.place_sigma[i], _EXACT * spread, 1e6 * spread)
        prior = Prior("position", net.place[i], np.diag(sigma**2))
        out.append((i, solve(replace(problem.take(np.array([n])), priors=(prior,)), method)[0]))
    return out


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
