"""Batched linear algebra for small symmetric positive definite systems. A singular item does not affect the others.

Letters: leading axes `...` or N count the systems of a batch. n is the number of unknowns, q of right sides or columns,
r of rows, c of equalities, d of coordinates. The library of the array can be NumPy, JAX, PyTorch or another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base import arrays
from optloc.base.types import Array

PIVOT = 1e-15
"""Minimum ratio of a pivot to its diagonal: five units in the last place, below which no digit is significant."""

# Number of rows above which absent rows are removed before a covariance is factored. The time grows with the cube of
# the number of rows. Each epoch of a file has the rows of all epochs, most of them absent.
_MANY = 16


def factor(matrix: Array, least: float = PIVOT) -> tuple[Array, Array]:
    """Return Cholesky factors of a batch of symmetric matrices.

    Parameters
    ----------
    matrix : array (..., n, n)
        Symmetric matrices.
    least : float
        Minimum ratio of a pivot to its diagonal element.

    Returns
    -------
    lower : array (..., n, n)
        Lower factors; not valid where `ok` is false.
    ok : bool array (...)
        Whether the matrix is numerically positive definite.
    """
    n = matrix.shape[-1]
    if arrays.is_other_library(matrix):
        # Arrays of some libraries are read-only. NumPy is faster with writing column by column.
        return _factor_read_only(matrix, least)
    lower = np.zeros(matrix.shape)
    ok = np.ones(matrix.shape[:-2], dtype=bool)
    for j in range(n):
        known = lower[..., j:, :j]
        column = matrix[..., j:, j] - (known * lower[..., j, None, :j]).sum(-1)
        pivot = column[..., 0]
        positive = pivot > least * np.abs(matrix[..., j, j])
        ok &= positive
        # An item that is not definite continues with a pivot of one: its numbers stay finite, but are not valid.
        lower[..., j:, j] = column / np.sqrt(np.where(positive, pivot, 1.0))[..., None]
    return lower, ok


def _factor_read_only(matrix: Any, least: float) -> tuple[Any, Any]:
    """Return the result of `factor` for arrays that are read-only: column by column, from the remaining matrix."""
    xp, n = arrays.library(matrix), matrix.shape[-1]
    below = arrays.as_array_like(np.tril(np.ones((n, n))), matrix)
    # This comparison makes a mask with the shape of the batch on the device of the array. NaN is not ok.
    rest, columns, ok = matrix, [], matrix[..., 0, 0] == matrix[..., 0, 0]
    for j in range(n):
        pivot = rest[..., j, j]
        positive = pivot > least * xp.abs(matrix[..., j, j])
        ok = ok & positive
        column = below[:, j] * rest[..., :, j] / xp.sqrt(xp.where(positive, pivot, 1.0))[..., None]
        rest = rest - column[..., :, None] * column[..., None, :]
        columns.append(column)
    return xp.stack(columns, axis=-1), ok


def factor_semidefinite(covariance: Array) -> Array:
    """Return lower triangular L with ``L L'`` equal to a covariance, which may be singular.

    It is a Cholesky factorisation in the order of the rows, without pivoting. If the error of a row is a linear
    combination of the errors of earlier rows, its column is zero.

    Parameters
    ----------
    covariance : array (..., r, r)
        Symmetric positive semidefinite.
    """
    size = covariance.shape[-1]
    rest, lower = np.array(covariance, dtype=float), np.zeros(covariance.shape)
    # Each step rounds a diagonal element by half a unit. The sign of a remainder of this size is not significant.
    least = 4.0 * size * np.finfo(float).eps * np.abs(np.diagonal(rest, axis1=-2, axis2=-1))
    for j in range(size):
        pivot = rest[..., j, j]
        # With this comparison NaN does not count as zero, so a covariance with NaN does not give samples without noise.
        nothing = pivot <= least[..., j]
        column = rest[..., j:, j] / np.sqrt(np.where(nothing, 1.0, pivot))[..., None]
        column = np.where(nothing[..., None], 0.0, column)
        lower[..., j:, j] = column
        rest[..., j:, j:] -= column[..., :, None] * column[..., None, :]
    return lower


def _substitute(lower: Any, right: Any, order: range) -> Array:
    """Return the solution (..., n, q) of a triangular system; `order` is the order of the rows.

    `lower` (..., n, n) is the triangular matrix and `right` (..., n, q) the right side. No array is changed.
    """
    xp, rows = arrays.library(lower), dict[int, Any]()
    for j in order:
        rest = right[..., j, :]
        for i, row in rows.items():
            rest = rest - lower[..., j, i, None] * row
        rows[j] = rest / lower[..., j, j, None]
    solved: Array = xp.stack([rows[j] for j in range(len(order))], axis=-2)
    return solved


def _forward(lower: Array, right: Array) -> Array:
    """Return the solution (..., n, q) of ``lower @ x = right`` for lower triangular matrices (..., n, n)."""
    if arrays.is_other_library(lower):
        return _substitute(lower, right, range(lower.shape[-1]))
    out = np.empty(np.broadcast_shapes(lower.shape[:-2], right.shape[:-2]) + right.shape[-2:])
    for j in range(lower.shape[-1]):
        known = (lower[..., j, :j, None] * out[..., :j, :]).sum(-2)
        out[..., j, :] = (right[..., j, :] - known) / lower[..., j, j, None]
    return out


def _backward(lower: Array, right: Array) -> Array:
    """Return the solution (..., n, q) of ``lower.T @ x = right`` for lower triangular matrices (..., n, n)."""
    if arrays.is_other_library(lower):
        return _substitute(lower.mT, right, range(lower.shape[-1])[::-1])
    out = np.empty(right.shape)
    for j in reversed(range(lower.shape[-1])):
        known = (lower[..., j + 1 :, j, None] * out[..., j + 1 :, :]).sum(-2)
        out[..., j, :] = (right[..., j, :] - known) / lower[..., j, j, None]
    return out


def solve(matrix: Array, right: Array, least: float = PIVOT) -> tuple[Array, Array]:
    """Return the solution of ``matrix @ x = right`` for symmetric positive definite matrices.

    The matrix is first scaled to a unit diagonal (Jacobi scaling).

    Parameters
    ----------
    matrix : array (..., n, n)
        Symmetric matrices.
    right : array (..., n, q)
        Right-hand sides.
    least : float
        Minimum ratio of a pivot to its diagonal element.

    Returns
    -------
    x : array (..., n, q)
        Solutions; zero where `ok` is false.
    ok : bool array (...)
        Whether the matrix is numerically positive definite.
    """
    xp = arrays.library(matrix)
    diagonal = xp.linalg.diagonal(matrix)
    good = diagonal > 0.0
    # Unknowns have different units, such as metres and radians. After scaling, pivots do not depend on the units.
    scale = 1.0 / xp.sqrt(xp.where(good, diagonal, 1.0))
    lower, ok = factor(matrix * scale[..., :, None] * scale[..., None, :], least)
    ok = ok & xp.all(good, axis=-1)
    lower = xp.where(ok[..., None, None], lower, arrays.eye(matrix.shape[-1], matrix))
    x = scale[..., None] * _backward(lower, _forward(lower, scale[..., None] * right))
    return xp.where(ok[..., None, None], x, 0.0), ok


def inverse(matrix: Array, least: float = PIVOT) -> tuple[Array, Array]:
    """Return the inverses (..., n, n) of symmetric positive definite matrices, and whether each is valid (...).

    Invalid inverses are NaN: the matrix is not numerically positive definite. `least` as for `solve`.
    """
    xp = arrays.library(matrix)
    out, ok = solve(matrix, xp.broadcast_to(arrays.eye(matrix.shape[-1], matrix), matrix.shape), least)
    # The rounding of the two substitutions is not symmetric, but a covariance must be symmetric to the last bit.
    return xp.where(ok[..., None, None], 0.5 * (out + out.mT), xp.nan), ok


def root(matrix: Array, cut: float = 1e-12) -> tuple[Array, Array]:
    """Return A with ``A A'`` equal to the pseudo-inverse of symmetric positive semidefinite matrices.

    Parameters
    ----------
    matrix : array (..., n, n)
        Symmetric matrices.
    cut : float
        Directions with less than this share of the largest eigenvalue, after scaling of the columns, count as zero.

    Returns
    -------
    root : array (..., n, n)
        The columns of zero directions are zero.
    regular : bool array (...)
        Whether there is no zero direction.
    """
    xp = arrays.library(matrix)
    diagonal = xp.linalg.diagonal(matrix)
    scale = 1.0 / xp.sqrt(xp.where(diagonal > 0.0, diagonal, 1.0))
    scaled = matrix * scale[..., :, None] * scale[..., None, :]
    # LAPACK refuses the whole batch if one matrix contains NaN. Such a matrix is replaced by zeros, so that all its
    # directions are zero.
    finite = xp.all(xp.isfinite(scaled), axis=(-1, -2))
    values, vectors = xp.linalg.eigh(xp.where(finite[..., None, None], scaled, 0.0))
    largest = values[..., -1:]
    # For a zero matrix no direction is kept, because the largest eigenvalue counts as at least `cut`.
    kept = values > cut * xp.where(largest > cut, largest, cut)
    inverse = xp.where(kept, 1.0 / xp.sqrt(xp.where(kept, values, 1.0)), 0.0)
    return scale[..., :, None] * vectors * inverse[..., None, :], xp.all(kept, axis=-1)


def whitening(covariance: Array) -> Array:
    """Return W with ``W' W`` equal to the inverse of a covariance, or to a generalised inverse if it is singular.

    The generalised inverse is the scaled pseudo-inverse of the correlation matrix.

    Parameters
    ----------
    covariance : array (..., r, r)
        Symmetric positive semidefinite. A row and column of zeros means an absent row.

    Returns
    -------
    array (..., r, r)
        Lower triangular if the covariance of the present rows is regular. Its rank is the rank of the covariance.
        Surplus rows, and the columns of absent rows, are exactly zero.
    """
    xp = arrays.library(covariance)
    diagonal = xp.linalg.diagonal(covariance)
    absent = diagonal == 0.0
    # Independent rows are the usual case. They need only a square root.
    if covariance.shape[-1] == 1:
        single: Array = xp.where(absent[..., None], 0.0, 1.0 / xp.sqrt(xp.where(absent[..., None], 1.0, covariance)))
        return single
    if covariance.shape[-1] > _MANY and not arrays.is_other_library(covariance):
        most = max(int((~absent).sum(-1).max(initial=0)), 1)
        if most < covariance.shape[-1]:
            return _whitening_of_present(covariance, absent, most)
    scale = 1.0 / xp.sqrt(xp.where(diagonal > 0.0, diagonal, 1.0))
    unit = covariance * scale[..., :, None] * scale[..., None, :]
    eye = xp.broadcast_to(arrays.eye(covariance.shape[-1], covariance), covariance.shape)
    lower, ok = factor(xp.where(absent[..., None], eye, unit))
    # If the errors of a loop of rows cancel, rounding leaves a pivot of about 1e-6 (its square is 1e-12). Only
    # eigenvalues can then separate noise from rounding.
    ok = ok & xp.all(xp.linalg.diagonal(lower) > 1e-6, axis=-1)
    matrix = _forward(xp.where(ok[..., None, None], lower, eye), eye)
    if not bool(xp.all(ok)):
        values, vectors = xp.linalg.eigh(xp.where(xp.isfinite(unit), unit, 0.0))
        # Rounding leaves eigenvalues of about 1e-15 in directions without noise. The limit admits standard deviations
        # that are up to 1e5 times smaller than others.
        kept = values > 1e-10 * values[..., -1:]
        roots = xp.where(kept, 1.0 / xp.sqrt(xp.where(kept, values, 1.0)), 0.0)
        matrix = xp.where(ok[..., None, None], matrix, roots[..., :, None] * vectors.mT)
    whitened: Array = matrix * xp.where(absent, 0.0, scale)[..., None, :]
    return whitened


def _whitening_of_present(covariance: Array, absent: Array, most: int) -> Array:
    """Return the result of `whitening`, computed from the present rows only.

    `absent` (..., r) marks absent rows. Each item has at most `most` present rows.
    """
    # A stable sort keeps the order of the rows, so that the matrix stays triangular.
    chosen = np.argsort(absent, axis=-1, kind="stable")[..., :most]
    rows, columns = chosen[..., :, None], chosen[..., None, :]
    submatrix = np.take_along_axis(np.take_along_axis(covariance, rows, -2), columns, -1)
    rows_of_result = np.zeros((*submatrix.shape[:-1], covariance.shape[-1]))
    np.put_along_axis(rows_of_result, np.broadcast_to(columns, submatrix.shape), whitening(submatrix), -1)
    out = np.zeros(covariance.shape)
    np.put_along_axis(out, np.broadcast_to(rows, rows_of_result.shape), rows_of_result, -2)
    return out


# Least squares on the tangent space of equality constraints.


@dataclass(frozen=True, slots=True)
class Tangent:
    """Directions along which equalities are satisfied to first order (tangent), and directions across them.

    Parameters
    ----------
    along : array (N, n, n - c)
        Basis of the tangent space.
    across : array (N, n, c)
        ``across @ g`` is the shortest step that restores the equalities; g (N, c) are their values with opposite sign.
    """

    along: Array
    across: Array


def tangent(gradients: Array, scale: Array) -> Tangent:
    """Return the tangent space of equality constraints.

    Parameters
    ----------
    gradients : array (N, c, n)
        Gradients of the equalities.
    scale : array (N, n)
        Typical size of each unknown, which defines the length of a step.
    """
    c = gradients.shape[-2]
    # The QR factors of the scaled gradients split the space: the first c columns are across, the others along.
    scaled = np.swapaxes(gradients * scale[:, None], -1, -2)
    scaled = np.where(np.isfinite(scaled), scaled, 0.0)
    q, r = np.linalg.qr(scaled, mode="complete")
    size = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
    # Four digits above rounding error. The limit 1e-300 is for gradients that are all zero.
    regular = size > 1e-12 * np.maximum(size.max(-1, keepdims=True), 1e-300)
    lower = np.swapaxes(r[:, :c], -1, -2)
    restore = np.zeros_like(lower)
    for i in range(c):  # invert the small triangle by columns; the column of a dependent equality is zero
        for j in range(c):
            known = (lower[:, i, :i] * restore[:, :i, j]).sum(-1)
            value = (float(i == j) - known) / np.where(regular[:, i], lower[:, i, i], 1.0)
            restore[:, i, j] = np.where(regular[:, i], value, 0.0)
    return Tangent(scale[..., None] * q[..., c:], scale[..., None] * (q[..., :c] @ restore))


def solve_within(information: Array, vector: Array, along: Array) -> tuple[Array, Array]:
    """Return the step (..., n) along a basis (..., n, q) that solves normal equations, and whether it exists (...).

    `information` (..., n, n) and `vector` (..., n) are the normal matrix and the right side.
    """
    if along.shape[-1] == 0:
        # If the number of equalities equals the number of unknowns, the step is zero, which is a valid result.
        return np.zeros_like(vector), np.ones(vector.shape[:-1], dtype=bool)
    transposed = np.swapaxes(along, -1, -2)
    part, ok = solve(transposed @ information @ along, transposed @ vector[..., None])
    return (along @ part)[..., 0], ok


def inverse_within(information: Array, along: Array) -> tuple[Array, Array]:
    """Return the covariance (N, n, n) along a basis (N, n, q), zero across it, and whether it exists (N,).

    `information` (N, n, n) is the normal matrix.
    """
    if along.shape[-1] == 0:
        return np.zeros_like(information), np.ones(len(information), dtype=bool)
    transposed = np.swapaxes(along, -1, -2)
    inner, ok = inverse(transposed @ information @ along)
    return along @ inner @ transposed, ok


# Points: centre and spread. Covariances: error ellipses and ellipsoids.


def centre_of_points(points: Array, inside: Array) -> Array:
    """Return the mean (..., d) of the points (..., s, d) that `inside` (..., s) selects; zero if it selects none."""
    total = np.einsum("...s,...sd->...d", inside.astype(float), points)
    return np.asarray(total / np.maximum(inside.sum(-1), 1)[..., None])


def centre_and_spread(points: Array, inside: Array | None = None) -> tuple[Array, Array]:
    """Return the mean (..., d) of points (..., s, d) and their greatest distance (...) from the mean.

    Parameters
    ----------
    points : array (..., s, d)
        Finite points, including those that `inside` leaves out.
    inside : bool array (..., s), optional
        Points that count; default: all. If no point counts, the mean is the origin.
    """
    if inside is None:
        inside = np.ones(points.shape[:-1], dtype=bool)
    centre = centre_of_points(points, inside)
    away = np.linalg.norm(points - centre[..., None, :], axis=-1)
    return centre, np.where(inside, away, 0.0).max(-1)


def error_ellipse(covariance: Array, probability: float = 0.95) -> tuple[Array, Array]:
    """Return the ellipse or ellipsoid that contains a Gaussian variable with a given probability.

    Parameters
    ----------
    covariance : array (..., d, d)
        Square metres; NaN if there is no covariance.
    probability : float
        Between 0 and 1.

    Returns
    -------
    semi_axes : array (..., d)
        Lengths in metres, ascending; NaN if there is no covariance.
    directions : array (..., d, d)
        Unit vectors of the axes in columns.
    """
    from scipy.special import gammaincinv

    known = np.asarray(np.isfinite(covariance).all((-1, -2)))
    values, vectors = np.linalg.eigh(np.where(known[..., None, None], covariance, 0.0))
    # The chi-square quantile from the incomplete gamma function, because `scipy.stats` takes a second to load.
    scale = np.sqrt(2.0 * gammaincinv(covariance.shape[-1] / 2, probability))
    axes = scale * np.sqrt(np.maximum(values, 0.0))
    return np.where(known[..., None], axes, np.nan), np.where(known[..., None, None], vectors, np.nan)


def project_out(unknowns: Array, values: Array) -> Array:
    """Return values (..., q, p) minus their projection onto the span of unknowns (..., q, n).

    The result is the part of the values that no choice of the n linear unknowns can explain.
    """
    if not unknowns.shape[-1]:
        return values
    basis = span_of(unknowns)
    # Project twice: the rounding error of the first projection is proportional to the values, which can be large.
    once = values - basis @ (np.swapaxes(basis, -1, -2) @ values)
    return np.asarray(once - basis @ (np.swapaxes(basis, -1, -2) @ once))


def span_of(unknowns: Array) -> Array:
    """Return orthonormal columns (..., q, n) of the span of unknowns (..., q, n); zero columns if some are dependent.

    `unknowns` has one column for each linear unknown. Columns are first scaled to unit length. Singular values below
    1e-12 of the largest then count as dependent.
    """
    length = np.sqrt((unknowns**2).sum(-2, keepdims=True))
    u, s, _ = np.linalg.svd(unknowns / np.where(length > 0.0, length, 1.0), full_matrices=False)
    # The rounding error of a dependent column is about 1e-15. Dropping dependent columns does not change the span.
    return np.asarray(u * (s > 1e-12 * np.maximum(s[..., :1], 1e-300))[..., None, :])


def normalised(vector: Array) -> Array:
    """Return the vectors (..., d) scaled to unit length; the first axis for vectors of length zero."""
    length = np.sqrt((vector**2).sum(-1, keepdims=True))
    first = np.eye(vector.shape[-1])[0]
    return np.where(length > 0.0, vector / np.where(length > 0.0, length, 1.0), first)


def spread_directions(count: int, d: int) -> Array:
    """Return evenly distributed unit vectors (count, d): on a circle, or on a golden-angle spiral on the sphere."""
    number = np.arange(count) + 0.5
    if d == 2:
        angle = 2.0 * np.pi * number / count
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    height, angle = 1.0 - 2.0 * number / count, np.pi * (1.0 + np.sqrt(5.0)) * number
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)


def block_diagonal(blocks: Array) -> Array:
    """Return blocks (..., s, d, d) as block-diagonal matrices (..., s d, s d)."""
    s, d = blocks.shape[-3], blocks.shape[-1]
    apart = arrays.as_array_like(np.eye(s)[:, None, :, None], blocks) * blocks[..., :, :, None, :]
    whole: Array = arrays.library(blocks).reshape(apart, (*blocks.shape[:-3], s * d, s * d))
    return whole
