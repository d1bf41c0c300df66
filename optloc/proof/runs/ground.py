"""A target at a known height over the Earth: its positions at all epochs, and bounds of their derivatives.

The state has four numbers: the position along two axes of a plane, m, and the velocity along these axes, m/s. The
surface determines the rest: the position is on the surface, and the velocity is along it. So the position at an epoch
is a function of the two position numbers q and of w, the velocity times the time. Values are computed like
`optloc.models.course.carry`. Derivatives at a state are finite differences, whose error is bounded by the third
derivatives of this function.
"""

from __future__ import annotations

from math import asin, cos, inf, sin, sqrt
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled
from optloc.models.primitives import WGS84_A, WGS84_F
from optloc.proof.nodes.level import EXACT, LEAST_RADIUS, normal_at
from optloc.proof.nodes.node import Triple, inner_product, sum_of_forms, triple_at, write_triple

# The surface, and states on it.


class Ground(NamedTuple):
    """A surface of constant height, and the axes of states on it.

    Parameters
    ----------
    data : array (HEIGHT_WIDTH,)
        Numbers of the height node, see `optloc.proof.nodes.level`; empty for straight motion.
    axes : array (3, 3)
        Orthonormal axes in the frame, as rows: the two axes of states, and the upward axis.
    level : float
        Height of the state, metres.
    rise : array (K,)
        Heights at the epochs above the height of the state, metres.
    span : float
        Greatest time between an epoch and the state, seconds.
    """

    data: Array
    axes: Array
    level: float
    rise: Array
    span: float


STRAIGHT = Ground(np.zeros(0), np.eye(3), 0.0, np.zeros(0), 0.0)


@compiled
def over_ground(ground: Ground) -> bool:
    """Return whether targets move over the Earth, rather than straight."""
    return bool(ground.data.shape[0] > 0)


# Newton steps onto a surface, and the tolerance: the accuracy of a height.
_STEPS, _CLOSE = 20, EXACT
# As in `optloc.models.course`.
_STILL, _E2 = 1e-14, WGS84_F * (2.0 - WGS84_F)


@compiled
def lift(ground: Ground, first: float, second: float) -> tuple[float, Triple, Triple]:
    """Return the remaining height error, m, the point of the surface above two given coordinates, and its normal.

    `first` and `second` are the coordinates of the point along the two axes of states, m. Point and normal are in the
    frame.
    """
    data, e, f, up = (
        ground.data,
        triple_at(ground.axes[0], 0),
        triple_at(ground.axes[1], 0),
        triple_at(ground.axes[2], 0),
    )
    place = sum_of_forms(first, e, second, f)
    centre = _centre(data)
    # start at about the height of a sphere above the Earth's centre
    aside = (first - inner_product(e, centre)) ** 2 + (second - inner_product(f, centre)) ** 2
    above = inner_product(up, centre) + sqrt(max((WGS84_A + ground.level) ** 2 - aside, 0.0))
    place = sum_of_forms(1.0, place, above, up)
    off, normal = inf, up
    for _ in range(_STEPS):
        height, normal, _, _, _ = normal_at(data, np.array(place))
        off = height - ground.level
        rise = inner_product(normal, up)
        if abs(off) <= _CLOSE or not rise > 0.0:
            break
        place = sum_of_forms(1.0, place, -off / rise, up)
    return off, place, normal


@compiled
def _centre(data: Array) -> Triple:
    """Return the Earth's centre in the frame, metres; `data` are the numbers of the height node."""
    x, y, z = data[3], data[4], data[5]
    first, second, third = triple_at(data, 6), triple_at(data, 9), triple_at(data, 12)
    c = sum_of_forms(1.0, sum_of_forms(x, first, y, second), z, third)
    return data[0] - c[0], data[1] - c[1], data[2] - c[2]


@compiled
def horizontal_vector(ground: Ground, normal: Triple, first: float, second: float) -> Triple:
    """Return the vector along the surface that has two given components along the axes of states.

    `normal` is the normal of the surface at the position.
    """
    up = triple_at(ground.axes[2], 0)
    plan = sum_of_forms(first, triple_at(ground.axes[0], 0), second, triple_at(ground.axes[1], 0))
    return sum_of_forms(1.0, plan, -inner_product(plan, normal) / inner_product(up, normal), up)


@compiled
def place_over_ground(ground: Ground, start: Triple, way: Triple, rise: float) -> Triple:
    """Return the position, in the frame, that a target reaches over ground, like `optloc.models.course.carry`.

    `start` is its position, `way` its velocity times the time, m, and `rise` the reported change of its height, m.
    """
    data = ground.data
    height, up, _, _, sp = normal_at(data, np.array(start))
    climb = inner_product(way, up)
    level = sum_of_forms(1.0, way, -climb, up)
    radius = WGS84_A * sqrt(1.0 - _E2) / (1.0 - _E2 * sp * sp) + height
    squared = inner_product(level, level)
    half = 0.5 * sqrt(squared / (radius * radius) + _STILL)
    share = sin(half) / half
    place = sum_of_forms(1.0, start, share * cos(half), level)
    place = sum_of_forms(1.0, place, -0.5 * share * share * squared / radius, up)
    reached, normal, _, _, _ = normal_at(data, np.array(place))
    return sum_of_forms(1.0, place, height + climb + rise - reached, normal)


# Derivatives at a state.

# Step of the differences, metres. The error is (step^2 / 6) times the third derivative, 1e-9 of a derivative; the
# rounding of positions, 1e-8 m, gives 1e-10.
_STEP = 200.0
# Points of the differences: the state, two along each of the four numbers, and two along each pair of numbers.
_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
FIRST_ORDER, SECOND_ORDER = 9, 21
# Rounding of a position, metres.
_ROUNDED = 4.0 * EXACT


def _moves() -> Array:
    """Return the moves (21, 4) from the state to the points of the differences, in steps."""
    own = np.eye(4)
    pairs = [own[i] + own[j] for i, j in _PAIRS]
    return np.array([np.zeros(4), *(sign * move for move in (*own, *pairs) for sign in (1.0, -1.0))])


_MOVES = _moves()


@compiled
def set_starts(ground: Ground, state: Array, begin: int, end: int, starts: Array) -> None:
    """Write positions and normals of the points `begin` to `end` - 1 of the differences to `starts` (SECOND_ORDER, 6).

    Points that differ in the velocity only have the same position and normal.
    """
    for k in range(begin, end):
        twin = k
        for other in range(k):  # points that differ in the velocity only have one start
            if _MOVES[other, 0] == _MOVES[k, 0] and _MOVES[other, 1] == _MOVES[k, 1]:
                twin = other
        if twin < k:
            starts[k] = starts[twin]
            continue
        _, place, normal = lift(ground, state[0] + _STEP * _MOVES[k, 0], state[1] + _STEP * _MOVES[k, 1])
        for i in range(3):
            starts[k, i], starts[k, 3 + i] = place[i], normal[i]


@compiled
def set_reached(
    ground: Ground, state: Array, time: float, rise: float, starts: Array, begin: int, end: int, reached: Array
) -> None:
    """Write the positions that the points `begin` to `end` - 1 of the differences reach at a time.

    They are written into `reached` (SECOND_ORDER, 3), m. `time` is the time after the state, s, and `rise` the change
    of height.
    """
    for k in range(begin, end):
        first, second = time * state[2] + _STEP * _MOVES[k, 2], time * state[3] + _STEP * _MOVES[k, 3]
        way = horizontal_vector(ground, triple_at(starts[k], 3), first, second)
        write_triple(place_over_ground(ground, triple_at(starts[k], 0), way, rise), reached[k])


@compiled
def slope_of(reached: Array, i: int, a: int) -> float:
    """Return the derivative of coordinate i of a position with respect to number a of (q, w): a central difference."""
    return float((reached[1 + 2 * a, i] - reached[2 + 2 * a, i]) / (2.0 * _STEP))


@compiled
def set_second(reached: Array, i: int, out: Array) -> None:
    """Write the second derivatives (4, 4) of coordinate i of a position with respect to (q, w), by differences, 1/m."""
    share, here = 1.0 / (_STEP * _STEP), reached[0, i]
    for a in range(4):
        out[a, a] = share * (reached[1 + 2 * a, i] - here + (reached[2 + 2 * a, i] - here))
    for p in range(6):
        a, b = _PAIRS[p]
        both = reached[9 + 2 * p, i] - here + (reached[10 + 2 * p, i] - here)
        out[a, b] = out[b, a] = 0.5 * (share * both - out[a, a] - out[b, b])


# Bounds of derivatives over a box.

# Greatest distance from the middle of the plane, and greatest way, as shares of the Earth's least radius; and least
# cosine between the plane's axis and the normals.
_ASIDE, _FAR, _LEAN = 0.85, 0.5, 0.5
# Greatest angle between a normal of the ellipsoid and the line to the Earth's centre, radians: slightly above e^2 / 2.
_DEFLECTION = 0.0034
# Bounds of the derivatives of normals of surfaces of constant height, in radii R. First order: 1 / R. Second: 1.2 /
# R^2 (see `optloc.proof.nodes.level.curve_height`). Third: 4 / R^3; for a sphere it is at most 3 (across the normal),
# and the change with latitude adds about e^2 times this.
_FIRST, _SECOND, _THIRD = 1.0, 1.2, 4.0
# Bounds of the three derivatives of the sphere's radius b / (1 - e^2 y^2), in units of b, with respect to a component
# y of the normal.
_E = _E2 / (1.0 - _E2)
_RADIUS = (2.1 * _E, 2.1 * _E, 25.0 * _E * _E)
# Bounds of the derivatives of sin(w) / w and (1 - cos(w)) / w^2 with respect to w^2; they are largest at zero.
_SINE, _DROP = (1.0 / 6.0, 1.0 / 60.0, 1.0 / 840.0), (1.0 / 24.0, 1.0 / 360.0, 1.0 / 6720.0)

# A bound of a function of one variable with bounds of its first three derivatives; and derivatives of an outer
# function.
Jet = tuple[float, float, float, float]
Derivatives = tuple[float, float, float]


@compiled
def curvature_bounds(ground: Ground, state: Array, half: Array) -> tuple[bool, float, float, float]:
    """Return whether the positions of a box of states are bounded, and bounds of their derivatives by (q, w).

    The bounds are of the first three derivatives: per metre, metre^2 and metre^3. All functions are bounded along
    lines of (q, w), in metres. A bound of the k-th derivative along each line bounds the derivative of the function.
    Let u be the normal at the start p. Then ``u.p' = 0`` and ``u.w = 0`` determine p and w, and the sphere is
    ``Y = p + S w - D u``. The position is ``F = Y + G n``, with n the normal at Y and G the remaining height. In
    ``Y'' + G'' n`` and ``Y''' + G''' n`` the second term cancels the part of the first along n.

    Parameters
    ----------
    ground : Ground
        The surface.
    state, half : array (4,)
        Middle and half-widths of the states.
    """
    centre, way2, plan2, high = _centre(ground.data), 0.0, 0.0, 0.0
    for k in range(2):
        # including the points of differences next to the box
        aside = abs(state[k] - inner_product(triple_at(ground.axes[k], 0), centre)) + half[k] + 2.0 * _STEP
        way = ground.span * (abs(state[2 + k]) + half[2 + k]) + 2.0 * _STEP
        plan2, way2 = plan2 + aside * aside, way2 + way * way
    for rise in ground.rise:
        high = max(high, abs(rise))
    radius, plan, way = LEAST_RADIUS + ground.level - high, sqrt(plan2), sqrt(way2)
    if not (radius > _ASIDE * LEAST_RADIUS and plan < _ASIDE * radius and way < _FAR * radius):
        return False, inf, inf, inf
    lean = asin(plan / radius) + _DEFLECTION
    if not cos(lean) > _LEAN:
        return False, inf, inf, inf
    # greatest depth of the sphere below the level of its start
    radius -= 1.1 * (way / cos(lean)) ** 2 / radius
    turns = (_FIRST / radius, _SECOND / radius**2, _THIRD / radius**3)
    place, normal, along = _begun(turns, lean, way)
    b1, b2, b3 = _ended(turns, ground.level, high, place, normal, along)
    return True, b1, b2, b3


@compiled
def errors_of(third: float) -> tuple[float, float]:
    """Return bounds of the errors of slopes and second derivatives, as norms over (q, w), from the third derivatives.

    With h the step, m, and b3 the bound of the third derivatives (`third`, 1/m^2), the error of a first difference is
    ``b3 h^2 / 6``. The error of a second difference is ``b3 h / 3`` along one number, and ``(2 2^1.5 + 4) b3 h / 12``
    along two. Four orthogonal numbers double the first error, and quadruple the others.
    """
    first = 2.0 * (third * _STEP * _STEP / 6.0 + _ROUNDED / _STEP)
    return first, 4.0 * (0.6 * third * _STEP + 4.0 * _ROUNDED / (_STEP * _STEP))


@compiled
def _begun(turns: Derivatives, lean: float, way: float) -> tuple[Jet, Jet, Jet]:
    """Return bounds of the position on the surface (without a bound of its value), the normal there, and the way.

    `turns` bounds the derivatives of normals, `lean` is the greatest angle between a normal and the upward axis,
    radians, and `way` the greatest distance along the two axes, m. A `Jet` contains a bound of a value and of three
    derivatives.
    """
    n1, n2, _ = turns
    c, s = cos(lean), sin(lean)
    p1 = 1.0 / c
    p2 = n1 * p1 * p1 / c
    place = (inf, p1, p2, (3.0 * n1 * p1 * p2 + n2 * p1**3) / c)
    normal = _composed(1.0, turns, place)
    u1, u2, u3 = normal[1], normal[2], normal[3]
    # the upward part of the way: the product of its plan with the normal, divided by the upward part of the normal
    across = _inverse((1.0, u1, u2, u3), c)
    upward = _product((way * s, s + way * u1, 2.0 * u1 + way * u2, 3.0 * u2 + way * u3), across)
    return place, normal, (way / c, 1.0 + upward[1], upward[2], upward[3])


@compiled
def _ended(
    turns: Derivatives, level: float, high: float, place: Jet, normal: Jet, along: Jet
) -> tuple[float, float, float]:
    """Return bounds of the first three derivatives of the position at the end of a way.

    `level` is the height of the state and `high` the greatest change of height, m. `place`, `normal` and `along` are
    the results of `_begun`.
    """
    n1, n2, _ = turns
    flat = WGS84_A * sqrt(1.0 - _E2)
    outer = (_RADIUS[0] * flat, _RADIUS[1] * flat, _RADIUS[2] * flat)
    over = _inverse(_composed(flat / (1.0 - _E2) + abs(level), outer, normal), flat + level)
    squared = _product(along, along)
    angle = _product(squared, _product(over, over))
    fallen = _product(_product(_composed(0.5, _DROP, angle), squared), over)
    ahead, below = _product(_composed(1.0, _SINE, angle), along), _product(fallen, normal)
    y1, y2, y3 = place[1] + ahead[1] + below[1], place[2] + ahead[2] + below[2], place[3] + ahead[3] + below[3]
    turned = _composed(1.0, turns, (inf, y1, y2, y3))
    # The remaining height, and its change. The normal at the end is nearly the normal at the start, and p' and w' are
    # orthogonal to the normal at the start.
    off = along[0] + fallen[0]
    g0 = fallen[0] + 0.5 * n1 * off * off + high
    g1 = n1 * off * (place[1] + ahead[1]) + normal[1] * along[0] + below[1]
    g2, bent = n1 * y1 * y1 + y2, 3.0 * n1 * y1 * y2 + n2 * y1**3
    return (
        y1 + g0 * turned[1],
        sqrt(y2**2 + (n1 * y1 * y1) ** 2) + 2.0 * g1 * turned[1] + g0 * turned[2],
        sqrt(y3**2 + bent**2) + 3.0 * (g2 * turned[1] + g1 * turned[2]) + g0 * turned[3],
    )


@compiled
def _product(f: Jet, g: Jet) -> Jet:
    """Return bounds of a product of two functions, from bounds of the functions and of their derivatives."""
    return (
        f[0] * g[0],
        f[1] * g[0] + f[0] * g[1],
        f[2] * g[0] + 2.0 * f[1] * g[1] + f[0] * g[2],
        f[3] * g[0] + 3.0 * (f[2] * g[1] + f[1] * g[2]) + f[0] * g[3],
    )


@compiled
def _composed(most: float, outer: Derivatives, own: Jet) -> Jet:
    """Return bounds of a composed function, from its greatest value and the outer function's derivatives.

    `most` is the greatest value, `outer` bounds the derivatives of the outer function, and `own` the inner function.
    """
    a, b, c = own[1], own[2], own[3]
    bent = outer[2] * a**3 + 3.0 * outer[1] * a * b
    return most, outer[0] * a, outer[1] * a * a + outer[0] * b, bent + outer[0] * c


@compiled
def _inverse(f: Jet, least: float) -> Jet:
    """Return bounds of 1/f, where f is at least `least`, a positive number."""
    return _composed(1.0 / least, (1.0 / least**2, 2.0 / least**3, 6.0 / least**4), f)


# From states in space to states on the surface, and back.


# Cosine between the frame's third axis and the normal above which the frame's third axis is the upward axis of states.
_UPRIGHT = 0.9


def axes_at(data: Array, place: Array) -> Array:
    """Return the axes (3, 3) of states around a position (3,), as rows: the frame's if its third is upward, else ENU.

    ENU is east, north, up. `data` are the numbers of the height node.
    """
    _, up, east, north, _ = normal_at(data, np.ascontiguousarray(place))
    return np.eye(3) if up[2] > _UPRIGHT else np.array([east, north, up])


def state_on(ground: Ground, state: Array) -> Array:
    """Return the four numbers (..., 4) of states (..., 6) on the surface.

    They are position (m) and velocity (m/s) along the two axes of states.
    """
    plan = ground.axes[:2]
    return np.concatenate([state[..., :3] @ plan.T, state[..., 3:] @ plan.T], axis=-1)


def corners_on(ground: Ground, corners: Array) -> Array:
    """Return the least box (2, 4) of states on the surface that contains all states of a box (2, 6)."""
    plan, out = ground.axes[:2], np.zeros((2, 4))
    for k in range(4):
        for axis in np.flatnonzero(plan[k % 2]):  # components without influence on an axis may be unlimited
            out[:, k] += np.sort(plan[k % 2, axis] * corners[:, 3 * (k // 2) + axis])
    return out


def state_off(ground: Ground, state: Array) -> Array:
    """Return position and velocity (6,), m and m/s, of a state (4,) on the surface."""
    _, place, normal = lift(ground, state[0], state[1])
    return np.array([*place, *horizontal_vector(ground, normal, state[2], state[3])])
