"""Access checks of requests: host name, origin and token, before any other code reads a request.

A browser runs pages of strangers on a machine that reaches this server. The host name stops pages whose domain name
resolves to this machine (DNS rebinding). The origin stops requests from pages of other servers. Tokens stop other
machines. Every answer has headers with which a browser neither stores, embeds nor reinterprets it.
"""

from __future__ import annotations

from base64 import b64decode
from binascii import Error as NotBase64
from collections.abc import Awaitable, Callable, MutableMapping
from hmac import compare_digest
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

from optloc.service.answers import to_line
from optloc.service.http_options import AccessRules, digest_of, hostname

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Message, Receive, Send], Awaitable[None]]
"""An ASGI application (asgi.readthedocs.io, version 3)."""

SAFE_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Headers of every answer that does not set them itself."""

_REALM = 'realm="optloc", charset="UTF-8"'


class AccessChecks:
    """An ASGI application that refuses requests by their host name, origin and token, and passes on all others.

    Parameters
    ----------
    app : App
        Application that answers the other requests.
    access : AccessRules
        Permitted hosts and tokens.
    local : bool
        Whether the server is reached from this machine only.
    """

    def __init__(self, app: App, access: AccessRules, *, local: bool) -> None:
        self._app, self._access, self._local = app, access, local

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it: a request with a JSON error, a websocket with the code 1008."""

        async def safe(message: Message) -> None:
            """Send a message, with the headers that every answer has."""
            if message["type"] == "http.response.start":
                present = {name.lower() for name, _ in message["headers"]}
                added = [(name.lower().encode(), value.encode()) for name, value in SAFE_HEADERS.items()]
                message["headers"] = [*message["headers"], *(each for each in added if each[0] not in present)]
            await send(message)

        refusal = self._refusal(scope)
        if refusal is None:
            await self._app(scope, receive, safe)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": refusal[1]})
        else:
            code, why, headers = refusal
            headers = [*headers, (b"content-type", b"application/json")]
            await safe({"type": "http.response.start", "status": code, "headers": headers})
            await safe({"type": "http.response.body", "body": to_line({"error": why})})

    def _refusal(self, scope: Message) -> tuple[int, str, list[tuple[bytes, bytes]]] | None:
        """Return the HTTP status code, the reason and the headers of a refusal; None for a permitted request."""
        given: dict[str, list[str]] = {"host": [], "origin": [], "authorization": []}
        for name, value in scope["headers"]:
            given.get(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
        if len(given["host"]) != 1 or not self._is_permitted(hostname(given["host"][0])):
            return 400, "the host name of the request is not permitted; name it by --allow-host", []
        if any(not _is_same(origin, given["host"][0]) for origin in given["origin"]):
            return 403, "requests from pages of other sites are refused", []
        if self._access.tokens and not self._has_token(given["authorization"]):
            # A browser then opens a form for a name and a password: the password is the token.
            challenges = [(b"www-authenticate", f"{scheme} {_REALM}".encode()) for scheme in ("Bearer", "Basic")]
            return 401, "a valid token is missing; send the header Authorization: Bearer TOKEN", challenges
        return None

    def _is_permitted(self, name: str) -> bool:
        """Return whether a host name is stated, or is one that no page of a stranger can have.

        An address is no domain name, so a page under this address is a page of this server.
        """
        if name in self._access.hosts or name == "localhost":
            return True
        try:
            return ip_address(name).is_loopback or not self._local
        except ValueError:
            return False

    def _has_token(self, authorization: list[str]) -> bool:
        """Return whether a request has one permitted token; the time does not depend on the characters of a token."""
        scheme, _, word = authorization[0].partition(" ") if len(authorization) == 1 else ("", "", "")
        if scheme.lower() == "basic":
            try:
                word = b64decode(word.strip(), validate=True).decode().partition(":")[2]
            except (NotBase64, ValueError):
                return False
        elif scheme.lower() != "bearer":
            return False
        digest = digest_of(word.strip())
        return sum(compare_digest(digest, known) for known in self._access.tokens) > 0  # compares all of them


def _is_same(origin: str, host: str) -> bool:
    """Return whether a page of an origin comes from the host of the request."""
    try:
        return urlsplit(origin).netloc.lower() == host.lower() != ""
    except ValueError:
        return False
