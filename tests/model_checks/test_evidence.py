"""Errors that residuals show, against fits without the rows."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, least_cost, ranges_to

from optloc.model_checks.evidence import drops, errors, influence, log_tail
from optloc.model_checks.groups import groups_of


def test_the_drop_without_a_row_is_the_fall_of_the_cost_of_a_linear_fit():
    sigma, error = 2.0, np.array([1.0, -3.0, 14.0, 0.5, 2.0])
    problem = ranges_to(PLACE, sigma, error)
    away = PLACE - SQUARE
    J = away / np.linalg.norm(away, axis=1, keepdims=True) / sigma
    drop, dof = drops(influence(problem, PLACE), [np.array([i]) for i in range(5)])
    whole = least_cost(error / sigma, J)
    kept = [np.delete(np.arange(5), i) for i in range(5)]
    np.testing.assert_allclose(drop, [whole - least_cost(error[k] / sigma, J[k]) for k in kept], rtol=1e-6)
    assert dof.tolist() == [1] * 5


def test_a_gross_error_is_estimated_with_the_sigma_of_row_and_prediction():
    problem = ranges_to(PLACE, 1.0, np.array([0.0, 0.0, 50.0, 0.0, 0.0]))
    group = groups_of(problem, np.ones(5, dtype=bool), ("row",))[2]
    found = errors(influence(problem, PLACE), [group])[0]
    assert found.value[0] == pytest.approx(50.0, rel=1e-6)
    J = (PLACE - SQUARE) / np.linalg.norm(PLACE - SQUARE, axis=1, keepdims=True)
    rest = np.delete(J, 2, axis=0)
    predicted = J[2] @ np.linalg.inv(rest.T @ rest) @ J[2]
    assert found.sigma[0] == pytest.approx(np.sqrt(1.0 + predicted), rel=1e-6)


def test_tails_of_two_degrees_of_freedom_are_exponential_even_beyond_numbers():
    statistic = np.array([0.0, 3.0, 500.0, 4000.0])
    np.testing.assert_allclose(log_tail(statistic, np.full(4, 2)), -statistic / 2.0, rtol=1e-12)
    assert log_tail(np.array(9.0), np.array(0)) == 0.0
