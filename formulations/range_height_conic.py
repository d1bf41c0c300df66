r"""Semidefinite relaxation of the fix on an ellipsoid from ranges known up to one unknown.

.. math:: \min_{t, \mu} \; |x(t, \mu) - \bar x|^2 + (r_1(t) - |\bar x - s_1|)^2 \quad\text{subject to}\quad
   \mu^2 = q(t), \quad E(t) + L(t)\,\mu + \alpha\,\mu^2 = 0

with :math:`x = b + p\,t + n\,\mu` (:mod:`formulations.range_height`): the range equations are eliminated *before*
lifting :math:`(1, t, \mu)` to a 3 by 3 matrix. The system is square, its points are isolated and the least-squares cost
is zero at all of them, so the objective is a choice: :math:`\bar x` is a point near the target (the one below the
satellites). Its second term puts the mirror point of negative range at a distance; without it the relaxation mixes the
two. The full lift of (x, r) is never tight here. A range guess that is wrong by a factor of two loses exactness.

Source: N. Z. Shor, "Quadratic optimization problems", Sov. J. Comput. Syst. Sci. 25 (1987); elimination before
lifting is facial reduction: D. Drusvyatskiy and H. Wolkowicz, "The many faces of degeneracy in conic optimization",
Found. Trends Optim. 3 (2017).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.algebra import Array
from formulations.conic import ConicAnswer, Relaxation, keep, rank_ratio, tight
from formulations.range_height import Ellipsoid, HeightCurve, three_stations
from formulations.solver_report import SolverReport


@dataclass(frozen=True, slots=True)
class LiftedHeights:
    """A lifted fix.

    Parameters
    ----------
    x : Array, shape (3,)
        Point read off the lift; on the ellipsoid only if tight. NaN if the solver gave none.
    ranges : Array, shape (3,)
        Ranges read off the lift.
    bound : float
        Lower bound of the objective over all points that fit, recomputed from the dual. It bounds no likelihood.
    rank_ratio : float
        Second over first eigenvalue of the lift; near zero means exact.
    answer : ConicAnswer
        The solver's report.
    """

    x: Array
    ranges: Array
    bound: float
    rank_ratio: float
    answer: ConicAnswer


def lifted_problem() -> Any:
    """Build the relaxation as a cvxpy problem.

    Returns
    -------
    cvxpy.Problem
        Parameters ``objective``, ``curve``, ``surface``, symmetric matrices of shape (3, 3); variable ``lift``.

    Notes
    -----
    Shor (1987).
    """
    import cvxpy as cp

    objective, curve, surface = (cp.Parameter((3, 3), name=name) for name in ("objective", "curve", "surface"))
    lift = cp.Variable((3, 3), symmetric=True, name="lift")
    zero = [cp.sum(cp.multiply(form, lift)) == 0 for form in (curve, surface)]
    return cp.Problem(cp.Minimize(cp.sum(cp.multiply(objective, lift))), [lift >> 0, lift[0, 0] == 1, *zero])


@keep
def _relaxation(backend: str) -> Relaxation:
    """Return the relaxation, built once for each back end."""
    return Relaxation(lifted_problem(), backend=backend, settings=settings_of(backend))


def settings_of(backend: str = "CLARABEL") -> dict[str, float]:
    """Return the settings of the relaxation for a back end.

    The tolerance is a tenth of a millimetre in Earth radii, which a matrix of size three allows.
    """
    return tight(backend, 1e-11)


@dataclass(frozen=True, slots=True)
class HeightProgram:
    """The data of the relaxation.

    Parameters
    ----------
    curve : HeightCurve
        The points that fit the ranges.
    change : Array, shape (3, 3)
        Map from the scaled variables of the lift to (1, t, mu).
    values : dict of str to Array
        Parameters of `lifted_problem`.
    size : float
        The squared distance is `size` times the objective.
    longest : float
        Greatest length of the lift of any point of the ellipsoid.
    """

    curve: HeightCurve
    change: Array
    values: dict[str, Array]
    size: float
    longest: float

    @property
    def places(self) -> Array:
        """Return the matrix (3, 3) that maps the first column of the lift to the position."""
        return np.stack([self.curve.base[0], self.curve.along[0], self.curve.across[0]], axis=1) @ self.change


def height_program(
    stations: Array, sign: Array, offset: Array, surface: Ellipsoid, near: Array
) -> HeightProgram | None:
    """Return the data of the relaxation, or None if the ranges give no curve; arguments as in `lift`."""
    curve = three_stations(stations[None], np.asarray(sign, dtype=np.float64)[None], offset[None])
    guess = float(np.linalg.norm(near - stations[0]))
    forms, change = _forms(curve, surface, near, guess)
    if not (curve.ok[0] and all(np.isfinite(form).all() for form in forms.values())):
        return None
    # each form is divided by its largest entry, which an equality allows; the bound is multiplied by it again
    scale = float(np.abs(forms["objective"]).max())
    data = {name: form / np.abs(form).max() for name, form in forms.items()}
    return HeightProgram(curve, change, data, scale, _reach(curve, stations[0], surface, guess))


def lift(
    stations: Array, sign: Array, offset: Array, surface: Ellipsoid, near: Array, *, backend: str = "CLARABEL"
) -> LiftedHeights:
    """Return the fix on the ellipsoid from the relaxation.

    Parameters
    ----------
    stations : Array, shape (3, 3)
        Positions as rows, numbers of order one (Earth radii).
    sign, offset : Array, shape (3,)
        Ranges ``sign tau + offset``, signs 1 or -1.
    surface : Ellipsoid
        Shape (3, 3) and centre (3,).
    near : Array, shape (3,)
        A point near the fix.
    backend : str
        Conic solver.

    Returns
    -------
    LiftedHeights
        The fix if `rank_ratio` is small. The problem is built once per back end in each process.

    Notes
    -----
    Shor (1987) after the elimination of the ranges.
    """
    program = height_program(stations, sign, offset, surface, near)
    if program is None:
        status = "not formulated"
        nothing = ConicAnswer({}, np.nan, -np.inf, status, False, 0, SolverReport(backend, status))
        return LiftedHeights(np.full(3, np.nan), np.full(3, np.nan), -np.inf, np.nan, nothing)
    answer = _relaxation(backend).solve(program.values, reach=program.longest)
    lift, curve = answer.values["lift"], program.curve
    _, t, mu = program.change @ lift[:, 0]
    x = curve.points(np.array([[t]]), np.array([[mu]]))[0, 0]
    return LiftedHeights(x, curve.rate[0] * t + curve.offset[0], answer.bound * program.size, rank_ratio(lift), answer)


def _forms(curve: HeightCurve, surface: Ellipsoid, near: Array, guess: float) -> tuple[dict[str, Array], Array]:
    """Return the quadratic forms (3, 3) by name, and the map from scaled variables to (1, t, mu).

    The scaled variables are relative to `guess`, the expected range r_1, and in its unit. `near` (3,) is the point of
    the objective.
    """
    E, L, alpha = (v[0] for v in curve.on_ellipsoid(surface.shape[None], surface.centre[None]))
    q, rate, offset = curve.square[0], curve.rate[0, 0], curve.offset[0, 0]
    on_surface = 0.5 * np.array([[2.0 * E[0], E[1], L[0]], [E[1], 2.0 * E[2], L[1]], [L[0], L[1], 2.0 * alpha]])
    on_curve = -0.5 * np.array([[2.0 * q[0], q[1], 0.0], [q[1], 2.0 * q[2], 0.0], [0.0, 0.0, -2.0]])
    away = np.stack([curve.base[0] - near, curve.along[0], curve.across[0]], axis=1)
    late = np.array([offset - guess, rate, 0.0])
    # t = (guess / rate) u + (guess - offset) / rate: u is zero where r_1 is the guess, and of order one elsewhere
    change = np.diag([1.0, guess / rate, guess])
    change[1, 0] = (guess - offset) / rate
    forms = {"objective": away.T @ away + np.outer(late, late), "curve": on_curve, "surface": on_surface}
    return {name: change.T @ form @ change for name, form in forms.items()}, change


def _reach(curve: HeightCurve, station: Array, surface: Ellipsoid, guess: float) -> float:
    """Return the greatest length of the lift of any point of the ellipsoid, which makes the bound rigorous.

    `guess` is the expected range, the unit of the lift. `station` (3,) is the first station.
    """
    size = 1.0 / float(np.sqrt(np.linalg.eigvalsh(surface.shape)[0]))
    t = (float(np.linalg.norm(station - surface.centre)) + size) / guess + 1.0
    mu = (abs(float(curve.across[0] @ (surface.centre - curve.base[0]))) + size) / guess
    return 1.0 + t * t + mu * mu
