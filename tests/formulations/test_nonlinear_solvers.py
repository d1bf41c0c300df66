"""Nonlinear solvers of CasADi: their reports, and their silence."""

import sys
import threading

import casadi as ca
import numpy as np
import pytest

from formulations.backend import Choice
from formulations.nls import Program
from formulations.nonlinear_solvers import nonlinear_report, silent, status_of

STATIONS = np.array([[0.0, 0.0], [1.0, 0.1], [0.2, 0.9], [-0.8, 0.5]])
Z = np.linalg.norm([0.6, 0.7] - STATIONS, axis=1)
NAMES = ("ipopt", "sqpmethod", "feasiblesqpmethod", "qrsqp", "fatrop", "alpaqa", "uno")
# alpaqa stops at 1e-5 by default and reports no iterations
NEAR = {"alpaqa": 1e-3}
INSTALLED = [name for name in NAMES if ca.has_nlpsol(name)]


def solved(name, start=(0.4, 0.4), limit=0.5):
    def residual(x, p, z):
        return [z[i] - ca.sqrt((x[0] - s[0]) ** 2 + (x[1] - s[1]) ** 2) for i, s in enumerate(STATIONS.tolist())]

    program = Program(2, 4, residual=residual, inequalities=lambda x, p: [0.5 - x[0]], choice=Choice("nonlinear", name))
    return program.solve(start, Z)


@pytest.mark.parametrize("name", INSTALLED)
def test_each_solver_reports_and_prints_nothing(name, capfd):
    usual, found = solved("ipopt"), solved(name)
    out, err = capfd.readouterr()
    assert out == err == ""
    assert found.success
    np.testing.assert_allclose(found.x, usual.x, atol=NEAR.get(name, 1e-5))
    report = found.report
    assert (report.backend, report.status, report.outcome) == (name, found.status, "solved")
    assert report.iterations == found.iterations
    assert np.isnan(report.gap)


# fatrop may never end at a start without a gradient, so no solver runs there
@pytest.mark.parametrize("name", INSTALLED)
def test_a_start_without_a_gradient_is_a_failure_without_output(name, capfd):
    bad = solved(name, STATIONS[0], None)
    assert not bad.success
    assert bad.status == "the cost has no gradient at the start"
    assert (bad.report.backend, bad.report.outcome) == (name, "failed")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", [name for name in ("ipopt", "uno") if name in INSTALLED])
def test_residuals_where_a_solver_passes_them_on(name):
    report = solved(name).report
    assert 0.0 <= report.primal_residual < 1e-6
    assert 0.0 <= report.dual_residual < 1e-6


def test_a_status_is_the_own_one_or_that_of_casadi():
    assert status_of({"return_status": 0, "unified_return_status": "X"}) == "0"
    assert status_of({"unified_return_status": "SOLVER_RET_SUCCESS"}) == "SOLVER_RET_SUCCESS"
    with pytest.raises(KeyError):
        status_of({"success": True})
    report = nonlinear_report("x", {"iter_count": 3}, "Infeasible_Problem_Detected", success=False)
    assert (report.outcome, report.iterations) == ("infeasible", 3)


def test_only_the_thread_of_the_solver_is_muted(capsys):
    before, inside, done = sys.stdout, threading.Event(), threading.Event()

    def other():
        inside.wait(10.0)
        sys.stdout.write("of another thread\n")
        done.set()

    thread = threading.Thread(target=other)
    thread.start()
    with silent("alpaqa"):
        sys.stdout.write("of the solver\n")
        inside.set()
        assert done.wait(10.0)
        with silent("ipopt"):
            sys.stdout.write("of an inner block\n")
    thread.join()
    sys.stdout.write("afterwards\n")
    assert capsys.readouterr().out == "of another thread\nafterwards\n"
    assert sys.stdout is before
