"""optloc study: bad commands are one sentence; a study runs, tells its state and is compared."""

from collections import Counter
from io import StringIO
from math import inf
from types import SimpleNamespace

import pytest
from lab.study.test_design import sentence
from lab.study.texts import QUICK
from rich.console import Console
from typer.testing import CliRunner

from optloc.cli import app, show_sheet
from optloc.lab.commands.study import _in_words, _quartiles, _show_pairs, _status_sheet
from optloc.lab.study.paired import Median, Pair

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


@pytest.mark.parametrize("width", [80, 120, 300])
def test_headings_of_statuses_are_whole_words_at_any_width(width):
    statuses = [
        "ok",
        "unproven",
        "too few rows",
        "singular geometry",
        "max iterations",
        "contradictory",
        "disconnected",
    ]
    methods = {(f"method number {i} of many", name): 7 for i in range(2) for name in statuses}
    found = SimpleNamespace(counts=dict.fromkeys(statuses, 14), methods=methods)
    stream = StringIO()
    show_sheet(_status_sheet(found, width), Console(file=stream, width=width))
    text = stream.getvalue()
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    words = {word for name in statuses for word in name.split()}
    assert words <= set(text.replace("│", " ").replace("┃", " ").split())


def test_headings_of_pairs_fit_in_80_characters():
    medians = Median(-0.12, -0.34, 0.11, 0.5), Median(1.2, 0.98, 1.4, 0.5)
    share = (0.5, 0.4, 0.6)
    one = Pair("case", "1 ns", "gauss-newton from the box", "auto", 100, 12, 13, *share, 0.031, *medians)
    stream = StringIO()
    _show_pairs([one], Console(file=stream, width=80))
    lines = stream.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    text = " ".join(" ".join(line.replace("┃", " ").replace("│", " ").split()) for line in lines)
    for word in ("difference,", "ratio", "trials", "right", "gauss-newton", "[-0.34, 0.11]"):
        assert word in text
