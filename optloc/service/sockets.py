"""Websockets of a server: each sends all records of a stream, and accepts lines."""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from contextlib import suppress
from typing import Any

from optloc.service.answers import Record, to_line
from optloc.service.connections import group_of
from optloc.service.messages import of_client
from optloc.service.stream import Stream

MOST, EACH = 256, 32
"""Largest number of websockets, and of websockets of one address."""

# Largest number of records that wait for a websocket.
_QUEUE = 1024


class Sockets:
    """The websockets of one stream."""

    def __init__(self, stream: Stream) -> None:
        self._stream, self._open = stream, Counter[str]()

    async def listen(self, socket: Any) -> None:
        """Serve a websocket until its client disconnects; refuse it if there are too many."""
        address = group_of(socket.client.host if socket.client else "")
        if self._open.total() >= MOST or self._open[address] >= EACH:
            await socket.close(1013, "there are too many websockets")
            return
        self._open[address] += 1
        try:
            await _listen(self._stream, socket)
        finally:
            self._open[address] -= 1
            self._open += Counter()  # remove addresses without websockets


async def _listen(stream: Stream, socket: Any) -> None:
    """Send all records to a websocket, and accept lines from it."""
    from starlette.websockets import WebSocketDisconnect

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
    client, number = socket.headers.get("x-client"), 0
    try:
        while True:
            text = await socket.receive_text()
            number += 1
            if not stream.inbox.offer(stream.lines([of_client(text.encode(), client)], "websocket", number)):
                stream.metrics.add("refused")
                await socket.send_text(
                    json.dumps({"error": "the input queue is full; send the line again", "line": number})
                )
    except (WebSocketDisconnect, RuntimeError, KeyError):
        pass  # the client has disconnected, or sends data that is not text
    finally:
        stream.listeners = tuple(each for each in stream.listeners if each is not receive)
        sending.cancel()
