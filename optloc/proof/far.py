"""The inverse-range chart: all positions outside a cube, to infinity, as boxes of finite size.

A position outside the cube ``|x - m|_inf <= R`` is ``x = m + R p / v`` with p on the surface of the unit cube and v in
(0, 1]; v = 0 is infinity. On each of the 2 D faces the coordinates are those of p on the face, then v. The line to a
station at ``m + R a`` is, but for the factor R/v, ``p - v a``: angles and ratios of ranges are functions of that alone.
Where every row's coefficients of ranges sum to zero the distance to m may be taken off every range. What is left,

    R (|p - v a| - |p|) / v = R (-2 a.p + v |a|^2) / (|p - v a| + |p|),

stays finite and smooth at infinity.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.angles import bound_azimuth, bound_elevation, curve_azimuth, curve_elevation
from optloc.proof.forms import Triple, blend, inner, product, range_bend, range_form, reach, scaled, triple, write
from optloc.proof.nodes import AZIMUTH, ELEVATION, RANGE, RATIO
from optloc.proof.ratio import bound_ratio, curve_ratio, quotient_bend
from optloc.types import Array

# How little the coefficients of ranges in a row may sum to, relative to their sizes.
_BALANCED = 1e-12


class Far(NamedTuple):
    """The outside of a cube, and working memory for one box there.

    Parameters
    ----------
    middle : array (3,)
        Centre of the cube, metres.
    radius : float
        Half its side; all stations lie inside.
    dimension : int
        2 or 3.
    point, away, away_b : array (3,)
        p at the centre of a box, and the scaled lines to a node's stations.
    flat, sense, sense_b : array (3, 3)
        Their derivatives with respect to the coordinates of the face.
    bend, second : array (3, 3)
        Second derivatives.
    """

    middle: Array
    radius: float
    dimension: int
    point: Array
    away: Array
    away_b: Array
    flat: Array
    sense: Array
    sense_b: Array
    bend: Array
    second: Array


@compiled
def far_from(middle: Array, radius: float, dimension: int) -> Far:
    """Return the outside of a cube with centre `middle` (3,) and half-width `radius`, metres."""
    return Far(
        middle,
        radius,
        dimension,
        np.zeros(3),
        np.zeros(3),
        np.zeros(3),
        np.zeros((3, 3)),
        np.zeros((3, 3)),
        np.zeros((3, 3)),
        np.zeros((3, 3)),
        np.zeros((3, 3)),
    )


@compiled
def reaches_infinity(kinds: Array, K: Array) -> bool:
    """Return whether a cost stays finite at infinity, so that the chart holds.

    Linear forms, heights, and ranges that no other balances grow without end.

    Parameters
    ----------
    kinds : int array (J,)
        Codes of the nodes.
    K : array (q, J)
        Whitened rows.
    """
    for j in range(kinds.shape[0]):
        if kinds[j] not in (RANGE, AZIMUTH, ELEVATION, RATIO):
            return False
    for i in range(K.shape[0]):
        total = size = 0.0
        for j in range(kinds.shape[0]):
            if kinds[j] == RANGE:
                total += K[i, j]
                size += abs(K[i, j])
        if abs(total) > _BALANCED * size:
            return False
    return True


@compiled
def set_face(far: Far, face: int, at: Array) -> None:
    """Write the point p of a face's coordinates, and its derivative; faces 2 k and 2 k + 1 have p_k = -1 and 1."""
    far.flat[:] = 0.0
    column = 0
    for k in range(far.dimension):
        if k == face // 2:
            far.point[k] = 1.0 if face % 2 else -1.0
        else:
            far.point[k] = at[column]
            far.flat[k, column] = 1.0
            column += 1


@compiled
def position(far: Far, at: Array, x: Array) -> None:
    """Write the position x (D,) of the point that `set_face` has set; v must not be zero."""
    for k in range(far.dimension):
        x[k] = far.middle[k] + far.radius * far.point[k] / at[far.dimension - 1]


@compiled
def _set_line(far: Far, at: Array, data: Array, first: int, away: Array, sense: Array) -> None:
    """Write the scaled line p - v a to the station at data[first:first + 3], and its derivative."""
    last = far.dimension - 1
    for k in range(far.dimension):
        a = (data[first + k] - far.middle[k]) / far.radius
        away[k] = far.point[k] - at[last] * a
        for m in range(last):
            sense[k, m] = far.flat[k, m]
        sense[k, last] = -a


@compiled
def _station(far: Far, data: Array) -> tuple[Triple, Triple]:
    """Return the station in units of the cube, and the gradient of ``-2 a.p + v |a|^2``, which is affine."""
    a = (
        (data[0] - far.middle[0]) / far.radius,
        (data[1] - far.middle[1]) / far.radius,
        (data[2] - far.middle[2]) / far.radius if far.dimension == 3 else 0.0,
    )
    flat = far.flat
    steepness = inner(a, a)
    first = -2.0 * (a[0] * flat[0, 0] + a[1] * flat[1, 0] + a[2] * flat[2, 0])
    if far.dimension == 2:
        return a, (first, steepness, 0.0)
    return a, (first, -2.0 * (a[0] * flat[0, 1] + a[1] * flat[1, 1] + a[2] * flat[2, 1]), steepness)


@compiled
def bound_difference(far: Far, at: Array, data: Array, half: Array, slope: Array) -> tuple[float, float, float]:
    """Bound a range less the distance to the centre over a box, metres; as the functions of `optloc.proof.nodes`.

    With phi = N/S, N affine, ``S = S_c + u.s + q``, slope ``g = (n - phi u)/S_c``, the remainder is exactly
    ``-((g.s)(u.s) + (phi + g.s) q) / S``.
    """
    h = triple(half, 0)
    _set_line(far, at, data, 0, far.away, far.sense)
    a, n = _station(far, data)
    r, u, least, q = range_form(far.away, far.sense, h)
    r0, u0, least0, q0 = range_form(far.point, far.flat, h)
    size, u, most = r + r0, blend(1.0, u, 1.0, u0), q + q0
    v = at[far.dimension - 1]
    phi = (v * inner(a, a) - 2.0 * inner(a, triple(far.point, 0))) / size
    g = blend(1.0 / size, n, -phi / size, u)
    write(blend(far.radius, g, 0.0, g), slope)
    low, high = product(g, u, h)
    swing = reach(g, h)
    low, high = low + min((phi - swing) * most, 0.0), high + max((phi + swing) * most, 0.0)
    low, high = scaled(-high, -low, least + least0, size + reach(u, h) + most)
    return far.radius * phi, far.radius * low, far.radius * high


@compiled
def curve_difference(far: Far, at: Array, data: Array, half: Array, turn: Array) -> float:
    """Bound how a range less the distance to the centre curves over a box; the Hessian is written into ``far.bend``."""
    h = triple(half, 0)
    _set_line(far, at, data, 0, far.away, far.sense)
    a, n = _station(far, data)
    r, u, least, q = range_form(far.away, far.sense, h)
    r0, u0, least0, q0 = range_form(far.point, far.flat, h)
    ds, chi, norm = range_bend(far.sense, h, r, u, least, q, far.second)
    ds0, chi0, norm0 = range_bend(far.flat, h, r0, u0, least0, q0, far.bend)
    for k in range(3):
        for m in range(3):
            far.second[k, m] += far.bend[k, m]
            far.bend[k, m] = 0.0
    size, u = r + r0, blend(1.0, u, 1.0, u0)
    phi = (at[far.dimension - 1] * inner(a, a) - 2.0 * inner(a, triple(far.point, 0))) / size
    g = blend(1.0 / size, n, -phi / size, u)
    still = (0.0, 0.0, 0.0)
    changes = (still, blend(1.0, ds, 1.0, ds0), 0.0, chi + chi0, norm + norm0, reach(u, h) + q + q0)
    change = quotient_bend(g, u, (phi, size, least + least0), changes, h, far.bend, far.second, turn)
    for k in range(3):
        turn[k] *= far.radius
        for m in range(3):
            far.bend[k, m] *= far.radius
    return far.radius * change


@compiled
def bound_far(far: Far, kinds: Array, data: Array, at: Array, half: Array, nodes: Array) -> None:
    """Bound all nodes over a box of the face that `set_face` has set.

    Parameters
    ----------
    far : Far
        The chart.
    kinds, data : array (J,), (J, WIDTH)
        The nodes.
    at, half : array (3,)
        Centre and half-widths in the coordinates of the face.
    nodes : array (J, NODE_WIDTH)
        Written, see `optloc.proof.boxes`.
    """
    for j in range(kinds.shape[0]):
        kind, own, slope = kinds[j], data[j], nodes[j, 1:4]
        if kind == RANGE:
            value, low, high = bound_difference(far, at, own, half, slope)
        else:
            _set_line(far, at, own, 0, far.away, far.sense)
            if kind == AZIMUTH:
                value, low, high = bound_azimuth(own, far.away, far.sense, half, slope)
            elif kind == ELEVATION:
                value, low, high = bound_elevation(own, far.away, far.sense, half, slope)
            else:
                _set_line(far, at, own, 3, far.away_b, far.sense_b)
                value, low, high = bound_ratio(own, far.away, far.sense, far.away_b, far.sense_b, half, slope)
        nodes[j, 0], nodes[j, 4], nodes[j, 5] = value, low, high


@compiled
def curve_far(far: Far, kinds: Array, data: Array, at: Array, half: Array, curves: Array) -> None:
    """Fill second derivatives and bounds of their change in the table of all nodes (J, CURVE_WIDTH)."""
    for j in range(kinds.shape[0]):
        kind, own, turn = kinds[j], data[j], curves[j, 6:9]
        if kind == RANGE:
            chi = curve_difference(far, at, own, half, turn)
        else:
            _set_line(far, at, own, 0, far.away, far.sense)
            if kind == AZIMUTH:
                chi = curve_azimuth(own, far.away, far.sense, half, far.bend, turn)
            elif kind == ELEVATION:
                chi = curve_elevation(own, far.away, far.sense, half, far.bend, turn)
            else:
                _set_line(far, at, own, 3, far.away_b, far.sense_b)
                chi = curve_ratio(own, far.away, far.sense, far.away_b, far.sense_b, half, far.bend, turn)
        curves[j, 9] = chi
        column = 0
        for k in range(3):
            for m in range(k, 3):
                curves[j, column] = far.bend[k, m]
                column += 1
