"""A server: the application of a stream over HTTP, with limits of connections and access checks."""

from __future__ import annotations

import socket
from collections.abc import Callable
from threading import Thread

from optloc.problem import InvalidProblem
from optloc.service.access_checks import AccessChecks
from optloc.service.connections import Connections, protocol_of
from optloc.service.endpoints import application
from optloc.service.http_options import HOST, PORT, AccessRules, is_local
from optloc.service.messages import LINE
from optloc.service.stream import Stream


def serve(
    stream: Stream, host: str = HOST, port: int = PORT, access: AccessRules | None = None
) -> tuple[int, Callable[[], None]]:
    """Serve requests in a separate thread, and return the port and a function that stops the server.

    `host` is the name or address of the interface; other machines can reach it unless it is a local address. `port` 0
    selects a free port. `access` has the permitted hosts and tokens. Raise InvalidProblem if the address is not
    available, if other machines can reach it without a token, or if a library is missing.
    """
    access = access or AccessRules()
    if not (is_local(host) or access.tokens or access.open):
        what = f"other machines reach {host}, and requests need no token"
        raise InvalidProblem(what, "--http", "give --token-file FILE, or --no-token behind a proxy with a password")
    try:
        import starlette  # noqa: F401  # the application needs it
        import uvicorn
    except ImportError:
        raise InvalidProblem(
            "requests need uvicorn and starlette", "--http", "pip install 'optloc[live-http]'"
        ) from None
    try:
        found = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except (OSError, OverflowError) as error:
        what = f"the address {host}:{port} is not available ({getattr(error, 'strerror', None) or error})"
        raise InvalidProblem(what, "--http", "choose another port") from None
    # The application has no start-up work (lifespan). Proxy headers are ignored, since any client can write them.
    # Warnings are not logged: a client causes one with each request that is not HTTP.
    config = uvicorn.Config(
        AccessChecks(application(stream), access, local=is_local(host)),
        http=protocol_of(Connections()),
        log_level="error",
        access_log=False,
        lifespan="off",
        ws_max_size=LINE,
        timeout_graceful_shutdown=2,
        proxy_headers=False,
        server_header=False,
    )
    server = uvicorn.Server(config)
    thread = Thread(target=lambda: server.run(sockets=[found]), name="optloc requests", daemon=True)
    thread.start()

    def stop() -> None:
        """Stop the server, and wait at most 5 s for its end."""
        server.should_exit = True
        thread.join(5.0)

    return int(found.getsockname()[1]), stop
