"""Moments of a point and of range errors: the monomials, and what matrices and rules are made of them.

A monomial is a product of two of ``(1, s, t)`` (position and reference range) and two of ``(1, w)`` (errors): these
are the entries of the moment matrix of ``(1, s, t) x (1, w)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Moments:
    """Numbers of the monomials of M ranges in d dimensions, with p = d + 2 places.

    Parameters
    ----------
    count : int
        How many monomials there are.
    table : Index, shape (p, p, M, M)
        Number of each by its two places and its two errors.
    matrix : Index, shape (p M, p M)
        The moment matrix.
    cone : Index, shape (M (M + 1) / 2, p (p + 1) / 2)
        The pairs of places times each pair of errors.
    rules : Index, shape (M - 1, p, d + 5)
        ``1, s, t, w_i, t w_i, w_i^2`` times each of ``1, s, t``.
    cost : Index, shape ((M + 1)(M + 2) / 2,)
        The pairs of ``(1, t, w)``.
    """

    count: int
    table: Index
    matrix: Index
    cone: Index
    rules: Index
    cost: Index


@lru_cache(maxsize=32)
def moments(stations: int, dimension: int) -> Moments:
    """Return numbers of the monomials; pairs are upper triangles, row by row.

    Parameters
    ----------
    stations, dimension : int
        M and d.

    Returns
    -------
    Moments
        The numbers.
    """
    M, p = stations, dimension + 2
    place = list(combinations_with_replacement(range(p), 2))
    error = list(combinations_with_replacement(range(M), 2))
    table = np.zeros((p, p, M, M), dtype=np.int64)
    for i, (a, b) in enumerate(place):
        for j, (k, m) in enumerate(error):
            table[[a, a, b, b], [b, b, a, a], [k, m, k, m], [m, k, m, k]] = i * len(error) + j
    cone = np.array([[table[a, b, k, m] for a, b in place] for k, m in error])
    rules = np.stack(
        [
            np.column_stack([table[:, :, 0, 0], table[0, :, 0, i], table[:, p - 1, 0, i], table[0, :, i, i]])
            for i in range(1, M)
        ]
    )
    terms = [(0, 0), (p - 1, 0), *((0, i) for i in range(1, M))]
    cost = np.array([table[u[0], v[0], u[1], v[1]] for u, v in combinations_with_replacement(terms, 2)])
    matrix = table.transpose(0, 2, 1, 3).reshape(p * M, p * M)
    return Moments(len(place) * len(error), table, matrix, cone, rules, cost)


def upper(form: Array) -> Array:
    """Return the coefficients of a quadratic form on the products of pairs.

    Parameters
    ----------
    form : Array, shape (n, n)
        Symmetric.

    Returns
    -------
    Array, shape (n (n + 1) / 2,)
        Upper triangle row by row, the entries off the diagonal doubled.
    """
    row, column = np.triu_indices(len(form))
    return np.asarray(np.where(row == column, 1.0, 2.0) * form[row, column])
