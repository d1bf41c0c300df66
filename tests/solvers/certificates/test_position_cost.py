"""Costs over the position, and whether they are those of a problem and its fix."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import Motion, assemble, constraints, measured, solve
from optloc.solvers.certificates.position_cost import (
    admitted_states,
    boxes_around,
    costs_of,
    eliminate_nuisance,
    is_free,
    matches_problem_cost,
    regions_of,
    state_columns,
    surfaces_of,
    why_unlimited,
)

ERROR = np.array([0.5, -1.0, 2.0, -0.5, 1.0])


def moving(**more):
    a, epoch = np.tile(np.arange(5), 2), np.repeat([0, 1], 5)
    rows = measured("range", np.full(10, 600.0), a=a, epoch=epoch, sigma=1.0)
    return assemble(SQUARE, rows, times=[0.0, 1.0], motions=(Motion(1),), **more).flat()


def test_arrivals_cost_the_scatter_about_the_best_emission_time():
    z = np.linalg.norm(PLACE - SQUARE, axis=1) + 700.0 + ERROR
    problem = assemble(SQUARE, measured("toa", z, a=np.arange(5), sigma=2.0)).flat()
    places = PLACE + np.array([[[0.0, 0.0], [30.0, -50.0]]])
    left = (np.linalg.norm(places[0, :, None] - SQUARE, axis=-1) - z) / 2.0
    expected = ((left - left.mean(1, keepdims=True)) ** 2).sum(1)
    np.testing.assert_allclose(costs_of(eliminate_nuisance(problem), places)[0][0], expected, rtol=1e-9)


def test_costs_agree_with_their_own_problem_alone():
    problem = ranges_to(PLACE, 2.0, ERROR)
    fix, costs = solve(problem, "gtrs+lsr"), eliminate_nuisance(problem)
    assert matches_problem_cost(problem, fix, costs).tolist() == [True]
    assert matches_problem_cost(problem, fix, eliminate_nuisance(ranges_to(PLACE, 2.0, 1.1 * ERROR))).tolist() == [
        False
    ]
    assert matches_problem_cost(problem, replace(fix, cost=fix.cost + 1.0), costs).tolist() == [False]
    assert is_free(problem, fix, np.array([0])).tolist() == [True]


def test_what_constraints_admit_is_the_box_of_their_sides():
    problem = moving(constraints=(*constraints.box([0.0, -np.inf], [900.0, 800.0]), *constraints.speed(30.0)))
    expected = [[0.0, -np.inf, -30.0, -30.0], [900.0, 800.0, 30.0, 30.0]]
    np.testing.assert_array_equal(admitted_states(problem, 4), expected)
    assert "anywhere at any speed" in why_unlimited(moving())
    limited = moving(constraints=(*constraints.box([0.0, 0.0], [900.0, 800.0]), *constraints.speed(30.0)))
    assert why_unlimited(limited) == ""
    region, asked = regions_of(limited, np.zeros((1, 4)), None)
    np.testing.assert_array_equal(region[0], [[0.0, 0.0, -30.0, -30.0], [900.0, 800.0, 30.0, 30.0]])
    assert asked


def test_a_target_that_stays_is_looked_for_everywhere():
    region, asked = regions_of(ranges_to(PLACE, 1.0), PLACE[None], None)
    assert np.isnan(region).all()
    assert not asked
    assert state_columns(ranges_to(PLACE, 1.0)) == slice(0, 2)
    assert state_columns(moving()) == slice(0, 4)


def test_regions_around_states_hold_them_well_inside():
    problem = moving()
    spread = np.linalg.norm(SQUARE - SQUARE.mean(0), axis=1).max()
    near, far = boxes_around(problem, np.array([[300.0, 650.0, 5.0, 0.0], [1e5, 0.0, 900.0, 0.0]]))
    np.testing.assert_allclose(near[1, :2] - near[0, :2], 20.0 * spread)
    np.testing.assert_allclose(near[:, 2:], [[-700.0, -700.0], [700.0, 700.0]])
    assert far[1, 0] > 1.9e5
    assert far[1, 2] == pytest.approx(1800.0)


def test_an_equality_of_a_coordinate_is_a_plane():
    held = replace(ranges_to(PLACE, 1.0), constraints=tuple(constraints.box([300.0, -np.inf], [300.0, np.inf])))
    planes, surface = surfaces_of(held, PLACE[None])
    assert planes.tolist() == [[[1.0, 0.0, 0.0]]]
    assert surface.shape == (1, 0)
    planes, _ = surfaces_of(ranges_to(PLACE, 1.0), PLACE[None])
    assert planes.shape == (1, 0, 3)
