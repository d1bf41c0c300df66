"""A warm relaxation beside the bare Clarabel solve of the same data, in one run."""

import time

import clarabel
import numpy as np
import pytest

from formulations import squared_range_conic
from formulations.conic import Relaxation
from formulations.squared_range import cone

QUADRIC = cone(3)
PROBLEMS = {"shor": squared_range_conic.shor_problem, "hull": squared_range_conic.hull_problem}


def data(kind: str, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(6, 4)), 2.0 * rng.normal(size=6)
    factor, _ = squared_range_conic._triangle(*rows)
    return {"gram": factor.T @ factor} if kind == "shor" else {"factor": factor}


def bare(warm: Relaxation) -> None:
    fed = warm._data
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    clarabel.DefaultSolver(fed.P, fed.q, fed.A, fed.b, fed.cones, settings).solve()


@pytest.mark.parametrize("kind", list(PROBLEMS))
def test_warm_relaxation(benchmark, kind):
    warm = Relaxation(PROBLEMS[kind](QUADRIC))
    inputs = [data(kind, seed) for seed in range(40)]
    warm.solve(inputs[0])
    whole, alone = [], []
    for values in inputs * 5:
        begin = time.perf_counter()
        warm.solve(values, bound=False)
        middle = time.perf_counter()
        bare(warm)
        whole.append(middle - begin)
        alone.append(time.perf_counter() - middle)
    benchmark.extra_info["warm / bare"] = float(np.median(np.array(whole) / np.array(alone)))
    benchmark(warm.solve, inputs[1], bound=False)
