"""What cannot be demanded: malformed or contradictory constraints are refused with a sentence that names them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optloc.epochs import separable
from optloc.errors import InvalidProblem, nearest
from optloc.models.surfaces import SURFACES
from optloc.problem import Problem
from optloc.types import Array, Band, Polygon

_SLIVER = 1e-12


def check_constraints(problem: Problem) -> None:
    """Refuse constraints that cannot be what is meant; that no position meets them is a status, not an error.

    Parameters
    ----------
    problem : Problem
        Its stations, rows and motions are in order.

    Raises
    ------
    InvalidProblem
        Naming the constraint.
    """
    for constraint in problem.constraints:
        where = f"constraint {constraint.name!r}"
        _check_target(problem, constraint, where)
        if isinstance(constraint, Polygon):
            _check_plan(problem, where)
            check_polygon(constraint.vertices, where)
        else:
            _check_band(problem, constraint, where)
    for same in like(problem.constraints):
        _check_agreement(same)


def like(constraints: Sequence[Band | Polygon]) -> list[list[Band]]:
    """Return the bands on one quantity of one target together, in the order of their first."""
    groups: dict[tuple[str, int, bytes], list[Band]] = {}
    for c in constraints:
        if isinstance(c, Band):
            groups.setdefault((c.kind, c.target, np.asarray(c.coefficients, dtype=float).tobytes()), []).append(c)
    return list(groups.values())


def _check_target(problem: Problem, constraint: Band | Polygon, where: str) -> None:
    count = len(problem.motions)
    if not 0 <= constraint.target < count:
        raise InvalidProblem(f"there is no target {constraint.target}", where, f"use 0 to {count - 1}")
    motion = problem.motions[constraint.target]
    if motion.known is not None:
        raise InvalidProblem("the target's motion is known", where, "leave the constraint out")
    if motion.span == "epoch" and problem.epochs > 1 and not separable(problem):
        advice = "let the target be static or move uniformly, or leave out what ties the epochs together"
        raise InvalidProblem("the epochs of this free target are tied together by other unknowns", where, advice)


def _check_plan(problem: Problem, where: str) -> None:
    if problem.frame.kind == "ecef":
        advice = "use the frame enu, whose first two coordinates are east and north"
        raise InvalidProblem("a polygon needs a plan, and the frame is ECEF", where, advice)


def check_polygon(vertices: Array, where: str) -> None:
    """Refuse corners (v, 2) that do not bound a simple polygon."""
    if vertices.ndim != 2 or vertices.shape[-1] != 2 or len(vertices) < 3:
        count = "no pairs" if vertices.ndim != 2 or vertices.shape[-1] != 2 else f"only {len(vertices)} corners"
        raise InvalidProblem(f"the polygon has {count}", where, "give three corners or more, two coordinates each")
    if not np.isfinite(vertices).all():
        corner = int(np.flatnonzero(~np.isfinite(vertices).all(-1))[0])
        raise InvalidProblem(f"corner {corner + 1} is not finite", where, "give two numbers")
    v = vertices - vertices.mean(0)
    size = np.abs(v).max()
    i, j = np.triu_indices(len(v), 1)
    twice = np.flatnonzero((np.abs(v[i] - v[j]) <= _SLIVER * size).all(-1))
    if len(twice):
        one, two = int(i[twice[0]]) + 1, int(j[twice[0]]) + 1
        raise InvalidProblem(f"corner {two} repeats corner {one}", where, "leave one out; the polygon closes by itself")
    if abs(_cross(v, np.roll(v, -1, axis=0)).sum()) <= _SLIVER * size**2:
        raise InvalidProblem("the polygon has no area", where, "give corners in order around the region")
    crossing = _crossing(v, size)
    if crossing is not None:
        edges = " and ".join(f"{e + 1}-{(e + 1) % len(v) + 1}" for e in crossing)
        raise InvalidProblem(f"the polygon is not simple: its edges {edges} meet", where, "give corners in order")


def _crossing(v: Array, size: float) -> tuple[int, int] | None:
    """Return two edges of a polygon that meet elsewhere than at their common corner, or None."""
    a, b, n = v, np.roll(v, -1, axis=0), len(v)
    i, j = np.triu_indices(n, 1)
    apart = (j - i > 1) & (j - i < n - 1)
    along = b - a
    straddle = np.ones(len(i), dtype=bool)
    for p, q in ((i, j), (j, i)):
        sides = _cross(along[p], a[q] - a[p]), _cross(along[p], b[q] - a[p])
        straddle &= np.sign(_flat(sides[0], size)) * np.sign(_flat(sides[1], size)) <= 0
    low, high = np.minimum(a, b), np.maximum(a, b)
    overlap = ((low[i] <= high[j]) & (low[j] <= high[i])).all(-1)
    # Neighbours always meet at their corner; they run into each other only where one turns straight back.
    back = (np.abs(_cross(along[i], along[j])) <= _SLIVER * size**2) & ((along[i] * along[j]).sum(-1) < 0.0)
    bad = np.flatnonzero(np.where(apart, straddle & overlap, back & ((j - i == 1) | (j - i == n - 1))))
    return (int(i[bad[0]]), int(j[bad[0]])) if len(bad) else None


def _flat(area: Array, size: float) -> Array:
    return np.where(np.abs(area) <= _SLIVER * size**2, 0.0, area)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _check_band(problem: Problem, band: Band, where: str) -> None:
    surface = SURFACES.get(band.kind)
    if surface is None:
        raise InvalidProblem(f"unknown quantity {band.kind!r}", where, nearest(band.kind, SURFACES))
    if surface.ecef and not problem.frame.geodetic:
        raise InvalidProblem(f"{band.kind} needs a geodetic frame", where, "use frame ecef or enu with an origin")
    if surface.ecef and problem.dimension != 3:
        raise InvalidProblem(f"{band.kind} needs three dimensions", where, "use 3-D stations")
    if surface.velocity and problem.motions[band.target].order == 0:
        raise InvalidProblem(f"{band.kind} needs a target that moves", where, "give it a velocity, or leave this out")
    size = problem.dimension if surface.coefficients < 0 else surface.coefficients
    given = np.shape(band.coefficients)[-1:]
    if given != (size,):
        raise InvalidProblem(f"coefficients of shape {np.shape(band.coefficients)}", where, f"give {size} numbers")
    if not np.isfinite(band.coefficients).all():
        raise InvalidProblem("a coefficient is not finite", where, "give numbers")
    for name, bound, absent in (("lower", band.lower, -np.inf), ("upper", band.upper, np.inf)):
        bad = np.isnan(bound) | (np.isinf(bound) & (bound != absent))
        if np.any(bad):
            raise InvalidProblem(
                f"the {name} bound is {np.asarray(bound)[bad][0]:g}", where, f"give a number, or {absent:g} for none"
            )


def _check_agreement(bands: Sequence[Band]) -> None:
    """Refuse bands on one quantity that cannot hold together, and equalities that are given twice."""
    where, unit = f"constraint {bands[0].name!r}", SURFACES[bands[0].kind].unit.replace("1", "")
    exact = [band.lower for band in bands if np.all(band.lower == band.upper)]
    low = np.max(np.broadcast_arrays(*(band.lower for band in bands)), axis=0)
    high = np.min(np.broadcast_arrays(*(band.upper for band in bands)), axis=0)
    clash = np.broadcast_arrays(low, high, low > high)
    if clash[2].any():
        least, most = (f"{np.ravel(bound[clash[2]])[0]:.10g} {unit}".strip() for bound in clash[:2])
        what = f"it must be at least {least} and at most {most}"
        raise InvalidProblem(what, where, "correct the bounds, they contradict each other")
    if len(exact) > 1:
        raise InvalidProblem("the same equality is given twice", where, "leave one of them out")
