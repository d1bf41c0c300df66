"""Constraints: how users state them, and the faces on which an answer may lie."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.linalg import Tangent, tangent
from optloc.base.types import Array, Band, Polygon
from optloc.linear.evaluate import to_ecef
from optloc.models.primitives import Jet, Point
from optloc.models.surfaces import SURFACES
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem

# Share of its size by which a constraint may be broken, a micrometre where the bound is zero: rounding of coordinates
# of the Earth's size (a nanometre) passes, and no measurement is as good.
TOLERANCE = 1e-6

# How users state constraints.


def box(lower: Sequence[float], upper: Sequence[float], *, target: int = 0) -> tuple[Band, ...]:
    """Return the constraint that a target lies in a box; infinite bounds are none.

    Parameters
    ----------
    lower, upper : sequence of d float
        Least and greatest coordinates in the problem's frame, metres.
    target : int
        Which target.
    """
    d = len(lower)
    return tuple(
        Band("plane", _number(low), _number(high), np.eye(d)[i], "xyz"[i], target)
        for i, (low, high) in enumerate(zip(lower, upper, strict=True))
    )


def height(lower: float = -np.inf, upper: float = np.inf, *, exactly: Any = None, target: int = 0) -> tuple[Band, ...]:
    """Return the constraint on a target's height above the WGS 84 ellipsoid, metres: a band, or one exact value.

    Parameters
    ----------
    lower, upper : float
        Band; `lower` = 0 is "above ground".
    exactly : float or array (...), optional
        Known height, in the place of a band.
    target : int
        Which target.
    """
    low, high = (lower, upper) if exactly is None else (exactly, exactly)
    return (Band("height", _number(low), _number(high), np.zeros(0), "height", target),)


def visible(points: Any, *, elevation: float = 0.0, target: int = 0) -> tuple[Band, ...]:
    """Return the constraint that points, for instance satellites, stand above the target's horizon.

    Parameters
    ----------
    points : array (v, 3)
        ECEF, metres.
    elevation : float
        Least elevation, radians.
    target : int
        Which target.
    """
    # Bounded is the sine, see `optloc.models.surfaces`; it grows with the elevation.
    least = _number(np.sin(elevation))
    return tuple(
        Band("visible", least, _number(np.inf), point, f"sight of point {i}", target)
        for i, point in enumerate(np.asarray(points, dtype=float))
    )


def speed(upper: float, *, lower: float = 0.0, target: int = 0) -> tuple[Band, ...]:
    """Return the constraint on a target's speed, metres per second."""
    # No speed is negative: a lower bound of zero would be a side on which nothing can lie with a gradient.
    return (Band("speed", _number(lower if lower > 0.0 else -np.inf), _number(upper), np.zeros(0), "speed", target),)


def polygon(vertices: Any, *, target: int = 0) -> tuple[Polygon, ...]:
    """Return the constraint that a target's plan position lies in a simple polygon (v, 2), metres."""
    return (Polygon(np.asarray(vertices, dtype=float), "polygon", target),)


def _number(value: Any) -> Array:
    return np.asarray(value, dtype=float)


# Faces: the sides that hold with equality together, and how vectors are brought onto them.


@dataclass(frozen=True, slots=True)
class Level:
    """A constraint of a problem that holds with equality.

    Parameters
    ----------
    constraint : int
        Number of the constraint.
    side : "equal", "lower", "upper", or int
        Which bound; of a polygon, which edge.
    """

    constraint: int
    side: str | int


Face = tuple[Level, ...]


def exact(problem: Problem) -> Face:
    """Return the equalities of a problem."""
    return tuple(Level(i, "equal") for i, c in enumerate(problem.constraints) if is_exact(c))


def faces(problem: Problem) -> list[Face]:
    """Return every set of constraints that can hold with equality together; the equalities alone come first."""
    found = [exact(problem)]
    for i, constraint in enumerate(problem.constraints):
        sides = [] if is_exact(constraint) else list(_sides(i, constraint))
        # More sides than dimensions meet in no point; speeds bound other unknowns, and do not count.
        wider = [(*face, *side) for face in found for side in sides]
        found += [face for face in wider if sum(_kind(problem, v) != "speed" for v in face) <= problem.dimension]
    return sorted(found, key=len)


def face_names(problem: Problem, face: Face) -> tuple[str, ...]:
    """Return what each level of a face is called, for instance "height upper"."""
    return tuple(
        f"{problem.constraints[level.constraint].name} {'edge ' if isinstance(level.side, int) else ''}{level.side}"
        for level in face
    )


def _kind(problem: Problem, level: Level) -> str:
    constraint = problem.constraints[level.constraint]
    return constraint.kind if isinstance(constraint, Band) else "plane"


def is_exact(constraint: Band | Polygon) -> bool:
    """Return whether a constraint is an equality."""
    return isinstance(constraint, Band) and bool(np.all(constraint.lower == constraint.upper))


def needs_velocity(constraint: Band | Polygon) -> bool:
    """Return whether a constraint bounds the velocity of its target."""
    return isinstance(constraint, Band) and SURFACES[constraint.kind].velocity


def _sides(i: int, constraint: Band | Polygon) -> Iterator[Face]:
    if isinstance(constraint, Band):
        if np.isfinite(constraint.lower).all():
            yield (Level(i, "lower"),)
        if np.isfinite(constraint.upper).all():
            yield (Level(i, "upper"),)
        return
    # An answer lies on an edge, or in the corner where it meets the one before.
    for edge in range(len(constraint.vertices)):
        yield (Level(i, edge),)
        yield (Level(i, (edge - 1) % len(constraint.vertices)), Level(i, edge))


def levels(problem: Problem, face: Face, x: Array) -> tuple[Array, Array]:
    """Return g(x) - value (N, c) of the levels of a face and their gradients (N, c, n) to the shared unknowns."""
    values = np.zeros((len(x), len(face)))
    gradients = np.zeros((len(x), len(face), problem.layout.n_shared))
    for i, level in enumerate(face):
        band = _band(problem.constraints[level.constraint], level.side)
        jet, columns = _quantity(problem, band, x)
        values[:, i] = jet.value - (band.upper if level.side == "upper" else band.lower)
        for seed, partial in jet.partials.items():
            gradients[:, i, columns[seed]] = partial
    return values, gradients


def restore(problem: Problem, face: Face, x: Array) -> Array:
    """Return vectors (N, size) moved onto a face along the shortest way, by Newton steps."""
    n = problem.layout.n_shared
    # Newton squares a small relative distance: 1e-2 becomes rounding in three steps, and five are to spare.
    for _ in range(8):
        values, gradients = levels(problem, face, x)
        # A nanometre is the last digit of an ECEF coordinate; vectors that are NaN must not keep the others going.
        if np.nanmax(np.abs(values), initial=0.0) < 1e-9:
            break
        space = tangent(gradients, np.ones((len(x), n)))
        x = np.concatenate([x[:, :n] - (space.across @ values[..., None])[..., 0], x[:, n:]], axis=1)
    return x


def tangent_at(problem: Problem, face: Face, x: Array) -> Tangent:
    """Return the tangent space of a face at vectors (N, size)."""
    return tangent(levels(problem, face, x)[1], np.ones((len(x), problem.layout.n_shared)))


def _band(constraint: Band | Polygon, side: str | int) -> Band:
    if isinstance(constraint, Band):
        return constraint
    assert isinstance(side, int)
    here, there = constraint.vertices[side], constraint.vertices[(side + 1) % len(constraint.vertices)]
    along = there - here
    # Unit length, so that a level is in metres; it points outwards where corners go counter-clockwise.
    normal = np.array([along[1], -along[0]]) / np.hypot(*along)
    value = _number(normal @ here)
    return Band("plane", value, value, normal, constraint.name, constraint.target)


# What vectors and programs need to know of the constraints as they are stated.


def conjunction(problem: Problem) -> list[Band]:
    """Return the constraints as bands that must all hold: edges of a convex polygon too, a concave one is left out."""
    bands: list[Band] = []
    for c in problem.constraints:
        if isinstance(c, Band):
            bands.append(c)
            continue
        corners = c.vertices
        edge = np.roll(corners, -1, axis=0) - corners
        turn = edge[:, 0] * np.roll(edge, -1, axis=0)[:, 1] - edge[:, 1] * np.roll(edge, -1, axis=0)[:, 0]
        # Edges of a concave polygon need not all hold: such a region is no conjunction.
        if (turn >= 0.0).all() or (turn <= 0.0).all():
            sign = 1.0 if turn.sum() > 0.0 else -1.0
            for i in range(len(corners)):
                plane = _band(c, i)
                bands.append(
                    replace(
                        plane, coefficients=sign * plane.coefficients, upper=sign * plane.upper, lower=_number(-np.inf)
                    )
                )
    return bands


def face_of(problem: Problem, x: Array) -> Array:
    """Return the number of the face (N,) in `faces` on which vectors x (N, size) lie, the one with most levels."""
    found = np.zeros(len(x), dtype=int)
    for number, face in enumerate(faces(problem)):
        if face:
            values, _ = levels(problem, face, x)
            # Faces come with fewest levels first, so that the last one that fits has the most.
            found[(np.abs(values) <= 10.0 * TOLERANCE * (1.0 + np.abs(x).max(1, keepdims=True))).all(1)] = number
    return found


def violation(problem: Problem, x: Array) -> Array:
    """Return by how much vectors x (N, size) break their worst constraint, relative to its size (N,), or 0."""
    worst = np.zeros(len(x))
    for c in problem.constraints:
        if isinstance(c, Polygon):
            worst = np.maximum(worst, _outside(c, _plan(problem, c.target, x)))
            continue
        with np.errstate(all="ignore"):  # the speed of a target at rest has no derivative, and none is needed here
            value = _quantity(problem, c, x)[0].value
        for bound, sign in ((c.lower, 1.0), (c.upper, -1.0)):
            with np.errstate(invalid="ignore"):
                short = np.where(np.isfinite(bound), sign * (bound - value), -np.inf)
            # Metres of an altitude and sines of an elevation by one measure: relative to the bound, absolute near
            # zero.
            size = 1.0 + np.where(np.isfinite(bound), np.abs(bound), 0.0)
            worst = np.maximum(worst, short / size)
    return worst


def violation_names(problem: Problem) -> str:
    """Return the names of all constraints, for messages."""
    return ", ".join(dict.fromkeys(c.name for c in problem.constraints))


def _quantity(problem: Problem, band: Band, x: Array) -> tuple[Jet, dict[int, int]]:
    """Return the bounded quantity with its derivatives, and the column of x behind each seed."""
    surface, d, c = SURFACES[band.kind], problem.dimension, band.coefficients
    names = state_names(band.target, len(problem.motions), 2)
    slot, shared = problem.layout.find(names[0])
    if not shared:
        raise InvalidProblem(
            "a constraint needs a target whose state lasts the run", "constraints", "solve epoch by epoch"
        )
    columns = {i: slot.start + i for i in range(d)}
    position: tuple[Any, ...] = tuple(Jet(x[:, slot.start + i], {i: np.ones(1)}) for i in range(d))
    velocity: tuple[Any, ...] | None = None
    if surface.velocity:
        start = problem.layout.find(names[1])[0].start
        columns |= {d + i: start + i for i in range(d)}
        velocity = tuple(Jet(x[:, start + i], {d + i: np.ones(1)}) for i in range(d))
    ecef = to_ecef(problem, position) if surface.ecef else None
    # An edge of a polygon is a plane with two coefficients: it bounds the plan of a target in space.
    used = position[: c.shape[-1]] if band.kind == "plane" else position
    value = surface.g(Point(used, velocity, None, ecef), tuple(c[..., i] for i in range(c.shape[-1])))
    return value, columns


def _plan(problem: Problem, target: int, x: Array) -> Array:
    slot, _ = problem.layout.find(state_names(target, len(problem.motions), 0)[0])
    return x[:, slot.start : slot.start + 2]


def _outside(region: Polygon, points: Array) -> Array:
    """Return the distance of points (N, 2) from a polygon relative to its size; 0 inside."""
    a, b = region.vertices, np.roll(region.vertices, -1, axis=0)
    p = points[:, None]
    along, to = b - a, p - a
    share = np.clip((to * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    distance = np.sqrt(((to - share[..., None] * along) ** 2).sum(-1)).min(1)
    # Even-odd rule: a ray to the right crosses the boundary an odd number of times from inside.
    crosses = (a[:, 1] > p[..., 1]) != (b[:, 1] > p[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (p[..., 1] - a[:, 1]) * along[:, 0] / along[:, 1]
    inside = (crosses & (p[..., 0] < at)).sum(1) % 2 == 1
    return np.where(inside, 0.0, distance / (1.0 + np.abs(region.vertices).max()))
