"""Every set of a few groups is left out and the rest is fixed anew, without a guess: nothing masks anything."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb
from time import perf_counter

import numpy as np

from optloc.fix import Fix, Stage
from optloc.problem import Problem
from optloc.solve.merge import merged
from optloc.solve.parts import in_parts
from optloc.solve.stages import gtrs, lsr, packed, pooled, roots, search, unrefined, widen
from optloc.solve.suspect_groups import Group, mask, without
from optloc.types import Array

TEST = 0.01
"""Probability of the chi-square test: a fit less likely than this is contradicted."""

LAST = TEST**2
"""What is left to be named where nothing passes the test."""

# Rows times subsets of one problem up to which all subsets of a size are tried, and numbers of a batch at a time.
_MOST, _CHUNK = 100_000, 1_000_000
# Rests whose cost is at most so many times that of the test are solved in more ways, and in all of them.
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


def explained(problem: Problem, groups: Sequence[Group], whole: Fix) -> list[Finding]:
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
    for size in range(1, max(1, int(whole.dof.max()) // 2) + 1):
        if not len(open_) or not enumerable(groups, problem.count, size):
            break
        step = max(1, _CHUNK // (comb(len(groups), size) * problem.count + 1))
        for first in range(0, len(open_), step):
            items = open_[first : first + step]
            for item, (rests, p_value, closest) in zip(items, _tried(problem.take(items), groups, size), strict=True):
                placed = [rest for rest in rests if rest.fix.answered or int(rest.fix.dof) == 0]
                passing = [rest for rest in placed if plausible(rest.fix, size)]
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


def _tried(
    problem: Problem, groups: Sequence[Group], size: int
) -> list[tuple[list[Rest], dict[tuple[int, ...], float], Rest | None]]:
    """Return the rests of each problem that may pass, the probabilities of all, and the cheapest of all."""
    sets = list(_subsets(groups, problem.count, size))
    count = problem.batch_shape[0]
    rests: list[list[Rest]] = [[] for _ in range(count)]
    probabilities: list[dict[tuple[int, ...], float]] = [{} for _ in range(count)]
    closest: list[Rest | None] = [None] * count
    for dropped in dict.fromkeys(priors for _, _, priors in sets):
        own = [(left, rows) for left, rows, priors in sets if priors == dropped]
        fix = _fixed(problem, np.stack([rows for _, rows in own]), dropped)
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
    masks = [mask([group], count) for group in groups]
    for left in combinations(range(len(groups)), size):
        rows = np.any([masks[i] for i in left], axis=0)
        idle = any(
            groups[i].prior < 0 and not (masks[i] & ~np.any([masks[j] for j in left if j != i], axis=0)).any()
            for i in left
            if size > 1
        )
        if not idle:
            yield left, rows, frozenset(groups[i].prior for i in left if groups[i].prior >= 0)


def _fixed(problem: Problem, left: Array, dropped: frozenset[int]) -> Fix:
    """Return the fixes (N * C,) of N problems without each of C sets of rows (C, m), set after set of each problem."""
    count = problem.batch_shape[0]
    many = problem.take(np.repeat(np.arange(count), len(left)))
    return in_parts(without(many, np.tile(left, (count, 1)), dropped), lambda part, _: solved(part))


def solved(problem: Problem) -> Fix:
    """Return the fixes of a flat batch by the cheapest start, and in more ways where that one may have missed.

    A rest that fails by less than `_NEAR` gets every stationary point of the squared-range problem as a start, and one
    that passes, or fails by little, all candidates: its other positions explain the data as well.
    """
    fix = lsr(problem, gtrs(problem, None))
    fix = _again(problem, fix, _NEAR, lambda part, own: lsr(part, _beside(part, roots(part, None), own)))
    fix = _again(problem, fix, _CLOSE, lambda part, own: lsr(part, widen(part, own)))
    if np.isnan(fix.cost).all() and (fix.dof >= 0).any():
        fix = search(problem, fix)  # no closed form starts from these kinds
    return fix


def _again(problem: Problem, fix: Fix, near: float, better: Callable[[Problem, Fix], Fix]) -> Fix:
    """Return fixes of which those whose cost is not that many times too large were made anew."""
    with np.errstate(invalid="ignore"):
        items = np.flatnonzero(~(fix.cost > near * _limit(fix.dof)) & (fix.dof >= 0))
    if not len(items):
        return fix
    return merged(fix, items, better(problem.take(items), fix[items]), Stage("again", f"{len(items)} anew", 0.0))


def _beside(problem: Problem, start: Fix, fix: Fix) -> Fix:
    pool = packed(np.concatenate([pooled(start)[0], pooled(fix)[0]], axis=1))
    return unrefined(problem, pool, None, "roots", perf_counter())


def _limit(dof: Array) -> Array:
    """Return the cost (N,) at which the test fails."""
    from scipy.special import gammainccinv

    return np.asarray(2.0 * gammainccinv(np.maximum(dof, 1) / 2, TEST))
