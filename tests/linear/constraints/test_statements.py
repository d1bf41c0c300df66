"""Statements on motions and on pairs of targets."""

import numpy as np
import pytest

from optloc import constraints


def sides(limits):
    return [(one.kind, float(one.lower), float(one.upper), one.along) for one in limits]


def test_a_speed_has_a_least_value_only_where_it_is_asked_for():
    assert sides(constraints.speed("36 km/h")) == [("speed", -np.inf, 10.0, False)]
    assert sides(constraints.speed(10.0, lower=2.0)) == [("speed", 2.0, 10.0, False)]
    assert sides(constraints.speed(10.0, along=True)) == [("speed", -np.inf, 10.0, True)]
    assert sides(constraints.speed(10.0, lower=2.0, along=True)) == [
        ("speed", -np.inf, 10.0, True),
        ("least speed", 2.0, np.inf, False),
    ]


def test_turns_are_limited_to_both_sides_unless_one_is_stated():
    assert sides(constraints.turn_rate("3 deg/s"))[0][1:3] == pytest.approx((-np.radians(3.0), np.radians(3.0)))
    assert sides(constraints.turn_rate(0.1, lower=0.0))[0][1:3] == (0.0, 0.1)
    assert sides(constraints.acceleration(2.0)) == [("acceleration", -np.inf, 2.0, False)]


def test_two_targets_are_bounded_from_both_sides():
    assert sides(constraints.separation(0, 1, 5.0, 9.0)) == [
        ("separation", -np.inf, 9.0, True),
        ("least separation", 5.0, np.inf, False),
    ]
    assert sides(constraints.separation(0, 1, 5.0, 5.0)) == [("separation", 5.0, 5.0, True)]
    assert sides(constraints.separation(0, 1, 5.0, 9.0, along=False)) == [("separation", 5.0, 9.0, False)]
    assert [one.other for one in constraints.separation(2, 1, 5.0, 9.0)] == [1, 1]


def test_statements_take_a_name():
    assert constraints.height(0.0, 9.0, name="floor")[0].name == "floor"
    assert [one.name for one in constraints.box([0, 0], [1, 1], name="hall")] == ["hall x", "hall y"]
    assert constraints.visible(np.eye(3), name="sight")[1].name == "sight 1"
