"""Quantities that constraints bound."""

import numpy as np
import pymap3d
import pytest

from optloc.models.primitives import Point
from optloc.models.surfaces import SURFACES

PLACE = pymap3d.geodetic2ecef(47.0, 11.0, 900.0)


def test_a_plane_is_a_linear_form_of_the_position():
    assert SURFACES["plane"].g(Point((1.0, 2.0, 3.0)), (0.5, -1.0, 2.0)) == 4.5


def test_a_speed_is_the_length_of_the_velocity():
    assert SURFACES["speed"].g(Point((0.0, 0.0), (30.0, -40.0)), ()) == 50.0


def test_a_height_is_geodetic():
    assert SURFACES["height"].g(Point(PLACE, ecef=PLACE), ()) == pytest.approx(900.0, abs=1e-6)


@pytest.mark.parametrize("elevation", [-20.0, 5.0, 80.0])
def test_a_visible_point_has_the_sine_of_its_elevation_above_the_horizon(elevation):
    satellite = pymap3d.aer2ecef(130.0, elevation, 2e7, 47.0, 11.0, 900.0)
    found = SURFACES["visible"].g(Point(PLACE, ecef=PLACE), satellite)
    assert found == pytest.approx(np.sin(np.radians(elevation)), abs=1e-9)


def test_points_carry_what_the_table_says_that_each_surface_takes():
    for surface in SURFACES.values():
        point = Point((1e3, 2e3, 3e3), (1.0, 2.0, 2.0) if surface.velocity else None)
        point = Point(point.position, point.velocity, ecef=PLACE if surface.ecef else None)
        count = 3 if surface.coefficients < 0 else surface.coefficients
        assert np.isfinite(surface.g(point, (1.0, 2.0, 3.0)[:count]))
