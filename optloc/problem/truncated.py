"""The truncated normal law of a position whose fix is at a bound or near it.

The law of the fix without its bounds is ``N(x + shift, covariance)``. It is limited to the admitted points. The fix x
is the admitted point of the highest density. Seen from it the law is integrated along rays, each up to the first
bound. Regions and intervals are of highest density: one with equal tails would never hold a target on the bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np

from optloc.base.linalg import factor_semidefinite, spread_directions
from optloc.base.records import Axes, take
from optloc.base.types import Array

HELD = 1e-13
"""Share of the largest variance below which a variance is rounding: an equality holds that direction."""

# Rays by the number of dimensions that the law has: the error of a probability is below 0.2 %, of a moment below 1 %.
_RAYS = {2: 360, 3: 2500}
# Nodes along a ray, and by how much the squared deviation grows along it: 45 leaves out 1e-10.
_NODES, _END = 16, 45.0
# Nodes along a ray where numbers are sorted, and the share by which these differ from ray to ray (the golden section).
_SPREAD, _GOLDEN = 48, 0.6180339887498949
# Thresholds at which the mass inside is tabulated: between them it is interpolated.
_LEVELS = 96
# Starts of intervals that are compared for the shortest.
_STARTS = 200
# Departure of a surface from its tangent plane, as a share of the distance: the Earth's at 100 km is 0.8 %. And metres
# that are rounding of coordinates of its size.
_BENT, _ROUNDED = 0.02, 1e-3
# Rate at which a ray nears a bound, as a share of its step, below which it runs along it.
_EXACT = 1e-12
# Share of their width by which intervals may differ and count as alike: what the nodes leave open.
_ALIKE = 0.01
# Share of its length by which an edge is lengthened: a ray through a corner meets one of its edges.
_LONGER = 1e-9
# Deviations by which a point may lie beyond a plane bound and count as on it: rounding of coordinates.
_ON = 1e-6


@dataclass(frozen=True, slots=True)
class Truncated:
    """Normal laws of positions, cut off at h bounds.

    Parameters
    ----------
    normal : array (..., h, d)
        Unit vectors out of what each bound admits; zero for none.
    slack : array (..., h)
        Distance of the fix from each bound along its normal, metres; infinite for none.
    along : array (..., h, d)
        Unit vectors along edges of polygons; zero for bounds without ends.
    span : array (..., h, 2)
        Ends of the edges along these, metres from the fix; infinite for bounds without ends.
    give : array (..., h)
        Distance by which a curved bound departs from its plane, metres.
    shift : array (..., d)
        Mean of the law without bounds, less the fix, metres.
    covariance : array (..., d, d)
        Of the law without bounds, square metres.
    """

    normal: Annotated[Array, Axes(2, slots=True, empty=0.0)]
    slack: Annotated[Array, Axes(1, slots=True, empty=np.inf)]
    along: Annotated[Array, Axes(2, slots=True, empty=0.0)]
    span: Annotated[Array, Axes(2, slots=True, empty=np.inf)]
    give: Annotated[Array, Axes(1, slots=True, empty=0.0)]
    shift: Annotated[Array, Axes(1, empty=0.0)]
    covariance: Annotated[Array, Axes(2)]

    @property
    def cuts(self) -> Array:
        """Return a flag (...) for each law that a bound cuts off."""
        return np.asarray(np.isfinite(self.slack).any(-1) & np.isfinite(self.covariance).all((-1, -2)))

    def moments(self) -> tuple[Array, Array]:
        """Return mean less fix (..., d), metres, and covariance (..., d, d), square metres, of cut-off laws.

        References
        ----------
        G. M. Tallis, "The moment generating function of the truncated multi-normal distribution" (1961), for one bound.
        """
        mean, covariance = _behind_one(self)
        finite = np.isfinite(self.slack)
        several = (finite.sum(-1) != 1) | np.isfinite(np.where(finite[..., None], self.span, np.inf)).any((-1, -2))
        for i in zip(*np.nonzero(np.atleast_1d(several & self.cuts)), strict=True):
            index = tuple(map(int, i)) if several.ndim else ()
            mean[index], covariance[index] = take(self, index).moments_by_rays()
        return mean, covariance

    def moments_by_rays(self) -> tuple[Array, Array]:
        """Return the moments of one law, whatever its bounds."""
        rays = self._rays()
        weight = rays.weight / rays.weight.sum()
        mean = (weight[..., None] * rays.place).sum((0, 1))
        away = rays.place - mean
        return mean, np.einsum("kn,kni,knj->ij", weight, away, away)

    def distance_squared(self, points: Array) -> Array:
        """Return the chi-square value (...) of the region of highest density through points (..., d) from the fix.

        One law; infinite for points that a bound does not admit.
        """
        from scipy.special import gammaincinv

        rays, d = self._rays(), points.shape[-1]
        least = float((rays.middle**2).sum())
        away = (points - self.shift) @ rays.whitener.T
        excess = np.maximum((away**2).sum(-1) - least, 0.0)
        level = np.interp(np.sqrt(excess), *rays.levels())
        value = np.where(level < 1.0, 2.0 * gammaincinv(d / 2, np.minimum(level, 1.0 - 1e-16)), np.inf)
        return np.where(self.admits(points) & is_along(rays.projector, points), value, np.inf)

    def admits(self, points: Array) -> Array:
        """Return a flag (...) for points (..., d), metres from the fix of one law, that the bounds admit."""
        sigma = np.sqrt(np.maximum(np.einsum("hi,ij,hj->h", self.normal, self.covariance, self.normal), 0.0))
        beyond = points @ self.normal.T - np.where(np.isfinite(self.slack), self.slack, 0.0)
        outside = np.isfinite(self.slack) & (beyond > self.give + _ON * sigma)
        where = points @ self.along.T
        # beyond its ends the line of an edge bounds nothing
        return np.asarray(~(outside & (where >= self.span[:, 0]) & (where <= self.span[:, 1])).any(-1))

    def interval(self, number: Callable[[Array], Array], level: float) -> tuple[float, float]:
        """Return the shortest interval that holds a number of one law with a given probability.

        Parameters
        ----------
        number : callable
            Maps points (..., d), metres from the fix, to numbers (...).
        level : float
            Probability.
        """
        rays = self._rays()
        ends = number(np.concatenate([np.zeros((1, len(self.shift))), rays.tip]))
        place, weight = rays.spread()
        values, weight = number(place).ravel(), weight.ravel()
        order = np.argsort(values)
        share = np.cumsum(weight[order])
        share = (share - 0.5 * weight[order]) / share[-1]
        inner = values[order]
        shares = np.concatenate([[0.0], share, [1.0]])
        inner = np.concatenate([[min(inner[0], ends.min())], inner, [max(inner[-1], ends.max())]])
        first = np.linspace(0.0, 1.0 - level, _STARTS)
        low, high = np.interp(first, shares, inner), np.interp(first + level, shares, inner)
        width = high - low
        best = int(np.argmin(width))
        for end in (0, -1):  # among alike ones the interval that reaches a bound
            best = end if width[end] <= (1.0 + _ALIKE) * width.min() and np.isin(inner[end], ends) else best
        return float(low[best]), float(high[best])

    def draw(self, n: int, seed: int) -> tuple[Array, Array]:
        """Return n points (n, d) of one law, metres from the fix, and excesses (n,).

        The excess of a point is its squared deviation minus the squared deviation of the fix. The draw is a systematic
        resampling of nodes along the rays; `seed` decides its start.
        """
        rays = self._rays()
        place, weight = rays.spread()
        share = np.cumsum(weight.ravel())
        at = (np.random.default_rng(seed).random() + np.arange(n)) / n * share[-1]
        chosen = np.searchsorted(share, at).clip(max=share.size - 1)
        points = place.reshape(-1, place.shape[-1])[chosen]
        away = (points - self.shift) @ rays.whitener.T
        return points, (away**2).sum(-1) - (rays.middle**2).sum()

    def outline(self, plane: Array, level: float) -> Array:
        """Return the closed boundary (r, 2) of the region of highest density in a plane, metres from the fix.

        In space it is the shadow of the region, which holds the two coordinates with more than the probability.

        Parameters
        ----------
        plane : array (2, d)
            Unit vectors at right angles.
        level : float
            Probability.
        """
        from scipy.spatial import ConvexHull

        rays = self._rays()
        excess = float(np.interp(level, *rays.levels()[::-1])) ** 2
        share = np.minimum(1.0, (rays.lean + np.sqrt(rays.lean**2 + excess)) / np.maximum(rays.length, 1e-300))
        points = (rays.tip * share[:, None]) @ plane.T
        # rays in a plane come in the order of their angles
        line = points if plane.shape[1] == 2 else points[ConvexHull(points).vertices]
        return np.concatenate([line, line[:1]])

    def _rays(self) -> _Rays:
        factor = factor_of(self.covariance)
        rank = factor.shape[1]
        whitener = np.linalg.solve(factor.T @ factor, factor.T)
        unit, middle = _directions(rank), whitener @ self.shift
        step, lean = unit @ factor.T, unit @ middle
        # a ray ends where the squared deviation has grown to `_END`
        length = np.minimum(self.exits(step), lean + np.sqrt(lean**2 + _END))
        node, share = _gauss()
        weight = share * length[:, None] * _density(length[:, None] * node, lean[:, None], rank)
        tip = length[:, None] * step
        place = tip[:, None] * node[:, None]
        return _Rays(lean, length, rank, middle, whitener, factor @ whitener, place, tip, weight)

    def exits(self, step: Array) -> Array:
        """Return the number (k,) of steps (k, d) from the fix to the first bound; infinite without one."""
        rate, size = step @ self.normal.T, np.sqrt((step**2).sum(-1, keepdims=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            length = np.where(rate > _EXACT * size, np.maximum(self.slack, 0.0) / rate, np.inf)
            where = np.where(np.isfinite(length), length, 0.0) * (step @ self.along.T)
        slip = _LONGER * np.where(np.isfinite(self.span), np.abs(self.span), 0.0).sum(-1)
        meets = (where >= self.span[:, 0] - slip) & (where <= self.span[:, 1] + slip)
        return np.asarray(np.where(meets & ~np.isnan(length), length, np.inf).min(-1, initial=np.inf))


class _Rays(NamedTuple):
    """One law in polar coordinates about its fix, on its k rays.

    Parameters
    ----------
    lean : array (k,)
        Mean of the law without bounds along each ray, deviations.
    length : array (k,)
        Of each ray, deviations.
    rank : int
        Dimensions in which the law has a width.
    middle : array (rank,)
        Mean of the law without bounds, deviations.
    whitener : array (rank, d)
        From metres to deviations.
    projector : array (d, d)
        Onto the directions in which the law has a width.
    place : array (k, n, d)
        Nodes, metres from the fix.
    tip : array (k, d)
        Ends of the rays, metres from the fix.
    weight : array (k, n)
        Of the nodes.
    """

    lean: Array
    length: Array
    rank: int
    middle: Array
    whitener: Array
    projector: Array
    place: Array
    tip: Array
    weight: Array

    def spread(self) -> tuple[Array, Array]:
        """Return places (k, n, d), metres from the fix, and their weights (k, n), at other lengths on each ray.

        Numbers of nodes at the same lengths come in clusters, and a shortest interval would end between these.
        """
        k = np.arange(len(self.length))[:, None]
        node = (np.arange(_SPREAD) + k * _GOLDEN % 1.0) / _SPREAD
        weight = self.length[:, None] * _density(self.length[:, None] * node, self.lean[:, None], self.rank)
        return self.tip[:, None] * node[..., None], weight

    def levels(self) -> tuple[Array, Array]:
        """Return thresholds (t,) and the probabilities within.

        A threshold is the root of a squared deviation less the squared deviation of the fix.
        """
        grid = np.linspace(0.0, np.sqrt(_END), _LEVELS)
        mass = np.array([self._mass(one) for one in grid**2])
        return grid, mass / mass[-1]

    def _mass(self, excess: float) -> float:
        end = np.minimum(self.length, self.lean + np.sqrt(self.lean**2 + excess))[:, None]
        node, share = _gauss()
        return float((share * end * _density(end * node, self.lean[:, None], self.rank)).sum())


def is_along(projector: Array, points: Array) -> Array:
    """Return a flag for points (..., d), metres from a fix, near the surface of the equalities that hold it, (...).

    `projector` (..., d, d) projects onto the tangent plane; a surface may depart from its plane as the Earth does.
    """
    within = (projector * points[..., None, :]).sum(-1)
    off = np.sqrt(((points - within) ** 2).sum(-1))
    return np.asarray(off <= _BENT * np.sqrt((within**2).sum(-1)) + _ROUNDED)


def _behind_one(law: Truncated) -> tuple[Array, Array]:
    """Return mean less fix (..., d) and covariance (..., d, d) of laws that the first of their bounds cuts off."""
    from scipy.special import log_ndtr

    first = np.isfinite(law.slack).argmax(-1)[..., None]
    normal = np.take_along_axis(law.normal, first[..., None], axis=-2)[..., 0, :]
    slack = np.take_along_axis(law.slack, first, axis=-1)[..., 0]
    across = (law.covariance * normal[..., None, :]).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.sqrt((across * normal).sum(-1))
        away = (slack - (normal * law.shift).sum(-1)) / sigma
        # density over probability of a standard normal number below `away`
        hazard = np.exp(-0.5 * away**2 - 0.5 * np.log(2.0 * np.pi) - log_ndtr(away))
        unit = across / sigma[..., None]
        mean = law.shift - hazard[..., None] * unit
        less = hazard * (away + hazard)
        return mean, law.covariance - less[..., None, None] * unit[..., :, None] * unit[..., None, :]


def factor_of(covariance: Array) -> Array:
    """Return a matrix (d, rank) whose product with its transpose is a covariance (d, d) that may be singular."""
    lower = factor_semidefinite(covariance)
    return np.asarray(lower[:, np.diagonal(lower) ** 2 > HELD * np.trace(covariance)])


def _density(length: Array, lean: Array, rank: int) -> Array:
    """Return the density along rays at lengths from the fix, in proportion to that at the fix, and its volume."""
    return np.asarray(length ** (rank - 1) * np.exp(length * (lean - 0.5 * length)))


@lru_cache(maxsize=1)
def _gauss() -> tuple[Array, Array]:
    """Return nodes and weights of Gauss and Legendre between 0 and 1."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    return 0.5 * (node + 1.0), 0.5 * weight


@lru_cache(maxsize=4)
def _directions(rank: int) -> Array:
    """Return unit vectors (k, rank) that are spread evenly."""
    return np.array([[-1.0], [1.0]])[:, :rank] if rank <= 1 else spread_directions(_RAYS[rank], rank)
