"""Recordings: lines with their times, epochs of a problem file as events, and replays at any speed."""

import json
from math import inf, isnan

import numpy as np
import pytest
from service.lines import SITE

from optloc.service.queues import Inbox
from optloc.service.recording import Recorded, read_recording, replay


def test_a_line_keeps_the_time_at_which_it_was_read(tmp_path):
    path = tmp_path / "lines.ndjson"
    path.write_bytes(b'{"event": "1", "received": 3.5}\n\n{"event": "2"}\n{"received": "soon"}\n[\n')
    found = read_recording(path)
    assert [each.data for each in found][1] == b'{"event": "2"}'
    assert found[0].received == 3.5
    assert all(isnan(each.received) for each in found[1:])
    assert len(found) == 4


def test_epochs_of_a_problem_file_are_events_in_the_order_of_their_times(tmp_path):
    values = [(time, name, z) for time, z in ((2.0, 7.0), (1.0, 5.0)) for name in "BC"]
    rows = ", ".join(f'{{ time = {time}, a = "{name}", z = {z} }}' for time, name, z in values)
    text = SITE[: SITE.index("rows = [{ a")] + f"rows = [{rows}]\n"
    path = tmp_path / "epochs.toml"
    path.write_text(text)
    found = read_recording(path)
    assert [each.received for each in found] == [1.0, 2.0]
    line = json.loads(found[0].data)
    assert line["time"] == 1.0
    assert line["rows"] == [{"kind": "tdoa", "z": 5.0, "a": a, "b": "A"} for a in "BC"]


class Receiver:
    """Takes the lines of a replay as a stream does; its clock is at the time of the last look plus 0.1 s."""

    def __init__(self):
        self.inbox, self.now = Inbox(), 0.0

    def clock(self):
        self.now += 0.1
        return self.now


@pytest.mark.parametrize("speed", [inf, 1e9])
def test_a_replay_hands_on_all_lines_with_the_times_of_the_recording(speed):
    stream = Receiver()
    recording = [Recorded(10.0, b"a"), Recorded(np.nan, b"b"), Recorded(12.0, b"c")]
    replay(recording, stream, speed, "file")
    lines = stream.inbox.take(9, 0.0)
    assert [(line.data, line.when) for line in lines] == [(b"a", 10.0), (b"b", 10.0), (b"c", 12.0)]
    assert [line.number for line in lines] == [1, 2, 3]
    assert {line.source for line in lines} == {"file"}


def test_a_replay_ends_with_the_stream():
    stream = Receiver()
    stream.inbox.close()
    replay([Recorded(0.0, b"a")], stream, inf, "file")
    assert stream.inbox.take(9, 0.0) is None


def test_a_recorded_line_that_an_adapter_cannot_convert_is_handed_on_with_its_error():
    stream = Receiver()
    replay([Recorded(0.0, b"1"), Recorded(1.0, b"x")], stream, inf, "file", lambda data: b"%d" % int(data))
    good, bad = stream.inbox.take(9, 0.0)
    assert (good.fault, bad.number) == ("", 2)
    assert "ValueError" in bad.fault
