"""Lines of maps: lines of position, ground tracks and constraints, on Earth and in a plane."""

from importlib.resources import files as package_files

import numpy as np
import pytest

import optloc
from optloc import Frame, assemble, constraints, measured, solve, station_array
from optloc.show import fix_page
from optloc.show.maps.map_lines import constraint_lines, ground_tracks, lines_on_map

DEMO = package_files("optloc") / "scenarios" / "demo.toml"


@pytest.fixture(scope="module")
def demo():
    problem = optloc.load(DEMO)
    return problem, optloc.solve(problem)


def test_lines_of_position_meet_their_rows(demo):
    problem, fix = demo
    lon, lat = np.degrees(fix.geodetic[1]), np.degrees(fix.geodetic[0])
    lines = lines_on_map(problem, fix, (lon - 0.1, lon + 0.1, lat - 0.07, lat + 0.07))
    assert {name for name, _ in lines} == {f"tdoa {n} – Lake" for n in ("Chapel", "Quarry", "Summit", "Mill", "Tower")}
    for name, line in lines:
        row = [f"tdoa {problem.stations.names[a]} – Lake" for a in problem.rows[0].a].index(name)
        x = problem.frame.from_geodetic(*np.radians(line.T[::-1]), np.full(len(line), fix.geodetic[2]))
        assert np.abs(optloc.engine.predict(problem, x)[:, row] - problem.z[row]).max() < 30.0


def test_a_pass_has_its_ground_track_on_the_map():
    problem = optloc.load(DEMO.parent.parent / "starters" / "range_rate.toml")
    near = problem.frame.from_geodetic(np.radians(47.0), np.radians(10.0), 650.0)
    fix = optloc.solve(problem, start=np.append(near, 0.0))
    ((name, line),) = ground_tracks(problem)
    lat, lon, _ = problem.frame.to_geodetic(problem.stations.position[[0, -1], 0])
    assert name == "ground track of SAT"
    np.testing.assert_allclose(line[[0, -1]], np.degrees(np.stack([lon, lat], axis=-1)))
    page = fix_page(problem, fix, "pass")
    assert "ground track of SAT" in page
    assert page.count("range_rate SAT") >= 13
    # turned to the date line its track stays in one piece
    over = np.array([[np.cos(turn), np.sin(turn), 0.0] for turn in np.radians([178.0, 181.0, 184.0])]) * 7e6
    stations = optloc.station_array(over[:, None], ("high",), velocity=np.ones((3, 1, 3)))
    rows = optloc.measured("range_rate", np.zeros(3), a=[0, 0, 0], epoch=[0, 1, 2], sigma=1.0)
    ((_, line),) = ground_tracks(optloc.assemble(stations, rows, times=[0.0, 1.0, 2.0], frame=optloc.problem.ECEF))
    np.testing.assert_allclose(line, [[178.0, 0.0], [181.0, 0.0], [184.0, 0.0]], atol=1e-9)


def test_constraints_are_lines_on_earth():
    frame = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
    places = np.array([[0.0, 0.0, 0.0], [9e3, 0.0, 50.0], [0.0, 9e3, 90.0], [9e3, 9e3, 0.0]])
    rows = measured("range", np.linalg.norm(places - [4e3, 5e3, 700.0], axis=1), a=np.arange(4), sigma=5.0)
    limits = [constraints.disc((4e3, 4e3), 2e3), constraints.half_plane((1.0, 0.0, 0.0), 7e3)]
    problem = assemble(station_array(places), rows, frame=frame, constraints=limits)
    fix = solve(assemble(station_array(places), rows, frame=frame), "gtrs+lsr")
    (disc, line) = constraint_lines(problem, [fix])
    assert [name for name, _ in (disc, line)] == ["region", "limit, ticks on the excluded side"]
    lon, lat = np.radians(disc[1]).T
    ring = frame.from_geodetic(lat, lon, np.full(len(lat), float(frame.to_geodetic(fix.position)[2])))
    np.testing.assert_allclose(np.hypot(*(ring[:, :2] - [4e3, 4e3]).T), 2e3, atol=2.0)
    assert np.ptp(line[1][:, 1]) < 1.0
    page = fix_page(problem, fix, "Limits")
    assert "limit, ticks on the excluded side" in page


def test_lines_and_limits_of_a_plane_are_in_metres():
    places = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [90.0, 90.0]])
    z = np.linalg.norm(places - [30.0, 40.0], axis=1)
    limit = [constraints.disc((30.0, 40.0), 20.0)]
    problem = assemble(places, measured("range", z, a=np.arange(4), sigma=1.0), constraints=limit)
    fix = solve(problem)
    for name, line in lines_on_map(problem, fix, (-50.0, 150.0, -50.0, 150.0)):
        row = [f"range {each}" for each in problem.stations.names].index(name)
        np.testing.assert_allclose(np.linalg.norm(line - places[row], axis=1), z[row], atol=0.1)
    ((name, ring),) = constraint_lines(problem, [fix])
    assert name == "region"
    np.testing.assert_allclose(np.hypot(*(ring - [30.0, 40.0]).T), 20.0, atol=1e-6)
    assert ground_tracks(problem) == []
