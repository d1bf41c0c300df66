"""Connections of a server: limits of their number and time, so that clients that send half a request block no others.

uvicorn has no time limit for the headers of a request, and counts silent connections like requests. Here a silent
connection is closed after some seconds, and at once if its place is needed.
"""

from __future__ import annotations

from collections import defaultdict
from ipaddress import ip_address, ip_network
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from uvicorn.protocols.http.h11_impl import H11Protocol as _Protocol
else:
    _Protocol = object  # uvicorn is an extra: `protocol_of` adds its class

MOST, EACH = 512, 128
"""Largest number of connections, and of connections of one address: a proxy may keep 128 open."""

HEAD, WHOLE = 10.0, 90.0
"""Seconds for the headers of a request, and for its body and answer together: an answer may take 30 s."""

_CLOSED = b"HTTP/1.1 %s\r\nContent-Type: application/json\r\nContent-Length: %d\r\nConnection: close\r\n"
_CLOSED += b"Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\n"
_CLOSED += b"Content-Security-Policy: default-src 'none'; frame-ancestors 'none'\r\n\r\n"


class Connection(Protocol):
    """A connection of a client."""

    address: str

    @property
    def is_silent(self) -> bool:
        """Return whether the connection has no request that is being answered."""

    def drop(self) -> None:
        """Close the connection at once."""


class Connections:
    """The open connections of a server.

    `most` is the largest number of connections, and `each` the largest number of connections of one address.
    """

    def __init__(self, most: int = MOST, each: int = EACH) -> None:
        self._most, self._each = most, each
        # dictionaries as ordered sets, the oldest connection first
        self._all: dict[Connection, None] = {}
        self._of: defaultdict[str, dict[Connection, None]] = defaultdict(dict)

    def __len__(self) -> int:
        return len(self._all)

    def admit(self, connection: Connection) -> bool:
        """Add a connection, and return whether it has a place.

        Without a free place, the oldest silent connection is dropped: first of its address, else of all addresses.
        """
        own = self._of[group_of(connection.address)]
        crowd = own if len(own) >= self._each else self._all if len(self._all) >= self._most else None
        if crowd is not None:
            silent = next((each for each in crowd if each.is_silent), None)
            if silent is None:
                self._forget(group_of(connection.address))
                return False
            self.release(silent)
            silent.drop()
            own = self._of[group_of(connection.address)]
        self._all[connection] = own[connection] = None
        return True

    def release(self, connection: Connection) -> None:
        """Remove a connection that has closed; without effect if it is removed already."""
        self._all.pop(connection, None)
        group = group_of(connection.address)
        self._of[group].pop(connection, None)
        self._forget(group)

    def _forget(self, group: str) -> None:
        """Remove an address without connections."""
        if not self._of[group]:
            del self._of[group]


def group_of(address: str) -> str:
    """Return the addresses that count as one client: an IPv4 address, or a network /64 of IPv6 (RFC 6177)."""
    try:
        ip = ip_address(address)
    except ValueError:
        return address
    if ip.version == 6 and ip.ipv4_mapped is None:
        return str(ip_network((int(ip), 64), strict=False))
    return str(ip.ipv4_mapped if ip.version == 6 else ip)


class BoundedConnection(_Protocol):
    """HTTP/1.1 with limits; the class of uvicorn has no limit for the headers of a request."""

    places: Connections
    head: float
    whole: float

    def connection_made(self, transport: Any) -> None:
        """Accept a connection, or answer 503 if there is no place."""
        super().connection_made(transport)
        self.address = self.client[0] if self.client else ""
        self.since = self.loop.time()
        self.timer = self.loop.call_later(self.head, self.check)
        if not self.places.admit(self):
            self.refuse(b"503 Service Unavailable", b"too many connections")

    @property
    def is_silent(self) -> bool:
        """Return whether no request of the connection is being answered."""
        cycle: Any = self.cycle  # None before the first request
        return cycle is None or bool(cycle.response_complete)

    def check(self) -> None:
        """Close the connection if its time is over, or look again at the end of its time.

        The client sent too little of a request, sends a body too slowly, or reads its answer too slowly.
        """
        left = self.since + (self.head if self.is_silent else self.whole) - self.loop.time()
        if left > 0.0:
            self.timer = self.loop.call_later(left, self.check)
        else:
            self.drop()

    def handle_events(self) -> None:
        """Handle the data of the client; a new request begins a new time limit."""
        before = self.cycle
        super().handle_events()
        if self.cycle is not before:
            self.since = self.loop.time()

    def on_response_complete(self) -> None:
        """Begin the time limit of the next request."""
        self.since = self.loop.time()
        self.timer.cancel()
        self.timer = self.loop.call_later(self.head, self.check)
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Pass the connection to the protocol of websockets, which has other limits."""
        self.leave()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Release the place of the connection."""
        self.leave()
        super().connection_lost(exc)

    def leave(self) -> None:
        """Release the place of the connection and stop its timer."""
        self.timer.cancel()
        self.places.release(self)

    def drop(self) -> None:
        """Close the connection at once; data that is not sent is lost."""
        self.transport.abort()

    def refuse(self, status: bytes, why: bytes) -> None:
        """Answer with a status and a reason, and close the connection."""
        body = b'{"error":"%s"}\n' % why
        self.transport.write(_CLOSED % (status, len(body)) + body)
        self.transport.close()

    def send_400_response(self, msg: str) -> None:
        """Answer data that are not HTTP."""
        self.refuse(b"400 Bad Request", b"this is not HTTP/1.1")


def protocol_of(places: Connections, head: float = HEAD, whole: float = WHOLE) -> Any:
    """Return a class of uvicorn protocols whose connections have the limits of `places`.

    `head` is the time for the headers of a request, and `whole` the time for its body and its answer, s.
    """
    from uvicorn.protocols.http.h11_impl import H11Protocol

    limits = {"places": places, "head": head, "whole": whole}
    return type("BoundedProtocol", (BoundedConnection, H11Protocol), limits)
