"""Lower bounds of the maximum-likelihood cost by convex relaxations: an opinion independent of branch and bound.

Every bound is recomputed from a dual point, and holds over all positions or over a named region. A method whose bound
belongs to another cost than the likelihood answers NaN and says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.range_enclosure import EnclosingBox, Ranged, ball, enclosure
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.linalg import centre_and_spread
from optloc.base.threads import WORTH, map_on_threads
from optloc.base.types import Array
from optloc.linear.least_squares_ranges import Ranges, ranges
from optloc.linear.mirror import one_position
from optloc.linear.vectors import problem_at_rest
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers.starts.angles import angle_bounds, bearings

TIGHT = 1e-3
"""A bound within this of the cost, relative to one plus the cost, leaves nothing to be found."""

# Costs up to this above that of the fix are looked at: the wider the box of moments, the looser the bound.
_MARGIN = 0.1
# Largest ratio of eigenvalues at which first moments are a point: what an interior-point solver leaves of zero.
_RANK_ONE = 1e-4
# Relative difference at which two ways to a cost agree, as for a tight bound.
_SAME = 1e-3
_OPEN = "the rows do not enclose the positions that cost as little; give a region"
_MOST_STATIONS = 10  # the time of a relaxation grows with their sixth power
_OTHER_COSTS = {
    "sdp": "Shor's relaxation bounds the squared-range cost, not the likelihood",
    "socp": "the cone relaxation bounds the squared-range cost, not the likelihood",
    "minimax": "the cones bound the worst angle, not the likelihood",
    "heights": "the satellite relaxation bounds the distance from the point below, not the likelihood",
}
METHODS = ("moment", "directions", *_OTHER_COSTS)


@dataclass(frozen=True, slots=True)
class Reference:
    """Lower bounds for a flat batch of N fixes.

    Parameters
    ----------
    method : str
        Which relaxation.
    bound : array (N,)
        No position of the scope has a lower maximum-likelihood cost; NaN where nothing is bounded.
    scope : object array (N,)
        "global", "region", or "" where nothing is bounded.
    reason : object array (N,)
        Why nothing is bounded; empty where something is.
    point : array (N, d)
        Where the relaxation itself puts the minimum, metres; NaN where it is not a point.
    """

    method: str
    bound: Array
    scope: Array
    reason: Array
    point: Array

    def tight(self, cost: Array) -> Array:
        """Return where the bound leaves no room below costs (N,)."""
        with np.errstate(invalid="ignore"):
            return np.asarray(cost - self.bound <= TIGHT * (1.0 + cost))


def reference_bound(problem: Problem, fix: Fix, method: str, *, region: float | None = None) -> Reference:
    """Bound the maximum-likelihood cost from below by a convex relaxation, one program for each fix, over threads.

    Parameters
    ----------
    problem : Problem
        N problems, flattened.
    fix : Fix
        Their refined fixes. A bound is valid whatever the fix, but tight at its best only for the global minimum.
    method : {"moment", "directions"}
        Order-2 moments: one static position from range, toa, tdoa and range_sum rows, up to 10 stations.
        Unit directions: one static position from azimuths and elevations. The names of other relaxations are known
        and answer why they bound no likelihood.
    region : float, optional
        Radius of a ball about the middle of the stations, metres: the scope where the rows alone do not enclose the
        positions with a cost as low as that of the fix.

    Returns
    -------
    Reference
        Bounds, and why there are none.

    Raises
    ------
    InvalidProblem
        For an unknown method.

    References
    ----------
    J. B. Lasserre, "Global optimization with polynomials and the problem of moments", SIAM J. Optim. 11 (2001);
    N. Z. Shor, "Quadratic optimization problems", Sov. J. Comput. Syst. Sci. 25 (1987).
    """
    if method not in METHODS:
        raise InvalidProblem(f"unknown reference {method!r}", "method", nearest(method, METHODS))
    problem, fix = problem.flat(), fix.flat()
    why = _OTHER_COSTS.get(method) or _beyond(problem)
    if not why:
        why = _beyond_moments(problem) if method == "moment" else _beyond_directions(problem)
    if why:
        return _nothing(problem, method, why)
    return _by_moments(problem, fix, region) if method == "moment" else _by_directions(problem, fix)


def _beyond(problem: Problem) -> str:
    """Return what no relaxation here covers."""
    if not one_position(problem) or problem.motions[0].order > 0:
        return "the relaxation is for one position that stays"
    if problem.biases or problem.priors:
        return "the relaxation knows no biases and no priors"
    if problem.stations.errors:
        return "the relaxation takes the stations for exact"
    return "the relaxation knows no constraints" if problem.constraints else ""


def _beyond_moments(problem: Problem) -> str:
    from optloc.models import MODELS

    for rows in problem.rows:
        if MODELS[rows.kind].ranges is None:
            return f"{rows.kind} rows are no sums of ranges"
    return ""


def _beyond_directions(problem: Problem) -> str:
    for rows in problem.rows:
        if rows.kind not in ("azimuth", "elevation"):
            return f"{rows.kind} rows are no angles"
    if problem.dimension != 3 or bearings(problem) is None:
        return "the relaxation needs azimuths and elevations in space"
    correlated = any(block.row.shape[1] > 1 for block in problem.noise.blocks)
    return "the relaxation needs angles with independent errors" if correlated else ""


def _nothing(problem: Problem, method: str, why: str) -> Reference:
    size = problem.batch_shape[0]
    scope, reason = np.full(size, "", dtype=object), np.full(size, why, dtype=object)
    return Reference(method, np.full(size, np.nan), scope, reason, np.full((size, problem.dimension), np.nan))


def _by_directions(problem: Problem, fix: Fix) -> Reference:
    out, seen = _nothing(problem, "directions", ""), bearings(problem)
    assert seen is not None
    bound = angle_bounds(seen, np.where(fix.answered[:, None], fix.position, np.nan))
    known = np.isfinite(bound)
    out.bound[known], out.scope[known] = bound[known], "global"
    out.reason[~known] = "there are fewer than two complete bearings, or no fix"
    return out


def _by_moments(problem: Problem, fix: Fix, region: float | None) -> Reference:
    from formulations.moment_sdp import moment_bound

    out, found = _nothing(problem, "moment", ""), ranges(problem_at_rest(problem))
    assert found is not None
    position = np.broadcast_to(
        problem.stations.position, (problem.batch_shape[0], *problem.stations.position.shape[-3:])
    )
    place = position[:, found.epoch, found.station]

    def bounded(i: int) -> None:
        out.reason[i] = _declined(found, i, bool(fix.answered[i]))
        if out.reason[i]:
            return
        nodes = _nodes(found, i)
        centre, spread = centre_and_spread(place[i, nodes])
        size = float(spread) or 1.0
        own = _scaled(found, i, nodes, (place[i, nodes] - centre) / size, size)
        point = (fix.position[i] - centre) / size
        cost = float(own.cost(point))
        # the misfit of the rows among themselves, without the digits that its own sum of squares has lost
        loops = float(fix.cost[i]) - cost
        if not abs(loops - found.cost[i]) <= _SAME * (1.0 + fix.cost[i]):
            out.reason[i] = "the ranges do not carry the cost of the fix"
            return
        box = enclosure(own, point, cost + _MARGIN)
        out.scope[i] = "global" if box is not None else "region"
        box = box or _region(own, region, size)
        answer = None if box is None else moment_bound(own, box, cost + _MARGIN)
        if answer is None or not np.isfinite(answer.bound):
            out.scope[i] = ""
            out.reason[i] = _OPEN if answer is None else f"no dual point was found ({answer.answer.status})"
            return
        out.bound[i] = max(answer.bound, 0.0) + loops
        if answer.rank_ratio < _RANK_ONE:
            out.point[i] = centre + size * answer.point

    map_on_threads(bounded, range(len(place)), least=WORTH)
    return out


def _declined(found: Ranges, i: int, answered: bool) -> str:
    count = int(found.inside[i].sum())
    if not answered:
        return "there is no fix whose cost could be compared"
    if count < 2:
        return "fewer than two stations have ranges"
    return f"{count} stations make the relaxation too large" if count > _MOST_STATIONS else ""


def _nodes(found: Ranges, i: int) -> Array:
    """Return the stations of problem i that have ranges, the reference first."""
    nodes, first = np.flatnonzero(found.inside[i]), int(found.reference[i])
    return np.concatenate([[first], nodes[nodes != first]])


def _scaled(found: Ranges, i: int, nodes: Array, station: Array, size: float) -> Ranged:
    covariance = found.covariance[i if len(found.covariance) > 1 else 0][np.ix_(nodes, nodes)]
    sign, offset = found.sign[i, nodes].astype(float), found.offset[i, nodes] / size
    return Ranged(station, sign, offset, covariance / size**2, bool(found.sign[i].any()))


def _region(own: Ranged, region: float | None, size: float) -> EnclosingBox | None:
    return None if region is None else ball(own, np.zeros(own.station.shape[1]), region / size)
