"""Engine of a stream: fixes at once, and proofs under a deadline, in small batches of events.

Each set of rows has a prepared problem. The calling thread computes fixes (first phase); a second thread computes
proofs (second phase). In shapes, n is the number of events of a batch, and m the number of rows.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import inf
from threading import Condition, Thread
from typing import Any, NamedTuple

import numpy as np

from optloc.engine import simulate
from optloc.model_checks import refuse_impossible, suspicious_values
from optloc.problem import Array, InvalidProblem, Status
from optloc.service.answers import Record, fix_records, proof_records, unproven_record, unsolved_record
from optloc.service.events import Event
from optloc.service.metrics import Metrics
from optloc.service.site import Ready, Site, SiteRow
from optloc.service.tracks import Scan, Tracks, TrackSettings
from optloc.solvers import PreparedFloors

LOG = logging.getLogger("optloc.service")

BATCH = 64
"""Largest number of events that are solved together: single events at low rates, all waiting events under load."""

PENDING = 256
"""Largest number of waiting proofs; further events are answered without a proof, or wait, by the settings."""

PHASES = ("two", "one", "fix")
"""Answers of an event: a fix at once and its proof later, both in one answer after the proof, or no proof."""

# Reason of an event of a track at a site with several floors.
_ON_FLOORS = "a track needs one height, and the site lists several; state one height, or send the event without a track"
# Number of groups of events whose values are checked: a wrong unit is the same in all events.
_CHECKED = 8

Emit = Callable[[Event, Record, bool], None]
"""Receives an event, its answer, and whether it is the last answer."""


class EventGroup(NamedTuple):
    """Events of a batch with the same rows: their prepared problem, and their measurements `z` (n, m), SI."""

    ready: Ready
    events: list[Event]
    z: Array


@dataclass(slots=True, eq=False)
class Pending:
    """A proof that is not finished.

    event: its event. ready: prepared problem. z: measurements (m,), SI. before: answer of the first phase, or None if
    no answer was written. until: deadline by the clock of the stream, s. done: whether the event has its last answer.
    """

    event: Event
    ready: Ready
    z: Array
    before: Record | None
    until: float
    done: bool = False


class Engine:
    """Solver of events: the first phase runs in the calling thread, the second phase in a separate thread.

    Parameters
    ----------
    site : Site
        Site of the events.
    metrics : Metrics
        Counters.
    emit : callable
        Receives the answers, from both threads.
    clock : callable
        Monotonic clock, s.
    phases : "two", "one" or "fix"
        As in `PHASES`.
    deadline : float
        Seconds from the closing of an event to the end of its proof; infinity for no deadline.
    shed : bool
        Whether events are answered without a proof if too many wait; otherwise the stream waits.
    track_settings : TrackSettings, optional
        Settings of tracks.
    """

    def __init__(
        self,
        site: Site,
        metrics: Metrics,
        emit: Emit,
        clock: Callable[[], float],
        *,
        phases: str = "two",
        deadline: float = inf,
        shed: bool = True,
        track_settings: TrackSettings | None = None,
    ) -> None:
        self.site, self._metrics, self._emit, self._clock = site, metrics, emit, clock
        self._phases, self._deadline, self._shed = phases, deadline, shed
        self._waiting: deque[Pending] = deque()
        # waiting and running proofs, in the order of their deadlines
        self._open: deque[Pending] = deque()
        self._changed, self._ends = Condition(), False
        self._thread = Thread(target=self._prove, name="optloc proofs", daemon=True)
        self._to_check, self._warned = _CHECKED, set[str]()
        first = site.whole.fast
        self._untrackable = _ON_FLOORS if isinstance(first, PreparedFloors) else ""
        self.tracks = Tracks(first.problem, track_settings or TrackSettings(), metrics, self._answer_scan, clock)
        metrics.gauges["proofs"] = lambda: len(self._waiting)
        if phases != "fix":
            self._thread.start()

    @property
    def next_due(self) -> float:
        """Return the earliest deadline of a proof; infinity without open proofs."""
        with self._changed:
            return self._open[0].until if self._open else inf

    def solve(self, events: Iterable[Event]) -> None:
        """Answer closed events with fixes and queue their proofs; pass events of tracks to their tracks.

        An event with an error is answered by its error. With the phases "one", an event is answered after its proof
        only.
        """
        closed, tracked = list[Event](), list[Event]()
        for event in events:
            refused = event.refused or (self._untrackable if event.track else "")
            if refused:
                self._answer_error(event, refused)
            else:
                (tracked if event.track else closed).append(event)
        self._follow(tracked)
        for group in self._groups(closed):
            if self._phases == "one":
                self._offer(self._proofs_of(group, [None] * len(group.events)))
            else:
                self._answer_fixes(group)

    def expire(self) -> None:
        """Answer the events whose proofs have passed their deadlines."""
        now, late = self._clock(), []
        with self._changed:
            while self._open and (self._open[0].done or self._open[0].until <= now):
                item = self._open.popleft()
                if not item.done:
                    item.done = True
                    late.append(item)
        self._give_up(late, "deadline")

    def drop(self) -> None:
        """Leave the waiting tracks and proofs without an answer, because no answer can be written."""
        self.tracks.drop()
        with self._changed:
            for item in self._open:
                item.done = True
            self._waiting.clear()
            self._open.clear()
            self._changed.notify_all()

    def stop(self) -> None:
        """Finish the waiting tracks and the proofs within their deadlines, and end.

        A proof that runs beyond its deadline ends later, and its result is dropped; see `join`.
        """
        self.tracks.stop()
        with self._changed:
            self._ends = True
            self._changed.notify_all()
        while self._thread.is_alive():
            self._thread.join(min(max(self.next_due - self._clock(), 1e-3), 0.1))
            self.expire()
            with self._changed:
                if all(item.done for item in self._open):
                    return  # running proofs are already given up

    def join(self, seconds: float) -> None:
        """Wait at most `seconds` for the thread of the proofs, after `stop`."""
        if self._thread.is_alive():
            self._thread.join(seconds)

    # Batches.

    def _follow(self, events: Sequence[Event]) -> None:
        """Pass events of tracks to their tracks, in the order in which they closed."""
        scans = [Scan(e, group.ready.fast.problem, z) for group in self._groups(events) for e, z in _pairs(group)]
        # groups are by rows, but tracks need the order of time
        place = {id(event): i for i, event in enumerate(events)}
        if scans:
            self.tracks.take(sorted(scans, key=lambda scan: place[id(scan.event)]))

    def _answer_fixes(self, group: EventGroup) -> None:
        """Answer the events of a group with fixes, and queue their proofs unless no proofs are wanted."""
        last = self._phases == "fix"
        records = self._first_records(group, "fix", pending=not last)
        self._metrics.note_latency("fix", [self._clock() - event.stamp for event in group.events])
        for event, record in zip(group.events, records, strict=True):
            self._answer(event, record, last or "error" in record)
        if not last:
            self._offer(self._proofs_of(group, records))

    def _proofs_of(self, group: EventGroup, records: Sequence[Record | None]) -> list[Pending]:
        """Return the proofs of the events of a group; `records` has the answers of the first phase, or None.

        An event whose first answer is an error has no proof.
        """
        return [
            Pending(event, group.ready, z, record, event.stamp + self._deadline)
            for (event, z), record in zip(_pairs(group), records, strict=True)
            if record is None or "error" not in record
        ]

    def _groups(self, events: Iterable[Event]) -> list[EventGroup]:
        """Return events grouped by rows; answer events whose rows give no problem at once."""
        found: dict[tuple[tuple[int, ...], tuple[SiteRow, ...]], list[Event]] = {}
        all_rows = tuple(range(len(self.site.rows)))
        names: dict[tuple[Any, ...], tuple[SiteRow, ...]] = {all_rows: self.site.rows}
        for event in events:
            # Sort the rows, so that events with the same rows in another order share one problem. `names` stores rows
            # only for events without standard deviations.
            keys = tuple(event.rows)
            if event.sigmas or keys not in names:
                keys = tuple(sorted(keys, key=_order))
                rows = tuple(self.site.row(key)._replace(sigma=event.sigmas.get(key)) for key in keys)
                event.rows = {key: event.rows[key] for key in keys}
                if not event.sigmas:
                    names[keys] = rows
            else:
                rows = names[keys]
            found.setdefault((tuple(sorted(event.times)), rows), []).append(event)
        return [group for key, members in found.items() for group in self._group(key, members)]

    def _group(self, key: tuple[tuple[int, ...], tuple[SiteRow, ...]], events: list[Event]) -> list[EventGroup]:
        """Return events with equal rows as one group; the result is empty if their rows give no problem.

        `key` has the numbers of the stations with arrivals, and the rows with values. Events without a problem are
        answered at once with an error or a status.
        """
        receivers, rows = key
        now = self._clock()
        self._metrics.note_rows((self.site.stations[i] for i in receivers), now)
        self._metrics.note_rows((name for row in rows for name in (row.a, row.b) if name), now)
        try:
            ready = self.site.ready(receivers, rows)
        except InvalidProblem as error:
            for event in events:
                self._answer_error(event, str(error))
            return []
        if ready is None:
            for event in events:
                self._answer(event, unsolved_record(event, status=Status.TOO_FEW_ROWS.label), last=True)
            return []
        # differences of integers: a float of seconds since 1970 only resolves 70 m
        arrivals = np.array([_since_first(event, receivers) for event in events], dtype=float).reshape(len(events), -1)
        values = np.array([list(event.rows.values()) for event in events], dtype=float).reshape(len(events), -1)
        return self._possible(EventGroup(ready, events, ready.si(arrivals, values)))

    def _possible(self, group: EventGroup) -> list[EventGroup]:
        """Return the group without impossible events, which are answered; log suspicious values of the first groups."""
        ready, problem = group.ready, group.ready.fast.problem
        bad = (group.z < ready.least).any(-1)
        for i in np.flatnonzero(bad).tolist():
            try:
                refuse_impossible(problem.with_rows(z=group.z[i]), lambda _: self.site.source, "live")
            except InvalidProblem as error:
                self._answer_error(group.events[i], str(error))
        kept = np.flatnonzero(~bad).tolist()
        if bad.any():
            group = EventGroup(ready, [group.events[i] for i in kept], group.z[kept])
        if kept and self._to_check > 0:
            self._to_check -= 1
            found = suspicious_values(problem.with_rows(z=group.z), "live", speed=self.site.speed)
            for one in (one for one in found if one.cause not in self._warned):
                self._warned.add(one.cause)
                LOG.warning("%s: %s; %s", self.site.source, one.seen, one.advice)
        return [group] if kept else []

    def _first_records(self, group: EventGroup, phase: str | None, *, pending: bool = False) -> list[Record]:
        """Return the answers of the first phase (n), as `fix_records`; if the solver fails, each has the error."""
        try:
            return fix_records(group.ready.fast(group.z), group.events, phase, pending=pending)
        except Exception as error:  # noqa: BLE001  # an error of one event must not end the stream
            return self._error_records(group, error)

    def _error_records(self, group: EventGroup, error: Exception) -> list[Record]:
        """Return answers with an error for all events of a group, and log errors that are not errors of the input."""
        if not isinstance(error, InvalidProblem):
            LOG.error("events failed, from %s on", group.events[0].name, exc_info=error)
        why = str(error) if isinstance(error, InvalidProblem) else f"{type(error).__name__}: {error}"
        self._metrics.add("unsolvable", len(group.events))
        return [unsolved_record(event, error=why) for event in group.events]

    def _answer_error(self, event: Event, why: str) -> None:
        """Answer an event with the error `why`, and count it."""
        self._metrics.add("unsolvable")
        self._answer(event, unsolved_record(event, phase="track" if event.track else "fix", error=why), last=True)

    def _answer(self, event: Event, record: Record, last: bool) -> None:
        """Send an answer of an event; with `last`, count its status and its proof."""
        if last:
            self._metrics.count_event(record.get("status", "error"), record.get("proof"))
        self._emit(event, record, last)

    def _answer_scan(self, event: Event, record: Record) -> None:
        """Send the answer of a track, which is the only answer of its event."""
        self._emit(event, record, True)

    # Proofs, in a separate thread.

    def _offer(self, items: Sequence[Pending]) -> None:
        """Queue proofs; if the queue is full, wait, or answer without a proof with `shed`."""
        rejected: Sequence[Pending] = ()
        with self._changed:
            if self._shed:
                free_places = max(PENDING - len(self._waiting), 0)
                items, rejected = items[:free_places], items[free_places:]
            else:
                self._changed.wait_for(lambda: len(self._waiting) < PENDING)
            self._waiting.extend(items)
            self._open.extend(items)
            self._changed.notify_all()
        self._give_up(rejected, "skipped: load")

    def _give_up(self, items: Sequence[Pending], why: str) -> None:
        """Answer events without their proofs, and count them; `why` is "deadline" or "skipped: load".

        Events without an answer of the first phase are fixed now.
        """
        self._metrics.add("overdue" if why == "deadline" else "skipped", len(items))
        for group in _proof_groups([item for item in items if item.before is None]):
            for event, record in zip(group.events, self._first_records(group, None), strict=True):
                whole = record if "error" in record else unproven_record(event, why, record, answered=False)
                self._answer(event, whole, last=True)
        for item in items:
            if item.before is not None:
                self._answer(item.event, unproven_record(item.event, why, item.before, answered=True), last=True)

    def _prove(self) -> None:
        """Compute the waiting proofs in batches until the engine ends (the second thread)."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ends)
                if not self._waiting:
                    return
                taken = [self._waiting.popleft() for _ in range(min(len(self._waiting), BATCH))]
                self._changed.notify_all()
            for group in _proof_groups([item for item in taken if not item.done]):
                try:
                    self._conclude(group, {id(item.event): item for item in taken})
                except Exception:  # an answer that cannot be passed on must not end all proofs
                    LOG.exception("answers of proofs failed, from %s on", group.events[0].name)

    def _conclude(self, group: EventGroup, items: dict[int, Pending]) -> None:
        """Prove the fixes of events, and answer the events that are still open.

        `items` has the pending proofs by the identity of the event, since late rows may have given an event of the same
        name. Events that passed their deadline meanwhile have their last answer, so their proofs are dropped.
        """
        pending = [items[id(event)] for event in group.events]
        try:
            fix = group.ready.full(group.z)
            records = proof_records(fix, group.events, [item.before for item in pending])
        except Exception as error:  # noqa: BLE001  # as in the first phase
            records = self._error_records(group, error)
        answered = []
        with self._changed:
            for item, record in zip(pending, records, strict=True):
                if not item.done:
                    item.done = True
                    answered.append((item.event, record))
            while self._open and self._open[0].done:
                self._open.popleft()
        self._metrics.note_latency("proof", [self._clock() - event.stamp for event, _ in answered])
        for event, record in answered:
            self._answer(event, record, last=True)


def warm_up(site: Site, phases: str) -> None:
    """Solve simulated events, so that machine code is loaded before the first real event.

    `phases` are the phases of the answers: "two", "one" or "fix".
    """
    ready = site.whole
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


def _order(key: int | SiteRow) -> tuple[int, tuple[str, ...]]:
    """Return the sort key of a row: in the order of the template, then rows that are not in the template."""
    return (key, ()) if isinstance(key, int) else (1 << 30, key[2:5])


def _since_first(event: Event, receivers: Sequence[int]) -> list[int]:
    """Return the arrivals at the stations `receivers` in picoseconds since the first arrival of the event."""
    times = event.times
    first = min(times.values(), default=0)
    return [times[i] - first for i in receivers]


def _pairs(group: EventGroup) -> list[tuple[Event, Array]]:
    """Return each event of a group with its measurements (m,), SI."""
    return list(zip(group.events, group.z, strict=True))


def _proof_groups(items: Sequence[Pending]) -> list[EventGroup]:
    """Return proofs grouped by prepared problem."""
    found: dict[int, list[Pending]] = {}
    for item in items:
        found.setdefault(id(item.ready), []).append(item)
    return [
        EventGroup(group[0].ready, [item.event for item in group], np.stack([item.z for item in group]))
        for group in found.values()
    ]
