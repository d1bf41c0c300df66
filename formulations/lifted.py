r"""Lifted ranges, the textbook forms: **baselines of studies, never a default**.

Ranges :math:`r_i = |x - s_i|` become additional unknowns, so that rows linear in ranges are linear:

.. math:: \min_{x, r \ge 0} \; |K r - z|^2 \quad\text{subject to}\quad r_i^2 = |x - s_i|^2, \quad i = 1..M,

with whitened rows `K` (ranges: a scaled identity; range differences: rows :math:`e_a - e_b`; sums: :math:`e_a +
e_b`).

*Order one.* :math:`Y = (1, x, r)(1, x, r)^\top` relaxed to :math:`Y \succeq 0`; the equalities are linear in `Y`. For
range differences it is **never tight** where the residual is not zero: adding :math:`t \, 1 1^\top` to the block of
:math:`r r^\top` costs nothing, which leaves the squared system with its reference range free. The value is then near
zero, and the point read off is no fix. It is kept to show exactly that.

*Nonlinear.* The same problem for IPOPT, with `r` as unknowns: no better than the problem in `x` alone, and a local
method like it.

Sources: K. Yang, G. Wang and Z.-Q. Luo, "Efficient convex relaxation methods for robust target localization by a
sensor network using time differences of arrivals", IEEE Trans. Signal Process. 57 (2009) (the lift, which they
penalise); K. W. Cheung, W.-K. Ma and H. C. So, "Accurate approximation algorithm for TOA-based maximum likelihood
mobile location using semidefinite programming", ICASSP 2004.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array
from formulations.conic import ConicAnswer, Relaxation, keep, rank_ratio, tight
from formulations.nls import Local, Program
from formulations.unit_scale import PointScale


@dataclass(frozen=True, slots=True)
class Lifted:
    """The result of the order-one relaxation.

    Parameters
    ----------
    point : Array, shape (d,)
        Position read off the first column.
    ranges : Array, shape (M,)
        Ranges read off the first column; they differ from the distances of `point` if the relaxation is not tight.
    value, bound : float
        Optimum, and a lower bound of the ML cost ``|K r(x) - z|^2`` recomputed from the dual.
    rank_ratio : float
        Second over first eigenvalue of the lift.
    answer : ConicAnswer
        The solver's report.
    """

    point: Array
    ranges: Array
    value: float
    bound: float
    rank_ratio: float
    answer: ConicAnswer


def lifted_problem(count: int, dim: int, change: Array | None = None) -> Any:
    """Build the order-one relaxation as a cvxpy problem: a baseline, never a default.

    Parameters
    ----------
    count, dim : int
        M stations in d dimensions.
    change : Array, shape (1 + d + M, 1 + d + M), optional
        Matrix for other unknowns u: ``(1, x, r) = change u``, where u[0] = 1. By default u is (1, x, r).

    Returns
    -------
    cvxpy.Problem
        Variable ``lift`` of shape (1 + d + M, 1 + d + M) of u; parameters ``gram`` (1 + M, 1 + M), the products of
        ``[-z, K]`` in these unknowns; ``station`` (M, d) and ``square`` (M,), the squared lengths; ``reach``, the
        largest ``|x|^2``, without which range differences leave the lift unbounded.

    Notes
    -----
    Yang, Wang and Luo (2009), without their penalty.
    """
    import cvxpy as cp

    size, first = 1 + dim + count, 1 + dim
    own = cp.Variable((size, size), symmetric=True, name="lift")
    lift = own if change is None else change @ own @ change.T
    gram = cp.Parameter((1 + count, 1 + count), name="gram")
    station, square = cp.Parameter((count, dim), name="station"), cp.Parameter(count, name="square")
    reach = cp.Parameter(name="reach")
    x, r, diagonal = lift[0, 1:first], lift[0, first:], cp.diag(lift)
    value = gram[0, 0] + 2 * gram[0, 1:] @ own[0, first:] + cp.sum(cp.multiply(gram[1:, 1:], own[first:, first:]))
    rules = [
        own >> 0,
        lift[0, 0] == 1,
        diagonal[first:] == cp.sum(diagonal[1:first]) - 2 * station @ x + square,
        r >= 0,
        cp.sum(diagonal[1:first]) <= reach,
    ]
    return cp.Problem(cp.Minimize(value), rules)


@keep
def _relaxation(count: int, dim: int, backend: str) -> Relaxation:
    """Return the relaxation for `count` stations in `dim` dimensions, built once for each size and back end."""
    return Relaxation(lifted_problem(count, dim), backend=backend, settings=settings_of(backend))


def settings_of(backend: str = "CLARABEL") -> dict[str, float]:
    """Return the settings of the relaxation for a back end.

    The tolerance is a decade below the default of Clarabel, because the value that this baseline demonstrates is near
    zero.
    """
    return tight(backend, 1e-9)


def lifted_data(
    rows: ArrayLike, right: ArrayLike, station: ArrayLike, *, reach: float = 10.0
) -> tuple[dict[str, Array], float, float]:
    """Return the data of the relaxation; arguments as in `lifted_ranges`.

    Returns
    -------
    values : dict of str to Array
        Parameters of `lifted_problem`.
    size : float
        The cost is the square of `size` times the objective.
    longest : float
        Greatest length of the lift of any point within the reach.
    """
    K, z, S = (np.asarray(part, dtype=np.float64) for part in (rows, right, station))
    table = np.concatenate([-z[:, None], K], axis=1)
    size = float(np.abs(K).max()) or 1.0  # whitened rows are large where noise is small
    square = (S * S).sum(axis=1)
    # |(1, x, r)|^2 of every point within the reach, which makes the bound rigorous
    longest = 1.0 + reach**2 + float(((reach + np.sqrt(square)) ** 2).sum())
    values = {"gram": table.T @ table / size**2, "station": S, "square": square, "reach": np.array(reach**2)}
    return values, size, longest


def lifted_ranges(
    rows: ArrayLike, right: ArrayLike, station: ArrayLike, *, reach: float = 10.0, backend: str = "CLARABEL"
) -> Lifted:
    """Return the solution of the order-one relaxation: a baseline, never a default.

    Parameters
    ----------
    rows : array_like, shape (q, M)
        Whitened K.
    right : array_like, shape (q,)
        Whitened z.
    station : array_like, shape (M, d)
        Positions, in any unit of length.
    reach : float
        Largest allowed distance of x from the mean of the stations, in extents of the array: range differences leave
        the lift unbounded without it. The bound holds within this distance.
    backend : str
        Conic solver.

    Returns
    -------
    Lifted
        Point and bound; the text of the module explains their limits.

    Notes
    -----
    Yang, Wang and Luo (2009). Built once per size and back end in each process.
    """
    K, S = np.asarray(rows, dtype=np.float64), np.asarray(station, dtype=np.float64)
    own = PointScale.of(S)
    values, size, longest = lifted_data(K * own.unit, right, own.scaled(S), reach=reach)
    count, dim = S.shape
    answer = _relaxation(count, dim, backend).solve(values, reach=longest)
    lift = answer.values["lift"]
    point, ranges = lift[0, 1 : 1 + dim].copy(), lift[0, 1 + dim :].copy()
    bound = max(answer.bound, 0.0) * size**2  # a sum of squares is not negative
    point, ranges = own.back(point), own.unit * ranges
    return Lifted(point, ranges, answer.primal * size**2, bound, rank_ratio(lift), answer)


@keep
def _program(count: int, dim: int, measured: int) -> Program:
    """Return a program with unknowns (x, r) and parameters: the stations, then the rows K, both row by row."""

    def residual(y: Any, p: Any, z: Any) -> list[Any]:
        """Return ``z - K r``, with K from the parameters p."""
        at = count * dim
        return [z[k] - sum(p[at + count * k + i] * y[dim + i] for i in range(count)) for k in range(measured)]

    def equalities(y: Any, p: Any) -> list[Any]:
        """Return ``r_i^2 - |x - s_i|^2``, which must be zero."""
        return [y[dim + i] ** 2 - sum((y[j] - p[dim * i + j]) ** 2 for j in range(dim)) for i in range(count)]

    return Program(dim + count, measured, count * (dim + measured), residual=residual, equalities=equalities)


def lifted_program(rows: ArrayLike, right: ArrayLike, station: ArrayLike, start: ArrayLike) -> Local:
    """Return a local solution of the lifted problem by IPOPT: a baseline, never a default.

    Parameters
    ----------
    rows : array_like, shape (q, M)
        Whitened K.
    right : array_like, shape (q,)
        Whitened z.
    station : array_like, shape (M, d)
        Positions, numbers of order one.
    start : array_like, shape (d,)
        First position; the ranges start at its distances.

    Returns
    -------
    Local
        ``x`` is (x, r), of length d + M.

    Notes
    -----
    Cheung, Ma and So (2004) state the problem. Built once per size in each process.
    """
    K, z, S, x = (np.asarray(part, dtype=np.float64) for part in (rows, right, station, start))
    count, dim = S.shape
    first = np.concatenate([x, np.sqrt(((x - S) ** 2).sum(axis=1))])
    lower = np.concatenate([np.full(dim, -np.inf), np.zeros(count)])
    given = np.concatenate([S.ravel(), K.ravel()])
    return _program(count, dim, len(z)).solve(first, z, p=given, lower=lower)
