r"""Bearings with bounded errors: cones, their common points, and the fix whose worst angle is least.

The angle between p - S_i and the measured unit direction :math:`u_i` is at most :math:`\theta_i < \pi/2` exactly if

.. math:: |T_i (p - S_i)| \le \tan(\theta_i) \, u_i^\top (p - S_i), \qquad T_i^\top T_i = I - u_i u_i^\top,

a second-order cone that no point behind the station satisfies. A ball of radius r about p is inside this cone exactly
if :math:`|T_i (p - S_i)| + r / \cos\theta_i \le \tan(\theta_i) u_i^\top (p - S_i)`, so one problem,

.. math:: \max_{p,\, r \le 1} \; r \quad\text{subject to these N cones},

decides whether the cones meet (:math:`r \ge 0`). If they meet, it gives the centre of the largest inscribed ball.
Otherwise its dual gives multipliers that prove that the cones do not meet. With :math:`\theta_i = t \sigma_i` the set
grows with t (the worst scaled angle is quasi-convex). Bisection on t, accelerated by the attained angles, finds the
global minimax fix.

Sources: M. S. Lobo, L. Vandenberghe, S. Boyd and H. Lebret, "Applications of second-order cone programming", Linear
Algebra Appl. 284 (1998); F. Kahl and R. Hartley, "Multiple-view geometry under the L-infinity norm", IEEE Trans.
Pattern Anal. Mach. Intell. 30 (2008).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array
from formulations.conic import ConicAnswer, Relaxation, keep, tight
from formulations.unit_scale import PointScale

# Largest half-angle of a cone, radians: at pi/2 the cone is a half-space; here its tangent is 100.
_WIDEST = 0.5 * np.pi - 0.01
_RADIUS = 1e3  # radius of the region of a proof of emptiness, in extents of the stations about their mean
_EXACT = 1e-6  # level, in the caller's sigma, that counts as zero, since bisection would halve it forever
# statuses of infeasible problems in Clarabel, and in cvxpy for all others; in lower case
_SOLVED = ("solved", "almostsolved", "optimal", "optimal_inaccurate")
_UNBOUNDED = ("dualinfeasible", "almostdualinfeasible", "unbounded", "unbounded_inaccurate")


@dataclass(frozen=True, slots=True)
class Common:
    """The common points of cones.

    Parameters
    ----------
    point : Array, shape (d,)
        Centre of the largest ball inside all cones, of a radius of at most about one extent of the stations; if they do
        not meet, the point that violates them least.
    margin : float
        Radius of this ball. If the cones do not meet, minus the largest violation, which is similar to a distance.
    most : float
        Upper bound of the margin, recomputed from the dual, over points within `_RADIUS` of the stations.
    meet : bool or None
        True if a check shows that `point` is in every cone; False if `most` is negative, which proves that no point is;
        None if neither could be shown.
    answer : ConicAnswer
        The solver's report.
    """

    point: Array
    margin: float
    most: float
    meet: bool | None
    answer: ConicAnswer


@dataclass(frozen=True, slots=True)
class Minimax:
    """The fix whose worst scaled angle is least.

    Parameters
    ----------
    point : Array, shape (d,)
        The fix; NaN if no point is in front of all stations.
    level : float
        Its worst ``angle_i / sigma_i``.
    least : float
        Proven lower bound: no point within `_WIDEST` of every bearing has a smaller level.
    meet : bool or None
        As in `Common`, at the widest level.
    solves : int
        Number of solved cone programs.
    """

    point: Array
    level: float
    least: float
    meet: bool | None
    solves: int


def common(direction: ArrayLike, station: ArrayLike, bound: ArrayLike, *, backend: str = "CLARABEL") -> Common:
    """Return whether the cones meet, and the centre of their common points.

    Parameters
    ----------
    direction : array_like, shape (N, d)
        Measured unit directions.
    station : array_like, shape (N, d)
        Positions, in any unit of length.
    bound : array_like, shape (N,)
        Largest possible angle to the true direction, radians, positive and below pi/2; an infinite value drops a cone.
    backend : str
        Conic solver; only Clarabel gives proofs.

    Returns
    -------
    Common
        Verdict, centre and margin.

    Notes
    -----
    See the text of the module.
    """
    u, S, theta = (np.asarray(part, dtype=np.float64) for part in (direction, station, bound))
    relaxation, own = _relaxation("ball", u.shape[0], u.shape[1], backend), _scale_of(S, theta)
    answer = relaxation.solve(_cone_data(u, own.scaled(S), theta, ball=True))
    # the program minimises minus the radius
    point, margin, most = own.back(answer.values["point"]), -answer.primal * own.unit, -answer.bound * own.unit
    inside = bool((angles(point, u, S) <= theta).all())
    meet = True if inside else (False if most < 0.0 else None)
    return Common(point, margin, most, meet, answer)


def extent(
    direction: ArrayLike, station: ArrayLike, bound: ArrayLike, towards: ArrayLike, *, backend: str = "CLARABEL"
) -> Array:
    """Return the extent of the common points of the cones in given directions.

    Parameters
    ----------
    direction, station, bound, backend
        As in `common`.
    towards : array_like, shape (K, d)
        Directions.

    Returns
    -------
    Array, shape (K,)
        Upper bounds of ``towards'p`` over the set, recomputed from the dual and attained up to the solver's accuracy;
        infinite if the set is not bounded, NaN if it is empty or the solver failed.

    Notes
    -----
    Lobo et al. (1998).
    """
    u, S, theta = (np.asarray(part, dtype=np.float64) for part in (direction, station, bound))
    relaxation, own = _relaxation("edge", u.shape[0], u.shape[1], backend), _scale_of(S, theta)
    data = _cone_data(u, own.scaled(S), theta, ball=False)
    out = []
    for line in np.asarray(towards, dtype=np.float64):
        answer = relaxation.solve({**data, "towards": -line})
        if answer.status.lower() in _UNBOUNDED:
            out.append(np.inf)
        else:
            known = answer.status.lower() in _SOLVED
            most = (-answer.bound if np.isfinite(answer.bound) else -answer.primal) if known else np.nan
            out.append(float(line @ own.origin) + own.unit * most)
    return np.array(out)


def minimax(
    direction: ArrayLike,
    station: ArrayLike,
    sigma: ArrayLike,
    *,
    tolerance: float = 1e-4,
    most: int = 60,
    backend: str = "CLARABEL",
) -> Minimax:
    """Return the point whose largest scaled angle to the bearings is least, over all points.

    Parameters
    ----------
    direction, station, backend
        As in `common`.
    sigma : array_like, shape (N,)
        Scale of each angle, radians; an infinite value drops a bearing.
    tolerance : float
        Relative width of the final bracket, far below the accuracy of error bounds.
    most : int
        Greatest number of cone programs; bisection to 1e-4 takes about 14.

    Returns
    -------
    Minimax
        Fix, level, and proven lower bound of the level.

    Notes
    -----
    Kahl and Hartley (2008), bisection; the lower end of the bracket is raised only by a proof.
    """
    u, S, scale = (np.asarray(part, dtype=np.float64) for part in (direction, station, sigma))
    # the widest cones first: if they do not meet, no point is in front of all stations
    level, low = _WIDEST / float(scale[np.isfinite(scale)].min()), 0.0
    found = _common_at_level(u, S, scale, level, backend)
    if not found.meet:
        nowhere = level if found.meet is False else 0.0
        return Minimax(np.full(u.shape[1], np.nan), np.inf, nowhere, found.meet, 1)
    point, solves = found.point, 1
    level = float((angles(point, u, S) / scale).max())
    while level - low > tolerance * level and level > _EXACT and solves < most:
        middle = 0.5 * (low + level)
        found, solves = _common_at_level(u, S, scale, middle, backend), solves + 1
        if found.meet:
            # the angles at the found point are below the requested level: faster than bisection alone
            point, level = found.point, float((angles(found.point, u, S) / scale).max())
        elif found.meet is False:
            low = middle
        else:
            break
    return Minimax(point, level, low, True, solves)


def angles(point: Array, direction: Array, station: Array) -> Array:
    """Return the angles between measured directions and a point.

    Parameters
    ----------
    point : Array, shape (d,)
        Target.
    direction, station : Array, shape (N, d)
        Unit vectors and positions.

    Returns
    -------
    Array, shape (N,)
        Radians, from 0 to pi.

    Notes
    -----
    W. Kahan's form: accurate for small and for nearly opposite directions.
    """
    line = point - station
    line = line / np.linalg.norm(line, axis=1, keepdims=True)
    away, along = np.linalg.norm(line - direction, axis=1), np.linalg.norm(line + direction, axis=1)
    return np.asarray(2.0 * np.arctan2(away, along))


def _common_at_level(u: Array, S: Array, scale: Array, level: float, backend: str) -> Common:
    """Return the common points of cones whose half-angles are `level` times `scale` (N,), at most `_WIDEST`."""
    return common(u, S, _half_angles(scale, level), backend=backend)


def _half_angles(scale: Array, level: float) -> Array:
    """Return half-angles (N,) that are `level` times `scale` (N,), at most `_WIDEST`; infinite for a dropped cone."""
    return np.where(np.isfinite(scale), np.minimum(level * scale, _WIDEST), np.inf)


def _scale_of(S: Array, theta: Array) -> PointScale:
    """Return origin and unit of the stations S (N, d) whose angle bound `theta` (N,) is finite."""
    held = np.isfinite(theta)
    return PointScale.of(S[held] if held.any() else S)


# The cone programs and their parameters.


@keep
def _relaxation(kind: str, count: int, dim: int, backend: str) -> Relaxation:
    """Return the cone program "ball" or "edge" for `count` cones in `dim` dimensions, built once for each back end."""
    settings = settings_of(backend)
    if kind == "edge":
        return Relaxation(edge_problem(count, dim), backend=backend, settings=settings)
    # (p, 0) is feasible for every common point p, so emptiness is proven for all p with |p| <= radius (1 + ..)
    return Relaxation(ball_problem(count, dim), backend=backend, settings=settings, radius=_RADIUS)


def settings_of(backend: str = "CLARABEL") -> dict[str, float]:
    """Return the settings of the cone programs for a back end.

    The sign of a margin is a proof, so the tolerance is two decades below the default of Clarabel.
    """
    return tight(backend, 1e-10)


def ball_data(direction: Array, station: Array, scale: Array, level: float) -> dict[str, Array]:
    """Return the parameters of `ball_problem` for cones whose half-angles are a multiple of their scales.

    Parameters
    ----------
    direction, station : Array, shape (N, d)
        Unit directions and positions.
    scale : Array, shape (N,)
        Scale of each angle, radians; an infinite value drops a cone.
    level : float
        The multiple.
    """
    return _cone_data(direction, station, _half_angles(scale, level), ball=True)


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
    """Return the constraints of the cones, with new parameters.

    If `radius` is not None, a ball of this radius about the point must be inside the cones.
    """
    import cvxpy as cp

    rows = dim - 1
    side, at = cp.Parameter((count * rows, dim), name="side"), cp.Parameter(count * rows, name="side_at")
    slope, from_ = cp.Parameter((count, dim), name="slope"), cp.Parameter(count, name="slope_at")
    off, reach = side @ point - at, slope @ point - from_
    if radius is not None:
        reach = reach - cp.Parameter(count, name="widen") * radius
    return [cp.SOC(reach[i], off[i * rows : (i + 1) * rows]) for i in range(count)]


def _cone_data(u: Array, S: Array, theta: Array, *, ball: bool) -> dict[str, Array]:
    """Return the parameters of both problems at half-angles `theta` (N,) below pi/2; an infinite angle drops its cone.

    `u` (N, d) are the measured directions, `S` (N, d) the stations. `ball` is True for the problem with a ball. Each
    cone is multiplied by the cosine of its half-angle, so that wide cones have small numbers.
    """
    _count, dim = u.shape
    held = np.isfinite(theta)
    half = np.where(held, theta, 0.0)
    # the complement of u: the last left singular vectors of a column
    side = np.linalg.svd(u[:, :, None])[0][:, :, 1:].transpose(0, 2, 1)
    side = np.where(held[:, None, None], np.cos(half)[:, None, None] * side, 0.0)
    slope = np.where(held, np.sin(half), 0.0)[:, None] * u
    at = (slope * S).sum(axis=1)
    data = {
        "side": side.reshape(-1, dim),
        "side_at": np.einsum("nrd,nd->nr", side, S).ravel(),
        "slope": slope,
        "slope_at": np.where(held, at, -1.0),
    }
    return {**data, "widen": np.where(held, 1.0, 0.0)} if ball else data
