"""Projection of maps: limits on the shorter way around the Earth, metres of a plane, and path data."""

import re

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.show.maps.projection import Plane, map_limits, path, shift_near, short_path


def test_a_map_goes_the_shorter_way_around_the_earth():
    west, east, south, north = map_limits([np.array([[179.0, 10.0], [-179.0, 12.0]])])
    assert west < 179.0
    assert 181.0 < east < 190.0
    assert south < 10.0
    assert north > 12.0
    with pytest.raises(InvalidProblem, match="nothing has a position"):
        map_limits([np.full((1, 2), np.nan)])


def test_longitudes_are_within_half_a_turn_of_the_middle():
    place = np.array([[-170.0, 1.0], [170.0, 2.0], [539.0, 3.0]])
    found = shift_near(place, 175.0)
    assert found[:, 0] == pytest.approx([190.0, 170.0, 179.0])
    assert found[:, 1].tolist() == [1.0, 2.0, 3.0]


def test_a_plane_in_metres_is_true_to_scale():
    limits = map_limits([np.array([[0.0, 500.0], [1000.0, 700.0]])], flat=True)
    plane = Plane(*limits, flat=True)
    at = plane(np.array([[0.0, 500.0], [1000.0, 500.0], [0.0, 600.0]]))
    assert at[1, 0] - at[0, 0] == pytest.approx(10.0 * (at[0, 1] - at[2, 1]))
    assert (np.abs(at) < plane.half).all()
    assert plane.nearest(np.array([[500.0, 1.0]])).tolist() == [[500.0, 1.0]]
    west, east, _, _ = map_limits([np.zeros((1, 2))], flat=True)
    assert 0.5 < east - west < 5.0


def test_short_paths_are_the_paths():
    rng = np.random.default_rng(3)
    line = np.cumsum(rng.normal(0.0, 3.0, (200, 2)), axis=0) - 40.0
    text = short_path([line], close=True)
    assert len(text) < 0.8 * len(path([line], close=True))
    steps = [float(part) for part in re.findall(r"-?(?:\d+\.?\d*|\.\d+)", text.partition("l")[2])]
    start = [float(part) for part in text[1:].partition("l")[0].split(" ")]
    back = np.cumsum([start, *np.reshape(steps, (-1, 2))], axis=0)
    expected = np.round(line, 1)
    kept = np.append(True, (np.diff(expected, axis=0) != 0.0).any(-1))
    np.testing.assert_allclose(back, expected[kept], atol=1e-9)
    assert short_path([np.zeros((3, 2))], close=False) == ""
