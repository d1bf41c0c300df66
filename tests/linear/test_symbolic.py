"""Residuals and constraints on CasADi symbols, against the same on numbers."""

import casadi
import numpy as np
import pytest
from cases import CASES, ENU, STATIONS, TARGET, plain_predict, wrapped

from optloc import assemble, measured
from optloc.linear.constraints import box, height
from optloc.linear.symbolic import bounds, constrained, parameters, residual


@pytest.mark.parametrize("name", ["tdoa+azimuth-2d", "tdoa+fdoa-3d", "toa+tdoa-3d", "tdoa+height-3d"])
def test_symbolic_residuals_are_those_of_numbers(name):
    case = CASES[name]
    numbers = parameters(case.problem)
    x, p, z = (
        casadi.SX.sym(one, size)
        for one, size in (("x", len(case.truth)), ("p", len(numbers)), ("z", case.problem.count))
    )
    function = casadi.Function("r", [x, p, z], [casadi.vertcat(*residual(case.problem, x, p, z))])
    place = case.truth * 1.1 + 20.0
    found = function(place, numbers, case.problem.observed).full().ravel()
    expected = wrapped(case.problem, case.problem.observed - plain_predict(case.problem, place))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7)


def test_symbolic_constraints_are_zero_or_positive_where_they_hold():
    limits = (box([-np.inf, 2e3, 100.0], [4e3, 2e3, np.inf]), height(-1e3, 5e3))
    rows = measured("range", a=np.arange(7), sigma=1.0)
    problem = assemble(STATIONS[3], rows, constraints=limits, frame=ENU)
    numbers = bounds(problem)
    x, p = casadi.SX.sym("x", 3), casadi.SX.sym("p", len(numbers))
    equal, more = constrained(problem, x, p, 10.0)
    function = casadi.Function("c", [x, p], [casadi.vertcat(*equal), casadi.vertcat(*more)])
    place = TARGET[3]
    same, least = (each.full().ravel() for each in function(place, numbers))
    assert same == pytest.approx([(place[1] - 2e3) / 10.0])
    # the height above an ellipsoid through the origin's 420 m, 7 km from it: 4 m more than the third coordinate
    up = place[2] + 420.0
    expected = [(4e3 - place[0]) / 10.0, (place[2] - 100.0) / 10.0, (up + 1e3) / 10.0, (5e3 - up) / 10.0]
    np.testing.assert_allclose(np.sort(least), np.sort(expected), atol=0.5)
