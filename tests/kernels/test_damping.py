"""The rule by which steps are taken, and what becomes of the damping."""

import numpy as np
import pytest

from optloc.kernels.damping import FIRST_GROWTH, judge, judge_lane
from optloc.kernels.jit import plain

FORMS = pytest.mark.parametrize("form", [judge, judge_lane], ids=["arrays", "lane"])


def judged(form, cost, after, gain, damping=1e-3, growth=FIRST_GROWTH, solvable=True, damped=True):
    """Return whether a step is taken, the last, or stuck, and the next damping and growth."""
    with plain():
        if form is judge_lane:
            return form(cost, after, gain, solvable, 0.0, damping, growth, 1e-7, damped)
        parts = (np.array([each]) for each in (cost, after, gain, solvable, 0.0, damping, growth))
        return tuple(part[0] for part in form(*parts, 1e-7, damped))


@FORMS
def test_a_step_that_does_what_was_predicted_is_taken_and_damps_a_tenth(form):
    assert judged(form, 10.0, 6.0, 4.0) == (True, False, False, pytest.approx(1e-4), FIRST_GROWTH)


@FORMS
def test_a_step_that_does_half_keeps_the_damping(form):
    assert judged(form, 10.0, 8.0, 4.0)[3] == pytest.approx(1e-3)


@FORMS
def test_each_refusal_doubles_the_growth_of_the_damping(form):
    better, small, stuck, damping, growth = judged(form, 10.0, 10.5, 4.0)
    assert (better, small, stuck) == (False, False, False)
    assert (damping, growth) == (pytest.approx(2e-3), 4.0)
    assert judged(form, 10.0, 10.5, 4.0, damping, growth)[3:] == (pytest.approx(8e-3), 8.0)


@FORMS
def test_a_cost_that_is_not_a_number_is_refused_and_one_that_rises_is_taken_without_damping(form):
    assert not judged(form, 10.0, np.nan, 4.0)[0]
    assert judged(form, 10.0, 11.0, 4.0, damped=False)[0]
    assert not judged(form, 10.0, 6.0, 4.0, solvable=False)[0]


@FORMS
def test_a_step_that_predicts_no_gain_is_the_last_and_one_that_no_damping_helps_is_stuck(form):
    assert judged(form, 10.0, 10.0, 1e-16)[:3] == (True, True, False)
    assert judged(form, 10.0, 10.5, 4.0, damping=1e12)[2]
