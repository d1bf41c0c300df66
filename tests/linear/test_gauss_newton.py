"""A fixed number of Gauss-Newton steps."""

import numpy as np
import pytest
from cases import CASES, plain_cost

from optloc import InvalidProblem
from optloc.linear.gauss_newton import gauss_newton


def test_steps_end_where_the_cost_has_no_slope():
    case = CASES["tdoa+azimuth-2d"]
    found = gauss_newton(case.problem, case.truth, steps=8)
    assert found.regular
    assert found.cost == pytest.approx(plain_cost(case.problem, found.x))
    for i in range(2):
        ahead, behind = (plain_cost(case.problem, found.x + sign * 0.1 * np.eye(2)[i]) for sign in (1, -1))
        sigma = np.sqrt(found.covariance[i, i])
        assert abs(ahead - behind) / 0.2 * sigma < 1e-3


def test_damping_shortens_the_first_step_and_not_the_way():
    case = CASES["range-2d"]
    start = case.truth + 400.0
    one, damped = (gauss_newton(case.problem, start, steps=1, damping=f).x - start for f in (0.0, 3.0))
    assert np.linalg.norm(damped) < 0.5 * np.linalg.norm(one)
    both = [gauss_newton(case.problem, start, steps=40, damping=factor).x for factor in (0.0, 3.0)]
    np.testing.assert_allclose(*both, atol=0.05)


@pytest.mark.parametrize(("steps", "damping"), [(0, 0.0), (1, -0.1), (1, np.nan)])
def test_steps_and_damping_out_of_range_are_refused(steps, damping):
    with pytest.raises(InvalidProblem, match="give steps >= 1, damping >= 0"):
        gauss_newton(CASES["range-2d"].problem, CASES["range-2d"].truth, steps=steps, damping=damping)
