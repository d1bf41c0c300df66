"""Unit directions lifted: the minorant, the rigorous bound of the angular ML cost, tightness, guess-free starts."""

import numpy as np
import pytest
from often import few
from scipy.optimize import least_squares

from formulations.bearing_ls import meeting, predict, rays
from formulations.direction_sdp import angle_bound, directions, minorant


def errors(point, station, angle, axes=None):
    error = predict(point, station, axes) - angle
    error[:, 0] = np.arctan2(np.sin(error[:, 0]), np.cos(error[:, 0]))
    return error


def case(rng, count, sigma):
    S = rng.uniform(-1, 1, (count, 3)) * [1.0, 1.0, 0.2]
    r, a = rng.uniform(1, 4), rng.uniform(0, 2 * np.pi)
    P = np.array([r * np.cos(a), r * np.sin(a), rng.uniform(0.1, 1.5)])
    s = np.broadcast_to(sigma, (count, 2)) * 1.0
    return S, P, s, predict(P, S) + s * rng.normal(size=(count, 2))


def best(S, z, s, starts, axes=None):
    """The ML point by SciPy from several starts."""
    found = [
        least_squares(lambda p: (errors(p, S, z, axes) / s).ravel(), x, method="lm", xtol=1e-13, ftol=1e-13, gtol=1e-13)
        for x in starts
        if np.isfinite(x).all()
    ]
    least = min(found, key=lambda one: one.cost)
    return least.x, 2 * least.cost


@pytest.mark.parametrize("wide", [0.05, 0.3, 1.0])
def test_minorant_lies_below_on_the_cap_and_touches(wide):
    rng = np.random.default_rng(0)
    count = 400
    elevation, sigma = rng.uniform(-1.5, 1.5, count), wide * rng.uniform(0.02, 1, (count, 2))
    error = sigma * rng.normal(size=(count, 2))
    error[:, 1] = np.clip(error[:, 1], elevation - 1.57, elevation + 1.57)
    rho = np.sqrt(((error / sigma) ** 2).sum(axis=1).max() * 1.1)
    found = minorant(error, sigma, elevation, rho**2)
    frame = rays(np.zeros(count), elevation)
    for _ in range(100):
        other = rng.uniform(-1, 1, (count, 2)) * rho * sigma
        other[:, 0] = np.clip(other[:, 0], -np.pi, np.pi)
        up = elevation - error[:, 1] + other[:, 1]
        fits = np.abs(up) <= 0.5 * np.pi
        v = rays(other[:, 0] - error[:, 0], up).ahead
        w = np.stack([(part * v).sum(axis=1) for part in (frame.ahead, frame.across, frame.upward)], axis=1)
        w[:, 0] -= 1.0
        q = found.constant + (2 * found.linear * w + found.square * w**2).sum(axis=1)
        f = ((other / sigma) ** 2).sum(axis=1)
        assert (q <= f * (1 + 1e-12) + 1e-12)[fits].all()
        assert ((w * w).sum(axis=1) <= found.reach**2 + 1e-12)[fits].all()
    used = found.square[:, 1] > 0
    assert used.mean() > (0.95 if wide < 0.1 else 0.2)
    np.testing.assert_allclose(found.constant[used], ((error / sigma) ** 2).sum(axis=1)[used])


@pytest.mark.parametrize(
    ("count", "sigma", "share"), [(2, 0.005, 1.0), (2, 0.05, 0.95), (4, 0.02, 1.0), (4, 0.05, 0.9)]
)
def test_bound_reaches_the_ml_cost_where_tight(count, sigma, share):
    rng, tight = np.random.default_rng(count), []
    for _ in range(20):
        S, P, s, z = case(rng, count, sigma)
        start = directions(z, s, S)
        x, cost = best(S, z, s, [P, start.point])
        proof = angle_bound(z, s, S, x)
        assert proof.bound <= cost * (1 + 1e-9)
        tight.append(proof.rank_ratio < 1e-5)
        if tight[-1]:
            assert cost - proof.bound < 1e-3
            assert start.answer.solved
    assert np.mean(tight) >= share


@pytest.mark.parametrize("trials", few([50, 100], 1))
def test_bound_holds_for_any_fix_noise_and_layout(trials):
    rng = np.random.default_rng(1)
    for _ in range(trials):
        count = int(rng.integers(2, 5))
        S, P = rng.uniform(-1, 1, (count, 3)), 2 * rng.normal(size=3)
        s = np.exp(rng.uniform(np.log(0.003), np.log(0.3), (count, 2)))
        z = predict(P, S) + s * rng.normal(size=(count, 2))
        z[:, 1] = np.clip(z[:, 1], -1.57, 1.57)
        cost = best(S, z, s, [P, *rng.normal(0, 3, (2, 3))])[1]
        for point in (P, 2 * rng.normal(size=3)):
            assert 0.0 <= angle_bound(z, s, S, point).bound <= cost * (1 + 1e-9)


def test_a_poor_fix_is_not_certified():
    rng = np.random.default_rng(2)
    for _ in range(10):
        S, P, s, z = case(rng, 4, 0.02)
        x, _cost = best(S, z, s, [P])
        poor = x + 0.2 * rng.normal(size=3)
        assert ((errors(poor, S, z) / s) ** 2).sum() - angle_bound(z, s, S, poor).bound > 1e-2


def test_start_needs_no_guess():
    rng = np.random.default_rng(3)
    for _ in range(20):
        S, P, s, z = case(rng, 4, 0.02)
        found = directions(z, s, S)
        np.testing.assert_allclose(np.linalg.norm(found.direction, axis=1), 1.0)
        ours, reference = best(S, z, s, [found.point])[1], best(S, z, s, [P, *rng.normal(0, 4, (3, 3))])[1]
        assert ours <= reference * (1 + 1e-6) + 1e-9
        assert found.rank_ratio < 1e-5


def test_exact_angles_in_own_axes():
    rng = np.random.default_rng(4)
    S, P, axes = rng.normal(size=(3, 3)), np.array([3.0, 1.0, 2.0]), np.linalg.qr(rng.normal(size=(3, 3, 3)))[0]
    z, s = predict(P, S, axes), np.full((3, 2), 0.01)
    found = directions(z, s, S, axes=axes)
    np.testing.assert_allclose(found.point, P, atol=1e-5)
    assert angle_bound(z, s, S, P, axes=axes).bound <= 1e-9
    z = z + 0.01 * rng.normal(size=(3, 2))
    x, cost = best(S, z, s, [P], axes)
    assert angle_bound(z, s, S, x, axes=axes).bound == pytest.approx(cost, abs=1e-3)


def test_rays_that_diverge_are_sent_to_infinity_not_behind():
    S, s = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.full((2, 2), 0.02)
    z = np.array([[1.60, 0.3], [1.54, 0.3]])  # they meet behind
    found = directions(z, s, S)
    assert found.direction[0] @ found.direction[1] > 1 - 1e-6
    far = 1e8 * np.array([np.cos(1.57), np.sin(1.57), np.tan(0.3)])
    x, cost = best(S, z, s, [far])
    assert 0 <= cost - angle_bound(z, s, S, x).bound < 1e-2


def test_meeting_of_lines():
    S = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1.0, 0.5]])
    line = np.array([0.3, 0.4, 2.0]) - S
    np.testing.assert_allclose(meeting(line / np.linalg.norm(line, axis=1)[:, None], S), [0.3, 0.4, 2.0], atol=1e-12)
    assert np.isnan(meeting(np.tile([0.0, 0.0, 1.0], (3, 1)), S)).all()


def test_another_back_end_gives_the_point_but_no_bound():
    rng = np.random.default_rng(5)
    S, _P, s, z = case(rng, 2, 0.02)
    other = directions(z, s, S, backend="SCS")
    assert other.bound == 0.0
    np.testing.assert_allclose(other.direction, directions(z, s, S).direction, atol=1e-3)
