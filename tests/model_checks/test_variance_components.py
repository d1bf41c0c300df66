"""Variances of groups and tests of single errors, against dense matrices written down plainly."""

import numpy as np
import pytest
from model_checks.small import means

from optloc.base.errors import InvalidProblem
from optloc.model_checks.variance_components import error_sizes, fit, snooped, tested as told, total


def test_tests_are_those_of_the_dense_projection():
    rng = np.random.default_rng(3)
    made, variance = means(rng.standard_normal((2, 4))), np.array([1.0, 4.0, 2.0, 0.5])
    found = told(made, np.broadcast_to(variance, (2, 4)))
    inverse, J = np.diag(1.0 / variance), np.ones((4, 1))
    P = inverse - inverse @ J @ np.linalg.inv(J.T @ inverse @ J) @ J.T @ inverse
    np.testing.assert_allclose(found.matrix[0, :4, :4], P, atol=1e-12)
    np.testing.assert_allclose(found.vector[:, :4], made.residual @ P, atol=1e-12)
    np.testing.assert_allclose(found.cost, [v @ P @ v for v in made.residual], rtol=1e-12)
    assert found.dof.tolist() == [3, 3]


def test_the_size_of_an_error_is_its_distance_from_the_mean_of_the_others():
    rows = np.array([[1.0, 2.0, 3.0, 40.0]])
    tests = told(means(rows), np.ones(()))
    shift, sigma = error_sizes(tests, slice(0, 4))
    assert shift[0, 3] == pytest.approx(40.0 - 2.0)
    assert sigma[0, 3] == pytest.approx(np.sqrt(1.0 + 1.0 / 3.0))
    found = snooped(tests, slice(0, 4), 3.5)
    assert found.gross.tolist() == [[False, False, False, True]]
    assert found.tests.cost[0] == pytest.approx(2.0)


def test_variances_of_two_groups_are_told_apart():
    rng = np.random.default_rng(4)
    errors = rng.standard_normal((400, 6)) * np.array([1.0, 1.0, 1.0, 3.0, 3.0, 3.0])
    none = np.zeros(2, dtype=bool)
    found = fit(means(errors, groups=[0, 0, 0, 1, 1, 1]), none, none)
    np.testing.assert_allclose(found.variance, [1.0, 9.0], rtol=0.15)
    assert (found.low < found.variance).all()
    assert (found.variance < found.high).all()


def test_fixes_without_redundancy_show_no_noise():
    none = np.zeros(1, dtype=bool)
    with pytest.raises(InvalidProblem, match="no fix has more rows than unknowns"):
        fit(means(np.ones((3, 1))), none, none)


def test_totals_are_sums_over_groups():
    group = np.array([[0, 1, -1], [1, 1, 0]])
    assert total(group, 2).tolist() == [2.0, 3.0]
    assert total(group, 2, np.array([[1.0, 2.0, 9.0], [3.0, 4.0, 5.0]])).tolist() == [6.0, 9.0]
