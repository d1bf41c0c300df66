"""Bounds that the data do not reach: every position on them costs too much to matter.

After a proof for all positions, every region of low cost contains a known minimum. Let these minima be admitted, and
let every position of a plane between them and the forbidden side cost too much. Then no region of low cost crosses the
plane, and the bound does not matter. A bound of a coordinate is such a plane. For "above ground" it is the tangent
plane below the fix: the Earth is convex, so it is on the other side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array, Band
from optloc.linear.constraints import is_exact
from optloc.problem.problem import Problem
from optloc.proof.batch import Answered, Asked, cost_here, empty_answer, prove_here
from optloc.proof.near import VALUE
from optloc.proof.position_costs import Affine, PositionCosts
from optloc.solvers.certify.branch_and_bound import budgets
from optloc.solvers.certify.position_cost import admitted
from optloc.solvers.policy import LISTED_GAP, equal_cost


@dataclass(frozen=True, slots=True)
class Edges:
    """Bounds of a problem, each on one side of a quantity.

    Parameters
    ----------
    quantity : int array (e,)
        Which quantity each bounds, in the order of `optloc.engine.admission.admission_of`.
    level : array (e,)
        Its value there.
    region : array (2, d)
        Corners of all that is admitted, where coordinates are bounded on all sides; else NaN.
    """

    quantity: Array
    level: Array
    region: Array


def edges_of(problem: Problem) -> Edges | None:
    """Return the bounds of a problem; None where a plane cannot separate both sides of one of them."""
    found: list[tuple[int, float]] = []
    for i, band in enumerate(problem.constraints):
        if not isinstance(band, Band) or is_exact(band) or band.lower.ndim or band.upper.ndim:
            return None
        if band.kind not in ("plane", "height") or (band.kind == "height" and np.isfinite(band.upper)):
            return None
        found += [(i, float(side)) for side in (band.lower, band.upper) if np.isfinite(side)]
    region = admitted(problem, problem.dimension)
    region = region if np.isfinite(region).all() else np.full_like(region, np.nan)
    return Edges(np.array([i for i, _ in found], dtype=np.int64), np.array([side for _, side in found]), region)


class Scratch(NamedTuple):
    """Arrays of a thread, for n fixes and e edges: costs, questions, answers, costs at places."""

    costs: PositionCosts
    asked: Asked
    answered: Answered
    found: Array


def scratch(affine: Affine, edges: Edges, count: int, d: int) -> Scratch:
    """Return arrays for a number of fixes."""
    n = count * len(edges.level)
    costs = affine.room(n)
    none = np.zeros(n, dtype=np.int64)
    asked = Asked(
        x=np.empty((n, d)),
        others=np.zeros((n, 0, d)),
        known=none,
        hidden=none.copy(),
        gaps=np.zeros((n, 1)),
        eps=np.empty(n),
        region=np.repeat(edges.region[None], n, axis=0),
        fallback=np.full((n, 2, d), np.nan),
        budget=budgets(np.zeros(n), len(costs.kinds), 1),
        planes=np.zeros((n, 1, 3)),
        surface=np.zeros((n, 0)),
    )
    return Scratch(costs, asked, empty_answer(n, d), np.zeros((2, n, 1)))


def are_out_of_reach(
    edges: Edges, room: Scratch, costs: PositionCosts, x: Array, cov: Array, cost: Array, value: Array, normal: Array
) -> bool:
    """Return whether nothing on the edges of n fixes costs less than `LISTED_GAP` more than them.

    Parameters
    ----------
    edges, room : Edges, Scratch
        Of the problem.
    costs : PositionCosts
        Of the fixes, written.
    x, cov, cost : array (n, d), (n, d, d), (n,)
        Fixes, covariances and costs.
    value, normal : array (n, k), (n, k, d)
        Bounded quantities there, and their gradients.
    """
    count, d = len(edges.level), x.shape[1]
    slope = normal[:, edges.quantity]
    across = (cov[:, None] @ slope[..., None])[..., 0]
    away = (edges.level - value[:, edges.quantity]) / (slope * across).sum(-1)
    # where the quadratic model is least on the plane
    place = x[:, None] + away[..., None] * across
    if np.isfinite(edges.region[0, 0]):
        place = np.clip(place, *edges.region)
    room.asked.x[:] = place.reshape(-1, d)
    unit = slope / np.sqrt((slope * slope).sum(-1, keepdims=True))
    room.asked.planes[:, 0, :d] = unit.reshape(-1, d)
    room.costs.w[:] = np.repeat(costs.w, count, axis=0)
    if len(room.costs.data) > 1:
        room.costs.data[:] = np.repeat(costs.data, count, axis=0)
    cost_here(room.costs, room.asked.x[:, None], room.found)
    level = np.repeat(cost + LISTED_GAP, count)
    more = room.found[0, :, 0] - level
    if not (more > equal_cost(level)).all():
        return False
    room.asked.eps[:] = more
    prove_here(room.costs, room.asked, room.answered)
    answered = room.answered
    return bool(((answered.verdict == VALUE) & (answered.bound > level - equal_cost(level))).all())
