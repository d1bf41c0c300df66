"""Solve: the answer of plain least squares, and what is refused or left as it is."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to
from scipy.optimize import least_squares

from optloc import InvalidProblem, Motion, Status, assemble, measured
from optloc.solvers.methods import Method
from optloc.solvers.solution import solve, solve_in_stages

ERROR = np.array([0.5, -1.0, 2.0, -0.5, 1.0])


def test_the_fix_is_the_least_squares_point():
    fix = solve(ranges_to(PLACE, 2.0, ERROR), "gtrs+lsr")
    r = np.linalg.norm(PLACE - SQUARE, axis=1)
    best = least_squares(lambda x: (np.linalg.norm(x - SQUARE, axis=1) - r - ERROR) / 2.0, PLACE, xtol=1e-15)
    np.testing.assert_allclose(fix.x[0], best.x, atol=1e-4)
    assert fix.cost[0] == pytest.approx(2.0 * best.cost, rel=1e-6)
    staged = solve_in_stages(ranges_to(PLACE, 2.0, ERROR), Method.parse("gtrs+lsr"))
    np.testing.assert_allclose(staged.x, fix.x, atol=1e-4)


def test_epochs_that_share_nothing_are_one_more_axis():
    epoch, a = np.repeat([0, 1], 5), np.tile(np.arange(5), 2)
    z = np.concatenate([np.linalg.norm(place - SQUARE, axis=1) for place in (PLACE, PLACE + 100.0)])
    rows = measured("range", z, a=a, sigma=1.0, epoch=epoch)
    fix = solve(assemble(SQUARE, rows, times=[0.0, 1.0], motions=(Motion(0, span="epoch"),)))
    assert fix.shape == (2,)
    np.testing.assert_allclose(fix.position, [PLACE, PLACE + 100.0], atol=1e-3)


def test_a_start_stays_as_it_is_where_nothing_refines_it():
    problem = ranges_to(PLACE, 2.0, ERROR)
    fix = solve(problem, "gtrs", refine=False)
    assert fix.code[0] == Status.UNREFINED
    again = solve(problem, "lsr", start=PLACE + 30.0)
    np.testing.assert_allclose(again.x[0], solve(problem, "gtrs+lsr").x[0], atol=1e-3)


def test_a_start_of_another_size_and_a_problem_without_unknowns_are_refused():
    problem = ranges_to(PLACE, 2.0)
    with pytest.raises(InvalidProblem, match="start has shape"):
        solve(problem, "lsr", start=np.zeros(3))
    known = Motion(0, known=PLACE[None, None])
    rows = measured("range", np.ones(5), a=np.arange(5), sigma=1.0)
    with pytest.raises(InvalidProblem, match="nothing is unknown"):
        solve(assemble(SQUARE, rows, motions=(known,)), "gtrs")
