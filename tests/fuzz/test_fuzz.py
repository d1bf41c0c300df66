"""Whatever is in a file, a command ends with an answer or one sentence, in time, and what reads is read rightly.

Cases are mutations (`fuzz.mutations`) of everything that optloc ships (`fuzz.originals`), of foreign tables, recordings
and checkpoints of streams, and folders of studies (`fuzz.surfaces`). Each runs in a fork of one warm process
(`fuzz.harness`). A problem file that reads is compared with a plain re-reading of it (`fuzz.plain`, `fuzz.oracle`).
"""

import json
import os
import random
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from fuzz import mutations, plain
from fuzz.cases import case_of
from fuzz.found import FOUND
from fuzz.harness import outcome
from monte_carlo.tables import code_digest
from typer.testing import CliRunner

import optloc
from optloc.cli import app

HERE = Path(__file__).parent
FEW, ALONE = 5, 1
# Of a seed, of which there are ten in full: 20 000 cases in parts of about ten minutes of one processor.
PARTS, PART = 4, 500
# Least share of the cases of a part that are problems which read as their plain re-reading does; 0.11 were measured.
READ = 0.05


def run(seed, first, count):
    """Return the faults of some cases and the counts of what became of them, of a process of their own."""
    paths = os.pathsep.join([str(HERE.parent), str(Path(optloc.__file__).parents[1])])
    given = {**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1", "NO_COLOR": "1"}
    command = [sys.executable, "-m", "fuzz.harness", str(seed), str(first), str(count)]
    done = subprocess.run(command, env=given, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_mutated_files_end_in_an_answer_or_one_sentence(seed):
    found = run(seed, 0, FEW)
    assert not found["faults"], "\n".join(found["faults"])
    counts = found["counts"]
    assert sum(number for what, number in counts.items() if what.startswith("exit ")) == FEW
    # Most of the problems that are read are judged.
    assert counts.get("same", 0) + counts.get("same fix", 0) >= counts.get("not judged", 0)


@pytest.mark.parametrize("number", range(ALONE))
def test_the_real_command_line_does_what_its_fork_does(number, seed, tmp_path):
    case = case_of(seed, 1000 + number)
    for name, data in case.files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(data)
    given = {**os.environ, "PYTHONPATH": str(Path(optloc.__file__).parents[1])}
    command = [sys.executable, "-m", "optloc.cli", *case.arguments]
    done = subprocess.run(command, cwd=tmp_path, env=given, capture_output=True, text=True, check=False)
    assert not outcome(done.returncode, done.stderr)


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_once_is_one_sentence(name, tmp_path, monkeypatch):
    arguments, files, words = FOUND[name]
    for path, text in files.items():
        (tmp_path / path).write_bytes(text if isinstance(text, bytes) else text.encode())
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", RuntimeWarning)
        result = CliRunner().invoke(app, arguments)
    assert not [str(one.message) for one in warned if one.category is RuntimeWarning]
    if words is None:
        assert result.exit_code in (0, 1), result.output
        return
    assert result.exit_code == 2, result.output
    for word in words:
        assert word in result.stderr
    assert not outcome(result.exit_code, result.stderr)


def test_cases_and_mutations_are_the_same_each_time():
    assert case_of(3, 14) == case_of(3, 14)
    text = "format = 1\nz = [1.0, 2.0]\n"
    for mutation in mutations.TOKENS:
        assert mutation(random.Random(1), text) == mutation(random.Random(1), text)


def test_the_oracle_sees_a_wrong_number(tmp_path):
    from fuzz.oracle import differences
    from fuzz.originals import problems

    from optloc.files import read

    (tmp_path / "p.toml").write_bytes(problems()["elevation.toml"]["elevation.toml"])
    problem = read(tmp_path / "p.toml").problem
    own = plain.read(tmp_path / "p.toml")
    assert not differences(own, problem)
    own.rows[5].z += 1e-7
    assert "row 5: z" in differences(own, problem)


def parts(config, seed, part):
    """Return what is stored of a part of the full run, and a function that stores it; of other code it is none."""
    key = f"optloc/fuzz/{seed}/{part}"
    stored = config.cache.get(key, {})
    known = stored.get("found") if stored.get("code") == digest() else None
    return known, lambda found: config.cache.set(key, {"code": digest(), "found": found})


def digest():
    """Return what tells this state of the package and of the cases from others."""
    return code_digest(*HERE.glob("*.py"))


@pytest.mark.full
@pytest.mark.parametrize("part", range(PARTS))
def test_mutated_files_in_full(part, seed, pytestconfig):
    """Parts are stored as they are done: a run that was stopped goes on where it was."""
    known, store = parts(pytestconfig, seed, part)
    found = run(seed, part * PART, PART) if known is None else known
    store(found)
    assert not found["faults"], "\n".join(found["faults"])
    assert found["counts"].get("same", 0) + found["counts"].get("same fix", 0) >= READ * PART
