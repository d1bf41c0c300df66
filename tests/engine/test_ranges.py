"""Rows that are sums of ranges: equations and curvature against differences, and the cost of infinity."""

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET, dense_covariance, plain_predict
from engine.blocks import block_of
from engine.networks import around, scene
from scipy.optimize import least_squares

from optloc.engine import ranges
from optloc.engine.evaluator import bend, equations, finish
from optloc.engine.memory import H_TRIAL
from optloc.kernels.jit import enabled

machine_code = pytest.mark.skipif(not enabled(), reason="there is no direct way without machine code")


def least_at_infinity(made, i):
    """The least cost of all directions, by a fine grid and SciPy, at a million spreads of the stations."""
    d, centre, remote = made.place.shape[-1], made.place[i].mean(0), 1e10
    rng = np.random.default_rng(5)
    e = rng.standard_normal((4000, d))
    e /= np.sqrt((e**2).sum(-1, keepdims=True))
    best = e[np.argsort(made.cost(i, centre + remote * e))[:4]]

    def left(v):
        return made.residuals(i, centre + remote * v / np.sqrt(v @ v))

    # differences of ranges of ten million kilometres lose their last digits: a coarse step for the derivatives
    return min(2.0 * least_squares(left, v, x_scale="jac", diff_step=1e-6).cost for v in best)


@machine_code
@pytest.mark.parametrize("case", ["line of sight in the plane", "space", "stations in one plane"])
def test_infinity_is_the_least_of_all_directions(case):
    d = 2 if case.startswith("line") else 3
    made = around("tdoa", d, d + 3, (5.0, 5.6), 30)
    if case.endswith("one plane"):  # hard case: two directions of the same cost
        place = made.place.copy()
        place[..., 2] *= 1e-9
        above = np.abs(made.truth) * np.array([0.2, 0.2, 1.0])
        made = scene("tdoa", place, above, 3)
    found, exact = made.answer(), 0
    for i in np.flatnonzero(found.settled):
        least = least_at_infinity(made, i)
        if found.infinity[i] <= found.cost[i] + 16.0:
            exact += 1
            assert found.infinity[i] == pytest.approx(least, rel=1e-3, abs=1e-3)
        else:  # a lower bound, beyond all that is asked
            assert found.infinity[i] <= least * (1.0 + 1e-3) + 1e-3
    assert exact > 3 or case.endswith("one plane")


@machine_code
def test_ranges_cost_ever_more_at_infinity():
    assert np.isinf(around("range", 3, 5, (3.0, 4.0), 20).answer().infinity).all()


# Single steps, in plain Python.


def second_differences(cost, x, step):
    """Return half the second derivatives (d, d) of a cost."""
    e = step * np.eye(len(x))
    rows = [[cost(x + u + v) - cost(x + u - v) - cost(x - u + v) + cost(x - u - v) for u in e] for v in e]
    return np.array(rows) / (8.0 * step**2)


@pytest.mark.usefixtures("in_python")
@pytest.mark.parametrize("name", ["tdoa-3d", "range-2d", "range_sum-2d", "toa-2d"])
def test_equations_and_curvature_are_those_of_differences(name):
    problem = CASES[name].problem
    d = problem.dimension
    block, x = block_of(problem, ranges), TARGET[d] + 30.0
    weight = np.linalg.pinv(dense_covariance(problem), rcond=1e-12, hermitian=True)
    if name.startswith("toa"):  # an emission time that is common to all is projected out
        ones = np.ones(problem.count)
        weight = weight - np.outer(weight @ ones, ones @ weight) / (ones @ weight @ ones)

    def residual(at):
        vector = np.append(at, 0.0)[: problem.layout.size]
        return problem.observed - plain_predict(problem, vector)

    def cost(at):
        return residual(at) @ weight @ residual(at)

    block.put(x)
    block.run(equations, block.rows, block.room, 0)
    information, right, found = block.equations()
    jacobian = np.array([residual(x - 0.01 * e) - residual(x + 0.01 * e) for e in np.eye(d)]).T / 0.02
    assert found == pytest.approx(cost(x))
    np.testing.assert_allclose(information, jacobian.T @ weight @ jacobian, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(right, jacobian.T @ weight @ residual(x), rtol=1e-6, atol=1e-6)
    block.run(bend, block.rows, block.room)
    curvature = np.tril(block.room.matrix[H_TRIAL, :, :, 0])
    expected = second_differences(cost, x, 2.0)
    np.testing.assert_allclose(curvature, np.tril(expected), atol=2e-4 * np.abs(expected).max())


@pytest.mark.usefixtures("in_python")
def test_a_finished_fix_has_the_emission_time_that_fits_it():
    problem = CASES["toa-2d"].problem
    block, x = block_of(problem, ranges), np.zeros((1, 3))
    block.put(TARGET[2])
    z = np.atleast_2d(problem.z)
    block.run(finish, block.rows, z, block.room, 1, block.room.scalar[0], False, x)
    assert x[0, 2] == pytest.approx((problem.observed - np.linalg.norm(STATIONS[2] - TARGET[2], axis=1)).mean())
