"""Adapters of conic solvers: the same solution and duals from each, honest reports, silence, and refusals."""

from dataclasses import replace
from importlib.util import find_spec

import cvxpy as cp
import numpy as np
import pytest

from formulations.backend import Choice, recording, using
from formulations.conic_solvers import SOLVERS, adapter, refusal, solve_problem, solve_with_status
from formulations.solver_report import SolverReport
from formulations.squared_range import paraboloid
from formulations.squared_range_conic import shor

MODULES = {"HIGHS": "highspy"}
AT = np.array([1.0, 2.0, 3.0])


def missing(name):
    return find_spec(MODULES.get(name, name.lower())) is None


def each(names):
    """Parameters with a skip, and its reason, for solvers that are not installed."""
    return [
        pytest.param(name, marks=pytest.mark.skipif(missing(name), reason=f"{SOLVERS[name].package} is not installed"))
        for name in names
    ]


CONIC = [name for name, one in SOLVERS.items() if "second-order" in one.cones]
SEMIDEFINITE = [name for name, one in SOLVERS.items() if "semidefinite" in one.cones]


def quadratic():
    x = cp.Variable(3, name="x")
    return cp.Problem(cp.Minimize(cp.sum_squares(x - AT)), [x <= 1.0, x[0] >= 0.2, cp.sum(x) == 0.9])


def second_order():
    x = cp.Variable(3, name="x")
    return cp.Problem(cp.Minimize(cp.sum_squares(x - AT)), [cp.norm(x) <= 1.0, x[0] >= 0.2, cp.sum(x) == 0.9])


def semidefinite():
    lift = cp.Variable((3, 3), symmetric=True, name="lift")
    form = np.arange(9.0).reshape(3, 3)
    rules = [lift >> 0, cp.trace(lift) == 1.0, lift[0, 1] >= 0.1]
    return cp.Problem(cp.Minimize(cp.trace((form + form.T) @ lift)), rules)


def same_as_clarabel(name, build):
    """Solve by a solver and by Clarabel; compare value, variables, and duals, and return the report."""
    problem, other = build(), build()
    report = solve_problem(problem, name)
    assert solve_problem(other).outcome == "solved"
    assert report.outcome == "solved", report
    assert problem.status == "optimal"
    assert problem.value == pytest.approx(other.value, abs=1e-4)
    for own, theirs in zip(problem.variables(), other.variables(), strict=True):
        np.testing.assert_allclose(own.value, theirs.value, atol=1e-3)
    for own, theirs in zip(problem.constraints, other.constraints, strict=True):
        np.testing.assert_allclose(own.dual_value, theirs.dual_value, atol=2e-3)
    return report


def is_complete(report, name):
    """Residuals, gap, iterations and time are numbers, and small."""
    assert report.backend == name
    assert report.status
    assert 0.0 <= report.primal_residual < 1e-4
    assert 0.0 <= report.dual_residual < 1e-4
    # the lowest supported versions of some solvers report no gap
    if np.isnan(report.gap) and name in ("OSQP", "HIGHS"):
        return
    assert 0.0 <= report.gap < 1e-4
    assert report.worst == max(report.primal_residual, report.dual_residual, report.gap)
    assert report.iterations > 0
    assert report.seconds >= 0.0
    assert report.message == ""


@pytest.mark.parametrize("name", each(SOLVERS))
def test_quadratic_programs(name):
    is_complete(same_as_clarabel(name, quadratic), name)


@pytest.mark.parametrize("name", each(CONIC))
def test_second_order_cones(name):
    is_complete(same_as_clarabel(name, second_order), name)


@pytest.mark.parametrize("name", each(SEMIDEFINITE))
def test_semidefinite_cones(name):
    is_complete(same_as_clarabel(name, semidefinite), name)


@pytest.mark.parametrize("name", each(SOLVERS))
def test_the_residuals_are_those_of_the_solution(name):
    """Residuals recomputed from the values on the problem are of the size that the solver reports."""
    problem = quadratic()
    report = solve_problem(problem, name)
    (x,), (upper, lower, total) = problem.variables(), problem.constraints
    violation = max(np.maximum(x.value - 1.0, 0.0).max(), 0.2 - x.value[0], abs(x.value.sum() - 0.9))
    slope = 2.0 * (x.value - AT) + upper.dual_value - np.array([1.0, 0, 0]) * lower.dual_value + total.dual_value
    assert violation <= 10.0 * report.primal_residual + 1e-6
    assert np.abs(slope).max() <= 10.0 * report.dual_residual + 2e-4


@pytest.mark.parametrize("name", each(SOLVERS))
def test_problems_without_a_solution_have_no_values(name):
    x = cp.Variable(3, name="x")
    nowhere = cp.Problem(cp.Minimize(cp.sum_squares(x)), [x <= 1.0, x[0] >= 2.0])
    endless = cp.Problem(cp.Minimize(cp.sum(x)), [x <= 1.0])
    for problem, word in ((nowhere, "infeasible"), (endless, "unbounded")):
        x.value = AT
        report = solve_problem(problem, name)
        # QOCO detects neither
        assert report.outcome == word or (name == "QOCO" and report.outcome == "failed")
        assert x.value is None


@pytest.mark.parametrize("name", each(SOLVERS))
def test_nothing_is_printed(name, capfd):
    solve_problem(quadratic(), name)
    solve_problem(second_order() if name in CONIC else quadratic(), name)
    out, err = capfd.readouterr()
    assert out == err == ""


@pytest.mark.skipif(missing("HIGHS"), reason="highspy is not installed")
def test_the_banner_of_highs_is_dropped_and_other_output_is_not(capfd):
    import os
    import subprocess
    import sys

    lines = (
        "import os, highspy\n"
        "own = highspy.Highs\n"
        "highspy.Highs = lambda: (os.write(1, b'of another thread\\n'), own())[1]\n"
        "from formulations.conic_solvers import _silence_highs\n"
        "_silence_highs()\n"
    )
    found = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, check=True, env=os.environ)
    assert found.stdout == "of another thread\n"


LIMITS = {"CLARABEL": {"max_iter": 1}, "SCS": {"max_iters": 1}, "CVXOPT": {"max_iters": 1}, "QOCO": {"max_iters": 1},
          "PIQP": {"max_iter": 1}, "OSQP": {"max_iter": 1, "polishing": False},
          "HIGHS": {"qp_iteration_limit": 0}}  # fmt: skip


@pytest.mark.parametrize("name", each(SOLVERS))
def test_a_solver_that_stops_early_reports_it(name):
    problem = second_order() if name in CONIC else quadratic()
    report = solve_problem(problem, name, LIMITS[name])
    assert report.outcome in ("failed", "inaccurate")
    assert report.status
    if report.outcome == "failed":
        assert problem.variables()[0].value is None
        assert problem.status is None


@pytest.mark.parametrize("name", each([name for name in SOLVERS if name != "QOCO"]))
def test_an_unknown_setting_is_reported(name):
    report, status = solve_with_status(quadratic(), name, {"no_such_setting": 1})
    assert (report.outcome, report.status, status) == ("failed", "error", "solver_error")
    assert report.message
    assert str(report) == f"{name}: {report.message}"


@pytest.mark.parametrize("name", each(["OSQP", "PIQP", "HIGHS"]))
def test_solvers_of_quadratic_programs_refuse_cones_in_one_sentence(name):
    words = f"{name} solves linear and quadratic programs only, and this problem has second-order cones; use CLARABEL"
    with pytest.raises(ValueError, match=words):
        solve_problem(second_order(), name)
    assert refusal(second_order(), name).startswith(words)
    assert refusal(quadratic(), name) == ""


@pytest.mark.parametrize("name", each(["OSQP"]))
def test_a_relaxation_reports_the_refusal_as_its_ending(name):
    with using(Choice("conic", name)), recording() as endings:
        found = shor(np.eye(3), np.ones(3), paraboloid(2))
    assert np.isnan(found.y).all()
    assert found.answer.status == "solver_error"
    assert found.answer.message.startswith(f"{name} solves linear and quadratic programs only, and this problem has")
    assert [str(ending) for ending in endings] == [f"{name}: {found.answer.message}"]


def test_solvers_that_are_unknown_or_missing_are_refused(monkeypatch):
    with pytest.raises(ValueError, match="unknown solver 'NOBODY'; use one of CLARABEL"):
        solve_problem(quadratic(), "NOBODY")
    if "MOSEK" not in cp.installed_solvers():
        with pytest.raises(ValueError, match="MOSEK is not installed; install mosek, or use CLARABEL"):
            solve_problem(quadratic(), "MOSEK")


def test_a_solver_without_its_own_adapter_reports_the_numbers_of_cvxpy():
    x = cp.Variable(2)
    report = solve_problem(cp.Problem(cp.Maximize(x[0] + 2 * x[1]), [x >= 0, cp.sum(x) <= 1]), "SCIPY")
    assert (report.backend, report.status, report.outcome) == ("SCIPY", "optimal", "solved")
    assert np.isnan(report.worst)
    np.testing.assert_allclose(x.value, [0.0, 1.0], atol=1e-9)
    assert adapter("SCIPY").solves() == "linear programs only"


@pytest.mark.parametrize("name", each([name for name, one in SOLVERS.items() if one.takes_start]))
def test_a_start_saves_iterations(name):
    problem = quadratic()
    settings = {"eps_abs": 1e-9, "eps_rel": 1e-9}
    first = solve_problem(problem, name, settings)
    again, cold = (solve_problem(problem, name, settings, warm=warm) for warm in (True, False))
    assert again.outcome == "solved"
    assert again.iterations < first.iterations
    assert cold.iterations == first.iterations


def test_a_large_residual_contradicts_a_solution(monkeypatch):
    """QOCO calls some unbounded problems solved; the adapter compares the residual with the data."""
    wrong = replace(SOLVERS["CLARABEL"], read=lambda found: ("Solved", 0.0, 5.0, 0.0, 3, 0.1))
    monkeypatch.setitem(SOLVERS, "CLARABEL", wrong)
    problem = quadratic()
    report = solve_problem(problem)
    assert report.outcome == "failed"
    assert report.message == "the residuals are too large for the reported solution"
    assert problem.value is None


def test_parameters_and_problems_that_are_not_dpp():
    p, x = cp.Parameter(name="p", value=2.0), cp.Variable(2, name="x")
    problem = cp.Problem(cp.Minimize(cp.sum_squares(x - p * p)), [x <= 3.0])
    assert solve_problem(problem).outcome == "solved"
    np.testing.assert_allclose(x.value, 3.0, atol=1e-6)
    p.value = 1.0
    assert isinstance(solve_problem(problem), SolverReport)
    np.testing.assert_allclose(x.value, 1.0, atol=1e-6)
