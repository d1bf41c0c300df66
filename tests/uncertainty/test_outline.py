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
from optloc.problem.chart import quantile
from optloc.show.formats.marks import geojson
from optloc.show.maps.map_marks import fixed_spots
from optloc.show.pictures import plot_fixes
from optloc.show.pictures.outlines import outlines_of
from optloc.uncertainty.contour import holds
from optloc.uncertainty.region import RegionSurface

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


def counted(value, lines, count=500):
    """Return the area in which a value is negative around lines, by the nodes of a grid along their longest axis."""
    points = np.concatenate(lines)
    middle = points.mean(0)
    turn = np.linalg.svd(points - middle, full_matrices=False)[2]
    own = (points - middle) @ turn.T
    low, high = own.min(0), own.max(0)
    low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
    side = [a + (b - a) * (np.arange(count) + 0.5) / count for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*side), axis=-1).reshape(-1, 2)
    return float((value(middle + grid @ turn) < 0.0).mean() * (high - low).prod())


def drawn_area(outline):
    return sum(area(line) for line in outline.lines)


def regions(problem, fix, *planes):
    """Return the outlines of a single fix."""
    (found,) = outlines_of(problem, fix, planes or [np.eye(problem.dimension)[:2]])
    return found


FLAT = ["tdoa 2 5 30", "aoa 3 50 10", "tdoa 2 5 100", "tdoa 2 5 300", "tdoa 2 4 60"]


@pytest.mark.parametrize(("name", "item"), few([(name, item) for item in range(3) for name in FLAT], 5, names=2))
def test_the_outline_in_the_plane_is_the_contour_of_the_cost(name, item):
    problem, _, fix = fixed(name, item)
    found = regions(problem, fix)
    if fix.chart.name == "cartesian" or not np.isfinite(fix.x).all():
        assert found == []
        return
    (outline,) = found
    # a cost of its own
    S, z = problem.stations.position.reshape(-1, 2), problem.z
    inverse = np.linalg.inv(optloc.problem.dense(problem.noise, np.arange(problem.count)).reshape((problem.count,) * 2))

    def cost(points):
        away = points[:, None] - S
        if name.startswith("tdoa"):
            r = np.linalg.norm(away, axis=-1)
            off = z - (r[:, 1:] - r[:, :1])
        else:
            off = z - np.arctan2(away[..., 1], away[..., 0])
            off = np.arctan2(np.sin(off), np.cos(off))
        return np.einsum("ni,ij,nj->n", off, inverse, off)

    least = float(cost(fix.position[None])[0])
    reach = 3.0 * np.linalg.norm(fix.position - fix.chart.centre)

    def value(points):
        beyond = np.linalg.norm(points + fix.position - fix.chart.centre, axis=1) - reach
        return np.where(beyond > 0.0, np.inf, cost(points + fix.position) - least - quantile(0.95, 2))

    assert drawn_area(outline) == pytest.approx(counted(value, outline.lines), rel=0.02)
    around = np.concatenate(outline.lines)
    at_edge = np.linalg.norm(around + fix.position - fix.chart.centre, axis=1) > 0.99 * reach
    assert outline.cut == at_edge.any()
    excess = cost(around[~at_edge] + fix.position) - least
    assert np.median(excess) == pytest.approx(quantile(0.95, 2), rel=1e-3)
    assert any(holds(polygon[0], np.zeros(2)) for polygon in outline.polygons)


def test_an_ambiguous_fix_has_two_parts_of_their_own_sizes():
    problem = optloc.load(DEMOS / "ambiguous.toml")
    fix = optloc.solve(problem)
    (outline,) = regions(problem, fix)
    assert len(outline.polygons) == 2
    assert not outline.cut
    S, z = problem.stations.position.reshape(-1, 2), problem.rows[0].z
    inverse = np.linalg.inv(optloc.problem.dense(problem.noise, np.arange(2)))

    def value(points):
        r = np.linalg.norm(points[:, None] + fix.position - S, axis=-1)
        off = z - (r[:, 1:] - r[:, :1])
        return np.einsum("ni,ij,nj->n", off, inverse, off) - float(fix.cost) - quantile(0.95, 2)

    for polygon in outline.polygons:
        assert drawn_area(type(outline)((polygon,))) == pytest.approx(counted(value, polygon), rel=0.02)
    other = fix.alternatives.position[0] - fix.position if hasattr(fix.alternatives, "position") else None
    other = fix.alternatives.x[0, :2] - fix.position if other is None else other
    assert sum(holds(polygon[0], other) for polygon in outline.polygons) == 1


@pytest.mark.parametrize(
    ("name", "view"), few([("plane 50 400", (0, 2)), ("plane 50 400", (0, 1)), ("azel 4 300", (0, 1))], 1, names=2)
)
def test_in_space_the_coordinate_that_is_not_seen_is_at_its_best(name, view):
    problem, _, fix = fixed(name, 0)
    plane = np.eye(3)[list(view)]
    (outline,) = regions(problem, fix, plane)
    surface, hidden = RegionSurface.of(problem, fix), np.cross(*plane)
    rng = np.random.default_rng(3)
    around = np.concatenate(outline.lines)
    spread = np.sqrt(hidden @ fix.covariance() @ hidden)
    depth = np.concatenate([np.linspace(-12.0, 12.0, 481) * spread, [-2.0 * (fix.position @ hidden)]])

    def least(points):
        costs = surface.cost(points[:, None] @ plane + fix.position + depth[:, None] * hidden)
        return costs.min(1) - surface.least

    # on the outline the best of all depths costs what the level allows, a little inside less, outside more
    some = around[rng.permutation(len(around))[:30]]
    assert least(some) == pytest.approx(quantile(0.95, 2), rel=0.05)
    points = rng.uniform(around.min(0), around.max(0), (300, 2))
    inside = np.array([sum(holds(line, point) for line in outline.lines) % 2 for point in points]) == 1
    excess = least(points)
    assert (excess[inside] < 1.05 * quantile(0.95, 2)).all()
    assert (excess[~inside] > 0.95 * quantile(0.95, 2)).all()


def test_what_goes_on_to_infinity_is_cut_off_and_says_so():
    problem, _, fix = fixed("aoa 3 50 10", 0)
    (outline,) = regions(problem, fix)
    far = np.linalg.norm(np.concatenate(outline.lines) + fix.position - fix.chart.centre, axis=1).max()
    assert outline.cut
    assert far == pytest.approx(3.0 * fix.chart.distance, rel=0.02)
    labels = plot_fixes(problem, fix).axes[0].get_legend_handles_labels()[1]
    assert "95 % region, cut off" in labels


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
    assert far.fix.chart.name != "cartesian"
    found = geojson(results_of(far))["features"][-1]
    assert found["properties"]["role"] == "region95"
    assert found["geometry"]["type"] == "Polygon"
    ring = np.array(found["geometry"]["coordinates"][0])
    assert (ring[0] == ring[-1]).all()
    assert area(ring[:, :2]) > 0
    lon, lat = np.degrees(problem.frame.to_geodetic(far.fix.position.reshape(1, 3))[1::-1]).ravel()
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
    (outline,) = regions(problem, fix)
    plan = [[line + fix.position[:2] for line in polygon] for polygon in outline.polygons]
    around = np.concatenate([line for polygon in plan for line in polygon])
    # points of the surface around, by a cost of their own
    rng, z, place = np.random.default_rng(scene), problem.z, problem.stations.position.reshape(-1, 3)
    low, high = around.min(0), around.max(0)
    points = np.c_[rng.uniform(low, high, (2000, 2)), np.zeros(2000)]
    for _ in range(5):
        points[:, 2] += 1600.0 - problem.frame.to_geodetic(points)[2]
    way = np.linalg.norm(points[:, None] - place, axis=-1)
    off = way[:, 1:] - way[:, :1] - z
    inverse = np.linalg.inv(60.0**2 * (np.eye(3) + 1.0))
    excess = np.einsum("ni,ij,nj->n", off, inverse, off) - float(fix.cost)
    held = np.array([any(inside(point[:2], polygon) for polygon in plan) for point in points])
    assert (excess < quantile(0.95, 2)).sum() > 5
    near = np.linalg.norm(points - fix.position, axis=1) < 2.9 * float(fix.chart.distance)
    assert held[near & (excess < 0.98 * quantile(0.95, 2))].all()
    assert not held[excess > 1.02 * quantile(0.95, 2)].any()
    labels = plot_fixes(problem, fix).axes[0].get_legend_handles_labels()[1]
    assert any(label.startswith("95 % region") for label in labels)
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
                plan, height = regions(problem, fix, np.eye(3)[:2], np.eye(3)[[0, 2]])
                # as thin as it is drawn: all of it lies at one height
                assert np.ptp(np.concatenate(height.lines)[:, 1]) < 0.02 * np.ptp(np.concatenate(plan.lines))
                plot_fixes(problem, fix)
                drawn.append(across)
                break
    assert drawn == [np.inf, 700.0]
