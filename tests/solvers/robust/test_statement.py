"""Tests of a robust fix: changes of single rows, and what is not checked at all."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import constraints, solve
from optloc.problem.loss import LOSSES
from optloc.solvers.policy import AMBIGUOUS_GAP
from optloc.solvers.robust.stage import Robust
from optloc.solvers.robust.statement import NEEDS, _changes, _squared, _squared_position, check_minima

MORE = np.concatenate([SQUARE, [[-400.0, 500.0], [1300.0, 300.0], [600.0, 1500.0]]])
ERROR = np.array([0.5, -1.0, 200.0, -0.5, 1.0, 0.3, -0.8, 0.2])


@pytest.fixture(scope="module")
def searched():
    """Return a problem with one gross row of eight, and the minima of a loss."""
    problem = ranges_to(PLACE, 1.0, ERROR, MORE)
    return problem, Robust(LOSSES["cauchy"])(problem, None)


def test_every_row_changes_alone_and_a_doubted_one_is_exchanged_for_each_other():
    present, doubted = np.array([[True, True, True, False]]), np.array([[False, True, False, False]])
    item, change, limit = _changes(present, doubted)
    assert item.tolist() == [0] * 5
    assert change.astype(int).tolist() == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 1, 0, 0], [0, 1, 1, 0]]
    # leaving one out must gain what a row costs less the gap, and taking one back may cost it and the gap
    assert limit.tolist() == [-7.0, 25.0, -7.0, AMBIGUOUS_GAP, AMBIGUOUS_GAP]


def test_one_gross_row_of_eight_passes_and_of_four_does_not(searched):
    problem, found = searched
    pool = check_minima(problem, LOSSES["cauchy"], found)
    assert pool.robust.tolist() == [True]
    assert pool.remark[0] == ""
    few = ranges_to(PLACE, 1.0, ERROR[:4], SQUARE[:4])
    pool = check_minima(few, LOSSES["cauchy"], Robust(LOSSES["cauchy"])(few, None))
    assert pool.robust.tolist() == [False]
    assert pool.remark[0]


def test_constraints_are_not_checked_and_said(searched):
    problem, found = searched
    boxed = replace(problem, constraints=tuple(constraints.box([-1e4, -1e4], [1e4, 1e4])))
    pool = check_minima(boxed, LOSSES["cauchy"], found)
    assert pool.remark[0] == NEEDS


def test_steps_are_measured_in_the_covariance_of_the_fix():
    problem = ranges_to(PLACE, 2.0, stations=SQUARE)
    fix = solve(problem, "gtrs+lsr")
    step = np.array([[3.0, -2.0]])
    expected = step[0] @ np.linalg.solve(fix.cov[0], step[0])
    assert _squared(fix, step)[0] == pytest.approx(expected)
    assert _squared_position(problem, fix, step)[0] == pytest.approx(expected)
