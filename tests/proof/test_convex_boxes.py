"""Boxes around minima: convex in every sample, and known minima recognised there."""

import numpy as np
import pytest
from proof.costs import beside, random_case

from optloc.proof.atlas import atlas_of, set_centre, write_position
from optloc.proof.box import station_cube
from optloc.proof.convex_boxes import (
    accuracy_floor_far,
    is_known,
    known_minima,
    limit_half_widths,
    set_convex,
    set_minimum,
)
from optloc.proof.search_space import HIDDEN_REACH, chart_at

pytestmark = pytest.mark.usefixtures("plainly")


@pytest.fixture(params=[2, 3])
def fixed(request):
    rng = np.random.default_rng(20 + request.param)
    case, truth = random_case(rng, request.param)
    cost, box = case.tables
    x = case.minimum(truth)
    chart, _ = chart_at(cost, x, box)
    return rng, case, cost, box, x, chart


def least_curvature(case, places):
    return np.linalg.eigvalsh(case.derivatives(places)[1])[:, 0].min()


def test_the_hessian_is_positive_all_over_a_convex_box(fixed):
    rng, case, cost, box, x, chart = fixed
    box.at[:] = 0.0
    hull = np.array([1e3, 1e3, 1e3 if case.d == 3 else 0.0])
    assert set_convex(cost, chart, box, hull, 0.0)
    assert (box.half[: case.d] > 1.0).all()
    s = rng.uniform(-1.0, 1.0, (300, 3)) * box.half
    assert least_curvature(case, x + (s @ chart.sense.T)[:, : case.d]) > 0.0


def test_the_box_of_a_minimum_in_the_atlas_is_convex_too(fixed):
    rng, case, cost, box, x, _ = fixed
    d, atlas = case.d, atlas_of(*station_cube(cost.kinds, cost.data, x), case.d, 1)
    assert set_minimum(cost, box, atlas, 0, x, 0.0, 1e-6, np.inf)
    assert not set_minimum(cost, box, atlas, 0, x, case.cost(x) + 1.0, 1e-6, np.inf)
    s, places = rng.uniform(-1.0, 1.0, (100, 3)) * atlas.minima.sides[0], np.empty((100, d))
    for one, place in zip(s, places, strict=True):
        set_centre(atlas, 2 * d + 1, one)
        write_position(atlas, place)
    assert least_curvature(case, places) > 0.0
    assert accuracy_floor_far(cost, atlas) > np.linalg.norm(case.w)


def test_the_fix_comes_first_among_known_minima_and_slopes_are_left_out(fixed):
    _, case, cost, box, x, chart = fixed
    corners = np.full(3, 1e4)
    corners[case.d :] = 0.0
    slope = x + 30.0
    found = known_minima(cost, chart, box, beside([slope], case.d), -corners, corners, 0.0, case.cost(x) + 1.0, True)
    minima, sides, count, free = found
    assert (count, free) == (1, 1)
    np.testing.assert_array_equal(minima[0], 0.0)
    assert (sides[0, : case.d] > 0.0).all()


def test_a_box_is_known_only_if_all_of_it_is_inside():
    minima, sides = np.array([[1.0, 0.0, 0.0]]), np.array([[2.0, 2.0, 2.0]])
    assert is_known(np.array([2.0, 1.0, 0.0]), np.ones(3), minima, sides)
    assert not is_known(np.array([2.0, 1.0, 0.0]), np.array([1.1, 1.0, 1.0]), minima, sides)


def test_a_hidden_minimum_reaches_no_farther_than_allowed():
    sense, hull = np.diag([1e3, 10.0, 1.0]), np.array([1e4, 1e4, 1e4])
    limit_half_widths(sense, hull)
    assert np.abs(sense @ hull).max() == pytest.approx(HIDDEN_REACH)
    small = np.array([1.0, 1.0, 1.0])
    limit_half_widths(sense, small)
    assert small.tolist() == [1.0, 1.0, 1.0]
