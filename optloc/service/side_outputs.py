"""Further outputs than the answers: the recording, the checkpoints and standard error. They never stop the stream.

Each output has a bounded queue and a thread that writes it. If the queue is full, the oldest waiting entries are
dropped and counted. If writing fails, the thread writes again after a growing delay.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from threading import Condition, Thread
from time import monotonic
from typing import Generic, TypeVar

from optloc.service.alarms import FIRST_DELAY, LONGEST_DELAY, PATIENCE, Alarm, sentence

T = TypeVar("T")

# Size of the entries that are written together, bytes: on a nearly full disk, a part of a large queue still fits.
_TOGETHER = 1 << 16


class SideOutput(Generic[T]):
    """Bounded queue of one output, with a thread that writes it.

    Parameters
    ----------
    name : str
        Name for messages and health.
    write : callable
        Writes entries; it raises OSError or InvalidProblem if this fails, and has then written none of them.
    most : int
        Largest size of all waiting entries, in the unit of `put`.
    say : callable
        Receives one sentence when writing fails for the first time, and one when it works again.
    finish : callable
        Called once after the last entry is written.
    clock : callable
        Monotonic clock, s.

    Attributes
    ----------
    dropped : int
        Number of dropped lines.
    alarm : Alarm, optional
        Error of the last attempt to write; None if it succeeded.
    """

    def __init__(
        self,
        name: str,
        write: Callable[[Sequence[T]], None],
        most: int,
        say: Callable[[str], None] = lambda line: None,
        finish: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = monotonic,
    ) -> None:
        self.name, self._write, self._most, self._say, self._finish = name, write, most, say, finish
        self._clock = clock
        self._waiting, self._size, self._changed = deque[tuple[T, int, int]](), 0, Condition()
        self._ends = self._busy = False
        self.dropped = 0
        self.alarm: Alarm | None = None
        self._thread = Thread(target=self._run, name=f"optloc {name}", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, entry: T, size: int = 1, count: int = 1) -> None:
        """Add an entry; if the queue is full, its oldest entries are dropped. The caller never waits for the output.

        `size` is its share of the queue. `count` is the number of lines in the entry, for the count of dropped lines.
        """
        with self._changed:
            if self._ends:
                self.dropped += count
                return
            self._waiting.append((entry, size, count))
            self._size += size
            self._trim()
            self._changed.notify_all()

    def close(self, seconds: float = PATIENCE) -> None:
        """Write the waiting entries, and wait at most `seconds` for this; entries that remain are dropped."""
        with self._changed:
            self._ends = True
            self._changed.notify_all()
        self._thread.join(seconds)
        with self._changed:
            self._drop_all()

    def wait(self, seconds: float = PATIENCE) -> None:
        """Wait until the waiting entries are written or writing fails, at most `seconds`."""
        with self._changed:
            self._changed.wait_for(lambda: self.alarm is not None or not (self._waiting or self._busy), seconds)

    def _trim(self) -> None:
        """Drop the oldest entries while the queue is too large, except the newest entry; the caller has the lock."""
        while self._size > self._most and len(self._waiting) > 1:
            _, size, count = self._waiting.popleft()
            self._size -= size
            self.dropped += count

    def _drop_all(self) -> None:
        """Drop and count all waiting entries; the caller has the lock."""
        self.dropped += sum(count for _, _, count in self._waiting)
        self._waiting.clear()
        self._size = 0

    def _run(self) -> None:
        """Write the waiting entries until the output is closed (the thread of the output)."""
        delay = FIRST_DELAY
        while taken := self._taken():
            error = self._error_of(partial(self._write, [entry for entry, _, _ in taken]))
            self._note(error)
            if error is None:
                delay = FIRST_DELAY
                continue
            with self._changed:
                self._changed.notify_all()
                self._waiting.extendleft(reversed(taken))
                self._size += sum(size for _, size, _ in taken)
                self._trim()
                if self._ends:  # the last attempt has failed
                    self._drop_all()
                self._changed.wait_for(lambda: self._ends, delay)
            delay = min(2.0 * delay, LONGEST_DELAY)
        error = self._error_of(self._finish)
        if error is not None:
            self._note(error)

    def _taken(self) -> list[tuple[T, int, int]]:
        """Return the oldest waiting entries as soon as there are any; empty after the end."""
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._waiting or self._ends)
            taken, size = [], 0
            while self._waiting and size < _TOGETHER:
                taken.append(self._waiting.popleft())
                size += taken[-1][1]
            self._size -= size
            self._busy = bool(taken)
            return taken

    def _error_of(self, work: Callable[[], object]) -> str | None:
        """Return the error of a call that writes, or None."""
        try:
            work()
        except Exception as error:  # noqa: BLE001  # an error of optloc in one output must not end its thread
            return sentence(error)
        return None

    def _note(self, error: str | None) -> None:
        """Store the result of an attempt to write; report the first error, and the first success after it."""
        if error is None and self.alarm is not None:
            self.alarm = None
            self._say(f"The output {self.name!r} is written again; {self.dropped} lines were dropped.")
        elif error is not None and self.alarm is None:
            self.alarm = Alarm(error, self._clock())
            self._say(f"The output {self.name!r} cannot be written, and fixing goes on: {error}")
