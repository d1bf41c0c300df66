"""Foci in layers of constant speed: the best minima of an independent shooter, on interfaces and at known depths."""

import numpy as np
import pytest
from often import few
from scipy.optimize import least_squares, minimize

import optloc
from optloc import Status, assemble, constraints, measured, solve
from optloc.models import Layers
from optloc.solvers.layered import Strata, in_every_layer, strata_of

# Own rays: a direct path through the layers between both ends, found by the tangent of the angle at the fastest speed.


def rays(tops, speed, stations, x, layer):
    """Return times and their derivatives (s, 3) to the focus x, which belongs to a given layer."""
    low, apart = np.append(tops[1:], -np.inf), x - stations
    across = np.hypot(*apart[:, :2].T)
    up, down = np.maximum(stations[:, 2], x[2])[:, None], np.minimum(stations[:, 2], x[2])[:, None]
    height = np.maximum(np.minimum(up, tops) - np.maximum(down, low), 0.0)
    height[:, layer] = np.maximum(height[:, layer], 1e-7)
    top = np.where(height > 0.0, speed, 0.0).max(1, keepdims=True)
    ratio = speed / top
    slow, part = np.maximum(1.0 - ratio**2, 0.0), np.where(height > 0.0, height * ratio, 0.0)
    tangent = across / part.sum(1)
    for _ in range(60):
        root = np.sqrt(1.0 + tangent[:, None] ** 2 * slow)
        reached, rate = (part * tangent[:, None] / root).sum(1), (part / root**3).sum(1)
        tangent = np.maximum(tangent + (across - reached) / rate, 0.0)
    root = np.sqrt(1.0 + tangent[:, None] ** 2 * slow)
    reached, long = (part * tangent[:, None] / root).sum(1), np.hypot(1.0, tangent)
    p, cosine = tangent / long / top[:, 0], np.where(height > 0.0, root / long[:, None], 1.0)
    time = np.where(height > 0.0, height / speed / cosine, 0.0).sum(1) + p * (across - reached)
    level = (p / np.maximum(across, 1e-9))[:, None] * apart[:, :2]
    return time, np.c_[level, np.sign(apart[:, 2]) * cosine[:, layer] / speed[layer]]


def test_own_rays_are_those_of_the_least_time_over_the_places_of_refraction():
    rng, tops, speed = np.random.default_rng(2), np.array([1600.0, -2000.0, -9000.0]), np.array([4e3, 6e3, 5e3])
    stations, x = np.c_[rng.uniform(-2e4, 2e4, (4, 2)), rng.uniform(0, 1500, 4)], np.array([3e3, -4e3, -12e3])
    time, _ = rays(tops, speed, stations, x, 2)
    for station, own in zip(stations, time, strict=True):
        across = np.hypot(*(x - station)[:2])
        height = np.array([station[2] + 2000.0, 7000.0, 3000.0])

        def total(u, across=across, height=height):
            return (np.hypot(np.array([u[0], u[1], 1.0 - u[0] - u[1]]) * across, height) / speed).sum()

        least = minimize(total, [0.3, 0.4], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-14})
        assert own == pytest.approx(least.fun, abs=1e-9)


def residuals(case, x, layer):
    """Return residuals and their derivatives, less their means where the time of origin is unknown."""
    tops, speed, stations, z, sigma, free = case
    time, slope = rays(tops, speed, stations, x, layer)
    error, slope = (z - time) / sigma, -slope / sigma
    return (error - error.mean(), slope - slope.mean(0)) if free else (error, slope)


def least(case, rng):
    """Return the least cost over all layers and interfaces from many starts."""
    tops, stations = case[0], case[2]
    best, middle, wide = np.inf, stations.mean(0), {"xtol": 1e-12, "ftol": 1e-13, "gtol": 1e-12}
    for j, (low, high) in enumerate(zip([*tops[1:], -1e5], tops, strict=True)):
        for z in (low + 1.0, 0.5 * (low + high), high - 1.0):
            for away in (np.zeros(2), rng.normal(0.0, 5e3, 2)):
                begin, bounds = np.r_[middle[:2] + away, z], ([-2e5, -2e5, low], [2e5, 2e5, high])
                found = least_squares(
                    lambda x, j=j: residuals(case, x, j)[0],
                    begin,
                    lambda x, j=j: residuals(case, x, j)[1],
                    bounds,
                    x_scale=1e3,
                    **wide,
                )
                if 2.0 * found.cost < best:
                    best, middle = 2.0 * found.cost, found.x
        for z in (low, high):
            found = least_squares(lambda x, j=j, z=z: residuals(case, np.r_[x, z], j)[0], middle[:2], x_scale=1e3)
            best = min(best, 2.0 * found.cost)
    return best


def drawn(seed):
    """Return a random model of three layers, stations, times and noise; a third of the foci is next to an interface."""
    rng = np.random.default_rng((5, seed))
    count = rng.integers(6, 12)
    stations = np.c_[rng.uniform(-20e3, 20e3, (count, 2)), rng.uniform(0, 1500, count)]
    tops = 1600.0 - np.array([0.0, rng.uniform(2e3, 6e3), rng.uniform(8e3, 15e3)])
    speed = rng.uniform(3e3, 8e3, 3)
    speed = np.sort(speed) if seed % 3 else speed
    sigma, free = 10.0 ** rng.uniform(-2.5, -0.8), bool(seed % 5)
    depth = (-rng.uniform(0, 15e3), tops[1] + rng.normal(0, 300), tops[2] + rng.normal(0, 300))[seed % 3]
    x = np.r_[rng.uniform(-15e3, 15e3, 2), min(depth, 1500.0)]
    layer = int(np.searchsorted(-tops, -x[2])) - 1
    z = rays(tops, speed, stations, x, layer)[0] + sigma * rng.standard_normal(count) + 2.0 * free
    return (tops, speed, stations, z, sigma, free), rng


def fixed(case, **given):
    tops, speed, stations, z, sigma, free = case
    table = Layers(tuple(1600.0 - tops), tuple(speed), "constant", 1600.0)
    kind, unit = "toa" if free else "range", table.unit_speed
    rows = measured(kind, z * unit, a=np.arange(len(z)), sigma=sigma * unit)
    return solve(assemble(stations, rows, medium=table, **given))


@pytest.mark.parametrize("seed", few(range(300), 3))
def test_random_foci_are_the_best_minima_of_an_independent_shooter(seed):
    case, rng = drawn(seed)
    fix = fixed(case)
    assert fix.status not in (Status.MAX_ITERATIONS, Status.STALLED)
    assert fix.cost <= least(case, rng) * (1.0 + 1e-4) + 1e-3


@pytest.mark.parametrize("seed", few(range(40), 2))
def test_exact_heights_below_an_interface_are_held(seed):
    case, rng = drawn(seed)
    site = optloc.Frame.enu(lat_deg=43.75, lon_deg=7.5)
    height = case[0][1 + seed % 2] - rng.uniform(50.0, 1500.0)
    fix = fixed(case, frame=site, constraints=constraints.height(exactly=height))
    assert fix.status in (Status.UNPROVEN, Status.MISFIT)
    assert abs(site.to_geodetic(fix.position)[2] - height) < 1e-6


# Picks of P waves of a local earthquake, and the layers of a crust that begin at depths below the sea.
NETWORK = {
    "RONE": (43.881333, 7.598167, 300, 53.63),
    "SBF": (43.8635, 7.434833, 847, 54.32),
    "NEGI": (43.847667, 7.703833, 640, 54.13),
    "AURF": (43.887333, 7.3275, 1040, 55.54),
    "AUTN": (43.9955, 7.4275, 2069, 56.03),
    "CEPP": (43.916333, 7.7465, 1080, 55.32),
    "IMI": (43.9105, 7.893167, 840, 56.87),
    "MVIF": (43.8965, 7.1525, 1480, 57.64),
}
CRUST = Layers((0, 4100, 12100, 20100, 27100), (4000, 6000, 6300, 7000, 8000), "constant", 2100.0)


@pytest.mark.parametrize("method", ["auto", "gtrs+lsr"])
def test_a_focus_at_an_interface_has_the_law_of_the_side_that_costs_less(method):
    site = optloc.Frame.enu(lat_deg=43.75, lon_deg=7.5)
    rows = np.array(list(NETWORK.values()))
    stations = np.array([site.from_geodetic(*np.radians(row[:2]), row[2]) for row in rows])
    unit = CRUST.unit_speed
    picks = measured("toa", unit * rows[:, 3], a=np.arange(len(rows)), sigma=0.1 * unit)
    fix = solve(assemble(stations, picks, frame=site, medium=CRUST), method)
    assert fix.status == Status.UNPROVEN
    assert abs(fix.position[2] + 10e3) < 1e-3
    for exactly, cost in ((-9900.0, 5.15), (-11000.0, 5.98)):
        known = constraints.height(exactly=exactly)
        side = solve(assemble(stations, picks, frame=site, medium=CRUST, constraints=known), method)
        assert abs(site.to_geodetic(side.position)[2] - exactly) < 1e-6
        assert abs(side.cost - cost) < 0.02
    case = (2100.0 - np.array(CRUST.depth), np.array(CRUST.speed), stations, rows[:, 3], 0.1, True)
    above, below = (residuals(case, np.r_[fix.position[:2], -10e3 + edge], j) for j, edge in ((1, 1e-6), (2, -1e-6)))
    # far stations hear a focus below the interface earlier by a jump
    assert fix.cost == pytest.approx(below[0] @ below[0], rel=1e-6)
    assert fix.cost < above[0] @ above[0] - 1e-3
    assert fix.sigma()[2] == pytest.approx(np.sqrt(np.linalg.inv(below[1].T @ below[1])[2, 2]), rel=1e-4)


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("seed", [8, 33, 149])
def test_a_kink_has_the_larger_variance_of_both_sides(seed, upside_down):
    # The layer on the side away from the stations is slower: the cost is continuous, and its slope jumps.
    rng = np.random.default_rng((9, seed))
    stations = np.c_[rng.uniform(-20e3, 20e3, (6, 2)), rng.uniform(0, 1500, 6)]
    x, edge = np.r_[rng.uniform(-10e3, 10e3, 2), -4000.0], 1e-6
    tops, speed = np.array([1600.0, -4000.0]), np.array([6e3, 3e3])
    z = rays(tops, speed, stations, x, 1)[0] + 0.15 * rng.standard_normal(6)
    if upside_down:
        stations[:, 2], speed = -8000.0 - stations[:, 2], speed[::-1]
    case = (tops, speed, stations, z, 0.15, False)
    found = least_squares(lambda u: residuals(case, np.r_[u, -4000.0 + edge], 0)[0], x[:2], x_scale=1e3)
    sides = [residuals(case, np.r_[found.x, z], j) for j, z in ((0, -4000.0 + edge), (1, -4000.0 - edge))]
    slopes = [slope[:, 2] @ error for error, slope in sides]
    assert slopes[1] < 0.0 < slopes[0]
    fix = fixed(case)
    assert fix.status in (Status.UNPROVEN, Status.AMBIGUOUS)
    assert fix.cost == pytest.approx(2.0 * found.cost, abs=1e-6)
    assert np.abs(fix.position - np.r_[found.x, -4000.0]).max() < 0.1
    spread = [np.sqrt(np.linalg.inv(slope.T @ slope)[2, 2]) for _, slope in sides]
    assert fix.sigma()[2] == pytest.approx(max(spread), rel=1e-4)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_rays_that_graze_an_interface_give_the_depth_at_which_the_cost_is_larger_by_one(seed):
    rng, turn = np.random.default_rng(seed), np.arange(8) * np.pi / 4.0
    radius, tops, speed = rng.uniform(30e3, 60e3, 8), np.array([0.0, -5e3]), np.array([4e3, 6e3])
    stations = np.c_[radius * np.cos(turn), radius * np.sin(turn), np.full(8, -10.0)]
    # waves that come early leave no room below the interface
    z = rays(tops, speed, stations, np.array([500.0, -800.0, -5e3]), 1)[0] + 0.05 * (rng.standard_normal(8) - 0.3)
    table = Layers((0, 5e3), tuple(speed), "constant")
    unit = table.unit_speed
    rows = measured("range", z * unit, a=np.arange(8), sigma=0.05 * unit)
    fix = solve(assemble(stations, rows, medium=table))
    assert fix.status in (Status.UNPROVEN, Status.SEARCHED)
    assert abs(fix.position[2] + 5e3) < 1e-3
    case = (tops, speed, stations, z, 0.05, False)
    found = [
        2.0 * least_squares(lambda u, z=z: residuals(case, np.r_[u, z], 1)[0], fix.position[:2], x_scale=1e3).cost
        for z in (-5e3 - 1e-6, -5e3 - fix.sigma()[2])
    ]
    assert 0.7 < found[1] - found[0] < 1.4


def test_layers_are_told_by_the_third_coordinate():
    strata = Strata(2, np.array([-100.0, -300.0, -np.inf]), np.array([0.0, -100.0, -300.0]))
    assert strata.layer(np.array([-50.0, -150.0, -1e4, 20.0])).tolist() == [0, 1, 2, 0]
    # off the ends by a quarter of the height, which is twice that of the others for the last
    moved = strata.inside(np.array([-150.0, -250.0, 0.0]), np.array([0, 1, 2]))
    assert moved.tolist() == [-75.0, -250.0, -450.0]
    starts = in_every_layer(strata, np.array([[[7.0, 8.0, -150.0]]]))[0]
    assert starts[:, 2].tolist() == [-150.0, -75.0, -150.0, -450.0]
    assert (starts[:, :2] == [7.0, 8.0]).all()


def test_only_an_interface_divides_a_problem():
    stations = np.array([[0.0, 0.0, 0.0], [9e3, 0.0, 0.0], [0.0, 9e3, 0.0], [9e3, 9e3, 100.0]])
    problem = assemble(stations, measured("toa", np.full(4, 9e3), a=np.arange(4), sigma=10.0)).flat()
    assert strata_of(problem) is None
    layered = problem.in_medium(Layers((0.0, 2e3), (3e3, 5e3), "constant", surface=500.0))
    strata = strata_of(layered)
    np.testing.assert_allclose(strata.high, [500.0, -1500.0], atol=1e-5)
    assert strata_of(problem.in_medium(Layers((0.0,), (3e3,), "constant", surface=500.0))) is None
