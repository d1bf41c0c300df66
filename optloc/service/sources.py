"""Where lines come from besides pipes and requests: brokers of messages, and the formats of gateways and receivers."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Collection, Mapping
from threading import Thread
from typing import Any
from urllib.parse import unquote, urlsplit

from optloc.problem import InvalidProblem, nearest
from optloc.service.events import LINE
from optloc.service.queues import WAITING
from optloc.service.stream import Stream

LOG = logging.getLogger("optloc.service")

Adapter = Callable[[bytes], bytes]
"""Turns a line of another format into one of a stream; what it does not understand stays, and is refused."""

# Formats of others.


class ChirpStack:
    """Uplinks of ChirpStack (version 4, JSON) whose gateways have fine timestamps.

    The event is the deduplication id, the target the device. Gateways of other networks hear a device, too: those that
    the site does not have are left out, and each is named once in a warning.

    Parameters
    ----------
    stations : collection of str
        Names of the stations: the gateways' ids.
    """

    def __init__(self, stations: Collection[str]) -> None:
        self._stations = frozenset(stations)
        self._foreign: set[str] = set()

    def __call__(self, line: bytes) -> bytes:
        """Return an uplink as a whole event."""
        found = _object(line)
        if found is None or not isinstance(found.get("rxInfo"), list):
            return line
        every = [each for each in found["rxInfo"] if isinstance(each, dict) and isinstance(each.get("gatewayId"), str)]
        heard = [each for each in every if each["gatewayId"] in self._stations]
        self._warn({each["gatewayId"] for each in every} - self._stations)
        arrivals = [
            {"station": each["gatewayId"], "time": str(each["fineTimeSinceGpsEpoch"]).removesuffix("s")}
            for each in heard
            if each.get("fineTimeSinceGpsEpoch") is not None
        ]
        device = found.get("deviceInfo")
        target = device.get("devEui") if isinstance(device, dict) else None
        event = {"event": found.get("deduplicationId"), "arrivals": arrivals} | ({"target": target} if target else {})
        return json.dumps(event).encode()

    def _warn(self, foreign: set[str]) -> None:
        """Name gateways that the site does not have, each once."""
        for name in sorted(foreign - self._foreign) if len(self._foreign) < _MESSAGES else ():
            self._foreign.add(name)
            LOG.warning("gateway %r is no station of the site: its arrivals are left out", name[:40])


# Nanoseconds within which receivers of one network hear the same transmission, and messages that are remembered: equal
# bits are sent again after tenths of a second.
_TOGETHER, _MESSAGES = 5_000_000, 4096
# A day in nanoseconds: clocks of these receivers begin anew at midnight.
_DAY = 86_400 * 10**9


class ModeS:
    """Messages of mlat-client, ``{"mlat": {"t": ..., "m": "8d..."}}``, each with the name of its `receiver`.

    The receivers' clocks must be synchronised: `t` counts nanoseconds since midnight, as of GPS receivers
    (``radarcape_gps``). Equal messages within 5 ms are one event; those that carry an address have it as the target.

    Parameters
    ----------
    stations : collection of str
        Names of the stations: the receivers.
    """

    def __init__(self, stations: Collection[str]) -> None:
        self._stations = frozenset(stations)
        self._seen: dict[str, tuple[int, int]] = {}

    def __call__(self, line: bytes) -> bytes:
        """Return a message as one arrival."""
        found = _object(line)
        heard = None if found is None else found.get("mlat")
        if found is None or not isinstance(heard, dict):
            return line
        bits, time, station = heard.get("m"), heard.get("t"), found.get("receiver")
        if not isinstance(bits, str) or type(time) is not int:
            return line
        first, number = self._seen.pop(bits, (time, 0))
        apart = (time - first + _DAY // 2) % _DAY - _DAY // 2
        if abs(apart) > _TOGETHER:
            first, number, apart = time, number + 1, 0
        self._seen[bits] = first, number
        if len(self._seen) > _MESSAGES:
            del self._seen[next(iter(self._seen))]
        # counted from the first receiver's midnight: an event does not end there
        event = {"event": f"{bits}-{number}", "station": station, "time_ns": first + apart}
        address = _address(bits)
        return json.dumps(event | ({"target": address} if address else {})).encode()


def _address(bits: str) -> str:
    """Return the address that a Mode S message carries in the clear: formats 11, 17 and 18."""
    try:
        kind = int(bits[:2], 16) >> 3
    except ValueError:
        return ""
    return bits[2:8].lower() if kind in (11, 17, 18) else ""


def _object(line: bytes) -> dict[str, Any] | None:
    if len(line) > 4 * LINE:  # an uplink has much that is left out
        return None
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


ADAPTERS: Mapping[str, Callable[[Collection[str]], Adapter]] = {"chirpstack": ChirpStack, "mode-s": ModeS}
"""Formats of others by name."""


def adapter_of(name: str, stations: Collection[str]) -> Adapter:
    """Return what turns lines of a format into those of a stream; raise InvalidProblem for an unknown one."""
    if name not in ADAPTERS:
        raise InvalidProblem(f"there is no format {name!r}", "--adapter", nearest(name, ADAPTERS))
    return ADAPTERS[name](stations)


# Brokers.


def mqtt(stream: Stream, address: str, adapter: Adapter | None = None) -> Callable[[], None]:
    """Take the messages of a topic of an MQTT broker; where too many wait, the oldest are dropped and counted.

    Parameters
    ----------
    stream : Stream
        Who answers.
    address : str
        ``mqtt://user@host:1883/topic``, or ``mqtts`` with TLS; the topic may have wildcards. The password is in the
        variable OPTLOC_MQTT_PASSWORD.
    adapter : callable, optional
        Turns what comes into lines.

    Returns
    -------
    callable
        Ends it.

    Raises
    ------
    InvalidProblem
        For an address that is none, a broker that cannot be reached, or a missing library.
    """
    try:
        from paho.mqtt import client as paho
        from paho.mqtt.enums import CallbackAPIVersion
    except ImportError:
        raise InvalidProblem("MQTT needs paho-mqtt", "--mqtt", "pip install 'optloc[live-mqtt]'") from None
    parts = urlsplit(address)
    topic = unquote(parts.path[1:] + (f"#{parts.fragment}" if "#" in address else ""))
    if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or not topic:
        raise InvalidProblem(f"{address!r} is no address of a topic", "--mqtt", "write mqtt://host:1883/topic")
    # Version 2 of its callbacks: the other one goes in its next release.
    client = paho.Client(CallbackAPIVersion.VERSION2)
    if parts.scheme == "mqtts":
        client.tls_set()
    if parts.username:
        client.username_pw_set(unquote(parts.username), os.environ.get("OPTLOC_MQTT_PASSWORD"))
    number = 0

    def connected(client: Any, _: Any, __: Any, reason: Any, ___: Any) -> None:
        if reason.is_failure:
            LOG.warning("%s: the broker refuses (%s)", parts.hostname, reason)
        else:
            client.subscribe(topic, qos=1)  # again after every reconnection

    def heard(_: Any, __: Any, message: Any) -> None:
        nonlocal number
        number = _push(stream, message.payload, "mqtt", number, adapter)

    client.on_connect, client.on_message = connected, heard
    try:
        client.connect(parts.hostname, parts.port or (8883 if parts.scheme == "mqtts" else 1883))
    except (OSError, ValueError) as error:
        raise InvalidProblem(f"the broker cannot be reached ({error})", "--mqtt", "check host and port") from None
    client.loop_start()

    def stop() -> None:
        client.disconnect()
        client.loop_stop()

    return stop


def _push(stream: Stream, payload: bytes, source: str, number: int, adapter: Adapter | None) -> int:
    """Hand the lines of a message to a stream in any case, and return the number of the last one."""
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
    """Take the messages of a ZeroMQ socket.

    Parameters
    ----------
    stream : Stream
        Who answers.
    address : str
        ``tcp://host:5555`` subscribes to a publisher, of whose messages the oldest are dropped where too many wait;
        ``pull+tcp://127.0.0.1:5555`` listens, and lets those wait who push.
    adapter : callable, optional
        Turns what comes into lines.

    Returns
    -------
    callable
        Ends it.

    Raises
    ------
    InvalidProblem
        For an address that is none, or a missing library.
    """
    try:
        import zmq
    except ImportError:
        raise InvalidProblem("ZeroMQ needs pyzmq", "--zmq", "pip install 'optloc[live-zmq]'") from None
    pulls = address.startswith("pull+")
    context: Any = zmq.Context()
    socket = context.socket(zmq.PULL if pulls else zmq.SUB)
    # Nothing of a stranger's size is kept: a message may hold as many lines as a request.
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
        # a socket belongs to its thread
        context.destroy(0)

    thread = Thread(target=run, name="optloc zmq", daemon=True)
    thread.start()

    def stop() -> None:
        nonlocal ends
        ends = True
        thread.join(5.0)

    return stop
