"""Feeds: records in other formats, the latest fixes, and streams whose feeds are read by parsers of others."""

import contextlib
import json
import shutil
import socket
import subprocess
import time
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from service.lines import Answers, arrivals, differences, line, solved

from optloc.base.frames import ECEF
from optloc.base.types import Status
from optloc.service.feeds import FORMATS, Latest, to_aircraft, to_feature, to_mark
from optloc.service.stream import Settings, Stream
from optloc.show.formats import FORMATS as FILE_FORMATS

PLACE = {"lat_deg": 47.5, "lon_deg": 11.25, "height": 3048.0}
X = ECEF.from_geodetic(np.radians(47.5), np.radians(11.25), 3048.0)
FIX = {"event": "7", "phase": "fix", "status": "ok", "position": X.tolist(), "cov": np.eye(3).tolist(), **PLACE}
COUNT = 3
TIME = 1_700_000_000.25


def test_a_mark_has_the_sentence_of_its_record():
    assert "ok. Wait for it. latitude" in to_mark(FIX | {"sentence": "Wait for it."}, ECEF).words
    assert Status.OK.sentence in to_mark(FIX, ECEF).words
    moving = FIX | {"status": "started", "nis": None, "velocity": [1.0, 2.0, 3.0], "cov": np.eye(6).tolist()}
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


# Streams in the default two phases: the feeds carry the proven fix.


@pytest.fixture(scope="module")
def z(on_earth):
    return differences(on_earth, arrivals(on_earth, COUNT))


@pytest.fixture(scope="module")
def truth(on_earth, z):
    """Return latitudes and longitudes (degrees) and heights (m) of the fixes."""
    fix = solved(on_earth, z)[1]
    return fix.latlon[:, 0], fix.latlon[:, 1], fix.frame.to_geodetic(fix.position)[2]


def feed(site, z, form, **settings):
    """Return the output of a stream in a format."""
    out = Answers()
    stream = Stream(site, Settings(**({"format": form, "shed": False, "deadline": 1e6} | settings)), out)
    lines = [line(event=str(i), z=row, target=f"T{i}", time=TIME + i) for i, row in enumerate(z.tolist())]
    stream.inbox.put(stream.lines(lines, "test"))
    stream.close()
    assert stream.ended.wait(60.0)
    return out.data


def test_cursor_on_target_has_a_pending_event_and_then_its_update(on_earth, z, truth):
    events = [ET.fromstring(each) for each in feed(on_earth, z, "cot").splitlines()]
    for i in range(COUNT):
        pending, judged = [each for each in events if each.get("uid") == f"optloc.T{i}"]
        assert (pending.get("type"), judged.get("type")) == ("a-p-G", "a-u-G")
        assert judged.get("time") >= pending.get("time")
        point = judged.find("point")
        assert float(point.get("lat")) == pytest.approx(truth[0][i], abs=1e-8)
        assert float(point.get("ce")) < 100.0 < float(pending.find("point").get("ce"))
        assert judged.find("detail/remarks").text.startswith("ok. ")


def test_a_parser_of_cursor_on_target_reads_the_update(on_earth, z, truth):
    takproto = pytest.importorskip("takproto", reason="needs takproto")
    last = feed(on_earth, z, "cot").decode().splitlines()[-COUNT:]
    found = {event.uid: event for event in (takproto.parse_proto(takproto.xml2proto(each)).cotEvent for each in last)}
    for i in range(COUNT):
        event = found[f"optloc.T{i}"]
        assert (event.type, event.how, event.detail.contact.callsign) == ("a-u-G", "m-f", f"T{i}")
        assert event.startTime == round(1000 * (TIME + i))
        assert (event.lat, event.lon) == pytest.approx((truth[0][i], truth[1][i]), abs=1e-8)
        assert event.hae == pytest.approx(truth[2][i], abs=1e-3)
        assert event.ce < 100.0


def test_nmea_has_one_judged_position_for_each_event(on_earth, z, truth):
    pynmea2 = pytest.importorskip("pynmea2", reason="needs pynmea2")
    found = [pynmea2.parse(each, check=True) for each in feed(on_earth, z, "nmea").decode().splitlines()]
    assert [each.sentence_type for each in found] == ["GGA", "GST"] * COUNT
    for i, (place, spread) in enumerate(zip(found[::2], found[1::2], strict=True)):
        assert place.gps_qual == 1
        assert int(place.num_sats) == len(z[i])
        assert place.timestamp.strftime("%H:%M:%S.%f") == f"22:13:2{i}.250000"
        assert (place.latitude, place.longitude) == pytest.approx((truth[0][i], truth[1][i]), abs=1e-8)
        assert place.altitude + float(place.geo_sep) == pytest.approx(truth[2][i], abs=1e-3)
        assert 0.0 < spread.std_dev_minor < spread.std_dev_major < 100.0


@pytest.mark.skipif(shutil.which("gpsd") is None, reason="needs gpsd")
def test_gpsd_reads_the_feed(on_earth, z, truth):
    """gpsd reads the sentences from a socket, and reports their positions to its own readers."""
    lines = feed(on_earth, z, "nmea")
    with socket.create_server(("127.0.0.1", 0)) as source, socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        taken.close()
        place = f"tcp://127.0.0.1:{source.getsockname()[1]}"
        daemon = subprocess.Popen(["gpsd", "-N", "-n", "-S", str(port), place], stderr=subprocess.DEVNULL)
        try:
            reader = connected(port)
            reader.sendall(b'?WATCH={"enable":true,"json":true};\n')
            receiver, _ = source.accept()
            reports = positions(reader, receiver, lines)
        finally:
            daemon.terminate()
            daemon.wait(10)
    found = [(report["lat"], report["lon"]) for report in reports]
    for i in range(COUNT):
        assert any(pair == pytest.approx((truth[0][i], truth[1][i]), abs=1e-7) for pair in found)


def connected(port):
    """Return a connection to a server that starts."""
    for _ in range(100):
        with contextlib.suppress(OSError):
            return socket.create_connection(("127.0.0.1", port), timeout=1.0)
        time.sleep(0.1)
    raise AssertionError("gpsd does not start")


def positions(reader, receiver, lines):
    """Return the positions that gpsd reports while it is sent the sentences, until it has reported each of them."""
    reports, buffer = [], b""
    for _ in range(20):
        for each in lines.splitlines():
            receiver.sendall(each + b"\r\n")
            time.sleep(0.05)
        with contextlib.suppress(TimeoutError):
            while True:
                reader.settimeout(0.2)
                buffer += reader.recv(65536)
        read = [
            json.loads(each) for each in buffer.splitlines() if each.startswith(b'{"class":"TPV"') and each[-1:] == b"}"
        ]
        reports = [each for each in read if each.get("mode", 0) >= 2]
        if len({each["lat"] for each in reports}) >= COUNT:
            break
    receiver.close()
    return reports


def test_aircraft_and_geojson_have_the_fix_twice_and_then_judged(on_earth, z, truth):
    planes = [json.loads(each) for each in feed(on_earth, z, "aircraft").splitlines()]
    features = [json.loads(each) for each in feed(on_earth, z, "geojson").splitlines()]
    for i in range(COUNT):
        assert [each["status"] for each in planes if each["hex"] == f"T{i}"] == ["unproven", "ok"]
        first, last = [each for each in features if each["properties"]["target"] == f"T{i}"]
        assert (first["properties"]["status"], last["properties"]["status"]) == ("unproven", "ok")
        assert last["properties"]["proof"] == "global"
        assert last["properties"]["ellipse95_1"] > 0.0
        assert last["geometry"] == first["geometry"]
        assert last["geometry"]["coordinates"][1] == pytest.approx(truth[0][i], abs=1e-9)


@pytest.mark.parametrize(("phases", "count"), [("one", 1), ("fix", 1), ("two", 2)])
def test_each_phase_is_one_line(on_earth, z, phases, count):
    assert len(feed(on_earth, z, "cot", phases=phases).splitlines()) == count * COUNT
    assert feed(on_earth, z, "nmea", phases=phases).count(b"GGA") == COUNT


def test_a_proof_that_is_given_up_still_updates_the_feed(on_earth, z):
    """With no time for proofs, the last line of each event repeats the first fix with its status."""
    found = [json.loads(each) for each in feed(on_earth, z, "aircraft", deadline=0.0).splitlines()]
    assert [each["status"] for each in found].count("unproven") == 2 * COUNT
    assert feed(on_earth, z, "nmea", deadline=0.0).count(b",0,00,") == COUNT
