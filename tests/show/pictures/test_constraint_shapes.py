"""Shapes of constraints in a plan: outlines, excluded sides, cuts at the height of the fix, roads and contours."""

import numpy as np
import pytest

from optloc import assemble, constraints, measured, solve, station_array
from optloc.models.surfaces import SURFACES, Surface
from optloc.show.pictures import plot_fixes
from optloc.show.pictures.constraint_shapes import drawn_regions

PLACES = np.array([[0.0, 0.0, 5.0], [900.0, 0.0, 40.0], [0.0, 800.0, 10.0], [900.0, 800.0, 0.0]])
REACH = PLACES[:, :2]


def problem(limits, d=2):
    ranges = np.linalg.norm(PLACES[:, :d] - np.array([300.0, 400.0, 60.0])[:d], axis=1)
    return assemble(
        station_array(PLACES[:, :d]), measured("range", ranges, a=np.arange(4), sigma=5.0), constraints=limits
    )


def shapes(*limits, d=2, place=(300.0, 400.0, 60.0)):
    return drawn_regions(problem(list(limits), d), REACH, np.array(place[:d]))


def left_of(line):
    """Return a point a little to the left of the middle of a line (n, 2)."""
    i = len(line) // 2
    along = line[i] - line[i - 1]
    return (line[i] + line[i - 1]) / 2.0 + 1e-3 * np.array([-along[1], along[0]])


def test_a_full_box_is_a_ring_and_an_open_one_has_limits():
    (ring,) = shapes(constraints.box((0.0, 10.0), (500.0, 600.0)))
    assert (ring.look, ring.lines[0].shape) == ("inside", (5, 2))
    (limit,) = shapes(constraints.box((0.0, -np.inf), (np.inf, np.inf)))
    assert limit.look == "limit"
    np.testing.assert_allclose(limit.lines[0][:, 0], 0.0, atol=1e-9)
    assert left_of(limit.lines[0])[0] < 0.0


@pytest.mark.parametrize("normal", [(1.0, 0.0), (-3.0, 4.0), (0.0, -2.0)])
def test_the_excluded_side_is_on_the_left(normal):
    (limit,) = shapes(constraints.band(normal, -100.0, 100.0))
    lower, upper = (left_of(line) @ normal for line in limit.lines)
    assert lower < -100.0
    assert upper > 100.0
    assert all(np.abs(line).max() > 1e4 for line in limit.lines)


def test_circles_are_cut_at_the_height_of_the_fix():
    inside, outside = shapes(constraints.annulus((100.0, 200.0), 50.0, 400.0))
    assert (inside.look, outside.look) == ("inside", "outside")
    np.testing.assert_allclose(np.hypot(*(outside.lines[0] - [100.0, 200.0]).T), 50.0)
    (ball,) = shapes(constraints.keep_out_ball((100.0, 200.0, 20.0), 50.0), d=3)
    np.testing.assert_allclose(np.hypot(*(ball.lines[0] - [100.0, 200.0]).T), 30.0)
    assert shapes(constraints.keep_out_ball((100.0, 200.0, 500.0), 50.0), d=3) == ()
    (whole,) = shapes(constraints.ball((100.0, 200.0, 500.0), 50.0), d=3)
    np.testing.assert_allclose(np.hypot(*(whole.lines[0] - [100.0, 200.0]).T), 50.0)


def test_planes_are_cut_at_the_height_of_the_fix():
    (limit,) = shapes(constraints.half_plane((1.0, 0.0, 1.0), 500.0), d=3)
    np.testing.assert_allclose(limit.lines[0][:, 0], 440.0)
    assert shapes(constraints.half_plane((0.0, 0.0, 1.0), 500.0), d=3) == ()


def test_polygons_keep_in_or_out():
    corners = [[0.0, 0.0], [500.0, 0.0], [0.0, 500.0]]
    (inside,), (outside,) = shapes(constraints.polygon(corners)), shapes(constraints.keep_out_polygon(corners))
    assert (inside.look, outside.look) == ("inside", "outside")
    np.testing.assert_array_equal(inside.lines[0], outside.lines[0])
    moved = inside.moved(np.array([1.0, 2.0]))
    np.testing.assert_array_equal(moved.lines[0] - inside.lines[0], np.full((4, 2), [1.0, 2.0]))


def test_a_road_has_its_width():
    (road,) = shapes(constraints.polyline([[0.0, 0.0], [100.0, 0.0], [100.0, 300.0]], 10.0))
    assert (road.look, len(road.lines)) == ("road", 2)
    first, second = road.lines
    np.testing.assert_allclose([first.min(0), first.max(0)], [[-10.0, -10.0], [110.0, 10.0]], atol=0.1)
    np.testing.assert_allclose([second.min(0), second.max(0)], [[90.0, -10.0], [110.0, 310.0]], atol=0.1)
    # counter-clockwise rings, so that overlapping segments are filled once
    for x, y in (first.T, second.T):
        assert (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0.0


def test_a_terrain_has_contours_and_a_section():
    x = np.linspace(0.0, 900.0, 10)
    heights = 0.1 * x[:, None] + 0.0 * x
    contours, section = shapes(constraints.terrain(x, x, heights, exactly=0.0), d=3)
    assert "every 10 m" in contours.label
    for line in contours.lines:
        np.testing.assert_allclose(line[:, 0], 100.0 * np.round(line[0, 0] / 100.0), atol=1e-6)
    assert section.view == (0, 2)
    np.testing.assert_allclose(section.lines[0][:, 1], 0.1 * section.lines[0][:, 0], atol=1e-9)
    assert section.moved(np.ones(2)) is section


def test_a_fence_has_its_standard_deviation():
    line, beside = shapes(constraints.fence((1.0, 0.0), 100.0, 20.0))
    assert left_of(line.lines[0])[0] > 100.0
    assert sorted(float(each[0, 0]) for each in beside.lines) == pytest.approx([80.0, 120.0])


def test_other_quantities_are_traced(monkeypatch):
    surface = Surface(lambda t, c: t.position[0] * t.position[0] + t.position[1] * t.position[1], "square", "m", 0)
    monkeypatch.setitem(SURFACES._own, "square", surface)
    (limit,) = shapes(constraints.quantity("square", 200.0**2, 400.0**2))
    for line, radius in zip(limit.lines, (200.0, 400.0), strict=True):
        np.testing.assert_allclose(np.hypot(*line.T), radius, rtol=2e-3)
    inner, outer = (float(np.hypot(*left_of(line))) for line in limit.lines)
    assert inner < 200.0
    assert outer > 400.0 * (1.0 - 2e-3)
    (curve,) = shapes(constraints.quantity("square", 200.0**2, 200.0**2))
    assert curve.look == "inside"


def test_heights_and_speeds_have_no_shape():
    assert shapes(d=3) == ()


def test_every_look_is_drawn():
    x = np.linspace(0.0, 900.0, 10)
    limits = [
        constraints.disc((300.0, 400.0), 200.0),
        constraints.keep_out_disc((500.0, 400.0), 90.0),
        constraints.half_plane((1.0, 0.0, 0.0), 700.0),
        constraints.polyline([[0.0, 380.0], [300.0, 390.0], [600.0, 500.0]], 40.0),
        constraints.terrain(x, x, 0.1 * x[:, None] + 0.0 * x, lower=0.0),
    ]
    found = problem(limits, 3)
    figure = plot_fixes(found, solve(problem([], 3), "gtrs+lsr"))
    texts = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"region", "keep-out area", "road with its tolerance", "limit, ticks on the excluded side"} <= texts
    # a limit without ends does not change the extent of the plan
    assert np.ptp(figure.axes[0].get_xlim()) < 3000.0
