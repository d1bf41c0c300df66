"""Marks: ellipses by their axes, covariances that cover, dates, and the same as GeoJSON."""

import numpy as np
import pytest
from show.ranging import ENU, ranged

from optloc import InvalidProblem
from optloc.base.frames import CARTESIAN
from optloc.base.types import Status
from optloc.problem import ECEF
from optloc.show.columns import fix_columns
from optloc.show.formats.marks import Results, ellipse, geojson, mark_of, need_earth


@pytest.mark.parametrize("bearing", [0.0, 30.0, 90.0, 150.0])
def test_an_ellipse_has_the_bearing_of_its_long_axis(bearing):
    way = np.array([np.sin(np.radians(bearing)), np.cos(np.radians(bearing))])
    found = ellipse(1.0 * np.eye(2) + 8.0 * np.outer(way, way))
    assert found[:2] == pytest.approx((3.0, 1.0))
    assert (found[2] - bearing + 90.0) % 180.0 == pytest.approx(90.0, abs=1e-9)


def mark(status="ok", time=np.nan, velocity=None, dated=False):
    place = ECEF.from_geodetic(np.radians(47.0), np.radians(8.0), 400.0)
    axes = ECEF.enu_axes(place)
    cov = axes.T @ np.diag([1.0, 4.0, 9.0]) @ axes
    return mark_of(ECEF, place, cov, status, velocity=velocity, name="m", target="m", time=time, dated=dated)


def test_a_mark_is_level_on_earth():
    found = mark(velocity=ECEF.enu_axes(mark().position)[1] * 5.0)
    assert found.place == pytest.approx([8.0, 47.0, 400.0])
    assert found.level == pytest.approx(np.diag([1.0, 4.0, 9.0]), abs=1e-9)
    assert found.velocity == pytest.approx([0.0, 5.0, 0.0], abs=1e-12)
    assert found.words.startswith(f"ok. {Status.OK.sentence} latitude: 47.000000")
    assert "sigma east, north, up: 1, 2, 3 m" in found.words


def test_what_is_not_ok_has_a_position_without_a_covariance():
    found = mark("ambiguous")
    assert (found.known, found.sure, found.covers) == (True, False, False)
    assert "if this position is correct" in found.words


def test_only_times_since_1970_are_dates():
    assert mark(time=1_700_000_000.5).date is None
    assert mark(dated=True).date is None
    assert mark(time=1_700_000_000.5, dated=True).date.isoformat() == "2023-11-14T22:13:20.500000+00:00"
    assert mark(time=-86400.0, dated=True).date.isoformat() == "1969-12-31T00:00:00+00:00"


def test_geojson_has_stations_fix_and_an_ellipse_that_holds_the_fix():
    problem, fix = ranged()
    features = geojson(Results(fix_columns(fix), ENU, (fix,), problem))["features"]
    assert [one["properties"]["role"] for one in features] == ["station"] * 4 + ["fix", "ellipse95"]
    ring = np.array(features[-1]["geometry"]["coordinates"][0])[:, :2]
    middle = (ring.min(0) + ring.max(0)) / 2.0
    assert middle == pytest.approx(features[-2]["geometry"]["coordinates"][:2], abs=1e-7)


def test_positions_on_a_map_need_the_earth():
    with pytest.raises(InvalidProblem, match="GeoJSON needs positions on Earth"):
        need_earth(CARTESIAN, "GeoJSON", "x")
