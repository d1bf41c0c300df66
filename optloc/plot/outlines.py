"""What covers where an ellipse does not, as lines of a picture: an egg for a far fix, a banana or a ring as it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.problem.chart import CURVED, INVERSE_RANGE, Chart, quantile
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.uncertainty.region import directions, likelihood_region

# Cells of a region that is drawn, by dimension: finer than a picture shows. And regions that are drawn as they are:
# each takes a tenth of a second.
_CELLS, _MOST = {2: 400, 3: 3000}, 12
# Where a region that goes on to infinity is cut off in a picture: so many times the distance of the fix.
_FAR = 3.0
# Points around an outline in the plane, and on a spiral around one in space: 4 degrees apart.
_POINTS, _SPIRAL = 181, 3000
# Points of the grid on which many cells are joined, and steps up to which a cell is all of the rectangle around it.
_GRID, _SMALL = 300, 3

Pieces = tuple[Array, ...]
"""Convex parts of a region, the corners (v, d) of each."""


def pieces_of(problem: Problem, fix: Fix, level: float = 0.95) -> list[Pieces]:
    """Return the regions of the fixes of a batch of one position where an ellipse does not cover.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    fix : Fix
        Their fixes.
    level : float
        Probability that a region contains the target.

    Returns
    -------
    list of tuple of array (v, d)
        Metres in the problem's frame; empty where the ellipse covers, or nothing is known of what does.
    """
    flat = fix if len(fix.shape) == 1 else fix.flat()
    if flat.chart is None:
        return [() for _ in range(len(flat))]
    kinds = np.where(np.isfinite(flat.cov).all((-1, -2)), flat.chart.kind, -1)
    own = _one_each(problem, len(flat))
    found: list[Pieces] = []
    for i, kind in enumerate(kinds):
        if kind == INVERSE_RANGE:
            found.append((far_hull(_item(flat.chart, i), level),))
        elif kind == CURVED and own is not None and (kinds == CURVED).sum() <= _MOST:
            found.append(_cells(own.take(np.array([i])), flat[i], level))
        else:
            found.append(())
    return found


def _one_each(problem: Problem, count: int) -> Problem | None:
    """Return the problems of so many fixes as a flat batch: those of a batch, or of the epochs of a file."""
    flat = problem.flat()
    if flat.batch_shape[0] != count and problem.batch_shape == () and separable(problem):
        flat = by_epoch(problem).flat()
    return flat if flat.batch_shape[0] == count else None


def _item(charts: Chart, i: int) -> Chart:
    return Chart(charts.kind[i], charts.position[i], charts.covariance[i], charts.centre[i])


def far_hull(chart: Chart, level: float) -> Array:
    """Return points (v, d) whose convex hull is the plan of the region of a fix that is Gaussian in its inverse range.

    It is cut off at three times the distance of the fix: pictures have an end.
    """
    d = len(chart.position)
    if d == 2:
        turn = 2.0 * np.pi * np.arange(_POINTS) / _POINTS
        ways = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    else:
        high = np.linspace(-1.0, 1.0, _SPIRAL)  # from pole to pole
        turn, across = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(_SPIRAL), np.sqrt(1.0 - high**2)
        ways = np.concatenate([np.stack([across * np.cos(turn), across * np.sin(turn), high], -1), directions(d)])
    # Two coordinates of it are seen: their ellipse holds the level, as that of a covariance does.
    scale = np.sqrt(np.diagonal(chart.spread))
    lower = scale[:, None] * np.linalg.cholesky(chart.spread / np.outer(scale, scale))
    away = np.sqrt(quantile(level, 2)) * ways @ lower.T
    # What would be farther is pulled back along its chord to the fix.
    share = np.where(away[:, -1] < 0.0, np.minimum(1.0, (1.0 - 1.0 / _FAR) / np.maximum(-away[:, -1], 1e-300)), 1.0)
    return chart.to_position(chart.mean + share[:, None] * away)


def _cells(problem: Problem, fix: Fix, level: float) -> Pieces:
    """Return the cells of the region of a curved fix; none where it cannot be enclosed."""
    try:
        region = likelihood_region(problem, fix, level, boxes=_CELLS[problem.dimension])
    except InvalidProblem:
        return ()
    if region.cells is None:
        return ()
    centre, reach = region.surface.chart.centre, _FAR * float(region.surface.chart.distance)
    corners = region.cells.corners
    corners = np.where(np.isfinite(corners).all(-1, keepdims=True), corners, centre + reach * region.cells.directions)
    return tuple(corners)


# Lines around convex parts.


def rings(pieces: Sequence[Array]) -> list[Array]:
    """Return closed lines (r, 2) around the union of convex parts, given by their corners (v, 2)."""
    return [line for polygon in polygons(pieces) for line in polygon]


def polygons(pieces: Sequence[Array]) -> list[list[Array]]:
    """Return the union of convex parts, given by their corners (v, 2), as polygons: closed lines (r, 2), then holes.

    Lines run counter-clockwise, those around holes clockwise.
    """
    if not pieces:
        return []
    if len(pieces) == 1:
        return [[hull(pieces[0])]]
    try:
        from contourpy import FillType, contour_generator
    except ImportError:  # it comes with the pictures' library; without it the parts stay apart
        return [[hull(piece)] for piece in pieces]
    corners = np.stack(pieces)
    low, high = corners.min((0, 1)), corners.max((0, 1))
    # One step both ways, as pictures have one scale; and a rim, so that lines close.
    step = max(float((high - low).max()), np.finfo(float).tiny) / (_GRID - 6)
    place = (corners - low) / step + 3.0
    mask = np.zeros((_GRID + 1, _GRID + 1))
    for one in place:
        first, last = np.floor(one.min(0)).astype(int), np.ceil(one.max(0)).astype(int)
        inside = 1.0 if (last - first).max() <= _SMALL else _nodes_inside(one, first, last)
        part = mask[first[0] : last[0] + 1, first[1] : last[1] + 1]
        np.maximum(part, inside, out=part)
    found: Any = contour_generator(z=mask.T, fill_type=FillType.OuterOffset).filled(0.5, 2.0)
    return [
        [low + (part - 3.0) * step for part in np.split(np.asarray(line), np.asarray(end, dtype=int)[1:-1])]
        for line, end in zip(*found, strict=True)
    ]


def _nodes_inside(corners: Array, first: Array, last: Array) -> Array:
    """Return which nodes of a grid, from the first to the last (2,), lie in a convex hull or half a step from it."""
    from scipy.spatial import ConvexHull

    # Joggled: a flat cell has a hull, too.
    sides = ConvexHull(corners, qhull_options="QJ").equations
    x, y = (np.arange(first[k], last[k] + 1) for k in range(2))
    away = sides[:, 0, None, None] * x[:, None] + sides[:, 1, None, None] * y + sides[:, 2, None, None]
    return np.asarray((away <= 0.5).all(0), dtype=float)


def hull(points: Array) -> Array:
    """Return the convex hull of points (v, 2) as a closed line (r, 2)."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        # Scaled: a needle is no degenerate hull.
        size = np.maximum(np.ptp(points, axis=0), np.finfo(float).tiny)
        around = ConvexHull((points - points.min(0)) / size).vertices
    except QhullError:
        return points
    return np.asarray(points[np.append(around, around[0])])
