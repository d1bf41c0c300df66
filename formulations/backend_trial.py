"""A test of back ends in a separate process: ``python -m formulations.backend_trial SECONDS KIND:NAME...``.

Each back end solves programs of two unknowns with a known solution, and programs without a solution. It must print
nothing. The process prints one line for each back end. If a solver does not end in time, the process ends, because
machine code cannot be stopped otherwise.
"""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from threading import Timer
from typing import Any

import numpy as np

from formulations.algebra import Array
from formulations.backend import Choice, SolverError, using

PASSED, FAILED = "backend-passed", "backend-failed"
"""Start of the lines with a result, since solvers print other lines."""

# Three ranges to a position, which the constraints of some programs exclude.
_STATION = np.array([[0.0, 0.0], [1.0, 0.1], [0.2, 0.9]])
_PLACE = np.array([0.6, 0.7])
_RANGES = np.sqrt(((_PLACE - _STATION) ** 2).sum(1))
# Accepted error of a solution: first-order solvers stop at 1e-4.
_NEAR = 1e-2


def _conic_failure(name: str) -> str:
    """Return the failure of a conic solver, or "" if it works.

    The solver must solve a program with a known position, and must not report a common point of cones that do not meet.
    """
    from formulations.minimax_cone import common
    from formulations.squared_range import paraboloid
    from formulations.squared_range_conic import hull, shor

    rows = np.column_stack([_STATION, -0.5 * np.ones(3)])
    right = 0.5 * ((_STATION**2).sum(1) - _RANGES**2)
    with using(Choice("conic", name)):
        found = [each(rows, right, paraboloid(2)) for each in (hull, shor)]
        solved = [one for one in found if np.isfinite(one.y).all()]
        if not solved:
            return f"it solves no conic program ({found[0].answer.message or found[0].answer.status})"
        if any(np.abs(one.y[:2] - _PLACE).max() > _NEAR for one in solved):
            return "its solution is wrong"
        # two stations with bearings away from each other: no point is in front of both
        apart = common(np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 0.0], [1.0, 0.0]]), np.full(2, 0.1))
        if apart.meet:
            return "it reports a common point of cones that do not meet"
    return ""


def _quadratic_failure(name: str) -> str:
    """Return the failure of a solver of linear and quadratic programs, or "" if it works.

    The solver must solve programs with a known solution, and must not report a solution of programs that have none.
    """
    import cvxpy as cp

    from formulations.conic_solvers import solve_problem
    from formulations.cvxpy_access import solves_quadratic_objectives

    x = cp.Variable(2)
    # a corner of a polygon, and the point of a half-plane that is nearest to a point outside of it
    known = [(cp.Problem(cp.Minimize(-x[0] - 2 * x[1]), [x >= 0, x[0] + x[1] <= 1, x[1] <= 0.75]), [0.25, 0.75])]
    if solves_quadratic_objectives(name):
        known.append((cp.Problem(cp.Minimize(cp.sum_squares(x - _PLACE)), [cp.sum(x) == 1.0, x >= 0]), [0.45, 0.55]))
    for problem, solution in known:
        report = solve_problem(problem, name)
        if report.outcome != "solved":
            return f"it ends without a solution ({report.message or report.status})"
        if np.abs(x.value - solution).max() > _NEAR:
            return "its solution is wrong"
    for rules in ([x >= 1, cp.sum(x) <= 1], [x <= 1]):
        if solve_problem(cp.Problem(cp.Minimize(cp.sum(x)), rules), name).outcome == "solved":
            return "it reports success for a program without a solution"
    return ""


def _nonlinear_failure(name: str) -> str:
    """Return the failure of a nonlinear solver, or "" if it works.

    The solver must solve programs with a known position, and must not report success for programs without a solution.
    """
    free, held = _solve(name), _solve(name, inequalities=lambda x, p: [0.5 - x[0]])
    if isinstance(free, str) or isinstance(held, str):
        return str(free if isinstance(free, str) else held)
    if not (free.success and held.success):
        return f"it ends without a solution ({held.status if free.success else free.status})"
    if np.abs(free.x - _PLACE).max() > _NEAR or held.x[0] > 0.5 + _NEAR:
        return "its solution is wrong"
    hopeless: list[dict[str, Any]] = [
        {"equalities": lambda x, p: [x[0] ** 2 + 1.0]},
        {"inequalities": lambda x, p: [x[0] - 1.0, -x[0]]},
        {"start": _STATION[0]},  # without a gradient
        {"ranges": np.array([np.nan, 1.0, 1.0])},
    ]
    for each in hopeless:
        found = _solve(name, **each)
        if not isinstance(found, str) and found.success:
            return "it reports success for a program without a solution"
    return ""


def _solve(name: str, start: Array | None = None, ranges: Array = _RANGES, **constraints: Callable[..., Any]) -> Any:
    """Return the solution of the nonlinear solver `name` for the position (2,), or the message of its failure.

    `constraints` are the equalities and inequalities of `formulations.nls.Program`. `ranges` (3,) are the measurements.
    """
    import casadi as ca

    from formulations.nls import Program

    def residual(x: Any, p: Any, z: Any) -> list[Any]:
        """Return measured minus predicted ranges."""
        return [z[i] - ca.sqrt((x[0] - s[0]) ** 2 + (x[1] - s[1]) ** 2) for i, s in enumerate(_STATION.tolist())]

    try:
        program = Program(2, 3, residual=residual, choice=Choice("nonlinear", name), **constraints)  # type: ignore[arg-type]
        return program.solve(np.array([0.4, 0.4]) if start is None else start, ranges)
    except SolverError as trouble:
        return str(trouble).partition("\n")[0]


def _failure_of(kind: str, name: str) -> str:
    """Return the failure of a solver of a kind, "conic", "quadratic" or "nonlinear", or "" if it works."""
    tests = {"conic": _conic_failure, "quadratic": _quadratic_failure, "nonlinear": _nonlinear_failure}
    try:
        return tests[kind](name)
    except Exception as trouble:  # noqa: BLE001  (any exception of a solver is its failure)
        return f"{type(trouble).__name__}: {trouble}".partition("\n")[0]


def _printed(file: Any) -> bool:
    """Return whether something was written to a file since the last call, and empty the file."""
    sys.stdout.flush()
    sys.stderr.flush()
    with suppress(OSError, AttributeError, TypeError):  # the C library's buffer, where the system has one for all
        ctypes.CDLL(None).fflush(None)
    some = os.fstat(file.fileno()).st_size > 0
    file.seek(0)
    file.truncate()
    return some


def main(seconds: float, choices: list[str]) -> None:
    """Test back ends one after the other, and print the failure of each.

    Parameters
    ----------
    seconds : float
        Time limit of each back end for all programs.
    choices : list of str
        Kind and name of each back end, joined by a colon.
    """
    lines = os.fdopen(os.dup(1), "w", encoding="utf-8")

    def say(word: str, name: str, fault: str) -> None:
        """Print one result line."""
        lines.write(f"\n{word} {name} {fault}\n")
        lines.flush()

    def stop(name: str) -> None:
        """Print the failure of a solver that did not end in time, and end the process."""
        say(FAILED, name, f"it does not end within {seconds:g} s on a program of two unknowns")
        os._exit(0)

    with tempfile.TemporaryFile() as output:
        # what solvers print, from machine code too
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
        for kind, _, name in (choice.partition(":") for choice in choices):
            import_module("casadi" if kind == "nonlinear" else "cvxpy")  # not counted as time of the solver
            _printed(output)
            timer = Timer(seconds, stop, (name,))
            timer.daemon = True
            timer.start()
            fault = _failure_of(kind, name)
            timer.cancel()
            if _printed(output) and not fault:
                fault = "it prints messages that no setting suppresses"
            say(FAILED if fault else PASSED, name, fault)


if __name__ == "__main__":
    main(float(sys.argv[1]), sys.argv[2:])
