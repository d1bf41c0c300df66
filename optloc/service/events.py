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

from optloc.problem import InvalidProblem
from optloc.service.messages import Key, Message, name_keys
from optloc.service.metrics import Metrics
from optloc.service.site import Site, UnknownName

MOST_OPEN = 4096
"""Largest number of open events; beyond, the oldest event closes early."""

REMEMBERED = 65_536
"""Number of closed events whose rows are stored: a minute at a thousand events a second."""


OTHER, GONE = 409, 410
"""HTTP status codes of a repeated id: with other values, and with an answer that is no longer kept."""


class RefusedRepeat(InvalidProblem):
    """A request repeats the id of an event, but cannot have its answer.

    `name` is the name of the event, and `code` is `OTHER` or `GONE`.
    """

    def __init__(self, what: str, name: str, code: int) -> None:
        advice = {OTHER: "use another id, or name the client", GONE: "use another id"}[code]
        super().__init__(what, f"event {name_keys(name)['event'][:40]!r}", advice)
        self.name, self.code = name, code


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
        Id of the event, as in `optloc.service.messages.full_name`.
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
    replies : list of Reply
        Receivers of the answers.
    so_far : dict, optional
        Answers so far, as one record; None without any, and after the last.
    answered : bool
        Whether the event has its last answer.
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
    replies: list[Reply] = field(default_factory=list)
    so_far: dict[str, Any] | None = None
    answered: bool = False
    when: int | None = None
    track: bool = False
    refused: str = ""
    lines: dict[str, int] = field(default_factory=dict)


def _attach(event: Event, reply: Reply) -> bool:
    """Give a receiver the answers of an event that is not answered, and return whether it is not answered."""
    if not event.answered and reply not in event.replies:
        event.replies.append(reply)
        reply.expect()
    return not event.answered


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
    attach : callable
        Gives a receiver the answers of an event; returns False if they are gone. See `optloc.service.replies`.
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
    attach: Callable[[Event, Reply], bool] = _attach
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
        events wait, s. `reply` receives the answers. With `track`, a new event is answered by the state of its track.
        If another process answers the event, the rows are only counted. If the event is already closed, the rows are
        late or repeated. Raise RefusedRepeat for a line with a receiver that differs from the event of its id.
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
                return self._take_late(message, now, reply, track=track)
            event = Event(message.event, message.rows, message.times, when, now, message.sigmas or {}, message.target)
            event.when, event.track, event.revision = message.when, track, self.revision
            self._attach_reply(event, reply)
            if message.whole:
                self._close(event, "whole", now)
                return event
            self._open(event, now)
        else:
            if reply is not None:
                self._refuse_other_values(event, message, track=track)
            self._join(event, message)
            self._attach_reply(event, reply)
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
            if len(event.times) < len(site.arrival_stations):
                return False
            return all(i in event.rows for i in site.other_rows)
        return len(event.rows) >= len(site.rows) and all(i in event.rows for i in range(len(site.rows)))

    def _attach_reply(self, event: Event, reply: Reply | None) -> None:
        """Give the event a receiver of its answers, if there is one; raise RefusedRepeat if its answer is gone."""
        if reply is not None and not self.attach(event, reply):
            raise RefusedRepeat("its answer is no longer kept", event.name, GONE)

    def _refuse_other_values(self, event: Event, message: Message, *, track: bool) -> None:
        """Raise RefusedRepeat if a line has other values than the event of its id."""
        other = self._differing(event, message)
        self.metrics.counts["conflicts"] += len(other)
        for key in ("target", "when"):
            given = getattr(message, key)
            if given not in ("", None) and given != getattr(event, key):
                other.append({"target": "its target", "when": "its time"}[key])
        sigmas = message.sigmas or {}
        if any(event.sigmas.get(key) != sigma for key, sigma in sigmas.items() if key in event.rows):
            other.append("its sigma")
        if event.track != track:
            other.append("its form, fix or track")
        if other:
            more = f" and {len(other) - 3} more" if len(other) > 3 else ""
            raise RefusedRepeat(f"the id is used with other values: {', '.join(other[:3])}{more}", event.name, OTHER)

    def _differing(self, event: Event, message: Message) -> list[str]:
        """Return the names of the rows and stations of a line that have another value in the event."""
        site = self.site
        other = [site.name_of(key) for key, value in message.rows.items() if event.rows.get(key, value) != value]
        return other + [site.stations[i] for i, value in message.times.items() if event.times.get(i, value) != value]

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

    def _take_late(self, message: Message, now: float, reply: Reply | None, *, track: bool) -> Event | str:
        """Handle rows that arrive after their event has closed: count them, send notes, or answer again.

        A receiver gets the answer of the event; a line with other rows or values is refused. The result is as
        in `take`.
        """
        event, counts = self.closed[message.event], self.metrics.counts
        if event is None:
            counts["repeated"] += len(message.rows) + len(message.times)
            if reply is not None:
                raise RefusedRepeat("its answer is no longer kept", message.event, GONE)
            return "answered"
        if reply is not None:
            self._refuse_other_values(event, message, track=track)
        site = self.site
        late = [site.name_of(key) for key in message.rows if key not in event.rows]
        late += [site.stations[i] for i in message.times if i not in event.times]
        other = self._differing(event, message)
        counts["conflicts"] += len(other)
        counts["repeated"] += len(message.rows) + len(message.times) - len(late) - len(other)
        counts["late"] += len(late)
        if other:
            self.note({**name_keys(event.name), "note": "conflict", "rows": other})
        if late and not self.revise:
            self.note({**name_keys(event.name), "note": "late", "rows": late})
            if reply is not None:
                raise RefusedRepeat(f"it is answered without {', '.join(late[:3])}", event.name, OTHER)
        if late and self.revise:
            again = Event(
                name=event.name,
                rows={**message.rows, **event.rows},
                times={**message.times, **event.times},
                first=now,
                stamp=now,
                sigmas={**(message.sigmas or {}), **event.sigmas},
                target=event.target or message.target,
                closed="late",
                revision=event.revision + 1,
                conflict=event.conflict or bool(other),
                when=event.when,
                track=event.track,
                refused=event.refused,
            )
            counts["revisions"] += 1
            self.closed[event.name] = again
            self.ready.append(again)
            self._attach_reply(again, reply)
            return again
        self._attach_reply(event, reply)
        return "dropped" if late or other else "answered"


def share_of(event: str, count: int) -> int:
    """Return the number from 0 to `count` - 1 of the process that answers an event; it is the same on all machines."""
    return crc32(event.encode("utf-8", "surrogatepass")) % count
