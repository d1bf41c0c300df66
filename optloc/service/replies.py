"""Replies: the requests that wait for an event, and the answers that are kept for requests that are repeated.

A client that has lost its answer sends the same lines again. It gets the same answer, from memory; the event is not
solved twice. Lines with other values under the same id are refused, because one of the two events would be lost.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from threading import Lock

from optloc.service.answers import Record, join, to_line
from optloc.service.events import Event, Reply

KEPT = 16_384
"""Number of answers to requests that are kept: 16 s at a thousand requests a second, about 16 MB."""


class Replies:
    """Answers of events on their way to requests; thread-safe. `most` is the largest number of kept answers."""

    def __init__(self, most: int = KEPT) -> None:
        self._lock, self._most, self._kept = Lock(), most, OrderedDict[str, bytes]()

    def attach(self, event: Event, reply: Reply) -> bool:
        """Give a receiver the answers of an event; return False if the event is answered and its answer is not kept.

        The receiver gets the answers so far at once, and later answers as they are made.
        """
        with self._lock:
            kept = self._kept.get(event.name) if event.answered else None
            if event.answered and kept is None:
                return False
            if kept is not None:
                reply.expect()
                reply.answer(json.loads(kept), True)
            elif reply not in event.replies:
                event.replies.append(reply)
                reply.expect()
                if event.so_far is not None:
                    reply.answer(event.so_far, False)
            return True

    def answer(self, event: Event, record: Record, last: bool) -> Record:
        """Pass an answer to the receivers of its event, and return all answers of the event as one record.

        `last` marks the last answer of the event. It is kept if a receiver waited for it.
        """
        with self._lock:
            event.so_far = record if event.so_far is None else join(event.so_far, record)
            whole = event.so_far
            for reply in event.replies:
                reply.answer(record, last)
            if last:
                self._keep(event, whole)
            return whole

    def _keep(self, event: Event, whole: Record) -> None:
        """Store the whole answer of an event that requests wait for, and free the memory of the event."""
        if event.replies:
            self._kept.pop(event.name, None)
            self._kept[event.name] = to_line(join(None, whole))
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        event.answered, event.so_far, event.replies = True, None, []
