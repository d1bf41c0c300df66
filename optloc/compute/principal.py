"""Principal axes of small symmetric matrices, many side by side in lanes."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.compute.systems import LANES

# Squared correlation that is left, at most: axes so near cost what the exact ones do to ten digits.
_CORRELATION = 1e-20
# Squared share of the trace below which an entry is rounding that no rotation takes away.
_ROUNDING = 1e-31
# Jacobi's sweeps converge quadratically: of 64 matrices one always needs three, and a few more reach the rounding from
# any matrix. In the plane a single turn is exact.
_FIRST, _SWEEPS = 3, 8


@compiled
def principal_axes(matrix: Array, axes: Array, spare: Array) -> None:
    """Make symmetric matrices diagonal by Jacobi rotations.

    Parameters
    ----------
    matrix : array (n, n, W)
        Read on and below the diagonal; its diagonal is overwritten with the eigenvalues, in no order.
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
                _rotate(matrix, axes, p, q)


@compiled
def _is_left(matrix: Array, trace: Array) -> bool:
    """Return whether an entry beside a diagonal is more than rounding."""
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
                # NaN is never left: a lane without a matrix holds up no other
                left += 1.0 if entry * entry > least else 0.0
    return left > 0.0


@compiled
def _rotate(matrix: Array, axes: Array, p: int, q: int) -> None:
    """Turn axes p < q so that the entry between them vanishes."""
    n = len(matrix)
    for lane in range(LANES):
        entry, first, second = matrix[q, p, lane], matrix[p, p, lane], matrix[q, q, lane]
        # the smaller of the two angles: the axes keep their order, and nothing cancels
        ratio = (second - first) / (2.0 * entry)
        size = 1.0 / (abs(ratio) + np.sqrt(1.0 + ratio * ratio))
        tangent = size if ratio >= 0.0 else -size
        tangent = tangent if entry != 0.0 else 0.0
        cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
        sine = tangent * cosine
        matrix[p, p, lane], matrix[q, q, lane] = first - tangent * entry, second + tangent * entry
        # the entry's place holds the angle until the others are turned
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
