"""From what explains the data of one problem to explanations: who is left out, how large an error, what evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.base.types import Array
from optloc.problem.fix import Alternatives, Explanation, Fix, Suspect
from optloc.problem.problem import Problem
from optloc.solvers.starts.arrivals import Arrivals, restore_order
from optloc.solvers.suspects.evidence import Error, errors, influence
from optloc.solvers.suspects.groups import Group
from optloc.solvers.suspects.subsets import Finding, Rest
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
    """

    problem: Problem
    arrivals: Arrivals | None
    groups: tuple[Group, ...]
    whole: Fix

    @property
    def work(self) -> Problem:
        """Return the form in which it was looked at."""
        return self.problem if self.arrivals is None else self.arrivals.problem

    def vector(self, x: Array) -> Array:
        """Return vectors (..., size) in the order of the given problem."""
        return x if self.arrivals is None else restore_order(self.problem, self.arrivals.problem, x)

    def rows(self, group: Group) -> tuple[int, ...]:
        """Return the rows of a group as numbers of the given problem's rows."""
        if self.arrivals is None:
            return group.rows
        return tuple(sorted({int(i) for row in group.rows for i in self.arrivals.origin[row]}))


def conclude_case(case: Case, finding: Finding) -> Conclusion | None:
    """Return what a finding means for its problem; None where the fix of all the data stands."""
    if finding.rests:
        explanations = tuple(_explanation(case, rest, finding) for rest in finding.rests)
        return Conclusion(explanations, finding.rests[0].fix, _alternatives(case, finding.rests, explanations))
    # no set was tried and nothing stood out: a run whose noise is larger than stated keeps its fix
    if case.whole.answered and set(finding.p_value) == {()} and not finding.note:
        return None
    return Conclusion((), case.whole, case.whole.alternatives, _name_closest(case, finding))


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
    groups, fix = [case.groups[i] for i in rest.left], rest.fix
    p_without, suspects = float(fix.p_value), []
    found = errors(influence(case.work, fix.x), groups) if np.isfinite(fix.x).all() else [None] * len(groups)
    for i, group, error in zip(rest.left, groups, found, strict=True):
        known = finding.p_value.get(tuple(j for j in rest.left if j != i))
        p_with = _p_with(fix, error) if known is None else known
        none = np.full(1, np.nan)
        value, sigma = (none, none) if error is None else (error.value, error.sigma)
        suspects.append(Suspect(group.name, group.kind, case.rows(group), value, sigma, p_with, p_without))
    return Explanation(tuple(suspects), case.vector(fix.x), float(fix.cost), int(fix.dof), p_without)


def _p_with(fix: Fix, error: Error | None) -> float:
    """Return the chi-square probability of a rest with one of its suspects back, to first order."""
    from scipy.special import gammaincc

    if error is None:
        return float("nan")
    # the rest with the suspect back: to first order its cost rises by the statistic
    return float(gammaincc((int(fix.dof) + error.dof) / 2, (float(fix.cost) + error.statistic) / 2))


def _alternatives(case: Case, rests: Sequence[Rest], explanations: Sequence[Explanation]) -> Alternatives:
    """Return the other positions of the first explanation and those of the others, cheapest first.

    Explanations leave out as many groups, so that their costs compare as those of other minima do.
    """
    first = rests[0].fix
    x = [case.vector(first.alternatives.x), *(one.x[None] for one in explanations[1:])]
    gap = [first.alternatives.gap, *(np.array([max(one.cost - float(first.cost), 0.0)]) for one in explanations[1:])]
    points, gaps = np.concatenate(x), np.concatenate(gap)
    kept = np.isfinite(gaps) & np.isfinite(points).all(-1)
    order = np.argsort(gaps[kept], kind="stable")
    return Alternatives(points[kept][order], gaps[kept][order])
