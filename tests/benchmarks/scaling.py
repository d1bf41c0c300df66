"""How the time of a fix grows: with stations, epochs and the size of the batch; and what a second thread brings."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from mmap import PAGESIZE
from multiprocessing import get_context
from pathlib import Path
from threading import Event, Thread
from time import perf_counter
from typing import Any

import numpy as np
from benchmarks.rounds import product
from benchmarks.scenes import SIGMA, Scene
from benchmarks.with_general import scipy_from_the_truth
from monte_carlo import layouts

from optloc import Problem, assemble, measured, solve

Array = np.ndarray
METHODS = ("gtrs+lsr", "auto")
SCIPY = "SciPy from the truth"
STATIONS, EPOCHS = (5, 6, 8, 12, 20, 35, 50), (1, 3, 10, 30, 100, 300, 1000)
BATCH = (1, 10, 100, 1000, 10_000, 100_000, 1_000_000)
THREADS = (1, 2)
# Rows in a round: what is large in one direction is small in the other.
ROWS, GENERAL = 20_000, 30


@dataclass(frozen=True)
class Curve:
    """The time of a fix along one axis.

    Parameters
    ----------
    axis : str
        What grows.
    method : str
        How it is fixed.
    at : tuple of int
        Where on the axis.
    microseconds : tuple of float
        Time of a fix in the quietest round.
    products : tuple of float
        The same in matrix products of order 200.
    """

    axis: str
    method: str
    at: tuple[int, ...]
    microseconds: tuple[float, ...]
    products: tuple[float, ...]


def scene(stations: int, count: int) -> Scene:
    """Return emitters inside a box, an array of their own for each."""
    rng, kind = np.random.default_rng([layouts.SEED, stations]), layouts.KINDS["tdoa"]
    places, truth = layouts.anywhere(stations, rng, count), layouts.inside(rng, count)
    covariance = kind.covariance(stations - 1, SIGMA)
    noise = rng.standard_normal((count, stations - 1)) @ np.linalg.cholesky(covariance).T
    return Scene(places, layouts.model(kind, places, SIGMA).exact(truth) + noise, truth, covariance)


def problem_of(made: Scene, epochs: int = 1) -> Problem:
    """Return the problems of a scene; with several epochs each is a run of a fixed emitter with the same stations."""
    s = made.stations.shape[1]
    a, epoch = np.tile(np.arange(1, s), epochs), np.repeat(np.arange(epochs), s - 1)
    rng = np.random.default_rng(layouts.SEED)
    z = np.tile(made.z, epochs)
    if epochs > 1:
        fresh = rng.standard_normal((len(z), epochs, s - 1)) @ np.linalg.cholesky(made.covariance).T
        z = z + fresh.reshape(z.shape)
    rows = measured("tdoa", z, a=a, b=np.zeros_like(a), epoch=epoch, arrival_sigma=SIGMA / np.sqrt(2.0))
    return assemble(made.stations[:, None], rows, times=np.arange(float(epochs)))


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let batches use a number of threads for a while."""
    before = os.environ.get("OPTLOC_THREADS")
    os.environ["OPTLOC_THREADS"] = str(count)
    try:
        yield
    finally:
        if before is None:
            del os.environ["OPTLOC_THREADS"]
        else:
            os.environ["OPTLOC_THREADS"] = before


def quietest(
    works: dict[tuple[str, int], tuple[Callable[[], Any], int]], rounds: int
) -> dict[Any, tuple[float, float]]:
    """Return microseconds of a fix and its ratio to a matrix product for each work, in interleaved rounds."""
    found: dict[Any, list[tuple[float, float]]] = {key: [] for key in works}
    for i in range(rounds + 1):
        for key, (work, count) in works.items():
            beside, began = product(), perf_counter()
            work()
            seconds = (perf_counter() - began) / count
            if i or rounds == 0:
                found[key].append((1e6 * seconds, seconds / beside))
    return {key: min(times) for key, times in found.items()}


def curves(axis: str, found: dict[tuple[str, int], tuple[float, float]]) -> list[Curve]:
    """Return the curves of the methods of one axis."""
    out = []
    for method in dict.fromkeys(name for name, _ in found):
        at = tuple(place for name, place in found if name == method)
        values = [found[method, place] for place in at]
        out.append(Curve(axis, method, at, *(tuple(column) for column in zip(*values, strict=True))))
    return out


def with_stations(rounds: int, most: int = STATIONS[-1]) -> list[Curve]:
    """Return the time of a fix against the number of stations, batches of equal rows."""
    works: dict[tuple[str, int], tuple[Callable[[], Any], int]] = {}
    for s in (s for s in STATIONS if s <= most):
        made = scene(s, ROWS // (s - 1))
        works |= _solved(s, problem_of(made), len(made.z))
        works[SCIPY, s] = (scipy_from_the_truth(made.first(GENERAL)), GENERAL)
    with threads(1):
        return curves("stations", quietest(works, rounds))


def with_epochs(rounds: int, most: int = EPOCHS[-1]) -> list[Curve]:
    """Return the time of a fix of one emitter against the number of epochs that it is heard, six stations."""
    works: dict[tuple[str, int], tuple[Callable[[], Any], int]] = {}
    for k in (k for k in EPOCHS if k <= most):
        made = scene(6, max(1, ROWS // (5 * k)))
        works |= _solved(k, problem_of(made, k), len(made.z))
    with threads(1):
        return curves("epochs", quietest(works, rounds))


def with_batch(rounds: int, most: int = BATCH[-1]) -> list[Curve]:
    """Return the time of a fix against the number of fixes of one call, six stations, on one and two threads."""
    made, works = scene(6, most), {}
    for n in (n for n in BATCH if n <= most):
        for (method, place), (work, _) in _solved(n, problem_of(made.first(n)), n).items():
            # The proof of a million takes its time: the curve is flat long before.
            if n <= most // 10 or method == METHODS[0]:
                for count in THREADS:
                    name = method if count == 1 else f"{method}, {count} threads"
                    works[name, place] = (partial(_threaded, work, count), n)
    return curves("fixes of one call", quietest(works, rounds))


def _solved(place: int, problem: Problem, count: int) -> dict[tuple[str, int], tuple[Callable[[], Any], int]]:
    return {(method, place): (partial(solve, problem, method), count) for method in METHODS}


def _threaded(work: Callable[[], Any], count: int) -> None:
    with threads(count):
        work()


def million(method: str, count: int, inside: float = 1.0) -> tuple[float, float, float]:
    """Return seconds, megabytes and share of proven fixes of one call with many fixes, some of them outside.

    It runs in a process of its own; the memory is by how much that grows during the call, at most.
    """
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(_million, (method, count, inside))


def _million(method: str, count: int, inside: float) -> tuple[float, float, float]:
    made = scene(6, count)
    rng, kind = np.random.default_rng(layouts.SEED), layouts.KINDS["tdoa"]
    near = int(count * inside)
    truth = np.concatenate([made.truth[:near], layouts.outside(rng, count - near)])
    noise = rng.standard_normal(made.z.shape) @ np.linalg.cholesky(made.covariance).T
    exact = layouts.model(kind, made.stations, SIGMA).exact(truth)
    mixed = rng.permutation(count)
    problem = problem_of(Scene(made.stations[mixed], (exact + noise)[mixed], truth[mixed], made.covariance))
    solve(problem.take(np.arange(min(count, 5000))), method)
    with resident() as held:
        began = perf_counter()
        fix = solve(problem, method)
        seconds = perf_counter() - began
    proven = float(np.mean([one.proof == "global" for one in np.ravel(fix.certificate)]))
    return seconds, held[1] - held[0], proven


@contextmanager
def resident() -> Iterator[list[float]]:
    """Yield a list of the megabytes that this process holds now and, in the end, of the most that it held meanwhile."""
    held, done = [_megabytes()] * 2, Event()

    def watch() -> None:
        while not done.wait(0.005):
            held[1] = max(held[1], _megabytes())

    watcher = Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield held
    finally:
        done.set()
        watcher.join()


def _megabytes() -> float:
    status = Path("/proc/self/statm")
    if not status.is_file():
        return float("nan")
    return int(status.read_text(encoding="ascii").split()[1]) * PAGESIZE / 1e6
