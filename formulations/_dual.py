"""Projection on the dual of a product of cones: what makes a solver's dual point an honest one.

Source: N. Parikh and S. Boyd, "Proximal algorithms", Found. Trends Optim. 1 (2014), section 6.3.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def dual_point(z: Array, dims: Any) -> Array:
    """Project on the dual cone.

    Parameters
    ----------
    z : Array, shape (m,)
        Dual point in Clarabel's order: zero, nonnegative, second-order and semidefinite cones.
    dims : Any
        cvxpy's ``ConeDims``.

    Returns
    -------
    Array, shape (m,)
        The nearest dual feasible point; NaN in the rows of any other cone.

    Notes
    -----
    Parikh and Boyd (2014), section 6.3.
    """
    z, at = z.copy(), int(dims.zero)
    z[at : at + dims.nonneg] = np.maximum(z[at : at + dims.nonneg], 0.0)
    at += int(dims.nonneg)
    for size in dims.soc:
        z[at : at + size] = _second_order(z[at : at + size])
        at += int(size)
    for size in dims.psd:
        count = size * (size + 1) // 2
        z[at : at + count] = _semidefinite(z[at : at + count], size)
        at += count
    if at != len(z):
        z[at:] = np.nan
    return z


def _second_order(z: Array) -> Array:
    """Projection on ``z_0 >= |z_1..|``."""
    size = float(np.linalg.norm(z[1:]))
    if size <= z[0]:
        return z
    if size <= -z[0]:
        return np.zeros_like(z)
    half = 0.5 * (1.0 + z[0] / size)
    return np.concatenate([[half * size], half * z[1:]])


def _semidefinite(z: Array, size: int) -> Array:
    """Projection of a scaled upper triangle, stored column by column, on the semidefinite cone."""
    if not np.isfinite(z).all():
        return z
    column, row, scale = _triangle(size)
    matrix = np.empty((size, size))
    matrix[row, column] = matrix[column, row] = z * scale
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(matrix)
    else:
        # the usual case: an interior-point dual is strictly inside
        return z
    fixed = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(fixed[row, column] / scale)


@lru_cache(maxsize=64)
def _triangle(size: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Columns and rows of a stored upper triangle, and what undoes the scale of its off-diagonal entries."""
    column, row = np.tril_indices(size)
    return column, row, np.where(row == column, 1.0, np.sqrt(0.5))
