"""Multi-start search for a network, until three starts agree on the least cost.

Each round makes starts (`restarts.rounds`) and then moves single stations or pulses (`blocks`) of the
cheapest networks. A block is one station or pulse. The cost is chi-square: the sum of squared whitened
residuals.

Arguments of many functions: `net` is the network, `lik` is its likelihood, and `at` is one estimate of
all unknowns (S = 1).
"""

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
"""Number of starts that must reach the least cost: with fewer, 10 % of networks ended in another minimum."""

# Largest number of starts, after which the best network is accepted: 90 % of networks of six stations need
# fewer.
_STARTS = 144
# Networks whose blocks are moved after each round, least cost first.
_TRIED = 2
# Block moves that are tried in one network during the search, least cost first.
_MOVES = 8
# Largest number of sweeps of block moves; a sweep that does not lower the cost is the last.
_SWEEPS = 6
# Costs with a smaller difference count as equal: a tenth of a standard deviation of one measurement.
_SAME = 0.01


@dataclass(slots=True)
class NetworkSearchResult:
    """State and result of a search.

    `ends` contains the minima of all starts. `best` (S = 1) is the best network, and `cost` is its cost.
    `made` is the number of starts. `onward` maps the rounded cost of a minimum to the lower cost that block
    moves reach from it.
    """

    ends: RoundEnds
    best: NetworkEstimate
    cost: float
    made: int
    onward: dict[float, float] = field(default_factory=dict)

    @property
    def agreeing(self) -> int:
        """Return the number of starts that reach the best network, directly or by block moves."""
        reached = np.array([self.onward.get(_cost_key(cost), cost) for cost in self.ends.cost])
        return self.ends.counted(reached <= self.cost + _SAME + equal_cost(self.cost))


def _cost_key(cost: float) -> float:
    """Return a rounded cost as key of `NetworkSearchResult.onward`: minima with equal keys are the same."""
    return round(float(cost), 4)


def search(
    net: Network, seed: int, limit: int | None, tell: Callable[[str], None] | None
) -> NetworkSearchResult | None:
    """Return the cheapest network of the search, or None if no start converges.

    `seed` sets the random starts. The search ends if `AGREEING` starts reach the least cost and this cost
    fits the noise. It ends after `limit` starts (None: `_STARTS`) even if they do not agree. The function
    calls `tell` with a progress message after each round.
    """
    limit = limit or _STARTS
    lik = likelihood(net)
    found: NetworkSearchResult | None = None
    for made, one in rounds(starts_of(lik, seed)):
        good = np.isfinite(one.cost)
        if good.any():
            found = _add_round(found, one.take(good), made)
            _improve_by_block_moves(lik, found)
            if tell is not None:
                tell(f"{found.made} starts, {found.agreeing} at the least cost {found.cost:.5g}")
            agreed = found.agreeing >= AGREEING and _fits(net, found.cost)
            if agreed or made >= limit:
                return found
        # No start of this round converged: stop after twice the limit.
        if made >= 2 * limit:
            return found
    return found


def _add_round(found: NetworkSearchResult | None, ends: RoundEnds, made: int) -> NetworkSearchResult:
    """Add the minima of a round (`ends`) to the search result, and return the result.

    `found` is the result so far, or None before the first round; it is changed. `made` is the number of starts.
    """
    if found is not None:
        ends = joined([found.ends, ends])
    i = int(ends.cost.argmin())
    if found is None:
        return NetworkSearchResult(ends, ends.at.take(np.array([i])), float(ends.cost[i]), made)
    found.ends, found.made = ends, made
    if ends.cost[i] < found.cost - _SAME:
        found.best, found.cost = ends.at.take(np.array([i])), float(ends.cost[i])
    return found


def _improve_by_block_moves(lik: Likelihood, found: NetworkSearchResult) -> None:
    """Move single blocks of the cheapest networks to other positions, as long as that lowers the cost.

    The results are written to `found`: `onward`, and `best` and `cost` if a network is cheaper.
    """
    ends = found.ends
    tried = 0
    for i in np.argsort(ends.cost, kind="stable"):
        if found.agreeing >= AGREEING or tried == _TRIED:
            return
        if _cost_key(ends.cost[i]) in found.onward:
            continue
        tried += 1
        at, cost = _sweep_block_moves(lik, ends.at.take(np.array([i])), float(ends.cost[i]))
        found.onward[_cost_key(ends.cost[i])] = cost
        if cost < found.cost - _SAME:
            found.best, found.cost = at, cost


def _sweep_block_moves(lik: Likelihood, at: NetworkEstimate, cost: float) -> tuple[NetworkEstimate, float]:
    """Return the network (S = 1) and the cost that repeated block moves reach from the minimum `at` with this cost."""
    for _ in range(_SWEEPS):
        found = sorted(elsewhere(lik, at), key=lambda block: block.gaps[0])[:_MOVES]
        if not found:
            break
        there, costs = lik.refine(together(*(moved(lik, at, block, block.places[0]) for block in found)))
        # Accept only a fall of the cost that is larger than rounding.
        i = int(np.argmin(costs))
        if costs[i] >= cost - _SAME - equal_cost(cost):
            break
        at, cost = there.take(np.array([i])), float(costs[i])
    return at, cost


def proven(
    lik: Likelihood, at: NetworkEstimate
) -> tuple[NetworkEstimate, tuple[StationBlock, ...], list[tuple[str, NetworkEstimate]]]:
    """Return the network after moves to all positions that block proofs did not exclude, until no move lowers the cost.

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
        Stations and pulses with their proofs.
    others : list of (str, NetworkEstimate)
        Refined networks after a move of one block or of all stations, and a description of each.
    """
    cost, others = float(lik.cost(at)[0]), list[tuple[str, NetworkEstimate]]()
    for _ in range(_SWEEPS):
        at, cost, bent_others = _apply_joint_moves(lik, at, cost)
        found = blocks(lik, at)
        places = [
            (block, place)
            for block in found
            for place, gap in zip(block.places, block.gaps, strict=True)
            if gap <= MOVED
        ]
        if not places:
            return at, found, bent_others
        ends, costs = lik.refine(together(*(moved(lik, at, block, place) for block, place in places)))
        others = [(f"{block.name} elsewhere", ends.take(np.array([n]))) for n, (block, _) in enumerate(places)]
        i = int(np.argmin(costs))
        if costs[i] >= cost - _SAME - equal_cost(cost):
            break
        at, cost = ends.take(np.array([i])), float(costs[i])
    return at, found, others + bent_others


def _apply_joint_moves(
    lik: Likelihood, at: NetworkEstimate, cost: float
) -> tuple[NetworkEstimate, float, list[tuple[str, NetworkEstimate]]]:
    """Return the cheapest network that joint moves of all stations reach, its cost, and their other minima.

    `at` (S = 1) is a minimum with this `cost`. Each other minimum has a description. If an open motion
    changes no row, no move is made.
    """
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
    """Return whether the cost of a network passes the chi-square test: its p-value is at least `P_MISFIT`."""
    dof = np.array(net.rows - net.unknowns + frame_size(net))
    return not float(tail_probability(np.array(cost), dof)) < P_MISFIT


def frame_size(network: Network) -> int:
    """Return the number of unknowns that only the frame fixes: motions and a common clock offset that change no row.

    They do not count in the degrees of freedom. Each known coordinate reduces the number by one.
    """
    d = network.dimension
    known = int(np.isfinite(network.place_sigma).sum())
    clocks = int(not network.synchronised and any(slot.kind in CLOCKED for slot in network.slots))
    return max(d * (d + 1) // 2 - known, 0) + clocks
