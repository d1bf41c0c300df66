"""Supervision of sources: an error is one report and an alarm, and the source runs again."""

import threading

import pytest
from service.broker import wait_for

from optloc.service import supervisor
from optloc.service.alarms import SourceLost
from optloc.service.supervisor import LineSource, Supervisor


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(supervisor, "FIRST_DELAY", 0.01)


class Kept:
    """A supervisor that keeps reports and states."""

    def __init__(self):
        self.reports, self.watches, self.closed = [], [], threading.Event()
        self.now = Supervisor(self.closed.set, self.reports.append, lambda: 7.0, self.watches.append)


def test_a_source_that_fails_runs_again_and_is_reported_once():
    kept, runs = Kept(), []

    def run(watch):
        runs.append(1)
        if len(runs) < 4:
            raise SourceLost("the broker is lost")
        watch.works()
        watch.stopping.wait(30.0)

    kept.now.start(LineSource("mqtt", run))
    wait_for(lambda: len(kept.reports) == 2)
    (watch,) = kept.watches
    assert kept.reports == [
        {"source": "mqtt", "error": "the broker is lost"},
        {"source": "mqtt", "note": "recovered"},
    ]
    assert (watch.restarts, watch.alarm, kept.now.failed) == (3, None, [])
    kept.now.stop()
    assert not kept.closed.is_set()


def test_a_source_that_starts_after_the_stop_does_not_run():
    kept, runs = Kept(), []
    kept.now.stop()
    running = kept.now.start(LineSource("mqtt", runs.append))
    running.thread.join(10.0)
    assert (runs, running.thread.is_alive(), kept.closed.is_set()) == ([], False, False)


def test_the_stop_waits_as_long_as_a_source_permits():
    kept, free = Kept(), threading.Event()
    waited, left = (
        kept.now.start(LineSource(name, lambda watch: free.wait(10.0), interrupt=interrupt, patience=patience))
        for name, interrupt, patience in (("waited", free.set, 10.0), ("left", lambda: None, 0.0))
    )
    left.stop()
    assert left.thread.is_alive()
    waited.stop()
    assert not waited.thread.is_alive()
    kept.now.stop()
    left.thread.join(10.0)


def test_the_delay_doubles_to_its_limit_and_starts_again_after_a_success(monkeypatch):
    monkeypatch.setattr(supervisor, "LONGEST_DELAY", 0.03)
    kept, delays, runs = Kept(), [], []

    def run(watch):
        delays.append(watch.delay)
        runs.append(1)
        if len(runs) == 4:
            watch.works()
        if len(runs) == 6:
            return
        raise ValueError("no")

    kept.now.start(LineSource("x", run, is_last=True))
    assert kept.closed.wait(20.0)
    assert delays == pytest.approx([0.01, 0.02, 0.03, 0.03, 0.02, 0.03])


def test_a_source_that_never_recovers_is_given_up_and_failed():
    kept = Kept()

    def run(watch):
        raise OSError(5, "Input/output error")

    kept.now.start(LineSource("stdin", run, is_last=True, tries=2))
    assert kept.closed.wait(20.0)
    (watch,) = kept.watches
    assert (watch.restarts, kept.now.failed) == (2, ["stdin"])
    assert watch.alarm == ("OSError: [Errno 5] Input/output error", 7.0)
    assert len(kept.reports) == 1


def test_the_end_of_a_source_ends_the_stream_only_if_it_is_the_last():
    kept = Kept()
    kept.now.start(LineSource("other", lambda watch: None))
    kept.now.stop()
    assert not kept.closed.is_set()
    kept.now.start(LineSource("stdin", lambda watch: None, is_last=True))
    assert kept.closed.wait(20.0)
    assert kept.now.failed == []
