r"""Linear algebra of small matrices in batches, for most problems of this package.

Every product is a fixed chain of elementwise operations. So an item that is singular or not finite changes no bit of
its neighbours, and no function is called for each matrix. There are two layouts. Geometry has the batch on the first
axes and the vector on the last axis. The squared-range solvers have the *batch on the last axis*, so that every
operation of a small matrix runs along contiguous memory.

Sources: textbook formulas; the bordered system is the one of a Newton step on the optimality conditions, J. Nocedal
and S. J. Wright, "Numerical Optimization", 2006, section 16.1.
"""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

# Greatest length of a polishing step, relative to the point. Corrections of rounding errors are shorter (about 1e-8 at
# a double root); a longer step leads to another point.
_CORRECTION = 1e-2


# The batch on the first axis.


def dot(a: Array, b: Array) -> Array:
    """Return the inner products of vectors along the last axis.

    Parameters
    ----------
    a, b : Array, shape (..., d)
        Vectors.

    Returns
    -------
    Array, shape (...)
        The products.
    """
    return np.asarray(np.sum(a * b, axis=-1))


def flatten(value: ArrayLike, last: tuple[int, ...], lead: tuple[int, ...]) -> Array:
    """Return a value with one batch axis.

    Parameters
    ----------
    value : array_like
        Broadcast to the shape ``(*lead, *last)``.
    last, lead : tuple of int
        Shape of one item, and of the batch.

    Returns
    -------
    array
        Of shape ``(N, *last)``, N the product of `lead`.
    """
    return np.broadcast_to(np.asarray(value, dtype=np.float64), (*lead, *last)).reshape(-1, *last)


def span(when: Array, heard: Mask) -> tuple[Array, Array]:
    """Return the middle and the half length of the observed times; polynomials use times relative to them.

    Scaled powers of time are then of order one.

    Parameters
    ----------
    when : Array, shape (N, k)
        Times.
    heard : Mask, shape (N, k)
        Whether each time is observed.

    Returns
    -------
    middle, half : Array, shape (N, 1)
        Zero and one if no time is observed; the half length is one if all times are equal.
    """
    first = np.min(np.where(heard, when, np.inf), axis=-1, keepdims=True)
    last = np.max(np.where(heard, when, -np.inf), axis=-1, keepdims=True)
    any_time = last >= first
    half = np.where(any_time, 0.5 * (last - first), 0.0)
    return np.where(any_time, 0.5 * (first + last), 0.0), np.where(half > 0.0, half, 1.0)


def uncentre(c: Array, middle: Array, half: Array) -> Array:
    """Return the coefficients of a polynomial in time from its coefficients in ``(time - middle) / half``.

    Parameters
    ----------
    c : Array, shape (N, order + 1, d)
        Coefficients, constant first.
    middle, half : Array, shape (N, 1)
        Results of `span`.

    Returns
    -------
    Array, shape (N, order + 1, d)
        Coefficients in time, by the binomial theorem.
    """
    out = np.zeros_like(c)
    for j in range(c.shape[1]):
        for i in range(j + 1):
            out[:, i] += c[:, j] * comb(j, i) * (-middle) ** (j - i) / half**j
    return out


# The batch on the last axis.


def normal(B: Array, g: Array) -> tuple[Array, Array]:
    """Return the normal equations of rows: the matrix ``B'B`` and the right side ``B'g``.

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
    """
    n = B.shape[1]
    A = np.empty((n, n, B.shape[2]))
    for i in range(n):
        for j in range(i + 1):
            A[i, j] = A[j, i] = (B[:, i] * B[:, j]).sum(axis=0)
    return A, (B * g[:, None]).sum(axis=0)


def apply(matrix: Array, points: Array) -> Array:
    """Return ``matrix @ points`` for every item and slot.

    Parameters
    ----------
    matrix : Array, shape (m, n, N)
        One matrix per item; its transpose is ``matrix.transpose(1, 0, 2)``.
    points : Array, shape (n, K, N)
        K vectors per item.

    Returns
    -------
    Array, shape (m, K, N)
        The products, summed column by column.
    """
    out: Array = matrix[:, 0, None] * points[0]
    for j in range(1, len(points)):
        out += matrix[:, j, None] * points[j]
    return out


def across(matrix: Array, vector: Array) -> Array:
    """Return ``matrix' @ vector`` for every item.

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


def eigen(S: Array) -> tuple[Array, Array]:
    """Return the eigenpairs of symmetric matrices; an item that is not finite does not affect the others.

    Parameters
    ----------
    S : Array, shape (n, n, N)
        Symmetric matrices. The identity replaces matrices that are not finite, for which LAPACK raises an error.

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
    """Return the solution v of ``[diag D, q; q', corner] (v, .) = (right, last)``, in which one entry of D may vanish.

    Newton steps on a constrained minimum have this form. Only v is returned, not the last unknown.

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
    # Elimination divides by the entries of D; the entry with the largest q^2 / |D| is eliminated by the border instead.
    pivot = np.argmax(q * q / np.abs(D), axis=0)[None]
    pivot_entry, pivot_border = np.take_along_axis(D, pivot, axis=0)[0], np.take_along_axis(q, pivot, axis=0)[0]
    share = q * pivot_entry / D
    np.put_along_axis(share, pivot, pivot_border[None], axis=0)
    multiplier = ((share * right).sum(axis=0) - last * pivot_entry) / ((share * q).sum(axis=0) - corner * pivot_entry)
    out = (right - multiplier * q) / D
    np.put_along_axis(out, pivot, 0.0, axis=0)
    rest = (last - corner * multiplier - (q * out).sum(axis=0)) / pivot_border
    np.put_along_axis(out, pivot, rest[None], axis=0)
    return np.asarray(out)


def correct(y: Array, move: Array) -> Array:
    """Return points after a polishing step; a large step, as at a fold or the apex, is not taken.

    Parameters
    ----------
    y, move : Array, shape (n, K, N)
        Points and steps.

    Returns
    -------
    Array, shape (n, K, N)
        ``y + move`` or ``y``.
    """
    short = np.abs(move).max(axis=0) <= _CORRECTION * np.abs(y).max(axis=0)
    return np.where(short, y + move, y)
