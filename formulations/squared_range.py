r"""Squared-range least squares: a linear fit with one quadratic constraint, solved exactly.

.. math:: \min_y \; |B y - g|^2 \quad\text{subject to}\quad y^\top C y + 2 h^\top y = 0

for two quadrics. The *cone*, :math:`y = (x, r)`, `C = diag(1, .., 1, -1)`, `h = 0`: `x` is measured from a reference
point and `r` is its distance (range differences, arrival times, range sums, bearings). The *paraboloid*, :math:`y =
(x, w)`, `C = diag(1, .., 1, 0)`, `h = (0, .., 0, -1/2)`: `w` is :math:`|x|^2` (ranges, ratios of ranges, bearings).

A multiplier :math:`\lambda` makes every stationary point, except the apex of the cone, a solution of
:math:`(B^\top B + \lambda C) y = B^\top g - \lambda h`. Both cases become :math:`\sum_j c_j^2/(t - p_j)^2 = \kappa +
\sigma t` (:mod:`formulations.secular`), with d poles:

- cone: :math:`C v_j = \gamma_j (A + \lambda_0 C) v_j`, one negative :math:`\gamma_0`, and :math:`t = 1/(1 + (\lambda
  - \lambda_0) \gamma_0)`. Adding :math:`\lambda_0 C` changes no value on the cone; it makes the pencil definite when
  :math:`A = B^\top B` is singular;
- paraboloid: `w` is eliminated by its own (linear) equation and :math:`t = \lambda`.

The global minimiser is the root above the last pole, where :math:`B^\top B + \lambda C` is positive semidefinite (no
gap). A singular `A` is the hard case: a root is on a pole, and both intersections of the solution line with the
quadric appear.

Sources: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), section 3; A.
Beck, P. Stoica and J. Li, "Exact and approximate solutions of source localization problems", IEEE Trans. Signal
Process. 56 (2008), section II (ranges: the paraboloid) and section III (range differences: the cone); P. Stoica and
J. Li, "Source localization from range-difference measurements", IEEE Signal Process. Mag. 23 (2006) (the minimal case,
a quadratic in the reference range).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from formulations.algebra import Array, Mask, across, apply, bordered, correct, eigen, normal
from formulations.secular import Roots, Secular, everything, largest

Finder = Callable[[Secular], Roots]

# Number of problems that are computed at a time: 100 000 fits in space took 47 ms in parts of 2048, 30 ms in parts of
# 8192, and 47 ms at once. For small parts numpy's calls take the time, for large parts the memory does.
_CHUNK = 8192

# Newton's method on the multiplier. Of random problems in space with errors of 1 % of their size, 94 % converge within
# three steps and 99.97 % within five. With errors of 10 %, 96-98 % converge within five; for the others the secular
# equation is better.
_STEPS = 5
_WEAK = 1e-7  # a pivot below this share of the largest entry has lost half of its digits: the secular equation is used
_SETTLED = 1e-7  # relative change of y below which the last step reduces the error to its square

# The secular equation.
_SEMIDEFINITE = 1e-8  # a Cholesky pivot below this share of the largest entry (root of the precision) needs a shift
_LIFT = 1e-9  # added to such matrices to find the shift: above their rounding errors, below valid pivots
_FLAT = 1e-13  # eigenvalues of the scaled normal matrix below this, some hundred roundings, are zero
_FLOOR = 1e-15  # relative floor of the roots of secular weights: some roundings, so that no pole vanishes
_LEAST = 1e-200  # the floor if all weights vanish: a square far above the smallest number
# Relative distance from the cone above which a point is invalid. It was measured in 50 000 problems, a third of them
# with columns scaled over eight decades: 99 % of the points are within 3e-16, and all except 2e-4 of them are within
# this value.
_OFF = 1e-6

# The line of solutions: singular values below this share of the largest count as zero; one decade above the rounding of
# the normal matrix, which contains their squares.
_DEPENDENT = 1e-7


@dataclass(frozen=True, slots=True)
class Quadric:
    """The constraint ``y'Cy + 2h'y = 0`` on ``y`` of length ``size``.

    Parameters
    ----------
    shape : {"cone", "paraboloid"}
        ``|x| = |r|`` with ``y = (x, r)``, or ``|x|^2 = w`` with ``y = (x, w)``.
    size : int
        Length of ``y``: the dimension of ``x`` plus one.
    """

    shape: Literal["cone", "paraboloid"]
    size: int

    @property
    def square(self) -> Array:
        """Return the diagonal of C, shape (size,)."""
        out = np.ones(self.size)
        out[-1] = -1.0 if self.shape == "cone" else 0.0
        return out

    @property
    def linear(self) -> Array:
        """Return the vector h, shape (size,)."""
        out = np.zeros(self.size)
        out[-1] = 0.0 if self.shape == "cone" else -0.5
        return out

    def value(self, y: Array) -> Array:
        """Return ``y'Cy + 2h'y``.

        Parameters
        ----------
        y : Array, shape (..., size)
            Points.

        Returns
        -------
        Array, shape (...)
            The value; zero on the quadric.
        """
        return np.asarray(np.sum(self.square * y * y + 2.0 * self.linear * y, axis=-1))


def cone(d: int) -> Quadric:
    """Return the quadric ``|x|^2 = r^2`` with ``x`` of dimension `d`.

    Parameters
    ----------
    d : int
        Dimension of ``x``.

    Returns
    -------
    Quadric
        The cone (Beck, Stoica and Li, 2008, section III).
    """
    return Quadric("cone", d + 1)


def paraboloid(d: int) -> Quadric:
    """Return the quadric ``|x|^2 = w`` with ``x`` of dimension `d`.

    Parameters
    ----------
    d : int
        Dimension of ``x``.

    Returns
    -------
    Quadric
        The paraboloid (Beck, Stoica and Li, 2008, section II).
    """
    return Quadric("paraboloid", d + 1)


def minimiser(B: Array, g: Array, quadric: Quadric, *, positive: bool = False) -> tuple[Array, Mask]:
    """Return the global minimiser of ``|By - g|^2`` on the quadric.

    Parameters
    ----------
    B : Array, shape (..., q, n)
        Whitened rows, numbers of order one; absent rows are zero.
    g : Array, shape (..., q)
        Right sides.
    quadric : Quadric
        The constraint, of size n.
    positive : bool
        Whether to minimise over the half ``y[-1] >= 0``; relevant for the cone only.

    Returns
    -------
    y : Array, shape (..., n)
        The minimiser; NaN if `ok` is False. If ``B'B`` has rank n - 1, there may be a second one.
    ok : Mask, shape (...)
        False if the input is not finite or the rank of ``B'B`` is less than n - 1.

    Notes
    -----
    More (1993), theorem 3.2; Beck, Stoica and Li (2008), sections II and III.
    """
    rows, right, shape = _one_batch(B, g, quadric)
    y, ok = np.empty((len(rows), quadric.size)), np.empty(len(rows), dtype=np.bool_)
    with np.errstate(all="ignore"):
        for part, b, h, _ in _parts(rows, right):
            points, ok[part] = _descend(b, h, quadric.square, quadric.linear)
            y[part] = points.T
    # problems that do not converge are collected over all parts, because small batches are slow
    hard = np.flatnonzero(~ok)
    if hard.size:
        points, _, valid = _points(rows[hard], right[hard], quadric, largest)
        y[hard], ok[hard] = points[:, 0], valid[:, 0]
    if positive and quadric.shape == "cone":
        wrong = np.flatnonzero(ok & (y[:, -1] < 0.0))
        if wrong.size:
            y[wrong] = stationary(rows[wrong], right[wrong], quadric, positive=True)[0][:, 0]
    return y.reshape(*shape, quadric.size), ok.reshape(shape)


def stationary(B: Array, g: Array, quadric: Quadric, *, positive: bool = False) -> tuple[Array, Array, Mask]:
    """Return all real stationary points of ``|By - g|^2`` on the quadric, the cheapest first.

    Parameters
    ----------
    B : Array, shape (..., q, n)
        Whitened rows, numbers of order one; absent rows are zero.
    g : Array, shape (..., q)
        Right sides.
    quadric : Quadric
        The constraint, of size n.
    positive : bool
        Whether to drop points with ``y[-1] < 0`` (a negative range).

    Returns
    -------
    y : Array, shape (..., K, n)
        Points, NaN if not valid; K = 2n - 1. The cone has at most 2(n - 1) with a multiplier, and its apex
        ``y = 0``, where the gradient of the constraint vanishes. The paraboloid has at most 2n - 1.
    cost : Array, shape (..., K)
        ``|By - g|^2``, ascending; infinite if not valid.
    valid : Mask, shape (..., K)
        Whether each point is valid; all False if the input is not finite or the rank of ``B'B`` is less than n - 1.

    Notes
    -----
    The points are the real roots of the secular equation's numerator, which is not formed. If ``B'B`` has rank n - 1,
    both intersections of the line of least-squares solutions with the quadric are among them.
    """
    rows, right, shape = _one_batch(B, g, quadric)
    y, cost, valid = _points(rows, right, quadric, everything)
    if positive:
        valid &= y[..., -1] >= 0.0
    y[~valid], cost[~valid] = np.nan, np.inf
    order = np.argsort(cost, axis=-1, kind="stable")
    y = np.take_along_axis(y, order[..., None], axis=1)
    cost, valid = np.take_along_axis(cost, order, axis=1), np.take_along_axis(valid, order, axis=1)
    k, n = 2 * quadric.size - 1, quadric.size
    return y.reshape(*shape, k, n), cost.reshape(*shape, k), valid.reshape(*shape, k)


def _one_batch(B: Array, g: Array, quadric: Quadric) -> tuple[Array, Array, tuple[int, ...]]:
    """Return rows (N, q, n) and right sides (N, q) with one batch axis, and their original leading axes."""
    B, g = np.asarray(B, dtype=np.float64), np.asarray(g, dtype=np.float64)
    if B.ndim < 2 or g.ndim < 1 or B.shape[-1] != quadric.size or B.shape[-2] != g.shape[-1]:
        raise ValueError(f"rows {B.shape} and right sides {g.shape} do not fit a quadric of size {quadric.size}")
    shape = np.broadcast_shapes(B.shape[:-2], g.shape[:-1])
    count = int(np.prod(shape))
    rows = np.broadcast_to(B, (*shape, *B.shape[-2:])).reshape(count, *B.shape[-2:])
    return rows, np.broadcast_to(g, (*shape, g.shape[-1])).reshape(count, g.shape[-1]), shape


def _parts(rows: Array, right: Array) -> Iterator[tuple[slice, Array, Array, Mask]]:
    """Yield parts that fit the cache: the slice, rows (q, n, N), right sides (q, N), and the mask of bad items (N,).

    Items that are not finite become zero, and are marked.
    """
    for i in range(0, len(rows), _CHUNK):
        part = slice(i, i + _CHUNK)
        b, h = np.moveaxis(rows[part], 0, -1).copy(), right[part].T.copy()
        bad = ~(np.isfinite(b).all(axis=(0, 1)) & np.isfinite(h).all(axis=0))
        b[..., bad], h[..., bad] = 0.0, 0.0
        yield part, b, h, np.asarray(bad)


def _points(rows: Array, right: Array, quadric: Quadric, find: Finder) -> tuple[Array, Array, Mask]:
    """Return points (N, K, n), costs (N, K) and validity (N, K) of every slot by the secular equation.

    `rows` (N, q, n) are B, `right` (N, q) are g. `find` is `largest` (K = 1, the global minimiser) or `everything`.
    """
    slots = 1 if find is largest else 2 * quadric.size - 1
    count, n = len(rows), quadric.size
    y, cost = np.empty((count, slots, n)), np.empty((count, slots))
    valid, usable = np.empty((count, slots), dtype=np.bool_), np.empty(count, dtype=np.bool_)
    solve = _cone_points if quadric.shape == "cone" else _paraboloid_points
    with np.errstate(all="ignore"):
        for part, b, h, bad in _parts(rows, right):
            points, found = solve(b, h, find)
            found &= np.isfinite(points).all(axis=0) & ~bad
            left = apply(b, points) - h[:, None]
            y[part], valid[part], cost[part] = points.transpose(2, 1, 0), found.T, (left * left).sum(axis=0).T
            usable[part] = ~bad
        # the apex, in the last slot of the cone, is always found, also without a multiplier
        roots = slots - 1 if quadric.shape == "cone" and slots > 1 else slots
        lost = np.flatnonzero(usable & ~valid[:, :roots].any(axis=1))
        if lost.size:
            points, met = _line_points(rows[lost], right[lost], quadric.square, quadric.linear)
            few = min(roots, 2)
            y[lost, :few], valid[lost, :few] = points[:, :few], met[:, :few]
            left = np.einsum("Nqn,Nkn->Nkq", rows[lost], points[:, :few]) - right[lost, None]
            cost[lost, :few] = (left * left).sum(axis=-1)
    y[~valid], cost[~valid] = np.nan, np.inf
    return y, cost, valid


# Easy problems: Newton's iteration on the multiplier.
#
# Let y = (A + lambda C)^-1 (b - lambda h), q = C y + h and phi(lambda) = y'Cy + 2h'y. On the interval where A + lambda
# C is positive definite, phi decreases with the slope -2 q'(A + lambda C)^-1 q. Its only zero there is the global
# minimiser (More, 1993, theorem 3.2). The start lambda = 0 is the unconstrained fit. A few factorisations suffice for
# data of ordinary noise, and take a fraction of the time of an eigenvalue problem.


def _descend(B: Array, g: Array, square: Array, linear: Array) -> tuple[Array, Mask]:
    """Return global minimisers y (n, N), and whether each item (N,) converged; otherwise y has no meaning.

    B (q, n, N) and g (q, N) are finite; `square` and `linear` (n,) are the diagonal of C and the vector h.
    """
    A, b = normal(B, g)
    signs, shift = square[:, None], linear[:, None]
    least = _WEAK * np.einsum("iiN->iN", A).max(axis=0)
    multiplier = np.zeros(A.shape[2])
    y, q, p = b, b, b
    todo, definite = np.ones(len(multiplier), dtype=np.bool_), np.ones(len(multiplier), dtype=np.bool_)
    for _ in range(_STEPS):
        lower, pivots = _factor(A, multiplier, square)
        definite &= np.min(pivots, axis=0) > least
        y = _substitute(lower, pivots, b - multiplier * shift)
        q = signs * y + shift
        p = _substitute(lower, pivots, q)
        bend = _inner(q, p)
        step = 0.5 * _inner(y, q + shift) / bend
        todo &= definite & (np.abs(step) * np.abs(p).max(axis=0) > _SETTLED * np.abs(y).max(axis=0))
        if not todo.any():
            break
        multiplier = np.where(todo, multiplier + step, multiplier)
    # one Newton step on the optimality conditions; its residual comes from B, not from the squares in A and b
    left = -g
    for j in range(len(y)):
        left = left + B[:, j] * y[j]
    slope = _substitute(lower, pivots, across(B, left) + multiplier * q)
    y = y - slope - p * ((0.5 * _inner(y, q + shift) - _inner(q, slope)) / bend)
    return y, definite & ~todo & np.isfinite(y).all(axis=0)


def _factor(A: Array, multiplier: Array, square: Array) -> tuple[list[list[Array]], list[Array]]:
    """Return the unit lower factor and pivots of ``A + multiplier diag(square)``; A is (n, n, N), `multiplier` (N,)."""
    lower: list[list[Array]] = []
    pivots: list[Array] = []
    for i in range(len(A)):
        raw: list[Array] = []
        row: list[Array] = []
        pivot = A[i, i] + square[i] * multiplier
        for j in range(i):
            entry = A[i, j]
            for k in range(j):
                entry = entry - raw[k] * lower[j][k]
            raw.append(entry)
            row.append(entry / pivots[j])
            pivot = pivot - entry * row[j]
        lower.append(row)
        pivots.append(pivot)
    return lower, pivots


def _substitute(lower: list[list[Array]], pivots: list[Array], right: Array) -> Array:
    """Return the solution (n, N) of the system whose factor and pivots `_factor` returned, for a right side (n, N)."""
    n = len(pivots)
    out = np.empty_like(right)
    for i in range(n):
        value = right[i]
        for j in range(i):
            value = value - lower[i][j] * out[j]
        out[i] = value
    for i in reversed(range(n)):
        out[i] /= pivots[i]
        for j in range(i + 1, n):
            out[i] -= lower[j][i] * out[j]
    return out


def _inner(a: Array, b: Array) -> Array:
    """Return the inner products (N,) of vectors (n, N)."""
    total = a[0] * b[0]
    for i in range(1, len(a)):
        total = total + a[i] * b[i]
    return np.asarray(total)


# The cone: every stationary point from one secular equation.
#
# Let L L' = A + lambda_0 C, let gamma_0 < 0 < gamma_1 <= .. and W be the eigenpairs of L^-1 C L^-T, and V = L^-T W,
# f = V'b, a_j = -gamma_j / gamma_0. Then, with t = 1 / (1 + (lambda - lambda_0) gamma_0),
#
#     y(t) = t (f_0 v_0 + sum_j f_j v_j / ((1 + a_j) (t - p_j))),    p_j = a_j / (1 + a_j),
#     sum_j a_j f_j^2 / (1 + a_j)^2 / (t - p_j)^2 = f_0^2 .
#
# The apex y = 0 has no multiplier and is added.


def _cone_points(B: Array, g: Array, find: Finder) -> tuple[Array, Mask]:
    """Return stationary points (n, K, N) on ``|x| = |r|``, and whether each slot contains one (K, N).

    B (q, n, N) and g (q, N) are finite. `find` is `largest` (one slot) or `everything` (K = 2n - 1 slots, the last one
    the apex).
    """
    n = B.shape[1]
    A, b = normal(B, g)
    gamma, V, shift, known = _pencil(A)
    f = across(V, b)
    ratio = -gamma[1:] / gamma[0]
    tall = 1.0 + ratio
    gap = (ratio[None] - ratio[:, None]) / (tall[None] * tall[:, None])
    weight, level = ratio * (f[1:] / tall) ** 2, f[0] ** 2
    # without weight a pole vanishes, and with it the root on this pole
    floor = _FLOOR**2 * (weight.max(axis=0) + level) + _LEAST
    weight, level = np.maximum(weight, floor), np.maximum(level, floor)
    roots = find(Secular(gap, ratio / tall, weight, level, np.zeros_like(level)))
    heavy = np.copysign(np.sqrt(weight / ratio), f[1:])
    first = np.copysign(np.sqrt(level), f[0])
    inner = np.concatenate([(roots.t * first)[None], roots.t * (heavy[:, None] / roots.apart)])
    y = apply(V, inner)
    # polish: one Newton step on the optimality conditions, whose matrix in the basis V is bordered by q
    D = np.concatenate([1.0 / roots.t[None], tall[:, None] * roots.apart / roots.t])
    multiplier = (1.0 / roots.t - 1.0) / gamma[0] + shift
    sign = np.ones((n, 1, 1))
    sign[-1] = -1.0
    slope = apply(B.transpose(1, 0, 2), apply(B, y) - g[:, None]) + multiplier * sign * y
    q = gamma[:, None] * inner
    move = bordered(D, q, 0.0, -apply(V.transpose(1, 0, 2), slope), -0.5 * (sign * y * y).sum(axis=0))
    y = correct(y, apply(V, move))
    found = roots.found & known & (np.abs((sign * y * y).sum(axis=0)) <= _OFF * (y * y).sum(axis=0))
    if y.shape[1] > 1:
        y[:, -1], found[-1] = 0.0, known
    return y, found


def _pencil(A: Array) -> tuple[Array, Array, Array, Mask]:
    """Return eigenpairs of ``C v = gamma (A + shift C) v``, the shift, and whether the rank of A is at least n - 1.

    The eigenvalues (n, N) ascend. The eigenvectors (n, n, N) are normalised to ``v'(A + shift C)v = 1``.
    """
    n, _, count = A.shape
    signs = np.ones((n, 1))
    signs[-1] = -1.0
    shift, known = np.zeros(count), np.ones(count, dtype=np.bool_)
    X, weak = _inverse_factor(A)
    if weak.any():
        # the middle of the interval where A + shift C is definite, from A plus a small multiple of the unit matrix
        poor = np.ascontiguousarray(A[..., weak])
        size = np.einsum("iiN->iN", poor)
        known[weak] = _rank(poor, size) >= n - 1
        lifted = poor + _LIFT * size.max(axis=0) * np.eye(n)[..., None]
        ends = eigen(_congruent(_inverse_factor(lifted)[0], signs))[0]
        shift[weak] = -0.5 / ends[-1] - 0.5 / ends[0]
        X[..., weak] = _inverse_factor(poor + shift[weak] * signs[:, None] * np.eye(n)[..., None])[0]
    gamma, W = eigen(_congruent(X, signs))
    return gamma, apply(X.transpose(1, 0, 2), W), shift, known


def _inverse_factor(A: Array) -> tuple[Array, Mask]:
    """Return the inverse Cholesky factor (n, n, N) of A, and the mask (N,) of items with a pivot that is too small.

    The factor of a marked item has no meaning.
    """
    n, _, count = A.shape
    L, X, weak = np.zeros_like(A), np.zeros_like(A), np.zeros(count, dtype=np.bool_)
    least = _SEMIDEFINITE * np.einsum("iiN->iN", A).max(axis=0)
    for i in range(n):
        for j in range(i):
            L[i, j] = (A[i, j] - (L[i, :j] * L[j, :j]).sum(axis=0)) * X[j, j]
        pivot = A[i, i] - (L[i, :i] * L[i, :i]).sum(axis=0)
        weak |= ~(pivot > least)
        X[i, i] = 1.0 / np.sqrt(pivot)
        for j in range(i):
            X[i, j] = -(L[i, j:i] * X[j:i, j]).sum(axis=0) * X[i, i]
    return X, weak


def _congruent(X: Array, signs: Array) -> Array:
    """Return the matrices ``X diag(signs) X'`` (n, n, N)."""
    n = len(X)
    M = np.empty_like(X)
    for i in range(n):
        for j in range(i + 1):
            M[i, j] = M[j, i] = (X[i] * X[j] * signs).sum(axis=0)
    return M


def _rank(A: Array, size: Array) -> NDArray[np.int64]:
    """Return the rank (N,) of positive semidefinite matrices after scaling their columns; `size` is their diagonal."""
    most = size.max(axis=0)
    scale = 1.0 / np.sqrt(np.where(size > _FLAT**2 * most, size, np.where(most > 0.0, most, 1.0)))
    values = eigen(A * scale[:, None] * scale)[0]
    return np.asarray((values > _FLAT).sum(axis=0), dtype=np.int64)


# The paraboloid: every stationary point from one secular equation.
#
# Let (a, A_ww) be the column of w, S = A_xx - a a' / A_ww = V s V', alpha = V'a / (2 A_ww) and
# beta = V'(b_x - a b_w / A_ww). Eliminating w leaves x = V (u - alpha) with
#
#     u_j = (beta_j + s_j alpha_j) / (lambda + s_j),    |u|^2 = |alpha|^2 + b_w / A_ww + lambda / (2 A_ww) .


def _paraboloid_points(B: Array, g: Array, find: Finder) -> tuple[Array, Mask]:
    """Return stationary points (n, K, N) on ``|x|^2 = w``, and whether each slot contains one (K, N).

    B (q, n, N) and g (q, N) are finite. `find` is `largest` (one slot) or `everything` (K = 2n - 1 slots).
    """
    A, b = normal(B, g)
    d = A.shape[0] - 1
    trace = np.einsum("iiN->N", A[:d, :d])
    free = A[d, d] <= _FLOOR * trace
    corner = np.where(free, _FLOOR * trace, A[d, d])
    half = 0.5 * A[:d, d] / corner
    S = A[:d, :d] - 2.0 * half[:, None] * A[None, :d, d]
    s, V = eigen(S)
    # poles ascend as the eigenvalues descend
    s, V = np.maximum(s[::-1], 0.0), V[:, ::-1]
    # directions that the rows leave undetermined: with two of them the rank of A is less than n - 1
    missing = (s <= _FLAT * trace).sum(axis=0) + free
    alpha = across(V, half)
    c = across(V, b[:d] - 2.0 * half * b[d]) + s * alpha
    level, slope = (alpha * alpha).sum(axis=0) + b[d] / corner, 0.5 / corner
    floor = _FLOOR**2 * ((c * c).max(axis=0) + (s.max(axis=0)) ** 2 * np.abs(level)) + _LEAST
    weight = np.maximum(c * c, floor)
    roots = find(Secular(s[:, None] - s[None], -s, weight, level, slope))
    u = np.copysign(np.sqrt(weight), c)[:, None] / roots.apart
    x = apply(V, u - alpha[:, None])
    y = np.concatenate([x, (x * x).sum(axis=0)[None]])
    # polish: Newton's step of the cost in x, whose Hessian is V (D + 4 A_ww u u') V'
    slope_y = apply(B.transpose(1, 0, 2), apply(B, y) - g[:, None])
    slope_x = slope_y[:d] + 2.0 * slope_y[d] * x
    move = bordered(roots.apart, u, -0.25 / corner, -apply(V.transpose(1, 0, 2), slope_x), np.zeros(u.shape[1:]))
    x = correct(x, apply(V, move))
    return np.concatenate([x, (x * x).sum(axis=0)[None]]), roots.found & (missing < 2)


# The intersection of a line of least-squares solutions with the quadric.
#
# If B has rank n - 1 (or its weakest direction is noise), the minimisers of |B y - g|^2 are the line y_0 + t v. On this
# line the constraint is a quadratic in t. This is for the few problems whose v is almost on the cone: no multiplier
# separates the two solutions from a solution at infinity.


def _line_points(B: Array, g: Array, square: Array, linear: Array) -> tuple[Array, Mask]:
    """Return both points (N, 2, n) of the solution line on the quadric, and whether they exist (N, 2).

    The batch is the first axis here: B (N, q, n), g (N, q). `square` and `linear` (n,) are the diagonal of C and the
    vector h. The function uses the stable form of the quadratic formula; a vanishing leading coefficient leaves one
    point.
    """
    n = B.shape[-1]
    with np.errstate(all="ignore"):
        # rows of zeros give n singular values also if there are fewer rows than unknowns
        u, s, vt = np.linalg.svd(np.concatenate([B, np.zeros((len(B), n, n))], axis=1), full_matrices=False)
        weak = vt[:, -1]
        share = np.einsum("Nqk,Nq->Nk", u[:, : B.shape[1], :-1], g) / s[:, :-1]
        base = np.einsum("Nk,Nkn->Nn", share, vt[:, :-1])
        lead = (square * weak * weak).sum(-1)
        half = (square * base * weak + linear * weak).sum(-1)
        rest = (square * base * base + 2.0 * linear * base).sum(-1)
        bent = half * half - lead * rest
        sharp = -half - np.copysign(np.sqrt(np.maximum(bent, 0.0)), half)
        t = np.stack([rest / sharp, sharp / lead], axis=1)
        y = base[:, None] + t[..., None] * weak[:, None]
        known = (bent >= 0.0) & (s[:, -2] > _DEPENDENT * s[:, 0])
    return y, known[:, None] & np.isfinite(y).all(axis=-1)
