"""Search coordinates and tables of a box, against values and derivatives of the cost by formulas of their own."""

import numpy as np
import pytest
from proof.costs import random_case

from optloc.proof.search_space import (
    accuracy_floor,
    axes_of_next_piece,
    chart_at,
    curve_box,
    equal_within,
    is_convex,
    value_at,
    widen_by_rounding,
    without_differences,
    write_centre,
)
from optloc.proof.surface import FIRST, SECOND, UP

pytestmark = pytest.mark.usefixtures("plainly")


@pytest.fixture(params=[2, 3])
def case(request):
    return random_case(np.random.default_rng(10 + request.param), request.param)


def test_one_unit_of_a_search_coordinate_is_one_sigma(case):
    case, truth = case
    cost, box = case.tables
    x, d = case.minimum(truth), case.d
    chart, good = chart_at(cost, x, box)
    assert good
    line = x - case.stations
    J = case.K @ (line / np.linalg.norm(line, axis=1, keepdims=True))
    T = chart.sense[:d, :d]
    np.testing.assert_allclose(T.T @ J.T @ J @ T, np.eye(d), atol=1e-2)  # axes are principal to a hundredth
    np.testing.assert_allclose(chart.back[:d, :d] @ T, np.eye(d), atol=1e-12)
    np.testing.assert_allclose(chart.gram, chart.sense.T @ chart.sense, atol=1e-9)


def test_tables_of_a_point_have_the_derivatives_of_the_cost(case):
    case, truth = case
    cost, box = case.tables
    chart, _ = chart_at(cost, case.minimum(truth), box)
    box.at[:], box.half[:] = [2.0, -1.0, 0.0], 0.0
    assert value_at(cost, chart, box) == pytest.approx(case.cost(box.centre[: case.d]), rel=1e-9)
    curve_box(cost, chart, box)
    gradient, hessian = case.derivatives(box.centre[: case.d])
    T = chart.sense[: case.d]
    np.testing.assert_allclose(box.sums[6:9], T.T @ gradient, atol=1e-6)
    expected = (T.T @ hessian @ T)[np.triu_indices(3)]
    np.testing.assert_allclose(box.sums[:6], expected, atol=1e-6)
    # the Hessian is within its bounds at the point itself
    assert is_convex(cost, chart, box, 0.0) == (np.linalg.eigvalsh(hessian)[0] > 0.0)


def test_costs_count_as_equal_within_their_rounding():
    assert equal_within(1e-6, 100.0, 0.0) == 1e-6
    assert equal_within(1e-6, 100.0, 1e-3) == pytest.approx(1e-3 * (80.0 + 0.024))


def test_a_box_is_widened_by_the_rounding_of_its_place(case):
    case, truth = case
    cost, box = case.tables
    chart, _ = chart_at(cost, case.minimum(truth), box)
    box.at[:], half = 0.0, np.zeros(3)
    write_centre(chart.origin, chart.sense, box.at, box.centre)
    widen_by_rounding(chart, box.centre, half)
    # one unit in the last place of a coordinate, seen in sigma
    ulp = np.abs(chart.back[: case.d, : case.d]) @ np.spacing(np.abs(box.centre[: case.d]))
    assert (half[: case.d] >= ulp).all()
    assert (half[: case.d] < 1e-6).all()


def test_a_turned_piece_of_a_surface_has_a_third_of_its_axes_upward():
    case, truth = random_case(np.random.default_rng(4), 3)
    cost, box = case.tables
    chart, _ = chart_at(cost, truth, box)
    surface = np.zeros(40)
    for first, axis in zip((FIRST, SECOND, UP), np.eye(3), strict=True):
        surface[first : first + 3] = axis
    own = chart._replace(surface=surface)
    ups = [tuple(axes_of_next_piece(cost, own, side).surface[UP : UP + 3]) for side in range(6)]
    assert len(set(ups)) == 6
    assert ups[0] == (0.0, 0.0, 1.0)
    assert ups[1] == (0.0, 0.0, -1.0)
    assert not without_differences(own._replace(differs=True)).differs


def test_the_floor_grows_with_measurements_and_distance(case):
    case, _ = case
    cost, _ = case.tables
    floors = [
        accuracy_floor(cost.kinds, cost.data, cost.weight, cost.w, np.array([far, 0.0, 0.0]), 0.25)
        for far in (0.0, 1e6, 1e9)
    ]
    assert np.linalg.norm(case.w) < floors[0] < floors[1] < floors[2]
    assert floors[2] - floors[1] == pytest.approx(0.25 * cost.weight.sum() * (1e9 - 1e6), rel=1e-9)
