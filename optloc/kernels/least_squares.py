"""Damped Gauss-Newton (Taylor least squares, LSR) for a batch of problems; converged problems leave the batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base.threads import map_on_threads
from optloc.base.types import Array, Status
from optloc.kernels.damping import FIRST_DAMPING, FIRST_GROWTH, StopRules, judge
from optloc.kernels.pack import PackedRuns, coarseness
from optloc.kernels.sums import equations_at, packed, serves, sums_at
from optloc.linear.constraints import Face, is_height
from optloc.linear.equalities import Equalities
from optloc.linear.mirror import Folded
from optloc.linear.normal import Normal, decrement, depends_on_place, offsets_of, step, whitener_at, with_station_noise
from optloc.models.primitives import WGS84_A
from optloc.problem.epochs import is_one_window, windows
from optloc.problem.noise import Whitener, variances, whiten
from optloc.problem.problem import Problem

WEIGHINGS = 2
"""Number of refinements in sequence if station errors enlarge the noise and this noise depends on the position.

Each refinement starts at the result of the refinement before, and computes the noise there. Two are enough, because the
noise hardly changes with the position."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of one unknown, at which steps stop.

    Parameters
    ----------
    column : int
        Column of the unknown.
    low, high : array (M,)
        Least and greatest value in each refinement.
    """

    column: int
    low: Array
    high: Array

    def take(self, items: Array) -> Limits:
        """Return the limits of the selected refinements; `items` are indices or a mask."""
        return Limits(self.column, self.low[items], self.high[items])

    def clip(self, x: Array) -> Array:
        """Return vectors (M, size) with the unknown clipped to its limits."""
        out = np.array(x)
        out[:, self.column] = np.clip(x[:, self.column], self.low, self.high)
        return out

    def reached(self, x: Array, within: float = 0.0) -> Array:
        """Return -1 (M,) for vectors (M, size) at the low limit, 1 at the high limit, and 0 between the limits.

        A vector is at a limit if its distance from the limit is at most `within`, in the unit of the unknown.
        """
        z = x[:, self.column]
        return np.where(z - self.low <= within, -1, np.where(self.high - z <= within, 1, 0))


@dataclass(frozen=True, slots=True)
class Refined:
    """The refined estimates, with their costs and statuses.

    Parameters
    ----------
    x : array (N, size)
        Parameter vectors.
    cost : array (N,)
        Weighted sum of squared residuals and prior penalties.
    status : int array (N,)
        `Status` of each: ok, max iterations, stalled, singular geometry, numerical.
    iterations : int array (N,)
        Number of steps tried.
    make : callable
        Returns the normal equations at `x`.
    """

    x: Array
    cost: Array
    status: Array
    iterations: Array
    make: Callable[[], Normal]

    @property
    def equations(self) -> Normal:
        """Return the normal equations at `x`."""
        return self.make()


def refine(
    problem: Problem,
    start: Array,
    *,
    item: Array | None = None,
    tolerance: float = 1e-7,
    limit: int = 60,
    damped: bool = True,
    face: Face = (),
    folded: Folded | None = None,
    limits: Limits | None = None,
) -> Refined:
    """Return the local maximum-likelihood estimates near given starts.

    Levenberg's method with Marquardt's scaling: a step is accepted if it lowers the cost, and the damping follows the
    ratio of the achieved to the predicted decrease (Nielsen 1999).

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    start : array (M, size)
        Starting vectors.
    item : int array (M,), optional
        Problem of each start; by default one start for each problem, M = N.
    tolerance : float
        A fix has converged if its next step is shorter than this number of its standard deviations.
    limit : int
        Greatest number of steps.
    damped : bool
        If False, plain Taylor iteration: every step is accepted, even if it raises the cost.
    face : Face
        Levels that the estimate satisfies with equality, also in every epoch of a run. Steps follow their
        tangent space, and the vectors are projected back onto them.
    folded : Folded, optional
        Restricts steps to a plane of symmetry of the problem, instead of a face.
    limits : Limits, optional
        Limits of one unknown for each start. A refinement ends with the status stalled if a step stays at a limit.

    Returns
    -------
    Refined
        One entry for each start.
    """
    # By default the last step is far below any uncertainty, and its square adds 1e-14 to the cost. Sixty steps are ten
    # times the number that fixes near their stations take.
    rules = StopRules(float(tolerance), int(limit), bool(damped))
    quick = None if face or folded or limits else _by_machine_code(problem, start, item, rules)
    if quick is not None:
        return quick
    weights = None
    if not depends_on_place(problem):
        weights = _Weights.of(problem, start)
        # One matrix for each problem, even if the problem has several starts.
        weights = weights if item is None else weights.take(item)
    if item is not None:
        problem = problem.take(item)
    if weights is not None:
        return _iterate(problem, start, weights, rules, face, folded, limits)
    for _ in range(WEIGHINGS):
        done = _refine_by_numpy(problem, start, rules, face, limits)
        start = done.x
    return done


# Refinement by numpy: all problems of a batch side by side; converged problems leave the batch.


def _refine_by_numpy(
    problem: Problem, start: Array, rules: StopRules, face: Face = (), limits: Limits | None = None
) -> Refined:
    """Return the refinement by numpy, with weights computed at the start; see `refine` for `face` and `limits`."""
    return _iterate(problem, start, _Weights.of(problem, start), rules, face, None, limits)


@dataclass(frozen=True, slots=True)
class _Weights:
    """The weights of the rows during an iteration.

    `matrices` are the whitening matrices of a run that is one window. `at` are the vectors at which station errors are
    converted to noise.
    """

    matrices: tuple[Whitener, ...] | None
    at: Array | None

    @classmethod
    def of(cls, problem: Problem, start: Array) -> _Weights:
        """Return the weights of a problem at given starts (N, size)."""
        at = start if depends_on_place(problem) else None
        one = is_one_window(problem, len(start))
        return cls(whiten(with_station_noise(problem, at).noise, problem.weight) if one else None, at)

    def take(self, items: Array) -> _Weights:
        """Return the weights of the selected problems."""
        matrices = None if self.matrices is None else tuple(w.take(items) for w in self.matrices)
        return _Weights(matrices, None if self.at is None else self.at[items])

    def equations(self, problem: Problem, x: Array) -> Normal:
        """Return the normal equations at vectors x (N, size) with these weights."""
        return equations_at(problem, x, self.matrices, at=self.at)


def _iterate(
    problem: Problem,
    start: Array,
    weights: _Weights,
    rules: StopRules,
    face: Face,
    folded: Folded | None,
    limits: Limits | None,
) -> Refined:
    """Return the refinement by numpy from `start` (N, size) with fixed weights.

    The `rules` end a refinement. See `refine` for `face`, `folded` and `limits`.
    """
    with np.errstate(all="ignore"):
        start = Equalities.of(problem, face).restore(start) if face else start
        start = start if limits is None else limits.clip(start)
        state = _DescentState.begin(problem, start, weights)
        active = np.arange(len(start))
        part = _ActiveProblems(problem, weights, face, _blur(problem, len(start)), folded, limits)
        for iteration in range(rules.limit):
            # MAX_ITERATIONS is the initial status: these problems have not ended.
            moving = np.flatnonzero(state.status[active] == Status.MAX_ITERATIONS)
            if not len(moving):
                break
            # Nothing is copied while all problems are active.
            if len(moving) < len(active):
                active, part = active[moving], part.take(moving)
            _advance(part, state, active, rules, iteration)
    return Refined(state.x, state.equations.cost, state.status, state.iterations, lambda: state.equations)


@dataclass(slots=True)
class _DescentState:
    """The state of the iteration of N problems; a step changes only the entries of active problems.

    `x` (N, size) are the vectors with the normal equations at them. `damping` and `growth` (N,) are Marquardt's factor
    and its change after a rejected step. `status` (N,) are numbers of `Status`, `iterations` (N,) the steps tried.
    """

    x: Array
    equations: Normal
    damping: Array
    growth: Array
    status: Array
    iterations: Array

    @classmethod
    def begin(cls, problem: Problem, start: Array, weights: _Weights) -> _DescentState:
        """Return the state at given starts (N, size)."""
        count = len(start)
        equations = _writable(weights.equations(problem, start))
        status = np.full(count, int(Status.MAX_ITERATIONS), dtype=np.int8)
        status[~np.isfinite(equations.cost)] = Status.NUMERICAL
        return cls(
            np.array(start),
            equations,
            np.full(count, FIRST_DAMPING),
            np.full(count, FIRST_GROWTH),
            status,
            np.zeros(count, dtype=np.int32),
        )


@dataclass(frozen=True, slots=True)
class _ActiveProblems:
    """The problems of a refinement that have not ended, with their weights and constraints.

    `problem` is the batch of these N problems. `blur` (N,) is the rounding error of their whitened residuals. `face`,
    `folded` and `limits` are arguments of `refine`.
    """

    problem: Problem
    weights: _Weights
    face: Face
    blur: Array
    folded: Folded | None
    limits: Limits | None

    def take(self, items: Array) -> _ActiveProblems:
        """Return the selected problems."""
        folded = None if self.folded is None else self.folded.take(items)
        limits = None if self.limits is None else self.limits.take(items)
        return _ActiveProblems(
            self.problem.take(items), self.weights.take(items), self.face, self.blur[items], folded, limits
        )

    @property
    def held(self) -> Equalities | Folded | None:
        """Return the constraints of steps; None for free steps."""
        return Equalities.of(self.problem, self.face) if self.face else self.folded


# Number of roundings between a measurement and its residual.
_ROUNDINGS = 4.0


def _blur(problem: Problem, count: int) -> Array:
    """Return the rounding error (N,) of the whitened residuals of `count` vectors, in standard deviations.

    It is large for arrival times counted from long ago.
    """
    squares: Any = 0.0
    for _, _, part in windows(problem, count):
        sigma = np.sqrt(variances(part.noise, part.count))
        ratio = (np.abs(part.observed) + coarseness(part)) / sigma
        squares = squares + (np.where(part.weight > 0.0, ratio, 0.0) ** 2).sum(-1)
    coarse = _ROUNDINGS * np.finfo(float).eps * np.sqrt(squares)
    return np.broadcast_to(np.where(np.isfinite(coarse), coarse, 0.0), (count,))


def _blur_of_face(problem: Problem, face: Face, equations: Normal) -> Array | float:
    """Return the rounding error (N,) that a known height adds to the whitened residuals.

    A position is projected onto the height from the centre of the Earth. So its coordinates have the rounding error of
    this distance. The information of the rows converts this error to residuals.
    """
    if not any(is_height(problem, level) for level in face):
        return 0.0
    slots = [slot for slot in problem.layout.shared if slot.name.partition("[")[0] == "position"]
    own = [column for slot in slots for column in range(slot.start, slot.start + slot.size)]
    information = np.diagonal(equations.shared, axis1=-2, axis2=-1)[..., own].sum(-1)
    return np.asarray(_ROUNDINGS * np.finfo(float).eps * WGS84_A * np.sqrt(np.maximum(information, 0.0)))


def _advance(part: _ActiveProblems, state: _DescentState, active: Array, rules: StopRules, iteration: int) -> None:
    """Try one step of every active problem, and write the result to `state`.

    `active` are the numbers of the problems of `part` in `state`. The `rules` end a refinement. `iteration` is the
    number of this step, from 0.
    """
    # In most batches all problems end together: while all are active, arrays are not copied.
    everything = len(active) == len(state.x)
    now = state.equations if everything else _selected(state.equations, active)
    here = state.x[active]
    damping = state.damping[active] if rules.damped else np.zeros(len(active))
    held = part.held
    move, solvable = step(now, damping) if held is None else held.step(now, damping, here)
    x = here + move if held is None else held.retract(here, move)
    x = x if part.limits is None else part.limits.clip(x)
    after = part.weights.equations(part.problem, x)
    found = judge(
        now.cost,
        after.cost,
        decrement(now, move, part.problem.layout.n_shared),
        solvable,
        part.blur + (_blur_of_face(part.problem, part.face, now) if part.face else 0.0),
        damping,
        state.growth[active],
        rules.tolerance,
        rules.damped,
    )
    state.iterations[active] = iteration + 1
    _store_accepted(state, active, found.better, x, after)
    state.damping[active], state.growth[active] = found.damping, found.growth
    if part.limits is not None:
        # a step that stays at the limit is stalled: it could only move along the limit, as on a face
        pinned = (part.limits.reached(x) != 0) & (part.limits.reached(here) == part.limits.reached(x))
        state.status[active[pinned]] = Status.STALLED
    state.status[active[found.small]] = Status.OK
    state.status[active[found.stuck]] = Status.STALLED
    if not rules.damped:
        state.status[active[~found.better]] = Status.NUMERICAL


def _store_accepted(state: _DescentState, active: Array, better: Array, x: Array, after: Normal) -> None:
    """Store accepted vectors x and their equations `after` in the state; `better` marks the accepted steps."""
    if better.all() and len(active) == len(state.x):
        state.x, state.equations = x, _writable(after)
        return
    to = active[better]
    state.x[to] = x[better]
    for mine, new in zip(state.equations.parts, after.parts, strict=True):
        mine[to] = new[better]


def _writable(equations: Normal) -> Normal:
    """Return normal equations whose arrays are writable."""
    return Normal(*(array if array.flags.writeable else np.array(array) for array in equations.parts))


def _selected(equations: Normal, index: Array) -> Normal:
    """Return the normal equations of the selected problems."""
    return Normal(*(part[index] for part in equations.parts))


# Refinement by machine code: the supported problems, and their weights.

# Greatest number of unknowns for lanes: LAPACK solves larger systems faster one after the other. For runs with local
# unknowns, lanes share the elimination: networks of 64 took half of the time in lanes.
_UNKNOWNS, _OF_RUNS = 40, 70
# Number of derivatives that are computed at a time for weights that depend on the position: 16 MB.
_WEIGHED = 2**21


def _by_machine_code(problem: Problem, start: Array, item: Array | None, rules: StopRules) -> Refined | None:
    """Return the refinement by machine code, or None if machine code does not support the problem.

    See `refine` for the arguments: starts (M, size), and the problem of each start.
    """
    most = _OF_RUNS if problem.layout.n_local and problem.epochs > 1 else _UNKNOWNS
    few = problem.layout.n_shared + problem.layout.n_local <= most
    if not few or not serves(problem, len(start)):
        return None
    own = np.arange(len(start)) if item is None else np.asarray(item, dtype=np.int64)
    if not depends_on_place(problem):
        return _refine_with_weights(
            problem, start, own, whiten(with_station_noise(problem).noise, problem.weight), rules
        )
    width = problem.layout.n_shared + offsets_of(problem)
    # Each problem has different weights. They are computed in parts, so that the derivatives fit into the memory.
    parts = np.array_split(np.arange(len(start)), 1 + len(start) * problem.count * width // _WEIGHED)

    def work(part: Array) -> Refined | None:
        """Return the refinement of the starts `part`."""
        return _refine_reweighted(problem.take(own[part]), start[part], rules)

    done = map_on_threads(work, parts) if len(parts) > 1 else [work(parts[0])]
    found = [one for one in done if one is not None]
    return _join(found) if len(found) == len(parts) else None


def _refine_with_weights(
    problem: Problem, start: Array, item: Array, noise: tuple[Whitener, ...], rules: StopRules
) -> Refined | None:
    """Return the refinement by machine code with the weights `noise`, or None if machine code is not supported.

    `start` (M, size) are the starts, `item` (M,) is the problem of each start. The `rules` end a refinement.
    """
    found = packed(problem, noise)
    if found is None:
        return None
    from optloc.kernels import refine
    from optloc.kernels.runs import refined_runs

    if isinstance(found, PackedRuns):
        done, lost = refined_runs(found, item, start, rules)
    else:
        done, lost = refine.refined(found, item, start, rules)
    # numpy refines the runs in which an epoch does not determine its local unknowns: it takes the step of least norm.
    if lost.any():
        more = _refine_by_numpy(problem.take(item[lost]), start[lost], rules)
        for name in ("x", "cost", "status", "iterations"):
            getattr(done, name)[lost] = getattr(more, name)

    def make() -> Normal:
        """Return the normal equations at the refined vectors."""
        if isinstance(found, PackedRuns):
            return sums_at(found, done.x, item, priors=True)
        return refine.equations(found, item, done)

    return Refined(done.x, done.cost, done.status, done.iterations, make)


def _refine_reweighted(problem: Problem, start: Array, rules: StopRules) -> Refined | None:
    """Return the refinement of one start of each problem.

    It runs with the weights at the start, and again with the weights at the result (`WEIGHINGS` times).
    """
    done = None
    for _ in range(WEIGHINGS):
        done = _refine_with_weights(problem, start, np.arange(len(start)), whitener_at(problem, start), rules)
        if done is None:
            return None
        start = done.x
    return done


def _join(parts: list[Refined]) -> Refined:
    """Return several refinements as one."""

    def make() -> Normal:
        """Return the normal equations of all parts."""
        made = [part.equations for part in parts]
        return Normal(*(np.concatenate(same) for same in zip(*(one.parts for one in made), strict=True)))

    x, cost, status, iterations = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "cost", "status", "iterations")
    )
    return Refined(x, cost, status, iterations, make)
