"""Grids of places, and the bound at each."""

import numpy as np
import pytest

from optloc import InvalidProblem, Motion, assemble, measured
from optloc.bounds.over_area import bound_map, extent, grid_of, map_coordinates
from optloc.problem import ECEF

SQUARE = np.array([[-1e3, -1e3], [1e3, -1e3], [1e3, 1e3], [-1e3, 1e3]])


def ranges(**more):
    return assemble(SQUARE, measured("range", a=np.arange(4), sigma=2.0), **more)


def test_two_pairs_of_perpendicular_ranges_bound_each_axis_by_the_root_of_half_the_variance():
    found = bound_map(ranges(), np.zeros(2), [0.0], [0.0])
    # each axis has the information of 4 ranges at 45 degrees, 4 cos(45)^2 / sigma^2
    assert found.horizontal[0] == pytest.approx([2.0])
    assert found.dilution[0] == pytest.approx([1.0])
    assert np.isnan(found.vertical).all()


def test_the_columns_of_a_grid_go_along_x():
    grid = grid_of(ranges(), [0.0, 1.0, 2.0], [10.0, 20.0], 0.0)
    assert grid.shape == (2, 3)
    assert grid.places.tolist() == [[0, 10], [1, 10], [2, 10], [0, 20], [1, 20], [2, 20]]


def test_a_grid_in_degrees_is_at_its_height_on_earth_unless_metres_are_asked_for():
    places = ECEF.from_geodetic(np.radians([47.0, 47.1, 47.0]), np.radians([11.0, 11.0, 11.1]), np.zeros(3))
    problem = assemble(places, measured("range", a=[0, 1, 2], sigma=1.0), frame=ECEF)
    grid = grid_of(problem, [11.05], [47.05], 2000.0)
    assert grid.geodetic
    assert map_coordinates(ECEF, grid.places, True)[0] == pytest.approx([11.05, 47.05, 2000.0])
    assert grid.stations[2] == pytest.approx([11.1, 47.0])
    assert grid_of(problem, [1.0], [2.0], 3.0, geodetic=False).places.tolist() == [[1.0, 2.0, 3.0]]


def test_an_extent_holds_stations_and_places_with_a_margin_of_the_larger_side():
    assert extent(ranges(), np.array([[3e3, 0.0], [np.nan, 1.0]]), widen=0.5) == (-3e3, 5e3, -3e3, 3e3)


def test_coordinates_of_a_map_are_degrees_on_earth_and_metres_elsewhere():
    place = ECEF.from_geodetic(np.radians([47.0]), np.radians([11.0]), np.array([500.0]))
    assert map_coordinates(ECEF, place, True)[0] == pytest.approx([11.0, 47.0, 500.0])
    assert map_coordinates(ECEF, place, False) is place


def test_a_map_moves_one_target_of_a_whole_run():
    with pytest.raises(InvalidProblem, match="0 targets are unknown"):
        bound_map(ranges(motions=(Motion(known=np.zeros((1, 1, 2))),)), np.zeros(0), [0.0], [0.0])
    with pytest.raises(InvalidProblem, match="every epoch has a separate position"):
        bound_map(ranges(motions=(Motion(span="epoch"),)), np.zeros(2), [0.0], [0.0])
