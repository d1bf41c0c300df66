"""The methods of a fix: text, HTML, dictionaries, data frames and maps, with the labels of the user."""

import numpy as np
import pytest
from show.answers import batch
from show.ranging import ranged

import optloc
from optloc.show.columns import fix_columns, fix_detail
from optloc.show.fixes import dict_of, frame_of, geojson_of, html_of, in_order_of_answer, text_of
from optloc.show.formats.marks import Results


def test_text_and_html_are_those_of_the_answer():
    _, fix = ranged()
    assert text_of(fix).splitlines()[0].split() == ["status", "ok"]
    assert html_of(fix).count("<table") == html_of(fix).count("</table>") > 0


def test_other_forms_hold_the_same_position():
    problem, fix = ranged()
    assert [dict_of(fix)[axis] for axis in "xy"] == fix.position.tolist()
    features = geojson_of(fix, problem)["features"]
    assert [feature["properties"]["role"] for feature in features] == ["station"] * 4 + ["fix", "ellipse95"]


def test_alternatives_on_earth_have_latitude_longitude_and_height():
    site = optloc.Frame.enu(lat_deg=47.0, lon_deg=8.0)
    places = np.array([[0.0, 0.0, 0.0], [900.0, 0.0, 0.0], [0.0, 900.0, 0.0]])
    rows = optloc.measured("range", np.linalg.norm(places - [300.0, 400.0, 200.0], axis=1), a=[0, 1, 2], sigma=1.0)
    fix = optloc.solve(optloc.assemble(places, rows, frame=site))
    mirror = site.to_geodetic(fix.position * [1.0, 1.0, -1.0])
    (other,) = fix_detail(fix)["alternatives"]
    assert other["latlon"] == pytest.approx([*np.degrees(mirror[:2]).tolist(), float(mirror[2])], abs=1e-6)
    plain = optloc.solve(optloc.assemble(places, rows))
    assert "latlon" not in fix_detail(plain)["alternatives"][0]


def test_labels_of_fixes_travel_to_dictionaries_frames_and_files():
    fixes = batch()
    names = [f"event {i}" for i in range(25)]
    assert [one["label"] for one in dict_of(fixes)["fixes"]] == names
    assert frame_of(fixes).index.tolist() == names
    assert "label" not in frame_of(fixes)
    properties = [one["properties"] for one in geojson_of(fixes)["features"]]
    # the unbounded fixes have no position
    assert [one["label"] for one in properties if one["role"] == "fix"] == [names[i] for i in range(25) if i % 5]
    results = Results(fix_columns(fixes), fixes.frame, (fixes,))
    assert [mark.name for mark in results.marks()] == names


def test_keys_have_the_order_of_the_sections():
    record = dict_of(batch()[1])
    wanted = ["label", "status", "sentence", "lat_deg", "x", "sigma_x", "reason", "certificate"]
    assert [key for key in record if key in wanted] == wanted
    assert in_order_of_answer({"cost": 1, "status": 2}) == {"status": 2, "cost": 1}
