"""Squared rows of ranges: linear in the position and one more unknown, they bound both."""

from __future__ import annotations

from math import sqrt

import numpy as np

from optloc.kernels.jit import inlined
from optloc.proof.linear3 import invert
from optloc.proof.nodes import LINEAR, RANGE
from optloc.types import Array

# A left inverse is exact to this share, and the slack of all bounds from an enclosure.
SLACK = 1e-6
# Columns of a table of nodes: error at the fix, and how far from there the node may be; of its squared row, zero where
# it has none: coefficients of the error (3), of the position and one more unknown (4), the same weighted (4), the left
# inverse of all (4), and the weight in a sum of rows.
ERROR, SWING, FIRST, SECOND, THIRD, ROW, WEIGHTED, LEFT, WEIGHT, TIE_WIDTH = 0, 1, 2, 3, 4, 5, 9, 13, 17, 18


@inlined
def around_squares(
    kinds: Array,
    data: Array,
    A: Array,
    nodes: Array,
    back: Array,
    rho: float,
    member: Array,
    reference: int,
    R: Array,
    tie: Array,
    ties: Array,
    lower: Array,
    upper: Array,
) -> None:
    """Bound the search coordinates by the squared rows of a group.

    Squaring ``r_j = n_j r_p + z_j + e_j`` with n_j = +-1 leaves ``2 a_j.(x - s_p) + 2 z_j n_j r_p = const - phi_j``
    with ``phi_j = e_j (2 z_j + 2 n_j r_p + e_j)``; without a reference the second unknown is |x - s_p|^2 and n_j = 0.
    Differences to the fix bring the constants away. The last unknown is bounded first, because phi contains it.
    """
    count, ranges = _rows(kinds, data, nodes, member, reference, tie, ties)
    plane = lower[2] == upper[2] == 0.0
    if count < 3 - int(plane) + int(ranges) or not _left_inverse(A, nodes, kinds, member, ties, ranges, plane):
        return
    near = nodes[reference, 0] if reference >= 0 else 0.0
    middle, spread = near, 0.0
    if reference >= 0:
        for j in member:
            ties[j, WEIGHT] = ties[j, LEFT + 3]
        own, beta, alpha, square = _sums(R, member, ties, near, 0.0)
        alpha, beta, own = rho * alpha, rho * beta + rho * rho * square, near + own
        if alpha >= 1.0:
            return
        least, most = max(0.0, (own - beta) / (1.0 + alpha)), (own + beta) / (1.0 - alpha)
        middle, spread = 0.5 * (least + most), 0.5 * (most - least) * (1.0 + SLACK)
    for k in range(3):
        for j in member:
            weight = back[k, 0] * ties[j, LEFT] + back[k, 1] * ties[j, LEFT + 1]
            ties[j, WEIGHT] = weight + back[k, 2] * ties[j, LEFT + 2]
        centre, linear, slope, square = _sums(R, member, ties, near, middle)
        reach = (rho * (linear + spread * slope) + rho * rho * square) * (1.0 + SLACK)
        lower[k], upper[k] = max(lower[k], centre - reach), min(upper[k], centre + reach)


@inlined
def _rows(
    kinds: Array, data: Array, nodes: Array, member: Array, reference: int, tie: Array, ties: Array
) -> tuple[int, bool]:
    """Write the squared rows: their coefficients, and those of their errors.

    An error e changes a row by ``e (first + second r_p + third e)``. Returned: how many rows there are, and whether any
    is a range.
    """
    origin, count, ranges = reference, 0, False
    for j in member:
        ties[j, FIRST:] = 0.0
        if kinds[j] == LINEAR:
            for k in range(3):
                ties[j, ROW + k] = data[j, 3 + k]
            ties[j, FIRST], ties[j, WEIGHT] = -1.0, 1.0
        elif kinds[j] == RANGE and (reference < 0 or tie[j] != 0.0):
            origin = j if origin < 0 else origin
            apart, near = nodes[j, 0] - ties[j, ERROR], nodes[j, 0]
            if reference >= 0:
                apart -= tie[j] * nodes[reference, 0]
            for k in range(3):
                ties[j, ROW + k] = 2.0 * (data[j, k] - data[origin, k])
            ties[j, ROW + 3] = 2.0 * apart * tie[j] if reference >= 0 else -1.0
            ties[j, FIRST], ties[j, SECOND], ties[j, THIRD] = 2.0 * apart, 2.0 * tie[j], 1.0
            # For the left inverse: what a squared row is worth beside its range.
            ties[j, WEIGHT] = 0.5 / near if near > 0.0 else 1.0
            ranges = True
        else:
            continue
        count += 1
    return count, ranges


@inlined
def _left_inverse(A: Array, nodes: Array, kinds: Array, member: Array, ties: Array, ranges: bool, plane: bool) -> bool:
    """Write the left inverse of the rows that is best for the errors at the fix; False where there is none."""
    normal = np.zeros((4, 4))
    for j in member:
        t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
        for m in member:
            weight = A[j, m] * ties[j, WEIGHT] * ties[m, WEIGHT]
            t0 += weight * ties[m, ROW]
            t1 += weight * ties[m, ROW + 1]
            t2 += weight * ties[m, ROW + 2]
            t3 += weight * ties[m, ROW + 3]
        ties[j, WEIGHTED], ties[j, WEIGHTED + 1], ties[j, WEIGHTED + 2], ties[j, WEIGHTED + 3] = t0, t1, t2, t3
        for k in range(4):
            for m in range(k + 1):
                normal[k, m] += ties[j, WEIGHTED + k] * ties[j, ROW + m]
    if plane:
        normal[2, 2] = 1.0
    if not ranges:
        normal[3, 3] = 1.0
    if not invert(normal, 4, 1e-9):
        return False
    for j in member:
        t0, t1, t2, t3 = ties[j, WEIGHTED], ties[j, WEIGHTED + 1], ties[j, WEIGHTED + 2], ties[j, WEIGHTED + 3]
        for k in range(4):
            ties[j, LEFT + k] = normal[k, 0] * t0 + normal[k, 1] * t1 + normal[k, 2] * t2 + normal[k, 3] * t3
    return True


@inlined
def _sums(R: Array, member: Array, ties: Array, near: float, middle: float) -> tuple[float, float, float, float]:
    """Return what the errors make of a weighted sum of squared rows.

    First its value at the fix. Then ``sqrt(m'R m)`` for weights times (first + middle second), and for weights times
    second: rho times them bounds the part of the errors that is linear. Last the sum of ``|weight| third R_ii``: rho
    squared times that bounds the part that is quadratic.
    """
    value = linear = slope = square = 0.0
    for i in range(member.shape[0]):
        j = member[i]
        weight, e, first, second, third = (
            ties[j, WEIGHT],
            ties[j, ERROR],
            ties[j, FIRST],
            ties[j, SECOND],
            ties[j, THIRD],
        )
        value += weight * e * (first + second * near + third * e)
        square += abs(weight) * third * R[i, i]
        along, across = 0.0, 0.0
        for m in range(member.shape[0]):
            other = member[m]
            tied = R[i, m] * ties[other, WEIGHT]
            along += tied * (ties[other, FIRST] + middle * ties[other, SECOND])
            across += tied * ties[other, SECOND]
        linear += weight * (first + middle * second) * along
        slope += weight * second * across
    return value, sqrt(max(linear, 0.0)), sqrt(max(slope, 0.0)), square
