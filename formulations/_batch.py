"""Small linear algebra on batches whose batch is the last axis.

Every product is a fixed chain of elementwise operations: an item that is singular or not finite changes no bit of its
neighbours, and problems of three or four unknowns cost no call per matrix. Textbook formulas; the bordered system is
the one of a Newton step on the optimality conditions (J. Nocedal and S. J. Wright, "Numerical Optimization", 2006,
section 16.1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


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
