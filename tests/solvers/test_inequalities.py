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


# Data that contradict a half-plane or a band by hundreds of chi-square: kind, stations, measurements, standard
# deviation, direction of the normal in degrees, and limits. Descents from the free candidates missed the least minimum.
FAR = {
    "four differences": (
        "tdoa",
        [[-439, -144], [-45, -367], [40, 6], [498, -144], [-284, -6]],
        ([-305, -401, -160, -94], 60.0, 4.5, (-161.0, -136.0)),
    ),
    "six ranges": (
        "range",
        [[-268, -90], [-178, -197], [8, -409], [142, -410], [-441, -155], [570, -473]],
        ([285, 318, 503, 482, 468, 796], 20.0, -34.3, (171.0, 251.0)),
    ),
    "five differences": (
        "tdoa",
        [[541, -501], [-101, -550], [-108, -271], [-97, 59], [509, -90], [14, -539]],
        ([-7, -155, -185, -254, -24], 20.0, 171.0, (-62.0, 38.0)),
    ),
    "half-plane": (
        "tdoa",
        [[482, -572], [224, 221], [-411, -538], [-584, 79], [402, -326], [-116, 479]],
        ([-670, -7, -180, -235, -451], 20.0, 156.7, (-np.inf, -140.0)),
    ),
}


@pytest.mark.parametrize("case", FAR)
def test_no_minimum_is_missed_along_an_edge_far_from_the_data(case):
    kind, places, (z, sigma, heading, limits) = FAR[case]
    stations, first = np.array(places, dtype=float), 0 if kind == "range" else 1
    others = {} if kind == "range" else {"b": 0}
    rows = measured(kind, np.array(z, dtype=float), a=np.arange(first, len(stations)), sigma=sigma, **others)
    normal = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading))])
    fix = solve(assemble(stations, rows, constraints=constraints.band(normal, *limits)))
    # the cost at points half a metre apart along both edges
    along = np.arange(-3e3, 3e3, 0.5)[:, None] * [-normal[1], normal[0]]
    edge = np.concatenate([limit * normal + along for limit in limits if np.isfinite(limit)])
    away = np.linalg.norm(edge[:, None] - stations, axis=-1)
    modelled = away if kind == "range" else away[:, 1:] - away[:, :1]
    assert fix.cost <= (((modelled - z) / sigma) ** 2).sum(-1).min()


def test_the_problems_of_a_batch_are_searched_one_by_one():
    z = np.array([[250.0, 380.0, 420.0], [300.0, 250.0, 500.0], [100.0, 250.0, 490.0]])
    stations = np.array([[-27.0, 3.0], [282.0, -11.0], [-508.0, -101.0]])

    def solved(ranges):
        rows = measured("range", ranges, a=np.arange(3), sigma=20.0)
        return solve(assemble(stations, rows, constraints=constraints.band([0.97, -0.245], -200.0, -190.0)))

    together = solved(z)
    for i, one in enumerate(z):
        alone = solved(one)
        np.testing.assert_allclose(together.position[i], alone.position, atol=1e-6)
        assert together.code[i] == alone.code
