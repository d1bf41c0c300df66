"""What the benchmarks time: 10 000 six-station problems, and the same by a general least-squares routine."""

from __future__ import annotations

from functools import cache
from time import perf_counter

import numpy as np
from monte_carlo.layouts import BOX, KINDS, SEED, anywhere, fixed, inside, model, outside
from scipy.optimize import least_squares

from optloc import Fix, Problem, solve

COUNT, STATIONS, SIGMA, GENERAL = 10_000, 6, 10.0, 300
Array = np.ndarray


# An array of good shape: the faces of the box.
FACES = np.concatenate([np.eye(3), -np.eye(3)]) * BOX / 2.0
SCENES = ("one array, inside", "random arrays, half outside")


@cache
def batch(scene: str) -> tuple[Problem, Array, Array, Array]:
    """Return problem, stations, measurements and truth."""
    rng = np.random.default_rng(SEED)
    if scene == SCENES[0]:
        stations, truth = np.array(fixed(FACES, rng, COUNT)), inside(rng, COUNT)
    else:
        stations = anywhere(STATIONS, rng, COUNT)
        truth = np.concatenate([inside(rng, COUNT // 2), outside(rng, COUNT - COUNT // 2)])
    kind = KINDS["tdoa"]
    exact = model(kind, stations, SIGMA).exact(truth)
    root = np.linalg.cholesky(kind.covariance(STATIONS - 1, SIGMA))
    z = exact + rng.standard_normal(exact.shape) @ root.T
    shared = stations[:1] if scene == SCENES[0] else stations
    return kind.problem(shared, z, SIGMA), stations, z, truth


@cache
def cut(scene: str, chunk: int) -> tuple[Problem, ...]:
    """Return the same problems in chunks."""
    problem = batch(scene)[0]
    return tuple(problem.take(np.arange(i, min(i + chunk, COUNT))) for i in range(0, COUNT, chunk))


def fixes(scene: str, method: str, chunk: int) -> list[Fix]:
    """Fix all problems, chunk by chunk; the covariance is part of every fix."""
    return [solve(problem, method=method) for problem in cut(scene, chunk)]


def microseconds(scene: str, method: str, chunk: int, rounds: int = 5) -> float:
    """Return the time of one fix in the quietest round."""
    fixes(scene, method, chunk)
    times = []
    for _ in range(rounds):
        began = perf_counter()
        fixes(scene, method, chunk)
        times.append(perf_counter() - began)
    return 1e6 * min(times) / COUNT


def general(scene: str) -> list[Array]:
    """Fix every 33rd problem by scipy from the truth, with exact derivatives, and add the covariance."""
    _, stations, z, truth = batch(scene)
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


def general_microseconds(scene: str, rounds: int = 3) -> float:
    """Return scipy's time of one fix in the quietest round."""
    times = []
    for _ in range(rounds):
        began = perf_counter()
        count = len(general(scene))
        times.append((perf_counter() - began) / count)
    return 1e6 * min(times)


def relaxation_ratio(kind: str, solves: int = 300) -> tuple[float, float, float]:
    """Return microseconds of a warm relaxation, and its ratios to bare Clarabel with and without its set-up."""
    import clarabel

    from formulations.conic import Relaxation
    from formulations.squared_range import cone
    from formulations.squared_range_conic import hull_problem, shor_problem

    relaxation = Relaxation(shor_problem(cone(3)) if kind == "shor" else hull_problem(cone(3)))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    rng = np.random.default_rng(SEED)
    times = []
    for _ in range(solves):
        x = rng.uniform(-2.0, 2.0, 3)
        rows = rng.standard_normal((5, 4))
        right = rows @ [*x, np.linalg.norm(x)] + 0.1 * rng.standard_normal(5)
        factor = np.linalg.qr(np.concatenate([rows, -right[:, None]], axis=1), mode="r")
        factor /= np.abs(factor).max()
        values = {"gram": factor.T @ factor} if kind == "shor" else {"factor": factor}
        begin = perf_counter()
        relaxation.solve(values, bound=False)
        whole = perf_counter()
        data = relaxation._data
        alone = clarabel.DefaultSolver(data.P, data.q, data.A, data.b, data.cones, settings)
        ready = perf_counter()
        alone.solve()
        end = perf_counter()
        times.append((whole - begin, end - whole, end - ready))
    warm, bare, only = np.array(times).T
    return 1e6 * float(np.median(warm)), float(np.median(warm / bare)), float(np.median(warm / only))
