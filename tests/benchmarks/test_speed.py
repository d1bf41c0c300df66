"""Times, for reading and not for judging: run as `pytest tests/benchmarks`, in a quiet moment."""

import os
import platform

import numpy as np
import pytest
from benchmarks.speed import (
    COUNT,
    SIGMA,
    STATIONS,
    fixes,
    general,
    general_microseconds,
    microseconds,
    relaxation_ratio,
)
from monte_carlo.tables import write


CHUNKS = [500, 2000, COUNT]
METHODS = ["gtrs+lsr", "auto"]


@pytest.mark.parametrize("chunk", CHUNKS)
@pytest.mark.parametrize("method", METHODS)
def test_fixes(benchmark, method, chunk):
    benchmark.group = f"{COUNT} six-station TDOA fixes"
    found = benchmark.pedantic(fixes, (method, chunk), rounds=5, warmup_rounds=1)
    benchmark.extra_info["us_per_fix"] = 1e6 * benchmark.stats.stats.min / COUNT
    answered = np.concatenate([fix.answered & np.isfinite(fix.cov).all((-1, -2)) for fix in found])
    assert answered.mean() > 0.99


def test_general_least_squares_from_the_truth(benchmark):
    benchmark.group = "scipy.optimize.least_squares from the truth, exact derivatives"
    found = benchmark.pedantic(general, rounds=3, warmup_rounds=1)
    ours = microseconds("gtrs+lsr", 2000)
    theirs = 1e6 * benchmark.stats.stats.min / len(found)
    benchmark.extra_info.update(us_per_fix=theirs, us_per_fix_optloc=ours, ratio=theirs / ours)


@pytest.mark.parametrize("kind", ["shor", "hull"])
def test_warm_relaxation(benchmark, kind):
    benchmark.group = "relaxations"
    warm, ratio = benchmark.pedantic(relaxation_ratio, (kind,), rounds=1)
    benchmark.extra_info.update(us_per_solve=warm, ratio_to_bare_clarabel=ratio)


@pytest.mark.full
def test_write_the_table():
    theirs = general_microseconds()
    rows = [["scipy least_squares from the truth, with covariance", f"{theirs:.0f}", "1"]]
    for method in METHODS:
        for chunk in CHUNKS:
            ours = microseconds(method, chunk)
            rows.append([f"{method}, chunks of {chunk}", f"{ours:.1f}", f"{theirs / ours:.0f}"])
    for kind in ("shor", "hull"):
        warm, ratio = relaxation_ratio(kind)
        rows.append([f"warm relaxation: {kind} ({ratio:.2f} times the bare Clarabel solve)", f"{warm:.0f}", ""])
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "not set")
    facts = (
        f"{COUNT} TDOA fixes with {STATIONS} stations, {SIGMA:g} m, half the emitters outside, fix and covariance; "
        f"numpy {np.__version__}, Python {platform.python_version()}, OPENBLAS_NUM_THREADS {threads}"
    )
    path = write("speed", ["what", "us each", "times faster than scipy"], rows, facts)
    assert path.is_file()
