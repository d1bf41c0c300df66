"""From what explains the data to a fix: explanations with their evidence, status and reason in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.status import Certificate, Status
from optloc.base.types import Array
from optloc.problem.fix import Alternatives, Explanation, Fix, Suspect
from optloc.problem.problem import Problem
from optloc.solvers.starts.arrivals import Arrivals, original
from optloc.solvers.suspects.evidence import Error, errors, influence
from optloc.solvers.suspects.groups import Group
from optloc.solvers.suspects.subsets import Finding, Rest

_SHOWN = 4
_UNKNOWN = Certificate("unknown", "the data contradict each other", "none")


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
        return x if self.arrivals is None else original(self.problem, self.arrivals.problem, x)

    def rows(self, group: Group) -> tuple[int, ...]:
        """Return the rows of a group as numbers of the given problem's rows."""
        if self.arrivals is None:
            return group.rows
        return tuple(sorted({int(i) for row in group.rows for i in self.arrivals.origin[row]}))


def concluded(case: Case, finding: Finding) -> Fix:
    """Return the fix of one problem, without batch axes, that a finding means."""
    if not finding.rests:
        settled = case.whole.answered and set(finding.p_value) == {()} and not finding.note
        return case.whole if settled else _contradictory(case, finding)
    explanations = tuple(_explanation(case, rest, finding) for rest in finding.rests)
    first = finding.rests[0].fix
    others = _alternatives(case, finding.rests, explanations)
    weights = np.array(np.broadcast_to(case.problem.weight, (1, case.problem.count))[0])
    weights[[row for suspect in explanations[0].suspects for row in suspect.rows]] = 0.0
    several = len(explanations) > 1
    return replace(
        case.whole,
        x=explanations[0].x,
        cov=first.cov,
        code=np.array(int(Status.AMBIGUOUS) if several and first.answered else int(first.code), dtype=np.int8),
        reason=_object(_rivals(explanations) if several else _named(explanations[0], first)),
        certificate=first.certificate,
        alternatives=others,
        cost=first.cost,
        dof=first.dof,
        weights=weights,
        active=first.active,
        local=first.local if case.arrivals is None else None,
        explanations=_object(explanations),
    )


def _contradictory(case: Case, finding: Finding) -> Fix:
    """Return the fix with nothing left out, without a covariance: the noise that it would follow from is refuted."""
    whole, tested = case.whole, {left: p for left, p in finding.p_value.items() if left and np.isfinite(p)}
    reason = finding.note
    if tested:
        best = max(tested, key=tested.__getitem__)
        names = _listed([case.groups[i].name for i in best])
        reason = f"nothing explains it; best is to leave out {names} (p = {tested[best]:.1g})"
        reason += f"; {finding.note}" if finding.note else ""
    if whole.status == Status.CONTRADICTORY and whole.reason[()]:  # what the constraints have to do with it
        reason = f"{whole.reason[()]}; {reason}"
    return replace(
        whole,
        cov=np.full_like(whole.cov, np.nan),
        code=np.array(int(Status.CONTRADICTORY), dtype=np.int8),
        reason=_object(reason),
        certificate=_object(_UNKNOWN),
        local=None if whole.local is None else np.full_like(whole.local, np.nan),
        explanations=_object(()),
    )


def _explanation(case: Case, rest: Rest, finding: Finding) -> Explanation:
    groups, fix = [case.groups[i] for i in rest.left], rest.fix
    p_without, suspects = float(fix.p_value), []
    found = errors(influence(case.work, fix.x), groups) if np.isfinite(fix.x).all() else [None] * len(groups)
    for i, group, error in zip(rest.left, groups, found, strict=True):
        known = finding.p_value.get(tuple(j for j in rest.left if j != i))
        p_with = _with(fix, error) if known is None else known
        none = np.full(1, np.nan)
        value, sigma = (none, none) if error is None else (error.value, error.sigma)
        suspects.append(Suspect(group.name, group.kind, case.rows(group), value, sigma, p_with, p_without))
    return Explanation(tuple(suspects), case.vector(fix.x), float(fix.cost), int(fix.dof), p_without)


def _with(fix: Fix, error: Error | None) -> float:
    """Return the chi-square probability of a rest with one of its suspects back, to first order."""
    from scipy.special import gammaincc

    if error is None:
        return float("nan")
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


def _named(explanation: Explanation, fix: Fix) -> str:
    parts = [f"{suspect.name}{_error(suspect)}" for suspect in explanation.suspects]
    reason = f"left out: {_listed(parts)}; p = {_p(explanation.suspects[0].p_with)} with"
    reason += "" if len(parts) == 1 else " the first"
    own = str(fix.reason[()] or "")
    return f"{reason}, {_p(explanation.p_value)} without" + (f"; {own}" if own else "")


def _rivals(explanations: Sequence[Explanation]) -> str:
    shown = [" and ".join(one.names) for one in explanations[:_SHOWN]]
    more = f" or {len(explanations) - _SHOWN} others" if len(explanations) > _SHOWN else ""
    common = set(explanations[0].names).intersection(*(one.names for one in explanations[1:]))
    sure = f"; {_listed(sorted(common))} in all of them" if common else ""
    blind = all(one.dof == 0 for one in explanations)
    why = "an error is there, but redundancy 1 does not tell where" if blind else "several explanations pass"
    return f"{why}: {' or '.join(shown)}{more}{sure}"


def _error(suspect: Suspect) -> str:
    """Return the error of a suspect of one number in words."""
    if len(suspect.error) != 1 or not np.isfinite(suspect.error[0]):
        return ""
    return f" (error {suspect.error[0]:+.3g}, sigma {suspect.sigma[0]:.2g})"


def _p(value: float) -> str:
    return "none" if np.isnan(value) else f"{value:.1g}"


def _listed(parts: Sequence[str]) -> str:
    if len(parts) > _SHOWN:
        parts = [*parts[:_SHOWN], f"{len(parts) - _SHOWN} more"]
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


def _object(value: object) -> Array:
    out = np.empty((), dtype=object)
    out[()] = value
    return out
