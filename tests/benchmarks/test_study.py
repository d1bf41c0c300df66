"""What studies cost beside their solvers: run as `pytest tests/benchmarks/test_study.py`, in a quiet moment."""

import resource
from time import perf_counter

import pytest
from lab.study.texts import design

from optloc.lab.study.design import workers
from optloc.lab.study.execute import executor, run_design
from optloc.lab.study.folder import read_frame

MILLION = """
format = 1
name = "million"
trials = 1_000_000
[[scenario]]
name = "six stations"
layout = { stations = 6 }
truth = { kind = "box", box = ["10 km", "10 km", "6 km"] }
noise = ["10 m"]
[[method]]
method = "gtrs+lsr"
"""
SLOW = MILLION.replace("1_000_000", "2000").replace('"gtrs+lsr"', '"socp"\nchunk = 500')


@pytest.mark.full
def test_a_million_fixes_in_two_minutes_and_two_gigabytes(tmp_path):
    began = perf_counter()
    found = run_design(design(MILLION), tmp_path / "out", executor("processes", 2))
    seconds = perf_counter() - began
    own, theirs = (resource.getrusage(who).ru_maxrss / 1e6 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(f"{found.rows} fixes in {seconds:.1f} s; memory {own:.2f} GB here, {theirs:.2f} GB at most in a worker")  # noqa: T201  (what a benchmark is for)
    assert found.complete
    assert seconds < 120.0
    assert own + 2.0 * theirs < 2.0


@pytest.mark.full
@pytest.mark.skipif(workers() < 2, reason="needs two processors")
def test_two_workers_do_the_work_of_nearly_two(tmp_path):
    """The rate after the first parts of each worker, so that beginning processes does not count; quietest of rounds."""
    text = SLOW.replace("2000", "16_000").replace("chunk = 500", "chunk = 1000")
    rates = {1: 0.0, 2: 0.0}
    for i in range(3):
        for jobs in (1, 2):
            told: list[tuple[float, int]] = []
            by, out = executor("processes", jobs), tmp_path / f"{i}-{jobs}"
            run_design(design(text), out, by, lambda rows, _, told=told: told.append((perf_counter(), rows)))
            steady = told[2 * jobs :]
            rate = sum(rows for _, rows in steady[1:]) / (steady[-1][0] - steady[0][0])
            rates[jobs] = max(rates[jobs], rate)
    print(f"two workers are {rates[2] / rates[1]:.2f} times as fast as one")  # noqa: T201  (what a benchmark is for)
    assert rates[2] > 1.7 * rates[1]


def test_overhead_of_the_machinery_at_tasks_of_a_millisecond(tmp_path):
    """Everything but the solver, storing included, costs less than a tenth of the solver's time."""
    told: list[float] = []
    run_design(design(SLOW), tmp_path / "out", executor("processes", 1), lambda *_: told.append(perf_counter()))
    # From the first part on: processes and machine code have begun by then.
    frame = read_frame(tmp_path / "out", ["chunk", "trial", "seconds"])
    first = frame["chunk"] == frame["chunk"][frame["trial"] == 0].iloc[0]
    rows, solver, whole = int((~first).sum()), float(frame["seconds"][~first].sum()), told[-1] - told[0]
    each = 1e3 * solver / rows
    print(f"{each:.2f} ms a fix, {1e6 * (whole - solver) / rows:.0f} us beside it: {whole / solver - 1.0:.1%}")  # noqa: T201  (what a benchmark is for)
    assert (whole - solver) / rows < 0.1 * max(solver / rows, 1e-3)
