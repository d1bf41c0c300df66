"""Real roots of a polynomial between two limits."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled

DEGREE = 4
"""Greatest degree."""

# Halvings after which any two doubles have become neighbours.
_MOST = 200


@compiled
def real_roots(c: Array, low: float, high: float, work: Array, out: Array) -> int:
    """Write the real roots of c[0] + c[1] t + ... between two limits in ascending order, and return their number.

    Between two roots of its derivative, a polynomial has at most one root, which is bracketed. Roots of even order,
    where the polynomial touches zero, may be missed.

    Parameters
    ----------
    c : array (DEGREE + 1,)
        Coefficients, constant first.
    low, high : float
        Limits.
    work : array (2, DEGREE + 2)
        Scratch.
    out : array (DEGREE,)
        Written: the roots.
    """
    slope, edge = work[0], work[1]
    count = 0
    # derivatives from the linear one down to the polynomial itself: `out` contains the roots of the derivative before,
    # between which a root is bracketed
    for order in range(DEGREE - 1, -1, -1):
        degree = DEGREE - order
        for i in range(degree + 1):
            slope[i] = c[i + order]
            for k in range(order):
                slope[i] *= i + order - k
        edge[0] = low
        for i in range(count):
            edge[1 + i] = out[i]
        edge[1 + count] = high
        brackets, count = count + 1, 0
        for i in range(brackets):
            left, right = _value(slope, degree, edge[i]), _value(slope, degree, edge[i + 1])
            if left * right < 0.0 or right == 0.0:
                out[count] = _root(slope, degree, edge[i], edge[i + 1], left)
                count += 1
    return count


@compiled
def _value(c: Array, degree: int, t: float) -> float:
    # Return the value of a polynomial at t, by Horner's rule.
    value = c[degree]
    for i in range(degree - 1, -1, -1):
        value = value * t + c[i]
    return float(value)


@compiled
def _root(c: Array, degree: int, low: float, high: float, left: float) -> float:
    """Return the root between `low` and `high`, where the values have different signs; `left` is the value at `low`.

    The iteration uses Newton's step if it stays between the points, else the middle.
    """
    t = high
    for _ in range(_MOST):
        value, slope = c[degree], 0.0
        for i in range(degree - 1, -1, -1):
            slope = slope * t + value
            value = value * t + c[i]
        if value == 0.0:
            return t
        if (value < 0.0) == (left < 0.0):
            low = t
        else:
            high = t
        after = t - value / slope if slope != 0.0 else low
        if not low < after < high:
            after = 0.5 * (low + high)
        if abs(after - t) <= _NOTHING * abs(after) or not low < after < high:
            return after
        t = after
    return t


# Relative difference of two roots that counts as rounding.
_NOTHING = 2.0 * np.finfo(float).eps
