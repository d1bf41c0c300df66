"""Pictures by name: each is drawn by a function with a summary, and wrong names and types are refused."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.cli.extensions import PictureRequest
from optloc.cli.options import shipped_problems
from optloc.cli.pictures import _PICTURES, _solve_one, pictures, run_plot
from optloc.files import read


def asked(tmp_path, name="p.svg", epoch=None):
    return PictureRequest(shipped_problems()["demo"], tmp_path / name, "auto", epoch)


def test_every_picture_has_a_summary_and_neighbours_replace_none():
    known = pictures()
    assert all(known[name] is draw for name, draw in _PICTURES.items())
    assert all((draw.__doc__ or "").strip().endswith(".") for draw in known.values())


def test_unknown_pictures_and_types_are_refused_before_the_work(tmp_path):
    with pytest.raises(InvalidProblem, match="did you mean 'residuals'"):
        run_plot("residual", asked(tmp_path), quiet=True)
    with pytest.raises(InvalidProblem, match=r"type '\.gif'"):
        run_plot("fix", asked(tmp_path, "p.gif"), quiet=True)


def test_the_picture_asked_for_is_drawn_to_its_file(tmp_path, monkeypatch, capsys):
    drawn = []
    monkeypatch.setitem(_PICTURES, "fix", drawn.append)
    assert run_plot("fix", asked(tmp_path), quiet=False) == 0
    assert drawn == [asked(tmp_path)]
    assert "p.svg" in capsys.readouterr().out.replace("\n", "")


def test_an_epoch_is_chosen_by_its_label(tmp_path):
    _, fix, title = _solve_one(PictureRequest(shipped_problems()["run"], tmp_path / "p.svg", "auto", None))
    labels = read(shipped_problems()["run"]).epochs
    assert title.endswith(f"epoch {labels[0]}")
    _, last, _ = _solve_one(PictureRequest(shipped_problems()["run"], tmp_path / "p.svg", "auto", labels[-1]))
    assert len(fix) == len(last) == 1
    assert np.abs(fix.position - last.position).max() > 1.0
    with pytest.raises(InvalidProblem, match="no epoch 'never'"):
        _solve_one(PictureRequest(shipped_problems()["run"], tmp_path / "p.svg", "auto", "never"))
