"""What the benchmarks of runs time: one run of more and more epochs, an update, and many short ones in a batch."""

from __future__ import annotations

import pickle
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from monte_carlo.layouts import SEED
from runs import DELAYS, FIXED, drawn, estimated, run
from scipy.optimize import least_squares

from optloc import Fix, Problem, solve
from optloc.problem.epochs import cut
from optloc.solvers import Running

EPOCHS = (1000, 2500, 5000, 10_000)
FLIGHT = 600.0
TRIALS, BATCH, CHUNK = 2000, 700, 250
Array = np.ndarray


@dataclass(frozen=True)
class Growth:
    """What a run of some epochs takes.

    Parameters
    ----------
    epochs : int
        k.
    seconds : float
        Of `optloc.solve`.
    working : float
        Most memory that it holds at any time beyond the problem, megabytes.
    stored : float
        Memory of the problem itself, megabytes.
    update : float
        Seconds of an update by one epoch.
    """

    epochs: int
    seconds: float
    working: float
    stored: float
    update: float


def flight(epochs: int, *, eliminated: bool = False) -> Problem:
    """Return one drawn run of 600 s, five stations and a number of epochs."""
    made = run(epochs, step=FLIGHT / epochs)
    return drawn(estimated(made) if eliminated else made, SEED, 1)


def growth(epochs: int, *, eliminated: bool = False, rounds: int = 3) -> Growth:
    """Return what a run takes whose station errors are weighed, or unknowns of each epoch that are eliminated."""
    problem = flight(epochs + 1, eliminated=eliminated)
    first = cut(problem, 0, epochs)
    stored = len(pickle.dumps(first)) / 1e6
    fix, working = peak(first)
    seconds = quickest(lambda: solve(first), rounds)
    running, last = Running.begin(first, fix), cut(problem, epochs, epochs + 1)
    return Growth(epochs, seconds, working, stored, quickest(lambda: running.update(last), 5 * rounds))


def peak(problem: Problem) -> tuple[Fix, float]:
    """Return the fix of a run and the most memory it held beyond the problem, megabytes."""
    tracemalloc.start()
    fix = solve(problem)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return fix, most / 1e6


def quickest(work: Callable[[], Any], rounds: int) -> float:
    """Return the seconds of the quietest round."""
    times = []
    for _ in range(rounds):
        began = perf_counter()
        work()
        times.append(perf_counter() - began)
    return min(times)


def batched(method: str = "auto", trials: int = TRIALS) -> float:
    """Return the seconds of many runs of 700 epochs, in chunks."""
    problem = drawn(run(BATCH), SEED, trials)
    chunks = [problem.take(np.arange(i, min(i + CHUNK, trials))) for i in range(0, trials, CHUNK)]
    began = perf_counter()
    for chunk in chunks:
        assert solve(chunk, method).answered.all()
    return perf_counter() - began


def general(rounds: int = 3) -> float:
    """Return the seconds of scipy for one run of 700 epochs from the truth, with exact derivatives and covariance."""
    problem = drawn(run(BATCH), SEED, 1)
    place, z = problem.stations.position, problem.z.reshape(-1, 4)
    white = np.linalg.inv(np.linalg.cholesky((3.0**2 + 1.0) * (np.eye(4) + 1.0)))

    def residual(x: Array) -> Array:
        ranges = np.linalg.norm(x[:3] - place, axis=-1)
        return ((ranges[:, 1:] - ranges[:, :1] + x[3:] - z) @ white.T).ravel()

    def jacobian(x: Array) -> Array:
        apart = x[:3] - place
        unit = apart / np.linalg.norm(apart, axis=-1, keepdims=True)
        rows = np.concatenate([unit[:, 1:] - unit[:, :1], np.broadcast_to(np.eye(4), (len(place), 4, 4))], axis=-1)
        return (white @ rows).reshape(-1, 7)

    def work() -> Array:
        found = least_squares(residual, np.concatenate([FIXED, DELAYS]), jac=jacobian, method="lm", x_scale="jac")
        return np.linalg.inv(found.jac.T @ found.jac)

    return quickest(work, rounds)
