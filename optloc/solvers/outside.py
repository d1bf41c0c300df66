"""Adapters for external solvers and fixes: a fix as a pool, and a solver of fixes as a stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base import linalg
from optloc.base.types import Array, Status
from optloc.problem.claims import Claims, empty_claims, merged_claims
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Stage
from optloc.problem.problem import Problem
from optloc.solvers.pool import Curvature, NoStart, Pool, begin
from optloc.solvers.stages import Solver
from optloc.solvers.verdict.findings import NO_ANSWER, NO_PROOF
from optloc.solvers.verdict.judge import filled_objects, judge, verdict
from optloc.solvers.verdict.minima import settle

FixSolver = Callable[[Problem, Fix | None], Fix]
"""An external solver: it maps a flat batch of problems, and their fixes or None, to fixes."""


def adapt(solver: FixSolver) -> Solver:
    """Return the stage of an external solver: judge the pool, call the solver, and convert the fixes to a pool."""

    def stage(problem: Problem, pool: Pool | None) -> Pool:
        fix = solver(problem, None if pool is None else judge(problem, pool))
        return accept(problem, fix)

    return stage


def given(problem: Problem, start: Any) -> Fix:
    """Return the fixes, not refined, of given starts (N, size) or (N, q, size) of a flat batch."""
    return judge(problem, begin(problem, np.asarray(start, dtype=float)))


def judge_points(problem: Problem, start: Array, x: Array, cost: Array, code: Array, stage: Stage) -> Fix:
    """Return the fixes, with verdicts, at the points that an external solver reached.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    start : array (N, size) or (N, q, size)
        Starts of the solver.
    x : array (N, q, size)
        Final points.
    cost : array (N, q)
        Cost at the final points; infinite where the solver failed.
    code : int array (N, q)
        `Status` that the solver reports.
    stage : Stage
        Description of the solver.
    """
    faces = np.zeros(cost.shape, dtype=int)
    found = replace(begin(problem, start), x=x, cost=cost, code=code.astype(np.int8), face=faces)
    return verdict(problem, settle(problem, found, stage))


def accept(problem: Problem, fix: Fix) -> Pool:
    """Return a pool from fixes of a flat batch; the verdict on this pool is the fixes again.

    Starts stay starts. Some contents of a fix do not follow from its numbers, such as the cause of a missing answer or
    the rows left out. The pool stores these fixes unchanged.
    """
    x = np.concatenate([fix.x[:, None], fix.alternatives.x], axis=1)
    shape = x.shape[:2]
    # unrefined starts need a separate pool: a verdict would treat them as minima
    if np.isnan(fix.cost).all() and (fix.code == Status.UNREFINED).any():
        code = np.full(shape, int(Status.UNAVAILABLE), dtype=np.int8)
        missing = NoStart(np.where(fix.code == Status.UNREFINED, "", fix.reason), fix.code)
        faces, costs = np.zeros(shape, dtype=int), np.full(shape, np.nan)
        return Pool(x, costs, code, faces, fix.weights, fix.dof, fix.stages, missing=missing)
    cost = np.concatenate([fix.cost[:, None], fix.cost[:, None] + fix.alternatives.gap], axis=1)
    # empty slots have infinite gaps
    listed = np.where(np.isfinite(fix.alternatives.gap), int(Status.OK), int(Status.UNAVAILABLE))
    known = np.asarray(np.isfinite(fix.cov).all((-1, -2)))
    # A fix keeps its covariance, not its smallest pivot. The pivot is not needed, since the status does not change.
    covariance = np.where(known[:, None, None], fix.cov, np.eye(fix.cov.shape[-1]))
    information, regular = linalg.inverse(covariance)
    if fix.active is not None:  # zero variance here comes from a constraint, not from missing rows
        constrained = np.flatnonzero(_lengths(fix.active) > 0)
        information[constrained], regular[constrained] = (
            np.linalg.pinv(covariance[constrained], _HELD, hermitian=True),
            True,
        )
    marks = np.zeros(len(fix.code), dtype=int) if fix.marks is None else fix.marks
    searched = (fix.code == Status.SEARCHED) | (marks & Status.SEARCHED.mark != 0)
    robust = marks & Status.ROBUST.mark != 0
    whole = np.array_equal(fix.weights, np.broadcast_to(problem.weight, fix.weights.shape)) and not robust.any()
    verbatim = ~fix.answered if fix.explanations is None else ~fix.answered | (_lengths(fix.explanations) > 0)
    # a rescaled fix has a noise that differs from the problem's
    verbatim = verbatim | (marks & Status.RESCALED.mark != 0)
    return Pool(
        x,
        np.where(np.isfinite(cost), cost, np.inf),
        np.concatenate([np.where(fix.answered, int(Status.OK), fix.code)[:, None], listed], axis=1).astype(np.int8),
        np.zeros(shape, dtype=int),
        fix.weights,
        fix.dof,
        fix.stages,
        refined=True,
        curvature=Curvature(fix.cov, information, known & regular, None, fix.active, fix.local),
        infinity=None if fix.infinity is None else fix.cost + fix.infinity,
        loss="" if whole else "given",
        robust=robust if robust.any() else None,
        searched=searched,
        remark=np.where(fix.code == Status.SEARCHED, fix.reason, ""),
        proven=_claims(fix.claims),
        asked=fix.explanations is not None,
        conclusion=_verbatim(fix, verbatim),
    )


# Variances below this share of the largest variance are rounding errors of zero.
_HELD = 1e-12


def _lengths(explanations: Array) -> Array:
    """Return the lengths (N,) of the tuples in an object array (N,)."""
    return np.array([len(found) for found in explanations], dtype=int)


def _claims(claims: Claims) -> Claims:
    """Return the claims (N,); claims without a proof or an answer are marked as not tried."""
    nothing = (claims.reason == NO_PROOF.reason) | (claims.reason == NO_ANSWER.reason)
    return merged_claims(nothing, empty_claims(len(nothing)), claims)


def _verbatim(fix: Fix, items: Array) -> Array:
    """Return an object array (N,) with the fixes of flagged items, and None for the others."""
    out = filled_objects(len(fix), None)
    for i in np.flatnonzero(items):
        out[i] = fix[int(i)]
    return out
