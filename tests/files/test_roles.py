"""Roles of columns by name and by option, and stations of tables and GeoJSON."""

import json

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.files.roles import Roles, in_space, placed, places_of, scaled, with_standard_columns
from optloc.files.table import of_rows


def table(**row):
    return of_rows([row], "t.csv", {})


def test_names_suggest_roles_and_options_outweigh_them():
    held = table(station="A", x_km=1.0, y_km=2.0, Range_m=5.0, other=7.0)
    roles = Roles.of(held, {})
    assert [roles.find(role) for role in ("station", "x", "range", "lat")] == ["station", "x_km", "Range_m", None]
    assert Roles.of(held, {"range": "other"}).column("range") == "other"
    with pytest.raises(InvalidProblem, match="looks like the lat"):
        roles.column("lat")


def test_a_label_of_two_columns_joins_them():
    roles = Roles.of(table(day="mon", hour=7), {"message": "day+hour"})
    assert list(roles.labels("message")) == ["mon-7"]


def test_numbers_of_a_role_are_in_the_unit_asked_for():
    roles = Roles.of(table(name="A", x_km=1.5, y=2.0), {})
    assert scaled(roles, "x", "length", "m").tolist() == [1500.0]
    assert scaled(roles, "y", "length", "m").tolist() == [2.0]


def test_depths_are_negative_heights_and_missing_heights_are_zero():
    deep = placed(Roles.of(table(name="A", x=1.0, y=2.0, depth=30.0), {}), None)
    assert deep.columns["z"].tolist() == [-30.0]
    flat = in_space(placed(Roles.of(table(name="A", x=1.0, y=2.0), {}), None))
    assert flat.columns["z"].tolist() == [0.0]
    assert "z = 0" in flat.note


def test_points_of_geojson_are_longitude_latitude_height(tmp_path):
    path = tmp_path / "s.geojson"
    points = [{"type": "Feature", "properties": {"name": n}, "geometry": {"type": "Point", "coordinates": at}}
              for n, at in (("A", [8.5, 47.2]), ("B", [8.6, 47.3, 400.0]))]  # fmt: skip
    path.write_text(json.dumps({"type": "FeatureCollection", "features": points}))
    found = places_of(path, {}, None)
    assert found.frame == "geodetic"
    assert list(found.names) == ["A", "B"]
    assert np.array_equal(found.columns["lat_deg"], [47.2, 47.3])
    assert np.array_equal(found.columns["lon_deg"], [8.5, 8.6])
    assert np.array_equal(found.columns["height"], [0.0, 400.0])
    assert "1 of 2 points have no height" in found.note


def test_other_words_of_station_tables_become_our_names():
    found = with_standard_columns(table(receiver="A", latitude=1.0, longitude=2.0, altitude_km=0.5), "m")
    assert found.raw("name").tolist() == ["A"]
    assert [found.numbers(key).tolist() for key in ("lat_deg", "lon_deg", "height")] == [[1.0], [2.0], [500.0]]


def test_a_station_that_occurs_twice_is_named_by_its_row():
    rows = [{"name": name, "x": 1.0 * i, "y": 0.0} for i, name in enumerate(["A", "B", "A"])]
    with pytest.raises(InvalidProblem, match="the station 'A' occurs twice; give each station its own name") as refused:
        places_of(of_rows(rows, "anchors.csv", {}), {}, None)
    assert refused.value.where == "anchors.csv, row 3, column 'name'"
    assert places_of(of_rows(rows[:2], "anchors.csv", {}), {}, None).source == "anchors.csv"
