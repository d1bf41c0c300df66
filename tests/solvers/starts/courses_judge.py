"""Random problems of one target on a polynomial course, and a judge that shares no code with the solver.

The judge is SciPy's `least_squares` from many starts: around the truth, and of courses through random places.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
from scipy.optimize import leastsq
from scipy.stats import chi2

from optloc import Motion, Problem, assemble, measured

Array = np.ndarray
# Courses of which the judge refines the cheapest, how many it refines, and how many more at random.
DRAWN, CHEAPEST, ANY = 4000, 60, 40


@dataclass(frozen=True)
class Case:
    """One problem, its truth, and its whitened residuals and their slopes as functions of a state."""

    problem: Problem
    truth: Array
    residual: object
    slopes: object
    span: float
    stations: Array

    @property
    def dof(self) -> int:
        return self.problem.count - self.truth.size


def _stations(rng, d, count, shape):
    place = rng.uniform(0.0, 2000.0, (count, d))
    if shape == "line":
        place[:, 1] = 0.1 * place[:, 1] + 900.0
    if d == 3:
        place[:, 2] *= 0.15
    return place


def _pairs(rng, sparse, s, k, n):
    """Return station and epoch of each row: all, or a few at random with at least as many as unknowns."""
    a, e = np.tile(np.arange(s), k), np.repeat(np.arange(k), s)
    if not sparse:
        return a, e
    pick = np.sort(rng.permutation(len(a))[: int(rng.integers(n, min(24, len(a)) + 1))])
    return a[pick], e[pick]


def draw(name, seed):
    """Return a random case of a name such as "range/2/1/sparse/square": kind, d, order, rows, stations."""
    kind, d, order, rows, shape = name.split("/")
    d, order = int(d), int(order)
    rng = np.random.default_rng([int(seed), *name.encode()])
    k, n = int(rng.integers(4, 9)), d * (order + 1)
    span = float(rng.choice([20.0, 70.0, 300.0]))
    times = np.linspace(0.0, span, k)
    s = int(rng.integers(3, 6)) + (kind == "tdoa") + (d - 2)
    s = int(rng.integers(2, 4)) if kind in ("both", "azimuth") else s
    s = 1 if kind == "own" else s
    place = np.broadcast_to(_stations(rng, d, s, shape), (k, s, d)).copy()
    if kind == "own":
        # one observer on a way with a turn
        legs = rng.normal(0.0, 8.0, (2, d))
        place += np.cumsum(np.where(np.arange(k)[:, None] < k // 2, legs[0], legs[1]) * span / (k - 1), axis=0)[:, None]
    middle = place.mean((0, 1)) if shape != "far" else place.mean((0, 1)) + rng.normal(0.0, 4000.0, d)
    state = np.zeros((order + 1, d))
    state[0] = middle + rng.normal(0.0, 700.0, d)
    state[1] = rng.normal(0.0, rng.choice([3.0, 15.0]), d)
    state[2:] = rng.normal(0.0, rng.choice([0.1, 0.4]), (order - 1, d)) if order > 1 else 0.0
    return _measure(rng, kind, rows == "sparse", times, place, state, n)


def _measure(rng, kind, sparse, times, place, state, n):
    k, s, d = place.shape
    order = len(state) - 1
    factors = np.stack([times**j / factorial(j) for j in range(order + 1)])
    rates = np.stack([times ** (j - 1) / factorial(j - 1) if j else 0.0 * times for j in range(order + 1)])
    a, e = _pairs(rng, sparse, s, k, n)
    b = np.zeros_like(a)
    if kind == "tdoa":
        kept = a > 0
        a, e, b = a[kept], e[kept], b[kept]
    main = {"both": "range", "own": "azimuth"}.get(kind, kind)
    sigma = float(np.exp(rng.uniform(*np.log([2.0, 60.0]))))
    sigma = 10.0 ** rng.uniform(-3.0, -1.5) if main == "azimuth" else sigma

    def model(x):
        """Return values and slopes (m, size) of all rows."""
        parts = x.reshape(order + 1, d)
        where, speed = factors.T @ parts, rates.T @ parts
        line, other = where[e] - place[e, a], where[e] - place[e, b]
        r, q = np.sqrt((line**2).sum(1)), np.sqrt((other**2).sum(1))
        f = factors.T[e][:, :, None]
        if main == "azimuth":
            flat = line[:, :2] / (line[:, :2] ** 2).sum(1, keepdims=True)
            across = np.zeros_like(line)
            across[:, 0], across[:, 1] = -flat[:, 1], flat[:, 0]
            return np.arctan2(line[:, 1], line[:, 0]), (f * across[:, None]).reshape(len(a), -1)
        u = line / r[:, None]
        if main == "tdoa":
            return r - q, (f * (u - other / q[:, None])[:, None]).reshape(len(a), -1)
        if kind != "both":
            return r, (f * u[:, None]).reshape(len(a), -1)
        v, g = speed[e], rates.T[e][:, :, None]
        rate = (u * v).sum(1)
        turned = (v - rate[:, None] * u) / r[:, None]
        slopes = f * turned[:, None] + g * u[:, None]
        return np.concatenate([r, rate]), np.concatenate([f * u[:, None], slopes]).reshape(2 * len(a), -1)

    deviation = np.full(len(a), sigma) if kind != "both" else np.repeat([sigma, 0.02 * sigma], len(a))
    with np.errstate(all="ignore"):
        exact = model(state.ravel())[0]
    z = exact + deviation * rng.standard_normal(len(exact))
    if main == "azimuth":
        z = np.arctan2(np.sin(z), np.cos(z))

    def residual(x):
        off = model(x)[0] - z
        return (np.arctan2(np.sin(off), np.cos(off)) if main == "azimuth" else off) / deviation

    told = [measured(main, z[: len(a)], a=a, epoch=e, sigma=sigma, **({"b": b} if main == "tdoa" else {}))]
    if kind == "both":
        told.append(measured("range_rate", z[len(a) :], a=a, epoch=e, sigma=0.02 * sigma))
    problem = assemble(place if kind == "own" else place[:1], *told, times=times, motions=(Motion(order),))
    return Case(
        problem, state, residual, lambda x: model(x)[1] / deviation[:, None], float(times[-1]), place.reshape(-1, d)
    )


def best(case, seed=0, drawn=DRAWN):
    """Return the least cost of descents from the truth, around it, and from `drawn` courses anywhere, and its state."""
    rng, (terms, d) = np.random.default_rng(seed), case.truth.shape
    scale = np.array([600.0, 900.0 / case.span, 2000.0 / case.span**2])[:terms, None]
    near = case.truth + scale * rng.standard_normal((20, terms, d))
    size = 1000.0 * np.exp(rng.normal(0.0, 0.8, (drawn, 1, 1)))
    wide = case.stations.mean(0) * (np.arange(terms) == 0)[:, None]
    wide = wide + size * scale / 600.0 * rng.standard_normal((drawn, terms, d))
    wide[::4, 1:] = 0.0
    cost = np.array([(case.residual(x.ravel()) ** 2).sum() for x in wide])
    chosen = np.concatenate([np.argsort(cost)[:CHEAPEST], rng.permutation(drawn)[:ANY]]).astype(int)
    least, where = np.inf, None
    for x in np.concatenate([case.truth[None], near, wide[chosen]]):
        with np.errstate(all="ignore"):
            found = leastsq(case.residual, x.ravel(), Dfun=case.slopes, full_output=True, ftol=1e-12, xtol=1e-12)
            reached = float((case.residual(found[0]) ** 2).sum())
        if reached < least:
            least, where = reached, found[0]
    return least, where


def p_value(case, cost):
    """Return the probability of a cost at least as large; 1 without degrees of freedom."""
    return float(chi2.sf(cost, case.dof)) if case.dof > 0 else 1.0


NAMES = [
    f"{kind}/{rows}/{shape}"
    for kind, shapes in (
        ("range/2/1", ("square", "line", "far")),
        ("range/2/2", ("square",)),
        ("range/3/1", ("square",)),
        ("tdoa/2/1", ("square", "far")),
        ("tdoa/2/2", ("square",)),
        ("both/2/1", ("square",)),
        ("azimuth/2/1", ("square",)),
        ("own/2/1", ("square",)),
    )
    for shape in shapes
    for rows in ("full", "sparse")
]
