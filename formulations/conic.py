r"""Parametrised conic problems, canonicalised once and solved again with Clarabel's data.

A cvxpy problem that obeys the parameter rules (DPP) becomes

.. math:: \min_x \tfrac12 x^\top P x + q^\top x + d \quad\text{subject to}\quad A x + s = b, \; s \in K,

in which `P`, `q`, `d`, `A`, `b` are affine in the parameters. The affine maps are taken out of cvxpy once; a later
solve needs only a few sparse products, an update of Clarabel's data and the solve. Its dual point `z`, projected on the
dual cone, gives

.. math:: \min \ge d - \tfrac12 x^\top P x - b^\top z - \rho \, |P x + q + A^\top z|

for every minimiser with :math:`|x^*| \le \rho`, independent of the solver's report: the "optimal value" is never used
as a bound.

Threads may share a relaxation: each thread has separate numbers, and calls of cvxpy run one at a time.

Sources: A. Agrawal et al., "Differentiable convex optimization layers", NeurIPS 2019 (the affine maps); C. Jansson,
D. Chaykin and C. Keil, "Rigorous error bounds for the optimal value in semidefinite programming", SIAM J. Numer.
Anal. 46 (2007) (the bound, here with one radius for all of x); N. Parikh and S. Boyd, "Proximal algorithms", Found.
Trends Optim. 1 (2014), section 6.3 (the projection).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

from formulations.algebra import Array, Index
from formulations.backend import Ending, SolverError, choice_for, count, first_sentence, hold_in_forks, record
from formulations.conic_solvers import adapter, read_clarabel, solve_with_status
from formulations.cvxpy_access import LOCK, AffineMap, cone_program, dual_values
from formulations.solver_report import SolverReport

_Arguments = ParamSpec("_Arguments")
_Built = TypeVar("_Built")

# Number of cached problems: more sizes of one problem than a study mixes. Building takes 10 ms to 0.5 s. A problem
# takes less than 2 MB (moments of seven ranges, eight directions), or 20 MB (registration with eight windows, moving
# target).
_KEPT = 64


@dataclass(frozen=True, slots=True)
class ConicAnswer:
    """The result of one conic solve.

    Parameters
    ----------
    values : Mapping[str, Array]
        Values of the variables by name; NaN if the solver ended without a solution.
    primal : float
        Objective at the solution; NaN if there is none.
    bound : float
        Lower bound of the optimum, recomputed from the dual point; minus infinity if none is available.
    status : str
        Status in the solver's words.
    solved : bool
        Whether the solver met its full tolerances.
    iterations : int
        Interior-point (or other) iterations.
    report : SolverReport
        The solver's own report: status, residuals, gap, iterations and seconds.
    message : str
        Message of the solver, for instance the reason of a failure; empty if there is none.
    read_duals : callable
        Returns `duals`, which are computed when they are read.
    """

    values: Mapping[str, Array]
    primal: float
    bound: float
    status: str
    solved: bool
    iterations: int
    report: SolverReport
    message: str = ""
    read_duals: Callable[[], tuple[Array, ...]] = field(default=tuple, repr=False, compare=False)

    @property
    def duals(self) -> tuple[Array, ...]:
        """Return the dual value of each constraint, in the order of ``problem.constraints`` and in cvxpy's signs.

        A second-order cone has its parts in one vector. The tuple is empty if the solver ended without a dual point.
        """
        return self.read_duals()


class Relaxation:
    """One cvxpy problem with named parameters, solved many times.

    Parameters
    ----------
    problem : cvxpy.Problem
        A minimisation that is DPP; parameters and variables carry unique names. Linear, second-order and
        semidefinite cones.
    backend : str
        ``"CLARABEL"`` is fast; any other solver of cvxpy runs by ``problem.solve`` and gives no bound.
    settings : Mapping[str, Any], optional
        Settings of the back end.
    radius : float
        For the bound, every minimiser is assumed to be no longer than this factor times ``1 + |x|`` of the solution. A
        factor of two allows a solution whose error is its length. If a rigorous length is known, pass it as `reach`.

    Notes
    -----
    Agrawal et al. (2019). Threads may share a relaxation: each has separate numbers, no solve uses earlier results, and
    Clarabel releases the interpreter lock. So a result depends only on the data of its solve. Do not pickle.
    """

    def __init__(
        self,
        problem: Any,
        *,
        backend: str = "CLARABEL",
        settings: Mapping[str, Any] | None = None,
        radius: float = 2.0,
    ) -> None:
        self.problem, self.backend, self.settings, self.radius = problem, backend, dict(settings or {}), radius
        self.parameters = {parameter.name(): parameter for parameter in problem.parameters()}
        with LOCK:
            self._shared = Data(problem) if backend == "CLARABEL" else None
        self._own = threading.local()

    @property
    def _data(self) -> Data | None:
        """Return the numbers of this thread, copied at its first use; None if the back end is not Clarabel."""
        if self._shared is None:
            return None
        if not hasattr(self._own, "data"):
            self._own.data = self._shared.twin()
        own: Data = self._own.data
        return own

    def solve(self, values: Mapping[str, Array], *, bound: bool = True, reach: float | None = None) -> ConicAnswer:
        """Return the solution for new parameter values.

        Parameters
        ----------
        values : Mapping[str, Array]
            Values of every parameter, by name.
        bound : bool
            Whether to recompute the lower bound from the dual; without it the bound is minus infinity.
        reach : float, optional
            Known greatest length of the variables at any minimiser. It replaces ``radius (1 + |x|)`` and makes the
            bound rigorous.

        Returns
        -------
        ConicAnswer
            Point, value, bound and status; a failure is reported here, not raised.
        """
        if values.keys() != self.parameters.keys():
            raise ValueError(f"parameters {sorted(values)} given, {sorted(self.parameters)} expected")
        choice, data = choice_for("conic"), self._data
        backend, settings = (self.backend, self.settings) if choice is None else (choice.name, dict(choice.settings))
        if data is None or backend != "CLARABEL":
            with LOCK:
                answer = self._solve_by_cvxpy(values, backend, settings)
        else:
            answer = self._solve_by_clarabel(data, values, {**self.settings, **settings}, bound=bound, reach=reach)
        count(backend, answer.iterations)
        record(Ending(backend, answer.status, answer.message, bool(np.isfinite(answer.primal))))
        return answer

    def _solve_by_clarabel(
        self,
        data: Data,
        values: Mapping[str, Array],
        settings: Mapping[str, Any],
        *,
        bound: bool,
        reach: float | None,
    ) -> ConicAnswer:
        """Return the solution by Clarabel, without cvxpy; see `solve` for `values`, `bound` and `reach`."""
        data.feed(values)
        try:
            solution = _solver(data, settings).solve()
            if str(solution.status) == "NumericalError":
                solution = _solver(data, {**_REGULAR, **settings}).solve()
        except Exception as trouble:  # any failure of a solver that was built
            record(Ending("CLARABEL", "error", first_sentence(trouble), found=False))
            raise SolverError(f"Clarabel failed: {trouble}") from trouble
        x, z, status = np.array(solution.x), np.array(solution.z), str(solution.status)
        if not (np.isfinite(x).all() and np.isfinite(z).all()):
            x, z = np.full(len(x), np.nan), np.full(len(z), np.nan)
        far = self.radius * (1.0 + float(np.sqrt(x @ x))) if reach is None else reach
        # any dual point bounds the optimum, for every status of the solver
        low = data.bound(x, z, far) if bound else -np.inf
        # the last iterate of a failed solve is not a solution
        at = x if status in _MET else np.full(len(x), np.nan)
        quadratic = float(at @ data.square(at))
        primal = 0.5 * quadratic + float(data.q @ at) + data.d
        report = read_clarabel(solution)
        duals = partial(data.shared.duals, z) if np.isfinite(z).all() else tuple
        return ConicAnswer(
            data.recover(at), primal, low, status, status == "Solved", report.iterations, report, "", duals
        )

    def _solve_by_cvxpy(self, values: Mapping[str, Array], backend: str, settings: Mapping[str, Any]) -> ConicAnswer:
        """Return the solution by another back end through cvxpy; it has no lower bound."""
        for name, value in values.items():
            self.parameters[name].value = value
        try:
            # a start at the previous solution would make results depend on their order
            report, status = solve_with_status(self.problem, backend, settings)
        except ValueError as trouble:
            report, status = SolverReport(backend, "error", message=str(trouble)), "solver_error"
        good = report.outcome == "solved" or (report.outcome == "inaccurate" and adapter(backend).reduced)
        found = {v.name(): v.value for v in self.problem.variables()} if good else {}
        good = good and all(value is not None and np.isfinite(value).all() for value in found.values())
        point = {
            v.name(): np.array(found[v.name()], dtype=np.float64) if good else np.full(v.shape, np.nan)
            for v in self.problem.variables()
        }
        primal = float(self.problem.value) if good else np.nan
        duals = dual_values(self.problem) if good else ()
        solved = good and report.outcome == "solved"
        return ConicAnswer(point, primal, -np.inf, status, solved, report.iterations, report, report.message,
                           lambda: duals)  # fmt: skip


# Statuses of Clarabel with a solution: its tolerances are met, or its reduced tolerances (5e-5 of the gap, 1e-4 of
# feasibility). It also checks them if it stops at a limit or makes no progress.
_MET = ("Solved", "AlmostSolved")
# For a second attempt if the factorisation lost its digits: ten times the default of 1e-8. Relaxations of Doppler
# shifts of satellites then meet the full tolerances, with a third more iterations.
_REGULAR = {"static_regularization_constant": 1e-7}


def _solver(data: Data, settings: Mapping[str, Any]) -> Any:
    """Return a Clarabel solver for the data, with settings that keep the dual point valid for the bound."""
    import clarabel

    own = clarabel.DefaultSettings()
    # after a presolve or a decomposition, the multipliers would belong to another problem than the one used for bounds
    own.verbose, own.presolve_enable, own.chordal_decomposition_enable = False, False, False
    own.max_threads = 1  # threads make such small problems slower; several problems run in parallel instead
    for name, value in settings.items():
        setattr(own, name, value)
    return clarabel.DefaultSolver(data.P, data.q, data.A, data.b, data.cones, own)


def keep(build: Callable[_Arguments, _Built]) -> Callable[_Arguments, _Built]:
    """Cache a function, so that it runs once for each set of arguments in each process, also with threads.

    Parameters
    ----------
    build : callable
        A function with hashable arguments, which is decorated.

    Returns
    -------
    callable
        The same function with a cache of its 64 most recently used results.
    """

    def alone(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Built:
        """Build while no other thread uses cvxpy."""
        with LOCK:
            return build(*args, **kwargs)

    # A cached result waits only for builds of the same function. Without this lock two threads would build it twice.
    cached, lock = lru_cache(_KEPT)(alone), threading.Lock()
    hold_in_forks(lock)

    @wraps(build)
    def once(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Built:
        """Return the cached result, and build it at the first call."""
        with lock:
            return cached(*args, **kwargs)  # type: ignore[arg-type]  # arguments are hashable

    return once


def tight(backend: str, tolerance: float, **more: float) -> dict[str, float]:
    """Return settings with which Clarabel stops at one relative tolerance; other back ends keep their defaults.

    Parameters
    ----------
    backend : str
        Conic solver.
    tolerance : float
        Tolerance of the gap, absolute and relative, and of feasibility. The default of Clarabel is 1e-8.
    **more
        Further settings of Clarabel.

    Returns
    -------
    dict
        Settings of a `Relaxation`.
    """
    if backend != "CLARABEL":
        return {}
    return {"tol_gap_abs": tolerance, "tol_gap_rel": tolerance, "tol_feas": tolerance, **more}


def rank_ratio(lift: Array) -> float:
    """Return the second over the first eigenvalue of a lift, which is near zero if the relaxation is tight.

    Parameters
    ----------
    lift : Array, shape (n, n)
        Symmetric matrix.

    Returns
    -------
    float
        The ratio; NaN if the solver gave no lift.
    """
    if not np.isfinite(lift).all():
        return np.nan
    values = np.linalg.eigvalsh(lift)
    return float(abs(values[-2]) / values[-1])


# The data of a cvxpy problem.


class Data:
    """Clarabel's data as affine functions of the parameters of a cvxpy problem, with a fixed sparsity pattern.

    Parameters
    ----------
    problem : cvxpy.Problem
        A minimisation that follows cvxpy's rules for parameters (DPP).

    Notes
    -----
    Agrawal et al. (2019). `feed` writes into the arrays `P`, `q`, `d`, `A`, `b`, so each thread needs a separate
    `twin`.
    """

    def __init__(self, problem: Any) -> None:
        import cvxpy
        import scipy.sparse as sp

        for parameter in problem.parameters():
            if parameter.value is None:
                parameter.value = np.zeros(parameter.shape)
        if not (problem.is_dcp(dpp=True) and isinstance(problem.objective, cvxpy.Minimize)):
            raise ValueError("the problem must be a minimisation that follows cvxpy's rules for parameters (DPP)")
        self.shared = program = cone_program(problem)
        self.dims, self.cones, self.slots = program.dims, program.cones, program.slots
        # all parameters in one vector, followed by a one for the constants of the affine maps
        self.vector = np.zeros(program.length + 1)
        self.vector[-1] = 1.0
        n = program.size
        self._linear = _Product.of(program.linear)
        # cvxpy stores [A, b] as one sparse matrix: the columns of A, then the column b
        self._matrix, pattern = _Product.of(program.constraints.matrix), program.constraints
        m = pattern.shape[0]
        self.q, self.d, self.b = np.zeros(n), 0.0, np.zeros(m)
        last = pattern.starts[n]
        self._left, self._rows = slice(0, last), pattern.rows[last:]
        self._quadratic: _Product | None = None
        self._upper = np.zeros(0, dtype=np.int64)
        self.A = sp.csc_array((np.zeros(last), pattern.rows[:last], pattern.starts[: n + 1]), shape=(m, n))
        self.P = sp.csc_array((n, n))
        if program.quadratic is not None:
            self._quadratic = _Product.of(program.quadratic.matrix)
            self._upper, self.P = _upper_triangle(program.quadratic)
        self.across, self.below = _Product.transposed(self.A), _Product.transposed(self.P)
        self.above = _Product(n, self.below.source, self.below.row, self.P.data)
        # P x is the triangle times x plus its transpose times x, less the diagonal, which both contain
        self._ridge = np.where(self.below.row == self.below.source, 0.0, 1.0)
        self._recover = program.recovery

    def feed(self, values: Mapping[str, Array]) -> None:
        """Write the data for new parameter values.

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
        # cvxpy writes A x + b in K, Clarabel A x + s = b with s in K: the sign of A changes
        entries = self._matrix(self.vector)
        self.A.data[:] = -entries[self._left]
        self.b = np.zeros(self.A.shape[0])
        self.b[self._rows] = entries[self._left.stop :]
        if self._quadratic is not None:
            self.P.data[:] = self._quadratic(self.vector)[self._upper]

    def twin(self) -> Data:
        """Return the same problem with separate arrays, for another thread; the affine maps are shared."""
        other = copy(self)
        other.vector, other.A = self.vector.copy(), self.A.copy()
        other.P = self.P.copy()
        other.across = replace(self.across, data=other.A.data)
        other.below, other.above = (replace(one, data=other.P.data) for one in (self.below, self.above))
        return other

    def square(self, x: Array) -> Array:
        """Return the product ``P x`` (n,) from the stored upper triangle."""
        if self._quadratic is None:
            return np.zeros_like(x)
        return self.below(x) + self.above(x, self._ridge)

    def bound(self, x: Array, z: Array, reach: float) -> float:
        """Return a lower bound of the optimum from a dual point.

        Parameters
        ----------
        x, z : Array, shapes (n,) and (m,)
            Primal point (its quadratic term only) and dual point.
        reach : float
            Assumed greatest length of the minimiser.

        Returns
        -------
        float
            The bound; minus infinity if the dual point gives none.

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
        """Return the values of the variables by name at a point x (n,) of the solver, one array for each variable."""
        return {name: (matrix @ x).reshape(shape, order="F") for name, matrix, shape in self._recover}


@dataclass(frozen=True, slots=True)
class _Product:
    """Products of a sparse matrix with vectors; with tens of entries, products of scipy take longer than the solver.

    Entry i is `data[i]`, in row `row[i]` and column `source[i]`; `size` is the number of rows.
    """

    size: int
    row: Index
    source: Index
    data: Array

    @classmethod
    def of(cls, matrix: Any) -> _Product:
        """Return the products with a sparse matrix of scipy."""
        entries = matrix.tocoo()
        return cls(matrix.shape[0], entries.row.astype(np.int64), entries.col.astype(np.int64), entries.data)

    @classmethod
    def transposed(cls, matrix: Any) -> _Product:
        """Return the transpose of a compressed-column matrix, which shares its entries."""
        size = matrix.shape[1]
        column = np.repeat(np.arange(size), np.diff(matrix.indptr))
        return cls(size, column, matrix.indices.astype(np.int64), matrix.data)

    def __call__(self, x: Array, share: Array | float = 1.0) -> Array:
        """Return the product with x, with each entry of the matrix multiplied by `share`."""
        total = np.bincount(self.row, weights=self.data * x[self.source] * share, minlength=self.size)
        return np.asarray(total, dtype=np.float64)


def _upper_triangle(pattern: AffineMap) -> tuple[Index, Any]:
    """Return the positions of the entries of the upper triangle of P among its entries, and the triangle, zero.

    Clarabel takes the upper triangle of P only.
    """
    import scipy.sparse as sp

    n = pattern.shape[1]
    column = np.repeat(np.arange(n), np.diff(pattern.starts))
    upper = np.flatnonzero(pattern.rows <= column)
    row, column = pattern.rows[upper], column[upper]
    start = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=n))])
    return upper, sp.csc_array((np.zeros(len(row)), row, start), shape=(n, n))


# Projection on the dual of a product of cones, which makes the dual point of a solver feasible.


def dual_point(z: Array, dims: Any) -> Array:
    """Return the projection of a point on the dual cone.

    Parameters
    ----------
    z : Array, shape (m,)
        Dual point in Clarabel's order: zero, nonnegative, second-order and semidefinite cones.
    dims : Any
        cvxpy's ``ConeDims``.

    Returns
    -------
    Array, shape (m,)
        The nearest dual feasible point; NaN in the rows of any other cone.

    Notes
    -----
    Parikh and Boyd (2014), section 6.3.
    """
    z, at = z.copy(), int(dims.zero)
    z[at : at + dims.nonneg] = np.maximum(z[at : at + dims.nonneg], 0.0)
    at += int(dims.nonneg)
    for size in dims.soc:
        z[at : at + size] = _second_order(z[at : at + size])
        at += int(size)
    for size in dims.psd:
        count = size * (size + 1) // 2
        z[at : at + count] = _semidefinite(z[at : at + count], size)
        at += count
    if at != len(z):
        z[at:] = np.nan
    return z


def _second_order(z: Array) -> Array:
    """Return the projection of z on the second-order cone ``z_0 >= |(z_1, z_2, ...)|``."""
    size = float(np.linalg.norm(z[1:]))
    if size <= z[0]:
        return z
    if size <= -z[0]:
        return np.zeros_like(z)
    half = 0.5 * (1.0 + z[0] / size)
    return np.concatenate([[half * size], half * z[1:]])


def _semidefinite(z: Array, size: int) -> Array:
    """Return the projection of z, a scaled upper triangle by columns, on the cone of `size` x `size` matrices."""
    if not np.isfinite(z).all():
        return z
    column, row, scale = _triangle(size)
    matrix = np.empty((size, size))
    matrix[row, column] = matrix[column, row] = z * scale
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(matrix)
    else:
        # the usual case: the dual point of an interior-point method is strictly inside
        return z
    fixed = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(fixed[row, column] / scale)


@lru_cache(_KEPT)
def _triangle(size: int) -> tuple[Index, Index, Array]:
    """Return columns and rows of a stored upper triangle (`size` x `size`), and the factor of its stored entries.

    The factor gives the entries of the matrix: one on the diagonal, and the root of a half elsewhere.
    """
    column, row = np.tril_indices(size)
    return column, row, np.where(row == column, 1.0, np.sqrt(0.5))
