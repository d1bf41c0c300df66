"""The first proofs of a process are those of every later one: plain Python begins them, machine code goes on."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from often import few

from optloc import Status, assemble, measured, solve
from optloc.kernels.jit import FEW, _Kernel, enabled
from optloc.proof import batch, best_first
from optloc.proof.batch import FIRST_BOXES

needs_code = pytest.mark.skipif(not enabled(), reason="without machine code every call is like the first")
KERNELS = (batch._loop, batch._evaluate, best_first.without_unused_nodes)


def drawn(kind: str, d: int, count: int, size: int, seed: int):
    """Return a batch of problems with rather large noise, a quarter of them of targets far outside."""
    rng = np.random.default_rng(seed)
    sides = np.array([1e4, 1e4, 4e3])[:d]
    place, x = rng.uniform(-0.5, 0.5, (size, count, d)) * sides, rng.uniform(-1.0, 1.0, (size, d)) * sides
    x[: size // 4] *= 4.0
    apart = x[:, None] - place
    r = np.linalg.norm(apart, axis=-1)
    pairs = {"a": np.arange(1, count), "b": 0}
    value, sigma, ends = {
        "tdoa": lambda: (r[:, 1:] - r[:, :1], 20.0, pairs),
        "range": lambda: (r, 20.0, {"a": np.arange(count)}),
        "toa": lambda: (r + 1e3, 20.0, {"a": np.arange(count)}),
        "groa": lambda: (r[:, 1:] / r[:, :1], 0.02, pairs),
        "range_sum": lambda: (r[:, 1:] + r[:, :1], 20.0, pairs),
        "azimuth": lambda: (np.arctan2(apart[..., 1], apart[..., 0]), 0.02, {"a": np.arange(count)}),
    }[kind]()
    return assemble(
        place[:, None], measured(kind, value + sigma * rng.standard_normal(value.shape), sigma=sigma, **ends)
    )


CASES = [
    ("tdoa", 2, 4, 16, 3),
    ("toa", 2, 5, 9, 6),
    ("range", 3, 4, 16, 7),
    ("groa", 2, 4, 16, 8),
    ("azimuth", 2, 3, 16, 10),
    ("tdoa", 2, 5, 16, 4),
    ("tdoa", 3, 6, 12, 5),
    ("range_sum", 3, 4, 15, 9),
    ("tdoa", 2, 4, 1, 3),
]


def told(problem) -> list:
    fix = solve(problem)
    claims = np.ravel(np.asarray(fix.certificate, dtype=object))
    labels = [Status(int(code)).label for code in np.ravel(fix.code)]
    return [(label, one.proof, one.unique, one.margin) for label, one in zip(labels, claims, strict=True)]


@needs_code
@pytest.mark.parametrize("case", few(CASES, 5), ids=lambda case: "-".join(map(str, case)))
def test_the_first_call_says_what_later_calls_say(case, monkeypatch):
    """A process that has not used machine code yet begins a few proofs with few boxes each."""
    problem = drawn(*case)
    for kernel in KERNELS:
        assert isinstance(kernel, _Kernel)
        monkeypatch.setattr(kernel, "asked", 0)
        monkeypatch.setattr(kernel, "ready", False)
    first = told(problem)
    assert told(problem) == told(problem) == first


def test_who_ran_out_of_few_boxes_goes_on(monkeypatch):
    """A proof that used its few boxes up may have shown less than it would have with more."""
    budgets = []

    def proved(costs, asked):
        budgets.append(asked.budget.copy())
        out = batch.empty_answer(len(asked.x), 2)
        out.boxes[:] = np.minimum(asked.budget, [7, 25, 90][: len(asked.x)] if len(budgets) == 1 else 1000)
        return out

    monkeypatch.setattr(batch, "_prove", proved)
    monkeypatch.setattr(batch, "enabled", lambda: True)
    monkeypatch.setattr(batch, "may_use_code", lambda kernel, count: True)
    n = 3
    asked = batch.ProofRequest(*(np.zeros((n, 2)) for _ in batch.ProofRequest._fields))._replace(
        budget=np.array([3000, 3000, 60])
    )
    costs = batch.PositionCosts(
        np.zeros(1, np.int64), np.zeros((1, 1, 1)), np.zeros((1, 1, 1)), np.zeros((n, 1)), np.zeros(n)
    )
    monkeypatch.setattr(batch, "FIRST_BOXES", 75)
    answer = batch._prove_few(costs, asked)
    assert budgets[0].tolist() == [25, 25, 25]
    assert budgets[1].tolist() == [3000, 60]  # the second and the third, each with all of its own
    assert answer.boxes.tolist() == [7, 1000, 60]


def test_few_boxes_are_counted_and_not_timed():
    assert FIRST_BOXES // FEW > 0
    source = Path(batch.__file__).read_text("utf-8")
    assert "perf_counter" not in source
    assert "monotonic" not in source


@needs_code
@pytest.mark.slow
@pytest.mark.parametrize("case", few(CASES[:6], 2), ids=lambda case: "-".join(map(str, case)))
def test_the_first_call_of_a_fresh_process(case):
    """Machine code is on disk: the process that runs this test has used it."""
    told(drawn(*case))
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); from proof.test_first_call import drawn, told; "
        f"problem = drawn(*{case!r}); said = [told(problem) for _ in range(3)]; "
        "assert said[0] == said[1] == said[2], said"
    )
    tests = str(Path(__file__).resolve().parents[1])
    done = subprocess.run(
        [sys.executable, "-c", code, tests],
        capture_output=True,
        text=True,
        env={**os.environ, "OPTLOC_COMPILE": "wait"},
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
