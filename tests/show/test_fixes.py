"""The methods of a fix: text, HTML, dictionaries, data frames and maps, with the labels of the user."""

from dataclasses import replace

import numpy as np
import pandas as pd
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


@pytest.mark.parametrize("names", [("burst",), ("day", "burst"), (None,)])
def test_a_data_frame_keeps_the_names_of_the_index(names):
    places = {"A": (0.0, 0.0), "B": (1000.0, 0.0), "C": (0.0, 1000.0), "D": (900.0, 1100.0)}
    ranges = np.linalg.norm(np.array([[300.0, 400.0], [310.0, 400.0]])[:, None] - [*places.values()], axis=-1)
    labels = [("mon", 7), ("tue", 9)] if len(names) == 2 else [7, 9]
    index = pd.MultiIndex.from_tuples(labels, names=names) if len(names) == 2 else pd.Index(labels, name=names[0])
    fix = optloc.locate(places, ranges=pd.DataFrame(ranges, columns=list(places), index=index), sigma=1.0)
    assert fix.to_dataframe().index.equals(index)
    assert tuple(fix.to_dataframe().index.names) == names
    assert fix.flat().label_names == fix[:1].label_names == names
    title = f"Fixes by {', '.join(names)}" if names[0] else "Fixes"
    assert title in str(fix).splitlines()
    assert f"<caption>{title}</caption>" in fix._repr_html_()


def test_a_dictionary_has_numbers_of_multipliers_and_sigmas_along_east_and_north():
    problem, fix = ranged()
    found = dict_of(fix)
    axes = problem.frame.enu_axes(fix.position)[:2]
    sigma = np.sqrt(np.diagonal(axes @ fix.covariance() @ axes.T))
    assert [found["sigma_east"], found["sigma_north"]] == pytest.approx(sigma.tolist())
    assert "sigma_up" not in found
    held = optloc.solve(replace(problem, constraints=(*optloc.constraints.box([-np.inf, -np.inf], [290.0, np.inf]),)))
    (one,) = held.active[()]
    assert dict_of(held)["multipliers"] == [one.multiplier]
    assert one.multiplier > 0.0
