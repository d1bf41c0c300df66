r"""The secular equation of least squares with one quadratic constraint.

.. math:: \sum_j \frac{c_j^2}{(t - p_j)^2} = \kappa + \sigma t, \qquad \sigma \ge 0,

with poles :math:`p_1 \le \dots \le p_d`. :math:`T(t)` is the left side. By Cauchy's inequality :math:`3 T'^2 \le 2 T
T''`, so :math:`T^{-1/2}` is concave between two poles, :math:`(\kappa + \sigma t)^{-1/2}` is convex where it exists,
and

.. math:: k(t) = T(t)^{-1/2} - (\kappa + \sigma t)^{-1/2}

is concave in every interval. Newton's iteration on `k` starts near a pole, where `k <= 0`. It therefore climbs
monotonically to the first root on that side of the pole, or reaches `k' <= 0`, which proves that no root exists. Every
interval contains at most two roots, one at each end. So starts on both sides of all poles, and for ``sigma > 0`` at the
zero of the right side, find all real roots. No polynomial and no bracket is needed. Each root is stored as the distance
from its pole: roots that fall onto a pole (the "hard case", ``c_j`` near 0) keep their full relative accuracy.

Sources: J. J. More and D. C. Sorensen, "Computing a trust region step", SIAM J. Sci. Stat. Comput. 4 (1983), section 3
(the concave form on the last interval); the use on every interval is the same inequality.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.algebra import Array, Mask

_EPS = float(np.finfo(np.float64).eps)
# Limit of Newton steps. Random problems of up to four unknowns, with columns scaled over twelve decades, took at most
# 52 steps. Most steps are far from the root, where the distance from the pole grows only by a constant factor.
_STEPS = 80


@dataclass(frozen=True, slots=True)
class Secular:
    r"""A batch of secular equations, the batch on the last axis.

    Parameters
    ----------
    gap : Array, shape (d, d, N)
        Differences of poles ``gap[k, j] = p_j - p_k``, which may be more accurate than the poles.
    pole : Array, shape (d, N)
        Poles in ascending order.
    weight : Array, shape (d, N)
        The :math:`c_j^2`, all positive (the caller floors exact zeros).
    level, slope : Array, shape (N,)
        :math:`\kappa` and :math:`\sigma`.
    """

    gap: Array
    pole: Array
    weight: Array
    level: Array
    slope: Array


@dataclass(frozen=True, slots=True)
class Roots:
    """Roots of a batch of secular equations, one in each slot.

    Parameters
    ----------
    t : Array, shape (K, N)
        The roots.
    apart : Array, shape (d, K, N)
        ``t - p_j`` with full relative accuracy.
    found : Mask, shape (K, N)
        Whether the slot contains a root; otherwise the other arrays have no meaning.
    """

    t: Array
    apart: Array
    found: Mask


def largest(equation: Secular) -> Roots:
    """Return the root above the last pole; it is unique, and exists if the right side grows or is positive.

    Parameters
    ----------
    equation : Secular
        N equations.

    Returns
    -------
    Roots
        One slot (K = 1).

    Notes
    -----
    More and Sorensen (1983), section 3.
    """
    gap = equation.gap[:, -1:]
    start, free = _start(equation, equation.pole[-1:], equation.weight[-1:], 1.0)
    return _climb(equation, equation.pole[-1:], gap, np.ones((1, 1)), start, free)


def everything(equation: Secular) -> Roots:
    """Return all real roots.

    Parameters
    ----------
    equation : Secular
        N equations.

    Returns
    -------
    Roots
        Slots: d to the left of each pole, d to the right, and one next to the zero of the right side (K = 2d + 1).

    Notes
    -----
    See the text of the module: each interval between poles contains at most two roots.
    """
    d = len(equation.pole)
    left, left_free = _start(equation, equation.pole, equation.weight, -1.0)
    right, right_free = _start(equation, equation.pole, equation.weight, 1.0)
    sign = np.concatenate([-np.ones((d, 1)), np.ones((d + 1, 1))])
    slope = np.where(equation.slope > 0.0, equation.slope, 1.0)
    zero = -equation.level / slope
    # below all poles the left side grows: after the zero of the right side, no root comes before left side / slope
    apart = zero - equation.pole
    tail = np.sum(equation.weight / apart**2, axis=0) / slope
    gap = np.concatenate([equation.gap, equation.gap, apart[:, None]], axis=1)
    pole = np.concatenate([equation.pole, equation.pole, zero[None]])
    start = np.concatenate([left, right, tail[None]])
    exists = (equation.slope > 0.0) & (zero < equation.pole[0])
    free = np.concatenate([left_free, right_free, exists[None]])
    return _climb(equation, pole, gap, sign, start, free)


def _start(equation: Secular, pole: Array, weight: Array, sign: float) -> tuple[Array, Mask]:
    """Return distances from the poles that are not beyond the first root, and whether a root is possible.

    `pole` and `weight` (K, N) belong to the slots; `sign` is 1 for roots above the poles, -1 for roots below them.
    """
    level, slope = equation.level + equation.slope * pole, equation.slope
    positive = level > 0.0
    safe = np.where(positive, level, 1.0)
    if sign < 0.0:
        return np.sqrt(weight / safe), positive
    grows = slope > 0.0
    if not grows.any():
        return np.sqrt(weight / safe), positive
    rate = np.where(grows, slope, 1.0)
    # The other poles only add to the left side. If this pole alone exceeds twice each of the two terms of the right
    # side, the first root has not been reached. If the level is negative, the root is beyond the zero of the right
    # side, at the distance b. Then (away + b)^2 <= 4 max(away, b)^2 gives the factors of a quarter.
    cube = np.where(grows, np.cbrt(0.25 * weight / rate), np.inf)
    above = np.minimum(np.sqrt(0.5 * weight / safe), cube)
    away = np.where(positive, 1.0, -level / rate)
    below = away + np.minimum(0.25 * weight / (rate * away**2), cube)
    return np.where(positive, above, np.where(away > 0.0, below, cube)), positive | grows


def _climb(equation: Secular, origin: Array, gap: Array, sign: Array, start: Array, free: Mask) -> Roots:
    """Return the roots after Newton's monotone iteration from distances `start` (K, N) of the origins.

    `gap[k, i]` is the distance of origin i from pole k. `sign` is 1 for slots above their origin, -1 below. `free`
    marks slots in which a root is possible.
    """
    weight = equation.weight[:, None]
    level = equation.level + equation.slope * origin
    slope = equation.slope * sign
    away, todo, found = start.copy(), free.copy(), np.zeros(free.shape, dtype=np.bool_)
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            apart = gap + sign * away
            part = weight / (apart * apart)
            total = part.sum(axis=0)
            right = level + slope * away
            root, side = 1.0 / np.sqrt(total), 1.0 / np.sqrt(right)
            value = root - side
            change = sign * (part / apart).sum(axis=0) * root / total + 0.5 * slope * side / right
            step = -value / change
            # a level too high for the interval: no root, k' changes sign first
            todo &= (change > 0.0) & np.isfinite(step)
            # a step of a few roundings of the distance: the iteration has converged
            done = todo & (step <= 4.0 * _EPS * away)
            found |= done
            todo &= ~done
            if not todo.any():
                break
            away = np.where(todo, away + step, away)
    apart = gap + sign * away
    # a Newton step may jump over the next pole if the interval contains no root
    found &= np.all((apart * gap > 0.0) | (gap == 0.0), axis=0) & np.all((gap != 0.0) | (apart * sign > 0.0), axis=0)
    return Roots(origin + sign * away, apart, found)
