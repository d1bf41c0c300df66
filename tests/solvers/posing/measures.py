"""What every posed problem has to meet, measured on one random problem of a formulation at a random scale."""

from functools import partial
from inspect import signature

import numpy as np
from scipy.optimize import least_squares
from solvers.posing.scenes import METHODS, SCENES

from optloc import constraints, pose, solve
from optloc.linear.least_squares_ranges import ranges
from optloc.linear.vectors import problem_at_rest
from optloc.solvers.starts.angles import bearings, complete_bearings, sights
from optloc.solvers.starts.squared_range import hull, last_weighting, shor

# Steps of the difference quotient, in standard deviations of the position: large where the value has few digits, and
# small where it has kinks.
STEPS = {"nls": 1e-3, "minimax_cone": 1e-2, "registration_sdp": 0.3}
# Formulations whose rows fit exactly at isolated points: a half-plane beside the point has no solution.
ISOLATED = ("range_height_conic",)
WITHOUT_POSITION = ("direction_sdp",)


def drawn(formulation, seed):
    """Return a random problem of a formulation, of any size from a millimetre to a million kilometres."""
    scene = SCENES[formulation][seed % len(SCENES[formulation])]
    scale = 10.0 ** np.random.default_rng(seed).uniform(-3.0, 9.0)
    return scene(seed, scale) if "scale" in signature(scene).parameters else scene(seed)


def worst_residual(formulation, seed):
    """Return the largest of primal residual, dual residual and relative gap of a problem without changes."""
    return pose(drawn(formulation, seed), formulation).solve(refine=False).posed.backend.worst


def fenced(formulation, seed):
    """Return reports and errors with a half-plane beside the optimum.

    Returns
    -------
    outcome : str
        "solved", or "infeasible".
    worst : float
        Largest residual with the half-plane.
    error : float
        Difference of dual and difference quotient over the larger of the quotient and the value, per unit of length.
    smooth : bool
        Whether quotients of two steps agree: at a kink and at rounding there is no derivative to compare.
    """
    problem = drawn(formulation, seed)
    base, fix = pose(problem, formulation).solve(refine=False), solve(problem)
    d = problem.stations.dimension
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=d)
    normal /= np.linalg.norm(normal)
    unit = pose(problem, formulation).unit
    spread = normal @ fix.cov[:d, :d] @ normal
    sigma = min(np.sqrt(spread) if spread > 0.0 else 1e-3 * unit, 1e-2 * unit)
    offset = normal @ base.x[:d] - sigma

    def at(level):
        posed = pose(problem, formulation)
        posed.add(constraints.half_plane(normal, level), name="fence")
        return posed.solve(refine=False).posed

    step = STEPS.get(formulation, 0.05) * sigma
    here = at(offset)
    if here.backend.outcome == "infeasible":
        return "infeasible", 0.0, 0.0, True
    quotient = [-(at(offset + h).value - at(offset - h).value) / (2.0 * h) * unit for h in (step, 0.5 * step)]
    size = max(abs(quotient[0]), 1.0 + abs(here.value))
    smooth = abs(quotient[0] - quotient[1]) < 5e-5 * size
    error = abs(here.duals["fence"] * unit - quotient[1]) / size
    return here.backend.outcome, here.backend.worst, error, smooth


def above_multi_start(formulation, seed):
    """Return by how much bound and value exceed the least posed cost over many points, relative to one plus this cost.

    The judge evaluates the cost itself at points, and knows nothing of the relaxation.
    """
    problem = drawn(formulation, seed)
    found = pose(problem, formulation).solve(refine=False).posed
    least = LEAST[formulation](problem.flat())
    return (np.nanmax([found.bound, found.value]) - least) / (1.0 + abs(least))


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


LEAST = {
    "squared_range_conic: shor": partial(least_squared, pick=shor),
    "squared_range_conic: hull": partial(least_squared, pick=hull),
    "direction_sdp": least_chordal,
    "moment_sdp": least_likely,
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
