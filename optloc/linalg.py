"""Small symmetric positive definite systems in batches: one singular item never disturbs the others."""

from __future__ import annotations

import numpy as np

from optloc.types import Array


def factor(matrix: Array, least: float = 1e-15) -> tuple[Array, Array]:
    """Return Cholesky factors of a batch of symmetric matrices.

    Parameters
    ----------
    matrix : array (..., n, n)
        Symmetric matrices.
    least : float
        Share of its diagonal that a pivot must exceed.

    Returns
    -------
    lower : array (..., n, n)
        Lower factors; meaningless where not ok.
    ok : bool array (...)
        Whether the matrix is numerically positive definite.
    """
    n = matrix.shape[-1]
    lower = np.zeros(matrix.shape)
    ok = np.ones(matrix.shape[:-2], dtype=bool)
    for j in range(n):
        known = lower[..., j:, :j]
        column = matrix[..., j:, j] - (known * lower[..., j, None, :j]).sum(-1)
        pivot = column[..., 0]
        positive = pivot > least * np.abs(matrix[..., j, j])
        ok &= positive
        lower[..., j:, j] = column / np.sqrt(np.where(positive, pivot, 1.0))[..., None]
    return lower, ok


def _forward(lower: Array, right: Array) -> Array:
    out = np.empty(np.broadcast_shapes(lower.shape[:-2], right.shape[:-2]) + right.shape[-2:])
    for j in range(lower.shape[-1]):
        known = (lower[..., j, :j, None] * out[..., :j, :]).sum(-2)
        out[..., j, :] = (right[..., j, :] - known) / lower[..., j, j, None]
    return out


def _backward(lower: Array, right: Array) -> Array:
    out = np.empty(right.shape)
    for j in reversed(range(lower.shape[-1])):
        known = (lower[..., j + 1 :, j, None] * out[..., j + 1 :, :]).sum(-2)
        out[..., j, :] = (right[..., j, :] - known) / lower[..., j, j, None]
    return out


def solve(matrix: Array, right: Array, least: float = 1e-15) -> tuple[Array, Array]:
    """Return the solution of ``matrix @ x = right`` for symmetric positive definite matrices.

    The matrix is first scaled to a unit diagonal (Jacobi).

    Parameters
    ----------
    matrix : array (..., n, n)
        Symmetric matrices.
    right : array (..., n, q)
        Right-hand sides.
    least : float
        Share of its diagonal that a pivot must exceed.

    Returns
    -------
    x : array (..., n, q)
        Solutions; zero where not ok.
    ok : bool array (...)
        Whether the matrix is numerically positive definite.
    """
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    good = diagonal > 0.0
    scale = 1.0 / np.sqrt(np.where(good, diagonal, 1.0))
    lower, ok = factor(matrix * scale[..., :, None] * scale[..., None, :], least)
    ok = ok & good.all(-1)
    lower = np.where(ok[..., None, None], lower, np.eye(matrix.shape[-1]))
    x = scale[..., None] * _backward(lower, _forward(lower, scale[..., None] * right))
    return np.where(ok[..., None, None], x, 0.0), ok


def inverse(matrix: Array, least: float = 1e-15) -> tuple[Array, Array]:
    """Return inverses (..., n, n) of symmetric positive definite matrices, NaN where not ok, and ok (...)."""
    n = matrix.shape[-1]
    out, ok = solve(matrix, np.broadcast_to(np.eye(n), matrix.shape), least)
    return np.where(ok[..., None, None], 0.5 * (out + np.swapaxes(out, -1, -2)), np.nan), ok


def root(matrix: Array, cut: float = 1e-12) -> tuple[Array, Array]:
    """Return A with ``A A'`` the pseudo-inverse of symmetric positive semidefinite matrices.

    Parameters
    ----------
    matrix : array (..., n, n)
        Symmetric matrices.
    cut : float
        Directions with less than this share of the largest eigenvalue, columns scaled, count as nothing.

    Returns
    -------
    root : array (..., n, n)
        Zero columns for directions of nothing.
    regular : bool array (...)
        Whether there are none.
    """
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = matrix * scale[..., :, None] * scale[..., None, :]
    finite = np.asarray(np.isfinite(scaled).all((-1, -2)))
    values, vectors = np.linalg.eigh(np.where(finite[..., None, None], scaled, 0.0))
    kept = values > cut * np.maximum(values[..., -1:], cut)
    inverse = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
    return scale[..., :, None] * vectors * inverse[..., None, :], np.asarray(kept.all(-1))


def whitening(covariance: Array) -> Array:
    """Return W with ``W' W`` the inverse of a covariance, or its pseudo-inverse where it is singular.

    Parameters
    ----------
    covariance : array (..., r, r)
        Symmetric positive semidefinite; a row and column of zeros is absent.

    Returns
    -------
    array (..., r, r)
        Lower triangular where the covariance of the rows present is regular; its rank is that of the covariance, and
        rows beyond it, like the columns of absent rows, are exactly zero.
    """
    diagonal = np.diagonal(covariance, axis1=-2, axis2=-1)
    absent = diagonal == 0.0
    if covariance.shape[-1] == 1:
        return np.asarray(np.where(absent[..., None], 0.0, 1.0 / np.sqrt(np.where(absent[..., None], 1.0, covariance))))
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    unit = covariance * scale[..., :, None] * scale[..., None, :]
    eye = np.broadcast_to(np.eye(covariance.shape[-1]), covariance.shape)
    lower, ok = factor(unit + absent[..., None] * eye)
    pivot = np.diagonal(lower, axis1=-2, axis2=-1).min(-1)
    ok = ok & (pivot > 1e-6)
    matrix = _forward(np.where(ok[..., None, None], lower, eye), eye)
    if not ok.all():
        values, vectors = np.linalg.eigh(np.where(np.isfinite(unit), unit, 0.0))
        kept = values > 1e-10 * values[..., -1:]
        roots = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
        matrix = np.where(ok[..., None, None], matrix, roots[..., :, None] * np.swapaxes(vectors, -1, -2))
    return np.asarray(matrix * (scale * ~absent)[..., None, :])
