"""Bounds: minima on faces, against SciPy and against the cost along a whole face."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to
from scipy.optimize import minimize

from optloc import Status, assemble, constraints, measured, solve
from optloc.linear.constraints import faces
from optloc.solvers.inequalities import bound_pool, is_minimum, without_broken
from optloc.solvers.pool import begin
from optloc.solvers.stages import lsr


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


# Stations, measured ranges, normal and limits of a band: data that contradict it by hundreds of chi-square.
STATIONS = np.array([[-27.0, 3.0], [282.0, -11.0], [-508.0, -101.0]])
NORMAL = np.array([0.97, -0.245]) / np.hypot(0.97, -0.245)


def far_from(band, z):
    rows = measured("range", z, a=np.arange(3), sigma=20.0)
    return assemble(STATIONS, rows, constraints=constraints.band(NORMAL, *band))


def least_along(band, z):
    """Return the least cost on the two edges of a band, at points a tenth of a metre apart."""
    along = np.arange(-2e3, 2e3, 0.1)[:, None] * [-NORMAL[1], NORMAL[0]]
    places = np.concatenate([side * NORMAL + along for side in band])
    away = np.linalg.norm(places[:, None] - STATIONS, axis=-1)
    return (((away - z) / 20.0) ** 2).sum(-1).min()


def test_no_minimum_is_missed_along_an_edge_far_from_the_data():
    random = np.random.default_rng(3)
    missed = []
    for number in range(12):
        z = np.linalg.norm(random.uniform(-250.0, 250.0, 2) + 200.0 * NORMAL - STATIONS, axis=1)
        band = np.array([-115.5, -62.8]) - 20.0 * number
        fix = solve(far_from(band, z))
        if fix.cost > least_along(band, z) + 1e-2:
            missed.append(number)
    assert not missed


def test_the_problems_of_a_batch_are_searched_one_by_one():
    z = np.array([[250.0, 380.0, 420.0], [300.0, 250.0, 500.0], [100.0, 250.0, 490.0]])
    together = solve(far_from((-200.0, -190.0), z))
    for i, one in enumerate(z):
        alone = solve(far_from((-200.0, -190.0), one))
        np.testing.assert_allclose(together.position[i], alone.position, atol=1e-6)
        assert together.code[i] == alone.code
