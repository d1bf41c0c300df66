r"""The secular equation of least squares with one quadratic constraint.

.. math:: \sum_j \frac{c_j^2}{(t - p_j)^2} = \kappa + \sigma t, \qquad \sigma \ge 0,

with poles :math:`p_1 \le \dots \le p_d`. Put :math:`T(t)` for the left side. By Cauchy's inequality
:math:`3 T'^2 \le 2 T T''`, so :math:`T^{-1/2}` is concave between two poles, :math:`(\kappa + \sigma t)^{-1/2}` is
convex where it exists, and

.. math:: k(t) = T(t)^{-1/2} - (\kappa + \sigma t)^{-1/2}

is concave in every interval. Newton's iteration on `k`, started where `k <= 0` beside a pole, therefore climbs
monotonically to the first root on that side of the pole or meets `k' <= 0`, which proves there is none. Every
interval holds at most two roots, one per end, so the two sides of all poles, and for ``sigma > 0`` the zero of the
right side, list all real roots without a polynomial and without a bracket. Each root is held as its distance from its
own pole: roots that fall onto a pole (the "hard case", ``c_j`` near 0) keep their full relative accuracy.

Sources: J. J. More and D. C. Sorensen, "Computing a trust region step", SIAM J. Sci. Stat. Comput. 4 (1983), section 3
(the concave form on the last interval); the use on every interval is the same inequality.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_EPS = float(np.finfo(np.float64).eps)
_STEPS = 80


@dataclass(frozen=True, slots=True)
class Secular:
    r"""A batch of secular equations, the batch on the last axis.

    Parameters
    ----------
    gap : Array, shape (d, d, N)
        Differences of poles ``gap[k, j] = p_j - p_k``, given apart because they may be known better than the poles.
    pole : Array, shape (d, N)
        Poles in ascending order.
    weight : Array, shape (d, N)
        The :math:`c_j^2`, all positive (the caller floors exact zeros).
    level, slope : Array, shape (N,)
        :math:`\kappa` and :math:`\sigma`.
    """

    gap: Array
    pole: Array
    weight: Array
    level: Array
    slope: Array


@dataclass(frozen=True, slots=True)
class Roots:
    """Roots on a batch of secular equations, one per slot.

    Parameters
    ----------
    t : Array, shape (K, N)
        The roots.
    apart : Array, shape (d, K, N)
        ``t - p_j`` with full relative accuracy.
    found : Mask, shape (K, N)
        True where the slot holds a root; the other arrays are meaningless elsewhere.
    """

    t: Array
    apart: Array
    found: Mask


def largest(equation: Secular) -> Roots:
    """Root above the last pole; it is unique, and exists whenever the right side grows or is positive.

    Parameters
    ----------
    equation : Secular
        N equations.

    Returns
    -------
    Roots
        One slot (K = 1).

    Notes
    -----
    More and Sorensen (1983), section 3.
    """
    gap = equation.gap[:, -1:]
    start, free = _start(equation, equation.pole[-1:], equation.weight[-1:], 1.0)
    return _climb(equation, equation.pole[-1:], gap, np.ones((1, 1)), start, free)


def everything(equation: Secular) -> Roots:
    """All real roots.

    Parameters
    ----------
    equation : Secular
        N equations.

    Returns
    -------
    Roots
        Slots: d to the left of each pole, d to the right, and one beside the zero of the right side (K = 2d + 1).

    Notes
    -----
    See the module's first lines; each interval between poles holds at most two roots.
    """
    d = len(equation.pole)
    left, left_free = _start(equation, equation.pole, equation.weight, -1.0)
    right, right_free = _start(equation, equation.pole, equation.weight, 1.0)
    sign = np.concatenate([-np.ones((d, 1)), np.ones((d + 1, 1))])
    slope = np.where(equation.slope > 0.0, equation.slope, 1.0)
    zero = -equation.level / slope
    apart = zero - equation.pole
    tail = np.sum(equation.weight / apart**2, axis=0) / slope
    gap = np.concatenate([equation.gap, equation.gap, apart[:, None]], axis=1)
    pole = np.concatenate([equation.pole, equation.pole, zero[None]])
    start = np.concatenate([left, right, tail[None]])
    exists = (equation.slope > 0.0) & (zero < equation.pole[0])
    free = np.concatenate([left_free, right_free, exists[None]])
    return _climb(equation, pole, gap, sign, start, free)


def _start(equation: Secular, pole: Array, weight: Array, sign: float) -> tuple[Array, Mask]:
    """Distances from the poles that cannot lie beyond the first root, and whether a root is possible at all."""
    level, slope = equation.level + equation.slope * pole, equation.slope
    positive = level > 0.0
    safe = np.where(positive, level, 1.0)
    if sign < 0.0:
        return np.sqrt(weight / safe), positive
    grows = slope > 0.0
    if not grows.any():
        return np.sqrt(weight / safe), positive
    rate = np.where(grows, slope, 1.0)
    cube = np.where(grows, np.cbrt(0.25 * weight / rate), np.inf)
    above = np.minimum(np.sqrt(0.5 * weight / safe), cube)
    away = np.where(positive, 1.0, -level / rate)
    below = away + np.minimum(0.25 * weight / (rate * away**2), cube)
    return np.where(positive, above, np.where(away > 0.0, below, cube)), positive | grows


def _climb(equation: Secular, origin: Array, gap: Array, sign: Array, start: Array, free: Mask) -> Roots:
    """Newton's monotone iteration from every start; ``gap[k, i]`` is the distance of origin i from pole k."""
    weight = equation.weight[:, None]
    level = equation.level + equation.slope * origin
    slope = equation.slope * sign
    away, todo, found = start.copy(), free.copy(), np.zeros(free.shape, dtype=np.bool_)
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            apart = gap + sign * away
            part = weight / (apart * apart)
            total = part.sum(axis=0)
            right = level + slope * away
            root, side = 1.0 / np.sqrt(total), 1.0 / np.sqrt(right)
            value = root - side
            change = sign * (part / apart).sum(axis=0) * root / total + 0.5 * slope * side / right
            step = -value / change
            # a level too high for the interval: no root, k' changes sign first
            todo &= (change > 0.0) & np.isfinite(step)
            done = todo & (step <= 4.0 * _EPS * away)
            found |= done
            todo &= ~done
            if not todo.any():
                break
            away = np.where(todo, away + step, away)
    apart = gap + sign * away
    # a Newton step may jump over the next pole when the interval holds no root
    found &= np.all((apart * gap > 0.0) | (gap == 0.0), axis=0) & np.all((gap != 0.0) | (apart * sign > 0.0), axis=0)
    return Roots(origin + sign * away, apart, found)


# Small linear algebra on batches whose batch is the last axis.
#
# Every product is a fixed chain of elementwise operations: an item that is singular or not finite changes no bit of its
# neighbours, and problems of three or four unknowns cost no call per matrix. Textbook formulas; the bordered system is
# the one of a Newton step on the optimality conditions (J. Nocedal and S. J. Wright, "Numerical Optimization", 2006,
# section 16.1).


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


def across(matrix: Array, vector: Array) -> Array:
    """``matrix' @ vector`` for every item.

    Parameters
    ----------
    matrix : Array, shape (m, n, N)
        One matrix per item.
    vector : Array, shape (m, N)
        One vector per item.

    Returns
    -------
    Array, shape (n, N)
        The products.
    """
    return np.asarray((matrix * vector[:, None]).sum(axis=0))


def across_many(matrix: Array, points: Array) -> Array:
    """``matrix' @ points`` for every item and slot.

    Parameters
    ----------
    matrix : Array, shape (m, n, N)
        One matrix per item.
    points : Array, shape (m, K, N)
        K vectors per item.

    Returns
    -------
    Array, shape (n, K, N)
        The products.
    """
    return apply(matrix.transpose(1, 0, 2), points)


def eigen(S: Array) -> tuple[Array, Array]:
    """Eigenpairs of symmetric matrices; an item that is not finite does not stop the others.

    Parameters
    ----------
    S : Array, shape (n, n, N)
        Symmetric matrices; the identity takes the place of those that are not finite.

    Returns
    -------
    values : Array, shape (n, N)
        Ascending.
    vectors : Array, shape (n, n, N)
        Columns ``vectors[:, j]``.
    """
    bad = ~np.isfinite(S).all(axis=(0, 1))
    batch = np.ascontiguousarray(np.moveaxis(S, -1, 0))
    if bad.any():
        batch[bad] = np.eye(len(S))
    values, vectors = np.linalg.eigh(batch)
    return values.T.copy(), np.moveaxis(vectors, 0, -1).copy()


def bordered(D: Array, q: Array, corner: float | Array, right: Array, last: Array) -> Array:
    """Solve ``[diag D, q; q', corner] (v, .) = (right, last)`` for v, pivoting on one entry of D that may vanish.

    Parameters
    ----------
    D, q, right : Array, shape (n, K, N)
        Diagonal, border and right side.
    corner, last : Array, broadcast to shape (K, N)
        Corner entry and last right side.

    Returns
    -------
    Array, shape (n, K, N)
        The first n unknowns.

    Notes
    -----
    Nocedal and Wright (2006), section 16.1.
    """
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


def accept(y: Array, move: Array) -> Array:
    """Take a polishing step only where it is small: at a fold or the apex it means nothing.

    Parameters
    ----------
    y, move : Array, shape (n, K, N)
        Points and steps.

    Returns
    -------
    Array, shape (n, K, N)
        ``y + move`` or ``y``.
    """
    good = np.abs(move).max(axis=0) <= 1e-2 * np.abs(y).max(axis=0)
    return np.where(good, y + move, y)


# Newton's iteration on the multiplier of squared-range least squares, where its Lagrangian is positive definite.
#
# On the interval where :math:`A + \lambda C \succ 0` the function :math:`\varphi(\lambda) = y^\top C y + 2 h^\top y`
# with :math:`y = (A + \lambda C)^{-1} (b - \lambda h)` decreases with slope :math:`-2 q^\top (A + \lambda C)^{-1} q`,
# :math:`q = C y + h`, and its only zero is the global minimiser (More, 1993, theorem 3.2). Started at :math:`\lambda =
# 0`, the unconstrained fit, a few factorisations suffice for data of ordinary noise, at a fraction of the price of an
# eigenvalue problem. Items that leave the interval or do not settle are reported and go to the secular equation.
#
# Source: J. J. More, "Generalizations of the trust region problem", Optim. Methods Softw. 2 (1993), theorem 3.2.

_POLISHING_STEPS = 5
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
    for _ in range(_POLISHING_STEPS):
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


# Polynomials in time: a middle and a half length that keep powers of order one, and the way back.


def span(when: Array, heard: Mask) -> tuple[Array, Array]:
    """Middle and half length of the times heard, shape (N, 1): powers of what is left are of order one."""
    first = np.min(np.where(heard, when, np.inf), axis=-1, keepdims=True)
    last = np.max(np.where(heard, when, -np.inf), axis=-1, keepdims=True)
    some = last >= first
    half = np.where(some, 0.5 * (last - first), 0.0)
    return np.where(some, 0.5 * (first + last), 0.0), np.where(half > 0.0, half, 1.0)


def uncentred(c: Array, middle: Array, spread: Array) -> Array:
    """Coefficients (N, order + 1, d) in time from those in ``(time - middle) / spread``."""
    out = np.zeros_like(c)
    for j in range(c.shape[1]):
        for i in range(j + 1):
            out[:, i] += c[:, j] * comb(j, i) * (-middle) ** (j - i) / spread**j
    return out
