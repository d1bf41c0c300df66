"""A stream over HTTP: requests, limits, strangers' pages, the websocket, the map."""

import json
import time
import urllib.error
import urllib.request
from urllib.parse import urlsplit

import numpy as np
import pytest
from service.broker import wait_for
from service.conftest import ON_EARTH
from service.lines import Answers, arrivals, ask, differences, line, solved
from show.browser import Browser, executable, readable

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
connect = pytest.importorskip("websockets.sync.client").connect
ConnectionClosed = pytest.importorskip("websockets.exceptions").ConnectionClosed

from optloc.base.errors import InvalidProblem  # noqa: E402  (after the libraries that may be missing)
from optloc.cli.track import runs_of  # noqa: E402
from optloc.files import read  # noqa: E402
from optloc.service.http_options import AccessRules, digest_of  # noqa: E402
from optloc.service.serve import serve  # noqa: E402
from optloc.service.stream import Settings, Stream  # noqa: E402
from optloc.service.tracks import TrackSettings  # noqa: E402
from optloc.tracking import polynomial, tracked  # noqa: E402


@pytest.fixture(scope="module")
def site(on_earth):
    return on_earth


@pytest.fixture(scope="module")
def served(server):
    return server


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
    assert ask(port, "POST", "/fix", parts[0])[::2] == (200, said)


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


def flight(site, count=20, seed=3):
    """Return times and rows of something that flies through the site."""
    rng = np.random.default_rng(seed)
    t = np.arange(float(count))
    x = np.array([500.0, 800.0, 700.0]) + t[:, None] * np.array([60.0, 40.0, 5.0])
    path = np.linalg.norm(x[:, None] - site.position, axis=-1) + 5.0 * rng.standard_normal((count, len(site.stations)))
    ends = [(site.number[row.a], site.number[row.b]) for row in site.rows]
    return t, np.array([path[:, a] - path[:, b] for a, b in ends]).T


def test_a_track_is_that_of_the_command(site, served, tmp_path):
    _, port = served
    t, z = flight(site)
    z[12] += 500.0  # and one scan that no gate lets pass
    rows = ",\n".join(
        f'{{ a = "{row.a}", time = {time}, z = {value!r} }}'
        for time, values in zip(t.tolist(), z.tolist(), strict=True)
        for row, value in zip(site.rows, values, strict=True)
    )
    (tmp_path / "flight.toml").write_text(ON_EARTH.split("rows = [{ a")[0] + f"rows = [{rows}]\n")
    problem = next(runs_of(read(tmp_path / "flight.toml")))[1]
    entries = list(tracked(problem, polynomial(1, 1.0)))
    lines = [line(event=f"flies {i}", z=v, time=t[i], target="ab/1") for i, v in enumerate(z.tolist())]
    # other targets between its events, and the same event again
    lines[5:5] = [line(event="else", z=z[0].tolist(), time=2.0, target="other"), lines[4]]
    code, _, said = ask(port, "POST", "/track", b"\n".join(lines))
    records = {r["event"]: r for r in map(json.loads, said.splitlines())}
    assert (code, len(records), records["else"]["status"]) == (200, 21, "starting")
    own = [records[f"flies {i}"] for i in range(20)]
    assert [r["status"] for r in own] == [entry.label for entry in entries]
    assert own[12]["rejected"] == entries[12].rejected > 0
    for record, entry in zip(own[1:], entries[1:], strict=True):
        d = entry.updated.mean
        np.testing.assert_allclose(record["position"] + record["velocity"], d, rtol=1e-7)
        np.testing.assert_allclose(record["cov"], entry.updated.cov, rtol=1e-6, atol=1e-9)
        nis = float(entry.updated.nis)
        assert record["nis"] is None if np.isnan(nis) else record["nis"] == pytest.approx(nis, rel=1e-6)
    listed = json.loads(ask(port, "GET", "/track")[2])["tracks"]
    assert {r["target"] for r in listed} >= {"ab/1", "other"}
    one = json.loads(ask(port, "GET", "/track/ab/1")[2])
    assert (one["event"], one["position"]) == ("flies 19", own[19]["position"])
    values = ask(port, "GET", "/metrics")[2]
    assert 'optloc_tracks_total{status="started"} 1' in values


def test_what_no_track_can_take_is_refused_and_counted(site, served):
    stream, port = served
    z = flight(site, 3)[1].tolist()
    before = dict(stream.metrics.counts)

    def post(**found):
        code, _, said = ask(port, "POST", "/track", line(**found), Content_Type="application/json")
        return code, json.loads(said)

    assert post(event="t1", z=z[0], time=5, target="late")[1]["status"] == "starting"
    code, said = post(event="t2", z=z[1], time="5", target="late")
    assert (code, "in the order of their times" in said["error"]) == (400, True)
    code, said = post(event="t3", z=z[1], target="late")
    assert (code, "needs the time" in said["error"]) == (400, True)
    assert post(event="t4", z=z[1], time=True)[0] == 400
    assert post(event="t5", z=z[1], time=1, time_ns=1)[0] == 400
    after = stream.metrics.counts
    assert [after[k] - before[k] for k in ("tracked", "unordered", "unsolvable", "malformed")] == [1, 1, 1, 2]
    code, _, said = ask(port, "GET", "/track/nobody")
    assert (code, json.loads(said)["error"]) == (404, "there is no track of 'nobody'")


def test_tracks_are_bounded_in_number_and_age(site):
    z, now, out = flight(site, 1)[1].tolist(), [0.0], Answers()
    settings = Settings(track=True, track_settings=TrackSettings(most=3, age=10.0))
    stream = Stream(site, settings, out, clock=lambda: now[0])
    for i in range(5):
        stream.inbox.put(stream.lines([line(event=str(i), z=z[0], time=i, target=str(i))], "test"))
    stream.close()
    assert stream.ended.wait(10.0)
    assert [r["target"] for r in stream.tracks.records()] == ["4", "3", "2"]
    assert stream.metrics.counts["forgotten"] == 2
    now[0] = 11.0
    assert stream.tracks.records() == []
    assert stream.metrics.counts["forgotten"] == 5


def test_the_map_needs_no_network(served):
    _, port = served
    code, _, page = ask(port, "GET", "/")
    assert code == 200
    assert "station A" in page
    assert "map.json" in page
    outside = [
        word for word in ("http://", "https://", "//cdn", "@import") if word in page.replace("http://www.w3.org", "")
    ]
    assert outside == []


@pytest.mark.skipif(executable() is None, reason="needs chromium (Debian's package of that name)")
def test_fixes_appear_on_the_map_in_a_browser(site, served):
    _, port = served
    for i, row in enumerate(differences(site, arrivals(site, 2)).tolist()):
        ask(port, "POST", "/fix", line(event=f"shown {i}", z=row, target="<b>here</b>"))
    with Browser() as browser:
        shown = "[...document.querySelectorAll('.list li')].some(row => row.innerText.includes('here'))"
        readable(browser, f"http://127.0.0.1:{port}/", "live", ready=shown)
        told = browser.run("[...document.querySelectorAll('.list li')].map(row => row.innerText.trim())")
        assert any(text.startswith("<b>here</b> ok") and "\n47.5" in text for text in told), told
        # Other tests of this module may have sent events of other targets in the last minute.
        assert browser.run("document.querySelectorAll('[data-layer=trails] path').length") >= 1
        assert browser.run("document.querySelector('.link').textContent").startswith("Connected, last event")
        assert browser.run("document.querySelectorAll('b b').length") == 0
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
    monkeypatch.setattr("optloc.service.sockets._QUEUE", 4)
    with connect(f"ws://127.0.0.1:{port}/ws", open_timeout=10.0) as socket:
        socket.send("{}")
        socket.recv(timeout=10.0)
        for listener in list(stream.listeners) * 1000:
            listener({"note": "much"})
        with pytest.raises(ConnectionClosed, match="the client reads too slowly"):
            list(iter(lambda: socket.recv(timeout=10.0), None))


def test_a_place_that_is_taken_is_said(served):
    stream, port = served
    with pytest.raises(InvalidProblem, match=f"the address 127.0.0.1:{port} is not available"):
        serve(stream, port=port)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "fixes.example.org"])
def test_other_machines_need_a_token(served, host):
    with pytest.raises(InvalidProblem, match=f"other machines reach {host}, and requests need no token") as caught:
        serve(served[0], host, 0)
    assert "--token-file FILE, or --no-token" in str(caught.value)


@pytest.mark.parametrize("access", [AccessRules(tokens=(digest_of("x" * 16),)), AccessRules(without_token=True)])
def test_a_server_for_others_answers_under_its_address(site, access):
    stream = Stream(site, Settings(), Answers())
    port, stop = serve(stream, "0.0.0.0", 0, access)
    given = {"Host": "192.168.1.5", "Authorization": f"Bearer {'x' * 16}"}
    assert ask(port, "GET", "/health", **given)[0] == 200
    assert ask(port, "GET", "/health", **given | {"Host": "evil.example"})[0] == 400
    assert ask(port, "GET", "/health", Host="192.168.1.5")[0] == (401 if access.tokens else 200)
    stream.close()
    assert stream.ended.wait(10.0)
    stop()


def test_a_server_that_ends_by_itself_is_an_alarm_and_starts_again(site):
    import uvicorn

    class Once(uvicorn.Server):
        """A server whose first run fails."""

        runs = 0

        def run(self, sockets=None):
            Once.runs += 1
            if Once.runs == 1:
                for each in sockets:
                    each.close()
                raise SystemExit(3)  # as uvicorn does if it cannot start
            super().run(sockets)

    stream = Stream(site, Settings(), Answers())
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("uvicorn.Server", Once)
        port, stop = serve(stream, port=0)
        wait_for(lambda: stream.health()["alarms"])
        (alarm,) = stream.health()["alarms"]
        assert (alarm["part"], alarm["name"], alarm["error"]) == ("source", "http", "SystemExit: 3")
        wait_for(lambda: not stream.health()["alarms"])
    until = time.monotonic() + 20.0
    while time.monotonic() < until:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/health") as response:
                assert json.loads(response.read())["alarms"] == []
            break
        except urllib.error.URLError:
            time.sleep(0.05)
    else:
        raise AssertionError("the server is not back")
    stop()
    assert stream.sources.failed == []
    stream.close()
    assert stream.ended.wait(10.0)
