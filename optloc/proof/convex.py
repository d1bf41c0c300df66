"""Second derivatives of the cost over a box: where it is convex, and where its gradient cannot vanish."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, inlined
from optloc.proof.box import clip, is_empty
from optloc.proof.nodes.angles import curve_azimuth, curve_elevation
from optloc.proof.nodes.codes import AZIMUTH, ELEVATION, HEIGHT, LINEAR, RANGE, RATIO
from optloc.proof.nodes.height import curve_height
from optloc.proof.nodes.linear3 import inverse, positive
from optloc.proof.nodes.ranges import curve_ranges
from optloc.proof.nodes.ratio import curve_ratio

# Columns of a table of second derivatives (J, 14): Hessian (00, 01, 02, 11, 12, 22), bounds of the change of the
# gradient (6:9) and of the Hessian (9), K'(K phi - w) (10), and K'J (11:14).
CURVE_WIDTH = 14
FORCE = 10
# A vector of sums: Hessian of f/2 at the centre (0:6), its gradient (6:9), and bounds of its change (9:15).
SUMS = 15


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
    for j in range(kinds.shape[0]):
        kind = kinds[j]
        if kind == LINEAR:
            curves[j, :10] = 0.0
        elif kind != RANGE:
            for k in range(3):
                line[k] = centre[k] - data[j, k]
                line[3 + k] = centre[k] - data[j, 3 + k]
            own, turn = data[j], curves[j, 6:9]
            if kind == AZIMUTH:
                chi = curve_azimuth(own, line[:3], sense, half, second, turn)
            elif kind == ELEVATION:
                chi = curve_elevation(own, line[:3], sense, half, second, turn)
            elif kind == RATIO:
                chi = curve_ratio(own, line[:3], sense, line[3:], sense, half, second, turn)
            else:
                chi = curve_height(own, line[:3], sense, half, second, turn)
            # A slope of zero may stand for one that was not used: then the gradient is not that of the node.
            flat = nodes[j, 1] == 0.0 and nodes[j, 2] == 0.0 and nodes[j, 3] == 0.0
            curves[j, 9] = inf if flat else chi
            column = 0
            for k in range(3):
                for m in range(k, 3):
                    curves[j, column] = second[k, m]
                    column += 1


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
    curves[:, 10:] = 0.0
    for i in range(K.shape[0]):
        residual, j0, j1, j2 = -w[i], 0.0, 0.0, 0.0
        for j in range(K.shape[1]):
            factor = K[i, j]
            residual += factor * nodes[j, 0]
            j0 += factor * nodes[j, 1]
            j1 += factor * nodes[j, 2]
            j2 += factor * nodes[j, 3]
        sums[0] += j0 * j0
        sums[1] += j0 * j1
        sums[2] += j0 * j2
        sums[3] += j1 * j1
        sums[4] += j1 * j2
        sums[5] += j2 * j2
        sums[6] += j0 * residual
        sums[7] += j1 * residual
        sums[8] += j2 * residual
        for j in range(K.shape[1]):
            factor = K[i, j]
            curves[j, 10] += factor * residual
            curves[j, 11] += factor * j0
            curves[j, 12] += factor * j1
            curves[j, 13] += factor * j2
    for j in range(K.shape[1]):
        for k in range(6):
            sums[k] += curves[j, 10] * curves[j, k]


@inlined
def force_change(A: Array, half: Array, nodes: Array, curves: Array, j: int) -> tuple[float, float]:
    """Return how far component j of K'(K phi - w) can fall and rise over the box; A = K'K (J, J)."""
    spread = abs(curves[j, 11]) * half[0] + abs(curves[j, 12]) * half[1] + abs(curves[j, 13]) * half[2]
    fall, rise = -spread, spread
    for m in range(A.shape[0]):
        first, second = A[j, m] * nodes[m, 4], A[j, m] * nodes[m, 5]
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
    h0, h1, h2, h3, h4, h5 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    away, d0, d1, d2 = margin, 0.0, 0.0, 0.0
    for j in range(kinds.shape[0]):
        kind = kinds[j]
        b0, b1, b2 = abs(curves[j, 11]), abs(curves[j, 12]), abs(curves[j, 13])
        e0, e1, e2 = curves[j, 6], curves[j, 7], curves[j, 8]
        d0 += 2.0 * b0 * e0 + b0 * e1 + b1 * e0 + b0 * e2 + b2 * e0
        d1 += 2.0 * b1 * e1 + b0 * e1 + b1 * e0 + b1 * e2 + b2 * e1
        d2 += 2.0 * b2 * e2 + b0 * e2 + b2 * e0 + b1 * e2 + b2 * e1
        if kind == LINEAR:
            continue
        fall, rise = force_change(A, half, nodes, curves, j)
        if kind in (RANGE, HEIGHT):
            h0 += fall * curves[j, 0]
            h1 += fall * curves[j, 1]
            h2 += fall * curves[j, 2]
            h3 += fall * curves[j, 3]
            h4 += fall * curves[j, 4]
            h5 += fall * curves[j, 5]
            away += abs(curves[j, 10] + fall) * curves[j, 9]
        else:
            most = max(-fall, rise)
            n1, n2, n4 = abs(curves[j, 1]), abs(curves[j, 2]), abs(curves[j, 4])
            d0 += most * (abs(curves[j, 0]) + n1 + n2)
            d1 += most * (abs(curves[j, 3]) + n1 + n4)
            d2 += most * (abs(curves[j, 5]) + n2 + n4)
            away += (abs(curves[j, 10]) + most) * curves[j, 9]
    h0, h3 = h0 - d0 - away, h3 - d1 - away
    # In the plane nothing depends on the third coordinate.
    h5 = 1.0 if half[2] == 0.0 and sums[5] == 0.0 else h5 - d2 - away
    return positive(h0, h1, h2, h3, h4, h5)


@compiled
def spread_of(A: Array, half: Array, nodes: Array, curves: Array, sums: Array) -> float:
    """Write bounds of the change of each entry of the Hessian into sums[9:15]; return one of the rest's norm."""
    sums[9:15] = 0.0
    ball = 0.0
    for j in range(A.shape[0]):
        fall, rise = force_change(A, half, nodes, curves, j)
        most = max(-fall, rise)
        ball += (abs(curves[j, 10]) + most) * curves[j, 9]
        b0, b1, b2 = abs(curves[j, 11]), abs(curves[j, 12]), abs(curves[j, 13])
        e0, e1, e2 = curves[j, 6], curves[j, 7], curves[j, 8]
        f0, f1, f2 = 0.0, 0.0, 0.0
        for m in range(A.shape[0]):
            factor = abs(A[j, m])
            f0 += factor * curves[m, 6]
            f1 += factor * curves[m, 7]
            f2 += factor * curves[m, 8]
        sums[9] += 2.0 * b0 * e0 + e0 * f0 + most * abs(curves[j, 0])
        sums[10] += b0 * e1 + b1 * e0 + e0 * f1 + most * abs(curves[j, 1])
        sums[11] += b0 * e2 + b2 * e0 + e0 * f2 + most * abs(curves[j, 2])
        sums[12] += 2.0 * b1 * e1 + e1 * f1 + most * abs(curves[j, 3])
        sums[13] += b1 * e2 + b2 * e1 + e1 * f2 + most * abs(curves[j, 4])
        sums[14] += 2.0 * b2 * e2 + e2 * f2 + most * abs(curves[j, 5])
    return ball


@compiled
def clip_to_stationary(
    A: Array, half: Array, nodes: Array, curves: Array, sums: Array, cut: Array, solve: Array
) -> None:
    """Clip a box to where the gradient of f may vanish.

    Interval Newton: the gradient at c + s is ``g + H s``, H the mean of the Hessian between centre and s. Bounds of its
    change over t times the box are at most t times those over the box (`optloc.proof.nodes`), so the mean changes by
    half of them. With Y the inverse of the Hessian at the centre a zero obeys ``s = -Y g - (Y H - 1) s``.

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
    plane = half[2] == 0.0 and sums[5] == 0.0
    a, b, c, d, e, f = sums[0], sums[1], sums[2], sums[3], sums[4], 1.0 if plane else sums[5]
    if not inverse(a, b, c, d, e, f, solve):
        return
    h0, h1, h2 = half[0], half[1], half[2]
    ball *= 0.5 * sqrt(h0 * h0 + h1 * h1 + h2 * h2)
    w0 = 0.5 * (sums[9] * h0 + sums[10] * h1 + sums[11] * h2)
    w1 = 0.5 * (sums[10] * h0 + sums[12] * h1 + sums[13] * h2)
    w2 = 0.5 * (sums[11] * h0 + sums[13] * h1 + sums[14] * h2)
    for k in range(2 if plane else 3):
        y0, y1, y2 = solve[k, 0], solve[k, 1], solve[k, 2]
        step = y0 * sums[6] + y1 * sums[7] + y2 * sums[8]
        # What rounding leaves of Y H - 1 counts as change.
        e0, e1, e2 = y0 * a + y1 * b + y2 * c, y0 * b + y1 * d + y2 * e, y0 * c + y1 * e + y2 * f
        e0, e1, e2 = e0 - (k == 0), e1 - (k == 1), e2 - (k == 2)
        reach = abs(e0) * h0 + abs(e1) * h1 + abs(e2) * h2 + abs(y0) * w0 + abs(y1) * w1 + abs(y2) * w2
        reach += sqrt(y0 * y0 + y1 * y1 + y2 * y2) * ball
        clip(cut, k, -step, reach + 1e-9)


@compiled
def slopes_everywhere(A: Array, half: Array, nodes: Array, curves: Array, sums: Array, solve: Array) -> bool:
    """Return whether the gradient of f cannot vanish in the box; arguments as of `clip_to_stationary`."""
    cut = np.empty(6)
    for k in range(3):
        cut[k], cut[3 + k] = -half[k], half[k]
    clip_to_stationary(A, half, nodes, curves, sums, cut, solve)
    return is_empty(cut)
