"""The account: received = answered + refused + dropped + open for each source, after every kind of line."""

import json
import threading
import time
from collections import Counter
from itertools import count, islice

import pytest
from service.broker import wait_for
from service.lines import SITE, Answers, arrivals, balanced, differences, line, site_in, slowed

from optloc.service.account import OTHERS, STATES, Account, total
from optloc.service.queues import Ticket
from optloc.service.site import FAST
from optloc.service.stream import Settings, Stream


def counts(**given):
    return dict.fromkeys(STATES, 0) | given


def test_lines_move_from_open_to_one_state():
    account = Account()
    account.receive("pipe", 3)
    account.receive("mqtt")
    account.settle("answered", {"pipe": 2, "mqtt": 1})
    account.settle("dropped", {"pipe": 1})
    assert account.records() == {
        "pipe": counts(received=3, answered=2, dropped=1),
        "mqtt": counts(received=1, answered=1),
    }
    account.receive("pipe")
    assert account.difference({"pipe": 1}) == {}
    assert account.difference({}) == {"pipe": 1}
    # a checkpoint with no open event: the line in the queue is not received yet
    assert account.for_checkpoint({})["pipe"] == counts(received=3, answered=2, dropped=1)
    other = Account()
    other.restore(account.for_checkpoint({"pipe": 1}))
    assert other.records() == account.records()
    assert total([{"a": 1}, {"a": 2, "b": 1}]) == Counter(a=3, b=1)


def test_names_of_sources_are_bounded():
    account = Account()
    for i in range(300):
        account.receive(f"client {i}")
        account.settle("refused", {f"client {i}": 1})
    found = account.records()
    assert len(found) == 257
    assert found[OTHERS] == counts(received=44, refused=44)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"), method=FAST)


@pytest.fixture(scope="module")
def z(site):
    return differences(site, arrivals(site, 4)).tolist()


def running(site, **settings):
    """Return a stream and its answers."""
    out = Answers()
    return Stream(site, Settings(**({"phases": "fix", "wait": 60.0} | settings)), out), out


def sent(stream, *lines, source="pipe"):
    """Return the account of a source after lines, once the stream has read all lines."""
    stream.inbox.put(stream.lines(lines, source))
    wait_for(lambda: not len(stream.inbox))
    # a command is read after the lines before it
    done = threading.Event()
    stream.inbox.put(stream.lines([line(command="health")], "probe", 1, Ticket(1, lambda _: done.set())))
    assert done.wait(20.0)
    wait_for(lambda: not stream._unsettled)
    return balanced(stream.health())[source]


def ended(stream):
    """Return the account at the end of a stream."""
    stream.close()
    assert stream.ended.wait(60.0)
    assert stream.error is None
    found = balanced(stream.health())
    assert {each["open"] for each in found.values()} == {0}
    return found


def part(event, station, **more):
    return line(event=event, station=station, time_ns=1 + "ABCDEF".index(station), **more)


@pytest.mark.parametrize(
    ("lines", "wanted"),
    [
        (lambda z: [line(event="1", z=z[0])], {"answered": 1}),
        (lambda z: [part("1", "A"), part("1", "B")], {"open": 2}),
        (lambda z: [part("1", "A"), part("1", "A")], {"open": 2}),
        (lambda z: [part("1", "A"), line(event="1", station="A", time_ns=9)], {"open": 2}),
        (lambda z: [line(event="1", z=z[0])] * 2, {"answered": 2}),
        (lambda z: [line(event="1", z=z[0]), line(event="1", z=z[1])], {"answered": 1, "dropped": 1}),
        (lambda z: [line(event="1", z=[None, *z[0][1:]]), line(event="1", z=z[0])], {"answered": 1, "dropped": 1}),
        (lambda z: [b"{}", b"nonsense", b'{"event": "1"}', b"   "], {"refused": 3}),
        (lambda z: [part("1", "A"), line(event="1", station="nowhere", time_ns=1)], {"open": 1, "refused": 1}),
        (lambda z: [part("1", "A"), line(command="flush")], {"answered": 2}),
        (lambda z: [line(command="health")], {"answered": 1}),
        (lambda z: [line(event="1", rows=[{"kind": "tdoa", "a": "B", "b": "A", "z": 1e9}])], {"answered": 1}),
    ],
    ids=[
        "whole", "partial", "repeated while open", "conflict while open", "repeated", "conflict", "late", "malformed",
        "unknown station", "flush", "health", "too few rows",
    ],
)  # fmt: skip
def test_each_line_is_counted_once(site, z, lines, wanted):
    stream, _ = running(site)
    given = lines(z)
    received = sum(bool(each.strip()) for each in given)
    assert sent(stream, *given) == counts(received=received, **wanted)
    ended(stream)


def test_a_late_row_that_gives_a_new_answer_is_answered(site, z):
    stream, out = running(site, revise=True)
    found = sent(stream, line(event="1", z=[None, *z[0][1:]]), line(event="1", z=z[0]))
    assert found == counts(received=2, answered=2)
    ended(stream)
    assert [record.get("revision") for record in out.records if record.get("event") == "1"] == [None, 2]


def test_lines_of_other_processes_are_dropped(site, z):
    stream, out = running(site, part=(0, 2))
    found = sent(stream, *(line(event=str(i), z=z[i % 4]) for i in range(40)))
    ended(stream)
    answered = sum("event" in record for record in out.records)
    assert found == counts(received=40, answered=answered, dropped=40 - answered)
    assert 0 < answered < 40


def test_a_reload_answers_the_open_lines(tmp_path, z):
    site = site_in(tmp_path, method=FAST)
    said, out = [], Answers()
    stream = Stream(site, Settings(phases="fix", wait=60.0), out, said.append, site_file=tmp_path / "site.toml")
    assert sent(stream, part("1", "A")) == counts(received=1, open=1)
    (tmp_path / "site.toml").write_text(SITE.replace("Six receivers", "Others"))
    stream.reload()
    wait_for(lambda: said)
    assert sent(stream, part("2", "A")) == counts(received=2, answered=1, open=1)
    assert ended(stream)["pipe"] == counts(received=2, answered=2)


def test_events_whose_proofs_are_skipped_are_answered(tmp_path):
    site = site_in(tmp_path)
    out = Answers()
    stream = Stream(slowed(site), Settings(deadline=0.05), out)
    rows = differences(site, arrivals(site, 8)).tolist()
    stream.inbox.put(stream.lines([line(event=str(i), z=rows[i % 8]) for i in range(600)], "pipe"))
    assert ended(stream)["pipe"] == counts(received=600, answered=600)
    why = Counter(record.get("why") for record in out.records if record["phase"] == "proof")
    assert why["skipped: load"] > 0
    assert sum(why.values()) == 600
    assert (why["skipped: load"], why["deadline"]) == tuple(stream.health()[key] for key in ("skipped", "overdue"))


def test_a_full_queue_and_the_end_of_a_stream_are_counted(site, z):
    free = threading.Event()

    class Held(Answers):
        def __call__(self, data):
            free.wait(60.0)
            super().__call__(data)

    stream = Stream(site, Settings(phases="fix"), Held())
    # a repeated event has no second answer, so that only new events fill the queues
    lines = (line(event=str(i), z=z[i % 4]) for i in count())
    while stream.inbox.offer(stream.lines(list(islice(lines, 1000)), "request")):
        pass
    pushed = [stream.inbox.push(each) for each in stream.lines(list(islice(lines, 7000)), "mqtt")]
    free.set()
    found = ended(stream)
    stream.inbox.put(stream.lines(list(islice(lines, 10)), "pipe"))
    assert found["request"]["refused"] == 1000
    assert found["mqtt"] == counts(received=7000, answered=7000 - sum(pushed), dropped=sum(pushed))
    assert sum(pushed) > 0
    assert balanced(stream.health())["pipe"] == counts(received=10, dropped=10)


def test_a_line_that_is_in_no_queue_is_an_alarm(site):
    stream, _ = running(site, health=0.05)
    stream.metrics.account.receive("pipe")  # a line that was lost
    wait_for(lambda: stream.health()["alarms"])
    (alarm,) = stream.health()["alarms"]
    assert (alarm["part"], alarm["error"]) == ("account", "1 open lines of pipe are in no queue and no event")
    stream.close()
    assert stream.ended.wait(10.0)


# Kills: the account is in the checkpoint.


def killed(stream, path):
    """Return the last checkpoint of a stream, which then ends as after a kill: its last state is not written."""
    until = time.monotonic() + 20.0
    before = path.read_bytes()
    while path.read_bytes() == before and time.monotonic() < until:
        time.sleep(0.01)
    kept = path.read_bytes()
    stream.close()
    assert stream.ended.wait(20.0)
    path.write_bytes(kept)
    return json.loads(kept)


def test_the_account_goes_on_after_a_kill(site, z, tmp_path):
    path = tmp_path / "s.state"
    stream, _ = running(site, state=path, every=0.3)
    sent(stream, line(event="1", z=z[0]), part("2", "A"), part("2", "B"), b"nonsense")
    kept = killed(stream, path)
    assert kept["account"]["pipe"] == counts(received=4, answered=1, refused=1, open=2)
    assert not kept["ended"]
    stream, out = running(site, state=path)
    assert balanced(stream.health())["pipe"] == counts(received=4, answered=1, refused=1, open=2)
    assert sent(stream, line(event="1", z=z[0])) == counts(received=5, answered=2, refused=1, open=2)
    assert ended(stream)["pipe"] == counts(received=5, answered=4, refused=1)
    (record,) = [record for record in out.records if record.get("event") == "2"]
    assert record["revision"] == 2


def test_what_is_answered_again_after_a_kill_has_a_higher_revision(site, z, tmp_path):
    path, revisions = tmp_path / "s.state", []
    for _ in range(3):
        stream, out = running(site, state=path, every=60.0)
        before = path.read_bytes()
        # answered after the last checkpoint, so the next process does not know it
        sent(stream, line(event="1", z=z[0]))
        stream.close()
        assert stream.ended.wait(20.0)
        path.write_bytes(before)
        revisions += [record.get("revision", 1) for record in out.records if record.get("event") == "1"]
    assert revisions == [1, 2, 3]


def test_a_stream_that_ends_by_itself_does_not_raise_revisions(site, z, tmp_path):
    for event in "12":
        stream, out = running(site, state=tmp_path / "s.state")
        sent(stream, line(event=event, z=z[0]))
        ended(stream)
        assert not [record for record in out.records if "revision" in record]


def test_a_closed_output_leaves_the_events_open_for_the_next_stream(site, z, tmp_path):
    path = tmp_path / "s.state"

    def gone(data):
        raise BrokenPipeError

    stream = Stream(site, Settings(phases="fix", state=path), gone)
    stream.inbox.put(stream.lines([line(event="1", z=z[0])], "pipe"))
    assert stream.ended.wait(20.0)
    assert balanced(stream.health())["pipe"] == counts(received=1, open=1)
    stream, out = running(site, state=path)
    assert ended(stream)["pipe"] == counts(received=1, answered=1)
    assert [(record["event"], record["revision"]) for record in out.records] == [("1", 2)]


def test_metrics_have_the_account(site, z):
    stream, _ = running(site)
    sent(stream, line(event="1", z=z[0]), part("2", "A"))
    text = stream.metrics.text(stream.clock())
    assert 'optloc_source_lines_total{source="pipe",state="received"} 2' in text
    assert 'optloc_source_lines_total{source="pipe",state="answered"} 1' in text
    assert 'optloc_open_lines{source="pipe"} 1' in text
    ended(stream)
