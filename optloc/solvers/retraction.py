"""Descents that never leave a face, for faces on which damped least squares with equalities fails.

A turn rate is an example: it has no limit where a course comes to rest, and steps across that place leave the face.
Here each step is along the face and is followed by a projection back onto it.

Letters: M points of several problems, c levels of a face, `size` numbers of a parameter vector, the first s of which
all epochs share.
"""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array, Status
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import TOLERANCE, Face, bound_of, levels, tangent_at
from optloc.linear.normal import marginal
from optloc.linear.vectors import complete
from optloc.problem.problem import Problem

# Newton steps of a projection: three reduce a relative distance of 1e-2 to rounding, and three are in reserve.
_PROJECTIONS = 6
# Steps of a descent. It converges linearly if the face is bent.
_STEPS = 60
# First damping relative to the diagonal of the information, its factors after a good and a bad step, and its limit.
# These are usual values of the method of Levenberg and Marquardt.
_DAMPING, _BETTER, _WORSE, _MOST = 1e-3, 0.3, 5.0, 1e8
# Expected decrease of chi-square, relative to chi-square plus one, below which a point is a minimum.
_FLAT = 1e-8


def projected(problem: Problem, face: Face, x: Array, root: Array) -> Array:
    """Return the shared unknowns (M, s) of vectors (M, size) projected onto a face along the shortest way in a metric.

    The way is found by Newton steps. `root` (M, s, s) times its transpose is the inverse of the metric.
    """
    s = problem.layout.n_shared
    x = x.copy()
    for _ in range(_PROJECTIONS):
        with np.errstate(all="ignore"):
            values, gradients = levels(problem, face, x)
            across = gradients @ root
            # a point without a gradient stays, and is then not on the face
            across, values = (np.where(np.isfinite(part), part, 0.0) for part in (across, values))
            step = root @ (np.linalg.pinv(across) @ values[..., None])
        x[:, :s] -= np.where(np.isfinite(step[..., 0]), step[..., 0], 0.0)
    return x[:, :s]


def is_on(problem: Problem, face: Face, x: Array) -> Array:
    """Return flags (M,) of vectors x (M, size) that are on all levels of a face."""
    value = np.stack([np.broadcast_to(bound_of(problem, level), (len(x),)) for level in face], axis=1)
    with np.errstate(all="ignore"):
        return np.asarray((np.abs(levels(problem, face, x)[0]) <= TOLERANCE * (1.0 + np.abs(value))).all(1))


def descend_along(problem: Problem, face: Face, start: Array) -> tuple[Array, Array, Array]:
    """Return points (M, size), costs (M,) and statuses (M,) of the descents along a face from starts (M, size).

    The status is `ok`, or `max_iterations` for a descent that is not finished. It is `numerical` for a start that
    cannot be projected onto the face.

    Parameters
    ----------
    problem : Problem
        Flat batch of M problems without unknowns of single epochs, except for emission times.
    face : Face
        The levels.
    start : array (M, size)
        Starts.
    """
    s = problem.layout.n_shared
    root = _units(problem, start)
    x = _on_face(problem, face, start, root)
    usable = is_on(problem, face, x) & np.isfinite(x).all(-1)
    x = np.where(usable[:, None], x, start)
    cost, damping = np.where(usable, _cost(problem, x), np.inf), np.full(len(x), _DAMPING)
    code = np.where(usable, np.int8(Status.MAX_ITERATIONS), np.int8(Status.NUMERICAL))
    for _ in range(_STEPS):
        open_ = np.flatnonzero(code == Status.MAX_ITERATIONS)
        if not len(open_):
            break
        part, here = problem.take(open_), x[open_]
        along, information, vector = _within(part, face, here)
        diagonal = np.diagonal(information, axis1=-2, axis2=-1)
        raised = information + (damping[open_, None] * diagonal)[..., None] * np.eye(along.shape[-1])
        step = (np.linalg.pinv(raised, hermitian=True) @ vector[..., None])[..., 0]
        flat = (step * vector).sum(-1) <= _FLAT * (1.0 + cost[open_])
        trial = here.copy()
        trial[:, :s] += (along @ step[..., None])[..., 0]
        trial = _on_face(part, face, trial, root[open_])
        least = np.where(is_on(part, face, trial), _cost(part, trial), np.inf)
        better = least < cost[open_]
        x[open_[better]], cost[open_[better]] = trial[better], least[better]
        damping[open_] *= np.where(better, _BETTER, _WORSE)
        # with a damping that large, the last steps did not decrease the cost at all
        code[open_[flat & (damping[open_] <= 1.0)]] = Status.OK
        code[open_[damping[open_] > _MOST]] = Status.STALLED
    return x, cost, code


def _units(problem: Problem, x: Array) -> Array:
    """Return diagonal matrices (M, s, s) of the standard deviations of each shared unknown alone, which scale steps."""
    with np.errstate(all="ignore"):
        information, _, _ = marginal(equations_at(problem, np.where(np.isfinite(x), x, 0.0)))
        unit = 1.0 / np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    return np.where(np.isfinite(unit), unit, 1.0)[..., None] * np.eye(problem.layout.n_shared)


def _on_face(problem: Problem, face: Face, x: Array, root: Array) -> Array:
    """Return vectors (M, size) projected onto a face, with the emission times that fit best."""
    return complete(problem, projected(problem, face, x, root)[:, None])[:, 0]


def _cost(problem: Problem, x: Array) -> Array:
    """Return the cost (M,) at vectors (M, size); infinite where it is not finite."""
    with np.errstate(all="ignore"):
        cost = equations_at(problem, np.where(np.isfinite(x), x, 0.0)).cost
    return np.where(np.isfinite(cost) & np.isfinite(x).all(-1), cost, np.inf)


def _within(problem: Problem, face: Face, x: Array) -> tuple[Array, Array, Array]:
    """Return a basis (M, s, s - c) of the directions along a face, and the normal equations in it."""
    along = tangent_at(problem, face, x)
    with np.errstate(all="ignore"):
        information, vector, _ = marginal(equations_at(problem, x))
    usable: Array = np.asarray(np.isfinite(information).all((-1, -2)) & np.isfinite(vector).all(-1))
    across = np.swapaxes(along, -1, -2)
    information = np.where(usable[:, None, None], information, np.eye(along.shape[-2]))
    vector = np.where(usable[:, None], vector, 0.0)
    return along, across @ information @ along, (across @ vector[..., None])[..., 0]
