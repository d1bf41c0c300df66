"""Azimuths over a box: value, slope, remainder and curvature, and what azimuths of several stations enclose.

The line of sight of an azimuth is the complex number z = X + iY of its horizontal part. With ``z = z_c (1 + w)``,
``w = r + i t``, the angle changes by ``atan(t/(1+r))``, whose linear part is t. Elevations build on the same.
"""

from __future__ import annotations

from math import atan, atan2, cos, hypot, inf, pi, sin, sqrt

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.proof.nodes.node import (
    SCALED,
    Node,
    Row,
    Triple,
    blend,
    inner,
    lay_out,
    length,
    product,
    pull,
    reach,
    row_reach,
    triple,
    unbounded,
    write,
)

# Numbers: the station, its axes (rows), the measured angle from which the node counts, wrapped, and what is not 0 where
# the row is the node's own.
STATION, AXES, MEASURED, ALONE, _WIDTH = 0, 6, 15, 16, 17

# Share of an angle's argument that its own rounding may be: some units in the last place.
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
    if size >= 1.0:  # the series that the third order is cut from ends at the origin
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


@compiled
def horizontal(data: Array, line: Array, sense: Array) -> tuple[float, float, Triple, Triple]:
    """Return the line's components along the first two axes, turned by the measured angle, and their pulls."""
    c, s = cos(data[MEASURED]), sin(data[MEASURED])
    first, second = triple(data, AXES), triple(data, AXES + 3)
    ahead, aside = blend(c, first, s, second), blend(c, second, -s, first)
    away = triple(line, 0)
    return inner(ahead, away), inner(aside, away), pull(ahead, sense), pull(aside, sense)


@compiled
def bound_azimuth(data: Array, line: Array, sense: Array, half: Array, slope: Array) -> tuple[float, float, float]:
    """Bound an azimuth minus its measured value over a box (see `optloc.proof.nodes.node`), radians.

    Where the box touches the half-plane behind the measured direction the angle jumps from pi to -pi. A row of its own
    (number `ALONE`) is then given by its absolute value, which does not jump and costs the same.
    """
    x, y, along, beside = horizontal(data, line, sense)
    h = triple(half, 0)
    squared = x * x + y * y
    value = atan2(y, x)
    if squared > 0.0:
        radial = blend(x / squared, along, y / squared, beside)
        around = blend(x / squared, beside, -y / squared, along)
        back, aside = reach(radial, h), reach(around, h)
        # Neither the station's vertical nor the cut behind the measured direction is in the box.
        if back < 1.0 and abs(value) + atan(aside / (1.0 - back)) < pi:
            low, high = product(radial, around, h)
            low, high = remainder(back, back, aside, (-high, -low))
            write(around, slope)
            return value, low, high
    return _flat_azimuth(value, (x, reach(along, h)), (y, reach(beside, h)), data[ALONE] != 0.0, slope)


@compiled
def _flat_azimuth(
    value: float, ahead: tuple[float, float], aside: tuple[float, float], alone: bool, slope: Array
) -> tuple[float, float, float]:
    """Enclose an azimuth by two numbers; each component is a centre and a half-width."""
    slope[0] = slope[1] = slope[2] = 0.0
    right, up, down = ahead[0] + ahead[1], aside[0] + aside[1], aside[0] - aside[1]
    if alone and ahead[0] - ahead[1] <= 0.0 and down <= 0.0 <= up:
        # The greatest sidestep at the farthest advance is the least angle off the measured direction.
        least = atan2(max(up, -down), right) if right < 0.0 else 0.0
        return abs(value), least - abs(value), pi - abs(value)
    low, high = arguments(ahead[0] - ahead[1], right, down, up)
    return value, low - value, high - value


@compiled
def curve_azimuth(data: Array, line: Array, sense: Array, half: Array, curvature: Array, turn: Array) -> float:
    """Bound how an azimuth curves over a box (see `optloc.proof.nodes.node`).

    With gamma = radial + i around, the gradient is ``Im(gamma/(1+w))`` and the Hessian ``-Im(gamma gamma'/(1+w)^2)``.
    """
    x, y, along, beside = horizontal(data, line, sense)
    h = triple(half, 0)
    squared = x * x + y * y
    if squared == 0.0:
        return unbounded(curvature, turn)
    radial, around = blend(x / squared, along, y / squared, beside), blend(x / squared, beside, -y / squared, along)
    for k in range(3):
        for m in range(3):
            curvature[k, m] = -(radial[k] * around[m] + around[k] * radial[m])
    back, aside = reach(radial, h), reach(around, h)
    if not (back < 1.0 and abs(atan2(y, x)) + atan(aside / (1.0 - back)) < pi):
        turn[0] = turn[1] = turn[2] = inf
        return inf
    front = 1.0 - back
    size = sqrt(back * back + aside * aside)
    # How far the factors of gradient and Hessian can be from 1, for complex w of at most this size.
    real, imaginary = size / front, aside / (front * front)  # of 1/(1+w) - 1
    real2, imaginary2 = size * size / front, imaginary * size * (2.0 + size)  # of w^2/(1+w)
    for k in range(3):
        whole = abs(around[k]) * real + abs(radial[k]) * imaginary
        second = abs(around[k]) * real2 + abs(radial[k]) * imaginary2
        turn[k] = min(whole, row_reach(curvature, k, h) + second)
    one, other = length(radial), length(around)
    mixed = abs(inner(radial, around)) + one * other
    return max(one, other) ** 2 * 2.0 * imaginary / front + mixed * real * (2.0 + real)


@compiled
def sight(data: Array, x: Array) -> Triple:
    """Return the line from a station to a fix in the station's axes."""
    line = (x[0] - data[0], x[1] - data[1], x[2] - data[2])
    return inner(triple(data, AXES), line), inner(triple(data, AXES + 3), line), inner(triple(data, AXES + 6), line)


@compiled
def _ray(kinds: Array, data: Array, swing: Array, j: int, x: Array, row: Array) -> tuple[float, float]:
    """Write the horizontal unit vector n across the sight: ``|n.(x' - x)| <= r sin(swing)`` at distance r."""
    p, q, r = sight(data[j], x)
    flat = hypot(p, q)
    if not flat > 0.0:
        return -1.0, 0.0
    for k in range(3):
        row[k] = (p * data[j, AXES + 3 + k] - q * data[j, AXES + k]) / flat
    return sin(swing[j]), hypot(flat, r)


def _numbers(row: Row) -> Array:
    return lay_out({STATION: row.place(row.a), AXES: row.axes(row.a), MEASURED: row.measured[:, None]})


def _mark(numbers: Array, alone: Array, centred: Array, measured: Array) -> None:
    """Let an azimuth alone be folded: its cost is even, so where it jumps from pi to -pi its absolute value serves."""
    numbers[..., ALONE] = alone & centred


HORIZONTAL_ANGLE = Node(
    "azimuth",
    _WIDTH,
    1,
    _numbers,
    bound_azimuth,
    curve_azimuth,
    infinity=SCALED,
    ray=_ray,
    counts_from_measured=True,
    most=pi,
    mark=_mark,
)
