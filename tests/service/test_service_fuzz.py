"""Mutated messages over all endpoints and sources: no traceback, no poisoned reader, and the stream goes on."""

import http.client
import json
import logging
import random
import re
import socket
import threading
from contextlib import ExitStack

import pytest
from service.lines import Answers, arrivals, differences, line
from service.mutants import EVIL, mutant, originals

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
zmq = pytest.importorskip("zmq")
connect = pytest.importorskip("websockets.sync.client").connect
ConnectionClosed = pytest.importorskip("websockets.exceptions").ConnectionClosed

from optloc.base.errors import InvalidProblem  # noqa: E402
from optloc.service.adapters import adapter_of  # noqa: E402
from optloc.service.brokers import _push, zeromq  # noqa: E402
from optloc.service.openapi import REFUSALS  # noqa: E402
from optloc.service.serve import serve  # noqa: E402
from optloc.service.stream import Settings, Stream  # noqa: E402

FEW, MANY = 500, 20_000
# Messages between two looks at all feeds.
LOOK = 250
FEEDS = ("/health", "/fixes.geojson", "/map.json", "/data/aircraft.json", "/track", "/openapi.json", "/metrics")
NUMBER = re.compile(r"[-+]?(\d+(\.\d+)?([eE][-+]?\d+)?|nan|inf)")


class Faults(logging.Handler):
    """Collects exceptions that are no refusals of input, from logs of all levels and from threads."""

    def __init__(self):
        super().__init__(logging.DEBUG)
        self.found = []

    def emit(self, record):
        error = record.exc_info[1] if record.exc_info else None
        known = isinstance(error, InvalidProblem)
        if (error is not None and not known) or record.levelno >= logging.ERROR:
            self.found.append(self.format(record))


class Site:
    """A stream with all its sources, and a client of each."""

    def __init__(self, site):
        self.out = Answers()
        self.stream = Stream(site, Settings(wait=0.02, revise=True, deadline=0.5), self.out)
        self.port, self._stop = serve(self.stream, port=0)
        with socket.create_server(("127.0.0.1", 0)) as free:
            address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        self.stream.start(zeromq(self.stream, f"pull+{address}"))
        self._context = zmq.Context()
        self.pushed = self._context.socket(zmq.PUSH)
        self.pushed.connect(address)
        self.adapters = {name: adapter_of(name, site.stations) for name in ("chirpstack", "mode-s")}
        self._http, self._socket, self._sockets, self.codes, self.numbers = None, None, ExitStack(), set(), 0

    def close(self):
        self.pushed.close(0)
        self._context.term()
        self._sockets.close()
        self.stream.close()
        assert self.stream.ended.wait(60.0)
        assert self.stream.error is None
        self._stop()

    def ask(self, method, path, body=None, headers=None):
        """Return the code and the body of an answer, over one connection as long as it lasts."""
        for _ in range(2):
            try:
                self._http = self._http or http.client.HTTPConnection("127.0.0.1", self.port, timeout=40.0)
                self._http.request(method, path, body, headers or {})
                answer = self._http.getresponse()
                found = answer.status, answer.read()
            except (http.client.HTTPException, OSError):
                self._http.close()
                self._http = None
                continue
            self.codes.add(found[0])
            return found
        raise AssertionError(f"no answer to {method} {path}")

    def posted(self, rng, data):
        """Post a message to /fix or /track, as one event or as lines, with odd headers at times."""
        kinds = ("application/json", "application/x-ndjson", "text/plain", "APPLICATION/JSON; x")
        headers = {"Content-Type": rng.choice(kinds)}
        if rng.random() < 0.2:
            headers[rng.choice(("X-Client", "Origin", "Authorization", "Content-Type"))] = odd(rng)
        code, body = self.ask("POST", rng.choice(("/fix", "/fix", "/track")), data, headers)
        assert code == 200 or code in REFUSALS, (code, body)
        for each in body.splitlines():
            check(strict(each))

    def looked(self, rng, data):
        """Ask for a path that is made of a message."""
        path = rng.choice(("/", "/track/", "/data/", "/fix/", "/health?", "/../")) + "".join(
            chr(byte) if 33 <= byte < 127 else f"%{byte:02x}" for byte in data[: rng.randrange(1, 200)]
        )
        code, _ = self.ask(rng.choice(("GET", "HEAD", "PUT", "OPTIONS", "DELETE")), path)
        assert code == 200 or code in REFUSALS, (code, path)

    def raw(self, rng, data):
        """Send bytes that are hardly HTTP."""
        head = rng.choice((b"", b"POST /fix HTTP/1.1\r\nHost: localhost\r\n", b"GET / HTTP/1.1\r\nHost: "))
        with socket.create_connection(("127.0.0.1", self.port), timeout=20.0) as connection:
            connection.sendall(head + data[:500] + rng.choice((b"", b"\r\n\r\n", b"\r\n\r\n" + data[:50])))
            connection.shutdown(socket.SHUT_WR)
            found = connection.recv(200)
            assert not found or (found.startswith(b"HTTP/1.1 ") and not found.startswith(b"HTTP/1.1 500")), found

    def told(self, rng, data):
        """Send a message to the websocket, and read what it sends meanwhile."""
        if self._socket is None:
            self._socket = self._sockets.enter_context(connect(f"ws://127.0.0.1:{self.port}/ws", open_timeout=20.0))
        try:
            self._socket.send(data if rng.random() < 0.02 else data.decode("utf-8", "replace"))
            while True:
                check(strict(self._socket.recv(timeout=0.0).encode()))
        except TimeoutError:
            pass
        except ConnectionClosed:  # a message is not text, or is too long
            self._socket = None

    def mqtt(self, rng, data):
        """Pass the payload of a message of a broker, as the client of MQTT does."""
        self.numbers = _push(self.stream, data, "mqtt", self.numbers, None)

    def adapted(self, rng, data, name):
        """Pass an uplink or a message of a receiver."""
        self.numbers = _push(self.stream, data, "mqtt", self.numbers, self.adapters[name])

    def zeromq(self, rng, data):
        """Push a message of one or several frames."""
        self.pushed.send_multipart([data] if rng.random() < 0.9 else [b"topic", data])

    def read_all(self):
        """Read all feeds: each has the code 200 and is valid."""
        for path in FEEDS:
            code, body = self.ask("GET", path)
            assert code == 200, (path, body)
            if path == "/metrics":
                values = [each.rsplit(" ", 1)[1] for each in body.decode().splitlines() if not each.startswith("#")]
                assert all(map(NUMBER.fullmatch, values))
            else:
                strict(body)


def strict(data):
    """Return valid JSON without NaN, and without text that other readers cannot encode."""

    def refuse(word):
        raise AssertionError(word)

    found = json.loads(data, parse_constant=refuse)
    json.dumps(found, ensure_ascii=False).encode()
    return found


def check(record):
    """An error is one sentence."""
    error = record.get("error", "x")
    assert isinstance(error, str)
    assert 0 < len(error) <= 400, error
    assert error.splitlines() == [error]


def odd(rng):
    """Return the value of a header that HTTP permits."""
    text = rng.choice((*EVIL[:20], b"http://[", b"Basic !!", b"null", b"a:b@c"))[:300]
    return "".join(chr(byte) for byte in text if 32 <= byte < 127 or byte >= 160).strip() or "x"


def run(site, z, seed, count):
    """Send mutated messages of a seed over all ways, and return the stream's counts."""
    rng, faults = random.Random(seed), Faults()
    loggers = [logging.getLogger(name) for name in ("optloc", "uvicorn", "asyncio")]
    before, threading.excepthook = threading.excepthook, lambda failed: faults.found.append(repr(failed))
    for each in loggers:
        each.addHandler(faults)
    level = loggers[0].level
    loggers[0].setLevel(logging.DEBUG)
    messages, server = originals(site, z), Site(site)
    ways = [*[server.posted] * 4, *[server.told, server.mqtt, server.zeromq] * 2, server.looked, server.raw]
    ways += [lambda rng, data, name=name: server.adapted(rng, data, name) for name in server.adapters]
    forms = ["line"] * 12 + list(server.adapters)
    try:
        for number in range(count):
            way = rng.randrange(len(ways))
            ways[way](rng, mutant(rng, messages[forms[way]]))
            if number % LOOK == LOOK - 1:
                server.read_all()
        server.read_all()
        code, body = server.ask("POST", "/fix", line(event="last", z=z[1]), {"Content-Type": "application/json"})
        assert (code, json.loads(body)["status"]) == (200, "ok")
        counts = dict(server.stream.metrics.counts)
    finally:
        server.close()
        threading.excepthook = before
        loggers[0].setLevel(level)
        for each in loggers:
            each.removeHandler(faults)
    assert faults.found == []
    for each in server.out.data.splitlines():
        check(strict(each))
    assert not server.codes & {500, 503, 504}
    return counts


def test_mutated_messages_poison_no_reader(on_earth, seed):
    z = differences(on_earth, arrivals(on_earth, 2)).tolist()
    counts = run(on_earth, z, seed, FEW)
    assert counts["malformed"] > FEW // 4
    assert counts["events"] > FEW // 20


@pytest.mark.full
def test_many_mutated_messages_poison_no_reader(on_earth):
    z = differences(on_earth, arrivals(on_earth, 2)).tolist()
    counts = run(on_earth, z, 1, MANY)
    assert counts["malformed"] > MANY // 4
    assert counts["events"] > MANY // 50
