"""Boxes that hold every point whose cost is at most a level: a region as it is, however bent, and out to infinity.

The same bounds as those of a proof, without its tests for minima: a box is left out only where its least cost is above
the level. Boxes are halved generation by generation, so that what is left is cut about equally fine everywhere.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, put, put_rows, zero
from optloc.proof.atlas import Atlas, atlas_of, first_minima, set_centre, with_minima, within
from optloc.proof.box import (
    CENTRE,
    DEPTH,
    HALF,
    J0,
    J1,
    J2,
    LEAST,
    MIDDLE,
    PIECE,
    bound_nodes,
    clip,
    cost_at,
    cube,
    cut_out,
    least_residual,
    linearise_rows,
    pop,
    push_halves,
    rounding,
    steepest_side,
    uncut,
)
from optloc.proof.convex_boxes import accuracy_floor_far, set_minimum
from optloc.proof.enclosure import enclose
from optloc.proof.nodes.dispatch import bound_pieces
from optloc.proof.nodes.node import HIGH, LOW
from optloc.proof.search_space import Box, Chart, Cost, chart_at, place, widen

# Share of a box below which what is left of it is looked at again before it is cut, as in `optloc.proof.near`.
_SHRUNK = 0.5
# Share of its bend that halving a side must leave a box at most, to be preferred to what its slopes say: nodes that are
# only enclosed bend as much in half the box.
_STRAIGHTER = 0.8
# No box is halved more often: a hull of a billion standard deviations is then a thousandth of one wide, in three
# dimensions.
_GENERATIONS = 120
# Corners of what is searched are moved out by this share, for the rounding of the enclosure; from a half-width of the
# second on it is none.
_OUTWARDS, _ENDLESS = 1e-9, 1e300
# Squared slope of all rows along a side below which it is none: far above where products of doubles vanish.
_FLAT = 1e-200
# What becomes of a box.
_OUT, _IN, _SMALLER, _ACROSS = range(4)


@compiled
def room(most: int) -> Array:
    """Return room for the boxes of a cover: three lists of twice `most`, see `optloc.proof.box.DEPTH`."""
    return np.zeros((3, 2 * most, DEPTH))


@compiled
def cost_of_point(cost: Cost, box: Box, x: Array) -> float:
    """Return f at a position x (D,); the first table of the box is filled."""
    numbers, origin = np.zeros((3, 3, 3)), np.zeros(3)
    for k in range(x.shape[0]):
        origin[k] = x[k]
    box.half[:] = 0.0
    plain = Chart(origin, numbers[0], numbers[1], numbers[2], np.zeros(3), 0.0, np.zeros(0), False, origin)
    _bound_near(cost, plain, box)
    return cost_at(cost.K, cost.w, box.nodes)


# What is inlined elsewhere is called here: machine code of it once takes a third of the time to make.


@compiled
def _bound_near(cost: Cost, chart: Chart, box: Box) -> None:
    """Bound the nodes over a box of search coordinates."""
    place(chart.origin, chart.sense, box.at, box.centre)
    bound_nodes(cost.kinds, cost.data, box.centre, chart.sense, chart.gram, box.half, box.line, box.nodes)


@compiled
def _least(cost: Cost, box: Box, floor: float) -> float:
    """Linearise the rows over a box whose nodes are bounded; return a lower bound of ``|K phi - w|``."""
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    return least_residual(cost.K, cost.weight, floor, box.half, box.nodes, box.rows)


@compiled
def _rounding(cost: Cost, box: Box, floor: float) -> float:
    return rounding(cost.K, cost.weight, floor, box.nodes)


@compiled
def cover_near(
    cost: Cost, box: Box, x: Array, level: float, most: int, lists: Array, chart: Chart
) -> tuple[int, int, int]:
    """Cover the region inside an enclosure.

    Parameters
    ----------
    cost, box : Cost, Box
        The cost, and tables to work with.
    x : array (D,)
        The fix.
    level : float
        Highest cost of the region.
    most : int
        How many boxes there may be.
    lists : array (3, 2 * most, DEPTH)
        Room (`room`); the boxes are written into the last list, in search coordinates.
    chart : Chart
        Written: the search coordinates.

    Returns
    -------
    count, inside : int
        How many boxes hold the region, and how many of these, the first ones, lie inside it; -1 without an enclosure.
    boxes : int
        How many boxes were looked at.
    """
    own, good = chart_at(cost, x, box)
    put(own.origin, chart.origin)
    put_rows(own.sense, chart.sense)
    put_rows(own.back, chart.back)
    put_rows(own.gram, chart.gram)
    put(own.slip, chart.slip)
    corners = np.empty((2, 3))
    low, high = corners[0], corners[1]
    if not good or not enclose(cost, own, box, sqrt(level), low, high):
        return -1, 0, 0
    widest, front = 0.0, lists[0]
    for k in range(3):
        slack = _OUTWARDS * (1.0 + abs(low[k]) + abs(high[k])) if high[k] > low[k] else 0.0
        front[0, CENTRE + k] = 0.5 * (low[k] + high[k])
        front[0, HALF + k] = 0.5 * (high[k] - low[k]) + slack
        widest = max(widest, abs(low[k]) + slack, abs(high[k]) + slack)
    if not widest < _ENDLESS:
        return -1, 0, 0
    front[0, LEAST] = front[0, PIECE] = 0.0
    floor = own.floor
    size, done, boxes = zero() + 1, zero(), zero()
    for _ in range(_GENERATIONS):
        following = zero()
        for i in range(size):
            fate = _look_near(cost, chart, box, lists[0], i, level, floor)
            boxes += 1
            if fate == _IN:
                done = _keep(lists[2], done, box, 0)
            elif fate == _SMALLER:
                following = _keep(lists[1], following, box, 0)
            elif fate == _ACROSS:
                side = _side_near(cost, chart, box, x.shape[0])
                following = push_halves(lists[1], following, side, box.at, box.half, 0.0, 0, False)
        size = following
        put_rows(lists[1, :size], lists[0, :size])
        # The next generation may be twice as large, and must find room: a box leaves one inside or two to look at.
        if size == 0 or size + done > most:
            break
    count = done
    for i in range(size):
        boxes += 1
        if _look_near(cost, chart, box, lists[0], i, level, floor) != _OUT:
            count = _keep(lists[2], count, box, 0)
    return count, done, boxes


@compiled
def _look_near(cost: Cost, chart: Chart, box: Box, front: Array, i: int, level: float, floor: float) -> int:
    """Take a box of a list, clip it to what may lie in the region, and return what becomes of it."""
    pop(front, i, box.at, box.half)
    place(chart.origin, chart.sense, box.at, box.centre)
    widen(chart, box.centre, box.half)
    _bound_near(cost, chart, box)
    return _decide(cost, box, level, floor)


@compiled
def _decide(cost: Cost, box: Box, level: float, floor: float) -> int:
    """Return what becomes of a box whose nodes are bounded; one across the edge of the region is clipped to it."""
    low = _least(cost, box, floor)
    if low > 0.0 and low * low > level:
        return _OUT
    if _most_residual(cost, floor, box) <= sqrt(level):
        return _IN
    return _clip(cost, box, sqrt(level) + _rounding(cost, box, floor))


@compiled
def _clip(cost: Cost, box: Box, longest: float) -> int:
    """Clip a box side by side to where the residual may be shorter than `longest`; return what becomes of it.

    With J_k the derivative of the residual along side k every point of the box obeys ``J_k.residual = J_k.middle +
    |J_k|^2 s_k + sum_m J_k.J_m s_m + J_k.K dq``, dq the remainders from their middle. Unlike
    `optloc.proof.box.shrink` this needs no inverse: it works where the rows do not determine a position, whatever the
    rounding. Over 18 fixes of all shapes both together left no fewer cells.
    """
    rows, nodes, half = box.rows, box.nodes, box.half
    uncut(half, box.cut)
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
        if reach < inf:  # nor where a node is not bounded, which may leave no number at all
            clip(box.cut, k, -middle / own, (longest * sqrt(own) + reach) / own)
    share = cut_out(box.cut, box.at, half)
    return _OUT if not share > 0.0 else _SMALLER if share < _SHRUNK else _ACROSS


@compiled
def _most_residual(cost: Cost, floor: float, box: Box) -> float:
    """Return an upper bound of ``|K phi - w|`` over a box whose rows are linearised."""
    middle, j0, j1, j2 = 0.0, 0.0, 0.0, 0.0
    for i in range(box.rows.shape[0]):
        middle += box.rows[i, MIDDLE] ** 2
        j0 += box.rows[i, J0] ** 2
        j1 += box.rows[i, J1] ** 2
        j2 += box.rows[i, J2] ** 2
    reach = sqrt(middle) + sqrt(j0) * box.half[0] + sqrt(j1) * box.half[1] + sqrt(j2) * box.half[2]
    for j in range(cost.weight.shape[0]):
        reach += 0.5 * cost.weight[j] * (box.nodes[j, HIGH] - box.nodes[j, LOW])
    return float(reach + _rounding(cost, box, floor))


@compiled
def _keep(boxes: Array, count: int, box: Box, piece: int) -> int:
    """Write a box into a list; return how many it holds."""
    for k in range(3):
        boxes[count, CENTRE + k], boxes[count, HALF + k] = box.at[k], box.half[k]
    boxes[count, LEAST], boxes[count, PIECE] = 0.0, piece
    return count + 1


@compiled
def _bends(cost: Cost, box: Box) -> float:
    """Return how much of the residual over a box is not linear: half the widths of the remainders, weighted."""
    total = 0.0
    for j in range(cost.weight.shape[0]):
        total += 0.5 * cost.weight[j] * (box.nodes[j, HIGH] - box.nodes[j, LOW])
    return float(total)


@compiled
def _is_bent(cost: Cost, box: Box, dimension: int) -> bool:
    """Return whether over a box curvature changes the residual more than the steepest side does."""
    most = 0.0
    for m in range(dimension):
        steep = 0.0
        for i in range(box.rows.shape[0]):
            steep += box.rows[i, J0 + m] ** 2
        most = max(most, sqrt(steep) * box.half[m])
    total = _bends(cost, box)
    return bool(most < total < inf)


@compiled
def _side_near(cost: Cost, chart: Chart, box: Box, dimension: int) -> int:
    """Return the side to halve: where the rows bend most of all, the one whose halving straightens them most."""
    side = steepest_side(box.half, box.rows, dimension)
    if _is_bent(cost, box, dimension):
        least = _STRAIGHTER * _bends(cost, box)
        for k in range(dimension):
            box.half[k] *= 0.5
            _bound_near(cost, chart, box)
            box.half[k] *= 2.0
            if _bends(cost, box) < least:
                least, side = _bends(cost, box), k
    return side


@compiled
def _side_far(cost: Cost, atlas: Atlas, box: Box, piece: int) -> int:
    """Return the side to halve in a piece of an atlas, see `_side_near`."""
    side = steepest_side(box.half, box.rows, atlas.dimension)
    if _is_bent(cost, box, atlas.dimension):
        least = _STRAIGHTER * _bends(cost, box)
        set_centre(atlas, piece, box.at)
        for k in range(atlas.dimension):
            box.half[k] *= 0.5
            bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
            box.half[k] *= 2.0
            if _bends(cost, box) < least:
                least, side = _bends(cost, box), k
    return side


# All space to infinity, where the cost stays finite there (`optloc.proof.box.reaches_infinity`).


@compiled
def cover_everywhere(
    cost: Cost, box: Box, x: Array, level: float, most: int, lists: Array, cells: Array, far: Array, base: Array
) -> tuple[int, int, int]:
    """Cover the region with pieces of an atlas.

    Parameters
    ----------
    cost, box, x, level, most, lists
        As of `cover_near`.
    cells : array (2 * most, 1 + D, 1 + D)
        Written: of each box its centre, then half of each edge, in homogeneous coordinates ``(R p, v)``: the position
        is ``m + R p / v``.
    far : array (2 * most,)
        Written: the cost at infinity in the direction of the centre of a box that reaches there; infinite for others.
    base : array (3,)
        Written: m, metres.

    Returns
    -------
    count, inside, boxes : int
        As of `cover_near`.
    """
    middle, radius = cube(cost.kinds, cost.data, x)
    put(middle, base)
    d = x.shape[0]
    atlas = atlas_of(middle, radius, d, 1)
    # The surroundings of the fix along its own axes, where they can be found: a long thin region is cut along them.
    known = set_minimum(cost, box, atlas, 0, x, 0.0, 1e-6 * (1.0 + level), inf)
    atlas = with_minima(middle, radius, d, first_minima(atlas.minima, int(known)))
    floor, size = accuracy_floor_far(cost, atlas), _pieces(lists[0], atlas)
    done, boxes = zero(), zero()
    for _ in range(_GENERATIONS):
        following = zero()
        for i in range(size):
            fate = _look_far(cost, atlas, box, lists[0], i, level, floor)
            piece = int(lists[0, i, PIECE])
            boxes += 1
            if fate == _IN:
                done = _keep(lists[2], done, box, piece)
            elif fate == _SMALLER:
                following = _keep(lists[1], following, box, piece)
            elif fate == _ACROSS:
                side = _side_far(cost, atlas, box, piece)
                following = push_halves(lists[1], following, side, box.at, box.half, 0.0, piece, False)
        size = following
        put_rows(lists[1, :size], lists[0, :size])
        if size == 0 or size + done > most:
            break
    count = done
    for i in range(size):
        boxes += 1
        if _look_far(cost, atlas, box, lists[0], i, level, floor) != _OUT:
            count = _keep(lists[2], count, box, int(lists[0, i, PIECE]))
    for i in range(count):
        _write_cell(cost, atlas, box, lists[2], i, cells, far)
    return count, done, boxes


@compiled
def _pieces(boxes: Array, atlas: Atlas) -> int:
    """Write all faces of the cube, its inside, and the surroundings of the fix; return how many boxes these are."""
    d = atlas.dimension
    count = 2 * d + 1
    for piece in range(count):
        boxes[piece] = 0.0
        for k in range(d):
            boxes[piece, HALF + k] = 1.0
        if piece < 2 * d:
            boxes[piece, CENTRE + d - 1] = boxes[piece, HALF + d - 1] = 0.5
        boxes[piece, PIECE] = piece
    if atlas.minima.home.shape[0]:
        boxes[count] = 0.0
        for k in range(d):
            boxes[count, HALF + k] = atlas.minima.core[0, 1, k]
        boxes[count, PIECE] = count
        count += 1
    return count


@compiled
def _look_far(cost: Cost, atlas: Atlas, box: Box, front: Array, i: int, level: float, floor: float) -> int:
    """Take a box of a list and return what becomes of it."""
    pop(front, i, box.at, box.half)
    piece = int(front[i, PIECE])
    set_centre(atlas, piece, box.at)
    # What lies in the surroundings of the fix is covered there.
    around = piece <= 2 * atlas.dimension and atlas.minima.home.shape[0] > 0
    if around and within(atlas, box.half, 0)[1]:
        return _OUT
    bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
    return _decide(cost, box, level, floor)


@compiled
def _write_cell(cost: Cost, atlas: Atlas, box: Box, boxes: Array, i: int, cells: Array, far: Array) -> None:
    """Write a box in homogeneous coordinates, and the cost at infinity in its direction if it reaches there."""
    d, piece = atlas.dimension, int(boxes[i, PIECE])
    pop(boxes, i, box.at, box.half)
    set_centre(atlas, piece, box.at)
    for k in range(d):
        cells[i, 0, k] = atlas.radius * atlas.point[k]
        for m in range(d):
            cells[i, 1 + m, k] = atlas.radius * atlas.slant[k, m] * box.half[m]
    cells[i, 0, d] = atlas.scale[0]
    for m in range(d):
        cells[i, 1 + m, d] = atlas.scale[1 + m] * box.half[m]
    far[i] = inf
    if piece < 2 * d and box.at[d - 1] <= box.half[d - 1]:
        atlas.scale[0] = 0.0
        bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
        far[i] = cost_at(cost.K, cost.w, box.nodes)
