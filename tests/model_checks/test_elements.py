"""Rows of a fix as independent errors of groups, against covariances and derivatives of another make."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import assemble, measured
from optloc.model_checks.elements import GROUPINGS, elements, ends_of, kinds_of, typical_sigma

THERE = np.array([330.0, 630.0])


def test_errors_of_stations_make_up_the_covariance_of_range_differences():
    a = np.arange(1, 5)
    problem = assemble(SQUARE, measured("tdoa", np.zeros(4), a=a, b=0, arrival_sigma=3.0)).flat()
    made = elements(problem, PLACE[None], "station")
    covariance = made.effect[0] @ made.effect[0].T + made.fixed[0]
    np.testing.assert_allclose(covariance, 9.0 * (np.eye(4) + 1.0), atol=1e-9)
    assert sorted(made.names) == sorted(problem.stations.names)


def test_residuals_and_columns_are_those_of_plain_ranges():
    made = elements(ranges_to(PLACE, 2.0), THERE[None], "kind")

    def h(place):
        return np.linalg.norm(place - SQUARE, axis=1)

    np.testing.assert_allclose(made.residual[0], h(PLACE) - h(THERE), atol=1e-9)
    slope = np.stack([(h(THERE + step) - h(THERE - step)) / 2e-3 for step in 1e-3 * np.eye(2)], axis=1)
    np.testing.assert_allclose(made.jacobian[0], slope, atol=1e-6)
    np.testing.assert_allclose(made.sigma[0], 2.0)


def test_a_difference_belongs_to_both_of_its_stations_with_opposite_signs():
    problem = assemble(SQUARE, measured("tdoa", np.zeros(1), a=2, b=0, sigma=4.0)).flat()
    ends = ends_of(problem, "station")
    assert ends.sign.tolist() == [[1.0, -1.0]]
    assert ends.name[0].tolist() == [problem.stations.names[2], problem.stations.names[0]]
    assert kinds_of(problem).tolist() == ["tdoa"]
    assert typical_sigma(problem, "kind") == {"tdoa": pytest.approx(4.0)}


@pytest.mark.parametrize("by", GROUPINGS)
def test_absent_rows_have_no_errors(by):
    problem = ranges_to(PLACE, 2.0)
    made = elements(problem.with_rows(weight=np.array([[1.0, 1.0, 0.0, 1.0, 1.0]])), PLACE[None], by)
    assert (made.of_effect >= 0).sum() == 4
