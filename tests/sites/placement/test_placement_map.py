"""The map of a placement: two panels on one scale, stations that are taken, and the loss of each station."""

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="pictures need matplotlib")

from optloc.bounds import BoundMap
from optloc.sites.placement import placement_map
from optloc.sites.placement.placement_map import StationLoss, plot_placement


def maps(side):
    grid = np.linspace(0.0, side, 5)
    stations = side * np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.8]])
    fields = {"x": grid, "y": grid, "stations": stations, "names": ("A", "B", "C"), "geodetic": False}
    own = BoundMap.__dataclass_fields__
    made = []
    for factor in (4.0, 1.0):
        sigma = factor * (1.0 + np.add.outer(grid, grid) / side)
        given = fields | {"sigma": sigma}
        made.append(BoundMap(**{name: given.get(name) for name in own}))
    return made


@pytest.fixture
def drawn(monkeypatch):
    monkeypatch.setattr(placement_map, "separate_notes", lambda figure: None)  # which lays the figure out
    return draw


def draw(side):
    taken = np.array([[True, True, False], [True, True, True]])
    losses = [StationLoss("A", np.inf, "", np.inf), StationLoss("C", 5.0, "D", 3.0)]
    places = np.array([[0.5, 0.5]]) * side
    return plot_placement(maps(side), taken, places, np.ones(1), losses, 2.0, ("before", "after"))


def test_both_maps_have_one_scale_and_show_who_is_taken(drawn):
    before, after = drawn(100.0).axes[:2]
    meshes = [axes.collections[0] for axes in (before, after)]
    assert meshes[0].norm is meshes[1].norm
    named = [[text.get_text() for text in axes.texts if text.get_text() in "ABC"] for axes in (before, after)]
    assert [set(names) for names in named] == [{"A", "B"}, {"A", "B", "C"}]
    assert (before.get_title(), after.get_title()) == ("before", "after")


@pytest.mark.parametrize(("side", "unit", "width"), [(100.0, "x (m)", 100.0), (2e4, "x (km)", 20.0)])
def test_a_large_map_is_in_kilometres(drawn, side, unit, width):
    axes = drawn(side).axes[0]
    assert axes.get_xlabel() == unit
    assert axes.get_xlim() == pytest.approx((0.0, width))


def test_candidates_have_a_dark_outline(drawn):
    (candidates,) = [one for one in drawn(100.0).axes[0].collections if one.get_label() == "candidate, not taken"]
    assert candidates.get_edgecolor().tolist() == [[0.0, 0.0, 0.0, 1.0]]


def test_each_loss_is_a_bar_with_its_replacement(drawn):
    panel = next(axes for axes in drawn(100.0).axes if axes.get_title() == "loss of one station")
    assert [text.get_text() for text in panel.get_yticklabels()] == ["A", "C"]
    assert panel.patches[1].get_width() == 5.0
    assert [text.get_text() for text in panel.texts] == ["no fix"]
    (replaced,) = panel.collections
    assert replaced.get_offsets()[1].tolist() == [3.0, 1.0]
    assert panel.lines[0].get_xdata()[0] == 2.0
