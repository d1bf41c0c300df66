"""Fixes of a target that is on one of several heights, such as the floors of a building: one fix for each, compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.errors import InvalidProblem
from optloc.base.records import join
from optloc.base.types import Array, Band, Status, first_status
from optloc.problem.claims import GLOBAL, UNKNOWN, Claims
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Alternatives
from optloc.problem.problem import Problem
from optloc.solvers.certificates.branch_and_bound import claim_sentence
from optloc.solvers.policy import AMBIGUOUS_GAP, LISTED_GAP
from optloc.solvers.prepared import Prepared, prepare
from optloc.solvers.solution import solve


def on_floors(problem: Problem, floors: Sequence[float]) -> list[Problem]:
    """Return a problem for each floor: the band of its height becomes an exact height.

    Floors outside the band, which other constraints may narrow, are left out.

    Parameters
    ----------
    problem : Problem
        A problem whose target has a band of heights, or an exact height.
    floors : sequence of float
        Heights, metres.

    Raises
    ------
    InvalidProblem
        If the problem has no band of heights, or if no floor is inside it.
    """
    bands = [band for band in problem.constraints if _is_of_height(band)]
    if not bands:
        raise InvalidProblem("the problem has no height", "height", "state a height or a band of heights")
    exact = all(np.array_equal(band.lower, band.upper) for band in bands if isinstance(band, Band))
    inside = [
        height
        for height in floors
        if exact or all(np.all((b.lower <= height) & (height <= b.upper)) for b in bands if isinstance(b, Band))
    ]
    if not inside:
        listed = ", ".join(f"{height:g}" for height in floors)
        raise InvalidProblem(f"other constraints exclude the heights {listed} m", "height", "correct one of them")
    return [_at_height(problem, height) for height in inside]


def height_of(problem: Problem) -> float:
    """Return the exact height of a problem, metres; NaN without one."""
    exact = (b for b in problem.constraints if isinstance(b, Band) and _is_of_height(b) and b.lower == b.upper)
    return next((float(band.lower) for band in exact), float("nan"))


def _is_of_height(band: object) -> bool:
    """Return whether a constraint bounds the height: above the ellipsoid, or as the third coordinate."""
    if not isinstance(band, Band):
        return False
    normal = np.asarray(band.coefficients, dtype=float)
    upward = band.kind == "plane" and normal.shape == (3,) and normal[2] == 1.0 and not normal[:2].any()
    return band.kind == "height" or upward


def _at_height(problem: Problem, height: float) -> Problem:
    """Return a problem in which the target is exactly at a height, metres."""
    level = np.asarray(height, dtype=float)
    return replace(
        problem,
        constraints=tuple(
            replace(band, lower=level, upper=level) if isinstance(band, Band) and _is_of_height(band) else band
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
    return best_of_floors([solve(problem, method) for problem in problems])


@dataclass(frozen=True, slots=True)
class PreparedFloors:
    """Prepared problems that differ in the height of the target, to fix new measurements many times.

    Parameters
    ----------
    floors : tuple of Prepared
        One prepared problem for each floor.
    """

    floors: tuple[Prepared, ...]

    @property
    def problem(self) -> Problem:
        """Return the problem on the first floor."""
        return self.floors[0].problem

    def __call__(self, z: ArrayLike) -> Fix:
        """Return the best of the fixes of measurements z (..., m) on all floors."""
        return best_of_floors([floor(z) for floor in self.floors])


def prepare_on_floors(problem: Problem, floors: Sequence[float], method: str) -> Prepared | PreparedFloors:
    """Return a prepared problem for the heights `floors`, metres; for an empty sequence, the problem itself.

    `problem` and `method` are as for `optloc.prepare`.
    """
    if not floors:
        return prepare(problem, method)
    return PreparedFloors(tuple(prepare(one, method) for one in on_floors(problem, floors)))


def best_of_floors(fixes: Sequence[Fix]) -> Fix:
    """Return the best of the fixes on several floors, as `solve_on_floors`; `fixes` has one fix for each floor."""
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
