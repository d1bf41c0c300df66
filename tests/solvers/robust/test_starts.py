"""Starts that gross errors cannot spoil: subsets of rows, and ways down to a loss that is not convex."""

import numpy as np
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import assemble, measured
from optloc.problem.loss import LOSSES
from optloc.solvers.pool import begin
from optloc.solvers.robust.starts import _graduate, _unite, flip_rows, robust_starts, subsets
from optloc.solvers.stages import lsr

MORE = np.concatenate([SQUARE, [[-400.0, 500.0], [1300.0, 300.0], [600.0, 1500.0]]])
ERROR = np.array([0.5, -300.0, 200.0, -0.5, 1.0, 0.3, -0.8, 0.2])


def test_subsets_lack_one_station_or_more_and_keep_enough_rows():
    problem = ranges_to(PLACE, 1.0)
    item, kept = subsets(problem, np.zeros(1, dtype=bool))
    # one or two or three of five stations are left out; two rows are enough
    assert sorted((~kept).sum(1).tolist()) == [1] * 5 + [2] * 10 + [3] * 10
    assert (item == 0).all()
    assert len(np.unique(kept, axis=0)) == len(kept)
    # with an unknown time of emission two rows are too few
    arrivals = assemble(SQUARE, measured("toa", np.ones(5), a=np.arange(5), sigma=1.0)).flat()
    assert (~subsets(arrivals, np.zeros(1, dtype=bool))[1]).sum(1).max() == 2
    _, clean = subsets(problem, np.ones(1, dtype=bool))
    assert (~clean).sum(1).tolist() == [1] * 5


def test_unions_are_of_the_members_that_a_problem_has():
    own = np.array([[True, False, True]])
    item, rows, size = _unite(own, np.eye(3, dtype=bool), 2)
    assert item.tolist() == [0, 0, 0]
    assert sorted(map(tuple, rows.astype(int).tolist())) == [(0, 0, 1), (1, 0, 0), (1, 0, 1)]
    assert sorted(size.tolist()) == [1, 1, 2]


def test_some_start_is_near_the_target_with_two_gross_rows_of_eight():
    problem = ranges_to(PLACE, 1.0, ERROR, MORE)
    starts = robust_starts(problem, LOSSES["cauchy"])[0]
    assert np.nanmin(np.linalg.norm(starts - PLACE, axis=-1)) < 5.0


def test_a_loss_that_is_bent_step_by_step_leads_to_the_target():
    problem = ranges_to(PLACE, 1.0, ERROR, MORE)
    found = _graduate(problem, np.array([[PLACE + 60.0, [np.nan, np.nan]]]))
    assert np.linalg.norm(found[0, 0] - PLACE) < 5.0
    assert np.isnan(found[0, 1]).all()


def test_rows_at_the_brink_change_sides_one_by_one():
    problem = ranges_to(PLACE, 1.0, ERROR, MORE)
    pool = lsr(problem, begin(problem, PLACE[None]))
    starts = flip_rows(problem, LOSSES["truncated"], pool)
    assert starts.shape == (1, 8, 2)
    assert len(np.unique(starts[0].round(3), axis=0)) > 4
