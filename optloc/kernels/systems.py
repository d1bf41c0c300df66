"""Small symmetric positive definite systems side by side in lanes; a singular system does not affect the other lanes.

Systems of unknowns with mixed units (metres, radians, seconds) are scaled to a unit diagonal. They are flagged if a
pivot vanishes, as in `optloc.base.linalg`. Their matrices and vectors are stored in cells of a memory m (cells, B) of B
lanes, row by row; arguments such as `right` are their first cells. Systems of lengths only, such as positions from
ranges, are factored without scaling. This takes no square roots, and the number of lanes is known when they are
compiled.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from optloc.base.linalg import PIVOT
from optloc.base.types import Array
from optloc.kernels.batched_rows import LaneCells
from optloc.kernels.jit import compiled, inlined

# Scaled systems in the memory of a block of lanes.


@compiled
def factor(m: Array, matrix: int, n: int, scale: int, ok: int, least: float, lanes: int) -> None:
    """Replace the lower triangle (n, n) by the factor of the matrix scaled to a unit diagonal.

    The diagonal then contains inverse pivots.

    Parameters
    ----------
    m : array (cells, B)
        Memory.
    matrix : int
        First cell of the matrix.
    n : int
        Size of the matrix.
    scale : int
        First cell of the scales (n,), which are written.
    ok : int
        Cell that becomes 0.0 if a matrix is not numerically positive definite.
    least : float
        Share of its diagonal that a pivot must exceed.
    lanes : int
        Number of lanes that contain a problem.
    """
    for i in range(n):
        for b in range(lanes):
            positive = m[matrix + i * n + i, b] > 0.0
            # A lane that is not definite continues with ones: its numbers stay finite, and `ok` is zero.
            m[scale + i, b] = 1.0 / np.sqrt(m[matrix + i * n + i, b] if positive else 1.0)
            m[ok, b] = m[ok, b] if positive else 0.0
        for j in range(i + 1):
            for b in range(lanes):
                m[matrix + i * n + j, b] *= m[scale + i, b] * m[scale + j, b]
    for j in range(n):
        pivot = matrix + j * n + j
        for k in range(j):
            for b in range(lanes):
                m[pivot, b] -= m[matrix + j * n + k, b] * m[matrix + j * n + k, b]
        for b in range(lanes):
            positive = m[pivot, b] > least
            m[ok, b] = m[ok, b] if positive else 0.0
            m[pivot, b] = 1.0 / np.sqrt(m[pivot, b] if positive else 1.0)
        for i in range(j + 1, n):
            entry = matrix + i * n + j
            for k in range(j):
                for b in range(lanes):
                    m[entry, b] -= m[matrix + i * n + k, b] * m[matrix + j * n + k, b]
            for b in range(lanes):
                m[entry, b] *= m[pivot, b]


@compiled
def forward(m: Array, lower: int, n: int, scale: int, right: int, lanes: int) -> None:
    """Replace the vector (n,) at cell `right` by the inverse of the factor times the vector and its scale."""
    for i in range(n):
        for b in range(lanes):
            m[right + i, b] *= m[scale + i, b]
        for k in range(i):
            for b in range(lanes):
                m[right + i, b] -= m[lower + i * n + k, b] * m[right + k, b]
        for b in range(lanes):
            m[right + i, b] *= m[lower + i * n + i, b]


@compiled
def backward(m: Array, lower: int, n: int, scale: int, right: int, lanes: int) -> None:
    """Replace the vector (n,) at cell `right`, which `forward` returned, by the solution, which is scaled."""
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for b in range(lanes):
                m[right + i, b] -= m[lower + k * n + i, b] * m[right + k, b]
        for b in range(lanes):
            m[right + i, b] *= m[lower + i * n + i, b]
    for i in range(n):
        for b in range(lanes):
            m[right + i, b] *= m[scale + i, b]


@compiled
def step(m: Array, room: LaneCells, n: int, local: int, damping: int, ok: int, lanes: int) -> None:
    """Write the damped step from `room.now` to `room.step`; the step is zero if cell `ok` becomes 0.0.

    Parameters
    ----------
    m : array (cells, B)
        Memory.
    room : LaneCells
        Addresses in the memory.
    n, local : int
        Numbers of shared and of local unknowns.
    damping : int
        Cell of Marquardt's factor f: the diagonal of the information is multiplied by 1 + f.
    ok : int
        Cell that becomes 0.0 if the systems cannot be solved.
    lanes : int
        Number of lanes that contain a problem.
    """
    size = n + local
    line = size + 1
    for b in range(lanes):
        m[ok, b] = 1.0
    for i in range(n):
        for j in range(i + 1):
            for b in range(lanes):
                m[room.shared + i * n + j, b] = m[room.now + i * line + j, b]
        for b in range(lanes):
            m[room.shared + i * n + i, b] *= 1.0 + m[damping, b]
            m[room.step + i, b] = m[room.now + size * line + i, b]
    if local > 0:
        factor_local(m, room, room.now, n, local, damping, ok, PIVOT, lanes)
        eliminate(m, room, n, local, lanes)
    factor(m, room.shared, n, room.shared_scale, ok, PIVOT, lanes)
    forward(m, room.shared, n, room.shared_scale, room.step, lanes)
    backward(m, room.shared, n, room.shared_scale, room.step, lanes)
    if local > 0:
        complete(m, room, n, local, lanes)
    for i in range(size):
        for b in range(lanes):
            m[room.step + i, b] = m[room.step + i, b] if m[ok, b] != 0.0 else 0.0


@compiled
def factor_local(
    m: Array, room: LaneCells, source: int, n: int, local: int, damping: int, ok: int, least: float, lanes: int
) -> None:
    """Factor the damped system of the local unknowns of the equations at cell `source`.

    The coupling with the n shared unknowns and the right side, multiplied by the inverse factor, are written to
    `room.half`. See `step` for `damping`, and `factor` for `ok` and `least`.
    """
    line, half = n + local + 1, room.half
    for i in range(local):
        row, own = source + (n + i) * line, room.local + i * local
        for j in range(i + 1):
            for b in range(lanes):
                m[own + j, b] = m[row + n + j, b]
        for b in range(lanes):
            # Marquardt's scaling, as for the shared unknowns.
            grown = m[own + i, b] * (1.0 + m[damping, b])
            m[own + i, b] = grown if grown != 0.0 else 1.0  # an unknown without a row keeps its value
        for j in range(n):
            for b in range(lanes):
                m[half + j * local + i, b] = m[row + j, b]
        for b in range(lanes):
            m[half + n * local + i, b] = m[source + (n + local) * line + n + i, b]
    factor(m, room.local, local, room.local_scale, ok, least, lanes)
    # The couplings of all shared unknowns, followed by the vector.
    for j in range(n + 1):
        forward(m, room.local, local, room.local_scale, half + j * local, lanes)


@compiled
def eliminate(m: Array, room: LaneCells, n: int, local: int, lanes: int) -> None:
    """Subtract the Schur complement of the local unknowns from the shared system in `room.shared` and `room.step`."""
    half = room.half
    for a in range(local):
        for i in range(n):
            u, v = half + i * local + a, half + n * local + a
            for b in range(lanes):
                m[room.step + i, b] -= m[u, b] * m[v, b]
            for j in range(i + 1):
                for b in range(lanes):
                    # `half` is L^-1 C', so that its products are C B^-1 C'.
                    m[room.shared + i * n + j, b] -= m[u, b] * m[half + j * local + a, b]


@compiled
def complete(m: Array, room: LaneCells, n: int, local: int, lanes: int) -> None:
    """Write the step of the local unknowns to `room.step`, after the step of the shared ones.

    The local system is factored, and its coupling is in `room.half`.
    """
    own = room.step + n
    for a in range(local):
        for b in range(lanes):
            m[own + a, b] = m[room.half + n * local + a, b]
        for i in range(n):
            for b in range(lanes):
                m[own + a, b] -= m[room.half + i * local + a, b] * m[room.step + i, b]
    backward(m, room.local, local, room.local_scale, own, lanes)


# Systems of one unit, in arrays whose last axis is the lane.

LANES = 64
"""Number of lanes of a block if all unknowns are lengths. A fix takes the same time with 16 to 256, twice with 8."""


@compiled
def factor_plain(A: Array, diagonal: Array, lower: Array, inverse: Array) -> None:
    """Write the unit lower factors of symmetric matrices, and one over each pivot.

    Parameters
    ----------
    A : array (n, n, W)
        Read below the diagonal.
    diagonal : array (n, W)
        Diagonal of the matrices, used instead of that of A.
    lower : array (n, n, W)
        Written: the factors below the diagonal; above it is scratch.
    inverse : array (n, W)
        Written: one over each pivot.
    """
    n = len(diagonal)
    for i in range(n):
        pivot = inverse[i]
        for lane in range(LANES):
            pivot[lane] = diagonal[i, lane]
        for j in range(i):
            # above the diagonal are the entries before the division by their pivot
            for lane in range(LANES):
                lower[j, i, lane] = A[i, j, lane]
            for k in range(j):
                for lane in range(LANES):
                    lower[j, i, lane] -= lower[k, i, lane] * lower[j, k, lane]
            for lane in range(LANES):
                lower[i, j, lane] = lower[j, i, lane] * inverse[j, lane]
                pivot[lane] -= lower[j, i, lane] * lower[i, j, lane]
        for lane in range(LANES):
            # Infinite or negative if the matrix is not definite; the caller compares it with the diagonal.
            pivot[lane] = 1.0 / pivot[lane]


@compiled
def solve_plain(lower: Array, inverse: Array, right: Array) -> None:
    """Solve with a factorisation of `factor_plain`, in place.

    Parameters
    ----------
    lower, inverse : array (n, n, W), (n, W)
        Unit lower factors and inverse pivots.
    right : array (n, W)
        Overwritten with the solutions.
    """
    n = len(inverse)
    for i in range(n):
        for j in range(i):
            for lane in range(LANES):
                right[i, lane] -= lower[i, j, lane] * right[j, lane]
    for i in range(n - 1, -1, -1):
        for lane in range(LANES):
            right[i, lane] *= inverse[i, lane]
        for j in range(i + 1, n):
            for lane in range(LANES):
                right[i, lane] -= lower[j, i, lane] * right[j, lane]


# Share of its diagonal that a pivot must keep: an unknown that no row depends on keeps its value.
_FELT = 1e-13


@compiled
def eliminate_last(A: Array, right: Array, cost: Array, diagonal: Array, keep: int) -> None:
    """Eliminate the last unknowns from normal equations: they take the best values for any values of the others.

    Parameters
    ----------
    A : array (n, n, W)
        Information below the diagonal. Overwritten: the remaining information about the first `keep` unknowns; row i of
        an eliminated unknown contains ``-d x_i / d x_j`` for j < i.
    right : array (n, W)
        Right side; overwritten.
    cost : array (W,)
        Cost; overwritten with the minimum over the eliminated unknowns.
    diagonal : array (n, W)
        Scratch.
    keep : int
        Number of unknowns that stay.
    """
    n = len(right)
    for k in range(keep, n):
        for lane in range(LANES):
            diagonal[k, lane] = A[k, k, lane]
    for k in range(n - 1, keep - 1, -1):
        for lane in range(LANES):
            felt = A[k, k, lane] > _FELT * diagonal[k, lane]
            A[k, k, lane] = 1.0 / A[k, k, lane] if felt else 0.0
            cost[lane] -= A[k, k, lane] * right[k, lane] * right[k, lane]
        # from the last column backwards, so that overwritten entries are no longer needed
        for i in range(k - 1, -1, -1):
            share = diagonal[k]
            for lane in range(LANES):
                share[lane] = A[k, k, lane] * A[k, i, lane]
                right[i, lane] -= share[lane] * right[k, lane]
            for j in range(i + 1):
                for lane in range(LANES):
                    A[i, j, lane] -= share[lane] * A[k, j, lane]
            for lane in range(LANES):
                A[k, i, lane] = share[lane]


# Linear algebra of symmetric 3x3 matrices and of small positive definite systems, as scalar code.


@compiled
def positive(a: float, b: float, c: float, d: float, e: float, f: float) -> bool:
    """Return whether the matrix [[a, b, c], [b, d, e], [c, e, f]] is positive definite despite rounding."""
    # Some thousand times the rounding error of the entries, which are sums over rows: above it, the matrix is positive.
    shift = 1e-12 * (abs(a) + abs(d) + abs(f))
    a, d, f = a - shift, d - shift, f - shift
    if not a > 0.0:
        return False
    dd, ee, ff = d - b * b / a, e - b * c / a, f - c * c / a
    return dd > 0.0 and ff - ee * ee / dd > 0.0


@inlined
def positive_along(a: float, b: float, c: float, d: float, e: float, f: float, second: bool, third: bool) -> bool:
    """Return whether a matrix is positive definite in the coordinates that exist, see `positive`.

    `second` and `third` are False if the coordinate does not exist. Then its entries are ignored, and its pivot is set
    as large as the others. A pivot of 1 would be rounding compared with large ones in other units.
    """
    most = max(abs(a), abs(d) if second else 0.0, abs(f) if third else 0.0)
    return positive(a, b, c, d if second else most, e, f if third else most)


@compiled
def principal(matrix: Array, vectors: Array) -> None:
    """Diagonalise a symmetric 3x3 matrix by Jacobi rotations in place.

    `vectors` receives the eigenvectors in columns.
    """
    _rotate_until(matrix, vectors, 0.0)


@compiled
def roughly_principal(matrix: Array, vectors: Array) -> None:
    """Diagonalise a positive definite 3x3 matrix approximately; correlations of up to 0.01 remain."""
    # Search coordinates need not be exact axes: with 0.01 a box is not worse, and one or two sweeps are saved.
    _rotate_until(matrix, vectors, 1e-2)


@compiled
def _rotate_until(matrix: Array, vectors: Array, correlation: float) -> None:
    # Rotate until the remaining squared correlations are small.
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(12):  # Jacobi's sweeps converge quadratically: a few are enough
        b, c, e = matrix[0, 1], matrix[0, 2], matrix[1, 2]
        a, d, f = abs(matrix[0, 0]), abs(matrix[1, 1]), abs(matrix[2, 2])
        # Some units in the last place: smaller entries are rounding, which no rotation removes.
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
    # Apply the Jacobi rotation that makes entry (p, q) zero.
    away = matrix[p, q]
    if away == 0.0:
        return
    # The smaller of the two angles that make the entry zero: the order of the axes stays, and no digits cancel.
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
    """Write the inverse of [[a, b, c], [b, d, e], [c, e, f]] to out (3, 3); return False if the matrix is singular."""
    u, v, t = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * u + b * v + c * t
    # The sum of the absolute terms of the determinant, before cancellation. For a matrix of rank one the cofactors are
    # rounding themselves, and would not be small compared with each other. The ratio does not depend on the scales of
    # rows and columns.
    size = abs(a * d * f) + 2.0 * abs(b * c * e) + abs(a) * e * e + abs(d) * c * c + abs(f) * b * b
    # Only the last four digits are left: an inverse would be noise.
    if not abs(determinant) > 1e-12 * size:
        return False
    scale = 1.0 / determinant
    out[0, 0], out[1, 1], out[2, 2] = u * scale, (a * f - c * c) * scale, (a * d - b * b) * scale
    out[0, 1], out[0, 2], out[1, 2] = v * scale, t * scale, (b * c - a * e) * scale
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return True


@compiled
def cholesky(matrix: Array, size: int, least: float) -> bool:
    """Replace the lower triangle of a leading block by its factor; return whether the block is positive definite.

    Parameters
    ----------
    matrix : array (n, n)
        Symmetric; its lower triangle is read and written.
    size : int
        Size of the leading block.
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
    return True


@compiled
def substitute(lower: Array, right: Array) -> None:
    """Replace the vector `right` (n,) by the inverse of the lower triangular matrix `lower` times this vector."""
    for i in range(len(right)):
        for k in range(i):
            right[i] -= lower[i, k] * right[k]
        right[i] /= lower[i, i]


@compiled
def solve_factored(lower: Array, right: Array) -> None:
    """Replace the vector `right` (n,) by the solution of the system whose factor `cholesky` wrote to `lower`."""
    substitute(lower, right)
    for i in range(len(right) - 1, -1, -1):
        for k in range(i + 1, len(right)):
            right[i] -= lower[k, i] * right[k]
        right[i] /= lower[i, i]


@compiled
def invert(matrix: Array, size: int, least: float) -> bool:
    """Replace the leading block of a positive definite matrix by its inverse; return False if it is singular.

    Parameters
    ----------
    matrix : array (n, n)
        Symmetric; its lower triangle is read, both triangles are written.
    size : int
        Size of the leading block.
    least : float
        Share of its diagonal that a pivot must exceed.
    """
    if not cholesky(matrix, size, least):
        return False
    for j in range(size):  # replace the lower factor by its inverse
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


# Principal axes of many small matrices side by side.

# Greatest squared correlation that remains: with such axes, costs agree with the exact ones to ten digits.
_CORRELATION = 1e-20
# Squared share of the trace below which an entry is rounding, which no rotation removes.
_ROUNDING = 1e-31
# Jacobi's sweeps converge quadratically. Of 64 matrices one always needs three, and a few more reach the rounding from
# any matrix. In two dimensions a single rotation is exact.
_FIRST, _SWEEPS = 3, 8


@compiled
def principal_axes(matrix: Array, axes: Array, spare: Array) -> None:
    """Diagonalise symmetric matrices by Jacobi rotations.

    Parameters
    ----------
    matrix : array (n, n, W)
        Read on and below the diagonal; the diagonal is overwritten with the eigenvalues, not sorted.
    axes : array (n, n, W)
        Written: unit eigenvectors, in columns.
    spare : array (W,)
        Scratch.
    """
    n = len(matrix)
    for i in range(n):
        for j in range(n):
            for lane in range(LANES):
                axes[i, j, lane] = 1.0 if i == j else 0.0
    for sweep in range(_SWEEPS if n > 2 else n - 1):
        if sweep >= _FIRST and not _is_left(matrix, spare):
            return
        for p in range(n - 1):
            for q in range(p + 1, n):
                _turn(matrix, axes, p, q)


@compiled
def _is_left(matrix: Array, trace: Array) -> bool:
    """Return whether an off-diagonal entry is more than rounding in any lane; `trace` (W,) is scratch."""
    n, left = len(matrix), 0.0
    for lane in range(LANES):
        trace[lane] = 0.0
    for i in range(n):
        for lane in range(LANES):
            trace[lane] += abs(matrix[i, i, lane])
    for i in range(1, n):
        for j in range(i):
            for lane in range(LANES):
                entry = matrix[i, j, lane]
                least = max(
                    _CORRELATION * abs(matrix[i, i, lane] * matrix[j, j, lane]), _ROUNDING * trace[lane] * trace[lane]
                )
                # comparisons with NaN are false, so that a lane without a matrix does not delay the others
                left += 1.0 if entry * entry > least else 0.0
    return left > 0.0


@compiled
def _turn(matrix: Array, axes: Array, p: int, q: int) -> None:
    """Rotate the axes p < q so that the entry (q, p) of the matrices vanishes."""
    n = len(matrix)
    for lane in range(LANES):
        entry, first, second = matrix[q, p, lane], matrix[p, p, lane], matrix[q, q, lane]
        # the smaller of the two angles: the axes keep their order, and no digits cancel
        ratio = (second - first) / (2.0 * entry)
        size = 1.0 / (abs(ratio) + np.sqrt(1.0 + ratio * ratio))
        tangent = size if ratio >= 0.0 else -size
        tangent = tangent if entry != 0.0 else 0.0
        cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
        sine = tangent * cosine
        matrix[p, p, lane], matrix[q, q, lane] = first - tangent * entry, second + tangent * entry
        # the entry stores the angle until the other entries are rotated
        matrix[q, p, lane], matrix[p, q, lane] = cosine, sine
    for k in range(n):
        if k not in (p, q):
            a, b, c, d = max(k, p), min(k, p), max(k, q), min(k, q)
            for lane in range(LANES):
                first, second = matrix[a, b, lane], matrix[c, d, lane]
                cosine, sine = matrix[q, p, lane], matrix[p, q, lane]
                matrix[a, b, lane] = cosine * first - sine * second
                matrix[c, d, lane] = sine * first + cosine * second
        for lane in range(LANES):
            first, second = axes[k, p, lane], axes[k, q, lane]
            cosine, sine = matrix[q, p, lane], matrix[p, q, lane]
            axes[k, p, lane] = cosine * first - sine * second
            axes[k, q, lane] = sine * first + cosine * second
    for lane in range(LANES):
        matrix[q, p, lane] = 0.0
