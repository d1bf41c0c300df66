"""Second derivatives of a cost with unknown factors: boxes with one minimum, and boxes without a stationary point.

The coordinates are offsets s from the centre (3,) and ``t = R (k - best - B s)`` (G,), with the factors k, and with R
and U as in `optloc.proof.scaled.reduction`. B is the derivative of the best factors. So the Hessian at the centre has
no entry between s and t, and its part along t is the identity. E (q, 3) is the derivative of the residual along s. The
force on a node is the product of its column of the rows with the residual.

The statements are about points whose factors fit their position best, and are either not zero or may be negative. All
minima are such points, and so is the point of least cost at each position.
"""

from __future__ import annotations

from math import inf, sqrt

from optloc.kernels.jit import compiled, inlined
from optloc.kernels.systems import positive_along
from optloc.proof.box import is_empty, relative_rounding, reset_cut
from optloc.proof.curvature import C00, G0, LENGTH0, NOISE0, contract_newton, is_concave_along, symmetric_entry
from optloc.proof.nodes.node import CHI, H00, H01, H02, H11, H12, H22, HIGH, LOW, PHI, SLOPE0, TURN0
from optloc.proof.scaled.reduction import (
    Scaled,
    ScaledWorkspace,
    is_bounded,
    is_positive,
    rounding_of_residual,
    size_of_factor,
)
from optloc.proof.search_space import Box

# Rounding as a share of the information: sums over some tens of rows and nodes.
_ROUNDED = 1e-11
# Rounds in which offsets and factors narrow each other's ranges.
_ROUNDS = 2


@compiled
def sum_scaled(scaled: Scaled, squares: bool, box: Box, sheet: ScaledWorkspace) -> float:
    """Write Hessian, gradient and bounds of their change over a box; return a bound of the norm of the rest.

    Parameters
    ----------
    scaled : Scaled
        The cost.
    squares : bool
        Whether the positive part of the change of ``E'E`` counts. A test of convexity may leave it out.
    box : Box
        Its nodes and their curves are filled; the sums are written.
    sheet : ScaledWorkspace
        Reduced rows with the ranges of the factors; derivatives and changes are written.
    """
    if not (is_positive(sheet) or (scaled.free and is_bounded(sheet))):
        return inf
    for j in range(box.nodes.shape[0]):
        if not (box.nodes[j, HIGH] - box.nodes[j, LOW] < inf and box.curves[j, CHI] < inf):
            return inf
    noise = rounding_of_residual(scaled, sheet)
    box.sums[:], sheet.cross[:], sheet.third[:] = 0.0, 0.0, 0.0
    _derive(scaled, noise, box, sheet)
    _add_information(scaled, noise, box, sheet)
    ball = 0.0
    for j in range(box.nodes.shape[0]):
        ball += _add_node(scaled, noise, j, box, sheet)
    _add_third(box, sheet)
    _add_mixed(scaled, box, sheet)
    _add_changes(scaled, squares, box, sheet)
    return float(ball + _ROUNDED * (box.sums[H00] + box.sums[H11] + box.sums[H22]))


@inlined
def factor_of(scaled: Scaled, sheet: ScaledWorkspace, j: int) -> float:
    """Return the factor of node j at the centre of a box: the best factor of its group, or 1 without a factor."""
    return float(sheet.best[scaled.group[j]]) if scaled.group[j] >= 0 else 1.0


@inlined
def _range_of(sheet: ScaledWorkspace, g: int) -> float:
    """Return the largest distance of factor g from its value at the centre; zero for no factor (g < 0)."""
    return float(max(sheet.most[g] - sheet.best[g], sheet.best[g] - sheet.least[g])) if g >= 0 else 0.0


@inlined
def _greatest(sheet: ScaledWorkspace, g: int) -> float:
    """Return the greatest size of factor g in its range; 1 for no factor (g < 0)."""
    return float(max(size_of_factor(sheet, g), abs(sheet.best[g]))) if g >= 0 else 1.0


@inlined
def _change_of(box: Box, j: int) -> float:
    """Return the greatest difference of node j in a box from its value at the centre, in the unit of the node."""
    change = max(abs(box.nodes[j, LOW]), abs(box.nodes[j, HIGH]))
    for m in range(3):
        change += abs(box.nodes[j, SLOPE0 + m]) * box.half[m]
    return float(change)


@inlined
def _derive(scaled: Scaled, noise: float, box: Box, sheet: ScaledWorkspace) -> None:
    """Write derivatives of residual and factors, pulls, changes of derivatives, and half-widths of the coordinates.

    They are the fields `E`, `lean`, `force`, `tie`, `turn` and `reach` of `sheet`; `noise` bounds the rounding of a
    residual.
    """
    nodes, E, lean, back, third = box.nodes, sheet.E, sheet.lean, sheet.back, sheet.third
    (q, J), G = scaled.cost.K.shape, back.shape[0]
    for j in range(J):
        sheet.force[j] = 0.0
        for i in range(q):
            sheet.force[j] -= scaled.cost.K[i, j] * sheet.w[i]
    for m in range(3):
        sheet.reach[m] = box.half[m]
        for g in range(G):  # sum of forces times slopes, then times the inverse of R, in unused memory
            third[g, m] = third[G + g, m] = 0.0
        for i in range(q):
            E[i, m] = 0.0
            for j in range(J):
                E[i, m] += factor_of(scaled, sheet, j) * sheet.K[i, j] * nodes[j, SLOPE0 + m]
        for j in range(J):
            if scaled.group[j] >= 0:
                third[scaled.group[j], m] += sheet.force[j] * nodes[j, SLOPE0 + m]
        for g in range(G):
            for h in range(g + 1):
                third[G + g, m] += back[h, g] * third[h, m]
            for i in range(q):
                E[i, m] -= sheet.unit[i, g] * third[G + g, m]
        for g in range(G):
            lean[g, m] = 0.0
            for h in range(g, G):
                along = third[G + h, m]
                for j in range(J):
                    along += factor_of(scaled, sheet, j) * sheet.pull[h, j] * nodes[j, SLOPE0 + m]
                lean[g, m] -= back[g, h] * along
    for g in range(G):
        sheet.reach[3 + g] = _reach_of(scaled, noise, g, box, sheet)
    for j in range(J):
        _set_turn(scaled, j, box, sheet)
    third[:] = 0.0


@inlined
def _reach_of(scaled: Scaled, noise: float, g: int, box: Box, sheet: ScaledWorkspace) -> float:
    """Return the largest coordinate t_g of factor g in a box, at points whose factors are best.

    `noise` bounds the rounding of a residual.
    """
    nodes, half, G, reach = box.nodes, box.half, sheet.back.shape[0], sheet.spin[g] + noise
    for m in range(3):
        reach += abs(sheet.third[G + g, m]) * half[m]
    for j in range(nodes.shape[0]):
        size = max(abs(nodes[j, LOW]), abs(nodes[j, HIGH]))
        reach += abs(sheet.pull[g, j]) * _greatest(sheet, scaled.group[j]) * size
    for h in range(G):
        for m in range(3):
            if not half[m] > 0.0:
                continue
            along = 0.0
            for j in range(nodes.shape[0]):
                along += sheet.pull[g, j] * nodes[j, SLOPE0 + m] * (1.0 if scaled.group[j] == h else 0.0)
            reach += _range_of(sheet, h) * abs(along) * half[m]
    return float(reach)


@inlined
def _set_turn(scaled: Scaled, j: int, box: Box, sheet: ScaledWorkspace) -> None:
    """Write the pulls on node j, and the changes over a box of its multiples in the derivatives of the residual."""
    nodes, g, G = box.nodes, scaled.group[j], sheet.back.shape[0]
    change = _change_of(box, j)
    for m in range(3):
        total = 0.0
        for i in range(sheet.E.shape[0]):
            total += scaled.cost.K[i, j] * sheet.E[i, m]
        sheet.tie[j, m] = total
        turn = _greatest(sheet, g) * box.curves[j, TURN0 + m] + _range_of(sheet, g) * abs(nodes[j, SLOPE0 + m])
        sheet.turn[j, m] = turn + (abs(sheet.lean[g, m]) * change if g >= 0 else 0.0)
    for h in range(G):
        sheet.tie[j, 3 + h] = sheet.pull[h, j]
        sheet.turn[j, 3 + h] = abs(sheet.back[g, h]) * change if g >= 0 else 0.0


@inlined
def _add_information(scaled: Scaled, noise: float, box: Box, sheet: ScaledWorkspace) -> None:
    """Add ``E'E`` and the gradient to the sums, and their rounding to the bounds of change.

    `noise` bounds the rounding of a residual.
    """
    sums, E, weight, share, longest = box.sums, sheet.E, scaled.cost.weight, relative_rounding(scaled.cost.K), 0.0
    for i in range(E.shape[0]):
        longest += sheet.w[i] * sheet.w[i]
        for k in range(3):
            sums[G0 + k] -= E[i, k] * sheet.w[i]
            for m in range(k, 3):
                sums[symmetric_entry(k, m)] += E[i, k] * E[i, m]
    longest = sqrt(longest)
    for k in range(3):
        sums[LENGTH0 + k] = sqrt(sums[symmetric_entry(k, k)])
    for k in range(3):
        blur = 0.0
        for j in range(weight.shape[0]):
            g = scaled.group[j]
            size = abs(factor_of(scaled, sheet, j) * box.nodes[j, SLOPE0 + k])
            size += abs(sheet.lean[g, k] * box.nodes[j, PHI]) if g >= 0 else 0.0
            blur += share * weight[j] * size
        sums[NOISE0 + k] = sums[LENGTH0 + k] * noise + blur * (longest + noise)
        for m in range(3):
            sums[C00 + symmetric_entry(k, m)] += 2.0 * blur * (sums[LENGTH0 + m] + blur)


@inlined
def _second(scaled: Scaled, j: int, k: int, m: int, box: Box, sheet: ScaledWorkspace) -> float:
    """Return the second derivative along the offsets k and m of node j times its factor."""
    own, g = factor_of(scaled, sheet, j) * box.curves[j, symmetric_entry(k, m)], scaled.group[j]
    if g < 0:
        return float(own)
    p = box.nodes[j]
    return float(own + p[SLOPE0 + k] * sheet.lean[g, m] + p[SLOPE0 + m] * sheet.lean[g, k])


@inlined
def _rest_of(scaled: Scaled, noise: float, j: int, box: Box, sheet: ScaledWorkspace) -> float:
    """Return the change of the force of node j over a box without its linear part; `noise` as in `_derive`."""
    A, nodes, G = scaled.cost.A, box.nodes, sheet.back.shape[0]
    rest = scaled.cost.weight[j] * noise
    for m in range(A.shape[0]):
        size = max(abs(nodes[m, LOW]), abs(nodes[m, HIGH]))
        rest += abs(A[j, m]) * _greatest(sheet, scaled.group[m]) * size
    J = A.shape[0]
    for h in range(G):
        for k in range(3):
            if not box.half[k] > 0.0:
                continue
            along = 0.0
            for m in range(J):
                along += A[j, m] * nodes[m, SLOPE0 + k] * (1.0 if scaled.group[m] == h else 0.0)
            rest += _range_of(sheet, h) * abs(along) * box.half[k]
    return float(rest)


@inlined
def _add_node(scaled: Scaled, noise: float, j: int, box: Box, sheet: ScaledWorkspace) -> float:
    """Add the second derivatives of node j times its force to the sums; return a bound of the norm of their change.

    `noise` bounds the rounding of a residual.
    """
    curves, sums, third, g, G = box.curves, box.sums, sheet.third, scaled.group[j], sheet.back.shape[0]
    force, rest, linear = sheet.force[j], _rest_of(scaled, noise, j, box, sheet), 0.0
    for n in range(3 + G):
        linear += abs(sheet.tie[j, n]) * sheet.reach[n]
    whole = abs(force) + linear + rest
    for k in range(3):
        for m in range(k, 3):
            at, second = symmetric_entry(k, m), _second(scaled, j, k, m, box, sheet)
            sums[at] += force * second
            sums[C00 + at] += rest * abs(second)
            for n in range(3 + G):
                third[n, at] += sheet.tie[j, n] * second
            if g >= 0:
                third[3 + G + g, at] += force * curves[j, at]
                turn = curves[j, TURN0 + k] * abs(sheet.lean[g, m]) + curves[j, TURN0 + m] * abs(sheet.lean[g, k])
                sums[C00 + at] += (linear + rest) * _range_of(sheet, g) * abs(curves[j, at]) + whole * turn
    if g >= 0:
        for h in range(g, G):
            for k in range(3):
                size, turn = abs(box.nodes[j, SLOPE0 + k]), curves[j, TURN0 + k]
                sheet.cross[h, k] += abs(sheet.back[g, h]) * (rest * size + whole * turn)
    return float(whole * _greatest(sheet, g) * curves[j, CHI])


@inlined
def _add_third(box: Box, sheet: ScaledWorkspace) -> None:
    """Add the linear changes of forces to the bounds of the Hessian's change along s, ``sums[C00:]``.

    They were summed over the nodes into ``sheet.third``, because they partly cancel.
    """
    G = sheet.back.shape[0]
    for at in range(6):
        for n in range(3 + G):
            box.sums[C00 + at] += abs(sheet.third[n, at]) * sheet.reach[n]
        for g in range(G):
            box.sums[C00 + at] += abs(sheet.third[3 + G + g, at]) * _range_of(sheet, g)


@inlined
def _add_mixed(scaled: Scaled, box: Box, sheet: ScaledWorkspace) -> None:
    """Add the linear changes of forces to the bounds of the change of entries between offsets and factors.

    These bounds are ``sheet.cross`` (G, 3 + G).
    """
    G = sheet.back.shape[0]
    for h in range(G):
        for k in range(3):
            for n in range(3 + G):
                total = 0.0
                for j in range(box.nodes.shape[0]):
                    if scaled.group[j] >= 0:
                        own = sheet.back[scaled.group[j], h] * box.nodes[j, SLOPE0 + k]
                        total += sheet.tie[j, n] * own
                sheet.cross[h, k] += abs(total) * sheet.reach[n]


@inlined
def _add_changes(scaled: Scaled, squares: bool, box: Box, sheet: ScaledWorkspace) -> None:
    """Add the change of ``E'E`` to the bounds of the Hessian's change; `squares`: including its positive part."""
    A, sums, turn, tie, G = scaled.cost.A, box.sums, sheet.turn, sheet.tie, sheet.back.shape[0]
    for j in range(A.shape[0]):
        for k in range(3 + G):
            for m in range(k, 3 + G):
                change = abs(tie[j, k]) * turn[j, m] + abs(tie[j, m]) * turn[j, k]
                if squares:
                    for other in range(A.shape[0]):
                        change += abs(A[j, other]) * turn[j, k] * turn[other, m]
                if m < 3:
                    sums[C00 + symmetric_entry(k, m)] += change
                else:
                    sheet.cross[m - 3, k] += change
                    if k >= 3 and k != m:
                        sheet.cross[k - 3, m] += change


@compiled
def is_convex_scaled(scaled: Scaled, margin: float, box: Box, sheet: ScaledWorkspace) -> bool:
    """Return whether the Hessian of f/2 exceeds `margin` over a whole box, at all factors within their ranges.

    If so, the box has at most one stationary point whose residual is short enough for these ranges.
    """
    away = sum_scaled(scaled, False, box, sheet) + margin
    if not away < inf:
        return False
    sums, cross, G = box.sums, sheet.cross, sheet.back.shape[0]
    d0 = sums[C00 + H00] + sums[C00 + H01] + sums[C00 + H02] + away
    d1 = sums[C00 + H01] + sums[C00 + H11] + sums[C00 + H12] + away
    d2 = sums[C00 + H02] + sums[C00 + H12] + sums[C00 + H22] + away
    for g in range(G):
        left = 1.0 - margin
        for k in range(3 + G):
            left -= cross[g, k]
        if not left > 0.0:
            return False
        d0, d1, d2 = d0 + cross[g, 0], d1 + cross[g, 1], d2 + cross[g, 2]
    second, third = box.half[1] != 0.0 or sums[LENGTH0 + 1] != 0.0, box.half[2] != 0.0 or sums[LENGTH0 + 2] != 0.0
    h0, h3, h5 = sums[H00] - d0, sums[H11] - d1, sums[H22] - d2
    return positive_along(h0, sums[H01], sums[H02], h3, sums[H12], h5, second, third)


@compiled
def clip_stationary(scaled: Scaled, box: Box, sheet: ScaledWorkspace) -> bool:
    """Write to `box.cut` the part of a box in which the cost may have a minimum; return False if no part remains.

    Interval Newton in the offsets, as in `optloc.proof.curvature.contract_to_minima`; without a finite bound of the
    Hessian's change, the whole box remains. `sheet.cross` bounds the changes of the Hessian's entries that belong to
    the factors. At a stationary point, half of these changes times `sheet.reach` limit the coordinate of each factor.
    """
    reset_cut(box.half, box.cut)
    ball = sum_scaled(scaled, True, box, sheet)
    if not ball < inf:
        return True
    sums, cross, reach, noise, G = (
        box.sums,
        sheet.cross,
        sheet.reach,
        rounding_of_residual(scaled, sheet),
        sheet.back.shape[0],
    )
    for _ in range(_ROUNDS):
        for g in range(G):
            own = 0.0
            for k in range(3 + G):
                own += cross[g, k] * reach[k]
            reach[3 + g] = min(reach[3 + g], 0.5 * own + noise)
    for k in range(3):
        for g in range(G):
            sums[NOISE0 + k] += 0.5 * cross[g, k] * reach[3 + g]
    contract_newton(box.half, sums, ball, box.cut, box.solve)
    return not is_empty(box.cut) and not is_concave_along(sums, ball, box.solve)


@compiled
def slope_of(box: Box, eps: float) -> float:
    """Return the margin of convexity for which the slope at the centre of a box lowers the cost by at most eps.

    If the Hessian of f/2 exceeds this margin over the box, no point of the box costs less than the centre by more than
    eps.
    """
    total = 0.0
    for k in range(3):
        slope = abs(box.sums[G0 + k]) + box.sums[NOISE0 + k]
        total += slope * slope
    return total / eps
