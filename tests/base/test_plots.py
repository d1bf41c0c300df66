"""Values of lower layers are drawn by the table of their folder."""

import sys

import pytest

import optloc
from optloc.base import plots


def test_the_folder_and_the_class_select_the_function(monkeypatch):
    asked = []
    table = type("Table", (), {"PLOTS": {"Frame": lambda value, **options: (value, options)}})

    def load(folder):
        asked.append(folder)
        return table

    monkeypatch.setattr(plots, "_LOADER", [])
    plots.set_plots(load)
    frame = optloc.Frame("cartesian")
    assert plots.plot_of(frame, title="t") == (frame, {"title": "t"})
    assert asked == ["base"]


def test_without_matplotlib_there_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.delitem(sys.modules, "optloc.show.pictures.notebook_figure", raising=False)
    problem = optloc.assemble([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], optloc.measured("range", a=[0, 1, 2], sigma=1.0))
    with pytest.raises(optloc.InvalidProblem, match="pip install 'optloc"):
        problem.plot()
