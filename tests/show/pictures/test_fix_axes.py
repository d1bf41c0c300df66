"""Fixes and problems in one axes: artists, an inset where the ellipse is too small, and alternative texts."""

from importlib.resources import files as package_files

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from show.ranging import PLACES, ranged

import optloc

DEMOS = package_files("optloc") / "scenarios"


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def labels(axes):
    return axes.get_legend_handles_labels()[1]


def test_a_fix_is_drawn_in_a_figure_that_notebooks_show():
    problem, fix = ranged()
    axes = fix.plot(problem)
    assert isinstance(axes, Axes)
    assert plt.get_fignums() == [axes.figure.number]
    assert {"station", "fix", "95 % ellipse", "circle of a range"} <= set(labels(axes))
    assert axes.get_title() == "status ok"
    assert axes.get_xlabel().endswith(" (m)")


def test_a_fix_remembers_its_problem():
    fix = optloc.locate(
        {"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (0.0, 6.0)}, ranges={"A": 5.0, "B": 5.0, "C": 5.0}, sigma=0.1
    )
    assert "station" in labels(fix.plot())


def test_a_batch_without_its_problem_asks_for_it():
    problem = optloc.problem.by_epoch(optloc.load(DEMOS / "run.toml")).take(np.arange(3))
    fixes = optloc.solve(problem)
    with pytest.raises(optloc.InvalidProblem, match=r"fix\.plot\(problem\)"):
        fixes.plot()
    assert fixes.plot(problem).get_title() == "3 ok"


@pytest.mark.parametrize(("sigma", "insets"), [(0.001, 1), (0.1, 0)])
def test_an_inset_shows_an_ellipse_that_is_too_small(sigma, insets):
    stations = PLACES[:, :2]
    z = np.linalg.norm(stations - stations.mean(0), axis=1)
    rows = optloc.measured("range", z, a=np.arange(len(z)), sigma=sigma * np.ptp(stations))
    axes = optloc.solve(optloc.assemble(optloc.station_array(stations), rows)).plot()
    assert len(axes.child_axes) == insets
    for near in axes.child_axes:
        assert near.get_title() == "around the fix"
        # the ellipse fills the inset
        ellipse = next(line for line in near.lines if line.get_label() == "95 % ellipse").get_xydata()
        assert np.ptp(ellipse, axis=0).max() > 0.4 * np.ptp(near.get_xlim())


def test_axes_of_the_user_are_used():
    problem, fix = ranged()
    figure, axes = plt.subplots(1, 2)
    assert fix.plot(problem, ax=axes[1], title="mine") is axes[1]
    assert axes[1].get_title() == "mine"
    assert not axes[0].collections
    assert plt.get_fignums() == [figure.number]


def test_a_curved_region_is_its_contour():
    places = optloc.station_array([[0.0, 0.0], [30.0, 0.0], [60.0, 5.0]], "ABC")
    rows = optloc.measured("azimuth", [0.30, 0.34, 0.39], a=[0, 1, 2], sigma=0.02)
    axes = optloc.solve(optloc.assemble(places, rows)).plot()
    assert "95 % region, cut off" in labels(axes)
    assert "95 % ellipse" not in labels(axes)


def test_a_problem_has_stations_and_lines():
    axes = optloc.load(DEMOS / "ambiguous.toml").plot()
    assert {"station", "hyperbola of a time difference"} == set(labels(axes))
    assert axes.get_title() == "3 stations, 2 tdoa rows"
    assert {"B – A", "C – A"} <= {text.get_text() for text in axes.texts}


def test_a_problem_with_more_unknowns_has_no_lines():
    assert set(labels(optloc.load(DEMOS / "demo.toml").plot())) == {"station"}
