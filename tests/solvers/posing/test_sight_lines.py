"""Posed bearings have the values of the relaxations that the methods solve."""

import numpy as np
import pytest
from solvers.posing.scenes import differences, sighted

from formulations.direction_sdp import directions
from formulations.minimax_cone import angles, minimax
from optloc import InvalidProblem, pose, solve
from optloc.solvers.posing.sight_lines import pose_directions, pose_minimax
from optloc.solvers.starts.angles import bearings, complete_bearings, cones_of, sights


def test_the_chordal_value_is_that_of_the_formulation():
    problem = sighted(3)
    seen = bearings(problem.flat())
    expected = directions(**sights(seen, *complete_bearings(seen)[0]))
    posed = pose(problem, "direction_sdp")
    found = posed.solve(refine=False)
    assert found.posed.value == pytest.approx(expected.value, rel=1e-5)
    assert np.linalg.norm(posed.of("direction").value, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert found.position == pytest.approx(seen.metres(expected.point[None, None])[0, 0], abs=1e-2)


def test_the_cones_have_the_smallest_maximal_angle():
    problem = sighted(3)
    seen = bearings(problem.flat())
    ahead, station, scale = cones_of(seen, 0)
    level = minimax(ahead, station, scale).level
    posed = pose(problem, "minimax_cone")
    point = (posed.solve(refine=False).position - seen.centre[0]) / seen.scale[0]
    assert (angles(point, ahead, station) / scale).max() == pytest.approx(level, rel=1e-3)
    assert float(posed.of("radius").value) == pytest.approx(0.0, abs=1e-3 * posed.unit)


def test_other_rows_are_refused():
    for state in (pose_directions, pose_minimax):
        with pytest.raises(InvalidProblem, match="azimuths"):
            state(differences(1).flat(), lambda part: None)


def test_the_bound_is_of_chords_and_may_exceed_the_cost_of_angles():
    """The docstring of `PosedAnswer.bound`: moments bound the maximum-likelihood cost, directions another cost."""
    excess = []
    for seed in range(4):
        problem = sighted(seed)
        cost = float(solve(problem).cost)
        excess.append(pose(problem, "direction_sdp").solve(refine=False).posed.bound / cost - 1.0)
    assert max(excess) > 0.0
    # the costs differ to first order in the noise, 2 mrad
    assert np.abs(excess).max() < 2e-3
