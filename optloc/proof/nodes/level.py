"""Linear forms of the position and geodetic heights, with bounds over a box.

Linear forms (coordinates, planes, priors) are exact. A height is the distance to the ellipsoid, so it curves like the
ranges to the centres of two balls. At each of its points, the ellipsoid contains the tangent ball of its least radius
of curvature b^2/a. It is inside the tangent ball of its greatest radius of curvature a^2/b (Blaschke's rolling
theorem). Above the ellipsoid the height is convex, and its Hessian is between 0 and 1/(b^2/a + height) across the
normal.
"""

from __future__ import annotations

from math import sqrt

from optloc.base.types import Array
from optloc.kernels.jit import compiled
from optloc.models.primitives import WGS84_A, WGS84_F
from optloc.problem.problem import Problem
from optloc.proof.nodes.node import (
    CONVEX,
    FLAT,
    Node,
    NodeRow,
    Triple,
    hypot_excess,
    inner_product,
    largest_row_value,
    lay_out,
    length,
    length_across,
    reach,
    sum_of_forms,
    triple_at,
    turned_form,
    unbounded_curvature,
    write_triple,
)

# Linear forms.

# Numbers of the form n.(x - o): its zero o, and its coefficients n.
ORIGIN, COEFFICIENTS, _NUMBERS = 0, 3, 6


@compiled
def bound_linear(data: Array, line: Array, sense: Array, half: Array, slope: Array) -> tuple[float, float, float]:
    """Bound a linear form over a box (see `optloc.proof.nodes.node`); it has no remainder."""
    n = triple_at(data, COEFFICIENTS)
    write_triple(turned_form(n, sense), slope)
    return inner_product(n, triple_at(line, 0)), 0.0, 0.0


@compiled
def size_linear(data: Array, reach: float) -> float:
    """Return the sum of the sizes of the terms of a linear form, which limits its accuracy, in the unit of the form.

    `reach` is the sum of the sizes of the coordinates, m.
    """
    size = reach + (abs(data[ORIGIN]) + abs(data[ORIGIN + 1]) + abs(data[ORIGIN + 2]))
    return float(size * (abs(data[COEFFICIENTS]) + abs(data[COEFFICIENTS + 1]) + abs(data[COEFFICIENTS + 2])))


def linear_numbers(coefficients: Array, origin: Array | None = None) -> Array:
    """Return the numbers (B, n) of a linear node ``n.(x - o)``: coefficients n (B, d), origin o (B, d), default 0."""
    parts = {COEFFICIENTS: coefficients}
    return lay_out(parts if origin is None else parts | {ORIGIN: origin})


def _numbers_of_row(row: NodeRow) -> Array:
    """Raise an error: no measurement is linear in the position. Priors make linear nodes directly."""
    raise NotImplementedError("a row of measurements does not name a linear form")


LINEAR_FORM = Node("linear", _NUMBERS, 1, _numbers_of_row, bound_linear, shape=FLAT, size=size_linear)

# Geodetic heights.

# Numbers: a point o of the frame, its ECEF position, and the rows of the rotation from frame to ECEF.
POINT, ECEF, ROTATION, HEIGHT_WIDTH = 0, 3, 6, 15

_B = WGS84_A * (1.0 - WGS84_F)
_E2 = WGS84_F * (2.0 - WGS84_F)
LEAST_RADIUS = _B * _B / WGS84_A
# Error of Bowring's latitude and of rounding, metres; see `optloc.models.primitives.geodetic_height`.
EXACT = 1e-8
# Below this height, metres, normals intersect, and Bowring's latitude is not exact.
_DEEP = -2e6


@compiled
def geodetic(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return height, distance from the axis, sine and cosine of the latitude, computed like `optloc.models.primitives`.

    Coordinates are Earth-centred Earth-fixed, metres.
    """
    p = sqrt(x * x + y * y + 1e-12)  # a micrometre off the axis, as in the model: so each point has a meridian
    rise, run = z * WGS84_A, p * _B
    whole = sqrt(rise * rise + run * run)
    su, cu = rise / whole, run / whole
    sp, cp = su, cu
    for _ in range(2):
        rise, run = z + (_E2 / (1.0 - _E2)) * _B * su * su * su, p - _E2 * WGS84_A * cu * cu * cu
        whole = sqrt(rise * rise + run * run)
        sp, cp = rise / whole, run / whole
        rise = (1.0 - WGS84_F) * sp
        whole = sqrt(rise * rise + cp * cp)
        su, cu = rise / whole, cp / whole
    return p * cp + z * sp - WGS84_A * sqrt(1.0 - _E2 * sp * sp), p, sp, cp


@compiled
def _ecef(data: Array, line: Array) -> Triple:
    """Return Earth-centred Earth-fixed coordinates, metres, of the end of a line that begins at point o of the node."""
    along, origin = triple_at(line, 0), triple_at(data, ECEF)
    return (
        inner_product(triple_at(data, ROTATION), along) + origin[0],
        inner_product(triple_at(data, ROTATION + 3), along) + origin[1],
        inner_product(triple_at(data, ROTATION + 6), along) + origin[2],
    )


@compiled
def normal_at(data: Array, line: Array) -> tuple[float, Triple, Triple, Triple, float]:
    """Return height (m), upward, eastward and northward unit vectors in the problem's frame, and sine of the latitude.

    The point is the end of `line`, which begins at point o of the node (see the columns of its numbers, `data`).
    """
    e, f, g = _ecef(data, line)
    height, p, sp, cp = geodetic(e, f, g)
    ce, se = e / p, f / p
    first, second, third = triple_at(data, ROTATION), triple_at(data, ROTATION + 3), triple_at(data, ROTATION + 6)
    outward, east = sum_of_forms(ce, first, se, second), sum_of_forms(-se, first, ce, second)
    return height, sum_of_forms(cp, outward, sp, third), east, sum_of_forms(-sp, outward, cp, third), sp


@compiled
def bound_height(data: Array, line: Array, sense: Array, half: Array, slope: Array) -> tuple[float, float, float]:
    """Bound a geodetic height over a box (see `optloc.proof.nodes.node`), metres.

    Deep in the Earth the model's formula is not an exact height. With x the position from the Earth's centre and a, b
    the semi-axes of the ellipsoid, the height there is between ``-|x| - a`` and ``|x| - b``.
    """
    height, up, _, _, _ = normal_at(data, line)
    h = triple_at(half, 0)
    n = turned_form(up, sense)
    swing, aside = reach(n, h), length_across(sense, n, h)
    way = sqrt(swing * swing + aside * aside)
    if not height - way > _DEEP:
        slope[0] = slope[1] = slope[2] = 0.0
        farthest = length(_ecef(data, line)) + way
        return height, -farthest - WGS84_A - height, farthest - _B - height
    write_triple(n, slope)
    # Bowring's error falls with the height, but the rounding of coordinates grows with it.
    slack = EXACT * max(1.0, height / LEAST_RADIUS)
    return height, -slack, hypot_excess(LEAST_RADIUS + height - swing, aside) + slack


@compiled
def curve_height(data: Array, line: Array, sense: Array, half: Array, curvature: Array, turn: Array) -> float:
    """Bound the second derivatives of a geodetic height h over a box (see `optloc.proof.nodes.node`).

    The Hessian is ``u u'/(N + h) + v v'/(M + h)``: u is east, v is north, and M and N are the radii of curvature of the
    meridian and the prime vertical. With a and b the semi-axes of the ellipsoid and e its eccentricity, the derivative
    of the Hessian is at most 1.2 / (b^2/a + h)^2. The factor 1.2 covers ``3 p q^2`` with ``p^2 + q^2 = 1`` (1.155), for
    the turning normal and the stretching tangents. It also covers ``3/2 e^2 (1 + e^2)`` (0.01), for curvature that
    changes with latitude.
    """
    height, up, east, north, sp = normal_at(data, line)
    h = triple_at(half, 0)
    n = turned_form(up, sense)
    swing, aside = reach(n, h), length_across(sense, n, h)
    way = sqrt(swing * swing + aside * aside)
    if not height - way > _DEEP:
        return unbounded_curvature(curvature, turn)
    flat = 1.0 - _E2 * sp * sp
    prime = WGS84_A / sqrt(flat)
    meridian = prime * (1.0 - _E2) / flat
    u, v = turned_form(east, sense), turned_form(north, sense)
    # The inverse of the least radius of curvature in the box, below its lowest point.
    bend = 1.0 / (LEAST_RADIUS + height - way)
    change = 1.2 * bend * bend * way
    chi = 0.0
    for k in range(3):
        for m in range(3):
            curvature[k, m] = u[k] * u[m] / (prime + height) + v[k] * v[m] / (meridian + height)
    for k in range(3):
        column = length((sense[0, k], sense[1, k], sense[2, k]))
        own = largest_row_value(curvature, k, h)
        turn[k] = own + change * column * way
        chi += column * column * change
    return chi


@compiled
def earth_ball(data: Array, least: float, most: float) -> tuple[float, float, float, float]:
    """Return centre (three numbers) and radius, m, of a ball around the Earth's centre with all heights up to `most`.

    A height is at least the distance from the Earth's centre minus the equatorial radius. The lower end `least` gives
    no ball and is not used.
    """
    origin = triple_at(data, ECEF)
    first, second, third = triple_at(data, ROTATION), triple_at(data, ROTATION + 3), triple_at(data, ROTATION + 6)
    c = sum_of_forms(1.0, sum_of_forms(origin[0], first, origin[1], second), origin[2], third)
    return data[POINT] - c[0], data[POINT + 1] - c[1], data[POINT + 2] - c[2], WGS84_A + most


def height_numbers(problem: Problem) -> Array:
    """Return the numbers (1, n) of the node for the geodetic height of a position in the problem's frame."""
    frame = problem.frame
    return lay_out({ECEF: frame.origin_ecef()[None], ROTATION: frame.rotation_to_ecef().reshape(1, 9)})


def _numbers(row: NodeRow) -> Array:
    """Return the numbers (1, n) of the height node of a row."""
    return height_numbers(row.problem)


GEODETIC_HEIGHT = Node("height", HEIGHT_WIDTH, 1, _numbers, bound_height, curve_height, shape=CONVEX, ball=earth_ball)
