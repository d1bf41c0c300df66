"""Supervision of the sources of a stream: each source runs in a thread, and starts again after an error.

A source that fails is one line with its name. Until it works again, it is an alarm in health and metrics, and sets the
exit code.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from threading import Event, Lock, Thread
from typing import Any

from optloc.service.alarms import FIRST_DELAY, LONGEST_DELAY, PATIENCE, Alarm, sentence

LOG = logging.getLogger("optloc.service")


class Watch:
    """State of a running source, for the source and for its supervisor.

    name: name of the source. stopping: set when the source must end. alarm: its error, or None while it works.
    restarts: number of restarts since the start.
    """

    def __init__(self, name: str, clock: Callable[[], float], report: Callable[[dict[str, Any]], None]) -> None:
        self.name, self._clock, self._report = name, clock, report
        self.stopping, self.restarts, self.delay = Event(), 0, FIRST_DELAY
        self.alarm: Alarm | None = None

    def works(self) -> None:
        """Register that the source works: its alarm ends, and its next restart is quick."""
        if self.alarm is not None:
            self.alarm = None
            self._report({"source": self.name, "note": "recovered"})
        self.delay = FIRST_DELAY

    def fails(self, error: str) -> None:
        """Register that the source does not work; only the first of several errors in a row is reported."""
        if self.alarm is None:
            self.alarm = Alarm(error, self._clock())
            self._report({"source": self.name, "error": error})


@dataclass(frozen=True, slots=True)
class LineSource:
    """A source of lines.

    Parameters
    ----------
    name : str
        Name in messages, alarms and the account.
    run : callable
        Reads the source until its end, or until `Watch.stopping` is set; it raises an exception if the source fails.
    is_last : bool
        Whether the stream ends with this source.
    tries : float
        Number of restarts without success after which the source is given up; infinity: never.
    interrupt : callable
        Called after `Watch.stopping` is set, for a source that does not look at it.
    patience : float
        Seconds for which the end of the stream waits for the thread of the source.
    """

    name: str
    run: Callable[[Watch], None]
    is_last: bool = False
    tries: float = inf
    interrupt: Callable[[], None] = lambda: None
    patience: float = PATIENCE


@dataclass(frozen=True, slots=True)
class RunningSource:
    """A source with its state and its thread."""

    source: LineSource
    watch: Watch
    thread: Thread

    def interrupt(self) -> None:
        """Tell the source to end."""
        self.watch.stopping.set()
        self.source.interrupt()

    def stop(self) -> None:
        """End the source, and wait some seconds for its thread."""
        self.interrupt()
        self.thread.join(self.source.patience)


class Supervisor:
    """Threads of all sources of a stream.

    Parameters
    ----------
    close : callable
        Ends the stream.
    report : callable
        Receives one record for each failure and each recovery.
    clock : callable
        Monotonic clock, s.
    on_start : callable
        Receives the state of each new source, for health and metrics.
    """

    def __init__(
        self,
        close: Callable[[], None],
        report: Callable[[dict[str, Any]], None],
        clock: Callable[[], float],
        on_start: Callable[[Watch], None] = lambda watch: None,
    ) -> None:
        self._close, self._report, self._clock, self._on_start = close, report, clock, on_start
        self._lock, self._running, self._ends = Lock(), list[RunningSource](), False

    def start(self, source: LineSource) -> RunningSource:
        """Run a source in a separate thread until it ends, is given up or is stopped; after `stop`, it does not run."""
        watch = Watch(source.name, self._clock, self._report)
        self._on_start(watch)
        thread = Thread(target=self._run, args=(source, watch), name=f"optloc {source.name}", daemon=True)
        running = RunningSource(source, watch, thread)
        with self._lock:
            if self._ends:
                watch.stopping.set()
            self._running.append(running)
            thread.start()
        return running

    def stop(self) -> None:
        """End all sources, and wait some seconds for each."""
        with self._lock:
            self._ends, stopped = True, list(self._running)
        for running in stopped:
            running.interrupt()
        for running in stopped:
            running.stop()

    @property
    def failed(self) -> list[str]:
        """Return the names of the sources that do not work."""
        return [running.watch.name for running in self._running if running.watch.alarm is not None]

    def _run(self, source: LineSource, watch: Watch) -> None:
        """Run a source, and again after each error with a growing delay (the thread of the source)."""
        tries = 0
        while not watch.stopping.is_set():
            try:
                source.run(watch)
                break
            except (Exception, SystemExit) as error:  # any error is an alarm; a library may call sys.exit
                LOG.debug("source %s failed", source.name, exc_info=error)
                tries = tries + 1 if watch.alarm is not None else 1
                watch.fails(sentence(error))
            if tries > source.tries or watch.stopping.wait(watch.delay):
                break
            watch.delay = min(2.0 * watch.delay, LONGEST_DELAY)
            watch.restarts += 1
        if source.is_last:
            self._close()
