"""Modelled measurements and their derivatives at a point, all rows at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.arrays import foreign, library, placed
from optloc.models.jet import Jet
from optloc.models.primitives import wrap
from optloc.plan import Plan, plans
from optloc.problem import Problem
from optloc.states import fitting, points
from optloc.types import Array, Rows


def predict(problem: Problem, x: Array) -> Array:
    """Return the modelled measurements h(x), (..., m), of a problem at vectors x (..., size)."""
    values, x, xp = [], fitting(problem, x), library(x)
    for plan in plans(problem):
        value = placed(plan.model.h(*points(problem, plan, x, differentiate=False)), x)
        value = xp.broadcast_to(value, np.broadcast_shapes(value.shape, (plan.block.count,)))
        values.append(_biased(plan, x, value)[0])
    return _joined(values)


def differentiate(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return residuals and derivatives of a problem at a point.

    Parameters
    ----------
    problem : Problem
        Batch of problems (...).
    x : array (..., size)
        Parameter vectors, ordered by ``problem.layout``, of any array library; so are the answers.

    Returns
    -------
    residual : array (..., m)
        z - h(x), angles wrapped; zero for absent rows.
    jacobian : array (..., m, n + l)
        Derivatives of h with respect to the shared unknowns and to the local ones of each row's epoch.
    """
    layout, x, xp = problem.layout, fitting(problem, x), library(x)
    width = layout.n_shared + layout.n_local
    batch = np.broadcast_shapes(problem.batch_shape, x.shape[:-1])
    place = None if foreign(x) else np.zeros((*batch, problem.count, width))
    residuals, jacobians = [], []
    for plan, block, start in zip(plans(problem), problem.rows, problem.starts, strict=True):
        m = block.count
        value, terms = _derived(problem, plan, x)
        residual = _residual(block, value, plan.model.period is not None)
        residuals.append(xp.broadcast_to(residual, (*batch, m)))
        if place is None:
            jacobians.append(_stacked(terms, (*batch, m), width, x))
        else:
            _added(terms, place[..., start : start + m, :])
    return _joined(residuals), xp.concat(jacobians, axis=-2) if place is None else place


# Derivatives of a block of m rows: folded column (m,) and coefficient (m,) of each row, times a factor (..., m or 1).
_Terms = list[tuple[Array, Array, Any]]


def _derived(problem: Problem, plan: Plan, x: Array) -> tuple[Any, _Terms]:
    """Return the values (..., m) of one block, biases included, and their derivatives."""
    jet, m, fold = plan.model.h(*points(problem, plan, x, differentiate=True)), plan.block.count, _folded(problem)
    if not isinstance(jet, Jet):
        jet = Jet(placed(np.asarray(jet), x), {})
    value, gain = _biased(plan, x, jet.value)
    terms: _Terms = []
    for feed in plan.feeds:
        partial = jet.partials.get(feed.seed)
        if partial is not None:
            column, coefficient = feed.table(m)
            terms.append((fold(column), coefficient, partial if gain is None else partial * gain))
    unit = placed(np.ones(1), x)
    for found, factor in ((plan.gains, jet.value), (plan.adds, unit)):
        terms += [(fold(column), coefficient, factor) for column, coefficient in found.tables(m)]
    return value, terms


def _folded(problem: Problem) -> Any:
    """Return the map from columns of the full vector to columns of [shared, local of the row's epoch]."""
    n, length = problem.layout.n_shared, problem.layout.n_local

    def fold(column: Array) -> Array:
        return column if length == 0 else np.where(column < n, column, n + (column - n) % length)

    return fold


def _biased(plan: Plan, x: Array, value: Any) -> tuple[Any, Any]:
    """Return values with scales, offsets, drifts and emission times, and the factor that scales them or None."""
    m, gain = plan.block.count, None
    if plan.gains.row.size:
        gain = 1.0 + plan.gains.total(x, m)
        value = value * gain
    return value + plan.adds.total(x, m) if plan.adds.row.size else value, gain


def _residual(block: Rows, value: Any, periodic: bool) -> Any:
    """Return what is measured less the values of one block; absent rows count as met."""
    residual = placed(block.z - block.correction, value) - value
    residual = wrap(residual) if periodic else residual
    if not foreign(block.weight) and np.all(block.weight > 0.0):
        return residual
    return library(residual).where(placed(block.weight, residual) > 0.0, residual, 0.0)


def _added(terms: _Terms, jacobian: Array) -> None:
    """Add derivatives to a block's part of the Jacobian."""
    for column, coefficient, factor in terms:
        if np.all(column == column[:1]):
            jacobian[..., column[0]] += factor if np.all(coefficient == 1.0) else factor * coefficient
            continue
        rows = np.flatnonzero(coefficient)
        picked = factor if factor.shape[-1:] in ((), (1,)) else factor[..., rows]
        jacobian[..., rows, column[rows]] += picked * coefficient[rows]


def _stacked(terms: _Terms, shape: tuple[int, ...], width: int, x: Array) -> Any:
    """Return the Jacobian (*shape, width) of a block, column by column: in some libraries nothing can be written."""
    columns: dict[int, Any] = {}
    for column, coefficient, factor in terms:
        for j in np.unique(column[coefficient != 0.0]):
            part = factor * placed(np.where(column == j, coefficient, 0.0), x)
            columns[int(j)] = columns[int(j)] + part if int(j) in columns else part
    zero, xp = placed(np.zeros(1), x), library(x)
    return xp.stack([xp.broadcast_to(columns.get(j, zero), shape) for j in range(width)], axis=-1)


def _joined(parts: list[Any]) -> Array:
    xp = library(parts[0])
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    joined: Array = xp.concat([xp.broadcast_to(part, (*shape, part.shape[-1])) for part in parts], axis=-1)
    return joined
