"""Many groups: the worst is left out and the rest fixed anew, until none stands out; then who fits again is taken back.

Each step tests all groups at once to first order (data snooping: Baarda 1968; iterated: Kok 1984), each at 1 % over the
number of groups: the chi-square of thousands of rows does not notice a few that are wrong. It may be masked where many
agree on a wrong answer; a robust fix before it lets it start from what that one rejected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optloc.fix import Fix
from optloc.problem import Problem
from optloc.solve.stages import given, lsr
from optloc.solve.suspect_evidence import Influence, errors, influence, significance
from optloc.solve.suspect_groups import Group, mask, without
from optloc.solve.suspect_subsets import TEST, Finding, Rest, minimal
from optloc.types import Array

# Groups of more rows than this are tested again only where no smaller one stands out.
_LARGE = 16
# Rivals are looked for in the place of each suspect where there are not more, so many for each.
_MOST, _RIVALS = 8, 3


def grown(problem: Problem, groups: Sequence[Group], fix: Fix, rejected: Array, start: Rest | None = None) -> Finding:
    """Return what explains one problem, found group by group.

    Parameters
    ----------
    problem : Problem
        Flat batch of one problem.
    groups : sequence of Group
        What may be wrong.
    fix : Fix
        Of the problem, without batch axes.
    rejected : bool array (m,)
        Rows that a robust fix rejected: left out at the beginning.
    start : Rest, optional
        Where to begin else: the best that was found without a few groups.
    """
    level = float(np.log(TEST / len(groups)))
    left = [i for i, group in enumerate(groups) if len(group.rows) == 1 and rejected[group.rows[0]]]
    rest = fixed_without(problem, groups, left, fix.x) if left else fix
    if start is not None and not left:
        left, rest = list(start.left), start.fix
    while (worst := _worst(problem, groups, left, rest, level)) is not None:
        if int(rest.dof) <= len(groups[worst].rows):
            return Finding(
                (), {(): float(fix.p_value)}, f"{len(left)} of {len(groups)} left out, and still no rest agrees"
            )
        left = [*(i for i in left if not _inside(groups[i], groups[worst])), worst]
        rest = fixed_without(problem, groups, left, rest.x)
    left, rest = _taken_back(problem, groups, left, rest, level)
    if not left or not rest.answered:
        return Finding((), {(): float(fix.p_value)}, "" if rest.answered else str(rest.reason))
    found = minimal([Rest(tuple(sorted(left)), rest), *_rivals(problem, groups, left, rest, level)], groups)
    return Finding(found, {(): float(fix.p_value)})


def fixed_without(problem: Problem, groups: Sequence[Group], left: Sequence[int], x: Array) -> Fix:
    """Return the fix of one problem without some groups, refined from a vector (size,)."""
    part = _part(problem, groups, left)
    return lsr(part, given(part, x[None]))[0]


def _part(problem: Problem, groups: Sequence[Group], left: Sequence[int]) -> Problem:
    chosen = [groups[i] for i in left]
    dropped = frozenset(group.prior for group in chosen if group.prior >= 0)
    return without(problem, mask(chosen, problem.count)[None], dropped)


def _worst(problem: Problem, groups: Sequence[Group], left: Sequence[int], rest: Fix, level: float) -> int | None:
    """Return the group, not yet left out, that contradicts the rest most; None where none does clearly."""
    if not np.isfinite(rest.x).all():
        return None
    gone = mask([groups[i] for i in left], problem.count)
    open_ = [i for i, g in enumerate(groups) if i not in set(left) and (g.prior >= 0 or not gone[list(g.rows)].all())]
    at = _influence(problem, groups, left, rest.x)
    small = [i for i in open_ if len(groups[i].rows) <= _LARGE]
    first = not left
    for members in [open_] if first else [small, [i for i in open_ if len(groups[i].rows) > _LARGE]]:
        if members:
            tail = significance(at, [_present(groups[i], gone) for i in members])
            if tail.min() < level:
                return members[int(tail.argmin())]
    return None


def _influence(problem: Problem, groups: Sequence[Group], left: Sequence[int], x: Array) -> Influence:
    dropped = frozenset(groups[i].prior for i in left if groups[i].prior >= 0)
    gone = mask([groups[i] for i in left], problem.count)
    return influence(without(problem, gone[None], frozenset()), x, dropped)


def _present(group: Group, gone: Array) -> Group:
    """Return a group without rows that are left out already."""
    return group if group.prior >= 0 else replace(group, rows=tuple(i for i in group.rows if not gone[i]))


def _inside(one: Group, other: Group) -> bool:
    return one.prior < 0 and other.prior < 0 and set(one.rows) <= set(other.rows)


def _taken_back(
    problem: Problem, groups: Sequence[Group], left: list[int], rest: Fix, level: float
) -> tuple[list[int], Fix]:
    """Return what is still left out, and the rest, once every group that fits the rest is taken back."""
    while left:
        chosen = [groups[i] for i in left]
        tail = [-error.log_tail for error in errors(influence(problem, rest.x), chosen)]
        best = int(np.argmin(tail))
        if tail[best] > -level:
            break
        left = [i for i in left if i != left[best]]
        rest = fixed_without(problem, groups, left, rest.x)
    return left, rest


def _rivals(problem: Problem, groups: Sequence[Group], left: list[int], rest: Fix, level: float) -> list[Rest]:
    """Return other sets of as many groups: one of them in the place of another, if then none stands out either."""
    found: dict[tuple[int, ...], Rest] = {}
    for i in left if len(left) <= _MOST else ():
        others = [j for j in left if j != i]
        fix = fixed_without(problem, groups, others, rest.x)
        gone = mask([groups[j] for j in others], problem.count)
        open_ = [j for j, g in enumerate(groups) if j not in left and not _overlap(g, gone)]
        if not np.isfinite(fix.x).all() or not open_:
            continue
        tail = significance(_influence(problem, groups, others, fix.x), [groups[j] for j in open_])
        for j in np.argsort(tail)[:_RIVALS]:
            key = tuple(sorted([*others, open_[int(j)]]))
            if key in found or tail[j] > level:
                continue
            other = fixed_without(problem, groups, key, fix.x)
            agrees = bool(other.answered) and (
                np.isnan(rest.p_value) or other.p_value >= min(TEST, float(rest.p_value))
            )
            if agrees and _worst(problem, groups, key, other, level) is None:
                found[key] = Rest(key, other)
    return list(found.values())


def _overlap(group: Group, gone: Array) -> bool:
    return group.prior < 0 and bool(gone[list(group.rows)].any())
