"""The likelihood region of a fix in the plane of a picture: a contour of the cost, of any shape.

In the plane the region is ``f <= f(fix) + q``. In space a picture shows two coordinates. The third coordinate then
takes its best value, and q is the quantile of chi-square with two degrees of freedom, as for an ellipse from a
covariance. So the outline contains the two visible coordinates with the stated probability.

Here f is the cost over the position, and `surface` holds this cost and the fix. Points of the plane are metres from the
fix along its two axes.
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

# Most cells that contain a region, by dimension; the contour is searched in them.
_CELLS = {2: 400, 3: 3000}
# Distance, in distances of the fix, at which a picture cuts off a region that reaches to infinity.
FAR = 3.0
# Share of that distance from which a line counts as cut off.
_AT_EDGE = 0.995
# Steps across the ellipsoid of a far fix, by dimension. The search extends beyond the ellipsoid by a factor, since the
# fix is not exactly Gaussian there.
_STEPS, _BEYOND = {2: 24, 3: 14}, 1.4
# Positions along the hidden coordinate, and steps from the best two of them: a cost with two minima there has both.
_ALONG, _NEWTON = 9, 4
# Nodes across the plane of the table that contains the reach of cells along the third coordinate.
_ACROSS = 160
# Half the drawn width of a region that is a line, as a share of its length: visible, but not mistaken for an area.
_WIDTH = 2e-3
# Halvings that find the ends of a line within a step.
_HALVINGS = 20
# Steps of the grid from the fix to the level of a Gaussian, most nodes (more than a picture shows), and most doublings
# of the step. With the doublings the grid covers a region of a million standard deviations.
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
    """Return the outline of the region of a fix, in a plane through it, if no ellipse covers the region.

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
        # a law that bounds cut off has a single closed outline, which must run counter-clockwise
        line = fix.chart.truncated.outline(plane, level)
        return Outline(([line if area(line) > 0.0 else line[::-1]],))
    if fix.chart is None or int(fix.chart.kind) not in (CURVED, INVERSE_RANGE) or not np.isfinite(fix.cov).all():
        return None
    if exact(problem):
        return _outline_on_equalities(problem, fix, plane, level)
    try:
        if int(fix.chart.kind) == INVERSE_RANGE:
            surface, cells = RegionSurface.of(problem, fix), _far_cells(fix.chart, level)
        else:
            region = likelihood_region(problem, fix, level, boxes=_CELLS[problem.dimension])
            if region.cells is None:
                return None
            surface, cells = region.surface, region.cells.corners
            # a corner at infinity is replaced by a point at the distance where the picture ends
            away = fix.chart.centre + FAR * float(fix.chart.distance) * region.cells.directions
            cells = np.where(np.isfinite(cells).all(-1, keepdims=True), cells, away)
    except InvalidProblem:
        return None
    return _outline_in_cells(surface, cells, plane, level)


def _outline_in_cells(surface: RegionSurface, cells: Array, plane: Array, level: float) -> Outline | None:
    """Return the outline, in a plane, of a region without equalities; None if it has no part in the plane.

    `surface` is the cost around the fix. `cells` (m, v, d) are the corners of convex cells that contain the region,
    metres. `plane` (2, d) has the axes of the plane, and `level` is the probability. The outline ends at `FAR`
    distances of the fix from the stations.
    """
    q, centre = quantile(level, 2), (surface.chart.centre - surface.position) @ plane.T
    reach = FAR * float(surface.chart.distance)
    cost = _profile(surface, cells, plane)

    # negative inside the region, zero on its outline
    def value(points: Array) -> Array:
        beyond = np.sqrt(((points - centre) ** 2).sum(-1)) / reach - 1.0
        return np.asarray(np.maximum((cost(points) - surface.least) / q - 1.0, beyond))

    polygons = trace(value, (cells - surface.position) @ plane.T)
    far = max((np.sqrt(((line - centre) ** 2).sum(-1)).max() for each in polygons for line in each), default=0.0)
    return Outline(tuple(polygons), bool(far > _AT_EDGE * reach)) if polygons else None


def _profile(surface: RegionSurface, cells: Array, plane: Array) -> Callable[[Array], Array]:
    """Return a function from points (n, 2) of a plane to the least cost (n,) over the hidden coordinate.

    The hidden coordinate is searched within the cells (m, v, d) only; outside them the cost is infinite.
    """
    if plane.shape[1] == 2:
        return lambda points: surface.cost(surface.position + points @ plane)
    normal = np.cross(plane[0], plane[1])
    in_plane, depth = (cells - surface.position) @ plane.T, (cells - surface.position) @ normal
    origin = in_plane.min((0, 1))
    step = max(float((in_plane.max((0, 1)) - origin).max()), np.finfo(float).tiny) / (_ACROSS - 3)
    # table over nodes of a grid in the plane: least and greatest hidden coordinate of the cells there
    low, high = np.full((_ACROSS + 1, _ACROSS + 1), np.inf), np.full((_ACROSS + 1, _ACROSS + 1), -np.inf)
    first = np.floor((in_plane.min(1) - origin) / step).astype(int)
    last = np.ceil((in_plane.max(1) - origin) / step).astype(int) + 2
    for (i, j), (m, n), least, most in zip(first, last, depth.min(1), depth.max(1), strict=True):
        np.minimum(low[i:m, j:n], least, out=low[i:m, j:n])
        np.maximum(high[i:m, j:n], most, out=high[i:m, j:n])

    def least_cost(points: Array) -> Array:
        out = np.full(len(points), np.inf)
        node = np.round((points - origin) / step).astype(int)
        inside = ((node >= 0) & (node <= _ACROSS)).all(1)
        inside[inside] = low[tuple(node[inside].T)] <= high[tuple(node[inside].T)]
        if inside.any():
            nodes_inside = tuple(node[inside].T)
            out[inside] = _least_along(surface, points[inside] @ plane, normal, low[nodes_inside], high[nodes_inside])
        return out

    return least_cost


def _least_along(surface: RegionSurface, base: Array, normal: Array, low: Array, high: Array) -> Array:
    """Return the least costs (n,) along lines in the direction of `normal` (d,), between two ends of each line.

    `base` (n, d) are points of the lines relative to the fix. `low` and `high` (n,) are the ends along the normal,
    metres.
    """

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
        # a Newton step that does not lower the cost is tried again at a quarter of its length
        step = np.where(better, new[2], 0.25 * step)
    return np.asarray(cost.min(1))


def _far_cells(chart: Chart, level: float) -> Array:
    """Return cells (m, 2^d, d), metres, that contain the region of a fix that is Gaussian in its inverse range.

    `chart` has the coordinates in which the fix is Gaussian, and `level` is the probability.
    """
    d = len(chart.position)
    values, vectors = np.linalg.eigh(chart.spread)
    axes = np.sqrt(np.maximum(values, 0.0) * quantile(level, 2)) * vectors
    edges = np.linspace(-_BEYOND, _BEYOND, _STEPS[d] + 1)
    corner = np.array(list(product((0, 1), repeat=d)))
    first = np.array(list(product(range(_STEPS[d]), repeat=d)))
    cells = edges[first[:, None] + corner]
    cells = cells[np.sqrt((cells**2).sum(-1)).min(1) <= _BEYOND]
    in_chart = chart.mean + cells @ axes.T
    in_chart[..., -1] = np.maximum(in_chart[..., -1], 0.9 / FAR)  # farther points are cut off
    return chart.to_position(in_chart)


# A region on equalities: part of a surface, or of a line.


def _outline_on_equalities(problem: Problem, fix: Fix, plane: Array, level: float) -> Outline | None:
    """Return the outline of a region on the surface of equalities, or a strip around a region on a line.

    None if no node of the grid is in the region. The arguments are as in `outline_of`.
    """
    assert fix.chart is not None
    on_equalities = cost_along(problem, fix, level, FAR * float(fix.chart.distance))
    nodes, step = on_equalities.flooded()
    if not len(nodes):
        return None
    if on_equalities.axes.shape[1] == 1:
        ends = on_equalities.away(nodes * step)
        return Outline(_strips(on_equalities, plane, fix.position), bool(ends.max() > _AT_EDGE))
    around = trace_nodes(on_equalities.value, nodes, step)
    far = max((on_equalities.away(line).max() for polygon in around for line in polygon), default=0.0)
    in_plane = [[(on_equalities.place(line) - fix.position) @ plane.T for line in polygon] for polygon in around]
    return Outline(tuple(map(_counter_clockwise, in_plane)), bool(far > _AT_EDGE)) if in_plane else None


def _counter_clockwise(polygon: Polygon) -> Polygon:
    """Return a polygon whose outer line runs counter-clockwise.

    The axes of a surface may be seen from below, which reverses the sense of lines.
    """
    return polygon if area(polygon[0]) >= 0.0 else [line[::-1] for line in polygon]


def _strips(along_line: EqualityCost, plane: Array, position: Array) -> tuple[Polygon, ...]:
    """Return thin strips around a region along a line, in the plane: without a width it would be invisible.

    `along_line` is the cost along the line, `plane` (2, d) has the axes of the picture, and `position` (d,) is the fix.
    """
    nodes, step = along_line.flooded()
    order = np.sort(nodes[:, 0])
    parts = np.split(order, np.flatnonzero(np.diff(order) > 1) + 1)
    found = []
    for part in parts:
        ends = _ends(along_line, part, step)
        along = np.concatenate([ends[:1], part[1:-1] * step, ends[1:]])
        line = (along_line.place(along[:, None]) - position) @ plane.T
        tangent = np.gradient(line, axis=0)
        length = np.maximum(np.sqrt((tangent**2).sum(-1, keepdims=True)), np.finfo(float).tiny)
        half_width = _WIDTH * np.ptp(line, axis=0).max() * tangent[:, ::-1] / length * [-1.0, 1.0]
        found.append([np.concatenate([line - half_width, (line + half_width)[::-1], (line - half_width)[:1]])])
    return tuple(map(_counter_clockwise, found))


def _ends(along_line: EqualityCost, part: Array, step: float) -> Array:
    """Return the ends (2,) of an interval of neighbouring nodes: the coordinates at which the cost meets the level.

    `part` are the indices of the nodes in ascending order, and `step` is their distance.
    """
    inside = np.array([part[0], part[-1]], dtype=float) * step
    outside = inside + np.array([-step, step])
    for _ in range(_HALVINGS):
        middle = 0.5 * (inside + outside)
        within = along_line.value(middle[:, None]) < 0.0
        inside, outside = np.where(within, middle, inside), np.where(within, outside, middle)
    return np.asarray(inside)


@dataclass(frozen=True, slots=True)
class EqualityCost:
    """The cost along the surface or line of equalities, in coordinates from the fix along its principal axes.

    Coordinates are numbers of standard deviations along the k principal axes; k is 1 for a line, 2 for a surface.

    Parameters
    ----------
    problem : Problem
        Flat batch of one, rows weighted as in the fix.
    face : Face
        The equalities.
    x : array (1, size)
        All unknowns of the fix.
    columns : slice
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
        Coordinates of the fix, and of alternatives within the region.
    """

    problem: Problem
    face: Face
    x: Array
    columns: slice
    axes: Array
    least: float
    quantile: float
    reach: float
    starts: Array

    def place(self, steps: Array) -> Array:
        """Return the positions (n, d), metres, of coordinates (n, k)."""
        return np.asarray(self._vectors(steps)[:, self.columns])

    def away(self, steps: Array) -> Array:
        """Return the distances (n,) of coordinates (n, k) from the fix, as shares of the reach."""
        return np.asarray(np.sqrt(((self.place(steps) - self.x[0, self.columns]) ** 2).sum(-1)) / self.reach)

    def value(self, steps: Array) -> Array:
        """Return numbers (n,) at coordinates (n, k) that are negative inside the region and zero on its edge."""
        points = self._vectors(steps)
        cost = profile(self.problem, points[:, None], self.x, passes(self.problem))[0][:, 0]
        beyond = np.sqrt(((points[:, self.columns] - self.x[0, self.columns]) ** 2).sum(-1)) / self.reach - 1.0
        return np.asarray(np.maximum((cost - self.least) / self.quantile - 1.0, beyond))

    def flooded(self) -> tuple[Array, float]:
        """Return the connected nodes (n, k) of a grid in the region, and the step of the grid in standard deviations.

        If a fine grid has too many nodes, the step is doubled. The array is empty if all grids have too many.
        """
        step = float(np.sqrt(self.quantile)) / _FINE
        for _ in range(_DOUBLINGS):
            found = _connected_nodes(lambda steps: self.value(steps) <= 0.0, self.starts, step)
            if found is not None:
                return found, step
            step *= 2.0
        return np.zeros((0, self.axes.shape[1]), dtype=int), step

    def _vectors(self, steps: Array) -> Array:
        """Return vectors (n, size) of coordinates (n, k), moved onto the equalities."""
        points = np.repeat(self.x, len(steps), axis=0)
        points[:, self.columns] += steps @ self.axes.T
        return restore(self.problem, self.face, points)


def cost_along(problem: Problem, fix: Fix, level: float, reach: float) -> EqualityCost:
    """Return the cost of a fix along the surface or line of its equalities.

    Parameters
    ----------
    problem : Problem
        The problem of the fix: one static position with equalities.
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
    columns = slice(slot.start, slot.start + d)
    gradients = levels(flat, face, x)[1][0][:, columns]
    tangent = np.linalg.svd(gradients)[2][len(gradients) :].T  # orthogonal to all gradients
    values, vectors = np.linalg.eigh(tangent.T @ fix.covariance() @ tangent)
    axes = tangent @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    q = quantile(level, axes.shape[1])
    least = float(profile(flat, x[None], x, passes(flat))[0][0, 0])
    others = fix.alternatives.x[:, columns][fix.alternatives.gap <= q]
    starts = np.concatenate([np.zeros((1, axes.shape[1])), (others - x[0, columns]) @ np.linalg.pinv(axes).T])
    return EqualityCost(flat, face, x, columns, axes, least, q, reach, starts)


def _connected_nodes(inside: Callable[[Array], Array], starts: Array, step: float) -> Array | None:
    """Return the nodes (n, k) of a grid, in steps, that are connected within a region; None if there are too many.

    `inside` maps coordinates (n, k) to flags of points in the region. `starts` (q, k) are coordinates in the region,
    and `step` is the distance of nodes. Neighbours of a start are always included.
    """
    k = starts.shape[1]
    neighbours = np.array([way for way in product((-1, 0, 1), repeat=k) if any(way)])
    # neighbours of a start are included too: the region may be thinner than a step
    seen = {tuple(node) for node in np.round(starts / step).astype(int).tolist()}
    kept, front = set(seen), seen
    while front:
        new = {tuple(node) for at in front for node in (np.array(at) + neighbours).tolist()} - seen
        seen |= new
        nodes = np.array(sorted(new)).reshape(-1, k)
        good = inside(nodes * step) if len(nodes) else np.zeros(0, dtype=bool)
        front = {tuple(node) for node in nodes[good].tolist()}
        kept |= front
        if len(kept) > _NODES:
            return None
    return np.array(sorted(kept)).reshape(-1, k)
