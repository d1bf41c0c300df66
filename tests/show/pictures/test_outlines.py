"""GeoJSON as RFC 7946 has it, wherever on the Earth: cut at the antimeridian, closed around the poles."""

import json
from itertools import pairwise

import numpy as np
import pymap3d
import pytest
from typer.testing import CliRunner

from optloc.base.frames import ECEF
from optloc.cli import app
from optloc.show.pictures.outlines import earth_line, line_geometry, polygon_geometry

RUN = CliRunner()
# Latitude and longitude of a middle, and semi-axes of an ellipse about it, metres.
PLACES = {
    "ordinary": (47.0, 11.0, 3e3, 1e3),
    "across the date line": (10.0, 179.9, 40e3, 10e3),
    "just touching": (-5.0, -179.99999, 3.0, 2.0),
    "on the date line": (60.0, 180.0, 0.2, 0.1),
    "around the north pole": (89.9, 30.0, 40e3, 20e3),
    "around the south pole": (-89.8, -100.0, 90e3, 50e3),
    "at the pole": (90.0, 0.0, 5e3, 2e3),
    "beside the pole": (89.5, 20.0, 200e3, 30e3),
    "half a continent": (70.0, 170.0, 2.5e6, 1.5e6),
    "south of it": (-75.0, 179.0, 1.4e6, 2e6),
}


def rings(geometry):
    """Return the polygons of a geometry, each a list of closed lines (n, 2)."""
    assert geometry["type"] in ("Polygon", "MultiPolygon")
    several = [geometry["coordinates"]] if geometry["type"] == "Polygon" else geometry["coordinates"]
    return [[np.array(line)[:, :2] for line in polygon] for polygon in several]


def area(ring):
    (x, y), (x1, y1) = ring[:-1].T, ring[1:].T
    return 0.5 * np.sum(x * y1 - x1 * y)


def inside(places, geometry):
    """Tell which places (n, 2) are in a geometry, straight lines in degrees, by the even-odd rule."""
    lon, lat = np.atleast_2d(places).T
    count = np.zeros(len(lon), dtype=int)
    for ring in (line for polygon in rings(geometry) for line in polygon):
        for (x0, y0), (x1, y1) in pairwise(ring):
            if y0 != y1:
                count += ((y0 > lat) != (y1 > lat)) & (lon < x0 + (lat - y0) / (y1 - y0) * (x1 - x0))
    return count % 2 == 1


def check_form(geometry):
    for polygon in rings(geometry):
        for i, ring in enumerate(polygon):
            assert len(ring) >= 4
            assert (ring[0] == ring[-1]).all()
            assert np.abs(ring[:, 0]).max() <= 180.0
            assert np.abs(ring[:, 1]).max() <= 90.0
            assert np.abs(np.diff(ring[:, 0])).max() <= 180.0 or np.abs(ring[:, 1]).max() == 90.0
            assert (area(ring) > 0.0) == (i == 0)


def plane(lat, lon, one, two, points):
    """Return points (n, 2) of the unit disc as longitude and latitude (n, 2) of the ellipse about a place."""
    turn = np.radians(30.0)
    east, north = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ (points * [one, two]).T
    y, x, _ = pymap3d.enu2geodetic(east, north, np.zeros_like(east), lat, lon, 0.0)
    return np.stack([x, y], axis=-1)


def circle(count, clockwise=False):
    angle = np.linspace(0.0, 2.0 * np.pi, count + 1) * (-1.0 if clockwise else 1.0)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def on_earth(lat, lon, one, two, points):
    """Return the closed line of points (n, 2) of the disc by optloc's own frame."""
    turn = np.radians(30.0)
    flat = (points * [one, two]) @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    centre = ECEF.from_geodetic(np.radians(lat), np.radians(lon), 0.0)
    line = centre + flat @ ECEF.enu_axes(centre)[:2]
    line[-1] = line[0]
    return earth_line(ECEF, line)


def draws(seed, low, high, count=150):
    draw = np.random.default_rng(seed)
    radius, angle = np.sqrt(draw.uniform(low**2, high**2, count)), draw.uniform(0.0, 2.0 * np.pi, count)
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@pytest.mark.parametrize("place", PLACES)
def test_an_ellipse_is_where_it_is(place, seed):
    lat, lon, *size = PLACES[place]
    geometry = polygon_geometry([[on_earth(lat, lon, *size, circle(72))]])
    check_form(geometry)
    # 72 corners: the chord is a thousandth within the ellipse; a line in degrees bends a little more near a pole.
    for low, high, expected in ((0.0, 0.97, True), (1.03, 1.8, False)):
        where = plane(lat, lon, *size, draws(seed, low, high))
        assert inside(where, geometry).tolist() == [expected] * len(where)
    if "pole" in place and place != "beside the pole":
        assert inside([12.3, np.copysign(89.999999, lat)], geometry)


@pytest.mark.parametrize("place", PLACES)
def test_a_region_with_a_hole_keeps_it(place, seed):
    lat, lon, *size = PLACES[place]
    lines = [on_earth(lat, lon, *size, circle(72)), on_earth(lat, lon, *size, 0.5 * circle(72, clockwise=True))]
    geometry = polygon_geometry([lines])
    check_form(geometry)
    for low, high, expected in ((0.0, 0.48, False), (0.52, 0.97, True), (1.03, 1.5, False)):
        where = plane(lat, lon, *size, draws(seed, low, high))
        assert inside(where, geometry).tolist() == [expected] * len(where)


def test_a_hole_may_be_beside_the_cut_and_a_banana_may_cross_it_twice(seed):
    lat, lon, one, two = 20.0, 180.0, 50e3, 50e3
    hole = 0.2 * circle(40, clockwise=True) + [0.5, 0.0]
    geometry = polygon_geometry([[on_earth(lat, lon, one, two, circle(72)), on_earth(lat, lon, one, two, hole)]])
    check_form(geometry)
    assert sorted(len(polygon) for polygon in rings(geometry)) == [1, 2]
    angle = np.linspace(-0.8 * np.pi, 0.8 * np.pi, 80)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    banana = np.concatenate([arc, 0.7 * arc[::-1], arc[:1]])
    geometry = polygon_geometry([[on_earth(lat, lon, one, two, banana)]])
    check_form(geometry)
    assert len(rings(geometry)) == 3
    points = draws(seed, 0.0, 1.2, 300)
    radius, turn = np.hypot(*points.T), np.abs(np.arctan2(points[:, 1], points[:, 0]))
    sure = (np.abs(radius - 1.0) > 0.03) & (np.abs(radius - 0.7) > 0.03) & (np.abs(turn - 0.8 * np.pi) > 0.05)
    expected = (radius > 0.7) & (radius < 1.0) & (turn < 0.8 * np.pi)
    where = plane(lat, lon, one, two, points[sure])
    assert inside(where, geometry).tolist() == expected[sure].tolist()


def test_lines_are_cut_at_the_antimeridian():
    line = np.array([[170.0, 0.0], [178.0, 1.0], [186.0, 2.0], [181.0, 3.0], [176.0, 4.0]])
    parts = line_geometry([line])["coordinates"]
    ends = [(part[0], part[-1]) for part in parts]
    assert ends == [([170.0, 0.0], [180.0, 1.25]), ([-180.0, 1.25], [-180.0, 3.2]), ([180.0, 3.2], [176.0, 4.0])]


TOML = """
format = 1
[frame]
kind = "enu"
origin = {{ lat_deg = {lat}, lon_deg = {lon}, height = 0 }}
[stations]
rows = [{stations}]
[[measurements]]
kind = "range"
sigma = {sigma}
rows = [{rows}]
"""


@pytest.mark.parametrize(("lat", "lon"), [(15.0, 180.0), (89.9999, 40.0), (-89.9999, -170.0), (-15.0, -179.9999)])
def test_the_command_writes_it(lat, lon, tmp_path):
    points = {"A": (0, 0, 0), "B": (9000, 0, 500), "C": (0, 9000, 900), "D": (9000, 9000, 100), "E": (4000, -9000, 700)}
    stations = ", ".join(f'{{ name = "{n}", x = {x}, y = {y}, z = {z} }}' for n, (x, y, z) in points.items())
    target = np.array([20.0, 10.0, 3000.0])
    rows = ", ".join(f'{{ a = "{n}", z = {np.linalg.norm(target - p)} }}' for n, p in points.items())
    (tmp_path / "a.toml").write_text(TOML.format(lat=lat, lon=lon, sigma=30.0, stations=stations, rows=rows))
    out = tmp_path / "a.geojson"
    done = RUN.invoke(app, ["fix", str(tmp_path / "a.toml"), "--geojson", str(out), "--html", str(tmp_path / "a.html")])
    assert done.exit_code == 0, done.output
    features = {f["properties"]["role"]: f["geometry"] for f in json.loads(out.read_text())["features"]}
    check_form(features["ellipse95"])
    assert inside(features["fix"]["coordinates"][:2], features["ellipse95"])
    page = (tmp_path / "a.html").read_text()
    assert "nan" not in page.split("<svg")[1].split("</svg>")[0].lower()
    if abs(lat) > 80.0:
        assert inside([77.0, np.copysign(89.9999999, lat)], features["ellipse95"])
