"""Linear forms of a box's coordinates as triples of numbers: their reach, their products, ranges over a box.

A box is ``|s_k| <= h_k``; a linear form u.s is the triple of its coefficients.
"""

from __future__ import annotations

from math import inf, sqrt

from optloc.base.types import Array
from optloc.compute.jit import compiled

Triple = tuple[float, float, float]
# A range over a box, see `range_form`.
RangeForm = tuple[float, Triple, float, float, float]


@compiled
def triple(numbers: Array, at: int) -> Triple:
    """Return three numbers from an index on."""
    return numbers[at], numbers[at + 1], numbers[at + 2]


@compiled
def pull(n: Triple, sense: Array) -> Triple:
    """Return the linear form ``n.(sense s)``."""
    return (
        n[0] * sense[0, 0] + n[1] * sense[1, 0] + n[2] * sense[2, 0],
        n[0] * sense[0, 1] + n[1] * sense[1, 1] + n[2] * sense[2, 1],
        n[0] * sense[0, 2] + n[1] * sense[1, 2] + n[2] * sense[2, 2],
    )


@compiled
def inner(u: Triple, v: Triple) -> float:
    """Return the inner product of two triples."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@compiled
def length(u: Triple) -> float:
    """Return the Euclidean length of a triple."""
    return sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])


@compiled
def blend(p: float, u: Triple, q: float, v: Triple) -> Triple:
    """Return the linear form ``p u + q v``."""
    return p * u[0] + q * v[0], p * u[1] + q * v[1], p * u[2] + q * v[2]


@compiled
def write(u: Triple, out: Array) -> None:
    """Write a triple into an array (3,)."""
    out[0], out[1], out[2] = u[0], u[1], u[2]


@compiled
def still(slope: Array) -> bool:
    """Return whether a slope (3,) is zero, as that of a node which is only enclosed."""
    return bool(slope[0] == 0.0 and slope[1] == 0.0 and slope[2] == 0.0)


@compiled
def unbounded(curvature: Array, turn: Array) -> float:
    """Say that a node's curvature has no bound over a box: no Hessian, infinite change of the gradient; return inf."""
    for k in range(3):
        turn[k] = inf
        for m in range(3):
            curvature[k, m] = 0.0
    return inf


@compiled
def reach(u: Triple, h: Triple) -> float:
    """Return the greatest value of ``|u.s|`` over a box."""
    return abs(u[0]) * h[0] + abs(u[1]) * h[1] + abs(u[2]) * h[2]


@compiled
def row_reach(matrix: Array, k: int, h: Triple) -> float:
    """Return the greatest value over a box of ``|(matrix s)_k|``: with a Hessian, of the change of a gradient."""
    return float(abs(matrix[k, 0]) * h[0] + abs(matrix[k, 1]) * h[1] + abs(matrix[k, 2]) * h[2])


@compiled
def product(u: Triple, v: Triple, h: Triple) -> tuple[float, float]:
    """Return an enclosure of ``(u.s)(v.s)`` over a box: squares have a sign, which the product of reaches forgets."""
    low = high = 0.0
    for k in range(3):
        square = u[k] * v[k] * h[k] * h[k]
        low += min(square, 0.0)
        high += max(square, 0.0)
    mixed = (
        abs(u[0] * v[1] + u[1] * v[0]) * h[0] * h[1]
        + abs(u[0] * v[2] + u[2] * v[0]) * h[0] * h[2]
        + abs(u[1] * v[2] + u[2] * v[1]) * h[1] * h[2]
    )
    return low - mixed, high + mixed


@compiled
def scaled(low: float, high: float, least: float, most: float) -> tuple[float, float]:
    """Return an enclosure of a number in [low, high] divided by one in [least, most], both of these positive."""
    return low / (least if low < 0.0 else most), high / (least if high > 0.0 else most)


@compiled
def excess(along: float, across: float) -> float:
    """Return a bound of ``hypot(a, b) - a`` for all a >= along and |b| <= across: it falls with a."""
    whole = sqrt(along * along + across * across)
    # The difference of two numbers that are nearly one would lose all digits: as a quotient it loses none.
    return across * across / (whole + along) if along > 0.0 else whole - along


@compiled
def greatest(a: float, b: float, c: float, d: float, e: float, f: float) -> float:
    """Return the maximum of s'[[a, b, c], [b, d, e], [c, e, f]]s, positive semidefinite, over |s_k| <= 1.

    The maximum is at a corner. The signs of a corner make all three mixed terms positive where their product is;
    otherwise one of them must be negative: the smallest.
    """
    u, v, t = abs(b), abs(c), abs(e)
    mixed = u + v + t
    if b * c * e < 0.0:
        mixed -= 2.0 * min(u, v, t)
    # Rounding may leave a form that is nowhere positive below zero, of which no root could be taken.
    return max(0.0, a + d + f + 2.0 * mixed)


@compiled
def across(sense: Array, u: Triple, h: Triple) -> float:
    """Return a bound over a box of the length of ``sense s`` without its part along a unit vector.

    Parameters
    ----------
    sense : array (3, 3)
        Derivative of a line.
    u : triple
        Pull of the unit vector.
    h : triple
        Half-widths.
    """
    form = greatest(
        _gram(sense, u, 0, 0) * h[0] * h[0],
        _gram(sense, u, 0, 1) * h[0] * h[1],
        _gram(sense, u, 0, 2) * h[0] * h[2],
        _gram(sense, u, 1, 1) * h[1] * h[1],
        _gram(sense, u, 1, 2) * h[1] * h[2],
        _gram(sense, u, 2, 2) * h[2] * h[2],
    )
    return sqrt(form)


@compiled
def range_form(line: Array, sense: Array, h: Triple) -> RangeForm:
    """Return a range over a box: its value r, slope u, the least r + u.s, a bound of the remainder, and the greatest.

    The range is ``r + u.s + q`` with ``0 <= q <= remainder``.
    """
    n = triple(line, 0)
    r = length(n)
    u = pull((n[0] / r, n[1] / r, n[2] / r) if r > 0.0 else (1.0, 0.0, 0.0), sense)
    swing, aside = reach(u, h), across(sense, u, h)
    # The farthest corner, up to the rounding of its root.
    far = sqrt((r + swing) * (r + swing) + aside * aside) * (1.0 + 1e-15)
    return r, u, r - swing, excess(r - swing, aside), far


@compiled
def range_bend(
    sense: Array, h: Triple, r: float, u: Triple, least: float, remainder: float, hessian: Array
) -> tuple[Triple, float, float]:
    """Write the Hessian of a range; return bounds of the change of its gradient (a triple) and Hessian, and its norm.

    Parameters
    ----------
    sense : array (3, 3)
        Derivative of the line.
    h : triple
        Half-widths.
    r, u, least, remainder
        What `range_form` returns; `least` must be positive.
    hessian : array (3, 3)
        Written: ``sense' P sense / r``.
    """
    trace = 0.0
    for k in range(3):
        for m in range(k + 1):
            gram = _gram(sense, u, k, m)
            hessian[k, m] = hessian[m, k] = gram / r
            if k == m:
                trace += gram / r
    if not least > 0.0:
        return (inf, inf, inf), inf, trace
    back = r / least
    turn = (
        row_reach(hessian, 0, h) * back + remainder * abs(u[0]) / least,
        row_reach(hessian, 1, h) * back + remainder * abs(u[1]) / least,
        row_reach(hessian, 2, h) * back + remainder * abs(u[2]) / least,
    )
    eta = length(turn)
    change = eta * (2.0 * length(u) + eta) / least + trace * (reach(u, h) + remainder) / least
    return turn, change, trace


@compiled
def _gram(sense: Array, u: Triple, k: int, m: int) -> float:
    entry = sense[0, k] * sense[0, m] + sense[1, k] * sense[1, m] + sense[2, k] * sense[2, m] - u[k] * u[m]
    # A squared length: rounding may not make it negative.
    return float(max(entry, 0.0)) if k == m else float(entry)
