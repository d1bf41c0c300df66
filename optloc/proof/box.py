"""A box: all nodes bounded over it, the least length of the residual there, and where the cost is convex."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, inlined
from optloc.compute.systems import inverse, positive
from optloc.proof.nodes.dispatch import bound_others, curve_others, shape_of
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
    RANGE,
    SLOPE0,
    SLOPE1,
    SLOPE2,
    TURN0,
    TURN1,
    TURN2,
)
from optloc.proof.nodes.range import bound_ranges, curve_ranges

# Unit in the last place of a double at 1.
_ULP = 2.0**-52
# A half-width covers the rounding of its centre and corners: relative to itself, and some units in the last place
# of these.
_WIDER, _SHIFT = 1e-12, 1e-15
# Coordinate descents towards the least-squares point of a box; any point gives a valid bound. Over 8 fixes by range
# differences one descent took 6 % more boxes of an atlas than three, and ten took 0.6 % fewer.
_SWEEPS = 3
# Columns of a table of rows over a box (q, ROW_WIDTH): residual in the middle of the remainders, Jacobian, direction v.
MIDDLE, J0, J1, J2, DIRECTION, ROW_WIDTH = range(6)


@inlined
def bound_nodes(
    kinds: Array, data: Array, centre: Array, sense: Array, gram: Array, half: Array, line: Array, nodes: Array
) -> None:
    """Bound all nodes over a box in the near chart.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes.
    centre : array (3,)
        Centre of the box, metres.
    sense, gram : array (3, 3)
        T with x = c + T s, and ``T'T``.
    half : array (3,)
        Half-widths in search coordinates.
    line : array (6,)
        Working memory.
    nodes : array (J, NODE_WIDTH)
        Written.
    """
    others = bound_ranges(kinds, data, centre, sense, gram, half, nodes)
    if others:
        bound_others(kinds, data, centre, sense, half, line, nodes)


@inlined
def linearise_rows(K: Array, w: Array, nodes: Array, rows: Array) -> None:
    """Fill residuals (in the middle of the remainders) and Jacobian of the table of rows (q, ROW_WIDTH)."""
    for i in range(K.shape[0]):
        middle, j0, j1, j2 = -w[i], 0.0, 0.0, 0.0
        for j in range(K.shape[1]):
            factor = K[i, j]
            middle += factor * (nodes[j, PHI] + 0.5 * (nodes[j, LOW] + nodes[j, HIGH]))
            j0 += factor * nodes[j, SLOPE0]
            j1 += factor * nodes[j, SLOPE1]
            j2 += factor * nodes[j, SLOPE2]
        rows[i, MIDDLE], rows[i, J0], rows[i, J1], rows[i, J2] = middle, j0, j1, j2


@inlined
def cost_at(K: Array, w: Array, nodes: Array) -> float:
    """Return f at the centre of a box whose table of nodes is filled."""
    total = 0.0
    for i in range(K.shape[0]):
        residual = -w[i]
        for j in range(K.shape[1]):
            residual += K[i, j] * nodes[j, PHI]
        total += residual * residual
    return total


@inlined
def least_residual(K: Array, weight: Array, floor: float, half: Array, nodes: Array, rows: Array) -> float:
    """Return a lower bound of ``|K phi - w|`` over a box, negative where it says nothing.

    For any v, ``v.(K phi - w)`` over the box is at least its value in the middle less what the box and the remainders
    can change; v is the residual nearest to zero of the linear part (box-constrained least squares).

    Parameters
    ----------
    K : array (q, J)
        Whitened rows.
    weight : array (J,)
        Lengths of the columns of K.
    floor : float
        What else limits the accuracy of residuals: lengths of w and of the coordinates times their weights.
    half : array (3,)
        Half-widths in search coordinates.
    nodes, rows : array (J, NODE_WIDTH), (q, ROW_WIDTH)
        Filled tables; the direction v is written.
    """
    # Whatever v is, the bound holds; how good it is depends on v alone.
    _nearest(half, rows)
    length, reach, t0, t1, t2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(K.shape[0]):
        v = rows[i, DIRECTION]
        length += v * v
        reach += v * rows[i, MIDDLE]
        t0 += v * rows[i, J0]
        t1 += v * rows[i, J1]
        t2 += v * rows[i, J2]
    if not length > 0.0:
        return -1.0
    reach -= abs(t0) * half[0] + abs(t1) * half[1] + abs(t2) * half[2]
    for j in range(K.shape[1]):
        # The residual was taken in the middle of the remainders, so each counts with half its width.
        radius = 0.5 * (nodes[j, HIGH] - nodes[j, LOW])
        if radius > 0.0:
            total = 0.0
            for i in range(K.shape[0]):
                total += K[i, j] * rows[i, DIRECTION]
            reach -= abs(total) * radius
    return float(reach / sqrt(length)) - rounding(K, weight, floor, nodes)


@inlined
def rounding(K: Array, weight: Array, floor: float, nodes: Array) -> float:
    """Return a bound of the rounding errors of a residual (its length); arguments as of `least_residual`."""
    size = floor
    for j in range(K.shape[1]):
        size += weight[j] * (abs(nodes[j, PHI]) + abs(nodes[j, LOW]) + abs(nodes[j, HIGH]))
    # One rounding for each term of the sums over nodes and rows, and 32 for those within a node and in the slopes.
    return float((32 + K.shape[0] + K.shape[1]) * _ULP * size)


@compiled
def normal_of(rows: Array) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return J'J (00, 01, 02, 11, 12, 22) and J' middle."""
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(rows.shape[0]):
        middle, j0, j1, j2 = rows[i, MIDDLE], rows[i, J0], rows[i, J1], rows[i, J2]
        a00 += j0 * j0
        a01 += j0 * j1
        a02 += j0 * j2
        a11 += j1 * j1
        a12 += j1 * j2
        a22 += j2 * j2
        b0 += j0 * middle
        b1 += j1 * middle
        b2 += j2 * middle
    return a00, a01, a02, a11, a12, a22, b0, b1, b2


@compiled
def within(s: float, half: float) -> float:
    """Return the number nearest to s between -half and half."""
    if s > half:
        return half
    return max(s, -half)


@inlined
def _nearest(half: Array, rows: Array) -> None:
    """Write the direction v = middle + J s with s nearly the least-squares solution inside the box."""
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = normal_of(rows)
    d0, d1 = 1.0 / a00 if a00 > 0.0 else 0.0, 1.0 / a11 if a11 > 0.0 else 0.0
    d2 = 1.0 / a22 if a22 > 0.0 else 0.0
    s0, s1, s2 = 0.0, 0.0, 0.0
    for _ in range(_SWEEPS):
        s0 = within(-(b0 + a01 * s1 + a02 * s2) * d0, half[0])
        s1 = within(-(b1 + a01 * s0 + a12 * s2) * d1, half[1])
        s2 = within(-(b2 + a02 * s0 + a12 * s1) * d2, half[2])
    for i in range(rows.shape[0]):
        rows[i, DIRECTION] = rows[i, MIDDLE] + rows[i, J0] * s0 + rows[i, J1] * s1 + rows[i, J2] * s2


# Parts of a box that may be left out: where residuals are too long.


@inlined
def shrink(K: Array, rho: float, plane: bool, nodes: Array, rows: Array, cut: Array, solve: Array) -> None:
    """Clip a box to where the residual may be shorter than rho.

    With Y = (J'J)^-1 J' every point of the box obeys ``s = Y (residual) - Y (middle) - Y K dq``, dq the remainders
    from their middle: each coordinate is within ``rho |Y_k| + sum_j |Y_k K_j| (high_j - low_j)/2`` of that of Y middle.

    Parameters
    ----------
    K : array (q, J)
        Whitened rows.
    rho : float
        Longest residual of interest, rounding included.
    plane : bool
        Whether nothing depends on the third coordinate.
    nodes, rows : arrays
        Filled tables of the box.
    cut : array (6,)
        Lower and upper ends of the box about its centre; clipped.
    solve : array (3, 3)
        Working memory.
    """
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = normal_of(rows)
    if plane:  # nothing depends on the third coordinate: any pivot will do
        a22 = a22 + 1.0
    if not inverse(a00, a01, a02, a11, a12, a22, solve):
        return
    c0 = solve[0, 0] * b0 + solve[0, 1] * b1 + solve[0, 2] * b2
    c1 = solve[1, 0] * b0 + solve[1, 1] * b1 + solve[1, 2] * b2
    c2 = solve[2, 0] * b0 + solve[2, 1] * b1 + solve[2, 2] * b2
    r0, r1 = rho * sqrt(max(solve[0, 0], 0.0)), rho * sqrt(max(solve[1, 1], 0.0))
    r2 = rho * sqrt(max(solve[2, 2], 0.0))
    for j in range(K.shape[1]):
        radius = 0.5 * (nodes[j, HIGH] - nodes[j, LOW])
        if radius > 0.0:
            p0, p1, p2 = 0.0, 0.0, 0.0
            for i in range(K.shape[0]):
                p0 += K[i, j] * rows[i, J0]
                p1 += K[i, j] * rows[i, J1]
                p2 += K[i, j] * rows[i, J2]
            r0 += abs(solve[0, 0] * p0 + solve[0, 1] * p1 + solve[0, 2] * p2) * radius
            r1 += abs(solve[1, 0] * p0 + solve[1, 1] * p1 + solve[1, 2] * p2) * radius
            r2 += abs(solve[2, 0] * p0 + solve[2, 1] * p1 + solve[2, 2] * p2) * radius
    clip(cut, 0, -c0, r0)
    clip(cut, 1, -c1, r1)
    if not plane:
        clip(cut, 2, -c2, r2)


@inlined
def uncut(half: Array, cut: Array) -> None:
    """Write the ends of a whole box."""
    for k in range(3):
        cut[k], cut[3 + k] = -half[k], half[k]


@compiled
def clip(cut: Array, k: int, centre: float, reach: float) -> None:
    """Clip coordinate k of a box to ``|s - centre| <= reach``, with some slack for rounding."""
    # The inverse that centre and reach come from is good to some digits less than a double.
    reach += 1e-9 * (abs(centre) + reach)
    cut[k], cut[3 + k] = max(cut[k], centre - reach), min(cut[3 + k], centre + reach)


@inlined
def cut_out(cut: Array, at: Array, half: Array) -> float:
    """Replace a box by its part between the ends of a cut; return the share of its volume that this is."""
    share = 1.0
    for k in range(3):
        low, high, old = cut[k], cut[3 + k], half[k]
        if low > high:
            return 0.0
        if low > -old or high < old:
            middle = at[k] + 0.5 * (low + high)
            half[k] = min(0.5 * (high - low) * (1.0 + _WIDER) + _SHIFT * (abs(at[k]) + old), old)
            at[k] = middle
            share *= half[k] / old
    return share


@compiled
def is_empty(cut: Array) -> bool:
    """Return whether nothing is left of a box."""
    return bool(cut[0] > cut[3] or cut[1] > cut[4] or cut[2] > cut[5])


# The boxes still to be looked at: a stack, so that the deepest comes first and few are kept.

# Columns of the stack (capacity, DEPTH): centre, half-widths, the bound of the box that it came from, and the piece of
# an atlas that it lies in (0 in the near chart).
CENTRE, HALF, LEAST, PIECE, DEPTH = 0, 3, 6, 7, 8


@compiled
def push_around(stack: Array, size: int, low: Array, high: Array, hole: Array, piece: int) -> int:
    """Push the box between two corners, less the box |s_k| <= hole_k around the origin; return the size of the stack.

    The hole is cut out along its faces: at most two slabs a dimension. Slabs overlap the hole by a rounding.
    """
    low, high = low.copy(), high.copy()
    for k in range(3):
        for side in range(2):
            first, last = (low[k], min(-hole[k], high[k])) if side == 0 else (max(hole[k], low[k]), high[k])
            if not last > first:
                continue
            for m in range(3):
                a, b = (first, last) if m == k else (low[m], high[m])
                stack[size, CENTRE + m], stack[size, HALF + m] = 0.5 * (a + b), _wide(0.5 * (b - a), abs(a) + abs(b))
            stack[size, LEAST], stack[size, PIECE] = 0.0, piece
            size += 1
        if -hole[k] > high[k] or hole[k] < low[k]:
            return size
        low[k], high[k] = max(low[k], -hole[k]), min(high[k], hole[k])
    return size


@compiled
def pop(stack: Array, row: int, at: Array, half: Array) -> None:
    """Write centre and half-widths of a box on the stack into `at` and `half`."""
    for k in range(3):
        at[k], half[k] = stack[row, CENTRE + k], stack[row, HALF + k]


@compiled
def push(stack: Array, size: int, at: Array, half: Array, low: float) -> int:
    """Push a box of the near chart; return the size of the stack."""
    for k in range(3):
        stack[size, CENTRE + k], stack[size, HALF + k] = at[k], half[k]
    stack[size, LEAST], stack[size, PIECE] = low, 0.0
    return size + 1


@compiled
def push_halves(stack: Array, size: int, k: int, at: Array, half: Array, low: float, piece: int, exact: bool) -> int:
    """Push the halves of a box, cut across side k; return the size of the stack.

    `exact` says that centres and half-widths are sums of powers of two, which halving does not round.
    """
    for side in range(2):
        for m in range(3):
            stack[size, CENTRE + m], stack[size, HALF + m] = at[m], half[m]
        quarter = 0.5 * half[k]
        stack[size, CENTRE + k] = at[k] + (quarter if side else -quarter)
        stack[size, HALF + k] = quarter if exact else _wide(quarter, abs(at[k]) + half[k])
        stack[size, LEAST], stack[size, PIECE] = low, piece
        size += 1
    return size


@compiled
def _wide(half: float, size: float) -> float:
    """Return a half-width that covers the rounding of a centre and of a corner of this size."""
    return half * (1.0 + _WIDER) + _SHIFT * size if half > 0.0 else 0.0


@compiled
def least_left(stack: Array, size: int) -> float:
    """Return a lower bound of the cost in the boxes left."""
    least = inf
    for i in range(size):
        low = max(stack[i, LEAST], 0.0)
        least = min(least, low * low)
    return least


# Second derivatives of the cost over a box: where it is convex, and where its gradient cannot vanish.

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
    for j in range(kinds.shape[0]):
        if kinds[j] != RANGE:  # ranges alone are the common case, and every array that is handed on costs
            curve_others(kinds, data, centre, sense, half, line, second, nodes, curves)
            break


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
        shape = CONVEX if kinds[j] == RANGE else shape_of(kinds[j])  # the common case spares the call
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
