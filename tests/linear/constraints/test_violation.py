"""By how much points break constraints."""

import numpy as np
import pytest
from linear.constraints.shared import flat, ranges_to

from optloc import constraints
from optloc.base.types import AnyOf
from optloc.linear.constraints.violation import (
    member_violation,
    plan_positions,
    violation,
    violation_names,
    violation_of,
)

DISC, PLANE = constraints.disc([0.0, 0.0], 9.0), constraints.half_plane([1.0, 0.0], -19.0)
UNION = AnyOf((DISC, PLANE), "either")
PROBLEM = flat(ranges_to([400.0, 300.0]), UNION).take(np.zeros(3, dtype=int))
POINTS = np.array([[3.0, 4.0], [-25.0, 7.0], [0.0, 29.0]])


def test_a_union_is_broken_as_little_as_its_nearest_member():
    assert violation(PROBLEM, POINTS) == pytest.approx([0.0, 0.0, 19.0 / 20.0])
    assert violation_of(PROBLEM, UNION, POINTS) == pytest.approx([-0.4, -0.3, 19.0 / 20.0])
    assert member_violation(PROBLEM, DISC, POINTS)[0] == pytest.approx(-0.4)


def test_names_and_plan_positions():
    assert violation_names(PROBLEM) == "either"
    assert plan_positions(PROBLEM, 0, POINTS) is not None
    np.testing.assert_array_equal(plan_positions(PROBLEM, 0, POINTS), POINTS)
