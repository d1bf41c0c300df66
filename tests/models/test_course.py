"""Courses over ground."""

import numpy as np
import pymap3d
import pytest
from pymap3d.vincenty import vdist

from optloc.models.course import carry

START = np.array(pymap3d.geodetic2ecef(47.0, 11.0, 3000.0))
EAST = np.array([-np.sin(np.radians(11.0)), np.cos(np.radians(11.0)), 0.0])
UP = np.array(pymap3d.enu2uvw(0.0, 0.0, 1.0, 47.0, 11.0))


def carried(way, rise=0.0):
    return pymap3d.ecef2geodetic(*carry(tuple(START), tuple(START + way), rise))


@pytest.mark.parametrize(("climb", "rise"), [(0.0, 0.0), (800.0, 0.0), (-500.0, 120.0)])
def test_a_level_way_keeps_the_height_and_climb_and_rise_add_to_it(climb, rise):
    assert carried(5e4 * EAST + climb * UP, rise)[2] == pytest.approx(3000.0 + climb + rise, abs=1e-7)


@pytest.mark.parametrize(("way", "within"), [(1e5, 0.03), (5e5, 2.0)])
def test_a_way_on_the_ground_has_the_length_and_the_direction_of_the_geodesic(way, within):
    ground = START - 3000.0 * UP
    lat, lon, height = pymap3d.ecef2geodetic(*carry(tuple(ground), tuple(ground + way * EAST), 0.0))
    length, azimuth = vdist(47.0, 11.0, lat, lon)
    assert length == pytest.approx(way, abs=within)
    assert azimuth == pytest.approx(90.0, abs=1e-3)
    assert height == pytest.approx(0.0, abs=1e-7)


def test_a_way_high_above_the_ground_is_shorter_there_by_height_over_radius():
    high = START + 1e5 * UP
    lat, lon, _ = pymap3d.ecef2geodetic(*carry(tuple(high), tuple(high + 1e4 * EAST), 0.0))
    radius = 6.3896e6  # of curvature towards east at 47 degrees
    assert vdist(47.0, 11.0, lat, lon)[0] == pytest.approx(1e4 * radius / (radius + 1.03e5), abs=0.5)


def test_a_target_at_rest_stays():
    assert carry(tuple(START), tuple(START), 0.0) == pytest.approx(tuple(START), abs=1e-8)
