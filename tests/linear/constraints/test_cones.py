"""Conditions for a minimum along a face to be one of all admitted positions."""

import numpy as np
import pytest
from linear.constraints.shared import flat, ranges_to

from optloc import constraints
from optloc.base.types import AnyOf
from optloc.linear.constraints import Level, is_held

LEFT, LOWER = constraints.half_plane([1.0, 0.0], 0.0), constraints.half_plane([0.0, 1.0], 0.0)
NEAR = constraints.disc([0.0, 0.0], 9.0)
NOTCH = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 1.0], [0.0, 4.0]])
PROBLEM = ranges_to([400.0, 300.0])


def held(limits, face, x, descent, information=None):
    scale = None if information is None else np.array([information])
    return bool(is_held(flat(PROBLEM, *limits), face, np.array([x]), np.array([descent]), scale)[0])


@pytest.mark.parametrize(("descent", "minimal"), [([1.0, 0.0], True), ([-1.0, 0.0], False)])
def test_a_bound_holds_what_it_pushes_back(descent, minimal):
    assert held(LEFT, (Level(0, "upper"),), [0.0, 5.0], descent) is minimal
    assert held(constraints.half_plane([-1.0, 0.0], 0.0), (Level(0, "upper"),), [0.0, 5.0], descent) is not minimal


def test_a_point_inside_another_member_is_no_minimum_unless_the_cost_is_level():
    union, face = (AnyOf((LEFT, NEAR)),), (Level(0, (0, 0, "upper")),)
    assert held(union, face, [0.0, 20.0], [1.0, 0.0])
    assert not held(union, face, [0.0, 5.0], [1.0, 0.0])
    assert held(union, face, [0.0, 5.0], [1e-9, 0.0], np.eye(2))


def test_a_point_on_the_bounds_of_two_members_must_be_held_by_both():
    face = (Level(0, (0, 0, "upper")),)
    same = (*constraints.half_plane([1.0, 0.1], 0.0), *LOWER)
    assert not held((AnyOf((LEFT, LOWER)),), face, [0.0, 0.0], [1.0, 0.0])
    assert held((AnyOf((LEFT, LEFT)),), face, [0.0, 0.0], [1.0, 0.0])
    # the second member has a corner whose cone contains the way down, although it points elsewhere
    corner = (*constraints.half_plane([1.0, 1.0], 0.0), *constraints.half_plane([1.0, -1.0], 0.0))
    assert held((AnyOf((LEFT, corner)),), face, [0.0, 0.0], [1.0, 0.0])
    assert not held((AnyOf((LEFT, same)),), face, [0.0, 0.0], [1.0, 0.0])


def test_other_active_constraints_help_to_hold():
    limits, face = (*LOWER, AnyOf((LEFT, NEAR))), (Level(0, "upper"), Level(1, (0, 0, "upper")))
    assert held(limits, face, [0.0, 0.0], [0.0, 1.0])
    assert not held(limits, face, [0.0, 0.0], [1.0, 1.0])


def test_an_edge_bounds_nothing_beyond_its_ends():
    keep_in, keep_out = constraints.polygon(NOTCH), constraints.keep_out_polygon(NOTCH)
    edge = (Level(0, 0),)
    assert held(keep_in, edge, [2.0, 0.0], [0.0, -1.0])
    assert held(keep_out, edge, [2.0, 0.0], [0.0, 1.0])
    assert not held(keep_out, edge, [9.0, 0.0], [0.0, 1.0])


def test_a_corner_with_an_angle_above_a_half_turn_holds_nothing():
    notch, tip = (Level(0, 2), Level(0, 3)), (Level(0, 0), Level(0, 1))
    assert not held(constraints.polygon(NOTCH), notch, [2.0, 1.0], [0.0, 1.0])
    assert held(constraints.keep_out_polygon(NOTCH), notch, [2.0, 1.0], [0.0, -1.0])
    assert held(constraints.polygon(NOTCH), tip, [4.0, 0.0], [1.0, -1.0])
    assert not held(constraints.keep_out_polygon(NOTCH), tip, [4.0, 0.0], [-1.0, 1.0])
