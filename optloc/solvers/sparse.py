"""The stage "sparse": starts and suspected rows from a convex program that allows gross errors in a few rows.

Letters: N problems, m rows, d coordinates. Module `optloc.solvers.starts.sparse_rows` builds the programs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from scipy.special import ndtri

from optloc.base import linalg
from optloc.base.types import Array
from optloc.linear.mirror import one_position
from optloc.linear.redundancy import present_unknowns
from optloc.linear.vectors import problem_at_rest, vectors
from optloc.problem.arrival_times import as_arrivals
from optloc.problem.problem import Problem
from optloc.solvers.pool import Pool, begin, offer, pack
from optloc.solvers.stages import explain_absence, fix_by, gtrs, lsr
from optloc.solvers.starts.several_positions import from_pieces
from optloc.solvers.starts.sparse_rows import derivatives, deviations, lift_positions, linearise_sparse
from optloc.solvers.verdict.judge import judge

# A row is in error if noise makes the greatest of all residuals this large with at most this probability. Clean data
# lose a row once in a hundred cases (docs/measured/sparse.md).
_LEVEL = 0.01
# Most tests of the rows, each with the fix of the rows that passed the test before. Usually the second test confirms
# the first. The limit ends cycles of two sets that lead to each other.
_PASSES = 8
# Variance of a residual, in units of the variance of its row, below which the row is not checked: rounding of 1 - J C
# J'.
_UNCHECKED = 1e-6


# The programs, and the test of the rows that they suspect.


@dataclass(frozen=True, slots=True)
class SparseErrors:
    """Results of the convex programs for a flat batch of N problems of one position.

    Parameters
    ----------
    position : array (N, 2, d)
        Point of the last program, and the fix without the rows in error; NaN without a solution.
    raw : bool array (N, m)
        Support of the last program: rows whose gross error is not zero.
    wrong : bool array (N, m)
        Rows in error after the test of the fix without them.
    """

    position: Array
    raw: Array
    wrong: Array


def sparse(problem: Problem, pool: Pool | None) -> Pool:
    """Return two starts: the point of the convex program with sparse errors, and the fix without the rows in error.

    With fewer than about ten stations this is only a start: the penalty on the sizes of the errors then often hides the
    wrong rows. Use a search for suspects instead.
    """
    return explain_absence(problem, _starts(problem, pool), "sparse")


def _starts(problem: Problem, pool: Pool | None) -> Pool:
    """Return the starts of `sparse`, without reasons for missing starts."""
    began = perf_counter()
    if not one_position(problem):
        x = from_pieces(problem, lambda piece: fix_by(piece, lambda one: _starts(one, None)))
        return offer(problem, x, pool, "sparse", began)
    alone = problem_at_rest(problem)
    arrived = as_arrivals(alone)
    found = sparse_errors(alone if arrived is None else arrived.problem)
    # a wrong arrival is part of all differences that contain it
    wrong = found.wrong if arrived is None else spread_rows(found.wrong, arrived.origin, problem.count)
    weights = np.where(wrong, 0.0, problem.weight)
    x = vectors(problem.with_rows(weight=weights), pack(found.position))  # emission times fit the rows that are kept
    start = offer(problem, x, pool, "sparse", began)
    stage = replace(start.stages[-1], detail=f"{int(found.wrong.sum(1).max(initial=0))} wrong rows at most")
    return replace(start, weights=weights, stages=(*start.stages[:-1], stage))


def spread_rows(wrong: Array, origin: Sequence[Array], count: int) -> Array:
    """Return flags (N, count) of rows that contain a wrong arrival time (`optloc.problem.arrival_times`).

    `wrong` (N, m) flags the m arrival times, and `origin` lists the rows of each.
    """
    out = np.zeros((len(wrong), count), dtype=bool)
    for i, rows in enumerate(origin):
        out[:, rows] |= wrong[:, i, None]
    return out


def sparse_errors(problem: Problem) -> SparseErrors:
    """Return positions and suspected rows of a flat batch of problems with one static target.

    Three programs run in turn: with the squared rows, with the squared rows weighted by the ranges to the first
    solution, and with the rows linearised at the second solution. Then the support is tested: its rows are left out,
    the other rows are fixed, and each row gets a test. A row is in error if noise makes the greatest of all residuals
    this large with a probability of at most 1 %.

    Parameters
    ----------
    problem : Problem
        N problems.
    """
    position, failed = lift_positions(problem, _closed_form)
    x = vectors(problem, position[:, None])[:, 0]
    x, raw, unsolved = linearise_sparse(problem, x)
    start = problem.layout.take(x, "position")
    fixed, wrong = _test_support(problem, x, raw)
    # if a program fails, its fix and its rows are not tested, so all results are dropped
    failed |= unsolved
    found = np.where(failed[:, None, None], np.nan, np.stack([start, fixed], axis=1))
    return SparseErrors(found, raw & ~failed[:, None], wrong & ~failed[:, None])


def _closed_form(problem: Problem) -> Array:
    """Return the positions (N, d) of the closed form of all rows, metres."""
    return problem.layout.take(gtrs(problem, None).x[:, 0], "position")


def _test_support(problem: Problem, x: Array, wrong: Array) -> tuple[Array, Array]:
    """Return the positions (N, d) of the fixes without the rows in error, metres, and flags (N, m) of these rows.

    `x` (N, size) are the first fixes, and `wrong` (N, m) flags the suspected rows.
    """
    present = np.broadcast_to(problem.weight > 0.0, wrong.shape)
    # two-sided, for the greatest of m rows: Bonferroni
    limit = -ndtri(0.5 * _LEVEL / np.maximum(present.sum(1, keepdims=True), 1))
    wrong, active = wrong.copy(), np.arange(len(x))
    x = x.copy()
    # If the support leaves too few rows for a fix, only its first rows are left out. All sizes are equal here.
    wrong = _spare(problem, wrong.astype(float), wrong)
    for _ in range(_PASSES):
        part, left_out = problem.take(active), wrong[active]
        rest = part.with_rows(weight=np.where(left_out, 0.0, part.weight))
        # the other rows have a closed form that the wrong rows have not biased
        starts = np.stack([x[active], gtrs(rest, None).x[:, 0]], axis=1)
        fixed = judge(rest, lsr(rest, begin(rest, starts))).x
        x[active] = np.where(np.isfinite(fixed), fixed, x[active])
        size = _standardise(part, x[active], ~left_out & present[active])
        now_wrong = _spare(part, size, size > limit[active])
        changed = (now_wrong != left_out).any(1) & np.isfinite(fixed).all(1)
        wrong[active[changed]] = now_wrong[changed]
        active = active[changed]
        if not len(active):
            break
    return problem.layout.take(x, "position"), wrong


def _spare(problem: Problem, size: Array, wrong: Array) -> Array:
    """Return flags (N, m) of the rows in error that may be left out: the largest ones.

    `size` (N, m) orders the rows in error `wrong` (N, m). One row more than unknowns must remain.
    """
    present = np.broadcast_to(problem.weight > 0.0, wrong.shape)
    most = np.maximum(present.sum(1, keepdims=True) - present_unknowns(problem)[:, None] - 1, 0)
    # argsort of argsort is the rank: 0 for the largest
    rank = np.argsort(np.argsort(-np.where(wrong, size, -np.inf), axis=1, kind="stable"), axis=1)
    return np.asarray(wrong & (rank < most))


def _standardise(problem: Problem, x: Array, kept: Array) -> Array:
    """Return absolute residuals (N, m) at the fix of the rows kept, divided by their standard deviations.

    The residual of a row in the fix has the variance s^2 - J C J', the residual of a row left out s^2 + J C J'. Here s
    is the standard deviation of the row, J its derivatives, and C the covariance of the fix. A row that the fix always
    fits has the result 0. `kept` (N, m) flags the rows in the fix.
    """
    residual, jacobian = derivatives(problem, x)
    sigma = deviations(problem)
    residual, white = residual / sigma, jacobian / sigma[..., None]
    inside = np.where(kept[..., None], white, 0.0)
    information = np.swapaxes(inside, -1, -2) @ inside
    # for unknowns without a kept row, a one on the diagonal keeps the matrix invertible and changes nothing else
    idle = np.einsum("nii->ni", information) == 0.0
    covariance, _ = linalg.inverse(information + idle[..., None] * np.eye(idle.shape[-1]))
    lever = np.einsum("nmi,nij,nmj->nm", white, covariance, white)
    variance = np.where(kept, 1.0 - lever, 1.0 + lever)
    with np.errstate(invalid="ignore"):
        checked = variance > _UNCHECKED  # a row without redundancy fits with any error
    return np.where(checked, np.abs(residual) / np.sqrt(np.where(checked, variance, 1.0)), 0.0)
