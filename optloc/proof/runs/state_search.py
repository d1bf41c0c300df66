"""The search of boxes of positions and velocities for a target in uniform motion, and its proof in a region.

A state is position and velocity (n = 4 numbers), and search coordinates are principal axes of the cost at the fix, in
standard deviations. Each box is first bounded with the rows of a few epochs, whose cost is never more than the cost of
all rows; all rows are used only if this bound is not sufficient.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, zero
from optloc.kernels.systems import invert
from optloc.proof.box import exceeds_level
from optloc.proof.local_search import (
    ANOTHER,
    BETTER,
    BUDGET,
    CHEAPER,
    CLEAR,
    COARSE,
    OTHER,
    SPENT,
    STATIONARY,
    UNIQUE,
    VALUE,
    Goal,
)
from optloc.proof.runs.rows import residual_at, rounding_of_residual
from optloc.proof.runs.state_bounds import has_no_minimum, is_convex, least_length, set_lines, sum_up
from optloc.proof.runs.states import (
    SHIFT,
    WIDER,
    ConstantVelocityCost,
    StateAxes,
    StateTable,
    floor_of,
    put,
    set_bends,
    set_box,
    table_of,
)
from optloc.proof.search_space import COARSEST, equal_within

# The search.

# As in `optloc.proof.runs.search`: levels below which boxes are bounded with all rows, and below which derivatives
# exclude minima; boxes on the stack; and the greatest number of bounds with few rows, as a multiple of the budget for
# all rows.
_WORTH, _NEAR, _CAPACITY, _LOOKS = 4.0, 100.0, 4096, 10
# Each side also counts with this share of the steepest side's change.
_ALIKE = 0.1


class Search(NamedTuple):
    """Data of a search, and the known minima.

    Parameters
    ----------
    whole, few : ConstantVelocityCost
        All rows, and the rows of a few epochs, whose cost is nowhere more.
    axes : StateAxes
        The coordinates.
    table, small : StateTable
        Working memory for all rows, and for few.
    floors : tuple of 2 float
        Sizes of measurements and coordinates in the residuals of all and of few rows, without the nodes.
    minima, sides : array (P, n)
        Known minima, and half-widths of boxes around them on which the cost is convex.
    """

    whole: ConstantVelocityCost
    few: ConstantVelocityCost
    axes: StateAxes
    table: StateTable
    small: StateTable
    floors: tuple[float, float]
    minima: Array
    sides: Array


@compiled
def search_courses(search: Search, stack: Array, size: int, aim: Goal, budget: int, found: Array) -> tuple[int, int]:
    """Search boxes for minima that cost less than a level; return the outcome and the number of boxes.

    Parameters
    ----------
    search : Search
        Data of the search.
    stack, size : array (capacity, 2 n), int
        The boxes: centres, half-widths.
    aim : Goal
        The conditions to show for each box.
    budget : int
        Greatest number of boxes with all rows; with few rows, `_LOOKS` times this number is allowed.
    found : array (n,)
        Written: the state of the outcomes CHEAPER and ANOTHER.

    Returns
    -------
    outcome : int
        CLEAR, CHEAPER (a state costs less than `aim.better`), ANOTHER (an unknown minimum below the level), or SPENT.
    boxes : int
        Number of boxes that were taken from the stack.
    """
    axes, table, small, n = search.axes, search.table, search.small, found.shape[0]
    boxes, looks, lows = 0, 0, 0
    while size > 0:
        if boxes >= budget or looks >= _LOOKS * budget or size + 2 > stack.shape[0]:
            return SPENT, looks
        size -= 1
        looks += 1
        put(small, stack[size, :n], stack[size, n:])
        where = _where(axes, small.at, small.half)  # -1: outside the region, 0: across its edge, 1: inside
        if where < 0 or _is_known(search, small.at, small.half):
            continue
        here, low = _look(search.few, axes, small, search.floors[1], aim.level)
        if exceeds_level(low, aim.level):
            continue
        if here < _WORTH * (aim.level + 1.0):
            boxes += 1
            put(table, small.at, small.half)
            here, low = _look(search.whole, axes, table, search.floors[0], aim.level)
            if exceeds_level(low, aim.level):
                continue
            inside = _is_inside(axes, table.at, found)
            if inside and here < aim.better:
                return CHEAPER, looks
            # inside a region, the gradient vanishes at a minimum; on the edge of the region the cost must exceed the
            # level
            if where > 0 and here < _NEAR * (aim.level + 1.0):
                ball, noise = _curve(search, table)
                if has_no_minimum(table, ball, noise):
                    continue
            lows += int(inside and here < aim.level)
            # at low centre number 1, 2, 4 and so on: minima are found early, with few descents in vain
            if inside and here < aim.level and lows & (lows - 1) == 0 and _descends(search, aim.level, found):
                return ANOTHER, looks
        size = _push_halves(stack, size, small, _steepest(small))
    return CLEAR, looks


@compiled
def _look(
    course: ConstantVelocityCost, axes: StateAxes, table: StateTable, floor: float, level: float
) -> tuple[float, float]:
    """Return the cost at the centre of a box that is set, and a lower bound of the residual over it.

    A negative bound means that no bound is known. `floor` is the result of `floor_of`. Second derivatives are computed
    only if the bound without them is below `level`.
    """
    set_box(course, axes, table)
    here = residual_at(course.rows, table.nodes, table.sheet)
    noise = rounding_of_residual(course.rows, floor, table.nodes)
    set_lines(course, table)
    if here < level:  # no bound can exceed the level
        return here, -1.0
    low = least_length(course, table, here, False) - noise
    if exceeds_level(low, level):
        return here, low
    set_bends(course, axes, table)
    return here, max(low, least_length(course, table, here, True) - noise)


@compiled
def _curve(search: Search, table: StateTable) -> tuple[float, float]:
    """Fill the sums of a box that was bounded with all rows; return the results of `sum_up`."""
    noise = rounding_of_residual(search.whole.rows, search.floors[0], table.nodes)
    set_bends(search.whole, search.axes, table)
    return sum_up(search.whole, table, noise)


@compiled
def _where(axes: StateAxes, at: Array, half: Array) -> int:
    """Return -1 if no state of a box is in the region, 1 if all are inside it, and 0 otherwise.

    The box has the centre `at` and the half-widths `half` (n,); the region is in `axes`.
    """
    inside = 1
    for i in range(at.shape[0]):
        middle, reach = axes.origin[i], 0.0
        for m in range(at.shape[0]):
            middle += axes.turn[i, m] * at[m]
            reach += abs(axes.turn[i, m]) * half[m] * (1.0 + 1e-9)
        if middle - reach > axes.corners[1, i] or middle + reach < axes.corners[0, i]:
            return -1
        if middle - reach <= axes.corners[0, i] or middle + reach >= axes.corners[1, i]:
            inside = 0
    return inside


@compiled
def _is_inside(axes: StateAxes, at: Array, state: Array) -> bool:
    """Write the state of search coordinates `at` into `state`; return whether it is in the region."""
    inside = True
    for i in range(at.shape[0]):
        state[i] = axes.origin[i]
        for m in range(at.shape[0]):
            state[i] += axes.turn[i, m] * at[m]
        inside = inside and axes.corners[0, i] <= state[i] <= axes.corners[1, i]
    return inside


@compiled
def _is_known(search: Search, at: Array, half: Array) -> bool:
    """Return whether a box (centre `at`, half-widths `half`) is inside the convex box of a known minimum."""
    for p in range(search.minima.shape[0]):
        inside = True
        for m in range(at.shape[0]):
            inside = inside and abs(at[m] - search.minima[p, m]) + half[m] <= search.sides[p, m]
        if inside:
            return True
    return False


@compiled
def _steepest(table: StateTable) -> int:
    """Return the side of a linearised box along which the residual changes most: the side to halve."""
    best, steepest, side, n = -1.0, 0.0, 0, table.at.shape[0]
    for m in range(n):
        table.move[m] = 0.0
        for value in table.lines[m]:
            table.move[m] += value * value
        table.move[m] = sqrt(table.move[m])
        steepest = max(steepest, table.move[m] / table.half[m])
    for m in range(n):
        change = table.move[m] + (_ALIKE * steepest + 1e-300) * table.half[m]
        if change > best:
            best, side = change, m
    return side


@compiled
def _push_halves(stack: Array, size: int, table: StateTable, side: int) -> int:
    """Push the halves of a box across `side`, widened by rounding; return the number of boxes on the stack."""
    n = table.at.shape[0]
    for sign in (-0.5, 0.5):
        for m in range(n):
            stack[size, m], stack[size, n + m] = table.at[m], table.half[m]
        stack[size, side] += sign * table.half[side]
        stack[size, n + side] *= 0.5
        stack[size, n + side] += WIDER * stack[size, n + side] + SHIFT * (abs(table.at[side]) + table.half[side])
        size += 1
    return size


# Descents.

# Greatest number of steps, and the length of the last step, standard deviations.
_STEPS, _CLOSE = 40, 1e-3


@compiled
def _descends(search: Search, level: float, found: Array) -> bool:
    """Return whether the centre of the box `search.table` descends to an unknown minimum below the level.

    If so, `found` (n,) is this minimum, a state in m and m/s.
    """
    table = search.table
    before, damping = table.at.copy(), 1e-3
    now = _linearise(search, table)
    noise = rounding_of_residual(search.whole.rows, search.floors[0], table.nodes)
    for _ in range(_STEPS):
        length = _step(table, damping)
        if not length >= 0.0:
            return False
        for m in range(before.shape[0]):
            before[m] = table.at[m]
            table.at[m] -= table.move[m]
        after = _linearise(search, table)
        if after <= now + noise * (2.0 * sqrt(now) + noise):
            now, damping = after, 0.1 * damping
            if length < _CLOSE * _CLOSE + noise * noise:
                table.half[:] = 0.0
                return (
                    now < level
                    and _is_inside(search.axes, table.at, found)
                    and not _is_known(search, table.at, table.half)
                )
        else:
            put(table, before, before)
            damping = max(10.0 * damping, 1e-4)
            _linearise(search, table)
    return False


@compiled
def _linearise(search: Search, table: StateTable) -> float:
    """Return the cost at the centre of the box; write residual and Jacobian per unit of search coordinates."""
    for m in range(table.at.shape[0]):
        table.half[m], table.unit[m] = 0.0, 1.0
    set_box(search.whole, search.axes, table)
    cost = residual_at(search.whole.rows, table.nodes, table.sheet)
    set_lines(search.whole, table)
    return cost


@compiled
def _step(table: StateTable, damping: float) -> float:
    """Write a damped Gauss-Newton step into `table.move`; return its squared length in standard deviations, or -1.

    `damping` is the share by which the diagonal of the normal matrix grows. The result is -1 if the rows do not
    determine a step. The step is subtracted from the coordinates.
    """
    n, matrix, lines = table.at.shape[0], table.solve, table.lines
    for m in range(n):
        table.slope[m] = 0.0
        for i in range(lines.shape[1]):
            table.slope[m] += lines[m, i] * table.sheet.residual[i]
        for other in range(n):
            matrix[m, other] = 0.0
            for i in range(lines.shape[1]):
                matrix[m, other] += lines[m, i] * lines[other, i]
    for m in range(n):
        matrix[m, m] *= 1.0 + damping
    if not invert(matrix, n, 1e-14):
        return -1.0
    length = 0.0
    for m in range(n):
        table.move[m] = 0.0
        for other in range(n):
            table.move[m] += matrix[m, other] * table.slope[other]
        length += table.move[m] * table.slope[m]
    return length


# Known minima.

# First half-width, standard deviations, the factor by which it is reduced, and the number of trials, which reduce it
# to a millionth.
_WIDEST, _SMALLER, _TRIALS = 100.0, 0.8, 62


@compiled
def set_minimum(search: Search, p: int, state: Array, least: float, eps: float) -> bool:
    """Write minimum p, at `state` (n,), and the sides of a convex box around it, into `search`.

    Return False if the state is no minimum or costs less than `least`. In the box the cost is at most `eps` below the
    cost of the minimum.
    """
    axes, table, n = search.axes, search.table, state.shape[0]
    for m in range(n):
        search.minima[p, m] = 0.0
        for i in range(n):
            search.minima[p, m] += axes.back[m, i] * (state[i] - axes.origin[i])
    put(table, search.minima[p], search.minima[p])
    if not _linearise(search, table) >= least:
        return False
    margin = 0.0
    for m in range(n):
        slope = 0.0
        for i in range(table.lines.shape[1]):
            slope += table.lines[m, i] * table.sheet.residual[i]
        margin += slope * slope / eps
    share = _WIDEST
    for _ in range(_TRIALS):
        for m in range(n):
            table.half[m] = table.unit[m] = share
        set_box(search.whole, axes, table)
        residual_at(search.whole.rows, table.nodes, table.sheet)
        set_lines(search.whole, table)
        ball, noise = _curve(search, table)
        blur = noise / share  # rounding of the slope, from which the margin is computed
        if is_convex(table, ball, margin + n * blur * (blur + 2.0 * sqrt(eps * margin)) / eps):
            for m in range(n):
                search.sides[p, m] = share
            return True
        share *= _SMALLER
    return False


# The proof.


@compiled
def prove_course(
    whole: ConstantVelocityCost,
    few: ConstantVelocityCost,
    axes: StateAxes,
    others: Array,
    kappa: float,
    eps: float,
    budget: int,
    found: Array,
) -> tuple[int, int, float]:
    """Prove the claim of `optloc.proof.local_search.prove_locally` for a moving target, within a region.

    Parameters
    ----------
    whole, few : ConstantVelocityCost
        All rows, and the rows of a few epochs.
    axes : StateAxes
        Axes around the fix, with the region.
    others : array (P, n)
        Other known minima.
    kappa, eps : float
        Gap to prove, and the tolerance within which a lower cost counts as equal to the cost of the fix.
    budget : int
        Greatest number of boxes.
    found : array (n,)
        Written: a better or other state.

    Returns
    -------
    verdict, boxes, bound
        As in `optloc.proof.local_search.prove_locally`.
    """
    x, n = axes.origin, axes.origin.shape[0]
    table, small, room = table_of(whole), table_of(few), np.zeros((2, 1 + others.shape[0], n))
    floors = floor_of(whole, x), floor_of(few, x)
    search = Search(whole, few, axes, table, small, floors, room[0], room[1])
    least = _linearise(search, table)
    most, eps = max(COARSEST, eps), equal_within(eps, least, rounding_of_residual(whole.rows, floors[0], table.nodes))
    if not eps <= most:
        return COARSE, 0, -inf
    level = least + kappa if kappa > 0.0 else least - eps
    # The search of states does not read the last three fields.
    aim = Goal(level, least - eps, least - 0.5 * eps, False, 0, 0)
    known, place = zero(), x.copy()
    for p in range(1 + (others.shape[0] if kappa > 0.0 else 0)):
        for m in range(n if p > 0 else 0):
            place[m] = others[p - 1, m]
        known += int(set_minimum(search, known, place, aim.better, 0.5 * eps))
        if known == 0:
            return STATIONARY, 0, -inf
    search = Search(whole, few, axes, table, small, floors, room[0, :known], room[1, :known])
    stack = np.zeros((_CAPACITY, 2 * n))
    _set_first(axes, stack[0, :n], stack[0, n:])
    outcome, boxes = search_courses(search, stack, 1, aim, budget, found)
    if outcome == CLEAR:
        return (UNIQUE if kappa > 0.0 else VALUE), boxes, aim.value
    if outcome == SPENT:
        return BUDGET, boxes, -inf
    return (BETTER if outcome == CHEAPER else OTHER), boxes, -inf


@compiled
def _set_first(axes: StateAxes, at: Array, half: Array) -> None:
    """Write the box in search coordinates that contains the region into `at` and `half` (n,), which must be zero."""
    for m in range(at.shape[0]):
        for i in range(at.shape[0]):
            low, high = axes.corners[0, i], axes.corners[1, i]
            at[m] += axes.back[m, i] * (0.5 * (low + high) - axes.origin[i])
            half[m] += abs(axes.back[m, i]) * 0.5 * (high - low) * (1.0 + 1e-9)
