"""Initial states of tracks: a fix of one epoch, or of several epochs that determine a velocity.

Letters: n numbers of a state, d of them coordinates of the position.

Arguments of many functions: `problem` is a run of one target, and `dynamics` is the model of motion.
`speed` (m/s) and `rate` (m/s^2) are prior sigmas of velocity and acceleration, or None. `method` is a
method of `optloc.solve`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from optloc.base.errors import InvalidProblem, NoSolution
from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array, Band, Motion, Prior, Rows, Status
from optloc.problem.epochs import cut
from optloc.problem.fix import Fix
from optloc.problem.noise import Block, Noise
from optloc.problem.problem import Problem
from optloc.solvers.solution import solve
from optloc.solvers.verdict.findings import Finding, objections
from optloc.tracking.dynamics import Dynamics
from optloc.tracking.level_plane import is_level
from optloc.tracking.rivals import Rival
from optloc.tracking.track import State, check_trackable

# Metres. It is below every other error; a millimetre has too few digits in ECEF coordinates for convergence.
_EXACT = 1e-2
# If the chi-square of the rows of a start is less likely than this, the rows contradict each other. The next scan is
# then tried as a start. One of ten thousand good starts is rejected, which costs a scan; a wrong start costs the track.
_PLAUSIBLE = 1e-4
# Largest number of first scans that are tried before a contradictory start is accepted: every attempt needs a fix, and
# for a longer contradiction a status is better than a longer search. The distance grows by half each time, and eleven
# attempts reach over forty scans. A target with bad reception at first (a drone on the floor) has moved by then.
_TRIES = 11
# Largest number of scans of a start that is extended until its state is unique: in a longer start, the fit depends more
# on the model of motion, which has no noise here, than on the rows.
_CLEAR = 24
# Limits of the standard deviation of a position, in spreads of the stations and as a share of its distance from them.
# If both are exceeded, the track ends. Three standard deviations then reach the stations. Far away, all differences of
# received levels are alike: a track by level differences moved 650 m away from an apartment of 9 m. With a limit of
# three spreads, this track lasts one scan longer.
_SPREADS, _SHARE = 2.0, 1.0 / 3.0

Fit = tuple[float, int]
"""Sum of the squared innovations (or residuals) of rows in their standard deviations, and the number of rows."""


def begun(
    problem: Problem,
    dynamics: Dynamics,
    *,
    epochs: int | None = None,
    speed: float | None = None,
    rate: float | None = None,
    method: str = "auto",
) -> State:
    """Return the initial state of the target of a run, without a guess.

    The first epochs are solved as one problem of the order of the dynamics. Epochs are added until position, velocity
    and acceleration are determined. With prior standard deviations, the first epoch alone may be enough.

    Parameters
    ----------
    problem : Problem
        A single run.
    dynamics : Dynamics
        Gives the order of the state.
    epochs : int, optional
        Number of first epochs for the start; None for the smallest number that determines the state.
    speed, rate : float, optional
        Prior standard deviation of each coordinate of velocity (m/s) and acceleration (m/s^2), about zero.
    method : str
        Method of `optloc.solve` for the epochs; "robust" if rows may have gross errors.

    Returns
    -------
    State
        State at the time of the last used epoch.

    Raises
    ------
    InvalidProblem
        If the run has several targets.
    NoSolution
        If no number of epochs determines the state; the exception has the last fix.
    """
    check_trackable(problem)
    order = dynamics.order
    fix, used = None, 0
    for used in [epochs] if epochs is not None else counts(problem.epochs, order, speed, rate):
        fix = first_fix(problem, dynamics, used, speed=speed, rate=rate, method=method)
        if is_one_gaussian(fix):
            return state_of(problem, fix, used)
    if fix is None:
        raise InvalidProblem("there are no epochs", "start", "give a run of at least one scan")
    raise NoSolution(problem, fix)


def is_one_gaussian(fix: Fix) -> bool:
    """Return whether a fix is one position with a valid covariance, as a filter requires for its start.

    A proof of uniqueness exists for single scans at most; for runs it is enough that no other position was found.
    """
    against = (Status.MISFIT, Status.UNBOUNDED, Status.AMBIGUOUS, Status.CURVED)
    return bool(fix.answered) and not bool(fix.has(*against))


def two_point(first: Fix, second: Fix, times: tuple[float, float]) -> State:
    """Return the state at the second of two fixes, with velocity and the covariance between both.

    Parameters
    ----------
    first, second : Fix
        Fixes (...) of static positions with independent errors.
    times : tuple of two float
        Seconds.

    Raises
    ------
    InvalidProblem
        If the second fix is not later than the first.

    References
    ----------
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), eq.
    5.5.3-4, with the covariance of each fix.
    """
    # The error of the second fix is in both parts of the state, so its covariance correlates velocity and position.
    T = times[1] - times[0]
    if not T > 0.0:
        raise InvalidProblem(
            f"the fixes at {times[0]} and {times[1]} s are not in order", "times", "give the earlier fix first"
        )
    one, two = first.covariance(), second.covariance()
    mean = np.concatenate([second.position, (second.position - first.position) / T], axis=-1)
    upper = np.concatenate([two, two / T], axis=-1)
    lower = np.concatenate([two / T, (one + two) / T**2], axis=-1)
    return State(times[1], mean, np.concatenate([upper, lower], axis=-2))


def counts(epochs: int, order: int, speed: float | None = None, rate: float | None = None) -> list[int]:
    """Return the numbers of first epochs that a start tries, each half larger than the number before; see `begun`.

    `epochs` is the length of the run, the last number. `order`, `speed` and `rate` decide the first number.
    """
    # With a prior of every rate, one epoch may be enough; otherwise a state of order q needs at least q + 1 scans.
    known = speed is not None and (order < 2 or rate is not None)
    count = 1 if order == 0 or known else order + 1
    out = []
    while count < epochs:
        out.append(count)
        # Half more each time: all attempts together take about three times as long as the last attempt.
        count = max(count + 1, count * 3 // 2)
    return [*out, epochs]


def first_fix(
    problem: Problem,
    dynamics: Dynamics,
    count: int,
    *,
    speed: float | None = None,
    rate: float | None = None,
    method: str = "auto",
) -> Fix:
    """Return the fix of the first `count` epochs of a run, with a motion of the order of the dynamics; see `begun`."""
    return solve(_start_problem(problem, count, dynamics.order, speed, rate), method)


def _start_problem(problem: Problem, count: int, order: int, speed: float | None, rate: float | None) -> Problem:
    """Return the first `count` epochs of a run as one problem, with priors of velocity and acceleration.

    The unknown is a state of the given `order`. `speed` (m/s) and `rate` (m/s^2) are the sigmas of the
    priors, or None.
    """
    part = cut(problem, 0, count)
    d = problem.dimension
    priors = [
        Prior(name, np.zeros(d), sigma**2 * np.eye(d))
        for name, sigma in (("velocity", speed), ("acceleration", rate))[:order]
        if sigma is not None
    ]
    # The state is estimated at the last used scan, where tracking continues.
    motion = Motion(order, reference=float(problem.times[count - 1]))
    return replace(part, motions=(motion,), priors=tuple(priors))


def state_of(problem: Problem, fix: Fix, used: int) -> State:
    """Return the `first_fix` of the first `used` epochs as a state at the last of these epochs."""
    mean, cov = fix.gaussian()
    return State(float(problem.times[used - 1]), np.array(mean), np.array(cov))


def with_height_rows(problem: Problem) -> Problem:
    """Return a run whose exact height, if there is one, is a measurement of every epoch with a sigma of a centimetre.

    Bounds remain, because they separate starts. Epochs without rows do not get a height.

    Parameters
    ----------
    problem : Problem
        A run of one target.

    Raises
    ------
    InvalidProblem
        For another equality than an exact height, because updates would not keep it.
    """
    # An exact height becomes a row of every scan, so that updates keep it as starts do.
    exact = [c for c in problem.constraints if isinstance(c, Band) and np.array_equal(c.lower, c.upper)]
    exact = [c for c in exact if not is_level(c)]  # a plane z = h is kept by the filter, see `OnPlane`
    if not exact:
        return problem
    other = next((c for c in exact if c.kind != "height"), None)
    if other is not None:
        advice = "replace it by bounds, or solve the run as one problem"
        raise InvalidProblem(f"the constraint {other.name!r} is an equality", "track", advice)
    observed = np.unique(problem.epoch[problem.weight > 0.0])
    m, none = len(observed), np.full(len(observed), -1)
    rise = problem.motions[0].rise
    z = np.broadcast_to(exact[0].lower, (m,)) if rise is None else exact[0].lower[..., None] + rise[..., observed, 0]
    rows = Rows("height", z, none, none, observed, np.zeros_like(observed), np.ones(m), np.zeros(m))
    block = Block(problem.count + np.arange(m)[:, None], np.full((1, 1, 1), _EXACT**2))
    kept = tuple(c for c in problem.constraints if not any(c is e for e in exact))
    return replace(problem, rows=(*problem.rows, rows), noise=Noise((*problem.noise.blocks, block)), constraints=kept)


# Start of a track: the first scans that determine a state and do not contradict each other.


@dataclass(frozen=True, slots=True)
class Beginning:
    """A start, or the reason why there is no start.

    - last: last scan that was used or given up.
    - state: state at this scan, or None.
    - code: ok; ambiguous if the state has alternatives; rejected if the rows contradict each other; curved if
    the
      covariance is not valid; without a state, the status of the last attempt.
    - waiting: status of the scans before; ok if a start follows.
    - reason: a sentence if the status is not ok.
    - fit: chi-square of the rows of the start, and its degrees of freedom.
    - left_out: number of rows of the last scan that a robust start excludes.
    - first: first used scan.
    - rivals: other states at the last scan if the start is ambiguous.
    """

    last: int
    state: State | None
    code: Status
    waiting: Status
    reason: str = ""
    fit: Fit = (0.0, 0)
    left_out: int = 0
    first: int = 0
    rivals: tuple[Rival, ...] = ()


class Undecided(Exception):  # noqa: N818  # no error: more scans follow
    """Raised if a start needs more scans than have arrived; `scans` is the necessary number of scans of the run."""

    def __init__(self, scans: int) -> None:
        """Store the necessary number of scans."""
        super().__init__(scans)
        self.scans = scans


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Successive scans that determine a state.

    - fix: their common fix.
    - first, last: numbers of the first and the last scan.
    - state: state at the last scan.
    - left_out, left_out_last: number of rows that a robust fix excludes, of all scans and of the last scan.
    """

    fix: Fix
    first: int
    last: int
    state: State
    left_out: int
    left_out_last: int

    @property
    def p(self) -> float:
        """Return the p-value of the rows (chi-square).

        Without redundancy it is 1, because then no row contradicts the others.
        """
        p = float(self.fix.p_value)
        return 1.0 if np.isnan(p) else p

    @property
    def others(self) -> int:
        """Return the number of other minima that explain the rows."""
        return int(np.isfinite(self.fix.alternatives.gap).sum())

    @property
    def fit(self) -> Fit:
        """Return the chi-square of the rows and its degrees of freedom."""
        return float(self.fix.cost), int(self.fix.dof)

    @property
    def clean(self) -> bool:
        """Return whether a filter can start with this state: one Gaussian, from rows that fit together."""
        # With less redundancy, other rows might be the wrong rows, see `optloc.solvers.suspect_rows`.
        sure = not self.left_out or int(self.fix.dof) > self.left_out
        return sure and self.p >= _PLAUSIBLE and is_one_gaussian(self.fix)

    def beginning(self, code: Status, reason: str = "") -> Beginning:
        """Return the stretch as a start with a status and its sentence."""
        return Beginning(self.last, self.state, code, Status.OK, reason, self.fit, self.left_out_last, self.first)


def begin(
    problem: Problem,
    first: int,
    dynamics: Dynamics,
    speed: float | None,
    rate: float | None,
    method: str = "auto",
    *,
    ends: bool = True,
) -> Beginning:
    """Return a start at scan `first` or later, without a guess.

    The smallest number of scans that determines the state is solved as one problem. If their rows contradict
    each other, the start begins at a later scan. If several states explain the rows, the stretch of
    scans is extended. `speed`, `rate` and `method` are as in `begun`. With `ends`, `problem` has all scans of
    the run; otherwise a start that needs later scans raises `Undecided`.
    """
    doubtful: list[_Stretch] = []
    verdict, last = Status.TOO_FEW_ROWS, first
    observed = _scans_with_rows(problem, first)
    # `i` is an index of `observed`: scans without a row are no start. `last` is the scan of the present attempt.
    for i in _trial_scans(len(observed) if ends else np.inf):
        if i >= len(observed):
            raise Undecided(problem.epochs + 1)
        last = int(observed[i])
        run = cut(problem, last, problem.epochs)
        # For a run that continues, add the next numbers of scans beyond the present length.
        tries = counts(run.epochs if ends else 2 * run.epochs + 2, dynamics.order, speed, rate)
        fixed = partial(first_fix, run, dynamics, speed=speed, rate=rate, method=method)
        found, verdict = _first_stretch(run, last, tries, fixed)
        if found is not None and found.clean:
            return found.beginning(Status.OK)
        if found is not None:
            doubtful.append(found)
        elif verdict != Status.CONTRADICTORY:
            break  # if all later scans leave the state open, fewer scans do so too
        # Another first scan is tried only if the rows contradict each other.
        if found is not None and found.p >= _PLAUSIBLE:
            break
    if doubtful:
        # The stretch with the least chi-square per degree of freedom; its redundancy can be 0.
        best = min(doubtful, key=lambda each: each.fit[0] / max(each.fit[1], 1))
        start = _doubtful_start(best)
        if start.code != Status.AMBIGUOUS:
            return start
        run = cut(problem, best.first, problem.epochs)
        posed = _start_problem(run, best.last - best.first + 1, dynamics.order, speed, rate)
        return replace(start, rivals=tuple(_rivals(posed, best)))
    if verdict == Status.CONTRADICTORY:  # these scans contradict each other; later scans may agree
        why = "the rows of the scans contradict each other"
        return Beginning(last, state=None, code=Status.REJECTED, waiting=Status.REJECTED, reason=why)
    reason = f"the remaining scans do not determine a state: {verdict.label}"
    return Beginning(problem.epochs - 1, state=None, code=verdict, waiting=verdict, reason=reason)


def _doubtful_start(best: _Stretch) -> Beginning:
    """Return a start with a doubtful state, and the status that names the problem."""
    return best.beginning(*objections(_FINDINGS, best)[0])


def _rivals(posed: Problem, best: _Stretch) -> Iterator[Rival]:
    """Yield the other minima of a start as states.

    `posed` is the problem of the start `best`; rows that a robust fix left out are not used. Each minimum is
    refined again, because its covariance is needed.
    """
    kept = posed.with_rows(weight=posed.weight * (best.fix.weights > 0.0))
    others = best.fix.alternatives
    for x, gap in zip(others.x, others.gap, strict=True):
        if np.isfinite(gap) and np.isfinite(x).all():
            mean, cov = solve(kept, "lsr", start=x).gaussian()
            if np.isfinite(mean).all() and np.isfinite(cov).all():
                yield Rival(State(best.state.time, np.array(mean), np.array(cov)), float(gap))


_FINDINGS = (
    Finding(
        Status.REJECTED,
        lambda start: start.p < _PLAUSIBLE,
        lambda start: [f"the rows of the start contradict each other (p = {start.p:.2g})"],
    ),
    Finding(
        Status.AMBIGUOUS,
        lambda start: start.others,
        lambda start: [f"the start has {start.others} alternative{'s' if start.others > 1 else ''}"],
    ),
    # the last possible reason
    Finding(Status.CURVED, lambda start: True, lambda start: ["the covariance of the start is not valid"]),
)
"""Findings about a start with a doubtful state."""


def _trial_scans(count: float) -> Iterator[int]:
    """Yield the numbers of the scans at which starts are tried: the next few scans, then at increasing distances.

    There are at most `_TRIES` numbers, all below `count`.
    """
    i = 0
    for _ in range(_TRIES):
        if i < count:
            yield i
        i = max(i + 1, i * 3 // 2)


def _first_stretch(
    run: Problem, k: int, tries: Sequence[int], fixed: Callable[[int], Fix]
) -> tuple[_Stretch | None, Status]:
    """Return the first unique start of a run from scan k, else the first start with an answer, and the last status.

    `tries` are the numbers of scans to try. `fixed` returns the fix of a number of scans. The stretch is None
    if no number of scans gives an answer. If the rows contradict each other, longer stretches are not tried.
    """
    ambiguous, verdict = None, Status.TOO_FEW_ROWS
    for count in tries:
        if ambiguous is not None and count > _CLEAR:
            break
        if count > run.epochs:
            raise Undecided(k + count)
        fix = fixed(count)
        verdict = Status(int(fix.code))
        # More scans do not repair contradictory rows; the p-value is NaN without redundancy, and then no row
        # contradicts.
        contradicted = bool(fix.p_value < _PLAUSIBLE)
        state = state_of(run, fix, count) if bool(fix.answered) else None
        if state is None or _is_vague(run, state):
            if contradicted:
                return ambiguous, Status.CONTRADICTORY
            continue
        used = cut(run, 0, count)
        out = (used.weight > 0.0) & (fix.weights == 0.0)
        found = _Stretch(fix, k, k + count - 1, state, int(out.sum()), int((out & (used.epoch == count - 1)).sum()))
        if contradicted:
            return ambiguous or found, verdict
        if found.clean:
            return found, verdict
        ambiguous = ambiguous or found
    return ambiguous, verdict


def _is_vague(problem: Problem, state: State) -> bool:
    """Return whether the sigma of a position exceeds both the spread of the stations and the range of the target.

    NaN counts as exceeding.
    """
    d = problem.dimension
    sigma = float(np.sqrt(np.linalg.eigvalsh(state.cov[:d, :d])[-1]))
    return not sigma <= reach(problem, state.mean[:d])


def _scans_with_rows(problem: Problem, first: int) -> Array:
    """Return the numbers of the scans from `first` on that have a valid row, in ascending order."""
    scans = np.unique(problem.epoch[problem.weight > 0.0])
    return np.asarray(scans[scans >= first])


def reach(problem: Problem, position: Array) -> float:
    """Return the larger of the spread of the stations and the distance of a position (d,) from their centre, m.

    A prediction that is more uncertain than this length is not followed.
    """
    centre, spread = centre_and_spread(problem.stations.places.reshape(-1, problem.dimension))
    return max(float(spread), float(np.linalg.norm(position - centre)))


def out_of_sight(problem: Problem, mean: Array, cov: Array) -> str:
    """Return the reason why a position is too uncertain to follow; empty if it is not.

    The standard deviation is then more than twice the spread of the stations, and more than a third of the distance
    from their centre. `mean` (n,) and `cov` (n, n) belong to the state.
    """
    d = problem.dimension
    sigma = float(np.sqrt(max(np.linalg.eigvalsh(cov[:d, :d])[-1], 0.0)))
    centre, spread = centre_and_spread(problem.stations.places.reshape(-1, d))
    if sigma <= max(_SPREADS * float(spread), _SHARE * float(np.linalg.norm(mean[:d] - centre))):
        return ""
    return f"the position is uncertain by {sigma:.3g} m, but the spread of the stations is {float(spread):.3g} m"
