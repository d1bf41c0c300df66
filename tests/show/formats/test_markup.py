"""XML of marks, read by a parser: places, covariances, and names that XML cannot hold."""

from xml.etree import ElementTree as ET

import numpy as np
import pytest
from show.ranging import ENU, ranged

from optloc import InvalidProblem
from optloc.show.columns import fix_columns
from optloc.show.formats.marks import Results, mark_of
from optloc.show.formats.markup import cot, event, gpx, kml

KML, GPX = "{http://www.opengis.net/kml/2.2}", "{http://www.topografix.com/GPX/1/1}"


def results(title="four ranges"):
    problem, fix = ranged()
    return Results(fix_columns(fix), ENU, (fix,), problem, title)


def test_kml_has_the_place_of_each_station_and_fix():
    document = ET.fromstring(kml(results("a <b> \x07")))
    points = [point.text.split(",") for point in document.iter(f"{KML}coordinates")]
    places = [place for _, place in results().stations()] + [results().marks()[0].place]
    for text, place in zip(points, places, strict=False):
        assert [float(v) for v in text[:2]] == pytest.approx(place[:2], abs=1e-9)
    assert len(list(document.iter(f"{KML}Polygon"))) == 1
    assert document.find(f"{KML}Document/{KML}name").text.startswith("a <b>")


@pytest.mark.parametrize(
    ("epochs", "times", "names"),
    [
        (
            ["1782900000", "1782900005.25"],
            [1782900000.0, 1782900005.25],
            ["2026-07-01T10:00:00", "2026-07-01T10:00:05"],
        ),
        (["first", "second"], [1782900000.0, 1782900005.25], ["first", "second"]),
    ],
)
def test_an_epoch_without_a_label_is_named_by_its_date(epochs, times, names):
    columns = {name: np.repeat(values, 2) for name, values in fix_columns(ranged()[1]).items()}
    columns |= {"epoch": np.array(epochs, dtype=object), "time": np.array(times)}
    found = [mark.name for mark in Results(columns, ENU, dated=True).marks()]
    assert all(name.startswith(start) for name, start in zip(found, names, strict=True)), found
    assert [mark.name for mark in Results(columns, ENU).marks()] == epochs


def test_seconds_without_a_scale_are_no_dates():
    columns = {**fix_columns(ranged()[1]), "time": np.array([1.4e9])}
    assert ET.fromstring(gpx(Results(columns, ENU))).find(f".//{GPX}time") is None
    with pytest.raises(InvalidProblem, match="Cursor on Target needs dates, but the times have no time scale"):
        cot(Results(columns, ENU))
    assert cot(Results({**columns, "time": np.array([np.nan])}, ENU))


def test_a_height_of_zero_has_no_sign():
    level = mark_of(ENU, np.array([0.0, 0.0, -400.0001]), np.eye(3), "ok", name="m", target="m", time=np.nan)
    assert level.place[2] < 0.0
    assert ET.fromstring(event(level)).find("point").get("hae") == "0.000"


def test_gpx_has_the_covariance_along_east_and_north():
    document = ET.fromstring(gpx(results()))
    kinds = [point.find(f"{GPX}type").text for point in document.iter(f"{GPX}wpt")]
    assert kinds == ["station"] * 4 + ["fix"]
    (cov,) = document.iter("{urn:optloc:fix}covariance_enu_m2")
    level = results().marks()[0].level
    assert [float(v) for v in cov.text.split()] == pytest.approx([level[0, 0], level[0, 1], level[1, 1]], rel=1e-8)


def test_an_event_has_errors_and_course_or_their_sign_of_unknown():
    about = {"name": "m", "target": "m", "time": 1_700_000_000.0, "dated": True}
    sure = mark_of(ENU, np.zeros(3), np.diag([9.0, 4.0, 1.0]), "ok", velocity=np.array([3.0, 4.0, 0.0]), **about)
    found = ET.fromstring(event(sure))
    assert (found.get("type"), found.get("start")) == ("a-u-G", "2023-11-14T22:13:20.000Z")
    assert [float(found.find("point").get(key)) for key in ("ce", "le")] == [3.0, 1.0]
    assert float(found.find("detail/track").get("speed")) == 5.0
    assert float(found.find("detail/track").get("course")) == pytest.approx(36.87, abs=0.01)
    doubtful = ET.fromstring(event(mark_of(ENU, np.zeros(3), np.eye(3), "misfit", **about)))
    assert (doubtful.get("type"), doubtful.find("point").get("ce")) == ("a-p-G", "9999999.000")
    assert event(mark_of(ENU, np.full(3, np.nan), np.eye(3), "unbounded", **about)) == ""
