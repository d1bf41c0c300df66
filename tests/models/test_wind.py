"""Paths of sound through moving air, and fixes in it."""

import numpy as np
import pytest

from optloc import InvalidProblem, locate
from optloc.models import Wind
from optloc.models.primitives import Point

ROOFS = np.array([[0, 0], [620, 80], [180, 540], [760, 690], [-310, 380], [350, -290]], dtype=float)


def flights(shot, wind, speed):
    """Return the times of flight from a shot to the roofs, s: a sphere of sound whose centre drifts with the wind."""
    line = ROOFS - shot
    along, rest = line @ wind, speed**2 - wind @ wind
    return (np.sqrt(along**2 + rest * (line**2).sum(1)) - along) / rest


def test_a_wave_arrives_where_its_drifting_sphere_meets_the_station():
    wind = Wind((6.0, -3.0, 1.0), 340.0)
    shot, station = np.array([10.0, 20.0, 3.0]), np.array([310.0, -70.0, 12.0])
    time = wind.path(Point(tuple(shot)), Point(tuple(station))) / 340.0
    radius = np.linalg.norm(station - shot - np.array(wind.velocity) * time)
    assert radius == pytest.approx(340.0 * time, rel=1e-12)


def test_the_gradients_are_the_derivatives_of_the_path():
    wind, step = Wind((6.0, -3.0), 340.0), 1e-4
    shot, station = (10.0, 20.0), (310.0, -70.0)
    at_t, at_a = wind.gradients(Point(shot), Point(station))
    for axis in (0, 1):
        moved = tuple(v + step * (i == axis) for i, v in enumerate(station))
        slope = (wind.path(Point(shot), Point(moved)) - wind.path(Point(shot), Point(station))) / step
        assert slope == pytest.approx(at_a[axis], abs=1e-6)
        assert at_t[axis] == -at_a[axis]


def test_a_shot_in_the_wind_is_found_without_a_correction_by_hand():
    shot, wind = np.array([310.0, 260.0]), np.array([6.0, -3.0])
    times = 12.0 + flights(shot, wind, 336.0)
    names = [f"m{i}" for i in range(6)]
    arrivals = dict(zip(names, times, strict=True))
    places = dict(zip(names, ROOFS.tolist(), strict=True))
    fix = locate(places, toa=arrivals, sigma="2 ms", wave_speed=Wind((6.0, -3.0), 336.0))
    assert fix.position == pytest.approx(shot, abs=1e-3)
    assert float(fix.cost) == pytest.approx(0.0, abs=1e-6)
    assert fix.status.label == "ok"
    assert fix.certificate.proof == "global"
    still = locate(places, toa=arrivals, sigma="2 ms", wave_speed=336.0)
    assert np.linalg.norm(still.position - shot) > 5.0


def test_wrong_winds_are_refused():
    with pytest.raises(InvalidProblem, match="above half of the wave speed"):
        Wind((200.0, 0.0), 340.0)
    with pytest.raises(InvalidProblem, match="has 1 components"):
        Wind((2.0,), 340.0)
    with pytest.raises(InvalidProblem, match="has 1 components"):
        Wind(340.0, (2.0, 0.0))
    places = {"A": (0, 0), "B": (9, 0), "C": (0, 9), "D": (9, 9)}
    with pytest.raises(InvalidProblem, match="the stations have two"):
        locate(places, ranges=dict.fromkeys(places, 6.0), sigma=0.1, wave_speed=Wind((1.0, 0.0, 0.0), 340.0))
