"""Gain ratios r_a/r_b over a box: remainder and curvature of a quotient of two ranges."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.forms import (
    Triple,
    blend,
    length,
    product,
    range_bend,
    range_form,
    reach,
    scaled,
    triple,
    unbounded,
    write,
)
from optloc.types import Array


@compiled
def bound_ratio(
    data: Array, line: Array, sense: Array, line_b: Array, sense_b: Array, half: Array, slope: Array
) -> tuple[float, float, float]:
    """Bound a ratio of ranges over a box (see `optloc.proof.nodes`).

    With ``r_a' = r_a + u_a.s + q_a`` and likewise b, slope ``g = (u_a - phi u_b)/r_b``, the remainder is exactly
    ``(q_a - (g.s)(u_b.s) - (phi + g.s) q_b) / r_b'``. The upper end is infinite where the box may touch station b.
    """
    h = triple(half, 0)
    ra, ua, least_a, most_qa = range_form(line, sense, h)
    rb, ub, least_b, most_qb = range_form(line_b, sense_b, h)
    phi = ra / rb if rb > 0.0 else inf
    top, bottom = ra + reach(ua, h) + most_qa, rb + reach(ub, h) + most_qb
    low, high = max(least_a, 0.0) / bottom - phi, top / least_b - phi if least_b > 0.0 else inf
    if least_b > 0.0:
        g = blend(1.0 / rb, ua, -phi / rb, ub)
        down, up = product(g, ub, h)
        swing = reach(g, h)
        under, over = min((phi - swing) * most_qb, 0.0), max((phi + swing) * most_qb, 0.0)
        less, more = scaled(-up - over, most_qa - down - under, least_b, bottom)
        if more - less <= high - low:
            write(g, slope)
            return phi, less, more
    slope[0] = slope[1] = slope[2] = 0.0
    return phi, low, high


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
    """Bound how a ratio of ranges curves over a box (see `optloc.proof.nodes`).

    ``phi r_b = r_a`` differentiated twice: the Hessian is ``(H_a - g u_b' - u_b g' - phi H_b) / r_b``.
    """
    h = triple(half, 0)
    ra, ua, least_a, qa = range_form(line, sense, h)
    rb, ub, least_b, qb = range_form(line_b, sense_b, h)
    if not (least_a > 0.0 and least_b > 0.0):
        return unbounded(curvature, turn)
    phi = ra / rb
    bend = np.empty((3, 3))
    ea, chi_a, _ = range_bend(sense, h, ra, ua, least_a, qa, curvature)
    eb, chi_b, norm_b = range_bend(sense_b, h, rb, ub, least_b, qb, bend)
    g = blend(1.0 / rb, ua, -phi / rb, ub)
    changes = (ea, eb, chi_a, chi_b, norm_b, reach(ub, h) + qb)
    return quotient_bend(g, ub, (phi, rb, least_b), changes, h, curvature, bend, turn)


@compiled
def quotient_bend(
    g: Triple,
    u: Triple,
    centre: tuple[float, float, float],
    changes: tuple[Triple, Triple, float, float, float, float],
    h: Triple,
    curvature: Array,
    bend: Array,
    turn: Array,
) -> float:
    """Bound how a quotient phi = N/S curves, from how N and S do; return the change of its Hessian.

    Parameters
    ----------
    g, u : triple
        Gradients of phi and of S.
    centre : three numbers
        phi, S, and the least S over the box, positive.
    changes : tuple
        Bounds of the change of the gradients of N and S (triples), of their Hessians, the norm of the Hessian of S at
        the centre, and the change of S.
    h : triple
        Half-widths.
    curvature : array (3, 3)
        The Hessian of N; overwritten by that of phi.
    bend : array (3, 3)
        The Hessian of S.
    turn : array (3,)
        Written: bounds of the change of the gradient of phi.
    """
    phi, size, least = centre
    dn, ds, chi_n, chi_s, norm_s, widen = changes
    for k in range(3):
        for m in range(3):
            curvature[k, m] = (curvature[k, m] - g[k] * u[m] - u[k] * g[m] - phi * bend[k, m]) / size
    # phi' r' = N', so the change of phi is (N' - N - phi (S' - S)) / S': its own slope, and what that changes by.
    rise = reach(g, h) * size / least + (reach(dn, h) + abs(phi) * reach(ds, h)) / least
    norm = 0.0
    for k in range(3):
        for m in range(3):
            norm += curvature[k, m] * curvature[k, m]
        change = dn[k] + abs(phi) * ds[k] + rise * (abs(u[k]) + ds[k]) + widen * abs(g[k])
        turn[k] = change / least
    wander = (turn[0], turn[1], turn[2])
    dg, du = length(wander), length(ds)
    mixed = 2.0 * (dg * length(u) + length(g) * du + dg * du)
    chi = (chi_n + mixed + abs(phi) * chi_s + rise * (norm_s + chi_s) + widen * sqrt(norm)) / least
    for k in range(3):
        turn[k] = min(turn[k], reach((curvature[k, 0], curvature[k, 1], curvature[k, 2]), h) + chi * length(h))
    return chi
