"""Starts of one position: closed forms at the target of exact data, known heights, and where to look beside."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import Frame, Motion, assemble, constraints, measured
from optloc.base.frames import ECEF, geodetic_to_ecef
from optloc.solvers.starts.position import (
    along_the_valley,
    distance_of,
    height_starts,
    is_registration_run,
    known_height,
    over_ground,
    spread_of,
    squared_range_starts,
    subarray_starts,
)
from optloc.solvers.starts.squared_range import stationary_points

PEAK = geodetic_to_ecef(np.radians(47.0), np.radians(8.0), 1500.0)


def nearest(starts, place):
    return np.nanmin(np.linalg.norm(starts - place, axis=-1))


def from_satellites(kind="range"):
    up = PEAK / np.linalg.norm(PEAK)
    side = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [-0.5, 0.2, 0.6]])
    stations = 2.6e7 * (up + 0.5 * side) / np.linalg.norm(up + 0.5 * side, axis=1, keepdims=True)
    r = np.linalg.norm(PEAK - stations, axis=1)
    if kind == "range":
        rows = measured("range", r[:2], a=[0, 1], sigma=5.0)
    else:
        rows = measured("tdoa", r[1:3] - r[0], a=[1, 2], b=0, sigma=5.0)
    held = tuple(constraints.height(1500.0, 1500.0))
    return assemble(stations, rows, frame=ECEF, constraints=held).flat()


def test_centre_and_spread_are_those_of_the_stations():
    problem = ranges_to([3.0, 4.0], 1.0, stations=np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 2.0], [0.0, -2.0]]))
    centre, spread = spread_of(problem)
    np.testing.assert_allclose(centre, [[0.0, 0.0]], atol=1e-12)
    assert spread[0] == pytest.approx(2.0)
    assert distance_of(problem, np.array([[3.0, 4.0]]))[0] == pytest.approx(2.5)


@pytest.mark.parametrize("kind", ["range", "tdoa"])
def test_two_rows_and_a_height_meet_at_the_target(kind):
    problem = from_satellites(kind)
    assert known_height(problem).tolist() == [1500.0]
    assert over_ground(problem)
    assert nearest(height_starts(problem)[0], PEAK) < 0.1


def test_without_a_height_there_is_no_such_start():
    problem = replace(from_satellites(), constraints=())
    assert known_height(problem) is None
    assert height_starts(problem).shape == (1, 0, 3)
    assert not over_ground(ranges_to(PLACE, 1.0))


def test_a_measured_height_is_known_where_it_is_present():
    frame = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
    stations = np.column_stack([SQUARE, np.zeros(5)])
    rows = [measured("range", np.ones(5), a=np.arange(5), sigma=1.0), measured("height", [730.0], sigma=5.0)]
    problem = assemble(stations, *rows, frame=frame).flat()
    assert known_height(problem).tolist() == [730.0]
    absent = problem.with_rows(weight=np.array([[1.0] * 5 + [0.0]]))
    assert np.isnan(known_height(absent)).all()


def test_all_arrays_that_lack_a_station_start_exact_data_at_the_target():
    problem = ranges_to(PLACE, 1.0)
    assert nearest(squared_range_starts(problem, stationary_points)[0], PLACE) < 1e-6
    starts = subarray_starts(problem)[0]
    # five arrays of four stations, each with the target among its points
    assert (np.linalg.norm(starts - PLACE, axis=-1) < 1e-6).sum() >= 5


def test_other_minima_are_looked_for_along_the_line_and_the_longest_axis():
    problem = ranges_to(PLACE, 1.0)
    centre, spread = spread_of(problem)
    far = centre + 20.0 * spread * np.array([[1.0, 0.0]])
    points = along_the_valley(problem, far, np.diag([4.0, 100.0])[None])[0]
    assert len(points) == 7 + 2 + 8
    np.testing.assert_allclose(points[:9, 1], centre[0, 1])
    np.testing.assert_allclose(points[9:, 0], far[0, 0])
    np.testing.assert_allclose(np.abs(points[9:, 1] - far[0, 1]), 10.0 * np.array([12, 6, 3, 1.5, 1.5, 3, 6, 12]))
    assert np.isnan(along_the_valley(problem, far, np.full((1, 2, 2), np.nan))[0, 9:]).all()


def test_a_run_of_ranges_with_a_moving_target_is_registrable():
    rows = measured("range", np.ones(10), a=np.tile(np.arange(5), 2), epoch=np.repeat([0, 1], 5), sigma=1.0)
    assert is_registration_run(assemble(SQUARE, rows, times=[0.0, 1.0], motions=(Motion(1),)).flat())
    assert not is_registration_run(assemble(SQUARE, rows, times=[0.0, 1.0]).flat())
    assert not is_registration_run(ranges_to(PLACE, 1.0))
