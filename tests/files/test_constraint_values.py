"""Keys of constraints as SI values: units, points on Earth, and wrong numbers of coordinates."""

import numpy as np
import pytest

from optloc import Frame, InvalidProblem, Motion, station_array
from optloc.base.frames import CARTESIAN, ECEF
from optloc.files.constraint_values import ConstraintValues

ENU = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)


def values(given, d=3, frame=ENU, kind="disc"):
    stations = station_array(np.zeros((2, d)))
    return ConstraintValues(kind, given, stations, frame, Motion(), np.zeros(1), ("a", "b"), 0, "x.toml", 340.0)


def test_amounts_have_units():
    found = values({"radius": "2 km", "min": 3.0, "max": "4000 m", "unit": "km", "x": "2 s"})
    assert (found.amount("radius"), found.bounds("length"), found.amount("x")) == (2000.0, (3000.0, 4000.0), 680.0)
    assert np.isnan(found.amount("y"))
    assert values({"max": 3.0, "unit": "deg/s"}).rate("max") == "3.0 deg/s"
    assert values({"max": 3.0}).rate("max") == 3.0
    assert values({"name": "hall"}).naming == {"name": "hall"}
    assert values({}).naming == {}


def test_points_in_the_frame_and_on_earth():
    assert values({"x": "1 km", "y": 2.0}).point(2).tolist() == [1000.0, 2.0]
    place = ENU.from_geodetic(np.radians(47.01), np.radians(8.02), 500.0)
    found = values({"lat_deg": 47.01, "lon_deg": 8.02, "height": 500.0}).point(3)
    np.testing.assert_allclose(found, place, atol=1e-6)
    plan = values({"points_deg": [[47.01, 8.02], [47.0, 8.0]]}).points("points", (2, 3))
    np.testing.assert_allclose(plan[1], [0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(plan[0], place[:2], atol=0.1)
    assert values({"normal": [3.0, 4.0]}).direction().tolist() == [3.0, 4.0, 0.0]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: values({"radius": 0.0}).positive("radius"), "the radius is not positive"),
        (lambda: values({"radius": [1.0]}).positive("radius"), "disc has one number, not a list"),
        (lambda: values({"radius": "3 deg"}).positive("radius"), "'deg'"),
        (lambda: values({"max": [1.0]}).rate("max"), "one bound"),
        (lambda: values({"x": 1.0}).point(2), "disc has no 'y'"),
        (lambda: values({"x": 1.0, "lat_deg": 1.0, "lon_deg": 1.0}).point(2), "the centre is given twice"),
        (lambda: values({"lat_deg": 1.0, "lon_deg": 1.0}).point(3), "has no 'height'"),
        (lambda: values({"lat_deg": 97.0, "lon_deg": 1.0}).point(2), "latitude 97"),
        (lambda: values({"lat_deg": 7.0, "lon_deg": 1.0}, frame=CARTESIAN).point(2), "need an enu frame"),
        (lambda: values({}, frame=ECEF).plan(), "needs a plan, and the frame is ECEF"),
        (lambda: values({"points": [[0, 0], [1]]}).points("points", (2, 3)), "point 2 has 1 coordinates"),
        (lambda: values({"points": [[0, 0]], "points_deg": []}).points("points", (2,)), "given twice"),
        (lambda: values({"normal": [0.0, 0.0]}).direction(), "normal is zero"),
        (lambda: values({"normal": [0.0, 0.0, 1.0]}, d=2).direction(), "3 coordinates, not 2"),
    ],
)
def test_a_mistake_names_the_key(call, words):
    with pytest.raises(InvalidProblem, match=words) as error:
        call()
    assert str(error.value).startswith("x.toml")
