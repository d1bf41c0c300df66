"""The verdict: the only place where a pool becomes a fix, so that a status means the same whatever the method."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base.records import overwrite, present, take
from optloc.base.status import Certificate, Status
from optloc.base.types import Array
from optloc.problem.fix import Alternatives, Fix
from optloc.problem.problem import Problem
from optloc.solvers.pool import Curvature, Pool
from optloc.solvers.verdict.conclusion import conclude
from optloc.solvers.verdict.status import LOCAL, doubt_sentence, doubtful, fill, rule

_EPOCHS_SHOWN = 8  # epochs that a sentence names


def judge(problem: Problem, pool: Pool) -> Fix:
    """Return the fixes of a flat batch of problems.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Their candidates; starts that nobody has refined get the status `unavailable`.
    """
    if pool.curvature is None:
        return _show_starts(problem, pool)
    fix = _plain(problem, pool, pool.curvature)
    # rules cost more than a compiled fix: they are asked only where something stands against one
    if pool.plain is None:
        fix = _apply_rules(problem, pool, fix)
    elif not pool.plain.all():
        items = np.flatnonzero(~pool.plain)
        fix = overwrite(fix, items, _apply_rules(problem.take(items), take(pool, items), fix[items]))
    if pool.conclusion is not None:
        for i in np.flatnonzero(present(pool.conclusion)):
            told = pool.conclusion[i]
            own = told.reshape((1,)) if isinstance(told, Fix) else conclude(problem.take(np.array([i])), told)
            fix = overwrite(fix, np.array([i]), own)
    return fix


def standing(pool: Pool, fix: Fix) -> Array:
    """Return the candidates (N, q, size) of a pool that its verdict lets stand: those without a position are NaN."""
    if pool.curvature is None:
        return pool.x
    best = np.where(np.isnan(fix.x).all(-1, keepdims=True), np.nan, pool.x[:, 0])
    return np.concatenate([best[:, None], pool.x[:, 1:]], axis=1)


def _plain(problem: Problem, pool: Pool, curvature: Curvature) -> Fix:
    """Return the fixes of pools as if nothing stood against their best candidates."""
    count, cost = len(pool), pool.cost[:, 0]
    reason = fill(count, "")
    if pool.plain is not None:
        p_value = doubtful(cost, pool.dof)
        for i in np.flatnonzero(np.isfinite(p_value) & pool.plain):
            reason[i] = doubt_sentence(p_value[i])
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(pool.cost[:, 1:]), pool.cost[:, 1:] - cost[:, None], np.inf)
    return Fix(
        pool.x[:, 0],
        curvature.covariance,
        problem.layout,
        problem.frame,
        np.full(count, int(Status.OK), dtype=np.int8),
        reason,
        _claims(pool),
        Alternatives(pool.x[:, 1:], gap),
        cost,
        pool.dof,
        pool.weights,
        pool.stages,
        fill(count, ()) if curvature.active is None else curvature.active,
        curvature.local,
        fill(count, ()) if pool.asked else None,
    )


def _claims(pool: Pool) -> Array:
    """Return the certificates (N,) of refined answers: what was proven of them, or that they are minima."""
    local = fill(len(pool), LOCAL)
    if pool.certificate is None:
        return local
    return np.where(present(pool.certificate), pool.certificate, local)


def _apply_rules(problem: Problem, pool: Pool, fix: Fix) -> Fix:
    """Return the fixes with the statuses of the rules."""
    ruling = rule(problem, pool, fix.alternatives.gap)
    assert pool.curvature is not None
    regular = pool.curvature.regular
    unknown = ruling.gone if regular is None else ruling.gone | ~regular
    return replace(
        fix,
        x=np.where(ruling.gone[:, None], np.nan, fix.x),
        cov=np.where(unknown[:, None, None], np.nan, fix.cov),
        code=ruling.code,
        reason=ruling.reason,
        certificate=ruling.certificate,
        cost=np.where(np.isfinite(fix.cost), fix.cost, np.nan),
    )


def _show_starts(problem: Problem, pool: Pool) -> Fix:
    """Return starts as fixes whose status says that they are not refined."""
    count, n = len(pool), problem.layout.n_shared
    name = pool.stages[-1].name if pool.stages else "start"
    return Fix(
        pool.x[:, 0],
        np.full((count, n, n), np.nan),
        problem.layout,
        problem.frame,
        np.full(count, int(Status.UNAVAILABLE), dtype=np.int8),
        fill(count, "not refined"),
        fill(count, Certificate("unknown", "a start, not refined", name)),
        Alternatives(pool.x[:, 1:], np.full((count, pool.x.shape[1] - 1), np.nan)),
        np.full(count, np.nan),
        pool.dof,
        pool.weights,
        pool.stages,
    )


def hide_open_epochs(fix: Fix) -> Fix:
    """Return the fixes of runs without the states of epochs that leave them open: NaN, and named in the reason."""
    if fix.local is None or not fix.answered.any():
        return fix
    size = fix.local.shape[-1]
    undone = np.isnan(np.diagonal(fix.local, axis1=-2, axis2=-1)).any(-1) & fix.answered[..., None]
    if not undone.any():
        return fix
    x, reason = fix.x.copy(), fix.reason.copy()
    n, length = fix.layout.n_shared, fix.layout.n_local
    states = x[..., n:].reshape(*undone.shape, length)
    states[undone, :size] = np.nan
    for i in np.ndindex(reason.shape):
        where = np.flatnonzero(undone[i])
        if len(where):
            shown = ", ".join(map(str, where[:_EPOCHS_SHOWN])) + (" ..." if len(where) > _EPOCHS_SHOWN else "")
            left = f"{len(where)} of {undone.shape[-1]} epochs do not place their targets: {shown}"
            reason[i] = f"{reason[i]}; {left}" if reason[i] else left
    x[..., n:] = states.reshape(*x.shape[:-1], -1)
    return replace(fix, x=x, reason=reason)
