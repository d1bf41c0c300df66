"""optloc study: bad commands are one sentence; a study runs, tells its state and is compared."""

from collections import Counter
from math import inf

import pytest
from lab.study.test_design import sentence
from lab.study.texts import QUICK
from typer.testing import CliRunner

from optloc.cli import app
from optloc.lab.commands.study import _in_words, _quartiles

RUN = CliRunner()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "divergense"], "did you mean 'divergence'"),
        (["run", "nowhere.toml"], "no such file"),
        (["run", "groa", "--executor", "procesess"], "did you mean 'processes'"),
        (["run", "groa", "--executor", "in-process"], "unknown executor 'in-process'"),
        (["run", "groa", "--task-limit", "0"], "the limit 0 s is out of range"),
        (["run", "groa", "--task-limit", "nan"], "the limit nan s is out of range"),
        (["status", "."], "contains no study"),
        (["compare", ".", "."], "contains no study"),
    ],
)
def test_bad_commands_are_one_sentence(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert words in sentence(RUN.invoke(app, ["study", *arguments]))


def test_run_status_and_compare(tmp_path):
    (tmp_path / "s.toml").write_text(QUICK)
    out = str(tmp_path / "out")
    made = RUN.invoke(app, ["study", "run", str(tmp_path / "s.toml"), "--out", out, "-j", "1"])
    assert made.exit_code == 0, made.output
    assert "complete, 180 of 180 rows" in made.stdout
    state = RUN.invoke(app, ["study", "status", out, "--json"])
    assert state.exit_code == 0
    assert '"rows": 180' in state.stdout
    both = RUN.invoke(app, ["study", "compare", out, out], env={"COLUMNS": "200"})
    assert both.exit_code == 0
    assert "identical" in both.stdout
    next((tmp_path / "out" / "parts").glob("*.parquet")).unlink()
    assert RUN.invoke(app, ["study", "status", out]).exit_code == 1


def test_counts_are_told_by_the_most_common():
    assert _in_words(Counter(ok=7, misfit=2)) == "ok 7, misfit 2"
    assert _in_words(Counter(ok=7, misfit=4, ambiguous=3, stalled=2, died=1)) == "ok 7, misfit 4, ambiguous 3, other 3"


def test_quartiles_stand_around_the_median():
    assert _quartiles((2.0, 3.5, inf)) == "3.5 [2, ∞]"
    assert _quartiles(None) == "-"
