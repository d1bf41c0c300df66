"""Notes cover neither each other nor marks nor insets, and the scale bar and the inset take free corners."""

import numpy as np
import pytest

from optloc.show.pictures.notes import free_corner, mark_positions, scale_bar, separate_notes
from optloc.show.pictures.style import figure_class, note


def panel_with(points):
    figure = figure_class()(figsize=(5.0, 5.0))
    panel = figure.subplots()
    panel.set(xlim=(0.0, 10.0), ylim=(0.0, 10.0))
    panel.scatter(*np.array(points).T)
    return panel


def test_notes_of_near_points_are_apart_and_inside():
    points = [(5.0, 5.0), (5.1, 5.0), (9.9, 9.9)]
    panel = panel_with(points)
    for i, point in enumerate(points):
        note(panel, f"station {i}", *point)
    separate_notes(panel.figure)
    boxes = [text.get_window_extent() for text in panel.texts]
    assert not boxes[0].overlaps(boxes[1])
    inside = panel.get_window_extent()
    assert all(box.x1 <= inside.x1 and box.y1 <= inside.y1 for box in boxes)


def test_a_note_leaves_the_place_of_an_inset():
    panel = panel_with([(6.0, 8.0)])
    near = panel.inset_axes((0.62, 0.6, 0.35, 0.35), xticks=[], yticks=[])
    note(panel, "far", 6.0, 8.0)
    separate_notes(panel.figure)
    assert not panel.texts[0].get_window_extent().overlaps(near.get_window_extent())


def test_a_corner_is_free_without_marks():
    panel = panel_with([(9.0, 9.0), (1.0, 9.0), (9.0, 1.0)])
    assert free_corner(panel) == ("lower left", True)
    assert free_corner(panel, "lower left") == ("upper right", False)
    scale_bar(panel, "m")
    (bar,) = panel.artists
    assert bar.txt_label.get_text() == "2 m"


@pytest.mark.parametrize("free", [(9.0, 9.0), (1.0, 9.0), (9.0, 1.0), (1.0, 1.0)])
def test_a_scale_bar_covers_no_mark_if_a_corner_is_free(free):
    marks = [point for point in [(9.0, 9.0), (1.0, 9.0), (9.0, 1.0), (1.0, 1.0)] if point != free]
    panel = panel_with(marks)
    scale_bar(panel, "m")
    panel.figure.draw_without_rendering()
    box = panel.artists[0].get_window_extent()
    assert not any(box.contains(*place) for place in mark_positions(panel))
    assert box.contains(*panel.transData.transform([free[0], 9.6 if free[1] > 5.0 else 0.5]))


def test_a_note_leaves_the_place_of_a_scale_bar():
    panel = panel_with([(6.3, 0.4)])
    scale_bar(panel, "m")
    note(panel, "a station with a long name", 6.3, 0.4)
    separate_notes(panel.figure)
    (bar,) = panel.artists
    assert bar.loc == bar.codes["lower right"]
    assert not panel.texts[0].get_window_extent().overlaps(bar.get_window_extent())
