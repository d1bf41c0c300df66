"""Pseudo-linear bearings: exactness, absent and singular items, the bias and its removal, agreement with ML."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from formulations.bearing_ls import rays, sight

TARGET = np.array([-1.0, 5.0, 1.0])


def turned(rng, count):
    return np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]


def angles(point, station, axes=None):
    line = point - station
    if axes is not None:
        line = np.einsum("...ij,...j->...i", axes, line)
    return np.arctan2(line[..., 1], line[..., 0]), np.arctan2(line[..., 2], np.hypot(line[..., 0], line[..., 1]))


def jacobian(point, station):
    """Rows of azimuth, then elevation, from the specification."""
    d = point - station
    rho, D2 = np.hypot(d[:, 0], d[:, 1]), (d**2).sum(axis=1)
    A = np.arctan2(d[:, 1], d[:, 0])
    first = np.stack([-np.sin(A) / rho, np.cos(A) / rho, np.zeros_like(A)], axis=1)
    return np.concatenate([first, np.stack([-np.cos(A) * d[:, 2] / D2, -np.sin(A) * d[:, 2] / D2, rho / D2], axis=1)])


def ring(count):
    turn = np.arange(count) * 2 * np.pi / count
    return np.stack([np.cos(turn), np.sin(turn), 0.1 * np.cos(3 * turn)], axis=1)


def trials(count, sigma, runs, seed=0):
    rng, S = np.random.default_rng(seed), ring(count)
    A, E = angles(TARGET, S)
    A, E = A + sigma * rng.normal(size=(runs, count)), E + sigma * rng.normal(size=(runs, count))
    w = np.full((runs, count), 1.0 / sigma)
    return S, A, E, sight(A, np.broadcast_to(S, (runs, count, 3)), w, elevation=E, elevation_weight=w)


def test_rays_are_orthonormal_and_tangents_are_derivatives():
    rng = np.random.default_rng(0)
    A, E, axes, step = rng.uniform(-3, 3, 6), rng.uniform(-1.4, 1.4, 6), turned(rng, 6), 1e-6
    seen = rays(A, E, axes)
    frame = np.stack([seen.ahead, seen.across, seen.upward], axis=1)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (6, 3, 3)), atol=1e-14)
    by_A = (rays(A + step, E, axes).ahead - rays(A - step, E, axes).ahead) / (2 * step)
    by_E = (rays(A, E + step, axes).ahead - rays(A, E - step, axes).ahead) / (2 * step)
    np.testing.assert_allclose(by_A, np.cos(E)[:, None] * seen.across, atol=1e-9)
    np.testing.assert_allclose(by_E, seen.upward, atol=1e-9)


def test_exact_angles_give_the_target_in_any_axes_and_batch():
    rng = np.random.default_rng(1)
    S, P, axes = rng.normal(size=(3, 4, 5, 3)), rng.normal(size=(3, 4, 1, 3)), turned(rng, 5)
    A, E = angles(P, S, axes)
    w = rng.uniform(10, 100, (3, 4, 5))
    found = sight(A, S, w, elevation=E, elevation_weight=0.5 * w, axes=axes)
    assert found.ok.all()
    assert found.ahead.all()
    for point in (found.plain, found.weighted, found.instrumental):
        assert point.shape == (3, 4, 3)
        np.testing.assert_allclose(point, P[..., 0, :], atol=1e-9)


def test_exact_azimuths_in_the_plane():
    rng = np.random.default_rng(2)
    S, P = rng.normal(size=(20, 3, 2)), 3 * rng.normal(size=(20, 1, 2))
    line = P - S
    found = sight(np.arctan2(line[..., 1], line[..., 0]), S, np.full((20, 3), 7.0))
    assert (found.ok & found.ahead).all()
    np.testing.assert_allclose(found.instrumental, P[:, 0], atol=1e-7)


def test_absent_angles_are_not_read():
    rng = np.random.default_rng(3)
    S, w = rng.normal(size=(5, 3)), np.full(5, 50.0)
    A, E = angles(TARGET, S)
    A, E = A + 0.01 * rng.normal(size=5), E + 0.01 * rng.normal(size=5)
    fewer = sight(A[:3], S[:3], w[:3], elevation=E[:3], elevation_weight=w[:3] * [1, 0, 1])
    drop = np.array([1, 1, 1, 0, 0])
    A[3:], E[[1, 3, 4]] = np.nan, np.nan
    # an elevation whose azimuth is absent is no row
    whole = sight(A, S, w * drop, elevation=E, elevation_weight=w * [1, 0, 1, 1, 0])
    np.testing.assert_allclose(whole.instrumental, fewer.instrumental, rtol=1e-9)


def test_singular_items_disturb_no_other():
    rng = np.random.default_rng(4)
    S = rng.normal(size=(6, 2, 3))
    A, E = angles(TARGET, S)
    w = np.full((6, 2), 20.0)
    clean = sight(A, S, w, elevation=E, elevation_weight=w)
    A[1], E[1] = 0.3, 0.2  # parallel rays
    S[3, 1] = S[3, 0]  # one station twice, seen twice the same
    A[3], E[3] = A[3, 0], E[3, 0]
    w = w.copy()
    w[4] = 0.0  # nothing
    A[5, 0] = np.inf
    found = sight(A, S, w, elevation=E, elevation_weight=w)
    np.testing.assert_array_equal(found.ok, [True, False, True, False, False, False])
    assert np.isnan(found.instrumental[~found.ok]).all()
    assert not found.ahead[~found.ok].any()
    for name in ("plain", "weighted", "instrumental"):
        np.testing.assert_array_equal(getattr(found, name)[[0, 2]], getattr(clean, name)[[0, 2]])


def test_azimuths_alone_leave_the_height_open():
    S = ring(4)
    assert not sight(angles(TARGET, S)[0], S, np.ones(4)).ok


def test_points_behind_a_station_are_told():
    S = np.array([[0.0, 0.0], [1.0, 0.0]])
    found = sight(np.array([2.0, 1.0]), S, np.ones(2))
    assert found.ok
    assert not found.ahead


@pytest.mark.parametrize(("count", "sigma", "room"), [(50, 0.05, 0.3), (50, 0.02, 0.1)])
def test_many_rays_bias_is_predicted_and_the_instruments_remove_it(count, sigma, room):
    """Specification A5: the pull towards the stations is -(G'G)^-1 sum k (rho u_h + D u)."""
    runs = 200
    S, _A, _E, found = trials(count, sigma, runs)
    line = TARGET - S
    A0, E0 = angles(TARGET, S)
    seen = rays(A0, E0)
    G = np.concatenate([seen.across, seen.upward])
    flat = line * [1.0, 1.0, 0.0]
    k = 0.5 * (1 - np.exp(-2 * sigma**2))
    expected = -np.linalg.solve(G.T @ G, k * (flat + line).sum(axis=0))
    bias = {name: (getattr(found, name) - TARGET).mean(axis=0) for name in ("plain", "weighted", "instrumental")}
    rms = {name: np.sqrt(((getattr(found, name) - TARGET) ** 2).sum(axis=1).mean()) for name in bias}
    H = jacobian(TARGET, S) / sigma
    crb = np.sqrt(np.trace(np.linalg.inv(H.T @ H)))
    size = room * np.linalg.norm(expected)
    np.testing.assert_allclose(bias["plain"], expected, atol=size + 3 * crb / np.sqrt(runs))
    assert np.linalg.norm(bias["weighted"]) > 0.6 * np.linalg.norm(expected)
    assert np.linalg.norm(bias["instrumental"]) < 3 * crb / np.sqrt(runs)
    assert rms["instrumental"] == pytest.approx(crb, rel=0.15)
    assert rms["plain"] > rms["instrumental"]


@pytest.mark.parametrize(("count", "sigma"), [(2, 0.005), (4, 0.005), (4, 0.02), (4, 0.05)])
def test_few_rays_start_reaches_the_best_of_a_multi_start(count, sigma):
    S, A, E, found = trials(count, sigma, 25, seed=5)
    rng = np.random.default_rng(6)
    for i in range(25):

        def error(p, i=i):
            a, e = angles(p, S)
            a = a - A[i]
            return np.concatenate([np.arctan2(np.sin(a), np.cos(a)), e - E[i]]) / sigma

        ours = least_squares(error, found.instrumental[i], method="lm")
        others = [least_squares(error, p, method="lm").cost for p in (TARGET, *rng.normal(0, 5, (3, 3)))]
        assert ours.cost <= min(others) * (1 + 1e-6) + 1e-9
        if count > 2 and sigma < 0.03:
            assert np.linalg.norm(found.instrumental[i] - ours.x) < 0.1 * np.linalg.norm(ours.x - TARGET) + 2e-2


def test_two_stations_of_the_angles_paper():
    """Specification A5, first row, in km: CRB 5.265; RMSE PLS 5.30, WPLS 5.28, WIV 5.30; bias below its scatter."""
    S, P, runs = np.array([[-40.0, 0.0, 0.0], [40.0, 0.0, 0.0]]), np.array([-10.0, 50.0, 10.0]), 200
    H = jacobian(P, S) / 0.05
    assert np.sqrt(np.trace(np.linalg.inv(H.T @ H))) == pytest.approx(5.265, abs=1e-3)
    rng, (A, E) = np.random.default_rng(8), angles(P, S)
    A, E, w = A + 0.05 * rng.normal(size=(runs, 2)), E + 0.05 * rng.normal(size=(runs, 2)), np.full((runs, 2), 20.0)
    found = sight(A, np.broadcast_to(S, (runs, 2, 3)), w, elevation=E, elevation_weight=w)
    for point in (found.plain, found.weighted, found.instrumental):
        assert np.sqrt(((point - P) ** 2).sum(axis=1).mean()) == pytest.approx(5.30, rel=0.1)
        assert np.linalg.norm((point - P).mean(axis=0)) < 3 * 5.3 / np.sqrt(runs)


def test_weighting_matters_where_ranges_differ():
    rng = np.random.default_rng(7)
    S = np.array([[0.0, 0, 0], [4.0, 0, 0], [0, 40.0, 1.0], [-30.0, 0, 2.0]])
    P, sigma, runs = np.array([1.0, 2.0, 1.0]), 0.01, 200
    A, E = angles(P, S)
    A, E = A + sigma * rng.normal(size=(runs, 4)), E + sigma * rng.normal(size=(runs, 4))
    w = np.full((runs, 4), 1 / sigma)
    found = sight(A, np.broadcast_to(S, (runs, 4, 3)), w, elevation=E, elevation_weight=w)
    H = jacobian(P, S) / sigma
    crb = np.sqrt(np.trace(np.linalg.inv(H.T @ H)))
    rms = [np.sqrt(((x - P) ** 2).sum(axis=1).mean()) for x in (found.plain, found.weighted, found.instrumental)]
    assert rms[0] > 3 * crb
    assert rms[1] == pytest.approx(crb, rel=0.15)
    assert rms[2] == pytest.approx(crb, rel=0.15)
