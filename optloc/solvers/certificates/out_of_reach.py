"""Bounds that the data do not reach: every position on them costs too much to matter.

After a proof over all positions, every region of low cost contains a known minimum. Assume that these minima are
admitted, and that every position of a plane between them and the forbidden side costs too much. Then no region of low
cost crosses the plane, and the bound does not matter. A bound of a coordinate is such a plane. For "above ground" it is
the tangent plane below the fix: the Earth is convex, so it is on the other side.

Letters: N or n fixes, e edges (bounds) of a problem, k constraints, d coordinates. Proofs number the pairs of fix and
edge: n e planes, the edges of the first fix first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array, Band
from optloc.linear.constraints import Level, exact, levels
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.proof.batch import ProofRequest, ProofResult, cost_here, costs_at, empty_answer, prove_all, prove_here
from optloc.proof.local_search import VALUE
from optloc.proof.position_costs import Affine, PositionCosts
from optloc.solvers.certificates.branch_and_bound import budgets
from optloc.solvers.certificates.position_cost import admitted_states, state_columns
from optloc.solvers.policy import LISTED_GAP, equal_cost

# Share of the distance between fix and plane by which rounding may move a position off the plane.
_ON_PLANE = 1e-9


@dataclass(frozen=True, slots=True)
class Edges:
    """Bounds of a problem, one entry for each finite side of each constraint.

    Parameters
    ----------
    levels : tuple of Level
        Number of the constraint, and its side: lower or upper.
    value : array (e,)
        Bounds, in the unit of the constraint.
    region : array (2, d)
        Corners of the admitted box, metres, if all coordinates are bounded on both sides; else NaN.
    """

    levels: tuple[Level, ...]
    value: Array
    region: Array

    @property
    def constraint(self) -> Array:
        """Return the number, in the problem, of the constraint of each edge, (e,)."""
        return np.array([level.constraint for level in self.levels], dtype=np.int64)


def edges_of(problem: Problem) -> Edges | None:
    """Return the bounds of a problem; None if one of them has no plane between its two sides.

    None is also the result for equalities and for bounds that vary within the batch.
    """
    found: list[tuple[Level, float]] = []
    if exact(problem):
        return None
    for i, band in enumerate(problem.constraints):
        if not isinstance(band, Band) or band.lower.ndim or band.upper.ndim:
            return None
        if band.kind not in ("plane", "height") or (band.kind == "height" and np.isfinite(band.upper)):
            return None
        sides = (("lower", float(band.lower)), ("upper", float(band.upper)))
        found += [(Level(i, side), value) for side, value in sides if np.isfinite(value)]
    region = admitted_states(problem, problem.dimension)
    region = region if np.isfinite(region).all() else np.full_like(region, np.nan)
    return Edges(tuple(level for level, _ in found), np.array([value for _, value in found]), region)


def new_questions(edges: Edges, count: int, d: int, nodes: float) -> ProofRequest:
    """Return an empty request for proofs about the edges of `count` fixes in d coordinates.

    `nodes` is the number of residual terms of a problem, for the budget. `lay_planes` writes positions and planes.
    """
    n = count * len(edges.levels)
    none = np.zeros(n, dtype=np.int64)
    return ProofRequest(
        x=np.empty((n, d)),
        others=np.zeros((n, 0, d)),
        known=none,
        hidden=none.copy(),
        gaps=np.zeros((n, 1)),
        eps=np.empty(n),
        region=np.repeat(edges.region[None], n, axis=0),
        fallback=np.full((n, 2, d), np.nan),
        budget=budgets(n, nodes, 1),
        planes=np.zeros((n, 1, 3)),
        surface=np.zeros((n, 0)),
    )


def lay_planes(edges: Edges, x: Array, cov: Array, missing: Array, slope: Array, asked: ProofRequest) -> None:
    """Write planes to a request, and the points on them where the quadratic model of the cost is least.

    Parameters
    ----------
    edges : Edges
        Edges of the problems.
    x, cov : array (n, d), (n, d, d)
        Fixes, metres, and covariances, m^2.
    missing, slope : array (n, e), (n, e, d)
        Bounds minus the bounded quantities at the fixes, and gradients of these quantities.
    asked : ProofRequest
        Request of n e proofs; its fields `x` and `planes` are written.
    """
    d = x.shape[1]
    toward = (cov[:, None] @ slope[..., None])[..., 0]
    place = x[:, None] + (missing / (slope * toward).sum(-1))[..., None] * toward
    unit = slope / np.sqrt((slope * slope).sum(-1, keepdims=True))
    if np.isfinite(edges.region[0, 0]):
        inside = np.clip(place, *edges.region)
        # an oblique plane does not contain the clipped point, so nothing is proven for it
        clipped_off = np.abs(((inside - place) * unit).sum(-1)) > _ON_PLANE * np.abs(missing)
        place = np.where(clipped_off[..., None], np.nan, inside)
    asked.x[:] = place.reshape(-1, d)
    asked.planes[:, 0, :d] = unit.reshape(-1, d)


# A few fixes by machine code, on stored arrays.


class ReachWorkspace(NamedTuple):
    """Stored arrays of a thread for n e planes: costs, request, results, and (2, n e, 1) costs at points.

    `found[0]` has the costs, and `found[1]` the rounding errors of the residuals.
    """

    costs: PositionCosts
    asked: ProofRequest
    answered: ProofResult
    found: Array


def new_workspace(affine: Affine, edges: Edges, count: int, d: int) -> ReachWorkspace:
    """Return the workspace for `count` fixes in d coordinates; `affine` describes the costs of the problem."""
    n = count * len(edges.levels)
    costs = affine.room(n)
    return ReachWorkspace(
        costs, new_questions(edges, count, d, len(costs.kinds)), empty_answer(n, d), np.zeros((2, n, 1))
    )


def are_out_of_reach(
    edges: Edges,
    room: ReachWorkspace,
    costs: PositionCosts,
    x: Array,
    cov: Array,
    cost: Array,
    value: Array,
    normal: Array,
) -> bool:
    """Return True if every position on the edges of n fixes costs at least `LISTED_GAP` more than the fixes.

    Parameters
    ----------
    edges, room : Edges, ReachWorkspace
        Edges and workspace of the problem.
    costs : PositionCosts
        Costs of the fixes, with their measurements.
    x, cov, cost : array (n, d), (n, d, d), (n,)
        Fixes, metres, covariances, m^2, and costs (chi-square).
    value, normal : array (n, k), (n, k, d)
        Quantities of the constraints at the fixes, and their gradients.
    """
    count, constraint = len(edges.levels), edges.constraint
    lay_planes(edges, x, cov, edges.value - value[:, constraint], normal[:, constraint], room.asked)
    room.costs.w[:] = np.repeat(costs.w, count, axis=0)
    if len(room.costs.data) > 1:  # the fixes do not share the data of their terms
        room.costs.data[:] = np.repeat(costs.data, count, axis=0)
    cost_here(room.costs, room.asked.x[:, None], room.found)
    level = np.repeat(cost + LISTED_GAP, count)
    # The proof shows that no position of the plane costs less than the point on it by more than `eps`. So no position
    # of the plane costs less than the level.
    room.asked.eps[:] = room.found[0, :, 0] - level
    if not (room.asked.eps > equal_cost(level)).all():
        return False
    prove_here(room.costs, room.asked, room.answered)
    return bool(_are_shown(room.answered, level).all())


def _are_shown(answered: ProofResult, level: Array) -> Array:
    """Return flags (n,) of planes where every position is proven to cost at least `level` (n,)."""
    # coarse rounding may make the proven bound lower than the level
    return np.asarray((answered.verdict == VALUE) & (answered.bound > level - equal_cost(level)))


def out_of_reach(problem: Problem, edges: Edges, costs: PositionCosts, fix: Fix, gap: float) -> Array:
    """Return flags (N,) of fixes: every position on their edges costs at least `gap` more than the fix.

    Parameters
    ----------
    problem : Problem
        N problems.
    edges : Edges
        Their bounds.
    costs : PositionCosts
        Their costs over the position.
    fix : Fix
        Their fixes: answers without an active bound.
    gap : float
        Difference of costs.
    """
    columns, count = state_columns(problem), len(edges.levels)
    values, gradients = levels(problem, edges.levels, fix.x)
    asked = new_questions(edges, len(fix.x), columns.stop - columns.start, costs.dense)
    lay_planes(edges, fix.x[:, columns], fix.cov[:, columns, columns], -values, gradients[..., columns], asked)
    plane_costs = costs.take(np.repeat(np.arange(len(fix.x)), count))
    level = np.repeat(fix.cost + gap, count)
    # the cost of the point on the plane minus the level: the proof must show that no position is cheaper by more
    asked.eps[:] = costs_at(plane_costs, asked.x[:, None])[0][:, 0] - level
    out = np.zeros(len(level), dtype=bool)
    # above `plane_costs.level` angles may be off by a whole turn, so the costs are not valid there
    items = np.flatnonzero((asked.eps > equal_cost(level)) & (plane_costs.level > level))
    if len(items):
        out[items] = _are_shown(prove_all(plane_costs.take(items), asked.take(items)), level[items])
    return np.asarray(out.reshape(len(fix.x), count).all(1))
