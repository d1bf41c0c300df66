"""A target in uniform motion: bounds of a cost over boxes of positions and velocities.

A *state* is position and velocity (4 numbers, m and m/s). The rows are the rows of a run. For a box of states, the
target's positions at the time t of an epoch are in a box of space. The nodes of this epoch (ranges, for instance) are
bounded over this box. In the plane these positions are ``p + t v``; over ground, see `optloc.proof.runs.ground`. Slopes
and Hessians with respect to the state follow by the chain rule, and are summed over all nodes before they are bounded.
Search coordinates are the principal axes of the cost at the fix. Letters: J nodes, K epochs, q rows, n = 4 numbers of a
state, d = 2 or 3 coordinates of a position. A *lever* is the derivative of a position with respect to the state.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled
from optloc.models.primitives import WGS84_A
from optloc.proof.box import bound_nodes
from optloc.proof.curvature import curve_nodes, symmetric_entry
from optloc.proof.nodes.node import CHI, CURVE_WIDTH, H00, HIGH, LOW, NODE_WIDTH, SLOPE0, TURN0, triple_at, write_triple
from optloc.proof.runs.ground import (
    FIRST_ORDER,
    SECOND_ORDER,
    Ground,
    curvature_bounds,
    errors_of,
    over_ground,
    place_over_ground,
    set_reached,
    set_second,
    set_starts,
    slope_of,
)
from optloc.proof.runs.rows import (
    RunRows,
    RunWorkspace,
    norm_of,
    residual_at,
    rounding_of_residual,
    share_within,
    workspace_of,
)
from optloc.proof.search_space import accuracy_floor

# Data of the search.


class ConstantVelocityCost(NamedTuple):
    """The cost of a run over the state of a target in uniform motion.

    Parameters
    ----------
    kinds, data : int array (J,), array (J, width)
        The nodes, epoch by epoch.
    first : int array (K + 1,)
        Index of the first node of each epoch, and the end.
    since : array (K,)
        Time of each epoch after the time of the state, seconds.
    rows : RunRows
        All rows.
    ground : Ground
        The surface on which the target moves; `optloc.proof.runs.ground.STRAIGHT` in the plane.
    """

    kinds: Array
    data: Array
    first: Array
    since: Array
    rows: RunRows
    ground: Ground


class StateAxes(NamedTuple):
    """Search coordinates s of states: ``(p, v) = origin + turn s``.

    Parameters
    ----------
    origin : array (n,)
        Position and velocity of the fix, n = 4, metres and m/s.
    turn, back : array (n, n)
        Derivative of the state with respect to s, and its inverse.
    corners : array (2, n)
        Lowest and highest state of the region.
    """

    origin: Array
    turn: Array
    back: Array
    corners: Array


class StateTable(NamedTuple):
    """Working memory for one box of states.

    Parameters
    ----------
    at, half : array (n,)
        Centre and half-widths of the box, search coordinates.
    unit : array (n,)
        Units of derivatives: half-widths of a box, or one.
    lever : array (K, d, n)
        Derivatives of the position at each epoch with respect to coordinates in these units.
    places : array (K, 2, 3)
        Middle and half-widths of the box of positions at each epoch, metres.
    sizes : array (K, 2)
        Squared lengths of the state's change in the position at each epoch, metres^2: the greatest over the box, and a
        bound for a step of length one.
    starts, reached, second : array (SECOND_ORDER, 6), (K, SECOND_ORDER, 3), (3, 4, 4)
        Over ground: see `optloc.proof.runs.ground`.
    limits : array (3,)
        Bounds of the first three derivatives of positions over ground.
    nodes, curves : array (J, NODE_WIDTH), (J, CURVE_WIDTH)
        Tables of all nodes, with derivatives with respect to the position.
    bends : array (J, n, n)
        Lower triangles of the Hessians of all nodes with respect to coordinates, at the centre.
    rests : array (J, 3)
        Bounds of three numbers of each node: its third-order remainder, the norm of its Hessian's change over the box,
        and the norm of its Hessian.
    sheet : RunWorkspace
        Working memory of the rows.
    lines, pulls : array (n, q), (n, J)
        Columns of the Jacobian, and their products with the columns of the rows.
    slope, along : array (n,)
        The gradient of f/2 at the centre, and the inner products of the Jacobian with a direction.
    hessian, change : array (n, n)
        The Hessian of f/2 at the centre, and bounds of the first-order change of its entries.
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
    sizes: Array
    starts: Array
    reached: Array
    second: Array
    limits: Array
    nodes: Array
    curves: Array
    bends: Array
    rests: Array
    sheet: RunWorkspace
    lines: Array
    pulls: Array
    slope: Array
    along: Array
    hessian: Array
    change: Array
    move: Array
    solve: Array


# Numbers of a state: position and velocity, along two axes each.
STATE = 4
# Each half-width grows by the rounding of centres: a share of the half-width, and a few units in the last place.
WIDER, SHIFT = 1e-12, 1e-15


@compiled
def table_of(course: ConstantVelocityCost) -> StateTable:
    """Return working memory for boxes of states of a cost, filled with zeros."""
    J, K, q, n = course.kinds.shape[0], course.since.shape[0], course.rows.w.shape[0], STATE
    over = over_ground(course.ground)
    vectors, matrices = np.zeros((6, n)), np.zeros((3, n, n))
    return StateTable(
        vectors[0],
        vectors[1],
        vectors[2],
        np.zeros((K, 3 if over else 2, n)),
        np.zeros((K, 2, 3)),
        np.zeros((K, 2)),
        np.zeros((SECOND_ORDER, 6)),
        np.zeros((K if over else 0, SECOND_ORDER, 3)),
        np.zeros((3, n, n)),
        np.zeros(3),
        np.zeros((J, NODE_WIDTH)),
        np.zeros((J, CURVE_WIDTH)),
        np.zeros((J, n, n)),
        np.zeros((J, 3)),
        workspace_of(course.rows),
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
def put(table: StateTable, at: Array, half: Array) -> None:
    """Set the centre `at` and the half-widths `half` (n,) of a box; the half-widths are the units of derivatives."""
    for m in range(at.shape[0]):
        table.at[m], table.half[m], table.unit[m] = at[m], half[m], half[m]


@compiled
def set_box(course: ConstantVelocityCost, axes: StateAxes, table: StateTable) -> None:
    """Bound all nodes over a box that is set by `put`, and write the derivatives of positions in its units."""
    if over_ground(course.ground):
        _carry(course, axes, table)
    else:
        _shift(course, axes, table)
    _bound(course, table)
    if over_ground(course.ground):
        _fold(course, table)


@compiled
def _bound(course: ConstantVelocityCost, table: StateTable) -> None:
    """Bound all nodes over the boxes of positions at their epochs (`table.places`)."""
    plan, line = np.zeros((3, 3)), np.zeros(6)
    for i in range(table.lever.shape[1]):
        plan[i, i] = 1.0
    for k in range(course.since.shape[0]):
        a, b, place, reach = course.first[k], course.first[k + 1], table.places[k, 0], table.places[k, 1]
        bound_nodes(course.kinds[a:b], course.data[a:b], place, plan, plan, reach, line, table.nodes[a:b])


@compiled
def _shift(course: ConstantVelocityCost, axes: StateAxes, table: StateTable) -> None:
    """Write the boxes of positions at all epochs, and their derivatives, for a target that moves in the plane."""
    at, half = table.at, table.half
    for k in range(course.since.shape[0]):
        time, place, reach = course.since[k], table.places[k, 0], table.places[k, 1]
        table.sizes[k] = 0.0
        for i in range(2):
            place[i], reach[i] = axes.origin[i] + time * axes.origin[2 + i], 0.0
            size = abs(axes.origin[i]) + abs(time * axes.origin[2 + i])
            for m in range(STATE):
                lever = axes.turn[i, m] + time * axes.turn[2 + i, m]
                place[i] += lever * at[m]
                reach[i] += abs(lever) * half[m]
                size += (abs(axes.turn[i, m]) + abs(time * axes.turn[2 + i, m])) * (abs(at[m]) + half[m])
                table.lever[k, i, m] = lever * table.unit[m]
                table.sizes[k, 1] += table.lever[k, i, m] ** 2
            if reach[i] > 0.0:
                reach[i] += WIDER * reach[i] + SHIFT * STATE * size
            table.sizes[k, 0] += reach[i] * reach[i]


@compiled
def _carry(course: ConstantVelocityCost, axes: StateAxes, table: StateTable) -> None:
    """Write positions and their derivatives for a target that moves over ground, and bounds of the derivatives.

    The boxes of positions include the nonlinear part of the motion and the errors of finite differences.
    """
    ground, state, half = course.ground, np.zeros(STATE), np.zeros(STATE)
    for i in range(STATE):
        state[i] = axes.origin[i]
        size = abs(axes.origin[i])
        for m in range(STATE):
            state[i] += axes.turn[i, m] * table.at[m]
            half[i] += abs(axes.turn[i, m]) * table.half[m]
            size += abs(axes.turn[i, m]) * (abs(table.at[m]) + table.half[m])
        if half[i] > 0.0:
            half[i] += WIDER * half[i] + SHIFT * STATE * size
    _, table.limits[0], table.limits[1], table.limits[2] = curvature_bounds(ground, state, half)
    blur, _ = errors_of(table.limits[2])
    set_starts(ground, state, 0, FIRST_ORDER, table.starts)
    for k in range(course.since.shape[0]):
        time, reached, sizes = course.since[k], table.reached[k], table.sizes[k]
        set_reached(ground, state, time, ground.rise[k], table.starts, 0, FIRST_ORDER, reached)
        sizes[:] = 0.0
        for i in range(STATE):
            share = 1.0 if i < 2 else time * time
            sizes[0] += share * half[i] * half[i]
            for m in range(STATE):
                sizes[1] += share * (axes.turn[i, m] * table.unit[m]) ** 2
        rest = _rest_of_places(table, k, blur)
        for i in range(3):
            reach = 0.0
            for m in range(STATE):
                lever = 0.0
                for a in range(STATE):
                    lever += (1.0 if a < 2 else time) * slope_of(reached, i, a) * axes.turn[a, m]
                table.lever[k, i, m] = lever * table.unit[m]
                reach += abs(lever) * table.half[m]
            table.places[k, 0, i] = reached[0, i]
            table.places[k, 1, i] = reach * (1.0 + WIDER) + rest if reach > 0.0 else 0.0


@compiled
def _rest_of_places(table: StateTable, k: int, blur: float) -> float:
    """Return the greatest distance of positions over ground at epoch k from their linear form, metres.

    `blur` bounds the error of the slopes of positions.
    """
    return float(0.5 * table.limits[1] * table.sizes[k, 0] + blur * sqrt(table.sizes[k, 0]))


# A remainder without a bound: finite, so that no product with it is NaN.
_ANY = 1e300


@compiled
def _fold(course: ConstantVelocityCost, table: StateTable) -> None:
    """Add the nonlinear part of positions over ground to the bounds of nodes.

    Without bounds of the derivatives of positions, the remainders become practically infinite.
    """
    blur, _ = errors_of(table.limits[2])
    for k in range(course.since.shape[0]):
        rest = _rest_of_places(table, k, blur)
        for j in range(course.first[k], course.first[k + 1]):
            slope = 0.0
            for i in range(3):
                slope += table.nodes[j, SLOPE0 + i] ** 2
            off = sqrt(slope) * rest if table.limits[2] < inf else _ANY
            table.nodes[j, LOW] -= off
            table.nodes[j, HIGH] += off


@compiled
def set_bends(course: ConstantVelocityCost, axes: StateAxes, table: StateTable) -> None:
    """Bound second derivatives of all nodes over a box whose nodes are bounded: `table.bends` and `table.rests`."""
    plan, line, second, d = np.zeros((3, 3)), np.zeros(6), np.zeros((3, 3)), table.lever.shape[1]
    for i in range(d):
        plan[i, i] = 1.0
    if d == 3:
        _carry_beside(course, axes, table)
    table.bends[:] = 0.0
    for k in range(course.since.shape[0]):
        a, b, place, reach = course.first[k], course.first[k + 1], table.places[k, 0], table.places[k, 1]
        nodes, curves = table.nodes[a:b], table.curves[a:b]
        curve_nodes(course.kinds[a:b], course.data[a:b], place, plan, plan, reach, line, second, nodes, curves)
        for j in range(a, b):
            _pull_back(table.curves[j], table.lever[k], table.bends[j])
            change, size, off = table.curves[j, CHI], norm_of(table.curves, j), 0.0
            if d == 3:
                change, size, off = _bends_over(table, k, j, change, size)
            table.rests[j, 0] = change * table.sizes[k, 0] / 6.0 + off
            table.rests[j, 1], table.rests[j, 2] = change * table.sizes[k, 1], size * table.sizes[k, 1]
        if d == 3:
            _bend_over(course, axes, table, k)


@compiled
def _pull_back(curve: Array, lever: Array, out: Array) -> None:
    """Add ``L'N L`` to the lower triangle of a matrix (n, n): the Hessian of a node with respect to the state.

    N, in `curve`, is its Hessian with respect to the position, and L (d, n) the lever.
    """
    d, n = lever.shape
    for m in range(n):
        for i in range(d):
            along = 0.0
            for k in range(d):
                along += curve[H00 + symmetric_entry(i, k)] * lever[k, m]
            for other in range(m, n):
                out[other, m] += along * lever[i, other]


@compiled
def _carry_beside(course: ConstantVelocityCost, axes: StateAxes, table: StateTable) -> None:
    """Write the positions over ground around the centre, from which second derivatives are computed as differences."""
    state = np.zeros(STATE)
    for i in range(STATE):
        state[i] = axes.origin[i]
        for m in range(STATE):
            state[i] += axes.turn[i, m] * table.at[m]
    set_starts(course.ground, state, FIRST_ORDER, SECOND_ORDER, table.starts)
    for k in range(course.since.shape[0]):
        time, rise = course.since[k], course.ground.rise[k]
        set_reached(course.ground, state, time, rise, table.starts, FIRST_ORDER, SECOND_ORDER, table.reached[k])


@compiled
def _bends_over(table: StateTable, k: int, j: int, chi: float, size: float) -> tuple[float, float, float]:
    """Return bounds for node j of epoch k: change and norm of its Hessian, and the error of its slope times the reach.

    `chi` and `size` are change and norm of the Hessian with respect to the position. States are in metres. With g slope
    and N Hessian of the node with respect to the position F, the Hessian is ``F''(g) + F'(N, F')``. The error of
    differences does not shrink with the box, and counts three times: a third-order remainder is a sixth of a change
    that shrinks with the box, but half of a change that does not.
    """
    b1, b2, b3 = table.limits[0], table.limits[1], table.limits[2]
    first, second = errors_of(b3)
    reach, slope, turn = sqrt(table.sizes[k, 0]), 0.0, 0.0
    for i in range(3):
        slope += table.nodes[j, SLOPE0 + i] ** 2
        turn += table.curves[j, TURN0 + i] ** 2
    slope, turn = sqrt(slope), sqrt(turn)
    change = b1 * b1 * chi + 2.0 * size * b1 * b2 * reach + turn * b2 + slope * b3 * reach
    change += 3.0 * (2.0 * size * b1 * first + slope * second)
    return change, b1 * b1 * size + slope * b2, slope * first * reach


@compiled
def _bend_over(course: ConstantVelocityCost, axes: StateAxes, table: StateTable, k: int) -> None:
    """Add the second derivatives of the position over ground at epoch k to the Hessians of its nodes."""
    time, n = course.since[k], STATE
    scaled, own = np.zeros((n, n)), np.zeros((n, n))
    for i in range(3):
        set_second(table.reached[k], i, own)
        for a in range(n):
            for b in range(n):
                own[a, b] *= (1.0 if a < 2 else time) * (1.0 if b < 2 else time)
        for a in range(n):
            for m in range(n):
                scaled[a, m] = 0.0
                for b in range(n):
                    scaled[a, m] += own[a, b] * axes.turn[b, m] * table.unit[m]
        for m in range(n):
            for other in range(m + 1):
                table.second[i, m, other] = 0.0
                for a in range(n):
                    table.second[i, m, other] += axes.turn[a, m] * table.unit[m] * scaled[a, other]
    for j in range(course.first[k], course.first[k + 1]):
        for i in range(3):
            for m in range(n):
                for other in range(m + 1):
                    table.bends[j, m, other] += table.nodes[j, SLOPE0 + i] * table.second[i, m, other]


# Single states.


@compiled
def cost_of_state(course: ConstantVelocityCost, state: Array) -> tuple[float, float]:
    """Return the cost of a position and velocity (2 d,), m and m/s, and the rounding of its residual.

    The state may be at any height.
    """
    table, d = table_of(course), state.shape[0] // 2
    for k in range(course.since.shape[0]):
        for i in range(d):
            table.places[k, 0, i] = state[i] + course.since[k] * state[d + i]
        if d == 3:
            time = course.since[k]
            way = (time * state[3], time * state[4], time * state[5])
            write_triple(
                place_over_ground(course.ground, triple_at(state, 0), way, course.ground.rise[k]), table.places[k, 0]
            )
    _bound(course, table)
    cost = residual_at(course.rows, table.nodes, table.sheet)
    return cost, rounding_of_residual(course.rows, floor_of(course, state), table.nodes)


@compiled
def floor_of(course: ConstantVelocityCost, state: Array) -> float:
    """Return the sizes of measurements and coordinates in residuals, without nodes, over all positions of a state.

    The result limits the accuracy of residuals, see `optloc.proof.search_space.accuracy_floor`.
    """
    d, last, most = state.shape[0] // 2, 0.0, np.zeros(3)
    for time in course.since:
        last = max(last, abs(time))
    for i in range(d):
        most[i] = abs(state[i]) + last * abs(state[d + i])
    if over_ground(course.ground):
        most[:] = WGS84_A + abs(course.ground.level)  # positions are computed from the Earth's centre
    # Sums over nodes and rows do not round coordinates, so coordinates count with a share of the rounding.
    share = share_within(course.rows)
    return accuracy_floor(course.kinds, course.data, course.rows.weight, course.rows.w, most, share)
