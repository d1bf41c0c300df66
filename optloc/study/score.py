"""What is written about the fixes of trials: errors against truth and bound, consistency, cost, certificate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc import linalg
from optloc.bounds import crlb
from optloc.constraints import exact
from optloc.equations import equations_at
from optloc.fix import Fix
from optloc.normal import covariance, eliminated
from optloc.problem import Problem
from optloc.status import Status
from optloc.study.cases import Case
from optloc.study.draws import Drawn
from optloc.types import Array

Values = dict[str, Any]
"""Columns of some trials: arrays (n,), or one value for all."""


@dataclass(frozen=True, slots=True)
class Exact:
    """What holds for trials whatever the method.

    Parameters
    ----------
    drawn : Drawn
        The trials.
    bound : array (n, p, p)
        Cramer-Rao bound of the shared unknowns at the truth; NaN where the geometry is singular.
    cost : array (n,)
        Cost at the truth.
    """

    drawn: Drawn
    bound: Array
    cost: Array


def exact_of(drawn: Drawn) -> Exact:
    """Return bound and cost at the truth of trials."""
    problem, size = drawn.problem, len(drawn.truth)
    with np.errstate(all="ignore"):
        equations = equations_at(problem, drawn.truth)
        bound = crlb(problem, drawn.truth) if exact(problem) else covariance(equations)[0]
        cost = eliminated(equations).cost
    return Exact(drawn, np.broadcast_to(bound, (size, *bound.shape[-2:])), np.broadcast_to(cost, (size,)))


def truth_values(case: Case, known: Exact) -> Values:
    """Return the columns that do not depend on the method."""
    problem, truth = known.drawn.problem, known.drawn.truth
    names = case.state
    place = _take(problem, truth, names[0])
    values: Values = {f"truth_{axis}": _component(place, i) for i, axis in enumerate("xyz")}
    values["outliers"] = known.drawn.bad
    values |= {"crlb": _root_trace(_block(problem, known.bound, names[0])), "cost_truth": known.cost}
    moving = len(names) > 1
    values["crlb_velocity"] = _root_trace(_block(problem, known.bound, names[1])) if moving else np.nan
    entries = _lengths(problem)
    variance = np.diagonal(known.bound, axis1=-2, axis2=-1)[:, entries]
    values["crlb_bias"] = np.sqrt(variance.mean(-1)) if len(entries) else np.nan
    return values


def fix_values(case: Case, known: Exact, fix: Fix) -> Values:
    """Return the columns of fixes (n,) of trials."""
    problem, truth, names = known.drawn.problem, known.drawn.truth, case.state
    size = len(truth)
    x = np.where(np.isfinite(fix.x).all(-1, keepdims=True), fix.x, np.nan)
    error = _take(problem, x - truth, names[0])
    claimed = _block(problem, fix.cov, names[0])
    values: Values = {f"error_{axis}": _component(error, i) for i, axis in enumerate("xyz")}
    values |= {
        "answered": fix.answered,
        "located": np.asarray(np.isfinite(error).all(-1)),
        "error": np.linalg.norm(error, axis=-1),
        "error_nearest": _nearest(problem, fix, truth, names[0], error),
        "deviation": np.sqrt(_squared(error, _block(problem, known.bound, names[0]))),
        "sigma": _root_trace(claimed),
        "nees": _squared(error, claimed),
        "cost": _cost(problem, fix, x),
        "dof": np.broadcast_to(fix.dof, (size,)),
        "rejected": np.broadcast_to((fix.weights < 0.5 * problem.weight).sum(-1), (size,)),
        "alternatives": np.isfinite(fix.alternatives.gap).sum(-1),
    }
    moving = len(names) > 1
    values["error_velocity"] = np.linalg.norm(_take(problem, x - truth, names[1]), axis=-1) if moving else np.nan
    entries = _lengths(problem)
    values["error_bias"] = np.sqrt(((x - truth)[:, entries] ** 2).mean(-1)) if len(entries) else np.nan
    labels = np.array([status.label for status in Status], dtype=object)
    values |= {"status": labels[fix.code], "reason": fix.reason}
    values |= {"proof": [c.proof for c in fix.certificate], "certificate": [c.method for c in fix.certificate]}
    values["bound"] = np.array([c.bound for c in fix.certificate], dtype=float)
    return values


def _component(place: Array, i: int) -> Any:
    return place[:, i] if i < place.shape[-1] else np.nan


def _take(problem: Problem, x: Array, name: str) -> Array:
    return problem.layout.take(x, name)


def _block(problem: Problem, matrix: Array, name: str) -> Array:
    slot, _ = problem.layout.find(name)
    part = slice(slot.start, slot.start + slot.size)
    return np.asarray(matrix[:, part, part])


def _lengths(problem: Problem) -> Array:
    """Return the entries of the shared unknowns that are biases in metres."""
    found = [np.arange(s.start, s.start + s.size) for s in problem.layout.shared if s.members and s.unit == "m"]
    return np.concatenate([*found, np.zeros(0, dtype=np.int64)])


def _root_trace(matrix: Array) -> Array:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.trace(matrix, axis1=-2, axis2=-1)))


def _squared(error: Array, matrix: Array) -> Array:
    """Return e' M^-1 e (n,); NaN where there is no error or no regular matrix."""
    usable = np.asarray(np.isfinite(matrix).all((-1, -2)) & np.isfinite(error).all(-1))
    kept = np.where(usable[:, None, None], matrix, np.eye(matrix.shape[-1]))
    solved, ok = linalg.solve(kept, np.where(usable[:, None], error, 0.0)[..., None])
    return np.asarray(np.where(usable & ok, (error * solved[..., 0]).sum(-1), np.nan))


def _nearest(problem: Problem, fix: Fix, truth: Array, name: str, error: Array) -> Array:
    best = np.linalg.norm(error, axis=-1)
    for i in range(fix.alternatives.x.shape[1]):
        with np.errstate(invalid="ignore"):
            best = np.fmin(best, np.linalg.norm(_take(problem, fix.alternatives.x[:, i] - truth, name), axis=-1))
    return np.asarray(best)


def _cost(problem: Problem, fix: Fix, x: Array) -> Array:
    """Return the cost of every estimate, that of unrefined ones evaluated here."""
    cost = np.where(np.isfinite(fix.cost), fix.cost, np.nan)
    items = np.flatnonzero(~np.isfinite(cost) & np.isfinite(x).all(-1))
    if len(items):
        with np.errstate(all="ignore"):
            found = eliminated(equations_at(problem.take(items), x[items])).cost
        cost[items] = np.where(np.isfinite(found), found, np.nan)
    return cost
