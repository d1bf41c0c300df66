"""Bounds of the residual of a moving target, and of its second derivatives, over boxes of states.

A state is position and velocity (n = 4 numbers). The cost is ``f = |P e|^2`` with residual e (q,) and the projection P
that removes other unknowns (`optloc.proof.runs.rows`). Derivatives are with respect to search coordinates in the units
`table.unit`: the half-widths of a box, so that the box is ``|s_m| <= 1``, or 1 at a point. The working memory `table`
is described in `optloc.proof.runs.states.StateTable`.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, put
from optloc.kernels.systems import invert
from optloc.proof.batch import plainly
from optloc.proof.nodes.node import HIGH, LOW, SLOPE0
from optloc.proof.runs.ground import errors_of
from optloc.proof.runs.rows import (
    greatest_length,
    multiply,
    multiply_transposed,
    project_out_unknowns,
    relative_rounding_of,
    residual_at,
)
from optloc.proof.runs.states import STATE, ConstantVelocityCost, StateAxes, StateTable, set_bends, set_box, table_of

# Rows over a box.


@compiled
def set_lines(course: ConstantVelocityCost, table: StateTable) -> None:
    """Write the Jacobian ``P S Phi`` (n, q) at the centre of a box whose nodes are bounded into `table.lines`."""
    values, d = table.sheet.reach, table.lever.shape[1]
    for m in range(table.at.shape[0]):
        for k in range(course.since.shape[0]):
            for j in range(course.first[k], course.first[k + 1]):
                values[j] = 0.0
                for i in range(d):
                    values[j] += table.nodes[j, SLOPE0 + i] * table.lever[k, i, m]
        multiply(course.rows, values, table.lines[m])
        project_out_unknowns(course.rows, table.lines[m])


# Bounds of the residual over a box.

# Coordinate descents towards the least-squares point of a box; any point gives a valid bound.
_SWEEPS = 3


@compiled
def _reach(course: ConstantVelocityCost, table: StateTable, direction: Array, curved: bool) -> float:
    """Return a lower bound of ``|P e|`` over a box from a direction (q,), without rounding; see `least_length`.

    If `curved`, second derivatives are available (`set_bends`). Each node counts with them and a third-order remainder,
    or with the interval of its remainder, whichever is better.
    """
    n, d, force = table.at.shape[0], table.lever.shape[1], table.sheet.force
    length, total, rest = 0.0, 0.0, 0.0
    for i in range(direction.shape[0]):
        length += direction[i] * direction[i]
        total += direction[i] * table.sheet.residual[i]
    if not length > 0.0:
        return -1.0
    multiply_transposed(course.rows, direction, force)
    table.along[:], table.solve[:] = 0.0, 0.0
    for k in range(course.since.shape[0]):
        lever = table.lever[k]
        for j in range(course.first[k], course.first[k + 1]):
            still = True
            for i in range(d):
                slope = force[j] * table.nodes[j, SLOPE0 + i]
                still = still and table.nodes[j, SLOPE0 + i] == 0.0
                for m in range(n):
                    table.along[m] += slope * lever[i, m]
            enclosed = min(force[j] * table.nodes[j, LOW], force[j] * table.nodes[j, HIGH])
            left = -abs(force[j]) * table.rests[j, 0] if curved and not still else -inf
            if left > enclosed:
                rest += left
                for m in range(n):
                    for other in range(m + 1):
                        table.solve[m, other] += force[j] * table.bends[j, m, other]
            else:
                rest += enclosed
    for m in range(n):
        rest += 0.5 * min(table.solve[m, m], 0.0)
        for other in range(m):
            rest -= abs(table.solve[m, other])
        rest -= abs(table.along[m])
    return float((total + rest) / sqrt(length))


@compiled
def least_length(course: ConstantVelocityCost, table: StateTable, cost: float, curved: bool) -> float:
    """Return a lower bound of ``|P e|`` over a box, without rounding; a negative result means that no bound is known.

    `cost` is the cost at the centre, and `curved` as in `_reach`. The residual at the centre and the Jacobian must be
    set. The direction of the bound is the shortest residual of the linear part.
    """
    sheet, lines, n = table.sheet, table.lines, table.at.shape[0]
    if not cost > 0.0:
        return -1.0
    s, v = table.move, sheet.length
    for m in range(n):
        s[m] = 0.0
    for i in range(v.shape[0]):
        v[i] = sheet.residual[i]
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
def sum_up(course: ConstantVelocityCost, table: StateTable, noise: float) -> tuple[float, float]:
    """Write gradient, Hessian and its first-order change; return bounds of the rest and of the gradient's rounding.

    The method is `optloc.proof.runs.rows.sum_up_rows`, in the units `table.unit`. Nodes, Hessians of nodes, residual
    and Jacobian must be set; `noise` bounds the rounding of a residual.
    """
    rows, sheet, lines, pulls, n = course.rows, table.sheet, table.lines, table.pulls, table.at.shape[0]
    multiply_transposed(rows, sheet.residual, sheet.force)
    longest, widest = 0.0, 0.0
    for value in sheet.residual:
        longest += value * value
    longest = sqrt(longest)
    table.hessian[:] = 0.0
    for m in range(n):
        multiply_transposed(rows, lines[m], pulls[m])
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
        for other in range(n):  # the rounding of J'J, doubled as in `sum_up_rows`
            table.change[m, other] += 4.0 * sqrt(widest) * blur
    ball = _rest(course, table, noise + relative_rounding_of(rows) * longest)
    return ball, sqrt(widest) * noise + blur * (longest + noise)


@compiled
def _blur_of_lines(course: ConstantVelocityCost, table: StateTable) -> float:
    """Return a bound of the rounding of each column of the Jacobian, as a length."""
    most, missed = 0.0, _missed(course, table)
    for m in range(table.at.shape[0]):
        total = 0.0
        for k in range(course.since.shape[0]):
            for j in range(course.first[k], course.first[k + 1]):
                for i in range(table.lever.shape[1]):
                    total += course.rows.weight[j] * abs(table.nodes[j, SLOPE0 + i] * table.lever[k, i, m])
        most = max(most, total)
    return float(relative_rounding_of(course.rows) * most + missed)


@compiled
def _missed(course: ConstantVelocityCost, table: StateTable) -> float:
    """Return a bound of the error of finite differences in each column of the Jacobian; 0 for motion in the plane."""
    total = 0.0
    if table.lever.shape[1] == 3:
        first, _ = errors_of(table.limits[2])
        for k in range(course.since.shape[0]):
            for j in range(course.first[k], course.first[k + 1]):
                slope = 0.0
                for i in range(3):
                    slope += table.nodes[j, SLOPE0 + i] ** 2
                total += course.rows.weight[j] * sqrt(slope * table.sizes[k, 1]) * first
    return float(total)


@compiled
def _turn(course: ConstantVelocityCost, table: StateTable) -> None:
    """Add the nodes' part to `table.hessian`, and write the linear part of its change to `table.change`."""
    n = table.at.shape[0]
    third = np.zeros((n, n, n))
    for j in range(course.kinds.shape[0]):
        own = table.bends[j]
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
def _rest(course: ConstantVelocityCost, table: StateTable, blur: float) -> float:
    """Return a bound of the norm of the rest of the Hessian's change; see `optloc.proof.runs.rows.sum_up_rows`.

    `blur` bounds the rounding of a force per weight of its node.
    """
    rows, sheet, reach, n = course.rows, table.sheet, table.sheet.reach, table.at.shape[0]
    own = cross = ball = 0.0
    size = sqrt(float(n))
    for j in range(course.kinds.shape[0]):
        change, across, along = table.rests[j, 1], 0.0, 0.0
        for m in range(n):
            across += table.pulls[m, j] * table.pulls[m, j]
            along += abs(table.pulls[m, j])
        ball += (abs(sheet.force[j]) + along) * change
        cross += sqrt(across) * change * size
        own += rows.weight[j] * blur * table.rests[j, 2]
        reach[j] = max(-table.nodes[j, LOW], table.nodes[j, HIGH])
    if not ball < inf:
        return inf
    remainder = greatest_length(rows, reach, sheet.length)
    put(table.rests[:, 2], reach)
    bent = greatest_length(rows, reach, sheet.length)
    put(table.rests[:, 1], reach)
    wide = greatest_length(rows, reach, sheet.length)
    jump = bent * size + 0.5 * wide * size
    return float(ball + cross + 2.0 * own + remainder * (bent + wide) + jump * jump)


@compiled
def is_convex(table: StateTable, ball: float, margin: float) -> bool:
    """Return whether the Hessian of f/2 exceeds `margin` times the identity over a whole box, in search coordinates.

    `sum_up` must have run; `ball` is its first result. Its Hessian is in units of the half-widths, so the margin is
    multiplied by their squares. Bounds of the change are subtracted from the diagonal (Gershgorin).
    """
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
def has_no_minimum(table: StateTable, ball: float, noise: float) -> bool:
    """Return whether a box whose sums are filled contains no minimum of the cost.

    `ball` and `noise` are the results of `sum_up`. The box has no minimum if the gradient does not vanish, or if the
    cost has negative curvature along a coordinate.
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


# Second derivatives at a state.


@compiled
def hessian_of_state(course: ConstantVelocityCost, state: Array) -> Array:
    """Return the Hessian (4, 4) of f/2 at a state (4,), with respect to position (m) and velocity (m/s)."""
    table = table_of(course)
    table.unit[:] = 1.0
    axes = StateAxes(state, np.eye(STATE), np.eye(STATE), np.zeros((2, STATE)))
    set_box(course, axes, table)
    residual_at(course.rows, table.nodes, table.sheet)
    set_lines(course, table)
    set_bends(course, axes, table)
    sum_up(course, table, 0.0)
    return table.hessian


def axes_of(hessian: Array, state: Array, corners: Array) -> StateAxes | None:
    """Return the principal axes of the cost at a state (n,), in standard deviations; None if it is no minimum.

    `hessian` (n, n) is the Hessian of f/2 at the state, and `corners` (2, n) is the region.
    """
    size = np.sqrt(np.maximum(np.diag(hessian), 0.0))
    if not (np.isfinite(hessian).all() and size.all()):
        return None
    values, vectors = np.linalg.eigh(hessian / size / size[:, None])
    if not values[0] > 0.0:
        return None
    turn = vectors / size[:, None] / np.sqrt(values)
    return StateAxes(state, plainly(turn), plainly(np.linalg.inv(turn)), corners)
