"""Layered media: speed as a function of depth (constant or linear in each layer), and first arrivals of the rays.

Letters: n pairs of points, L layers, k rays that were found. y is a depth and c a speed; y0, y1, c0, c1 are the depths
and the speeds at the top and the bottom of a layer. In functions (n,), metres: `across` is the horizontal distance of a
pair, `high` and `low` are the depths of its upper and lower end, `yt` and `ya` of its target and station.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np

from optloc.base.arrays import Portable, log
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.models.primitives import Components, Jet, Point, differential, subtract

# Number of parts of the turning rays of a layer, in each of which at most one root is searched. Eight parts find the
# same first arrivals as a search that is a hundred times finer. The exception is 1 of 2 000 positions, at the edge of a
# shadow (tests/models/test_layers.py).
_PARTS = 8
# Maximum number of Newton steps. Nearly horizontal rays need most: each step doubles the tangent of their angle.
_STEPS = 60
# Relative change of the ray angle at convergence, and largest accepted relative error of the distance. The error of the
# travel time is of the order of their squares.
_ARRIVED, _MISSED = 1e-13, 1e-7
# Below this value the series of asinh(u) / u is exact up to rounding.
_SMALL = 0.03


@dataclass(frozen=True, slots=True)
class Layers:
    """A medium with a speed of sound or of seismic waves that depends on the depth below a horizontal surface.

    Rays are direct paths, without reflections: they go up or down, or turn once where the speed increases. If there are
    several rays, the measurement is the first arrival. If no direct ray reaches a position, or if it is outside the
    table, the measurement is NaN.

    Parameters
    ----------
    depth : tuple of float
        Metres below the surface, increasing. With "linear" these are the points between which the speed is linear; with
        "constant", the tops of layers of constant speed. The last constant layer has no bottom.
    speed : tuple of float
        Metres per second, one for each depth.
    between : "linear" or "constant"
        Speed profile between the depths.
    surface : float
        Third coordinate of depth zero in the frame of the problem, metres upwards.
    reference : float, optional
        Speed that converts travel times to metres, metres per second: a measurement in metres is travel time times this
        speed. Default: the mean speed of the table, its depth divided by the vertical travel time.

    Raises
    ------
    InvalidProblem
        For depths that do not increase, for speeds that are not positive, or for too few of them.

    References
    ----------
    F. B. Jensen, W. A. Kuperman, M. B. Porter, H. Schmidt, "Computational Ocean Acoustics" (2011), section 3.3;
    K. Aki, P. G. Richards, "Quantitative Seismology" (2002), section 9.3.
    """

    depth: tuple[float, ...]
    speed: tuple[float, ...]
    between: Literal["linear", "constant"] = "linear"
    surface: float = 0.0
    reference: float | None = None

    def __post_init__(self) -> None:
        for name in ("depth", "speed"):
            object.__setattr__(self, name, _numbers(getattr(self, name), name))
        _check(self)
        if self.reference is None:
            object.__setattr__(self, "reference", _mean(self))

    @property
    def unit_speed(self) -> float:
        """Return the speed that converts travel times to metres, metres per second."""
        assert self.reference is not None
        return self.reference

    @property
    def straight(self) -> float:
        """Return the metres of a straight path per metre of a measurement, for starts without rays."""
        return _mean(self) / self.unit_speed

    @property
    def words(self) -> str:
        """Return a short description of the table."""
        shape = "straight lines between" if self.between == "linear" else "layers from"
        speeds = f"{min(self.speed):.6g} to {max(self.speed):.6g} m/s"
        return f"{speeds}, {shape} {len(self.depth)} depths; times are metres at {self.unit_speed:.6g} m/s"

    @property
    def reach(self) -> tuple[float, float]:
        """Return the lowest and the highest third coordinate for which the table gives a speed, metres."""
        bottom = np.inf if self.between == "constant" else self.depth[-1]
        return self.surface - bottom, self.surface - self.depth[0]

    def path(self, t: Point, a: Point) -> Any:
        """Return the travel time of the first arrival, multiplied by `unit_speed`, in metres."""
        ray, c = self._ray(t, a), self.unit_speed
        dx, dy = subtract(t.position[:2], a.position[:2])
        parts: list[tuple[Any, Any]] = [(dx, ray.share * _value(dx)), (dy, ray.share * _value(dy))]
        parts += [(t.position[2], ray.at_t), (a.position[2], ray.at_a)]
        # By Fermat's principle, the derivative of the path at an end is the slowness along the ray, for every change of
        # the ray.
        return differential(c * ray.time, [(end, c * slope) for end, slope in parts])

    def gradients(self, t: Point, a: Point) -> tuple[Components, Components]:
        """Return the gradients of `path` at both points: slowness times `unit_speed`, away from the other point."""
        ray, c = self._ray(t, a), self.unit_speed
        dx, dy = subtract(t.position[:2], a.position[:2])
        x, y, zt, za = _value(dx), _value(dy), t.position[2], a.position[2]
        away = np.where(ray.across > 0.0, ray.across, 1.0)
        # Derivatives of the ray parameter. For a vertical ray it is zero and has no direction.
        grows = [(dx, ray.by_across * x / away), (dy, ray.by_across * y / away), (zt, ray.by_t), (za, ray.by_a)]
        # The quotient of horizontal slowness and horizontal distance is smooth, also for a vertical ray.
        dependences = [(end, slope / away) for end, slope in grows]
        dependences += [(d, -ray.share * v / away**2) for d, v in ((dx, x), (dy, y))]
        share = differential(
            c * ray.share, [(end, np.where(ray.across > 0.0, c * slope, 0.0)) for end, slope in dependences]
        )
        ups = []
        for end, at, bends in ((zt, ray.at_t, ray.bends_t), (za, ray.at_a, ray.bends_a)):
            # at^2 = 1 / c^2 - p^2, so the differential of `at` is (bends d(end) - p dp) / at.
            with np.errstate(all="ignore"):  # a ray horizontal at an end has no derivative of its slope
                dependences_of_slope = [*((other, -ray.p * slope / at) for other, slope in grows), (end, bends / at)]
            ups.append(differential(c * at, [(other, c * slope) for other, slope in dependences_of_slope]))
        return (share * dx, share * dy, ups[0]), (-1.0 * share * dx, -1.0 * share * dy, ups[1])

    def _ray(self, t: Point, a: Point) -> Ray:
        """Return the first arrivals between targets `t` and stations `a`, in the shape of their coordinates."""
        given = [_value(v) for v in (*t.position, *a.position)]
        portable = any(isinstance(v, Portable) for v in given)
        values = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in given))
        x, y, zt, u, v, za = (np.ravel(value) for value in values)
        across = np.sqrt((x - u) ** 2 + (y - v) ** 2)
        ray = first_arrival(self, across, self.surface - zt, self.surface - za, log if portable else np.log)
        kind = Portable if portable else np.ndarray
        return Ray(*(part.reshape(values[0].shape).view(kind) for part in ray))


def _value(component: Any) -> Any:
    """Return the value of a component without its derivatives; raise InvalidProblem for symbols."""
    value = component.value if isinstance(component, Jet) else component
    if not isinstance(value, np.ndarray | float | int | np.number):
        # CasADi symbols and arrays of other libraries end here. No machine code is made for these rows.
        what = "rays through layers need NumPy arrays"
        raise InvalidProblem(what, "medium", "give numpy arrays, and replace the stage 'nlp' by 'lsr'")
    return value


def as_number(given: Any) -> float:
    """Return the value as a float; NaN if it is not a number."""
    try:
        return float(given)
    except (TypeError, ValueError):
        return float("nan")


def _numbers(given: Any, name: str) -> tuple[float, ...]:
    """Return the numbers of a table as a tuple; raise InvalidProblem, with the argument `name`, for other content."""
    try:
        return tuple(float(v) for v in given)
    except (TypeError, ValueError):
        raise InvalidProblem(f"the {name} is not a list of numbers", name, "give one number for each depth") from None


def _check(table: Layers) -> None:
    """Raise InvalidProblem if the depths, the speeds or the other fields of a table are invalid."""
    depth, speed = np.array(table.depth), np.array(table.speed)
    if table.between not in ("linear", "constant"):
        raise InvalidProblem(f"unknown shape {table.between!r} of speeds", "between", "use 'linear' or 'constant'")
    least = 2 if table.between == "linear" else 1
    if len(depth) != len(speed) or len(depth) < least:
        what = f"there are {len(depth)} depths and {len(speed)} speeds"
        raise InvalidProblem(what, "depth", f"give the same number of both, at least {least}")
    bad = np.flatnonzero(~(np.diff(depth, prepend=-np.inf) > 0.0) | ~np.isfinite(depth))
    if len(bad):
        what = f"depth {bad[0] + 1}, {depth[bad[0]]:g} m, is not below depth {bad[0]}"
        raise InvalidProblem(what, "depth", "sort the table downwards, one line for each depth")
    bad = np.flatnonzero(~((speed > 0.0) & np.isfinite(speed)))
    if len(bad):
        what = f"speed {bad[0] + 1} is {speed[bad[0]]:g} m/s"
        raise InvalidProblem(what, "speed", "give positive metres per second")
    for name, value, low in (("surface", table.surface, -np.inf), ("reference", table.reference, 0.0)):
        if value is not None and not low < as_number(value) < np.inf:
            raise InvalidProblem(f"the {name} is {value}", name, "give metres" if name == "surface" else "leave it out")


def _mean(table: Layers) -> float:
    """Return the mean speed, m/s: depth over vertical travel time. A bottomless layer counts as deep as the rest."""
    y0, y1, c0, c1 = _layers(table)
    span = np.where(np.isfinite(y1), y1 - y0, max(y0[-1] - y0[0], 1.0))
    u = np.log(c1 / c0)  # the time through a layer of linear speed is span u / (c1 - c0)
    time = span / c0 * np.where(np.abs(u) > 1e-9, u / np.where(u == 0.0, 1.0, np.expm1(u)), 1.0)
    return float(span.sum() / time.sum())


@lru_cache(maxsize=64)
def _layers(table: Layers) -> tuple[Array, Array, Array, Array]:
    """Return y0, y1, c0, c1, each (L,): the top and the bottom of each layer, metres, and the speeds at both, m/s."""
    depth, speed = np.array(table.depth), np.array(table.speed)
    if table.between == "linear":
        return depth[:-1], depth[1:], speed[:-1], speed[1:]
    return depth, np.append(depth[1:], np.inf), speed, speed


# Rays. The ray parameter p is the horizontal slowness, which is constant along a ray (Snell's law). w is the cosine of
# the angle from the vertical, sqrt(1 - p^2 c^2). A leg is the part of a ray in one layer, of height h, with speeds c1
# and c2.


class Ray(NamedTuple):
    """First arrivals of n pairs of a target t and a station a, as arrays of one shape. Without a ray the time is NaN.

    Parameters
    ----------
    time : array
        Travel time, seconds.
    across : array
        Horizontal distance, metres.
    p : array
        Ray parameter, seconds per metre.
    share : array
        p divided by the horizontal distance, or its limit for a vertical ray.
    at_t, at_a : array
        Derivatives of the time with respect to the third coordinate (upwards) of both ends, seconds per metre.
    by_across, by_t, by_a : array
        Derivatives of p with respect to the horizontal distance and to the third coordinates of both ends.
    bends_t, bends_a : array
        Half of the derivative of 1 / c^2 with respect to the third coordinate at both ends.
    """

    time: Array
    across: Array
    p: Array
    share: Array
    at_t: Array
    at_a: Array
    by_across: Array
    by_t: Array
    by_a: Array
    bends_t: Array
    bends_a: Array


class _Legs(NamedTuple):
    """Rays between n pairs of points through the same layers. The parameter of a ray is its angle at the top speed.

    Parameters
    ----------
    h, c1, c2 : array (L, n)
        Heights of the legs, metres, and speeds at their ends, m/s. A leg is the part of a ray in one layer.
    times : array (L, 1)
        Number of passes through each leg.
    short1, short2 : array (L, n)
        Relative difference of the squared speeds from the squared top speed.
    top : array (n,)
        Greatest speed of the legs, at which the angle is defined.
    turn, slope : array (n,)
        Speed at the start of the turning leg, and its increase per metre. If the n rays do not turn, all are NaN.
    """

    h: Array
    c1: Array
    c2: Array
    times: Array
    short1: Array
    short2: Array
    top: Array
    turn: Array
    slope: Array

    @classmethod
    def of(cls, parts: tuple[Array, Array, Array], times: Array, top: Array, turn: Array, slope: Array) -> _Legs:
        """Return legs from `parts`: their heights (L, n), metres, and the speeds at both ends (L, n)."""
        h, c1, c2 = parts
        short1, short2 = ((top - c) * (top + c) / top**2 for c in (c1, c2))
        return cls(h, c1, c2, times, short1, short2, top, turn, slope)

    def take(self, index: Array) -> _Legs:
        """Return the legs of the selected pairs."""
        return _Legs(*(part if part is self.times else part[..., index] for part in self))

    def cosines(self, sine: Array, cosine: Array) -> tuple[Array, Array]:
        """Return w at both ends of all legs, each (L, n), computed without a difference of nearly equal numbers.

        `sine` and `cosine` (n,) are of the angle from the vertical at the top speed, also in the other methods.
        """
        # By rounding, the top speed can be slightly below a speed that equals it.
        first, second = (np.sqrt(np.maximum(cosine**2 + sine**2 * v, 0.0)) for v in (self.short1, self.short2))
        return first, second

    def turning(self, sine: Array, cosine: Array) -> Array:
        """Return w (n,) at the start of the turning leg."""
        square = cosine**2 + sine**2 * (self.top - self.turn) * (self.top + self.turn) / self.top**2
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))

    def distance(self, sine: Array, cosine: Array) -> Array:
        """Return the horizontal distances (n,), metres, that rays with these angles reach."""
        w1, w2 = self.cosines(sine, cosine)
        p = sine / self.top
        distance = p * _sum(np.where(self.h > 0.0, self.times * (self.c1 + self.c2) * self.h / (w1 + w2), 0.0))
        if np.isnan(self.turn).all():
            return np.asarray(distance)
        return np.asarray(distance + 2.0 * self.turning(sine, cosine) / (p * self.slope))

    def across(self, sine: Array, cosine: Array) -> tuple[Array, Array]:
        """Return the horizontal distances (n,), metres, and their derivatives with respect to p, m^2/s."""
        w1, w2 = self.cosines(sine, cosine)
        p, per_p = sine / self.top, np.where(self.h > 0.0, self.times * (self.c1 + self.c2) * self.h / (w1 + w2), 0.0)
        bends = ((1.0 - self.short1) / w1 + (1.0 - self.short2) / w2) / (w1 + w2)
        derivative = _sum(np.where(self.h > 0.0, per_p * (1.0 + sine**2 * bends), 0.0))
        if np.isnan(self.turn).all():
            return p * _sum(per_p), derivative
        w = self.turning(sine, cosine)
        return p * _sum(per_p) + 2.0 * w / (p * self.slope), derivative - 2.0 / (self.slope * p**2 * w)

    def time(self, sine: Array, cosine: Array, logarithm: _Function) -> Array:
        """Return the travel times (n,), seconds."""
        # Along an arc of a circle the time is 2 / g asinh(g chord / (2 sqrt(c1 c2))). g is the change of speed per
        # metre, and chord the distance between the ends of the leg.
        p = sine / self.top
        w1, w2 = self.cosines(sine, cosine)
        h, mean = np.where(self.h > 0.0, self.h, 1.0), np.sqrt(self.c1 * self.c2)
        chord = h * np.sqrt(1.0 + (p * (self.c1 + self.c2) / (w1 + w2)) ** 2)
        u = np.abs(self.c2 - self.c1) / h * chord / (2.0 * mean)
        time = _sum(np.where(self.h > 0.0, self.times * chord / mean * _asinh_over(u, logarithm), 0.0))
        if np.isnan(self.turn).all():
            return time
        v = self.turning(sine, cosine) / (p * self.turn)
        return np.asarray(time + 2.0 * v * _asinh_over(v, logarithm) / self.slope)


_Function = Callable[[Any], Any]
_Layered = tuple[Array, Array, Array, Array]  # y0, y1, c0, c1, see `_layers`


def _sum(parts: Array) -> Array:
    """Return the sum over the first axis, in order, so that the bits are the same on every processor."""
    total = np.zeros(parts.shape[1:])
    for part in parts:
        total = total + part
    return total


def _asinh_over(u: Array, logarithm: _Function) -> Array:
    """Return asinh(u) / u for u >= 0 (any shape)."""
    v, small = u * u, u < _SMALL
    series = 1.0 - v / 6.0 * (1.0 - v * 9.0 / 20.0 * (1.0 - v * 25.0 / 42.0 * (1.0 - v * 49.0 / 72.0)))
    large = np.where(small, 1.0, u)
    return np.where(small, series, np.asarray(logarithm(large + np.sqrt(1.0 + large * large))) / large)


@dataclass(frozen=True, slots=True)
class _FoundRay:
    """Rays (k,) that connect their points.

    `index` (k,) is the number of the pair. `sine` and `cosine` (k,) are of the angle from the vertical at the depth of
    the top speed. `turns` (k,) is 0 without a turn, 1 for a turn below both ends, and -1 for a turn above both ends.
    """

    index: Array
    legs: _Legs
    sine: Array
    cosine: Array
    turns: Array


@np.errstate(all="ignore")  # rays that do not exist give NaN
def first_arrival(table: Layers, across: Array, yt: Array, ya: Array, logarithm: _Function = np.log) -> Ray:
    """Return the first arrivals between n pairs of points; the time is NaN if no direct ray connects a pair.

    All candidate rays of a pair are computed: a horizontal ray, a ray without a turn, and rays with one turn. The
    fastest is kept.

    Parameters
    ----------
    table : Layers
        Table of speeds.
    across : array (n,)
        Horizontal distances, metres.
    yt, ya : array (n,)
        Depths of both ends, metres.
    logarithm : callable
        Natural logarithm, of NumPy or with reproducible bits.
    """
    layers = _layers(table)
    known = np.isfinite(across)
    for y in (yt, ya):
        known = known & (y >= layers[0][0]) & (y <= layers[1][-1])
    pairs = np.flatnonzero(known)
    distance, high, low = across[pairs], np.minimum(yt, ya)[pairs], np.maximum(yt, ya)[pairs]
    best = np.full((4, len(across)), np.nan)  # rows as for `_keep_earlier`
    best[0] = np.inf  # no ray so far
    _keep_earlier(best, pairs, _horizontal_rays(layers, distance, high, low))
    for rays in (_direct_rays(layers, distance, high, low), _turning_rays(layers, distance, high, low)):
        if rays is None:
            continue
        reached, rate = rays.legs.across(rays.sine, rays.cosine)
        p, wanted = rays.sine / rays.legs.top, distance[rays.index]
        # Correct the time to first order for the error of the distance: its derivative is p.
        time = rays.legs.time(rays.sine, rays.cosine, logarithm) + p * (wanted - reached)
        good = np.abs(wanted - reached) <= _MISSED * wanted
        _keep_earlier(best, pairs[rays.index], np.stack([np.where(good, time, np.nan), p, 1.0 / rate, rays.turns]))
    return _derivatives_at_ends(layers, across, yt, ya, best)


def _keep_earlier(best: Array, index: Array, rays: Array) -> None:
    """Replace columns of `best` (4, n) in place by new `rays` (4, k) that arrive earlier; `index` (k,) are their pairs.

    The rows of both arrays are the travel time (s), the ray parameter p (s/m), the derivative of p with respect to the
    distance, and `turns` as in `_FoundRay`. In `best` the time is infinite for a pair without a ray so far. In `rays`
    the time is NaN if the ray does not exist.
    """
    # Latest first: the last write to a pair is its first arrival. Comparisons with NaN are false, so NaN is left out.
    order = np.argsort(-rays[0], kind="stable")
    order = order[rays[0, order] < best[0, index[order]]]
    best[:, index[order]] = rays[:, order]


def _speed(layers: _Layered, y: Array) -> tuple[Array, Array]:
    """Return the speeds at depths (n,) within the table, m/s, and their increase per metre of depth, 1/s."""
    y0, y1, c0, c1 = layers
    j = np.clip(np.searchsorted(y0, y, side="right") - 1, 0, len(y0) - 1)
    slope = (c1[j] - c0[j]) / (y1[j] - y0[j])
    return np.where(slope == 0.0, c0[j], c0[j] + slope * (y - y0[j])), slope


def _legs_between(layers: _Layered, high: Array, low: Array) -> tuple[Array, Array, Array]:
    """Return the heights, and the speeds at both ends, each (L, n), of the legs between depths `high` < `low` (n,)."""
    y0, y1, c0, c1 = (part[:, None] for part in layers)
    upper, lower, slope = np.clip(high, y0, y1), np.clip(low, y0, y1), (c1 - c0) / (y1 - y0)
    h = np.where(lower > upper, lower - upper, 0.0)
    at_upper, at_lower = (np.where(slope == 0.0, c0, c0 + slope * (y - y0)) for y in (upper, lower))
    return h, at_upper, at_lower


def _fastest(h: Array, c1: Array, c2: Array) -> Array:
    """Return the greatest speed (n,) of the legs with a height above zero; zero without such a leg."""
    return np.asarray(np.where(h > 0.0, np.maximum(c1, c2), 0.0).max(0))


def _horizontal_rays(layers: _Layered, across: Array, high: Array, low: Array) -> Array:
    """Return the rays (4, n), as for `_keep_earlier`, that stay at one depth, in a layer of constant speed."""
    c, slope = _speed(layers, high)
    time = np.where((high == low) & (slope == 0.0), across / c, np.nan)
    return np.stack([time, 1.0 / c, np.zeros_like(c), np.zeros_like(c)])


def _direct_rays(layers: _Layered, across: Array, high: Array, low: Array) -> _FoundRay | None:
    """Return the rays that only go up or only go down; each pair has at most one. None if no pair has one."""
    h, c1, c2 = _legs_between(layers, high, low)
    top = _fastest(h, c1, c2)
    index = np.flatnonzero(top > 0.0)
    if not len(index):
        return None
    nan = np.full(len(top), np.nan)
    legs, distance = _Legs.of((h, c1, c2), np.ones((len(h), 1)), top, nan, nan).take(index), across[index]
    # As a function of the tangent t of the angle at the top speed, the distance is concave. Newton steps from below
    # stay below.
    t = distance * legs.top / legs.across(np.zeros(len(index)), np.ones(len(index)))[1]
    remaining, remaining_legs = np.arange(len(index)), legs
    for _ in range(_STEPS):
        cosine = 1.0 / np.sqrt(1.0 + t[remaining] * t[remaining])
        reached, rate = remaining_legs.across(t[remaining] * cosine, cosine)
        step = (distance[remaining] - reached) * remaining_legs.top / (rate * cosine**3)  # dp/dt = cosine^3 / top
        t[remaining] += np.where(np.isfinite(step), step, 0.0)
        unfinished = np.flatnonzero(np.abs(step) > _ARRIVED * t[remaining])
        if not len(unfinished):
            break
        remaining, remaining_legs = remaining[unfinished], remaining_legs.take(unfinished)
    cosine = 1.0 / np.sqrt(1.0 + t * t)
    return _FoundRay(index, legs, t * cosine, cosine, np.zeros(len(index)))


class _Bracket(NamedTuple):
    """Intervals of the cotangent, each with one turning ray (k,); `rising` is as for `_solve_in_interval`."""

    pair: Array  # numbers of the pairs (k,)
    legs: _Legs
    low: Array  # ends of the interval
    high: Array
    rising: Array
    turns: Array  # as in `_FoundRay`


def _turning_rays(layers: _Layered, across: Array, high: Array, low: Array) -> _FoundRay | None:
    """Return the rays that turn once, below both ends or above both; None if no pair has one."""
    brackets: list[_Bracket] = []
    # A mirrored table converts rays that turn above to rays that turn below.
    mirrored = (-layers[1][::-1], -layers[0][::-1], layers[3][::-1], layers[2][::-1])
    for table_layers, upper, lower, turns in ((layers, high, low, 1.0), (mirrored, -low, -high, -1.0)):
        slope = (table_layers[3] - table_layers[2]) / (table_layers[1] - table_layers[0])
        for j in np.flatnonzero(slope > 0.0):
            brackets += _turning_in(table_layers, int(j), slope[j], (across, upper, lower), turns)
    if not brackets:
        return None
    index, low, high, rising, turn = (
        np.concatenate([getattr(part, name) for part in brackets])
        for name in ("pair", "low", "high", "rising", "turns")
    )
    parts = [part.legs for part in brackets]
    joined = {name: np.concatenate([getattr(one, name) for one in parts], axis=-1) for name in _Legs._fields}
    legs = _Legs(**(joined | {"times": parts[0].times}))
    return _FoundRay(index, legs, *_of_cotangent(_solve_in_interval(legs, across[index], low, high, rising)), turn)


def _turning_in(
    layers: _Layered, j: int, slope: float, pairs: tuple[Array, Array, Array], turns: float
) -> Iterator[_Bracket]:
    """Yield intervals that contain rays which turn in layer j.

    `slope` is the increase of the speed per metre in this layer. `pairs` are the distances, upper depths and lower
    depths (n,). The rays turn below the pairs. `turns` is the number to store in the result.
    """
    across, high, low = pairs
    # Legs between the two ends are passed once. Legs from the lower end to the `start` of the turn are passed twice.
    start = np.maximum(low, layers[0][j])
    h, c1, c2 = _legs_between(layers, high, low)
    heights_below, d1, d2 = _legs_between(layers, low, start)
    speed_at_start, speed_at_end = layers[2][j] + slope * (start - layers[0][j]), layers[3][j]
    top = np.maximum(np.maximum(_fastest(h, c1, c2), _fastest(heights_below, d1, d2)), speed_at_start)
    index = np.flatnonzero((low < layers[1][j]) & (top < speed_at_end) & (across > 0.0))
    if not len(index):
        return
    times = np.repeat([1.0, 2.0], len(h))[:, None]
    both = (np.concatenate([h, heights_below]), np.concatenate([c1, d1]), np.concatenate([c2, d2]))
    legs = _Legs.of(both, times, top, speed_at_start, np.full(len(top), slope)).take(index)
    # In terms of the cotangent of the angle at the top speed, the distance in the turning leg is linear. The ray turns
    # at the bottom of layer j for the greatest cotangent, `most`.
    most, distance = np.sqrt((speed_at_end - legs.top) * (speed_at_end + legs.top)) / legs.top, across[index]
    marks = [most * part / _PARTS for part in range(_PARTS + 1)]
    short = [legs.distance(*_of_cotangent(k)) <= distance for k in marks]  # whether the ray is too short
    for part in range(_PARTS):
        pick = np.flatnonzero(short[part] != short[part + 1])
        bounds = (marks[part][pick], marks[part + 1][pick])
        if len(pick):
            yield _Bracket(index[pick], legs.take(pick), *bounds, short[part][pick], np.full(len(pick), turns))


def _of_cotangent(k: Array) -> tuple[Array, Array]:
    """Return sine and cosine of the angles (n,) with cotangents k (n,)."""
    sine = 1.0 / np.sqrt(1.0 + k * k)
    return sine, k * sine


def _solve_in_interval(legs: _Legs, distance: Array, low: Array, high: Array, rising: Array) -> Array:
    """Return the cotangents (n,) of arriving rays in intervals, by Newton steps, or bisection outside the interval.

    `low` and `high` (n,) are the ends of the intervals; they are changed. `rising` (n,) is whether the ray at the lower
    end reaches at most the wanted `distance` (n,), metres.
    """
    k, remaining = 0.5 * (low + high), np.arange(len(low))
    for _ in range(_STEPS):
        current = k[remaining]
        sine, cosine = _of_cotangent(current)
        reached, rate = legs.across(sine, cosine)
        before = (reached <= distance[remaining]) == rising[remaining]  # the root is at a greater cotangent
        low[remaining], high[remaining] = (
            np.where(before, current, low[remaining]),
            np.where(before, high[remaining], current),
        )
        new = current - (distance[remaining] - reached) * legs.top / (rate * cosine * sine**2)
        new = np.where((new > low[remaining]) & (new < high[remaining]), new, 0.5 * (low[remaining] + high[remaining]))
        k[remaining] = new
        unfinished = np.flatnonzero(np.abs(new - current) > _ARRIVED * current)
        if not len(unfinished):
            break
        remaining, legs = remaining[unfinished], legs.take(unfinished)
    return k


def _derivatives_at_ends(layers: _Layered, across: Array, yt: Array, ya: Array, best: Array) -> Ray:
    """Return the first arrivals `best` (4, n), as for `_keep_earlier`, with their derivatives at both ends."""
    time, p, by_across, turns = best
    time = np.where(np.isfinite(time), time, np.nan)
    parts = []
    for depth, other_depth in ((yt, ya), (ya, yt)):
        c, slope = _speed(layers, depth)
        # The path grows if its end moves away along the ray. Upward motion of the deeper end shortens it.
        sign = np.where(
            turns == 0.0, np.where(depth > other_depth, -1.0, np.where(depth < other_depth, 1.0, 0.0)), turns
        )
        slowness = sign * np.sqrt(np.maximum((1.0 / c - p) * (1.0 / c + p), 0.0))
        change_of_p = np.where((p == 0.0) | (sign == 0.0), 0.0, -p / slowness * by_across)
        parts.append((slowness, change_of_p, slope / c**3))
    share = np.where(across > 0.0, p / np.where(across > 0.0, across, 1.0), by_across)  # limit: dp / d across
    (at_t, by_t, bends_t), (at_a, by_a, bends_a) = parts
    slopes = (p, share, at_t, at_a, by_across, by_t, by_a, bends_t, bends_a)
    # Without a ray only the time is NaN, so that an absent row does not make the derivatives of others NaN.
    return Ray(time, across, *(np.where(np.isfinite(time), slope, 0.0) for slope in slopes))
