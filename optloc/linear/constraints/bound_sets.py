"""Faces: sets of levels that an estimate can satisfy with equality together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from optloc.base.types import AnyOf, Array, Band, Constraint, Polygon
from optloc.linear.constraints.polygons import edge_of, is_convex, sense_of
from optloc.linear.constraints.quantities import decisive_epochs, is_exact
from optloc.linear.constraints.single_bounds import Face, Level, binds_position, levels
from optloc.linear.constraints.violation import TOLERANCE
from optloc.problem.problem import Problem


def exact(problem: Problem) -> Face:
    """Return the equality constraints of a problem, each at the epochs that decide about the whole course."""
    return tuple(
        Level(i, "equal", epoch)
        for i, c in enumerate(problem.constraints)
        if is_exact(c)
        for epoch in decisive_epochs(problem, c)
    )


def faces(problem: Problem) -> list[Face]:
    """Return every set of levels that an estimate can satisfy together, sorted by their number.

    The set with only the equalities is the first. Levels of different members of a union are not combined: where two
    members meet, the union has a corner that points inwards, and no minimum is there.
    """
    found = [exact(problem)]
    for i, constraint in enumerate(problem.constraints):
        sides = (
            []
            if is_exact(constraint)
            else _combined_sides(list(_sides(problem, i)), decisive_epochs(problem, constraint))
        )
        # More sides than dimensions have no common point. Speeds bound other unknowns, and do not count.
        wider = [(*face, *side) for face in found for side in sides]
        found += [face for face in wider if _most_at_once(problem, face) <= problem.dimension]
    return sorted(found, key=len)


def _combined_sides(sides: list[Face], epochs: list[int | None]) -> list[Face]:
    """Return all combinations of the `sides` of one constraint at the given epochs: at one epoch, or at several."""
    found: list[Face] = [()]
    for epoch in epochs:
        here = [tuple(replace(level, epoch=epoch) for level in side) for side in sides]
        found += [(*face, *side) for face in found for side in here]
    return found[1:]


def _most_at_once(problem: Problem, face: Face) -> int:
    """Return the greatest number of levels at one epoch; levels of speed do not count, since they bound no position."""
    count = Counter(level.epoch for level in face if binds_position(problem, level))
    return max(count.values(), default=0)


def _sides(problem: Problem, i: int) -> Iterator[Face]:
    """Yield the finite bounds of constraint number i if it is a band, or the edges and corners of a polygon.

    For a union, yield the combinations of bounds of each member.
    """
    constraint = problem.constraints[i]
    if isinstance(constraint, Band):
        yield from ((Level(i, side),) for side in finite_sides(constraint))
        return
    if isinstance(constraint, AnyOf):
        yield from _sides_of_members(problem, i, constraint)
        return
    # An estimate is on an edge, or in the corner with the edge before.
    for edge in range(len(constraint.vertices)):
        yield (Level(i, edge),)
        yield (Level(i, (edge - 1) % len(constraint.vertices)), Level(i, edge))


def _sides_of_members(problem: Problem, i: int, union: AnyOf) -> Iterator[Face]:
    """Yield the combinations of up to d bounds of each member of a union, in d dimensions."""
    for m, member in enumerate(union.members):
        bands = [[Level(i, (m, b, side)) for side in finite_sides(band)] for b, band in enumerate(member)]
        for count in range(1, min(problem.dimension, len(bands)) + 1):
            for chosen in combinations(bands, count):
                yield from product(*chosen)


def finite_sides(band: Band) -> tuple[str, ...]:
    """Return the names of the bounds of a band that exist: "lower", "upper", both or none."""
    pairs = (("lower", band.lower), ("upper", band.upper))
    return tuple(name for name, bound in pairs if np.isfinite(bound).all())


def bounds(problem: Problem) -> Face:
    """Return every single bound of the inequalities of a problem, at the reference time, without polygon corners."""
    sides = (side for i, c in enumerate(problem.constraints) if not is_exact(c) for side in _sides(problem, i))
    return tuple(side[0] for side in sides if len(side) == 1)


def is_conjunctive(constraint: Constraint) -> bool:
    """Return whether `conjunction` contains a constraint; it leaves out unions and regions that are not convex."""
    if isinstance(constraint, Polygon):
        return is_convex(constraint)
    return isinstance(constraint, Band) or len(constraint.members) == 1


def conjunction(problem: Problem) -> list[Band]:
    """Return the constraints as bands that a valid estimate satisfies all together.

    Edges of convex polygons are included. Unions, concave polygons and polygons to keep out of are left out.
    """
    bands: list[Band] = []
    for c in problem.constraints:
        if isinstance(c, Band):
            bands.append(c)
        elif not is_conjunctive(c):  # for a concave polygon, a point inside can violate an edge
            continue
        elif isinstance(c, AnyOf):
            bands += c.members[0]
        else:
            bands += [_half_plane(c, i) for i in range(len(c.vertices))]
    return bands


def _half_plane(region: Polygon, edge: int) -> Band:
    """Return the half-plane on the admitted side of an edge."""
    plane, sign = edge_of(region, edge), sense_of(region)
    return replace(plane, coefficients=sign * plane.coefficients, upper=sign * plane.upper, lower=np.array(-np.inf))


def face_of(problem: Problem, x: Array) -> Array:
    """Return the number (N,) in `faces` of the face with most levels on which vectors x (N, size) are; 0 if on none."""
    found = np.zeros(len(x), dtype=int)
    for number, face in enumerate(faces(problem)):
        if face:
            values, _ = levels(problem, face, x)
            # Faces are sorted by number of levels, so that the last face that fits has the most levels.
            found[(np.abs(values) <= 10.0 * TOLERANCE * (1.0 + np.abs(x).max(1, keepdims=True))).all(1)] = number
    return found
