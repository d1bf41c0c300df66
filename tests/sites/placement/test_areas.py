"""Areas: polygons of GeoJSON, convex parts, half-planes, and what the ground hides."""

import json

import numpy as np
import pytest

from optloc.base.errors import InvalidProblem
from optloc.base.frames import CARTESIAN, ECEF, Frame
from optloc.sites.placement.areas import (
    convex_parts,
    corners_in_frame,
    ground_of,
    inside,
    polygons_of,
    region_of,
    visible,
)

SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
# A letter L: the square without its upper right part.
ELL = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]])


def area(ring):
    x, y = ring.T
    return 0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()


def test_rings_are_read_from_every_shape_without_their_repeated_ends(tmp_path):
    closed = [*SQUARE.tolist(), SQUARE[0].tolist()]
    polygon = {"type": "Polygon", "coordinates": [closed]}
    shapes = {
        "plain": (polygon, 1),
        "feature": ({"type": "Feature", "geometry": polygon}, 1),
        "many": ({"type": "FeatureCollection", "features": [{"geometry": polygon}] * 2}, 2),
        "multi": ({"type": "MultiPolygon", "coordinates": [[closed], [closed], [closed]]}, 3),
    }
    for name, (shape, count) in shapes.items():
        (tmp_path / name).write_text(json.dumps(shape))
        rings = polygons_of(tmp_path / name)
        assert [ring.tolist() for ring in rings] == [SQUARE.tolist()] * count
    for shape, said in (([[[0, 0], [1, 1]]], "at least four corners"), ([], "at least four corners")):
        (tmp_path / "bad").write_text(json.dumps({"type": "Polygon", "coordinates": shape}))
        with pytest.raises(InvalidProblem, match=said):
            polygons_of(tmp_path / "bad")


def test_corners_on_earth_become_metres_of_the_frame():
    enu = Frame.enu(lat_deg=47.0, lon_deg=11.0)
    (corner,) = corners_in_frame(np.array([[11.0, 47.001]]), enu, "area")
    assert corner == pytest.approx([0.0, 111.2], abs=0.2)  # a thousandth of a degree to the north
    assert corners_in_frame(SQUARE, CARTESIAN, "area") is SQUARE
    with pytest.raises(InvalidProblem, match="needs a local frame"):
        corners_in_frame(SQUARE, ECEF, "area")


def test_points_of_an_ell_are_inside_one_of_its_rectangles():
    points = np.random.default_rng(1).uniform(-0.5, 4.5, (400, 2))
    x, y = points.T
    wanted = (x > 0) & (y > 0) & (((x < 4) & (y < 1)) | ((x < 1) & (y < 3)))
    assert (inside(points, ELL) == wanted).all()
    assert (inside(points, ELL[::-1]) == wanted).all()


@pytest.mark.parametrize("ring", [SQUARE, ELL, ELL[::-1]])
def test_convex_parts_make_up_the_polygon_and_are_convex(ring):
    parts = convex_parts(ring)
    assert sum(map(area, parts)) == pytest.approx(abs(area(ring)))
    points = np.random.default_rng(2).uniform(-0.5, 4.5, (200, 2))
    regions = [region_of(part, 0.0, 0.0) for part in parts]
    covered = np.array([any((region.excess(p, None) <= 0.0).all() for region in regions) for p in points])
    assert (covered == inside(points, ring)).all()


TURN = 0.8 * np.pi * np.arange(5)
CROSSING = {
    "bow tie": np.array([[0.0, 0.0], [4.0, 3.0], [4.0, 0.0], [0.0, 2.0]]),
    "one edge": np.array([[0.0, 0.0], [4.0, 3.0], [4.0, 0.0], [0.0, 2.0], [2.0, -2.0]]),
    "star": np.column_stack([np.cos(TURN), np.sin(TURN)]),  # turns left at every corner
}


@pytest.mark.parametrize("name", CROSSING)
def test_a_polygon_whose_edges_cross_is_refused(name):
    with pytest.raises(InvalidProblem, match="cross each other"):
        convex_parts(CROSSING[name])


def test_half_planes_tell_how_far_outside_a_place_is():
    region = region_of(SQUARE, 1.0, 2.0)
    assert region.excess(np.array([5.0, 1.0, 1.5]), None).max() == pytest.approx(1.0)
    assert (region.excess(np.array([2.0, 1.0, 1.5]), None) <= 0.0).all()
    assert region.nearest(np.array([2.0, 1.0, 9.0]), None) == pytest.approx([2.0, 1.0, 2.0])


def test_a_ridge_hides_what_is_behind_it(tmp_path):
    x = np.linspace(-10.0, 10.0, 21)
    rows = [f"{a},{b},{5.0 if a == 0.0 else 0.0}" for a in x for b in x[::5]]
    (tmp_path / "ground.csv").write_text("x,y,z\n" + "\n".join(rows))
    ground = ground_of(tmp_path / "ground.csv", "terrain")
    places = np.array([[-8.0, 0.0, 1.0], [-8.0, 0.0, 9.0]])
    assert visible(ground, places, np.array([[8.0, 0.0, 1.0], [-4.0, 1.0, 1.0], [8.0, 0.0, 9.0]])).tolist() == [
        [0.0, 1.0, 0.0],
        [0.0, 1.0, 1.0],
    ]
    (tmp_path / "part.csv").write_text("x,y,z\n" + "\n".join(rows[:-1]))
    with pytest.raises(InvalidProblem, match="not a full grid"):
        ground_of(tmp_path / "part.csv", "terrain")
