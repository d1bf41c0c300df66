"""Bounded queues between the threads of a stream: input lines and output lines.

`Inbox` passes lines from all sources to the thread that answers. `Outbox` writes the answers in a separate thread.
`Ticket` collects the answers for one client.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from threading import Condition, Lock, Thread
from typing import NamedTuple

from optloc.service.account import Account
from optloc.service.answers import Record, join
from optloc.service.engine import BATCH
from optloc.service.events import Event

WAITING = 4096
"""Largest number of waiting input lines, and of waiting output lines."""


class Ticket:
    """Collector of the answers to the lines of one client, such as a request.

    `lines` is the number of lines. `done` is called once, from any thread, with the answers in the order of completion.
    """

    def __init__(self, lines: int, done: Callable[[list[Record]], None]) -> None:
        self._lock, self._lines, self._done = Lock(), lines, done
        self._open, self._records = 0, dict[int | tuple[str, str], Record]()

    def expect(self) -> None:
        """Register one more event of these lines to be answered."""
        with self._lock:
            self._open += 1

    def handled(self, refused: Record | None = None) -> None:
        """Register a line as read; `refused` is an error or the result of a command, which answers the line."""
        with self._lock:
            self._lines -= 1
            if refused is not None:
                self._records[len(self._records)] = refused
            over = self._lines == 0 and self._open == 0
        if over:
            self._finish()

    def answer(self, record: Record, last: bool) -> None:
        """Take an answer; both phases of an event are joined to one record."""
        with self._lock:
            name = record.get("client", ""), record["event"]
            self._records[name] = join(self._records.get(name), record)
            self._open -= last
            over = last and self._lines == 0 and self._open == 0
        if over:
            self._finish()

    def _finish(self) -> None:
        """Pass the collected answers to the client."""
        self._done(list(self._records.values()))


class QueuedLine(NamedTuple):
    """An input line.

    Parameters
    ----------
    data : bytes
        Content.
    number : int
        Line number in its source.
    source : str
        Name of the source for messages.
    stamp : float
        Time of reading, by the clock of the stream, s.
    when : float
        Time of reading, by the time for which events wait, s; see `optloc.service.stream.read_lines`.
    ticket : Ticket, optional
        Receiver of the answers.
    track : bool, optional
        Whether its event is answered by its track; None: as set for the stream.
    fault : str
        Error of the adapter that should have converted the line; the line is then refused.
    """

    data: bytes
    number: int
    source: str
    stamp: float
    when: float
    ticket: Ticket | None = None
    track: bool | None = None
    fault: str = ""


class Inbox:
    """Bounded queue of input lines from all sources, which counts the lines in an account.

    `most` is the largest number of lines.
    """

    def __init__(self, most: int = WAITING, account: Account | None = None) -> None:
        self._most, self._lines, self._changed = most, deque[QueuedLine](), Condition()
        self._account = account or Account()
        self._pushing = set[str]()  # sources whose lines may be dropped, because they cannot wait
        self.closed = self._woken = False

    def __len__(self) -> int:
        return len(self._lines)

    def put(self, lines: Sequence[QueuedLine]) -> None:
        """Add lines; the caller waits while the queue is full. After the end of the stream, lines are dropped."""
        with self._changed:
            for first in range(0, len(lines), BATCH):
                self._changed.wait_for(lambda: len(self._lines) < self._most or self.closed)
                if self.closed:
                    self._receive(lines[first:])
                    self._settle("dropped", lines[first:])
                    return
                self._add(lines[first : first + BATCH])

    def offer(self, lines: Sequence[QueuedLine]) -> bool:
        """Add lines if all of them fit, and return whether they were added; the caller never waits.

        Lines that do not fit are refused.
        """
        with self._changed:
            if self.closed or len(self._lines) + len(lines) > self._most:
                self._receive(lines)
                self._settle("refused", lines)
                return False
            self._add(lines)
            return True

    def push(self, line: QueuedLine) -> int:
        """Add a line, and return the number of lines that were dropped because the queue is full.

        The oldest line of a source that pushes lines is dropped, or the new line if no such line waits.
        """
        with self._changed:
            self._pushing.add(line.source)
            if self.closed:
                self._receive([line])
                self._settle("dropped", [line])
                return 1
            self._add([line])
            if len(self._lines) <= self._most:
                return 0
            place = next(i for i, each in enumerate(self._lines) if each.source in self._pushing)
            self._settle("dropped", [self._lines[place]])
            del self._lines[place]
            return 1

    def _add(self, lines: Sequence[QueuedLine]) -> None:
        """Add and count lines; the caller has the lock."""
        self._receive(lines)
        self._lines.extend(lines)
        self._changed.notify_all()

    def _receive(self, lines: Sequence[QueuedLine]) -> None:
        """Count lines as received."""
        for source, count in _by_source(lines).items():
            self._account.receive(source, count)

    def _settle(self, state: str, lines: Sequence[QueuedLine]) -> None:
        """Count lines that no event gets."""
        self._account.settle(state, _by_source(lines))

    def difference(self, waiting: Counter[str]) -> dict[str, int]:
        """Return by source how many open lines are neither in this queue nor `waiting`; empty if the account is right.

        `waiting` has the numbers of lines, by source, that the reader of the queue has taken.
        """
        with self._changed:
            return self._account.difference(waiting + _by_source(self._lines))

    def drop(self) -> None:
        """Drop all waiting lines, because the stream has ended; their clients get an error."""
        with self._changed:
            lines = list(self._lines)
            self._lines.clear()
            self._settle("dropped", lines)
        for line in lines:
            if line.ticket is not None:
                line.ticket.handled({"error": "the stream has ended", "line": line.number, "source": line.source})

    def take(self, most: int, seconds: float) -> list[QueuedLine] | None:
        """Return up to `most` lines; an empty list if none arrives within `seconds`, None after the end.

        The list is also empty after a call of `wake`.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._lines or self.closed or self._woken, max(seconds, 0.0))
            self._woken = False
            if not self._lines:
                return None if self.closed else []
            taken = [self._lines.popleft() for _ in range(min(most, len(self._lines)))]
            self._changed.notify_all()
            return taken

    def close(self) -> None:
        """Accept no more lines; waiting lines are still answered."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def wake(self) -> None:
        """Wake the reader before its timeout."""
        with self._changed:
            self._woken = True
            self._changed.notify_all()


def _by_source(lines: Sequence[QueuedLine] | deque[QueuedLine]) -> Counter[str]:
    """Return the number of lines by source."""
    return Counter(line.source for line in lines)


class Outbox:
    """Bounded queue of output lines, with a thread that writes them.

    Parameters
    ----------
    write : callable
        Writes bytes to the output; an OSError means that the reader of the output has closed it.
    on_failure : callable
        Called once without arguments if writing fails; it ends the stream.
    on_written : callable
        Receives events whose last answer was written, in the thread of the output.
    most : int
        Largest number of waiting lines.

    Attributes
    ----------
    failed : bool
        Whether writing has failed; further lines are dropped.
    """

    def __init__(
        self,
        write: Callable[[bytes], None],
        on_failure: Callable[[], None],
        on_written: Callable[[Sequence[Event]], None],
        most: int = WAITING,
    ) -> None:
        self._write, self._on_failure, self._on_written, self._most = write, on_failure, on_written, most
        self._lines, self._changed = deque[tuple[bytes, Event | None]](), Condition()
        self._closed = self.failed = False
        self._thread = Thread(target=self._run, name="optloc output", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._lines)

    def put(self, line: bytes, completed: Event | None = None) -> None:
        """Add a line to be written; the caller waits while the queue is full.

        `completed` is the event whose last answer this line is; None for other lines.
        """
        with self._changed:
            self._changed.wait_for(lambda: len(self._lines) < self._most or self.failed)
            self._lines.append((line, completed))
            self._changed.notify_all()

    def close(self) -> None:
        """Write all waiting lines, and end."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        """Write the waiting lines until the queue is closed (the thread of the output)."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._lines or self._closed)
                if not self._lines:
                    return
                taken, self._lines = self._lines, deque()
                self._changed.notify_all()
            if self.failed:  # drop the lines, so that no caller waits for a full queue
                continue
            try:
                self._write(b"".join(line for line, _ in taken))
            except OSError:
                with self._changed:
                    self.failed = True
                    self._changed.notify_all()
                self._on_failure()
                continue
            self._on_written([event for _, event in taken if event is not None])
