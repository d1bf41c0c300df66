"""Constrained fixes against an independent solver: the same cost, the same multipliers."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from linear.constraints.test_faces import ENU, PLANE, SPACE, above, moving
from often import few
from scipy.optimize import minimize

from optloc import Frame, Status, assemble, measured, solve
from optloc.linear.constraints import box, height, polygon, speed

SIGMA = 30.0
TIMES, A, EPOCH = np.arange(5.0) * 4.0, np.tile(np.arange(5), 5), np.repeat(np.arange(5), 5)


@dataclass(frozen=True)
class Case:
    """One problem and, written apart, its cost with gradient and its bounds ``g(x) >= 0`` with their gradients."""

    problem: object
    cost: Callable
    bounds: list[tuple[str, Callable, Callable]]
    starts: np.ndarray
    scale: np.ndarray


def ranged(place, truth, rng, constraints, bounds, frame=None):
    z = np.linalg.norm(place - truth, axis=-1) + SIGMA * rng.standard_normal(len(place))
    rows = measured("range", z, a=np.arange(len(place)), sigma=SIGMA)

    def cost(x):
        way = x - place
        length = np.linalg.norm(way, axis=1)
        left = (z - length) / SIGMA
        return left @ left, -2.0 * (left / SIGMA / length) @ way

    problem = assemble(place, rows, frame=frame or Frame("cartesian"), constraints=constraints)
    starts = truth + np.array([[600.0, -500.0, 300.0], [-700.0, 400.0, -200.0], [0.0, 0.0, 0.0]])[:, : len(truth)]
    return Case(problem, cost, bounds, starts, np.full(len(truth), 1e3))


def plane(normal, value):
    """Return ``value - normal . x`` and its gradient."""
    normal = np.asarray(normal, dtype=float)
    return lambda x: value - normal @ x[: len(normal)], lambda x: -np.pad(normal, (0, len(x) - len(normal)))


def in_a_box(rng):
    truth = rng.uniform(1e3, 4e3, 2)
    low, high = truth - rng.uniform(50.0, 900.0, 2), truth + rng.uniform(-20.0, 20.0, 2)
    bounds = [(f"{n} upper", *plane(np.eye(2)[i], high[i])) for i, n in enumerate("xy")]
    bounds += [(f"{n} lower", *plane(-np.eye(2)[i], -low[i])) for i, n in enumerate("xy")]
    return ranged(PLANE, truth, rng, box(low, high), bounds)


def in_a_polygon(rng):
    truth = rng.uniform(1e3, 4e3, 2)
    corners = truth + np.array([[-1500.0, -1000.0], [rng.uniform(-15.0, 15.0), -20.0], [200.0, 1400.0]])
    bounds = []
    for i in range(3):
        along = corners[(i + 1) % 3] - corners[i]
        normal = np.array([along[1], -along[0]]) / np.hypot(*along)
        bounds.append((f"polygon edge {i}", *plane(normal, normal @ corners[i])))
    return ranged(PLANE, truth, rng, polygon(corners), bounds)


def in_a_height_band(rng):
    truth = np.array([*rng.uniform(500.0, 4500.0, 2), rng.uniform(100.0, 2e3)])
    ceiling = float(above(truth)) - rng.uniform(-30.0, 60.0)

    def up(x):  # the ellipsoid's normal, by central differences of a metre: exact to 1e-9
        return np.array([(above(x + e) - above(x - e)) / 2.0 for e in np.eye(3)])

    bounds = [
        ("height upper", lambda x: ceiling - above(x), lambda x: -up(x)),
        ("height lower", lambda x: above(x) - ceiling + 300.0, up),
    ]
    return ranged(SPACE, truth, rng, height(ceiling - 300.0, ceiling), bounds, ENU)


def below_a_speed(rng):
    state = np.array([1e3, 2e3, 60.0, 30.0])
    limit = float(np.hypot(60.0, 30.0)) - rng.uniform(-1.0, 3.0)
    problem, plain = moving(rng, speed(limit), truth=state)
    z = problem.z

    def cost(x):
        way = x[:2] + TIMES[EPOCH, None] * x[2:] - PLANE[A]
        length = np.linalg.norm(way, axis=1)
        left = (z - length) / SIGMA
        slope = -2.0 * (left / SIGMA / length)[:, None] * way
        return plain(x), np.concatenate([slope.sum(0), (TIMES[EPOCH, None] * slope).sum(0)])

    def quick(x):
        return np.hypot(x[2], x[3])

    bound = ("speed upper", lambda x: limit - quick(x), lambda x: -np.array([0.0, 0.0, x[2], x[3]]) / quick(x))
    scale = np.array([1e3, 1e3, 10.0, 10.0])
    return Case(problem, cost, [bound], state + np.array([[50.0, 50.0, -5.0, 5.0], [-90.0, 9.0, -20.0, 2.0]]), scale)


def solved_apart(case):
    """Return the cheapest point of SLSQP from several starts, and the multipliers of what holds it."""
    best = None
    for start in case.starts:
        found = minimize(
            lambda u: case.cost(u * case.scale)[0],
            start / case.scale,
            jac=lambda u: case.cost(u * case.scale)[1] * case.scale,
            method="SLSQP",
            constraints=[
                {
                    "type": "ineq",
                    "fun": lambda u, g=g: g(u * case.scale) / 100.0,
                    "jac": lambda u, slope=slope: slope(u * case.scale) * case.scale / 100.0,
                }
                for _, g, slope in case.bounds
            ],
            options={"maxiter": 500, "ftol": 1e-14},
        )
        x = found.x * case.scale
        if min(g(x) for _, g, _ in case.bounds) > -1e-4 and (best is None or found.fun < best[0]):
            best = (float(found.fun), x)
    assert best is not None
    value, x = best
    active = [(name, slope(x)) for name, g, slope in case.bounds if g(x) < 1e-3]
    if not active:
        return value, {}
    # the gradient of the cost is a combination of those of the bounds that hold
    multipliers, *_ = np.linalg.lstsq(np.array([s for _, s in active]).T, case.cost(x)[1], rcond=None)
    return value, dict(zip([name for name, _ in active], multipliers, strict=True))


@pytest.mark.parametrize("seed", few(range(8), 1))
@pytest.mark.parametrize("make", [in_a_box, in_a_polygon, in_a_height_band, below_a_speed])
def test_cost_and_multipliers_are_those_of_slsqp(make, seed):
    case = make(np.random.default_rng([17, seed]))
    value, multipliers = solved_apart(case)
    fix = solve(case.problem)
    assert fix.answered, fix.reason
    assert not fix.has(Status.MISFIT, Status.UNBOUNDED)
    assert float(fix.cost) == pytest.approx(value, rel=1e-6, abs=1e-6)
    held = {active.name: abs(active.multiplier) for active in fix.active[()]}
    assert held.keys() == multipliers.keys()
    for name, multiplier in multipliers.items():
        assert held[name] == pytest.approx(multiplier, rel=1e-3, abs=1e-5)
