"""What a node is: a scalar function of the position that residuals are sums of, and all that a proof must know of it.

Residuals are ``K phi(x) - w``, whitened, with one node phi_j a column. Each kind of node is a file of this folder with
one `Node`; `optloc.proof.nodes.dispatch` lists them. A measurement kind names its nodes in its `optloc.models.Model`.

All vectors here have three numbers. In the plane the third of a point, of a line and of every axis is 0, `sense` has a
column and a row of zeros, and the third half-width is 0: nothing depends on the third search coordinate then.

Over a box (centre c, half-widths h in search coordinates s, x = c + T s) a node is bounded by two functions of

    data (width,)  the node's own numbers, points first
    line (3,)      c minus the point data[0:3] (in the inverse-range chart the scaled line p - varpi a)
    sense (3, 3)   derivative of the line with respect to s (T near; [e_j, e_k, -a] far)
    half (3,)      half-widths h

(nodes of two points have ``line_b, sense_b`` of the second, data[3:6], after ``line, sense``):

``bound(data, line, sense, half, slope) -> (value, low, high)``
    value at the centre; writes its gradient with respect to s into slope (3,); low and high enclose the remainder
    ``phi(s) - value - slope.s`` for all |s_k| <= half_k. What cannot be bounded sharply has slope 0 and a wide
    interval, of which an end may be infinite.
``curve(data, line, sense, half, curvature, turn) -> chi``
    writes the Hessian with respect to s at the centre into curvature (3, 3), a bound of the change of each component of
    the gradient over the box into turn (3,), and returns a bound of the spectral norm of the change of the Hessian;
    infinite turn or chi where there is none. Over t times the box, 0 < t < 1, these bounds and those of the remainder
    are at most t times as large wherever chi is finite.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, sqrt
from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, inlined
from optloc.problem.problem import Problem

# Codes of the shipped nodes, by which machine code knows them; nodes from outside are counted on. ANY stands for a node
# of which nothing is known but its tables.
RANGE, LINEAR, AZIMUTH, ELEVATION, RATIO, HEIGHT, RATE, LOG_RANGE = range(8)
ANY = -1

# How a node curves: not at all, with a Hessian that is nowhere negative (a bound of its force from below is enough
# then), or in any way.
FLAT, CONVEX, MIXED = range(3)
# What becomes of a node at infinity. It grows without end, and so does the cost. Or it depends on the directions of its
# lines alone, so that scaled lines serve as well. Or only differences of such nodes are finite: ranges; or logarithms,
# for whose differences scaled lines serve.
GROWS, SCALED, DIFFERENCE, BALANCED = range(4)

# Columns of a table of nodes over a box (J, NODE_WIDTH): value at the centre, gradient, enclosure of the remainder and
# its middle. Of a range over a piece of an atlas its curvature needs more: all numbers of `range_form` except the last.
PHI, SLOPE0, SLOPE1, SLOPE2, LOW, HIGH, BETWEEN, FORM, NODE_WIDTH = 0, 1, 2, 3, 4, 5, 6, 7, 13
# Columns of a table of second derivatives (J, CURVE_WIDTH): the Hessian's entries, bounds of the change of the gradient
# and of the Hessian, and what the rows add to them: the force K'(K phi - w) on the node, its pull K'J, and how far the
# force may be from what it is computed to be.
H00, H01, H02, H11, H12, H22, TURN0, TURN1, TURN2, CHI, FORCE, PULL0, PULL1, PULL2, BLUR, CURVE_WIDTH = range(16)


@dataclass(frozen=True, slots=True)
class NodeRow:
    """The row of a flat batch of N problems that a node is made for.

    Parameters
    ----------
    problem : Problem
        The problems.
    a, b, epoch : int
        Stations and epoch of the row; -1 for a station that it does not have.
    measured : array (N,)
        Its measured value less everything that is known to be added.
    """

    problem: Problem
    a: int
    b: int
    epoch: int
    measured: Array

    def place(self, station: int) -> Array:
        """Return the position (B, d) of a station; B is N, or 1 where all problems share it."""
        position = self.problem.stations.position
        picked = position[..., self.epoch if position.shape[-3] > 1 else 0, station, :]
        return picked if picked.ndim == 2 else picked[None]

    def velocity(self, station: int) -> Array:
        """Return the velocity (B, d) of a station."""
        velocity = self.problem.stations.velocity
        assert velocity is not None  # a problem of kinds with velocities has them
        picked = velocity[..., self.epoch if velocity.shape[-3] > 1 else 0, station, :]
        return picked if picked.ndim == 2 else picked[None]

    def axes(self, station: int) -> Array:
        """Return the axes (B, 9) of a station, rows of three."""
        axes, d = self.problem.stations.axes, self.problem.dimension
        if axes is None:
            return np.eye(3).reshape(1, 9)
        picked = axes[..., self.epoch if axes.shape[-4] > 1 else 0, station, :, :]
        picked = picked if picked.ndim == 3 else picked[None]
        out = np.zeros((len(picked), 3, 3))
        out[:, :d, :d] = picked
        return out.reshape(len(picked), 9)


def lay_out(parts: dict[int, Array]) -> Array:
    """Return the numbers (B, n) of a node from its parts (B or 1, k) by the column where each begins; else zero."""
    last = max(start + part.shape[1] for start, part in parts.items())
    out = np.zeros((max(len(part) for part in parts.values()), last))
    for start, part in parts.items():
        out[:, start : start + part.shape[1]] = part
    return out


Kernel = Callable[..., Any]


@dataclass(frozen=True, slots=True)
class Node:
    """One kind of node. Its functions of scalars and arrays are compiled (`optloc.kernels.jit.compiled`).

    Parameters
    ----------
    name : str
        By which a `Model` names it.
    width : int
        How many numbers it has.
    points : int
        How many points these begin with, and lines the functions take: 1 or 2.
    numbers : callable
        ``(Row) -> array (B, n <= width)``: its numbers for a row of a batch, B = 1 where all problems share them.
    bound, curve : callable
        As above; None for ranges, which are bounded all at once.
    shape : int
        FLAT, CONVEX or MIXED.
    infinity : int
        GROWS, SCALED, DIFFERENCE or BALANCED.
    size : callable, optional
        ``(data, reach) -> float``: the size of what the value is a difference of, where the lengths of the
        coordinates sum to `reach`; it limits the accuracy. None: 1, as angles and ratios.
    ball : callable, optional
        ``(data, least, most) -> (x, y, z, radius)``: a ball that holds all points at which the node is in an interval;
        infinite where there is none. None: there never is one.
    ray : callable, optional
        ``(kinds, data, swing, j, x, row) -> (width, far)``: of node j, which is within `swing` (J,) of its value at a
        fix x. Writes a unit vector into row (3,): points at distance r off the station are within ``r width`` of the
        fix along it, and the fix itself is `far`. A negative width where nothing is known. None: it never is.
    of_station : bool
        Whether it is of a station at an epoch alone, so that all rows which name it share the node.
    counts_from_measured : bool
        Whether the node is its quantity less the measured value.
    most : float
        Greatest size of the node, for kinds with a period: residuals are wrapped, nodes are not.
    mark : callable, optional
        ``(numbers, alone)``: marks nodes whose rows are their own, with the least cost at zero, in their numbers
        (B, n, width), from where they are (B, n).
    """

    name: str
    width: int
    points: int
    numbers: Callable[[NodeRow], Array]
    bound: Kernel | None = None
    curve: Kernel | None = None
    shape: int = MIXED
    infinity: int = GROWS
    size: Kernel | None = None
    ball: Kernel | None = None
    ray: Kernel | None = None
    of_station: bool = False
    counts_from_measured: bool = False
    most: float = inf
    mark: Callable[[Array, Array], None] | None = None


# Linear forms of a box's coordinates as triples of numbers: their reach, their products, ranges over a box.
#
# A box is ``|s_k| <= h_k``; a linear form u.s is the triple of its coefficients.

Triple = tuple[float, float, float]
# A symmetric matrix: entries 00, 01, 02, 11, 12, 22. Numbers, not an array: machine code keeps them in registers.
Symmetric = tuple[float, float, float, float, float, float]
# A range over a box, see `range_form`.
RangeForm = tuple[float, Triple, float, float, float]


@compiled
def triple_at(numbers: Array, at: int) -> Triple:
    """Return three numbers from an index on."""
    return numbers[at], numbers[at + 1], numbers[at + 2]


@compiled
def turned_form(n: Triple, sense: Array) -> Triple:
    """Return the linear form ``n.(sense s)``."""
    return (
        n[0] * sense[0, 0] + n[1] * sense[1, 0] + n[2] * sense[2, 0],
        n[0] * sense[0, 1] + n[1] * sense[1, 1] + n[2] * sense[2, 1],
        n[0] * sense[0, 2] + n[1] * sense[1, 2] + n[2] * sense[2, 2],
    )


@compiled
def inner_product(u: Triple, v: Triple) -> float:
    """Return the inner product of two triples."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@compiled
def length(u: Triple) -> float:
    """Return the Euclidean length of a triple."""
    return sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])


@compiled
def sum_of_forms(p: float, u: Triple, q: float, v: Triple) -> Triple:
    """Return the linear form ``p u + q v``."""
    return p * u[0] + q * v[0], p * u[1] + q * v[1], p * u[2] + q * v[2]


@compiled
def write_triple(u: Triple, out: Array) -> None:
    """Write a triple into an array (3,)."""
    out[0], out[1], out[2] = u[0], u[1], u[2]


@compiled
def is_zero_slope(slope: Array) -> bool:
    """Return whether a slope (3,) is zero, as that of a node which is only enclosed."""
    return bool(slope[0] == 0.0 and slope[1] == 0.0 and slope[2] == 0.0)


@compiled
def unbounded_curvature(curvature: Array, turn: Array) -> float:
    """Say that a node's curvature has no bound over a box: no Hessian, infinite change of the gradient; return inf."""
    for k in range(3):
        turn[k] = inf
        for m in range(3):
            curvature[k, m] = 0.0
    return inf


@compiled
def reach(u: Triple, h: Triple) -> float:
    """Return the greatest value of ``|u.s|`` over a box."""
    return abs(u[0]) * h[0] + abs(u[1]) * h[1] + abs(u[2]) * h[2]


@compiled
def largest_row_value(matrix: Array, k: int, h: Triple) -> float:
    """Return the greatest value over a box of ``|(matrix s)_k|``: with a Hessian, of the change of a gradient."""
    return float(abs(matrix[k, 0]) * h[0] + abs(matrix[k, 1]) * h[1] + abs(matrix[k, 2]) * h[2])


@compiled
def product(u: Triple, v: Triple, h: Triple) -> tuple[float, float]:
    """Return an enclosure of ``(u.s)(v.s)`` over a box: squares have a sign, which the product of reaches forgets."""
    low = high = 0.0
    for k in range(3):
        square = u[k] * v[k] * h[k] * h[k]
        low += min(square, 0.0)
        high += max(square, 0.0)
    mixed = (
        abs(u[0] * v[1] + u[1] * v[0]) * h[0] * h[1]
        + abs(u[0] * v[2] + u[2] * v[0]) * h[0] * h[2]
        + abs(u[1] * v[2] + u[2] * v[1]) * h[1] * h[2]
    )
    return low - mixed, high + mixed


@compiled
def scaled(low: float, high: float, least: float, most: float) -> tuple[float, float]:
    """Return an enclosure of a number in [low, high] divided by one in [least, most], both of these positive."""
    return low / (least if low < 0.0 else most), high / (least if high > 0.0 else most)


@inlined
def hypot_excess(along: float, across: float) -> float:
    """Return a bound of ``hypot(a, b) - a`` for all a >= along and |b| <= across: it falls with a."""
    whole = sqrt(along * along + across * across)
    # The difference of two numbers that are nearly one would lose all digits: as a quotient it loses none.
    return across * across / (whole + along) if along > 0.0 else whole - along


@inlined
def largest_quadratic(a: float, b: float, c: float, d: float, e: float, f: float) -> float:
    """Return the maximum of s'[[a, b, c], [b, d, e], [c, e, f]]s, positive semidefinite, over |s_k| <= 1.

    The maximum is at a corner. The signs of a corner make all three mixed terms positive where their product is;
    otherwise one of them must be negative: the smallest.
    """
    u, v, t = abs(b), abs(c), abs(e)
    mixed = u + v + t
    if b * c * e < 0.0:
        mixed -= 2.0 * min(u, v, t)
    # Rounding may leave a form that is nowhere positive below zero, of which no root could be taken.
    return max(0.0, a + d + f + 2.0 * mixed)


@inlined
def length_across(sense: Array, u: Triple, h: Triple) -> float:
    """Return a bound over a box of the length of ``sense s`` without its part along a unit vector.

    Parameters
    ----------
    sense : array (3, 3)
        Derivative of a line.
    u : triple
        Pull of the unit vector.
    h : triple
        Half-widths.
    """
    g = _gram(sense, u)
    h0, h1, h2 = h
    form = largest_quadratic(
        g[0] * h0 * h0, g[1] * h0 * h1, g[2] * h0 * h2, g[3] * h1 * h1, g[4] * h1 * h2, g[5] * h2 * h2
    )
    return sqrt(form)


@inlined
def range_form(line: Array, sense: Array, h: Triple) -> RangeForm:
    """Return a range over a box: its value r, slope u, the least r + u.s, a bound of the remainder, and the greatest.

    The range is ``r + u.s + q`` with ``0 <= q <= remainder``.
    """
    n = triple_at(line, 0)
    r = length(n)
    per = 1.0 / r if r > 0.0 else 0.0
    u = turned_form((n[0] * per, n[1] * per, n[2] * per) if r > 0.0 else (1.0, 0.0, 0.0), sense)
    swing, aside = reach(u, h), length_across(sense, u, h)
    # The farthest corner, up to the rounding of its root.
    far = sqrt((r + swing) * (r + swing) + aside * aside) * (1.0 + 1e-15)
    return r, u, r - swing, hypot_excess(r - swing, aside), far


@inlined
def range_hessian(
    sense: Array, h: Triple, r: float, u: Triple, least: float, remainder: float
) -> tuple[Symmetric, Triple, float, float]:
    """Return the Hessian of a range; bounds of the change of its gradient (a triple) and Hessian, and its norm.

    Parameters
    ----------
    sense : array (3, 3)
        Derivative of the line.
    h : triple
        Half-widths.
    r, u, least, remainder
        What `range_form` returns; `least` must be positive.

    Returns
    -------
    hessian : symmetric
        ``sense' P sense / r``.
    turn, change, norm
        As above.
    """
    g, per = _gram(sense, u), 1.0 / r
    hessian = (g[0] * per, g[1] * per, g[2] * per, g[3] * per, g[4] * per, g[5] * per)
    trace = hessian[0] + hessian[3] + hessian[5]
    if not least > 0.0:
        return hessian, (inf, inf, inf), inf, trace
    most, (w0, w1, w2) = 1.0 / least, largest_entries(hessian, h)
    turn = (
        (w0 * r + remainder * abs(u[0])) * most,
        (w1 * r + remainder * abs(u[1])) * most,
        (w2 * r + remainder * abs(u[2])) * most,
    )
    eta = length(turn)
    change = (eta * (2.0 * length(u) + eta) + trace * (reach(u, h) + remainder)) * most
    return hessian, turn, change, trace


@inlined
def largest_entries(matrix: Symmetric, h: Triple) -> Triple:
    """Return the greatest values over a box of the entries of ``matrix s``, see `row_reach`."""
    m00, m01, m02, m11, m12, m22 = matrix
    b, c, e = abs(m01), abs(m02), abs(m12)
    return (
        abs(m00) * h[0] + b * h[1] + c * h[2],
        b * h[0] + abs(m11) * h[1] + e * h[2],
        c * h[0] + e * h[1] + abs(m22) * h[2],
    )


@compiled
def add_symmetric(a: Symmetric, b: Symmetric) -> Symmetric:
    """Return the sum of two symmetric matrices."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@compiled
def write_symmetric(matrix: Symmetric, out: Array) -> None:
    """Write a symmetric matrix into an array (3, 3)."""
    out[0, 0], out[1, 1], out[2, 2] = matrix[0], matrix[3], matrix[5]
    out[0, 1] = out[1, 0] = matrix[1]
    out[0, 2] = out[2, 0] = matrix[2]
    out[1, 2] = out[2, 1] = matrix[4]


@inlined
def _gram(sense: Array, u: Triple) -> Symmetric:
    """Return ``sense'sense - u u'``, of which rounding may not make a squared length negative."""
    a, b, c = sense[0, 0], sense[0, 1], sense[0, 2]
    d, e, f = sense[1, 0], sense[1, 1], sense[1, 2]
    p, q, r = sense[2, 0], sense[2, 1], sense[2, 2]
    u0, u1, u2 = u
    return (
        max(a * a + d * d + p * p - u0 * u0, 0.0),
        a * b + d * e + p * q - u0 * u1,
        a * c + d * f + p * r - u0 * u2,
        max(b * b + e * e + q * q - u1 * u1, 0.0),
        b * c + e * f + q * r - u1 * u2,
        max(c * c + f * f + r * r - u2 * u2, 0.0),
    )
