"""Known heights and planes in a proof: an equality is worth a row whose residual is its multiplier."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.constraints import exact
from optloc.fix import Fix
from optloc.problem import Problem
from optloc.proof.columns import height_numbers, linear_numbers, stacked
from optloc.proof.nodes import HEIGHT, LINEAR
from optloc.proof.pose import Posed
from optloc.types import Array, Band


@dataclass(frozen=True, slots=True)
class Held:
    """Posed costs of a flat batch of N problems with their equalities as rows.

    For a point with ``g(x) = H`` the cost is ``f(x) + ((g(x) - H) / s + l s)^2 - (l s)^2``: for the multiplier l of a
    fix its gradient vanishes there in all directions, and a bound over all points is one over those that meet it.

    Parameters
    ----------
    pose : Posed
        Costs with the rows.
    extra : array (N,)
        By how much the posed cost of a fix exceeds its cost.
    able : bool array (N,)
        Where no other constraint holds the fix.
    """

    pose: Posed
    extra: Array
    able: Array


def held(problem: Problem, fix: Fix, pose: Posed) -> Held:
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
        return Held(pose, np.zeros(size), able)
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.trace(fix.covariance(), axis1=-2, axis2=-1) / max(problem.dimension - len(face), 1))
    scale = np.where(np.isfinite(spread), np.maximum(spread, 1.0), 1.0)
    extra = np.zeros(size)
    for i, level in enumerate(face):
        constraint = problem.constraints[level.constraint]
        assert isinstance(constraint, Band)
        shift = np.array([0.5 * found[i].multiplier if good else 0.0 for found, good in zip(active, able, strict=True)])
        pose = _with_row(pose, *_node(problem, constraint), constraint.lower, scale, shift)
        extra = extra + (shift * scale) ** 2
    return Held(pose, extra, able)


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
    data = stacked(kinds, [*(pose.data[:, j] for j in range(nodes)), numbers])
    return replace(pose, kinds=kinds, data=data, K=K, w=w)
