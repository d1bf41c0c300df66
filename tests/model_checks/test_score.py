"""Score tests of offsets, against the fall of the cost of linear fits."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, least_cost, ranges_to

from optloc.model_checks.score import candidates, descend, explain_misfit, fit_anywhere, score


def test_the_statistic_of_an_offset_is_the_fall_of_the_cost_of_a_linear_fit():
    sigma, error = 2.0, np.array([1.0, -3.0, 9.0, 0.5, 2.0])
    problem = ranges_to(PLACE, sigma, error)
    offsets = tuple(one for one in candidates(problem) if one.is_channel_offset)
    assert [one.bias.members[0] for one in offsets] == list(problem.stations.names)
    J = (PLACE - SQUARE) / np.linalg.norm(PLACE - SQUARE, axis=1, keepdims=True) / sigma
    y = error / sigma
    expected = [least_cost(y, J) - least_cost(y, np.column_stack([J, np.eye(5)[i]])) for i in range(5)]
    found = score(problem, PLACE[None], offsets)
    np.testing.assert_allclose([one[0] for one in found], expected, rtol=1e-6)


def test_one_wrong_station_explains_a_misfit():
    problem = ranges_to(PLACE, 0.5, np.array([0.0, 0.0, 40.0, 0.0, 0.0]))
    told = explain_misfit(problem, PLACE[None])
    assert problem.stations.names[2] in told[0].candidate.name
    assert told[0].cost < 1.0


def test_data_that_fit_need_no_explanation():
    assert explain_misfit(ranges_to(PLACE, 1.0, np.array([0.5, -0.5, 0.3, 0.1, -0.2])), PLACE[None]) == ()


def test_descents_from_all_around_end_at_the_target():
    problem = ranges_to(PLACE, 1.0)
    found = fit_anywhere(problem)
    np.testing.assert_allclose(found.x, PLACE[None], atol=1e-3)
    x, cost = descend(problem, PLACE[None] + 50.0)
    np.testing.assert_allclose(x, PLACE[None], atol=1e-3)
    assert cost[0] == pytest.approx(0.0, abs=1e-6)
