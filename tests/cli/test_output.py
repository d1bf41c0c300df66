"""What commands print and write: sentences, strict JSON, tables, and outputs that are refused before the work."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from optloc import InvalidProblem
from optloc.cli import app
from optloc.cli.output import (
    Screen,
    claim_outputs,
    dumps,
    is_csv,
    meter,
    say_all,
    show_sheet,
    uses_standard_output,
    write_table,
    write_text,
)
from optloc.show.fix_answer import FixSheet

RUN = CliRunner()


def test_json_is_strict():
    assert json.loads(dumps({"a": np.array([1.0, np.nan]), "b": np.int64(3)})) == {"a": [1.0, None], "b": 3}


def test_sentences_begin_large_and_end_with_a_full_stop(capsys):
    say_all(Screen(), ["the fix is [ok]", "it has 3 \x1b[31mrows"])
    assert capsys.readouterr().out.splitlines()[0] == "The fix is [ok]."


def test_what_would_steer_the_terminal_is_spelled(capsys):
    Screen().print("a\x1b[31mb")
    assert "\x1b" not in capsys.readouterr().out


def test_numbers_of_a_table_stay_on_one_line_of_a_narrow_screen(capsys):
    screen = Screen()
    screen.width = 30
    cells = [f"{number}.123456" for number in range(1000, 1008)]
    show_sheet(FixSheet("Fixes", (*(f"x{i}, m" for i in range(8)), "status"), [(*cells, "ok, unchecked")]), screen)
    printed = capsys.readouterr().out
    assert all(cell in printed for cell in cells)


@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
def test_tables_are_read_back(name, tmp_path):
    columns = {"epoch": np.array(["a", "b"], dtype=object), "x": np.array([1 / 3, np.nan])}
    write_table(tmp_path / name, columns)
    found = (pd.read_csv if is_csv(Path(name)) else pd.read_parquet)(tmp_path / name)
    assert found.epoch.tolist() == ["a", "b"]
    assert np.array_equal(found.x.to_numpy(), columns["x"], equal_nan=True)


@pytest.mark.parametrize(
    ("given", "words"),
    [({"table": "t.doc"}, "results of type '.doc'"), ({"picture": "p.gif"}, "pictures of type '.gif'")],
)
def test_outputs_of_unknown_type_are_refused(given, words, tmp_path):
    with pytest.raises(InvalidProblem, match=words):
        claim_outputs(**{key: tmp_path / name for key, name in given.items()})
    claim_outputs(table=tmp_path / "t.csv", picture=tmp_path / "p.svg")


@pytest.mark.parametrize(
    "command", [["fix", "demo"], ["track", "run"], pytest.param(["check", "run"], marks=pytest.mark.slow)]
)
def test_results_on_standard_output_are_the_table_alone(command, tmp_path):
    stored = tmp_path / "results.csv"
    wanted = RUN.invoke(app, [*command, "--out", str(stored)])
    found = RUN.invoke(app, [*command, "--out", "-"])
    assert found.exit_code == wanted.exit_code
    assert found.stdout_bytes == stored.read_bytes()
    assert found.stderr.splitlines()[0] == wanted.stdout.splitlines()[0]  # the text for people


def test_one_output_has_standard_output():
    assert not uses_standard_output(None, Path("a.csv"), as_json=True)
    assert uses_standard_output(Path("-"), None)
    with pytest.raises(InvalidProblem, match="name a file"):
        uses_standard_output(Path("-"), Path("-"))
    with pytest.raises(InvalidProblem, match="name a file"):
        uses_standard_output(Path("-"), as_json=True)
    with pytest.raises(InvalidProblem, match=r"a picture is no text.*\.png"):
        claim_outputs(picture=Path("-"))


def test_a_minus_is_standard_output(tmp_path, capsys):
    write_text(Path("-"), "a line")
    write_text(tmp_path / "a.txt", "a line")
    assert capsys.readouterr().out == (tmp_path / "a.txt").read_text() == "a line\n"


def test_a_notebook_has_no_bars_although_its_commands_see_a_terminal(monkeypatch):
    monkeypatch.delenv("JPY_PARENT_PID", raising=False)
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    assert Screen(stderr=True).shows_bars
    monkeypatch.setenv("JPY_PARENT_PID", "1")
    assert not Screen(stderr=True).shows_bars


def test_a_quiet_meter_prints_nothing(capsys):
    with meter("work", quiet=True) as tell:
        tell(1, 2)
    assert capsys.readouterr() == ("", "")
