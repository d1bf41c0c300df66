"""The engine of a stream: fixes of events are those of solve, and proofs are given up in time."""

from math import inf
from threading import Event as Flag

import numpy as np
import pytest
from service import lines
from service.lines import arrivals, differences, site_in, slowed, solved

from optloc.service.engine import Engine, _order, _since_first
from optloc.service.events import Event
from optloc.service.metrics import Metrics
from optloc.service.site import FAST, SiteRow


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"), method=FAST)


class Answers:
    """Keeps answers as (event, record, whether it is the last one)."""

    def __init__(self):
        self.all = []

    def __call__(self, event, record, last):
        self.all.append((event.name, record, last))


def events(z):
    return [Event(str(i), dict(enumerate(map(float, row))), {}, 0.0, 0.0, closed="whole") for i, row in enumerate(z)]


def test_events_by_rows_have_the_fixes_of_solve(site):
    z, out, metrics = differences(site, arrivals(site, 3)), Answers(), Metrics()
    Engine(site, metrics, out, lambda: 1.0, phases="fix").solve(events(z))
    wanted = solved(site, z, FAST)[1].position
    assert [(name, last) for name, _, last in out.all] == [("0", True), ("1", True), ("2", True)]
    np.testing.assert_allclose([record["position"] for _, record, _ in out.all], wanted, atol=1e-6)
    assert metrics.percentiles("fix")[0] == 1.0


def test_events_with_too_few_rows_and_refused_ones_are_answered_at_once(site):
    out = Answers()
    refused = Event("bad", {}, {}, 0.0, 0.0, refused="there is no station 'G'")
    Engine(site, Metrics(), out, lambda: 0.0, phases="fix").solve([refused, Event("none", {}, {}, 0.0, 0.0)])
    (first, error, last), (second, few, _) = out.all
    assert (first, error["error"], last) == ("bad", "there is no station 'G'", True)
    assert (second, few["status"]) == ("none", "too few rows")


def test_a_proof_that_is_not_there_in_time_is_given_up(site, monkeypatch):
    out, now, gate = Answers(), [0.0], Flag()
    monkeypatch.setattr(lines, "Slow", lambda prepared, busy: lambda z: gate.wait(30.0) and prepared(z))
    engine = Engine(slowed(site), Metrics(), out, lambda: now[0], deadline=0.5)
    engine.solve(events(differences(site, arrivals(site, 1))))
    assert engine.next_due == 0.5
    now[0] = 0.6
    engine.expire()
    assert [(record["phase"], last) for _, record, last in out.all] == [("fix", False), ("proof", True)]
    assert out.all[1][1]["why"] == "deadline"
    assert engine.next_due == inf
    gate.set()
    engine.stop()
    assert len(out.all) == 2


def test_times_are_picoseconds_since_the_first_one():
    event = Event("1", {}, {4: 10**18 + 7, 2: 10**18, 3: 10**18 + 1}, 0.0, 0.0)
    assert _since_first(event, (2, 3, 4)) == [0, 1, 7]


def test_rows_of_the_template_stand_before_those_that_it_does_not_list():
    other, another = SiteRow(0, -1, "tdoa", "C", "B"), SiteRow(0, -1, "tdoa", "B", "D")
    assert sorted([other, 3, another, 0], key=_order) == [0, 3, another, other]
