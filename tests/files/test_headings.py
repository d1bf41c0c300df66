"""Bearings from the bow of a vehicle in tables: its heading is added, once, from the right column and unit."""

import json
from decimal import Decimal

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc import InvalidProblem, solve
from optloc.base.frames import ECEF
from optloc.cli import app
from optloc.files import load
from optloc.files.cell_text import Decimals
from optloc.files.convert import convert, interpret_table
from optloc.files.headings import from_bow, heading_of, stations_turned
from optloc.files.roles import ColumnPlaces, Roles
from optloc.files.table import of_rows
from optloc.files.table_import import BOW, COMPASS, ColumnHints, Readings, sort_named

RUN = CliRunner()
TARGET = (59.912, 10.735)
COURSE = [(59.900, 10.700, 350.0), (59.902, 10.706, 10.0), (59.905, 10.715, 65.0), (59.909, 10.722, 200.0)]


def true_bearing(lat, lon):
    """Return the bearing of the target in the horizontal plane of a place, degrees."""
    here, there = (ECEF.from_geodetic(np.radians(a), np.radians(b), 0.0) for a, b in ((lat, lon), TARGET))
    east, north, _ = ECEF.enu_axes(here) @ (there - here)
    return float(np.degrees(np.arctan2(east, north)) % 360.0)


def drive(
    folder, heading="heading_deg", bearing="bearing_deg", *, shift=0.0, unit=1.0, relative=True, name="drive.csv"
):
    """Write the log of a car: its places, headings less a shift, and bearings from the bow or from north."""
    lines = [f"lat,lon,{heading},bearing_deg"]
    for lat, lon, course in COURSE:
        seen = (true_bearing(lat, lon) - (course if relative else 0.0)) % 360.0
        lines.append(f"{lat},{lon},{unit * (course - shift)!r},{seen!r}")
    path = folder / "drive.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def fixed(path, **options):
    return solve(interpret_table(path, ColumnHints(**{"sigma": "1 deg", "still": True} | options)).read().problem)


def off(fix):
    lat, lon = np.degrees(fix.geodetic[:2])
    return float(np.hypot(lat - TARGET[0], (lon - TARGET[1]) * 0.5)) * 111e3


@pytest.mark.parametrize(
    ("heading", "unit"),
    [
        ("heading_deg", 1.0),
        ("Heading [deg]", 1.0),
        ("hdg_deg", 1.0),
        ("true_heading", 1.0),
        ("heading_rad", np.pi / 180.0),
        ("heading_mrad", 1e3 * np.pi / 180.0),
    ],
)
def test_headings_are_added_whatever_they_are_called(heading, unit, tmp_path):
    assert off(fixed(drive(tmp_path, heading, unit=float(unit)))) < 0.1


def test_a_stated_convention_leaves_the_heading_out(tmp_path):
    path = drive(tmp_path, relative=False)
    assert off(fixed(path, azimuth="north-clockwise")) < 0.1
    added = [float(z) for z in interpret_table(path, ColumnHints(sigma="1 deg", still=True)).sections[0].columns["z"]]
    apart = [z - true_bearing(lat, lon) - course for z, (lat, lon, course) in zip(added, COURSE, strict=True)]
    assert np.cos(np.radians(apart)) == pytest.approx([1.0] * len(COURSE))
    told = RUN.invoke(app, ["convert", str(path), "--sigma", "1 deg", "--azimuth", "north-clockwise", "--still"])
    assert "not used  heading_deg" in told.stdout
    told = RUN.invoke(app, ["convert", str(path), "--sigma", "1 deg", "--still"])
    assert "the heading in column 'heading_deg' is added; --azimuth north-clockwise reads them" in told.stdout
    assert "bearings from the bow, plus heading_deg" in told.stdout


@pytest.mark.parametrize("column", ["yaw_deg", "course_deg", "cog_deg"])
def test_other_angles_of_a_vehicle_are_no_headings_unless_named(column, tmp_path):
    path = drive(tmp_path, column)
    with pytest.raises(InvalidProblem, match="no column looks like the heading"):
        interpret_table(path, ColumnHints(sigma="1 deg", still=True, azimuth="bow-clockwise"))
    assert off(fixed(path, columns={"heading": column})) < 0.1
    assert off(fixed(path, columns={"heading": column}, azimuth="bow-clockwise")) < 0.1


def test_other_angles_do_not_change_true_bearings(tmp_path):
    assert off(fixed(drive(tmp_path, "course_deg", relative=False))) < 0.1


def test_a_declination_is_added_to_magnetic_headings(tmp_path):
    path = drive(tmp_path, "heading_mag_deg", shift=5.5)
    with pytest.raises(
        InvalidProblem, match=r"'heading_mag_deg' are magnetic, and the declination is unknown; give it with"
    ):
        fixed(path)
    assert off(fixed(path, declination="5.5 deg")) < 0.1
    out = tmp_path / "drive.toml"
    convert(path, out, sigma="1 deg", still=True, declination="5.5 deg")
    assert 'declination = "5.5 deg"' in out.read_text()
    assert off(solve(load(out))) < 0.1
    by_date = interpret_table(path, ColumnHints(sigma="1 deg", still=True, declination="2026-06-01")).read()
    assert "magnetic declination +5." in by_date.azimuths or "magnetic declination +4." in by_date.azimuths
    assert off(solve(by_date.problem)) < 60.0


def test_commands_take_the_declination(tmp_path):
    path = drive(tmp_path, shift=5.5)
    arguments = ["fix", str(path), "--sigma", "1 deg", "--still", "--declination", "5.5 deg", "--json"]
    found = json.loads(RUN.invoke(app, arguments).stdout)["fixes"][0]
    assert (found["lat_deg"], found["lon_deg"]) == pytest.approx(TARGET, abs=1e-6)
    wrong = RUN.invoke(app, [*arguments[:-2], "5.5"])
    assert (wrong.exit_code, wrong.stderr.count("\n")) == (2, 1)
    assert "--declination: '5.5' has no unit" in wrong.stderr


@pytest.mark.parametrize(
    ("replaced", "by", "words"),
    [
        ("200.0,", ",", r"row 4, column 'heading_deg': the bearing has no heading"),
        ("200.0,", "511,", r"row 4, column 'heading_deg': the heading 511 deg is more than a full turn"),
        ("heading_deg", "heading_m", r"no column looks like the heading"),
    ],
)
def test_headings_that_are_none_are_refused(replaced, by, words, tmp_path):
    path = drive(tmp_path)
    path.write_text(path.read_text().replace(replaced, by))
    with pytest.raises(InvalidProblem, match=words):
        fixed(path, azimuth="bow-clockwise")


def test_small_headings_without_a_unit_are_asked_for(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("lat,lon,heading,bearing_deg\n59.9,10.7,1.0,30\n59.8,10.75,2.0,20\n")
    with pytest.raises(InvalidProblem, match=r"the unit of the column 'heading' is unknown; rename it to heading_deg"):
        fixed(path)
    found = interpret_table(path, ColumnHints(sigma="1 deg", still=True, unit="deg")).sections[0]
    assert found.columns["z"].texts() == ["31.0", "22.0"]


def test_a_declination_without_bearings_from_north_is_refused(tmp_path):
    path = drive(tmp_path)
    with pytest.raises(InvalidProblem, match="angles from the x axis have no declination"):
        fixed(path, azimuth="east-counterclockwise", declination="4 deg")
    path.write_text("lat,lon,range_m\n59.9,10.7,100\n59.91,10.7,900\n59.9,10.71,700\n")
    with pytest.raises(InvalidProblem, match="the table has no bearings"):
        fixed(path, sigma="1 m", declination="4 deg")


def test_stations_of_a_table_may_have_headings(tmp_path):
    path, sites = tmp_path / "seen.csv", tmp_path / "sites.csv"
    lines, rows = ["station,bearing_deg"], ["name,lat,lon,heading_deg"]
    for k, (lat, lon, course) in enumerate(COURSE):
        lines.append(f"S{k},{(true_bearing(lat, lon) - course) % 360.0!r}")
        rows.append(f"S{k},{lat},{lon},{course}")
    path.write_text("\n".join(lines) + "\n")
    sites.write_text("\n".join(rows) + "\n")
    made = interpret_table(path, ColumnHints(sigma="1 deg", stations=sites))
    assert off(solve(made.read().problem)) < 0.1
    assert "bearings are relative to the headings of the stations" in made.notes[0]
    sites.write_text("\n".join(rows).replace(",65.0", ",") + "\n")
    with pytest.raises(InvalidProblem, match="station 'S2' has no heading"):
        interpret_table(path, ColumnHints(sigma="1 deg", stations=sites))
    path.write_text(path.read_text().replace("bearing_deg", "range_m"))
    assert "heading_deg" not in interpret_table(path, ColumnHints(sigma="1 m", stations=sites)).places.columns


def test_json_and_range_beside_the_bearing(tmp_path):
    rows = []
    for lat, lon, course in COURSE:
        here, there = (ECEF.from_geodetic(np.radians(a), np.radians(b), 0.0) for a, b in ((lat, lon), TARGET))
        seen = {"bearing_deg": true_bearing(lat, lon) - course, "range_m": float(np.linalg.norm(there - here))}
        rows.append({"lat": lat, "lon": lon, "hdg": course} | seen)
    path = tmp_path / "log.json"
    path.write_text(json.dumps(rows))
    assert off(fixed(path, sigma="range=1 m,bearing=1 deg")) < 0.5


def bearings(kind="azimuth", heading=None):
    """Return bearings of 350 and 30 degrees at stations A and B."""
    names, none = np.array(["A", "B"], dtype=object), np.arange(2)
    values = Decimals.of([Decimal(350), Decimal(30)])
    return Readings(sort_named(kind), "deg", values, none, ("bearing",), np.zeros(2, dtype=int), names, heading=heading)


def test_headings_are_added_within_a_turn():
    roles = Roles.of(
        of_rows([{"bearing": 350, "heading_deg": "20.5"}, {"bearing": 30, "heading_deg": 0}], "t.csv", {}), {}
    )
    assert heading_of(bearings(), roles, ColumnHints(azimuth=BOW)) == "heading_deg"
    assert heading_of(bearings(), roles, ColumnHints(azimuth=COMPASS)) is None
    found = from_bow(bearings(), roles, "heading_deg", ColumnHints())
    assert found.values.tolist() == [Decimal("10.5"), Decimal(30)]
    assert (found.azimuth, found.heading) == (COMPASS, "heading_deg")


def test_stations_that_measure_bearings_have_a_heading():
    columns = {"name": np.array(["A", "B"], dtype=object), "heading_deg": np.array([5.0, np.nan])}
    place = ColumnPlaces(columns, "cartesian")
    with pytest.raises(InvalidProblem, match="station 'B' has no heading"):
        stations_turned(place, [bearings()])
    kept, note = stations_turned(place, [bearings("range")])
    assert ("heading_deg" in kept.columns, note) == (False, "")
    sure = ColumnPlaces(columns | {"heading_deg": np.array([5.0, 7.0])}, "cartesian")
    with pytest.raises(InvalidProblem, match="are both given"):
        stations_turned(sure, [bearings(heading="heading_deg")])
    assert stations_turned(sure, [bearings()])[0].columns["heading_deg"].tolist() == [5.0, 7.0]
