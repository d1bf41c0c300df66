r"""A cvxpy problem taken apart once: Clarabel's data as affine functions of the parameters.

.. math:: \min_x \tfrac12 x^\top P x + q^\top x + d \quad\text{subject to}\quad A x + s = b, \; s \in K

Sources: A. Agrawal et al., "Differentiable convex optimization layers", NeurIPS 2019 (the affine maps); C. Jansson,
D. Chaykin and C. Keil, "Rigorous error bounds for the optimal value in semidefinite programming", SIAM J. Numer.
Anal. 46 (2007) (the bound).
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formulations._dual import dual_point

Array = NDArray[np.float64]


class Data:
    """Clarabel's data as affine functions of the parameters of a cvxpy problem, with a fixed sparsity pattern.

    Parameters
    ----------
    problem : cvxpy.Problem
        A minimisation that follows cvxpy's rules for parameters (DPP).

    Notes
    -----
    Agrawal et al. (2019). `feed` writes into the arrays `P`, `q`, `d`, `A`, `b`: give each thread its own `twin`.
    """

    def __init__(self, problem: Any) -> None:
        import cvxpy
        import scipy.sparse as sp
        from cvxpy.reductions.solvers.conic_solvers.clarabel_conif import dims_to_solver_cones

        for parameter in problem.parameters():
            if parameter.value is None:
                parameter.value = np.zeros(parameter.shape)
        if not (problem.is_dcp(dpp=True) and isinstance(problem.objective, cvxpy.Minimize)):
            raise ValueError("the problem must be a minimisation that follows cvxpy's rules for parameters (DPP)")
        stuff, chain, inverse = problem.get_problem_data(cvxpy.CLARABEL)
        self.program = stuff["param_prob"]
        self.dims, self.cones = stuff["dims"], dims_to_solver_cones(stuff["dims"])
        columns = self.program.param_id_to_col
        self.slots = {p.name(): (columns[p.id], p.shape) for p in problem.parameters() if p.id in columns}
        if len(self.slots) != len(problem.parameters()):
            raise ValueError("parameters need unique names and no symmetric, diagonal or semidefinite attribute")
        self.vector = np.zeros(self.program.total_param_size + 1)
        self.vector[-1] = 1.0
        n = self.program.x.size
        self._linear = _Product.of(self.program.q)
        self._matrix, pattern = _affine(self.program.reduced_A)
        m = pattern[2][0]
        self.q, self.d, self.b = np.zeros(n), 0.0, np.zeros(m)
        last = pattern[1][n]
        self._left, self._rows = slice(0, last), pattern[0][last:]
        self._quadratic: _Product | None = None
        self._upper = np.zeros(0, dtype=np.int64)
        self.A = sp.csc_array((np.zeros(last), pattern[0][:last], pattern[1][: n + 1]), shape=(m, n))
        self.P = sp.csc_array((n, n))
        if self.program.P is not None:
            self._quadratic, pattern = _affine(self.program.reduced_P)
            column = np.repeat(np.arange(n), np.diff(pattern[1]))
            self._upper = np.flatnonzero(pattern[0] <= column)
            row, column = pattern[0][self._upper], column[self._upper]
            start = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=n))])
            self.P = sp.csc_array((np.zeros(len(row)), row, start), shape=(n, n))
        self.across, self.below = _Product.transposed(self.A), _Product.transposed(self.P)
        self.above = _Product(n, self.below.source, self.below.row, self.P.data)
        self._ridge = np.where(self.below.row == self.below.source, 0.0, 1.0)
        self._recover = _recovery(problem, chain, inverse, self.program.x.id, n)

    def feed(self, values: Mapping[str, Array]) -> None:
        """Set the parameters.

        Parameters
        ----------
        values : Mapping[str, Array]
            Values of every parameter, by name.
        """
        for name, (start, shape) in self.slots.items():
            value = np.asarray(values[name], dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"parameter {name} has shape {value.shape}, {shape} expected")
            self.vector[start : start + value.size] = value.ravel(order="F")
        linear = self._linear(self.vector)
        self.q, self.d = linear[:-1].copy(), float(linear[-1])
        entries = self._matrix(self.vector)
        self.A.data[:] = -entries[self._left]
        self.b = np.zeros(self.A.shape[0])
        self.b[self._rows] = entries[self._left.stop :]
        if self._quadratic is not None:
            self.P.data[:] = self._quadratic(self.vector)[self._upper]

    def twin(self) -> Data:
        """Return the same problem with numbers of its own, for another thread."""
        other = copy(self)
        other.vector, other.A = self.vector.copy(), self.A.copy()
        other.P = self.P.copy()
        other.across = replace(self.across, data=other.A.data)
        other.below, other.above = (replace(one, data=other.P.data) for one in (self.below, self.above))
        return other

    def square(self, x: Array) -> Array:
        """Return ``Px`` from the stored upper triangle.

        Parameters
        ----------
        x : Array, shape (n,)
            A point.

        Returns
        -------
        Array, shape (n,)
            The product.
        """
        if self._quadratic is None:
            return np.zeros_like(x)
        return self.below(x) + self.above(x, self._ridge)

    def bound(self, x: Array, z: Array, reach: float) -> float:
        """Lower bound of the optimum from a dual point.

        Parameters
        ----------
        x, z : Array, shapes (n,) and (m,)
            Primal point (its quadratic term only) and dual point.
        reach : float
            The minimiser is taken to be no longer than this.

        Returns
        -------
        float
            The bound; minus infinity where the dual point is of no use.

        Notes
        -----
        Jansson, Chaykin and Keil (2007), with one radius for all of x.
        """
        z = dual_point(z, self.dims)
        if not np.isfinite(z).all():
            return -np.inf
        product = self.square(x)
        rest = product + self.q + self.across(z)
        return self.d - 0.5 * float(x @ product) - float(self.b @ z) - reach * float(np.sqrt(rest @ rest))

    def recover(self, x: Array) -> dict[str, Array]:
        """Return the values of the variables by name at a point of the solver.

        Parameters
        ----------
        x : Array, shape (n,)
            The point.

        Returns
        -------
        dict[str, Array]
            One array for each variable.
        """
        return {name: (matrix @ x).reshape(shape, order="F") for name, matrix, shape in self._recover}


@dataclass(frozen=True, slots=True)
class _Product:
    """A sparse matrix as a product only: on problems of tens of entries scipy's own costs more than the solver."""

    size: int
    row: NDArray[np.int64]
    source: NDArray[np.int64]
    data: Array

    @classmethod
    def of(cls, matrix: Any) -> _Product:
        entries = matrix.tocoo()
        return cls(matrix.shape[0], entries.row.astype(np.int64), entries.col.astype(np.int64), entries.data)

    @classmethod
    def transposed(cls, matrix: Any) -> _Product:
        """Transpose of a compressed-column matrix, sharing its entries."""
        size = matrix.shape[1]
        column = np.repeat(np.arange(size), np.diff(matrix.indptr))
        return cls(size, column, matrix.indices.astype(np.int64), matrix.data)

    def __call__(self, x: Array, share: Array | float = 1.0) -> Array:
        total = np.bincount(self.row, weights=self.data * x[self.source] * share, minlength=self.size)
        return np.asarray(total, dtype=np.float64)


def _affine(reduced: Any) -> tuple[_Product, tuple[NDArray[np.int64], NDArray[np.int64], tuple[int, int]]]:
    """Map from the parameter vector to the stored entries, and their compressed-column pattern."""
    reduced.cache()
    if reduced.problem_data_index is None:
        raise ValueError("the problem has no constraint")
    return _Product.of(reduced.reduced_mat), reduced.problem_data_index


def _recovery(problem: Any, chain: Any, inverse: Any, name: int, n: int) -> list[tuple[str, Array, tuple[int, ...]]]:
    """Matrices from the solver's x to each variable, read off by undoing the reductions on unit vectors."""
    from cvxpy.reductions.solution import Solution

    columns: dict[int, list[Array]] = {variable.id: [] for variable in problem.variables()}
    for unit in np.eye(n):
        solution = Solution("optimal", 0.0, {name: unit}, None, {})
        for reduction, data in zip(reversed(chain.reductions[:-1]), reversed(inverse[:-1]), strict=True):
            solution = reduction.invert(solution, data)
        for variable in problem.variables():
            value = solution.primal_vars[variable.id]
            dense = value.toarray() if hasattr(value, "toarray") else np.asarray(value)
            columns[variable.id].append(dense.ravel(order="F"))
    return [(v.name(), np.stack(columns[v.id], axis=1), v.shape) for v in problem.variables()]
