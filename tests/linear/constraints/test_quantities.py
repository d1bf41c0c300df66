"""Bounded quantities of problems: epochs that decide, second targets, and constraints of other targets."""

from dataclasses import replace

import numpy as np
import pytest
from linear.constraints.shared import flat, ranges_to

from optloc import Motion, constraints
from optloc.base.types import AnyOf
from optloc.linear.constraints.quantities import (
    bands_of,
    bounded,
    decisive_epochs,
    for_target,
    holds_along,
    is_exact,
    is_of_one_target,
    needs_velocity,
    quantity_at,
)

DISC = constraints.disc([0.0, 0.0], 5.0)
ONE = ranges_to([400.0, 300.0])


def run(*motions):
    return replace(ONE, times=np.array([0.0, 4.0, 9.0]), motions=motions)


def test_constraints_move_to_another_target():
    moved = for_target(AnyOf((DISC, DISC)), 3)
    assert moved.target == 3
    assert {band.target for band in bands_of(moved)} == {3}
    assert for_target(constraints.polygon(np.eye(3)[:, :2])[0], 2).target == 2


def test_what_a_constraint_is_about():
    apart = constraints.separation(0, 1, 5.0, 9.0)
    assert not any(is_of_one_target(band) for band in apart)
    assert is_of_one_target(AnyOf((DISC,)))
    assert needs_velocity(constraints.speed(5.0)[0])
    assert not needs_velocity(DISC[0])
    assert is_exact(constraints.annulus([0.0, 0.0], 5.0, 5.0)[0])
    assert not is_exact(AnyOf((DISC,)))


def test_a_speed_is_bounded_at_both_ends_of_an_accelerated_run():
    band = constraints.speed(9.0, lower=2.0, along=True)
    assert decisive_epochs(run(Motion(2)), band[0]) == [0, 2]
    assert decisive_epochs(run(Motion(1)), band[0]) == [None]
    assert decisive_epochs(run(Motion(2)), band[1]) == [None]
    assert not holds_along(run(Motion(1)), band[0])


def test_two_targets_are_bounded_at_both_ends_where_one_moves():
    band = constraints.separation(0, 1, 0.0, 9.0)[0]
    assert decisive_epochs(run(Motion(), Motion(1)), band) == [0, 2]
    assert decisive_epochs(run(Motion(), Motion()), band) == [None]


def test_the_distance_of_two_targets_depends_on_both():
    problem = flat(replace(ONE, motions=(Motion(), Motion())), *constraints.separation(0, 1, 0.0, 9.0))
    jet, columns = quantity_at(problem, problem.constraints[0], np.array([[1.0, 2.0, 4.0, 6.0]]))
    assert jet.value == pytest.approx(5.0)
    assert {columns[seed]: float(np.ravel(part)[0]) for seed, part in jet.partials.items()} == pytest.approx(
        {0: -0.6, 1: -0.8, 2: 0.6, 3: 0.8}
    )
    assert bounded(problem, problem.constraints[0], [(1.0, 2.0)], (), None, [(4.0, 6.0)]) == pytest.approx(5.0)
