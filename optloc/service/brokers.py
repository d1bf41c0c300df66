"""Sources of lines: the brokers MQTT and ZeroMQ."""

from __future__ import annotations

import os
from typing import Any
from urllib.parse import unquote, urlsplit

from optloc.problem import InvalidProblem
from optloc.service.adapters import Adapter
from optloc.service.alarms import SourceLost
from optloc.service.messages import LINE
from optloc.service.queues import WAITING
from optloc.service.stream import Stream
from optloc.service.supervisor import LineSource, Watch

# Seconds between two checks of whether a source must end.
_CHECK_EVERY = 0.2
# Seconds after which MQTT tests the connection to a silent broker.
_KEEPALIVE = 30
# Seconds to connect to a broker, and then for the TLS handshake, which cannot be interrupted: four round trips over a
# satellite. The end of the stream waits for both.
_CONNECT = 4.0
_PATIENCE = 2.0 * _CONNECT + 1.0


def mqtt(stream: Stream, address: str, adapter: Adapter | None = None) -> LineSource:
    """Return the messages of a topic of an MQTT broker as a source; the broker must be present now.

    If too many messages wait, the oldest are dropped and counted. `address` is ``mqtt://user@host:1883/topic``, or
    ``mqtts`` with TLS; the topic may have wildcards. The variable OPTLOC_MQTT_PASSWORD has the password. `adapter`
    converts messages to lines. Raise InvalidProblem for an invalid address, an unreachable broker, or a missing
    library.
    """
    try:
        from paho.mqtt import client as paho
    except ImportError:
        raise InvalidProblem("MQTT needs paho-mqtt", "--mqtt", "pip install 'optloc[live-mqtt]'") from None
    parts = urlsplit(address)
    # The wildcard # of a topic is the beginning of a fragment in an address.
    topic = unquote(parts.path[1:] + (f"#{parts.fragment}" if "#" in address else ""))
    if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or not topic:
        raise InvalidProblem(f"{address!r} is not an address of a topic", "--mqtt", "write mqtt://host:1883/topic")
    try:
        opened = [_mqtt_client(parts)]
    except (OSError, ValueError) as error:
        raise InvalidProblem(f"the broker cannot be reached ({error})", "--mqtt", "check host and port") from None
    number = 0

    def run(watch: Watch) -> None:
        """Receive messages until the source is stopped; raise SourceLost if the connection is lost."""
        client, refusal = opened.pop() if opened else _mqtt_client(parts), list[str]()

        def connected(client: Any, _: Any, __: Any, reason: Any, ___: Any) -> None:
            """Subscribe to the topic after each connection."""
            if reason.is_failure:
                refusal.append(f"the broker refuses ({reason})")
            else:
                client.subscribe(topic, qos=1)
                watch.works()

        def receive(_: Any, __: Any, message: Any) -> None:
            """Pass the lines of a message to the stream."""
            nonlocal number
            number = _push(stream, message.payload, "mqtt", number, adapter)

        client.on_connect, client.on_message = connected, receive
        while not watch.stopping.is_set():
            code = client.loop(_CHECK_EVERY)
            if refusal or code != paho.MQTT_ERR_SUCCESS:
                raise SourceLost(refusal[0] if refusal else f"the broker is lost ({paho.error_string(code)})")
        client.disconnect()

    return LineSource("mqtt", run, patience=_PATIENCE)


def _mqtt_client(parts: Any) -> Any:
    """Return a client that connects to the broker of a split address; raise OSError if the broker is not there."""
    from paho.mqtt import client as paho
    from paho.mqtt.enums import CallbackAPIVersion

    # Version 2 of the callbacks: version 1 will be removed in the next release.
    client = paho.Client(CallbackAPIVersion.VERSION2)
    client.connect_timeout = _CONNECT
    if parts.scheme == "mqtts":
        client.tls_set()
    if parts.username:
        client.username_pw_set(unquote(parts.username), os.environ.get("OPTLOC_MQTT_PASSWORD"))
    client.connect(parts.hostname, parts.port or (8883 if parts.scheme == "mqtts" else 1883), _KEEPALIVE)
    return client


def _push(stream: Stream, payload: bytes, source: str, number: int, adapter: Adapter | None) -> int:
    """Pass the lines of a message to a stream without waiting, and return the number of the last line.

    `number` is the number of the last line of the messages before. Lines that the full queue drops are counted.
    """
    lines = [data for data in payload.split(b"\n") if data.strip()]
    for line in stream.lines(lines, source, number + 1, adapter=adapter):
        dropped = stream.inbox.push(line)
        if dropped:
            stream.metrics.add("dropped", dropped)
    return number + len(lines)


def zeromq(stream: Stream, address: str, adapter: Adapter | None = None) -> LineSource:
    """Return the messages of a ZeroMQ socket as a source.

    ``tcp://host:5555`` subscribes to a publisher; if too many messages wait, the oldest are dropped.
    ``pull+tcp://127.0.0.1:5555`` listens; if too many messages wait, the senders wait. `adapter` converts messages to
    lines. Raise InvalidProblem for an invalid address, or a missing library.
    """
    try:
        import zmq
    except ImportError:
        raise InvalidProblem("ZeroMQ needs pyzmq", "--zmq", "pip install 'optloc[live-zmq]'") from None
    pulls = address.startswith("pull+")
    try:
        opened = [_zeromq_sockets(address)]
    except zmq.ZMQError as error:
        advice = "write tcp://host:5555, or pull+tcp://127.0.0.1:5555"
        raise InvalidProblem(f"{address!r} cannot be used ({error.strerror})", "--zmq", advice) from None
    number = 0

    def run(watch: Watch) -> None:
        """Receive messages until the source is stopped, and pass their lines to the stream."""
        nonlocal number
        context, socket, monitor = opened.pop() if opened else _zeromq_sockets(address)
        try:
            while not watch.stopping.is_set():
                ready = zmq.select([socket, monitor], [], [], _CHECK_EVERY)[0]
                if monitor in ready:
                    _note_event(monitor, watch, pulls=pulls)
                if socket not in ready:
                    continue
                payload = socket.recv_multipart()[-1]
                if pulls:
                    lines = [data for data in payload.split(b"\n") if data.strip()]
                    stream.inbox.put(stream.lines(lines, "zmq", number + 1, adapter=adapter))
                    number += len(lines)
                else:
                    number = _push(stream, payload, "zmq", number, adapter)
        finally:
            context.destroy(0)  # a socket must be closed in its thread

    return LineSource("zmq", run)


def _zeromq_sockets(address: str) -> tuple[Any, Any, Any]:
    """Return a context, a connected socket, and a socket that reports its connections; raise ZMQError otherwise."""
    import zmq

    pulls = address.startswith("pull+")
    context: Any = zmq.Context()
    try:
        socket = context.socket(zmq.PULL if pulls else zmq.SUB)
        # Limit the size of a message from the network to the size of a request.
        socket.setsockopt(zmq.MAXMSGSIZE, 16 * LINE)
        socket.setsockopt(zmq.RCVHWM, WAITING)
        socket.setsockopt(zmq.LINGER, 0)
        monitor = socket.get_monitor_socket(zmq.EVENT_CONNECTED | zmq.EVENT_CONNECT_RETRIED | zmq.EVENT_DISCONNECTED)
        if pulls:
            socket.bind(address.removeprefix("pull+"))
        else:
            socket.connect(address)
            socket.setsockopt(zmq.SUBSCRIBE, b"")
    except zmq.ZMQError:
        context.destroy(0)
        raise
    return context, socket, monitor


def _note_event(monitor: Any, watch: Watch, *, pulls: bool) -> None:
    """Start or end the alarm of a ZeroMQ source by one event of its connections.

    ZeroMQ connects again by itself. Senders of a socket that listens (`pulls`) may come and go.
    """
    import zmq
    from zmq.utils.monitor import recv_monitor_message

    event = recv_monitor_message(monitor)["event"]
    if event == zmq.EVENT_CONNECTED:
        watch.works()
    elif not pulls:
        watch.fails("the publisher is lost" if event == zmq.EVENT_DISCONNECTED else "no publisher answers")
