"""Posed moments, lifts and heights."""

import cvxpy
import numpy as np
import pytest
from solvers.posing.scenes import differences, levelled, ranged, sighted

from optloc import InvalidProblem, Status, constraints, pose, solve
from optloc.solvers.posing.range_moments import pose_heights, pose_lifted, pose_moments, range_rows


def test_moments_reach_the_cost_of_the_fix_and_name_their_box():
    problem = ranged(2)
    fix = solve(problem)
    posed = pose(problem, "moment_sdp")
    found = posed.solve(refine=False)
    assert found.posed.value == pytest.approx(float(fix.cost), rel=1e-4)
    assert float(np.sum(posed.residual.value**2)) == pytest.approx(float(fix.cost), rel=1e-3)
    reference = np.linalg.norm(problem.stations.position[0, 0] - found.position)
    assert float(posed.range.value) == pytest.approx(reference, rel=1e-4)
    posed.add(constraints.half_plane([1.0, 0.0], fix.position[0] - 3e3), name="far")
    beyond = posed.solve()
    assert beyond.status == Status.INFEASIBLE
    assert "in the box of positions" in str(beyond.reason)


def test_an_objective_that_ends_on_the_edge_of_the_box_says_so():
    posed = pose(ranged(2), "moment_sdp")
    posed.minimise(posed.position[0])
    assert "on the edge of the search, in the box of positions" in str(posed.solve().reason)
    inside = pose(ranged(2), "moment_sdp")
    place = np.array(solve(ranged(2)).position)
    inside.minimise(cvxpy.sum_squares((inside.position - place) / inside.unit))
    assert "on the edge" not in str(inside.solve().reason)


def test_duals_of_an_unknown_constraint_are_refused():
    with pytest.raises(InvalidProblem, match="no constraint 'quay'"):
        pose(ranged(2), "moment_sdp").solve(duals={"quay": 1.0})


def test_lifted_ranges_are_rows_of_ranges():
    problem = differences(2)
    posed = pose(problem, "lifted")
    fix = posed.solve(refine=False)
    assert fix.posed.value < 0.1
    rows, right = range_rows(problem.flat(), posed.unit)
    assert rows @ (posed.range.value / posed.unit) - right == pytest.approx(posed.residual.value, abs=1e-6)


def test_heights_keep_the_known_height():
    fix = pose(levelled(3), "range_height_conic").solve(refine=False)
    assert float(fix.geodetic[2]) == pytest.approx(0.0, abs=10.0)
    assert fix.posed.rank_ratio < 1e-6


def test_other_rows_are_refused():
    for state in (pose_moments, pose_heights, pose_lifted):
        with pytest.raises(InvalidProblem):
            state(sighted(1).flat(), solve)
