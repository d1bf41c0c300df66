"""Starts from angles: exact without noise, for places and for courses."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import Motion, assemble, measured
from optloc.solvers.starts.angles import (
    bearings,
    by_directions,
    course_starts,
    course_states,
    instrumental,
    least_worst,
    pair,
)

A = np.arange(5)
HILLS = np.column_stack([SQUARE, [0.0, 100.0, 50.0, 200.0, 20.0]])
ALOFT = np.array([300.0, 650.0, 400.0])


def angles(place, stations):
    line = np.asarray(place) - stations
    return np.arctan2(line[..., 1], line[..., 0]), np.arcsin(line[..., 2] / np.linalg.norm(line, axis=-1))


def in_space(sigma=0.01):
    azimuth, elevation = angles(ALOFT, HILLS)
    rows = [measured("azimuth", azimuth, a=A, sigma=sigma), measured("elevation", elevation, a=A, sigma=sigma)]
    return assemble(HILLS, *rows).flat()


@pytest.mark.parametrize(("start", "within"), [(instrumental, 1e-6), (by_directions, 1.0), (least_worst, 20.0)])
def test_exact_bearings_start_at_the_target(start, within):
    found = start(bearings(in_space()))
    assert found.shape == (1, 1, 3)
    assert np.linalg.norm(found[0, 0] - ALOFT) < within


def test_bearings_pair_an_elevation_with_the_azimuth_of_its_station():
    azimuth, elevation = angles(ALOFT, HILLS)
    rows = [measured("azimuth", azimuth, a=A, sigma=0.02), measured("elevation", elevation[[3]], a=[3], sigma=0.01)]
    seen = bearings(assemble(HILLS, *rows).flat())
    assert seen.angle[0, 3, 1] == pytest.approx(elevation[3])
    assert np.flatnonzero(seen.weight[0, :, 1]).tolist() == [3]
    np.testing.assert_allclose(seen.weight[0, :, 0], 50.0)
    np.testing.assert_allclose(seen.metres(seen.station), HILLS[None], atol=1e-9)
    assert bearings(ranges_to(PLACE, 1.0)) is None


def test_a_course_follows_from_the_bearings_of_a_station_that_turns():
    times = np.linspace(0.0, 100.0, 12)
    own = np.stack([10.0 * times, 300.0 * np.sin(times / 20.0)], axis=-1)[:, None]
    place = np.array([2000.0, 1500.0]) + times[:, None] * np.array([-5.0, 3.0])
    azimuth = np.arctan2(*(place - own[:, 0]).T[::-1])
    rows = measured("azimuth", azimuth, a=np.zeros(12, dtype=int), epoch=np.arange(12), sigma=1e-3)
    problem = assemble(own, rows, times=times, motions=(Motion(1),)).flat()
    found = course_states(problem)
    np.testing.assert_allclose(found[0], [[2000.0, 1500.0], [-5.0, 3.0]], rtol=1e-6)
    assert course_states(ranges_to(PLACE, 1.0)) is None


def test_a_bistatic_pair_gives_the_course_in_closed_form():
    times = np.array([0.0, 10.0, 20.0])
    place = ALOFT + times[:, None] * np.array([20.0, -10.0, 5.0])
    azimuth, elevation = angles(place, HILLS[0])
    total = np.linalg.norm(place - HILLS[0], axis=1) + np.linalg.norm(place - HILLS[2], axis=1)
    epoch, home = np.arange(3), np.zeros(3, dtype=int)
    rows = [
        measured("range_sum", total, a=home, b=home + 2, epoch=epoch, sigma=5.0),
        measured("azimuth", azimuth, a=home, epoch=epoch, sigma=0.01),
        measured("elevation", elevation, a=home, epoch=epoch, sigma=0.01),
    ]
    problem = assemble(HILLS, *rows, times=times, motions=(Motion(1),)).flat()
    assert pair(problem) == (0, 2)
    np.testing.assert_allclose(course_starts(problem)[0], [ALOFT, [20.0, -10.0, 5.0]], rtol=1e-6)
    assert pair(in_space()) is None
