"""The shape of the likelihood about a fix: how far it is Gaussian, in which chart, and what infinity costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base import linalg
from optloc.base.linalg import centre_and_spread, normalised, spread_directions
from optloc.base.types import Array
from optloc.kernels.damping import FIRST_GROWTH, judge
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import Face, exact, levels, restore, tangent_at, violation
from optloc.linear.normal import decrement, depends_on_place, marginal, step
from optloc.model_checks.scaled_rows import cost_beyond_speed, has_scales, profile_by_rows
from optloc.problem.chart import INVERSE_RANGE, Chart, basis
from optloc.problem.problem import Problem

# The cost over the position alone: other unknowns take the values that fit best there.


def profile(problem: Problem, x: Array, at: Array, passes: int = 1) -> tuple[Array, Array, Array]:
    """Return the least cost over all unknowns but the position, and its normal equations there.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems of one position.
    x : array (q, N, size)
        Positions, and where the search for the other unknowns begins.
    at : array (N, size)
        Where station errors of span "noise" are weighed.
    passes : int
        How often the other unknowns move to where they fit best: once is exact where rows are linear in them, unless
        they are so far off that rounding shows.

    Returns
    -------
    cost : array (q, N)
        Least costs.
    information : array (q, N, d, d)
        Of the position, the other unknowns eliminated.
    vector : array (q, N, d)
        Half the negative gradient of the cost.
    """
    slot, _ = problem.layout.find("position")
    part, n = slice(slot.start, slot.start + slot.size), problem.layout.n_shared
    weighed = np.broadcast_to(at, x.shape) if depends_on_place(problem) else None
    move = np.zeros(x.shape)
    for _ in range(passes):
        x = x + move
        equations = equations_at(problem, x, at=weighed)
        if problem.layout.size == slot.size:
            return equations.cost, equations.shared, equations.shared_vector
        along = _others(problem, x, part)
        move, _ = step(equations, np.zeros(equations.cost.shape), along)
    # The model is quadratic: it falls by the product of step and slope. After one step this product is rounding. The
    # sum of squares without it is never negative.
    cost = equations.cost - decrement(equations, move, n) if passes == 1 else equations.cost
    information, vector, _ = marginal(equations)
    across = information[..., part, :] @ along
    turned = np.swapaxes(along, -1, -2)
    right = np.concatenate([np.swapaxes(across, -1, -2), turned @ vector[..., None]], axis=-1)
    solved, _ = linalg.solve(turned @ information @ along, right)
    lost = across @ solved
    return cost, information[..., part, part] - lost[..., :-1], vector[..., part] - lost[..., -1]


def _others(problem: Problem, x: Array, part: slice) -> Array:
    """Return the directions (..., n, q) of the shared unknowns but the position, along the equalities about them.

    A height that is kept along a course is about the velocity as well.
    """
    n, face = problem.layout.n_shared, exact(problem)
    free = np.eye(n)[:, np.r_[0 : part.start, part.stop : n]]
    if not face or not free.shape[1]:
        return free
    gradients = np.stack([levels(problem, face, one)[1] for one in x]) @ free
    if not gradients.any():
        return free
    _, sizes, axes = np.linalg.svd(np.where(np.isfinite(gradients), gradients, 0.0))
    rank = int((sizes > _DEPENDENT * sizes.max(-1, keepdims=True)).sum(-1).max())
    return np.asarray(free @ np.swapaxes(axes[..., rank:, :], -1, -2))


# Share of the largest gradient below which an equality says nothing that another one does not.
_DEPENDENT = 1e-9


# How far the cost is that of a Gaussian.

BENT = 0.3
"""Logarithm of the cost three sigma away over 9 beyond which no Gaussian covers.

At 0.3 the 99.9 % ellipsoids hold 99.8 to 100 % of the truths; at 0.5 far fixes that look near by luck pass as well, and
theirs hold 79 to 92 %.
"""

AWAY = 3.0
"""Where the cost is looked at, standard deviations: 2 and 4 tell good covariances from bad ones as well."""
# The cost there is no less than this share of a Gaussian's: beyond, one is as bad as another.
_FLOOR = 1e-9
# Variances that differ by less have no axes of their own: those turned by half a right angle are as good.
_EQUAL = 0.05
# Least w of the chart: infinity is zero, and no position.
_NEAR_INFINITY = 1e-6
# Vectors at a time: their normal equations then take some tens of megabytes.
_PART = 2**16


def departure(problem: Problem, x: Array, covariance: Array, face: Face, centre: Array) -> Array:
    """Return by how much the cost departs from that of a Gaussian at three sigma, in metres and in inverse range.

    Along each principal axis and both ways, ``|ln((f(x +- 3 t) - f(x)) / 9)|``, the largest; the second chart is looked
    at only where the first departs by more than a tenth.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems of one position.
    x : array (N, size)
        Fixes.
    covariance : array (N, n, n)
        Of their shared unknowns.
    face : Face
        Constraints that hold all of them.
    centre : array (N, d)
        Centre of the stations: that of the inverse-range chart.

    Returns
    -------
    array (N, 2)
        Zero for a Gaussian, infinite where there is no chart.

    References
    ----------
    D. M. Bates and D. G. Watts, "Relative curvature measures of nonlinearity" (1980): what is tested here by the cost
    itself, without second derivatives.
    """
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    spread = covariance[:, part, part]
    precision, _ = linalg.inverse(spread)
    pull = covariance[:, :, part] @ (precision if not face else np.linalg.pinv(spread))  # of the others by the position
    look = ShapeTest(problem, x, pull, part, face)
    out = np.full((len(x), 2), np.inf)
    position, axes = x[:, part], _axes(spread)
    with np.errstate(all="ignore"):
        moved = AWAY * np.concatenate([axes, -axes], axis=1)
        out[:, 0] = look.departs(moved, np.full(moved.shape[:2], AWAY))
        away = position - centre
        distance = np.sqrt((away**2).sum(-1))
        other = np.flatnonzero((out[:, 0] > _SETTLED) & (distance > 0.0)) if not face else np.zeros(0, dtype=int)
        if len(other):
            out[other, 1] = _in_inverse_range(look.take(other), centre[other], spread[other])
    return out


# Below it the covariance in metres serves, whatever another chart says.
_SETTLED = 0.1


@dataclass(frozen=True, slots=True)
class ShapeTest:
    """The cost about a batch of fixes, and how the other unknowns follow the position there."""

    problem: Problem
    x: Array
    pull: Array
    part: slice
    face: Face

    def take(self, items: Array) -> ShapeTest:
        """Return some fixes."""
        return ShapeTest(self.problem.take(items), self.x[items], self.pull[items], self.part, self.face)

    def departs(self, moved: Array, sigmas: Array) -> Array:
        """Return the largest departure (N,) over displacements (N, k, d) of so many standard deviations (N, k)."""
        most = max(1, _PART // max(1, moved.shape[1]))
        if len(moved) > most:
            parts = [slice(i, i + most) for i in range(0, len(moved), most)]
            numbers = np.arange(len(moved))
            return np.concatenate([self.take(numbers[one]).departs(moved[one], sigmas[one]) for one in parts])
        shift = np.moveaxis((self.pull[:, None] @ moved[..., None])[..., 0], 1, 0)
        n = self.pull.shape[1]
        x = np.array(np.broadcast_to(self.x, (len(shift), *self.x.shape)))
        x[..., :n] += shift
        if self.face:
            x = np.stack([restore(self.problem, self.face, one) for one in x])
        # with the fix itself: of one fix a call costs as much as ten vectors of it
        cost, _, _ = profile(self.problem, np.concatenate([self.x[None], x]), self.x)
        ratio = (cost[1:] - cost[0]) / sigmas.T**2
        found = np.abs(np.log(np.maximum(ratio, _FLOOR)))
        # what has no width has no axis, and what cannot be evaluated is no Gaussian
        still = (moved == 0.0).all(-1).T
        return np.asarray(np.where(still, 0.0, np.where(np.isnan(found), np.inf, found)).max(0, initial=0.0))


def _axes(covariance: Array) -> Array:
    """Return one standard deviation along every principal axis (N, k, d), and turned ones where axes are arbitrary."""
    known = np.isfinite(covariance).all((-1, -2), keepdims=True)
    values, vectors = np.linalg.eigh(np.where(known, covariance, 0.0))
    # rounding, or a constraint, may leave a variance of nothing or less
    values = np.where(values > _EXACT * values[:, -1:], values, 0.0)
    axes = np.swapaxes(vectors * np.sqrt(values)[:, None, :], -1, -2)
    d, more = axes.shape[-1], []
    for i in range(d):
        for j in range(i + 1, d):
            alike = (values[:, j] - values[:, i] < _EQUAL * values[:, j])[:, None]
            if alike.any():
                turned = (axes[:, i] + axes[:, j], axes[:, i] - axes[:, j])
                more += [np.where(alike, each / np.sqrt(2.0), 0.0) for each in turned]
    return np.concatenate([axes, np.stack(more, axis=1)], axis=1) if more else np.asarray(axes)


# Share of the largest variance below which one is rounding.
_EXACT = 1e-14


def _in_inverse_range(look: ShapeTest, centre: Array, covariance: Array) -> Array:
    """Return the largest departure (N,) along the principal axes of the inverse-range chart."""
    position = look.x[:, look.part]
    chart = Chart(np.full(len(position), INVERSE_RANGE, dtype=np.int8), position, covariance, centre)
    axes = _axes(chart.spread)
    sigmas = np.full((len(axes), 2 * axes.shape[1]), AWAY)
    y = AWAY * np.concatenate([axes, -axes], axis=1)
    # a step across infinity ends just before it, and counts for as many sigmas as it has left
    share = np.where(y[..., -1] < 0.0, np.minimum(1.0, (1.0 - _NEAR_INFINITY) / np.maximum(-y[..., -1], 1e-300)), 1.0)
    y, sigmas = y * share[..., None], sigmas * share
    still = (y == 0.0).all(-1)
    y[..., -1] += 1.0
    # points (k, N, d) broadcast against the charts of N fixes
    there = np.moveaxis(chart.to_position(np.moveaxis(y, 1, 0)), 0, 1)
    return look.departs(np.where(still[..., None], 0.0, there - position[:, None]), sigmas)


# What the data say of positions ever farther away.

# Distance that stands for infinity, spreads of the stations: wave fronts bend by 5e-8 of the spread there, and rounding
# of a difference of ranges is 1e-9 of it.
_INFINITE = 1e7
# Directions that are tried: every 22.5 degrees of the plane, in space 50 on a spiral, about 28 degrees apart: the cost
# of range differences is quadratic in the direction and has two minima at most.
_DIRECTIONS = {2: 16, 3: 50}
# Those of them that are refined, beside that of the fix; and steps, of which each squares a small error.
_REFINED, _STEPS = 2, 12
# Share of a cost that no step promises any more at the end: what is compared with it is a gap of several.
_STILL = 1e-4
# Damping of the first steps (Nielsen's tau): the directions that are tried are no closed forms near a minimum.
_DAMPING = 1e-3
# Relative violation of a constraint (`optloc.linear.constraints.violation`) beyond rounding at such distances.
_BROKEN = 1e-4


def cost_at_infinity(problem: Problem, x: Array) -> Array:
    """Return the least cost (N,) of positions infinitely far away; very large where it grows without bound.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems of one position.
    x : array (N, size)
        Their fixes: the first direction that is tried, and where the other unknowns begin.
    """
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    centre, spread = centre_and_spread(problem.stations.places)
    centre = np.broadcast_to(centre, x[:, part].shape)
    along = None if not (face := exact(problem)) else tangent_at(problem, face, x)[:, part]
    sphere = _Sphere(problem, x, part, centre, _INFINITE * np.broadcast_to(spread, (len(x),)), along)
    with np.errstate(all="ignore"):
        own = sphere.direction(x[:, part] - centre)
        spread_out = spread_directions(_DIRECTIONS[slot.size], slot.size)[:, None]
        tried = sphere.direction(np.broadcast_to(spread_out, (len(spread_out), *own.shape)))
        cost = sphere.look(tried)[0]
        best = np.argsort(cost, axis=0)[:_REFINED]
        starts = np.concatenate([own[None], np.take_along_axis(tried, best[..., None], axis=0)])
        least = sphere.descend(starts).min(0)
        return np.fmin(least, cost_beyond_speed(problem, x)) if has_scales(problem) else np.asarray(least)


@dataclass(frozen=True, slots=True)
class _Sphere:
    """Positions so far away that they are directions."""

    problem: Problem
    x: Array
    part: slice
    centre: Array
    radius: Array
    along: Array | None

    def direction(self, vector: Array) -> Array:
        """Return unit vectors (..., N, d), along the equalities where there are some."""
        if self.along is not None:
            vector = (self.along @ (np.swapaxes(self.along, -1, -2) @ vector[..., None]))[..., 0]
        return normalised(vector)

    def look(self, direction: Array) -> tuple[Array, Array, Array]:
        """Return costs (q, N) in directions (q, N, d), and information and vector of the position."""
        x = np.array(np.broadcast_to(self.x, (len(direction), *self.x.shape)))
        x[..., self.part] = self.centre + self.radius[:, None] * direction
        own = profile_by_rows if has_scales(self.problem) else profile
        cost, information, vector = own(self.problem, x, self.x, 2)
        if self.problem.constraints:
            broken = np.stack([violation(self.problem, one) for one in x])
            cost = np.where(broken > _BROKEN, np.inf, cost)
        return np.where(np.isfinite(cost), cost, np.inf), information, vector

    def descend(self, direction: Array) -> Array:
        """Return the least costs (q, N) next to directions (q, N, d): damped Gauss-Newton on the sphere."""
        cost, information, vector = self.look(direction)
        damping, growth = np.full(cost.shape, _DAMPING), np.full(cost.shape, FIRST_GROWTH)
        scale = self.radius[:, None, None]
        for _ in range(_STEPS):
            across = scale * basis(direction)
            turned = np.swapaxes(across, -1, -2)
            inner = turned @ information @ across
            grown = inner * (1.0 + damping[..., None, None] * np.eye(inner.shape[-1]))
            pull = turned @ vector[..., None]
            move, ok = linalg.solve(grown, pull)
            # what the step promises: where that is nothing for any start, all have arrived
            gain = (move * pull).sum((-1, -2))
            if not (gain > _STILL * (1.0 + cost)).any():
                break
            trial = self.direction(direction + (across @ move)[..., 0] / self.radius[:, None])
            new, more, other = self.look(trial)
            better, _, _, damping, growth = judge(cost, new, gain, ok, 0.0 * cost, damping, growth, 0.0, True)
            direction = np.where(better[..., None], trial, direction)
            information = np.where(better[..., None, None], more, information)
            vector = np.where(better[..., None], other, vector)
            cost = np.where(better, new, cost)
        return np.asarray(cost)
