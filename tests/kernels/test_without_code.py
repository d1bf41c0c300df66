"""Where there is no machine code yet: few fixes are answered at once, batches as OPTLOC_COMPILE says."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from progress import without_progress

import optloc
from optloc import InvalidProblem
from optloc.cli.compile import parts
from optloc.kernels.jit import enabled, may_use_code, names_in
from optloc.proof.batch import _loop

pytestmark = pytest.mark.skipif(not enabled(), reason="without numba there is no machine code")

# Fixes of some problems with nothing on disk; what was compiled, what was proven, and why not.
FIXES = """
import sys
from collections import Counter

import numpy as np
from optloc import assemble, measured, prepare, simulate, solve
from optloc.kernels import jit

begun, callers = [], []
jit.start_background_compiler = lambda: begun.append(1)
original = jit._Kernel._prepare
jit._Kernel._prepare = lambda self, args: (callers.append(self.name), original(self, args))
count, sigma = int(sys.argv[1]), float(sys.argv[2])
place = 1e3 * np.array([[0.0, 0, 0], [10, 0, 1], [0, 10, 2], [-9, 1, 0.5], [1, -8, 3], [6, 7, 0]])
rows = measured("tdoa", a=[1, 2, 3, 4, 5], b=[0] * 5, arrival_sigma=sigma)
bare = assemble(place, rows)
problem = simulate(bare, [2e3, 3e3, 4e3], 1, count).flat()
fix = solve(problem)
assert prepare(bare)(problem.z[0]).answered
proofs = Counter(proof.proof for proof in fix.certificate)
said = sum("optloc compile" in proof.reason for proof in fix.certificate)
assert not callers, callers
print(len(jit._DONE), len(begun), proofs["global"], proofs["unknown"], said)
"""


def fixes(folder, count, sigma, **environment):
    everything = {name: value for name, value in os.environ.items() if name != "OPTLOC_COMPILE"}
    everything |= {"PYTHONPATH": str(Path(optloc.__file__).parents[1]), "NUMBA_CACHE_DIR": str(folder), **environment}
    command = [sys.executable, "-c", FIXES, str(count), str(sigma)]
    done = subprocess.run(command, env=everything, capture_output=True, text=True, check=False)
    assert not without_progress(done.stderr)
    return [int(word) for word in done.stdout.split()]


def test_few_fixes_are_proven_without_a_compiler(tmp_path):
    assert fixes(tmp_path, 3, 5.0) == [0, 0, 3, 0, 0]


def test_a_batch_goes_on_in_plain_python_while_a_child_compiles(tmp_path):
    compiled, begun, proven, unknown, said = fixes(tmp_path, 24, 5.0, OPTLOC_COMPILE="child")
    assert (compiled, begun > 0) == (0, True)
    assert proven + unknown == 24
    assert proven > 20
    assert said == unknown


@pytest.mark.parametrize(
    ("way", "few", "many"), [("", False, True), ("wait", True, True), ("child", False, False), ("never", False, False)]
)
def test_who_waits(monkeypatch, way, few, many):
    begun = []
    monkeypatch.setattr("optloc.kernels.jit.is_cached", lambda name: False)
    monkeypatch.setattr("optloc.kernels.jit.start_background_compiler", lambda: begun.append(1))
    monkeypatch.setattr(_loop, "ready", False)
    monkeypatch.setattr(_loop, "seen", False)
    monkeypatch.setenv("OPTLOC_COMPILE", way)
    assert (may_use_code(_loop, 16), may_use_code(_loop, 17)) == (few, many)
    assert len(begun) == (way == "child")


def test_another_way_is_named(monkeypatch):
    monkeypatch.setattr("optloc.kernels.jit.is_cached", lambda name: False)
    monkeypatch.setattr(_loop, "ready", False)
    monkeypatch.setattr(_loop, "seen", False)
    monkeypatch.setenv("OPTLOC_COMPILE", "later")
    with pytest.raises(InvalidProblem, match=r"'later'.*wait, child, never"):
        may_use_code(_loop, 1)


def test_entries_are_kernels_that_there_are():
    for part in parts().values():
        for name in part.entries:
            module, _, _ = name.rpartition(".")
            import_module(module)
            assert name in names_in("optloc")


ASKS = """
import os, sys
from optloc.cli.application import app
try:
    app(sys.argv[1:])
except SystemExit:
    pass
print(os.environ.get("OPTLOC_COMPILE"))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="has no such terminals")
@pytest.mark.parametrize(
    ("command", "looked_at", "way"),
    [("list kinds", True, "child"), ("list kinds", False, None), ("study list", True, None)],
)
def test_who_looks_on_does_not_wait(command, looked_at, way):
    """At a terminal a process in the background makes machine code; a script, or a study, waits for it."""
    import pty

    everything = {name: value for name, value in os.environ.items() if name != "OPTLOC_COMPILE"}
    kept, terminal = pty.openpty()
    try:
        done = subprocess.run(
            [sys.executable, "-c", ASKS, *command.split()],
            stdout=subprocess.PIPE,
            stderr=terminal if looked_at else subprocess.DEVNULL,
            env=everything,
            text=True,
            check=True,
        )
    finally:
        os.close(kept)
        os.close(terminal)
    assert done.stdout.split()[-1] == str(way)


# The fix of a run of moving stations, whose proof takes sparse rows.
RUN = """
import numpy as np
import optloc
from optloc.kernels import jit

rng = np.random.default_rng(1)
places = rng.uniform(-1e4, 1e4, (6, 3)) + 10.0 * np.arange(6)[:, None, None] * rng.uniform(-100.0, 100.0, (6, 3))
rows = optloc.measured("range", a=np.tile(np.arange(6), 6), epoch=np.repeat(np.arange(6), 6), sigma=1.0)
problem = optloc.simulate(optloc.assemble(optloc.Stations(places, tuple("ABCDEF")), rows), [2e3, 3e3, 4e3], 1)
print(optloc.solve(problem).status.label, len(jit._DONE))
"""


def test_runs_are_fixed_without_a_compiler(tmp_path):
    given = {**os.environ, "PYTHONPATH": str(Path(optloc.__file__).parents[1]), "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", RUN]
    done = subprocess.run(command, env=given | {"OPTLOC_COMPILE": "never"}, capture_output=True, text=True, check=True)
    assert not without_progress(done.stderr)
    status, compiled = done.stdout.split()
    assert status in ("ok", "unproven")
    assert compiled == "0"
