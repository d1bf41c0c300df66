"""Files of a stream: a recording on a full disk, a state that cannot be written, and one owner of each state."""

import json
import os
import sys
from pathlib import Path

import pytest
from service.broker import wait_for
from service.lines import Answers, arrivals, differences, line, site_in

from optloc.base import outputs
from optloc.problem import InvalidProblem
from optloc.service import side_outputs
from optloc.service.events import Events
from optloc.service.metrics import Metrics
from optloc.service.site import FAST
from optloc.service.stream import Settings, Stream
from optloc.service.stream_files import StreamFiles


@pytest.fixture
def site(tmp_path):
    return site_in(tmp_path, method=FAST)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(side_outputs, "FIRST_DELAY", 0.02)


def files(site, state=None, record=None, said=None):
    events = Events(site, Metrics(), lambda record: None)
    return StreamFiles(state, record, events, 0.0, (said if said is not None else []).append)


def test_lines_are_recorded_with_their_times(site, tmp_path):
    path = tmp_path / "r.ndjson"
    made = files(site, record=path)
    made.record(b'{"event": "1"}', 3.5)
    made.record(b'{"event": "2"}', 4.0)
    made.close()
    assert [json.loads(each) for each in path.read_bytes().splitlines()] == [
        {"received": 3.5, "event": "1"},
        {"received": 4.0, "event": "2"},
    ]
    assert not files(site).outputs


def test_the_newest_checkpoint_is_written(site, tmp_path):
    path = tmp_path / "s.state"
    made = files(site, state=path)
    for number in range(5):
        made.checkpoint(lambda number=number: {"number": number})
    made.close()
    assert json.loads(path.read_text()) == {"number": 4}
    assert not (tmp_path / "s.state.lock").exists()


def test_files_that_cannot_be_used_leave_no_lock(site, tmp_path):
    (tmp_path / "s.state").write_text("{}")
    with pytest.raises(InvalidProblem, match="this is not a checkpoint"):
        files(site, state=tmp_path / "s.state")
    with pytest.raises(InvalidProblem, match="it is a folder"):
        files(site, state=tmp_path / "t.state", record=tmp_path)
    assert {each.name for each in tmp_path.iterdir()} == {"site.toml", "s.state"}


class Full:
    """A file on a disk with room for `room` bytes; a write that does not fit writes what fits, as a disk does."""

    def __init__(self, file, room):
        self._file, self._room = file, room

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._file.close()

    def __getattr__(self, name):
        return getattr(self._file, name)

    def write(self, data):
        free = self._room[0] - os.fstat(self._file.fileno()).st_size
        if free <= 0:
            raise OSError(28, "No space left on device")
        return self._file.write(data[:free])


@pytest.fixture
def room(monkeypatch):
    """Return a list with the bytes that recordings may have."""
    found, opened = [2000], Path.open

    def open_full(self, *words, **more):
        file = opened(self, *words, **more)
        return Full(file, found) if self.name.endswith(".partial") else file

    monkeypatch.setattr(outputs.Path, "open", open_full)
    return found


def test_a_full_disk_degrades_the_recording_only(site, tmp_path, room):
    path, out, said = tmp_path / "r.ndjson", Answers(), []
    z = differences(site, arrivals(site, 4)).tolist()
    stream = Stream(site, Settings(phases="fix", record=path, state=tmp_path / "s.state"), out, said.append)

    def send(first, count):
        lines = [line(event=str(i), z=z[i % 4]) for i in range(first, first + count)]
        stream.inbox.put(stream.lines(lines, "pipe"))
        wait_for(lambda: len(out.records) == first + count)
        stream._files.write_record()
        stream._files.outputs[1].wait()

    send(0, 10)
    send(10, 100)
    wait_for(lambda: stream.health()["alarms"])
    (alarm,) = stream.health()["alarms"]
    assert (alarm["part"], alarm["name"]) == ("output", "recording")
    assert "No space left on device" in alarm["error"]
    send(110, 100)
    room[0] = 10**9
    wait_for(lambda: not stream.health()["alarms"])
    stream.close()
    assert stream.ended.wait(20.0)
    health = stream.health()
    assert health["account"]["pipe"]["answered"] == 210 == len(out.records)
    assert health["malformed"] == 0
    assert len([each for each in said if "cannot be written" in each]) == 1
    # each line is whole, and is there once
    names = [json.loads(each)["event"] for each in path.read_bytes().splitlines()]
    assert names == [str(i) for i in range(210)]
    assert health["dropped_by_output"] == {"state": 0, "recording": 0}


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() == 0, reason="the administrator may write anywhere")
def test_a_state_in_a_folder_that_is_protected_is_one_sentence(site, tmp_path):
    folder = tmp_path / "protected"
    folder.mkdir(mode=0o500)
    with pytest.raises(InvalidProblem, match="the lock file"):
        files(site, state=folder / "s.state")


def test_a_state_that_cannot_be_written_is_an_alarm_and_no_end(site, tmp_path, monkeypatch):
    out, said, broken = Answers(), [], [True]

    def fail(path, text):
        if broken[0]:
            raise InvalidProblem("the file cannot be written (No space left on device)", str(path), "free the disk")
        path.write_text(text)

    monkeypatch.setattr("optloc.service.stream_files.write_text", fail)
    stream = Stream(site, Settings(phases="fix", state=tmp_path / "s.state", every=0.05), out, said.append)
    assert [alarm["name"] for alarm in stream.health()["alarms"]] == ["state"]
    stream.inbox.put(stream.lines([line(event="1", z=[1.0] * 5)], "pipe"))
    wait_for(lambda: out.records)
    broken[0] = False
    wait_for(lambda: not stream.health()["alarms"])
    stream.close()
    assert stream.ended.wait(20.0)
    assert json.loads((tmp_path / "s.state").read_text())["closed"] == ["1"]
    assert len(said) == 2
