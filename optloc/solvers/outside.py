"""What comes from outside: fixes as pools, and solvers that take and return fixes as stages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base import linalg
from optloc.base.types import Array, Status
from optloc.problem.claims import Claims, empty_claims, merged_claims
from optloc.problem.fix import Fix, Stage
from optloc.problem.problem import Problem
from optloc.solvers.pool import Curvature, NoStart, Pool, begin
from optloc.solvers.stages import Solver
from optloc.solvers.verdict.findings import NO_ANSWER, NO_PROOF
from optloc.solvers.verdict.judge import filled_objects, judge, verdict
from optloc.solvers.verdict.minima import settle

FixSolver = Callable[[Problem, Fix | None], Fix]
"""A solver as others write it: it maps a flat batch of problems, and their fixes or None, to fixes."""


def adapt(solver: FixSolver) -> Solver:
    """Return a solver of others as a stage."""

    def stage(problem: Problem, pool: Pool | None) -> Pool:
        fix = solver(problem, None if pool is None else judge(problem, pool))
        return accept(problem, fix)

    return stage


def given(problem: Problem, start: Any) -> Fix:
    """Return given starts (N, size) or (N, q, size) of a flat batch as fixes that nobody has refined."""
    return judge(problem, begin(problem, np.asarray(start, dtype=float)))


def judge_points(problem: Problem, start: Array, x: Array, cost: Array, code: Array, stage: Stage) -> Fix:
    """Return the verdict on points that a solver of others has reached.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    start : array (N, size) or (N, q, size)
        Where it began.
    x : array (N, q, size)
        Where it ended.
    cost : array (N, q)
        Cost there; infinite where it ended nowhere.
    code : int array (N, q)
        `Status` that it claims.
    stage : Stage
        What it did.
    """
    faces = np.zeros(cost.shape, dtype=int)
    found = replace(begin(problem, start), x=x, cost=cost, code=code.astype(np.int8), face=faces)
    return verdict(problem, settle(problem, found, stage))


def accept(problem: Problem, fix: Fix) -> Pool:
    """Return fixes of a flat batch as a pool whose verdict they are.

    Starts stay starts. What a verdict cannot find in the numbers of a fix (why there is no answer, what was left out)
    is taken over word for word.
    """
    x = np.concatenate([fix.x[:, None], fix.alternatives.x], axis=1)
    shape = x.shape[:2]
    # nobody has refined them: a verdict would call them minima
    if np.isnan(fix.cost).all() and (fix.code == Status.UNREFINED).any():
        code = np.full(shape, int(Status.UNAVAILABLE), dtype=np.int8)
        missing = NoStart(np.where(fix.code == Status.UNREFINED, "", fix.reason), fix.code)
        faces, costs = np.zeros(shape, dtype=int), np.full(shape, np.nan)
        return Pool(x, costs, code, faces, fix.weights, fix.dof, fix.stages, missing=missing)
    cost = np.concatenate([fix.cost[:, None], fix.cost[:, None] + fix.alternatives.gap], axis=1)
    # empty slots have infinite gaps
    listed = np.where(np.isfinite(fix.alternatives.gap), int(Status.OK), int(Status.UNAVAILABLE))
    known = np.asarray(np.isfinite(fix.cov).all((-1, -2)))
    # a fix keeps its covariance alone: what is weak is not known of it, and not needed, as its verdict stands
    covariance = np.where(known[:, None, None], fix.cov, np.eye(fix.cov.shape[-1]))
    information, regular = linalg.inverse(covariance)
    if fix.active is not None:  # what constraints hold has no variance: that is no sign of rows that leave it open
        held = np.flatnonzero(_lengths(fix.active) > 0)
        information[held], regular[held] = np.linalg.pinv(covariance[held], _HELD, hermitian=True), True
    marks = np.zeros(len(fix.code), dtype=int) if fix.marks is None else fix.marks
    searched = (fix.code == Status.SEARCHED) | (marks & Status.SEARCHED.mark != 0)
    robust = marks & Status.ROBUST.mark != 0
    whole = np.array_equal(fix.weights, np.broadcast_to(problem.weight, fix.weights.shape)) and not robust.any()
    verbatim = ~fix.answered if fix.explanations is None else ~fix.answered | (_lengths(fix.explanations) > 0)
    # it has another noise than the problem
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


# Share of the largest variance below which one is the rounding of none.
_HELD = 1e-12


def _lengths(explanations: Array) -> Array:
    return np.array([len(found) for found in explanations], dtype=int)


def _claims(claims: Claims) -> Claims:
    """Return claims of which those that say nothing are as if nobody had tried."""
    nothing = (claims.reason == NO_PROOF.reason) | (claims.reason == NO_ANSWER.reason)
    return merged_claims(nothing, empty_claims(len(nothing)), claims)


def _verbatim(fix: Fix, items: Array) -> Array:
    out = filled_objects(len(fix), None)
    for i in np.flatnonzero(items):
        out[i] = fix[int(i)]
    return out
