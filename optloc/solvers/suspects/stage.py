"""Which measurement is lying: where the data contradict each other, who has to be left out for the rest to agree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np

from optloc.adequacy.groups import KINDS, ROW_PRICE, Group, check_kinds, groups_of
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.problem.arrivals import as_arrivals
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix, GroupKind, Stage
from optloc.problem.problem import Problem
from optloc.solvers.outside import accept
from optloc.solvers.policy import AMBIGUOUS_GAP
from optloc.solvers.pool import Pool, begin, offer
from optloc.solvers.stages import fix_by, lsr, search_widely
from optloc.solvers.starts.position import complete
from optloc.solvers.suspects.report import Case, conclude_case
from optloc.solvers.suspects.subsets import Finding, Rest, enumerable, explain, fix_rest, grow
from optloc.solvers.verdict.conclusion import Conclusion
from optloc.solvers.verdict.judge import fill, judge, standing

# A row that a loss gives less than half its weight is suspected first. More than `REJECTED` names: here it is a hint
# that is tested, and who fits is taken back.
_HALF = 0.5
# No other choice of rows helps these.
_BEYOND = (Status.REJECTED, Status.TOO_FEW_ROWS, Status.INFEASIBLE, Status.UNAVAILABLE, Status.DISCONNECTED)


def suspects(problem: Problem, fix: Fix | None = None, *, by: str | Sequence[str] = KINDS) -> Fix:
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
    pool = search_widely(flat) if fix is None else accept(flat, fix.flat())
    return judge(flat, suspect(flat, pool, kinds)).reshape(shape)


def suspect(problem: Problem, pool: Pool | None, by: Sequence[GroupKind] = KINDS) -> Pool:
    """Return the pool of a flat batch with what contradicts the rest left out: the stage behind `suspects`."""
    if pool is None:
        raise InvalidProblem(
            "suspects questions a fix", "method", "put it behind a refinement, as in 'gtrs+lsr+suspects'"
        )
    began = perf_counter()
    present = np.broadcast_to(problem.weight, (len(pool), problem.count))
    rejected = np.asarray((pool.weights < _HALF) & (present > _HALF))
    if not np.array_equal(pool.weights, present):
        # a robust fix has its minima elsewhere: the test is that of least squares with every row
        pool = lsr(problem, offer(problem, standing(pool, judge(problem, pool)), pool, "start", perf_counter()))
    pool = replace(pool, asked=True)
    fix = judge(problem, pool)
    with np.errstate(invalid="ignore"):
        # of a lower cost the cheapest set has a score beyond the gap whatever it leaves
        noticed = ~fix.answered | (fix.cost > ROW_PRICE - AMBIGUOUS_GAP)
    noticed |= problem.epochs > 1  # a few of many rows go unnoticed by the chi-square of all
    items = np.flatnonzero(noticed & (fix.dof > 0) & ~np.isin(fix.code, _BEYOND))
    conclusion = fill(len(pool), None)
    for own in _group_alike(present[items] > 0.0):
        for item, found in _conclude_pattern(problem, fix, items[own], by, rejected):
            conclusion[item] = found
    stage = Stage("suspects", f"{len(items)} of {len(fix)} contradict themselves", perf_counter() - began)
    return replace(pool, conclusion=conclusion, stages=(*pool.stages, stage))


def _group_alike(present: Array) -> list[Array]:
    """Return the numbers of the problems (N, m) that have the same rows, for each pattern."""
    if not len(present):
        return []
    _, pattern = np.unique(present, axis=0, return_inverse=True)
    return [np.flatnonzero(pattern.reshape(-1) == i) for i in range(int(pattern.max()) + 1)]


def _conclude_pattern(
    problem: Problem, fix: Fix, items: Array, by: Sequence[GroupKind], rejected: Array
) -> Iterator[tuple[int, Conclusion | None]]:
    """Yield what is concluded of problems in which the same rows are present."""
    part = problem.take(items)
    arrivals = as_arrivals(part)
    work = part if arrivals is None else arrivals.problem
    present = np.broadcast_to(work.weight, (len(items), work.count))[0] > 0.0
    groups = groups_of(work, present, by)
    # few sets: all are tried, and nothing masks anything; runs and many groups: one at a time
    if problem.epochs > 1 or not enumerable(groups, work.count, 1):
        findings = [_grow(work, groups, fix, i, item, rejected, None) for i, item in enumerate(items)]
    else:
        findings = explain(work, groups, fix[items])
        # sets that were too many to be tried: group by group from the best that was found
        untried = [not own.rests and own.tried < dof - 1 for own, dof in zip(findings, fix.dof[items], strict=True)]
        for i in np.flatnonzero(untried).tolist():
            more = _grow(work, groups, fix, i, int(items[i]), rejected, findings[i].closest)
            findings[i] = replace(more, p_value=findings[i].p_value | more.p_value)
    for i, finding in enumerate(findings):
        one = None if arrivals is None else replace(arrivals, problem=arrivals.problem.take(np.array([i])))
        yield int(items[i]), conclude_case(Case(part.take(np.array([i])), one, groups, fix[items[i]]), finding)


def _grow(
    problem: Problem, groups: Sequence[Group], fix: Fix, i: int, item: int, rejected: Array, start: Rest | None
) -> Finding:
    """Return what explains the i-th of some problems, that of the fix numbered `item`, found group by group."""
    # the fix is of the problem as given; with arrivals for differences the layout has emission times besides
    one, own = problem.take(np.array([i])), fix[item]
    if own.layout != one.layout or not np.isfinite(own.x).all():
        n = one.layout.n_shared
        known = np.isfinite(own.x[:n]).all()
        near = complete(one, own.x[None, None, :n]) if known else None
        own = (fix_rest(one) if near is None else fix_by(one, lambda _: begin(one, near)))[0]
    mine = rejected[item] if one.count == rejected.shape[1] else np.zeros(one.count, dtype=bool)
    return grow(one, groups, own, mine, start)
