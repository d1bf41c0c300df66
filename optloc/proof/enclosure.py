"""Enclosures: a box around all points that cost less than a level, computed from the measurements alone.

The cost is |K phi - w|^2 with nodes phi_j, such as ranges and azimuths; rho is the root of the level. Each residual of
a point inside is bounded, so each node of the point is within an interval. Intervals of nodes give balls, ellipsoids,
bounds of squared rows and bounds of directions. The box is the intersection of all of them. It is in search coordinates
s around a fix, with corners `lower` and `upper` (3,), in standard deviations. Nodes are solved in groups with a
reference range r_p (`optloc.proof.groups`): a node is ``r_j = n_j r_p + z_j + e_j`` with measured z_j and error e_j.
"""

from __future__ import annotations

from math import inf, pi, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined, zero
from optloc.kernels.systems import inverse, invert
from optloc.proof.box import rounding_error
from optloc.proof.groups import LOOSE
from optloc.proof.nodes.dispatch import ball_of, has_ray, ray_of
from optloc.proof.nodes.node import FORCE, LINEAR, PHI, RANGE
from optloc.proof.search_space import Box, Cost, LocalAxes

# Balls and ellipsoids that contain all points at which one node is within an interval.


@compiled
def around_node(
    kind: int, data: Array, least: float, most: float, x: Array, back: Array, lower: Array, upper: Array
) -> None:
    """Contract a box of search coordinates to all points at which a node is between `least` and `most`.

    Parameters
    ----------
    kind, data : int, array (width,)
        The node: its code and its numbers.
    least, most : float
        The interval, in the node's unit.
    x, back : array (3,), (3, 3)
        Origin of the search coordinates, metres, and their derivative with respect to the position.
    lower, upper : array (3,)
        Corners of the box, contracted in place.
    """
    c0, c1, c2, radius = data[0], data[1], data[2], most
    if kind != RANGE:  # ranges skip the call, because they are the common case
        c0, c1, c2, radius = ball_of(kind, data, least, most)
        if radius == inf:  # no ball contains these points
            return
    radius = max(radius, 0.0) * (1.0 + _WIDER)
    c0, c1, c2 = c0 - x[0], c1 - x[1], c2 - x[2]
    for k in range(3):
        b0, b1, b2 = back[k, 0], back[k, 1], back[k, 2]
        centre = b0 * c0 + b1 * c1 + b2 * c2
        reach = radius * sqrt(b0 * b0 + b1 * b1 + b2 * b2) + _WIDER * abs(centre)
        lower[k], upper[k] = max(lower[k], centre - reach), min(upper[k], centre + reach)


@compiled
def around_foci(one: Array, other: Array, most: float, x: Array, back: Array, lower: Array, upper: Array) -> None:
    """Contract a box of search coordinates to all points whose distances from two foci sum to at most `most`.

    These points fill an ellipsoid of revolution. The sum of distances is 2a, and c is the vector from the centre to a
    focus. Along a row b of `back` the ellipsoid reaches ``sqrt((a^2 - |c|^2) |b|^2 + (b.c)^2)`` from its centre.

    Parameters
    ----------
    one, other : array (3,)
        The foci, metres.
    most : float
        The sum of distances, metres.
    x, back, lower, upper : arrays
        As in `around_node`.
    """
    half = np.empty((2, 3))
    middle, focus = half[0], half[1]
    size = 0.0
    for m in range(3):
        middle[m], focus[m] = 0.5 * (one[m] + other[m]) - x[m], 0.5 * (other[m] - one[m])
        size += focus[m] * focus[m]
    a, c = 0.5 * most * (1.0 + _WIDER), sqrt(size)
    across = max(a - c, 0.0) * (a + c)
    for k in range(3):
        length = along = centre = 0.0
        for m in range(3):
            length += back[k, m] * back[k, m]
            along += back[k, m] * focus[m]
            centre += back[k, m] * middle[m]
        reach = sqrt(across * length + along * along) * (1.0 + _WIDER) + _WIDER * abs(centre)
        lower[k], upper[k] = max(lower[k], centre - reach), min(upper[k], centre + reach)


# Squared rows of ranges are linear in the position and one more unknown, so they bound both.

# A left inverse is exact to this share. All bounds of an enclosure get this share as slack. It is small against the
# widths of an enclosure, which are standard deviations or more.
SLACK = 1e-6
# Least pivot of normal equations as a share of the diagonal; greatest error of a left inverse; and the share by which
# a ball and its centre are widened. A weak geometry gets no enclosure, rather than a wrong one.
_PIVOT, _INVERSE, _WIDER = 1e-9, 1e-7, 1e-9
# Unit in the last place of a double at 1.
_ULP = 2.0**-52
# Columns of a table of nodes: the error at the fix, and the greatest change of the node from there. The other columns
# are the squared row, zero for nodes without a squared row: coefficients of the error (3), coefficients of the
# position and one more unknown (4), weighted coefficients (4), the left inverse (4), and the weight in a sum of rows.
ERROR, SWING, FIRST, SECOND, THIRD, ROW, WEIGHTED, LEFT, WEIGHT, TIE_WIDTH = 0, 1, 2, 3, 4, 5, 9, 13, 17, 18


@inlined
def around_squares(
    kinds: Array,
    data: Array,
    A: Array,
    nodes: Array,
    sense: Array,
    rho: float,
    member: Array,
    reference: int,
    R: Array,
    tie: Array,
    ties: Array,
    lower: Array,
    upper: Array,
) -> None:
    """Contract the box of search coordinates by the squared rows of one group of nodes.

    Squaring ``r_j = n_j r_p + z_j + e_j`` with n_j = +-1 gives ``2 a_j.(x - s_p) + 2 z_j n_j r_p = const - phi_j`` with
    ``phi_j = e_j (2 z_j + 2 n_j r_p + e_j)``. Here s_p is the station of the reference, and a_j the station of node j
    from s_p. Without a reference range, the second unknown is |x - s_p|^2 and n_j = 0. Differences to the fix remove
    the constants. The last unknown is bounded first, because phi contains it.

    Parameters
    ----------
    kinds, data, A, nodes, sense : arrays (J,), (J, width), (J, J), (J, NODE_WIDTH), (3, 3)
        Nodes of the cost, ``A = K'K``, the table of nodes at the fix, and T with x = origin + T s.
    rho : float
        Longest residual of points inside the box.
    member, reference : int array, int
        Nodes of the group without the reference, and the reference; negative without a reference.
    R, tie : array (n, n), (J,)
        Covariance of the errors of the n nodes `member`, and the factors n_j of all nodes: -1, 0 or 1.
    ties : array (J, TIE_WIDTH)
        Table with the errors at the fix; the other columns are written.
    lower, upper : array (3,)
        Corners of the box, contracted in place; they stay if the rows give no bound.
    """
    count, ranges = _rows(kinds, data, nodes, sense, member, reference, tie, ties)
    for k in range(3):
        count += int(lower[k] == upper[k] == 0.0)  # a coordinate that does not exist needs no row
    if count < 3 + int(ranges) or not _left_inverse(A, member, ties, ranges, lower, upper):
        return
    near = nodes[reference, PHI] if reference >= 0 else 0.0
    middle, spread, last, more = near, 0.0, 0.0, 1.0
    if ranges:
        for j in member:
            ties[j, WEIGHT] = ties[j, LEFT + 3]
        own, beta, alpha, square = _sums(R, member, ties, near, 0.0)
        alpha, beta = rho * alpha, rho * beta + rho * rho * square
        last = abs(own) + beta  # greatest distance of the last unknown from its value at the fix
        if reference >= 0:
            if alpha >= 1.0:  # the errors can compensate any reference range
                return
            own, more = near + own, 1.0 / (1.0 - alpha)
            least, most = max(0.0, (own - beta) / (1.0 + alpha)), (own + beta) * more
            middle, spread = 0.5 * (least + most), 0.5 * (most - least) * (1.0 + SLACK)
            last = max(abs(least - near), abs(most - near))
    bound = np.empty((3, 4))  # of each coordinate: centre, reach, reach per change of the last unknown, greatest size
    for k in range(3):
        for j in member:
            ties[j, WEIGHT] = ties[j, LEFT + k]
        centre, linear, slope, square = _sums(R, member, ties, near, middle)
        reach = (rho * (linear + spread * slope) + rho * rho * square) * (1.0 + 0.5 * SLACK)
        bound[k, 0], bound[k, 1], bound[k, 2], bound[k, 3] = centre, reach, rho * slope, abs(centre) + reach
    if not _inverts_well(member, ties, bound, last, more):
        return
    for k in range(3):
        reach = bound[k, 1] * (1.0 + 0.5 * SLACK)
        lower[k], upper[k] = max(lower[k], bound[k, 0] - reach), min(upper[k], bound[k, 0] + reach)


@inlined
def _rows(
    kinds: Array, data: Array, nodes: Array, sense: Array, member: Array, reference: int, tie: Array, ties: Array
) -> tuple[int, bool]:
    """Write the coefficients of the squared rows of a group; return their number, and whether any is a range.

    Stations are counted from the station of the reference, or from the first station without a reference. An error e
    changes a row by ``e (first + second r_p + third e)``. For the arguments see `around_squares`; columns of `ties` are
    written.
    """
    origin, count, ranges = reference, 0, False
    for j in member:
        ties[j, FIRST:] = 0.0  # the coefficients of the row, too
        if kinds[j] == LINEAR:
            for k in range(3):
                ties[j, ROW + k] = data[j, 3] * sense[0, k] + data[j, 4] * sense[1, k] + data[j, 5] * sense[2, k]
            ties[j, FIRST], ties[j, WEIGHT] = -1.0, 1.0
        elif kinds[j] == RANGE and (reference < 0 or tie[j] != 0.0):
            origin = j if origin < 0 else origin
            apart, near = nodes[j, PHI] - ties[j, ERROR], nodes[j, PHI]
            if reference >= 0:
                apart -= tie[j] * nodes[reference, PHI]
            for k in range(3):
                for m in range(3):
                    ties[j, ROW + k] += 2.0 * (data[j, m] - data[origin, m]) * sense[m, k]
            ties[j, ROW + 3] = 2.0 * apart * tie[j] if reference >= 0 else -1.0
            ties[j, FIRST], ties[j, SECOND], ties[j, THIRD] = 2.0 * apart, 2.0 * tie[j], 1.0
            # Weight for the left inverse: the derivative of a range with respect to its square.
            ties[j, WEIGHT] = 0.5 / near if near > 0.0 else 1.0
            ranges = True
        else:
            continue
        count += 1
    return count, ranges


@inlined
def _left_inverse(A: Array, member: Array, ties: Array, ranges: bool, lower: Array, upper: Array) -> bool:
    """Write the left inverse of the rows that has the least errors at the fix; return False if it does not exist.

    `ranges` is the second result of `_rows`, and other arguments are as in `around_squares`. The columns WEIGHTED and
    LEFT of `ties` are written. Coordinates with lower = upper = 0 do not exist.
    """
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
    for k in range(3):
        if lower[k] == upper[k] == 0.0:
            normal[k, k] = 1.0
    if not ranges:
        normal[3, 3] = 1.0
    if not invert(normal, 4, _PIVOT):
        return False
    for j in member:
        t0, t1, t2, t3 = ties[j, WEIGHTED], ties[j, WEIGHTED + 1], ties[j, WEIGHTED + 2], ties[j, WEIGHTED + 3]
        for k in range(4):
            ties[j, LEFT + k] = normal[k, 0] * t0 + normal[k, 1] * t1 + normal[k, 2] * t2 + normal[k, 3] * t3
    return True


@inlined
def _inverts_well(member: Array, ties: Array, bound: Array, last: float, more: float) -> bool:
    """Return whether the error of the left inverse is negligible against the widths of an enclosure.

    Let E = (left inverse) (rows) - 1 in search coordinates and the last unknown. Differences y to the fix obey
    ``|y_k| <= b_k + sum_m |E_km y_m|``, where b_k are the bounds without E. At y = b these terms may be below a small
    share of the widths. Then no y exceeds the widths by more than this share.

    Parameters
    ----------
    member, ties : arrays
        As in `around_squares`.
    bound : array (3, 4)
        Of each coordinate: centre, reach, reach per change of the last unknown, and greatest size.
    last, more : float
        Greatest size of the last unknown, and the factor by which an addition to its bound grows.
    """
    off, size = np.zeros((4, 4)), np.zeros((4, 4))
    for j in member:
        if ties[j, ROW] == ties[j, ROW + 1] == ties[j, ROW + 2] == ties[j, ROW + 3] == 0.0:
            continue
        for k in range(4):
            for m in range(4):
                off[k, m] += ties[j, LEFT + k] * ties[j, ROW + m]
                size[k, m] += abs(ties[j, LEFT + k] * ties[j, ROW + m])
    wide, good = 0.0, True
    for k in range(3, -1, -1):  # the last unknown first, because the other bounds contain it
        extra = 0.0
        for m in range(4):
            most = bound[m, 3] if m < 3 else last
            own = most > 0.0 and size[k, k] > 0.0 and size[m, m] > 0.0
            lack = abs(off[k, m] - (k == m)) + (8 + member.shape[0]) * _ULP * size[k, m] if own else 0.0
            extra += lack * most
        if k == 3:
            wide = extra * more
            good = good and wide <= 0.25 * SLACK * last
        else:
            extra += bound[k, 2] * wide
            good = good and extra <= 0.25 * SLACK * bound[k, 1]
    return good


@inlined
def _sums(R: Array, member: Array, ties: Array, near: float, middle: float) -> tuple[float, float, float, float]:
    """Return the value of a weighted sum of squared rows at the fix, and three numbers that bound its errors.

    `member` are the nodes of the group. The weights are in column WEIGHT of `ties`, `near` is the reference range at
    the fix, and `middle` the middle of its interval. The second and third number are ``sqrt(m'R m)``, for weights times
    (first + middle second) and for weights times second. Times rho, they bound the linear part of the errors. The last
    number bounds the quadratic part, times rho squared: it is the sum of ``|weight| third R_ii``.
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


# A box around all points that several stations see in nearly the same directions as the fix.


@compiled
def around_rays(kinds: Array, data: Array, x: Array, back: Array, swing: Array, lower: Array, upper: Array) -> None:
    """Contract a box of search coordinates by angles that differ little from the angles of the fix.

    Let n be the horizontal unit vector across the direction from a station to the fix, and v the unit vector across
    both. A point y at distance r whose azimuth and elevation differ by at most a and e obeys ``|n.(y - x)| <= r sin a``
    and ``|v.(y - x)| <= r (sin e + 1 - cos a)``. The distance r is at most the distance of the fix plus ``|y - x|``. A
    left inverse of these rows bounds |y - x| first, then each coordinate.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes.
    x, back : array (3,), (3, 3)
        The fix, metres, and the derivative of the search coordinates with respect to the position.
    swing : array (J,)
        Greatest difference of each angle from its value at the fix, radians; infinite if unknown.
    lower, upper : array (3,)
        Corners of the box, contracted in place.
    """
    J = kinds.shape[0]
    rows, reach, far = np.empty((J, 3)), np.empty(J), np.empty(J)
    count = zero()
    for j in range(J):
        if has_ray(kinds[j]) and swing[j] < 0.5 * pi:
            wide, away = ray_of(kinds[j], kinds, data, swing, j, x, rows[count])
            if wide >= 0.0:
                reach[count], far[count] = wide, away
                count += 1
    gamma, off = np.empty((3, max(count, 1))), np.empty((3, 3))
    # Only along the axes that the search coordinates span: in other directions no position differs from the fix.
    axes, turned = np.zeros((3, 3)), np.zeros((3, 3))
    span = _span(back, axes, turned)
    for i in range(count):
        y0, y1, y2 = rows[i, 0], rows[i, 1], rows[i, 2]
        for k in range(3):
            rows[i, k] = y0 * axes[k, 0] + y1 * axes[k, 1] + y2 * axes[k, 2]
    if not _weighted_inverse(rows, reach, far, count, span, gamma, off):
        return
    steep, most = 0.0, 0.0
    for k in range(3):
        for m in range(3):
            steep += abs(off[k, m])
    for i in range(count):
        size = sqrt(gamma[0, i] ** 2 + gamma[1, i] ** 2 + gamma[2, i] ** 2) * reach[i]
        steep += size
        most += size * far[i]
    # The widths grow with y. If they grow faster than y, then y has no bound.
    if not steep < 1.0 - 1e-9:
        return
    most /= 1.0 - steep
    for k in range(3):
        wide = 0.0
        for m in range(3):  # the error of the left inverse, times y
            for c in range(3):
                wide += abs(turned[k, c]) * off[c, m] * most
        for i in range(count):
            pull = abs(turned[k, 0] * gamma[0, i] + turned[k, 1] * gamma[1, i] + turned[k, 2] * gamma[2, i])
            wide += pull * reach[i] * (far[i] + most)
        wide *= 1.0 + SLACK
        lower[k], upper[k] = max(lower[k], -wide), min(upper[k], wide)


@compiled
def _span(back: Array, axes: Array, turned: Array) -> int:
    """Write orthonormal axes (3, 3) of the rows of a matrix, and the matrix along them; return the number of axes.

    `back` (3, 3) is the matrix, and `turned` (3, 3) is ``back axes'``. Rows of zeros must come last.
    """
    count = 0
    for k in range(3):
        length = 0.0
        for m in range(3):
            axes[k, m] = back[k, m]
        for _ in range(2):  # twice is exact (Parlett 1980)
            for other in range(k):
                along = axes[k, 0] * axes[other, 0] + axes[k, 1] * axes[other, 1] + axes[k, 2] * axes[other, 2]
                for m in range(3):
                    axes[k, m] -= along * axes[other, m]
        length = sqrt(axes[k, 0] ** 2 + axes[k, 1] ** 2 + axes[k, 2] ** 2)
        count += int(length > 0.0)
        for m in range(3):
            axes[k, m] /= length if length > 0.0 else 1.0
    for k in range(3):
        for c in range(3):
            turned[k, c] = back[k, 0] * axes[c, 0] + back[k, 1] * axes[c, 1] + back[k, 2] * axes[c, 2]
    return count


@compiled
def _weighted_inverse(rows: Array, reach: Array, far: Array, count: int, span: int, gamma: Array, off: Array) -> bool:
    """Write the left inverse of rows weighted by their widths; return False if they do not determine a position.

    The first `count` of `rows` are unit vectors (3,) along `span` axes. The width of a row is reach times far: the
    share of the distance, times the distance of the fix, m. The left inverse is `gamma` (3, count). The bounds of its
    errors are written into `off` (3, 3), entry by entry.
    """
    solve, normal = np.empty((3, 3)), np.zeros((3, 3))
    for i in range(count):
        weight = 1.0 / (reach[i] * far[i]) ** 2 if reach[i] * far[i] > 0.0 else 0.0
        for k in range(3):
            for m in range(3):
                normal[k, m] += weight * rows[i, k] * rows[i, m]
    size = normal[0, 0] + normal[1, 1]
    for k in range(span, 3):
        normal[k, k] = 1.0
    if not size > 0.0 or not inverse(
        normal[0, 0], normal[0, 1], normal[0, 2], normal[1, 1], normal[1, 2], normal[2, 2], solve
    ):
        return False
    for i in range(count):
        weight = 1.0 / (reach[i] * far[i]) ** 2 if reach[i] * far[i] > 0.0 else 0.0
        for k in range(3):
            gamma[k, i] = weight * (solve[k, 0] * rows[i, 0] + solve[k, 1] * rows[i, 1] + solve[k, 2] * rows[i, 2])
    return _inverts(gamma, rows, count, span, off)


@compiled
def _inverts(gamma: Array, rows: Array, count: int, span: int, off: Array) -> bool:
    """Write bounds of the entries of |gamma rows - 1| into `off` (3, 3).

    Return whether all are as small as rounding. The arguments are as in `_weighted_inverse`.
    """
    off[:] = 0.0
    for k in range(span):
        for m in range(span):
            total = size = 0.0
            for i in range(count):
                total += gamma[k, i] * rows[i, m]
                size += abs(gamma[k, i] * rows[i, m])
            off[k, m] = abs(total - (k == m)) + (2 + count) * _ULP * (1.0 + size)
            if not off[k, m] < _INVERSE:
                return False
    return True


@compiled
def enclose(cost: Cost, chart: LocalAxes, box: Box, rho: float, lower: Array, upper: Array) -> bool:
    """Enclose all points with ``|K phi(x) - w| <= rho`` in a box of search coordinates around a fix.

    Within a group of nodes (`optloc.proof.groups.Groups`) errors obey ``|m.e| <= rho sqrt(m'R m)`` for each vector m.
    Squares of ranges and linear forms give equations that are linear in the position and one more unknown. Sums of two
    ranges give ellipsoids. Other nodes give balls.

    Parameters
    ----------
    cost, chart : Cost, LocalAxes
        The cost, and search coordinates around the fix.
    box : Box
        Tables of the fix. The function reads the values of the nodes and the forces ``K'(K phi - w)``.
    rho : float
        Square root of the level.
    lower, upper : array (3,)
        Written: corners in search coordinates, infinite for coordinates without a bound.

    Returns
    -------
    bool
        Whether the box is bounded.
    """
    kinds, data, A, groups, nodes, curves = cost.kinds, cost.data, cost.A, cost.groups, box.nodes, box.curves
    x, sense, back = chart.origin, chart.sense, chart.back
    # Rounding may have shortened the residuals, so the limit grows by as much.
    rho, first, rays = rho * (1.0 + SLACK) + SLACK + rounding_error(cost.K, cost.weight, chart.floor, nodes), 0, 0
    order, R, ties = groups.order, groups.R, np.empty((kinds.shape[0], TIE_WIDTH))
    for k in range(3):
        plane = sense[0, k] == 0.0 and sense[1, k] == 0.0 and sense[2, k] == 0.0
        lower[k], upper[k] = (0.0, 0.0) if plane else (-inf, inf)
    ties[:, SWING] = inf  # until a group gives a bound
    for number in range(kinds.shape[0]):
        count, reference = order[1, number], order[2, number]
        if count == 0:
            break
        size = count if reference < 0 else count - 1
        own, member = R[first : first + size, first : first + size], order[0, first : first + size]
        first += count
        if reference == LOOSE:  # its rows are too few to determine single nodes
            continue
        for i in range(size):
            j, error = member[i], 0.0
            for m in range(size):
                error += own[i, m] * curves[member[m], FORCE]
            ties[j, ERROR] = error
            if groups.tie[j] == 0.0:
                middle, reach = nodes[j, PHI] - error, rho * sqrt(own[i, i])
                ties[j, SWING] = abs(error) + reach
                rays += int(kinds[j] != RANGE and has_ray(kinds[j]))
                around_node(kinds[j], data[j], middle - reach, middle + reach, x, back, lower, upper)
            elif groups.tie[j] < 0.0:  # a sum of two ranges
                most = nodes[j, PHI] + nodes[reference, PHI] - error + rho * sqrt(own[i, i])
                around_foci(data[j, :3], data[reference, :3], most, x, back, lower, upper)
        around_squares(kinds, data, A, nodes, sense, rho, member, reference, own, groups.tie, ties, lower, upper)
    if rays:
        around_rays(kinds, data, x, back, ties[:, SWING].copy(), lower, upper)
    bounded = True
    for k in range(3):
        bounded = bounded and -inf < lower[k] <= upper[k] < inf
    return bounded
