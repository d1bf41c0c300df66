"""Costs of runs: all rows, and few of them, by plain formulas."""

import numpy as np
import pytest
from proof.runs.small import STATE, at_rest, course, residual, residual_at_rest

from optloc.proof.batch import costs_at
from optloc.proof.runs.prove import costs_of_courses, costs_of_runs
from optloc.proof.runs.run_costs import course_costs, few_costs, run_costs

pytestmark = pytest.mark.usefixtures("plainly")


def test_a_run_costs_the_sum_of_squares_of_all_its_rows():
    places = STATE[:2] + np.array([[[0.0, 0.0], [50.0, -80.0], [2e3, 3e3]]])
    costs = run_costs(at_rest())
    np.testing.assert_allclose(costs_of_runs(costs, places)[0][0], (residual_at_rest(places[0]) ** 2).sum(-1))
    assert costs.dense == pytest.approx(12.0)
    assert costs.take(slice(0)).runs == ()


def test_few_rows_cost_nowhere_more():
    places = STATE[:2] + np.random.default_rng(3).normal(size=(1, 20, 2)) * 500.0
    few, _ = costs_at(few_costs(at_rest()), places)
    assert (few[0] <= (residual_at_rest(places[0]) ** 2).sum(-1) * (1.0 + 1e-9)).all()


def test_a_course_costs_the_sum_of_squares_at_every_state():
    states = STATE + np.random.default_rng(4).normal(size=(1, 5, 4)) * [100.0, 100.0, 5.0, 5.0]
    costs = course_costs(course())
    np.testing.assert_allclose(costs_of_courses(costs, states)[0][0], (residual(states[0]) ** 2).sum(-1), rtol=1e-9)
    whole, few = costs.courses[0]
    assert len(few.kinds) <= len(whole.kinds) == 15
    assert (np.diff(whole.since) > 0.0).all()
