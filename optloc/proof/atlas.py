"""An atlas of all positions as boxes of finite size: around known minima, inside a cube, and outside it to infinity.

A position is ``x = m + R p / v``, with m the centre and R half the side of a cube that contains all stations:

- piece k < 2 D, a face of the cube: p is on the surface of the unit cube, and v in (0, 1]; v = 0 is infinity. The
  coordinates are the coordinates of p on the face, then v (inverse range);
- piece 2 D, inside the cube: v = 1, and the coordinates are the components of p;
- piece 2 D + 1 + i, around the known minimum i, the fix first. Its home is the face, or the inside, that contains the
  minimum. Home coordinates u and coordinates s of the piece are related by ``u = start + axes s``. On a face, v
  changes along the last axis only.

D is 2 or 3. The line to a station at ``m + R a`` is ``p - v a``, times R/v. A box of a piece has a centre `at` and
half-widths `half` (3,) in the coordinates of the piece; `set_centre` computes p and v of its centre. The boxes around a
minimum have coordinates in standard deviations.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined, put, put_rows
from optloc.proof.nodes.node import Triple, inner_product, reach, sum_of_forms, triple_at, write_triple


class AtlasMinima(NamedTuple):
    """Known minima and the boxes around them.

    Parameters
    ----------
    home : int array (P,)
        The piece that contains each minimum: a face or the inside.
    start, axes, back : array (P, 3), (P, 3, 3), (P, 3, 3)
        Home coordinates ``u = start + axes s``, and the inverse of the axes.
    sides : array (P, 3)
        Half-widths in s of boxes in which the cost is convex.
    core : array (P, 2, 3)
        Corners of wider boxes in s, which are searched along the axes. If the last number of the first corner is -inf,
        the box reaches infinity.
    """

    home: Array
    start: Array
    axes: Array
    back: Array
    sides: Array
    core: Array


class Atlas(NamedTuple):
    """The pieces of space, and working memory for one box.

    Parameters
    ----------
    middle : array (3,)
        Centre of the cube, metres.
    radius : float
        Half the side of the cube, metres; all stations are inside.
    dimension : int
        2 or 3.
    minima : AtlasMinima
        Known minima.
    point, slant : array (3,), (3, 3)
        p at the centre of a box, and its derivative with respect to the coordinates of the piece.
    scale : array (4,)
        v at the centre of a box, then its derivative.
    place, linear : array (4,), (3, 3)
        The home of the piece, then the home coordinates of the centre, and their derivative. A face and the inside are
        their own home.
    away, away_b, sense, sense_b : arrays
        Scaled lines to a node's stations, and their derivatives.
    bend : array (3, 3)
        Second derivatives.
    """

    middle: Array
    radius: float
    dimension: int
    minima: AtlasMinima
    point: Array
    slant: Array
    scale: Array
    place: Array
    linear: Array
    away: Array
    away_b: Array
    sense: Array
    sense_b: Array
    bend: Array


@compiled
def atlas_of(middle: Array, radius: float, dimension: int, count: int) -> Atlas:
    """Return the pieces around a cube, centre `middle` (3,) and half-width `radius`, m, with space for `count` minima.

    `dimension` is 2 or 3. The minima are zeros until they are written.
    """
    minima = AtlasMinima(
        np.zeros(count, dtype=np.int64),
        np.zeros((count, 3)),
        np.zeros((count, 3, 3)),
        np.zeros((count, 3, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 2, 3)),
    )
    return with_minima(middle, radius, dimension, minima)


@compiled
def with_minima(middle: Array, radius: float, dimension: int, minima: AtlasMinima) -> Atlas:
    """Return the pieces around a cube (centre `middle` (3,), half-width `radius`, m) and around known minima.

    `dimension` is 2 or 3.
    """
    # One array for all vectors and one for all matrices: each fix needs an atlas, and allocations take time.
    vectors, matrices = np.zeros((3, 3)), np.zeros((5, 3, 3))
    return Atlas(
        middle,
        radius,
        dimension,
        minima,
        vectors[0],
        matrices[0],
        np.zeros(4),
        np.zeros(4),
        matrices[1],
        vectors[1],
        vectors[2],
        matrices[2],
        matrices[3],
        matrices[4],
    )


@compiled
def first_minima(minima: AtlasMinima, count: int) -> AtlasMinima:
    """Return views of the first `count` minima: the arrays have space for more minima than were written."""
    return AtlasMinima(
        minima.home[:count],
        minima.start[:count],
        minima.axes[:count],
        minima.back[:count],
        minima.sides[:count],
        minima.core[:count],
    )


@compiled
def with_room_for_minimum(atlas: Atlas) -> Atlas:
    """Return the same pieces with space for one more known minimum, in the last place."""
    before, count = atlas.minima, atlas.minima.home.shape[0]
    wider = atlas_of(atlas.middle, atlas.radius, atlas.dimension, count + 1)
    minima = wider.minima
    for i in range(count):
        minima.home[i] = before.home[i]
        put(before.start[i], minima.start[i])
        put(before.sides[i], minima.sides[i])
        put_rows(before.axes[i], minima.axes[i])
        put_rows(before.back[i], minima.back[i])
        put_rows(before.core[i], minima.core[i])
    return wider


@compiled
def set_centre(atlas: Atlas, piece: int, at: Array) -> None:
    """Write p and v at the centre of a box, and their derivatives, into the working memory of the atlas.

    Parameters
    ----------
    atlas : Atlas
        Its working memory is written.
    piece : int
        Number of the piece; the faces 2 k and 2 k + 1 have p_k = -1 and 1.
    at : array (3,)
        Centre of the box in the coordinates of the piece.
    """
    d, place, linear = atlas.dimension, atlas.place, atlas.linear
    around = piece - 2 * d - 1
    # All below is in home coordinates. Around a minimum they follow from the axes of the minimum. The loops handle
    # single entries: slices of arrays would take more time than all other statements here.
    place[0] = piece if around < 0 else atlas.minima.home[around]
    for k in range(3):
        for m in range(3):
            linear[k, m] = 1.0 if around < 0 and k == m and k < d else 0.0
    for k in range(d):
        place[1 + k] = at[k] if around < 0 else atlas.minima.start[around, k]
        if around >= 0:
            for m in range(d):
                linear[k, m] = atlas.minima.axes[around, k, m]
                place[1 + k] += linear[k, m] * at[m]
    _set_home(atlas, int(place[0]))


@compiled
def _set_home(atlas: Atlas, home: int) -> None:
    # Writes p, v and their derivatives; `place` and `linear` are home coordinates, `home` is a face or the inside.
    d, place, linear, scale, slant = atlas.dimension, atlas.place, atlas.linear, atlas.scale, atlas.slant
    column = 0
    for k in range(d):
        level = k == home // 2  # the coordinate that is constant on a face
        atlas.point[k] = (1.0 if home % 2 else -1.0) if level else place[1 + column]
        for m in range(3):
            slant[k, m] = 0.0 if level else linear[column, m]
        column += 0 if level else 1
    # Inside the cube v is constant 1; on a face v is the last coordinate.
    face = home < 2 * d
    scale[0] = place[d] if face else 1.0
    for m in range(3):
        scale[1 + m] = linear[d - 1, m] if face else 0.0


@compiled
def piece_of(atlas: Atlas, x: Array, u: Array) -> int:
    """Return the home of a position x (D,), metres: a face or the inside; write its coordinates there into u (3,)."""
    d, most, home = atlas.dimension, 1.0, 2 * atlas.dimension
    for k in range(d):
        p = (x[k] - atlas.middle[k]) / atlas.radius
        if abs(p) > most:
            most, home = abs(p), 2 * k + (1 if p > 0.0 else 0)
    coordinates_on(atlas, home, x, u)
    return home


@compiled
def coordinates_on(atlas: Atlas, home: int, x: Array, u: Array) -> bool:
    """Write the coordinates u (3,) of a position x (D,), metres, on the face `home` or inside.

    Return False if the position has none: the face is on the other side of the centre of the cube.
    """
    d, v, column = atlas.dimension, 1.0, 0
    u[:] = 0.0
    if home < 2 * d:
        out = (x[home // 2] - atlas.middle[home // 2]) / atlas.radius * (1.0 if home % 2 else -1.0)
        if not out > 0.0:  # on the other side of the cube, or level with its centre: no positive v exists
            return False
        v = 1.0 / out
        u[d - 1] = v
    for k in range(d):
        if k != home // 2:
            u[column] = (x[k] - atlas.middle[k]) / atlas.radius * v
            column += 1
    return True


@compiled
def write_position(atlas: Atlas, x: Array) -> None:
    """Write the position x (D,), metres, of the centre that `set_centre` has set; v must not be zero."""
    for k in range(atlas.dimension):
        x[k] = atlas.middle[k] + atlas.radius * atlas.point[k] / atlas.scale[0]


# A thousand times the relative rounding of a few sums and products; and a factor that is a thousand times as far from
# 1.
_BEYOND, _OUTWARDS = 1e-12, 1.0 + 1e-9
# Rounding of a coordinate of a piece around a minimum: three products and sums of numbers of a size of about 1.
_PLACED = 8.0 * 2.0**-52


@compiled
def widen_around(atlas: Atlas, i: int, half: Array) -> None:
    """Widen the half-widths `half` (3,) of a box of the piece around minimum i by the rounding of its centre.

    So the computed bounds are valid for the exact box.
    """
    for k in range(atlas.dimension):
        for m in range(atlas.dimension):
            half[k] += _PLACED * abs(atlas.minima.back[i, k, m])


@compiled
def infinity_coordinate(atlas: Atlas, piece: int) -> float:
    """Return the last coordinate of infinity (v = 0) in a piece.

    The result is -inf if the last coordinate alone does not reach infinity. Around a minimum the result is slightly
    beyond infinity, where v rounds to zero.
    """
    d, around = atlas.dimension, piece - 2 * atlas.dimension - 1
    if around < 0 or atlas.minima.home[around] == 2 * d:
        return 0.0 if piece < 2 * d else -inf
    for k in range(d - 1):
        if atlas.minima.axes[around, d - 1, k] != 0.0:
            return -inf
    return float(-atlas.minima.start[around, d - 1] / atlas.minima.axes[around, d - 1, d - 1] * (1.0 + _BEYOND))


@compiled
def is_near_minimum(atlas: Atlas, half: Array, i: int) -> tuple[bool, bool]:
    """Return whether the current box is inside the convex box of minimum i, and whether it is inside its core.

    The current box has its centre in the working memory of the atlas (`set_centre`) and half-widths `half` (3,). The
    search leaves these boxes out: the first contains no second minimum, and the second is searched along other axes.
    """
    minima, d = atlas.minima, atlas.dimension
    if minima.home[i] != atlas.place[0]:
        return _within_from_another(atlas, half, i), False
    convex = core = True
    for k in range(d):
        if not (convex or core):
            break
        away = reach = 0.0
        for m in range(d):
            away += minima.back[i, k, m] * (atlas.place[1 + m] - minima.start[i, m])
            reach += _PLACED * abs(minima.back[i, k, m])
            slope = 0.0
            for c in range(d):
                slope += minima.back[i, k, c] * atlas.linear[c, m]
            reach += abs(slope) * half[m]
        # The ends are moved outwards by more than the rounding of the inverse axes: only a box that is surely inside
        # is left out.
        low, high = (away - reach) * _OUTWARDS, (away + reach) * _OUTWARDS
        convex = convex and max(high, -low) <= minima.sides[i, k]
        core = core and high <= minima.core[i, 1, k] and low >= minima.core[i, 0, k]
    return convex, core


@compiled
def _within_from_another(atlas: Atlas, half: Array, i: int) -> bool:
    """Return whether a box around the current centre is inside the convex box of a minimum that has another home.

    Coordinates of the box around minimum i are sums of its home coordinates. As functions of the box's coordinates they
    are quotients N/D of linear functions. At a point of the box with denominator D', their difference from the value q
    at the centre is ``(dN - q dD) / D'``.
    """
    minima, d, home = atlas.minima, atlas.dimension, int(atlas.minima.home[i])
    level, face = home // 2, home < 2 * d
    sign = 1.0 if home % 2 else -1.0
    divisor = sign * atlas.point[level] if face else atlas.scale[0]
    least = divisor
    for c in range(d):
        least -= half[c] * abs(atlas.slant[level, c] if face else atlas.scale[1 + c])
    if not least > 0.0:  # part of the box is on the other side of the cube, or at infinity
        return False
    for k in range(d):
        top = start = rounded = 0.0
        for m in range(d):
            part, column = minima.back[i, k, m], _column(m, level, face, d)
            top += part * (atlas.scale[0] if column < 0 else atlas.point[column])
            start += part * minima.start[i, m]
            rounded += _PLACED * abs(part)
        q = top / divisor
        reach = rounded
        for c in range(d):
            slope = -q * (sign * atlas.slant[level, c] if face else atlas.scale[1 + c])
            for m in range(d):
                column = _column(m, level, face, d)
                slope += minima.back[i, k, m] * (atlas.scale[1 + c] if column < 0 else atlas.slant[column, c])
            reach += abs(slope) * half[c] / least
        if not (abs(q - start) + reach) * _OUTWARDS <= minima.sides[i, k]:
            return False
    return True


@inlined
def _column(m: int, level: int, face: bool, d: int) -> int:
    """Return the component of p for coordinate m of a home, or -1 for v.

    A face (`face`) omits its constant component `level`, and its last coordinate is v. The dimension is d.
    """
    if not face:
        return m
    if m == d - 1:
        return -1
    return m + 1 if m >= level else m


class AtlasFrame(NamedTuple):
    """Position of a box as plain numbers.

    Compiled code counts references to each array that it passes on, which takes time.

    Parameters
    ----------
    middle : triple
        Centre of the cube, metres.
    radius : float
        Half the side of the cube, metres.
    space : bool
        Whether there are three dimensions.
    point, slant : triple, three triples
        p at the centre of the box, and the rows of its derivative.
    scale, rise : float, triple
        v at the centre of the box, and its derivative.
    """

    middle: Triple
    radius: float
    space: bool
    point: Triple
    slant: tuple[Triple, Triple, Triple]
    scale: float
    rise: Triple


@inlined
def frame_of(atlas: Atlas) -> AtlasFrame:
    """Return the position of the current centre (`set_centre`) as plain numbers, which calls pass on faster."""
    slant = (triple_at(atlas.slant[0], 0), triple_at(atlas.slant[1], 0), triple_at(atlas.slant[2], 0))
    point, rise = triple_at(atlas.point, 0), triple_at(atlas.scale, 1)
    return AtlasFrame(
        triple_at(atlas.middle, 0), atlas.radius, atlas.dimension == 3, point, slant, atlas.scale[0], rise
    )


@compiled
def contract_to_corners(atlas: Atlas, origin: Array, back: Array, corners: Array, half: Array, cut: Array) -> None:
    """Contract a box around the current centre to the part between corners in search coordinates around a fix.

    With b a row of `back`, a position x has the coordinate ``b.(x - origin)``. Times v, this is linear in the
    coordinates of the piece: ``b.(R p + (m - origin) v)``. An end times v is linear as well, so both are compared
    times v >= 0.

    Parameters
    ----------
    atlas : Atlas
        Its current centre is set.
    origin, back : array (3,), (3, 3)
        The fix, metres, and the derivative of the search coordinates with respect to the position.
    corners : array (2, 3)
        Least and greatest search coordinates.
    half, cut : array (3,), (6,)
        Half-widths of the box, and ends of its remaining part, contracted in place.
    """
    frame, h = frame_of(atlas), triple_at(half, 0)
    s0, s1, s2 = frame.slant
    m0, m1, m2 = frame.middle
    apart, most = (m0 - origin[0], m1 - origin[1], m2 - origin[2]), abs(frame.scale) + reach(frame.rise, h)
    for k in range(3):
        b = triple_at(back[k], 0)
        # v times the coordinate: its value at the centre, its derivative, and the sizes that its rounding is relative
        # to.
        away = inner_product(b, apart)
        middle = frame.radius * inner_product(b, frame.point) + away * frame.scale
        slant = sum_of_forms(1.0, sum_of_forms(b[0], s0, b[1], s1), b[2], s2)
        steep, blur = sum_of_forms(frame.radius, slant, away, frame.rise), 0.0
        for m in range(3):
            size = frame.radius * (abs(frame.point[m]) + reach(frame.slant[m], h))
            blur += abs(b[m]) * (size + (abs(frame.middle[m]) + abs(origin[m])) * most)
        for side in range(2):
            sign, end = (-1.0, corners[0, k]) if side == 0 else (1.0, corners[1, k])
            slope = sum_of_forms(sign, steep, -sign * end, frame.rise)
            # The distance of the coordinate beyond the end, times v, must not be positive. `room` is the greatest
            # allowed rise from the lowest corner of the box.
            room = reach(slope, h) - sign * (middle - end * frame.scale) + _BEYOND * (blur + abs(end) * most)
            if room < 0.0:
                cut[0], cut[3] = 1.0, -1.0
                return
            for c in range(3):
                size = abs(slope[c])
                if size > 0.0 and room < 2.0 * size * half[c]:
                    far = room / size - half[c] + _BEYOND * half[c]
                    if slope[c] > 0.0:
                        cut[3 + c] = min(cut[3 + c], far)
                    else:
                        cut[c] = max(cut[c], -far)


@inlined
def _station(frame: AtlasFrame, data: Array, first: int) -> Triple:
    """Return the station a at data[first:first + 3], relative to the centre and in half sides of the cube (no unit)."""
    m0, m1, m2 = frame.middle
    per = 1.0 / frame.radius
    third = (data[first + 2] - m2) * per if frame.space else 0.0
    return (data[first] - m0) * per, (data[first + 1] - m1) * per, third


@inlined
def set_line(frame: AtlasFrame, data: Array, first: int, away: Array, sense: Array) -> None:
    """Write the scaled line p - v a to the station data[first:first + 3] to `away`, and its derivative to `sense`."""
    a0, a1, a2 = _station(frame, data, first)
    write_triple(sum_of_forms(1.0, frame.point, -frame.scale, (a0, a1, a2)), away)
    s0, s1, s2 = frame.slant
    sense[0, 0], sense[0, 1], sense[0, 2] = sum_of_forms(1.0, s0, -a0, frame.rise)
    sense[1, 0], sense[1, 1], sense[1, 2] = sum_of_forms(1.0, s1, -a1, frame.rise)
    sense[2, 0], sense[2, 1], sense[2, 2] = sum_of_forms(1.0, s2, -a2, frame.rise)


@inlined
def scaled_station(frame: AtlasFrame, data: Array) -> tuple[float, float, Triple]:
    """Return ``|a|`` of a station a, and ``N = -2 a.p + v |a|^2`` with its constant gradient (3 numbers).

    N is the numerator of the range minus the distance to the centre (`optloc.proof.nodes.range`). `data` begins with
    the position of the station, m.
    """
    a = _station(frame, data, 0)
    squared = inner_product(a, a)
    s0, s1, s2 = frame.slant
    n = sum_of_forms(1.0, sum_of_forms(a[0], s0, a[1], s1), a[2], s2)
    return (
        sqrt(squared),
        frame.scale * squared - 2.0 * inner_product(a, frame.point),
        sum_of_forms(-2.0, n, squared, frame.rise),
    )
