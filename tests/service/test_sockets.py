"""Websockets: limits for each client, names of clients, and access checks."""

import json

import pytest
from service.lines import arrivals, differences, line

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
connect = pytest.importorskip("websockets.sync.client").connect


def test_a_client_has_a_few_websockets(server, monkeypatch):
    _, port = server
    monkeypatch.setattr("optloc.service.sockets.EACH", 2)
    url = f"ws://127.0.0.1:{port}/ws"
    with connect(url, open_timeout=10.0), connect(url, open_timeout=10.0), pytest.raises(Exception, match="403"):
        connect(url, open_timeout=10.0)
    with connect(url, open_timeout=10.0) as socket:
        socket.send("{}")
        assert json.loads(socket.recv(timeout=10.0))["error"]


def test_lines_belong_to_the_client_of_the_websocket(on_earth, server):
    _, port = server
    row = differences(on_earth, arrivals(on_earth, 1))[0].tolist()
    url = f"ws://127.0.0.1:{port}/ws"
    with connect(url, open_timeout=10.0, additional_headers={"X-Client": "boat"}) as socket:
        socket.send(line(event="1", z=row).decode())
        records = [json.loads(socket.recv(timeout=10.0)) for _ in range(2)]
        assert {(r["client"], r["event"]) for r in records} == {("boat", "1")}
        socket.send('{"event": "\\ud800", "z": [0, 0, 0, 0, 0]}')
        assert "half of a surrogate pair" in json.loads(socket.recv(timeout=10.0))["error"]
        socket.send(line(event="1", z=row[::-1]).decode())
        assert json.loads(socket.recv(timeout=10.0)) == {
            "event": "1",
            "client": "boat",
            "note": "conflict",
            "rows": [on_earth.name_of(i) for i in (0, 1, 3, 4)],
        }
