"""Levels: single bounds of constraints that are satisfied with equality, their gradients, and projection onto them.

A *level* is one bound of one constraint, satisfied with equality. A *face* is a set of levels that are satisfied
together. Letters: N vectors x, `size` unknowns in a vector, the first n of which all epochs share, d coordinates, c
levels of a face.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.linalg import tangent
from optloc.base.types import AnyOf, Array, Band, Constraint, Polygon
from optloc.linear.constraints.polygons import edge_of, sense_of
from optloc.linear.constraints.quantities import is_exact, quantity_at
from optloc.models.surfaces import SURFACES
from optloc.problem.problem import Problem


@dataclass(frozen=True, slots=True)
class Level:
    """A constraint of a problem that an estimate satisfies with equality.

    Parameters
    ----------
    constraint : int
        Number of the constraint.
    side : "equal", "lower", "upper", int, or tuple
        The bound; for a polygon, the number of the edge. For a union: the numbers of the member and of its band, and
        the bound.
    epoch : int, optional
        Epoch along a course; None: the reference time.
    """

    constraint: int
    side: str | int | tuple[int, int, str]
    epoch: int | None = None


Face = tuple[Level, ...]


def band_at(problem: Problem, level: Level) -> Band:
    """Return the band of a level; the edge of a polygon becomes a plane."""
    return _band(problem.constraints[level.constraint], level.side)


def _band(constraint: Constraint, side: str | int | tuple[int, int, str]) -> Band:
    """Return the band of a side of a constraint; the edge with number `side` of a polygon becomes a plane."""
    if isinstance(constraint, Band):
        return constraint
    if isinstance(constraint, AnyOf):
        assert isinstance(side, tuple)
        return constraint.members[side[0]][side[1]]
    assert isinstance(side, int)
    return edge_of(constraint, side)


def side_of(level: Level) -> str | int:
    """Return "equal", "lower" or "upper", or the number of the edge of a polygon."""
    return level.side[2] if isinstance(level.side, tuple) else level.side


def bound_of(problem: Problem, level: Level) -> Array:
    """Return the bound (...) that the quantity of a level is equal to."""
    band = band_at(problem, level)
    return band.upper if side_of(level) == "upper" else band.lower


def outwards(problem: Problem, level: Level) -> float:
    """Return 1 if the quantity of a level increases out of its bound, -1 if it decreases, 0 for an equality."""
    constraint = problem.constraints[level.constraint]
    if isinstance(constraint, Polygon):
        return sense_of(constraint)
    return 0.0 if is_exact(constraint) else 1.0 if side_of(level) == "upper" else -1.0


def is_flat(problem: Problem, level: Level) -> bool:
    """Return whether a level is a plane."""
    return kind_of(problem, level) == "plane"


def is_height(problem: Problem, level: Level) -> bool:
    """Return whether a level is a height above the Earth."""
    return kind_of(problem, level) == "height"


def binds_position(problem: Problem, level: Level) -> bool:
    """Return whether a level takes away freedom of the position; a speed does not."""
    return SURFACES[kind_of(problem, level)].places


def kind_of(problem: Problem, level: Level) -> str:
    """Return the kind of surface of a level; the edges of polygons are planes."""
    constraint = problem.constraints[level.constraint]
    return "plane" if isinstance(constraint, Polygon) else _band(constraint, level.side).kind


def is_corner(problem: Problem, face: Face) -> bool:
    """Return whether a face is one point: the number of its planes is the dimension."""
    return len(face) == problem.dimension and all(is_flat(problem, level) for level in face)


def face_names(problem: Problem, face: Face) -> tuple[str, ...]:
    """Return the name of each level of a face, for instance "height upper"."""
    return tuple(
        _name(problem.constraints[level.constraint], level)
        + ("" if level.epoch is None else f" at {problem.times[level.epoch]:g} s")
        for level in face
    )


def _name(constraint: Constraint, level: Level) -> str:
    """Return the name of a level at the reference time."""
    if isinstance(level.side, tuple):
        band = _band(constraint, level.side)
        own = "" if band.name.startswith(constraint.name) else f"{constraint.name} "
        return f"{own}{band.name} {level.side[2]}"
    return f"{constraint.name} {'edge ' if isinstance(level.side, int) else ''}{level.side}"


def on_face(problem: Problem, face: Face) -> Problem:
    """Return the problem whose only constraints are the levels of a face, as equalities at the reference time."""
    bands = []
    for level in face:
        band, value = band_at(problem, level), bound_of(problem, level)
        bands.append(replace(band, lower=value, upper=value, coefficients=_padded(problem, band)))
    return replace(problem, constraints=tuple(bands))


def _padded(problem: Problem, band: Band) -> Array:
    """Return the coefficients of a band.

    For a plane, zeros are appended up to the dimension (edges of polygons have two).
    """
    lacking = problem.dimension - band.coefficients.shape[-1] if band.kind == "plane" else 0
    return np.concatenate([band.coefficients, np.zeros((*band.coefficients.shape[:-1], lacking))], axis=-1)


def levels(problem: Problem, face: Face, x: Array) -> tuple[Array, Array]:
    """Return g(x) - value (N, c) of the levels of a face, and their gradients (N, c, n) to the shared unknowns."""
    values = np.zeros((len(x), len(face)))
    gradients = np.zeros((len(x), len(face), problem.layout.n_shared))
    for i, level in enumerate(face):
        with np.errstate(all="ignore"):  # the distance from a point has no derivative there
            jet, columns = quantity_at(problem, band_at(problem, level), x, level.epoch)
        values[:, i] = jet.value - bound_of(problem, level)
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
