"""Standard input: errors, the end of its thread while a pipe is silent, and inputs in memory."""

import io
import os
import sys

import pytest
from service.broker import wait_for
from service.lines import Answers, line, site_in

from optloc.service.site import FAST
from optloc.service.standard_input import Input, input_of, is_file, standard_input
from optloc.service.stream import Settings, Stream


@pytest.fixture
def stream(tmp_path):
    with Stream(site_in(tmp_path, method=FAST), Settings(phases="fix"), Answers()) as made:
        yield made


def test_standard_input_that_fails_for_good_is_no_end_without_an_error(stream, monkeypatch):
    monkeypatch.setattr("optloc.service.supervisor.FIRST_DELAY", 0.01)
    pieces = [line(event="1", z=[1.0] * 5) + b"\n", OSError(5, "Input/output error"), b"2\n"]

    def read(_):
        piece = pieces.pop(0) if pieces else OSError(5, "Input/output error")
        if isinstance(piece, OSError):
            raise piece
        return piece

    watch = stream.start(standard_input(stream, Input(read))).watch
    assert stream.ended.wait(20.0)
    assert watch.alarm.error == "OSError: [Errno 5] Input/output error"
    assert stream.sources.failed == ["stdin"]
    assert stream.health()["account"]["stdin"]["received"] == 2


@pytest.mark.skipif(sys.platform == "win32", reason="on Windows, a read of a pipe cannot be interrupted")
def test_the_thread_of_a_silent_pipe_ends_with_its_stream(stream):
    reading, writing = os.pipe()
    with os.fdopen(reading) as file, os.fdopen(writing, "wb", buffering=0) as pipe:
        running = stream.start(standard_input(stream, input_of(file)))
        pipe.write(line(event="1", z=[1.0] * 5) + b'\n{"event": "half a line')
        wait_for(lambda: stream.health()["account"].get("stdin", {}).get("answered") == 1)
        stream.close()
        assert stream.ended.wait(20.0)
        assert not running.thread.is_alive()
    # half a line is no line
    assert stream.health()["account"]["stdin"]["received"] == 1


def test_inputs_in_memory_are_files_without_a_wait(tmp_path):
    memory = io.TextIOWrapper(io.BytesIO(b"abc"))
    assert input_of(memory).wait is None
    assert (input_of(memory).read(2), is_file(memory)) == (b"ab", True)
    path = tmp_path / "lines"
    path.write_bytes(b"abc")
    with path.open() as file:
        assert is_file(file)
        assert input_of(file).read(9) == b"abc"


@pytest.mark.skipif(sys.platform == "win32", reason="on Windows, select works for sockets only")
def test_a_pipe_is_no_file_and_waits_for_bytes():
    reading, writing = os.pipe()
    with os.fdopen(reading) as file, os.fdopen(writing, "wb", buffering=0) as pipe:
        found = input_of(file)
        assert not is_file(file)
        assert not found.wait(0.0)
        pipe.write(b"a")
        assert found.wait(5.0)
