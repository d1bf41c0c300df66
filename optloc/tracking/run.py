"""Track of a whole run: started by a fix, gated, and restarted if the model of motion cannot follow the target.

Letters: m rows of the run, n numbers of a state.
"""

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
from optloc.tracking.level_plane import OnPlane, level_of
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

# If the first scan is less likely than this, it contradicts the given state. The run is then refused, so the limit is
# small.
_CONTRADICTORY = 1e-9
# Screen of a scan for lasting errors: REPEATS and EXCESS (sigmas) and SPREAD (m^2) of `optloc.kernels.filter`.
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
        Rules for the rejection of rows and for restarts.

    Returns
    -------
    Track
        State [p, v, a] after each scan, its covariance and status. `Track.states` returns another order.

    Raises
    ------
    InvalidProblem
        If the model or the filter is unknown, the times do not increase, there are several targets, or the start does
        not fit. `optloc.tracking.alone` separates several targets.
    """
    dynamics = motion_named(model) if isinstance(model, str) else model
    run = differences(problem) if problem.emitting else problem
    entries = list(tracked(run, dynamics, update, start=start, rules=rules))
    return replace(collected(entries, problem.dimension), dated=problem.dated)


def tracked(
    problem: Problem,
    dynamics: Dynamics,
    update: Update | str = "iekf",
    *,
    start: State | None = None,
    rules: Rules | None = None,
) -> Iterator[Entry]:
    """Yield the result of each scan of a run. Later errors do not change results that were already yielded.

    The track starts from the first scans that determine the state, without a guess. A scan without a valid row keeps
    the prediction.

    Parameters
    ----------
    problem : Problem
        A single run of one target, see `followed`; every update keeps an exact height.
    dynamics : Dynamics
        Model of motion.
    update : callable or str
        A filter, or its name in `UPDATES`.
    start : State, optional
        Known state at or before the first scan; replaces the first fix.
    rules : Rules, optional
        Rules for the rejection of rows and for restarts.

    Raises
    ------
    InvalidProblem
        If the filter is unknown, the times do not increase, the run has several targets, or the given state does not
        fit the dynamics or contradicts the first scan.
    """
    rule, level = filter_of(update), level_of(problem)
    rule = rule if level is None else OnPlane(rule, level)
    check_trackable(problem)
    _check_run(problem)
    if start is not None:
        _check_start(start, problem, dynamics)
    cleaned, broken = _clean(problem)
    # This function is no generator, so the checks above run at the call and not at the first scan.
    rules = rules or Rules()
    condition = Condition.of(start, float(problem.times[0]) if start is None else start.time, rules)
    condition.fresh = start is not None
    return _TrackRun.of(cleaned, broken, dynamics, rule, rules).entries(condition)


def collected(entries: Sequence[Entry], dimension: int) -> Track:
    """Return the entries as one track.

    Parameters
    ----------
    entries : sequence of Entry
        Entries in the order of time.
    dimension : int
        2 or 3.
    """
    times = np.array([entry.time for entry in entries])
    return collect(times, [(entry.updated, np.asarray(int(_status_of(entry)))) for entry in entries], dimension)


def _status_of(entry: Entry) -> Status:
    """Return the status of an entry in a track; a scan before the start has no state, so that it is not ok."""
    alone = entry.event == "starting" and entry.code == Status.OK
    return Status.TOO_FEW_ROWS if alone else Status(int(entry.code))


@dataclass(frozen=True, slots=True)
class _TrackRun:
    """A run or a part of it, with its model, filter and rules.

    - problem: the run.
    - scans: its scans as arrays.
    - bad: number of rows of each scan that are not finite.
    - dynamics, rule, rules: as in `tracked`; `rule` is the filter.
    - how: the filter with the gate for the compiled code; None for other filters.
    - near: a prediction with a total variance below this limit (m^2) is followed. It is the squared half
    extent of the
      stations.
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
        """Return the prepared run; `broken` (m,) marks rows that are not finite."""
        bad = np.bincount(problem.epoch[broken], minlength=problem.epochs).tolist()
        problem = with_height_rows(problem)
        # An infinite gate would not reject rows with a NaN innovation; the largest number rejects only these.
        gate, how = min(rules.gate, float(np.finfo(float).max)), None
        if isinstance(rule, Filter):
            own = min(gate, rule.how.gate)
            how = rule.how._replace(gate=float(own), most=rules.most, d=problem.dimension)
        # For any position of the centre, one station is at least half of the largest extent away from it.
        near = 0.5 * float(np.ptp(problem.stations.places.reshape(-1, problem.dimension), axis=0).max())
        return cls(problem, Scans.of(problem, dynamics.order), bad, dynamics, rule, rules, how, near**2)

    def entries(self, condition: Condition, *, ends: bool = True) -> Iterator[Entry]:
        """Yield one entry per scan, from the present condition of the track, which is updated.

        With `ends`, the problem has all scans of the run, as in `begin`.
        """
        times, k = self.problem.times.tolist(), 0
        while k < len(times):
            if condition.state is None:
                r = self.rules
                start_here = begin(self.problem, k, self.dynamics, r.speed, r.rate, r.starts, ends=ends)
                yield from self._start_entries(start_here, k, condition)
                k, condition.state, condition.missed = start_here.last + 1, start_here.state, 0
                condition.rivals = start_here.rivals
                condition.recent.begin(start_here)
                condition.last_row = times[start_here.last]
                continue
            before = condition.state
            found = self._update(k, before, times[k] - condition.last_row, condition.lasting.memory(self.scans.memory))
            if isinstance(found, str):
                condition.why, condition.state = found, None
                continue
            condition.why = ""
            entry, fit, screen = found
            if condition.fresh and entry.updated.count + entry.rejected > 0:
                _check_agrees(entry)
                condition.fresh = False
            condition.take(entry, fit, entry.rejected - self.bad[k])
            condition.rivals = self._remaining(condition.rivals, k, entry, times[k] - condition.last_row)
            cov = condition.lasting.take((self.scans, k, before), self.dynamics, entry.updated.cov, screen)
            k += 1
            wide = screen is None or screen[2] > self.near or cov is not entry.updated.cov
            vague = out_of_sight(self.problem, entry.updated.mean, cov) if wide else ""
            yield condition.judged(entry, cov, vague)
            condition.judge(vague)

    def _start_entries(self, begun: Beginning, k: int, condition: Condition) -> Iterator[Entry]:
        """Yield the scans of a start (`begun`), from scan `k`; only the last scan has a state.

        `condition` is the condition of the track before the start.
        """
        n = (self.dynamics.order + 1) * self.problem.dimension
        # Scans of a start have no separate states: their common fix is valid at the last scan.
        why = condition.why
        none = Updated(np.full(n, np.nan), np.full((n, n), np.nan), np.array(np.nan), np.array(0.0), np.array(0))
        for i in range(k, begun.last + 1):
            time = float(self.problem.times[i])
            if i < begun.last or begun.state is None:
                yield Entry(time, none, begun.waiting, self.bad[i], "starting", begun.reason)
                continue
            count = np.array(int((self.problem.weight[self.problem.epoch == i] > 0.0).sum()) - begun.left_out)
            cov = condition.lasting.begin(self._stretch(begun), begun.state)
            done = replace(none, mean=begun.state.mean, cov=cov, count=count)
            reason = "; ".join(filter(None, (why, begun.reason)))
            out = self.bad[i] + begun.left_out
            yield Entry(time, done, begun.code, out, "restarted" if why else "started", reason)

    def _remaining(self, rivals: tuple[Rival, ...], k: int, entry: Entry, silence: float) -> tuple[Rival, ...]:
        """Return the other states of a start that scan `k` does not refute.

        `entry` is the result of the scan for the track. `silence` is the time since the last valid row, s.
        """
        # Without `memory`, the screen for lasting errors does not run: it belongs to the track.
        found = [self._update(k, rival.state, silence, memory=None) for rival in rivals]
        others = [None if isinstance(one, str) else one[0] for one in found]
        return remaining(rivals, entry, others, self.rules.most)

    def _stretch(self, begun: Beginning) -> Problem:
        """Return the scans of a start as a problem, whose unknown is the state at the last of these scans."""
        motion = Motion(self.dynamics.order, reference=float(self.problem.times[begun.last]))
        return replace(cut(self.problem, begun.first, begun.last + 1), motions=(motion,))

    def _update(
        self, k: int, state: State, silence: float, memory: Array | None
    ) -> tuple[Entry, Fit, Screen | None] | str:
        """Return the entry of scan `k`, the fit of all rows to the prediction and the screen for lasting errors.

        The fit is the sum of squared innovations in sigmas and the number of rows. The screen is REPEATS, EXCESS
        and SPREAD of `optloc.kernels.filter`; None for scans that the compiled filter does not support. `state`
        is the state before the prediction. `silence` is the time since the last valid row, s. `memory` is the
        memory of the screen. If the state cannot be followed, return the reason instead.
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
                    why = self._too_uncertain(predicted(state, self.dynamics, time, self.problem.dimension), silence)
                    if why:
                        return why
                entry = self._entry(k, read(found), int(values[CODE]), int(values[REJECTED_ROWS]), [])
                return (
                    entry,
                    (values[INNOVATION], int(values[PRESENT])),
                    (values[REPEATS], values[EXCESS], values[SPREAD]),
                )
        ahead = predicted(state, self.dynamics, time, self.problem.dimension)
        return ("" if self.rules.gap is not None else self._too_uncertain(ahead, silence)) or self._update_in_numpy(
            k, ahead
        )

    def _too_uncertain(self, ahead: State, silence: float) -> str:
        """Return the reason why a prediction is too uncertain to follow; empty if it is not.

        `ahead` is the prediction. `silence` is the time since the last valid row, s.
        """
        d = self.problem.dimension
        sigma = float(np.sqrt(max(np.linalg.eigvalsh(ahead.cov[:d, :d])[-1], 0.0)))
        # If the prediction is uncertain by more than the spread of the stations, a new fix without a guess is better.
        limit = reach(self.problem, ahead.mean[:d])
        return f"the prediction was uncertain by {sigma:.3g} m after {silence:.6g} s" if sigma > limit else ""

    def _update_in_numpy(self, k: int, ahead: State) -> tuple[Entry, Fit, None]:
        """Return the entry, fit and screen (None) of scan `k` for any filter, with the rows that pass the gate.

        `ahead` is the predicted state. See `_update` for the fit.
        """
        scan = scan_at(self.problem, k, self.dynamics.order)
        # Apply the gate before the update: a gross error would pull an iterated update.
        off = innovation(scan, ahead.mean, ahead.cov).normalised[scan.weight > 0.0] if scan.rows else np.zeros(0)
        gated = int((~(np.abs(off) <= self.rules.gate)).sum())
        used = scan
        if gated:
            used = scan.with_rows(weight=weights_within(scan, ahead.mean, ahead.cov, self.rules.gate))
        # The size of one gross error has no information about the other rows, so each row counts at most as the gate.
        # NaN also counts as the gate.
        fit = float(np.nan_to_num(np.minimum(off**2, self.rules.most), nan=self.rules.most).sum()), len(off)
        causes: list[str] = []
        done, code = take_scan(used, ahead, self.rule, causes)
        return self._entry(k, done, int(code), gated, causes), fit, None

    def _entry(self, k: int, done: Updated, code: int, gated: int, causes: list[str]) -> Entry:
        """Return the entry of scan `k` from its update `done` with a status `code`.

        `gated` is the number of rows that failed the gate. `causes` are the causes of a numerical failure.
        """
        rejected = gated + self.bad[k]
        found = objections(_FINDINGS, _ScanOutcome(Status(code), rejected, int(done.count), causes))
        status, reason = found[0] if found else (Status(code), "")
        return Entry(float(self.problem.times[k]), done, status, rejected, "", reason)


@dataclass(frozen=True, slots=True)
class _ScanOutcome:
    """A scan after its update: status, numbers of rejected rows and of used rows (`count`), and causes of a failure."""

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
        lambda t: [f"{t.rejected} of {t.rejected + t.count} rows were rejected"],
    ),
    Finding(
        Status.NUMERICAL,
        lambda t: t.status == Status.NUMERICAL,
        lambda t: ["; ".join([*t.causes, "the update failed: the state was only predicted"])],
    ),
)
"""Findings about a single scan."""


# Largest number of scans that wait for a start. A stretch of 63 scans is the tenth attempt; if it is ambiguous, a few
# more scans do not help.
_WAITING = 64


class Follower:
    """A track that continues as scans arrive. Its results equal the results of `tracked` for the whole run.

    The only exception is a start that remains ambiguous for many scans: it ends after 64 scans, as at the end of a run.

    Parameters
    ----------
    dynamics : Dynamics
        Model of motion.
    update : callable or str
        A filter, or its name in `UPDATES`.
    rules : Rules, optional
        Rules for the rejection of rows and for restarts.
    """

    def __init__(self, dynamics: Dynamics, update: Update | str = "iekf", rules: Rules | None = None) -> None:
        self._dynamics, self._rule, self._rules = dynamics, filter_of(update), rules or Rules()
        self._condition: Condition | None = None
        self._waiting: list[Problem] = []
        self._needed = 1  # number of scans that the next attempt of a start needs
        self.last = -np.inf
        """Time of the last scan, seconds."""

    @property
    def lost(self) -> str:
        """Return the reason why the track lost its state; empty if there is a state, or if there was no state yet."""
        return self._condition.why if self._condition is not None and self._condition.state is None else ""

    def take(self, scan: Problem) -> list[Entry]:
        """Return the results of all pending scans up to this scan; empty if a start needs more scans.

        Parameters
        ----------
        scan : Problem
            One epoch of the run, later than all earlier scans; with the same stations and target.

        Raises
        ------
        InvalidProblem
            If the scan is not later, or has several targets; the track does not change.
        """
        check_trackable(scan)
        if scan.batch_shape or scan.epochs != 1:
            raise InvalidProblem("the problem is not a single scan", "track", "give one epoch per call")
        time = float(scan.times[0])
        if not time > self.last:
            what = f"the scan at {time:.10g} s follows the scan at {self.last:.10g} s"
            raise InvalidProblem(what, "times", "give scans in the order of time, one scan per time")
        run = [*self._waiting, scan]
        if len(run) < self._needed:
            self._waiting, self.last = run, time
            return []
        cleaned, broken = _clean(reduce(joined, run))
        stretch = _TrackRun.of(cleaned, broken, self._dynamics, self._rule, self._rules)
        condition = self._condition or Condition.of(None, float(run[0].times[0]), self._rules)
        done: list[Entry] = []
        self._needed = 1
        try:
            for entry in stretch.entries(condition, ends=len(run) >= _WAITING):
                done.append(entry)  # noqa: PERF402  # entries before an undecided start are kept
        except Undecided as undecided:
            self._needed = undecided.scans - len(done)
        self._condition, self._waiting, self.last = condition, run[len(done) :], time
        return done


def _clean(problem: Problem) -> tuple[Problem, Array]:
    """Return the run with weight zero for rows that are not finite, and a mask (m,) of these rows.

    Their values are set to zero, so that no computation meets a NaN.
    """
    broken = ~np.isfinite(problem.z) & (problem.weight > 0.0)
    if not broken.any():
        return problem, broken
    z, weight = np.where(broken, 0.0, problem.z), np.where(broken, 0.0, problem.weight)
    return problem.with_rows(z=z, weight=weight), broken


def _check_run(problem: Problem) -> None:
    """Raise InvalidProblem for a batch of runs, or for times that do not increase."""
    if problem.batch_shape:
        raise InvalidProblem("a batch of runs was given", "track", "call it for each run, or use `followed`")
    steps = np.flatnonzero(~(np.diff(problem.times) > 0.0))
    if len(steps):
        one, two = problem.times[steps[0]], problem.times[steps[0] + 1]
        what = f"the scan at {two:.10g} s follows the scan at {one:.10g} s"
        raise InvalidProblem(what, "times", "sort the scans by time, and give one scan per time")


def _check_start(start: State, problem: Problem, dynamics: Dynamics) -> None:
    """Raise InvalidProblem for a given state that does not fit the model, or is after the first scan."""
    check_state(start, (dynamics.order + 1) * problem.dimension)
    if start.time > problem.times[0]:
        what = f"the state belongs to {start.time:.10g} s, after the first scan at {problem.times[0]:.10g} s"
        raise InvalidProblem(what, "start", "give the state at or before the first scan")


def _check_agrees(entry: Entry) -> None:
    """Raise InvalidProblem if the first scan contradicts a given state by its chi-square, or fails the gate."""
    p_value = tail_probability(entry.updated.nis, entry.updated.count)  # NIS is NaN without a row
    if entry.code == Status.REJECTED or p_value < _CONTRADICTORY:
        what = f"the initial state contradicts the first scan, at {entry.time:.10g} s"
        advice = "correct it, increase its standard deviation, or remove it: a start needs no guess"
        raise InvalidProblem(what, "start", advice)
