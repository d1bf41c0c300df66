"""Linear rows for one position, one per measurement, and the convex programs that allow gross errors in a few of them.

Letters: N problems, m rows, n unknowns y, d coordinates, x a position, s a station, t an emission time as a distance.
q stations b are the second stations of pairs; r_a and r_b are the ranges to the stations a and b. `block` are the rows
of one kind.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from formulations.sparse_errors import range_cone, square_cone
from optloc.base.threads import WORTH, map_on_threads
from optloc.base.types import Array, Rows
from optloc.linear.evaluate import differentiate
from optloc.models import MODELS
from optloc.problem.noise import variances
from optloc.problem.problem import Problem
from optloc.solvers.starts.position import spread_of
from optloc.solvers.starts.squared_range import Coordinates, lift_rows

# Least scaled distance, and least factor, for the weight of a row: a point on a station must not give one row all the
# weight.
_NEAR = 1e-3


# Linear rows for one position, one per measurement, so that one wrong measurement is one wrong row.
#
# A range row is ``r_a + c r_b + t = m`` with c of 0, 1 or -1 and the emission time t. With ``|x - s|^2 = r^2`` it is
# linear in the position and in
#
# - ``|x|^2`` (range: c = 0, no t), which is at least the square of x: a cone;
# - ``t`` and ``|x|^2 - t^2`` (arrival times), which may have any value: no cone;
# - ``r_b`` (pairs), which is at least ``|x - s_b|``: a cone.
#
# If the ranges were first reduced to one reference, an error would spread to other rows.


@dataclass(frozen=True, slots=True)
class RowWise:
    """Rows of N problems of one position, ``rows . y = right``, with y = ((x - origin) / scale, others).

    Parameters
    ----------
    coordinates : Coordinates
        Origin and scale.
    rows, right : array (N, m, n), (N, m)
        Zero for a row that is absent or has no linear form.
    error : callable
        Maps scaled points (N, d), or None, to the standard deviations (N, m) of the right sides.
    apex : array (N, q, d)
        Stations b, scaled.
    square : bool
        Whether y contains ``|x|^2``, after x; the ranges to the q stations b are the last entries.
    """

    coordinates: Coordinates
    rows: Array
    right: Array
    error: Callable[[Array | None], Array]
    apex: Array
    square: bool

    def cones(self, item: int) -> list[tuple[int, Array]]:
        """Return the cones of one problem: pairs of the entry of y that a cone bounds, and its matrix."""
        n, d, q = self.rows.shape[-1], self.apex.shape[-1], self.apex.shape[1]
        ranged = [(n - q + j, range_cone(self.apex[item, j], n, n - q + j)) for j in range(q)]
        return [(d, square_cone(d, n, d)), *ranged] if self.square else ranged


@dataclass(frozen=True, slots=True)
class _SparsePart:
    """Linear rows of one kind: part of `RowWise`.

    Parameters
    ----------
    x, square : array (N, m, d), array (N, m) or (m,)
        Coefficients of x and of |x|^2.
    others : tuple of (column, coefficient)
        Column of y (m,) and coefficients of other unknowns.
    right : array (N, m)
        Right sides.
    error : callable
        Maps scaled points, or None, to the standard deviations of the right sides.
    """

    x: Array
    square: Array
    others: tuple[tuple[Array, Array], ...]
    right: Array
    error: Callable[[Array | None], Array]


def row_wise(problem: Problem) -> RowWise:
    """Return linear rows for a flat batch of problems with one static target, one row for each measurement.

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
    to = Coordinates(np.broadcast_to(centre, (size, d)), np.broadcast_to(spread, (size,)), on_cone=False)
    pairs = _references(problem)
    # columns of y: x, |x|^2, for each epoch t and |x|^2 - t^2, then the ranges to stations b
    first = d + 1 + 2 * problem.epochs
    n = first + len(pairs)
    rows, right = np.zeros((size, problem.count, n)), np.zeros((size, problem.count))
    errors: list[tuple[slice, Callable[[Array | None], Array]]] = []
    for block, start in zip(problem.rows, problem.starts, strict=True):
        part = _lift_ranges(problem, block, start, to, pairs, first)
        # kinds without ranges, such as bearings
        part = part or _lift_others(problem, block, start, to)
        if part is None:
            continue
        columns_of = slice(start, start + block.count)
        rows[:, columns_of, :d], rows[:, columns_of, d], right[:, columns_of] = part.x, part.square, part.right
        for column, value in part.others:
            rows[:, np.arange(start, columns_of.stop), column] += value
        errors.append((columns_of, part.error))
    usable = (problem.weight > 0.0) & np.isfinite(right) & np.isfinite(rows).all(-1)
    rows, right = np.where(usable[..., None], rows, 0.0), np.where(usable, right, 0.0)

    def error(point: Array | None) -> Array:
        out = np.ones(right.shape)
        for columns_of, each in errors:
            out[:, columns_of] = each(point)
        return out

    apex = (np.broadcast_to(problem.stations.position, (size, *problem.stations.position.shape[-3:]))[:, 0, pairs]
            - to.origin[:, None]) / to.scale[:, None, None]  # fmt: skip
    return RowWise(to, rows, right, error, apex, bool(rows[..., d].any()))


def _references(problem: Problem) -> list[int]:
    """Return the numbers of the stations b of rows that combine two ranges, in ascending order."""
    taken = [rows.b for rows in problem.rows if (form := MODELS[rows.kind].ranges) is not None and form[1] != 0]
    return sorted({int(b) for each in taken for b in each})


def _lift_ranges(
    problem: Problem, block: Rows, start: int, to: Coordinates, pairs: list[int], first: int
) -> _SparsePart | None:
    """Return the linear rows of range measurements of one kind, or None for other kinds.

    `start` is the number of the first row of the kind, and `to` has the scaled coordinates. `pairs` are the stations b,
    and `first` is the column of y of their first range.
    """
    model, form = MODELS[block.kind], MODELS[block.kind].ranges
    if form is None:
        return None
    place, scale = problem.stations.position[..., 0, :, :], to.scale
    a = (place[..., block.a, :] - to.origin[:, None]) / scale[:, None, None]
    m = (block.z - block.correction) / scale[:, None]
    # |x - a|^2 = m^2: -2 a x + |x|^2 = m^2 - |a|^2
    x, right, square = -2.0 * a, -(a**2).sum(-1), np.ones(block.count)
    others: tuple[tuple[Array, Array], ...] = ()
    if form[1]:
        b = (place[..., block.b, :] - to.origin[:, None]) / scale[:, None, None]
        # r_a = m - c r_b: the difference of both squares has 2 c m r_b for |x|^2
        x, right, square = x + 2.0 * b, right + (b**2).sum(-1), np.zeros(block.count)
        column = first + np.searchsorted(pairs, block.b)
        others = ((column, 2.0 * form[1] * m),)
    elif model.emission:
        # r = m - t: |x|^2 - t^2 is one more unknown of the epoch, and 2 m t is on the left
        m = _centre(m, block)
        column = problem.dimension + 1 + 2 * block.epoch
        square, others = np.zeros(block.count), ((column, 2.0 * m), (column + 1, np.ones(block.count)))
    sigma = deviations(problem)[:, start : start + block.count] / scale[:, None]

    def error(point: Array | None) -> Array:
        # without a point, assume the measured distance, or at least the size of the network
        away = np.maximum(1.0, np.abs(m)) if point is None else np.sqrt(((point[:, None] - a) ** 2).sum(-1))
        return np.asarray(2.0 * np.maximum(np.where(np.isfinite(away), away, 1.0), _NEAR) * sigma)

    return _SparsePart(x, square, others, right + m**2, error)


def _centre(m: Array, block: Rows) -> Array:
    """Return arrival times m (N, rows) of one kind minus the median of their epoch, in the same unit.

    The median sets the origin of time, because one gross error must not set it.
    """
    out, present = np.array(m), np.broadcast_to(block.weight > 0.0, m.shape)
    for epoch in np.unique(block.epoch):
        in_epoch = block.epoch == epoch
        with np.errstate(all="ignore"):
            middle = np.nanmedian(np.where(present[:, in_epoch], m[:, in_epoch], np.nan), axis=1, keepdims=True)
        out[:, in_epoch] -= np.where(np.isfinite(middle), middle, 0.0)
    return out


def _lift_others(problem: Problem, block: Rows, start: int, to: Coordinates) -> _SparsePart | None:
    """Return the linear rows of measurements without ranges of one kind, or None if the kind has no linear form.

    `start` is the number of the first row of the kind, and `to` has the scaled coordinates.
    """
    lifted = lift_rows(problem, block, start, None, to)
    if lifted is None:
        return None

    def error(point: Array | None) -> Array:
        return np.asarray(np.maximum(np.abs(lifted.factor(point)), _NEAR) * lifted.sigma)

    return _SparsePart(lifted.row[..., :-1], lifted.row[..., -1], (), lifted.right, error)


# The programs.


def lift_positions(problem: Problem, otherwise: Callable[[Problem], Array]) -> tuple[Array, Array]:
    """Return positions (N, d), metres, from the squared rows in two weightings, and flags (N,) of failed programs.

    If these rows leave a direction undetermined, `otherwise` gives the positions, such as a closed form of all rows:
    pairs without a common station have one more unknown each.
    """
    lifts, point, failed = row_wise(problem), None, np.zeros(problem.batch_shape[0], dtype=bool)
    for _ in range(2):
        y, _, unsolved = _fit(lifts.rows, lifts.right, lifts.error(point), lifts)
        point, failed = y[:, : problem.dimension], failed | unsolved
    assert point is not None
    position = point * lifts.coordinates.scale[:, None] + lifts.coordinates.origin
    lost = np.flatnonzero(np.isnan(position).any(1) & ~failed)
    if len(lost):
        position[lost] = otherwise(problem.take(lost))
    return position, failed


def linearise_sparse(problem: Problem, x: Array) -> tuple[Array, Array, Array]:
    """Return vectors (N, size) after one step with sparse errors, support (N, m), and flags (N,) of failed programs.

    The support are the rows whose gross error is not zero. The rows are linearised at x (N, size).
    """
    residual, jacobian = derivatives(problem, x)
    move, errors, failed = _fit(jacobian, residual, deviations(problem))
    return x + move, errors != 0.0, failed


def _fit(rows: Array, right: Array, sigma: Array, lifts: RowWise | None = None) -> tuple[Array, Array, Array]:
    """Return the unknowns (N, n) and errors in sigmas (N, m) of linear rows, and flags (N,) of failed programs.

    `rows` (N, m, n), `right` (N, m) and `sigma` (N, m) are coefficients, right sides and standard deviations. `lifts`
    adds its cones. Unknowns that no row contains are zero. Unknowns are NaN for a failed program or invalid rows.
    """
    from formulations.sparse_errors import sparse_fit

    y, errors = np.full((len(rows), rows.shape[-1]), np.nan), np.zeros(right.shape)
    failed = np.zeros(len(rows), dtype=bool)
    white, white_right = rows / sigma[..., None], right / sigma

    def fit(i: int) -> None:
        used = (white[i] != 0.0).any(0)
        if not (used.any() and np.isfinite(white[i]).all() and np.isfinite(white_right[i]).all()):
            return
        # the last column of a cone is its constant
        kept = np.append(used, True)
        cones = [] if lifts is None else [cone[:, kept] for column, cone in lifts.cones(i) if used[column]]
        found = sparse_fit(white[i][:, used], white_right[i], cones=cones)
        failed[i] = found.answer is not None and np.isnan(found.answer.primal)
        if failed[i]:
            return
        y[i], errors[i] = 0.0, found.errors
        y[i, used] = found.y

    map_on_threads(fit, range(len(rows)), least=WORTH)
    return y, errors, failed


def derivatives(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return residuals (N, m) and the derivatives (N, m, size) of predictions; NaN vectors give NaN.

    Derivatives of absent rows are zero.
    """
    residual, compact = differentiate(problem, x)
    n, width = problem.layout.n_shared, problem.layout.n_local
    full = np.zeros((*compact.shape[:-1], problem.layout.size))
    full[..., :n] = compact[..., :n]
    # local columns are compact: each row has the columns of its epoch
    # the local unknowns of epoch k are columns n + k * width and the following ones of a parameter vector
    for j in range(width):
        full[:, np.arange(problem.count), n + problem.epoch * width + j] = compact[..., n + j]
    return residual, np.where(problem.weight[..., None] > 0.0, full, 0.0)


def deviations(problem: Problem) -> Array:
    """Return the standard deviations (N, m) of all rows, with their weights."""
    weight = np.where(problem.weight > 0.0, problem.weight, 1.0)
    sigma = np.sqrt(variances(problem.noise, problem.count) / weight)
    return np.broadcast_to(sigma, (*problem.batch_shape, problem.count))
