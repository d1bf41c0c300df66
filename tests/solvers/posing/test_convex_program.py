"""Relations of any kind in a convex program: their duals are slopes per unit of what the user wrote."""

import cvxpy as cp
import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.solvers.posing.convex_program import ConvexProgram
from optloc.solvers.posing.posed_problem import PosedProblem


def program(size=1.0):
    """Return the squared distance from (1, 2, 2) in units of 1000."""
    x = cp.Variable(3, name="x")
    return ConvexProgram(cp.Problem(cp.Minimize(cp.sum_squares(x - np.array([1.0, 2.0, 2.0]))), [x >= -9.0]), size), x


KINDS = {
    "linear": lambda y, e: y[0] <= 500.0 + e,
    "greater": lambda y, e: y[0] >= 1500.0 + e,
    "equal": lambda y, e: y[1] == 700.0 + e,
    "norm": lambda y, e: cp.norm(y) <= 1000.0 + e,
    "square": lambda y, e: cp.sum_squares(y) <= 1e6 + e,
    "cone": lambda y, e: cp.SOC(1000.0 + e + 0.0 * y[0], y),
    "nonneg": lambda y, e: cp.NonNeg(500.0 + e - y[0]),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_dual_is_the_slope_in_the_units_of_the_user(kind):
    def at(e):
        own, x = program(50.0)
        PosedProblem(own).add(KINDS[kind](1e3 * x, e), name="it")
        found = own.solution("clarabel", {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11, "tol_feas": 1e-11})
        assert own.has_solution(found.backend)
        return found

    step = 1e3 if kind == "square" else 1.0
    found = at(0.0)
    slope = -(at(step).value - at(-step).value) / (2.0 * step) * (-1.0 if kind == "greater" else 1.0)
    assert found.duals["it"] == pytest.approx(slope, rel=2e-4)
    assert found.values["it"] == pytest.approx(0.0, abs=1e-3 * step)
    assert found.bound == pytest.approx(found.value, rel=1e-5)
    assert found.bound <= found.value * (1.0 + 1e-8)


def test_a_semidefinite_relation():
    own, x = program()
    PosedProblem(own).add(cp.bmat([[x[0:1, None], x[1:2, None]], [x[1:2, None], np.eye(1)]]) >> 0, name="it")
    found = own.solution(None, None)
    assert own.has_solution(found.backend)
    assert np.shape(found.duals["it"]) == (2, 2)
    assert np.linalg.eigvalsh(found.values["it"])[0] > -1e-6


def test_first_order_solvers_start_warm_and_others_say_that_they_do_not():
    own, x = program()
    PosedProblem(own).add(cp.norm(x) <= 1.0, name="it")
    own.solve("SCS", {"eps_abs": 1e-8, "eps_rel": 1e-8}, warm=False)
    report = own.solve("SCS", {"eps_abs": 1e-8, "eps_rel": 1e-8}, warm=True, start=own.variables())
    assert report.message == ""
    assert "does not use start" in own.solve("CLARABEL", None, warm=True).message
    with pytest.raises(InvalidProblem, match="unknown solver"):
        own.solve("NONE", None, warm=False)
