"""Where ranges of satellites meet the ellipsoid of a known height, against the closed form."""

import numpy as np
import pytest

import optloc
from optloc import assemble, constraints, measured, simulate
from optloc.engine.memory import BY_HEIGHT
from optloc.engine.plan import plan_of
from optloc.kernels.jit import enabled
from optloc.models.primitives import WGS84_A
from optloc.solvers.horizon import is_hidden
from optloc.solvers.starts.position import height_starts

compiled = pytest.mark.skipif(not enabled(), reason="there are no plans without machine code")


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
