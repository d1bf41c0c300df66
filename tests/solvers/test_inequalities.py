"""Bounds and the horizon: what the Earth hides, and minima on the faces of a box, against SciPy."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to
from scipy.optimize import minimize

from optloc import Status, assemble, constraints, measured
from optloc.base.frames import ECEF
from optloc.linear.constraints import faces
from optloc.solvers.inequalities import bound_pool, is_hidden, is_minimum, lowest_sight, without_broken
from optloc.solvers.pool import begin
from optloc.solvers.stages import lsr

RADIUS, HIGH = 6378137.0, 26.6e6
# satellites over the equator at these longitudes, degrees
SATELLITES = np.radians([0.0, 60.0, 100.0])


def from_space():
    stations = HIGH * np.stack([np.cos(SATELLITES), np.sin(SATELLITES), 0.0 * SATELLITES], axis=-1)
    return assemble(stations, measured("range", np.full(3, 2.3e7), a=np.arange(3), sigma=5.0), frame=ECEF).flat()


def test_a_satellite_below_the_horizon_is_hidden():
    problem, ground = from_space(), RADIUS * np.array([[1.0, 0.0, 0.0]])
    # from longitude 0 the satellite at 100 degrees is below the horizon, which is 76 degrees away
    assert is_hidden(problem, ground).tolist() == [True]
    assert is_hidden(problem.with_rows(weight=np.array([[1.0, 1.0, 0.0]])), ground).tolist() == [False]
    assert not is_hidden(ranges_to(PLACE, 1.0), PLACE[None]).any()


def test_the_lowest_sight_is_the_sine_of_the_elevation():
    problem, ground = from_space(), RADIUS * np.array([[1.0, 0.0, 0.0]])
    line = HIGH * np.stack([np.cos(SATELLITES), np.sin(SATELLITES)], axis=-1) - [RADIUS, 0.0]
    expected = (line[:, 0] / np.linalg.norm(line, axis=1)).min()
    assert lowest_sight(problem, ground)[0] == pytest.approx(expected, abs=1e-9)
    assert lowest_sight(ranges_to(PLACE, 1.0), PLACE[None]).tolist() == [0.0]


@pytest.fixture
def held():
    """Return a problem whose best place is beyond a side of its box, and the cost of places."""
    error = np.array([0.5, -1.0, 2.0, -0.5, 1.0])
    box = tuple(constraints.box([-np.inf, -np.inf], [290.0, np.inf]))
    z = np.linalg.norm(PLACE - SQUARE, axis=1) + error
    return replace(ranges_to(PLACE, 2.0, error), constraints=box), lambda x: (
        ((np.linalg.norm(x - SQUARE, axis=1) - z) / 2.0) ** 2
    ).sum()


def test_the_minimum_on_a_side_is_that_of_a_bounded_search(held):
    problem, cost = held
    pool = lsr(problem, begin(problem, PLACE[None]))
    best = minimize(cost, [280.0, 650.0], bounds=[(None, 290.0), (None, None)], method="L-BFGS-B", tol=1e-14)
    np.testing.assert_allclose(pool.x[0, 0], best.x, atol=1e-2)
    assert pool.cost[0, 0] == pytest.approx(best.fun, rel=1e-6)
    side = faces(problem)[pool.face[0, 0]]
    assert is_minimum(problem, side, pool.x[:, 0]).tolist() == [True]


def test_candidates_beyond_a_bound_are_refused(held):
    problem, _ = held
    free = lsr(replace(problem, constraints=()), begin(problem, PLACE[None]))
    pool = without_broken(problem, free)
    assert pool.cost[0, 0] == np.inf
    assert pool.code[0, 0] == Status.INFEASIBLE
    wide = replace(problem, constraints=tuple(constraints.box([0.0, 0.0], [1e3, 1e3])))
    assert bound_pool(wide, free) is free
