"""Nodes over the pieces of an atlas: angles, ratios of ranges, and ranges less the distance to the centre.

Angles and ratios are functions of the scaled line ``p - v a`` alone. Where every row's coefficients of ranges sum to
zero, the distance to the centre of the cube may be taken off every range. What is left,

    R (|p - v a| - |p|) / v = R (-2 a.p + v |a|^2) / (|p - v a| + |p|),

stays finite and smooth at infinity.
"""

from __future__ import annotations

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.proof.atlas import Atlas, scaled_station, set_line
from optloc.proof.nodes.angles import bound_azimuth, bound_elevation, curve_azimuth, curve_elevation
from optloc.proof.nodes.codes import AZIMUTH, ELEVATION, RANGE, RATIO
from optloc.proof.nodes.forms import RangeForm, blend, range_bend, range_form, reach, still, triple, unbounded, write
from optloc.proof.nodes.ratio import bound_ratio, curve_ratio, quotient, quotient_bend

# How little the coefficients of ranges in a row may sum to, relative to their sizes.
_BALANCED = 1e-12


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
def bound_difference(
    atlas: Atlas, data: Array, centre: RangeForm, half: Array, slope: Array
) -> tuple[float, float, float]:
    """Bound a range less the distance to the centre over a box, metres; as the functions of `optloc.proof.nodes.codes`.

    A quotient N/S with N linear, as ratios are (`optloc.proof.nodes.ratio.bound_ratio`), and at most ``R |a|`` in size.
    `centre` is what `optloc.proof.nodes.forms.range_form` says of p.
    """
    h, radius = triple(half, 0), atlas.radius
    set_line(atlas, data, 0, atlas.away, atlas.sense)
    a, rise, n = scaled_station(atlas, data)
    r, u, least, q, far = range_form(atlas.away, atlas.sense, h)
    r0, u0, least0, q0, far0 = centre
    size, u, most = r + r0, blend(1.0, u, 1.0, u0), q + q0
    phi, least = rise / size if size > 0.0 else 0.0, max(least, 0.0) + max(least0, 0.0)
    if least > 0.0:
        g = blend(1.0 / size, n, -phi / size, u)
        low, high = quotient(phi, g, u, most, (0.0, 0.0), (least, far + far0), h)
        if high - low <= 2.0 * a:
            write(blend(radius, g, 0.0, g), slope)
            return radius * phi, radius * low, radius * high
    slope[0] = slope[1] = slope[2] = 0.0
    return radius * phi, radius * (-a - phi), radius * (a - phi)


@compiled
def curve_difference(atlas: Atlas, data: Array, centre: RangeForm, half: Array, turn: Array) -> float:
    """Bound how a range less the distance to the centre curves over a box; the Hessian goes into ``atlas.bend``."""
    h, bend, second = triple(half, 0), atlas.bend, atlas.second
    bound_difference(atlas, data, centre, half, turn)
    a, rise, n = scaled_station(atlas, data)
    if a == 0.0:
        bend[:] = 0.0
        return 0.0
    r, u, least, q, _ = range_form(atlas.away, atlas.sense, h)
    r0, u0, least0, q0, _ = centre
    if still(turn) or not (least > 0.0 and least0 > 0.0):
        return unbounded(bend, turn)
    ds, chi, norm = range_bend(atlas.sense, h, r, u, least, q, second)
    ds0, chi0, norm0 = range_bend(atlas.slant, h, r0, u0, least0, q0, bend)
    for k in range(3):
        for m in range(3):
            second[k, m] += bend[k, m]
            bend[k, m] = 0.0
    size, u = r + r0, blend(1.0, u, 1.0, u0)
    phi = rise / size
    g = blend(1.0 / size, n, -phi / size, u)
    changes = ((0.0, 0.0, 0.0), blend(1.0, ds, 1.0, ds0), 0.0, chi + chi0, norm + norm0, reach(u, h) + q + q0)
    change = quotient_bend(g, u, (phi, size, least + least0), changes, h, bend, second, turn)
    for k in range(3):
        turn[k] *= atlas.radius
        for m in range(3):
            bend[k, m] *= atlas.radius
    return atlas.radius * change


@compiled
def bound_pieces(atlas: Atlas, kinds: Array, data: Array, half: Array, nodes: Array) -> None:
    """Bound all nodes over a box around the centre that `set_centre` has set.

    Parameters
    ----------
    atlas : Atlas
        The pieces.
    kinds, data : array (J,), (J, width)
        The nodes.
    half : array (3,)
        Half-widths in the coordinates of the piece.
    nodes : array (J, NODE_WIDTH)
        Written, see `optloc.proof.box`.
    """
    away, sense = atlas.away, atlas.sense
    centre = range_form(atlas.point, atlas.slant, triple(half, 0))
    for j in range(kinds.shape[0]):
        kind, own, slope = kinds[j], data[j], nodes[j, 1:4]
        if kind == RANGE:
            value, low, high = bound_difference(atlas, own, centre, half, slope)
        else:
            set_line(atlas, own, 0, away, sense)
            if kind == AZIMUTH:
                value, low, high = bound_azimuth(own, away, sense, half, slope)
            elif kind == ELEVATION:
                value, low, high = bound_elevation(own, away, sense, half, slope)
            else:
                set_line(atlas, own, 3, atlas.away_b, atlas.sense_b)
                value, low, high = bound_ratio(own, away, sense, atlas.away_b, atlas.sense_b, half, slope)
        nodes[j, 0], nodes[j, 4], nodes[j, 5] = value, low, high


@compiled
def curve_pieces(atlas: Atlas, kinds: Array, data: Array, half: Array, curves: Array) -> None:
    """Fill second derivatives and bounds of their change in the table of all nodes (J, CURVE_WIDTH)."""
    away, sense, bend = atlas.away, atlas.sense, atlas.bend
    centre = range_form(atlas.point, atlas.slant, triple(half, 0))
    for j in range(kinds.shape[0]):
        kind, own, turn = kinds[j], data[j], curves[j, 6:9]
        if kind == RANGE:
            chi = curve_difference(atlas, own, centre, half, turn)
        else:
            set_line(atlas, own, 0, away, sense)
            if kind == AZIMUTH:
                chi = curve_azimuth(own, away, sense, half, bend, turn)
            elif kind == ELEVATION:
                chi = curve_elevation(own, away, sense, half, bend, turn)
            else:
                set_line(atlas, own, 3, atlas.away_b, atlas.sense_b)
                chi = curve_ratio(own, away, sense, atlas.away_b, atlas.sense_b, half, bend, turn)
        curves[j, 9] = chi
        column = 0
        for k in range(3):
            for m in range(k, 3):
                curves[j, column] = bend[k, m]
                column += 1
