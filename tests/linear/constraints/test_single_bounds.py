"""Levels of bands, polygons and unions: bounds, gradients, names and projections."""

import numpy as np
import pytest
from linear.constraints.shared import flat, ranges_to

from optloc import constraints
from optloc.base.types import AnyOf
from optloc.linear.constraints import Level, band_at, bound_of, face_names, levels, on_face, outwards, restore

DISC, ROAD = constraints.disc([300.0, 400.0], 50.0), constraints.polyline([[0, 0], [300, 0], [300, 500]], 20.0)
UNION = AnyOf((DISC, constraints.half_plane([1.0, 0.0], 100.0)), "yard")
PROBLEM = flat(ranges_to([400.0, 300.0]), *DISC, *ROAD, UNION)
ON_DISC, ON_ROAD, ON_UNION = Level(0, "upper"), Level(1, (1, 0, "upper")), Level(2, (1, 0, "upper"))


def test_a_level_of_a_union_names_its_band():
    assert face_names(PROBLEM, (ON_DISC, ON_ROAD, ON_UNION)) == (
        "disc upper",
        "polyline 2 upper",
        "yard half-plane upper",
    )
    assert band_at(PROBLEM, ON_UNION).kind == "plane"
    assert [float(bound_of(PROBLEM, one)) for one in (ON_DISC, ON_ROAD, ON_UNION)] == [50.0, 20.0, 100.0]
    assert outwards(PROBLEM, ON_ROAD) == 1.0


def test_gradients_are_differences():
    x, face = np.array([[420.0, 310.0], [250.0, 530.0]]), (ON_DISC, ON_ROAD, ON_UNION)
    many = PROBLEM.take(np.zeros(2, dtype=int))
    gradients = levels(many, face, x)[1]
    for j, step in enumerate(1e-4 * np.eye(2)):
        slope = (levels(many, face, x + step)[0] - levels(many, face, x - step)[0]) / 2e-4
        assert gradients[:, :, j] == pytest.approx(slope, abs=1e-6)


@pytest.mark.parametrize("face", [(ON_DISC,), (ON_ROAD,), (ON_DISC, ON_ROAD)])
def test_projected_points_are_on_the_face(face):
    found = restore(PROBLEM, face, np.array([[340.0, 370.0]]))
    assert levels(PROBLEM, face, found)[0] == pytest.approx(0.0, abs=1e-8)


def test_a_face_is_a_problem_of_equalities():
    bands = on_face(PROBLEM, (ON_DISC, ON_ROAD)).constraints
    assert [(band.kind, float(band.lower), float(band.upper)) for band in bands] == [
        ("distance", 50.0, 50.0),
        ("segment", 20.0, 20.0),
    ]
