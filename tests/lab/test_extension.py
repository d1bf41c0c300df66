"""What the lab adds to the command line: its commands, its lists and its picture."""

import pytest
import typer
from lab.study.rows import hand_made

from optloc.base.errors import InvalidProblem
from optloc.cli import PictureRequest
from optloc.lab import extension
from optloc.lab.datasets import NAMES
from optloc.lab.extension import EXTENSION
from optloc.lab.papers import PAPERS
from optloc.lab.study import folder
from optloc.lab.study.design import shipped


def test_the_commands_are_those_of_the_lab():
    app = typer.Typer()
    EXTENSION.commands(app)
    assert [command.callback.__name__ for command in app.registered_commands] == ["reproduce"]
    assert [group.name for group in app.registered_groups] == ["study"]


def test_lists_have_one_line_for_each_entry_of_their_table(monkeypatch):
    monkeypatch.delenv("OPTLOC_DATA", raising=False)
    lists = {name: rows() for name, rows in EXTENSION.lists.items()}
    assert {row["paper"] for row in lists["papers"]} == set(PAPERS)
    assert {row["study"] for row in lists["studies"]} == set(shipped())
    assert {(row["dataset"], row["here"]) for row in lists["datasets"]} == {(name, "no") for name in NAMES}
    assert EXTENSION.facts["datasets"]() == {"folder": None, "there": []}


def asked(place, epoch=None):
    return PictureRequest(place, place / "out.png", "auto", epoch)


def test_the_picture_of_accuracy_is_of_one_case_of_a_study(tmp_path, monkeypatch):
    monkeypatch.setattr(folder, "read_frame", lambda place, columns: hand_made())
    drawn = []
    monkeypatch.setattr("optloc.show.plot_accuracy", lambda *given, **more: drawn.append((given, more)))
    monkeypatch.setattr("optloc.cli.write_picture", lambda picture, out: None)
    extension._accuracy(asked(tmp_path))
    (noise, errors, bound, _), more = drawn[0]
    assert (noise.tolist(), bound.tolist(), more) == ([10.0], [2.0], {"unit": "m"})
    assert {name: value.tolist() for name, value in errors.items()} == {"a": [2.0], "b": [2.0]}
    with pytest.raises(InvalidProblem, match="there is no case 'other'"):
        extension._accuracy(asked(tmp_path, epoch="other"))
    with pytest.raises(InvalidProblem, match="this picture needs a study"):
        extension._accuracy(asked(tmp_path / "none"))
