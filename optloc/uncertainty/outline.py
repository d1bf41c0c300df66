"""The likelihood region of a fix in the plane of a picture: a contour of the cost, of any shape.

In the plane the region is ``f <= f(fix) + q``. In space a picture shows two coordinates. The third coordinate then
takes its best value, and q is the quantile of chi-square with two degrees of freedom, as for an ellipse from a
covariance. So the outline contains the two visible coordinates with the stated probability.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.linear.constraints import Face, exact, levels, restore
from optloc.model_checks.shape import profile
from optloc.problem.chart import CURVED, INVERSE_RANGE, Chart, quantile
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.uncertainty.contour import Polygon, area, trace, trace_nodes
from optloc.uncertainty.region import RegionSurface, likelihood_region, passes

# Most cells that hold a region, by dimension; the contour is searched in them.
_CELLS = {2: 400, 3: 3000}
# Distance, in distances of the fix, at which a picture cuts off a region that reaches to infinity.
FAR = 3.0
# Share of that distance from which a line counts as cut off.
_AT_EDGE = 0.995
# Steps across the ellipsoid of a far fix, by dimension, and the factor by which the search extends beyond the
# ellipsoid, since the fix is not exactly Gaussian there.
_STEPS, _BEYOND = {2: 24, 3: 14}, 1.4
# Positions along the hidden coordinate, and steps from the best two of them: a cost with two minima there has both.
_ALONG, _NEWTON = 9, 4
# Nodes across the plane of the table that holds the reach of cells along the third coordinate.
_ACROSS = 160
# Half the drawn width of a region that is a line, as a share of its length: visible, but not mistaken for an area.
_WIDTH = 2e-3
# Halvings that find the ends of a line within a step.
_HALVINGS = 20
# Steps of the grid from the fix to the level of a Gaussian, most nodes (more than a picture shows), and most doublings
# of the step for larger regions: a region of a million standard deviations still ends.
_FINE, _NODES, _DOUBLINGS = 8.0, 4000, 20


@dataclass(frozen=True, slots=True)
class Outline:
    """A region in a plane.

    Parameters
    ----------
    polygons : tuple of list of array (r, 2)
        Closed lines along the axes of the plane, metres from the fix: the outer one counter-clockwise, then those
        around holes, clockwise.
    cut : bool
        Whether the region continues beyond the drawn part.
    """

    polygons: tuple[Polygon, ...]
    cut: bool = False

    @property
    def lines(self) -> list[Array]:
        """Return all closed lines (r, 2)."""
        return [line for polygon in self.polygons for line in polygon]


def outline_of(problem: Problem, fix: Fix, plane: Array, level: float = 0.95) -> Outline | None:
    """Return the region of a fix, in a plane through it, if no ellipse covers it.

    Parameters
    ----------
    problem : Problem
        A single problem of one position.
    fix : Fix
        Its fix.
    plane : array (2, d)
        Unit vectors at right angles: the axes of the plane in the frame of the problem.
    level : float
        Probability that the region contains the visible coordinates of the target.

    Returns
    -------
    Outline or None
        None if an ellipse covers, or if the region cannot be enclosed.
    """
    if fix.chart is not None and fix.chart.truncated is not None and fix.chart.cut_off:
        line = fix.chart.truncated.outline(plane, level)
        return Outline(([line if area(line) > 0.0 else line[::-1]],))
    if fix.chart is None or int(fix.chart.kind) not in (CURVED, INVERSE_RANGE) or not np.isfinite(fix.cov).all():
        return None
    if exact(problem):
        return _held(problem, fix, plane, level)
    try:
        if int(fix.chart.kind) == INVERSE_RANGE:
            surface, cells = RegionSurface.of(problem, fix), _far_cells(fix.chart, level)
        else:
            region = likelihood_region(problem, fix, level, boxes=_CELLS[problem.dimension])
            if region.cells is None:
                return None
            surface, cells = region.surface, region.cells.corners
            away = fix.chart.centre + FAR * float(fix.chart.distance) * region.cells.directions
            cells = np.where(np.isfinite(cells).all(-1, keepdims=True), cells, away)
    except InvalidProblem:
        return None
    return _free(surface, cells, plane, level)


def _free(surface: RegionSurface, cells: Array, plane: Array, level: float) -> Outline | None:
    """Return the outline of a region that cells (m, v, d) hold."""
    q, centre = quantile(level, 2), (surface.chart.centre - surface.position) @ plane.T
    reach = FAR * float(surface.chart.distance)
    cost = _profile(surface, cells, plane)

    def value(points: Array) -> Array:
        beyond = np.sqrt(((points - centre) ** 2).sum(-1)) / reach - 1.0
        return np.asarray(np.maximum((cost(points) - surface.least) / q - 1.0, beyond))

    polygons = trace(value, (cells - surface.position) @ plane.T)
    far = max((np.sqrt(((line - centre) ** 2).sum(-1)).max() for each in polygons for line in each), default=0.0)
    return Outline(tuple(polygons), bool(far > _AT_EDGE * reach)) if polygons else None


def _profile(surface: RegionSurface, cells: Array, plane: Array) -> Callable[[Array], Array]:
    """Return a function from points (n, 2) of a plane to the least cost (n,) over the hidden coordinate."""
    if plane.shape[1] == 2:
        return lambda points: surface.cost(surface.position + points @ plane)
    normal = np.cross(plane[0], plane[1])
    seen, depth = (cells - surface.position) @ plane.T, (cells - surface.position) @ normal
    origin = seen.min((0, 1))
    step = max(float((seen.max((0, 1)) - origin).max()), np.finfo(float).tiny) / (_ACROSS - 3)
    low, high = np.full((_ACROSS + 1, _ACROSS + 1), np.inf), np.full((_ACROSS + 1, _ACROSS + 1), -np.inf)
    first = np.floor((seen.min(1) - origin) / step).astype(int)
    last = np.ceil((seen.max(1) - origin) / step).astype(int) + 2
    for (i, j), (m, n), least, most in zip(first, last, depth.min(1), depth.max(1), strict=True):
        np.minimum(low[i:m, j:n], least, out=low[i:m, j:n])
        np.maximum(high[i:m, j:n], most, out=high[i:m, j:n])

    def least_cost(points: Array) -> Array:
        out = np.full(len(points), np.inf)
        node = np.round((points - origin) / step).astype(int)
        inside = ((node >= 0) & (node <= _ACROSS)).all(1)
        inside[inside] = low[tuple(node[inside].T)] <= high[tuple(node[inside].T)]
        if inside.any():
            own = tuple(node[inside].T)
            out[inside] = _least_along(surface, points[inside] @ plane, normal, low[own], high[own])
        return out

    return least_cost


def _least_along(surface: RegionSurface, base: Array, normal: Array, low: Array, high: Array) -> Array:
    """Return the least costs (n,) along lines through points (n, d) about the fix, between two ends (n,) of each."""

    def at(t: Array) -> tuple[Array, Array, Array]:
        points = surface.position + base[:, None] + t[..., None] * normal
        cost, information, vector = surface.look(points)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = (vector @ normal) / (information @ normal @ normal)
        return cost, t, np.where(np.isfinite(step), step, 0.0)

    cost, t, step = at(low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, _ALONG))
    # the best two of the local minima along the line
    around = np.pad(cost, ((0, 0), (1, 1)), constant_values=np.inf)
    valley = np.where((cost <= around[:, :-2]) & (cost <= around[:, 2:]), cost, np.inf)
    pick = np.argsort(valley, axis=1)[:, :2]
    cost, t, step = (np.take_along_axis(each, pick, axis=1) for each in (cost, t, step))
    for _ in range(_NEWTON):
        new = at(np.clip(t + step, low[:, None], high[:, None]))
        better = new[0] < cost
        cost, t = np.where(better, new[0], cost), np.where(better, new[1], t)
        step = np.where(better, new[2], 0.25 * step)
    return np.asarray(cost.min(1))


def _far_cells(chart: Chart, level: float) -> Array:
    """Return cells (m, 2^d, d) that hold the region of a fix that is Gaussian in its inverse range."""
    d = len(chart.position)
    values, vectors = np.linalg.eigh(chart.spread)
    axes = np.sqrt(np.maximum(values, 0.0) * quantile(level, 2)) * vectors
    edges = np.linspace(-_BEYOND, _BEYOND, _STEPS[d] + 1)
    corner = np.array(list(product((0, 1), repeat=d)))
    first = np.array(list(product(range(_STEPS[d]), repeat=d)))
    cells = edges[first[:, None] + corner]
    cells = cells[np.sqrt((cells**2).sum(-1)).min(1) <= _BEYOND]
    at = chart.mean + cells @ axes.T
    at[..., -1] = np.maximum(at[..., -1], 0.9 / FAR)  # farther points are cut off
    return chart.to_position(at)


# A region that equalities hold: part of a surface, or of a line.


def _held(problem: Problem, fix: Fix, plane: Array, level: float) -> Outline | None:
    """Return the outline of a region along a surface, or a strip around a region along a line."""
    assert fix.chart is not None
    held = cost_along(problem, fix, level, FAR * float(fix.chart.distance))
    nodes, step = held.flooded()
    if not len(nodes):
        return None
    if held.axes.shape[1] == 1:
        ends = held.away(nodes * step)
        return Outline(_strips(held, plane, fix.position), bool(ends.max() > _AT_EDGE))
    around = trace_nodes(held.value, nodes, step)
    far = max((held.away(line).max() for polygon in around for line in polygon), default=0.0)
    seen = [[(held.place(line) - fix.position) @ plane.T for line in polygon] for polygon in around]
    return Outline(tuple(map(_turned, seen)), bool(far > _AT_EDGE)) if seen else None


def _turned(polygon: Polygon) -> Polygon:
    """Return a polygon whose outer line runs counter-clockwise: the axes of a surface may be seen from below."""
    return polygon if area(polygon[0]) >= 0.0 else [line[::-1] for line in polygon]


def _strips(held: EqualityCost, plane: Array, position: Array) -> tuple[Polygon, ...]:
    """Return thin strips around a region along a line: without a width it would be invisible."""
    nodes, step = held.flooded()
    order = np.sort(nodes[:, 0])
    parts = np.split(order, np.flatnonzero(np.diff(order) > 1) + 1)
    found = []
    for part in parts:
        ends = _ends(held, part, step)
        along = np.concatenate([ends[:1], part[1:-1] * step, ends[1:]])
        line = (held.place(along[:, None]) - position) @ plane.T
        way = np.gradient(line, axis=0)
        length = np.maximum(np.sqrt((way**2).sum(-1, keepdims=True)), np.finfo(float).tiny)
        aside = _WIDTH * np.ptp(line, axis=0).max() * way[:, ::-1] / length * [-1.0, 1.0]
        found.append([np.concatenate([line - aside, (line + aside)[::-1], (line - aside)[:1]])])
    return tuple(map(_turned, found))


def _ends(held: EqualityCost, part: Array, step: float) -> Array:
    """Return the ends (2,) of an interval of nodes, at which the cost meets the level."""
    inside = np.array([part[0], part[-1]], dtype=float) * step
    outside = inside + np.array([-step, step])
    for _ in range(_HALVINGS):
        middle = 0.5 * (inside + outside)
        within = held.value(middle[:, None]) < 0.0
        inside, outside = np.where(within, middle, inside), np.where(within, outside, middle)
    return np.asarray(inside)


@dataclass(frozen=True, slots=True)
class EqualityCost:
    """The cost along the surface or line of equalities, in coordinates from the fix along its principal axes.

    Parameters
    ----------
    problem : Problem
        Flat batch of one, rows weighted as in the fix.
    face : Face
        The equalities.
    x : array (1, size)
        All unknowns of the fix.
    own : slice
        Slice of the position in the unknowns.
    axes : array (d, k)
        One standard deviation along each axis, metres.
    least : float
        Cost of the fix.
    quantile : float
        Largest excess of the cost in the region: the quantile of chi-square with k degrees of freedom.
    reach : float
        Largest distance from the fix, metres, which also ends a region without an end.
    starts : array (q, k)
        The fix, and alternatives within the region.
    """

    problem: Problem
    face: Face
    x: Array
    own: slice
    axes: Array
    least: float
    quantile: float
    reach: float
    starts: Array

    def place(self, steps: Array) -> Array:
        """Return the positions (n, d), metres, of coordinates (n, k)."""
        return np.asarray(self._vectors(steps)[:, self.own])

    def away(self, steps: Array) -> Array:
        """Return the distances (n,) of coordinates (n, k) from the fix, as shares of the reach."""
        return np.asarray(np.sqrt(((self.place(steps) - self.x[0, self.own]) ** 2).sum(-1)) / self.reach)

    def value(self, steps: Array) -> Array:
        """Return numbers (n,) that are negative inside the region and zero on its edge."""
        points = self._vectors(steps)
        cost = profile(self.problem, points[:, None], self.x, passes(self.problem))[0][:, 0]
        beyond = np.sqrt(((points[:, self.own] - self.x[0, self.own]) ** 2).sum(-1)) / self.reach - 1.0
        return np.asarray(np.maximum((cost - self.least) / self.quantile - 1.0, beyond))

    def flooded(self) -> tuple[Array, float]:
        """Return the connected nodes (n, k) of a grid in the region, and the step; empty if there are too many."""
        step = float(np.sqrt(self.quantile)) / _FINE
        for _ in range(_DOUBLINGS):
            found = _flooded(lambda steps: self.value(steps) <= 0.0, self.starts, step)
            if found is not None:
                return found, step
            step *= 2.0
        return np.zeros((0, self.axes.shape[1]), dtype=int), step

    def _vectors(self, steps: Array) -> Array:
        """Return vectors (n, size) of coordinates (n, k), moved onto the equalities."""
        points = np.repeat(self.x, len(steps), axis=0)
        points[:, self.own] += steps @ self.axes.T
        return restore(self.problem, self.face, points)


def cost_along(problem: Problem, fix: Fix, level: float, reach: float) -> EqualityCost:
    """Return the cost of a fix along the surface or line of its equalities.

    Parameters
    ----------
    problem : Problem
        The problem of the fix: one static position, held by equalities.
    fix : Fix
        A single fix.
    level : float
        Probability that the region contains the target.
    reach : float
        Largest distance of the region from the fix, metres.
    """
    flat, x = problem.flat().with_rows(weight=fix.weights[None]), fix.x[None]
    face, d = exact(flat), problem.dimension
    slot, _ = problem.layout.find("position")
    own = slice(slot.start, slot.start + d)
    gradients = levels(flat, face, x)[1][0][:, own]
    left = np.linalg.svd(gradients)[2][len(gradients) :].T  # orthogonal to all gradients
    values, vectors = np.linalg.eigh(left.T @ fix.covariance() @ left)
    axes = left @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    q = quantile(level, axes.shape[1])
    least = float(profile(flat, x[None], x, passes(flat))[0][0, 0])
    others = fix.alternatives.x[:, own][fix.alternatives.gap <= q]
    starts = np.concatenate([np.zeros((1, axes.shape[1])), (others - x[0, own]) @ np.linalg.pinv(axes).T])
    return EqualityCost(flat, face, x, own, axes, least, q, reach, starts)


def _flooded(inside: Callable[[Array], Array], starts: Array, step: float) -> Array | None:
    """Return the nodes (n, k) of a grid, in steps, that are connected within a region; None if there are too many."""
    k = starts.shape[1]
    ways = np.array([way for way in product((-1, 0, 1), repeat=k) if any(way)])
    # neighbours of a start are included too: the region may be thinner than a step
    seen = {tuple(node) for node in np.round(starts / step).astype(int).tolist()}
    held, front = set(seen), seen
    while front:
        fresh = {tuple(node) for at in front for node in (np.array(at) + ways).tolist()} - seen
        seen |= fresh
        nodes = np.array(sorted(fresh)).reshape(-1, k)
        good = inside(nodes * step) if len(nodes) else np.zeros(0, dtype=bool)
        front = {tuple(node) for node in nodes[good].tolist()}
        held |= front
        if len(held) > _NODES:
            return None
    return np.array(sorted(held)).reshape(-1, k)
