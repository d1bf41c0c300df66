"""Brokers: MQTT and ZeroMQ, with restarts of the broker."""

import json
import socket
import subprocess
import sys
import time
from contextlib import suppress
from shutil import which

import pytest
from service.broker import Broker, wait_for
from service.lines import Answers, line, site_in

from optloc.base.errors import InvalidProblem
from optloc.service.brokers import mqtt, zeromq
from optloc.service.queues import Inbox, QueuedLine
from optloc.service.site import FAST
from optloc.service.stream import Settings, Stream


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return site_in(tmp_path_factory.mktemp("site"), method=FAST)


@pytest.fixture
def stream(site):
    out = Answers()
    with Stream(site, Settings(phases="fix"), out) as made:
        made.out = out
        yield made


def running(stream, source):
    """Run a source of a stream, and return its state."""
    return stream.start(source).watch


# MQTT.


@pytest.fixture
def broker():
    pytest.importorskip("paho.mqtt.client")
    made = Broker()
    yield made
    made.stop()


def test_messages_of_a_broker_are_lines(stream, broker):
    good = [line(event=str(i), z=[10.0 * i] * 5) for i in range(3)]
    stream.start(mqtt(stream, f"mqtt://127.0.0.1:{broker.port}/site/+/toa/%23"))
    wait_for(lambda: broker.subscribers == 1)
    for payload in (good[0], good[1] + b"\n" + good[2] + b"\n", b"nonsense"):
        broker.publish(payload)
    wait_for(lambda: len(stream.out.records) == 4)
    stream.sources.stop()
    records = stream.out.records
    assert broker.topics == [b"site/+/toa/#"]
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


def check_restart(stream, watch, publish, stop, start):
    """Publish, stop and start a broker: the loss is an alarm, and messages arrive again after the restart."""
    publish(line(event="before", z=[1.0] * 5))
    wait_for(lambda: "before" in {record.get("event") for record in stream.out.records})
    assert stream.health()["alarms"] == []
    stop()
    wait_for(lambda: stream.health()["alarms"])
    (alarm,) = stream.health()["alarms"]
    assert (alarm["part"], alarm["name"]) == ("source", watch.name)
    assert "lost" in alarm["error"]
    assert f'optloc_alarm{{part="source",name="{watch.name}"}} 1' in stream.metrics.text(0.0)
    assert stream.sources.failed == [watch.name]
    start()
    wait_for(lambda: not stream.health()["alarms"])
    publish(line(event="after", z=[2.0] * 5))
    wait_for(lambda: "after" in {record.get("event") for record in stream.out.records})
    said = [record for record in stream.out.records if record.get("source") == watch.name]
    assert [set(record) for record in said] == [{"source", "error"}, {"source", "note"}]
    assert stream.sources.failed == []
    counts = stream.health()["account"][watch.name]
    assert counts == {"received": 2, "answered": 2, "refused": 0, "dropped": 0, "open": 0}


def test_a_broker_that_restarts_is_an_alarm_until_it_is_back(stream, broker):
    watch = running(stream, mqtt(stream, f"mqtt://127.0.0.1:{broker.port}/t"))
    wait_for(lambda: broker.subscribers == 1)

    def start():
        broker.start()
        wait_for(lambda: broker.subscribers == 1)

    check_restart(stream, watch, broker.publish, broker.stop, start)
    assert watch.restarts >= 1


def test_a_broker_that_refuses_is_an_alarm(stream, broker):
    broker.refuses = True
    watch = running(stream, mqtt(stream, f"mqtt://127.0.0.1:{broker.port}/t"))
    wait_for(lambda: watch.alarm is not None)
    assert "the broker refuses (" in watch.alarm.error
    broker.refuses = False
    wait_for(lambda: watch.alarm is None)


def test_a_source_that_waits_for_its_broker_ends_with_its_stream(stream, broker):
    made = stream.start(mqtt(stream, f"mqtt://127.0.0.1:{broker.port}/t"))
    wait_for(lambda: broker.subscribers == 1)
    broker.stop()
    wait_for(lambda: made.watch.restarts >= 1)  # the next attempt is two seconds later
    stream.close()
    assert stream.ended.wait(10.0)
    assert not made.thread.is_alive()


def test_a_server_that_does_not_answer_holds_no_source(stream, monkeypatch):
    pytest.importorskip("paho.mqtt.client")
    monkeypatch.setattr("optloc.service.brokers._CONNECT", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        place = f"127.0.0.1:{silent.getsockname()[1]}/t"
        with pytest.raises(InvalidProblem, match="the broker cannot be reached"):
            mqtt(stream, f"mqtts://{place}")
        made = stream.start(mqtt(stream, f"mqtt://{place}"))
        stream.close()
        assert stream.ended.wait(10.0)
    assert not made.thread.is_alive()


@pytest.mark.slow
def test_a_command_that_ends_without_its_broker_has_an_exit_code(tmp_path, broker):
    site_in(tmp_path)
    address = f"mqtt://127.0.0.1:{broker.port}/t"
    process = subprocess.Popen(
        [sys.executable, "-m", "optloc.cli", "live", "site.toml", "--mqtt", address],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    while b"ready: " not in process.stderr.readline():
        pass
    wait_for(lambda: broker.subscribers == 1)
    broker.stop()
    assert json.loads(process.stdout.readline())["source"] == "mqtt"
    process.terminate()
    _, said = process.communicate(timeout=60.0)
    assert process.returncode == 3
    why, health = said.splitlines()[-2:]
    assert why == b"The stream ends with exit code 3, because these sources do not work: mqtt."
    assert [alarm["name"] for alarm in json.loads(health)["health"]["alarms"]] == ["mqtt"]


@pytest.mark.skipif(which("mosquitto") is None, reason="mosquitto is not installed")
def test_mosquitto_restarts(stream):
    paho = pytest.importorskip("paho.mqtt.client")
    enums = pytest.importorskip("paho.mqtt.enums")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    process = []

    def start():
        process.append(subprocess.Popen(["mosquitto", "-p", str(port)], stderr=subprocess.DEVNULL))
        wait_for(lambda: _answers(port))

    def stop():
        process[-1].terminate()
        process[-1].wait(10.0)

    def publish(payload):
        client = paho.Client(enums.CallbackAPIVersion.VERSION2)
        client.connect("127.0.0.1", port)
        client.loop_start()
        client.publish("t", payload, qos=1).wait_for_publish(10.0)
        client.loop_stop()

    start()
    try:
        watch = running(stream, mqtt(stream, f"mqtt://127.0.0.1:{port}/t"))
        time.sleep(1.0)  # until the subscription
        check_restart(stream, watch, publish, stop, start)
    finally:
        stop()


def _answers(port):
    """Return whether a server accepts connections at a port."""
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
        return True
    return False


# ZeroMQ.


def test_what_a_broker_sends_too_much_of_loses_its_oldest():
    inbox = Inbox(most=4)
    lines = [QueuedLine(b"", number, "test", 0.0, 0.0) for number in range(7)]
    dropped = [inbox.push(each) for each in lines]
    assert (dropped, inbox.take(9, 0.0)) == ([0, 0, 0, 0, 1, 1, 1], lines[3:])


@pytest.mark.parametrize("pulls", [True, False], ids=["push", "publish"])
def test_messages_of_zeromq_are_lines(stream, pulls):
    zmq = pytest.importorskip("zmq")
    context = zmq.Context()
    other = context.socket(zmq.PUSH if pulls else zmq.PUB)
    other.setsockopt(zmq.LINGER, 0)
    if pulls:
        with socket.create_server(("127.0.0.1", 0)) as taken:
            place = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        stream.start(zeromq(stream, f"pull+{place}"))
        other.connect(place)
    else:
        place = f"tcp://127.0.0.1:{other.bind_to_random_port('tcp://127.0.0.1')}"
        stream.start(zeromq(stream, place))
        time.sleep(0.5)  # who subscribes late has missed what was said
    for i in range(3):
        other.send(line(event=str(i), z=[10.0 * i] * 5))
    wait_for(lambda: len(stream.out.records) == 3)
    stream.sources.stop()
    context.destroy(0)
    with pytest.raises(InvalidProblem, match="cannot be used"):
        zeromq(stream, "nonsense")


def test_a_publisher_that_restarts_is_an_alarm_until_it_is_back(stream):
    zmq = pytest.importorskip("zmq")
    context, sockets, place = zmq.Context(), [], ["tcp://127.0.0.1:*"]

    def start():
        sockets.append(context.socket(zmq.PUB))
        sockets[-1].setsockopt(zmq.LINGER, 0)
        sockets[-1].bind(place[0])
        place[0] = sockets[-1].getsockopt_string(zmq.LAST_ENDPOINT)

    def publish(payload):
        time.sleep(0.5)  # until the subscription
        sockets[-1].send(payload)

    start()
    watch = running(stream, zeromq(stream, place[0]))
    check_restart(stream, watch, publish, sockets[-1].close, start)
    context.destroy(0)
