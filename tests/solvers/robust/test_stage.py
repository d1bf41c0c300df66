"""The stage that minimises a loss: one gross row does no harm and is named."""

from types import SimpleNamespace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import assemble, measured
from optloc.problem.loss import LOSSES
from optloc.solvers.pool import begin
from optloc.solvers.robust.stage import Robust, doubted_minima, rejected

MORE = np.concatenate([SQUARE, [[-400.0, 500.0], [1300.0, 300.0], [600.0, 1500.0]]])
ERROR = np.array([0.5, -1.0, 200.0, -0.5, 1.0, 0.3, -0.8, 0.2])


@pytest.mark.parametrize("loss", ["huber", "cauchy", "truncated"])
def test_a_gross_row_is_doubted_and_does_no_harm(loss):
    problem = ranges_to(PLACE, 1.0, ERROR, MORE)
    pool = Robust(LOSSES[loss])(problem, begin(problem, PLACE[None] + 2.0))
    assert np.linalg.norm(pool.x[0, 0] - PLACE) < 3.0
    assert pool.weights[0].argmin() == 2
    assert pool.weights[0, 2] < 0.25
    assert pool.loss == loss


def test_a_late_arrival_is_named_among_differences():
    arrival = np.linalg.norm(PLACE - MORE, axis=1) + ERROR
    rows = measured("tdoa", arrival[1:] - arrival[0], a=np.arange(1, 8), b=0, arrival_sigma=1.0)
    problem = assemble(MORE, rows).flat()
    pool = Robust(LOSSES["cauchy"])(problem, begin(problem, PLACE[None] + 2.0))
    assert np.linalg.norm(pool.x[0, 0] - PLACE) < 3.0
    assert pool.weights[0].argmin() == 1
    assert pool.x.shape[-1] == 2  # the emission time is no unknown of the answer


def test_the_best_minimum_leaves_out_the_gross_row():
    found = doubted_minima(ranges_to(PLACE, 1.0, ERROR, MORE), LOSSES["cauchy"], 3)
    x, doubted = found[0]
    assert np.linalg.norm(x - PLACE) < 3.0
    assert np.flatnonzero(doubted).tolist() == [2]
    assert len(found) <= 3


def test_rows_are_rejected_below_a_quarter_of_their_weight():
    problem = ranges_to(PLACE, 1.0).with_rows(weight=np.array([[1.0, 1.0, 0.5, 0.0, 1.0]]))
    fix = SimpleNamespace(weights=np.array([[1.0, 0.24, 0.2, 0.0, 0.26]]))
    assert rejected(problem, fix).tolist() == [[False, True, False, False, False]]
