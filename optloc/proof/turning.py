"""The argument of 1 + w over a box of complex numbers w: what azimuth and elevation share.

With the line of sight as a complex number z = z_c (1 + w), w = r + i t, the angle changes by ``atan(t/(1+r))``,
whose linear part is t.
"""

from __future__ import annotations

from math import atan, atan2, pi, sqrt

from optloc.kernels.jit import compiled

_ROUNDING = 1e-15


@compiled
def departure(back: float, ahead: float, aside: float) -> float:
    """Return the greatest ``|atan(t/(1+r)) - t|`` over ``-back <= r <= ahead, |t| <= aside``; back must be below 1.

    At t > 0 the difference falls with r. At r = -back it is greatest where ``t^2 = back (1 - back)``; at r = ahead it
    falls with t.
    """
    best = min(aside, sqrt(back * (1.0 - back)))
    above = atan(best / (1.0 - back)) - best
    below = aside - atan(aside / (1.0 + ahead))
    return max(above, below) + _ROUNDING * aside


@compiled
def remainder(back: float, ahead: float, aside: float, bilinear: tuple[float, float]) -> tuple[float, float]:
    """Return an enclosure of ``atan(t/(1+r)) - t``.

    Parameters
    ----------
    back, ahead, aside : float
        ``-back <= r <= ahead, |t| <= aside``; back below 1.
    bilinear : pair of float
        An enclosure of ``-r t``, its leading term; what is beyond is at most ``|w|^3 / (3 (1 - |w|))``.
    """
    wide = departure(back, ahead, aside)
    most = max(back, ahead)
    size = sqrt(most * most + aside * aside)
    if size >= 1.0:
        return -wide, wide
    third = size * size * size / (3.0 * (1.0 - size)) + _ROUNDING * aside
    return max(-wide, bilinear[0] - third), min(wide, bilinear[1] + third)


@compiled
def arguments(left: float, right: float, down: float, up: float) -> tuple[float, float]:
    """Return the angles of the vectors in a rectangle, radians; all angles where it touches the cut or the origin.

    The rectangle is [left, right] along the first axis and [down, up] along the second.
    """
    if left <= 0.0 and down <= 0.0 <= up:
        return -pi, pi
    first, second = atan2(down, left), atan2(down, right)
    third, fourth = atan2(up, left), atan2(up, right)
    return min(first, second, third, fourth), max(first, second, third, fourth)
