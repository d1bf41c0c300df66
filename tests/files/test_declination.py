"""Declinations by angle and by date: what a text is, its limits, and one value for each position."""

from datetime import date

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.base.frames import CARTESIAN, Frame
from optloc.files.declination import angle_of, date_of, declinations


def test_a_date_is_told_from_an_angle():
    assert date_of("2026-06-01", "here") == date(2026, 6, 1)
    assert date_of("4 deg", "here") is None
    assert date_of(0.1, "here") is None
    with pytest.raises(InvalidProblem, match="not a date"):
        date_of("2026-13-01", "here")


def test_an_angle_is_at_most_half_a_turn():
    assert angle_of("-90 deg", None, "here") == pytest.approx(-np.pi / 2)
    assert angle_of(180.0, "deg", "here") == pytest.approx(np.pi)
    with pytest.raises(InvalidProblem, match="more than half a turn"):
        angle_of("181 deg", None, "here")


def test_a_date_needs_the_earth():
    with pytest.raises(InvalidProblem, match="stations on Earth"):
        declinations(np.zeros((1, 3)), CARTESIAN, date(2026, 6, 1), "here")


def test_each_position_has_the_value_of_its_place():
    pytest.importorskip("pygeomag")
    frame, day = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0), date(2026, 6, 1)
    position = np.array([[0.0, 0.0], [400e3, 0.0], [0.0, 0.0]])
    found = declinations(position, frame, day, "here")
    assert found[0] == found[2]
    # Over Central Europe declination grows towards the east, by about 0.4 deg per degree of longitude.
    assert 1.0 < np.degrees(found[1] - found[0]) < 3.0
