"""What a proof is posed of: the cost of a fix, its equalities as rows; checked against that of the problem itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base.types import Array, Band
from optloc.compute.sums import equations_at
from optloc.linear.constraints import exact
from optloc.linear.normal import Normal, eliminated, step
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.proof.batch import costs_at
from optloc.proof.nodes.height import height_numbers
from optloc.proof.nodes.linear import linear_numbers
from optloc.proof.nodes.node import HEIGHT, LINEAR
from optloc.proof.pose import Posed, stack_numbers
from optloc.solvers.starts.position import spread_of

# Least width of the row of an equality, relative to the coordinates: a narrower one would measure their rounding.
_NARROWEST = 1e-9


@dataclass(frozen=True, slots=True)
class Held:
    """Posed costs of a flat batch of N problems with their equalities as rows.

    For a point with ``g(x) = H`` the cost is ``f(x) + ((g(x) - H) / s + l s)^2 - (l s)^2``: for the multiplier l of a
    fix its gradient vanishes there in all directions, and a bound over all points is one over those that meet it. That
    of another point with a vanishing gradient along the surface has another multiplier, and no vanishing gradient here:
    only bounds exclude it (`optloc.proof.near.prove`).

    Parameters
    ----------
    pose : Posed
        Costs with the rows.
    extra : array (N,)
        By how much the posed cost of a fix exceeds its cost.
    able : bool array (N,)
        Where no other constraint holds the fix.
    surface : array (N, e)
        The values H of the nodes of the rows, which come last.
    single : bool
        Whether a gap can be proven: on planes, and on one height alone.
    """

    pose: Posed
    extra: Array
    able: Array
    surface: Array
    single: bool


def hold_equalities(problem: Problem, fix: Fix, pose: Posed) -> Held:
    """Return posed costs with the equalities of a flat batch of problems as rows at the multipliers of their fixes.

    References
    ----------
    M. J. D. Powell, "A method for nonlinear constraints in minimization problems" (1969); R. T. Rockafellar (1973): the
    augmented Lagrangian.
    """
    face, size = exact(problem), len(fix.x)
    active = [()] * size if fix.active is None else [tuple(found) for found in fix.active]
    able = np.array([len(found) == len(face) for found in active])
    if not face:
        return Held(pose, np.zeros(size), able, np.zeros((size, 0)), single=True)
    scale, extra, values, bent = _scale(problem, fix, len(face)), np.zeros(size), [], 0
    for i, level in enumerate(face):
        constraint = problem.constraints[level.constraint]
        assert isinstance(constraint, Band)
        shift = np.array([0.5 * found[i].multiplier if good else 0.0 for found, good in zip(active, able, strict=True)])
        pose = _with_row(pose, *_node(problem, constraint), constraint.lower, scale, shift)
        extra = extra + (shift * scale) ** 2
        values.append(np.broadcast_to(constraint.lower, (size,)))
        bent += constraint.kind == "height"
    return Held(pose, extra, able, np.stack(values, axis=1), single=not bent or len(face) == 1)


def _scale(problem: Problem, fix: Fix, count: int) -> Array:
    """Return the widths (N,) of the rows: standard deviations of the fixes along the surface, metres."""
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.trace(fix.covariance(), axis1=-2, axis2=-1) / max(problem.dimension - count, 1))
        size = spread_of(problem)[1] + np.abs(problem.frame.origin_ecef() if problem.frame.geodetic else 0.0).max()
        least = _NARROWEST * (size + np.abs(fix.position).max(-1))
    return np.where(np.isfinite(spread) & (spread > 0.0), np.fmax(spread, least), np.where(least > 0.0, least, 1.0))


def _node(problem: Problem, constraint: Band) -> tuple[int, Array]:
    """Return code and numbers (B, n) of the node that an equality sets."""
    if constraint.kind == "height":
        return HEIGHT, height_numbers(problem)
    coefficients = constraint.coefficients
    return LINEAR, linear_numbers(coefficients if coefficients.ndim == 2 else coefficients[None])


def _with_row(pose: Posed, kind: int, numbers: Array, value: Array, scale: Array, shift: Array) -> Posed:
    """Return costs with the row ``(node - value) / scale + shift * scale`` added."""
    size, (q, nodes) = len(scale), pose.K.shape[-2:]
    K = np.zeros((size, q + 1, nodes + 1))
    K[:, :q, :nodes], K[:, q, nodes] = pose.K, 1.0 / scale
    w = np.concatenate([pose.w, (np.broadcast_to(value, (size,)) / scale - shift * scale)[:, None]], axis=1)
    kinds = np.append(pose.kinds, kind)
    data = stack_numbers(kinds, [*(pose.data[:, j] for j in range(nodes)), numbers])
    return pose._replace(kinds=kinds, data=data, K=K, w=w)


# Whether a posed cost is that of its fix.

# Places beside each fix, about a standard deviation away: two ways to write the same cost agree there to the rounding,
# two different costs differ by a share of one. A second place would cost half as much time again.
_BESIDE = 1
# Relative difference of costs that is rounding, as for a proof, and how many lengths of a residual's own.
_EQUAL, _ROUNDINGS = 1e-6, 8.0
# Share of the largest eigenvalue of scaled information below which a combination of unknowns is open.
_OPEN = 1e-12
# Steps in which unknowns that enter the rows in no straight line (station errors) find their best values: each one
# squares what is left, and what is left of the first is some metres over some kilometres.
_STEPS = 6


def agrees(problem: Problem, fix: Fix, pose: Posed) -> Array:
    """Return of which of a flat batch of N problems the posed cost is their own (N,), at the fix and beside it.

    Parameters
    ----------
    problem : Problem
        N problems within the scope of the proof.
    fix : Fix
        Their fixes.
    pose : Posed
        Their costs over the position, equalities apart.
    """
    places = _places(fix)
    own = _own_costs(problem, fix, places)
    with np.errstate(all="ignore"):
        posed, blur = costs_at(pose, places)
        good = np.abs(posed - own) <= _tolerance(own, blur)
        good[:, 0] &= np.abs(own[:, 0] - fix.cost) <= _tolerance(fix.cost, blur[:, 0])
        if exact(problem):  # with the rows of equalities, which vanish at the fix
            held = hold_equalities(problem, fix, pose)
            whole, blur = costs_at(held.pose, places[:, :1])
            off = np.abs(whole[:, 0] - held.extra - fix.cost)
            good[:, 0] &= off <= _tolerance(fix.cost + held.extra, blur[:, 0])
    return np.asarray(good.all(1))


def _tolerance(cost: Array, blur: Array) -> Array:
    """Return by how much costs may differ: a share, and what the rounding of residuals makes of their squares."""
    return np.asarray(_EQUAL * (1.0 + cost) + _ROUNDINGS * blur * (np.sqrt(np.maximum(cost, 0.0)) + blur))


def _places(fix: Fix) -> Array:
    """Return the fixes and places about a standard deviation away, (N, 1 + P, d): the same ones in every run."""
    position, covariance = fix.position, fix.covariance()
    d = position.shape[-1]
    with np.errstate(all="ignore"):
        root, variance = np.zeros_like(covariance), np.where(np.isfinite(covariance), covariance, 0.0)
        for k in range(d):  # by Cholesky's rule, less what is not determined
            pivot = variance[:, k, k] - (root[:, k, :k] ** 2).sum(-1)
            root[:, k, k] = np.sqrt(np.maximum(pivot, 0.0))
            rest = variance[:, k + 1 :, k] - (root[:, k + 1 :, :k] @ root[:, k, :k, None])[..., 0]
            root[:, k + 1 :, k] = np.where(pivot[:, None] > 0.0, rest / root[:, k, k, None], 0.0)
    way = np.random.default_rng(1).standard_normal((_BESIDE, d))
    beside = np.where(np.isfinite(root), root, 0.0)[:, None] @ way[..., None]
    return np.concatenate([position[:, None], position[:, None] + beside[..., 0]], axis=1)


def _own_costs(problem: Problem, fix: Fix, places: Array) -> Array:
    """Return the costs (N, P) of the problems at positions (N, P, d), all other unknowns at their best values."""
    count, several = places.shape[:2]
    slot, _ = problem.layout.find("position")
    part = problem.take(np.repeat(np.arange(count), several)) if count > 1 else problem
    x = np.repeat(fix.x, several, axis=0)
    x[:, slot.start : slot.start + slot.size] = places.reshape(-1, places.shape[-1])
    with np.errstate(all="ignore"):
        equations = equations_at(part, x)
        if problem.stations.covariance is not None and problem.stations.span != "noise":
            for _ in range(_STEPS):
                move, ok = step(_without(equations, slot.start, slot.size), np.zeros(len(x)))
                x = x + np.where(ok[:, None], _spread(move, slot.start, slot.size), 0.0)
                equations = equations_at(part, x)
        rest = eliminated(_without(equations, slot.start, slot.size))
        cost = np.asarray(rest.cost)
        if rest.shared.shape[-1]:
            # Scaled, and by its pseudo-inverse: a combination that no row feels changes nothing.
            size = np.sqrt(np.diagonal(rest.shared, axis1=-2, axis2=-1))
            size = np.where(size > 0.0, size, 1.0)
            turned = np.linalg.pinv(rest.shared / size[..., :, None] / size[..., None, :], _OPEN, hermitian=True)
            vector = rest.shared_vector / size
            cost = cost - ((turned @ vector[..., None])[..., 0] * vector).sum(-1)
    return cost.reshape(count, several)


def _without(equations: Normal, start: int, size: int) -> Normal:
    """Return normal equations without the position: it is held."""
    keep = np.delete(np.arange(equations.shared.shape[-1]), slice(start, start + size))
    return Normal(
        equations.shared[..., keep[:, None], keep],
        equations.local,
        equations.cross[..., keep, :],
        equations.shared_vector[..., keep],
        equations.local_vector,
        equations.cost,
    )


def _spread(move: Array, start: int, size: int) -> Array:
    """Return a step (N, n) of all unknowns but the position as one of all, which leaves the position where it is."""
    return np.insert(move, np.full(size, start), 0.0, axis=-1)
