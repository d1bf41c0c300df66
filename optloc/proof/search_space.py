"""Data of a proof: the cost, search coordinates around a fix, and tables for one box.

Letters: J nodes (scalar functions of the position, such as ranges), q whitened rows, D coordinates of a position.
Search coordinates s (3,) are along principal axes of the fix, and their unit is one standard deviation.
"""

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

# Rounding of a coordinate from search coordinates to metres: three products and three sums, relative to the sizes of
# their terms.
_PLACED = 8.0 * 2.0**-52
# A residual counts 34 roundings or more for each size (`optloc.proof.box.relative_rounding`); coordinates count with
# this share.
# A line from a position to a station is as exact as its length, because the difference of two doubles is rounded once.
# So only the 8 roundings of the position itself remain.
LINES = 0.25
# Rounding of a residual up to which ranges are counted from a reference position: costs are then right to a hundredth.
_SHARP = 0.02


class Cost(NamedTuple):
    """The cost ``f(x) = |K phi(x) - w|^2`` of a position x, as a function of nodes phi: chi-square, without a unit.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes: their codes and their numbers.
    K, w : array (q, J), (q,)
        Whitened rows and whitened measurements.
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
"""Radius, metres, around a hidden minimum in which other points are hidden too: such minima are deep in the Earth."""


class KnownMinima(NamedTuple):
    """Known minima other than the fix, and the equalities of a problem.

    Parameters
    ----------
    points : array (P, D)
        Other minima, polished, metres. Boxes around them without a second minimum are excluded from the search.
    hidden : int
        The last `hidden` minima do not count, although they may cost less. Points near them do not count either.
    planes : array (e, 3)
        Normals of planes through the fix to which the claim is limited.
    surface : array (0,) or (SURFACE_WIDTH,)
        The surface of a height to which the claim is limited, see `optloc.proof.surface`; never together with planes.
    """

    points: Array
    hidden: int
    planes: Array
    surface: Array


class LocalAxes(NamedTuple):
    """Search coordinates s with ``x = origin + sense s``: principal axes of the fix, in units of standard deviations.

    With planes there are fewer coordinates. On the surface of a height there are two. The third axis is then upward,
    and the distance of points from the origin along it follows from the surface (`optloc.proof.surface`).

    Parameters
    ----------
    origin : array (3,)
        The fix, metres.
    sense, back, gram : array (3, 3)
        T, its inverse, and T'T. For coordinates that do not exist, columns of T, rows of the inverse, and rows and
        columns of T'T are zero.
    slip : array (3,)
        Change of search coordinates by the rounding of coordinates of one metre.
    floor : float
        Sizes of measurements and coordinates in residuals; the sizes of nodes are not included.
    surface : array (0,) or (SURFACE_WIDTH,)
        The surface of a height, with the axes of this piece.
    differs, middle : bool, array (3,)
        Whether ranges are counted from a reference position, and this position, the middle of the stations.
        Differences of ranges (`optloc.proof.nodes.range.bound_difference`) are closer to linear over boxes as large as
        a continent.
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
        Centre and half-widths, search coordinates (or coordinates of a piece of an atlas).
    centre : array (3,)
        Centre, metres.
    line : array (6,)
        Working memory.
    nodes, rows, curves, sums : array (J, NODE_WIDTH), (q, ROW_WIDTH), (J, CURVE_WIDTH), (SUMS,)
        Tables, see `optloc.proof.nodes.node` (nodes, curves), `optloc.proof.box` (rows) and `optloc.proof.curvature`
        (sums).
    solve : array (3, 3)
        Working memory.
    cut : array (6,)
        Lower, then upper ends of the remaining part of the box, relative to its centre.
    sense, gram, graph, lean : array (3, 3), (3, 3), (GRAPH_WIDTH,), (J,)
        For a box on a surface: its T and T'T, the graph of the surface, and slopes along the upward axis.
    inside : array (10, 3, 3)
        For a box on a surface: numbers of the inside of an atlas that contains it, see `_inside_of`.
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
    """Return the cost of nodes (`kinds`, `data`), whitened rows K (q, J) and whitened measurements w (q,)."""
    A, weight, groups = np.empty((K.shape[1], K.shape[1])), np.empty(K.shape[1]), empty_groups(K.shape[1])
    set_geometry(kinds, K, A, weight, groups)
    return Cost(kinds, data, K, w, A, weight, groups)


@compiled
def set_geometry(kinds: Array, K: Array, A: Array, weight: Array, groups: Groups) -> None:
    """Write the parts of a cost that depend on its rows K only: `A`, `weight` and `groups` of `Cost`.

    Costs that differ in their measurements only share these parts.
    """
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
    """Return uninitialised tables for boxes of costs with J nodes and q rows; centre and half-widths are zero."""
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

    Afterwards the box contains the tables of the fix: values of the nodes, forces (`CURVE_WIDTH`), and sums, whose
    gradient is along the search coordinates.
    """
    return chart_on(cost, x, box, np.empty((0, 3)), np.empty(0))


@compiled
def chart_on(cost: Cost, x: Array, box: Box, planes: Array, surface: Array) -> tuple[LocalAxes, bool]:
    """Return the search coordinates around a fix on planes or a surface (see `KnownMinima`).

    The second result is True if the rows determine these coordinates. Like `chart_at`, the function fills the tables of
    the box for the fix x (D,), metres.
    """
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
    if planes.shape[0] + surface.shape[0] == 0:
        count = D
        roughly_principal(information, gram)
    else:
        count = set_tangents(D, planes, surface, gram)
        principal_along(information, gram, count)
    most = max(information[0, 0], information[1, 1], information[2, 2])
    if count == D and least_diagonal(information, D) <= FAINT * most:
        lengths = information.copy()  # the calls below overwrite it
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
        # An axis along which there is no information keeps the unit of one metre.
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
        # Lines from the reference position have fewer exact digits than lines from the fix.
        if relative_rounding(cost.K) * floor < _SHARP:
            chart = LocalAxes(origin, sense, back, gram, slip, floor, own, True, middle)
    return chart, good


@compiled
def _length_of_lines(cost: Cost, surface: Array, middle: Array) -> float:
    """Return the weighted sizes of lines from any point of a surface, which limit the accuracy of range differences.

    `middle` (3,) is the reference position, m. The result has the unit of a whitened residual, like `accuracy_floor`.
    """
    size, total = WGS84_A + abs(surface[LEVEL]) + abs(middle[0]) + abs(middle[1]) + abs(middle[2]), 0.0
    for j in range(cost.kinds.shape[0]):
        if cost.kinds[j] == RANGE:
            total += 4.0 * cost.weight[j] * (size + abs(cost.data[j, 0]) + abs(cost.data[j, 1]) + abs(cost.data[j, 2]))
    return total


@compiled
def without_differences(chart: LocalAxes) -> LocalAxes:
    """Return the same search coordinates, with ranges that are bounded one by one instead of as differences."""
    origin = chart.origin
    return LocalAxes(origin, chart.sense, chart.back, chart.gram, chart.slip, chart.floor, chart.surface, False, origin)


@compiled
def accuracy_floor(kinds: Array, data: Array, weight: Array, w: Array, origin: Array, share: float) -> float:
    """Return the sizes of measurements and coordinates in residuals, without the sizes of the nodes.

    It is the length of w plus the size of the coordinates in each node times its weight, in the unit of whitened
    residuals. Times a relative rounding, it bounds this part of the rounding of a residual.

    Parameters
    ----------
    kinds, data, weight, w : arrays
        As in `Cost`.
    origin : array (3,)
        A position, metres.
    share : float
        Share of the coordinates in ranges: LINES for a position that is a double, more for a position that is computed
        in many steps.
    """
    total = 0.0
    for i in range(w.shape[0]):
        total += w[i] * w[i]
    total = sqrt(total)
    reach = abs(origin[0]) + abs(origin[1]) + abs(origin[2])
    for j in range(kinds.shape[0]):
        if kinds[j] == RANGE:  # the same as `size_of` returns: ranges skip the call, because they are common
            size = share * (reach + (abs(data[j, 0]) + abs(data[j, 1]) + abs(data[j, 2])))
        else:
            size = size_of(kinds[j], data[j], reach)
        total += weight[j] * size
    return total


@inlined
def write_centre(origin: Array, sense: Array, at: Array, centre: Array) -> None:
    """Write ``origin + sense at``, the position of search coordinates `at` in metres, into `centre` (3,)."""
    s0, s1, s2 = at[0], at[1], at[2]
    for k in range(3):
        centre[k] = origin[k] + (sense[k, 0] * s0 + sense[k, 1] * s1 + sense[k, 2] * s2)


@inlined
def widen_by_rounding(chart: LocalAxes, centre: Array, half: Array) -> None:
    """Widen a box by the rounding of its centre, metres, so that all bounds hold for the exact box.

    `half` (3,) are the half-widths in search coordinates, enlarged in place.
    """
    size = abs(centre[0]) + abs(centre[1]) + abs(centre[2])
    # The term that is added to the origin may be larger than the sum.
    size += 2.0 * (abs(chart.origin[0]) + abs(chart.origin[1]) + abs(chart.origin[2]))
    for k in range(3):
        half[k] += chart.slip[k] * size


@inlined
def is_bounded(cost: Cost, chart: LocalAxes, box: Box) -> bool:
    """Bound the nodes over a box and write them into ``box.nodes``.

    Return False if the box is so large that a surface is no graph over it.
    """
    write_centre(chart.origin, chart.sense, box.at, box.centre)
    if chart.surface.shape[0] == 0:
        bound_nodes(cost.kinds, cost.data, box.centre, chart.sense, chart.gram, box.half, box.line, box.nodes)
        return True
    return lay_on_surface(cost, chart, box)


@compiled
def lay_on_surface(cost: Cost, chart: LocalAxes, box: Box) -> bool:
    """Move a box from the plane of its coordinates onto the surface, and bound its nodes.

    Return False if the box is too large. ``box.sense``, ``box.graph`` and ``box.lean`` are written. The third
    half-width, across the surface, is zero afterwards.
    """
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
    """Return the atlas whose inside contains a box on a surface: its cube is as large as the Earth.

    The atlas consists of views that are made at each use. If the box stored the record, each call would count
    references to all its arrays.
    """
    m = box.inside
    numbers = m[9].reshape(9)
    # no code reads the minima; these arrays only have the right types
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
    """Write the centre and axes of a box on a surface into the working memory of an atlas (`_inside_of`)."""
    inside.scale[0] = 1.0
    for m in range(3):
        inside.point[m] = (box.centre[m] - inside.middle[m]) / inside.radius
        inside.scale[1 + m] = 0.0
        for k in range(3):
            inside.slant[m, k] = box.sense[m, k] / inside.radius


@compiled
def curve_along(cost: Cost, chart: LocalAxes, box: Box) -> None:
    """Write the table of second derivatives along a surface for a box on it whose nodes are bounded."""
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
    """Bound second derivatives of the nodes over a box whose nodes are bounded, and write them into ``box.curves``."""
    if chart.surface.shape[0] > 0:
        curve_along(cost, chart, box)
        return
    half, line, nodes, curves = box.half, box.line, box.nodes, box.curves
    curve_nodes(cost.kinds, cost.data, box.centre, chart.sense, chart.gram, half, line, box.solve, nodes, curves)


@inlined
def curve_box(cost: Cost, chart: LocalAxes, box: Box) -> None:
    """Write the tables of second derivatives, ``box.curves`` and ``box.sums``, of a box whose nodes are bounded."""
    curve_at(cost, chart, box)
    noise = rounding_error(cost.K, cost.weight, chart.floor, box.nodes)
    sum_up(cost.K, cost.w, cost.weight, noise, box.nodes, box.curves, box.sums)


@compiled
def value_at(cost: Cost, chart: LocalAxes, box: Box) -> float:
    """Return f at the centre of a box, infinite if it cannot be moved onto a surface; fill its table of nodes."""
    return cost_at(cost.K, cost.w, box.nodes) if is_bounded(cost, chart, box) else inf


@inlined
def rounding_at_centre(cost: Cost, chart: LocalAxes, box: Box) -> float:
    """Return a bound of the rounding of a residual, as a length, at the centre of a box whose nodes are bounded.

    On a surface, the rounding of the height is included, because it is computed from the Earth's centre.
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


# Tolerance of equal costs: 8 e sqrt(f) + 24 e^2, with f the cost of a fix and e the rounding of a residual. Each of
# two costs has an error of 2 e sqrt(f) + e^2, and half of the tolerance is for them. A slope of the cost has an error
# of e along each of three axes. 24 e^2 makes this an eighth of the curvature, or a quarter if half of the tolerance is
# left.
_COSTS, _SLOPES = 8.0, 24.0
COARSEST = 1.0
"""Greatest error of costs for a useful proof: a ninth of the gap below which two minima count as ambiguous."""


@compiled
def equal_within(eps: float, least: float, noise: float) -> float:
    """Return the tolerance of equal costs below the cost `least` of a fix: eps, or more if rounding is coarse.

    `noise` bounds the rounding of a residual's length. All are values of f or its root, without a unit.
    """
    return float(max(eps, noise * (_COSTS * sqrt(max(least, 0.0)) + _SLOPES * noise)))


@inlined
def shapes_of(cost: Cost, chart: LocalAxes) -> Array:
    """Return the codes of the nodes for tests of convexity: along a surface a range is not convex."""
    return cost.kinds if chart.surface.shape[0] == 0 else np.full_like(cost.kinds, ANY)


@compiled
def is_convex(cost: Cost, chart: LocalAxes, box: Box, margin: float) -> bool:
    """Return whether the Hessian of f/2 exceeds `margin` times the identity over a whole box.

    The tables of the box are filled. If the surface is no graph over the box, the result is False.
    """
    if not is_bounded(cost, chart, box):
        return False
    curve_box(cost, chart, box)
    return is_convex_over_box(shapes_of(cost, chart), cost.A, box.half, box.nodes, box.curves, box.sums, margin)


@compiled
def axes_of_next_piece(cost: Cost, chart: LocalAxes, side: int) -> LocalAxes:
    """Return the search coordinates of another piece of a surface, in units of the Earth's least radius.

    Parameters
    ----------
    cost, chart : Cost, LocalAxes
        The cost, and the search coordinates around the fix, side 0.
    side : int
        1: the piece opposite to the fix; 2 to 5: the pieces next to it.
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
