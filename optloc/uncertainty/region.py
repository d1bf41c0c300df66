"""The likelihood region of a fix: all positions whose cost exceeds the cost of the fix by at most a quantile.

A region may have any shape, several parts, and no end. Convex cells enclose it; bounds of the cost, as in a proof,
certify that no part is outside. Costs are chi-square values. Letters: n cells, k rays, d coordinates, q points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.linalg import centre_and_spread
from optloc.base.short_form import HasShortForm
from optloc.base.types import Array
from optloc.kernels.jit import enabled
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import exact
from optloc.linear.normal import covariance
from optloc.model_checks.shape import BENT, cost_at_infinity, departure, profile
from optloc.problem.chart import CARTESIAN, CURVED, INVERSE_RANGE, Chart, quantile
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.proof.position_costs import position_costs
from optloc.proof.scope import why_too_large, why_unsupported
from optloc.proof.search_space import Cost, cost_of, empty_box
from optloc.proof.subpaving import cover_region

# Most boxes of a cover, by dimension: the hull of an ellipse is then 2 % wider than the ellipse, the hull of an
# ellipsoid 10 %, after about 20 and 100 ms. Plain Python takes a thousand times longer for each box.
_MOST, _MOST_PLAIN = {2: 1000, 3: 8000}, 300
# Share by which a cell is enlarged when points are looked up, for the rounding of its inverse.
_ROUNDED = 1e-7
NOWHERE = "the positions with a cost this low are not bounded"
TURNS = "biases of angles may reach a whole turn at costs within the region"


@dataclass(frozen=True, slots=True)
class Cells:
    """Convex cells that together contain a region; a cell may reach infinity.

    Parameters
    ----------
    base : array (d,)
        A position, metres.
    edges : array (n, 1 + d, 1 + d)
        Middle of each cell, then half of each edge, in homogeneous coordinates. Here (P, v) is the position
        ``base + P / v``. The cell is the middle plus the edges times numbers between -1 and 1.
    inside : int
        Number of cells, at the beginning, that are completely inside the region.
    """

    base: Array
    edges: Array
    inside: int

    @property
    def corners(self) -> Array:
        """Return the corners (n, 2^d, d) of the cells, metres; coordinates are infinite if a cell has no end."""
        return self._finite(self._homogeneous())

    @property
    def directions(self) -> Array:
        """Return the corners of the cells as directions (n, 2^d, d), also for corners at infinity."""
        found = self._homogeneous()[..., :-1]
        return np.asarray(found / np.sqrt((found**2).sum(-1, keepdims=True)))

    def hold(self, points: Array) -> Array:
        """Return flags (q,) of points (q, d), metres, that are in a cell."""
        from_point = np.linalg.inv(np.swapaxes(self.edges, -1, -2))
        out = np.zeros(len(points), dtype=bool)
        for i, point in enumerate(np.append(points - self.base, np.ones((len(points), 1)), axis=1)):
            # the weight of the middle of each cell, then of its edges; a ratio of at most 1 is inside
            share = from_point @ point
            size = np.abs(share[:, 1:]).max(-1) if len(share) else np.zeros(0)
            out[i] = ((share[:, 0] > 0.0) & (size <= (1.0 + _ROUNDED) * share[:, 0])).any()
        return out

    def _homogeneous(self) -> Array:
        """Return the corners (n, 2^d, 1 + d) of the cells in homogeneous coordinates."""
        d = len(self.base)
        signs = np.array([(1.0, *corner) for corner in product((-1.0, 1.0), repeat=d)])
        return np.asarray(signs @ self.edges)

    def _finite(self, corners: Array) -> Array:
        """Return homogeneous corners (..., 1 + d) as positions (..., d), m; infinite if the last coordinate is zero."""
        scale = corners[..., -1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            apart = np.where(corners[..., :-1] == 0.0, 0.0, corners[..., :-1] / np.maximum(scale, 0.0))
        return np.asarray(self.base + apart)


@dataclass(frozen=True, slots=True, repr=False)
class Region(HasShortForm):
    """All positions whose cost exceeds the cost of a fix by at most a quantile of chi-square.

    Parameters
    ----------
    level : float
        Probability that it contains the target.
    surface : RegionSurface
        The cost over the position, and the fix.
    threshold : float
        Highest cost inside.
    points : array (k, d)
        First points at which rays from the fix leave the region, metres. The rays follow the principal axes and the
        directions between them, in the coordinates in which the fix is Gaussian. In the plane they are in order around
        the fix. NaN for a ray that never leaves the region.
    cells : Cells, optional
        Cells that contain the region, of any shape and with any number of parts; bounds of the proof certify them.
    open : bool
        Whether the region has no end: infinity is as likely. Then only a direction (`cone`) and a least range are
        known.
    reason : str
        Why there are no cells; empty if there are some.

    Notes
    -----
    The region follows from measurements and priors only: inequalities reduce it further.
    """

    level: float
    surface: RegionSurface
    threshold: float
    points: Array
    cells: Cells | None
    open: bool
    reason: str = ""

    def covers(self, points: Array) -> Array:
        """Return flags (...) of positions (..., d), metres, that are in the region."""
        return np.asarray(self.surface.cost(np.asarray(points, dtype=float)) <= self.threshold)

    @property
    def box(self) -> tuple[Array, Array] | None:
        """Return the least and greatest coordinates (d,), m, of a box that contains the region; None without cells."""
        if self.cells is None:
            return None
        corners = self.cells.corners.reshape(-1, len(self.cells.base))
        return corners.min(0), corners.max(0)

    @property
    def cone(self) -> tuple[Array, float] | None:
        """Return axis (d,) and half-angle, radians, of a cone from the middle of the stations that contains the region.

        The angle is pi if the region surrounds the middle; None without cells.
        """
        if self.cells is None:
            return None
        away = self._seen_from_middle()
        axis = self.surface.chart.direction
        if self.cells.hold(self.surface.chart.centre[None])[0]:
            return axis, float(np.pi)
        mean = away.reshape(-1, len(axis)).mean(0)
        axis = mean / np.sqrt((mean**2).sum()) if (mean**2).sum() > 0.0 else axis
        half = float(np.arccos(np.clip((away @ axis).min(), -1.0, 1.0)))
        # Beyond a right angle the corners of a convex cell do not limit its directions.
        return axis, half if half < 0.5 * np.pi else float(np.pi)

    @property
    def least_range(self) -> float:
        """Return a lower bound of the distance from the middle of the stations, metres; 0 without cells."""
        if self.cells is None:
            return 0.0
        # Along the direction of its middle, no point of a convex cell is nearer than its corners.
        middle = self.cells.edges[:, 0]
        away = self.cells.base - self.surface.chart.centre + middle[:, :-1] / middle[:, -1:]
        size = np.sqrt((away**2).sum(-1, keepdims=True))
        toward = away / np.where(size > 0.0, size, 1.0)
        with np.errstate(invalid="ignore"):
            along = ((self.cells.corners - self.surface.chart.centre) * toward[:, None]).sum(-1)
        # A corner at infinity is beyond the middle, or other corners limit the range.
        return max(0.0, float(np.where(np.isfinite(along), along, np.inf).min()))

    def _seen_from_middle(self) -> Array:
        """Return the directions (n, 2^d, d) of the corners of all cells from the middle of the stations."""
        assert self.cells is not None
        away = self.cells.corners - self.surface.chart.centre
        away = np.where(np.isfinite(away).all(-1, keepdims=True), away, self.cells.directions)
        return np.asarray(away / np.sqrt((away**2).sum(-1, keepdims=True)))


def likelihood_region(problem: Problem, fix: Fix, level: float = 0.95, *, boxes: int | None = None) -> Region:
    """Return the region of positions that the data do not exclude at a level.

    Parameters
    ----------
    problem : Problem
        The problem of the fix: one static position.
    fix : Fix
        A single fix.
    level : float
        Probability that the region contains the target.
    boxes : int, optional
        Most cells that may contain the region; more are finer. By default 1 000 in the plane and 8 000 in space.

    Notes
    -----
    The region is ``{x: f(x) <= f(fix) + q}``, with q the quantile of chi-square for the number of coordinates: the
    likelihood-ratio region (S. S. Wilks, 1938). It covers at its level even if no Gaussian does, because curvature of
    the coordinates does not change it.
    """
    surface = RegionSurface.of(problem, fix)
    threshold = surface.least + quantile(level, len(surface.position))
    points = boundary(surface, threshold)
    cells, reaches, reason = _cover(surface, threshold, boxes)
    endless = reaches or bool(cost_at_infinity(surface.problem, surface.x)[0] <= threshold)
    return Region(level, surface, threshold, points, cells, endless, reason)


# Outer bound: certified cells.


def _cover(surface: RegionSurface, threshold: float, boxes: int | None) -> tuple[Cells | None, bool, str]:
    """Return cells that contain the region or None, whether a cell reaches infinity, and the reason for None or "".

    `surface` is the cost around the fix, and `threshold` the highest cost in the region. `boxes` is the largest number
    of cells, None for the default.
    """
    why = why_unsupported(surface.problem) or why_too_large(surface.problem)
    if why:
        return None, False, why
    costs = position_costs(surface.problem)
    cost, x = _without_unused_terms(costs.kinds, costs.data[0], costs.K[0], costs.w[0]), np.array(surface.position)
    box, d = empty_box(*cost.K.shape), len(x)
    most = boxes or (_MOST[d] if enabled() else _MOST_PLAIN)
    # `cover_region` writes these arrays; `ends` has the cost at infinity of each cell, infinite if the cell has an end
    base, edges, ends = np.zeros(3), np.zeros((2 * most, 1 + d, 1 + d)), np.zeros(2 * most)
    above, bent = threshold - surface.least, surface.kind != CARTESIAN
    count, inside, highest = cover_region(cost, box, x, above, most, bent, base, edges, ends)
    if costs.level[0] < highest:
        return None, False, TURNS
    if count < 0:
        return None, False, NOWHERE
    return Cells(base[:d], edges[:count], inside), bool((ends[:count] <= highest).any()), ""


def _without_unused_terms(kinds: Array, data: Array, K: Array, w: Array) -> Cost:
    """Return the cost without terms that no row contains: the tables of a proof need terms that count.

    The cost has the rows ``K phi = w``. The values phi of its terms follow from `kinds` and `data`.
    """
    used = (K != 0.0).any(0)
    rows = (K != 0.0).any(1) | (w != 0.0)
    return cost_of(*(np.ascontiguousarray(each) for each in (kinds[used], data[used], K[rows][:, used], w[rows])))


# Inner points: rays from the fix end at the edge of the region.

# Rays in the plane, with every eighth along an axis or a diagonal: enough to draw the outline of an ellipse.
_RAYS = 64
# Steps along a ray before the level is met, in units of the distance at which a Gaussian meets it: the first, the last,
# and the factor between two. The factor is small enough to notice every gap of a curved region that is as wide as its
# distance.
_FIRST, _LAST, _FACTOR = 0.05, 1e3, 1.2
# Halvings of the last step: down to the rounding of a double.
_HALVINGS = 50
# Least w of a ray in the inverse-range chart; zero is infinity.
_NEAR_INFINITY = 1e-6


def boundary(surface: RegionSurface, threshold: float) -> Array:
    """Return the first points (k, d), metres, at which rays from the fix leave the region; NaN for endless rays.

    `surface` is the cost around the fix, and `threshold` the highest cost in the region.
    """
    rays = directions(len(surface.position))
    q = np.sqrt(threshold - surface.least)
    count = int(np.ceil(np.log(_LAST / _FIRST) / np.log(_FACTOR)))
    ladder = q * _FIRST * _FACTOR ** np.arange(count + 1)
    # a ray starts at the fix, and its coordinate counts standard deviations
    start, steps = _axes(surface.chart)
    steps = rays @ steps.T
    limit = _limit(surface, steps)
    along = np.minimum(ladder, limit[:, None])
    costs = surface.cost(_points(surface, start + along[..., None] * steps[:, None]))
    above = np.asarray(costs > threshold)
    first = above.argmax(1)  # index of the first point above the threshold; 0 also for a ray without any
    ray = np.arange(len(rays))
    low, high = np.where(first > 0, along[ray, np.maximum(first - 1, 0)], 0.0), along[ray, first]
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        outside = np.asarray(surface.cost(_points(surface, start + middle[:, None] * steps)) > threshold)
        low, high = np.where(outside, low, middle), np.where(outside, middle, high)
    found = _points(surface, start + low[:, None] * steps)
    return np.where(np.asarray(above.any(1))[:, None], found, np.nan)


def directions(d: int) -> Array:
    """Return k unit vectors (k, d): 64 around the circle, or the axes of space and all their diagonals."""
    if d == 2:
        turn = 2.0 * np.pi * np.arange(_RAYS) / _RAYS
        return np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    every = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=d) if any(way)])
    return np.asarray(every / np.sqrt((every**2).sum(-1, keepdims=True)))


def _axes(chart: Chart) -> tuple[Array, Array]:
    """Return the fix (d,), and its principal standard deviations as columns (d, d), in its Gaussian coordinates."""
    inverse = int(chart.kind) == INVERSE_RANGE
    spread = chart.spread if inverse else chart.covariance
    values, vectors = np.linalg.eigh(spread)
    return chart.mean if inverse else chart.position, vectors * np.sqrt(np.maximum(values, 0.0))


def _points(surface: RegionSurface, at: Array) -> Array:
    """Return the positions (..., d), metres, of coordinates in which the fix is Gaussian."""
    return surface.chart.to_position(at) if surface.kind == INVERSE_RANGE else at


def _limit(surface: RegionSurface, steps: Array) -> Array:
    """Return the largest multiples (k,) of ray steps (k, d), at which a ray is close to infinity.

    In metres a ray has no limit, and the result is infinite.
    """
    if surface.kind != INVERSE_RANGE:
        return np.full(len(steps), np.inf)
    with np.errstate(divide="ignore"):
        return np.where(steps[:, -1] < 0.0, (_NEAR_INFINITY - 1.0) / steps[:, -1], np.inf)


# The cost around a fix, along rays.

# Evaluations of the cost per part: their normal equations take some megabytes.
_PART = 2**13


@dataclass(frozen=True, slots=True)
class RegionSurface:
    """The cost ``f(x)`` of one problem over the position, and the fix on it.

    Parameters
    ----------
    problem : Problem
        Flat batch of one, rows weighted as in the fix.
    x : array (1, size)
        All unknowns of the fix.
    chart : Chart
        Position, covariance, and the coordinates in which the fix is Gaussian.
    least : float
        Cost of the fix.
    """

    problem: Problem
    x: Array
    chart: Chart
    least: float

    @classmethod
    def of(cls, problem: Problem, fix: Fix) -> RegionSurface:
        """Return the surface of a single fix of one static position; raise InvalidProblem for other fixes."""
        _check(problem, fix)
        if not np.isfinite(fix.position).all() or not np.isfinite(fix.covariance()).all():
            raise InvalidProblem("the fix has no position with a covariance", "fix", "see fix.status for the reason")
        kind = None if fix.chart is None or int(fix.chart.kind) == CURVED else int(fix.chart.kind)
        surface = cls._about(problem, fix, fix.x, fix.cov, kind)
        law = None if fix.chart is None else fix.chart.truncated
        return replace(surface, chart=replace(surface.chart, truncated=law))

    @classmethod
    def at(cls, problem: Problem, fix: Fix, x: Array) -> RegionSurface:
        """Return the surface of another minimum x (size,) of the problem of a single fix."""
        _check(problem, fix)
        flat = problem.flat().with_rows(weight=fix.weights[None])
        cov, ok = covariance(equations_at(flat, x[None]))
        if not ok[0]:
            raise InvalidProblem(
                "another minimum has no covariance", "fix", "use `samples`, which ignores other minima"
            )
        return cls._about(problem, fix, x, cov[0], None)

    @classmethod
    def _about(cls, problem: Problem, fix: Fix, x: Array, cov: Array, kind: int | None) -> RegionSurface:
        """Return the surface of a minimum x (size,) from the covariance of its shared unknowns (n, n).

        `kind` is the kind of its chart, or None if it is not known yet.
        """
        flat, x = problem.flat().with_rows(weight=fix.weights[None]), x[None]
        slot, _ = problem.layout.find("position")
        part = slice(slot.start, slot.start + slot.size)
        if fix.chart is not None:
            centre = fix.chart.centre
        else:
            centre = centre_and_spread(problem.stations.places)[0].reshape(-1, slot.size)[0]
        if kind is None:
            metres, inverse = departure(flat, x, cov[None], (), centre[None])[0]
            kind = CARTESIAN if metres <= BENT else INVERSE_RANGE if inverse <= BENT else CURVED
        chart = Chart(np.asarray(kind, dtype=np.int8), x[0, part], cov[part, part], centre)
        return cls(flat, x, chart, float(profile(flat, x[None], x, passes(flat))[0][0, 0]))

    @property
    def kind(self) -> int:
        """Return the kind of the chart, for instance `optloc.problem.chart.INVERSE_RANGE`."""
        return int(self.chart.kind)

    @property
    def position(self) -> Array:
        """Return the position (d,) of the fix, metres."""
        return self.chart.position

    def look(self, points: Array) -> tuple[Array, Array, Array]:
        """Return the cost at points, and its normal equations.

        Parameters
        ----------
        points : array (..., d)
            Positions, metres; positions that are not finite have an infinite cost.

        Returns
        -------
        cost : array (...)
            Least weighted sum of squared residuals.
        information : array (..., d, d)
            Information of the position; the other unknowns are eliminated.
        vector : array (..., d)
            Half the negative gradient of the cost.
        """
        d = points.shape[-1]
        flat = np.ascontiguousarray(points).reshape(-1, d)
        good = np.isfinite(flat).all(-1)
        slot, _ = self.problem.layout.find("position")
        # points that are not finite are evaluated at the fix, and their cost is replaced below
        x = np.repeat(self.x, len(flat), axis=0)
        x[:, slot.start : slot.start + d] = np.where(good[:, None], flat, self.position)
        cost, information, vector = np.empty(len(x)), np.empty((len(x), d, d)), np.empty((len(x), d))
        for first in range(0, len(x), _PART):
            part = slice(first, first + _PART)
            found = profile(self.problem, x[part, None], self.x, passes(self.problem))
            cost[part], information[part], vector[part] = (each[:, 0] for each in found)
        shape = points.shape[:-1]
        cost = np.where(good & np.isfinite(cost), cost, np.inf)
        return cost.reshape(shape), information.reshape(*shape, d, d), vector.reshape(*shape, d)

    def cost(self, points: Array) -> Array:
        """Return the cost (...) at points (..., d), metres."""
        return self.look(points)[0]


def passes(problem: Problem) -> int:
    """Return the number of Gauss-Newton steps of the other unknowns.

    They are linear, so one step reaches their best values. Far from the fix the step is long, and a second one removes
    its rounding errors.
    """
    return 1 if problem.layout.size == problem.dimension else 2


def _check(problem: Problem, fix: Fix) -> None:
    """Raise InvalidProblem unless the fix is a single fix of one static position without equalities."""
    advice = "take one fix of a batch: `problem.flat().take([i])` and `fix.flat()[i]`"
    if fix.shape != () or int(np.prod(problem.batch_shape)) != 1:
        raise InvalidProblem("a region or samples need a single fix, and this is a batch", "fix", advice)
    motion = problem.motions[0]
    shared = problem.layout.shares("position")
    if len(problem.motions) > 1 or motion.order > 0 or motion.known is not None or not shared:
        what = "a region or samples need one target at rest"
        raise InvalidProblem(what, "problem", "use fix.ellipse() or fix.gaussian() for other problems")
    if exact(problem):
        raise InvalidProblem(
            "an equality, such as a known height, holds the position, and regions do not support equalities",
            "problem",
            "give the height as a prior with its standard deviation",
        )
