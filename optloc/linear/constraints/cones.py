"""Conditions of Karush, Kuhn and Tucker: whether a minimum along a face is one of all admitted positions."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array, Polygon
from optloc.linear.constraints.levels import Face, levels, outwards
from optloc.linear.constraints.polygons import is_reflex
from optloc.linear.constraints.quantities import is_exact
from optloc.problem.problem import Problem


def is_held(problem: Problem, face: Face, x: Array, descent: Array) -> Array:
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
    """
    gradients = levels(problem, face, x)[1]
    share = (np.linalg.pinv(np.swapaxes(gradients, -1, -2)) @ descent[..., None])[..., 0]
    out = np.ones(len(x), dtype=bool)
    for i, level in enumerate(face):
        constraint = problem.constraints[level.constraint]
        if not is_exact(constraint):
            out &= share[:, i] * outwards(problem, level) >= 0.0
        if isinstance(constraint, Polygon):
            # at a concave corner, both sides are admitted, and the cost decreases along one of them
            here = [other.side for other in face if other.constraint == level.constraint]
            out &= len(here) < 2 or not is_reflex(constraint, int(here[0]))
    return out
