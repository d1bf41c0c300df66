"""Second derivatives of a cost with an unknown factor: boxes with one minimum, and boxes without a stationary point.

The coordinates are offsets times the factor, ``y = k s / k_c``, and the factor k. Then a node is the perspective of
phi, ``k phi(c + k_c y / k)``. It is linear along the factor at the centre. Its slope along y depends on the position
alone. The last coordinate is ``t = |a| (k - k_c) + u.J y``: the rows along u, with u and a as in
`optloc.proof.scaled.reduction`. In these coordinates the Hessian at the centre has no entry between y and t, and the
entry of t is 1.

The statements are about points whose factor fits their position best. All minima are such points, and so is the
cheapest point of each position.
"""

from __future__ import annotations

from math import inf, sqrt

from optloc.compute.jit import compiled, inlined
from optloc.compute.systems import positive_along
from optloc.proof.box import digits, uncut
from optloc.proof.curvature import (
    C00,
    G0,
    LENGTH0,
    NOISE0,
    bends_down,
    clip_newton,
    entry,
)
from optloc.proof.nodes.node import CHI, H00, H01, H02, H11, H12, H22, HIGH, LOW, SLOPE0, TURN0
from optloc.proof.scaled.reduction import (
    ALONG0,
    FACTOR,
    LEAST,
    LENGTH,
    MOST,
    SHORTEST,
    Scaled,
    Sheet,
    blur_of,
    unscale,
)
from optloc.proof.search_space import Box

# Share of the information that its rounding is below: sums over some tens of rows and nodes.
_ROUNDED = 1e-11
# Rounds in which the offsets narrow the factor, and it them.
_ROUNDS = 2


@compiled
def sum_scaled(scaled: Scaled, rho: float, box: Box, sheet: Sheet) -> tuple[float, float]:
    """Fill Hessian, gradient and bounds of their change over a box; return the bound of the rest's norm, and of t.

    Points count whose residuals are shorter than rho.

    Parameters
    ----------
    scaled : Scaled
        The cost.
    rho : float
        Longest residual of interest.
    box : Box
        Its nodes and their curves are filled; the sums are written, but for bounds of the change of the Hessian.
    sheet : Sheet
        Reduced rows with the range of the factor; derivatives and changes are written.
    """
    span, half = sheet.span, box.half
    factor, least, most = span[FACTOR], span[LEAST], span[MOST]
    if not (least > 0.0 and most < inf and span[LENGTH] > 0.0):
        return inf, inf
    _derive(scaled, box, sheet)
    reach = _narrow(scaled, rho, box, sheet)
    for m in range(3):
        sheet.half[m] = half[m] * span[MOST] / factor
    wide = sqrt(half[0] * half[0] + half[1] * half[1] + half[2] * half[2]) / (factor * span[LENGTH])
    lean = factor * sqrt(span[ALONG0] ** 2 + span[ALONG0 + 1] ** 2 + span[ALONG0 + 2] ** 2)
    return _sum_nodes(scaled, reach, wide, 1.0 + wide * lean, box, sheet), reach


@inlined
def _narrow(scaled: Scaled, rho: float, box: Box, sheet: Sheet) -> float:
    """Return the reach of the last coordinate at points whose factor is best, and narrow the range of the factor to it.

    There the residual is orthogonal to the column of the factor at the point. The angle between this column and u
    bounds the residual along u: its sine times the length of the residual.
    """
    span, half, nodes, weight = sheet.span, box.half, box.nodes, scaled.cost.weight
    factor, most, sine, bend, lean = span[FACTOR], span[MOST], 0.0, 0.0, 0.0
    for m in range(3):
        square = 0.0
        for i in range(sheet.J.shape[0]):
            square += sheet.J[i, m] * sheet.J[i, m]
        sine += sqrt(square) * half[m] / factor
        lean += abs(span[ALONG0 + m]) * half[m] * most
    for j in range(nodes.shape[0]):
        size = max(abs(nodes[j, LOW]), abs(nodes[j, HIGH]))
        sine += weight[j] * size
        bend += abs(sheet.pull[j]) * size
    blur = blur_of(scaled, sheet)
    sine = (sine + blur) / span[SHORTEST] if span[SHORTEST] > 0.0 else 1.0
    reach = rho * min(sine, 1.0) + most * bend + blur
    apart = (reach + lean) / span[LENGTH] * (1.0 + _ROUNDED)
    span[LEAST], span[MOST] = max(span[LEAST], factor - apart), min(most, factor + apart)
    return float(reach)


@inlined
def _derive(scaled: Scaled, box: Box, sheet: Sheet) -> None:
    """Write the derivatives of the rows, their pulls on the nodes and the changes of the nodes' gradients."""
    K, nodes, curves, span, half = scaled.cost.K, box.nodes, box.curves, sheet.span, box.half
    factor = span[FACTOR]
    for i in range(K.shape[0]):
        for m in range(3):
            total = 0.0
            for j in range(K.shape[1]):
                total += sheet.K[i, j] * nodes[j, SLOPE0 + m]
            sheet.J[i, m] = factor * total
    for j in range(K.shape[1]):
        change = max(abs(nodes[j, LOW]), abs(nodes[j, HIGH]))
        for m in range(3):
            change += curves[j, TURN0 + m] * half[m] if half[m] > 0.0 else 0.0
            total = 0.0
            for i in range(K.shape[0]):
                total += sheet.K[i, j] * sheet.J[i, m]
            sheet.tie[j, m] = total
        change /= span[LENGTH]
        sheet.turn[j, 3], sheet.tie[j, 3] = change, sheet.pull[j]
        for m in range(3):
            sheet.turn[j, m] = factor * (curves[j, TURN0 + m] + abs(span[ALONG0 + m]) * change)


@inlined
def _sum_nodes(scaled: Scaled, reach: float, wide: float, grow: float, box: Box, sheet: Sheet) -> float:
    """Write the sums of a box; return a bound of the norm of the change of the Hessian that no entry counts.

    Along each coordinate the forces of the nodes change together, so that their Hessians are summed with their signs.
    """
    K, sums, third, turned = scaled.cost.K, box.sums, sheet.third, 0.0
    factor, noise, longest = sheet.span[FACTOR], blur_of(scaled, sheet), 0.0
    greatest = factor * factor / sheet.span[LEAST]
    # By how much the square of the factor over k may differ from the factor.
    stretch = factor * max(factor / sheet.span[LEAST] - 1.0, 1.0 - factor / sheet.span[MOST])
    sums[:], sheet.cross[:], third[:] = 0.0, 0.0, 0.0
    for i in range(K.shape[0]):
        longest += sheet.w[i] * sheet.w[i]
        for k in range(3):
            sums[G0 + k] -= sheet.J[i, k] * sheet.w[i]
            for m in range(k, 3):
                sums[entry(k, m)] += sheet.J[i, k] * sheet.J[i, m]
    longest = sqrt(longest)
    for k in range(3):
        sums[LENGTH0 + k] = sqrt(sums[entry(k, k)])
    share = noise + digits(K) * longest
    for j in range(K.shape[1]):
        turned += _add_node(scaled, reach, share, greatest, grow, wide, j, box, sheet)
    size = 0.0
    for at in range(6):
        change = abs(third[3, at]) * reach + third[5, at]
        for m in range(3):
            change += abs(third[m, at]) * sheet.half[m]
        sums[at] += factor * third[4, at]
        sums[C00 + at] += change * greatest + abs(third[4, at]) * stretch
        size += (abs(third[4, at]) + change) * (1.0 if at in (H00, H11, H22) else 2.0)
    _add_rounding(scaled, longest, noise, box, sheet)
    turned += size * greatest * (grow * grow - 1.0 + grow * wide + wide * wide)
    return float(turned + _ROUNDED * (sums[H00] + sums[H11] + sums[H22]))


@inlined
def _add_node(
    scaled: Scaled,
    reach: float,
    blur: float,
    greatest: float,
    grow: float,
    wide: float,
    j: int,
    box: Box,
    sheet: Sheet,
) -> float:
    """Add the Hessian of a node times its force and its pulls to the sums; return what the change of it adds."""
    K, A, nodes, curves, third = scaled.cost.K, scaled.cost.A, box.nodes, box.curves, sheet.third
    force, rest, linear = 0.0, scaled.cost.weight[j] * blur, abs(sheet.pull[j]) * reach
    for i in range(K.shape[0]):
        force -= K[i, j] * sheet.w[i]
    for m in range(3):
        linear += abs(sheet.tie[j, m]) * sheet.half[m]
    for m in range(K.shape[1]):
        rest += abs(A[j, m]) * sheet.span[MOST] * max(abs(nodes[m, LOW]), abs(nodes[m, HIGH]))
    for at in range(6):
        own = curves[j, at]
        for m in range(4):
            third[m, at] += sheet.tie[j, m] * own
        third[4, at] += force * own
        third[5, at] += rest * abs(own)
    turned = greatest * curves[j, CHI] * (grow * grow + grow * wide + wide * wide)
    return float((abs(force) + linear + rest) * turned)


@inlined
def _add_rounding(scaled: Scaled, longest: float, noise: float, box: Box, sheet: Sheet) -> None:
    """Add the rounding of derivatives to the bounds of the gradient and of the Hessian's change."""
    K, weight, nodes, sums, share = scaled.cost.K, scaled.cost.weight, box.nodes, box.sums, digits(scaled.cost.K)
    for k in range(3):
        blur = 0.0
        for j in range(K.shape[1]):
            blur += share * weight[j] * sheet.span[FACTOR] * abs(nodes[j, SLOPE0 + k])
        sums[NOISE0 + k] = sums[LENGTH0 + k] * noise + blur * (longest + noise)
        for m in range(3):
            sums[C00 + entry(k, m)] += 2.0 * blur * (sums[LENGTH0 + m] + blur)


@inlined
def _add_changes(scaled: Scaled, squares: bool, box: Box, sheet: Sheet) -> None:
    """Add the change of ``J'J`` to the bounds of the Hessian's change; `squares`: the positive part of it as well."""
    A, sums, turn, tie = scaled.cost.A, box.sums, sheet.turn, sheet.tie
    for j in range(A.shape[0]):
        for k in range(4):
            for m in range(k, 4):
                change = abs(tie[j, k]) * turn[j, m] + abs(tie[j, m]) * turn[j, k]
                if squares:
                    for other in range(A.shape[0]):
                        change += abs(A[j, other]) * turn[j, k] * turn[other, m]
                if m < 3:
                    sums[C00 + entry(k, m)] += change
                else:
                    sheet.cross[k] += change


@compiled
def is_convex_scaled(scaled: Scaled, rho: float, margin: float, box: Box, sheet: Sheet) -> bool:
    """Return whether the Hessian of f/2 exceeds `margin` all over a box, at every factor of interest.

    Then the box has one stationary point at most whose residual is shorter than rho.
    """
    ball, _ = sum_scaled(scaled, rho, box, sheet)
    if not ball < inf:
        return False
    _add_changes(scaled, False, box, sheet)
    sums, cross, away = box.sums, sheet.cross, ball + margin
    d0 = sums[C00 + H00] + sums[C00 + H01] + sums[C00 + H02] + cross[0]
    d1 = sums[C00 + H01] + sums[C00 + H11] + sums[C00 + H12] + cross[1]
    d2 = sums[C00 + H02] + sums[C00 + H12] + sums[C00 + H22] + cross[2]
    if not 1.0 - cross[0] - cross[1] - cross[2] - cross[3] - away > 0.0:
        return False
    second, third = box.half[1] != 0.0 or sums[LENGTH0 + 1] != 0.0, box.half[2] != 0.0 or sums[LENGTH0 + 2] != 0.0
    h0, h3, h5 = sums[H00] - d0 - away, sums[H11] - d1 - away, sums[H22] - d2 - away
    return positive_along(h0, sums[H01], sums[H02], h3, sums[H12], h5, second, third)


@compiled
def clip_stationary(scaled: Scaled, rho: float, box: Box, sheet: Sheet) -> bool:
    """Clip a box to where a minimum with a residual shorter than rho may be; or return False for no such place.

    Interval Newton in the offsets, as `optloc.proof.curvature.clip_to_stationary`. The last coordinate of a stationary
    point is as far from zero as the entries of its row change.
    """
    uncut(box.half, box.cut)
    ball, reach = sum_scaled(scaled, rho, box, sheet)
    if not ball < inf:
        return True
    _add_changes(scaled, True, box, sheet)
    sums, cross, h, span = box.sums, sheet.cross, sheet.half, sheet.span
    length = sqrt(h[0] * h[0] + h[1] * h[1] + h[2] * h[2])
    noise = blur_of(scaled, sheet)
    for _ in range(_ROUNDS):
        own = cross[0] * h[0] + cross[1] * h[1] + cross[2] * h[2] + cross[3] * reach
        reach = min(reach, 0.5 * (own + ball * (length + reach)) + noise)
    for k in range(3):
        sums[NOISE0 + k] += 0.5 * (cross[k] + ball) * reach
    uncut(h, box.cut)
    clip_newton(h, sums, ball, box.cut, box.solve)
    if box.cut[0] > box.cut[3] or box.cut[1] > box.cut[4] or box.cut[2] > box.cut[5]:
        return False
    if bends_down(sums, ball, box.solve):
        return False
    unscale(box, box.half, span[FACTOR] / span[MOST], span[FACTOR] / span[LEAST])
    return True


@compiled
def slope_of(box: Box, eps: float) -> float:
    """Return the margin of convexity at which the slope at the centre of a box lowers the cost by eps at most."""
    total = 0.0
    for k in range(3):
        slope = abs(box.sums[G0 + k]) + box.sums[NOISE0 + k]
        total += slope * slope
    return total / eps
