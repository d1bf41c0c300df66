"""Tests that a robust fix must pass to be `ok`: a proof from the rows with weight, single rows, and repeats.

Letters: N problems, m rows, M changes of rows, `size` numbers of a parameter vector. Rejected rows have a weight below
a quarter of the original one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base import linalg
from optloc.base.types import Array, Status
from optloc.kernels.least_squares import refine
from optloc.linear.evaluate import predict
from optloc.linear.normal import marginal
from optloc.linear.redundancy import degrees_of_freedom
from optloc.model_checks.groups import ROW_PRICE
from optloc.problem.chart import quantile
from optloc.problem.fix import Fix
from optloc.problem.loss import Loss
from optloc.problem.problem import Problem
from optloc.solvers.certificates.admitted import certified
from optloc.solvers.policy import AMBIGUOUS_GAP, P_OUTLIER, REGION_LEVEL, REJECTED
from optloc.solvers.pool import Pool, begin
from optloc.solvers.robust.reweighting import Doubt, reweight, robust_equations
from optloc.solvers.stages import lsr
from optloc.solvers.verdict.findings import is_improbable
from optloc.solvers.verdict.judge import filled_objects, judge, verdict
from optloc.solvers.verdict.repeats import TOLERANCE, Repeats, holds, is_repeatable, repeated

# Largest squared distance, in standard deviations, between the minimum of the loss and the minimum of the rows with
# weight, if both are one answer. With clean data nine in ten are within half of it.
_NEAR = 1.0
# Limits for a change of one row to be another explanation. Without a row the cost must fall by more than _OUT; with a
# rejected row taken back it must rise by less than _BACK. A search for suspects has the same limits.
_OUT, _BACK = ROW_PRICE - AMBIGUOUS_GAP, ROW_PRICE + AMBIGUOUS_GAP
# Most rows for which each row is left out in turn: with more rows a single one rarely decides, and the time grows with
# the square.
_ROWS = 64
# Rows of changed problems that are refined together: 10 MB.
_TOGETHER = 2**12
# Most updates of the weights for a repeated measurement, which starts at its true position: ten more updates change no
# ellipse that covers.
_WEIGHINGS = 10

SEARCHED = "a search found the minima of the loss; there is no proof"
NEEDS = "robust fixes are tested for one target at rest without constraints, with at most 64 rows"


def check_minima(problem: Problem, loss: Loss, pool: Pool) -> Pool:
    """Return settled pools of a loss with flags of the minima that pass all tests, and reasons for the others.

    Parameters
    ----------
    problem : Problem
        N problems.
    loss : Loss
        The minimised loss.
    pool : Pool
        Settled, after a search from all starts.
    """
    curvature, count = pool.curvature, len(pool)
    assert curvature is not None
    kept, remark = np.zeros(count, dtype=bool), filled_objects(count, SEARCHED)
    pool = replace(pool, robust=kept, remark=remark)
    if problem.constraints or problem.count > _ROWS or not is_repeatable(problem):
        return replace(pool, remark=filled_objects(count, NEEDS))
    fix = judge(problem, pool)
    present = np.broadcast_to(problem.weight, pool.weights.shape) > 0.0
    doubted = present & (pool.weights < REJECTED * problem.weight)
    rejected_count = doubted.sum(1)
    redundancy = degrees_of_freedom(problem.with_rows(weight=np.where(doubted, 0.0, problem.weight)))
    unrivalled = fix.answered & ~fix.has(Status.AMBIGUOUS, Status.UNBOUNDED, Status.CONTRADICTORY)
    # the rows with weight must name the doubted rows, and one more row must show if another choice exists
    checked = redundancy > rejected_count
    for i in np.flatnonzero(unrivalled & ~checked):
        remark[i] = (
            f"redundancy {redundancy[i]} without {rejected_count[i]} rejected rows "
            "is too small to exclude another choice of rows"
        )
    items = np.flatnonzero(unrivalled & checked)
    if not len(items):
        return pool
    part, out = problem.take(items), doubted[items]
    good, reasons, repeats = _examine(part, loss, fix.x[items], out)
    kept[items], remark[items] = good, reasons
    found = np.full((count, 3), np.nan)
    found[items] = repeats
    return replace(pool, curvature=replace(curvature, repeats=found))


def _examine(problem: Problem, loss: Loss, x: Array, doubted: Array) -> tuple[Array, Array, Array]:
    """Return flags (N,) of fixes that pass, reasons (N,) of the others, and results of repeats (N, 3).

    `x` (N, size) are the minima of the loss, and `doubted` (N, m) flags the rejected rows. The numbers of the repeats
    are as in `Curvature.repeats`; NaN if a fix failed before.
    """
    rest = problem.with_rows(weight=np.where(doubted, 0.0, problem.weight))
    fix = verdict(rest, certified(rest, lsr(rest, begin(rest, x))))
    reason, repeats = filled_objects(len(x), ""), np.full((len(x), 3), np.nan)
    good = fix.code == Status.OK
    for i in np.flatnonzero(~good):
        reason[i] = f"the rows with weight do not prove the position: {fix[int(i)].status.label}"
    # if the loss rejects too few of the wrong rows, the other rows hardly fit
    poor = good & doubted.any(1) & is_improbable(fix.cost, fix.dof, P_OUTLIER)
    reason[poor] = "the rows with weight hardly agree: p is below 0.01"
    good &= ~poor
    apart = _squared(fix, x - fix.x)
    far = good & ~(apart <= _NEAR)
    reason[far] = "the rows with weight have another minimum: rows with reduced weight still shift the fix"
    good &= ~far
    items = np.flatnonzero(good)
    single = items[_decides(problem.take(items), fix[items], doubted[items])]
    reason[single] = "a single measurement decides: the position with it differs from the position without it"
    good[single] = False
    items = np.flatnonzero(good)
    if len(items):
        repeats[items] = _repeat(problem.take(items), loss, fix[items], doubted[items])
        covered = holds(repeats)
        reason[good & ~covered] = "the ellipses of simulated repeats do not cover the true positions"
        good &= covered
    return good, reason, repeats


def _squared(fix: Fix, step: Array) -> Array:
    """Return squared lengths (N,) of steps (N, size) in standard deviations of fixes, for the shared unknowns only.

    A squared length is step' covariance^-1 step.
    """
    n = fix.cov.shape[-1]
    with np.errstate(all="ignore"):
        return np.asarray((step[:, :n] * linalg.solve(fix.cov, step[:, :n, None])[0][..., 0]).sum(-1))


def _decides(problem: Problem, fix: Fix, doubted: Array) -> Array:
    """Return flags (N,) of problems in which one row more or less is another explanation with another position.

    Each row is left out or taken back separately, and each rejected row is exchanged with each other row.

    Parameters
    ----------
    problem : Problem
        N problems with all rows.
    fix : Fix
        Fixes of the rows with weight.
    doubted : bool array (N, m)
        The rejected rows.
    """
    item, change, limit = _changes(np.broadcast_to(problem.weight, doubted.shape) > 0.0, doubted)
    out = np.zeros(len(doubted), dtype=bool)
    step = max(1, _TOGETHER // problem.count)
    for first in range(0, len(item), step):
        numbers, chunk = item[first : first + step], slice(first, first + step)
        part = problem.take(numbers)
        part = part.with_rows(weight=np.where(doubted[numbers] ^ change[chunk], 0.0, part.weight))
        with np.errstate(all="ignore"):
            done = refine(part, fix.x[numbers])
            as_good = (done.cost - fix.cost[numbers] < limit[chunk]) & (done.status == Status.OK)
        moved = _squared_position(problem, fix[numbers], done.x - fix.x[numbers])
        out[numbers[as_good & ~(moved <= quantile(REGION_LEVEL, problem.dimension))]] = True
    return out


def _changes(present: Array, doubted: Array) -> tuple[Array, Array, Array]:
    """Return the problem (M,) of each change, flags (M, m) of its rows, and the limit (M,) of the rise of the cost.

    A changed row is left out, or taken back if it is rejected. If the cost rises by less than the limit, the change is
    another explanation. `present` and `doubted` (N, m) flag rows with weight before the loss and rejected rows.
    """
    item, row = np.nonzero(present)
    change = np.zeros((len(item), present.shape[1]), dtype=bool)
    change[np.arange(len(item)), row] = True
    limit = np.where(doubted[item, row], _BACK, -_OUT)
    swapped, taken_back, left_out = np.nonzero(doubted[:, :, None] & (present & ~doubted)[:, None, :])
    more = np.zeros((len(swapped), present.shape[1]), dtype=bool)
    more[np.arange(len(swapped)), taken_back] = more[np.arange(len(swapped)), left_out] = True
    # an exchange leaves out equally many rows, so the costs alone decide
    limits = np.concatenate([limit, np.full(len(swapped), AMBIGUOUS_GAP)])
    return np.concatenate([item, swapped]), np.concatenate([change, more]), limits


def _squared_position(problem: Problem, fix: Fix, step: Array) -> Array:
    """Return squared lengths (N,) of position steps, in standard deviations of fixes, from steps (N, size)."""
    slot, _ = problem.layout.find("position")
    where = slice(slot.start, slot.start + slot.size)
    with np.errstate(all="ignore"):
        solved = linalg.solve(fix.cov[:, where, where], step[:, where, None])[0][..., 0]
        return np.asarray((step[:, where] * solved).sum(-1))


def _repeat(problem: Problem, loss: Loss, fix: Fix, doubted: Array) -> Array:
    """Return two shares of repeats of the loss whose ellipses contain the truth, and an inflation, (N, 3).

    See `Curvature.repeats`. The rows flagged in `doubted` (N, m) keep their residuals in all repeats.
    """
    z = np.where(doubted, problem.observed - predict(problem, fix.x), 0.0)
    return repeated(problem, fix.x, fix.cov, lambda many, truth: _refit(many, loss, truth), z)


def _refit(problem: Problem, loss: Loss, truth: Array) -> Repeats:
    """Return the minima of a loss next to true vectors (N, size), with covariances and flags of valid results."""
    doubt = Doubt.of(problem, truth)
    done = reweight(problem, truth, loss, doubt, limit=_WEIGHINGS, tolerance=TOLERANCE)
    information, _, ok = marginal(robust_equations(loss, problem, doubt, done.x, done.weight))
    spread, regular = linalg.inverse(information)
    return Repeats(done.x, spread, ok & regular & np.isin(done.status, (Status.OK, Status.MAX_ITERATIONS)))
