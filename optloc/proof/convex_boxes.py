"""Boxes around known minima on which the cost is convex, so that they contain no second minimum.

A search leaves these *convex boxes* out. Their half-widths are called `sides`, the greatest useful half-widths `hull`,
both (3,), in standard deviations along the axes of the minimum. On a box whose Hessian of f/2 exceeds a `margin`, the
cost falls below the cost of its centre by at most slope^2 / margin.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined, put
from optloc.kernels.systems import principal
from optloc.proof.atlas import Atlas, infinity_coordinate, piece_of, set_centre
from optloc.proof.box import J0, cost_at, linearise_rows, rounding_error
from optloc.proof.curvature import FAINT, G0, G1, G2, NOISE0, bend_axes, is_convex_over_box, least_diagonal, sum_up
from optloc.proof.nodes.dispatch import bound_pieces, curve_pieces, infinity_of, size_of
from optloc.proof.nodes.node import ANY, DIFFERENCE
from optloc.proof.search_space import HIDDEN_REACH, Box, Cost, KnownMinima, LocalAxes, is_convex, widen_by_rounding

# Around a fix, in its search coordinates.

# Factor of the half-widths of a box that is not convex, which leaves a third of its volume; and the greatest number of
# such steps, which reduce a hull of a billion standard deviations to half of one.
_LESS, _SHRINKS = 0.7, 60
# Other minima must be known to a hundredth of a standard deviation: the ratio of convexity margin to slope.
_POLISHED = 100.0


@inlined
def set_convex(cost: Cost, chart: LocalAxes, box: Box, hull: Array, margin: float) -> bool:
    """Enlarge a box around its centre as far as the cost is proven convex on it; return False without a convex box.

    In most cases the cost is convex over the whole hull. Otherwise the hull is scaled down.

    Parameters
    ----------
    cost, chart : Cost, LocalAxes
        The cost and its search coordinates.
    box : Box
        The centre `at` is a minimum; the half-widths are written.
    hull : array (3,)
        Greatest useful half-widths.
    margin : float
        The Hessian of f/2 must exceed this.
    """
    size = 1.0
    for _ in range(_SHRINKS):
        for k in range(3):
            box.half[k] = size * hull[k]
        if is_convex(cost, chart, box, margin):
            return True
        size *= _LESS
    return False


@compiled
def is_known(at: Array, half: Array, minima: Array, sides: Array) -> bool:
    """Return whether a box (centre `at`, half-widths `half`) is inside the convex box of a known minimum.

    `minima` (P, 3) are the minima, and `sides` (P, 3) the half-widths of their convex boxes. All arguments are in one
    system, the search coordinates of `known_minima`.
    """
    for p in range(minima.shape[0]):
        inside = True
        for k in range(3):
            inside = inside and abs(at[k] - minima[p, k]) + half[k] <= sides[p, k]
        if inside:
            return True
    return False


@inlined
def known_minima(
    cost: Cost,
    chart: LocalAxes,
    box: Box,
    known: KnownMinima,
    low: Array,
    high: Array,
    margin: float,
    value: float,
    own: bool,
) -> tuple[Array, Array, int, int]:
    """Return the known minima (1 + P, 3) in search coordinates, half-widths of convex boxes around them, two counts.

    The first count is the number of minima, 0 if the cost is not convex around the fix. The second count is the number
    of minima that are the fix, which comes first, or hidden. Points that are no minima are left out. A minimum whose
    box contains a point below the cost `value` is left out unless it is hidden. Without the fix (`own` is False),
    minima of other pieces of a surface are left out too. `low` and `high` (3,) are the corners of the region to search,
    which limits the boxes. `margin` is the margin of the Hessian for the fix.
    """
    others = known.points
    count, free, size = 0, 0, 1 + others.shape[0]
    minima, sides, hull, shift = np.zeros((size, 3)), np.zeros((size, 3)), np.empty(3), np.zeros(3)
    for i in range(0 if own else 1, size):
        # Minimum p is the fix for 0, else point p - 1. The order is: the fix, hidden minima (the last points), others.
        hidden = 0 < i <= known.hidden
        p = size - i if hidden else (i - known.hidden if i > 0 else 0)
        box.at[:] = 0.0
        if p > 0:
            for k in range(3):
                for m in range(others.shape[1]):
                    box.at[k] += chart.back[k, m] * (others[p - 1, m] - chart.origin[m])
            box.half[:] = 0.0
            if chart.surface.shape[0] > 0:
                box.at[2] = 0.0
            if not is_convex(cost, chart, box, 0.0) or is_elsewhere(chart, box, others[p - 1]):
                continue
            sums = box.sums
            # If the Hessian exceeds a margin, the minimum is within slope / margin of any point. The cost at the
            # minimum is lower by at most slope^2 / margin.
            margin = _POLISHED * sqrt(sums[G0] * sums[G0] + sums[G1] * sums[G1] + sums[G2] * sums[G2])
            least = cost_at(cost.K, cost.w, box.nodes) - margin / (_POLISHED * _POLISHED)
            if not hidden and not least >= value:
                continue
        for k in range(3):
            hull[k] = max(high[k] - box.at[k], box.at[k] - low[k], 0.0)
        if hidden:
            limit_half_widths(box.sense if chart.surface.shape[0] > 0 else chart.sense, hull)
        if set_convex(cost, chart, box, hull, margin):
            # The box is reduced by the rounding of its centre. For the fix, the centre is the origin itself.
            shift[:] = 0.0
            if p > 0:
                widen_by_rounding(chart, box.centre, shift)
            for k in range(3):
                minima[count, k], sides[count, k] = box.at[k], max(box.half[k] - shift[k], 0.0)
            count += 1
            free += int(p == 0 or hidden)
        elif p == 0:
            return minima, sides, 0, 0
    return minima, sides, count, free


# Greatest distance, metres, between a point and the surface point at its search coordinates. The limit is below an
# Earth's radius, the distance of the other side, and above all rounding.
_ASIDE = 1e5


@inlined
def is_elsewhere(chart: LocalAxes, box: Box, place_of: Array) -> bool:
    """Return whether a point (D,) of a surface is on the other side of the Earth, behind its search coordinates.

    The point is `place_of`, m, and the box is at its search coordinates.
    """
    apart = 0.0
    for m in range(place_of.shape[0]):
        apart = max(apart, abs(place_of[m] - box.centre[m]))
    return bool(chart.surface.shape[0] > 0 and apart > _ASIDE)


@compiled
def limit_half_widths(sense: Array, hull: Array) -> None:
    """Reduce half-widths `hull` (3,) so that no coordinate is farther than `HIDDEN_REACH` metres from the centre.

    `sense` (3, 3) is the derivative of the position with respect to search coordinates.
    """
    share = 1.0
    for k in range(3):
        reach = 0.0
        for m in range(3):
            reach += abs(sense[k, m]) * hull[m]
        if reach * share > HIDDEN_REACH:
            share = HIDDEN_REACH / reach
    for k in range(3):
        hull[k] *= share


# The cost over the pieces of an atlas: all nodes over a box, out to infinity, and the boxes around known minima.
#
# Angles and ratios are functions of the scaled line ``p - v a`` alone. From each range the distance to the centre of
# the cube is subtracted. This does not change rows whose coefficients of ranges sum to zero.


@compiled
def accuracy_floor_far(cost: Cost, atlas: Atlas) -> float:
    """Return the sizes of measurements and of the cube in residuals, without the sizes of the nodes.

    The result is for boxes of an atlas what `optloc.proof.search_space.accuracy_floor` is around a fix.
    """
    total = 0.0
    for i in range(cost.w.shape[0]):
        total += cost.w[i] * cost.w[i]
    total = sqrt(total)
    # Lines are p - v a with |p| <= sqrt(3) and |a| < 1. So their lengths, and sums of two lengths, are below 4 radii.
    size = 4.0 * atlas.radius + abs(atlas.middle[0]) + abs(atlas.middle[1]) + abs(atlas.middle[2])
    for j in range(cost.kinds.shape[0]):
        own = size if infinity_of(cost.kinds[j]) == DIFFERENCE else 4.0 * size_of(cost.kinds[j], cost.data[j], 1.0)
        total += cost.weight[j] * own
    return total


# Boxes around a known minimum in an atlas: principal axes, and a box in which it is the only minimum.

# Greatest half-width of convex boxes, standard deviations: a fix with smaller deviations needs no wider box. And the
# greatest share of the way to infinity, where the coordinates of the minimum end.
_WIDEST, _SHARE = 1e4, 0.9
# Half-widths of the box searched along the axes of a minimum: in units of the convex box, and at least this many
# standard deviations. Outside, the cost is high enough for boxes along the axes of space.
_WIDER, _WIDE = 3.0, 3.0
# The same for a proof, standard deviations. A valley is narrow, oblique to the faces, and longer than its curvature at
# the minimum suggests. Squared rows quickly contract a box that is too wide. Over 2 000 fixes of each of ten layouts,
# 30 took as many boxes as 100, and proved up to 5 % more of the fixes on flat ground unique. Over 100 fixes outside
# the array, 12 took a sixth more boxes.
_VALLEY = 30.0
# Half-widths of the first convex box to test, standard deviations, and the factor by which the box and its sides grow.
# A finer search takes as long as the boxes that it saves, or longer.
_FIRST, _GROWTH = 3.0, 2.0


@compiled
def set_minimum(cost: Cost, box: Box, atlas: Atlas, i: int, x: Array, value: float, eps: float, limit: float) -> bool:
    """Write minimum i, at x, and the boxes around it into an atlas.

    Return False if x is no minimum or costs less than `value`.

    Parameters
    ----------
    cost : Cost
        The cost.
    box : Box
        Working memory.
    atlas : Atlas
        Minimum i is written.
    i : int
        Number of the minimum.
    x : array (D,)
        Polished position of the minimum, metres.
    value : float
        Least allowed cost of the minimum: the search leaves its convex box out. -inf allows any cost.
    eps : float
        Greatest fall of the cost below the cost of x in the convex box.
    limit : float
        Greatest distance of points of the boxes from the minimum along any coordinate, metres; infinity for no limit.
    """
    minima, d = atlas.minima, atlas.dimension
    minima.home[i] = piece_of(atlas, x, minima.start[i])
    if not set_axes(cost, box, atlas, i):
        return False
    _tables(cost, box, atlas, i, np.zeros(3))
    if not cost_at(cost.K, cost.w, box.nodes) >= value:
        return False
    # On a box whose Hessian exceeds a margin, the cost falls below the cost of its centre by at most slope^2 / margin.
    margin, hull = 0.0, np.zeros(3)
    for k in range(3):
        slope = abs(box.sums[G0 + k]) + box.sums[NOISE0 + k]
        margin += slope * slope / eps
    set_hull(atlas, i, hull, limit)
    if not _grow(cost, box, atlas, i, hull, margin):
        return False
    for k in range(d):
        minima.core[i, 1, k] = min(max(_WIDER * minima.sides[i, k], _WIDE), hull[k])
        minima.core[i, 0, k] = -minima.core[i, 1, k]
    return True


@compiled
def widen_core(atlas: Atlas, i: int, limit: float) -> None:
    """Widen the box searched along the axes of minimum i to contain its valley, within a limit in metres.

    If infinity is no farther than the box, and the axes allow it, the box reaches infinity.
    """
    d, core, hull = atlas.dimension, atlas.minima.core[i], np.full(3, _VALLEY)
    end = infinity_coordinate(atlas, 2 * d + 1 + i)
    if end == -inf:
        set_hull(atlas, i, hull, limit)
    elif limit < inf:
        _draw_in(atlas, i, hull, limit)
    for k in range(d):
        hull[k] = max(core[1, k], min(_VALLEY, hull[k]))
        core[0, k], core[1, k] = -hull[k], hull[k]
    if limit == inf and -_VALLEY < end:
        core[0, d - 1] = -inf


@compiled
def set_hull(atlas: Atlas, i: int, hull: Array, limit: float) -> None:
    """Write the greatest half-widths `hull` (3,) of convex boxes around minimum i of an atlas.

    No box reaches infinity, and no coordinate is farther than `limit` metres from the minimum.
    """
    minima, d = atlas.minima, atlas.dimension
    # v falls along the last axis only, or along all axes.
    ways = 1 if infinity_coordinate(atlas, 2 * d + 1 + i) > -inf else d
    for k in range(d):
        steep = abs(minima.axes[i, d - 1, k]) * ways if minima.home[i] < 2 * d else 0.0
        hull[k] = min(_WIDEST, _SHARE * minima.start[i, d - 1] / steep if steep > 0.0 else _WIDEST)
    if limit < inf:
        _draw_in(atlas, i, hull, limit)


@compiled
def _draw_in(atlas: Atlas, i: int, hull: Array, limit: float) -> None:
    """Reduce half-widths `hull` (3,) around minimum i so that no coordinate is farther than `limit` metres from it."""
    minima, d = atlas.minima, atlas.dimension
    beside, out, scale = 0.0, 0.0, 1.0  # greatest changes of p and v, and v
    for k in range(d):
        reach = 0.0
        for m in range(d):
            reach += abs(minima.axes[i, k, m]) * hull[m]
        if k == d - 1 and minima.home[i] < 2 * d:
            out, scale = reach, minima.start[i, k]
        else:
            beside = max(beside, reach)
    # |p/v - p'/v'| <= (|p - p'| + |v - v'|/v') / v, because |p'| <= 1.
    share = limit * scale / (atlas.radius * (beside + out / scale) + limit * out)
    for k in range(d):
        hull[k] *= min(share, 1.0)


# Standard deviations: a minimum nearer to infinity than this gets axes of which only the last changes v, so that a box
# can reach infinity. Other minima get principal axes, of which only one is long if the rows determine little. Over 100
# fixes outside five stations, 12 took a tenth fewer boxes than 5. Over 120 fixes on flat ground, 12 took a tenth more.
_REMOTE = 5.0
# Least pivot as a share of the diagonal: smaller pivots are rounding.
_PIVOT = 1e-14


@compiled
def set_axes(cost: Cost, box: Box, atlas: Atlas, i: int) -> bool:
    """Write axes of minimum i in its home coordinates, in standard deviations; return False if they do not exist.

    The home and the start of the minimum must be set. They do not exist if the rows do not determine a coordinate.
    """
    minima, d = atlas.minima, atlas.dimension
    axes, back = minima.axes[i], minima.back[i]
    axes[:], back[:] = 0.0, 0.0
    for k in range(3):
        axes[k, k] = back[k, k] = 1.0
    _tables(cost, box, atlas, i, np.zeros(3))
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    information, vectors = np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(d):
        for m in range(d):
            for row in range(box.rows.shape[0]):
                information[k, m] += box.rows[row, J0 + k] * box.rows[row, J0 + m]
    lengths, steep = information.copy(), 0.0
    principal(lengths, vectors)
    if least_diagonal(lengths, d) <= FAINT * max(lengths[0, 0], lengths[1, 1], lengths[2, 2]):
        bend_axes(box.sums, vectors, lengths, d)
    axes[:], back[:] = 0.0, 0.0
    for k in range(d):
        if not lengths[k, k] > 0.0:
            return False
        root = sqrt(lengths[k, k])
        for m in range(d):
            axes[m, k], back[k, m] = vectors[m, k] / root, vectors[m, k] * root
        steep += abs(axes[d - 1, k])
    if minima.home[i] < 2 * d and _REMOTE * steep > minima.start[i, d - 1]:
        return _set_triangular(information, d, axes, back)
    return True


@compiled
def _set_triangular(information: Array, d: int, axes: Array, back: Array) -> bool:
    """Write the upper triangular R with ``R'R`` the information (d, d) into `back`, and the inverse into `axes`.

    Return False if the information is singular.
    """
    axes[:], back[:] = 0.0, 0.0
    for k in range(d):
        for m in range(k, d):
            total = information[k, m]
            for c in range(k):
                total -= back[c, k] * back[c, m]
            if m == k:
                if not total > _PIVOT * information[k, k]:
                    return False
                back[k, k] = sqrt(total)
            else:
                back[k, m] = total / back[k, k]
    for m in range(d):
        for k in range(m, -1, -1):
            total = 1.0 if k == m else 0.0
            for c in range(k + 1, m + 1):
                total -= back[k, c] * axes[c, m]
            axes[k, m] = total / back[k, k]
    return True


@inlined
def _tables(cost: Cost, box: Box, atlas: Atlas, i: int, half: Array) -> None:
    """Fill the tables of a box with half-widths `half` (3,) around minimum i of an atlas."""
    box.at[:] = 0.0
    put(half, box.half)
    set_centre(atlas, 2 * atlas.dimension + 1 + i, box.at)
    bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
    curve_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes, box.curves)
    noise = rounding_error(cost.K, cost.weight, accuracy_floor_far(cost, atlas), box.nodes)
    sum_up(cost.K, cost.w, cost.weight, noise, box.nodes, box.curves, box.sums)


@compiled
def _convex(cost: Cost, box: Box, atlas: Atlas, i: int, half: Array, margin: float) -> bool:
    """Return whether the Hessian of f/2 exceeds `margin` over a box with half-widths `half` (3,) around minimum i."""
    _tables(cost, box, atlas, i, half)
    # Here ranges are differences, whose Hessians have no fixed sign, so the test must treat them as any node.
    return is_convex_over_box(np.full_like(cost.kinds, ANY), cost.A, box.half, box.nodes, box.curves, box.sums, margin)


@compiled
def _grow(cost: Cost, box: Box, atlas: Atlas, i: int, hull: Array, margin: float) -> bool:
    """Write half-widths of a box around minimum i on which the cost is convex; return False if none is found.

    `margin` is the margin of the Hessian. A cube shrinks or doubles, then each side grows separately, all within `hull`
    (3,).
    """
    sides, size = atlas.minima.sides[i], _FIRST
    trial = np.minimum(hull, size)
    while not _convex(cost, box, atlas, i, trial, margin):
        # If the cost is not convex at the centre, or on a millionth of a standard deviation, no box is found.
        if (size == _FIRST and not _convex(cost, box, atlas, i, np.zeros(3), margin)) or size < 1e-6:
            return False
        size *= 0.5
        trial = np.minimum(hull, size)
    while size < _WIDEST and _convex(cost, box, atlas, i, np.minimum(hull, _GROWTH * size), margin):
        size *= _GROWTH
    put(np.minimum(hull, size), sides)
    for k in range(atlas.dimension):
        trial = sides.copy()
        trial[k] = min(_GROWTH * sides[k], hull[k])
        while trial[k] > sides[k] and _convex(cost, box, atlas, i, trial, margin):
            sides[k] = trial[k]
            trial[k] = min(_GROWTH * sides[k], hull[k])
    return True
