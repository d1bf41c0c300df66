"""Sparse gross errors: equal to Huber's regression, optimal by its own conditions, within its cones."""

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import minimize

from formulations.sparse_errors import group_sizes, range_cone, sparse_fit, square_cone, thresholds


def regression(seed, m=24, n=4, bad=3, size=40.0):
    """Unit-noise rows of which a few are grossly wrong."""
    rng = np.random.default_rng(seed)
    B, y = 30.0 * rng.normal(size=(m, n)), rng.normal(size=n)
    gross = np.zeros(m)
    gross[rng.permutation(m)[:bad]] = size * rng.choice([-1.0, 1.0], bad)
    return B, B @ y + rng.normal(size=m) + gross, y, gross


@pytest.mark.parametrize("seed", range(6))
def test_without_cones_it_is_huber_regression(seed):
    B, g, _, _ = regression(seed)
    level = thresholds(np.ones(len(B), dtype=int))[0]

    def huber(y):
        r = np.abs(B @ y - g)
        return np.where(r <= level, 0.5 * r**2, level * r - 0.5 * level**2).sum()

    def slope(y):
        return B.T @ np.clip(B @ y - g, -level, level)

    found = minimize(huber, np.zeros(B.shape[1]), jac=slope, method="BFGS", options={"gtol": 1e-8, "maxiter": 2000})
    fit = sparse_fit(B, g, bound=True)
    assert fit.value == pytest.approx(found.fun, rel=1e-9)
    np.testing.assert_allclose(fit.y, found.x, atol=1e-6)
    assert fit.bound <= fit.value * (1.0 + 1e-9)
    assert fit.bound == pytest.approx(fit.value, rel=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_groups_meet_the_conditions_of_an_optimum(seed):
    B, g, _, _ = regression(seed)
    groups = np.arange(len(B)) // 3
    price = thresholds(np.bincount(groups))
    fit = sparse_fit(B, g, groups)
    rest = B @ fit.y - g - fit.errors
    np.testing.assert_allclose(B.T @ rest, 0.0, atol=1e-3)
    sizes, wrong = group_sizes(rest, groups, 8), group_sizes(fit.errors, groups, 8) > 0.0
    assert (sizes <= price + 1e-9).all()
    np.testing.assert_allclose(sizes[wrong], price[wrong], rtol=1e-9)
    aligned = (rest * fit.errors).sum()
    assert aligned == pytest.approx(float((price * group_sizes(fit.errors, groups, 8)).sum()), rel=1e-9)
    assert wrong.any()
    assert not wrong.all()


@pytest.mark.parametrize("make", [lambda n: range_cone(np.array([0.3, -0.2]), n, 2), lambda n: square_cone(2, n, 2)])
def test_with_a_cone_it_is_the_same_programme_written_plainly(make):
    for seed in range(4):
        B, g, _, _ = regression(seed, n=3)
        matrix = make(3)
        y, e = cp.Variable(3), cp.Variable(len(B))
        both = matrix[:, :3] @ y + matrix[:, 3]
        price = thresholds(np.ones(len(B), dtype=int))
        cost = 0.5 * cp.sum_squares(B @ y - g - e) + price @ cp.abs(e)
        plain = cp.Problem(cp.Minimize(cost), [cp.SOC(both[-1], both[:-1])])
        plain.solve(solver=cp.CLARABEL, tol_gap_rel=1e-10, tol_gap_abs=1e-10, tol_feas=1e-10)
        fit = sparse_fit(B, g, cones=[matrix], bound=True)
        assert fit.value == pytest.approx(plain.value, rel=1e-6)
        assert fit.bound <= plain.value * (1.0 + 1e-6)
        vector = matrix @ np.append(fit.y, 1.0)
        assert np.linalg.norm(vector[:-1]) <= vector[-1] + 1e-6


def test_cones_are_what_their_names_say():
    rng = np.random.default_rng(0)
    apex = np.array([0.5, -1.0, 2.0])
    for _ in range(20):
        x = 3.0 * rng.normal(size=3)
        way, square = np.linalg.norm(x - apex), x @ x
        for matrix, edge in ((range_cone(apex, 5, 4), way), (square_cone(3, 5, 3), square)):
            column = 4 if edge == way else 3
            for share, inside in ((1.001, True), (0.999, False)):
                y = np.array([*x, 0.0, 0.0, 1.0])
                y[column] = share * edge
                vector = matrix @ y
                assert (np.linalg.norm(vector[:-1]) <= vector[-1]) == inside


def test_gross_errors_of_any_size_are_found_among_many_good_rows():
    for seed in range(20):
        for size in (30.0, 1e3, 1e6):
            B, g, y, gross = regression(seed, m=60, size=size)
            fit = sparse_fit(B, g)
            assert (fit.errors[gross != 0.0] != 0.0).all()
            # each of three errors pulls by at most the threshold
            assert np.linalg.norm(B @ (fit.y - y)) < 12.0


def test_the_threshold_is_exceeded_as_often_as_it_says():
    single = thresholds(np.ones(50, dtype=int))
    np.testing.assert_allclose(single, np.sqrt(2.0 * np.log(50.0)))
    noise = np.random.default_rng(1).normal(size=(4000, 50))
    # the largest of m exceeds sqrt(2 ln m) with a probability of at most 1 / sqrt(pi ln m)
    assert (np.abs(noise) > single).any(1).mean() < 1.0 / np.sqrt(np.pi * np.log(50.0))
    sizes = np.array([1, 2, 5, 0] * 25)
    level, count = thresholds(sizes), 200_000
    clean = np.random.default_rng(2)
    shares = [
        (np.linalg.norm(clean.normal(size=(count, p)), axis=1) > level[i]).mean() for i, p in enumerate((1, 2, 5))
    ]
    np.testing.assert_allclose(shares, shares[0], atol=4e-4)
    assert level[3] == level[0]


def test_absent_rows_change_nothing():
    B, g, _, _ = regression(3)
    with_absent = sparse_fit(np.insert(B, [2, 9], 0.0, axis=0), np.insert(g, [2, 9], 0.0))
    plain = sparse_fit(B, g)
    np.testing.assert_allclose(with_absent.y, plain.y, atol=1e-7)
    np.testing.assert_allclose(np.delete(with_absent.errors, [2, 10]), plain.errors, atol=1e-5)


def test_what_cannot_be_fitted_is_not_a_number():
    B, g, _, _ = regression(4)
    flat = B.copy()
    flat[:, 1] = flat[:, 0]
    for rows, right in ((flat, g), (B[:2], g[:2]), (B, np.where(np.arange(len(g)) == 3, np.nan, g))):
        fit = sparse_fit(rows, right)
        assert np.isnan(fit.y).all()
        assert not fit.errors.any()
    with pytest.raises(ValueError, match="do not fit"):
        sparse_fit(B, g[:3])


def test_other_back_ends_go_through_cvxpy():
    B, g, _, _ = regression(5)
    cone = range_cone(np.zeros(3), 4, 3)
    usual, other = sparse_fit(B, g, cones=[cone]), sparse_fit(B, g, cones=[cone], backend="SCS")
    assert other.value == pytest.approx(usual.value, rel=1e-2)
