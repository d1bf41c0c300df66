"""Posed squared ranges have the values of the relaxations that the methods solve."""

import pytest
from solvers.posing.scenes import differences, ranged

from formulations import squared_range_conic
from optloc import pose
from optloc.linear.least_squares_ranges import ranges
from optloc.linear.vectors import problem_at_rest
from optloc.solvers.posing.squared_ranges import pose_hull, pose_shor
from optloc.solvers.starts.squared_range import hull, last_weighting, shor


@pytest.mark.parametrize("scene", [differences, ranged])
@pytest.mark.parametrize(("name", "state", "pick"), [("shor", pose_shor, shor), ("hull", pose_hull, hull)])
def test_the_value_is_that_of_the_formulation(scene, name, state, pick):
    problem = scene(6, noise=0.02)
    alone = problem_at_rest(problem.flat())
    squared, rows, right = last_weighting(alone, ranges(alone), pick)
    expected = getattr(squared_range_conic, name)(rows[0], right[0], squared.quadric)
    posed = pose(problem, f"squared_range_conic: {name}")
    found = posed.solve(refine=False).posed
    assert found.value == pytest.approx(expected.value, rel=1e-3, abs=1e-4)
    statement = state(problem.flat(), lambda part: None)
    assert statement.unit == pytest.approx(posed.unit)
