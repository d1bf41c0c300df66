"""A box around all points that cost less than a level, from the measurements alone."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.balls import around_node
from optloc.proof.linear3 import invert
from optloc.proof.nodes import AZIMUTH, ELEVATION, LINEAR, RANGE
from optloc.proof.rays import around_rays
from optloc.types import Array

# Nodes whose rows are tied to each other by less than this share count as independent.
_APART = 1e-13
# A left inverse is exact to this share, and the slack of all bounds here.
_SLACK = 1e-6


@compiled
def enclose(
    kinds: Array,
    data: Array,
    A: Array,
    force: Array,
    phi: Array,
    x: Array,
    sense: Array,
    back: Array,
    rho: float,
    lower: Array,
    upper: Array,
) -> bool:
    """Enclose all points with ``|K phi(x) - w| <= rho`` in a box of search coordinates around a fix.

    Nodes tied by correlated rows form a group. Within one the rows say ``phi_j = n_j r_p + z_j + e_j`` for a reference
    range r_p (n = 0 where no common offset is unknown), and ``|m.e| <= rho sqrt(m'R m)`` for every m. Ranges and linear
    forms are squared to equations linear in position and one more unknown; other nodes give balls of their own.

    Parameters
    ----------
    kinds, data : array (J,), (J, WIDTH)
        The nodes.
    A : array (J, J)
        ``K'K``.
    force : array (J,)
        ``K'(K phi - w)`` at the fix.
    phi : array (J,)
        Nodes at the fix.
    x : array (3,)
        The fix.
    sense, back : array (3, 3)
        T with x + T s, and its inverse.
    rho : float
        Square root of the level.
    lower, upper : array (3,)
        Written: corners in search coordinates, infinite where there is no bound.

    Returns
    -------
    bool
        Whether the box is bounded.
    """
    J = kinds.shape[0]
    rho = rho * (1.0 + _SLACK) + _SLACK
    label, member, tie, error = np.zeros(J, np.int64), np.empty(J, np.int64), np.empty(J), np.empty(J)
    R, swing, angles = np.empty((J, J)), np.full(J, inf), 0
    for k in range(3):
        plane = sense[0, k] == 0.0 and sense[1, k] == 0.0 and sense[2, k] == 0.0
        lower[k], upper[k] = (0.0, 0.0) if plane else (-inf, inf)
    for first in range(J):
        if label[first]:
            continue
        count = _group(A, first, label, member)
        reference = _solve_group(kinds, A, force, member, count, R, tie, error)
        if reference == -2:
            continue
        for i in range(count):
            if tie[i] == 0.0 and reference != member[i]:
                j = member[i]
                middle, reach = phi[j] - error[i], rho * sqrt(R[i, i])
                swing[j] = abs(error[i]) + reach
                angles += kinds[j] in (AZIMUTH, ELEVATION)
                around_node(kinds[j], data[j], middle - reach, middle + reach, x, back, lower, upper)
        _squared(kinds, data, A, phi, x, back, rho, member, count, reference, R, tie, error, lower, upper)
    if angles:
        around_rays(kinds, data, x, back, swing, lower, upper)
    return bool((lower > -inf).all() and (lower <= upper).all() and (upper < inf).all())


@compiled
def _group(A: Array, first: int, label: Array, member: Array) -> int:
    """Collect the nodes that are tied to the first by correlated rows; return how many there are."""
    member[0], count, seen = first, 1, 0
    label[first] = 1
    while seen < count:
        j = member[seen]
        seen += 1
        for m in range(A.shape[0]):
            if label[m] == 0 and abs(A[j, m]) > _APART * sqrt(A[j, j] * A[m, m]):
                label[m] = 1
                member[count] = m
                count += 1
    return count


@compiled
def _solve_group(
    kinds: Array, A: Array, force: Array, member: Array, count: int, R: Array, tie: Array, error: Array
) -> int:
    """Solve the rows of a group for its nodes.

    Returns the reference range, which is moved to the end of the members, -1 if none is needed, or -2 if rows are too
    few. R (count or count - 1) is the covariance of the errors, `tie` the factors n_j, `error` the errors at the fix.
    """
    for reference in range(-1, count):
        size = count
        if reference >= 0:
            if kinds[member[reference]] != RANGE:
                continue
            size = count - 1
            member[reference], member[size] = member[size], member[reference]
        for i in range(size):
            for j in range(size):
                R[i, j] = A[member[i], member[j]]
        if size and invert(R, size, 1e-9) and _ties(kinds, A, force, member, size, reference >= 0, R, tie, error):
            tie[size:count] = 0.0
            return -1 if reference < 0 else member[size]
        if reference >= 0:
            break
    return -2


@compiled
def _ties(
    kinds: Array, A: Array, force: Array, member: Array, size: int, common: bool, R: Array, tie: Array, error: Array
) -> bool:
    """Write how nodes follow the reference range, -1, 0 or 1, and their errors; False where they do otherwise."""
    for i in range(size):
        tie[i], error[i] = 0.0, 0.0
        for j in range(size):
            error[i] += R[i, j] * force[member[j]]
            if common:
                tie[i] -= R[i, j] * A[member[j], member[size]]
        nearest = float(round(tie[i]))
        if abs(tie[i] - nearest) > 1e-9 or abs(nearest) > 1.0 or (nearest != 0.0 and kinds[member[i]] != RANGE):
            return False
        tie[i] = nearest
    return True


@compiled
def _squared(
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
    origin, used, ranges = reference, 0, 0
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
            ranges += 1
        else:
            continue
        rows[used] = i
        used += 1
    gamma = np.empty((4, used))
    if not _left_inverse(A, phi, kinds, member, rows, used, G, ranges > 0, lower[2] == upper[2] == 0.0, gamma):
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
        middle, spread = 0.5 * (least + most), 0.5 * (most - least) * (1.0 + _SLACK)
    weights = np.empty(used)
    for k in range(3):
        for i in range(used):
            weights[i] = back[k, 0] * gamma[0, i] + back[k, 1] * gamma[1, i] + back[k, 2] * gamma[2, i]
        centre = _at_fix(rows, used, weights, error, first, second, third, near)
        reach = rho * _length(R, rows, used, weights, first, middle, second)
        reach += rho * spread * _length(R, rows, used, weights, second, 0.0, second)
        reach = (reach + _quadratic(R, rows, used, weights, rho, third)) * (1.0 + _SLACK)
        lower[k], upper[k] = max(lower[k], centre - reach), min(upper[k], centre + reach)


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
