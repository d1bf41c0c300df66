"""Which measurement is lying: where the data contradict each other, who has to be left out for the rest to agree."""

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
from optloc.problem.fix import Alternatives, Fix, Stage
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

# A row that a loss gives less than half its weight is suspected first. More than `REJECTED` names: here it is a hint
# that is tested, and who fits is taken back.
_HALF = 0.5
# Minima of a loss from which who is wrong is sought: an image in the plane of the stations has another beside it.
_MINIMA = 4
# Median costs per degree of freedom beyond which a fix is left out where the noise level is sought: noise of any size
# exceeds it in 3 % of fixes with redundancy one, and hardly ever with more.
_GROSS = 10.0
# No other choice of rows helps these.
_BEYOND = (Status.REJECTED, Status.TOO_FEW_ROWS, Status.INFEASIBLE, Status.UNAVAILABLE, Status.DISCONNECTED)


_Told = dict[int, Error]
_Explained = list[tuple[Array, tuple[Group, ...], list[Outcome]]]


@dataclass(frozen=True, slots=True)
class _Doubted:
    """Rows (N, m) that a robust fix before rejected, and the vectors (N, size) at which it did."""

    rows: Array
    x: Array

    def take(self, items: Array) -> _Doubted:
        """Return those of some problems."""
        return _Doubted(self.rows[items], self.x[items])


def suspects(
    problem: Problem, fix: Fix | None = None, *, by: str | Sequence[str] = KINDS, together: bool = True
) -> Fix:
    """Return fixes without the measurements that contradict the rest, and who they are.

    Every group, every two of them and so on are left out and the rest fixed anew without a guess. A set explains the
    data where its rest passes the chi-square test at 1e-4; its score is the cost of the rest and a price for each group
    (16 for one row). All sets within 9 of the best score are listed, the empty one too. Where they place the target
    elsewhere the fix is ambiguous; where none explains the data it is contradictory; an explanation that leaves out q
    rows is `ok` only with redundancy q + 1 without them. A range or range sum may also have an offset that all rows of
    its kind share. Where the sets are too many, and in runs, groups are left out one at a time.

    Parameters
    ----------
    problem : Problem
        Batch axes (...). Where its epochs share no unknown they are one more batch axis, as in `solve`.
    fix : Fix, optional
        Of the same problem, by `solve`; None: it is solved first. Rows that a robust method rejected are suspected
        first.
    by : "station", "row", "prior", "offset" or several of them
        What may be wrong: all rows of a station, one measurement, a prior, all lengths of a kind by one offset.
    together : bool
        Whether the noise of a batch, and of epochs, is stated for all of them, so that it is a suspect too where many
        contradict themselves; False for problems that have nothing to do with each other.

    Returns
    -------
    Fix
        With `explanations`; its weights are zero on rows that were left out.

    Raises
    ------
    InvalidProblem
        For an unknown group, or a fix of other batch axes.
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
    """Return the pool of a flat batch with what contradicts the rest left out: the stage behind `suspects`."""
    if pool is None:
        raise InvalidProblem(
            "suspects questions a fix", "method", "put it behind a refinement, as in 'gtrs+lsr+suspects'"
        )
    began = perf_counter()
    present = np.broadcast_to(problem.weight, (len(pool), problem.count))
    rejected = np.asarray((pool.weights < _HALF) & (present > _HALF))
    doubted = _Doubted(rejected, judge(problem, pool).x if rejected.any() else pool.x[:, 0])
    if not np.array_equal(pool.weights, present):
        # a robust fix has its minima elsewhere: the test is that of least squares with every row
        pool = lsr(
            problem, offer(problem, surviving_candidates(pool, judge(problem, pool)), pool, "start", perf_counter())
        )
    before = pool.stages
    asked = partial(_explain, present=present, doubted=doubted, by=by)
    louder, found = _weigh(problem, pool, asked, together)
    count = sum(len(items) for items, _, _ in found)
    if louder is None:
        pool = _with_conclusions(problem, pool, found)
    else:
        pool = replace(pool, asked=True, conclusion=_fix_by_louder_noise(louder, found))
    stage = Stage("suspects", f"{count} of {len(pool)} contradict themselves", perf_counter() - began)
    return replace(pool, stages=(*before, stage))


def _with_conclusions(problem: Problem, pool: Pool, found: _Explained) -> Pool:
    """Return pools with the conclusions that explanations lead to."""
    pool = replace(pool, asked=True)
    fix, conclusion = judge(problem, pool), filled_objects(len(pool), None)
    step = chunk_size(problem)
    for items, groups, outcomes in found:
        for first in range(0, len(items), step):
            part = slice(first, first + step)
            own = items[part]
            conclusion[own] = _conclude(problem.take(own), fix[own], groups, outcomes[part])
    return replace(pool, conclusion=conclusion)


@dataclass(frozen=True, slots=True)
class _Louder:
    """Problems with larger noise than stated, and their refined candidates.

    Parameters
    ----------
    problem : Problem
        N problems with the larger noise.
    pool : Pool
        Refined with it.
    sizes : array (m,)
        Factors of the stated standard deviations of the rows, 1 or more.
    reason : str
        Which noise is larger, and by how much.
    """

    problem: Problem
    pool: Pool
    sizes: Array
    reason: str


def _weigh(
    problem: Problem, pool: Pool, asked: Callable[[Problem, Fix], _Explained], together: bool
) -> tuple[_Louder | None, _Explained]:
    """Return the larger noise that is likelier for all problems together, if any, and the explanations with it."""
    fix = judge(problem, pool)
    louder = _louder(problem, pool, fix) if together else None
    if louder is None:
        return None, asked(problem, fix)
    # with the larger noise fewer rows are suspects
    other = judge(louder.problem, louder.pool)
    again, present = asked(louder.problem, other), np.broadcast_to(problem.weight, fix.weights.shape)
    more = 2.0 * (present @ np.log(louder.sizes)) / np.maximum(present.sum(1), 1.0)
    score = _score(again, other, more) + ROW_PRICE
    # with the noise as stated each fix costs what it does, or the price of a row at least
    if score < np.fmin(fix.cost, ROW_PRICE)[np.isfinite(fix.cost) & (fix.dof > 0)].sum():
        return louder, again
    found = asked(problem, fix)
    return (louder, again) if score < _score(found, fix, np.zeros(len(more))) else (None, found)


def _louder(problem: Problem, pool: Pool, fix: Fix) -> _Louder | None:
    """Return a batch with the noise that its fixes show, where that is larger than stated.

    A kind whose noise is stated too large keeps it: its ellipses then cover more than they promise. The upper ends of
    the intervals count, so that ellipses cover also where few fixes determine the factors.
    """
    if problem.epochs > 1 or len(fix.x) < SEVERAL:
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        each = np.where(fix.dof > 0, fix.cost / fix.dof, np.inf)
    if np.isfinite(each).sum() < SEVERAL:
        return None
    # a liar has a large cost relative to the other fixes, for noise of any size
    kept = np.flatnonzero(each <= _GROSS * np.median(each[np.isfinite(each)]))
    if len(kept) < SEVERAL:
        return None
    batch = batch_of(problem.take(kept))
    level = common_level_at(batch, restore_order(batch.layout, problem.layout, fix.x[kept]))
    grown = level.factor > 1.0
    if not level.refutes or not np.isfinite(level.high[grown]).all():
        return None
    used = replace(level, factor=np.where(grown, level.high, 1.0))
    said = [
        f"the noise of {kind} rows is {factor:.2g} ({low:.2g} to {high:.2g}) times as large as stated"
        for kind, factor, low, high, larger in zip(level.kinds, level.factor, level.low, level.high, grown, strict=True)
        if larger
    ]
    loud = used.scale(problem)
    refined = lsr(loud, offer(loud, surviving_candidates(pool, fix), pool, "start", perf_counter()))
    return _Louder(loud, refined, used.sizes(problem), f"{' and '.join(said)}: the upper end of the interval is used")


def _fix_by_louder_noise(louder: _Louder, found: _Explained) -> Array:
    """Return the finished fixes (N,), objects, of problems with larger noise than stated."""
    problem = louder.problem
    fix = verdict(problem, certified(problem, _with_conclusions(problem, louder.pool, found)))
    marks, reason = np.array(fix.marks), np.array(fix.reason)
    items = np.flatnonzero(fix.answered)
    marks[items] |= Status.RESCALED.mark
    reason[items] = [f"{louder.reason}; {own}" if own else louder.reason for own in reason[items]]
    out, fix = filled_objects(len(reason), None), replace(fix, marks=marks, reason=reason)
    for i in range(len(out)):
        out[i] = fix[i]
    return out


def _explain(problem: Problem, fix: Fix, present: Array, doubted: _Doubted, by: Sequence[GroupKind]) -> _Explained:
    """Return what explains those problems that show something: their numbers, what may be wrong, and what is."""
    with np.errstate(invalid="ignore"):
        # of a lower cost the cheapest set has a score beyond the gap whatever it leaves
        noticed = ~fix.answered | (fix.cost > ROW_PRICE - AMBIGUOUS_GAP)
    noticed |= problem.epochs > 1  # a few of many rows go unnoticed by the chi-square of all
    items = np.flatnonzero(noticed & (fix.dof > 0) & ~np.isin(fix.code, _BEYOND))
    patterns = [items[own] for own in _group_alike(present[items] > 0.0)]
    alike = [_alike(problem, fix, own, by) for own in patterns]
    # few sets: all are tried, and nothing masks anything; runs and many groups: one at a time
    many = [problem.epochs > 1 or not enumerable(one.groups, one.batch.count, 1) for one in alike]
    found = iter(explain([one for one, grown in zip(alike, many, strict=True) if not grown]))
    out: _Explained = []
    for own, one, grown in zip(patterns, alike, many, strict=True):
        part = doubted.take(own)
        if grown:
            outcomes = [_grow(one, i, part, None) for i in range(len(own))]
        else:
            outcomes = _with_grown(one, part, next(found))
        out.append((own, one.groups, outcomes))
    return out


def _score(found: _Explained, fix: Fix, more: Array) -> float:
    """Return the least score of all problems together, with more (N,) for each redundancy: what larger noise costs.

    It is twice the negative logarithm of the restricted likelihood, in which sigma times f counts r ln f^2.
    """
    good = np.isfinite(fix.cost) & (fix.dof > 0)
    score, dof = np.where(good, fix.cost, 0.0), np.where(good, fix.dof, 0)
    for items, _, outcomes in found:
        for i, outcome in zip(items, outcomes, strict=True):
            if good[i] and np.isfinite(outcome.least):
                score[i], dof[i] = outcome.least, outcome.dof
    return float((score + dof * more).sum())


def _group_alike(present: Array) -> list[Array]:
    """Return the numbers of the problems (N, m) that have the same rows, for each pattern."""
    if not len(present):
        return []
    _, pattern = np.unique(present, axis=0, return_inverse=True)
    return [np.flatnonzero(pattern.reshape(-1) == i) for i in range(int(pattern.max()) + 1)]


def _alike(problem: Problem, fix: Fix, items: Array, by: Sequence[GroupKind]) -> SameRows:
    """Return problems in which the same rows are present, by arrivals where that is the same, and their groups."""
    part = problem.take(items)
    arrivals = as_arrivals(part)
    work = part if arrivals is None else arrivals.problem
    present = np.broadcast_to(work.weight, (len(items), work.count))[0] > 0.0
    groups = groups_of(work, present, by)
    if arrivals is None:
        return SameRows(problem, items, groups, fix[items])
    return SameRows(work, np.arange(len(items)), groups, fix[items])


def _with_grown(alike: SameRows, doubted: _Doubted, outcomes: list[Outcome]) -> list[Outcome]:
    """Return outcomes where sets that were too many to be tried are sought group by group from the best found."""
    dof = alike.whole.dof
    untried = [not own.rests and own.tried < most - 1 for own, most in zip(outcomes, dof, strict=True)]
    for i in np.flatnonzero(untried).tolist():
        more = _grow(alike, i, doubted, outcomes[i].closest)
        outcomes[i] = replace(more, p_value=outcomes[i].p_value | more.p_value)
    return outcomes


def _conclude(problem: Problem, fix: Fix, groups: tuple[Group, ...], outcomes: Sequence[Outcome]) -> Array:
    """Return what is concluded of problems (N,) in which the same rows are present, None where nothing is."""
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
    # fixes of the problem as given have other unknowns than fixes of its arrivals
    for given in (True, False):
        items = [i for i, best in chosen.items() if (best.fix.layout == problem.layout) == given]
        if items:
            work = problem if given or arrivals is None else arrivals.problem
            proven = prove_remaining(work.take(np.array(items)), groups, [chosen[i] for i in items])
            chosen |= dict(zip(items, proven, strict=True))
    rests = {i: (best, *outcomes[i].rests[1:]) for i, best in chosen.items()}
    told = _errors(problem if arrivals is None else arrivals.problem, groups, rests)
    for i, own in rests.items():
        out[i] = _explained(cases[i], outcomes[i], own, told[i])
    return out


def _grow(alike: SameRows, i: int, doubted: _Doubted, start: RemainingFix | None) -> Outcome:
    """Return what explains the i-th of some problems, found group by group.

    The fix of all rows is where wrong ones have drawn it, perhaps to another minimum, from which the right ones look
    wrong. Where it shows something, the minima of a loss that no error draws far are begun from as well.
    """
    # the fix is of the problem as given; with arrivals for differences the layout has emission times besides
    one, own, groups = alike.batch.take(alike.items[[i]]), alike.whole[i], alike.groups
    if own.layout != one.layout or not np.isfinite(own.x).all():
        n = one.layout.n_shared
        known = np.isfinite(own.x[:n]).all()
        near = complete(one, own.x[None, None, :n]) if known else None
        own = (fix_remaining(one) if near is None else fix_by(one, lambda _: begin(one, near)))[0]
    handed = doubted.rows.shape[1] == one.count and doubted.rows[i].any()
    if handed:
        start = begin_without(one, groups, doubted.rows[i], doubted.x[i])
    first = grow_explanation(one, groups, own, start or remaining_fix_of(groups, (), own))
    if not first.rests and not first.note:
        return first
    minima = doubted_minima(one, LOSSES["truncated"], _MINIMA)
    begun = [begin_without(one, groups, rows, x) for x, rows in minima]
    return explain_from_beginnings([first, *(grow_explanation(one, groups, own, each) for each in begun)], groups)


# From what explains the data of one problem to explanations: who is left out, how large an error, what evidence.


@dataclass(frozen=True, slots=True)
class SuspectCase:
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

    def vector(self, fix: Fix, x: Array | None = None) -> Array:
        """Return a fix, or vectors (..., size) in its order, in the order of the given problem."""
        x, layout = fix.x if x is None else x, self.problem.layout
        return x if fix.layout == layout else restore_order(layout, fix.layout, x)

    def rows(self, group: Group) -> tuple[int, ...]:
        """Return the rows of a group as numbers of the given problem's rows."""
        if self.arrivals is None:
            return group.rows
        return tuple(sorted({int(i) for row in group.rows for i in self.arrivals.origin[row]}))


def _unexplained(case: SuspectCase, outcome: Outcome) -> Conclusion | None:
    """Return the conclusion of a problem that nothing explains; None where the fix of all data is kept."""
    # no set was tried and nothing stood out: a run whose noise is larger than stated keeps its fix
    if case.whole.answered and set(outcome.p_value) == {()} and not outcome.note:
        return None
    return Conclusion((), case.whole, case.whole.alternatives, tried=_name_closest(case, outcome))


def _best_rest(case: SuspectCase, outcome: Outcome) -> RemainingFix | None:
    """Return the rest that explains a problem best, to be proven; None where the fix of all data is kept."""
    best, *others = outcome.rests
    if not best.left and all(_same_place(best.fix, rest.fix) for rest in others):
        return None
    return best


def _explained(case: SuspectCase, outcome: Outcome, rests: Sequence[RemainingFix], told: Sequence[_Told]) -> Conclusion:
    """Return the conclusion of a problem of which the first rest is proven, with the errors of each rest."""
    (best, *_), (first, *others) = rests, outcome.rests
    elsewhere = [rest for rest in others if not _same_place(first.fix, rest.fix)]
    pairs = zip(rests, told, strict=True)
    explanations = tuple(_explanation(case, rest, outcome, found) for rest, found in pairs)
    spent, fix = int(case.whole.dof) - int(best.fix.dof), _in_layout(case, best.fix)
    return Conclusion(explanations, fix, _alternatives(case, best, elsewhere), spent, bool(elsewhere))


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
    return bool(regular) and float(step @ inverse @ step) <= quantile(REGION_LEVEL, len(step))


def _in_layout(case: SuspectCase, fix: Fix) -> Fix:
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


def _name_closest(case: SuspectCase, outcome: Outcome) -> str:
    """Return what came closest to an explanation, in words."""
    tested = {left: p for left, p in outcome.p_value.items() if left and np.isfinite(p)}
    if not tested:
        return outcome.note
    best = max(tested, key=tested.__getitem__)
    names = list_names([case.groups[i].name for i in best])
    reason = f"nothing explains it; best is to leave out {names} (p = {tested[best]:.1g})"
    return reason + (f"; {outcome.note}" if outcome.note else "")


def _explanation(case: SuspectCase, rest: RemainingFix, outcome: Outcome, told: _Told) -> Explanation:
    fix = rest.fix
    p_without = float(fix.p_value)
    # Errors of compass bearings are reported in the sense of the readings.
    senses = np.concatenate([np.full(rows.count, rows.sense) for rows in case.work.rows])
    suspects = []
    for i in rest.left:
        group, error = case.groups[i], told.get(i)
        known = outcome.p_value.get(tuple(j for j in rest.left if j != i))
        p_with = _p_with(fix, error) if known is None else known
        none = np.full(1, np.nan)
        value, sigma = (none, none) if error is None else (error.value, error.sigma)
        if group.rows and len(value) == len(group.rows):
            value = senses[list(group.rows)] * value
        suspects.append(Suspect(group.name, group.kind, case.rows(group), value, sigma, p_with, p_without))
    return Explanation(tuple(suspects), case.vector(fix), float(fix.cost), int(fix.dof), p_without, rest.score)


def _errors(
    work: Problem, groups: Sequence[Group], rests: dict[int, tuple[RemainingFix, ...]]
) -> dict[int, list[_Told]]:
    """Return the estimated errors of what each rest of some problems leaves out, by number of the group.

    Rests with the same offsets have the same unknowns: they are linearised together.
    """
    out: dict[int, list[_Told]] = {i: [{} for _ in own] for i, own in rests.items()}
    alike: dict[tuple[int, ...], list[tuple[int, RemainingFix, _Told]]] = {}
    for i, own in rests.items():
        for rest, told in zip(own, out[i], strict=True):
            if not np.isfinite(rest.fix.x).all() or not rest.left:
                continue
            offsets = tuple(j for j in rest.left if groups[j].offset is not None)
            told |= {j: _offset_error(groups[j], rest.fix) for j in offsets}
            if len(offsets) < len(rest.left):
                alike.setdefault(offsets, []).append((i, rest, told))
    for offsets, members in alike.items():
        part = leave_out_of(work.take(np.array([i for i, _, _ in members])), groups, offsets)
        found = influences(part, np.stack([rest.fix.x for _, rest, _ in members]))
        for at, (_, rest, told) in zip(found, members, strict=True):
            others = [j for j in rest.left if j not in offsets]
            told |= dict(zip(others, errors(at, [groups[j] for j in others]), strict=True))
    return out


def _offset_error(group: Group, fix: Fix) -> Error:
    """Return the error of a group that is one offset, from a fix that estimates it."""
    value, sigma = fix.take(group.name), fix.sigma(group.name)
    statistic = float((value / sigma) @ (value / sigma)) if np.isfinite(sigma).all() else np.nan
    return Error(value, sigma, statistic, len(value))


def _p_with(fix: Fix, error: Error | None) -> float:
    """Return the chi-square probability of a rest with one of its suspects back, to first order."""
    from scipy.special import gammaincc

    if error is None:
        return float("nan")
    # the rest with the suspect back: to first order its cost rises by the statistic
    return float(gammaincc((int(fix.dof) + error.dof) / 2, (float(fix.cost) + error.statistic) / 2))


def _alternatives(case: SuspectCase, best: RemainingFix, elsewhere: Sequence[RemainingFix]) -> Alternatives:
    """Return the other positions of the best explanation and those of the others, by score, cheapest first."""
    first = best.fix
    x = [case.vector(first, first.alternatives.x), *(case.vector(rest.fix)[None] for rest in elsewhere)]
    gap = [first.alternatives.gap, *(np.array([max(rest.score - best.score, 0.0)]) for rest in elsewhere)]
    points, gaps = np.concatenate(x), np.concatenate(gap)
    kept = np.isfinite(gaps) & np.isfinite(points).all(-1)
    order = np.argsort(gaps[kept], kind="stable")
    return Alternatives(points[kept][order], gaps[kept][order])
