"""The stage "suspects": it names the measurements, stations and priors that contradict the other data.

A *group* is a row, the rows of a station, a prior or a common offset. A *rest* is the problem without some groups. An
*explanation* is a set of groups whose rest passes the chi-square test. Letters: N problems, m rows, `size` numbers of a
parameter vector. A *score* is a chi-square cost plus the prices of the groups left out. `alike` are problems with the
same rows, `case` is one problem, `outcome` its search result, and `found` are explanations as of `_with_conclusions`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.linear.vectors import complete
from optloc.model_checks.elements import batch_of
from optloc.model_checks.evidence import Error, errors, influences
from optloc.model_checks.groups import KINDS, ROW_PRICE, Group, check_kinds, groups_of
from optloc.model_checks.noise_level import SEVERAL, common_level_at
from optloc.problem.arrival_times import Arrivals, as_arrivals, restore_order, shared_places
from optloc.problem.chart import quantile
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.explanations import Explanation, GroupKind, Suspect
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Alternatives, Stage
from optloc.problem.layout import Layout
from optloc.problem.loss import LOSSES
from optloc.problem.problem import Problem
from optloc.solvers.certificates.admitted import certified
from optloc.solvers.outside import accept
from optloc.solvers.policy import AMBIGUOUS_GAP, REGION_LEVEL
from optloc.solvers.pool import Pool, begin, chunk_size, in_parts, offer
from optloc.solvers.robust.stage import doubted_minima
from optloc.solvers.stages import fix_by, lsr, search_widely
from optloc.solvers.suspect_rows.subsets import (
    Outcome,
    RemainingFix,
    SameRows,
    begin_without,
    enumerable,
    explain,
    explain_from_beginnings,
    fix_remaining,
    grow_explanation,
    leave_out_of,
    prove_remaining,
    remaining_fix_of,
)
from optloc.solvers.verdict.conclusion import Conclusion, list_names
from optloc.solvers.verdict.judge import failed_fixes, filled_objects, judge, surviving_candidates, verdict

# A row that a robust loss gives less than half its weight is suspected first. The limit is above `REJECTED`, because
# this is a hint only: the row is tested, and taken back if it fits.
_HALF = 0.5
# Minima of a robust loss from which a search starts. A mirror image in the plane of the stations doubles their number.
_MINIMA = 4
# Fixes with more than this many median costs per degree of freedom do not count for the noise level. For noise of any
# size 3 % of fixes with redundancy one exceed it, and almost no fix with more redundancy.
_GROSS = 10.0
# statuses that no other choice of rows changes
_BEYOND = (Status.REJECTED, Status.TOO_FEW_ROWS, Status.INFEASIBLE, Status.UNAVAILABLE, Status.DISCONNECTED)


_GroupErrors = dict[int, Error]
_Explained = list[tuple[Array, tuple[Group, ...], list[Outcome]]]


@dataclass(frozen=True, slots=True)
class _RejectedRows:
    """Flags (N, m) of rows that an earlier robust fix rejected, and the vectors (N, size) of that fix."""

    rows: Array
    x: Array

    def take(self, items: Array) -> _RejectedRows:
        """Return the entries of some problems."""
        return _RejectedRows(self.rows[items], self.x[items])


def suspects(
    problem: Problem, fix: Fix | None = None, *, by: str | Sequence[str] = KINDS, together: bool = True
) -> Fix:
    """Return fixes without the measurements that contradict the other data, and name these suspects.

    Every group, every pair of groups and so on is left out, and the remaining data are fixed again without a first
    guess. A set explains the data if its rest passes the chi-square test at 1e-4. Its score is the cost of the rest
    plus a price for each group (16 for one row). All sets within 9 of the best score are listed, including the empty
    set.

    If the listed sets give different positions, the fix is ambiguous. If no set explains the data, it is contradictory.
    An explanation that leaves out q rows is `ok` only if the rest has redundancy q + 1. A range or range sum may also
    have an offset that all rows of its kind share. For too many sets, and in runs, groups are left out one at a time.

    Parameters
    ----------
    problem : Problem
        Batch axes (...). If its epochs share no unknown, the epochs become one more batch axis, as in `solve`.
    fix : Fix, optional
        Fix of the same problem, by `solve`; None: it is solved first. Rows that a robust method rejected are suspected
        first.
    by : "station", "row", "prior", "offset" or several of them
        Kinds of groups that may be wrong: all rows of a station, one measurement, a prior, or all lengths of a kind by
        one offset.
    together : bool
        Whether one statement of the noise applies to the whole batch and all epochs. If so, the noise is a suspect too
        when many fixes contradict themselves. False for unrelated problems.

    Returns
    -------
    Fix
        With `explanations`; the weights of rows left out are zero.

    Raises
    ------
    InvalidProblem
        For an unknown group, or a fix with other batch axes.
    """
    kinds = check_kinds(by)
    problem = by_epoch(problem) if separable(problem) else problem
    shape, flat = problem.batch_shape, problem.flat()
    if fix is not None and fix.shape != shape:
        raise InvalidProblem(f"the fix has batch axes {fix.shape}, not {shape}", "fix", "give the fix of this problem")
    given = None if fix is None else fix.flat()

    def work(part: Problem, own: slice) -> Fix:
        pool = search_widely(part) if given is None else accept(part, given[own])
        return judge(part, suspect(part, pool, kinds, together=together))

    return in_parts(flat, work, failed=failed_fixes).reshape(shape)


def suspect(problem: Problem, pool: Pool | None, by: Sequence[GroupKind] = KINDS, *, together: bool = True) -> Pool:
    """Return the pool of a flat batch with the conclusions of a search for suspects: the stage behind `suspects`.

    `by` and `together` are as in `suspects`.
    """
    if pool is None:
        raise InvalidProblem("suspects needs a fix", "method", "put it after a refinement, as in 'gtrs+lsr+suspects'")
    began = perf_counter()
    present = np.broadcast_to(problem.weight, (len(pool), problem.count))
    rejected = np.asarray((pool.weights < _HALF) & (present > _HALF))
    doubted = _RejectedRows(rejected, judge(problem, pool).x if rejected.any() else pool.x[:, 0])
    if not np.array_equal(pool.weights, present):
        # a robust fix has other minima, and the test needs least squares with every row
        pool = lsr(
            problem, offer(problem, surviving_candidates(pool, judge(problem, pool)), pool, "start", perf_counter())
        )
    before = pool.stages
    explain_all = partial(_explain, present=present, doubted=doubted, by=by)
    larger, found = _choose_noise(problem, pool, explain_all, together)
    count = sum(len(items) for items, _, _ in found)
    if larger is None:
        pool = _with_conclusions(problem, pool, found)
    else:
        pool = replace(pool, asked=True, conclusion=_fix_with_larger_noise(larger, found))
    stage = Stage("suspects", f"{count} of {len(pool)} have contradictions", perf_counter() - began)
    return replace(pool, stages=(*before, stage))


def _with_conclusions(problem: Problem, pool: Pool, found: _Explained) -> Pool:
    """Return pools with the conclusions from explanations: for each set of items their groups and outcomes."""
    pool = replace(pool, asked=True)
    fix, conclusion = judge(problem, pool), filled_objects(len(pool), None)
    step = chunk_size(problem)
    for items, groups, outcomes in found:
        for first in range(0, len(items), step):
            part = slice(first, first + step)
            numbers = items[part]
            conclusion[numbers] = _conclude(problem.take(numbers), fix[numbers], groups, outcomes[part])
    return replace(pool, conclusion=conclusion)


@dataclass(frozen=True, slots=True)
class _LargerNoise:
    """Problems with larger noise than stated, and their refined candidates.

    Parameters
    ----------
    problem : Problem
        N problems with the larger noise.
    pool : Pool
        Candidates, refined with the larger noise.
    sizes : array (m,)
        Factors of the stated standard deviations of the rows, 1 or more.
    reason : str
        Sentence on which noise is larger, and by how much.
    """

    problem: Problem
    pool: Pool
    sizes: Array
    reason: str


def _choose_noise(
    problem: Problem, pool: Pool, explain_all: Callable[[Problem, Fix], _Explained], together: bool
) -> tuple[_LargerNoise | None, _Explained]:
    """Return a larger noise if it is likelier for all problems together, else None; and the explanations with it.

    `explain_all` maps problems and their fixes to explanations. If `together` is False, no larger noise is tried.
    """
    fix = judge(problem, pool)
    larger = _larger_noise(problem, pool, fix) if together else None
    if larger is None:
        return None, explain_all(problem, fix)
    # with the larger noise fewer rows are suspects; the larger noise adds the price of one row
    other = judge(larger.problem, larger.pool)
    again, present = explain_all(larger.problem, other), np.broadcast_to(problem.weight, fix.weights.shape)
    more = 2.0 * (present @ np.log(larger.sizes)) / np.maximum(present.sum(1), 1.0)
    score = _score(again, other, more) + ROW_PRICE
    # a lower bound of the score with the stated noise: each fix costs at least its cost or the price of a row
    if score < np.fmin(fix.cost, ROW_PRICE)[np.isfinite(fix.cost) & (fix.dof > 0)].sum():
        return larger, again
    found = explain_all(problem, fix)
    return (larger, again) if score < _score(found, fix, np.zeros(len(more))) else (None, found)


def _larger_noise(problem: Problem, pool: Pool, fix: Fix) -> _LargerNoise | None:
    """Return the problems with the noise level that their fixes show; None if it is not larger than stated.

    A kind whose noise is smaller than stated keeps the stated noise: its ellipses then cover more than they promise.
    The factor of a kind is the upper end of its interval, so that ellipses cover even if few fixes determine it.
    """
    if problem.epochs > 1 or len(fix.x) < SEVERAL:
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        each = np.where(fix.dof > 0, fix.cost / fix.dof, np.inf)
    if np.isfinite(each).sum() < SEVERAL:
        return None
    # a fix with a gross error has a large cost relative to the other fixes, for noise of any size
    kept = np.flatnonzero(each <= _GROSS * np.median(each[np.isfinite(each)]))
    if len(kept) < SEVERAL:
        return None
    batch = batch_of(problem.take(kept))
    level = common_level_at(batch, restore_order(batch.layout, problem.layout, fix.x[kept]))
    is_larger = level.factor > 1.0
    if not level.refutes or not np.isfinite(level.high[is_larger]).all():
        return None
    used = replace(level, factor=np.where(is_larger, level.high, 1.0))
    sentences = [
        f"the noise of {kind} rows is {factor:.2g} ({low:.2g} to {high:.2g}) times as large as stated"
        for kind, factor, low, high, larger in zip(
            level.kinds, level.factor, level.low, level.high, is_larger, strict=True
        )
        if larger
    ]
    scaled = used.scale(problem)
    refined = lsr(scaled, offer(scaled, surviving_candidates(pool, fix), pool, "start", perf_counter()))
    return _LargerNoise(
        scaled, refined, used.sizes(problem), f"{' and '.join(sentences)}: the upper end of the interval is used"
    )


def _fix_with_larger_noise(larger: _LargerNoise, found: _Explained) -> Array:
    """Return the finished fixes (N,), an object array, of problems with larger noise than stated."""
    problem = larger.problem
    fix = verdict(problem, certified(problem, _with_conclusions(problem, larger.pool, found)))
    marks, reason = np.array(fix.marks), np.array(fix.reason)
    items = np.flatnonzero(fix.answered)
    marks[items] |= Status.RESCALED.mark
    reason[items] = [f"{larger.reason}; {sentence}" if sentence else larger.reason for sentence in reason[items]]
    out, fix = filled_objects(len(reason), None), replace(fix, marks=marks, reason=reason)
    for i in range(len(out)):
        out[i] = fix[i]
    return out


def _explain(problem: Problem, fix: Fix, present: Array, doubted: _RejectedRows, by: Sequence[GroupKind]) -> _Explained:
    """Return the explanations of problems with a contradiction: sets of item numbers, their groups, and their outcomes.

    `present` (N, m) are the stated weights of the rows. `doubted` are rows to suspect first, `by` the kinds of groups.
    """
    with np.errstate(invalid="ignore"):
        # a set has at least the price of a row: at a lower cost of all data its score is beyond the gap
        noticed = ~fix.answered | (fix.cost > ROW_PRICE - AMBIGUOUS_GAP)
    noticed |= problem.epochs > 1  # the chi-square test of a whole run does not notice a few wrong rows
    items = np.flatnonzero(noticed & (fix.dof > 0) & ~np.isin(fix.code, _BEYOND))
    patterns = [items[numbers] for numbers in _group_alike(present[items] > 0.0)]
    alike = [_same_rows(problem, fix, numbers, by) for numbers in patterns]
    # if the sets are few, all are tried; in runs and for many groups, one group at a time
    many = [problem.epochs > 1 or not enumerable(one.groups, one.batch.count, 1) for one in alike]
    found = iter(explain([one for one, too_many in zip(alike, many, strict=True) if not too_many]))
    out: _Explained = []
    for numbers, one, too_many in zip(patterns, alike, many, strict=True):
        part = doubted.take(numbers)
        if too_many:
            outcomes = [_group_by_group(one, i, part, None) for i in range(len(numbers))]
        else:
            outcomes = _with_group_by_group(one, part, next(found))
        out.append((numbers, one.groups, outcomes))
    return out


def _score(found: _Explained, fix: Fix, more: Array) -> float:
    """Return the sum of the least scores of all problems.

    `more` (N,) is the price of larger noise per degree of freedom. The sum is twice the negative logarithm of the
    restricted likelihood, in which a factor f of sigma costs r ln f^2, with redundancy r.
    """
    good = np.isfinite(fix.cost) & (fix.dof > 0)
    score, dof = np.where(good, fix.cost, 0.0), np.where(good, fix.dof, 0)
    for items, _, outcomes in found:
        for i, outcome in zip(items, outcomes, strict=True):
            if good[i] and np.isfinite(outcome.least):
                score[i], dof[i] = outcome.least, outcome.dof
    return float((score + dof * more).sum())


def _group_alike(present: Array) -> list[Array]:
    """Return groups of problems with the same rows, as arrays of their numbers; `present` (N, m) flags rows."""
    if not len(present):
        return []
    _, pattern = np.unique(present, axis=0, return_inverse=True)
    return [np.flatnonzero(pattern.reshape(-1) == i) for i in range(int(pattern.max()) + 1)]


def _same_rows(problem: Problem, fix: Fix, items: Array, by: Sequence[GroupKind]) -> SameRows:
    """Return problems `items` in which the same rows are present, and their groups of the kinds `by`.

    Range differences become arrival times if the two forms are equivalent.
    """
    part = problem.take(items)
    arrivals = as_arrivals(part)
    work = part if arrivals is None else arrivals.problem
    present = np.broadcast_to(work.weight, (len(items), work.count))[0] > 0.0
    groups = groups_of(work, present, by)
    if arrivals is None:
        return SameRows(problem, items, groups, fix[items])
    return SameRows(work, np.arange(len(items)), groups, fix[items])


def _with_group_by_group(alike: SameRows, doubted: _RejectedRows, outcomes: list[Outcome]) -> list[Outcome]:
    """Return outcomes after a search group by group for the problems whose sets were too many to try all.

    Each search starts from the cheapest of the rests that were tried last. `doubted` has the rows to suspect first.
    """
    dof = alike.whole.dof
    # a set of `dof` rows or more leaves no redundancy, so `dof - 1` is the largest size of a set that a test can accept
    untried = [not outcome.rests and outcome.tried < most - 1 for outcome, most in zip(outcomes, dof, strict=True)]
    for i in np.flatnonzero(untried).tolist():
        more = _group_by_group(alike, i, doubted, outcomes[i].closest)
        outcomes[i] = replace(more, p_value=outcomes[i].p_value | more.p_value)
    return outcomes


def _conclude(problem: Problem, fix: Fix, groups: tuple[Group, ...], outcomes: Sequence[Outcome]) -> Array:
    """Return the conclusions (N,) for problems with the same rows; None if the fix of all data is kept.

    `fix` has the fixes of all data, and `outcomes` the results of the search.
    """
    arrivals, out = as_arrivals(problem), filled_objects(len(outcomes), None)
    cases: list[SuspectCase] = []
    chosen: dict[int, RemainingFix] = {}
    for i, outcome in enumerate(outcomes):
        item = np.array([i])
        one = None if arrivals is None else replace(arrivals, problem=arrivals.problem.take(item))
        cases.append(SuspectCase(problem.take(item), one, groups, fix[i]))
        if not outcome.rests:
            out[i] = _unexplained(cases[i], outcome)
        elif (best := _best_rest(cases[i], outcome)) is not None:
            chosen[i] = best
    # fixes of the given problem and fixes of its arrivals have different unknowns
    for given in (True, False):
        items = [i for i, best in chosen.items() if (best.fix.layout == problem.layout) == given]
        if items:
            work = problem if given or arrivals is None else arrivals.problem
            proven = prove_remaining(work.take(np.array(items)), groups, [chosen[i] for i in items])
            chosen |= dict(zip(items, proven, strict=True))
    rests = {i: (best, *outcomes[i].rests[1:]) for i, best in chosen.items()}
    group_errors = _errors(problem if arrivals is None else arrivals.problem, groups, rests)
    for i, rests_of in rests.items():
        out[i] = _explained(cases[i], outcomes[i], rests_of, group_errors[i])
    return out


def _group_by_group(alike: SameRows, i: int, doubted: _RejectedRows, start: RemainingFix | None) -> Outcome:
    """Return the explanations of problem i from a search group by group.

    Wrong rows draw the fix of all data away, perhaps to another minimum, so that right rows look wrong there. If the
    first search finds a contradiction, more searches start from the minima of a robust loss, which wrong rows cannot
    draw far. The first search starts from the rest `start`; None: from all data. Rows that a robust fix rejected, in
    `doubted`, replace this start.
    """
    # the fix has the layout of the given problem; with arrivals the layout also has emission times
    one, whole, groups = alike.batch.take(alike.items[[i]]), alike.whole[i], alike.groups
    if whole.layout != one.layout or not np.isfinite(whole.x).all():
        n = one.layout.n_shared
        known = np.isfinite(whole.x[:n]).all()
        near = complete(one, whole.x[None, None, :n]) if known else None
        whole = (fix_remaining(one) if near is None else fix_by(one, lambda _: begin(one, near)))[0]
    has_rejected = doubted.rows.shape[1] == one.count and doubted.rows[i].any()
    if has_rejected:
        start = begin_without(one, groups, doubted.rows[i], doubted.x[i])
    first = grow_explanation(one, groups, whole, start or remaining_fix_of(groups, (), whole))
    if not first.rests and not first.note:
        return first
    minima = doubted_minima(one, LOSSES["truncated"], _MINIMA)
    beginnings = [begin_without(one, groups, rows, x) for x, rows in minima]
    return explain_from_beginnings(
        [first, *(grow_explanation(one, groups, whole, each) for each in beginnings)], groups
    )


# From outcomes to explanations: suspects, their errors, and the evidence.


@dataclass(frozen=True, slots=True)
class SuspectCase:
    """A problem whose data contradict each other, and the form in which it was searched.

    Parameters
    ----------
    problem : Problem
        Flat batch of one problem, as given.
    arrivals : Arrivals, optional
        The same problem with arrival times instead of range differences.
    groups : tuple of Group
        Groups that may be wrong.
    whole : Fix
        The fix of all data, without batch axes.
    """

    problem: Problem
    arrivals: Arrivals | None
    groups: tuple[Group, ...]
    whole: Fix

    @property
    def work(self) -> Problem:
        """Return the form of the problem that was searched."""
        return self.problem if self.arrivals is None else self.arrivals.problem

    def vector(self, fix: Fix, x: Array | None = None) -> Array:
        """Return the vector of a fix in the layout of the given problem, (size,).

        `x` (..., size of the fix) replaces the vector of the fix.
        """
        x, layout = fix.x if x is None else x, self.problem.layout
        return x if fix.layout == layout else restore_order(layout, fix.layout, x)

    def rows(self, group: Group) -> tuple[int, ...]:
        """Return the rows of a group as row numbers of the given problem."""
        if self.arrivals is None:
            return group.rows
        return tuple(sorted({int(i) for row in group.rows for i in self.arrivals.origin[row]}))


def _unexplained(case: SuspectCase, outcome: Outcome) -> Conclusion | None:
    """Return the conclusion of a problem without an explanation; None if the fix of all data is kept."""
    # A run without a tried set and without an outlier keeps its fix: its noise is larger than stated.
    if case.whole.answered and set(outcome.p_value) == {()} and not outcome.note:
        return None
    return Conclusion((), case.whole, case.whole.alternatives, tried=_name_closest(case, outcome))


def _best_rest(case: SuspectCase, outcome: Outcome) -> RemainingFix | None:
    """Return the best rest of a problem, to be proven; None if the fix of all data is kept.

    The fix is kept if it is the best rest and all other rests have the same position.
    """
    best, *others = outcome.rests
    if not best.left and all(_same_place(best.fix, rest.fix) for rest in others):
        return None
    return best


def _explained(
    case: SuspectCase, outcome: Outcome, rests: Sequence[RemainingFix], group_errors: Sequence[_GroupErrors]
) -> Conclusion:
    """Return the conclusion of a problem from its rests, of which the first is proven.

    `group_errors` has the estimated errors of the groups that each rest leaves out.
    """
    (best, *_), (first, *others) = rests, outcome.rests
    elsewhere = [rest for rest in others if not _same_place(first.fix, rest.fix)]
    pairs = zip(rests, group_errors, strict=True)
    explanations = tuple(_explanation(case, rest, outcome, found) for rest, found in pairs)
    spent, fix = int(case.whole.dof) - int(best.fix.dof), _in_layout(case, best.fix)
    return Conclusion(explanations, fix, _alternatives(case, best, elsewhere), spent, bool(elsewhere))


def _same_place(best: Fix, other: Fix) -> bool:
    """Return whether two fixes give the same answer: the position of `other` is inside the ellipsoid of `best`."""
    # unknowns that only one fix has, such as an offset, do not count; if both have positions, only positions count
    other_names = {slot.name for slot in other.layout.shared}
    common = [slot for slot in best.layout.shared if slot.name in other_names]
    common = [slot for slot in common if slot.name.partition("[")[0] == "position"] or common
    if not common:
        return False
    alike = Layout(tuple(common), (), 0)
    columns, other_columns = shared_places(alike, best.layout), shared_places(alike, other.layout)
    step, covariance = other.x[other_columns] - best.x[columns], best.cov[np.ix_(columns, columns)]
    if not (np.isfinite(step).all() and np.isfinite(covariance).all()):
        return False
    inverse, regular = linalg.inverse(covariance)
    return bool(regular) and float(step @ inverse @ step) <= quantile(REGION_LEVEL, len(step))


def _in_layout(case: SuspectCase, fix: Fix) -> Fix:
    """Return a fix with only the shared unknowns of the given problem, without added offsets and emission times."""
    layout = case.problem.layout
    if fix.layout == layout:
        return fix
    places = shared_places(layout, fix.layout)
    others = Alternatives(case.vector(fix, fix.alternatives.x), fix.alternatives.gap)
    # the states of epochs may have another order, so their covariances are dropped
    return replace(
        fix, x=case.vector(fix), cov=fix.cov[np.ix_(places, places)], layout=layout, local=None, alternatives=others
    )


def _name_closest(case: SuspectCase, outcome: Outcome) -> str:
    """Return a sentence on the set of groups with the largest p-value, since no set explains the data."""
    tested = {left: p for left, p in outcome.p_value.items() if left and np.isfinite(p)}
    if not tested:
        return outcome.note
    best = max(tested, key=tested.__getitem__)
    names = list_names([case.groups[i].name for i in best])
    reason = f"no explanation passes; the closest leaves out {names} (p = {tested[best]:.1g})"
    return reason + (f"; {outcome.note}" if outcome.note else "")


def _explanation(case: SuspectCase, rest: RemainingFix, outcome: Outcome, error_of: _GroupErrors) -> Explanation:
    """Return the explanation of a rest: its suspects with errors, from `error_of`, and p-values, and its fix."""
    fix = rest.fix
    p_without = float(fix.p_value)
    # errors of compass bearings are reported in the sense of the readings
    senses = np.concatenate([np.full(rows.count, rows.sense) for rows in case.work.rows])
    suspects = []
    for i in rest.left:
        group, error = case.groups[i], error_of.get(i)
        known = outcome.p_value.get(tuple(j for j in rest.left if j != i))
        p_with = _p_with(fix, error) if known is None else known
        unknown = np.full(1, np.nan)
        value, sigma = (unknown, unknown) if error is None else (error.value, error.sigma)
        if group.rows and len(value) == len(group.rows):
            value = senses[list(group.rows)] * value
        suspects.append(Suspect(group.name, group.kind, case.rows(group), value, sigma, p_with, p_without))
    return Explanation(tuple(suspects), case.vector(fix), float(fix.cost), int(fix.dof), p_without, rest.score)


def _errors(
    work: Problem, groups: Sequence[Group], rests: dict[int, tuple[RemainingFix, ...]]
) -> dict[int, list[_GroupErrors]]:
    """Return the estimated errors of the groups left out: for each problem a list, one entry for each rest.

    An entry maps the number of a group to its error. Rests with the same offsets have the same unknowns, so they are
    linearised together.
    """
    out: dict[int, list[_GroupErrors]] = {i: [{} for _ in rests_of] for i, rests_of in rests.items()}
    alike: dict[tuple[int, ...], list[tuple[int, RemainingFix, _GroupErrors]]] = {}
    for i, rests_of in rests.items():
        for rest, estimates in zip(rests_of, out[i], strict=True):
            if not np.isfinite(rest.fix.x).all() or not rest.left:
                continue
            offsets = tuple(j for j in rest.left if groups[j].offset is not None)
            estimates |= {j: _offset_error(groups[j], rest.fix) for j in offsets}
            if len(offsets) < len(rest.left):
                alike.setdefault(offsets, []).append((i, rest, estimates))
    for offsets, members in alike.items():
        part = leave_out_of(work.take(np.array([i for i, _, _ in members])), groups, offsets)
        found = influences(part, np.stack([rest.fix.x for _, rest, _ in members]))
        for influence_of, (_, rest, estimates) in zip(found, members, strict=True):
            others = [j for j in rest.left if j not in offsets]
            estimates |= dict(zip(others, errors(influence_of, [groups[j] for j in others]), strict=True))
    return out


def _offset_error(group: Group, fix: Fix) -> Error:
    """Return the error of an offset group from a fix that estimates the offset; units of the rows."""
    value, sigma = fix.take(group.name), fix.sigma(group.name)
    statistic = float((value / sigma) @ (value / sigma)) if np.isfinite(sigma).all() else np.nan
    return Error(value, sigma, statistic, len(value))


def _p_with(fix: Fix, error: Error | None) -> float:
    """Return the chi-square probability of a rest with a suspect taken back, to first order; NaN if unknown."""
    from scipy.special import gammaincc

    if error is None:
        return float("nan")
    # to first order the suspect raises the cost of the rest by its statistic
    return float(gammaincc((int(fix.dof) + error.dof) / 2, (float(fix.cost) + error.statistic) / 2))


def _alternatives(case: SuspectCase, best: RemainingFix, elsewhere: Sequence[RemainingFix]) -> Alternatives:
    """Return the other positions of the best rest and of the rests `elsewhere`, in ascending order of their gaps."""
    first = best.fix
    x = [case.vector(first, first.alternatives.x), *(case.vector(rest.fix)[None] for rest in elsewhere)]
    gap = [first.alternatives.gap, *(np.array([max(rest.score - best.score, 0.0)]) for rest in elsewhere)]
    points, gaps = np.concatenate(x), np.concatenate(gap)
    kept = np.isfinite(gaps) & np.isfinite(points).all(-1)
    order = np.argsort(gaps[kept], kind="stable")
    return Alternatives(points[kept][order], gaps[kept][order])
