"""Posed bearings have the values of the relaxations that the methods solve."""

import numpy as np
import pytest
from solvers.posing.scenes import differences, sighted

from formulations.direction_sdp import directions
from formulations.minimax_cone import angles, minimax
from optloc import InvalidProblem, pose
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
    point = posed.scaled(posed.solve(refine=False).position)
    assert (angles(point, ahead, station) / scale).max() == pytest.approx(level, rel=1e-3)
    assert float(posed.of("radius").value) == pytest.approx(0.0, abs=1e-3 * posed.unit)


def test_other_rows_are_refused():
    for state in (pose_directions, pose_minimax):
        with pytest.raises(InvalidProblem, match="azimuths"):
            state(differences(1).flat(), lambda part: None)
