"""The search of a network: rounds of starts and moves of blocks, until three starts agree on the cheapest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from optloc.problem import tail_probability
from optloc.sites.calibration.blocks import MOVED, StationBlock, blocks, elsewhere, moved
from optloc.sites.calibration.likelihood import Likelihood, NetworkEstimate, likelihood, together
from optloc.sites.calibration.motions import bent
from optloc.sites.calibration.network import CLOCKED, Network
from optloc.sites.calibration.restarts import RoundEnds, joined, rounds, starts_of
from optloc.solvers import P_MISFIT, equal_cost

AGREEING = 3
"""Starts that must arrive at the least cost: with fewer, one network in ten was found in another minimum."""

# Starts after which the best is taken for what it is: nine networks in ten of six stations need fewer.
_STARTS = 144
# Networks whose blocks are moved after each round, the cheapest first.
_TRIED = 2
# Moves that are tried of one network while the search goes on, the cheapest first.
_MOVES = 8
# Sweeps of block moves: each lowers the cost or is the last.
_SWEEPS = 6
# Difference of cost that nobody can tell: a tenth of a sigma of one number.
_SAME = 0.01


@dataclass(slots=True)
class NetworkSearchResult:
    """What a search has arrived at so far.

    `ends` are the minima of starts; `onward` tells where moves of blocks lead from the cost of one.
    """

    ends: RoundEnds
    best: NetworkEstimate
    cost: float
    made: int
    onward: dict[float, float] = field(default_factory=dict)

    @property
    def agreeing(self) -> int:
        """Return how many starts led to the best: by themselves, or by moves of blocks."""
        led = np.array([self.onward.get(_key(cost), cost) for cost in self.ends.cost])
        return self.ends.counted(led <= self.cost + _SAME + equal_cost(self.cost))


def _key(cost: float) -> float:
    return round(float(cost), 4)


def search(
    net: Network, seed: int, limit: int | None, tell: Callable[[str], None] | None
) -> NetworkSearchResult | None:
    """Return the cheapest network that a search finds, None where no start leads to one.

    Parameters
    ----------
    net : Network
        What was measured.
    seed : int
        Decides the starts.
    limit : int, optional
        Starts after which it ends, agreed or not.
    tell : callable, optional
        Called with a sentence on each round.
    """
    limit = limit or _STARTS
    lik = likelihood(net)
    found: NetworkSearchResult | None = None
    for made, one in rounds(starts_of(lik, seed)):
        good = np.isfinite(one.cost)
        if good.any():
            found = _added(found, one.take(good), made)
            _move_on(lik, found)
            if tell is not None:
                tell(f"{found.made} starts, {found.agreeing} at the least cost {found.cost:.5g}")
            agreed = found.agreeing >= AGREEING and _fits(net, found.cost)
            if agreed or made >= limit:
                return found
        if made >= 2 * limit:
            return found
    return found


def _added(found: NetworkSearchResult | None, ends: RoundEnds, made: int) -> NetworkSearchResult:
    if found is not None:
        ends = joined([found.ends, ends])
    i = int(ends.cost.argmin())
    if found is None:
        return NetworkSearchResult(ends, ends.at.take(np.array([i])), float(ends.cost[i]), made)
    found.ends, found.made = ends, made
    if ends.cost[i] < found.cost - _SAME:
        found.best, found.cost = ends.at.take(np.array([i])), float(ends.cost[i])
    return found


def _move_on(lik: Likelihood, found: NetworkSearchResult) -> None:
    """Move single blocks of the cheapest networks to their other places, as long as that lowers the cost."""
    ends = found.ends
    tried = 0
    for i in np.argsort(ends.cost, kind="stable"):
        if found.agreeing >= AGREEING or tried == _TRIED:
            return
        if _key(ends.cost[i]) in found.onward:
            continue
        tried += 1
        at, cost = _swept(lik, ends.at.take(np.array([i])), float(ends.cost[i]))
        found.onward[_key(ends.cost[i])] = cost
        if cost < found.cost - _SAME:
            found.best, found.cost = at, cost


def _swept(lik: Likelihood, at: NetworkEstimate, cost: float) -> tuple[NetworkEstimate, float]:
    """Return where moves of blocks lead from a minimum."""
    for _ in range(_SWEEPS):
        found = sorted(elsewhere(lik, at), key=lambda block: block.gaps[0])[:_MOVES]
        if not found:
            break
        there, costs = lik.refine(together(*(moved(lik, at, block, block.places[0]) for block in found)))
        i = int(np.argmin(costs))
        if costs[i] >= cost - _SAME - equal_cost(cost):
            break
        at, cost = there.take(np.array([i])), float(costs[i])
    return at, cost


def proven(
    lik: Likelihood, at: NetworkEstimate
) -> tuple[NetworkEstimate, tuple[StationBlock, ...], list[tuple[str, NetworkEstimate]]]:
    """Move blocks to all places that a proof leaves, until none lowers the cost.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : NetworkEstimate
        A minimum, S = 1.

    Returns
    -------
    at : NetworkEstimate
        The cheapest network.
    blocks : tuple of StationBlock
        What is proven of it.
    others : list of (str, NetworkEstimate)
        Networks with one block elsewhere, refined.
    """
    cost, others = float(lik.cost(at)[0]), list[tuple[str, NetworkEstimate]]()
    for _ in range(_SWEEPS):
        at, cost, beside = _straightened(lik, at, cost)
        found = blocks(lik, at)
        places = [
            (block, place)
            for block in found
            for place, gap in zip(block.places, block.gaps, strict=True)
            if gap <= MOVED
        ]
        if not places:
            return at, found, beside
        ends, costs = lik.refine(together(*(moved(lik, at, block, place) for block, place in places)))
        others = [(f"{block.name} elsewhere", ends.take(np.array([n]))) for n, (block, _) in enumerate(places)]
        i = int(np.argmin(costs))
        if costs[i] >= cost - _SAME - equal_cost(cost):
            break
        at, cost = ends.take(np.array([i])), float(costs[i])
    return at, found, others + beside


def _straightened(
    lik: Likelihood, at: NetworkEstimate, cost: float
) -> tuple[NetworkEstimate, float, list[tuple[str, NetworkEstimate]]]:
    """Return the cheapest network that joint moves lead to, its cost, and the other ends of these moves."""
    for _ in range(_SWEEPS):
        made = bent(lik, at)
        if made is None:
            return at, cost, []
        ends, costs = made
        i = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        others = [("the network bent", ends.take(np.array([n]))) for n in np.flatnonzero(costs > cost + _SAME)]
        if not costs[i] < cost - _SAME - equal_cost(cost):
            return at, cost, others
        at, cost = ends.take(np.array([i])), float(costs[i])
    return at, cost, others


def _fits(net: Network, cost: float) -> bool:
    dof = np.array(net.rows - net.unknowns + frame_size(net))
    return not float(tail_probability(np.array(cost), dof)) < P_MISFIT


def frame_size(network: Network) -> int:
    """Return how many unknowns the frame is, as far as known coordinates can fix it."""
    d = network.dimension
    known = int(np.isfinite(network.place_sigma).sum())
    clocks = int(not network.synchronised and any(slot.kind in CLOCKED for slot in network.slots))
    return max(d * (d + 1) // 2 - known, 0) + clocks
