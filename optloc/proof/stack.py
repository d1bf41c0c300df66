"""The stack of boxes still to be looked at: rows of centre, half-widths and the bound of the box they came from."""

from __future__ import annotations

from optloc.kernels.jit import compiled
from optloc.types import Array

CAPACITY, DEPTH = 512, 7


@compiled
def push_around(stack: Array, low: Array, high: Array, hole: Array) -> int:
    """Push the box between two corners, less the box |s_k| <= hole_k around the origin; return how many that makes.

    The hole is cut out along its faces: at most two slabs a dimension. Slabs overlap the hole by a rounding.
    """
    size = 0
    low, high = low.copy(), high.copy()
    for k in range(3):
        for side in range(2):
            first, last = (low[k], min(-hole[k], high[k])) if side == 0 else (max(hole[k], low[k]), high[k])
            if not last > first:
                continue
            for m in range(3):
                a, b = (first, last) if m == k else (low[m], high[m])
                stack[size, m], stack[size, 3 + m] = 0.5 * (a + b), _wide(0.5 * (b - a), abs(a) + abs(b))
            stack[size, 6] = 0.0
            size += 1
        if -hole[k] > high[k] or hole[k] < low[k]:
            return size
        low[k], high[k] = max(low[k], -hole[k]), min(high[k], hole[k])
    return size


@compiled
def pop(stack: Array, row: int, at: Array, half: Array) -> None:
    """Write centre and half-widths of a box on the stack into `at` and `half`."""
    for k in range(3):
        at[k], half[k] = stack[row, k], stack[row, 3 + k]


@compiled
def push(stack: Array, size: int, at: Array, half: Array, low: float) -> int:
    """Push a box; return the size of the stack."""
    for k in range(3):
        stack[size, k], stack[size, 3 + k] = at[k], half[k]
    stack[size, 6] = low
    return size + 1


@compiled
def push_halves(stack: Array, size: int, k: int, at: Array, half: Array, low: float) -> int:
    """Push the halves of a box, cut across side k; return the size of the stack."""
    for side in range(2):
        for m in range(3):
            stack[size, m], stack[size, 3 + m] = at[m], half[m]
        quarter = 0.5 * half[k]
        stack[size, k] = at[k] + (quarter if side else -quarter)
        stack[size, 3 + k] = _wide(quarter, abs(at[k]) + half[k])
        stack[size, 6] = low
        size += 1
    return size


@compiled
def _wide(half: float, size: float) -> float:
    """Return a half-width that covers the rounding of a centre and of a corner of this size."""
    return half * (1.0 + 1e-12) + 1e-15 * size if half > 0.0 else 0.0
