"""Conditions of Karush, Kuhn and Tucker: whether a minimum along a face is one of all admitted positions.

A point is a minimum of a union of regions if and only if it is a minimum of every member that contains it. In each
member, minus the gradient must be a sum of outward normals of the active bounds with factors that are not negative.

Letters: N vectors x, n shared unknowns, c levels.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from optloc.base.linalg import factor
from optloc.base.types import AnyOf, Array, Polygon
from optloc.linear.constraints.bound_sets import finite_sides
from optloc.linear.constraints.polygons import distances_from_edges, is_reflex
from optloc.linear.constraints.quantities import is_exact
from optloc.linear.constraints.single_bounds import Face, Level, bound_of, levels, outwards
from optloc.linear.constraints.violation import TOLERANCE, member_violation, plan_positions
from optloc.problem.problem import Problem

# Square of the share of a gradient that outward normals may leave over: the gradient is taken near a bound, not on it.
# Second: the same in units of chi-square, below which a point counts as stationary.
_LEFT, _STATIONARY = 1e-6, 1e-10


def is_held(problem: Problem, face: Face, x: Array, descent: Array, information: Array | None = None) -> Array:
    """Return whether each minimum along a face (N,) is a constrained minimum: the cost increases into the region.

    Parameters
    ----------
    problem : Problem
        N problems.
    face : Face
        Levels that the vectors satisfy with equality.
    x : array (N, size)
        Vectors on the face.
    descent : array (N, n)
        Minus the gradient with respect to the shared unknowns. At a constrained minimum it is a sum of outward normals
        with factors that are not negative.
    information : array (N, n, n), optional
        Information of the shared unknowns, which makes their units comparable.
    """
    gradients = levels(problem, face, x)[1]
    # beyond every finite distance nothing has a gradient, and nothing is a minimum
    out: Array = np.asarray(np.isfinite(gradients).all((-1, -2)) & np.isfinite(descent).all(-1))
    gradients, descent = np.where(out[:, None, None], gradients, 0.0), np.where(out[:, None], descent, 0.0)
    if information is not None:
        out &= np.isfinite(information).all((-1, -2))
    share = (np.linalg.pinv(np.swapaxes(gradients, -1, -2)) @ descent[..., None])[..., 0]
    for i, level in enumerate(face):
        constraint = problem.constraints[level.constraint]
        if not is_exact(constraint):
            out &= share[:, i] * outwards(problem, level) >= 0.0
        if isinstance(constraint, Polygon):
            assert isinstance(level.side, int)
            # beyond its ends, an edge bounds nothing
            points = plan_positions(problem, constraint.target, x)
            reach = TOLERANCE * (1.0 + np.abs(constraint.vertices).max())
            out &= distances_from_edges(constraint, points)[:, level.side] <= reach
            # at a concave corner, both sides are admitted, and the cost decreases along one of them
            same = [other.side for other in face if other.constraint == level.constraint]
            edges = [side for side in same if isinstance(side, int)]
            out &= len(edges) < 2 or not is_reflex(constraint, edges[0])
    unions = [i for i in dict.fromkeys(level.constraint for level in face) if _is_union(problem, i)]
    if unions and out.any():
        items = np.flatnonzero(out)
        part = problem.take(items)
        scale = None if information is None else information[items]
        out[items] = _is_held_by_all(part, face, unions, x[items], descent[items], scale)
    return out


def _is_union(problem: Problem, i: int) -> bool:
    """Return whether constraint number i has several members."""
    constraint = problem.constraints[i]
    return isinstance(constraint, AnyOf) and len(constraint.members) > 1


def _is_held_by_all(
    problem: Problem, face: Face, unions: list[int], x: Array, descent: Array, information: Array | None
) -> Array:
    """Return flags (N,) of points that are minima of every combination of members that contain them.

    `unions` are the numbers of the unions with a level in the face. The other arguments are as in `is_held`.
    """
    own = tuple(level for level in face if level.constraint not in unions)
    choices = []
    for i in unions:
        union = problem.constraints[i]
        assert isinstance(union, AnyOf)
        inside = [member_violation(problem, member, x) <= TOLERANCE for member in union.members]
        choices.append([(i, m, flags) for m, flags in enumerate(inside) if flags.any()])
    whitener = _whitener(information, descent)
    out = np.ones(len(x), dtype=bool)
    taken = {(level.constraint, level.side[0]) for level in face if isinstance(level.side, tuple)}
    for chosen in product(*choices):
        if all((i, m) in taken for i, m, _ in chosen):
            continue  # the members of the face itself, whose factors have the right signs
        items = np.flatnonzero(out & np.all([flags for _, _, flags in chosen], axis=0))
        if len(items):
            bounds = (*own, *(level for i, m, _ in chosen for level in _bounds_of(problem, i, m)))
            part = problem.take(items)
            out[items] = _is_in_cone(part, bounds, x[items], descent[items], whitener[items])
    return out


def _bounds_of(problem: Problem, i: int, member: int) -> Face:
    """Return all bounds of a member of the union number i as levels."""
    union = problem.constraints[i]
    assert isinstance(union, AnyOf)
    bands = enumerate(union.members[member])
    return tuple(Level(i, (member, b, side)) for b, band in bands for side in finite_sides(band))


def _whitener(information: Array | None, descent: Array) -> Array:
    """Return matrices (N, n, n) after which the length of a gradient is the square root of a chi-square value."""
    n = descent.shape[-1]
    plain = np.broadcast_to(np.eye(n), (len(descent), n, n))
    if information is None:
        return plain
    with np.errstate(all="ignore"):
        lower, ok = factor(information)
        found = np.linalg.pinv(np.where(ok[:, None, None], np.nan_to_num(lower), plain))
    return np.asarray(np.where(ok[:, None, None], found, plain))


def _is_in_cone(problem: Problem, bounds: Face, x: Array, descent: Array, whitener: Array) -> Array:
    """Return flags (N,) of points x (N, size) at which `descent` (N, n) is a sum of outward normals of active bounds.

    `bounds` are levels, of which those count that a point touches. `whitener` (N, n, n) scales gradients.
    """
    from scipy.optimize import nnls

    values, gradients = levels(problem, bounds, x)
    out = np.empty(len(x), dtype=bool)
    sense = np.array([outwards(problem, level) for level in bounds])
    sizes = [np.broadcast_to(1.0 + np.abs(bound_of(problem, level)), (len(x),)) for level in bounds]
    active = (np.abs(values) <= TOLERANCE * np.stack(sizes, axis=1)) if bounds else np.zeros((len(x), 0), dtype=bool)
    for k in range(len(x)):
        target = whitener[k] @ descent[k]
        normals = []
        for i in np.flatnonzero(active[k] | (sense == 0.0)):
            normal = whitener[k] @ gradients[k, i]
            # an equality pulls either way
            normals += [sense[i] * normal] if sense[i] else [normal, -normal]
        left = nnls(np.stack(normals, axis=1), target)[1] if normals else np.sqrt((target**2).sum())
        out[k] = left**2 <= max(_LEFT * float(target @ target), _STATIONARY)
    return out
