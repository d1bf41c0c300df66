r"""The choice of sites: optimal experimental design with a proven gap.

Site i adds rows :math:`G_{pi}` to the information at place p,
:math:`M_p(w) = M^0_p + \sum_i w_i G_{pi}^\top G_{pi}` with :math:`w \in \{0, 1\}^n`, and the covariance of the position
there is :math:`P_p = C M_p^{-1} C^\top`, :math:`C = [I\ 0]`. Of

*A* :math:`f_p = \operatorname{tr} P_p`,  *D* :math:`f_p = \log\det P_p`,  *E* :math:`f_p = \lambda_{\max}(P_p)`,

all convex in w, the mean or the maximum over places is minimised under linear rules :math:`R w \le b`. With
:math:`c_i = C M_p^{-1} g_i` every gradient is :math:`-c_i^\top W c_i` with W = I, :math:`P_p^{-1}`, and the projector
on the eigenvector.

*Semidefinite relaxation* (0 <= w <= 1): :math:`\begin{pmatrix} M_p & e \\ e^\top & t \end{pmatrix} \succeq 0` gives
:math:`t \ge e^\top M_p^{-1} e`, and :math:`M_p \succeq C^\top S_p C` gives :math:`P_p \preceq S_p^{-1}`.

*Outer approximation*: tangents :math:`t_p \ge f_p(u) + \nabla f_p(u)^\top (w - u)` are added at every integer point
that a mixed integer programme finds, and half way between this point and the best point. This ends when the dual bound
of the programme reaches the value of the best point.

*Continuous places*: the same criterion over the positions of the sites, each in a convex region, as a nonlinear
programme; a local optimum.

Sources: S. Joshi and S. Boyd, "Sensor selection via convex optimization", IEEE Trans. Signal Process. 57 (2009); F.
Pukelsheim, "Optimal Design of Experiments" (1993); M. A. Duran and I. E. Grossmann, "An outer-approximation algorithm
for a class of mixed-integer nonlinear programs", Math. Program. 36 (1986); W. Ben-Ameur and J. Neto, "Acceleration of
cutting-plane and column generation algorithms: applications to network design", Networks 49 (2007) (in-out).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Any, Literal

import numpy as np

from formulations.algebra import Array
from formulations.backend import SolverError, first_sentence

Criterion = Literal["A", "D", "E"]

# Sharpness of the smooth maximum over positions or failures in the nonlinear programme, which needs derivatives. For
# two equal values the smooth maximum is 7 % too large. The exact criterion evaluates the result.
_SHARP = 10.0
_QUIET: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 200},
}


@dataclass(frozen=True, slots=True)
class Design:
    """The candidate sites and the positions of the target.

    Parameters
    ----------
    rows : Array, shape (P, r, m, n)
        Whitened rows of each site at each place, zero if the site does not measure it; the position is first in m.
    prior : Array, shape (P, m, m)
        Information without any site, positive definite.
    weight : Array, shape (P,)
        Weights of the places, sum 1.
    dimension : int
        Dimension of the position.
    """

    rows: Array
    prior: Array
    weight: Array
    dimension: int


def covariances(design: Design, w: Array) -> Array:
    """Return the covariances (..., P, d, d) of the position at each place, for weights (..., n) of the sites."""
    information = design.prior + np.einsum("prmn,...n,prkn->...pmk", design.rows, np.asarray(w, float), design.rows)
    return np.asarray(np.linalg.inv(information)[..., : design.dimension, : design.dimension])


def of_places(covariance: Array, criterion: Criterion) -> Array:
    """Return the criterion f (...) of covariances (..., d, d) in m^2.

    The unit is m^2 for A and E; D is the logarithm of a determinant.
    """
    if criterion == "A":
        return np.asarray(np.trace(covariance, axis1=-2, axis2=-1))
    if criterion == "D":
        return np.asarray(np.linalg.slogdet(covariance)[1])
    return np.asarray(np.linalg.eigvalsh(covariance)[..., -1])


def value(design: Design, w: Array, criterion: Criterion, *, worst: bool = False, fail: bool = False) -> Array:
    """Return the criterion (...) of weights (..., n): the mean or maximum over places, optionally after a loss.

    The criterion after the worst loss is the maximum of the criterion over all sites that may fail. The failure of a
    site that was not chosen changes nothing.
    """
    w = np.asarray(w, dtype=float)
    if fail:
        lost = w[..., None, :] * (1.0 - np.eye(w.shape[-1]))
        return np.asarray(value(design, lost, criterion, worst=worst).max(-1))
    each = of_places(covariances(design, w), criterion)
    return np.asarray(each.max(-1) if worst else each @ design.weight)


def gradients(design: Design, w: Array, criterion: Criterion) -> tuple[Array, Array]:
    """Return f (P,) and its gradients (P, n) by the weights w (n,); a subgradient for a repeated eigenvalue."""
    information = design.prior + np.einsum("prmn,n,prkn->pmk", design.rows, np.asarray(w, float), design.rows)
    inverse = np.linalg.inv(information)
    d = design.dimension
    covariance = inverse[:, :d, :d]
    # `turn` is the matrix W of the gradient in the text of the module
    c = inverse[:, None, :d] @ design.rows
    if criterion == "A":
        turn = np.broadcast_to(np.eye(d), covariance.shape)
    elif criterion == "D":
        turn = np.linalg.inv(covariance)
    else:
        v = np.linalg.eigh(covariance)[1][..., -1]
        turn = v[..., :, None] * v[..., None, :]
    return of_places(covariance, criterion), -np.einsum("prdn,pde,pren->pn", c, turn, c)


def semidefinite_problem(
    design: Design, rules: Array, limits: Array, criterion: Criterion, *, worst: bool = False
) -> tuple[Any, Any]:
    """Build the semidefinite relaxation as a cvxpy problem.

    Parameters
    ----------
    design : Design
        Sites and places.
    rules, limits : Array, shapes (R, n), (R,)
        rules @ w <= limits.
    criterion, worst
        As in `value`.

    Returns
    -------
    problem : cvxpy.Problem
        Variable ``weights`` (n,) is w.
    each : cvxpy.Expression, shape (P,)
        The criterion at each place.

    Notes
    -----
    Joshi and Boyd (2009); see the text of the module.
    """
    import cvxpy as cp

    places, _, m, n = design.rows.shape
    d, w = design.dimension, cp.Variable(n, name="weights")
    bounds = [w >= 0, w <= 1, rules @ w <= limits]
    parts = []
    for p in range(places):
        sites = np.einsum("rmn,rkn->nmk", design.rows[p], design.rows[p]).reshape(n, -1)
        information = design.prior[p] + cp.reshape(sites.T @ w, (m, m), order="C")
        information = (information + information.T) / 2
        if criterion == "A":
            t = cp.Variable(d)
            for i in range(d):
                unit = np.eye(m)[:, i : i + 1]
                level = cp.reshape(t[i], (1, 1), order="C")
                bounds.append(cp.bmat([[information, unit], [unit.T, level]]) >> 0)
            parts.append(cp.sum(t))
            continue
        pick = np.eye(m)[:, :d]
        if criterion == "D":
            s = cp.Variable((d, d), symmetric=True)
            parts.append(-cp.log_det(s))
            bounds.append(information - pick @ s @ pick.T >> 0)
        else:
            least = cp.Variable()
            parts.append(cp.inv_pos(least))
            bounds.append(information - least * (pick @ pick.T) >> 0)
    each = cp.hstack(parts)
    return cp.Problem(cp.Minimize(cp.max(each) if worst else design.weight @ each), bounds), each


def semidefinite(
    design: Design, rules: Array, limits: Array, criterion: Criterion, *, worst: bool = False
) -> tuple[float, Array]:
    """Return the least value over 0 <= w <= 1, rules @ w <= limits, and w (n,), by Clarabel's interior-point method.

    The value is a lower bound for all sets of sites. The arguments are as in `semidefinite_problem`.

    Raises
    ------
    SolverError
        If the back end has no solution.
    """
    import cvxpy as cp

    problem, _ = semidefinite_problem(design, rules, limits, criterion, worst=worst)
    try:
        problem.solve(solver=cp.CLARABEL)
    except cp.error.SolverError as error:
        raise SolverError(f"Clarabel failed: {first_sentence(error)}") from None
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise SolverError(f"Clarabel ended with {problem.status}")
    return float(problem.value), np.asarray(next(v.value for v in problem.variables() if v.name() == "weights"))


@dataclass(frozen=True, slots=True)
class Outer:
    """The result of outer approximation.

    Parameters
    ----------
    chosen : Array, shape (n,)
        The best set, 0 or 1; NaN if the rules allow no set.
    value, bound : float
        Criterion of this set, and a lower bound for all sets that satisfy the rules.
    rounds : int
        Number of solved mixed integer programmes.
    """

    chosen: Array
    value: float
    bound: float
    rounds: int


def outer_approximation(
    design: Design,
    rules: Array,
    limits: Array,
    criterion: Criterion,
    *,
    worst: bool = False,
    start: Array | None = None,
    close: Callable[[float, float], bool] = lambda bound, best: bound >= best,
    seconds: float = 60.0,
) -> Outer:
    """Return the best set by outer approximation with HiGHS, and its dual bound.

    Parameters
    ----------
    design, rules, limits, criterion, worst
        As in `semidefinite_problem`.
    start : Array, shape (n,), optional
        A set that satisfies the rules.
    close : callable of (bound, value)
        Returns whether the gap is small enough.
    seconds : float
        Time limit: no further round begins after it, and a round ends with it.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp

    places, n = len(design.weight), design.rows.shape[-1]
    begun, best, chosen, bound, rounds = monotonic(), np.inf, np.full(n, np.nan), -np.inf, 0
    # the unknowns are w, then one t for the maximum over places, or one t for each place
    columns = 1 if worst else places
    goal = np.concatenate([np.zeros(n), [1.0] if worst else design.weight])
    cuts: list[Array] = []
    levels: list[Array] = []

    def cut(at: Array) -> None:
        """Add the tangents of the criterion at a point (n,), as rows ``slope w - t <= slope at - f``."""
        f, slope = gradients(design, at, criterion)
        column = np.zeros((places, 1)) if worst else -np.eye(places)
        cuts.append(np.hstack([slope, column - (1.0 if worst else 0.0)]))
        levels.append(slope @ at - f)

    cut(np.full(n, 0.5))
    if start is not None:
        best, chosen = float(value(design, start, criterion, worst=worst)), np.asarray(start, float)
        cut(chosen)
    fixed = LinearConstraint(np.hstack([rules, np.zeros((len(rules), columns))]), -np.inf, limits)
    box = Bounds(np.r_[np.zeros(n), np.full(columns, -np.inf)], np.r_[np.ones(n), np.full(columns, np.inf)])
    whole = np.r_[np.ones(n), np.zeros(columns)]
    # without a set the gap is infinite; a comparison of infinities would be misleading
    while not (np.isfinite(best) and close(bound, best)) and monotonic() - begun < seconds:
        left = max(0.1, seconds - (monotonic() - begun))
        tangents = LinearConstraint(np.vstack(cuts), -np.inf, np.concatenate(levels))
        # Feasibility to 1e-9: a set that violates a tangent by HiGHS's default of 1e-6 would lower the bound.
        found = milp(goal, integrality=whole, bounds=box, constraints=[fixed, tangents], options={"time_limit": left})
        rounds += 1
        if found.status == 2:  # the rules allow no set
            return Outer(chosen, best, np.inf, rounds)
        if found.mip_dual_bound is not None and np.isfinite(found.mip_dual_bound):
            bound = max(bound, float(found.mip_dual_bound))
        if found.x is None:
            break
        point = np.round(found.x[:n])
        reached = float(value(design, point, criterion, worst=worst))
        cut(point)
        if np.isfinite(chosen).all():
            cut(0.5 * (point + chosen))
        if reached < best:
            best, chosen = reached, point
    return Outer(chosen, best, bound, rounds)


@dataclass(frozen=True, slots=True)
class PlacementGround:
    """Height of the ground on a grid, with a cubic spline between the nodes, and constant beyond the outermost nodes.

    Parameters
    ----------
    x, y : Array, shapes (nx,), (ny,)
        Nodes, metres, ascending, at least four.
    height : Array, shape (nx, ny)
        Heights at the nodes, metres.
    """

    x: Array
    y: Array
    height: Array

    def function(self) -> Any:
        """Return the height as a function of CasADi, from plan coordinates (2,), metres, to metres."""
        import casadi as ca

        return ca.interpolant("ground", "bspline", [self.x, self.y], self.height.ravel(order="F"))

    def at(self, points: Array) -> Array:
        """Return the heights (q,), metres, at points (q, 2); points beyond the grid get the height at its edge."""
        spline = self.function()
        low, high = [self.x[0], self.y[0]], [self.x[-1], self.y[-1]]
        return np.array([float(spline(np.clip(point, low, high))) for point in points])


@dataclass(frozen=True, slots=True)
class PlacementRegion:
    """A convex region for sites: edges @ x <= offsets in the plan, and low <= height above ground <= high.

    Parameters
    ----------
    edges, offsets : Array, shapes (e, 2), (e,)
        Half-planes with unit normals.
    low, high : float
        Heights above the ground, or third coordinates without a ground; not used in the plane.
    """

    edges: Array
    offsets: Array
    low: float = 0.0
    high: float = 0.0

    def excess(self, place: Array, ground: PlacementGround | None) -> Array:
        """Return the violation of each rule by a place (d,), metres; no value is positive inside the region."""
        plan = self.edges @ place[:2] - self.offsets
        if len(place) == 2:
            return np.asarray(plan)
        up = place[2] - (0.0 if ground is None else float(ground.at(place[None, :2])[0]))
        return np.concatenate([plan, [self.low - up, up - self.high]])

    def nearest(self, place: Array, ground: PlacementGround | None) -> Array:
        """Return the place (d,) in the region, metres, that is nearest in the plan, at the nearest height."""
        flat = place[:2].copy()
        if (self.edges @ flat > self.offsets).any():
            from scipy.optimize import LinearConstraint, minimize

            inside: Any = LinearConstraint(self.edges, -np.inf, self.offsets)
            away: Any = lambda x: float(((x - place[:2]) ** 2).sum())  # noqa: E731
            flat = minimize(away, flat, constraints=inside, method="SLSQP").x
        if len(place) == 2:
            return np.asarray(flat)
        level = 0.0 if ground is None else float(ground.at(flat[None])[0])
        return np.append(flat, level + np.clip(place[2] - level, self.low, self.high))


def refine(
    information: Callable[[Sequence[Any]], Sequence[Any]],
    start: Array,
    regions: Sequence[PlacementRegion],
    weight: Array,
    dimension: int,
    criterion: Criterion,
    *,
    worst: bool = False,
    fail: bool = False,
    ground: PlacementGround | None = None,
) -> Array:
    """Return positions (k, d) of sites that are locally optimal, by IPOPT from a start (k, d).

    The maximum over places, the maximum over failures and the largest eigenvalue are replaced by smooth functions.

    Parameters
    ----------
    information : callable
        Returns the information matrices (m, m) of all places from a list of k symbols (d, 1), or None for a failed
        site.
    start : Array, shape (k, d)
        Initial positions.
    regions : sequence of k PlacementRegion
        Region of each site.
    weight : Array, shape (P,)
        Weights of the places.
    dimension, criterion, worst, fail
        As in `value`.
    ground : PlacementGround, optional
        Ground below the heights.

    Raises
    ------
    SolverError
        If IPOPT has no solution.
    """
    import casadi as ca

    k, d = start.shape
    symbols = [ca.SX.sym(f"a{i}", d) for i in range(k)]
    sets = [[None if j == i else s for j, s in enumerate(symbols)] for i in range(k)] if fail else [symbols]
    totals = []
    for one in sets:
        each = [_symbolic(ca, matrix, dimension, criterion) for matrix in information(one)]
        totals.append(_soft_maximum(ca, each) if worst else sum(w * f for w, f in zip(weight, each, strict=True)))
    goal = ca.Function("goal", [ca.vertcat(*symbols)], [_soft_maximum(ca, totals) if fail else totals[0]])
    # the ground is a spline, which scalar symbols cannot represent
    x, surface = ca.MX.sym("x", k * d), None if ground is None else ground.function()
    rules = []
    for i, region in enumerate(regions):
        own = x[i * d : (i + 1) * d]
        rules.append(ca.mtimes(ca.DM(region.edges), own[:2]) - ca.DM(region.offsets))
        if d == 3:
            up = own[2] - (0.0 if surface is None else surface(own[:2]))
            rules += [region.low - up, up - region.high]
    program: dict[str, Any] = {"x": x, "f": goal(x), "g": ca.vertcat(*rules)}
    solver = ca.nlpsol("placement", "ipopt", program, _QUIET)
    try:
        found = solver(x0=start.ravel(), ubg=0.0, lbg=-np.inf)
    except RuntimeError as error:
        raise SolverError(str(error)) from None
    return np.asarray(found["x"]).reshape(k, d)


def _symbolic(ca: Any, matrix: Any, d: int, criterion: Criterion) -> Any:
    """Return the criterion of the covariance of a symbolic information matrix; `ca` is the module casadi.

    For E, the result is a root of the trace of a power, which is smooth.
    """
    covariance = ca.inv(matrix)[:d, :d]
    if criterion == "A":
        return ca.trace(covariance)
    if criterion == "D":
        return ca.log(ca.det(covariance))
    product = covariance
    for _ in range(3):  # the eighth power: its trace is at most d times the power of the largest eigenvalue
        product = ca.mtimes(product, product)
    return ca.trace(product) ** 0.125


def _soft_maximum(ca: Any, values: Sequence[Any]) -> Any:
    """Return the log-sum-exp of values in units of the first.

    It exceeds the maximum by at most log(count) / sharpness times the first value.
    """
    size = ca.fabs(values[0]) + 1e-9
    return values[0] + size / _SHARP * ca.log(sum(ca.exp(_SHARP * (v - values[0]) / size) for v in values))
