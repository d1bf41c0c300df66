"""Damped Gauss-Newton (Taylor least squares, LSR) for a batch of problems; finished ones leave the batch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.constraints import Face, restored, tangent_at
from optloc.equations import equations_at
from optloc.kernels.pack import coarseness
from optloc.noise import Whitener, variances, whiten
from optloc.normal import Normal, decrement, step
from optloc.problem import Problem
from optloc.solve.machine_code import WEIGHINGS, Refined, Rules, by_machine_code
from optloc.status import Status
from optloc.types import Array
from optloc.weigh import depends_on_place, weighed
from optloc.windows import whole, windows


def refine(
    problem: Problem,
    start: Array,
    *,
    item: Array | None = None,
    tolerance: float = 1e-7,
    limit: int = 60,
    damped: bool = True,
    face: Face = (),
) -> Refined:
    """Return the local maximum-likelihood estimates next to given starts.

    Levenberg's method with Marquardt's scaling: a step is taken where it lowers the cost, and the damping follows
    the ratio of the achieved to the predicted decrease (Nielsen 1999).

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    start : array (M, size)
        Starting vectors.
    item : int array (M,), optional
        Problem of each start; None: one start for each problem, M = N.
    tolerance : float
        A fix is finished when its next step is shorter than this many of its own standard deviations.
    limit : int
        Steps tried at most.
    damped : bool
        False: plain Taylor iteration, every step is taken whatever it does to the cost.
    face : Face
        Constraints that hold with equality: steps follow their tangent space and are put back onto them.

    Returns
    -------
    Refined
        One entry for each start.
    """
    rules = Rules(problem.layout.n_shared, tolerance, limit, damped, face)
    quick = by_machine_code(problem, start, item, rules, _remade)
    if quick is not None:
        return quick
    weights = None
    if not depends_on_place(problem):
        weights = _Weights.of(problem, start)
        weights = weights if item is None else weights.take(item)
    if item is not None:
        problem = problem.take(item)
    if weights is not None:
        return _iterated(problem, start, weights, rules)
    for _ in range(WEIGHINGS):
        done = _remade(problem, start, rules)
        start = done.x
    return done


def _remade(problem: Problem, start: Array, rules: Rules) -> Refined:
    return _iterated(problem, start, _Weights.of(problem, start), rules)


@dataclass(frozen=True, slots=True)
class _Weights:
    """What whitens the rows during an iteration: matrices of a run that is one window, else where they are taken."""

    matrices: tuple[Whitener, ...] | None
    at: Array | None

    @classmethod
    def of(cls, problem: Problem, start: Array) -> _Weights:
        at = start if depends_on_place(problem) else None
        one = whole(problem, len(start))
        return cls(whiten(weighed(problem, at).noise, problem.weight) if one else None, at)

    def take(self, items: Array) -> _Weights:
        matrices = None if self.matrices is None else tuple(w.take(items) for w in self.matrices)
        return _Weights(matrices, None if self.at is None else self.at[items])

    def equations(self, problem: Problem, x: Array) -> Normal:
        return equations_at(problem, x, self.matrices, at=self.at)


def _iterated(problem: Problem, start: Array, weights: _Weights, rules: Rules) -> Refined:
    """Return where the iteration ends whose weights stay as they are."""
    with np.errstate(all="ignore"):
        start = restored(problem, rules.face, start) if rules.face else start
        state = _State.begin(problem, start, weights)
        active, blur = np.arange(len(start)), _blur(problem, len(start))
        for iteration in range(rules.limit):
            active = active[state.status[active] == Status.MAX_ITERATIONS]
            if not len(active):
                break
            part = _Part.of(problem, weights, blur, active)
            _advance(part, state, active, rules, iteration)
    return Refined(state.x, state.equations.cost, state.status, state.iterations, lambda: state.equations)


@dataclass(slots=True)
class _State:
    """What the iteration remembers of every problem; only the active entries change."""

    x: Array
    equations: Normal
    damping: Array
    growth: Array
    status: Array
    iterations: Array

    @classmethod
    def begin(cls, problem: Problem, start: Array, weights: _Weights) -> _State:
        count = len(start)
        equations = _owned(weights.equations(problem, start))
        status = np.full(count, int(Status.MAX_ITERATIONS), dtype=np.int8)
        status[~np.isfinite(equations.cost)] = Status.NUMERICAL
        return cls(
            np.array(start),
            equations,
            np.full(count, 1e-6),
            np.full(count, 2.0),
            status,
            np.zeros(count, dtype=np.int32),
        )


@dataclass(frozen=True, slots=True)
class _Part:
    """The problems still moving."""

    problem: Problem
    weights: _Weights
    blur: Array

    @classmethod
    def of(cls, problem: Problem, weights: _Weights, blur: Array, active: Array) -> _Part:
        if len(active) == len(blur):
            return cls(problem, weights, blur)
        return cls(problem.take(active), weights.take(active), blur[active])


def _blur(problem: Problem, count: int) -> Array:
    """Return the rounding error (N,) of the whitened residuals: arrival times that count from long ago are coarse."""
    squares: Any = 0.0
    for _, _, part in windows(problem, count):
        sigma = np.sqrt(variances(part.noise, part.count))
        ratio = (np.abs(part.observed) + coarseness(part)) / sigma
        squares = squares + (np.where(part.weight > 0.0, ratio, 0.0) ** 2).sum(-1)
    coarse = 4.0 * np.finfo(float).eps * np.sqrt(squares)
    return np.broadcast_to(np.where(np.isfinite(coarse), coarse, 0.0), (count,))


def _advance(part: _Part, state: _State, active: Array, rules: Rules, iteration: int) -> None:
    """Try one step of every problem still moving."""
    everything = len(active) == len(state.x)
    now = state.equations if everything else _at(state.equations, active)
    here = state.x[active]
    damping = state.damping[active] if rules.damped else np.zeros(len(active))
    move, solvable = step(now, damping, tangent_at(part.problem, rules.face, here) if rules.face else None)
    gain = decrement(now, move, rules.n)
    x = restored(part.problem, rules.face, here + move) if rules.face else here + move
    after = part.weights.equations(part.problem, x)
    achieved = now.cost - after.cost
    floor = 1e-13 * (1.0 + now.cost)
    rounding = floor + 2.0 * part.blur * np.sqrt(1.0 + now.cost)
    better = solvable & np.isfinite(after.cost) & ((achieved >= -rounding) if rules.damped else True)
    state.iterations[active] = iteration + 1
    small = solvable & (np.abs(gain) * (1.0 + damping) <= np.maximum(rules.tolerance**2, floor + part.blur**2))
    _keep(state, active, better, x, after)
    ratio = achieved / np.where(gain > 0.0, gain, 1.0)
    factor = np.maximum(1.0 / 3.0, 1.0 - (2.0 * np.clip(ratio, 0.0, 1.0) - 1.0) ** 3)
    factor = np.where(ratio > 0.9, 0.1, factor)
    state.damping[active] = np.where(
        better, np.maximum(damping * factor, 1e-12), damping * state.growth[active] + 1e-12
    )
    state.growth[active] = np.where(better, 2.0, 2.0 * state.growth[active])
    state.status[active[small]] = Status.OK
    state.status[active[~better & (state.damping[active] > 1e12)]] = Status.STALLED
    if not rules.damped:
        state.status[active[~better]] = Status.NUMERICAL


def _keep(state: _State, active: Array, better: Array, x: Array, after: Normal) -> None:
    if better.all() and len(active) == len(state.x):
        state.x, state.equations = x, _owned(after)
        return
    to = active[better]
    state.x[to] = x[better]
    for name in Normal.__slots__:
        getattr(state.equations, name)[to] = getattr(after, name)[better]


def _owned(equations: Normal) -> Normal:
    arrays = (getattr(equations, name) for name in Normal.__slots__)
    return Normal(*(array if array.flags.writeable else np.array(array) for array in arrays))


def _at(equations: Normal, index: Array) -> Normal:
    return Normal(*(getattr(equations, name)[index] for name in Normal.__slots__))
