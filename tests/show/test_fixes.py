"""What a fix says: numbers with their errors, p-values, counts of many fixes, and its forms as text and HTML."""

import numpy as np
import pytest
from show.ranging import ranged

import optloc
from optloc.base.records import join
from optloc.show.columns import fix_detail
from optloc.show.fixes import (
    alternative_sheet,
    as_p,
    count_sheet,
    dict_of,
    fix_sheet,
    frame_of,
    geojson_of,
    html_of,
    text_of,
    with_sigma,
)


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (1234.5678, 12.3, "1235 ± 12 m"),
        (1.23456, 0.0123, "1.235 ± 0.012 m"),
        (-0.001, 0.5, "0.00 ± 0.50 m"),
        (5.0, 0.0, "5 m (held)"),
        (5.0, np.inf, "5 m"),
    ],
)
def test_a_number_is_rounded_to_its_error(value, sigma, text):
    assert with_sigma(value, sigma, "m") == text


def test_a_sheet_has_the_numbers_of_the_fix():
    _, fix = ranged()
    rows = dict(fix_sheet(fix).rows)
    assert rows["status"].startswith("ok")
    text = " ".join(rows.values())
    for value, sigma in zip(fix.position, fix.sigma(), strict=True):
        assert with_sigma(value, sigma, "m") in text
    assert text_of(fix).splitlines()[0].split() == ["status", *rows["status"].split()]
    assert html_of(fix).count("<table") == html_of(fix).count("</table>") > 0


def test_many_fixes_are_counted_by_status():
    _, fix = ranged()
    sheet = count_sheet(frame_of(join([fix.flat()] * 3, 3)), "")
    assert [row[:2] for row in sheet.rows] == [("ok", "3")]
    assert sheet.title.startswith("3 fixes")
    # Three equal fixes: the median is each of them.
    assert sheet.rows[0][2] == f"{np.sqrt(np.trace(fix.covariance())):.3g}"


def test_other_forms_hold_the_same_position():
    problem, fix = ranged()
    assert [dict_of(fix)[axis] for axis in "xy"] == fix.position.tolist()
    features = geojson_of(fix, problem)["features"]
    assert [feature["properties"]["role"] for feature in features] == ["station"] * 4 + ["fix", "ellipse95"]


def test_a_p_value_is_short_and_absent_without_redundancy():
    assert as_p(np.nan) == "-"
    assert float(as_p(0.25)) == 0.25


def test_alternatives_on_earth_have_latitude_longitude_and_height():
    site = optloc.Frame.enu(lat_deg=47.0, lon_deg=8.0)
    places = np.array([[0.0, 0.0, 0.0], [900.0, 0.0, 0.0], [0.0, 900.0, 0.0]])
    rows = optloc.measured("range", np.linalg.norm(places - [300.0, 400.0, 200.0], axis=1), a=[0, 1, 2], sigma=1.0)
    fix = optloc.solve(optloc.assemble(places, rows, frame=site))
    mirror = site.to_geodetic(fix.position * [1.0, 1.0, -1.0])
    (other,) = fix_detail(fix)["alternatives"]
    assert other["latlon"] == pytest.approx([*np.degrees(mirror[:2]).tolist(), float(mirror[2])], abs=1e-6)
    sheet = alternative_sheet(fix)
    assert sheet is not None
    assert sheet.head[1] == "latitude, longitude, height in m"
    plain = optloc.solve(optloc.assemble(places, rows))
    assert "latlon" not in fix_detail(plain)["alternatives"][0]
