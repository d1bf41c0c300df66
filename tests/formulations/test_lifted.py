"""Baselines: the order-one lift is loose for range differences, as documented; the nonlinear form is only local."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from formulations.lifted import lifted_program, lifted_ranges


def case(rng, kind, count, sigma=0.03):
    S, P = rng.uniform(-1, 1, (count, 3)), rng.uniform(-1.5, 1.5, 3)
    D = np.eye(count) if kind == "range" else np.concatenate([-np.ones((count - 1, 1)), np.eye(count - 1)], axis=1)
    white = np.linalg.inv(np.linalg.cholesky(sigma**2 * D @ D.T))
    z = D @ (np.linalg.norm(P - S, axis=1) + sigma * rng.normal(size=count))
    return S, P, white @ D, white @ z


def best(S, K, z, starts):
    found = [
        least_squares(lambda p: K @ np.linalg.norm(p - S, axis=1) - z, x, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        for x in starts
    ]
    least = min(found, key=lambda one: one.cost)
    return least.x, 2 * least.cost


@pytest.mark.parametrize("count", [5, 6, 8])
def test_range_differences_are_never_tight(count):
    rng, share = np.random.default_rng(count), []
    for _ in range(8):
        S, P, K, z = case(rng, "tdoa", count)
        _x, cost = best(S, K, z, [P, *rng.normal(0, 2, (2, 3))])
        found = lifted_ranges(K, z, S)
        assert 0.0 <= found.bound <= cost
        assert found.bound <= max(found.value, 0.0) + 1e-6
        assert found.rank_ratio > 1e-3
        # the ranges read off are not the distances of the point read off
        assert np.abs(np.linalg.norm(found.point - S, axis=1) - found.ranges).max() > 1e-3
        share.append(1.0 - max(found.value, 0.0) / cost)
    assert np.median(share) > 0.7
    assert min(share) > 0.2


def test_ranges_may_be_tight_and_the_bound_is_valid():
    rng, tight = np.random.default_rng(0), 0
    for _ in range(10):
        S, P, K, z = case(rng, "range", 6)
        x, cost = best(S, K, z, [P, *rng.normal(0, 2, (2, 3))])
        found = lifted_ranges(K, z, S)
        assert found.bound <= cost * (1 + 1e-6)
        if found.rank_ratio < 1e-6:
            tight += 1
            np.testing.assert_allclose(found.point, x, atol=2e-2)
            assert found.value == pytest.approx(cost, rel=1e-2)
    assert 0 < tight


@pytest.mark.parametrize("kind", ["tdoa", "range"])
def test_nonlinear_form_agrees_with_scipy_from_near(kind):
    rng = np.random.default_rng(1)
    for _ in range(5):
        S, P, K, z = case(rng, kind, 6)
        x, cost = best(S, K, z, [P])
        found = lifted_program(K, z, S, P)
        assert found.success
        assert found.cost == pytest.approx(cost, rel=1e-5)
        np.testing.assert_allclose(found.x[:3], x, atol=1e-4)
        np.testing.assert_allclose(np.linalg.norm(found.x[:3] - S, axis=1), found.x[3:], atol=1e-6)


def test_the_lift_drops_no_range_sign():
    rng = np.random.default_rng(2)
    S, _P, K, z = case(rng, "tdoa", 6)
    assert (lifted_ranges(K, z, S).ranges >= -1e-6).all()
