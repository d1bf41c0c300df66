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


def test_a_way_of_100_km_has_the_length_and_the_direction_of_the_geodesic():
    lat, lon, _ = carried(1e5 * EAST)
    length, azimuth = vdist(47.0, 11.0, lat, lon)
    # the way is at 3 000 m above the ellipsoid: on the ground it is shorter by height over radius of curvature
    assert length == pytest.approx(1e5 * (1.0 - 3000.0 / (6.39e6 + 3000.0)), abs=0.2)
    assert azimuth == pytest.approx(90.0, abs=1e-4)


def test_a_target_at_rest_stays():
    assert carry(tuple(START), tuple(START), 0.0) == pytest.approx(tuple(START), abs=1e-8)
