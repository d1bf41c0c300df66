"""The inputs of a proof: costs over the position, surfaces and regions; and a check that a cost belongs to its fix.

Letters: N problems, P states for each problem, d coordinates, and n numbers of a state: d for the position, or 2 d with
the velocity. Positions are in metres in the frame of the problem, and velocities in metres per second.
"""

from __future__ import annotations

import numpy as np

from optloc.base import linalg
from optloc.base.types import AnyOf, Array, Band, Polygon
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import exact, is_exact
from optloc.linear.normal import eliminated, step
from optloc.models.primitives import geodetic_normal
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.proof.batch import ProofRequest, ProofResult, costs_at, lacks_code, prove_all
from optloc.proof.nodes.level import height_numbers
from optloc.proof.position_costs import PositionCosts, position_costs
from optloc.proof.runs.prove import costs_of_courses, costs_of_runs, prove_courses, prove_runs, runs_lack_code
from optloc.proof.runs.run_costs import CourseCosts, Runs, course_costs, run_costs
from optloc.proof.scaled.scaled_proof import (
    ScaledCosts,
    costs_at_scaled,
    prove_all_scaled,
    scaled_costs,
    scaled_lack_code,
    velocity_costs,
)
from optloc.proof.scope import has_one_epoch_velocity, held_height, is_run, is_scaled
from optloc.proof.surface import DATA, FIRST, LEVEL, MIDDLE, SURFACE_WIDTH, UP
from optloc.solvers.starts.position import spread_of

# Costs over the state of the target: its position, or its position and velocity if it moves. Problems with few rows use
# dense costs, problems with many rows use sparse costs.

Costs = PositionCosts | ScaledCosts | Runs | CourseCosts


def eliminate_nuisance(problem: Problem) -> Costs:
    """Return the costs of a flat batch over the state of the target, minimised over all other unknowns.

    Proofs split boxes of states only, so the other unknowns must be eliminated first.
    """
    if has_one_epoch_velocity(problem):
        return velocity_costs(problem)
    if problem.motions[0].order > 0:
        return course_costs(problem)
    if is_scaled(problem):
        return scaled_costs(problem)
    return run_costs(problem) if is_run(problem) else position_costs(problem)


def prove(costs: Costs, asked: ProofRequest) -> ProofResult:
    """Return the results of the proofs of n fixes, from the costs of their problems and the n requests `asked`."""
    if isinstance(costs, CourseCosts):
        return prove_courses(costs, asked)
    if isinstance(costs, ScaledCosts):
        return prove_all_scaled(costs, asked)
    return prove_runs(costs, asked) if isinstance(costs, Runs) else prove_all(costs, asked)


def lacks(costs: Costs, count: int) -> bool:
    """Return True if proofs of `count` fixes ended early because their machine code is not compiled yet."""
    if isinstance(costs, ScaledCosts):
        return scaled_lack_code(count)
    return lacks_code(count) if isinstance(costs, PositionCosts) else runs_lack_code(costs, count)


def costs_of(costs: Costs, states: Array) -> tuple[Array, Array]:
    """Return position costs (N, P) of states (N, P, n), and the rounding errors (N, P) of their residuals, in sigma."""
    if isinstance(costs, CourseCosts):
        return costs_of_courses(costs, states)
    if isinstance(costs, ScaledCosts):
        return costs_at_scaled(costs, states)
    return costs_of_runs(costs, states) if isinstance(costs, Runs) else costs_at(costs, states)


def state_columns(problem: Problem) -> slice:
    """Return the columns of parameter vectors that contain the state of a proof."""
    slot, _ = problem.layout.find("position")
    return slice(slot.start, slot.start + _state_size(problem))


def _state_size(problem: Problem) -> int:
    """Return the size of the state, without the velocity at a single epoch, which is linear and projected out."""
    return problem.dimension * (1 if has_one_epoch_velocity(problem) else problem.motions[0].order + 1)


# Equalities: a proof searches along their planes and surfaces only.


def surfaces_of(problem: Problem, position: Array) -> tuple[Array, Array]:
    """Return the planes and the surface to which equalities restrict the fixes of a flat batch.

    Parameters
    ----------
    problem : Problem
        N problems.
    position : array (N, d)
        Positions on these planes or near the surface.

    Returns
    -------
    planes : array (N, e, 3)
        Unit normals of e planes.
    surface : array (N, w)
        Numbers of the surface of a height (`optloc.proof.surface`); its upward axis is the normal at the position.
        Without a height w is 0.
    """
    if not exact(problem):  # a shortcut for the common case
        return np.zeros((len(position), 0, 3)), np.zeros((len(position), 0))
    bands = [band for band in problem.constraints if isinstance(band, Band) and is_exact(band)]
    return _planes(problem, bands, len(position)), _surface(problem, bands, position)


def _planes(problem: Problem, bands: list[Band], size: int) -> Array:
    """Return the unit normals (N, e, 3) of the e plane constraints among `bands`; N is `size`."""
    normals = [band.coefficients for band in bands if band.kind == "plane"]
    out = np.zeros((size, len(normals), 3))
    for i, normal in enumerate(normals):
        out[:, i, : problem.dimension] = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return out


def _surface(problem: Problem, bands: list[Band], position: Array) -> Array:
    """Return the w numbers (N, w) that describe the surface of a height constraint; w is 0 without a height.

    `bands` are the equalities of the problem. The order of the numbers is in `optloc.proof.surface`. The upward axis is
    the normal of the ellipsoid at the positions.
    """
    levels = [band.lower for band in bands if band.kind == "height"]
    if not levels:
        return np.zeros((len(position), 0))
    out, turn = np.zeros((len(position), SURFACE_WIDTH)), problem.frame.rotation_to_ecef()
    out[:, LEVEL], out[:, DATA:MIDDLE] = levels[0], height_numbers(problem)
    out[:, MIDDLE:FIRST] = -problem.frame.origin_ecef() @ turn
    place = problem.frame.to_ecef(np.where(np.isfinite(position), position, 0.0))
    out[:, UP:] = np.stack(geodetic_normal((place[:, 0], place[:, 1], place[:, 2])), axis=-1) @ turn
    return out


def is_free(problem: Problem, fix: Fix, items: Array) -> Array:
    """Return flags (n,) of fixes without an active inequality; `items` (n,) are their numbers in the batch.

    If active constraints are not recorded, the flags are False for a problem with equalities, else True.
    """
    face = exact(problem)
    if fix.active is None or not problem.constraints:
        return np.full(len(items), not face)
    return np.array([len(found) == len(face) for found in fix.active[items]], dtype=bool)


# Regions of claims.

# Half-widths of the fallback region if the proof cannot bound all positions. Positions: 10 spreads of the stations or 2
# distances of the fix, so that both are well inside. Velocities: 700 metres per second, above any aircraft.
_SPREADS, _DISTANCES, _FAST = 10.0, 2.0, 700.0


def regions_of(problem: Problem, state: Array, region: Array | None) -> tuple[Array, bool]:
    """Return corners (N, 2, n) of the regions of claims about states (N, n), and whether the region was requested.

    For a target at rest without a given region the search covers all positions: NaN. A moving target could be anywhere
    at any speed, so its claim needs a region. If constraints limit the position and the speed, they are the requested
    region. Otherwise the region is the box of `boxes_around`; see `why_unlimited`.

    Parameters
    ----------
    problem : Problem
        N problems.
    state : array (N, n)
        Positions, followed by velocities if the target moves.
    region : array (2, d) or (2, n), optional
        Requested corners.
    """
    size, n = state.shape
    out = np.full((size, 2, n), np.nan) if n == problem.dimension else boxes_around(problem, state)
    given = 0 if region is None else min(region.shape[-1], n)
    if region is not None:
        out[..., :given] = region[..., :given]
    if n == problem.dimension:
        return out, given > 0
    limits = admitted_states(problem, n)
    # constraints limit the coordinates without requested corners
    known = np.flatnonzero(np.isfinite(limits).all(0) & (np.arange(n) >= given))
    out[..., known] = limits[:, known]
    # a known height determines these coordinates, so they need no limit
    free = _across(problem)
    out[..., free] = [[-np.inf], [np.inf]]
    return out, set(range(n)) <= {*range(given), *known.tolist(), *free}


def why_unlimited(problem: Problem) -> str:
    """Return the reason why a proof of a moving target is useless without a requested region; "" if it is useful."""
    n = _state_size(problem)
    if n == problem.dimension or np.isfinite(np.delete(admitted_states(problem, n), _across(problem), axis=1)).all():
        return ""
    return "the target could be anywhere at any speed; add constraints: a box and a greatest speed"


def _across(problem: Problem) -> list[int]:
    """Return the indices in the state that a fixed height determines in a local frame: upward position and velocity.

    The list is empty without a fixed height or in an Earth-centred frame.
    """
    return [2, 5] if held_height(problem) is not None and problem.frame.kind != "ecef" else []


def admitted_states(problem: Problem, n: int) -> Array:
    """Return the least and the greatest states (2, n) that constraints admit; -inf and inf without a limit.

    Bounds of one coordinate, polygons, distances from points and a greatest speed count. The speed limits each
    component of the velocity.
    """
    d = problem.dimension
    out = np.stack([np.full(n, -np.inf), np.full(n, np.inf)])
    for band in problem.constraints:
        if isinstance(band, Polygon):
            if not band.outside:
                _limit(out, band.vertices.min(0), band.vertices.max(0))
            continue
        if isinstance(band, AnyOf):
            boxes = [box for box in map(_reach, band.members) if box is not None]
            if len(boxes) == len(band.members) and len({box.shape for box in boxes}) == 1:
                _limit(out, np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1])
            continue
        if band.lower.ndim or band.upper.ndim:
            continue
        near = _reach((band,))
        if near is not None:
            _limit(out, near[0], near[1])
            continue
        axis = np.flatnonzero(band.coefficients)
        if band.kind == "plane" and len(axis) == 1:
            factor = float(np.ravel(band.coefficients)[axis[0]])
            low, high = sorted((float(band.lower) / factor, float(band.upper) / factor))
            out[0, axis[0]], out[1, axis[0]] = max(out[0, axis[0]], low), min(out[1, axis[0]], high)
        elif band.kind == "speed":
            out[0, d:], out[1, d:] = -float(band.upper), float(band.upper)
    return out


def _limit(out: Array, low: Array, high: Array) -> None:
    """Limit the first coordinates of the states `out` (2, n) to a box with corners (k,)."""
    k = len(low)
    out[0, :k], out[1, :k] = np.maximum(out[0, :k], low), np.minimum(out[1, :k], high)


def _reach(member: tuple[Band, ...]) -> Array | None:
    """Return the corners (2, k) of a box around a conjunction with a greatest distance; None without one."""
    for band in member:
        if band.kind in ("distance", "segment") and band.upper.ndim == 0 and band.coefficients.ndim == 1:
            ends = band.coefficients.reshape(2 if band.kind == "segment" else 1, -1)
            return np.stack([ends.min(0) - band.upper, ends.max(0) + band.upper])
    return None


def boxes_around(problem: Problem, state: Array) -> Array:
    """Return the corners (N, 2, n) of boxes that contain states (N, n), far from the borders of the boxes.

    Positions are in cubes around the middle of the stations. Velocities of moving targets are in cubes around zero.
    """
    (centre, spread), d = spread_of(problem), problem.dimension
    with np.errstate(invalid="ignore"):
        away = np.nan_to_num(np.abs(state[:, :d] - centre).max(-1), nan=0.0)
        speed = np.nan_to_num(np.abs(state[:, d:]).max(-1, initial=0.0), nan=0.0)
    half = np.repeat(np.maximum(_SPREADS * spread, _DISTANCES * away)[:, None], d, axis=1)
    fast = np.repeat(np.maximum(_FAST, _DISTANCES * speed)[:, None], state.shape[-1] - d, axis=1)
    middle = np.concatenate([np.broadcast_to(centre, half.shape), np.zeros_like(fast)], axis=1)
    reach = np.concatenate([half, fast], axis=1)
    return np.stack([middle - reach, middle + reach], axis=1)


# Check whether a position cost belongs to its fix.

# Test positions per fix, about a standard deviation away. Two forms of the same cost agree there up to rounding, and
# two different costs differ by a share of one. A second test position would take half as much time again.
_BESIDE = 1
# Relative difference of costs that counts as rounding, as for a proof, and the factor of the rounding of a residual.
_EQUAL, _ROUNDINGS = 1e-6, 8.0
# Share of the largest eigenvalue of scaled information below which a combination of unknowns is undetermined.
_OPEN = 1e-12
# Gauss-Newton steps for unknowns that enter the rows nonlinearly (station errors). Each step squares the remaining
# error, and the relative error after the first step is some metres over some kilometres.
_STEPS = 6


def matches_problem_cost(problem: Problem, fix: Fix, costs: Costs) -> Array:
    """Return flags (N,): the position cost equals the cost of its problem, at the fix and near it.

    The check finds an error in the elimination of the other unknowns, before a proof about the wrong cost is used.

    Parameters
    ----------
    problem : Problem
        N problems within the scope of the proof.
    fix : Fix
        Their fixes.
    costs : PositionCosts, Runs or CourseCosts
        Their costs over the position, without equalities.
    """
    states = _test_states(problem, fix)
    expected = _costs_of_problem(problem, fix, states)
    with np.errstate(all="ignore"):
        actual, rounding = costs_of(costs, states)
        good = np.abs(actual - expected) <= _tolerance(expected, rounding)
        good[:, 0] &= np.abs(expected[:, 0] - fix.cost) <= _tolerance(fix.cost, rounding[:, 0])
    return np.asarray(good.all(1))


def _tolerance(cost: Array, rounding: Array) -> Array:
    """Return the allowed difference of costs: a relative share, plus the effect of rounded residuals.

    `rounding` has the shape of `cost`: rounding errors of the residuals, in sigma.
    """
    return np.asarray(_EQUAL * (1.0 + cost) + _ROUNDINGS * rounding * (np.sqrt(np.maximum(cost, 0.0)) + rounding))


def _test_states(problem: Problem, fix: Fix) -> Array:
    """Return the fixes and P states about a standard deviation away, (N, 1 + P, n); the same in every run."""
    columns = state_columns(problem)
    position, covariance = fix.x[..., columns], fix.cov[..., columns, columns]
    d = position.shape[-1]
    root = linalg.factor_semidefinite(np.where(np.isfinite(covariance), covariance, 0.0))
    direction = np.random.default_rng(1).standard_normal((_BESIDE, d))
    offset = root[:, None] @ direction[..., None]
    return np.concatenate([position[:, None], position[:, None] + offset[..., 0]], axis=1)


def _costs_of_problem(problem: Problem, fix: Fix, states: Array) -> Array:
    """Return the costs (N, P) of the problems at states (N, P, n), minimised over all other unknowns.

    This computation uses the normal equations of the problem, so it is independent of the position cost of the proof.
    """
    count, per_problem = states.shape[:2]
    columns = state_columns(problem)
    part = problem.take(np.repeat(np.arange(count), per_problem)) if count > 1 else problem
    x = np.repeat(fix.x, per_problem, axis=0)
    x[:, columns] = states.reshape(len(x), -1)
    others = np.delete(np.arange(problem.layout.n_shared), columns)
    with np.errstate(all="ignore"):
        equations = equations_at(part, x)
        if problem.stations.unknown_for:
            for _ in range(_STEPS):
                move, ok = step(equations, np.zeros(len(x)), np.eye(problem.layout.n_shared)[:, others])
                x = x + np.where(ok[:, None], move, 0.0)
                equations = equations_at(part, x)
        rest = eliminated(equations)
        information, vector, cost = rest.shared[:, others[:, None], others], rest.shared_vector[:, others], rest.cost
        if len(others):
            # scaled pseudo-inverse: a combination of unknowns that no row measures has no effect
            size = np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
            size = np.where(size > 0.0, size, 1.0)
            covariance = np.linalg.pinv(information / size[..., :, None] / size[..., None, :], _OPEN, hermitian=True)
            vector = vector / size
            cost = cost - ((covariance @ vector[..., None])[..., 0] * vector).sum(-1)
    return cost.reshape(count, per_problem)
