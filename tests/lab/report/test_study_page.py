"""Reports: the files of a study's report hold its numbers, and a browser shows all of it, on a desk and on a phone."""

import csv
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from often import few
from show.browser import Browser, executable
from typer.testing import CliRunner

from optloc.base.errors import InvalidProblem
from optloc.cli import app
from optloc.lab.report.study_page import write_report
from optloc.lab.study.design import design_of
from optloc.lab.study.execute import executor, run_design
from optloc.lab.study.folder import begin, read_frame
from optloc.show.drawing import marks as looks_of, panel, svg_text
from optloc.show.maps.canvas import Canvas, Curve, Label, LegendEntry, MapRow
from optloc.show.page import PagePart, write_page
from optloc.show.sheet import Sheet, TextTable

RUN = CliRunner()
TEXT = """
format = 1
name = "site"
title = 'A site <b>on Earth</b> & "elsewhere"'
seed = 5
trials = 6

[[scenario]]
name = "our site"
problem = "demo"
truth = { kind = "area", lat_deg = [47.6, 48.0], lon_deg = [11.0, 11.5], height = "3 km" }
noise = [1.0, 4.0]

[[scenario]]
name = "ring & <script>alert(1)</script>"
layout = { stations = 6, dimension = 2, placement = "ring" }
truth = { kind = "box", box = ["20 km", "20 km"] }
noise = ["10 m"]

[[method]]
method = ["gtrs+lsr", "gtrs"]

[[method]]
baseline = ["gauss-newton", "truth"]
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A study on Earth and in a plane."""
    folder = tmp_path_factory.mktemp("report") / "site"
    file = folder.with_suffix(".toml")
    file.write_text(TEXT, encoding="utf-8")
    run_design(design_of(file), folder, executor("processes", 1))
    return folder


@pytest.fixture(scope="module")
def made(site):
    return write_report(site)


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    """The report of a shipped study, with few trials."""
    folder = tmp_path_factory.mktemp("report") / "divergence"
    run_design(design_of(folder.relative_to(folder.parent), trials=2), folder, executor("processes", 1))
    return write_report(folder)


@pytest.mark.slow
def test_tables_hold_the_numbers_of_the_study(site, made):
    frame = read_frame(site)
    with (site / "report" / "tables" / "success.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 4
    for row in rows:
        part = frame[
            (frame["scenario"] == row["case"]) & (frame["method"] == row["method"])
            & (frame["noise_label"] == row["noise_label"])
        ]  # fmt: skip
        assert int(row["trials"]) == len(part) == 6
        assert int(row["answered"]) == part["answered"].sum()
    with (site / "report" / "tables" / "statuses.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    told = frame.groupby(["method", "status"], observed=True).size()
    assert {(row["method"], row["status"]): int(row["trials"]) for row in rows} == told.to_dict()
    with (site / "report" / "tables" / "accuracy.csv").open(encoding="utf-8") as file:
        row = next(r for r in csv.DictReader(file) if r["method"] == "gtrs+lsr" and r["noise_label"] == "4.0")
    part = frame[(frame["scenario"] == "our site") & (frame["method"] == "gtrs+lsr") & (frame["noise_label"] == "4.0")]
    assert float(row["rmse"]) == pytest.approx(np.sqrt((part["error"][part["answered"]] ** 2).mean()))


@pytest.mark.slow
def test_every_figure_is_there_twice_and_every_table_too(site, made):
    folder = site / "report"
    assert made[0] == folder / "report.html"
    assert sorted(made[1:]) == sorted([*(folder / "tables").iterdir(), *(folder / "figures").iterdir()])
    names = {path.stem for path in (folder / "figures").iterdir()}
    assert {
        "success-1",
        "accuracy-1",
        "errors-1",
        "gaps-1",
        "data-profile",
        "profile",
        "time-1",
        "map-1",
        "map-2",
    } <= names
    for name in names:
        assert (folder / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert ET.parse(folder / "figures" / f"{name}.svg").getroot().tag.endswith("svg")
    assert {p.stem for p in (folder / "tables").iterdir()} == {
        "ranking", "success", "statuses", "accuracy", "certificates", "profiles", "timing", "machine"
    }  # fmt: skip


@pytest.mark.slow
def test_the_page_needs_nothing_and_is_not_fooled_by_names(made):
    text = made[0].read_text(encoding="utf-8")
    assert "<script>alert(1)" not in text
    assert "<b>on Earth" not in text
    linked = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert all(link.startswith(("#", "data:")) for link in linked), linked[:5]
    identities = re.findall(r'\bid="([^"]*)"', text)
    assert len(identities) == len(set(identities))


def test_every_text_of_a_page_is_escaped():
    bad = "\"'><script>alert(1)</script>{{ 7 * 7 }}</pre>"
    marks = [Curve("dot", "M0 0h0", hover=bad), Label("name", 0.0, 0.0, bad)]
    rows = [MapRow(bad, bad, bad, "ok", bad, bad, bad, bad, 0.0, 0.0)]
    more = {"rows": rows, "counted": bad, "stations": [(bad, bad)], "legend": [LegendEntry("ok", bad)], "summary": bad}
    canvas = Canvas("map-1", bad, {"stations": marks}, bad, "0 0 1 1", "", {"text": bad}, listed=True, **more)
    sheet = Sheet(None, TextTable("t", bad, (bad,), ((bad,),), bad))
    part = PagePart("p", bad, bad, tables=[sheet], maps=[canvas], headings=True, folded=[sheet], source=bad, note=bad)
    page = write_page(bad, [part, part], opening=[bad], facts=bad, methods=looks_of([bad]).values())
    assert "<script>alert" not in page
    assert page.count("{{ 7 * 7 }}") == page.count("alert(1)") > 15
    assert all(mark not in page for mark in ("\"'>", "alert(1)</"))


def test_dollars_in_a_name_begin_no_formula():
    figure, _ = panel("gain $\\nosuch$")
    assert "gain $\\nosuch$" in svg_text(figure)


@pytest.mark.full
def test_the_same_study_gives_the_same_figures(site, made, tmp_path):
    again = write_report(site, tmp_path / "again")
    for one, two in zip(sorted(made), sorted(again), strict=True):
        assert one.name == two.name
        assert one.read_bytes() == two.read_bytes(), one.name


@pytest.mark.slow
def test_what_begins_at_the_truth_is_not_ranked(site, made):
    text = (site / "report" / "tables" / "ranking.csv").read_text(encoding="utf-8")
    assert "gtrs+lsr" in text
    assert "truth" not in text


browsed = pytest.mark.skipif(executable() is None, reason="needs chromium (Debian's package of that name)")
WIDTHS = [pytest.param((1280, 900, False), id="desk"), pytest.param((390, 844, True), id="phone")]
BOXES = """[...document.querySelectorAll('figure, .map')].map(f => {
  const box = f.querySelector('svg').getBoundingClientRect();
  return [f.id, box.left, box.right, box.height, f.querySelectorAll('path').length];
})"""


@pytest.fixture(scope="module")
def browser():
    with Browser() as one:
        yield one


@pytest.mark.slow
@browsed
@pytest.mark.parametrize("size", WIDTHS)
@pytest.mark.parametrize("study", few(["made", "shipped"], 1))
def test_a_browser_shows_every_figure(browser, request, study, size):
    page, *files = request.getfixturevalue(study)
    width, height, phone = size
    browser.messages.clear()
    browser.requests.clear()
    browser.open(page, width, height, phone=phone)
    assert browser.messages == []
    assert [url.partition(":")[0] for url in browser.requests] == ["file"]
    assert browser.run("document.documentElement.scrollWidth") <= width
    boxes = {name: box for name, *box in browser.run(BOXES)}
    wanted = {path.stem for path in files if path.suffix == ".svg"}
    assert {name.removeprefix("figure-") for name in boxes} == wanted
    for left, right, tall, paths in boxes.values():
        assert 0 <= left < right <= width
        assert right - left > 0.8 * min(width, 440) - 40
        assert tall > 100
        assert paths > 5
    assert browser.run("[...document.querySelectorAll('table')].every(t => t.closest('.scroll'))")
    assert browser.run("document.querySelectorAll('tbody tr').length") > 10


@pytest.mark.slow
@browsed
def test_a_method_stands_out_at_a_press(browser, made):
    browser.open(made[0])
    browser.run("document.querySelector('.legend button').click()")
    assert browser.run("document.body.classList.contains('picked')")
    lines = "[...document.querySelectorAll('svg [class^=\"method-0\"]')]"
    assert browser.run(f"{lines}.length") > 5
    assert browser.run(f"{lines}.every(l => getComputedStyle(l).opacity === '1')")
    assert browser.run("getComputedStyle(document.querySelector('svg [class^=\"method-1\"]')).opacity") == "0.12"
    browser.run("document.querySelector('.legend button').click()")
    assert not browser.run("document.body.classList.contains('picked')")


@pytest.mark.slow
@browsed
def test_the_map_tells_the_bound_and_moves(browser, site, made):
    browser.open(made[0])
    browser.run("document.querySelector('.map').scrollIntoView({block: 'center'})")
    box = "(r => [r.left, r.top, r.width, r.height])(document.querySelector('.map svg').getBoundingClientRect())"
    left, top, width, height = browser.run(box)
    centre = {"x": left + width / 2, "y": top + height / 2}
    browser.ask("Input.dispatchMouseEvent", type="mouseMoved", **centre)
    told = browser.run("document.querySelector('.map output').textContent")
    found = re.fullmatch(r"(47|48)\.\d+° N, 11\.\d+° E: bound ([\d.]+) m", told)
    assert found, told
    assert 5.0 < float(found[2]) < 500.0
    view = "document.querySelector('.map svg').getAttribute('viewBox').split(' ').map(Number)"
    before = browser.run(view)
    browser.ask("Input.dispatchMouseEvent", type="mouseWheel", **centre, deltaX=0, deltaY=-120)
    nearer = browser.run(view)
    assert nearer[2] < before[2]
    browser.run("document.querySelector('[data-do=all]').click()")
    assert browser.run(view) == before
    browser.run("document.querySelector('.layers input').click()")
    assert browser.run("document.querySelector('[data-layer=bound]').style.display") == "none"


@pytest.mark.slow
@browsed
def test_it_prints_with_its_tables_open(browser, made):
    browser.open(made[0])
    paper = browser.pdf()
    assert paper.startswith(b"%PDF")
    assert len(paper) > 100_000
    browser.ask("Emulation.setEmulatedMedia", media="print")
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    browser.ask("Emulation.setEmulatedMedia", media="")
    browser.run("dispatchEvent(new Event('beforeprint'))")
    assert browser.run("[...document.querySelectorAll('details')].every(d => d.open)")


@pytest.mark.full
def test_a_study_that_is_not_finished_says_so(site, tmp_path):
    some = tmp_path / "some"
    (some / "parts").mkdir(parents=True)
    (some / "manifest.json").write_bytes((site / "manifest.json").read_bytes())
    for part in sorted((site / "parts").iterdir())[:5]:
        (some / "parts" / part.name).write_bytes(part.read_bytes())
    text = write_report(some)[0].read_text(encoding="utf-8")
    assert "not finished" in text


@pytest.mark.slow
def test_bad_places_are_sentences(site, tmp_path):
    empty = tmp_path / "empty"
    begin(design_of(site.with_suffix(".toml")), empty)
    with pytest.raises(InvalidProblem, match="the study has no finished part yet"):
        write_report(empty)
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidProblem, match="cannot be made"):
        write_report(site, tmp_path / "file")
    found = RUN.invoke(app, ["study", "report", str(tmp_path / "none")])
    assert found.exit_code == 2
    assert "there is no such folder" in found.output
