"""Damped Newton steps in search coordinates, against damped Newton steps of another make."""

import numpy as np
import pytest
from proof.costs import random_case

from optloc.proof.descents import descend, newton_step
from optloc.proof.search_space import chart_at, curve_box, value_at, write_centre

pytestmark = pytest.mark.usefixtures("plainly")


@pytest.mark.parametrize("d", [2, 3])
def test_a_descent_ends_at_the_minimum_that_another_one_finds(d):
    case, truth = random_case(np.random.default_rng(d), d)
    cost, box = case.tables
    x = case.minimum(truth)
    chart, _ = chart_at(cost, x + 100.0, box)
    box.at[:] = 0.0
    assert descend(cost, chart, box) == pytest.approx(case.cost(x), rel=1e-9)
    np.testing.assert_allclose(box.centre[:d], x, atol=1e-3)
    assert (box.half == 0.0).all()


def test_an_undamped_step_is_that_of_newton():
    case, truth = random_case(np.random.default_rng(5), 3)
    cost, box = case.tables
    x = case.minimum(truth) + np.array([3.0, -2.0, 1.0])
    chart, _ = chart_at(cost, x, box)
    box.at[:], box.half[:] = 0.0, 0.0
    write_centre(chart.origin, chart.sense, box.at, box.centre)
    value_at(cost, chart, box)
    curve_box(cost, chart, box)
    length = newton_step(box, 0.0)
    gradient, hessian = case.derivatives(x)
    step = np.linalg.solve(hessian, gradient)
    np.testing.assert_allclose(chart.sense @ box.solve[0], step, rtol=1e-6)
    assert length == pytest.approx(gradient @ step, rel=1e-6)


def test_no_descent_begins_where_the_cost_is_no_number():
    case, truth = random_case(np.random.default_rng(6), 2)
    cost, box = case.tables
    chart, _ = chart_at(cost, truth, box)
    box.at[:] = np.nan
    assert descend(cost, chart, box) == np.inf
