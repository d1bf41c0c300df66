"""Fixes of a target that is on one of several heights, such as the floors of a building: one fix for each, compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.records import join
from optloc.base.types import Array, Band, Status, first_status
from optloc.problem.claims import GLOBAL, UNKNOWN, Claims
from optloc.problem.fix import Alternatives, Fix
from optloc.problem.problem import Problem
from optloc.solvers.certificates.branch_and_bound import claim_sentence
from optloc.solvers.policy import AMBIGUOUS_GAP, LISTED_GAP
from optloc.solvers.solution import solve


def at_height(problem: Problem, height: float) -> Problem:
    """Return a problem with its exact height replaced, metres; raise InvalidProblem if it has no exact height."""

    def replaced(band: object) -> bool:
        """Return whether a constraint is the exact height."""
        return isinstance(band, Band) and band.name == "height" and np.array_equal(band.lower, band.upper)

    if not any(map(replaced, problem.constraints)):
        raise InvalidProblem("the problem has no exact height", "height", "state one height, then several")
    level = np.asarray(height, dtype=float)
    return replace(
        problem,
        constraints=tuple(
            replace(band, lower=level, upper=level) if isinstance(band, Band) and replaced(band) else band
            for band in problem.constraints
        ),
    )


def solve_on_floors(problems: Sequence[Problem], method: str = "auto") -> Fix:
    """Return the best of the fixes of several problems, which differ in the height of the target only.

    A fix on another floor is an alternative if its cost is at most `LISTED_GAP` above the best. The status is
    `ambiguous` if it is at most `AMBIGUOUS_GAP` above. The fix is proven if the fixes of all floors are proven.

    Parameters
    ----------
    problems : sequence of Problem
        One problem, or one batch of equal shape, for each floor.
    method : str
        Method as in `optloc.solve`.
    """
    fixes = [solve(problem, method) for problem in problems]
    shape, flat = fixes[0].shape, [fix.flat() for fix in fixes]
    count, floors = len(flat[0]), len(flat)
    every = join(iter(flat), count * floors)
    cost = np.stack([np.where(fix.answered & np.isfinite(fix.cost), fix.cost, np.inf) for fix in flat])
    best = cost.argmin(axis=0)
    items = np.arange(count)
    chosen = every[best * count + items]
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(cost), cost - cost.min(axis=0), np.inf)
    gap[best, items] = np.inf
    chosen = replace(chosen, alternatives=_with_floors(chosen.alternatives, flat, gap))
    return _judged(chosen, flat, gap).reshape(shape)


def _with_floors(own: Alternatives, fixes: Sequence[Fix], gap: Array) -> Alternatives:
    """Return alternatives with the fixes of other floors, `gap` (f, N) above the best, sorted by cost."""
    rivals = np.where(gap <= LISTED_GAP, gap, np.inf).T
    x = np.concatenate([own.x, np.stack([fix.x for fix in fixes], axis=1)], axis=1)
    gaps = np.concatenate([own.gap, rivals], axis=1)
    order = np.argsort(gaps, axis=1, kind="stable")[:, : max(1, int(np.isfinite(gaps).sum(1).max()))]
    gaps, x = np.take_along_axis(gaps, order, 1), np.take_along_axis(x, order[..., None], 1)
    return Alternatives(np.where(np.isfinite(gaps)[..., None], x, np.nan), gaps)


def _judged(chosen: Fix, fixes: Sequence[Fix], gap: Array) -> Fix:
    """Return the fixes with the findings that the other floors add: `ambiguous`, and `unproven`."""
    nearest = gap.min(axis=0)
    rival = chosen.answered & (nearest <= AMBIGUOUS_GAP)
    # a floor whose fix is not proven, or has no answer, may have a better position
    open_floor = np.stack([fix.claims.proof != GLOBAL for fix in fixes]).any(axis=0)
    margin = np.stack([fix.claims.margin for fix in fixes]) + np.where(np.isfinite(gap), gap, 0.0)
    claims = chosen.claims
    least = np.where(open_floor, 0.0, np.minimum(claims.margin, margin.min(axis=0)))
    weaker = open_floor & (claims.proof == GLOBAL)
    # The sentence of a proof names its margin and the number of the alternatives.
    listed = np.isfinite(chosen.alternatives.gap).sum(axis=1)
    sentence = claims.reason.astype(object)
    for i in np.flatnonzero((claims.proof == GLOBAL) & claims.unique & ~weaker):
        sentence[i] = claim_sentence(float(least[i]), int(listed[i]), None)
    sentence[weaker] = "the fix on another floor is not proven"
    changed = Claims(
        np.where(weaker, UNKNOWN, claims.proof),
        sentence,
        claims.method, claims.bound, claims.gap, claims.unique & ~open_floor, least, claims.boxes, claims.region,
        claims.asked,
    )  # fmt: skip
    marks = np.zeros(len(chosen), dtype=np.int32) if chosen.marks is None else chosen.marks.copy()
    marks |= np.where(rival, Status.AMBIGUOUS.mark, 0).astype(marks.dtype)
    marks |= np.where(weaker & chosen.answered, Status.UNPROVEN.mark, 0).astype(marks.dtype)
    code = np.where(rival | (weaker & chosen.answered), first_status(marks), chosen.code)
    reason = chosen.reason.astype(object)
    reason[rival & (code == Status.AMBIGUOUS)] = "another of the stated heights fits about as well"
    reason[weaker & (code == Status.UNPROVEN)] = "the fix on another of the stated heights is not proven"
    return replace(chosen, code=code.astype(chosen.code.dtype), marks=marks, reason=reason, claims=changed)
