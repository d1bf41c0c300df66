"""Tracks of a target at a known height in a frame that is not on Earth."""

import numpy as np
import pytest

from optloc.linear import constraints
from optloc.problem.build import assemble, measured, station_array
from optloc.problem.epochs import separable
from optloc.problem.problem import Problem
from optloc.tracking.level_plane import is_level, level_of
from optloc.tracking.run import track

ANCHORS = np.array([[0, 0, 4], [20, 0, 4], [20, 12, 4], [0, 12, 4]], dtype=float)


def hall(count: int = 12) -> tuple[Problem, np.ndarray]:
    """Return a run of ranges to a cart at 1.2 m below anchors in one plane, and its path."""
    rng = np.random.default_rng(3)
    path = np.array([[4.0 + 0.5 * i, 5.0 + 0.2 * i, 1.2] for i in range(count)])
    z = np.linalg.norm(path[:, None] - ANCHORS, axis=-1) + 0.02 * rng.standard_normal((count, 4))
    epoch = np.repeat(np.arange(count), 4)
    rows = measured("range", z.ravel(), a=np.tile(np.arange(4), count), epoch=epoch, sigma=0.02)
    plane = constraints.box([-np.inf, -np.inf, 1.2], [np.inf, np.inf, 1.2])
    return assemble(station_array(ANCHORS), rows, times=np.arange(float(count)), constraints=plane[2:]), path


def test_a_horizontal_plane_is_known():
    plane = constraints.box([-np.inf, -np.inf, 1.2], [np.inf, np.inf, 1.2])
    assert [is_level(band) for band in plane] == [False, False, True]
    band = constraints.box([0.0, 0.0, 0.0], [0.0, 9.0, 3.0])
    assert not any(map(is_level, band))


def test_every_state_is_at_the_height():
    problem, path = hall()
    assert level_of(problem) == 1.2
    assert separable(problem) or problem.epochs == 12
    found = track(problem, "cv")
    states = found.mean[3:]
    assert states[:, 2] == pytest.approx(1.2, abs=0.01)
    # without the height, the plane of the anchors has a second position, at 6.8 m
    assert np.abs(states[:, :2] - path[3:, :2]).max() < 0.15
