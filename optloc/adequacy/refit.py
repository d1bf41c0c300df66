"""Plain least squares from where a fix is, or from all around: what other readings of the data are compared by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array
from optloc.compute.sums import equations_at
from optloc.linear.constraints import exact, restore, tangent_at
from optloc.linear.normal import Normal, step
from optloc.problem.problem import Problem

# Marquardt's damping to begin with, and what a step that succeeds, or fails, makes of it.
_DAMPING, _EASED, _RAISED = 1e-3, 0.1, 10.0
# Damping beyond which a step is shorter than rounding.
_STUCK = 1e12
# Relative decrease of the cost that is none: far below what a p-value shows.
_SMALL = 1e-9
# Distances of the starts from the middle of the stations, spreads: inside the network, at its edge, and two outside.
_DISTANCES = (0.4, 1.2, 4.0, 15.0)
# Spreads of the stations beyond which a place is a direction, and differences of ranges begin to be rounding.
_FLAT = 1e6


def descend(problem: Problem, x: Array, steps: int = 30) -> tuple[Array, Array]:
    """Return vectors (M, size) of least squares next to starts, and their costs (M,): damped Gauss-Newton.

    Parameters
    ----------
    problem : Problem
        Flat batch of M problems; equalities are kept, inequalities are not looked at.
    x : array (M, size)
        Starts.
    steps : int
        Greatest number of steps.
    """
    face = exact(problem)
    with np.errstate(all="ignore"):
        x = restore(problem, face, x) if face else np.array(x)
        equations = equations_at(problem, x)
        damping, over = np.full(len(x), _DAMPING), ~np.isfinite(equations.cost)
        for _ in range(steps):
            if over.all():
                break
            move, _ = step(equations, damping, tangent_at(problem, face, x) if face else None)
            trial = np.where(over[:, None] | ~np.isfinite(move), x, x + move)
            trial = restore(problem, face, trial) if face else trial
            new = equations_at(problem, trial)
            better = (new.cost < equations.cost) & ~over
            over = over | (better & (equations.cost - new.cost <= _SMALL * (1.0 + new.cost))) | (damping > _STUCK)
            x = np.where(better[:, None], trial, x)
            equations = _merge(better, new, equations)
            damping = damping * np.where(better, _EASED, _RAISED)
    return x, np.where(np.isfinite(equations.cost), equations.cost, np.inf)


def _merge(where: Array, one: Normal, other: Normal) -> Normal:
    """Return the equations of one where a mask (M,) holds, else of the other."""
    parts = zip(one.parts, other.parts, strict=True)
    return Normal(*(np.where(where.reshape(-1, *(1,) * (a.ndim - 1)), a, b) for a, b in parts))


@dataclass(frozen=True, slots=True)
class Fitted:
    """The best of many descents of a flat batch of N problems.

    Parameters
    ----------
    x : array (N, size)
        Vectors.
    cost : array (N,)
        Their costs; infinite where every descent failed.
    """

    x: Array
    cost: Array


def fit_anywhere(problem: Problem, more: Array | None = None) -> Fitted:
    """Return the best fit of problems of one position by descents from all around the stations.

    Nothing is proven: a search that misses the best place makes an advice be missed, not a wrong one be given.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems that have a position.
    more : array (N, size), optional
        Another start; NaN where there is none.
    """
    n, layout = problem.batch_shape[0], problem.layout
    centre, spread = centre_and_spread(problem.stations.places)
    rays = _directions(problem.dimension)
    away = np.concatenate([np.zeros((1, problem.dimension)), *(distance * rays for distance in _DISTANCES)])
    points = centre[..., None, :] + np.reshape(spread, (-1, 1, 1)) * away
    points = np.broadcast_to(points, (n, *points.shape[-2:]))
    x = np.zeros((n, points.shape[1], layout.size))
    slot, _ = layout.find("position")
    x[..., slot.start : slot.start + slot.size] = points
    if more is not None:
        x = np.concatenate([x, np.where(np.isfinite(more), more, x[:, 0])[:, None]], axis=1)
    many = problem.take(np.repeat(np.arange(n), x.shape[1]))
    found, cost = (part.reshape(*x.shape[:2], -1) for part in descend(many, x.reshape(-1, layout.size)))
    away = found[..., slot.start : slot.start + slot.size] - centre[..., None, :]
    far = np.abs(away).max(-1) > _FLAT * np.reshape(spread, (-1, 1))
    cost = np.where(far, np.inf, cost[..., 0])
    best, rows = cost.argmin(1), np.arange(n)
    return Fitted(found[rows, best], cost[rows, best])


def _directions(d: int) -> Array:
    """Return unit vectors (q, d): every 45 degrees of the plane; in space axes and corners of a cube."""
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * d), axis=-1).reshape(-1, d)
    kept = grid[np.isin(np.abs(grid).sum(-1), (1, d))]
    return np.asarray(kept / np.sqrt((kept**2).sum(-1, keepdims=True)))


def one_place(problem: Problem) -> bool:
    """Return whether the unknowns of a problem are one position of one epoch and what goes with it."""
    return problem.epochs == 1 and any(slot.name == "position" for slot in problem.layout.shared)
