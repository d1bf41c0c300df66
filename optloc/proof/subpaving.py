"""Subpavings: boxes that together contain every point whose cost is at most a level, for regions of any shape.

The regions may be curved and reach infinity. The bounds are the bounds of a proof, without its tests for minima: a box
is left out only if its least cost is above the level. All boxes of a generation are halved before the next generation,
so that their sizes are about equal everywhere. The boxes are in search coordinates around a fix, or on the pieces of an
atlas of all space (`optloc.proof.space`). A node is one scalar function of the position, such as a range; rows
(residuals) are sums of nodes, and a node over a box is linear plus a bounded remainder.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined, put, put_rows, zero
from optloc.proof.atlas import Atlas, atlas_of, is_near_minimum, with_room_for_minimum
from optloc.proof.box import (
    CENTRE,
    DEPTH,
    HALF,
    J0,
    J1,
    J2,
    MIDDLE,
    PIECE,
    bound_nodes,
    contract_coordinate,
    cost_at,
    cut_out,
    least_residual,
    linearise_rows,
    pop,
    push,
    push_halves,
    reaches_infinity,
    reset_cut,
    rounding_error,
    station_cube,
    steepest_side,
)
from optloc.proof.convex_boxes import set_minimum
from optloc.proof.enclosure import enclose
from optloc.proof.nodes.dispatch import bound_pieces
from optloc.proof.nodes.node import HIGH, LOW
from optloc.proof.pieces import SHRUNK, push_faces
from optloc.proof.search_space import Box, Cost, LocalAxes, chart_at, write_centre
from optloc.proof.space import Space, floor_of, set_box, set_place

# Halving a side must reduce the sum of remainders to this share to be preferred to the steepest side. Nodes that are
# only enclosed keep their remainders in half the box.
_STRAIGHTER = 0.8
# Greatest number of halvings: in three dimensions, a hull of a billion standard deviations is then a thousandth of one
# wide.
_GENERATIONS = 120
# Corners of the region to search are moved outwards by this share, for the rounding of the enclosure. A half-width
# above the second number does not count as an enclosure.
_OUTWARDS, _ENDLESS = 1e-9, 1e300
# Share by which the level is raised, for the rounding of two ways to compute the cost of a fix.
_EQUAL = 1e-9
# Squared slope of all rows along a side below which the slope counts as zero; far above underflow of doubles.
_FLAT = 1e-200
# Results of a test of a box: outside the region, inside, smaller after contraction, or across the edge.
_OUT, _IN, _SMALLER, _ACROSS = range(4)


@compiled
def cover_region(
    cost: Cost, box: Box, x: Array, above: float, most: int, bent: bool, base: Array, cells: Array, ends: Array
) -> tuple[int, int, float]:
    """Cover the region around a fix with boxes: inside an enclosure, or with pieces of an atlas of all space.

    The atlas needs a cost that stays finite at infinity (`optloc.proof.box.reaches_infinity`).

    Parameters
    ----------
    cost, box : Cost, Box
        The cost, and working memory.
    x : array (D,)
        The fix, metres.
    above : float
        Highest cost of the region minus the cost of the fix.
    most : int
        Greatest number of boxes.
    bent : bool
        Whether to prefer the atlas if possible; otherwise the atlas is used only without an enclosure.
    base : array (3,)
        Written: a position m, metres.
    cells : array (2 * most, 1 + D, 1 + D)
        Written: the centre of each box, then half of each edge, in homogeneous coordinates (P, v): the position is
        ``m + P / v``.
    ends : array (2 * most,)
        Written: for each box that reaches infinity, the cost at infinity in the direction of its centre; else
        infinity.

    Returns
    -------
    count, inside : int
        Number of boxes that contain the region, -1 without boxes; the first `inside` of them are inside the region.
    level : float
        The highest cost of the region.
    """
    chart, good = chart_at(cost, x, box)
    level = cost_at(cost.K, cost.w, box.nodes) + above
    level += _EQUAL * (1.0 + level)
    lists, endless, size = np.zeros((3, 2 * most, DEPTH)), reaches_infinity(cost.kinds, cost.K), zero()
    middle, radius = station_cube(cost.kinds, cost.data, x)
    atlas, none = atlas_of(middle, radius, x.shape[0], 0), np.empty((0, 3))
    space = Space(False, atlas, chart, none, none)
    if good and not (bent and endless):
        size = _push_enclosure(cost, chart, box, sqrt(level), lists[0])
    if size == 0:
        if not endless:
            return -1, 0, level
        size, atlas = _push_atlas(cost, atlas, box, x, level, lists[0])
        space = Space(True, atlas, chart, none, none)
    put(middle if space.far else chart.origin, base)
    count, inside = _halve(cost, space, box, level, most, lists, size)
    for i in range(count):
        _write_cell(cost, space, box, lists[2], i, cells, ends)
    return count, inside, level


@compiled
def _push_enclosure(cost: Cost, chart: LocalAxes, box: Box, longest: float, boxes: Array) -> int:
    """Write a box around all points with residuals shorter than `longest` into `boxes`; return the number, 0 or 1.

    The residual is the whitened vector K phi - w. The result is 0 if the measurements do not enclose these points.
    """
    corners = np.empty((2, 3))
    low, high = corners[0], corners[1]
    if not enclose(cost, chart, box, longest, low, high):
        return 0
    widest, boxes[0] = 0.0, 0.0
    for k in range(3):
        slack = _OUTWARDS * (1.0 + abs(low[k]) + abs(high[k])) if high[k] > low[k] else 0.0
        boxes[0, CENTRE + k] = 0.5 * (low[k] + high[k])
        boxes[0, HALF + k] = 0.5 * (high[k] - low[k]) + slack
        widest = max(widest, abs(low[k]) + slack, abs(high[k]) + slack)
    return 1 if widest < _ENDLESS else 0


@compiled
def _push_atlas(cost: Cost, atlas: Atlas, box: Box, x: Array, level: float, boxes: Array) -> tuple[int, Atlas]:
    """Write all pieces of an atlas, and a box around the fix x, into `boxes`; return their number, and the atlas.

    The box around the fix exists only if the fix has axes (is a minimum); with them, a long thin region is cut along
    them.
    """
    size, wider = push_faces(boxes, atlas.dimension), with_room_for_minimum(atlas)
    if not set_minimum(cost, box, wider, 0, x, 0.0, 1e-6 * (1.0 + level), inf):
        return size, atlas
    boxes[size] = 0.0
    for k in range(x.shape[0]):
        boxes[size, HALF + k] = wider.minima.core[0, 1, k]
    boxes[size, PIECE] = size
    return size + 1, wider


@compiled
def _halve(cost: Cost, space: Space, box: Box, level: float, most: int, lists: Array, size: int) -> tuple[int, int]:
    """Halve the boxes of the first list by generations; return the number of final boxes, and how many are inside.

    `lists` (3, capacity, DEPTH) contains the present generation (`size` boxes), the next generation, and the final
    boxes. The final boxes inside the region come first. `level` is the highest cost of the region. `most` is the
    greatest number of boxes in all.
    """
    floor, count, inside = floor_of(space, cost), zero(), zero()
    for generation in range(_GENERATIONS + 1):
        # The next generation may be twice as large, and needs space: a box leaves one box inside, or two to test.
        last = generation > 0 and (generation == _GENERATIONS or size + count > most)
        inside, following = count, zero()
        for i in range(size):
            fate, piece = _look(cost, space, box, lists[0], i, level, floor), int(lists[0, i, PIECE])
            if fate == _IN or (last and fate != _OUT):
                count = push(lists[2], count, box.at, box.half, 0.0, piece)  # subpavings use no bound of a parent
            elif fate == _SMALLER:
                following = push(lists[1], following, box.at, box.half, 0.0, piece)
            elif fate == _ACROSS:
                side = _side(cost, space, box, piece)
                following = push_halves(lists[1], following, side, box.at, box.half, 0.0, piece, False)
        size = following
        put_rows(lists[1, :size], lists[0, :size])
        if last:
            return count, inside
        if size == 0:
            break
    return count, count


@inlined
def _look(cost: Cost, space: Space, box: Box, front: Array, i: int, level: float, floor: float) -> int:
    """Return the result of the test of box i of the list `front`; a box across the edge of the region is contracted.

    Inside means that the greatest residual is below the root of `level`, outside that the least residual is above it.
    `floor` is the result of `optloc.proof.space.floor_of`.
    """
    piece, faces = int(front[i, PIECE]), 2 * space.atlas.dimension
    pop(front, i, box.at, box.half)
    set_box(space, box, piece)
    # The boxes around the fix cover this part of a face or of the inside.
    if (
        space.far
        and piece <= faces
        and space.atlas.minima.home.shape[0] > 0
        and is_near_minimum(space.atlas, box.half, 0)[1]
    ):
        return _OUT
    _bound(cost, space, box)
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    low = least_residual(cost.K, cost.weight, floor, box.half, box.nodes, box.rows)
    if low > 0.0 and low * low > level:
        return _OUT
    noise = rounding_error(cost.K, cost.weight, floor, box.nodes)
    return _IN if _most_residual(cost, box) + noise <= sqrt(level) else _clip(cost, box, sqrt(level) + noise)


@compiled
def _clip(cost: Cost, box: Box, longest: float) -> int:
    """Contract a box, side by side, to where the residual may be shorter than `longest`; return the result of the test.

    Let J_k be the derivative of the residual along side k, and dq the remainders minus the middles of their intervals.
    Each point of the box obeys ``J_k.residual = J_k.middle + |J_k|^2 s_k + sum_m J_k.J_m s_m + J_k.K dq``. Unlike
    `optloc.proof.box.contract_box`, this needs no inverse. So it works with any rounding, even if the rows do not
    determine a position. Over 18 fixes of all shapes, both contractors together left no fewer cells.
    """
    rows, nodes, half = box.rows, box.nodes, box.half
    reset_cut(half, box.cut)
    for k in range(3):
        own, middle, reach = 0.0, 0.0, 0.0
        for i in range(rows.shape[0]):
            own += rows[i, J0 + k] * rows[i, J0 + k]
            middle += rows[i, J0 + k] * rows[i, MIDDLE]
        if not own > _FLAT or half[k] == 0.0:
            continue
        for m in range(3):
            if m != k:
                total = 0.0
                for i in range(rows.shape[0]):
                    total += rows[i, J0 + k] * rows[i, J0 + m]
                reach += abs(total) * half[m]
        for j in range(nodes.shape[0]):
            radius = 0.5 * (nodes[j, HIGH] - nodes[j, LOW])
            if radius > 0.0:
                total = 0.0
                for i in range(rows.shape[0]):
                    total += rows[i, J0 + k] * cost.K[i, j]
                reach += abs(total) * radius
        if reach < inf:  # not if a node has no bound, which may give NaN
            contract_coordinate(box.cut, k, -middle / own, (longest * sqrt(own) + reach) / own)
    share = cut_out(box.cut, box.at, half)
    return _OUT if not share > 0.0 else _SMALLER if share < SHRUNK else _ACROSS


@inlined
def _bound(cost: Cost, space: Space, box: Box) -> None:
    """Bound the nodes over a box whose centre is set; subpavings are not made along surfaces."""
    if space.far:
        bound_pieces(space.atlas, cost.kinds, cost.data, box.half, box.nodes)
    else:
        _bound_near(cost, space.chart, box)


# The inlined code is called inside a separate function, which reduces the time to compile to a third.


@compiled
def _bound_near(cost: Cost, chart: LocalAxes, box: Box) -> None:
    # Bounds the nodes over a box in search coordinates around a fix.
    write_centre(chart.origin, chart.sense, box.at, box.centre)
    bound_nodes(cost.kinds, cost.data, box.centre, chart.sense, chart.gram, box.half, box.line, box.nodes)


@compiled
def _most_residual(cost: Cost, box: Box) -> float:
    """Return an upper bound of the residual's length ``|K phi - w|`` over a box; rounding is not included.

    The rows of the box must be linearised: column MIDDLE is the residual at the centre.
    """
    middle, j0, j1, j2 = 0.0, 0.0, 0.0, 0.0
    for i in range(box.rows.shape[0]):
        middle += box.rows[i, MIDDLE] ** 2
        j0 += box.rows[i, J0] ** 2
        j1 += box.rows[i, J1] ** 2
        j2 += box.rows[i, J2] ** 2
    reach = sqrt(middle) + sqrt(j0) * box.half[0] + sqrt(j1) * box.half[1] + sqrt(j2) * box.half[2]
    return float(reach + _bends(cost, box))


@compiled
def _bends(cost: Cost, box: Box) -> float:
    """Return a bound of the nonlinear part of the residual over a box: half the widths of the remainders, weighted.

    The result is infinite if a remainder has no bound.
    """
    total = 0.0
    for j in range(cost.weight.shape[0]):
        total += 0.5 * cost.weight[j] * (box.nodes[j, HIGH] - box.nodes[j, LOW])
    return float(total)


@compiled
def _is_bent(cost: Cost, box: Box, dimension: int) -> bool:
    """Return whether curvature changes the residual over a box more than the steepest side does.

    If a remainder has no bound, the result is False.
    """
    most = 0.0
    for m in range(dimension):
        steep = 0.0
        for i in range(box.rows.shape[0]):
            steep += box.rows[i, J0 + m] ** 2
        most = max(most, sqrt(steep) * box.half[m])
    total = _bends(cost, box)
    return bool(most < total < inf)


@compiled
def _side(cost: Cost, space: Space, box: Box, piece: int) -> int:
    """Return the side to halve: the steepest side, or if curvature dominates, the side that reduces it most.

    `piece` is the number of the box's piece of the atlas. The second choice needs the sum of remainders to fall to a
    share of `_STRAIGHTER`; the nodes are bounded for each side.
    """
    dimension = space.atlas.dimension
    side = steepest_side(box.half, box.rows, dimension)
    if _is_bent(cost, box, dimension):
        least = _STRAIGHTER * _bends(cost, box)
        set_place(space, box, piece)
        for k in range(dimension):
            box.half[k] *= 0.5
            _bound(cost, space, box)
            box.half[k] *= 2.0
            if _bends(cost, box) < least:
                least, side = _bends(cost, box), k
    return side


@compiled
def _write_cell(cost: Cost, space: Space, box: Box, boxes: Array, i: int, cells: Array, ends: Array) -> None:
    """Write box i in homogeneous coordinates, as `cover_region` returns it, and the cost at infinity in its direction.

    `ends[i]` is infinite for a box that does not reach infinity.
    """
    atlas, sense, d, piece = space.atlas, space.chart.sense, space.atlas.dimension, int(boxes[i, PIECE])
    pop(boxes, i, box.at, box.half)
    set_place(space, box, piece)
    cells[i, 0, d], ends[i] = atlas.scale[0] if space.far else 1.0, inf
    for k in range(d):
        cells[i, 0, k] = atlas.radius * atlas.point[k] if space.far else 0.0
    for m in range(d):
        cells[i, 1 + m, d] = atlas.scale[1 + m] * box.half[m] if space.far else 0.0
        for k in range(d):
            edge = atlas.radius * atlas.slant[k, m] if space.far else sense[k, m]
            cells[i, 1 + m, k] = edge * box.half[m]
            cells[i, 0, k] += 0.0 if space.far else edge * box.at[m]
    if space.far and piece < 2 * d and box.at[d - 1] <= box.half[d - 1]:
        atlas.scale[0] = 0.0
        bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
        ends[i] = cost_at(cost.K, cost.w, box.nodes)
