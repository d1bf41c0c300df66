"""Truncated normal distributions of fixes at or near bounds, and the shape of the cost inside the bounds.

Inequality constraints give h bounds. Arrays have N fixes of d coordinates, and n shared unknowns. The slack is the
distance of a fix from a bound. Near a fix, the bound of a height is replaced by its tangent plane. Other bent bounds
(circles, roads, the ground), unions, and polygons to keep out of are not replaced. For them, a function tests whether
points are admitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.linalg import spread_directions
from optloc.base.records import present, take
from optloc.base.types import Array, Band, Constraint, Polygon
from optloc.linear.constraints import (
    TOLERANCE,
    Level,
    bounds,
    exact,
    is_admitted,
    is_exact,
    is_flat,
    levels,
    outwards,
    violation,
)
from optloc.linear.mirror import one_position
from optloc.model_checks.shape import AWAY, ShapeTest
from optloc.problem.problem import Problem
from optloc.problem.truncated import Truncated, factor_of

# Largest distance to a bound, in standard deviations, at which the distribution is truncated: a farther bound removes a
# thousandth of it.
_NEAR = 3.0
# The same limit for the other bounds of such a fix: beyond it, a bound removes nothing.
_REACH = 7.0
# Largest departure of a curved bound from its tangent plane at three standard deviations, in standard deviations.
_FLAT = 0.1
# A fix within this number of standard deviations is on a bound; refinement is more exact.
_ON = 1e-3
# A shorter inward direction is parallel to other bounds.
_ALONG = 1e-6
# Directions and radii, in standard deviations, of the points that are tested for a bound without a plane nearby.
_WAYS, _RADII = {2: 24, 3: 60}, (0.5, 1.0, 1.5, 2.0, 2.5, _NEAR)


def has_law(problem: Problem) -> bool:
    """Return whether the problem has one static position and inequalities, which can truncate its distribution."""
    limited = any(not is_exact(constraint) for constraint in problem.constraints)
    return limited and one_position(problem) and problem.motions[0].order == 0


def are_near(limits: Array, value: Array, gradient: Array, covariance: Array) -> bool:
    """Return whether a bound is within three standard deviations of one of n fixes and truncates its distribution.

    `limits` (k, 2) are lower and upper limits of k quantities; infinite for none. `value` (n, k) and `gradient` (n, k,
    d) are the quantities at the fixes, and `covariance` (n, d, d) belongs to the positions.
    """
    reach = _NEAR * np.sqrt(np.maximum(((gradient @ covariance) * gradient).sum(-1), 0.0))
    return bool(((value - reach <= limits[:, 0]) | (value + reach >= limits[:, 1])).any())


@dataclass(frozen=True, slots=True)
class Law:
    """Truncated normal distributions of N fixes.

    - truncated: distributions of the positions.
    - sound (N,): True if all bounds are flat enough or far away.
    """

    truncated: Truncated
    sound: Array


def law_of(problem: Problem, x: Array, covariance: Array, shift: Array) -> Law | None:
    """Return the normal distributions of fixes, truncated at near bounds; None if no bound is near a fix.

    `problem` is a flat batch of N problems with one static position. `x` (N, size) are the fixes; NaN for none.
    `covariance` (N, n, n) is the covariance of the shared unknowns without the inequalities. `shift` (N, n) is the mean
    of the distribution without inequalities minus the fix. A bound that is too far away to matter gets an infinite
    slack.
    """
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    spread, sides = covariance[:, part, part], bounds(problem)
    region = _regions(problem, x, spread, part)
    with np.errstate(all="ignore"):
        values, normal = _planes(problem, sides, x, part)
        sigma = np.sqrt(np.maximum(np.einsum("nhi,nij,nhj->nh", normal, spread, normal), 0.0))
        # a bound along which an equality fixes the position truncates nothing
        # and a bound without a plane is left to the function of the region, except for the shape of the cost on it
        open_ones = (sigma > 0.0) & np.isfinite(values)
        told = None if region is None else present(region)
        plain = np.array([not _needs_region(problem.constraints[side.constraint]) for side in sides], dtype=bool)
        open_ones &= plain if told is None else np.where(told[:, None], np.abs(values) <= _ON * sigma, plain)
        near = open_ones & (values <= _NEAR * sigma)
        if not near.any() and told is None:
            return None
        # if one bound is near, the farther bounds of the same fix count up to `_REACH`
        slack = np.where(near.any(1)[:, None] & open_ones & (values <= _REACH * sigma), np.maximum(values, 0.0), np.inf)
        departures = _departures(problem, sides, x, spread, values, normal, np.isfinite(slack))
    if told is not None:
        departures = np.where(told[:, None], 0.0, departures)
    bent = np.isfinite(slack) & (departures > _FLAT * sigma)
    # a curved bound that the fix does not touch is ignored; if the fix touches it, the result is not sound
    touched = slack <= _ON * sigma
    slack = np.where(bent & ~touched, np.inf, slack)
    along, span = _edges(problem, sides, x, part)
    truncated = Truncated(normal, slack, along, span, departures, shift[:, part], spread, region)
    return Law(truncated, ~(bent & touched).any(1))


def _needs_region(constraint: Constraint) -> bool:
    """Return whether an inequality needs a function that tests points, because no plane replaces its bound."""
    if isinstance(constraint, Polygon):
        return constraint.outside
    return not isinstance(constraint, Band) or constraint.kind not in _PLANAR


# Quantities whose bounds are planes, or nearly planes at the distances of errors.
_PLANAR = ("plane", "height", "visible")


@dataclass(frozen=True, eq=False)
class AdmittedPoints:
    """The points that the inequalities of one problem admit, as a function of the distance from its fix.

    - problem: one problem, with inequalities only.
    - x (size,): the fix.
    - part: slice of the position in x.
    """

    problem: Problem
    x: Array
    part: slice

    def __call__(self, points: Array) -> Array:
        """Return flags (...) of the admitted ones of points (..., d), metres from the fix, for many points."""
        return is_admitted(self.problem, self._moved(points)).reshape(points.shape[:-1])

    def within_rounding(self, points: Array) -> Array:
        """Return the same flags, with points on the boundary of a polygon admitted, whatever rounding says."""
        broken = violation(self.problem, self._moved(points)) > TOLERANCE
        return np.asarray(~broken).reshape(points.shape[:-1])

    def _moved(self, points: Array) -> Array:
        """Return the vectors (N, size) of the fix moved by points (..., d)."""
        flat = points.reshape(-1, points.shape[-1])
        moved = np.repeat(self.x[None], len(flat), axis=0)
        moved[:, self.part] += flat
        return moved


def _regions(problem: Problem, x: Array, spread: Array, part: slice) -> Array | None:
    """Return functions (N,) that test points, for fixes near bounds without planes, and None for other fixes.

    The result is None if no fix has such a function. `x` (N, size) are the fixes, `spread` (N, d, d) the covariances of
    their positions, and `part` is the slice of the position.
    """
    limits = tuple(c for c in problem.constraints if not is_exact(c))
    if not any(_needs_region(c) for c in limits):
        return None
    d, out = part.stop - part.start, np.full(len(x), None, dtype=object)
    usable = np.flatnonzero(np.isfinite(spread).all((1, 2)) & np.isfinite(x).all(1))
    values, vectors = np.linalg.eigh(spread[usable])
    factor = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    ways = (np.array(_RADII)[:, None, None] * spread_directions(_WAYS[d], d)).reshape(-1, d)
    moved = np.repeat(x[usable][:, None], len(ways), axis=1)
    moved[..., part] += ways @ np.swapaxes(factor, -1, -2)
    limited = replace(problem, constraints=limits)
    many = limited.take(np.repeat(usable, len(ways)))
    broken = (violation(many, moved.reshape(-1, x.shape[-1])) > TOLERANCE).reshape(len(usable), len(ways))
    for i in usable[broken.any(1)]:
        out[i] = AdmittedPoints(limited.take(np.array([i])), x[i], part)
    return out if broken.any() else None


def _planes(problem: Problem, sides: tuple[Level, ...], x: Array, part: slice) -> tuple[Array, Array]:
    """Return distances (N, h) of fixes from bounds, m, and the unit outward normals (N, h, d).

    `sides` are the bounds, and `part` is the slice of the position in `x` (N, size). A distance is negative outside. It
    is infinite and the normal is zero if the bound does not depend on the position.
    """
    values, gradients = levels(problem, sides, x)
    sense = np.array([outwards(problem, side) for side in sides])
    gradients = gradients[..., part] * sense[:, None]
    size = np.sqrt((gradients**2).sum(-1))
    good = size > 0.0
    normal = np.where(good[..., None], gradients / np.where(good, size, 1.0)[..., None], 0.0)
    return np.where(good, -sense * values / np.where(good, size, 1.0), np.inf), normal


def _departures(
    problem: Problem, sides: tuple[Level, ...], x: Array, spread: Array, values: Array, normal: Array, near: Array
) -> Array:
    """Return the departures (N, h) of near bounds from their tangent planes at three standard deviations, m.

    `spread` (N, d, d) are the covariances of the positions. `values` (N, h) and `normal` (N, h, d) are from `_planes`.
    `near` (N, h) marks the bounds to compute; the other departures are zero. `sides` are the h bounds, and `x` (N,
    size) are the fixes.
    """
    departures, d = np.zeros(values.shape), spread.shape[-1]
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    curved = np.array([not is_flat(problem, side) for side in sides])
    items = np.flatnonzero((near & curved).any(1))
    if not len(items):
        return departures
    some, x_some = problem.take(items), x[items]
    steps = np.sqrt(np.maximum(np.diagonal(spread[items], axis1=-2, axis2=-1), 0.0))
    worst = np.zeros((len(items), len(sides)))
    for i in range(d):
        for sign in (-AWAY, AWAY):
            # a row of the covariance divided by its deviation is the step that changes this coordinate most
            step = sign * spread[items, i] / np.where(steps[:, i] > 0.0, steps[:, i], 1.0)[:, None]
            moved = np.array(x_some)
            moved[:, part] += step
            there = _planes(some, sides, moved, part)[0]
            plane = values[items] - (normal[items] * step[:, None]).sum(-1)
            worst = np.maximum(worst, np.where(np.isfinite(there), np.abs(there - plane), np.inf))
    departures[items] = np.where(near[items] & curved, worst, 0.0)
    return departures


def _edges(problem: Problem, sides: tuple[Level, ...], x: Array, part: slice) -> tuple[Array, Array]:
    """Return unit vectors (N, h, d) along the edges of polygons, and their ends (N, h, 2), m from the fix.

    For a bound that is no edge of a polygon, the vector is zero and the ends are infinite. `sides` are the h bounds,
    `x` (N, size) are the fixes, and `part` is the slice of the position.
    """
    n, d = len(x), part.stop - part.start
    along, span = np.zeros((n, len(sides), d)), np.tile([-np.inf, np.inf], (n, len(sides), 1))
    for i, side in enumerate(sides):
        region = problem.constraints[side.constraint]
        if isinstance(region, Polygon):
            assert isinstance(side.side, int)
            ends = region.vertices[[side.side, (side.side + 1) % len(region.vertices)]]
            unit = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
            along[:, i, :2] = unit
            span[:, i] = ((ends[None] - x[:, None, part.start : part.start + 2]) * unit).sum(-1)
    return along, span


def departure_inwards(problem: Problem, x: Array, covariance: Array, law: Truncated) -> Array:
    """Return the departure (N,) of the cost from a Gaussian inside the bounds that the fixes touch.

    It is ``|ln((f(x + s t) - f(x)) / q)|``, the largest over the directions t that leave one bound and stay on the
    others. The step s ends where the quadratic model has increased by q = 9, or at another bound. `problem` is a flat
    batch of N problems with one static position, and `x` (N, size) are fixes on bounds. `covariance` (N, n, n) is the
    covariance of the shared unknowns without the inequalities. `law` is the distribution of the positions.
    """
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    steps = [_inward_steps(take(law, i)) for i in range(len(x))]
    width = max(1, *(len(one) for one in steps))
    moved, increases = np.zeros((len(x), width, slot.size)), np.ones((len(x), width))
    for i, one in enumerate(steps):
        for k, (step, increase) in enumerate(one):
            moved[i, k], increases[i, k] = step, increase
    spread = covariance[:, part, part]
    pull = covariance[:, :, part] @ np.linalg.pinv(spread, hermitian=True)
    with np.errstate(all="ignore"):
        return ShapeTest(problem, x, pull, part, exact(problem)).departs(moved, np.sqrt(increases))


def _inward_steps(law: Truncated) -> list[tuple[Array, float]]:
    """Return inward steps (d,) from each bound that a fix touches, m, and the increase of the quadratic model there.

    `law` is the distribution of one position. A step stays on the other bounds that the fix touches. With a function
    for the admitted points, the steps are in all directions.
    """
    # `factor` converts independent standard normal numbers to metres. In these numbers, the distribution without bounds
    # is round with unit variance and the mean `middle`, and the fix is at zero.
    factor = factor_of(law.covariance)
    middle = np.linalg.solve(factor.T @ factor, factor.T @ law.shift)
    if law.region is not None:
        return _steps_within(law, factor, middle)
    turned = law.normal @ factor
    sigma = np.sqrt((turned**2).sum(-1))
    touched = np.flatnonzero((law.slack <= _ON * sigma) & (sigma > 0.0) & _touches_edge(law))[: factor.shape[0]]
    unit = turned[touched] / sigma[touched, None]
    others = np.where(np.isin(np.arange(len(sigma)), touched), np.inf, law.slack)
    rest = replace(law, slack=others)
    found = []
    for k in range(len(touched)):
        other_units = np.delete(unit, k, axis=0)
        # away from bound k; the part along the normals of the other bounds is removed
        inward = -unit[k] + other_units.T @ (np.linalg.pinv(other_units.T) @ unit[k]) if len(other_units) else -unit[k]
        size = np.sqrt((inward**2).sum())
        if size > _ALONG:
            inward = inward / size
            mean_along = float(inward @ middle)
            end = float(rest.exits((factor @ inward)[None])[0])
            # the model increases by l^2 - 2 m l after a length l, with the mean m along the direction; solve it for 9
            length = min(mean_along + np.sqrt(mean_along**2 + AWAY**2), end)
            found.append((length * (factor @ inward), max(length**2 - 2.0 * mean_along * length, 1e-300)))
    return found


# Directions of steps, by the number of dimensions with a width; shorter steps, in standard deviations, say nothing.
_STEPS, _SHORT = {1: 2, 2: 8, 3: 20}, 0.3


def _steps_within(law: Truncated, factor: Array, middle: Array) -> list[tuple[Array, float]]:
    """Return steps (d,) from a fix to admitted points, m, and the increases of the quadratic model there.

    `factor` and `middle` are as in `_inward_steps`.
    """
    rank = factor.shape[1]
    if rank == 0:
        return []
    ways = np.array([[-1.0], [1.0]]) if rank == 1 else spread_directions(_STEPS[rank], rank)
    mean_along = ways @ middle
    lengths = np.minimum(mean_along + np.sqrt(mean_along**2 + AWAY**2), law.exits(ways @ factor.T))
    increases = lengths**2 - 2.0 * mean_along * lengths
    kept = np.flatnonzero((lengths > _SHORT) & (increases > _SHORT**2))
    return [(lengths[k] * (factor @ ways[k]), float(increases[k])) for k in kept]


def _touches_edge(law: Truncated) -> Array:
    """Return a mask (h,) of bounds without ends, and of edges with the fix between their ends."""
    reach = _ON * np.sqrt(np.trace(law.covariance))
    return np.asarray((law.span[:, 0] <= reach) & (law.span[:, 1] >= -reach))


def covariance_of(law: Truncated, covariance: Array, part: slice) -> Array:
    """Return the covariances (N, n, n) of the shared unknowns of fixes with truncated positions.

    The other unknowns respond to the position as without the bounds. `law` holds the distributions of the positions,
    `covariance` (N, n, n) the covariances without the bounds, and `part` is the slice of the position.
    """
    # linear response of all shared unknowns to a change of the position
    pull = covariance[..., part] @ np.linalg.pinv(law.covariance, hermitian=True)
    return np.asarray(covariance + pull @ (law.moments()[1] - law.covariance) @ np.swapaxes(pull, -1, -2))
