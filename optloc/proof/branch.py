"""Branch and bound over boxes of the near chart."""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

from optloc.kernels.jit import compiled, inlined
from optloc.proof.boxes import bound_nodes, cost_at, least_residual, linearise_rows, rounding
from optloc.proof.chart import Box, Chart, Cost, place
from optloc.proof.clip import cut_out, is_empty, shrink, uncut
from optloc.proof.convex import clip_to_stationary, convex, curve_nodes, sum_up
from optloc.proof.descend import descend
from optloc.proof.nodes import RANGE
from optloc.proof.stack import pop, push, push_halves
from optloc.types import Array

# What a search finds: nothing, a cheaper point, another minimum below the level, or no end within the budget.
CLEAR, CHEAPER, ANOTHER, SPENT = range(4)
# Share of a box below which what is left is looked at again before it is cut.
_SHRUNK = 0.5


class Aim(NamedTuple):
    """What is to be shown of every box.

    Parameters
    ----------
    level : float
        Cost from which on a box is done.
    value : float
        Cost that every point must be shown to have.
    better : float
        Cost below which a point refutes the fix; above `value`, so that no sliver is left between the two.
    whole : bool
        Whether a box is done as well where the gradient cannot vanish, because the search as a whole leaves no way out;
        otherwise only if its cost is at least `value`.
    floor : float
        See `optloc.proof.boxes.least_residual`.
    """

    level: float
    value: float
    better: float
    whole: bool
    floor: float


@compiled
def branch(
    cost: Cost, chart: Chart, box: Box, minima: Array, sides: Array, aim: Aim, budget: int, stack: Array, size: int
) -> tuple[int, int, float]:
    """Look at the boxes of a stack until none is left.

    Parameters
    ----------
    cost, chart : Cost, Chart
        The cost and its search coordinates.
    box : Box
        Tables; holds the point of the outcomes CHEAPER and ANOTHER in the end.
    minima, sides : array (P, 3)
        Known minima, and half-widths of boxes around them where the cost is convex.
    aim : Aim
        What is to be shown.
    budget : int
        How many boxes may be looked at.
    stack, size : array (CAPACITY, DEPTH), int
        The boxes (`optloc.proof.stack`).

    Returns
    -------
    outcome : int
        CLEAR: all is shown. CHEAPER: a point below `aim.better`. ANOTHER: a minimum below `aim.level`. SPENT: boxes are
        left.
    boxes : int
        How many boxes were looked at.
    bound : float
        A lower bound of f in the boxes left; infinite if there are none.
    """
    # Arrays by names of their own: to hand a record on counts references to all it holds, at every box.
    kinds, data, K, w, A = cost.kinds, cost.data, cost.K, cost.w, cost.A
    sense, gram, at, half, centre, line = chart.sense, chart.gram, box.at, box.half, box.centre, box.line
    nodes, rows, curves, sums, solve, cut = box.nodes, box.rows, box.curves, box.sums, box.solve, box.cut
    weight, origin, unique = cost.weight, chart.origin, aim.level > aim.value
    rho = sqrt(max(aim.level, 0.0))
    boxes, low_points = 0, 0
    while size > 0:
        if boxes >= budget or size + 2 > stack.shape[0]:
            return SPENT, boxes, _lowest(stack, size)
        size -= 1
        pop(stack, size, at, half)
        boxes += 1
        place(origin, sense, at, centre)
        bound_nodes(kinds, data, centre, sense, gram, half, line, nodes)
        linearise_rows(K, w, nodes, rows)
        low = least_residual(K, weight, aim.floor, half, nodes, rows)
        if low > 0.0 and low * low >= aim.level:
            continue
        here = cost_at(K, w, nodes)
        if here < aim.better:
            return CHEAPER, boxes, 0.0
        uncut(half, cut)
        shrink(K, rho + rounding(K, weight, aim.floor, nodes), half[2] == 0.0, nodes, rows, cut, solve)
        if unique or aim.whole:
            sound = aim.whole or (low > 0.0 and low * low >= aim.value)
            if sound and is_known(at, half, minima, sides):
                continue
            curve_nodes(kinds, data, centre, sense, gram, half, line, solve, nodes, curves)
            sum_up(K, w, nodes, curves, sums)
            if sound:
                clip_to_stationary(A, half, nodes, curves, sums, cut, solve)
            if here < aim.level and not is_empty(cut):
                low_points += 1
                # Early, then more and more seldom, and wherever a box holds one minimum at most.
                if low_points & (low_points - 1) == 0 or convex(kinds, A, half, nodes, curves, sums, 0.0):
                    outcome = _follow(cost, chart, box, minima, sides, aim)
                    if outcome != CLEAR:
                        return outcome, boxes, 0.0
        side = cut_side(kinds, K, gram, half, nodes, rows, here < aim.level)
        share = cut_out(cut, at, half)
        if 0.0 < share < _SHRUNK:
            size = push(stack, size, at, half, low)
        elif share > 0.0:
            size = push_halves(stack, size, side, at, half, low)
    return CLEAR, boxes, inf


@compiled
def _follow(cost: Cost, chart: Chart, box: Box, minima: Array, sides: Array, aim: Aim) -> int:
    """Descend from the centre of a box to a minimum; return CHEAPER, or ANOTHER if it is not known, or CLEAR.

    The box is the minimum afterwards, or where all is clear what it was, but for its tables.
    """
    at, half = box.at.copy(), box.half.copy()
    least = descend(cost, chart, box)
    if least < aim.better:
        return CHEAPER
    if least < aim.level and not is_known(box.at, box.half, minima, sides):
        return ANOTHER
    box.at[:], box.half[:] = at, half
    return CLEAR


@compiled
def is_known(at: Array, half: Array, minima: Array, sides: Array) -> bool:
    """Return whether a box lies inside the convex box (half-widths `sides`) of a known minimum."""
    for p in range(minima.shape[0]):
        inside = True
        for k in range(3):
            inside = inside and abs(at[k] - minima[p, k]) + half[k] <= sides[p, k]
        if inside:
            return True
    return False


@inlined
def cut_side(kinds: Array, K: Array, gram: Array, half: Array, nodes: Array, rows: Array, inside: bool) -> int:
    """Return the coordinate across which to cut a box: where the remainders that matter shrink most.

    The remainder of a range is nearly ``s'N s / 2``, so coordinate k has the share ``h_k sum_m |N_km| h_m`` in it; it
    matters with its pull ``|K_j.v|`` on the bound. Where ranges have no part in the bound, and where no bound can do,
    because the centre lies below the level (`inside`), the widest side is cut.
    """
    if inside:
        return _widest(half)
    t0, t1, t2, h0, h1, h2 = 0.0, 0.0, 0.0, half[0], half[1], half[2]
    for j in range(kinds.shape[0]):
        wide = nodes[j, 5] - nodes[j, 4]
        if kinds[j] == RANGE and wide > 0.0:
            pull = 0.0
            for i in range(K.shape[0]):
                pull += K[i, j] * rows[i, 4]
            e0, e1, e2 = nodes[j, 1] * h0, nodes[j, 2] * h1, nodes[j, 3] * h2
            a, b = abs(gram[0, 1] * h0 * h1 - e0 * e1), abs(gram[0, 2] * h0 * h2 - e0 * e2)
            c = abs(gram[1, 2] * h1 * h2 - e1 * e2)
            x, y = gram[0, 0] * h0 * h0 - e0 * e0 + a + b, gram[1, 1] * h1 * h1 - e1 * e1 + a + c
            z = gram[2, 2] * h2 * h2 - e2 * e2 + b + c
            pull = abs(pull) * wide / (x + y + z + 1e-300)
            t0 += pull * x
            t1 += pull * y
            t2 += pull * z
    most = max(t0, t1, t2)
    if not most > 0.0:
        return _widest(half)
    return 0 if t0 == most else (1 if t1 == most else 2)


@inlined
def _widest(half: Array) -> int:
    if half[0] >= half[1] and half[0] >= half[2]:
        return 0
    return 1 if half[1] >= half[2] else 2


@compiled
def _lowest(stack: Array, size: int) -> float:
    """Return a lower bound of the cost in the boxes left."""
    least = inf
    for i in range(size):
        low = max(stack[i, 6], 0.0)
        least = min(least, low * low)
    return least
