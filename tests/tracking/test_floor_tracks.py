"""Tracks of a target that stays on one of several floors."""

import numpy as np
import pytest

from optloc.base.types import Motion, Status
from optloc.linear import constraints
from optloc.problem.build import assemble, measured
from optloc.tracking.dynamics import polynomial
from optloc.tracking.floor_tracks import UNDECIDED, track_on_floors

ANCHORS = np.array([[0.0, 0, 4], [20, 0, 4], [20, 12, 4], [0, 12, 4], [10, 6, 5.5]])


def run_at(height, anchors=ANCHORS, count=20, sigma=0.05):
    """Return a run of ranges to a cart that drives at a height, with a band of heights from 0 to 14 m."""
    times = 0.5 * np.arange(count)
    place = np.stack([4.0 + times, 3.0 + 0.5 * times, np.full(count, height)], axis=1)
    z = np.linalg.norm(place[:, None] - anchors, axis=-1) + sigma * np.random.default_rng(3).normal(
        size=(count, len(anchors))
    )
    station, epoch = np.tile(np.arange(len(anchors)), count), np.repeat(np.arange(count), len(anchors))
    rows = measured("range", z.ravel(), a=station, epoch=epoch, sigma=sigma)
    band = constraints.box([-np.inf, -np.inf, 0.0], [np.inf, np.inf, 14.0])[2:]
    motion = Motion(order=1)
    return assemble(anchors, rows, times=times, motions=(motion,), constraints=band), place


@pytest.mark.parametrize("height", [1.0, 10.5])
def test_the_floor_with_the_least_cost_is_found(height):
    problem, place = run_at(height, count=10)
    found = track_on_floors(problem, (1.0, 4.5, 10.5), polynomial(1, 0.5))
    assert found.height == height
    assert found.margin > 9.0
    assert found.entries[-1].code == Status.OK
    assert np.abs(found.entries[-1].updated.mean[:3] - place[-1]).max() < 0.3


def test_two_floors_that_fit_as_well_are_ambiguous():
    # 1 m and 7 m have the same distance from the plane of these anchors
    problem, _ = run_at(1.0, ANCHORS[:4])
    found = track_on_floors(problem, (1.0, 7.0), polynomial(1, 0.5))
    assert found.margin < 9.0
    codes = {entry.code for entry in found.entries if np.isfinite(entry.updated.nis)}
    assert codes == {Status.AMBIGUOUS}
    assert found.entries[-1].reason == UNDECIDED
