"""A box of a cost with an unknown factor: the factor is projected out of the rows, and its range is bounded.

The cost is ``f(x, k) = |k (K phi(x) + lift) - w|^2`` with k >= 0. A prior on k is the last row, in which K is zero.
At the centre c of a box, u is the direction of ``a = K phi(c) + lift``, and ``P = 1 - u u'``. Then ``P a = 0``.
So the cost at every x of the box and every k is at least

    |k P K (phi(x) - phi(c)) - P w|^2.

All bounds of rows therefore hold for the projected rows, with nodes times the greatest k. The rows along u bound k:
``|k u.(K phi(x) + lift) - u.w| <= rho`` where the cost is at most rho^2.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, inlined
from optloc.proof.box import digits, least_residual, linearise_rows, shrink, uncut
from optloc.proof.nodes.node import HIGH, LOW, NODE_WIDTH, PHI, SLOPE0, SLOPE1, SLOPE2
from optloc.proof.search_space import Box, Cost

# Factor of the rounding of projected rows: each number goes through three more sums than in rows as they are.
_PROJECTED = 4.0
# Numbers of a box: the best factor at its centre, the least and greatest factor of interest, the cost at the centre,
# the length of the column of the factor, the sizes that limit the accuracy, the slopes of the rows along u, and the
# least length of the column over the box.
FACTOR, LEAST, MOST, HERE, LENGTH, FLOOR, ALONG0, ALONG1, ALONG2, SHORTEST, SPAN = range(11)


class Scaled(NamedTuple):
    """A cost with an unknown factor of all rows.

    Parameters
    ----------
    cost : Cost
        Nodes, rows and measurements.
    lift : array (q,)
        Constant part of the column of the factor: zero, or in the last row the inverse of the prior's sigma.
    """

    cost: Cost
    lift: Array


class Sheet(NamedTuple):
    """Working memory for one box.

    Parameters
    ----------
    K, w : array (q, J), (q,)
        Projected rows and measurements.
    nodes : array (J, NODE_WIDTH)
        Nodes times the greatest factor, without their values.
    unit, pull : array (q,), (J,)
        Direction u, and ``K'u``.
    span : array (SPAN,)
        Numbers of the box.
    half : array (3,)
        Half-widths of the offsets times the factor.
    J : array (q, 3)
        Projected derivatives of the residual.
    turn, tie : array (J, 4), (J, 4)
        Changes of the gradients of the nodes, and their pulls ``K'J``; the last of each belongs to the factor.
    cross : array (4,)
        Changes of the entries of the Hessian that belong to the factor.
    third : array (6, 6)
        Entries of sums of the nodes' Hessians: with their pulls along four coordinates, with their forces, and with
        what else may change these.
    """

    K: Array
    w: Array
    nodes: Array
    unit: Array
    pull: Array
    span: Array
    half: Array
    J: Array
    turn: Array
    tie: Array
    cross: Array
    third: Array


@compiled
def sheet_of(scaled: Scaled) -> Sheet:
    """Return working memory for boxes of a cost."""
    q, J = scaled.cost.K.shape
    return Sheet(
        np.zeros((q, J)),
        np.zeros(q),
        np.zeros((J, NODE_WIDTH)),
        np.zeros(q),
        np.zeros(J),
        np.zeros(SPAN),
        np.zeros(3),
        np.zeros((q, 3)),
        np.zeros((J, 4)),
        np.zeros((J, 4)),
        np.zeros(4),
        np.zeros((6, 6)),
    )


@compiled
def reduce_rows(scaled: Scaled, floor: float, box: Box, sheet: Sheet) -> None:
    """Project the factor out of the rows at the centre of a box whose nodes are bounded.

    Parameters
    ----------
    scaled : Scaled
        The cost.
    floor : float
        The sizes that limit the accuracy of residuals, apart from the nodes.
    box : Box
        Its nodes are filled.
    sheet : Sheet
        Written, except the range of the factor.
    """
    K, w, lift, weight, nodes = scaled.cost.K, scaled.cost.w, scaled.lift, scaled.cost.weight, box.nodes
    unit, pull, span = sheet.unit, sheet.pull, sheet.span
    length, along, size = 0.0, 0.0, floor
    for j in range(K.shape[1]):
        size += weight[j] * abs(nodes[j, PHI])
    for i in range(K.shape[0]):
        total = lift[i]
        size += abs(lift[i])
        for j in range(K.shape[1]):
            total += K[i, j] * nodes[j, PHI]
        unit[i] = total
        length += total * total
    length = sqrt(length)
    for i in range(K.shape[0]):
        unit[i] = unit[i] / length if length > 0.0 else 0.0
        along += unit[i] * w[i]
    here = min(along, 0.0) ** 2  # the factor is not negative
    for i in range(K.shape[0]):
        sheet.w[i] = w[i] - unit[i] * along
        here += sheet.w[i] * sheet.w[i]
    for j in range(K.shape[1]):
        total = 0.0
        for i in range(K.shape[0]):
            total += unit[i] * K[i, j]
        pull[j] = total
        for i in range(K.shape[0]):
            sheet.K[i, j] = K[i, j] - unit[i] * total
    for m in range(3):
        total = 0.0
        for j in range(K.shape[1]):
            total += pull[j] * nodes[j, SLOPE0 + m]
        span[ALONG0 + m] = total
    span[FACTOR] = max(along, 0.0) / length if length > 0.0 else 0.0
    span[HERE], span[LENGTH], span[FLOOR] = here, length, _PROJECTED * size


@compiled
def bound_factor(scaled: Scaled, rho: float, box: Box, sheet: Sheet) -> bool:
    """Write the range of the factor at which points of a box have residuals shorter than rho; False for no factor.

    The rows are reduced. A last row without nodes is a prior, which bounds the factor as well.
    """
    half, nodes, span, pull, K = box.half, box.nodes, sheet.span, sheet.pull, scaled.cost.K
    fall = rise = abs(span[ALONG0]) * half[0] + abs(span[ALONG1]) * half[1] + abs(span[ALONG2]) * half[2]
    for j in range(nodes.shape[0]):
        first, second = pull[j] * nodes[j, LOW], pull[j] * nodes[j, HIGH]
        fall -= min(first, second, 0.0)
        rise += max(first, second, 0.0)
    blur = digits(K) * span[FLOOR]
    along, low, high = span[FACTOR] * span[LENGTH], 0.0, inf
    if span[FACTOR] == 0.0:  # its sign is not kept
        along = 0.0
        for i in range(K.shape[0]):
            along += sheet.unit[i] * scaled.cost.w[i]
    least, most = span[LENGTH] - fall - blur, span[LENGTH] + rise + blur
    span[SHORTEST] = least
    if least > 0.0:
        high = (along + rho + blur) / least
        low = max((along - rho - blur) / most, 0.0)
    last = K.shape[0] - 1
    if scaled.lift[last] > 0.0:
        per = 1.0 / scaled.lift[last]
        high = min(high, (scaled.cost.w[last] + rho) * per * (1.0 + 1e-12))
        low = max(low, (scaled.cost.w[last] - rho) * per * (1.0 - 1e-12))
    span[LEAST], span[MOST] = min(low, span[FACTOR]), max(high, span[FACTOR])
    return high > low


@compiled
def bound_rows(scaled: Scaled, box: Box, sheet: Sheet) -> float:
    """Return a lower bound of the residual over a box whose factor is bounded, negative where it says nothing."""
    most, nodes, out = sheet.span[MOST], box.nodes, sheet.nodes
    if not most < inf:
        return -1.0
    for j in range(nodes.shape[0]):
        out[j, PHI] = 0.0
        out[j, SLOPE0], out[j, SLOPE1] = most * nodes[j, SLOPE0], most * nodes[j, SLOPE1]
        out[j, SLOPE2] = most * nodes[j, SLOPE2]
        out[j, LOW], out[j, HIGH] = most * min(nodes[j, LOW], 0.0), most * max(nodes[j, HIGH], 0.0)
    linearise_rows(sheet.K, sheet.w, out, box.rows)
    return float(least_residual(sheet.K, scaled.cost.weight, _size_of(sheet), box.half, out, box.rows))


@inlined
def _size_of(sheet: Sheet) -> float:
    """Return the sizes that limit the accuracy of residuals at any factor of a box."""
    return float(max(1.0, sheet.span[MOST]) * sheet.span[FLOOR])


@compiled
def blur_of(scaled: Scaled, sheet: Sheet) -> float:
    """Return a bound of the rounding errors of a residual (its length) in a box."""
    most = sheet.span[MOST] if sheet.span[MOST] < inf else sheet.span[FACTOR]
    return float(digits(scaled.cost.K) * max(1.0, most) * sheet.span[FLOOR])


@compiled
def clip_rows(scaled: Scaled, rho: float, box: Box, sheet: Sheet) -> None:
    """Write the ends of what is left of a box where residuals may be shorter than rho; its rows are bounded."""
    uncut(box.half, box.cut)
    if not sheet.span[MOST] < inf:
        return
    noise, flat = blur_of(scaled, sheet), box.half[2] == 0.0
    shrink(sheet.K, scaled.cost.weight, rho + noise, box.half, flat, sheet.nodes, box.rows, box.cut, box.solve)
    unscale(box, box.half, 1.0, sheet.span[MOST] / sheet.span[LEAST] if sheet.span[LEAST] > 0.0 else inf)


@inlined
def unscale(box: Box, half: Array, least: float, most: float) -> None:
    """Turn ends of offsets times a factor into ends of offsets, which are between `least` and `most` as large."""
    for k in range(3):
        low, high = box.cut[k], box.cut[3 + k]
        if low > high:
            continue
        low = low * (least if low > 0.0 else most) if low != 0.0 else 0.0
        high = high * (least if high < 0.0 else most) if high != 0.0 else 0.0
        box.cut[k], box.cut[3 + k] = max(low, -half[k]), min(high, half[k])


@compiled
def look_at(scaled: Scaled, sheet: Sheet, box: Box, look: Cost) -> None:
    """Write rows that are the cost, its slope and information at a point whose rows are reduced, without the factor."""
    factor = sheet.span[FACTOR]
    for i in range(sheet.K.shape[0]):
        total = sheet.w[i]
        for j in range(sheet.K.shape[1]):
            look.K[i, j] = factor * sheet.K[i, j]
            total += look.K[i, j] * box.nodes[j, PHI]
        look.w[i] = total
