"""Interval of the distance of a target from the plane of all stations, where both sides of the plane fit equally well.

The cost depends on the position in the plane and on q = w^2, the square of the distance w from the plane. The
distribution of w follows from the profile of the cost over q, because no Gaussian describes w near the plane. A point
of the profile is the lowest cost at a fixed w.

Arrays have one entry for each of N problems. A position has d coordinates; a vector (size,) holds all unknowns of a
problem. In plane coordinates, the last coordinate of the position is w.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.kernels.least_squares import refine
from optloc.kernels.sums import equations_at
from optloc.linear.mirror import Folded, is_of_ranges, one_position, plane_of_stations
from optloc.linear.normal import depends_on_place, marginal, prior_parts
from optloc.models import MODELS
from optloc.problem.chart import quantile
from optloc.problem.fix import Fix
from optloc.problem.noise import variances
from optloc.problem.problem import Problem

REGION_LEVEL = 0.95
"""Probability of the interval of the distance from the plane; the interval decides between one region and two."""
JOINED = quantile(REGION_LEVEL, 1)
"""Cost on the plane, above the minimum, up to which both sides form one region."""

# Stations are coplanar if their distances from a plane are below a share of their spread, which is rounding of
# coordinates. They are also coplanar below a share of the noise: such a distance changes a residual by a thousandth of
# a standard deviation at most.
_COPLANAR, _NOISE_SHARE = 1e-9, 1e-3
# Share of the spread of the stations that counts as zero distance: its square changes no significant digit of a range.
_ZERO_DISTANCE = 1e-6
# Largest number of steps. The cost is nearly quadratic in q, and most refinements take two steps.
_STEPS = 100
# Length of the last step in standard deviations, for a fix and for a point of a profile. For a fix it is far below any
# uncertainty. The cost of a profile has an error of the square of this length.
_SETTLED, _PROFILED = 1e-7, 1e-2
# The search for the end of the interval starts at this number of standard deviations of q; for a Gaussian the end is at
# two.
_FIRST_STEP = 2.5
# Largest number of fourfold steps away from the plane: twelve steps lead to a million spreads of the stations.
_FURTHER = 12
# Largest number of steps towards an end of the interval, and the tolerance of the end in standard deviations.
_TRIALS, _CLOSE = 20, 1e-2


@dataclass(frozen=True, slots=True)
class Across:
    """N problems in coordinates whose last axis is the distance from the plane of the stations.

    - problem: the problems without constraints, with stations at distance zero from the plane.
    - centre (N, d): mean of the stations, m, in the original coordinates.
    - axes (N, d, d): unit vectors in columns; the last column is the normal of the plane.
    - size (N,): spread of the stations, m; 1 for stations at one point.
    """

    problem: Problem
    centre: Array
    axes: Array
    size: Array

    @classmethod
    def of(cls, problem: Problem) -> Across:
        """Return a flat batch of N problems with coplanar stations in the coordinates of their plane."""
        count = problem.batch_shape[0]
        centre, axes, _, size = plane_of_stations(problem)
        # the normal, the first column, becomes the last
        centre, axes = np.broadcast_to(centre, (count, centre.shape[-1])), axes[..., ::-1]
        axes = np.broadcast_to(axes, (count, *axes.shape[-2:]))
        place = (problem.stations.position - centre[:, None, None]) @ axes[:, None]
        place[..., -1] = 0.0
        stations = replace(problem.stations, position=place)
        turned = replace(problem, stations=stations, constraints=())
        return cls(turned, centre, axes, np.broadcast_to(np.where(size > 0.0, size, 1.0), (count,)))

    def take(self, items: Array) -> Across:
        """Return the problems with the numbers `items`."""
        return Across(self.problem.take(items), self.centre[items], self.axes[items], self.size[items])

    @property
    def part(self) -> slice:
        """Return the slice of the position in a vector of unknowns."""
        slot, _ = self.problem.layout.find("position")
        return slice(slot.start, slot.start + slot.size)

    @property
    def least(self) -> Array:
        """Return the distances from the plane (N,) that count as zero, m; derivatives by q exist only above zero."""
        return _ZERO_DISTANCE * self.size

    def to_plane(self, x: Array) -> Array:
        """Return vectors (N, size) with the position in plane coordinates, on the side with positive w."""
        out = np.array(x)
        place = ((x[:, self.part] - self.centre)[:, None] @ self.axes)[:, 0]
        place[:, -1] = np.abs(place[:, -1])
        out[:, self.part] = place
        return out

    def to_space(self, x: Array, side: Array) -> Array:
        """Return vectors (N, size) in the original coordinates, on one side of the plane.

        `x` (N, size) is in plane coordinates. `side` (N,) is 1 for the side of the normal and -1 for the other side.
        """
        out = np.array(x)
        place = x[:, self.part].copy()
        place[:, -1] *= side
        out[:, self.part] = self.centre + (self.axes @ place[..., None])[..., 0]
        return out

    def refine(self, x: Array, *, held: bool) -> tuple[Array, Array, Array]:
        """Return the refined vectors (N, size), their costs and their `Status` numbers (N,), by steps in plane and q.

        `x` (N, size) are the starts in plane coordinates. With `held`, the distance from the plane keeps its value.
        """
        start = np.array(x)
        axis = self.part.stop - 1
        start[:, axis] = np.maximum(start[:, axis], self.least)
        least = start[:, axis] if held else self.least
        with np.errstate(all="ignore"):
            done = refine(
                self.problem,
                start,
                tolerance=_PROFILED if held else _SETTLED,
                limit=_STEPS,
                folded=Folded(axis, least, held),
            )
        return done.x, done.cost, done.status

    def profile(self, x: Array, w: Array) -> tuple[Array, Array]:
        """Return the optimal vectors (N, size) and their costs (N,) at fixed distances `w` (N,) from the plane, m.

        `x` (N, size) are starts in plane coordinates; `w` replaces the distances from the plane in `x`.
        """
        start = np.array(x)
        start[:, self.part.stop - 1] = w
        end, cost, _ = self.refine(start, held=True)
        return end, cost


def is_symmetric(problem: Problem) -> bool:
    """Return whether rows and priors are equal for mirror images of the target in a plane of all stations."""
    if not one_position(problem) or depends_on_place(problem) or problem.stations.errors:
        return False
    if problem.fences or any(name == "position" for name, _, _ in prior_parts(problem)):
        return False
    return problem.medium is None and all(is_of_ranges(rows.kind) for rows in problem.rows)


def is_coplanar(problem: Problem) -> Array:
    """Return a mask (N,) of problems with all stations in one plane, or on one line for problems in the plane.

    Distances from the plane far below the noise count as zero. The mask is False if the two sides of the plane differ
    for other reasons, such as bearings or a prior on the position.
    """
    count = problem.batch_shape[0]
    if not is_symmetric(problem):
        return np.zeros(count, dtype=bool)
    # `off` is the largest distance of a station from the plane, `size` the largest distance from the centre, m
    _, _, off, size = plane_of_stations(problem)
    return np.broadcast_to(off <= np.maximum(_COPLANAR * size, _NOISE_SHARE * _noise(problem)), (count,))


def _noise(problem: Problem) -> Array:
    """Return the smallest standard deviation of the present rows (N or 1,), m; zero if a row depends on no range."""
    if any(MODELS[rows.kind].ranges is None for rows in problem.rows):
        return np.zeros(1)
    sigma = np.sqrt(variances(problem.noise, problem.count))
    return np.asarray(np.where(problem.weight > 0.0, sigma, np.inf).min(-1).reshape(-1))


def normal_of(problem: Problem) -> Array | None:
    """Return the unit normal (d,) of the plane of the stations, or None if the two sides of the plane differ."""
    if problem.constraints or not is_coplanar(problem).all():
        return None
    return np.asarray(plane_of_stations(problem)[1][0, :, 0])


def distance_from_plane(problem: Problem, fix: Fix, level: float = 0.95) -> tuple[float, float]:
    """Return the interval of the distance of a target from the plane of all stations.

    It follows from the profile likelihood. The interval holds the distances whose minimal cost is at most the cost of
    the fix plus a quantile of chi-square. Both sides of the plane fit equally well, so the distance has no sign.

    Parameters
    ----------
    problem : Problem
        A single problem: one static position; ranges or sums, differences or ratios of ranges; no constraints.
    fix : Fix
        Its fix.
    level : float
        Probability that the interval holds the distance.

    Returns
    -------
    low, high : float
        Metres. `low` is zero if the target may be in the plane. `high` is infinite if no distance is excluded.

    Raises
    ------
    InvalidProblem
        If the stations are not in one plane, for other rows, or for a fix without a position.

    References
    ----------
    S. A. Murphy and A. W. van der Vaart, "On profile likelihood", J. Am. Stat. Assoc. 95 (2000) 449-465.
    """
    flat, x = problem.flat(), fix.flat().x
    if problem.constraints or not is_coplanar(flat).all():
        raise InvalidProblem(
            "the stations have no plane of symmetry",
            "problem",
            "give ranges of stations in one plane, without constraints",
        )
    if not np.isfinite(x).all():
        raise InvalidProblem("the fix has no position", "fix", "see its status for the reason")
    across = Across.of(flat)
    in_plane = across.to_plane(x)
    _, cost = across.profile(in_plane, in_plane[:, across.part.stop - 1])
    low, high = interval_across(across, in_plane, cost, level)
    return float(low[0]), float(high[0])


def information_in_square(across: Across, x: Array) -> tuple[Array, Array]:
    """Return the information (N, n, n) on the n shared unknowns, and a mask (N,) of its existence.

    The unknown w, the distance from the plane, is replaced by q = w^2: derivatives by q are derivatives by w divided by
    2 w. A distance w of zero is increased to `across.least`. `x` (N, size) is in plane coordinates. The mask is False
    if the local unknowns of the only epoch are not determined.
    """
    axis = across.part.stop - 1
    start = np.array(x)
    start[:, axis] = np.maximum(start[:, axis], across.least)
    with np.errstate(all="ignore"):
        information, _, ok = marginal(equations_at(across.problem, start))
    scale = np.ones((len(x), information.shape[-1]))
    scale[:, axis] = 0.5 / start[:, axis]
    return information * scale[:, :, None] * scale[:, None, :], ok


def interval_across(across: Across, x: Array, cost: Array, level: float = REGION_LEVEL) -> tuple[Array, Array]:
    """Return the ends (N,) of the interval of the distance from the plane, by the profile of the cost.

    `x` (N, size) are the fixes in plane coordinates and `cost` (N,) their costs. Both ends are in metres. The upper end
    is infinite if no distance up to a million spreads of the stations has a high enough cost. The lower end is zero if
    the cost on the plane is low enough. `level` is the probability of the interval.
    """
    rise, w = quantile(level, 1), x[:, across.part.stop - 1]
    sigma = _spread_of_square(across, x)
    _, on_plane = across.profile(x, across.least)
    # The lower end is above zero only if the cost on the plane is too high. `ends` are q and cost of the fix, then of a
    # point with a higher cost. A quadratic cost reaches the limit sqrt(rise) standard deviations from the fix.
    off_plane, low = np.flatnonzero(on_plane - cost > rise), np.zeros(len(x))
    if len(off_plane):
        least = across.least[off_plane] ** 2
        ends = (w[off_plane] ** 2, cost[off_plane], least, on_plane[off_plane])
        low[off_plane] = _crossing(
            across.take(off_plane), x[off_plane], rise, ends, w[off_plane] ** 2 - np.sqrt(rise) * sigma[off_plane]
        )
    far, far_cost = _bracket(across, x, cost + rise, sigma)
    bounded, high = np.flatnonzero(np.isfinite(far)), np.full(len(x), np.inf)
    if len(bounded):
        ends = (w[bounded] ** 2, cost[bounded], far[bounded] ** 2, far_cost[bounded])
        high[bounded] = _crossing(
            across.take(bounded), x[bounded], rise, ends, w[bounded] ** 2 + np.sqrt(rise) * sigma[bounded]
        )
    return low, high


def _spread_of_square(across: Across, x: Array) -> Array:
    """Return the standard deviations (N,) of q, m^2; the squared sizes of the arrays if q has no information."""
    covariance, _ = linalg.inverse(information_in_square(across, x)[0])
    axis = across.part.stop - 1
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.maximum(covariance[:, axis, axis], 0.0))
    return np.where(np.isfinite(sigma) & (sigma > 0.0), sigma, across.size**2)


def _bracket(across: Across, x: Array, top: Array, sigma: Array) -> tuple[Array, Array]:
    """Return distances (N,) from the plane, m, whose profile cost exceeds the limit `top` (N,), and these costs (N,).

    These distances are start values for a search of the upper end. A distance is infinite if the cost stays below the
    limit at all tried distances. `x` (N, size) are the fixes in
    plane coordinates, and `sigma` (N,) the standard deviations of q, m^2.
    """
    # one step is enough if the cost is quadratic in q
    far = np.sqrt(x[:, across.part.stop - 1] ** 2 + _FIRST_STEP * sigma)
    reached, cost = across.profile(x, far)
    for _ in range(_FURTHER):
        within = cost <= top
        if not within.any():
            break
        far = np.where(within, 4.0 * far, far)
        refined, new_cost = across.profile(reached, far)
        cost = np.where(within, new_cost, cost)
        reached = np.where((cost <= top)[:, None], refined, reached)
    return np.where(cost <= top, np.inf, far), cost


def _crossing(across: Across, x: Array, rise: float, ends: tuple[Array, ...], first: Array) -> Array:
    """Return the distances (N,), m, at which the profile of the cost reaches `rise` above the fix.

    False position in q uses the square root of the rise, which is nearly linear in q. `x` (N, size) are the fixes in
    plane coordinates. `ends` are four arrays (N,): q and cost of the fix, then q and cost of a point with a larger
    rise. `first` (N,) is the expected q of the crossing, m^2.

    References
    ----------
    M. Dowell and P. Jarratt, "A modified regula falsi method for computing the root of an equation", BIT 11 (1971).
    """
    # a and b are the ends of the search in q; low and high are the excesses of the root of the rise there. side is 1
    # after a change of b, -1 after a change of a, and 0 at the start.
    a, least, b, above = ends
    root_rise = np.sqrt(rise)
    low, high, side = np.full(len(x), -root_rise), np.sqrt(above - least) - root_rise, np.zeros(len(x))
    q, reached = np.where((first > np.minimum(a, b)) & (first < np.maximum(a, b)), first, 0.5 * (a + b)), x
    for _ in range(_TRIALS):
        refined, cost = across.profile(reached, np.sqrt(q))
        excess = np.where(np.isfinite(cost), np.sqrt(np.maximum(cost - least, 0.0)) - root_rise, np.inf)
        if (np.abs(excess) <= _CLOSE).all():
            break
        over = excess > 0.0
        reached = np.where(over[:, None], reached, refined)
        # an end that stays for two iterations counts half, as in the modified regula falsi
        low, high = np.where(over & (side > 0.0), 0.5 * low, low), np.where(~over & (side < 0.0), 0.5 * high, high)
        a, low = np.where(over, a, q), np.where(over, low, excess)
        b, high = np.where(over, q, b), np.where(over, excess, high)
        side = np.where(over, 1.0, -1.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            q = (a * high - b * low) / (high - low)
        q = np.where(np.isfinite(q), q, 0.5 * (a + b))
    return np.sqrt(q)
