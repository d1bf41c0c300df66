"""A stream over HTTP: requests, limits, strangers' pages, the websocket, the map."""

import http.client
import json
import time
from urllib.parse import urlsplit

import pytest
from live.lines import SITE, Answers, arrivals, differences, line, site_in, solved
from report.browser import Browser, executable

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
connect = pytest.importorskip("websockets.sync.client").connect
ConnectionClosed = pytest.importorskip("websockets.exceptions").ConnectionClosed

from optloc.base.errors import InvalidProblem  # noqa: E402  (after the libraries that may be missing)
from optloc.live.serve import serve  # noqa: E402
from optloc.live.stream import Settings, Stream  # noqa: E402

ON_EARTH = SITE.replace("[stations]", '[frame]\nkind = "enu"\norigin = { lat_deg = 47.5, lon_deg = 8.0 }\n\n[stations]')


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"), ON_EARTH)


@pytest.fixture(scope="module")
def served(site):
    """Return a stream that listens, and its port."""
    stream = Stream(site, Settings(wait=0.05), Answers())
    port, stop = serve(stream, port=0)
    yield stream, port
    stream.close()
    assert stream.ended.wait(10.0)
    stop()


def ask(port, method, path, body=None, **headers):
    """Return code, headers and text of an answer; names of headers have underscores here."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    given = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body, given)
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders()), answer.read().decode()
    connection.close()
    return found


def test_a_request_is_answered_with_its_fix_and_proof(site, served):
    _, port = served
    z = differences(site, arrivals(site, 2))
    text = json.dumps({"event": "one", "z": z[0].tolist()}, indent=1)
    code, _, said = ask(port, "POST", "/fix", text, Content_Type="application/json")
    record, (_, fix) = json.loads(said), solved(site, z)
    assert code == 200
    assert record["position"] == pytest.approx(fix.position[0], rel=1e-9)
    assert (record["status"], record["proof"], "reason" in record) == ("ok", "global", False)
    lines = [line(event=f"many {i}", z=row) for i, row in enumerate(z.tolist())]
    code, headers, said = ask(port, "POST", "/fix", b"\n".join([*lines, b"{}"]))
    records = [json.loads(each) for each in said.splitlines()]
    assert (code, headers["content-type"]) == (200, "application/x-ndjson")
    assert {record.get("event", "error") for record in records} == {"many 0", "many 1", "error"}


def test_rows_of_one_event_may_come_in_several_requests(site, served):
    _, port = served
    times = arrivals(site, 1)[0]
    parts = [line(event="parts", station=name, time_ps=t) for name, t in zip("ABCDEF", times, strict=True)]
    code, _, said = ask(port, "POST", "/fix", b"\n".join(parts))
    assert (code, json.loads(said)["dof"]) == (200, 2)
    code, _, said = ask(port, "POST", "/fix", parts[0])
    assert (code, json.loads(said)) == (200, {"accepted": 1})


def test_bad_requests_are_refused_in_a_sentence(served):
    stream, port = served
    code, _, said = ask(port, "POST", "/fix", "{}", Content_Type="application/json")
    assert (code, "the line has no event" in said) == (400, True)
    assert ask(port, "POST", "/fix", b"")[0] == 400
    assert ask(port, "POST", "/fix", b"x" * (2 << 20))[0] == 413
    assert ask(port, "GET", "/fix")[0] == 405
    assert ask(port, "GET", "/../etc/passwd")[0] == 404
    # pages of others: by their own name, or by one that they have point here
    assert ask(port, "POST", "/fix", b"{}", Origin="http://evil.example")[0] == 403
    assert ask(port, "GET", "/health", Host="evil.example")[0] == 400
    stream.inbox._most, most = 0, stream.inbox._most
    code, headers, _ = ask(port, "POST", "/fix", b"{}")
    stream.inbox._most = most
    assert (code, headers["retry-after"]) == (429, "1")
    assert stream.metrics.counts["refused"] == 1


def test_health_metrics_and_the_latest_fixes(site, served):
    _, port = served
    row = differences(site, arrivals(site, 1))[0].tolist()
    ask(port, "POST", "/fix", line(event="seen", z=row, target="4b1234"))
    health = json.loads(ask(port, "GET", "/health")[2])
    assert health["statuses"]["ok"] >= 1
    _, headers, text = ask(port, "GET", "/metrics")
    assert headers["content-type"].startswith("text/plain; version=0.0.4")
    values = dict(each.rsplit(" ", 1) for each in text.splitlines() if not each.startswith("#"))
    assert float(values['optloc_fixes_total{status="ok"}']) >= 1.0
    assert float(values['optloc_latency_seconds{phase="fix",quantile="0.99"}']) > 0.0
    assert all(float(value) >= 0.0 for value in values.values())
    shapes = json.loads(ask(port, "GET", "/fixes.geojson")[2])["features"]
    (own,) = [shape for shape in shapes if shape["properties"].get("target") == "4b1234"]
    assert (own["properties"]["status"], own["properties"]["proof"]) == ("ok", "global")
    planes = json.loads(ask(port, "GET", "/data/aircraft.json")[2])["aircraft"]
    (own,) = [plane for plane in planes if plane["hex"] == "4b1234"]
    assert own["lat"] == pytest.approx(47.5, abs=0.1)


def test_the_map_needs_no_network(served):
    _, port = served
    code, _, page = ask(port, "GET", "/")
    assert code == 200
    assert "station A" in page
    assert "fixes.geojson" in page
    outside = [
        word for word in ("http://", "https://", "//cdn", "@import") if word in page.replace("http://www.w3.org", "")
    ]
    assert outside == []


@pytest.mark.skipif(executable() is None, reason="needs chromium (Debian's package of that name)")
def test_fixes_appear_on_the_map_in_a_browser(site, served):
    _, port = served
    row = differences(site, arrivals(site, 1))[0].tolist()
    ask(port, "POST", "/fix", line(event="shown", z=row, target="<b>here</b>"))
    with Browser() as browser:
        browser.ask("Page.navigate", url=f"http://127.0.0.1:{port}/")
        dots = "[...document.querySelectorAll('[data-layer=fixes] .dot')].map(dot => dot.dataset.tell)"
        until = time.monotonic() + 30.0
        while not (told := browser.run(dots)) and time.monotonic() < until:
            time.sleep(0.1)
        assert any(text.startswith("<b>here</b>, ok, 47.5") for text in told)
        assert browser.run("document.querySelectorAll('b').length") == 0
        assert browser.messages == []
        assert {urlsplit(url).netloc for url in browser.requests} == {f"127.0.0.1:{port}"}


def test_a_websocket_takes_lines_and_tells_all_answers(site, served):
    _, port = served
    row = differences(site, arrivals(site, 1))[0].tolist()
    with connect(f"ws://127.0.0.1:{port}/ws", open_timeout=10.0) as socket:
        socket.send(line(event="by socket", z=row).decode())
        records = [json.loads(socket.recv(timeout=10.0)) for _ in range(2)]
        assert [(r["event"], r["phase"]) for r in records] == [("by socket", "fix"), ("by socket", "proof")]
        socket.send("nonsense")
        assert json.loads(socket.recv(timeout=10.0))["source"] == "websocket"
        ask(port, "POST", "/fix", line(event="by request", z=row))
        assert json.loads(socket.recv(timeout=10.0))["event"] == "by request"
    with pytest.raises(Exception, match="403"):
        connect(f"ws://127.0.0.1:{port}/ws", origin="http://evil.example", open_timeout=10.0)


def test_a_websocket_that_reads_too_slowly_is_closed(served, monkeypatch):
    stream, port = served
    monkeypatch.setattr("optloc.live.serve._QUEUE", 4)
    with connect(f"ws://127.0.0.1:{port}/ws", open_timeout=10.0) as socket:
        socket.send("{}")
        socket.recv(timeout=10.0)
        for listener in list(stream.listeners) * 1000:
            listener({"note": "much"})
        with pytest.raises(ConnectionClosed, match="read faster"):
            list(iter(lambda: socket.recv(timeout=10.0), None))


def test_a_place_that_is_taken_is_said(served):
    stream, port = served
    with pytest.raises(InvalidProblem, match=f"nobody can listen at 127.0.0.1:{port}"):
        serve(stream, port=port)
