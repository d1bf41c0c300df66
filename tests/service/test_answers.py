"""Records of fixes and proofs, both phases as one, and other formats."""

import json

import numpy as np
import pytest

from optloc.base.frames import ECEF
from optloc.base.types import Status
from optloc.service.answers import FORMATS, Latest, join, to_aircraft, to_feature, to_line, to_mark, unproven, unsolved
from optloc.service.events import Event
from optloc.show.formats import FORMATS as FILE_FORMATS
from optloc.tracking.entry import scan_sentence

PLACE = {"lat_deg": 47.5, "lon_deg": 11.25, "height": 3048.0}
X = ECEF.from_geodetic(np.radians(47.5), np.radians(11.25), 3048.0)
FIX = {"event": "7", "phase": "fix", "status": "ok", "position": X.tolist(), "cov": np.eye(3).tolist(), **PLACE}


def event(**more):
    return Event("7", {}, {}, 0.0, 0.0, **({"closed": "whole"} | more))


def test_a_line_is_strict_json_with_null_for_what_is_not_finite():
    data = to_line({"a": float("nan"), "b": [1.0, {"c": float("inf")}]})
    assert json.loads(data) == {"a": None, "b": [1.0, {"c": None}]}
    assert data.endswith(b"\n")


def test_both_phases_are_one_record():
    proof = {"event": "7", "phase": "proof", "status": "ok", "proof": "global"}
    assert join(FIX | {"reason": "no proof yet"}, proof) == {k: v for k, v in FIX.items() if k != "phase"} | {
        "proof": "global"
    }
    assert join(None, proof) == {"event": "7", "status": "ok", "proof": "global"}


def test_an_event_says_what_is_not_as_usual_about_it():
    found = unsolved(event(closed="wait", revision=2, conflict=True, target="t"), error="why")
    assert found == {
        "event": "7", "phase": "fix", "error": "why", "position": None,
        "closed": "wait", "revision": 2, "conflict": True, "target": "t",
    }  # fmt: skip
    assert unsolved(event(), status="too few rows") == {
        "event": "7",
        "phase": "fix",
        "status": "too few rows",
        "position": None,
    }


def test_a_proof_that_was_not_finished_keeps_the_status():
    found = unproven(event(), "deadline", FIX)
    assert (found["phase"], found["status"], found["proof"], found["why"]) == ("proof", "ok", "unknown", "deadline")
    assert "status" not in unproven(event(), "deadline", None)
    assert "revision" not in found
    assert unproven(event(revision=2), "deadline", FIX)["revision"] == 2


def test_an_unproven_fix_of_a_stream_waits_for_its_proof():
    first = to_mark(FIX | {"status": "unproven"}, ECEF).words
    assert "its proof is not finished" in first
    assert Status.UNPROVEN.sentence not in first
    assert Status.UNPROVEN.sentence in to_mark(FIX | {"status": "unproven", "proof": "unknown"}, ECEF).words
    moving = FIX | {"status": "too few rows", "nis": None, "velocity": [1.0, 2.0, 3.0], "cov": np.eye(6).tolist()}
    assert scan_sentence("too few rows") in to_mark(moving, ECEF).words
    assert "velocity x: 1.0 ± 1.0 m/s" in to_mark(moving, ECEF).words


def test_features_and_aircraft_have_the_place_on_earth():
    bare = {name: value for name, value in FIX.items() if name != "cov"}
    feature = to_feature(bare, ECEF)
    assert feature["geometry"]["coordinates"] == [11.25, 47.5, 3048.0]
    assert feature["properties"] == {"event": "7", "phase": "fix", "status": "ok"}
    assert to_feature({"event": "7", "status": "stalled", "position": None}, ECEF)["geometry"] is None
    assert (to_aircraft(FIX)["alt_geom"], to_aircraft(FIX)["hex"]) == (10000, "7")  # feet


def test_a_feature_has_the_ellipse_and_the_sigmas_of_an_ok_fix_only():
    record = FIX | {"cov": np.diag([9.0, 9.0, 9.0]).tolist()}
    found = to_feature(record, ECEF)["properties"]
    assert [found[f"sigma_{axis}"] for axis in ("east", "north", "up")] == pytest.approx([3.0, 3.0, 3.0])
    # 5.991 is the 95 % quantile of chi-square with two degrees of freedom
    assert found["ellipse95_1"] == pytest.approx(3.0 * np.sqrt(5.991), rel=1e-4)
    assert "ellipse95_1" not in to_feature(record | {"status": "misfit"}, ECEF)["properties"]


def test_a_mark_is_at_the_position_of_its_record():
    mark = to_mark(FIX | {"alternatives": [{"position": (X + 1e3).tolist(), "gap": 2.0}]}, ECEF)
    assert (mark.status, mark.name) == ("ok", "7")
    (other,) = mark.others
    np.testing.assert_allclose(other.position, X + 1e3)
    assert other.probability == pytest.approx(1.0 / (1.0 + np.e))


def test_every_format_writes_a_fix_and_those_of_maps_leave_out_what_has_no_place():
    nowhere = {"event": "7", "phase": "fix", "status": "stalled", "position": None}
    for name, write in FORMATS.items():
        assert b"7" in write(FIX, ECEF), name
        assert (write(nowhere, ECEF) is None) == (name not in ("ndjson", "geojson")), name
    assert set(FORMATS) - set(FILE_FORMATS) <= {"ndjson", "aircraft", "geojson"}


def test_the_latest_fix_of_each_target_is_kept_and_the_oldest_leave():
    latest = Latest(most=2)
    for name in "abc":
        latest(FIX | {"event": name, "phase": "fix"})
    latest({"event": "c", "phase": "proof", "proof": "global"})
    latest({"event": "d", "position": None})
    found = latest.features(ECEF)["features"]
    assert [feature["properties"]["event"] for feature in found] == ["b", "c"]
    assert found[1]["properties"]["proof"] == "global"
    assert latest.aircraft()["messages"] == 3


def test_marks_have_trails_of_their_targets():
    latest = Latest()
    assert latest.marks(ECEF) | {"now": 0.0} == {"now": 0.0, "last": None, "fixes": []}
    for i in range(3):
        place = [FIX["position"][0] + 10.0 * i, *FIX["position"][1:]]
        latest(FIX | {"event": f"e{i}", "target": "T", "position": place})
    latest({"event": "e2", "phase": "proof", "status": "ok", "target": "T", "proof": "global"})
    found = latest.marks(ECEF)
    (mark,) = found["fixes"]
    assert (mark["name"], mark["status"], len(mark["trail"])) == ("T", "ok", 3)
    assert mark["trail"][-1] == mark["at"]
    assert found["last"] <= found["now"]
    assert latest.marks(ECEF)["fixes"][0] is mark  # only new fixes are computed
    json.dumps(found, allow_nan=False)
