"""Notes cover neither each other nor marks nor insets, and the scale bar and the inset take free corners."""

import numpy as np

from optloc.show.pictures.notes import free_corner, scale_bar, separate_notes
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
    assert free_corner(panel, ("lower",), "lower left") == ("lower right", False)
    scale_bar(panel, "m")
    (bar,) = panel.artists
    assert bar.txt_label.get_text() == "2 m"
