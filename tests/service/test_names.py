"""Events with a name that the site does not have: they are refused with the nearest name, and the stream goes on."""

import json

import pytest
from service.lines import EPOCH, Answers, answers, arrivals, line, site_in

from optloc.service.adapters import ChirpStack
from optloc.service.checkpoint import restore, state_of
from optloc.service.events import Events
from optloc.service.messages import parse
from optloc.service.metrics import Metrics
from optloc.service.site import FAST, UnknownName
from optloc.service.standard_input import read_lines
from optloc.service.stream import Settings, Stream


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"), method=FAST)


def single(site, event, times, names="ABCDEF"):
    """Return a line for each arrival of an event."""
    return [line(event=event, station=name, time_ps=t) for name, t in zip(names, times, strict=False)]


def by_event(records):
    return {record["event"]: record for record in records if "event" in record}


@pytest.mark.parametrize("place", [0, 2, 5])
def test_an_event_with_an_unknown_station_is_not_fixed_by_the_others(site, place):
    one, two = arrivals(site, 2)
    lines = single(site, "bad", one)
    lines.insert(place, line(event="bad", station="F ", time_ps=EPOCH))
    records, health = answers(site, [*lines, *single(site, "good", two)], phases="fix")
    found = by_event(records)
    assert found["bad"]["position"] is None
    assert "there is no station 'F '; did you mean 'F'?" in found["bad"]["error"]
    assert found["good"]["status"] == "unproven"
    assert (health["malformed"], health["unsolvable"], health["events"]) == (1, 1, 2)


def test_an_event_of_unknown_stations_alone_is_answered_by_the_sentence(site):
    records, health = answers(site, [line(event="7", station="G", time_ns=1)], phases="two", wait=0.0)
    assert "there is no station 'G'" in by_event(records)["7"]["error"]
    assert health["events"] == 1


def test_an_unknown_kind_of_a_row_refuses_its_event(site):
    rows = [{"event": "r", "kind": "tdoa", "a": name, "b": "A", "z": 10.0} for name in "BCDE"]
    lines = [line(**row) for row in rows]
    lines.append(line(event="r", kind="tdao", a="F", b="A", z=3.0, more=False))
    records, _ = answers(site, lines, phases="fix")
    assert "the site has no rows of the kind 'tdao'; did you mean 'tdoa'?" in by_event(records)["r"]["error"]


def test_a_whole_event_with_an_unknown_station_can_be_sent_again(site):
    (times,) = arrivals(site, 1)
    every = [{"station": name, "time_ps": t} for name, t in zip("ABCDEF", times, strict=True)]
    wrong = [*every[:-1], every[-1] | {"station": "f"}]
    records, health = answers(site, [line(event="w", arrivals=wrong), line(event="w", arrivals=every)], phases="fix")
    assert "did you mean 'F'?" in records[0]["error"]
    assert records[1]["event"] == "w"
    assert records[1]["dof"] == 2
    assert health["events"] == 1


def test_a_name_that_comes_after_the_answer_changes_nothing(site):
    (times,) = arrivals(site, 1)
    late = [*single(site, "x", times), line(event="x", station="Z", time_ps=EPOCH)]
    for revise in (False, True):
        records, health = answers(site, late, phases="fix", revise=revise)
        assert [record["dof"] for record in records if "event" in record] == [2]
        assert health["malformed"] == 1


def test_other_processes_leave_the_event_to_the_one_that_answers_it(site):
    error = None
    try:
        parse(line(event="1", station="Q", time_ns=5), site)
    except UnknownName as raised:
        error = raised
    assert (error.event, error.whole) == ("1", False)
    opened = 0
    for part in range(3):
        events = Events(site, Metrics(), lambda note: None, part=(part, 3))
        events.refuse(error, 0.0, 0.0)
        opened += len(events.open)
    assert opened == 1


def test_a_checkpoint_keeps_what_refused_an_event(site, tmp_path):
    (times,) = arrivals(site, 1)
    events = Events(site, Metrics(), lambda note: None)
    events.take(parse(single(site, "k", times)[0], site), 0.0, 0.0)
    with pytest.raises(UnknownName) as raised:
        parse(line(event="k", station="AA", time_ns=5), site)
    events.refuse(raised.value, 0.0, 0.0)
    path = tmp_path / "state"
    path.write_text(json.dumps(state_of(events)))
    again = Events(site, Metrics(), lambda note: None)
    restore(path, again, 0.0)
    assert "there is no station 'AA'" in again.open["k"].refused


def test_a_recording_with_an_unknown_station_is_answered_alike(site, tmp_path):
    (times,) = arrivals(site, 1)
    lines = [*single(site, "p", times[:4]), line(event="p", station="E2", time_ps=EPOCH)]
    record = tmp_path / "lines.ndjson"
    out = Answers()
    stream = Stream(site, Settings(phases="fix", record=record, wait=10.0), out)
    data = iter([b"\n".join(lines), b""])
    read_lines(lambda _: next(data), stream, "test")
    stream.close()
    assert stream.ended.wait(60.0)
    kept = [json.loads(each) for each in record.read_text().splitlines()]
    assert [each["station"] for each in kept] == ["A", "B", "C", "D", "E2"]
    assert "error" in by_event(out.records)["p"]


def test_a_gateway_of_another_network_is_named_once(site, caplog):
    adapter = ChirpStack(site.stations)
    heard = [{"gatewayId": name, "fineTimeSinceGpsEpoch": "1.5s"} for name in ("A", "roaming")]
    heard += [{"gatewayId": ["A"]}, {"gatewayId": None}]
    for number in range(3):
        sent = json.loads(adapter(json.dumps({"deduplicationId": str(number), "rxInfo": heard}).encode()))
        assert [each["station"] for each in sent["arrivals"]] == ["A"]
    assert [record.getMessage() for record in caplog.records] == [
        "gateway 'roaming' is not a station of the site: its arrivals are left out"
    ]
