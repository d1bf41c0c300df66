"""Faces: which bounds can be met together, and which constraints are a conjunction."""

from collections import Counter

import numpy as np
from linear.constraints.shared import flat, ranges_to

from optloc import constraints
from optloc.base.types import AnyOf
from optloc.linear.constraints import bounds, conjunction, face_of, faces, is_conjunctive

SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
PROBLEM = ranges_to([400.0, 300.0])


def sizes(*limits):
    return Counter(len(face) for face in faces(flat(PROBLEM, *limits)))


def test_levels_of_two_members_are_not_combined():
    corner = (*constraints.half_plane([1.0, 0.0], 5.0), *constraints.half_plane([0.0, 1.0], 5.0))
    assert sizes(AnyOf((corner, constraints.disc([0.0, 0.0], 9.0)))) == {0: 1, 1: 3, 2: 1}
    assert sizes(*constraints.polyline([[0, 0], [5, 0], [5, 5], [9, 9]], 1.0)) == {0: 1, 1: 3}


def test_bounds_of_two_constraints_are_combined_up_to_the_dimension():
    first, second, third = (constraints.keep_out_disc([k, 0.0], 5.0)[0] for k in (0.0, 4.0, 8.0))
    assert sizes(first, second, third) == {0: 1, 1: 3, 2: 3}


def test_every_side_of_a_keep_out_polygon_is_a_face():
    assert sizes(*constraints.keep_out_polygon(SQUARE)) == {0: 1, 1: 4, 2: 4}
    assert len(bounds(flat(PROBLEM, *constraints.keep_out_polygon(SQUARE)))) == 4


def test_unions_and_keep_out_polygons_are_no_conjunction():
    disc = constraints.disc([0.0, 0.0], 5.0)
    limits = (*disc, AnyOf((disc,)), AnyOf((disc, disc)), *constraints.keep_out_polygon(SQUARE))
    assert [is_conjunctive(one) for one in limits] == [True, True, False, False]
    assert len(conjunction(flat(PROBLEM, *limits))) == 2
    assert len(conjunction(flat(PROBLEM, *constraints.polygon(SQUARE)))) == 4


def test_a_point_is_on_the_face_with_most_levels():
    problem = flat(PROBLEM, *constraints.disc([0.0, 0.0], 5.0), *constraints.half_plane([1.0, 0.0], 3.0))
    points = np.array([[3.0, 4.0], [3.0, 0.0], [0.0, 5.0], [0.0, 0.0]])
    found = face_of(problem.take(np.zeros(4, dtype=int)), points)
    assert [len(faces(problem)[number]) for number in found] == [2, 1, 1, 0]
