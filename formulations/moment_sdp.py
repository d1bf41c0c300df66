r"""Ranges up to a common unknown: the order-2 moment relaxation of the maximum-likelihood fix, and its lower bound.

In a box (:mod:`formulations.range_enclosure`), :math:`x = c + A s`, :math:`r_1 = \bar r + h t`, and with the errors
:math:`w_i = u_i \omega_i` of the other ranges :math:`r_i = \sigma_i r_1 + d_i + w_i`,

.. math:: \min_{s, t, \omega} \; \zeta^\top Q\, \zeta, \; \zeta = (1, t, \omega) \quad\text{subject to}\quad
   |x - s_1|^2 = r_1^2, \qquad |x - s_i|^2 = (\sigma_i r_1 + d_i + w_i)^2, \qquad s_k^2, t^2 \le 1

is exact and polynomial. Its relaxation has the moments of :math:`(1, s, t) \otimes (1, \omega)` as unknowns: their
matrix, of size (d + 2) M, is positive semidefinite, so are :math:`E[(1 - t^2)\,(1, \omega)(1, \omega)^\top]` and those
of :math:`1 - s_k^2`; the first equality times every product of two errors and the others times 1, s and t vanish.
Rows for :math:`\omega_i^2` would be combinations of these, by the second equalities.

The cost depends on differences of ranges only, so that the lift of (1, x, r) is never tight; products of errors and
positions make this relaxation tighter. The box is necessary too: without it the moments have no bound, and the relative
tolerances of a solver hide violations. Every monomial is at most one here, which makes the bound from the dual
rigorous.

Source: J. B. Lasserre, "Global optimization with polynomials and the problem of moments", SIAM J. Optim. 11 (2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from formulations.algebra import Array, Index
from formulations.conic import ConicAnswer, Relaxation, keep, rank_ratio, tight
from formulations.range_enclosure import EnclosingBox, Ranged


@dataclass(frozen=True, slots=True)
class Moments:
    """Numbers of the monomials of M ranges in d dimensions, with p = d + 2 places.

    A monomial is a product of two of ``(1, s, t)`` (position and reference range) and two of ``(1, w)`` (errors): these
    are the entries of the moment matrix of ``(1, s, t) x (1, w)``.

    Parameters
    ----------
    count : int
        Number of monomials.
    table : Index, shape (p, p, M, M)
        Number of each monomial by its two places and its two errors.
    matrix : Index, shape (p M, p M)
        The moment matrix.
    cone : Index, shape (M (M + 1) / 2, p (p + 1) / 2)
        The pairs of places times each pair of errors.
    rules : Index, shape (M - 1, p, d + 5)
        ``1, s, t, w_i, t w_i, w_i^2`` times each of ``1, s, t``.
    cost : Index, shape ((M + 1)(M + 2) / 2,)
        The pairs of ``(1, t, w)``.
    """

    count: int
    table: Index
    matrix: Index
    cone: Index
    rules: Index
    cost: Index


@lru_cache(maxsize=32)  # the arrays are never written, so threads may share them
def moments(stations: int, dimension: int) -> Moments:
    """Return the numbers of the monomials; pairs are upper triangles, row by row.

    Parameters
    ----------
    stations, dimension : int
        M and d.

    Returns
    -------
    Moments
        The numbers.
    """
    M, p = stations, dimension + 2
    place = list(combinations_with_replacement(range(p), 2))
    error = list(combinations_with_replacement(range(M), 2))
    table = np.zeros((p, p, M, M), dtype=np.int64)
    for i, (a, b) in enumerate(place):
        for j, (k, m) in enumerate(error):
            table[[a, a, b, b], [b, b, a, a], [k, m, k, m], [m, k, m, k]] = i * len(error) + j
    cone = np.array([[table[a, b, k, m] for a, b in place] for k, m in error])
    rules = np.stack(
        [
            np.column_stack([table[:, :, 0, 0], table[0, :, 0, i], table[:, p - 1, 0, i], table[0, :, i, i]])
            for i in range(1, M)
        ]
    )
    terms = [(0, 0), (p - 1, 0), *((0, i) for i in range(1, M))]
    cost = np.array([table[u[0], v[0], u[1], v[1]] for u, v in combinations_with_replacement(terms, 2)])
    matrix = table.transpose(0, 2, 1, 3).reshape(p * M, p * M)
    return Moments(len(place) * len(error), table, matrix, cone, rules, cost)


@dataclass(frozen=True, slots=True)
class Bounded:
    """The result of the relaxation for the points of a box.

    Parameters
    ----------
    point : Array, shape (d,)
        First moments: the minimiser if `rank_ratio` is small.
    value : float
        Optimum of the relaxation, as reported by the solver.
    bound : float
        Lower bound of the cost in the box, recomputed from the dual, and at most the given `cost`.
    rank_ratio : float
        Second over first eigenvalue of the moments of (1, s, t); near zero if tight.
    answer : ConicAnswer
        The solver's report.
    """

    point: Array
    value: float
    bound: float
    rank_ratio: float
    answer: ConicAnswer


def moment_problem(stations: int, dimension: int) -> Any:
    """Build the relaxation as a cvxpy problem.

    Parameters
    ----------
    stations, dimension : int
        M and d.

    Returns
    -------
    cvxpy.Problem
        Variable ``y`` of moments, numbered by `formulations.moment_sdp.moments`. Parameters: ``cost`` of the pairs of
        ``(1, t, w)``; ``cone`` of the pairs of ``(1, s, t)``; ``rule`` (M - 1, d + 5) of ``1, s, t, w_i, t w_i,
        w_i^2``.

    Notes
    -----
    Lasserre (2001).
    """
    import cvxpy as cp

    own = moments(stations, dimension)
    y = cp.Variable(own.count, name="y")
    cost = cp.Parameter(len(own.cost), name="cost")
    cone = cp.Parameter(own.cone.shape[1], name="cone")
    rule = cp.Parameter((stations - 1, dimension + 5), name="rule")

    def arrange(index: Index) -> Any:
        """Return the moments with the given numbers as an expression of the same shape."""
        return cp.reshape(y[index.ravel()], index.shape, order="C")

    errors = arrange(own.table[0, 0])
    # the moment matrix, the matrices of (1 - t^2), (1 - s_k^2) times two errors, and the rules times 1, s and t
    demands = [arrange(own.matrix) >> 0, y[0] == 1, arrange(own.cone) @ cone == 0]
    demands += [errors - arrange(own.table[k, k]) >> 0 for k in range(1, dimension + 2)]
    demands += [arrange(index) @ rule[i] == 0 for i, index in enumerate(own.rules)]
    return cp.Problem(cp.Minimize(cost @ y[own.cost]), demands)


@keep
def _relaxation(stations: int, dimension: int, backend: str) -> Relaxation:
    """Return the relaxation, built once for each size and back end."""
    return Relaxation(moment_problem(stations, dimension), backend=backend, settings=settings_of(backend))


def settings_of(backend: str = "CLARABEL") -> dict[str, float]:
    """Return the settings of the relaxation for a back end.

    The equalities depend on each other at a solution: with Clarabel's default regularisation one solve in four stops
    early.
    """
    return tight(backend, 1e-8, static_regularization_constant=1e-7)


@dataclass(frozen=True, slots=True)
class MomentProgram:
    """The data of the relaxation.

    Parameters
    ----------
    values : dict of str to Array
        Parameters of `moment_problem`.
    size : float
        The cost is `size` times the objective.
    white : Array, shape (q, M + 1)
        Residuals in standard deviations, linear in ``(1, t, omega)``.
    box : EnclosingBox
        The box.
    """

    values: dict[str, Array]
    size: float
    white: Array
    box: EnclosingBox


def moment_program(ranged: Ranged, box: EnclosingBox, cost: float) -> MomentProgram:
    """Return the data of the relaxation; arguments as in `moment_bound`."""
    # errors in units of the largest error of a point with this cost: together with the box, every monomial is at most
    # one
    unit = np.sqrt(cost * np.diag(ranged.spread))
    cone, rule, white = _forms(ranged, box, unit)
    form = white.T @ white
    size = float(np.abs(form).max())
    values = {
        "cost": _upper(form / size),
        "cone": _upper(cone / np.abs(cone).max()),
        "rule": rule / np.abs(rule).max(1, keepdims=True),
    }
    return MomentProgram(values, size, white, box)


def moment_bound(ranged: Ranged, box: EnclosingBox, cost: float, *, backend: str = "CLARABEL") -> Bounded:
    """Return a lower bound of the maximum-likelihood cost over a box.

    Parameters
    ----------
    ranged : Ranged
        The measurements, in any unit of length: the box gives the units of the program.
    box : EnclosingBox
        The box, best from `formulations.range_enclosure.enclosure` with the same cost.
    cost : float
        Greatest relevant cost: slightly above the cost of a fix.
    backend : str
        Conic solver; only Clarabel gives bounds.

    Returns
    -------
    Bounded
        Bound, value and point. Built once per size and back end in each process.

    Notes
    -----
    Lasserre (2001).
    """
    M, d = ranged.station.shape
    own, program = moments(M, d), moment_program(ranged, box, cost)
    # no monomial of a relevant point exceeds one
    answer = _relaxation(M, d, backend).solve(program.values, reach=float(np.sqrt(own.count)))
    place = answer.values["y"][own.table[:, :, 0, 0]]
    point, size = box.centre + box.axes @ place[0, 1:-1], program.size
    return Bounded(point, answer.primal * size, min(answer.bound * size, cost), rank_ratio(place), answer)


def _forms(ranged: Ranged, box: EnclosingBox, unit: Array) -> tuple[Array, Array, Array]:
    """Return the coefficients of the relaxation: first equality, other equalities, and whitened residuals.

    The first equality is a matrix in (1, s, t), the residuals are linear in (1, t, omega). The others are rows (M - 1,
    d + 5)
    of ``1, s, t, w_i, t w_i, w_i^2``. `unit` (M - 1,) are the units of the errors w.
    """
    from_first, other = box.centre - ranged.station[0], ranged.station[1:] - ranged.station[0]
    middle, half = 0.5 * (box.low + box.high), 0.5 * (box.high - box.low)
    side, d, D = ranged.side, ranged.excess, len(from_first)
    place = np.column_stack([from_first, box.axes, np.zeros(D)])
    reach = np.zeros(D + 2)
    reach[0], reach[-1] = middle, half
    cone = place.T @ place - np.outer(reach, reach)
    # |x - s_1|^2 - |x - s_i|^2 + (sign r_1 + d + w)^2 - r_1^2
    rule = np.column_stack(
        [
            2.0 * side * d * middle + d * d - (other * other).sum(1) + 2.0 * other @ from_first,
            2.0 * other @ box.axes,
            2.0 * side * d * half,
            2.0 * (side * middle + d) * unit,
            2.0 * side * half * unit,
            unit * unit,
        ]
    )
    # from (1, t, omega) to (1, r_1, w)
    change = np.diag(np.concatenate([[1.0, half], unit]))
    change[1, 0] = middle
    return cone, rule, _white(ranged, change)


def _white(ranged: Ranged, change: Array) -> Array:
    """Return the whitened residuals as rows in the variables (1, t, omega), whose sum of squares is the cost.

    `change` maps (1, t, omega) to (1, r_1, w).
    """
    if ranged.free:
        return np.asarray(np.linalg.solve(np.linalg.cholesky(ranged.spread), change[2:]))
    # The measurement minus the middle of the box is small. It is subtracted before squaring, because squares of ranges
    # in standard deviations have eight digits more than the cost.
    error = -ranged.offset[0] * np.eye(1, len(change)) + change[1] + np.pad(change[2:], ((1, 0), (0, 0)))
    return np.asarray(np.linalg.solve(np.linalg.cholesky(ranged.covariance), error))


def _upper(form: Array) -> Array:
    """Return the coefficients of a quadratic form for products of pairs: the upper triangle, off-diagonal doubled."""
    row, column = np.triu_indices(len(form))
    return np.asarray(np.where(row == column, 1.0, 2.0) * form[row, column])
