"""Every set of a few groups is left out and the rest is fixed anew, without a guess: nothing masks anything."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from time import perf_counter

import numpy as np

from optloc.base.records import take
from optloc.base.types import Array
from optloc.problem.fix import Fix, Stage
from optloc.problem.problem import Problem
from optloc.solvers.certify.branch_and_bound import certified
from optloc.solvers.outside import accept
from optloc.solvers.pool import Pool, begin, in_parts, offer, pack
from optloc.solvers.stages import fix_by, gtrs, lsr, roots, search, widen
from optloc.solvers.suspects.evidence import Influence, errors, influence, significance
from optloc.solvers.suspects.groups import Group, leave_out, mark_rows
from optloc.solvers.verdict.judge import judge, standing, verdict

TEST = 0.01
"""Probability of the chi-square test: a fit less likely than this is contradicted. Clean data are accused as often."""

LAST = TEST**2
"""What is left to be named where nothing passes the test: the right rest fails it once in a hundred, too."""

# Rows times subsets of one problem up to which all subsets of a size are tried: seconds of fixes; and numbers of a
# batch at a time, some ten megabytes an array.
_MOST, _CHUNK = 100_000, 1_000_000
# Rests whose cost is at most so many times that of the test are solved in more ways, and in all of them. The cheapest
# start may end at another minimum, and a wrong rest that costs a hundred times too much hardly has one that passes.
_NEAR, _CLOSE = 100.0, 4.0


@dataclass(frozen=True, slots=True)
class Rest:
    """The fix to what is left without some groups.

    Parameters
    ----------
    left : tuple of int
        Numbers of the groups that were left out, ascending.
    fix : Fix
        Of one problem, without batch axes.
    """

    left: tuple[int, ...]
    fix: Fix


@dataclass(frozen=True, slots=True)
class Finding:
    """What explains the data of one problem.

    Parameters
    ----------
    rests : tuple of Rest
        What passes the test without the least number of groups, the most plausible first; empty where nothing does.
    p_value : dict of tuple of int to float
        Chi-square probability of the rest without each set of groups that was tried; NaN without redundancy.
    note : str
        What limited the search, in words.
    nearly : tuple of Rest
        Where nothing passes, what would pass a far weaker test: the right rest fails in 1 % of all cases, too.
    closest : Rest, optional
        The cheapest of the rests that were tried last.
    """

    rests: tuple[Rest, ...]
    p_value: dict[tuple[int, ...], float]
    note: str = ""
    nearly: tuple[Rest, ...] = ()
    closest: Rest | None = None


def plausible(fix: Fix, size: int, test: float = TEST) -> Array:
    """Return which rests (N,) do not contradict themselves.

    A rest counts as evidence where at least as many rows agree in it as groups were left out: to name q errors takes a
    redundancy of 2 q, as to correct them does in a code. A rest without redundancy cannot contradict itself; it counts
    where one group is missing, because an error in it would be noticed but not named. Rests that fit at infinity only
    count too; those with a position come first.
    """
    with np.errstate(invalid="ignore"):
        tested = np.isfinite(fix.cost) & (fix.p_value >= test) & (fix.dof >= size)
    return np.asarray(tested | ((fix.dof == 0) & (size == 1)))


def enumerable(groups: Sequence[Group], rows: int, size: int) -> bool:
    """Return whether all sets of so many groups are few enough to be tried."""
    return comb(len(groups), size) * rows <= _MOST


def explain(problem: Problem, groups: Sequence[Group], whole: Fix) -> list[Finding]:
    """Return what explains each problem of a flat batch: all the smallest sets of groups without which the rest passes.

    Sets of one, of two and so on, as many as the redundancy can name and as are few enough to be tried.

    Parameters
    ----------
    problem : Problem
        N problems in which the same rows are present.
    groups : sequence of Group
        What may be wrong.
    whole : Fix
        The fixes (N,) with nothing left out.
    """
    found = [Finding((), {(): float(p)}) for p in whole.p_value]
    open_ = np.arange(len(found))
    # to name q errors takes a redundancy of 2 q, as to correct them does in a code
    for size in range(1, max(1, int(whole.dof.max()) // 2) + 1):
        if not len(open_) or not enumerable(groups, problem.count, size):
            break
        # as many problems at a time as fit the memory with all their sets
        step = max(1, _CHUNK // (comb(len(groups), size) * problem.count + 1))
        for first in range(0, len(open_), step):
            items = open_[first : first + step]
            for item, (rests, p_value, closest) in zip(
                items, _try_sets(problem.take(items), groups, size), strict=True
            ):
                placed = [rest for rest in rests if rest.fix.answered or int(rest.fix.dof) == 0]
                passing = [rest for rest in placed if plausible(rest.fix, size)]
                # of the smallest size that has any
                nearly = found[item].nearly or minimal(rests, groups)
                found[item] = Finding(minimal(passing, groups), found[item].p_value | p_value, "", nearly, closest)
        open_ = np.array([item for item in open_ if not found[item].rests], dtype=np.int64)
    return found


def minimal(rests: Sequence[Rest], groups: Sequence[Group]) -> tuple[Rest, ...]:
    """Return those rests that do not leave out more than another, the most plausible first."""
    left = [frozenset(part for i in rest.left for part in _parts(groups[i])) for rest in rests]
    kept = [
        rest
        for j, (rest, own) in enumerate(zip(rests, left, strict=True))
        if not any(other < own or (other == own and i < j) for i, other in enumerate(left))
    ]
    return tuple(sorted(kept, key=_implausibility))


def _parts(group: Group) -> tuple[tuple[str, int], ...]:
    return (("prior", group.prior),) if group.prior >= 0 else tuple(("row", i) for i in group.rows)


def _implausibility(rest: Rest) -> tuple[bool, float, float]:
    p = float(rest.fix.p_value)
    return not bool(rest.fix.answered), -1.0 if np.isnan(p) else -p, float(rest.fix.cost)


def _try_sets(
    problem: Problem, groups: Sequence[Group], size: int
) -> list[tuple[list[Rest], dict[tuple[int, ...], float], Rest | None]]:
    """Return the rests of each problem that may pass, the probabilities of all, and the cheapest of all."""
    sets = list(_subsets(groups, problem.count, size))
    count = problem.batch_shape[0]
    rests: list[list[Rest]] = [[] for _ in range(count)]
    probabilities: list[dict[tuple[int, ...], float]] = [{} for _ in range(count)]
    closest: list[Rest | None] = [None] * count
    # priors are the same for a whole batch: sets that leave out the same ones are fixed together
    for dropped in dict.fromkeys(priors for _, _, priors in sets):
        own = [(left, rows) for left, rows, priors in sets if priors == dropped]
        fix = _fix_rests(problem, np.stack([rows for _, rows in own]), dropped)
        good, p_value = plausible(fix, size, LAST), fix.p_value
        cost = np.where(np.isfinite(fix.cost), fix.cost, np.inf).reshape(count, len(own))
        for item in range(count):
            for j, (left, _) in enumerate(own, start=item * len(own)):
                probabilities[item][left] = float(p_value[j])
                if good[j]:
                    rests[item].append(Rest(left, fix[j]))
            j, before = int(cost[item].argmin()), closest[item]
            if np.isfinite(cost[item, j]) and (before is None or cost[item, j] < float(before.fix.cost)):
                closest[item] = Rest(own[j][0], fix[item * len(own) + j])
    return list(zip(rests, probabilities, closest, strict=True))


def _subsets(groups: Sequence[Group], count: int, size: int) -> Iterator[tuple[tuple[int, ...], Array, frozenset[int]]]:
    """Yield sets of groups, their rows and their priors; each of a set must add something to the others."""
    masks = [mark_rows([group], count) for group in groups]
    for left in combinations(range(len(groups)), size):
        rows = np.any([masks[i] for i in left], axis=0)
        idle = any(
            groups[i].prior < 0 and not (masks[i] & ~np.any([masks[j] for j in left if j != i], axis=0)).any()
            for i in left
            if size > 1
        )
        if not idle:
            yield left, rows, frozenset(groups[i].prior for i in left if groups[i].prior >= 0)


def _fix_rests(problem: Problem, left: Array, dropped: frozenset[int]) -> Fix:
    """Return the fixes (N * C,) of N problems without each of C sets of rows (C, m), set after set of each problem."""
    count = problem.batch_shape[0]
    # item-major: the C sets of a problem lie together
    many = problem.take(np.repeat(np.arange(count), len(left)))
    return in_parts(leave_out(many, np.tile(left, (count, 1)), dropped), lambda part, _: fix_rest(part))


def fix_rest(problem: Problem) -> Fix:
    """Return the fixes of a flat batch by the cheapest start, and in more ways where that one may have missed.

    A rest that fails by less than `_NEAR` gets every stationary point of the squared-range problem as a start, and one
    that passes, or fails by little, all candidates: its other positions explain the data as well.
    """
    pool = lsr(problem, gtrs(problem, None))
    pool = _redo(problem, pool, _NEAR, lambda part, own: lsr(part, _beside(part, roots(part, None), own)))
    pool = _redo(problem, pool, _CLOSE, lambda part, own: lsr(part, widen(part, own)))
    if not np.isfinite(pool.cost[:, 0]).any() and (pool.dof >= 0).any():
        pool = search(problem, pool)  # no closed form starts from these kinds
    return judge(problem, pool)


def _redo(problem: Problem, pool: Pool, near: float, better: Callable[[Problem, Pool], Pool]) -> Pool:
    """Return pools of which those whose cost is not that many times too large were made anew."""
    cost = np.where(np.isfinite(pool.cost[:, 0]), pool.cost[:, 0], np.nan)
    with np.errstate(invalid="ignore"):
        # not: NaN, where there is no fix yet, is tried again as well
        items = np.flatnonzero(~(cost > near * _limit(pool.dof)) & (pool.dof >= 0))
    if not len(items):
        return pool
    other = better(problem.take(items), take(pool, items))
    return pool.merge(items, other, Stage("again", f"{len(items)} anew", 0.0))


def _beside(problem: Problem, start: Pool, pool: Pool) -> Pool:
    x = np.concatenate([start.x, standing(pool, judge(problem, pool))], axis=1)
    return offer(problem, pack(x), None, "roots", perf_counter())


def _limit(dof: Array) -> Array:
    """Return the cost (N,) at which the test fails."""
    from scipy.special import gammainccinv

    return np.asarray(2.0 * gammainccinv(np.maximum(dof, 1) / 2, TEST))


# Many groups: the worst is left out and the rest fixed anew, until none stands out; then who fits again is taken back.
#
# Each step tests all groups at once to first order (data snooping: Baarda 1968; iterated: Kok 1984), each at 1 % over
# the number of groups: the chi-square of thousands of rows does not notice a few that are wrong. It may be masked
# where many agree on a wrong answer; a robust fix before it lets it start from what that one rejected.

# Groups of more rows than this are tested again only where no smaller one stands out: their test is an eigenvalue
# problem of their size, and a station that is wrong stood out in the first round, in which all are tested.
_LARGE = 16
# Rivals are looked for in the place of each suspect where there are not more, the three that stand out most for each:
# every one is a fix, and a list of many more explains nothing.
_MOST_LEFT_OUT, _RIVALS = 8, 3


def grow(problem: Problem, groups: Sequence[Group], fix: Fix, rejected: Array, start: Rest | None = None) -> Finding:
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
    # Bonferroni: clean data are accused once in a hundred, whatever the number of groups
    level = float(np.log(TEST / len(groups)))
    left = [i for i, group in enumerate(groups) if len(group.rows) == 1 and rejected[group.rows[0]]]
    rest = fix_without(problem, groups, left, fix.x) if left else fix
    if start is not None and not left:
        left, rest = list(start.left), start.fix
    while (worst := _worst(problem, groups, left, rest, level)) is not None:
        # nothing would be left to agree
        if int(rest.dof) <= len(groups[worst].rows):
            return Finding(
                (), {(): float(fix.p_value)}, f"{len(left)} of {len(groups)} left out, and still no rest agrees"
            )
        # a station takes the place of its rows that were left out before
        left = [*(i for i in left if not _inside(groups[i], groups[worst])), worst]
        rest = fix_without(problem, groups, left, rest.x)
    left, rest = _take_back(problem, groups, left, rest, level)
    if not left or not rest.answered:
        return Finding((), {(): float(fix.p_value)}, "" if rest.answered else str(rest.reason))
    found = minimal([Rest(tuple(sorted(left)), rest), *_rivals(problem, groups, left, rest, level)], groups)
    return Finding(found, {(): float(fix.p_value)})


def fix_without(problem: Problem, groups: Sequence[Group], left: Sequence[int], x: Array) -> Fix:
    """Return the fix of one problem without some groups, refined from a vector (size,)."""
    part = _leave_out(problem, groups, left)
    return fix_by(part, lambda one: begin(one, x[None]))[0]


def prove_rest(problem: Problem, groups: Sequence[Group], rest: Rest) -> Rest:
    """Return what one problem is without some groups, after all that an `ok` promises has been looked at."""
    part = _leave_out(problem, groups, rest.left)
    if not bool(rest.fix.answered):
        return rest
    return Rest(rest.left, verdict(part, certified(part, accept(part, rest.fix.flat())))[0])


def _leave_out(problem: Problem, groups: Sequence[Group], left: Sequence[int]) -> Problem:
    chosen = [groups[i] for i in left]
    dropped = frozenset(group.prior for group in chosen if group.prior >= 0)
    return leave_out(problem, mark_rows(chosen, problem.count)[None], dropped)


def _worst(problem: Problem, groups: Sequence[Group], left: Sequence[int], rest: Fix, level: float) -> int | None:
    """Return the group, not yet left out, that contradicts the rest most; None where none does clearly."""
    if not np.isfinite(rest.x).all():
        return None
    gone = mark_rows([groups[i] for i in left], problem.count)
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
    gone = mark_rows([groups[i] for i in left], problem.count)
    return influence(leave_out(problem, gone[None], frozenset()), x, dropped)


def _present(group: Group, gone: Array) -> Group:
    """Return a group without rows that are left out already."""
    return group if group.prior >= 0 else replace(group, rows=tuple(i for i in group.rows if not gone[i]))


def _inside(one: Group, other: Group) -> bool:
    return one.prior < 0 and other.prior < 0 and set(one.rows) <= set(other.rows)


def _take_back(
    problem: Problem, groups: Sequence[Group], left: list[int], rest: Fix, level: float
) -> tuple[list[int], Fix]:
    """Return what is still left out, and the rest, once every group that fits the rest is taken back."""
    while left:
        chosen = [groups[i] for i in left]
        # all errors jointly, to first order: the one that is most likely none is taken back if it does not stand out
        tail = [-error.log_tail for error in errors(influence(problem, rest.x), chosen)]
        best = int(np.argmin(tail))
        if tail[best] > -level:
            break
        left = [i for i in left if i != left[best]]
        rest = fix_without(problem, groups, left, rest.x)
    return left, rest


def _rivals(problem: Problem, groups: Sequence[Group], left: list[int], rest: Fix, level: float) -> list[Rest]:
    """Return other sets of as many groups: one of them in the place of another, if then none stands out either."""
    found: dict[tuple[int, ...], Rest] = {}
    for i in left if len(left) <= _MOST_LEFT_OUT else ():
        others = [j for j in left if j != i]
        fix = fix_without(problem, groups, others, rest.x)
        gone = mark_rows([groups[j] for j in others], problem.count)
        open_ = [j for j, g in enumerate(groups) if j not in left and not _overlap(g, gone)]
        if not np.isfinite(fix.x).all() or not open_:
            continue
        tail = significance(_influence(problem, groups, others, fix.x), [groups[j] for j in open_])
        for j in np.argsort(tail)[:_RIVALS]:
            key = tuple(sorted([*others, open_[int(j)]]))
            if key in found or tail[j] > level:
                continue
            other = fix_without(problem, groups, key, fix.x)
            # no less likely than the test wants, or than the first explanation is
            agrees = bool(other.answered) and (
                np.isnan(rest.p_value) or other.p_value >= min(TEST, float(rest.p_value))
            )
            if agrees and _worst(problem, groups, key, other, level) is None:
                found[key] = Rest(key, other)
    return list(found.values())


def _overlap(group: Group, gone: Array) -> bool:
    return group.prior < 0 and bool(gone[list(group.rows)].any())
