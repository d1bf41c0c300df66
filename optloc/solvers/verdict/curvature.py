"""The curvature of the cost at an answer: covariance, weak directions, and the constraints that hold it."""

from __future__ import annotations

import numpy as np

from optloc.base import linalg
from optloc.base.types import Array
from optloc.linear.constraints import Face, face_names, faces, levels, tangent_at
from optloc.linear.normal import Normal, local_covariance, marginal
from optloc.problem.fix import Active
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.solvers.pool import Curvature

# Information that is none: no square of a Jacobian is as small, and its root still has an inverse.
_DEAD = 1e-300
# Share of the largest term of an open direction below which a term is not worth its words.
_TELLING = 0.05
# Spread of stations, relative to their coordinates, that rounding may have left of a point; and across a line or plane,
# relative to that along it: a micrometre a metre fixes nothing that noise would not hide.
_POINT, _FLAT = 1e-9, 1e-6


def measure_curvature(problem: Problem, equations: Normal, x: Array, face: Array) -> Curvature:
    """Return the curvature at vectors x (N, size) that lie on given faces (N,) of the constraints."""
    information, vector, ok = marginal(equations)
    covariance, regular = linalg.inverse(information)
    weakest = _smallest_pivot(information)
    active: Array = np.frompyfunc(lambda _: (), 1, 1)(np.arange(len(x)))
    sides = faces(problem) if problem.constraints else [()]
    for number in np.unique(face):
        if not sides[number]:
            continue
        items = np.flatnonzero(face == number)
        part = problem.take(items)
        space = tangent_at(part, sides[number], x[items])
        covariance[items], regular[items] = linalg.inverse_within(information[items], space)
        # what constraints hold is not open: the pivots are those along the face
        inner = np.swapaxes(space.along, -1, -2) @ information[items] @ space.along
        weakest[items] = _smallest_pivot(inner) if inner.shape[-1] else 1.0
        active[items] = _multipliers(part, sides[number], x[items], vector[items])
    regular = ok & regular
    local = _local_covariance(problem, equations, covariance)
    return Curvature(covariance, information, regular, weakest, active, local)


def _local_covariance(problem: Problem, equations: Normal, shared: Array) -> Array | None:
    """Return the covariance of the states that targets have at each epoch of a run, or None where there are none."""
    names = {name for i, m in enumerate(problem.motions) for name in state_names(i, len(problem.motions), m.order)}
    size = sum(slot.size for slot in problem.layout.local if slot.name in names)
    with np.errstate(all="ignore"):
        return local_covariance(equations, shared, size) if size else None


def _multipliers(problem: Problem, face: Face, x: Array, vector: Array) -> Array:
    """Return the active constraints of each problem: gradient of the cost + sum of multiplier * gradient = 0."""
    _, gradients = levels(problem, face, x)
    names = face_names(problem, face)
    out = np.empty(len(x), dtype=object)
    for i in range(len(x)):
        out[i] = ()
        if np.isfinite(gradients[i]).all() and np.isfinite(vector[i]).all():
            # half the gradient stands in the normal equations: twice it is balanced by the constraints, as well as they
            # can
            values = np.linalg.lstsq(gradients[i].T, 2.0 * vector[i], rcond=None)[0]
            out[i] = tuple(Active(name, float(value)) for name, value in zip(names, values, strict=True))
    return out


def _smallest_pivot(information: Array) -> Array:
    """Return the smallest squared pivot of the information scaled to a unit diagonal, (N,)."""
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        # a unit diagonal: metres, seconds and radians weigh the same
        scale = 1.0 / np.sqrt(diagonal)
        lower, ok = linalg.factor(information * scale[..., :, None] * scale[..., None, :])
        pivots = np.diagonal(lower, axis1=-2, axis2=-1).min(-1, initial=1.0) ** 2
    return np.where(ok & np.isfinite(pivots), pivots, 0.0)


def weak_direction(problem: Problem, information: Array) -> str:
    """Return a sentence that names the combination of unknowns that the data leave open."""
    diagonal = np.diagonal(information)
    if not np.isfinite(information).all():
        return "the information is not finite"
    labels = problem.layout.labels()
    dead = np.flatnonzero(diagonal <= _DEAD)
    if len(dead):
        return "nothing measures " + ", ".join(labels[i] for i in dead)
    scale = 1.0 / np.sqrt(diagonal)
    _, vectors = np.linalg.eigh(information * scale[:, None] * scale[None])
    direction = vectors[:, 0] * scale
    direction = direction / np.abs(direction).max()
    terms = [f"{value:+.2g} {labels[i]}" for i, value in enumerate(direction) if abs(value) > _TELLING]
    return "undetermined along " + " ".join(terms)


def station_direction(problem: Problem) -> str:
    """Return a sentence that names why the stations of one problem cannot fix a position."""
    position = problem.stations.position.reshape(-1, problem.dimension)
    used = sorted({int(s) for rows in problem.rows for s in (*rows.a, *rows.b) if s >= 0})
    places = position[used]
    values, vectors = np.linalg.eigh(np.cov(places.T, bias=True)) if len(used) > 1 else (np.zeros(1), np.eye(1))
    spread = np.sqrt(np.maximum(values, 0.0))
    if spread[-1] <= _POINT * (1.0 + np.abs(places).max()):
        return "the stations stand at one point"
    flat = int((spread < _FLAT * spread[-1]).sum())
    axis = ", ".join(f"{v:.2f}" for v in vectors[:, -1])
    if flat >= problem.dimension - 1 and problem.dimension > 1:
        return f"the stations stand on one line along ({axis}); turning about it changes nothing"
    axis = ", ".join(f"{v:.2f}" for v in vectors[:, 0])
    return f"the rows leave more than one direction open; the stations spread least along ({axis})"
