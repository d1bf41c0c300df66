"""Constraints of the table `optloc.constraints` as convex sets of one target: half-spaces and balls."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import AnyOf, Array, Band, Constraint, Polygon
from optloc.linear.constraints import conjunction, is_conjunctive
from optloc.linear.constraints.polygons import edge_of, is_convex, sense_of
from optloc.problem.problem import Problem


@dataclass(frozen=True, slots=True)
class HalfSpace:
    """The points with ``normal . x <= offset``, or on the plane if `equal`.

    Parameters
    ----------
    normal : array (d,)
        Unit vector.
    offset : float
        Metres.
    equal : bool
        Whether the points are on the plane.
    """

    normal: Array
    offset: float
    equal: bool = False


@dataclass(frozen=True, slots=True)
class ConvexBall:
    """The points whose first q coordinates are at most `radius` metres from `centre` (q,)."""

    centre: Array
    radius: float


ConvexSet = HalfSpace | ConvexBall

_ONLY = "a relaxation takes half-planes, discs, balls and convex polygons; use the formulation 'nls'"


def as_convex(problem: Problem, constraint: Constraint) -> tuple[ConvexSet, ...]:
    """Return a constraint of the table as convex sets that the position of its target is in.

    Parameters
    ----------
    problem : Problem
        A problem with one target.
    constraint : Band, Polygon or AnyOf
        An element of the constraints of a problem.

    Raises
    ------
    InvalidProblem
        If the constraint is not convex, or does not bound a position.
    """
    return tuple(part for band in conjunction_of(problem, constraint) for part in _of_band(problem, band))


def conjunction_of(problem: Problem, constraint: Constraint) -> list[Band]:
    """Return the bands that state a constraint together; raise InvalidProblem if it is not such a conjunction."""
    if not is_conjunctive(constraint):
        raise InvalidProblem(
            f"the constraint {constraint.name!r} is a union of regions",
            "constraint",
            "state it in the problem and use optloc.solve, which tries every region",
        )
    return conjunction(replace(problem, constraints=(constraint,)))


def members_of(problem: Problem, constraint: Constraint) -> list[list[Band]]:
    """Return the members of a constraint, each a conjunction of bands; the target is in one of them at least.

    Raises
    ------
    InvalidProblem
        For a polygon that is not convex: neither it nor its outside is a list of such members here.
    """
    if isinstance(constraint, AnyOf):
        return [list(member) for member in constraint.members]
    if isinstance(constraint, Polygon) and constraint.outside and is_convex(replace(constraint, outside=False)):
        sign = sense_of(replace(constraint, outside=False))
        edges = [edge_of(constraint, i) for i in range(len(constraint.vertices))]
        above, without = [sign * edge.upper for edge in edges], np.array(np.inf)
        return [
            [replace(edge, coefficients=sign * edge.coefficients, lower=low, upper=without)]
            for edge, low in zip(edges, above, strict=True)
        ]
    return [conjunction_of(problem, constraint)]


def _of_band(problem: Problem, band: Band) -> list[ConvexSet]:
    """Return the convex sets of a band; raise InvalidProblem if its sides are not convex."""
    lower, upper = (float(np.ravel(side)[0]) for side in (band.lower, band.upper))
    if band.kind == "plane":
        given = np.ravel(band.coefficients).astype(float)
        normal = np.concatenate([given, np.zeros(problem.dimension - len(given))])
        length = float(np.linalg.norm(normal))
        if not length > 0.0:
            raise InvalidProblem(f"the plane of {band.name!r} has no direction", "constraint", "give a normal")
        normal, lower, upper = normal / length, lower / length, upper / length
        if lower == upper:
            return [HalfSpace(normal, upper, equal=True)]
        sides = [(-1.0, -lower), (1.0, upper)]
        return [HalfSpace(sign * normal, offset) for sign, offset in sides if np.isfinite(offset)]
    if band.kind == "distance" and not lower > 0.0:
        return [ConvexBall(np.ravel(band.coefficients).astype(float), upper)]
    raise InvalidProblem(f"the constraint {band.name!r} on the {band.kind} is not convex", "constraint", _ONLY)
