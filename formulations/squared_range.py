r"""Squared-range least squares: a linear fit with one quadratic constraint, solved exactly.

.. math:: \min_y \; |B y - g|^2 \quad\text{subject to}\quad y^\top C y + 2 h^\top y = 0

for two quadrics. The *cone*, :math:`y = (x, r)`, `C = diag(1, .., 1, -1)`, `h = 0`: `x` is measured from a reference
point and `r` is its distance (range differences, arrival times, range sums, bearings). The *paraboloid*, :math:`y =
(x, w)`, `C = diag(1, .., 1, 0)`, `h = (0, .., 0, -1/2)`: `w` is :math:`|x|^2` (ranges, ratios of ranges, bearings).

A multiplier :math:`\lambda` makes every stationary point but the apex of the cone a solution of
:math:`(B^\top B + \lambda C) y = B^\top g - \lambda h`. Both cases become :math:`\sum_j c_j^2/(t - p_j)^2 = \kappa +
\sigma t` (:mod:`formulations.secular`), with d poles:

- cone: :math:`C v_j = \gamma_j (A + \lambda_0 C) v_j`, one negative :math:`\gamma_0`, and :math:`t = 1/(1 + (\lambda
  - \lambda_0) \gamma_0)`. Adding :math:`\lambda_0 C` changes no value on the cone; it makes the pencil definite when
  :math:`A = B^\top B` is singular;
- paraboloid: `w` is eliminated by its own (linear) equation and :math:`t = \lambda`.

The global minimiser is the root above the last pole, where :math:`B^\top B + \lambda C` is positive semidefinite (no
gap). A singular `A` is the hard case: a root sits on a pole, and both intersections of the solution line with the
quadric appear.

Sources: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), section 3; A.
Beck, P. Stoica and J. Li, "Exact and approximate solutions of source localization problems", IEEE Trans. Signal
Process. 56 (2008), section II (ranges: the paraboloid) and section III (range differences: the cone).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from formulations.secular import (
    Roots,
    Secular,
    accept,
    across,
    across_many,
    apply,
    bordered,
    descend,
    eigen,
    everything,
    largest,
    normal,
)

# Squared-range least squares on the cone: every stationary point from one secular equation.
#
# :math:`\min |B y - g|^2` over :math:`y = (x, r)`, :math:`y^\top C y = |x|^2 - r^2 = 0`. With :math:`A = B^\top B`,
# :math:`b = B^\top g` the stationary points solve :math:`(A + \lambda C) y = b`. Let :math:`L L^\top = A + \lambda_0
# C`, let :math:`\gamma_0 < 0 < \gamma_1 \le \dots` and `W` be the eigenpairs of :math:`L^{-1} C L^{-\top}`, and
# :math:`V = L^{-\top} W`, :math:`f = V^\top b`, :math:`a_j = -\gamma_j / \gamma_0`. Then, with :math:`t = 1/(1 +
# (\lambda - \lambda_0) \gamma_0)`,
#
# .. math:: y(t) = t \Big( f_0 v_0 + \sum_j \frac{f_j v_j}{(1 + a_j)(t - p_j)} \Big), \qquad p_j = \frac{a_j}{1 + a_j},
#    \qquad \sum_j \frac{a_j f_j^2 / (1 + a_j)^2}{(t - p_j)^2} = f_0^2 .
#
# Adding :math:`\lambda_0 C` changes no value on the cone; it makes the pencil definite where `A` is singular, the
# middle of the definite interval being the safest choice. The apex ``y = 0`` has no multiplier and is added.
#
# Sources: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), theorem 3.2; the
# map to a trust-region equation is a direct computation.

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Finder = Callable[[Secular], Roots]

_FLAT = 1e-13  # eigenvalues of the scaled normal matrix below this are zero
_WEAK = 1e-8  # normal matrices with a Cholesky pivot below this share of the largest entry are shifted along C
_LIFT = 1e-9  # what is added to them to find the shift
_OFF = 1e-6  # relative distance from the cone at which a point is no point
_TINY = 1e-15  # relative floor of the secular weights


def solve_cone(B: Array, g: Array, find: Finder) -> tuple[Array, Mask]:
    """Stationary points on ``|x| = |r|``.

    Parameters
    ----------
    B : Array, shape (q, n, N)
        Rows, finite.
    g : Array, shape (q, N)
        Right sides, finite.
    find : Finder
        `formulations.secular.largest` (one slot) or `everything` (K = 2n - 1 slots, the last one the apex).

    Returns
    -------
    y : Array, shape (n, K, N)
        Points; meaningless where not found.
    found : Mask, shape (K, N)
        Slots that hold a point.

    Notes
    -----
    More (1993), section 3.
    """
    n = B.shape[1]
    A, b = normal(B, g)
    gamma, V, shift, known = _pencils(A)
    f = across(V, b)
    ratio = -gamma[1:] / gamma[0]
    tall = 1.0 + ratio
    gap = (ratio[None] - ratio[:, None]) / (tall[None] * tall[:, None])
    weight, level = ratio * (f[1:] / tall) ** 2, f[0] ** 2
    floor = _TINY**2 * (weight.max(axis=0) + level) + 1e-200
    weight, level = np.maximum(weight, floor), np.maximum(level, floor)
    roots = find(Secular(gap, ratio / tall, weight, level, np.zeros_like(level)))
    heavy = np.copysign(np.sqrt(weight / ratio), f[1:])
    first = np.copysign(np.sqrt(level), f[0])
    inner = np.concatenate([(roots.t * first)[None], roots.t * (heavy[:, None] / roots.apart)])
    y = apply(V, inner)
    # polish: (D, q) is the bordered system in the basis V
    D = np.concatenate([1.0 / roots.t[None], tall[:, None] * roots.apart / roots.t])
    multiplier = (1.0 / roots.t - 1.0) / gamma[0] + shift
    sign = np.ones((n, 1, 1))
    sign[-1] = -1.0
    slope = across_many(B, apply(B, y) - g[:, None]) + multiplier * sign * y
    q = gamma[:, None] * inner
    move = bordered(D, q, 0.0, -across_many(V, slope), -0.5 * (sign * y * y).sum(axis=0))
    y = accept(y, apply(V, move))
    found = roots.found & known & (np.abs((sign * y * y).sum(axis=0)) <= _OFF * (y * y).sum(axis=0))
    if y.shape[1] > 1:
        y[:, -1], found[-1] = 0.0, known
    return y, found


def _pencils(A: Array) -> tuple[Array, Array, Array, Mask]:
    """Eigenpairs of ``C v = gamma (A + shift C) v``, ``v'(A + shift C)v = 1``, the shift, and rank A >= n - 1."""
    n, _, count = A.shape
    signs = np.ones((n, 1))
    signs[-1] = -1.0
    shift, known = np.zeros(count), np.ones(count, dtype=np.bool_)
    X, weak = _inverse_factor(A)
    if weak.any():
        # the middle of the interval where A + shift C is definite, from a slightly lifted A
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
    """Inverse Cholesky factor, and where a pivot is so small that it says nothing (there the factor is not used)."""
    n, _, count = A.shape
    L, X, weak = np.zeros_like(A), np.zeros_like(A), np.zeros(count, dtype=np.bool_)
    least = _WEAK * np.einsum("iiN->iN", A).max(axis=0)
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
    """``X diag(signs) X'``."""
    n = len(X)
    M = np.empty_like(X)
    for i in range(n):
        for j in range(i + 1):
            M[i, j] = M[j, i] = (X[i] * X[j] * signs).sum(axis=0)
    return M


def _rank(A: Array, size: Array) -> NDArray[np.int64]:
    """Rank of positive semidefinite matrices with their columns scaled."""
    most = size.max(axis=0)
    scale = 1.0 / np.sqrt(np.where(size > _FLAT**2 * most, size, np.where(most > 0.0, most, 1.0)))
    values = eigen(A * scale[:, None] * scale)[0]
    return np.asarray((values > _FLAT).sum(axis=0), dtype=np.int64)


# Squared-range least squares on the paraboloid: every stationary point from one secular equation.
#
# :math:`\min |B y - g|^2` over :math:`y = (x, w)`, :math:`|x|^2 = w`. With :math:`A = B^\top B`, :math:`b = B^\top g`
# the stationary points solve :math:`(A + \lambda C) y = b + \tfrac12 \lambda e_w`. Let `(a, A_ww)` be the column of
# `w`, :math:`S = A_{xx} - a a^\top / A_{ww} = V s V^\top`, :math:`\alpha = V^\top a / (2 A_{ww})`, :math:`\beta =
# V^\top (b_x - a b_w / A_{ww})`. Eliminating `w` leaves :math:`x = V (u - \alpha)` with
#
# .. math:: u_j = \frac{\beta_j + s_j \alpha_j}{\lambda + s_j}, \qquad
#    |u|^2 = |\alpha|^2 + \frac{b_w}{A_{ww}} + \frac{\lambda}{2 A_{ww}} .
#
# Sources: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), theorem 3.2; the
# elimination is a direct computation.


def solve_paraboloid(B: Array, g: Array, find: Finder) -> tuple[Array, Mask]:
    """Stationary points on ``|x|^2 = w``.

    Parameters
    ----------
    B : Array, shape (q, n, N)
        Rows, finite.
    g : Array, shape (q, N)
        Right sides, finite.
    find : Finder
        `formulations.secular.largest` (one slot) or `everything` (K = 2n - 1 slots).

    Returns
    -------
    y : Array, shape (n, K, N)
        Points; meaningless where not found.
    found : Mask, shape (K, N)
        Slots that hold a point.

    Notes
    -----
    The direct computation of the module's first lines.
    """
    A, b = normal(B, g)
    d = A.shape[0] - 1
    trace = np.einsum("iiN->N", A[:d, :d])
    free = A[d, d] <= _TINY * trace
    corner = np.where(free, _TINY * trace, A[d, d])
    half = 0.5 * A[:d, d] / corner
    S = A[:d, :d] - 2.0 * half[:, None] * A[None, :d, d]
    s, V = eigen(S)
    # poles ascend as the eigenvalues descend
    s, V = np.maximum(s[::-1], 0.0), V[:, ::-1]
    missing = (s <= _FLAT * trace).sum(axis=0) + free
    alpha = across(V, half)
    c = across(V, b[:d] - 2.0 * half * b[d]) + s * alpha
    level, slope = (alpha * alpha).sum(axis=0) + b[d] / corner, 0.5 / corner
    floor = _TINY**2 * ((c * c).max(axis=0) + (s.max(axis=0)) ** 2 * np.abs(level)) + 1e-200
    weight = np.maximum(c * c, floor)
    roots = find(Secular(s[:, None] - s[None], -s, weight, level, slope))
    u = np.copysign(np.sqrt(weight), c)[:, None] / roots.apart
    x = apply(V, u - alpha[:, None])
    y = np.concatenate([x, (x * x).sum(axis=0)[None]])
    # polish: Newton's step of the cost in x, whose Hessian is V (D + 4 A_ww u u') V'
    slope_y = across_many(B, apply(B, y) - g[:, None])
    slope_x = slope_y[:d] + 2.0 * slope_y[d] * x
    move = bordered(roots.apart, u, -0.25 / corner, -across_many(V, slope_x), np.zeros(u.shape[1:]))
    x = accept(x, apply(V, move))
    return np.concatenate([x, (x * x).sum(axis=0)[None]]), roots.found & (missing < 2)


# A line of least-squares solutions met with a quadric.
#
# Where `B` has rank n - 1 (or is so near that its weakest direction is noise) the minimisers of :math:`|B y - g|^2` are
# the line :math:`y_0 + t v`, and :math:`y^\top C y + 2 h^\top y = 0` along it is :math:`(v^\top C v)\, t^2 + 2 (v^\top
# C y_0 + h^\top v)\, t + y_0^\top C y_0 + 2 h^\top y_0 = 0`. This serves the few items whose direction `v` lies almost
# on the cone: there no multiplier separates the two solutions from one at infinity.
#
# Source: P. Stoica and J. Li, "Source localization from range-difference measurements", IEEE Signal Process. Mag. 23
# (2006), where the minimal case is the quadratic in the reference range; the direction comes from the singular value
# decomposition.

_DEPENDENT = 1e-7  # singular values below this share of the largest are missing ranks


def intersections(B: Array, g: Array, square: Array, linear: Array) -> tuple[Array, Mask]:
    """Both points of the solution line on the quadric.

    Parameters
    ----------
    B : Array, shape (N, q, n)
        Rows, finite.
    g : Array, shape (N, q)
        Right sides, finite.
    square, linear : Array, shape (n,)
        Diagonal of C and the vector h.

    Returns
    -------
    y : Array, shape (N, 2, n)
        Points.
    ok : Mask, shape (N, 2)
        False where the line misses the quadric or `B` lacks two ranks.

    Notes
    -----
    The stable form of the quadratic formula; a vanishing leading coefficient leaves one point.
    """
    n = B.shape[-1]
    with np.errstate(all="ignore"):
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


_CHUNK = 2048


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
        """Diagonal of C, shape (size,)."""
        out = np.ones(self.size)
        out[-1] = -1.0 if self.shape == "cone" else 0.0
        return out

    @property
    def linear(self) -> Array:
        """The vector h, shape (size,)."""
        out = np.zeros(self.size)
        out[-1] = 0.0 if self.shape == "cone" else -0.5
        return out

    def value(self, y: Array) -> Array:
        """``y'Cy + 2h'y``.

        Parameters
        ----------
        y : Array, shape (..., size)
            Points.

        Returns
        -------
        Array, shape (...)
            Zero on the quadric.
        """
        return np.asarray(np.sum(self.square * y * y + 2.0 * self.linear * y, axis=-1))


def cone(d: int) -> Quadric:
    """Quadric ``|x|^2 = r^2`` with ``x`` of dimension `d`.

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
    """Quadric ``|x|^2 = w`` with ``x`` of dimension `d`.

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
    """Global minimiser of ``|By - g|^2`` on the quadric.

    Parameters
    ----------
    B : Array, shape (..., q, n)
        Whitened rows, numbers of order one; absent rows are zero.
    g : Array, shape (..., q)
        Right sides.
    quadric : Quadric
        The constraint, of size n.
    positive : bool
        Minimise over the half ``y[-1] >= 0``; matters for the cone only.

    Returns
    -------
    y : Array, shape (..., n)
        The minimiser, NaN where `ok` is False. Where ``B'B`` has rank n - 1 it may be one of two.
    ok : Mask, shape (...)
        False where the input is not finite or ``B'B`` lacks two or more ranks.

    Notes
    -----
    More (1993), theorem 3.2; Beck, Stoica and Li (2008), sections II and III.
    """
    rows, right, shape = _flat(B, g, quadric)
    y, ok = np.empty((len(rows), quadric.size)), np.empty(len(rows), dtype=np.bool_)
    with np.errstate(all="ignore"):
        for part, b, h, _ in _chunks(rows, right):
            points, ok[part] = descend(b, h, quadric.square, quadric.linear)
            y[part] = points.T
    # what does not settle is gathered over all chunks: small batches are dear
    hard = np.flatnonzero(~ok)
    if hard.size:
        points, _, valid = _solved(rows[hard], right[hard], quadric, largest)
        y[hard], ok[hard] = points[:, 0], valid[:, 0]
    if positive and quadric.shape == "cone":
        wrong = np.flatnonzero(ok & (y[:, -1] < 0.0))
        if wrong.size:
            y[wrong] = stationary(rows[wrong], right[wrong], quadric, positive=True)[0][:, 0]
    return y.reshape(*shape, quadric.size), ok.reshape(shape)


def stationary(B: Array, g: Array, quadric: Quadric, *, positive: bool = False) -> tuple[Array, Array, Mask]:
    """All real stationary points of ``|By - g|^2`` on the quadric, the cheapest first.

    Parameters
    ----------
    B : Array, shape (..., q, n)
        Whitened rows, numbers of order one; absent rows are zero.
    g : Array, shape (..., q)
        Right sides.
    quadric : Quadric
        The constraint, of size n.
    positive : bool
        Drop points with ``y[-1] < 0`` (a negative range).

    Returns
    -------
    y : Array, shape (..., K, n)
        Points, NaN where not valid; K = 2n - 1. The cone has at most 2(n - 1) with a multiplier, and its apex
        ``y = 0``, where the gradient of the constraint vanishes. The paraboloid has at most 2n - 1.
    cost : Array, shape (..., K)
        ``|By - g|^2``, ascending, infinite where not valid.
    valid : Mask, shape (..., K)
        Nothing is valid where the input is not finite or ``B'B`` lacks two or more ranks.

    Notes
    -----
    Real roots of the numerator of the secular equation, without forming it. Where ``B'B`` has rank n - 1, both
    intersections of the line of least-squares solutions with the quadric are among them.
    """
    rows, right, shape = _flat(B, g, quadric)
    y, cost, valid = _solved(rows, right, quadric, everything)
    if positive:
        valid &= y[..., -1] >= 0.0
    y[~valid], cost[~valid] = np.nan, np.inf
    order = np.argsort(cost, axis=-1, kind="stable")
    y = np.take_along_axis(y, order[..., None], axis=1)
    cost, valid = np.take_along_axis(cost, order, axis=1), np.take_along_axis(valid, order, axis=1)
    k, n = 2 * quadric.size - 1, quadric.size
    return y.reshape(*shape, k, n), cost.reshape(*shape, k), valid.reshape(*shape, k)


def _flat(B: Array, g: Array, quadric: Quadric) -> tuple[Array, Array, tuple[int, ...]]:
    """Give inputs one batch axis, and the leading axes they had."""
    B, g = np.asarray(B, dtype=np.float64), np.asarray(g, dtype=np.float64)
    if B.ndim < 2 or g.ndim < 1 or B.shape[-1] != quadric.size or B.shape[-2] != g.shape[-1]:
        raise ValueError(f"rows {B.shape} and right sides {g.shape} do not fit a quadric of size {quadric.size}")
    shape = np.broadcast_shapes(B.shape[:-2], g.shape[:-1])
    count = int(np.prod(shape))
    rows = np.broadcast_to(B, (*shape, *B.shape[-2:])).reshape(count, *B.shape[-2:])
    return rows, np.broadcast_to(g, (*shape, g.shape[-1])).reshape(count, g.shape[-1]), shape


def _chunks(rows: Array, right: Array) -> Iterator[tuple[slice, Array, Array, Mask]]:
    """Yield parts that fit the cache, the batch on the last axis; items that are not finite are zeroed and named."""
    for i in range(0, len(rows), _CHUNK):
        part = slice(i, i + _CHUNK)
        b, h = np.moveaxis(rows[part], 0, -1).copy(), right[part].T.copy()
        bad = ~(np.isfinite(b).all(axis=(0, 1)) & np.isfinite(h).all(axis=0))
        b[..., bad], h[..., bad] = 0.0, 0.0
        yield part, b, h, np.asarray(bad)


def _solved(rows: Array, right: Array, quadric: Quadric, find: Finder) -> tuple[Array, Array, Mask]:
    """Points, costs and validity of every slot by the secular equation."""
    slots = 1 if find is largest else 2 * quadric.size - 1
    count, n = len(rows), quadric.size
    y, cost = np.empty((count, slots, n)), np.empty((count, slots))
    valid, usable = np.empty((count, slots), dtype=np.bool_), np.empty(count, dtype=np.bool_)
    solve = solve_cone if quadric.shape == "cone" else solve_paraboloid
    with np.errstate(all="ignore"):
        for part, b, h, bad in _chunks(rows, right):
            points, found = solve(b, h, find)
            found &= np.isfinite(points).all(axis=0) & ~bad
            left = apply(b, points) - h[:, None]
            y[part], valid[part], cost[part] = points.transpose(2, 1, 0), found.T, (left * left).sum(axis=0).T
            usable[part] = ~bad
    roots = slots - 1 if quadric.shape == "cone" and slots > 1 else slots
    lost = np.flatnonzero(usable & ~valid[:, :roots].any(axis=1))
    if lost.size:
        points, met = intersections(rows[lost], right[lost], quadric.square, quadric.linear)
        few = min(roots, 2)
        y[lost, :few], valid[lost, :few] = points[:, :few], met[:, :few]
        left = np.einsum("Nqn,Nkn->Nkq", rows[lost], points[:, :few]) - right[lost, None]
        cost[lost, :few] = (left * left).sum(axis=-1)
    y[~valid], cost[~valid] = np.nan, np.inf
    return y, cost, valid
