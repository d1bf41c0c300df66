"""Sets of groups that are left out: the wrong row is found, whatever masks it, and prices keep lists short."""

from types import SimpleNamespace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc.model_checks.groups import ROW_PRICE, groups_of
from optloc.solvers.pool import begin
from optloc.solvers.stages import fix_by
from optloc.solvers.suspect_rows.subsets import (
    Outcome,
    RemainingFix,
    SameRows,
    enumerable,
    explain,
    explain_from_beginnings,
    fix_remaining,
    fix_without,
    grow_explanation,
    leave_out_of,
    passes_noise_test,
    remaining_fix_of,
    within_gap,
)

MORE = np.concatenate([SQUARE, [[-400.0, 500.0], [1300.0, 300.0], [600.0, 1500.0]]])
ERROR = np.array([0.5, -1.0, 60.0, -0.5, 1.0, 0.3, -0.8, 0.2])


@pytest.fixture
def problem():
    return ranges_to(PLACE, 1.0, ERROR, MORE)


@pytest.fixture
def rows(problem):
    return groups_of(problem, np.ones(8, dtype=bool), ("row",))


def test_the_wrong_row_explains_the_data(problem, rows):
    whole = fix_remaining(problem)
    assert not passes_noise_test(whole)[0]
    ((outcome,),) = explain([SameRows(problem, np.array([0]), rows, whole)])
    assert [rest.left for rest in outcome.rests] == [(2,)]
    assert outcome.rests[0].score == pytest.approx(float(outcome.rests[0].fix.cost) + ROW_PRICE)
    assert outcome.p_value[(2,)] > 0.01 > outcome.p_value[(0,)]
    grown = grow_explanation(problem, rows, whole[0], remaining_fix_of(rows, (), whole[0]))
    assert [rest.left for rest in grown.rests] == [(2,)]


def test_data_that_agree_need_nobody_left_out():
    problem = ranges_to(PLACE, 1.0, np.where(np.arange(8) == 2, 0.1, ERROR), MORE)
    groups = groups_of(problem, np.ones(8, dtype=bool), ("row",))
    ((outcome,),) = explain([SameRows(problem, np.array([0]), groups, fix_remaining(problem))])
    assert outcome.rests[0].left == ()


def test_what_is_left_out_does_not_pull(problem, rows):
    part = leave_out_of(problem, rows, [2])
    assert part.weight[0].tolist() == [1, 1, 0, 1, 1, 1, 1, 1]
    fix = fix_without(problem, rows, [2], PLACE)
    other = fix_by(part, lambda one: begin(one, PLACE[None] + 3.0))[0]
    np.testing.assert_allclose(fix.x, other.x, atol=1e-4)
    assert int(fix.dof) == 5


def scored(left, cost, groups):
    return remaining_fix_of(groups, left, SimpleNamespace(cost=cost))


def test_a_larger_set_is_listed_only_if_it_gains_what_a_row_costs(rows):
    one, two = scored((2,), 20.0, rows), scored((2, 4), 12.0, rows)
    assert within_gap([two, one], rows) == (one, two)
    # a fall of less than the price of a row less the gap may be chance
    assert within_gap([scored((2, 4), 14.0, rows), one], rows) == (one,)
    assert within_gap([one, scored((3,), 40.0, rows)], rows) == (one,)
    assert within_gap([], rows) == ()


def test_outcomes_of_several_beginnings_are_one_list(rows):
    one, two = scored((2,), 20.0, rows), scored((3,), 22.0, rows)
    both = explain_from_beginnings([Outcome((one,), {}), Outcome((two, one), {})], rows)
    assert both.rests == (one, two)
    assert explain_from_beginnings([Outcome((), {}, "nothing")], rows).note == "nothing"
    assert isinstance(one, RemainingFix)


def test_too_many_sets_are_not_tried(rows):
    assert enumerable(rows, 8, 3)
    assert not enumerable(rows * 20, 160, 3)
