r"""The two reductions of squared-range least squares to a secular equation, with the batch on the last axis.

With :math:`A = B^\top B`, :math:`b = B^\top g` the stationary points solve :math:`(A + \lambda C) y = b - \lambda h`.

Cone. Let :math:`L L^\top = A + \lambda_0 C`, let :math:`\gamma_0 < 0 < \gamma_1 \le \dots` and `W` be the eigenpairs of
:math:`L^{-1} C L^{-\top}`, :math:`V = L^{-\top} W`, :math:`f = V^\top b`, :math:`a_j = -\gamma_j / \gamma_0`. Then

.. math:: y(t) = t \Big( f_0 v_0 + \sum_j \frac{f_j v_j}{(1 + a_j)(t - p_j)} \Big), \qquad p_j = \frac{a_j}{1 + a_j},
   \qquad \sum_j \frac{a_j f_j^2 / (1 + a_j)^2}{(t - p_j)^2} = f_0^2 .

Paraboloid. Let `(a, A_ww)` be the column of `w`, :math:`S = A_{xx} - a a^\top / A_{ww} = V s V^\top`, :math:`\alpha = V^\top a / (2 A_{ww})`,
:math:`\beta = V^\top (b_x - a b_w / A_{ww})`. Then with :math:`t = \lambda`, :math:`x = V (u - \alpha)`,

.. math:: u_j = \frac{\beta_j + s_j \alpha_j}{t + s_j}, \qquad |u|^2 = |\alpha|^2 + \frac{b_w}{A_{ww}} + \frac{t}{2 A_{ww}} .

Each root is polished by one Newton step on the optimality conditions with the residual taken from `B`, not from `A`.

Sources: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), sections 2-3; the map
of the cone to a trust-region equation and the elimination of `w` are direct computations.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

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
    f = _across(V, b)
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
    slope = _across_many(B, apply(B, y) - g[:, None]) + multiplier * sign * y
    q = gamma[:, None] * inner
    move = _bordered(D, q, 0.0, -_across_many(V, slope), -0.5 * (sign * y * y).sum(axis=0))
    y = _accept(y, apply(V, move))
    found = roots.found & known & (np.abs((sign * y * y).sum(axis=0)) <= _OFF * (y * y).sum(axis=0))
    if y.shape[1] > 1:
        y[:, -1], found[-1] = 0.0, known
    return y, found


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
    s, V = _eigen(S)
    # poles ascend as the eigenvalues descend
    s, V = np.maximum(s[::-1], 0.0), V[:, ::-1]
    missing = (s <= _FLAT * trace).sum(axis=0) + free
    alpha = _across(V, half)
    c = _across(V, b[:d] - 2.0 * half * b[d]) + s * alpha
    level, slope = (alpha * alpha).sum(axis=0) + b[d] / corner, 0.5 / corner
    floor = _TINY**2 * ((c * c).max(axis=0) + (s.max(axis=0)) ** 2 * np.abs(level)) + 1e-200
    weight = np.maximum(c * c, floor)
    roots = find(Secular(s[:, None] - s[None], -s, weight, level, slope))
    u = np.copysign(np.sqrt(weight), c)[:, None] / roots.apart
    x = apply(V, u - alpha[:, None])
    y = np.concatenate([x, (x * x).sum(axis=0)[None]])
    # polish: Newton's step of the cost in x, whose Hessian is V (D + 4 A_ww u u') V'
    slope_y = _across_many(B, apply(B, y) - g[:, None])
    slope_x = slope_y[:d] + 2.0 * slope_y[d] * x
    move = _bordered(roots.apart, u, -0.25 / corner, -_across_many(V, slope_x), np.zeros(u.shape[1:]))
    x = _accept(x, apply(V, move))
    return np.concatenate([x, (x * x).sum(axis=0)[None]]), roots.found & (missing < 2)


def normal(B: Array, g: Array) -> tuple[Array, Array]:
    """``B'B`` and ``B'g``.

    Parameters
    ----------
    B : Array, shape (q, n, N)
        Rows.
    g : Array, shape (q, N)
        Right sides.

    Returns
    -------
    A : Array, shape (n, n, N)
        ``B'B``, symmetric.
    b : Array, shape (n, N)
        ``B'g``.

    Notes
    -----
    The normal equations of Gauss (1809).
    """
    n = B.shape[1]
    A = np.empty((n, n, B.shape[2]))
    for i in range(n):
        for j in range(i + 1):
            A[i, j] = A[j, i] = (B[:, i] * B[:, j]).sum(axis=0)
    return A, (B * g[:, None]).sum(axis=0)


def apply(matrix: Array, points: Array) -> Array:
    """``matrix @ points`` for every item and slot.

    Parameters
    ----------
    matrix : Array, shape (m, n, N)
        One matrix per item.
    points : Array, shape (n, K, N)
        K vectors per item.

    Returns
    -------
    Array, shape (m, K, N)
        The products.

    Notes
    -----
    Summed column by column: no item depends on its neighbours in the batch.
    """
    out: Array = matrix[:, 0, None] * points[0]
    for j in range(1, len(points)):
        out += matrix[:, j, None] * points[j]
    return out


def _across(matrix: Array, vector: Array) -> Array:
    """``matrix' @ vector``: (m, n, N), (m, N) -> (n, N)."""
    return np.asarray((matrix * vector[:, None]).sum(axis=0))


def _across_many(matrix: Array, points: Array) -> Array:
    """``matrix' @ points``: (m, n, N), (m, K, N) -> (n, K, N)."""
    return apply(matrix.transpose(1, 0, 2), points)


def _eigen(S: Array) -> tuple[Array, Array]:
    """Eigenpairs of symmetric matrices (n, n, N), ascending; an item that is not finite does not stop the others."""
    bad = ~np.isfinite(S).all(axis=(0, 1))
    batch = np.ascontiguousarray(np.moveaxis(S, -1, 0))
    if bad.any():
        batch[bad] = np.eye(len(S))
    values, vectors = np.linalg.eigh(batch)
    return values.T.copy(), np.moveaxis(vectors, 0, -1).copy()


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
        ends = _eigen(_congruent(_inverse_factor(lifted)[0], signs))[0]
        shift[weak] = -0.5 / ends[-1] - 0.5 / ends[0]
        X[..., weak] = _inverse_factor(poor + shift[weak] * signs[:, None] * np.eye(n)[..., None])[0]
    gamma, W = _eigen(_congruent(X, signs))
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
    values = _eigen(A * scale[:, None] * scale)[0]
    return np.asarray((values > _FLAT).sum(axis=0), dtype=np.int64)


def _bordered(D: Array, q: Array, corner: float | Array, right: Array, last: Array) -> Array:
    """Solve ``[diag D, q; q', corner] (v, .) = (right, last)`` for v, pivoting on one entry that may vanish."""
    pivot = np.argmax(q * q / np.abs(D), axis=0)[None]
    own, edge = np.take_along_axis(D, pivot, axis=0)[0], np.take_along_axis(q, pivot, axis=0)[0]
    share = q * own / D
    np.put_along_axis(share, pivot, edge[None], axis=0)
    multiplier = ((share * right).sum(axis=0) - last * own) / ((share * q).sum(axis=0) - corner * own)
    out = (right - multiplier * q) / D
    np.put_along_axis(out, pivot, 0.0, axis=0)
    rest = (last - corner * multiplier - (q * out).sum(axis=0)) / edge
    np.put_along_axis(out, pivot, rest[None], axis=0)
    return np.asarray(out)


def _accept(y: Array, move: Array) -> Array:
    """Take a polishing step only where it is small: at a fold or the apex it means nothing."""
    good = np.abs(move).max(axis=0) <= 1e-2 * np.abs(y).max(axis=0)
    return np.where(good, y + move, y)
