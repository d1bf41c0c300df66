"""What the benchmarks time: 10 000 six-station problems, and the same by a general least-squares routine."""

from __future__ import annotations

from functools import cache
from time import perf_counter

import numpy as np
from monte_carlo.layouts import KINDS, SEED, anywhere, inside, model, outside
from scipy.optimize import least_squares

from optloc import Fix, Problem, solve

COUNT, STATIONS, SIGMA, GENERAL = 10_000, 6, 10.0, 300
Array = np.ndarray


@cache
def batch() -> tuple[Problem, Array, Array, Array]:
    """Return problem, stations, measurements and truth; emitters half inside the box, half outside."""
    rng = np.random.default_rng(SEED)
    stations = anywhere(STATIONS, rng, COUNT)
    truth = np.concatenate([inside(rng, COUNT // 2), outside(rng, COUNT - COUNT // 2)])
    kind = KINDS["tdoa"]
    exact = model(kind, stations, SIGMA).exact(truth)
    root = np.linalg.cholesky(kind.covariance(STATIONS - 1, SIGMA))
    z = exact + rng.standard_normal(exact.shape) @ root.T
    return kind.problem(stations, z, SIGMA), stations, z, truth


@cache
def cut(chunk: int) -> tuple[Problem, ...]:
    """Return the same problems in chunks."""
    problem = batch()[0]
    return tuple(problem.take(np.arange(i, min(i + chunk, COUNT))) for i in range(0, COUNT, chunk))


def fixes(method: str, chunk: int) -> list[Fix]:
    """Fix all problems, chunk by chunk; the covariance is part of every fix."""
    return [solve(problem, method=method) for problem in cut(chunk)]


def microseconds(method: str, chunk: int, rounds: int = 5) -> float:
    """Return the time of one fix in the quietest round."""
    fixes(method, chunk)
    times = []
    for _ in range(rounds):
        began = perf_counter()
        fixes(method, chunk)
        times.append(perf_counter() - began)
    return 1e6 * min(times) / COUNT


def general() -> list[Array]:
    """Fix every 33rd problem by scipy from the truth, with exact derivatives, and add the covariance."""
    _, stations, z, truth = batch()
    white = np.linalg.inv(np.linalg.cholesky(KINDS["tdoa"].covariance(STATIONS - 1, SIGMA)))
    out = []
    for i in range(0, COUNT, COUNT // GENERAL):
        places, rows = stations[i], z[i]

        def residual(x, places=places, rows=rows):
            r = np.sqrt(((x - places) ** 2).sum(1))
            return white @ (r[1:] - r[0] - rows)

        def jacobian(x, places=places):
            apart = x - places
            unit = apart / np.sqrt((apart**2).sum(1))[:, None]
            return white @ (unit[1:] - unit[0])

        found = least_squares(residual, truth[i], jac=jacobian, method="lm", x_scale="jac")
        out.append(np.linalg.inv(found.jac.T @ found.jac))
    return out


def general_microseconds(rounds: int = 3) -> float:
    """Return scipy's time of one fix in the quietest round."""
    times = []
    for _ in range(rounds):
        began = perf_counter()
        count = len(general())
        times.append((perf_counter() - began) / count)
    return 1e6 * min(times)


def relaxation_ratio(kind: str, solves: int = 300) -> tuple[float, float]:
    """Return microseconds of a warm relaxation and its ratio to the bare Clarabel solve of the same data."""
    from formulations.conic import Relaxation, _solver
    from formulations.squared_range import cone
    from formulations.squared_range_conic import hull_problem, shor_problem

    relaxation = Relaxation(shor_problem(cone(3)) if kind == "shor" else hull_problem(cone(3)))
    rng = np.random.default_rng(SEED)
    whole, bare = [], []
    for _ in range(solves):
        x = rng.uniform(-2.0, 2.0, 3)
        rows = rng.standard_normal((5, 4))
        right = rows @ [*x, np.linalg.norm(x)] + 0.1 * rng.standard_normal(5)
        factor = np.linalg.qr(np.concatenate([rows, -right[:, None]], axis=1), mode="r")
        factor /= np.abs(factor).max()
        values = {"gram": factor.T @ factor} if kind == "shor" else {"factor": factor}
        began = perf_counter()
        relaxation.solve(values)
        whole.append(perf_counter() - began)
        # The same data, already in Clarabel's form and in a solver of its own.
        alone = _solver(relaxation._data, {})
        began = perf_counter()
        alone.solve()
        bare.append(perf_counter() - began)
    return 1e6 * float(np.median(whole)), float(np.median(np.array(whole) / np.array(bare)))
