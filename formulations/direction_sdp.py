r"""Bearings as unknown unit directions: a semidefinite relaxation, and a lower bound of the angular ML cost.

Station i at :math:`S_i` measured azimuth and elevation, which are a unit vector :math:`u_i` with tangents :math:`a_i`,
:math:`e_i`. The unknowns are the unit directions :math:`v_i` themselves,

.. math:: \min \sum_i q_i(v_i) \quad\text{subject to}\quad |v_i| = 1, \quad v_i^\top [S_j - S_i]_\times v_j = 0,
   \quad (S_j - S_i)^\top (v_i - v_j) \ge 0,

the last two for every pair: two lines of sight lie in one plane, and they do not diverge (without this linear
inequality, rays that meet behind the stations would be accepted). The problem is quadratic in `v`; with :math:`v_i =
F_i^\top (e_1 + \sigma w_i)`, the rows of :math:`F_i` being a reference direction and its tangents, the lift :math:`Y =
(1, w)(1, w)^\top` of size 3N + 1 is relaxed to :math:`Y \succeq 0`.

Positions are no variables, and no linear or convex function of `v` gives a position. So a constraint on the position,
for instance a half-plane, cannot be added here; limits of elevations can. The stations occur only in the directions of
their base lines, so the unit of length has no effect.

*Chordal* (a start without a guess): :math:`q_i = (u_i - v_i)^\top W_i (u_i - v_i)`, :math:`W_i = a_i a_i^\top /
(\sigma_A \cos E)^2 + e_i e_i^\top / \sigma_E^2 + w_r u_i u_i^\top`. Its bound bounds the chordal cost only: on the
sphere :math:`a^\top v = \cos E_v \sin\delta`, so the two costs differ to first order in :math:`\sigma \tan E`.

*Touching* (a proof): :math:`q_i` is a quadratic that nowhere exceeds the squared angle errors and equals them at a
given fix (`minorant`). Its bound is rigorous for the ML cost itself, and equal to it where the
relaxation is tight and the fix is the best point.

Sources: N. Z. Shor, "Quadratic optimization problems", Sov. J. Comput. Syst. Sci. 25 (1987) (the lift); R. Hartley
and A. Zisserman, "Multiple view geometry in computer vision", 2004, section 9 (the equalities).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array
from formulations.bearing_ls import meeting, predict, rays
from formulations.conic import ConicAnswer, Relaxation, keep, rank_ratio, tight

# Least cosine in the weight of an azimuth: within 0.06 degrees of the zenith an azimuth has almost no information.
_LEVEL = 1e-3


@dataclass(frozen=True, slots=True)
class Directed:
    """The result of the relaxation.

    Parameters
    ----------
    point : Array, shape (3,)
        Least-squares intersection of the directions.
    direction : Array, shape (N, 3)
        Unit directions of sight: the last column of the lift, normalised.
    value, bound : float
        Optimum of the relaxation, and its lower bound recomputed from the dual: of the chordal cost
        (`directions`) or of the angular ML cost (`angle_bound`).
    rank_ratio : float
        Second over first eigenvalue of the lift in terms of v; near zero if tight.
    answer : ConicAnswer
        The solver's report.
    """

    point: Array
    direction: Array
    value: float
    bound: float
    rank_ratio: float
    answer: ConicAnswer


def directions(
    angle: ArrayLike,
    sigma: ArrayLike,
    station: ArrayLike,
    *,
    axes: ArrayLike | None = None,
    radial: float = 1.0,
    backend: str = "CLARABEL",
) -> Directed:
    """Return the solution of the chordal relaxation.

    Parameters
    ----------
    angle : array_like, shape (N, 2)
        Azimuth and elevation, radians.
    sigma : array_like, shape (N, 2)
        Standard deviations, positive.
    station : array_like, shape (N, 3)
        Positions, in any unit of length.
    axes : array_like, shape (N, 3, 3), optional
        Rows are the unit vectors of each station's axes.
    radial : float
        Radial weight relative to the smaller tangent weight; it removes the solution v = -u.
    backend : str
        Conic solver.

    Returns
    -------
    Directed
        A start; its bound is not a bound of the ML cost.

    Notes
    -----
    The module's text. Built once per N and back end in each process.
    """
    return _solve(chordal_program(angle, sigma, station, axes=axes, radial=radial), backend)


def angle_bound(
    angle: ArrayLike,
    sigma: ArrayLike,
    station: ArrayLike,
    point: ArrayLike,
    *,
    axes: ArrayLike | None = None,
    backend: str = "CLARABEL",
) -> Directed:
    """Return a lower bound of the ML cost ``sum (angle error / sigma)^2`` over all points, by means of a fix.

    Parameters
    ----------
    angle, sigma, station, axes, backend
        As in `directions`.
    point : array_like, shape (3,)
        A fix. The bound is valid for every point, but reaches its cost only if the point is stationary (a refined fix).

    Returns
    -------
    Directed
        ``bound`` is at most the ML cost of every point, up to rounding.

    Notes
    -----
    The module's text. The proof: points costlier than the fix need no bound; for the others, the minorant, the
    equalities and weak duality.
    """
    z, s = np.asarray(angle, dtype=np.float64), np.asarray(sigma, dtype=np.float64)
    S = np.asarray(station, dtype=np.float64)
    seen = predict(np.asarray(point, dtype=np.float64), S, axes)
    error = seen - z
    error[:, 0] = np.arctan2(np.sin(error[:, 0]), np.cos(error[:, 0]))
    found = minorant(error, s, seen[:, 1], float(((error / s) ** 2).sum()))
    cost = _Cost(float(found.constant.sum()), found.linear, found.square, float((found.reach**2).sum()))
    return _solve(_program(_frames(seen, axes), S, cost), backend)


# Quadratic functions of a unit direction that stay below its squared angle errors and touch them at one direction.


@dataclass(frozen=True, slots=True)
class Minorant:
    """``constant + 2 linear'w + sum square w^2`` for each direction, ``w = (v^, a^, e^)'v - (1, 0, 0)``.

    Parameters
    ----------
    constant : Array, shape (N,)
        Cost of the fix; zero if nothing better than ``f >= 0`` is known.
    linear, square : Array, shape (N, 3)
        Coefficients.
    reach : Array, shape (N,)
        Largest ``|v - v^|`` on the cap.
    """

    constant: Array
    linear: Array
    square: Array
    reach: Array


def minorant(error: Array, sigma: Array, elevation: Array, cost: float) -> Minorant:
    r"""Return, for each direction, a quadratic that nowhere exceeds the squared angle errors and equals them at a fix.

    Parameters
    ----------
    error : Array, shape (N, 2)
        Predicted minus measured azimuth (wrapped) and elevation.
    sigma : Array, shape (N, 2)
        Standard deviations.
    elevation : Array, shape (N,)
        Elevations predicted by the fix.
    cost : float
        Total cost of the fix, the square of rho; the bound is valid for points with at most this cost.

    Returns
    -------
    Minorant
        One quadratic for each direction.

    Notes
    -----
    Let :math:`\hat v` (azimuth :math:`\hat A`, elevation :math:`\hat E`) be the direction that a fix predicts, and `v`
    any direction, with :math:`\eta = A_v - \hat A` and :math:`\epsilon = E_v - \hat E`. The errors of the fix against
    the measured angles are :math:`\hat\delta` and :math:`\hat\varepsilon`, so that the cost of `v` is

    .. math:: f(v) = \frac{(\hat\delta + \eta)^2}{\sigma_A^2} + \frac{(\hat\varepsilon + \epsilon)^2}{\sigma_E^2} .

    In the frame :math:`(\hat v, \hat a, \hat e)` of the fix's direction and tangents, with :math:`c = \cos E_v`,

    .. math:: \hat a^\top v = c \sin\eta, \qquad \hat e^\top v = \sin\epsilon + \sin\hat E \, c \, (1 - \cos\eta),
       \qquad |v - \hat v|^2 = 4 \sin^2\tfrac{\epsilon}{2} + 4 c \cos\hat E \sin^2\tfrac{\eta}{2} .

    On the cap :math:`|\hat\delta + \eta| \le \rho \sigma_A`, :math:`|\hat\varepsilon + \epsilon| \le \rho \sigma_E`
    every remainder of

    .. math:: q(v) = f(\hat v) + \frac{2 \hat\delta \, \hat a^\top v}{\sigma_A^2 \cos\hat E} +
       \frac{2 \hat\varepsilon \, \hat e^\top v}{\sigma_E^2} + w_A (\hat a^\top v)^2 + w_E (\hat e^\top v)^2 +
       w_0 |v - \hat v|^2

    is at most a multiple of :math:`\eta^2` or :math:`\epsilon^2` (from :math:`|x - \sin x| \le |x|^3/6`, :math:`1 -
    \cos x \le x^2/2` and the mean value theorem for cos), and the three weights are :math:`1/\sigma^2` less these
    multiples. Hence :math:`q \le f` on the cap and :math:`q(\hat v) = f(\hat v)`. A point with total cost at most
    :math:`\rho^2` has all its directions in their caps. So over any set that contains the best point, the least sum of
    `q` is at most the least sum of `f`.

    Near the zenith, or with wide caps, a remainder may exceed a weight. Then the quadratic of this direction is zero,
    which is still a minorant. Derived here.
    """
    (dA, dE), (sA, sE), rho = error.T, sigma.T, np.sqrt(cost)
    # the cap: its elevations, the largest cosine and sine among them, and the largest eta and epsilon
    low = np.maximum(elevation - dE - rho * sE, -0.5 * np.pi)
    high = np.minimum(elevation - dE + rho * sE, 0.5 * np.pi)
    own = np.cos(elevation)
    widest = np.where((low <= 0.0) & (high >= 0.0), 1.0, np.maximum(np.cos(low), np.cos(high)))
    steep = np.sin(np.maximum(np.abs(low), np.abs(high)))
    turn = np.minimum(rho * sA, np.pi) + np.abs(dA)
    tilt = np.maximum(high - elevation, elevation - low)
    with np.errstate(all="ignore"):
        # |eta epsilon| is split so that both weights lose the same share
        mixed = np.abs(dA) * steep / (own * sA * sE)
        # 1 / sigma^2 less the remainders
        left_A = 1.0 / sA**2 - mixed * (sE / sA) ** 2 - np.abs(dA) * widest * turn / (3.0 * own * sA**2)
        left_A -= np.maximum(dE * np.sin(elevation), 0.0) * widest / sE**2
        left_E = 1.0 / sE**2 - mixed - np.abs(dE) * tilt / (3.0 * sE**2)
        # (e^'v)^2 <= epsilon^2 + spill eta^2
        spill = widest * steep * tilt + 0.5 * widest**2 * np.minimum(2.0, 0.5 * turn**2)
        # the common part of both tangent weights goes to the chord |v - v^|, the rest of a weight to its tangent
        chord = np.minimum(left_E, left_A / (widest * own))
        rest = left_A - chord * widest * own
        up = np.minimum(left_E - chord, rest / spill)
        across = (rest - up * spill) / widest**2
        square = np.stack([chord, across + chord, up + chord], axis=-1)
        linear = np.stack([np.zeros_like(own), dA / (sA**2 * own), dE / sE**2], axis=-1)
        constant = (dA / sA) ** 2 + (dE / sE) ** 2
        known = (left_A > 0.0) & (left_E > 0.0) & np.isfinite(square).all(axis=-1) & np.isfinite(linear).all(axis=-1)
    return Minorant(
        np.where(known, constant, 0.0),
        np.where(known[:, None], linear, 0.0),
        np.where(known[:, None], square, 0.0),
        np.minimum(np.sqrt(tilt**2 + widest * own * turn**2), 2.0),
    )


# The relaxation.


def direction_problem(count: int) -> Any:
    """Build the relaxation for `count` directions as a cvxpy problem.

    Parameters
    ----------
    count : int
        N, at least two.

    Returns
    -------
    cvxpy.Problem
        Variable ``lift`` of shape (3N + 1, 3N + 1), the one first. Parameters ``linear`` (3N,) and ``square`` (3N,)
        of the cost ``2 linear'w + sum square w^2``; ``unit`` (N,), the scales of the directions; for the P pairs
        ``level`` (P,), ``slope`` (P, 6) and ``turn`` (P, 9) of ``level + slope'(w_i, w_j) + w_i' turn w_j = 0``, and
        ``start`` (P,) and ``order`` (P, 6) of ``start + order'(w_i, w_j) >= 0``.

    Notes
    -----
    Shor (1987).
    """
    import cvxpy as cp

    size, pairs = 3 * count, list(combinations(range(count), 2))
    lift = cp.Variable((size + 1, size + 1), symmetric=True, name="lift")
    linear, square = cp.Parameter(size, name="linear"), cp.Parameter(size, name="square")
    unit, level = cp.Parameter(count, name="unit"), cp.Parameter(len(pairs), name="level")
    slope, turn = cp.Parameter((len(pairs), 6), name="slope"), cp.Parameter((len(pairs), 9), name="turn")
    start, order = cp.Parameter(len(pairs), name="start"), cp.Parameter((len(pairs), 6), name="order")
    # three differences w for each direction, so six numbers and nine products for each pair
    w, diagonal = lift[0, 1:], cp.diag(lift)[1:]
    rules = [lift >> 0, lift[0, 0] == 1]
    rules += [2 * w[3 * i] + unit[i] * cp.sum(diagonal[3 * i : 3 * i + 3]) == 0 for i in range(count)]
    for k, (i, j) in enumerate(pairs):
        block = cp.vec(lift[1 + 3 * i : 4 + 3 * i, 1 + 3 * j : 4 + 3 * j], order="C")
        both = cp.hstack([w[3 * i : 3 * i + 3], w[3 * j : 3 * j + 3]])
        rules.append(level[k] + slope[k] @ both + turn[k] @ block == 0)
        rules.append(start[k] + order[k] @ both >= 0)
    return cp.Problem(cp.Minimize(2 * linear @ w + square @ diagonal), rules)


@keep
def _relaxation(count: int, backend: str) -> Relaxation:
    """Return the relaxation for `count` directions, built once for each size and back end."""
    return Relaxation(direction_problem(count), backend=backend, settings=settings_of(backend))


def settings_of(backend: str = "CLARABEL") -> dict[str, float]:
    """Return the settings of the relaxation for a back end.

    The equalities depend on each other at a solution: with Clarabel's default of 1e-8 one solve in five stops early.
    """
    return tight(backend, 1e-9, static_regularization_constant=1e-7)


@dataclass(frozen=True, slots=True)
class _Cost:
    """A quadratic cost of N directions: ``constant + 2 linear'w + sum square w^2`` with w the change from a reference.

    `linear` and `square` have the shape (N, 3). `reach` is the largest sum of ``|v - v^|^2`` of any relevant point,
    with the reference directions v^.
    """

    constant: float
    linear: Array
    square: Array
    reach: float


def _frames(angle: Array, axes: ArrayLike | None) -> Array:
    """Return the frames (N, 3, 3) of directions `angle` (N, 2), radians.

    The rows are the direction, the tangent of azimuth, and the tangent of elevation.
    """
    seen = rays(angle[:, 0], angle[:, 1], axes)
    assert seen.upward is not None
    return np.stack([seen.ahead, seen.across, seen.upward], axis=1)


@dataclass(frozen=True, slots=True)
class DirectionProgram:
    """The data of the relaxation.

    Parameters
    ----------
    frame : Array, shape (N, 3, 3)
        Reference directions and their tangents, as rows.
    station : Array, shape (N, 3)
        Positions.
    weight : Array, shape (N, 3)
        Quadratic coefficients of the cost in ``w``, the changes from the reference directions.
    unit : float
        Unit of w.
    constant : float
        Constant of the cost.
    values : dict of str to Array
        Parameters of `direction_problem`.
    longest : float
        Greatest length of the lift of any relevant point.
    """

    frame: Array
    station: Array
    weight: Array
    unit: float
    constant: float
    values: dict[str, Array]
    longest: float

    @property
    def change(self) -> tuple[Array, Array]:
        """Return the matrix (3N, 3N) and the vector (3N,) that map w in its unit to the directions."""
        count = len(self.station)
        matrix = np.zeros((3 * count, 3 * count))
        for i in range(count):
            own = slice(3 * i, 3 * i + 3)
            matrix[own, own] = self.unit * self.frame[i].T
        return matrix, self.frame[:, 0].ravel()

    def lift_of_directions(self, lift: Array) -> Array:
        """Return the lift of (1, v) from the lift of (1, w); the rank is evaluated in the directions v."""
        matrix, base = self.change
        whole = np.block([[np.ones((1, 1)), np.zeros((1, len(base)))], [base[:, None], matrix]])
        return np.asarray(whole @ lift @ whole.T)

    def read(self, lift: Array) -> tuple[Array, Array]:
        """Return the intersection (3,) and the unit directions (N, 3) of the first moments of a lift."""
        v = self.lift_of_directions(lift)[1:, 0].reshape(len(self.station), 3)
        v = v / np.linalg.norm(v, axis=1, keepdims=True)
        return meeting(v, self.station), v


def chordal_program(
    angle: ArrayLike, sigma: ArrayLike, station: ArrayLike, *, axes: ArrayLike | None = None, radial: float = 1.0
) -> DirectionProgram:
    """Return the data of the chordal relaxation; arguments as in `directions`."""
    z, s = np.asarray(angle, dtype=np.float64), np.asarray(sigma, dtype=np.float64)
    flat = 1.0 / (s[:, 0] * np.maximum(np.cos(z[:, 1]), _LEVEL)) ** 2
    steep = 1.0 / s[:, 1] ** 2
    square = np.stack([radial * np.minimum(flat, steep), flat, steep], axis=-1)
    cost = _Cost(0.0, np.zeros_like(square), square, 4.0 * len(z))
    return _program(_frames(z, axes), np.asarray(station, dtype=np.float64), cost)


def _program(frame: Array, S: Array, cost: _Cost) -> DirectionProgram:
    """Return the data for a quadratic cost in the frames (N, 3, 3) of reference directions; S (N, 3) are stations."""
    count = len(S)
    # w in units in which the largest tangent weight is one; otherwise the lift of errors of a milliradian would vanish
    size = float(cost.square[:, 1:].max()) or 1.0
    unit = 1.0 / np.sqrt(size)
    pairs = np.array(list(combinations(range(count), 2)))
    base = S[pairs[:, 1]] - S[pairs[:, 0]]
    base = base / np.linalg.norm(base, axis=1, keepdims=True)
    across = np.cross(base[:, None], frame[pairs[:, 1]])
    # for each pair in both frames: the form v_i' [base]x v_j, and the products of the directions with the base line
    turn = np.einsum("pai,pbi->pab", frame[pairs[:, 0]], across)
    near = np.einsum("pai,pi->pa", frame[pairs[:, 0]], base)
    far = np.einsum("pai,pi->pa", frame[pairs[:, 1]], base)
    values = {
        "linear": (cost.linear * unit).ravel(),
        "square": (cost.square * unit**2).ravel(),
        "unit": np.full(count, unit),
        "level": turn[:, 0, 0] / unit,
        "slope": np.concatenate([turn[:, :, 0], turn[:, 0, :]], axis=1),
        "turn": unit * turn.reshape(-1, 9),
        "start": (near[:, 0] - far[:, 0]) / unit,
        "order": np.concatenate([near, -far], axis=1),
    }
    # the last number is |Y| of every relevant point
    return DirectionProgram(frame, S, cost.square, unit, cost.constant, values, 1.0 + cost.reach / unit**2)


def _solve(program: DirectionProgram, backend: str) -> Directed:
    """Return the solution of the relaxation."""
    count, constant = len(program.station), program.constant
    answer = _relaxation(count, backend).solve(program.values, reach=program.longest)
    lift = answer.values["lift"]
    point, v, ratio = np.full(3, np.nan), np.full((count, 3), np.nan), np.nan
    if np.isfinite(lift).all():
        point, v = program.read(lift)
        ratio = rank_ratio(program.lift_of_directions(lift))
    return Directed(point, v, constant + answer.primal, max(constant + answer.bound, 0.0), ratio, answer)
