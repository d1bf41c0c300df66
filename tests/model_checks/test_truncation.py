"""Laws cut off at the sides of a box: distances, normals and the half normal law."""

from dataclasses import replace

import numpy as np
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import constraints
from optloc.base.records import take
from optloc.model_checks.truncation import are_near, covariance_of, departure_inwards, has_law, law_of


def boxed(low):
    box = constraints.box(low, [np.inf, np.inf])
    return replace(ranges_to(PLACE, 1.0), constraints=tuple(box))


def test_only_bounds_cut_a_law_off():
    assert has_law(boxed([300.0, 0.0]))
    assert not has_law(ranges_to(PLACE, 1.0))


def test_a_bound_is_near_up_to_three_sigma():
    limits, along = np.array([[0.0, np.inf]]), np.array([[[1.0, 0.0]]])
    covariance = np.diag([4.0, 1.0])[None]
    assert are_near(limits, np.array([[5.9]]), along, covariance)
    assert not are_near(limits, np.array([[6.1]]), along, covariance)


def test_a_fix_on_the_side_of_a_box_has_a_half_normal_law():
    problem = boxed([300.0, -np.inf])
    J = (PLACE - SQUARE) / np.linalg.norm(PLACE - SQUARE, axis=1, keepdims=True)
    spread = np.linalg.inv(J.T @ J)
    law = law_of(problem, PLACE[None], spread[None], np.zeros((1, 2)))
    held = np.isfinite(law.truncated.slack[0])
    assert law.truncated.slack[0, held].tolist() == [0.0]
    np.testing.assert_allclose(law.truncated.normal[0, held], [[-1.0, 0.0]])
    # the half normal law has 1 - 2/pi of the variance, and the other coordinate follows
    expected = spread - 2.0 / np.pi * np.outer(spread[0], spread[0]) / spread[0, 0]
    np.testing.assert_allclose(covariance_of(law.truncated, spread[None], slice(0, 2))[0], expected, rtol=1e-6)
    # over three metres the cost of these ranges is a parabola
    assert departure_inwards(problem, PLACE[None], spread[None], law.truncated)[0] < 0.05


def test_a_side_far_away_leaves_no_law():
    assert law_of(boxed([0.0, -np.inf]), PLACE[None], np.eye(2)[None], np.zeros((1, 2))) is None


def test_points_on_the_edge_of_a_keep_out_polygon_are_admitted():
    corners = PLACE + np.array([[3.0, -200.0], [60.0, 0.0], [3.0, 200.0]])
    problem = replace(ranges_to(PLACE, 1.0), constraints=constraints.keep_out_polygon(corners))
    law = take(law_of(problem, PLACE[None], 9.0 * np.eye(2)[None], np.zeros((1, 2))).truncated, 0)
    # rounding puts most points of an edge on either side of it
    edge = np.column_stack([np.full(99, 3.0), np.linspace(-9.0, 9.0, 99)])
    assert law.admits(edge).all()
    assert np.isfinite(law.distance_squared(edge)).all()
    assert not law.admits(edge + np.array([0.01, 0.0])).any()
