"""What a proof works on: the cost, search coordinates around a fix, and tables for one box."""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined, put_rows
from optloc.kernels.systems import roughly_principal
from optloc.models.primitives import WGS84_A
from optloc.proof.atlas import Atlas, AtlasMinima
from optloc.proof.box import (
    ROW_WIDTH,
    bound_nodes,
    cost_at,
    reaches_infinity,
    relative_rounding,
    rounding_error,
    station_cube,
)
from optloc.proof.curvature import (
    DETERMINED,
    FAINT,
    G0,
    G1,
    G2,
    SUMS,
    bend_axes,
    curve_nodes,
    is_convex_over_box,
    least_diagonal,
    sum_up,
)
from optloc.proof.groups import Groups, empty_groups, set_groups
from optloc.proof.nodes.dispatch import bound_pieces, curve_pieces, size_of
from optloc.proof.nodes.level import LEAST_RADIUS
from optloc.proof.nodes.node import ANY, CURVE_WIDTH, H00, H01, H02, H11, H12, H22, NODE_WIDTH, RANGE
from optloc.proof.surface import (
    FIRST,
    GRAPH_WIDTH,
    LEVEL,
    MIDDLE,
    SAG,
    SECOND,
    SLIP,
    UP,
    fold_bounds,
    fold_curves,
    lay_box,
    principal_along,
    set_tangents,
    unfold_slopes,
)

# Roundings of a coordinate on its way from search coordinates to metres: three products, three sums, and the sizes of
# what they are rounded beside.
_PLACED = 8.0 * 2.0**-52
# A residual counts 34 roundings or more for each size (`optloc.proof.box.relative_rounding`), of coordinates a share.
# Lines from a position to stations are as exact as their own lengths, for a difference of two doubles is rounded once: what is left
# are the 8 roundings of a position as it is placed.
LINES = 0.25
# Rounding of a residual up to which ranges are counted from a place: costs are then right to a hundredth.
_SHARP = 0.02


class Cost(NamedTuple):
    """The cost ``f(x) = |K phi(x) - w|^2``.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes.
    K, w : array (q, J), (q,)
        Whitened rows.
    A : array (J, J)
        ``K'K``.
    weight : array (J,)
        Lengths of the columns of K.
    groups : Groups
        The nodes in groups.
    """

    kinds: Array
    data: Array
    K: Array
    w: Array
    A: Array
    weight: Array
    groups: Groups


HIDDEN_REACH = 5e4
"""How far around a minimum that does not count nothing else does, metres: such minima lie deep in the Earth."""


class KnownMinima(NamedTuple):
    """What is known of a problem beside its fix.

    Parameters
    ----------
    points : array (P, D)
        Other minima, polished; boxes around them that hold no second one are set aside.
    hidden : int
        The last so many of them do not count, though they may cost less: nor does what is near them.
    planes : array (e, 3)
        Normals of planes through the fix to which the claim is limited.
    surface : array (0,) or (SURFACE_WIDTH,)
        The surface of a height to which it is limited, see `optloc.proof.surface`; never together with planes.
    """

    points: Array
    hidden: int
    planes: Array
    surface: Array


class LocalAxes(NamedTuple):
    """Search coordinates s with ``x = origin + sense s``: principal axes of the fix, one unit a standard deviation.

    On planes there are fewer of them. On the surface of a height two: the third axis is upward, as
    `optloc.proof.surface` says, and points are off the origin along it as far as the surface is.

    Parameters
    ----------
    origin : array (3,)
        The fix.
    sense, back, gram : array (3, 3)
        T, its inverse, and T'T; columns of T, rows of the inverse and both of T'T are zero for coordinates that there
        are not.
    slip : array (3,)
        How far the rounding of coordinates of one metre moves a point, search coordinates.
    floor : float
        The sizes of what residuals are differences of, beside the nodes: measurements and coordinates.
    surface : array (0,) or (SURFACE_WIDTH,)
        The surface of a height, with the axes of this piece.
    differs, middle : bool, array (3,)
        Whether ranges on it are counted from a place, the middle of the stations: differences of ranges
        (`optloc.proof.nodes.range.bound_difference`) bend less over boxes as large as a continent.
    """

    origin: Array
    sense: Array
    back: Array
    gram: Array
    slip: Array
    floor: float
    surface: Array
    differs: bool
    middle: Array


class Box(NamedTuple):
    """A box and its tables.

    Parameters
    ----------
    at, half : array (3,)
        Centre and half-widths, search coordinates.
    centre : array (3,)
        Centre, metres.
    line : array (6,)
        Working memory.
    nodes, rows, curves, sums : array (J, NODE_WIDTH), (q, ROW_WIDTH), (J, CURVE_WIDTH), (SUMS,)
        Tables, see `optloc.proof.box`.
    solve : array (3, 3)
        Working memory.
    cut : array (6,)
        Ends of the part of the box that is left, about its centre.
    sense, gram, graph, lean : array (3, 3), (3, 3), (GRAPH_WIDTH,), (J,)
        Of a box on a surface: its own T and T'T, the graph of the surface, and slopes along the upward axis.
    inside : array (10, 3, 3)
        Of a box on a surface: numbers of its place in the inside of an atlas, see `_inside_of`.
    """

    at: Array
    half: Array
    centre: Array
    line: Array
    nodes: Array
    rows: Array
    curves: Array
    sums: Array
    solve: Array
    cut: Array
    sense: Array
    gram: Array
    graph: Array
    lean: Array
    inside: Array


@compiled
def cost_of(kinds: Array, data: Array, K: Array, w: Array) -> Cost:
    """Return the cost of nodes and whitened rows."""
    A, weight, groups = np.empty((K.shape[1], K.shape[1])), np.empty(K.shape[1]), empty_groups(K.shape[1])
    set_geometry(kinds, K, A, weight, groups)
    return Cost(kinds, data, K, w, A, weight, groups)


@compiled
def set_geometry(kinds: Array, K: Array, A: Array, weight: Array, groups: Groups) -> None:
    """Write what a cost takes from its rows alone: `A`, `weight` and `groups` of `Cost`."""
    for j in range(K.shape[1]):
        for m in range(j, K.shape[1]):
            total = 0.0
            for i in range(K.shape[0]):
                total += K[i, j] * K[i, m]
            A[j, m] = A[m, j] = total
        weight[j] = sqrt(A[j, j])
    set_groups(kinds, A, groups)


# A box and its tables.


@compiled
def empty_box(q: int, J: int) -> Box:
    """Return tables for boxes of J nodes and q rows."""
    return Box(
        np.zeros(3),
        np.zeros(3),
        np.zeros(3),
        np.empty(6),
        np.empty((J, NODE_WIDTH)),
        np.empty((q, ROW_WIDTH)),
        np.empty((J, CURVE_WIDTH)),
        np.empty(SUMS),
        np.empty((3, 3)),
        np.empty(6),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(GRAPH_WIDTH),
        np.empty(J),
        np.empty((10, 3, 3)),
    )


@compiled
def chart_at(cost: Cost, x: Array, box: Box) -> tuple[LocalAxes, bool]:
    """Return the search coordinates around a fix x (D,), and whether the rows determine them.

    The tables of the box are those of the fix afterwards: values of the nodes, forces (`CURVE_WIDTH`), and sums, whose
    gradient is that along the search coordinates.
    """
    return chart_on(cost, x, box, np.empty((0, 3)), np.empty(0))


@compiled
def chart_on(cost: Cost, x: Array, box: Box, planes: Array, surface: Array) -> tuple[LocalAxes, bool]:
    """Return the search coordinates around a fix on planes or a surface, see `KnownMinima`; else of `chart_at`."""
    D = x.shape[0]
    vectors, numbers = np.zeros((2, 3)), np.zeros((3, 3, 3))
    origin, slip, sense, back, gram = vectors[0], vectors[1], numbers[0], numbers[1], numbers[2]
    nodes, curves, sums, information = box.nodes, box.curves, box.sums, box.solve
    for k in range(D):
        origin[k] = x[k]
        sense[k, k] = gram[k, k] = 1.0
    box.half[:] = 0.0
    bound_nodes(cost.kinds, cost.data, origin, sense, gram, box.half, box.line, nodes)
    curves[:] = 0.0
    sum_up(cost.K, cost.w, cost.weight, 0.0, nodes, curves, sums)
    information[0, 0], information[1, 1], information[2, 2] = sums[H00], sums[H11], sums[H22]
    information[0, 1] = information[1, 0] = sums[H01]
    information[0, 2] = information[2, 0] = sums[H02]
    information[1, 2] = information[2, 1] = sums[H12]
    # `gram` holds the axes for the moment; it is written anew below.
    if planes.shape[0] + surface.shape[0] == 0:
        count = D
        roughly_principal(information, gram)
    else:
        count = set_tangents(D, planes, surface, gram)
        principal_along(information, gram, count)
    most = max(information[0, 0], information[1, 1], information[2, 2])
    if count == D and least_diagonal(information, D) <= FAINT * most:
        lengths = information.copy()  # what follows overwrites it
        unit = np.eye(3)
        curve_nodes(cost.kinds, cost.data, origin, unit, unit, box.half, box.line, information, nodes, curves)
        sum_up(cost.K, cost.w, cost.weight, 0.0, nodes, curves, sums)
        bend_axes(sums, gram, lengths, D)
        for k in range(D):
            information[k, k] = lengths[k, k]
    good, sense[:] = count > 0, 0.0
    for k in range(count):
        length = information[k, k]
        good = good and length > DETERMINED * most
        root = sqrt(length) if length > 0.0 else 1.0
        for m in range(3):
            sense[m, k], back[k, m] = gram[m, k] / root, gram[m, k] * root
            slip[k] += _PLACED * abs(back[k, m])
    own = surface.copy()
    if surface.shape[0] > 0:  # axes of the piece, of unit length
        for m in range(3):
            own[FIRST + m], own[SECOND + m] = gram[m, 0], gram[m, 1]
            sense[m, 2] = back[2, m] = surface[UP + m]
    g0, g1, g2 = sums[G0], sums[G1], sums[G2]
    for k in range(3):
        along = sense[0, k] * g0 + sense[1, k] * g1 + sense[2, k] * g2
        sums[G0 + k] = along if k < count else 0.0
        for m in range(3):
            gram[k, m] = sense[0, k] * sense[0, m] + sense[1, k] * sense[1, m] + sense[2, k] * sense[2, m]
    floor = accuracy_floor(cost.kinds, cost.data, cost.weight, cost.w, origin, LINES)
    chart = LocalAxes(origin, sense, back, gram, slip, floor, own, False, origin)
    if own.shape[0] > 0 and reaches_infinity(cost.kinds, cost.K):
        middle, _ = station_cube(cost.kinds, cost.data, x)
        floor += _length_of_lines(cost, own, middle)
        # Lines from anywhere have fewer digits than those from the fix, which very sharp rows need.
        if relative_rounding(cost.K) * floor < _SHARP:
            chart = LocalAxes(origin, sense, back, gram, slip, floor, own, True, middle)
    return chart, good


@compiled
def _length_of_lines(cost: Cost, surface: Array, middle: Array) -> float:
    """Return the sizes of lines from anywhere on a surface, whose lengths the differences of ranges need."""
    size, total = WGS84_A + abs(surface[LEVEL]) + abs(middle[0]) + abs(middle[1]) + abs(middle[2]), 0.0
    for j in range(cost.kinds.shape[0]):
        if cost.kinds[j] == RANGE:
            total += 4.0 * cost.weight[j] * (size + abs(cost.data[j, 0]) + abs(cost.data[j, 1]) + abs(cost.data[j, 2]))
    return total


@compiled
def without_differences(chart: LocalAxes) -> LocalAxes:
    """Return the same search coordinates, in which ranges are bounded one by one."""
    origin = chart.origin
    return LocalAxes(origin, chart.sense, chart.back, chart.gram, chart.slip, chart.floor, chart.surface, False, origin)


@compiled
def accuracy_floor(kinds: Array, data: Array, weight: Array, w: Array, origin: Array, share: float) -> float:
    """Return the sizes of what residuals are differences of, beside the nodes: measurements and coordinates.

    Parameters
    ----------
    kinds, data, weight, w : arrays
        As of `Cost`.
    origin : array (3,)
        A position, metres.
    share : float
        By what share coordinates count in ranges: LINES from a position that is a double, more from one that is worked
        out in many steps.
    """
    total = 0.0
    for i in range(w.shape[0]):
        total += w[i] * w[i]
    total = sqrt(total)
    reach = abs(origin[0]) + abs(origin[1]) + abs(origin[2])
    for j in range(kinds.shape[0]):
        if kinds[j] == RANGE:  # as its node says: ranges are asked often enough to be spared the call
            size = share * (reach + (abs(data[j, 0]) + abs(data[j, 1]) + abs(data[j, 2])))
        else:
            size = size_of(kinds[j], data[j], reach)
        total += weight[j] * size
    return total


@inlined
def write_centre(origin: Array, sense: Array, at: Array, centre: Array) -> None:
    """Write the centre of a box at search coordinates `at` in metres."""
    s0, s1, s2 = at[0], at[1], at[2]
    for k in range(3):
        centre[k] = origin[k] + (sense[k, 0] * s0 + sense[k, 1] * s1 + sense[k, 2] * s2)


@inlined
def widen_by_rounding(chart: LocalAxes, centre: Array, half: Array) -> None:
    """Widen a box by how far rounding may have moved its centre, metres: all that is said of it holds where it is."""
    size = abs(centre[0]) + abs(centre[1]) + abs(centre[2])
    # What is added to the origin may be larger than the sum.
    size += 2.0 * (abs(chart.origin[0]) + abs(chart.origin[1]) + abs(chart.origin[2]))
    for k in range(3):
        half[k] += chart.slip[k] * size


@inlined
def is_bounded(cost: Cost, chart: LocalAxes, box: Box) -> bool:
    """Bound the nodes over a box; return False where it is so large that a surface is no graph over it."""
    write_centre(chart.origin, chart.sense, box.at, box.centre)
    if chart.surface.shape[0] == 0:
        bound_nodes(cost.kinds, cost.data, box.centre, chart.sense, chart.gram, box.half, box.line, box.nodes)
        return True
    return lay_on_surface(cost, chart, box)


@compiled
def lay_on_surface(cost: Cost, chart: LocalAxes, box: Box) -> bool:
    """Bound the nodes over a box whose centre is in the plane of its chart along a surface, onto which it is moved."""
    put_rows(chart.sense, box.sense)
    if not lay_box(chart.surface, box.centre, box.half, box.sense, box.gram, box.graph, box.solve):
        box.half[2] = 0.0
        return False
    if chart.differs:
        inside = _inside_of(cost, chart, box)
        _set_inside(inside, box)
        bound_pieces(inside, cost.kinds, cost.data, box.half, box.nodes)
    else:
        bound_nodes(cost.kinds, cost.data, box.centre, box.sense, box.gram, box.half, box.line, box.nodes)
    fold_bounds(box.graph, box.lean, box.nodes)
    box.half[2] = 0.0
    return True


@inlined
def _inside_of(cost: Cost, chart: LocalAxes, box: Box) -> Atlas:
    """Return the atlas whose inside holds a box on a surface: its cube is as large as the Earth.

    It is made of views at each use. A record that a box held would be counted, array by array, in every call.
    """
    m = box.inside
    numbers = m[9].reshape(9)
    # nothing reads the minima: they have room of the right kinds
    minima = AtlasMinima(cost.groups.order[0], m[0], m[:1], m[:1], m[0], m[:1])
    return Atlas(
        chart.middle,
        LEAST_RADIUS,
        3,
        minima,
        m[0, 0],
        m[1],
        numbers[:4],
        numbers[4:8],
        m[2],
        m[0, 1],
        m[0, 2],
        m[3],
        m[4],
        m[5],
    )


@compiled
def _set_inside(inside: Atlas, box: Box) -> None:
    """Set the centre of a box on a surface, and its axes, in the inside of an atlas."""
    inside.scale[0] = 1.0
    for m in range(3):
        inside.point[m] = (box.centre[m] - inside.middle[m]) / inside.radius
        inside.scale[1 + m] = 0.0
        for k in range(3):
            inside.slant[m, k] = box.sense[m, k] / inside.radius


@compiled
def curve_along(cost: Cost, chart: LocalAxes, box: Box) -> None:
    """Fill the table of second derivatives along a surface of a box that lies on it."""
    unfold_slopes(box.lean, box.nodes)
    box.half[2] = box.graph[SAG] + box.graph[SLIP]
    sense, gram, half, line, nodes, curves = box.sense, box.gram, box.half, box.line, box.nodes, box.curves
    if chart.differs:
        curve_pieces(_inside_of(cost, chart, box), cost.kinds, cost.data, half, nodes, curves)
    else:
        curve_nodes(cost.kinds, cost.data, box.centre, sense, gram, half, line, box.solve, nodes, curves)
    fold_curves(box.graph, box.lean, nodes, curves)
    box.half[2] = 0.0


@inlined
def curve_at(cost: Cost, chart: LocalAxes, box: Box) -> None:
    """Bound second derivatives of the nodes over a box whose nodes are bounded."""
    if chart.surface.shape[0] > 0:
        curve_along(cost, chart, box)
        return
    half, line, nodes, curves = box.half, box.line, box.nodes, box.curves
    curve_nodes(cost.kinds, cost.data, box.centre, chart.sense, chart.gram, half, line, box.solve, nodes, curves)


@inlined
def curve_box(cost: Cost, chart: LocalAxes, box: Box) -> None:
    """Fill the tables of second derivatives of a box whose nodes are bounded."""
    curve_at(cost, chart, box)
    noise = rounding_error(cost.K, cost.weight, chart.floor, box.nodes)
    sum_up(cost.K, cost.w, cost.weight, noise, box.nodes, box.curves, box.sums)


@compiled
def value_at(cost: Cost, chart: LocalAxes, box: Box) -> float:
    """Return f at the centre of a box, infinite where it is off a surface; its first table is filled."""
    return cost_at(cost.K, cost.w, box.nodes) if is_bounded(cost, chart, box) else inf


@inlined
def rounding_at_centre(cost: Cost, chart: LocalAxes, box: Box) -> float:
    """Return a bound of the rounding errors of a residual (its length) at the centre of a box whose nodes are bounded.

    On a surface the height, which is worked out from the Earth's centre, is rounded as well.
    """
    noise = rounding_error(cost.K, cost.weight, chart.floor, box.nodes)
    if chart.surface.shape[0] > 0:
        total = 0.0
        for i in range(cost.K.shape[0]):
            along = 0.0
            for j in range(cost.K.shape[1]):
                along += cost.K[i, j] * box.lean[j]
            total += along * along
        noise += sqrt(total) * box.graph[SLIP]
    return noise


# How far below the cost f of a fix another cost counts as equal, in roundings e of a residual: 8 e sqrt(f) + 24 e^2.
# Each of two costs is off by 2 e sqrt(f) + e^2, and half of what counts as equal is left for them; a slope of the cost
# is off by e along each of three axes, which 24 e^2 makes an eighth of the curvature, a quarter where half is left.
_COSTS, _SLOPES = 8.0, 24.0
COARSEST = 1.0
"""By how much costs may be off for a proof to be worth its name: a ninth of the gap at which two minima differ."""


@compiled
def equal_within(eps: float, least: float, noise: float) -> float:
    """Return how far below the cost `least` of a fix another counts as equal: eps, or more where rounding is coarse."""
    return float(max(eps, noise * (_COSTS * sqrt(max(least, 0.0)) + _SLOPES * noise)))


@inlined
def shapes_of(cost: Cost, chart: LocalAxes) -> Array:
    """Return the codes of the nodes for tests of convexity: along a surface a range is not convex."""
    return cost.kinds if chart.surface.shape[0] == 0 else np.full_like(cost.kinds, ANY)


@compiled
def is_convex(cost: Cost, chart: LocalAxes, box: Box, margin: float) -> bool:
    """Return whether the Hessian of f/2 exceeds `margin` all over a box, whose tables are filled."""
    if not is_bounded(cost, chart, box):
        return False
    curve_box(cost, chart, box)
    return is_convex_over_box(shapes_of(cost, chart), cost.A, box.half, box.nodes, box.curves, box.sums, margin)


@compiled
def axes_of_next_piece(cost: Cost, chart: LocalAxes, side: int) -> LocalAxes:
    """Return the search coordinates of another piece of a surface, one unit the Earth's least distance.

    Parameters
    ----------
    cost, chart : Cost, LocalAxes
        The cost, and the search coordinates around the fix, side 0.
    side : int
        1: the piece opposite to the fix; 2 to 5: those beside it.
    """
    numbers, vectors, own = np.zeros((3, 3, 3)), np.zeros((2, 3)), chart.surface.copy()
    origin, slip, sense, back = vectors[0], vectors[1], numbers[0], numbers[1]
    sign, radius = -1.0 if side % 2 else 1.0, LEAST_RADIUS
    for k, column in ((0, FIRST), (1, SECOND), (2, UP)):
        source = FIRST + 3 * ((side // 2 + k) % 3)
        for m in range(3):
            own[column + m] = chart.surface[source + m] * (sign if k == 2 else 1.0)
            sense[m, k], back[k, m] = own[column + m] * radius, own[column + m] / radius
            slip[k] += _PLACED * abs(back[k, m])
    for m in range(3):
        sense[m, 2] = back[2, m] = own[UP + m]
        origin[m] = own[MIDDLE + m] + radius * own[UP + m]
    slip[2] = 0.0
    floor = accuracy_floor(cost.kinds, cost.data, cost.weight, cost.w, origin, LINES)
    if chart.differs:
        floor += _length_of_lines(cost, own, chart.middle)
    return LocalAxes(origin, sense, back, numbers[2], slip, floor, own, chart.differs, chart.middle)
