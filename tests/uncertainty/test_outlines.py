"""Pictures, maps and GeoJSON show what covers: an ellipse where it does, else the region as it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from often import few
from uncertainty.scenes import fixed

import optloc
from optloc.cli.file_fixes import fix_file, results_of
from optloc.files import read
from optloc.plot import plot_fixes
from optloc.plot.outlines import outlines_of
from optloc.problem.chart import quantile
from optloc.report.formats.marks import geojson
from optloc.report.map import fixed_spots

DEMOS = Path(optloc.__file__).parent / "scenarios"


def area(line):
    x, y = line.T
    return 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())


def inside(point, polygon):
    """Return whether a point is in a polygon with holes, by crossings of a ray."""
    crossed = 0
    for line in polygon:
        (x, y), (u, v) = line[:-1].T, line[1:].T
        up = (y > point[1]) != (v > point[1])
        at = x[up] + (point[1] - y[up]) * (u[up] - x[up]) / (v[up] - y[up])
        crossed += int((at > point[0]).sum())
    return crossed % 2 == 1


def test_a_union_of_squares_is_a_ring_with_a_hole():
    corners = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    pieces = [corners + 50 * np.array([np.cos(t), np.sin(t)]) for t in turn]
    ((around, hole),) = polygons(pieces)
    assert area(around) == pytest.approx(np.pi * 51.2**2, rel=0.03)
    assert area(hole) == pytest.approx(-np.pi * 48.8**2, rel=0.03)
    # Large cells, which hold many nodes of the grid.
    ((whole,),) = polygons([50 * corners, 50 * corners + [60.0, 0.0]])
    assert area(whole) == pytest.approx(160 * 100, rel=0.03)
    assert area(hull(corners)) == pytest.approx(4)
    assert polygons([]) == []


def test_the_egg_of_a_far_fix_is_the_region():
    problem, _, fix = fixed("tdoa 2 5 30", 0)
    assert fix.chart.name == "inverse range"
    ((points,),) = pieces_of(problem, fix)
    assert fix.chart.distance_squared(points) == pytest.approx(quantile(0.95, 2), rel=1e-9)
    region = optloc.likelihood_region(problem, fix)
    low, high = region.points.min(0), region.points.max(0)
    assert points.min(0) == pytest.approx(low, abs=0.15 * (high - low).max())
    assert points.max(0) == pytest.approx(high, abs=0.15 * (high - low).max())


def test_what_goes_on_to_infinity_ends_in_a_picture():
    problem, _, fix = fixed("azel 4 300", 0)
    ((points,),) = pieces_of(problem, fix)
    far = np.linalg.norm(points - fix.chart.centre, axis=1).max()
    assert fix.chart.distance < far < 3.2 * fix.chart.distance


def test_a_banana_is_drawn_where_the_truth_is_in_it():
    held = 0
    for item in range(2):
        problem, truth, fix = fixed("plane 50 400", item)
        (pieces,) = pieces_of(problem, fix)
        if fix.chart.name != "curved":
            assert pieces == ()
            continue
        side = polygons([piece[:, [0, 2]] for piece in pieces])
        assert any(inside(fix.position[[0, 2]], polygon) for polygon in side)
        assert any(inside(truth[[0, 2]], polygon) for polygon in side) >= bool(
            optloc.likelihood_region(problem, fix).covers(truth)
        )
        held += 1
    assert held


@pytest.mark.slow
def test_pictures_say_what_they_draw():
    labels = {}
    for name in ("tdoa 2 5 0", "tdoa 2 5 30", "plane 50 400"):
        problem, _, fix = fixed(name, 0)
        figure = plot_fixes(problem, fix)
        labels[name] = set(figure.axes[0].get_legend_handles_labels()[1])
    assert "95 % ellipse" in labels["tdoa 2 5 0"]
    assert "95 % region" in labels["tdoa 2 5 30"]
    assert "95 % region" in labels["plane 50 400"]
    assert "95 % ellipse" not in labels["plane 50 400"]


def test_geojson_has_the_region_of_a_far_fix():
    loaded = read(DEMOS / "demo.toml")
    problem = loaded.problem
    place = problem.stations.position.reshape(-1, 3)
    away = place.mean(0) + 60 * (place[1] - place.mean(0))
    truth = optloc.solve(problem).x.copy()
    truth[:3] = away
    far = fix_file(replace(loaded, problem=optloc.simulate(problem, truth, 5)), "auto", quiet=True)
    assert far.fixes[0].chart.name != "cartesian"
    found = geojson(results_of(far))["features"][-1]
    assert found["properties"]["role"] == "region95"
    assert found["geometry"]["type"] == "Polygon"
    ring = np.array(found["geometry"]["coordinates"][0])
    assert (ring[0] == ring[-1]).all()
    assert area(ring[:, :2]) > 0
    lon, lat = np.degrees(problem.frame.to_geodetic(far.fixes[0].position.reshape(1, 3))[1::-1]).ravel()
    assert inside((lon, lat), [ring[:, :2]])


def test_a_map_has_the_region_of_a_far_fix():
    frame = optloc.Frame("enu", (np.radians(48.0), np.radians(11.0), 500.0))
    bent = next(i for i in range(20) if fixed("tdoa 3 6 30", i)[2].chart.name == "inverse range")
    problem = replace(fixed("tdoa 3 6 30", bent)[0], frame=frame)
    fix = optloc.solve(problem)
    made = fixed_spots(problem, [fix], [])
    assert len(made.rings) == 1
    lat, lon = np.degrees(frame.to_geodetic(fix.position)[:2])
    assert inside((lon, lat), [made.rings[0]])


def held_at_a_height(seed):
    """Return a problem of differences whose target is at a known height, far from the stations, and its fix."""
    frame = optloc.Frame.enu(lat_deg=47.8, lon_deg=11.2, height=600.0)
    stations = np.array([[0.0, 0.0, 0.0], [9e3, 400.0, 30.0], [4e3, 7e3, 50.0], [-6e3, 5e3, 10.0]])
    rows = optloc.measured("tdoa", a=np.arange(1, 4), b=np.zeros(3, dtype=int), arrival_sigma=60.0)
    template = optloc.assemble(stations, rows, frame=frame, constraints=optloc.constraints.height(exactly=1600.0))
    lat, lon, _ = frame.to_geodetic(np.array([25e3, -30e3, 0.0]))
    truth = frame.from_geodetic(lat, lon, 1600.0)
    problem = optloc.simulate(template, truth, seed)
    return problem, truth, optloc.solve(problem)


@pytest.mark.parametrize("scene", few([1, 2, 4], 1))
def test_a_region_along_a_known_height_is_what_costs_as_little_there(scene):
    problem, _, fix = held_at_a_height(scene)
    assert fix.chart.name == "curved"
    (pieces,) = pieces_of(problem, fix)
    cells = np.array(pieces)
    assert problem.frame.to_geodetic(cells)[2] == pytest.approx(1600.0, abs=1e-6)
    plan = polygons([piece[:, :2] for piece in pieces])
    # points of the surface around, by a cost of their own
    rng, z, place = np.random.default_rng(scene), problem.z, problem.stations.position.reshape(-1, 3)
    low, high = cells[..., :2].min((0, 1)), cells[..., :2].max((0, 1))
    points = np.c_[rng.uniform(low, high, (2000, 2)), np.zeros(2000)]
    for _ in range(5):
        points[:, 2] += 1600.0 - problem.frame.to_geodetic(points)[2]
    way = np.linalg.norm(points[:, None] - place, axis=-1)
    off = way[:, 1:] - way[:, :1] - z
    inverse = np.linalg.inv(60.0**2 * (np.eye(3) + 1.0))
    excess = np.einsum("ni,ij,nj->n", off, inverse, off) - float(fix.cost)
    held = np.array([any(inside(point[:2], polygon) for polygon in plan) for point in points])
    assert (excess < quantile(0.95, 2)).sum() > 5
    assert held[excess < 0.9 * quantile(0.95, 2)].mean() > 0.98
    assert not held[excess > 4.0 * quantile(0.95, 2)].mean() > 0.02
    labels = plot_fixes(problem, fix).axes[0].get_legend_handles_labels()[1]
    assert "95 % region" in labels
    assert fixed_spots(problem, [fix], []).rings[0].shape[0] > 4


def test_a_region_along_a_plane_or_a_line_is_drawn():
    stations, drawn = np.array([[0.0, 0.0, 0.0], [1e3, 0.0, 0.0], [0.0, 1e3, 0.0]]), []
    for across in (np.inf, 700.0):
        high = np.array([np.inf, across, 300.0])
        held = optloc.constraints.box(np.where(np.isfinite(high), high, -np.inf), high)
        rows = optloc.measured("azimuth", a=np.arange(3), sigma=0.1)
        template = optloc.assemble(stations, rows, constraints=held)
        for seed in range(8):
            problem = optloc.simulate(template, [9e3, 700.0, 300.0], seed)
            fix = optloc.solve(problem)
            if fix.answered and fix.chart.name != "cartesian":
                (pieces,) = pieces_of(problem, fix)
                assert np.array(pieces)[..., 2] == pytest.approx(300.0)
                plot_fixes(problem, fix)
                drawn.append(across)
                break
    assert drawn == [np.inf, 700.0]
