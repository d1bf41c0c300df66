"""Adapters: conversion of the formats of gateways and receivers to lines of a stream."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Collection, Mapping
from typing import Any

from optloc.problem import InvalidProblem, nearest
from optloc.service.alarms import sentence
from optloc.service.messages import LINE
from optloc.service.strict_json import read_object

LOG = logging.getLogger("optloc.service")

Adapter = Callable[[bytes], bytes]
"""Converts a line of another format to a line of a stream; it returns other lines unchanged, for an error message."""


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
    try:
        return read_object(line, 4 * LINE)  # an uplink has many parts that are not used
    except InvalidProblem:
        return None


ADAPTERS: Mapping[str, Callable[[Collection[str]], Adapter]] = {"chirpstack": ChirpStack, "mode-s": ModeS}
"""Adapters by name."""


def adapter_of(name: str, stations: Collection[str]) -> Adapter:
    """Return the adapter for a format by name; raise InvalidProblem for an unknown format."""
    if name not in ADAPTERS:
        raise InvalidProblem(f"there is no format {name!r}", "--adapter", nearest(name, ADAPTERS))
    return ADAPTERS[name](stations)


def convert(adapter: Adapter | None, data: bytes) -> tuple[bytes, str]:
    """Return a line in the form of a stream, and the error of the adapter if it fails; empty if not.

    An adapter reads data from a network, so any exception is an error of this line only.
    """
    if adapter is None:
        return data, ""
    try:
        return adapter(data), ""
    except Exception as error:  # an error of one line must not end its source
        LOG.debug("an adapter failed", exc_info=error)
        return data, f"the adapter cannot convert this line ({sentence(error)})"
