"""Bounds that the data do not reach: their planes, and the cheapest place on each."""

from dataclasses import replace

import numpy as np
from model_checks.small import PLACE, ranges_to

from optloc import constraints
from optloc.solvers.certificates.out_of_reach import edges_of, lay_planes, new_questions


def boxed(*bounds):
    return replace(ranges_to(PLACE, 1.0), constraints=tuple(constraints.box(*bounds)))


def test_each_finite_side_of_a_box_is_an_edge():
    edges = edges_of(boxed([0.0, -np.inf], [900.0, 800.0]))
    assert edges.value.tolist() == [0.0, 900.0, 800.0]
    assert edges.constraint.tolist() == [0, 0, 1]
    assert np.isnan(edges.region).all()
    closed = edges_of(boxed([0.0, 100.0], [900.0, 800.0]))
    np.testing.assert_array_equal(closed.region, [[0.0, 100.0], [900.0, 800.0]])


def test_an_equality_and_a_greatest_speed_are_no_edges():
    assert edges_of(boxed([300.0, -np.inf], [300.0, np.inf])) is None
    assert edges_of(replace(ranges_to(PLACE, 1.0), constraints=tuple(constraints.speed(10.0)))) is None


def test_the_place_on_a_plane_is_where_the_quadratic_model_is_least():
    edges = edges_of(boxed([0.0, -np.inf], [np.inf, np.inf]))
    covariance = np.array([[4.0, 3.0], [3.0, 9.0]])
    asked = new_questions(edges, 1, 2, 5)
    missing, slope = np.array([[-300.0]]), np.array([[[1.0, 0.0]]])
    lay_planes(edges, PLACE[None], covariance[None], missing, slope, asked)
    np.testing.assert_allclose(asked.planes[0, 0], [1.0, 0.0, 0.0])
    # y follows x by 3/4 of its change
    np.testing.assert_allclose(asked.x[0], [0.0, PLACE[1] - 0.75 * 300.0])
    assert asked.gaps.tolist() == [[0.0]]
