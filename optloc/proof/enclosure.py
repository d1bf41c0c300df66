"""A box around all points that cost less than a level, from the measurements alone."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.balls import around_node
from optloc.proof.linear3 import invert
from optloc.proof.nodes import AZIMUTH, ELEVATION, RANGE
from optloc.proof.rays import around_rays
from optloc.proof.squares import SLACK, around_squares
from optloc.types import Array

# Nodes whose rows are tied to each other by less than this share count as independent.
_APART = 1e-13


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
    rho = rho * (1.0 + SLACK) + SLACK
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
        around_squares(kinds, data, A, phi, x, back, rho, member, count, reference, R, tie, error, lower, upper)
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
