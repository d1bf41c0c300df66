"""A box of a cost with unknown factors: the factors are projected out of the rows, and their ranges are bounded.

The cost is ``f(x, k) = |sum_g k_g (K_g phi(x) + l_g) + K_0 phi(x) - w|^2`` with factors k >= 0, such as an unknown
speed of waves. Letters: G factors, J nodes phi (scalar functions of the position, such as ranges), q whitened rows.
Each node belongs to one factor or to none. A prior on a factor is a row in which K is zero. At the centre c of a box
the columns of the factors are ``a_g = K_g phi(c) + l_g``. With ``A = U R``, U orthonormal, and ``P = 1 - U U'`` follows
``P A = 0``. So no x of the box and no k cost less than

    |P (sum_g k_g K_g (phi(x) - phi(c)) + K_0 phi(x) - w)|^2.

So all bounds of rows hold for the projected rows, in which each node is multiplied by the middle of its factor's range.
A factor may differ from the middle. This difference times the slopes of its nodes is one more node without slopes for
each coordinate. The column of this node is the projected derivative of the rows along the coordinate. The rows along U
bound k. At each position the residual of the best factors is orthogonal to their columns, so the ranges shrink with the
box.

The components of a target's velocity at one epoch are factors, too, and may be negative. Their nodes are components of
unit vectors from stations. The bounds that need ``k >= 0`` then hold for the sizes of the factors.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined
from optloc.proof.box import (
    DIRECTION,
    ROW_WIDTH,
    contract_box,
    least_residual,
    linearise_rows,
    relative_rounding,
    reset_cut,
)
from optloc.proof.nodes.node import HIGH, LOW, NODE_WIDTH, PHI, SLOPE0
from optloc.proof.search_space import Box, Cost

# Factor for the rounding of projected rows: each number is in three more sums than in the original rows.
_PROJECTED = 4.0
# Relative rounding of a bound of a factor.
_ROUNDED = 1e-12
# Least share of a column that must remain after projection by the columns of other factors: less is rounding.
_DEPENDENT = 1e-10
# Numbers of a box: the cost at its centre, and the sizes that limit the accuracy.
HERE, FLOOR, SPAN = range(3)


class Scaled(NamedTuple):
    """A cost with unknown factors.

    Parameters
    ----------
    cost : Cost
        Nodes, rows and measurements.
    lift : array (q, G)
        Constant parts of the columns of the factors: not zero only in rows of priors.
    group : int array (J,)
        The factor of each node, -1 for none.
    free : bool
        Whether factors may be negative.
    """

    cost: Cost
    lift: Array
    group: Array
    free: bool


class ScaledWorkspace(NamedTuple):
    """Working memory for one box.

    Parameters
    ----------
    K, w : array (q, J + 3 G), (q,)
        Projected rows and residuals at the centre. The last columns belong to the ranges of the factors along each
        coordinate.
    weight : array (J + 3 G,)
        Lengths of the columns of K: before the projection, or after it for nodes without a lower bound.
    nodes, rows : array (J + 3 G, NODE_WIDTH), (q, ROW_WIDTH)
        Nodes times factors, without their values; rows over them.
    unit, pull, V : array (q, G), (G, J), (G, J)
        U, ``U'K``, and ``R^-1 U'K``.
    back : array (G, G)
        The inverse of R.
    best, least, most : array (G,)
        Best factors at the centre, of any sign, and the ranges of the factors.
    fall, rise : array (G, G + 1)
        Largest decrease and increase of each factor by the change of the columns of factors. The last column is the
        change by the nodes without a factor.
    spin : array (G,)
        Longest residual along each column of U.
    span : array (SPAN,)
        Numbers of the box.
    E, lean : array (q, 3), (G, 3)
        Derivatives of the residual along the offsets, and of the factors.
    force : array (J,)
        Pulls of the nodes on the residual at the centre, ``K'(residual)``.
    turn, tie : array (J, 3 + G), (J, 3 + G)
        Changes of derivatives over a box as multiples of the rows, and pulls ``K'E``. The last columns belong to the
        factors.
    cross : array (G, 3 + G)
        Changes of the entries of the Hessian that belong to the factors.
    third : array (3 + 2 G, 6)
        Sums of the nodes' second derivatives: times their pulls along all coordinates, and for each factor times
        forces.
    reach : array (3 + G,)
        Half-widths of the box, and of the coordinates of the factors.
    """

    K: Array
    w: Array
    weight: Array
    nodes: Array
    rows: Array
    unit: Array
    pull: Array
    V: Array
    back: Array
    best: Array
    least: Array
    most: Array
    fall: Array
    rise: Array
    spin: Array
    span: Array
    E: Array
    lean: Array
    force: Array
    turn: Array
    tie: Array
    cross: Array
    third: Array
    reach: Array


@compiled
def workspace_of(scaled: Scaled) -> ScaledWorkspace:
    """Return working memory for boxes of a cost."""
    q, J = scaled.cost.K.shape
    G = scaled.lift.shape[1]
    wide = J + 3 * G
    return ScaledWorkspace(
        np.zeros((q, wide)),
        np.zeros(q),
        np.zeros(wide),
        np.zeros((wide, NODE_WIDTH)),
        np.zeros((q, ROW_WIDTH)),
        np.zeros((q, G)),
        np.zeros((G, J)),
        np.zeros((G, J)),
        np.zeros((G, G)),
        np.zeros(G),
        np.zeros(G),
        np.zeros(G),
        np.zeros((G, G + 1)),
        np.zeros((G, G + 1)),
        np.zeros(G),
        np.zeros(SPAN),
        np.zeros((q, 3)),
        np.zeros((G, 3)),
        np.zeros(J),
        np.zeros((J, 3 + G)),
        np.zeros((J, 3 + G)),
        np.zeros((G, 3 + G)),
        np.zeros((3 + 2 * G, 6)),
        np.zeros(3 + G),
    )


@compiled
def reduce_rows(scaled: Scaled, floor: float, box: Box, sheet: ScaledWorkspace) -> None:
    """Project the factors out of the rows at the centre of a box whose nodes are bounded.

    `floor` is the size of measurements and coordinates that limits the accuracy of residuals. All of `sheet` is written
    except the ranges of the factors. If the columns are dependent, `best` is NaN. A logarithm without a lower bound
    counts from its upper end. At the centre it may be far below all other values. The cost at the centre is then
    infinite.
    """
    K, weight, nodes, lift = scaled.cost.K, scaled.cost.weight, box.nodes, scaled.lift
    (q, J), G, size, unit, w = K.shape, lift.shape[1], floor, sheet.unit, sheet.w
    closed = True
    for j in range(J):
        if nodes[j, LOW] == -inf:
            nodes[j, PHI] += nodes[j, HIGH]
            nodes[j, HIGH], closed = 0.0, False
    for j in range(J):
        sheet.weight[j] = weight[j]
        size += weight[j] * abs(nodes[j, PHI])
    for i in range(q):
        w[i] = scaled.cost.w[i]
        for g in range(G):
            unit[i, g] = lift[i, g]
            size += abs(lift[i, g])
        for j in range(J):
            if scaled.group[j] < 0:
                w[i] -= K[i, j] * nodes[j, PHI]
            else:
                unit[i, scaled.group[j]] += K[i, j] * nodes[j, PHI]
    sheet.span[FLOOR] = _PROJECTED * size
    _orthogonalise(sheet)
    _project(scaled, sheet)
    if not closed:
        sheet.span[HERE] = inf


@inlined
def _orthogonalise(sheet: ScaledWorkspace) -> None:
    """Replace the columns of the factors by orthonormal ones, each projected twice, and write the inverse of R."""
    unit, back, good = sheet.unit, sheet.back, True
    q, G = unit.shape
    back[:] = 0.0
    for g in range(G):
        whole = left = 0.0
        for i in range(q):
            whole += unit[i, g] * unit[i, g]
        sheet.spin[:] = 0.0
        for _ in range(2 if g > 0 else 0):
            for h in range(g):
                along = 0.0
                for i in range(q):
                    along += unit[i, h] * unit[i, g]
                sheet.spin[h] += along
                for i in range(q):
                    unit[i, g] -= along * unit[i, h]
        for i in range(q):
            left += unit[i, g] * unit[i, g]
        length, apart = sqrt(left), sqrt(left) > _DEPENDENT * sqrt(whole)
        good, per = good and apart, 1.0 / length if apart else 0.0
        for i in range(q):
            unit[i, g] *= per
        for m in range(g):
            for h in range(m, g):
                back[m, g] -= back[m, h] * sheet.spin[h] * per
        back[g, g] = per
    sheet.best[:] = 0.0 if good else np.nan


@inlined
def _project(scaled: Scaled, sheet: ScaledWorkspace) -> None:
    """Write the projected rows and measurements, the factors at the centre, and the cost there (``span[HERE]``)."""
    K, unit, back, w, here = scaled.cost.K, sheet.unit, sheet.back, sheet.w, 0.0
    (q, J), G = K.shape, unit.shape[1]
    for g in range(G):
        along = 0.0
        for i in range(q):
            along += unit[i, g] * w[i]
        sheet.spin[g] = along
        for i in range(q):
            w[i] -= unit[i, g] * along
    for g in range(G):
        for h in range(g, G):
            sheet.best[g] += back[g, h] * sheet.spin[h]
    for i in range(q):
        here += w[i] * w[i]
        for j in range(J):
            sheet.K[i, j] = K[i, j]
    sheet.span[HERE] = here if scaled.free else here + _forwards(sheet)
    for j in range(J):
        for g in range(G):
            total = 0.0
            for i in range(q):
                total += unit[i, g] * K[i, j]
            sheet.pull[g, j] = total
            for i in range(q):
                sheet.K[i, j] -= unit[i, g] * total
    for j in range(J):
        for g in range(G):
            sheet.V[g, j] = 0.0
            for h in range(g, G):
                sheet.V[g, j] += back[g, h] * sheet.pull[h, j]


@inlined
def _forwards(sheet: ScaledWorkspace) -> float:
    """Return the cost that is added if a best factor is negative, but may not be: all factors become zero."""
    G, cost = sheet.best.shape[0], 0.0
    low = 0
    for g in range(G):
        low += int(not sheet.best[g] >= 0.0)
    if low == 0:
        return 0.0
    if G == 1:
        return sheet.spin[0] ** 2 if sheet.back[0, 0] > 0.0 else 0.0
    for g in range(G):
        cost += sheet.spin[g] ** 2
    return cost


@compiled
def bound_factors(scaled: Scaled, rho: float, box: Box, sheet: ScaledWorkspace) -> bool:
    """Write the ranges of factors (`least`, `most`) for points of a box with residuals shorter than rho.

    Return False if a range is empty. `is_bounded` then tests whether all factors have bounds. The rows must be reduced.
    The factors obey ``k = best + R^-1 U'(residual) - R^-1 U'(change of the rows)``, and the change grows with k. So the
    greatest factors follow from a system whose inverse has no negative entry, or from priors.
    """
    G, least, most, spin = sheet.best.shape[0], sheet.least, sheet.most, sheet.spin
    blur, bounded = relative_rounding(scaled.cost.K) * sheet.span[FLOOR], True
    least[:], most[:], spin[:] = -inf if scaled.free else 0.0, inf, rho + blur
    if not scaled.free:
        _bound_by_priors(scaled, rho, sheet)
    for g in range(G):
        if not sheet.best[g] > -inf:
            return True
    _swing(scaled, blur, box, sheet)
    if not _solve_swing(scaled.free, sheet, blur):
        return False
    for g in range(G):
        bounded = bounded and most[g] < inf
    if not bounded:
        most[:] = inf
        return True
    if scaled.free:
        for g in range(G):
            least[g] = -most[g]
    if not _narrow(scaled.free, sheet, blur):
        return False
    _set_slopes(scaled, box, sheet)
    for g in range(G):
        if not (least[g] > 0.0 or scaled.free):
            return True
    # For the best factors the residual is orthogonal to their columns. The smaller the box, the closer these columns
    # are to U.
    _turn(scaled, rho + blur, box, sheet)
    return _narrow(scaled.free, sheet, blur)


@inlined
def _bound_by_priors(scaled: Scaled, rho: float, sheet: ScaledWorkspace) -> None:
    """Narrow the ranges of the factors by the rows of priors: the last rows, one for each factor.

    The residual of each of these rows is at most rho.
    """
    lift, w = scaled.lift, scaled.cost.w
    q, G = lift.shape
    for g in range(G):
        i = q - G + g
        if lift[i, g] > 0.0:
            per = 1.0 / lift[i, g]
            sheet.most[g] = max((w[i] + rho) * per * (1.0 + _ROUNDED), 0.0)
            sheet.least[g] = max((w[i] - rho) * per * (1.0 - _ROUNDED), 0.0)


@inlined
def _swing(scaled: Scaled, blur: float, box: Box, sheet: ScaledWorkspace) -> None:
    """Write the greatest decrease (`fall`) and increase (`rise`) of the factors by the change of the rows over a box.

    `blur` bounds the rounding of a residual.
    """
    # `third` is unused so far. Row h of `slopes` is for the nodes of factor h, row G for nodes without a factor.
    nodes, half, V, slopes = box.nodes, box.half, sheet.V, sheet.third
    G, J = V.shape
    for g in range(G):
        slopes[: G + 1], sheet.fall[g], sheet.rise[g] = 0.0, 0.0, 0.0
        for j in range(J):
            pull, h = V[g, j], scaled.group[j] if scaled.group[j] >= 0 else G
            if pull == 0.0:
                continue
            first, second = pull * nodes[j, LOW], pull * nodes[j, HIGH]
            sheet.fall[g, h] -= min(first, second, 0.0)
            sheet.rise[g, h] += max(first, second, 0.0)
            for k in range(3):
                slopes[h, k] += pull * nodes[j, SLOPE0 + k]
        rounded = 0.0
        for m in range(g, G):
            rounded += abs(sheet.back[g, m]) * blur
        for h in range(G + 1):
            both = abs(slopes[h, 0]) * half[0] + abs(slopes[h, 1]) * half[1] + abs(slopes[h, 2]) * half[2] + rounded
            sheet.fall[g, h], sheet.rise[g, h] = sheet.fall[g, h] + both, sheet.rise[g, h] + both
            if scaled.free:  # for a factor of any sign, a decrease may be an increase
                sheet.fall[g, h] = sheet.rise[g, h] = max(sheet.fall[g, h], sheet.rise[g, h])


@inlined
def size_of_factor(sheet: ScaledWorkspace, g: int) -> float:
    """Return the greatest size of a factor in its range."""
    return float(max(sheet.most[g], -sheet.least[g]))


@inlined
def _reach_of(sheet: ScaledWorkspace, g: int, blur: float) -> float:
    """Return the greatest distance of factor g from its best value that residuals up to `spin` along U allow."""
    total = 0.0
    for h in range(g, sheet.best.shape[0]):
        total += abs(sheet.back[g, h]) * (sheet.spin[h] + blur)
    return float(total + _ROUNDED * (abs(sheet.best[g]) + total))


@inlined
def _narrow(free: bool, sheet: ScaledWorkspace, blur: float) -> bool:
    """Narrow the ranges of the factors, which are bounded; return False if a range is empty. `blur` as in `_swing`."""
    G, least, most, fall, rise = sheet.best.shape[0], sheet.least, sheet.most, sheet.fall, sheet.rise
    for g in range(G):
        reach = _reach_of(sheet, g, blur)
        high, low = sheet.best[g] + reach + fall[g, G], sheet.best[g] - reach - rise[g, G]
        for h in range(G):
            if free:
                change = fall[g, h] * size_of_factor(sheet, h)
                high, low = high + change, low - change
            elif h != g:
                high += fall[g, h] * most[h] if fall[g, h] > 0.0 else 0.0
                low -= rise[g, h] * most[h] if rise[g, h] > 0.0 else 0.0
        if free:
            slack = _ROUNDED * (abs(high) + abs(low))
            most[g], least[g] = min(most[g], high + slack), max(least[g], low - slack)
        elif fall[g, g] < 1.0:
            most[g] = min(most[g], high / (1.0 - fall[g, g]) * (1.0 + _ROUNDED))
        if not free and low > 0.0:
            least[g] = max(least[g], low / (1.0 + rise[g, g]) * (1.0 - _ROUNDED))
        if not most[g] > least[g]:
            return False
    return True


@inlined
def _solve_swing(free: bool, sheet: ScaledWorkspace, blur: float) -> bool:
    """Bound the greatest factors by ``(1 - N) k <= best + reach``; return False if there is no solution k >= 0.

    N is `sheet.fall`. If factors may be negative, k are their sizes. If all pivots are positive, the inverse of 1 - N
    has no negative entry (an M-matrix). The elimination has no pivoting.
    """
    G, most = sheet.best.shape[0], sheet.most
    matrix, right = sheet.cross, sheet.reach  # unused memory
    for g in range(G):
        start = abs(sheet.best[g]) if free else sheet.best[g]
        right[g] = start + _reach_of(sheet, g, blur) + sheet.fall[g, G]
        for h in range(G):
            matrix[g, h] = (1.0 if g == h else 0.0) - sheet.fall[g, h]
    for p in range(G):
        if not (matrix[p, p] > _ROUNDED and right[p] < inf):  # no M-matrix, so no bound from this system
            return True
        for g in range(p + 1, G):
            share = matrix[g, p] / matrix[p, p]
            for h in range(p, G):
                matrix[g, h] -= share * matrix[p, h]
            right[g] -= share * right[p]
    for p in range(G - 1, -1, -1):
        for h in range(p + 1, G):
            right[p] -= matrix[p, h] * right[h]
        right[p] /= matrix[p, p]
        if right[p] < 0.0:
            return False
        right[p] *= 1.0 + _ROUNDED
        most[p] = min(most[p], right[p])
    return True


@inlined
def _set_slopes(scaled: Scaled, box: Box, sheet: ScaledWorkspace) -> None:
    """Write the derivatives of the columns of the factors along each coordinate into the last columns of ``sheet.K``.

    They are not projected yet.
    """
    K, nodes, J = scaled.cost.K, box.nodes, box.nodes.shape[0]
    sheet.K[:, J:] = 0.0
    for j in range(J):
        for k in range(3):
            slope, column = nodes[j, SLOPE0 + k], J + 3 * scaled.group[j] + k
            if scaled.group[j] >= 0 and slope != 0.0:
                for i in range(K.shape[0]):
                    sheet.K[i, column] += K[i, j] * slope


@inlined
def _turn(scaled: Scaled, rho: float, box: Box, sheet: ScaledWorkspace) -> None:
    """Write the greatest length of residuals along U into `spin`, for factors that are best at their position."""
    nodes, half, back = box.nodes, box.half, sheet.back
    J, G = nodes.shape[0], back.shape[0]
    sheet.spin[:] = 0.0
    for g in range(G):
        change = 0.0
        for k in range(3):
            change += _length_of(sheet, J + 3 * g + k) * half[k] if half[k] > 0.0 else 0.0
        for j in range(J):
            if scaled.group[j] == g:
                change += scaled.cost.weight[j] * max(abs(nodes[j, LOW]), abs(nodes[j, HIGH]))
        for h in range(g, G):
            sheet.spin[h] += abs(back[g, h]) * change
    for h in range(G):
        sheet.spin[h] = rho * min(sheet.spin[h] * (1.0 + _ROUNDED), 1.0)


@compiled
def bound_rows(scaled: Scaled, box: Box, sheet: ScaledWorkspace) -> float:
    """Return a lower bound of the residual over a box whose factors are bounded; negative if no bound is known."""
    nodes, out, G = box.nodes, sheet.nodes, sheet.best.shape[0]
    if not is_bounded(sheet):
        return -1.0
    J = nodes.shape[0]
    for j in range(J):
        g = scaled.group[j]
        most = sheet.most[g] if g >= 0 else 1.0
        middle = 0.5 * (sheet.least[g] + most) if g >= 0 else 1.0
        out[j, PHI] = 0.0
        for k in range(3):
            out[j, SLOPE0 + k] = middle * nodes[j, SLOPE0 + k]
        out[j, LOW], out[j, HIGH] = most * min(nodes[j, LOW], 0.0), most * max(nodes[j, HIGH], 0.0)
        if scaled.free and g >= 0:
            wide = 0.5 * (most - sheet.least[g]) * max(abs(nodes[j, LOW]), abs(nodes[j, HIGH]))
            first, last = middle * nodes[j, LOW], middle * nodes[j, HIGH]
            out[j, LOW], out[j, HIGH] = min(first, last) - wide, max(first, last) + wide
        sheet.weight[j] = scaled.cost.weight[j] if out[j, LOW] > -inf else _length_of(sheet, j)
    for g in range(G):
        _add_range(g, box, sheet)
    linearise_rows(sheet.K, sheet.w, out, sheet.rows)
    low = least_residual(sheet.K, sheet.weight, size_of(sheet), box.half, out, sheet.rows)
    return float(low) if _has_signs(scaled, sheet) else -1.0


@inlined
def _length_of(sheet: ScaledWorkspace, j: int) -> float:
    """Return the length of column j of the rows ``sheet.K``."""
    square = 0.0
    for i in range(sheet.K.shape[0]):
        square += sheet.K[i, j] * sheet.K[i, j]
    return sqrt(square)


@inlined
def _has_signs(scaled: Scaled, sheet: ScaledWorkspace) -> bool:
    """Return whether nodes without a lower bound only add to the residual along its direction, beyond rounding.

    Otherwise the bound of the residual is not valid.
    """
    good = True
    for j in range(scaled.cost.K.shape[1]):
        if sheet.nodes[j, LOW] == -inf:
            total = square = 0.0
            for i in range(sheet.K.shape[0]):
                total += sheet.K[i, j] * sheet.rows[i, DIRECTION]
                square += sheet.rows[i, DIRECTION] ** 2
            good = good and -total > relative_rounding(sheet.K) * scaled.cost.weight[j] * sqrt(square)
    return good


@inlined
def _add_range(g: int, box: Box, sheet: ScaledWorkspace) -> None:
    """Project the columns of the range of a factor; write half of its range times the half-widths of the box."""
    K, out, J, unit = sheet.K, sheet.nodes, box.nodes.shape[0], sheet.unit
    wide = 0.5 * (sheet.most[g] - sheet.least[g])
    for k in range(3):
        column = J + 3 * g + k
        out[column, :] = 0.0
        if not box.half[k] > 0.0:
            continue
        sheet.weight[column] = _length_of(sheet, column)
        for h in range(unit.shape[1]):
            along = 0.0
            for i in range(K.shape[0]):
                along += unit[i, h] * K[i, column]
            for i in range(K.shape[0]):
                K[i, column] -= unit[i, h] * along
        out[column, LOW], out[column, HIGH] = -wide * box.half[k], wide * box.half[k]


@inlined
def is_bounded(sheet: ScaledWorkspace) -> bool:
    """Return whether all factors are bounded, and independent at the centre of the box."""
    good = True
    for g in range(sheet.best.shape[0]):
        good = good and sheet.most[g] < inf and sheet.best[g] > -inf
    return good


@inlined
def is_positive(sheet: ScaledWorkspace) -> bool:
    """Return whether all factors are bounded and greater than zero."""
    good = is_bounded(sheet)
    for g in range(sheet.best.shape[0]):
        good = good and sheet.least[g] > 0.0 and sheet.best[g] > 0.0
    return good


@inlined
def size_of(sheet: ScaledWorkspace) -> float:
    """Return the sizes that limit the accuracy of residuals, at any factors of a box (see `reduce_rows`)."""
    most = 1.0
    for g in range(sheet.best.shape[0]):
        most = max(most, size_of_factor(sheet, g) if sheet.most[g] < inf else abs(sheet.best[g]))
    return float(most * sheet.span[FLOOR])


@inlined
def rounding_of_residual(scaled: Scaled, sheet: ScaledWorkspace) -> float:
    """Return a bound of the rounding of a residual, as a length, in a box."""
    return float(relative_rounding(scaled.cost.K) * size_of(sheet))


@compiled
def clip_rows(scaled: Scaled, rho: float, box: Box, sheet: ScaledWorkspace) -> None:
    """Write the ends of the part of a box in which residuals may be shorter than rho; its rows must be bounded."""
    reset_cut(box.half, box.cut)
    if not is_bounded(sheet):
        return
    noise, flat = rounding_of_residual(scaled, sheet), box.half[2] == 0.0
    contract_box(sheet.K, sheet.weight, rho + noise, box.half, flat, sheet.nodes, sheet.rows, box.cut, box.solve)
