"""Checkpoints that were damaged: each is refused with one sentence, or goes on as it was."""

import copy
import json
import random

import pytest
from service.lines import EPOCH, Answers, arrivals, line, site_in
from typer.testing import CliRunner

from optloc import InvalidProblem
from optloc.cli import app
from optloc.service.account import STATES
from optloc.service.checkpoint import restore, state_of
from optloc.service.events import Events
from optloc.service.messages import parse
from optloc.service.metrics import Metrics
from optloc.service.stream import Settings, Stream

VALUES = (None, True, 0, -1, 1.5, 1e308, "", "A", "tdoa", "1", "9" * 30, "\ud800", "\x1b[2J", "x" * 300, [], [[]], {})
VALUES = (*VALUES, {"a": 1}, float("nan"), float("inf"), 10**40, [None] * 5, "optloc live 3")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="module")
def good(site):
    """Return the state of a stream with open events of every sort."""
    metrics = Metrics()
    events = Events(site, metrics, lambda record: None, 10.0)

    def take(sent, **more):
        event = events.take(parse(sent, site), 1.0, 1.0, **more)
        event.lines["pipe"] = event.lines.get("pipe", 0) + 1
        metrics.account.receive("pipe")

    metrics.account.receive("request", 2)
    metrics.account.settle("answered", {"request": 2})
    for i, times in enumerate(arrivals(site, 3)):
        for k, time in enumerate(times[: 3 + i]):
            more = {"target": "T"} if i else {}
            take(line(event=f"e{i}", station="ABCDEF"[k], time_ps=time, **more))
    more = {"kind": "tdoa", "z": 2.5, "sigma": 2.0, "time": 3.5}
    take(line(event="r", a="C", b="B", **more), track=True)
    events.remember("done", None)
    return state_of(events)


def places(node, path=()):
    """Yield the paths of all values within a value."""
    for key in node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
        yield (*path, key)
        yield from places(node[key], (*path, key))


def damaged(good, seed):
    """Return a checkpoint with one damage."""
    rng, text = random.Random(seed), json.dumps(good)
    kind = rng.choice(["cut", "flip", "value", "value", "value", "drop", "twice", "nest"])
    if kind == "cut":
        return text[: rng.randrange(len(text))].encode()
    if kind == "flip":
        data = bytearray(text.encode())
        data[rng.randrange(len(data))] = rng.randrange(256)
        return bytes(data)
    made = copy.deepcopy(good)
    *path, key = rng.choice(list(places(made)))
    parent = made
    for each in path:
        parent = parent[each]
    if kind == "value":
        parent[key] = rng.choice(VALUES)
    elif kind == "drop":
        del parent[key]
    elif kind == "nest":
        parent[key] = [parent[key]]
    elif isinstance(parent, list):
        parent.insert(key, copy.deepcopy(parent[key]))
    else:
        parent[f"{key}2"] = parent[key]
    return json.dumps(made).encode()


def refusal(path, events):
    """Return why a checkpoint is refused; empty where it is taken over."""
    try:
        restore(path, events, 1.0)
    except InvalidProblem as error:
        return str(error)
    return ""


def test_every_damage_is_a_sentence_or_does_not_matter(site, good, tmp_path):
    path, seen = tmp_path / "s.state", {"refused": 0, "resumed": 0}
    for seed in range(400):
        path.write_bytes(damaged(good, seed))
        events = Events(site, Metrics(), lambda record: None, 10.0)
        said = refusal(path, events)
        assert "\n" not in said, seed
        if said:
            assert not {**events.open, **events.closed}, seed
            seen["refused"] += 1
        else:
            # what was taken over is a state of its own
            path.write_text(json.dumps(state_of(events)))
            again = Events(site, Metrics(), lambda record: None, 10.0)
            restore(path, again, 1.0)
            assert again.open.keys() == events.open.keys(), seed
            seen["resumed"] += 1
    assert min(seen.values()) > 20


def test_a_whole_checkpoint_comes_back(site, good, tmp_path):
    path = tmp_path / "s.state"
    path.write_text(json.dumps(good))
    events = Events(site, Metrics(), lambda record: None, 10.0)
    restore(path, events, 1.0)
    again = state_of(events)
    # its stream did not end by itself: what is answered again has a higher revision
    assert [each.pop("revision") for each in again["open"]] == [2] * len(good["open"])
    assert again.pop("revision") == 2
    first = copy.deepcopy(good)
    assert {each.pop("revision") for each in first["open"]} == {first.pop("revision")} == {1}
    assert again == first


def test_a_checkpoint_of_the_first_format_comes_back(site, good, tmp_path):
    path, old = tmp_path / "s.state", copy.deepcopy(good)
    for key in ("ended", "revision", "account"):
        del old[key]
    for each in old["open"]:
        del each["lines"]
    path.write_text(json.dumps(old | {"format": "optloc live 1"}))
    events = Events(site, Metrics(), lambda record: None, 10.0)
    restore(path, events, 1.0)
    assert [event.name for event in events.open.values()] == [each["event"] for each in good["open"]]
    assert events.metrics.account.records() == {}


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("counts", [1], r"damaged \(counts"),
        ("counts", {"lines\n# bad": 1}, "s.state"),
        ("closed", ["a", 1], r"damaged \(closed"),
        ("open", {"a": 1}, r"damaged \(open"),
        ("format", "optloc live 9", "not a checkpoint of a stream"),
        ("account", {"pipe": {"received": 1}}, r"damaged \(account: the counts of a source are incomplete"),
        ("account", {"pipe": dict.fromkeys(STATES, 1)}, r"damaged \(account: the counts of a source do not balance"),
        ("account", {}, r"damaged \(account: the open lines"),
        ("ended", 1, r"damaged \(ended"),
        ("revision", -1, r"damaged \(revision"),
    ],
)
def test_what_is_wrong_is_named(site, good, tmp_path, key, value, said):
    path = tmp_path / "s.state"
    path.write_text(json.dumps(good | {key: value}))
    with pytest.raises(InvalidProblem, match=said):
        restore(path, Events(site, Metrics(), lambda record: None, 10.0), 1.0)


@pytest.mark.parametrize(
    ("key", "value"),
    [("times", [["A", "1" * 30]]), ("rows", [["tdoa", "B", "A", 1e40, None]]), ("when", 1e300), ("event", "done")],
)
def test_an_event_that_no_line_could_make_is_refused(site, good, tmp_path, key, value):
    path, made = tmp_path / "s.state", copy.deepcopy(good)
    made["open"][0][key] = value
    path.write_text(json.dumps(made))
    with pytest.raises(InvalidProblem, match=r"open event 1|s\.state"):
        restore(path, Events(site, Metrics(), lambda record: None, 10.0), 1.0)


def test_the_command_ends_with_one_sentence_and_leaves_no_recording(tmp_path):
    site_in(tmp_path)
    state = tmp_path / "s.state"
    state.write_text('{"format": "optloc live 1", "closed": [], "open": [], "counts": [3]}')
    words = ["live", str(tmp_path / "site.toml"), "--state", str(state), "--record", str(tmp_path / "r.ndjson")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2
    assert "this checkpoint is damaged" in " ".join(done.output.split())
    assert {path.name for path in tmp_path.iterdir()} == {"site.toml", "s.state"}


@pytest.mark.parametrize(
    "data",
    [b"", b"\x89PNG\r\n\x1a\n" + bytes(64), b"[1]", b'{"format": "optloc live 2"', b'{"format": "optloc live 2"}'],
)
def test_a_file_that_is_no_checkpoint_is_named_with_the_next_step(site, tmp_path, data):
    path = tmp_path / "s.state"
    path.write_bytes(data)
    with pytest.raises(InvalidProblem) as found:
        Stream(site, Settings(state=path, phases="fix"), Answers())
    said = str(found.value)
    assert "s.state" in said
    assert "\n" not in said
    assert "remove it" in said or "another file" in said
    assert path.read_bytes() == data
    assert not (tmp_path / "s.state.lock").exists()


def test_a_time_that_is_beyond_all_clocks_is_refused_before_it_is_kept(site):
    with pytest.raises(InvalidProblem, match="is out of range"):
        parse(line(event="1", kind="tdoa", a="B", b="A", z=1.0, time=1e15), site)


def test_a_stream_goes_on_from_its_state(site, good, tmp_path):
    path, out = tmp_path / "s.state", Answers()
    path.write_text(json.dumps(good))
    stream = Stream(site, Settings(state=path, phases="fix", wait=60.0), out)
    stream.inbox.put(stream.lines([line(event="e2", station="F", time_ps=EPOCH + 10**7)], "test"))
    stream.close()
    assert stream.ended.wait(60.0)
    assert stream.error is None
    assert {record["event"] for record in out.records} == {"e0", "e1", "e2", "r"}
    (joined,) = [record for record in out.records if record["event"] == "e2"]
    assert "error" not in joined, joined
    assert joined["position"] is not None, joined
