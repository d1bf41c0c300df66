"""Walks of biases as information, against their cost by definition."""

import numpy as np
import pytest

from optloc import assemble, measured, with_bias
from optloc.linear.walks import chain_at, count_free_unknowns, simulate_walks, state_columns, walk_names, walks

TIMES = np.array([0.0, 10.0, 30.0, 35.0])
DENSITY, MEAN, SIGMA = 0.04, 3.0, 2.0


@pytest.fixture
def problem():
    a, epoch = np.tile([1, 2, 3], 4), np.repeat(np.arange(4), 3)
    rows = measured("tdoa", a=a, b=0, epoch=epoch, sigma=3.0)
    whole = assemble(1e3 * np.array([[0, 0], [9, 1], [10, 9], [1, 10.0]]), rows, times=TIMES)
    return with_bias(whole, "clock", form="walk", members=["S1", "S3"], density=DENSITY, mean=MEAN, sigma=SIGMA)


def cost(problem, x):
    """Return the cost of the steps of random walks, and of where they begin."""
    value = problem.layout.take(x, "clock")
    steps = (np.diff(value, axis=0) ** 2 / (DENSITY * np.diff(TIMES))[:, None]).sum()
    return steps + ((value[0] - MEAN) ** 2 / SIGMA**2).sum()


def test_the_cost_of_a_walk_is_that_of_its_independent_steps(problem):
    x = np.random.default_rng(1).uniform(-5.0, 5.0, problem.layout.size)
    assert chain_at(problem, x).cost == pytest.approx(cost(problem, x))


def test_information_and_vector_of_a_walk_are_derivatives_of_its_cost(problem):
    x, n = np.random.default_rng(2).uniform(-5.0, 5.0, problem.layout.size), problem.layout.n_shared
    found = chain_at(problem, x)
    k, size = found.block.shape[:2]
    whole = np.zeros((k, size, k, size))
    whole[range(k), :, range(k)] = found.block
    whole[range(k - 1), :, range(1, k)] = found.link
    whole[range(1, k), :, range(k - 1)] = found.link.mT
    move = np.zeros(problem.layout.size)
    move[n:] = np.random.default_rng(3).standard_normal(k * size)
    # of a quadratic cost differences are exact: c(x + u) = c(x) - 2 u'v + u'Wu
    flat = move[n:]
    linear, square = flat @ found.vector.ravel(), flat @ whole.reshape(k * size, -1) @ flat
    assert cost(problem, x + move) == pytest.approx(found.cost - 2.0 * linear + square)
    assert cost(problem, x - move) == pytest.approx(found.cost + 2.0 * linear + square)


def test_walks_are_named_and_placed_among_the_unknowns_of_an_epoch(problem):
    (walk,) = walks(problem)
    assert walk_names(problem) == ("clock",)
    assert state_columns(problem.layout, walk).tolist() == [[0], [1]]
    assert count_free_unknowns(problem) == 0
    assert count_free_unknowns(with_bias(problem, "other", form="walk", density=1.0, rate_density=0.1)) == 8


def test_drawn_walks_begin_at_the_given_values_and_spread_with_the_root_of_time(problem):
    truth = np.zeros(problem.layout.size)
    truth[problem.layout.n_shared :][:2] = [20.0, -30.0]
    value = problem.layout.take(simulate_walks(problem, truth, 5, 4000), "clock")
    assert (value[:, 0] == [20.0, -30.0]).all()
    np.testing.assert_allclose(value[:, 1:].std(0), np.sqrt(DENSITY * TIMES[1:])[:, None] * [1, 1], rtol=0.06)
