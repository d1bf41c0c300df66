"""Outputs beside the answers: bounded, the oldest lines are dropped, writing is tried again, and no caller waits."""

import threading

import pytest
from service.broker import wait_for

from optloc.problem import InvalidProblem
from optloc.service import side_outputs
from optloc.service.side_outputs import SideOutput


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(side_outputs, "FIRST_DELAY", 0.01)


def test_entries_are_written_in_order_and_the_end_is_called_once():
    written, ends = [], []
    output = SideOutput("test", written.extend, 100, finish=lambda: ends.append(1))
    for i in range(10):
        output.put(i)
    output.close()
    assert (written, ends, output.dropped, output.alarm) == (list(range(10)), [1], 0, None)


def test_a_blocked_writer_drops_the_oldest_lines_and_no_caller_waits():
    free, written = threading.Event(), []

    def write(entries):
        free.wait(30.0)
        written.extend(entries)

    output = SideOutput("test", write, 4)
    output.put("first")
    wait_for(lambda: output._busy)
    for i in range(10):
        output.put(i, count=2)
    assert (len(output), output.dropped) == (4, 12)
    free.set()
    output.close()
    assert written == ["first", 6, 7, 8, 9]


def test_an_entry_that_is_larger_than_the_queue_is_kept():
    written = []
    output = SideOutput("test", written.extend, 4)
    output.put("large", size=100)
    output.wait()
    assert written == ["large"]
    output.close()


def test_a_full_disk_is_said_once_and_tried_again():
    full, written, said = [True], [], []

    def write(entries):
        if full[0]:
            raise OSError(28, "No space left on device")
        written.extend(entries)

    output = SideOutput("test", write, 3, said.append)
    for i in range(10):
        output.put(i)
        output.wait()
    wait_for(lambda: output.alarm is not None)
    assert "No space left on device" in output.alarm.error
    assert [each for each in said if "cannot be written, and fixing goes on" in each] == said[:1] == said
    full[0] = False
    wait_for(lambda: output.alarm is None)
    output.close()
    # of ten lines, the newest are written, and the others are counted
    assert written == list(range(10))[-len(written) :]
    assert output.dropped == 10 - len(written) > 0
    assert len(said) == 2
    assert "is written again" in said[1]


def test_an_output_that_never_works_ends_with_a_count():
    def write(entries):
        raise InvalidProblem("the file cannot be written", "x", "choose another place")

    output = SideOutput("test", write, 100)
    for i in range(5):
        output.put(i)
    output.close()
    assert (output.dropped, len(output)) == (5, 0)
    output.put(6)
    assert output.dropped == 6


def test_an_error_of_optloc_in_a_writer_ends_no_thread():
    calls = []

    def write(entries):
        calls.append(entries)
        if len(calls) == 1:
            raise ZeroDivisionError("of a writer")

    output = SideOutput("test", write, 100)
    output.put(1)
    wait_for(lambda: len(calls) > 1)
    output.close()
    assert (output.dropped, calls[1]) == (0, [1])


def test_the_end_waits_some_seconds_for_a_blocked_writer():
    free = threading.Event()
    output = SideOutput("test", lambda entries: free.wait(30.0), 100)
    output.put(1)
    wait_for(lambda: output._busy)
    output.put(2)
    output.close(0.05)
    assert output.dropped == 1
    free.set()
