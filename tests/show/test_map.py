"""Maps of fixes and tracks: what is drawn is where it is, and a browser opens the page on a desk and on a phone."""

from importlib.resources import files as package_files

import numpy as np
import pytest
from show.browser import Browser, executable
from typer.testing import CliRunner

import optloc
from optloc import Frame, assemble, constraints, measured, solve, station_array
from optloc.base.errors import InvalidProblem
from optloc.cli import app
from optloc.show import fix_page
from optloc.show.map import constraint_lines, fixed_spots, ground_tracks, lines_on_map

RUN = CliRunner()
DEMO = package_files("optloc") / "scenarios" / "demo.toml"
TRACK = """
format = 1
title = "pulses <&> more"
[frame]
kind = "enu"
origin = {{ lat_deg = {lat}, lon_deg = {lon}, height = 0.0 }}
[stations]
rows = [
  {{ name = "A", x = 0.0, y = 0.0 }}, {{ name = "B", x = 8e3, y = 1e3 }},
  {{ name = "C", x = 3e3, y = 7e3 }}, {{ name = "</script>", x = 9e3, y = 9e3 }},
]
[[measurements]]
kind = "range"
unit = "m"
sigma = 5.0
rows = [{rows}]
"""


@pytest.fixture(scope="module")
def demo():
    problem = optloc.load(DEMO)
    return problem, optloc.solve(problem)


def test_the_ring_is_the_ellipse(demo):
    problem, fix = demo
    made = fixed_spots(problem, [fix], [])
    lat, lon, height = fix.geodetic
    back = problem.frame.from_geodetic(*np.radians(made.rings[0].T[::-1]), np.full(73, height))
    axes = problem.frame.enu_axes(fix.position)[:2]
    away = (back - fix.position) @ axes.T
    square = np.einsum("ni,ij,nj->n", away, np.linalg.inv(axes @ fix.covariance() @ axes.T), away)
    np.testing.assert_allclose(square, 5.991, rtol=2e-3)
    np.testing.assert_allclose(made.place[0], np.degrees([lon, lat]), rtol=1e-12)


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


def test_a_plane_frame_is_refused():
    problem = optloc.load(DEMO.parent / "ambiguous.toml")
    with pytest.raises(InvalidProblem, match="positions on Earth"):
        fix_page(problem, optloc.solve(problem), "")


def moving(folder, lat=47.0, lon=11.0):
    """Write a file of twelve epochs, and return its path."""
    stations = np.array([[0.0, 0.0], [8e3, 1e3], [3e3, 7e3], [9e3, 9e3]])
    names, rng, rows = ("A", "B", "C", "</script>"), np.random.default_rng(4), []
    for k in range(12):
        place = np.array([2e3 + 150.0 * k, 3e3 + 90.0 * k])
        for name, r in zip(names, np.linalg.norm(stations - place, axis=-1), strict=True):
            z = r + 5.0 * rng.standard_normal()
            rows.append(f'{{ a = "{name}", z = {z:.2f}, epoch = "e{k}", time = {float(k)} }}')
    path = folder / "run.toml"
    path.write_text(TRACK.format(rows=", ".join(rows), lat=lat, lon=lon), encoding="utf-8")
    return path


@pytest.mark.skipif(executable() is None, reason="needs chromium (Debian's package of that name)")
def test_a_browser_opens_the_pages(tmp_path):
    assert RUN.invoke(app, ["fix", str(DEMO), "--html", str(tmp_path / "fix.html"), "-q"]).exit_code == 0
    run = str(moving(tmp_path, lon=179.98))
    assert RUN.invoke(app, ["fix", run, "--html", str(tmp_path / "fixes.html"), "-q"]).exit_code == 0
    assert RUN.invoke(app, ["track", run, "--html", str(tmp_path / "track.html"), "-q"]).exit_code == 0
    with Browser() as browser:
        # The first scan alone does not tell the velocity, so that the track begins with the second.
        for name, marks in (("fix", 1), ("fixes", 12), ("track", 11)):
            for width, phone in ((1280, False), (390, True)):
                browser.open(tmp_path / f"{name}.html", width, 844, phone=phone)
                assert browser.messages == []
                assert browser.run("document.documentElement.scrollWidth") <= width
                layer = "fix" if name == "fixes" else name
                shown = f"document.querySelectorAll('[data-layer={layer}] .dot').length"
                assert browser.run(shown) == marks
                assert browser.run(_OUTSIDE) == 0
        assert browser.requests == [url for url in browser.requests if url.startswith("file:")]
        browser.open(tmp_path / "fix.html")
        told = browser.run(_POINT)
        assert told.startswith("ok, 47.8")
        assert browser.run("document.querySelector('[data-do=focus]').click()") is None
        assert browser.run("document.querySelector('.ring').getBoundingClientRect().width") > 60


_OUTSIDE = """(() => { const box = document.querySelector('.map svg').getBoundingClientRect();
  return [...document.querySelectorAll('.map .dot')].filter(dot => { const b = dot.getBoundingClientRect();
    return b.x < box.x || b.x > box.right || b.y < box.y || b.y > box.bottom; }).length; })()"""
_POINT = """(() => { const dot = document.querySelector('[data-layer=fix] .dot'), b = dot.getBoundingClientRect();
  document.querySelector('.map svg').dispatchEvent(
    new PointerEvent('pointermove', { clientX: b.x + b.width / 2, clientY: b.y + b.height / 2, bubbles: true }));
  return document.querySelector('.map output').textContent; })()"""


def test_an_ellipse_that_does_not_cover_is_dotted_on_the_map(monkeypatch):
    """Of many curved fixes no region is enclosed, which takes a tenth of a second each: here from the first on."""
    monkeypatch.setattr("optloc.show.pictures.outlines._MOST", 0)
    lat, lon = np.radians([47.812, 47.751, 47.79]), np.radians([11.183, 11.148, 11.31])
    stations = optloc.station_array(optloc.problem.ECEF.from_geodetic(lat, lon, np.array([612.0, 640.0, 842.0])), "ABC")
    rows = optloc.measured("range", np.array([9000.0, 12300.0, 1500.0]), a=[0, 1, 2], sigma=800.0)
    problem = optloc.assemble(
        stations, rows, frame=optloc.problem.ECEF, constraints=(optloc.constraints.height(exactly=700.0),)
    )
    fix = optloc.solve(problem)
    assert fixed_spots(problem, [fix], []).local.all()
    page = fix_page(problem, fix, "far from an ellipse")
    assert "dotted: a local ellipse, not valid" in page
    assert 'class="ring local"' in page


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
    assert constraint_lines(assemble(station_array(places), rows, constraints=limits), [fix]) == []
