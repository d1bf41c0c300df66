"""Further sources of lines: MQTT and ZeroMQ, and adapters for the formats of gateways and receivers."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Collection, Mapping
from threading import Thread
from typing import Any
from urllib.parse import unquote, urlsplit

from optloc.problem import InvalidProblem, nearest
from optloc.service.messages import LINE
from optloc.service.queues import WAITING
from optloc.service.stream import Stream

LOG = logging.getLogger("optloc.service")

Adapter = Callable[[bytes], bytes]
"""Converts a line of another format to a line of a stream; it returns other lines unchanged, for an error message."""

# Formats of other systems.


class ChirpStack:
    """Adapter for uplinks of ChirpStack (version 4, JSON) from gateways with fine timestamps.

    The event is the deduplication id, the target is the device. Gateways of other networks may receive a device as
    well: gateways that the site does not have are left out, with one warning for each. `stations` are the ids of the
    gateways of the site.
    """

    def __init__(self, stations: Collection[str]) -> None:
        self._stations = frozenset(stations)
        self._foreign: set[str] = set()

    def __call__(self, line: bytes) -> bytes:
        """Return an uplink as a line with a whole event; lines of another form are returned unchanged."""
        found = _object(line)
        if found is None or not isinstance(found.get("rxInfo"), list):
            return line
        every = [each for each in found["rxInfo"] if isinstance(each, dict) and isinstance(each.get("gatewayId"), str)]
        receptions = [each for each in every if each["gatewayId"] in self._stations]
        self._warn({each["gatewayId"] for each in every} - self._stations)
        arrivals = [
            {"station": each["gatewayId"], "time": str(each["fineTimeSinceGpsEpoch"]).removesuffix("s")}
            for each in receptions
            if each.get("fineTimeSinceGpsEpoch") is not None
        ]
        device = found.get("deviceInfo")
        target = device.get("devEui") if isinstance(device, dict) else None
        event = {"event": found.get("deduplicationId"), "arrivals": arrivals} | ({"target": target} if target else {})
        return json.dumps(event).encode()

    def _warn(self, foreign: set[str]) -> None:
        """Log a warning for each gateway that the site does not have, once."""
        for name in sorted(foreign - self._foreign) if len(self._foreign) < _MESSAGES else ():
            self._foreign.add(name)
            LOG.warning("gateway %r is not a station of the site: its arrivals are left out", name[:40])


# Largest time between receptions of one transmission, ns, and number of remembered messages. Equal bits are repeated
# after tenths of a second.
_TOGETHER, _MESSAGES = 5_000_000, 4096
# A day in nanoseconds: the clocks of these receivers restart at midnight.
_DAY = 86_400 * 10**9


class ModeS:
    """Adapter for messages of mlat-client, with the name of the `receiver` added.

    A message is ``{"mlat": {"t": ..., "m": "8d..."}}``.

    The clocks of the receivers must be synchronised: `t` is in nanoseconds since midnight, as with GPS receivers
    (``radarcape_gps``). Equal messages within 5 ms are one event. An address in the message becomes the target.
    `stations` are the names of the receivers.
    """

    def __init__(self, stations: Collection[str]) -> None:
        self._stations = frozenset(stations)
        # by message: time of the first reception, ns, and the number of earlier events with the same message
        self._seen: dict[str, tuple[int, int]] = {}

    def __call__(self, line: bytes) -> bytes:
        """Return a message as a line with one arrival; lines of another form are returned unchanged."""
        found = _object(line)
        reception = None if found is None else found.get("mlat")
        if found is None or not isinstance(reception, dict):
            return line
        bits, time, station = reception.get("m"), reception.get("t"), found.get("receiver")
        if not isinstance(bits, str) or type(time) is not int:
            return line
        first, number = self._seen.pop(bits, (time, 0))
        # nanoseconds since midnight start again each day, so the delay is within half a day of zero
        delay = (time - first + _DAY // 2) % _DAY - _DAY // 2
        if abs(delay) > _TOGETHER:
            first, number, delay = time, number + 1, 0
        self._seen[bits] = first, number
        if len(self._seen) > _MESSAGES:
            del self._seen[next(iter(self._seen))]
        # relative to the midnight of the first receiver, so that midnight does not split an event
        event = {"event": f"{bits}-{number}", "station": station, "time_ns": first + delay}
        address = _address(bits)
        return json.dumps(event | ({"target": address} if address else {})).encode()


def _address(bits: str) -> str:
    """Return the address in a Mode S message of format 11, 17 or 18; empty for other formats."""
    try:
        kind = int(bits[:2], 16) >> 3
    except ValueError:
        return ""
    return bits[2:8].lower() if kind in (11, 17, 18) else ""


def _object(line: bytes) -> dict[str, Any] | None:
    """Return the JSON object of a line; None if it is too long or is not an object."""
    if len(line) > 4 * LINE:  # an uplink has many parts that are not used
        return None
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


ADAPTERS: Mapping[str, Callable[[Collection[str]], Adapter]] = {"chirpstack": ChirpStack, "mode-s": ModeS}
"""Adapters by name."""


def adapter_of(name: str, stations: Collection[str]) -> Adapter:
    """Return the adapter for a format by name; raise InvalidProblem for an unknown format."""
    if name not in ADAPTERS:
        raise InvalidProblem(f"there is no format {name!r}", "--adapter", nearest(name, ADAPTERS))
    return ADAPTERS[name](stations)


# Brokers.


def mqtt(stream: Stream, address: str, adapter: Adapter | None = None) -> Callable[[], None]:
    """Read the messages of a topic of an MQTT broker, and return a function that stops it.

    If too many messages wait, the oldest are dropped and counted. `address` is ``mqtt://user@host:1883/topic``, or
    ``mqtts`` with TLS; the topic may have wildcards. The variable OPTLOC_MQTT_PASSWORD has the password. `adapter`
    converts messages to lines. Raise InvalidProblem for an invalid address, an unreachable broker, or a missing
    library.
    """
    try:
        from paho.mqtt import client as paho
        from paho.mqtt.enums import CallbackAPIVersion
    except ImportError:
        raise InvalidProblem("MQTT needs paho-mqtt", "--mqtt", "pip install 'optloc[live-mqtt]'") from None
    parts = urlsplit(address)
    # The wildcard # of a topic is the beginning of a fragment in an address.
    topic = unquote(parts.path[1:] + (f"#{parts.fragment}" if "#" in address else ""))
    if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or not topic:
        raise InvalidProblem(f"{address!r} is not an address of a topic", "--mqtt", "write mqtt://host:1883/topic")
    # Version 2 of the callbacks: version 1 will be removed in the next release.
    client = paho.Client(CallbackAPIVersion.VERSION2)
    if parts.scheme == "mqtts":
        client.tls_set()
    if parts.username:
        client.username_pw_set(unquote(parts.username), os.environ.get("OPTLOC_MQTT_PASSWORD"))
    number = 0

    def connected(client: Any, _: Any, __: Any, reason: Any, ___: Any) -> None:
        """Subscribe to the topic after each connection, or log a warning if the broker refuses."""
        if reason.is_failure:
            LOG.warning("%s: the broker refuses (%s)", parts.hostname, reason)
        else:
            client.subscribe(topic, qos=1)  # again after each reconnection

    def receive(_: Any, __: Any, message: Any) -> None:
        """Pass the lines of a message to the stream."""
        nonlocal number
        number = _push(stream, message.payload, "mqtt", number, adapter)

    client.on_connect, client.on_message = connected, receive
    try:
        client.connect(parts.hostname, parts.port or (8883 if parts.scheme == "mqtts" else 1883))
    except (OSError, ValueError) as error:
        raise InvalidProblem(f"the broker cannot be reached ({error})", "--mqtt", "check host and port") from None
    client.loop_start()

    def stop() -> None:
        """Disconnect from the broker, and end the thread of the client."""
        client.disconnect()
        client.loop_stop()

    return stop


def _push(stream: Stream, payload: bytes, source: str, number: int, adapter: Adapter | None) -> int:
    """Pass the lines of a message to a stream without waiting, and return the number of the last line.

    `number` is the number of the last line of the messages before. Old lines that the full queue drops are counted.
    """
    for data in payload.split(b"\n"):
        if not data.strip():
            continue
        number += 1
        (line,) = stream.lines([adapter(data) if adapter else data], source, number)
        dropped = stream.inbox.push(line)
        if dropped:
            stream.metrics.add("dropped", dropped)
    return number


def zeromq(stream: Stream, address: str, adapter: Adapter | None = None) -> Callable[[], None]:
    """Read the messages of a ZeroMQ socket, and return a function that stops it.

    ``tcp://host:5555`` subscribes to a publisher; if too many messages wait, the oldest are dropped.
    ``pull+tcp://127.0.0.1:5555`` listens; if too many messages wait, the senders wait. `adapter` converts messages to
    lines. Raise InvalidProblem for an invalid address, or a missing library.
    """
    try:
        import zmq
    except ImportError:
        raise InvalidProblem("ZeroMQ needs pyzmq", "--zmq", "pip install 'optloc[live-zmq]'") from None
    pulls = address.startswith("pull+")
    context: Any = zmq.Context()
    socket = context.socket(zmq.PULL if pulls else zmq.SUB)
    # Limit the size of a message from the network to the size of a request.
    socket.setsockopt(zmq.MAXMSGSIZE, 16 * LINE)
    socket.setsockopt(zmq.RCVHWM, WAITING)
    socket.setsockopt(zmq.LINGER, 0)
    try:
        if pulls:
            socket.bind(address.removeprefix("pull+"))
        else:
            socket.connect(address)
            socket.setsockopt(zmq.SUBSCRIBE, b"")
    except zmq.ZMQError as error:
        context.destroy(0)
        advice = "write tcp://host:5555, or pull+tcp://127.0.0.1:5555"
        raise InvalidProblem(f"{address!r} cannot be used ({error.strerror})", "--zmq", advice) from None
    ends = False

    def run() -> None:
        """Receive messages until the source is stopped (a separate thread), and pass their lines to the stream."""
        number = 0
        while not ends:
            if not socket.poll(200):
                continue
            payload = socket.recv_multipart()[-1]
            if pulls:
                lines = [adapter(data) if adapter else data for data in payload.split(b"\n") if data.strip()]
                stream.inbox.put(stream.lines(lines, "zmq", number + 1))
                number += len(lines)
            else:
                number = _push(stream, payload, "zmq", number, adapter)
        # a socket must be closed in its thread
        context.destroy(0)

    thread = Thread(target=run, name="optloc zmq", daemon=True)
    thread.start()

    def stop() -> None:
        """Stop the source, and wait at most 5 s for its end."""
        nonlocal ends
        ends = True
        thread.join(5.0)

    return stop
