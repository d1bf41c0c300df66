"""The case of a problem and its fix: the sampled epochs, their fixes, and the row numbers of the problem as given."""

from __future__ import annotations

import numpy as np

from optloc.advice.change import MisfitCase
from optloc.base.types import Array
from optloc.kernels.sums import equations_at
from optloc.linear.equalities import spare_rows
from optloc.problem.epochs import by_epoch, has_correlated_epochs, rows_by_epoch, separable, some_epochs
from optloc.problem.problem import Problem

# Largest number of separate epochs that are compared, the worst of them among them: an error of all rows or of a
# station is visible in a few epochs.
_EPOCHS, _WORST = 12, 3
# Largest numbers of rows and of unknowns of a run with shared unknowns. Its equations are dense here, and thousands of
# fits are solved together: with 60 unknowns they need some hundred megabytes.
_ROWS, _UNKNOWNS = 400, 60


def case_of(problem: Problem, x: Array) -> MisfitCase | None:
    """Return the case of a problem; None if no epoch has redundancy, or a run cannot be sampled.

    Parameters
    ----------
    problem : Problem
        Flat batch of one problem or run, without values that are not finite.
    x : array (1, size)
        Its fix; NaN for unknowns without a fix.
    """
    origin = problem.origin if np.isfinite(problem.times).all() else 0.0
    if not separable(problem):
        part, start = _shortened(problem, x)
        if part.layout.size > _UNKNOWNS:
            return None
        dof = np.atleast_1d(spare_rows(part))
        if dof[0] < 1:
            return None
        number = np.flatnonzero(np.isin(problem.epoch, _kept_epochs(problem, part)))[None]
        return MisfitCase(part, np.zeros(1), number, start, dof, origin)
    base = by_epoch(problem).flat()
    number = np.full((problem.epochs, base.count), -1)
    number[problem.epoch, rows_by_epoch(problem)] = np.arange(problem.count)
    starts, dof = _by_epoch(problem, base, x), np.broadcast_to(spare_rows(base), problem.epochs)
    chosen = _sample(base, starts, dof)
    if not len(chosen):
        return None
    return MisfitCase(base.take(chosen), problem.times[chosen], number[chosen], starts[chosen], dof[chosen], origin)


def _by_epoch(problem: Problem, base: Problem, x: Array) -> Array:
    """Return the fixes (K, size) of the epochs of a run from its vector (1, size)."""
    local = x[:, problem.layout.n_shared :].reshape(problem.epochs, -1)
    out, start = np.full((problem.epochs, base.layout.size), np.nan), 0
    for slot in problem.layout.local:
        there, _ = base.layout.find(slot.name)
        first = there.start
        out[:, first : first + slot.size] = local[:, start : start + slot.size]
        start += slot.size
    return out


def _sample(base: Problem, x: Array, dof: Array) -> Array:
    """Return the numbers of at most `_EPOCHS` epochs with redundancy: evenly spread, or with a large cost."""
    able = np.flatnonzero(dof > 0)
    if len(able) <= _EPOCHS:
        return able
    cost = equations_at(base, np.nan_to_num(x)).cost - dof
    worst = able[np.argsort(-np.where(np.isfinite(cost[able]), cost[able], np.inf), kind="stable")[:_WORST]]
    even = able[np.linspace(0, len(able) - 1, _EPOCHS - _WORST).round().astype(int)]
    return np.unique(np.concatenate([worst, even]))


def _kept_epochs(problem: Problem, part: Problem) -> Array:
    """Return the numbers of the epochs of a problem that its shortened run has."""
    if part.epochs == problem.epochs:
        return np.arange(problem.epochs)
    return np.flatnonzero(np.isin(problem.times, part.times))


def _shortened(problem: Problem, x: Array) -> tuple[Problem, Array]:
    """Return a run within the limits of rows and unknowns, in epochs spread evenly over the run, and its vector.

    A run whose epochs are correlated stays whole.
    """
    n, length = problem.layout.n_shared, problem.layout.n_local
    most = min(problem.epochs * _ROWS / problem.count, (_UNKNOWNS - n) / max(length, 1))
    if most >= problem.epochs or problem.epochs == 1 or has_correlated_epochs(problem):
        return problem, x
    kept = max(2, int(most))
    chosen = np.unique(np.linspace(0, problem.epochs - 1, kept).round().astype(int))
    # epochs without rows determine nothing
    chosen = chosen[np.isin(chosen, problem.epoch)]
    local = x[:, n:].reshape(len(x), problem.epochs, length)[:, chosen]
    return some_epochs(problem, chosen), np.concatenate([x[:, :n], local.reshape(len(x), -1)], axis=1)
