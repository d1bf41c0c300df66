"""Maps of the bound: known geometry, the bound at single points, isolines, GeoJSON; shores against known places."""

import json
from importlib.resources import files as package_files

import numpy as np
import pytest

from optloc.base.errors import InvalidProblem
from optloc.bounds.cramer_rao import crlb
from optloc.bounds.over_area import bound_map, extent
from optloc.files import from_table, read
from optloc.show.maps.background import land, rings
from optloc.show.pictures.bound_map import isolines, levels, map_geojson, plot_bound_map

DEMOS = package_files("optloc") / "scenarios"


def ring(count, sigma, kind="range"):
    angle = 2 * np.pi * np.arange(count) / count
    stations = {f"S{i}": (1e3 * np.cos(a), 1e3 * np.sin(a)) for i, a in enumerate(angle)}
    return from_table({"a": list(stations), "z": [1e3] * count}, stations, kind=kind, sigma=sigma)


@pytest.fixture(scope="module")
def demo():
    return read(DEMOS / "demo.toml").problem


def test_ranges_from_a_ring_have_the_known_dilution_in_its_middle():
    found = bound_map(ring(8, 3.0), np.zeros(2), [-100.0, 0.0, 100.0], [0.0, 50.0])
    assert found.sigma.shape == (2, 3)
    assert found.row == pytest.approx(3.0)
    assert found.sigma[0, 1] == pytest.approx(3.0 * 2 / np.sqrt(8))
    assert found.dilution[0, 1] == pytest.approx(2 / np.sqrt(8))
    assert found.sigma[0, 0] == pytest.approx(found.sigma[0, 2])
    assert np.isnan(found.vertical).all()


def test_each_point_is_the_bound_there(demo):
    lon, lat = np.array([11.1, 11.2, 11.3]), np.array([47.75, 47.85])
    found = bound_map(demo, np.zeros(demo.layout.size), lon, lat, 3000.0)
    for j, i in ((0, 0), (1, 2)):
        place = demo.frame.from_geodetic(np.radians(lat[j]), np.radians(lon[i]), 3000.0)
        bound = crlb(demo, place)
        assert found.sigma[j, i] == pytest.approx(np.sqrt(np.trace(bound)))
        axes = demo.frame.enu_axes(place)
        assert found.vertical[j, i] == pytest.approx(np.sqrt((axes @ bound @ axes.T)[2, 2]))
    assert np.allclose(found.horizontal**2 + found.vertical**2, found.sigma**2)
    assert found.geodetic
    assert found.stations[0] == pytest.approx([11.183, 47.812])


def test_a_map_across_the_date_line_is_in_one_piece():
    stations = {
        "name": list("ABCD"),
        "lat_deg": [-17.0, -18.0, -17.0, -18.0],
        "lon_deg": [179.0, 179.5, -179.5, -179.0],
    }
    stations["height"] = [0.0, 500.0, 900.0, 100.0]
    problem = from_table({"a": list("ABCD"), "z": [5e4] * 4}, stations, kind="range", sigma=5.0, frame="geodetic")
    west, east, south, north = extent(problem)
    assert 0.0 < east - west < 6.0
    found = bound_map(
        problem, np.zeros(problem.layout.size), np.linspace(west, east, 9), np.linspace(south, north, 9), 9e3
    )
    assert np.isfinite(found.sigma).all()
    # Every station is on the map, whose longitudes go beyond 180 degrees.
    assert ((west < found.stations[:, 0]) & (found.stations[:, 0] < east)).all()
    for feature in map_geojson(found)["features"]:
        if feature["geometry"]["type"] == "MultiLineString":
            for line in feature["geometry"]["coordinates"]:
                assert np.abs(np.diff(np.array(line)[:, 0])).max() < 1.0


def test_isolines_are_where_the_bound_has_their_level(demo):
    x, y = np.linspace(11.0, 11.4, 61), np.linspace(47.7, 47.95, 61)
    found = bound_map(demo, np.zeros(demo.layout.size), x, y, 4000.0)
    for level, lines in isolines(found):
        for line in lines:
            for lon, lat in line[::10]:
                place = demo.frame.from_geodetic(np.radians(lat), np.radians(lon), 4000.0)
                assert np.sqrt(np.trace(crlb(demo, place))) == pytest.approx(level, rel=0.02)
    text = json.dumps(map_geojson(found))
    roles = [f["properties"]["role"] for f in json.loads(text)["features"]]
    assert roles.count("station") == 6
    assert roles.count("bound") >= 2


@pytest.mark.parametrize(("low", "high"), [(1.0, 1.2), (1.0, 3.0), (3.0, 50.0), (1.0, 1e6), (0.003, 0.02), (9.9, 10.1)])
def test_levels_are_round_few_and_hold_the_values(low, high):
    steps = levels(np.geomspace(low, high, 500))
    assert 3 <= len(steps) <= 12
    assert steps == sorted(set(steps))
    assert steps[0] <= low * 1.02
    assert steps[-1] >= high * 0.5


def test_pictures_have_units_and_nonsense_is_refused(demo, tmp_path):
    grid = np.linspace(-5e3, 5e3, 12)
    figure = plot_bound_map(bound_map(ring(5, 1.0), np.zeros(2), grid, grid), dilution=True)
    assert [figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()] == ["x (km)", "y (km)"]
    angles = ring(5, 0.01, "azimuth")
    with pytest.raises(InvalidProblem, match="not all lengths"):
        plot_bound_map(bound_map(angles, np.zeros(2), grid, grid), dilution=True)
    with pytest.raises(InvalidProblem, match="singular everywhere"):
        plot_bound_map(bound_map(ring(1, 1.0), np.zeros(2), grid, grid))
    with pytest.raises(InvalidProblem, match="frame is cartesian"):
        map_geojson(bound_map(ring(5, 1.0), np.zeros(2), grid, grid))


def _inside(polygons, place):
    hits = 0
    for ring_ in polygons:
        after = np.roll(ring_, -1, axis=0)
        across = (ring_[:, 1] > place[1]) != (after[:, 1] > place[1])
        a, b = ring_[across], after[across]
        hits += int((a[:, 0] + (place[1] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]) > place[0]).sum())
    return hits % 2 == 1


PLACES = [
    ((11.25, 47.75), True), ((0.0, 0.0), False), ((-98.0, 39.0), True), ((134.0, -25.0), True), ((-30.0, 40.0), False),
    ((37.6, 55.8), True), ((178.0, 67.0), True), ((-150.0, 0.0), False), ((50.5, 41.9), False), ((0.0, -85.0), True),
]  # fmt: skip


@pytest.mark.parametrize(("place", "dry"), PLACES)
def test_land_is_where_it_is(place, dry):
    assert (sum(_inside(rings(), (place[0] + turn, place[1])) for turn in (-360.0, 0.0, 360.0)) % 2 == 1) == dry
    window = (place[0] - 3.0, place[0] + 4.0, max(place[1] - 2.0, -90.0), place[1] + 2.0)
    cut = land(window)
    assert _inside(cut, (place[0] + 0.013, place[1] + 0.017)) == dry
    for polygon in cut:
        assert (polygon.min(0) >= [window[0] - 1e-9, window[2] - 1e-9]).all()
        assert (polygon.max(0) <= [window[1] + 1e-9, window[3] + 1e-9]).all()


def test_land_across_the_date_line():
    cut = land((170.0, 200.0, 60.0, 70.0))
    assert _inside(cut, (178.0, 67.0))  # Chukotka, west of the line
    assert _inside(cut, (185.0, 66.5))  # and east of it
    assert not _inside(cut, (181.0, 62.0))


def test_the_area_of_land_is_known():
    total = 0.0
    for ring_ in rings():
        lon, sine = np.radians(ring_[:, 0]), np.sin(np.radians(ring_[:, 1]))
        total += 0.5 * float(np.sum(np.diff(lon) * (sine[1:] + sine[:-1])))
    # 149 million square kilometres with the ice shelves of Antarctica left to taste
    assert abs(total) * 6371.0**2 == pytest.approx(148.5e6, rel=0.02)
