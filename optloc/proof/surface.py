"""Surfaces of a known height as graphs: over a box along the surface, nodes are functions of two coordinates.

Around a point c of the surface, its points are ``x(s) = c + T s + n t(s)``. T is along the surface, n is the upward
axis of the local coordinates, and t has no slope at c. The height is convex with a Hessian below 1/R, so t and its
derivatives are bounded. If a node is bounded over the box of s and t, it is bounded along the surface, and so is its
curvature.

A whole surface has six pieces, one for each direction of three axes through the Earth's centre. Each point belongs to
the direction along which it is farthest from the centre.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, put_rows
from optloc.kernels.systems import roughly_principal
from optloc.models.primitives import WGS84_A
from optloc.proof.nodes.level import EXACT, HEIGHT_WIDTH, LEAST_RADIUS, curve_height, normal_at
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
    SLOPE2,
    TURN0,
    TURN1,
    TURN2,
    inner_product,
    triple_at,
)

# Numbers of a surface: its height, the numbers of the height node, the Earth's centre, and three orthonormal axes of a
# piece, of which the last is upward. An array of length zero means no surface.
LEVEL, DATA, MIDDLE, FIRST, SECOND, UP = 0, 1, 1 + HEIGHT_WIDTH, 4 + HEIGHT_WIDTH, 7 + HEIGHT_WIDTH, 10 + HEIGHT_WIDTH
SURFACE_WIDTH, SIDES = 13 + HEIGHT_WIDTH, 6
# Numbers of a graph over a box: greatest distance below the tangent plane, and greatest distance of the centre from
# the surface; greatest slopes; the Hessian at the centre; the greatest norm and the greatest change of the Hessian.
SAG, SLIP, _STEEP0, _STEEP1, _BEND00, _BEND01, _BEND11, _BENT, _TURNED, GRAPH_WIDTH = range(10)
# Newton steps down to a surface, each of which doubles the number of exact digits. They end at the accuracy of a
# height. A centre that is up to `_LOOSE` times as far off the surface is accepted, because the bounds include this
# distance.
_STEPS, _LOOSE = 20, 10.0
# Least cosine between the normal and the upward axis for which a surface counts as a graph; a piece ends at 0.57. And
# the least radius of curvature, as a share of the Earth's least radius: heights are exact down to this depth.
_STEEP, _LEFT = 0.2, 0.7


@compiled
def is_beyond(surface: Array, centre: Array, sense: Array, half: Array) -> bool:
    """Return whether all points of a surface over a box belong to other pieces, along whose axes they are farther out.

    Parameters
    ----------
    surface : array (SURFACE_WIDTH,)
        The surface, with the axes of the piece.
    centre, sense, half : array (3,), (3, 3), (3,)
        The box in the plane of the local coordinates; only components along this plane are read.
    """
    most, nearest, aside = WGS84_A + abs(surface[LEVEL]), 0.0, 0.0
    for first in (FIRST, SECOND):
        away = reach = 0.0
        for m in range(3):
            away += surface[first + m] * (centre[m] - surface[MIDDLE + m])
        for k in range(2):
            slope = 0.0
            for m in range(3):
                slope += surface[first + m] * sense[m, k]
            reach += abs(slope) * half[k]
        least = max(abs(away) - reach, 0.0) * (1.0 - 1e-9)
        nearest, aside = max(nearest, least), aside + least * least
    return bool(nearest * nearest > most * most - aside)


@compiled
def lay_box(surface: Array, centre: Array, half: Array, sense: Array, gram: Array, graph: Array, second: Array) -> bool:
    """Move the centre of a box onto a surface, and the box into the tangent plane; return False if it is too large.

    Parameters
    ----------
    surface : array (SURFACE_WIDTH,)
        The surface.
    centre, half : array (3,)
        Centre, metres; moved. Half-widths; the third is written: the greatest distance of the surface from the box.
    sense, gram : array (3, 3)
        T of the local coordinates, whose third column is the upward axis; turned into the tangent plane. T'T is
        written.
    graph : array (GRAPH_WIDTH,)
        Written: the numbers of the graph over the box, see the columns above.
    second : array (3, 3)
        Working memory.
    """
    data, up, off, rise = surface[DATA:MIDDLE], triple_at(surface, UP), 0.0, 0.0
    exact = EXACT * max(1.0, surface[LEVEL] / LEAST_RADIUS)
    _, normal, _, _, _ = normal_at(data, centre)
    for _ in range(_STEPS):
        height, normal, _, _, _ = normal_at(data, centre)
        rise, off = inner_product(normal, up), height - surface[LEVEL]
        if not rise > _STEEP:
            return False
        if abs(off) <= exact:
            break
        for m in range(3):
            centre[m] -= off / rise * up[m]
    if not abs(off) <= _LOOSE * exact:
        return False
    farthest = size = 0.0
    for k in range(2):
        lean = -inner_product(normal, (sense[0, k], sense[1, k], sense[2, k])) / rise
        square = 0.0
        for m in range(3):
            sense[m, k] += up[m] * lean
            square += sense[m, k] * sense[m, k]
        graph[_STEEP0 + k] = sqrt(square)  # the length of the column, until `_write_graph` replaces it
        farthest += square * half[k] * half[k]
        size += square
    between = sense[0, 0] * sense[0, 1] + sense[1, 0] * sense[1, 1] + sense[2, 0] * sense[2, 1]
    reach = sqrt(farthest + 2.0 * abs(between) * half[0] * half[1])
    # A tangent plane is outside the surface, and so is all space between them. In this space no height curves more
    # than on the surface. So at |w| <= reach in the plane, the height is at most |w|^2 / 2R. From there it falls by
    # its slope, less the turn of the normal on the way. So t is between zero and the sag.
    radius = LEAST_RADIUS + surface[LEVEL]
    if not radius > _LEFT * LEAST_RADIUS:
        return False
    bend = 1.0 / radius
    share = 0.5 * bend / rise
    if not 4.0 * share * reach < 1.0:
        return False
    sag = 2.0 * share * reach * reach / (1.0 - 2.0 * share * reach + sqrt(1.0 - 4.0 * share * reach))
    least = rise - bend * (reach + sag)
    if not (sag <= reach and least > 0.5 * _STEEP):
        return False
    _write_graph(data, centre, half, sense, gram, graph, second, (sag, rise, least, bend, size))
    # The factor 2: for changes that grow with the box, the mean of slopes over the box counts half. This distance does
    # not grow with the box.
    graph[SLIP] = 2.0 * (abs(off) + 4.0 * exact) / least
    half[2] = graph[SAG] + graph[SLIP]
    return True


@compiled
def _write_graph(
    data: Array,
    centre: Array,
    half: Array,
    sense: Array,
    gram: Array,
    graph: Array,
    second: Array,
    found: tuple[float, float, float, float, float],
) -> None:
    """Write slopes and curvature of a surface over a box, from the derivatives of ``height(x(s)) = value``.

    `data` are the numbers of the height node, and the other arrays are as in `lay_box`. `found` contains the sag (m),
    the cosine between normal and upward axis at the centre, the least such cosine over the box, the greatest curvature
    of the height (1/m), and the sum of the squared lengths of the two tangents.
    """
    sag, rise, least, bend, size = found
    for k in range(3):
        for m in range(3):
            gram[k, m] = sense[0, k] * sense[0, m] + sense[1, k] * sense[1, m] + sense[2, k] * sense[2, m]
    way = sag
    for k in range(2):
        way += graph[_STEEP0 + k] * half[k]
    steep = 0.0
    for k in range(2):
        # The normal turns by at most its bend times the way. At the centre it has no component along the tangents.
        graph[_STEEP0 + k] *= bend * way / least
        steep += graph[_STEEP0 + k] * graph[_STEEP0 + k]
    half[2], graph[SAG] = sag, sag
    curve_height(data, centre, sense, half, second, graph[_BEND00 : _BEND11 + 1])  # bounds of changes follow below
    graph[_BEND00], graph[_BEND01], graph[_BEND11] = -second[0, 0] / rise, -second[0, 1] / rise, -second[1, 1] / rise
    long, steep = sqrt(size), sqrt(steep)
    wide = (long + steep) * (long + steep)
    graph[_BENT] = bend * wide / least
    # The Hessian of a height changes by 1.2 / R^2 a metre at most (`optloc.proof.nodes.level.curve_height`).
    change = 1.2 * bend * bend * way * wide + bend * (2.0 * long + steep) * steep
    graph[_TURNED] = change / least + bend * size * bend * way / (least * rise)


@compiled
def fold_bounds(graph: Array, lean: Array, nodes: Array) -> None:
    """Turn bounds of nodes over a box of (s, t) into bounds along the surface, where -(SAG + SLIP) <= t <= SLIP.

    `graph` is the result of `lay_box`. The slopes along the upward axis are moved from `nodes` to `lean` (J,).
    """
    sag, slip = graph[SAG] + graph[SLIP], graph[SLIP]
    for j in range(nodes.shape[0]):
        slope = nodes[j, SLOPE2]
        nodes[j, LOW] += min(-slope * sag, slope * slip)
        nodes[j, HIGH] += max(-slope * sag, slope * slip)
        lean[j], nodes[j, SLOPE2] = slope, 0.0


@compiled
def unfold_slopes(lean: Array, nodes: Array) -> None:
    """Restore the slopes of nodes along the upward axis from `lean` (J,); their second derivatives need them."""
    for j in range(nodes.shape[0]):
        nodes[j, SLOPE2] = lean[j]


@compiled
def fold_curves(graph: Array, lean: Array, nodes: Array, curves: Array) -> None:
    """Turn second derivatives over a box of (s, t) into second derivatives along the surface, by the chain rule.

    `graph` and `lean` are the results of `lay_box` and `fold_bounds`. The table `curves` (J, CURVE_WIDTH) is changed.
    """
    steep = sqrt(graph[_STEEP0] * graph[_STEEP0] + graph[_STEEP1] * graph[_STEEP1])
    for j in range(nodes.shape[0]):
        slope, turn, chi = lean[j], curves[j, TURN2], curves[j, CHI]
        mixed = sqrt(curves[j, H02] * curves[j, H02] + curves[j, H12] * curves[j, H12]) + chi
        along = (abs(curves[j, H22]) + chi) * steep
        curves[j, TURN0] += (abs(slope) + turn) * graph[_STEEP0]
        curves[j, TURN1] += (abs(slope) + turn) * graph[_STEEP1]
        curves[j, CHI] = chi + (2.0 * mixed + along) * steep + turn * graph[_BENT] + abs(slope) * graph[_TURNED]
        curves[j, H00] += slope * graph[_BEND00]
        curves[j, H01] += slope * graph[_BEND01]
        curves[j, H11] += slope * graph[_BEND11]
        curves[j, H02] = curves[j, H12] = curves[j, H22] = curves[j, TURN2] = nodes[j, SLOPE2] = 0.0


@compiled
def reach_of_piece(surface: Array, origin: Array, sense: Array, low: Array, high: Array) -> None:
    """Contract corners `low` and `high` (3,) of search coordinates to this piece of the surface.

    The third coordinate becomes 0.

    `origin` (m) and `sense` define the search coordinates: x = origin + sense s.
    """
    # A point of this piece is farthest along the third axis. So each other coordinate is at most sqrt(1/2) of its
    # distance from the centre: the squares sum to the squared distance.
    most = sqrt(0.5) * (WGS84_A + abs(surface[LEVEL])) * (1.0 + 1e-9)
    for k in range(2):
        unit, away = triple_at(surface, FIRST if k == 0 else SECOND), 0.0
        size = inner_product(unit, (sense[0, k], sense[1, k], sense[2, k]))
        for m in range(3):
            away += unit[m] * (origin[m] - surface[MIDDLE + m])
        low[k], high[k] = max(low[k], (-most - away) / size), min(high[k], (most - away) / size)
    low[2] = high[2] = 0.0


@compiled
def is_one_side(surface: Array, origin: Array, sense: Array, low: Array, high: Array) -> bool:
    """Return whether the whole part of a surface between corners (3,) of search coordinates belongs to one piece.

    `origin` (m) and `sense` define the search coordinates: x = origin + sense s. If True, other pieces need no search.
    """
    aside, below = 0.0, 0.0
    for m in range(3):
        below += surface[UP + m] * (origin[m] - surface[MIDDLE + m])
    for first in (FIRST, SECOND):
        away, reach = 0.0, 0.0
        for m in range(3):
            away += surface[first + m] * (origin[m] - surface[MIDDLE + m])
        for k in range(2):
            slope = 0.0
            for m in range(3):
                slope += surface[first + m] * sense[m, k]
            reach += abs(slope) * max(abs(low[k]), abs(high[k]))
        aside = max(aside, abs(away) + reach)
    return bool(below + low[2] > aside * (1.0 + 1e-9))


# Axes of search coordinates along planes or a surface.

# An axis of space is usable if its component across the other axes is at least this long. For one of the three axes
# the component is at least 0.57.
_ACROSS = 0.5
# Sine of the angle between two planes below which their common line has lost half of its digits.
_PARALLEL = 1e-8


@compiled
def set_tangents(D: int, planes: Array, surface: Array, axes: Array) -> int:
    """Write orthonormal axes (3, 3): first those along planes or a surface, then across; return the number along.

    The axes are columns, D is the dimension, and `planes` (e, 3) contains normals. The result is 0 if planes are nearly
    parallel, because the common directions are then unknown.
    """
    bent, apart = int(surface.shape[0] > 0), True
    across = planes.shape[0] + bent + 3 - D
    # From the last column on: the axis that a plane does not have, the normal of the surface, the normals of the
    # planes, then any other axes.
    for number in range(3):
        k = 2 - number
        if number < 3 - D:
            first = (0.0, 0.0, 1.0)
        elif number < 3 - D + bent:
            first = triple_at(surface, UP)
        elif number < across:
            first = triple_at(planes[number - bent - 3 + D], 0)
        else:
            first = (0.0, 0.0, 0.0)
        if number < across:
            apart = _set_axis(axes, k, first) > _PARALLEL and apart
        else:
            for turn in range(3):  # an axis of space, first axis k; without planes this one is taken
                m = (k + turn) % 3
                start = (1.0 if m == 0 else 0.0, 1.0 if m == 1 else 0.0, 1.0 if m == 2 else 0.0)
                if _set_axis(axes, k, start) > _ACROSS:
                    break
    return int(3 - across) if apart else 0


@compiled
def _set_axis(axes: Array, k: int, start: tuple[float, float, float]) -> float:
    """Write the unit vector of the part of `start` across the axes behind k as axis k.

    Return the length of this part.
    """
    length = 0.0
    for m in range(3):
        axes[m, k] = start[m]
    for _ in range(2):  # twice is exact (Parlett 1980)
        for other in range(k + 1, 3):
            along = axes[0, k] * axes[0, other] + axes[1, k] * axes[1, other] + axes[2, k] * axes[2, other]
            for m in range(3):
                axes[m, k] -= along * axes[m, other]
    length = sqrt(axes[0, k] ** 2 + axes[1, k] ** 2 + axes[2, k] ** 2)
    for m in range(3):
        axes[m, k] /= length if length > 0.0 else 1.0
    return length


@compiled
def principal_along(information: Array, axes: Array, count: int) -> None:
    """Turn the first `count` axes (columns) so that information (3, 3) is nearly diagonal along them.

    The information along the new axes replaces `information`.
    """
    own, turned, vectors = np.zeros((3, 3)), axes.copy(), np.zeros((3, 3))
    for k in range(count):
        for m in range(count):
            for i in range(3):
                for j in range(3):
                    own[k, m] += axes[i, k] * information[i, j] * axes[j, m]
    roughly_principal(own, vectors)
    put_rows(own, information)
    for k in range(count):
        for m in range(3):
            axes[m, k] = 0.0
            for i in range(count):
                axes[m, k] += turned[m, i] * vectors[i, k]
