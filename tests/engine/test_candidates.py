"""Starts that squared ranges do not give, and what infinity costs: against closed forms, stages and searches."""

import numpy as np
import pytest

import optloc
from optloc import assemble, constraints, measured, simulate, solve
from optloc.engine.memory import BY_HEIGHT, BY_PLACES
from optloc.engine.plan import plan_of
from optloc.engine.shape import STRAIGHT
from optloc.kernels.jit import enabled
from optloc.kernels.polynomial import DEGREE, real_roots
from optloc.model_checks.shape import cost_at_infinity
from optloc.models.primitives import WGS84_A
from optloc.solvers.inequalities import is_hidden
from optloc.solvers.stages import gtrs, lsr_with_mirror
from optloc.solvers.starts.position import height_starts
from optloc.solvers.verdict.judge import verdict

compiled = pytest.mark.skipif(not enabled(), reason="there are no plans without machine code")


def test_roots_are_those_of_eigenvalues():
    rng = np.random.default_rng(1)
    work, out = np.zeros((2, DEGREE + 2)), np.zeros(DEGREE)
    for trial in range(200):
        roots = rng.uniform(-2.0, 2.0, 4)
        pair = rng.uniform(-1.0, 1.0) + 1j * rng.uniform(0.1, 1.0)
        if trial % 2:
            roots = np.array([*roots[:2], pair, np.conj(pair)])
        c = np.poly(roots).real[::-1] * rng.uniform(0.1, 10.0)
        real = np.sort(roots[np.abs(roots.imag) == 0.0].real)
        real = real[np.abs(real) < 1.5]
        count = real_roots(c, -1.5, 1.5, work, out)
        assert count == len(real)
        apart = np.diff(real).min(initial=1.0)
        np.testing.assert_allclose(out[:count], real, atol=1e-13 / apart**2)


def test_roots_of_lower_degree():
    work, out = np.zeros((2, DEGREE + 2)), np.zeros(DEGREE)
    assert real_roots(np.array([-6.0, 3.0, 0.0, 0.0, 0.0]), -9.0, 9.0, work, out) == 1
    assert out[0] == pytest.approx(2.0)
    assert real_roots(np.array([1.0, 0.0, 1.0, 0.0, 0.0]), -9.0, 9.0, work, out) == 0


def satellites(rng, told):
    """Three satellites somewhere above a place, differences of their ranges and a known height."""
    up = rng.standard_normal(3)
    up /= np.sqrt(up @ up)
    place = up + 0.3 * rng.standard_normal((3, 3))
    place *= (WGS84_A + rng.uniform(5e5, 2e6)) / np.sqrt((place**2).sum(-1, keepdims=True))
    height = rng.uniform(-100.0, 9e3)
    below = up + 0.1 * rng.standard_normal(3)
    lat, lon, _ = optloc.problem.ECEF.to_geodetic(WGS84_A * below / np.sqrt(below @ below))
    truth = optloc.problem.ECEF.from_geodetic(lat, lon, height)
    rows = [measured("tdoa", a=[1, 2], b=0, arrival_sigma=rng.uniform(1.0, 100.0))]
    held = {"constraints": constraints.height(exactly=height)}
    if told:
        rows, held = [*rows, measured("height", [height], sigma=20.0)], {}
    problem = assemble(place, *rows, frame=optloc.problem.ECEF, **held)
    return simulate(problem, truth, int(rng.integers(1 << 30))), truth


@compiled
@pytest.mark.parametrize("told", [False, True])
def test_satellites_and_a_height_meet_where_the_closed_form_says(told):
    rng, settled, ambiguous = np.random.default_rng(7), 0, 0
    for _ in range(60):
        problem, _ = satellites(rng, told)
        flat = problem.flat()
        plan = plan_of(flat)
        assert plan.model.start == BY_HEIGHT
        found = plan.run(plan.load(flat), flat.z)[0]
        points = height_starts(flat)[0]
        points = points[np.isfinite(points).all(-1)]
        seen = points[~is_hidden(flat.take(np.zeros(len(points), dtype=int)), points)]
        assert found.settled[0] == (len(seen) > 0)
        if not len(seen):
            continue
        settled += 1
        # rows and a height are as many as unknowns: all points that are seen fit alike
        sigma = np.sqrt(np.trace(found.covariance[0]))
        apart = np.sqrt(((seen - found.x[0]) ** 2).sum(-1))
        assert apart.min() < 0.1 * sigma + 1.0
        assert np.isfinite(found.rival_cost[0]) == (len(seen) > 1)
        ambiguous += len(seen) > 1
    assert settled > 30
    assert ambiguous > 0


@compiled
def test_ranges_that_miss_the_earth_have_no_start():
    """Differences longer than the stations are apart, beside a problem that has its place."""
    problem, _ = satellites(np.random.default_rng(7), told=False)
    good = problem.flat()
    z = np.concatenate([good.z, good.z + 1e7, good.z])
    plan = plan_of(good)
    found = plan.run(plan.load(good), z)[0]
    assert found.settled.tolist() == [True, False, True]
    assert np.array_equal(found.x[0], found.x[2])


def pair(count):
    """Two aircraft that measure differences of range and of its rate at three epochs, and emitters about them."""
    times, velocity = np.array([0.0, 10.0, 20.0]), np.array([[120.0, 20.0], [110.0, -30.0]])
    place = np.array([[-10e3, 0.0], [10e3, 0.0]]) + times[:, None, None] * velocity
    stations = optloc.station_array(place, velocity=np.broadcast_to(velocity, place.shape))
    rows = [
        measured(kind, a=0, b=1, epoch=np.arange(3), sigma=sigma) for kind, sigma in (("tdoa", 30.0), ("fdoa", 0.3))
    ]
    problem = assemble(stations, *rows, times=times)
    rng = np.random.default_rng(3)
    turn, far = rng.uniform(0.0, 2.0 * np.pi, count), 10.0 ** rng.uniform(3.5, 4.8, count)
    truth = np.stack([far * np.cos(turn), far * np.sin(turn)], axis=1)
    z = np.stack([simulate(problem, one, i).z for i, one in enumerate(truth)])
    return problem.with_rows(z=z), truth


@compiled
def test_pairs_by_rates_find_the_minima_of_the_stages():
    problem, _ = pair(150)
    plan = plan_of(problem)
    assert plan.model.start == BY_PLACES
    fix, other = solve(problem, "gtrs+lsr"), verdict(problem, lsr_with_mirror(problem, gtrs(problem, None)))
    both = fix.answered & other.answered
    assert both.mean() > 0.95
    # what the stages found is never cheaper
    assert (fix.cost[both] <= other.cost[both] + 1e-6 * (1.0 + other.cost[both])).all()


@compiled
@pytest.mark.parametrize("kinds", [("azimuth", "elevation"), ("groa",), ("azimuth",), ("azimuth", "tdoa")])
def test_infinity_of_bent_fixes_is_what_a_search_finds(kinds):
    """Emitters so far away that their distance is hardly known."""
    rng = np.random.default_rng(len(kinds))
    d, count = (2 if kinds == ("azimuth",) else 3), 60
    place = rng.uniform(-5e3, 5e3, (6, d))
    a, b, sigma = np.arange(1, 6), 0, {"azimuth": 0.01, "elevation": 0.01, "groa": 0.01, "tdoa": 20.0}
    rows = [measured(k, a=a, sigma=sigma[k], **({"b": b} if k in ("groa", "tdoa") else {})) for k in kinds]
    problem = assemble(place, *rows)
    ahead = rng.standard_normal((count, d))
    truth = 10.0 ** rng.uniform(4.0, 5.5, (count, 1)) * ahead / np.sqrt((ahead**2).sum(-1, keepdims=True))
    z = np.stack([simulate(problem, one, i).z for i, one in enumerate(truth)])
    batch = problem.with_rows(z=z)
    plan = plan_of(batch)
    found = plan.run(plan.load(batch), z)[0]
    bent = np.flatnonzero(found.settled & (found.kappa[:, 0] > STRAIGHT))
    assert len(bent) > 5
    wanted = cost_at_infinity(batch.take(bent), found.x[bent])
    np.testing.assert_allclose(found.infinity[bent], wanted, rtol=2e-3, atol=1e-2)
    straight = found.settled & (found.kappa[:, 0] <= STRAIGHT)
    assert np.isnan(found.infinity[straight]).all()
    for i in bent[:5]:  # alone and in a block
        alone = plan.run(plan.load(batch), z[i : i + 1])[0]
        np.testing.assert_allclose(alone.infinity[0], found.infinity[i], rtol=1e-6)
