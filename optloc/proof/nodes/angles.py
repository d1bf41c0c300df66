"""Azimuths and elevations over a box: value, slope, remainder and curvature, and enclosures from several stations.

X, Y and Z are the components of the line of sight, from the station to a point, along the axes of the station. The
horizontal part is the complex number z = X + iY, with the value z_c at the centre of the box. With ``z = z_c (1 + w)``
and ``w = r + i t``, the azimuth changes by ``atan(t/(1+r))``, whose linear part is t. So r and t are the relative
changes along and across the line of sight. For an elevation the complex number is rho + iZ, with rho the horizontal
distance. Its argument changes in the same way, and rho is itself a range. The calling conventions of `bound` and
`curve` functions are in `optloc.proof.nodes.node`.
"""

from __future__ import annotations

from math import atan, atan2, cos, hypot, inf, pi, sin, sqrt

from optloc.base.types import Array
from optloc.kernels.jit import compiled
from optloc.proof.nodes.node import (
    AZIMUTH,
    SCALED,
    Node,
    NodeRow,
    Triple,
    hypot_excess,
    inner_product,
    is_zero_slope,
    largest_row_value,
    lay_out,
    length,
    product,
    reach,
    sum_of_forms,
    triple_at,
    turned_form,
    unbounded_curvature,
    write_triple,
)

# Azimuths.

# Numbers: the station, its axes (rows), and the wrapped measured angle to which the node is relative. The last number
# is not 0 if no other node is in the row.
STATION, AXES, MEASURED, ALONE, _WIDTH = 0, 6, 15, 16, 17

# Rounding of an angle as a share of its argument: a few units in the last place.
_ROUNDING = 1e-15


@compiled
def atan_remainder_bound(back: float, ahead: float, aside: float) -> float:
    """Return the greatest ``|atan(t/(1+r)) - t|`` over ``-back <= r <= ahead, |t| <= aside``; back must be below 1.

    This is the greatest remainder of an angle, radians, rounding included. For t > 0 the difference decreases with r.
    At r = -back it is greatest at ``t^2 = back (1 - back)``. At r = ahead it decreases with t.
    """
    best = min(aside, sqrt(back * (1.0 - back)))
    above = atan(best / (1.0 - back)) - best
    below = aside - atan(aside / (1.0 + ahead))
    return max(above, below) + _ROUNDING * aside


@compiled
def atan_remainder(back: float, ahead: float, aside: float, bilinear: tuple[float, float]) -> tuple[float, float]:
    """Return an enclosure of ``atan(t/(1+r)) - t``: the least and the greatest remainder of an angle, radians.

    Parameters
    ----------
    back, ahead, aside : float
        Limits of the relative changes: ``-back <= r <= ahead, |t| <= aside``; back below 1.
    bilinear : pair of float
        An enclosure of the leading term ``-r t``; the rest is at most ``|w|^3 / (3 (1 - |w|))``.
    """
    wide = atan_remainder_bound(back, ahead, aside)
    most = max(back, ahead)
    size = sqrt(most * most + aside * aside)
    if size >= 1.0:  # the series for the third order does not converge
        return -wide, wide
    third = size * size * size / (3.0 * (1.0 - size)) + _ROUNDING * aside
    return max(-wide, bilinear[0] - third), min(wide, bilinear[1] + third)


@compiled
def vector_angles(left: float, right: float, down: float, up: float) -> tuple[float, float]:
    """Return the least and greatest angle of the points of a rectangle, seen from the origin, radians.

    The rectangle is [left, right] along the first axis and [down, up] along the second. If it touches the origin or the
    half-axis at which angles jump from pi to -pi, the results are -pi and pi.
    """
    if left <= 0.0 and down <= 0.0 <= up:
        return -pi, pi
    first, second = atan2(down, left), atan2(down, right)
    third, fourth = atan2(up, left), atan2(up, right)
    return min(first, second, third, fourth), max(first, second, third, fourth)


@compiled
def horizontal_line(data: Array, line: Array, sense: Array) -> tuple[float, float, Triple, Triple]:
    """Return the horizontal line of sight in axes along and across the measured direction.

    The four results are the component along the measured direction, the component across it, and the gradients of both.
    `data` holds the numbers of an azimuth node; for `line` and `sense` see `optloc.proof.nodes.node`.
    """
    c, s = cos(data[MEASURED]), sin(data[MEASURED])
    first, second = triple_at(data, AXES), triple_at(data, AXES + 3)
    ahead, aside = sum_of_forms(c, first, s, second), sum_of_forms(c, second, -s, first)
    away = triple_at(line, 0)
    return inner_product(ahead, away), inner_product(aside, away), turned_form(ahead, sense), turned_form(aside, sense)


@compiled
def bound_azimuth(data: Array, line: Array, sense: Array, half: Array, slope: Array) -> tuple[float, float, float]:
    """Bound an azimuth minus its measured value over a box (see `optloc.proof.nodes.node`), radians.

    If the box touches the half-plane behind the measured direction, the angle jumps from pi to -pi. If no other node
    is in the row (number `ALONE`), the absolute value replaces the angle: it does not jump, and its cost is the same.
    """
    x, y, along, beside = horizontal_line(data, line, sense)
    h = triple_at(half, 0)
    squared = x * x + y * y
    value = atan2(y, x)
    if squared > 0.0:
        radial = sum_of_forms(x / squared, along, y / squared, beside)
        around = sum_of_forms(x / squared, beside, -y / squared, along)
        back, aside = reach(radial, h), reach(around, h)
        # The box contains neither the station's vertical nor the cut behind the measured direction.
        if back < 1.0 and abs(value) + atan(aside / (1.0 - back)) < pi:
            low, high = product(radial, around, h)
            low, high = atan_remainder(back, back, aside, (-high, -low))
            write_triple(around, slope)
            return value, low, high
    return _flat_azimuth(value, (x, reach(along, h)), (y, reach(beside, h)), data[ALONE] != 0.0, slope)


@compiled
def _flat_azimuth(
    value: float, ahead: tuple[float, float], aside: tuple[float, float], alone: bool, slope: Array
) -> tuple[float, float, float]:
    """Return value, least and greatest change of an azimuth that is enclosed by a constant interval, radians.

    `ahead` and `aside` are the components along and across the measured direction, each a pair of centre and
    half-width. If `alone`, the absolute value replaces the angle. The slope (3,) is set to zero.
    """
    slope[0] = slope[1] = slope[2] = 0.0
    right, up, down = ahead[0] + ahead[1], aside[0] + aside[1], aside[0] - aside[1]
    if alone and ahead[0] - ahead[1] <= 0.0 and down <= 0.0 <= up:
        # The greatest sidestep at the farthest advance gives the least angle from the measured direction.
        least = atan2(max(up, -down), right) if right < 0.0 else 0.0
        return abs(value), least - abs(value), pi - abs(value)
    low, high = vector_angles(ahead[0] - ahead[1], right, down, up)
    return value, low - value, high - value


@compiled
def curve_azimuth(data: Array, line: Array, sense: Array, half: Array, curvature: Array, turn: Array) -> float:
    """Bound the second derivatives of an azimuth over a box (see `optloc.proof.nodes.node`).

    The azimuth is the imaginary part of log z. With gamma the gradient of log z at the centre, the gradient of the
    azimuth is ``Im(gamma/(1+w))`` and the Hessian ``-Im(gamma gamma'/(1+w)^2)``.
    """
    x, y, along, beside = horizontal_line(data, line, sense)
    h = triple_at(half, 0)
    squared = x * x + y * y
    if squared == 0.0:
        return unbounded_curvature(curvature, turn)
    radial, around = (
        sum_of_forms(x / squared, along, y / squared, beside),
        sum_of_forms(x / squared, beside, -y / squared, along),
    )
    for k in range(3):
        for m in range(3):
            curvature[k, m] = -(radial[k] * around[m] + around[k] * radial[m])
    back, aside = reach(radial, h), reach(around, h)
    if not (back < 1.0 and abs(atan2(y, x)) + atan(aside / (1.0 - back)) < pi):
        turn[0] = turn[1] = turn[2] = inf
        return inf
    front = 1.0 - back
    size = sqrt(back * back + aside * aside)
    # Greatest differences from 1 of the factors of gradient and Hessian, for complex w of at most this size.
    real, imaginary = size / front, aside / (front * front)  # of 1/(1+w) - 1
    real2, imaginary2 = size * size / front, imaginary * size * (2.0 + size)  # of w^2/(1+w)
    for k in range(3):
        whole = abs(around[k]) * real + abs(radial[k]) * imaginary
        second = abs(around[k]) * real2 + abs(radial[k]) * imaginary2
        turn[k] = min(whole, largest_row_value(curvature, k, h) + second)
    one, other = length(radial), length(around)
    mixed = abs(inner_product(radial, around)) + one * other
    return max(one, other) ** 2 * 2.0 * imaginary / front + mixed * real * (2.0 + real)


@compiled
def line_of_sight(data: Array, x: Array) -> Triple:
    """Return the three components, metres, of the line from a station to the fix x along the axes of the station."""
    line = (x[0] - data[0], x[1] - data[1], x[2] - data[2])
    return (
        inner_product(triple_at(data, AXES), line),
        inner_product(triple_at(data, AXES + 3), line),
        inner_product(triple_at(data, AXES + 6), line),
    )


@compiled
def _ray(kinds: Array, data: Array, swing: Array, j: int, x: Array, row: Array) -> tuple[float, float]:
    """Write the horizontal unit vector n (3,) across the sight into `row`: ``|n.(x' - x)| <= r sin(swing[j])``.

    Here x is the fix, x' another point at distance r, and swing[j] the greatest change of azimuth j, radians. Return
    sin(swing[j]) and the distance of the fix from the station, m. The result is (-1, 0), no bound, if the fix is on the
    vertical of the station.
    """
    p, q, r = line_of_sight(data[j], x)
    flat = hypot(p, q)
    if not flat > 0.0:
        return -1.0, 0.0
    for k in range(3):
        row[k] = (p * data[j, AXES + 3 + k] - q * data[j, AXES + k]) / flat
    return sin(swing[j]), hypot(flat, r)


def _numbers(row: NodeRow) -> Array:
    """Return the numbers (B, n) of the azimuth node of a row."""
    return lay_out({STATION: row.place(row.a), AXES: row.axes(row.a), MEASURED: row.measured[:, None]})


def _mark(numbers: Array, alone: Array) -> None:
    """Mark azimuths that are alone in their rows: at the jump from pi to -pi their absolute value has the same cost."""
    numbers[..., ALONE] = alone


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


# Elevations.

# Numbers as in an azimuth, but the node is not relative to a measured value: column 15 stays zero.
_UPRIGHT_WIDTH = 16


@compiled
def _upright(data: Array, line: Array, sense: Array) -> tuple[float, float, Triple, Triple, Triple]:
    """Return horizontal distance and rise of a line, and gradients along outward, sideways and upward unit vectors.

    "Outward" is the horizontal direction from the station to the point, and "sideways" is the horizontal direction
    across.
    """
    x, y, along, beside = horizontal_line(data, line, sense)
    rho = sqrt(x * x + y * y)
    # On the station's vertical any direction is outward; the bounds there are not used.
    ex, ey = (x / rho, y / rho) if rho > 0.0 else (1.0, 0.0)
    up = triple_at(data, AXES + 6)
    return (
        rho,
        inner_product(up, triple_at(line, 0)),
        sum_of_forms(ex, along, ey, beside),
        sum_of_forms(ex, beside, -ey, along),
        turned_form(up, sense),
    )


@compiled
def bound_elevation(data: Array, line: Array, sense: Array, half: Array, slope: Array) -> tuple[float, float, float]:
    """Bound an elevation over a box (see `optloc.proof.nodes.node`), radians; the station's vertical may be inside."""
    rho, rise, outward, sideways, upward = _upright(data, line, sense)
    h = triple_at(half, 0)
    value = atan2(rise, rho)
    least = rho - reach(outward, h)
    bulge = hypot_excess(least, reach(sideways, h))
    low, high = -inf, inf
    squared = rho * rho + rise * rise
    radial, around = outward, upward
    if squared > 0.0:
        radial = sum_of_forms(rho / squared, outward, rise / squared, upward)
        around = sum_of_forms(rho / squared, upward, -rise / squared, outward)
        back, aside = reach(radial, h), reach(around, h)
        if back < 1.0:
            # rho = (linear part) + q with 0 <= q <= bulge changes r by q rho/r^2 and t by -q rise/r^2.
            ahead, shift = bulge * rho / squared, bulge * rise / squared
            low, high = product(radial, around, h)
            cross = abs(shift) * back + ahead * aside
            bilinear = -high - cross + min(ahead * shift, 0.0), -low + cross + max(ahead * shift, 0.0)
            low, high = atan_remainder(back, back + ahead, aside + abs(shift), bilinear)
            low, high = low - max(shift, 0.0), high - min(shift, 0.0)
    # If the line of sight turns by much, a constant interval is tighter than a slope with its remainder.
    bottom, top = _flat_elevation((rise, reach(upward, h)), max(least, 0.0), rho + reach(outward, h) + bulge)
    if top - bottom < high - low:
        slope[0] = slope[1] = slope[2] = 0.0
        return value, bottom - value, top - value
    write_triple(around, slope)
    return value, low, high


@compiled
def _flat_elevation(rise: tuple[float, float], near: float, far: float) -> tuple[float, float]:
    """Return the least and the greatest elevation, radians, over a box, without a slope.

    `rise` is the vertical component as a pair of centre and half-width; `near` and `far` limit the horizontal distance.
    """
    down, up = rise[0] - rise[1], rise[0] + rise[1]
    return atan2(down, near if down < 0.0 else far), atan2(up, far if up < 0.0 else near)


@compiled
def curve_elevation(data: Array, line: Array, sense: Array, half: Array, curvature: Array, turn: Array) -> float:
    """Bound the second derivatives of an elevation over a box (see `optloc.proof.nodes.node`).

    The unit vectors along the line (a), upwards across it (b) and sideways (c) are mapped to search coordinates and
    divided by the range. The gradient is b, and the Hessian is ``-(a b' + b a') - tan(elevation) c c'``. The bounds
    follow from bounds of the changes of a, b and c over the box.
    """
    bound_elevation(data, line, sense, half, turn)  # for its slope only: `turn` is overwritten below
    if is_zero_slope(turn):
        return unbounded_curvature(curvature, turn)
    rho, rise, outward, sideways, upward = _upright(data, line, sense)
    h = triple_at(half, 0)
    least, swing = rho - reach(outward, h), reach(sideways, h)
    if not least > 0.0:
        return unbounded_curvature(curvature, turn)
    squared = rho * rho + rise * rise
    r, tan = sqrt(squared), rise / rho
    a, b = (
        sum_of_forms(rho / squared, outward, rise / squared, upward),
        sum_of_forms(rho / squared, upward, -rise / squared, outward),
    )
    c = sum_of_forms(1.0 / r, sideways, 0.0, sideways)
    for k in range(3):
        for m in range(3):
            curvature[k, m] = -(a[k] * b[m] + b[k] * a[m]) - tan * c[k] * c[m]
    back, aside, bulge = reach(a, h), reach(b, h), hypot_excess(least, swing) / r
    yaw = swing / least  # tangents of the frame's turns: about the vertical, and up or down
    pitch = (aside + bulge * abs(rise) / r) / (1.0 - back) if back < 1.0 else inf
    if not (yaw < 1.0 and pitch < 1.0 and abs(tan) * pitch < 1.0):
        turn[0] = turn[1] = turn[2] = inf
        return inf
    # Three changes in order: the range changes, then the frame turns up or down, then about the vertical.
    near = 1.0 / (1.0 - back)
    stretch = max(back * near, back + aside + bulge)
    steeper = pitch * (1.0 + tan * tan) / (1.0 - abs(tan) * pitch)
    sweep = sum_of_forms(1.0 / r, outward, 0.0, outward)
    swung = _swung(sweep, c, yaw, (0.0, 0.0, 0.0), near, 0.0)
    da, db = _swung(a, b, pitch, swung, near, stretch), _swung(b, a, pitch, swung, near, stretch)
    dc = _swung(c, sweep, yaw, (0.0, 0.0, 0.0), near, stretch)
    return _frame_turn((a, b, c), (da, db, dc), (abs(tan), steeper), h, curvature, turn)


@compiled
def _swung(u: Triple, v: Triple, tangent: float, more: Triple, near: float, stretch: float) -> Triple:
    """Return bounds of the absolute change, in each component, of a vector u that is divided by the range.

    Over the box u turns towards v and changes further by at most `more`. All triples are components along the search
    coordinates. If the tangent of an angle is at most `tangent`, ``u cos + v sin - u`` is at most ``tangent^2/2 |u| +
    tangent |v|``. With r the range at the centre and r' the range elsewhere in the box, `near` bounds r/r' and
    `stretch` bounds its difference from 1.
    """
    bent = 0.5 * tangent * tangent
    return (
        (bent * abs(u[0]) + tangent * abs(v[0])) * near + more[0] + stretch * abs(u[0]),
        (bent * abs(u[1]) + tangent * abs(v[1])) * near + more[1] + stretch * abs(u[1]),
        (bent * abs(u[2]) + tangent * abs(v[2])) * near + more[2] + stretch * abs(u[2]),
    )


@compiled
def _frame_turn(
    frame: tuple[Triple, Triple, Triple],
    change: tuple[Triple, Triple, Triple],
    steep: tuple[float, float],
    h: Triple,
    curvature: Array,
    turn: Array,
) -> float:
    """Write the change of an elevation's gradient and return the change of its Hessian, from the change of its frame.

    `frame` contains the vectors a, b and c of `curve_elevation`, and `change` bounds of their changes. `steep` is the
    tangent of the elevation and a bound of its change. `h` are the half-widths of the box. `curvature` is the Hessian
    at the centre, and `turn` (3,) is written.
    """
    (a, b, c), (da, db, dc) = frame, change
    tan = steep[0] + steep[1]
    one, other, third = length(da), length(db), length(dc)
    side = length(c)
    across = 2.0 * (one * length(b) + other * length(a) + one * other)
    chi = across + steep[1] * (side + third) ** 2 + steep[0] * third * (2.0 * side + third)
    wide, high, flank = reach(a, h) + reach(da, h), reach(b, h) + reach(db, h), reach(c, h) + reach(dc, h)
    for k in range(3):
        along = (abs(a[k]) + da[k]) * high + (abs(b[k]) + db[k]) * wide
        whole = along + tan * (abs(c[k]) + dc[k]) * flank
        turn[k] = min(whole, largest_row_value(curvature, k, h) + chi * length(h))
    return chi


@compiled
def _upright_ray(kinds: Array, data: Array, swing: Array, j: int, x: Array, row: Array) -> tuple[float, float]:
    """Write the unit vector v across the sight and the horizontal: ``|v.(x' - x)| <= r (sin e + 1 - cos a)``.

    Here r is the distance of the point x' from the station, and e = swing[j] the greatest change of the elevation. The
    greatest change of the azimuth from the same station is a, below a quarter turn. Return the factor of r and the
    distance of the fix x, m; (-1, 0), no bound, without this azimuth.
    """
    turn = _azimuth_beside(kinds, data, swing, j)
    p, q, r = line_of_sight(data[j], x)
    flat = hypot(p, q)
    if not (turn < 0.5 * pi and flat > 0.0):
        return -1.0, 0.0
    whole = hypot(flat, r)
    for k in range(3):
        outward = (p * data[j, AXES + k] + q * data[j, AXES + 3 + k]) / flat
        row[k] = (flat * data[j, AXES + 6 + k] - r * outward) / whole
    return sin(swing[j]) + 1.0 - cos(turn), whole


@compiled
def _azimuth_beside(kinds: Array, data: Array, swing: Array, j: int) -> float:
    """Return the greatest change, radians, of the azimuth from the station of elevation j; pi without this azimuth.

    `swing` (J,) contains the greatest change of each node. Azimuth and elevation must have the same station and axes.
    """
    least = pi
    for m in range(kinds.shape[0]):
        if kinds[m] == AZIMUTH:
            same = True
            for k in range(AXES + 9):
                same = same and data[m, k] == data[j, k]
            if same:
                least = min(least, swing[m])
    return least


def _upright_numbers(row: NodeRow) -> Array:
    """Return the numbers (B, n) of the elevation node of a row."""
    return lay_out({STATION: row.place(row.a), AXES: row.axes(row.a)})


VERTICAL_ANGLE = Node(
    "elevation",
    _UPRIGHT_WIDTH,
    1,
    _upright_numbers,
    bound_elevation,
    curve_elevation,
    infinity=SCALED,
    ray=_upright_ray,
    most=0.5 * pi,
)
