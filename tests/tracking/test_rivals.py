"""Tracks that begin at an ambiguous start: they are not `ok` before the other states are refuted."""

import numpy as np
import pytest

from optloc import Motion, Status, assemble, measured
from optloc.solvers.policy import AMBIGUOUS_GAP
from optloc.tracking import State, polynomial, tracked
from optloc.tracking.entry import Entry
from optloc.tracking.rivals import Rival, remaining
from optloc.tracking.updates import Updated

LINE = np.array([[0.0, 0.0], [60.0, 0.0], [120.0, 0.0]])


def ranges(stations, heard, seed):
    """Return a run by ranges with a sigma of 1 m, `heard` (k, s) says of which stations, and the places (k, 2)."""
    rng = np.random.default_rng(seed)
    place = np.array([20.0, 50.0]) + np.arange(len(heard))[:, None] * np.array([1.5, 0.4])
    epoch, station = np.nonzero(heard)
    z = np.linalg.norm(place[epoch] - stations[station], axis=1) + rng.standard_normal(len(epoch))
    rows = measured("range", z, a=station, sigma=1.0, epoch=epoch)
    return assemble(stations, rows, times=np.arange(len(heard), dtype=float), motions=(Motion(1),)), place


@pytest.mark.parametrize("seed", range(3))
def test_a_mirror_image_that_no_scan_refutes_keeps_a_track_ambiguous(seed):
    problem, _ = ranges(LINE, np.ones((40, 3), dtype=bool), seed)
    entries = list(tracked(problem, polynomial(1, 0.3)))
    followed = [entry for entry in entries if entry.event == ""]
    assert followed
    assert {entry.code for entry in followed} == {Status.AMBIGUOUS}
    assert "other state" in followed[-1].reason


@pytest.mark.parametrize("seed", range(6))
def test_a_station_off_the_line_refutes_the_mirror_image(seed):
    # The fourth station is heard after the longest stretch that a start takes.
    stations = np.vstack([LINE, [60.0, 90.0]])
    heard = np.ones((70, 4), dtype=bool)
    heard[:40, 3] = False
    problem, place = ranges(stations, heard, seed)
    entries = list(tracked(problem, polynomial(1, 0.3)))
    assert all(entry.code != Status.OK for entry in entries[:40] if entry.event == "")
    late = entries[-10:]
    assert all(entry.code == Status.OK for entry in late)
    for entry, there in zip(late, place[-10:], strict=True):
        apart = entry.updated.mean[:2] - there
        assert apart @ np.linalg.solve(entry.updated.cov[:2, :2], apart) < 25.0


def scan(mean, loglikelihood, rejected=0):
    mean = np.array([mean, 0.0])
    updated = Updated(mean, np.eye(2), np.float64(1.0), np.float64(loglikelihood), np.int64(1))
    return Entry(1.0, updated, Status.OK, rejected)


def left(rival, track, gap=0.0):
    found = remaining([Rival(State(0.0, np.zeros(2), np.eye(2)), gap)], track, [rival], most=9.0)
    return [one.gap for one in found]


def test_a_gap_is_the_log_likelihood_ratio_of_all_scans():
    track = scan(0.0, -2.0)
    assert left(scan(10.0, -5.0), track, gap=4.0) == [4.0 + 2.0 * 3.0]
    # A row that was left out counts as one at the gate.
    assert left(scan(10.0, -2.0, rejected=1), track) == [9.0]
    assert left(scan(10.0, -5.0), track, gap=20.0) == []
    assert left(None, track) == []


def test_states_within_a_sigma_of_both_are_one():
    # The squared distance in both covariances is half the squared distance of the means.
    assert left(scan(1.4, -2.0), scan(0.0, -2.0)) == []
    assert left(scan(1.5, -2.0), scan(0.0, -2.0)) == [0.0]


def test_a_rival_leads_where_the_scans_prefer_it_clearly():
    state = State(0.0, np.zeros(2), np.eye(2))
    assert Rival(state, -AMBIGUOUS_GAP - 0.1).leads
    assert not Rival(state, -AMBIGUOUS_GAP + 0.1).leads
