"""A cold machine: processor time of the first fixes with machine code at hand and without, and of making it."""

import os
import resource
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import numba
import pytest
from monte_carlo.tables import write

import optloc
from optloc.kernels.jit import enabled

pytestmark = pytest.mark.skipif(not enabled(), reason="times of machine code")
# Ten thousand proven fixes as a program's first ones.
BATCH = """
import numpy as np
from optloc import assemble, measured, simulate, solve

place = 1e3 * np.array([[0.0, 0, 0], [10, 0, 1], [0, 10, 2], [-9, 1, 0.5], [1, -8, 3], [6, 7, 0]])
rows = measured("tdoa", a=[1, 2, 3, 4, 5], b=[0] * 5, arrival_sigma=5.0)
fix = solve(simulate(assemble(place, rows), [2e3, 3e3, 4e3], 1, 10_000))
assert fix.answered.all()
"""
FIRST = ("-m", "optloc.cli", "fix", "demo", "--quiet")


def spent(folder, *arguments):
    """Return processor time and time of a fresh interpreter, s, whose machine code is in a folder."""
    known = {name: value for name, value in os.environ.items() if not name.startswith("OPTLOC_COMPILE")}
    known |= {"PYTHONPATH": str(Path(optloc.__file__).parents[1]), "NUMBA_CACHE_DIR": str(folder)}
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter()
    subprocess.run([sys.executable, "-P", *arguments], env=known, stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, perf_counter() - began


@pytest.mark.full
def test_write_the_table(tmp_path):
    first = spent(tmp_path / "none", *FIRST)
    made = spent(tmp_path / "made", "-m", "optloc.cli", "compile")
    at_hand = spent(tmp_path / "made", *FIRST)
    batch = spent(tmp_path / "made", "-c", BATCH)
    figures = {
        "`optloc fix demo`, with stored machine code": at_hand,
        "a program that proves 10 000 fixes, with stored machine code": batch,
        "`optloc fix demo`, without stored machine code": first,
        "`optloc compile`, from nothing": made,
    }
    rows = [[name, *(f"{seconds:.1f}" for seconds in times)] for name, times in figures.items()]
    facts = f"numba {numba.__version__}, {os.cpu_count()} cores; start of Python and imports included"
    assert write("cold", ["first call of a process", "processor time, s", "time, s"], rows, facts).is_file()
    assert first[0] < 2.0 * at_hand[0] < 0.1 * made[0]  # nothing is compiled for one fix
