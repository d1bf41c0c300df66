"""Search for suspects over sets of groups: leave each set out and fix the remaining rows again, without a first guess.

If the sets are few, all of them are tried, so that one error cannot mask another. If they are many, `grow_explanation`
leaves out one group at a time. A *group* is a row, the rows of a station, a prior or a common offset. A *rest* is the
problem without a set of groups. `alike` are problems with the same rows, and `whole` are the fixes of all data.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from optloc.base.records import join, take
from optloc.base.types import Array
from optloc.kernels.jit import enabled
from optloc.model_checks.evidence import Influence, drops, embed, errors, influence, significance
from optloc.model_checks.groups import ROW_PRICE, Group, leave_out, mark_rows
from optloc.problem.claims import GLOBAL
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Stage
from optloc.problem.problem import Problem
from optloc.proof.scope import is_run, is_scaled
from optloc.solvers.certificates.admitted import certified
from optloc.solvers.outside import accept
from optloc.solvers.policy import AMBIGUOUS_GAP, LISTED_GAP, P_MISFIT, P_OUTLIER
from optloc.solvers.pool import Pool, begin, offer, pack
from optloc.solvers.stages import add_candidates, fix_by, gtrs, lsr, roots, search
from optloc.solvers.verdict.judge import judge, surviving_candidates, verdict

# Rows times sets of one problem up to which all sets of a size are tried: this takes seconds. Rows of all sets that are
# fixed together, at 2.5 kB per row: 40 MB, and larger parts are not faster.
_MOST, _CHUNK = 100_000, 2**14
# Rows times sets above which a first-order test selects the sets to try: below, the test takes longer than it saves.
_FEW = 2_000
# Factors of the limit of the chi-square test. Rests with a cost up to the first are solved from more starts, rests with
# a cost up to the second from all starts. The cheapest start may end at another minimum, and a rest that costs a
# hundred times too much almost never has a minimum that passes.
_NEAR, _CLOSE = 100.0, 4.0
# Share of the boxes of a proof that a rest may use: a few hundred boxes. Good rests need tens of boxes, and more boxes
# take longer than other starts.
_SHORT = 0.01
_BLIND = "a measurement is wrong, but redundancy 1 cannot identify it"


# Numbers of the groups of a set, flags (m,) of the rows that it leaves out, numbers of its groups without rows.
_Set = tuple[tuple[int, ...], Array, frozenset[int]]


@dataclass(frozen=True, slots=True)
class RemainingFix:
    """The fix of one problem without some groups.

    Parameters
    ----------
    left : tuple of int
        Numbers of the groups left out, ascending; () for the fix of all data.
    fix : Fix
        Of one problem, without batch axes.
    score : float
        Cost of the fix plus the prices of the groups left out: twice a negative logarithm of probability, up to a
        constant.
    """

    left: tuple[int, ...]
    fix: Fix
    score: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of the search for one problem.

    Parameters
    ----------
    rests : tuple of RemainingFix
        Rests whose score is within the gap of the least, the best first; empty if no rest passes.
    p_value : dict of tuple of int to float
        Chi-square probability of the rest without each set that was tried; NaN without redundancy.
    note : str
        Sentence on the limit of the search.
    closest : RemainingFix, optional
        The cheapest of the rests that were tried last.
    tried : int
        Size of the largest sets that are covered: they were tried, or their prices or lack of redundancy exclude them.
    least : float
        Least score of all sets tried, whether they pass or not.
    dof : int
        Redundancy of the rest with the least score.
    """

    rests: tuple[RemainingFix, ...]
    p_value: dict[tuple[int, ...], float]
    note: str = ""
    closest: RemainingFix | None = None
    tried: int = 0
    least: float = np.inf
    dof: int = 0


def remaining_fix_of(groups: Sequence[Group], left: tuple[int, ...], fix: Fix) -> RemainingFix:
    """Return the rest of one problem without the groups `left`, with its score."""
    return RemainingFix(left, fix, float(fix.cost) + sum(groups[i].price for i in left))


def passes_noise_test(fix: Fix) -> Array:
    """Return flags (N,) of rests with redundancy that pass the chi-square test.

    Rests without redundancy are not tested, so they do not pass. Rests with their minimum at infinity count too.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(fix.cost) & (fix.dof > 0) & (fix.p_value >= P_MISFIT))


def enumerable(groups: Sequence[Group], rows: int, size: int) -> bool:
    """Return whether all sets of `size` groups are few enough to be tried, for problems of `rows` rows."""
    return comb(len(groups), size) * rows <= _MOST


@dataclass(frozen=True, slots=True)
class SameRows:
    """Problems of a flat batch in which the same rows are present.

    Parameters
    ----------
    batch : Problem
        The batch.
    items : int array (N,)
        Numbers of the problems in the batch.
    groups : tuple of Group
        Groups that may be wrong.
    whole : Fix
        Their fixes (N,) of all data.
    """

    batch: Problem
    items: Array
    groups: tuple[Group, ...]
    whole: Fix


@dataclass(frozen=True, slots=True)
class _Request:
    """Sets of groups to leave out of problems `items` of a `SameRows`, and their least scores `best` so far."""

    alike: SameRows
    items: Array
    sets: Sequence[_Set]
    best: Array


def explain(alike: Sequence[SameRows]) -> list[list[Outcome]]:
    """Return the explanations of each problem: all sets of groups within the gap of the best.

    Sets of one group, of two groups and so on are tried under three conditions. Their prices alone do not exceed the
    best score by more than the gap. The rest has redundancy. The sets are few enough. Rests of all problems of a batch
    are fixed together.
    """
    searches = dict(enumerate(_search(one) for one in alike))
    out: list[list[Outcome]] = [[] for _ in alike]
    tried: dict[int, list[list[_Tried]]] = {}
    while searches:
        asked: dict[int, list[_Request]] = {}
        for number, running in list(searches.items()):
            try:
                asked[number] = running.send(tried[number]) if number in tried else next(running)
            except StopIteration as done:
                out[number] = done.value
                del searches[number]
        tried = _try_requests(asked)
    return out


def _search(alike: SameRows) -> Generator[list[_Request], list[list[_Tried]], list[Outcome]]:
    """Yield requests for the sets to try, size by size; receive their results, and return the outcomes (N,)."""
    groups, whole, count = alike.groups, alike.whole, alike.batch.count
    prices = np.cumsum(np.sort([group.price for group in groups]))  # least price of a set of each size
    rests = [[remaining_fix_of(groups, (), whole[i])] if ok else [] for i, ok in enumerate(passes_noise_test(whole))]
    probability: list[dict[tuple[int, ...], float]] = [{(): float(p)} for p in whole.p_value]
    closest: list[RemainingFix | None] = [None] * len(rests)
    least = [(float(c), int(r)) for c, r in zip(whole.cost, whole.dof, strict=True)]
    tried = np.zeros(len(rests), dtype=np.int64)
    for size in range(1, len(groups) + 1):
        best = np.array([min((rest.score for rest in rests_of), default=np.inf) for rests_of in rests])
        # no set of this size or larger can come within the gap
        done = (prices[size - 1] > best + AMBIGUOUS_GAP) | (whole.dof <= size)
        tried[done] = len(groups)  # no larger set can be an explanation
        if done.all() or not enumerable(groups, count, size):
            break
        tried[~done] = size
        items, sets = np.flatnonzero(~done), list(_subsets(groups, count, size))
        requests = []
        if len(sets) * count > _FEW:
            # If all data agree, few of many sets matter, and the cost of their rests is known to first order.
            agree = [i for i in items if rests[i] and not rests[i][0].left]
            for i in agree:
                rests_of = _promising(alike.batch.take(alike.items[[i]]), groups, sets, whole[i], best[i])
                requests += [_Request(alike, np.array([i]), rests_of, best[[i]])] if rests_of else []
            items = np.setdiff1d(items, agree)
        requests += [_Request(alike, items, sets, best[items])] if len(items) else []
        answers = (yield requests) if requests else []
        for request, found in zip(requests, answers, strict=True):
            for item, one in zip(request.items.tolist(), found, strict=True):
                rests[item] += one.rests
                probability[item] |= one.p_value
                closest[item], least[item] = one.closest, min(least[item], one.least)
    notes = ["" if dof > 1 else _BLIND for dof in whole.dof]
    parts = zip(rests, probability, notes, closest, tried, least, strict=True)
    return [
        Outcome(within_gap(rests_of, groups), p, note, near, int(most), *low)
        for rests_of, p, note, near, most, low in parts
    ]


def within_gap(rests: Sequence[RemainingFix], groups: Sequence[Group]) -> tuple[RemainingFix, ...]:
    """Return the rests whose score is within the gap of the least, the best first.

    A rest that leaves out more rows than another is listed only if its cost is lower by more than chance explains. The
    limit for each further row is the price of a row minus the gap, as between one row and none.
    """
    if not rests:
        return ()
    order = sorted(rests, key=lambda rest: (rest.score, rest.left))
    kept: list[tuple[frozenset[tuple[int, int]], RemainingFix]] = []
    for rest in order:
        if rest.score > order[0].score + AMBIGUOUS_GAP:
            break
        numbers = _parts(groups, rest.left)
        if not any(_adds_nothing(rest, len(numbers), other, len(parts)) for parts, other in kept if parts <= numbers):
            kept.append((numbers, rest))
    return tuple(rest for _, rest in kept)


def _adds_nothing(rest: RemainingFix, size: int, other: RemainingFix, fewer: int) -> bool:
    """Return whether the `size` rows of a rest lower the cost no more than chance, beyond the `fewer` of `other`."""
    if size == fewer:  # the same rows under other names: their costs differ by rounding
        return True
    return float(other.fix.cost - rest.fix.cost) <= (ROW_PRICE - AMBIGUOUS_GAP) * (size - fewer)


def _parts(groups: Sequence[Group], left: Sequence[int]) -> frozenset[tuple[int, int]]:
    """Return the parts that a set of groups leaves out: pairs (-1, row), or (group without rows, component)."""
    rows = {(-1, row) for i in left for row in groups[i].rows}
    return frozenset(rows | {(i, j) for i in left if not groups[i].rows for j in range(groups[i].size)})


@dataclass(slots=True)
class _Tried:
    """Results of the sets of one size for one problem; the fields are as in `Outcome`."""

    rests: list[RemainingFix]
    p_value: dict[tuple[int, ...], float]
    closest: RemainingFix | None = None
    least: tuple[float, int] = (np.inf, 0)  # least score of all sets, and the redundancy of the rest with this score
    best: float = np.inf  # least score of the rests that passed so far
    cheapest: float = np.inf  # cost of `closest`


def _promising(problem: Problem, groups: Sequence[Group], sets: Sequence[_Set], whole: Fix, best: float) -> list[_Set]:
    """Return the sets whose rest may come within the gap of the least score `best`, to first order.

    The first-order fall of the cost must be half of the need. Sets with an offset or a prior, and all sets of a fix at
    infinity, are kept.
    """
    if not np.isfinite(whole.x).all():
        return list(sets)
    # the fix may lack the emission times of arrivals; the rows are linear in them
    at = influence(problem, embed(whole.layout, problem.layout, whole.x))
    plain = [one for one in sets if not one[2]]
    drop, _ = drops(at, [np.flatnonzero(rows) for _, rows, _ in plain])
    prices = np.array([sum(groups[i].price for i in left) for left, _, _ in plain])
    wanted = float(whole.cost) + prices - best - AMBIGUOUS_GAP
    # sets with a prior or an offset have no first-order estimate here, so all of them are tried
    return [one for one in sets if one[2]] + [plain[i] for i in np.flatnonzero(2.0 * drop >= wanted)]


def _try_requests(asked: dict[int, list[_Request]]) -> dict[int, list[list[_Tried]]]:
    """Return the results of the sets: for each search and request a list of records, one for each item."""
    out = {number: [[_Tried([], {}) for _ in one.items] for one in requests] for number, requests in asked.items()}
    pairs: dict[Any, list[_Pair]] = {}
    # Problems of a batch have the same priors and unknowns, so sets that change the same ones are fixed together.
    for number, requests in asked.items():
        for request, found in zip(requests, out[number], strict=True):
            groups = request.alike.groups
            names = [tuple((groups[i].name, groups[i].prior) for i in sorted(others)) for _, _, others in request.sets]
            for item, best, tried in zip(request.items.tolist(), request.best.tolist(), found, strict=True):
                tried.best = best
                for name, one in zip(names, request.sets, strict=True):
                    key = (id(request.alike.batch), name)
                    pairs.setdefault(key, []).append(_Pair(request.alike, item, one, tried))
    for pairs_of_key in pairs.values():
        # parts that fit the memory
        step = max(1, _CHUNK // (pairs_of_key[0].alike.batch.count + 1))
        for first in range(0, len(pairs_of_key), step):
            _try_pairs(pairs_of_key[first : first + step])
    return out


class _Pair(NamedTuple):
    """One problem of an `SameRows`, a set to leave out of it, and the record that receives the result."""

    alike: SameRows
    item: int
    left: _Set
    tried: _Tried


def _try_pairs(pairs: Sequence[_Pair]) -> None:
    """Fix the rests of all pairs together, and add the results to the record of each pair."""
    alike, others = pairs[0].alike, sorted(pairs[0].left[2])
    items = np.array([pair.alike.items[pair.item] for pair in pairs])
    rows, changed = np.stack([pair.left[1] for pair in pairs]), [alike.groups[i] for i in others]
    fix = fix_remaining(leave_out(alike.batch.take(items), rows, changed))
    cost = np.where(np.isfinite(fix.cost), fix.cost, np.inf)
    price = np.array([sum(pair.alike.groups[i].price for i in pair.left[0]) for pair in pairs])
    may_start = all(
        group.offset is None for group in changed
    )  # a search that starts from the closest rest has no offset
    good, kept, cheapest_of = passes_noise_test(fix), list[int](), dict[int, int]()
    for j, (pair, p, c, score) in enumerate(
        zip(pairs, fix.p_value.tolist(), cost.tolist(), (cost + price).tolist(), strict=True)
    ):
        tried = pair.tried
        tried.p_value[pair.left[0]] = p
        tried.least = min(tried.least, (score, int(fix.dof[j])))
        if good[j] and score <= tried.best + AMBIGUOUS_GAP:  # other rests are never listed
            tried.best = min(tried.best, score)
            kept.append(j)
        if may_start and c < tried.cheapest:
            tried.cheapest, cheapest_of[id(tried)] = c, j
    chosen = sorted({*kept, *cheapest_of.values()})
    # copies: a view of one fix would keep all fixes in memory
    chosen_fixes = fix[np.array(chosen, dtype=int)]
    rests = {
        j: remaining_fix_of(pairs[j].alike.groups, pairs[j].left[0], chosen_fixes[k]) for k, j in enumerate(chosen)
    }
    for j in kept:
        pairs[j].tried.rests.append(rests[j])
    for j in cheapest_of.values():
        pairs[j].tried.closest = rests[j]


def _subsets(groups: Sequence[Group], count: int, size: int) -> Iterator[_Set]:
    """Yield all sets of `size` groups: their numbers, flags of their rows (count,), and their groups without rows.

    A set is skipped if one of its groups adds no row to the others.
    """
    masks = [mark_rows([group], count) for group in groups]
    for left in combinations(range(len(groups)), size):
        rows = np.any([masks[i] for i in left], axis=0)
        adds_no_row = any(
            groups[i].rows and not (masks[i] & ~np.any([masks[j] for j in left if j != i], axis=0)).any()
            for i in left
            if size > 1
        )
        if not adds_no_row:
            yield left, rows, frozenset(i for i in left if not groups[i].rows)


def fix_remaining(problem: Problem) -> Fix:
    """Return the fixes of a flat batch from the cheapest start, and from more starts if it may miss a minimum.

    A rest whose cost is less than `_NEAR` times the limit of the test also starts from every stationary point of the
    squared-range problem. A rest that passes, or has less than `_CLOSE` times the limit, starts from all candidates,
    because its other minima explain the data too.
    """
    pool = lsr(problem, gtrs(problem, None))
    # a proof of a good rest takes a fraction of the time of other starts
    unproven = ~_is_proven(problem, pool)
    pool = _solve_again(
        problem, pool, unproven, _NEAR, lambda part, own: lsr(part, _with_starts(part, roots(part, None), own))
    )
    pool = _solve_again(problem, pool, unproven, _CLOSE, lambda part, own: lsr(part, add_candidates(part, own)))
    if not np.isfinite(pool.cost[:, 0]).any() and (pool.dof >= 0).any():
        pool = search(problem, pool)  # no closed form starts from these kinds
    return judge(problem, pool)


def _is_proven(problem: Problem, pool: Pool) -> Array:
    """Return flags (N,) of rests for which a short proof shows that all minima within the listed gap are known."""
    if not enabled() or problem.constraints or problem.fences or is_run(problem) or is_scaled(problem):
        return np.zeros(len(pool), dtype=bool)
    claims = certified(problem, pool, effort=_SHORT).proven
    assert claims is not None
    return np.asarray(claims.unique & (claims.proof == GLOBAL) & (claims.margin >= LISTED_GAP))


def _solve_again(
    problem: Problem, pool: Pool, unproven: Array, near: float, better: Callable[[Problem, Pool], Pool]
) -> Pool:
    """Return pools in which `better` solves unproven items again if their cost is at most `near` times the limit.

    The limit is the cost at which the chi-square test fails. Items without a fix are solved again too.
    """
    cost = np.where(np.isfinite(pool.cost[:, 0]), pool.cost[:, 0], np.nan)
    with np.errstate(invalid="ignore"):
        # written with "not", so that NaN (no fix yet) is tried again too
        items = np.flatnonzero(unproven & ~(cost > near * _cost_limit(pool.dof)) & (pool.dof >= 0))
    if not len(items):
        return pool
    other = better(problem.take(items), take(pool, items))
    return pool.merge(items, other, Stage("again", f"{len(items)} from more starts", 0.0))


def _with_starts(problem: Problem, start: Pool, pool: Pool) -> Pool:
    """Return a pool of starts together with the candidates of an earlier pool."""
    x = np.concatenate([start.x, surviving_candidates(pool, judge(problem, pool))], axis=1)
    return offer(problem, pack(x), None, "roots", perf_counter())


def _cost_limit(dof: Array) -> Array:
    """Return the cost (N,) at which the chi-square test fails, for N numbers of degrees of freedom."""
    from scipy.special import gammainccinv

    return np.asarray(2.0 * gammainccinv(np.maximum(dof, 1) / 2, P_MISFIT))


# Search for many groups: leave out the worst group and fix the rest, until no group stands out. Then take back each
# group that fits again.
#
# Each step tests all groups to first order (data snooping: Baarda 1968; iterated: Kok 1984), each at 1 % over the
# number of groups: the chi-square test of thousands of rows does not notice a few wrong rows. Many rows that agree on a
# wrong answer can mask the errors. After a robust fix, the search starts from the rows that the robust fix rejected.

# Groups of more rows are tested again only if no smaller group stands out. Their test is an eigenvalue problem of their
# size, and a wrong station stands out in the first round, which tests all groups.
_LARGE = 16
# Rivals are tried for each suspect if there are at most this many suspects: the three groups that stand out most. Each
# rival takes a fix, and a longer list of rivals explains nothing.
_MOST_LEFT_OUT, _RIVALS = 8, 3


def grow_explanation(problem: Problem, groups: Sequence[Group], fix: Fix, start: RemainingFix) -> Outcome:
    """Return the explanations of one problem from a search group by group.

    Parameters
    ----------
    problem : Problem
        Flat batch of one problem.
    groups : sequence of Group
        Groups that may be wrong.
    fix : Fix
        Fix of all data, without batch axes.
    start : RemainingFix
        Start of the search.
    """
    # Bonferroni: a false alarm in one of a hundred clean problems, for any number of groups
    level = float(np.log(P_OUTLIER / len(groups)))
    left, rest = list(start.left), start.fix
    while (worst := _most_contradictory(problem, groups, left, rest, level)) is not None:
        # no redundancy would remain for a test
        if int(rest.dof) <= len(groups[worst].rows):
            return Outcome(
                (),
                {(): float(fix.p_value)},
                f"with {len(left)} of {len(groups)} left out, the remaining data still disagree",
            )
        # a station replaces its single rows that were left out before
        left = [*(i for i in left if not _inside(groups[i], groups[worst])), worst]
        rest = fix_without(problem, groups, left, rest.x)
    left, rest = _take_back(problem, groups, left, rest, level)
    if not left or not rest.answered:
        return Outcome((), {(): float(fix.p_value)}, "" if rest.answered else str(rest.reason))
    found = [remaining_fix_of(groups, tuple(sorted(left)), rest), *_rivals(problem, groups, left, rest, level)]
    if passes_noise_test(fix):
        found.append(remaining_fix_of(groups, (), fix))
    return Outcome(within_gap(found, groups), {(): float(fix.p_value)})


def explain_from_beginnings(outcomes: Sequence[Outcome], groups: Sequence[Group]) -> Outcome:
    """Return the joined outcome of several searches of one problem; without an explanation the first outcome."""
    rests = {rest.left: rest for outcome in outcomes for rest in outcome.rests}
    return replace(outcomes[0], rests=within_gap([*rests.values()], groups)) if rests else outcomes[0]


def begin_without(problem: Problem, groups: Sequence[Group], rows: Array, x: Array) -> RemainingFix:
    """Return the rest of one problem without the flagged rows (m,), refined from a vector x (size,)."""
    left = tuple(i for i, group in enumerate(groups) if len(group.rows) == 1 and rows[group.rows[0]])
    return remaining_fix_of(groups, left, fix_without(problem, groups, left, x))


def fix_without(problem: Problem, groups: Sequence[Group], left: Sequence[int], x: Array) -> Fix:
    """Return the fix of one problem without the groups `left`, refined from a vector x (size,)."""
    part = leave_out_of(problem, groups, left)
    return fix_by(part, lambda one: begin(one, x[None]))[0]


def prove_remaining(problem: Problem, groups: Sequence[Group], rests: Sequence[RemainingFix]) -> list[RemainingFix]:
    """Return the rests of N problems, one each, after the proofs and tests of `ok`, where they have an answer."""
    out, alike = list(rests), dict[tuple[int, ...], list[int]]()
    for i, rest in enumerate(rests):
        if bool(rest.fix.answered):
            alike.setdefault(tuple(j for j in rest.left if not groups[j].rows), []).append(i)
    # problems with the same offsets have the same unknowns, so they are proven together
    for others, items in alike.items():
        rows = np.stack([mark_rows([groups[j] for j in rests[i].left], problem.count) for i in items])
        part = leave_out(problem.take(np.array(items)), rows, [groups[j] for j in others])
        fixes = join([rests[i].fix.flat() for i in items], len(items))
        proven = verdict(part, certified(part, accept(part, fixes)))
        for place, i in enumerate(items):
            out[i] = remaining_fix_of(groups, rests[i].left, proven[place])
    return out


def leave_out_of(problem: Problem, groups: Sequence[Group], left: Sequence[int]) -> Problem:
    """Return problems without the rows and priors of the groups `left`, and with their offsets as unknowns."""
    chosen = [groups[i] for i in left]
    rows = np.broadcast_to(mark_rows(chosen, problem.count), (*problem.batch_shape, problem.count))
    return leave_out(problem, rows, [one for one in chosen if not one.rows])


def _most_contradictory(
    problem: Problem, groups: Sequence[Group], left: Sequence[int], rest: Fix, level: float
) -> int | None:
    """Return the number of the group that contradicts the rest most; None if no probability is below the limit.

    `left` are the groups left out already, and `level` is the natural logarithm of the probability of the limit.
    """
    if not np.isfinite(rest.x).all():
        return None
    left_out = mark_rows([groups[i] for i in left], problem.count)
    open_ = [
        i for i, g in enumerate(groups) if i not in set(left) and (g.prior >= 0 or not left_out[list(g.rows)].all())
    ]
    at = _influence(problem, groups, left, rest.x)
    small = [i for i in open_ if len(groups[i].rows) <= _LARGE]
    first = not left  # the first round tests groups of any size together
    for members in [open_] if first else [small, [i for i in open_ if len(groups[i].rows) > _LARGE]]:
        if members:
            tail = significance(at, [_present(groups[i], left_out) for i in members])  # logarithms of p-values
            if tail.min() < level:
                return members[int(tail.argmin())]
    return None


def _influence(problem: Problem, groups: Sequence[Group], left: Sequence[int], x: Array) -> Influence:
    """Return the influence of each row on the fix x (size,) of one problem without the groups `left`."""
    dropped = frozenset(groups[i].prior for i in left if groups[i].prior >= 0)
    left_out = mark_rows([groups[i] for i in left], problem.count)
    return influence(leave_out(problem, left_out[None]), x, dropped)


def _present(group: Group, left_out: Array) -> Group:
    """Return a group without the rows that are left out already; `left_out` (m,) flags these rows."""
    return group if group.prior >= 0 else replace(group, rows=tuple(i for i in group.rows if not left_out[i]))


def _inside(one: Group, other: Group) -> bool:
    """Return whether the rows of one group are all in another group."""
    return one.prior < 0 and other.prior < 0 and set(one.rows) <= set(other.rows)


def _take_back(
    problem: Problem, groups: Sequence[Group], left: list[int], rest: Fix, level: float
) -> tuple[list[int], Fix]:
    """Return the groups left out and the fix of the rest; groups with log p above `level` are taken back."""
    while left and np.isfinite(rest.x).all():
        chosen = [groups[i] for i in left]
        # all errors are estimated jointly, to first order; the least significant one is taken back
        tail = [-error.log_tail for error in errors(influence(problem, rest.x), chosen)]
        best = int(np.argmin(tail))
        if tail[best] > -level:
            break
        left = [i for i in left if i != left[best]]
        rest = fix_without(problem, groups, left, rest.x)
    return left, rest


def _rivals(problem: Problem, groups: Sequence[Group], left: list[int], rest: Fix, level: float) -> list[RemainingFix]:
    """Return other sets of equal size: one group replaces another of `left`, and no further group then stands out.

    `level` is the natural logarithm of the probability at which a group stands out.
    """
    found: dict[tuple[int, ...], RemainingFix] = {}
    for i in left if len(left) <= _MOST_LEFT_OUT else ():
        others = [j for j in left if j != i]
        fix = fix_without(problem, groups, others, rest.x)
        left_out = mark_rows([groups[j] for j in others], problem.count)
        open_ = [j for j, g in enumerate(groups) if j not in left and g.offset is None and not _overlap(g, left_out)]
        if not np.isfinite(fix.x).all() or not open_:
            continue
        tail = significance(_influence(problem, groups, others, fix.x), [groups[j] for j in open_])
        for j in np.argsort(tail)[:_RIVALS]:
            key = tuple(sorted([*others, open_[int(j)]]))
            if key in found or tail[j] > level:
                continue
            other = fix_without(problem, groups, key, fix.x)
            if bool(other.answered) and _most_contradictory(problem, groups, key, other, level) is None:
                found[key] = remaining_fix_of(groups, key, other)
    return list(found.values())


def _overlap(group: Group, left_out: Array) -> bool:
    """Return whether a group has a row that is left out already."""
    return group.prior < 0 and bool(left_out[list(group.rows)].any())
