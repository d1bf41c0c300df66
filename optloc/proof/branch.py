"""Branch and bound over boxes of the near chart."""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

from optloc.kernels.jit import compiled
from optloc.proof.boxes import cost_at, rounding
from optloc.proof.chart import Box, Chart, Cost, bound_box, curve_box
from optloc.proof.clip import cut_out, is_empty, shrink
from optloc.proof.convex import clip_to_stationary, convex
from optloc.proof.descend import descend
from optloc.proof.inline import inlined
from optloc.proof.stack import push, push_halves
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
    boxes, low_points = 0, 0
    while size > 0:
        if boxes >= budget or size + 2 > stack.shape[0]:
            return SPENT, boxes, _lowest(stack, size)
        size -= 1
        box.at[:], box.half[:] = stack[size, :3], stack[size, 3:6]
        boxes += 1
        low = bound_box(cost, chart, box, aim.floor)
        if low > 0.0 and low * low >= aim.level:
            continue
        here = cost_at(cost.K, cost.w, box.nodes)
        if here < aim.better:
            return CHEAPER, boxes, 0.0
        for k in range(3):
            box.cut[k], box.cut[3 + k] = -box.half[k], box.half[k]
        _shrink(cost, box, aim)
        if aim.level > aim.value:
            if aim.whole or (low > 0.0 and low * low >= aim.value):
                if _known(box, minima, sides):
                    continue
                curve_box(cost, chart, box)
                clip_to_stationary(cost.A, box.half, box.nodes, box.curves, box.sums, box.cut, box.solve)
            else:
                curve_box(cost, chart, box)
            if here < aim.level and not is_empty(box.cut):
                low_points += 1
                # Early, then more and more seldom, and wherever a box holds one minimum at most.
                if low_points & (low_points - 1) == 0 or _is_bowl(cost, box):
                    outcome = _follow(cost, chart, box, minima, sides, aim)
                    if outcome != CLEAR:
                        return outcome, boxes, 0.0
        side = _side(cost, chart, box, here < aim.level)
        share = cut_out(box.cut, box.at, box.half)
        if 0.0 < share < _SHRUNK:
            size = push(stack, size, box.at, box.half, low)
        elif share > 0.0:
            size = push_halves(stack, size, side, box.at, box.half, low)
    return CLEAR, boxes, inf


@inlined
def _shrink(cost: Cost, box: Box, aim: Aim) -> None:
    rho = sqrt(max(aim.level, 0.0)) + rounding(cost.K, cost.weight, aim.floor, box.nodes)
    shrink(cost.K, rho, box.half[2] == 0.0, box.nodes, box.rows, box.cut, box.solve)


@inlined
def _is_bowl(cost: Cost, box: Box) -> bool:
    return convex(cost.kinds, cost.A, box.half, box.nodes, box.curves, box.sums, 0.0)


@compiled
def _follow(cost: Cost, chart: Chart, box: Box, minima: Array, sides: Array, aim: Aim) -> int:
    """Descend from the centre of a box to a minimum; return CHEAPER, or ANOTHER if it is not known, or CLEAR.

    The box is the minimum afterwards, or where all is clear what it was, but for its tables.
    """
    at0, at1, at2 = box.at[0], box.at[1], box.at[2]
    h0, h1, h2 = box.half[0], box.half[1], box.half[2]
    least = descend(cost, chart, box)
    if least < aim.better:
        return CHEAPER
    if least < aim.level and not _known(box, minima, sides):
        return ANOTHER
    box.at[0], box.at[1], box.at[2] = at0, at1, at2
    box.half[0], box.half[1], box.half[2] = h0, h1, h2
    return CLEAR


@compiled
def _side(cost: Cost, chart: Chart, box: Box, inside: bool) -> int:
    """Return the coordinate across which to cut a box: where the remainders that matter shrink most.

    The remainder of a range is nearly ``s'N s / 2``, so coordinate k has the share ``h_k sum_m |N_km| h_m`` in it; it
    matters with its pull ``|K_j.v|`` on the bound. Where ranges have no part in the bound, and where no bound can do,
    because the centre lies below the level (`inside`), the widest side is cut.
    """
    if inside:
        return _widest(box.half)
    t0, t1, t2 = 0.0, 0.0, 0.0
    nodes, half, gram = box.nodes, box.half, chart.gram
    h0, h1, h2 = half[0], half[1], half[2]
    for j in range(cost.kinds.shape[0]):
        wide = nodes[j, 5] - nodes[j, 4]
        if wide > 0.0:
            pull = 0.0
            for i in range(cost.K.shape[0]):
                pull += cost.K[i, j] * box.rows[i, 4]
            g0, g1, g2 = nodes[j, 1], nodes[j, 2], nodes[j, 3]
            a = abs(gram[0, 1] - g0 * g1) * h0 * h1
            b = abs(gram[0, 2] - g0 * g2) * h0 * h2
            c = abs(gram[1, 2] - g1 * g2) * h1 * h2
            x, y = (gram[0, 0] - g0 * g0) * h0 * h0 + a + b, (gram[1, 1] - g1 * g1) * h1 * h1 + a + c
            z = (gram[2, 2] - g2 * g2) * h2 * h2 + b + c
            pull = abs(pull) * wide / (x + y + z + 1e-300)
            t0 += pull * x
            t1 += pull * y
            t2 += pull * z
    most = max(t0, t1, t2)
    if not most > 0.0:
        return _widest(half)
    return 0 if t0 == most else (1 if t1 == most else 2)


@compiled
def _widest(half: Array) -> int:
    if half[0] >= half[1] and half[0] >= half[2]:
        return 0
    return 1 if half[1] >= half[2] else 2


@compiled
def _known(box: Box, minima: Array, sides: Array) -> bool:
    """Return whether a box lies inside the convex box of a known minimum."""
    for p in range(minima.shape[0]):
        inside = True
        for k in range(3):
            inside = inside and abs(box.at[k] - minima[p, k]) + box.half[k] <= sides[p, k]
        if inside:
            return True
    return False


@compiled
def _lowest(stack: Array, size: int) -> float:
    """Return a lower bound of the cost in the boxes left."""
    least = inf
    for i in range(size):
        low = max(stack[i, 6], 0.0)
        least = min(least, low * low)
    return least
