"""Polygons in the plan: sides, distances and corners."""

import numpy as np
import pytest

from optloc.base.types import Polygon
from optloc.linear.constraints.polygons import (
    distances_from_edges,
    edge_of,
    is_convex,
    is_inside,
    is_reflex,
    orientation,
    polygon_violation,
    sense_of,
)

NOTCH = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 1.0], [0.0, 4.0]])
SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])


@pytest.mark.parametrize("corners", [NOTCH, NOTCH[::-1]])
def test_points_are_inside_or_outside_whatever_the_order_of_corners(corners):
    points = np.array([[1.0, 1.0], [2.0, 3.0], [3.9, 3.5], [5.0, 1.0]])
    assert is_inside(Polygon(corners), points).tolist() == [True, False, True, False]
    # the depth of the notch at (2, 3) is the distance from its two edges
    depth = 2.0 * 2.0 / np.hypot(2.0, 3.0)
    expected = np.array([0.0, depth, 0.0, 1.0]) / 5.0
    assert polygon_violation(Polygon(corners), points) == pytest.approx(expected)
    inside = np.array([1.0, 0.0, 1.0, 0.0])
    assert (polygon_violation(Polygon(corners, outside=True), points) > 0.0).tolist() == (inside > 0.0).tolist()


def test_edges_end_at_their_corners():
    assert distances_from_edges(Polygon(SQUARE), np.array([[5.0, -1.0]]))[0] == pytest.approx(
        [np.sqrt(2.0), np.sqrt(2.0), np.sqrt(26.0), np.sqrt(26.0)]
    )


def test_the_admitted_side_turns_the_normals_and_the_corners_over():
    inner, outer = Polygon(NOTCH), Polygon(NOTCH, outside=True)
    assert (sense_of(inner), sense_of(outer)) == (1.0, -1.0)
    # the end of edge 2 is the notch
    assert [is_reflex(inner, edge) for edge in range(5)] == [False, False, True, False, False]
    assert [is_reflex(outer, edge) for edge in range(5)] == [True, True, False, True, True]
    assert edge_of(inner, 0).coefficients == pytest.approx([0.0, -1.0])


def test_a_region_to_keep_out_of_is_not_convex():
    assert is_convex(Polygon(SQUARE))
    assert not is_convex(Polygon(NOTCH))
    assert not is_convex(Polygon(SQUARE, outside=True))


def test_the_order_of_corners_shows_far_from_the_origin():
    assert orientation(SQUARE + 1e9) == 1.0
    assert orientation(SQUARE[::-1] + 1e9) == -1.0
