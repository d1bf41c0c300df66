"""Checks of constraints: malformed or contradictory ones raise an error that names them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import AnyOf, Array, Band, Constraint, Fence, Motion, Polygon
from optloc.base.units import LARGEST
from optloc.models.surfaces import SURFACES, Surface
from optloc.problem.epochs import separable
from optloc.problem.problem import Problem


def out_of_range(values: Any) -> tuple[Any, str]:
    """Return a mask of values that are not finite or whose squares overflow, and words for the first such value."""
    values = np.asarray(values)
    bad = ~(np.abs(values) <= LARGEST)
    return bad, "not finite" if not np.isfinite(values[bad]).all() else f"beyond {LARGEST:g}"


# Limit of corners, because the checks compare each edge with every other edge, and each edge is a piece of the region.
_CORNERS = 1000

# Checks of constraints: malformed or contradictory constraints raise an error that names them.

# Lengths relative to the size of the polygon, and areas relative to its square, below which corners and edges touch:
# four digits above rounding error.
_SLIVER = 1e-12


def check_constraints(problem: Problem) -> None:
    """Raise if a constraint is invalid. Constraints that no position meets are not an error: they give a status."""
    for constraint in (*problem.constraints, *problem.fences):
        where = f"constraint {constraint.name!r}"
        if not isinstance(constraint.name, str):
            raise InvalidProblem("the name is no text", where, "give a text such as 'harbour'")
        _check_target(problem, constraint, where)
        if isinstance(constraint, Polygon):
            _check_plan(problem, "a polygon", where)
            check_polygon(constraint.vertices, where)
        elif isinstance(constraint, AnyOf):
            _check_union(problem, constraint, where)
        elif isinstance(constraint, Band):
            _check_band(problem, constraint, where)
        elif constraint.normal.shape[-1] != problem.dimension:
            raise InvalidProblem("the normal has another dimension than the stations", where, "match the stations")
    for same in bands_by_quantity(problem.constraints):
        _check_agreement(same)
    _check_equalities(problem)


def _check_equalities(problem: Problem) -> None:
    """Raise if the equalities on the position of a target without a motion are dependent, or more than coordinates."""
    for target, motion in enumerate(problem.motions):
        exact = [
            band
            for band in problem.constraints
            if isinstance(band, Band) and band.target == target and np.all(band.lower == band.upper)
        ]
        planes = [band for band in exact if band.kind == "plane" and np.ndim(band.coefficients) == 1]
        width = max((len(band.coefficients) for band in planes), default=0)
        normals = [np.append(one.coefficients, np.zeros(width - len(one.coefficients))) for one in planes]
        if len(planes) > 1 and np.linalg.matrix_rank(np.array(normals)) < len(planes):
            where = f"constraint {planes[-1].name!r}"
            raise InvalidProblem("the other equalities determine it already", where, "leave one of them out")
        if motion.order == 0 and len(exact) > problem.dimension and all(band.other is None for band in exact):
            what = f"{len(exact)} equalities are more than the {problem.dimension} coordinates of the target"
            raise InvalidProblem(what, f"constraint {exact[-1].name!r}", "leave one of them out")


def _check_target(problem: Problem, constraint: Constraint | Fence, where: str) -> None:
    """Raise if the target of a constraint is missing or known, or if other unknowns connect its free epochs."""
    count = len(problem.motions)
    if not isinstance(constraint.target, int | np.integer):
        what = f"the target {constraint.target!r} is no whole number"
        raise InvalidProblem(what, where, f"use 0 to {count - 1}")
    if not 0 <= constraint.target < count:
        raise InvalidProblem(f"there is no target {constraint.target}", where, f"use 0 to {count - 1}")
    motion = problem.motions[constraint.target]
    if motion.known is not None:
        raise InvalidProblem("the target's motion is known", where, "leave the constraint out")
    if motion.span == "epoch" and problem.epochs > 1 and not separable(problem):
        advice = "let the target be static or move uniformly, or leave out the unknowns that epochs share"
        raise InvalidProblem("other unknowns connect the epochs of this free target", where, advice)


def _check_union(problem: Problem, union: AnyOf, where: str) -> None:
    """Raise if a member of a union is empty, invalid, an equality, or about another target."""
    if not union.members or not all(union.members):
        raise InvalidProblem("the union has no member, or one without a band", where, "give one band or more to each")
    for band in (band for member in union.members for band in member):
        if band.target != union.target:
            what = f"the union is about target {union.target}, and a band about target {band.target}"
            raise InvalidProblem(what, where, "use one target")
        if np.all(band.lower == band.upper):
            raise InvalidProblem(f"the band {band.name!r} of a union is an equality", where, "give it a width")
        if band.along:
            what = f"the band {band.name!r} of a union applies along a course"
            raise InvalidProblem(what, where, "apply it at the reference time, with along=False")
        _check_band(problem, band, where)
    for member in union.members:
        for same in bands_by_quantity(member):
            _check_agreement(same)


def _check_plan(problem: Problem, what: str, where: str) -> None:
    """Raise if the frame has no horizontal plan, which `what` needs."""
    if problem.frame.kind == "ecef":
        advice = "use the frame enu, whose first two coordinates are east and north"
        raise InvalidProblem(f"{what} needs a plan, and the frame is ECEF", where, advice)


def check_polygon(vertices: Array, where: str) -> None:
    """Raise if corners (v, 2) do not form a simple polygon."""
    if vertices.ndim != 2 or vertices.shape[-1] != 2 or len(vertices) < 3:
        count = "no pairs" if vertices.ndim != 2 or vertices.shape[-1] != 2 else f"only {len(vertices)} corners"
        raise InvalidProblem(f"the polygon has {count}", where, "give three corners or more, two coordinates each")
    if len(vertices) > _CORNERS:
        what = f"the polygon has {len(vertices)} corners, {_CORNERS} at most"
        raise InvalidProblem(what, where, "leave out corners that change the shape little")
    bad, why = out_of_range(vertices)
    if bad.any():
        corner = int(np.flatnonzero(bad.any(-1))[0])
        raise InvalidProblem(f"corner {corner + 1} is {why}", where, "give two numbers")
    # Relative to the mean, because corners in metres from a distant origin would lose the digits that areas need.
    v = vertices - vertices.mean(0)
    size = np.abs(v).max()
    i, j = np.triu_indices(len(v), 1)
    twice = np.flatnonzero((np.abs(v[i] - v[j]) <= _SLIVER * size).all(-1))
    if len(twice):
        one, two = int(i[twice[0]]) + 1, int(j[twice[0]]) + 1
        advice = "leave one out; the last corner connects to the first automatically"
        raise InvalidProblem(f"corner {two} repeats corner {one}", where, advice)
    if abs(_cross(v, np.roll(v, -1, axis=0)).sum()) <= _SLIVER * size**2:
        raise InvalidProblem("the polygon has no area", where, "give corners in order around the region")
    crossing = _crossing(v, size)
    if crossing is not None:
        edges = " and ".join(f"{e + 1}-{(e + 1) % len(v) + 1}" for e in crossing)
        raise InvalidProblem(f"the polygon is not simple: its edges {edges} meet", where, "give corners in order")


def _crossing(v: Array, size: float) -> tuple[int, int] | None:
    """Return the numbers of two edges of a polygon that meet elsewhere than at a common corner, or None.

    `v` (n, 2) are the corners, and `size` is the size of the polygon, both in metres.
    """
    a, b, n = v, np.roll(v, -1, axis=0), len(v)
    i, j = np.triu_indices(n, 1)
    # Pairs of edges without a common corner. The last edge is a neighbour of the first.
    apart = (j - i > 1) & (j - i < n - 1)
    along = b - a
    # Two segments meet if the ends of each are on different sides of the other, or on it. For collinear segments the
    # bounding boxes decide.
    straddle = np.ones(len(i), dtype=bool)
    for p, q in ((i, j), (j, i)):
        sides = _cross(along[p], a[q] - a[p]), _cross(along[p], b[q] - a[p])
        straddle &= np.sign(_rounded(sides[0], size)) * np.sign(_rounded(sides[1], size)) <= 0
    low, high = np.minimum(a, b), np.maximum(a, b)
    overlap = ((low[i] <= high[j]) & (low[j] <= high[i])).all(-1)
    # Neighbours always meet at their corner. They overlap only if one turns straight back.
    turns_back = (np.abs(_cross(along[i], along[j])) <= _SLIVER * size**2) & ((along[i] * along[j]).sum(-1) < 0.0)
    bad = np.flatnonzero(np.where(apart, straddle & overlap, turns_back & ((j - i == 1) | (j - i == n - 1))))
    return (int(i[bad[0]]), int(j[bad[0]])) if len(bad) else None


def _rounded(area: Array, size: float) -> Array:
    """Return signed areas (...), m^2, zero if within rounding error for a polygon of this `size`, m."""
    return np.where(np.abs(area) <= _SLIVER * size**2, 0.0, area)


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product (...) of plane vectors (..., 2): twice a signed area."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def bands_by_quantity(constraints: Sequence[Constraint]) -> list[list[Band]]:
    """Return groups of bands on the same quantity of the same target, in the order of their first members."""
    groups: dict[tuple[Any, ...], list[Band]] = {}
    for c in constraints:
        if isinstance(c, Band):
            key = (c.kind, c.target, c.along, np.asarray(c.coefficients, dtype=float).tobytes(), c.other, c.table)
            groups.setdefault(key, []).append(c)
    return list(groups.values())


def _check_band(problem: Problem, band: Band, where: str) -> None:
    """Raise if the kind, coefficients or bounds of a band are invalid."""
    surface = SURFACES.get(band.kind)
    if surface is None:
        raise InvalidProblem(f"unknown quantity {band.kind!r}", where, nearest(band.kind, SURFACES))
    if surface.ecef and not problem.frame.geodetic:
        raise InvalidProblem(f"{band.kind} needs a geodetic frame", where, "use frame ecef or enu with an origin")
    if surface.ecef and problem.dimension != 3:
        raise InvalidProblem(f"{band.kind} needs three dimensions", where, "use 3-D stations")
    motion = problem.motions[band.target]
    if surface.velocity and motion.order == 0:
        raise InvalidProblem(f"{band.kind} needs a target that moves", where, "give it a velocity, or leave this out")
    if surface.acceleration and motion.order < 2:
        what = f"{band.kind} needs a target with an acceleration"
        raise InvalidProblem(what, where, "use Motion(2), or leave this out")
    _check_extras(problem, surface, band, where)
    if band.along and motion.span == "run" and motion.order > 0:
        _check_along(motion, band, where)
    sizes = surface.counts(problem.dimension)
    given = np.shape(band.coefficients)[-1:]
    if given not in {(size,) for size in sizes}:
        listed = " or ".join(str(size) for size in sizes)
        raise InvalidProblem(f"coefficients of shape {np.shape(band.coefficients)}", where, f"give {listed} numbers")
    bad, why = out_of_range(band.coefficients)
    if np.any(bad):
        raise InvalidProblem(f"a coefficient is {why}", where, "give numbers")
    for name, bound, absent in (("lower", band.lower, -np.inf), ("upper", band.upper, np.inf)):
        bad = out_of_range(bound)[0] & (np.asarray(bound) != absent)
        if np.any(bad):
            raise InvalidProblem(
                f"the {name} bound is {np.asarray(bound)[bad][0]:g}", where, f"give a number, or {absent:g} for none"
            )


def _check_extras(problem: Problem, surface: Surface, band: Band, where: str) -> None:
    """Raise if the frame, the table, the second target or the run do not fit a quantity."""
    count = len(problem.motions)
    if surface.upright and (problem.frame.kind == "ecef" or problem.dimension != 3):
        what = f"{band.kind} needs three coordinates of which the last is up"
        raise InvalidProblem(what, where, "use 3-D stations in a Cartesian frame or in the frame enu")
    if surface.table != (band.table is not None):
        what = f"{band.kind} needs a table" if surface.table else f"{band.kind} takes no table"
        raise InvalidProblem(what, where, "give it with table=" if surface.table else "leave it out")
    if surface.other != (band.other is not None):
        what = f"{band.kind} needs a second target" if surface.other else f"{band.kind} takes no second target"
        raise InvalidProblem(what, where, "give it with other=" if surface.other else "leave it out")
    if band.other is not None:
        if not 0 <= band.other < count or band.other == band.target:
            advice = f"use another number from 0 to {count - 1}" if count > 1 else "this problem has one target"
            raise InvalidProblem(f"the second target {band.other} does not fit", where, advice)
        if problem.motions[band.other].known is not None:
            raise InvalidProblem("the motion of the second target is known", where, "use a keep-out ball instead")
        both = (problem.motions[band.target], problem.motions[band.other])
        if (band.along or surface.along) and any(motion.order > 1 or motion.over == "ground" for motion in both):
            what = "the distance along courses with an acceleration, or over ground, has no closed form"
            raise InvalidProblem(what, where, "use constant velocities in space, or along=False")
    motion = problem.motions[band.target]
    if surface.along and motion.over == "ground":
        what = f"{band.kind} does not apply along a course over ground"
        raise InvalidProblem(what, where, "use over='space', or leave this out")


def _check_along(motion: Motion, band: Band, where: str) -> None:
    """Raise if a band cannot apply at all times of this motion."""
    other = "or apply it at the reference time only, with along=False"
    if SURFACES[band.kind].ends:
        # convex in time: the upper bound at both ends is enough, for all orders of motion in space
        if band.other is None and motion.order < 2:
            return
        if motion.over == "space" and not np.isfinite(band.lower).any():
            return
        what = f"a lower limit of {band.kind} along a course needs its least value"
        if motion.over == "ground":
            what = f"{band.kind} cannot apply along a course over ground with an acceleration"
        if np.all(band.lower == band.upper):
            what = f"{band.kind} is not constant along a course"
        raise InvalidProblem(what, where, f"use the quantity 'least {band.kind}', {other}")
    if (band.kind, motion.over) not in (("height", "ground"), ("plane", "space")):
        what, advice = f"{band.kind} cannot apply along a course over {motion.over}", f"use the other course, {other}"
        if band.kind == "height":
            what, advice = "a straight course has no constant height above the Earth", f"give over='ground', {other}"
        raise InvalidProblem(what, where, advice)
    if motion.order > 1 and not np.all(band.lower == band.upper):
        raise InvalidProblem("bounds along a course of constant acceleration", where, f"give one exact value, {other}")


def _check_agreement(bands: Sequence[Band]) -> None:
    """Raise if bands on one quantity contradict each other, or if the same equality is given twice."""
    where, unit = f"constraint {bands[0].name!r}", SURFACES[bands[0].kind].unit.replace("1", "")
    exact = [band.lower for band in bands if np.all(band.lower == band.upper)]
    # All bands on one quantity apply: compare the highest lower bound with the lowest upper bound.
    low = np.max(np.broadcast_arrays(*(band.lower for band in bands)), axis=0)
    high = np.min(np.broadcast_arrays(*(band.upper for band in bands)), axis=0)
    clash = np.broadcast_arrays(low, high, low > high)  # the third array marks contradictions
    if clash[2].any():
        least, most = (f"{np.ravel(bound[clash[2]])[0]:.10g} {unit}".strip() for bound in clash[:2])
        what = f"it must be at least {least} and at most {most}"
        raise InvalidProblem(what, where, "correct the bounds, they contradict each other")
    if len(exact) > 1:
        raise InvalidProblem("the same equality is given twice", where, "leave one of them out")
