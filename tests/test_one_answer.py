"""One answer in all outputs: the sentence of the status and the text of the sigmas are the same everywhere."""

import html
import json
import re
from functools import cache
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from multi_target.scenes import drawn
from show.answers import singles
from show.ranging import PLACES, ranged
from typer.testing import CliRunner

from optloc.base.types import Status
from optloc.cli.application import app
from optloc.multi_target import separate
from optloc.service.answers import fix_records, to_line
from optloc.service.events import Event
from optloc.service.feeds import Latest, to_feature
from optloc.show.answer_texts import sure_rows, with_sigma
from optloc.show.columns import fix_columns
from optloc.show.describe_emitters import answer_of_emitters
from optloc.show.formats.marks import Results
from optloc.show.formats.markup import cot, gpx, kml
from optloc.show.render import text_of_answer
from optloc.solvers import solve
from optloc.tracking.entry import scan_sentence

ROOT = Path(__file__).resolve().parents[1]


@cache
def on_earth():
    """Return single fixes on Earth by name; the advice for an unproven fix depends on its method."""
    found = {name: fix for name, fix in singles().items() if "Earth" in name}
    return found | {"no proof tried": solve(ranged()[0], "gtrs+lsr")}


def plain(text):
    """Return the words of a text, without tags, frames of tables and line breaks."""
    return " ".join(re.sub(r"<[^>]*>|[│┃]", " ", html.unescape(text)).split())


def first(document, tag):
    """Return the text of the first element of an XML document with a tag of any namespace."""
    return next(one.text for one in ET.fromstring(document).iter() if one.tag.rpartition("}")[2] == tag)


def outputs(fix):
    """Return the texts of a fix on Earth by output."""
    results = Results(fix_columns(fix), fix.frame, (fix,))
    found = {"print": repr(fix), "HTML": fix._repr_html_(), "KML": first(kml(results), "description")}
    if np.isfinite(fix.position).all():
        found |= {"GPX": first(gpx(results), "desc"), "CoT": first(cot(results).splitlines()[0], "remarks")}
        (mark,) = live_of(fix)[1].marks(fix.frame)["fixes"]
        found["live map"] = f"{mark['sentence']} {mark['size']}"
    return found


def live_of(fix):
    """Return the record of a fix in a stream, and its latest fixes."""
    (record,) = fix_records(fix.flat(), [Event("event", {}, {}, 0.0, 0.0, closed="whole")], None)
    latest = Latest()
    latest(record)
    return record, latest


def sentences_as_data(fix):
    """Return the sentence of a fix by output, for outputs that have it as a value of its own."""
    record, latest = live_of(fix)
    found = {"dictionary": fix.to_dict()["sentence"], "live line": json.loads(to_line(record))["sentence"]}
    found["live feature"] = to_feature(record, fix.frame)["properties"]["sentence"]
    roles = ("fix", "direction95", "ray", "curve")
    features = [one["properties"] for one in fix.to_geojson()["features"]]
    found |= {f"GeoJSON, {one['role']}": one["sentence"] for one in features if one["role"] in roles}
    for one in latest.features(fix.frame)["features"]:
        found["live map as GeoJSON"] = one["properties"]["sentence"]
    for one in latest.marks(fix.frame)["fixes"]:
        found["live map"] = one["sentence"]
    return found


@pytest.mark.parametrize("name", on_earth())
def test_a_fix_has_the_same_sentence_and_sigmas_in_all_outputs(name):
    fix = on_earth()[name]
    spread = sure_rows(fix_columns(fix), 0)
    for output, text in outputs(fix).items():
        words = plain(text)
        assert fix.sentence in words, output
        for label, value in spread:
            assert value in words.partition(label)[2][: len(value) + 2], (output, label)


@pytest.mark.parametrize("name", on_earth())
def test_a_fix_has_the_same_sentence_in_all_data(name):
    fix = on_earth()[name]
    found = sentences_as_data(fix)
    assert any(output.startswith("GeoJSON") for output in found)
    assert set(found.values()) == {fix.sentence}


RUN = """format = 2
title = "run"
[frame]
kind = "enu"
origin = { lat_deg = 47.0, lon_deg = 8.0, height = 400.0 }
[stations]
file = "stations.csv"
[[measurements]]
kind = "range"
file = "run.csv"
sigma = "2 m"
"""


def test_the_summary_of_a_track_has_the_words_of_its_marks(tmp_path):
    times = np.arange(12.0)
    path = np.array([300.0, 400.0]) + times[:, None] * np.array([5.0, -2.0])
    z = np.linalg.norm(path[:, None] - PLACES, axis=-1)
    lines = [
        f"{t},{t},{s},{value}" for t, row in zip(times, z, strict=True) for s, value in zip("ABCD", row, strict=True)
    ]
    (tmp_path / "run.csv").write_text("\n".join(["epoch,time,a,z", *lines]))
    places = [f"{name},{x},{y}" for name, (x, y) in zip("ABCD", PLACES.tolist(), strict=True)]
    (tmp_path / "stations.csv").write_text("\n".join(["name,x,y", *places]))
    (tmp_path / "run.toml").write_text(RUN)
    out = tmp_path / "run.kml"
    result = CliRunner().invoke(app, ["track", str(tmp_path / "run.toml"), "--out", str(out)], env={"COLUMNS": "300"})
    assert result.exit_code == 0, result.output
    descriptions = [one.text for one in ET.fromstring(out.read_text()).iter() if one.tag.endswith("description")]
    last = [text for text in descriptions if "sigma" in text][-1]
    words = plain(result.stdout)
    assert scan_sentence("ok") in last
    assert scan_sentence("ok") in words
    sigma = re.search(r"sigma east, north: ([^;]*);", last).group(1)
    assert f"sigma east, north {sigma}" in words


def test_emitters_have_the_sentence_of_their_status():
    scene = drawn(1, 1, false=0)
    (found,) = separate(scene.problem, scene.clutter)
    text = plain(text_of_answer(answer_of_emitters(found)))
    assert found.status.sentence in text
    assert found.status.sentence in plain(repr(found))
    for fix in found.fixes:
        assert with_sigma(fix.position[0], fix.sigma()[0], "").strip() in text


def test_each_sentence_is_written_once():
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "optloc").rglob("*.py")]
    labels = ("starting", "started", "restarted", "lost", *(one.label for one in Status))
    for sentence in {*(one.sentence for one in Status), *map(scan_sentence, labels)}:
        start = " ".join(sentence.split()[:8])
        assert sum(text.count(start) for text in texts) == 1, sentence
