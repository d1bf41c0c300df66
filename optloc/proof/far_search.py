"""Branch and bound over all positions, for costs that nothing encloses."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.atlas import Atlas, coordinates_on, position, set_centre, within
from optloc.proof.boxes import cost_at, least_residual, linearise_rows
from optloc.proof.chart import Box, Chart, Cost, empty_box
from optloc.proof.convex import slopes_everywhere, spread_of, sum_up
from optloc.proof.descend import descend
from optloc.proof.far import bound_pieces, curve_pieces
from optloc.proof.linear3 import principal
from optloc.proof.nodes import RANGE
from optloc.proof.stack import push_around
from optloc.types import Array

# What a search finds: nothing, a cheaper point, another minimum below the level, no end within the budget, or a cost at
# infinity below the level.
CLEAR, CHEAPER, ANOTHER, SPENT, INFINITE = range(5)
_CAPACITY, _DEPTH = 2048, 8
# A box at infinity of this size whose cost is below the level is not split further.
_TINY = 1e-5
# Points closer to a minimum than this are that minimum, standard deviations.
_SAME = 1e-3
_ALIKE = 0.1
_NEAR = 100.0


@compiled
def search_everywhere(
    cost: Cost, atlas: Atlas, chart: Chart, level: float, value: float, budget: int, found: Array
) -> tuple[int, int, float]:
    """Search all positions but some boxes for minima that cost less than a level.

    A box is done where the cost is at least `level`, or where it has no minimum, its gradient or its curvature being of
    one sign: the least cost over all positions, if it is attained, is attained elsewhere. Around known minima boxes
    lie along their principal axes.

    Parameters
    ----------
    cost : Cost
        The cost; `optloc.proof.far.reaches_infinity` holds.
    atlas : Atlas
        The pieces, known minima among them.
    chart : Chart
        Search coordinates around the fix, in which low points descend.
    level : float
        Cost to exceed.
    value : float
        Cost below which a point refutes the fix.
    budget : int
        How many boxes may be looked at.
    found : array (D,)
        Written: the point of the outcomes CHEAPER and ANOTHER.

    Returns
    -------
    outcome : int
        CLEAR: no minimum costs less than `level`. CHEAPER: `found` costs less than `value`. ANOTHER: `found` is a
        minimum that costs less than `level`. SPENT: boxes are left. INFINITE: the cost at infinity is below `level`.
    boxes : int
        How many boxes were looked at.
    bound : float
        A lower bound of f: `value`, unless boxes are left.
    """
    box, near = empty_box(cost.K.shape[0], cost.K.shape[1]), empty_box(cost.K.shape[0], cost.K.shape[1])
    stack, last = np.zeros((_CAPACITY, _DEPTH)), atlas.dimension - 1
    size, boxes, lows, floor = _pieces(stack, atlas), 0, 0, _floor(cost, atlas)
    while size > 0:
        if boxes >= budget or size + 2 > _CAPACITY:
            return SPENT, boxes, _least(stack, size)
        size -= 1
        boxes += 1
        box.at[:], box.half[:] = stack[size, :3], stack[size, 3:6]
        piece = int(stack[size, 7])
        set_centre(atlas, piece, box.at)
        if _known(atlas, box, piece):
            continue
        bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
        linearise_rows(cost.K, cost.w, box.nodes, box.rows)
        low = least_residual(cost.K, cost.weight, floor, box.half, box.nodes, box.rows)
        if low > 0.0 and low * low >= level:
            continue
        here = cost_at(cost.K, cost.w, box.nodes)
        if here < value:
            position(atlas, found)
            return CHEAPER, boxes, 0.0
        touching = piece < 2 * atlas.dimension and box.at[last] <= box.half[last]
        # The test is dear, and fails in large boxes: only where the cost is low it can spare splits.
        if here < _NEAR * (level + 1.0) and _leaves(cost, atlas, box, touching):
            continue
        if here < level:
            lows += 1
            if lows & (lows - 1) == 0 and _another(cost, atlas, chart, near, level, found):
                return ANOTHER, boxes, 0.0
        if touching and max(box.half[0], box.half[1], box.half[2]) < _TINY and _at_infinity(cost, atlas, box) < level:
            return INFINITE, boxes, 0.0
        size = _split(stack, size, atlas.dimension, box, low, piece)
    return CLEAR, boxes, value


@compiled
def _known(atlas: Atlas, box: Box, piece: int) -> bool:
    """Return whether a box lies in the convex box of a known minimum, or in one that is searched along its axes."""
    known, d = False, atlas.dimension
    for i in range(atlas.minima.home.shape[0]):
        known = known or within(atlas, box.half, i, atlas.minima.sides[i])
        # A box around one minimum is left to those that come before it, never to itself.
        if piece <= 2 * d or piece > 2 * d + 1 + i:
            known = known or within(atlas, box.half, i, atlas.minima.core[i])
    return known


@compiled
def _another(cost: Cost, atlas: Atlas, chart: Chart, near: Box, level: float, found: Array) -> bool:
    """Return whether the centre of a box descends to a minimum below the level that is not known, and write it."""
    d, minima, u = atlas.dimension, atlas.minima, np.zeros(3)
    position(atlas, found)
    for k in range(3):
        near.at[k] = 0.0
        for m in range(d):
            near.at[k] += chart.back[k, m] * (found[m] - chart.origin[m])
    if not descend(cost, chart, near) < level:
        return False
    for i in range(minima.home.shape[0]):
        inside = coordinates_on(atlas, minima.home[i], near.centre, u)
        for k in range(d):
            away = 0.0
            for m in range(d):
                away += minima.back[i, k, m] * (u[m] - minima.start[i, m])
            inside = inside and abs(away) <= max(minima.sides[i, k], _SAME)
        if inside:
            return False
    for m in range(d):
        found[m] = near.centre[m]
    return True


@compiled
def _pieces(stack: Array, atlas: Atlas) -> int:
    """Push all faces of the cube, its inside, and on top of them the surroundings of known minima, the fix last."""
    d = atlas.dimension
    size = 2 * d + 1
    for piece in range(size):
        for k in range(d):
            stack[piece, 3 + k] = 1.0
        if piece < 2 * d:
            stack[piece, d - 1] = stack[piece, d + 2] = 0.5
        stack[piece, 7] = piece
    slabs = np.zeros((6, 7))
    for i in range(atlas.minima.home.shape[0] - 1, -1, -1):
        core = atlas.minima.core[i]
        for slab in range(push_around(slabs, -core, core, atlas.minima.sides[i])):
            stack[size, :7] = slabs[slab]
            stack[size, 7] = 2 * d + 1 + i
            size += 1
    return size


@compiled
def _split(stack: Array, size: int, dimension: int, box: Box, low: float, piece: int) -> int:
    """Push the halves of a box, cut across the side along which the residual changes most; return the stack's size."""
    k = _side(box, dimension)
    for side in range(2):
        stack[size, :3], stack[size, 3:6] = box.at, box.half
        quarter = 0.5 * box.half[k]
        stack[size, k] += quarter if side else -quarter
        # Exact but around the fix, where centres and half-widths are no sums of powers of two.
        stack[size, 3 + k] = quarter + (1e-15 * (abs(box.at[k]) + quarter) if piece > 2 * dimension else 0.0)
        stack[size, 6], stack[size, 7] = low, piece
        size += 1
    return size


@compiled
def _side(box: Box, dimension: int) -> int:
    """Return the side along which the residual changes most; a part of that change counts for all sides alike.

    Nodes that are only enclosed have no slope, and bend where they do.
    """
    steepest, best, k = 0.0, -1.0, 0
    for m in range(dimension):
        steepest = max(steepest, _steepness(box, m))
    for m in range(dimension):
        change = (_steepness(box, m) + _ALIKE * steepest + 1e-300) * box.half[m]
        if change > best:
            best, k = change, m
    return k


@compiled
def _steepness(box: Box, m: int) -> float:
    total = 0.0
    for i in range(box.rows.shape[0]):
        total += box.rows[i, 1 + m] * box.rows[i, 1 + m]
    return sqrt(total)


@compiled
def _leaves(cost: Cost, atlas: Atlas, box: Box, touching: bool) -> bool:
    """Return whether no infimum of the cost can lie in a box whose nodes are bounded.

    The gradient does not vanish, or the Hessian has a negative eigenvalue; and at infinity, an end of the box that is
    none of space, the cost falls inwards or changes along infinity.
    """
    curve_pieces(atlas, cost.kinds, cost.data, box.half, box.curves)
    sum_up(cost.K, cost.w, box.nodes, box.curves, box.sums)
    if not touching and slopes_everywhere(cost.A, box.half, box.nodes, box.curves, box.sums, box.solve):
        return True
    ball = spread_of(cost.A, box.half, box.nodes, box.curves, box.sums)
    if not ball < inf:
        return False
    if not touching:
        return _bends_down(box, ball)
    sums, h = box.sums, box.half
    ball *= sqrt(h[0] * h[0] + h[1] * h[1] + h[2] * h[2])
    for k in range(atlas.dimension):
        change = ball
        for m in range(3):
            entry = _entry(k, m)
            change += (abs(sums[entry]) + sums[9 + entry]) * h[m]
        slope, change = sums[6 + k], change * (1.0 + 1e-6) + 1e-9
        if -slope > change or (k < atlas.dimension - 1 and slope > change):
            return True
    return False


@compiled
def _bends_down(box: Box, ball: float) -> bool:
    """Return whether the cost curves downwards along one direction all over a box, as around a saddle.

    `optloc.proof.convex.spread_of` has filled ``box.sums[9:15]`` and returned `ball`, bounds of the Hessian's change.
    """
    sums, hessian, vectors = box.sums, box.solve, np.empty((3, 3))
    for k in range(3):
        for m in range(3):
            hessian[k, m] = sums[_entry(k, m)]
    principal(hessian, vectors)
    column = 0
    for k in range(1, 3):
        if hessian[k, k] < hessian[column, column]:
            column = k
    most = ball
    for k in range(3):
        for m in range(3):
            entry = _entry(k, m)
            z = vectors[k, column] * vectors[m, column]
            most += sums[entry] * z + sums[9 + entry] * abs(z)
    size = abs(sums[0]) + abs(sums[3]) + abs(sums[5])
    return bool(most < -1e-9 * size)


@compiled
def _entry(k: int, m: int) -> int:
    """Return where entry (k, m) of a symmetric matrix stands among (00, 01, 02, 11, 12, 22)."""
    first, second = min(k, m), max(k, m)
    return second if first == 0 else first + second + 1


@compiled
def _at_infinity(cost: Cost, atlas: Atlas, box: Box) -> float:
    """Return the cost at infinity in the direction of the centre of a box on a face; its table of nodes is lost."""
    atlas.scale[0] = 0.0
    bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
    return cost_at(cost.K, cost.w, box.nodes)


@compiled
def _floor(cost: Cost, atlas: Atlas) -> float:
    """Return the sizes of what residuals are differences of, beside the nodes: measurements and the cube."""
    total = 0.0
    for i in range(cost.w.shape[0]):
        total += cost.w[i] * cost.w[i]
    total = sqrt(total)
    size = 4.0 * atlas.radius + abs(atlas.middle[0]) + abs(atlas.middle[1]) + abs(atlas.middle[2])
    for j in range(cost.kinds.shape[0]):
        total += cost.weight[j] * (size if cost.kinds[j] == RANGE else 4.0)
    return total


@compiled
def _least(stack: Array, size: int) -> float:
    """Return a lower bound of the cost in the boxes left."""
    least = inf
    for i in range(size):
        low = max(stack[i, 6], 0.0)
        least = min(least, low * low)
    return least
