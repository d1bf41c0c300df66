"""A whole run as a track: started without a guess, gated, and begun anew where the model cannot follow."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array, Status
from optloc.problem.epochs import cut
from optloc.problem.fix import Fix, tail_probability
from optloc.problem.problem import Problem
from optloc.track.associate import innovation, weights_within
from optloc.track.dynamics import Dynamics
from optloc.track.start import counts, first_fix, is_one_gaussian, state_of, with_height_rows
from optloc.track.track import State, Track, check_state, check_trackable, collect, predicted, scan_at, take_scan
from optloc.track.updates import Update, Updated, filter_of

# Rows of a start whose chi-square is less likely than this contradict each other: the next scan is tried. One good
# start in ten thousand is passed over, which costs a scan; a wrong one costs the track.
_PLAUSIBLE = 1e-4
# Scans that starts are tried from before one that contradicts itself is taken: every try costs a fix, and a run that is
# wrong for longer deserves a status more than a search. The distance grows by half each time, and eleven tries reach
# over forty scans: who is heard badly at first (a drone on the floor) has moved by then.
_TRIES = 11
# Scans of a stretch that is made longer until its state is clear: a longer one asks more of the model of motion, which
# has no noise here, than of the rows.
_CLEAR = 24
# A given state whose first scan is less likely than this contradicts it: the run is refused, so this is nearly sure.
_ABSURD = 1e-9
# Scans of the window by which a track is judged, over those of `Rules.patience`.
_WINDOW = 4
# Mean squared innovation over the squared gate: a half where half of the rows are beyond the gate, as every place has
# some by chance that agree; a quarter (5 sigma: two and a half times as large as stated) where no covariance covers.
_LOST, _DOUBTFUL = 0.5, 0.25
# Gate, standard deviations: of a good row one in two million is left out.
_USUAL = 5.0
Event = Literal["starting", "started", "restarted", ""]
Fit = tuple[float, int]
"""Sum of the squared innovations (or residuals) of rows in their standard deviations, and how many these are."""


@dataclass(frozen=True, slots=True)
class Rules:
    """When a row is left out and when a track begins anew.

    Parameters
    ----------
    gate : float
        Rows further than this many standard deviations from the prediction are left out; infinite for none.
    patience : int
        So many scans in succession of whose rows most were left out end a track; so do four times as many of whose
        rows half were, or whose innovations are as large on the whole as if half were.
    gap : float, optional
        Seconds without a valid row that end a track. Without it a gap ends a track where the predicted position has a
        standard deviation beyond the spread of the stations, and beyond the range of the target.
    speed, rate : float, optional
        Prior standard deviation of each coordinate of velocity (m/s) and acceleration (m/s^2), about zero, for starts.
    """

    gate: float = _USUAL
    patience: int = 5
    gap: float | None = None
    speed: float | None = None
    rate: float | None = None

    @property
    def most(self) -> float:
        """Return the squared innovation that a row counts as at most: that of the gate, or of the usual one."""
        return float(min(self.gate, _USUAL) ** 2)


@dataclass(frozen=True, slots=True)
class Entry:
    """What became of one scan.

    Parameters
    ----------
    time : float
        Seconds.
    updated : Updated
        State after the scan, its NIS and the rows used; NaN before the first start.
    code : Status
        Ok; too few rows where none was valid and the state was only predicted; rejected where most rows did not pass
        the gate or are not finite; misfit where the innovations of the last scans are much larger than stated;
        ambiguous where a start has alternatives; numerical where the update failed.
    rejected : int
        Rows left out.
    event : "starting", "started", "restarted" or ""
        The scan is one that a start needed; the state is a new fix; or nothing special.
    reason : str
        A sentence where the status or the event needs one.
    """

    time: float
    updated: Updated
    code: Status
    rejected: int = 0
    event: Event = ""
    reason: str = ""

    @property
    def label(self) -> str:
        """Return the event, else the status, in words; a start that is not clean is called by its status."""
        return self.event if self.event and self.code == Status.OK else self.code.label


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
        When rows are left out and tracks begin anew.

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
    return _Run(with_height_rows(cleaned), broken, dynamics, rule, rules or Rules()).entries(start)


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
class _Run:
    """One run with its rules; `broken` says which of its rows (m,) are not finite."""

    problem: Problem
    broken: Array
    dynamics: Dynamics
    rule: Update
    rules: Rules

    def entries(self, start: State | None) -> Iterator[Entry]:
        """Yield all entries."""
        # heard: the time of the last valid row. missed: scans in succession whose rows the gate mostly refused.
        # fresh: whether a given state has yet to meet its first row. recent: how the last scans fit.
        times, k, state, why = self.problem.times, 0, start, ""
        heard = float(times[0]) if start is None else start.time
        missed, fresh, recent = 0, start is not None, _Recent(self.rules)
        while k < len(times):
            if state is None:
                start_here = begin(self.problem, k, self.dynamics, self.rules.speed, self.rules.rate)
                yield from self._starting(start_here, k, why)
                k, state, missed = start_here.last + 1, start_here.state, 0
                recent.begin(start_here)
                heard = float(times[start_here.last])
                continue
            ahead = predicted(state, self.dynamics, float(times[k]), self.problem.dimension)
            why = self._unbridged(ahead, times[k] - heard)
            if why:
                state = None
                continue
            entry, fit = self._updated(k, ahead)
            if fresh and entry.updated.count + entry.rejected > 0:
                _check_agrees(entry)
                fresh = False
            # Rows that are not finite say nothing of the state: only those that the gate refused end a track. A scan
            # without rows leaves the count as it was.
            gated, used = entry.rejected - self._bad(k), int(entry.updated.count)
            missed = missed + 1 if gated > used else missed * int(used == 0)
            heard = float(times[k]) if entry.updated.count > 0 else heard
            recent.add(fit)
            yield recent.judge(entry)
            state, k = State(entry.time, entry.updated.mean, entry.updated.cov), k + 1
            if missed >= self.rules.patience:
                state, why = None, f"most rows of {missed} scans did not fit the prediction"
            elif recent.lost:
                state, why = None, recent.sentence

    def _starting(self, begun: Beginning, k: int, why: str) -> Iterator[Entry]:
        """Yield the scans of a start, of which the last one has the state."""
        n = (self.dynamics.order + 1) * self.problem.dimension
        # Scans of a start have no state of their own: the fix of all of them holds at the last one.
        none = Updated(np.full(n, np.nan), np.full((n, n), np.nan), np.array(np.nan), np.array(0.0), np.array(0))
        for i in range(k, begun.last + 1):
            time = float(self.problem.times[i])
            if i < begun.last or begun.state is None:
                yield Entry(time, none, begun.waiting, self._bad(i), "starting", begun.reason)
                continue
            count = np.array(int((self.problem.weight[self.problem.epoch == i] > 0.0).sum()))
            done = replace(none, mean=begun.state.mean, cov=begun.state.cov, count=count)
            reason = "; ".join(filter(None, (why, begun.reason)))
            yield Entry(time, done, begun.code, self._bad(i), "restarted" if why else "started", reason)

    def _bad(self, k: int) -> int:
        """Return how many rows of a scan are not finite."""
        # Rows of an exact height stand behind those of the file, and are never broken.
        return int(self.broken[self.problem.epoch[: len(self.broken)] == k].sum())

    def _unbridged(self, ahead: State, silence: float) -> str:
        """Return why a prediction is not worth following; empty where it is."""
        if self.rules.gap is not None:
            return f"no valid row for {silence:.6g} s" if silence > self.rules.gap else ""
        d = self.problem.dimension
        sigma = float(np.sqrt(max(np.linalg.eigvalsh(ahead.cov[:d, :d])[-1], 0.0)))
        # Where a prediction may be anywhere between the stations, a fix without a guess tells more.
        limit = reach(self.problem, ahead.mean[:d])
        return f"the prediction was uncertain by {sigma:.3g} m after {silence:.6g} s" if sigma > limit else ""

    def _updated(self, k: int, ahead: State) -> tuple[Entry, Fit]:
        """Return the update of a prediction by the rows of a scan that pass the gate, and how all of them fit it."""
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
        status, rejected, reason = Status(int(code)), lost + self._bad(k), ""
        if status == Status.TOO_FEW_ROWS and not rejected:
            reason = "no valid row: the state was only predicted"
        elif rejected > int(done.count):
            status, reason = Status.REJECTED, f"{rejected} of {rejected + int(done.count)} rows were left out"
        elif status == Status.NUMERICAL:
            reason = "; ".join([*causes, "the update failed: the state was only predicted"])
        return Entry(ahead.time, done, status, rejected, "", reason), fit


class _Recent:
    """How the rows of the last scans fit the prediction: their windowed NIS, no row further than the gate."""

    def __init__(self, rules: Rules) -> None:
        # As many scans as tell the loss of a track from a few wild rows in a row, where a scan has a single one: if one
        # row in ten is wild, ten of twenty are in one window of a million.
        self.scans: deque[Fit] = deque(maxlen=_WINDOW * rules.patience)
        self.most, self.since = rules.most, 0

    def begin(self, start: Beginning) -> None:
        """Take the rows of a start; what did not fit before is forgotten where they agree, and else still counts."""
        if start.code == Status.OK:
            self.scans.clear()
        self.add(start.fit)
        self.since = 0

    def add(self, fit: Fit) -> None:
        """Take how the rows of one more scan fit."""
        square, count = fit
        if count > 0:
            self.scans.append((min(square, self.most * count), count))
            self.since += 1

    @property
    def share(self) -> float:
        """Return the mean squared innovation as a share of the squared gate; 0 where the rows are too few to tell."""
        rows = sum(count for _, count in self.scans)
        assert self.scans.maxlen is not None
        return sum(square for square, _ in self.scans) / (self.most * rows) if rows >= self.scans.maxlen else 0.0

    @property
    def lost(self) -> bool:
        """Return whether a full window is as bad as if half of its rows were beyond the gate."""
        return self.since >= len(self.scans) == self.scans.maxlen and self.share > _LOST

    @property
    def sentence(self) -> str:
        """Return how large the innovations are."""
        times = np.sqrt(self.share * self.most)
        return f"the innovations of the last {len(self.scans)} scans are {times:.2g} times as large as stated"

    def judge(self, entry: Entry) -> Entry:
        """Return a scan with the status that those before it deserve, where its own is clean."""
        if entry.code != Status.OK or self.share <= _DOUBTFUL:
            return entry
        return replace(entry, code=Status.MISFIT, reason=self.sentence)


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


# Where a track begins: the first scans that determine a state and do not contradict each other.


@dataclass(frozen=True, slots=True)
class Beginning:
    """A start, or why there is none.

    Parameters
    ----------
    last : int
        Last scan that was used, or given up.
    state : State or None
        At that scan.
    code : Status
        Ok; ambiguous where the state has alternatives; rejected where the rows contradict each other.
    waiting : Status
        Of the scans before: ok where a start follows.
    reason : str
        A sentence where the status is not ok.
    fit : tuple of float and int
        Chi-square of the rows of the start, and its degrees of freedom.
    """

    last: int
    state: State | None
    code: Status
    waiting: Status
    reason: str = ""
    fit: Fit = (0.0, 0)


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Scans that determine a state: their fix, the last of them, and the state there."""

    fix: Fix
    last: int
    state: State

    @property
    def p(self) -> float:
        """Return the p-value of the rows; 1 without redundancy, where nothing contradicts."""
        p = float(self.fix.p_value)
        return 1.0 if np.isnan(p) else p

    @property
    def fit(self) -> Fit:
        """Return the chi-square of the rows and its degrees of freedom."""
        return float(self.fix.cost), int(self.fix.dof)

    @property
    def clean(self) -> bool:
        """Return whether a filter may begin with it."""
        return self.p >= _PLAUSIBLE and is_one_gaussian(self.fix)


def begin(problem: Problem, first: int, dynamics: Dynamics, speed: float | None, rate: float | None) -> Beginning:
    """Return a start from the scan `first` on, without a guess.

    The fewest scans that determine the state are solved as one problem. Where their rows contradict each other the
    stretch begins one scan later, where several states explain them it is made longer.

    Parameters
    ----------
    problem : Problem
        A single run of one target.
    first : int
        First scan that may be used.
    dynamics : Dynamics
        Gives the order of the state.
    speed, rate : float, optional
        Prior standard deviations, see `begun`.
    """
    doubtful: list[_Stretch] = []
    verdict, last = Status.TOO_FEW_ROWS, first
    heard = _heard(problem, first)
    for i in _slides(len(heard)):
        last = int(heard[i])
        found, verdict = _stretch(problem, last, dynamics, speed, rate)
        if found is not None and found.clean:
            return Beginning(found.last, found.state, Status.OK, Status.OK, fit=found.fit)
        if found is not None:
            doubtful.append(found)
        elif verdict != Status.CONTRADICTORY:
            break  # what all later scans leave open, fewer of them do too
        if found is not None and found.p >= _PLAUSIBLE:
            break
    if doubtful:
        return _doubtful(min(doubtful, key=lambda each: each.fit[0] / max(each.fit[1], 1)))
    if verdict == Status.CONTRADICTORY:  # of these scans; later ones may agree
        return Beginning(last, None, Status.REJECTED, Status.REJECTED, "the rows of the scans contradict each other")
    reason = f"the scans that are left do not determine a state: {verdict.label}"
    return Beginning(problem.epochs - 1, None, verdict, verdict, reason)


def _doubtful(best: _Stretch) -> Beginning:
    """Return a start that is not clean, with a status that says what is wrong with it."""
    others = int(np.isfinite(best.fix.alternatives.gap).sum())
    if best.p < _PLAUSIBLE:
        code, reason = Status.REJECTED, f"the rows of the start contradict each other (p = {best.p:.2g})"
    elif others:
        code, reason = Status.AMBIGUOUS, f"the start has {others} alternative{'s' if others > 1 else ''}"
    else:
        code, reason = Status.CURVED, "the covariance of the start does not cover"
    return Beginning(best.last, best.state, code, Status.OK, reason, best.fit)


def _slides(count: int) -> Iterator[int]:
    """Yield which of so many scans starts are tried from: the next few, then ever farther apart."""
    i = 0
    for _ in range(_TRIES):
        if i < count:
            yield i
        i = max(i + 1, i * 3 // 2)


def _stretch(
    problem: Problem, k: int, dynamics: Dynamics, speed: float | None, rate: float | None
) -> tuple[_Stretch | None, Status]:
    """Return the first clear start from scan k on, else the first one that is answered, and the last verdict."""
    run, ambiguous, verdict = cut(problem, k, problem.epochs), None, Status.TOO_FEW_ROWS
    for count in counts(run.epochs, dynamics.order, speed, rate):
        if ambiguous is not None and count > _CLEAR:
            break
        fix = first_fix(run, dynamics, count, speed=speed, rate=rate)
        verdict = Status(int(fix.code))
        # More scans do not mend rows that contradict each other; NaN without redundancy, where nothing does.
        contradicted = bool(fix.p_value < _PLAUSIBLE)
        state = state_of(run, fix, count) if bool(fix.answered) else None
        if state is None or _is_vague(problem, state):
            if contradicted:
                return ambiguous, Status.CONTRADICTORY
            continue
        found = _Stretch(fix, k + count - 1, state)
        if contradicted:
            return ambiguous or found, verdict
        if found.clean:
            return found, verdict
        ambiguous = ambiguous or found
    return ambiguous, verdict


def _is_vague(problem: Problem, state: State) -> bool:
    """Return whether a state is vaguer than the range of the target, so that it begins nothing; NaN is vague, too."""
    d = problem.dimension
    sigma = float(np.sqrt(np.linalg.eigvalsh(state.cov[:d, :d])[-1]))
    return not sigma <= reach(problem, state.mean[:d])


def _heard(problem: Problem, first: int) -> Array:
    """Return the scans from `first` on that have a valid row."""
    scans = np.unique(problem.epoch[problem.weight > 0.0])
    return np.asarray(scans[scans >= first])


def reach(problem: Problem, position: Array) -> float:
    """Return the spread of the stations, or the range of a position (d,) from their centre if that is more, metres."""
    centre, spread = centre_and_spread(problem.stations.places.reshape(-1, problem.dimension))
    return max(float(spread), float(np.linalg.norm(position - centre)))
