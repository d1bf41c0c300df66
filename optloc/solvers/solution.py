"""`solve`: from a problem to a fix, without a first guess."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.problem.determined import Source
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers.methods import Method, shortcut
from optloc.solvers.pool import PART, begin, in_parts, noting_place
from optloc.solvers.single import at_once
from optloc.solvers.verdict.judge import failed_fixes, hide_open_epochs, verdict


def solve(problem: Problem, method: str = "auto", *, start: ArrayLike | None = None, refine: bool = True) -> Fix:
    """Return the fix of every problem of a batch, without a first guess.

    Parameters
    ----------
    problem : Problem
        Batch axes (...). If its epochs share no unknown, the epochs become one more batch axis, (..., k).
    method : str
        "auto", or stages joined by "+", for instance "gtrs+lsr"; see ``optloc list solvers``. After a method that only
        starts, such as "sdp" or "minimax", the stages "lsr+certify" run.
    start : array (..., size), optional
        Starting vector. A method that begins with a refinement, such as "lsr", has no other start. Every other method
        treats it as one more candidate.
    refine : bool
        False: a method that only starts returns its estimate without refinement, with the status `unrefined`. Use this
        to compare starts.

    Returns
    -------
    Fix
        With the batch axes of the problem. A failure is a status, never an exception. If a stage fails numerically for
        one problem of a batch, its status is `numerical` and its reason is the cause; the other problems are fixed.

    Raises
    ------
    InvalidProblem
        For an unknown method, or if nothing is unknown.
    """
    run = Method.parse(method)
    fix = at_once(problem, run) if start is None else None
    fix = solve_in_stages(problem, run, start, refine=refine) if fix is None else fix
    return with_sources(problem, fix)


def solve_in_stages(problem: Problem, run: Method, start: Any = None, *, refine: bool = True) -> Fix:
    """Return the fixes of `solve` by the stages of the method `run`; `start` and `refine` are as in `solve`."""
    if problem.layout.size == 0:
        raise InvalidProblem("nothing is unknown: the motion of every target is known", "motions", "give a bias")
    if separable(problem):
        problem = by_epoch(problem)
    shape, flat = problem.batch_shape, problem.flat()
    vector = None if start is None else _broadcast_start(problem, start).reshape(-1, problem.layout.size)

    def work(some: Problem, part: slice) -> Fix:
        pool = run(some, None if vector is None else begin(some, vector[part]))
        if refine and pool.curvature is None:
            pool = _FINISH(some, pool)
        with noting_place("the verdict"):
            return hide_open_epochs(verdict(some, pool))

    # the shortcut divides the batch for its threads
    most = flat.batch_shape[0] if shortcut(run) and vector is None else PART
    with np.errstate(all="ignore"):  # an overflow gets a status, so a warning would repeat it
        fix = in_parts(flat, work, most, failed_fixes)
    return fix.reshape(shape) if shape != (len(fix),) else fix


# Stages that refine and judge the starts of a method that only starts.
_FINISH = Method(("lsr", "certify"))


def _broadcast_start(problem: Problem, start: Any) -> Array:
    """Return the vector `start` for every problem, (..., size); raise InvalidProblem if it has a wrong shape."""
    vector, wanted = np.asarray(start, dtype=float), (*problem.batch_shape, problem.layout.size)
    try:
        return np.broadcast_to(vector, wanted)
    except ValueError:
        raise InvalidProblem(
            f"start has shape {vector.shape}, not {wanted}", "start", "give numbers in the order of problem.layout"
        ) from None


# Most fixes of a batch that keep their problems for later advice: a user reads no more fixes one by one.
_KEPT = 8


def with_sources(problem: Problem, fix: Fix) -> Fix:
    """Return the fixes with their problems for pictures and later advice.

    A single fix stores its problem. In a batch, fixes that are not `ok` do, if there are at most `_KEPT`.
    """
    if not fix.shape and not problem.batch_shape:  # a copy of the problem would take as long as the fix
        source_of_one = np.empty((), dtype=object)
        source_of_one[()] = Source(problem)
        return replace(fix, source=source_of_one)
    items = np.flatnonzero(fix.code.ravel() != Status.OK)
    if not 0 < len(items) <= _KEPT:
        return fix
    flat = (problem if problem.batch_shape == fix.shape else by_epoch(problem)).flat()
    source = np.empty(fix.code.size, dtype=object)
    for i in items:
        source[i] = Source(flat.take(np.array([i])))
    return replace(fix, source=source.reshape(fix.shape))
