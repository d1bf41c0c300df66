"""Confidence sets of direction and range of a target, from the likelihood over direction and inverse range.

The target is at ``x = c + (s / v) u``. Here c is the centre of the stations, s their spread, u a unit vector, and v the
inverse range in units of 1/s, at least 0. Infinity is v = 0, a regular point, so a plane wave needs no special case. A
cone holds the directions whose cost, at the best v, is close enough to the minimum. The inverse range is not Gaussian
at its bound, so all ends follow from the cost itself.

Arrays hold q or k directions of d coordinates, and a vector of `size` parameters for each. A rise is an increase of the
cost above the lowest cost of all minima, `least`; the edge of a set is at a given rise. Its square root is in standard
deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from optloc.base import linalg
from optloc.base.linalg import normalised, spread_directions
from optloc.base.types import Array
from optloc.kernels.damping import FIRST_GROWTH, judge
from optloc.linear.mirror import mirror, one_position, plane_of_stations
from optloc.linear.normal import depends_on_place
from optloc.linear.vectors import vectors
from optloc.model_checks.scaled_rows import has_scales, profile_by_rows
from optloc.model_checks.shape import profile
from optloc.problem.chart import basis, jacobian, quantile
from optloc.problem.determined import LEVEL, Direction, is_in_cone
from optloc.problem.problem import Problem

INFINITY = 1e-6
"""Inverse range that counts as zero: wave fronts bend by 5e-7 of the spread, and derivatives keep four digits."""

# Largest inverse range: a point closer to the centre has no direction.
_LARGEST = 1e3
# Numbers of directions of the grid search, about 28 degrees apart in space and 15 in the plane, and the inverse ranges
# at each direction.
_TRIED = {2: 24, 3: 50}
_INVERSE = np.array([INFINITY, 0.1, 0.3, 1.0, 3.0])
# Number of starts that are refined, and number of steps of each: a damped step squares a small error.
_REFINED, _STEPS = 16, 40
# Number of steps at one point of an edge, where the start is close to the result.
_FEW = 12
# Steps end if the predicted decrease is below this share of the cost; the cost is compared with a quantile of several.
_CONVERGED = 1e-6
# Damping of the first step, relative to the diagonal.
_DAMPING = 1e-3
# Largest rotation of a step in radians: beyond it the linear model is not valid.
_TURN = 0.5
# Number of rays to the edge of a cone in space: the area of the polygon is 0.6 % smaller than the ellipse.
_RAYS = 32
# Growth of a step that searches the outer side of an edge, and the largest number of false positions.
_GROWTH, _TRIALS = 1.6, 14
# Tolerance of the square root of the rise: a hundredth of a standard deviation.
_CLOSE = 1e-2
# Largest number of cones. More minima are points of a valley, which no cone describes.
_CONES = 4
# Inverse range close to the stations, where the cost may have another minimum.
_NEAR_STATIONS = 0.5
# Largest angle to the edge of a cone in radians: beyond it the cone has no edge. Lunes of two mirror images reach it.
_WIDEST = 0.999 * np.pi
# Angle in radians and relative range within which two minima are equal.
_SAME = 1e-3
# Angle in radians within which a direction is the mirror image of another, and the share of a cone that must be inside
# another cone.
_ALIKE, _WITHIN = 1e-2, 0.97
# Angle between points of a valley in radians: useful cones are not wider.
_VALLEY_ANGLE = 0.1
# Share of rays without an edge above which a cone has no edge. A lune between opposite images has some of these rays.
_OPEN = 0.5


@dataclass(frozen=True, slots=True)
class DirectionCost:
    """The cost as a function of direction and inverse range, minimised over all other unknowns.

    - problem: flat batch of one problem with one position.
    - x (1, size): start of the search for the other unknowns.
    - centre (d,): centre of the stations with present rows, m.
    - spread: largest distance of these stations from the centre, m; 1 for one station.
    - weighed (1, size): parameters at which the noise of station errors is computed; None computes it at each position.
    - most: largest inverse range of the search, in 1/spread.
    """

    problem: Problem
    x: Array
    centre: Array
    spread: float
    weighed: Array | None = None
    most: float = _LARGEST

    @classmethod
    def of(cls, problem: Problem) -> DirectionCost:
        """Return the cost of a flat batch of one problem, with the centre and spread of its stations."""
        centre, _, _, size = plane_of_stations(problem)
        spread = float(size[0]) if size[0] > 0.0 else 1.0
        return cls(problem, vectors(problem, np.zeros((1, 1, problem.dimension)))[:, 0], centre[0], spread)

    def positions(self, u: Array, v: Array) -> Array:
        """Return the positions (q, d), m, at the directions `u` (q, d) and the inverse ranges `v` (q,)."""
        return np.asarray(self.centre + (self.spread / v)[:, None] * u)

    def vectors(self, u: Array, v: Array) -> Array:
        """Return parameter vectors (q, size) with positions at directions `u` (q, d) and inverse ranges `v` (q,)."""
        slot, _ = self.problem.layout.find("position")
        x = np.repeat(self.x, len(u), axis=0)
        x[:, slot.start : slot.start + slot.size] = self.positions(u, v)
        return x

    def evaluate(self, u: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return costs (q,), information (q, d, d) and right sides (q, d) at directions `u` and inverse ranges `v`.

        Information and right side refer to d changes: d - 1 rotations of u, rad, and the change of v. A cost that
        cannot be computed is infinite.
        """
        x = self.vectors(u, v)[:, None]
        method = profile_by_rows if has_scales(self.problem) else profile
        cost, information, vector = method(self.problem, x, x if self.weighed is None else self.weighed, passes=2)
        # derivative of the position by the d changes, which converts the equations of the position
        away = self.spread * u
        gradient = jacobian(np.concatenate([0.0 * u[:, :-1], v[:, None]], axis=1), away, np.zeros(u.shape[1]))
        turned = np.swapaxes(gradient, -1, -2)
        cost = np.where(np.isfinite(cost[:, 0]), cost[:, 0], np.inf)
        return cost, turned @ information[:, 0] @ gradient, (turned @ vector[:, 0, :, None])[..., 0]

    def descend(self, u: Array, v: Array, rotate: bool, change_range: bool, steps: int) -> tuple[Array, Array, Array]:
        """Return the directions (q, d), inverse ranges and costs (q,) after at most `steps` damped Gauss-Newton steps.

        `u` and `v` are the starts. `rotate` allows changes of the direction, and `change_range` changes of the inverse
        range.
        """
        d = u.shape[1]
        free = np.array([rotate] * (d - 1) + [change_range])
        cost, information, vector = self.evaluate(u, v)
        damping, growth = np.full(len(u), _DAMPING), np.full(len(u), FIRST_GROWTH)
        for _ in range(steps):
            move, gain, ok = _step(information, vector, damping, self._may_change(free, v, vector))
            if not (gain > _CONVERGED * (1.0 + cost)).any():
                break
            there, v_there = self._moved(u, v, move)
            new, more, other = self.evaluate(there, v_there)
            better, _, _, damping, growth = judge(cost, new, gain, ok, 0.0 * cost, damping, growth, 0.0, True)
            u, v = np.where(better[:, None], there, u), np.where(better, v_there, v)
            information = np.where(better[:, None, None], more, information)
            vector, cost = np.where(better[:, None], other, vector), np.where(better, new, cost)
        return u, v, cost

    def _moved(self, u: Array, v: Array, move: Array) -> tuple[Array, Array]:
        """Return directions (q, d) and inverse ranges (q,) after steps (q, d): d - 1 rotations, rad, and a change of v.

        A rotation is at most `_TURN`, and an inverse range stays within its bounds. `u` (q, d) and `v` (q,) are the
        starts, and `move` (q, d) are the steps.
        """
        turn = move[:, :-1]
        length = np.sqrt((turn**2).sum(-1, keepdims=True))
        turn = turn * np.minimum(1.0, _TURN / np.maximum(length, 1e-300))
        there = u + (basis(u) @ turn[..., None])[..., 0]
        there /= np.sqrt((there**2).sum(-1, keepdims=True))
        return there, np.clip(v + move[:, -1], INFINITY, self.most)

    def _may_change(self, searched: Array, v: Array, vector: Array) -> Array:
        """Return the mask (q, d) of the coordinates of a step that may change.

        `searched` (d,) marks the coordinates that the search changes, and `vector` (q, d) is the right side. An inverse
        range at its bound may only move away from the bound.
        """
        out = np.broadcast_to(searched, vector.shape).copy()
        out[:, -1] &= ~(((v <= INFINITY) & (vector[:, -1] <= 0.0)) | ((v >= self.most) & (vector[:, -1] >= 0.0)))
        return out

    def best_range(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return the best inverse ranges (q,) of directions `u` (q, d) and their costs (q,).

        Each direction has three starts: its guess in `v` (q,), infinity, and a point near the stations. The directions
        do not change.
        """
        starts = np.concatenate([v, np.full(len(v), INFINITY), np.full(len(v), _NEAR_STATIONS)])
        _, found, cost = self.descend(np.tile(u, (3, 1)), starts, rotate=False, change_range=True, steps=_FEW)
        found, cost = found.reshape(3, -1), cost.reshape(3, -1)
        best = cost.argmin(0)[None]
        return np.take_along_axis(found, best, 0)[0], np.take_along_axis(cost, best, 0)[0]


def _step(information: Array, vector: Array, damping: Array, free: Array) -> tuple[Array, Array, Array]:
    """Return damped steps (q, d), the predicted decreases of the cost (q,), and a mask (q,) of solvable systems.

    `information` (q, d, d) and `vector` (q, d) are the normal equations, and `damping` (q,) is relative to their
    diagonal. Coordinates that `free` (q, d) does not mark do not change.
    """
    inner = np.where(free[:, :, None] & free[:, None, :], information, 0.0)
    right = np.where(free, vector, 0.0)
    size = np.diagonal(inner, axis1=-2, axis2=-1).copy()
    # damping: both rotations have one scale: on the plane of the stations, the derivative across the plane is zero
    size[:, :-1] = size[:, :-1].max(-1, keepdims=True)
    size = np.where(free & (size > 0.0), size, np.maximum(size.max(-1, keepdims=True), 1e-300))
    # a fixed coordinate gets a diagonal entry only, so that the system stays solvable
    grown = inner + (damping[:, None] * size + np.where(free, 0.0, size))[..., None] * np.eye(size.shape[-1])
    move, ok = linalg.solve(grown, right[..., None])
    move = np.where(free & ok[:, None], move[..., 0], 0.0)
    return move, (move * right).sum(-1), ok


# Search for all minima, independent of the fix.


@dataclass(frozen=True, slots=True)
class DirectionMinima:
    """Minima of the cost in ascending order: directions (k, d), inverse ranges (k,) in 1/spread, and costs (k,)."""

    u: Array
    v: Array
    cost: Array

    def __getitem__(self, items: Array) -> DirectionMinima:
        return DirectionMinima(self.u[items], self.v[items], self.cost[items])


def minima_of(surface: DirectionCost, rise: float) -> DirectionMinima:
    """Return the different minima with a cost of at most `rise` above the lowest cost, from a grid search."""
    d = len(surface.centre)
    spot = spread_directions(_TRIED[d], d)
    u, v = np.repeat(spot, len(_INVERSE), axis=0), np.tile(np.minimum(_INVERSE, surface.most), len(spot))
    cost = surface.evaluate(u, v)[0].reshape(len(spot), -1)
    order = np.argsort(cost.min(1), kind="stable")[:_REFINED]
    found = surface.descend(spot[order], np.minimum(_INVERSE, surface.most)[cost[order].argmin(1)], True, True, _STEPS)
    found = _lowest(surface, *found)
    # add mirror images in the plane of the stations, and points on the plane, where a separate minimum is a point
    image = normalised(mirror(surface.problem, surface.centre + found[0][None])[0] - surface.centre)
    on = normalised(found[0] + image)
    more = surface.descend(np.concatenate([image, on]), np.tile(found[1], 2), True, True, _STEPS)
    u, v, cost = (np.concatenate(pair) for pair in zip(found, more, strict=True))
    return _distinct(u, v, cost, rise)


def _lowest(surface: DirectionCost, u: Array, v: Array, cost: Array) -> tuple[Array, Array, Array]:
    """Return directions (q, d), inverse ranges (q,) and costs (q,): the better one of each minimum and infinity.

    The arguments are minima. A second descent starts at infinity in the direction of each minimum.
    """
    there, other, flat = surface.descend(u, np.full(len(v), INFINITY), True, True, _STEPS)
    better = flat < cost
    return np.where(better[:, None], there, u), np.where(better, other, v), np.where(better, flat, cost)


def _distinct(u: Array, v: Array, cost: Array, rise: float) -> DirectionMinima:
    """Return the different minima within `rise` of the lowest cost, in ascending order of the cost."""
    order = [int(i) for i in np.argsort(cost, kind="stable") if cost[i] <= cost.min() + rise]
    kept: list[int] = []
    for i in order:
        alike = [abs(v[i] - v[j]) <= _SAME * (1.0 + v[j]) and u[i] @ u[j] > 1.0 - 0.5 * _SAME**2 for j in kept]
        if not any(alike):
            kept.append(i)
    return DirectionMinima(u[kept], v[kept], cost[kept])


# Edges: points where the square root of the rise of the cost reaches a given value.

# Function of arguments (k,) and guesses (k,) of the minimised unknown. It returns two arrays (k,): the square root of
# the rise minus its value at the edge (the excess), and the optimal unknown.
Profile = Callable[[Array, Array], tuple[Array, Array]]


def edge(
    surface: DirectionCost, start: tuple[Array, Array], rays: Array, least: float, rise: Array
) -> tuple[Array, Array]:
    """Return the angles (k,) of the edge of a cone along rays, in radians, and the directions (k, d) there.

    `start` is the direction (d,) and the inverse range of a minimum. `rays` (k, d) are unit vectors perpendicular to
    the direction, one for each ray. `least` is the lowest cost of all minima, and `rise` (k,) the rise of the cost at
    the edge. The results are NaN for a ray whose cost stays lower up to the widest angle.
    """
    # low is inside the cone and high is tried; below and above are the excesses there
    u0, v0 = start
    wanted, v = np.sqrt(rise), np.full(len(rays), v0)
    low, high, above = np.zeros(len(rays)), _gaussian_edge(surface, u0, v0, rays, wanted), np.zeros(len(rays))
    below = _sigmas_above(surface.evaluate(u0[None], np.atleast_1d(v0))[0], least)[0] - wanted

    def at(angle: Array, guess: Array) -> tuple[Array, Array]:
        # excess of the root of the rise at angles on the rays, and the best inverse ranges there
        turned = np.cos(angle)[:, None] * u0 + np.sin(angle)[:, None] * rays
        found, cost = surface.best_range(turned, guess)
        return _sigmas_above(cost, least) - wanted, found

    inside = np.ones(len(rays), dtype=bool)
    while inside.any():
        above, found = at(high, v)
        inside = (above < 0.0) & (high < _WIDEST)
        low, below = np.where(inside, high, low), np.where(inside, above, below)
        v = np.where(inside, found, v)
        high = np.where(inside, np.minimum(_GROWTH * high, _WIDEST), high)
    open_ = above < 0.0
    low = _false_position(at, (low, below), (high, above), v)
    turned = np.cos(low)[:, None] * u0 + np.sin(low)[:, None] * rays
    return np.where(open_, np.nan, low), np.where(open_[:, None], np.nan, turned)


def _sigmas_above(cost: Array, least: float) -> Array:
    """Return the square root of the rise of costs above the lowest cost, in standard deviations."""
    return np.sqrt(np.maximum(cost - least, 0.0))


def _gaussian_edge(surface: DirectionCost, u: Array, v: Array, rays: Array, wanted: Array) -> Array:
    """Return the angles (k,) of the edge of a Gaussian cone along the rays `rays` (k, d), in radians, as first guesses.

    `u` (d,) and `v` are a minimum, and `wanted` (k,) is the square root of the rise at the edge.
    """
    _, information, _ = surface.evaluate(u[None], np.atleast_1d(v))
    across = rays @ basis(u)
    form = ((across @ _direction_information(information[0], float(v))) * across).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        guess = wanted / np.sqrt(form)
    return np.clip(np.where(np.isfinite(guess), guess, _TURN), 1e-9, _TURN)


def _false_position(at: Profile, low: tuple[Array, Array], high: tuple[Array, Array], v: Array) -> Array:
    """Return the zeros (k,) of functions between two ends, by the modified false position.

    `at` evaluates the functions, which are negative at `low` and positive at `high`. Both ends are pairs of arguments
    (k,) and values (k,). `v` (k,) are guesses of the unknown that `at` minimises.

    References
    ----------
    M. Dowell and P. Jarratt, "A modified regula falsi method for computing the root of an equation", BIT 11 (1971).
    """
    (a, f_a), (b, f_b) = low, high
    side, middle = np.zeros(len(a)), a
    for _ in range(_TRIALS):
        with np.errstate(divide="ignore", invalid="ignore"):
            middle = (a * f_b - b * f_a) / (f_b - f_a)
        middle = np.where(np.isfinite(middle) & (middle > a) & (middle < b), middle, 0.5 * (a + b))
        now, found = at(middle, v)
        if (np.abs(now) <= _CLOSE).all():
            break
        over = now > 0.0
        v = np.where(over, v, found)
        f_a, f_b = np.where(over & (side > 0.0), 0.5 * f_a, f_a), np.where(~over & (side < 0.0), 0.5 * f_b, f_b)
        a, f_a = np.where(over, a, middle), np.where(over, f_a, now)
        b, f_b = np.where(over, middle, b), np.where(over, now, f_b)
        side = np.where(over, 1.0, -1.0)
    return np.asarray(middle)


def ends_of_range(surface: DirectionCost, minima: DirectionMinima, least: float, rise: float) -> tuple[float, float]:
    """Return the smallest and largest inverse range near minima with a low enough cost, in 1/spread.

    The cost is a profile over the inverse range: the directions adapt to each inverse range. An inverse range belongs
    to the interval if its cost is at most `rise` above `least`. A lower end of `INFINITY` means infinity, and an upper
    end of `surface.most` the nearest point of the search.
    """
    wanted, count = np.sqrt(rise), len(minima.v)
    # all ends together: lower ends with the sign changed, so that each search goes upwards
    side, state = np.repeat([-1.0, 1.0], count), np.tile(minima.u, (2, 1))
    low, limit = side * np.tile(minima.v, 2), np.where(side > 0.0, surface.most, -INFINITY)

    def at(inverse: Array, _: Array) -> tuple[Array, Array]:
        # excess of the root of the rise at inverse ranges; the directions start where the cost was last low enough
        nonlocal state
        there, _, cost = surface.descend(state, side * inverse, rotate=True, change_range=False, steps=_FEW)
        state = np.where((cost <= least + rise)[:, None], there, state)
        return _sigmas_above(cost, least) - wanted, inverse

    _, information, _ = surface.evaluate(state, side * low)
    step = np.clip(wanted / np.sqrt(np.maximum(information[:, -1, -1], 1e-300)), INFINITY, surface.most)
    before, high = np.full(2 * count, -wanted), np.minimum(low + step, limit)
    while True:
        above, _ = at(high, high)
        inside = (above < 0.0) & (high < limit)
        if not inside.any():
            break
        low, before, step = np.where(inside, high, low), np.where(inside, above, before), 2.0 * step
        high = np.where(inside, np.minimum(high + step, limit), high)
    ends = np.abs(np.where(above < 0.0, limit, _false_position(at, (low, before), (high, above), high)))
    return float(ends[:count].min()), float(ends[count:].max())


# Cones.


def directions_of(surface: DirectionCost, level: Array, few: bool = False) -> tuple[Direction, ...]:
    """Return the directions that the data allow, with their cones and ranges.

    The result is empty if there is no minimum, a cone has no closed edge, or more than `_CONES` cones are necessary.
    `level` (d, d) has two horizontal axes and, in space, the vertical axis as rows. `few` means fewer rows than
    unknowns. If many minima are then far apart, they are points of a valley, and the result is empty.
    """
    d = len(surface.centre)
    rise, single = quantile(LEVEL, d - 1), quantile(LEVEL, 1)
    minima = minima_of(surface, rise)
    if depends_on_place(surface.problem):
        # compute the noise of station errors at the best minimum, so that the same noise applies to the whole cone
        surface = replace(surface, weighed=surface.vectors(minima.u[:1], minima.v[:1]))
        minima = minima_of(surface, rise)
    if not np.isfinite(minima.cost[0]) or (few and _is_valley(minima.u)):
        return ()
    # each cone is found with the numbers of the minima inside it
    least, found = float(minima.cost[0]), list[tuple[Direction, list[int]]]()
    for i, u in enumerate(minima.u):
        around, members = next(((cone, items) for cone, items in found if cone.covers(u)), (None, [i]))
        if around is not None:
            members.append(i)
            # a minimum inside a known cone needs a separate cone only if it is a mirror image
            if not _is_image(surface, around.vector, u):
                continue
        cone = _cone(surface, minima, i, np.array([rise, single]), level)
        if around is not None and (cone is None or around.covers(u + _WITHIN * (cone.outline - u)).all()):
            continue
        if cone is None or len(found) == _CONES:
            return ()
        found.append((cone, members))
    return tuple(_with_range(surface, cone, minima[np.array(items)], least, single) for cone, items in found)


def _is_valley(u: Array) -> bool:
    """Return whether more than `_CONES` of the directions (k, d) are well separated from each other."""
    kept = u[:1]
    for one in u[1:]:
        if (kept @ one).max() < np.cos(_VALLEY_ANGLE):
            kept = np.concatenate([kept, one[None]])
    return len(kept) > _CONES


def _is_image(surface: DirectionCost, one: Array, other: Array) -> bool:
    """Return whether two different directions (d,) are mirror images in the plane of the stations.

    Two touching cones of mirror images are narrow where they touch, so rays from one of them miss much of the other.
    """
    image = mirror(surface.problem, (surface.centre + one)[None])[0] - surface.centre
    return bool(np.abs(image - other).max() < _ALIKE and np.abs(image - one).max() > _ALIKE)


def _cone(surface: DirectionCost, minima: DirectionMinima, i: int, rises: Array, level: Array) -> Direction | None:
    """Return the cone about minimum number `i` without its range, or None if the set has no closed edge.

    `rises` (2,) are the rises of the cost at the edge of the cone, and at the ends of azimuth and elevation. `level` is
    as in `directions_of`. The range is set to (infinity, 0, infinity); `_with_range` replaces it.
    """
    u, v, least = minima.u[i], minima.v[i], float(minima.cost[0])
    # a minimum above a rise is outside the set of this rise: its edge is then the minimum itself
    usable, across = rises > minima.cost[i] - least, _principal(surface, minima.u[i], minima.v[i])
    sides = np.concatenate([across.T, -across.T])
    reach, _ = edge(surface, (u, v), sides, least, np.full(len(sides), rises[0]))
    if np.isnan(reach).mean() > _OPEN:
        return None
    half = np.where(np.isnan(reach), _WIDEST, reach).reshape(2, -1).mean(0)
    # rays have equal angles in the metric of the ellipse, so that its tips are not cut off
    rays = sides if len(u) == 2 else normalised(_unit_circle() * half @ across.T)
    k = len(rays)
    angle, edges = np.zeros((2, k)), np.tile(u, (2, k, 1))
    found = edge(surface, (u, v), np.tile(rays, (usable.sum(), 1)), least, np.repeat(rises[usable], k))
    angle[usable], edges[usable] = found[0].reshape(-1, k), found[1].reshape(-1, k, len(u))
    if np.isnan(angle[0]).mean() > _OPEN:
        return None
    opposite = np.isnan(angle)
    angle = np.where(opposite, _WIDEST, angle)
    edges = np.where(opposite[..., None], np.cos(_WIDEST) * u + np.sin(_WIDEST) * rays, edges)
    half, axes = _ellipse(u, rays, angle[0])
    azimuth, elevation = _angles(u, edges[1], level)
    return Direction(u, azimuth, elevation, half, axes, edges[0], (np.inf, 0.0, np.inf), float(minima.cost[i]) - least)


def _principal(surface: DirectionCost, u: Array, v: float) -> Array:
    """Return the principal axes (d, d - 1) of the information on a direction: unit vectors perpendicular to it."""
    _, information, _ = surface.evaluate(u[None], np.atleast_1d(v))
    return np.asarray(basis(u) @ np.linalg.eigh(_direction_information(information[0], v))[1])


def _unit_circle() -> Array:
    """Return unit vectors (k, 2) on the whole circle, counter-clockwise."""
    turn = 2.0 * np.pi * np.arange(_RAYS) / _RAYS
    return np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def _direction_information(information: Array, v: float) -> Array:
    """Return the information (d - 1, d - 1) on rotations of a direction, rad^-2.

    If the inverse range `v` is free, it is eliminated from `information` (d, d); at infinity it is fixed.
    """
    turns = information[:-1, :-1]
    if v <= INFINITY or information[-1, -1] <= 0.0:
        return turns
    return np.asarray(turns - np.outer(information[:-1, -1], information[-1, :-1]) / information[-1, -1])


def _ellipse(u: Array, rays: Array, angle: Array) -> tuple[Array, Array]:
    """Return semi-axes (d - 1,), rad, and unit vectors (d, d - 1) of the ellipse with the moments of an outline.

    The outline is at the angles `angle` (k,), rad, from the direction `u` (d,) along the unit vectors `rays` (k, d).
    """
    across = basis(u)
    if len(u) == 2:
        return np.array([0.5 * angle.sum()]), across
    rim = angle[:, None] * (rays @ across)
    rim = rim[np.argsort(np.arctan2(rim[:, 1], rim[:, 0]))]
    following = np.roll(rim, -1, axis=0)
    # triangles from the direction to the outline: twice their areas, and their second moments
    double = rim[:, 0] * following[:, 1] - rim[:, 1] * following[:, 0]
    both = rim + following
    moment = (double[:, None, None] * sum(e[:, :, None] * e[:, None, :] for e in (rim, following, both))).sum(0) / 24.0
    values, turned = np.linalg.eigh(moment / (0.5 * double.sum()))
    return 2.0 * np.sqrt(np.maximum(values[::-1], 0.0)), across @ turned[:, ::-1]


def _angles(u: Array, edges: Array, level: Array) -> tuple[tuple[float, float, float], tuple[float, ...]]:
    """Return azimuth and elevation of a direction, each as (value, lower end, upper end) in radians.

    `edges` (k, d) is the edge of its cone, and `level` is as in `directions_of`. In the plane, the elevation is empty.
    """
    local, rim = level @ u, edges @ level.T
    middle = float(np.arctan2(local[1], local[0]))
    turn = np.arctan2(rim[:, 1] * local[0] - rim[:, 0] * local[1], rim[:, :2] @ local[:2])
    ends = (middle + float(turn.min()), middle + float(turn.max()))
    if len(u) == 2:
        return (middle, *ends), ()
    height = np.arcsin(np.clip(rim[:, 2], -1.0, 1.0))
    up, down = (bool(is_in_cone(u, edges, side * level[2])) for side in (1.0, -1.0))
    low, high = -0.5 * np.pi if down else float(height.min()), 0.5 * np.pi if up else float(height.max())
    # if a cone contains the vertical, every azimuth is possible
    ends = (middle - np.pi, middle + np.pi) if up or down else ends
    return (middle, *ends), (float(np.arcsin(np.clip(local[2], -1.0, 1.0))), low, high)


def _with_range(
    surface: DirectionCost, cone: Direction, minima: DirectionMinima, least: float, rise: float
) -> Direction:
    """Return a cone with its range (best, smallest, largest) in m, from the inverse ranges of the minima in the cone.

    `minima` are in the cone, `least` is the lowest cost of all minima, and `rise` the rise at the ends of the range. If
    no minimum in the cone is within this rise, the minimum with the lowest cost is used. Infinity as an end means no
    upper limit.
    """
    near = minima[minima.cost <= least + rise]
    if not len(near.cost):
        near = minima[minima.cost == minima.cost.min()]
    with np.errstate(divide="ignore"):
        low, high = ends_of_range(surface, near, least, max(rise, float(near.cost.min()) - least))
        best = near.v[near.cost.argmin()]

    def distance(v: float) -> float:
        return np.inf if v <= INFINITY else 0.0 if v >= _LARGEST else surface.spread / v

    return replace(cone, range=(distance(float(best)), distance(high), distance(low)))


def has_directions(problem: Problem) -> bool:
    """Return whether problems have one static position, no constraints and no medium, as `DirectionCost` requires."""
    still = one_position(problem) and problem.motions[0].order == 0 and problem.layout.shares("position")
    return still and not (problem.constraints or problem.fences) and problem.medium is None


# Regions in the plane.

# Number of rays about a minimum: the extent along an axis is 0.1 % smaller than the extent of an ellipse.
_AROUND = 64


def extent_of(surface: DirectionCost, u: Array, v: float, least: float, rise: float) -> Array:
    """Return positions (k, 2) on the edge of a region in the plane, m.

    The region holds the positions with a cost of less than `rise` above the lowest cost `least`. `u` (2,) and `v` are a
    minimum inside the region. An edge at infinity is at 1e6 spreads of the stations.
    """
    _, information, _ = surface.evaluate(u[None], np.atleast_1d(v))
    values, axes = np.linalg.eigh(information[0])
    steps = axes * np.sqrt(rise / np.maximum(values, _DAMPING * max(float(values.max()), 1e-300)))
    turn = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    rays, side = np.stack([np.cos(turn), np.sin(turn)], axis=-1) @ steps.T, basis(u)[:, 0]

    def places(share: Array) -> tuple[Array, Array]:
        # directions and inverse ranges at shares of the Gaussian rays
        angle = np.clip(share * rays[:, 0], -np.pi, np.pi)
        inverse = np.clip(v + share * rays[:, 1], INFINITY, _LARGEST)
        return np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * side, inverse

    def at(share: Array, _: Array) -> tuple[Array, Array]:
        # excess of the root of the rise at these points
        return _sigmas_above(surface.evaluate(*places(share))[0], least) - np.sqrt(rise), share

    # a ray that reaches infinity ends there
    falls = rays[:, 1] < 0.0
    most = np.where(falls, (v - INFINITY) / np.maximum(-rays[:, 1], 1e-300), _FARTHEST)
    low, high = np.zeros(_AROUND), np.minimum(1.0, most)
    below = np.full(_AROUND, float(at(low, low)[0][0]))
    while True:
        above, _ = at(high, high)
        inside = (above < 0.0) & (high < most)
        if not inside.any():
            break
        low, below = np.where(inside, high, low), np.where(inside, above, below)
        high = np.where(inside, np.minimum(_GROWTH * high, most), high)
    ends = np.where(above < 0.0, high, _false_position(at, (low, below), (high, above), high))
    return surface.positions(*places(ends))


# Longest ray, in units of the ray of a Gaussian region.
_FARTHEST = 1e4
