"""A whole run as a track: started without a guess, gated, and restarted where the model cannot follow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Motion, Status
from optloc.kernels.filter import (
    CODE,
    EXCESS,
    GENERAL,
    INNOVATION,
    PRESENT,
    REJECTED_ROWS,
    REPEATS,
    SPREAD,
    Filtering,
)
from optloc.problem.chart import tail_probability
from optloc.problem.epochs import cut, joined
from optloc.problem.problem import Problem
from optloc.solvers.verdict.findings import Finding, objections
from optloc.tracking.condition import Condition
from optloc.tracking.differences import differences
from optloc.tracking.dynamics import Dynamics
from optloc.tracking.entry import Entry, Rules
from optloc.tracking.named_models import motion_named
from optloc.tracking.rivals import Rival, remaining
from optloc.tracking.scan_rows import Scans
from optloc.tracking.start import Beginning, Fit, Undecided, begin, out_of_sight, reach, with_height_rows
from optloc.tracking.track import (
    State,
    Track,
    check_state,
    check_trackable,
    collect,
    move_of,
    predicted,
    scan_at,
    take_scan,
)
from optloc.tracking.updates import Filter, Update, Updated, filter_of, innovation, read, weights_within

# A given state whose first scan is less likely than this contradicts it: the run is refused, so this is nearly sure.
_ABSURD = 1e-9
Screen = tuple[float, float, float]


def track(
    problem: Problem,
    model: Dynamics | str = "cv",
    update: Update | str = "iekf",
    *,
    start: State | None = None,
    rules: Rules | None = None,
) -> Track:
    """Return the track of one target through a run, without a first guess.

    Parameters
    ----------
    problem : Problem
        A single run of one target: epochs with times.
    model : Dynamics or str
        Model of motion, or its name: "cv", "ca", "static", "singer", "csm"; see ``optloc list motions``.
    update : callable or str
        A filter, or its name; see ``optloc list trackers``.
    start : State, optional
        Known state at or before the first scan.
    rules : Rules, optional
        When rows are left out and tracks restart.

    Returns
    -------
    Track
        State [p, v, a] after each scan, its covariance and status. `Track.states` returns another order.

    Raises
    ------
    InvalidProblem
        For an unknown model or filter, times that do not increase, several targets, and a start that does not
        fit. Several targets are separated by `optloc.tracking.alone`.
    """
    dynamics = motion_named(model) if isinstance(model, str) else model
    run = differences(problem) if problem.emitting else problem
    entries = list(tracked(run, dynamics, update, start=start, rules=rules))
    return collected(entries, problem.dimension)


def tracked(
    problem: Problem,
    dynamics: Dynamics,
    update: Update | str = "iekf",
    *,
    start: State | None = None,
    rules: Rules | None = None,
) -> Iterator[Entry]:
    """Yield what becomes of each scan of a run, one by one: what was yielded stays, whatever goes wrong later.

    The track starts from the first stretch of scans that determine the state, without a guess. Scans without a valid
    row keep the prediction.

    Parameters
    ----------
    problem : Problem
        A single run of one target, see `followed`; an exact height is held by every update.
    dynamics : Dynamics
        Model of motion.
    update : callable or str
        A filter, or its name in `UPDATES`.
    start : State, optional
        Known state at or before the first scan, in the place of a fix.
    rules : Rules, optional
        When rows are left out and tracks restart.

    Raises
    ------
    InvalidProblem
        For an unknown filter, times that do not increase, a run that is not one target's, and a given state that does
        not fit the dynamics or contradicts the first scan.
    """
    rule = filter_of(update)
    check_trackable(problem)
    _check_run(problem)
    if start is not None:
        _check_start(start, problem, dynamics)
    cleaned, broken = _clean(problem)
    # The checks above are made at the call, not at the first scan.
    rules = rules or Rules()
    course = Condition.of(start, float(problem.times[0]) if start is None else start.time, rules)
    course.fresh = start is not None
    return _TrackRun.of(cleaned, broken, dynamics, rule, rules).entries(course)


def collected(entries: Sequence[Entry], dimension: int) -> Track:
    """Return entries as one track.

    Parameters
    ----------
    entries : sequence of Entry
        In the order of time.
    dimension : int
        2 or 3.
    """
    times = np.array([entry.time for entry in entries])
    return collect(times, [(entry.updated, np.asarray(int(entry.code))) for entry in entries], dimension)


@dataclass(frozen=True, slots=True)
class _TrackRun:
    """One run, or a stretch of it, with its rules.

    Parameters
    ----------
    problem : Problem
        The run.
    scans : Scans
        Its scans as arrays.
    bad : list of int
        Rows of each scan that are not finite.
    dynamics, rule, rules
        As of `tracked`.
    how : Filtering or None
        The filter with the gate, as machine code takes it.
    near : float
        Total variance below which a prediction is followed: it is nearer than the stations are spread, squared.
    """

    problem: Problem
    scans: Scans
    bad: list[int]
    dynamics: Dynamics
    rule: Update
    rules: Rules
    how: Filtering | None
    near: float

    @classmethod
    def of(cls, problem: Problem, broken: Array, dynamics: Dynamics, rule: Update, rules: Rules) -> _TrackRun:
        """Return a run whose rows (m,) are `broken` where they are not finite."""
        bad = np.bincount(problem.epoch[broken], minlength=problem.epochs).tolist()
        problem = with_height_rows(problem)
        # An infinite gate refuses NaN: the largest number does what infinity does for innovations.
        gate, how = min(rules.gate, float(np.finfo(float).max)), None
        if isinstance(rule, Filter):
            own = min(gate, rule.how.gate)
            how = rule.how._replace(gate=float(own), most=rules.most, d=problem.dimension)
        # From any centre, a station is at least half of the largest extent away.
        near = 0.5 * float(np.ptp(problem.stations.places.reshape(-1, problem.dimension), axis=0).max())
        return cls(problem, Scans.of(problem, dynamics.order), bad, dynamics, rule, rules, how, near**2)

    def entries(self, course: Condition, *, ends: bool = True) -> Iterator[Entry]:
        """Yield all entries, one for each scan, from where a track stands; `ends` as of `begin`."""
        times, k = self.problem.times.tolist(), 0
        while k < len(times):
            if course.state is None:
                r = self.rules
                start_here = begin(self.problem, k, self.dynamics, r.speed, r.rate, r.starts, ends=ends)
                yield from self._starting(start_here, k, course)
                k, course.state, course.missed = start_here.last + 1, start_here.state, 0
                course.rivals = start_here.rivals
                course.recent.begin(start_here)
                course.heard = times[start_here.last]
                continue
            before = course.state
            found = self._update(k, before, times[k] - course.heard, course.lasting.memory(self.scans.memory))
            if isinstance(found, str):
                course.why, course.state = found, None
                continue
            course.why = ""
            entry, fit, screen = found
            if course.fresh and entry.updated.count + entry.rejected > 0:
                _check_agrees(entry)
                course.fresh = False
            course.take(entry, fit, entry.rejected - self.bad[k])
            course.rivals = self._remaining(course.rivals, k, entry, times[k] - course.heard)
            cov = course.lasting.take((self.scans, k, before), self.dynamics, entry.updated.cov, screen)
            k += 1
            wide = screen is None or screen[2] > self.near or cov is not entry.updated.cov
            vague = out_of_sight(self.problem, entry.updated.mean, cov) if wide else ""
            yield course.judged(entry, cov, vague)
            course.judge(vague)

    def _starting(self, begun: Beginning, k: int, course: Condition) -> Iterator[Entry]:
        """Yield the scans of a start, of which the last one has the state."""
        n = (self.dynamics.order + 1) * self.problem.dimension
        # Scans of a start have no state of their own: the fix of all of them holds at the last one.
        why = course.why
        none = Updated(np.full(n, np.nan), np.full((n, n), np.nan), np.array(np.nan), np.array(0.0), np.array(0))
        for i in range(k, begun.last + 1):
            time = float(self.problem.times[i])
            if i < begun.last or begun.state is None:
                yield Entry(time, none, begun.waiting, self.bad[i], "starting", begun.reason)
                continue
            count = np.array(int((self.problem.weight[self.problem.epoch == i] > 0.0).sum()) - begun.left_out)
            cov = course.lasting.begin(self._stretch(begun), begun.state)
            done = replace(none, mean=begun.state.mean, cov=cov, count=count)
            reason = "; ".join(filter(None, (why, begun.reason)))
            out = self.bad[i] + begun.left_out
            yield Entry(time, done, begun.code, out, "restarted" if why else "started", reason)

    def _remaining(self, rivals: tuple[Rival, ...], k: int, entry: Entry, silence: float) -> tuple[Rival, ...]:
        """Return the other states of a start that a scan does not refute."""
        found = [self._update(k, rival.state, silence, None) for rival in rivals]
        others = [None if isinstance(one, str) else one[0] for one in found]
        return remaining(rivals, entry, others, self.rules.most)

    def _stretch(self, begun: Beginning) -> Problem:
        """Return the scans of a start."""
        motion = Motion(self.dynamics.order, reference=float(self.problem.times[begun.last]))
        return replace(cut(self.problem, begun.first, begun.last + 1), motions=(motion,))

    def _update(
        self, k: int, state: State, silence: float, memory: Array | None
    ) -> tuple[Entry, Fit, Screen | None] | str:
        """Return the entry of a scan, the fit of all rows to the prediction and the screen for lasting errors.

        Where the state is not followed the result is the reason.
        """
        if self.rules.gap is not None and silence > self.rules.gap:
            return f"no valid row for {silence:.6g} s"
        time = float(self.problem.times[k])
        if self.how is not None and self.scans.rows[k] is not None:
            move = move_of(state, self.dynamics, time, self.problem.dimension)
            found = self.scans.filtered(k, state.mean, state.cov, self.how, move, memory=memory)
            if found is not None and found.values[CODE] != GENERAL:
                values = found.values.tolist()
                if values[SPREAD] > self.near and self.rules.gap is None:
                    why = self._unbridged(predicted(state, self.dynamics, time, self.problem.dimension), silence)
                    if why:
                        return why
                entry = self._entry(k, read(found), int(values[CODE]), int(values[REJECTED_ROWS]), [])
                return (
                    entry,
                    (values[INNOVATION], int(values[PRESENT])),
                    (values[REPEATS], values[EXCESS], values[SPREAD]),
                )
        ahead = predicted(state, self.dynamics, time, self.problem.dimension)
        return ("" if self.rules.gap is not None else self._unbridged(ahead, silence)) or self._general(k, ahead)

    def _unbridged(self, ahead: State, silence: float) -> str:
        """Return why a prediction is not worth following; empty where it is."""
        d = self.problem.dimension
        sigma = float(np.sqrt(max(np.linalg.eigvalsh(ahead.cov[:d, :d])[-1], 0.0)))
        # Where a prediction may be anywhere between the stations, a fix without a guess tells more.
        limit = reach(self.problem, ahead.mean[:d])
        return f"the prediction was uncertain by {sigma:.3g} m after {silence:.6g} s" if sigma > limit else ""

    def _general(self, k: int, ahead: State) -> tuple[Entry, Fit, None]:
        """Return the update of a prediction by any filter with the rows of a scan that pass the gate."""
        scan = scan_at(self.problem, k, self.dynamics.order)
        # Gate first, update then: an iterated update would be drawn by what it should not believe.
        off = innovation(scan, ahead.mean, ahead.cov).normalised[scan.weight > 0.0] if scan.rows else np.zeros(0)
        lost = int((~(np.abs(off) <= self.rules.gate)).sum())
        used = scan
        if lost:
            used = scan.with_rows(weight=weights_within(scan, ahead.mean, ahead.cov, self.rules.gate))
        # How wild a row is says nothing of the others: none counts further than the gate, nor NaN less.
        fit = float(np.nan_to_num(np.minimum(off**2, self.rules.most), nan=self.rules.most).sum()), len(off)
        causes: list[str] = []
        done, code = take_scan(used, ahead, self.rule, causes)
        return self._entry(k, done, int(code), lost, causes), fit, None

    def _entry(self, k: int, done: Updated, code: int, lost: int, causes: list[str]) -> Entry:
        """Return the entry of an update, of which a number of rows (`lost`) did not pass the gate."""
        rejected = lost + self.bad[k]
        found = objections(_FINDINGS, _Taken(Status(code), rejected, int(done.count), causes))
        status, reason = found[0] if found else (Status(code), "")
        return Entry(float(self.problem.times[k]), done, status, rejected, "", reason)


@dataclass(frozen=True, slots=True)
class _Taken:
    """A scan after its update: status, rows left out and used, and causes of a failure."""

    status: Status
    rejected: int
    count: int
    causes: list[str]


_FINDINGS = (
    Finding(
        Status.TOO_FEW_ROWS,
        lambda t: t.status == Status.TOO_FEW_ROWS and not t.rejected,
        lambda t: ["no valid row: the state was only predicted"],
    ),
    Finding(
        Status.REJECTED,
        lambda t: t.rejected > t.count,
        lambda t: [f"{t.rejected} of {t.rejected + t.count} rows were left out"],
    ),
    Finding(
        Status.NUMERICAL,
        lambda t: t.status == Status.NUMERICAL,
        lambda t: ["; ".join([*t.causes, "the update failed: the state was only predicted"])],
    ),
)
"""All findings against one scan by itself."""


# Scans that wait for a start, at most: a stretch of 63 is the tenth that is tried, and what so many leave open is not
# a matter of the next few.
_WAITING = 64


class Follower:
    """A track that goes on as scans come: what it says of them is what `tracked` says of the whole run.

    Only a start that many scans leave open is told earlier than there: it is given up after 64 of them, as at the end
    of a run.

    Parameters
    ----------
    dynamics : Dynamics
        Model of motion.
    update : callable or str
        A filter, or its name in `UPDATES`.
    rules : Rules, optional
        When rows are left out and tracks restart.
    """

    def __init__(self, dynamics: Dynamics, update: Update | str = "iekf", rules: Rules | None = None) -> None:
        self._dynamics, self._rule, self._rules = dynamics, filter_of(update), rules or Rules()
        self._course: Condition | None = None
        self._waiting: list[Problem] = []
        self._needed = 1  # scans, for the next try of a start
        self.last = -np.inf
        """Time of the last scan, seconds."""

    @property
    def lost(self) -> str:
        """Return why the last state was given up while there is no new one; empty where there is one, or never was."""
        return self._course.why if self._course is not None and self._course.state is None else ""

    def take(self, scan: Problem) -> list[Entry]:
        """Return what became of the scans up to this one that were left open; nothing where a start needs more.

        Parameters
        ----------
        scan : Problem
            One epoch of the run, later than those before; the same stations and target.

        Raises
        ------
        InvalidProblem
            Where it is not later, or not one target's; the track stays as it was.
        """
        check_trackable(scan)
        if scan.batch_shape or scan.epochs != 1:
            raise InvalidProblem("this is not a single scan", "track", "give one epoch after the other")
        time = float(scan.times[0])
        if not time > self.last:
            what = f"the scan at {time:.10g} s follows one at {self.last:.10g} s"
            raise InvalidProblem(what, "times", "give scans in the order of time, and one for each time")
        run = [*self._waiting, scan]
        if len(run) < self._needed:
            self._waiting, self.last = run, time
            return []
        cleaned, broken = _clean(reduce(joined, run))
        stretch = _TrackRun.of(cleaned, broken, self._dynamics, self._rule, self._rules)
        course = self._course or Condition.of(None, float(run[0].times[0]), self._rules)
        done: list[Entry] = []
        self._needed = 1
        try:
            for entry in stretch.entries(course, ends=len(run) >= _WAITING):
                done.append(entry)  # noqa: PERF402  # those before a start that is left open stay
        except Undecided as undecided:
            self._needed = undecided.scans - len(done)
        self._course, self._waiting, self.last = course, run[len(done) :], time
        return done


def _clean(problem: Problem) -> tuple[Problem, Array]:
    """Return the run with weight zero for rows that are not finite, and which of the present ones these are (m,)."""
    broken = ~np.isfinite(problem.z) & (problem.weight > 0.0)
    if not broken.any():
        return problem, broken
    z, weight = np.where(broken, 0.0, problem.z), np.where(broken, 0.0, problem.weight)
    return problem.with_rows(z=z, weight=weight), broken


def _check_run(problem: Problem) -> None:
    if problem.batch_shape:
        raise InvalidProblem("there are several runs", "track", "take them one by one, or use `followed`")
    steps = np.flatnonzero(~(np.diff(problem.times) > 0.0))
    if len(steps):
        one, two = problem.times[steps[0]], problem.times[steps[0] + 1]
        what = f"the scan at {two:.10g} s follows one at {one:.10g} s"
        raise InvalidProblem(what, "times", "sort the scans by time, and give one scan for each time")


def _check_start(start: State, problem: Problem, dynamics: Dynamics) -> None:
    check_state(start, (dynamics.order + 1) * problem.dimension)
    if start.time > problem.times[0]:
        what = f"the state holds at {start.time:.10g} s, after the first scan at {problem.times[0]:.10g} s"
        raise InvalidProblem(what, "start", "give the state at or before the first scan")


def _check_agrees(entry: Entry) -> None:
    """Refuse a given state that its first scan contradicts: by its chi-square, or as no row passed the gate."""
    p_value = tail_probability(entry.updated.nis, entry.updated.count)  # NaN without a row
    if entry.code == Status.REJECTED or p_value < _ABSURD:
        what = f"the initial state contradicts the first scan, at {entry.time:.10g} s"
        advice = "correct it, make its standard deviation larger, or leave it out: a start needs no guess"
        raise InvalidProblem(what, "start", advice)
