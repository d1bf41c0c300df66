"""A stream over HTTP: events in requests and over a websocket, health, metrics, the latest fixes and their map."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Callable
from contextlib import suppress
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

from optloc.problem import InvalidProblem
from optloc.service.answers import Record, to_line
from optloc.service.messages import LINE
from optloc.service.queues import WAITING, Ticket
from optloc.service.site import Site
from optloc.service.stream import Stream

HOST, PORT = "127.0.0.1", 8200
"""Default address of the server: requests of this machine only."""

# Largest size of a request, bytes: a thousand events of a large network.
_BODY = 1 << 20
# Seconds after which a request is answered without its fix, since its events wait for rows of other clients.
_PATIENCE = 30.0
# Largest number of requests and websockets at a time, and of records that wait for a websocket.
_CONNECTIONS, _QUEUE = 256, 1024
# Permitted host names of local requests. Another name may come from a web page of a stranger whose domain name resolves
# to this machine (DNS rebinding).
_NAMES = ("localhost", "127.0.0.1", "::1", "[::1]")
# Headers of the page. No other page may show it in a frame; the page itself has a stricter Content-Security-Policy.
_SAFE = {
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def serve(stream: Stream, host: str = HOST, port: int = PORT) -> tuple[int, Callable[[], None]]:
    """Serve requests in a separate thread, and return the port and a function that stops the server.

    `host` is the name or address of the interface; other machines can reach it unless it is a local address. `port` 0
    selects a free port. Raise InvalidProblem if the address is not available, or a library is missing.
    """
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
    config = uvicorn.Config(
        application(stream, local=host in _NAMES),
        log_level="warning",
        access_log=False,
        lifespan="off",
        ws_max_size=LINE,
        limit_concurrency=_CONNECTIONS,
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


def application(stream: Stream, *, local: bool = True) -> Any:
    """Return the ASGI application of a stream.

    With `local`, a request must have a host name of this machine (`_NAMES`); otherwise any host name is permitted.
    """
    from starlette.applications import Starlette
    from starlette.middleware import Middleware
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
    from starlette.routing import Route, WebSocketRoute

    async def health(_: Any) -> Any:
        return JSONResponse(stream.health())

    async def metrics(_: Any) -> Any:
        text = stream.metrics.text(stream.clock())
        return Response(text, headers={"Content-Type": "text/plain; version=0.0.4; charset=utf-8"})

    # Features and marks in a thread, because many new fixes take some milliseconds.

    async def fixes(_: Any) -> Any:
        found = await asyncio.to_thread(stream.latest.features, stream.site.frame)
        return JSONResponse(found, media_type="application/geo+json")

    async def aircraft(_: Any) -> Any:
        return JSONResponse(stream.latest.aircraft())

    async def marks(_: Any) -> Any:
        return JSONResponse(await asyncio.to_thread(stream.latest.marks, stream.site.frame))

    async def page(_: Any) -> Any:
        """Return the page with the map; status 404 without a station on the map."""
        try:
            return HTMLResponse(await asyncio.to_thread(page_of, stream.site), headers=_SAFE)
        except InvalidProblem as error:
            return PlainTextResponse(f"{error}\n", 404)

    async def listen(socket: Any) -> None:
        await _listen(stream, socket)

    routes = [
        Route("/", page),
        *_line_routes(stream),
        Route("/health", health),
        Route("/metrics", metrics),
        Route("/fixes.geojson", fixes),
        Route("/map.json", marks),
        Route("/data/aircraft.json", aircraft),
        WebSocketRoute("/ws", listen),
    ]
    names = list(_NAMES) if local else ["*"]
    return Starlette(routes=routes, middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=names)])


def _line_routes(stream: Stream) -> list[Any]:
    """Return the routes that accept lines and return tracks."""
    from starlette.responses import JSONResponse, Response
    from starlette.routing import Route

    def refused(code: int, why: str, **headers: str) -> Any:
        """Return an error response with the HTTP status `code` and the reason `why`."""
        return JSONResponse({"error": why}, code, headers)

    async def answer(request: Any, *, track: bool) -> Any:
        """Return the response to a request with lines: fixes, or states of tracks with `track`."""
        if not _is_same_origin(request):
            return refused(403, "requests from pages of other sites are refused")
        body = await _body(request)
        if body is None:
            return refused(413, f"the request has more than {_BODY} bytes")
        # A JSON body is one event, which may have line breaks. Another body has one event in each line.
        single = request.headers.get("content-type", "").partition(";")[0].strip() == "application/json"
        lines = [body.replace(b"\n", b" ")] if single else [each for each in body.split(b"\n") if each.strip()]
        if not 0 < len(lines) <= WAITING:
            return refused(400, f"send 1 to {WAITING} lines")
        records = await _answers_to(stream, lines, track=track)
        if isinstance(records, int):  # an HTTP status code, for a request without answers
            messages = {
                429: "the input queue is full",
                503: "the stream ends",
                504: "no answer yet; it will be in the stream",
            }
            return refused(records, messages[records], **{"Retry-After": "1"})
        if single:
            return Response(to_line(records[0]), 400 if "error" in records[0] else 200, media_type="application/json")
        return Response(b"".join(map(to_line, records)), media_type="application/x-ndjson")

    async def fix(request: Any) -> Any:
        return await answer(request, track=False)

    async def track(request: Any) -> Any:
        """Return the response to /track: answers to lines (POST), or the last states of all tracks (GET)."""
        if stream.untracked:
            return refused(400, stream.untracked)
        if request.method == "POST":
            return await answer(request, track=True)
        return JSONResponse({"tracks": stream.tracks.records()})

    async def one_track(request: Any) -> Any:
        """Return the response to /track/NAME: the last state of one track; status 404 without a track."""
        name = request.path_params["name"]
        found = next((each for each in stream.tracks.records() if each["target"] == name), None)
        return refused(404, f"there is no track of {name[:40]!r}") if found is None else JSONResponse(found)

    return [
        Route("/fix", fix, methods=["POST"]),
        Route("/track", track, methods=["GET", "POST"]),
        Route("/track/{name:path}", one_track),
    ]


def page_of(site: Site) -> str:
    """Return the page with the map of a site; raise InvalidProblem if no station has a position on the map."""
    from optloc.show import live_page

    ready = site.ready((), site.rows)
    assert ready is not None  # a site has rows
    return live_page(ready.fast.problem, site.title)


def _is_same_origin(request: Any) -> bool:
    """Return whether a request comes from a program, or from a page of this server."""
    origin = request.headers.get("origin")
    return origin is None or urlsplit(origin).netloc == request.headers.get("host")


async def _body(request: Any) -> bytes | None:
    """Return the body of a request; None if it is too large."""
    parts, size = [], 0
    async for part in request.stream():
        size += len(part)
        if size > _BODY:
            return None
        parts.append(part)
    return b"".join(parts)


async def _answers_to(stream: Stream, lines: list[bytes], *, track: bool) -> list[Record] | int:
    """Return the answers to lines, or an HTTP status code if there are no answers.

    The codes are 429 (queue full), 503 (the stream ends) and 504 (no answer in time). With `track`, the answers are
    states of tracks.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[list[Record]] = loop.create_future()

    def finish(records: list[Record]) -> None:
        if not future.done():
            future.set_result(records)

    def done(records: list[Record]) -> None:
        with suppress(RuntimeError):  # the server has ended
            loop.call_soon_threadsafe(finish, records)

    ticket = Ticket(len(lines), done)
    if not stream.inbox.offer(stream.lines(lines, "request", 1, ticket, track=track)):
        if stream.inbox.closed:
            return 503
        stream.metrics.add("refused")
        return 429
    try:
        records = await asyncio.wait_for(future, _PATIENCE)
    except TimeoutError:
        return 504
    return records or [{"accepted": len(lines)}]


async def _listen(stream: Stream, socket: Any) -> None:
    """Send all records to a websocket, and accept lines from it."""
    from starlette.websockets import WebSocketDisconnect

    if not _is_same_origin(socket):
        await socket.close(1008, "requests from pages of other sites are refused")
        return
    await socket.accept()
    loop, queue = asyncio.get_running_loop(), asyncio.Queue[Record | None](_QUEUE)

    def enqueue(record: Record | None) -> None:
        """Queue a record for the websocket; if the queue is full, replace it by None, which closes the websocket."""
        with suppress(asyncio.QueueFull):
            queue.put_nowait(record)
            return
        while not queue.empty():  # a slow reader gets a close code, and must connect again
            queue.get_nowait()
        queue.put_nowait(None)

    def receive(record: Record) -> None:
        """Pass a record from a thread of the stream to the event loop of the server."""
        with suppress(RuntimeError):  # the server has ended
            loop.call_soon_threadsafe(enqueue, record)

    async def send() -> None:
        """Send queued records until None arrives, then close the websocket with the code 1013."""
        while (record := await queue.get()) is not None:
            await socket.send_text(to_line(record).decode())
        await socket.close(1013, "the client reads too slowly")

    stream.listeners = (*stream.listeners, receive)
    sending = asyncio.create_task(send())
    number = 0
    try:
        while True:
            text = await socket.receive_text()
            number += 1
            if not stream.inbox.offer(stream.lines([text.encode()], "websocket", number)):
                stream.metrics.add("refused")
                await socket.send_text(
                    json.dumps({"error": "the input queue is full; send the line again", "line": number})
                )
    except (WebSocketDisconnect, RuntimeError, KeyError):
        pass  # the client has disconnected, or sends data that is not text
    finally:
        stream.listeners = tuple(each for each in stream.listeners if each is not receive)
        sending.cancel()
