"""Modelled measurements and their derivatives at a point, all rows at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.models.jet import Jet
from optloc.models.primitives import wrap
from optloc.plan import Plan, plans
from optloc.problem import Problem
from optloc.states import fitting, points
from optloc.types import Array


def predict(problem: Problem, x: Array) -> Array:
    """Return the modelled measurements h(x), (..., m), of a problem at vectors x (..., size)."""
    values, x = [], fitting(problem, x)
    for plan in plans(problem):
        t, a, b = points(problem, plan, x, differentiate=False)
        value = np.asarray(plan.model.h(t, a, b))
        value = np.broadcast_to(value, np.broadcast_shapes(value.shape, (plan.block.count,)))
        values.append(_biased(plan, x, value, None, None))
    shape = np.broadcast_shapes(*(value.shape[:-1] for value in values))
    return np.concatenate([np.broadcast_to(value, (*shape, value.shape[-1])) for value in values], axis=-1)


def differentiate(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return residuals and derivatives of a problem at a point.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    x : array (..., size)
        Parameter vectors, ordered by ``problem.layout``.

    Returns
    -------
    residual : array (..., m)
        z - h(x), angles wrapped; zero for absent rows.
    jacobian : array (..., m, n + l)
        Derivatives of h with respect to the shared unknowns and to the local ones of each row's epoch.
    """
    layout, x = problem.layout, fitting(problem, x)
    batch = np.broadcast_shapes(problem.batch_shape, x.shape[:-1])
    jacobian = np.zeros((*batch, problem.count, layout.n_shared + layout.n_local))
    values = []
    for plan, start in zip(plans(problem), problem.starts, strict=True):
        value = _differentiate(problem, plan, x, jacobian[..., start : start + plan.block.count, :])
        values.append(np.broadcast_to(value, (*batch, plan.block.count)))
    return _residual(problem, np.concatenate(values, axis=-1)), jacobian


def _residual(problem: Problem, value: Array) -> Array:
    residual = np.asarray(problem.observed - value)
    for plan, start in zip(plans(problem), problem.starts, strict=True):
        if plan.model.period is not None:
            part = slice(start, start + plan.block.count)
            residual[..., part] = wrap(residual[..., part])
    weight = problem.weight
    return residual if np.all(weight > 0.0) else np.where(weight > 0.0, residual, 0.0)


def _differentiate(problem: Problem, plan: Plan, x: Array, jacobian: Array) -> Array:
    """Write the derivatives of one block into its part of the Jacobian and return its values."""
    t, a, b = points(problem, plan, x, differentiate=True)
    jet = plan.model.h(t, a, b)
    if not isinstance(jet, Jet):
        jet = Jet(np.asarray(jet), {})
    rows = np.arange(plan.block.count)
    fold = _folded(problem)
    for feed in plan.feeds:
        partial = jet.partials.get(feed.seed)
        if partial is not None:
            picked = partial if isinstance(feed.rows, slice) or partial.shape[-1] == 1 else partial[..., feed.rows]
            jacobian[..., rows[feed.rows], fold(feed.column)] += picked * feed.gain
    value = np.broadcast_to(jet.value, (*jacobian.shape[:-2], plan.block.count))
    return _biased(plan, x, value, jacobian, fold)


def _folded(problem: Problem) -> Any:
    """Return the map from columns of the full vector to columns of [shared, local of the row's epoch]."""
    n, length = problem.layout.n_shared, problem.layout.n_local

    def fold(column: Array) -> Array:
        return column if length == 0 else np.where(column < n, column, n + (column - n) % length)

    return fold


def _biased(plan: Plan, x: Array, value: Array, jacobian: Array | None, fold: Any) -> Array:
    """Return the values with scales, offsets, drifts and emission times; write their derivatives where asked."""
    if not plan.gains.row.size and not plan.adds.row.size:
        return value
    gain, added = 1.0 + plan.gains.total(x, plan.block.count), plan.adds.total(x, plan.block.count)
    if jacobian is not None:
        jacobian *= gain[..., None]
        for terms, factor in ((plan.gains, value), (plan.adds, np.ones(value.shape[-1:]))):
            derivative = factor[..., terms.row] * terms.coefficient
            np.add.at(jacobian, (..., terms.row, fold(terms.column)), derivative)  # type: ignore[arg-type]
    return np.asarray(value * gain + added)
