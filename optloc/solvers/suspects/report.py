"""From what explains the data of one problem to explanations: who is left out, how large an error, what evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.adequacy.evidence import Error, errors, influence
from optloc.adequacy.groups import Group
from optloc.base import linalg
from optloc.base.types import Array
from optloc.problem.arrivals import Arrivals, restore_order, shared_places
from optloc.problem.chart import quantile
from optloc.problem.fix import Alternatives, Explanation, Fix, Suspect
from optloc.problem.layout import Layout
from optloc.problem.problem import Problem
from optloc.solvers.policy import COVERED
from optloc.solvers.suspects.subsets import Finding, Rest, fix_without, leave_out_of, prove_rest, rest_of
from optloc.solvers.verdict.conclusion import Conclusion, list_names


@dataclass(frozen=True, slots=True)
class Case:
    """A problem whose data contradict each other, and in which form it was looked at.

    Parameters
    ----------
    problem : Problem
        Flat batch of one problem, as given.
    arrivals : Arrivals, optional
        The same problem with arrival times for range differences.
    groups : tuple of Group
        What may be wrong.
    whole : Fix
        The fix with nothing left out, without batch axes.
    refuted : str
        Why the noise cannot be as stated, or "".
    """

    problem: Problem
    arrivals: Arrivals | None
    groups: tuple[Group, ...]
    whole: Fix
    refuted: str

    @property
    def work(self) -> Problem:
        """Return the form in which it was looked at."""
        return self.problem if self.arrivals is None else self.arrivals.problem

    def vector(self, fix: Fix, x: Array | None = None) -> Array:
        """Return a fix, or vectors (..., size) in its order, in the order of the given problem."""
        x, layout = fix.x if x is None else x, self.problem.layout
        return x if fix.layout == layout else restore_order(layout, fix.layout, x)

    def rows(self, group: Group) -> tuple[int, ...]:
        """Return the rows of a group as numbers of the given problem's rows."""
        if self.arrivals is None:
            return group.rows
        return tuple(sorted({int(i) for row in group.rows for i in self.arrivals.origin[row]}))


def conclude_case(case: Case, finding: Finding) -> Conclusion | None:
    """Return what a finding means for its problem; None where the fix of all the data stands."""
    if not finding.rests:
        # no set was tried and nothing stood out: a run whose noise is larger than stated keeps its fix
        if case.whole.answered and set(finding.p_value) == {()} and not finding.note:
            return None
        return Conclusion((), case.whole, case.whole.alternatives, tried=_name_closest(case, finding))
    best, *others = finding.rests
    elsewhere = [rest for rest in others if not _same_place(best.fix, rest.fix)]
    if not best.left and not elsewhere:
        return None
    work = case.work if best.left else case.problem
    if case.refuted:  # it was found by other noise than is stated
        best = rest_of(case.groups, best.left, fix_without(work, case.groups, best.left, best.fix.x))
    best = prove_rest(work, case.groups, best)
    explanations = tuple(_explanation(case, rest, finding) for rest in (best, *others))
    spent, fix = int(case.whole.dof) - int(best.fix.dof), _in_layout(case, best.fix)
    return Conclusion(explanations, fix, _alternatives(case, best, elsewhere), spent, bool(elsewhere), case.refuted)


def _same_place(best: Fix, other: Fix) -> bool:
    """Return whether two fixes give the same answer: the other one's place is inside the ellipsoid of the best."""
    # of unknowns besides, such as an offset that only one of them has, nobody asked
    theirs = {slot.name for slot in other.layout.shared}
    common = [slot for slot in best.layout.shared if slot.name in theirs]
    common = [slot for slot in common if slot.name.partition("[")[0] == "position"] or common
    if not common:
        return False
    alike = Layout(tuple(common), (), 0)
    where, there = shared_places(alike, best.layout), shared_places(alike, other.layout)
    step, covariance = other.x[there] - best.x[where], best.cov[np.ix_(where, where)]
    if not (np.isfinite(step).all() and np.isfinite(covariance).all()):
        return False
    inverse, regular = linalg.inverse(covariance)
    return bool(regular) and float(step @ inverse @ step) <= quantile(COVERED, len(step))


def _in_layout(case: Case, fix: Fix) -> Fix:
    """Return a fix with the shared unknowns of the given problem alone."""
    layout = case.problem.layout
    if fix.layout == layout:
        return fix
    places = shared_places(layout, fix.layout)
    others = Alternatives(case.vector(fix, fix.alternatives.x), fix.alternatives.gap)
    # the states of epochs may stand in another order
    return replace(
        fix, x=case.vector(fix), cov=fix.cov[np.ix_(places, places)], layout=layout, local=None, alternatives=others
    )


def _name_closest(case: Case, finding: Finding) -> str:
    """Return what came closest to an explanation, in words."""
    tested = {left: p for left, p in finding.p_value.items() if left and np.isfinite(p)}
    if not tested:
        return finding.note
    best = max(tested, key=tested.__getitem__)
    names = list_names([case.groups[i].name for i in best])
    reason = f"nothing explains it; best is to leave out {names} (p = {tested[best]:.1g})"
    return reason + (f"; {finding.note}" if finding.note else "")


def _explanation(case: Case, rest: Rest, finding: Finding) -> Explanation:
    fix = rest.fix
    p_without = float(fix.p_value)
    told = _errors(case, rest)
    suspects = []
    for i in rest.left:
        group, error = case.groups[i], told.get(i)
        known = finding.p_value.get(tuple(j for j in rest.left if j != i))
        p_with = _p_with(fix, error) if known is None else known
        none = np.full(1, np.nan)
        value, sigma = (none, none) if error is None else (error.value, error.sigma)
        suspects.append(Suspect(group.name, group.kind, case.rows(group), value, sigma, p_with, p_without))
    return Explanation(tuple(suspects), case.vector(fix), float(fix.cost), int(fix.dof), p_without, rest.score)


def _errors(case: Case, rest: Rest) -> dict[int, Error]:
    """Return the estimated errors of what was left out, by number of the group; none without a fix."""
    fix = rest.fix
    if not np.isfinite(fix.x).all() or not rest.left:
        return {}
    offsets = [i for i in rest.left if case.groups[i].offset is not None]
    others = [i for i in rest.left if case.groups[i].offset is None]
    out = {}
    for i in offsets:
        name = case.groups[i].name
        value, sigma = fix.take(name), fix.sigma(name)
        statistic = float((value / sigma) @ (value / sigma)) if np.isfinite(sigma).all() else np.nan
        out[i] = Error(value, sigma, statistic, len(value))
    if others:
        groups = [case.groups[i] for i in others]
        work = leave_out_of(case.work, case.groups, offsets)
        out |= dict(zip(others, errors(influence(work, fix.x), groups), strict=True))
    return out


def _p_with(fix: Fix, error: Error | None) -> float:
    """Return the chi-square probability of a rest with one of its suspects back, to first order."""
    from scipy.special import gammaincc

    if error is None:
        return float("nan")
    # the rest with the suspect back: to first order its cost rises by the statistic
    return float(gammaincc((int(fix.dof) + error.dof) / 2, (float(fix.cost) + error.statistic) / 2))


def _alternatives(case: Case, best: Rest, elsewhere: Sequence[Rest]) -> Alternatives:
    """Return the other positions of the best explanation and those of the others, by score, cheapest first."""
    first = best.fix
    x = [case.vector(first, first.alternatives.x), *(case.vector(rest.fix)[None] for rest in elsewhere)]
    gap = [first.alternatives.gap, *(np.array([max(rest.score - best.score, 0.0)]) for rest in elsewhere)]
    points, gaps = np.concatenate(x), np.concatenate(gap)
    kept = np.isfinite(gaps) & np.isfinite(points).all(-1)
    order = np.argsort(gaps[kept], kind="stable")
    return Alternatives(points[kept][order], gaps[kept][order])
