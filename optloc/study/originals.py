"""What the papers do between a guess and an answer, for any problem: baselines that never look for another minimum."""

from __future__ import annotations

import numpy as np

from optloc.epochs import tied
from optloc.equations import equations_at
from optloc.normal import step
from optloc.problem import Problem
from optloc.types import Array
from optloc.windows import window

_FIRST = 40


def single_step(problem: Problem, start: Array) -> Array:
    """Return where one Gauss-Newton step from a guess leads.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    start : array (N, size)
        Parameter vectors.

    Returns
    -------
    array (N, size)
        NaN where the normal equations are singular.
    """
    with np.errstate(all="ignore"):
        return _moved(problem, start)


def recursion(problem: Problem, start: Array, *, iterations: int = 2) -> Array:
    """Return where the registration paper's recursion leads: undamped steps over all data so far, epoch by epoch.

    It begins with the first forty epochs and never takes a step back.

    Parameters
    ----------
    problem : Problem
        Flat batch of N runs without unknowns of single epochs.
    start : array (N, size)
        Parameter vectors.
    iterations : int
        Steps at each epoch.

    Returns
    -------
    array (N, size)
        NaN where the steps ran away, and for problems that have unknowns of single epochs.
    """
    if problem.layout.n_local or tied(problem):
        return np.full_like(start, np.nan)
    x = start
    with np.errstate(all="ignore"):
        for last in range(min(_FIRST, problem.epochs), problem.epochs + 1):
            so_far = window(problem, 0, last) if last < problem.epochs else problem
            for _ in range(iterations):
                x = _moved(so_far, x)
    return x


def _moved(problem: Problem, x: Array) -> Array:
    move, ok = step(equations_at(problem, x), np.zeros(len(x)))
    return x + np.where(ok[:, None], move, np.nan)
