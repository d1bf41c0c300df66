"""A million fixes: time, memory, one-fix latency; run as `pytest tests/benchmarks`, in a quiet moment."""

import tracemalloc
from time import perf_counter

import numpy as np
import pytest
from benchmarks.speed import COUNT, SCENES, SIGMA, STATIONS, batch, general_microseconds
from monte_carlo.tables import write

from optloc import prepare, solve
from optloc.kernels.jit import enabled

MILLION, THREADS = 1_000_000, (1, 2)
pytestmark = pytest.mark.skipif(not enabled(), reason="times of machine code")


def dgemm(n=400, rounds=20):
    """Return what this machine multiplies, 10^9 operations a second."""
    a, times = np.random.default_rng(0).random((n, n)), []
    for _ in range(rounds):
        began = perf_counter()
        a @ a
        times.append(perf_counter() - began)
    return 2e-9 * n**3 / min(times)


def million(scene):
    """Return a million problems: those of a scene, again and again."""
    problem = batch(scene)[0]
    again = np.resize(np.arange(COUNT), MILLION)
    return problem.take(again)


def seconds(problem, method, rounds=3):
    """Return the time of a batch in the quietest round."""
    times = []
    for _ in range(rounds):
        began = perf_counter()
        fix = solve(problem, method)
        times.append(perf_counter() - began)
        assert fix.answered.mean() > 0.99
    return min(times)


def latency(method, count=300):
    """Return the median time of one fix of a prepared problem, microseconds."""
    problem, _, z, _ = batch(SCENES[0])
    ready = prepare(problem.with_rows(z=z[0]), method)
    times = []
    for i in range(count):
        began = perf_counter()
        ready(z[i])
        times.append(perf_counter() - began)
    return 1e6 * float(np.median(times[count // 10 :]))


def megabytes(problem, method):
    """Return the most memory that solving a batch holds at any time, its answer included and the problem not."""
    tracemalloc.start()
    fix = solve(problem, method)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(fix) == MILLION
    return most / 1e6


@pytest.mark.parametrize("scene", SCENES)
def test_million_fixes(scene):
    problem = million(scene)
    assert seconds(problem, "gtrs+lsr") < 3.0
    assert megabytes(problem, "gtrs+lsr") < 700.0  # a second place for all where some have a rival


def test_one_fix():
    assert latency("gtrs+lsr") < 100.0


@pytest.mark.parametrize("scene", SCENES)
def test_hundred_times_faster_than_a_general_routine(scene):
    theirs, ours = general_microseconds(scene), 1e6 * seconds(million(scene), "gtrs+lsr") / MILLION
    assert theirs / ours > 100.0


@pytest.mark.full
def test_write_the_table(monkeypatch):
    rows = []
    for scene in SCENES:
        problem = million(scene)
        for threads in THREADS:
            monkeypatch.setenv("OPTLOC_THREADS", str(threads))
            took = seconds(problem, "gtrs+lsr")
            rows.append(
                [f"{scene}: a million fixes, {threads} threads", f"{took:.2f} s", f"{took / MILLION * 1e6:.2f}"]
            )
            proven = seconds(problem, "gtrs+lsr+value", 2)
            what = f"{scene}: with a proof of their values, {threads} threads"
            rows.append([what, f"{proven:.1f} s", f"{proven / MILLION * 1e6:.1f}"])
        rows.append([f"{scene}: memory of a million fixes", f"{megabytes(problem, 'gtrs+lsr'):.0f} MB", ""])
        rows.append([f"{scene}: scipy least_squares from the truth", "", f"{general_microseconds(scene):.0f}"])
    methods = ("gtrs+lsr", "auto")
    rows += [[f"one fix of a prepared problem, {method}", "", f"{latency(method):.0f}"] for method in methods]
    facts = f"TDOA, {STATIONS} stations, {SIGMA:g} m; fix, covariance and verdict; dgemm {dgemm():.0f} Gflop/s one core"
    assert write("million", ["what", "whole", "us a fix"], rows, facts).is_file()
