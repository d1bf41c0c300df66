"""Nobody waits in silence for machine code: a compiler that sleeps is spoken of all the time."""

import os
import select
import subprocess
import sys
from pathlib import Path
from time import monotonic

import pytest

import optloc
from optloc.kernels.jit import enabled

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(optloc.__file__).parents[1])}
# A compiler that takes its time: kernels of three seconds and of about one, of which nothing is kept.
SLEEPS = """
import time

from optloc.kernels import jit


class Sleeps:
    def __init__(self, seconds, made):
        self.seconds, self.made = seconds, made

    def typeof_pyval(self, value):
        return type(value)

    def compile(self, types):
        if self.made:
            jit._report("optloc.proof.slow", False)
        time.sleep(self.seconds)
        if self.made:
            jit._report("optloc.proof.slow", True)

    def __call__(self, value):
        return value


def run(made, *times):
    for seconds in times:
        kernel = jit.compiled(lambda value: value)
        kernel._forms[False] = Sleeps(seconds, made)
        assert kernel(7) == 7
"""


pytestmark = pytest.mark.skipif(not enabled(), reason="without numba nothing is compiled")


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="pipes cannot be waited for")
def test_standard_error_is_never_quiet_for_long():
    code = SLEEPS + "run(True, 3.0, 1.2, 0.9)"
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, env=ENVIRONMENT) as process:
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


@pytest.mark.parametrize(
    ("code", "line"),
    [
        ("run(False, 2.4)", "loading machine code\n"),
        ("from optloc.kernels.progress import keep_quiet\nkeep_quiet(True)\nrun(True, 2.4)", ""),
    ],
)
def test_loading_is_no_compilation_and_quiet_is_quiet(code, line):
    done = subprocess.run(
        [sys.executable, "-c", SLEEPS + code], env=ENVIRONMENT, capture_output=True, text=True, check=True
    )
    assert done.stderr == line


def test_a_cell_of_a_notebook_stores_no_progress():
    """Jupyter sets the variable for its kernels, and shell commands of a cell inherit it."""
    code = SLEEPS + "run(False, 2.4)"
    environment = ENVIRONMENT | {"JPY_PARENT_PID": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    shown = "import logging\nlogging.basicConfig(level=logging.INFO, format='%(message)s')\n" + code
    done = subprocess.run([sys.executable, "-c", shown], env=environment, capture_output=True, text=True, check=True)
    assert "loading machine code\n" in done.stderr


def test_the_option_quiet_switches_progress_off_and_its_absence_on():
    from typer.testing import CliRunner

    from optloc.cli import app
    from optloc.kernels.progress import Reporter

    for options, quiet in ((["--quiet"], True), ([], False)):
        assert CliRunner().invoke(app, ["new", "range", *options]).exit_code == 0
        assert Reporter.quiet == quiet
