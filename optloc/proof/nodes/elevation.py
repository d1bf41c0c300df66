"""Elevations over a box: value, slope, remainder and curvature, and what they enclose beside azimuths.

The line of sight of an elevation is the complex number rho + iZ, with rho the horizontal distance, a range of its own,
whose argument changes as that of an azimuth does (`optloc.proof.nodes.azimuth`).
"""

from __future__ import annotations

from math import atan2, cos, hypot, inf, pi, sin, sqrt

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.proof.nodes.azimuth import AXES, STATION, horizontal, remainder, sight
from optloc.proof.nodes.node import (
    AZIMUTH,
    SCALED,
    Node,
    Row,
    Triple,
    blend,
    excess,
    inner,
    lay_out,
    length,
    product,
    pull,
    reach,
    row_reach,
    still,
    triple,
    unbounded,
    write,
)

# Numbers: as of an azimuth, but that nothing is measured from anywhere: column 15 stays zero.
_WIDTH = 16


@compiled
def _upright(data: Array, line: Array, sense: Array) -> tuple[float, float, Triple, Triple, Triple]:
    """Return horizontal distance and rise of a line, and the pulls of outward, sideways and upward unit vectors."""
    x, y, along, beside = horizontal(data, line, sense)
    rho = sqrt(x * x + y * y)
    # On the station's vertical any direction is outward; what is bounded there is not used.
    ex, ey = (x / rho, y / rho) if rho > 0.0 else (1.0, 0.0)
    up = triple(data, AXES + 6)
    return rho, inner(up, triple(line, 0)), blend(ex, along, ey, beside), blend(ex, beside, -ey, along), pull(up, sense)


@compiled
def bound_elevation(data: Array, line: Array, sense: Array, half: Array, slope: Array) -> tuple[float, float, float]:
    """Bound an elevation over a box (see `optloc.proof.nodes.node`), radians; it may hold the station's vertical."""
    rho, rise, outward, sideways, upward = _upright(data, line, sense)
    h = triple(half, 0)
    value = atan2(rise, rho)
    least = rho - reach(outward, h)
    bulge = excess(least, reach(sideways, h))
    low, high = -inf, inf
    squared = rho * rho + rise * rise
    radial, around = outward, upward
    if squared > 0.0:
        radial = blend(rho / squared, outward, rise / squared, upward)
        around = blend(rho / squared, upward, -rise / squared, outward)
        back, aside = reach(radial, h), reach(around, h)
        if back < 1.0:
            # rho = (linear part) + q, 0 <= q <= bulge, moves r by q rho/r^2 and t by -q rise/r^2.
            ahead, shift = bulge * rho / squared, bulge * rise / squared
            low, high = product(radial, around, h)
            cross = abs(shift) * back + ahead * aside
            bilinear = -high - cross + min(ahead * shift, 0.0), -low + cross + max(ahead * shift, 0.0)
            low, high = remainder(back, back + ahead, aside + abs(shift), bilinear)
            low, high = low - max(shift, 0.0), high - min(shift, 0.0)
    # Where the line of sight turns by much, two numbers say more than a slope and its remainder.
    bottom, top = _flat_elevation((rise, reach(upward, h)), max(least, 0.0), rho + reach(outward, h) + bulge)
    if top - bottom < high - low:
        slope[0] = slope[1] = slope[2] = 0.0
        return value, bottom - value, top - value
    write(around, slope)
    return value, low, high


@compiled
def _flat_elevation(rise: tuple[float, float], near: float, far: float) -> tuple[float, float]:
    """Enclose an elevation by two numbers: rise is a centre and a half-width, near and far horizontal distances."""
    down, up = rise[0] - rise[1], rise[0] + rise[1]
    return atan2(down, near if down < 0.0 else far), atan2(up, far if up < 0.0 else near)


@compiled
def curve_elevation(data: Array, line: Array, sense: Array, half: Array, curvature: Array, turn: Array) -> float:
    """Bound how an elevation curves over a box (see `optloc.proof.nodes.node`).

    In the unit vectors along the line (a), upwards across it (b) and sideways (c), all pulled and divided by the range,
    the gradient is b and the Hessian ``-(a b' + b a') - tan(elevation) c c'``; the frame turns over the box.
    """
    bound_elevation(data, line, sense, half, turn)  # for its slope alone: `turn` is overwritten below
    if still(turn):
        return unbounded(curvature, turn)
    rho, rise, outward, sideways, upward = _upright(data, line, sense)
    h = triple(half, 0)
    least, swing = rho - reach(outward, h), reach(sideways, h)
    if not least > 0.0:
        return unbounded(curvature, turn)
    squared = rho * rho + rise * rise
    r, tan = sqrt(squared), rise / rho
    a, b = (
        blend(rho / squared, outward, rise / squared, upward),
        blend(rho / squared, upward, -rise / squared, outward),
    )
    c = blend(1.0 / r, sideways, 0.0, sideways)
    for k in range(3):
        for m in range(3):
            curvature[k, m] = -(a[k] * b[m] + b[k] * a[m]) - tan * c[k] * c[m]
    back, aside, bulge = reach(a, h), reach(b, h), excess(least, swing) / r
    yaw = swing / least  # tangents of the frame's turns about the vertical, and up or down
    pitch = (aside + bulge * abs(rise) / r) / (1.0 - back) if back < 1.0 else inf
    if not (yaw < 1.0 and pitch < 1.0 and abs(tan) * pitch < 1.0):
        turn[0] = turn[1] = turn[2] = inf
        return inf
    # First the range changes, then the frame turns up or down, then about the vertical.
    near = 1.0 / (1.0 - back)
    stretch = max(back * near, back + aside + bulge)
    steeper = pitch * (1.0 + tan * tan) / (1.0 - abs(tan) * pitch)
    sweep = blend(1.0 / r, outward, 0.0, outward)
    swung = _swung(sweep, c, yaw, (0.0, 0.0, 0.0), near, 0.0)
    da, db = _swung(a, b, pitch, swung, near, stretch), _swung(b, a, pitch, swung, near, stretch)
    dc = _swung(c, sweep, yaw, (0.0, 0.0, 0.0), near, stretch)
    return _frame_turn((a, b, c), (da, db, dc), (abs(tan), steeper), h, curvature, turn)


@compiled
def _swung(u: Triple, v: Triple, tangent: float, more: Triple, near: float, stretch: float) -> Triple:
    """Return bounds of the change of u when it turns towards v and beyond by `more`, and the range changes.

    By an angle whose tangent is at most `tangent`, ``u cos + v sin - u`` is at most ``tangent^2/2 |u| + tangent |v|``.
    `near` and `stretch` bound r/r' and its difference from 1.
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
    """Write the change of an elevation's gradient and return that of its Hessian, from the change of its frame.

    `steep` is the tangent of the elevation and a bound of its change.
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
        turn[k] = min(whole, row_reach(curvature, k, h) + chi * length(h))
    return chi


@compiled
def _ray(kinds: Array, data: Array, swing: Array, j: int, x: Array, row: Array) -> tuple[float, float]:
    """Write the unit vector v across the sight and the horizontal: ``|v.(x' - x)| <= r (sin e + 1 - cos a)``.

    At distance r, with e the swing of the elevation and a that of the azimuth beside it, below a quarter turn.
    """
    turn = _azimuth_beside(kinds, data, swing, j)
    p, q, r = sight(data[j], x)
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
    """Return how far the azimuth may swing that the station of elevation j measures, pi if there is none."""
    least = pi
    for m in range(kinds.shape[0]):
        if kinds[m] == AZIMUTH:
            same = True
            for k in range(AXES + 9):
                same = same and data[m, k] == data[j, k]
            if same:
                least = min(least, swing[m])
    return least


def _numbers(row: Row) -> Array:
    return lay_out({STATION: row.place(row.a), AXES: row.axes(row.a)})


VERTICAL_ANGLE = Node(
    "elevation", _WIDTH, 1, _numbers, bound_elevation, curve_elevation, infinity=SCALED, ray=_ray, most=0.5 * pi
)
