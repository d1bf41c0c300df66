"""A stream: lines from all sources go through one bounded queue; one thread answers, one thread writes.

The thread that answers parses lines, collects events, closes them in time, and passes them to the engine. It also
writes checkpoints, recordings and health.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from time import monotonic

import numpy as np

from optloc.engine import enabled, simulate
from optloc.files import GrowingFile, access, write_text
from optloc.problem import InvalidProblem
from optloc.service import events as of_events
from optloc.service.answers import FORMATS, OF_RECORDS, Latest, Record, to_feed, to_line
from optloc.service.checkpoint import restore, state_of
from optloc.service.engine import BATCH, Engine
from optloc.service.events import Events, RefusedRepeat
from optloc.service.messages import LINE, parse, shown_name, stamped
from optloc.service.metrics import Metrics
from optloc.service.queues import Inbox, Outbox, QueuedLine, Ticket
from optloc.service.replies import Replies
from optloc.service.site import Site, UnknownName, read_site
from optloc.service.tracks import Following, Tracks

LOG = logging.getLogger("optloc.service")

# Lines between two looks at the clock: a timer is late by their time, some milliseconds.
_LINES = 256
# Seconds between checks of whether a reader has read its available input.
_PAUSE = 1e-3
# Share of the time that does not count for waiting events while lines wait to be read. Rows of an event that were
# written together then stay together at any reading speed, and events with missing rows still close.
_UNCOUNTED = 0.98
# Bytes of a recording that are collected before writing.
_RECORD_BUFFER = 1 << 16


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a stream.

    Parameters
    ----------
    wait : float
        Seconds from the first row of an event to its closing.
    revise : bool
        Whether late rows give a new answer.
    phases : "two", "one" or "fix"
        As in `optloc.service.engine.PHASES`.
    deadline : float
        Seconds after which a proof is given up.
    shed : bool
        Whether proofs are skipped under load; otherwise rows wait.
    part : (int, int)
        Number of this process, and number of processes.
    format : str
        A key of `optloc.service.answers.FORMATS`.
    state : Path, optional
        Checkpoint; restored at the start if it exists.
    record : Path, optional
        File for the lines with their times of reading.
    every : float
        Seconds between checkpoints.
    health : float
        Seconds between lines of health.
    track : bool
        Whether events are answered by states of tracks instead of fixes.
    following : Following, optional
        Settings of tracks.
    """

    wait: float = 0.05
    revise: bool = False
    phases: str = "two"
    deadline: float = 1.0
    shed: bool = True
    part: tuple[int, int] = (0, 1)
    format: str = "ndjson"
    state: Path | None = None
    record: Path | None = None
    every: float = 5.0
    health: float = 10.0
    track: bool = False
    following: Following | None = None


class Stream:
    """A service that reads lines, answers events and writes answers until it is closed.

    Parameters
    ----------
    site : Site
        Template of events.
    settings : Settings
        Settings of the answers.
    write : callable
        Writes bytes to the output.
    say : callable
        Prints a line for people, such as health.
    clock : callable
        Monotonic clock, s.
    again : Path, optional
        File of the site, for reloading.
    replayed : bool
        Whether lines have recorded times of reading: events then close by these times, at any replay speed.
    """

    def __init__(
        self,
        site: Site,
        settings: Settings,
        write: Callable[[bytes], None],
        say: Callable[[str], None] = lambda line: None,
        clock: Callable[[], float] = monotonic,
        again: Path | None = None,
        *,
        replayed: bool = False,
    ) -> None:
        self.site, self._settings, self._say, self.clock, self._again = site, settings, say, clock, again
        self._replayed = replayed
        self.metrics, self.latest, self.inbox = Metrics(), Latest(), Inbox()
        # replaced, never modified, because threads iterate over it
        self.listeners: tuple[Callable[[Record], None], ...] = ()
        # for a source that is a file: seconds that do not count for waiting, and whether it has more to read
        self.held = 0.0
        self.pending: Callable[[], bool] = bool
        self._outbox = Outbox(write, self.inbox.close)
        self._format = FORMATS[settings.format]
        self._engine = self._new_engine(site)
        self._replies = Replies()
        self._events = Events(
            site, self.metrics, self._emit, settings.wait, settings.revise, settings.part, attach=self._replies.attach
        )
        self._unwritten: dict[str, of_events.Event] = {}  # closed events whose last answer may not be written yet
        # before other files are created, since a rejected checkpoint must leave none behind
        if settings.state is not None and settings.state.exists():
            restore(settings.state, self._events, self._time())
        self._record = None if settings.record is None else GrowingFile(settings.record)
        self._recorded = bytearray()  # lines that are not yet in the file of the recording
        self._reload = False
        self._next_state, self._next_health = clock() + settings.every, clock() + settings.health
        self.metrics.gauges |= {
            "input": lambda: len(self.inbox),
            "output": lambda: len(self._outbox),
            "open": lambda: len(self._events.open),
        }
        self.ended = Event()
        self.error: Exception | None = None
        warm_up(site, settings.phases)
        Thread(target=self._run, name="optloc stream", daemon=True).start()

    def _new_engine(self, site: Site) -> Engine:
        """Return the engine of a site with the settings of the stream."""
        s = self._settings
        return Engine(
            site,
            self.metrics,
            self._answer,
            self.clock,
            phases=s.phases,
            deadline=s.deadline,
            shed=s.shed,
            following=s.following,
        )

    # Interface for sources and commands.

    def lines(
        self,
        data: Sequence[bytes],
        source: str,
        first: int = 1,
        ticket: Ticket | None = None,
        *,
        track: bool | None = None,
    ) -> list[QueuedLine]:
        """Return data that was just read as lines, numbered from `first`; `track` is as in `QueuedLine`."""
        now, when = self.clock(), self._time()
        return [QueuedLine(each, first + i, source, now, when, ticket, track) for i, each in enumerate(data)]

    @property
    def tracks(self) -> Tracks:
        """Return the tracks of the stream."""
        return self._engine.tracks

    @property
    def untracked(self) -> str:
        """Return the reason for which this stream cannot make tracks; empty if it can."""
        if self._settings.part[1] > 1:
            return "this process answers a part of the events, but a track needs all events of its target"
        return self.tracks.why

    def _time(self) -> float:
        """Return the time of the clock for which events wait, s: the clock without the seconds that do not count."""
        return self.clock() - self.held

    def close(self) -> None:
        """Read no more lines, answer the waiting lines, and end."""
        self.inbox.close()

    def reload(self) -> None:
        """Reload the file of the site, if it is valid; open events are answered by the old site."""
        self._reload = True
        self.inbox.wake()

    @property
    def failed(self) -> bool:
        """Return whether the reader of the output has closed it."""
        return self._outbox.failed

    def health(self) -> Record:
        """Return counts, latencies and settings."""
        about = {"site": self.site.title, "machine_code": enabled(), "phases": self._settings.phases}
        return self.metrics.health(self.clock(), about)

    # The thread that answers.

    def _run(self) -> None:
        """Answer lines until the end (the thread that answers); an error is stored for the thread that waits."""
        try:
            self._loop()
        except Exception as error:  # noqa: BLE001  # raised in the thread that waits for the stream
            self.error = error
        finally:
            self.inbox.close()
            self._outbox.close()
            self.ended.set()

    def _loop(self) -> None:
        """Read lines and answer closed events until the queue of lines is closed or the output fails."""
        while not self._outbox.failed:
            # `due` is the number of seconds until the next timed work. In a replay, only lines close events.
            due = min(self._engine.next_due, self._next_state, self._next_health) - self.clock()
            if not self._replayed:
                due = min(due, self._events.next_due - self._time())
            pending = self.pending()
            lines = self.inbox.take(_LINES, max(due, _PAUSE) if pending else due)
            if lines is None:
                break
            for line in lines:
                if line.when >= self._events.next_due:
                    self._events.due(line.when, self.clock())
                self._read(line)
                if len(self._events.ready) >= BATCH:
                    self._answer_closed()
            # while lines wait, use the time of the last line: rows of an open event may be among the waiting lines
            if not (self._replayed or pending or len(self.inbox)):
                self._events.due(self._time(), self.clock())
            self._do_timed_work()
        if not self._outbox.failed:
            self._finish()

    def _do_timed_work(self) -> None:
        """Answer closed events, then do the work that is due: deadlines, reload, health, recording and checkpoint."""
        now = self.clock()
        self._answer_closed()
        self._engine.expire()
        if self._reload:
            self._reload = False
            self._reload_site()
        if now >= self._next_health:
            self._next_health = now + self._settings.health
            self._say(json.dumps({"health": self.health()}))
            self._write_record()
        if now >= self._next_state:
            self._next_state = now + self._settings.every
            self._checkpoint()

    def _finish(self) -> None:
        """Answer all waiting events, and store the last state."""
        self._events.flush(self.clock())
        self._answer_closed()
        self._engine.stop()
        self._outbox.close()
        self._checkpoint()
        self._write_record(last=True)

    def _read(self, line: QueuedLine) -> None:
        """Read one line: add its rows to an event, or run its command; report an invalid line."""
        counts, ticket = self.metrics.counts, line.ticket
        data = line.data.strip()
        refused = None
        if data:
            counts["lines"] += 1
            track = self._settings.track if line.track is None else line.track
            try:
                message = parse(data, self.site)
                self._record_line(data, line.stamp)
                if message.command:
                    refused = self._run_command(message.command)
                else:
                    self._events.take(message, line.stamp, line.when, ticket, track=track)
            except Exception as error:  # an error of one line must not end the stream
                if not isinstance(error, InvalidProblem):
                    LOG.exception("line %d of %s failed", line.number, line.source)
                # A line with an unknown name belongs to an event: record it, since it changes the answer.
                if isinstance(error, UnknownName):
                    self._record_line(data, line.stamp)
                    self._events.refuse(error, line.stamp, line.when, track=track)
                counts["malformed"] += 1
                refused = {"error": str(error), "line": line.number, "source": line.source}
                if isinstance(error, RefusedRepeat):
                    refused |= {**shown_name(error.name), "code": error.code}
                if ticket is None:
                    self._emit(refused)
        if ticket is not None:
            ticket.handled(refused)

    def _run_command(self, command: str) -> Record:
        """Run the command "flush" or "health", and return the record that answers it."""
        if command == "flush":
            self._events.flush(self.clock())
            return {"flushed": True}
        record = {"health": self.health()}
        self._emit(record)
        return record

    def _answer_closed(self) -> None:
        """Pass the closed events to the engine, and keep them for checkpoints until their answers are written."""
        closed = list(self._events.closing())
        for event in closed:
            self._unwritten[event.name] = event
        for first in range(0, len(closed), BATCH):
            self._engine.settle(closed[first : first + BATCH])

    # Answers, from all threads.

    def _answer(self, event: of_events.Event, record: Record, last: bool) -> None:
        """Write an answer of an event, and pass it to all receivers; `last` marks the last answer of the event."""
        self._publish(record)
        whole = self._replies.answer(event, record, last)
        line = to_feed(self._settings.format, record, whole, self.site.frame, last=last)
        self._outbox.put(line, event.name if last else None)

    def _emit(self, record: Record) -> None:
        """Write a record that is not an answer: a note, an error, health."""
        self._publish(record)
        if self._settings.format in OF_RECORDS:
            self._outbox.put(self._format(record, self.site.frame) or b"")
        else:
            self._say(json.dumps(record))

    def _publish(self, record: Record) -> None:
        """Pass a record to the latest fixes and to the listeners."""
        self.latest(record)
        for listener in self.listeners:
            listener(record)

    # Files.

    def _reload_site(self) -> None:
        """Reload the file of the site after the events of the old site are answered."""
        if self._again is None:
            return
        try:
            with access(anew=True):
                site = read_site(self._again, self.site.method, self.site.options)
            warm_up(site, self._settings.phases)
        except InvalidProblem as error:
            self._say(f"The site is not changed: {error}")
            return
        self._events.flush(self.clock())
        self._answer_closed()
        self._engine.stop()
        self.site = self._events.site = site
        self._engine = self._new_engine(site)
        self._events.closed = dict.fromkeys(self._events.closed)  # their rows belong to the old site
        self._say(f"The site is now {site.title!r}, with {len(site.rows)} rows of {len(site.stations)} stations.")

    def _checkpoint(self) -> None:
        """Write a checkpoint, if set; events whose last answers are written count as closed."""
        for _ in range(len(self._outbox.written)):
            self._unwritten.pop(self._outbox.written.popleft(), None)
        if self._settings.state is not None:
            try:
                write_text(self._settings.state, to_line(state_of(self._events, self._unwritten)).decode())
            except InvalidProblem as error:
                self._say(f"No checkpoint is written: {error}")  # a full disk must not end the stream

    def _record_line(self, data: bytes, stamp: float) -> None:
        """Record a line with its time of reading, `stamp`, s, as the first key of its JSON object."""
        if self._record is not None:
            self._recorded += stamped(data, stamp) + b"\n"
            if len(self._recorded) > _RECORD_BUFFER:
                self._write_record()

    def _write_record(self, *, last: bool = False) -> None:
        """Append the collected lines to the recording, if any; with `last`, finish the file."""
        if self._record is None:
            return
        if self._recorded:
            self._record.append(bytes(self._recorded))
            self._recorded.clear()
        if last:
            self._record.finish()


def warm_up(site: Site, phases: str) -> None:
    """Solve simulated events, so that machine code is loaded before the first real event.

    `phases` are the phases of the answers: "two", "one" or "fix".
    """
    ready = site.ready((), site.rows)
    assert ready is not None  # a site has rows
    problem = ready.fast.problem
    x = np.zeros(problem.layout.size)
    slot, _ = problem.layout.find("position")
    # away from the centre, where the geometry may be symmetric
    x[slot.start : slot.start + slot.size] = site.position.mean(0) + 0.1 * np.ptp(site.position, axis=0)
    with np.errstate(all="ignore"):
        z = simulate(problem, x, 0, BATCH).z
    for count in (1, BATCH):
        ready.fast(z[:count])
        if phases != "fix":
            ready.full(z[:count])


# Sources that are files: standard input, and recordings.


def read_lines(
    read: Callable[[int], bytes],
    stream: Stream,
    source: str,
    adapter: Callable[[bytes], bytes] | None = None,
    pending: Callable[[], bool] = bool,
) -> None:
    """Read lines until the end and pass them to a stream; while the queue is full, nothing is read.

    Parameters
    ----------
    read : callable
        Returns at most the given number of bytes, as soon as any are available; empty at the end.
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
    while True:
        waited = pending()  # then the input waits for this thread, not this thread for the input
        if not (piece := read(LINE)):
            break
        now = stream.clock()
        stream.held += _UNCOUNTED * (now - last) if waited else 0.0
        last = now
        *whole, rest = (rest + piece).split(b"\n")
        if len(rest) > 2 * LINE:
            rest = rest[: LINE + 1]  # the beginning suffices to reject a line that is too long
        lines = whole if adapter is None else [adapter(data) for data in whole]
        stream.inbox.put(stream.lines(lines, source, number + 1))
        number += len(whole)
        if stream.inbox.closed:
            return
    stream.pending = bool
    if rest:
        stream.inbox.put(stream.lines([rest if adapter is None else adapter(rest)], source, number + 1))
