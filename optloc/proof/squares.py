"""Squared rows of ranges: linear in the position and one more unknown, they bound both."""

from __future__ import annotations

from math import sqrt

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.linear3 import invert
from optloc.proof.nodes import LINEAR, RANGE
from optloc.types import Array

# A left inverse is exact to this share, and the slack of all bounds from an enclosure.
SLACK = 1e-6


@compiled
def around_squares(
    kinds: Array,
    data: Array,
    A: Array,
    phi: Array,
    x: Array,
    back: Array,
    rho: float,
    member: Array,
    count: int,
    reference: int,
    R: Array,
    tie: Array,
    error: Array,
    lower: Array,
    upper: Array,
) -> None:
    """Bound the search coordinates by the squared rows of a group.

    Squaring ``r_j = n_j r_p + z_j + e_j`` with n_j = +-1 leaves ``2 a_j.(x - s_p) + 2 z_j n_j r_p = const - phi_j``
    with ``phi_j = e_j (2 z_j + 2 n_j r_p + e_j)``; without a reference the second unknown is |x - s_p|^2 and n_j = 0.
    Differences to the fix bring the constants away. The last unknown is bounded first, because phi contains it.
    """
    size = count if reference < 0 else count - 1
    rows, G = np.empty(size, np.int64), np.empty((size, 4))
    first, second, third = np.empty(size), np.empty(size), np.empty(size)
    used, ranges = _rows(kinds, data, phi, member, size, reference, tie, error, rows, G, first, second, third)
    gamma = np.empty((4, used))
    if not _left_inverse(A, phi, kinds, member, rows, used, G, ranges, lower[2] == upper[2] == 0.0, gamma):
        return
    near = phi[reference] if reference >= 0 else 0.0
    middle, spread = near, 0.0
    if reference >= 0:
        alpha = rho * _length(R, rows, used, gamma[3], second, 0.0, second)
        if alpha >= 1.0:
            return
        beta = rho * _length(R, rows, used, gamma[3], first, 0.0, second) + _quadratic(
            R, rows, used, gamma[3], rho, third
        )
        own = near + _at_fix(rows, used, gamma[3], error, first, second, third, near)
        least, most = max(0.0, (own - beta) / (1.0 + alpha)), (own + beta) / (1.0 - alpha)
        middle, spread = 0.5 * (least + most), 0.5 * (most - least) * (1.0 + SLACK)
    weights = np.empty(used)
    for k in range(3):
        for i in range(used):
            weights[i] = back[k, 0] * gamma[0, i] + back[k, 1] * gamma[1, i] + back[k, 2] * gamma[2, i]
        centre = _at_fix(rows, used, weights, error, first, second, third, near)
        reach = rho * _length(R, rows, used, weights, first, middle, second)
        reach += rho * spread * _length(R, rows, used, weights, second, 0.0, second)
        reach = (reach + _quadratic(R, rows, used, weights, rho, third)) * (1.0 + SLACK)
        lower[k], upper[k] = max(lower[k], centre - reach), min(upper[k], centre + reach)


@compiled
def _rows(
    kinds: Array,
    data: Array,
    phi: Array,
    member: Array,
    size: int,
    reference: int,
    tie: Array,
    error: Array,
    rows: Array,
    G: Array,
    first: Array,
    second: Array,
    third: Array,
) -> tuple[int, bool]:
    """Write the squared rows: the places of their nodes in the group, their coefficients, and those of their errors.

    An error e changes a row by ``e (first + second r_p + third e)``. Returned: how many rows there are, and whether any
    is a range.
    """
    origin, used, ranges = reference, 0, False
    for i in range(size):
        j = member[i]
        if kinds[j] == LINEAR:
            for k in range(3):
                G[used, k] = data[j, 3 + k]
            G[used, 3], first[used], second[used], third[used] = 0.0, -1.0, 0.0, 0.0
        elif kinds[j] == RANGE and (reference < 0 or tie[i] != 0.0):
            origin = j if origin < 0 else origin
            common = tie[i] * phi[reference] if reference >= 0 else 0.0
            apart = phi[j] - common - error[i]
            for k in range(3):
                G[used, k] = 2.0 * (data[j, k] - data[origin, k])
            G[used, 3] = 2.0 * apart * tie[i] if reference >= 0 else -1.0
            first[used], second[used], third[used] = 2.0 * apart, 2.0 * tie[i], 1.0
            ranges = True
        else:
            continue
        rows[used] = i
        used += 1
    return used, ranges


@compiled
def _left_inverse(
    A: Array,
    phi: Array,
    kinds: Array,
    member: Array,
    rows: Array,
    used: int,
    G: Array,
    ranges: bool,
    plane: bool,
    gamma: Array,
) -> bool:
    """Write the left inverse of G (used, 4) that is best for the errors at the fix; False where there is none."""
    weighted, normal = np.zeros((used, 4)), np.zeros((4, 4))
    for i in range(used):
        j = member[rows[i]]
        for m in range(used):
            n = member[rows[m]]
            weight = A[j, n]
            if kinds[j] == RANGE:
                weight /= 2.0 * phi[j] if phi[j] > 0.0 else 1.0
            if kinds[n] == RANGE:
                weight /= 2.0 * phi[n] if phi[n] > 0.0 else 1.0
            for k in range(4):
                weighted[i, k] += weight * G[m, k]
        for k in range(4):
            for m in range(4):
                normal[k, m] += weighted[i, k] * G[i, m]
    if plane:
        normal[2, 2] = 1.0
    if not ranges:
        normal[3, 3] = 1.0
    if used < 3 - int(plane) + int(ranges) or not invert(normal, 4, 1e-9):
        return False
    for k in range(4):
        for i in range(used):
            gamma[k, i] = 0.0
            for m in range(4):
                gamma[k, i] += normal[k, m] * weighted[i, m]
    return True


@compiled
def _length(R: Array, rows: Array, used: int, gamma: Array, first: Array, factor: float, second: Array) -> float:
    """Return ``sqrt(m'R m)`` for m = gamma o (first + factor second)."""
    total = 0.0
    for i in range(used):
        own = gamma[i] * (first[i] + factor * second[i])
        for j in range(used):
            total += own * R[rows[i], rows[j]] * gamma[j] * (first[j] + factor * second[j])
    return sqrt(max(total, 0.0))


@compiled
def _quadratic(R: Array, rows: Array, used: int, gamma: Array, rho: float, third: Array) -> float:
    """Return a bound of sum_i gamma_i third_i e_i^2."""
    total = 0.0
    for i in range(used):
        total += abs(gamma[i]) * third[i] * R[rows[i], rows[i]]
    return rho * rho * total


@compiled
def _at_fix(
    rows: Array, used: int, gamma: Array, error: Array, first: Array, second: Array, third: Array, near: float
) -> float:
    """Return gamma.phi at the fix."""
    total = 0.0
    for i in range(used):
        e = error[rows[i]]
        total += gamma[i] * e * (first[i] + second[i] * near + third[i] * e)
    return total
