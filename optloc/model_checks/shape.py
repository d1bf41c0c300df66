"""Shape of the likelihood near a fix: departure from a Gaussian in two coordinate charts, and the cost at infinity.

Arrays have N problems of d coordinates, n shared unknowns, and q positions tried for each problem. A vector of `size`
numbers holds all unknowns of a problem. The departure is zero for a Gaussian.
"""

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

# Cost as a function of the position alone, minimised over the other unknowns.


def profile(problem: Problem, x: Array, at: Array, passes: int = 1) -> tuple[Array, Array, Array]:
    """Return the lowest cost over all unknowns except the position, with the information and gradient of the position.

    `problem` is a flat batch of N problems with one position. `x` (q, N, size) holds positions and starts of the other
    unknowns. Station errors that are new at each epoch (span "noise") add to the noise of the rows. Their effect is
    computed at the vectors `at` (N, size). `passes` is the number of updates of the other unknowns. One update is exact
    if the rows are linear in them, unless the start is so far off that rounding matters.

    The results are costs (q, N), information (q, N, d, d) and vectors (q, N, d). The information belongs to the
    position, with other unknowns eliminated. The vector is half the negative gradient of the cost.
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
        along = _other_directions(problem, x, part)
        move, _ = step(equations, np.zeros(equations.cost.shape), along)
    # The model is quadratic, so the cost decreases by the product of step and slope. After one step this product is
    # rounding, and the sum of squares without it is never negative.
    cost = equations.cost - decrement(equations, move, n) if passes == 1 else equations.cost
    information, vector, _ = marginal(equations)
    # Schur complement: eliminate the other unknowns from the equations of the position.
    coupling = information[..., part, :] @ along
    turned = np.swapaxes(along, -1, -2)
    right = np.concatenate([np.swapaxes(coupling, -1, -2), turned @ vector[..., None]], axis=-1)
    solved, _ = linalg.solve(turned @ information @ along, right)
    explained = coupling @ solved
    return cost, information[..., part, part] - explained[..., :-1], vector[..., part] - explained[..., -1]


def _other_directions(problem: Problem, x: Array, part: slice) -> Array:
    """Return p directions (..., n, p) of the n shared unknowns that keep the position and satisfy the equalities.

    `x` (q, N, size) are vectors and `part` is the slice of the position. An equality can restrict other unknowns too.
    For instance, a fixed height of a moving target restricts its velocity.
    """
    n, face = problem.layout.n_shared, exact(problem)
    free = np.eye(n)[:, np.r_[0 : part.start, part.stop : n]]
    if not face or not free.shape[1]:
        return free
    # the derivatives of the equalities by the free unknowns; directions with zero derivatives remain
    gradients = np.stack([levels(problem, face, one)[1] for one in x]) @ free
    if not gradients.any():
        return free
    _, sizes, axes = np.linalg.svd(np.where(np.isfinite(gradients), gradients, 0.0))
    rank = int((sizes > _DEPENDENT * sizes.max(-1, keepdims=True)).sum(-1).max())
    return np.asarray(free @ np.swapaxes(axes[..., rank:, :], -1, -2))


# Share of the largest gradient below which an equality depends on the other equalities.
_DEPENDENT = 1e-9


# Departure of the cost from the cost of a Gaussian.

BENT = 0.3
"""Limit of the logarithm of (cost rise at three sigma) / 9. Beyond it, no Gaussian covers as stated.

With 0.3 the 99.9 % ellipsoids hold 99.8 to 100 % of the true positions. With 0.5, far fixes that look near by chance
pass as well, and their ellipsoids hold 79 to 92 %."""

AWAY = 3.0
"""Distance of the test points in standard deviations; 2 and 4 give the same verdicts."""
# Lower limit of the ratio of the cost to the cost of a Gaussian: below it, all values are equally bad.
_FLOOR = 1e-9
# Variances whose relative difference is below this share have no distinct axes: axes rotated by 45 degrees are tested
# too.
_EQUAL = 0.05
# Smallest w of the chart: w = 0 is infinity and not a position.
_NEAR_INFINITY = 1e-6
# Number of vectors that are processed together: their normal equations need some tens of megabytes.
_PART = 2**16


def departure(problem: Problem, x: Array, covariance: Array, face: Face, centre: Array) -> Array:
    """Return the departure (N, 2) of the cost from a Gaussian at three sigma, in metres and in inverse range.

    It is the largest ``|ln((f(x +- 3 t) - f(x)) / 9)|`` over the principal axes t, in both directions. It is zero for a
    Gaussian, and infinite for a chart that is not tested. The second chart is tested only if the departure in the first
    chart exceeds a tenth, and only without equalities. `x` (N, size) are the fixes, and `covariance` (N, n, n) the
    covariances of their shared unknowns. `face` holds the equality constraints. `centre` (N, d) is the origin of the
    inverse-range chart.

    References
    ----------
    D. M. Bates and D. G. Watts, "Relative curvature measures of nonlinearity" (1980). The test here uses the cost
    itself, without second derivatives.
    """
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    spread = covariance[:, part, part]
    precision, _ = linalg.inverse(spread)
    pull = covariance[:, :, part] @ (precision if not face else np.linalg.pinv(spread))  # response of the others
    test = ShapeTest(problem, x, pull, part, face)
    out = np.full((len(x), 2), np.inf)
    position, axes = x[:, part], _axes(spread)
    with np.errstate(all="ignore"):
        moved = AWAY * np.concatenate([axes, -axes], axis=1)
        out[:, 0] = test.departs(moved, np.full(moved.shape[:2], AWAY))
        away = position - centre
        distance = np.sqrt((away**2).sum(-1))
        other = np.flatnonzero((out[:, 0] > _SETTLED) & (distance > 0.0)) if not face else np.zeros(0, dtype=int)
        if len(other):
            out[other, 1] = _in_inverse_range(test.take(other), centre[other], spread[other])
    return out


# Below this departure the covariance in metres is used; the other chart is not tested.
_SETTLED = 0.1


@dataclass(frozen=True, slots=True)
class ShapeTest:
    """A test of the shape of the cost around N fixes.

    - problem: flat batch of the N problems.
    - x (N, size): the fixes.
    - pull (N, n, d): response of the n shared unknowns to a change of the position.
    - part: slice of the position.
    - face: equality constraints.
    """

    problem: Problem
    x: Array
    pull: Array
    part: slice
    face: Face

    def take(self, items: Array) -> ShapeTest:
        """Return the fixes with the numbers `items`."""
        return ShapeTest(self.problem.take(items), self.x[items], self.pull[items], self.part, self.face)

    def departs(self, moved: Array, sigmas: Array) -> Array:
        """Return the largest departure (N,) over displacements `moved` (N, k, d) of the fixes, m.

        `sigmas` (N, k) are the lengths of the displacements in standard deviations. The departure is the absolute
        logarithm of the rise of the cost divided by the square of this length; infinite if the cost cannot be computed.
        """
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
        # include the fix itself: for one fix, a separate call takes as long as ten vectors
        cost, _, _ = profile(self.problem, np.concatenate([self.x[None], x]), self.x)
        ratio = (cost[1:] - cost[0]) / sigmas.T**2
        found = np.abs(np.log(np.maximum(ratio, _FLOOR)))
        # a zero displacement has no departure, and a cost that cannot be evaluated is not Gaussian
        still = (moved == 0.0).all(-1).T
        return np.asarray(np.where(still, 0.0, np.where(np.isnan(found), np.inf, found)).max(0, initial=0.0))


def _axes(covariance: Array) -> Array:
    """Return displacements (N, k, d) of one standard deviation along all principal axes of covariances (N, d, d).

    For equal variances, axes rotated by 45 degrees are added. `covariance` belongs to the positions, m^2; a covariance
    that is not finite counts as zero.
    """
    known = np.isfinite(covariance).all((-1, -2), keepdims=True)
    values, vectors = np.linalg.eigh(np.where(known, covariance, 0.0))
    # rounding or a constraint can make a variance zero or negative
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


# Share of the largest variance below which a variance is rounding.
_EXACT = 1e-14


def _in_inverse_range(test: ShapeTest, centre: Array, covariance: Array) -> Array:
    """Return the largest departure (N,) along the principal axes of the inverse-range chart.

    `centre` (N, d) is the origin of the chart, and `covariance` (N, d, d) belongs to the positions, m^2. `test` holds
    the fixes and their problems.
    """
    position = test.x[:, test.part]
    chart = Chart(np.full(len(position), INVERSE_RANGE, dtype=np.int8), position, covariance, centre)
    axes = _axes(chart.spread)
    sigmas = np.full((len(axes), 2 * axes.shape[1]), AWAY)
    y = AWAY * np.concatenate([axes, -axes], axis=1)
    # a step across infinity ends just before it, and its length in sigmas is reduced accordingly
    share = np.where(y[..., -1] < 0.0, np.minimum(1.0, (1.0 - _NEAR_INFINITY) / np.maximum(-y[..., -1], 1e-300)), 1.0)
    y, sigmas = y * share[..., None], sigmas * share
    still = (y == 0.0).all(-1)
    # the fix has the chart coordinates (0, ..., 0, 1)
    y[..., -1] += 1.0
    # points (k, N, d) broadcast against the charts of N fixes
    there = np.moveaxis(chart.to_position(np.moveaxis(y, 1, 0)), 0, 1)
    return test.departs(np.where(still[..., None], 0.0, there - position[:, None]), sigmas)


# Cost of positions at large distances.

# Distance that represents infinity, in spreads of the stations: wave fronts bend by 5e-8 of the spread there, and the
# rounding of a difference of ranges is 1e-9 of it.
_INFINITE = 1e7
# Numbers of directions of the search: every 22.5 degrees of the plane; in space 50 on a spiral, about 28 degrees apart.
# The cost of range differences is quadratic in the direction and has two minima at most.
_DIRECTIONS = {2: 16, 3: 50}
# Number of directions that are refined in addition to the direction of the fix, and number of steps: each step squares
# a small error.
_REFINED, _STEPS = 2, 12
# Steps end if the predicted decrease is below this share of the cost; the cost is compared with a gap of several.
_STILL = 1e-4
# Damping of the first steps (Nielsen's tau): the directions of the search are not closed forms near a minimum.
_DAMPING = 1e-3
# Relative violation of a constraint (`optloc.linear.constraints.violation`) beyond rounding at these distances.
_BROKEN = 1e-4


def cost_at_infinity(problem: Problem, x: Array) -> Array:
    """Return the lowest cost (N,) of positions at infinity, computed at `_INFINITE` spreads of the stations.

    The cost is large if it has no limit there, and infinite if a constraint excludes all directions. `problem` is a
    flat batch of N problems with one position. The fixes `x` (N, size) give the first direction and the start of the
    other unknowns.
    """
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    centre, spread = centre_and_spread(problem.stations.places)
    centre = np.broadcast_to(centre, x[:, part].shape)
    along = None if not (face := exact(problem)) else tangent_at(problem, face, x)[:, part]
    sphere = _Sphere(problem, x, part, centre, _INFINITE * np.broadcast_to(spread, (len(x),)), along)
    with np.errstate(all="ignore"):
        fixed = sphere.direction(x[:, part] - centre)
        spread_out = spread_directions(_DIRECTIONS[slot.size], slot.size)[:, None]
        tried = sphere.direction(np.broadcast_to(spread_out, (len(spread_out), *fixed.shape)))
        cost = sphere.evaluate(tried)[0]
        best = np.argsort(cost, axis=0)[:_REFINED]
        starts = np.concatenate([fixed[None], np.take_along_axis(tried, best[..., None], axis=0)])
        least = sphere.descend(starts).min(0)
        return np.fmin(least, cost_beyond_speed(problem, x)) if has_scales(problem) else np.asarray(least)


@dataclass(frozen=True, slots=True)
class _Sphere:
    """Positions on a sphere about the stations. It is so large that the cost depends on the directions alone.

    - problem: flat batch of N problems with one position.
    - x (N, size): start of the other unknowns.
    - part: slice of the position.
    - centre (N, d), radius (N,): of the sphere, m.
    - along (N, d, t): directions of the position that the equality constraints allow; None without equalities.
    """

    problem: Problem
    x: Array
    part: slice
    centre: Array
    radius: Array
    along: Array | None

    def direction(self, vector: Array) -> Array:
        """Return unit vectors (..., N, d), along the equalities if there are any."""
        if self.along is not None:
            vector = (self.along @ (np.swapaxes(self.along, -1, -2) @ vector[..., None]))[..., 0]
        return normalised(vector)

    def evaluate(self, direction: Array) -> tuple[Array, Array, Array]:
        """Return costs (q, N) in directions (q, N, d), with the normal equations of the position.

        These are information (q, N, d, d) and right sides (q, N, d). The cost is infinite if the position violates a
        constraint.
        """
        x = np.array(np.broadcast_to(self.x, (len(direction), *self.x.shape)))
        x[..., self.part] = self.centre + self.radius[:, None] * direction
        method = profile_by_rows if has_scales(self.problem) else profile
        cost, information, vector = method(self.problem, x, self.x, 2)
        if self.problem.constraints:
            broken = np.stack([violation(self.problem, one) for one in x])
            cost = np.where(broken > _BROKEN, np.inf, cost)
        return np.where(np.isfinite(cost), cost, np.inf), information, vector

    def descend(self, direction: Array) -> Array:
        """Return the lowest costs (q, N) near directions (q, N, d), by damped Gauss-Newton on the sphere."""
        # the tangents `across` of the sphere have lengths in metres, so `move` is a rotation in radians
        cost, information, vector = self.evaluate(direction)
        damping, growth = np.full(cost.shape, _DAMPING), np.full(cost.shape, FIRST_GROWTH)
        scale = self.radius[:, None, None]
        for _ in range(_STEPS):
            across = scale * basis(direction)
            turned = np.swapaxes(across, -1, -2)
            inner = turned @ information @ across
            grown = inner * (1.0 + damping[..., None, None] * np.eye(inner.shape[-1]))
            pull = turned @ vector[..., None]
            move, ok = linalg.solve(grown, pull)
            # predicted decrease: if it is negligible for all starts, all have converged
            gain = (move * pull).sum((-1, -2))
            if not (gain > _STILL * (1.0 + cost)).any():
                break
            trial = self.direction(direction + (across @ move)[..., 0] / self.radius[:, None])
            new, more, other = self.evaluate(trial)
            better, _, _, damping, growth = judge(cost, new, gain, ok, 0.0 * cost, damping, growth, 0.0, True)
            direction = np.where(better[..., None], trial, direction)
            information = np.where(better[..., None, None], more, information)
            vector = np.where(better[..., None], other, vector)
            cost = np.where(better, new, cost)
        return np.asarray(cost)
