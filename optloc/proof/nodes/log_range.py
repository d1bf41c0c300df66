"""Logarithms of ranges over a box; signal strengths in decibels are multiples of them.

Differences of logarithms stay finite and smooth at infinity. Scaled lines give the same differences, because the scale
cancels.
"""

from __future__ import annotations

from math import inf, log, log1p

from optloc.base.types import Array
from optloc.kernels.jit import compiled
from optloc.proof.nodes.node import (
    BALANCED,
    Node,
    NodeRow,
    Symmetric,
    is_zero_slope,
    largest_entries,
    length,
    range_form,
    range_hessian,
    reach,
    sum_of_forms,
    triple_at,
    unbounded_curvature,
    write_symmetric,
    write_triple,
)

# Least range with a logarithm: at the station the logarithm does not exist.
_LEAST = 1e-300


@compiled
def bound_logarithm(data: Array, line: Array, sense: Array, half: Array, slope: Array) -> tuple[float, float, float]:
    """Bound the logarithm of a range over a box (see `optloc.proof.nodes.node`).

    For a range r' = r (1 + t) in the box, with r at the centre, ``log r' = log r + t + (log(1 + t) - t)``. The bracket
    is never positive, and decreases with |t|. In a box that may contain the station, the logarithm has no lower bound.
    """
    h = triple_at(half, 0)
    r, u, least, most, far = range_form(line, sense, h)
    phi = log(max(r, _LEAST))
    if not least > 0.0:
        slope[0] = slope[1] = slope[2] = 0.0
        return phi, -inf, log(max(far, _LEAST)) - phi
    below, above = least / r - 1.0, far / r - 1.0
    low, high = log1p(below), log1p(above)
    less, more = min(log1p(below) - below, log1p(above) - above), most / r
    # Otherwise a constant interval for the whole box is tighter than a slope with its remainder.
    if more - less <= high - low:
        write_triple(sum_of_forms(1.0 / r, u, 0.0, u), slope)
        return phi, less, more
    slope[0] = slope[1] = slope[2] = 0.0
    return phi, low, high


@compiled
def curve_logarithm(data: Array, line: Array, sense: Array, half: Array, curvature: Array, turn: Array) -> float:
    """Bound the second derivatives of the logarithm of a range over a box (see `optloc.proof.nodes.node`).

    With u the gradient and B the Hessian of the range, the gradient is g = u/r and the Hessian is ``B/r - g g'``.
    """
    h = triple_at(half, 0)
    bound_logarithm(data, line, sense, half, turn)
    r, u, least, most, _ = range_form(line, sense, h)
    if is_zero_slope(turn) or not least > 0.0:
        return unbounded_curvature(curvature, turn)
    bend, du, chi, norm = range_hessian(sense, h, r, u, least, most)
    g, swing = sum_of_forms(1.0 / r, u, 0.0, u), reach(u, h) + most
    own: Symmetric = (
        bend[0] / r - g[0] * g[0],
        bend[1] / r - g[0] * g[1],
        bend[2] / r - g[0] * g[2],
        bend[3] / r - g[1] * g[1],
        bend[4] / r - g[1] * g[2],
        bend[5] / r - g[2] * g[2],
    )
    # g' - g = (u' - u - g (r' - r)) / r', as for any quotient.
    wide = sum_of_forms(1.0 / least, du, swing / least, (abs(g[0]), abs(g[1]), abs(g[2])))
    dg = length(wide)
    change = (chi + swing * norm / r) / least + dg * (2.0 * length(g) + dg)
    (w0, w1, w2), away = largest_entries(own, h), change * length(h)
    write_triple((min(wide[0], w0 + away), min(wide[1], w1 + away), min(wide[2], w2 + away)), turn)
    write_symmetric(own, curvature)
    return change


def _numbers(row: NodeRow) -> Array:
    """Return the numbers (B, n) of the node of a row: the station's position."""
    return row.place(row.a)


LOGARITHM = Node("log range", 3, 1, _numbers, bound_logarithm, curve_logarithm, infinity=BALANCED, of_station=True)
