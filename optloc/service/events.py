"""Events of a stream: open while rows arrive, then closed and answered, then remembered.

A message has rows, or arrivals at stations, of one event. An event is open until all its rows are present or its
waiting time is over; then it closes and is answered. Two clocks are used. `now` is a monotonic clock, s. `when` is the
clock for which events wait, s. It follows recorded times in a replay, and runs slowly while lines wait to be read.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol
from zlib import crc32

from optloc.service.messages import Key, Message
from optloc.service.metrics import Metrics
from optloc.service.site import Site, UnknownName

MOST_OPEN = 4096
"""Largest number of open events; beyond, the oldest event closes early."""

REMEMBERED = 65_536
"""Number of closed events whose rows are stored: a minute at a thousand events a second."""


class Reply(Protocol):
    """Receiver of the answers of an event, in addition to the output: the client that sent its lines."""

    def expect(self) -> None:
        """Register one more event to be answered."""

    def answer(self, record: dict[str, Any], last: bool) -> None:
        """Take an answer; `last` marks the last answer of an event."""


@dataclass(slots=True)
class Event:
    """Rows that form one event.

    Parameters
    ----------
    name : str
        Id of the event.
    rows, times, sigmas, target
        As in `Message`.
    first : float
        Time of its first row, by the time for which events wait, s.
    stamp : float
        Time at which it could be answered, by the clock, s: its last row was read, or its wait was over.
    closed : str
        Closing reason: "whole", "wait", "flush" or "early".
    revision : int
        1, and one more for each answer with late rows.
    conflict : bool
        Whether a row had two values.
    when : int, optional
        As in `Message`.
    track : bool
        Whether the answer is the state of a track instead of a fix.
    reply : Reply, optional
        Receiver of the answers.
    refused : str
        Error if a line has a station or a kind that the site does not have; the event is then not solved.
    lines : dict of str to int
        Number of its lines by source, which count as open until the event has its last answer.
    """

    name: str
    rows: dict[Key, float]
    times: dict[int, int]
    first: float
    stamp: float
    sigmas: dict[Key, float] = field(default_factory=dict)
    target: str = ""
    closed: str = ""
    revision: int = 1
    conflict: bool = False
    reply: Reply | None = None
    when: int | None = None
    track: bool = False
    refused: str = ""
    lines: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class Events:
    """Open and closed events of one stream, for one thread.

    Parameters
    ----------
    site : Site
        Rows and stations of an event.
    metrics : Metrics
        Counters.
    note : callable
        Receives a record of each row that is late, or changes its value, after its event was answered.
    wait : float
        Seconds from the first row of an event to its closing.
    revise : bool
        Whether late rows give a new answer.
    part : (int, int)
        Number of this process and number of processes: each answers a share of the events.
    most : int
        Largest number of open events.
    revision : int
        Revision of the first answer of an event: 1, and one more for each start after a kill.
    """

    site: Site
    metrics: Metrics
    note: Callable[[dict[str, Any]], None]
    wait: float = 0.05
    revise: bool = False
    part: tuple[int, int] = (0, 1)
    most: int = MOST_OPEN
    revision: int = 1
    open: dict[str, Event] = field(default_factory=dict)
    # None: an id from a checkpoint, without rows
    closed: dict[str, Event | None] = field(default_factory=dict)
    ready: deque[Event] = field(default_factory=deque)
    # names of closed events in order: the first key of a dictionary is slow to find after many deletions
    _order: deque[str] = field(default_factory=deque)

    def take(
        self, message: Message, now: float, when: float, reply: Reply | None = None, *, track: bool = False
    ) -> Event | str:
        """Add the rows of a line to its event, and close the event if it is whole.

        Return the event that answers the line. Without such an event, return the state of the line in the account:
        "answered" for rows that repeat an answered event, otherwise "dropped".

        `now` is the time of reading by the monotonic clock, s; `when` is the time of reading by the clock for which
        events wait, s. `reply` receives the answers unless the event already has a receiver. With `track`, a new event
        is answered by the state of its track. If another process answers the event, the rows are only counted. If the
        event is already closed, the rows are late or repeated.
        """
        counts = self.metrics.counts
        size = len(message.rows) + len(message.times)
        counts["rows"] += size
        if self.part[1] > 1 and share_of(message.event, self.part[1]) != self.part[0]:
            counts["elsewhere"] += size
            return "dropped"
        event = self.open.get(message.event)
        if event is None:
            if message.event in self.closed:
                return self._after(message, now)
            event = Event(message.event, message.rows, message.times, when, now, message.sigmas or {}, message.target)
            event.when, event.track, event.revision = message.when, track, self.revision
            self._wait_for(event, reply)
            if message.whole:
                self._close(event, "whole", now)
                return event
            self._open(event, now)
        else:
            self._join(event, message)
            self._wait_for(event, reply)
        if message.whole or self._is_whole(event):
            self.open.pop(event.name, None)
            self._close(event, "whole", now)
        return event

    def refuse(self, error: UnknownName, now: float, when: float, *, track: bool = False) -> None:
        """Reject the event of a line with an unknown station or kind, if other lines also belong to the event.

        When the event closes, its answer is the error: without the rows of this line it would be a different event. If
        the line is a whole event, only the line is rejected, and may be sent again. `now`, `when` and `track` are as in
        `take`.
        """
        if self.part[1] > 1 and share_of(error.event, self.part[1]) != self.part[0]:
            return
        event = self.open.get(error.event)
        if event is None:
            if error.whole or not error.event or error.event in self.closed:
                return
            event = Event(error.event, {}, {}, when, now, track=track, revision=self.revision)
            self._open(event, now)
        event.refused = event.refused or str(error)
        if error.whole:
            self._close(self.open.pop(event.name), "whole", now)

    def _open(self, event: Event, now: float) -> None:
        """Add a new event to the open events; if there are too many, close the oldest."""
        self.open[event.name] = event
        if len(self.open) > self.most:
            self.metrics.counts["early"] += 1
            oldest = next(iter(self.open))
            self._close(self.open.pop(oldest), "early", now)

    def due(self, when: float, now: float) -> None:
        """Close the events whose waiting time is over; `when` and `now` are as in `take`."""
        while self.open:
            event = next(iter(self.open.values()))
            if when < event.first + self.wait:
                return
            del self.open[event.name]
            self.metrics.counts["incomplete"] += 1
            self._close(event, "wait", now)

    @property
    def next_due(self) -> float:
        """Return the time at which the next event closes, by the clock for which events wait, s; infinity if none."""
        return next(iter(self.open.values())).first + self.wait if self.open else float("inf")

    def flush(self, now: float) -> None:
        """Close all open events; `now` is as in `take`."""
        for event in self.open.values():
            self._close(event, "flush", now)
        self.open.clear()

    def closing(self) -> Iterator[Event]:
        """Yield the events that have closed since the last call."""
        while self.ready:
            yield self.ready.popleft()

    def _join(self, event: Event, message: Message) -> None:
        """Add rows to an open event; if a row occurs twice, the first value is kept."""
        counts = self.metrics.counts
        known: list[tuple[dict[Any, Any], dict[Any, Any]]] = [
            (event.rows, message.rows),
            (event.times, message.times),
        ]
        for stored, new in known:
            for key, value in new.items():
                if key not in stored:
                    stored[key] = value
                elif stored[key] == value:
                    counts["repeated"] += 1
                else:
                    counts["conflicts"] += 1
                    event.conflict = True
        if message.sigmas:
            event.sigmas = {**message.sigmas, **event.sigmas}
        event.target = event.target or message.target
        event.when = message.when if event.when is None else event.when

    def _is_whole(self, event: Event) -> bool:
        """Return whether an event has all its rows, so that it need not wait.

        With arrivals, these are the arrivals at all stations of the template, and the rows that arrivals do not give.
        """
        site = self.site
        if event.times:
            if len(event.times) < len(site.hearing):
                return False
            return all(i in event.rows for i in site.others)
        return len(event.rows) >= len(site.rows) and all(i in event.rows for i in range(len(site.rows)))

    def _wait_for(self, event: Event, reply: Reply | None) -> None:
        """Give the event a receiver of its answers, if it has none."""
        if reply is not None and event.reply is None:
            event.reply = reply
            reply.expect()

    def _close(self, event: Event, why: str, now: float) -> None:
        """Close an event for the reason `why`, and queue it for its answer."""
        event.closed, event.stamp = why, now
        self.metrics.counts["events"] += 1
        self.remember(event.name, event)
        self.ready.append(event)

    def remember(self, name: str, event: Event | None) -> None:
        """Store a closed event, so that late rows are recognised; forget the oldest event if there are too many.

        `event` is None if only the name is known, as from a checkpoint.
        """
        self.closed[name] = event
        self._order.append(name)
        if len(self._order) > REMEMBERED:
            self.closed.pop(self._order.popleft(), None)

    def _after(self, message: Message, now: float) -> Event | str:
        """Handle rows that arrive after the answer of their event: count them, send notes, or answer again.

        The result is as in `take`.
        """
        event, counts = self.closed[message.event], self.metrics.counts
        if event is None:
            counts["repeated"] += len(message.rows) + len(message.times)
            return "answered"
        site = self.site
        late = [site.name_of(key) for key in message.rows if key not in event.rows]
        late += [site.stations[i] for i in message.times if i not in event.times]
        other = [site.name_of(key) for key, value in message.rows.items() if event.rows.get(key, value) != value]
        other += [site.stations[i] for i, value in message.times.items() if event.times.get(i, value) != value]
        counts["conflicts"] += len(other)
        counts["repeated"] += len(message.rows) + len(message.times) - len(late) - len(other)
        counts["late"] += len(late)
        if other:
            self.note({"event": event.name, "note": "conflict", "rows": other})
        if late and not self.revise:
            self.note({"event": event.name, "note": "late", "rows": late})
        if late and self.revise:
            again = Event(
                event.name, {**message.rows, **event.rows}, {**message.times, **event.times}, now, now,
                {**(message.sigmas or {}), **event.sigmas}, event.target or message.target,
                "late", event.revision + 1, event.conflict or bool(other), None, event.when, event.track, event.refused,
            )  # fmt: skip
            counts["revisions"] += 1
            self.closed[event.name] = again
            self.ready.append(again)
            return again
        return "dropped" if late or other else "answered"


def share_of(event: str, count: int) -> int:
    """Return the number from 0 to `count` - 1 of the process that answers an event; it is the same on all machines."""
    return crc32(event.encode("utf-8", "surrogatepass")) % count
