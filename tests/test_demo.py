"""`optloc demo` right after installation: each section has the status that its text states, without machine code."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from progress import without_progress
from typer.testing import CliRunner

import optloc
from optloc import Status, solve
from optloc.cli.application import app
from optloc.cli.options import shipped_problems
from optloc.kernels.jit import plain

SECTIONS = [("1. A fix", "ok"), ("2. Two possible places", "ambiguous"), ("3. A registration", "ok")]
# Seconds from the prompt to the last section, on two processors that have nothing else to do.
PATIENCE = 20.0
EMITTER, CLOCKS = [14e3, 16e3], [1200.0, -800.0, 2100.0]
METRES_PER_NS = 0.299792458


def check(text):
    """Compare the titles of a demo, the statuses in its texts and the statuses in its tables with the known ones."""
    ends = re.search("^ +Next *$", text, re.MULTILINE)
    assert ends
    _, *parts = re.split(r"^ *(\d\. .*?) *$", text[: ends.start()], flags=re.MULTILINE)
    titles, bodies = parts[::2], parts[1::2]
    stated = [re.findall(r"The status is (\w+)", " ".join(body.split())) for body in bodies]
    printed = [re.findall(r"^│ status +│ (\w+)", body, re.MULTILINE) for body in bodies]
    assert titles == [title for title, _ in SECTIONS]
    assert stated == printed == [[status] for _, status in SECTIONS]
    assert "unproven" not in text


def test_the_check_of_a_demo_refuses_other_statuses():
    table = "{}\nThe status is {}.\n│ status │ {} │\n"
    text = "".join(table.format(title, status, status) for title, status in SECTIONS) + "   Next  \n"
    check(text)
    with pytest.raises(AssertionError):
        check(text.replace("│ ok", "│ unproven"))
    with pytest.raises(AssertionError):
        check(text.replace("is ok", "is ambiguous"))


@pytest.mark.slow
def test_a_fresh_installation_finishes_every_proof_in_time(tmp_path):
    cache, folder = tmp_path / "cache", tmp_path / "folder"
    folder.mkdir()
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "OPTLOC_COMPILE": "never"}
    environment["PYTHONPATH"] = str(Path(optloc.__file__).parents[1])
    before = os.times()
    done = subprocess.run(
        [sys.executable, "-m", "optloc.cli", "demo"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )
    after = os.times()
    assert done.returncode == 0, done.stderr
    check(done.stdout)
    assert without_progress(done.stderr) == []  # progress of a compilation would be here
    assert not [path for path in cache.rglob("*") if path.is_file()]
    # Processor time, as other processes may use the processors during a test.
    used = after.children_user + after.children_system - before.children_user - before.children_system
    assert used < PATIENCE


@pytest.mark.slow
def test_machine_code_gives_the_same_statuses(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["demo"])
    assert result.exit_code == 0, result.output
    check(result.stdout)
    for words in ("Alternatives", "Biases", "optloc new tdoa"):
        assert words in result.stdout
    assert (tmp_path / "optloc-demo.png").read_bytes().startswith(b"\x89PNG")
    assert "\x1b" not in result.output
    (tmp_path / "optloc-demo.png").unlink()
    silent = CliRunner().invoke(app, ["demo", "--quiet"])
    assert (silent.exit_code, silent.output) == (0, "")


def test_the_registration_finds_the_known_emitter_and_clocks():
    problem = optloc.load(shipped_problems()["clocks"])
    with plain():
        fix = solve(problem)
    assert fix.status == Status.OK
    assert (fix.certificate.proof, fix.certificate.unique) == ("global", True)
    error = fix.x - [*EMITTER, *(METRES_PER_NS * np.array(CLOCKS))]
    assert error @ np.linalg.solve(fix.cov, error) < 20.5  # quantile 0.999 of five unknowns


def test_a_fix_that_ignores_the_clocks_is_as_wrong_as_the_demo_states():
    problem = optloc.load(shipped_problems()["clocks"])
    fix = solve(replace(problem, biases=()))
    assert np.linalg.norm(fix.position - EMITTER) > 4000.0
    assert fix.status == Status.MISFIT
