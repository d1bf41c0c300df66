"""Marks of maps: ellipses, rows of the list, classes of statuses and texts of times and coordinates."""

from importlib.resources import files as package_files

import numpy as np
import pytest
from show.ranging import ranged, unbounded

import optloc
from optloc.base.types import Status
from optloc.problem import CARTESIAN
from optloc.show import fix_page
from optloc.show.describe_fix import answer_of
from optloc.show.maps.map_marks import (
    fixed_spots,
    look_of,
    map_row,
    other_spots,
    scan_spots,
    station_spots,
    time_text,
)
from optloc.show.row_answer import state_table

DEMO = package_files("optloc") / "scenarios" / "demo.toml"


@pytest.fixture(scope="module")
def demo():
    problem = optloc.load(DEMO)
    return problem, optloc.solve(problem)


def test_the_ring_is_the_ellipse(demo):
    problem, fix = demo
    made = fixed_spots(problem, [fix], [])
    lat, lon, height = fix.geodetic
    back = problem.frame.from_geodetic(*np.radians(made.rings[0].T[::-1]), np.full(73, height))
    axes = problem.frame.enu_axes(fix.position)[:2]
    away = (back - fix.position) @ axes.T
    square = np.einsum("ni,ij,nj->n", away, np.linalg.inv(axes @ fix.covariance() @ axes.T), away)
    np.testing.assert_allclose(square, 5.991, rtol=2e-3)
    np.testing.assert_allclose(made.place[0], np.degrees([lon, lat]), rtol=1e-12)


def test_an_ellipse_that_does_not_cover_is_dotted_on_the_map(monkeypatch):
    """Of many curved fixes no region is enclosed, which takes a tenth of a second each: here from the first on."""
    monkeypatch.setattr("optloc.show.pictures.outlines._MOST", 0)
    lat, lon = np.radians([47.812, 47.751, 47.79]), np.radians([11.183, 11.148, 11.31])
    stations = optloc.station_array(optloc.problem.ECEF.from_geodetic(lat, lon, np.array([612.0, 640.0, 842.0])), "ABC")
    rows = optloc.measured("range", np.array([9000.0, 12300.0, 1500.0]), a=[0, 1, 2], sigma=800.0)
    problem = optloc.assemble(
        stations, rows, frame=optloc.problem.ECEF, constraints=(optloc.constraints.height(exactly=700.0),)
    )
    fix = optloc.solve(problem)
    assert fixed_spots(problem, [fix], []).local.all()
    page = fix_page(problem, fix, "far from an ellipse")
    assert "Dotted: a local ellipse, not valid" in page
    assert 'class="ring local"' in page


def test_a_row_has_status_time_and_coordinates():
    problem, fix = ranged()
    marks = fixed_spots(problem, [fix], ["one"], [1.7e9], dated=True)
    (row,) = marks.rows
    assert (row.name, row.time, row.status, row.look) == ("one", "2023-11-14 22:13:20 UTC", "ok", "ok")
    lat, lon = (float(part) for part in row.copied.split(", "))
    assert (lon, lat) == pytest.approx(marks.place[0], abs=1e-5)
    printed = answer_of(fix).section("how sure").rows
    assert row.size == "; ".join(f"{label}: {text}" for label, text in printed)


def test_each_target_has_its_trail():
    problem, fix = ranged()
    assert fixed_spots(problem, [fix, fix]).groups == ()  # the order of these fixes is unknown
    assert fixed_spots(problem, [fix, fix], times=[0.0, 1.0]).groups == ("", "")
    assert fixed_spots(problem, [fix, fix], times=[0.0, 1.0], targets="ab").groups == ("a", "b")


def test_an_unknown_position_has_no_coordinates():
    (row,) = fixed_spots(ranged()[0], [unbounded()]).rows
    assert row.status == "unbounded"
    assert row.look == "bad"
    assert row.place == row.copied == ""
    assert row.size == "no position"
    assert row.note


def test_each_status_has_a_class():
    assert look_of("ok") == look_of("started") == "ok"
    assert look_of("ok", unchecked=True) == "alone"
    assert look_of("ambiguous", unchecked=True) == "rival"
    assert {look_of(status.label) for status in Status} == {"ok", "alone", "rival", "care", "bad"}


def test_small_ellipses_have_more_decimals():
    problem, _ = ranged()
    sigma = np.array([3.0, 0.3, 0.002, 1e-7])
    places, covariance = np.tile([10.0, 20.0], (4, 1)), sigma[:, None, None] ** 2 * np.eye(2)
    columns = state_table(problem.frame, places, covariance, status=["ok"] * 4)
    rows = [map_row(problem.frame, columns, i) for i in range(4)]
    assert [len(row.place.partition(",")[0].partition(".")[2]) for row in rows] == [6, 7, 9, 6]


def test_a_plane_frame_has_metres():
    place, covariance = np.array([[1.0, -2.0, 3.0]]), np.diag([4.0, 9.0, 0.0])[None]
    row = map_row(CARTESIAN, state_table(CARTESIAN, place, covariance, status=["ok"], unchecked=[True]), 0, "a", 2.5)
    assert row.place == "x 1.0 m, y -2.0 m, z 3 m"
    assert row.copied == "1.0, -2.0, 3"
    assert row.size.startswith("sigma x, y, z: 2, 3, 0 m")  # a constraint fixes z
    assert row.time == "2.5 s"
    assert "no redundancy" in row.note


def test_times_are_short():
    assert time_text(float("nan")) == ""
    assert time_text(1.7e9 + 0.25) == "1700000000 s"
    assert time_text(1.7e9 + 0.25, dated=True) == "2023-11-14 22:13:20.250 UTC"


def test_alternatives_have_rows():
    problem = optloc.load(DEMO.parent / "ambiguous.toml")
    found = other_spots(problem, [optloc.solve(problem)])
    assert len(found.rows) == len(found.place) >= 1
    assert found.rows[0].status.startswith("alternative, cost gap")


def test_scans_form_one_trail_for_each_target():
    problem, fix = ranged()
    place, covariance = np.stack([fix.position, np.full(2, np.nan)]), np.stack([fix.covariance()] * 2)
    texts = {"status": ["ok", "starting"], "reason": ["", "too few rows"], "target": ["t", "t"]}
    columns = state_table(problem.frame, place, covariance, **texts) | {"time": np.array([0.0, 1.0])}
    found = scan_spots(problem, columns, ["t 1", "t 2"], np.array([True, False]))
    assert found.groups == ("t", "t")
    assert [row.size == "no position" for row in found.rows] == [False, True]


def test_a_station_in_space_has_no_place():
    problem = optloc.load(DEMO.parent.parent / "starters" / "range_rate.toml")
    assert np.isnan(station_spots(problem).place).all()
