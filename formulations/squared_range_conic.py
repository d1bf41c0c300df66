r"""Convex relaxations of squared-range least squares.

The problem is :math:`\min |B y - g|^2` subject to :math:`y^\top C y + 2 h^\top y = 0`
(:mod:`formulations.squared_range`). With :math:`R^\top R = [B, -g]^\top [B, -g]` (the triangular factor, so the size
does not grow with the rows):

*Shor.* :math:`\min \operatorname{tr}(R^\top R\, Y)` over :math:`Y \succeq 0`, :math:`Y_{n+1,n+1} = 1`,
:math:`\operatorname{tr}(C Y_{11}) + 2 h^\top Y_{12} = 0`. With one quadratic constraint the S-lemma makes it exact:
the optimum equals the GTRS value and a rank-one optimum exists.

*Second order.* The constraint is relaxed to its convex hull, :math:`|x| \le r` (cone) or :math:`|x|^2 \le w`
(paraboloid): :math:`\min |R (y, 1)|^2`. A lower bound, tight when the unconstrained fit violates the hull. The norm
itself would lose digits: 10 of 240 programs then miss the tolerance, and none misses it with its square.

Sources: N. Z. Shor, "Quadratic optimization problems", Sov. J. Comput. Syst. Sci. 25 (1987); J. J. More,
"Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993); for tightness of the second-order form
see the tests.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.algebra import Array
from formulations.conic import ConicAnswer, Relaxation, keep, rank_ratio, tight
from formulations.squared_range import Quadric
from formulations.unit_scale import RowScale


@dataclass(frozen=True, slots=True)
class Relaxed:
    """A relaxed squared-range fit.

    Parameters
    ----------
    y : Array, shape (n,)
        Point read off the relaxation; on the quadric only if tight.
    points : Array, shape (2, n)
        Two points of the quadric whose mixture is the solution; NaN if the relaxation is tight, or a point is at
        infinity.
    value : float
        Optimal ``|By - g|^2`` of the relaxation.
    bound : float
        Lower bound of the squared-range cost, recomputed from the dual.
    rank_ratio : float
        Second over first eigenvalue of the lifted matrix (Shor); relative distance from the quadric (second order).
        Near zero means tight.
    answer : ConicAnswer
        The solver's report, in the coordinates of `formulations.unit_scale.RowScale`.
    """

    y: Array
    points: Array
    value: float
    bound: float
    rank_ratio: float
    answer: ConicAnswer


def shor_problem(quadric: Quadric, change: Array | None = None) -> Any:
    """Build the semidefinite relaxation as a cvxpy problem with parameter ``gram``.

    Parameters
    ----------
    quadric : Quadric
        The constraint, of size n.
    change : Array, shape (n, n + 1), optional
        Other unknowns w with ``y = change (w, 1)``; by default w is y.

    Returns
    -------
    cvxpy.Problem
        Parameter ``gram`` of shape (n + 1, n + 1) is ``[B, -g]'[B, -g]`` in the unknowns w; variable ``lift`` is the
        lift of (w, 1).

    Notes
    -----
    Shor (1987).
    """
    import cvxpy as cp

    n = quadric.size
    gram = cp.Parameter((n + 1, n + 1), name="gram")
    lift = cp.Variable((n + 1, n + 1), symmetric=True, name="lift")
    shape = np.zeros((n + 1, n + 1))
    shape[np.arange(n), np.arange(n)] = quadric.square
    shape[:n, n] = shape[n, :n] = quadric.linear
    if change is not None:
        whole = np.vstack([change, np.eye(n + 1)[n]])
        shape = whole.T @ shape @ whole
        shape /= np.abs(shape).max()
    constraints = [lift >> 0, lift[n, n] == 1, cp.sum(cp.multiply(shape, lift)) == 0]
    return cp.Problem(cp.Minimize(cp.sum(cp.multiply(gram, lift))), constraints)


def hull_problem(quadric: Quadric, change: Array | None = None) -> Any:
    """Build the second-order relaxation as a cvxpy problem with parameter ``factor``.

    Parameters
    ----------
    quadric : Quadric
        The constraint, of size n.
    change : Array, shape (n, n + 1), optional
        Other unknowns w with ``y = change (w, 1)``; by default w is y.

    Returns
    -------
    cvxpy.Problem
        Parameter ``factor`` of shape (n + 1, n + 1) is the triangular factor of ``[B, -g]`` in the unknowns w; variable
        ``y``, which is w.

    Notes
    -----
    The convex hull of the half cone and of the paraboloid.
    """
    import cvxpy as cp

    n = quadric.size
    factor = cp.Parameter((n + 1, n + 1), name="factor")
    w = cp.Variable(n, name="y")
    y = w if change is None else change[:, :n] @ w + change[:, n]
    if quadric.shape == "cone":
        inside = cp.norm(y[:-1]) <= y[-1]
    elif change is None:
        inside = cp.sum_squares(y[:-1]) <= y[-1]
    else:
        inside = _inside_paraboloid(change, w)
    # squared: a multiplier is then cost per unit of its constraint, and the residuals of the solver are small
    return cp.Problem(cp.Minimize(cp.sum_squares(factor[:, :n] @ w + factor[:, n])), [inside])


TOLERANCE = 1e-10
"""Tolerance of Clarabel for both relaxations.

In 200 random problems in space, the greatest error of the point of `shor` is 1e-3 at Clarabel's default of 1e-8. It is
1e-4 here, after two more iterations; at 1e-11 one solve in seven stops early.
"""


@keep
def _relaxation(kind: str, quadric: Quadric, backend: str) -> Relaxation:
    """Return the relaxation of the given kind, "shor" or "hull", built once for each quadric and back end."""
    problem = shor_problem(quadric) if kind == "shor" else hull_problem(quadric)
    return Relaxation(problem, backend=backend, settings=tight(backend, TOLERANCE))


def shor(B: Array, g: Array, quadric: Quadric, *, backend: str = "CLARABEL", bound: bool = True) -> Relaxed:
    """Return the solution of the semidefinite relaxation.

    Parameters
    ----------
    B : Array, shape (q, n)
        Whitened rows, in any unit of length.
    g : Array, shape (q,)
        Right sides.
    quadric : Quadric
        The constraint.
    backend : str
        Conic solver.
    bound : bool
        Whether to recompute the lower bound from the dual.

    Returns
    -------
    Relaxed
        ``y`` is the last column of the lift. The problem is built once per quadric and back end in each process.

    Notes
    -----
    Shor (1987).
    """
    n = quadric.size
    own = RowScale.of(B, g, quadric)
    factor, scale = triangle(*own.rows(B, g))
    answer = _relaxation("shor", quadric, backend).solve({"gram": factor.T @ factor}, bound=bound)
    lift = answer.values["lift"]
    points = own.back(np.concatenate([lift[None, :n, n], mixed_points(lift, quadric)]))
    value, low = answer.primal * scale**2, answer.bound * scale**2
    return Relaxed(points[0], points[1:], value, low, rank_ratio(lift), answer)


def hull(B: Array, g: Array, quadric: Quadric, *, backend: str = "CLARABEL", bound: bool = True) -> Relaxed:
    """Return the solution of the second-order cone relaxation.

    Parameters
    ----------
    B : Array, shape (q, n)
        Whitened rows, in any unit of length.
    g : Array, shape (q,)
        Right sides.
    quadric : Quadric
        The constraint.
    backend : str
        Conic solver.
    bound : bool
        Whether to recompute the lower bound from the dual.

    Returns
    -------
    Relaxed
        The relaxed point. The bound is for the half cone ``r >= 0``.

    Notes
    -----
    The convex hull of the half cone and of the paraboloid.
    """
    own = RowScale.of(B, g, quadric)
    factor, scale = triangle(*own.rows(B, g))
    answer = _relaxation("hull", quadric, backend).solve({"factor": factor}, bound=bound)
    y = answer.values["y"]
    off = float(abs(quadric.value(y)) / (1.0 + np.sum(y * y)))
    # from the point: the objective of a solver has an error relative to the largest row, which may exceed a small cost
    value = float(np.sum((factor[:, :-1] @ y + factor[:, -1]) ** 2)) * scale**2
    low = max(answer.bound, 0.0) * scale**2  # a sum of squares is not negative
    points = own.back(np.concatenate([y[None], crossings(factor[:, :-1], y, quadric)]))
    return Relaxed(points[0], points[1:], value, low, off, answer)


# Second over first eigenvalue of a lift, and distance from the quadric, below which a solution is one point.
_TIGHT = 1e-6


def mixed_points(lift: Array, quadric: Quadric) -> Array:
    """Return the two points of the quadric whose mixture is a lift of rank two.

    With only as many rows as unknowns there are two solutions, and an interior-point method ends between them. With one
    quadratic constraint, a lift is always a sum of lifts of points that satisfy it.

    Parameters
    ----------
    lift : Array, shape (n + 1, n + 1)
        Symmetric positive semidefinite.
    quadric : Quadric
        The constraint, of size n.

    Returns
    -------
    Array, shape (2, n)
        The points; NaN if the rank is one, or if a point is at infinity.

    Notes
    -----
    J. F. Sturm, S. Zhang, "On cones of nonnegative quadratic functions", Math. Oper. Res. 28 (2003), proposition 3.
    """
    n, out = quadric.size, np.full((2, quadric.size), np.nan)
    if not np.isfinite(lift).all():  # the solver has no solution
        return out
    values, vectors = np.linalg.eigh(lift)
    if not values[-2] > _TIGHT * values[-1]:
        return out
    first, second = (np.sqrt(values[i]) * vectors[:, i] for i in (-1, -2))
    # The lift satisfies the constraint, so the forms of its two parts have the sum zero. Their signs differ, and two
    # combinations of the parts have the form zero: they are the points.
    a, b, c = _form(first, first, quadric), _form(first, second, quadric), _form(second, second, quadric)
    if not a * c < 0.0:
        return out
    turn = (-b + np.sqrt(b * b - a * c)) / c
    for i, point in enumerate((first + turn * second, second - turn * first)):
        if abs(point[n]) > _TIGHT * np.abs(point).max():
            out[i] = point[:n] / point[n]
    return out


def _form(u: Array, v: Array, quadric: Quadric) -> float:
    """Return the bilinear form of the constraint for two vectors (n + 1,), points (y, 1) times any number."""
    linear = quadric.linear @ (u[:-1] * v[-1] + v[:-1] * u[-1])
    return float(np.sum(quadric.square * u[:-1] * v[:-1]) + linear)


def crossings(factor: Array, y: Array, quadric: Quadric) -> Array:
    """Return the points where a line meets the quadric: the line through a point along which its fit changes least.

    Parameters
    ----------
    factor : Array, shape (q, n)
        Rows.
    y : Array, shape (n,)
        Point.
    quadric : Quadric
        The constraint.

    Returns
    -------
    Array, shape (2, n)
        The points; NaN if the point is on the quadric, or if the line misses it.
    """
    out = np.full((2, quadric.size), np.nan)
    if not abs(quadric.value(y)) > _TIGHT * (1.0 + np.sum(y * y)):
        return out
    along = np.linalg.svd(factor)[2][-1]
    a = float(np.sum(quadric.square * along * along))
    b = float(np.sum(quadric.square * along * y) + quadric.linear @ along)
    c = float(quadric.value(y))
    if b * b - a * c < 0.0:
        return out
    # the root of larger size first, so that no digits cancel
    q = -(b + np.copysign(np.sqrt(b * b - a * c), b))
    for i, (over, under) in enumerate(((q, a), (c, q))):
        if abs(under) > _TIGHT * abs(over):
            out[i] = y + over / under * along
    return out


def _inside_paraboloid(change: Array, w: Any) -> Any:
    """Return the constraint ``|x|^2 <= y_n`` in the unknowns w (n,) with ``y = change (w, 1)``, divided by its slope.

    The constants of both sides are almost equal, and their difference is a few standard deviations.
    """
    import cvxpy as cp

    slope, centre = change[:, :-1], change[:, -1]
    level = float(centre[:-1] @ centre[:-1] - centre[-1])
    line = 2.0 * centre[:-1] @ slope[:-1] - slope[-1]
    size = max(float(np.abs(line).max()), abs(level)) or 1.0
    return cp.sum_squares((slope[:-1] / np.sqrt(size)) @ w) + (line / size) @ w + level / size <= 0.0


def in_deviations(B: Array, g: Array) -> Array:
    """Return a change of unknowns after which the cost is a plain square: a unit is a standard deviation.

    Parameters
    ----------
    B : Array, shape (q, n)
        Whitened rows, numbers of order one or larger.
    g : Array, shape (q,)
        Right sides.

    Returns
    -------
    Array, shape (n, n + 1)
        The map from (w, 1) to y: w is zero at the least-squares fit, and one at a distance of a standard deviation.
        Directions that rows determine less well than the unit of y keep this unit.
    """
    _, size, across = np.linalg.svd(np.concatenate([B, np.zeros((B.shape[1], B.shape[1]))]), full_matrices=False)
    known = size > _KNOWN * size[0]
    centre = np.linalg.lstsq(B, g, rcond=_KNOWN)[0]
    return np.concatenate([across.T / np.where(known, np.maximum(size, 1.0), 1.0), centre[:, None]], axis=1)


# Singular value of the rows, relative to the largest, below which a direction is undetermined: rounding of the rows.
_KNOWN = 1e-12


def triangle(B: Array, g: Array) -> tuple[Array, float]:
    """Return the triangular factor of rows and right sides, divided by its size, and this size.

    Whitened rows are large if the noise is small; the solver needs numbers of order one.

    Parameters
    ----------
    B : Array, shape (q, n)
        Whitened rows.
    g : Array, shape (q,)
        Right sides.

    Returns
    -------
    factor : Array, shape (n + 1, n + 1)
        R with ``R'R = [B, -g]'[B, -g] / scale^2``.
    scale : float
        Largest entry before the division.
    """
    rows = np.concatenate([B, -g[:, None]], axis=1)
    n = rows.shape[1]
    factor = np.zeros((n, n))
    upper = np.linalg.qr(rows, mode="r")
    factor[: len(upper)] = upper
    scale = float(np.abs(factor).max()) or 1.0
    return factor / scale, scale
