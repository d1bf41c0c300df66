"""Pages with maps: texts without scripts, and a browser that opens them on a desk and on a phone."""

import re
from importlib.resources import files as package_files

import numpy as np
import pytest
from show.browser import TOO_SMALL, Browser, executable, kept, readable
from show.ranging import ranged
from typer.testing import CliRunner

import optloc
from optloc.cli import app
from optloc.show import fix_page, live_page

RUN = CliRunner()
NEEDS_BROWSER = pytest.mark.skipif(executable() is None, reason="needs chromium (Debian's package of that name)")
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


def batch():
    """Return a problem of 200 epochs over Europe, solved apart: some are misfits, some are not determined."""
    rng, frame = np.random.default_rng(1), optloc.problem.ECEF
    lat, lon = np.radians([52.5, 48.9, 41.9, 59.3]), np.radians([13.4, 2.3, 12.5, 18.1])
    stations = optloc.station_array(
        frame.from_geodetic(lat, lon, np.full(4, 100.0)), ("Berlin", "Paris", "Rome", "Oslo")
    )
    north, east = np.radians(rng.uniform(43.0, 57.0, 200)), np.radians(rng.uniform(3.0, 18.0, 200))
    truth = frame.from_geodetic(north, east, np.full(200, 10e3))
    z = np.linalg.norm(truth[:, None] - stations.position, axis=-1) + rng.normal(0.0, 300.0, (200, 4))
    z[::17, 2] += 20e3
    rows = optloc.measured("range", z, a=np.arange(4), sigma=300.0)
    return optloc.assemble(stations, rows, frame=frame, constraints=(optloc.constraints.height(exactly=10e3),))


def test_the_page_of_a_fix_has_status_coordinates_and_sigma_without_scripts():
    problem, fix = ranged()
    page = re.sub(r"<script.*?</script>", "", fix_page(problem, fix, "Four ranges"), flags=re.DOTALL)
    lat, lon, _ = np.degrees(fix.geodetic)
    assert '<span class="status">ok</span>' in page
    assert f"<code>{lat:.6f}, {lon:.6f}</code>" in page
    assert "sigma east, north: 1" in page
    assert re.search(r'<title id="map-1-title">Four ranges</title><desc id="map-1-about">Map of 4 stations', page)
    assert "<b>S1</b>" in page or "<b>1</b>" in page
    assert page.count('class="station"') == 4 + 1  # and one in the legend


def test_a_plane_frame_has_a_grid_instead_of_a_coast():
    problem = optloc.load(DEMO.parent / "ambiguous.toml")
    page = fix_page(problem, optloc.solve(problem), "Two places")
    assert 'data-layer="grid"' in page
    assert 'class="land"' not in page
    assert "GeoNames" not in page
    assert "alternative, cost gap" in page
    assert "data-copy=" in page


def test_a_live_page_requests_its_own_server_only():
    problem, _ = ranged()
    page = live_page(problem, "Site")
    assert "connect-src &#39;self&#39;" in page
    assert "Not connected yet." in page
    assert "map.json" in page


_OUTSIDE = """(() => { const box = document.querySelector('.map .sheet').getBoundingClientRect();
  return [...document.querySelectorAll('.map .sheet .dot')].filter(dot => { const b = dot.getBoundingClientRect();
    return b.x < box.x || b.x > box.right || b.y < box.y || b.y > box.bottom; }).length; })()"""
_CENTRE = """(() => { const sheet = document.querySelector('.map .sheet');
  sheet.scrollIntoView({ block: 'center' });
  const b = sheet.getBoundingClientRect();
  return [b.x + b.width / 2, b.y + b.height / 2]; })()"""
_MARK = """(() => { const b = document.querySelector('[data-layer=fix] .dot').getBoundingClientRect();
  return [b.x + b.width / 2, b.y + b.height / 2]; })()"""
_KEY = (
    "document.querySelector('.map .sheet').dispatchEvent(new KeyboardEvent('keydown', {{ key: '{}', bubbles: true }}))"
)
_VIEW = "document.querySelector('.map .sheet').getAttribute('viewBox').split(' ').map(Number)"


@NEEDS_BROWSER
def test_a_browser_opens_the_page_of_a_fix(tmp_path):
    problem = optloc.load(DEMO)
    path = tmp_path / "fix.html"
    path.write_text(fix_page(problem, optloc.solve(problem), "One pulse"), encoding="utf-8")
    with Browser() as browser:
        readable(browser, path, "fix")
        assert browser.requests == [url for url in browser.requests if url.startswith("file:")]
        browser.open(path)
        assert browser.run(_OUTSIDE) == 0
        browser.run("document.querySelector('[data-do=focus]').click()")
        assert browser.run("document.querySelector('.sheet .ring').getBoundingClientRect().width") > 60
        # keys of the map
        browser.run(_KEY.format("0"))
        whole = browser.run(_VIEW)
        browser.run(_KEY.format("ArrowRight"))
        assert browser.run(_VIEW)[0] > whole[0]
        browser.run(_KEY.format("+"))
        assert browser.run(_VIEW)[2] < whole[2]
        browser.run(_KEY.format("Enter"))
        assert browser.run("document.querySelectorAll('.list .picked').length") == 1
        assert "47.8" in browser.run("document.querySelector('.map output').textContent")
        # a switch hides its layer, and a button copies
        browser.run("document.querySelector('[value=names]').click()")
        assert browser.run("document.querySelector('[data-layer=names]').style.display") == "none"
        browser.run("document.querySelector('.copy').click()")
        browser.run("new Promise(done => setTimeout(done, 300))")
        assert browser.run("document.querySelector('.map output').textContent").startswith(
            ("Copied: 47.8", "The browser")
        )


@NEEDS_BROWSER
@pytest.mark.slow
def test_a_browser_opens_pages_of_many_kinds(tmp_path):
    problem, plane = batch(), optloc.load(DEMO.parent / "ambiguous.toml")
    names, times = [f"pulse {i}" for i in range(200)], 1.7e9 + np.arange(200.0)
    pages = {
        "batch": fix_page(problem, optloc.solve(problem), "Two hundred fixes", names, times=times),
        "plane": fix_page(plane, optloc.solve(plane), "Two places"),
    }
    for name, text in pages.items():
        (tmp_path / f"{name}.html").write_text(text, encoding="utf-8")
    run = str(moving(tmp_path, lon=179.98))
    assert RUN.invoke(app, ["fix", run, "--html", str(tmp_path / "fixes.html"), "-q"]).exit_code == 0
    assert RUN.invoke(app, ["track", run, "--html", str(tmp_path / "track.html"), "-q"]).exit_code == 0
    assert RUN.invoke(app, ["crlb", str(DEMO), "--map", str(tmp_path / "bound.html")]).exit_code == 0
    with Browser() as browser:
        for name in ("batch", "plane", "fixes", "track", "bound"):
            readable(browser, tmp_path / f"{name}.html", name)
        # The first scan alone does not tell the velocity, so that the track begins with the second.
        for name, layer, marks, rows in (
            ("fixes", "fix", 12, 12),
            ("track", "track", 11, 12),
            ("batch", "fix", 200, 200),
        ):
            browser.open(tmp_path / f"{name}.html", 390, 844, phone=True)
            assert browser.run(f"document.querySelectorAll('[data-layer={layer}] [data-row]').length") == marks
            assert browser.run("document.querySelectorAll('.list li').length") == rows
            assert browser.run(_OUTSIDE) == 0


@NEEDS_BROWSER
@pytest.mark.slow
def test_fingers_move_the_map_and_select_a_mark(tmp_path):
    problem, fix = ranged()
    path = tmp_path / "fix.html"
    path.write_text(fix_page(problem, fix, "Four ranges"), encoding="utf-8")
    with Browser() as browser:
        browser.open(path, 390, 844, phone=True)
        browser.ask("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)

        def touch(kind, *points):
            fingers = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
            browser.ask("Input.dispatchTouchEvent", type=f"touch{kind}", touchPoints=fingers)

        whole = browser.run(_VIEW)
        x, y = browser.run(_CENTRE)
        touch("Start", (x, y))
        touch("Move", (x + 50, y + 20))
        touch("End")
        moved = browser.run(_VIEW)
        assert moved[0] < whole[0]
        assert moved[2] == whole[2]
        touch("Start", (x - 30, y))
        touch("Start", (x - 30, y), (x + 30, y))
        touch("Move", (x - 60, y), (x + 60, y))
        touch("End")
        assert browser.run(_VIEW)[2] == pytest.approx(0.5 * whole[2])
        browser.run("document.querySelector('[data-do=all]').click()")
        x, y = browser.run(_MARK)
        touch("Start", (x + 6, y))  # a finger is wider than a mark
        touch("End")
        assert browser.run("document.querySelectorAll('.list .picked').length") == 1
        assert browser.messages == []


@NEEDS_BROWSER
def test_a_page_is_readable_without_scripts(tmp_path):
    problem, fix = ranged()
    path = tmp_path / "still.html"
    path.write_text(fix_page(problem, fix, "Four ranges"), encoding="utf-8")
    with Browser() as browser:
        for width, phone in ((1280, False), (390, True)):
            browser.open(path, width, 844, phone=phone, scripts=False)
            kept(browser, f"still-{width}")
            browser.ask("Emulation.setScriptExecutionDisabled", value=False)
            assert browser.run(TOO_SMALL) == []
            assert browser.run("document.documentElement.scrollWidth") <= width
            assert "ok" in browser.run("document.querySelector('.list').innerText")
