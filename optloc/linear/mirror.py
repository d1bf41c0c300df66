"""Mirror images of a position in the plane of the stations, and steps for targets near this plane.

If all stations are in a plane, ranges depend only on the square of the target's distance w from the plane. On the plane
the derivatives by w vanish, so Gauss-Newton steps in w do not converge. Steps in q = w^2 converge, and a minimum on the
plane is a minimum at the bound q = 0.

Letters: N or M problems, s stations, m rows, d coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array
from optloc.linear.normal import Normal, step
from optloc.models import MODELS
from optloc.problem.problem import Problem


def one_position(problem: Problem) -> bool:
    """Return whether the only unknown state is one position.

    This is the case for a single unknown target, if it and the stations are at rest, or if there is only one epoch.
    """
    if len(problem.motions) != 1 or problem.motions[0].known is not None or problem.motions[0].span == "epoch":
        return False
    still = problem.stations.position.shape[-3] == 1 and problem.motions[0].order == 0
    return still or problem.epochs == 1


def is_of_ranges(kind: str) -> bool:
    """Return whether the formula of a kind is a sum or a ratio of ranges."""
    model = MODELS[kind]
    return model.ranges is not None or (model.lifted is not None and not model.axes)


def rows_of_stations(problem: Problem) -> Array:
    """Return the mask (s, m): True if a row measures with a station."""
    every, parts = np.arange(problem.stations.count)[:, None], []
    for rows in problem.rows:
        taken = MODELS[rows.kind].stations
        parts.append(((rows.a == every) & (taken > 0)) | ((rows.b == every) & (taken > 1)))
    return np.concatenate(parts, axis=1)


def mirror(problem: Problem, position: Array) -> Array:
    """Return points (N, ..., d), metres, mirrored in the plane (or line) that fits the stations best."""
    centre, axes, _, _ = plane_of_stations(problem)
    # eigenvalues are ascending, so the stations spread least along the first vector
    normal = axes[..., :, 0]
    shape = (-1, *(1,) * (position.ndim - 2), position.shape[-1])
    across, middle = normal.reshape(shape), centre.reshape(shape)
    return np.asarray(position - 2.0 * ((position - middle) * across).sum(-1, keepdims=True) * across)


def plane_of_stations(problem: Problem) -> tuple[Array, Array, Array, Array]:
    """Return the plane (or line) that fits the stations of each problem best.

    Stations at rest are used if a row of them is present; moving stations are always used.

    Returns
    -------
    centre : array (N or 1, d)
        Mean of the stations, metres.
    axes : array (N or 1, d, d)
        Unit vectors, in columns: first the normal, last the axis along which the stations spread most.
    off, size : array (N or 1,)
        Greatest distances of a station from the plane and from the centre, metres.
    """
    places = problem.stations.places
    flat = places if places.ndim == 3 else places[None]
    share = np.ones((1, flat.shape[-2], 1))
    if problem.stations.position.shape[-3] == 1:
        share = ((problem.weight > 0.0).astype(float) @ rows_of_stations(problem).T > 0.0).astype(float)[..., None]
    centre = (share * flat).sum(-2, keepdims=True) / np.maximum(share.sum(-2, keepdims=True), 1.0)
    away = share * (flat - centre)
    _, axes = np.linalg.eigh(np.swapaxes(flat - centre, -1, -2) @ away)
    off, size = np.abs(away @ axes[..., :, :1])[..., 0].max(-1), np.sqrt((away**2).sum(-1)).max(-1)
    return centre[..., 0, :], axes, off, size


# Steps in the square of the distance from the plane.


@dataclass(frozen=True, slots=True)
class Folded:
    """Steps of M problems whose target has a mirror image in a plane.

    Parameters
    ----------
    column : int
        Column of the distance from the plane in the shared unknowns.
    least : array (M,)
        Distance that counts as zero, metres: its square is so small that it changes no range.
    held : bool
        Whether the target stays on the plane.
    """

    column: int
    least: Array
    held: bool = False

    def take(self, items: Array) -> Folded:
        """Return the steps of the selected problems."""
        return replace(self, least=self.least[items])

    def step(self, equations: Normal, damping: Array, x: Array) -> tuple[Array, Array]:
        """Return the damped steps (M, size), and whether they exist (M,); no step from the plane crosses it.

        A Gauss-Newton step in q is a step in w to first order, ``dq = 2 w dw``; `retract` converts it to a step in q.
        """
        at = x[:, self.column] <= self.least
        stays = at & (self.held | (equations.shared_vector[:, self.column] <= 0.0))
        return step(_without(equations, self.column, stays), damping)

    def retract(self, x: Array, move: Array) -> Array:
        """Return the vectors (M, size) after steps (M, size): w moves by a step of q = w^2, kept positive."""
        out, w = x + move, x[:, self.column]
        square = w * w + 2.0 * w * move[:, self.column]
        out[:, self.column] = np.sqrt(np.maximum(square, self.least**2))
        return out


def _without(equations: Normal, column: int, items: Array) -> Normal:
    """Return normal equations in which the shared unknown `column` of the selected problems does not move.

    `items` (M,) is the mask of these problems.
    """
    if not items.any():
        return equations
    shared, cross, vector = (np.array(part) for part in (equations.shared, equations.cross, equations.shared_vector))
    own = shared[items, column, column]
    shared[items, column], shared[items, :, column] = 0.0, 0.0
    # Any pivot is valid, because all other entries of its row are zero.
    shared[items, column, column] = np.where(own > 0.0, own, 1.0)
    cross[items, :, column], vector[items, column] = 0.0, 0.0
    return replace(equations, shared=shared, cross=cross, shared_vector=vector)
