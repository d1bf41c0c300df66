"""Adapters of conic solvers: cones, quiet settings, and the report from the solver's own solution object.

cvxpy passes on neither the residuals nor the dual objective of most solvers. So a solve has three steps: cvxpy compiles
the problem, the solver solves it, the adapter reads the solution object, and cvxpy writes the values back.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from time import perf_counter
from typing import Any

import numpy as np

from formulations import cvxpy_access
from formulations.backend import first_sentence
from formulations.cvxpy_access import LOCK, Compiled
from formulations.solver_report import Outcome, SolverReport, relative_gap

Reading = tuple[str, float, float, float, int, float]
"""Status, primal residual, dual residual, relative gap, iterations and seconds of a solution object."""


@dataclass(frozen=True, slots=True)
class ConicSolver:
    """The adapter of one solver of cvxpy.

    Parameters
    ----------
    name : str
        Name in cvxpy.
    package : str
        Distribution that installs it.
    cones : frozenset of str
        Supported cones, as in `formulations.cvxpy_access.cones_of`.
    summary : str
        Method and source, for listings.
    read : callable, optional
        Returns the numbers of the solver's own solution object; without it, cvxpy's numbers are used.
    quiet : Mapping[str, Any]
        Settings that suppress output.
    takes_start : bool
        Whether the solver can start at a previous solution. Interior-point methods cannot.
    reduced : bool
        Whether an inaccurate solution meets reduced tolerances. If not, it may be any last iterate.
    prepare : callable, optional
        Runs before each solve.
    own : callable, optional
        Solves the compiled problem without cvxpy, which would drop the solver's report.
    convert : callable
        Converts the result of `own` to the form that cvxpy reads.
    """

    name: str
    package: str
    cones: frozenset[str]
    summary: str
    read: Callable[[Any], Reading] | None = None
    quiet: Mapping[str, Any] = field(default_factory=dict)
    takes_start: bool = False
    reduced: bool = False
    prepare: Callable[[], None] | None = None
    own: Callable[[Compiled, dict[str, Any]], Any] | None = None
    convert: Callable[[Any], Any] = lambda found: found

    def solves(self) -> str:
        """Return the problems that the solver solves, in words."""
        return solved_by(self.name, self.cones)


def solved_by(name: str, cones: frozenset[str]) -> str:
    """Return the problems that a solver solves, in words.

    Parameters
    ----------
    name : str
        Name of the solver in cvxpy.
    cones : frozenset of str
        Its cones.

    Returns
    -------
    str
        For instance ``"linear, quadratic, second-order cone and semidefinite programs"``.
    """
    names = {
        "second-order": "second-order cone",
        "semidefinite": "semidefinite",
        "exponential": "exponential cone",
        "power": "power cone",
    }
    quadratic = cvxpy_access.solves_quadratic_objectives(name) or "second-order" in cones
    words = ["linear", *(["quadratic"] if quadratic else []), *(word for cone, word in names.items() if cone in cones)]
    joined = " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
    return f"{joined} programs" if len(cones) > 1 else f"{joined} programs only"


def _clarabel(found: Any) -> Reading:
    """Return the numbers of a solution of Clarabel; its residuals are relative."""
    gap = relative_gap(found.obj_val, found.obj_val_dual)
    return str(found.status), found.r_prim, found.r_dual, gap, found.iterations, found.solve_time


def _scs(found: Any) -> Reading:
    """Return the numbers of a result of SCS; its residuals are absolute, its times are in milliseconds."""
    info = found["info"]
    gap = relative_gap(info["pobj"], info["dobj"])
    seconds = 1e-3 * (info["setup_time"] + info["solve_time"])
    return str(info["status"]), info["res_pri"], info["res_dual"], gap, info["iter"], seconds


def _cvxopt(found: Any) -> Reading:
    """Return the numbers of a result of CVXOPT; its residuals are relative, and it reports no time."""
    primal, dual = (found.get(f"{side} objective") for side in ("primal", "dual"))
    gap = np.nan if primal is None or dual is None else relative_gap(primal, dual)
    residuals = [_number(found.get(f"{side} infeasibility")) for side in ("primal", "dual")]
    return str(found["status"]), residuals[0], residuals[1], gap, int(found.get("iterations", 0)), found["seconds"]


def _cvxopt_conelp(form: Compiled, settings: dict[str, Any]) -> Any:
    """Return the result of CVXOPT's ``conelp`` with the seconds of the call; cvxpy would drop its residuals."""
    import cvxopt.solvers

    given = dict(settings)
    if "max_iters" in given:  # cvxpy's name of this setting
        given["maxiters"] = given.pop("max_iters")
    kkt = given.pop("kktsolver", None)
    unknown = sorted(given.keys() - _CVXOPT_SETTINGS)
    if unknown:  # CVXOPT would ignore it
        raise TypeError(f"unknown setting {unknown[0]!r} of CVXOPT; it has {', '.join(sorted(_CVXOPT_SETTINGS))}")
    # one step of refinement, which cvxpy also requires
    options = {"show_progress": False, "refinement": 1, **given}
    start = perf_counter()
    try:
        found = dict(cvxopt.solvers.conelp(**cvxpy_access.cvxopt_matrices(form), kktsolver=kkt, options=options))
    except (ValueError, ArithmeticError) as trouble:  # equations that depend on each other, or a singular matrix
        found = {"status": "unknown", "message": first_sentence(trouble)}
    return {**found, "seconds": perf_counter() - start}


_CVXOPT_SETTINGS = frozenset({"maxiters", "abstol", "reltol", "feastol", "refinement", "show_progress", "debug"})


def _qoco(found: Any) -> Reading:
    """Return the numbers of a solution of QOCO; its residuals and its gap are absolute."""
    gap = abs(found.gap) / max(1.0, abs(found.obj))
    seconds = found.setup_time_sec + found.solve_time_sec
    return str(found.status), found.pres, found.dres, gap, found.iters, seconds


def _osqp(found: Any) -> Reading:
    """Return the numbers of a result of OSQP; its residuals are absolute. Versions before 1.0.2 report no gap."""
    info = found.info
    gap = relative_gap(info.obj_val, info.dual_obj_val) if hasattr(info, "dual_obj_val") else np.nan
    return str(info.status), info.prim_res, info.dual_res, gap, info.iter, info.run_time


def _piqp(found: Any) -> Reading:
    """Return the numbers of a result of PIQP; versions before 0.6 report absolute residuals under other names."""
    info = found.info
    names = (("primal_res_rel", "primal_inf"), ("dual_res_rel", "dual_inf"))
    residuals = [getattr(info, new) if hasattr(info, new) else getattr(info, old) for new, old in names]
    gap = relative_gap(info.primal_obj, info.dual_obj)
    return info.status.name, residuals[0], residuals[1], gap, info.iter, info.run_time


def _highs(found: Any) -> Reading:
    """Return the numbers of a result of HiGHS: its greatest violations."""
    info = found["info"]
    kinds = ("ipm", "crossover", "pdlp", "qp", "simplex")
    iterations = sum(max(0, getattr(info, f"{kind}_iteration_count", 0)) for kind in kinds)
    # versions before 1.11 report no gap
    gap = _number(getattr(info, "primal_dual_objective_error", None))
    residuals = info.max_primal_infeasibility, info.max_dual_infeasibility
    return str(found["model_status"]), *residuals, gap, iterations, float(found["run_time"])


@cache
def _silence_highs() -> None:
    """Print nothing for HiGHS: its first object in a process writes a banner to file descriptor 1, with any settings.

    The descriptor points to a temporary file while the first object is made. Then the lines of other threads, if there
    are any, are written to the original descriptor.
    """
    import highspy

    sys.stdout.flush()
    original = os.dup(1)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        try:
            highspy.Highs()  # type: ignore[no-untyped-call]
        finally:
            os.dup2(original, 1)
        file.seek(0)
        others = [line for line in file.read().splitlines(keepends=True) if not line.startswith(_BANNER)]
    os.write(original, b"".join(others))
    os.close(original)


_BANNER = (b"Running HiGHS", b"Copyright (c)", b"Includes third-party software")


def _number(value: Any) -> float:
    """Return a value as a number; NaN for None."""
    return np.nan if value is None else float(value)


_QP = frozenset({"linear"})
_SOC = _QP | {"second-order"}
_SDP = _SOC | {"semidefinite"}
_ALL = _SDP | {"exponential", "power"}

SOLVERS: dict[str, ConicSolver] = {
    solver.name: solver
    for solver in (
        ConicSolver("CLARABEL", "clarabel", _ALL, "interior point", _clarabel, reduced=True),
        ConicSolver("SCS", "scs", _ALL, "operator splitting, takes a start", _scs, takes_start=True),
        ConicSolver("CVXOPT", "cvxopt", _SDP, "interior point", _cvxopt, own=_cvxopt_conelp,
                    convert=cvxpy_access.cvxopt_solution),
        ConicSolver("QOCO", "qoco", _SOC, "interior point", _qoco, reduced=True),
        ConicSolver("PIQP", "piqp", _QP, "proximal interior point", _piqp),
        ConicSolver("OSQP", "osqp", _QP, "operator splitting, takes a start", _osqp, takes_start=True),
        ConicSolver("HIGHS", "highspy", _QP, "simplex, interior point and active set", _highs,
                    quiet={"output_flag": False}, prepare=_silence_highs),
    )
}  # fmt: skip
"""Adapters by the name of the solver in cvxpy."""

# Back ends without an adapter that report an inaccurate solution if their reduced tolerances are met.
_REDUCED = frozenset({"ECOS"})
_OUTCOMES: dict[str, Outcome] = {
    "optimal": "solved",
    "optimal_inaccurate": "inaccurate",
    "infeasible": "infeasible",
    "infeasible_inaccurate": "infeasible",
    "unbounded": "unbounded",
    "unbounded_inaccurate": "unbounded",
}


def adapter(name: str) -> ConicSolver:
    """Return the adapter of a solver; a solver of cvxpy without its own adapter gets one that reads cvxpy's numbers.

    Parameters
    ----------
    name : str
        Name of the solver in cvxpy.

    Returns
    -------
    ConicSolver
        The adapter.

    Raises
    ------
    ValueError
        If cvxpy does not know the solver.
    """
    if name in SOLVERS:
        return SOLVERS[name]
    cones = cvxpy_access.cones_of_solvers()
    if name not in cones:
        raise ValueError(f"unknown solver {name!r}; use one of {', '.join(SOLVERS)}")
    return ConicSolver(name, name.lower(), cones[name], "", reduced=name in _REDUCED)


def refusal(problem: Any, solver: str) -> str:
    """Return the reason why a solver cannot solve a problem, as one sentence; "" if it can.

    Parameters
    ----------
    problem : cvxpy.Problem
        A convex problem.
    solver : str
        Name of the solver in cvxpy.

    Returns
    -------
    str
        The sentence, with the next step.
    """
    import cvxpy

    one = adapter(solver)
    if solver not in cvxpy.installed_solvers():
        return f"{solver} is not installed; install {one.package}, or use CLARABEL"
    with LOCK:
        missing = sorted(cvxpy_access.cones_of(problem) - one.cones)
    if missing:
        able = [name for name, other in SOLVERS.items() if other.cones >= {*missing}]
        kinds = " and ".join(missing)
        return f"{solver} solves {one.solves()}, and this problem has {kinds} cones; use {' or '.join(able)}"
    return ""


def read_clarabel(solution: Any) -> SolverReport:
    """Return the report of a solution object of Clarabel.

    Parameters
    ----------
    solution : clarabel.DefaultSolution
        The solution.

    Returns
    -------
    SolverReport
        The report.
    """
    status = str(solution.status)
    gap = relative_gap(solution.obj_val, solution.obj_val_dual)
    return SolverReport("CLARABEL", status, solution.r_prim, solution.r_dual, gap, solution.iterations,
                        solution.solve_time, "", _CLARABEL.get(status, "failed"))  # fmt: skip


_CLARABEL: dict[str, Outcome] = {
    "Solved": "solved",
    "AlmostSolved": "inaccurate",
    "PrimalInfeasible": "infeasible",
    "AlmostPrimalInfeasible": "infeasible",
    "DualInfeasible": "unbounded",
    "AlmostDualInfeasible": "unbounded",
}


def solve_problem(
    problem: Any, solver: str = "CLARABEL", settings: Mapping[str, Any] | None = None, warm: bool = False
) -> SolverReport:
    """Solve a cvxpy problem, and write primal and dual values onto its variables and constraints.

    Parameters
    ----------
    problem : cvxpy.Problem
        A convex problem whose parameters have values.
    solver : str
        Name of the solver in cvxpy.
    settings : Mapping[str, Any], optional
        Settings of the solver, by the solver's names.
    warm : bool
        Whether to start at the previous solution of this problem by this solver. Interior-point solvers ignore it.

    Returns
    -------
    SolverReport
        The solver's own report. A failed solve is reported here, not raised, and leaves no values.

    Raises
    ------
    ValueError
        If the solver is unknown, is not installed, or does not support the cones of the problem.
    """
    return solve_with_status(problem, solver, settings, warm=warm)[0]


def solve_with_status(
    problem: Any, solver: str, settings: Mapping[str, Any] | None = None, *, warm: bool = False
) -> tuple[SolverReport, str]:
    """Return the report of `solve_problem`, and the status in cvxpy's words, for instance ``"optimal_inaccurate"``.

    Parameters
    ----------
    problem, solver, settings, warm
        As in `solve_problem`.

    Returns
    -------
    SolverReport
        The solver's own report.
    str
        Status in cvxpy's words; ``"solver_error"`` if the solver raised an error.

    Raises
    ------
    ValueError
        As in `solve_problem`.
    """
    import cvxpy

    one = adapter(solver)
    given = {**one.quiet, **(settings or {})}
    with LOCK:
        cvxpy_access.clear_values(problem)
        try:
            form = cvxpy_access.compiled(problem, solver, given)
        except cvxpy.error.SolverError as trouble:
            raise ValueError(refusal(problem, solver) or first_sentence(trouble)) from trouble
        try:
            if one.prepare is not None:
                one.prepare()
            if one.own is None:
                raw = cvxpy_access.run(problem, form, given, warm=warm and one.takes_start)
            else:
                raw = one.own(form, given)
            status = cvxpy_access.write_back(problem, form, one.convert(raw))
        except Exception as trouble:  # noqa: BLE001  (a solver may raise anything; its problem stays usable)
            cvxpy_access.clear_values(problem)
            word = "" if isinstance(trouble, cvxpy.error.SolverError) else f"{type(trouble).__name__}: "
            report = SolverReport(solver, "error", message=f"{word}{first_sentence(trouble)}")
            return report, "solver_error"
        report = _report(one, raw, status, problem, form)
        if report.outcome == "failed":
            cvxpy_access.clear_values(problem)
        return report, status


# Share of the size of the data from which a residual contradicts a reported solution: ten times the loosest tolerance
# of an adapter, 1e-4 of Clarabel's reduced tolerances.
_BROKEN = 1e-3


def _report(one: ConicSolver, raw: Any, status: str, problem: Any, form: Compiled) -> SolverReport:
    """Return the report of a solution object `raw`, whose status in cvxpy's words is `status`."""
    outcome = _OUTCOMES.get(status, "failed")
    if one.read is None:
        stats = problem.solver_stats if outcome != "failed" else None
        iterations = int(stats.num_iters or 0) if stats is not None else 0
        seconds = _number(stats.solve_time) if stats is not None else np.nan
        return SolverReport(one.name, status, iterations=iterations, seconds=seconds, outcome=outcome)
    word, primal, dual, gap, iterations, seconds = one.read(raw)
    message = str(raw.get("message", "")) if isinstance(raw, dict) else ""
    # QOCO reports a solution for some problems that are unbounded
    vectors = [form.data[name] for name in _VECTORS if form.data.get(name) is not None]
    size = 1.0 + max((float(np.abs(vector).max(initial=0.0)) for vector in vectors), default=0.0)
    if outcome == "solved" and max(primal, dual) > _BROKEN * size:
        outcome, message = "failed", "the residuals are too large for the reported solution"
    return SolverReport(
        one.name, word, float(primal), float(dual), float(gap), int(iterations), float(seconds), message, outcome
    )


# Names of the vectors in the data of solvers: objective and right sides.
_VECTORS = ("c", "q", "b", "h", "g")
