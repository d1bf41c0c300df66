"""The proof for all positions: an enclosure where there is one, else the atlas of all space."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, inlined, zero
from optloc.proof.atlas import (
    Atlas,
    atlas_of,
    coordinates_on,
    cube,
    first_minima,
    home_of,
    position,
    set_centre,
    with_minima,
    within,
)
from optloc.proof.box import cost_at, least_residual, linearise_rows, push_around
from optloc.proof.chart import Box, Chart, Cost, chart_at, empty_box
from optloc.proof.convex import convex, slopes_everywhere, spread_of, sum_up
from optloc.proof.near import BETTER, BUDGET, OPEN, OTHER, SINGULAR, STATIONARY, UNIQUE, VALUE, descend, prove
from optloc.proof.nodes.codes import RANGE, RATIO
from optloc.proof.nodes.far import bound_pieces, curve_pieces, reaches_infinity
from optloc.proof.nodes.linear3 import principal

# Branch and bound over all positions, for costs that nothing encloses.

# What a search finds: nothing, a cheaper point, another minimum below the level, no end within the budget, or a cost at
# infinity below the level.
CLEAR, CHEAPER, ANOTHER, SPENT, INFINITE = range(5)
_CAPACITY, _DEPTH = 2048, 8
# A box at infinity of this size whose cost is below the level is not split further.
_TINY = 1e-5
# Points closer to a minimum than this are that minimum, standard deviations.
_SAME = 1e-3
_ALIKE = 0.1
_NEAR = 100.0


@compiled
def search_everywhere(
    cost: Cost, atlas: Atlas, chart: Chart, level: float, value: float, budget: int, found: Array
) -> tuple[int, int, float]:
    """Search all positions but some boxes for minima that cost less than a level.

    A box is done where the cost is at least `level`, or where it has no minimum, its gradient or its curvature being of
    one sign: the least cost over all positions, if it is attained, is attained elsewhere. Around known minima boxes
    lie along their principal axes.

    Parameters
    ----------
    cost : Cost
        The cost; `optloc.proof.nodes.far.reaches_infinity` holds.
    atlas : Atlas
        The pieces, known minima among them.
    chart : Chart
        Search coordinates around the fix, in which low points descend.
    level : float
        Cost to exceed.
    value : float
        Cost below which a point refutes the fix.
    budget : int
        How many boxes may be looked at.
    found : array (D,)
        Written: the point of the outcomes CHEAPER and ANOTHER.

    Returns
    -------
    outcome : int
        CLEAR: no minimum costs less than `level`. CHEAPER: `found` costs less than `value`. ANOTHER: `found` is a
        minimum that costs less than `level`. SPENT: boxes are left. INFINITE: the cost at infinity is below `level`.
    boxes : int
        How many boxes were looked at.
    bound : float
        A lower bound of f: `value`, unless boxes are left.
    """
    box, near = empty_box(cost.K.shape[0], cost.K.shape[1]), empty_box(cost.K.shape[0], cost.K.shape[1])
    stack, last = np.zeros((_CAPACITY, _DEPTH)), atlas.dimension - 1
    size, boxes, lows, floor = _pieces(stack, atlas), 0, 0, _floor(cost, atlas)
    while size > 0:
        if boxes >= budget or size + 2 > _CAPACITY:
            return SPENT, boxes, _least(stack, size)
        size -= 1
        boxes += 1
        box.at[:], box.half[:] = stack[size, :3], stack[size, 3:6]
        piece = int(stack[size, 7])
        set_centre(atlas, piece, box.at)
        if _known(atlas, box, piece):
            continue
        bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
        linearise_rows(cost.K, cost.w, box.nodes, box.rows)
        low = least_residual(cost.K, cost.weight, floor, box.half, box.nodes, box.rows)
        if low > 0.0 and low * low >= level:
            continue
        here = cost_at(cost.K, cost.w, box.nodes)
        if here < value:
            position(atlas, found)
            return CHEAPER, boxes, 0.0
        touching = piece < 2 * atlas.dimension and box.at[last] <= box.half[last]
        # The test is dear, and fails in large boxes: only where the cost is low it can spare splits.
        if here < _NEAR * (level + 1.0) and _leaves(cost, atlas, box, touching):
            continue
        if here < level:
            lows += 1
            if lows & (lows - 1) == 0 and _another(cost, atlas, chart, near, level, found):
                return ANOTHER, boxes, 0.0
        if touching and max(box.half[0], box.half[1], box.half[2]) < _TINY and _at_infinity(cost, atlas, box) < level:
            return INFINITE, boxes, 0.0
        size = _split(stack, size, atlas.dimension, box, low, piece)
    return CLEAR, boxes, value


@compiled
def _known(atlas: Atlas, box: Box, piece: int) -> bool:
    """Return whether a box lies in the convex box of a known minimum, or in one that is searched along its axes."""
    known, d = False, atlas.dimension
    for i in range(atlas.minima.home.shape[0]):
        known = known or within(atlas, box.half, i, atlas.minima.sides[i])
        # A box around one minimum is left to those that come before it, never to itself.
        if piece <= 2 * d or piece > 2 * d + 1 + i:
            known = known or within(atlas, box.half, i, atlas.minima.core[i])
    return known


@compiled
def _another(cost: Cost, atlas: Atlas, chart: Chart, near: Box, level: float, found: Array) -> bool:
    """Return whether the centre of a box descends to a minimum below the level that is not known, and write it."""
    d, minima, u = atlas.dimension, atlas.minima, np.zeros(3)
    position(atlas, found)
    for k in range(3):
        near.at[k] = 0.0
        for m in range(d):
            near.at[k] += chart.back[k, m] * (found[m] - chart.origin[m])
    if not descend(cost, chart, near) < level:
        return False
    for i in range(minima.home.shape[0]):
        inside = coordinates_on(atlas, minima.home[i], near.centre, u)
        for k in range(d):
            away = 0.0
            for m in range(d):
                away += minima.back[i, k, m] * (u[m] - minima.start[i, m])
            inside = inside and abs(away) <= max(minima.sides[i, k], _SAME)
        if inside:
            return False
    for m in range(d):
        found[m] = near.centre[m]
    return True


@compiled
def _pieces(stack: Array, atlas: Atlas) -> int:
    """Push all faces of the cube, its inside, and on top of them the surroundings of known minima, the fix last."""
    d = atlas.dimension
    size = 2 * d + 1
    for piece in range(size):
        for k in range(d):
            stack[piece, 3 + k] = 1.0
        if piece < 2 * d:
            stack[piece, d - 1] = stack[piece, d + 2] = 0.5
        stack[piece, 7] = piece
    slabs = np.zeros((6, 7))
    for i in range(atlas.minima.home.shape[0] - 1, -1, -1):
        core = atlas.minima.core[i]
        for slab in range(push_around(slabs, -core, core, atlas.minima.sides[i])):
            stack[size, :7] = slabs[slab]
            stack[size, 7] = 2 * d + 1 + i
            size += 1
    return size


@compiled
def _split(stack: Array, size: int, dimension: int, box: Box, low: float, piece: int) -> int:
    """Push the halves of a box, cut across the side along which the residual changes most; return the stack's size."""
    k = _side(box, dimension)
    for side in range(2):
        stack[size, :3], stack[size, 3:6] = box.at, box.half
        quarter = 0.5 * box.half[k]
        stack[size, k] += quarter if side else -quarter
        # Exact but around the fix, where centres and half-widths are no sums of powers of two.
        stack[size, 3 + k] = quarter + (1e-15 * (abs(box.at[k]) + quarter) if piece > 2 * dimension else 0.0)
        stack[size, 6], stack[size, 7] = low, piece
        size += 1
    return size


@compiled
def _side(box: Box, dimension: int) -> int:
    """Return the side along which the residual changes most; a part of that change counts for all sides alike.

    Nodes that are only enclosed have no slope, and bend where they do.
    """
    steepest, best, k = 0.0, -1.0, 0
    for m in range(dimension):
        steepest = max(steepest, _steepness(box, m))
    for m in range(dimension):
        change = (_steepness(box, m) + _ALIKE * steepest + 1e-300) * box.half[m]
        if change > best:
            best, k = change, m
    return k


@compiled
def _steepness(box: Box, m: int) -> float:
    total = 0.0
    for i in range(box.rows.shape[0]):
        total += box.rows[i, 1 + m] * box.rows[i, 1 + m]
    return sqrt(total)


@compiled
def _leaves(cost: Cost, atlas: Atlas, box: Box, touching: bool) -> bool:
    """Return whether no infimum of the cost can lie in a box whose nodes are bounded.

    The gradient does not vanish, or the Hessian has a negative eigenvalue; and at infinity, an end of the box that is
    none of space, the cost falls inwards or changes along infinity.
    """
    curve_pieces(atlas, cost.kinds, cost.data, box.half, box.curves)
    sum_up(cost.K, cost.w, box.nodes, box.curves, box.sums)
    if not touching and slopes_everywhere(cost.A, box.half, box.nodes, box.curves, box.sums, box.solve):
        return True
    ball = spread_of(cost.A, box.half, box.nodes, box.curves, box.sums)
    if not ball < inf:
        return False
    if not touching:
        return _bends_down(box, ball)
    sums, h = box.sums, box.half
    ball *= sqrt(h[0] * h[0] + h[1] * h[1] + h[2] * h[2])
    for k in range(atlas.dimension):
        change = ball
        for m in range(3):
            entry = _entry(k, m)
            change += (abs(sums[entry]) + sums[9 + entry]) * h[m]
        slope, change = sums[6 + k], change * (1.0 + 1e-6) + 1e-9
        if -slope > change or (k < atlas.dimension - 1 and slope > change):
            return True
    return False


@compiled
def _bends_down(box: Box, ball: float) -> bool:
    """Return whether the cost curves downwards along one direction all over a box, as around a saddle.

    `optloc.proof.convex.spread_of` has filled ``box.sums[9:15]`` and returned `ball`, bounds of the Hessian's change.
    """
    sums, hessian, vectors = box.sums, box.solve, np.empty((3, 3))
    for k in range(3):
        for m in range(3):
            hessian[k, m] = sums[_entry(k, m)]
    principal(hessian, vectors)
    column = 0
    for k in range(1, 3):
        if hessian[k, k] < hessian[column, column]:
            column = k
    most = ball
    for k in range(3):
        for m in range(3):
            entry = _entry(k, m)
            z = vectors[k, column] * vectors[m, column]
            most += sums[entry] * z + sums[9 + entry] * abs(z)
    size = abs(sums[0]) + abs(sums[3]) + abs(sums[5])
    return bool(most < -1e-9 * size)


@compiled
def _entry(k: int, m: int) -> int:
    """Return where entry (k, m) of a symmetric matrix stands among (00, 01, 02, 11, 12, 22)."""
    first, second = min(k, m), max(k, m)
    return second if first == 0 else first + second + 1


@compiled
def _at_infinity(cost: Cost, atlas: Atlas, box: Box) -> float:
    """Return the cost at infinity in the direction of the centre of a box on a face; its table of nodes is lost."""
    atlas.scale[0] = 0.0
    bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
    return cost_at(cost.K, cost.w, box.nodes)


@compiled
def _floor(cost: Cost, atlas: Atlas) -> float:
    """Return the sizes of what residuals are differences of, beside the nodes: measurements and the cube."""
    total = 0.0
    for i in range(cost.w.shape[0]):
        total += cost.w[i] * cost.w[i]
    total = sqrt(total)
    size = 4.0 * atlas.radius + abs(atlas.middle[0]) + abs(atlas.middle[1]) + abs(atlas.middle[2])
    for j in range(cost.kinds.shape[0]):
        total += cost.weight[j] * (size if cost.kinds[j] == RANGE else 4.0)
    return total


@compiled
def _least(stack: Array, size: int) -> float:
    """Return a lower bound of the cost in the boxes left."""
    least = inf
    for i in range(size):
        low = max(stack[i, 6], 0.0)
        least = min(least, low * low)
    return least


# The surroundings of a known minimum in an atlas: its principal axes, and a box in which it is the only minimum.

# No convex box is looked for beyond this many standard deviations, nor nearer to infinity than a tenth of the way.
_WIDEST, _SHARE = 1e4, 0.9
# The box searched along the axes: convex boxes, and standard deviations at least.
_WIDER, _WIDE = 3.0, 3.0


@compiled
def set_minimum(cost: Cost, box: Box, atlas: Atlas, i: int, x: Array, eps: float) -> bool:
    """Write a minimum and its surroundings into an atlas; return False where it is none.

    Parameters
    ----------
    cost : Cost
        The cost.
    box : Box
        Tables to work with.
    atlas : Atlas
        Minimum i is written.
    i : int
        Which.
    x : array (D,)
        Its position, polished.
    eps : float
        How far the cost may fall below that of x in its convex box.
    """
    minima, d = atlas.minima, atlas.dimension
    minima.home[i] = home_of(atlas, x, minima.start[i])
    if not _set_axes(cost, box, atlas, i):
        return False
    _tables(cost, box, atlas, i, np.zeros(3))
    sums = box.sums
    # On a box whose Hessian exceeds a margin the cost falls below that of its centre by slope^2 / margin at most.
    margin = (sums[6] * sums[6] + sums[7] * sums[7] + sums[8] * sums[8]) / eps
    hull = np.zeros(3)
    for k in range(d):
        steep = abs(minima.axes[i, d - 1, k]) * d if minima.home[i] < 2 * d else 0.0
        hull[k] = min(_WIDEST, _SHARE * minima.start[i, d - 1] / steep if steep > 0.0 else _WIDEST)
    if not _grow(cost, box, atlas, i, hull, margin):
        return False
    for k in range(d):
        minima.core[i, k] = min(max(_WIDER * minima.sides[i, k], _WIDE), hull[k])
    return True


@compiled
def _set_axes(cost: Cost, box: Box, atlas: Atlas, i: int) -> bool:
    """Write the principal axes of minimum i in the coordinates of its home; return False where there are none."""
    minima, d = atlas.minima, atlas.dimension
    minima.axes[i], minima.back[i] = np.eye(3), np.eye(3)
    _tables(cost, box, atlas, i, np.zeros(3))
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    information, vectors = np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(d):
        for m in range(d):
            for row in range(box.rows.shape[0]):
                information[k, m] += box.rows[row, 1 + k] * box.rows[row, 1 + m]
    principal(information, vectors)
    minima.axes[i], minima.back[i] = 0.0, 0.0
    for k in range(d):
        if not information[k, k] > 0.0:
            return False
        root = sqrt(information[k, k])
        for m in range(d):
            minima.axes[i, m, k], minima.back[i, k, m] = vectors[m, k] / root, vectors[m, k] * root
    return True


@compiled
def _tables(cost: Cost, box: Box, atlas: Atlas, i: int, half: Array) -> None:
    """Fill the tables of a box with half-widths (3,) around minimum i."""
    box.at[:], box.half[:] = 0.0, half
    set_centre(atlas, 2 * atlas.dimension + 1 + i, box.at)
    bound_pieces(atlas, cost.kinds, cost.data, box.half, box.nodes)
    curve_pieces(atlas, cost.kinds, cost.data, box.half, box.curves)
    sum_up(cost.K, cost.w, box.nodes, box.curves, box.sums)


@compiled
def _convex(cost: Cost, box: Box, atlas: Atlas, i: int, half: Array, margin: float) -> bool:
    _tables(cost, box, atlas, i, half)
    # Ranges are differences here, whose Hessians have no sign: the test must take them for ratios.
    return convex(np.full_like(cost.kinds, RATIO), cost.A, box.half, box.nodes, box.curves, box.sums, margin)


@compiled
def _grow(cost: Cost, box: Box, atlas: Atlas, i: int, hull: Array, margin: float) -> bool:
    """Write half-widths of a box around minimum i on which the cost is convex; return False where there is none.

    A cube that shrinks or doubles, then its sides one by one, none beyond the hull (3,).
    """
    sides = atlas.minima.sides[i]
    if not _convex(cost, box, atlas, i, np.zeros(3), margin):
        return False
    trial, size = np.minimum(hull, 1.0), 1.0
    while not _convex(cost, box, atlas, i, trial, margin):
        size *= 0.5
        trial = np.minimum(hull, size)
        if size < 1e-6:
            return False
    while size < _WIDEST and _convex(cost, box, atlas, i, np.minimum(hull, 1.5 * size), margin):
        size *= 1.5
    sides[:] = np.minimum(hull, size)
    for k in range(atlas.dimension):
        trial = sides.copy()
        trial[k] = min(1.5 * sides[k], hull[k])
        while trial[k] > sides[k] and _convex(cost, box, atlas, i, trial, margin):
            sides[k] = trial[k]
            trial[k] = min(1.5 * sides[k], hull[k])
    return True


# A verdict beside those of `optloc.proof.near`: the cost at infinity is within the gap.
UNBOUNDED = 8
# Boxes after which the search of an enclosure is given up for the atlas, which takes some hundred.
_SOON = 500
# Distance, relative to that of the fix, within which two minima are the same.
_CLOSE = 1e-3


@inlined
def prove_everywhere(
    cost: Cost, box: Box, x: Array, others: Array, kappa: float, eps: float, budget: int, found: Array
) -> tuple[int, int, float]:
    """Prove that no position costs less than a fix, and that no other minimum has a gap below kappa.

    The claim is for all positions, to infinity. Where something encloses the cheap ones, that is searched first; where
    nothing does, or the search does not end soon, and the cost stays finite at infinity, the atlas of all space: along
    inverse ranges a long valley is straight, and the cost convex on wider boxes.

    Parameters
    ----------
    cost, box, x, others, kappa, eps, budget, found
        As of `optloc.proof.near.prove`.

    Returns
    -------
    verdict : int
        As of `optloc.proof.near.prove`. UNBOUNDED: the cost at infinity is below that of the fix plus kappa.
    boxes : int
        How many boxes were looked at.
    bound : float
        A certified lower bound of f over all positions; -inf where there is none.
    """
    nowhere, open_end = np.full(x.shape[0], np.nan), reaches_infinity(cost.kinds, cost.K)
    first = min(budget, _SOON) if open_end else budget
    verdict, boxes, bound = prove(cost, box, x, others, kappa, eps, first, nowhere, nowhere, False, found)
    again = verdict in (OPEN, BUDGET, STATIONARY, SINGULAR) or (verdict == OTHER and _listed(x, others, found))
    if not open_end or not again or boxes >= budget:
        return verdict, boxes, bound
    verdict, more, bound = prove_atlas(cost, box, x, others, kappa, eps, budget - boxes, found)
    return verdict, boxes + more, bound


@compiled
def prove_atlas(
    cost: Cost, box: Box, x: Array, others: Array, kappa: float, eps: float, budget: int, found: Array
) -> tuple[int, int, float]:
    """Prove the same as `prove_everywhere` with the atlas alone, where `far.reaches_infinity` holds."""
    chart, _ = chart_at(cost, x, box)
    least = cost_at(cost.K, cost.w, box.nodes)
    middle, radius = cube(cost.kinds, cost.data)
    atlas = atlas_of(middle, radius, x.shape[0], 1 + (others.shape[0] if kappa > 0.0 else 0))
    known, place = zero(), np.empty(x.shape[0])
    for p in range(atlas.minima.home.shape[0]):
        place[:] = x if p == 0 else others[p - 1]
        if set_minimum(cost, box, atlas, known, place, eps):
            known += 1
        elif p == 0:
            return STATIONARY, 0, -inf
    atlas = with_minima(middle, radius, x.shape[0], first_minima(atlas.minima, known))
    level = least + kappa if kappa > 0.0 else least - eps
    outcome, boxes, bound = search_everywhere(cost, atlas, chart, level, least - eps, budget, found)
    if outcome == CLEAR:
        return UNIQUE if kappa > 0.0 else VALUE, boxes, bound
    if outcome == CHEAPER:
        return BETTER, boxes, bound
    if outcome == ANOTHER:
        return OTHER, boxes, bound
    return UNBOUNDED if outcome == INFINITE else BUDGET, boxes, min(bound, least - eps)


@compiled
def _listed(x: Array, others: Array, found: Array) -> bool:
    """Return whether a minimum that was found is one of the others: around it no box along the axes of x is convex."""
    for p in range(others.shape[0]):
        apart = away = 0.0
        for k in range(x.shape[0]):
            apart += (found[k] - others[p, k]) ** 2
            away += (x[k] - others[p, k]) ** 2
        if apart <= _CLOSE * _CLOSE * away:
            return True
    return False
