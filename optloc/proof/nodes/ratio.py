"""Gain ratios r_a/r_b over a box: remainder and curvature of a quotient of two ranges."""

from __future__ import annotations

from math import inf, sqrt

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined
from optloc.proof.nodes.node import (
    SCALED,
    Node,
    NodeRow,
    Symmetric,
    Triple,
    add_symmetric,
    is_zero_slope,
    largest_entries,
    lay_out,
    length,
    product,
    range_form,
    range_hessian,
    reach,
    scaled,
    sum_of_forms,
    triple_at,
    turned_form,
    unbounded_curvature,
    write_symmetric,
    write_triple,
)

# Numbers: stations a and b.
STATION, STATION_B, _WIDTH = 0, 3, 6


@compiled
def bound_ratio(
    data: Array, line: Array, sense: Array, line_b: Array, sense_b: Array, half: Array, slope: Array
) -> tuple[float, float, float]:
    """Bound a ratio of ranges over a box (see `optloc.proof.nodes.node`).

    There are two quotients. With ``N = r_a^2 - r_b^2`` (affine in the position) and S = r_a + r_b, the first is delta =
    N/S = r_a - r_b. The second is phi = 1 + delta/r_b. At displacement s from the centre, the remainder of a quotient
    phi = N/S with slope g is ``(q_N - (g.s)(u.s) - (phi + g.s) q_S) / S'``. Here q_N and q_S are the remainders of N
    and S, u is the slope of S, and S' = S + u.s + q_S. Only the enclosures of q_N and q_S are inexact.

    If the box may contain station b, the ratio has no upper bound.
    """
    h = triple_at(half, 0)
    ra, ua, least_a, most_a, far_a = range_form(line, sense, h)
    rb, ub, least_b, most_b, far_b = range_form(line_b, sense_b, h)
    phi = ra / rb if rb > 0.0 else inf
    low = max(least_a, 0.0) / far_b if far_b > 0.0 else 0.0
    if least_b > 0.0:
        high = far_a / least_b
        # First the difference, whose numerator is affine, then the ratio from it: a range as numerator would have
        # curvature.
        n, q = _squares(line, sense, line_b, sense_b, h)
        size, u, most = ra + rb, sum_of_forms(1.0, ua, 1.0, ub), most_a + most_b
        delta = ra - rb
        g = sum_of_forms(1.0 / size, n, -delta / size, u)
        least = least_b + max(least_a, 0.0)
        q = quotient_remainder(delta, g, u, most, q, (least, far_a + far_b), h)
        g = sum_of_forms(1.0 / rb, g, -(phi - 1.0) / rb, ub)
        less, more = quotient_remainder(phi - 1.0, g, ub, most_b, q, (least_b, far_b), h)
        # Otherwise a constant interval for the whole box is tighter than a slope with its remainder.
        if more - less <= high - low:
            write_triple(g, slope)
            return phi, less, more
    else:
        high = inf
    slope[0] = slope[1] = slope[2] = 0.0
    return phi, low - phi, high - phi


@compiled
def quotient_remainder(
    phi: float,
    g: Triple,
    u: Triple,
    most: float,
    above: tuple[float, float],
    below: tuple[float, float],
    h: Triple,
) -> tuple[float, float]:
    """Return an enclosure of the remainder of a quotient phi = N/S over a box.

    Parameters
    ----------
    phi, g : float, triple
        Value and slope of the quotient.
    u, most : triple, float
        Slope of S, and the greatest remainder of S, which is not negative.
    above : pair of float
        Enclosure of the remainder of N.
    below : pair of float
        Least, positive, and greatest S over the box.
    h : triple
        Half-widths.
    """
    low, high = product(g, u, h)
    swing = reach(g, h)
    # The value of the quotient in the box, times the remainder of S, which is never negative.
    low, high = low + min((phi - swing) * most, 0.0), high + max((phi + swing) * most, 0.0)
    return scaled(above[0] - high, above[1] - low, below[0], below[1])


@compiled
def _squares(line: Array, sense: Array, line_b: Array, sense_b: Array, h: Triple) -> tuple[Triple, tuple[float, float]]:
    """Return slope and remainder of ``|line|^2 - |line_b|^2`` over a box, as the product of difference and sum.

    The results are the gradient at the centre, and the least and greatest remainder, square metres.
    """
    apart = (line[0] - line_b[0], line[1] - line_b[1], line[2] - line_b[2])
    n, low, high = turned_form(apart, sense), 0.0, 0.0
    n = sum_of_forms(1.0, n, 1.0, turned_form(apart, sense_b))
    for i in range(3):
        own, other = triple_at(sense[i], 0), triple_at(sense_b[i], 0)
        differ, both = sum_of_forms(1.0, own, -1.0, other), sum_of_forms(1.0, own, 1.0, other)
        n = sum_of_forms(1.0, n, line[i] + line_b[i], differ)
        less, more = product(differ, both, h)
        low, high = low + less, high + more
    return n, (low, high)


@compiled
def curve_ratio(
    data: Array,
    line: Array,
    sense: Array,
    line_b: Array,
    sense_b: Array,
    half: Array,
    curvature: Array,
    turn: Array,
) -> float:
    """Bound the second derivatives of a ratio over a box (`optloc.proof.nodes.node`).

    As in `bound_ratio`, there are two quotients: the difference of the ranges first, then the ratio.
    """
    h = triple_at(half, 0)
    bound_ratio(data, line, sense, line_b, sense_b, half, turn)
    ra, ua, least_a, qa, _ = range_form(line, sense, h)
    rb, ub, least_b, qb, _ = range_form(line_b, sense_b, h)
    if is_zero_slope(turn) or not (least_a > 0.0 and least_b > 0.0):
        return unbounded_curvature(curvature, turn)
    own, da, chi_a, norm_a = range_hessian(sense, h, ra, ua, least_a, qa)
    bend, db, chi_b, norm_b = range_hessian(sense_b, h, rb, ub, least_b, qb)
    n, _ = _squares(line, sense, line_b, sense_b, h)
    second = _square_bend(sense, sense_b)
    size, u, delta = ra + rb, sum_of_forms(1.0, ua, 1.0, ub), ra - rb
    g = sum_of_forms(1.0 / size, n, -delta / size, u)
    changes = (
        largest_entries(second, h),
        sum_of_forms(1.0, da, 1.0, db),
        0.0,
        chi_a + chi_b,
        norm_a + norm_b,
        reach(u, h) + qa + qb,
    )
    centre = (delta, size, least_a + least_b)
    second, wander, chi = quotient_hessian(g, u, centre, changes, h, second, add_symmetric(own, bend))
    # The result for the difference is the numerator of the second step.
    g = sum_of_forms(1.0 / rb, g, -delta / (rb * rb), ub)
    changes = (wander, db, chi, chi_b, norm_b, reach(ub, h) + qb)
    second, wander, chi = quotient_hessian(g, ub, (delta / rb, rb, least_b), changes, h, second, bend)
    write_symmetric(second, curvature)
    write_triple(wander, turn)
    return chi


@compiled
def _square_bend(sense: Array, sense_b: Array) -> Symmetric:
    """Return the constant Hessian of ``|line|^2 - |line_b|^2``."""
    return (
        _square_entry(sense, sense_b, 0, 0),
        _square_entry(sense, sense_b, 0, 1),
        _square_entry(sense, sense_b, 0, 2),
        _square_entry(sense, sense_b, 1, 1),
        _square_entry(sense, sense_b, 1, 2),
        _square_entry(sense, sense_b, 2, 2),
    )


@compiled
def _square_entry(sense: Array, sense_b: Array, k: int, m: int) -> float:
    """Return entry (k, m) of the Hessian of ``|line|^2 - |line_b|^2``."""
    entry = 0.0
    for i in range(3):
        entry += sense[i, k] * sense[i, m] - sense_b[i, k] * sense_b[i, m]
    return 2.0 * entry


@inlined
def quotient_hessian(
    g: Triple,
    u: Triple,
    centre: tuple[float, float, float],
    changes: tuple[Triple, Triple, float, float, float, float],
    h: Triple,
    curvature: Symmetric,
    bend: Symmetric,
) -> tuple[Symmetric, Triple, float]:
    """Return the Hessian of a quotient phi = N/S, and bounds of the changes of its gradient and its Hessian.

    Parameters
    ----------
    g, u : triple
        Gradients of phi and of S.
    centre : three numbers
        phi, S, and the least S over the box, positive.
    changes : tuple
        Bounds of the change of the gradients of N and S (triples), and of their Hessians; the norm of the Hessian of S
        at the centre; and a bound of the change of S.
    h : triple
        Half-widths.
    curvature, bend : symmetric
        The Hessians of N and of S.
    """
    phi, size, least = centre
    dn, ds, chi_n, chi_s, norm_s, widen = changes
    c00, c01, c02, c11, c12, c22 = curvature
    b00, b01, b02, b11, b12, b22 = bend
    g0, g1, g2 = g
    u0, u1, u2 = u
    per, most = 1.0 / size, 1.0 / least  # one division takes as long as five products
    own = (
        (c00 - 2.0 * g0 * u0 - phi * b00) * per,
        (c01 - g0 * u1 - u0 * g1 - phi * b01) * per,
        (c02 - g0 * u2 - u0 * g2 - phi * b02) * per,
        (c11 - 2.0 * g1 * u1 - phi * b11) * per,
        (c12 - g1 * u2 - u1 * g2 - phi * b12) * per,
        (c22 - 2.0 * g2 * u2 - phi * b22) * per,
    )
    # phi' S' = N', so the change of phi is (N' - N - phi (S' - S)) / S': its slope, and the change of the slope.
    rise = (reach(g, h) * size + reach(dn, h) + abs(phi) * reach(ds, h)) * most
    norm = own[0] * own[0] + own[3] * own[3] + own[5] * own[5]
    norm += 2.0 * (own[1] * own[1] + own[2] * own[2] + own[4] * own[4])
    t0 = (dn[0] + abs(phi) * ds[0] + rise * (abs(u0) + ds[0]) + widen * abs(g0)) * most
    t1 = (dn[1] + abs(phi) * ds[1] + rise * (abs(u1) + ds[1]) + widen * abs(g1)) * most
    t2 = (dn[2] + abs(phi) * ds[2] + rise * (abs(u2) + ds[2]) + widen * abs(g2)) * most
    dg, du = length((t0, t1, t2)), length(ds)
    mixed = 2.0 * (dg * length(u) + length(g) * du + dg * du)
    chi = (chi_n + mixed + abs(phi) * chi_s + rise * (norm_s + chi_s) + widen * sqrt(norm)) * most
    (w0, w1, w2), far = largest_entries(own, h), chi * length(h)
    return own, (min(t0, w0 + far), min(t1, w1 + far), min(t2, w2 + far)), chi


@compiled
def _ball(data: Array, least: float, most: float) -> tuple[float, float, float, float]:
    """Return a ball that contains all points with ``least <= r_a/r_b <= most``: centre (three numbers) and radius, m.

    The points with ``r_a <= q r_b``, q < 1, form the ball of Apollonius, around station a. If most >= 1 and least > 1,
    the ball is around station b, with q = 1/least. Otherwise there is no ball: the radius is infinite.
    """
    q = most if most < 1.0 else (1.0 / least if least > 1.0 else 1.0)
    if not q * q < 1.0 - 1e-9:  # nearly half of space: such a ball is useless and badly rounded
        return 0.0, 0.0, 0.0, inf
    near, far = (STATION, STATION_B) if most < 1.0 else (STATION_B, STATION)
    q = max(q, 0.0)
    scale = 1.0 / (1.0 - q * q)
    c0 = (data[near] - q * q * data[far]) * scale
    c1 = (data[near + 1] - q * q * data[far + 1]) * scale
    c2 = (data[near + 2] - q * q * data[far + 2]) * scale
    p0, p1, p2 = data[0] - data[3], data[1] - data[4], data[2] - data[5]
    return c0, c1, c2, q * sqrt(p0 * p0 + p1 * p1 + p2 * p2) * scale


def _numbers(row: NodeRow) -> Array:
    """Return the numbers (B, n) of the ratio node of a row: the positions of both stations."""
    return lay_out({STATION: row.place(row.a), STATION_B: row.place(row.b)})


RATIO_OF_RANGES = Node("ratio", _WIDTH, 2, _numbers, bound_ratio, curve_ratio, infinity=SCALED, ball=_ball)
