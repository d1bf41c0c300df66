"""Endpoints: repeated ids, clients, refusals, and the headers and feeds of all answers."""

import http.client
import json
import socket

import pytest
from service.lines import Answers, arrivals, ask, differences, line

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from optloc.service.access_checks import SAFE_HEADERS
from optloc.service.serve import serve
from optloc.service.stream import Settings, Stream

ONE = {"Content_Type": "application/json"}
FEEDS = ("/health", "/metrics", "/fixes.geojson", "/map.json", "/data/aircraft.json", "/track", "/openapi.json", "/")


@pytest.fixture(scope="module")
def z(on_earth):
    return differences(on_earth, arrivals(on_earth, 3)).tolist()


def test_a_repeated_request_gets_its_fix_and_other_values_409(server, z):
    _, port = server
    lines = [line(event=f"again {i}", z=z[i]) for i in range(2)]
    code, _, first = ask(port, "POST", "/fix", b"\n".join(lines))
    records = {r["event"]: r for r in map(json.loads, first.splitlines())}
    assert (code, {r["status"] for r in records.values()}) == (200, {"ok"})
    code, _, again = ask(port, "POST", "/fix", b"\n".join(lines))
    assert (code, {r["event"]: r for r in map(json.loads, again.splitlines())}) == (200, records)
    code, _, single = ask(port, "POST", "/fix", lines[0], **ONE)
    assert (code, json.loads(single)) == (200, records["again 0"])
    other = line(event="again 0", z=z[2])
    for headers in ({}, ONE):
        code, _, said = ask(port, "POST", "/fix", other, **headers)
        record = json.loads(said)
        assert (code, record["code"], record["event"]) == (409, 409, "again 0")
        assert "other values" in record["error"]
        assert len(record["error"]) <= 200
    # of several lines, each has its own record
    code, _, said = ask(port, "POST", "/fix", b"\n".join([other, lines[1]]))
    found = [json.loads(each) for each in said.splitlines()]
    assert (code, sorted(r.get("code", 200) for r in found)) == (200, [200, 409])
    assert ask(port, "POST", "/track", line(event="again 0", z=z[0], time=1))[0] == 409


def test_a_track_is_repeated_with_its_state(server, z):
    _, port = server
    lines = [line(event=f"state {i}", z=z[0], time=i, target="state") for i in range(2)]
    for each in lines:
        assert ask(port, "POST", "/track", each, **ONE)[0] == 200
    first, second = (ask(port, "POST", "/track", lines[0], **ONE) for _ in range(2))
    assert (first[0], first[2], json.loads(first[2])["event"]) == (200, second[2], "state 0")


def test_ids_of_clients_do_not_meet(server, z):
    stream, port = server
    for client, values in ((None, z[0]), ("roof", z[1]), ("cellar", z[2])):
        headers = {} if client is None else {"X_Client": client}
        code, _, said = ask(port, "POST", "/fix", line(event="same", z=values), **headers)
        record = json.loads(said)
        assert (code, record["event"], record.get("client")) == (200, "same", client)
    by_key = json.loads(ask(port, "POST", "/fix", line(event="same", client="cellar", z=z[2]))[2])
    assert by_key == record
    names = {(r.get("client"), r["event"]) for _, r in stream.latest._stored.values()}
    assert {(None, "same"), ("roof", "same"), ("cellar", "same")} <= names
    code, _, said = ask(port, "POST", "/fix", line(event="same", client="roof", z=z[2]), **ONE, X_Client="cellar")
    assert (code, "the key 'client' occurs twice" in said) == (400, True)
    assert ask(port, "POST", "/fix", line(event="same", z=z[2]), **ONE, X_Client="x" * 300)[0] == 400
    assert json.loads(ask(port, "POST", "/fix", b"{}", **ONE, X_Client="roof")[2])["error"].startswith(
        "the line has no"
    )


def test_an_answer_that_is_no_longer_kept_is_410(server, z, monkeypatch):
    stream, port = server
    monkeypatch.setattr(stream._replies, "_most", 0)
    sent = line(event="lost", z=z[0])
    assert ask(port, "POST", "/fix", sent, **ONE)[0] == 200
    code, _, said = ask(port, "POST", "/fix", sent, **ONE)
    assert (code, json.loads(said)["error"]) == (410, "event 'lost': its answer is no longer kept; use another id.")


def test_a_retry_after_a_timeout_gets_its_answer(on_earth, z, monkeypatch):
    """The first request ends before the event closes; the second gets the answer of the same event."""
    stream = Stream(on_earth, Settings(wait=1.0), Answers())
    port, stop = serve(stream, port=0)
    parts = [line(event="late", kind="tdoa", a=r.a, b=r.b, z=v) for r, v in zip(on_earth.rows[:4], z[0], strict=False)]
    monkeypatch.setattr("optloc.service.endpoints._PATIENCE", 0.1)
    code, headers, _ = ask(port, "POST", "/fix", b"\n".join(parts))
    assert (code, headers["retry-after"]) == (504, "1")
    monkeypatch.undo()
    code, _, said = ask(port, "POST", "/fix", b"\n".join(parts))
    assert (code, json.loads(said)["closed"], json.loads(said)["dof"]) == (200, "wait", 1)
    assert stream.metrics.counts["events"] == 1
    stream.close()
    assert stream.ended.wait(10.0)
    stop()


def test_a_lone_surrogate_reaches_no_feed(server):
    _, port = server
    for path, key in (("/fix", "event"), ("/track", "target"), ("/fix", "client")):
        text = json.dumps({"event": "poison", "time": 1, "z": [0.0] * 5, key: "\ud800"})
        code, _, said = ask(port, "POST", path, text, **ONE)
        assert (code, "half of a surrogate pair" in said) == (400, True)
    assert {path: ask(port, "GET", path)[0] for path in FEEDS} == dict.fromkeys(FEEDS, 200)


@pytest.mark.parametrize(
    ("method", "path", "headers", "expected"),
    [
        ("GET", "/health", {}, 200),
        ("GET", "/", {}, 200),
        ("GET", "/nothing", {}, 404),
        ("GET", "/track/nobody", {}, 404),
        ("GET", "/fix", {}, 405),
        ("POST", "/fix", {}, 400),
        ("GET", "/health", {"Host": "evil.example"}, 400),
        ("GET", "/health", {"Origin": "http://evil.example"}, 403),
    ],
)
def test_all_answers_have_safe_headers_and_refusals_are_json(server, method, path, headers, expected):
    code, found, said = ask(server[1], method, path, **headers)
    assert code == expected
    found = {name.lower(): value for name, value in found.items()}
    for name, value in SAFE_HEADERS.items():
        assert found[name.lower()] == (value if path != "/" or "Policy" not in name[:24] else found[name.lower()])
    assert "frame-ancestors 'none'" in found["content-security-policy"]
    assert "server" not in found
    if code != 200:
        assert isinstance(json.loads(said)["error"], str)


def test_a_body_that_does_not_come_is_refused(server, monkeypatch):
    monkeypatch.setattr("optloc.service.endpoints._UPLOAD", 0.2)
    with socket.create_connection(("127.0.0.1", server[1]), timeout=20.0) as connection:
        connection.sendall(b"POST /fix HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99\r\n\r\n{")
        answer = http.client.HTTPResponse(connection)
        answer.begin()
        assert (answer.status, json.loads(answer.read())["error"]) == (408, "the request was not complete in time")
        assert connection.recv(1) == b""


def test_tokens_and_hosts_hold_for_a_whole_server(on_earth, tmp_path):
    from optloc.service.http_options import access_of

    (tmp_path / "tokens").write_text("0123456789abcdef\n")
    stream = Stream(on_earth, Settings(), Answers())
    port, stop = serve(stream, port=0, access=access_of(["fixes.org"], tmp_path / "tokens"))
    token = {"Authorization": "Bearer 0123456789abcdef"}
    for path in FEEDS:
        assert (ask(port, "GET", path)[0], ask(port, "GET", path, **token)[0]) == (401, 200)
    assert ask(port, "GET", "/health", Host="fixes.org", **token)[0] == 200
    assert ask(port, "POST", "/fix", b"{}")[0] == 401
    stream.close()
    assert stream.ended.wait(10.0)
    stop()
