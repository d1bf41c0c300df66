"""Tracks of the targets of a stream: the state of each target after each of its events."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from threading import Condition, Thread
from typing import NamedTuple

import numpy as np

from optloc.problem import Array, InvalidProblem, Problem
from optloc.service.answers import UNNAMED, Record, track_record, unsolved_record
from optloc.service.events import Event
from optloc.service.metrics import Metrics
from optloc.tracking import Dynamics, Entry, Follower, Rules, Update, alone, polynomial

LOG = logging.getLogger("optloc.service")

# Largest number of events that wait for their track; then the stream waits, since no scan may be lost.
_WAITING = 256


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """Settings of the tracks of a stream, and their largest number.

    Parameters
    ----------
    dynamics : Dynamics
        Motion model; by default constant velocity with a process noise of 1 m/s^2, as in ``optloc track``.
    update : callable or str
        A filter, or its name in `optloc.tracking.UPDATES`.
    rules : Rules
        Rules for the gate, and for the start and end of tracks.
    most : int
        Largest number of tracks, more than the aircraft of a busy sky; beyond, the track without events for longest is
        removed.
    age : float
        Seconds without events after which a track is removed; `Rules.gap` or the covariance has ended it before.
    """

    dynamics: Dynamics = field(default_factory=lambda: polynomial(1, 1.0))
    update: Update | str = "iekf"
    rules: Rules = field(default_factory=Rules)
    most: int = 1024
    age: float = 300.0

    def follower(self) -> Follower:
        """Return the tracker of a new target."""
        return Follower(self.dynamics, self.update, self.rules)


class Scan(NamedTuple):
    """An event in the form for a tracker: its problem, and its measurements (m,)."""

    event: Event
    problem: Problem
    z: Array


@dataclass(slots=True)
class _StoredTrack:
    """A stored track.

    follower: tracker of the target. origin: time of its first event, picoseconds. updated: time of its last event by
    the clock of the stream, s. last: last answer.
    """

    follower: Follower
    origin: int
    updated: float = 0.0
    last: Record | None = None


class Tracks:
    """The tracks of a stream, computed in a separate thread, so that no fix waits for the start of a track.

    Parameters
    ----------
    problem : Problem
        Problem of a whole event of the site.
    settings : TrackSettings
        Settings.
    metrics : Metrics
        Counters.
    emit : callable
        Receives an event and its answer.
    clock : callable
        Monotonic clock, s.
    """

    def __init__(
        self,
        problem: Problem,
        settings: TrackSettings,
        metrics: Metrics,
        emit: Callable[[Event, Record], None],
        clock: Callable[[], float],
    ) -> None:
        self._settings, self._metrics, self._emit, self._clock = settings, metrics, emit, clock
        # tracks by target, in the order of their last events, the oldest first
        self._kept: dict[str, _StoredTrack] = {}
        self._waiting, self._ends = deque[Scan](), False
        self._changed = Condition()
        self._thread: Thread | None = None
        self._problem = problem
        metrics.gauges |= {"scans": lambda: len(self._waiting), "tracks": lambda: len(self._kept)}

    @cached_property
    def refusal(self) -> str:
        """Return the reason for which events of the site make no tracks; empty if they do."""
        return _reason_without_tracks(self._problem, self._settings)

    def take(self, scans: Sequence[Scan]) -> None:
        """Queue events in the order in which they closed; the caller waits while the queue is full."""
        with self._changed:
            if self._thread is None:
                self._thread = Thread(target=self._run, name="optloc tracks", daemon=True)
                self._thread.start()
            for scan in scans:
                self._changed.wait_for(lambda: len(self._waiting) < _WAITING)
                self._waiting.append(scan)
                self._changed.notify_all()

    def stop(self) -> None:
        """Answer the waiting events, and end."""
        with self._changed:
            self._ends = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def drop(self) -> None:
        """Leave the waiting events without an answer."""
        with self._changed:
            self._waiting.clear()
            self._changed.notify_all()

    def records(self) -> list[Record]:
        """Return the last answer of each stored track, with the seconds since then (`age`), the latest first."""
        with self._changed:
            now = self._clock()
            self._forget(now)
            kept = [(each.last, now - each.updated) for each in self._kept.values() if each.last is not None]
        return [record | {"age": round(age, 3)} for record, age in reversed(kept)]

    def _run(self) -> None:
        """Answer the waiting events until the tracks end (the thread of the tracks)."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ends)
                if not self._waiting:
                    return
                scan = self._waiting.popleft()
                self._changed.notify_all()
            try:
                record = self._track_event(*scan)
            except Exception as error:  # noqa: BLE001  # an error of one event must not end the stream
                record = self._error_record(scan.event, error)
            self._metrics.note_latency("track", [self._clock() - scan.event.stamp])
            self._emit(scan.event, record)

    def _error_record(self, event: Event, error: Exception) -> Record:
        """Return the answer to an event whose track failed.

        An unexpected error also removes the track.
        """
        if isinstance(error, InvalidProblem):
            self._metrics.add("unsolvable")
            return unsolved_record(event, phase="track", error=str(error))
        LOG.error("event %s failed in its track", event.name, exc_info=error)
        # remove the track, since its state may be half updated
        with self._changed:
            self._kept.pop(event.target or UNNAMED, None)
        self._metrics.add("unsolvable")
        self._metrics.add("forgotten")
        return unsolved_record(event, phase="track", error=f"{type(error).__name__}: {error}; a new track starts")

    def _track_event(self, event: Event, problem: Problem, z: Array) -> Record:
        """Return the answer to an event from the track of its target.

        `z` (m,) are the measurements of `problem`, SI. An event that is not later than the last event of its track is
        refused. Raise InvalidProblem for an event without a time, or a site without tracks.
        """
        if self.refusal:
            raise InvalidProblem(self.refusal, None, "request fixes instead of tracks")
        when = event.when if event.when is not None else min(event.times.values(), default=None)
        if when is None:
            raise InvalidProblem("a track needs the time of the event", "time", "add time, time_ns or time_ps")
        name = event.target or UNNAMED
        kept = self._kept.get(name)
        track = kept or _StoredTrack(self._settings.follower(), when)
        # subtract integers of picoseconds first, since a float would lose digits
        time = (when - track.origin) * 1e-12
        if track.follower.last >= time:
            self._metrics.add("unordered")
            what = (
                f"the event is {track.follower.last - time:.6g} s before the last event of {name}, or at the same time"
            )
            error = InvalidProblem(what, "time", "send the events of a target in the order of their times")
            return unsolved_record(event, phase="track", error=str(error))
        entries = track.follower.take(scan_of(problem, z, time))
        entry = entries[-1] if entries and entries[-1].time == time else None
        record = _answer_of(event, when, entry, track.follower, problem)
        with self._changed:
            now = self._clock()
            self._kept.pop(name, None)
            track.updated, track.last = now, record
            self._kept[name] = track
            self._metrics.add("tracked")
            self._metrics.count_scan(record["status"])
            self._forget(now)
        return record

    def _forget(self, now: float) -> None:
        """Remove tracks without recent events, and tracks beyond the largest number."""
        while self._kept:
            name = next(iter(self._kept))
            if len(self._kept) <= self._settings.most and now - self._kept[name].updated <= self._settings.age:
                return
            del self._kept[name]
            self._metrics.add("forgotten")


def scan_of(problem: Problem, z: Array, time: float) -> Problem:
    """Return measurements (m,) of a problem, SI, as one scan of a run with one target; `time` is in seconds."""
    rows = np.ones(problem.count, dtype=bool)
    return alone(problem.with_rows(z=z), rows, np.array([time]))


def _answer_of(event: Event, when: int, entry: Entry | None, follower: Follower, problem: Problem) -> Record:
    """Return the answer to an event: the state of its track, or "starting" or "lost" without a state.

    `when` is the time of the event, picoseconds. `entry` is the result of the scan, or None.
    """
    if entry is not None:
        return track_record(event, when * 1e-12, entry, problem)
    outcome = {"status": "lost", "reason": follower.lost} if follower.lost else {"status": "starting"}
    return unsolved_record(event, phase="track", target=event.target or UNNAMED, time=when * 1e-12, **outcome)


def _reason_without_tracks(problem: Problem, settings: TrackSettings) -> str:
    """Return the reason for which events of a site make no tracks; empty if they do.

    A track is started with measurements that are zero, to find errors of the
    settings.
    """
    if problem.priors:
        return f"the file has a prior of {problem.priors[0].name!r}; a track cannot use priors"
    if len(problem.motions) > 1 or problem.motions[0].known is not None:
        return "the file has several targets, or a known target"
    try:
        with np.errstate(all="ignore"):
            settings.follower().take(scan_of(problem, np.zeros(problem.count), 0.0))
    except InvalidProblem as error:
        return str(error)
    return ""
