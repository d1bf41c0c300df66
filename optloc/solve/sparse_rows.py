"""Rows of one position made linear one by one, so that one wrong measurement is one wrong row.

A range row says ``r_a + c r_b + t = m`` with c of 0, 1 or -1 and t the emission time. With ``|x - s|^2 = r^2`` it is
linear in the position and in

- ``|x|^2`` (range: c = 0, no t), which is not less than the square of x: a cone;
- ``t`` and ``|x|^2 - t^2`` (arrival times), of which every value is possible: no cone;
- ``r_b`` (pairs), which is not less than ``|x - s_b|``: a cone.

No row passes on its error to another one, as it does where the ranges are first reduced to one reference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from formulations.sparse_errors import range_cone, square_cone
from optloc.models import MODELS
from optloc.noise import variances
from optloc.problem import Problem
from optloc.solve.lifted import Coordinates, lifted_rows
from optloc.solve.scale import spread_of
from optloc.types import Array, Rows

_NEAR = 1e-3


@dataclass(frozen=True, slots=True)
class RowWise:
    """Rows of N problems of one position, ``rows . y = right``, with y = ((x - origin) / scale, others).

    Parameters
    ----------
    origin : array (N, d)
        Metres.
    scale : array (N,)
        Metres.
    rows, right : array (N, m, n), (N, m)
        Zero for a row that is absent or does not lift.
    error : callable
        Maps scaled points (N, d), or None, to the standard deviations (N, m) of the right sides.
    apex : array (N, q, d)
        Stations b, scaled.
    square : bool
        Whether y holds ``|x|^2``, behind x; the ranges to the q stations b are the last entries.
    """

    origin: Array
    scale: Array
    rows: Array
    right: Array
    error: Callable[[Array | None], Array]
    apex: Array
    square: bool

    def cones(self, item: int) -> list[tuple[int, Array]]:
        """Return the entry of y that each cone bounds, and the cone, of one problem."""
        n, d, q = self.rows.shape[-1], self.apex.shape[-1], self.apex.shape[1]
        ranged = [(n - q + j, range_cone(self.apex[item, j], n, n - q + j)) for j in range(q)]
        return [(d, square_cone(d, n, d)), *ranged] if self.square else ranged


@dataclass(frozen=True, slots=True)
class _Part:
    """Rows of one kind: coefficients of x, of |x|^2 and of others by their column, right side, error at a point."""

    x: Array
    square: Array
    others: tuple[tuple[Array, Array], ...]
    right: Array
    error: Callable[[Array | None], Array]


def row_wise(problem: Problem) -> RowWise:
    """Return the rows of a flat batch of problems with one static target, each made linear by itself.

    Parameters
    ----------
    problem : Problem
        N problems.

    Notes
    -----
    A. Beck, P. Stoica, J. Li, "Exact and approximate solutions of source localization problems", IEEE Trans. Signal
    Process. 56 (2008), sections II and III, with one row for each measurement.
    """
    size, d = problem.batch_shape[0], problem.dimension
    centre, spread = spread_of(problem)
    origin, scale = np.broadcast_to(centre, (size, d)), np.broadcast_to(spread, (size,))
    pairs = _references(problem)
    first = d + 1 + 2 * problem.epochs
    n = first + len(pairs)
    rows, right = np.zeros((size, problem.count, n)), np.zeros((size, problem.count))
    errors: list[tuple[slice, Callable[[Array | None], Array]]] = []
    for block, start in zip(problem.rows, problem.starts, strict=True):
        part = _ranged(problem, block, start, origin, scale, pairs, first)
        part = part or _otherwise(problem, block, start, Coordinates(origin, scale, False))
        if part is None:
            continue
        own = slice(start, start + block.count)
        rows[:, own, :d], rows[:, own, d], right[:, own] = part.x, part.square, part.right
        for column, value in part.others:
            rows[:, np.arange(start, own.stop), column] += value
        errors.append((own, part.error))
    usable = (problem.weight > 0.0) & np.isfinite(right) & np.isfinite(rows).all(-1)
    rows, right = np.where(usable[..., None], rows, 0.0), np.where(usable, right, 0.0)

    def error(point: Array | None) -> Array:
        out = np.ones(right.shape)
        for own, each in errors:
            out[:, own] = each(point)
        return out

    apex = (np.broadcast_to(problem.stations.position, (size, *problem.stations.position.shape[-3:]))[:, 0, pairs]
            - origin[:, None]) / scale[:, None, None]  # fmt: skip
    return RowWise(origin, scale, rows, right, error, apex, bool(rows[..., d].any()))


def _references(problem: Problem) -> list[int]:
    """Return the stations b of rows that combine two ranges."""
    taken = [rows.b for rows in problem.rows if (form := MODELS[rows.kind].ranges) is not None and form[1] != 0]
    return sorted({int(b) for each in taken for b in each})


def _sigma(problem: Problem, block: Rows, start: int) -> Array:
    weight = np.where(block.weight > 0.0, block.weight, 1.0)
    return np.sqrt(variances(problem.noise, problem.count)[..., start : start + block.count] / weight)


def _ranged(
    problem: Problem, block: Rows, start: int, origin: Array, scale: Array, pairs: list[int], first: int
) -> _Part | None:
    model, form = MODELS[block.kind], MODELS[block.kind].ranges
    if form is None:
        return None
    place = problem.stations.position[..., 0, :, :]
    a = (place[..., block.a, :] - origin[:, None]) / scale[:, None, None]
    m = (block.z - block.correction) / scale[:, None]
    x, right, square = -2.0 * a, -(a**2).sum(-1), np.ones(block.count)
    others: tuple[tuple[Array, Array], ...] = ()
    if form[1]:
        b = (place[..., block.b, :] - origin[:, None]) / scale[:, None, None]
        x, right, square = x + 2.0 * b, right + (b**2).sum(-1), np.zeros(block.count)
        column = first + np.searchsorted(pairs, block.b)
        others = ((column, 2.0 * form[1] * m),)
    elif model.emission:
        m = _centred(m, block)
        column = problem.dimension + 1 + 2 * block.epoch
        square, others = np.zeros(block.count), ((column, 2.0 * m), (column + 1, np.ones(block.count)))
    sigma = _sigma(problem, block, start) / scale[:, None]

    def error(point: Array | None) -> Array:
        away = np.maximum(1.0, np.abs(m)) if point is None else np.sqrt(((point[:, None] - a) ** 2).sum(-1))
        return np.asarray(2.0 * np.maximum(np.where(np.isfinite(away), away, 1.0), _NEAR) * sigma)

    return _Part(x, square, others, right + m**2, error)


def _centred(m: Array, block: Rows) -> Array:
    """Return arrival times (N, m) less the median of their epoch: one that is far off must not decide the origin."""
    out, heard = np.array(m), np.broadcast_to(block.weight > 0.0, m.shape)
    for epoch in np.unique(block.epoch):
        own = block.epoch == epoch
        with np.errstate(all="ignore"):
            middle = np.nanmedian(np.where(heard[:, own], m[:, own], np.nan), axis=1, keepdims=True)
        out[:, own] -= np.where(np.isfinite(middle), middle, 0.0)
    return out


def _otherwise(problem: Problem, block: Rows, start: int, to: Coordinates) -> _Part | None:
    lifted = lifted_rows(problem, block, start, None, to)
    if lifted is None:
        return None

    def error(point: Array | None) -> Array:
        return np.asarray(np.maximum(np.abs(lifted.factor(point)), _NEAR) * lifted.sigma)

    return _Part(lifted.row[..., :-1], lifted.row[..., -1], (), lifted.right, error)
