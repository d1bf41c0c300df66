"""Bounds over a box: bounds of all nodes, a lower bound of the residual's length, and the stack of boxes to search.

The cost is ``f(x) = |K phi(x) - w|^2``, with whitened rows K (q, J) and measurements w (q,). A node phi_j is one scalar
function of the position x that rows are sums of, such as a range. Over a box each node is linear up to a remainder, and
an interval encloses this remainder. A box has a centre `at` and half-widths `half` (3,) in search coordinates s, with x
= origin + T s; their unit is a standard deviation. `cut` (6,) contains the lower and upper ends of the part of the box
that remains to be searched, relative to its centre.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined
from optloc.kernels.systems import inverse
from optloc.proof.nodes.dispatch import bound_others, infinity_of, points_of
from optloc.proof.nodes.node import (
    BALANCED,
    BETWEEN,
    DIFFERENCE,
    GROWS,
    HIGH,
    LOW,
    PHI,
    RANGE,
    SLOPE0,
    SLOPE1,
    SLOPE2,
)
from optloc.proof.nodes.range import bound_ranges

# Unit in the last place of a double at 1.
_ULP = 2.0**-52
# A half-width covers the rounding of its centre and corners: relative to itself, and some units in their last place.
_WIDER, _SHIFT = 1e-12, 1e-15
# Coordinate descents towards the least-squares point of a box. Any point gives a valid bound. Over 8 fixes by range
# differences, one descent took 6 % more boxes of an atlas than three. Ten descents took 0.6 % fewer.
_SWEEPS = 3
# A node that has a bound on one side only must pull the direction v the right way. This share of |v| is the margin for
# rounding.
_BEYOND = 1e-9
# Columns of a table of rows over a box (q, ROW_WIDTH): the residual with each remainder at the middle of its interval,
# the Jacobian, and the direction v.
MIDDLE, J0, J1, J2, DIRECTION, ROW_WIDTH = range(6)


@inlined
def bound_nodes(
    kinds: Array, data: Array, centre: Array, sense: Array, gram: Array, half: Array, line: Array, nodes: Array
) -> None:
    """Bound all nodes over a box in search coordinates around a fix.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes: their codes and their numbers.
    centre : array (3,)
        Centre of the box, metres.
    sense, gram : array (3, 3)
        T with x = c + T s, and ``T'T``.
    half : array (3,)
        Half-widths in search coordinates.
    line : array (6,)
        Working memory.
    nodes : array (J, NODE_WIDTH)
        Written: value, slope and interval of the remainder of each node.
    """
    others = bound_ranges(kinds, data, centre, sense, gram, half, nodes)
    if others:
        bound_others(kinds, data, centre, sense, half, line, nodes)


@inlined
def linearise_rows(K: Array, w: Array, nodes: Array, rows: Array) -> None:
    """Write residuals and Jacobian into the table of rows (q, ROW_WIDTH), each remainder at the middle of its interval.

    A remainder with one finite bound counts with this bound. The middles are written into column BETWEEN of `nodes`.
    """
    for j in range(K.shape[1]):
        nodes[j, BETWEEN] = middle_of(nodes[j, LOW], nodes[j, HIGH])
    for i in range(K.shape[0]):
        middle, j0, j1, j2 = -w[i], 0.0, 0.0, 0.0
        for j in range(K.shape[1]):
            factor = K[i, j]
            middle += factor * (nodes[j, PHI] + nodes[j, BETWEEN])
            j0 += factor * nodes[j, SLOPE0]
            j1 += factor * nodes[j, SLOPE1]
            j2 += factor * nodes[j, SLOPE2]
        rows[i, MIDDLE], rows[i, J0], rows[i, J1], rows[i, J2] = middle, j0, j1, j2


@inlined
def middle_of(low: float, high: float) -> float:
    """Return the middle of an interval; its finite end if the other end is infinite; 0 if both are infinite."""
    middle = 0.5 * (low + high)
    if abs(middle) < inf:
        return middle
    return high if high < inf else (low if low > -inf else 0.0)


@inlined
def size_within(low: float, high: float) -> float:
    """Return the sum of the sizes of the finite ends of an interval, which limits the accuracy of its middle."""
    size = abs(low) + abs(high)
    return size if size < inf else abs(middle_of(low, high))


@inlined
def cost_at(K: Array, w: Array, nodes: Array) -> float:
    """Return the cost f at the centre of a box (no unit) from the values of its nodes."""
    total = 0.0
    for i in range(K.shape[0]):
        residual = -w[i]
        for j in range(K.shape[1]):
            residual += K[i, j] * nodes[j, PHI]
        total += residual * residual
    return total


@inlined
def least_residual(K: Array, weight: Array, floor: float, half: Array, nodes: Array, rows: Array) -> float:
    """Return a lower bound of ``|K phi - w|`` over a box; a negative result means that no bound is known.

    For any direction v, ``v.(K phi - w)`` is at least its value at the middle of the remainders, less its greatest
    change over the box and the remainders. The function takes as v the shortest residual of the linear part
    (box-constrained least squares).

    Parameters
    ----------
    K : array (q, J)
        Whitened rows.
    weight : array (J,)
        Lengths of the columns of K.
    floor : float
        Further sizes that limit the accuracy of residuals: the length of w, and the coordinates times their weights.
    half : array (3,)
        Half-widths in search coordinates.
    nodes, rows : array (J, NODE_WIDTH), (q, ROW_WIDTH)
        Filled tables of the box; the direction v is written into `rows`.
    """
    # The bound is valid for each v. A better v gives a tighter bound.
    _nearest(half, rows)
    _absorb(K, weight, nodes, rows)
    length, reach, t0, t1, t2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(K.shape[0]):
        v = rows[i, DIRECTION]
        length += v * v
        reach += v * rows[i, MIDDLE]
        t0 += v * rows[i, J0]
        t1 += v * rows[i, J1]
        t2 += v * rows[i, J2]
    if not length > 0.0:
        return -1.0
    reach -= abs(t0) * half[0] + abs(t1) * half[1] + abs(t2) * half[2]
    for j in range(K.shape[1]):
        # The residual was taken with each remainder at its middle, so a remainder changes it by at most half its
        # width.
        radius = 0.5 * (nodes[j, HIGH] - nodes[j, LOW])
        if radius > 0.0:
            total = 0.0
            for i in range(K.shape[0]):
                total += K[i, j] * rows[i, DIRECTION]
            if radius < inf:
                reach -= abs(total) * radius
            elif not total * _open_side(nodes, j) > relative_rounding(K) * weight[j] * sqrt(length):
                return -1.0  # along v the node has no bound
    return float(reach / sqrt(length)) - rounding_error(K, weight, floor, nodes)


@inlined
def exceeds_level(low: float, level: float) -> bool:
    """Return whether a residual of at least `low` implies a cost of at least `level`, which is a value of f.

    Costs are never negative, so a level of 0 or less is always exceeded.
    """
    return level <= 0.0 or (low > 0.0 and low * low >= level)


@inlined
def rounding_error(K: Array, weight: Array, floor: float, nodes: Array) -> float:
    """Return a bound of the rounding error of a residual, as a length; for the arguments see `least_residual`."""
    size = floor
    for j in range(K.shape[1]):
        size += weight[j] * (abs(nodes[j, PHI]) + size_within(nodes[j, LOW], nodes[j, HIGH]))
    return float(relative_rounding(K) * size)


@inlined
def relative_rounding(K: Array) -> float:
    """Return the relative rounding error of a sum over the nodes and rows of K (q, J); it covers all sums of a box."""
    # One rounding for each term of the sums, and 32 for the terms inside a node and in its slopes.
    return float((32 + K.shape[0] + K.shape[1]) * _ULP)


@compiled
def normal_of(rows: Array) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the entries (00, 01, 02, 11, 12, 22) of J'J, and the vector J' middle (3 numbers).

    J is the Jacobian of the residuals and `middle` the residuals in the table of rows: the terms of least squares.
    """
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(rows.shape[0]):
        middle, j0, j1, j2 = rows[i, MIDDLE], rows[i, J0], rows[i, J1], rows[i, J2]
        a00 += j0 * j0
        a01 += j0 * j1
        a02 += j0 * j2
        a11 += j1 * j1
        a12 += j1 * j2
        a22 += j2 * j2
        b0 += j0 * middle
        b1 += j1 * middle
        b2 += j2 * middle
    return a00, a01, a02, a11, a12, a22, b0, b1, b2


@compiled
def clamp(s: float, half: float) -> float:
    """Return the number between -half and half that is nearest to s."""
    if s > half:
        return half
    return max(s, -half)


@inlined
def _nearest(half: Array, rows: Array) -> None:
    """Write the direction v = middle + J s into `rows`; s is nearly the least-squares solution inside the box."""
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = normal_of(rows)
    d0, d1 = 1.0 / a00 if a00 > 0.0 else 0.0, 1.0 / a11 if a11 > 0.0 else 0.0
    d2 = 1.0 / a22 if a22 > 0.0 else 0.0
    s0, s1, s2 = 0.0, 0.0, 0.0
    for _ in range(_SWEEPS):
        s0 = clamp(-(b0 + a01 * s1 + a02 * s2) * d0, half[0])
        s1 = clamp(-(b1 + a01 * s0 + a12 * s2) * d1, half[1])
        s2 = clamp(-(b2 + a02 * s0 + a12 * s1) * d2, half[2])
    for i in range(rows.shape[0]):
        rows[i, DIRECTION] = rows[i, MIDDLE] + rows[i, J0] * s0 + rows[i, J1] * s1 + rows[i, J2] * s2


@compiled
def _absorb(K: Array, weight: Array, nodes: Array, rows: Array) -> None:
    """Remove from the direction v the parts that nodes without slope can explain (arguments as in `least_residual`).

    An example is a range over a box around its station.
    """
    for _ in range(_SWEEPS):
        for j in range(K.shape[1]):
            radius = 0.5 * (nodes[j, HIGH] - nodes[j, LOW])
            still = nodes[j, SLOPE0] == 0.0 and nodes[j, SLOPE1] == 0.0 and nodes[j, SLOPE2] == 0.0
            if not (still and 0.0 < radius and weight[j] > 0.0):
                continue
            pull = 0.0
            for i in range(K.shape[0]):
                pull += K[i, j] * rows[i, DIRECTION]
            if radius < inf:
                move = clamp(-pull / (weight[j] * weight[j]), radius)
            else:
                move = _move_beyond(K, weight[j], rows, pull, _open_side(nodes, j))
            for i in range(K.shape[0]):
                rows[i, DIRECTION] += move * K[i, j]


@compiled
def _open_side(nodes: Array, j: int) -> float:
    """Return 1 if a node has no upper bound, -1 if it has no lower bound, and 0 if it has neither or both."""
    return (1.0 if nodes[j, LOW] > -inf else 0.0) - (1.0 if nodes[j, HIGH] < inf else 0.0)


@compiled
def _move_beyond(K: Array, weight: float, rows: Array, pull: float, side: float) -> float:
    """Return a step of a one-sided node towards its open side; after it the node only adds to the residual along v.

    `weight` is the length of the node's column of K, `pull` its product with v, and `side` is 1 or -1, the open
    direction.
    """
    length = 0.0
    for i in range(K.shape[0]):
        length += rows[i, DIRECTION] * rows[i, DIRECTION]
    move = (_BEYOND * sqrt(length) * weight - side * pull) / (weight * weight)
    return side * max(move, 0.0)


# Contraction of a box: parts in which the residual is too long are cut off.


@inlined
def contract_box(
    K: Array, weight: Array, rho: float, half: Array, plane: bool, nodes: Array, rows: Array, cut: Array, solve: Array
) -> None:
    """Contract a box to the part in which the residual may be shorter than rho.

    Let Z be nearly the inverse of J'J, ``Y = Z J'`` and ``E = Y J - 1``, and dq the remainders minus the middles of
    their intervals. Each point of the box obeys ``s = Y (residual) - Y (middle) - Y K dq - E s``. This bounds the
    distance of coordinate k from coordinate k of -Y middle by
    ``rho |Y_k| + sum_j |Y_k K_j| (high_j - low_j)/2 + |E_k| half``.

    Parameters
    ----------
    K, weight : array (q, J), (J,)
        Whitened rows, and the lengths of their columns.
    rho : float
        Longest residual of interest, rounding included.
    half : array (3,)
        Half-widths.
    plane : bool
        Whether no node depends on the third coordinate.
    nodes, rows : arrays
        Filled tables of the box.
    cut : array (6,)
        Lower and upper ends of the box relative to its centre; contracted in place.
    solve : array (3, 3)
        Working memory.
    """
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = normal_of(rows)
    if plane:  # no node depends on the third coordinate, so any positive pivot is valid
        a22 = a22 + 1.0
    if half[1] == 0.0:  # no node depends on the second coordinate either
        a11 = a11 + 1.0
    if not inverse(a00, a01, a02, a11, a12, a22, solve):
        return
    r0, r1, r2, size, longest = 0.0, 0.0, 0.0, rho, 0.0
    for i in range(K.shape[0]):
        longest += rows[i, MIDDLE] * rows[i, MIDDLE]
    for j in range(K.shape[1]):
        radius = 0.5 * (nodes[j, HIGH] - nodes[j, LOW])
        if radius > 0.0:
            p0, p1, p2 = 0.0, 0.0, 0.0
            for i in range(K.shape[0]):
                p0 += K[i, j] * rows[i, J0]
                p1 += K[i, j] * rows[i, J1]
                p2 += K[i, j] * rows[i, J2]
            size += weight[j] * radius
            r0 += abs(solve[0, 0] * p0 + solve[0, 1] * p1 + solve[0, 2] * p2) * radius
            r1 += abs(solve[1, 0] * p0 + solve[1, 1] * p1 + solve[1, 2] * p2) * radius
            r2 += abs(solve[2, 0] * p0 + solve[2, 1] * p1 + solve[2, 2] * p2) * radius
    l0, l1, l2, h0, h1, h2 = sqrt(a00), sqrt(a11), sqrt(a22), half[0], half[1], half[2]
    # Products of Y with vectors of these lengths have this rounding error: terms are rounded before they cancel.
    slack = relative_rounding(K) * (size + sqrt(longest) + l0 * h0 + l1 * h1 + l2 * h2)
    for k in range(2 if plane else 3):
        y0, y1, y2 = solve[k, 0], solve[k, 1], solve[k, 2]
        e0 = abs(y0 * a00 + y1 * a01 + y2 * a02 - (k == 0))
        e1 = abs(y0 * a01 + y1 * a11 + y2 * a12 - (k == 1))
        e2 = abs(y0 * a02 + y1 * a12 + y2 * a22 - (k == 2))
        # |Y_k|^2 is entry kk of Z J'J Z.
        across = solve[k, k] + (e0 * abs(y0) + e1 * abs(y1) + e2 * abs(y2))
        reach = (r0 if k == 0 else (r1 if k == 1 else r2)) + rho * sqrt(max(across, 0.0))
        reach += e0 * h0 + e1 * h1 + e2 * h2 + slack * (abs(y0) * l0 + abs(y1) * l1 + abs(y2) * l2)
        contract_coordinate(cut, k, -(y0 * b0 + y1 * b1 + y2 * b2), reach)


@inlined
def reset_cut(half: Array, cut: Array) -> None:
    """Write the ends of the whole box into `cut` (6,): the remaining part is then the whole box."""
    for k in range(3):
        cut[k], cut[3 + k] = -half[k], half[k]


@compiled
def contract_coordinate(cut: Array, k: int, centre: float, reach: float) -> None:
    """Contract coordinate k of `cut` to ``|s - centre| <= reach``, with slack for rounding."""
    reach += 1e-9 * (abs(centre) + reach)
    if not reach < inf:  # NaN as well: with infinite bounds the coordinate is not restricted
        return
    cut[k], cut[3 + k] = max(cut[k], centre - reach), min(cut[3 + k], centre + reach)


@inlined
def share_left(cut: Array, half: Array) -> float:
    """Return the share, 0 to 1, of a box's volume that remains between the ends of a cut."""
    share = 1.0
    for k in range(3):
        if cut[k] > cut[3 + k]:
            return 0.0
        if half[k] > 0.0:
            share *= 0.5 * (cut[3 + k] - cut[k]) / half[k]
    return share


@inlined
def cut_out(cut: Array, at: Array, half: Array) -> float:
    """Replace a box by its part between the ends of a cut; return the share, 0 to 1, of the volume that remains."""
    share = 1.0
    for k in range(3):
        low, high, old = cut[k], cut[3 + k], half[k]
        if low > high:
            return 0.0
        if low > -old or high < old:
            middle = at[k] + 0.5 * (low + high)
            half[k] = min(0.5 * (high - low) * (1.0 + _WIDER) + _SHIFT * (abs(at[k]) + old), old)
            at[k] = middle
            share *= half[k] / old
    return share


@compiled
def is_empty(cut: Array) -> bool:
    """Return whether the cut leaves no part of a box: the lower end of a coordinate exceeds the upper end."""
    return bool(cut[0] > cut[3] or cut[1] > cut[4] or cut[2] > cut[5])


# Each side also gets this share of the steepest side's change, because nodes that are only enclosed have no slope.
# Over 8 fixes by range differences a share of 0 took 10 % more boxes.
_ALIKE = 0.1


@compiled
def steepest_side(half: Array, rows: Array, dimension: int) -> int:
    """Return the number k < dimension of the side along which the residual changes most: the best side to halve.

    Each side also counts with a share of the greatest change. Nodes that are only enclosed have no slope, although they
    depend on the position.
    """
    steepest, best, k = 0.0, -1.0, 0
    for m in range(dimension):
        steepest = max(steepest, _steepness(rows, m))
    for m in range(dimension):
        change = (_steepness(rows, m) + _ALIKE * steepest + 1e-300) * half[m]  # if all slopes are zero, the widest side
        if change > best:
            best, k = change, m
    return k


@inlined
def widest(half: Array) -> int:
    """Return the number (0, 1 or 2) of the widest side of a box."""
    if half[0] >= half[1] and half[0] >= half[2]:
        return 0
    return 1 if half[1] >= half[2] else 2


@compiled
def _steepness(rows: Array, m: int) -> float:
    """Return the length of the derivative of the residual along side m."""
    total = 0.0
    for i in range(rows.shape[0]):
        total += rows[i, J0 + m] * rows[i, J0 + m]
    return sqrt(total)


# The boxes still to be searched are a stack: the deepest box comes first, so that the stack stays short.

# Columns of the stack (capacity, DEPTH): centre, half-widths, lower bound of the residual over the parent box, and the
# piece of the atlas. The piece is 0 in search coordinates around a fix.
CENTRE, HALF, LEAST, PIECE, DEPTH = 0, 3, 6, 7, 8


@compiled
def push_around(stack: Array, size: int, low: Array, high: Array, hole: Array, piece: int) -> int:
    """Push the box between two corners without the box |s_k| <= hole_k around the origin; return the size of the stack.

    The corners are `low` and `high`, and the hole is the convex box around a minimum, all (3,). It is cut out along its
    faces, which leaves at most two slabs in each dimension. Slabs overlap the hole by rounding, and belong to `piece`.
    """
    low, high = low.copy(), high.copy()
    for k in range(3):
        for side in range(2):
            first, last = (low[k], min(-hole[k], high[k])) if side == 0 else (max(hole[k], low[k]), high[k])
            if not last > first:
                continue
            for m in range(3):
                a, b = (first, last) if m == k else (low[m], high[m])
                stack[size, CENTRE + m], stack[size, HALF + m] = 0.5 * (a + b), _wide(0.5 * (b - a), abs(a) + abs(b))
            stack[size, LEAST], stack[size, PIECE] = 0.0, piece
            size += 1
        if -hole[k] > high[k] or hole[k] < low[k]:
            return size
        low[k], high[k] = max(low[k], -hole[k]), min(high[k], hole[k])
    return size


@compiled
def pop(stack: Array, row: int, at: Array, half: Array) -> None:
    """Copy centre and half-widths of the box at `row` of the stack into `at` and `half`."""
    for k in range(3):
        at[k], half[k] = stack[row, CENTRE + k], stack[row, HALF + k]


@compiled
def push(stack: Array, size: int, at: Array, half: Array, low: float, piece: int) -> int:
    """Push a box, with lower bound `low` of the residual over it; return the number of boxes on the stack."""
    for k in range(3):
        stack[size, CENTRE + k], stack[size, HALF + k] = at[k], half[k]
    stack[size, LEAST], stack[size, PIECE] = low, piece
    return size + 1


@compiled
def push_halves(stack: Array, size: int, k: int, at: Array, half: Array, low: float, piece: int, exact: bool) -> int:
    """Push the two halves of a box that is cut across side k; return the number of boxes on the stack.

    `low` bounds the residual over the box. `exact`: centres and half-widths are sums of powers of two, so that halving
    does not round them.
    """
    for side in range(2):
        for m in range(3):
            stack[size, CENTRE + m], stack[size, HALF + m] = at[m], half[m]
        quarter = 0.5 * half[k]
        stack[size, CENTRE + k] = at[k] + (quarter if side else -quarter)
        stack[size, HALF + k] = quarter if exact else _wide(quarter, abs(at[k]) + half[k])
        stack[size, LEAST], stack[size, PIECE] = low, piece
        size += 1
    return size


@compiled
def _wide(half: float, size: float) -> float:
    """Return a half-width, enlarged by the rounding of a centre and a corner of this size."""
    return half * (1.0 + _WIDER) + _SHIFT * size if half > 0.0 else 0.0


@compiled
def least_left(stack: Array, size: int) -> float:
    """Return a lower bound of the cost over the first `size` boxes of the stack; infinity for an empty stack."""
    least = inf
    for i in range(size):
        low = stack[i, LEAST]
        least = min(least, low * low if low > 0.0 else 0.0)  # NaN, too, gives no bound
    return least


# All of space as boxes: whether boxes may reach infinity, and the cube in the middle.

# Sum of the coefficients of ranges in a row, relative to the sum of their sizes, below which the row counts as
# balanced. Only the rounding of whitening keeps this sum from zero.
_BALANCED = 1e-12
# Half-width of the cube, in half-sizes of the station array. The margin keeps stations off the faces of the cube,
# where the scaled line to a station would vanish.
_REACHES = 1.25
# Both in half-sizes of the station array: if the fix is closer than `_NEAR_CENTRE` to the middle of the stations, the
# centre of the cube moves by `_ASIDE`. Convex boxes around a fix, and boxes of low cost, end before they reach a
# centre that is a fifth of the array away. The direction of the move is oblique: on the line from the centre through
# the fix to a station, the difference of both ranges has no slope.
_NEAR_CENTRE, _ASIDE = 0.1, (0.21, 0.13, 0.17)


@compiled
def reaches_infinity(kinds: Array, K: Array) -> bool:
    """Return whether a cost stays finite at infinity, so that an atlas of all positions applies.

    Linear forms, heights, and ranges without a range of opposite sign grow without limit, and so do logarithms of
    ranges.

    Parameters
    ----------
    kinds : int array (J,)
        Codes of the nodes.
    K : array (q, J)
        Whitened rows.
    """
    for j in range(kinds.shape[0]):
        # Here and below, ranges skip the call `infinity_of`: they are the common case, and their limit is known.
        if kinds[j] != RANGE and infinity_of(kinds[j]) == GROWS:
            return False
    for i in range(K.shape[0]):
        total = size = logarithms = lengths = 0.0
        for j in range(kinds.shape[0]):
            if kinds[j] == RANGE or infinity_of(kinds[j]) == DIFFERENCE:
                total += K[i, j]
                size += abs(K[i, j])
            elif infinity_of(kinds[j]) == BALANCED:
                logarithms += K[i, j]
                lengths += abs(K[i, j])
        if abs(total) > _BALANCED * size or abs(logarithms) > _BALANCED * lengths:
            return False
    return True


@compiled
def station_cube(kinds: Array, data: Array, x: Array) -> tuple[Array, float]:
    """Return centre (3,) and half-width, metres, of a cube that contains all stations with a margin.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        Nodes that have stations.
    x : array (D,)
        The fix, metres. If the fix is near the middle of the stations, the centre is moved: each range is counted from
        the distance to the centre, which has no derivative at the centre. If all stations coincide, the distance of
        the fix from them sets the size.
    """
    low, high = np.full(3, inf), np.full(3, -inf)
    for j in range(kinds.shape[0]):
        for first in range(0, 3 * points_of(kinds[j]), 3):
            for k in range(3):
                low[k], high[k] = min(low[k], data[j, first + k]), max(high[k], data[j, first + k])
    reach = 0.0
    for k in range(3):
        reach = max(reach, 0.5 * (high[k] - low[k]))
    middle, away = 0.5 * (low + high), 0.0
    for k in range(x.shape[0]):
        away = max(away, abs(x[k] - middle[k]))
    if not reach > 0.0:
        reach = away
    elif away < _NEAR_CENTRE * reach:
        for k in range(x.shape[0]):
            middle[k] += _ASIDE[k] * reach
        reach *= 1.0 + _ASIDE[0]
    return middle, _REACHES * reach if reach > 0.0 else 1.0
