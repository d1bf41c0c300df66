"""Constraints: functions for users to state them, and the faces on which an estimate may be.

A *level* is one bound of one constraint, satisfied with equality. A *face* is a set of levels that are satisfied
together. Letters: N vectors x, `size` unknowns in a vector, the first n of which all epochs share, d coordinates, c
levels of a face. A *band* is a constraint ``lower <= g(x) <= upper``; its *quantity* is g.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.errors import InvalidProblem
from optloc.base.linalg import tangent
from optloc.base.types import Amount, Array, Band, Motion, Polygon
from optloc.base.units import in_si
from optloc.linear.courses import course_at, elapsed, height_at, to_ecef
from optloc.models.primitives import Jet, Point
from optloc.models.surfaces import SURFACES
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem

# Relative violation of a constraint that is accepted; a micrometre if the bound is zero. This is above the rounding of
# coordinates of the Earth's size (a nanometre), and below the error of any measurement.
TOLERANCE = 1e-6

# Functions with which users state constraints.


def box(lower: Sequence[Amount] | Array, upper: Sequence[Amount] | Array, *, target: int = 0) -> tuple[Band, ...]:
    """Return the constraint that a target is in a box; an infinite bound means no bound.

    Parameters
    ----------
    lower, upper : sequence of d float or str
        Least and greatest coordinates in the problem's frame: metres, or text such as "2 km".
    target : int
        Number of the target.
    """
    d = len(lower)
    return tuple(
        Band("plane", _metres(low, "box"), _metres(high, "box"), np.eye(d)[i], "xyz"[i], target)
        for i, (low, high) in enumerate(zip(lower, upper, strict=True))
    )


def height(
    lower: Amount | Array = -np.inf,
    upper: Amount | Array = np.inf,
    *,
    exactly: Amount | Array | None = None,
    target: int = 0,
    along: bool = True,
) -> tuple[Band, ...]:
    """Return the constraint on a target's height above the WGS 84 ellipsoid: a band, or one exact value.

    A straight course departs from a height above the curved Earth. So a moving target needs
    ``Motion(order, over="ground")``, see also `reported`.

    Parameters
    ----------
    lower, upper : float or str
        Band, metres or text such as "1640 ft"; `lower` = 0 is "above ground".
    exactly : float, str or array (...), optional
        Known height, instead of a band.
    target : int
        Number of the target.
    along : bool
        Whether the constraint applies at every epoch, or only at the reference time.
    """
    low, high = (lower, upper) if exactly is None else (exactly, exactly)
    low, high = _metres(low, "height"), _metres(high, "height")
    return (Band("height", low, high, np.zeros(0), "height", target, along),)


def reported(
    heights: ArrayLike,
    times: ArrayLike,
    *,
    within: Amount = 0.0,
    order: int = 1,
    reference: float | None = None,
    target: int = 0,
) -> tuple[Motion, tuple[Band, ...]]:
    """Return motion and constraint of a target whose height is known at every epoch.

    An example is an aircraft that reports its height. The course over ground is a polynomial of the given order. Its
    height at each epoch is the reported height plus a polynomial of time, which the constraint bounds: it is zero if
    `within` is zero.

    Parameters
    ----------
    heights : array (..., k)
        Heights above the WGS 84 ellipsoid at each epoch, metres.
    times : array (k,)
        Times of the epochs, seconds, ascending.
    within : float or str
        Half the width of the band about the reported height: metres, or text such as "50 ft"; 0: the height is exact.
    order : 1 or 2
        Order of the motion over ground: 1 for a constant velocity, 2 for a constant acceleration.
    reference : float, optional
        Time to which the state belongs, seconds; the first epoch by default.
    target : int
        Number of the target.

    Returns
    -------
    Motion
        Motion over ground. Its field `rise` (..., k, 2) contains the heights relative to the height at the reference
        time, metres, and their rates, m/s.
    tuple of Band
        The height at the reference time, and therefore at every epoch.

    Raises
    ------
    InvalidProblem
        If the number of heights differs from the number of times, or times are not ascending.
    """
    heights, times = np.asarray(heights, dtype=float), np.asarray(times, dtype=float)
    if times.ndim != 1 or heights.shape[-1:] != times.shape or not (np.diff(times) > 0.0).all():
        what = f"heights of shape {heights.shape} for times of shape {times.shape}"
        raise InvalidProblem(what, "reported heights", "give one height for each epoch, and ascending times")
    # height at the reference time: linear between epochs `before` and `before` + 1, outside the times constant
    last = len(times) - 1
    place = float(np.interp(times[0] if reference is None else reference, times, np.arange(last + 1.0)))
    before = min(int(place), last)
    share = place - before
    at_reference = heights[..., before] * (1.0 - share) + heights[..., min(before + 1, last)] * share
    rate = np.gradient(heights, times, axis=-1) if last else np.zeros_like(heights)
    half = float(in_si(within, "length", "within", place=True))
    rise = np.stack([heights - at_reference[..., None], rate], axis=-1)
    motion = Motion(order, reference=reference, over="ground", rise=rise)
    return motion, height(at_reference - half, at_reference + half, target=target)


def visible(points: ArrayLike, *, elevation: Amount = 0.0, target: int = 0) -> tuple[Band, ...]:
    """Return the constraint that points, for instance satellites, are above the target's horizon.

    Parameters
    ----------
    points : array (v, 3)
        ECEF, metres.
    elevation : float or str
        Least elevation: radians, or text such as "5 deg".
    target : int
        Number of the target.
    """
    # The bounded quantity is the sine, see `optloc.models.surfaces`, which increases with the elevation.
    least = _float_array(np.sin(in_si(elevation, "angle", "elevation")))
    return tuple(
        Band("visible", least, _float_array(np.inf), point, f"sight of point {i}", target)
        for i, point in enumerate(np.asarray(points, dtype=float))
    )


def speed(upper: Amount, *, lower: Amount = 0.0, target: int = 0) -> tuple[Band, ...]:
    """Return the constraint on a target's speed: metres per second, or text such as "90 km/h"."""
    upper, lower = float(in_si(upper, "speed", "speed")), float(in_si(lower, "speed", "speed"))
    # A lower bound of zero is left out: no speed is negative, and at zero the gradient does not exist.
    return (
        Band(
            "speed", _float_array(lower if lower > 0.0 else -np.inf), _float_array(upper), np.zeros(0), "speed", target
        ),
    )


def polygon(vertices: ArrayLike, *, target: int = 0) -> tuple[Polygon, ...]:
    """Return the constraint that a target's plan position is in a simple polygon (v, 2), metres."""
    return (Polygon(np.asarray(vertices, dtype=float), "polygon", target),)


def _float_array(value: Any) -> Array:
    """Return a value as an array of floats."""
    return np.asarray(value, dtype=float)


def _metres(value: Any, where: str) -> Array:
    """Return a length in metres, from a number or a text with a unit."""
    return _float_array(in_si(value, "length", where, place=True))


# Faces: levels that are satisfied with equality together, and the projection of vectors onto them.


@dataclass(frozen=True, slots=True)
class Level:
    """A constraint of a problem that an estimate satisfies with equality.

    Parameters
    ----------
    constraint : int
        Number of the constraint.
    side : "equal", "lower", "upper", or int
        The bound; for a polygon, the number of the edge.
    epoch : int, optional
        Epoch along a course; None: the reference time.
    """

    constraint: int
    side: str | int
    epoch: int | None = None


Face = tuple[Level, ...]


def exact(problem: Problem) -> Face:
    """Return the equality constraints of a problem, each at the epochs that decide about the whole course."""
    return tuple(
        Level(i, "equal", epoch)
        for i, c in enumerate(problem.constraints)
        if is_exact(c)
        for epoch in decisive_epochs(problem, c)
    )


def decisive_epochs(problem: Problem, constraint: Band | Polygon) -> list[int | None]:
    """Return the epochs at which a constraint along a course decides about all epochs; None is the reference time.

    The bounded quantity is a polynomial of time of the motion's order n. An equality at n + 1 epochs makes it constant.
    If n = 1, bounds at the first and the last epoch are enough.
    """
    if not isinstance(constraint, Band) or not holds_along(problem, constraint):
        return [None]
    count = problem.motions[constraint.target].order + 1
    chosen = np.unique(np.linspace(0, problem.epochs - 1, count).round().astype(int))
    return [int(k) for k in np.argsort(problem.times, kind="stable")[chosen]]


def holds_along(problem: Problem, band: Band) -> bool:
    """Return whether a band bounds a whole course.

    This needs three conditions: the band applies along the course, the target moves, and its state lasts for the run.
    """
    motion = problem.motions[band.target]
    return band.along and motion.span == "run" and motion.order > 0


def faces(problem: Problem) -> list[Face]:
    """Return every set of levels that an estimate can satisfy together, sorted by their number.

    The set with only the equalities is the first.
    """
    found = [exact(problem)]
    for i, constraint in enumerate(problem.constraints):
        sides = (
            []
            if is_exact(constraint)
            else _combined_sides(list(_sides(i, constraint)), decisive_epochs(problem, constraint))
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
    count = Counter(level.epoch for level in face if _kind(problem, level) != "speed")
    return max(count.values(), default=0)


def on_face(problem: Problem, face: Face) -> Problem:
    """Return the problem whose only constraints are the levels of a face, as equalities at the reference time."""
    bands = []
    for level in face:
        band = _band(problem.constraints[level.constraint], level.side)
        value = band.upper if level.side == "upper" else band.lower
        bands.append(replace(band, lower=value, upper=value, coefficients=_padded(problem, band)))
    return replace(problem, constraints=tuple(bands))


def _padded(problem: Problem, band: Band) -> Array:
    """Return the coefficients of a band.

    For a plane, zeros are appended up to the dimension (edges of polygons have two).
    """
    lacking = problem.dimension - band.coefficients.shape[-1] if band.kind == "plane" else 0
    return np.concatenate([band.coefficients, np.zeros((*band.coefficients.shape[:-1], lacking))], axis=-1)


def is_corner(problem: Problem, face: Face) -> bool:
    """Return whether a face is one point: the number of its planes is the dimension."""
    return len(face) == problem.dimension and all(_kind(problem, level) == "plane" for level in face)


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
            out &= len(here) < 2 or _orientation(constraint.vertices) * _orientation(_corner(constraint, here)) > 0.0
    return out


def bounds(problem: Problem) -> Face:
    """Return every single bound of the inequalities of a problem, at the reference time, without polygon corners."""
    sides = (side for i, c in enumerate(problem.constraints) if not is_exact(c) for side in _sides(i, c))
    return tuple(side[0] for side in sides if len(side) == 1)


def outwards(problem: Problem, level: Level) -> float:
    """Return 1 if the quantity of a level increases out of its bound, -1 if it decreases, 0 for an equality."""
    constraint = problem.constraints[level.constraint]
    if isinstance(constraint, Polygon):
        return _orientation(constraint.vertices)
    return 0.0 if is_exact(constraint) else 1.0 if level.side == "upper" else -1.0


def is_flat(problem: Problem, level: Level) -> bool:
    """Return whether a level is a plane."""
    return _kind(problem, level) == "plane"


def _corner(region: Polygon, edges: list[str | int]) -> Array:
    """Return three points (3, 2) of a polygon: start of an edge, the corner at its end, and end of the next edge."""
    first, count = edges[0], len(region.vertices)
    assert isinstance(first, int)
    return region.vertices[[first, (first + 1) % count, (first + 2) % count]]


def _orientation(vertices: Array) -> float:
    """Return 1 if corners (v, 2) are in counter-clockwise order around their interior, -1 if clockwise."""
    (x, y), (u, v) = vertices.T, np.roll(vertices, -1, axis=0).T
    return float(np.sign((x * v - u * y).sum()))


def face_names(problem: Problem, face: Face) -> tuple[str, ...]:
    """Return the name of each level of a face, for instance "height upper"."""
    return tuple(
        f"{problem.constraints[level.constraint].name} {'edge ' if isinstance(level.side, int) else ''}{level.side}"
        + ("" if level.epoch is None else f" at {problem.times[level.epoch]:g} s")
        for level in face
    )


def _kind(problem: Problem, level: Level) -> str:
    """Return the kind of surface of a level; the edges of polygons are planes."""
    constraint = problem.constraints[level.constraint]
    return constraint.kind if isinstance(constraint, Band) else "plane"


def is_height(problem: Problem, level: Level) -> bool:
    """Return whether a level is a height above the Earth."""
    return _kind(problem, level) == "height"


def is_exact(constraint: Band | Polygon) -> bool:
    """Return whether a constraint is an equality."""
    return isinstance(constraint, Band) and bool(np.all(constraint.lower == constraint.upper))


def needs_velocity(constraint: Band | Polygon) -> bool:
    """Return whether a constraint bounds the velocity of its target."""
    return isinstance(constraint, Band) and SURFACES[constraint.kind].velocity


def _sides(i: int, constraint: Band | Polygon) -> Iterator[Face]:
    """Yield the finite bounds of constraint number i if it is a band, or the edges and corners of a polygon."""
    if isinstance(constraint, Band):
        if np.isfinite(constraint.lower).all():
            yield (Level(i, "lower"),)
        if np.isfinite(constraint.upper).all():
            yield (Level(i, "upper"),)
        return
    # An estimate is on an edge, or in the corner with the edge before.
    for edge in range(len(constraint.vertices)):
        yield (Level(i, edge),)
        yield (Level(i, (edge - 1) % len(constraint.vertices)), Level(i, edge))


def levels(problem: Problem, face: Face, x: Array) -> tuple[Array, Array]:
    """Return g(x) - value (N, c) of the levels of a face, and their gradients (N, c, n) to the shared unknowns."""
    values = np.zeros((len(x), len(face)))
    gradients = np.zeros((len(x), len(face), problem.layout.n_shared))
    for i, level in enumerate(face):
        band = _band(problem.constraints[level.constraint], level.side)
        jet, columns = _quantity(problem, band, x, level.epoch)
        values[:, i] = jet.value - (band.upper if level.side == "upper" else band.lower)
        for seed, partial in jet.partials.items():
            gradients[:, i, columns[seed]] = partial
    return values, gradients


def restore(problem: Problem, face: Face, x: Array) -> Array:
    """Return vectors x (N, size) projected onto a face along the shortest way, by Newton steps.

    Local unknowns do not move.
    """
    n = problem.layout.n_shared
    # Newton squares a small relative distance: three steps reduce 1e-2 to rounding, and five are in reserve.
    for _ in range(8):
        values, gradients = levels(problem, face, x)
        # A nanometre is the last digit of an ECEF coordinate. NaN vectors must not keep the iteration going.
        if np.nanmax(np.abs(values), initial=0.0) < 1e-9:
            break
        space = tangent(gradients, np.ones((len(x), n)))
        x = np.concatenate([x[:, :n] - (space.across @ values[..., None])[..., 0], x[:, n:]], axis=1)
    return x


def tangent_at(problem: Problem, face: Face, x: Array) -> Array:
    """Return a basis (N, n, n - c) of the directions that stay on a face, at vectors (N, size)."""
    return tangent(levels(problem, face, x)[1], np.ones((len(x), problem.layout.n_shared))).along


def _band(constraint: Band | Polygon, side: str | int) -> Band:
    """Return the band of a level; the edge with number `side` of a polygon becomes a plane."""
    if isinstance(constraint, Band):
        return constraint
    assert isinstance(side, int)
    here, there = constraint.vertices[side], constraint.vertices[(side + 1) % len(constraint.vertices)]
    along = there - here
    # Unit length, so that a level is in metres; it points outwards if corners are counter-clockwise.
    normal = np.array([along[1], -along[0]]) / np.hypot(*along)
    value = _float_array(normal @ here)
    return Band("plane", value, value, normal, constraint.name, constraint.target)


# Functions on the stated constraints, for vectors and for nonlinear programs.


def conjunction(problem: Problem) -> list[Band]:
    """Return the constraints as bands that a valid estimate satisfies all together.

    Edges of convex polygons are included. Concave polygons are left out.
    """
    bands: list[Band] = []
    for c in problem.constraints:
        if isinstance(c, Band):
            bands.append(c)
            continue
        corners = c.vertices
        edge = np.roll(corners, -1, axis=0) - corners
        turn = edge[:, 0] * np.roll(edge, -1, axis=0)[:, 1] - edge[:, 1] * np.roll(edge, -1, axis=0)[:, 0]
        # For a concave polygon, a point inside can violate an edge: the region is not a conjunction.
        if (turn >= 0.0).all() or (turn <= 0.0).all():
            sign = 1.0 if turn.sum() > 0.0 else -1.0
            for i in range(len(corners)):
                plane = _band(c, i)
                bands.append(
                    replace(
                        plane,
                        coefficients=sign * plane.coefficients,
                        upper=sign * plane.upper,
                        lower=_float_array(-np.inf),
                    )
                )
    return bands


def face_of(problem: Problem, x: Array) -> Array:
    """Return the number (N,) in `faces` of the face with most levels on which vectors x (N, size) are; 0 if on none."""
    found = np.zeros(len(x), dtype=int)
    for number, face in enumerate(faces(problem)):
        if face:
            values, _ = levels(problem, face, x)
            # Faces are sorted by number of levels, so that the last face that fits has the most levels.
            found[(np.abs(values) <= 10.0 * TOLERANCE * (1.0 + np.abs(x).max(1, keepdims=True))).all(1)] = number
    return found


def violation(problem: Problem, x: Array) -> Array:
    """Return the violation (N,) of the worst constraint at vectors x (N, size); 0 if all constraints are satisfied.

    The violation is divided by one plus the absolute bound, or for a polygon by one plus its greatest coordinate.
    """
    worst = np.zeros(len(x))
    for c in problem.constraints:
        if isinstance(c, Polygon):
            worst = np.maximum(worst, _polygon_violation(c, _horizontal(problem, c.target, x)))
            continue
        with np.errstate(all="ignore"):  # the speed of a target at rest has no derivative, and none is needed here
            values = [_quantity(problem, c, x, epoch)[0].value for epoch in decisive_epochs(problem, c)]
        for value in values:
            worst = np.maximum(worst, _band_violation(c, value))
    return worst


def _band_violation(band: Band, value: Array) -> Array:
    """Return the violation (N,) of the worse bound, divided by one plus the absolute bound; negative if satisfied."""
    worst = np.full(len(value), -np.inf)
    for bound, sign in ((band.lower, 1.0), (band.upper, -1.0)):
        with np.errstate(invalid="ignore"):
            lacking = np.where(np.isfinite(bound), sign * (bound - value), -np.inf)
        # One measure for metres of a height and sines of an elevation: relative to the bound, absolute near zero.
        size = 1.0 + np.where(np.isfinite(bound), np.abs(bound), 0.0)
        worst = np.maximum(worst, lacking / size)
    return worst


def violation_names(problem: Problem) -> str:
    """Return the names of all constraints, for messages."""
    return ", ".join(dict.fromkeys(c.name for c in problem.constraints))


def _quantity(problem: Problem, band: Band, x: Array, epoch: int | None = None) -> tuple[Jet, dict[int, int]]:
    """Return the bounded quantity (N,) at an epoch with its derivatives, and the column of x for each derivative.

    The second result maps the seed of each derivative to the column. The epoch None is the reference time.
    """
    d, columns, states = problem.dimension, dict[int, int](), []
    for j, name in enumerate(state_names(band.target, len(problem.motions), problem.motions[band.target].order)):
        slot, shared = problem.layout.find(name)
        if not shared:
            raise InvalidProblem(
                "a constraint needs a target whose state lasts the run", "constraints", "solve epoch by epoch"
            )
        columns |= {d * j + i: slot.start + i for i in range(d)}
        states.append(tuple(Jet(x[:, slot.start + i], {d * j + i: np.ones(1)}) for i in range(d)))
    c = band.coefficients
    value = bounded(problem, band, states, tuple(c[..., i] for i in range(c.shape[-1])), epoch)
    return value, columns


def bounded(
    problem: Problem, band: Band, states: Sequence[Any], coefficients: tuple[Any, ...], epoch: int | None
) -> Any:
    """Return the quantity that a band bounds, less the known rise of a height.

    Parameters
    ----------
    problem : Problem
        Problem with the motion of the target.
    band : Band
        The constraint.
    states : sequence of tuples of d numbers
        Position, velocity and acceleration, as far as the target has them: jets or symbols.
    coefficients : tuple of c numbers
        Coefficients of the band.
    epoch : int, optional
        Epoch along the course; None: the reference time.
    """
    surface = SURFACES[band.kind]
    since = 0.0 if epoch is None else float(elapsed(problem, band.target)[epoch])
    if epoch is not None and band.kind == "height":
        return height_at(problem, list(states), since)
    position = states[0] if epoch is None else course_at(problem, band.target, list(states), since)
    ecef = to_ecef(problem, position) if surface.ecef else None
    # An edge of a polygon is a plane with two coefficients: it bounds the plan position of a target in space.
    used = position[: len(coefficients)] if band.kind == "plane" else position
    return surface.g(Point(used, states[1] if surface.velocity else None, None, ecef), coefficients)


def _horizontal(problem: Problem, target: int, x: Array) -> Array:
    """Return the plan positions (N, 2) of a target in vectors x (N, size), metres."""
    slot, _ = problem.layout.find(state_names(target, len(problem.motions), 0)[0])
    return x[:, slot.start : slot.start + 2]


def _polygon_violation(region: Polygon, points: Array) -> Array:
    """Return the distance of points (N, 2) from a polygon, divided by one plus its greatest coordinate; 0 inside."""
    a, b = region.vertices, np.roll(region.vertices, -1, axis=0)
    p = points[:, None]
    along, to = b - a, p - a
    share = np.clip((to * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    distance = np.sqrt(((to - share[..., None] * along) ** 2).sum(-1)).min(1)
    # Even-odd rule: a ray from inside to the right crosses the boundary an odd number of times.
    crosses = (a[:, 1] > p[..., 1]) != (b[:, 1] > p[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (p[..., 1] - a[:, 1]) * along[:, 0] / along[:, 1]
    inside = (crosses & (p[..., 0] < at)).sum(1) % 2 == 1
    return np.where(inside, 0.0, distance / (1.0 + np.abs(region.vertices).max()))
