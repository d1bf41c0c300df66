"""Quantities of a target that a constraint can bound, written once and elementwise like the measurement kinds.

To add a quantity, add an entry to the table, or declare an entry point of the group ``optloc.constraints`` in another
package.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base.linalg import spread_directions
from optloc.base.registry import Registry
from optloc.base.types import Array
from optloc.models.primitives import Components, Point, clip, dot, geodetic_height, geodetic_normal, norm, subtract


@dataclass(frozen=True, slots=True)
class Surface:
    """A quantity that a constraint can bound.

    Parameters
    ----------
    g : callable of (t, c)
        The quantity of target `t` with coefficients `c`, SI units. The table of a band follows its coefficients.
    summary : str
        One line for listings.
    unit : str
        SI unit of g.
    coefficients : int or tuple of int
        Number of coefficients, or the numbers that are possible. A negative number counts multiples of the dimension of
        the problem: -1 for one position.
    velocity, acceleration, ecef, other, table : bool
        Whether the target needs a velocity, an acceleration or ECEF coordinates, and whether the band needs a second
        target or a table.
    upright : bool
        Whether the third axis must point upwards, so that ECEF coordinates do not fit.
    ends : bool
        Whether the quantity is convex in time along a course. Then its upper bound at both ends of a run is enough.
    along : bool
        Whether the quantity is an extreme over the whole run, so that it needs no epochs.
    convex : "lower", "upper", "both" or ""
        The bounds that leave a convex set of positions.
    around : callable of (c, bound), optional
        Function that returns points (q, k) spread over the surface on which the quantity equals `bound`: the first k
        coordinates of positions, metres. With a second target they are differences of positions. None for a surface
        without bends.
    """

    g: Callable[[Point, Components], Any]
    summary: str
    unit: str
    coefficients: int | tuple[int, ...] = 0
    velocity: bool = False
    acceleration: bool = False
    ecef: bool = False
    other: bool = False
    table: bool = False
    upright: bool = False
    ends: bool = False
    along: bool = False
    convex: str = ""
    around: Callable[[Components, float], Array] | None = None

    def counts(self, dimension: int) -> tuple[int, ...]:
        """Return the possible numbers of coefficients in problems of this dimension, ascending."""
        listed = self.coefficients if isinstance(self.coefficients, tuple) else (self.coefficients,)
        return tuple(sorted({n if n >= 0 else -n * dimension for n in listed}))

    @property
    def places(self) -> bool:
        """Return whether the quantity depends on positions alone, so that it takes away freedom of the position."""
        return not (self.velocity or self.acceleration)


def _height(t: Point, c: Components) -> Any:
    """Return the height of the target above the WGS 84 ellipsoid, metres."""
    assert t.ecef is not None
    return geodetic_height(t.ecef)


def _visible(t: Point, c: Components) -> Any:
    """Return the sine of the elevation of a point `c`, ECEF in metres, above the horizon of the target."""
    assert t.ecef is not None
    line = subtract(c, t.ecef)
    # The sine instead of the angle, because it is smooth and increases with the angle from nadir to zenith.
    return dot(line, geodetic_normal(t.ecef)) / norm(line)


def _speed(t: Point, c: Components) -> Any:
    """Return the speed of the target, metres per second."""
    assert t.velocity is not None
    return norm(t.velocity)


def _slowest(start: Components, rate: Components, t: Point) -> Components:
    """Return ``start + s rate`` at the time s of the run at which it is shortest.

    Its square is a convex quadratic function of s, so that the time is the free minimum, limited to the run.
    """
    assert t.span is not None
    # a rate of exactly zero has no free minimum; the shift is far below the square of any real rate
    since = clip(-1.0 * dot(start, rate) / (dot(rate, rate) + _TINY), t.span[0], t.span[1])
    return tuple(p + since * q for p, q in zip(start, rate, strict=True))


# Added to the square of a rate before a division, in its SI unit squared.
_TINY = 1e-60


def _least_speed(t: Point, c: Components) -> Any:
    """Return the least speed of the target within its run, metres per second."""
    assert t.velocity is not None
    return norm(t.velocity if t.acceleration is None else _slowest(t.velocity, t.acceleration, t))


def _acceleration(t: Point, c: Components) -> Any:
    """Return the absolute acceleration of the target, metres per second squared."""
    assert t.acceleration is not None
    return norm(t.acceleration)


def _turn_rate(t: Point, c: Components) -> Any:
    """Return the turn rate in the plan with the greatest absolute value within the run, radians per second.

    The rate is ``(v x a) / |v|^2``. With a constant acceleration the numerator is constant, so that the greatest value
    is at the least speed.
    """
    assert t.velocity is not None
    assert t.acceleration is not None
    v, a = t.velocity[:2], t.acceleration[:2]
    slowest = _slowest(v, a, t)
    return (v[0] * a[1] - v[1] * a[0]) / dot(slowest, slowest)


def _distance(t: Point, c: Components) -> Any:
    """Return the distance of the target from a point `c`, metres; in the plan if `c` has two coordinates."""
    return norm(subtract(t.position[: len(c)], c))


def _segment(t: Point, c: Components) -> Any:
    """Return the distance of the target from the segment between two points, metres; `c` are their coordinates."""
    half = len(c) // 2
    a, b = c[:half], c[half:]
    along, to = subtract(b, a), subtract(t.position[:half], a)
    share = clip(dot(to, along) / dot(along, along), 0.0, 1.0)
    return norm(tuple(p - share * q for p, q in zip(to, along, strict=True)))


def _terrain(t: Point, c: Components) -> Any:
    """Return the height of the target above the ground of a `Terrain`, metres."""
    x, y, z = t.position
    return z - c[-1].of(x, y)


def _separation(t: Point, c: Components) -> Any:
    """Return the distance between two targets, metres."""
    assert t.other is not None
    return norm(subtract(t.position, t.other.position))


def _least_separation(t: Point, c: Components) -> Any:
    """Return the least distance between two targets within the run, metres."""
    assert t.other is not None
    line = subtract(t.position, t.other.position)
    rates = [one.velocity for one in (t, t.other)]
    if rates[0] is None and rates[1] is None:
        return norm(line)
    mine, theirs = (one if one is not None else (0.0,) * len(line) for one in rates)
    return norm(_slowest(line, subtract(mine, theirs), t))


# Points around a curved surface, by dimension: from these a refinement reaches every minimum along it. Three starts
# missed 2 of 150 minima around discs; a minimum of the cost on a circle is seldom narrower than a twelfth of it.
_AROUND = {2: 12, 3: 26}
# Directions across a segment in space, and most places along a segment.
_ACROSS, _PARTS = 6, 6


def _around_point(c: Components, bound: float) -> Array:
    """Return points (q, k) at the distance `bound` around the point `c` with k coordinates, metres."""
    return np.array(c) + bound * spread_directions(_AROUND[len(c)], len(c))


def _around_origin(c: Components, bound: float) -> Array:
    """Return vectors (q, 2) of the length `bound` in all directions of the plan, metres."""
    return bound * spread_directions(_AROUND[2], 2)


def _around_segment(c: Components, bound: float) -> Array:
    """Return points (q, k) at the distance `bound` around the segment `c`, metres: around its ends and along it."""
    half = len(c) // 2
    a, b = np.array(c[:half]), np.array(c[half:])
    length = np.sqrt(((b - a) ** 2).sum())
    along = (b - a) / length
    # unit vectors across the segment: the last rows of a full basis that begins with its direction
    basis = np.linalg.svd(along[None])[2][1:]
    across = basis.T @ ([[1.0, -1.0]] if half == 2 else spread_directions(_ACROSS, 2).T)
    # places along it about two widths apart
    parts = int(np.clip(np.ceil(length / (2.0 * bound)), 2, _PARTS)) if bound > 0.0 else _PARTS
    sides = [a + (b - a) * k / parts + bound * across.T for k in range(1, parts)]
    ways = spread_directions(_AROUND[half], half)
    ends = [end + bound * ways[sign * (ways @ along) > 0.0] for end, sign in ((a, -1.0), (b, 1.0))]
    return np.concatenate([*ends, *sides])


def _around_terrain(c: Components, bound: float) -> Array:
    """Return points (q, 3) at the height `bound` above the points of a grid of the ground, metres."""
    ground = c[-1]
    steps = [max(1, int(np.ceil(len(axis) / _NODES))) for axis in (ground.x, ground.y)]
    x, y = ground.x[:: steps[0]], ground.y[:: steps[1]]
    height = ground.height[:: steps[0], :: steps[1]] + bound
    return np.stack([*np.meshgrid(x, y, indexing="ij"), height], axis=-1).reshape(-1, 3)


# Most points of a grid along each axis at which the cost is evaluated: valleys are wider than a 40th of the grid.
_NODES = 40

# Each quantity is smooth at usual positions of targets, so its gradient can keep an estimate on the constraint.
_OWN: dict[str, Surface] = {
    "plane": Surface(lambda t, c: dot(c, t.position), "linear form c . x of the position", "m", -1, convex="both"),
    "height": Surface(_height, "height above the WGS 84 ellipsoid", "m", ecef=True),
    "visible": Surface(
        _visible, "sine of the elevation of a point c (ECEF) above the target's horizon", "1", 3, ecef=True
    ),
    "speed": Surface(_speed, "speed of the target", "m/s", velocity=True, ends=True),
    "least speed": Surface(_least_speed, "least speed of the target within the run", "m/s", velocity=True, along=True),
    "acceleration": Surface(_acceleration, "absolute acceleration of the target", "m/s^2", acceleration=True),
    "turn_rate": Surface(
        _turn_rate,
        "greatest turn rate of the target within the run, anticlockwise in the plan",
        "rad/s",
        velocity=True,
        acceleration=True,
        along=True,
    ),
    "distance": Surface(
        _distance,
        "distance from a point c; in the plan if c has two coordinates",
        "m",
        (2, -1),
        convex="upper",
        around=_around_point,
    ),
    "segment": Surface(
        _segment,
        "distance from the segment between two points c; in the plan if they have two coordinates",
        "m",
        (4, -2),
        convex="upper",
        around=_around_segment,
    ),
    "terrain": Surface(
        _terrain, "height above the ground of a grid", "m", table=True, upright=True, around=_around_terrain
    ),
    "separation": Surface(
        _separation, "distance between two targets", "m", other=True, ends=True, around=_around_origin
    ),
    "least separation": Surface(
        _least_separation,
        "least distance between two targets within the run",
        "m",
        other=True,
        along=True,
        around=_around_origin,
    ),
}


SURFACES: Registry[Surface] = Registry("optloc.constraints", lambda value: isinstance(value, Surface), _OWN)
"""Quantities by name: the quantities of optloc and of installed packages."""
