r"""Squared-range least squares on the cone: every stationary point from one secular equation.

:math:`\min |B y - g|^2` over :math:`y = (x, r)`, :math:`y^\top C y = |x|^2 - r^2 = 0`. With :math:`A = B^\top B`,
:math:`b = B^\top g` the stationary points solve :math:`(A + \lambda C) y = b`. Let :math:`L L^\top = A + \lambda_0
C`, let :math:`\gamma_0 < 0 < \gamma_1 \le \dots` and `W` be the eigenpairs of :math:`L^{-1} C L^{-\top}`, and
:math:`V = L^{-\top} W`, :math:`f = V^\top b`, :math:`a_j = -\gamma_j / \gamma_0`. Then, with :math:`t = 1/(1 +
(\lambda - \lambda_0) \gamma_0)`,

.. math:: y(t) = t \Big( f_0 v_0 + \sum_j \frac{f_j v_j}{(1 + a_j)(t - p_j)} \Big), \qquad p_j = \frac{a_j}{1 + a_j},
   \qquad \sum_j \frac{a_j f_j^2 / (1 + a_j)^2}{(t - p_j)^2} = f_0^2 .

Adding :math:`\lambda_0 C` changes no value on the cone; it makes the pencil definite where `A` is singular, the middle
of the definite interval being the safest choice. The apex ``y = 0`` has no multiplier and is added.

Sources: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), theorem 3.2; the
map to a trust-region equation is a direct computation.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from formulations._batch import accept, across, across_many, apply, bordered, eigen, normal
from formulations.secular import Roots, Secular

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
