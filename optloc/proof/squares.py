"""Squared rows of ranges over a box of an atlas: linear in the position and one range, they contract boxes of any size.

The error of a range against the range of a reference station p is ``e_j = phi_j - phi_p - z_j``. With lines scaled by
v, in half sides of the cube, the error obeys

    (q_j - q_p - v z_j) (q_j + q_p + v z_j) / v = N_j - N_p - 2 z_j q_p - v z_j^2,

with ``q_j = |p - v a_j|`` and the linear function ``N_j = -2 a_j.p + v |a_j|^2``. So an error is the right side divided
by the sum of both ranges and v z_j. On the right side only q_p is not linear over a box. In the rows themselves, no
range is linear. Any station of a group can be the reference. The module takes the station whose range is closest to
linear.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, zero
from optloc.proof.atlas import Atlas, frame_of, scaled_station, set_line
from optloc.proof.box import (
    DIRECTION,
    J0,
    MIDDLE,
    ROW_WIDTH,
    contract_box,
    is_empty,
    least_residual,
    relative_rounding,
    reset_cut,
)
from optloc.proof.enclosure import SLACK
from optloc.proof.nodes.node import FORCE, HIGH, LOW, NODE_WIDTH, PHI, RANGE, range_form, triple_at
from optloc.proof.search_space import Box, Cost

# Columns of a table of lines over a box (J, LINE_WIDTH): value, slope, least, greatest and remainder of the scaled
# range; then N and its gradient.
VALUE, SLOPE, LEAST, MOST, BEND, LINEAR, GRADIENT, LINE_WIDTH = 0, 1, 4, 5, 6, 7, 8, 11


class Squares(NamedTuple):
    """Squared rows of groups of ranges, and tables for one box.

    Parameters
    ----------
    group : int array (J,)
        Number of the group of each node; -1 for nodes without a squared row.
    groups : int
        Number of groups.
    late : array (J,)
        Measured value of each range minus the value of the reference of its group, metres.
    spread : array (J, J)
        Greatest error of the difference of two ranges of a group if the residual has length one, metres.
    sizes : array (J,)
        Sizes of the coordinates that form each line as a difference, half sides of the cube.
    floor : float
        Sizes of the terms of residuals, times their weights.
    lack : float
        Greatest error of a residual of the squared rows by the rounding of `late`.
    steep : float
        Greatest change of a residual per unit change of the scaled range of a reference.
    lines : array (J, LINE_WIDTH)
        Table of lines over a box.
    K, weight, nodes, rows : arrays (q, G), (G,), (G, NODE_WIDTH), (q, ROW_WIDTH)
        Tables of the squared rows, whose nodes are the ranges of references: see `optloc.proof.box`.
    """

    group: Array
    groups: int
    late: Array
    spread: Array
    sizes: Array
    floor: float
    lack: float
    steep: float
    lines: Array
    K: Array
    weight: Array
    nodes: Array
    rows: Array


@compiled
def squares_of(cost: Cost, box: Box, middle: Array, radius: float) -> Squares:
    """Return the squared rows of a cost; the tables of the box must be the tables of a fix (`chart_at`).

    `middle` (3,) and `radius` are centre and half-width, m, of the cube of the atlas.
    """
    kinds, groups, nodes = cost.kinds, cost.groups, box.nodes
    J, order, R, tie = kinds.shape[0], groups.order, groups.R, groups.tie
    group, late, spread, sizes = np.full(J, -1), np.zeros(J), np.zeros((J, J)), np.zeros(J)
    first, count, floor, lack, steep = zero(), zero(), 0.0, 0.0, 0.0
    for number in range(J):
        members, reference = order[1, number], order[2, number]
        if members == 0:
            break
        own, last = order[0, first : first + members], members - 1
        # Only groups of range differences are usable: all ranges follow the reference.
        usable = members > 1 and reference >= 0
        for i in range(last):
            usable = usable and kinds[own[i]] == RANGE and tie[own[i]] == 1.0
        if usable:
            among = R[first : first + last, first : first + last]
            lack += _set_late(cost, box, own, among, late)
            _set_spread(own, among, spread)
            for j in own:
                group[j] = count
                steep += cost.weight[j] * abs(late[j])
                for k in range(3):
                    sizes[j] += (abs(cost.data[j, k]) + abs(middle[k])) / radius
                floor += cost.weight[j] * (nodes[j, PHI] + nodes[reference, PHI] + abs(late[j]))
            count += 1
        first += members
    q, G = cost.K.shape[0], count
    return Squares(
        group,
        count,
        late,
        spread,
        sizes,
        floor,
        lack,
        steep,
        np.zeros((J, LINE_WIDTH)),
        np.zeros((q, G)),
        np.zeros(G),
        np.zeros((G, NODE_WIDTH)),
        np.zeros((q, ROW_WIDTH)),
    )


@compiled
def _set_late(cost: Cost, box: Box, own: Array, R: Array, late: Array) -> float:
    """Write the measured range differences of a group, m, into `late`; return a bound of their error.

    The bound is the length of a residual. `own` are the nodes of the group, reference last, and R is the covariance of
    their errors. Errors at the fix are e = R f, with f the forces K'(K phi - w). Exact errors obey A e = f. The length
    of the remaining difference bounds the error of the result.
    """
    last, nodes, curves = own.shape[0] - 1, box.nodes, box.curves
    reference = own[last]
    for i in range(last):
        error = 0.0
        for m in range(last):
            error += R[i, m] * curves[own[m], FORCE]
        late[own[i]] = nodes[own[i], PHI] - nodes[reference, PHI] - error
    off, square = np.empty(last), 0.0
    for i in range(last):
        off[i] = curves[own[i], FORCE]
        for m in range(last):
            j = own[m]
            off[i] -= cost.A[own[i], j] * (nodes[j, PHI] - nodes[reference, PHI] - late[j])
        for m in range(i + 1):
            square += R[i, m] * off[i] * off[m] * (1.0 if m == i else 2.0)
    return sqrt(max(square, 0.0))


@compiled
def _set_spread(own: Array, R: Array, spread: Array) -> None:
    """Write the standard deviations, m, of the differences of two ranges of a group into `spread` (J, J).

    `own` are the nodes of the group, reference last, and R is the covariance of their errors. A share of the terms is
    added, because the difference of variances cancels digits.
    """
    last = own.shape[0] - 1
    for i in range(last + 1):
        for m in range(last + 1):
            first, second = R[i, i] if i < last else 0.0, R[m, m] if m < last else 0.0
            tied = R[i, m] if i < last and m < last else 0.0
            spread[own[i], own[m]] = sqrt(max(first + second - 2.0 * tied, 0.0) + SLACK * (first + second))


@compiled
def change_of_residual(atlas: Atlas, squares: Squares, half: Array) -> float:
    """Return the greatest change of a residual over a box by the remainder of the distance to the cube's centre."""
    return float(range_form(atlas.point, atlas.slant, triple_at(half, 0))[3] * squares.steep)


@compiled
def clip_to_squares(cost: Cost, atlas: Atlas, squares: Squares, rho: float, box: Box) -> bool:
    """Contract the current box to where the residual may be shorter than rho; return whether any part remains.

    The ends of the remaining part are written into ``box.cut``.
    """
    _fill_lines(cost, atlas, squares, box.half)
    longest = rho * (1.0 + SLACK) + SLACK + squares.lack
    wider, size = _fill_rows(cost, atlas, squares, box.half)
    longest *= 1.0 + wider
    _deflate(squares, longest)
    low = least_residual(squares.K, squares.weight, size, box.half, squares.nodes, squares.rows)
    reset_cut(box.half, box.cut)
    if low > longest:
        return False
    noise, flat = relative_rounding(squares.K) * size, box.half[2] == 0.0
    contract_box(
        squares.K, squares.weight, longest + noise, box.half, flat, squares.nodes, squares.rows, box.cut, box.solve
    )
    return not is_empty(box.cut)


@compiled
def _fill_lines(cost: Cost, atlas: Atlas, squares: Squares, half: Array) -> None:
    """Write the table of scaled lines from the stations over the current box of the atlas into ``squares.lines``."""
    frame, h, lines = frame_of(atlas), triple_at(half, 0), squares.lines
    for j in range(lines.shape[0]):
        if squares.group[j] < 0:
            continue
        set_line(frame, cost.data[j], 0, atlas.away, atlas.sense)
        value, slope, least, bend, most = range_form(atlas.away, atlas.sense, h)
        _, linear, gradient = scaled_station(frame, cost.data[j])
        lines[j, VALUE], lines[j, LEAST], lines[j, MOST] = value, max(least, 0.0), most
        lines[j, BEND], lines[j, LINEAR] = bend, linear
        lines[j, SLOPE], lines[j, SLOPE + 1], lines[j, SLOPE + 2] = slope
        lines[j, GRADIENT], lines[j, GRADIENT + 1], lines[j, GRADIENT + 2] = gradient


@compiled
def _fill_rows(cost: Cost, atlas: Atlas, squares: Squares, half: Array) -> tuple[float, float]:
    """Write the table of squared rows; return the share by which they may exceed a residual, and sizes of terms.

    The sizes are for `optloc.proof.box.least_residual`: sums of terms, times their weights, that limit the accuracy.
    """
    lines, rows, K, radius, scale = squares.lines, squares.rows, cost.K, atlas.radius, atlas.scale
    swing = abs(scale[1]) * half[0] + abs(scale[2]) * half[1] + abs(scale[3]) * half[2]
    far, most = abs(scale[0]) + swing, 0.0
    for k in range(3):
        most += abs(atlas.point[k])
        for m in range(3):
            most += abs(atlas.slant[k, m]) * half[m]
    rows[:], squares.K[:] = 0.0, 0.0
    wider, size = 0.0, squares.floor
    for g in range(squares.groups):
        reference = -1  # the range of the group that is closest to linear over the box
        for j in range(lines.shape[0]):
            if squares.group[j] == g and (reference < 0 or lines[j, BEND] < lines[reference, BEND]):
                reference = j
        bend = 0.5 * lines[reference, BEND]
        for j in range(lines.shape[0]):
            if squares.group[j] != g or j == reference:
                continue
            # The measured difference z_j, and bounds of the divisor: two ranges plus v z_j. The unit is half a side
            # of the cube.
            late = (squares.late[j] - squares.late[reference]) / radius
            low = lines[j, LEAST] + lines[reference, LEAST] + scale[0] * late - swing * abs(late)
            high = lines[j, MOST] + lines[reference, MOST] + scale[0] * late + swing * abs(late)
            # Any positive number is valid. The middle is best, but it may be negative.
            middle = max(0.5 * (low + high), 0.25 * (lines[j, MOST] + lines[reference, MOST]))
            share = max(high / middle - 1.0, 1.0 - low / middle)
            wider += cost.weight[j] * squares.spread[j, reference] * share
            factor = radius / middle
            constant = lines[j, LINEAR] - lines[reference, LINEAR] - 2.0 * late * (lines[reference, VALUE] + bend)
            constant -= scale[0] * late * late
            g0 = lines[j, GRADIENT] - lines[reference, GRADIENT]
            g1 = lines[j, GRADIENT + 1] - lines[reference, GRADIENT + 1]
            g2 = lines[j, GRADIENT + 2] - lines[reference, GRADIENT + 2]
            g0 -= 2.0 * late * lines[reference, SLOPE] + late * late * scale[1]
            g1 -= 2.0 * late * lines[reference, SLOPE + 1] + late * late * scale[2]
            g2 -= 2.0 * late * lines[reference, SLOPE + 2] + late * late * scale[3]
            both = squares.sizes[j] + squares.sizes[reference]
            terms = both * (2.0 * most + far * both) + 2.0 * abs(late) * lines[reference, MOST] + late * late * far
            size += cost.weight[j] * factor * terms
            for i in range(K.shape[0]):
                weight = K[i, j] * factor
                rows[i, MIDDLE] += weight * constant
                rows[i, J0] += weight * g0
                rows[i, J0 + 1] += weight * g1
                rows[i, J0 + 2] += weight * g2
                squares.K[i, g] += weight * 2.0 * late
        squares.nodes[g, LOW], squares.nodes[g, HIGH] = -bend, bend
    # Sums over all nodes of a group have one rounding for each node.
    return wider, size * relative_rounding(cost.K) / relative_rounding(squares.K)


@compiled
def _deflate(squares: Squares, longest: float) -> None:
    """Shorten the rows along the directions of the reference ranges by the best factor; no residual becomes longer.

    `longest` is the greatest residual of interest. This is close to least squares with the errors of rows and
    references as noise. The closer it is, the more of the box is cut off.
    """
    rows, K = squares.rows, squares.K
    for g in range(squares.groups):
        square = 0.0
        for i in range(K.shape[0]):
            square += K[i, g] * K[i, g]
        squares.weight[g] = sqrt(square)
        bend = squares.nodes[g, HIGH]
        if not square > 0.0:
            continue
        left = 1.0 / sqrt(1.0 + square * bend * bend / (longest * longest))
        for column in range(MIDDLE, DIRECTION):
            along = 0.0
            for i in range(K.shape[0]):
                along += K[i, g] * rows[i, column]
            along *= (1.0 - left) / square
            for i in range(K.shape[0]):
                rows[i, column] -= along * K[i, g]
        for i in range(K.shape[0]):
            K[i, g] *= left
        squares.weight[g] *= left
