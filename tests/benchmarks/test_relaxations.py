"""Batches of relaxations over threads, beside what two threads gain the machine on matrix products at that moment."""

from __future__ import annotations

import os
from collections.abc import Callable
from time import perf_counter

import numpy as np
import pytest
from monte_carlo.tables import write
from monte_carlo.trials import automatic, trials

from formulations.direction_sdp import directions
from formulations.moment_sdp import moment_bound
from formulations.range_enclosure import Ranged, enclosure
from formulations.squared_range import cone
from formulations.squared_range_conic import hull, shor
from optloc import solve
from optloc.base.threads import map_on_threads
from optloc.solvers.certificates.relaxations import reference_bound

ROUNDS = 7
Work = Callable[[int], object]


def matrix_products(threads: int) -> object:
    """Matrix products of a millisecond: they hold no lock and share no cache, so they show what the machine gives."""
    matrices = [np.random.default_rng(i).normal(size=(160, 160)) for i in range(threads)]
    return map_on_threads(
        lambda i: [matrices[i % threads] @ matrices[i % threads] for _ in range(20)], range(40), threads
    )


def squared(relax: Callable[..., object]) -> Work:
    rng = np.random.default_rng(0)
    items = [(rng.normal(size=(6, 4)), 2.0 * rng.normal(size=6)) for _ in range(600)]
    return lambda threads: map_on_threads(lambda item: relax(*item, cone(3), bound=False), items, threads)


def by_directions() -> Work:
    rng = np.random.default_rng(1)
    items = []
    for _ in range(60):
        station, target = rng.normal(size=(4, 3)), np.array([3.0, 2.0, 2.5]) + rng.normal(size=3)
        apart = target - station
        angle = np.stack([np.arctan2(apart[:, 1], apart[:, 0]), np.arctan2(apart[:, 2], np.hypot(*apart[:, :2].T))], 1)
        items.append((angle + 5e-3 * rng.normal(size=(4, 2)), np.full((4, 2), 5e-3), station))
    return lambda threads: map_on_threads(lambda item: directions(*item), items, threads)


def by_moments() -> Work:
    rng = np.random.default_rng(2)
    items = []
    while len(items) < 8:
        station, target = rng.uniform(-1.0, 1.0, (5, 3)), rng.uniform(-1.0, 1.0, 3)
        r = np.linalg.norm(target - station, axis=1)
        covariance = np.zeros((5, 5))
        covariance[1:, 1:] = 0.5e-6 * (np.eye(4) + 1.0)
        ranged = Ranged(station, np.ones(5), r - r[0], covariance, free=True)
        box = enclosure(ranged, target, 2.0)
        if box is not None:
            items.append((ranged, box, 2.0))
    return lambda threads: map_on_threads(lambda item: moment_bound(*item), items, threads)


def stage(case: str, run: Callable[..., object]) -> Work:
    def work(threads: int) -> object:
        os.environ["OPTLOC_THREADS"] = str(threads)
        try:
            return run(trials(case, 200).problem)
        finally:
            del os.environ["OPTLOC_THREADS"]

    return work


def bounds(case: str, method: str, count: int) -> Work:
    problem, fix = trials(case, count).problem, automatic(case, count)

    def work(threads: int) -> object:
        os.environ["OPTLOC_THREADS"] = str(threads)
        try:
            return reference_bound(problem, fix, method)
        finally:
            del os.environ["OPTLOC_THREADS"]

    return work


TDOA, ANGLES = "TDOA, 5 stations, inside, 10 m", "azimuth and elevation, 4 stations, inside, 5 mrad"
# Batches whose programs are long enough for threads: of shorter ones handing over the interpreter lock takes the gain.
LONG = ("unit directions", "moments", "stage directions", "reference bound, moments")
WORK: dict[str, Callable[[], Work]] = {
    "Shor relaxation": lambda: squared(shor),
    "cone relaxation": lambda: squared(hull),
    "unit directions": by_directions,
    "moments": by_moments,
    "stage sdp": lambda: stage(TDOA, lambda problem: solve(problem, "sdp", refine=False)),
    "stage socp": lambda: stage(TDOA, lambda problem: solve(problem, "socp", refine=False)),
    "stage directions": lambda: stage(ANGLES, lambda problem: solve(problem, "directions", refine=False)),
    "stage minimax": lambda: stage(ANGLES, lambda problem: solve(problem, "minimax", refine=False)),
    "reference bound, moments": lambda: bounds(TDOA, "moment", 16),
    "reference bound, directions": lambda: bounds(ANGLES, "directions", 60),
}


def seconds(work: Work, threads: int) -> float:
    begin = perf_counter()
    work(threads)
    return perf_counter() - begin


def gains(work: Work, rounds: int = ROUNDS) -> tuple[float, float, float]:
    """Return the gain of two threads over one, that of matrix products meanwhile, and the least time on one."""
    work(1)
    work(2)
    found = []
    for _ in range(rounds):
        alone, both = seconds(work, 1), seconds(work, 2)
        spare = seconds(matrix_products, 1) / seconds(matrix_products, 2)
        found.append((alone, both, spare))
    alone, both, spare = np.min([f[0] for f in found]), np.min([f[1] for f in found]), np.max([f[2] for f in found])
    return float(alone / both), float(spare), float(alone)


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one processor")
@pytest.mark.parametrize("name", list(WORK))
def test_two_threads_beside_one(benchmark, name):
    work = WORK[name]()
    gain, spare, _ = gains(work)
    benchmark.group = "batches of relaxations"
    benchmark.extra_info.update(two_threads=gain, two_threads_of_matrix_products=spare)
    benchmark.pedantic(work, (2,), rounds=1)
    if spare > 1.8 and name in LONG:
        assert gain > 1.6


@pytest.mark.full
def test_write_the_table():
    rows = []
    for name, make in WORK.items():
        gain, spare, alone = gains(make())
        rows.append([name, f"{alone:.2f}", f"{gain:.2f}", f"{spare:.2f}"])
    header = ["batch", "one thread, s", "two threads, gain", "gain of matrix products meanwhile"]
    write("relaxations", header, rows, f"{os.cpu_count()} processors, least of {ROUNDS} interleaved rounds")
