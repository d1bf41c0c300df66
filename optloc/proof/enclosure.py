"""A box around all points that cost less than a level, from the measurements alone."""

from __future__ import annotations

from math import cos, hypot, inf, pi, sin, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, inlined, zero
from optloc.models.primitives import WGS84_A
from optloc.proof.convex import FORCE
from optloc.proof.groups import LOOSE, Groups
from optloc.proof.nodes.codes import AZIMUTH, ELEVATION, HEIGHT, LINEAR, RANGE, RATIO
from optloc.proof.nodes.linear3 import inverse, invert

# Balls that hold all points at which one node lies in an interval.


@compiled
def around_node(
    kind: int, data: Array, least: float, most: float, x: Array, back: Array, lower: Array, upper: Array
) -> None:
    """Clip a box of search coordinates by all points at which a node lies between `least` and `most`.

    A range gives a ball around its station. Points with ``r_a <= q r_b``, q < 1, fill the ball of Apollonius. A
    geodetic height is at least the distance from the Earth's centre less the equatorial radius. Angles bound nothing.

    Parameters
    ----------
    kind, data : int, array (width,)
        The node.
    least, most : float
        Its interval.
    x, back : array (3,), (3, 3)
        Origin of the search coordinates, and their derivative with respect to the position.
    lower, upper : array (3,)
        Corners of the box, clipped in place.
    """
    c0, c1, c2, radius = data[0], data[1], data[2], most
    if kind == RATIO:
        q = most if most < 1.0 else (1.0 / least if least > 1.0 else 1.0)
        if not q * q < 1.0 - 1e-9:
            return
        near, far = (0, 3) if most < 1.0 else (3, 0)
        q = max(q, 0.0)
        scale = 1.0 / (1.0 - q * q)
        c0 = (data[near] - q * q * data[far]) * scale
        c1 = (data[near + 1] - q * q * data[far + 1]) * scale
        c2 = (data[near + 2] - q * q * data[far + 2]) * scale
        p0, p1, p2 = data[0] - data[3], data[1] - data[4], data[2] - data[5]
        radius = q * sqrt(p0 * p0 + p1 * p1 + p2 * p2) * scale
    elif kind == HEIGHT:
        c0 -= data[6] * data[3] + data[9] * data[4] + data[12] * data[5]
        c1 -= data[7] * data[3] + data[10] * data[4] + data[13] * data[5]
        c2 -= data[8] * data[3] + data[11] * data[4] + data[14] * data[5]
        radius = WGS84_A + most
    elif kind != RANGE:
        return
    radius = max(radius, 0.0) * (1.0 + 1e-9)
    c0, c1, c2 = c0 - x[0], c1 - x[1], c2 - x[2]
    for k in range(3):
        b0, b1, b2 = back[k, 0], back[k, 1], back[k, 2]
        centre = b0 * c0 + b1 * c1 + b2 * c2
        reach = radius * sqrt(b0 * b0 + b1 * b1 + b2 * b2) + 1e-9 * abs(centre)
        lower[k], upper[k] = max(lower[k], centre - reach), min(upper[k], centre + reach)


# Squared rows of ranges: linear in the position and one more unknown, they bound both.

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


# A box around all points that several stations see in directions close to those of the fix.


@compiled
def around_rays(kinds: Array, data: Array, x: Array, back: Array, swing: Array, lower: Array, upper: Array) -> None:
    """Clip a box of search coordinates by angles that differ little from those at the fix.

    With n the horizontal and v the other unit vector across the direction from a station to the fix, a point at
    distance r whose azimuth and elevation differ by at most a and e obeys ``|n.(x - x^)| <= r sin a`` and
    ``|v.(x - x^)| <= r (sin e + 1 - cos a)``. With r at most the fix's distance plus ``y = |x - x^|`` and a left
    inverse of these rows, y is bounded first, then each coordinate.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes.
    x, back : array (3,), (3, 3)
        The fix, and the derivative of the search coordinates with respect to the position.
    swing : array (J,)
        How far each angle may be from its value at the fix, radians; infinite where it is not known.
    lower, upper : array (3,)
        Corners of the box, clipped in place.
    """
    J = kinds.shape[0]
    rows, reach, far = np.empty((J, 3)), np.empty(J), np.empty(J)
    count = zero()
    for j in range(J):
        if kinds[j] == AZIMUTH and swing[j] < 0.5 * pi:
            count = _add_azimuth(data[j], x, sin(swing[j]), rows, reach, far, count)
        elif kinds[j] == ELEVATION and swing[j] < 0.5 * pi:
            turn = _azimuth_beside(kinds, data, swing, j)
            if turn < 0.5 * pi:
                count = _add_elevation(data[j], x, sin(swing[j]) + 1.0 - cos(turn), rows, reach, far, count)
    gamma = np.empty((3, max(count, 1)))
    if not _weighted_inverse(rows, reach, far, count, back, gamma):
        return
    steep, most = 0.0, 0.0
    for i in range(count):
        size = sqrt(gamma[0, i] ** 2 + gamma[1, i] ** 2 + gamma[2, i] ** 2) * reach[i]
        steep += size
        most += size * far[i]
    if not steep < 1.0 - 1e-9:
        return
    most /= 1.0 - steep
    for k in range(3):
        wide = 0.0
        for i in range(count):
            pull = abs(back[k, 0] * gamma[0, i] + back[k, 1] * gamma[1, i] + back[k, 2] * gamma[2, i])
            wide += pull * reach[i] * (far[i] + most)
        wide *= 1.0 + 1e-6
        lower[k], upper[k] = max(lower[k], -wide), min(upper[k], wide)


@compiled
def _azimuth_beside(kinds: Array, data: Array, swing: Array, j: int) -> float:
    """Return how far the azimuth may swing that the station of elevation j measures, pi if there is none."""
    least = pi
    for m in range(kinds.shape[0]):
        if kinds[m] == AZIMUTH:
            same = True
            for k in range(15):
                same = same and data[m, k] == data[j, k]
            if same:
                least = min(least, swing[m])
    return least


@compiled
def _local(data: Array, x: Array) -> tuple[float, float, float]:
    """Return the line from station to fix in the station's axes."""
    a, b, c = x[0] - data[0], x[1] - data[1], x[2] - data[2]
    return (
        data[6] * a + data[7] * b + data[8] * c,
        data[9] * a + data[10] * b + data[11] * c,
        data[12] * a + data[13] * b + data[14] * c,
    )


@compiled
def _add_azimuth(data: Array, x: Array, width: float, rows: Array, reach: Array, far: Array, count: int) -> int:
    p, q, r = _local(data, x)
    flat = hypot(p, q)
    if flat > 0.0:
        for k in range(3):
            rows[count, k] = (p * data[9 + k] - q * data[6 + k]) / flat
        reach[count], far[count] = width, hypot(flat, r)
        count += 1
    return count


@compiled
def _add_elevation(data: Array, x: Array, width: float, rows: Array, reach: Array, far: Array, count: int) -> int:
    p, q, r = _local(data, x)
    flat = hypot(p, q)
    whole = hypot(flat, r)
    if flat > 0.0:
        for k in range(3):
            outward = (p * data[6 + k] + q * data[9 + k]) / flat
            rows[count, k] = (flat * data[12 + k] - r * outward) / whole
        reach[count], far[count] = width, whole
        count += 1
    return count


@compiled
def _weighted_inverse(rows: Array, reach: Array, far: Array, count: int, back: Array, gamma: Array) -> bool:
    """Write the left inverse of rows weighted by their widths; False where they do not determine a position."""
    solve, normal = np.empty((3, 3)), np.zeros((3, 3))
    for i in range(count):
        weight = 1.0 / (reach[i] * far[i]) ** 2 if reach[i] * far[i] > 0.0 else 0.0
        for k in range(3):
            for m in range(3):
                normal[k, m] += weight * rows[i, k] * rows[i, m]
    plane = back[2, 0] == 0.0 and back[2, 1] == 0.0 and back[2, 2] == 0.0
    if plane:
        normal[2, 2] = 1.0
    size = normal[0, 0] + normal[1, 1]
    if not size > 0.0 or not inverse(
        normal[0, 0], normal[0, 1], normal[0, 2], normal[1, 1], normal[1, 2], normal[2, 2], solve
    ):
        return False
    for i in range(count):
        weight = 1.0 / (reach[i] * far[i]) ** 2 if reach[i] * far[i] > 0.0 else 0.0
        for k in range(3):
            gamma[k, i] = weight * (solve[k, 0] * rows[i, 0] + solve[k, 1] * rows[i, 1] + solve[k, 2] * rows[i, 2])
    return _inverts(gamma, rows, count, plane)


@compiled
def _inverts(gamma: Array, rows: Array, count: int, plane: bool) -> bool:
    """Return whether gamma times rows is the identity up to a small rounding."""
    for k in range(2 if plane else 3):
        for m in range(3):
            total = 0.0
            for i in range(count):
                total += gamma[k, i] * rows[i, m]
            if not abs(total - (k == m)) < 1e-7:
                return False
    return True


@compiled
def enclose(
    kinds: Array,
    data: Array,
    A: Array,
    groups: Groups,
    nodes: Array,
    curves: Array,
    x: Array,
    sense: Array,
    back: Array,
    rho: float,
    lower: Array,
    upper: Array,
) -> bool:
    """Enclose all points with ``|K phi(x) - w| <= rho`` in a box of search coordinates around a fix.

    Within a group of nodes (`optloc.proof.groups`) the errors obey ``|m.e| <= rho sqrt(m'R m)`` for every m. Ranges and
    linear forms are squared to equations linear in position and one more unknown; other nodes give balls of their own.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes.
    A : array (J, J)
        ``K'K``.
    groups : Groups
        The nodes in groups.
    nodes, curves : array (J, NODE_WIDTH), (J, CURVE_WIDTH)
        Tables of the fix, of which the values of the nodes and the forces ``K'(K phi - w)`` are read.
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
    rho, first, angles = rho * (1.0 + SLACK) + SLACK, 0, 0
    order, R, ties = groups.order, groups.R, np.empty((kinds.shape[0], TIE_WIDTH))
    for k in range(3):
        plane = sense[0, k] == 0.0 and sense[1, k] == 0.0 and sense[2, k] == 0.0
        lower[k], upper[k] = (0.0, 0.0) if plane else (-inf, inf)
    ties[:, SWING] = inf
    for number in range(kinds.shape[0]):
        count, reference = order[1, number], order[2, number]
        if count == 0:
            break
        size = count if reference < 0 else count - 1
        own, member = R[first : first + size, first : first + size], order[0, first : first + size]
        first += count
        if reference == LOOSE:
            continue
        for i in range(size):
            j, error = member[i], 0.0
            for m in range(size):
                error += own[i, m] * curves[member[m], FORCE]
            ties[j, ERROR] = error
            if groups.tie[j] == 0.0:
                middle, reach = nodes[j, 0] - error, rho * sqrt(own[i, i])
                ties[j, SWING] = abs(error) + reach
                angles += kinds[j] in (AZIMUTH, ELEVATION)
                around_node(kinds[j], data[j], middle - reach, middle + reach, x, back, lower, upper)
        around_squares(kinds, data, A, nodes, back, rho, member, reference, own, groups.tie, ties, lower, upper)
    if angles:
        around_rays(kinds, data, x, back, ties[:, SWING].copy(), lower, upper)
    bounded = True
    for k in range(3):
        bounded = bounded and -inf < lower[k] <= upper[k] < inf
    return bounded
