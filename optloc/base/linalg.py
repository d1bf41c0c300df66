"""Small symmetric positive definite systems in batches: one singular item never disturbs the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base import arrays
from optloc.base.types import Array

PIVOT = 1e-15
"""Share of its diagonal that a pivot must exceed: five units in the last place, below which no digit of it is known."""

# Rows from which on those that are absent are taken out before a covariance is factored: time goes with the third power
# of their number, and each epoch of a file has the rows of all epochs, most of them absent.
_MANY = 16


def factor(matrix: Array, least: float = PIVOT) -> tuple[Array, Array]:
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
    if arrays.is_other_library(matrix):
        # Arrays of some libraries cannot be written; in numpy, writing column by column is the quicker way.
        return _factor(matrix, least)
    lower = np.zeros(matrix.shape)
    ok = np.ones(matrix.shape[:-2], dtype=bool)
    for j in range(n):
        known = lower[..., j:, :j]
        column = matrix[..., j:, j] - (known * lower[..., j, None, :j]).sum(-1)
        pivot = column[..., 0]
        positive = pivot > least * np.abs(matrix[..., j, j])
        ok &= positive
        # An item that is not definite goes on with a pivot of one: its numbers stay finite, and mean nothing.
        lower[..., j:, j] = column / np.sqrt(np.where(positive, pivot, 1.0))[..., None]
    return lower, ok


def _factor(matrix: Any, least: float) -> tuple[Any, Any]:
    """Return what `factor` does without writing into an array: column by column, the rest less what each explains."""
    xp, n = arrays.library(matrix), matrix.shape[-1]
    below = arrays.as_array_like(np.tril(np.ones((n, n))), matrix)
    # The first comparison makes a mask of the batch's shape on the array's own device; a NaN there is not ok.
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
    """Return lower triangular L with ``L L'`` a covariance, which may be singular.

    Cholesky's columns in the order of the rows, without pivots; a row whose error is a combination of those before it
    has a column of zeros.

    Parameters
    ----------
    covariance : array (..., r, r)
        Symmetric positive semidefinite.
    """
    size = covariance.shape[-1]
    rest, lower = np.array(covariance, dtype=float), np.zeros(covariance.shape)
    # Each step rounds a diagonal by half a unit; a remainder of that size may be anything, its sign included.
    least = 4.0 * size * np.finfo(float).eps * np.abs(np.diagonal(rest, axis1=-2, axis2=-1))
    for j in range(size):
        pivot = rest[..., j, j]
        # Written so that NaN is no remainder: a covariance without a number gives no draw without noise.
        nothing = pivot <= least[..., j]
        column = rest[..., j:, j] / np.sqrt(np.where(nothing, 1.0, pivot))[..., None]
        column = np.where(nothing[..., None], 0.0, column)
        lower[..., j:, j] = column
        rest[..., j:, j:] -= column[..., :, None] * column[..., None, :]
    return lower


def _substitute(lower: Any, right: Any, order: range) -> Array:
    """Return the solution of a triangular system whose rows are solved in a given order; it writes into no array."""
    xp, rows = arrays.library(lower), dict[int, Any]()
    for j in order:
        left = right[..., j, :]
        for i, row in rows.items():
            left = left - lower[..., j, i, None] * row
        rows[j] = left / lower[..., j, j, None]
    solved: Array = xp.stack([rows[j] for j in range(len(order))], axis=-2)
    return solved


def _forward(lower: Array, right: Array) -> Array:
    if arrays.is_other_library(lower):
        return _substitute(lower, right, range(lower.shape[-1]))
    out = np.empty(np.broadcast_shapes(lower.shape[:-2], right.shape[:-2]) + right.shape[-2:])
    for j in range(lower.shape[-1]):
        known = (lower[..., j, :j, None] * out[..., :j, :]).sum(-2)
        out[..., j, :] = (right[..., j, :] - known) / lower[..., j, j, None]
    return out


def _backward(lower: Array, right: Array) -> Array:
    if arrays.is_other_library(lower):
        return _substitute(lower.mT, right, range(lower.shape[-1])[::-1])
    out = np.empty(right.shape)
    for j in reversed(range(lower.shape[-1])):
        known = (lower[..., j + 1 :, j, None] * out[..., j + 1 :, :]).sum(-2)
        out[..., j, :] = (right[..., j, :] - known) / lower[..., j, j, None]
    return out


def solve(matrix: Array, right: Array, least: float = PIVOT) -> tuple[Array, Array]:
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
    xp = arrays.library(matrix)
    diagonal = xp.linalg.diagonal(matrix)
    good = diagonal > 0.0
    # Metres beside radians and seconds: scaled, a pivot says how much of its unknown is known, whatever its unit.
    scale = 1.0 / xp.sqrt(xp.where(good, diagonal, 1.0))
    lower, ok = factor(matrix * scale[..., :, None] * scale[..., None, :], least)
    ok = ok & xp.all(good, axis=-1)
    lower = xp.where(ok[..., None, None], lower, arrays.eye(matrix.shape[-1], matrix))
    x = scale[..., None] * _backward(lower, _forward(lower, scale[..., None] * right))
    return xp.where(ok[..., None, None], x, 0.0), ok


def inverse(matrix: Array, least: float = PIVOT) -> tuple[Array, Array]:
    """Return inverses (..., n, n) of symmetric positive definite matrices, NaN where not ok, and ok (...)."""
    xp = arrays.library(matrix)
    out, ok = solve(matrix, xp.broadcast_to(arrays.eye(matrix.shape[-1], matrix), matrix.shape), least)
    # Rounding of the two substitutions differs across the diagonal; covariances are symmetric to the last bit.
    return xp.where(ok[..., None, None], 0.5 * (out + out.mT), xp.nan), ok


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
    xp = arrays.library(matrix)
    diagonal = xp.linalg.diagonal(matrix)
    scale = 1.0 / xp.sqrt(xp.where(diagonal > 0.0, diagonal, 1.0))
    scaled = matrix * scale[..., :, None] * scale[..., None, :]
    # LAPACK refuses a matrix with a NaN, and with it the whole batch: such an item is handed zeros, and keeps no
    # direction.
    finite = xp.all(xp.isfinite(scaled), axis=(-1, -2))
    values, vectors = xp.linalg.eigh(xp.where(finite[..., None, None], scaled, 0.0))
    largest = values[..., -1:]
    # Of a matrix of zeros nothing is kept: the largest counts as no less than the cut.
    kept = values > cut * xp.where(largest > cut, largest, cut)
    inverse = xp.where(kept, 1.0 / xp.sqrt(xp.where(kept, values, 1.0)), 0.0)
    return scale[..., :, None] * vectors * inverse[..., None, :], xp.all(kept, axis=-1)


def whitening(covariance: Array) -> Array:
    """Return W with ``W' W`` the inverse of a covariance, or a generalised inverse where it is singular.

    The generalised inverse is the scaled pseudo-inverse of the correlation matrix.

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
    xp = arrays.library(covariance)
    diagonal = xp.linalg.diagonal(covariance)
    absent = diagonal == 0.0
    # Independent rows are the usual case, and a square root is all that they need.
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
    # A pivot of a millionth (its square 1e-12) is left of a loop of rows whose errors cancel: only the eigenvalues
    # tell what of it is noise.
    ok = ok & xp.all(xp.linalg.diagonal(lower) > 1e-6, axis=-1)
    matrix = _forward(xp.where(ok[..., None, None], lower, eye), eye)
    if not bool(xp.all(ok)):
        values, vectors = xp.linalg.eigh(xp.where(xp.isfinite(unit), unit, 0.0))
        # Rounding leaves eigenvalues of some 1e-15 to directions without noise; sigmas up to 1e5 times smaller than
        # others are meant.
        kept = values > 1e-10 * values[..., -1:]
        roots = xp.where(kept, 1.0 / xp.sqrt(xp.where(kept, values, 1.0)), 0.0)
        matrix = xp.where(ok[..., None, None], matrix, roots[..., :, None] * vectors.mT)
    whitened: Array = matrix * xp.where(absent, 0.0, scale)[..., None, :]
    return whitened


def _whitening_of_present(covariance: Array, absent: Array, most: int) -> Array:
    """Return the same as `whitening` from the rows that are present, at most so many of each item."""
    # stable: they stay in their order, so that the matrix stays triangular
    kept = np.argsort(absent, axis=-1, kind="stable")[..., :most]
    rows, columns = kept[..., :, None], kept[..., None, :]
    own = np.take_along_axis(np.take_along_axis(covariance, rows, -2), columns, -1)
    across = np.zeros((*own.shape[:-1], covariance.shape[-1]))
    np.put_along_axis(across, np.broadcast_to(columns, own.shape), whitening(own), -1)
    out = np.zeros(covariance.shape)
    np.put_along_axis(out, np.broadcast_to(rows, across.shape), across, -2)
    return out


# Least squares on the tangent space of equality constraints.


@dataclass(frozen=True, slots=True)
class Tangent:
    """Directions along which equalities hold to first order, and the directions across.

    Parameters
    ----------
    along : array (N, n, n - c)
        Basis of the tangent space.
    across : array (N, n, c)
        ``across @ g`` is the shortest step that restores the equalities.
    """

    along: Array
    across: Array


def tangent(gradients: Array, scale: Array) -> Tangent:
    """Return the tangent space of equalities.

    Parameters
    ----------
    gradients : array (N, c, n)
        Gradients of the equalities.
    scale : array (N, n)
        Typical size of each unknown: decides what "shortest" means.
    """
    c = gradients.shape[-2]
    # Columns of the scaled gradients: their QR factors split the space into across (first c) and along.
    scaled = np.swapaxes(gradients * scale[:, None], -1, -2)
    scaled = np.where(np.isfinite(scaled), scaled, 0.0)
    q, r = np.linalg.qr(scaled, mode="complete")
    size = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
    # Four digits above rounding; 1e-300 keeps gradients of zero from being their own scale.
    regular = size > 1e-12 * np.maximum(size.max(-1, keepdims=True), 1e-300)
    lower = np.swapaxes(r[:, :c], -1, -2)
    restore = np.zeros_like(lower)
    for i in range(c):  # inverse of the small triangle, column by column; a dependent equality restores nothing
        for j in range(c):
            known = (lower[:, i, :i] * restore[:, :i, j]).sum(-1)
            value = (float(i == j) - known) / np.where(regular[:, i], lower[:, i, i], 1.0)
            restore[:, i, j] = np.where(regular[:, i], value, 0.0)
    return Tangent(scale[..., None] * q[..., c:], scale[..., None] * (q[..., :c] @ restore))


def solve_within(information: Array, vector: Array, along: Array) -> tuple[Array, Array]:
    """Return the step (..., n) along a basis (..., n, q) that solves normal equations, and where it exists (...)."""
    if along.shape[-1] == 0:
        # As many equalities as unknowns leave no step, which is an answer and no failure.
        return np.zeros_like(vector), np.ones(vector.shape[:-1], dtype=bool)
    transposed = np.swapaxes(along, -1, -2)
    part, ok = solve(transposed @ information @ along, transposed @ vector[..., None])
    return (along @ part)[..., 0], ok


def inverse_within(information: Array, along: Array) -> tuple[Array, Array]:
    """Return the covariance (N, n, n) along a basis (N, n, q), zero across it, and where it exists (N,)."""
    if along.shape[-1] == 0:
        return np.zeros_like(information), np.ones(len(information), dtype=bool)
    transposed = np.swapaxes(along, -1, -2)
    inner, ok = inverse(transposed @ information @ along)
    return along @ inner @ transposed, ok


# Points: their centre and spread, error ellipses and ellipsoids of covariances.


def centre_of_points(points: Array, inside: Array) -> Array:
    """Return the mean (..., d) of those points (..., s, d) that count, (..., s); the mean of none is the origin."""
    total = np.einsum("...s,...sd->...d", inside.astype(float), points)
    return np.asarray(total / np.maximum(inside.sum(-1), 1)[..., None])


def centre_and_spread(points: Array, inside: Array | None = None) -> tuple[Array, Array]:
    """Return the mean (..., d) of points (..., s, d) and their greatest distance from it (...).

    Parameters
    ----------
    points : array (..., s, d)
        Finite, those that are left out too.
    inside : bool array (..., s), optional
        Which of them count; all if absent. The mean of none is the origin.
    """
    if inside is None:
        inside = np.ones(points.shape[:-1], dtype=bool)
    centre = centre_of_points(points, inside)
    away = np.linalg.norm(points - centre[..., None, :], axis=-1)
    return centre, np.where(inside, away, 0.0).max(-1)


def error_ellipse(covariance: Array, probability: float = 0.95) -> tuple[Array, Array]:
    """Return the ellipse or ellipsoid that holds a Gaussian with a given probability.

    Parameters
    ----------
    covariance : array (..., d, d)
        Square metres; NaN where there is none.
    probability : float
        Between 0 and 1.

    Returns
    -------
    semi_axes : array (..., d)
        Lengths in metres, ascending; NaN where there is no covariance.
    directions : array (..., d, d)
        Unit vectors of the axes in columns.
    """
    from scipy.special import gammaincinv

    known = np.asarray(np.isfinite(covariance).all((-1, -2)))
    values, vectors = np.linalg.eigh(np.where(known[..., None, None], covariance, 0.0))
    # The quantile of chi-square by the incomplete gamma function: `scipy.stats` takes a second to load.
    scale = np.sqrt(2.0 * gammaincinv(covariance.shape[-1] / 2, probability))
    axes = scale * np.sqrt(np.maximum(values, 0.0))
    return np.where(known[..., None], axes, np.nan), np.where(known[..., None, None], vectors, np.nan)


def project_out(unknowns: Array, values: Array) -> Array:
    """Return values (..., q, p) less their projection onto the span of unknowns (..., q, n)."""
    if not unknowns.shape[-1]:
        return values
    basis = span_of(unknowns)
    # Twice: what rounding leaves of the first projection is as large as the values, and they may be large.
    once = values - basis @ (np.swapaxes(basis, -1, -2) @ values)
    return np.asarray(once - basis @ (np.swapaxes(basis, -1, -2) @ once))


def span_of(unknowns: Array) -> Array:
    """Return orthonormal columns (..., q, n) of the span of unknowns (..., q, n); zeros where some are dependent.

    Columns are scaled to one length first; what then is shorter than 1e-12 counts as dependent.
    """
    length = np.sqrt((unknowns**2).sum(-2, keepdims=True))
    u, s, _ = np.linalg.svd(unknowns / np.where(length > 0.0, length, 1.0), full_matrices=False)
    # The rounding of a column that is a sum of others is some thousandth of that; what is dependent changes nothing.
    return np.asarray(u * (s > 1e-12 * np.maximum(s[..., :1], 1e-300))[..., None, :])


def normalised(vector: Array) -> Array:
    """Return unit vectors (..., d); the first axis for vectors without length."""
    length = np.sqrt((vector**2).sum(-1, keepdims=True))
    first = np.eye(vector.shape[-1])[0]
    return np.where(length > 0.0, vector / np.where(length > 0.0, length, 1.0), first)


def spread_directions(count: int, d: int) -> Array:
    """Return unit vectors (count, d) spread evenly: on the circle, or on a spiral of the golden angle on the sphere."""
    number = np.arange(count) + 0.5
    if d == 2:
        turn = 2.0 * np.pi * number / count
        return np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    height, turn = 1.0 - 2.0 * number / count, np.pi * (1.0 + np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=-1)
