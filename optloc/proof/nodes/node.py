"""Nodes: scalar functions of the position that residuals are sums of, and the functions that bound a node over a box.

A node is for instance a range or an azimuth. Residuals are ``K phi(x) - w``, whitened: K (q, J) has one row for each
measurement or prior, and one column for each node phi_j. Each kind of node is a file of this folder with one `Node`;
`optloc.proof.nodes.dispatch` lists them. A measurement kind names its nodes in its `optloc.models.Model`.

Letters in shapes: N problems, d coordinates, J nodes; B is N, or 1 if all problems share the numbers.

All vectors here have three numbers. In the plane the third number of a point, of a line and of every axis is 0, and so
is the third half-width. `sense` has a column and a row of zeros. So nothing depends on the third search coordinate.

Over a box (centre c, half-widths h in search coordinates s, x = c + T s) a node is bounded by two functions of

    data (width,)  numbers of the node, points first
    line (3,)      c minus the point data[0:3] (in an atlas the scaled line p - varpi a)
    sense (3, 3)   derivative of the line with respect to s (T near; [e_j, e_k, -a] far)
    half (3,)      half-widths h

(nodes of two points also have ``line_b, sense_b`` of the second point, data[3:6], after ``line, sense``):

``bound(data, line, sense, half, slope) -> (value, low, high)``
    returns the value at the centre, and an interval [low, high]. The interval contains the remainder
    ``phi(s) - value - slope.s`` for all |s_k| <= half_k. Writes the gradient with respect to s into slope (3,).
    Without a sharp bound, the slope is 0 and the interval is wide; an end may be infinite.
``curve(data, line, sense, half, curvature, turn) -> chi``
    writes the Hessian with respect to s at the centre into curvature (3, 3), and a bound of the change of each
    component of the gradient over the box into turn (3,). Returns a bound of the spectral norm of the change of the
    Hessian. Without a bound, turn or chi is infinite. Wherever chi is finite, these bounds and the bounds of the
    remainder over t times the box, 0 < t < 1, are at most t times as large.
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

# Codes of the shipped nodes in compiled code; nodes of users get the next codes. ANY is a node of which only the
# tables are known.
RANGE, LINEAR, AZIMUTH, ELEVATION, RATIO, HEIGHT, RATE, LOG_RANGE = range(8)
ANY = -1

# Curvature of a node: zero; a Hessian that is nowhere negative, for which a lower bound of the force is enough; or
# any.
FLAT, CONVEX, MIXED = range(3)
# Behaviour of a node at infinity. GROWS: it grows without limit, and so does the cost. SCALED: it depends on the
# directions of its lines only, so that scaled lines give the same value. DIFFERENCE: only differences of such nodes
# are finite (ranges). BALANCED: only differences are finite, and scaled lines give the same differences (logarithms).
GROWS, SCALED, DIFFERENCE, BALANCED = range(4)

# Columns of a table of nodes over a box (J, NODE_WIDTH): value at the centre, gradient, interval of the remainder and
# the middle of this interval. For a range over a piece of an atlas, FORM has the numbers of `range_form` except the
# last, which its curvature needs.
PHI, SLOPE0, SLOPE1, SLOPE2, LOW, HIGH, BETWEEN, FORM, NODE_WIDTH = 0, 1, 2, 3, 4, 5, 6, 7, 13
# Columns of a table of second derivatives (J, CURVE_WIDTH): the Hessian's entries, and bounds of the change of the
# gradient and of the Hessian. Then numbers that depend on the rows: the force K'(K phi - w) on the node, its pull K'J,
# and a bound of the rounding of the force.
H00, H01, H02, H11, H12, H22, TURN0, TURN1, TURN2, CHI, FORCE, PULL0, PULL1, PULL2, BLUR, CURVE_WIDTH = range(16)


@dataclass(frozen=True, slots=True)
class NodeRow:
    """The row of a flat batch of N problems for which a node is made.

    Parameters
    ----------
    problem : Problem
        The problems.
    a, b, epoch : int
        Indices of the row's stations and of its epoch; -1 for a station that the row does not have.
    measured : array (N,)
        Measured values of the row minus all known additions, in the unit of the kind (m, rad, m/s).
    """

    problem: Problem
    a: int
    b: int
    epoch: int
    measured: Array

    def place(self, station: int) -> Array:
        """Return the position (B, d), metres, of a station; B is N, or 1 if all problems share it."""
        position = self.problem.stations.position
        picked = position[..., self.epoch if position.shape[-3] > 1 else 0, station, :]
        return picked if picked.ndim == 2 else picked[None]

    def velocity(self, station: int) -> Array:
        """Return the velocity (B, d), m/s, of a station at the epoch of the row."""
        velocity = self.problem.stations.velocity
        assert velocity is not None  # problems with velocity kinds have station velocities
        picked = velocity[..., self.epoch if velocity.shape[-3] > 1 else 0, station, :]
        return picked if picked.ndim == 2 else picked[None]

    def axes(self, station: int) -> Array:
        """Return the axes (B, 9) of a station: three unit vectors, row by row.

        Stations without axes get the axes of the frame. In the plane, the third row and column are zero if axes are
        given.
        """
        axes, d = self.problem.stations.axes, self.problem.dimension
        if axes is None:
            return np.eye(3).reshape(1, 9)
        picked = axes[..., self.epoch if axes.shape[-4] > 1 else 0, station, :, :]
        picked = picked if picked.ndim == 3 else picked[None]
        out = np.zeros((len(picked), 3, 3))
        out[:, :d, :d] = picked
        return out.reshape(len(picked), 9)


def lay_out(parts: dict[int, Array]) -> Array:
    """Return the numbers (B, n) of a node, put together from parts (B or 1, k).

    The key of each part is its first column. Columns without a part are zero.
    """
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
        Name for use in a `Model`.
    width : int
        Number of the node's numbers.
    points : int
        Number of points at the beginning of the numbers, and of lines that the functions take: 1 or 2.
    numbers : callable
        ``(NodeRow) -> array (B, n <= width)``: the numbers for a row of a batch, B = 1 if all problems share them.
    bound, curve : callable
        As above; None for ranges, which are bounded all at once.
    shape : int
        FLAT, CONVEX or MIXED.
    infinity : int
        GROWS, SCALED, DIFFERENCE or BALANCED.
    size : callable, optional
        ``(data, reach) -> float``: the size of the terms of the value, which limits its accuracy; `reach` is the sum
        of the sizes of the coordinates. None: 1, as for angles and ratios.
    ball : callable, optional
        ``(data, least, most) -> (x, y, z, radius)``: a ball that contains all points at which the node is in an
        interval; infinite radius without a ball. None: the node has no balls.
    ray : callable, optional
        ``(kinds, data, swing, j, x, row) -> (width, far)`` for node j, which is within `swing` (J,) of its value at a
        fix x. Writes a unit vector into row (3,). Points at distance r from the station are within ``r width`` of the
        fix along this vector, and `far` is the distance of the fix. A negative width means no bound. None: the node
        has no bounds of this kind.
    of_station : bool
        Whether the node depends on one station and epoch only, so that all rows with this node share it.
    counts_from_measured : bool
        Whether the node is the quantity minus the measured value.
    most : float
        Greatest size of the node, for kinds with a period: residuals are wrapped, nodes are not.
    mark : callable, optional
        ``(numbers, alone)``: marks nodes that share no row with other nodes and have their least cost at zero. The
        numbers (B, n, width) of the nodes are changed where `alone` (B, n) is True.
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


# Linear forms of a box's coordinates as triples of numbers: their greatest values, their products, ranges over a box.
#
# A box is ``|s_k| <= h_k``; a linear form u.s is the triple of its coefficients.

Triple = tuple[float, float, float]
# A symmetric matrix: entries 00, 01, 02, 11, 12, 22. A tuple, because compiled code keeps its numbers in registers.
Symmetric = tuple[float, float, float, float, float, float]
# A range over a box, see `range_form`.
RangeForm = tuple[float, Triple, float, float, float]


@compiled
def triple_at(numbers: Array, at: int) -> Triple:
    """Return three consecutive numbers of an array as a triple."""
    return numbers[at], numbers[at + 1], numbers[at + 2]


@compiled
def turned_form(n: Triple, sense: Array) -> Triple:
    """Return the linear form ``n.(sense s)`` as the triple ``sense' n``.

    For a unit vector n, this is the gradient of a line's component along n with respect to s.
    """
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
    """Return whether a slope (3,) is zero, as for a node with a constant interval."""
    return bool(slope[0] == 0.0 and slope[1] == 0.0 and slope[2] == 0.0)


@compiled
def unbounded_curvature(curvature: Array, turn: Array) -> float:
    """Write the results of a node without bounds of curvature: zero Hessian, infinite change of slope; return inf."""
    for k in range(3):
        turn[k] = inf
        for m in range(3):
            curvature[k, m] = 0.0
    return inf


@compiled
def reach(u: Triple, h: Triple) -> float:
    """Return the greatest value of ``|u.s|`` over the box with half-widths h."""
    return abs(u[0]) * h[0] + abs(u[1]) * h[1] + abs(u[2]) * h[2]


@compiled
def largest_row_value(matrix: Array, k: int, h: Triple) -> float:
    """Return the greatest ``|(matrix s)_k|`` over a box; for a Hessian, a bound of a gradient component's change."""
    return float(abs(matrix[k, 0]) * h[0] + abs(matrix[k, 1]) * h[1] + abs(matrix[k, 2]) * h[2])


@compiled
def product(u: Triple, v: Triple, h: Triple) -> tuple[float, float]:
    """Return an enclosure (least, greatest) of ``(u.s)(v.s)`` over the box with half-widths h.

    A square s_k^2 is between 0 and h_k^2, so its term has a known sign. This makes the enclosure tighter.
    """
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
    """Return an enclosure of a number in [low, high] divided by a number in [least, most], with most >= least > 0."""
    return low / (least if low < 0.0 else most), high / (least if high > 0.0 else most)


@inlined
def hypot_excess(along: float, across: float) -> float:
    """Return a bound of ``hypot(a, b) - a`` for all a >= along and |b| <= across.

    The difference decreases with a. For a range, it is the greatest remainder: a is the component along the line of
    sight.
    """
    whole = sqrt(along * along + across * across)
    # A difference of two nearly equal numbers would lose all digits; the quotient loses none.
    return across * across / (whole + along) if along > 0.0 else whole - along


@inlined
def largest_quadratic(a: float, b: float, c: float, d: float, e: float, f: float) -> float:
    """Return the maximum of s'[[a, b, c], [b, d, e], [c, e, f]]s, positive semidefinite, over |s_k| <= 1.

    The maximum is at a corner. If the product of the three mixed terms is positive, the signs of a corner make all of
    them positive. Otherwise one of them must be negative: the smallest.
    """
    u, v, t = abs(b), abs(c), abs(e)
    mixed = u + v + t
    if b * c * e < 0.0:
        mixed -= 2.0 * min(u, v, t)
    # Rounding may make the form slightly negative, and the callers take its square root.
    return max(0.0, a + d + f + 2.0 * mixed)


@inlined
def length_across(sense: Array, u: Triple, h: Triple) -> float:
    """Return a bound over a box of the length of ``sense s`` without its component along a unit vector.

    Parameters
    ----------
    sense : array (3, 3)
        Derivative of a line.
    u : triple
        Gradient of the component along the unit vector.
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
    """Return a range over a box: value r, slope u, least r + u.s, greatest remainder, and greatest value.

    `line` (3,) is the line from the station to the centre of the box, `sense` (3, 3) its derivative, and h the
    half-widths. The range is ``r + u.s + q`` with ``0 <= q <= remainder``. If the third number is positive, the box
    does not contain the station.
    """
    n = triple_at(line, 0)
    r = length(n)
    per = 1.0 / r if r > 0.0 else 0.0
    u = turned_form((n[0] * per, n[1] * per, n[2] * per) if r > 0.0 else (1.0, 0.0, 0.0), sense)
    swing, aside = reach(u, h), length_across(sense, u, h)
    # The distance of the farthest corner, enlarged by the rounding of the root.
    far = sqrt((r + swing) * (r + swing) + aside * aside) * (1.0 + 1e-15)
    return r, u, r - swing, hypot_excess(r - swing, aside), far


@inlined
def range_hessian(
    sense: Array, h: Triple, r: float, u: Triple, least: float, remainder: float
) -> tuple[Symmetric, Triple, float, float]:
    """Return the Hessian of a range, bounds of the changes of its gradient and Hessian, and a norm of the Hessian.

    Parameters
    ----------
    sense : array (3, 3)
        Derivative of the line.
    h : triple
        Half-widths.
    r, u, least, remainder
        Results of `range_form`; `least` must be positive.

    Returns
    -------
    hessian : symmetric
        ``sense' P sense / r``, with P the projection across the line.
    turn : triple
        Bound of the change of each component of the gradient over the box.
    change : float
        Bound of the spectral norm of the change of the Hessian over the box.
    norm : float
        Trace of the Hessian, which bounds its norm.
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
    """Return the greatest sizes over a box of the entries of ``matrix s``, see `largest_row_value`."""
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
    """Write a symmetric matrix, given as six entries, into an array (3, 3)."""
    out[0, 0], out[1, 1], out[2, 2] = matrix[0], matrix[3], matrix[5]
    out[0, 1] = out[1, 0] = matrix[1]
    out[0, 2] = out[2, 0] = matrix[2]
    out[1, 2] = out[2, 1] = matrix[4]


@inlined
def _gram(sense: Array, u: Triple) -> Symmetric:
    """Return ``sense'sense - u u'``; squared lengths that rounding makes negative are set to zero.

    With u the gradient along a unit vector, this quadratic form of s is the squared length of ``sense s`` across the
    vector.
    """
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
