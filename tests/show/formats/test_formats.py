"""Fixes and tracks in the formats of others, read back by parsers that know nothing of optloc."""

import dataclasses
import json
import re
from functools import reduce
from operator import xor
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pymap3d
import pytest
import yaml
from scipy.stats import chi2
from typer.testing import CliRunner

import optloc
from optloc.base.frames import CARTESIAN, ECEF, Frame
from optloc.cli import app
from optloc.show.formats import FORMATS, Results, write_fixes
from optloc.show.formats.marks import ellipse
from optloc.show.formats.markup import cot, gpx, kml
from optloc.show.formats.sentences import g2o, nmea, ros

RUN = CliRunner()
DEMOS = Path(optloc.__file__).parent / "scenarios"
KML, GPX, OWN = (
    "{http://www.opengis.net/kml/2.2}",
    "{http://www.topografix.com/GPX/1/1}",
    "{urn:optloc:fix}",
)
LAT, LON, HEIGHT = -33.999999999, 151.2, 412.5
# Children in the order of the schemas.
ORDER = {
    f"{KML}Placemark": "name description TimeStamp styleUrl ExtendedData Point Polygon MultiGeometry",
    f"{KML}Document": "name Style Placemark",
    f"{KML}Polygon": "tessellate altitudeMode outerBoundaryIs innerBoundaryIs",
    f"{KML}Point": "altitudeMode coordinates",
    f"{KML}Style": "IconStyle LineStyle PolyStyle",
    f"{GPX}gpx": "metadata wpt trk",
    f"{GPX}wpt": "ele time name desc type extensions",
    f"{GPX}trkpt": "ele time extensions",
    f"{GPX}trk": "name trkseg",
}
ENU = np.array([[900.0, 350.0, -40.0], [350.0, 400.0, 60.0], [-40.0, 60.0, 2500.0]])


def level_axes(lat, lon):
    """Return east, north, up in ECEF as rows, by small steps of another library."""
    start = np.array(pymap3d.geodetic2ecef(lat, lon, 0.0))
    steps = [pymap3d.enu2ecef(*step, lat, lon, 0.0) for step in np.eye(3)]
    return np.array([np.array(step) - start for step in steps])


def columns_of(frame, position, covariance, status="ok", chart="cartesian", **more):
    """Return a table of one row, made by hand."""
    from optloc.show.columns import covariance_columns, geodetic_columns

    axes, spread = "xyz"[: len(position)], np.asarray(covariance)[None]
    table = {"status": np.array([status], object), "reason": np.array([""], object), "chart": np.array([chart], object)}
    table |= {axis: np.array([v]) for axis, v in zip(axes, position, strict=True)}
    table |= covariance_columns(spread, axes) | geodetic_columns(frame, np.asarray(position)[None], spread)
    return table | {name: np.array([value]) for name, value in more.items()}


def on_earth(status="ok", chart="cartesian", **more):
    """Return a row in ECEF whose covariance is `ENU` along east, north and up."""
    axes = level_axes(LAT, LON)
    place = np.array(pymap3d.geodetic2ecef(LAT, LON, HEIGHT))
    return Results(
        columns_of(ECEF, place, axes.T @ ENU @ axes, status, chart, **more), ECEF, title="site <&>", dated=True
    )


def ambiguous():
    problem = optloc.load(DEMOS / "ambiguous.toml")
    problem = dataclasses.replace(problem, frame=Frame.enu(lat_deg=LAT, lon_deg=LON))
    return problem, optloc.solve(problem)


def check_order(root):
    for element in root.iter():
        if element.tag in ORDER:
            words = [child.tag.rpartition("}")[2] for child in element]
            places = [ORDER[element.tag].split().index(word) for word in words]
            assert places == sorted(places), (element.tag, words)


def ring(text):
    return np.array([[float(v) for v in each.split(",")] for each in text.split()])


def test_the_ellipse_of_kml_is_where_it_is_on_the_ellipsoid():
    root = ET.fromstring(kml(on_earth(time=1.7e9)))
    check_order(root)
    assert root.find(f"{KML}Document/{KML}name").text == "site <&>"
    assert root.find(f".//{KML}when").text == "2023-11-14T22:13:20.000Z"
    corners = ring(root.find(f".//{KML}Polygon//{KML}coordinates").text)
    assert (corners[0] == corners[-1]).all()
    east, north, up = pymap3d.geodetic2enu(corners[:, 1], corners[:, 0], corners[:, 2], LAT, LON, HEIGHT)
    away = np.stack([east, north], axis=-1)
    far = np.einsum("ni,ij,nj->n", away, np.linalg.inv(ENU[:2, :2]), away)
    assert far == pytest.approx(chi2.ppf(0.95, 2), rel=1e-5)
    assert np.abs(up).max() < 1e-2
    area = 0.5 * np.sum(east[:-1] * north[1:] - east[1:] * north[:-1])
    assert area > 0.0
    point = ring(root.find(f".//{KML}Point/{KML}coordinates").text)[0]
    assert point == pytest.approx([LON, LAT, HEIGHT], abs=1e-3)


@pytest.mark.parametrize(("status", "chart"), [("misfit", "cartesian"), ("ambiguous", "cartesian"), ("ok", "curved")])
def test_what_does_not_cover_has_no_ellipse_anywhere(status, chart):
    results = on_earth(status, chart)
    root = ET.fromstring(kml(results))
    assert root.find(f".//{KML}Polygon") is None
    doubts = {"misfit": "not valid: the residuals", "ambiguous": "if this position is correct", "ok": "not valid; use"}
    assert doubts[status] in root.find(f".//{KML}Placemark/{KML}description").text
    assert (status == "ok") != (f": {status}" in root.find(f".//{KML}Placemark/{KML}name").text)
    point = ET.fromstring(cot(results)).find("point")
    assert float(point.get("ce")) == float(point.get("le")) == 9999999.0
    assert "GST" not in nmea(results)
    assert "EDGE" not in g2o(results)
    assert '"covariance"' not in ros(results)
    assert ET.fromstring(gpx(results)).find(f".//{OWN}covariance_enu_m2") is None
    assert "Polygon" not in json.dumps(optloc.show.formats.geojson(results))


def test_alternatives_are_shown(tmp_path):
    problem, fix = ambiguous()
    count = int(np.isfinite(fix.alternatives.gap).sum())
    assert count >= 1
    for name in FORMATS:
        write_fixes(tmp_path / f"out{FORMATS[name].endings[0]}", fix, problem)
    root = ET.parse(tmp_path / "out.kml").getroot()
    check_order(root)
    names = [element.text for element in root.iter(f"{KML}name")]
    assert sum("alternative" in name for name in names) == count
    root = ET.parse(tmp_path / "out.gpx").getroot()
    check_order(root)
    assert sum(element.text == "alternative" for element in root.iter(f"{GPX}type")) == count
    events = [ET.fromstring(line) for line in (tmp_path / "out.cot").read_text().splitlines()]
    assert [event.get("type") for event in events] == ["a-p-G"] * (count + 1)
    assert len({event.get("uid") for event in events}) == count + 1
    features = json.loads((tmp_path / "out.geojson").read_text())["features"]
    roles = [feature["properties"]["role"] for feature in features]
    assert roles.count("alternative") == count
    assert "ellipse95" not in roles
    assert (tmp_path / "out.nmea").read_text().split(",")[6] == "0"
    assert (tmp_path / "out.g2o").read_text().count("# alternative at ") == count
    assert list(yaml.safe_load_all((tmp_path / "out.yaml").read_text())) == []


def test_gpx_has_the_order_of_its_schema_and_no_error_that_it_does_not_know():
    root = ET.fromstring(gpx(on_earth(time=1.7e9)))
    check_order(root)
    point = root.find(f"{GPX}trk/{GPX}trkseg/{GPX}trkpt")
    assert [float(point.get(name)) for name in ("lat", "lon")] == pytest.approx([LAT, LON], abs=1e-9)
    assert float(point.find(f"{GPX}ele").text) == pytest.approx(HEIGHT, abs=1e-3)
    triangle = [float(v) for v in point.find(f".//{OWN}covariance_enu_m2").text.split()]
    assert triangle == pytest.approx(ENU[np.triu_indices(3)], rel=1e-6)
    assert not {f"{GPX}hdop", f"{GPX}vdop", f"{GPX}pdop"} & {element.tag for element in root.iter()}


def test_cursor_on_target_has_one_sigma_and_the_schema_s_attributes():
    axes = level_axes(LAT, LON)
    moving = axes.T @ [3.0, 4.0, 1.0]
    root = ET.fromstring(cot(on_earth(time=1.7e9, vx=moving[0], vy=moving[1], vz=moving[2])))
    assert set(root.attrib) == {"version", "uid", "type", "time", "start", "stale", "how"}
    assert root.get("start") == "2023-11-14T22:13:20.000Z"
    assert [child.tag for child in root] == ["point", "detail"]
    point = {name: float(value) for name, value in root.find("point").attrib.items()}
    assert point["hae"] == pytest.approx(HEIGHT, abs=1e-3)
    assert point["ce"] == pytest.approx(np.sqrt(np.linalg.eigvalsh(ENU[:2, :2])[-1]), abs=1e-3)
    assert point["le"] == pytest.approx(50.0, abs=1e-3)
    track = root.find("detail/track")
    assert float(track.get("course")) == pytest.approx(np.degrees(np.arctan2(3.0, 4.0)), abs=0.01)
    assert float(track.get("speed")) == pytest.approx(5.0, abs=1e-3)


def test_nmea_has_checksums_places_and_error_statistics():
    text = nmea(on_earth(time=1.7e9))
    found = re.findall(r"^\$(GN\w{3}),(.*)\*([0-9A-F]{2})\r$", text, re.MULTILINE)
    assert [name for name, _, _ in found] == ["GNGGA", "GNGST"]
    for name, body, checksum in found:
        assert reduce(xor, f"{name},{body}".encode()) == int(checksum, 16)
        assert len(f"${name},{body}*{checksum}\r\n") <= 82
    place, errors = (body.split(",") for _, body, _ in found)
    assert place[0] == errors[0] == "221320.00"
    # 33.999999999 degrees are 59.99999994 minutes, which is never written as 60
    assert place[1:5] == ["3359.9999999", "S", "15112.0000000", "E"]
    assert place[5:7] == ["1", "03"]
    assert float(place[8]) + float(place[10]) == pytest.approx(HEIGHT, abs=1e-3)
    major, minor, bearing, north, east, up = map(float, errors[2:])
    assert [north, east, up] == pytest.approx([20.0, 30.0, 50.0], abs=1e-3)
    way = np.array([np.sin(np.radians(bearing)), np.cos(np.radians(bearing))])
    assert way @ ENU[:2, :2] @ way == pytest.approx(major**2, rel=1e-3)
    assert major**2 + minor**2 == pytest.approx(1300.0, rel=1e-3)


def test_poses_of_ros_have_rows_of_x_y_z_and_rotations():
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    results = Results(columns_of(CARTESIAN, [10.0, -20.0], covariance, time=12.25), CARTESIAN)
    (message,) = (one for one in yaml.safe_load_all(ros(results)) if one)
    assert message["header"] == {"stamp": {"sec": 12, "nanosec": 250_000_000}, "frame_id": "map"}
    assert message["pose"]["pose"]["position"] == {"x": 10.0, "y": -20.0, "z": 0.0}
    matrix = np.reshape(message["pose"]["covariance"], (6, 6))
    assert (matrix[:2, :2] == covariance).all()
    assert (np.diag(matrix)[2:] >= 1e4).all()
    assert np.count_nonzero(matrix) == 8
    (message,) = (one for one in yaml.safe_load_all(ros(on_earth())) if one)
    axes = level_axes(LAT, LON)
    assert message["header"]["frame_id"] == "earth"
    found = np.reshape(message["pose"]["covariance"], (6, 6))[:3, :3]
    assert found == pytest.approx(axes.T @ ENU @ axes, rel=1e-6)


@pytest.mark.parametrize("held", [False, True])
def test_g2o_has_information_row_by_row_of_the_upper_triangle(held):
    covariance = np.diag([4.0, 9.0, 0.0]) if held else ENU
    results = Results(columns_of(CARTESIAN, [1.0, 2.0, 3.0], covariance), CARTESIAN)
    lines = [line.split() for line in g2o(results).splitlines() if not line.startswith("#")]
    assert lines[0] == ["VERTEX_TRACKXYZ", "0", "1", "2", "3"]
    assert lines[1][:5] == ["EDGE_POINTXYZ_PRIOR", "0", "1", "2", "3"]
    information = np.zeros((3, 3))
    information[np.triu_indices(3)] = [float(v) for v in lines[1][5:]]
    information += np.triu(information, 1).T
    size = 2 if held else 3
    assert (information @ covariance)[:size, :size] == pytest.approx(np.eye(size), abs=1e-9)
    assert np.isfinite(information).all()
    plane = Results(columns_of(CARTESIAN, [1.0, 2.0], np.diag([4.0, 9.0])), CARTESIAN)
    assert g2o(plane).splitlines()[-1] == "EDGE_PRIOR_XY 0 1 2 0.25 0 0.111111111111"


def test_the_longer_axis_has_its_bearing_from_north_to_east():
    for turn in (0.0, 30.0, 90.0, 150.0):
        way = np.array([np.sin(np.radians(turn)), np.cos(np.radians(turn))])
        major, minor, bearing = ellipse(np.eye(2) + 8.0 * np.outer(way, way))
        assert (major, minor) == pytest.approx((3.0, 1.0))
        assert (bearing - turn + 90.0) % 180.0 == pytest.approx(90.0)


@pytest.mark.parametrize("ending", [ending for one in FORMATS.values() for ending in one.endings])
def test_the_command_writes_every_format_by_its_ending(ending, tmp_path):
    out = tmp_path / f"fixes{ending}"
    done = RUN.invoke(app, ["fix", "demo", "--quiet", "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert out.stat().st_size > 100


def test_a_track_is_a_line_and_what_cannot_be_written_is_refused_before_the_work(tmp_path):
    for path in DEMOS.glob("run*"):
        frame = '[frame]\nkind = "enu"\norigin = { lat_deg = 47.0, lon_deg = 8.0 }\n\n[stations]'
        text = path.read_text().replace("[stations]", frame)
        (tmp_path / path.name).write_text(text)
    for ending in ("kml", "gpx"):
        done = RUN.invoke(app, ["track", str(tmp_path / "run.toml"), "--quiet", "--out", str(tmp_path / f"o.{ending}")])
        assert done.exit_code in (0, 1), done.output
    line = ET.parse(tmp_path / "o.kml").getroot().find(f".//{KML}LineString/{KML}coordinates")
    root = ET.parse(tmp_path / "o.gpx").getroot()
    assert len(ring(line.text)) == len(list(root.iter(f"{GPX}trkpt"))) > 10
    check_order(root)
    refusals = {"fixes.kmz": "did you mean '.kml'", "fixes.kml": "the frame is cartesian"}
    for name, text in refusals.items():
        done = RUN.invoke(app, ["track", "run", "--out", str(tmp_path / name)])
        assert done.exit_code == 2
        assert text in done.output
    assert "graph optimisation" in RUN.invoke(app, ["list", "formats"]).output


def test_formats_of_the_earth_refuse_other_frames(tmp_path):
    problem = optloc.load(DEMOS / "ambiguous.toml")
    fix = optloc.solve(problem)
    for name, one in FORMATS.items():
        if one.earth:
            with pytest.raises(optloc.InvalidProblem, match="cartesian"):
                write_fixes(tmp_path / f"{name}{one.endings[0]}", fix)
    assert not list(tmp_path.iterdir())
