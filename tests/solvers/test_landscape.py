"""The cost over the place: its profile along held directions, and where iterations end."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to
from scipy.optimize import minimize_scalar

from optloc import InvalidProblem, solve
from optloc.solvers.landscape import ITERATIONS, End, basins, profile_cost

ERROR = np.array([3.0, -2.0, 4.0, 1.0, -3.0])


def cost(x, y):
    z = np.linalg.norm(PLACE - SQUARE, axis=1) + ERROR
    return (((np.linalg.norm(np.array([x, y]) - SQUARE, axis=1) - z) / 5.0) ** 2).sum()


def test_a_place_that_is_held_costs_what_its_ranges_do():
    problem = ranges_to(PLACE, 5.0, ERROR)
    places = np.array([[310.0, 640.0], [350.0, 700.0]])
    found = profile_cost(problem, PLACE, places, np.eye(2))
    np.testing.assert_allclose(found, [cost(*place) for place in places], rtol=1e-6)


def test_a_direction_that_is_not_held_takes_its_best_value():
    problem = ranges_to(PLACE, 5.0, ERROR)
    found = profile_cost(problem, PLACE, np.array([[310.0, 640.0]]), np.array([[1.0, 0.0]]))
    best = minimize_scalar(lambda y: cost(310.0, y), bounds=(500.0, 800.0), method="bounded", options={"xatol": 1e-6})
    assert found[0] == pytest.approx(best.fun, rel=1e-5)


@pytest.mark.parametrize("method", list(ITERATIONS))
def test_iterations_from_beside_the_fix_reach_it(method):
    problem = ranges_to(PLACE, 5.0, ERROR)
    fix = solve(problem)[0]
    found = basins(problem, fix, PLACE + np.array([[[20.0, 0.0], [0.0, -30.0]]]), method)
    assert found.ends.tolist() == [[End.REACHED, End.REACHED]]
    assert found.share(End.REACHED) == 1.0


def test_an_unknown_iteration_and_no_fix_are_refused():
    problem = ranges_to(PLACE, 5.0, ERROR)
    fix = solve(problem)[0]
    with pytest.raises(InvalidProblem, match="unknown iteration"):
        basins(problem, fix, PLACE[None], "newton")
    lost = ranges_to(PLACE, 5.0, stations=SQUARE[:1])
    with pytest.raises(InvalidProblem, match="no fix for a start to reach"):
        basins(lost, solve(lost)[0], PLACE[None])
