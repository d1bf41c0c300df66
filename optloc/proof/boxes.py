"""A box: all nodes bounded over it, and the least length that the residual can have there."""

from __future__ import annotations

from math import sqrt

from optloc.kernels.jit import compiled, inlined
from optloc.proof.angles import bound_azimuth, bound_elevation
from optloc.proof.height import bound_height
from optloc.proof.nodes import AZIMUTH, ELEVATION, LINEAR, RANGE, RATIO
from optloc.proof.ranges import bound_ranges
from optloc.proof.ratio import bound_ratio
from optloc.types import Array

_ULP = 2.0**-52
# Coordinate descents towards the least-squares point of a box; any point gives a valid bound.
_SWEEPS = 3
# Columns of a table of nodes over a box (J, 6): value at the centre, gradient, enclosure of the remainder.
NODE_WIDTH = 6
# Columns of a table of rows over a box (q, 5): residual in the middle of the remainders, Jacobian, direction v.
ROW_WIDTH = 5


@compiled
def bound_linear(line: Array, sense: Array, data: Array, node: Array) -> None:
    """Write the row of a linear form n.(x - o), which has no remainder, into the table of nodes."""
    n0, n1, n2 = data[3], data[4], data[5]
    node[0] = n0 * line[0] + n1 * line[1] + n2 * line[2]
    for k in range(3):
        node[1 + k] = n0 * sense[0, k] + n1 * sense[1, k] + n2 * sense[2, k]
    node[4] = node[5] = 0.0


@inlined
def bound_nodes(
    kinds: Array, data: Array, centre: Array, sense: Array, gram: Array, half: Array, line: Array, nodes: Array
) -> None:
    """Bound all nodes over a box in the near chart.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes.
    centre : array (3,)
        Centre of the box, metres.
    sense, gram : array (3, 3)
        T with x = c + T s, and ``T'T``.
    half : array (3,)
        Half-widths in search coordinates.
    line : array (6,)
        Working memory.
    nodes : array (J, NODE_WIDTH)
        Written.
    """
    others = bound_ranges(kinds, data, centre, sense, gram, half, nodes)
    for j in range(kinds.shape[0] if others else 0):
        kind = kinds[j]
        if kind == RANGE:
            continue
        for k in range(3):
            line[k] = centre[k] - data[j, k]
        if kind == LINEAR:
            bound_linear(line, sense, data[j], nodes[j])
        else:
            for k in range(3):
                line[3 + k] = centre[k] - data[j, 3 + k]
            own, slope = data[j], nodes[j, 1:4]
            if kind == AZIMUTH:
                value, low, high = bound_azimuth(own, line[:3], sense, half, slope)
            elif kind == ELEVATION:
                value, low, high = bound_elevation(own, line[:3], sense, half, slope)
            elif kind == RATIO:
                value, low, high = bound_ratio(own, line[:3], sense, line[3:], sense, half, slope)
            else:
                value, low, high = bound_height(own, line[:3], sense, half, slope)
            nodes[j, 0], nodes[j, 4], nodes[j, 5] = value, low, high


@inlined
def linearise_rows(K: Array, w: Array, nodes: Array, rows: Array) -> None:
    """Fill residuals (in the middle of the remainders) and Jacobian of the table of rows (q, ROW_WIDTH)."""
    for i in range(K.shape[0]):
        middle, j0, j1, j2 = -w[i], 0.0, 0.0, 0.0
        for j in range(K.shape[1]):
            factor = K[i, j]
            middle += factor * (nodes[j, 0] + 0.5 * (nodes[j, 4] + nodes[j, 5]))
            j0 += factor * nodes[j, 1]
            j1 += factor * nodes[j, 2]
            j2 += factor * nodes[j, 3]
        rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3] = middle, j0, j1, j2


@inlined
def cost_at(K: Array, w: Array, nodes: Array) -> float:
    """Return f at the centre of a box whose table of nodes is filled."""
    total = 0.0
    for i in range(K.shape[0]):
        residual = -w[i]
        for j in range(K.shape[1]):
            residual += K[i, j] * nodes[j, 0]
        total += residual * residual
    return total


@inlined
def least_residual(K: Array, weight: Array, floor: float, half: Array, nodes: Array, rows: Array) -> float:
    """Return a lower bound of ``|K phi - w|`` over a box, negative where it says nothing.

    For any v, ``v.(K phi - w)`` over the box is at least its value in the middle less what the box and the remainders
    can change; v is the residual nearest to zero of the linear part (box-constrained least squares).

    Parameters
    ----------
    K : array (q, J)
        Whitened rows.
    weight : array (J,)
        Lengths of the columns of K.
    floor : float
        What else limits the accuracy of residuals: lengths of w and of the coordinates times their weights.
    half : array (3,)
        Half-widths in search coordinates.
    nodes, rows : array (J, NODE_WIDTH), (q, ROW_WIDTH)
        Filled tables; the direction v is written.
    """
    _nearest(half, rows)
    length, reach, t0, t1, t2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(K.shape[0]):
        v = rows[i, 4]
        length += v * v
        reach += v * rows[i, 0]
        t0 += v * rows[i, 1]
        t1 += v * rows[i, 2]
        t2 += v * rows[i, 3]
    if not length > 0.0:
        return -1.0
    reach -= abs(t0) * half[0] + abs(t1) * half[1] + abs(t2) * half[2]
    for j in range(K.shape[1]):
        radius = 0.5 * (nodes[j, 5] - nodes[j, 4])
        if radius > 0.0:
            total = 0.0
            for i in range(K.shape[0]):
                total += K[i, j] * rows[i, 4]
            reach -= abs(total) * radius
    return float(reach / sqrt(length)) - rounding(K, weight, floor, nodes)


@inlined
def rounding(K: Array, weight: Array, floor: float, nodes: Array) -> float:
    """Return a bound of the rounding errors of a residual (its length); arguments as of `least_residual`."""
    size = floor
    for j in range(K.shape[1]):
        size += weight[j] * (abs(nodes[j, 0]) + abs(nodes[j, 4]) + abs(nodes[j, 5]))
    return float((32 + K.shape[0] + K.shape[1]) * _ULP * size)


@compiled
def normal_of(rows: Array) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return J'J (00, 01, 02, 11, 12, 22) and J' middle."""
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(rows.shape[0]):
        middle, j0, j1, j2 = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3]
        a00 += j0 * j0
        a01 += j0 * j1
        a02 += j0 * j2
        a11 += j1 * j1
        a12 += j1 * j2
        a22 += j2 * j2
        b0 += j0 * middle
        b1 += j1 * middle
        b2 += j2 * middle
    return a00, a01, a02, a11, a12, a22, b0, b1, b2


@compiled
def within(s: float, half: float) -> float:
    """Return the number nearest to s between -half and half."""
    if s > half:
        return half
    return max(s, -half)


@inlined
def _nearest(half: Array, rows: Array) -> None:
    """Write the direction v = middle + J s with s nearly the least-squares solution inside the box."""
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = normal_of(rows)
    d0, d1 = 1.0 / a00 if a00 > 0.0 else 0.0, 1.0 / a11 if a11 > 0.0 else 0.0
    d2 = 1.0 / a22 if a22 > 0.0 else 0.0
    s0, s1, s2 = 0.0, 0.0, 0.0
    for _ in range(_SWEEPS):
        s0 = within(-(b0 + a01 * s1 + a02 * s2) * d0, half[0])
        s1 = within(-(b1 + a01 * s0 + a12 * s2) * d1, half[1])
        s2 = within(-(b2 + a02 * s0 + a12 * s1) * d2, half[2])
    for i in range(rows.shape[0]):
        rows[i, 4] = rows[i, 0] + rows[i, 1] * s0 + rows[i, 2] * s1 + rows[i, 3] * s2
