"""Targets near the plane of all stations: both sides fit alike, and the distance w from the plane enters by its square.

A minimum of the cost over the place in the plane and q = w^2 >= 0 is a pair of mirror images, or one place in the
plane. The data tell the two images apart only where the cost on the plane between them is clearly higher; else they
are ends of one region.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from optloc.base import linalg
from optloc.base.records import take
from optloc.base.types import Array, Status
from optloc.compute.least_squares import refine
from optloc.compute.sums import equations_at
from optloc.linear.folded import Folded
from optloc.linear.normal import depends_on_place, marginal
from optloc.problem.chart import quantile
from optloc.problem.fix import Stage
from optloc.problem.problem import Problem
from optloc.solvers.policy import LISTED_GAP, SAME_PLACE
from optloc.solvers.pool import Curvature, Pool
from optloc.solvers.starts.position import is_of_ranges, one_position, plane_of_stations, spread_of
from optloc.solvers.verdict.minima import measure_curvature, smallest_pivot

REGION_LEVEL = 0.95
"""Probability of the interval of the distance from the plane, by which one region is told from two."""
JOINED = quantile(REGION_LEVEL, 1)
"""Cost on the plane, above the least, up to which both sides of it are one region."""

APART = 20.0
"""Standard deviations of w from the plane beyond which no region reaches across: they are ten of q."""

# Share of the spread of the stations by which they may be off a plane: rounding of their coordinates.
_COPLANAR = 1e-9
# Share of the spread of the stations that stands for no distance: its square changes no range by a digit that counts.
_NONE = 1e-6
# Steps at most: the cost is nearly quadratic in q, and most take two.
_STEPS = 100
# Standard deviations of q at which the end of its interval is looked for first: of a Gaussian it is at two.
_FIRST = 2.5
# Fourfold steps away from the plane: as many lead a million spreads of the stations away.
_FURTHER = 12
# Steps towards an end at most, and the distance of its cost from the level at which it is near enough.
_TRIALS, _CLOSE = 12, 1e-2


@dataclass(frozen=True, slots=True)
class Across:
    """N problems in coordinates whose last one is the distance from the plane of the stations.

    Parameters
    ----------
    problem : Problem
        The problems, without constraints.
    centre : array (N, d)
        Mean of the stations, metres.
    axes : array (N, d, d)
        Unit vectors in columns, the normal of the plane last.
    size : array (N,)
        Spread of the stations, metres.
    """

    problem: Problem
    centre: Array
    axes: Array
    size: Array

    @classmethod
    def of(cls, problem: Problem) -> Across:
        """Return problems whose stations are coplanar."""
        count = problem.batch_shape[0]
        centre, axes, _ = plane_of_stations(problem)
        centre, axes = np.broadcast_to(centre, (count, centre.shape[-1])), axes[..., ::-1]
        axes = np.broadcast_to(axes, (count, *axes.shape[-2:]))
        place = (problem.stations.position - centre[:, None, None]) @ axes[:, None]
        place[..., -1] = 0.0
        stations = replace(problem.stations, position=place)
        turned = replace(problem, stations=stations, constraints=())
        return cls(turned, centre, axes, np.broadcast_to(spread_of(problem)[1], (count,)))

    def take(self, items: Array) -> Across:
        """Return some of them."""
        return Across(self.problem.take(items), self.centre[items], self.axes[items], self.size[items])

    @property
    def part(self) -> slice:
        """Return where the position stands among the unknowns."""
        slot, _ = self.problem.layout.find("position")
        return slice(slot.start, slot.start + slot.size)

    @property
    def least(self) -> Array:
        """Return the distances (N,) that stand for none, metres."""
        return _NONE * self.size

    def to_plane(self, x: Array) -> Array:
        """Return vectors (N, size) with the position in these coordinates, on the side where w is positive."""
        out = np.array(x)
        place = ((x[:, self.part] - self.centre)[:, None] @ self.axes)[:, 0]
        place[:, -1] = np.abs(place[:, -1])
        out[:, self.part] = place
        return out

    def to_space(self, x: Array, side: Array) -> Array:
        """Return vectors (N, size) of the problem as it was, on one side of the plane."""
        out = np.array(x)
        place = x[:, self.part].copy()
        place[:, -1] *= side
        out[:, self.part] = self.centre + (self.axes @ place[..., None])[..., 0]
        return out

    def refine(self, x: Array, *, held: bool) -> tuple[Array, Array, Array]:
        """Return where steps in the plane and in q end: vectors (N, size), costs and `Status` numbers (N,).

        Parameters
        ----------
        x : array (N, size)
            Starts.
        held : bool
            Whether the distance from the plane stays as it is.
        """
        start = np.array(x)
        own = self.part.stop - 1
        start[:, own] = np.maximum(start[:, own], self.least)
        least = start[:, own] if held else self.least
        with np.errstate(all="ignore"):
            done = refine(self.problem, start, limit=_STEPS, folded=Folded(own, least, held))
        return done.x, done.cost, done.status

    def profile(self, x: Array, w: Array) -> tuple[Array, Array]:
        """Return vectors (N, size) and costs (N,) at distances w (N,) from the plane, all else at its best."""
        start = np.array(x)
        start[:, self.part.stop - 1] = w
        end, cost, _ = self.refine(start, held=True)
        return end, cost


def is_symmetric(problem: Problem) -> bool:
    """Return whether rows and priors of a problem are the same for mirror images in a plane of its stations."""
    if not one_position(problem) or depends_on_place(problem) or problem.stations.errors:
        return False
    if any(name == "position" for name, *_ in problem.priors):
        return False
    return problem.medium is None and all(is_of_ranges(rows.kind) for rows in problem.rows)


def is_coplanar(problem: Problem) -> Array:
    """Return whether all stations of each problem lie in one plane, or in the plane on one line, (N,)."""
    count = problem.batch_shape[0]
    if not is_symmetric(problem):
        return np.zeros(count, dtype=bool)
    return np.broadcast_to(plane_of_stations(problem)[2] <= _COPLANAR, (count,))


def normal_of(problem: Problem) -> Array | None:
    """Return the normal (d,) of the plane of the stations of one problem, or None where its sides are not alike."""
    if problem.constraints or not is_coplanar(problem).all():
        return None
    return np.asarray(plane_of_stations(problem)[1][0, :, 0])


def join_sides(problem: Problem, pool: Pool) -> Pool:
    """Return a settled pool in which both sides of the plane of coplanar stations are one region, where they are.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Settled. Where the cost on the plane is out of question it stays as it is.
    """
    if problem.constraints or not is_symmetric(problem):
        return pool
    items = np.flatnonzero(is_coplanar(problem) & np.isfinite(pool.x).all(-1).any(-1))
    items = items[_is_near(problem.take(items), take(pool, items))] if len(items) else items
    if not len(items):
        return pool
    began, across, own = perf_counter(), Across.of(problem.take(items)), take(pool, items)
    found = _minima(across, own)
    good = np.flatnonzero(np.isfinite(found.cost[:, 0]))
    if not len(good):
        return pool
    items, across, own, found = items[good], across.take(good), take(own, good), found.take(good)
    fresh = _as_pool(problem.take(items), across, own, found)
    joined = int((found.on_plane - found.cost[:, 0] <= JOINED).sum())
    stage = Stage("fold", f"{joined} of {len(items)} on both sides of the plane at once", perf_counter() - began)
    return pool.merge(items, fresh, stage)


def _is_near(problem: Problem, pool: Pool) -> Array:
    """Return where a fix may be near the plane, for its standard deviations, or is none yet, (N,)."""
    assert pool.curvature is not None
    across = Across.of(problem)
    place, normal = pool.x[:, 0, across.part], across.axes[..., -1]
    w = np.abs(((place - across.centre) * normal).sum(-1))
    spread = pool.curvature.covariance[:, across.part, across.part]
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt((normal[:, None] @ spread @ normal[..., None])[:, 0, 0])
        return np.asarray((pool.code[:, 0] != Status.OK) | ~(w > APART * sigma))


@dataclass(frozen=True, slots=True)
class _Found:
    """Minima of N problems over the place in the plane and q, the cheapest first.

    Parameters
    ----------
    x : array (N, r, size)
        In the coordinates of `Across`; NaN in empty slots.
    cost : array (N, r)
        Infinite in empty slots.
    on_plane : array (N,)
        Least cost on the plane.
    """

    x: Array
    cost: Array
    on_plane: Array

    def take(self, items: Array) -> _Found:
        """Return those of some problems."""
        return _Found(self.x[items], self.cost[items], self.on_plane[items])


def _minima(across: Across, pool: Pool) -> _Found:
    """Return the minima that steps in q reach from all candidates of a pool."""
    item, slot = pool.occupied
    each, shape = across.take(item), pool.x.shape[:2]
    start = each.to_plane(pool.x[item, slot])
    end, least, code = each.refine(start, held=False)
    x, cost = np.full(pool.x.shape, np.nan), np.full(shape, np.inf)
    good = (code == Status.OK) & np.isfinite(least)
    x[item[good], slot[good]], cost[item[good], slot[good]] = end[good], least[good]
    _, level = each.profile(np.where(good[:, None], end, start), each.least)
    on_plane = np.full(len(pool), np.inf)
    np.minimum.at(on_plane, item, np.where(np.isfinite(level), level, np.inf))
    order = np.argsort(cost, axis=1, kind="stable")
    x, cost = np.take_along_axis(x, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)
    keep = _distinct(across, x, cost)
    x, cost = np.where(keep[..., None], x, np.nan), np.where(keep, cost, np.inf)
    return _Found(x, cost, on_plane)


def _distinct(across: Across, x: Array, cost: Array) -> Array:
    """Return which minima (N, r), the cheapest first, are listed: near enough in cost, and no repetition."""
    n = across.problem.layout.n_shared
    information, _ = information_in_square(across, np.where(np.isfinite(x[:, 0]), x[:, 0], 0.0))
    folded = np.array(x[..., :n])
    folded[..., across.part.stop - 1] **= 2
    with np.errstate(invalid="ignore"):
        keep = np.isfinite(cost) & (cost <= cost[:, :1] + LISTED_GAP)
    for slot in range(1, x.shape[1]):
        for other in range(slot):
            away = folded[:, slot] - folded[:, other]
            with np.errstate(invalid="ignore"):
                same = (away[:, None] @ information @ away[..., None])[:, 0, 0] < SAME_PLACE
            keep[:, slot] &= ~(same & keep[:, other])
    return keep


def information_in_square(across: Across, x: Array) -> tuple[Array, Array]:
    """Return the information (N, n, n) on the shared unknowns with q in place of w, and where it exists (N,)."""
    own = across.part.stop - 1
    at = np.array(x)
    at[:, own] = np.maximum(at[:, own], across.least)
    with np.errstate(all="ignore"):
        information, _, ok = marginal(equations_at(across.problem, at))
    scale = np.ones((len(x), information.shape[-1]))
    scale[:, own] = 0.5 / at[:, own]
    return information * scale[:, :, None] * scale[:, None, :], ok


def _as_pool(problem: Problem, across: Across, own: Pool, found: _Found) -> Pool:
    """Return minima and their mirror images as a settled pool, in space."""
    count, slots, size = found.x.shape
    w = found.x[..., across.part.stop - 1]
    x, cost = np.full((count, 2 * slots, size), np.nan), np.full((count, 2 * slots), np.inf)
    off = w > across.least[:, None]
    for slot in range(slots):
        # the upper side first, as the verdict has it
        upward = np.where(across.axes[:, -1, -1] < 0.0, -1.0, 1.0)
        flat = np.where(off[:, slot, None], found.x[:, slot], _on_plane(across, found.x[:, slot]))
        for side in (0, 1):
            x[:, 2 * slot + side] = across.to_space(flat, upward if side == 0 else -upward)
            there = np.isfinite(found.cost[:, slot]) & (off[:, slot] | (side == 0))
            cost[:, 2 * slot + side] = np.where(there, found.cost[:, slot], np.inf)
    x[~np.isfinite(cost)] = np.nan
    joined = np.zeros(cost.shape, dtype=bool)
    joined[:, :2] = (found.on_plane - found.cost[:, 0] <= JOINED)[:, None]
    curvature = _curvature(problem, across, found, x[:, 0], joined[:, 0])
    code = np.where(np.isfinite(cost), np.int8(Status.OK), np.int8(Status.UNAVAILABLE))
    blank = np.zeros(cost.shape, dtype=int)
    plain = None if own.plain is None else np.zeros(count, dtype=bool)
    return replace(own, x=x, cost=cost, code=code, face=blank, joined=joined, curvature=curvature, plain=plain)


def _on_plane(across: Across, x: Array) -> Array:
    out = np.array(x)
    out[:, across.part.stop - 1] = 0.0
    return out


def _curvature(problem: Problem, across: Across, found: _Found, x: Array, joined: Array) -> Curvature:
    """Return the curvature at minima x (N, size): of a joined region with the second moment of both sides about it."""
    with np.errstate(all="ignore"):
        at = measure_curvature(problem, equations_at(problem, x), x, np.zeros(len(x), dtype=int))
    covariance, kappa = at.covariance.copy(), np.full((len(x), 2), np.nan)
    items = np.flatnonzero(joined)
    if not len(items):
        return replace(at, kappa=kappa)
    across, best = across.take(items), found.x[items, 0]
    information, ok = information_in_square(across, best)
    square, regular = linalg.inverse(information)
    own = across.part.stop - 1
    _, end = interval_across(across, best, found.cost[items, 0])
    # both sides are alike: the distance has no correlation with anything
    square[:, own], square[:, :, own] = 0.0, 0.0
    square[:, own, own] = (end / np.sqrt(JOINED)) ** 2 + best[:, own] ** 2
    turn = np.broadcast_to(np.eye(information.shape[-1]), information.shape).copy()
    turn[:, across.part, across.part] = across.axes
    covariance[items] = turn @ square @ np.swapaxes(turn, -1, -2)
    kappa[items] = np.inf
    known, weakest, of_all = np.array(at.regular), np.array(at.weakest), np.array(at.information)
    known[items] = ok & regular
    weakest[items] = smallest_pivot(information)
    of_all[items], _ = linalg.inverse(covariance[items])
    return replace(at, covariance=covariance, information=of_all, regular=known, weakest=weakest, kappa=kappa)


def interval_across(across: Across, x: Array, cost: Array, level: float = REGION_LEVEL) -> tuple[Array, Array]:
    """Return the ends (N,) of the distance from the plane within which the profile of the cost is low enough.

    Parameters
    ----------
    across : Across
        N problems.
    x, cost : array (N, size), (N,)
        Their fixes, in these coordinates.
    level : float
        Probability that the interval holds the distance.

    Returns
    -------
    low, high : array (N,)
        Metres; the far end is infinite where no distance up to a million spreads of the stations costs enough.
    """
    top, w = cost + quantile(level, 1), x[:, across.part.stop - 1]
    _, on_plane = across.profile(x, across.least)
    apart, low = np.flatnonzero(on_plane > top), np.zeros(len(x))
    if len(apart):
        least, above = across.least[apart], (on_plane - top)[apart]
        low[apart] = _crossing(across.take(apart), x[apart], top[apart], w[apart], least, above)
    far, there = _beyond(across, x, top)
    ends, high = np.flatnonzero(np.isfinite(far)), np.full(len(x), np.inf)
    if len(ends):
        above = (there - top)[ends]
        high[ends] = _crossing(across.take(ends), x[ends], top[ends], w[ends], far[ends], above)
    return low, high


def _beyond(across: Across, x: Array, top: Array) -> tuple[Array, Array]:
    """Return distances (N,) from the plane at which the profile of the cost is above a level (N,), and these costs."""
    information, _ = information_in_square(across, x)
    covariance, _ = linalg.inverse(information)
    own = across.part.stop - 1
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.maximum(covariance[:, own, own], 0.0))
    # one step where the cost is quadratic in q
    far = np.sqrt(x[:, own] ** 2 + _FIRST * np.where(sigma > 0.0, sigma, across.size**2))
    reached, cost = across.profile(x, far)
    for _ in range(_FURTHER):
        within = cost <= top
        if not within.any():
            break
        far = np.where(within, 4.0 * far, far)
        reached, cost = across.profile(reached, far)
    return np.where(cost <= top, np.inf, far), cost


def _crossing(across: Across, x: Array, top: Array, inside: Array, outside: Array, above: Array) -> Array:
    """Return the distances (N,) at which the profile of the cost crosses a level (N,): false position in q.

    Parameters
    ----------
    across, x : Across, array (N, size)
        The problems, and their fixes.
    top : array (N,)
        The level.
    inside, outside : array (N,)
        Distances from the plane, metres, of costs below and above the level.
    above : array (N,)
        How far the cost outside is above it.

    References
    ----------
    M. Dowell and P. Jarratt, "A modified regula falsi method for computing the root of an equation", BIT 11 (1971).
    """
    a, b, q, reached = inside**2, outside**2, inside**2, x
    low, high, side = across.profile(x, inside)[1] - top, np.array(above), np.zeros(len(x))
    for _ in range(_TRIALS):
        with np.errstate(invalid="ignore", divide="ignore"):
            q = (a * high - b * low) / (high - low)
        q = np.where(np.isfinite(q), q, 0.5 * (a + b))
        reached, cost = across.profile(reached, np.sqrt(q))
        now = np.where(np.isfinite(cost), cost - top, np.inf)
        if (np.abs(now) <= _CLOSE).all():
            break
        over = now > 0.0
        # an end that stays twice in a row counts half
        low, high = np.where(over & (side > 0.0), 0.5 * low, low), np.where(~over & (side < 0.0), 0.5 * high, high)
        a, low = np.where(over, a, q), np.where(over, low, now)
        b, high = np.where(over, q, b), np.where(over, now, high)
        side = np.where(over, 1.0, -1.0)
    return np.sqrt(q)
