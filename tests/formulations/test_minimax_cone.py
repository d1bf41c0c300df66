"""Cones of bounded angle errors: minimax against brute force, emptiness and its proof, balls and extents."""

import numpy as np
import pytest
from scipy.optimize import minimize

from formulations.minimax_cone import angles, common, extent, minimax

STATIONS = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1.0, 0.2], [-0.5, -0.8, 0.1]])
TARGET = np.array([0.5, 1.5, 2.0])


def towards(point, station, rng=None, sigma=0.0):
    u = point - station
    u = u / np.linalg.norm(u, axis=-1, keepdims=True)
    if rng is not None:
        u = u + sigma * rng.normal(size=u.shape)
    return u / np.linalg.norm(u, axis=-1, keepdims=True)


@pytest.mark.parametrize(("dim", "count", "sigma"), [(3, 2, 0.01), (3, 4, 0.005), (3, 4, 0.05), (2, 4, 0.02)])
def test_minimax_equals_brute_force(dim, count, sigma):
    rng = np.random.default_rng(count + dim)
    S, P = STATIONS[:count, :dim], TARGET[:dim]
    for _ in range(4):
        u, scale = towards(P, S, rng, sigma), sigma * rng.uniform(0.5, 2, count)
        found = minimax(u, S, scale)
        assert found.meet
        assert found.least <= found.level <= found.least * (1 + 2e-3)

        def worst(p, u=u, scale=scale):
            return (angles(p, u, S) / scale).max()

        assert worst(found.point) == pytest.approx(found.level)
        starts = (P, found.point, found.point + 0.3 * rng.normal(size=dim))
        brute = min(
            minimize(worst, x, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-9, "maxfev": 1200}).fun
            for x in starts
        )
        assert found.least <= brute * (1 + 1e-9)
        assert found.level <= brute * (1 + 2e-3)
        assert ((found.point - S) * u).sum(axis=1).min() > 0


def test_exact_bearings_have_level_zero():
    found = minimax(towards(TARGET, STATIONS), STATIONS, np.full(4, 0.01))
    assert found.level < 1e-3
    np.testing.assert_allclose(found.point, TARGET, atol=1e-4)


def test_minimax_beats_a_planar_grid():
    rng = np.random.default_rng(0)
    S, P = STATIONS[:3, :2], TARGET[:2]
    u = towards(P, S, rng, 0.05)
    found = minimax(u, S, np.ones(3))
    grid = np.stack(np.meshgrid(np.linspace(-2, 6.003, 801), np.linspace(-2, 6.003, 801)), axis=-1).reshape(-1, 2)
    line = grid[:, None] - S
    line = line / np.linalg.norm(line, axis=-1, keepdims=True)
    worst = np.arccos(np.clip((line * u).sum(axis=-1), -1, 1)).max(axis=1)
    assert found.level <= worst.min()
    assert np.linalg.norm(grid[worst.argmin()] - found.point) < 0.1


def test_a_ball_is_inscribed_and_the_largest():
    rng = np.random.default_rng(1)
    u, theta = towards(TARGET, STATIONS, rng, 0.01), np.full(4, 0.05)
    found = common(u, STATIONS, theta)
    assert found.meet
    assert found.margin > 0
    assert found.margin <= found.most <= found.margin + 1e-4
    sphere = rng.normal(size=(400, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    inside = [(angles(found.point + 0.9999 * found.margin * v, u, STATIONS) <= theta).all() for v in sphere]
    assert all(inside)
    # distance of other points to the nearest cone is never larger
    for _ in range(200):
        p = found.point + 0.05 * rng.normal(size=3)
        line = p - STATIONS
        gap = (np.linalg.norm(line, axis=1) * np.sin(theta - angles(p, u, STATIONS))).min()
        assert gap <= found.most


def test_emptiness_is_proven_and_membership_checked():
    rng = np.random.default_rng(2)
    u = towards(TARGET, STATIONS, rng, 0.03)
    least = minimax(u, STATIONS, np.ones(4))
    empty = common(u, STATIONS, np.full(4, 0.9 * least.level))
    assert empty.meet is False
    assert empty.most < 0
    full = common(u, STATIONS, np.full(4, 1.1 * least.level))
    assert full.meet is True
    assert (angles(full.point, u, STATIONS) <= 1.1 * least.level).all()


def test_points_behind_a_station_are_rejected():
    u = towards(TARGET, STATIONS)
    u[0] *= -1.0
    assert common(u, STATIONS, np.full(4, 0.1)).meet is False
    # opposite rays on a line: no point is in front of both
    S = np.array([[0.0, 0.0], [1.0, 0.0]])
    apart = minimax(np.array([[-1.0, 0.0], [1.0, 0.0]]), S, np.full(2, 0.02))
    assert apart.meet is not True
    assert np.isnan(apart.point).all()


def test_extent_holds_every_common_point_and_is_attained():
    rng = np.random.default_rng(3)
    S, u, theta = STATIONS[:3], towards(TARGET, STATIONS[:3], rng, 0.01), np.full(3, 0.04)
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    reach = extent(u, S, theta, sides)
    centre = common(u, S, theta).point
    points = centre + (rng.random((200_000, 3)) - 0.5) * 2 * (reach[:3] + reach[3:])
    line = points[:, None] - S
    line /= np.linalg.norm(line, axis=-1, keepdims=True)
    inside = points[(np.arccos(np.clip((line * u).sum(axis=-1), -1, 1)) <= theta).all(axis=1)]
    assert len(inside) > 500
    most = (inside @ sides.T).max(axis=0)
    assert (most <= reach + 1e-9).all()
    assert (most >= reach - 0.25 * np.tile(reach[:3] + reach[3:], 2)).all()


def test_extent_of_open_and_empty_sets():
    u = towards(TARGET, STATIONS)
    lone = np.array([0.05, np.inf, np.inf, np.inf])
    assert extent(u, STATIONS, lone, np.array([[0.0, 0.0, 1.0]]))[0] == np.inf
    assert extent(u, STATIONS, lone, np.array([[0.0, 0.0, -1.0]]))[0] == pytest.approx(0.0, abs=1e-6)
    u[1] *= -1.0
    assert np.isnan(extent(u, STATIONS, np.full(4, 0.05), np.eye(3))).all()


def test_dropped_cones_are_not_read():
    u = towards(TARGET, STATIONS, np.random.default_rng(4), 0.01)
    some = common(u, STATIONS, np.array([0.05, 0.05, 0.05, np.inf]))
    few = common(u[:3], STATIONS[:3], np.full(3, 0.05))
    np.testing.assert_allclose(some.point, few.point, atol=1e-4)
    assert some.margin == pytest.approx(few.margin, abs=1e-7)
