"""Speeds over depth, and the rays through them: constant or straight-line speeds in layers, first arrivals."""

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

# Parts of a layer's turning rays in each of which at most one root is looked for: eight find the first arrivals that a
# search a hundred times finer does, but for 1 of 2 000 places at the edge of a shadow (tests/models/test_layers.py).
_PARTS = 8
# Newton steps, most of them for rays that leave nearly level: the tangent of their angle doubles at each.
_STEPS = 60
# Relative change of a ray's angle at which it has arrived, and relative miss of its distance that is none: the travel
# time is right to the square of both.
_ARRIVED, _MISSED = 1e-13, 1e-7
# Below this the series of asinh(u) / u is exact to rounding.
_SMALL = 0.03


@dataclass(frozen=True, slots=True)
class Layers:
    """Speeds of sound or of seismic waves over depth, below a level surface: a medium.

    Rays are direct paths: they go up or down, or turn once where the speed grows, and nothing reflects them. Of several
    the first arrival is the measurement. A place that no direct ray leads to, or that the table does not reach, has
    none: its measurement is NaN.

    Parameters
    ----------
    depth : tuple of float
        Metres below the surface, growing: of the points between which speeds are straight lines, or of the tops of
        layers of constant speed. The last such layer has no bottom.
    speed : tuple of float
        Metres per second, one for each depth.
    between : "linear" or "constant"
        What holds between the depths.
    surface : float
        Third coordinate of depth zero in the frame of the problem, metres upwards.
    reference : float, optional
        Speed by which travel times became metres, metres per second: a measurement in metres is the travel time times
        it. By default the mean of the table: its depth over the time straight down.

    Raises
    ------
    InvalidProblem
        For depths that do not grow, speeds that are not positive, or too few of either.

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
        """Return the speed by which travel times became metres, metres per second."""
        assert self.reference is not None
        return self.reference

    @property
    def straight(self) -> float:
        """Return metres of a straight path for one metre of a measurement: what starts without a ray take."""
        return _mean(self) / self.unit_speed

    @property
    def words(self) -> str:
        """Return what the table is in a few words."""
        shape = "straight lines between" if self.between == "linear" else "layers from"
        speeds = f"{min(self.speed):.6g} to {max(self.speed):.6g} m/s"
        return f"{speeds}, {shape} {len(self.depth)} depths; times are metres at {self.unit_speed:.6g} m/s"

    @property
    def reach(self) -> tuple[float, float]:
        """Return the lowest and the highest third coordinate that has a speed, metres."""
        bottom = np.inf if self.between == "constant" else self.depth[-1]
        return self.surface - bottom, self.surface - self.depth[0]

    def path(self, t: Point, a: Point) -> Any:
        """Return the travel time of the first arrival times `unit_speed`, metres."""
        ray, c = self._ray(t, a), self.unit_speed
        dx, dy = subtract(t.position[:2], a.position[:2])
        parts: list[tuple[Any, Any]] = [(dx, ray.share * _value(dx)), (dy, ray.share * _value(dy))]
        parts += [(t.position[2], ray.at_t), (a.position[2], ray.at_a)]
        # By Fermat's principle a path grows by the slowness along the ray when an end moves, whatever the ray does.
        return differential(c * ray.time, [(end, c * slope) for end, slope in parts])

    def gradients(self, t: Point, a: Point) -> tuple[Components, Components]:
        """Return the gradients of `path` at both points: slowness vectors times `unit_speed`, which point away."""
        ray, c = self._ray(t, a), self.unit_speed
        dx, dy = subtract(t.position[:2], a.position[:2])
        x, y, zt, za = _value(dx), _value(dy), t.position[2], a.position[2]
        away = np.where(ray.across > 0.0, ray.across, 1.0)
        # How the ray parameter grows with each coordinate; straight overhead it is zero, and has no direction.
        grows = [(dx, ray.by_across * x / away), (dy, ray.by_across * y / away), (zt, ray.by_t), (za, ray.by_a)]
        # Horizontal slowness over horizontal distance is smooth overhead too.
        own = [(end, slope / away) for end, slope in grows]
        own += [(d, -ray.share * v / away**2) for d, v in ((dx, x), (dy, y))]
        share = differential(c * ray.share, [(end, np.where(ray.across > 0.0, c * slope, 0.0)) for end, slope in own])
        ups = []
        for end, at, bends in ((zt, ray.at_t, ray.bends_t), (za, ray.at_a, ray.bends_a)):
            # at^2 = 1 / c^2 - p^2
            with np.errstate(all="ignore"):  # level at an end the ray's slope has no derivative
                pulls = [*((other, -ray.p * slope / at) for other, slope in grows), (end, bends / at)]
            ups.append(differential(c * at, [(other, c * slope) for other, slope in pulls]))
        return (share * dx, share * dy, ups[0]), (-1.0 * share * dx, -1.0 * share * dy, ups[1])

    def _ray(self, t: Point, a: Point) -> Ray:
        given = [_value(v) for v in (*t.position, *a.position)]
        own = any(isinstance(v, Portable) for v in given)
        values = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in given))
        x, y, zt, u, v, za = (np.ravel(value) for value in values)
        across = np.sqrt((x - u) ** 2 + (y - v) ** 2)
        ray = first_arrival(self, across, self.surface - zt, self.surface - za, log if own else np.log)
        kind = Portable if own else np.ndarray
        return Ray(*(part.reshape(values[0].shape).view(kind) for part in ray))


def _value(component: Any) -> Any:
    value = component.value if isinstance(component, Jet) else component
    if not isinstance(value, np.ndarray | float | int | np.number):
        # Symbols of IPOPT, arrays of other libraries; a tape of machine code is then not made.
        what = "rays through layers are traced with numbers of numpy alone"
        raise InvalidProblem(what, "medium", "give numpy arrays, and leave out the stage 'nlp': 'lsr' refines them")
    return value


def as_number(given: Any) -> float:
    """Return a number, NaN for what is none."""
    try:
        return float(given)
    except (TypeError, ValueError):
        return float("nan")


def _numbers(given: Any, name: str) -> tuple[float, ...]:
    try:
        return tuple(float(v) for v in given)
    except (TypeError, ValueError):
        raise InvalidProblem(f"the {name} is no list of numbers", name, "give one number for each depth") from None


def _check(table: Layers) -> None:
    depth, speed = np.array(table.depth), np.array(table.speed)
    if table.between not in ("linear", "constant"):
        raise InvalidProblem(f"unknown shape {table.between!r} of speeds", "between", "use 'linear' or 'constant'")
    least = 2 if table.between == "linear" else 1
    if len(depth) != len(speed) or len(depth) < least:
        what = f"there are {len(depth)} depths and {len(speed)} speeds"
        raise InvalidProblem(what, "depth", f"give as many of both, at least {least}")
    bad = np.flatnonzero(~(np.diff(depth, prepend=-np.inf) > 0.0) | ~np.isfinite(depth))
    if len(bad):
        what = f"depth {bad[0] + 1}, {depth[bad[0]]:g} m, is not below the one before"
        raise InvalidProblem(what, "depth", "sort the table downwards, one line for each depth")
    bad = np.flatnonzero(~((speed > 0.0) & np.isfinite(speed)))
    if len(bad):
        what = f"speed {bad[0] + 1} is {speed[bad[0]]:g} m/s"
        raise InvalidProblem(what, "speed", "give positive metres per second")
    for name, value, low in (("surface", table.surface, -np.inf), ("reference", table.reference, 0.0)):
        if value is not None and not low < as_number(value) < np.inf:
            raise InvalidProblem(f"the {name} is {value}", name, "give metres" if name == "surface" else "leave it out")


def _mean(table: Layers) -> float:
    """Return the depth of the table over the time straight down; a layer without a bottom is as deep as the rest."""
    y0, y1, c0, c1 = _layers(table)
    span = np.where(np.isfinite(y1), y1 - y0, max(y0[-1] - y0[0], 1.0))
    u = np.log(c1 / c0)
    time = span / c0 * np.where(np.abs(u) > 1e-9, u / np.where(u == 0.0, 1.0, np.expm1(u)), 1.0)
    return float(span.sum() / time.sum())


@lru_cache(maxsize=64)
def _layers(table: Layers) -> tuple[Array, Array, Array, Array]:
    """Return top, bottom, and the speeds there, of each layer (L,)."""
    depth, speed = np.array(table.depth), np.array(table.speed)
    if table.between == "linear":
        return depth[:-1], depth[1:], speed[:-1], speed[1:]
    return depth, np.append(depth[1:], np.inf), speed, speed


# Rays: the ray parameter p is the horizontal slowness, which Snell's law keeps; w is the cosine of the angle from
# the vertical, sqrt(1 - p^2 c^2). A leg is a part of a ray within one layer, from speed c1 to speed c2 over a height h.


class Ray(NamedTuple):
    """First arrivals, each an array of one shape; NaN where there is none.

    Parameters
    ----------
    time : array
        Travel time, seconds.
    across : array
        Horizontal distance, metres.
    p : array
        Ray parameter, seconds per metre.
    share : array
        p over the horizontal distance, and its limit overhead.
    at_t, at_a : array
        Derivatives of the time to the third coordinates of both ends, upwards, seconds per metre.
    by_across, by_t, by_a : array
        Derivatives of p to the horizontal distance and to the third coordinates of both ends.
    bends_t, bends_a : array
        Half the derivative of 1 / c^2 to the third coordinate at both ends.
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
    """Rays between n pairs of points that pass the same layers, each known by its angle where it is the most level.

    Parameters
    ----------
    h, c1, c2 : array (L, n)
        Heights of legs, and speeds at their ends.
    times : array (L, 1)
        How often each is passed.
    short1, short2 : array (L, n)
        By what share the squares of those speeds are below that of the top speed.
    top : array (n,)
        Greatest speed of the legs: there the angle is counted.
    turn, slope : array (n,)
        Speed at which the leg that turns begins, and its growth with each metre; NaN where nothing turns.
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
        """Return legs of heights and speeds."""
        h, c1, c2 = parts
        short1, short2 = ((top - c) * (top + c) / top**2 for c in (c1, c2))
        return cls(h, c1, c2, times, short1, short2, top, turn, slope)

    def take(self, index: Array) -> _Legs:
        """Return those of some of the pairs."""
        return _Legs(*(part if part is self.times else part[..., index] for part in self))

    def cosines(self, sine: Array, cosine: Array) -> tuple[Array, Array]:
        """Return w at both ends of all legs, without a difference of numbers that are all but equal."""
        # Rounding may leave the top speed a little below one that equals it.
        first, second = (np.sqrt(np.maximum(cosine**2 + sine**2 * v, 0.0)) for v in (self.short1, self.short2))
        return first, second

    def turning(self, sine: Array, cosine: Array) -> Array:
        """Return w where the leg that turns begins."""
        square = cosine**2 + sine**2 * (self.top - self.turn) * (self.top + self.turn) / self.top**2
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))

    def distance(self, sine: Array, cosine: Array) -> Array:
        """Return horizontal distances (n,)."""
        w1, w2 = self.cosines(sine, cosine)
        p = sine / self.top
        distance = p * _sum(np.where(self.h > 0.0, self.times * (self.c1 + self.c2) * self.h / (w1 + w2), 0.0))
        if np.isnan(self.turn).all():
            return np.asarray(distance)
        return np.asarray(distance + 2.0 * self.turning(sine, cosine) / (p * self.slope))

    def across(self, sine: Array, cosine: Array) -> tuple[Array, Array]:
        """Return horizontal distances (n,) and their derivatives to p."""
        w1, w2 = self.cosines(sine, cosine)
        p, own = sine / self.top, np.where(self.h > 0.0, self.times * (self.c1 + self.c2) * self.h / (w1 + w2), 0.0)
        bends = ((1.0 - self.short1) / w1 + (1.0 - self.short2) / w2) / (w1 + w2)
        derivative = _sum(np.where(self.h > 0.0, own * (1.0 + sine**2 * bends), 0.0))
        if np.isnan(self.turn).all():
            return p * _sum(own), derivative
        w = self.turning(sine, cosine)
        return p * _sum(own) + 2.0 * w / (p * self.slope), derivative - 2.0 / (self.slope * p**2 * w)

    def time(self, sine: Array, cosine: Array, logarithm: _Function) -> Array:
        """Return travel times (n,): along an arc of a circle 2 / g asinh(g chord / (2 sqrt(c1 c2)))."""
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


def _sum(parts: Array) -> Array:
    # One after the other: the same bits on every processor.
    total = np.zeros(parts.shape[1:])
    for part in parts:
        total = total + part
    return total


def _asinh_over(u: Array, logarithm: _Function) -> Array:
    """Return asinh(u) / u of numbers that are not negative."""
    v, small = u * u, u < _SMALL
    series = 1.0 - v / 6.0 * (1.0 - v * 9.0 / 20.0 * (1.0 - v * 25.0 / 42.0 * (1.0 - v * 49.0 / 72.0)))
    large = np.where(small, 1.0, u)
    return np.where(small, series, np.asarray(logarithm(large + np.sqrt(1.0 + large * large))) / large)


@dataclass(frozen=True, slots=True)
class _FoundRay:
    """Rays that arrive, all (k,): of which pair, sine and cosine of the angle at the top speed, and where they turn."""

    index: Array
    legs: _Legs
    sine: Array
    cosine: Array
    # 0: they do not; 1: below both ends; -1: above both
    turns: Array


_Layered = tuple[Array, Array, Array, Array]


@np.errstate(all="ignore")  # rays that do not exist have no numbers
def first_arrival(table: Layers, across: Array, yt: Array, ya: Array, logarithm: _Function = np.log) -> Ray:
    """Return the first arrivals between points.

    Parameters
    ----------
    table : Layers
        The speeds.
    across : array (n,)
        Horizontal distances, metres.
    yt, ya : array (n,)
        Depths of both ends, metres.
    logarithm : callable
        The natural logarithm that is used.
    """
    layers = _layers(table)
    known = np.isfinite(across)
    for y in (yt, ya):
        known = known & (y >= layers[0][0]) & (y <= layers[1][-1])
    which = np.flatnonzero(known)
    distance, high, low = across[which], np.minimum(yt, ya)[which], np.maximum(yt, ya)[which]
    best = np.full((4, len(across)), np.nan)
    best[0] = np.inf
    _offer(best, which, _level(layers, distance, high, low))
    for found in (_direct(layers, distance, high, low), _turning(layers, distance, high, low)):
        if found is None:
            continue
        reached, rate = found.legs.across(found.sine, found.cosine)
        p, own = found.sine / found.legs.top, distance[found.index]
        # What the ray misses costs p of time a metre.
        time = found.legs.time(found.sine, found.cosine, logarithm) + p * (own - reached)
        good = np.abs(own - reached) <= _MISSED * own
        _offer(best, which[found.index], np.stack([np.where(good, time, np.nan), p, 1.0 / rate, found.turns]))
    return _ends(layers, across, yt, ya, best)


def _offer(best: Array, index: Array, found: Array) -> None:
    """Write time, p, dp / dX and turns (4, k) of rays that arrive before those that were found for their pairs."""
    order = np.argsort(-found[0], kind="stable")  # several of one pair: the first arrival is written last
    order = order[found[0, order] < best[0, index[order]]]
    best[:, index[order]] = found[:, order]


def _speed(layers: _Layered, y: Array) -> tuple[Array, Array]:
    """Return speeds at depths (n,) within the table, and their growth with each metre down."""
    y0, y1, c0, c1 = layers
    j = np.clip(np.searchsorted(y0, y, side="right") - 1, 0, len(y0) - 1)
    slope = (c1[j] - c0[j]) / (y1[j] - y0[j])
    return np.where(slope == 0.0, c0[j], c0[j] + slope * (y - y0[j])), slope


def _between(layers: _Layered, high: Array, low: Array) -> tuple[Array, Array, Array]:
    """Return heights and speeds (L, n) of the legs between depths."""
    y0, y1, c0, c1 = (part[:, None] for part in layers)
    upper, lower, slope = np.clip(high, y0, y1), np.clip(low, y0, y1), (c1 - c0) / (y1 - y0)
    h = np.where(lower > upper, lower - upper, 0.0)
    at_upper, at_lower = (np.where(slope == 0.0, c0, c0 + slope * (y - y0)) for y in (upper, lower))
    return h, at_upper, at_lower


def _fastest(h: Array, c1: Array, c2: Array) -> Array:
    return np.asarray(np.where(h > 0.0, np.maximum(c1, c2), 0.0).max(0))


def _level(layers: _Layered, across: Array, high: Array, low: Array) -> Array:
    """Return what `_offer` takes of rays that stay at their depth: both ends in a layer of constant speed."""
    c, slope = _speed(layers, high)
    time = np.where((high == low) & (slope == 0.0), across / c, np.nan)
    return np.stack([time, 1.0 / c, np.zeros_like(c), np.zeros_like(c)])


def _direct(layers: _Layered, across: Array, high: Array, low: Array) -> _FoundRay | None:
    """Return the rays that go up or down all the way: there is one at most."""
    h, c1, c2 = _between(layers, high, low)
    top = _fastest(h, c1, c2)
    index = np.flatnonzero(top > 0.0)
    if not len(index):
        return None
    nan = np.full(len(top), np.nan)
    legs, distance = _Legs.of((h, c1, c2), np.ones((len(h), 1)), top, nan, nan).take(index), across[index]
    # With the tangent t of the angle at the top speed distances are concave: Newton's steps from below stay below.
    t = distance * legs.top / legs.across(np.zeros(len(index)), np.ones(len(index)))[1]
    left, own = np.arange(len(index)), legs
    for _ in range(_STEPS):
        cosine = 1.0 / np.sqrt(1.0 + t[left] * t[left])
        reached, rate = own.across(t[left] * cosine, cosine)
        move = (distance[left] - reached) * own.top / (rate * cosine**3)
        t[left] += np.where(np.isfinite(move), move, 0.0)
        still = np.flatnonzero(np.abs(move) > _ARRIVED * t[left])
        if not len(still):
            break
        left, own = left[still], own.take(still)
    cosine = 1.0 / np.sqrt(1.0 + t * t)
    return _FoundRay(index, legs, t * cosine, cosine, np.zeros(len(index)))


class _Bracket(NamedTuple):
    """Turning rays of which one arrives between two cotangents of their angle: see `_within`, each (k,)."""

    pair: Array
    legs: _Legs
    low: Array
    high: Array
    rising: Array
    turns: Array


def _turning(layers: _Layered, across: Array, high: Array, low: Array) -> _FoundRay | None:
    """Return the rays that turn once, below both ends or above both."""
    found: list[_Bracket] = []
    # What is above in a table is below in its mirror image.
    mirrored = (-layers[1][::-1], -layers[0][::-1], layers[3][::-1], layers[2][::-1])
    for own, upper, lower, turns in ((layers, high, low, 1.0), (mirrored, -low, -high, -1.0)):
        slope = (own[3] - own[2]) / (own[1] - own[0])
        for j in np.flatnonzero(slope > 0.0):
            found += _turning_in(own, int(j), slope[j], (across, upper, lower), turns)
    if not found:
        return None
    index, low, high, rising, turn = (
        np.concatenate([getattr(part, name) for part in found]) for name in ("pair", "low", "high", "rising", "turns")
    )
    parts = [part.legs for part in found]
    each = {name: np.concatenate([getattr(one, name) for one in parts], axis=-1) for name in _Legs._fields}
    legs = _Legs(**(each | {"times": parts[0].times}))
    return _FoundRay(index, legs, *_of_cotangent(_within(legs, across[index], low, high, rising)), turn)


def _turning_in(
    layers: _Layered, j: int, slope: float, pairs: tuple[Array, Array, Array], turns: float
) -> Iterator[_Bracket]:
    """Yield where rays arrive that turn in layer j, below pairs of which distance, upper and lower depth are given."""
    across, high, low = pairs
    begins = np.maximum(low, layers[0][j])
    h, c1, c2 = _between(layers, high, low)
    more, d1, d2 = _between(layers, low, begins)
    turn, leaves = layers[2][j] + slope * (begins - layers[0][j]), layers[3][j]
    top = np.maximum(np.maximum(_fastest(h, c1, c2), _fastest(more, d1, d2)), turn)
    index = np.flatnonzero((low < layers[1][j]) & (top < leaves) & (across > 0.0))
    if not len(index):
        return
    times = np.repeat([1.0, 2.0], len(h))[:, None]
    both = (np.concatenate([h, more]), np.concatenate([c1, d1]), np.concatenate([c2, d2]))
    legs = _Legs.of(both, times, top, turn, np.full(len(top), slope)).take(index)
    # By the cotangent of the angle at the top speed: of the turning leg alone the distance is linear in it.
    most, distance = np.sqrt((leaves - legs.top) * (leaves + legs.top)) / legs.top, across[index]
    marks = [most * part / _PARTS for part in range(_PARTS + 1)]
    short = [legs.distance(*_of_cotangent(k)) <= distance for k in marks]
    for part in range(_PARTS):
        pick = np.flatnonzero(short[part] != short[part + 1])
        bounds = (marks[part][pick], marks[part + 1][pick])
        if len(pick):
            yield _Bracket(index[pick], legs.take(pick), *bounds, short[part][pick], np.full(len(pick), turns))


def _of_cotangent(k: Array) -> tuple[Array, Array]:
    sine = 1.0 / np.sqrt(1.0 + k * k)
    return sine, k * sine


def _within(legs: _Legs, distance: Array, low: Array, high: Array, rising: Array) -> Array:
    """Return the cotangents (n,) between bounds at which rays arrive, by Newton's steps, halved where they leave."""
    k, left = 0.5 * (low + high), np.arange(len(low))
    for _ in range(_STEPS):
        here = k[left]
        sine, cosine = _of_cotangent(here)
        reached, rate = legs.across(sine, cosine)
        before = (reached <= distance[left]) == rising[left]
        low[left], high[left] = np.where(before, here, low[left]), np.where(before, high[left], here)
        new = here - (distance[left] - reached) * legs.top / (rate * cosine * sine**2)
        new = np.where((new > low[left]) & (new < high[left]), new, 0.5 * (low[left] + high[left]))
        k[left] = new
        still = np.flatnonzero(np.abs(new - here) > _ARRIVED * here)
        if not len(still):
            break
        left, legs = left[still], legs.take(still)
    return k


def _ends(layers: _Layered, across: Array, yt: Array, ya: Array, best: Array) -> Ray:
    """Return rays with what they are at their ends."""
    time, p, by_across, turns = best
    time = np.where(np.isfinite(time), time, np.nan)
    parts = []
    for own, other in ((yt, ya), (ya, yt)):
        c, slope = _speed(layers, own)
        # A path grows where its end moves away along the ray: up from the deeper end it shortens.
        sign = np.where(turns == 0.0, np.where(own > other, -1.0, np.where(own < other, 1.0, 0.0)), turns)
        at = sign * np.sqrt(np.maximum((1.0 / c - p) * (1.0 / c + p), 0.0))
        by = np.where((p == 0.0) | (sign == 0.0), 0.0, -p / at * by_across)
        parts.append((at, by, slope / c**3))
    share = np.where(across > 0.0, p / np.where(across > 0.0, across, 1.0), by_across)
    (at_t, by_t, bends_t), (at_a, by_a, bends_a) = parts
    slopes = (p, share, at_t, at_a, by_across, by_t, by_a, bends_t, bends_a)
    # Where no ray arrives the time alone is NaN: a row that is absent there must not spoil the others.
    return Ray(time, across, *(np.where(np.isfinite(time), slope, 0.0) for slope in slopes))
