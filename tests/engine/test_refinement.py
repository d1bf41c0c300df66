"""Damped steps of a block, against a minimiser of the plainly written cost."""

import numpy as np
import pytest
from cases import CASES, plain_cost
from engine.blocks import block_of
from scipy.optimize import minimize

from optloc.engine import ranges, tapes
from optloc.engine.admission import evaluate
from optloc.engine.memory import ALIVE, COST, DAMPING, GAIN, GOOD, MOVE, SOLVABLE, STEPS, X
from optloc.engine.refinement import propose, refine

pytestmark = pytest.mark.usefixtures("in_python")


@pytest.mark.parametrize(("name", "module"), [("range-2d", ranges), ("tdoa+azimuth-2d", tapes)])
def test_a_refinement_ends_at_the_least_cost(name, module):
    problem, truth = CASES[name].problem, CASES[name].truth
    block = block_of(problem, module)
    block.put(truth + np.array([400.0, -300.0]))
    block.run(refine, block.model, block.rows, block.room, 1e-7, 60)
    scalar, x = block.room.scalar, block.at(X)
    assert (scalar[GOOD, 0], scalar[ALIVE, 0]) == (1.0, 0.0)
    assert 1 <= scalar[STEPS, 0] < 20
    assert scalar[COST, 0] == pytest.approx(plain_cost(problem, x))
    least = minimize(lambda at: plain_cost(problem, at), x, method="Nelder-Mead", options={"xatol": 1e-3})
    np.testing.assert_allclose(x, least.x, atol=0.02)


def test_a_refinement_out_of_steps_stays_alive_and_one_without_a_start_is_not_good():
    block = block_of(CASES["range-2d"].problem, ranges)
    block.put(CASES["range-2d"].truth + 900.0)
    block.run(refine, block.model, block.rows, block.room, 1e-7, 1)
    assert block.room.scalar[[GOOD, ALIVE, STEPS], 0].tolist() == [1.0, 1.0, 1.0]
    block.put(np.full(2, np.nan))
    block.run(refine, block.model, block.rows, block.room, 1e-7, 9)
    assert block.room.scalar[[GOOD, ALIVE], 0].tolist() == [0.0, 0.0]


def test_a_proposed_step_solves_the_damped_equations():
    block = block_of(CASES["tdoa-3d"].problem, ranges)
    block.put(CASES["tdoa-3d"].truth + 70.0)
    block.run(evaluate, block.model, block.rows, block.room, 0)
    block.room.scalar[DAMPING] = 0.5
    block.run(propose, block.model, block.room)
    information, right, _ = block.equations()
    move = np.linalg.solve(information + 0.5 * np.diag(np.diag(information)), right)
    np.testing.assert_allclose(block.room.vector[MOVE, :, 0], move, rtol=1e-9)
    assert block.room.scalar[GAIN, 0] == pytest.approx(move @ right)
    assert block.room.scalar[SOLVABLE, 0] == 1.0
