"""``optloc crlb --map``: every kind of file, the height it is drawn at, and sentences for what cannot be."""

import json
from importlib.resources import files as package_files

import pytest
from show.browser import Browser, executable
from typer.testing import CliRunner

from optloc.cli import app

RUN = CliRunner()
DEMO = str(package_files("optloc") / "scenarios" / "demo.toml")
PLANE = str(package_files("optloc") / "scenarios" / "ambiguous.toml")


def mapped(out, *more, file=DEMO):
    return RUN.invoke(app, ["crlb", file, "--map", str(out), *more])


def test_geojson_is_at_the_height_that_is_asked_for(tmp_path):
    out = tmp_path / "m.geojson"
    assert mapped(out, "--height", "3000 ft", "--extent", "11,11.5,47.6,48").exit_code == 0
    features = json.loads(out.read_text())["features"]
    bounds = [f["properties"] for f in features if f["properties"]["role"] == "bound"]
    assert bounds[0]["height"] == pytest.approx(914.4)
    points = [
        p
        for f in features
        if f["geometry"]["type"] == "MultiLineString"
        for x in f["geometry"]["coordinates"]
        for p in x
    ]
    assert all(11 - 1e-6 <= lon <= 11.5 + 1e-6 and 47.6 - 1e-6 <= lat <= 48 + 1e-6 for lon, lat in points)


def test_pictures_are_written(tmp_path):
    assert mapped(tmp_path / "m.png", "--height", "3 km").exit_code == 0
    assert mapped(tmp_path / "d.svg", "--dilution", "--at", "0,0,4000", file=DEMO).exit_code == 0
    assert mapped(tmp_path / "p.pdf", file=PLANE).exit_code == 0
    assert all((tmp_path / name).stat().st_size > 5_000 for name in ("m.png", "d.svg", "p.pdf"))


@pytest.mark.skipif(executable() is None, reason="needs chromium (Debian's package of that name)")
def test_the_page_opens_without_complaint(tmp_path):
    assert mapped(tmp_path / "m.html").exit_code == 0
    with Browser() as browser:
        browser.open(tmp_path / "m.html", 390, 844, phone=True)
        assert browser.messages == []
        assert len(browser.requests) == 1
        assert browser.run("document.documentElement.scrollWidth") <= 390
        assert browser.run("document.querySelectorAll('.map .name').length") == 6
        assert browser.run("document.querySelector('.map .land').getAttribute('d').length") > 10


@pytest.mark.parametrize(
    ("name", "more", "file", "sentence"),
    [
        ("m.xyz", (), DEMO, "are unknown; use .png, .svg"),
        ("m.png", ("--extent", "1,2"), DEMO, "not an extent of a map; write west,east,south,north"),
        ("m.png", ("--extent", "12,11,47,48"), DEMO, "not an extent of a map"),
        ("m.png", ("--extent", "11,12,47,95"), DEMO, "not an extent of a map"),
        ("m.png", ("--height", "low"), DEMO, "low"),
        ("m.geojson", (), PLANE, "frame is cartesian"),
        ("m.html", ("--dilution",), DEMO, "can only be a picture"),
        ("no/m.png", (), DEMO, "cannot be written"),
    ],
)
def test_bad_input_is_a_sentence(tmp_path, name, more, file, sentence):
    found = mapped(tmp_path / name, *more, file=file)
    assert found.exit_code == 2
    assert sentence in found.output
    assert "Traceback" not in found.output
