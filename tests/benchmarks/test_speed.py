"""Times, for reading and not for judging: run as `pytest tests/benchmarks`, in a quiet moment."""

import os
import platform

import numpy as np
import pytest
from benchmarks.speed import (
    COUNT,
    SCENES,
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
@pytest.mark.parametrize("scene", SCENES)
def test_fixes(benchmark, scene, method, chunk):
    benchmark.group = f"{COUNT} six-station TDOA fixes: {scene}"
    found = benchmark.pedantic(fixes, (scene, method, chunk), rounds=5, warmup_rounds=1)
    benchmark.extra_info["us_per_fix"] = 1e6 * benchmark.stats.stats.min / COUNT
    answered = np.concatenate([fix.answered & np.isfinite(fix.cov).all((-1, -2)) for fix in found])
    assert answered.mean() > 0.99


@pytest.mark.parametrize("scene", SCENES)
def test_general_least_squares_from_the_truth(benchmark, scene):
    benchmark.group = "scipy.optimize.least_squares from the truth, exact derivatives"
    found = benchmark.pedantic(general, (scene,), rounds=3, warmup_rounds=1)
    ours = microseconds(scene, "gtrs+lsr", COUNT)
    theirs = 1e6 * benchmark.stats.stats.min / len(found)
    benchmark.extra_info.update(us_per_fix=theirs, us_per_fix_optloc=ours, ratio=theirs / ours)


@pytest.mark.full
def test_write_the_table():
    rows = []
    for scene in SCENES:
        theirs = general_microseconds(scene)
        rows.append([f"{scene}: scipy least_squares from the truth", f"{theirs:.0f}", "1"])
        for method in METHODS:
            for chunk in CHUNKS:
                ours = microseconds(scene, method, chunk, rounds=3)
                rows.append([f"{scene}: {method}, chunks of {chunk}", f"{ours:.1f}", f"{theirs / ours:.1f}"])
    for kind in ("shor", "hull"):
        warm, bare, only = relaxation_ratio(kind)
        what = f"warm relaxation: {kind} ({bare:.2f} x bare Clarabel on the same data, {only:.2f} x without its set-up)"
        rows.append([what, f"{warm:.0f}", ""])
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "not set")
    facts = (
        f"{COUNT} TDOA fixes with {STATIONS} stations, {SIGMA:g} m; fix and covariance; "
        f"numpy {np.__version__}, Python {platform.python_version()}, OPENBLAS_NUM_THREADS {threads}"
    )
    path = write("speed", ["what", "us each", "times faster than scipy"], rows, facts)
    assert path.is_file()
