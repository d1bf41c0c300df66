"""Prediction and update of the state of a target, scan by scan, and the types `State` and `Track`.

Letters: k scans, m rows of a scan, n numbers of a state, d coordinates, (...) a batch of targets.

Arguments of many functions: `problem` is a run of one target, `dynamics` is the model of motion, `rule`
is the filter, and `ahead` is a predicted state.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.errors import NUMERICAL, InvalidProblem
from optloc.base.plots import plot_of
from optloc.base.short_form import HasShortForm
from optloc.base.types import Array, Motion, Status
from optloc.kernels.filter import CODE, GENERAL, Move
from optloc.problem.epochs import cut
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.problem.state_order import in_order
from optloc.tracking.dynamics import Dynamics
from optloc.tracking.scan_rows import Scans
from optloc.tracking.updates import Filter, Update, Updated, filter_of, read

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Smallest eigenvalue of a singular covariance after rounding, as a share of its largest entry.
_NEGATIVE = 1e-9


@dataclass(frozen=True, slots=True)
class State:
    """Estimated state of a target at one time.

    Parameters
    ----------
    time : float
        Seconds.
    mean : array (..., n)
        State [p, v, a]: position (m), velocity (m/s) and acceleration (m/s^2), as far as the model has them.
    cov : array (..., n, n)
        Covariance of the state.
    """

    time: float
    mean: Array
    cov: Array


@dataclass(frozen=True, slots=True, repr=False)
class Track(HasShortForm):
    """States of a target over time (k scans); a batch of targets has leading axes (...).

    Parameters
    ----------
    times : array (k,)
        Times of the scans, seconds.
    mean : array (..., k, n)
        State [p, v, a] after each scan: m, m/s, m/s^2.
    cov : array (..., k, n, n)
        Covariance after each scan.
    nis : array (..., k)
        Normalised innovation squared; NaN if no row was used.
    count : int array (..., k)
        Number of rows used.
    loglikelihood : array (..., k)
        Log-likelihood of each scan given the prediction; 0 if no row was used.
    code : int array (..., k)
        `Status` of each scan. Ok. Too few rows: no valid row, the state is only predicted. Rejected: rows failed
        the gate or are not finite. Numerical: the update failed, the state is only predicted.
    dimension : int
        2 or 3.
    dated : bool
        Whether the times are since 1970, UTC.
    """

    times: Array
    mean: Array
    cov: Array
    nis: Array
    count: Array
    loglikelihood: Array
    code: Array
    dimension: int
    dated: bool = False

    @property
    def position(self) -> Array:
        """Return the positions (..., k, d), metres."""
        return self.mean[..., : self.dimension]

    @property
    def velocity(self) -> Array:
        """Return the velocities (..., k, d), metres per second; raise InvalidProblem for a static target."""
        if self.mean.shape[-1] < 2 * self.dimension:
            raise InvalidProblem("the state has no velocity", "velocity", "use a model of motion with velocity")
        return self.mean[..., self.dimension : 2 * self.dimension]

    def states(self, order: str) -> tuple[Array, Array]:
        """Return states (..., k, m) and covariances (..., k, m, m) with their components in another order.

        Parameters
        ----------
        order : str
            Names of components, for example "x vx y vy". The order of `mean` is x y z vx vy vz ax ay az.

        Raises
        ------
        InvalidProblem
            If the state has no component of this name.
        """
        return in_order(order, self.dimension, self.mean, self.cov)

    def plot(self, problem: Problem | None = None, **options: Any) -> Axes:
        """Return a plan, or another picture, in matplotlib axes; see `optloc.show.track_axes` for the options."""
        return plot_of(self, problem=problem, **options)

    @property
    def last(self) -> State:
        """Return the state after the last scan."""
        return State(float(self.times[-1]), self.mean[..., -1, :], self.cov[..., -1, :, :])


def followed(problem: Problem, start: State, dynamics: Dynamics, update: Update | str = "iekf") -> Track:
    """Return the track of a target from a given state.

    Parameters
    ----------
    problem : Problem
        Batch (...) of runs, see `scans`; scans at or before the start are ignored.
    start : State
        State at or before the first used scan.
    dynamics : Dynamics
        Model of motion.
    update : callable or str
        A filter, or its name in `UPDATES`.

    Raises
    ------
    InvalidProblem
        If the filter is unknown, the state does not fit the dynamics, or the run has several targets.
    """
    check_state(start, (dynamics.order + 1) * problem.dimension)
    check_trackable(problem)
    return follow(problem, start, dynamics, filter_of(update))


def follow(problem: Problem, start: State, dynamics: Dynamics, rule: Update) -> Track:
    """Return the track of a state through the scans of a run; scans at or before the start are ignored.

    `rule` is the filter. The arguments are not checked, see `followed`.
    """
    given, state, steps, times = Scans.of(problem, dynamics.order), start, [], []
    for k, time in enumerate(problem.times.tolist()):
        if time <= start.time:
            continue
        done, code = step(given, k, state, dynamics, rule)
        state = State(time, done.mean, done.cov)
        steps.append((done, code))
        times.append(time)
    return collect(np.array(times), steps, problem.dimension, dated=problem.dated)


def step(
    given: Scans,
    k: int,
    state: State,
    dynamics: Dynamics,
    rule: Update,
    more: tuple[Array, Array] | None = None,
) -> tuple[Updated, Array]:
    """Return the state after prediction to scan k and update, and its status (...) as in `take_scan`.

    `given` are the scans, `state` is the state before the prediction, and `rule` is the filter. The scan is
    not before the state. `more` replaces the measurements minus corrections (..., m) and the weights (..., m)
    of the scan. One call of compiled code does the update if possible.
    """
    problem = given.problem
    time, d = float(problem.times[k]), problem.dimension
    if isinstance(rule, Filter) and given.rows[k] is not None:
        found = given.filtered(
            k, state.mean, state.cov, rule.how._replace(d=d), move_of(state, dynamics, time, d), more
        )
        if found is not None and not (found.values[..., CODE] == GENERAL).any():
            return read(found), found.values[..., CODE].astype(np.int8)
    scan = scan_at(problem, k, given.order)
    if more is not None:
        scan = scan.with_rows(z=more[0] + scan.correction, weight=more[1])
    return take_scan(scan, predicted(state, dynamics, time, d), rule)


def move_of(state: State, dynamics: Dynamics, time: float, dimension: int) -> Move | None:
    """Return the prediction step of a state (...) to a later `time`, s, or None for the same time."""
    dt = _elapsed(state, time)
    if dt == 0.0:
        return None
    return Move(*dynamics.step(dt, state.mean, dimension))


def _elapsed(state: State, time: float) -> float:
    """Return the seconds from a state to a later time; raise InvalidProblem for an earlier time."""
    if time < state.time:
        raise InvalidProblem(f"the scan at {time} s is before the state at {state.time} s", "times", "sort the scans")
    return time - state.time


def predicted(state: State, dynamics: Dynamics, time: float, dimension: int) -> State:
    """Return the predicted state at a later time.

    Parameters
    ----------
    state : State
        State of the order of the dynamics.
    dynamics : Dynamics
        Model of motion.
    time : float
        Time of the prediction in seconds, not before the state.
    dimension : int
        2 or 3.
    """
    dt = _elapsed(state, time)
    # Two scans at the same time: some models divide by the time step, so skip them.
    if dt == 0.0:
        return state
    # The model adds the drive to the mean after F: for the current statistical model, the effect of the present
    # acceleration.
    F, Q, drive = dynamics.step(dt, state.mean, dimension)
    cov = F @ state.cov @ F.T + Q
    return State(time, (F @ state.mean[..., None])[..., 0] + drive, 0.5 * (cov + np.swapaxes(cov, -1, -2)))


def take_scan(scan: Problem, ahead: State, rule: Update, causes: list[str] | None = None) -> tuple[Updated, Array]:
    """Return the update of a predicted state (...) by a scan, and its status (...); a bad scan keeps the prediction.

    `scan` is a problem of one epoch at the time of the state `ahead`, and `rule` is the filter. If an update
    fails numerically, its cause is appended to `causes`.
    """
    shape = ahead.mean.shape[:-1]
    if not scan.rows or not scan.count:
        return _prediction_only(ahead), np.full(shape, int(Status.TOO_FEW_ROWS), dtype=np.int8)
    usable, broken = scan, np.zeros((), dtype=bool)
    if not np.isfinite(scan.z).all():
        # One scan may serve many targets, and one target many runs, so the weights have the axes of both.
        weight = np.broadcast_to(scan.weight, np.broadcast_shapes((*shape, scan.count), scan.z.shape))
        bad = ~np.isfinite(scan.z) & (weight > 0.0)
        usable, broken = scan.with_rows(z=np.where(bad, 0.0, scan.z), weight=weight * ~bad), np.asarray(bad.any(-1))
    # A lost state gets a status below, so it needs no warning.
    with np.errstate(all="ignore"):
        done = _update_each(usable, ahead, rule, [] if causes is None else causes)
    if not broken.any() and np.isfinite(done.cov).all() and np.isfinite(done.mean).all() and np.all(done.count > 0):
        return done, np.zeros(done.mean.shape[:-1], dtype=np.int8)
    lost = ~(np.isfinite(done.mean).all(-1) & np.isfinite(done.cov).all((-1, -2)))
    empty = done.count == 0
    # Order of severity: a lost state, then rows that are not finite, then a scan without rows.
    code = np.where(lost, Status.NUMERICAL, np.where(empty, Status.TOO_FEW_ROWS, Status.OK))
    code = np.where(broken & ~lost, Status.REJECTED, code).astype(np.int8)
    # Without a usable row, the prediction is the best estimate.
    kept = lost | empty
    mean = np.where(kept[..., None], ahead.mean, done.mean)
    cov = np.where(kept[..., None, None], ahead.cov, done.cov)
    return Updated(
        mean, cov, np.where(kept, np.nan, done.nis), np.where(kept, 0.0, done.loglikelihood), done.count
    ), code


def _update_each(scan: Problem, ahead: State, rule: Update, causes: list[str]) -> Updated:
    """Return the update of states (...); a state whose update fails numerically is NaN, and the others are valid.

    If the update of a batch fails, each state is updated alone. The cause of a failure is appended to `causes`.
    """
    try:
        return rule(scan, ahead.mean, ahead.cov)
    except NUMERICAL as error:
        n, shape = ahead.mean.shape[-1], np.broadcast_shapes(scan.batch_shape, ahead.mean.shape[:-1])
        if math.prod(shape) == 1:
            causes.append(str(error) or type(error).__name__)
            # A mean has one axis of n numbers, a covariance has two, and the other fields have none.
            mean, cov, none = (np.full((*shape, *([n] * core)), np.nan) for core in (1, 2, 0))
            return Updated(mean, cov, none, none, np.zeros(shape))
    mean = np.broadcast_to(ahead.mean, (*shape, n)).reshape(-1, n)
    cov = np.broadcast_to(ahead.cov, (*shape, n, n)).reshape(-1, n, n)
    # `which` is the number of the scan of each state: several states may share one scan.
    size = math.prod(scan.batch_shape)
    which, flat = np.broadcast_to(np.arange(size).reshape(scan.batch_shape), shape).ravel(), scan.flat()
    each = [
        _update_each(flat.take(np.array([i])), State(ahead.time, *one), rule, causes)
        for i, *one in zip(which, mean, cov, strict=True)
    ]
    return Updated(
        *(
            np.stack([np.asarray(getattr(one, field.name)) for one in each]).reshape(*shape, *([n] * core))
            for field, core in zip(fields(Updated), (1, 2, 0, 0, 0), strict=True)
        )
    )


def _prediction_only(ahead: State) -> Updated:
    """Return the prediction (...) as an update without rows: NIS is NaN, and count and log-likelihood are 0."""
    shape = ahead.mean.shape[:-1]
    none = np.zeros(shape)
    return Updated(ahead.mean, ahead.cov, np.full(shape, np.nan), none, none)


def collect(times: Array, steps: list[tuple[Updated, Array]], dimension: int, *, dated: bool = False) -> Track:
    """Return the updates and statuses of all scans as a track.

    `steps` are the update and status of each scan, in the order of the `times` (k,), s, which are since 1970,
    UTC, if `dated`. `dimension` is 2 or 3.
    """
    if not steps:
        raise InvalidProblem("no scan is later than the start", "start", "give a start before the last scan")

    def stacked(name: str, core: int) -> Array:
        """Return a field of all updates with an axis of scans before its `core` last axes."""
        return np.stack([getattr(done, name) for done, _ in steps], axis=-1 - core)

    return Track(
        times,
        stacked("mean", 1),
        stacked("cov", 2),
        stacked("nis", 0),
        stacked("count", 0).astype(int),
        stacked("loglikelihood", 0),
        np.stack([code for _, code in steps], axis=-1),
        dimension,
        dated,
    )


# Scans of a run, and checks of runs and states.


def scans(problem: Problem, order: int) -> Iterator[tuple[float, Problem]]:
    """Yield the times (seconds) and the scans of a run.

    A scan is a problem of one epoch. Its only unknown is the state at the time of the epoch.

    Parameters
    ----------
    problem : Problem
        A run of one target without biases; its model of motion is ignored. Convert arrival times to differences first.
    order : int
        Order of the state.
    """
    check_trackable(problem)
    for k in range(problem.epochs):
        yield float(problem.times[k]), scan_at(problem, k, order)


def scan_at(problem: Problem, k: int, order: int) -> Problem:
    """Return scan k of a run as a problem, see `scans`; it has no rows if the epoch has no rows.

    `order` is the order of the state.
    """
    if not (problem.epoch == k).any():
        return replace(problem, rows=())
    # The unknown of a scan is the state at the time of the scan, so this time is the reference of the motion.
    scan = cut(replace(problem, motions=(Motion(order),)), k, k + 1)
    return replace(scan, motions=(Motion(order, reference=float(problem.times[k])),))


def check_trackable(problem: Problem) -> None:
    """Raise InvalidProblem with advice if a tracker of one target cannot use the run."""
    if len(problem.motions) > 1:
        raise InvalidProblem("there are several targets", "track", "track each target separately")
    if problem.biases:
        advice = "estimate it first, then call `with_known_bias`"
        raise InvalidProblem(f"the bias {problem.biases[0].name!r} is unknown", "track", advice)
    if problem.emitting:
        raise InvalidProblem(
            "emission times are unknown", "track", "convert to differences with `optloc.engine.reduce`"
        )
    if problem.stations.unknown_for:
        raise InvalidProblem("station offsets are unknown", "stations", 'give their errors span = "noise"')
    if problem.fences:
        raise InvalidProblem("a track cannot use fences", "track", "leave them out, or solve the run as one problem")


def check_state(state: State, n: int) -> None:
    """Raise InvalidProblem for a state that does not have n numbers, or has an invalid covariance."""
    if state.mean.shape[-1:] != (n,) or state.cov.shape[-2:] != (n, n):
        raise InvalidProblem(
            f"{n} unknowns, but a state of {state.mean.shape[-1]} numbers and a covariance {state.cov.shape[-2:]}",
            "start",
            "give position, velocity and acceleration as in the dynamics",
        )
    if not (np.isfinite(state.mean).all() and np.isfinite(state.cov).all()):
        raise InvalidProblem("the state is not finite", "start", "start from a fix with an answer")
    if (np.linalg.eigvalsh(state.cov)[..., 0] < -_NEGATIVE * np.abs(state.cov).max((-1, -2))).any():
        raise InvalidProblem("the covariance is not positive semidefinite", "start", "give a valid covariance")


def status_of_scans(fix: Fix) -> Array:
    """Return the statuses (...) of fixes as statuses of scans, which need no proof that a position is unique."""
    alone = fix.answered & ~fix.has(Status.MISFIT, Status.UNBOUNDED, Status.AMBIGUOUS)
    return np.where(alone, int(Status.OK), fix.code).astype(np.int8)
