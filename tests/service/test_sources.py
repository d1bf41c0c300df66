"""Brokers and the formats of others: MQTT from a broker of 40 lines, ZeroMQ, ChirpStack, Mode S."""

import json
import socket
import threading
import time

import pytest
from service.lines import EPOCH, Answers, answers, arrivals, line, site_in
from typer.testing import CliRunner

from optloc.base.errors import InvalidProblem
from optloc.cli import app
from optloc.service.queues import Inbox
from optloc.service.site import FAST
from optloc.service.sources import ChirpStack, ModeS, adapter_of, mqtt, zeromq
from optloc.service.stream import Settings, Stream


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"), method=FAST)


@pytest.fixture
def stream(site):
    out = Answers()
    made = Stream(site, Settings(phases="fix"), out)
    made.out = out
    yield made
    made.close()
    assert made.ended.wait(10.0)


def wait_for(true):
    until = time.monotonic() + 20.0
    while not true() and time.monotonic() < until:
        time.sleep(0.01)
    assert true()


# MQTT 3.1.1 (OASIS, 2014): the packets that a subscriber needs.


def broker(messages, seen):
    """Return the port of a broker for one client: it accepts, and sends messages once that has subscribed."""
    listener = socket.create_server(("127.0.0.1", 0))

    def run():
        connection, _ = listener.accept()
        with connection, listener:
            while head := connection.recv(1):
                body = connection.recv(connection.recv(1)[0])  # no packet here is as long as 128 bytes
                if head[0] >> 4 == 1:
                    connection.sendall(b"\x20\x02\x00\x00")
                elif head[0] >> 4 == 8:
                    seen.append(body[4 : 4 + body[3]])
                    connection.sendall(b"\x90\x03" + body[:2] + b"\x00")
                    for payload in messages:
                        packet = b"\x00\x01t" + payload
                        size = (
                            bytes([len(packet) % 128 | 128, len(packet) // 128])
                            if len(packet) > 127
                            else bytes([len(packet)])
                        )
                        connection.sendall(b"\x30" + size + packet)
                elif head[0] >> 4 == 14:
                    return

    threading.Thread(target=run, daemon=True).start()
    return listener.getsockname()[1]


def test_messages_of_a_broker_are_lines(stream):
    pytest.importorskip("paho.mqtt.client")
    seen = []
    good = [line(event=str(i), z=[10.0 * i] * 5) for i in range(3)]
    port = broker([good[0], good[1] + b"\n" + good[2] + b"\n", b"nonsense"], seen)
    stop = mqtt(stream, f"mqtt://127.0.0.1:{port}/site/+/toa/%23")
    wait_for(lambda: len(stream.out.records) == 4)
    stop()
    records = stream.out.records
    assert seen == [b"site/+/toa/#"]
    assert {record["event"] for record in records if "event" in record} == {"0", "1", "2"}
    assert [record["line"] for record in records if "error" in record] == [4]


@pytest.mark.parametrize("address", ["mqtt://host", "http://host/topic", "mqtt:///topic", "nonsense"])
def test_addresses_that_are_no_topic(stream, address):
    pytest.importorskip("paho.mqtt.client")
    with pytest.raises(InvalidProblem, match="is not an address of a topic"):
        mqtt(stream, address)


def test_a_broker_that_is_not_there_is_said(stream):
    pytest.importorskip("paho.mqtt.client")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(InvalidProblem, match="the broker cannot be reached"):
        mqtt(stream, f"mqtt://127.0.0.1:{port}/topic")


def test_what_a_broker_sends_too_much_of_loses_its_oldest():
    inbox = Inbox(most=4)
    dropped = [inbox.push(number) for number in range(7)]
    assert (dropped, inbox.take(9, 0.0)) == ([0, 0, 0, 0, 1, 1, 1], [3, 4, 5, 6])


@pytest.mark.parametrize("pulls", [True, False], ids=["push", "publish"])
def test_messages_of_zeromq_are_lines(stream, pulls):
    zmq = pytest.importorskip("zmq")
    context = zmq.Context()
    other = context.socket(zmq.PUSH if pulls else zmq.PUB)
    other.setsockopt(zmq.LINGER, 0)
    if pulls:
        with socket.create_server(("127.0.0.1", 0)) as taken:
            place = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        stop = zeromq(stream, f"pull+{place}")
        other.connect(place)
    else:
        place = f"tcp://127.0.0.1:{other.bind_to_random_port('tcp://127.0.0.1')}"
        stop = zeromq(stream, place)
        time.sleep(0.5)  # who subscribes late has missed what was said
    for i in range(3):
        other.send(line(event=str(i), z=[10.0 * i] * 5))
    wait_for(lambda: len(stream.out.records) == 3)
    stop()
    context.destroy(0)
    with pytest.raises(InvalidProblem, match="cannot be used"):
        zeromq(stream, "nonsense")


def test_uplinks_of_chirpstack_are_events(site):
    times = arrivals(site, 1)[0]
    heard = [
        {"gatewayId": name, "rssi": -80, "fineTimeSinceGpsEpoch": f"{t // 10**12}.{t % 10**12 // 1000:09d}s"}
        for name, t in zip("ABCDEF", times, strict=True)
    ]
    heard += [{"gatewayId": "roaming", "fineTimeSinceGpsEpoch": "1.5s"}, {"gatewayId": "A2"}]
    uplink = {
        "deduplicationId": "3ac7e3c4",
        "deviceInfo": {"devEui": "0101010101010101", "tenantName": "x"},
        "fCnt": 12,
        "rxInfo": heard,
    }
    adapter = ChirpStack(site.stations)
    records, _ = answers(site, [adapter(json.dumps(uplink).encode())], phases="fix")
    (record,) = records
    assert (record["event"], record["target"], record["dof"]) == ("3ac7e3c4", "0101010101010101", 2)
    uplink["rxInfo"] = heard[-1:]
    (record,) = answers(site, [adapter(json.dumps(uplink).encode())], phases="fix")[0]
    assert "arrivals: the value is not a list of 1 to 4096 entries" in record["error"]
    assert adapter(b"nonsense") == b"nonsense"


def test_mode_s_messages_are_arrivals(site):
    adapter, bits = ModeS(site.stations), "8d4840d6202cc371c32ce0576098"
    nanoseconds = [t // 1000 - EPOCH // 1000 for t in arrivals(site, 1)[0]]

    def sent(start):
        return [
            adapter(json.dumps({"receiver": name, "mlat": {"t": (start + t) % (86_400 * 10**9), "m": bits}}).encode())
            for name, t in zip("FEDCBA", reversed(nanoseconds), strict=True)
        ]

    # once over midnight, and the same bits again
    lines = [*sent(86_400 * 10**9 - 9000), *sent(5 * 10**8)]
    records, health = answers(site, lines, phases="fix", wait=10.0)
    assert [(r["event"], r["target"], r["dof"]) for r in records] == [(f"{bits}-{i}", "4840d6", 2) for i in (0, 1)]
    assert records[0]["position"] == pytest.approx(records[1]["position"], abs=1e-3)
    assert health["malformed"] == 0
    assert adapter(b'{"sync": {}}') == b'{"sync": {}}'


def test_unknown_formats_and_addresses_are_one_sentence(tmp_path):
    site_in(tmp_path)
    for words, said in (
        (["--adapter", "chirpstak"], "did you mean 'chirpstack'?"),
        (["--http", "port"], "'port' is not a port"),
        (["--mqtt", "x"], "is not an address of a topic"),
    ):
        result = CliRunner().invoke(app, ["live", str(tmp_path / "site.toml"), *words])
        assert (result.exit_code, len(result.output.splitlines())) == (2, 1), result.output
        assert said in result.output
    with pytest.raises(InvalidProblem):
        adapter_of("none", ())
