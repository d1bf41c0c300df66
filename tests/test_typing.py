"""Scripts of users under ``mypy --strict``: the planted errors are found, and nothing else."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).with_name("typing")
ROOT = SCRIPTS.parents[1]
# Line and code of each planted error.
PLANTED = {
    ("wrong_status.py", 6, "comparison-overlap"),
    ("wrong_arguments.py", 5, "call-overload"),
    ("wrong_arguments.py", 6, "call-overload"),
}
RIGHT = sorted(path for path in SCRIPTS.glob("*.py") if not path.name.startswith("wrong"))


@pytest.mark.skipif(importlib.util.find_spec("mypy") is None, reason="mypy is not installed: pip install '.[lint]'")
def test_mypy_finds_the_planted_errors_and_nothing_else():
    cache = os.environ.get("OPTLOC_MYPY_CACHE", ".mypy_cache")
    words = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", cache, *map(str, sorted(SCRIPTS.glob("*.py")))]
    text = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT).stdout
    errors = re.findall(r"([\w.]+):(\d+): error: .*\[([\w-]+)\]", text)
    assert {(name, int(line), code) for name, line, code in errors} == PLANTED
    assert len(errors) == len(PLANTED)


@pytest.mark.parametrize("path", RIGHT, ids=lambda path: path.stem)
def test_a_script_without_a_planted_error_runs(path):
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), {"__name__": "__main__"})
