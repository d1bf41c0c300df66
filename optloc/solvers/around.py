"""Starts for minima along curved bounds: points all around them, since a curved bound can have several minima.

Letters: n problems, q starts of each, `size` numbers of a parameter vector, d coordinates.
"""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array, Polygon
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import Face, Level, band_at, bound_of, exact
from optloc.linear.vectors import complete
from optloc.models.surfaces import SURFACES
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem

# Most starts on one surface. More points than these are reduced to those where the cost is least among neighbours.
_MOST = 40
# Neighbours of a point with which its cost is compared: those around a point of a grid. Starts kept of a larger set.
_NEIGHBOURS, _KEPT = 8, 12
# Places along an edge of a polygon, as shares of its length.
_ALONG = (0.1, 0.5, 0.9)


def starts_around(problem: Problem, face: Face, items: Array, first: Array) -> Array:
    """Return starts (n, q, size) all around the curved levels and the edges of a face; q is 0 without such levels.

    Parameters
    ----------
    problem : Problem
        Flat batch of problems.
    face : Face
        Levels on which the starts are needed. The starts are on one of them, or near it.
    items : int array (n,)
        Numbers of the problems.
    first : array (n, size)
        A candidate of each problem; it gives the unknowns that a level does not determine. NaN for none.
    """
    found = [_around_level(problem, level, items, first) for level in face]
    return np.concatenate([np.zeros((len(items), 0, first.shape[-1])), *found], axis=1)


def starts_on_equalities(problem: Problem, x: Array) -> Array:
    """Return starts (N, q, size) all around the curved equalities of problems with candidates x (N, q', size)."""
    face = exact(problem)
    if not any(_surface(problem, level) is not None for level in face):
        return np.zeros((len(x), 0, x.shape[-1]))
    good = ~np.isnan(x.sum(-1))
    first = np.where(good.any(1)[:, None], x[np.arange(len(x)), good.argmax(1)], np.nan)
    return starts_around(problem, face, np.arange(len(x)), first)


def _surface(problem: Problem, level: Level) -> object | None:
    """Return the function that spreads points around a level; None for a level without bends."""
    return SURFACES[band_at(problem, level).kind].around


def _around_level(problem: Problem, level: Level, items: Array, first: Array) -> Array:
    """Return starts (n, q, size) around one level; the arguments are as in `starts_around`."""
    none = np.zeros((len(items), 0, first.shape[-1]))
    constraint = problem.constraints[level.constraint]
    if isinstance(constraint, Polygon):
        assert isinstance(level.side, int)
        here, there = (constraint.vertices[(level.side + k) % len(constraint.vertices)] for k in (0, 1))
        points = [here + share * (there - here) for share in _ALONG]
        return _placed(problem, level, items, first, [np.array(points)] * len(items))
    band, around = band_at(problem, level), SURFACES[band_at(problem, level).kind].around
    if around is None or level.epoch is not None:
        return none
    bound = np.ravel(bound_of(problem, level))
    coefficients = band.coefficients if band.coefficients.ndim > 1 else band.coefficients[None]
    table = () if band.table is None else (band.table,)
    if len(bound) == len(coefficients) == 1:
        clouds = [around((*coefficients[0], *table), float(bound[0]))] * len(items)
    else:
        pick = [(coefficients[i % len(coefficients)], bound[i % len(bound)]) for i in items]
        clouds = [around((*c, *table), float(value)) for c, value in pick]
    return _placed(problem, level, items, first, clouds)


def _placed(problem: Problem, level: Level, items: Array, first: Array, clouds: list[Array]) -> Array:
    """Return starts (n, q, size) with the position of the target of a level at the points of each problem.

    `clouds` has the points (q, k) of each problem, k coordinates of the position. The other unknowns are copied
    from the vectors `first` (n, size).
    """
    band, n = band_at(problem, level), problem.layout.n_shared
    count, width = len(problem.motions), max(map(len, clouds), default=0)
    slot, shared = problem.layout.find(state_names(band.target, count, 0)[0])
    out = np.full((len(items), width, n), np.nan)
    if shared:
        for row, points in enumerate(clouds):
            out[row, : len(points)] = np.where(np.isfinite(first[row, :n]), first[row, :n], 0.0)
            k = points.shape[-1]
            if band.other is None:
                out[row, : len(points), slot.start : slot.start + k] = points
                continue
            # the points are differences of two positions, whose middle stays
            other, _ = problem.layout.find(state_names(band.other, count, 0)[0])
            both = [first[row, one.start : one.start + k] for one in (slot, other)]
            middle = np.nan_to_num(0.5 * (both[0] + both[1]))
            for one, sign in ((slot, 0.5), (other, -0.5)):
                out[row, : len(points), one.start : one.start + k] = middle + sign * points
    part = problem.take(items)
    if width <= _MOST:
        return complete(part, out)
    chosen = [_lowest(part.take(np.array([i])), out[i]) for i in range(len(items))]
    kept = np.full((len(items), _KEPT, n), np.nan)
    for row, found in enumerate(chosen):
        kept[row, : len(found)] = found
    return complete(part, kept)


def _lowest(problem: Problem, shared: Array) -> Array:
    """Return the shared unknowns (k, n), at most `_KEPT`, at which the cost is least among their neighbours.

    `shared` (q, n) are the candidates of one problem, with NaN for missing candidates.
    """
    from scipy.spatial import cKDTree

    shared = shared[np.isfinite(shared).all(-1)]
    x = complete(problem, shared[None])[0]
    with np.errstate(all="ignore"):
        cost = equations_at(problem.take(np.zeros(len(x), dtype=np.int64)), x).cost
    cost = np.where(np.isfinite(cost), cost, np.inf)
    slot = next(slot for slot in problem.layout.shared if slot.name.startswith("position"))
    place = shared[:, slot.start : slot.start + 2]
    near = cKDTree(place).query(place, min(_NEIGHBOURS + 1, len(place)))[1]
    low = np.flatnonzero(np.isfinite(cost) & (cost <= cost[near].min(-1)))
    return shared[low[np.argsort(cost[low], kind="stable")][:_KEPT]]
