"""Nobody waits in silence for machine code: a compiler that sleeps is spoken of all the time."""

import os
import select
import subprocess
import sys
from pathlib import Path
from time import monotonic

import pytest

import optloc
from optloc.compute.jit import enabled

# A compiler that takes its time: kernels of three seconds and of about one, of which nothing is kept.
SLEEPS = """
import time

from optloc.compute import jit


class Sleeps:
    def __init__(self, seconds):
        self.seconds = seconds

    def typeof_pyval(self, value):
        return type(value)

    def compile(self, types):
        jit._report("optloc.proof.slow", False)
        time.sleep(self.seconds)
        jit._report("optloc.proof.slow", True)

    def __call__(self, value):
        return value


for seconds in (3.0, 1.2, 0.9):
    kernel = jit.compiled(lambda value: value)
    kernel._forms[False] = Sleeps(seconds)
    assert kernel(7) == 7
"""


@pytest.mark.slow
@pytest.mark.skipif(not enabled(), reason="without numba nothing is compiled")
@pytest.mark.skipif(os.name == "nt", reason="pipes cannot be waited for")
def test_standard_error_is_never_quiet_for_long():
    environment = {**os.environ, "PYTHONPATH": str(Path(optloc.__file__).parents[1])}
    with subprocess.Popen([sys.executable, "-c", SLEEPS], stderr=subprocess.PIPE, env=environment) as process:
        said, gaps, last = b"", [], None
        while select.select([process.stderr], [], [], 60.0)[0]:
            more = os.read(process.stderr.fileno(), 4096)
            if not more:
                break
            said += more
            if last is not None:
                gaps.append(monotonic() - last)
            last = monotonic()
        tail = monotonic() - last
    assert process.returncode == 0, said
    lines = said.decode().splitlines()
    assert 2 <= len(lines) <= 4, lines
    assert all("making machine code: " in line and "functions" in line for line in lines)
    assert max(gaps) < 2.5
    assert tail < 4.0
