"""Ways one after the other: the next is taken for the problems of which the one before leaves something to prove."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np

from optloc.fix import Fix, Stage
from optloc.problem import Problem
from optloc.proof.scope import unsupported
from optloc.solve.merge import merged
from optloc.solve.stages import Solver, packed, pooled, unrefined
from optloc.solve.verdict import LISTED_GAP
from optloc.status import Status
from optloc.types import Array

# More candidates change nothing about these.
_SETTLED = (Status.REJECTED, Status.TOO_FEW_ROWS)


def first_that_proves(branches: Sequence[Sequence[Solver]]) -> Solver:
    """Return the solver that takes the first branch, and each further one for what is not proven by then.

    What the earlier branches found competes in the later ones. Problems beyond the scope of the proof take the last
    branch alone.

    Parameters
    ----------
    branches : sequence of sequences of solvers
        Each ends with a proof.
    """

    def solver(problem: Problem, fix: Fix | None) -> Fix:
        taken = branches[-1:] if unsupported(problem) else branches
        for branch in taken:
            fix = _next(problem, fix, branch)
        assert fix is not None
        return fix

    return solver


def unproven(fix: Fix) -> Array:
    """Return which fixes (N,) could still change: no proof that all minima within the listed gap are known."""
    sure = [c.proof == "global" and c.margin >= LISTED_GAP for c in fix.certificate]
    return np.asarray(~np.array(sure, dtype=bool) & ~np.isin(fix.code, _SETTLED))


def _next(problem: Problem, fix: Fix | None, branch: Sequence[Solver]) -> Fix:
    if fix is None or not fix.stages or fix.stages[-1].name != "certify":
        for stage in branch:
            fix = stage(problem, fix)
        assert fix is not None
        return fix
    items = np.flatnonzero(unproven(fix))
    if not len(items):
        return fix
    part, own = problem.take(items), fix[items]
    new = _beside(part, branch[0](part, None), own)
    for stage in branch[1:]:
        new = stage(part, new)
    joint = merged(fix, items, new, Stage("", "", 0.0))
    return replace(joint, stages=(*fix.stages, *new.stages))


def _beside(problem: Problem, start: Fix, fix: Fix) -> Fix:
    """Return starts with what an earlier branch found beside them."""
    pool = packed(np.concatenate([pooled(start)[0], pooled(fix)[0]], axis=1))
    return replace(unrefined(problem, pool, None, "", perf_counter()), stages=start.stages)
