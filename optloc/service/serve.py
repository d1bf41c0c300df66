"""A server: the application of a stream over HTTP, with limits of connections and access checks."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any

from optloc.problem import InvalidProblem
from optloc.service.access_checks import AccessChecks, App
from optloc.service.alarms import SourceLost
from optloc.service.connections import Connections, protocol_of
from optloc.service.endpoints import application
from optloc.service.http_options import HOST, PORT, AccessRules, is_local
from optloc.service.messages import LINE
from optloc.service.stream import Stream
from optloc.service.supervisor import LineSource, Watch


def serve(
    stream: Stream, host: str = HOST, port: int = PORT, access: AccessRules | None = None
) -> tuple[int, Callable[[], None]]:
    """Serve requests in a separate thread, and return the port and a function that stops the server.

    `host` is the name or address of the interface; other machines can reach it unless it is a local address. `port` 0
    selects a free port. `access` has the permitted hosts and tokens. Raise InvalidProblem if the address is not
    available, if other machines can reach it without a token, or if a library is missing.
    """
    access = access or AccessRules()
    if not (is_local(host) or access.tokens or access.without_token):
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
        opened = [_listener(host, port)]
    except (OSError, OverflowError) as error:
        what = f"the address {host}:{port} is not available ({getattr(error, 'strerror', None) or error})"
        raise InvalidProblem(what, "--http", "choose another port") from None
    app = AccessChecks(application(stream), access, local=is_local(host))
    number = int(opened[0].getsockname()[1])
    servers: list[Any] = []

    def run(watch: Watch) -> None:
        """Serve requests until the server is stopped; raise SourceLost if it ends by itself."""
        servers[:] = [uvicorn.Server(_config(app))]
        if watch.stopping.is_set():
            return
        watch.works()
        servers[0].run(sockets=[opened.pop() if opened else _listener(host, number)])
        if not watch.stopping.is_set():
            raise SourceLost("the server has ended")

    def interrupt() -> None:
        """Stop the server soon."""
        for server in servers:
            server.should_exit = True

    return number, stream.start(LineSource("http", run, interrupt=interrupt)).stop


def _listener(host: str, port: int) -> socket.socket:
    """Return a socket that listens at an address; raise OSError or OverflowError if this is not possible."""
    return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)


def _config(app: App) -> Any:
    """Return the configuration of one run of the server, with no connections yet."""
    import uvicorn

    # The application has no start-up work (lifespan). Proxy headers are ignored, since any client can write them.
    # Warnings are not logged: a client causes one with each request that is not HTTP.
    return uvicorn.Config(
        app,
        http=protocol_of(Connections()),
        log_level="error",
        access_log=False,
        lifespan="off",
        ws_max_size=LINE,
        timeout_graceful_shutdown=2,
        proxy_headers=False,
        server_header=False,
    )
