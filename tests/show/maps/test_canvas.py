"""Parts of a map: labels that fit, layers below the grid, dots."""

import numpy as np

from optloc.show.maps.canvas import Label, dot, fitting, map_canvas
from optloc.show.maps.projection import Plane


def test_a_label_that_overlaps_a_more_important_one_is_hidden():
    plane = Plane(0.0, 1000.0, 0.0, 700.0, flat=True)
    layers = {
        "cities": [Label("city", 5.0, 0.0, "behind"), Label("city", 0.0, 200.0, "free")],
        "names": [Label("name", 0.0, 0.0, "station"), Label("name", 490.0, 0.0, "beyond the edge")],
    }
    found = {one.text: one.shown for drawn in fitting(layers, plane).values() for one in drawn}
    assert found == {"behind": False, "free": True, "station": True, "beyond the edge": False}


def test_a_plane_has_no_coast_and_no_cities():
    flat = map_canvas(Plane(0.0, 10.0, 0.0, 10.0, flat=True), "m", "", {"fix": ()}, {}, "", under={"bound": ()})
    assert list(flat.layers) == ["bound", "grid", "fix"]
    assert flat.shore == flat.border == ""
    assert flat.data["flat"]
    earth = map_canvas(Plane(5.0, 15.0, 43.0, 50.0), "m", "", {"fix": ()}, {}, "")
    assert list(earth.layers) == ["grid", "cities", "fix"]
    assert len(earth.shore) > 1000
    assert len(earth.border) > 1000
    assert any(label.text == "• Munich" for label in earth.layers["cities"])


def test_a_dot_is_a_path_of_length_zero():
    one = dot(1.5, np.float64(-2.0), "ok", 12, "text", 3)
    assert (one.kind, one.d, one.width, one.hover, one.row) == ("dot ok", "M1.5 -2h0", 12, "text", 3)
