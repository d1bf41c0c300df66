"""Bounded queues between the threads of a stream: lines that wait to be read, answers that wait to be written."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from threading import Condition, Lock, Thread
from typing import NamedTuple

from optloc.service.answers import Record, join
from optloc.service.engine import BATCH

WAITING = 4096
"""Lines that may wait to be read, and answers that may wait to be written."""


class Ticket:
    """Whoever waits for the answers to some lines, such as a request.

    Parameters
    ----------
    lines : int
        How many lines it sends.
    done : callable
        Called once, from any thread, with the answers in the order in which they were complete.
    """

    def __init__(self, lines: int, done: Callable[[list[Record]], None]) -> None:
        self._lock, self._lines, self._done = Lock(), lines, done
        self._open, self._records = 0, dict[int | str, Record]()

    def expect(self) -> None:
        """Note that an event of these lines is to be answered."""
        with self._lock:
            self._open += 1

    def handled(self, refused: Record | None = None) -> None:
        """Note that a line was read, and what is wrong with it if anything is."""
        with self._lock:
            self._lines -= 1
            if refused is not None:
                self._records[len(self._records)] = refused
            over = self._lines == 0 and self._open == 0
        if over:
            self._finish()

    def answer(self, record: Record, last: bool) -> None:
        """Take an answer; both phases of an event become one record."""
        with self._lock:
            name = record["event"]
            self._records[name] = join(self._records.get(name), record)
            self._open -= last
            over = last and self._lines == 0 and self._open == 0
        if over:
            self._finish()

    def _finish(self) -> None:
        self._done(list(self._records.values()))


class QueuedLine(NamedTuple):
    """A line as it was read.

    Parameters
    ----------
    data : bytes
        What it holds.
    number : int
        Its place in its source.
    source : str
        What complaints call that.
    stamp : float
        When it was read, by the clock of the stream.
    when : float
        The same by the time that events wait, see `optloc.service.stream.read_lines`.
    ticket : Ticket, optional
        Who waits for what it brings.
    track : bool, optional
        Whether its event is answered by its track; None: as the stream does it.
    """

    data: bytes
    number: int
    source: str
    stamp: float
    when: float
    ticket: Ticket | None = None
    track: bool | None = None


class Inbox:
    """Lines that wait to be read, from all sources; bounded.

    Parameters
    ----------
    most : int
        Lines that may wait.
    """

    def __init__(self, most: int = WAITING) -> None:
        self._most, self._lines, self._changed = most, deque[QueuedLine](), Condition()
        self.closed = self._woken = False

    def __len__(self) -> int:
        return len(self._lines)

    def put(self, lines: Sequence[QueuedLine]) -> None:
        """Take lines; the caller waits while there are too many. None are taken any more once the stream ends."""
        with self._changed:
            for first in range(0, len(lines), BATCH):
                self._changed.wait_for(lambda: len(self._lines) < self._most or self.closed)
                if self.closed:
                    return
                self._lines.extend(lines[first : first + BATCH])
                self._changed.notify_all()

    def offer(self, lines: Sequence[QueuedLine]) -> bool:
        """Take lines if there is room for all of them, and return whether there was."""
        with self._changed:
            if self.closed or len(self._lines) + len(lines) > self._most:
                return False
            self._lines.extend(lines)
            self._changed.notify_all()
            return True

    def push(self, line: QueuedLine) -> int:
        """Take a line in any case, and return how many of the oldest were dropped for it."""
        with self._changed:
            dropped = 0
            while len(self._lines) >= self._most:
                self._lines.popleft()
                dropped += 1
            self._lines.append(line)
            self._changed.notify_all()
            return dropped

    def take(self, most: int, seconds: float) -> list[QueuedLine] | None:
        """Return the next lines, none where none comes within some seconds; None where none will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._lines or self.closed or self._woken, max(seconds, 0.0))
            self._woken = False
            if not self._lines:
                return None if self.closed else []
            taken = [self._lines.popleft() for _ in range(min(most, len(self._lines)))]
            self._changed.notify_all()
            return taken

    def close(self) -> None:
        """Take no more lines: what is there is still answered."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def wake(self) -> None:
        """Let the reader look round."""
        with self._changed:
            self._woken = True
            self._changed.notify_all()


class Outbox:
    """Answers that wait to be written, by a thread of its own; bounded.

    Parameters
    ----------
    write : callable
        Writes bytes; an OSError ends the stream.
    gone : callable
        Called where writing fails.
    """

    def __init__(self, write: Callable[[bytes], None], gone: Callable[[], None], most: int = WAITING) -> None:
        self._write, self._gone, self._most = write, gone, most
        self._lines, self._changed = deque[tuple[bytes, str | None]](), Condition()
        self._closed = self.failed = False
        self.written = deque[str]()
        self._thread = Thread(target=self._run, name="optloc output", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._lines)

    def put(self, line: bytes, whole: str | None = None) -> None:
        """Take a line, and the event that is answered with it; the caller waits while there are too many."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._lines) < self._most or self.failed)
            self._lines.append((line, whole))
            self._changed.notify_all()

    def close(self) -> None:
        """Write what is there, and end."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._lines or self._closed)
                if not self._lines:
                    return
                taken, self._lines = self._lines, deque()
                self._changed.notify_all()
            if self.failed:
                continue
            try:
                self._write(b"".join(line for line, _ in taken))
            except OSError:
                with self._changed:
                    self.failed = True
                    self._changed.notify_all()
                self._gone()
                continue
            self.written.extend(name for _, name in taken if name is not None)
