"""Linear algebra of symmetric 3x3 matrices and of small positive definite systems, as scalar code."""

from __future__ import annotations

from math import sqrt

from optloc.base.types import Array
from optloc.compute.jit import compiled


@compiled
def positive(a: float, b: float, c: float, d: float, e: float, f: float) -> bool:
    """Return whether the matrix [[a, b, c], [b, d, e], [c, e, f]] is positive definite, rounding taken against it."""
    # Some thousand times the rounding of the entries, which are sums over rows: what then is positive is so indeed.
    shift = 1e-12 * (abs(a) + abs(d) + abs(f))
    a, d, f = a - shift, d - shift, f - shift
    if not a > 0.0:
        return False
    dd, ee, ff = d - b * b / a, e - b * c / a, f - c * c / a
    return dd > 0.0 and ff - ee * ee / dd > 0.0


@compiled
def principal(matrix: Array, vectors: Array) -> None:
    """Make a symmetric 3x3 matrix diagonal by Jacobi rotations, in place; `vectors` receives the columns."""
    _rotate_until(matrix, vectors, 0.0)


@compiled
def roughly_principal(matrix: Array, vectors: Array) -> None:
    """Make a positive definite 3x3 matrix nearly diagonal: correlations of a hundredth are left."""
    # Search coordinates need be no exact axes: at a hundredth a box is no worse, and a sweep or two is spared.
    _rotate_until(matrix, vectors, 1e-2)


@compiled
def _rotate_until(matrix: Array, vectors: Array, correlation: float) -> None:
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(12):  # Jacobi's sweeps converge quadratically: a handful reaches the rounding
        b, c, e = matrix[0, 1], matrix[0, 2], matrix[1, 2]
        a, d, f = abs(matrix[0, 0]), abs(matrix[1, 1]), abs(matrix[2, 2])
        # Some units in the last place: smaller entries are rounding, and no rotation takes them away.
        if not abs(b) + abs(c) + abs(e) > 1e-15 * (a + d + f):
            return
        share = correlation * correlation
        if b * b <= share * a * d and c * c <= share * a * f and e * e <= share * d * f:
            return
        for p in range(2):
            for q in range(p + 1, 3):
                _rotate(matrix, vectors, p, q)


@compiled
def _rotate(matrix: Array, vectors: Array, p: int, q: int) -> None:
    away = matrix[p, q]
    if away == 0.0:
        return
    # The smaller of the two angles that make the entry zero: the order of the axes stays, and nothing cancels.
    ratio = (matrix[q, q] - matrix[p, p]) / (2.0 * away)
    tangent = (1.0 if ratio >= 0.0 else -1.0) / (abs(ratio) + sqrt(1.0 + ratio * ratio))
    cosine = 1.0 / sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    for k in range(3):
        first, second = matrix[k, p], matrix[k, q]
        matrix[k, p], matrix[k, q] = cosine * first - sine * second, sine * first + cosine * second
    for k in range(3):
        first, second = matrix[p, k], matrix[q, k]
        matrix[p, k], matrix[q, k] = cosine * first - sine * second, sine * first + cosine * second
        first, second = vectors[k, p], vectors[k, q]
        vectors[k, p], vectors[k, q] = cosine * first - sine * second, sine * first + cosine * second


@compiled
def inverse(a: float, b: float, c: float, d: float, e: float, f: float, out: Array) -> bool:
    """Write the inverse of [[a, b, c], [b, d, e], [c, e, f]] into out (3, 3); return False where it is singular."""
    u, v, t = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * u + b * v + c * t
    # Cancelled to its last four digits: an inverse would be noise.
    if not abs(determinant) > 1e-12 * (abs(a * u) + abs(b * v) + abs(c * t)):
        return False
    scale = 1.0 / determinant
    out[0, 0], out[1, 1], out[2, 2] = u * scale, (a * f - c * c) * scale, (a * d - b * b) * scale
    out[0, 1], out[0, 2], out[1, 2] = v * scale, t * scale, (b * c - a * e) * scale
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return True


@compiled
def invert(matrix: Array, size: int, least: float) -> bool:
    """Replace the leading block of a positive definite matrix by its inverse; return False where it is singular.

    Parameters
    ----------
    matrix : array (n, n)
        Symmetric; its lower triangle is read, both are written.
    size : int
        How many rows and columns count.
    least : float
        Share of its diagonal that a pivot must exceed.
    """
    for j in range(size):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > least * matrix[j, j] or not pivot > 0.0:
            return False
        root = sqrt(pivot)
        matrix[j, j] = root
        for i in range(j + 1, size):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / root
    for j in range(size):  # the lower factor by its own inverse
        matrix[j, j] = 1.0 / matrix[j, j]
        for i in range(j + 1, size):
            total = 0.0
            for k in range(j, i):
                total -= matrix[i, k] * matrix[k, j]
            matrix[i, j] = total / matrix[i, i]
    for j in range(size):
        for i in range(j, size):
            total = 0.0
            for k in range(i, size):
                total += matrix[k, i] * matrix[k, j]
            matrix[j, i] = total
    for j in range(size):
        for i in range(j + 1, size):
            matrix[i, j] = matrix[j, i]
    return True
