"""Constraints of the table as half-spaces and balls."""

import numpy as np
import pytest
from solvers.posing.scenes import ranged

from optloc import InvalidProblem, constraints
from optloc.solvers.posing.convex_constraints import ConvexBall, HalfSpace, as_convex, conjunction_of

FLAT = ranged(1).flat()


def test_planes_have_unit_normals_and_both_sides():
    (one,) = as_convex(FLAT, constraints.half_plane([3.0, 4.0], 10.0)[0])
    assert isinstance(one, HalfSpace)
    assert one.normal == pytest.approx([0.6, 0.8])
    assert one.offset == pytest.approx(2.0)
    low, high = as_convex(FLAT, constraints.band([1.0, 0.0], -2.0, 5.0)[0])
    assert (low.normal[0], low.offset, high.normal[0], high.offset) == (-1.0, 2.0, 1.0, 5.0)
    (line,) = as_convex(FLAT, constraints.band([0.0, 1.0], 3.0, 3.0)[0])
    assert line.equal


def test_discs_and_convex_polygons():
    (ball,) = as_convex(FLAT, constraints.disc([1.0, 2.0], 3.0)[0])
    assert isinstance(ball, ConvexBall)
    assert (ball.centre.tolist(), ball.radius) == ([1.0, 2.0], 3.0)
    corner = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    for vertices in (corner, corner[::-1]):
        sides = as_convex(FLAT, constraints.polygon(vertices)[0])
        assert all(side.normal @ [1.0, 1.0] < side.offset for side in sides)
        assert any(side.normal @ [3.0, 3.0] > side.offset for side in sides)


def test_what_is_not_convex_is_refused():
    for one in (constraints.keep_out_disc([0.0, 0.0], 1.0), constraints.annulus([0.0, 0.0], 1.0, 2.0)):
        with pytest.raises(InvalidProblem, match="not convex"):
            as_convex(FLAT, one[0])
    with pytest.raises(InvalidProblem, match="union"):
        conjunction_of(FLAT, constraints.keep_out_polygon([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])[0])
