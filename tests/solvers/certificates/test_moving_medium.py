"""Proofs in a wind: the problem at rest has the same costs, and its claims hold in the wind."""

import numpy as np
import pytest

import optloc
from optloc.base.types import Bias, Status
from optloc.linear import constraints
from optloc.linear.evaluate import predict
from optloc.models import Wind
from optloc.problem.build import assemble, measured
from optloc.solvers.certificates.moving_medium import problem_at_rest

STATIONS = np.array([[0.0, 0.0], [500.0, 0.0], [0.0, 500.0], [500.0, 500.0], [250.0, 700.0]])
CUBE = np.array([[0.0, 0, 0], [300, 0, 20], [0, 300, 60], [300, 300, 5], [150, 100, 90], [40, 220, 140]])
GALE = Wind((20.0, -35.0), 340.0)


def travel(target, stations, wind):
    """Return travel times multiplied by the wave speed, by bisection on the drifting wavefront."""
    w = np.array([*wind.velocity, 0.0][: stations.shape[1]])
    low, high = np.zeros(len(stations)), np.full(len(stations), 1e4)
    for _ in range(200):
        time = (low + high) / 2.0
        outside = np.linalg.norm(stations - target - w * time[:, None], axis=-1) > wind.speed * time
        low, high = np.where(outside, time, low), np.where(outside, high, time)
    return wind.speed * (low + high) / 2.0


def arrivals(stations, target, wind, sigma, seed=0, count=1, **more):
    """Return a batch of problems of arrival times with noise."""
    n, rng = len(stations), np.random.default_rng(seed)
    z = travel(target, stations, wind) + 800.0 + sigma * rng.standard_normal((count, n))
    return assemble(stations, measured("toa", z, a=np.arange(n), sigma=sigma), medium=wind, **more)


@pytest.mark.parametrize("stations", [STATIONS, CUBE], ids=["plane", "space"])
@pytest.mark.parametrize("kind", ["toa", "tdoa", "both"])
def test_costs_are_equal_at_rest(stations, kind):
    n = len(stations)
    rng = np.random.default_rng(4)
    rows = [measured("toa", rng.normal(size=n), a=np.arange(n), sigma=1.0)]
    rows += [measured("tdoa", rng.normal(size=n - 1), a=np.arange(1, n), b=0, arrival_sigma=1.0)]
    clocks = (Bias("clock", ("A",), np.arange(2), np.zeros(2, dtype=int), np.ones(2), sigma=np.array([3.0])),)
    chosen = {"toa": rows[:1], "tdoa": rows[1:], "both": rows}[kind]
    problem = assemble(stations, *chosen, medium=GALE, biases=clocks).flat()
    still = problem_at_rest(problem)
    x = rng.normal(scale=200.0, size=(1, problem.layout.size))
    difference = predict(problem, x) - predict(still.problem, still.at_rest(x))
    known = still.problem.correction - problem.correction
    assert np.abs(difference - known).max() < 1e-9
    assert np.abs(still.in_wind(still.at_rest(x)) - x).max() < 1e-9


def test_a_fix_in_wind_is_proven_and_the_same_as_at_rest():
    problem = arrivals(STATIONS, np.array([310.0, 260.0]), GALE, 0.3, count=8)
    fix = optloc.solve(problem)
    assert (fix.code == Status.OK).all()
    assert {certificate.proof for certificate in fix.certificate} == {"global"}
    assert np.abs(fix.position - [310.0, 260.0]).max() < 2.0
    still = problem_at_rest(problem.flat())
    rest = optloc.solve(still.problem)
    assert np.abs(rest.cost - fix.cost).max() < 1e-6
    assert np.abs(rest.position @ np.linalg.inv(still.stretch) - fix.position).max() < 1e-5


def test_two_positions_in_wind_are_ambiguous():
    # three differences of arrivals in the plane: two branches meet twice for a target outside
    target = np.array([-250.0, -180.0])
    stations = STATIONS[:3]
    z = travel(target, stations, GALE)
    fix = optloc.solve(
        assemble(stations, measured("tdoa", z[1:] - z[0], a=[1, 2], b=0, arrival_sigma=0.1), medium=GALE)
    )
    assert fix.status == Status.AMBIGUOUS
    both = np.concatenate([fix.position[None], fix.alternatives.x[np.isfinite(fix.alternatives.gap)][:, :2]])
    residuals = [travel(each, stations, GALE)[1:] - travel(each, stations, GALE)[0] - (z[1:] - z[0]) for each in both]
    assert np.abs(residuals).max() < 1e-3
    assert np.linalg.norm(both - target, axis=1).min() < 1.0


def test_a_level_target_in_wind_is_proven():
    target = np.array([120.0, 90.0, 30.0])
    level = constraints.box([-np.inf, -np.inf, 30.0], [np.inf, np.inf, 30.0])
    fix = optloc.solve(arrivals(CUBE, target, GALE, 0.1, constraints=level))
    fix = fix[0]
    assert fix.status == Status.OK
    assert abs(fix.position[2] - 30.0) < 1e-6
    assert np.abs(fix.position - target).max() < 1.0


def test_a_box_in_wind_admits_positions_inside_only():
    target = np.array([310.0, 260.0])
    inside = constraints.box([0.0, 0.0], [500.0, 500.0])
    assert optloc.solve(arrivals(STATIONS, target, GALE, 0.3, constraints=inside))[0].status == Status.OK


@pytest.mark.parametrize("angle", [0.3, 1.1])
def test_regions_in_the_wind_are_inside_regions_at_rest(angle):
    wind = Wind((60.0 * np.cos(angle), 60.0 * np.sin(angle)), 340.0)
    still = problem_at_rest(arrivals(STATIONS, np.array([310.0, 260.0]), wind, 0.3).flat())
    low, high = np.array([-20.0, 5.0]), np.array([30.0, 25.0])
    inner = still.inside(low, high)
    corners = np.array([[inner[i][0], inner[j][1]] for i in (0, 1) for j in (0, 1)]) @ still.stretch
    assert (corners >= low - 1e-9).all()
    assert (corners <= high + 1e-9).all()
    assert (inner[1] - inner[0] > 0.3 * (high - low)).all()
    outer = still.around(np.array([low, high]))
    corners = np.array([[(low, high)[i][0], (low, high)[j][1]] for i in (0, 1) for j in (0, 1)]) @ still.stretch
    assert (corners >= outer[0] - 1e-9).all()
    assert (corners <= outer[1] + 1e-9).all()


def test_ranges_in_wind_keep_their_reason():
    z = travel(np.array([310.0, 260.0]), STATIONS, GALE)
    fix = optloc.solve(assemble(STATIONS, measured("range", z, a=np.arange(5), sigma=0.3), medium=GALE))
    assert fix.status == Status.UNPROVEN
    assert "wind" in fix.certificate.reason


@pytest.mark.slow
def test_the_proven_fix_is_the_best_of_a_grid():
    """No position of a fine grid, each with its best emission time, has a lower cost than a proven fix."""
    rng = np.random.default_rng(7)
    steps = np.linspace(-900.0, 1400.0, 180)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    proven = 0
    for seed in range(12):
        stations = rng.uniform(0.0, 500.0, (4, 2))
        wind = Wind(tuple(rng.uniform(-60.0, 60.0, 2)), 340.0)
        problem = arrivals(stations, rng.uniform(-200.0, 700.0, 2), wind, 2.0, seed)
        fix = optloc.solve(problem)[0]
        if fix.certificate is None or fix.certificate.proof != "global":
            continue
        proven += 1
        x = np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)
        residual = problem.z[0] - np.asarray(predict(problem, x))
        residual -= residual.mean(-1, keepdims=True)
        assert ((residual / 2.0) ** 2).sum(-1).min() >= fix.cost - 1e-6
    assert proven >= 8
