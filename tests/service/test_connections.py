"""Connections: limits for each client, and clients that send half a request."""

import http.client
import socket
from functools import partial

import pytest
from service.lines import Answers, ask

pytest.importorskip("uvicorn")
pytest.importorskip("starlette")

from optloc.service.connections import EACH, Connections, group_of, protocol_of
from optloc.service.serve import serve
from optloc.service.stream import Settings, Stream


class Fake:
    def __init__(self, address, silent=True):
        self.address, self.is_silent, self.dropped = address, silent, False

    def drop(self):
        self.dropped = True


def test_the_oldest_silent_connection_makes_room():
    connections = Connections(most=4, each=2)
    busy, first, second = Fake("10.0.0.1", silent=False), Fake("10.0.0.1"), Fake("10.0.0.1")
    assert all(map(connections.admit, (busy, first, second)))
    assert (busy.dropped, first.dropped, second.dropped, len(connections)) == (False, True, False, 2)
    second.is_silent = False
    assert not connections.admit(Fake("10.0.0.1"))
    others = [Fake(f"10.0.1.{i}") for i in range(3)]
    assert all(map(connections.admit, others))
    assert [other.dropped for other in others] == [True, False, False]
    for each in (busy, second, *others):
        connections.release(each)
    assert (len(connections), connections._of) == (0, {})


def test_no_room_among_busy_connections():
    connections = Connections(most=2)
    assert all(connections.admit(Fake(f"10.0.0.{i}", silent=False)) for i in range(2))
    assert not connections.admit(Fake("10.0.0.9"))
    assert len(connections) == 2


def test_a_network_of_ipv6_is_one_client():
    assert group_of("2001:db8::1") == group_of("2001:db8::2:3") != group_of("2001:db8:0:1::1")
    assert group_of("::ffff:10.0.0.1") == group_of("10.0.0.1") == "10.0.0.1"
    assert group_of("") == ""


@pytest.fixture
def hasty(on_earth, monkeypatch):
    """Return the port of a server with short time limits."""
    monkeypatch.setattr("optloc.service.serve.protocol_of", partial(protocol_of, head=0.5, whole=1.0))
    stream = Stream(on_earth, Settings(), Answers())
    port, stop = serve(stream, port=0)
    yield port
    stream.close()
    assert stream.ended.wait(10.0)
    stop()


def opened(port, data):
    connection = socket.create_connection(("127.0.0.1", port), timeout=20.0)
    connection.sendall(data)
    return connection


HALF = b"POST /fix HTTP/1.1\r\nHost: localhost\r\n"


def test_half_requests_and_slow_bodies_are_closed(hasty):
    for data in (b"", HALF, HALF + b"Content-Length: 9\r\n\r\n{"):
        with opened(hasty, data) as connection:
            assert connection.recv(100) == b""
    # the time counts from the last answer
    connection = http.client.HTTPConnection("127.0.0.1", hasty, timeout=20.0)
    connection.request("GET", "/health")
    assert connection.getresponse().read()
    connection.sock.sendall(HALF)
    assert connection.sock.recv(100) == b""
    connection.close()


def test_a_client_with_many_half_requests_blocks_no_other(server):
    _, port = server
    held = [opened(port, HALF) for _ in range(EACH + 20)]
    assert [ask(port, "GET", "/health")[0] for _ in range(3)] == [200] * 3
    assert held[0].recv(100) == b""  # the oldest has made room
    held[-1].setblocking(False)
    with pytest.raises(BlockingIOError):
        held[-1].recv(100)
    for each in held:
        each.close()


def test_data_that_are_not_http_get_one_answer(server):
    with opened(server[1], b"\x16\x03\x01\x02\x00\r\n\r\n") as connection:
        found = b"".join(iter(lambda: connection.recv(1000), b""))
    assert found.startswith(b"HTTP/1.1 400 ")
    assert b"nosniff" in found
    assert found.endswith(b'{"error":"this is not HTTP/1.1"}\n')
