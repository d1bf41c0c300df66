"""The proof of a target in uniform motion: boxes of positions and velocities, in the plane or in space.

The rows are those of a run; a node of an epoch at time t is bounded over the places ``p + t v`` of all states (p, v) of
a box, which lie in a box of space again. Slopes and Hessians with respect to the state follow by the chain rule, and
are summed over all nodes before a bound is taken. Coordinates are the principal axes of the cost at the fix.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.compute.systems import invert
from optloc.proof.batch import plainly
from optloc.proof.box import bound_nodes
from optloc.proof.chart import accuracy_floor
from optloc.proof.curvature import curve_nodes, entry
from optloc.proof.everywhere import ANOTHER, CHEAPER, CLEAR, SPENT
from optloc.proof.near import BETTER, BUDGET, OTHER, STATIONARY, UNIQUE, VALUE, Aim
from optloc.proof.nodes.node import CHI, CURVE_WIDTH, H00, HIGH, LOW, NODE_WIDTH, PHI, SLOPE0
from optloc.proof.runs.rows import (
    Rows,
    Sheet,
    blur_of,
    digits_of,
    greatest_length,
    multiply,
    norm_of,
    project,
    pull_back,
    residual_at,
    sheet_of,
)

# What is searched.


class Course(NamedTuple):
    """The cost of a run over the state of a target in uniform motion.

    Parameters
    ----------
    kinds, data : int array (J,), array (J, width)
        The nodes, epoch by epoch.
    first : int array (K + 1,)
        Where the nodes of each epoch begin, and the end.
    since : array (K,)
        Seconds of each epoch from the time at which the state holds.
    rows : Rows
        All rows.
    """

    kinds: Array
    data: Array
    first: Array
    since: Array
    rows: Rows


class Axes(NamedTuple):
    """Search coordinates s of states: ``(p, v) = origin + turn s``.

    Parameters
    ----------
    origin : array (n,)
        Position and velocity of the fix, n = 2 d.
    turn, back : array (n, n)
        Their derivative with respect to s, and its inverse.
    corners : array (2, n)
        Lowest and highest state of the region.
    """

    origin: Array
    turn: Array
    back: Array
    corners: Array


class Table(NamedTuple):
    """Working memory for one box of a course.

    Parameters
    ----------
    at, half : array (n,)
        The box.
    unit : array (n,)
        Lengths in which derivatives are taken: half-widths of a box, or one.
    lever : array (K, d, n)
        Derivatives of the places of each epoch with respect to coordinates in these lengths.
    places : array (K, 2, 3)
        Middle and half-widths of the places of each epoch, metres.
    nodes, curves : array (J, NODE_WIDTH), (J, CURVE_WIDTH)
        Tables of all nodes, with derivatives with respect to the place.
    sheet : Sheet
        Of the rows.
    lines, pulls : array (n, q), (n, J)
        Columns of the Jacobian, and what they pull at the nodes.
    slope, along : array (n,)
        The gradient of f/2 at the centre, and the inner products of the Jacobian with a direction.
    hessian, change : array (n, n)
        The Hessian of f/2 at the centre, and by how much its entries change to first order.
    move : array (n,)
        A step.
    solve : array (n, n)
        Working memory.
    """

    at: Array
    half: Array
    unit: Array
    lever: Array
    places: Array
    nodes: Array
    curves: Array
    sheet: Sheet
    lines: Array
    pulls: Array
    slope: Array
    along: Array
    hessian: Array
    change: Array
    move: Array
    solve: Array


# A half-width covers the rounding of centres: relative to itself, and some units in the last place of these.
_WIDER, _SHIFT = 1e-12, 1e-15


@compiled
def table_of(course: Course, n: int) -> Table:
    """Return working memory for boxes of n coordinates."""
    J, K, q, d = course.kinds.shape[0], course.since.shape[0], course.rows.w.shape[0], n // 2
    vectors, matrices = np.zeros((6, n)), np.zeros((3, n, n))
    return Table(
        vectors[0],
        vectors[1],
        vectors[2],
        np.zeros((K, d, n)),
        np.zeros((K, 2, 3)),
        np.zeros((J, NODE_WIDTH)),
        np.zeros((J, CURVE_WIDTH)),
        sheet_of(course.rows),
        np.zeros((n, q)),
        np.zeros((n, J)),
        vectors[3],
        vectors[4],
        matrices[0],
        matrices[1],
        vectors[5],
        matrices[2],
    )


@compiled
def set_box(course: Course, axes: Axes, table: Table, scaled: bool) -> None:
    """Bound all nodes over a box that is set, and take derivatives in its half-widths (`scaled`) or in lengths of 1."""
    n, d, at, half = table.at.shape[0], table.at.shape[0] // 2, table.at, table.half
    plan, line = np.zeros((3, 3)), np.zeros(6)
    for i in range(d):
        plan[i, i] = 1.0
    for m in range(n):
        table.unit[m] = half[m] if scaled else 1.0
    for k in range(course.since.shape[0]):
        time, place, reach = course.since[k], table.places[k, 0], table.places[k, 1]
        for i in range(d):
            place[i], reach[i] = axes.origin[i] + time * axes.origin[d + i], 0.0
            size = abs(axes.origin[i]) + abs(time * axes.origin[d + i])
            for m in range(n):
                lever = axes.turn[i, m] + time * axes.turn[d + i, m]
                place[i] += lever * at[m]
                reach[i] += abs(lever) * half[m]
                size += (abs(axes.turn[i, m]) + abs(time * axes.turn[d + i, m])) * (abs(at[m]) + half[m])
                table.lever[k, i, m] = lever * table.unit[m]
            if reach[i] > 0.0:
                reach[i] += _WIDER * reach[i] + _SHIFT * n * size
        a, b = course.first[k], course.first[k + 1]
        bound_nodes(course.kinds[a:b], course.data[a:b], place, plan, plan, reach, line, table.nodes[a:b])


@compiled
def set_bends(course: Course, table: Table) -> None:
    """Bound second derivatives of all nodes, with respect to the place, over a box whose nodes are bounded."""
    plan, line, second = np.zeros((3, 3)), np.zeros(6), np.zeros((3, 3))
    for i in range(table.lever.shape[1]):
        plan[i, i] = 1.0
    for k in range(course.since.shape[0]):
        a, b, place, reach = course.first[k], course.first[k + 1], table.places[k, 0], table.places[k, 1]
        nodes, curves = table.nodes[a:b], table.curves[a:b]
        curve_nodes(course.kinds[a:b], course.data[a:b], place, plan, plan, reach, line, second, nodes, curves)


@compiled
def set_lines(course: Course, table: Table) -> None:
    """Write the Jacobian of the rows at the centre of a box whose nodes are bounded."""
    values, d = table.sheet.reach, table.lever.shape[1]
    for m in range(table.at.shape[0]):
        for k in range(course.since.shape[0]):
            for j in range(course.first[k], course.first[k + 1]):
                values[j] = 0.0
                for i in range(d):
                    values[j] += table.nodes[j, SLOPE0 + i] * table.lever[k, i, m]
        multiply(course.rows, values, table.lines[m])
        project(course.rows, table.lines[m])


# Bounds of the residual over a box.

# Coordinate descents towards the least-squares point of a box; any point gives a valid bound.
_SWEEPS = 3


@compiled
def _reach(course: Course, table: Table, direction: Array, curved: bool) -> float:
    """Return a lower bound of ``|P e|`` over a box from one direction (q,), rounding apart; see `least_length`."""
    n, d, force = table.at.shape[0], table.lever.shape[1], table.sheet.force
    length, total, rest = 0.0, 0.0, 0.0
    for i in range(direction.shape[0]):
        length += direction[i] * direction[i]
        total += direction[i] * table.sheet.residual[i]
    if not length > 0.0:
        return -1.0
    pull_back(course.rows, direction, force)
    table.along[:], table.solve[:] = 0.0, 0.0
    for k in range(course.since.shape[0]):
        lever, third = table.lever[k], 0.0
        for i in range(d):
            third += table.places[k, 1, i] * table.places[k, 1, i] / 6.0
        for j in range(course.first[k], course.first[k + 1]):
            still = True
            for i in range(d):
                slope = force[j] * table.nodes[j, SLOPE0 + i]
                still = still and table.nodes[j, SLOPE0 + i] == 0.0
                for m in range(n):
                    table.along[m] += slope * lever[i, m]
            enclosed = min(force[j] * table.nodes[j, LOW], force[j] * table.nodes[j, HIGH])
            left = -abs(force[j]) * table.curves[j, CHI] * third if curved and not still else -inf
            if left > enclosed:
                rest += left
                _bend(table.curves[j], lever, force[j], table.solve)
            else:
                rest += enclosed
    for m in range(n):
        rest += 0.5 * min(table.solve[m, m], 0.0)
        for other in range(m):
            rest -= abs(table.solve[m, other])
        rest -= abs(table.along[m])
    return float((total + rest) / sqrt(length))


@compiled
def _bend(curve: Array, lever: Array, factor: float, out: Array) -> None:
    """Add ``factor L'N L`` to the lower triangle of a matrix (n, n), N the Hessian of a node."""
    d, n = lever.shape
    for m in range(n):
        for i in range(d):
            along = 0.0
            for k in range(d):
                along += curve[H00 + entry(i, k)] * lever[k, m]
            for other in range(m, n):
                out[other, m] += factor * along * lever[i, other]


@compiled
def least_length(course: Course, table: Table, cost: float, curved: bool) -> float:
    """Return a lower bound of ``|P e|`` over a box, rounding apart; negative where it says nothing.

    The residual at the centre and the Jacobian are set. Of the directions that are tried the last is the residual
    nearest to zero of the linear part.
    """
    sheet, lines, n = table.sheet, table.lines, table.at.shape[0]
    if not cost > 0.0:
        return -1.0
    s, v = table.move, sheet.length
    s[:] = 0.0
    v[:] = sheet.residual
    for _ in range(_SWEEPS):
        for m in range(n):
            pull = own = 0.0
            for i in range(v.shape[0]):
                pull += lines[m, i] * v[i]
                own += lines[m, i] * lines[m, i]
            if own > 0.0:
                new = min(max(s[m] - pull / own, -1.0), 1.0)
                step = new - s[m]
                for i in range(v.shape[0]):
                    v[i] += step * lines[m, i]
                s[m] = new
    return _reach(course, table, v, curved)


# Second derivatives of f/2 over a box.


@compiled
def sum_up(course: Course, table: Table, noise: float) -> tuple[float, float]:
    """Fill gradient, Hessian and its change of first order; return bounds of the rest's norm and of the gradient's blur.

    As `optloc.proof.runs.rows.sum_up_rows`, in units of the half-widths of the box; nodes, Hessians of nodes, residual
    and Jacobian are set, `noise` is the rounding of a residual.
    """
    rows, sheet, lines, pulls, n = course.rows, table.sheet, table.lines, table.pulls, table.at.shape[0]
    pull_back(rows, sheet.residual, sheet.force)
    longest, widest = 0.0, 0.0
    for value in sheet.residual:
        longest += value * value
    longest = sqrt(longest)
    table.hessian[:] = 0.0
    for m in range(n):
        pull_back(rows, lines[m], pulls[m])
        table.slope[m] = 0.0
        for i in range(lines.shape[1]):
            table.slope[m] += lines[m, i] * sheet.residual[i]
        for other in range(m + 1):
            for i in range(lines.shape[1]):
                table.hessian[m, other] += lines[m, i] * lines[other, i]
        widest = max(widest, table.hessian[m, m])
    blur = _blur_of_lines(course, table)
    _turn(course, table)
    for m in range(n):
        for other in range(m):
            table.hessian[other, m] = table.hessian[m, other]
        for other in range(
            n
        ):  # the rounding of J'J counts as change, twice: for the mean over a line half of it counts
            table.change[m, other] += 4.0 * sqrt(widest) * blur
    ball = _rest(course, table, noise + digits_of(rows) * longest)
    return ball, sqrt(widest) * noise + blur * (longest + noise)


@compiled
def _blur_of_lines(course: Course, table: Table) -> float:
    """Return a bound of the rounding of each column of the Jacobian."""
    most = 0.0
    for m in range(table.at.shape[0]):
        total = 0.0
        for k in range(course.since.shape[0]):
            for j in range(course.first[k], course.first[k + 1]):
                for i in range(table.lever.shape[1]):
                    total += course.rows.weight[j] * abs(table.nodes[j, SLOPE0 + i] * table.lever[k, i, m])
        most = max(most, total)
    return float(digits_of(course.rows) * most)


@compiled
def _turn(course: Course, table: Table) -> None:
    """Add the nodes' part of the Hessian, and write what is linear in s of its change."""
    n, own = table.at.shape[0], table.solve
    third = np.zeros((n, n, n))
    for k in range(course.since.shape[0]):
        for j in range(course.first[k], course.first[k + 1]):
            own[:] = 0.0
            _bend(table.curves[j], table.lever[k], 1.0, own)
            for m in range(n):
                for other in range(m + 1):
                    table.hessian[m, other] += table.sheet.force[j] * own[m, other]
                    for along in range(n):
                        third[along, m, other] += table.pulls[along, j] * own[m, other]
    for a in range(n):
        for b in range(a + 1):
            change = 0.0
            for k in range(n):
                ka, kb = third[b, max(k, a), min(k, a)], third[a, max(k, b), min(k, b)]
                change += abs(third[k, a, b] + ka + kb)
            table.change[a, b] = table.change[b, a] = change


@compiled
def _rest(course: Course, table: Table, blur: float) -> float:
    """Return a bound of the norm of what else changes in the Hessian; see `optloc.proof.runs.rows`."""
    rows, sheet, reach, n = course.rows, table.sheet, table.sheet.reach, table.at.shape[0]
    own = cross = ball = 0.0
    size = sqrt(float(n))
    for k in range(course.since.shape[0]):
        lever = _squared(table.lever[k])
        for j in range(course.first[k], course.first[k + 1]):
            chi, across, along = table.curves[j, CHI] * lever, 0.0, 0.0
            for m in range(n):
                across += table.pulls[m, j] * table.pulls[m, j]
                along += abs(table.pulls[m, j])
            ball += (abs(sheet.force[j]) + along) * chi
            cross += sqrt(across) * chi * size
            own += rows.weight[j] * blur * norm_of(table.curves, j) * lever
            reach[j] = max(-table.nodes[j, LOW], table.nodes[j, HIGH])
    if not ball < inf:
        return inf
    remainder = greatest_length(rows, reach, sheet.length)
    for k in range(course.since.shape[0]):
        for j in range(course.first[k], course.first[k + 1]):
            reach[j] = norm_of(table.curves, j) * _squared(table.lever[k])
    bent = greatest_length(rows, reach, sheet.length)
    for k in range(course.since.shape[0]):
        for j in range(course.first[k], course.first[k + 1]):
            reach[j] = table.curves[j, CHI] * _squared(table.lever[k])
    wide = greatest_length(rows, reach, sheet.length)
    jump = bent * size + 0.5 * wide * size
    return float(ball + cross + 2.0 * own + remainder * (bent + wide) + jump * jump)


@compiled
def _squared(lever: Array) -> float:
    """Return the squared Frobenius norm of a lever (d, n)."""
    total = 0.0
    for i in range(lever.shape[0]):
        for m in range(lever.shape[1]):
            total += lever[i, m] * lever[i, m]
    return total


@compiled
def is_convex(table: Table, ball: float, margin: float) -> bool:
    """Return whether the Hessian of f/2, in lengths of 1, exceeds `margin` all over a box whose sums are filled."""
    if not ball < inf:
        return False
    n, matrix = table.at.shape[0], table.solve
    for m in range(n):
        away = ball + margin * table.unit[m] * table.unit[m]
        for other in range(n):
            matrix[m, other] = table.hessian[m, other]
            away += table.change[m, other]
        matrix[m, m] -= away
    return invert(matrix, n, 1e-12)


@compiled
def has_no_minimum(table: Table, ball: float, noise: float) -> bool:
    """Return whether no minimum of the cost can lie in a box whose sums are filled.

    The gradient does not vanish, or the cost bends downwards along a coordinate.
    """
    n, matrix = table.at.shape[0], table.solve
    if not ball < inf:
        return False
    size = sqrt(float(n))
    for m in range(n):
        change = ball * size
        for other in range(n):
            change += abs(table.hessian[m, other]) + table.change[m, other]
            matrix[m, other] = table.hessian[m, other]
        # slack for the rounding of the sums
        if abs(table.slope[m]) > change * (1.0 + 1e-6) + noise:
            return True
        if table.hessian[m, m] + (table.change[m, m] + ball) * (1.0 + 1e-6) < 0.0:
            return True
    if not invert(matrix, n, 1e-12):
        return False
    # with Y nearly the inverse: s = -Y slope - (Y H - 1) s - Y (change s)
    for k in range(n):
        centre, spread = 0.0, 0.0
        for m in range(n):
            own, turned = abs(matrix[k, m]), -1.0 if k == m else 0.0
            centre -= matrix[k, m] * table.slope[m]
            for other in range(n):
                turned += matrix[k, other] * table.hessian[other, m]
                spread += own * table.change[m, other]
            spread += own * (noise + ball * size) + abs(turned)
        if abs(centre) > 1.0 + spread * (1.0 + 1e-6) + 1e-9 * abs(centre):
            return True
    return False


# The search.

# As of `optloc.proof.runs.search`: where boxes are looked at with all rows, and where minima are excluded by
# derivatives, in levels; boxes on the stack; and looks at few rows for each at all rows.
_WORTH, _NEAR, _CAPACITY, _LOOKS = 4.0, 100.0, 4096, 10
# Share of the steepest side's change that counts for all sides alike.
_ALIKE = 0.1


class Search(NamedTuple):
    """Where is looked, and what is known there.

    Parameters
    ----------
    whole, few : Course
        All rows, and those of few epochs, which cost nowhere more.
    axes : Axes
        The coordinates.
    table, small : Table
        Working memory for all rows, and for few.
    floors : tuple of 2 float
        Sizes of what residuals of all and of few rows are differences of, beside the nodes.
    minima, sides : array (P, n)
        Known minima, and half-widths of boxes around them on which the cost is convex.
    """

    whole: Course
    few: Course
    axes: Axes
    table: Table
    small: Table
    floors: tuple[float, float]
    minima: Array
    sides: Array


@compiled
def search_courses(search: Search, stack: Array, size: int, aim: Aim, budget: int, found: Array) -> tuple[int, int]:
    """Search boxes for minima that cost less than a level; return the outcome and how many boxes were looked at.

    Parameters
    ----------
    search : Search
        Where.
    stack, size : array (capacity, 2 n), int
        The boxes: centres, half-widths.
    aim : Aim
        What is to be shown of each.
    budget : int
        How many boxes may be looked at with all rows, and `_LOOKS` times as many with few.
    found : array (n,)
        Written: the state of the outcomes CHEAPER and ANOTHER.

    Returns
    -------
    outcome, boxes
        CLEAR, CHEAPER (a state costs less than `aim.better`), ANOTHER (a minimum below the level is not known), SPENT.
    """
    axes, table, small, n = search.axes, search.table, search.small, found.shape[0]
    boxes, looks, lows = 0, 0, 0
    while size > 0:
        if boxes >= budget or looks >= _LOOKS * budget or size + 2 > stack.shape[0]:
            return SPENT, looks
        size -= 1
        looks += 1
        small.at[:], small.half[:] = stack[size, :n], stack[size, n:]
        where = _where(axes, small.at, small.half)
        if where < 0 or _is_known(search, small.at, small.half):
            continue
        here, low = _look(search.few, axes, small, search.floors[1], aim.level)
        if low > 0.0 and low * low >= aim.level:
            continue
        if here < _WORTH * (aim.level + 1.0):
            boxes += 1
            table.at[:], table.half[:] = small.at, small.half
            here, low = _look(search.whole, axes, table, search.floors[0], aim.level)
            if low > 0.0 and low * low >= aim.level:
                continue
            inside = _is_inside(axes, table.at, found)
            if inside and here < aim.better:
                return CHEAPER, looks
            # the least cost of a region is at its edge, or where the gradient vanishes
            if here < _NEAR * (aim.level + 1.0) and (where > 0 or (low > 0.0 and low * low >= aim.value)):
                ball, noise = _curve(search, table)
                if has_no_minimum(table, ball, noise):
                    continue
            lows += int(inside and here < aim.level)
            # at the first, second, fourth ... low centre: found early, and seldom looked for in vain
            if inside and here < aim.level and lows & (lows - 1) == 0 and _descends(search, aim.level, found):
                return ANOTHER, looks
        size = _push_halves(stack, size, small, _steepest(small))
    return CLEAR, looks


@compiled
def _look(course: Course, axes: Axes, table: Table, floor: float, level: float) -> tuple[float, float]:
    """Return the cost at the centre of a box that is set and a lower bound of the residual over it."""
    set_box(course, axes, table, True)
    here = residual_at(course.rows, table.nodes, table.sheet)
    noise = blur_of(course.rows, floor, table.nodes)
    set_lines(course, table)
    if here < level:  # no bound will do
        return here, -1.0
    low = least_length(course, table, here, False) - noise
    if low > 0.0 and low * low >= level:
        return here, low
    set_bends(course, table)
    return here, max(low, least_length(course, table, here, True) - noise)


@compiled
def _curve(search: Search, table: Table) -> tuple[float, float]:
    """Fill the sums of a box that was looked at with all rows, see `sum_up`."""
    noise = blur_of(search.whole.rows, search.floors[0], table.nodes)
    set_bends(search.whole, table)
    return sum_up(search.whole, table, noise)


@compiled
def _where(axes: Axes, at: Array, half: Array) -> int:
    """Return -1 where no state of a box is in the region, 1 where all are in its inside, else 0."""
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
def _is_inside(axes: Axes, at: Array, state: Array) -> bool:
    """Write the state of search coordinates; return whether it is in the region."""
    inside = True
    for i in range(at.shape[0]):
        state[i] = axes.origin[i]
        for m in range(at.shape[0]):
            state[i] += axes.turn[i, m] * at[m]
        inside = inside and axes.corners[0, i] <= state[i] <= axes.corners[1, i]
    return inside


@compiled
def _is_known(search: Search, at: Array, half: Array) -> bool:
    """Return whether a box lies where the cost is convex around a known minimum."""
    for p in range(search.minima.shape[0]):
        inside = True
        for m in range(at.shape[0]):
            inside = inside and abs(at[m] - search.minima[p, m]) + half[m] <= search.sides[p, m]
        if inside:
            return True
    return False


@compiled
def _steepest(table: Table) -> int:
    """Return the side of a box that was looked at along which the residual changes most."""
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
def _push_halves(stack: Array, size: int, table: Table, side: int) -> int:
    """Push the halves of a box; return the size of the stack."""
    n = table.at.shape[0]
    for sign in (-0.5, 0.5):
        stack[size, :n], stack[size, n:] = table.at, table.half
        stack[size, side] += sign * table.half[side]
        stack[size, n + side] *= 0.5
        stack[size, n + side] += _WIDER * stack[size, n + side] + _SHIFT * (abs(table.at[side]) + table.half[side])
        size += 1
    return size


# Descents.

# Steps, and the length of one in standard deviations that ends it.
_STEPS, _CLOSE = 40, 1e-3


@compiled
def _descends(search: Search, level: float, found: Array) -> bool:
    """Return whether the centre of a box descends to a minimum below the level that is not known, and write it."""
    table, n = search.table, found.shape[0]
    before, damping = table.at.copy(), 1e-3
    now = _linearise(search, table)
    for _ in range(_STEPS):
        before[:] = table.at
        length = _step(table, damping)
        if not length >= 0.0:
            return False
        table.at[:] -= table.move
        after = _linearise(search, table)
        if after <= now:
            now, damping = after, 0.1 * damping
            if length < _CLOSE * _CLOSE:
                table.half[:] = 0.0
                return (
                    now < level
                    and _is_inside(search.axes, table.at, found)
                    and not _is_known(search, table.at, table.half)
                )
        else:
            table.at[:], damping = before, max(10.0 * damping, 1e-4)
            _linearise(search, table)
    return False


@compiled
def _linearise(search: Search, table: Table) -> float:
    """Return the cost at coordinates that are set, with residual, Jacobian and slope in lengths of 1."""
    table.half[:] = 0.0
    set_box(search.whole, search.axes, table, False)
    cost = residual_at(search.whole.rows, table.nodes, table.sheet)
    set_lines(search.whole, table)
    return cost


@compiled
def _step(table: Table, damping: float) -> float:
    """Write a damped Gauss-Newton step; return its squared length in units of what is left, NaN where there is none."""
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

# Sides are tried smaller by this factor, so often: from the first, standard deviations, to a millionth of it.
_WIDEST, _SMALLER, _TRIALS = 100.0, 0.8, 62


@compiled
def set_minimum(search: Search, p: int, state: Array, least: float, eps: float) -> bool:
    """Write a minimum and the sides of a convex box around it; return False where it is none, or costs less than that.

    Within the box no cost is more than eps below that of the minimum.
    """
    axes, table, n = search.axes, search.table, state.shape[0]
    for m in range(n):
        search.minima[p, m] = 0.0
        for i in range(n):
            search.minima[p, m] += axes.back[m, i] * (state[i] - axes.origin[i])
    table.at[:] = search.minima[p]
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
        table.half[:] = share
        set_box(search.whole, axes, table, True)
        residual_at(search.whole.rows, table.nodes, table.sheet)
        set_lines(search.whole, table)
        ball, _ = _curve(search, table)
        if is_convex(table, ball, margin):
            search.sides[p] = share
            return True
        share *= _SMALLER
    return False


# The proof.


@compiled
def cost_of_state(course: Course, state: Array) -> tuple[float, float]:
    """Return the cost of a state (n,), and the rounding of its residual."""
    table = table_of(course, state.shape[0])
    set_box(course, _own_axes(state), table, False)
    cost = residual_at(course.rows, table.nodes, table.sheet)
    return cost, blur_of(course.rows, _floor(course, state), table.nodes)


@compiled
def hessian_of_state(course: Course, state: Array) -> Array:
    """Return the Hessian (n, n) of f/2 at a state (n,)."""
    table = table_of(course, state.shape[0])
    set_box(course, _own_axes(state), table, False)
    residual_at(course.rows, table.nodes, table.sheet)
    set_lines(course, table)
    set_bends(course, table)
    sum_up(course, table, 0.0)
    return table.hessian


@compiled
def _own_axes(state: Array) -> Axes:
    n = state.shape[0]
    return Axes(state, np.eye(n), np.eye(n), np.zeros((2, n)))


@compiled
def _floor(course: Course, state: Array) -> float:
    """Return the sizes of what residuals are differences of, beside the nodes, over all places of a state."""
    d, last, most = state.shape[0] // 2, 0.0, np.zeros(3)
    for time in course.since:
        last = max(last, abs(time))
    for i in range(d):
        most[i] = abs(state[i]) + last * abs(state[d + i])
    return accuracy_floor(course.kinds, course.data, course.rows.weight, course.rows.w, most)


def axes_of(hessian: Array, state: Array, corners: Array) -> Axes | None:
    """Return the principal axes of the cost at a state (n,), in standard deviations; None where it is no minimum."""
    size = np.sqrt(np.maximum(np.diag(hessian), 0.0))
    if not (np.isfinite(hessian).all() and size.all()):
        return None
    values, vectors = np.linalg.eigh(hessian / size / size[:, None])
    if not values[0] > 0.0:
        return None
    turn = vectors / size[:, None] / np.sqrt(values)
    return Axes(state, plainly(turn), plainly(np.linalg.inv(turn)), corners)


@compiled
def prove_course(
    whole: Course, few: Course, axes: Axes, others: Array, kappa: float, eps: float, budget: int, found: Array
) -> tuple[int, int, float]:
    """Prove of a course what `optloc.proof.near.prove` proves of a cost, within a region.

    Parameters
    ----------
    whole, few : Course
        All rows, and those of few epochs.
    axes : Axes
        Of the fix, with the region.
    others : array (P, n)
        Other known minima.
    kappa, eps : float
        Gap to prove, and how far below the cost of the fix still counts as equal.
    budget : int
        How many boxes may be looked at.
    found : array (n,)
        Written: a better or other state.

    Returns
    -------
    verdict, boxes, bound
        As there.
    """
    x, n = axes.origin, axes.origin.shape[0]
    table, small, room = table_of(whole, n), table_of(few, n), np.zeros((2, 1 + others.shape[0], n))
    floors = _floor(whole, x), _floor(few, x)
    search = Search(whole, few, axes, table, small, floors, room[0], room[1])
    least = _linearise(search, table)
    level = least + kappa if kappa > 0.0 else least - eps
    aim = Aim(level, least - eps, least - 0.5 * eps, False, 0)
    if not set_minimum(search, 0, x, aim.better, 0.5 * eps):
        return STATIONARY, 0, -inf
    known = 1
    for p in range(others.shape[0] if kappa > 0.0 else 0):
        known += int(set_minimum(search, known, others[p], aim.better, 0.5 * eps))
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
def _set_first(axes: Axes, at: Array, half: Array) -> None:
    """Write the box that holds a region."""
    for m in range(at.shape[0]):
        for i in range(at.shape[0]):
            low, high = axes.corners[0, i], axes.corners[1, i]
            at[m] += axes.back[m, i] * (0.5 * (low + high) - axes.origin[i])
            half[m] += abs(axes.back[m, i]) * 0.5 * (high - low) * (1.0 + 1e-9)
