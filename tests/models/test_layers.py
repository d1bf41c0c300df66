"""Rays through layers of constant speed or constant gradient: those of the textbook, with their derivatives."""

from unittest import mock

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

from optloc import InvalidProblem
from optloc.models import Layers, layers as rays
from optloc.models.layers import first_arrival
from optloc.models.primitives import Jet, Point

# A summer sea: a warm surface, a thermocline, a channel with its axis at 1 300 m, and the deep.
SEA = Layers((0, 30, 80, 300, 1300, 5000), (1530, 1529, 1508, 1497, 1485, 1548))
# A crust in layers, and one in which the speed grows everywhere.
CRUST = Layers((0, 500, 3000), (2000, 3500, 5500), "constant")
SLOPE = Layers((0, 8000), (2000, 6000))
TABLES = pytest.mark.parametrize("table", [SEA, CRUST, SLOPE], ids=["sea", "crust", "slope"])


def drawn(seed, count, depth=4000.0, across=6000.0):
    """Return coordinates (count, 6) of targets and stations."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(-across, across, (count, 6))
    place[:, [2, 5]] = -rng.uniform(0.0, depth, (count, 2))
    return place


def ends(place):
    return Point(tuple(place[:, :3].T)), Point(tuple(place[:, 3:].T))


def length(table, place):
    return table.path(*ends(place))


def test_two_layers_are_those_of_snell(seed):
    table, rng = Layers((0, 100), (1500, 1800), "constant"), np.random.default_rng(seed)
    across, high, low = rng.uniform(0, 3000, 50), rng.uniform(0, 100, 50), rng.uniform(100, 1000, 50)
    ray = first_arrival(table, across, low, high)
    for i in range(50):

        def time(x, i=i):
            return np.hypot(x, 100 - high[i]) / 1500 + np.hypot(across[i] - x, low[i] - 100) / 1800

        # Fermat: the place where the ray meets the border is that of the least time.
        least = minimize_scalar(time, bounds=(0.0, across[i]), method="bounded", options={"xatol": 1e-9})
        assert ray.time[i] == pytest.approx(least.fun, rel=1e-12)
        sine = np.array([least.x / np.hypot(least.x, 100 - high[i]) / 1500])
        np.testing.assert_allclose(ray.p[i], sine, atol=1e-9)


@pytest.mark.parametrize("cuts", [(), (10, 33, 400, 401, 9000)])
def test_a_constant_gradient_bends_rays_to_circles(seed, cuts):
    # However the table is cut, over the horizon and beyond the turning point.
    g, c0, rng = 0.05, 1450.0, np.random.default_rng(seed)
    depth = np.array([0.0, *cuts, 20e3])
    table = Layers(tuple(depth), tuple(c0 + g * depth))
    across, yt, ya = rng.uniform(0, 2e4, 1000), rng.uniform(0, 5e3, 1000), rng.uniform(0, 5e3, 1000)
    chord, mean = np.hypot(across, yt - ya), np.sqrt((c0 + g * yt) * (c0 + g * ya))
    np.testing.assert_allclose(
        first_arrival(table, across, yt, ya).time, 2.0 / g * np.arcsinh(0.5 * g * chord / mean), rtol=1e-12
    )


@TABLES
def test_rays_obey_the_equation_of_rays_and_arrive(table, seed):
    place = drawn(seed, 200)
    at_t, at_a = (np.stack(v, axis=1) for v in table.gradients(*ends(place)))
    time, arrived = length(table, place) / table.unit_speed, 0
    y0, y1, c0, c1 = rays._layers(table)

    def speed(z):
        j = int(np.clip(np.searchsorted(y0, -z, side="right") - 1, 0, len(y0) - 1))
        slope = (c1[j] - c0[j]) / (y1[j] - y0[j]) if np.isfinite(y1[j]) else 0.0
        return c0[j] + slope * (-z - y0[j]), -slope

    for i in np.flatnonzero(np.isfinite(time))[:12]:

        def move(_, state):
            # ds/dt: along the slowness by c^2; the slowness by -dc/dz / c, with what Snell's law keeps
            c, up = speed(state[2])
            return [*(c * c * state[3:]), 0.0, 0.0, -up / c]

        begin = [*place[i, 3:], *(-at_a[i] / table.unit_speed)]
        if table.between == "constant":
            continue
        run = solve_ivp(move, (0.0, time[i]), begin, rtol=1e-10, atol=1e-9, max_step=time[i] / 200)
        np.testing.assert_allclose(run.y[:3, -1], place[i, :3], atol=0.05)
        np.testing.assert_allclose(run.y[3:, -1], at_t[i] / table.unit_speed, atol=2e-8)
        arrived += 1
    assert arrived or table.between == "constant"


@TABLES
def test_no_finer_search_finds_an_earlier_arrival(table, seed):
    place = drawn(seed, 400)
    found = length(table, place)
    with mock.patch.object(rays, "_PARTS", 800):
        best = length(table, place)
    assert (np.isnan(found) == np.isnan(best)).mean() > 0.995
    both = np.isfinite(found) & np.isfinite(best)
    assert (np.abs(found - best)[both] < 1e-6).mean() > 0.995


@TABLES
def test_derivatives_are_those_of_differences(table, seed):
    place, step = drawn(seed, 300), 1e-3
    jets = [Jet(place[:, i], {i: np.ones(1)}) for i in range(6)]
    points = Point(tuple(jets[:3])), Point(tuple(jets[3:]))
    path, slopes = table.path(*points), [v for end in table.gradients(*points) for v in end]
    for i in range(6):
        more, less = (place + sign * step * np.eye(6)[i] for sign in (1.0, -1.0))
        slope = (length(table, more) - length(table, less)) / (2 * step)
        # But for the few places at which one ray takes over from another, or ends.
        assert np.nanquantile(np.abs(slope - path.partials[i]), 0.97) < 1e-7
        np.testing.assert_allclose(slopes[i].value, path.partials[i], atol=1e-12)
        ahead, behind = ([v for end in table.gradients(*ends(at)) for v in end] for at in (more, less))
        for j in range(6):
            bend = (ahead[j] - behind[j]) / (2 * step)
            got = np.broadcast_to(slopes[j].partials.get(i, 0.0), bend.shape)
            good = np.isfinite(bend) & np.isfinite(got)
            assert np.quantile(np.abs(bend - got)[good], 0.97) < 1e-8


def test_the_gradient_is_the_slowness():
    place = drawn(1, 500)
    at_t, at_a = (np.stack(v, axis=1) for v in SEA.gradients(*ends(place)))
    here = np.isfinite(length(SEA, place))
    for gradient, depth in ((at_t, -place[:, 2]), (at_a, -place[:, 5])):
        size = np.linalg.norm(gradient, axis=1) * np.interp(depth, SEA.depth, SEA.speed) / SEA.unit_speed
        np.testing.assert_allclose(size[here], 1.0, atol=1e-9)
    np.testing.assert_allclose(at_t[here, :2], -at_a[here, :2], atol=1e-15)  # Snell's law


def test_overhead_and_level_rays():
    place = np.array([[0, 0, -900.0, 0, 0, -10], [700, 0, -200, 0, 0, -200], [0, 0, -200, 0, 0, -200 - 1e-7]])
    layers = Layers((0, 500), (1500, 2000), "constant", reference=1000.0)
    value = length(layers, place)
    np.testing.assert_allclose(value[:2] / 1000.0, [490 / 1500 + 400 / 2000, 700 / 1500], rtol=1e-14)
    jets = [Jet(place[:2, i], {i: np.ones(1)}) for i in range(6)]
    points = Point(tuple(jets[:3])), Point(tuple(jets[3:]))
    slopes = np.stack([layers.path(*points).partials[i] for i in range(6)])
    np.testing.assert_allclose(slopes[:, 0], [0, 0, -0.5, 0, 0, 1 / 1.5], atol=1e-12)
    np.testing.assert_allclose(slopes[:, 1], [1 / 1.5, 0, 0, -1 / 1.5, 0, 0], atol=1e-12)
    assert all(np.isfinite(v.value).all() for v in layers.gradients(*points)[0])


def test_a_shadow_begins_where_the_ray_that_grazes_the_surface_leads():
    # Below a surface at which the speed is greatest: x^2 = (c0 / g)^2 - (c / g)^2 for each end.
    g, table = 0.1, Layers((0, 1000), (1500, 1400))
    edge = sum(np.sqrt((1500 / g) ** 2 - ((1500 - g * y) / g) ** 2) for y in (50.0, 200.0))
    ray = first_arrival(table, edge + np.array([-1.0, 1.0]), np.full(2, 200.0), np.full(2, 50.0))
    assert np.isfinite(ray.time).tolist() == [True, False]
    # Nor does anything lead out of the table, or through its top.
    ray = first_arrival(table, np.full(2, 10.0), np.array([-1.0, 1001.0]), np.full(2, 50.0))
    assert np.isnan(ray.time).all()
    assert not ray.at_t.any()


def test_the_reference_is_a_unit_alone():
    place = drawn(2, 50)
    slow, fast = (Layers(SEA.depth, SEA.speed, reference=c) for c in (1000.0, 1500.0))
    np.testing.assert_allclose(length(fast, place), 1.5 * length(slow, place), rtol=1e-14)
    assert Layers((0, 100), (1000, 2000), "linear").unit_speed == pytest.approx(1000 / np.log(2), rel=1e-12)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"depth": (0, 0)}, "depth 2, 0 m, is not below depth 1"),
        ({"depth": (10, 0)}, "sort the table downwards"),
        ({"depth": (0, np.nan)}, "depth 2"),
        ({"speed": (1500, -1)}, "speed 2 is -1 m/s"),
        ({"speed": (1500,)}, "2 depths and 1 speeds"),
        ({"depth": (0,), "speed": (1500,)}, "at least 2"),
        ({"speed": "fast"}, "not a list of numbers"),
        ({"between": "cubic"}, "unknown shape"),
        ({"surface": np.nan}, "surface"),
        ({"reference": 0.0}, "reference"),
        ({"reference": "slow"}, "reference"),
    ],
)
def test_wrong_tables_are_told(options, words):
    with pytest.raises(InvalidProblem) as error:
        Layers(**({"depth": (0, 100), "speed": (1500, 1400)} | options))
    assert words in str(error.value)
    assert len(str(error.value)) < 200
