"""Known heights and planes in a proof: an equality is worth a row whose residual is its multiplier."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base.types import Array, Band
from optloc.linear.constraints import exact
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
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
