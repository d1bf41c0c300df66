"""Starts that squared ranges do not give: the cheapest of many places, against those of the stages."""

import numpy as np
import pytest

import optloc
from optloc import assemble, measured, simulate, solve
from optloc.engine.memory import BY_PLACES
from optloc.engine.plan import plan_of
from optloc.kernels.jit import enabled
from optloc.solvers.stages import gtrs, lsr_with_mirror
from optloc.solvers.verdict.judge import verdict

compiled = pytest.mark.skipif(not enabled(), reason="there are no plans without machine code")


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
