"""The cost around a fix: squares that hold everything, grids at one height, and what has no landscape."""

from dataclasses import replace

import numpy as np
import pytest
from show.ranging import PLACES, TRUTH, ranged

from optloc import InvalidProblem
from optloc.show.pictures.landscape import _excess, limits, plane, single
from optloc.show.pictures.scene import scene_of


def test_a_square_holds_stations_and_fix_with_a_rim():
    problem, fix = ranged()
    low, high = limits(scene_of(problem, [fix]))
    assert high - low == pytest.approx(np.full(2, 1100.0 * 1.5))
    assert ((low < PLACES) & (high > PLACES)).all()


def test_a_grid_is_at_the_height_of_its_point():
    x, y, points = plane(np.array([[0.0, 10.0], [4.0, 30.0]]), 3, np.array([9.0, 9.0, 7.0]))
    assert (x.tolist(), y.tolist()) == ([0.0, 2.0, 4.0], [10.0, 20.0, 30.0])
    assert points.shape == (9, 3)
    assert points[5].tolist() == [4.0, 20.0, 7.0]


def test_the_excess_is_the_root_of_the_cost_above_the_fix():
    problem, fix = single(*ranged())
    points = np.array([TRUTH, [700.0, 200.0], fix.position[0]])
    residual = problem.z[0] - np.linalg.norm(points[:, None] - PLACES, axis=-1)
    expected = np.sqrt(np.maximum((residual**2).sum(-1) / 4.0 - fix.cost[0], 0.0))
    assert _excess(problem, fix, points, 2) == pytest.approx(expected, abs=1e-6)


def test_a_batch_and_a_missing_answer_have_no_landscape():
    problem, fix = ranged()
    lost = replace(fix.flat(), x=np.full((1, 2), np.nan))
    with pytest.raises(InvalidProblem, match="the problem has no fix"):
        single(problem, lost)
