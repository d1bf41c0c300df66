"""What a proof works on: the cost, search coordinates around a fix, and tables for one box."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled, inlined
from optloc.proof.box import NODE_WIDTH, ROW_WIDTH, bound_nodes, cost_at
from optloc.proof.convex import CURVE_WIDTH, SUMS, convex, curve_nodes, sum_up
from optloc.proof.groups import Groups, empty_groups, set_groups
from optloc.proof.nodes.codes import LINEAR, RANGE
from optloc.proof.nodes.linear3 import roughly_principal


class Cost(NamedTuple):
    """The cost ``f(x) = |K phi(x) - w|^2``.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes.
    K, w : array (q, J), (q,)
        Whitened rows.
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


class Chart(NamedTuple):
    """Search coordinates s with ``x = origin + sense s``: principal axes of the fix, one unit a standard deviation.

    Parameters
    ----------
    origin : array (3,)
        The fix.
    sense, back, gram : array (3, 3)
        T, its inverse, and T'T; rows and columns of zeros for the third coordinate in the plane.
    """

    origin: Array
    sense: Array
    back: Array
    gram: Array


class Box(NamedTuple):
    """A box and its tables.

    Parameters
    ----------
    at, half : array (3,)
        Centre and half-widths, search coordinates.
    centre : array (3,)
        Centre, metres.
    line : array (6,)
        Working memory.
    nodes, rows, curves, sums : array (J, NODE_WIDTH), (q, ROW_WIDTH), (J, CURVE_WIDTH), (SUMS,)
        Tables, see `optloc.proof.box` and `optloc.proof.convex`.
    solve : array (3, 3)
        Working memory.
    cut : array (6,)
        Ends of the part of the box that is left, about its centre.
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


@compiled
def cost_of(kinds: Array, data: Array, K: Array, w: Array) -> Cost:
    """Return the cost of nodes and whitened rows."""
    A, weight, groups = np.empty((K.shape[1], K.shape[1])), np.empty(K.shape[1]), empty_groups(K.shape[1])
    set_geometry(kinds, K, A, weight, groups)
    return Cost(kinds, data, K, w, A, weight, groups)


@compiled
def set_geometry(kinds: Array, K: Array, A: Array, weight: Array, groups: Groups) -> None:
    """Write what a cost takes from its rows alone: `A`, `weight` and `groups` of `Cost`."""
    for j in range(K.shape[1]):
        for m in range(j, K.shape[1]):
            total = 0.0
            for i in range(K.shape[0]):
                total += K[i, j] * K[i, m]
            A[j, m] = A[m, j] = total
        weight[j] = sqrt(A[j, j])
    set_groups(kinds, A, groups)


@compiled
def empty_box(q: int, J: int) -> Box:
    """Return tables for boxes of J nodes and q rows."""
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
    )


@compiled
def chart_at(cost: Cost, x: Array, box: Box) -> tuple[Chart, bool]:
    """Return the search coordinates around a fix x (D,), and whether the rows determine them.

    The tables of the box are those of the fix afterwards: values of the nodes, forces (`CURVE_WIDTH`), and sums, whose
    gradient is that along the search coordinates.
    """
    D = x.shape[0]
    origin, numbers = np.zeros(3), np.zeros((3, 3, 3))
    sense, back, gram = numbers[0], numbers[1], numbers[2]
    nodes, curves, sums, information = box.nodes, box.curves, box.sums, box.solve
    for k in range(D):
        origin[k] = x[k]
        sense[k, k] = gram[k, k] = 1.0
    box.half[:] = 0.0
    bound_nodes(cost.kinds, cost.data, origin, sense, gram, box.half, box.line, nodes)
    curves[:] = 0.0
    sum_up(cost.K, cost.w, nodes, curves, sums)
    information[0, 0], information[1, 1], information[2, 2] = sums[0], sums[3], sums[5]
    information[0, 1] = information[1, 0] = sums[1]
    information[0, 2] = information[2, 0] = sums[2]
    information[1, 2] = information[2, 1] = sums[4]
    roughly_principal(information, gram)
    most = max(information[0, 0], information[1, 1], information[2, 2])
    good = True
    for k in range(D):
        length = information[k, k]
        good = good and length > 1e-13 * most
        root = sqrt(length) if length > 0.0 else 1.0
        for m in range(3):
            sense[m, k], back[k, m] = gram[m, k] / root, gram[m, k] * root
    for k in range(3):
        for m in range(3):
            gram[k, m] = sense[0, k] * sense[0, m] + sense[1, k] * sense[1, m] + sense[2, k] * sense[2, m]
    g0, g1, g2 = sums[6], sums[7], sums[8]
    for k in range(3):
        sums[6 + k] = sense[0, k] * g0 + sense[1, k] * g1 + sense[2, k] * g2
    return Chart(origin, sense, back, gram), good


@compiled
def accuracy_floor(cost: Cost, chart: Chart) -> float:
    """Return the sizes of what residuals are differences of, beside the nodes: measurements and coordinates."""
    total = 0.0
    for i in range(cost.w.shape[0]):
        total += cost.w[i] * cost.w[i]
    total = sqrt(total)
    for j in range(cost.kinds.shape[0]):
        size = 1.0
        if cost.kinds[j] in (RANGE, LINEAR):
            size = abs(chart.origin[0]) + abs(chart.origin[1]) + abs(chart.origin[2])
            size += abs(cost.data[j, 0]) + abs(cost.data[j, 1]) + abs(cost.data[j, 2])
            if cost.kinds[j] == LINEAR:
                size *= abs(cost.data[j, 3]) + abs(cost.data[j, 4]) + abs(cost.data[j, 5])
        total += cost.weight[j] * size
    return total


@inlined
def place(origin: Array, sense: Array, at: Array, centre: Array) -> None:
    """Write the centre of a box at search coordinates `at` in metres."""
    s0, s1, s2 = at[0], at[1], at[2]
    for k in range(3):
        centre[k] = origin[k] + (sense[k, 0] * s0 + sense[k, 1] * s1 + sense[k, 2] * s2)


@compiled
def value_at(cost: Cost, chart: Chart, box: Box) -> float:
    """Return f at the centre of a box; its first table is filled."""
    place(chart.origin, chart.sense, box.at, box.centre)
    bound_nodes(cost.kinds, cost.data, box.centre, chart.sense, chart.gram, box.half, box.line, box.nodes)
    return cost_at(cost.K, cost.w, box.nodes)


@inlined
def curve_box(cost: Cost, chart: Chart, box: Box) -> None:
    """Fill the tables of second derivatives of a box whose nodes are bounded."""
    sense, gram, half, line, nodes, curves = chart.sense, chart.gram, box.half, box.line, box.nodes, box.curves
    curve_nodes(cost.kinds, cost.data, box.centre, sense, gram, half, line, box.solve, nodes, curves)
    sum_up(cost.K, cost.w, nodes, curves, box.sums)


@compiled
def is_convex(cost: Cost, chart: Chart, box: Box, margin: float) -> bool:
    """Return whether the Hessian of f/2 exceeds `margin` all over a box, whose tables are filled."""
    place(chart.origin, chart.sense, box.at, box.centre)
    bound_nodes(cost.kinds, cost.data, box.centre, chart.sense, chart.gram, box.half, box.line, box.nodes)
    curve_box(cost, chart, box)
    return convex(cost.kinds, cost.A, box.half, box.nodes, box.curves, box.sums, margin)
