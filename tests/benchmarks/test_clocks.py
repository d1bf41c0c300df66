"""Clocks that walk against clocks that stay: a long run may take three times as long. Run it in a quiet moment."""

from time import perf_counter

import numpy as np
import pytest

import optloc
from optloc.problem.bias import with_bias

EPOCHS, ROUNDS = 10_000, 3
MOST = 3.0


def run(**change):
    """Return a drawn run of four range differences a second, of stations that circle around a target."""
    t = np.arange(float(EPOCHS))
    angle, turn = np.array([0.0, 1.3, 2.6, 3.8, 5.0]), (t / t[-1])[:, None]
    height = np.array([1.0, 4.0, 0.7, 3.0, 5.0]) * 1e3 * (1.0 + 0.5 * np.cos(3.0 * turn + angle))
    place = np.stack([9e3 * np.cos(angle + 1.5 * turn), 9e3 * np.sin(angle + 1.5 * turn), height], axis=-1)
    rows = optloc.measured(
        "tdoa", a=np.tile([1, 2, 3, 4], EPOCHS), b=0, epoch=np.repeat(np.arange(EPOCHS), 4), sigma=3.0
    )
    plain = optloc.assemble(place, rows, times=t)
    problem = with_bias(plain, "clock", members=["S1", "S2", "S3", "S4"], **change)
    truth = np.zeros(problem.layout.size)
    truth[:3] = [4e3, 3e3, 1e3]
    return optloc.simulate(problem, optloc.engine.simulate_walks(problem, truth, 5), 6)


def seconds(problem):
    """Return the least time of a few fixes."""
    best = np.inf
    for _ in range(ROUNDS):
        began = perf_counter()
        assert optloc.solve(problem).answered
        best = min(best, perf_counter() - began)
    return best


@pytest.mark.full
def test_clocks_that_walk_take_three_times_as_long_at_most():
    assert seconds(run(form="walk", density=0.0025)) < MOST * seconds(run())
