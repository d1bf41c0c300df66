"""Standard input as a source of lines. Its thread ends with the stream, also while a pipe is silent."""

from __future__ import annotations

import os
import select
import stat
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from optloc.service.adapters import Adapter
from optloc.service.alarms import PATIENCE
from optloc.service.messages import LINE
from optloc.service.stream import Stream
from optloc.service.supervisor import LineSource, Watch

# Share of the time that does not count for waiting events while lines wait to be read. Rows of an event that were
# written together then stay together at any reading speed, and events with missing rows still close.
_UNCOUNTED = 0.98
# Restarts of a failing standard input: an error of a terminal may pass, an error of a device does not.
_TRIES = 3
# Seconds between two checks of whether the source must end.
_CHECK_EVERY = 0.2


class Input(NamedTuple):
    """An input of bytes.

    read: returns at most the given number of bytes as soon as there are any; empty at the end. wait: waits at most the
    given seconds, and returns whether bytes can be read without waiting; None if only a read shows this.
    """

    read: Callable[[int], bytes]
    wait: Callable[[float], bool] | None = None


def input_of(file: Any) -> Input:
    """Return a text file such as standard input as an input of bytes.

    The input reads the file descriptor without the lock of Python's buffer, since the end of the process would wait for
    this lock. Files in memory have no descriptor.
    """
    try:
        number = file.fileno()
    except (OSError, AttributeError, ValueError):
        return Input(file.buffer.read1)  # in memory, as in tests
    read, wait = partial(os.read, number), partial(_is_readable, number)
    try:
        wait(0.0)
    except (OSError, ValueError):
        return Input(read)  # on Windows, select works for sockets only
    return Input(read, wait)


def _is_readable(number: int, seconds: float) -> bool:
    """Wait at most `seconds` for bytes of a file descriptor, and return whether they can be read without waiting."""
    return bool(select.select([number], [], [], seconds)[0])


def is_file(file: Any) -> bool:
    """Return whether an input is a regular file, or in memory: its data can wait, unlike the data of a pipe."""
    try:
        return stat.S_ISREG(os.fstat(file.fileno()).st_mode)
    except (OSError, AttributeError, ValueError):
        return True  # a stream without a file number is in memory, as in tests


def standard_input(stream: Stream, source: Input, adapter: Adapter | None = None) -> LineSource:
    """Return standard input as a source, with whose end the stream ends; `adapter` is as in `read_lines`."""
    wait = source.wait

    def run(watch: Watch) -> None:
        """Read standard input until its end, or until the source is stopped."""

        def read(count: int) -> bytes | None:
            """Return at most `count` bytes; None if the source is stopped."""
            while wait is not None and not wait(_CHECK_EVERY):
                if watch.stopping.is_set():
                    return None
            data = source.read(count)
            watch.works()
            return data

        read_lines(read, stream, watch.name, adapter, bool if wait is None else partial(wait, 0.0))

    # A read that only bytes can end is not waited for.
    return LineSource("stdin", run, is_last=True, tries=_TRIES, patience=0.0 if wait is None else PATIENCE)


def read_lines(
    read: Callable[[int], bytes | None],
    stream: Stream,
    source: str,
    adapter: Adapter | None = None,
    pending: Callable[[], bool] = bool,
) -> None:
    """Read lines until the end and pass them to a stream; while the queue is full, nothing is read.

    Parameters
    ----------
    read : callable
        Returns at most the given number of bytes, as soon as any are available; empty at the end, None after a stop.
    stream : Stream
        Receives the lines.
    source : str
        Name of the source for messages.
    adapter : callable, optional
        Converts input lines to lines of a stream.
    pending : callable
        Returns whether input is available: then the time between two reads hardly counts for waiting events.
    """
    rest, number, last = b"", 0, stream.clock()
    stream.pending = pending
    try:
        while True:
            waited = pending()  # then the input waits for this thread, not this thread for the input
            piece = read(LINE)
            if piece is None:
                return
            if not piece:
                break
            now = stream.clock()
            stream.uncounted += _UNCOUNTED * (now - last) if waited else 0.0
            last = now
            *whole, rest = (rest + piece).split(b"\n")
            if len(rest) > 2 * LINE:
                rest = rest[: LINE + 1]  # the beginning suffices to reject a line that is too long
            stream.inbox.put(stream.lines(whole, source, number + 1, adapter=adapter))
            number += len(whole)
            if stream.inbox.closed:
                return
    finally:
        stream.pending = bool
    stream.inbox.put(stream.lines([rest], source, number + 1, adapter=adapter))
