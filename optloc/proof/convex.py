"""Second derivatives of the cost over a box: where it is convex, and where its gradient cannot vanish."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, inlined
from optloc.proof.box import clip, is_empty
from optloc.proof.linear3 import inverse, positive
from optloc.proof.nodes.dispatch import curve_others, shape_of
from optloc.proof.nodes.node import (
    CHI,
    CONVEX,
    FLAT,
    FORCE,
    H00,
    H01,
    H02,
    H11,
    H12,
    H22,
    HIGH,
    LOW,
    PHI,
    PULL0,
    PULL1,
    PULL2,
    SLOPE0,
    SLOPE1,
    SLOPE2,
    TURN0,
    TURN1,
    TURN2,
)
from optloc.proof.nodes.range import curve_ranges

# A vector of sums (SUMS,): the Hessian of f/2 at the centre, entries H00 to H22 as of a node, its gradient, and bounds
# of the change of each entry of the Hessian.
G0, G1, G2, C00, C01, C02, C11, C12, C22, SUMS = range(6, 16)


@inlined
def curve_nodes(
    kinds: Array,
    data: Array,
    centre: Array,
    sense: Array,
    gram: Array,
    half: Array,
    line: Array,
    second: Array,
    nodes: Array,
    curves: Array,
) -> None:
    """Fill the table of second derivatives (J, CURVE_WIDTH) over a box.

    Arguments are those of `bound_nodes`, which ran before, and working memory `second` (3, 3).
    """
    curve_ranges(kinds, gram, half, nodes, curves)
    curve_others(kinds, data, centre, sense, half, line, second, nodes, curves)


@compiled
def sum_up(K: Array, w: Array, nodes: Array, curves: Array, sums: Array) -> None:
    """Fill forces and pulls of the table, and Hessian and gradient of f/2 at the centre of the box.

    Parameters
    ----------
    K, w : array (q, J), (q,)
        Whitened rows.
    nodes, curves : array (J, NODE_WIDTH), (J, CURVE_WIDTH)
        Tables of the box.
    sums : array (SUMS,)
        Written.
    """
    sums[:] = 0.0
    curves[:, FORCE:] = 0.0
    for i in range(K.shape[0]):
        residual, j0, j1, j2 = -w[i], 0.0, 0.0, 0.0
        for j in range(K.shape[1]):
            factor = K[i, j]
            residual += factor * nodes[j, PHI]
            j0 += factor * nodes[j, SLOPE0]
            j1 += factor * nodes[j, SLOPE1]
            j2 += factor * nodes[j, SLOPE2]
        sums[H00] += j0 * j0
        sums[H01] += j0 * j1
        sums[H02] += j0 * j2
        sums[H11] += j1 * j1
        sums[H12] += j1 * j2
        sums[H22] += j2 * j2
        sums[G0] += j0 * residual
        sums[G1] += j1 * residual
        sums[G2] += j2 * residual
        for j in range(K.shape[1]):
            factor = K[i, j]
            curves[j, FORCE] += factor * residual
            curves[j, PULL0] += factor * j0
            curves[j, PULL1] += factor * j1
            curves[j, PULL2] += factor * j2
    for j in range(K.shape[1]):
        for k in range(6):
            sums[k] += curves[j, FORCE] * curves[j, k]


@inlined
def force_change(A: Array, half: Array, nodes: Array, curves: Array, j: int) -> tuple[float, float]:
    """Return how far component j of K'(K phi - w) can fall and rise over the box; A = K'K (J, J)."""
    spread = abs(curves[j, PULL0]) * half[0] + abs(curves[j, PULL1]) * half[1] + abs(curves[j, PULL2]) * half[2]
    fall, rise = -spread, spread
    for m in range(A.shape[0]):
        first, second = A[j, m] * nodes[m, LOW], A[j, m] * nodes[m, HIGH]
        fall += min(first, second)
        rise += max(first, second)
    return fall, rise


@compiled
def convex(kinds: Array, A: Array, half: Array, nodes: Array, curves: Array, sums: Array, margin: float) -> bool:
    """Return whether the Hessian of f/2 exceeds `margin` times the identity all over the box.

    H = Phi'A Phi + sum_j g_j N_j. The first part changes by at least ``-(B'E + E'B)`` with B = A Phi and E the changes
    of the gradients (a term ``dPhi'A dPhi`` is positive). A node whose Hessian is positive semidefinite counts with its
    least force. What is bounded by entries only is taken off the diagonal, row by row (Gershgorin).

    Parameters
    ----------
    kinds : array (J,)
        Codes of the nodes.
    A : array (J, J)
        ``K'K``.
    half, nodes, curves, sums : arrays
        Of the box, filled by `bound_nodes`, `curve_nodes` and `sum_up`.
    margin : float
        In units of f/2 per squared search coordinate.
    """
    h0, h1, h2, h3, h4, h5 = sums[H00], sums[H01], sums[H02], sums[H11], sums[H12], sums[H22]
    away, d0, d1, d2 = margin, 0.0, 0.0, 0.0
    for j in range(kinds.shape[0]):
        b0, b1, b2 = abs(curves[j, PULL0]), abs(curves[j, PULL1]), abs(curves[j, PULL2])
        e0, e1, e2 = curves[j, TURN0], curves[j, TURN1], curves[j, TURN2]
        # Rows of |B|'E + E'|B|: Gershgorin takes them off the diagonal.
        d0 += 2.0 * b0 * e0 + b0 * e1 + b1 * e0 + b0 * e2 + b2 * e0
        d1 += 2.0 * b1 * e1 + b0 * e1 + b1 * e0 + b1 * e2 + b2 * e1
        d2 += 2.0 * b2 * e2 + b0 * e2 + b2 * e0 + b1 * e2 + b2 * e1
        shape = shape_of(kinds[j])
        if shape == FLAT:
            continue
        fall, rise = force_change(A, half, nodes, curves, j)
        if shape == CONVEX:
            # A force times a positive semidefinite Hessian is least where the force is: no absolute values are lost.
            h0 += fall * curves[j, H00]
            h1 += fall * curves[j, H01]
            h2 += fall * curves[j, H02]
            h3 += fall * curves[j, H11]
            h4 += fall * curves[j, H12]
            h5 += fall * curves[j, H22]
            away += abs(curves[j, FORCE] + fall) * curves[j, CHI]
        else:
            most = max(-fall, rise)
            n1, n2, n4 = abs(curves[j, H01]), abs(curves[j, H02]), abs(curves[j, H12])
            d0 += most * (abs(curves[j, H00]) + n1 + n2)
            d1 += most * (abs(curves[j, H11]) + n1 + n4)
            d2 += most * (abs(curves[j, H22]) + n2 + n4)
            away += (abs(curves[j, FORCE]) + most) * curves[j, CHI]
    h0, h3 = h0 - d0 - away, h3 - d1 - away
    # In the plane nothing depends on the third coordinate: any positive entry leaves the test to the others.
    h5 = 1.0 if half[2] == 0.0 and sums[H22] == 0.0 else h5 - d2 - away
    return positive(h0, h1, h2, h3, h4, h5)


@compiled
def spread_of(A: Array, half: Array, nodes: Array, curves: Array, sums: Array) -> float:
    """Write bounds of the change of each entry of the Hessian into sums[C00:]; return one of the rest's norm."""
    sums[C00:] = 0.0
    ball = 0.0  # what is known of a change by its norm alone
    for j in range(A.shape[0]):
        fall, rise = force_change(A, half, nodes, curves, j)
        most = max(-fall, rise)
        ball += (abs(curves[j, FORCE]) + most) * curves[j, CHI]
        b0, b1, b2 = abs(curves[j, PULL0]), abs(curves[j, PULL1]), abs(curves[j, PULL2])
        e0, e1, e2 = curves[j, TURN0], curves[j, TURN1], curves[j, TURN2]
        f0, f1, f2 = 0.0, 0.0, 0.0
        for m in range(A.shape[0]):
            factor = abs(A[j, m])
            f0 += factor * curves[m, TURN0]
            f1 += factor * curves[m, TURN1]
            f2 += factor * curves[m, TURN2]
        sums[C00] += 2.0 * b0 * e0 + e0 * f0 + most * abs(curves[j, H00])
        sums[C01] += b0 * e1 + b1 * e0 + e0 * f1 + most * abs(curves[j, H01])
        sums[C02] += b0 * e2 + b2 * e0 + e0 * f2 + most * abs(curves[j, H02])
        sums[C11] += 2.0 * b1 * e1 + e1 * f1 + most * abs(curves[j, H11])
        sums[C12] += b1 * e2 + b2 * e1 + e1 * f2 + most * abs(curves[j, H12])
        sums[C22] += 2.0 * b2 * e2 + e2 * f2 + most * abs(curves[j, H22])
    return ball


@compiled
def clip_to_stationary(
    A: Array, half: Array, nodes: Array, curves: Array, sums: Array, cut: Array, solve: Array
) -> None:
    """Clip a box to where the gradient of f may vanish.

    Interval Newton: the gradient at c + s is ``g + H s``, H the mean of the Hessian between centre and s. Bounds of its
    change over t times the box are at most t times those over the box (`optloc.proof.nodes.node`), so the mean changes
    by half of them. With Y the inverse of the Hessian at the centre a zero obeys ``s = -Y g - (Y H - 1) s``.

    Parameters
    ----------
    A, half, nodes, curves, sums : arrays
        As of `convex`.
    cut : array (6,)
        Lower and upper ends of the box about its centre; clipped.
    solve : array (3, 3)
        Working memory.
    """
    ball = spread_of(A, half, nodes, curves, sums)
    if not ball < inf:
        return
    # The share of the box that the mean reaches: half of the bounds of change, which grow with it at least linearly.
    plane = half[2] == 0.0 and sums[H22] == 0.0
    a, b, c, d, e, f = sums[H00], sums[H01], sums[H02], sums[H11], sums[H12], 1.0 if plane else sums[H22]
    if not inverse(a, b, c, d, e, f, solve):
        return
    h0, h1, h2 = half[0], half[1], half[2]
    ball *= 0.5 * sqrt(h0 * h0 + h1 * h1 + h2 * h2)
    w0 = 0.5 * (sums[C00] * h0 + sums[C01] * h1 + sums[C02] * h2)
    w1 = 0.5 * (sums[C01] * h0 + sums[C11] * h1 + sums[C12] * h2)
    w2 = 0.5 * (sums[C02] * h0 + sums[C12] * h1 + sums[C22] * h2)
    for k in range(2 if plane else 3):
        y0, y1, y2 = solve[k, 0], solve[k, 1], solve[k, 2]
        step = y0 * sums[G0] + y1 * sums[G1] + y2 * sums[G2]
        # What rounding leaves of Y H - 1 counts as change.
        e0, e1, e2 = y0 * a + y1 * b + y2 * c, y0 * b + y1 * d + y2 * e, y0 * c + y1 * e + y2 * f
        e0, e1, e2 = e0 - (k == 0), e1 - (k == 1), e2 - (k == 2)
        reach = abs(e0) * h0 + abs(e1) * h1 + abs(e2) * h2 + abs(y0) * w0 + abs(y1) * w1 + abs(y2) * w2
        reach += sqrt(y0 * y0 + y1 * y1 + y2 * y2) * ball
        # Search coordinates count standard deviations: a billionth of one, for the rounding of the gradient.
        clip(cut, k, -step, reach + 1e-9)


@compiled
def slopes_everywhere(A: Array, half: Array, nodes: Array, curves: Array, sums: Array, solve: Array) -> bool:
    """Return whether the gradient of f cannot vanish in the box; arguments as of `clip_to_stationary`."""
    cut = np.empty(6)
    for k in range(3):
        cut[k], cut[3 + k] = -half[k], half[k]
    clip_to_stationary(A, half, nodes, curves, sums, cut, solve)
    return is_empty(cut)
