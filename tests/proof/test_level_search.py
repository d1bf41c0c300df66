"""Levels and boxes that wait for them, and what a cost has to bring for a search."""

from types import SimpleNamespace

import numpy as np
import pytest

from optloc.proof.box import DEPTH, LEAST
from optloc.proof.level_search import _first_below, _last_above_zero, _take_back, bound_row, search_levels
from optloc.proof.local_search import CLEAR

pytestmark = pytest.mark.usefixtures("plainly")


def test_the_last_level_above_zero_is_searched_first():
    assert _last_above_zero(np.array([30.0, 9.0, 1.0])) == 2
    assert _last_above_zero(np.array([30.0, 9.0, -1e-6])) == 1
    assert _last_above_zero(np.array([-1.0])) == -1


def test_levels_that_infinity_undercuts_are_given_up():
    levels = np.array([30.0, 9.0, 1.0])
    assert _first_below(levels, 0, 50.0) == 0
    assert _first_below(levels, 0, 10.0) == 1
    assert _first_below(levels, 1, 0.5) == 3


def test_boxes_below_a_level_are_taken_back():
    stack, aside = np.zeros((4, DEPTH)), np.zeros((4, DEPTH))
    aside[:3, LEAST] = [1.0, 4.0, 2.0]  # least residuals: their squares are costs
    size, waiting = _take_back(stack, aside, 3, 9.0)
    assert (size, waiting) == (2, 1)
    assert stack[:2, LEAST].tolist() == [1.0, 2.0]
    assert aside[0, LEAST] == 4.0


def test_no_cost_is_below_zero():
    space = SimpleNamespace(atlas=SimpleNamespace(dimension=2))
    work, stack, rivals = SimpleNamespace(box=None), np.zeros((1, DEPTH)), np.zeros((0, 2))
    done = search_levels(work, space, stack, 1, np.zeros(1), 0.0, True, 9, rivals, np.zeros(2))
    assert done == (CLEAR, 0, 0.0, 0, 0)


def test_a_cost_brings_its_own_bounds():
    with pytest.raises(NotImplementedError):
        bound_row(None, None, np.zeros((1, DEPTH)), 0, 1.0)
