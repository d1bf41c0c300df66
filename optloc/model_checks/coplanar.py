"""How far a target is from the plane of all stations, both sides of which fit alike.

The cost is one of the place in the plane and of q = w^2, the square of the distance. The law of w follows from
the profile of the cost over q: near the plane no Gaussian describes it.
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
"""Probability of the interval of the distance from the plane, which separates one region from two."""
JOINED = quantile(REGION_LEVEL, 1)
"""Cost on the plane, above the least, up to which both sides of it are one region."""

# Share of the spread of the stations by which they may be off a plane: rounding of their coordinates. And the share of
# the noise: it changes a residual by a thousandth of a standard deviation at most.
_COPLANAR, _UNHEARD = 1e-9, 1e-3
# Share of the spread of the stations that counts as no distance: its square changes no range by a digit that counts.
_NONE = 1e-6
# Steps at most: the cost is nearly quadratic in q, and most take two.
_STEPS = 100
# Length of the last step, standard deviations: of a fix it is far below any uncertainty, and the cost of a profile is
# off by its square.
_SETTLED, _PROFILED = 1e-7, 1e-2
# Standard deviations of q at which the end of its interval is looked for first: of a Gaussian it is at two.
_FIRST = 2.5
# Fourfold steps away from the plane: twelve lead a million spreads of the stations away.
_FURTHER = 12
# Steps towards an end at most, and the standard deviations that it may be off.
_TRIALS, _CLOSE = 20, 1e-2


@dataclass(frozen=True, slots=True)
class Across:
    """N problems in coordinates of which the last is the distance from the plane of the stations.

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
        centre, axes, _, size = plane_of_stations(problem)
        centre, axes = np.broadcast_to(centre, (count, centre.shape[-1])), axes[..., ::-1]
        axes = np.broadcast_to(axes, (count, *axes.shape[-2:]))
        place = (problem.stations.position - centre[:, None, None]) @ axes[:, None]
        place[..., -1] = 0.0
        stations = replace(problem.stations, position=place)
        turned = replace(problem, stations=stations, constraints=())
        return cls(turned, centre, axes, np.broadcast_to(np.where(size > 0.0, size, 1.0), (count,)))

    def take(self, items: Array) -> Across:
        """Return some of them."""
        return Across(self.problem.take(items), self.centre[items], self.axes[items], self.size[items])

    @property
    def part(self) -> slice:
        """Return the slice of the position in the vector of unknowns."""
        slot, _ = self.problem.layout.find("position")
        return slice(slot.start, slot.start + slot.size)

    @property
    def least(self) -> Array:
        """Return the distances (N,) that count as zero, metres."""
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
        """Return the ends of steps in the plane and in q: vectors (N, size), costs and `Status` numbers (N,).

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
            done = refine(
                self.problem,
                start,
                tolerance=_PROFILED if held else _SETTLED,
                limit=_STEPS,
                folded=Folded(own, least, held),
            )
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
    if any(name == "position" for name, _, _ in prior_parts(problem)):
        return False
    return problem.medium is None and all(is_of_ranges(rows.kind) for rows in problem.rows)


def is_coplanar(problem: Problem) -> Array:
    """Return whether all stations of each problem lie in one plane, or in the plane on one line, (N,).

    So do stations that are off it by far less than the noise.
    """
    count = problem.batch_shape[0]
    if not is_symmetric(problem):
        return np.zeros(count, dtype=bool)
    _, _, off, size = plane_of_stations(problem)
    return np.broadcast_to(off <= np.maximum(_COPLANAR * size, _UNHEARD * _noise(problem)), (count,))


def _noise(problem: Problem) -> Array:
    """Return the least standard deviation (N or 1,) of the ranges, metres; zero for other rows."""
    if any(MODELS[rows.kind].ranges is None for rows in problem.rows):
        return np.zeros(1)
    sigma = np.sqrt(variances(problem.noise, problem.count))
    return np.asarray(np.where(problem.weight > 0.0, sigma, np.inf).min(-1).reshape(-1))


def normal_of(problem: Problem) -> Array | None:
    """Return the normal (d,) of the plane of the stations of one problem, or None where its sides are not alike."""
    if problem.constraints or not is_coplanar(problem).all():
        return None
    return np.asarray(plane_of_stations(problem)[1][0, :, 0])


def distance_from_plane(problem: Problem, fix: Fix, level: float = 0.95) -> tuple[float, float]:
    """Return the interval of the distance of a target from the plane that all stations lie in.

    It follows from the profile likelihood: in it the least cost is below the cost of the fix plus a quantile of
    chi-square. Both sides of the plane fit alike, so the distance has no sign.

    Parameters
    ----------
    problem : Problem
        A single problem: one position that stays, ranges or sums, differences or ratios of ranges, no constraints.
    fix : Fix
        Its fix.
    level : float
        Probability that the interval holds the distance.

    Returns
    -------
    low, high : float
        Metres; `low` is zero where the target may lie in the plane, `high` is infinite where no distance is excluded.

    Raises
    ------
    InvalidProblem
        For stations that lie in no plane, other rows, or a fix without a position.

    References
    ----------
    S. A. Murphy and A. W. van der Vaart, "On profile likelihood", J. Am. Stat. Assoc. 95 (2000) 449-465.
    """
    flat, x = problem.flat(), fix.flat().x
    if problem.constraints or not is_coplanar(flat).all():
        raise InvalidProblem(
            "the sides of no plane fit alike", "problem", "give ranges of stations in one plane, without constraints"
        )
    if not np.isfinite(x).all():
        raise InvalidProblem("there is no position that an interval could be about", "fix", "see its status for why")
    across = Across.of(flat)
    at = across.to_plane(x)
    _, cost = across.profile(at, at[:, across.part.stop - 1])
    low, high = interval_across(across, at, cost, level)
    return float(low[0]), float(high[0])


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
    rise, w = quantile(level, 1), x[:, across.part.stop - 1]
    sigma = _spread_of_square(across, x)
    _, on_plane = across.profile(x, across.least)
    apart, low = np.flatnonzero(on_plane - cost > rise), np.zeros(len(x))
    if len(apart):
        least = across.least[apart] ** 2
        ends = (w[apart] ** 2, cost[apart], least, on_plane[apart])
        low[apart] = _crossing(across.take(apart), x[apart], rise, ends, w[apart] ** 2 - np.sqrt(rise) * sigma[apart])
    far, there = _beyond(across, x, cost + rise, sigma)
    found, high = np.flatnonzero(np.isfinite(far)), np.full(len(x), np.inf)
    if len(found):
        ends = (w[found] ** 2, cost[found], far[found] ** 2, there[found])
        high[found] = _crossing(across.take(found), x[found], rise, ends, w[found] ** 2 + np.sqrt(rise) * sigma[found])
    return low, high


def _spread_of_square(across: Across, x: Array) -> Array:
    """Return standard deviations (N,) of q; the squared sizes of the arrays where q has no information."""
    covariance, _ = linalg.inverse(information_in_square(across, x)[0])
    own = across.part.stop - 1
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.maximum(covariance[:, own, own], 0.0))
    return np.where(np.isfinite(sigma) & (sigma > 0.0), sigma, across.size**2)


def _beyond(across: Across, x: Array, top: Array, sigma: Array) -> tuple[Array, Array]:
    """Return distances (N,) from the plane at which the profile of the cost is above a level (N,), and these costs."""
    # one step where the cost is quadratic in q
    far = np.sqrt(x[:, across.part.stop - 1] ** 2 + _FIRST * sigma)
    reached, cost = across.profile(x, far)
    for _ in range(_FURTHER):
        within = cost <= top
        if not within.any():
            break
        far = np.where(within, 4.0 * far, far)
        there, found = across.profile(reached, far)
        cost = np.where(within, found, cost)
        reached = np.where((cost <= top)[:, None], there, reached)
    return np.where(cost <= top, np.inf, far), cost


def _crossing(across: Across, x: Array, rise: float, ends: tuple[Array, ...], first: Array) -> Array:
    """Return the distances (N,) at which the profile of the cost reaches a rise: false position in q.

    What is followed is the root of the rise, which is nearly linear in q.

    Parameters
    ----------
    across, x : Across, array (N, size)
        The problems, and their fixes.
    rise : float
        Of the cost above the fix.
    ends : tuple of array (N,)
        The q of the fix and its cost; a q whose cost is above the level, and this cost.
    first : array (N,)
        Where the crossing is expected.

    References
    ----------
    M. Dowell and P. Jarratt, "A modified regula falsi method for computing the root of an equation", BIT 11 (1971).
    """
    a, least, b, above = ends
    wanted = np.sqrt(rise)
    low, high, side = np.full(len(x), -wanted), np.sqrt(above - least) - wanted, np.zeros(len(x))
    q, reached = np.where((first > np.minimum(a, b)) & (first < np.maximum(a, b)), first, 0.5 * (a + b)), x
    for _ in range(_TRIALS):
        there, cost = across.profile(reached, np.sqrt(q))
        now = np.where(np.isfinite(cost), np.sqrt(np.maximum(cost - least, 0.0)) - wanted, np.inf)
        if (np.abs(now) <= _CLOSE).all():
            break
        over = now > 0.0
        reached = np.where(over[:, None], reached, there)
        # an end that stays twice in a row counts half
        low, high = np.where(over & (side > 0.0), 0.5 * low, low), np.where(~over & (side < 0.0), 0.5 * high, high)
        a, low = np.where(over, a, q), np.where(over, low, now)
        b, high = np.where(over, q, b), np.where(over, now, high)
        side = np.where(over, 1.0, -1.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            q = (a * high - b * low) / (high - low)
        q = np.where(np.isfinite(q), q, 0.5 * (a + b))
    return np.sqrt(q)
