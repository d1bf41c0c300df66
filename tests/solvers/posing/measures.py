"""What every posed problem has to meet, measured on one random problem of a formulation at a random scale."""

from dataclasses import dataclass
from functools import cache, partial
from inspect import signature
from itertools import pairwise, product

import numpy as np
from scipy.optimize import least_squares, minimize
from solvers.posing.scenes import METHODS, SCENES

from formulations.minimax_cone import minimax
from formulations.range_height import locate as exact_points
from optloc import constraints, pose, solve
from optloc.base.frames import geodetic_to_ecef
from optloc.linear.least_squares_ranges import ranges
from optloc.linear.vectors import problem_at_rest
from optloc.models.primitives import WGS84_A
from optloc.problem.posed_answer import PosedAnswer
from optloc.solvers.starts.angles import bearings, complete_bearings, cones_of, sights
from optloc.solvers.starts.position import height_sights, spread_of
from optloc.solvers.starts.squared_range import hull, last_weighting, shor

# Steps of the difference quotient, in standard deviations of the position: large where the value has few digits, and
# small where it has kinks. The first step is of the formulation; the others serve if two quotients disagree.
STEPS = {"nls": 1e-3, "minimax_cone": 1e-2, "registration_sdp": 1.0}
STEP, OTHERS = 0.05, (0.5, 0.01, 0.1)
# Formulations whose value has so few digits that steps are large, and quotients are extrapolated once more.
COARSE = ("registration_sdp",)
# Two quotients that differ by less, relative to their size, are near the derivative.
AGREE = 5e-5
# Smaller steps than this one, in standard deviations, do not bound a dual: the value has too few digits.
WIDE = 0.05
# Formulations whose rows fit exactly at isolated points: a half-plane beside the point has no solution.
ISOLATED = ("range_height_conic",)
WITHOUT_POSITION = ("direction_sdp",)
# Powers of metres of the costs that are no chi-square. Chi-square has a natural unit, one.
IN_METRES = {"minimax_cone": 1, "range_height_conic": 2}
# Methods of the covariance that sets the size of steps, where the default takes a minute.
QUICK = {"registration_sdp": "sdp+lsr"}


def drawn(formulation, seed):
    """Return a random problem of a formulation, of any size from a millimetre to a million kilometres."""
    scene = SCENES[formulation][seed % len(SCENES[formulation])]
    scale = 10.0 ** np.random.default_rng(seed).uniform(-3.0, 9.0)
    return scene(seed, scale) if "scale" in signature(scene).parameters else scene(seed)


def worst_residual(formulation, seed):
    """Return the largest of primal residual, dual residual and relative gap of a problem without changes."""
    return pose(drawn(formulation, seed), formulation).solve(refine=False).posed.backend.worst


@dataclass(frozen=True, slots=True)
class Fenced:
    """A problem without changes, and with a half-plane beside its optimum.

    Parameters
    ----------
    base : PosedAnswer
        The answer without the half-plane.
    unit : float
        Unit of length, metres.
    outcome : str
        Outcome with the half-plane; "no point" if the rows alone have no solution, "failed" if the solver found none.
    worst : float
        Largest residual of both solves.
    error : float
        Error of the dual over the larger of the quotient and the value, per unit of length; NaN without a solution.
    smooth : bool
        Whether quotients of two steps agree. The error is the difference from the extrapolated quotient then. At a kink
        it is the distance of the dual from the slopes of all supporting lines, since the optimum is a convex function.
    """

    base: PosedAnswer
    unit: float
    outcome: str
    worst: float
    error: float = np.nan
    smooth: bool = True


def fenced(formulation, seed):
    """Return reports and errors of a problem without changes, and with a half-plane beside its optimum."""
    problem = drawn(formulation, seed)
    plain = pose(problem, formulation)
    base, unit = plain.solve(refine=False), plain.unit
    if base.posed.backend.outcome == "infeasible":
        return Fenced(base.posed, unit, "no point", 0.0)
    if not np.isfinite(base.x).all():
        return Fenced(base.posed, unit, "failed", np.nan)
    normal, offset, sigma = fence_beside(problem, formulation, base, seed)

    @cache
    def at(step):
        posed = pose(problem, formulation)
        posed.add(constraints.half_plane(normal, offset + step * sigma), name="fence")
        return posed.solve(refine=False).posed

    here, worst = at(0.0), base.posed.backend.worst
    if here.backend.outcome == "infeasible":
        return Fenced(base.posed, unit, "infeasible", worst)
    worst = float(np.max([worst, here.backend.worst]))
    error, smooth = dual_error(formulation, at, unit, sigma)
    return Fenced(base.posed, unit, here.backend.outcome, worst, float(error), smooth)


def dual_error(formulation, at, unit, sigma):
    """Return the relative error of a dual, and whether quotients of two steps agree.

    Parameters
    ----------
    formulation : str
        Name of the formulation.
    at : callable
        Answer with the half-plane moved by a multiple of `sigma`.
    unit, sigma : float
        Unit of length and standard deviation, metres.
    """
    here, slope = at(0.0), unit / sigma
    dual, natural = here.duals["fence"] * unit, 0.0 if formulation in IN_METRES else 1.0
    tried = (STEPS.get(formulation, STEP), *OTHERS)
    for step in tried:
        halves = [step * 0.5**k for k in range(3 if formulation in COARSE else 2)]
        quotient, order = [-(at(h).value - at(-h).value) / (2.0 * h) * slope for h in halves], 4.0
        size = max(abs(quotient[0]), natural + abs(here.value))
        while len(quotient) > 2:
            quotient = [(order * b - a) / (order - 1.0) for a, b in pairwise(quotient)]
            order *= 4.0
        if abs(quotient[0] - quotient[1]) < AGREE * size:
            return abs(dual - (order * quotient[1] - quotient[0]) / (order - 1.0)) / size, True
    if formulation == "nls":  # its optimum is no convex function of the offset
        return np.nan, False
    wide = [h for step in tried for h in (step, 0.5 * step) if h >= WIDE]
    low = max((here.value - at(h).value) / h * slope for h in wide)
    high = min((at(-h).value - here.value) / h * slope for h in wide)
    return max(low - dual, dual - high, 0.0) / size, False


def fence_beside(problem, formulation, base, seed):
    """Return normal and offset of a half-plane a standard deviation beside an optimum, and this deviation in metres."""
    fix, d = solve(problem, QUICK.get(formulation, "auto")), problem.stations.dimension
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=d)
    normal /= np.linalg.norm(normal)
    unit = float(spread_of(problem.flat())[1][0])
    spread = normal @ fix.cov[:d, :d] @ normal
    sigma = min(np.sqrt(spread) if spread > 0.0 else 1e-3 * unit, 1e-2 * unit)
    return normal, normal @ base.x[:d] - sigma, sigma


def points_of_heights(problem):
    """Return the points (q, 3) on the ellipsoid that fit two range differences exactly, by SciPy from many starts."""
    station, z = problem.stations.position.reshape(-1, 3), np.ravel(problem.observed)[:2]

    def residual(angles):
        reach = np.linalg.norm(geodetic_to_ecef(*angles, 0.0) - station, axis=1)
        return reach[1:] - reach[0] - z

    found = []
    for start in product(np.radians(np.arange(-75.0, 76.0, 30.0)), np.radians(np.arange(-175.0, 180.0, 30.0))):
        end = least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=60)
        if np.abs(end.fun).max() < 1e-3:  # metres
            found.append(geodetic_to_ecef(*end.x, 0.0))
    return np.array(found).reshape(-1, 3)


def denied_points(formulation, seed, *, fence):
    """Return how many points fit the rows, and the half-plane with `fence`, although a program has no solution."""
    problem = drawn(formulation, seed)
    found = points_of_heights(problem)
    if not fence:
        return len(found)
    base = pose(problem, formulation).solve(refine=False)
    normal, offset, sigma = fence_beside(problem, formulation, base, seed)
    return int((found @ normal < offset - 1e-6 * sigma).sum())


def above_multi_start(formulation, seed):
    """Return by how much bound and value exceed the least posed cost over many points; see `above_least`."""
    posed = pose(drawn(formulation, seed), formulation)
    return above_least(formulation, seed, posed.solve(refine=False).posed, posed.unit)


def above_least(formulation, seed, found, unit):
    """Return by how much an answer exceeds the least posed cost over many points, relative to one plus this cost.

    The judge evaluates the cost itself at points, and knows nothing of the relaxation. A cost in metres is relative to
    the unit of length.
    """
    least = LEAST[formulation](drawn(formulation, seed).flat())
    one = unit ** IN_METRES.get(formulation, 0)
    return float((np.nanmax([found.bound, found.value]) - least) / (one + abs(least)))


def least_squared(problem, pick):
    """Return the least squared-range cost over starts around the stations, by SciPy on the rows."""
    alone = problem_at_rest(problem)
    squared, rows, right = last_weighting(alone, ranges(alone), pick)
    cone = squared.quadric.shape == "cone"

    def residual(x):
        length = np.linalg.norm(x)
        return rows[0] @ np.append(x, length if cone else length**2) - right[0]

    starts = np.random.default_rng(1).uniform(-3.0, 3.0, (12, problem.dimension))
    return min(2.0 * least_squares(residual, x, xtol=1e-15, ftol=1e-15, gtol=1e-15).cost for x in starts)


def least_chordal(problem):
    """Return the least chordal cost of directions over starts around the stations, by SciPy."""
    seen = bearings(problem_at_rest(problem))
    given = sights(seen, *complete_bearings(seen)[0])
    angle, sigma, station = given["angle"], given["sigma"], given["station"]
    across = np.stack([-np.sin(angle[:, 0]), np.cos(angle[:, 0]), 0.0 * angle[:, 0]], axis=1)
    level = np.stack([np.cos(angle[:, 0]), np.sin(angle[:, 0])], axis=1)
    ahead = np.concatenate([np.cos(angle[:, 1:]) * level, np.sin(angle[:, 1:])], axis=1)
    up = np.cross(ahead, across)
    flat, steep = 1.0 / (sigma[:, 0] * np.cos(angle[:, 1])), 1.0 / sigma[:, 1]

    def residual(x):
        line = x - station
        off = line / np.linalg.norm(line, axis=1, keepdims=True) - ahead
        parts = (
            np.minimum(flat, steep) * (off * ahead).sum(1),
            flat * (off * across).sum(1),
            steep * (off * up).sum(1),
        )
        return np.concatenate(parts)

    starts = np.random.default_rng(1).uniform(-2.0, 2.0, (24, 3))
    return min(2.0 * least_squares(residual, x, xtol=1e-15, ftol=1e-15, gtol=1e-15).cost for x in starts)


def least_likely(problem):
    """Return the least maximum-likelihood cost that a search from many positions finds."""
    return float(solve(problem, "searched").cost[0])


def least_far(problem):
    """Return the least squared distance from the point below the stations, m^2, over all points that fit exactly.

    The points are those of the closed form of range differences and a height.
    """
    given = height_sights(problem_at_rest(problem))
    near, first = given["near"], given["stations"][0]
    found = exact_points(given["stations"], given["sign"], given["offset"], given["surface"])
    far = ((found.x - near) ** 2).sum(-1) + (found.ranges[..., 0] - np.linalg.norm(near - first)) ** 2
    return WGS84_A**2 * float(np.min(far[found.valid], initial=np.inf))


def least_ball(problem):
    """Return minus the largest radius of a ball inside the smallest cones, metres, by searches from many points."""
    seen = bearings(problem_at_rest(problem))
    ahead, station, scale = cones_of(seen, 0)
    found = minimax(ahead, station, scale)
    theta = np.minimum(found.level * scale, 0.5 * np.pi - 0.01)
    sigma = np.min(scale * np.linalg.norm(found.point - station, axis=1))

    def outside(w):
        line = found.point + sigma * w - station
        along = (line * ahead).sum(1)
        across = np.linalg.norm(line - along[:, None] * ahead, axis=1)
        return -np.min(np.sin(theta) * along - np.cos(theta) * across)

    starts = np.random.default_rng(1).normal(size=(12, 3))
    settings = {"xatol": 1e-12, "fatol": 1e-15, "maxiter": 2000}
    return float(seen.scale[0]) * min(minimize(outside, w, method="Nelder-Mead", options=settings).fun for w in starts)


LEAST = {
    "squared_range_conic: shor": partial(least_squared, pick=shor),
    "squared_range_conic: hull": partial(least_squared, pick=hull),
    "direction_sdp": least_chordal,
    "minimax_cone": least_ball,
    "moment_sdp": least_likely,
    "range_height_conic": least_far,
    "lifted": least_likely,
    "nls": least_likely,
}


def apart_from_method(formulation, seed):
    """Return the distance in standard deviations between a pose without changes and the method of the same name."""
    problem = drawn(formulation, seed)
    fix, expected = pose(problem, formulation).solve(), solve(problem, METHODS[formulation])
    if not expected.answered:
        return None
    n = expected.layout.n_shared
    sigma = np.sqrt(np.diagonal(expected.cov))
    return float(np.max(np.abs(fix.x[:n] - expected.x[:n]) / np.where(sigma > 0.0, sigma, 1.0)))
