"""Tracks of a stream: states after events, their order in time, and which are forgotten."""

import numpy as np
import pytest
from service.lines import arrivals, differences, site_in

from optloc import solve
from optloc.service.events import Event
from optloc.service.metrics import Metrics
from optloc.service.site import FAST
from optloc.service.tracks import Scan, Tracks, TrackSettings, scan_of


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"), method=FAST)


@pytest.fixture(scope="module")
def problem(site):
    return site.ready((), site.rows).fast.problem


def tracks(problem, out, now, **more):
    return Tracks(problem, TrackSettings(**more), Metrics(), lambda event, record: out.append(record), lambda: now[0])


def scan(problem, z, seconds, target="t"):
    when = None if seconds is None else round(seconds * 1e12)
    return Scan(Event(f"{target}{seconds}", {}, {}, 0.0, 0.0, target=target, when=when, closed="whole"), problem, z)


def test_a_target_that_stays_is_followed_and_events_must_come_in_order(site, problem):
    (z,), out = differences(site, arrivals(site, 1, sigma=0.0)), []
    made = tracks(problem, out, [0.0])
    made.take([scan(problem, z, seconds) for seconds in (0.0, 1.0, 2.0, 3.0, 1.5)])
    made.take([scan(problem, z, None)])
    made.stop()
    followed = out[3]
    assert (followed["phase"], followed["target"], followed["time"]) == ("track", "t", 3.0)
    assert followed["status"] == "ok"
    (wanted,) = solve(problem.with_rows(z=z), FAST).flat().position
    assert np.linalg.norm(np.subtract(followed["position"], wanted)) < 1.0
    assert "1.5 s before the last event of t" in out[4]["error"]
    assert "needs the time of the event" in out[5]["error"]


def test_silent_and_surplus_tracks_are_forgotten(site, problem):
    (z,), out, now = differences(site, arrivals(site, 1)), [], [0.0]
    made = tracks(problem, out, now, most=2, age=10.0)
    made.take([scan(problem, z, 0.0, name) for name in "abc"])
    made.stop()
    assert [record["target"] for record in made.records()] == ["c", "b"]
    now[0] = 10.5
    assert made.records() == []


def test_a_scan_is_one_epoch_with_the_measurements_of_the_event(problem):
    z = np.arange(problem.count, dtype=float)
    found = scan_of(problem, z, 7.0)
    assert (found.epochs, found.times.tolist()) == (1, [7.0])
    np.testing.assert_array_equal(found.z, z)
    assert tracks(problem, [], [0.0]).refusal == ""
