"""Branch and bound outside a cube, to infinity, and with a search inside it: proofs where nothing encloses."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.boxes import cost_at, least_residual, linearise_rows
from optloc.proof.chart import Box, Chart, Cost, empty_box
from optloc.proof.convex import slopes_everywhere, spread_of, sum_up
from optloc.proof.descend import descend
from optloc.proof.far import Far, bound_far, curve_far, position, set_face
from optloc.types import Array

# What a search of the outside finds: nothing, a cheaper point, a point below the level that may belong to another
# minimum, no end within the budget, or a cost at infinity below the level.
CLEAR, CHEAPER, LOW, SPENT, INFINITE = range(5)
_CAPACITY, _DEPTH = 1024, 8
# A box at infinity of this size whose cost is below the level is not split further.
_TINY = 1e-5
# Minima closer than this are the same, standard deviations of the fix.
_SAME = 0.1


@compiled
def search_far(
    cost: Cost,
    far: Far,
    box: Box,
    chart: Chart,
    minima: Array,
    level: float,
    value: float,
    budget: int,
    found: Array,
) -> tuple[int, int, float]:
    """Search the outside of a cube for positions that cost less than a level.

    A box is done where the cost is at least `level`. Where `level` exceeds `value` it is also done where the gradient
    cannot vanish: the least cost over all positions, if it is attained, is attained elsewhere.

    Parameters
    ----------
    cost : Cost
        The cost; `optloc.proof.far.reaches_infinity` holds.
    far : Far
        The outside.
    box : Box
        Tables.
    chart : Chart
        Search coordinates around the fix, in which low points descend.
    minima : array (P, 3)
        Known minima in those coordinates.
    level : float
        Cost to exceed.
    value : float
        Cost below which a point refutes the fix.
    budget : int
        How many boxes may be looked at.
    found : array (D,)
        Written: the point of the outcomes CHEAPER and LOW.

    Returns
    -------
    outcome : int
        CLEAR: no minimum costs less than `level`. CHEAPER: `found` costs less than `value`. LOW: `found` is another
        minimum that costs less than `level`. SPENT: boxes are left. INFINITE: the cost at infinity is below `level`.
    boxes : int
        How many boxes were looked at.
    bound : float
        A lower bound of f there: `value`, unless boxes are left.
    """
    stack, near, lows = np.empty((_CAPACITY, _DEPTH)), empty_box(cost.K.shape[0], cost.K.shape[1]), 0
    size, boxes, floor = _faces(stack, far.dimension), 0, _floor(cost, far)
    while size > 0:
        if boxes >= budget or size + 2 > stack.shape[0]:
            return SPENT, boxes, _least(stack, size)
        size -= 1
        boxes += 1
        box.at[:], box.half[:] = stack[size, :3], stack[size, 3:6]
        face = int(stack[size, 7])
        set_face(far, face, box.at)
        bound_far(far, cost.kinds, cost.data, box.at, box.half, box.nodes)
        linearise_rows(cost.K, cost.w, box.nodes, box.rows)
        low = least_residual(cost.K, cost.weight, floor, box.half, box.nodes, box.rows)
        if low > 0.0 and low * low >= level:
            continue
        here = cost_at(cost.K, cost.w, box.nodes)
        if here < level:
            position(far, box.at, found)
            if here < value:
                return CHEAPER, boxes, 0.0
        if level > value and _leaves(cost, far, box):
            continue
        if here < level:
            lows += 1
            if lows & (lows - 1) == 0 and _another(cost, chart, near, minima, level, found):
                return LOW, boxes, 0.0
        touching = box.at[far.dimension - 1] <= box.half[far.dimension - 1]
        if touching and max(box.half[0], box.half[1], box.half[2]) < _TINY and _at_infinity(cost, far, box) < level:
            return INFINITE, boxes, 0.0
        size = _split(stack, size, far.dimension, box, low, face)
    return CLEAR, boxes, value


@compiled
def _another(cost: Cost, chart: Chart, near: Box, minima: Array, level: float, found: Array) -> bool:
    """Return whether a point descends to a minimum below the level that is not known; `found` is moved there."""
    dimension = found.shape[0]
    for k in range(3):
        near.at[k] = 0.0
        for m in range(dimension):
            near.at[k] += chart.back[k, m] * (found[m] - chart.origin[m])
    if not descend(cost, chart, near) < level:
        return False
    for p in range(minima.shape[0]):
        if max(abs(near.at[0] - minima[p, 0]), abs(near.at[1] - minima[p, 1]), abs(near.at[2] - minima[p, 2])) < _SAME:
            return False
    for m in range(dimension):
        found[m] = near.centre[m]
    return True


@compiled
def _faces(stack: Array, dimension: int) -> int:
    """Push all faces of the cube, from infinity to its surface."""
    stack[:] = 0.0
    size = 2 * dimension
    for face in range(size):
        for k in range(dimension - 1):
            stack[face, 3 + k] = 1.0
        stack[face, dimension - 1] = stack[face, dimension + 2] = 0.5
        stack[face, 7] = face
    return size


@compiled
def _split(stack: Array, size: int, dimension: int, box: Box, low: float, face: int) -> int:
    """Push the halves of a box, cut across the side along which the residual changes most; return the stack's size."""
    most, k = -1.0, 0
    for m in range(dimension):
        steep = 0.0
        for i in range(box.rows.shape[0]):
            steep += box.rows[i, 1 + m] * box.rows[i, 1 + m]
        steep = sqrt(steep) * box.half[m]
        if steep > most:
            most, k = steep, m
    for side in range(2):
        stack[size, :3], stack[size, 3:6] = box.at, box.half
        quarter = 0.5 * box.half[k]
        # Centres and half-widths are exact: sums of powers of two.
        stack[size, k] += quarter if side else -quarter
        stack[size, 3 + k] = quarter
        stack[size, 6], stack[size, 7] = low, face
        size += 1
    return size


@compiled
def _leaves(cost: Cost, far: Far, box: Box) -> bool:
    """Return whether no infimum of the cost can lie in a box whose nodes are bounded.

    The gradient does not vanish; and at infinity, an end of the box that is none of space, the cost also falls inwards
    or changes along infinity.
    """
    curve_far(far, cost.kinds, cost.data, box.at, box.half, box.curves)
    sum_up(cost.K, cost.w, box.nodes, box.curves, box.sums)
    last = far.dimension - 1
    if box.at[last] > box.half[last]:
        return slopes_everywhere(cost.A, box.half, box.nodes, box.curves, box.sums, box.solve)
    ball = spread_of(cost.A, box.half, box.nodes, box.curves, box.sums)
    if not ball < inf:
        return False
    sums, h = box.sums, box.half
    ball *= sqrt(h[0] * h[0] + h[1] * h[1] + h[2] * h[2])
    for k in range(far.dimension):
        change = ball * (1.0 + 1e-6)
        for m in range(3):
            entry = _entry(k, m)
            change += (abs(sums[entry]) + sums[9 + entry]) * h[m] * (1.0 + 1e-6)
        slope = sums[6 + k]
        if -slope > change or (k < last and slope > change):
            return True
    return False


@compiled
def _entry(k: int, m: int) -> int:
    """Return where entry (k, m) of a symmetric matrix stands among (00, 01, 02, 11, 12, 22)."""
    first, second = min(k, m), max(k, m)
    return second if first == 0 else first + second + 1


@compiled
def _at_infinity(cost: Cost, far: Far, box: Box) -> float:
    """Return the cost at infinity in the direction of a box's centre; its tables are those of that point then."""
    last = far.dimension - 1
    middle, box.at[last] = box.at[last], 0.0
    bound_far(far, cost.kinds, cost.data, box.at, box.half, box.nodes)
    box.at[last] = middle
    return cost_at(cost.K, cost.w, box.nodes)


@compiled
def _floor(cost: Cost, far: Far) -> float:
    """Return the sizes of what residuals are differences of, beside the nodes: measurements and the cube."""
    total = 0.0
    for i in range(cost.w.shape[0]):
        total += cost.w[i] * cost.w[i]
    total = sqrt(total)
    size = 4.0 * far.radius + abs(far.middle[0]) + abs(far.middle[1]) + abs(far.middle[2])
    for j in range(cost.kinds.shape[0]):
        total += cost.weight[j] * (size if cost.kinds[j] == 0 else 4.0)
    return total


@compiled
def _least(stack: Array, size: int) -> float:
    """Return a lower bound of the cost in the boxes left."""
    least = inf
    for i in range(size):
        low = max(stack[i, 6], 0.0)
        least = min(least, low * low)
    return least
