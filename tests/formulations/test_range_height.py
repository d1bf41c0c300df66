"""Points of an ellipsoid from ranges known up to one unknown: exactness, root structure, horizon, failure."""

import numpy as np
import pytest

from formulations.range_height import ellipsoid, locate, locate_by_ranges, visible

EARTH = 6378137.0
FLATTENING = 1 / 298.257223563
AXES = np.array([1.0, 1.0, 1.0 - FLATTENING])
WGS84 = ellipsoid(AXES)


def ecef(latitude, longitude, height=0.0):
    """Earth radii from degrees and metres."""
    phi, lam, e2 = np.radians(latitude), np.radians(longitude), FLATTENING * (2 - FLATTENING)
    n, h = 1 / np.sqrt(1 - e2 * np.sin(phi) ** 2), height / EARTH
    return np.stack(
        [(n + h) * np.cos(phi) * np.cos(lam), (n + h) * np.cos(phi) * np.sin(lam), (n * (1 - e2) + h) * np.sin(phi)], -1
    )


SATELLITES = ecef(np.array([24.44, 25.09, 24.44]), np.array([125.21, 125.68, 125.99]), 8e5)
TARGET = ecef(25.80, 127.37)


def targets(count, degrees, seed=0, surface=WGS84):
    """Points of the Earth within an angle of the satellites, seen by all of them."""
    rng = np.random.default_rng(seed)
    below = SATELLITES.mean(0) / np.linalg.norm(SATELLITES.mean(0))
    east = np.cross([0.0, 0.0, 1.0], below)
    east /= np.linalg.norm(east)
    cosine, turn = rng.uniform(np.cos(np.radians(degrees)), 1, 2 * count), rng.uniform(0, 2 * np.pi, 2 * count)
    side = np.cos(turn)[:, None] * east + np.sin(turn)[:, None] * np.cross(below, east)
    x = cosine[:, None] * below + np.sqrt(1 - cosine**2)[:, None] * side
    x /= np.sqrt(surface.polar(x, x))[:, None]
    return x[visible(x[:, None], surface, SATELLITES).all(-1)][:count]


def distances(x, stations):
    return np.linalg.norm(x[..., None, :] - stations, axis=-1)


def nearest(found, x):
    """Distance of the nearest candidate."""
    return np.where(found.valid, np.linalg.norm(found.x - x[..., None, :], axis=-1), np.inf).min(-1)


def test_printed_scenario():
    r = distances(TARGET, SATELLITES)
    np.testing.assert_allclose((r[:1] - r[1:]) * EARTH, [23600.0, 18840.1], atol=0.1)
    every = locate(SATELLITES, np.ones(3), r - r[0], WGS84, positive=False)
    assert every.valid.all()
    np.testing.assert_allclose(np.sort(every.ranges[:, 0]) * EARTH / 1e3, [-12998.2, -819.9, 847.9, 13044.8], atol=0.05)
    away = np.linalg.norm(every.x - TARGET, axis=-1) * EARTH
    order = np.argsort(every.ranges[:, 0])
    assert away[order[1]] == pytest.approx(434e3, rel=2e-3)
    assert away[order[2]] < 1e-6
    assert away[order[3]] == pytest.approx(12198e3, rel=1e-4)
    np.testing.assert_allclose(every.x[order[3]], ecef(-4.35, -80.11), atol=2e-4)
    kept = locate(SATELLITES, np.ones(3), r - r[0], WGS84)
    assert kept.valid.sum() == 2
    assert np.isnan(kept.x[~kept.valid]).all()
    assert visible(kept.x[kept.valid][:, None], WGS84, SATELLITES).all(-1).sum() == 1


def test_every_visible_target_is_found_to_a_millimetre():
    x = targets(2000, 28)
    r = distances(x, SATELLITES)
    found = locate(SATELLITES, np.ones(3), r - r[:, :1], WGS84)
    assert len(x) == 2000
    assert (nearest(found, x) * EARTH < 1e-3).all()
    assert (found.valid.sum(-1) == 2).all()
    seen = (found.valid & visible(found.x[:, :, None], WGS84, SATELLITES).all(-1)).sum(-1)
    assert set(seen) <= {1, 2}
    # a second visible point appears near the horizon only
    assert 0.99 <= (seen == 1).mean() < 1
    lower = SATELLITES.mean(0) * 0.96
    assert (seen[visible(x, WGS84, lower)] == 1).all()


def test_noisy_fix_is_where_newton_from_the_truth_goes():
    x = targets(500, 20, seed=1)
    noise = np.random.default_rng(1).normal(size=(500, 2)) * 14.99 / EARTH
    r = distances(x, SATELLITES)
    z = r[:, :1] - r[:, 1:] + noise
    found = locate(SATELLITES, np.ones(3), np.pad(-z, ((0, 0), (1, 0))), WGS84)
    y = x.copy()
    for _ in range(15):
        u = (y[:, None] - SATELLITES) / distances(y, SATELLITES)[..., None]
        q = distances(y, SATELLITES)
        H = np.concatenate([u[:, :1] - u[:, 1:], 2 * (y @ WGS84.shape)[:, None]], axis=1)
        e = np.column_stack([z - (q[:, :1] - q[:, 1:]), 1 - WGS84.polar(y, y)])
        y += np.linalg.solve(H, e[..., None])[..., 0]
    settled = np.abs(WGS84.polar(y, y) - 1) < 1e-13
    assert settled.mean() > 0.99
    assert nearest(found, y)[settled].max() * EARTH < 1e-4


def test_height_is_data():
    high = ellipsoid(AXES, np.array([0.0, 500.0, 1e4]) / EARTH)
    x = ecef(25.8, 127.37, np.array([0.0, 500.0, 1e4]))
    r = distances(x, SATELLITES)
    off = nearest(locate(SATELLITES, np.ones(3), r - r[:, :1], high), x) * EARTH
    assert off[0] < 1e-6
    # the grown ellipsoid is not exactly the surface of that height
    assert 0 < off[1] < 0.1
    assert off[1] < off[2] < 2.0


@pytest.mark.parametrize("sign", [(1, 1, 1), (1, -1, 1), (-1, -1, -1)], ids=str)
def test_any_ellipsoid_any_frame_any_signs(sign):
    rng = np.random.default_rng(2)
    n = 3000
    rotation = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    surface = ellipsoid(
        rng.uniform(0.5, 1.5, (n, 3)), rng.uniform(0, 0.1, n), origin=rng.normal(size=(n, 3)), rotation=rotation
    )
    d = rng.normal(size=(n, 3))
    x = surface.centre + d / np.sqrt(surface.polar(surface.centre + d, surface.centre + d))[:, None]
    s = 1.5 * rng.normal(size=(n, 3, 3))
    sign = np.array(sign, dtype=float)
    offset = distances(x, s) - sign * rng.normal(size=(n, 1))
    found = locate(s, sign, offset, surface)
    assert nearest(found, x).max() < 1e-9
    assert (surface.polar(found.x.swapaxes(0, 1), found.x.swapaxes(0, 1)).T[found.valid] - 1 < 1e-10).all()
    np.testing.assert_allclose(distances(found.x, s[:, None])[found.valid], found.ranges[found.valid], atol=1e-9)
    np.testing.assert_array_less(-1e-12, found.ranges[found.valid])
    two = locate_by_ranges(s[:, :2], distances(x, s)[:, :2], surface)
    assert nearest(two, x).max() < 1e-9
    assert set(two.valid.sum(-1)) <= {2, 4}


def test_ground_network_in_its_own_frame():
    rng = np.random.default_rng(3)
    unit = 20e3 / EARTH
    origin, R = ecef(50.0, 10.0), np.linalg.qr(rng.normal(size=(3, 3)))[0]
    s = ecef(
        50 + rng.uniform(-0.2, 0.2, (500, 3)), 10 + rng.uniform(-0.3, 0.3, (500, 3)), rng.uniform(0, 500, (500, 3))
    )
    x = ecef(50 + rng.uniform(-0.4, 0.4, 500), 10 + rng.uniform(-0.6, 0.6, 500))
    grown = AXES + 9e3 / EARTH
    x /= np.sqrt(((x / grown) ** 2).sum(-1))[:, None]
    local = ellipsoid(AXES / unit, 9e3 / 20e3, origin=origin / unit, rotation=R)
    s, x = (s - origin) / unit @ R.T, (x - origin) / unit @ R.T
    found = locate(s, np.ones(3), distances(x, s) - distances(x, s)[:, :1], local)
    assert nearest(found, x).max() * 20e3 < 1e-3
    assert nearest(locate_by_ranges(s[:, :2], distances(x, s)[:, :2], local), x).max() * 20e3 < 1e-3
    # stations below the surface see all of it
    assert visible(x[:, None], local, s).all()


def test_symmetric_geometry_has_no_linear_term():
    # the plane of the stations holds the centre of a sphere: L = 0 and every root is double
    s = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [-2.0, 0.5, 0.0]])
    x = np.array([0.3, 0.5, np.sqrt(1 - 0.34)])
    r = distances(x, s)
    sphere = ellipsoid(np.ones(3))
    found = locate(s, np.ones(3), r - r[0], sphere)
    for z in (x, x * [1, 1, -1]):
        assert nearest(found, z) < 1e-9
    two = locate_by_ranges(s[:2], r[:2], sphere)
    assert two.valid.sum() == 2
    assert nearest(two, x) < 1e-9


def test_horizon_is_what_a_ray_says():
    rng = np.random.default_rng(4)
    d = rng.normal(size=(4000, 3))
    x = d / np.sqrt(WGS84.polar(d, d))[:, None]
    s = rng.uniform(1.05, 4, (4000, 1)) * rng.permutation(x)
    towards = s - x
    # the ray leaves the surface upwards
    outward = (x @ WGS84.shape * towards).sum(-1) > 0
    np.testing.assert_array_equal(visible(x, WGS84, s), outward)
    assert visible(x, WGS84, 0.9 * s / np.linalg.norm(s, axis=-1, keepdims=True)).all()
    assert not visible(np.full(3, np.nan), WGS84, s[0])


def test_what_cannot_be_solved_is_not_valid_and_harms_no_neighbour():
    x = targets(8, 15)
    r = distances(x, SATELLITES)
    s = np.broadcast_to(SATELLITES, (8, 3, 3)).copy()
    offset = r - r[:, :1]
    clean = locate(s, np.ones(3), offset, WGS84)
    s[1, 2] = 2 * s[1, 1] - s[1, 0]
    s[2, 1] = s[2, 0]
    s[3, 0, 0] = np.nan
    offset[4, 1] = np.inf
    offset[5, 1] = 3.0
    found = locate(s, np.ones(3), offset, WGS84)
    assert not found.valid[1:6].any()
    np.testing.assert_array_equal(found.x[[0, 6, 7]], clean.x[[0, 6, 7]])
    apart = locate_by_ranges(SATELLITES[:2], np.array([[0.1, 3.0], [np.nan, 0.2], [0.0, 0.0]]), WGS84)
    assert not apart.valid.any()
    with pytest.raises(ValueError, match="signs"):
        locate(s, np.zeros(3), offset, WGS84)
    assert locate(np.zeros((0, 3, 3)), np.ones(3), np.zeros((0, 3)), WGS84).x.shape == (0, 4, 3)
