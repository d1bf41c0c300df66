"""Small batched systems against numpy.linalg, and what a singular or broken item does to its neighbours: nothing."""

import numpy as np
import pytest

from optloc.base import linalg


def positive(rng, *shape):
    n = shape[-1]
    root = rng.standard_normal((*shape, n))
    size = 10.0 ** rng.uniform(-4, 4, shape)  # badly scaled unknowns
    return size[..., :, None] * (root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(n)) * size[..., None, :]


@pytest.mark.parametrize("n", [1, 2, 3, 6, 15])
def test_solve_and_inverse_are_numpys(n):
    rng = np.random.default_rng(n)
    matrix, right = positive(rng, 20, n), rng.standard_normal((20, n, 3))
    x, ok = linalg.solve(matrix, right)
    assert ok.all()
    for i in range(20):
        scale = np.sqrt(np.diag(matrix[i]))
        unit = matrix[i] / scale[:, None] / scale
        reference = np.linalg.solve(unit, right[i] / scale[:, None]) / scale[:, None]
        assert np.allclose(x[i] * scale[:, None], reference * scale[:, None], rtol=1e-8, atol=1e-10)
    inverse, ok = linalg.inverse(matrix)
    assert ok.all()
    assert np.array_equal(inverse, np.swapaxes(inverse, -1, -2))
    assert np.allclose((inverse @ matrix), np.eye(n), atol=1e-6 * np.sqrt(np.linalg.cond(matrix)).max())


def test_factor_is_the_cholesky_factor():
    matrix = positive(np.random.default_rng(1), 7, 4)
    lower, ok = linalg.factor(matrix)
    assert ok.all()
    assert np.allclose(lower, np.linalg.cholesky(matrix), rtol=1e-9)


def test_leading_axes_broadcast():
    rng = np.random.default_rng(2)
    matrix, right = positive(rng, 3, 1, 4), rng.standard_normal((5, 4, 2))
    x, ok = linalg.solve(np.broadcast_to(matrix, (3, 5, 4, 4)), np.broadcast_to(right, (3, 5, 4, 2)))
    assert x.shape == (3, 5, 4, 2)
    assert ok.shape == (3, 5)
    one, _ = linalg.solve(matrix[1, 0], right[2])
    assert np.array_equal(x[1, 2], one)


@pytest.mark.parametrize(
    "broken",
    [
        np.zeros((3, 3)),
        np.full((3, 3), np.nan),
        np.diag([1.0, -1.0, 1.0]),
        np.ones((3, 3)),
        np.diag([1.0, np.inf, 1.0]),
    ],
    ids=["zero", "nan", "indefinite", "singular", "infinite"],
)
def test_a_bad_item_is_named_and_leaves_the_others_untouched(broken):
    rng = np.random.default_rng(3)
    good = positive(rng, 4, 3)
    right = rng.standard_normal((4, 3, 1))
    alone, _ = linalg.solve(good, right)
    mixed = good.copy()
    mixed[2] = broken
    with np.errstate(invalid="ignore"):
        x, ok = linalg.solve(mixed, right)
        inverse, same = linalg.inverse(mixed)
    assert ok.tolist() == same.tolist() == [True, True, False, True]
    assert np.array_equal(x[[0, 1, 3]], alone[[0, 1, 3]])
    assert (x[2] == 0.0).all()
    assert np.isnan(inverse[2]).all()


def test_whitening_makes_unit_covariance():
    rng = np.random.default_rng(4)
    for n in (1, 2, 5):
        covariance = positive(rng, 6, n)
        W = linalg.whitening(covariance)
        assert np.allclose(W @ covariance @ np.swapaxes(W, -1, -2), np.eye(n), atol=1e-8)
        assert np.allclose(W, np.tril(W))


def test_whitening_of_many_rows_takes_those_that_are_present():
    rng = np.random.default_rng(5)
    covariance, present = positive(rng, 7, 40), rng.random((7, 40)) < 0.4
    present[0] = False
    both = present[:, :, None] & present[:, None, :]
    W = linalg.whitening(np.where(both, covariance, 0.0))
    assert np.allclose(W, np.tril(W))
    assert not W[~both].any()
    for whole, found, own in zip(covariance, W, present, strict=True):
        np.testing.assert_allclose(found[np.ix_(own, own)], linalg.whitening(whole[np.ix_(own, own)]), rtol=1e-9)


def all_pairs(count):
    a, b = np.triu_indices(count, 1)
    design = np.zeros((len(a), count))
    design[np.arange(len(a)), a], design[np.arange(len(a)), b] = 1.0, -1.0
    return design


def of_stations(design, variance):
    return (design * variance) @ design.T


@pytest.mark.parametrize("count", [3, 4, 6])
def test_whitening_of_a_singular_covariance_is_its_pseudo_inverse(count):
    """All pairs of arrival times: R = D diag(variance) D' has rank s - 1 and weighs as s - 1 rows do."""
    rng = np.random.default_rng(count)
    variance = rng.uniform(0.5, 4.0, count)
    design = all_pairs(count)
    covariance = of_stations(design, variance)
    W = linalg.whitening(covariance)
    arrivals = rng.standard_normal(count)
    residual = design @ arrivals
    star = np.concatenate([np.ones((count - 1, 1)), -np.eye(count - 1)], axis=1)
    reference = star @ arrivals @ np.linalg.solve(of_stations(star, variance), star @ arrivals)
    assert residual @ W.T @ W @ residual == pytest.approx(reference, rel=1e-9)
    assert residual @ np.linalg.pinv(covariance, hermitian=True) @ residual == pytest.approx(reference, rel=1e-9)
    assert np.linalg.matrix_rank(W) == count - 1


def test_a_singular_covariance_in_a_batch_leaves_the_others_bit_for_bit():
    regular = positive(np.random.default_rng(5), 3, 6)
    mixed = np.concatenate([regular, of_stations(all_pairs(4), np.ones(4))[None]])
    W = linalg.whitening(mixed)
    assert np.array_equal(W[:3], linalg.whitening(regular))
    assert np.isfinite(W).all()


def test_centre_and_spread_of_points_that_count():
    points = np.random.default_rng(1).normal(size=(4, 7, 3))
    inside = np.random.default_rng(2).random((4, 7)) < 0.6
    centre, spread = linalg.centre_and_spread(points, inside)
    for i in range(4):
        own = points[i, inside[i]]
        assert np.allclose(centre[i], own.mean(0), rtol=1e-15)
        assert np.isclose(spread[i], np.linalg.norm(own - own.mean(0), axis=1).max(), rtol=1e-14)
    assert np.array_equal(linalg.centre_and_spread(points)[0], points.mean(-2))
    assert not linalg.centre_and_spread(points, np.zeros((4, 7), dtype=bool))[1].any()
