"""Bounds over a box for hundreds of rows, in a time that is proportional to the number of rows.

Each row of a long run depends on few nodes (scalar functions of the position, such as ranges). All rows share a few
unknowns that enter linearly, such as offsets and drifts. The residual without them is ``e = S phi - w`` with S (q, J)
sparse and whitened. With Q an orthonormal basis of their directions, the cost is ``f = |P e|^2``, ``P = 1 - Q Q'``. The
dense rows P S are never computed. Each unit vector v with ``Q'v = 0`` gives the bound ``|P e| >= v.e``. Bounds of v.e
over a box need one pass over the entries of S. Second derivatives are summed over all nodes before they are bounded,
because they cancel in a long run. A box has half-widths `half` (3,) in search coordinates, and tables `nodes` and
`curves` (`optloc.proof.nodes.node`).
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled
from optloc.kernels.systems import positive_along
from optloc.proof.curvature import (
    BLUR0,
    C00,
    C01,
    C02,
    C11,
    C12,
    C22,
    G0,
    LENGTH0,
    NOISE0,
    symmetric_entry,
)
from optloc.proof.nodes.node import (
    CHI,
    H00,
    H01,
    H02,
    H11,
    H12,
    H22,
    HIGH,
    LOW,
    PHI,
    SLOPE0,
    SLOPE1,
    SLOPE2,
)

# Unit in the last place of a double at 1.
_ULP = 2.0**-52
# Number of roundings within a node and in its slopes.
_WITHIN = 32


class RunRows(NamedTuple):
    """Whitened rows ``e = S phi - w``, and the directions of other unknowns.

    Parameters
    ----------
    start : int array (q + 1,)
        Index of the first entry of each row, and the end.
    column, factor : int array (n,), array (n,)
        The node and the value of each entry of S.
    w : array (q,)
        Whitened measurements.
    basis : array (p, q)
        Orthonormal basis Q' of the changes of rows by the other unknowns.
    weight : array (J,)
        Lengths of the columns of S.
    """

    start: Array
    column: Array
    factor: Array
    w: Array
    basis: Array
    weight: Array


class RunWorkspace(NamedTuple):
    """Working memory for rows over one box.

    Parameters
    ----------
    residual : array (q,)
        P e at the centre.
    force : array (J,)
        ``S'P e``.
    lines, pulls : array (3, q), (3, J)
        Columns of the Jacobian ``P S Phi``, and of ``S'P S Phi``.
    reach, length : array (J,), (q,)
        A number for each node, and the products of the rows with these numbers.
    """

    residual: Array
    force: Array
    lines: Array
    pulls: Array
    reach: Array
    length: Array


@compiled
def workspace_of(rows: RunRows) -> RunWorkspace:
    """Return uninitialised working memory for rows."""
    q, J = rows.w.shape[0], rows.weight.shape[0]
    return RunWorkspace(np.empty(q), np.empty(J), np.empty((3, q)), np.empty((3, J)), np.empty(J), np.empty(q))


@compiled
def multiply(rows: RunRows, values: Array, out: Array) -> None:
    """Write ``S values`` for numbers (J,) of the nodes into `out` (q,)."""
    for i in range(out.shape[0]):
        total = 0.0
        for n in range(rows.start[i], rows.start[i + 1]):
            total += rows.factor[n] * values[rows.column[n]]
        out[i] = total


@compiled
def multiply_transposed(rows: RunRows, values: Array, out: Array) -> None:
    """Write ``S'values`` for numbers (q,) of the rows into `out` (J,)."""
    out[:] = 0.0
    for i in range(values.shape[0]):
        value = values[i]
        for n in range(rows.start[i], rows.start[i + 1]):
            out[rows.column[n]] += rows.factor[n] * value


@compiled
def project_out_unknowns(rows: RunRows, values: Array) -> None:
    """Subtract from values (q,) their part that the other unknowns can explain."""
    for _ in range(2):  # twice is exact (Parlett 1980)
        for k in range(rows.basis.shape[0]):
            along, own = 0.0, rows.basis[k]
            for i in range(values.shape[0]):
                along += own[i] * values[i]
            for i in range(values.shape[0]):
                values[i] -= along * own[i]


@compiled
def greatest_length(rows: RunRows, values: Array, out: Array) -> float:
    """Return a bound of the length of ``S y`` over all y with ``|y_j| <= values_j``.

    `values` (J,) are the greatest sizes of changes of the nodes. Of `out` (q,), only the length is read.
    """
    total = 0.0
    for i in range(out.shape[0]):
        most = 0.0
        for n in range(rows.start[i], rows.start[i + 1]):
            most += abs(rows.factor[n]) * values[rows.column[n]]
        total += most * most
    return sqrt(total)


@compiled
def rounding_of_residual(rows: RunRows, floor: float, nodes: Array) -> float:
    """Return a bound of the rounding of a residual, as a length.

    Parameters
    ----------
    rows : RunRows
        The rows.
    floor : float
        Further sizes that limit the accuracy: the length of w, and coordinates times their weights.
    nodes : array (J, NODE_WIDTH)
        Table of the box.
    """
    size = floor
    for j in range(nodes.shape[0]):
        size += rows.weight[j] * (abs(nodes[j, PHI]) + abs(nodes[j, LOW]) + abs(nodes[j, HIGH]))
    return relative_rounding_of(rows) * size


@compiled
def relative_rounding_of(rows: RunRows) -> float:
    """Return the relative rounding of sums over nodes and rows: one unit for each term, and 32 within a node."""
    return float((_WITHIN + rows.w.shape[0] + rows.weight.shape[0]) * _ULP)


@compiled
def share_within(rows: RunRows) -> float:
    """Return the share, 0 to 1, of `relative_rounding_of` from within a node: the rounding of coordinates."""
    return float(_WITHIN / (_WITHIN + rows.w.shape[0] + rows.weight.shape[0]))


@compiled
def residual_at(rows: RunRows, nodes: Array, sheet: RunWorkspace) -> float:
    """Write the residual at the centre of a box whose nodes are bounded, and its forces; return the cost there.

    The residual P e (q,) and the forces (J,) are written into `sheet`.
    """
    e, total = sheet.residual, 0.0
    for i in range(e.shape[0]):
        value = -rows.w[i]
        for n in range(rows.start[i], rows.start[i + 1]):
            value += rows.factor[n] * nodes[rows.column[n], PHI]
        e[i] = value
    project_out_unknowns(rows, e)
    for i in range(e.shape[0]):
        total += e[i] * e[i]
    multiply_transposed(rows, e, sheet.force)
    return total


# Greatest part that a projection may leave of a vector in the span: the rounding of whitened rows.
_BALANCED = 1e-11


@compiled
def is_balanced(rows: RunRows, ones: Array, out: Array) -> bool:
    """Return whether equal changes of the marked nodes change the rows only as the other unknowns can explain.

    `ones` (J,) is 1 for marked nodes and 0 for others; `out` (q,) is working memory. With ranges marked, True means
    that the cost stays finite at infinity.
    """
    size = greatest_length(rows, ones, out)
    multiply(rows, ones, out)
    project_out_unknowns(rows, out)
    left = 0.0
    for i in range(out.shape[0]):
        left += out[i] * out[i]
    return bool(sqrt(left) <= _BALANCED * size)


@compiled
def least_length(
    half: Array, nodes: Array, curves: Array, lean: Array, slip: float, sheet: RunWorkspace, cost: float, curved: bool
) -> float:
    """Return a lower bound of ``|P e|`` over a box, without rounding; a negative result means that no bound is known.

    Parameters
    ----------
    half : array (3,)
        Half-widths.
    nodes, curves : array (J, NODE_WIDTH), (J, CURVE_WIDTH)
        Tables of the box.
    lean, slip : array (J,), float
        Slopes of nodes across a surface, and greatest distance of the centre from it; 0 without a surface.
    sheet : RunWorkspace
        Filled by `residual_at`.
    cost : float
        Result of `residual_at`.
    curved : bool
        Whether second derivatives are available. Each node counts with its second derivatives and a third-order
        remainder, or with the interval of its remainder, whichever gives the better bound.
    """
    n = sqrt(cost)
    if not n > 0.0:
        return -1.0
    h0, h1, h2 = half[0], half[1], half[2]
    # A Hessian that changes by chi over the box, evenly along each ray, leaves a third-order remainder of a sixth of
    # chi.
    third = (h0 * h0 + h1 * h1 + h2 * h2) / 6.0
    g0 = g1 = g2 = m00 = m01 = m02 = m11 = m12 = m22 = rest = 0.0
    for j in range(nodes.shape[0]):
        force = sheet.force[j]
        s0, s1, s2 = nodes[j, SLOPE0], nodes[j, SLOPE1], nodes[j, SLOPE2]
        g0 += force * s0
        g1 += force * s1
        g2 += force * s2
        enclosed = min(force * nodes[j, LOW], force * nodes[j, HIGH])
        if curved and (s0 != 0.0 or s1 != 0.0 or s2 != 0.0):  # a slope of zero may replace an unused slope
            # The factor 2: slopes and Hessians of a point off the surface also differ, by much less.
            left = -abs(force) * (curves[j, CHI] * third + 2.0 * abs(lean[j]) * slip)
            if left > enclosed:
                rest += left
                m00 += force * curves[j, H00]
                m01 += force * curves[j, H01]
                m02 += force * curves[j, H02]
                m11 += force * curves[j, H11]
                m12 += force * curves[j, H12]
                m22 += force * curves[j, H22]
                continue
        rest += enclosed
    rest += 0.5 * (min(m00, 0.0) * h0 * h0 + min(m11, 0.0) * h1 * h1 + min(m22, 0.0) * h2 * h2)
    rest -= abs(m01) * h0 * h1 + abs(m02) * h0 * h2 + abs(m12) * h1 * h2
    return float(n + (rest - abs(g0) * h0 - abs(g1) * h1 - abs(g2) * h2) / n)


# Second derivatives of f/2 over a box: H = J'J + sum_j g_j N_j, with N_j the Hessian of node j and g_j its force.


@compiled
def sum_up_rows(
    rows: RunRows, half: Array, nodes: Array, curves: Array, noise: float, sheet: RunWorkspace, sums: Array
) -> float:
    """Write sums (SUMS,) of a box, and bounds of the Hessian's change; return a bound of the norm of the rest.

    Along s the Jacobian changes by ``P S (N s + r)`` with ``|r| <= chi |s| / 2``. Forces change by
    ``S'P S (Phi s + q)`` with q the remainders. The part that is linear in s is summed over the nodes, entry by entry,
    before it is bounded. The bounds of the change are in sums[C00:].

    Parameters
    ----------
    rows : RunRows
        The rows.
    half, nodes, curves : arrays
        The box and its tables.
    noise : float
        Bound of the rounding of a residual.
    sheet : RunWorkspace
        Filled by `residual_at`; lines and pulls are written.
    sums : array (SUMS,)
        Written.
    """
    sums[:] = 0.0
    residual, lines, pulls, q = sheet.residual, sheet.lines, sheet.pulls, rows.w.shape[0]
    longest, share = 0.0, relative_rounding_of(rows)
    for i in range(q):
        longest += residual[i] * residual[i]
    longest = sqrt(longest)
    for k in range(3):
        multiply(rows, nodes[:, SLOPE0 + k], lines[k])
        project_out_unknowns(rows, lines[k])
        multiply_transposed(rows, lines[k], pulls[k])
    for k in range(3):
        for m in range(k, 3):
            total = 0.0
            for i in range(q):
                total += lines[k, i] * lines[m, i]
            sums[symmetric_entry(k, m)] = total
        total = 0.0
        for i in range(q):
            total += lines[k, i] * residual[i]
        sums[G0 + k], sums[LENGTH0 + k] = total, sqrt(sums[symmetric_entry(k, k)])
    for j in range(nodes.shape[0]):
        for k in range(6):
            sums[k] += sheet.force[j] * curves[j, k]
        for k in range(3):
            sums[BLUR0 + k] += share * rows.weight[j] * abs(nodes[j, SLOPE0 + k])
    for k in range(3):
        sums[NOISE0 + k] = sums[LENGTH0 + k] * noise + sums[BLUR0 + k] * (longest + noise)
    _turn_entries(half, curves, pulls, sums)
    return _rest(rows, half, nodes, curves, noise + share * longest, sheet, sums)


@compiled
def _turn_entries(half: Array, curves: Array, pulls: Array, sums: Array) -> None:
    """Write the part of the Hessian's change that is linear in s into sums[C00:].

    `pulls` (3, J) are the columns of ``S'P S Phi``. The nodes' third derivatives are not included.
    """
    third = np.zeros((3, 6))  # entry (l, m) along k: sum_j pull_jk N_jlm
    for j in range(curves.shape[0]):
        for k in range(3):
            for at in range(6):
                third[k, at] += pulls[k, j] * curves[j, at]
    for a in range(3):
        for b in range(a, 3):
            change = 0.0
            for k in range(3):
                turn = (
                    third[k, symmetric_entry(a, b)] + third[a, symmetric_entry(k, b)] + third[b, symmetric_entry(k, a)]
                )
                change += half[k] * abs(turn)
            # The rounding of J'J counts as change. It is doubled, because the mean over a line takes half of each
            # change.
            blur = sums[LENGTH0 + a] * sums[BLUR0 + b] + sums[LENGTH0 + b] * sums[BLUR0 + a]
            sums[C00 + symmetric_entry(a, b)] = change + 2.0 * blur


@compiled
def _rest(
    rows: RunRows, half: Array, nodes: Array, curves: Array, blur: float, sheet: RunWorkspace, sums: Array
) -> float:
    """Return a bound of the norm of the rest of the Hessian's change; arguments as in `sum_up_rows`.

    `blur` bounds the rounding of a force per weight of its node.
    """
    h0, h1, h2, reach = half[0], half[1], half[2], sheet.reach
    size = sqrt(h0 * h0 + h1 * h1 + h2 * h2)
    own = cross = ball = 0.0
    for j in range(nodes.shape[0]):
        chi = curves[j, CHI]
        p0, p1, p2 = abs(sheet.pulls[0, j]), abs(sheet.pulls[1, j]), abs(sheet.pulls[2, j])
        # First, the change of the node's Hessian times its force and the first-order change of the force. Then the
        # second-order change of its gradient.
        ball += (abs(sheet.force[j]) + p0 * h0 + p1 * h1 + p2 * h2) * chi
        cross += sqrt(p0 * p0 + p1 * p1 + p2 * p2) * chi * size
        bend = norm_of(curves, j)
        own += rows.weight[j] * blur * bend
        reach[j] = max(-nodes[j, LOW], nodes[j, HIGH])
    if not ball < inf:
        return inf
    remainder = greatest_length(rows, reach, sheet.length)
    for j in range(nodes.shape[0]):
        reach[j] = norm_of(curves, j)
    bent = greatest_length(rows, reach, sheet.length)
    for j in range(nodes.shape[0]):
        reach[j] = curves[j, CHI]
    wide = greatest_length(rows, reach, sheet.length)
    # Second-order changes of forces, times Hessians and times their changes; and the square of the Jacobian's change.
    jump = bent * size + 0.5 * wide * size
    return float(ball + cross + 2.0 * own + remainder * (bent + wide) + jump * jump)


@compiled
def norm_of(curves: Array, j: int) -> float:
    """Return the Frobenius norm of a node's Hessian."""
    a, b, c = curves[j, H00], curves[j, H11], curves[j, H22]
    d, e, f = curves[j, H01], curves[j, H02], curves[j, H12]
    return sqrt(a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f))


@compiled
def is_convex_by(half: Array, sums: Array, ball: float, margin: float) -> bool:
    """Return whether the Hessian of f/2 exceeds `margin` over a whole box, from its sums and bounds of their change.

    `sums` and `ball` are the results of `sum_up_rows`.
    """
    if not ball < inf:
        return False
    d0 = sums[C00] + sums[C01] + sums[C02] + ball + margin
    d1 = sums[C01] + sums[C11] + sums[C12] + ball + margin
    d2 = sums[C02] + sums[C12] + sums[C22] + ball + margin
    # In the plane, and along a surface, nothing depends on the third coordinate.
    second, third = half[1] != 0.0 or sums[H11] != 0.0, half[2] != 0.0 or sums[H22] != 0.0
    h0, h3, h5 = sums[H00] - d0, sums[H11] - d1, sums[H22] - d2
    return bool(positive_along(h0, sums[H01], sums[H02], h3, sums[H12], h5, second, third))
