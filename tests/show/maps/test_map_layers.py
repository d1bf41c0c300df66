"""Layers of maps: trails with gaps, marks that differ without colours, labels of lines, counts and legends."""

import numpy as np

from optloc.show.maps.canvas import Label, MapRow, StationSymbol
from optloc.show.maps.map_layers import (
    counted,
    curves,
    ellipses,
    legend_of,
    line_labels,
    live_legend,
    mark_names,
    marks_of,
    nearest_turn,
    placed_rows,
    station_symbols,
    trails,
)
from optloc.show.maps.map_marks import Spots
from optloc.show.maps.projection import Plane

PLANE = Plane(0.0, 100.0, 0.0, 80.0, flat=True)
LOOKS = ("ok", "alone", "rival", "care", "bad")


def marked(places, looks=None, groups=()):
    places = np.array(places, dtype=float)
    looks = looks or ["ok"] * len(places)
    rows = tuple(MapRow(f"m{i}", f"2026-11-30 00:00:0{i} UTC", look, look) for i, look in enumerate(looks))
    ring = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    count = len(places)
    return Spots(places, (ring,) * count, np.ones(count, bool), tuple(looks), rows=rows, groups=tuple(groups))


def test_a_missing_position_interrupts_a_trail():
    places = [[10, 10], [20, 10], [np.nan, np.nan], [30, 10], [40, 10], [50, 50], [60, 60]]
    found = trails(marked(places, groups="aaaaabb"), PLANE)
    assert [curve.d.count("M") for curve in found] == [2, 1]
    assert [curve.hover for curve in found] == ["trail of a", "trail of b"]
    assert trails(marked(places), PLANE) == []


def test_marks_differ_without_colours():
    found = marks_of(marked([[10 * i, 10] for i in range(5)], LOOKS), PLANE, first=7)
    assert [curve.row for curve in found if curve.row >= 0] == [7, 8, 9, 10, 11]
    centres = [curve.kind for curve in found if "centre" in curve.kind]
    assert centres == ["dot centre alone", "dot centre rival", "dot centre care"]


def test_names_of_one_day_have_no_date():
    found = mark_names(marked([[10, 10], [20, 20]]), PLANE)
    assert [label.text for label in found] == ["m0, 00:00:00", "m1, 00:00:01"]
    many = marked([[5 * i, 10] for i in range(13)])
    assert mark_names(many, PLANE)[0].text == "m0"
    assert mark_names(marked([]), PLANE) == []


def test_rows_have_their_place_on_the_drawing():
    (row,) = placed_rows(marked([[50.0, 40.0]]), PLANE)
    assert (row.x, row.y) == (0.0, 0.0)


def test_a_line_has_its_name_where_it_is_visible():
    lines = [("inside", np.array([[-500.0, 40.0], [50.0, 40.0], [500.0, 40.0]])), ("outside", np.full((3, 2), 900.0))]
    (label,) = line_labels(lines, PLANE)
    assert (label.kind, label.text) == ("along", "inside")
    assert [curve.hover for curve in curves(lines, PLANE)] == ["inside", "outside"]
    assert line_labels(lines * 6, PLANE) == []


def test_a_line_is_shifted_to_the_map():
    earth = Plane(175.0, 185.0, 0.0, 8.0)
    ((_, line),) = nearest_turn([("a", np.array([[-179.0, 1.0], [-178.0, 2.0]]))], earth)
    assert line[:, 0].tolist() == [181.0, 182.0]
    assert nearest_turn([("a", line)], PLANE)[0][1] is line


def test_stations_are_triangles_with_names():
    symbols, names = station_symbols(["A", "sky"], np.array([[1.0, 2.0], [np.nan, np.nan]]))
    assert symbols == [StationSymbol(1.0, 2.0, "station A")]
    assert names == [Label("name", 1.0, 2.0, "A")]


def test_valid_and_local_ellipses_are_two_curves():
    marks = marked([[10, 10], [20, 20]])
    (valid,) = ellipses(marks, PLANE)
    assert valid.kind == "ring"
    both = Spots(marks.place, marks.rings, marks.clean, marks.text, local=np.array([True, False]))
    assert [curve.kind for curve in ellipses(both, PLANE)] == ["ring", "ring local"]


def test_counts_and_legend_name_the_statuses():
    rows = marked([[1, 1]] * 6, [*LOOKS, "ok"]).rows
    assert counted(rows) == "6 positions: 2 ok, 1 alone, 1 rival, 1 care, 1 bad."
    assert counted(rows[:1]) == ""
    assert [entry.look for entry in legend_of(rows, ["stations", "trails"])] == [*LOOKS, "station", "trail"]
    assert {"ok", "rival", "care", "bad", "station", "ring", "trail"} == {entry.look for entry in live_legend()}
