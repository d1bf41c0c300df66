"""Targets near the plane of all stations: the two sides of the plane are two minima, or one likelihood region.

The data separate mirror images only if the cost on the plane between them is clearly higher. Otherwise both belong to
one region.

Letters: N problems, r minima of a problem, q slots of a pool, `size` numbers of a parameter vector. w is the distance
from the plane in metres. The minima are found in the coordinates of `Across`: position in the plane, and w^2. The
parameter `across` holds the plane of each problem, and `own` the pool before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from optloc.base import linalg
from optloc.base.records import take
from optloc.base.types import Array, Status
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import TOLERANCE, exact, violation
from optloc.model_checks.coplanar import (
    JOINED,
    Across,
    information_in_square,
    interval_across,
    is_coplanar,
    is_symmetric,
)
from optloc.problem.fix_parts import Stage
from optloc.problem.problem import Problem
from optloc.solvers.horizon import is_hidden
from optloc.solvers.policy import LISTED_GAP, SAME_PLACE
from optloc.solvers.pool import Curvature, Pool
from optloc.solvers.verdict.minima import measure_curvature, smallest_pivot

APART = 20.0
"""Standard deviations of the distance w from the plane beyond which no region reaches across: ten of w^2."""


def join_sides(problem: Problem, pool: Pool) -> Pool:
    """Return a settled pool in which both sides of the plane of the stations are one region, if the data allow both.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Settled. Fixes far from the plane are returned unchanged. So are fixes whose two sides both break a constraint.
    """
    if exact(problem) or not is_symmetric(problem):
        return pool
    items = np.flatnonzero(is_coplanar(problem) & np.isfinite(pool.x).all(-1).any(-1))
    items = items[_is_near(problem.take(items), take(pool, items))] if len(items) else items
    if not len(items):
        return pool
    began, across, own = perf_counter(), Across.of(problem.take(items)), take(pool, items)
    found = _minima(across, own)
    # a problem without a finished minimum keeps its pool
    good = np.flatnonzero(np.isfinite(found.cost[:, 0]))
    if not len(good):
        return pool
    items, across, own, found = items[good], across.take(good), take(own, good), found.take(good)
    part = problem.take(items)
    sides = _sides(part, across, found)
    # a problem of which constraints or the Earth exclude both sides keeps its pool too
    met = np.flatnonzero(np.isfinite(sides.cost[:, :2]).any(1))
    if not len(met):
        return pool
    items, across, own, found, sides = items[met], across.take(met), take(own, met), found.take(met), sides.take(met)
    fresh = _as_pool(problem.take(items), across, own, found, sides)
    joined = int(_is_joined(found, sides).sum())
    stage = Stage("fold", f"{joined} of {len(items)} include both sides of the plane", perf_counter() - began)
    return pool.merge(items, fresh, stage)


def _is_near(problem: Problem, pool: Pool) -> Array:
    """Return flags (N,) of fixes near the plane, within `APART` standard deviations, or not finished.

    Only for these fixes may both sides of the plane be one region.
    """
    assert pool.curvature is not None
    across = Across.of(problem)
    place, normal = pool.x[:, 0, across.part], across.axes[..., -1]
    w = np.abs(((place - across.centre) * normal).sum(-1))
    spread = pool.curvature.covariance[:, across.part, across.part]
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt((normal[:, None] @ spread @ normal[..., None])[:, 0, 0])
        return np.asarray((pool.code[:, 0] != Status.OK) | ~(w > APART * sigma))


@dataclass(frozen=True, slots=True)
class _FoundSides:
    """Minima of N problems over the position in the plane and w^2, the squared distance from it; the cheapest first.

    Parameters
    ----------
    x : array (N, r, size)
        In the coordinates of `Across`; NaN in empty slots.
    cost : array (N, r)
        Infinite in empty slots.
    on_plane : array (N,)
        Least cost on the plane.
    """

    x: Array
    cost: Array
    on_plane: Array

    def take(self, items: Array) -> _FoundSides:
        """Return the entries of problems `items`."""
        return _FoundSides(self.x[items], self.cost[items], self.on_plane[items])


def _minima(across: Across, pool: Pool) -> _FoundSides:
    """Return the minima that steps in the coordinates of `Across` reach from all candidates of a pool."""
    item, slot = pool.occupied
    each, shape = across.take(item), pool.x.shape[:2]
    start = each.to_plane(pool.x[item, slot])
    end, least, code = each.refine(start, held=False)
    x, cost = np.full(pool.x.shape, np.nan), np.full(shape, np.inf)
    good = (code == Status.OK) & np.isfinite(least)
    x[item[good], slot[good]], cost[item[good], slot[good]] = end[good], least[good]
    # least cost on the plane: the other coordinates are refined at the distance that counts as zero
    _, level = each.profile(np.where(good[:, None], end, start), each.least)
    on_plane = np.full(len(pool), np.inf)
    np.minimum.at(on_plane, item, np.where(np.isfinite(level), level, np.inf))
    order = np.argsort(cost, axis=1, kind="stable")
    x, cost = np.take_along_axis(x, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)
    keep = _distinct(across, x, cost)
    x, cost = np.where(keep[..., None], x, np.nan), np.where(keep, cost, np.inf)
    return _FoundSides(x, cost, on_plane)


def _distinct(across: Across, x: Array, cost: Array) -> Array:
    """Return flags (N, r) of distinct minima within the listed gap of cost.

    The minima x (N, r, size) are in ascending order of cost (N, r). Of equal minima the first one is kept.
    """
    n = across.problem.layout.n_shared
    information, _ = information_in_square(across, np.where(np.isfinite(x[:, 0]), x[:, 0], 0.0))
    folded = np.array(x[..., :n])
    folded[..., across.part.stop - 1] **= 2  # w^2 is the coordinate of the information
    with np.errstate(invalid="ignore"):
        keep = np.isfinite(cost) & (cost <= cost[:, :1] + LISTED_GAP)
    for slot in range(1, x.shape[1]):
        for other in range(slot):
            away = folded[:, slot] - folded[:, other]
            with np.errstate(invalid="ignore"):
                same = (away[:, None] @ information @ away[..., None])[:, 0, 0] < SAME_PLACE
            keep[:, slot] &= ~(same & keep[:, other])
    return keep


@dataclass(frozen=True, slots=True)
class _Sides:
    """Minima on both sides of the plane: two slots for each minimum of `_FoundSides`, the likelier side first.

    Parameters
    ----------
    x : array (N, 2r, size)
        In space; NaN in empty slots.
    cost : array (N, 2r)
        Infinite in empty slots, and for minima that a constraint forbids or the Earth hides.
    on_plane : bool array (N,)
        Whether the first minimum is in the plane.
    """

    x: Array
    cost: Array
    on_plane: Array

    def take(self, items: Array) -> _Sides:
        """Return the entries of problems `items`."""
        return _Sides(self.x[items], self.cost[items], self.on_plane[items])


def _sides(problem: Problem, across: Across, found: _FoundSides) -> _Sides:
    """Return the minima on both sides of the plane, in space; the cost of a minimum that is not admitted is infinite.

    A minimum in the plane has one slot only.
    """
    count, slots, size = found.x.shape
    x, cost = np.full((count, 2 * slots, size), np.nan), np.full((count, 2 * slots), np.inf)
    off = found.x[..., across.part.stop - 1] > across.least[:, None]
    # the upper side first, as in the verdict; `upward` is the sign of the normal that points up
    upward = np.where(across.axes[:, -1, -1] < 0.0, -1.0, 1.0)
    for slot in range(slots):
        minimum = np.array(found.x[:, slot])
        minimum[~off[:, slot], across.part.stop - 1] = 0.0
        for side, sense in ((0, upward), (1, -upward)):
            in_space = across.to_space(minimum, sense)
            exists = np.isfinite(found.cost[:, slot]) & (off[:, slot] | (side == 0))
            if exists.any():
                known = np.where(exists[:, None], in_space, 0.0)
                exists &= (violation(problem, known) <= TOLERANCE) & ~is_hidden(problem, known)
            x[exists, 2 * slot + side], cost[exists, 2 * slot + side] = in_space[exists], found.cost[exists, slot]
    # if constraints admit only the second side, it becomes the first
    swap = ~np.isfinite(cost[:, 0]) & np.isfinite(cost[:, 1])
    x[swap, :2], cost[swap, :2] = x[swap, 1::-1], cost[swap, 1::-1]
    return _Sides(x, cost, ~off[:, 0])


def _is_joined(found: _FoundSides, sides: _Sides) -> Array:
    """Return flags (N,) of problems in which both sides of the plane are one region.

    The region is one if constraints admit both sides, and the cost on the plane is at most `JOINED` above the least
    cost.
    """
    both = np.isfinite(sides.cost[:, :2]).all(1) | sides.on_plane
    return np.asarray(both & (found.on_plane - found.cost[:, 0] <= JOINED))


def _as_pool(problem: Problem, across: Across, own: Pool, found: _FoundSides, sides: _Sides) -> Pool:
    """Return minima on both sides of the plane as a settled pool, together with minima on constraints.

    `own` is the pool before, with the minima on constraints.
    """
    x, cost = sides.x, sides.cost
    joined = _is_joined(found, sides)
    pair = np.where(joined[:, None, None], x[:, :2], np.nan)
    curvature = _curvature(problem, across, found, x[:, 0], joined)
    face = np.zeros(cost.shape, dtype=int)
    if problem.constraints:
        constrained = _has_active_constraint(across, own, cost[:, 0])
        x = np.concatenate([x, np.where(constrained[..., None], own.x, np.nan)], axis=1)
        cost = np.concatenate([cost, np.where(constrained, own.cost, np.inf)], axis=1)
        face = np.concatenate([face, np.where(constrained, own.face, 0)], axis=1)
    order = np.argsort(~np.isfinite(cost), axis=1, kind="stable")[:, : int(np.isfinite(cost).sum(1).max())]
    x = np.take_along_axis(x, order[..., None], axis=1)
    cost, face = np.take_along_axis(cost, order, axis=1), np.take_along_axis(face, order, axis=1)
    code = np.where(np.isfinite(cost), np.int8(Status.OK), np.int8(Status.UNAVAILABLE))
    plain = None if own.plain is None else np.zeros(len(x), dtype=bool)
    return replace(own, x=x, cost=cost, code=code, face=face, pair=pair, curvature=curvature, plain=plain)


def _has_active_constraint(across: Across, own: Pool, least: Array) -> Array:
    """Return flags (N, q) of minima with an active constraint, off the plane, with costs within the listed gap.

    `least` (N,) is the least cost of each problem.
    """
    away = own.x[..., across.part] - across.centre[:, None]
    w = np.abs((away * across.axes[:, None, :, -1]).sum(-1))
    with np.errstate(invalid="ignore"):
        near = (own.code == Status.OK) & (own.cost <= least[:, None] + LISTED_GAP)
        return np.asarray((own.face > 0) & near & (w > across.least[:, None]))


def _curvature(problem: Problem, across: Across, found: _FoundSides, x: Array, joined: Array) -> Curvature:
    """Return the curvature at minima x (N, size).

    `joined` (N,) flags regions with both sides of the plane: their covariance is the second moment of both sides about
    x.
    """
    with np.errstate(all="ignore"):
        curvature = measure_curvature(problem, equations_at(problem, x), x, np.zeros(len(x), dtype=int))
    covariance, kappa = curvature.covariance.copy(), np.full((len(x), 2), np.nan)
    items = np.flatnonzero(joined)
    if not len(items):
        return replace(curvature, kappa=kappa)
    across, best = across.take(items), found.x[items, 0]
    information, ok = information_in_square(across, best)
    square, regular = linalg.inverse(information)
    axis = across.part.stop - 1
    _, upper = interval_across(across, best, found.cost[items, 0])
    # both sides are symmetric, so the distance from the plane is not correlated with other unknowns
    square[:, axis], square[:, :, axis] = 0.0, 0.0
    square[:, axis, axis] = (upper / np.sqrt(JOINED)) ** 2 + best[:, axis] ** 2
    rotation = np.broadcast_to(np.eye(information.shape[-1]), information.shape).copy()
    rotation[:, across.part, across.part] = across.axes
    covariance[items] = rotation @ square @ np.swapaxes(rotation, -1, -2)
    kappa[items] = np.inf  # no single Gaussian describes both sides
    regular_now, weakest, of_all = (
        np.array(curvature.regular),
        np.array(curvature.weakest),
        np.array(curvature.information),
    )
    regular_now[items] = ok & regular
    weakest[items] = smallest_pivot(information)
    of_all[items], _ = linalg.inverse(covariance[items])
    return replace(
        curvature, covariance=covariance, information=of_all, regular=regular_now, weakest=weakest, kappa=kappa
    )
