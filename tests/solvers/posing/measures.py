"""What every posed problem has to meet, measured on one random problem of a formulation at a random scale."""

from inspect import signature

import numpy as np
from solvers.posing.scenes import METHODS, SCENES

from optloc import constraints, pose, solve

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
    problem, d = drawn(formulation, seed), None
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
    """Return by how much bound and value exceed the least cost of the same program over many points; negative if not.

    The judge evaluates the posed cost itself: at random points of the quadric for squared ranges, and at the
    maximum-likelihood fix and points around it for the bounds of the likelihood.
    """
    problem = drawn(formulation, seed)
    posed = pose(problem, formulation)
    found = posed.solve(refine=False).posed
    least = least_cost(posed, problem, formulation)
    return max(found.bound, found.value) - least, 1.0 + abs(least)


def least_cost(posed, problem, formulation):
    """Return the least posed cost over a multi-start with SciPy that knows nothing of the relaxation."""
    from scipy.optimize import least_squares

    if formulation in ("moment_sdp", "lifted"):
        return float(solve(problem, "searched").cost)
    rows = squared_rows_of(posed)
    centre, unit = posed.origin, posed.unit
    best = np.inf
    rng = np.random.default_rng(1)
    for start in [*rng.uniform(-3.0, 3.0, (24, len(centre)))]:
        end = least_squares(rows, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        best = min(best, 2.0 * end.cost)
    assert unit > 0.0
    return best


def squared_rows_of(posed):
    """Return the residuals of squared ranges as a function of the scaled position, from the expressions of a pose."""
    constant, slope = affine(posed.residual, posed)
    place, turn = affine(posed.position, posed)
    cone = "range" in posed.statement.parts
    last_at, last_turn = affine(posed.range, posed) if cone else (None, None)
    quadric = posed.statement

    def rows(x):
        return quadric_rows(x)

    def quadric_rows(x):
        r = np.linalg.norm(x)
        y = np.append(x, r if cone else r * r)
        # the unknowns w of the program from y, by the two affine maps
        stack = np.concatenate([turn / posed.unit, (last_turn / posed.unit if cone else LAST(posed))])
        shift = np.concatenate([(place - posed.origin) / posed.unit, (last_at / posed.unit if cone else LAST0(posed))])
        w = np.linalg.solve(stack, y - shift)
        return constant + slope @ w

    assert quadric is not None
    return rows


def LAST(posed):
    return posed.last[:, :-1]


def LAST0(posed):
    return posed.last[:, -1]


def affine(expression, posed):
    """Return constant (m,) and matrix (m, n) of an affine expression of the first moments of the program."""
    lift = posed.statement.program.variables()[0]
    shape = lift.shape
    n = shape[0] - (1 if len(shape) == 2 else 0)
    before = lift.value
    values = []
    for k in range(n + 1):
        w = np.zeros(n) if k == 0 else np.eye(n)[k - 1]
        lift.value = w if len(shape) == 1 else np.outer(np.append(w, 1.0), np.append(w, 1.0))
        values.append(np.ravel(expression.value))
    lift.value = before
    return values[0], np.stack([one - values[0] for one in values[1:]], axis=1)


def apart_from_method(formulation, seed):
    """Return the distance in standard deviations between a pose without changes and the method of the same name."""
    problem = drawn(formulation, seed)
    fix, expected = pose(problem, formulation).solve(), solve(problem, METHODS[formulation])
    if not expected.answered:
        return None
    n = expected.layout.n_shared
    sigma = np.sqrt(np.diagonal(expected.cov))
    return float(np.max(np.abs(fix.x[:n] - expected.x[:n]) / np.where(sigma > 0.0, sigma, 1.0)))
