"""Tracks of the targets of a stream: the state of each after each of its events."""

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
from optloc.service.answers import UNNAMED, Record, track_record, unsolved
from optloc.service.events import Event
from optloc.service.metrics import Metrics
from optloc.tracking import Dynamics, Entry, Follower, Rules, Update, alone, polynomial

LOG = logging.getLogger("optloc.service")

# Events that may wait for their track; beyond, the stream waits, as every scan counts.
_WAITING = 256


@dataclass(frozen=True, slots=True)
class Following:
    """How the tracks of a stream are made, and how many of them are kept.

    Parameters
    ----------
    dynamics : Dynamics
        Model of motion; by default constant velocity driven by 1 m/s^2, as of ``optloc track``.
    update : callable or str
        A filter, or its name in `optloc.tracking.UPDATES`.
    rules : Rules
        When rows are left out and tracks begin anew.
    most : int
        Tracks that are kept; the one that was silent longest makes room. More than the aircraft of a busy sky.
    age : float
        Seconds of silence after which one is forgotten; `Rules.gap` or its covariance has ended it before.
    """

    dynamics: Dynamics = field(default_factory=lambda: polynomial(1, 1.0))
    update: Update | str = "iekf"
    rules: Rules = field(default_factory=Rules)
    most: int = 1024
    age: float = 300.0


class Scan(NamedTuple):
    """An event as a tracker takes it: its problem, and its measurements (m,)."""

    event: Event
    problem: Problem
    z: Array


@dataclass(slots=True)
class _Kept:
    """A track, the time of its first event in picoseconds, when it was heard by the clock, and what it said last."""

    follower: Follower
    origin: int
    heard: float = 0.0
    last: Record | None = None


class Tracks:
    """The tracks of a stream, made in a thread of their own so that no fix waits for a start.

    Parameters
    ----------
    problem : Problem
        Of a whole event of the site.
    how : Following
        How they are made.
    metrics : Metrics
        Where is counted.
    emit : callable
        Takes an event and its answer.
    clock : callable
        Seconds that never go back.
    """

    def __init__(
        self,
        problem: Problem,
        how: Following,
        metrics: Metrics,
        emit: Callable[[Event, Record], None],
        clock: Callable[[], float],
    ) -> None:
        self._how, self._metrics, self._emit, self._clock = how, metrics, emit, clock
        # in the order in which they were heard last
        self._kept: dict[str, _Kept] = {}
        self._waiting, self._ends = deque[Scan](), False
        self._changed = Condition()
        self._thread: Thread | None = None
        self._problem = problem
        metrics.gauges |= {"scans": lambda: len(self._waiting), "tracks": lambda: len(self._kept)}

    @cached_property
    def why(self) -> str:
        """Return why events of the site make no tracks; empty where they do."""
        return _why_not(self._problem, self._how)

    def take(self, scans: Sequence[Scan]) -> None:
        """Take events in the order in which they closed; the caller waits while there are too many."""
        with self._changed:
            if self._thread is None:
                self._thread = Thread(target=self._run, name="optloc tracks", daemon=True)
                self._thread.start()
            for scan in scans:
                self._changed.wait_for(lambda: len(self._waiting) < _WAITING)
                self._waiting.append(scan)
                self._changed.notify_all()

    def stop(self) -> None:
        """Answer what is there, and end."""
        with self._changed:
            self._ends = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def records(self) -> list[Record]:
        """Return the last answer of each track that is kept, with the seconds since (`age`), the latest first."""
        with self._changed:
            now = self._clock()
            self._forget(now)
            kept = [(each.last, now - each.heard) for each in self._kept.values() if each.last is not None]
        return [record | {"age": round(age, 3)} for record, age in reversed(kept)]

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ends)
                if not self._waiting:
                    return
                scan = self._waiting.popleft()
                self._changed.notify_all()
            try:
                record = self._follow(*scan)
            except Exception as error:  # noqa: BLE001  # a stream goes on, whatever one event brings to light
                record = self._failed(scan.event, error)
            self._metrics.took("track", [self._clock() - scan.event.stamp])
            self._emit(scan.event, record)

    def _failed(self, event: Event, error: Exception) -> Record:
        if isinstance(error, InvalidProblem):
            self._metrics.add("unsolvable")
            return unsolved(event, phase="track", error=str(error))
        LOG.error("event %s failed in its track", event.name, exc_info=error)
        # what is left of it may be half of a step
        with self._changed:
            self._kept.pop(event.target or UNNAMED, None)
        self._metrics.add("unsolvable")
        self._metrics.add("forgotten")
        return unsolved(event, phase="track", error=f"{type(error).__name__}: {error}; the track begins anew")

    def _follow(self, event: Event, problem: Problem, z: Array) -> Record:
        """Return what an event says of its target."""
        if self.why:
            raise InvalidProblem(self.why, None, "ask for fixes")
        when = event.when if event.when is not None else min(event.times.values(), default=None)
        if when is None:
            raise InvalidProblem("a track needs the time of the event", "time", "add time, time_ns or time_ps")
        name = event.target or UNNAMED
        kept = self._kept.get(name)
        track = kept or _Kept(Follower(self._how.dynamics, self._how.update, self._how.rules), when)
        # whole picoseconds first: only their difference becomes a float
        time = (when - track.origin) * 1e-12
        if track.follower.last >= time:
            self._metrics.add("unordered")
            what = f"the event is {track.follower.last - time:.6g} s before the last one of {name}, or at the same time"
            error = InvalidProblem(what, "time", "send the events of a target in the order of their times")
            return unsolved(event, phase="track", error=str(error))
        entries = track.follower.take(scan_of(problem, z, time))
        entry = entries[-1] if entries and entries[-1].time == time else None
        record = _told(event, when, entry, track.follower, problem)
        with self._changed:
            now = self._clock()
            self._kept.pop(name, None)
            track.heard, track.last = now, record
            self._kept[name] = track
            self._metrics.add("tracked")
            self._metrics.followed(record["status"])
            self._forget(now)
        return record

    def _forget(self, now: float) -> None:
        """Forget tracks that were silent for too long, or are too many."""
        while self._kept:
            name = next(iter(self._kept))
            if len(self._kept) <= self._how.most and now - self._kept[name].heard <= self._how.age:
                return
            del self._kept[name]
            self._metrics.add("forgotten")


def scan_of(problem: Problem, z: Array, time: float) -> Problem:
    """Return measurements (m,) of a problem as one scan of a run of one target, at a time in seconds."""
    rows = np.ones(problem.count, dtype=bool)
    return alone(problem.with_rows(z=z), rows, np.array([time]))


def _told(event: Event, when: int, entry: Entry | None, follower: Follower, problem: Problem) -> Record:
    if entry is not None:
        return track_record(event, when * 1e-12, entry, problem)
    said = {"status": "lost", "reason": follower.lost} if follower.lost else {"status": "starting"}
    return unsolved(event, phase="track", target=event.target or UNNAMED, time=when * 1e-12, **said)


def _why_not(problem: Problem, how: Following) -> str:
    """Return why events of a site make no tracks; empty where they do."""
    if problem.priors:
        return f"the file has a prior of {problem.priors[0].name!r}, which a track does not take"
    if len(problem.motions) > 1 or problem.motions[0].known is not None:
        return "the file tells of several targets, or of one whose place is known"
    try:
        with np.errstate(all="ignore"):
            Follower(how.dynamics, how.update, how.rules).take(scan_of(problem, np.zeros(problem.count), 0.0))
    except InvalidProblem as error:
        return str(error)
    return ""
