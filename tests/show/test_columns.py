"""Fixes as columns: covariances in named axes, level coordinates, tables below each other, and JSON."""

import json

import numpy as np
import pytest
from show.ranging import ENU, ranged

from optloc.base.records import join
from optloc.problem import ECEF
from optloc.show.columns import (
    covariance_columns,
    fix_columns,
    fix_detail,
    geodetic_columns,
    join_tables,
    level_covariance,
    plain,
    records,
    without_open,
)


def test_columns_of_a_fix_are_its_numbers():
    _, fix = ranged()
    found = fix_columns(fix)
    assert [found["x"][0], found["y"][0]] == fix.position.tolist()
    assert [found["sigma_x"][0], found["sigma_y"][0]] == pytest.approx(fix.sigma().tolist())
    assert found["cov_xy"][0] == fix.covariance()[0, 1]
    assert found["status"].tolist() == [fix.status.label]


def test_level_coordinates_turn_the_covariance():
    place = ECEF.from_geodetic(np.radians(40.0), np.radians(30.0), 100.0)
    axes = ECEF.enu_axes(place)
    found = geodetic_columns(ECEF, place[None], (axes.T @ np.diag([1.0, 4.0, 9.0]) @ axes)[None])
    assert [found[name][0] for name in ("lat_deg", "lon_deg", "height")] == pytest.approx([40.0, 30.0, 100.0])
    assert level_covariance(found, 0) == pytest.approx(np.diag([1.0, 4.0, 9.0]), abs=1e-9)


def test_upper_triangles_have_their_axes():
    cov = np.arange(9.0).reshape(1, 3, 3)
    assert {name: v[0] for name, v in covariance_columns(cov, "enu").items()} == {
        "cov_ee": 0.0, "cov_en": 1.0, "cov_eu": 2.0, "cov_nn": 4.0, "cov_nu": 5.0, "cov_uu": 8.0,
    }  # fmt: skip


def test_what_is_not_determined_is_named_and_hidden():
    hidden, names = without_open(np.ones((2, 2, 2)), np.array([[False, True], [False, False]]), "xy")
    assert names == ["y", ""]
    assert np.array_equal(hidden[0], [[1.0, np.nan], [np.nan, np.nan]], equal_nan=True)
    assert (hidden[1] == 1.0).all()


def test_tables_below_each_other_lack_columns_as_nan():
    found = join_tables([{"a": np.array([1.0])}, {"a": np.array([2.0]), "b": np.array([3.0])}])
    assert records(found) == [{"a": 1.0, "b": None}, {"a": 2.0, "b": 3.0}]


def test_json_of_a_fix_has_no_arrays_and_no_infinities():
    _, fix = ranged()
    assert json.loads(json.dumps(plain(fix_detail(fix)), allow_nan=False))["unchecked"] is False
    assert plain({"a": (np.float64(np.inf), np.int8(2))}) == {"a": [None, 2]}
    assert ENU.geodetic
    assert len(records(fix_columns(join([fix.flat(), fix.flat()], 2)))) == 2
