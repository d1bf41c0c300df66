"""The status that the numbers of a fix deserve, and why, in a sentence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base.status import Certificate, Status
from optloc.base.types import Array
from optloc.bounds.observability import open_sentences
from optloc.linear.constraints import violation_names
from optloc.models import MODELS
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers.policy import AMBIGUOUS_GAP, DOUBT, FAR, FLAT
from optloc.solvers.starts.least_squares_ranges import ranges
from optloc.solvers.starts.position import distance_of, spread_of
from optloc.solvers.verdict.curvature import Curvature, station_direction, weak_direction

_EQUAL = 1e-3
_WEAK = 1e-12
_SHOWN = 8

_UNKNOWN = Certificate("unknown", "there is no refined answer to prove anything about", "none")


def explain(problem: Problem, fix: Fix, curvature: Curvature) -> None:
    """Settle the status of every fix and say why; writes into the fresh arrays of `fix`."""
    finite = np.isfinite(problem.z) | (problem.weight == 0.0)
    broken = ~np.broadcast_to(finite.all(-1), fix.code.shape)
    few = (fix.dof < 0) & ~broken
    missing = ~np.isfinite(fix.cost) & ~broken & ~few
    answered = ~(broken | few | missing)
    weak = answered & ~(curvature.regular & (curvature.weakest >= _WEAK))
    distance = distance_of(problem, _position(problem, fix))
    with np.errstate(invalid="ignore"):
        loose = np.trace(fix.cov, axis1=-2, axis2=-1) > (distance * spread_of(problem)[1]) ** 2
        lost = weak | loose | (fix.code != Status.OK) | (fix.p_value < DOUBT)
        far = answered & ((lost & (distance > FAR)) | (distance > FLAT))
    weak &= ~far
    fix.code[broken], fix.code[few], fix.code[far] = Status.REJECTED, Status.TOO_FEW_ROWS, Status.UNBOUNDED
    fix.code[weak] = Status.SINGULAR_GEOMETRY
    gap = np.min(fix.alternatives.gap, axis=1, initial=np.inf)
    fix.code[(fix.code == Status.OK) & (gap < AMBIGUOUS_GAP)] = Status.AMBIGUOUS
    doubt(fix, np.flatnonzero((fix.code == Status.OK) & (fix.p_value < DOUBT)))
    for i in np.flatnonzero(few):
        lacking = -int(fix.dof[i])
        some = "is 1 measurement" if lacking == 1 else f"are {lacking} measurements"
        fix.reason[i] = f"there {some} fewer than unknowns"
    for i in np.flatnonzero(answered & np.isin(fix.code, (Status.UNBOUNDED, Status.MAX_ITERATIONS, Status.STALLED))):
        fix.reason[i] = f"the refinement stopped {distance[i]:.3g} spreads of the stations away"
    for i in np.flatnonzero(weak):
        fix.reason[i] = _open(problem, curvature.information[i])
    for i in np.flatnonzero(fix.code == Status.AMBIGUOUS):
        alike = gap[i] < _EQUAL
        fix.reason[i] = "another position " + ("fits as well" if alike else f"costs only {gap[i]:.2g} more")
        if problem.epochs > 1 and any(motion.order > 0 for motion in problem.motions):
            fix.reason[i] += ": a bound on height, speed or place would decide"
    barred = missing & (fix.code == Status.INFEASIBLE)
    for i in np.flatnonzero(barred):
        names = violation_names(problem)
        fix.reason[i] = (
            f"no minimum meets all of: {names}" if names else "the Earth hides every position from a satellite"
        )
    missing = missing & ~barred
    if missing.any():
        _explain_missing(problem, fix, np.flatnonzero(missing))
    unsure = ~np.isin(fix.code, (Status.OK, Status.AMBIGUOUS))
    fix.certificate[unsure] = _UNKNOWN
    gone = broken | few | missing | barred | weak | far
    fix.x[gone] = np.nan
    fix.cov[gone] = np.nan


def doubt(fix: Fix, items: Array) -> None:
    """Say of those items of which it is so that the noise does not allow their residuals; writes into `fix.reason`."""
    for i, p_value in zip(items, fix[items].p_value, strict=True):
        if p_value < DOUBT:
            fix.reason[i] = f"the residuals are larger than the noise allows (p = {p_value:.1g})"


def without_open_epochs(fix: Fix) -> Fix:
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
            shown = ", ".join(str(k) for k in where[:_SHOWN]) + (" ..." if len(where) > _SHOWN else "")
            left = f"{len(where)} of {undone.shape[-1]} epochs do not place their targets: {shown}"
            reason[i] = f"{reason[i]}; {left}" if reason[i] else left
    x[..., n:] = states.reshape(*x.shape[:-1], -1)
    return replace(fix, x=x, reason=reason)


def _open(problem: Problem, information: Array) -> str:
    """Return what the data leave open: combinations of biases by name, else the direction of the position."""
    named = open_sentences(problem.layout, information) if problem.biases and np.isfinite(information).all() else ()
    return "; ".join(named) or weak_direction(problem, information)


def _explain_missing(problem: Problem, fix: Fix, items: Array) -> None:
    single = problem.epochs == 1 or problem.stations.position.shape[-3] == 1
    found = ranges(problem.take(items)) if single else None
    for place, i in enumerate(items):
        groups = () if found is None else found.groups[int(found.pattern[place])]
        if len(groups) > 1:
            names = problem.stations.names
            fix.code[i] = Status.DISCONNECTED
            fix.reason[i] = "no row links " + " with ".join(
                "{" + ", ".join(names[s] for s in sorted(set(group))) + "}" for group in groups
            )
        elif not any(MODELS[rows.kind].ranges or MODELS[rows.kind].lifted for rows in problem.rows):
            fix.code[i] = Status.UNAVAILABLE
            fix.reason[i] = "no closed form starts from " + " and ".join(rows.kind for rows in problem.rows)
        else:
            fix.code[i] = Status.SINGULAR_GEOMETRY
            one = problem.take(np.array([i]))
            fix.reason[i] = _short(one) or station_direction(one)


def _short(problem: Problem) -> str:
    """Return a sentence that names the targets of a single problem with fewer rows than their states need."""
    lacking = []
    target = np.concatenate([rows.target for rows in problem.rows])
    for i, motion in enumerate(problem.motions):
        rows = int(((target == i) & (problem.weight[0] > 0.0)).sum())
        needed = (motion.order + 1) * problem.dimension
        if motion.known is None and motion.span == "run" and rows < needed:
            lacking.append(f"target {i} has {rows} measurement{'' if rows == 1 else 's'} for {needed} unknowns")
    return "; ".join(lacking[:_SHOWN]) if len(problem.motions) > 1 else ""


def _position(problem: Problem, fix: Fix) -> Array:
    """Return the position (N, d) of the only target, or the centre of the stations where there is no such thing."""
    if any(slot.name == "position" for slot in problem.layout.shared):
        return fix.position
    return np.broadcast_to(spread_of(problem)[0], (len(fix.x), problem.dimension))
