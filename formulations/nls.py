r"""Weighted nonlinear least squares with bounds, equalities and inequalities, as a CasADi program for IPOPT.

.. math:: \min_x \; |W\, e(x, p, z)|^2 + (x - m)^\top M (x - m) \quad\text{subject to}\quad
   l \le x \le u, \quad c(x, p) = 0, \quad d(x, p) \ge 0,

with :math:`e = z - h(x, p)` unless another residual is given (residuals of angles must be wrapped). The functions h, c,
d are arguments of the program; CasADi differentiates them exactly. Data, weights, prior, bounds and start are arguments
of the solve, so that a program is compiled once per structure. Threads may share a program: they take turns.

Sources: A. Waechter and L. T. Biegler, "On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming", Math. Program. 106 (2006); J. A. E. Andersson et al., "CasADi", Math. Program.
Comput. 11 (2019), section 5 (code generation).
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array
from formulations.backend import Choice, Ending, SolverError, count, first_sentence, hold_in_forks, record
from formulations.nonlinear_solvers import nonlinear_report, silent, status_of
from formulations.solver_report import SolverReport

Function = Callable[[Any, Any], Any]
Residual = Callable[[Any, Any, Any], Any]

_QUIET = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False, "calc_lam_p": False}
# CasADi's own solver of quadratic programs: others print, or end with an error where a program has no solution.
_QRQP = {
    "qpsol": "qrqp",
    "qpsol_options": {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False},
}
# Options that suppress output of CasADi's solvers and keep their inner solvers from failing. The tolerance of IPOPT is
# two decades below its default of 1e-8, because its solutions verify those of a Gauss-Newton iteration.
_SILENCE: dict[str, dict[str, Any]] = {
    "ipopt": {"ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10}},
    "sqpmethod": {
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
        **_QRQP,
        "hessian_approximation": "exact",
        "convexify_strategy": "regularize",
    },
    "feasiblesqpmethod": {
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
        **_QRQP,
        "hessian_approximation": "exact",
        "convexify_strategy": "regularize",
    },
    "qrsqp": {"print_header": False, "print_iteration": False, **_QRQP},
    # updates that need no Schur complement: it needs a linear solver of HSL, which CasADi does not include
    "blocksqp": {"print_header": False, "print_iteration": False, "schur": False, "hess_update": 2},
    "fatrop": {"fatrop": {"print_level": 0}},
    "uno": {"uno": {"logger": "SILENT"}},
}
# Violation of a constraint, in its unit of order one, from which a point is not a solution, even if the solver reports
# success: ten times the loosest tolerance, 1e-4 of IPOPT.
_BROKEN = 1e-3

_COMPILERS = ("cc", "gcc", "clang")
_PATIENCE = 600.0  # time limit of the compiler, seconds; 200 rows take about 10, large programs longer


@dataclass(frozen=True, slots=True)
class Local:
    """A local solution.

    Parameters
    ----------
    x : Array, shape (n,)
        The solution; if `success` is False, the last iterate.
    cost : float
        ``|We|^2`` plus the prior term.
    bounds : Array, shape (n,)
        Multipliers of the bounds: positive at an upper, negative at a lower bound. The gradient of the cost plus all
        multipliers times the gradients of their constraints is zero.
    equalities, inequalities : Array
        Multipliers of ``c = 0`` and ``d >= 0``; the latter are at most zero.
    status : str
        Status in the solver's words, and any contradiction to it.
    success : bool
        True if the solver met its tolerances, the point satisfies the constraints and the cost has a gradient there.
    iterations : int
        Interior-point iterations.
    report : SolverReport
        The solver's report; only IPOPT and Uno pass on their residuals.
    """

    x: Array
    cost: float
    bounds: Array
    equalities: Array
    inequalities: Array
    status: str
    success: bool
    iterations: int
    report: SolverReport


@dataclass(frozen=True, slots=True)
class NonlinearStatement:
    """A nonlinear program as expressions of CasADi.

    Parameters
    ----------
    x, p : casadi.SX
        Unknowns (n, 1), and all numbers that change between solves.
    f : casadi.SX
        Cost.
    equalities, inequalities : casadi.SX
        Columns c and d of ``c = 0`` and ``d >= 0``.
    white : casadi.SX
        Residuals (m, 1) in standard deviations.
    """

    x: Any
    p: Any
    f: Any
    equalities: Any
    inequalities: Any
    white: Any

    @property
    def g(self) -> Any:
        """Return the column of all constraints, the equalities first."""
        import casadi as ca

        return ca.vertcat(self.equalities, self.inequalities)


class Program:
    """A compiled least-squares program, solved many times with new data.

    Parameters
    ----------
    n, m, p : int
        Numbers of unknowns, measurements and parameters.
    h : callable, optional
        ``h(x, p)`` on CasADi symbols (column vectors), giving m expressions as a list or a column.
    residual : callable, optional
        ``residual(x, p, z)``, m expressions, instead of ``z - h(x, p)``.
    penalty : callable, optional
        ``q(x, p)``, a smooth expression that is added to the cost.
    equalities, inequalities : callable, optional
        ``c(x, p)`` and ``d(x, p)``, lists or columns of expressions.
    diagonal : bool
        True: W is a vector of m weights; False: W is an m by m matrix.
    settings : Mapping[str, Any], optional
        IPOPT settings, for instance ``{"max_iter": 200}``.
    choice : Choice, optional
        Another nonlinear solver of CasADi with its settings, instead of IPOPT and `settings`.
    compiled : bool
        Compile the functions to machine code with the C compiler of the system. A solve of 200 rows then takes half the
        time, but the compiler takes about 10 s. The attribute of this name is True if the compilation succeeded. If
        not, CasADi interprets the functions, as by default.

    Notes
    -----
    Waechter and Biegler (2006). Threads may share a program: they solve one after the other. Do not pickle.
    """

    def __init__(
        self,
        n: int,
        m: int,
        p: int = 0,
        h: Function | None = None,
        *,
        residual: Residual | None = None,
        penalty: Function | None = None,
        equalities: Function | None = None,
        inequalities: Function | None = None,
        diagonal: bool = True,
        settings: Mapping[str, Any] | None = None,
        choice: Choice | None = None,
        compiled: bool = False,
    ) -> None:
        if (h is None) == (residual is None):
            raise ValueError("give either h or residual")
        self.n, self.m, self.p, self.diagonal = n, m, p, diagonal
        given = (lambda x, p, z: z - _column(h(x, p), m)) if h is not None else residual
        assert given is not None
        self._prepare(_state(self, given, penalty, equalities, inequalities), choice, settings or {}, compiled)

    @classmethod
    def of(
        cls,
        program: Program,
        statement: NonlinearStatement,
        *,
        choice: Choice | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> Program:
        """Return a program with another cost or more constraints, and the numbers of an earlier program.

        Parameters
        ----------
        program : Program
            The earlier program: sizes, and the order of the numbers p.
        statement : NonlinearStatement
            Expressions in the symbols x and p of its statement.
        choice : Choice, optional
            Another nonlinear solver of CasADi with its settings.
        settings : Mapping[str, Any], optional
            IPOPT settings.
        """
        changed = cls.__new__(cls)
        changed.n, changed.m, changed.p, changed.diagonal = program.n, program.m, program.p, program.diagonal
        changed._prepare(statement, choice, settings or {}, compiled=False)  # noqa: SLF001  (own class)
        return changed

    def _prepare(
        self, statement: NonlinearStatement, choice: Choice | None, settings: Mapping[str, Any], compiled: bool
    ) -> None:
        """Build the solver of a statement; arguments as in the class."""
        import casadi as ca

        self.statement, x, data = statement, statement.x, statement.p
        self._equal, self._more = statement.equalities.shape[0], statement.inequalities.shape[0]
        program = {"x": x, "p": data, "f": statement.f, "g": statement.g}
        self._name = "ipopt" if choice is None else choice.name
        options = _options(choice, settings)
        broken = ca.vertcat(statement.equalities, ca.fmin(statement.inequalities, 0.0))
        self._check = ca.Function("check", [x, data], [ca.gradient(statement.f, x), broken])
        with silent(self._name):
            solver = ca.nlpsol("nls", self._name, program, options)
            faster = _compile(self._name, solver, options) if compiled else None
        self.compiled = faster is not None
        self._solver = solver if faster is None else faster
        # CasADi releases the interpreter lock while it solves. The solver has one memory, which simultaneous threads
        # would corrupt, and one report of its last solve.
        self.lock = threading.Lock()
        _LOCKS.programs.add(self)

    def data(
        self,
        z: ArrayLike,
        weight: ArrayLike | None = None,
        p: ArrayLike = (),
        prior: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> Array:
        """Return the numbers of the symbols p of the statement; arguments as in `solve`."""
        identity = np.ones(self.m) if self.diagonal else np.eye(self.m)
        mean, information = prior if prior is not None else (np.zeros(self.n), np.zeros((self.n, self.n)))
        return np.concatenate(
            [
                _check("p", p, (self.p,)),
                _check("z", z, (self.m,)),
                _check("weight", identity if weight is None else weight, identity.shape).ravel(order="F"),
                _check("prior mean", mean, (self.n,)),
                _check("prior information", information, (self.n, self.n)).ravel(order="F"),
            ]
        )

    def solve(
        self,
        start: ArrayLike,
        z: ArrayLike,
        weight: ArrayLike | None = None,
        p: ArrayLike = (),
        *,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        prior: tuple[ArrayLike, ArrayLike] | None = None,
        multipliers: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> Local:
        """Return a local solution for new data.

        Parameters
        ----------
        start : array_like, shape (n,)
            First iterate.
        z : array_like, shape (m,)
            Measurements.
        weight : array_like, shape (m,) or (m, m), optional
            W; ones (the identity) if absent. A zero weight drops a row.
        p : array_like, shape (p,)
            Parameters of h, c and d.
        lower, upper : array_like, shape (n,), optional
            Bounds; infinite if absent.
        prior : pair of array_like, shapes (n,) and (n, n), optional
            Mean m and information matrix M.
        multipliers : pair of array_like, shapes (n,) and (constraints,), optional
            First multipliers of the bounds, and of equalities and inequalities, with the signs of `Local`; zeros if
            absent. They help a solver that starts warm.

        Returns
        -------
        Local
            A local minimiser, or the last iterate and the reason of the failure. At a start without a finite gradient
            no solver runs.
        """
        data = self.data(z, weight, p, prior)
        constraints = self._equal + self._more
        first, second = multipliers if multipliers is not None else (np.zeros(self.n), np.zeros(constraints))
        given = {
            "x0": _check("start", start, (self.n,)),
            "p": data,
            "lbx": _check("lower", np.full(self.n, -np.inf) if lower is None else lower, (self.n,)),
            "ubx": _check("upper", np.full(self.n, np.inf) if upper is None else upper, (self.n,)),
            "lam_x0": _check("multipliers of bounds", first, (self.n,)),
            "lam_g0": _check("multipliers", second, (constraints,)),
            "lbg": np.zeros(constraints),
            "ubg": np.concatenate([np.zeros(self._equal), np.full(self._more, np.inf)]),
        }
        if not np.isfinite(self._check(given["x0"], data)[0].full()).all():
            # a solver may never return from such a start, as fatrop does
            return self._without_gradient(given["x0"], data)
        try:
            with self.lock, silent(self._name):
                found, stats = self._solver(**given), self._solver.stats()
            status = status_of(stats)
        except RuntimeError as trouble:  # CasADi raises no other type
            record(Ending(self._name, "error", first_sentence(trouble), found=False))
            raise SolverError(f"{self._name} failed: {trouble}") from trouble
        except KeyError as trouble:
            record(Ending(self._name, "error", "it reports no status", found=False))
            raise SolverError(f"{self._name} failed: it reports no status") from trouble
        iterations = int(stats.get("iter_count", 0))
        count(self._name, iterations)
        against = self._contradiction(found["x"], data, status) if stats["success"] else ""
        status = f"{status}, but {against}" if against else status
        success = bool(stats["success"]) and not against
        record(Ending(self._name, status, "", success))
        reached = _numbers(found["lam_g"])
        return Local(
            x=_numbers(found["x"]),
            cost=float(found["f"]),
            bounds=_numbers(found["lam_x"]),
            equalities=reached[: self._equal],
            inequalities=reached[self._equal :],
            status=status,
            success=success,
            iterations=iterations,
            report=nonlinear_report(self._name, stats, status, success=success),
        )

    def _without_gradient(self, start: Array, data: Array) -> Local:
        """Return a failure at a start where the cost has no finite gradient; `data` are the parameters of the solve."""
        status = "the cost has no gradient at the start"
        record(Ending(self._name, status, "", found=False))
        report = SolverReport(self._name, status)
        bounds, equalities, inequalities = np.zeros(self.n), np.zeros(self._equal), np.zeros(self._more)
        return Local(
            start, np.nan, bounds, equalities, inequalities, status, success=False, iterations=0, report=report
        )

    def _contradiction(self, x: Any, data: Array, status: str) -> str:
        """Return the reason why a point is not a solution although the solver reports success; "" if there is none.

        Some solvers report success at their time limit, or at a start without a gradient. `data` are the parameters of
        the solve, `status` is the status in the solver's words.
        """
        if "limit" in status.lower():
            return "it stopped at a limit"
        slope, broken = (_numbers(value) for value in self._check(x, data))
        if not np.isfinite(slope).all():
            return "the cost has no gradient at this point"
        return "" if np.abs(broken).max(initial=0.0) <= _BROKEN else "the constraints are not met"


def _state(
    program: Program,
    residual: Residual,
    penalty: Function | None,
    equalities: Function | None,
    inequalities: Function | None,
) -> NonlinearStatement:
    """Return the expressions of a program of the given size; the functions are as in `Program`."""
    import casadi as ca

    n, m = program.n, program.m
    x, given, z = ca.SX.sym("x", n), ca.SX.sym("p", program.p), ca.SX.sym("z", m)
    weight = ca.SX.sym("W", m, 1 if program.diagonal else m)
    mean, information = ca.SX.sym("mean", n), ca.SX.sym("M", n, n)
    misfit = _column(residual(x, given, z), m)
    c = _column(equalities(x, given)) if equalities else ca.SX(0, 1)
    d = _column(inequalities(x, given)) if inequalities else ca.SX(0, 1)
    # common subexpressions are computed once: derivatives of courses over ground then have a seventh of the length
    misfit, c, d = ca.cse([misfit, c, d])
    white = weight * misfit if program.diagonal else weight @ misfit
    cost = ca.sumsqr(white) + ca.bilin(information, x - mean, x - mean)
    cost += 0.0 if penalty is None else penalty(x, given)
    # one parameter vector contains all numbers that change between solves, so the program is built and compiled once
    data = ca.vertcat(given, z, ca.vec(weight), mean, ca.vec(information))
    return NonlinearStatement(x, data, cost, c, d, white)


class _Locks:
    """The locks of all programs as one lock; a fork waits until their solves have ended."""

    def __init__(self) -> None:
        self.programs: WeakSet[Program] = WeakSet()
        self.held: list[threading.Lock] = []

    def acquire(self) -> None:
        """Acquire the locks of all programs."""
        self.held = [program.lock for program in self.programs]
        for lock in self.held:
            lock.acquire()

    def release(self) -> None:
        """Release the locks of all programs."""
        for lock in self.held:
            lock.release()


_LOCKS = _Locks()
hold_in_forks(_LOCKS)


def _options(choice: Choice | None, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a CasADi solver: options that suppress output, then settings of the choice or `settings`.

    The options of IPOPT are in a separate table.
    """
    name = "ipopt" if choice is None else choice.name
    own = dict(settings if choice is None else choice.settings)
    silent = _SILENCE.get(name, {})
    if name == "ipopt":
        return {**_QUIET, "ipopt": {**silent["ipopt"], **own}}
    return {**_QUIET, **silent, **own}


def _column(expressions: Any, count: int | None = None) -> Any:
    """Return expressions as one CasADi column; raise ValueError if there are not `count` of them."""
    import casadi as ca

    listed = isinstance(expressions, Sequence)
    column = ca.vertcat(*expressions) if listed else ca.vec(ca.SX(expressions))
    if count is not None and column.shape[0] != count:
        raise ValueError(f"{column.shape[0]} expressions given, {count} measurements expected")
    return column


def _check(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return a value as an array; raise ValueError if its shape is wrong."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, {shape} expected")
    return array


def _numbers(value: Any) -> Array:
    """Return values of CasADi as a vector."""
    return np.asarray(value.full(), dtype=np.float64).ravel()


def _compile(name: str, solver: Any, options: dict[str, Any]) -> Any:
    """Return a CasADi solver with its functions compiled to machine code, or None if no compiler succeeds.

    `name` and `options` are the plugin and the options of `solver`.
    """
    import casadi as ca

    compiler = next((found for found in map(shutil.which, _COMPILERS) if found), None)
    if compiler is None:
        return None
    generator = ca.CodeGenerator("program.c")
    generator.add(solver.oracle())
    for part in solver.get_function():
        generator.add(solver.get_function(part))
    with tempfile.TemporaryDirectory(prefix="casadi", ignore_cleanup_errors=True) as folder:
        source, library = Path(folder) / "program.c", Path(folder) / "program.so"
        source.write_text(generator.dump(), encoding="utf-8")
        # for 200 ranges, -O2 took 2.4 times as long to compile and was not faster; -O0 solved at a third of the speed
        command = [compiler, "-O1", "-shared", "-fPIC", str(source), "-o", str(library), "-lm"]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=_PATIENCE)  # noqa: S603  (no shell)
            # loaded code stays in memory after its file is deleted
            return ca.nlpsol("nls", name, str(library), options)
        except (subprocess.SubprocessError, OSError, RuntimeError):
            return None
