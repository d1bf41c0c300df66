"""Second derivatives of the cost over a box: where the cost is convex, and where its gradient cannot vanish.

The cost is ``f = |K phi - w|^2`` with nodes phi (J,), such as ranges; A is K'K (J, J). The *force* on a node is its
component of K'(K phi - w). Its *pull* is its row of K'J, with J the Jacobian of the residuals. A box has half-widths
`half` (3,) in search coordinates, whose unit is a standard deviation. Tables of the box are `nodes` and `curves`
(`optloc.proof.nodes.node`), and `sums` (SUMS,), whose columns are below. `cut` (6,) contains the lower and upper ends
of the remaining part of the box, relative to its centre. A part of the Hessian's change has no bounds for single
entries: `ball` bounds its spectral norm.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined
from optloc.kernels.systems import inverse, positive, positive_along, principal
from optloc.proof.box import contract_coordinate, is_empty, relative_rounding
from optloc.proof.nodes.dispatch import curve_others, shape_of
from optloc.proof.nodes.node import (
    BLUR,
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
    RANGE,
    SLOPE0,
    SLOPE1,
    SLOPE2,
    TURN0,
    TURN1,
    TURN2,
)
from optloc.proof.nodes.range import curve_ranges

DETERMINED = 1e-13
"""Share of the best information below which rows do not determine a coordinate.

The square root is a ratio of standard deviations of three million, the limit of double precision.
"""
FAINT = 1e-6
"""Share of the best information below which second derivatives may add some: stations are nearly coplanar."""

# Passes over the components of the gradient: a second pass saved 3 % of the boxes, a third pass none.
_SWEEPS = 2
# A few units in the last place: the rounding of a sum of a few products, relative to their sizes.
_ROUNDING = 1e-15
# A vector of sums (SUMS,): the Hessian of f/2 at the centre (entries H00 to H22 as in a node), and its gradient;
# lengths of the columns of the Jacobian, and bounds of the rounding of these columns and of the gradient; and bounds
# of the change of each entry of the Hessian.
G0, G1, G2, LENGTH0, LENGTH1, LENGTH2, BLUR0, BLUR1, BLUR2, NOISE0, NOISE1, NOISE2 = range(6, 18)
C00, C01, C02, C11, C12, C22, SUMS = range(18, 25)


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
    """Write the table of second derivatives (J, CURVE_WIDTH) of all nodes over a box.

    `optloc.proof.box.bound_nodes` must have run for the same box, and its arguments are the same. `second` (3, 3) is
    working memory.
    """
    curve_ranges(kinds, gram, half, nodes, curves)
    for j in range(kinds.shape[0]):
        if kinds[j] != RANGE:  # only if there are other kinds than ranges: each array that a call passes on takes time
            curve_others(kinds, data, centre, sense, half, line, second, nodes, curves)
            break


@compiled
def sum_up(K: Array, w: Array, weight: Array, noise: float, nodes: Array, curves: Array, sums: Array) -> None:
    """Write forces and pulls into the table, and Hessian and gradient of f/2 at the centre of the box into the sums.

    Parameters
    ----------
    K, w, weight : array (q, J), (q,), (J,)
        Whitened rows and measurements, and the lengths of the columns of K.
    noise : float
        Bound of the rounding of a residual, see `optloc.proof.box.rounding_error`.
    nodes, curves : array (J, NODE_WIDTH), (J, CURVE_WIDTH)
        Tables of the box; forces and pulls are written into `curves`.
    sums : array (SUMS,)
        Written.
    """
    sums[:] = 0.0
    curves[:, FORCE:] = 0.0
    longest = 0.0
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
        longest += residual * residual
        for j in range(K.shape[1]):
            factor = K[i, j]
            curves[j, FORCE] += factor * residual
            curves[j, PULL0] += factor * j0
            curves[j, PULL1] += factor * j1
            curves[j, PULL2] += factor * j2
    longest, share = sqrt(longest), relative_rounding(K)
    sums[LENGTH0], sums[LENGTH1], sums[LENGTH2] = sqrt(sums[H00]), sqrt(sums[H11]), sqrt(sums[H22])
    for j in range(K.shape[1]):
        curves[j, BLUR] = weight[j] * (noise + share * longest) + share * abs(curves[j, FORCE])
        for k in range(3):
            sums[BLUR0 + k] += share * weight[j] * abs(nodes[j, SLOPE0 + k])
        for k in range(6):
            sums[k] += curves[j, FORCE] * curves[j, k]
    for k in range(3):
        sums[NOISE0 + k] = sums[LENGTH0 + k] * noise + sums[BLUR0 + k] * (longest + noise)


@inlined
def force_change(A: Array, half: Array, nodes: Array, curves: Array, j: int) -> tuple[float, float]:
    """Return the greatest fall (negative) and rise (positive) of the force on node j over the box; A = K'K (J, J).

    Rounding of the force at the centre counts as change.
    """
    spread = abs(curves[j, PULL0]) * half[0] + abs(curves[j, PULL1]) * half[1] + abs(curves[j, PULL2]) * half[2]
    fall, rise = -spread - curves[j, BLUR], spread + curves[j, BLUR]
    for m in range(A.shape[0]):
        first, second = A[j, m] * nodes[m, LOW], A[j, m] * nodes[m, HIGH]
        fall += min(first, second)
        rise += max(first, second)
    return fall, rise


@compiled
def is_convex_over_box(
    kinds: Array, A: Array, half: Array, nodes: Array, curves: Array, sums: Array, margin: float
) -> bool:
    """Return whether the Hessian of f/2 exceeds `margin` times the identity over the whole box.

    The Hessian is H = Phi'A Phi + sum_j g_j N_j. Here Phi (J, 3) are the gradients of the nodes, g_j is the force on
    node j, and N_j its Hessian. With B = A Phi and E the changes of the gradients, the first part changes by at least
    ``-(B'E + E'B)``: the term ``dPhi'A dPhi`` is positive. A node whose Hessian is positive semidefinite counts with
    its least force. Changes that are bounded by entries only are subtracted from the diagonal, row by row (Gershgorin).

    Parameters
    ----------
    kinds : array (J,)
        Codes of the nodes.
    A : array (J, J)
        ``K'K``.
    half, nodes, curves, sums : arrays
        Tables of the box, filled by `bound_nodes`, `curve_nodes` and `sum_up`.
    margin : float
        In units of f/2 per squared search coordinate.
    """
    h0, h1, h2, h3, h4, h5 = sums[H00], sums[H01], sums[H02], sums[H11], sums[H12], sums[H22]
    away = margin
    # The rounding of J'J is subtracted like changes.
    length, blur = sums[LENGTH0] + sums[LENGTH1] + sums[LENGTH2], sums[BLUR0] + sums[BLUR1] + sums[BLUR2]
    d0, d1 = sums[LENGTH0] * blur + sums[BLUR0] * length, sums[LENGTH1] * blur + sums[BLUR1] * length
    d2 = sums[LENGTH2] * blur + sums[BLUR2] * length
    for j in range(kinds.shape[0]):
        b0, b1, b2 = abs(curves[j, PULL0]), abs(curves[j, PULL1]), abs(curves[j, PULL2])
        e0, e1, e2 = curves[j, TURN0], curves[j, TURN1], curves[j, TURN2]
        # Row sums of |B|'E + E'|B|, which Gershgorin's theorem subtracts from the diagonal.
        d0 += 2.0 * b0 * e0 + b0 * e1 + b1 * e0 + b0 * e2 + b2 * e0
        d1 += 2.0 * b1 * e1 + b0 * e1 + b1 * e0 + b1 * e2 + b2 * e1
        d2 += 2.0 * b2 * e2 + b0 * e2 + b2 * e0 + b1 * e2 + b2 * e1
        shape = CONVEX if kinds[j] == RANGE else shape_of(kinds[j])  # ranges, the common case, skip the call
        if shape == FLAT:
            continue
        fall, rise = force_change(A, half, nodes, curves, j)
        if shape == CONVEX:
            # A force times a positive semidefinite Hessian is least for the least force, so no absolute values are
            # needed.
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
    # In the plane nothing depends on the third coordinate.
    second, third = half[1] != 0.0 or sums[H11] != 0.0, half[2] != 0.0 or sums[H22] != 0.0
    return positive_along(h0 - d0 - away, h1, h2, h3 - d1 - away, h4, h5 - d2 - away, second, third)


@compiled
def spread_of(A: Array, half: Array, nodes: Array, curves: Array, sums: Array) -> float:
    """Write bounds of the change of the Hessian's entries into sums[C00:]; return a bound of the norm of the rest.

    The arguments are as in `is_convex_over_box`. The Hessian is half of the Hessian of f, and the change is from the
    centre of the box to any other point.
    """
    l0, l1, l2, u0, u1, u2 = sums[LENGTH0], sums[LENGTH1], sums[LENGTH2], sums[BLUR0], sums[BLUR1], sums[BLUR2]
    # The rounding of J'J counts as change. It is doubled, because the mean over a line takes half of each change.
    sums[C00], sums[C01], sums[C02] = 4.0 * l0 * u0, 2.0 * (l0 * u1 + l1 * u0), 2.0 * (l0 * u2 + l2 * u0)
    sums[C11], sums[C12], sums[C22] = 4.0 * l1 * u1, 2.0 * (l1 * u2 + l2 * u1), 4.0 * l2 * u2
    ball = 0.0  # the part of the change that is bounded by its norm only
    for j in range(A.shape[0]):
        fall, rise = force_change(A, half, nodes, curves, j)
        most = max(-fall, rise) + curves[j, BLUR]
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
def contract_to_minima(
    A: Array, half: Array, nodes: Array, curves: Array, sums: Array, cut: Array, solve: Array
) -> bool:
    """Contract a box to the part in which the gradient of f may vanish; return whether the box may contain a minimum.

    This is an interval Newton method. The gradient at c + s is ``g + H s``, with H the mean of the Hessian between
    centre and s. Over t times the box, bounds of the change are at most t times the bounds over the box
    (`optloc.proof.nodes.node`). So the mean changes by half of them. With Y the inverse of the Hessian at the centre,
    a zero of the gradient obeys ``s = -Y g - (Y H - 1) s``.

    Parameters
    ----------
    A, half, nodes, curves, sums : arrays
        As in `is_convex_over_box`.
    cut : array (6,)
        Lower and upper ends of the box relative to its centre; contracted in place.
    solve : array (3, 3)
        Working memory.
    """
    return not has_no_infimum(3, False, half, sums, spread_of(A, half, nodes, curves, sums), cut, solve)


@inlined
def contract_newton(half: Array, sums: Array, ball: float, cut: Array, solve: Array) -> None:
    """Contract a box to the part in which the gradient may vanish (see `contract_to_minima`).

    `ball` and sums[C00:] bound the Hessian's change, as `spread_of` returns and writes them.
    """
    if not ball < inf:
        return
    # The mean of the Hessian changes by half of the bounds of change, which grow with the box at least linearly.
    plane = half[2] == 0.0 and sums[H22] == 0.0
    a, b, c, d, e, f = sums[H00], sums[H01], sums[H02], sums[H11], sums[H12], 1.0 if plane else sums[H22]
    d = 1.0 if half[1] == 0.0 and d == 0.0 else d
    h0, h1, h2 = half[0], half[1], half[2]
    ball *= 0.5 * sqrt(h0 * h0 + h1 * h1 + h2 * h2)
    if not _clip_along(a, d, f, plane, sums, ball, cut):
        return
    h0, h1, h2 = max(abs(cut[0]), abs(cut[3])), max(abs(cut[1]), abs(cut[4])), max(abs(cut[2]), abs(cut[5]))
    w0 = 0.5 * (sums[C00] * h0 + sums[C01] * h1 + sums[C02] * h2)
    w1 = 0.5 * (sums[C01] * h0 + sums[C11] * h1 + sums[C12] * h2)
    w2 = 0.5 * (sums[C02] * h0 + sums[C12] * h1 + sums[C22] * h2)
    if not inverse(a, b, c, d, e, f, solve):
        return
    for k in range(2 if plane else 3):
        y0, y1, y2 = solve[k, 0], solve[k, 1], solve[k, 2]
        step = y0 * sums[G0] + y1 * sums[G1] + y2 * sums[G2]
        # The rounding of Y H - 1 counts as change.
        e0, e1, e2 = y0 * a + y1 * b + y2 * c, y0 * b + y1 * d + y2 * e, y0 * c + y1 * e + y2 * f
        e0, e1, e2 = e0 - (k == 0), e1 - (k == 1), e2 - (k == 2)
        reach = abs(e0) * h0 + abs(e1) * h1 + abs(e2) * h2 + abs(y0) * w0 + abs(y1) * w1 + abs(y2) * w2
        reach += sqrt(y0 * y0 + y1 * y1 + y2 * y2) * ball
        # The rounding of the gradient and of the products with it, even if they cancel in the sum.
        reach += abs(y0) * sums[NOISE0] + abs(y1) * sums[NOISE1] + abs(y2) * sums[NOISE2]
        g0, g1, g2 = abs(sums[G0]), abs(sums[G1]), abs(sums[G2])
        reach += _ROUNDING * (abs(y0) * g0 + abs(y1) * g1 + abs(y2) * g2)
        contract_coordinate(cut, k, -step, reach + 1e-9)


@inlined
def _clip_along(a: float, d: float, f: float, plane: bool, sums: Array, ball: float, cut: Array) -> bool:
    """Contract each coordinate to where the same component of the gradient may vanish; return whether any part remains.

    If the Hessian is nearly singular, its inverse gives no bound, but a steep coordinate still gives one. Arguments are
    as in `contract_newton`. a, d and f are the diagonal of the Hessian. `plane` means that there is no third
    coordinate. `ball` is multiplied by half of the diagonal of the box.
    """
    for _ in range(_SWEEPS):
        for k in range(2 if plane else 3):
            own = a if k == 0 else (d if k == 1 else f)
            if not own > 0.0:
                continue
            # The rounding of the sum counts even if the terms cancel, because the slope may be small.
            middle, wide = sums[G0 + k], ball + sums[NOISE0 + k] + _ROUNDING * abs(sums[G0 + k])
            for m in range(3):
                at, far = symmetric_entry(k, m), max(abs(cut[m]), abs(cut[3 + m]))
                wide += (0.5 * sums[C00 + at] + _ROUNDING * abs(sums[at])) * far
                if m != k:
                    middle += sums[at] * 0.5 * (cut[m] + cut[3 + m])
                    wide += abs(sums[at]) * 0.5 * (cut[3 + m] - cut[m])
            contract_coordinate(cut, k, -middle / own, wide / own + 1e-9)
            if cut[k] > cut[3 + k]:
                return False
    return True


@compiled
def has_no_infimum(
    dimension: int, touching: bool, half: Array, sums: Array, ball: float, cut: Array, solve: Array
) -> bool:
    """Return whether a box of an atlas cannot contain an infimum of the cost.

    This holds if the gradient does not vanish, or the Hessian has a negative eigenvalue. A box that reaches infinity
    (`touching`) contains no infimum if the cost falls inwards or changes along infinity.

    Parameters
    ----------
    dimension : int
        2 or 3.
    touching : bool
        Whether infinity is a side of the box.
    half, sums : array (3,), (SUMS,)
        The box, and its sums with bounds of the Hessian's change.
    ball : float
        A bound of the norm of the rest of that change.
    cut : array (6,)
        Ends of the part of the box to test; contracted unless the box reaches infinity.
    solve : array (3, 3)
        Working memory.
    """
    if not ball < inf:
        return False
    if not touching:
        contract_newton(half, sums, ball, cut, solve)
        return is_empty(cut) or is_concave_along(sums, ball, solve)
    ball *= sqrt(half[0] * half[0] + half[1] * half[1] + half[2] * half[2])
    for k in range(dimension):
        change = ball
        for m in range(3):
            at = symmetric_entry(k, m)
            change += (abs(sums[at]) + sums[C00 + at]) * half[m]
        # Slack for the relative rounding of the sums, and for the rounding of the gradient.
        slope, change = sums[G0 + k], change * (1.0 + 1e-6) + sums[NOISE0 + k]
        if -slope > change or (k < dimension - 1 and slope > change):
            return True
    return False


@compiled
def most_curved_side(half: Array, sums: Array, dimension: int) -> int:
    """Return the side (0, 1, 2) along which the uncertain part of the Hessian changes the slope most, or -1.

    A search halves this side. The result is -1 if no side has a finite change above zero. Over 70 fixes that took many
    boxes, halving this side took an eighth fewer boxes than halving the steepest side.
    """
    most, side = 0.0, -1
    for m in range(dimension):
        change = 0.0
        for k in range(dimension):
            change += sums[C00 + symmetric_entry(k, m)] * half[k]
        change *= half[m]
        if most < change < inf:
            most, side = change, m
    return side


@compiled
def is_concave_along(sums: Array, ball: float, hessian: Array) -> bool:
    """Return whether the cost has a direction of negative curvature over the whole box, as around a saddle.

    No minimum is in a box of this kind. `sums` and `ball` are as in `has_no_infimum`, and `hessian` (3, 3) is working
    memory.
    """
    # No eigenvalue is less than a diagonal entry less the sizes of the other entries of its row (Gershgorin). This
    # decides the common case.
    a, b, c = abs(sums[H01]), abs(sums[H02]), abs(sums[H12])
    least = min(sums[H00] - a - b, sums[H11] - a - c, sums[H22] - b - c)
    if least + ball >= 0.0 or positive(sums[H00], sums[H01], sums[H02], sums[H11], sums[H12], sums[H22]):
        return False
    vectors = np.empty((3, 3))
    for k in range(3):
        for m in range(3):
            hessian[k, m] = sums[symmetric_entry(k, m)]
    principal(hessian, vectors)
    column = 0
    for k in range(1, 3):
        if hessian[k, k] < hessian[column, column]:
            column = k
    most = ball
    for k in range(3):
        for m in range(3):
            at = symmetric_entry(k, m)
            z = vectors[k, column] * vectors[m, column]
            most += sums[at] * z + sums[C00 + at] * abs(z)
    size = abs(sums[H00]) + abs(sums[H11]) + abs(sums[H22])
    return bool(most < -1e-9 * size)  # by more than the rounding of the Hessian's entries


@compiled
def least_diagonal(information: Array, dimension: int) -> float:
    """Return the least of the first `dimension` diagonal entries of an information matrix (3, 3)."""
    least = inf
    for k in range(dimension):
        least = min(least, information[k, k])
    return least


@compiled
def bend_axes(sums: Array, axes: Array, information: Array, dimension: int) -> None:
    """Replace the information along axes by the second derivative of the cost if this is larger.

    The rows may not determine an axis to first order: across a plane of symmetry all first derivatives vanish.

    Parameters
    ----------
    sums : array (SUMS,)
        Contains the Hessian of f/2.
    axes, information : array (3, 3)
        Axes in columns, and a matrix whose diagonal is the information along them; raised in place.
    dimension : int
        2 or 3.
    """
    for column in range(dimension):
        bent = 0.0
        for k in range(3):
            for m in range(3):
                bent += axes[k, column] * axes[m, column] * sums[symmetric_entry(k, m)]
        information[column, column] = max(information[column, column], bent)


@compiled
def symmetric_entry(k: int, m: int) -> int:
    """Return the index of entry (k, m) of a symmetric matrix in the list (00, 01, 02, 11, 12, 22)."""
    first, second = min(k, m), max(k, m)
    return second if first == 0 else first + second + 1
