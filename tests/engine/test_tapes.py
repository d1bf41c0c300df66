"""Rows of every kind as tapes: equations against differences, and other unknowns that fit a position best."""

import numpy as np
import pytest
from cases import CASES, dense_covariance, plain_predict, wrapped
from engine.blocks import block_of

from optloc import with_bias
from optloc.engine import tapes
from optloc.engine.evaluator import bow_of, complete, costs, equations
from optloc.engine.memory import COST_TRIAL, TRIAL, X

pytestmark = pytest.mark.usefixtures("in_python")


def residual(problem, x):
    return wrapped(problem, problem.observed - plain_predict(problem, x))


def weight_of(problem):
    return np.linalg.pinv(dense_covariance(problem), rcond=1e-12, hermitian=True)


@pytest.mark.parametrize("name", ["tdoa+azimuth-2d", "range+azimuth-3d", "groa-2d"])
def test_equations_are_those_of_differences_of_plain_predictions(name):
    problem, x = CASES[name].problem, CASES[name].truth + 20.0
    block, weight = block_of(problem, tapes), weight_of(problem)
    block.put(x)
    block.run(equations, block.rows, block.room, 0)
    information, right, cost = block.equations()
    steps = 0.01 * np.eye(len(x))
    jacobian = np.array([wrapped(problem, residual(problem, x - e) - residual(problem, x + e)) for e in steps]).T / 0.02
    left = residual(problem, x)
    assert cost == pytest.approx(left @ weight @ left)
    expected = jacobian.T @ weight @ jacobian
    np.testing.assert_allclose(information, expected, rtol=1e-5, atol=1e-6 * expected.max())
    np.testing.assert_allclose(right, jacobian.T @ weight @ left, rtol=1e-4, atol=1e-6)


def test_other_unknowns_are_the_best_for_their_position_and_costs_are_the_least():
    problem = with_bias(CASES["tdoa-3d"].problem, "clock", members=["S1", "S3"])
    block, place, weight = block_of(problem, tapes), CASES["tdoa-3d"].truth + 50.0, weight_of(problem)
    x = np.append(place, [9.0, 9.0])
    block.put(x)
    block.run(complete, block.rows, block.room)
    design = np.zeros((problem.count, 2))
    design[[0, 2], [0, 1]] = 1.0
    left = residual(problem, np.append(place, [0.0, 0.0]))
    best = np.linalg.solve(design.T @ weight @ design, design.T @ weight @ left)
    np.testing.assert_allclose(block.at(X), np.append(place, best), rtol=1e-9)
    block.put(x, TRIAL)
    block.run(costs, block.rows, block.room)
    off = left - design @ best
    assert block.room.scalar[COST_TRIAL, 0] == pytest.approx(off @ weight @ off)


def test_tapes_have_no_bound_of_their_curvature():
    block = block_of(CASES["groa-2d"].problem, tapes)
    assert block.run(bow_of, block.rows, block.room) == np.inf
