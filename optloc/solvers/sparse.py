"""The stage "sparse": starts and suspected rows from a convex program that allows gross errors in a few rows.

Letters: N problems, m rows, n unknowns y, d coordinates, x a position, s a station, t an emission time as a distance.
q stations b are the second stations of pairs; r_a and r_b are the ranges to the stations a and b. `block` are the rows
of one kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from scipy.special import ndtri

from formulations.sparse_errors import range_cone, square_cone
from optloc.base import linalg
from optloc.base.threads import WORTH, map_on_threads
from optloc.base.types import Array, Rows
from optloc.linear.evaluate import differentiate
from optloc.linear.mirror import one_position
from optloc.linear.redundancy import present_unknowns
from optloc.linear.vectors import problem_at_rest, vectors
from optloc.models import MODELS
from optloc.problem.arrival_times import as_arrivals
from optloc.problem.noise import variances
from optloc.problem.problem import Problem
from optloc.solvers.pool import Pool, begin, offer, pack
from optloc.solvers.stages import explain_absence, fix_by, gtrs, lsr
from optloc.solvers.starts.position import spread_of
from optloc.solvers.starts.several_positions import from_pieces
from optloc.solvers.starts.squared_range import Coordinates, lift_rows
from optloc.solvers.verdict.judge import judge

# Least scaled distance, and least factor, for the weight of a row: a point on a station must not give one row all the
# weight.
_NEAR = 1e-3
# A row is in error if noise makes the greatest of all residuals this large with at most this probability. Clean data
# lose a row once in a hundred cases (docs/measured/sparse.md).
_LEVEL = 0.01
# Most tests of the rows, each with the fix of the rows that passed the test before. Usually the second test confirms
# the first. The limit ends cycles of two sets that lead to each other.
_PASSES = 8
# Variance of a residual, in units of the variance of its row, below which the row is not checked: rounding of 1 - J C
# J'.
_UNCHECKED = 1e-6


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
    origin : array (N, d)
        Metres.
    scale : array (N,)
        Metres.
    rows, right : array (N, m, n), (N, m)
        Zero for a row that is absent or has no linear form.
    error : callable
        Maps scaled points (N, d), or None, to the standard deviations (N, m) of the right sides.
    apex : array (N, q, d)
        Stations b, scaled.
    square : bool
        Whether y contains ``|x|^2``, after x; the ranges to the q stations b are the last entries.
    """

    origin: Array
    scale: Array
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
    origin, scale = np.broadcast_to(centre, (size, d)), np.broadcast_to(spread, (size,))
    pairs = _references(problem)
    # columns of y: x, |x|^2, for each epoch t and |x|^2 - t^2, then the ranges to stations b
    first = d + 1 + 2 * problem.epochs
    n = first + len(pairs)
    rows, right = np.zeros((size, problem.count, n)), np.zeros((size, problem.count))
    errors: list[tuple[slice, Callable[[Array | None], Array]]] = []
    for block, start in zip(problem.rows, problem.starts, strict=True):
        part = _lift_ranges(problem, block, start, origin, scale, pairs, first)
        # kinds without ranges, such as bearings
        part = part or _lift_others(problem, block, start, Coordinates(origin, scale, False))
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
            - origin[:, None]) / scale[:, None, None]  # fmt: skip
    return RowWise(origin, scale, rows, right, error, apex, bool(rows[..., d].any()))


def _references(problem: Problem) -> list[int]:
    """Return the numbers of the stations b of rows that combine two ranges, in ascending order."""
    taken = [rows.b for rows in problem.rows if (form := MODELS[rows.kind].ranges) is not None and form[1] != 0]
    return sorted({int(b) for each in taken for b in each})


def _block_sigma(problem: Problem, block: Rows, start: int) -> Array:
    """Return the standard deviations (..., m) of the rows of one kind, with their weights.

    `start` is the number of the first row of the kind in the problem.
    """
    weight = np.where(block.weight > 0.0, block.weight, 1.0)
    return np.sqrt(variances(problem.noise, problem.count)[..., start : start + block.count] / weight)


def _lift_ranges(
    problem: Problem, block: Rows, start: int, origin: Array, scale: Array, pairs: list[int], first: int
) -> _SparsePart | None:
    """Return the linear rows of range measurements of one kind, or None for other kinds.

    `start` is the number of the first row of the kind. `origin` and `scale` are as in `RowWise`. `pairs` are the
    stations b, and `first` is the column of y of their first range.
    """
    model, form = MODELS[block.kind], MODELS[block.kind].ranges
    if form is None:
        return None
    place = problem.stations.position[..., 0, :, :]
    a = (place[..., block.a, :] - origin[:, None]) / scale[:, None, None]
    m = (block.z - block.correction) / scale[:, None]
    # |x - a|^2 = m^2: -2 a x + |x|^2 = m^2 - |a|^2
    x, right, square = -2.0 * a, -(a**2).sum(-1), np.ones(block.count)
    others: tuple[tuple[Array, Array], ...] = ()
    if form[1]:
        b = (place[..., block.b, :] - origin[:, None]) / scale[:, None, None]
        # r_a = m - c r_b: the difference of both squares has 2 c m r_b for |x|^2
        x, right, square = x + 2.0 * b, right + (b**2).sum(-1), np.zeros(block.count)
        column = first + np.searchsorted(pairs, block.b)
        others = ((column, 2.0 * form[1] * m),)
    elif model.emission:
        # r = m - t: |x|^2 - t^2 is one more unknown of the epoch, and 2 m t is on the left
        m = _centre(m, block)
        column = problem.dimension + 1 + 2 * block.epoch
        square, others = np.zeros(block.count), ((column, 2.0 * m), (column + 1, np.ones(block.count)))
    sigma = _block_sigma(problem, block, start) / scale[:, None]

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
    position, failed = _lift(problem)
    x = vectors(problem, position[:, None])[:, 0]
    x, raw, unsolved = _linearise(problem, x)
    start = problem.layout.take(x, "position")
    fixed, wrong = _test_support(problem, x, raw)
    # if a program fails, its fix and its rows are not tested, so all results are dropped
    failed |= unsolved
    found = np.where(failed[:, None, None], np.nan, np.stack([start, fixed], axis=1))
    return SparseErrors(found, raw & ~failed[:, None], wrong & ~failed[:, None])


def _lift(problem: Problem) -> tuple[Array, Array]:
    """Return positions (N, d), metres, from the squared rows in two weightings, and flags (N,) of failed programs.

    If these rows leave a direction undetermined, the position is the closed form of all rows: pairs without a common
    station have one more unknown each.
    """
    lifts, point, failed = row_wise(problem), None, np.zeros(problem.batch_shape[0], dtype=bool)
    for _ in range(2):
        y, _, unsolved = _fit(lifts.rows, lifts.right, lifts.error(point), lifts)
        point, failed = y[:, : problem.dimension], failed | unsolved
    assert point is not None
    position = point * lifts.scale[:, None] + lifts.origin
    lost = np.flatnonzero(np.isnan(position).any(1) & ~failed)
    if len(lost):
        rest = problem.take(lost)
        position[lost] = rest.layout.take(gtrs(rest, None).x[:, 0], "position")
    return position, failed


def _linearise(problem: Problem, x: Array) -> tuple[Array, Array, Array]:
    """Return vectors (N, size) after one step with sparse errors, support (N, m), and flags (N,) of failed programs.

    The support are the rows whose gross error is not zero. The rows are linearised at x (N, size).
    """
    residual, jacobian = _derivatives(problem, x)
    move, errors, failed = _fit(jacobian, residual, _sigma(problem))
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
    residual, jacobian = _derivatives(problem, x)
    sigma = _sigma(problem)
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


def _derivatives(problem: Problem, x: Array) -> tuple[Array, Array]:
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


def _sigma(problem: Problem) -> Array:
    """Return the standard deviations (N, m) of all rows, with their weights."""
    weight = np.where(problem.weight > 0.0, problem.weight, 1.0)
    sigma = np.sqrt(variances(problem.noise, problem.count) / weight)
    return np.broadcast_to(sigma, (*problem.batch_shape, problem.count))
