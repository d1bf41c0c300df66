"""The feed of a live map: places, ellipse and texts of a fix, on Earth and in a plane."""

import numpy as np
import pytest
from show.ranging import ENU, ranged

from optloc.base.types import Status
from optloc.problem import CARTESIAN
from optloc.show import live_mark, mark_of


def test_a_fix_on_earth_has_degrees_and_an_ellipse():
    problem, fix = ranged()
    mark = mark_of(ENU, fix.position, fix.covariance(), "ok", name="a", target="a", time=float("nan"), others=())
    found = live_mark(problem.frame, mark, [fix.position, fix.position + 10.0])
    lat, lon, _ = fix.geodetic
    assert found["at"] == pytest.approx(np.degrees([lon, lat]), abs=1e-8)
    assert found["trail"][0] == found["at"]
    assert found["trail"][1] != found["at"]
    major, minor, bearing = found["ellipse"]
    assert major >= minor > 0.0
    assert 0.0 <= bearing < 180.0
    assert (found["name"], found["time"], found["look"], found["status"]) == ("a", "", "ok", "ok")
    assert found["place"] == found["copied"]


def test_a_status_without_a_valid_covariance_has_no_ellipse():
    named = {"name": "a", "target": "a", "time": 1.7e9, "texts": {"reason": "why"}}
    found = live_mark(CARTESIAN, mark_of(CARTESIAN, np.array([3.0, 4.0]), np.eye(2), "misfit", **named))
    assert found["at"] == [3.0, 4.0]
    assert found["ellipse"] is None
    assert found["look"] == "bad"
    assert found["note"] == "why"
    assert found["sentence"] == Status.MISFIT.sentence
    assert found["size"].startswith("sigma x, y: 1, 1 m; 95 % radius: not valid")
