"""The application of a server: endpoints that accept lines and return fixes, tracks, health, metrics and the map."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any

from optloc.problem import InvalidProblem
from optloc.service.answers import Record, to_line
from optloc.service.messages import of_client
from optloc.service.openapi import BODY, JSON, LINES, REFUSALS, Endpoint, document
from optloc.service.queues import WAITING, Ticket
from optloc.service.site import Site
from optloc.service.sockets import Sockets
from optloc.service.stream import Stream

# Seconds after which a request is answered without its fix, since its events wait for rows of other clients, and
# seconds for the body of a request.
_PATIENCE, _UPLOAD = 30.0, 20.0
# Refusals of requests with lines.
_POSTED = (400, 408, 409, 410, 413, 429, 503, 504)
# The page has a stricter Content-Security-Policy in its head, with the digests of its scripts.
_PAGE = {"Content-Security-Policy": "frame-ancestors 'none'"}


def application(stream: Stream) -> Any:
    """Return the ASGI application of a stream, without access checks."""
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.routing import Route, WebSocketRoute

    table: list[Endpoint] = []

    async def described(_: Any) -> Any:
        return _json(document(table, stream.site))

    table += [*_feeds(stream), *_line_endpoints(stream)]
    table.append(Endpoint("/openapi.json", "GET", described, "Return this description (OpenAPI 3.1).", "Description"))

    async def failed(_: Any, error: Any) -> Any:
        return _refused(error.status_code, REFUSALS.get(error.status_code, str(error.detail)), **(error.headers or {}))

    # `:path` lets a name of a target have slashes
    routes: list[Any] = [Route(each.path.replace("}", ":path}"), each.run, methods=[each.method]) for each in table]
    routes.append(WebSocketRoute("/ws", Sockets(stream).listen))
    app = Starlette(routes=routes, exception_handlers={HTTPException: failed})
    app.router.redirect_slashes = False  # a path with a slash at its end is another path
    return app


def _json(found: Record, code: int = 200, media: str = JSON) -> Any:
    """Return a response with a record as strict JSON."""
    from starlette.responses import Response

    return Response(to_line(found), code, media_type=media)


def _refused(code: int, why: str, **headers: str) -> Any:
    """Return an error response with the HTTP status `code` and the reason `why`."""
    response = _json({"error": why}, code)
    response.headers.update(headers)
    return response


def _feeds(stream: Stream) -> list[Endpoint]:
    """Return the endpoints that read the state of a stream."""
    from starlette.responses import HTMLResponse, Response

    async def health(_: Any) -> Any:
        return _json(stream.health())

    async def metrics(_: Any) -> Any:
        text = stream.metrics.text(stream.clock())
        return Response(text, headers={"Content-Type": "text/plain; version=0.0.4; charset=utf-8"})

    # Features and marks in a thread, because many new fixes take some milliseconds.

    async def fixes(_: Any) -> Any:
        found = await asyncio.to_thread(stream.latest.features, stream.site.frame)
        return _json(found, media="application/geo+json")

    async def aircraft(_: Any) -> Any:
        return _json(stream.latest.aircraft())

    async def marks(_: Any) -> Any:
        return _json(await asyncio.to_thread(stream.latest.marks, stream.site.frame))

    async def page(_: Any) -> Any:
        """Return the page with the map; status 404 without a station on the map."""
        try:
            return HTMLResponse(await asyncio.to_thread(page_of, stream.site), headers=_PAGE)
        except InvalidProblem as error:
            return _refused(404, str(error))

    return [
        Endpoint("/", "GET", page, "Return the map of stations and fixes.", media=("text/html",), refusals=(404,)),
        Endpoint("/health", "GET", health, "Return counters and latencies.", "Health"),
        Endpoint("/metrics", "GET", metrics, "Return counters for Prometheus.", media=("text/plain",)),
        Endpoint(
            "/fixes.geojson",
            "GET",
            fixes,
            "Return the latest fix of each target as GeoJSON.",
            "Features",
            ("application/geo+json",),
        ),
        Endpoint("/map.json", "GET", marks, "Return the latest fixes for the map; the keys may change.", "Map"),
        Endpoint("/data/aircraft.json", "GET", aircraft, "Return the latest fixes in the form of readsb.", "Aircraft"),
    ]


def _line_endpoints(stream: Stream) -> list[Endpoint]:
    """Return the endpoints that accept lines and return tracks."""

    async def fix(request: Any) -> Any:
        return await _answer(stream, request, track=False)

    async def track(request: Any) -> Any:
        return _refusal_of_tracks(stream) or await _answer(stream, request, track=True)

    async def tracks(_: Any) -> Any:
        return _refusal_of_tracks(stream) or _json({"tracks": stream.tracks.records()})

    async def one_track(request: Any) -> Any:
        name = request.path_params["target"]
        found = next((each for each in stream.tracks.records() if each["target"] == name), None)
        return _refused(404, f"there is no track of {name[:40]!r}") if found is None else _json(found)

    def posted(path: str, run: Callable[[Any], Awaitable[Any]], about: str) -> Endpoint:
        """Return an endpoint that accepts lines."""
        return Endpoint(path, "POST", run, about, "Record", (JSON, LINES), lines=True, refusals=_POSTED)

    return [
        posted("/fix", fix, "Answer lines with their fixes and proofs."),
        posted("/track", track, "Answer lines with the states of their tracks."),
        Endpoint("/track", "GET", tracks, "Return the last states of all tracks.", "Tracks", refusals=(400,)),
        Endpoint("/track/{target}", "GET", one_track, "Return the last state of one track.", "Record", refusals=(404,)),
    ]


def _refusal_of_tracks(stream: Stream) -> Any:
    """Return a refusal if a stream cannot make tracks; None if it can."""
    return _refused(400, stream.track_refusal) if stream.track_refusal else None


def page_of(site: Site) -> str:
    """Return the page with the map of a site; raise InvalidProblem if no station has a position on the map."""
    from optloc.show import live_page

    return live_page(site.whole.fast.problem, site.title)


# Lines.


async def _answer(stream: Stream, request: Any, *, track: bool) -> Any:
    """Return the response to a request with lines: fixes, or states of tracks with `track`."""
    from starlette.responses import Response

    try:
        async with asyncio.timeout(_UPLOAD):
            body = await _body(request)
    except TimeoutError:
        return _refused(408, REFUSALS[408], Connection="close")
    if body is None:
        return _refused(413, REFUSALS[413], Connection="close")
    # A JSON body is one event, which may have line breaks. Another body has one event in each line.
    single = request.headers.get("content-type", "").partition(";")[0].strip().lower() == JSON
    lines = [body.replace(b"\n", b" ")] if single else [each for each in body.split(b"\n") if each.strip()]
    if not 0 < len(lines) <= WAITING:
        return _refused(400, f"send 1 to {WAITING} lines")
    client = request.headers.get("x-client")
    records = await _answers_to(stream, [of_client(each, client) for each in lines], track=track)
    if isinstance(records, int):  # an HTTP status code, for a request without answers
        return _refused(records, REFUSALS[records], **{"Retry-After": "1"})
    refused = all("error" in record and "code" in record for record in records)
    if single:
        return _json(records[0], records[0].get("code", 400) if "error" in records[0] else 200)
    return Response(b"".join(map(to_line, records)), records[0]["code"] if refused else 200, media_type=LINES)


async def _body(request: Any) -> bytes | None:
    """Return the body of a request; None if it is too large."""
    parts, size = [], 0
    async for part in request.stream():
        size += len(part)
        if size > BODY:
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
