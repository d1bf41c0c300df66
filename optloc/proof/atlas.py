"""An atlas of all positions: around known minima, inside a cube, and outside it to infinity, as boxes of finite size.

A position is ``x = m + R p / v``, with m the centre and R half the side of a cube that holds all stations:

- piece k < 2 D, a face of the cube: p on the surface of the unit cube, v in (0, 1]; v = 0 is infinity. The coordinates
  are those of p on the face, then v: the inverse-range chart;
- piece 2 D, inside the cube: v = 1, the coordinates are those of p;
- piece 2 D + 1 + p, around the known minimum p, the fix first: v = 1, the coordinates are the principal axes s of that
  minimum (`optloc.proof.chart`).

The line to a station at ``m + R a`` is, but for the factor R/v, ``p - v a``.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.forms import Triple, inner, pull, triple
from optloc.proof.nodes import RATIO
from optloc.types import Array

# Half-width of the cube, reaches of the stations.
_REACHES = 1.25


class Atlas(NamedTuple):
    """Pieces of space, and working memory for one box.

    Parameters
    ----------
    middle : array (3,)
        Centre of the cube, metres.
    radius : float
        Half its side; all stations lie inside.
    dimension : int
        2 or 3.
    origin, axes, back : array (P, 3), (P, 3, 3), (P, 3, 3)
        Search coordinates s around the known minima, ``x = origin + axes s``.
    sides : array (P, 3)
        Half-widths of boxes around them on which the cost is convex.
    point, away, away_b : array (3,)
        p at the centre of a box, and the scaled lines to a node's stations.
    flat, sense, sense_b : array (3, 3)
        Their derivatives with respect to the coordinates of the piece.
    scale : array (3,)
        v at the centre of a box; and 1 on a face, where it varies.
    bend, second : array (3, 3)
        Second derivatives.
    """

    middle: Array
    radius: float
    dimension: int
    origin: Array
    axes: Array
    back: Array
    sides: Array
    point: Array
    away: Array
    away_b: Array
    flat: Array
    sense: Array
    sense_b: Array
    scale: Array
    bend: Array
    second: Array


@compiled
def atlas_of(middle: Array, radius: float, dimension: int, count: int) -> Atlas:
    """Return the pieces around a cube, centre `middle` (3,) and half-width `radius`, with room for `count` minima."""
    lines, matrices = np.zeros((4, 3)), np.zeros((5, 3, 3))
    return Atlas(
        middle,
        radius,
        dimension,
        np.zeros((count, 3)),
        np.zeros((count, 3, 3)),
        np.zeros((count, 3, 3)),
        np.zeros((count, 3)),
        lines[0],
        lines[1],
        lines[2],
        matrices[0],
        matrices[1],
        matrices[2],
        lines[3],
        matrices[3],
        matrices[4],
    )


@compiled
def first_minima(atlas: Atlas, count: int) -> Atlas:
    """Return the atlas with the first `count` of its minima."""
    return Atlas(
        atlas.middle,
        atlas.radius,
        atlas.dimension,
        atlas.origin[:count],
        atlas.axes[:count],
        atlas.back[:count],
        atlas.sides[:count],
        atlas.point,
        atlas.away,
        atlas.away_b,
        atlas.flat,
        atlas.sense,
        atlas.sense_b,
        atlas.scale,
        atlas.bend,
        atlas.second,
    )


@compiled
def set_centre(atlas: Atlas, piece: int, at: Array) -> None:
    """Write point and scale at the centre of a box, and their derivatives.

    Parameters
    ----------
    atlas : Atlas
        Its working memory is written.
    piece : int
        Which piece; the faces 2 k and 2 k + 1 have p_k = -1 and 1.
    at : array (3,)
        Centre in the coordinates of the piece.
    """
    d, flat, point = atlas.dimension, atlas.flat, atlas.point
    flat[:] = 0.0
    atlas.scale[0], atlas.scale[1] = 1.0, 0.0
    if piece == 2 * d:
        for k in range(d):
            point[k], flat[k, k] = at[k], 1.0
    elif piece > 2 * d:
        origin, sense = atlas.origin[piece - 2 * d - 1], atlas.axes[piece - 2 * d - 1]
        for k in range(d):
            move = sense[k, 0] * at[0] + sense[k, 1] * at[1] + sense[k, 2] * at[2]
            point[k] = (origin[k] + move - atlas.middle[k]) / atlas.radius
            for m in range(d):
                flat[k, m] = sense[k, m] / atlas.radius
    else:
        column = 0
        for k in range(d):
            if k == piece // 2:
                point[k] = 1.0 if piece % 2 else -1.0
            else:
                point[k], flat[k, column] = at[column], 1.0
                column += 1
        atlas.scale[0], atlas.scale[1] = at[d - 1], 1.0


@compiled
def position(atlas: Atlas, x: Array) -> None:
    """Write the position x (D,) of the centre that `set_centre` has set; v must not be zero."""
    for k in range(atlas.dimension):
        x[k] = atlas.middle[k] + atlas.radius * atlas.point[k] / atlas.scale[0]


@compiled
def within(atlas: Atlas, half: Array, p: int, wider: float, least: float) -> bool:
    """Return whether a box lies inside the box around minimum p with half-widths ``max(wider sides, least)``.

    Times v, each of these inequalities is between linear forms in the coordinates of every piece.

    Parameters
    ----------
    atlas : Atlas
        Set by `set_centre`.
    half : array (3,)
        Half-widths of the box.
    p : int
        Which minimum.
    wider, least : float
        Factor of the sides of the convex box, and standard deviations.
    """
    d, v, last = atlas.dimension, atlas.scale[0], atlas.dimension - 1
    back, origin = atlas.back[p], atlas.origin[p]
    for k in range(d):
        middle, still, side = 0.0, 0.0, max(wider * atlas.sides[p, k], least)
        for m in range(d):
            middle += atlas.radius * back[k, m] * atlas.point[m]
            still += back[k, m] * (atlas.middle[m] - origin[m])
        middle += still * v
        low = high = 0.0
        for c in range(d):
            slope = 0.0
            for m in range(d):
                slope += atlas.radius * back[k, m] * atlas.flat[m, c]
            varies = atlas.scale[1] if c == last else 0.0
            slope += still * varies
            low += abs(-slope - side * varies) * half[c]
            high += abs(slope - side * varies) * half[c]
        room = side * v * (1.0 - 1e-9)
        if middle + high > room or low - middle > room:
            return False
    return True


@compiled
def set_line(atlas: Atlas, data: Array, first: int, away: Array, sense: Array) -> None:
    """Write the scaled line p - v a to the station at data[first:first + 3], and its derivative."""
    last = atlas.dimension - 1
    for k in range(atlas.dimension):
        a = (data[first + k] - atlas.middle[k]) / atlas.radius
        away[k] = atlas.point[k] - atlas.scale[0] * a
        for m in range(atlas.dimension):
            sense[k, m] = atlas.flat[k, m]
        sense[k, last] -= a * atlas.scale[1]


@compiled
def scaled_station(atlas: Atlas, data: Array) -> tuple[float, float, Triple]:
    """Return ``|a|`` of a station a, and ``N = -2 a.p + v |a|^2`` with its gradient, a constant."""
    a = (
        (data[0] - atlas.middle[0]) / atlas.radius,
        (data[1] - atlas.middle[1]) / atlas.radius,
        (data[2] - atlas.middle[2]) / atlas.radius if atlas.dimension == 3 else 0.0,
    )
    squared, n = inner(a, a), pull((-2.0 * a[0], -2.0 * a[1], -2.0 * a[2]), atlas.flat)
    steep = squared * atlas.scale[1]
    n = (n[0], n[1] + steep, 0.0) if atlas.dimension == 2 else (n[0], n[1], n[2] + steep)
    return sqrt(squared), atlas.scale[0] * squared - 2.0 * inner(a, triple(atlas.point, 0)), n


@compiled
def cube(kinds: Array, data: Array) -> tuple[Array, float]:
    """Return centre (3,) and half-width of a cube that holds all stations well.

    Parameters
    ----------
    kinds, data : array (J,), (J, WIDTH)
        Nodes that have stations.
    """
    low, high = np.full(3, inf), np.full(3, -inf)
    for j in range(kinds.shape[0]):
        for first in range(0, 6 if kinds[j] == RATIO else 3, 3):
            for k in range(3):
                low[k], high[k] = min(low[k], data[j, first + k]), max(high[k], data[j, first + k])
    reach = 0.0
    for k in range(3):
        reach = max(reach, 0.5 * (high[k] - low[k]))
    return 0.5 * (low + high), max(_REACHES * reach, 1.0)
