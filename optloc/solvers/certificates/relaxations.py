"""Lower bounds of the maximum-likelihood cost from convex relaxations, independent of branch and bound.

Every bound is recomputed from a dual point. It is valid over all positions or over a named region. For a method that
bounds another cost than the likelihood, the bound is NaN and the reason names that cost.

Letters: N fixes of a batch, i the number of one of them, d coordinates. Costs are chi-square values. `found` are the
least-squares ranges of all problems, from which the moment relaxation takes the ranges of problem i.
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
"""Relative difference, to one plus the cost, up to which a bound counts as tight: no better position remains."""

# The search covers costs up to this much above the fix: a wider box of moments gives a looser bound.
_MARGIN = 0.1
# Largest ratio of eigenvalues at which first moments count as a point: an interior-point solver leaves this much of
# zero.
_RANK_ONE = 1e-4
# Relative difference up to which two computations of a cost agree, as for a tight bound.
_SAME = 1e-3
_OPEN = "the rows do not bound the positions with a cost this low; give a region"
_MOST_STATIONS = 10  # the time of a relaxation grows with their sixth power
_OTHER_COSTS = {
    "sdp": "Shor's relaxation bounds the squared-range cost, not the likelihood",
    "socp": "the cone relaxation bounds the squared-range cost, not the likelihood",
    "minimax": "the cone program bounds the worst angle, not the likelihood",
    "heights": "the satellite relaxation bounds the distance from the point below, not the likelihood",
}
METHODS = ("moment", "directions", *_OTHER_COSTS)


@dataclass(frozen=True, slots=True)
class Reference:
    """Lower bounds for a flat batch of N fixes.

    Parameters
    ----------
    method : str
        Name of the relaxation.
    bound : array (N,)
        No position of the scope has a lower maximum-likelihood cost; NaN without a bound.
    scope : object array (N,)
        "global", "region", or "" without a bound.
    reason : object array (N,)
        Why there is no bound; "" if there is one.
    point : array (N, d)
        Minimum of the relaxation, metres; NaN if the solution of the relaxation is not a point.
    """

    method: str
    bound: Array
    scope: Array
    reason: Array
    point: Array

    def tight(self, cost: Array) -> Array:
        """Return flags (N,) of bounds that are tight for costs (N,): cost and bound agree within `TIGHT` (1 + cost)."""
        with np.errstate(invalid="ignore"):
            return np.asarray(cost - self.bound <= TIGHT * (1.0 + cost))


def reference_bound(problem: Problem, fix: Fix, method: str, *, region: float | None = None) -> Reference:
    """Return lower bounds of the maximum-likelihood cost from a convex relaxation.

    Each fix is one convex program; threads share the programs.

    Parameters
    ----------
    problem : Problem
        N problems, flattened.
    fix : Fix
        Their refined fixes. A bound is valid for every fix, but it can be tight only for the global minimum.
    method : {"moment", "directions"}
        "moment": moments of order 2, for one static position from range, toa, tdoa and range_sum rows, up to 10
        stations. "directions": unit directions, for one static position from azimuths and elevations. Names of other
        relaxations are accepted; their reason explains why they do not bound the likelihood.
    region : float, optional
        Radius of a ball about the middle of the stations, metres. It is the scope if the rows alone do not enclose the
        positions with a cost as low as the cost of the fix.

    Returns
    -------
    Reference
        Bounds, or reasons for missing bounds.

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
    """Return the reason why no relaxation of this module covers the problem; "" if one may cover it."""
    if not one_position(problem) or problem.motions[0].order > 0:
        return "the relaxation supports one target at rest only"
    if problem.biases or problem.priors:
        return "the relaxation does not support biases and priors"
    if problem.stations.errors:
        return "the relaxation does not support station errors"
    stated = problem.constraints or problem.fences
    return "the relaxation does not support constraints and fences" if stated else ""


def _beyond_moments(problem: Problem) -> str:
    """Return the reason why the moment relaxation does not cover the problem; "" if it does."""
    from optloc.models import MODELS

    for rows in problem.rows:
        if MODELS[rows.kind].ranges is None:
            return f"{rows.kind} rows are not sums of ranges"
    return ""


def _beyond_directions(problem: Problem) -> str:
    """Return the reason why the relaxation over directions does not cover the problem; "" if it does."""
    for rows in problem.rows:
        if rows.kind not in ("azimuth", "elevation"):
            return f"{rows.kind} rows are not angles"
    if problem.dimension != 3 or bearings(problem) is None:
        return "the relaxation needs azimuths and elevations in three dimensions"
    correlated = any(block.row.shape[1] > 1 for block in problem.noise.blocks)
    return "the relaxation needs angles with independent errors" if correlated else ""


def _nothing(problem: Problem, method: str, why: str) -> Reference:
    """Return a reference without bounds for all fixes: bounds and points are NaN, and `why` is the reason.

    `method` is the name of the relaxation.
    """
    size = problem.batch_shape[0]
    scope, reason = np.full(size, "", dtype=object), np.full(size, why, dtype=object)
    return Reference(method, np.full(size, np.nan), scope, reason, np.full((size, problem.dimension), np.nan))


def _by_directions(problem: Problem, fix: Fix) -> Reference:
    """Return the bounds of the relaxation over unit directions."""
    reference, seen = _nothing(problem, "directions", ""), bearings(problem)
    assert seen is not None
    bound = angle_bounds(seen, np.where(fix.answered[:, None], fix.position, np.nan))
    known = np.isfinite(bound)
    reference.bound[known], reference.scope[known] = bound[known], "global"
    reference.reason[~known] = "there are fewer than two complete bearings, or no fix"
    return reference


def _by_moments(problem: Problem, fix: Fix, region: float | None) -> Reference:
    """Return the bounds of the moment relaxation; `region` is the radius of a ball, metres, or None."""
    from formulations.moment_sdp import moment_bound

    reference, found = _nothing(problem, "moment", ""), ranges(problem_at_rest(problem))
    assert found is not None
    place = _places(problem, found)

    def bounded(i: int) -> None:
        about = _enclosed(found, place, fix, i, region)
        if isinstance(about, str):
            reference.reason[i] = about
            return
        reference.scope[i], centre, size = about.scope, about.centre, about.size
        loops, box = about.loops, about.box
        answer = None if box is None else moment_bound(about.scaled, box, about.cost)
        if answer is None or not np.isfinite(answer.bound):
            reference.scope[i] = ""
            reference.reason[i] = (
                _OPEN if answer is None else f"the solver found no dual point ({answer.answer.status})"
            )
            return
        reference.bound[i] = max(answer.bound, 0.0) + loops
        if answer.rank_ratio < _RANK_ONE:
            reference.point[i] = centre + size * answer.point

    map_on_threads(bounded, range(len(place)), least=WORTH)
    return reference


@dataclass(frozen=True, slots=True)
class EnclosedRanges:
    """The ranges of one problem, and a box around all positions up to a greatest cost.

    Parameters
    ----------
    scaled : Ranged
        Ranges in units of `size` metres, relative to `centre` (d,).
    box : EnclosingBox or None
        The box; None if the rows do not bound such positions.
    cost : float
        Greatest cost of the positions in the box.
    loops : float
        Cost of the misfit of the rows among themselves, which no position changes.
    scope : "global" or "region"
        Whether the box contains all such positions.
    """

    scaled: Ranged
    box: EnclosingBox | None
    cost: float
    loops: float
    centre: Array
    size: float
    scope: str


def enclosed_ranges(problem: Problem, fix: Fix, margin: float) -> EnclosedRanges | str:
    """Return the ranges and the box of a flat batch of one problem, or the reason why they do not exist.

    The box contains the positions whose chi-square is at most `margin` above the chi-square of the fix.
    """
    why = _beyond(problem) or _beyond_moments(problem)
    found = None if why else ranges(problem_at_rest(problem))
    return why if found is None else _enclosed(found, _places(problem, found), fix, 0, None, margin)


def _places(problem: Problem, found: Ranges) -> Array:
    """Return the positions (N, s, d) of the stations with ranges, metres."""
    shape = (problem.batch_shape[0], *problem.stations.position.shape[-3:])
    return np.broadcast_to(problem.stations.position, shape)[:, found.epoch, found.station]


def _enclosed(
    found: Ranges, place: Array, fix: Fix, i: int, region: float | None, margin: float = _MARGIN
) -> EnclosedRanges | str:
    """Return the ranges and the box of problem i, or the reason why they do not exist; `region` is in metres."""
    why = _declined(found, i, bool(fix.answered[i]))
    if why:
        return why
    nodes = _nodes(found, i)
    centre, spread = centre_and_spread(place[i, nodes])
    size = float(spread) or 1.0  # stations at one point have no spread, so the unit is a metre
    scaled = _scaled(found, i, nodes, (place[i, nodes] - centre) / size, size)
    point = (fix.position[i] - centre) / size
    cost = float(scaled.cost(point))
    # the misfit of the rows among themselves, computed without the cancellation of large sums of squares
    loops = float(fix.cost[i]) - cost
    if not abs(loops - found.cost[i]) <= _SAME * (1.0 + fix.cost[i]):
        return "the cost of the ranges differs from the cost of the fix"
    box = enclosure(scaled, point, cost + margin)
    scope = "global" if box is not None else "region"
    return EnclosedRanges(scaled, box or _region(scaled, region, size), cost + margin, loops, centre, size, scope)


def _declined(found: Ranges, i: int, answered: bool) -> str:
    """Return the reason why the moment relaxation is not computed for problem i; "" if it is computed.

    `answered` is True if there is a fix with a cost to compare.
    """
    count = int(found.inside[i].sum())
    if not answered:
        return "there is no fix with a cost to compare"
    if count < 2:
        return "fewer than two stations have ranges"
    return f"{count} stations make the relaxation too large" if count > _MOST_STATIONS else ""


def _nodes(found: Ranges, i: int) -> Array:
    """Return the numbers of the stations of problem i that have ranges, the reference station first."""
    nodes, first = np.flatnonzero(found.inside[i]), int(found.reference[i])
    return np.concatenate([[first], nodes[nodes != first]])


def _scaled(found: Ranges, i: int, nodes: Array, station: Array, size: float) -> Ranged:
    """Return the ranges of problem i, in units of `size` metres.

    `nodes` are the numbers of its stations, and `station` their positions relative to the centre, in the same unit.
    """
    covariance = found.covariance[i if len(found.covariance) > 1 else 0][np.ix_(nodes, nodes)]
    sign, offset = found.sign[i, nodes].astype(float), found.offset[i, nodes] / size
    return Ranged(station, sign, offset, covariance / size**2, bool(found.sign[i].any()))


def _region(ranges_of_one: Ranged, region: float | None, size: float) -> EnclosingBox | None:
    """Return the box around a ball of radius `region` metres, or None without a region.

    `size` is the unit of the scaled ranges, metres. The centre of the ball is the middle of the stations.
    """
    return None if region is None else ball(ranges_of_one, np.zeros(ranges_of_one.station.shape[1]), region / size)
