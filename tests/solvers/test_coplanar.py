"""Targets near the plane of all stations: both sides are one region there, and two minima far from it."""

import numpy as np
import pytest
from model_checks.small import SQUARE, ranges_to

from optloc import Status
from optloc.solvers.coplanar import join_sides
from optloc.solvers.stages import lsr, roots

FLOOR = np.column_stack([SQUARE, np.zeros(5)])


def settled(height, sigma=2.0):
    problem = ranges_to([300.0, 650.0, height], sigma, np.array([1.0, -2.0, 0.5, 1.5, -1.0]), stations=FLOOR)
    return problem, lsr(problem, roots(problem, None))


def test_both_sides_of_the_plane_are_a_pair_near_it():
    problem, pool = settled(15.0)
    if pool.pair is None:
        pool = join_sides(problem, pool)
    first, second = pool.pair[0]
    np.testing.assert_allclose(first[:2], second[:2], atol=1e-6)
    assert first[2] == pytest.approx(-second[2])
    assert pool.code[0, 0] == Status.OK
    # the second moment about the plane, not the width of one side
    assert pool.curvature.covariance[0, 2, 2] > first[2] ** 2


def test_far_from_the_plane_nothing_is_joined():
    problem, pool = settled(500.0)
    assert pool.pair is None
    assert join_sides(problem, pool) is pool
    # both mirror images are minima of their own
    assert sorted(np.sign(pool.x[0, :2, 2])) == [-1.0, 1.0]


def test_stations_that_fill_space_have_no_sides():
    stations = FLOOR + np.outer(np.arange(5.0), [0.0, 0.0, 150.0])
    problem = ranges_to([300.0, 650.0, 100.0], 2.0, stations=stations)
    pool = lsr(problem, roots(problem, None))
    assert join_sides(problem, pool) is pool
