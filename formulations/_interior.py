r"""Newton's iteration on the multiplier of squared-range least squares, where its Lagrangian is positive definite.

On the interval where :math:`A + \lambda C \succ 0` the function :math:`\varphi(\lambda) = y^\top C y + 2 h^\top y`
with :math:`y = (A + \lambda C)^{-1} (b - \lambda h)` decreases with slope :math:`-2 q^\top (A + \lambda C)^{-1} q`,
:math:`q = C y + h`, and its only zero is the global minimiser (More, 1993, theorem 3.2). Started at :math:`\lambda =
0`, the unconstrained fit, a few factorisations suffice for data of ordinary noise, at a fraction of the price of an
eigenvalue problem. Items that leave the interval or do not settle are reported and go to the secular equation.

Source: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), theorem 3.2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from formulations._batch import across, normal

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_STEPS = 5
_WEAK = 1e-7  # a pivot below this share of the largest entry: the secular equation is the better tool
_SETTLED = 1e-7  # relative change of y below which the last, polishing step squares the error away


def descend(B: Array, g: Array, square: Array, linear: Array) -> tuple[Array, Mask]:
    """Global minimisers of the items that are easy.

    Parameters
    ----------
    B : Array, shape (q, n, N)
        Rows, finite.
    g : Array, shape (q, N)
        Right sides, finite.
    square, linear : Array, shape (n,)
        Diagonal of C and the vector h.

    Returns
    -------
    y : Array, shape (n, N)
        Minimisers; meaningless where not settled.
    settled : Mask, shape (N,)
        Items whose iteration converged inside the definite interval.

    Notes
    -----
    More (1993), theorem 3.2.
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
        y = _solve(lower, pivots, b - multiplier * shift)
        q = signs * y + shift
        p = _solve(lower, pivots, q)
        bend = _dot(q, p)
        step = 0.5 * _dot(y, q + shift) / bend
        todo &= definite & (np.abs(step) * np.abs(p).max(axis=0) > _SETTLED * np.abs(y).max(axis=0))
        if not todo.any():
            break
        multiplier = np.where(todo, multiplier + step, multiplier)
    # one Newton step on the optimality conditions, the residual taken from B
    left = -g
    for j in range(len(y)):
        left = left + B[:, j] * y[j]
    slope = _solve(lower, pivots, across(B, left) + multiplier * q)
    y = y - slope - p * ((0.5 * _dot(y, q + shift) - _dot(q, slope)) / bend)
    return y, definite & ~todo & np.isfinite(y).all(axis=0)


def _factor(A: Array, multiplier: Array, square: Array) -> tuple[list[list[Array]], list[Array]]:
    """Find the unit lower factor and pivots of ``A + multiplier diag(square)``."""
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


def _solve(lower: list[list[Array]], pivots: list[Array], right: Array) -> Array:
    """Solve with a factorisation: shape (n, N)."""
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


def _dot(a: Array, b: Array) -> Array:
    """Inner products, shape (N,)."""
    total = a[0] * b[0]
    for i in range(1, len(a)):
        total = total + a[i] * b[i]
    return np.asarray(total)
