"""Ranges over a box: all ranges of a problem at once; and ranges minus the distance to the centre of an atlas.

Most rows are sums of ranges, so these loops are written out: values that all ranges share are computed once for a box.
Around a fix, the position is x = c + T s with s in the box. In an atlas, the position is ``m + R p / v`` with the
centre m and half-width R of the cube, and a station is at ``m + R a`` (`optloc.proof.atlas`).
"""

from __future__ import annotations

from math import inf, sqrt

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined
from optloc.proof.atlas import AtlasFrame, scaled_station, set_line
from optloc.proof.nodes.node import (
    CHI,
    CONVEX,
    DIFFERENCE,
    FORM,
    H00,
    H01,
    H02,
    H11,
    H12,
    H22,
    HIGH,
    LOW,
    PHI,
    RANGE,
    SLOPE0,
    SLOPE1,
    SLOPE2,
    TURN0,
    TURN1,
    TURN2,
    Node,
    NodeRow,
    RangeForm,
    Symmetric,
    Triple,
    add_symmetric,
    largest_quadratic,
    range_form,
    range_hessian,
    reach,
    sum_of_forms,
    triple_at,
)
from optloc.proof.nodes.ratio import quotient_hessian, quotient_remainder

# Second derivatives of a range over a box, see `range_hessian`.
RangeBend = tuple[Symmetric, Triple, float, float]


@compiled
def bound_ranges(kinds: Array, data: Array, centre: Array, sense: Array, gram: Array, half: Array, nodes: Array) -> int:
    """Bound all ranges over a box; return the number of other nodes.

    Let v be the line from the station to the centre of the box, r its length, u its direction, and d = T s. With
    a = r + u.d and b = |d - u u.d|, the remainder is ``sqrt(a^2 + b^2) - a``. It decreases with a (of either sign) and
    increases with b. So it is at most its value at the least a and the greatest b.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes: their codes and their numbers.
    centre, half : array (3,)
        Centre of the box, metres, and half-widths in search coordinates.
    sense, gram : array (3, 3)
        T with x = c + T s, and ``T'T``.
    nodes : array (J, NODE_WIDTH)
        Rows of ranges are written.
    """
    others = 0
    # Local variables: an array entry would be loaded again after each entry that is written.
    c0, c1, c2, h0, h1, h2 = centre[0], centre[1], centre[2], half[0], half[1], half[2]
    t00, t01, t02 = sense[0, 0], sense[0, 1], sense[0, 2]
    t10, t11, t12 = sense[1, 0], sense[1, 1], sense[1, 2]
    t20, t21, t22 = sense[2, 0], sense[2, 1], sense[2, 2]
    # Entries of T'T times half-widths: the part of the quadratic form that does not depend on the direction.
    m00, m01, m02 = gram[0, 0] * h0 * h0, gram[0, 1] * h0 * h1, gram[0, 2] * h0 * h2
    m11, m12, m22 = gram[1, 1] * h1 * h1, gram[1, 2] * h1 * h2, gram[2, 2] * h2 * h2
    for j in range(kinds.shape[0]):
        if kinds[j] != RANGE:
            others += 1
            continue
        x, y, z = c0 - data[j, 0], c1 - data[j, 1], c2 - data[j, 2]
        r = sqrt(x * x + y * y + z * z)
        per = 1.0 / r if r > 0.0 else 0.0
        g0 = (x * t00 + y * t10 + z * t20) * per
        g1 = (x * t01 + y * t11 + z * t21) * per
        g2 = (x * t02 + y * t12 + z * t22) * per
        e0, e1, e2 = g0 * h0, g1 * h1, g2 * h2
        least = r - abs(e0) - abs(e1) - abs(e2)
        across = largest_quadratic(
            m00 - e0 * e0, m01 - e0 * e1, m02 - e0 * e2, m11 - e1 * e1, m12 - e1 * e2, m22 - e2 * e2
        )
        root = sqrt(least * least + across)
        nodes[j, PHI], nodes[j, LOW] = r, 0.0
        nodes[j, SLOPE0], nodes[j, SLOPE1], nodes[j, SLOPE2] = g0, g1, g2
        # The same number without cancellation.
        nodes[j, HIGH] = across / (root + least) if least > 0.0 else root - least
    return others


@compiled
def curve_ranges(kinds: Array, gram: Array, half: Array, nodes: Array, curves: Array) -> None:
    """Write Hessians of all ranges, and bounds of their change, into the table of second derivatives.

    Let u be the direction of the line, r its length, P the projection across u, d = T s, and q the remainder. With r'
    the range elsewhere in the box, the gradient T'u changes by ``(T'P d - q T'u) / r'``. The Hessian ``T'P T / r``
    changes by a difference of quotients.

    Parameters
    ----------
    kinds : array (J,)
        Codes of the nodes.
    gram, half : array (3, 3), (3,)
        ``T'T``, and half-widths of the box.
    nodes : array (J, NODE_WIDTH)
        Filled by `bound_ranges`.
    curves : array (J, CURVE_WIDTH)
        Rows of ranges are written, see `optloc.proof.nodes.node`.
    """
    h0, h1, h2 = half[0], half[1], half[2]
    m00, m01, m02, m11, m12, m22 = gram[0, 0], gram[0, 1], gram[0, 2], gram[1, 1], gram[1, 2], gram[2, 2]
    for j in range(kinds.shape[0]):
        if kinds[j] != RANGE:
            continue
        r, g0, g1, g2, most = nodes[j, PHI], nodes[j, SLOPE0], nodes[j, SLOPE1], nodes[j, SLOPE2], nodes[j, HIGH]
        swing = abs(g0) * h0 + abs(g1) * h1 + abs(g2) * h2
        least = r - swing
        n00, n01, n02 = m00 - g0 * g0, m01 - g0 * g1, m02 - g0 * g2
        n11, n12, n22 = m11 - g1 * g1, m12 - g1 * g2, m22 - g2 * g2
        if least > 0.0:
            per, near = 1.0 / r, 1.0 / least
            e0 = (most * abs(g0) + abs(n00) * h0 + abs(n01) * h1 + abs(n02) * h2) * near
            e1 = (most * abs(g1) + abs(n01) * h0 + abs(n11) * h1 + abs(n12) * h2) * near
            e2 = (most * abs(g2) + abs(n02) * h0 + abs(n12) * h1 + abs(n22) * h2) * near
            eta, slope = sqrt(e0 * e0 + e1 * e1 + e2 * e2), sqrt(g0 * g0 + g1 * g1 + g2 * g2)
            norm = sqrt(n00 * n00 + n11 * n11 + n22 * n22 + 2.0 * (n01 * n01 + n02 * n02 + n12 * n12))
            chi = (eta * (2.0 * slope + eta) + norm * (swing + most) * per) * near
        else:  # the station may be in the box, where the gradient has any direction
            per, chi = 1.0 / r if r > 0.0 else 0.0, inf
            e0, e1, e2 = sqrt(m00) + abs(g0), sqrt(m11) + abs(g1), sqrt(m22) + abs(g2)
        curves[j, H00], curves[j, H01], curves[j, H02] = n00 * per, n01 * per, n02 * per
        curves[j, H11], curves[j, H12], curves[j, H22] = n11 * per, n12 * per, n22 * per
        curves[j, TURN0], curves[j, TURN1], curves[j, TURN2], curves[j, CHI] = e0, e1, e2, chi


# Behaviour at infinity. An atlas needs rows in which the coefficients of ranges sum to zero. Then the distance to the
# centre of its cube can be subtracted from each range. The result,
#
#     R (|p - v a| - |p|) / v = R (-2 a.p + v |a|^2) / (|p - v a| + |p|),
#
# stays finite and smooth at infinity.


@inlined
def bound_difference(
    frame: AtlasFrame, data: Array, centre: RangeForm, h: Triple, away: Array, sense: Array
) -> tuple[float, float, float, Triple, RangeForm]:
    """Return the bounds over a box of a range minus the distance to the centre of the cube.

    The results are the value at the centre of the box, the least and greatest remainder, the slope (all metres), and
    the `range_form` of the scaled line. The node is a quotient N/S with linear N, like ratios
    (`optloc.proof.nodes.ratio.bound_ratio`), and its size is at most ``R |a|``.

    Parameters
    ----------
    frame : AtlasFrame
        Position of the box.
    data : array (width,)
        Numbers of the node.
    centre : tuple
        Result of `optloc.proof.nodes.node.range_form` for p.
    h : triple
        Half-widths.
    away, sense : array (3,), (3, 3)
        Working memory.
    """
    radius = frame.radius
    set_line(frame, data, 0, away, sense)
    a, rise, n = scaled_station(frame, data)
    r, u, least, q, far = form = range_form(away, sense, h)
    r0, u0, least0, q0, far0 = centre
    size, u, most = r + r0, sum_of_forms(1.0, u, 1.0, u0), q + q0
    phi, least = rise / size if size > 0.0 else 0.0, max(least, 0.0) + max(least0, 0.0)
    if least > 0.0:
        g = sum_of_forms(1.0 / size, n, -phi / size, u)
        low, high = quotient_remainder(phi, g, u, most, (0.0, 0.0), (least, far + far0), h)
        # By the triangle inequality, the difference of the two distances is at most |a| in size.
        if high - low <= 2.0 * a:
            return radius * phi, radius * low, radius * high, sum_of_forms(radius, g, 0.0, g), form
    return radius * phi, radius * (-a - phi), radius * (a - phi), (0.0, 0.0, 0.0), form


@inlined
def curve_centre(slant: Array, centre: RangeForm, h: Triple) -> RangeBend:
    """Return the second derivatives of the distance |p| to the cube's centre over a box, for `curve_difference`.

    `slant` (3, 3) is the derivative of p, and `centre` its `range_form`. If the box may contain the centre, the bounds
    of changes are infinite.
    """
    r, u, least, q, _ = centre
    if not least > 0.0:
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (inf, inf, inf), inf, inf
    return range_hessian(slant, h, r, u, least, q)


@inlined
def curve_difference(
    frame: AtlasFrame,
    data: Array,
    node: Array,
    centre: RangeForm,
    bent: RangeBend,
    h: Triple,
    away: Array,
    sense: Array,
) -> tuple[Symmetric, Triple, float]:
    """Return Hessian and bounds of changes over a box of a range minus the distance to the centre.

    The first result is the Hessian at the centre of the box. The second bounds the change of each component of the
    gradient, and the third the spectral norm of the Hessian's change. An infinite number means that no bound is known.

    Parameters
    ----------
    frame, data, centre, h, away, sense
        As in `bound_difference`.
    node : array (NODE_WIDTH,)
        Result of `bound_difference`.
    bent : tuple
        Result of `curve_centre`.
    """
    m0, m1, m2 = frame.middle
    still, own = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if data[0] == m0 and data[1] == m1 and (data[2] == m2 or not frame.space):  # the node is zero
        return own, still, 0.0
    r, u, least, q = node[FORM], triple_at(node, FORM + 1), node[FORM + 4], node[FORM + 5]
    r0, u0, least0, q0, _ = centre
    slope = triple_at(node, SLOPE0)
    if slope == still or not (least > 0.0 and least0 > 0.0):
        return own, (inf, inf, inf), inf
    set_line(frame, data, 0, away, sense)
    second, ds, change, norm = range_hessian(sense, h, r, u, least, q)
    second0, ds0, change0, norm0 = bent
    size, u = r + r0, sum_of_forms(1.0, u, 1.0, u0)
    # The numerator of the quotient is linear.
    changes = (still, sum_of_forms(1.0, ds, 1.0, ds0), 0.0, change + change0, norm + norm0, reach(u, h) + q + q0)
    # Value and slope are in metres, so all results are in metres.
    return quotient_hessian(
        slope, u, (node[PHI], size, least + least0), changes, h, own, add_symmetric(second, second0)
    )


@compiled
def _size(data: Array, reach: float) -> float:
    """Return the size of the terms of a range, metres, which limits its accuracy."""
    return float(reach + (abs(data[0]) + abs(data[1]) + abs(data[2])))


@compiled
def _ball(data: Array, least: float, most: float) -> tuple[float, float, float, float]:
    """Return the ball of all points with a range of at most `most`: station (three numbers) and radius, metres."""
    return data[0], data[1], data[2], most


def _numbers(row: NodeRow) -> Array:
    """Return the numbers (B, n) of the range node of a row: the station's position."""
    return row.place(row.a)


DISTANCE = Node("range", 3, 1, _numbers, shape=CONVEX, infinity=DIFFERENCE, size=_size, ball=_ball, of_station=True)
