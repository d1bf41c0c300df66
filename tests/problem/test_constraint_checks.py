"""Constraints that cannot be meant are refused by name."""

from dataclasses import replace

import numpy as np
import pytest

from optloc import InvalidProblem, Motion, assemble, constraints, measured
from optloc.base.types import AnyOf, Band, Polygon
from optloc.linear.constraints import box
from optloc.problem.constraint_checks import bands_by_quantity, check_constraints, check_polygon

PLANE = np.array([[0.0, 0.0], [9.0, 1.0], [10.0, 9.0], [1.0, 10.0]])
SPACE = np.column_stack([PLANE, [0.0, 2.0, 1.0, 3.0]])
FLAT = assemble(PLANE, measured("range", np.full(4, 5.0), a=np.arange(4), sigma=1.0))
HIGH = assemble(SPACE, measured("range", np.full(4, 5.0), a=np.arange(4), sigma=1.0))
FAST = replace(FLAT, motions=(Motion(1),))
CURVED = replace(FLAT, motions=(Motion(2),))
TWO = replace(FLAT, motions=(Motion(), Motion()))
GROUND = constraints.terrain([0.0, 9.0], [0.0, 9.0], np.zeros((2, 2)), exactly=0.0)
(DISC,) = constraints.disc([0.0, 0.0], 5.0)
NEAR = replace(DISC, target=1)

BAD = {
    "a missing target": (FLAT, (NEAR,), "there is no target 1"),
    "an empty union": (FLAT, (AnyOf(()),), "the union has no member"),
    "a union of two targets": (TWO, (AnyOf(((DISC,), (NEAR,))),), "about target 0, and a band about target 1"),
    "an equality in a union": (FLAT, (AnyOf((constraints.annulus([0, 0], 5.0, 5.0),)),), "is an equality"),
    "a band along a course in a union": (FAST, (AnyOf(((replace(DISC, along=True),),)),), "applies along a course"),
    "a wrong number of coefficients": (FLAT, constraints.quantity("distance", 0, 1, [1.0]), "give 2 numbers"),
    "a ground in the plane": (FLAT, GROUND, "needs three coordinates"),
    "no table": (HIGH, constraints.quantity("terrain", 0.0, 1.0), "needs a table"),
    "a table too many": (HIGH, (replace(GROUND[0], kind="plane", coefficients=np.eye(3)[0]),), "takes no table"),
    "no second target": (TWO, constraints.quantity("separation", 0.0, 1.0), "needs a second target"),
    "a second target too many": (TWO, (replace(DISC, other=1),), "takes no second target"),
    "a second target that is missing": (TWO, constraints.separation(0, 2, 1.0, 2.0), "second target 2 does not fit"),
    "a course without acceleration": (FAST, constraints.acceleration(1.0), "needs a target with an acceleration"),
    "a turn without acceleration": (FAST, constraints.turn_rate(0.1), "needs a target with an acceleration"),
    "a distance along curved courses": (
        replace(TWO, motions=(Motion(2), Motion())),
        constraints.separation(0, 1, 5.0, 9.0),
        "has no closed form",
    ),
    "a known speed along a curved course": (
        CURVED,
        (replace(constraints.speed(3.0, lower=3.0)[0], along=True),),
        "speed is not constant along a course",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_meant_is_named(case):
    problem, limits, words = BAD[case]
    with pytest.raises(InvalidProblem, match=words):
        check_constraints(replace(problem, constraints=limits))


def test_what_fits_passes():
    check_constraints(
        replace(CURVED, constraints=(*constraints.turn_rate(0.1), *constraints.speed(9.0, lower=1.0, along=True)))
    )
    check_constraints(replace(HIGH, constraints=(*GROUND, *constraints.disc([0, 0], 5.0))))
    check_constraints(replace(TWO, constraints=constraints.separation(0, 1, 5.0, 9.0)))


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        ([[0, 0], [1, 0]], "only 2 corners"),
        ([[0, 0], [1, 0], [1, 1], [0, 0]], "corner 4 repeats corner 1"),
        ([[0, 0], [1, 1], [2, 2]], "no area"),
        ([[0, 0], [2, 2], [2, 0], [0, 1.5]], "edges 1-2 and 3-4 meet"),
        ([[0, 0], [1, np.nan], [1, 1]], "corner 2 is not finite"),
    ],
)
def test_corners_that_bound_no_simple_polygon_are_refused(corners, words):
    with pytest.raises(InvalidProblem, match=words):
        check_polygon(np.array(corners, dtype=float), "polygon")


def test_bands_on_one_quantity_are_together():
    first, second = box([0.0, 1.0], [2.0, 3.0]), box([-1.0, -np.inf], [9.0, np.inf])
    other = Band("plane", np.array(0.0), np.array(1.0), np.array([1.0, 0.0]), "x", target=1)
    region = Polygon(np.array([[0, 0], [1, 0], [0, 1.0]]))
    groups = bands_by_quantity([*first, region, *second, other])
    assert [[band.lower.item() for band in group] for group in groups] == [[0.0, -1.0], [1.0, -np.inf], [0.0]]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("disc", "str is no constraint"),
        ([None], "NoneType is no constraint"),
        ({"kind": "disc"}, "dict is no constraint"),
        (replace(DISC, target="A"), "no whole number"),
        (replace(DISC, name=3), "the name is no text"),
        ([constraints.band([1, 0], 5, 5), constraints.band([-1, 0], -5, -5)], "determine it already"),
        ([constraints.band([a, b], c, c) for a, b, c in [(1, 0, 5), (0, 1, 5), (1, 1, 10)]], "determine it already"),
        ([constraints.annulus([x, 0], 5, 5) for x in (1, 2, 3)], "more than the 2 coordinates"),
    ],
)
def test_arguments_that_are_no_constraints_and_equalities_that_depend_are_refused(given, words):
    rows = measured("range", np.full(4, 5.0), a=np.arange(4), sigma=1.0)
    with pytest.raises(InvalidProblem, match=words):
        assemble(PLANE, rows, constraints=given)


def test_constraints_can_be_nested():
    nested = assemble(
        PLANE, measured("range", np.full(4, 5.0), a=np.arange(4), sigma=1.0), constraints=[[(DISC,)], [[DISC]]]
    )
    assert nested.constraints == (DISC, DISC)


def test_a_box_has_as_many_lower_as_upper_limits():
    with pytest.raises(InvalidProblem, match="2 lower and 1 upper"):
        box((0.0, 0.0), (1.0,))
