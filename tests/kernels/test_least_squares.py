"""Refinement from given starts, by numpy, against a minimiser of a plainly written cost."""

import numpy as np
import pytest
from cases import CASES, plain_cost
from scipy.optimize import minimize

from optloc import Status, assemble, measured
from optloc.kernels.jit import plain
from optloc.kernels.least_squares import Limits, refine
from optloc.linear.constraints import box, exact


@pytest.fixture(autouse=True)
def by_numpy():
    """Take the form without machine code."""
    with plain():
        yield


@pytest.mark.parametrize("name", ["tdoa+azimuth-2d", "range+range_sum-3d"])
def test_a_refinement_ends_where_a_minimiser_of_the_plain_cost_ends(name):
    case = CASES[name]
    found = refine(case.problem.flat(), case.truth[None] + 300.0)
    least = minimize(lambda x: plain_cost(case.problem, x), found.x[0], method="Nelder-Mead", options={"xatol": 1e-4})
    assert found.status[0] == Status.OK
    assert found.cost[0] == pytest.approx(plain_cost(case.problem, found.x[0]))
    assert found.cost[0] <= least.fun + 1e-9
    np.testing.assert_allclose(found.x[0], least.x, atol=0.01)
    assert found.equations.cost[0] == pytest.approx(found.cost[0])


def test_starts_may_share_a_problem_and_a_limit_of_steps_is_a_status():
    case = CASES["range-2d"]
    starts = case.truth + np.array([[0.0, 0.0], [500.0, 900.0], [-800.0, 200.0]])
    found = refine(case.problem.flat(), starts, item=np.zeros(3, dtype=int))
    np.testing.assert_allclose(found.x, np.broadcast_to(found.x[:1], (3, 2)), atol=1e-3)
    short = refine(case.problem.flat(), starts[1:2], limit=1)
    assert short.status.tolist() == [Status.MAX_ITERATIONS]
    assert short.iterations.tolist() == [1]


def test_an_answer_on_a_face_is_the_best_of_the_face():
    rows = CASES["range-2d"].problem.rows[0]
    line = box([-np.inf, 6e3], [np.inf, 6e3])
    places = CASES["range-2d"].problem.stations.position[0]
    problem = assemble(places, measured("range", rows.z, a=rows.a, sigma=5.0), constraints=line).flat()
    found = refine(problem, np.array([[2e3, 6e3]]), face=exact(problem))
    across = np.linspace(-50.0, 50.0, 2001)
    costs = [
        ((rows.z - np.hypot(found.x[0, 0] + t - places[:, 0], 6e3 - places[:, 1])) ** 2).sum() / 25.0 for t in across
    ]
    assert found.x[0, 1] == pytest.approx(6e3)
    assert abs(across[int(np.argmin(costs))]) <= 0.05


def test_limits_stop_a_refinement_at_their_end():
    case = CASES["range-2d"]
    problem, best = case.problem.flat(), refine(case.problem.flat(), case.truth[None]).x
    limits = Limits(0, best[:, 0] - 500.0, best[:, 0] - 200.0)
    assert limits.clip(best)[0].tolist() == [best[0, 0] - 200.0, best[0, 1]]
    assert [limits.reached(best + move)[0] for move in (-600.0, -300.0, 0.0)] == [-1, 0, 1]
    found = refine(problem, best - [300.0, 0.0], limits=limits)
    assert limits.reached(found.x).tolist() == [1]
    assert found.status.tolist() == [Status.STALLED]
