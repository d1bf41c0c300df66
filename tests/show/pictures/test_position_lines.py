"""Lines of position: each is where its row is what was measured, and names and fading follow their number."""

from importlib.resources import files as package_files

import numpy as np
import pytest
from often import few

import optloc
from optloc.base.frames import ECEF
from optloc.files import read
from optloc.show.pictures import plot_fixes, save
from optloc.show.pictures.position_lines import PositionLine, draw_lines, isodopplers, lines_of_position
from optloc.show.pictures.scene import scene_of
from optloc.show.pictures.style import figure_class
from optloc.solvers import solve

DEMOS = package_files("optloc") / "scenarios"


def rates(position, velocity, truth, frame, sigma):
    """Return a run of frequency differences between two stations, with a fix near the truth."""
    count, d = len(position), len(truth)
    rows = optloc.measured("fdoa", a=np.zeros(count, int), b=np.ones(count, int), epoch=np.arange(count), sigma=0.1)
    stations = optloc.station_array(position, ("one", "two"), velocity=velocity)
    near = (optloc.problem.Prior("position", np.array(truth), sigma**2 * np.eye(d)),)
    options = {"times": np.arange(count), "motions": (optloc.Motion(),), "frame": frame, "priors": near}
    problem = optloc.simulate(optloc.assemble(stations, rows, **options), truth=truth, seed=1)
    return problem, solve(problem)


def pair():
    velocity = np.array([[100.0, 20.0], [90.0, -30.0]])
    position = np.array([[0.0, 0.0], [6e3, 1e3]]) + 2.0 * np.arange(40)[:, None, None] * velocity
    return rates(position, np.broadcast_to(velocity, position.shape), [12e3, 15e3], optloc.problem.CARTESIAN, 3e3)


def orbit():
    """Return a pass 800 km high of four minutes beside a station on the ground."""
    turn = 1e-3 * np.arange(0, 240, 6.0)
    up, ahead = np.array([0.766, 0.1, 0.635]), np.array([-0.635, 0.05, 0.757])
    place = 7.17e6 * (np.cos(turn)[:, None] * up + np.sin(turn)[:, None] * ahead)
    speed = 7.17e3 * (np.cos(turn)[:, None] * ahead - np.sin(turn)[:, None] * up)
    ground = np.broadcast_to(ECEF.from_geodetic(0.8, 0.05, 0.0), place.shape)
    truth = ECEF.from_geodetic(np.radians(47.8), np.radians(11.2), 600.0)
    position, velocity = np.stack([place, ground], axis=1), np.stack([speed, 0.0 * speed], axis=1)
    return rates(position, velocity, truth.tolist(), ECEF, 1e4)


@pytest.mark.slow
@pytest.mark.parametrize("scene", few([pair, orbit], 1))
def test_isodopplers_are_drawn_without_moving_the_limits(scene, tmp_path):
    problem, fix = scene()
    figure = plot_fixes(problem, fix)
    (overview,) = [c for c in figure.axes[0].collections if c.get_label() == "equal Doppler through the fix"]
    assert 9 <= len(overview.get_segments()) < 40
    half = 0.5 * np.ptp(figure.axes[0].get_xlim())
    shown = scene_of(problem, [fix])
    everything = np.concatenate([shown.stations, shown.fixes, *shown.tracks])[:, :2]
    assert half < 1.5 * np.ptp(everything, axis=0).max() / 1e3
    save(figure, tmp_path / "p.png")


@pytest.mark.parametrize("scene", [pair, orbit])
def test_isodopplers_go_through_the_fix_with_its_rate(scene):
    problem, fix = scene()
    if problem.dimension == 2:
        x, y = np.linspace(10e3, 14e3, 81), np.linspace(13e3, 17e3, 81)

        def place(points):
            return points

        at, close = fix.position, 100.0
    else:
        lat, lon, height = fix.geodetic
        x, y = np.degrees(lon) + np.linspace(-3.0, 3.0, 81), np.degrees(lat) + np.linspace(-2.0, 2.0, 81)

        def place(points):
            return problem.frame.from_geodetic(*np.radians(points.T[::-1]), np.full(len(points), height))

        at, close = np.degrees([lon, lat]), 0.05
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    lines = isodopplers(problem, fix, x, y, place(grid))
    assert {name for name, _ in lines} == {"fdoa one – two, as at the fix"}
    assert len(lines) >= 9
    picked = np.linspace(0, problem.count - 1, 9).astype(int)
    level = optloc.engine.predict(problem, fix.x)[picked]
    for _, line in lines:
        values = optloc.engine.predict(problem, place(line))[:, picked]
        # one of the rows has the same rate all along
        assert np.abs(values - level).max(axis=0).min() < 2e-3 * np.ptp(
            optloc.engine.predict(problem, place(grid))[:, picked]
        )
    assert sum(np.linalg.norm(line - at, axis=1).min() < close for _, line in lines) >= 9


def test_other_fixes_have_no_isodopplers():
    grid = (np.arange(3.0), np.arange(3.0), np.zeros((9, 2)))
    demo = read(DEMOS / "ambiguous.toml").problem
    assert not isodopplers(demo, solve(demo), *grid)


def measured_in_the_plane(kind, absent=()):
    """Return a problem in the plane whose rows are off by some sigmas, and its fix."""
    stations = optloc.station_array(np.array([[0.0, 0.0], [900.0, 100.0], [700.0, 800.0], [-100.0, 600.0]]), "ABCD")
    a, b = np.arange(4), np.array([1, 2, 3, 0])
    pair = {"b": b} if optloc.models.MODELS[kind].stations > 1 else {}
    weight = {"weight": np.where(np.isin(a, absent), 0.0, 1.0)}
    sigma = 0.01 if kind in {"azimuth", "groa"} else 10.0
    empty = optloc.assemble(stations, optloc.measured(kind, None, a=a, **pair, sigma=sigma, **weight))
    truth = np.append([300.0, 420.0], [50.0] * (empty.layout.size - 2))
    z = optloc.engine.predict(empty, truth) + sigma * np.array([1.0, -0.5, 0.3, 0.8])
    problem = optloc.assemble(stations, optloc.measured(kind, z, a=a, **pair, sigma=sigma, **weight))
    return problem, solve(problem)


@pytest.mark.parametrize("kind", ["tdoa", "toa", "range", "range_sum", "azimuth", "groa"])
def test_lines_of_position_are_where_a_row_is_what_was_measured(kind):
    problem, fix = measured_in_the_plane(kind, absent=(3,))
    x, y = np.linspace(-300.0, 1200.0, 301), np.linspace(-300.0, 1200.0, 301)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    lines = lines_of_position(problem, fix, x, y, grid)
    names = {one.name for one in lines}
    pairs = {"tdoa", "range_sum", "groa"}
    first = int(np.argmin(problem.z[:3]))
    heard = {f"{n} – {'ABC'[first]}" for i, n in enumerate("ABC") if i != first}
    assert names == ({"A – B", "B – C", "C – D"} if kind in pairs else heard if kind == "toa" else {"A", "B", "C"})
    for one in lines:
        row = "ABC".index(one.name[0])
        vectors = np.concatenate([one.line, np.tile(np.asarray(fix.x)[2:], (len(one.line), 1))], axis=-1)
        off = optloc.engine.predict(problem, vectors) - problem.z
        off = off[:, row] - (off[:, first] if kind == "toa" else 0.0)
        # bearings are steep beside their stations, where the grid is coarse for them
        far = np.linalg.norm(one.line - problem.stations.position[0, row], axis=-1) > 100.0
        assert np.abs(off[far]).max() < {"azimuth": 2e-3, "groa": 2e-2}.get(kind, 0.5)


def test_a_run_has_no_lines():
    moving = read(DEMOS / "run.toml").problem
    grid = (np.arange(3.0), np.arange(3.0), np.zeros((9, moving.dimension)))
    assert not lines_of_position(moving, solve(moving), *grid)


def crossing(count):
    """Return as many vertical lines of ranges, one for each station."""
    y = np.linspace(0.0, 10.0, 21)
    return [PositionLine("range", f"S{i}", np.column_stack([np.full(21, float(i)), y])) for i in range(count)]


@pytest.mark.parametrize(("count", "named"), [(1, 0), (4, 4), (10, 10), (11, 0)])
def test_few_lines_are_named_and_many_are_faded(count, named):
    panel = figure_class()().subplots()
    panel.set(xlim=(-1.0, 12.0), ylim=(0.0, 10.0))
    draw_lines(panel, crossing(count), np.zeros(2), 1.0, limits=np.array([[-1.0, 0.0], [12.0, 10.0]]))
    (drawn,) = panel.collections
    assert len(drawn.get_segments()) == count
    assert [text.get_text() for text in panel.texts] == [f"S{i}" for i in range(count)][:named]
    assert (drawn.get_alpha() < 0.5) == (count > 10)
    looks = {
        (tuple(colour), str(dash)) for colour, dash in zip(drawn.get_colors(), drawn.get_linestyles(), strict=False)
    }
    assert len(looks) == count or count > 10


def test_a_line_outside_of_the_plan_has_no_name():
    panel = figure_class()().subplots()
    panel.set(xlim=(50.0, 60.0), ylim=(0.0, 10.0))
    draw_lines(panel, crossing(3), np.zeros(2), 1.0, limits=np.array([[50.0, 0.0], [60.0, 10.0]]))
    assert not panel.texts
