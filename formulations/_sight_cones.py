"""The cone programs of bearings with bounded errors, as cvxpy problems and as their parameters.

Source: M. S. Lobo, L. Vandenberghe, S. Boyd and H. Lebret, "Applications of second-order cone programming", Linear
Algebra Appl. 284 (1998).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def ball_problem(count: int, dim: int) -> Any:
    """Build the largest common ball of cones as a cvxpy problem.

    Parameters
    ----------
    count, dim : int
        N cones in d dimensions.

    Returns
    -------
    cvxpy.Problem
        Variables ``point`` (d,) and ``radius``; parameters ``side`` (N (d - 1), d) and ``side_at`` (N (d - 1),): rows
        of T and their products with S; ``slope`` (N, d) and ``slope_at`` (N,): tan(theta) u and its product with S;
        ``widen`` (N,): 1 / cos(theta). A cone may be multiplied by a factor; rows of zeros with ``slope_at`` negative
        drop one.

    Notes
    -----
    Lobo et al. (1998).
    """
    import cvxpy as cp

    point, radius = cp.Variable(dim, name="point"), cp.Variable(name="radius")
    return cp.Problem(cp.Minimize(-radius), [*_cones(point, radius, count, dim), radius <= 1.0])


def edge_problem(count: int, dim: int) -> Any:
    """Build the farthest common point of cones in a direction as a cvxpy problem.

    Parameters
    ----------
    count, dim : int
        N cones in d dimensions.

    Returns
    -------
    cvxpy.Problem
        Variable ``point`` minimising ``towards'point``; parameters as in `ball_problem`, without ``widen``.

    Notes
    -----
    Lobo et al. (1998).
    """
    import cvxpy as cp

    point, towards = cp.Variable(dim, name="point"), cp.Parameter(dim, name="towards")
    return cp.Problem(cp.Minimize(towards @ point), _cones(point, None, count, dim))


def _cones(point: Any, radius: Any, count: int, dim: int) -> list[Any]:
    import cvxpy as cp

    rows = dim - 1
    side, at = cp.Parameter((count * rows, dim), name="side"), cp.Parameter(count * rows, name="side_at")
    slope, from_ = cp.Parameter((count, dim), name="slope"), cp.Parameter(count, name="slope_at")
    off, reach = side @ point - at, slope @ point - from_
    if radius is not None:
        reach = reach - cp.Parameter(count, name="widen") * radius
    return [cp.SOC(reach[i], off[i * rows : (i + 1) * rows]) for i in range(count)]


def cone_data(u: Array, S: Array, theta: Array, *, ball: bool) -> dict[str, Array]:
    """Return the parameters of the two problems.

    Parameters
    ----------
    u, S : Array, shape (N, d)
        Unit directions and stations.
    theta : Array, shape (N,)
        Half-angles below pi/2; infinite drops a cone.
    ball : bool
        For `ball_problem` (True) or `edge_problem`.

    Returns
    -------
    dict of Arrays
        By the parameters' names; each cone is multiplied by its cosine, so that wide ones keep small numbers.

    Notes
    -----
    See :mod:`formulations.minimax_cone`.
    """
    _count, dim = u.shape
    kept = np.isfinite(theta)
    half = np.where(kept, theta, 0.0)
    # the complement of u: the last left singular vectors of a column
    side = np.linalg.svd(u[:, :, None])[0][:, :, 1:].transpose(0, 2, 1)
    side = np.where(kept[:, None, None], np.cos(half)[:, None, None] * side, 0.0)
    slope = np.where(kept, np.sin(half), 0.0)[:, None] * u
    at = (slope * S).sum(axis=1)
    data = {
        "side": side.reshape(-1, dim),
        "side_at": np.einsum("nrd,nd->nr", side, S).ravel(),
        "slope": slope,
        "slope_at": np.where(kept, at, -1.0),
    }
    return {**data, "widen": np.where(kept, 1.0, 0.0)} if ball else data
