"""A stream: lines from all sources go through one bounded queue; one thread answers, one thread writes.

The thread that answers parses lines, collects events, closes them in time, and passes them to the engine. It also
makes checkpoints, recordings and health, which other threads write.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event as Flag, Lock, Thread
from time import monotonic
from typing import Any, Self

from optloc.engine import enabled
from optloc.files import access
from optloc.service.account import total
from optloc.service.adapters import Adapter, convert
from optloc.service.alarms import PATIENCE, Alarm, SourceLost, sentence
from optloc.service.answers import Record, to_line
from optloc.service.checkpoint import state_of
from optloc.service.engine import BATCH, Engine, warm_up
from optloc.service.events import Event, Events, RefusedRepeat
from optloc.service.feeds import FORMATS, OF_RECORDS, Latest, to_feed
from optloc.service.messages import name_keys, parse
from optloc.service.metrics import Metrics
from optloc.service.queues import Inbox, Outbox, QueuedLine, Ticket
from optloc.service.replies import Replies
from optloc.service.side_outputs import SideOutput
from optloc.service.site import Site, UnknownName, read_site
from optloc.service.stream_files import StreamFiles
from optloc.service.supervisor import LineSource, RunningSource, Supervisor, Watch
from optloc.service.tracks import Tracks, TrackSettings

LOG = logging.getLogger("optloc.service")

# Lines between two readings of the clock: a timer is late by their time, a few milliseconds.
_LINES = 256
# Seconds between checks of whether a reader has read its available input.
_PAUSE = 1e-3
# Seconds between writes of the recording.
_RECORD_EVERY = 1.0
# Lines of an event whose lines are settled. It is shared, since many events are remembered, and never modified.
_NO_LINES: dict[str, int] = {}


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
        A key of `optloc.service.feeds.FORMATS`.
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
    track_settings : TrackSettings, optional
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
    track_settings: TrackSettings | None = None


class Stream:
    """A service that reads lines, answers events and writes answers until it is closed.

    It is a context manager: the end of the block closes the stream and waits for all its threads.

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
    site_file : Path, optional
        File of the site, for reloading.
    replayed : bool
        Whether lines have recorded times of reading: events then close by these times, at any replay speed.

    Raises
    ------
    InvalidProblem
        If the site cannot be solved, or if the state or the recording cannot be used. No thread then stays.
    """

    def __init__(
        self,
        site: Site,
        settings: Settings,
        write: Callable[[bytes], None],
        say: Callable[[str], None] = lambda line: None,
        clock: Callable[[], float] = monotonic,
        site_file: Path | None = None,
        *,
        replayed: bool = False,
    ) -> None:
        self.site, self._settings, self._say, self.clock, self._site_file = site, settings, say, clock, site_file
        self._replayed = replayed
        self.metrics, self.latest = Metrics(), Latest()
        self.inbox = Inbox(account=self.metrics.account)
        self.sources = Supervisor(self.close, self._emit, clock, self._watch)
        # replaced, never modified, because threads iterate over it
        self.listeners: tuple[Callable[[Record], None], ...] = ()
        # for a source that is a file: seconds that do not count for waiting, and whether it has more to read
        self.uncounted = 0.0
        self.pending: Callable[[], bool] = bool
        self._format = FORMATS[settings.format]
        self._replies = Replies()
        self._events = Events(
            site, self.metrics, self._emit, settings.wait, settings.revise, settings.part, attach=self._replies.attach
        )
        # closed events whose last answer may not be written yet, by identity, since an event may be answered twice
        self._unsettled: dict[int, Event] = {}
        self._settling = Lock()
        self._imbalance: Alarm | None = None
        self.ended = Flag()
        self.error: Exception | None = None
        warm_up(site, settings.phases)
        # Threads start from here on, after all that can be refused.
        self._files = StreamFiles(settings.state, settings.record, self._events, self._time(), say)
        self._outbox = Outbox(write, self.inbox.close, self._settle)
        self._engine = self._new_engine(site)
        for output in self._files.outputs:
            self.watch_output(output)
        # before the first answer, so that the answers after a kill have higher revisions
        self._files.checkpoint(self._state, waits=True)
        self._reload = False
        now = clock()
        self._next_state, self._next_health, self._next_record = now + settings.every, now + settings.health, now
        self.metrics.gauges |= {
            "input": lambda: len(self.inbox),
            "output": lambda: len(self._outbox),
            "open": lambda: len(self._events.open),
        }
        self.metrics.alarms["account", "lines"] = lambda: self._imbalance
        self._thread = Thread(target=self._run, name="optloc stream", daemon=True)
        self._thread.start()

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
            track_settings=s.track_settings,
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
        adapter: Adapter | None = None,
    ) -> list[QueuedLine]:
        """Return data that was just read as lines, numbered from `first`, without blank lines of a pipe.

        `track` is as in `QueuedLine`. `adapter` converts the lines; a line on which it fails is refused later.
        """
        now, when = self.clock(), self._time()
        found = [(i, *convert(adapter, each)) for i, each in enumerate(data, first) if ticket or each.strip()]
        return [QueuedLine(each, i, source, now, when, ticket, track, fault) for i, each, fault in found]

    def start(self, source: LineSource) -> RunningSource:
        """Read a source in a separate thread, and again after an error."""
        return self.sources.start(source)

    def _watch(self, watch: Watch) -> None:
        """Show the state of a source in health and metrics."""
        self.metrics.alarms["source", watch.name] = lambda: watch.alarm
        self.metrics.restarts[watch.name] = lambda: watch.restarts

    def watch_output(self, output: SideOutput[Any]) -> None:
        """Show the state of a side output in health and metrics."""
        self.metrics.alarms["output", output.name] = lambda: output.alarm
        self.metrics.losses[output.name] = lambda: output.dropped

    @property
    def tracks(self) -> Tracks:
        """Return the tracks of the stream."""
        return self._engine.tracks

    @property
    def track_refusal(self) -> str:
        """Return the reason for which this stream cannot make tracks; empty if it can."""
        if self._settings.part[1] > 1:
            return "this process answers a part of the events, but a track needs all events of its target"
        return self.tracks.refusal

    def _time(self) -> float:
        """Return the time of the clock for which events wait, s: the clock without the seconds that do not count."""
        return self.clock() - self.uncounted

    def close(self) -> None:
        """Read no more lines, answer the waiting lines, and end; `ended` is set after the end of all threads."""
        self.inbox.close()

    def __enter__(self) -> Self:
        """Return the stream."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the stream, and wait for its end; raise the error that ended the stream, if any.

        After an interrupt (Ctrl-C), nothing is waited for.
        """
        self.close()
        if kind is not None and not issubclass(kind, Exception):
            return
        while self._thread.is_alive():
            self._thread.join(1.0)  # on Windows, a wait without a timeout blocks signals
        if kind is None and self.error is not None:
            raise self.error

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
        """Answer lines until the end, then end all other threads (the thread that answers).

        An error of one step is stored for the thread that waits, and the other steps follow.
        """
        for step in (
            self._loop,
            self.inbox.close,
            self._answer_rest,
            self._stop_engine,
            self.inbox.drop,
            self.sources.stop,  # after the answers to their lines, and before the last checkpoint counts their lines
            self._outbox.close,
            self._store_end,
            self._files.close,
        ):
            try:
                step()
            except Exception as error:  # noqa: BLE001  # raised in the thread that waits for the stream
                self.error = self.error or error
        self.ended.set()

    def _loop(self) -> None:
        """Read lines and answer closed events until the queue of lines is closed or the output fails."""
        while not self._outbox.failed:
            # `due` is the number of seconds until the next timed work. In a replay, only lines close events.
            due = min(self._engine.next_due, self._next_state, self._next_health, self._next_record) - self.clock()
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
            self._check_account()
            self._say(json.dumps({"health": self.health()}))
        if now >= self._next_record:
            self._next_record = now + _RECORD_EVERY
            self._files.write_record()
        if now >= self._next_state:
            self._next_state = now + self._settings.every
            self._files.checkpoint(self._state)

    @property
    def _can_write(self) -> bool:
        """Return whether answers can be written: the stream has no error, and the output is open."""
        return self.error is None and not self._outbox.failed

    def _answer_rest(self) -> None:
        """Answer all waiting events."""
        if self._can_write:
            self._events.flush(self.clock())
            self._answer_closed()

    def _stop_engine(self) -> None:
        """Finish the tracks and proofs, or drop them if they cannot be written, and wait for their threads."""
        if not self._can_write:
            self._engine.drop()
        self._engine.stop()
        self._engine.join(PATIENCE)

    def _store_end(self) -> None:
        """Check the account, and write the last checkpoint."""
        self._check_account()
        ended = self._can_write
        self._files.checkpoint(lambda: self._state(ended=ended))

    def _read(self, line: QueuedLine) -> None:
        """Read one line: add its rows to an event, or run its command; report an invalid line."""
        self.metrics.counts["lines"] += 1
        try:
            found, reply = self._take(line)
        except Exception as error:  # noqa: BLE001  # an error of one line must not end the stream
            found, reply = "refused", self._refuse(line, error)
        if isinstance(found, Event):
            found.lines[line.source] = found.lines.get(line.source, 0) + 1
        else:
            self.metrics.account.settle(found, {line.source: 1})
        if line.ticket is not None:
            line.ticket.handled(reply)

    def _take(self, line: QueuedLine) -> tuple[Event | str, Record | None]:
        """Return the event that gets the rows of a line, or the state of the line in the account, and its direct reply.

        Raise InvalidProblem for an invalid line. Only commands have a direct reply.
        """
        if line.fault:
            raise SourceLost(line.fault)
        data = line.data.strip()
        message = parse(data, self.site)
        self._files.record(data, line.stamp)
        if message.command:
            return "answered", self._run_command(message.command)
        track = self._settings.track if line.track is None else line.track
        return self._events.take(message, line.stamp, line.when, line.ticket, track=track), None

    def _refuse(self, line: QueuedLine, error: Exception) -> Record:
        """Count and report a line that cannot be read, and return the report."""
        LOG.debug("line %d of %s is refused", line.number, line.source, exc_info=error)
        # A line with an unknown name belongs to an event: record it, since it changes the answer.
        if isinstance(error, UnknownName):
            self._files.record(line.data.strip(), line.stamp)
            track = self._settings.track if line.track is None else line.track
            self._events.refuse(error, line.stamp, line.when, track=track)
        self.metrics.counts["malformed"] += 1
        refused: Record = {"error": sentence(error), "line": line.number, "source": line.source}
        if isinstance(error, RefusedRepeat):
            refused |= {**name_keys(error.name), "code": error.code}
        if line.ticket is None:
            self._emit(refused)
        return refused

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
        with self._settling:
            self._unsettled.update((id(event), event) for event in closed)
        for first in range(0, len(closed), BATCH):
            self._engine.solve(closed[first : first + BATCH])

    # Answers, from all threads.

    def _answer(self, event: Event, record: Record, last: bool) -> None:
        """Write an answer of an event, and pass it to all receivers; `last` marks the last answer of the event."""
        self._publish(record)
        whole = self._replies.answer(event, record, last)
        self._outbox.put(self._written(record, whole, last=last), event if last else None)

    def _written(self, record: Record, whole: Record, *, last: bool) -> bytes:
        """Return an answer in the output format, as `to_feed`; if the format fails, return the error as an answer."""
        try:
            return to_feed(self._settings.format, record, whole, self.site.frame, last=last)
        except Exception as error:  # an answer that cannot be written must not end the thread that made it
            LOG.debug("an answer cannot be written", exc_info=error)
            self.metrics.add("unwritable")
            return to_line({"event": record["event"], "error": sentence(error)})

    def _settle(self, events: Sequence[Event]) -> None:
        """Count the lines of events whose last answer was written as answered (the thread of the output)."""
        with self._settling:
            for event in events:
                self._unsettled.pop(id(event), None)
            self.metrics.account.settle("answered", total(event.lines for event in events))
            for event in events:
                event.lines = _NO_LINES

    def _check_account(self) -> None:
        """Compare the open lines of the account with the lines in queues and events; a difference is an alarm."""
        with self._settling:
            waiting = total(event.lines for event in (*self._unsettled.values(), *self._events.open.values()))
            found = self.inbox.difference(waiting)
        if found and self._imbalance is None:
            source, count = next(iter(found.items()))
            self._imbalance = Alarm(f"{count} open lines of {source} are in no queue and no event", self.clock())

    def _emit(self, record: Record) -> None:
        """Write a record that is not an answer: a note, an error, health."""
        self._publish(record)
        if self._settings.format in OF_RECORDS:
            self._outbox.put(self._format(record, self.site.frame) or b"")
        else:
            self._say(json.dumps(record))

    def _publish(self, record: Record) -> None:
        """Pass a record to the latest fixes and to the listeners; an error of a receiver must not end the thread."""
        receivers: tuple[Callable[[Record], None], ...] = (self.latest, *self.listeners)
        for receive in receivers:
            try:
                receive(record)
            except Exception as error:  # as above
                LOG.debug("a receiver of answers failed", exc_info=error)
                self.metrics.add("unwritable")

    # Files.

    def _reload_site(self) -> None:
        """Reload the file of the site after the events of the old site are answered."""
        if self._site_file is None:
            return
        try:
            with access(anew=True):
                site = read_site(self._site_file, self.site.method, self.site.options)
            warm_up(site, self._settings.phases)
        except Exception as error:  # noqa: BLE001  # an error of the new file must not end the stream
            self._say(f"The site is not changed: {sentence(error)}")
            return
        self._events.flush(self.clock())
        self._answer_closed()
        self._engine.stop()
        self.site = self._events.site = site
        self._engine = self._new_engine(site)
        self._events.closed = dict.fromkeys(self._events.closed)  # their rows belong to the old site
        self._say(f"The site is now {site.title!r}, with {len(site.rows)} rows of {len(site.stations)} stations.")

    def _state(self, *, ended: bool = False) -> Record:
        """Return the state for a checkpoint; events whose last answers are written count as closed."""
        with self._settling:
            return state_of(self._events, list(self._unsettled.values()), ended=ended)
