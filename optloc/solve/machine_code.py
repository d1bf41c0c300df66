"""Refinements by machine code: which problems it serves, and with which weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optloc.constraints import Face
from optloc.equations import serves
from optloc.kernels.pack import packed
from optloc.noise import Whitener, whiten
from optloc.normal import Normal
from optloc.problem import Problem
from optloc.threads import mapped
from optloc.types import Array
from optloc.weigh import depends_on_place, weighed, whitener_at

WEIGHINGS = 2
"""Station errors are weighed where the target is thought to be; the weights hardly change with it."""

# Systems of more unknowns are better solved one after the other than side by side.
_UNKNOWNS = 40
# Numbers of the derivatives from which weights that depend on the place are made at a time.
_WEIGHED = 2**21


@dataclass(frozen=True, slots=True)
class Refined:
    """Where the refinement ended.

    Parameters
    ----------
    x : array (N, size)
        Parameter vectors.
    cost : array (N,)
        Weighted sum of squared residuals and prior penalties.
    status : int array (N,)
        `Status` of each: ok, max iterations, stalled, singular geometry, numerical.
    iterations : int array (N,)
        Steps tried.
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


@dataclass(frozen=True, slots=True)
class Rules:
    """What does not change during an iteration: see `optloc.solve.refine.refine`.

    Parameters
    ----------
    n : int
        Number of shared unknowns.
    tolerance : float
        Length of the last step in its own standard deviations.
    limit : int
        Steps tried at most.
    damped : bool
        Whether steps are damped and refused.
    face : Face
        Constraints that hold with equality.
    """

    n: int
    tolerance: float
    limit: int
    damped: bool
    face: Face


Refinement = Callable[[Problem, Array, Rules], Refined]


def by_machine_code(
    problem: Problem, start: Array, item: Array | None, rules: Rules, otherwise: Refinement
) -> Refined | None:
    """Return where a refinement by machine code ends, or None where it does not serve the problem or does not pay.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    start : array (M, size)
        Starting vectors.
    item : int array (M,), optional
        Problem of each start; None: M = N.
    rules : Rules
        When to stop.
    otherwise : callable
        Refines what machine code gives up: an epoch of a run left its own unknowns open.
    """
    few = problem.layout.n_shared + problem.layout.n_local <= _UNKNOWNS
    if rules.face or not few or not serves(problem, len(start)):
        return None
    own = np.arange(len(start)) if item is None else np.asarray(item, dtype=np.int64)
    if not depends_on_place(problem):
        return _at_once(problem, start, own, whiten(weighed(problem).noise, problem.weight), rules, otherwise)
    width = problem.layout.n_shared + problem.stations.count * problem.dimension
    parts = np.array_split(np.arange(len(start)), 1 + len(start) * problem.count * width // _WEIGHED)
    done = mapped(lambda part: _anew(problem.take(own[part]), start[part], rules, otherwise), parts)
    found = [one for one in done if one is not None]
    return _joined(found) if len(found) == len(parts) else None


def _at_once(
    problem: Problem, start: Array, item: Array, noise: tuple[Whitener, ...], rules: Rules, otherwise: Refinement
) -> Refined | None:
    """Return where machine code ends with given weights, or None where it does not serve."""
    found = packed(problem, noise)
    if found is None:
        return None
    from optloc.kernels import spread
    from optloc.kernels.refine import Rules as Limits

    kernel = Limits(float(rules.tolerance), int(rules.limit), bool(rules.damped))
    done, lost = spread.refined(found, item, start, kernel)
    if lost.any():
        more = otherwise(problem.take(item[lost]), start[lost], rules)
        for name in ("x", "cost", "status", "iterations"):
            getattr(done, name)[lost] = getattr(more, name)
    return Refined(done.x, done.cost, done.status, done.iterations, lambda: spread.equations(found, item, done))


def _anew(problem: Problem, start: Array, rules: Rules, otherwise: Refinement) -> Refined | None:
    """Return where machine code ends for one start of each problem, weighed where they are and once more at the end."""
    done = None
    for _ in range(WEIGHINGS):
        done = _at_once(problem, start, np.arange(len(start)), whitener_at(problem, start), rules, otherwise)
        if done is None:
            return None
        start = done.x
    return done


def _joined(parts: list[Refined]) -> Refined:
    """Return several refinements as one."""

    def make() -> Normal:
        made = [part.equations for part in parts]
        return Normal(*(np.concatenate([getattr(one, name) for one in made]) for name in Normal.__slots__))

    x, cost, status, iterations = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "cost", "status", "iterations")
    )
    return Refined(x, cost, status, iterations, make)
