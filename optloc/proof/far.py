"""The cost over the pieces of an atlas: all nodes over a box, out to infinity, and the surroundings of known minima.

Angles and ratios are functions of the scaled line ``p - v a`` alone; ranges count less the distance to the centre of
the cube, which rows whose coefficients of ranges sum to zero do not feel.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.proof.atlas import Atlas, home_of, set_centre
from optloc.proof.box import J0, linearise_rows
from optloc.proof.chart import Box, Cost
from optloc.proof.convex import G0, G1, G2, convex, sum_up
from optloc.proof.linear3 import principal
from optloc.proof.nodes.dispatch import bound_pieces, curve_pieces, infinity_of, points_of
from optloc.proof.nodes.node import (
    ANY,
    DIFFERENCE,
    GROWS,
)

# How little the coefficients of ranges in a row may sum to, relative to their sizes: zero but for whitening's rounding.
_BALANCED = 1e-12
# Half-width of the cube, reaches of the stations: with a margin, so that no station touches a face, where lines to it
# would vanish.
_REACHES = 1.25


@compiled
def reaches_infinity(kinds: Array, K: Array) -> bool:
    """Return whether a cost stays finite at infinity, so that the chart holds.

    Linear forms, heights, and ranges that no other balances grow without end.

    Parameters
    ----------
    kinds : int array (J,)
        Codes of the nodes.
    K : array (q, J)
        Whitened rows.
    """
    for j in range(kinds.shape[0]):
        if infinity_of(kinds[j]) == GROWS:
            return False
    for i in range(K.shape[0]):
        total = size = 0.0
        for j in range(kinds.shape[0]):
            if infinity_of(kinds[j]) == DIFFERENCE:
                total += K[i, j]
                size += abs(K[i, j])
        if abs(total) > _BALANCED * size:
            return False
    return True


@compiled
def cube(kinds: Array, data: Array) -> tuple[Array, float]:
    """Return centre (3,) and half-width of a cube that holds all stations well.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        Nodes that have stations.
    """
    low, high = np.full(3, inf), np.full(3, -inf)
    for j in range(kinds.shape[0]):
        for first in range(0, 3 * points_of(kinds[j]), 3):
            for k in range(3):
                low[k], high[k] = min(low[k], data[j, first + k]), max(high[k], data[j, first + k])
    reach = 0.0
    for k in range(3):
        reach = max(reach, 0.5 * (high[k] - low[k]))
    return 0.5 * (low + high), max(_REACHES * reach, 1.0)


@compiled
def accuracy_floor_far(cost: Cost, atlas: Atlas) -> float:
    """Return the sizes of what residuals are differences of, beside the nodes: measurements and the cube."""
    total = 0.0
    for i in range(cost.w.shape[0]):
        total += cost.w[i] * cost.w[i]
    total = sqrt(total)
    # Lines are p - v a with |p| at most sqrt(3) and |a| below 1: their lengths, and sums of two, are below 4 reaches.
    size = 4.0 * atlas.radius + abs(atlas.middle[0]) + abs(atlas.middle[1]) + abs(atlas.middle[2])
    for j in range(cost.kinds.shape[0]):
        total += cost.weight[j] * (size if infinity_of(cost.kinds[j]) == DIFFERENCE else 4.0)
    return total


# The surroundings of a known minimum in an atlas: its principal axes, and a box in which it is the only minimum.

# No convex box is looked for beyond this many standard deviations: a fix so well determined needs none wider. Nor
# nearer to infinity than a tenth of the way, where its coordinates end.
_WIDEST, _SHARE = 1e4, 0.9
# The box searched along the axes of a minimum: convex boxes, and standard deviations at least. Beyond it the cost is
# high enough for boxes along the axes of space.
_WIDER, _WIDE = 3.0, 3.0
# Factor by which convex boxes are tried larger: the last one that is convex is at least two thirds of the largest.
_GROWTH = 1.5


@compiled
def set_minimum(cost: Cost, box: Box, atlas: Atlas, i: int, x: Array, eps: float) -> bool:
    """Write a minimum and its surroundings into an atlas; return False where it is none.

    Parameters
    ----------
    cost : Cost
        The cost.
    box : Box
        Tables to work with.
    atlas : Atlas
        Minimum i is written.
    i : int
        Which.
    x : array (D,)
        Its position, polished.
    eps : float
        How far the cost may fall below that of x in its convex box.
    """
    minima, d = atlas.minima, atlas.dimension
    minima.home[i] = home_of(atlas, x, minima.start[i])
    if not _set_axes(cost, box, atlas, i):
        return False
    _tables(cost, box, atlas, i, np.zeros(3))
    sums = box.sums
    # On a box whose Hessian exceeds a margin the cost falls below that of its centre by slope^2 / margin at most.
    margin = (sums[G0] * sums[G0] + sums[G1] * sums[G1] + sums[G2] * sums[G2]) / eps
    hull = np.zeros(3)
    for k in range(d):
        steep = abs(minima.axes[i, d - 1, k]) * d if minima.home[i] < 2 * d else 0.0
        hull[k] = min(_WIDEST, _SHARE * minima.start[i, d - 1] / steep if steep > 0.0 else _WIDEST)
    if not _grow(cost, box, atlas, i, hull, margin):
        return False
    for k in range(d):
        minima.core[i, k] = min(max(_WIDER * minima.sides[i, k], _WIDE), hull[k])
    return True


@compiled
def _set_axes(cost: Cost, box: Box, atlas: Atlas, i: int) -> bool:
    """Write the principal axes of minimum i in the coordinates of its home; return False where there are none."""
    minima, d = atlas.minima, atlas.dimension
    minima.axes[i], minima.back[i] = np.eye(3), np.eye(3)
    _tables(cost, box, atlas, i, np.zeros(3))
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    information, vectors = np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(d):
        for m in range(d):
            for row in range(box.rows.shape[0]):
                information[k, m] += box.rows[row, J0 + k] * box.rows[row, J0 + m]
    principal(information, vectors)
    minima.axes[i], minima.back[i] = 0.0, 0.0
    for k in range(d):
        if not information[k, k] > 0.0:
            return False
        root = sqrt(information[k, k])
        for m in range(d):
            minima.axes[i, m, k], minima.back[i, k, m] = vectors[m, k] / root, vectors[m, k] * root
    return True


@compiled
def _tables(cost: Cost, box: Box, atlas: Atlas, i: int, half: Array) -> None:
    """Fill the tables of a box with half-widths (3,) around minimum i."""
    box.at[:], box.half[:] = 0.0, half
    set_centre(atlas, 2 * atlas.dimension + 1 + i, box.at)
    bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
    curve_pieces(atlas, cost.kinds, cost.data, box.half, box.curves)
    sum_up(cost.K, cost.w, box.nodes, box.curves, box.sums)


@compiled
def _convex(cost: Cost, box: Box, atlas: Atlas, i: int, half: Array, margin: float) -> bool:
    _tables(cost, box, atlas, i, half)
    # Ranges are differences here, whose Hessians have no sign: the test must take them for any node.
    return convex(np.full_like(cost.kinds, ANY), cost.A, box.half, box.nodes, box.curves, box.sums, margin)


@compiled
def _grow(cost: Cost, box: Box, atlas: Atlas, i: int, hull: Array, margin: float) -> bool:
    """Write half-widths of a box around minimum i on which the cost is convex; return False where there is none.

    A cube that shrinks or doubles, then its sides one by one, none beyond the hull (3,).
    """
    sides = atlas.minima.sides[i]
    if not _convex(cost, box, atlas, i, np.zeros(3), margin):
        return False
    trial, size = np.minimum(hull, 1.0), 1.0
    while not _convex(cost, box, atlas, i, trial, margin):
        size *= 0.5
        trial = np.minimum(hull, size)
        if size < 1e-6:  # a millionth of a standard deviation: no box that could hold the rounding of the minimum
            return False
    while size < _WIDEST and _convex(cost, box, atlas, i, np.minimum(hull, _GROWTH * size), margin):
        size *= _GROWTH
    sides[:] = np.minimum(hull, size)
    for k in range(atlas.dimension):
        trial = sides.copy()
        trial[k] = min(_GROWTH * sides[k], hull[k])
        while trial[k] > sides[k] and _convex(cost, box, atlas, i, trial, margin):
            sides[k] = trial[k]
            trial[k] = min(_GROWTH * sides[k], hull[k])
    return True
