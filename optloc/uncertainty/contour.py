"""Contours of a function of two coordinates: the set where it is negative, as closed lines.

The grid is inside cells that contain the set, and it is refined until enough of its nodes are in the set. Each point of
a line is then moved along its edge of the grid to the zero of the function. So the grid decides the number of parts and
corners, but not the course of a line.

A *node* is a point of the grid, given by two indices. An *edge* joins two neighbouring nodes. A *polygon* is a closed
line and the lines around its holes. Letters: m cells of v corners, a grid of (nx, ny) nodes, r points of a line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optloc.base.types import Array

Value = Callable[[Array], Array]
"""Maps points (n, 2) to values (n,): negative inside, zero on the contour, perhaps infinite."""

Polygon = list[Array]
"""Closed lines (r, 2): the outer one counter-clockwise, then those around holes, clockwise."""

# Nodes across the longer side of the grid that separates cells which touch from cells which do not.
_COARSE = 200
# Nodes of the first grid. Nodes inside a part before it is traced: a disc of 600 nodes has an outline of 90 corners,
# which loses 0.1 % of its area. Most nodes that are evaluated together: 0.2 s in the plane.
_FIRST, _INSIDE, _MOST = 4000, 600, 40_000
# Factor of the nodes inside at which several parts are accepted: fewer may be one ridge that is thinner than a step.
_APART_AT = 10
# Most grids: each has half the step of the grid before.
_PASSES = 8
# Values below which a node is near the set, the widest first: at a ridge of half width w the value is 3 at distance 2
# w.
_LIMITS = (3.0, 1.0, 0.2)
# Least width of a grid as a share of its length: a row of cells may have no width.
_THIN = 1e-9
# Steps of the search for the zero along an edge: it begins with an interpolation, and the function is smooth.
_STEPS = 7
# Larger values are cut to this value for interpolation, in units of the value at the end of the set.
_CUT = 4.0


@dataclass(frozen=True, slots=True)
class _Grid:
    """Nodes ``origin + (step * (i, j)) @ axes`` of a rotated grid (nx, ny), with a step (2,) along each of its axes."""

    origin: Array
    axes: Array
    step: Array

    def points(self, nodes: Array) -> Array:
        """Return the points (n, 2) of nodes (n, 2), which need not be whole numbers."""
        return np.asarray(self.origin + (self.step * nodes) @ self.axes)


def trace(value: Value, cells: Array) -> list[Polygon]:
    """Return the polygons in which a function is negative, inside cells that contain all of them.

    Parameters
    ----------
    value : callable
        Maps points (n, 2) to values (n,).
    cells : array (m, v, 2)
        Corners of convex cells.

    Returns
    -------
    list of list of array (r, 2)
        Each a closed line, then its holes; larger parts come first.
    """
    found = [polygon for part in _parts(cells) for polygon in _trace_part(value, part)]
    return sorted(found, key=lambda polygon: -area(polygon[0]))


def area(line: Array) -> float:
    """Return the area inside a closed line (r, 2); negative for a clockwise line."""
    (x, y) = (line - line[0]).T
    return 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())


def holds(line: Array, point: Array) -> bool:
    """Return whether a closed line (r, 2) surrounds a point (2,), from the crossings of a ray."""
    (x0, y0), (x1, y1) = line[:-1, :2].T, line[1:, :2].T
    crosses = (y0 > point[1]) != (y1 > point[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = x0 + (point[1] - y0) / (y1 - y0) * (x1 - x0)
    return bool((crosses & (x > point[0])).sum() % 2)


def trace_nodes(value: Value, nodes: Array, step: float) -> list[Polygon]:
    """Return the polygons in which a function is negative around nodes (n, 2) of a grid through the origin.

    `step` is the distance between neighbouring nodes.
    """
    low = nodes.min(0) - 2  # two nodes of margin on each side, so that every line closes
    mask = np.zeros(np.ptp(nodes, axis=0) + 5, dtype=bool)
    mask[tuple((nodes - low).T)] = True
    grid = _Grid(low * step, np.eye(2), np.full(2, step))
    values = _evaluate(value, grid, mask)
    return _polygons(value, grid, values)


# Parts of the cells that do not touch; each part has a grid.


def _parts(cells: Array) -> list[Array]:
    """Return the cells (m, v, 2) in groups that do not touch each other; each group gets a separate grid."""
    from scipy.ndimage import label

    low, high = cells.min((0, 1)), cells.max((0, 1))
    step = float((high - low).max()) / (_COARSE - 1)
    if len(cells) == 1 or step <= 0.0:
        return [cells]
    first, last = np.floor((cells.min(1) - low) / step).astype(int), np.ceil((cells.max(1) - low) / step).astype(int)
    groups, count = label(_nodes_in_rectangles(first, last, (_COARSE + 1, _COARSE + 1)), np.ones((3, 3)))
    if count <= 1:
        return [cells]
    group_of_cell = groups[tuple(first.T)]
    # a group may separate further on its finer grid
    return [part for i in range(1, count + 1) for part in _parts(cells[group_of_cell == i])]


def _nodes_in_rectangles(first: Array, last: Array, shape: tuple[int, int]) -> Array:
    """Return flags of the nodes of a grid that are in one of m rectangles, from first to last nodes, both (m, 2).

    `shape` is the shape of the grid.
    """
    # signs at the corners of rectangles: their cumulative sums along both axes count the rectangles at each node
    count = np.zeros((shape[0] + 1, shape[1] + 1), dtype=int)
    (west, south), (east, north) = first.T, last.T + 1
    for x, y, sign in ((west, south, 1), (east, south, -1), (west, north, -1), (east, north, 1)):
        np.add.at(count, (x, y), sign)
    return np.asarray(count.cumsum(0).cumsum(1)[:-1, :-1] > 0)


def _trace_part(value: Value, cells: Array) -> list[Polygon]:
    """Return the polygons of one group of cells (m, v, 2), on a grid along the principal axes of the cells."""
    flat = cells.reshape(-1, 2)
    middle = flat.mean(0)
    axes = np.linalg.eigh(np.cov((flat - middle).T))[1].T[::-1].copy()
    axes[1] *= np.sign(np.linalg.det(axes))  # a rotation without reflection: lines keep their sense
    grid, mask = _first_grid((cells - middle) @ axes.T, axes, middle)
    found: list[Polygon] = []
    for _ in range(_PASSES):
        values = _evaluate(value, grid, mask)
        found, inside = _polygons(value, grid, values), int((values < 0.0).sum())
        # a part that is thinner than a step falls apart on the grid
        if inside >= _INSIDE and (len(found) <= 1 or inside >= _APART_AT * _INSIDE):
            break
        finer = _promising(values, mask)
        if finer is None:
            break
        grid, mask = _Grid(grid.origin, axes, 0.5 * grid.step), finer
    return found


def _first_grid(cells: Array, axes: Array, middle: Array) -> tuple[_Grid, Array]:
    """Return a grid over cells (m, v, 2), and flags (nx, ny) of its nodes in or next to cells.

    The cells are relative to `middle` (2,) and in rotated axes, the rows of `axes` (2, 2).
    """
    low, high = cells.min((0, 1)), cells.max((0, 1))
    size = np.maximum(high - low, _THIN * float((high - low).max()))
    step = size / np.sqrt(_FIRST)  # separate steps: a long thin set takes as many nodes as a round one
    for _ in range(2):  # cells fill only a part of the rectangle, so the grid may be finer
        shape = np.ceil(size / step).astype(int) + 5
        first = np.floor((cells.min(1) - low) / step).astype(int) + 1
        last = np.ceil((cells.max(1) - low) / step).astype(int) + 3
        mask = _nodes_in_rectangles(first, last, (int(shape[0]), int(shape[1])))
        used_step, step = step, step * np.sqrt(mask.sum() / _FIRST)
    return _Grid(middle + (low - 2.0 * used_step) @ axes, axes, used_step), mask


def _promising(values: Array, mask: Array) -> Array | None:
    """Return flags of the nodes near the set on a grid of half the step; None if there are too many, or none.

    `values` (nx, ny) are the values on the present grid, and `mask` (nx, ny) flags its nodes in use.
    """
    from scipy.ndimage import binary_dilation

    around = np.ones((3, 3), dtype=bool)
    for limit in _LIMITS:
        near = values < limit
        if near.any():
            kept = binary_dilation(near, around) & mask
            finer = np.zeros((2 * mask.shape[0] - 1, 2 * mask.shape[1] - 1), dtype=bool)
            finer[::2, ::2] = kept
            finer = binary_dilation(finer, around)
            if finer.sum() <= _MOST:
                return np.asarray(finer)
    return None


def _evaluate(value: Value, grid: _Grid, mask: Array) -> Array:
    """Return the values (nx, ny) at the nodes flagged in `mask`, limited to plus and minus `_CUT`.

    Other nodes, and the border of the grid, get `_CUT`: far outside the set.
    """
    out = np.full(mask.shape, _CUT)
    nodes = np.argwhere(mask)
    if len(nodes):
        found = value(grid.points(nodes.astype(float)))
        out[tuple(nodes.T)] = np.where(np.isnan(found), _CUT, np.clip(found, -_CUT, _CUT))
    out[[0, -1]] = out[:, [0, -1]] = _CUT  # so that lines close
    return out


# Marching squares: the corners of a square that are inside decide which of its edges a line joins, with the inside on
# the left. Corners have the bits 1, 2, 4, 8 from the lower left one, counter-clockwise. Edges are below (B), right (R),
# above (T) and left (L). For squares with two opposite corners inside, the mean value decides.
_JOINS: dict[int, tuple[str, ...]] = {
    1: ("BL",),
    2: ("RB",),
    3: ("RL",),
    4: ("TR",),
    6: ("TB",),
    7: ("TL",),
    8: ("LT",),
    9: ("BT",),
    11: ("RT",),
    12: ("LR",),
    13: ("BR",),
    14: ("LB",),
}
_APART: dict[int, tuple[str, ...]] = {5: ("BL", "TR"), 10: ("RB", "LT")}
_TOGETHER: dict[int, tuple[str, ...]] = {5: ("BR", "TL"), 10: ("LB", "RT")}
# An edge is its lower or left node, and a flag for the second axis.
_EDGES = {"B": (0, 0, 0), "T": (0, 1, 0), "L": (0, 0, 1), "R": (1, 0, 1)}

Edge = tuple[int, int, int]


def _polygons(value: Value, grid: _Grid, values: Array) -> list[Polygon]:
    """Return the polygons of values (nx, ny) on a grid, with corners at the zeros of the function `value`."""
    loops = _loops(values)
    if not loops:
        return []
    ends = np.cumsum([len(loop) for loop in loops])[:-1]
    points = np.split(_crossings(value, grid, values, np.array([edge for loop in loops for edge in loop])), ends)
    lines = [np.concatenate([line, line[:1]]) for line in points]
    sizes = [area(line) for line in lines]
    outer = [[line] for line, size in zip(lines, sizes, strict=True) if size > 0.0]
    for line, size in zip(lines, sizes, strict=True):
        if size < 0.0:
            around = [polygon for polygon in outer if holds(polygon[0], line[0])]
            if around:
                min(around, key=lambda polygon: area(polygon[0])).append(line)
    return outer


def _loops(values: Array) -> list[list[Edge]]:
    """Return the closed sequences of edges that the contour of zero crosses, from values (nx, ny).

    An edge is the indices of its lower or left node, and 1 if it is along the second axis, else 0.
    """
    inside = values < 0.0
    code = inside[:-1, :-1] + 2 * inside[1:, :-1] + 4 * inside[1:, 1:] + 8 * inside[:-1, 1:]
    following: dict[Edge, Edge] = {}
    for i, j in np.argwhere((code > 0) & (code < 15)).tolist():
        square = int(code[i, j])
        joins = _JOINS.get(square)
        if joins is None:
            joins = (_TOGETHER if values[i : i + 2, j : j + 2].mean() < 0.0 else _APART)[square]
        for join in joins:
            (a, b, c), (d, e, f) = _EDGES[join[0]], _EDGES[join[1]]
            following[i + a, j + b, c] = (i + d, j + e, f)
    loops = []
    while following:
        first, here = following.popitem()
        loop = [first]
        while here != first:
            loop.append(here)
            here = following.pop(here)
        loops.append(loop)
    return loops


def _crossings(value: Value, grid: _Grid, values: Array, edges: Array) -> Array:
    """Return the zeros (n, 2) of the function `value` along edges (n, 3) of a grid.

    `values` (nx, ny) are the values at the nodes; an edge is as in `_loops`.
    """
    begin, along = edges[:, :2].astype(float), np.eye(2)[edges[:, 2]]
    one, two = values[tuple(edges[:, :2].T)], values[tuple((edges[:, :2] + np.eye(2, dtype=int)[edges[:, 2]]).T)]
    # from the end inside to the end outside
    start = np.where((one < 0.0)[:, None], begin, begin + along)
    direction = np.where((one < 0.0)[:, None], along, -along)
    low, high = np.zeros(len(edges)), np.ones(len(edges))
    at_low, at_high = np.minimum(one, two), np.maximum(one, two)
    last_side = np.zeros(len(edges))  # 1 if the last point was inside, -1 if it was outside
    for _ in range(_STEPS):
        share = at_low / (at_low - at_high)
        # not at an end of the interval, so that the interval always becomes shorter
        middle = low + np.clip(share, 0.02, 0.98) * (high - low)
        found = value(grid.points(start + middle[:, None] * direction))
        found = np.where(np.isnan(found), _CUT, np.clip(found, -_CUT, _CUT))
        within = found < 0.0
        low, high = np.where(within, middle, low), np.where(within, high, middle)
        # if one end is used twice, half of its value is taken (Illinois rule), so that both ends approach the zero
        at_high = np.where(within, np.where(last_side > 0.0, 0.5 * at_high, at_high), found)
        at_low = np.where(within, found, np.where(last_side < 0.0, 0.5 * at_low, at_low))
        last_side = np.where(within, 1.0, -1.0)
    share = np.clip(at_low / (at_low - at_high), 0.0, 1.0)
    return grid.points(start + (low + share * (high - low))[:, None] * direction)
