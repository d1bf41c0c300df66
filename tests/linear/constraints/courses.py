"""Random problems of courses, of two targets and of equalities, and a judge by SLSQP from many starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from linear.constraints.judge import _circle, _ground, _ranges
from scipy.optimize import minimize

from optloc import Motion, assemble, constraints, measured, solve

TIMES = np.linspace(0.0, 70.0, 8)


@dataclass(frozen=True)
class Posed:
    """One problem and, written apart: its cost, its bounds (at least zero), its equalities, and starts with a scale."""

    problem: object
    cost: Callable
    bounds: Callable
    equal: Callable | None
    starts: np.ndarray
    scale: np.ndarray


def _course(rng, order, limits, bounds):
    """Return the ranges to a course of one target, with constraints that depend on its true state."""
    stations = rng.uniform(0.0, 2000.0, (int(rng.integers(3, 6)), 2))
    heading, turn = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.02, 0.02)
    speed = rng.uniform(8.0, 25.0)
    velocity = speed * np.array([np.cos(heading), np.sin(heading)])
    acceleration = turn * speed * np.array([-np.sin(heading), np.cos(heading)]) + rng.uniform(-0.1, 0.1, 2)
    state = np.concatenate([rng.uniform(500.0, 1500.0, 2), velocity, acceleration])[: 2 * order + 2]
    a, k = np.tile(np.arange(len(stations)), len(TIMES)), np.repeat(np.arange(len(TIMES)), len(stations))
    sigma = rng.uniform(5.0, 40.0)

    def places(x):
        parts = np.reshape(x, (-1, 2))
        factors = np.stack([np.ones(len(TIMES)), TIMES, 0.5 * TIMES**2])[: len(parts)]
        return factors.T @ parts

    z = np.sqrt(((places(state)[k] - stations[a]) ** 2).sum(-1)) + sigma * rng.standard_normal(len(a))

    def cost(x):
        return float((((z - np.sqrt(((places(x)[k] - stations[a]) ** 2).sum(-1))) / sigma) ** 2).sum())

    made = limits(state)
    problem = assemble(
        stations,
        measured("range", z, a=a, epoch=k, sigma=sigma),
        times=TIMES,
        motions=(Motion(order),),
        constraints=made,
    )
    scale = np.repeat([200.0, 5.0, 0.2], 2)[: len(state)]
    starts = state + scale * rng.standard_normal((25, len(state)))
    return Posed(problem, cost, bounds(state), None, starts, scale)


def _slowest(x):
    """Return the least squared speed of a course of order 2."""
    v, a = x[2:4], x[4:6]
    return float(((v + np.clip(-(v @ a) / (a @ a), 0.0, TIMES[-1]) * a) ** 2).sum())


def _length(u):
    return float(np.sqrt((u**2).sum()))


def top_speed(rng):
    share = rng.uniform(0.93, 1.03)
    return _course(
        rng,
        1,
        lambda s: constraints.speed(share * _length(s[2:4])),
        lambda s: lambda x: np.array([share * _length(s[2:4]) - _length(x[2:4])]),
    )


def speeds_along(rng):
    low, high = rng.uniform(0.9, 1.05), rng.uniform(0.95, 1.05)

    def limits(s):
        ends = [_length(s[2:4]), _length(s[2:4] + TIMES[-1] * s[4:6])]
        most = max(high * max(ends), 1.1 * low * np.sqrt(_slowest(s)))
        return low * np.sqrt(_slowest(s)), most

    def bounds(s):
        least, most = limits(s)
        return lambda x: np.array(
            [most - _length(x[2:4]), most - _length(x[2:4] + TIMES[-1] * x[4:6]), np.sqrt(_slowest(x)) - least]
        )

    return _course(rng, 2, lambda s: constraints.speed(limits(s)[1], lower=limits(s)[0], along=True), bounds)


def _turn(x):
    return (x[2] * x[5] - x[3] * x[4]) / _slowest(x)


def turns(rng):
    share = rng.uniform(0.6, 1.2)
    return _course(
        rng,
        2,
        lambda s: constraints.turn_rate(share * abs(_turn(s))),
        lambda s: lambda x: 1e2 * np.array([share * abs(_turn(s)) - _turn(x), share * abs(_turn(s)) + _turn(x)]),
    )


def accelerations(rng):
    share = rng.uniform(0.7, 1.1)
    return _course(
        rng,
        2,
        lambda s: constraints.acceleration(share * _length(s[4:6])),
        lambda s: lambda x: 1e1 * np.array([share * _length(s[4:6]) - _length(x[4:6])]),
    )


def _pair(rng, way, exact=False):
    """Return the ranges to two targets at rest, whose distance is bounded from one side or known."""
    stations = rng.uniform(0.0, 1000.0, (int(rng.integers(4, 6)), 2))
    first = rng.uniform(200.0, 800.0, 2)
    places = np.stack([first, first + rng.uniform(-60.0, 60.0, 2)])
    sigma, apart = rng.uniform(4.0, 20.0), _length(places[1] - places[0])
    a, t = np.tile(np.arange(len(stations)), 2), np.repeat([0, 1], len(stations))
    z = _ranges(places, stations).ravel() + sigma * rng.standard_normal(len(a))

    def cost(x):
        return float((((z - _ranges(np.reshape(x, (2, 2)), stations).ravel()) / sigma) ** 2).sum())

    limit = apart + rng.uniform(-8.0, 20.0) * way
    limit = max(limit, 5.0)
    made = (
        constraints.separation(0, 1, limit, limit)
        if exact
        else constraints.separation(0, 1, *((limit, np.inf) if way > 0.0 else (0.0, limit)))
    )
    problem = assemble(
        stations, measured("range", z, a=a, target=t, sigma=sigma), motions=(Motion(), Motion()), constraints=made
    )
    starts = places.ravel() + 60.0 * rng.standard_normal((25, 4))

    def gap(x):
        return np.array([way * (_length(x[2:] - x[:2]) - limit)])

    return Posed(
        problem, cost, (lambda x: np.zeros(0)) if exact else gap, gap if exact else None, starts, np.full(4, 100.0)
    )


def pairs_apart(rng):
    return _pair(rng, 1.0)


def pairs_together(rng):
    return _pair(rng, -1.0)


def pairs_at_a_known_distance(rng):
    return _pair(rng, 1.0, exact=True)


def _fixed(rng, d, limits, equal):
    from linear.constraints.judge import drawn

    stations, truth, rows, cost = drawn(rng, d)
    made, level = limits(truth)
    problem = assemble(stations, *rows, constraints=made)
    starts = np.concatenate([truth + 100.0 * rng.standard_normal((15, d)), rng.uniform(0.0, 1000.0, (10, d))])
    return Posed(
        problem,
        lambda x: float(cost(x[None])[0]),
        lambda x: np.zeros(0),
        lambda x: level(x[None]),
        starts,
        np.full(d, 100.0),
    )


def on_the_ground(rng):
    x, y, height, at = _ground(rng)

    def limits(truth):
        above = float(truth[2] - at(truth[None])[0])
        return constraints.terrain(x, y, height, exactly=above), lambda p: p[:, 2] - at(p) - above

    return _fixed(rng, 3, limits, None)


def on_a_circle(rng):
    def limits(truth):
        centre, radius = _circle(rng, truth, False)
        return constraints.annulus(centre, radius, radius), lambda p: np.sqrt(((p - centre) ** 2).sum(1)) - radius

    return _fixed(rng, 2, limits, None)


ALL = {
    maker.__name__: maker
    for maker in (
        top_speed,
        speeds_along,
        turns,
        accelerations,
        pairs_apart,
        pairs_together,
        pairs_at_a_known_distance,
        on_the_ground,
        on_a_circle,
    )
}


def best_by_slsqp(case):
    """Return the least admitted cost, and where it is, of many descents by SciPy with slopes by differences."""
    best, where = np.inf, None
    rules = [{"type": "ineq", "fun": lambda y: case.bounds(y * case.scale)}]
    if case.equal is not None:
        rules.append({"type": "eq", "fun": lambda y: case.equal(y * case.scale) / case.scale[0]})
    for start in case.starts:
        with np.errstate(all="ignore"):
            found = minimize(
                lambda y: case.cost(y * case.scale),
                start / case.scale,
                method="SLSQP",
                constraints=rules,
                options={"ftol": 1e-12, "maxiter": 200},
            )
        x = found.x * case.scale
        off = max(-case.bounds(x).min(initial=0.0), 0.0 if case.equal is None else np.abs(case.equal(x)).max())
        if off < 1e-7 and found.fun < best:
            best, where = float(found.fun), x
    return best, where


def verdict(name, seed, method="auto"):
    """Return what is wrong with the fix of one random problem, "" for nothing; and whether a bound was active."""
    case = ALL[name](np.random.default_rng([seed, sum(map(ord, name))]))
    best, where = best_by_slsqp(case)
    fix = solve(case.problem, method)
    x = fix.x[: len(case.scale)]
    if not np.isfinite(x).all():
        return f"no position ({fix.status}: {fix.reason}), {best:.6g} at {where}", False
    cost = case.cost(x)
    off = max(-case.bounds(x).min(initial=0.0), 0.0 if case.equal is None else np.abs(case.equal(x)).max())
    wrong = []
    if off > 1e-4:
        wrong.append(f"outside by {off:.3g}")
    if cost > best * (1.0 + 1e-6) + 1e-5:
        wrong.append(f"missed: {cost:.9g} at {x}, {best:.9g} at {where} ({fix.status}, {fix.active[()]})")
    return "; ".join(wrong), bool(fix.active[()])
