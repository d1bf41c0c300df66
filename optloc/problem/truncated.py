"""The truncated normal distribution of a position whose fix is at a bound or near it.

Without bounds the distribution is ``N(x + shift, covariance)``. It is truncated to the admitted points. The fix x is
the admitted point of highest density. The distribution is integrated along rays from the fix, each up to the first
bound. Regions and intervals have the highest density, because an interval with equal tails never contains a target on
the bound. Where the admitted points are no intersection of half-spaces, a function tests the points. A ray can then
have several admitted parts, and each part counts as a separate ray.

Letters: h bounds, d coordinates, k rays, n nodes on a ray. The squared deviation of a point is its squared distance
from x + shift, in standard deviations. The excess of a point is its squared deviation minus the squared deviation of
the fix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, NamedTuple

import numpy as np

from optloc.base.linalg import factor_semidefinite, spread_directions
from optloc.base.records import Axes, present, take
from optloc.base.types import Array

HELD = 1e-13
"""Share of the largest variance below which a variance is rounding error: an equality fixes that direction."""

# Number of rays by dimension: the error of a probability is below 0.2 %, the error of a moment below 1 %.
_RAYS = {2: 360, 3: 2500}
# The same for rays on which the admitted parts are searched, which takes longer: errors are twice as large.
_SEARCHED = {2: 240, 3: 800}
# Number of nodes on a ray, and increase of the squared deviation at its end: 45 neglects a probability of 1e-10.
_NODES, _END = 16, 45.0
# Number of nodes on a ray for sorted values, and the share by which they shift from ray to ray (golden section).
_SPREAD, _GOLDEN = 48, 0.6180339887498949
# Numbers of rays and of nodes on a ray, by dimension, for the probability of any region: the error is below 0.001.
_FINE = {1: (2, 2**15), 2: (720, 96), 3: (2500, 96)}
# Number of thresholds in the table of enclosed probability, between which it is interpolated.
_LEVELS = 96
# Number of candidate intervals among which the shortest is selected.
_STARTS = 200
# Departure of a surface from its tangent plane, as a share of the distance: 0.8 % for the Earth at 100 km. Second:
# metres that are rounding error of coordinates with the size of the Earth.
_BENT, _ROUNDED = 0.02, 1e-3
# Speed at which a ray approaches a bound, relative to its step, below which the ray counts as parallel.
_EXACT = 1e-12
# Relative difference of widths below which intervals count as equally short: the accuracy of the nodes.
_ALIKE = 0.01
# Points on a ray at which admitted parts are looked for, and halvings of the interval that contains an end of a part.
_TRIED, _HALVINGS = 48, 20
# Length of a step, in steps, up to which the first bound is looked for: the density ends before.
_FAR = 10.0
# Relative extension of polygon edges, so that a ray through a corner meets one of the two edges.
_LONGER = 1e-9
# Standard deviations by which a point may exceed a plane bound and still count as admitted: rounding of coordinates.
_ON = 1e-6


@dataclass(frozen=True, slots=True)
class Truncated:
    """Normal distributions of positions, truncated at h bounds.

    Parameters
    ----------
    normal : array (..., h, d)
        Unit normals of the bounds, directed to the points that they exclude; zero for unused entries.
    slack : array (..., h)
        Distance of the fix from each bound along its normal, metres; infinite for unused entries.
    along : array (..., h, d)
        Unit vectors along the edges of polygons; zero for bounds without ends.
    span : array (..., h, 2)
        Ends of the edges along these vectors, metres from the fix; infinite for bounds without ends.
    give : array (..., h)
        Greatest distance of a curved bound from its plane, metres.
    shift : array (..., d)
        Mean of the distribution without bounds minus the fix, metres.
    covariance : array (..., d, d)
        Covariance of the distribution without bounds, square metres.
    region : object array (...), optional
        For distributions whose bounds are no planes: functions that map points (..., d), metres from the fix, to flags
        (...) of the admitted ones. None for the others. With such a function, planes serve the shape of the cost only.
        Their method ``within_rounding`` returns the flags with points on a boundary admitted.
    """

    normal: Annotated[Array, Axes(2, slots=True, empty=0.0)]
    slack: Annotated[Array, Axes(1, slots=True, empty=np.inf)]
    along: Annotated[Array, Axes(2, slots=True, empty=0.0)]
    span: Annotated[Array, Axes(2, slots=True, empty=np.inf)]
    give: Annotated[Array, Axes(1, slots=True, empty=0.0)]
    shift: Annotated[Array, Axes(1, empty=0.0)]
    covariance: Annotated[Array, Axes(2)]
    region: Annotated[Array, Axes(0, empty=None)] | None = None

    @property
    def cuts(self) -> Array:
        """Return a mask (...) of the distributions that a bound truncates."""
        bounded = np.isfinite(self.slack).any(-1) | self._has_region
        return np.asarray(bounded & np.isfinite(self.covariance).all((-1, -2)))

    @property
    def _has_region(self) -> Array:
        """Return a mask (...) of the distributions with a function for the admitted points."""
        if self.region is None:
            return np.zeros(self.slack.shape[:-1], dtype=bool)
        return present(np.atleast_1d(self.region)).reshape(self.slack.shape[:-1])

    def moments(self) -> tuple[Array, Array]:
        """Return mean minus fix (..., d), metres, and covariance (..., d, d), m^2, of truncated distributions.

        One bound without ends has a closed form. All other distributions are integrated along rays.

        References
        ----------
        G. M. Tallis, "The moment generating function of the truncated multi-normal distribution" (1961), for one bound.
        """
        mean, covariance = _moments_behind_one_bound(self)
        finite = np.isfinite(self.slack)
        # Distributions with several bounds, or with a bound that has ends: the edge of a polygon.
        several = self._has_region | (finite.sum(-1) != 1)
        several = several | np.isfinite(np.where(finite[..., None], self.span, np.inf)).any((-1, -2))
        for i in zip(*np.nonzero(np.atleast_1d(several & self.cuts)), strict=True):
            if several.ndim:
                index = tuple(map(int, i))
                mean[index], covariance[index] = take(self, index).moments_by_rays()
            else:  # `region` is the function itself then, no array of functions
                mean[...], covariance[...] = self.moments_by_rays()
        return mean, covariance

    def moments_by_rays(self) -> tuple[Array, Array]:
        """Return the moments of one distribution with any bounds: mean minus fix (d,) and covariance (d, d).

        The units are metres and square metres.
        """
        rays = self._rays()
        weight = rays.weight / rays.weight.sum()
        mean = (weight[..., None] * rays.place).sum((0, 1))
        away = rays.place - mean
        return mean, np.einsum("kn,kni,knj->ij", weight, away, away)

    def distance_squared(self, points: Array) -> Array:
        """Return the chi-square value (...) of the highest-density region whose edge contains points (..., d).

        Call it for one distribution. Points are in metres from the fix. The value is infinite for points that a bound
        excludes.
        """
        from scipy.special import gammaincinv

        rays, d = self._rays(), points.shape[-1]
        # Squared deviation of the fix. The excess of a point is its squared deviation minus this value.
        least = float((rays.middle**2).sum())
        away = (points - self.shift) @ rays.whitener.T
        excess = np.maximum((away**2).sum(-1) - least, 0.0)
        level = np.interp(np.sqrt(excess), *rays.levels())
        value = np.where(level < 1.0, 2.0 * gammaincinv(d / 2, np.minimum(level, 1.0 - 1e-16)), np.inf)
        return np.where(self.admits(points) & is_along(rays.projector, points), value, np.inf)

    def admits(self, points: Array) -> Array:
        """Return a mask (...) of the points (..., d), metres from the fix of one distribution, inside the bounds."""
        if self.region is not None:
            return np.asarray(self._test.within_rounding(points))
        sigma = np.sqrt(np.maximum(np.einsum("hi,ij,hj->h", self.normal, self.covariance, self.normal), 0.0))
        beyond = points @ self.normal.T - np.where(np.isfinite(self.slack), self.slack, 0.0)
        outside = np.isfinite(self.slack) & (beyond > self.give + _ON * sigma)
        position_on_edge = points @ self.along.T
        # An edge bounds only the points between its ends.
        return np.asarray(
            ~(outside & (position_on_edge >= self.span[:, 0]) & (position_on_edge <= self.span[:, 1])).any(-1)
        )

    def interval(self, number: Callable[[Array], Array], level: float) -> tuple[float, float]:
        """Return the shortest interval that contains a quantity of one distribution with a given probability.

        Parameters
        ----------
        number : callable
            Maps points (..., d), metres from the fix, to values (...).
        level : float
            Probability of the interval.
        """
        rays = self._rays()
        # Values at the fix and at the ends of the rays: they extend the table of values up to the bounds.
        ends = number(np.concatenate([np.zeros((1, len(self.shift))), rays.tip]))
        points, weight = rays.spread()
        values, weight = number(points).ravel(), weight.ravel()
        # Table of the distribution function: sorted values, each with the probability below it plus half of its weight.
        order = np.argsort(values)
        cumulative = np.cumsum(weight[order])
        cumulative = (cumulative - 0.5 * weight[order]) / cumulative[-1]
        sorted_values = values[order]
        probabilities = np.concatenate([[0.0], cumulative, [1.0]])
        sorted_values = np.concatenate(
            [[min(sorted_values[0], ends.min())], sorted_values, [max(sorted_values[-1], ends.max())]]
        )
        # Candidate intervals: `first` is the probability below the lower end.
        first = np.linspace(0.0, 1.0 - level, _STARTS)
        low, high = (
            np.interp(first, probabilities, sorted_values),
            np.interp(first + level, probabilities, sorted_values),
        )
        width = high - low
        best = int(np.argmin(width))
        for end in (0, -1):  # if several are about equally short, take one at a bound
            best = end if width[end] <= (1.0 + _ALIKE) * width.min() and np.isin(sorted_values[end], ends) else best
        return float(low[best]), float(high[best])

    def draw(self, n: int, seed: int) -> tuple[Array, Array]:
        """Return n random points (n, d) of one distribution, metres from the fix, and their excesses (n,).

        The points are a systematic resampling of nodes on the rays; `seed` determines its start.
        """
        rays = self._rays()
        nodes, weight = rays.spread()
        share = np.cumsum(weight.ravel())
        targets = (np.random.default_rng(seed).random() + np.arange(n)) / n * share[-1]
        chosen = np.searchsorted(share, targets).clip(max=share.size - 1)
        points = nodes.reshape(-1, nodes.shape[-1])[chosen]
        away = (points - self.shift) @ rays.whitener.T
        return points, (away**2).sum(-1) - (rays.middle**2).sum()

    def nodes(self) -> tuple[Array, Array]:
        """Return fixed points (p, d) of one distribution, metres from the fix, and weights (p,), not normalised."""
        rank = factor_of(self.covariance).shape[1]
        if not rank:  # an exact position
            return np.zeros((1, len(self.shift))), np.ones(1)
        count, nodes = _FINE[rank]
        points, weight = self._rays(count).spread(nodes)
        return points.reshape(-1, points.shape[-1]), weight.ravel()

    def outline(self, plane: Array, level: float) -> Array:
        """Return the closed boundary (r, 2) of the highest-density region in a plane, metres from the fix.

        In three dimensions it is the projection of the region. It contains the two coordinates with a higher
        probability.

        Parameters
        ----------
        plane : array (2, d)
            Orthogonal unit vectors.
        level : float
            Probability of the region.
        """
        from scipy.spatial import ConvexHull

        rays = self._rays()
        excess = float(np.interp(level, *rays.levels()[::-1])) ** 2
        # At the length s of a ray the excess is s^2 - 2 lean s. Solve for s; a ray that ends earlier keeps its end.
        share = np.minimum(1.0, (rays.lean + np.sqrt(rays.lean**2 + excess)) / np.maximum(rays.length, 1e-300))
        # parts of the region that the fix does not see have no place in one closed line
        seen = rays.begin <= 0.0
        points = (rays.tip * share[:, None])[seen] @ plane.T
        # In two dimensions the rays are sorted by angle.
        boundary = points if plane.shape[1] == 2 else points[ConvexHull(points).vertices]
        return np.concatenate([boundary, boundary[:1]])

    def _rays(self, count: int | None = None) -> _Rays:
        """Return one distribution in polar coordinates around its fix, with quadrature nodes on each ray.

        `count` is the number of rays; None for the number of moments and regions.
        """
        factor = factor_of(self.covariance)
        rank = factor.shape[1]
        whitener = np.linalg.solve(factor.T @ factor, factor.T)
        # Rays whose admitted parts are searched cost more, so there are fewer.
        usual = _RAYS if self.region is None else _SEARCHED
        unit, middle = _directions(rank, count or usual.get(rank, 2)), whitener @ self.shift
        step, lean = unit @ factor.T, unit @ middle
        # A ray ends where the squared deviation has increased by `_END`.
        length = lean + np.sqrt(lean**2 + _END)
        if self.region is None:
            length = np.minimum(self.exits(step), length)
            begin = np.zeros_like(length)
        else:
            number, begin, length = self._parts(step, length)
            step, lean = step[number], lean[number]
        node, share = _gauss()
        at = begin[:, None] + (length - begin)[:, None] * node
        weight = share * (length - begin)[:, None] * _density(at, lean[:, None], rank)
        place, tip = at[..., None] * step[:, None], length[:, None] * step
        return _Rays(lean, begin, length, rank, middle, whitener, factor @ whitener, place, tip, weight)

    @property
    def _test(self) -> Any:
        """Return the function of one distribution that tests points."""
        # One distribution taken out of a batch has its function in an array without axes.
        return self.region[()] if isinstance(self.region, np.ndarray) else self.region

    def _inside(self, points: Array) -> Array:
        """Return flags (...) of admitted points (..., d), metres from the fix, by the function of one distribution."""
        return np.asarray(self._test(points))

    def _parts(self, step: Array, length: Array) -> tuple[Array, Array, Array]:
        """Return the admitted parts of rays: the number of the ray of each, and its begin and end in steps.

        `step` (k, d) are the steps of the rays, metres, and `length` (k,) the numbers of steps at which they end.
        """
        shares = np.linspace(0.0, 1.0, _TRIED + 1)
        inside = self._inside((length[:, None] * shares)[..., None] * step[:, None])
        inside[:, 0] = True  # the fix, whatever rounding says
        ray, cell = np.nonzero(inside[:, 1:] != inside[:, :-1])
        low, high, enters = shares[cell], shares[cell + 1], inside[ray, cell + 1]
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            same = self._inside((length[ray] * middle)[:, None] * step[ray]) == enters
            low, high = np.where(same, low, middle), np.where(same, middle, high)
        # every ray begins inside, so that begins and ends alternate on it
        every = np.arange(len(step))
        begins = np.concatenate([every, ray[enters]]), np.concatenate([np.zeros(len(step)), high[enters]])
        last = np.flatnonzero(inside[:, -1])
        ends = np.concatenate([ray[~enters], last]), np.concatenate([low[~enters], np.ones(len(last))])
        first, final = (np.lexsort((at, number)) for number, at in (begins, ends))
        number = begins[0][first]
        return number, begins[1][first] * length[number], ends[1][final] * length[number]

    def exits(self, step: Array) -> Array:
        """Return the number (k,) of steps (k, d), metres, from the fix to the first bound; infinite without a bound.

        The number is not an integer: 2.5 means that the bound is 2.5 times the step away.
        """
        if self.region is not None:
            number, _, end = self._parts(step, np.full(len(step), _FAR))
            # a direction inwards may leave the region at its beginning, by rounding: the longest part then counts
            out = np.zeros(len(step))
            np.maximum.at(out, number, end)
            return np.where(out < _FAR, out, np.inf)
        rate, size = step @ self.normal.T, np.sqrt((step**2).sum(-1, keepdims=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            length = np.where(rate > _EXACT * size, np.maximum(self.slack, 0.0) / rate, np.inf)
            position_on_edge = np.where(np.isfinite(length), length, 0.0) * (step @ self.along.T)
        tolerance = _LONGER * np.where(np.isfinite(self.span), np.abs(self.span), 0.0).sum(-1)
        meets = (position_on_edge >= self.span[:, 0] - tolerance) & (position_on_edge <= self.span[:, 1] + tolerance)
        return np.asarray(np.where(meets & ~np.isnan(length), length, np.inf).min(-1, initial=np.inf))


class _Rays(NamedTuple):
    """One truncated distribution in polar coordinates around its fix, on k rays.

    Parameters
    ----------
    lean : array (k,)
        Mean of the distribution without bounds along each ray, in standard deviations.
    begin : array (k,)
        Distance from the fix at which each ray begins, in standard deviations; zero except for separate parts.
    length : array (k,)
        Distance from the fix at which each ray ends, in standard deviations.
    rank : int
        Number of dimensions in which the distribution has a width.
    middle : array (rank,)
        Mean of the distribution without bounds, in standard deviations.
    whitener : array (rank, d)
        Matrix that converts metres to standard deviations.
    projector : array (d, d)
        Projector onto the directions in which the distribution has a width.
    place : array (k, n, d)
        Nodes, metres from the fix.
    tip : array (k, d)
        Ends of the rays, metres from the fix.
    weight : array (k, n)
        Weights of the nodes.
    """

    lean: Array
    begin: Array
    length: Array
    rank: int
    middle: Array
    whitener: Array
    projector: Array
    place: Array
    tip: Array
    weight: Array

    def spread(self, nodes: int = _SPREAD) -> tuple[Array, Array]:
        """Return other nodes (k, n, d), metres from the fix, and their weights (k, n), at other lengths on each ray.

        `nodes` is the number n of nodes on a ray.

        With the same lengths on all rays, values at the nodes form clusters, and the ends of a shortest interval would
        be between clusters.
        """
        k = np.arange(len(self.length))[:, None]
        node = (np.arange(nodes) + k * _GOLDEN % 1.0) / nodes
        size = (self.length - self.begin)[:, None]
        at = self.begin[:, None] + size * node
        share = at / np.maximum(self.length[:, None], 1e-300)
        return self.tip[:, None] * share[..., None], size * _density(at, self.lean[:, None], self.rank)

    def levels(self) -> tuple[Array, Array]:
        """Return thresholds (t,) and the probabilities (t,) of the regions that they enclose, both increasing.

        A threshold is the square root of an excess.
        """
        grid = np.linspace(0.0, np.sqrt(_END), _LEVELS)
        mass = np.array([self._mass(one) for one in grid**2])
        return grid, mass / mass[-1]

    def _mass(self, excess: float) -> float:
        """Return the unnormalised probability of points whose excess is at most `excess`."""
        end = np.minimum(self.length, self.lean + np.sqrt(self.lean**2 + excess))
        size, (node, share) = np.maximum(end - self.begin, 0.0)[:, None], _gauss()
        at = self.begin[:, None] + size * node
        return float((share * size * _density(at, self.lean[:, None], self.rank)).sum())


def is_along(projector: Array, points: Array) -> Array:
    """Return a mask (...) of the points (..., d), metres from a fix, near the surface of its equality constraints.

    `projector` (..., d, d) projects onto the tangent plane. The tolerance allows for a surface as curved as the Earth.
    """
    within = (projector * points[..., None, :]).sum(-1)
    off = np.sqrt(((points - within) ** 2).sum(-1))
    return np.asarray(off <= _BENT * np.sqrt((within**2).sum(-1)) + _ROUNDED)


def _moments_behind_one_bound(distribution: Truncated) -> tuple[Array, Array]:
    """Return mean minus fix (..., d) and covariance (..., d, d) of distributions truncated at their first bound.

    The units are metres and square metres. Only the first bound of each distribution counts.
    """
    from scipy.special import log_ndtr

    first = np.isfinite(distribution.slack).argmax(-1)[..., None]
    normal = np.take_along_axis(distribution.normal, first[..., None], axis=-2)[..., 0, :]
    slack = np.take_along_axis(distribution.slack, first, axis=-1)[..., 0]
    across = (distribution.covariance * normal[..., None, :]).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.sqrt((across * normal).sum(-1))
        bound = (slack - (normal * distribution.shift).sum(-1)) / sigma
        # Density divided by probability, of a standard normal variable below `bound`.
        hazard = np.exp(-0.5 * bound**2 - 0.5 * np.log(2.0 * np.pi) - log_ndtr(bound))
        unit = across / sigma[..., None]
        mean = distribution.shift - hazard[..., None] * unit
        reduction = hazard * (bound + hazard)
        return mean, distribution.covariance - reduction[..., None, None] * unit[..., :, None] * unit[..., None, :]


def factor_of(covariance: Array) -> Array:
    """Return a matrix F (d, rank) with F F' = covariance (d, d), which may be singular.

    F converts `rank` independent standard normal numbers to a displacement in metres.
    """
    lower = factor_semidefinite(covariance)
    return np.asarray(lower[:, np.diagonal(lower) ** 2 > HELD * np.trace(covariance)])


def _density(length: Array, lean: Array, rank: int) -> Array:
    """Return the density at lengths along rays, relative to the density at the fix, times the volume element.

    Lengths are in standard deviations. `lean` is the mean of the distribution without bounds along the ray. The volume
    element of `rank` dimensions is length to the power rank - 1.
    """
    return np.asarray(length ** (rank - 1) * np.exp(length * (lean - 0.5 * length)))


@lru_cache(maxsize=1)
def _gauss() -> tuple[Array, Array]:
    """Return the nodes and weights of Gauss-Legendre quadrature between 0 and 1."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    return 0.5 * (node + 1.0), 0.5 * weight


@lru_cache(maxsize=8)
def _directions(rank: int, count: int) -> Array:
    """Return evenly distributed unit vectors (k, rank), the directions of the rays: `count`, or two on a line."""
    return np.array([[-1.0], [1.0]])[:, :rank] if rank <= 1 else spread_directions(count, rank)
