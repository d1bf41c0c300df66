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
    interval.
``curve(data, line, sense, half, curvature, turn) -> chi``
    writes the Hessian with respect to s at the centre into curvature (3, 3), a bound of the change of each component of
    the gradient over the box into turn (3,), and returns a bound of the spectral norm of the change of the Hessian;
    infinite turn or chi where there is none. Over t times the box, 0 < t < 1, these bounds and those of the remainder
    are at most t times as large wherever chi is finite.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.problem.problem import Problem

# Codes of the shipped nodes, by which machine code knows them; nodes from outside are counted on. ANY stands for a node
# of which nothing is known but its tables.
RANGE, LINEAR, AZIMUTH, ELEVATION, RATIO, HEIGHT = range(6)
ANY = -1

# How a node curves: not at all, with a Hessian that is nowhere negative (a bound of its force from below is enough
# then), or in any way.
FLAT, CONVEX, MIXED = range(3)
# What becomes of a node at infinity. It grows without end, and so does the cost. Or it depends on the directions of its
# lines alone, so that scaled lines serve as well. Or only differences of such nodes are finite: ranges.
GROWS, SCALED, DIFFERENCE = range(3)

# Columns of a table of nodes over a box (J, NODE_WIDTH): value at the centre, gradient, enclosure of the remainder.
PHI, SLOPE0, SLOPE1, SLOPE2, LOW, HIGH, NODE_WIDTH = range(7)
# Columns of a table of second derivatives (J, CURVE_WIDTH): the Hessian's entries, bounds of the change of the gradient
# and of the Hessian, and what the rows add to them: the force K'(K phi - w) on the node, and its pull K'J.
H00, H01, H02, H11, H12, H22, TURN0, TURN1, TURN2, CHI, FORCE, PULL0, PULL1, PULL2, CURVE_WIDTH = range(15)


@dataclass(frozen=True, slots=True)
class Row:
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
    """One kind of node. Its functions of scalars and arrays are compiled (`optloc.compute.jit.compiled`).

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
        GROWS, SCALED or DIFFERENCE.
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
    counts_from_measured : bool
        Whether the node is its quantity less the measured value.
    most : float
        Greatest size of the node, for kinds with a period: residuals are wrapped, nodes are not.
    mark : callable, optional
        ``(numbers, alone, centred, measured)``: marks nodes whose rows are their own in their numbers (B, n, width),
        from where they are (B, n), where such a row has its least cost at zero for all problems (n,), and at which
        value for each (N, n).
    differs : bool
        Whether `mark` needs numbers for each problem.
    """

    name: str
    width: int
    points: int
    numbers: Callable[[Row], Array]
    bound: Kernel | None = None
    curve: Kernel | None = None
    shape: int = MIXED
    infinity: int = GROWS
    size: Kernel | None = None
    ball: Kernel | None = None
    ray: Kernel | None = None
    counts_from_measured: bool = False
    most: float = inf
    mark: Callable[[Array, Array, Array, Array], None] | None = None
    differs: bool = False
