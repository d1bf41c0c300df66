"""Pictures: every kind of problem is drawn, with units, one scale and the alternatives."""

from importlib.resources import files as package_files

import numpy as np
import pytest

import optloc
from optloc.base.linalg import error_ellipse
from optloc.cli.file_fixes import fix_file
from optloc.files import from_table, read
from optloc.show.pictures import plot_fixes, save
from optloc.show.pictures.scene import scene_of
from optloc.solvers import solve

DEMOS = package_files("optloc") / "scenarios"


@pytest.mark.parametrize(("name", "panels"), [("demo", 3), ("ambiguous", 2), ("run", 1)])
def test_demos_are_drawn(name, panels, tmp_path):
    fixed = fix_file(read(DEMOS / f"{name}.toml"), "auto", quiet=True)
    figure = plot_fixes(fixed.loaded.problem, (fixed.fix,), title=name)
    assert len(figure.axes) == panels
    for axes in figure.axes:
        assert axes.get_aspect() == 1.0
        assert axes.get_xlabel().endswith((" (m)", " (km)"))
        assert axes.get_ylabel().endswith((" (m)", " (km)"))
    save(figure, tmp_path / "p.png")
    assert len((tmp_path / "p.png").read_bytes()) > 5_000


def test_alternatives_are_labelled_with_their_cost():
    fixed = fix_file(read(DEMOS / "ambiguous.toml"), "auto", quiet=True)
    figure = plot_fixes(fixed.loaded.problem, (fixed.fix,))
    assert any(text.get_text().startswith("+") for text in figure.axes[0].texts)


def test_nothing_fixed_is_drawn_too(tmp_path):
    problem = from_table({"a": ["B"], "b": ["A"], "z": [1.0]}, {"A": (0, 0), "B": (9, 0)}, kind="tdoa", sigma=1.0)
    figure = plot_fixes(problem, solve(problem))
    save(figure, tmp_path / "p.svg")
    assert (tmp_path / "p.svg").stat().st_size > 1_000


def test_positions_in_ecef_are_drawn_along_east_and_north():
    stations = {"name": ["A", "B", "C", "D", "E"], "lat_deg": [47.0, 47.1, 47.2, 47.1, 47.0]}
    stations |= {"lon_deg": [11.0, 11.1, 11.0, 10.9, 11.2], "height": [500.0, 900.0, 700.0, 600.0, 2000.0]}
    rows = {"a": list("ABCDE"), "z": [9e3, 8e3, 15e3, 9e3, 16e3]}
    problem = from_table(rows, stations, kind="range", sigma=5.0, frame="geodetic")
    scene = scene_of(problem, [solve(problem)])
    assert scene.axes == ("east", "north", "up")
    assert np.abs(scene.stations).max() < 3e4


def test_ellipse_holds_its_share():
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    semi_axes, directions = error_ellipse(covariance, 0.95)
    draws = np.random.default_rng(2).multivariate_normal(np.zeros(2), covariance, 20_000)
    inside = (((draws @ directions) / semi_axes) ** 2).sum(-1) < 1.0
    assert abs(inside.mean() - 0.95) < 0.006
    assert np.isnan(error_ellipse(np.full((2, 2), np.nan))[0]).all()


def ranged_with_noise():
    """Return four ranges in the plane that are off by some sigmas, and their fix."""
    places = np.array([[0.0, 0.0], [900.0, 100.0], [700.0, 800.0], [-100.0, 600.0]])
    z = np.linalg.norm(places - [300.0, 420.0], axis=1) + np.array([10.0, -5.0, 3.0, 8.0])
    problem = optloc.assemble(
        optloc.station_array(places, "ABCD"), optloc.measured("range", z, a=np.arange(4), sigma=10.0)
    )
    return problem, solve(problem)


def test_a_picture_has_lines_a_scale_and_the_same_limits():
    problem, fix = ranged_with_noise()
    figure = plot_fixes(problem, fix)
    plan = figure.axes[0]
    (lines,) = [c for c in plan.collections if c.get_label() == "circle of a range"]
    assert len(lines.get_segments()) >= 4
    assert np.ptp(plan.get_xlim()) < 2500.0
    (bar,) = [one for one in plan.artists if type(one).__name__ == "AnchoredSizeBar"]
    assert bar.txt_label.get_text() in {"200 m", "500 m"}
