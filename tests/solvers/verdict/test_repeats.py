"""Fixes that are curved three deviations away: repeats of the measurement say whether their 95 % figures hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from optloc import Status, assemble, measured, simulate, solve
from optloc.base.errors import InvalidProblem, NoSolution
from optloc.base.types import Array
from optloc.problem import Prior
from optloc.problem.problem import Problem
from optloc.solvers.verdict.repeats import ENOUGH, repeat

CORNERS = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 4.0], [0.0, 4.0]])
# Chi-square of two degrees of freedom at 95 %.
INSIDE = 5.991464547107979
COARSE = np.radians(4.0)


def bearings(target: Array, sigma: float = COARSE, seed: int = 0, trials: int | None = None) -> Problem:
    """Return coarse bearings from three corners of a room."""
    line = target - CORNERS[:3]
    rows = measured("azimuth", np.arctan2(line[:, 1], line[:, 0]), a=np.arange(3), sigma=sigma)
    return simulate(assemble(CORNERS, rows), target, seed, trials)


def valley(distance: float, sigma: float) -> tuple[Problem, Array]:
    """Return bearings that cross at small angles, and their target."""
    stations, target = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -1.0]]), np.array([distance, 0.3])
    line = target - stations
    rows = measured("azimuth", np.arctan2(line[:, 1], line[:, 0]), a=np.arange(3), sigma=np.radians(sigma))
    return assemble(stations, rows), target


def own_share(problem: Problem, place: Array, spread: Array, sigma: float) -> float:
    """Return the share of repeats whose ellipse holds the drawn place, by another method and other draws."""
    rng, held, count = np.random.default_rng(77), 0, 400
    for truth in rng.multivariate_normal(place, spread, count):
        line = truth - CORNERS[:3]
        z = np.arctan2(line[:, 1], line[:, 0]) + sigma * rng.standard_normal(3)

        def residual(x: Array, z: Array = z) -> Array:
            away = x - CORNERS[:3]
            return ((z - np.arctan2(away[:, 1], away[:, 0]) + np.pi) % (2.0 * np.pi) - np.pi) / sigma

        done = least_squares(residual, truth)
        off = done.x - truth
        held += off @ (done.jac.T @ done.jac) @ off <= INSIDE
    return held / count


@pytest.mark.parametrize("target", [(2.0, 2.5), (3.5, 1.0), (6.5, 6.0)])
def test_the_share_of_repeats_is_that_of_another_method(target: tuple[float, float]) -> None:
    problem = bearings(np.array(target))
    fix = solve(problem)
    shares = repeat(problem.flat(), fix.x[None], fix.cov[None])[0]
    expected = own_share(problem, fix.position, fix.covariance(), COARSE)
    # 48 and 400 draws: four standard deviations of their difference
    assert shares[0] == pytest.approx(expected, abs=4.0 * np.sqrt(0.95 * 0.05 * (1 / 48 + 1 / 400)) + 0.02)
    assert shares[0] <= shares[1]


def test_coarse_bearings_are_ok_at_95_percent_and_say_so() -> None:
    problem, target = valley(5.0, 1.5)
    fix = next(one for seed in range(20) if (one := solve(simulate(problem, target, seed))).has(Status.TAILS))
    assert fix.status is Status.OK
    assert fix.findings == (Status.TAILS,)
    assert "the 99.9 % region is not" in str(fix)
    assert fix.to_dataframe()["tails"].all()
    assert fix.require() is fix
    assert bool(fix.covers(fix.position))
    with pytest.raises(NoSolution, match=r"95 % figures"):
        fix.require(level=0.999)
    if fix.chart.name == "cartesian":
        with pytest.raises(InvalidProblem, match=r"hold at 0\.95, not at 0\.999"):
            fix.covers(fix.position, 0.999)


def test_a_fix_has_the_same_repeats_alone_and_in_a_batch() -> None:
    problem = simulate(*valley(5.0, 1.5), 0, 12)
    fix = solve(problem)
    told = fix.has(Status.TAILS)
    assert told.any()
    for i in np.flatnonzero(told)[:3]:
        alone = solve(problem.take(np.array([i])))
        assert bool(alone.has(Status.TAILS)[0])


@pytest.mark.parametrize("distance", [3.0, 5.0, 8.0])
def test_an_ok_fix_is_seldom_off_at_any_place(distance: float) -> None:
    problem, target = valley(distance, 1.5)
    fix = solve(simulate(problem, target, 1, 200))
    good = fix.code == Status.OK
    away, spread = fix.position - target, fix.covariance()
    squared = (away * np.linalg.solve(spread, away[..., None])[..., 0]).sum(-1)
    assert good.mean() > 0.8
    assert fix.has(Status.TAILS).mean() > 0.5
    # the promise is 5 % of all measurements; three deviations of the count more are chance
    assert (good & (squared > INSIDE)).sum() <= 10 + 3.0 * np.sqrt(0.05 * 0.95 * 200)


def test_most_of_a_long_valley_stays_curved() -> None:
    problem, target = valley(15.0, 3.0)
    assert solve(simulate(problem, target, 3, 100)).has(Status.TAILS).mean() < 0.25


def test_priors_are_measurements_that_are_repeated() -> None:
    """A prior on the position is one more row: the shares agree with those of another method."""
    target, prior = np.array([3.0, 1.0]), np.diag([0.4, 0.1])
    problem, _ = valley(3.0, 4.0)
    held = replace(problem, priors=(Prior("position", target, prior),))
    measured_once = simulate(held, target, 2)
    fix = solve(measured_once)
    shares = repeat(measured_once.flat(), fix.x[None], fix.cov[None])[0]
    stations, sigma = problem.stations.position.reshape(-1, 2), np.radians(4.0)
    rng, inside, count, root = np.random.default_rng(5), 0, 400, np.sqrt(np.diag(prior))
    for truth in rng.multivariate_normal(fix.position, fix.covariance(), count):
        line = truth - stations
        z = np.arctan2(line[:, 1], line[:, 0]) + sigma * rng.standard_normal(3)
        mean = truth + root * rng.standard_normal(2)

        def residual(x: Array, z: Array = z, mean: Array = mean) -> Array:
            away = x - stations
            return np.r_[(z - np.arctan2(away[:, 1], away[:, 0])) / sigma, (x - mean) / root]

        done = least_squares(residual, truth)
        off = done.x - truth
        inside += off @ (done.jac.T @ done.jac) @ off <= INSIDE
    assert shares[0] == pytest.approx(inside / count, abs=4.0 * np.sqrt(0.95 * 0.05 * (1 / 48 + 1 / 400)) + 0.02)


def test_the_shares_that_are_enough_are_below_the_levels() -> None:
    assert all(share < level for share, level in zip(ENOUGH, (0.95, 0.999), strict=True))


def test_a_tracker_starts_from_the_covariance_that_repeats_inflate() -> None:
    problem = simulate(*valley(5.0, 1.5), 0, 30)
    many = solve(problem)
    tails = many.has(Status.TAILS)
    assert tails.sum() > 5
    ratio = many.gaussian()[1][..., 0, 0] / many.cov[..., 0, 0]
    assert (ratio[~tails & np.isfinite(ratio)] == 1.0).all()
    assert (ratio[tails] >= 1.0).all()
    assert ratio[tails].max() < 4.0  # 88 % of the ellipses hold
    first = int(np.flatnonzero(tails)[0])
    one = solve(problem.take(np.array([first])))
    np.testing.assert_allclose(one.gaussian()[1][0], many.gaussian()[1][first], rtol=1e-6)
