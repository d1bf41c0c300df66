"""Methods of the table: general solvers, written as a user of each would write them."""

from __future__ import annotations

from typing import Any

import numpy as np
from benchmarks.scenes import Scene
from benchmarks.worker import each

Array = np.ndarray
STEPS = 6


def scipy_from_the_truth(scene: Scene) -> Any:
    """Levenberg-Marquardt of SciPy, exact derivatives, started at the truth; the covariance is part of the fix."""
    from scipy.optimize import least_squares

    white = scene.white

    def fix(i: int) -> Array:
        places, z = scene.stations[i], scene.z[i]

        def residual(x: Array) -> Array:
            r = np.sqrt(((x - places) ** 2).sum(1))
            return white @ (r[1:] - r[0] - z)

        def jacobian(x: Array) -> Array:
            apart = x - places
            unit = apart / np.sqrt((apart**2).sum(1))[:, None]
            return white @ (unit[1:] - unit[0])

        found = least_squares(residual, scene.truth[i], jac=jacobian, method="lm", x_scale="jac")
        np.linalg.inv(found.jac.T @ found.jac)
        return found.x

    return each(scene, fix)


def casadi_mapped(scene: Scene) -> Any:
    """Fixed Gauss-Newton steps from the truth as one CasADi function, mapped over the batch."""
    import casadi as ca

    s = scene.stations.shape[1]
    x, places, z = ca.SX.sym("x", 3), ca.SX.sym("s", 3, s), ca.SX.sym("z", s - 1)
    white = ca.SX(ca.DM(scene.white))
    ranges = [ca.norm_2(x - places[:, i]) for i in range(s)]
    residual = white @ (z - ca.vertcat(*(r - ranges[0] for r in ranges[1:])))
    slope = -ca.jacobian(residual, x)
    normal, right = slope.T @ slope, slope.T @ residual
    step = ca.Function("step", [x, places, z], [x + ca.inv(normal) @ right])
    many = step.map(len(scene.z))
    inputs = np.moveaxis(scene.stations, 2, 0).reshape(3, -1), scene.z.T

    def work() -> Array:
        point: Any = scene.truth.T
        for _ in range(STEPS):
            point = many(point, *inputs)
        return np.array(point).T

    return work


def ipopt_from_the_truth(scene: Scene) -> Any:
    """IPOPT through CasADi, built once, started at the truth."""
    import casadi as ca

    s = scene.stations.shape[1]
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 3 * s + s - 1)
    places, z = ca.reshape(p[: 3 * s], 3, s), p[3 * s :]
    ranges = [ca.norm_2(1e4 * x - places[:, i]) for i in range(s)]
    residual = ca.SX(ca.DM(scene.white)) @ (z - ca.vertcat(*(r - ranges[0] for r in ranges[1:])))
    quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    solver = ca.nlpsol("fix", "ipopt", {"x": x, "p": p, "f": 0.5 * ca.sumsqr(residual)}, quiet)

    def fix(i: int) -> Array:
        given = np.concatenate([scene.stations[i].ravel(), scene.z[i]])
        return 1e4 * np.array(solver(x0=scene.truth[i] / 1e4, p=given)["x"])[:, 0]

    return each(scene, fix)


def lifted(scene: Scene, i: int) -> tuple[Array, Array, float]:
    """Return rows and right side of the squared range differences, in units of the size of the array, and the unit."""
    apart = scene.stations[i, 1:] - scene.stations[i, 0]
    unit = float(np.abs(apart).max())
    rows = 2.0 * np.concatenate([apart, scene.z[i, :, None]], axis=1) / unit
    right = ((apart**2).sum(1) - scene.z[i] ** 2) / unit**2
    return rows, right, unit


def semidefinite() -> tuple[Any, Any, Any]:
    """Return the order-1 relaxation of squared range differences: problem, parameter of the cost, lifted variable."""
    import cvxpy as cp

    gram, lift = cp.Parameter((5, 5), symmetric=True), cp.Variable((5, 5), symmetric=True)
    shape = np.diag([1.0, 1.0, 1.0, -1.0, 0.0])
    inside = [lift >> 0, lift[4, 4] == 1, cp.sum(cp.multiply(shape, lift)) == 0]
    return cp.Problem(cp.Minimize(cp.sum(cp.multiply(gram, lift))), inside), gram, lift


def cvxpy_relaxed(built_once: bool) -> Any:
    """Return the relaxation through ``problem.solve``, built once with a parameter or anew for each fix."""

    def make(scene: Scene) -> Any:
        kept = semidefinite() if built_once else None

        def fix(i: int) -> Array:
            problem, gram, lift = kept or semidefinite()
            rows, right, unit = lifted(scene, i)
            factor = np.concatenate([rows, -right[:, None]], axis=1)
            gram.value = factor.T @ factor
            problem.solve(solver="CLARABEL")
            return scene.stations[i, 0] + unit * lift.value[:3, 4]

        return each(scene, fix)

    return make


METHODS = {
    "SciPy least_squares from the truth": scipy_from_the_truth,
    "CasADi, mapped Gauss-Newton from the truth": casadi_mapped,
    "CasADi + IPOPT from the truth": ipopt_from_the_truth,
    "cvxpy, order-1 SDP, solved again": cvxpy_relaxed(built_once=True),
    "cvxpy, order-1 SDP, cold": cvxpy_relaxed(built_once=False),
}
