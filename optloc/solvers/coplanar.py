"""Targets near the plane of all stations: both sides of it are two minima, or one region.

The data tell mirror images apart only where the cost on the plane between them is clearly higher than theirs; else they
are ends of one region.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from optloc.adequacy.coplanar import JOINED, Across, information_in_square, interval_across, is_coplanar, is_symmetric
from optloc.base import linalg
from optloc.base.records import take
from optloc.base.types import Array, Status
from optloc.compute.sums import equations_at
from optloc.problem.fix import Stage
from optloc.problem.problem import Problem
from optloc.solvers.policy import LISTED_GAP, SAME_PLACE
from optloc.solvers.pool import Curvature, Pool
from optloc.solvers.verdict.minima import measure_curvature, smallest_pivot

APART = 20.0
"""Standard deviations of w from the plane beyond which no region reaches across: they are ten of q."""


def join_sides(problem: Problem, pool: Pool) -> Pool:
    """Return a settled pool in which both sides of the plane of coplanar stations are one region, where they are.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Settled. Where the cost on the plane is out of question it stays as it is.
    """
    if problem.constraints or not is_symmetric(problem):
        return pool
    items = np.flatnonzero(is_coplanar(problem) & np.isfinite(pool.x).all(-1).any(-1))
    items = items[_is_near(problem.take(items), take(pool, items))] if len(items) else items
    if not len(items):
        return pool
    began, across, own = perf_counter(), Across.of(problem.take(items)), take(pool, items)
    found = _minima(across, own)
    good = np.flatnonzero(np.isfinite(found.cost[:, 0]))
    if not len(good):
        return pool
    items, across, own, found = items[good], across.take(good), take(own, good), found.take(good)
    fresh = _as_pool(problem.take(items), across, own, found)
    joined = int((found.on_plane - found.cost[:, 0] <= JOINED).sum())
    stage = Stage("fold", f"{joined} of {len(items)} on both sides of the plane at once", perf_counter() - began)
    return pool.merge(items, fresh, stage)


def _is_near(problem: Problem, pool: Pool) -> Array:
    """Return where a fix may be near the plane, for its standard deviations, or is none yet, (N,)."""
    assert pool.curvature is not None
    across = Across.of(problem)
    place, normal = pool.x[:, 0, across.part], across.axes[..., -1]
    w = np.abs(((place - across.centre) * normal).sum(-1))
    spread = pool.curvature.covariance[:, across.part, across.part]
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt((normal[:, None] @ spread @ normal[..., None])[:, 0, 0])
        return np.asarray((pool.code[:, 0] != Status.OK) | ~(w > APART * sigma))


@dataclass(frozen=True, slots=True)
class _Found:
    """Minima of N problems over the place in the plane and q, the cheapest first.

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

    def take(self, items: Array) -> _Found:
        """Return those of some problems."""
        return _Found(self.x[items], self.cost[items], self.on_plane[items])


def _minima(across: Across, pool: Pool) -> _Found:
    """Return the minima that steps in q reach from all candidates of a pool."""
    item, slot = pool.occupied
    each, shape = across.take(item), pool.x.shape[:2]
    start = each.to_plane(pool.x[item, slot])
    end, least, code = each.refine(start, held=False)
    x, cost = np.full(pool.x.shape, np.nan), np.full(shape, np.inf)
    good = (code == Status.OK) & np.isfinite(least)
    x[item[good], slot[good]], cost[item[good], slot[good]] = end[good], least[good]
    _, level = each.profile(np.where(good[:, None], end, start), each.least)
    on_plane = np.full(len(pool), np.inf)
    np.minimum.at(on_plane, item, np.where(np.isfinite(level), level, np.inf))
    order = np.argsort(cost, axis=1, kind="stable")
    x, cost = np.take_along_axis(x, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)
    keep = _distinct(across, x, cost)
    x, cost = np.where(keep[..., None], x, np.nan), np.where(keep, cost, np.inf)
    return _Found(x, cost, on_plane)


def _distinct(across: Across, x: Array, cost: Array) -> Array:
    """Return which minima (N, r), the cheapest first, are listed: near enough in cost, and no repetition."""
    n = across.problem.layout.n_shared
    information, _ = information_in_square(across, np.where(np.isfinite(x[:, 0]), x[:, 0], 0.0))
    folded = np.array(x[..., :n])
    folded[..., across.part.stop - 1] **= 2
    with np.errstate(invalid="ignore"):
        keep = np.isfinite(cost) & (cost <= cost[:, :1] + LISTED_GAP)
    for slot in range(1, x.shape[1]):
        for other in range(slot):
            away = folded[:, slot] - folded[:, other]
            with np.errstate(invalid="ignore"):
                same = (away[:, None] @ information @ away[..., None])[:, 0, 0] < SAME_PLACE
            keep[:, slot] &= ~(same & keep[:, other])
    return keep


def _as_pool(problem: Problem, across: Across, own: Pool, found: _Found) -> Pool:
    """Return minima and their mirror images as a settled pool, in space."""
    count, slots, size = found.x.shape
    w = found.x[..., across.part.stop - 1]
    x, cost = np.full((count, 2 * slots, size), np.nan), np.full((count, 2 * slots), np.inf)
    off = w > across.least[:, None]
    for slot in range(slots):
        # the upper side first, as the verdict has it
        upward = np.where(across.axes[:, -1, -1] < 0.0, -1.0, 1.0)
        flat = np.where(off[:, slot, None], found.x[:, slot], _on_plane(across, found.x[:, slot]))
        for side in (0, 1):
            x[:, 2 * slot + side] = across.to_space(flat, upward if side == 0 else -upward)
            there = np.isfinite(found.cost[:, slot]) & (off[:, slot] | (side == 0))
            cost[:, 2 * slot + side] = np.where(there, found.cost[:, slot], np.inf)
    x[~np.isfinite(cost)] = np.nan
    joined = np.zeros(cost.shape, dtype=bool)
    joined[:, :2] = (found.on_plane - found.cost[:, 0] <= JOINED)[:, None]
    curvature = _curvature(problem, across, found, x[:, 0], joined[:, 0])
    code = np.where(np.isfinite(cost), np.int8(Status.OK), np.int8(Status.UNAVAILABLE))
    blank = np.zeros(cost.shape, dtype=int)
    plain = None if own.plain is None else np.zeros(count, dtype=bool)
    return replace(own, x=x, cost=cost, code=code, face=blank, joined=joined, curvature=curvature, plain=plain)


def _on_plane(across: Across, x: Array) -> Array:
    out = np.array(x)
    out[:, across.part.stop - 1] = 0.0
    return out


def _curvature(problem: Problem, across: Across, found: _Found, x: Array, joined: Array) -> Curvature:
    """Return the curvature at minima x (N, size): of a joined region with the second moment of both sides about it."""
    with np.errstate(all="ignore"):
        at = measure_curvature(problem, equations_at(problem, x), x, np.zeros(len(x), dtype=int))
    covariance, kappa = at.covariance.copy(), np.full((len(x), 2), np.nan)
    items = np.flatnonzero(joined)
    if not len(items):
        return replace(at, kappa=kappa)
    across, best = across.take(items), found.x[items, 0]
    information, ok = information_in_square(across, best)
    square, regular = linalg.inverse(information)
    own = across.part.stop - 1
    _, end = interval_across(across, best, found.cost[items, 0])
    # both sides are alike: the distance has no correlation with anything
    square[:, own], square[:, :, own] = 0.0, 0.0
    square[:, own, own] = (end / np.sqrt(JOINED)) ** 2 + best[:, own] ** 2
    turn = np.broadcast_to(np.eye(information.shape[-1]), information.shape).copy()
    turn[:, across.part, across.part] = across.axes
    covariance[items] = turn @ square @ np.swapaxes(turn, -1, -2)
    kappa[items] = np.inf
    known, weakest, of_all = np.array(at.regular), np.array(at.weakest), np.array(at.information)
    known[items] = ok & regular
    weakest[items] = smallest_pivot(information)
    of_all[items], _ = linalg.inverse(covariance[items])
    return replace(at, covariance=covariance, information=of_all, regular=known, weakest=weakest, kappa=kappa)
